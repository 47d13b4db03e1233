"""The equations of a rig in plain text, read from its topology: with letters, and in numbers."""

from collections.abc import Iterator

import numpy as np

from jaxtank.core.units import local


def equations(plant, disturbed=False):
    """Return the lines of a rig's equations."""
    letters, numbers = [], []
    for i in range(plant.tanks):
        area, terms = float(plant.area[i]), list(_terms(plant, i))
        flows = [(sign, letter) for sign, letter, _, _ in terms]
        rates = [(sign, f"{value / area:.4g} {variable}") for sign, _, value, variable in terms]
        if disturbed:
            flows.append(("+", f"d{i + 1}"))
            rates.append(("+", f"d{i + 1}/A{i + 1}"))
        letters.append(f"A{i + 1} h{i + 1}' = {_sum(flows)}")
        numbers.append(f"h{i + 1}' = {_sum(rates)}")
    rate = local("cm/s", plant.units)
    return [
        *letters,
        f"  q(h) = sqrt(2 g h), flow per area of an outlet [{rate}]",
        *(["  w(x) = sgn(x) sqrt(2 g |x|)"] if plant.pipes else []),
        f"  {'; '.join(_meanings(plant, disturbed))}",
        f"in numbers [{rate}]:",
        *numbers,
    ]


def _meanings(plant, disturbed):
    """What the letters mean."""
    length, drive = plant.units
    yield (
        f"A cross-sections, h levels [{length}], u pump inputs [{drive}], k pump gains, a outlets"
        " to the basin"
    )
    if plant.links:
        yield "s outlets from tank to tank (s31: of tank 3 into tank 1)"
    if plant.pipes:
        yield "p pipes between tanks (p12: of tanks 1 and 2)"
    if any(second is not None for _, second in plant.feeds):
        yield "gamma share of a pump that goes to its first tank"
    if disturbed:
        yield f"d inflow that no pump brings [{local('cm^3/s', plant.units)}]"


def _terms(plant, i) -> Iterator[tuple[str, str, float, str]]:
    """(sign, flow with letters, coefficient, variable of the flow) of each flow of tank i."""
    yield from _pump_flows(plant, i)
    root = float(np.sqrt(2.0 * float(plant.gravity)))
    for k, (source, sink) in enumerate(plant.links):
        if sink == i:
            letters = f"s{source + 1}{sink + 1} q(h{source + 1})"
            yield "+", letters, float(plant.orifice[k]) * root, f"sqrt(h{source + 1})"
    for k, (a, b) in enumerate(plant.pipes):
        if i in (a, b):
            difference = f"h{i + 1} - h{(b if a == i else a) + 1}"
            letters = f"p{a + 1}{b + 1} w({difference})"
            variable = f"sgn({difference}) sqrt|{difference}|"
            yield "-", letters, float(plant.pipe[k]) * root, variable
    yield from _outlets(plant, i, root)


def _pump_flows(plant, i):
    for j, (first, second) in enumerate(plant.feeds):
        gain, share, u = float(plant.pump_gain[j]), float(plant.split[j]), f"u{j + 1}"
        if first == i and second is None:
            yield "+", f"k{j + 1} {u}", gain, u
        elif first == i:
            yield "+", f"gamma{j + 1} k{j + 1} {u}", share * gain, u
        elif second == i:
            yield "+", f"(1 - gamma{j + 1}) k{j + 1} {u}", (1.0 - share) * gain, u


def _outlets(plant, i, root):
    """The outlets of tank i, which all depend on its level, as one term."""
    areas = {
        f"s{i + 1}{sink + 1}": float(plant.orifice[k])
        for k, (source, sink) in enumerate(plant.links)
        if source == i
    }
    if float(plant.drain[i]) != 0.0:
        areas[f"a{i + 1}"] = float(plant.drain[i])
    if areas:
        names = f"({' + '.join(areas)})" if len(areas) > 1 else next(iter(areas))
        yield "-", f"{names} q(h{i + 1})", sum(areas.values()) * root, f"sqrt(h{i + 1})"


def _sum(terms):
    text = " ".join(f"{sign} {term}" for sign, term in terms)
    return text.removeprefix("+ ") or "0"


def physics(plant):
    """Return sentences on rims, empty tanks, overflow and laminar flow."""
    length = plant.units[0]
    rims = f"{', '.join(f'{v:g}' for v in np.asarray(plant.rim))} {length}"
    words = (
        "not simulated: a rim ({rims}) is a limit that a level may pass, so that a tuner can tell"
        " how far."
    )
    if plant.overflow:
        words = "simulated: a level stops at its rim ({rims}), and the liquid above it is lost."
    sentences = [f"Overflow is {words.format(rims=rims)}"]
    for (source, sink), share in zip(plant.spills, np.asarray(plant.caught)):
        sentences.append(
            f"{100 * share:.4g} % of the overflow of tank {source + 1} falls into tank {sink + 1}."
        )
    if plant.bottom:
        sentences.append(
            "A level stops at zero whatever is drawn from it; in one step no tank gives more than"
            " it holds."
        )
    sentences.append(
        f"Flow turns laminar (linear in the level) below {plant.knee:g} {length}, of a level or of"
        " a difference of levels."
    )
    return sentences

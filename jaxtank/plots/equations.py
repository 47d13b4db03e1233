"""The equations of a rig in plain text, read from its topology: with letters, and in numbers."""

import numpy as np

from jaxtank.core.units import local


def equations(plant, disturbed=False):
    """Lines of a `TankNetwork`'s equations: A_i h_i' of every tank by letters, what the letters
    are, and h_i' in numbers.

    disturbed: with the inflow d_i that no pump brings. Units as the rig counts. An outlet that is
        closed (0) is left out.
    """
    letters, numbers = [], []
    for i in range(plant.tanks):
        flows, rates = _terms(plant, i)
        flows += [("+", f"d{i + 1}")] if disturbed else []
        rates += [("+", f"d{i + 1}/A{i + 1}")] if disturbed else []
        letters.append(f"A{i + 1} h{i + 1}' = {_sum(flows)}")
        numbers.append(f"h{i + 1}' = {_sum(rates)}")
    length, drive = plant.units
    words = [
        f"A cross-sections, h levels [{length}], u pump inputs [{drive}], k pump gains, a outlets"
        " to the basin"
    ]
    words += ["s outlets from tank to tank (s31: of tank 3 into tank 1)"] if plant.links else []
    words += ["p pipes between tanks (p12: of tanks 1 and 2)"] if plant.pipes else []
    words += (
        ["gamma share of a pump that goes to its first tank"]
        if any(second is not None for _, second in plant.feeds)
        else []
    )
    words += [f"d inflow that no pump brings [{local('cm^3/s', plant.units)}]"] if disturbed else []
    meant = [f"q(h) = sqrt(2 g h), flow per area of an outlet [{local('cm/s', plant.units)}]"]
    meant += ["w(x) = sgn(x) sqrt(2 g |x|)"] if plant.pipes else []
    return [
        *letters,
        *(f"  {line}" for line in meant),
        f"  {'; '.join(words)}",
        f"in numbers [{local('cm/s', plant.units)}]:",
        *numbers,
    ]


def _terms(plant, i):
    """([(sign, flow into tank i by letters)], [(sign, rate of its level in numbers)])."""
    root, area = np.sqrt(2.0 * float(plant.gravity)), float(plant.area[i])
    flows, rates = [], []

    def add(sign, words, value, of):
        flows.append((sign, words))
        rates.append((sign, f"{value / area:.4g} {of}"))

    for j, (first, second) in enumerate(plant.feeds):
        gain, share = float(plant.pump_gain[j]), float(plant.split[j])
        if second is None and first == i:
            add("+", f"k{j + 1} u{j + 1}", gain, f"u{j + 1}")
        elif first == i:
            add("+", f"gamma{j + 1} k{j + 1} u{j + 1}", share * gain, f"u{j + 1}")
        elif second == i:
            add("+", f"(1 - gamma{j + 1}) k{j + 1} u{j + 1}", (1.0 - share) * gain, f"u{j + 1}")
    for k, (source, sink) in enumerate(plant.links):
        if sink == i:
            add(
                "+",
                f"s{source + 1}{sink + 1} q(h{source + 1})",
                float(plant.orifice[k]) * root,
                f"sqrt(h{source + 1})",
            )
    for k, (one, other) in enumerate(plant.pipes):
        if i in (one, other):
            there = other if one == i else one
            words = f"p{one + 1}{other + 1} w(h{i + 1} - h{there + 1})"
            add(
                "-",
                words,
                float(plant.pipe[k]) * root,
                f"sgn(h{i + 1} - h{there + 1}) sqrt|h{i + 1} - h{there + 1}|",
            )
    out = [
        (f"s{i + 1}{sink + 1}", float(plant.orifice[k]))
        for k, (source, sink) in enumerate(plant.links)
        if source == i
    ]
    out += [(f"a{i + 1}", float(plant.drain[i]))] if float(plant.drain[i]) != 0.0 else []
    if out:
        names = " + ".join(name for name, _ in out)
        add(
            "-",
            f"{f'({names})' if len(out) > 1 else names} q(h{i + 1})",
            sum(value for _, value in out) * root,
            f"sqrt(h{i + 1})",
        )
    return flows, rates


def _sum(terms):
    text = " ".join(f"{sign} {words}" for sign, words in terms)
    return text.removeprefix("+ ") or "0"


def physics(plant):
    """Sentences on what the rig's walls do: rims, bottoms, what passes a rim, laminar flow."""
    length = plant.units[0]
    rims = ", ".join(f"{v:g}" for v in np.asarray(plant.rim))
    found = [
        (
            f"Rims at {rims} {length} are physics: a level stops there, and what would rise past it"
            " is lost."
            if plant.overflow
            else (
                f"Rims at {rims} {length} are a limit and not physics: a level may rise past its"
                " rim, so that a tuner can tell how far."
            )
        )
    ]
    for (source, sink), share in zip(plant.spills, np.asarray(plant.caught)):
        found.append(
            f"{100 * share:.4g} % of what passes the rim of tank {source + 1} falls into tank"
            f" {sink + 1}."
        )
    if plant.bottom:
        found.append(
            "A level stops at zero whatever is drawn from it; in one step no tank gives more than"
            " it holds."
        )
    found.append(
        f"Flow turns laminar (linear in the level) below {plant.knee:g} {length}, of a level or of"
        " a difference of levels."
    )
    return found

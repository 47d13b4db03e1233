"""The equations of a rig in plain text, read from its topology: with letters, and in numbers."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxtank.core.labels import label_of, units_of_inputs
from jaxtank.core.units import local
from jaxtank.plants.elements import full_open
from jaxtank.plants.vessels import shape_name


def equations(plant, disturbed=False):
    if not plant.plain:
        return _of_elements(plant, disturbed)
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


def _of_elements(plant, disturbed):
    """Lines of the equations of a network that is not plain, in numbers."""
    terms: list[list[tuple[str, str]]] = [[] for _ in range(plant.tanks)]
    for source, sink, text in _streams(plant):
        for tank, sign in ((source, "-"), (sink, "+")):
            if tank is not None:
                terms[tank].append((sign, text))
    rows, length, drive = [], plant.units[0], units_of_inputs(plant)
    for i, flows in enumerate(terms):
        flows += [("+", f"d{i + 1}")] if disturbed else []
        content = "V" if plant.shapes else f"{float(plant.area[i]):.4g} h"
        rows.append(f"{content}{i + 1}' = {_sum(flows)}")
    lines = ["q(x) = sqrt(x) for x > 0, else 0", "w(x) = sgn(x) sqrt|x|"]
    lines = [f"  {line}" for line in lines if any(f" {line[0]}(" in row for row in rows)]
    lines += [*_curves(plant), *_volumes(plant)]
    meaning = f"h levels [{length}], u inputs [{drive}] of the pumps, then of the valves"
    return [f"in numbers [{local('cm^3/s', plant.units)}]:", *rows, *lines, f"  {meaning}"]


def _curves(plant):
    """Lines of the points of each curve."""
    for name, letter in (("curves", "f"), ("lift_curves", "e"), ("characteristics", "c")):
        for j, points in enumerate(getattr(plant, name)):
            if isinstance(points, tuple):
                pairs = ", ".join(f"({a:g}, {b:g})" for a, b in points)
                yield f"  {letter}{j + 1} through {pairs}"


def _volumes(plant):
    """Lines of the volume of each tank, of a network with shapes."""
    length = plant.units[0]
    for i in range(plant.tanks):
        if shape := shape_name(plant, i):
            area, extent = float(plant.area[i]), float(plant.extent[i])
            sizes = f"area {area:g} {length}^2, to {extent:g} {length}"
            yield f"  V{i + 1}(h{i + 1}): volume of a {shape} ({sizes})"
        elif plant.shapes:
            yield f"  V{i + 1} = {float(plant.area[i]):.4g} h{i + 1}"


def _streams(plant):
    """(from, to, flow in numbers) of each opening, pump and valve, closed ones left out."""
    root = float(np.sqrt(2.0 * float(plant.gravity)))
    yield from _outflows(plant, root)
    for k, (a, b) in enumerate(plant.pipes):
        yield a, b, f"{_entry(plant, 'pipe', k) * root:.4g} {_apart(plant, 'pipe', k, a, b)}"
    yield from _pumped(plant)
    yield from _through_valves(plant, root)


def _entry(plant, name, k) -> Any:
    value = getattr(plant, name)
    return None if value is None else float(value[k])


def _head(plant, kind, k, i):
    port = _entry(plant, f"{kind}_port", k)
    return f"h{i + 1} - {port:g}" if port else f"h{i + 1}"


def _apart(plant, kind, k, a, b):
    port = _entry(plant, f"{kind}_port", k)
    ends = (f"max(h{i + 1}, {port:g})" if port else f"h{i + 1}" for i in (a, b))
    return f"w({' - '.join(ends)})"


def _outflows(plant, root):
    outlets = [(i, None) for i in range(plant.tanks)]
    for kind, pairs in (("drain", outlets), ("orifice", plant.links)):
        for k, (source, sink) in enumerate(pairs):
            exponent = _entry(plant, f"{kind}_exponent", k)
            resistance = _entry(plant, f"{kind}_resistance", k)
            above, size = _head(plant, kind, k, source), _entry(plant, kind, k) * root
            power = f"({above})^{exponent:g}" if exponent else f"q({above})"
            if size > 0.0:
                yield source, sink, f"{size:.4g} {power}"
            if resistance and np.isfinite(resistance):
                yield source, sink, f"({above})/{resistance:g}"


def _pumped(plant):
    for j, (first, second) in enumerate(plant.feeds):
        source = plant.sources[j] if plant.sources else None
        text = f"u{j + 1}"
        if plant.curves and plant.curves[j]:
            text = f"f{j + 1}({text})"
        if plant.lift_curves and plant.lift_curves[j]:
            ends = ["0" if i is None else f"h{i + 1}" for i in (first, source)]
            text += f" e{j + 1}({' - '.join(ends)})"
        shares = [(first, 1.0)]
        if second is not None:
            share = float(plant.split[j])
            shares = [(first, share), (second, 1.0 - share)]
        for sink, share in shares:
            yield source, sink, f"{share * float(plant.pump_gain[j]):.4g} {text}"


def _through_valves(plant, root):
    for k, (source, sink) in enumerate(plant.valves):
        u = f"u{len(plant.feeds) + k + 1}"
        u = f"{u}/100" if full_open(plant.units) == 100.0 else u
        kinds = {"linear": u, "equal-percentage": f"{float(plant.rangeability[k]):g}^({u} - 1)"}
        share = kinds.get(plant.characteristics[k], f"c{k + 1}({u})")
        head, ends = _head(plant, "valve", k, source), ("valve", k, source, sink)
        flow = f"q({head})" if sink is None else _apart(plant, *ends)
        direction = " one way" if plant.one_way[k] and sink is not None else ""
        yield source, sink, f"{_entry(plant, 'valve', k) * root:.4g} {share} {flow}{direction}"


def _meanings(plant, disturbed):
    length, drive = plant.units[0], units_of_inputs(plant)
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
            yield "-", letters, float(plant.pipe[k]) * root, f"sgn({difference}) sqrt|{difference}|"
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
    links = enumerate(plant.links)
    areas = {f"s{i + 1}{b + 1}": float(plant.orifice[k]) for k, (a, b) in links if a == i}
    if float(plant.drain[i]) != 0.0:
        areas[f"a{i + 1}"] = float(plant.drain[i])
    if areas:
        names = f"({' + '.join(areas)})" if len(areas) > 1 else next(iter(areas))
        yield "-", f"{names} q(h{i + 1})", sum(areas.values()) * root, f"sqrt(h{i + 1})"


def _sum(terms):
    return " ".join(f"{sign} {term}" for sign, term in terms).removeprefix("+ ") or "0"


def physics(plant):
    """Return sentences on rims, empty tanks, overflow and laminar flow."""
    length = plant.units[0]
    rims = f"{', '.join(f'{v:g}' for v in np.asarray(plant.rim))} {length}"
    words = (
        "not simulated: a rim ({rims}) is a limit that a level may pass, so that a tuner can tell"
        " how far."
    )
    if plant.overflow:
        words = "simulated: a level stops at its rim ({rims}), and the liquid above it overflows."
    sentences = [f"Overflow is {words.format(rims=rims)}"]
    for k, ((source, sink), share) in enumerate(zip(plant.spills, np.asarray(plant.caught))):
        tank = label_of(plant, "tank", source)
        ports = getattr(plant, "spill_port", None)
        if plant.overflow and ports is not None and ports[k] < plant.rim[source]:
            sentences.append(f"The level of {tank} stops below its rim, at {ports[k]:g} {length}.")
        sentences.append(
            f"{100 * share:.4g} % of the overflow of {tank} falls into"
            f" {label_of(plant, 'tank', sink)}."
        )
    if plant.bottom:
        sentences.append(
            "A level stops at zero whatever is drawn from it; in one step no tank gives more than"
            " it holds."
        )
    sentences.append(
        f"Below {plant.knee:g} {length}, of a level or of a difference of levels, a parabola"
        " replaces the root in the flow: its slope at 0 is finite."
    )
    return sentences

"""Flows of a network with valves, pumps between tanks, curves, ports or shaped tanks.

A `TankNetwork` without any of these has its own straight-line formulas; one with them adds up the
streams below, one for each opening and each input.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxtank.core.curves import monotone_curve
from jaxtank.core.errors import InputError
from jaxtank.core.numerics import clip, lower_clip, smooth_signed_sqrt, smooth_sqrt
from jaxtank.plants.vessels import area_of, level_of, volume_of


class Stream(NamedTuple):
    """A flow from one tank to another; None is the basin."""

    source: int | None
    sink: int | None
    flow: Any  # [cm^3/s], negative where it runs from sink to source
    by_pump: bool = False  # as asked for, whatever the levels; else by a head


FEATURES = {
    "valve": ("valves",),
    "pump that draws from a tank": ("sources",),
    "pump curve": ("curves",),
    "head loss of a pump": ("lift_curves",),
    "tank with a shape": ("shapes", "extent"),
    "port above the bottom": ("drain_port", "orifice_port", "pipe_port", "valve_port"),
    "overflow below the rim": ("spill_port",),
    "exponent of an outlet": ("drain_exponent", "orifice_exponent"),
    "linear outlet": ("drain_resistance", "orifice_resistance"),
}
"""Elements that a plain network has not, and the fields of a `TankNetwork` where they are."""

TRACE = 1e-100
"""Level that is added to that of each tank, below rounding unless it is empty, where flows in
proportion to it have the shares of its outlets; in float64 its square does not underflow.
"""

PORTS = ("drain_port", "orifice_port", "pipe_port", "valve_port")


def features(net: Any) -> list[str]:
    """Return the elements of a plant that a plain network has not; [] of one, and of no network."""
    absent = lambda value: value is None or (isinstance(value, tuple) and not value)
    parts = lambda names: (getattr(net, name, None) for name in names)
    return [word for word, names in FEATURES.items() if not all(map(absent, parts(names)))]


def check_plain(net: Any, what: str, remedy: str) -> None:
    """Raise InputError for a network that is not plain."""
    if elements := features(net):
        raise InputError(f"{what}: not covered: {', '.join(elements)}; {remedy}")


def _joined(net):
    """Return (tank or None for the basin, the same) of all that moves liquid but the drains."""
    pumps = zip(net.sources or (None,) * len(net.feeds), net.feeds)
    pumped = [(source, sink) for source, sinks in pumps for sink in sinks[: 2 - (None in sinks)]]
    return [*net.links, *net.pipes, *pumped, *net.valves]


def closed_circuit(net: Any, stores: Iterable[int] = ()) -> list[int]:
    """Return tanks of circuits that exchange nothing with the basin, nor with `stores`, which take
    what the others leave over; [] of traced areas.
    """
    if any(isinstance(v, Tracer) for v in jax.tree.leaves((net.drain, net.drain_resistance))):
        return []
    open_tanks = {*stores, *np.flatnonzero(np.asarray(net.drain) > 0.0)}
    if net.drain_resistance is not None:
        open_tanks |= set(np.flatnonzero(np.isfinite(np.asarray(net.drain_resistance))))
    joined = _joined(net)
    for a, b in joined:
        open_tanks |= {b} if a is None else {a} if b is None else set()
    within = [pair for pair in joined if None not in pair]
    for _ in range(net.tanks):
        open_tanks |= {i for pair in within if open_tanks & set(pair) for i in pair}
    return [i for i in range(net.tanks) if i not in open_tanks]


def unregulated(net: Any) -> list[int]:
    """Return tanks that are not controlled and whose level acts on no flow: a store that is pumped
    out of, or that collects what runs out of others. Only a balance by chance holds their level.
    """
    if any(isinstance(v, Tracer) for v in jax.tree.leaves((net.drain, net.drain_resistance))):
        return []
    return np.flatnonzero(is_unregulated(net, np)).tolist()


def is_unregulated(net: Any, xp: Any = jnp) -> Any:
    """Return (n,) whether each tank is `unregulated`."""
    acting = {*net.outputs, *(source for source, _ in net.links)}
    acting |= {tank for pair in (*net.pipes, *net.valves) for tank in pair}
    for j, curve in enumerate(net.lift_curves or ()):
        if curve is not None:
            acting |= {*net.feeds[j], *(net.sources[j : j + 1] if net.sources else ())}
    alone = np.array([i not in acting for i in range(net.tanks)])
    drained = xp.asarray(net.drain) > 0.0
    if net.drain_resistance is not None:
        drained = drained | xp.isfinite(xp.asarray(net.drain_resistance))
    return alone & ~drained


def power_law(head: Any, exponent: Any, knee: Any) -> Any:
    """Return head^exponent for a head >= 0, with a finite slope at 0, C1 at `knee`."""
    y = lower_clip(head, 0.0) / knee
    laminar = lower_clip(y * ((2.0 - exponent) + (exponent - 1.0) * y), 0.0)
    deep = jnp.exp(exponent * jnp.log(jnp.where(y >= 1.0, y, 1.0)))
    return knee**exponent * jnp.where(y >= 1.0, deep, laminar)


def opening_flow(net: Any, area: Any, head: Any, exponent: Any, resistance: Any) -> Any:
    """Return area sqrt(2 g) head^exponent, and head/resistance beside it, of an opening."""
    root = smooth_sqrt(head, net.knee) if exponent is None else power_law(head, exponent, net.knee)
    flow = area * jnp.sqrt(2.0 * net.gravity) * root
    return flow if resistance is None else flow + lower_clip(head, 0.0) / resistance


def full_open(units: tuple[str, str]) -> float:
    """Return the input of a valve that is full open: 1, or 100 where inputs are in %."""
    return 100.0 if units[1].strip() == "%" else 1.0


def valve_share(characteristic: Any, rangeability: Any, opening: Any) -> Any:
    """Return the share of a valve's full area that is open (IEC 60534-2-4)."""
    if characteristic == "linear":
        return opening
    if characteristic == "equal-percentage":
        return jnp.exp(jnp.log(rangeability) * (opening - 1.0))
    return monotone_curve(characteristic, opening)


def openings(net: Any) -> tuple[tuple[str, Any], ...]:
    """Return the kinds of openings that discharge freely, with their (from, to)."""
    return ("drain", [(i, None) for i in range(net.tanks)]), ("orifice", net.links)


def outlet_flow(net: Any, kind: str, k: int, level: Any) -> Any:
    """Return the flow of drain or orifice k of a tank that is filled to a level."""
    area, port, exponent, resistance = (
        None if values is None else values[k]
        for values in (
            getattr(net, name)
            for name in (kind, f"{kind}_port", f"{kind}_exponent", f"{kind}_resistance")
        )
    )
    return opening_flow(net, area, _head(level, port), exponent, resistance)


def pipe_flow(net: Any, k: int, x: Any) -> Any:
    """Return the flow of pipe k from its first tank to its second."""
    port = None if net.pipe_port is None else net.pipe_port[k]
    return _joined_flow(net, net.pipe[k], x, net.pipes[k], port)


def valve_flow(net: Any, k: int, x: Any, share: Any = 1.0) -> Any:
    """Return the flow of valve k with a share of its area open."""
    (source, sink), area = net.valves[k], net.valve[k] * share
    port = None if net.valve_port is None else net.valve_port[k]
    if sink is None:
        flow = opening_flow(net, area, _head(x[source], port), None, None)
    else:
        flow = _joined_flow(net, area, x, (source, sink), port)
    return lower_clip(flow, 0.0) if net.one_way[k] else flow


def _head(level: Any, port: Any) -> Any:
    # an opening above the level is dry: no flow, in either direction
    return level if port is None else lower_clip(level - port, 0.0)


def _joined_flow(net: Any, area: Any, x: Any, ends: tuple[int, int], port: Any) -> Any:
    """Return the flow through an opening below the surface of two tanks, in both directions."""
    heads = [_head(x[i], port) for i in ends]
    root = smooth_signed_sqrt(heads[0] - heads[1], net.knee)
    return area * jnp.sqrt(2.0 * net.gravity) * root


def streams(net: Any, x: Any, u: Any) -> list[Stream]:
    """Return the flow of each drain, orifice, pipe, pump and valve at levels x and inputs u."""
    flows = [
        Stream(source, sink, outlet_flow(net, kind, k, x[source]))
        for kind, pairs in openings(net)
        for k, (source, sink) in enumerate(pairs)
    ]
    flows += [Stream(a, b, pipe_flow(net, k, x)) for k, (a, b) in enumerate(net.pipes)]
    return flows + _moved(net, input_flows(net, x, u))


def _moved(net, moved):
    """Return the streams of pumps, one for each tank that they fill, and of valves."""
    flows = []
    for j, (first, second) in enumerate(net.feeds):
        source, flow = net.sources[j] if net.sources else None, moved[j]
        if second is None:
            flows.append(Stream(source, first, flow, by_pump=True))
        else:
            flows.append(Stream(source, first, net.split[j] * flow, by_pump=True))
            flows.append(Stream(source, second, (1.0 - net.split[j]) * flow, by_pump=True))
    for k, (source, sink) in enumerate(net.valves):
        flows.append(Stream(source, sink, moved[len(net.feeds) + k]))
    return flows


def input_flows(net: Any, x: Any, u: Any) -> tuple[Any, ...]:
    """Return the flow (m,) [cm^3/s] of each pump and valve, positive from source to sink."""
    flows: list[Any] = []
    for j, (first, _) in enumerate(net.feeds):
        source = net.sources[j] if net.sources else None
        flows.append(net.pump_gain[j] * _driven(net, j, x, u[j], source, first))
    for k in range(len(net.valves)):
        opening = u[len(net.feeds) + k] / full_open(net.units)
        share = valve_share(net.characteristics[k], net.rangeability[k], opening)
        flows.append(valve_flow(net, k, x, share))
    return tuple(flows)


def _driven(net: Any, j: int, x: Any, u: Any, source: int | None, sink: int | None) -> Any:
    """Return what pump j's input asks for, by its curve, less what the lift takes away."""
    curve = net.curves[j] if net.curves else None
    demand = u if curve is None else monotone_curve(curve, u)
    by_lift = net.lift_curves[j] if net.lift_curves else None
    if by_lift is None:
        return demand
    lift = (0.0 if sink is None else x[sink]) - (0.0 if source is None else x[source])
    return demand * lower_clip(monotone_curve(by_lift, lift), 0.0)


def valves_open(net: Any) -> tuple[float, ...]:
    """Return inputs (m,) with the pumps off and the valves open."""
    return (0.0,) * len(net.feeds) + (full_open(net.units),) * len(net.valves)


def largest_supply(net: Any, u: np.ndarray) -> Any:
    """Return (samples,) what the pumps bring from the basin at most, for inputs (samples, m)."""
    total = np.zeros(len(u))
    for j in range(len(net.feeds)):
        if net.sources and net.sources[j] is not None:
            continue
        curve, by_lift = (c[j] if c else None for c in (net.curves, net.lift_curves))
        demand = u[:, j] if curve is None else np.asarray(monotone_curve(curve, u[:, j]))
        most = 1.0 if by_lift is None else max(1.0, *(share for _, share in by_lift))
        total += np.maximum(float(net.pump_gain[j]) * demand * most, 0.0)
    return total


def _shares(net, x, flows, step, d):
    """Return the shares (n,) of the flows out of each tank that it can give within a step: by their
    head, and by pumps, which also take what enters meanwhile; by head as far as the step follows.
    """
    leaving = _leaving(net, flows)
    available = [lower_clip(v, 0.0) / step for v in stored(net, x)]
    by_head = [_share(out, most) for out, most in zip(leaving, available)]
    outside = [0.0] * net.tanks if d is None else [lower_clip(v, 0.0) for v in d]
    # a shaped tank holds little beside what passes it, at steps that follow its outlets
    shaped = [i for i, shape in enumerate(net.shapes or ()) if shape != "prism"]
    (low, high), steep = STABLE, steepness(net, x, leaving, step) if shaped else []
    for _ in range(min(len(shaped), ROUNDS)):
        before = list(by_head)
        for i in shaped:
            passed = clip((high - steep[i]) / (high - low), 0.0, 1.0)
            entering = outside[i] + _entering(i, flows, before)
            by_head[i] = _share(leaving[i], available[i] + passed * entering)
    pumped = list(by_head)
    for i in sorted({source for source in net.sources or () if source is not None}):
        # a tank that is nearly empty passes on what it gets; an outlet would swing about that
        pumped[i] = _share(leaving[i], available[i] + outside[i] + _entering(i, flows, by_head))
    return by_head, pumped


def _leaving(net, flows):
    """Return the flow (n,) out of each tank."""
    leaving: list[Any] = [0.0] * net.tanks
    for source, sink, flow, _ in flows:
        if source is not None:
            leaving[source] = leaving[source] + jnp.where(flow >= 0.0, flow, 0.0)
        if sink is not None:  # a flow of 0 leaves the source
            leaving[sink] = leaving[sink] + jnp.where(flow < 0.0, -flow, 0.0)
    return leaving


def _share(out, most):
    return jnp.where(out >= most, most / jnp.where(out > 0.0, out, 1.0), 1.0)


ROUNDS = 3  # tanks in a row, each of which passes on what it gets within a step


STABLE = 1.5, 2.5
"""Step times d(outflow)/d(volume) up to which a step follows an outlet, and from which it would
swing about the bottom: between, a share of what enters may leave again. Runge-Kutta steps are
unstable above 2 (midpoint) to 2.8."""


def steepness(net: Any, x: Any, leaving: Any, step: Any) -> list[Any]:
    """Return (n,) step times d(outflow)/d(volume) of each tank, at most the end of STABLE."""
    bent = net.drain_exponent, net.orifice_exponent, net.drain_resistance, net.orifice_resistance
    exponent, ratios = 0.5 if all(v is None for v in bent) else 1.0, list[Any]()
    for area, h, out in zip(sections(net, x), x, leaving):
        # exponent * outflow / level over the section
        steep, flat = step * exponent * out, area * lower_clip(h, 0.0)
        below = STABLE[1] * flat > steep
        ratios.append(jnp.where(below, steep / jnp.where(below, flat, 1.0), STABLE[1]))
    return ratios


def _entering(i, flows, shares):
    """Return what at least enters tank i, where each tank gives a share of the flows out of it."""
    total: Any = 0.0
    for source, sink, flow, _ in flows:
        if sink == i:
            share = 1.0 if source is None else shares[source]
            total = total + jnp.where(flow >= 0.0, flow * share, 0.0)
        if source == i and sink is not None:
            total = total + jnp.where(flow < 0.0, -flow * shares[sink], 0.0)
    return total


def net_flows(net: Any, x: Any, u: Any, d: Any, step: Any = None) -> tuple[Any, ...]:
    """Return the net inflow (n,) [cm^3/s]; with `step`, at most what a tank holds leaves it."""
    # also where the tank is empty: the slopes of unlimited flows by its volume may be vast there
    flows = streams(net, x if step is None else [lower_clip(h, 0.0) + TRACE for h in x], u)
    by_head = pumped = [1.0] * net.tanks
    if step is not None:
        by_head, pumped = _shares(net, x, flows, step, d)
    rates = [0.0 if d is None else d[i] for i in range(net.tanks)]
    for source, sink, flow, by_pump in flows:
        shares = pumped if by_pump else by_head
        forward, backward = (1.0 if end is None else shares[end] for end in (source, sink))
        flow = flow * jnp.where(flow >= 0.0, forward, backward)  # also the slope of a flow of 0
        if source is not None:
            rates[source] = rates[source] - flow
        if sink is not None:
            rates[sink] = rates[sink] + flow
    return tuple(rates)


def _by_tank(net: Any, function: Any, values: Any) -> tuple[Any, ...]:
    shapes = net.shapes or ("prism",) * net.tanks
    return tuple(
        function(shape, net.area[i], 1.0 if net.extent is None else net.extent[i], values[i])
        for i, shape in enumerate(shapes)
    )


def stored(net: Any, x: Any) -> tuple[Any, ...]:
    """Return the volume (n,) [cm^3] in each tank at levels x (n,)."""
    return _by_tank(net, volume_of, x)


def levels(net: Any, volumes: Any) -> tuple[Any, ...]:
    """Return the level (n,) [cm] of each volume."""
    return _by_tank(net, level_of, volumes)


def sections(net: Any, x: Any) -> Any:
    """Return the cross-section (n,) [cm^2] of each tank at its level; None of a plant without."""
    if not getattr(net, "shapes", ()):
        return getattr(net, "area", None)
    return _by_tank(net, area_of, x)


def brims(net: Any) -> list[Any]:
    """Return the level (n,) [cm] at which each tank overflows: its rim, or a port below."""
    heights = [net.rim[i] for i in range(net.tanks)]
    for k, (source, _) in enumerate(net.spills):
        if net.spill_port is not None:
            heights[source] = jnp.minimum(heights[source], net.spill_port[k])
    return heights


def overflowed(
    net: Any, x: Any, order: tuple[list[int], list[int]], moved: Any = None
) -> tuple[Any, Any]:
    """Return (levels (n,) at or below the brims, volume lost over each (n,) [cm^3]); `moved`: as
    of `TankNetwork.spill`.
    """
    heights, volumes, lost = brims(net), list(stored(net, x)), [0.0] * net.tanks
    brim = stored(net, heights)
    if moved is not None:
        volumes = [v - m for v, m in zip(volumes, moved)]
    full = [False] * net.tanks

    def over(i: int) -> Any:
        excess = lower_clip(volumes[i] - brim[i], 0.0)
        lost[i], volumes[i] = lost[i] + excess, volumes[i] - excess
        full[i] = excess > 0.0
        return excess

    placed, ring = order
    for i in placed:
        excess = over(i)
        for k, (source, sink) in enumerate(net.spills):
            if source == i:
                lost[i] = lost[i] - net.caught[k] * excess
                volumes[sink] = volumes[sink] + net.caught[k] * excess
    for i in ring:  # what has come back to a full tank leaves the rig there
        over(i)
    if moved is not None and net.bottom:
        volumes = [lower_clip(v, 0.0) for v in volumes]
    # a tank that overflows stands at its brim exactly, and others keep their level to the bit
    lower = levels(net, volumes)
    return tuple(jnp.where(full[i], heights[i], lower[i]) for i in range(net.tanks)), tuple(lost)

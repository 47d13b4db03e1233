"""Levels and inputs of the steady states of a reference on many plants; which plants reach them."""

import contextlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxtank.analysis.steady_batch import SteadyStates, flow_leaves
from jaxtank.case import Case
from jaxtank.core.errors import InputError
from jaxtank.core.labels import labels_of
from jaxtank.core.text import count
from jaxtank.core.tree import get_value, split_index
from jaxtank.limits import lowest_levels
from jaxtank.loop.steady import sharing, steady_inflow
from jaxtank.plants.elements import brims, closed_circuit, unregulated
from jaxtank.plants.tank_network import TankNetwork
from jaxtank.rig import check_limits
from jaxtank.signals.base import Constant, Sum
from jaxtank.signals.inflows import InflowTable
from jaxtank.signals.setpoints import Ramps


class Plateau(NamedTuple):
    """Setpoints that are held for a while."""

    time_s: float  # its start [s]
    names: tuple[str, ...]  # (outputs,) dotted name of each setpoint
    values: tuple[float, ...]  # (outputs,) each setpoint [cm]


def plateaus_of(case: Case) -> list[Plateau] | None:
    """Return the plateaus of a case in order of time, or None where its reference has none."""
    reference: Any = case.loop.reference
    if isinstance(reference, Constant):
        names = tuple(f"reference.level[{i}]" for i in range(reference.channels))
        return [Plateau(0.0, names, tuple(map(float, reference.level)))]
    if not isinstance(reference, Ramps):
        return None
    ramp = float(reference.ramp)
    names = [f"reference.initial[{i}]" for i in range(reference.channels)]
    values = [float(v) for v in reference.initial]
    starts = sorted({time for time, _ in reference.changes})
    plateaus = [] if starts and starts[0] <= 0.0 else [Plateau(0.0, tuple(names), tuple(values))]
    for start, following in zip(starts, [*starts[1:], np.inf]):
        for j, (time, i) in enumerate(reference.changes):
            if time == start:
                names[i], values[i] = f"reference.targets[{j}]", float(reference.targets[j])
        if start + ramp <= min(following, case.clock.duration):
            plateaus.append(Plateau(start + ramp, tuple(names), tuple(values)))
    return plateaus


BLOCK = 1 << 14  # draws whose steady states are computed at once: 100 bytes each

RESTS = {"plain": "dead_zone", "hysteresis": "stop"}
"""{kind of a dead zone: leaf of the input at or below which nothing flows}."""

TOLERANCE = 1e-9  # by how much a limit may be passed, as a share of its size: rounding


class Needs:
    """Levels and inputs of the steady states at every plateau of a case, for each of N plants."""

    def __init__(
        self, case: Case, values: Mapping[str, Any], limits: Mapping[str, Any] | None = None
    ):
        loop: Any = case.loop
        plateaus = plateaus_of(case)
        if (why := unjudged(case)) or not plateaus:
            raise InputError(f"{case.name}: feasibility is not known: {why}")
        count = len(next(iter(values.values()))) if values else 1
        of = lambda name: drawn_values(loop, name, values, count)
        steady = steady_inflow(loop)
        inflow = 0.0 if steady is None else np.asarray(steady, dtype=float)
        if isinstance(loop.disturbance, Constant):
            inflow = of("disturbance.level")
        zoned = np.ndim(loop.actuator.offset) > 0
        self.offset = of("actuator.dead_zone") if zoned else np.zeros((1, loop.plant.pumps))
        self.case, self.values, self.limits = case, dict(values), limits
        self.plateaus, self.count = plateaus, count
        flows = {name: of(f"plant.{name}") for name in flow_leaves(loop.plant)}
        self.states = SteadyStates(loop.plant, flows, inflow, sharing(loop))
        self.setpoints = np.stack(
            [np.stack([of(name) for name in p.names], axis=-1) for p in plateaus], axis=1
        )
        self.rim = of("plant.rim")
        stated = check_limits(loop, case.limits if limits is None else limits)
        self.at_rim, level = _limit_of(loop.plant, stated)
        top = np.where(self.at_rim, self.rim, level)
        low = of("actuator.low")
        low = np.maximum(low, self.offset) if zoned else low
        zone = RESTS.get(getattr(loop.actuator, "dead_zone_kind", ""), "")
        idle = zone and getattr(loop.actuator, "dead_zone", None) is not None
        low = np.maximum(low, of(f"actuator.{zone}")) if idle else low
        self.idle = slice(loop.plant.tanks, None) if idle else slice(0)  # inputs that may also be 0
        lowest = np.fmax(lowest_levels(case.replace(limits=stated)), 0.0)  # 0 also for NaN: none
        least = np.broadcast_to(lowest, top.shape)
        self.low = np.concatenate([least, low], axis=1)
        self.high = np.concatenate([top, of("actuator.high")], axis=1)

    def first(self, count: int) -> "Needs":
        return Needs(self.case, {n: v[:count] for n, v in self.values.items()}, self.limits)

    def at(self, setpoints: Any = None) -> np.ndarray:
        """Return (N, P, n + m) levels and inputs at setpoints (P, outputs) or (N, P, outputs)."""
        # Those of the case where None. A level below 0: the flow would have to run backwards.
        levels, inputs = self.states.at(self.setpoints if setpoints is None else setpoints)
        return np.concatenate([levels, inputs + self.offset[:, None]], axis=2)

    def excess(self, needed: Any = None, low: Any = None, high: Any = None) -> np.ndarray:
        """Return (N, P, n + m) by how much `needed` passes a limit [cm, V]; negative: a margin."""
        needed = self.at() if needed is None else needed
        low, high = self.low if low is None else low, self.high if high is None else high
        scale = TOLERANCE * np.maximum(np.abs(low), np.abs(high))
        over = np.maximum(needed - high[:, None], low[:, None] - needed) - scale[:, None]
        off = np.abs(needed[..., self.idle]) <= scale[:, None, self.idle]
        over[..., self.idle] = np.where(off, -scale[:, None, self.idle], over[..., self.idle])
        return np.where(np.isfinite(over), over, np.inf)

    def feasible(self, needed: Any = None, high: Any = None) -> np.ndarray:
        return ~np.any(self.excess(needed, high=high) > 0, axis=(1, 2))


def unjudged(case: Case) -> str:
    """Return why `Needs` is not defined for a case; "" where it is."""
    plant: Any = case.loop.plant
    if not isinstance(plant, TankNetwork):
        return f"a {type(plant).__name__} is no network of tanks"
    if inflow_varies(case.loop.disturbance):
        return "its inflow follows a table, and what can be held changes with it"
    names = lambda tanks: (
        f"{labels_of(plant, 'tank', tanks)} {'has' if len(tanks) == 1 else 'have'}"
    )
    if tanks := () if plant.plain else closed_circuit(plant, unregulated(plant)):
        volume = "so that steady levels depend on the initial volume"
        return f"{names(tanks)} no exchange with the basin, {volume}"
    if tanks := unregulated(plant):
        return f"{names(tanks)} no outflow that rises with the level, and fills or runs empty"
    if plant.pumps != len(plant.outputs) and sharing(case.loop) is None:
        return f"it has {count(plant.pumps, 'input')} and {count(len(plant.outputs), 'output')}"
    return (
        _needs_overflow(case) if plateaus_of(case) else "its setpoints are never held for a while"
    )


def _needs_overflow(case: Case) -> str:
    """Why it is not known, where a tank may need what another overflows; "" elsewhere."""
    loop: Any = case.loop
    plant = loop.plant
    if not (plant.overflow and plant.spills):
        return ""
    flow, plateaus = steady_inflow(loop), plateaus_of(case) or ()
    inflow, levels = 0.0 if flow is None else np.asarray(flow), np.full((1, plant.tanks), np.nan)
    with contextlib.suppress(InputError):  # an output that no pump moves but by what overflows
        states = SteadyStates(plant, {}, inflow, sharing(loop))
        levels = states.at([plateau.values for plateau in plateaus])[0][0]
    full = sorted({source for source, _ in plant.spills})
    brim = np.array(brims(plant), dtype=float)[full]
    above = ~np.all(levels[:, full] <= brim, axis=0)  # or without a steady state
    if np.all(levels >= 0.0) and not above.any():
        return ""
    if np.any(above & _must_not_overflow(case)[full]):  # then no such setpoint is within limits
        return ""
    tanks = labels_of(plant, "tank", full)
    return f"steady states do not count what overflows from {tanks} into another tank"


def _must_not_overflow(case: Case) -> np.ndarray:
    """Where a limit of the case keeps a tank below its brim: (n,) booleans."""
    plant: Any = case.loop.plant
    if "max_level" not in case.limits:
        return np.zeros(plant.tanks, dtype=bool)
    level: Any = check_limits(case.loop, case.limits)["max_level"]
    rim, brim = (np.array(v, dtype=float) for v in (plant.rim, brims(plant)))
    level = rim if isinstance(level, str) else np.asarray(level, dtype=float)
    lost = np.ones(plant.tanks)  # share of the overflow that no tank catches
    for (source, _), share in zip(plant.spills, np.asarray(plant.caught, dtype=float)):
        lost[source] -= share
    return (level <= brim) & (level < rim) | (level >= rim) & (lost > TOLERANCE)


def inflow_varies(inflow: Any) -> bool:
    """Return whether an inflow is a table of more than one row."""
    if isinstance(inflow, Sum):
        return inflow_varies(inflow.first) or inflow_varies(inflow.second)
    return isinstance(inflow, InflowTable) and any(len(times) > 1 for *_, times in inflow.rows)


def drawn_values(loop: Any, name: str, values: Mapping[str, Any], count: int) -> np.ndarray:
    """Return (count, ...) values of a leaf, or of an entry of it, over the draws."""
    base, index = split_index(name)
    whole = np.asarray(get_value(loop, base), dtype=float)
    leaf = np.array(np.broadcast_to(whole, (count, *whole.shape)))
    for other, column in values.items():
        owner, entry = split_index(other)
        if owner == base:
            part, column = leaf[(slice(None), *entry)], np.asarray(column, dtype=float)
            part[...] = column.reshape(column.shape + (1,) * (part.ndim - column.ndim))
    return leaf[(slice(None), *index)]


def _limit_of(plant, limits):
    """((n,) True where a tank's limit is its rim, (n,) limit [cm])."""
    level, rim = limits.get("max_level", "rim"), np.asarray(plant.rim, dtype=float)
    if isinstance(level, str):
        return np.ones(plant.tanks, dtype=bool), rim
    level = np.broadcast_to(np.asarray(level, dtype=float), (plant.tanks,))
    at_rim = np.isnan(level) | (plant.overflow & (level >= rim))
    return at_rim, np.where(at_rim, rim, level)


def infeasible(case: Case, values: Mapping[str, Any]) -> np.ndarray | None:
    """Return where a plateau of the reference has no steady state within rims and pump limits."""
    if getattr(case.loop.plant, "pipes", None) != () or unjudged(case):
        return None
    rims, blocks = {"max_level": "rim"}, range(0, len(next(iter(values.values()))), BLOCK)
    parts = ({n: v[i : i + BLOCK] for n, v in values.items()} for i in blocks)
    return np.concatenate([~Needs(case, part, rims).feasible() for part in parts])

"""An independent check of a finished safety filter: for which tanks it keeps the limits.

It works on the final numbers, with its own formulas; README.md: "What the checker covers".
"""
# Conditions are generators of (holds, reason), holds written so that a NaN fails it.

import functools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxtank.core.labels import label_of
from jaxtank.safety.known_features import (
    FLOWS,
    SHAPE,
    SIGMAS,
    first_failure,
    readable,
    span_of,
    unknown_feature,
)

LIMITS, CASE = "limits", "case"
"""Levels at t = 0 for which a verdict holds: any at or below the limits, or the case's start."""
SHALLOW = 0.05  # a0 of Theorem 2 as a share of the root of the limit
PARTS = 1000  # intervals of readings on which least inputs and caps are compared
ROUNDING = 1e-9


class Verdict(NamedTuple):
    """Whether the limits of one tank are proved on every plant of the box, and the reason."""

    # tank : counted from 0. holds, low_holds : of the upper and the low limit. reason, low_reason :
    # the theorem, the condition that fails with both numbers, or "not covered: FEATURE". starts :
    # LIMITS or CASE.

    tank: int
    holds: bool
    reason: str
    starts: str
    low_holds: bool
    low_reason: str


def check(
    safety_filter: Any,
    plant: Any,
    actuator: Any,
    sensor: Any,
    *,
    hold: float,
    substeps: int = 1,
    box: Mapping[str, tuple[Any, Any]],
    inflow: tuple[Any, Any] = (0.0, 0.0),
    volume: Any = 0.0,
    draws: bool = False,
    start: Any = None,
    faults: Any = None,
    limits: Any = None,
) -> tuple[Verdict, ...]:
    """Return the Verdict of each tank."""
    parts = {"plant": plant, "actuator": actuator, "sensor": sensor, "safety_filter": safety_filter}
    parts |= {} if faults is None else {"faults": faults}
    tanks = len(np.atleast_1d(safety_filter.limit))
    not_proved = lambda why: tuple(Verdict(i, False, why, CASE, False, why) for i in range(tanks))
    if why := unknown_feature(parts, box):
        return not_proved(why)
    rig = _Rig(safety_filter, plant, actuator, sensor, hold, substeps, box, faults)
    rig.disturbed(inflow, volume, draws)
    least = start
    if start is not None and "x0" in box:
        least, start = (np.asarray(v, dtype=float) for v in box["x0"])
    claimed = rig.limit + rig.spare if limits is None else np.asarray(limits, float)
    if why := rig.uncovered():
        return not_proved(why)
    from_any = _joint(rig, None, claimed)
    upper = from_any if start is None else _joint(rig, np.asarray(start, float), claimed)
    lows = _joint_low(rig, least, upper)
    return tuple(_verdict(rig, i, from_any, upper, lows[i]) for i in range(tanks))


def _verdict(rig, i, from_any, upper, low_reason):
    limited = rig.low[i] > 0.0
    return Verdict(
        tank=i,
        holds=not upper.reasons[i],
        reason=upper.reasons[i] or upper.theorems[i],
        starts=CASE if from_any.reasons[i] else LIMITS,
        low_holds=bool(limited and not low_reason),
        low_reason=low_reason or ("Low limits" if limited else ""),
    )


def _root(h, knee):
    """Root of a level in the flows of a TankNetwork: a parabola below the laminar threshold."""
    if h >= knee:
        return math.sqrt(h)
    x = max(h, 0.0) / knee
    return math.sqrt(knee) * x * (1.5 - 0.5 * x)


def _pipe_root(z, knee):
    """Signed root of a difference of levels in the flows of a TankNetwork."""
    return math.copysign(math.inf, z) if math.isinf(z) else z / math.sqrt(math.hypot(z, knee))


class _Rig:
    """The final numbers: coefficients per tank of the filter's plants, limits, pumps, readings."""

    limit: np.ndarray
    spare: np.ndarray
    low: np.ndarray

    def __init__(self, safety_filter, plant, actuator, sensor, hold, substeps, box, faults):
        self.filter, self.plant, self.hold = safety_filter, plant, float(hold)
        self.label = functools.partial(label_of, plant, "tank")
        self.unit, self.knee = plant.units[0], float(plant.knee)
        n = self.tanks = len(np.atleast_1d(plant.rim))
        full = lambda v, size=n: np.broadcast_to(np.asarray(v, dtype=float), (size,))
        for name in ("limit", "reach", "spare", "rate", "slope", "band", "low", "bottom"):
            setattr(self, name, full(getattr(safety_filter, name)))
        for name in ("held", "kept", "divided", "running"):
            setattr(self, name, set(getattr(safety_filter, name, ())))
        self.predicted = int(safety_filter.predicted)
        self.faults, self.span = faults, functools.partial(span_of, dict(box))
        self.rim, self.highest_rim = (full(v) for v in self.span("plant.rim", plant.rim))
        self.caught = self.span("plant.caught", plant.caught)[1]
        self._coefficients(safety_filter.least, safety_filter.most, hold / substeps)
        self._pumps(actuator, full)
        self.needed, self.top = readable(sensor, self.span, full)

    def _coefficients(self, least, most, step):
        plant, n = self.plant, self.tanks
        slow, fast = math.sqrt(2.0 * float(least.gravity)), math.sqrt(2.0 * float(most.gravity))
        small, large = np.asarray(least.area, float), np.asarray(most.area, float)
        self.area = small
        free = [np.array(p.drain, dtype=float) for p in (least, most)]
        # of each tank: {source: (least, largest)} of its orifices together, {tanks below}, [(other,
        # least, largest)] of its pipes, {pump: (least, largest)}
        self.into, self.below = [{} for _ in range(n)], [set() for _ in range(n)]
        self.pipes, self.gains = [[] for _ in range(n)], [{} for _ in range(n)]
        for k, (i, j) in enumerate(plant.links):
            free[0][i] += least.orifice[k]
            free[1][i] += most.orifice[k]
            ends = slow * least.orifice[k] / large[j], fast * most.orifice[k] / small[j]
            _add(self.into[j], i, ends)
            self.below[i].add(j)
        outlets = free[1].copy()
        for k, pair in enumerate(plant.pipes):
            for i, j in (pair, pair[::-1]):
                outlets[i] += most.pipe[k]
                ends = slow * least.pipe[k] / large[i], fast * most.pipe[k] / small[i]
                self.pipes[i].append((j, *map(float, ends)))
        self.out, self.out_most = slow * free[0] / large, fast * free[1] / small
        # with `bottom` a tank gives less than its outlets would below this level
        self.empty = (step * fast * outlets / small) ** 2 if plant.bottom else np.zeros(n)
        for j, (first, second) in enumerate(plant.feeds):
            shares = [(first, 1.0, 1.0)]
            if second is not None:
                a, b = float(least.split[j]), float(most.split[j])
                shares = [(first, a, b), (second, 1.0 - b, 1.0 - a)]
            for i, a, b in shares:
                ends = float(least.pump_gain[j]) * a / large[i], most.pump_gain[j] * b / small[i]
                _add(self.gains[i], j, ends)

    def _pumps(self, bank, full):
        m = len(self.plant.feeds)
        span = lambda name: self.span(f"actuator.{name}", getattr(bank, name))
        each = lambda name: tuple(full(v, m) for v in span(name))
        self.lag, self.delay = each("lag"), tuple(float(v) for v in span("delay"))
        self.zoned = bank.dead_zone is not None
        self.pulsed = self.zoned and bank.dead_zone_kind == "pulse"
        dead = span("dead_zone")[0] if self.zoned and bank.dead_zone_kind == "offset" else 0.0
        self.dead = full(dead, m)
        # inputs as the filter counts them, less its offset
        self.offset, (self.backwards, self.lowest) = full(self.filter.offset, m), each("low")
        self.weakest, self.high = (v - self.offset for v in each("high"))
        self.capped = full(bank.high, m) - self.offset
        # pumps whose lower limit, or input before the start, may be above what the filter counts on
        self.stronger = self.lowest > np.maximum(full(bank.low, m), 0.0)
        leaves = ("low", "high", "initial")
        self.unsure = any(np.any(e != getattr(bank, name)) for name in leaves for e in span(name))
        self.under_way = np.zeros(m)
        if self.delay[1] > 0.0 or np.any(self.lag[1] > 0.0):
            self.under_way = np.maximum(each("initial")[1] - self.offset, 0.0)
        self.most = np.maximum(np.maximum(self.high, self.under_way), 0.0)
        if self.pulsed:
            self.most = np.maximum(self.most, each("pulse")[1])

    def disturbed(self, inflow, volume, draws):
        """Take the inflow disturbances of the case."""
        full = lambda v: np.broadcast_to(np.asarray(v, dtype=float), (self.tanks,))
        self.leaving, self.entering, self.volume = full(inflow[0]), full(inflow[1]), full(volume)
        self.draws = bool(draws)
        self.inflow, self.draw = full(self.filter.inflow), full(self.filter.draw)

    def pumped(self, tank, inputs):
        """The most that pumps at `inputs` (m) [V] bring [cm/s]."""
        return sum(b * max(inputs[j], 0.0) for j, (_, b) in self.gains[tank].items())

    def rise(self, tank, level, others):
        """Largest rate of a level with its pumps off, other levels at most `others` [cm/s]."""
        h = max(level, 0.0)
        leaves, rate = h >= self.empty[tank], self.inflow[tank] / self.area[tank]
        if leaves:
            rate -= self.out[tank] * _root(h, self.knee)
        for other, least, most in self.pipes[tank]:
            s = _pipe_root(others[other] - h, self.knee)
            rate += most * s if s >= 0.0 else least * s if leaves else 0.0
        for source, (_, most) in self.into[tank].items():
            rate += most * _root(others[source], self.knee) if most > 0.0 else 0.0
        return float(rate)

    def fall(self, tank, level, others):
        """Least rate of a level with its pumps off, other levels at least `others` [cm/s]."""
        h = max(level, 0.0)
        rate = self.draw[tank] / self.area[tank] - self.out_most[tank] * _root(h, self.knee)
        for other, least, most in self.pipes[tank]:
            s = _pipe_root(others[other] - h, self.knee)
            gives = others[other] >= self.empty[other]
            rate += most * s if s < 0.0 else least * s if gives else 0.0
        for source, (least, _) in self.into[tank].items():
            if others[source] >= self.empty[source]:
                rate += least * _root(others[source], self.knee)
        return float(rate)

    def neighbours(self, tank):
        """Tanks on whose levels the rate of this one depends."""
        return set(self.into[tank]) | {k for k, *_ in self.pipes[tank]}

    def rounding(self, tank, level):
        return ROUNDING * max(self.out[tank] * _root(level, self.knee), 1e-9)

    def uncovered(self):
        """What the filter does not count on, of the whole rig; or ""."""
        self.faults_lower_levels = False  # outside the box, but only lowering levels
        return first_failure(self._covered())

    def _covered(self):
        """(holds, reason): the plant, its box and its faults are in the filter's box."""
        for name in SHAPE:
            same = all(getattr(e, name) == getattr(self.plant, name) for e in _ends(self.filter))
            yield same, f"not covered: plant.{name} differs from that of the safety filter"
        ends = {name: self.span(f"plant.{name}", getattr(self.plant, name)) for name in FLOWS}
        yield from self._inside(ends, "")
        faults = self.faults
        counted = {name: (low.copy(), high.copy()) for name, (low, high) in ends.items()}
        entries = () if faults is None else zip(faults.windows, faults.factor, faults.extra)
        for (name, *_), factor, extra in entries:
            field, _, entry = name.partition("[")
            at = int(entry.rstrip("]")) if entry else ...
            yield field in ends, f"not covered: fault of plant.{name}"
            low, high = (end[at] for end in ends[field])
            moved = factor * low + extra, factor * high + extra
            wide = min(low, *moved), max(high, *moved)
            ends[field][0][at], ends[field][1][at] = wide
            # a leak and a weak pump lower levels: nothing passes a limit that did not without
            gentle = wide
            if field == "drain":
                gentle = wide[0], counted[field][1][at]
            elif field == "pump_gain":
                gentle = counted[field][0][at], wide[1]
            self.faults_lower_levels |= gentle != wide
            counted[field][0][at], counted[field][1][at] = gentle
            yield from self._inside(counted, "fault of ")

    def _inside(self, ends, what):
        """(holds, reason) of each coefficient being in the filter's box."""
        for name, (low, high) in ends.items():
            least, most = (np.asarray(getattr(p, name), float) for p in _ends(self.filter))
            low, high = np.broadcast_to(low, least.shape), np.broadcast_to(high, most.shape)
            slack = 1e-12 * np.maximum(np.abs(low), np.abs(high))
            top = np.minimum(high, 1.0) if name == "split" else high  # a share above 1 is none
            for at in np.ndindex(least.shape):
                a, b, c, d = (float(v[at]) for v in (low, high, least, most))
                holds = c <= a + slack[at] and d >= float(top[at]) - slack[at]
                place = f"plant.{name}" + "".join(f"[{k}]" for k in at)
                counts = f"the filter counts on {c:.4g} to {d:.4g}"
                yield holds, f"not covered: {what}{place} from {a:.4g} to {b:.4g}, {counts}"


def _add(table, key, ends):
    """Add (least, largest) to those that a table has of a key."""
    before = table.get(key, (0.0, 0.0))
    table[key] = (before[0] + float(ends[0]), before[1] + float(ends[1]))


def _ends(safety_filter):
    return safety_filter.least, safety_filter.most


class _Hypotheses(NamedTuple):
    """Assumptions on all tanks (n,): upper bounds [cm], no overflow, largest start [cm]."""

    bounds: np.ndarray
    dry: np.ndarray
    begin: np.ndarray
    of_case: bool


class _JointResult(NamedTuple):
    """Of each tank: the condition that fails, or ""; the theorem; the bound of its level [cm]."""

    reasons: list[str]
    theorems: list[str]
    bounds: np.ndarray


def _joint(rig, start, claimed):
    """The largest set of tanks whose limits are kept together, from `start`, or from any levels."""
    level = np.array(rig.limit)  # before volumes that enter besides
    if start is None:
        free = [i for i in range(rig.tanks) if i not in rig.held]
        level[free] = (claimed - rig.spare)[free]
    begin = claimed if start is None else start
    inside, bounded = set(range(rig.tanks)), set(range(rig.tanks))
    dry, alone = np.ones(rig.tanks, dtype=bool), None
    while True:
        bounds = np.full(rig.tanks, np.inf)
        bounds[list(bounded)] = rig.reach[list(bounded)]
        bounds[list(inside)] = (level + rig.spare)[list(inside)]
        still = dry & (bounds <= rig.rim * (1.0 + 1e-12))
        at = _Hypotheses(bounds, still, begin, start is not None)
        upper = [_upper(rig, i, level[i], at) for i in range(rig.tanks)]
        alone = alone or upper
        outside = {i for i in inside if upper[i][0]}
        loose, wet = _loose_and_wet(rig, bounded - inside, at, dry)
        if not (outside or loose or wet):
            break
        inside, bounded, dry = inside - outside, bounded - loose, dry.copy()
        dry[list(wet)] = False
    lost = set(range(rig.tanks)) - inside
    reasons = [_reason(rig, i, alone[i][0], upper[i][0], lost) for i in range(rig.tanks)]
    return _JointResult(reasons, [theorem for _, theorem in upper], bounds)


def _loose_and_wet(rig, tanks, at, dry):
    """Those of `tanks` without a bound, and those that may overflow though counted as `dry`."""
    stays = {i: _stays(rig, i, at) for i in tanks}
    loose = {i for i, how in stays.items() if not how}
    return loose, {i for i, how in stays.items() if how != "flows" and dry[i]}


def _reason(rig, i, alone, together, lost):
    """Why the limit of a tank is not proved: `alone`, or because of the tanks `lost`; or ""."""
    if alone or not together:
        return alone
    others = sorted(lost - {i})
    near = [k for k in others if k in rig.neighbours(i)] or others
    return f"relies on {', '.join(map(rig.label, near))}, not proved"


def _stays(rig, i, at):
    """What keeps a level below its `reach`, whatever its pumps do: "flows", the "rim", or ""."""
    top = rig.reach[i] - rig.spare[i]
    if not (at.begin[i] <= top * (1.0 + 1e-12) and math.isfinite(top) and top > 0.0):
        return ""
    if first_failure(_entering(rig, i, at)):
        return ""
    if rig.rise(i, top, at.bounds) + rig.pumped(i, rig.most) <= rig.rounding(i, top):
        return "flows"
    return "rim" if rig.plant.overflow and rig.reach[i] >= rig.highest_rim[i] else ""


def _entering(rig, i, at):
    """(holds, reason): no more enters than the filter counts on, overflow of others included."""
    entering, counts = rig.entering[i], "the filter counts on"
    for (a, b), share in zip(rig.plant.spills, rig.caught) if rig.plant.overflow else ():
        if b != i or at.dry[a]:
            continue
        ringed = _ringed(rig.plant.spills, i)
        yield not ringed, "not covered: a ring of tanks that overflow into each other"
        below = at.begin[a] + rig.spare[a] <= rig.rim[a] * (1.0 + 1e-12)
        yield below, f"not covered: volumes that overflow at once from {rig.label(a)}"
        yield from _entering(rig, a, at)
        over = rig.rise(a, rig.rim[a], at.bounds) + rig.pumped(a, rig.most)
        entering += share * max(over, 0.0) * float(np.asarray(rig.filter.most.area)[a])
    reason = f"{entering:.4g} {rig.unit}^3/s may enter, {counts} {rig.inflow[i]:.4g}"
    yield entering <= rig.inflow[i] * (1.0 + ROUNDING), reason
    risen = rig.volume[i] / rig.area[i]
    reason = f"inflow pulses raise it by {risen:.4g} {rig.unit}, {counts} {rig.spare[i]:.4g}"
    yield risen <= rig.spare[i] * (1.0 + ROUNDING), reason


def _ringed(spills, tank):
    """Whether what overflows from a tank can come back to it."""
    reached, new = set(), {tank}
    while new:
        reached |= new
        new = {b for a, b in spills if a in new} - (reached - {tank})
        if tank in new:
            return True
    return False


def _upper(rig, i, level, at):
    """(why a limit is not proved with the other tanks at their bounds, or ""; the theorem)."""
    if not at.begin[i] <= level * (1.0 + 1e-12):
        unit = rig.unit
        return f"start at {at.begin[i]:.4g} {unit}, above the limit {level:.4g} {unit}", ""
    if why := first_failure(_entering(rig, i, at)):
        return why, ""
    if not all(math.isfinite(at.bounds[k]) for k in rig.neighbours(i)):
        return "a tank beside it has no bound", ""
    if i in rig.held:
        return _upper_of_row(rig, i, level, at)
    theorem = "full pumps stay below" if rig.gains[i] else ""
    theorem = theorem or "no pump, and its inflow cannot pass the limit"
    why = _rim(rig, i, level, rig.rise(i, level, at.bounds) + rig.pumped(i, rig.most))
    return why, "" if why else theorem


def _upper_of_row(rig, i, level, at):
    """The same of a tank whose limit a row of the filter keeps."""
    if why := first_failure(_readable(rig, i, at.bounds)):
        return why, ""
    if rig.pulsed:
        return "not covered: a pulse dead zone pays out more than was commanded", ""
    if rig.slope[i] > 0.0:
        return first_failure(_second_order(rig, i, at)), "Theorem 2"
    if why := first_failure(_row(rig, i, level, at)):
        return why, ""
    lag = max(rig.lag[1][j] for j in rig.gains[i])
    if rig.delay[1] == 0.0 and lag == 0.0:
        why = first_failure([_rate_of_hold(rig, i, "kappa T")])
        return why, "" if why else "Theorem 1"
    if rig.predicted:
        return first_failure(_predicted(rig, i, level, at)), "Theorem 5"
    theorem = "Theorem 4" if lag > 0.0 else "Theorem 3"
    return first_failure(_late(rig, i, level, lag, at)), theorem


def _rate_of_hold(rig, i, what):
    value = rig.rate[i] * rig.hold
    return value <= 1.0 + 1e-12, f"{what} = {value:.3g} above 1"


def _rim(rig, i, level, entering):
    """The rim condition of a tank into which `entering` [cm/s] more enters than leaves, or ""."""
    if entering <= rig.rounding(i, level):
        return ""
    leaves = rig.out[i] * _root(level, rig.knee)
    enters = f"rim condition: {entering + leaves:.4g} {rig.unit}/s may enter at the limit"
    return f"{enters}, {leaves:.4g} leave for certain"


def _row(rig, i, level, at):
    """(holds, reason) of what each row on a tank's own pumps needs."""
    gains = rig.gains[i]
    yield gains, "no row: it has neither a pump nor a k1"
    why = _rim(rig, i, level, rig.rise(i, level, at.bounds) + _row_inflow(rig, i, rig.lowest))
    yield not why, why
    together = len(gains) > 1 and i not in rig.divided
    stoppable = not any(rig.lowest[j] > 0.0 and j not in rig.running for j in gains)
    reason = "lower limits above 0 of several pumps of one tank"
    yield not together or stoppable, f"not covered: {reason}"
    sure = not any(rig.stronger[j] for j in gains)
    yield not together or sure, f"not covered: uncertain {reason}"


def _readable(rig, i, bounds):
    """(holds, reason): the row of a tank counts on readings and bounds that hold."""
    near, unit, counts = rig.neighbours(i), rig.unit, "the filter counts on"
    for k in sorted({i} | near):
        yield (
            rig.band[k] >= rig.needed[k] * (1.0 - ROUNDING),
            f"noise band {rig.band[k]:.3g} {unit} below {SIGMAS:g} standard deviations of the"
            " noise, half an ADC step, the offset and the lower end of the span,"
            f" {rig.needed[k]:.3g} {unit}",
        )
        reason = f"above what the sensor can read, {rig.top[k]:.4g} {unit}"
        readable = bounds[k] <= rig.top[k] * (1.0 + 1e-12)
        yield readable, f"level {bounds[k]:.4g} {unit} {reason}"
    for k in sorted(near.union(*(rig.neighbours(k) for k in near))):
        reason = f"may reach {bounds[k]:.4g} {unit}, {counts} {rig.reach[k]:.4g} {unit}"
        yield rig.reach[k] >= bounds[k] * (1.0 - ROUNDING), f"{rig.label(k)} {reason}"
    for j, dead in enumerate(rig.dead):
        reason = f"may move liquid above {dead:.4g} V, {counts} {rig.offset[j]:.4g} V"
        yield rig.offset[j] <= dead * (1.0 + 1e-12), f"pump {j + 1} {reason}"
    age = float(rig.filter.age)
    reason = f"dead time {rig.delay[1]:.4g} s, {counts} {age:.4g} s"
    yield not near or age >= rig.delay[1] * (1.0 - ROUNDING), reason
    most = np.maximum(rig.high, np.where(rig.under_way > 0.0, rig.under_way, -np.inf))
    beyond = any(most[j] > rig.capped[j] for k in near for j in rig.gains[k])
    reason = "not covered: a pump of a tank beside it may run above its upper limit"
    yield age >= 1e5 or not beyond, reason


def _second_order_covered(rig, i, sources):
    """(holds, reason): tank i and those above it are of the kind of Theorem 2."""
    ring = {i, *sources}
    row = "second-order row"
    alone = not rig.gains[i] and sources
    yield alone, f"not covered: a {row} of a tank with a pump or without tanks above"
    late = rig.delay[1] > 0.0 or np.any(rig.lag[1] > 0.0)
    yield not late, f"not covered: {row}s with dead time or lag"
    yield not any(rig.pipes[k] for k in ring), f"not covered: {row}s with pipes"
    fed = any(rig.into[j] for j in sources)
    yield not fed, f"not covered: {row}s where the tanks above are fed by others"
    still = all(rig.inflow[k] <= 0.0 and rig.spare[k] <= 0.0 for k in ring)
    yield still, f"not covered: {row}s with inflow disturbances"


def _second_order(rig, i, at):
    """(holds, reason) of Theorem 2 for tank i."""
    k1, top, knee, unit = rig.slope[i], rig.limit[i], rig.knee, rig.unit
    sources = {j: most for j, (_, most) in rig.into[i].items()}
    yield from _second_order_covered(rig, i, sources)
    for j in sources:
        yield from _entering(rig, j, at)
    stop = all(rig.lowest[p] <= 0.0 for j in sources for p in rig.gains[j])
    yield stop, "not covered: second-order rows on pumps that cannot stop"
    yield _rate_of_hold(rig, i, "k2 T")
    s, a0 = (lambda h: _root(h, knee)), SHALLOW * _root(top, knee)
    flows = {j: most * s(rig.reach[j]) for j, most in sources.items()}
    full, leaves = sum(flows.values()), rig.out[i] * s(top)
    shallow = max([knee, *(rig.empty[j] for j in sources)])
    less = "where outflow is less"
    yield a0 * a0 >= shallow, f"(C3) a0^2 = {a0 * a0:.3g} {unit} below {shallow:.3g} {unit}, {less}"
    for j, most in sources.items():
        rest = leaves - (full - flows[j])
        yield rest > most * a0, f"(C3) {rest:.3g} not above {most * a0:.3g} {unit}/s"
    reason = f"(C2) k1 H = {k1 * top:.4g} below F = {full:.4g} {unit}/s"
    yield k1 * top >= full * (1.0 - ROUNDING), reason
    # the least level h* from which out s(h) + k1 (H - h) is below F up to H, H if none: it is
    # concave in h and at 0 not below F, so there is one crossing
    falling = lambda h: rig.out[i] * s(h) + k1 * (top - h)
    star = top if falling(top) >= full else _bisected(lambda h: falling(h) >= full, 0.0, top)
    drained = sum(0.5 * most * rig.out[j] for j, most in sources.items())
    steep = k1 * k1 * (top - star)
    reason = f"(C1) k1^2 (H - h*) = {steep:.4g} above D = {drained:.4g} {unit}/s^2"
    yield steep <= drained, reason
    lowest = star - rig.hold * (full + rig.out_most[i] * s(top)) - 2.0 * rig.band[i]
    reason = f"(C4) the row acts down to {lowest:.3g} {unit}, {less}"
    yield lowest >= max(knee, rig.empty[i]), reason
    steep = rig.out[i] / (2.0 * math.sqrt(lowest))
    yield k1 >= steep, f"(C4) k1 = {k1:.4g} below the slope of the outflow, {steep:.4g} 1/s"
    g = rig.out[i] * s(at.begin[i]) + k1 * (top - at.begin[i])
    g -= sum(most * max(s(at.begin[j]), a0) for j, most in sources.items())
    yield g >= -1e-12 * full, "start: the tanks above hold more than can be stopped in time"


def _bisected(below, low, high):
    """The largest number between low and high up to which below(number) is true."""
    for _ in range(200):
        mid = 0.5 * (low + high)
        low, high = (mid, high) if below(mid) else (low, mid)
    return low


def _late(rig, i, level, lag, at):
    """(holds, reason) of Theorem 3 or, with a lag [s], Theorem 4 for tank i."""
    what, kappa, pumps, unit = "dead time or lag", rig.rate[i], rig.gains[i], rig.unit
    yield not rig.pipes[i], f"not covered: a pipe with {what}"
    yield rig.spare[i] <= 0.0, f"not covered: inflow pulses with {what}"
    lags = {float(end[j]) for j in pumps for end in rig.lag}
    one_row = len(pumps) == 1 or i in rig.divided or len(lags) <= 1
    yield one_row, "not covered: pumps of one tank whose lags differ, in one row"
    empty, less = rig.empty[i], "where outflow is less"
    yield level > empty, f"limit {level:.3g} {unit} below {empty:.3g} {unit}, {less}"
    steep = rig.out[i] * _root(level, rig.knee) / (level - empty)
    reason = f"(N) kappa {kappa:.4g} below c_min s(H)/(H - empty) = {steep:.4g} 1/s"
    yield kappa >= steep * (1.0 - ROUNDING), reason
    samples = math.ceil(rig.delay[1] / rig.hold - 1e-6)
    if lag > 0.0:
        shallow = max(rig.knee, empty)
        reason = f"not covered: a limit below 4 x {shallow:.3g} {unit} with lag"
        yield shallow <= 0.25 * level, reason
        far = all(_far(rig, k) for k in rig.neighbours(i))
        yield far, "not covered: lag where the rates of other tanks bound their levels"
        sigma, bound = _sigma(kappa, lag, samples * rig.hold + rig.hold)
        yield sigma > 0.0, f"kappa {kappa:.4g} above its bound {bound:.4g} 1/s"
        filled = _row_inflow(rig, i, rig.most) + rig.rise(i, 0.0, at.bounds)
        most = 0.75 * sigma * level
        reason = f"(F) {filled:.3g} {unit}/s may enter, above 3/4 sigma H = {most:.3g}"
        yield filled <= most, reason
    else:
        bound = samples**samples / (samples + 1) ** (samples + 1)
        reason = f"kappa {kappa:.4g} above its bound {bound / rig.hold:.4g} 1/s"
        yield kappa * rig.hold <= bound * (1.0 + 1e-12), reason
    entering = _row_inflow(rig, i, rig.under_way)
    allowed = -rig.rise(i, level, at.bounds)  # by (N), at or below H
    if at.of_case:
        # concave in the level on either side of `empty`
        others = at.bounds
        if lag == 0.0:  # levels that the tanks can have until the first input of the filter ends
            most = rig.delay[1] + rig.hold
            fastest = lambda k: rig.pumped(k, rig.most) + max(rig.rise(k, 0.0, at.bounds), 0.0)
            risen = [at.begin[k] + rig.spare[k] + most * fastest(k) for k in range(rig.tanks)]
            others = np.minimum(at.bounds, risen)
        ends = {0.0, *(min(at.begin[i], h) for h in (np.nextafter(empty, 0.0), empty, level))}
        allowed = min(kappa * (level - h) - rig.rise(i, h, others) for h in ends)
    reason = f"{entering:.4g} {unit}/s under way, {max(allowed, 0.0):.4g} allowed"
    yield entering <= allowed + rig.rounding(i, level), f"(S) start: {reason}"


def _row_inflow(rig, i, inputs):
    """Largest rise rate [cm/s] by pumps at `inputs` (m) [V]; of a divided row by one share."""
    if i not in rig.divided:
        return rig.pumped(i, inputs)
    full, shares = rig.pumped(i, rig.capped), [0.0]
    for j, (_, b) in rig.gains[i].items():
        if b * max(inputs[j], 0.0) > 0.0:
            share = b * max(rig.capped[j], 0.0) / full if full > 0.0 else 0.0
            shares.append(b * inputs[j] / share if share > 0.0 else math.inf)
    return max(shares)


def _far(rig, k):
    """Whether the filter bounds the level of tank k by its `reach` alone, whatever it reads."""
    rate = rig.pumped(k, rig.capped) + max(rig.rise(k, 0.0, rig.reach), 0.0)
    return (rig.hold + float(rig.filter.age)) * rate + rig.spare[k] >= rig.reach[k]


def _sigma(kappa, lag, age):
    """(largest sigma with kappa <= r(sigma) = sigma (1 - tau sigma) e^(-sigma a), or 0; max r)."""
    rate = lambda sigma: sigma * (1.0 - lag * sigma) * math.exp(-sigma * age)
    slope = lambda sigma: (1.0 - 2.0 * lag * sigma) - age * sigma * (1.0 - lag * sigma)
    best = _bisected(lambda sigma: slope(sigma) > 0.0, 0.0, 1.0 / lag)
    if not kappa <= rate(best) * (1.0 + 1e-12):
        return 0.0, rate(best)
    return _bisected(lambda sigma: rate(sigma) >= kappa, best, 1.0 / lag), rate(best)


def _predicted(rig, i, level, at):
    """(holds, reason) of Theorem 5 for tank i."""
    other = any(rig.pipes) or np.any(rig.lag[1] > 0.0) or rig.zoned or np.any(rig.offset != 0.0)
    yield not other, "not covered: prediction with pipes, lag or a dead zone"
    yield not (np.any(rig.spare > 0.0) or rig.draws), "not covered: prediction with inflow pulses"
    reason = "not covered: prediction with uncertain limits or initial inputs of pumps"
    yield not rig.unsure, reason
    lowered = rig.faults_lower_levels or np.any(rig.bottom > 0.0)
    yield not lowered, "not covered: prediction with faults or low limits"
    dry = not rig.plant.overflow or at.bounds[i] <= rig.rim[i]
    yield dry, "not covered: prediction of a tank that overflows"
    yield _drawn(rig, i)
    apart = max(abs(d - rig.predicted * rig.hold) for d in rig.delay)
    reason = f"dead time from {rig.delay[0]:.4g} to {rig.delay[1]:.4g} s, the filter predicts"
    yield apart <= 1e-6 * rig.hold, f"{reason} {rig.predicted * rig.hold:.4g} s"
    yield _rate_of_hold(rig, i, "kappa T")
    entering, h = rig.pumped(i, rig.under_way), float(at.begin[i])
    steps = 500 * rig.predicted
    reason = f"start: inputs under way may fill it above {level:.4g} {rig.unit}"
    for _ in range(steps):  # from above: a rate falls while a level rises
        h += rig.delay[1] / steps * max(entering + rig.rise(i, h, at.bounds), 0.0)
        yield h <= level * (1.0 + ROUNDING), reason


def _drawn(rig, i):
    """(holds, reason): no more is drawn than the filter counts on."""
    reason = f"may be drawn, the filter counts on {-rig.draw[i]:.4g}"
    return rig.draw[i] <= rig.leaving[i], f"{-rig.leaving[i]:.4g} {rig.unit}^3/s {reason}"


def _joint_low(rig, start, upper):
    """[why the low limit of each tank is not proved, or ""]: the largest set kept together."""
    begin = rig.low if start is None else np.asarray(start, float)
    reasons = [""] * rig.tanks
    while True:
        proved = np.where([bool(why) for why in reasons], 0.0, np.maximum(rig.low, 0.0))
        before, reasons = reasons, list(reasons)
        for i in (i for i in range(rig.tanks) if rig.low[i] > 0.0 and not before[i]):
            reasons[i] = first_failure(_lower(rig, i, proved, begin, upper))
        if reasons == before:
            return reasons


def _lower(rig, i, proved, begin, upper):
    """(holds, reason) of a low limit while the others stay above `proved` (n,) [cm]."""
    low, gains, kappa, eps, unit = rig.low[i], rig.gains[i], rig.rate[i], rig.band[i], rig.unit
    reason = f"start at {begin[i]:.4g} {unit}, below the low limit"
    yield begin[i] >= low * (1.0 - 1e-12), reason
    reason = "not covered: a low limit with faults, or inflow pulses that draw liquid"
    yield not (rig.draws or rig.faults_lower_levels), reason
    yield _drawn(rig, i)
    full = sum(a * max(rig.weakest[j], 0.0) for j, (a, _) in gains.items())
    falling = -rig.fall(i, low, proved)
    reason = f"{falling:.4g} {unit}/s may leave at the low limit, {full:.4g} enter for certain"
    yield falling <= full * (1.0 + ROUNDING) + 1e-15, reason
    if not gains:
        return
    near = rig.neighbours(i)
    for k in sorted(near.union({i}, *(rig.neighbours(k) for k in near))):
        yield rig.bottom[k] <= proved[k], f"relies on the low limit of {rig.label(k)}, not proved"
    bounded = all(math.isfinite(upper.bounds[k]) for k in {i} | near)
    yield bounded, "not covered: a low limit where a level has no upper bound"
    yield i in rig.kept, "no row of the filter keeps it"
    late = rig.delay[1] > 0.0 or np.any(rig.lag[1] > 0.0) or rig.zoned
    yield not late, "not covered: low limits with dead time, lag or a dead zone"
    yield from _readable(rig, i, upper.bounds)
    yield _rate_of_hold(rig, i, "kappa T")
    forwards = len(gains) == 1 or all(rig.backwards[j] >= 0.0 for j in gains)
    reason = "not covered: a low limit kept by several pumps that may run backwards"
    yield forwards, reason
    edges = np.linspace(low - eps, upper.bounds[i] + eps, PARTS + 1)
    pairs = zip(edges[:-1], edges[1:])
    needs = lambda a, b: -rig.fall(i, b + eps, rig.bottom) - kappa * (a - eps - low)
    needed = np.minimum([needs(a, b) for a, b in pairs], full)
    share = min(a / b for a, b in gains.values() if b > 0.0)
    allowed = np.all(needed <= share * _caps(rig, i, edges) + 1e-12)
    yield allowed, "floor above cap: the upper limit is kept first"
    yield from _caps_of_others(rig, i, float(needed.max()))


def _caps(rig, i, edges):
    """(parts,) the least that the row of a tank allows for readings between the edges [cm/s]."""
    if i not in rig.held:
        return np.full(len(edges) - 1, np.inf)
    eps = rig.band[i]
    room = rig.rate[i] * (rig.limit[i] - edges[1:] - eps)
    return np.maximum(room - [rig.rise(i, a - eps, rig.reach) for a in edges[:-1]], 0.0)


def _caps_of_others(rig, i, needed):
    """(holds, reason): no row of another tank stops a pump on which `needed` [cm/s] relies."""
    if needed <= 0.0:
        return
    gains, stops = rig.gains[i], "may stop a pump that the floor relies on"
    fed = {k for k in range(rig.tanks) if set(rig.gains[k]) & set(gains)}
    for k in sorted((fed - {i}) & rig.held):
        edges = np.linspace(0.0, rig.limit[k] + rig.band[k], PARTS + 1)
        common = set(rig.gains[k]) & set(gains)
        total = sum(rig.gains[k][j][1] / max(gains[j][0], 1e-300) for j in common) * needed
        alone = len(gains) == len(rig.gains[k]) == 1
        yield alone and total <= _caps(rig, k, edges).min(), f"the cap for {rig.label(k)} {stops}"
    for k in sorted({k for f in fed for k in rig.below[f]} & rig.held):
        yield not rig.slope[k] > 0.0, f"the cap for {rig.label(k)} {stops}"

"""An independent check of a finished safety filter: for which tanks it keeps the limits.

Works on the final numbers alone, with formulas of its own, and knows a closed list of features:
README.md of this folder, "What the checker covers".
"""
# Every condition is tested as "not (a <= b)", so that a NaN fails it.

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.plants.faults import Faults
from jaxtank.plants.tank_network import TankNetwork

ANY, OWN = "any at or below the limits", "the given start"
"""Hypotheses on the start."""
SIGMAS = 5.0
"""Standard deviations of the noise that a band must have at least."""
SHALLOW = 0.05
"""a0 of Theorem 2 as a share of the root of the limit."""
PARTS = 1000
"""Intervals of readings on which floors and caps are compared."""
ROUNDING = 1e-9

FLOWS = ("area", "drain", "orifice", "pipe", "pump_gain", "split", "gravity")
SHAPE = ("links", "pipes", "feeds", "spills", "overflow", "bottom", "knee")
KNOWN = {
    "plant": {*FLOWS, *SHAPE, "rim", "caught", "outputs", "units"},
    "actuator": {"low", "high", "dead_zone", "stop", "pulse", "lag", "initial", "delay"}
    | {"saturation", "dead_zone_kind"},
    "sensor": {"gain", "noise", "offset", "full_scale", "bits"},
    "faults": {"factor", "extra", "windows"},
    "safety_filter": {"least", "most", "limit", "reach", "rate", "band", "inflow", "slope"}
    | {"spare", "age", "offset", "low", "bottom", "draw", "held", "kept", "predicted", "substeps"}
    | {"allocate", "divided", "running"},
}
"""{part: fields that the checker knows}; a field that is not listed must be None, False or ()."""
CLASSES = {"plant": TankNetwork, "actuator": PumpBank, "sensor": LevelSensor, "faults": Faults}
UNCERTAIN = {
    *(f"plant.{name}" for name in (*FLOWS, "rim", "caught")),
    *(f"actuator.{name}" for name in ("low", "high", "dead_zone", "stop", "pulse", "lag")),
    *("actuator.initial", "actuator.delay", "x0"),
    *("sensor.noise", "sensor.offset", "sensor.gain", "sensor.full_scale"),
}
HARMLESS = ("controller.", "observer.", "reference.")
"""Uncertain parameters of what may be anything: beginnings of their names."""


class Verdict(NamedTuple):
    """Whether the limits of one tank are proved on every plant of the box, and the reason."""

    # tank : counted from 0. holds, low_holds : of the upper and the low limit. reason, low_reason :
    # the theorem, the condition that fails with both numbers, or "not covered: FEATURE". starts :
    # ANY or OWN, the levels at t = 0 for which it holds.

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
    drawn: bool = False,
    start: Any = None,
    faults: Any = None,
    limits: Any = None,
) -> tuple[Verdict, ...]:
    """Return the Verdict of each tank."""
    parts = {"plant": plant, "actuator": actuator, "sensor": sensor, "safety_filter": safety_filter}
    parts |= {} if faults is None else {"faults": faults}
    tanks = len(np.atleast_1d(safety_filter.limit))
    if missing := _not_known(parts, box):
        return _none(tanks, missing)
    rig = _Rig(safety_filter, plant, actuator, sensor, hold, substeps, box, faults)
    rig.disturbed(inflow, volume, drawn)
    least = start
    if start is not None and "x0" in box:
        least, start = (np.asarray(v, dtype=float) for v in box["x0"])
    claimed = rig.limit + rig.spare if limits is None else np.asarray(limits, float)
    if why := rig.uncovered():
        return _none(tanks, why)
    from_any = _joint(rig, None, claimed)
    found = from_any if start is None else _joint(rig, np.asarray(start, float), claimed)
    lows = _joint_low(rig, least, found)
    return tuple(
        Verdict(
            tank=i,
            holds=not found.reasons[i],
            reason=found.reasons[i] or found.theorems[i],
            starts=OWN if from_any.reasons[i] else ANY,
            low_holds=bool(rig.low[i] > 0.0 and not lows[i]),
            low_reason=lows[i] or ("Low limits" if rig.low[i] > 0.0 else ""),
        )
        for i in range(tanks)
    )


def _none(tanks, why):
    """Verdicts of a rig on which nothing is proved."""
    return tuple(Verdict(i, False, why, OWN, False, why) for i in range(tanks))


def _not_known(parts, box):
    """The first feature that is not on the closed list, or a number that is none; or ""."""
    for part, value in parts.items():
        kind = CLASSES.get(part)
        if kind is not None and type(value) is not kind:
            return f"not covered: {part} of class {type(value).__name__}"
    guard = parts["safety_filter"]
    if (type(guard).__module__, type(guard).__name__) != ("jaxtank.safety.filter", "SafetyFilter"):
        return f"not covered: safety filter of class {type(guard).__name__}"
    inner = {"safety_filter.least": guard.least, "safety_filter.most": guard.most}
    for part, value in {**parts, **inner}.items():
        if part in inner and type(value) is not TankNetwork:
            return f"not covered: {part} of class {type(value).__name__}"
        known = KNOWN["plant" if part in inner else part]
        for field in dataclasses.fields(value):
            entry = getattr(value, field.name)
            if field.name not in known and not _neutral(entry):
                return f"not covered: {part}.{field.name}"
            if field.name in known and _has_nan(entry):
                return f"not covered: {part}.{field.name} is no number"
    for name, ends in box.items():
        base = name.partition("[")[0]
        if base not in UNCERTAIN and not name.startswith(HARMLESS):
            return f"not covered: uncertain {name}"
        if any(_has_nan(end) for end in ends):
            return f"not covered: uncertain {name} is no number"
    return ""


def _neutral(entry):
    return entry is None or entry is False or (isinstance(entry, tuple) and not entry)


def _has_nan(entry):
    if entry is None or isinstance(entry, tuple):  # left out; pairs of tanks
        return False
    try:
        return bool(np.isnan(np.asarray(entry, dtype=float)).any())
    except (TypeError, ValueError):  # names, another component
        return False


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

    def __init__(self, guard, plant, actuator, sensor, hold, substeps, box, faults):
        self.guard, self.plant, self.hold = guard, plant, float(hold)
        n = self.tanks = len(np.atleast_1d(plant.rim))
        full = lambda v, size=n: np.broadcast_to(np.asarray(v, dtype=float), (size,))
        self.limit, self.reach, self.spare = map(full, (guard.limit, guard.reach, guard.spare))
        self.rate, self.slope, self.band = map(full, (guard.rate, guard.slope, guard.band))
        self.low, self.bottom = full(guard.low), full(guard.bottom)
        self.held, self.kept = set(guard.held), set(guard.kept)
        self.divided, self.running = (set(getattr(guard, k, ())) for k in ("divided", "running"))
        self.predicted = int(guard.predicted)
        self.box, self.faults = dict(box), faults
        self.rim, self.highest_rim = (full(v) for v in self.span("plant.rim", plant.rim))
        self.caught = self.span("plant.caught", plant.caught)[1]
        self._coefficients(guard.least, guard.most, hold / substeps)
        self._pumps(actuator, full)
        self._readings(sensor, full)

    def span(self, name, value):
        """(lower, upper) of a leaf over the box."""
        value = np.asarray(0.0 if value is None else value, dtype=float)
        low, high = value.copy(), value.copy()
        for other, (lower, upper) in self.box.items():
            base, _, entry = other.partition("[")
            if base == name:
                at = int(entry.rstrip("]")) if entry else ...
                low[at], high[at] = (
                    np.minimum(low[at], np.asarray(lower, float)),
                    np.maximum(high[at], np.asarray(upper, float)),
                )
        return low, high

    def _coefficients(self, least, most, step):
        plant, n = self.plant, self.tanks
        slow, fast = math.sqrt(2.0 * float(least.gravity)), math.sqrt(2.0 * float(most.gravity))
        small, large = np.asarray(least.area, float), np.asarray(most.area, float)
        self.area = small
        self.knee = float(plant.knee)
        free = [np.array(p.drain, dtype=float) for p in (least, most)]
        self.into = [[] for _ in range(n)]  # (source, least, largest) of each tank
        self.below = [set() for _ in range(n)]
        self.pipes = [[] for _ in range(n)]  # (other, least, largest)
        for k, (i, j) in enumerate(plant.links):
            free[0][i] += least.orifice[k]
            free[1][i] += most.orifice[k]
            ends = slow * least.orifice[k] / large[j], fast * most.orifice[k] / small[j]
            self.into[j].append((i, *map(float, ends)))
            self.below[i].add(j)
        everything = free[1].copy()
        for k, (i, j) in enumerate(plant.pipes):
            for one, other in ((i, j), (j, i)):
                everything[one] += most.pipe[k]
                ends = slow * least.pipe[k] / large[one], fast * most.pipe[k] / small[one]
                self.pipes[one].append((other, *map(float, ends)))
        self.out, self.out_most = slow * free[0] / large, fast * free[1] / small
        # with `bottom` a tank gives less than its outlets would below this level
        self.empty = (step * fast * everything / small) ** 2 if plant.bottom else np.zeros(n)
        self.gains = [{} for _ in range(n)]  # {pump: (least, largest)}
        for j, (first, second) in enumerate(plant.feeds):
            shares = [(first, 1.0, 1.0)]
            if second is not None:
                a, b = float(least.split[j]), float(most.split[j])
                shares = [(first, a, b), (second, 1.0 - b, 1.0 - a)]
            for i, a, b in shares:
                before = self.gains[i].get(j, (0.0, 0.0))
                self.gains[i][j] = (
                    before[0] + float(least.pump_gain[j]) * a / large[i],
                    before[1] + float(most.pump_gain[j]) * b / small[i],
                )

    def _pumps(self, bank, full):
        m = len(self.plant.feeds)
        self.lag = tuple(full(v, m) for v in self.span("actuator.lag", bank.lag))
        self.delay = tuple(float(v) for v in self.span("actuator.delay", bank.delay))
        self.pulsed = bank.dead_zone is not None and bank.dead_zone_kind == "pulse"
        self.zoned = bank.dead_zone is not None
        dead = self.span("actuator.dead_zone", bank.dead_zone)[0]
        self.dead = full(dead if self.zoned and bank.dead_zone_kind == "offset" else 0.0, m)
        span = lambda name: tuple(
            full(v, m) for v in self.span(f"actuator.{name}", getattr(bank, name))
        )
        # inputs as the filter counts them, less its offset
        self.offset, (self.backwards, self.lowest) = full(self.guard.offset, m), span("low")
        self.weakest, self.high = (v - self.offset for v in span("high"))
        self.capped = full(bank.high, m) - self.offset
        # pumps whose lower limit, or input before the start, may be above what the filter counts on
        self.stronger = self.lowest > np.maximum(full(bank.low, m), 0.0)
        self.unsure = any(
            np.any(self.span(f"actuator.{name}", getattr(bank, name))[end] != getattr(bank, name))
            for name in ("low", "high", "initial")
            for end in (0, 1)
        )
        self.under_way = np.zeros(m)
        if self.delay[1] > 0.0 or np.any(self.lag[1] > 0.0):
            self.under_way = np.maximum(span("initial")[1] - self.offset, 0.0)
        self.most = np.maximum(np.maximum(self.high, self.under_way), 0.0)
        if self.pulsed:
            self.most = np.maximum(self.most, span("pulse")[1])

    def _readings(self, sensor, full):
        off = [np.abs(v) for v in self.span("sensor.offset", sensor.offset)]
        self.needed = full(SIGMAS * self.span("sensor.noise", sensor.noise)[1])
        self.needed = self.needed + np.maximum(*off)
        self.top = np.full(self.tanks, np.inf)
        if sensor.bits:
            gain, scale = (
                self.span(f"sensor.{k}", getattr(sensor, k)) for k in ("gain", "full_scale")
            )
            self.needed = self.needed + 0.5 * full(gain[1]) * scale[1] / 2**sensor.bits
            self.top = full(gain[0]) * scale[0]

    def disturbed(self, inflow, volume, drawn):
        """Take the inflow disturbances of the case."""
        full = lambda v: np.broadcast_to(np.asarray(v, dtype=float), (self.tanks,))
        self.entering, self.leaving = full(inflow[1]), full(inflow[0])
        self.volume, self.drawn = full(volume), bool(drawn)
        self.inflow, self.draw = (full(getattr(self.guard, k)) for k in ("inflow", "draw"))

    def brought(self, tank, inputs):
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
        for source, _, most in self.into[tank]:
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
        for source, least, _ in self.into[tank]:
            if others[source] >= self.empty[source]:
                rate += least * _root(others[source], self.knee)
        return float(rate)

    def neighbours(self, tank):
        """Tanks on whose levels the rate of this one depends."""
        return {k for k, *_ in self.into[tank]} | {k for k, *_ in self.pipes[tank]}

    def uncovered(self):
        """What the filter does not count on, of the whole rig; or ""."""
        guard, plant = self.guard, self.plant
        for name in SHAPE:
            if any(getattr(end, name) != getattr(plant, name) for end in (guard.least, guard.most)):
                return f"not covered: plant.{name} differs from that of the safety filter"
        ends = {name: self.span(f"plant.{name}", getattr(plant, name)) for name in FLOWS}
        self.faults_lower_levels = False  # outside the box, but only lowering levels
        if why := self._outside(ends, ""):
            return why
        if self.faults is not None and (why := self._faulty(ends)):
            return why
        return ""

    def _faulty(self, ends):
        """Why the faults of a case leave the box, or ""; `ends` : {leaf: (lower, upper)}."""
        entries = zip(self.faults.windows, self.faults.factor, self.faults.extra)
        counted = {name: (low.copy(), high.copy()) for name, (low, high) in ends.items()}
        for (name, *_), factor, extra in entries:
            field, _, entry = name.partition("[")
            if field not in ends:
                return f"not covered: fault of plant.{name}"
            at = int(entry.rstrip("]")) if entry else ...
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
            if why := self._outside(counted, "fault of "):
                return why
        return ""

    def _outside(self, ends, what):
        """The first coefficient outside the filter's box, or ""."""
        for name, (low, high) in ends.items():
            least, most = (np.asarray(getattr(p, name), float) for p in _ends(self.guard))
            low, high = np.broadcast_to(low, least.shape), np.broadcast_to(high, most.shape)
            slack = 1e-12 * np.maximum(np.abs(low), np.abs(high))
            bad = ~((least <= low + slack) & (most >= high - slack))
            if name == "split":  # a share above 1 is none
                bad = ~((least <= low + slack) & (most >= np.minimum(high, 1.0) - slack))
            if bad.any():
                at = np.argwhere(bad)[0]
                place = f"[{at[0]}]" if len(at) else ""
                a, b, c, d = (float(v[tuple(at)]) for v in (low, high, least, most))
                return (
                    f"not covered: {what}plant.{name}{place} from {a:.4g} to {b:.4g}, the filter"
                    f" counts on {c:.4g} to {d:.4g}"
                )
        return ""


def _ends(guard):
    return guard.least, guard.most


class _Hypotheses(NamedTuple):
    """Assumptions on all tanks (n,): upper bounds of the levels [cm], whether a tank never
    overflows, largest levels at t = 0 [cm]; and whether these are the case's start.
    """

    bounds: np.ndarray
    dry: np.ndarray
    begin: np.ndarray
    own: bool


class _JointResult(NamedTuple):
    """Of each tank: the condition that fails, or ""; the theorem; the bound of its level [cm]."""

    reasons: list[str]
    theorems: list[str]
    bounds: np.ndarray


def _joint(rig, start, claimed):
    """The largest set of tanks whose limits are kept together, from `start` or (None) from any
    levels at or below the claimed limits (n,) [cm].
    """
    n, alone = rig.tanks, None
    level = np.array(rig.limit)  # before volumes that enter besides
    if start is None:
        free = [i for i in range(n) if i not in rig.held]
        level[free] = (claimed - rig.spare)[free]
    begin = claimed if start is None else start
    inside, bounded = set(range(n)), set(range(n))
    dry = np.ones(n, dtype=bool)
    while True:
        bounds = np.full(n, np.inf)
        for i in range(n):
            if i in inside:
                bounds[i] = level[i] + rig.spare[i]
            elif i in bounded:
                bounds[i] = rig.reach[i]
        at = _Hypotheses(
            bounds, dry & (bounds <= rig.rim * (1.0 + 1e-12)), begin, start is not None
        )
        found = [_upper(rig, i, level[i], at) for i in range(n)]
        alone = found if alone is None else alone
        outside = {i for i in inside if found[i][0]}
        stays = {i: _stays(rig, i, at) for i in bounded - inside}
        loose = {i for i, how in stays.items() if not how}
        wet = {i for i in range(n) if dry[i] and (i in loose or stays.get(i) == "rim")}
        if not (outside or loose or wet):
            break
        inside, bounded, dry = inside - outside, bounded - loose, dry.copy()
        dry[list(wet)] = False
    reasons = [found[i][0] if i not in inside else "" for i in range(n)]
    for i in (i for i in range(n) if reasons[i] and not alone[i][0]):
        lost = sorted(k for k in range(n) if k not in inside and k != i)
        near = [k for k in lost if k in rig.neighbours(i)] or lost
        reasons[i] = f"relies on tank {', '.join(str(k + 1) for k in near)}, not proved"
    reasons = [alone[i][0] or reasons[i] for i in range(n)]
    return _JointResult(reasons, [theorem for _, theorem in found], bounds)


def _stays(rig, i, at):
    """What keeps the level of a tank below its `reach`, whatever its pumps do: "flows", or the
    "rim" over which the rest overflows; or "".
    """
    top = rig.reach[i] - rig.spare[i]
    if not (at.begin[i] <= top * (1.0 + 1e-12) and math.isfinite(top) and top > 0.0):
        return ""
    if _spilled(rig, i, at):
        return ""
    if rig.rise(i, top, at.bounds) + rig.brought(i, rig.most) <= _rounding(rig, i, top):
        return "flows"
    return "rim" if rig.plant.overflow and rig.reach[i] >= rig.highest_rim[i] else ""


def _rounding(rig, i, level):
    return ROUNDING * max(rig.out[i] * _root(level, rig.knee), 1e-9)


def _spilled(rig, i, at):
    """Why more may enter than the filter counts on, overflow of other tanks included, or ""."""
    entering = rig.entering[i]
    if rig.plant.overflow:
        for (a, b), share in zip(rig.plant.spills, rig.caught):
            if b == i and not at.dry[a]:
                if _ringed(rig.plant.spills, i):
                    return "not covered: a ring of tanks that overflow into each other"
                if not at.begin[a] + rig.spare[a] <= rig.rim[a] * (1.0 + 1e-12):
                    return f"not covered: volumes that overflow at once from tank {a + 1}"
                if why := _spilled(rig, a, at):
                    return why
                over = rig.rise(a, rig.rim[a], at.bounds) + rig.brought(a, rig.most)
                entering += share * max(over, 0.0) * float(np.asarray(rig.guard.most.area)[a])
    if not entering <= rig.inflow[i] * (1.0 + ROUNDING):
        return f"{entering:.4g} cm^3/s may enter, the filter counts on {rig.inflow[i]:.4g}"
    risen = rig.volume[i] / rig.area[i]
    if not risen <= rig.spare[i] * (1.0 + ROUNDING):
        return f"inflow pulses raise it by {risen:.4g} cm, the filter counts on {rig.spare[i]:.4g}"
    return ""


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
    """(why the limit of a tank is not proved with the others at their bounds, or ""; the
    theorem).
    """
    bounds = at.bounds
    if not at.begin[i] <= level * (1.0 + 1e-12):
        return f"start at {at.begin[i]:.4g} cm, above the limit {level:.4g} cm", ""
    if why := _spilled(rig, i, at):
        return why, ""
    if not all(math.isfinite(bounds[k]) for k in rig.neighbours(i)):
        return "a tank beside it has no bound", ""
    if i not in rig.held:
        return _unheld(rig, i, level, bounds)
    if why := _readable(rig, i, bounds):
        return why, ""
    if rig.pulsed:
        return "not covered: a pulse dead zone pays out more than was commanded", ""
    if rig.slope[i] > 0.0:
        return _second_order(rig, i, at), "Theorem 2"
    if not rig.gains[i]:
        return "no row: it has neither a pump nor a k1", ""
    entering = rig.rise(i, level, bounds) + _row_inflow(rig, i, rig.lowest)
    if not entering <= _rounding(rig, i, level):
        return _rim(rig, i, level, entering), ""
    together = len(rig.gains[i]) > 1 and i not in rig.divided
    if together and any(rig.lowest[j] > 0.0 and j not in rig.running for j in rig.gains[i]):
        return "not covered: lower limits above 0 of several pumps of one tank", ""
    if together and any(rig.stronger[j] for j in rig.gains[i]):
        return "not covered: uncertain lower limits above 0 of several pumps of one tank", ""
    lag = max(rig.lag[1][j] for j in rig.gains[i])
    if rig.delay[1] == 0.0 and lag == 0.0:
        if not rig.rate[i] * rig.hold <= 1.0 + 1e-12:
            return f"kappa T = {rig.rate[i] * rig.hold:.3g} above 1", ""
        return "", "Theorem 1"
    if rig.predicted:
        return _predicted(rig, i, level, at), "Theorem 5"
    return _late(rig, i, level, lag, at), "Theorem 4" if lag > 0.0 else "Theorem 3"


def _rim(rig, i, level, entering):
    leaves = rig.out[i] * _root(level, rig.knee)
    return (
        f"rim condition: {entering + leaves:.4g} cm/s may enter at the limit, {leaves:.4g} leave"
        " for certain"
    )


def _unheld(rig, i, level, bounds):
    """Of a tank without a row: with pumps at full it cannot rise at its limit."""
    entering = rig.rise(i, level, bounds) + rig.brought(i, rig.most)
    if not entering <= _rounding(rig, i, level):
        return _rim(rig, i, level, entering), ""
    if rig.gains[i]:
        return "", "full pumps stay below"
    return "", "no pump, and its inflow cannot pass the limit"


def _readable(rig, i, bounds):
    """Why the row of a tank may count on readings or bounds that do not hold, or ""."""
    near = rig.neighbours(i)
    for k in sorted({i} | near):
        if not rig.band[k] >= rig.needed[k] * (1.0 - ROUNDING):
            return (
                f"noise band {rig.band[k]:.3g} cm below {SIGMAS:g} standard deviations of the"
                f" noise, half an ADC step and the offset, {rig.needed[k]:.3g} cm"
            )
        if not bounds[k] <= rig.top[k] * (1.0 + 1e-12):
            return f"level {bounds[k]:.4g} cm above what the sensor can read, {rig.top[k]:.4g} cm"
    for k in sorted(near.union(*(rig.neighbours(k) for k in near))):
        if not rig.reach[k] >= bounds[k] * (1.0 - ROUNDING):
            return (
                f"tank {k + 1} may reach {bounds[k]:.4g} cm, the filter counts on"
                f" {rig.reach[k]:.4g} cm"
            )
    for j in range(len(rig.dead)):
        if not rig.offset[j] <= rig.dead[j] * (1.0 + 1e-12):
            return (
                f"pump {j + 1} may move liquid above {rig.dead[j]:.4g} V, the filter counts on"
                f" {rig.offset[j]:.4g} V"
            )
    if near and not float(rig.guard.age) >= rig.delay[1] * (1.0 - ROUNDING):
        return f"dead time {rig.delay[1]:.4g} s, the filter counts on {float(rig.guard.age):.4g} s"
    if float(rig.guard.age) < 1e5 and any(
        rig.under_way[j] > max(rig.capped[j], 0.0) or rig.high[j] > rig.capped[j]
        for k in near
        for j in rig.gains[k]
    ):
        return "not covered: a pump of a tank beside it may run above its upper limit"
    return ""


def _second_order(rig, i, at):
    """Why Theorem 2 does not hold for tank i, or ""."""
    k1, top, knee, sources = rig.slope[i], rig.limit[i], rig.knee, rig.into[i]
    ring = {i} | {j for j, *_ in sources}
    if rig.gains[i] or not sources:
        return "not covered: a second-order row of a tank with a pump or without tanks above"
    if rig.delay[1] > 0.0 or np.any(rig.lag[1] > 0.0):
        return "not covered: second-order rows with dead time or lag"
    if any(rig.pipes[k] for k in ring):
        return "not covered: second-order rows with pipes"
    if any(rig.into[j] for j, *_ in sources):
        return "not covered: second-order rows where the tanks above are fed by others"
    if any(rig.inflow[k] > 0.0 or rig.spare[k] > 0.0 for k in ring):
        return "not covered: second-order rows with inflow disturbances"
    if why := next((why for j, *_ in sources if (why := _spilled(rig, j, at))), ""):
        return why
    pumps = {p for j, *_ in sources for p in rig.gains[j]}
    if any(rig.lowest[p] > 0.0 for p in pumps):
        return "not covered: second-order rows on pumps that cannot stop"
    if not rig.rate[i] * rig.hold <= 1.0 + 1e-12:
        return f"k2 T = {rig.rate[i] * rig.hold:.3g} above 1"
    s, a0 = (lambda h: _root(h, knee)), SHALLOW * _root(top, knee)
    flows = {j: most * s(rig.reach[j]) for j, _, most in sources}
    full, leaves = sum(flows.values()), rig.out[i] * s(top)
    shallow = max([knee, *(rig.empty[j] for j, *_ in sources)])
    if not a0 * a0 >= shallow:
        return f"(C3) a0^2 = {a0 * a0:.3g} cm below {shallow:.3g} cm, where outflow is less"
    for j, _, most in sources:
        if not leaves - (full - flows[j]) > most * a0:
            return f"(C3) {leaves - full + flows[j]:.3g} not above {most * a0:.3g} cm/s"
    if not k1 * top >= full * (1.0 - ROUNDING):
        return f"(C2) k1 H = {k1 * top:.4g} below F = {full:.4g} cm/s"
    star, drained = _falling(rig.out[i], k1, top, full, knee), 0.0
    drained = sum(0.5 * most * rig.out[j] for j, _, most in sources)
    if not k1 * k1 * (top - star) <= drained:
        return f"(C1) k1^2 (H - h*) = {k1 * k1 * (top - star):.4g} above D = {drained:.4g} cm/s^2"
    lowest = star - rig.hold * (full + rig.out_most[i] * s(top)) - 2.0 * rig.band[i]
    if not lowest >= max(knee, rig.empty[i]):
        return f"(C4) the row acts down to {lowest:.3g} cm, where outflow is less"
    steep = rig.out[i] / (2.0 * math.sqrt(lowest))
    if not k1 >= steep:
        return f"(C4) k1 = {k1:.4g} below the slope of the outflow, {steep:.4g} 1/s"
    g = rig.out[i] * s(at.begin[i]) + k1 * (top - at.begin[i])
    g -= sum(most * max(s(at.begin[j]), a0) for j, _, most in sources)
    if not g >= -1e-12 * full:
        return "start: the tanks above hold more than can be stopped in time"
    return ""


def _falling(out, k1, top, full, knee):
    """The least level h* [cm] from which out s(h) + k1 (H - h) is below F up to H, H if none."""
    f = lambda h: out * _root(h, knee) + k1 * (top - h)
    if f(top) >= full:
        return top
    # f is concave and f(0) >= F: one crossing
    low, high = 0.0, top
    for _ in range(200):
        mid = 0.5 * (low + high)
        low, high = (mid, high) if f(mid) >= full else (low, mid)
    return low


def _late(rig, i, level, lag, at):
    """Why Theorem 3 or, with a lag [s], Theorem 4 does not hold for tank i, or ""."""
    what, kappa, pumps = "dead time or lag", rig.rate[i], rig.gains[i]
    if rig.pipes[i]:
        return f"not covered: a pipe with {what}"
    if rig.spare[i] > 0.0:
        return f"not covered: inflow pulses with {what}"
    low, high = rig.lag[0], rig.lag[1]
    if len(pumps) > 1 and i not in rig.divided:
        ends = {float(v) for j in pumps for v in (low[j], high[j])}
        if len(ends) > 1:
            return "not covered: pumps of one tank whose lags differ, in one row"
    empty = rig.empty[i]
    if not level > empty:
        return f"limit {level:.3g} cm below {empty:.3g} cm, where outflow is less"
    steep = rig.out[i] * _root(level, rig.knee) / (level - empty)
    if not kappa >= steep * (1.0 - ROUNDING):
        return f"(N) kappa {kappa:.4g} below c_min s(H)/(H - empty) = {steep:.4g} 1/s"
    samples = math.ceil(rig.delay[1] / rig.hold - 1e-6)
    age = samples * rig.hold + rig.hold
    if lag > 0.0:
        if not max(rig.knee, empty) <= 0.25 * level:
            return f"not covered: a limit below 4 x {max(rig.knee, empty):.3g} cm with lag"
        far = [k for k in rig.neighbours(i) if not _far(rig, k)]
        if far:
            return "not covered: lag where the rates of other tanks bound their levels"
        sigma = _sigma(kappa, lag, age)
        if not sigma > 0.0:
            return f"kappa {kappa:.4g} above its bound {_rate(_best(lag, age), lag, age):.4g} 1/s"
        filled = _row_inflow(rig, i, rig.most) + rig.rise(i, 0.0, at.bounds)
        if not filled <= 0.75 * sigma * level:
            return (
                f"(F) {filled:.3g} cm/s may enter, above 3/4 sigma H = {0.75 * sigma * level:.3g}"
            )
    else:
        bound = samples**samples / (samples + 1) ** (samples + 1)
        if not kappa * rig.hold <= bound * (1.0 + 1e-12):
            return f"kappa {kappa:.4g} above its bound {bound / rig.hold:.4g} 1/s"
    brought = _row_inflow(rig, i, rig.under_way)
    allowed = -rig.rise(i, level, at.bounds)  # by (N), at or below H
    if at.own:
        # concave in the level on either side of `empty`
        others = at.bounds if lag > 0.0 else _soon(rig, at)
        ends = {0.0, *(min(at.begin[i], h) for h in (np.nextafter(empty, 0.0), empty, level))}
        allowed = min(kappa * (level - h) - rig.rise(i, h, others) for h in ends)
    if not brought <= allowed + _rounding(rig, i, level):
        return f"(S) start: {brought:.4g} cm/s under way, {max(allowed, 0.0):.4g} allowed"
    return ""


def _row_inflow(rig, i, inputs):
    """Largest rise rate [cm/s] by pumps at `inputs` (m) [V]; for a divided row, that of all pumps
    if each used the same part of its share as the pump that uses the largest part.
    """
    if i not in rig.divided:
        return rig.brought(i, inputs)
    full, shares = rig.brought(i, rig.capped), [0.0]
    for j, (_, b) in rig.gains[i].items():
        if b * max(inputs[j], 0.0) > 0.0:
            share = b * max(rig.capped[j], 0.0) / full if full > 0.0 else 0.0
            shares.append(b * inputs[j] / share if share > 0.0 else math.inf)
    return max(shares)


def _soon(rig, at):
    """(n,) levels [cm] that the tanks can have until the first input of the filter ends."""
    age = rig.delay[1] + rig.hold
    risen = [
        at.begin[k]
        + rig.spare[k]
        + age * (rig.brought(k, rig.most) + max(rig.rise(k, 0.0, at.bounds), 0.0))
        for k in range(rig.tanks)
    ]
    return np.minimum(at.bounds, risen)


def _far(rig, k):
    """Whether the filter bounds the level of tank k by its `reach` alone, whatever it reads."""
    rate = rig.brought(k, rig.capped) + max(rig.rise(k, 0.0, rig.reach), 0.0)
    return (rig.hold + float(rig.guard.age)) * rate + rig.spare[k] >= rig.reach[k]


def _rate(sigma, lag, age):
    return sigma * (1.0 - lag * sigma) * math.exp(-sigma * age)


def _best(lag, age):
    """The sigma that allows the largest kappa: where the slope of `_rate` is 0."""
    low, high = 0.0, 1.0 / lag
    for _ in range(200):
        mid = 0.5 * (low + high)
        rising = (1.0 - 2.0 * lag * mid) - age * mid * (1.0 - lag * mid) > 0.0
        low, high = (mid, high) if rising else (low, mid)
    return low


def _sigma(kappa, lag, age):
    """The largest sigma [1/s] with kappa <= sigma (1 - tau sigma) e^(-sigma a), 0 if none."""
    low, high = _best(lag, age), 1.0 / lag
    if not kappa <= _rate(low, lag, age) * (1.0 + 1e-12):
        return 0.0
    for _ in range(200):
        mid = 0.5 * (low + high)
        low, high = (mid, high) if _rate(mid, lag, age) >= kappa else (low, mid)
    return low


def _predicted(rig, i, level, at):
    """Why Theorem 5 does not hold for tank i, or ""."""
    if any(rig.pipes) or np.any(rig.lag[1] > 0.0) or rig.zoned or np.any(rig.offset != 0.0):
        return "not covered: prediction with pipes, lag or a dead zone"
    if np.any(rig.spare > 0.0) or rig.drawn:
        return "not covered: prediction with inflow pulses"
    if rig.unsure:
        return "not covered: prediction with uncertain limits or initial inputs of pumps"
    if rig.faults_lower_levels or np.any(rig.bottom > 0.0):
        return "not covered: prediction with faults or low limits"
    if rig.plant.overflow and not at.bounds[i] <= rig.rim[i]:
        return "not covered: prediction of a tank that overflows"
    if not rig.draw[i] <= rig.leaving[i]:
        return f"{-rig.leaving[i]:.4g} cm^3/s may be drawn, the filter counts on {-rig.draw[i]:.4g}"
    if not max(abs(d - rig.predicted * rig.hold) for d in rig.delay) <= 1e-6 * rig.hold:
        return (
            f"dead time from {rig.delay[0]:.4g} to {rig.delay[1]:.4g} s, the filter predicts"
            f" {rig.predicted * rig.hold:.4g} s"
        )
    if not rig.rate[i] * rig.hold <= 1.0 + 1e-12:
        return f"kappa T = {rig.rate[i] * rig.hold:.3g} above 1"
    brought, h = rig.brought(i, rig.under_way), float(at.begin[i])
    steps = 500 * rig.predicted
    for _ in range(steps):  # from above: a rate falls while a level rises
        h += rig.delay[1] / steps * max(brought + rig.rise(i, h, at.bounds), 0.0)
        if not h <= level * (1.0 + ROUNDING):
            return f"start: inputs under way may fill it above {level:.4g} cm"
    return ""


def _joint_low(rig, start, upper):
    """[why the low limit of each tank is not proved, or ""]: the largest set kept together."""
    n = rig.tanks
    begin = rig.low if start is None else np.asarray(start, float)
    reasons = [""] * n
    while True:
        proved = [rig.low[i] if rig.low[i] > 0.0 and not reasons[i] else 0.0 for i in range(n)]
        after = [
            reasons[i] or (_lower(rig, i, proved, begin, upper) if rig.low[i] > 0.0 else "")
            for i in range(n)
        ]
        if after == reasons:
            return reasons
        reasons = after


def _lower(rig, i, proved, begin, upper):
    """Why the low limit of a tank is not kept while the others stay above `proved` (n,) [cm]."""
    low, gains, kappa, eps = rig.low[i], rig.gains[i], rig.rate[i], rig.band[i]
    if not begin[i] >= low * (1.0 - 1e-12):
        return f"start at {begin[i]:.4g} cm, below the low limit"
    if rig.drawn or rig.faults_lower_levels:
        return "not covered: a low limit with faults, or inflow pulses that draw liquid"
    if not rig.draw[i] <= rig.leaving[i]:
        return f"{-rig.leaving[i]:.4g} cm^3/s may be drawn, the filter counts on {-rig.draw[i]:.4g}"
    full = sum(a * max(rig.weakest[j], 0.0) for j, (a, _) in gains.items())
    falling = -rig.fall(i, low, proved)
    if not falling <= full * (1.0 + ROUNDING) + 1e-15:
        return f"{falling:.4g} cm/s may leave at the low limit, {full:.4g} enter for certain"
    if not gains:
        return ""
    near = rig.neighbours(i)
    for k in sorted(near.union({i}, *(rig.neighbours(k) for k in near))):
        if not rig.bottom[k] <= proved[k]:
            return f"relies on the low limit of tank {k + 1}, not proved"
    if not all(math.isfinite(upper.bounds[k]) for k in {i} | near):
        return "not covered: a low limit where a level has no upper bound"
    if i not in rig.kept:
        return "no row of the filter keeps it"
    if rig.delay[1] > 0.0 or np.any(rig.lag[1] > 0.0) or rig.zoned:
        return "not covered: low limits with dead time, lag or a dead zone"
    if why := _readable(rig, i, upper.bounds):
        return why
    if not kappa * rig.hold <= 1.0 + 1e-12:
        return f"kappa T = {kappa * rig.hold:.3g} above 1"
    if len(gains) > 1 and any(rig.backwards[j] < 0.0 for j in gains):
        return "not covered: a low limit kept by several pumps that may run backwards"
    edges = np.linspace(low - eps, upper.bounds[i] + eps, PARTS + 1)
    asked = [
        -rig.fall(i, b + eps, rig.bottom) - kappa * (a - eps - low)
        for a, b in zip(edges[:-1], edges[1:])
    ]
    asked = np.minimum(asked, full)
    share = min(a / b for a, b in gains.values() if b > 0.0)
    if np.any(~(asked <= share * _caps(rig, i, edges) + 1e-12)):
        return "floor above cap: the upper limit is kept first"
    return _other_caps(rig, i, float(asked.max()))


def _caps(rig, i, edges):
    """(parts,) the least that the row of a tank allows for readings between the edges [cm/s]."""
    if i not in rig.held:
        return np.full(len(edges) - 1, np.inf)
    eps = rig.band[i]
    allowed = [
        rig.rate[i] * (rig.limit[i] - b - eps) - rig.rise(i, a - eps, rig.reach)
        for a, b in zip(edges[:-1], edges[1:])
    ]
    return np.maximum(allowed, 0.0)


def _other_caps(rig, i, asked):
    """The row of another tank that may stop a pump on which a floor [cm/s] relies, or ""."""
    if asked <= 0.0:
        return ""
    fed = {k for k in range(rig.tanks) if set(rig.gains[k]) & set(rig.gains[i])}
    for k in sorted(fed - {i}):
        if k not in rig.held:
            continue
        edges = np.linspace(0.0, rig.limit[k] + rig.band[k], PARTS + 1)
        common = set(rig.gains[k]) & set(rig.gains[i])
        wanted = sum(rig.gains[k][j][1] / max(rig.gains[i][j][0], 1e-300) for j in common) * asked
        alone = len(rig.gains[i]) == len(rig.gains[k]) == 1
        if not (alone and wanted <= _caps(rig, k, edges).min()):
            return f"the cap for tank {k + 1} may stop a pump that the floor relies on"
    for k in sorted({k for f in fed for k in rig.below[f]}):
        if k in rig.held and rig.slope[k] > 0.0:
            return f"the cap for tank {k + 1} may stop a pump that the floor relies on"
    return ""

"""An independent check of a finished `OutletFilter`: for which tanks it keeps the limits.

It works on the final numbers with its own formulas; Theorem 6 of README.md of this folder.
"""
# Conditions are generators of (holds, reason), holds written so that a NaN fails it.

import functools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import scipy  # its parts are imported when they are first used

from jaxtank.core.labels import label_of
from jaxtank.safety.checker import CASE, LIMITS, Verdict
from jaxtank.safety.known_features import OUTLETS, first_failure, readable, span_of, unknown_feature

PARTS = 500  # intervals of readings on which floors and caps are compared
FINE = 4000  # levels at which a tank is tested for holding what it gives in a step
ROUNDING = 1e-9
UNKNOWN = 1e6  # level [cm] from which a filter's bound of a level is none
BOXED = ("area", "drain", "orifice", "pipe", "pump_gain", "split", "gravity", "valve", "extent")
"""Parameters of the plant that may lie anywhere between those of the filter's two plants."""


class _Row(NamedTuple):
    """A row of the filter; only the last of two that oppose each other is sure to hold."""

    tank: int
    upper: bool
    movers: tuple
    place: int


class _Bounds(NamedTuple):
    """(n,) levels that tanks do not pass, and below which they do not fall [cm]."""

    high: np.ndarray
    low: np.ndarray


def check(
    outlet_filter: Any,
    plant: Any,
    actuator: Any,
    sensor: Any,
    *,
    hold: float,
    substeps: int = 1,
    box: Mapping[str, tuple[Any, Any]],
    inflow: tuple[Any, Any] = (0.0, 0.0),
    pulses: bool = False,
    faults: Any = None,
) -> tuple[Verdict, ...]:
    """Return the Verdict of each tank; `box` has the levels at t = 0 as "x0"."""
    parts = {"plant": plant, "actuator": actuator, "sensor": sensor, "safety_filter": outlet_filter}
    parts |= {} if faults is None else {"faults": faults}
    tanks = len(np.atleast_1d(outlet_filter.limit))
    why = unknown_feature(parts, box, OUTLETS)
    not_proved = lambda why: tuple(Verdict(i, False, why, CASE, False, why) for i in range(tanks))
    if why:
        return not_proved(why)
    rig = _Rig(outlet_filter, plant, actuator, sensor, hold, substeps, box)
    if why := first_failure(_covered(rig, pulses, faults, inflow)):
        return not_proved(why)
    upper, lower = _joint(rig)
    whole = not any(upper) and not any(why for why, low in zip(lower, rig.low) if low > 0.0)
    starts = LIMITS if whole else CASE
    return tuple(_verdict(rig, i, upper[i], lower[i], starts) for i in range(tanks))


def _verdict(rig, i, upper, lower, starts):
    rows = {(row.tank, row.upper) for row in rig.rows}
    words = lambda up: "Theorem 6" if (i, up) in rows else "no input can pass the limit"
    limited = bool(rig.low[i] > 0.0)
    low_reason = lower or (words(False) if limited else "")
    return Verdict(i, not upper, upper or words(True), starts, limited and not lower, low_reason)


def _root(h, knee):
    return math.sqrt(h) if h >= knee else math.sqrt(knee) * h / knee * (1.5 - 0.5 * h / knee)


def _power(h, p, knee):
    y = h / knee
    return h**p if y >= 1.0 else knee**p * max(y * (2.0 - p + (p - 1.0) * y), 0.0)


def _volume(shape, area, extent, h):
    """Volume below a level in a tank, from geometry."""
    if shape == "prism":
        return area * h
    y = h / extent
    if shape == "cone":
        return area * h * y * y / 3.0
    if shape == "sphere":
        return area * h * (2.0 * y - 4.0 / 3.0 * y * y)
    if shape == "horizontal-cylinder":
        r = 0.5 * extent
        chord = (r - h) * math.sqrt(max(h * (extent - h), 0.0))
        return area / extent * (r * r * math.acos(max(min((r - h) / r, 1.0), -1.0)) - chord)
    levels, shares = (np.array(column, dtype=float) for column in zip(*shape))
    knots = np.append(levels[levels < y], y)
    return area * extent * float(np.trapezoid(np.interp(knots, levels, shares), knots))


def _share(points, lift):
    """Share of a pump's flow at a lift: monotone cubics, straight beyond the ends."""
    x, y = (np.array(column, dtype=float) for column in zip(*points))
    slope = np.diff(y) / np.diff(x)
    ends = scipy.interpolate.PchipInterpolator(x, y).derivative()(x) if len(x) > 2 else slope
    ends = np.array([slope[0], *ends[1:-1], slope[-1]])
    if lift <= x[0] or lift >= x[-1]:
        at, k = (0, 0) if lift <= x[0] else (-1, -1)
        return max(y[at] + slope[k] * (lift - x[at]), 0.0)
    return max(float(scipy.interpolate.CubicHermiteSpline(x, y, ends)(lift)), 0.0)


class _Rig:
    """The final numbers of a rig and its filter."""

    limit: np.ndarray
    low: np.ndarray
    reach: np.ndarray
    bottom: np.ndarray
    rate: np.ndarray
    band: np.ndarray
    empty: np.ndarray
    inflow: np.ndarray
    draw: np.ndarray

    def __init__(self, outlet_filter, plant, actuator, sensor, hold, substeps, box):
        self.filter, self.plant, self.actuator = outlet_filter, plant, actuator
        self.label = functools.partial(label_of, plant, "tank")
        self.hold, self.step = float(hold), hold / substeps
        self.span = functools.partial(span_of, dict(box))
        self.weak, self.strong = outlet_filter.least, outlet_filter.most
        n, m = len(np.atleast_1d(plant.rim)), len(plant.feeds)
        self.n, self.m, self.inputs = n, m, m + len(plant.valves)
        full = lambda v, size=n: np.array(np.broadcast_to(np.asarray(v, dtype=float), (size,)))
        names = ("limit", "low", "reach", "bottom", "rate", "band")
        for name in (*names, "climb", "drop", "empty", "inflow", "draw"):
            setattr(self, name, full(getattr(outlet_filter, name)))
        self.shapes = plant.shapes or ("prism",) * n
        self.ends = [full(end, self.inputs) for end in (actuator.low, actuator.high)]
        self.range = [[self.demand(j, v) for j, v in enumerate(end)] for end in self.ends]
        self.begin = [full(end) for end in box.get("x0", (0.0, 0.0))]
        self.needed, self.top = readable(sensor, self.span, full)
        self.shallow = functools.cache(functools.partial(_shallow, self))
        order = [(*row, False) for row in outlet_filter.low_rows]
        order += [(*row, True) for row in outlet_filter.upper_rows]
        self.rows = [_Row(i, up, tuple(movers), k) for k, (i, movers, up) in enumerate(order)]

    def demand(self, j, u):
        k = j - self.m
        if k < 0:
            return float(u)
        opening = float(u) / (100.0 if self.plant.units[1].strip() == "%" else 1.0)
        if self.plant.characteristics[k] == "linear":
            return opening
        return float(self.plant.rangeability[k]) ** (opening - 1.0)

    def source(self, j):
        return self.plant.sources[j] if self.plant.sources else None

    def row(self, i, upper):
        """The row of a limit, or None."""
        return next((r for r in self.rows if r.tank == i and r.upper == upper), None)

    def neighbours(self, i, upper=False):
        """Tanks on whose levels the harm to tank i depends: at its low limit the pumps' too."""
        lifts = self.plant.lift_curves or (None,) * self.m
        pairs = [*self.plant.pipes, *self.plant.valves]
        for j, pair in enumerate(self.plant.feeds):
            if not upper or lifts[j] is not None:
                pairs += [(self.source(j), k) for k in pair]
        near = {k for pair in pairs if i in pair for k in pair}
        return (near | {a for a, b in self.plant.links if b == i}) - {i, None}

    def outlet(self, end, kind, k, level):
        """Flow of a drain or an orifice under the level of its tank."""
        of = lambda name: getattr(end, name)
        port, power, resistance = (of(f"{kind}_{s}") for s in ("port", "exponent", "resistance"))
        head = max(level - (0.0 if port is None else float(port[k])), 0.0)
        knee = float(end.knee)
        flow = _root(head, knee) if power is None else _power(head, float(power[k]), knee)
        flow *= float(of(kind)[k]) * math.sqrt(2.0 * float(end.gravity))
        return flow if resistance is None else flow + head / float(resistance[k])

    def joined(self, end, area, ports, k, first, second):
        """Flow between two tanks through pipe or valve k, towards the other level."""
        port = 0.0 if ports is None else float(ports[k])
        heads = [h if ports is None else max(h - port, 0.0) for h in (first, second)]
        z = heads[0] - heads[1]
        flow = float(area[k]) * math.sqrt(2.0 * float(end.gravity))
        return flow * z / math.sqrt(math.hypot(z, float(end.knee)))

    def sure(self, i, level, flow):
        return flow if level >= self.empty[i] else 0.0

    def harm(self, i, h, others, upper):
        """Most that flows into tank i (upper), or out of it, without inputs [cm^3/s]."""
        enters, leaves = (self.strong, self.weak) if upper else (self.weak, self.strong)
        into = self.inflow[i] if upper else self.draw[i]
        out = self.outlet(leaves, "drain", i, h)
        out = self.sure(i, h, out) if upper else out
        for k, (a, b) in enumerate(self.plant.links):
            if a == i:
                flow = self.outlet(leaves, "orifice", k, h)
                out += self.sure(i, h, flow) if upper else flow
            if b == i:
                flow = self.outlet(enters, "orifice", k, others[a])
                into += flow if upper else self.sure(a, others[a], flow)
        harm = into - out if upper else out - into
        pipes = (k for k, ends in enumerate(self.plant.pipes) if i in ends)
        return harm + sum(self.piped(k, i, h, others, upper) for k in pipes)

    def piped(self, k, i, h, others, upper):
        """Harm of pipe k to tank i at one of its ends."""
        (other,) = set(self.plant.pipes[k]) - {i}
        flow = lambda end: self.joined(end, end.pipe, end.pipe_port, k, h, others[other])
        weak, strong = flow(self.weak), flow(self.strong)
        if upper:
            return -(self.sure(i, h, weak) if weak >= 0.0 else strong)
        return strong if strong >= 0.0 else self.sure(other, others[other], weak)

    def effects(self, i, h, others, upper):
        """{input: (harm per demand above 0, below 0, whether a larger input helps)}."""
        table = {}
        for j, pair in enumerate(self.plant.feeds):
            if i == self.source(j) or i in pair:
                table[j] = self.pumped(j, i, h, others, upper)
        for k, pair in enumerate(self.plant.valves):
            if i in pair:
                table[self.m + k] = self.through(k, i, h, others, upper)
        return table

    def pumped(self, j, i, h, others, upper):
        """Effect of pump j on tank i."""
        a, b = float(self.weak.pump_gain[j]), float(self.strong.pump_gain[j])
        source, (first, second) = self.source(j), self.plant.feeds[j]
        takes = i == source
        other = first if takes else source
        if not takes and second is not None:
            p, q = float(self.weak.split[j]), float(self.strong.split[j])
            p, q = (p, q) if i == first else (1.0 - q, 1.0 - p)
            a, b = a * p, b * q
        if self.plant.lift_curves and self.plant.lift_curves[j] is not None:
            lift = h - (0.0 if other is None else others[other])
            share = _share(self.plant.lift_curves[j], -lift if takes else lift)
            a, b = a * share, b * share
        dry = lambda k: k is not None and self.sure(k, h if k == i else others[k], 1.0) == 0.0
        if takes == upper:  # a larger input helps
            return (0.0 if dry(source) else -a), -b, True
        givers = (first, second) if takes else (i,)
        return b, (0.0 if any(map(dry, givers)) else a), False

    def through(self, k, i, h, others, upper):
        """Effect of valve k on tank i."""
        (a, b), ends = self.plant.valves[k], (self.weak, self.strong)
        if b is not None:
            strong, other = self.strong, others[b if i == a else a]
            flow = self.joined(strong, strong.valve, strong.valve_port, k, h, other)
            if self.plant.one_way[k] and (flow > 0.0) != (i == a):
                flow = 0.0
            return max(-flow if upper else flow, 0.0), 0.0, False
        port = 0.0 if self.plant.valve_port is None else float(self.plant.valve_port[k])
        root = _root(max(h - port, 0.0), float(self.plant.knee))
        flows = [float(e.valve[k]) * math.sqrt(2.0 * float(e.gravity)) * root for e in ends]
        plus = -self.sure(i, h, flows[0]) if upper else flows[1]
        return plus, plus, upper

    def worst(self, effects, movers=()):
        """What inputs do at most, `movers` at their harmless ends."""
        total = 0.0
        for j, effect in effects.items():
            ends = [_done(effect, end[j]) for end in self.range]
            total += min(ends) if j in movers else max(ends)
        return total

    def room(self, i, low, high):
        """Least volume between two levels over the box."""
        volume = lambda e, h: _volume(self.shapes[i], float(self.weak.area[i]), e, h)
        if self.plant.extent is None:
            return volume(1.0, high) - volume(1.0, low)
        extents = {float(end.extent[i]) for end in (self.weak, self.strong)}
        return min(volume(e, high) - volume(e, low) for e in extents)

    def allowed(self, row, reading, level):
        """(effects, least harm that a row allows) at a reading and a level, ends of an interval."""
        i, up = row.tank, row.upper
        others = self.reach if up else self.bottom
        if up:
            room = self.room(i, min(max(reading + self.band[i], 0.0), self.limit[i]), self.limit[i])
        else:
            room = self.room(i, self.low[i], max(reading - self.band[i], self.low[i]))
        h = max(level - self.band[i] if up else level + self.band[i], 0.0)
        effects = self.effects(i, h, others, up)
        rest = {j: e for j, e in effects.items() if j not in row.movers}
        return effects, self.rate[i] * room - self.harm(i, h, others, up) - self.worst(rest)


def _done(effect, v):
    return effect[0] * v if v >= 0.0 else effect[1] * v


def _covered(rig, pulses, faults, inflow):
    """(holds, reason) of what the theorem needs of the whole rig."""
    plant, actuator = rig.plant, rig.actuator
    yield not pulses, "not covered: inflow pulses"
    yield faults is None, "not covered: faults"
    late = float(np.max(np.asarray(actuator.delay or 0.0, dtype=float))) > 0.0
    lags = actuator.lag is not None and np.any(np.asarray(actuator.lag) > 0.0)
    yield not (late or lags), "not covered: dead time or lag with outlets"
    yield actuator.dead_zone is None, "not covered: dead zones with outlets"
    yield not (plant.overflow and plant.spills), "not covered: overflow into a tank with outlets"
    yield from _counted(rig)
    entering = [np.broadcast_to(np.asarray(v, dtype=float), (rig.n,)) for v in inflow]
    counted = np.all(entering[0] >= rig.draw) and np.all(entering[1] <= rig.inflow)
    yield counted, "inflow disturbances beyond those that the filter counts on"
    yield from _covered_elements(rig)


def _counted(rig):
    """(holds, reason): the plants of the box are those that the filter counts on."""
    plant = rig.plant
    differs = "differs from that of the safety filter"
    for name in (*OUTLETS.static, *OUTLETS.fixed):
        values = [getattr(e, name) for e in (plant, rig.weak, rig.strong)]
        if name in OUTLETS.fixed and values[0] is not None:
            values = [None if v is None else np.asarray(v).tolist() for v in values]
        yield values[0] == values[1] == values[2], f"not covered: plant.{name} {differs}"
    for name in (name for name in BOXED if getattr(plant, name) is not None):
        low, high = rig.span(f"plant.{name}", getattr(plant, name))
        high = np.minimum(high, 1.0) if name == "split" else high
        least, most = (np.asarray(getattr(e, name), float) for e in (rig.weak, rig.strong))
        slack = 1e-12 * np.maximum(np.abs(low), np.abs(high))
        inside = np.all(least <= low + slack) and np.all(most >= high - slack)
        yield inside, f"not covered: plant.{name} beyond the box of the safety filter"


def _covered_elements(rig):
    """(holds, reason) of pumps, valves and shapes."""
    plant = rig.plant
    yield plant.bottom, "not covered: levels below the bottom (plant.bottom = false)"
    for j, pair in enumerate(plant.feeds):
        word, source = f"not covered: pump {j + 1}", rig.source(j)
        yield source is None or source not in pair, f"{word} from a tank into itself"
        yield pair[0] is not None or pair[1] is None, f"{word} without a first tank"
        yield pair[0] is None or pair[0] != pair[1], f"{word} twice into one tank"
        if plant.lift_curves and plant.lift_curves[j] is not None:
            yield rig.ends[0][j] >= 0.0, f"{word} with head loss that runs backwards"
            yield pair[1] is None, f"{word} with head loss into two tanks"
            falls = np.all(np.diff([share for _, share in plant.lift_curves[j]]) <= 0.0)
            yield falls, f"{word} whose flow rises with the lift"
        yield not plant.curves or plant.curves[j] is None, f"{word} with a curve"
    for k, (a, b) in enumerate(plant.valves):
        word = f"not covered: valve {k + 1}"
        kind = plant.characteristics[k]
        yield kind in ("linear", "equal-percentage"), f"{word} with a characteristic of points"
        yield rig.ends[0][rig.m + k] >= 0.0, f"{word} below closed"
        yield a != b, f"{word} of one tank"
    for i, shape in enumerate(rig.shapes):
        if shape == "prism":
            continue
        least, most = (float(e.extent[i]) for e in (rig.weak, rig.strong))
        word = f"not covered: {rig.label(i)}"
        yield rig.limit[i] <= least, f"{word} with a limit above its shape"
        sure = least == most or isinstance(shape, str)
        yield sure, f"{word} with a table of areas of uncertain extent"


def _joint(rig):
    """[why each upper limit is not proved, or ""], and of low limits, of the largest joint set."""
    upper, lower = [""] * rig.n, [""] * rig.n
    highest = rig.span("plant.rim", rig.plant.rim)[1]
    over = np.maximum(highest, rig.begin[1]) if rig.plant.overflow else np.full(rig.n, np.inf)
    while True:
        high = np.where([bool(why) for why in upper], over, rig.limit)
        low = np.where([bool(why) for why in lower], 0.0, rig.low)
        bounds = _Bounds(high, low)
        after = [
            [why or first_failure(_kept(rig, i, bounds, up)) for i, why in enumerate(reasons)]
            for reasons, up in ((upper, True), (lower, False))
        ]
        if after == [upper, lower]:
            return upper, lower
        upper, lower = after


def _kept(rig, i, bounds, upper):
    """(holds, reason) of one limit while the other tanks stay within `bounds`."""
    if not upper and rig.low[i] <= 0.0:
        return
    unit, limit = rig.plant.units[0], rig.limit[i] if upper else rig.low[i]
    start, side = rig.begin[1][i] if upper else rig.begin[0][i], "above" if upper else "below"
    starts = start <= limit * (1.0 + 1e-12) if upper else start >= limit * (1.0 - 1e-12)
    yield starts, f"start at {start:.4g} {unit}, {side} the limit {limit:.4g} {unit}"
    near, row = rig.neighbours(i, upper), rig.row(i, upper)
    others = rig.reach if upper else rig.bottom
    movers = () if row is None else row.movers
    rest = rig.harm(i, limit, others, upper)
    effects = rig.effects(i, limit, others, upper)
    yield set(movers) <= set(effects), "a row moves an input that does not act on the tank"
    passing = rest + rig.worst(effects, movers)
    words = "enter at its limit" if upper else "leave at its low limit"
    reason = f"{passing:.3g} {unit}^3/s more may {words} than its inputs can balance"
    yield passing <= ROUNDING * max(abs(rest), 1e-9), reason
    for k in sorted({i} | near):
        sure = rig.empty[k] >= rig.shallow(k) * (1.0 - ROUNDING)
        yield sure, f"{rig.label(k)} may run empty within a step"
    if row is not None:
        yield from _row_holds(rig, row, bounds, near)
    # last: of two tanks that rely on each other the answer names what the first of them lacks
    yield from _relied_on(rig, row, bounds, upper, sorted(near))


def _relied_on(rig, row, bounds, upper, near):
    """(holds, reason): the levels of neighbours are within what one limit counts on."""
    for k in near:
        word = f"relies on {rig.label(k)}"
        yield math.isfinite(bounds.high[k]), f"{word}, which has no upper bound"
        yield rig.reach[k] < UNKNOWN, f"{word}, not proved"
        yield bounds.high[k] <= rig.reach[k] * (1.0 + ROUNDING), f"{word}, not proved"
        yield bounds.low[k] >= rig.bottom[k], f"{word}, whose low limit is not proved"
        yield upper or bounds.high[k] <= rig.limit[k], f"{word}, not proved"
    for k in near if row is not None else ():
        any_change = _any_change(rig, k, min(rig.climb[k], rig.drop[k]))
        for j in () if any_change else sorted(rig.neighbours(k)):
            word = f"limit of {rig.label(j)}, not proved"
            yield bounds.high[j] <= rig.reach[j], f"relies on the upper {word}"
            yield bounds.low[j] >= rig.bottom[j], f"relies on the low {word}"


def _row_holds(rig, row, bounds, near):
    """(holds, reason) of the readings and of the other rows."""
    i, unit = row.tank, rig.plant.units[0]
    value = rig.rate[i] * rig.hold
    yield value <= 1.0 + 1e-12, f"kappa T = {value:.3g} above 1"
    yield math.isfinite(bounds.high[i]), "it has no upper bound"
    for k in sorted({i} | near):
        narrow = f"noise band {rig.band[k]:.3g} {unit} below {rig.needed[k]:.3g} {unit}"
        yield rig.band[k] >= rig.needed[k] * (1.0 - ROUNDING), narrow
        reason = f"{rig.label(k)} may rise above what its sensor can read, {rig.top[k]:.4g} {unit}"
        # one without a bound is a limit that another one relies on
        bound = bounds.high[k]
        yield not math.isfinite(bound) or bound <= rig.top[k] * (1.0 + 1e-12), reason
    for k in sorted(near):
        rates = [_fastest(rig, k, up) * rig.hold for up in (True, False)]
        for counted, most in zip((rig.climb[k], rig.drop[k]), rates):
            slower = rig.shapes[k] == "prism" and most <= counted * (1.0 + ROUNDING)
            reason = f"{rig.label(k)} may change faster than is counted on"
            yield slower or _any_change(rig, k, counted), reason
    for other in rig.rows[row.place + 1 :]:
        yield from _compatible(rig, row, other, bounds)


def _any_change(rig, k, counted):
    """Whether a change of a level in a hold that is counted on is as large as any can be."""
    return counted >= rig.reach[k] + rig.band[k]


def _fastest(rig, k, upper):
    """Largest rise (upper) or fall of a level [cm/s] of a tank with one cross-section."""
    h, others = (0.0, rig.reach) if upper else (rig.reach[k], rig.bottom)
    rate = rig.harm(k, h, others, upper) + rig.worst(rig.effects(k, h, others, upper))
    return max(rate, 0.0) / float(rig.weak.area[k])


def _shallow(rig, i):
    """The level [cm] below which a tank may hold less than it gives in a step."""
    empty, none = rig.empty, np.zeros(rig.n)
    rig.empty = none
    levels, last = np.linspace(0.0, rig.limit[i], FINE + 1), 0.0
    for k in range(FINE, 0, -1):
        h = levels[k]
        gives = rig.harm(i, h, none, False) + rig.draw[i]
        effects = rig.effects(i, h, none, False).items()
        gives += sum(max(0.0, *(_done(e, end[j]) for end in rig.range)) for j, e in effects)
        if rig.step * gives > rig.room(i, 0.0, h) * (1.0 + ROUNDING):
            last = levels[min(k + 1, FINE)]
            break
    rig.empty = empty
    return last


def _bound(effect, allowed, ends):
    """Demand at which a single mover does the harm that is allowed, within its range."""
    plus, minus, up = effect
    divisor = (minus if up else plus) if allowed >= 0.0 else (plus if up else minus)
    if divisor == 0.0:
        return ends[0] if up == (allowed >= 0.0) else ends[1]
    return min(max(allowed / divisor, ends[0]), ends[1])


def _compatible(rig, row, later, bounds):
    """(holds, reason): a later row does not undo what a row has moved."""
    effects_of = lambda r: rig.effects(r.tank, rig.limit[r.tank], rig.reach, r.upper)
    ups = [{j: e[2] for j, e in effects_of(r).items()} for r in (row, later)]
    against = [j for j in set(row.movers) & set(later.movers) if ups[0][j] != ups[1][j]]
    if not against:
        return
    limit = f"the {'upper' if later.upper else 'low'} limit of {rig.label(later.tank)}"
    word = f"not covered: {limit} moves the same inputs the other way"
    yield len(row.movers) == 1 and len(later.movers) == 1, word
    (j,) = against
    ends = [end[j] for end in rig.range]

    def demands(r):
        eps = rig.band[r.tank]
        with np.errstate(invalid="ignore"):  # a level without a bound: NaN, which holds nowhere
            edges = np.linspace(bounds.low[r.tank] - eps, bounds.high[r.tank] + eps, PARTS + 1)
        pairs = zip(edges[1:], edges[:-1]) if r.upper else zip(edges[:-1], edges[1:])
        rows = (rig.allowed(r, reading, level) for reading, level in pairs)
        return np.array([_bound(effects[j], allowed, ends) for effects, allowed in rows])

    mine, theirs = demands(row), demands(later)
    floors, caps = (mine, theirs) if ups[0][j] else (theirs, mine)
    agree = floors <= caps + 1e-12 if row.tank == later.tank else floors.max() <= caps.min() + 1e-12
    yield np.all(agree), f"{limit} is kept first"

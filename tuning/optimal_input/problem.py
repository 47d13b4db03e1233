"""The problem of the optimal inputs: objective, limits, intervals, and what a run with given inputs
costs.
"""

import dataclasses

import jax
import numpy as np

from jaxtank import measures as ms
from jaxtank.core.errors import InputError
from jaxtank.core.labels import entry_label
from jaxtank.core.tree import number
from jaxtank.limits import resolve_limits
from jaxtank.loop import run as lp
from jaxtank.rig import check_objective
from tuning.optimal_input.cost import (
    POINTWISE,
    Lagrangian,
    Terms,
    evaluate,
    open_loop,
    value_and_gradient,
)

TOLERANCE = 3e-5
"""Share of a limit by which it may be exceeded and still counts as held [-]: 1e-3 cm of 30 cm."""

SEARCH_SAMPLES = 4000  # fewest samples of the coarse clock of the search
INTERVALS = 1200  # most intervals of an input by default

MOST_INTERVALS = 20_000

WEIGHT = 1e5
"""First weight of a squared excess, for a cost scaled to 1 and an excess as a share of its limit
[-].
"""

SENSITIVE = {"u2", "travel", "deviation2", "changes2", "past2"}
"""Accumulators that depend on an input within the dead zone of its pump."""


class InputProblem:
    """Inputs (pumps, intervals) of a case as unknowns: their box, cost and limits."""

    def __init__(self, case, objective, limits, interval):
        self.case = case
        loop, clock = case.loop, case.clock
        weights = check_objective(case.objective if objective is None else objective)
        self.objective = {m: w for m, w in weights.items() if w > 0}
        lp.check(loop, clock, jax.random.key(0))
        self.limits = resolve_limits(case, limits)
        _check_measures(self.objective, self.limits)
        names = (*self.objective, *(limit.measure for limit in self.limits))
        needs = {a for m in names for a in ms.MEASURES[m].needs}
        self.low, self.high = _box(loop.actuator, loop.plant.pumps, needs)
        self.interval = _interval(clock, interval)
        self.count = max(1, int(np.ceil((clock.samples - 1) * clock.dt / self.interval - 1e-6)))
        # changes from sample to sample are fewer at a coarser step
        self.coarse = (
            dataclasses.replace(clock, integrator="midpoint")
            if "changes2" in needs
            else _search_clock(clock, self.interval, (loop.actuator.delay, *loop.actuator.delays))
        )
        dry = _without_overflow(self.limits, loop.plant)
        self.plant = dataclasses.replace(loop.plant, overflow=False) if dry else loop.plant
        self.start = self._terms(dry)  # the Lagrangian with the limits as given

    def _terms(self, dry):
        """Set `terms`; return the first Lagrangian. dry: tanks that must not overflow."""
        loop = self.case.loop
        rim = np.asarray(loop.plant.rim)
        limits = [_limit_of(v, rim, dry) for v in self.limits]
        pointwise = [limit for limit in limits if limit[0] in POINTWISE]
        integral = [limit for limit in limits if limit[0] not in POINTWISE]
        self.terms = Terms(
            objective=tuple(self.objective.items()),
            squared=tuple(self.objective) == ("rms_error_total",),
            pointwise=tuple((m, i) for m, i, _ in pointwise),
            integral=tuple((m, i) for m, i, _ in integral),
        )
        length = float(np.max(np.abs([*np.ravel(loop.x0), *rim[np.isfinite(rim)], 1e-3])))
        values, sums = [v for *_, v in pointwise], [v for *_, v in integral]
        return Lagrangian(
            scale=np.float64(1.0),
            weight=np.float64(WEIGHT),
            pointwise=number(values),
            multipliers=(np.zeros(self.coarse.samples),) * len(values),
            integral=number(sums),
            integral_multipliers=number(np.zeros(len(sums))),
            sizes=(
                number([abs(v) or length for v in values]),
                number([abs(v) or 1.0 for v in sums]),
            ),
            smoothing=(number(1e-3 * np.max(self.high - self.low)), number(1e-5 * length)),
        )

    def project(self, u):
        """Return inputs (pumps, ..) projected onto the pumps' limits."""
        return np.clip(u, self.low[:, None], self.high[:, None])

    def loop(self):
        """Return the open loop with one input per interval."""
        zeros = np.zeros((self.case.loop.plant.pumps, self.count))
        return dataclasses.replace(
            open_loop(self.case.loop, zeros, self.interval), plant=self.plant
        )

    def value_and_gradient(self, u, lagrangian):
        """Return (search cost, gradient (pumps, intervals)) on the coarse clock."""
        return value_and_gradient(self.loop(), self.coarse, self.terms, u, lagrangian)

    def excesses(self, u, interval, clock, lagrangian):
        """Return the result of `cost.evaluate` for u, sampled: one program for any interval."""
        at = np.arange(clock.samples) * (clock.dt / interval) + 1e-6
        at = np.minimum(at, u.shape[1] - 1).astype(int)
        loop = dataclasses.replace(open_loop(self.case.loop, u[:, at], clock.dt), plant=self.plant)
        return evaluate(loop, clock, self.terms, u[:, at], lagrangian)

    def check(self, u, interval):
        """Return cost, excess and constraints of inputs u (pumps, ..) at the case's own step."""
        over, integral, measures = self.excesses(u, interval, self.case.clock, self.start)
        over, integral = [np.asarray(o) for o in over], [float(v) for v in integral]
        peaks = [float(o.max()) for o in over]
        excess = max([0.0, *peaks, *integral])
        return {
            "u": u.T,
            "interval": interval,
            "cost": float(sum(w * np.sum(measures[m]) for m, w in self.objective.items())),
            "excess": excess,
            "beyond": (peaks, integral),
            "holds": bool(excess <= TOLERANCE),
            "constraints": self._constraints(over, integral),
        }

    def _constraints(self, over, integral):
        """Return a dict for each limit: name, measure, limit, value, margin, tank, time_s."""
        start, dt, rows = self.start, self.case.clock.dt, []
        peaks = [(int(np.argmax(o)), o) for o in over]
        cells = [
            *zip(self.terms.pointwise, start.pointwise, start.sizes[0], peaks),
            *zip(self.terms.integral, start.integral, start.sizes[1], integral),
        ]
        for (m, i), limit, size, peak in cells:
            at, excess = (peak[0], peak[1][peak[0]]) if m in POINTWISE else (None, peak)
            per, excess = ms.MEASURES[m].per, excess * float(size)
            row = {
                "name": entry_label(self.case.loop.plant, m, per, i),
                "measure": m,
                "limit": float(limit),
                "value": float(float(limit) + POINTWISE.get(m, 1) * excess),
                "margin": float(-excess),
                "tank": i + 1 if per == "tank" else None,
                "time_s": None if at is None else at * dt,
            }
            rows.append(row)
        return rows


def _check_measures(objective, limits):
    """Raise InputError for measures without a derivative by every input."""
    good = [m for m, spec in ms.MEASURES.items() if spec.by_input]
    for m in (m for m in objective if m not in good):
        reason = f"bound of {m}: has no derivative by every input"
        raise InputError(f"{reason}; can be minimised: {', '.join(good)}")
    for limit in (v for v in limits if v.measure not in (*good, *POINTWISE)):
        reason = f"bound under a limit on {limit.measure}: has no derivative"
        raise InputError(f"{reason}; can be limited: {', '.join([*POINTWISE, *good])}")


def _box(actuator, pumps, needs):
    """Return (low, high) (pumps,) of the inputs; raise InputError where they are not finite."""
    low, high = (
        np.array(np.broadcast_to(v, pumps), dtype=float) for v in (actuator.low, actuator.high)
    )
    if not np.all(np.isfinite([low, high])):
        raise InputError("bound: every pump needs finite limits, actuator.low and actuator.high")
    # within an offset dead zone nothing depends on the input: a search would not leave it
    if np.any(np.asarray(actuator.offset) > 0) and not needs & SENSITIVE:
        low = np.minimum(np.maximum(low, actuator.offset), high)
    return low, high


def _without_overflow(limits, plant):
    """Return tanks whose overflow volume is limited to nothing: none or all of them."""
    dry = [v.index for v in limits if v.measure == "overflow_volume" and v.value <= 1e-3]
    if dry and len(dry) < plant.tanks:
        raise InputError(
            "bound: a limit on overflow_volume must be given for all tanks, or max_level = rim"
        )
    return dry


def _limit_of(limit, rim, dry):
    """Return (measure, entry, value) of a Limit: no overflow as a limit on the level."""
    if limit.measure == "overflow_volume" and limit.index in dry:
        return "max_level", limit.index, rim[limit.index] * (1 - TOLERANCE)
    return limit.measure, limit.index, limit.value


def _interval(clock, interval):
    """Return the interval [s] as given, or 1, 2, 5 times a power of ten for at most INTERVALS."""
    if interval is None:
        least = max(clock.duration / INTERVALS, clock.dt)
        round_numbers = [a * 10.0**b for b in range(-6, 7) for a in (1, 2, 5)]
        inside = [v for v in round_numbers if (1 - 1e-9) * least <= v <= 2.5 * least]
        fits = [v for v in inside if _whole_number(v / clock.dt)]
        return float(fits[0] if fits else clock.dt * np.ceil(least / clock.dt - 1e-6))
    good = isinstance(interval, (int, float)) and not isinstance(interval, bool)
    good = good and clock.dt * (1 - 1e-9) <= interval <= clock.duration
    if not good or not _whole_number(interval / clock.dt):
        raise InputError(
            f"interval = {interval!r} s: must be a whole number of samples of {clock.dt:g} s, at"
            f" most {clock.duration:g} s"
        )
    if (count := clock.duration / interval) > MOST_INTERVALS:
        most = f"{count:.0f} intervals; must be at most {MOST_INTERVALS}"
        raise InputError(f"interval = {interval:g} s: {most}")
    return float(interval)


def _search_clock(clock, interval, delays):
    """Return the clock of the search: up to twenty samples in one, and a cheaper integrator."""
    for f in (20, 10, 5, 4, 2):
        dt = clock.dt * f
        if (clock.samples - 1) / f >= SEARCH_SAMPLES and all(
            _whole_number(v / dt) for v in (interval, *delays, clock.duration)
        ):
            return dataclasses.replace(clock, dt=dt, integrator="midpoint")
    return dataclasses.replace(clock, integrator="midpoint")


def _whole_number(x):
    return abs(x - round(x)) <= 1e-6 * max(1.0, abs(x))

"""The search for the best inputs: grids from coarse to fine, L-BFGS in a box, limits by one
multiplier per sample.
"""

import dataclasses

import jax
import numpy as np

from jaxtank import measures as ms
from jaxtank.analysis.steady_state import equilibrium
from jaxtank.core.errors import InputError, NonFiniteError
from jaxtank.core.tree import number
from jaxtank.loop import run as lp
from jaxtank.rig import check_objective
from tuning.optimal_input.cost import RUNNING, Held, Terms, look, open_loop, value_and_gradient
from tuning.optimal_input.lbfgsb import minimise
from tuning.problem.limits import resolve_limits

TOLERANCE = 3e-5
"""Share of a limit by which it may be passed and still counts as held [-]: 1e-3 cm of 30 cm."""

SEARCH_SAMPLES = 4000
"""Samples that a coarse clock must leave for the search."""

INTERVALS = 1200
"""Most intervals of an input where none are asked for."""

GRIDS = (16, 4, 1)
"""Intervals that move together, coarse to fine: slow changes of the input are found on few
unknowns.
"""

WEIGHT = 1e5
"""First weight of a squared excess, of a cost that counts as 1 and an excess as a share of its
limit [-].
"""

SETPOINTS = 8
"""Setpoints whose steady inputs are asked for: a start needs no more."""

ROUNDS = 8
"""Most rounds of repair on the finest grid."""


class InputSearch:
    """The search of `bound`: problem, memory and counters."""

    def __init__(self, case, objective, limits, interval, iterations, progress):
        if jax.numpy.result_type(float) != np.float64:
            raise InputError("bound needs float64: jax.config.update('jax_enable_x64', True)")
        if (
            not isinstance(iterations, int)
            or isinstance(iterations, bool)
            or not 1 <= iterations <= 100_000
        ):
            raise InputError(
                f"iterations = {iterations!r}: must be a whole number from 1 to 100000"
            )
        self.case, self.most, self.progress = case, iterations, progress
        self.objective = {
            m: w
            for m, w in check_objective(case.objective if objective is None else objective).items()
            if w > 0
        }
        loop, clock = case.loop, case.clock
        lp.check(loop, clock, jax.random.key(0))
        self.low, self.high = (
            np.array(np.broadcast_to(v, loop.plant.pumps), dtype=float)
            for v in (loop.actuator.low, loop.actuator.high)
        )
        if not np.all(np.isfinite([self.low, self.high])):
            raise InputError(
                "bound: every pump needs finite limits, actuator.low and actuator.high"
            )
        self.limits = resolve_limits(case, limits)
        _check_served(self.objective, self.limits)
        self.interval = _interval(clock, interval)
        self.count = max(1, int(np.ceil((clock.samples - 1) * clock.dt / self.interval - 1e-6)))
        needs = {
            a
            for m in (*self.objective, *(limit.measure for limit in self.limits))
            for a in ms.MEASURES[m].needs
        }
        # changes from sample to sample are fewer at a coarser step
        self.coarse = (
            dataclasses.replace(clock, integrator="midpoint")
            if "changes2" in needs
            else _search_clock(clock, self.interval, loop.actuator.delay)
        )
        # below an offset dead zone the pump stands still whatever the voltage: a search would not
        # find its way out
        if np.any(np.asarray(loop.actuator.offset) > 0) and not needs & {
            "u2",
            "travel",
            "deviation2",
            "changes2",
            "past2",
        }:
            self.low = np.minimum(np.maximum(self.low, loop.actuator.offset), self.high)
        # no liquid over a rim is a level at most at the rim: the slope of a level that stops there
        # would say nothing
        spill = [
            limit.index
            for limit in self.limits
            if limit.measure == "overflow_volume" and limit.value <= 1e-3
        ]
        if spill and len(spill) < loop.plant.tanks:
            raise InputError(
                "bound: a limit on overflow_volume must be given for all tanks, or max_level = rim"
            )
        self.plant = dataclasses.replace(loop.plant, overflow=False) if spill else loop.plant
        rim = np.asarray(loop.plant.rim)
        held = [(limit.measure, limit.index, limit.value) for limit in self.limits]
        levels = [
            (
                ("max_level", i, rim[i] * (1 - TOLERANCE))
                if m == "overflow_volume" and i in spill
                else (m, i, v)
            )
            for m, i, v in held
        ]
        running = [limit for limit in levels if limit[0] in RUNNING]
        whole = [limit for limit in levels if limit[0] not in RUNNING]
        self.terms = Terms(
            objective=tuple(self.objective.items()),
            squared=tuple(self.objective) == ("rms_error_total",),
            running=tuple((m, i) for m, i, _ in running),
            whole=tuple((m, i) for m, i, _ in whole),
        )
        length = float(np.max(np.abs([*np.ravel(loop.x0), *rim[np.isfinite(rim)], 1e-3])))
        self.held = Held(
            scale=np.float64(1.0),
            weight=np.float64(WEIGHT),
            running=number([v for *_, v in running]),
            forces=tuple(np.zeros(self.coarse.samples) for _ in running),
            whole=number([v for *_, v in whole]),
            pulls=number(np.zeros(len(whole))),
            room=(
                number([abs(v) or length for *_, v in running]),
                number([abs(v) or 1.0 for *_, v in whole]),
            ),
            knees=(number(1e-3 * np.max(self.high - self.low)), number(1e-5 * length)),
        )
        self.asked = self.held
        self.best, self.closed, self.grids, self.slope = None, None, [], np.nan
        self.iterations, self.gradients, self.simulations = 0, 0, 0

    def run(self):
        """Grids from coarse to fine; on each, rounds of L-BFGS and new multipliers; on the last,
        until the limits hold.
        """
        grids = [g for g in GRIDS if g == 1 or self.count >= 20 * g]
        u = self._start(grids[0])
        for group in grids:
            # a wide knee on a fine grid would let one jump be had for nothing, cut into many small
            # ones
            self.held = self.held._replace(
                knees=(self.asked.knees[0] * group * group / GRIDS[0], self.asked.knees[1])
            )
            self._rescale(u)
            u, found = self._settle(u, group, 5 if group == 1 else 2)
            if group == 1:
                found = self._repair(u, found)
            self.grids.append(
                {
                    "interval_s": self.interval * group,
                    "cost": found["cost"],
                    "excess": found["excess"],
                }
            )

    def _start(self, group):
        """The better of two searches on the coarsest grid: from the law's own inputs, and from
        those of steady state.
        """
        starts = [s for s in (self._own(), self._steady()) if s is not None]
        self._rescale(starts[0])
        done = [self._descend(u, group) for u in starts]
        if not any(np.isfinite(f) for _, f in done):
            raise NonFiniteError(
                "neither the law's own inputs nor those of steady state give a run that stays"
                " finite"
            )
        return min(done, key=lambda pair: pair[1] if np.isfinite(pair[1]) else np.inf)[0]

    def _own(self):
        """The law's own inputs, each the mean over its interval; None if they do not stay finite."""
        loop, clock = self.case.loop, self.case.clock
        quiet = dataclasses.replace(loop, sensor=loop.sensor.without_noise())
        try:
            applied = np.asarray(lp.simulate(quiet, clock).applied).T
        except NonFiniteError:
            return None
        self.simulations += 1
        self.closed = self.check(applied, clock.dt)
        if not np.isfinite(self.closed["cost"]):
            self.closed = None
        at = np.minimum(
            np.arange(clock.samples) * clock.dt / self.interval + 1e-6, self.count - 1
        ).astype(int)
        return self._inside(
            np.stack(
                [
                    np.bincount(at, row, self.count) / np.bincount(at, minlength=self.count)
                    for row in applied
                ]
            )
        )

    def _steady(self):
        """The inputs that would hold the nearest of a few setpoints, where they exist; the middle
        of the range elsewhere.
        """
        plant, actuator = self.case.loop.plant, self.case.loop.actuator
        r = np.array(
            self.case.loop.reference.sample(dataclasses.replace(self.coarse, dt=self.interval))[0]
        )[:, : self.count]
        offset = np.asarray(actuator.offset)
        known = np.unique(r, axis=1)
        known, held = known[:, :: -(-known.shape[1] // SETPOINTS)].T, []
        for setpoint in known:
            try:
                held.append(equilibrium(plant, setpoint)[1] + offset)
            except InputError:  # none at this setpoint
                held.append(0.5 * (self.low + self.high))
        nearest = np.argmin(((r[:, None, :] - known.T[:, :, None]) ** 2).sum(axis=0), axis=0)
        return self._inside(np.array(held)[nearest].T)

    def _inside(self, u):
        return np.clip(u, self.low[:, None], self.high[:, None])

    def _loop(self):
        zeros = np.zeros((self.case.loop.plant.pumps, self.count))
        return dataclasses.replace(
            open_loop(self.case.loop, zeros, self.interval), plant=self.plant
        )

    def _rescale(self, u):
        """Count the cost of u as 1, and keep the multipliers what they are in units of the cost."""
        bare = self.held._replace(
            weight=np.float64(1e-30),
            forces=tuple(0.0 * f for f in self.held.forces),
            scale=np.float64(1.0),
        )
        cost = float(
            value_and_gradient(
                self._loop(), self.coarse, self.terms, u, bare._replace(pulls=0.0 * bare.pulls)
            )[0]
        )
        self.gradients += 1
        if not np.isfinite(cost) or cost <= 1e-12:
            return
        ratio = float(self.held.scale) / cost
        self.held = self.held._replace(
            scale=np.float64(cost),
            forces=tuple(f * ratio for f in self.held.forces),
            pulls=self.held.pulls * ratio,
        )

    def _descend(self, u, group):
        """(inputs, search cost) after L-BFGS from u, with `group` neighbouring intervals as one."""
        low, span = self.low[:, None], (self.high - self.low)[:, None]
        edges = np.arange(0, self.count, group)
        sizes, loop = np.diff(np.append(edges, self.count)), self._loop()

        def spread(z):
            return low + span * np.repeat(z.reshape(len(low), -1), sizes, axis=1)

        def cost(z):
            self.gradients += 1
            value, gradient = value_and_gradient(
                loop, self.coarse, self.terms, spread(z), self.held
            )
            gradient = (np.add.reduceat(np.asarray(gradient), edges, axis=1) * span).ravel()
            if not (np.isfinite(value) and np.all(np.isfinite(gradient))):
                return 1e12, np.zeros_like(gradient)
            return float(value), gradient

        z = (np.add.reduceat(u, edges, axis=1) / sizes - low) / span
        z, value, gradient, count = minimise(cost, np.clip(z, 0.0, 1.0).ravel(), self.most)
        self.iterations += count
        self.slope = float(np.max(np.abs(z - np.clip(z - gradient, 0.0, 1.0))))
        return spread(z), value

    def _settle(self, u, group, rounds):
        """(inputs, what check says of them) after rounds of descent and new multipliers; heavier
        where an excess does not shrink.
        """
        last, before = np.inf, np.inf
        for _ in range(rounds):
            u, _ = self._descend(u, group)
            found = self.check(u, self.interval)
            self._tell(found, group)
            if found["excess"] <= 30 * TOLERANCE and abs(found["cost"] - before) <= 2e-3 * abs(
                found["cost"]
            ):
                break
            before = found["cost"]
            if not self.terms.running and not self.terms.whole:
                continue
            self._push(u)
            if found["excess"] > max(0.5 * last, TOLERANCE):
                self.held = self.held._replace(weight=self.held.weight * 3.0)
            last = found["excess"]
        return u, found

    def _push(self, u):
        """New multipliers: force + weight * excess, not below 0."""
        over, whole, _ = self._look(u, self.interval, self.coarse, self.held)
        w = self.held.weight
        self.held = self.held._replace(
            forces=tuple(
                np.maximum(0.0, np.asarray(f) + w * np.asarray(g))
                for f, g in zip(self.held.forces, over)
            ),
            pulls=(
                np.maximum(0.0, np.asarray(self.held.pulls) + w * np.asarray(whole))
                if len(whole)
                else self.held.pulls
            ),
        )

    def _repair(self, u, found):
        """Heavier weights, then limits tightened by the little that still passes them, until they
        hold at the case's own step.
        """
        for k in range(ROUNDS):
            if found["excess"] <= TOLERANCE:
                break
            self._push(u)
            if found["excess"] > 10 * TOLERANCE and k < ROUNDS - 3:
                self.held = self.held._replace(weight=self.held.weight * 3.0)
            else:
                sign = np.array([RUNNING[m] for m, _ in self.terms.running])
                running, whole = (np.maximum(np.array(v), 0.0) for v in found["beyond"])
                self.held = self.held._replace(
                    running=self.held.running - sign * running * self.held.room[0],
                    whole=self.held.whole - whole * self.held.room[1],
                )
            u, _ = self._descend(u, 1)
            found = self.check(u, self.interval)
            self._tell(found, 1)
        return found

    def check(self, u, interval):
        """What a run with u (pumps, intervals) comes to at the case's own step; kept if it is the
        best so far.
        """
        clock = self.case.clock
        over, whole, measures = self._look(u, interval, clock, self.asked)
        over, whole = [np.asarray(o) for o in over], [float(w) for w in whole]
        peaks = [float(o.max()) for o in over]
        excess = max([0.0, *peaks, *whole])
        found = {
            "u": u.T,
            "interval": interval,
            "cost": float(sum(w * np.sum(measures[m]) for m, w in self.objective.items())),
            "excess": excess,
            "beyond": (peaks, whole),
            "holds": bool(excess <= TOLERANCE),
            "constraints": self._constraints(over, whole),
        }
        if (
            np.isfinite(found["cost"])
            and (self.best is None or _better(found, self.best))
            and u.shape[1] == self.count
        ):
            self.best = found
        return found

    def _look(self, u, interval, clock, held):
        """What `inputs.look` says of u, given sample by sample: one compiled program for whatever
        interval.
        """
        at = np.minimum(
            np.arange(clock.samples) * (clock.dt / interval) + 1e-6, u.shape[1] - 1
        ).astype(int)
        self.simulations += 1
        loop = dataclasses.replace(open_loop(self.case.loop, u[:, at], clock.dt), plant=self.plant)
        return look(loop, clock, self.terms, u[:, at], held)

    def _constraints(self, over, whole):
        """One dict per limit: name, measure, limit, value, margin, tank or output counted from 1,
        time of the tightest sample.
        """
        rows = []
        for j, (m, i) in enumerate(self.terms.running):
            at, limit, room = (
                int(np.argmax(over[j])),
                float(self.asked.running[j]),
                float(self.asked.room[0][j]),
            )
            rows.append(
                (
                    m,
                    i,
                    limit,
                    limit + RUNNING[m] * over[j][at] * room,
                    -over[j][at] * room,
                    at * self.case.clock.dt,
                )
            )
        for j, (m, i) in enumerate(self.terms.whole):
            limit, room = float(self.asked.whole[j]), float(self.asked.room[1][j])
            rows.append((m, i, limit, limit + whole[j] * room, -whole[j] * room, None))
        return [
            {
                "name": (
                    m if ms.MEASURES[m].per == "run" else f"{m} of {ms.MEASURES[m].per} {i + 1}"
                ),
                "measure": m,
                "limit": limit,
                "value": float(value),
                "margin": float(margin),
                "tank": i + 1 if ms.MEASURES[m].per == "tank" else None,
                "time_s": when,
            }
            for m, i, limit, value, margin, when in rows
        ]

    def _tell(self, found, group):
        if self.progress is not None:
            self.progress(
                {
                    "stage": "bound",
                    "interval_s": self.interval * group,
                    "cost": found["cost"],
                    "excess": found["excess"],
                    "gradients": self.gradients,
                }
            )


def _better(a, b):
    """True if a is to be preferred: held limits first, then the smaller excess, then the lower
    cost.
    """
    if a["holds"] != b["holds"]:
        return a["holds"]
    return a["cost"] < b["cost"] if a["holds"] else a["excess"] < b["excess"]


def _check_served(objective, limits):
    good = [m for m, spec in ms.MEASURES.items() if spec.by_input]
    for m in objective:
        if m not in good:
            raise InputError(
                f"bound of {m}: has no slope in every input; can be made small: {', '.join(good)}"
            )
    for limit in limits:
        if limit.measure not in (*good, *RUNNING):
            raise InputError(
                f"bound under a limit on {limit.measure}: has no slope; can be limited:"
                f" {', '.join([*RUNNING, *good])}"
            )


def _interval(clock, interval):
    """The interval [s]: as asked, or the shortest of 1, 2, 5 times a power of ten that gives at
    most INTERVALS.
    """
    if interval is None:
        least = max(clock.duration / INTERVALS, clock.dt)
        nice = [a * 10.0**b for b in range(-6, 7) for a in (1, 2, 5)]
        fits = [
            v
            for v in nice
            if (1 - 1e-9) * least <= v <= 2.5 * least and _whole_number(v / clock.dt)
        ]
        return float(fits[0] if fits else clock.dt * np.ceil(least / clock.dt - 1e-6))
    good = (
        isinstance(interval, (int, float))
        and not isinstance(interval, bool)
        and clock.dt * (1 - 1e-9) <= interval <= clock.duration
    )
    if not good or not _whole_number(interval / clock.dt):
        raise InputError(
            f"interval = {interval!r} s: must be a whole number of samples of {clock.dt:g} s, at"
            f" most {clock.duration:g} s"
        )
    if clock.duration / interval > 20_000:
        raise InputError(
            f"interval = {interval:g} s: {clock.duration / interval:.0f} intervals; must be at most"
            " 20000"
        )
    return float(interval)


def _search_clock(clock, interval, delay):
    """The clock of the search: up to twenty of the case's samples in one, as intervals and delay
    allow, and a cheaper integrator.
    """
    for f in (20, 10, 5, 4, 2):
        dt = clock.dt * f
        if (clock.samples - 1) / f >= SEARCH_SAMPLES and all(
            _whole_number(v / dt) for v in (interval, delay, clock.duration)
        ):
            return dataclasses.replace(clock, dt=dt, integrator="midpoint")
    return dataclasses.replace(clock, integrator="midpoint")


def _whole_number(x):
    return abs(x - round(x)) <= 1e-6 * max(1.0, abs(x))

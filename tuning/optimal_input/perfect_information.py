"""`bound`: the perfect-information open-loop optimum of a case."""

import dataclasses
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
import scipy  # its parts are imported when they are first used

from jaxtank import measures as ms
from jaxtank.case import Case, check_case
from jaxtank.core.checks import check_whole
from jaxtank.core.errors import InputError, NonFiniteError
from jaxtank.core.labels import entry_label
from jaxtank.core.tree import number
from jaxtank.limits import resolve_limits
from jaxtank.loop import run as lp
from jaxtank.loop.closed_loop import without_noise
from jaxtank.loop.steady import steady_state
from jaxtank.loop.trajectory import Trajectory
from jaxtank.rig import check_objective
from tuning.optimal_input.cost import (
    POINTWISE,
    Lagrangian,
    Terms,
    evaluate,
    open_loop,
    scaled,
    value_and_gradient,
)
from tuning.views import Result

TOLERANCE = 3e-5  # share of a limit by which it may be exceeded: 1e-3 cm of 30 cm

SEARCH_SAMPLES = 4000  # fewest samples of the coarse clock of the search
INTERVALS = 1200  # most intervals of an input by default

MOST_INTERVALS = 20_000

WEIGHT = 1e5  # of a squared excess (share of its limit), for a cost of 1 [-]
CHANGES = {"changes2", "jitter2", "relative_jitter2"}
SENSITIVE = {"u2", "travel", "deviation2", "past2", *CHANGES}  # to inputs within dead zones


class InputProblem:
    """Inputs (pumps, intervals) of a case as unknowns: their box, cost and limits."""

    def __init__(self, case, objective, limits, interval):
        self.case = case
        loop, clock = case.loop, case.clock
        weights = check_objective(case.objective if objective is None else objective)
        self.objective = {m: w for m, w in weights.items() if w > 0}
        lp.check(loop, clock, jax.random.key(0))
        self.limits = resolve_limits(case, limits, governed=False)
        _check_measures(self.objective, self.limits)
        names = (*self.objective, *(limit.measure for limit in self.limits))
        needs = {a for m in names for a in ms.MEASURES[m].needs}
        self.low, self.high = _box(loop.actuator, loop.plant.pumps, needs)
        self.interval = _interval(clock, interval)
        self.count = max(1, int(np.ceil((clock.samples - 1) * clock.dt / self.interval - 1e-6)))
        # changes from sample to sample are fewer at a coarser step
        self.coarse = (
            dataclasses.replace(clock, integrator="midpoint")
            if needs & CHANGES
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
        return np.clip(u, self.low[:, None], self.high[:, None])

    def loop(self):
        """Return the open loop with one input per interval."""
        zeros = np.zeros((self.case.loop.plant.pumps, self.count))
        return dataclasses.replace(
            open_loop(self.case.loop, zeros, self.interval), plant=self.plant
        )

    def value_and_gradient(self, u, lagrangian):
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


@dataclasses.dataclass(frozen=True, kw_only=True, repr=False)
class InputBound(Result):
    """Result of `tuning.bound`; costs and measures are exact, at the case's own step."""

    case: Any
    objective: dict
    cost: float
    measures: dict
    u: np.ndarray
    interval: float
    constraints: list
    holds: bool
    closed_loop: dict | None
    source: str
    grids: list
    slope: float
    iterations: int
    gradients: int
    simulations: int
    interrupted: bool
    wall_s: float

    @property
    def gain_percent(self) -> float | None:
        """Most that another controller could save [% of the cost of the case's own]."""
        closed = self.closed_loop
        if closed is None or not (closed["holds"] and self.holds and closed["cost"] > 0):
            return None
        return 100.0 * (1.0 - self.cost / closed["cost"])

    @property
    def worst(self) -> dict[str, Any] | None:
        """The constraint with the least margin as a share of its limit, None without limits."""
        return min(
            self.constraints, key=lambda c: c["margin"] / (abs(c["limit"]) or 1.0), default=None
        )

    def trajectory(self, save_every: int = 1) -> Trajectory:
        """Return the run with these inputs, as `jaxtank.simulate` does."""
        loop = open_loop(self.case.loop, self.u.T, self.interval)
        return lp.simulate(loop, self.case.clock, save_every=save_every)


def bound(
    case: Case,
    objective: Mapping[str, float] | None = None,
    limits: Mapping[str, Any] | None = None,
    *,
    interval: float | None = None,
    iterations: int = 200,
    progress: Callable | None = None,
) -> InputBound:
    """Compute the perfect-information open-loop optimum: a lower bound on any controller's cost.

        min over u_1 .. u_K in [low, high] of  sum_m weight_m measure_m(run with u)   under the
        limits, at every sample

    The search starts from the inputs of the case's controller and from the steady-state inputs,
    with exact gradients by reverse mode at a coarser clock, and holds limits on levels by one
    multiplier per sample (augmented Lagrangian). The result is checked, and its limits tightened
    until they hold, at the case's own step.

    It is a numerical optimum of a non-convex problem, not a certificate. A controller that samples
    faster than the interval may have a lower cost; if the case's controller has one, its inputs
    are the result. Dead zone, lag and delay act on the inputs; there is no sensor noise. Ctrl-C
    ends the search with the best inputs so far.

    Parameters
    ----------
    case : Case
    objective : mapping, optional
        {measure: weight} as in `tune`; the case's own by default.
    limits : mapping, optional
        {measure: value} as in `tune`; the case's own by default.
    interval : float, optional
        For which each input is held [s], a whole number of the case's samples; by default for 600
        to 1200 intervals, where the case has as many samples.
    iterations : int
        Most iterations of L-BFGS in each round.
    progress : callable, optional
        Called with a dict after every round.

    Returns
    -------
    InputBound

    Raises
    ------
    InputError
        For measures that are maxima, times or counts: they have no derivative by every input
        (levels and errors may be limited, not minimised).
    NonFiniteError
        Where neither start gives a run that stays finite.

    Examples
    --------
    >>> import jax, tuning
    >>> from jaxtank import presets
    >>> jax.config.update("jax_enable_x64", True)
    >>> case = presets.load("gouta2015").cases["backstepping"]
    >>> result = tuning.bound(case)  # doctest: +SKIP
    >>> result.holds, result.cost < result.closed_loop["cost"]  # doctest: +SKIP
    (True, True)
    """
    check_case(case)
    began = time.perf_counter()
    problem = InputProblem(case, objective, limits, interval)
    search = InputSearch(problem, iterations, progress)
    interrupted = False
    try:
        search.run()
    except KeyboardInterrupt:
        interrupted = True
    best, source, closed = search.best, "search", search.closed
    if closed is not None and (best is None or _better(closed, best, strictly=True)):
        best, source = closed, "closed loop"
    if best is None:
        raise NonFiniteError(DIVERGED)
    loop = open_loop(case.loop, best["u"].T, best["interval"])
    names = tuple(m for m in ms.reported() if ms.serves(m, loop) and m != "estimation_rms")
    shared = ("cost", "holds", "constraints")
    return InputBound(
        case=case,
        objective=problem.objective,
        **{name: best[name] for name in (*shared, "u", "interval")},
        measures={m: np.asarray(v) for m, v in lp.evaluate(loop, case.clock, names).items()},
        closed_loop=None if closed is None else {name: closed[name] for name in shared},
        **{name: getattr(search, name) for name in ("grids", "slope", "iterations")},
        **{name: getattr(search, name) for name in ("gradients", "simulations")},
        source=source,
        interrupted=interrupted,
        wall_s=time.perf_counter() - began,
    )


DIVERGED = (
    "neither the inputs of the case's controller nor the steady-state inputs give a finite run"
)

GRIDS = (16, 4, 1)  # intervals that share an input, coarse to fine

SETPOINTS = 8  # most setpoints whose steady-state inputs are computed for a start
ROUNDS = 8  # most rounds of constraint tightening with the finest intervals


class InputSearch:
    """The search of `bound`: the best inputs so far, multipliers and counters."""

    def __init__(self, problem: InputProblem, iterations=200, progress=None):
        if jax.numpy.result_type(float) != np.float64:
            raise InputError("bound needs float64: jax.config.update('jax_enable_x64', True)")
        check_whole("iterations", iterations, 1, 100_000)
        self.problem, self.most, self.progress = problem, iterations, progress
        self.lagrangian = problem.start
        self.best, self.closed, self.grids, self.slope = None, None, [], np.nan
        self.iterations, self.gradients, self.simulations = 0, 0, 0

    def run(self):
        """Search with coarse, then finer intervals; repeat the finest until the limits hold."""
        problem = self.problem
        grids = [g for g in GRIDS if g == 1 or problem.count >= 20 * g]
        u = self._start(grids[0])
        for group in grids:
            # smoothing shrinks with the interval: a wide one makes a jump cut into small ones free
            width, error = problem.start.smoothing
            width = width * group * group / GRIDS[0]
            self.lagrangian = self.lagrangian._replace(smoothing=(width, error))
            self._rescale(u)
            u, check = self._settle(u, group, 5 if group == 1 else 2)
            if group == 1:
                check = self._repair(u, check)
            grid = {name: check[name] for name in ("cost", "excess")}
            self.grids.append({"interval_s": problem.interval * group, **grid})

    def _start(self, group):
        """Return the better of two searches with the coarsest intervals."""
        starts = [s for s in (self._closed_loop(), self._steady()) if s is not None]
        self._rescale(starts[0])
        ends = [self._descend(u, group) for u in starts]
        if not any(np.isfinite(cost) for _, cost in ends):
            raise NonFiniteError(DIVERGED)
        return min(ends, key=lambda pair: pair[1] if np.isfinite(pair[1]) else np.inf)[0]

    def _closed_loop(self):
        """Return the interval means of the case's own inputs, None if its run diverges."""
        problem = self.problem
        loop, clock = problem.case.loop, problem.case.clock
        try:
            applied = np.asarray(lp.simulate(without_noise(loop), clock).applied).T
        except NonFiniteError:
            return None
        self.simulations += 1
        check = self.check(applied, clock.dt)
        self.closed = check if np.isfinite(check["cost"]) else None
        at = np.arange(clock.samples) * clock.dt / problem.interval + 1e-6
        at = np.minimum(at, problem.count - 1).astype(int)
        samples = np.bincount(at, minlength=problem.count)
        means = [np.bincount(at, row, problem.count) / samples for row in applied]
        return problem.project(np.stack(means))

    def _steady(self):
        """Return steady-state inputs of the nearest of a few setpoints."""
        problem, loop = self.problem, self.problem.case.loop
        clock = dataclasses.replace(problem.coarse, dt=problem.interval)
        r = np.array(loop.reference.sample(clock)[0])[:, : problem.count]
        known = np.unique(r, axis=1)
        known, steady = known[:, :: -(-known.shape[1] // SETPOINTS)].T, []
        for setpoint in known:
            try:
                steady.append(steady_state(loop, setpoint)[1])
            except InputError:  # none at this setpoint
                steady.append(0.5 * (problem.low + problem.high))
        nearest = np.argmin(((r[:, None, :] - known.T[:, :, None]) ** 2).sum(axis=0), axis=0)
        return problem.project(np.array(steady)[nearest].T)

    def _rescale(self, u):
        """Scale the cost of u to 1, and keep the multipliers relative to the cost."""
        before = self.lagrangian
        bare = scaled(before, 0.0)._replace(weight=np.float64(1e-30), scale=np.float64(1.0))
        cost = float(self.problem.value_and_gradient(u, bare)[0])
        self.gradients += 1
        if np.isfinite(cost) and cost > 1e-12:
            ratio = float(before.scale) / cost
            self.lagrangian = scaled(before, ratio)._replace(scale=np.float64(cost))

    def _descend(self, u, group):
        """Return (inputs, search cost) of L-BFGS from u, with `group` intervals as one."""
        problem = self.problem
        low, span = problem.low[:, None], (problem.high - problem.low)[:, None]
        edges = np.arange(0, problem.count, group)
        sizes = np.diff(np.append(edges, problem.count))
        inputs = lambda z: low + span * np.repeat(z.reshape(len(low), -1), sizes, axis=1)

        def cost(z):
            self.gradients += 1
            value, gradient = problem.value_and_gradient(inputs(z), self.lagrangian)
            gradient = (np.add.reduceat(np.asarray(gradient), edges, axis=1) * span).ravel()
            if not (np.isfinite(value) and np.all(np.isfinite(gradient))):
                return 1e12, np.zeros_like(gradient)
            return float(value), gradient

        z = (np.add.reduceat(u, edges, axis=1) / sizes - low) / span
        z, value, gradient, count = minimise(cost, np.clip(z, 0.0, 1.0).ravel(), self.most)
        self.iterations += count
        self.slope = float(np.max(np.abs(z - np.clip(z - gradient, 0.0, 1.0))))
        return inputs(z), value

    def _settle(self, u, group, rounds):
        """Return (inputs, their check) after rounds of descent and new multipliers."""
        # The weight is raised where an excess does not shrink.
        last, before, check = np.inf, np.inf, {}
        for _ in range(rounds):
            u, check = self._round(u, group)
            small = abs(check["cost"] - before) <= 2e-3 * abs(check["cost"])
            if check["excess"] <= 30 * TOLERANCE and small:
                break
            before = check["cost"]
            if not self.problem.limits:
                continue
            self._update_multipliers(u)
            if check["excess"] > max(0.5 * last, TOLERANCE):
                self.lagrangian = self.lagrangian._replace(weight=self.lagrangian.weight * 3.0)
            last = check["excess"]
        return u, check

    def _round(self, u, group):
        """Return (inputs, their check) of a descent from u, and report it."""
        u, _ = self._descend(u, group)
        check = self.check(u, self.problem.interval)
        if self.progress is not None:
            state = {"stage": "bound", "interval_s": self.problem.interval * group}
            state |= {"cost": check["cost"], "excess": check["excess"]}
            self.progress(state | {"gradients": self.gradients})
        return u, check

    def _update_multipliers(self, u):
        """Set multipliers to multiplier + weight * excess, not below 0."""
        before, problem = self.lagrangian, self.problem
        self.simulations += 1
        over, integral, _ = problem.excesses(u, problem.interval, problem.coarse, before)
        raised = lambda f, g: np.maximum(0.0, np.asarray(f) + before.weight * np.asarray(g))
        sums = before.integral_multipliers
        self.lagrangian = before._replace(
            multipliers=tuple(map(raised, before.multipliers, over)),
            integral_multipliers=raised(sums, integral) if len(integral) else sums,
        )

    def _repair(self, u, check):
        """Return the check of inputs that hold the limits at the case's step, or None."""
        for k in range(ROUNDS):
            if check["excess"] <= TOLERANCE:
                break
            self._update_multipliers(u)
            before = self.lagrangian
            if check["excess"] > 10 * TOLERANCE and k < ROUNDS - 3:
                self.lagrangian = before._replace(weight=before.weight * 3.0)
            else:
                sign = np.array([POINTWISE[m] for m, _ in self.problem.terms.pointwise])
                peaks, integral = (np.maximum(np.array(v), 0.0) for v in check["beyond"])
                self.lagrangian = before._replace(
                    pointwise=before.pointwise - sign * peaks * before.sizes[0],
                    integral=before.integral - integral * before.sizes[1],
                )
            u, check = self._round(u, 1)
        return check

    def check(self, u, interval):
        """Return `problem.check` of the inputs; keep it in `best` if it is the best so far."""
        self.simulations += 1
        check = self.problem.check(u, interval)
        full = u.shape[1] == self.problem.count
        if full and np.isfinite(check["cost"]) and (not self.best or _better(check, self.best)):
            self.best = check
        return check


def _better(a, b, strictly=False):
    """Return whether a is preferred: limits hold, then the smaller excess, then the cost."""
    if a["holds"] != b["holds"]:
        return a["holds"]
    if not a["holds"]:
        return not strictly and a["excess"] < b["excess"]
    return a["cost"] < b["cost"]


MEMORY = 12  # pairs of steps and gradient changes kept


def minimise(function, z, iterations, tolerance=1e-8):
    """Return (z, value, gradient, iterations) of a local minimum over the unit cube: L-BFGS-B."""
    options = {"maxiter": iterations, "maxcor": MEMORY, "ftol": tolerance, "gtol": 0.0}
    done = scipy.optimize.minimize(
        function, z, jac=True, method="L-BFGS-B", bounds=[(0.0, 1.0)] * len(z), options=options
    )
    return done.x, done.fun, done.jac, done.nit

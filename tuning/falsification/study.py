"""Find the plant, the start and the reading errors that drive levels highest."""

import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxtank.case import Case, check_case
from jaxtank.core.checks import check_whole
from jaxtank.core.errors import InputError
from jaxtank.core.numerics import lower_clip
from jaxtank.loop.closed_loop import faulty_sensors
from jaxtank.loop.validation import check
from jaxtank.safety.certificate import TankCertificate
from jaxtank.safety.of_case import certificates_of
from jaxtank.safety.outlet_design import UNKNOWN
from jaxtank.safety.outlets import OutletFilter
from jaxtank.safety.worst_case import rates_of, rise
from tuning.falsification.attacked import (
    Attacked,
    batch_size,
    coefficients_of,
    filter_or_design,
    programs,
)
from tuning.falsification.result import Attack, Found
from tuning.problem.scenarios import noisy

PUMPS, STARTS = ("own", "full", "random"), ("any", "own")


def attack(
    case: Case,
    distributions: Mapping[str, Any] | None = None,
    starts: int = 8,
    iterations: int = 12,
    seed: int = 0,
    *,
    windows: int = 4,
    draws: int = 64,
    pumps: str = "own",
    start: str = "any",
    noise: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Attack:
    """Find the highest level of each tank over plants, starts and reading errors of a box.

    Random draws first, half of them corners of the box; then, for each tank, ascent along the
    signs of the slopes of its highest level from the `starts` best of them. What it finds is a
    lower bound of the worst; only what `jaxtank show` reports as proved is proved.

    Rims are no physics here: a level that stops at its rim cannot be seen to pass it.

    Parameters
    ----------
    case : Case
        With a safety filter or without.
    distributions : dict or None
        {dotted name: distribution}, whose ranges are the box (each entry on its own); None: the box
        that the case's safety filter is, or would be, designed for.
    starts : int
        Draws from which the ascent of each tank starts.
    iterations : int
        Steps of the ascent.
    seed : int
        Of the draws.
    windows : int
        Windows of equal length in each of which a coefficient of the flows has its own value.
    draws : int
        Random draws.
    pumps : {"own", "full", "random"}
        What commands the pumps, through the safety filter: the case's controller, full command, or
        commands that switch at random and are changed by the ascent too.
    start : {"any", "own"}
        Levels at t = 0: any up to the limits (with a filter: from which it can hold them), or the
        case's own.
    noise : bool
        Whether reading errors may change from sample to sample, or are constant.
    progress : callable or None
        Called with (steps done, steps in all).

    Returns
    -------
    Attack

    Raises
    ------
    InputError
        Before anything is run.

    Examples
    --------
    >>> import tuning
    >>> from jaxtank import presets, rig
    >>> case = rig.set_values(presets.find("cascaded/pi"), {"clock.duration": 40.0})
    >>> attack = tuning.attack(case, starts=1, draws=2, iterations=0, windows=1)
    >>> [run.tank for run in attack.found]
    [0, 1]
    """
    check_case(case, seed)
    began = time.perf_counter()
    counts = {"starts": starts, "iterations": iterations, "windows": windows, "draws": draws}
    for name, value in {**counts, "seed": seed}.items():
        low = 0 if name in ("seed", "iterations") else 1
        check_whole(name, value, low, 2**31 - 1 if name == "seed" else 10**6)
    for name, value, allowed in (("pumps", pumps, PUMPS), ("start", start, STARTS)):
        if value not in allowed:
            raise InputError(f"{name} = {value!r}: must be one of {', '.join(allowed)}")
    check(case.loop, case.clock, jax.random.key(0) if noisy(case) else None)
    if faulty_sensors(case.loop):
        raise InputError(
            "attack searches the errors of readings itself: leave out [[fault]] with sensor"
        )
    limits = limits_of(case)
    attacked = Attacked(
        case=case,
        coefficients=coefficients_of(case, distributions),
        windows=windows,
        pumps=pumps,
        start=start,
        noise=noise,
        ceiling=limits.ceiling,
    )
    search = _Search(attacked, draws, starts, iterations, seed, progress)
    points, levels = search.screen()
    climbed = search.climb(points, levels)
    rises = _rises(case, np.maximum(limits.limit, climbed.level))
    rows = limits.rows or (None,) * len(rises)
    return Attack(
        attacked=attacked,
        found=tuple(
            Found(
                tank=i,
                limit=float(limits.limit[i]),
                certified=row and row.certified,
                reason=row.reason if row else "",
                starts=row.starts if row else "",
                nominal=float(levels[0, i]),
                drawn=float(levels[1:, i].max()),
                level=float(climbed.level[i]),
                time_s=float(climbed.time[i]),
                rise=float(rises[i]),
                values=climbed.values[i],
            )
            for i, row in enumerate(rows)
        ),
        history=climbed.history,
        starts=starts,
        draws=draws,
        seed=seed,
        wall_s=time.perf_counter() - began,
    )


class Limits(NamedTuple):
    """Limits (n,) [cm], levels (n,) below which starts lie [cm], certificates (None: no filter)."""

    limit: np.ndarray
    ceiling: np.ndarray
    rows: tuple[TankCertificate, ...] | None


def limits_of(case: Case) -> Limits:
    """Return the level limits of a case: from its safety filter, else max_level and the rims."""
    loop, safety_filter = case.loop, case.loop.safety_filter
    if safety_filter is None:
        rim, top = np.asarray(loop.plant.rim, dtype=float), case.limits.get("max_level", "rim")
        limit = rim if isinstance(top, str) else np.minimum(rim, np.asarray(top, dtype=float))
        return Limits(limit, limit, None)
    limit = np.asarray(safety_filter.limit, dtype=float)
    if case.safety is None:  # made by hand
        return Limits(limit + np.asarray(getattr(safety_filter, "spare", 0.0)), limit, None)
    rows = certificates_of(case)
    return Limits(np.array([row.limit for row in rows]), limit, rows)


def _rises(case, reach):
    """Largest rises (n,) of levels below `reach` between two samples [cm]; nan for no network."""
    safety_filter = filter_or_design(case)
    if safety_filter is None:
        return np.full(len(reach), np.nan)
    if isinstance(safety_filter, OutletFilter):
        return np.where(safety_filter.climb < UNKNOWN, safety_filter.climb, np.nan)
    rates = rates_of(safety_filter.least, safety_filter.most, safety_filter.inflow, 0.0)
    high, rises = np.asarray(case.loop.actuator.high, dtype=float), []
    for i in range(len(reach)):
        pumped = sum(b * max(high[j], 0.0) for j, (_, b) in rates.pumps[i].items())
        fastest = pumped + float(lower_clip(rise(rates, i, 0.0, reach), 0.0))
        rises.append(float(fastest) * case.clock.dt)
    return np.array(rises)


class _Climbed(NamedTuple):
    """The highest run of each tank: values, level, time; and levels by step (steps + 1, n)."""

    values: list[dict[str, np.ndarray]]
    level: np.ndarray
    time: np.ndarray
    history: np.ndarray


class _Search:
    """Draws and ascents of one attack, in batches of one size each."""

    def __init__(self, attacked, draws, starts, iterations, seed, progress):
        self.attacked, self.draws, self.starts = attacked, draws, starts
        self.iterations, self.rng = iterations, np.random.default_rng(seed)
        self.run, self.slopes = programs(attacked)
        progress = progress or (lambda done, total: None)
        self.report = lambda done: progress(done, iterations + 2)

    def values(self, z):
        """Values (runs, ...) of variables (runs, ...) in the unit cube."""
        return jax.tree.map(np.asarray, jax.jit(jax.vmap(self.attacked.values))(z))

    def levels(self, values):
        """((runs, n) highest levels [cm], (runs, n) their times [s]) of values (runs, ...)."""
        return _in_batches(self.run, batch_size(self.attacked, min(64, self.draws + 1)), values)

    def screen(self):
        """Return (variables of the draws, levels (draws + 1, n)); row 0 is the unchanged case."""
        points = _points(self.attacked, self.draws, self.rng)
        values, nominal = self.values(points), self.attacked.nominal()
        first = {k: np.broadcast_to(nominal[k], v.shape[1:])[None] for k, v in values.items()}
        levels = self.levels({k: np.concatenate([first[k], v]) for k, v in values.items()})[0]
        self.report(1)
        return points, levels

    def climb(self, points, levels):
        """Return the _Climbed of ascents from the best of the draws."""
        starts, n = min(self.starts, self.draws), levels.shape[1]
        order = np.argsort(-levels[1:], axis=0, kind="stable")[:starts].T.ravel()  # (n starts,)
        tanks = np.repeat(np.arange(n), starts)
        z, history = {k: v[order] for k, v in points.items()}, levels[1:][order, tanks][None]
        if self.iterations:
            size = batch_size(self.attacked, len(tanks))

            def slopes(at):
                (value, _), slope = _in_batches(self.slopes, size, at, tanks)
                return value, slope

            z, _, history = ascend(slopes, z, self.iterations, lambda done: self.report(done + 2))
        values = self.values(z)
        highest, times = self.levels(values)
        best = highest.argmax(axis=0)  # the ascent for one tank may serve another better
        chosen = [{k: v[i] for k, v in values.items()} for i in best]
        self.report(self.iterations + 2)
        at = (best, np.arange(n))
        history = history.reshape(-1, n, starts).max(axis=2)
        return _Climbed(chosen, highest[at], times[at], history)


def _in_batches(function, size, *arrays):
    """`function` of trees (runs, ...), `size` at a time; the last row fills the last batch."""
    runs = len(jax.tree.leaves(arrays)[0])
    rows = [np.minimum(np.arange(i, i + size), runs - 1) for i in range(0, runs, size)]
    parts = [function(*jax.tree.map(lambda v, r=r: v[r], arrays)) for r in rows]
    return jax.tree.map(lambda *v: np.concatenate([np.asarray(p) for p in v])[:runs], *parts)


def _points(attacked, draws, rng):
    """{variable: (draws, ...)}: half at corners of the box; half constant in time."""
    points = {}
    corner, steady = np.arange(draws) % 2 == 0, np.arange(draws) // 2 % 2 == 0
    for name, shape in attacked.shapes.items():
        z = rng.random((draws, *shape))
        if name == "start":
            z = np.sqrt(z)  # near the limits more often
        elif name == "noise":
            z = np.where(_wide(steady, z), 0.5, np.round(z))
        else:
            z = np.where(_wide(corner, z), np.round(z), z)
        if name == "varying":
            z = np.where(_wide(steady, z), z[..., :1], z)
        points[name] = z
    return points


SHORTEST = 1 / 64  # step at which a point counts as the top of its hill


class Ascent(NamedTuple):
    """Points (runs, ...) after an ascent, values (runs,), and values (iterations + 1, runs)."""

    z: dict[str, np.ndarray]
    value: np.ndarray
    history: np.ndarray


def ascend(
    slopes: Callable, z: dict[str, np.ndarray], iterations: int, report: Callable | None = None
) -> Ascent:
    """Return points in the unit cube with higher values than at `z`."""
    # Each point moves by its own step along the signs of its slopes, z + step sign(dz) cut to the
    # cube: a step of 1 goes to the corner that a linear function is highest at. A point that does
    # not rise stays, and its step is halved.
    value, slope = slopes(z)
    step, history = np.ones(len(value)), [value]
    for done in range(iterations):
        if report is not None:
            report(done)
        # a slope that is not finite counts as 0
        signs = {k: np.sign(np.where(np.isfinite(v), v, 0.0)) for k, v in slope.items()}
        moved = {k: np.clip(v + _wide(step, v) * signs[k], 0.0, 1.0) for k, v in z.items()}
        moves = [np.any(np.reshape(moved[k] != v, (len(v), -1)), axis=1) for k, v in z.items()]
        active = (step >= SHORTEST) & np.any(moves, axis=0)
        if not active.any():
            break
        new, new_slope = slopes(moved)
        better = active & (new > value)
        z = {k: np.where(_wide(better, v), moved[k], v) for k, v in z.items()}
        slope = {k: np.where(_wide(better, v), new_slope[k], v) for k, v in slope.items()}
        value = np.where(better, new, value)
        step = np.where(better, step, 0.5 * step)
        history.append(value)
    return Ascent(z, value, np.stack(history))


def _wide(row, like):
    """(runs,) as an array that is multiplied with `like` (runs, ...)."""
    return row.reshape(-1, *([1] * (np.ndim(like) - 1)))

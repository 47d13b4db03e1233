"""Find the plant, the start and the reading errors that drive levels highest."""

import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxtank.case import Case
from jaxtank.core.errors import InputError
from jaxtank.core.numerics import lower_clip
from jaxtank.loop.validation import check
from jaxtank.safety.certificate import TankCertificate
from jaxtank.safety.of_case import certificates_of
from jaxtank.safety.worst_case import rates_of, rise
from tuning.falsification.attacked import Attacked, batch_size, coefficients_of, programs
from tuning.falsification.result import Attack, Found
from tuning.problem.scenarios import noisy
from tuning.uncertainty.sampling import check_whole

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
    >>> found = tuning.attack(case, starts=1, draws=2, iterations=0, windows=1)
    >>> [one.tank for one in found.found]
    [0, 1]
    """
    began = time.perf_counter()
    counts = {"starts": starts, "iterations": iterations, "windows": windows, "draws": draws}
    _check_arguments({**counts, "seed": seed}, pumps, start)
    check(case.loop, case.clock, jax.random.key(0) if noisy(case) else None)
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
    drawn, levels = search.screen()
    climbed = search.climb(drawn, levels)
    return Attack(
        attacked=attacked,
        found=_found(case, limits, levels, climbed),
        history=climbed.history,
        starts=starts,
        draws=draws,
        seed=seed,
        wall_s=time.perf_counter() - began,
    )


def _check_arguments(counts, pumps, start):
    """Raise InputError for a number or a word that is none of those allowed."""
    for name, value in counts.items():
        low = 0 if name in ("seed", "iterations") else 1
        check_whole(name, value, low, 2**31 - 1 if name == "seed" else 10**6)
    for name, value, allowed in (("pumps", pumps, PUMPS), ("start", start, STARTS)):
        if value not in allowed:
            raise InputError(f"{name} = {value!r}: must be one of {', '.join(allowed)}")


def _found(case, limits, levels, climbed):
    """The Found of each tank. levels: (draws + 1, n), first those of the case as it is."""
    rises = _rises(case, np.maximum(limits.limit, climbed.level))
    return tuple(
        Found(
            tank=i,
            limit=float(limits.limit[i]),
            certified=None if limits.rows is None else limits.rows[i].certified,
            reason="" if limits.rows is None else limits.rows[i].reason,
            starts="" if limits.rows is None else limits.rows[i].starts,
            nominal=float(levels[0, i]),
            drawn=float(levels[1:, i].max()),
            level=float(climbed.level[i]),
            time_s=float(climbed.time[i]),
            rise=float(rises[i]),
            values=climbed.values[i],
        )
        for i in range(case.loop.plant.tanks)
    )


class Limits(NamedTuple):
    """(n,) limits [cm], (n,) levels below which starts lie [cm], and the certificates, None without
    a filter whose settings are known.
    """

    limit: np.ndarray
    ceiling: np.ndarray
    rows: tuple[TankCertificate, ...] | None


def limits_of(case: Case) -> Limits:
    """Return the level limits of a case: those of its safety filter, or max_level and the rims."""
    loop, guard = case.loop, case.loop.safety_filter
    if guard is None:
        rim = np.asarray(loop.plant.rim, dtype=float)
        given = case.limits.get("max_level", "rim")
        limit = rim if isinstance(given, str) else np.minimum(rim, np.asarray(given, dtype=float))
        return Limits(limit, limit, None)
    limit = np.asarray(guard.limit, dtype=float)
    if case.safety is None:  # made by hand
        return Limits(limit + np.asarray(guard.spare), limit, None)
    rows = certificates_of(case)
    return Limits(np.array([row.limit for row in rows]), limit, rows)


def _rises(case, reach):
    """(n,) what each level can rise by between two samples [cm] while no level passes `reach` (n,)
    [cm]: b_max u_max dt and what flows in; nan for a plant that is no network.
    """
    guard = case.loop.safety_filter
    if guard is None:
        try:
            guard, _ = case.safety_design()
        except InputError:
            return np.full(len(reach), np.nan)
    rates = rates_of(guard.least, guard.most, guard.inflow, 0.0)
    high, found = np.asarray(case.loop.actuator.high, dtype=float), []
    for i in range(len(reach)):
        pumped = sum(b * max(high[j], 0.0) for j, (_, b) in rates.pumps[i].items())
        fastest = pumped + float(lower_clip(rise(rates, i, 0.0, reach), 0.0))
        found.append(float(fastest) * case.clock.dt)
    return np.array(found)


class _Climbed(NamedTuple):
    """The highest run of each tank: its values, level and time; highest level of each tank by step
    of the ascent (steps + 1, n)."""

    values: list[dict[str, np.ndarray]]
    level: np.ndarray
    time: np.ndarray
    history: np.ndarray


class _Search:
    """Draws and ascents of one attack, in batches of one size each."""

    def __init__(self, attacked, draws, starts, iterations, seed, progress):
        self.attacked, self.draws, self.starts = attacked, draws, starts
        self.iterations, self.progress = iterations, progress
        self.rng = np.random.default_rng(seed)
        self.tanks = attacked.case.loop.plant.tanks
        self.run, self.slopes = programs(attacked)
        self.total = iterations + 2

    def report(self, done):
        """Call `progress` with the steps done and their number."""
        if self.progress is not None:
            self.progress(done, self.total)

    def levels(self, values):
        """((runs, n) highest levels [cm], (runs, n) their times [s]) of values (runs, ...)."""
        runs = len(values["x0"])
        size = batch_size(self.attacked, min(64, self.draws + 1))
        found = [self.run(part) for part in _batches(values, size)]
        return tuple(np.concatenate([np.asarray(f[k]) for f in found])[:runs] for k in (0, 1))

    def screen(self):
        """(variables of the draws, levels (draws + 1, n), first those of the case as it is)."""
        drawn = _drawn(self.attacked, self.draws, self.rng)
        values = jax.tree.map(np.asarray, jax.jit(jax.vmap(self.attacked.values))(drawn))
        own = self.attacked.nominal()
        like = {k: np.broadcast_to(own[k], v.shape[1:])[None] for k, v in values.items()}
        both = {k: np.concatenate([like[k], v]) for k, v in values.items()}
        levels, _ = self.levels(both)
        self.report(1)
        return drawn, levels

    def climb(self, drawn, levels):
        """Return the _Climbed of ascents from the best of the draws."""
        starts, n = min(self.starts, self.draws), self.tanks
        order = np.argsort(-levels[1:], axis=0, kind="stable")[:starts].T  # (n, starts)
        z = {k: v[order.ravel()] for k, v in drawn.items()}
        tanks = np.repeat(np.arange(n), starts)
        best, history = z, levels[1:][order.ravel(), tanks][None]
        if self.iterations:
            done = ascend(lambda at: self._sloped(at, tanks), z, self.iterations, self._stepped)
            best, history = done.z, done.history
        values = jax.tree.map(np.asarray, jax.jit(jax.vmap(self.attacked.values))(best))
        found, times = self.levels(values)
        own = found.argmax(axis=0)  # the ascent for one tank may serve another better
        chosen = [{k: v[own[i]] for k, v in values.items()} for i in range(n)]
        self.report(self.total)
        at = (own, np.arange(n))
        history = history.reshape(-1, n, starts).max(axis=2)
        return _Climbed(chosen, found[at], times[at], history)

    def _stepped(self, done):
        self.report(done + 2)

    def _sloped(self, z, tanks):
        """(values (runs,), slopes) of variables (runs, ...) for the tanks (runs,)."""
        runs = len(tanks)
        size = batch_size(self.attacked, runs)
        parts = [
            self.slopes(one, at)
            for one, at in zip(_batches(z, size), _batches({"tanks": tanks}, size))
            for at in [at["tanks"]]
        ]
        value = np.concatenate([np.asarray(f[0][0]) for f in parts])[:runs]
        slope = {k: np.concatenate([np.asarray(f[1][k]) for f in parts])[:runs] for k in z}
        return value, slope


def _batches(arrays, size):
    """[arrays (size, ...)] of arrays (runs, ...), the last row repeated to fill the last batch."""
    runs = len(next(iter(arrays.values())))
    rows = [np.minimum(np.arange(i, i + size), runs - 1) for i in range(0, runs, size)]
    return [{k: v[r] for k, v in arrays.items()} for r in rows]


def _drawn(attacked, draws, rng):
    """{variable: (draws, ...)}: half of the draws at corners of the box, half inside; half of them
    with coefficients and reading errors that are constant in time.
    """
    found, shapes = {}, attacked.shapes
    corner, steady = np.arange(draws) % 2 == 0, np.arange(draws) // 2 % 2 == 0
    for name, shape in shapes.items():
        z = rng.random((draws, *shape))
        wide = (-1, *([1] * len(shape)))
        if name == "start":
            z = np.sqrt(z)  # near the limits more often
        elif name == "noise":
            z = np.where(steady.reshape(wide), 0.5, np.round(z))
        else:
            z = np.where(corner.reshape(wide), np.round(z), z)
        if name == "varying":
            z = np.where(steady.reshape(wide), z[..., :1], z)
        found[name] = z
    return found


SHORTEST = 1 / 64
"""Step at which a point counts as the top of its hill."""


class Ascent(NamedTuple):
    """Points (runs, ...) after an ascent, their values (runs,), and the values (iterations + 1,
    runs) on the way."""

    z: dict[str, np.ndarray]
    value: np.ndarray
    history: np.ndarray


def ascend(
    slopes: Callable, z: dict[str, np.ndarray], iterations: int, report: Callable | None = None
) -> Ascent:
    """Return points with higher values than those of `z`, in the unit cube."""
    # Each point moves by its own step along the signs of its slopes, z + step sign(dz) cut to the
    # cube: a step of 1 goes to the corner that a linear function is highest at. A point that does
    # not rise stays, and its step is halved.
    value, slope = slopes(z)
    step, history = np.ones(len(value)), [value]
    for done in range(iterations):
        if report is not None:
            report(done)
        tried = {k: _moved(z[k], slope[k], step) for k in z}
        moves = [np.any(_flat(tried[k]) != _flat(z[k]), axis=1) for k in z]
        active = (step >= SHORTEST) & np.any(moves, axis=0)
        if not active.any():
            break
        new, new_slope = slopes(tried)
        better = active & (new > value)
        z = {k: np.where(_wide(better, v), tried[k], v) for k, v in z.items()}
        slope = {k: np.where(_wide(better, v), new_slope[k], v) for k, v in slope.items()}
        value = np.where(better, new, value)
        step = np.where(better, step, 0.5 * step)
        history.append(value)
    return Ascent(z, value, np.stack(history))


def _wide(row, like):
    """(runs,) as an array that is multiplied with `like` (runs, ...)."""
    return row.reshape(-1, *([1] * (np.ndim(like) - 1)))


def _moved(z, slope, step):
    """z + step sign(slope), cut to the unit cube; a slope that is not finite counts as 0."""
    sign = np.sign(np.where(np.isfinite(slope), slope, 0.0))
    return np.clip(z + _wide(step, z) * sign, 0.0, 1.0)


def _flat(rows):
    return np.reshape(rows, (len(rows), -1))

"""Find the plant, the start and the reading errors that drive levels highest."""

import dataclasses
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxtank.case import Case, check_case
from jaxtank.core.checks import check_choice, check_whole
from jaxtank.core.errors import InputError
from jaxtank.core.numerics import lower_clip
from jaxtank.core.tree import with_values
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.limits import lowest_levels
from jaxtank.loop.closed_loop import faulty_sensors
from jaxtank.loop.run import evaluate_and_flag
from jaxtank.loop.validation import check
from jaxtank.plants.faults import Faults
from jaxtank.safety.box import beyond_box
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
    of_plant,
    own_coefficients,
    programs,
)
from tuning.problem.scenarios import noisy
from tuning.uncertainty.batches import in_batches
from tuning.views import Result

TOLERANCE = 1e-9  # share of a limit by which rounding may pass it


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Found:
    """The highest level that an attack found in one tank, and the run that has it."""

    tank: int
    limit: float
    certified: bool | None
    reason: str
    starts: str
    nominal: float
    drawn: float
    level: float
    time_s: float
    rise: float
    values: Mapping[str, np.ndarray] = dataclasses.field(repr=False)

    @property
    def margin(self) -> float:
        """Distance of the level found to the limit [cm], negative where it passes."""
        return self.limit - self.level

    @property
    def passed(self) -> bool:
        return self.level > self.limit * (1.0 + TOLERANCE)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Attack(Result):
    """The worst that was found of a case; made by `tuning.attack`.

    Attributes
    ----------
    attacked : Attacked
        The case as a function of the variables of the attack.
    found : tuple of Found
        One for each tank.
    history : (iterations + 1, tanks) array
        Highest level after each step of the ascent [cm].
    lowest : (tanks,) array or None
        Lowest levels of the case's own run [cm], where it has limits from below, which are not
        attacked.
    starts, draws, seed : int
    wall_s : float
        [s].
    """

    attacked: Attacked
    found: tuple[Found, ...]
    history: np.ndarray
    lowest: np.ndarray | None
    starts: int
    draws: int
    seed: int
    wall_s: float

    @property
    def case(self) -> Any:
        """The case that was attacked, without overflow."""
        return self.attacked.case

    @property
    def passed(self) -> list[Found]:
        """The runs in which a level passed its limit."""
        return [run for run in self.found if run.passed]

    @property
    def below(self) -> dict[int, float]:
        """{tank that falls below a limit in the case's own run: its lowest level}."""
        if self.lowest is None:
            return {}
        pairs = zip(self.lowest, lowest_levels(self.attacked.original))
        return {i: float(level) for i, (level, limit) in enumerate(pairs) if level < limit}

    @property
    def worst(self) -> Found:
        """The run with the smallest margin to its limit, as a share of it."""
        return max(self.found, key=lambda run: run.level / run.limit)

    def parameters(self, run: Found) -> dict[str, Any]:
        """Return {dotted name: value, or the list of its values in windows of equal length} of a
        run. "sensor.offset[i]" is the mean error of a reading [cm].
        """
        values: dict[str, Any] = {}
        for c, value in zip(self.attacked.coefficients, _rows(run)):
            same = np.all(value == value[0])
            values[c.name] = float(value[0]) if same else [float(v) for v in value]
        values |= {f"x0[{i}]": float(h) for i, h in enumerate(run.values["x0"])}
        if "error" in run.values:
            mean = np.mean(run.values["error"], axis=1)
            values |= {f"sensor.offset[{i}]": float(v) for i, v in enumerate(mean)}
        return values

    def loop(self, run: Found) -> Any:
        """Return the ClosedLoop of a run."""
        return self.attacked.loop_of(jax.tree.map(np.asarray, dict(run.values)))

    def rig(self, run: Found) -> Any:
        """Return a run as a Case that a rig file can describe: the nominal plant with faults from
        t = 0, its start, and the mean error of each reading as the sensor's offset. Errors that
        change from sample to sample, an ADC's range and commands in place of the controller's have
        no place in a rig file (`not_in_rig`).
        """
        case, values = self.case, run.values
        if self.attacked.pumps != "own":
            case = self.attacked.original
        loop: Any = case.loop
        rows = zip(self.attacked.coefficients, _rows(run))
        loop = with_values(loop, {c.name: v[0] for c, v in rows if not of_plant(c)})
        changes: dict[str, Any] = {"x0": np.asarray(values["x0"]), "faults": self._faults(run)}
        safety = case.safety
        if "error" in values and isinstance(loop.sensor, LevelSensor):
            noise, offset = np.zeros(loop.plant.tanks), np.mean(values["error"], axis=1)
            changes["sensor"] = dataclasses.replace(loop.sensor, noise=noise, offset=offset)
            if safety is not None:  # as for the sensor of the case, not for one with this offset
                rates = np.unique(loop.safety_filter.rate)
                safety = {**safety, "band": np.asarray(loop.safety_filter.band)}
                safety |= {"rate": float(rates[0])} if len(rates) == 1 else {}
        return case.replace(loop=dataclasses.replace(loop, **changes), safety=safety)

    def not_in_rig(self, run: Found) -> list[str]:
        """Return, in words, the parts of a run that no rig file can describe."""
        error, missing = run.values.get("error"), []
        if error is not None and np.ptp(error, axis=1).max() > 0.0:
            missing.append("reading errors that change from sample to sample (their mean is)")
        if error is not None and getattr(self.case.loop.sensor, "bits", 0):
            missing.append("readings without the steps of the ADC")
        if self.attacked.pumps != "own":
            missing.append("commands in place of the controller's")
        return missing

    def _faults(self, run):
        """Return the Faults of the plant in a run, equal windows joined, then those of the case."""
        clock, of_case = self.case.clock, self.case.loop.faults
        edges = np.linspace(0.0, clock.duration + clock.dt, self.attacked.windows + 1)
        windows, extra = [], []
        for c, row in zip(self.attacked.coefficients, _rows(run)):
            if not of_plant(c):
                continue
            starts = [k for k in range(len(row)) if k == 0 or row[k] != row[k - 1]]
            for k, end in zip(starts, [*starts[1:], len(row)]):
                if row[k] != c.nominal:
                    name = c.name.removeprefix("plant.")
                    windows.append((name, float(edges[k]), float(edges[end])))
                    extra.append(row[k] - c.nominal)
        factor = np.ones(len(extra))
        if of_case is not None:
            factor, extra = np.append(factor, of_case.factor), np.append(extra, of_case.extra)
            windows += of_case.windows
        if not windows:
            return None
        return Faults(factor=factor, extra=np.asarray(extra), windows=tuple(windows))


def _rows(run):
    """Values in each window of every coefficient: (windows,) arrays, (1,) where constant."""
    return [*np.asarray(run.values["varying"]), *np.asarray(run.values["constant"])[:, None]]


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
    check_choice("pumps", pumps, PUMPS)
    check_choice("start", start, STARTS)
    check(case.loop, case.clock, jax.random.key(0) if noisy(case) else None)
    if faulty_sensors(case.loop):
        raise InputError(
            "attack searches the errors of readings itself: leave out [[fault]] with sensor"
        )
    limits, ceiling, rows = limits_of(case)
    kinds = {"windows": windows, "pumps": pumps, "start": start, "noise": noise}
    coefficients = coefficients_of(case, distributions)
    attacked = Attacked(case=case, coefficients=coefficients, ceiling=ceiling, **kinds)
    search = _Search(attacked, draws, starts, iterations, seed, progress)
    points, levels = search.screen()
    values, level, times, history = search.climb(points, levels)
    rises = _rises(case, np.maximum(limits, level))
    numbers = {"limit": limits, "nominal": levels[0], "drawn": levels[1:].max(axis=0)}
    numbers |= {"level": level, "time_s": times, "rise": rises}
    found: list[Found] = []
    for i, row in enumerate(rows or (None,) * len(rises)):
        proof: dict[str, Any] = {"certified": None, "reason": "", "starts": ""}
        proof = {name: getattr(row, name) for name in proof} if row else proof
        if beyond_filter(attacked) and proof["certified"]:
            why = "the attack reaches beyond what the safety filter was designed for"
            proof = {"certified": False, "reason": why, "starts": ""}
        of_tank: dict[str, Any] = {name: float(column[i]) for name, column in numbers.items()}
        found.append(Found(tank=i, values=values[i], **proof, **of_tank))
    of: dict[str, Any] = {"starts": starts, "draws": draws, "seed": seed, "lowest": _lowest(case)}
    of |= {"history": history, "wall_s": time.perf_counter() - began}
    return Attack(attacked=attacked, found=tuple(found), **of)


def _lowest(case):
    """(tanks,) lowest levels of a case's own run without noise [cm]; None without such limits."""
    if "min_level" not in case.limits:
        return None
    loop = dataclasses.replace(case.loop, sensor=case.loop.sensor.without_noise())
    return np.asarray(evaluate_and_flag(loop, case.clock, ("min_level",))[0]["min_level"])


def beyond_filter(attacked: Attacked) -> list[str]:
    """Sentences on plants and readings beyond those that the safety filter was designed for."""
    case, sentences = attacked.case, list[str]()
    safety_filter: Any = case.loop.safety_filter
    if safety_filter is None:
        return []
    plants = {c.name: (c.low, c.high) for c in attacked.coefficients if c.name.startswith("plant.")}
    tolerances = {c.name: (c.low, c.high) for c in own_coefficients(attacked.original)}
    others = {c.name: (c.low, c.high) for c in attacked.coefficients if c.name not in plants}
    if outside := [*beyond_box(safety_filter, plants), *beyond_ends(others, tolerances)]:
        sentences.append(
            f"The intervals of {', '.join(outside)} are wider than those that the safety filter"
            " was designed for: nothing is proved there."
        )
    bands = (attacked.band, np.asarray(safety_filter.band))
    if np.any(bands[0] > bands[1] * (1.0 + 1e-12)):
        wide, band = (", ".join(f"{v:.3g}" for v in values) for values in bands)
        unit = case.loop.units[0]
        sentences.append(
            f"Readings may be off by ({wide}) {unit}, more than the band ({band}) {unit} of the"
            " safety filter: nothing is proved of such readings."
        )
    return sentences


def beyond_ends(ends: Mapping[str, Any], known: Mapping[str, Any]) -> list[str]:
    """Return the names of the (low, high) that are not within the known ones of their name."""
    spare = lambda pair: TOLERANCE * max(map(abs, pair))
    within = lambda a, b: b[0] - spare(b) <= a[0] and a[1] <= b[1] + spare(b)
    return [n for n, pair in ends.items() if n not in known or not within(pair, known[n])]


def limits_of(case: Case) -> tuple[Any, Any, tuple[TankCertificate, ...] | None]:
    """Return limits (n,), levels (n,) below which starts lie [cm], certificates with a filter."""
    loop, safety_filter = case.loop, case.loop.safety_filter
    if safety_filter is None:
        rim, top = np.asarray(loop.plant.rim, dtype=float), case.limits.get("max_level", "rim")
        limit = rim if isinstance(top, str) else np.minimum(rim, np.asarray(top, dtype=float))
        return limit, limit, None
    limit = np.asarray(safety_filter.limit, dtype=float)
    if case.safety is None:  # made by hand
        return limit + np.asarray(getattr(safety_filter, "spare", 0.0)), limit, None
    rows = certificates_of(case)
    return np.array([row.limit for row in rows]), limit, rows


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

    def with_case(self, values):
        """The values (1 + runs, ...) with those of the unchanged case before them."""
        of_case = self.attacked.nominal()
        first = {k: np.broadcast_to(of_case[k], v.shape[1:])[None] for k, v in values.items()}
        return {k: np.concatenate([first[k], v]) for k, v in values.items()}

    def levels(self, values):
        """((runs, n) highest levels [cm], (runs, n) their times [s]) of values (runs, ...)."""
        return in_batches(self.run, batch_size(self.attacked, min(64, self.draws + 1)), values)

    def screen(self):
        """Return (variables of the draws, levels (draws + 1, n)); row 0 is the unchanged case."""
        points = _points(self.attacked, self.draws, self.rng)
        levels = self.levels(self.with_case(self.values(points)))[0]
        self.report(1)
        return points, levels

    def climb(self, points, levels):
        """Return values, level, time of the highest run of each tank, and levels by step."""
        starts, n = min(self.starts, self.draws), levels.shape[1]
        order = np.argsort(-levels[1:], axis=0, kind="stable")[:starts].T.ravel()  # (n starts,)
        tanks = np.repeat(np.arange(n), starts)
        z, history = {k: v[order] for k, v in points.items()}, levels[1:][order, tanks][None]
        if self.iterations:
            size = batch_size(self.attacked, len(tanks))

            def slopes(at):
                (value, _), slope = in_batches(self.slopes, size, at, tanks)
                return value, slope

            z, _, history = ascend(slopes, z, self.iterations, lambda done: self.report(done + 2))
        values = self.with_case(self.values(z))
        highest, times = self.levels(values)
        best = highest.argmax(axis=0)  # the ascent for one tank may serve another better
        chosen = [{k: v[i] for k, v in values.items()} for i in best]
        self.report(self.iterations + 2)
        at = (best, np.arange(n))
        history = history.reshape(-1, n, starts).max(axis=2)
        return chosen, highest[at], times[at], history


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


def ascend(slopes, z, iterations: int, report: Callable | None = None) -> Ascent:
    """Return points in the unit cube with higher values than at `z`."""
    # along the signs of the slopes, cut to the cube: a step of 1 reaches the best corner of a
    # linear function; where a point does not rise its step is halved
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

"""Performance of a set of gains on validation plants, at the step of the case."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxtank import measures as ms, rig
from jaxtank.case import Case, check_case
from jaxtank.core.jsonable import clean, fields
from jaxtank.core.tree import get_value
from jaxtank.limits import limited_levels, of_drawn_rims, resolve_limits
from jaxtank.loop import run as lp
from jaxtank.loop.closed_loop import without_noise
from jaxtank.task import COST
from tuning.feasible.study import can_follow, can_judge
from tuning.problem.functions import as_measures
from tuning.problem.scenarios import at_once, noisy, processors
from tuning.search.options import check_numbers, check_precision
from tuning.search.setting import NEAR, Setting, not_stated, scenarios_to_judge, setting_of
from tuning.uncertainty.batches import batch_size, run_batch
from tuning.uncertainty.draws import Draws
from tuning.uncertainty.sampling import Points, clopper_pearson
from tuning.uncertainty.validation import SEED_OFFSET
from tuning.views import Shown

LANES = 8  # runs in a batch are a multiple of this: numbers in a vector register

NOISE = "sensor.noise"

OF_LEVELS = ("max_level", "min_level", "overflow_volume")
"""Measures whose limits a safety filter may keep."""


class ScenarioPlants(NamedTuple):
    """Drawn plants that run in one scenario, or in the case's own run."""

    rows: Any  # of the N plants
    case: Case
    values: Mapping[str, Any]  # {parameter: (rows, ...)} as drawn


class PlantRuns(NamedTuple):
    """Measures of N drawn plants, and of the nominal one."""

    groups: Sequence[ScenarioPlants]
    measures: dict[str, np.ndarray[Any, Any]]  # {name: (N, ...)}
    failed: np.ndarray[Any, Any]  # (N,) True where the run diverged
    # {name: value} of the nominal plant without noise; None where it diverged, or was not run
    nominal: dict[str, np.ndarray[Any, Any]] | None


def run_plants(
    case: Case,
    distributions: Mapping[str, Any],
    samples: int,
    seed: int,
    names: Sequence[str],
    quiet: bool = False,
) -> PlantRuns:
    """Run a case on drawn plants, in its scenarios in turn; quiet: also its plant without noise."""
    space = Draws(case.loop, distributions)
    random = noisy(case) or any(n.startswith(NOISE) for n in space.labels)
    plants = space.values(Points("random", space.dimensions, samples, seed).rows(0, samples))
    names, key = tuple(names), seed if random else None
    scenarios = scenarios_to_judge(case)
    if not scenarios:
        measures, failed, nominal = _run_draws(case, plants, samples, key, names, quiet)
        return PlantRuns([ScenarioPlants(slice(None), case, plants)], measures, failed, nominal)
    groups, failed = list[ScenarioPlants](), np.zeros(samples, dtype=bool)
    joined: dict[str, np.ndarray] = {}
    for k, scenario in enumerate(scenarios):
        rows = np.arange(k, samples, len(scenarios))
        inside = rig.set_scenario(case, scenario.values).replace(scenarios=())
        values = {n: v[rows] for n, v in not_stated(scenario, plants).items()}
        if not values:  # a batch of runs needs a value of each
            values = {"x0": np.tile(np.asarray(inside.loop.x0, dtype=float), (len(rows), 1))}
        measures, failed[rows], _ = _run_draws(inside, values, len(rows), key, names, False)
        for n, v in measures.items():
            joined.setdefault(n, np.zeros((samples, *v.shape[1:]), v.dtype))[rows] = v
        groups.append(ScenarioPlants(rows, inside, values))
    nominal = None
    if quiet:
        alone, diverged = lp.evaluate_and_flag(without_noise(case.loop), case.clock, names, None)
        nominal = None if bool(diverged) else {n: np.asarray(v) for n, v in alone.items()}
    return PlantRuns(groups, joined, failed, nominal)


def _run_draws(
    case: Case, plants: Mapping[str, Any], samples: int, key: int | None, names: tuple, quiet: bool
) -> tuple[dict[str, np.ndarray], np.ndarray, dict[str, np.ndarray] | None]:
    """(measures, failed, those of the nominal plant without noise) of a case on drawn plants."""
    random = key is not None
    lp.check(case.loop, case.clock, jax.random.key(0) if random else None)
    # the last run is of the nominal plant without noise, unless entries of the noise are drawn
    quiet = quiet and np.ndim(case.loop.sensor.noise) > 0
    quiet = quiet and not any(n.startswith(f"{NOISE}[") for n in plants)
    values = _with_nominal(case.loop, plants, samples) if quiet else dict(plants)
    count = samples + quiet
    size = _batch(batch_size(case, random, count), count)
    if case.loop.sequential:
        size = -(-count // processors())
    measures = _run_batches(case, names, key, values, count, size)
    failed, nominal = measures.pop("failed") > 0, None
    if quiet and not failed[samples]:
        nominal = {n: v[samples] for n, v in measures.items()}
    return {n: v[:samples] for n, v in measures.items()}, failed[:samples], nominal


def _run_batches(
    case: Case, names: tuple, key: int | None, values: Mapping[str, Any], count: int, size: int
) -> dict[str, np.ndarray]:
    """Measures of `count` runs in batches of `size`, of which the last one repeats its last run."""
    rows = np.minimum(np.arange(-(-count // size) * size), count - 1)

    def run(batch: np.ndarray) -> Any:
        block = {n: np.asarray(v)[rows[batch]] for n, v in values.items()}
        return run_batch(case, names, key, block, batch)

    batches = at_once(run, np.split(np.arange(len(rows)), len(rows) // size))
    return {n: np.concatenate([b[n] for b in batches]) for n in batches[0]}


def _with_nominal(loop: Any, plants: Mapping[str, Any], samples: int) -> dict[str, Any]:
    """Values of the plants and, last, those of the nominal plant without noise."""
    noise = np.asarray(loop.sensor.noise, dtype=float)
    last = {n: get_value(loop, n) for n in plants} | {NOISE: 0.0 * noise}
    values = {NOISE: np.broadcast_to(noise, (samples, *noise.shape))} | dict(plants)
    return {
        n: np.concatenate([np.asarray(v), np.asarray(last[n], dtype=float)[None]])
        for n, v in values.items()
    }


def _batch(most: int, count: int) -> int:
    """Runs in a batch: the multiple of LANES near `most` with the fewest runs in vain."""
    if most < LANES:
        return most
    sizes = range(max(LANES, most // 2), most + most // 8 + 1, LANES)
    return min(sizes, key=lambda size: (-(-count // size) * size, -size))


FRESH = 256  # plants on which an answer is judged

NOMINAL = (  # measures of the nominal plant, which runs in addition to the plants
    *("rms_error_total", "rms_error", "settling_time", "recovery_time"),
    *("steady_state_error", "steady_state_swing", "time_of_steady_state_error"),
    *("max_level", "min_level", "overflow_volume"),  # what a verdict names beside the limits
)


@dataclasses.dataclass(frozen=True, kw_only=True, repr=False)
class Judged(Shown):
    """A case on N plants that are not exactly known, with sensor noise; made by `tuning.validate`.

    Parameters
    ----------
    cost, error : (N,) objective; total rms error [unit of length].
    level : (N, tanks) highest levels.
    travel : (N,) rms change of the inputs per sample, as a share of their range [-].
    held : (N,) True where every limit holds; failed : (N,) True where the run diverged.
    infeasible : (N,) True where no controller can hold a setpoint; None where that is not known.
    limits : the Limits; measures : {name: (N, ...)}.  unit : of length.
    nominal : {name: value} of the nominal plant without noise: the measures above and NOMINAL; None
        where the case states noise, or that run diverged.
    runs : name of the N runs: plants, or one plant with new noise.
    """

    cost: np.ndarray
    error: np.ndarray
    level: np.ndarray
    travel: np.ndarray
    held: np.ndarray
    failed: np.ndarray
    infeasible: np.ndarray | None
    limits: list[Any]
    measures: dict[str, np.ndarray]
    unit: str
    nominal: dict[str, np.ndarray] | None = None
    runs: str = "plants"

    @property
    def samples(self) -> int:
        """Number of plants N."""
        return len(self.cost)

    def share_held(self) -> dict[str, Any]:
        """Return {"share", "interval95", "samples"} of the plants on which every limit holds."""
        count, n = int(self.held.sum()), self.samples
        return {"share": count / n, "interval95": clopper_pearson(count, n), "samples": n}

    def to_json(self) -> dict[str, Any]:
        """Return means over the plants whose run is finite, as plain numbers."""
        good = ~self.failed
        mean = lambda values: float(np.mean(values[good])) if good.any() else None
        share = self.share_held()
        return {
            "samples": self.samples,
            "failed": int(self.failed.sum()),
            "objective": mean(self.cost),
            "error": mean(self.error),
            "highest_level": self.level[good].max(axis=0).tolist() if good.any() else None,
            "travel_percent": mean(100.0 * self.travel),
            "limits_held": share["share"],
            "interval95": share["interval95"],
        }

    def _rows(self) -> dict[str, str]:
        means = self.to_json()
        low, high = (100.0 * end for end in means["interval95"])
        rows = {
            "limits held": f"{100 * means['limits_held']:.3g} % of {self.samples} {self.runs}"
            f" (95 % interval {low:.3g} to {high:.3g} %)"
        }
        if means["error"] is not None:
            levels = ", ".join(f"{v:.4g}" for v in means["highest_level"])
            rows |= {
                "mean total rms error": f"{means['error']:.4g} {self.unit}",
                "highest levels": f"{levels} {self.unit}",
                "rms change of input per sample": f"{means['travel_percent']:.3g} % of their range",
            }
        if means["failed"]:
            rows["diverged"] = f"{means['failed']} plants"
        return rows

    def plot(self) -> dict[str, Any]:
        """Return matplotlib figures {"plants": errors and highest levels}; {} where every run
        diverged.
        """
        return drawn({"plants": self})

    def worst(self) -> list[dict[str, Any]]:
        """Return a dict for each limit: the Limit, its worst value, and on how many plants it is
        violated."""
        rows = []
        for limit in self.limits:
            values = self.measures[limit.measure].reshape(self.samples, -1)[:, limit.index]
            margins = limit.margins(values)
            i = int(np.argmin(margins))
            row = {"limit": limit, "value": float(values[i]), "margin": float(margins[i])}
            rows.append(row | {"plant": i, "broken": int((margins < 0).sum())})
        return rows


def drawn(sides: Mapping[str, Judged]) -> dict[str, Any]:
    """Return {"plants": figure} of {name: Judged}; {} where every run of one diverged."""
    if any(side.failed.all() for side in sides.values()):
        return {}
    from jaxtank.plots.uncertainty import plants

    clouds = {name: (s.error[~s.failed], s.level[~s.failed]) for name, s in sides.items()}
    last = list(sides.values())[-1]
    limits = np.full(last.level.shape[1], np.inf)
    for limit in last.limits:
        if limit.measure == "max_level":
            limits[limit.index] = limit.value
    return {"plants": plants(clouds, limits, last.unit)}


def validate(
    case: Case,
    samples: int = FRESH,
    seed: int = 0,
    *,
    distributions: Mapping[str, Any] | None = None,
    objective: Any = None,
    limits: Any = None,
) -> Judged:
    """Return the performance of a case on uncertain plants with noise in the readings.

    The noise is taken from the case or its scenarios, else 0.1 % of the height of its tanks. The
    same seed gives the same plants and noise, and the plants of `tune` with this seed.

    Parameters
    ----------
    case : the Case, with the gains and the safety filter that it has.
    samples : number of plants.
    seed : of plants and noise.
    distributions : {name: distribution or share}; by default the tolerances of the case, else 5 %
        of every flow.
    objective : {measure: weight} or a custom function, as in `tuning.tune`.
    limits : {measure: value}, and `Constraint`, as in `tuning.tune`; default: of the case.

    Returns
    -------
    Judged

    Raises
    ------
    InputError : for a name or a value that cannot be used.

    Examples
    --------
    >>> import jax, tuning
    >>> from jaxtank import presets
    >>> jax.config.update("jax_enable_x64", True)
    >>> tuning.validate(presets.find("cascaded/pi"), samples=8).share_held()["share"]
    0.0
    """
    check_case(case, seed)
    check_precision()
    check_numbers(samples=samples)
    objective, limits = as_measures(objective, limits)
    return judge(setting_of(case, objective, limits, distributions), samples, seed)


def judge(
    setting: Setting, samples: int, seed: int, round_: int = 0, more: Sequence[str] = ()
) -> Judged:
    """Return the Judged of a setting on `samples` plants, with the measures `more` as well."""
    case = setting.searched
    limits = resolve_limits(case, setting.case.limits)
    stated = (name for scenario in scenarios_to_judge(case) for name in scenario.values)
    limits = of_drawn_rims(limits, case.loop.plant, [*setting.distributions, *stated])
    names = [*setting.objective, *COST, "rms_error_total", *ms.TRACKED, *more]
    names = [m for m in dict.fromkeys(names) if ms.serves(m, case.loop)]
    names += [limit.measure for limit in limits]
    quiet = [m for m in NOMINAL if ms.serves(m, case.loop)] if not noisy(setting.case) else []
    seed = (SEED_OFFSET + seed + 104_729 * round_) % 2**31
    samples = max(samples, len(scenarios_to_judge(case)))
    asked = tuple(dict.fromkeys([*names, *quiet]))
    plants = run_plants(case, setting.distributions, samples, seed, asked, bool(quiet))
    measures = {m: plants.measures[m] for m in dict.fromkeys(names)}
    rows = {m: v.reshape(samples, -1) for m, v in measures.items()}
    past = [limit.margins(rows[limit.measure][:, limit.index]) < 0 for limit in limits]
    changes = np.sqrt(rows[COST[1]]) / setting.span
    return Judged(
        cost=np.asarray(sum(w * rows[m].sum(axis=1) for m, w in setting.objective.items())),
        error=rows["rms_error_total"][:, 0],
        level=rows["max_level"],
        travel=np.sqrt(np.mean(changes**2, axis=1)),
        held=~(plants.failed | np.any(past, axis=0)) if past else ~plants.failed,
        failed=plants.failed,
        infeasible=_infeasible(plants, samples, setting.case.limits),
        limits=limits,
        measures=measures,
        nominal=plants.nominal,
        unit=setting.case.loop.units[0],
        runs=setting.runs.removeprefix("validation "),
    )


def _infeasible(plants: PlantRuns, samples: int, limits: Mapping[str, Any]) -> Any:
    """(N,) True where no controller can hold a setpoint; None where that is not known."""
    infeasible = np.zeros(samples, dtype=bool)
    for group in plants.groups:
        if not can_judge(group.case):
            return None
        infeasible[group.rows] = ~can_follow(group.case, group.values, limits)
    return infeasible


def near_limits(setting: Setting, plants: Judged) -> np.ndarray:
    """Return (tanks,) True where some plant comes within NEAR of the limit on its level."""
    limit = limited_levels(setting.case)
    with np.errstate(invalid="ignore"):
        highest = np.where(plants.failed[:, None], np.inf, plants.level).max(axis=0)
        return np.isfinite(limit) & (highest >= NEAR * limit)


@dataclasses.dataclass(frozen=True, kw_only=True, repr=False)
class Answer(Shown):
    """How the default answer was found and judged: `TuningResult.answer`.

    Parameters
    ----------
    setting : plants, noise, cost and safety filter of the search.
    before, after : the case as given and the tuned case on the same validation plants.
    nominal : {"before", "after": total rms error of the case's own run, without noise}.
    kept : {parameter: True where it stays at its start}.
    least_cost_peaks : peaks Ms and Mt [-] of the gains of least cost, where gains with lower ones
        were chosen; else None.
    filter_offsets : {output from 0: steady-state errors without and with the safety filter} where
        it enlarges them; filter_lost : validation plants that miss setpoints within their reach
        under it. It is left out where that is better.
    agreed : True if two searches ended within 1 % of each other, or differential evolution found
        nothing better.
    lost : outputs that no longer follow their setpoints, as `tuning.search.result.Lost`.
    idle : numbers of the tanks, from 1, whose limit no plant comes near.
    tightened : largest share by which a limit was tightened for the search [-].
    coarse_dt : step of the search [s]; integrator : its integrator.
    measures : {"before", "after": {measure: value} of the case's own run}.
    feasibility : a `tuning.Feasibility`, None where it is not known; mended : the Mend that was
        applied first, None where none was asked for.

    Examples
    --------
    >>> import tuning
    >>> from jaxtank import presets
    >>> result = tuning.tune(presets.find("gouta2015/backstepping"))  # doctest: +SKIP
    >>> result.answer.after.share_held()["share"]  # doctest: +SKIP
    1.0
    """

    setting: Setting
    before: Judged
    after: Judged | None
    nominal: Mapping[str, float]
    kept: Mapping[str, bool]
    agreed: bool
    lost: tuple
    idle: tuple[int, ...]
    tightened: float
    coarse_dt: float
    integrator: str = "rk4"
    measures: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    feasibility: Any = None
    mended: Any = None
    least_cost_peaks: tuple[float, float] | None = None
    filter_offsets: Mapping[int, tuple[float, float]] = dataclasses.field(default_factory=dict)
    filter_lost: int = 0

    @property
    def held(self) -> bool:
        """True if every limit holds on every plant that judged the answer."""
        return self.after is not None and bool(self.after.held.all())

    def _sections(self) -> list[Any]:
        return self._report().of_answer(self)

    def __str__(self) -> str:
        return self._report().answer_text(self)

    def plot(self) -> dict[str, Any]:
        """Return matplotlib figures {"plants": errors and highest levels before and after}."""
        return drawn(self.sides)

    @property
    def sides(self) -> dict[str, Judged]:
        """{"before", "after": Judged}, without those that are None."""
        sides = {"before": self.before, "after": self.after}
        return {name: side for name, side in sides.items() if side is not None}

    def open_limits(self) -> dict[int, dict[str, str]]:
        """Return {tank: {measure: why its limit is not proved}} of the tanks of the safety filter
        with a limit on the level that is not proved.
        """
        plant, rows = self.setting.case.loop.plant, {}
        rims = np.broadcast_to(np.asarray(plant.rim, dtype=float), (plant.tanks,))
        limits = [] if self.after is None else self.after.limits
        for certificate in self.setting.certificates:
            asked = {"max_level": certificate.limit}
            if certificate.low > 0.0:
                asked["min_level"] = certificate.low
            for limit in limits:
                if limit.index == certificate.tank and limit.measure in OF_LEVELS:
                    rim = limit.measure == "overflow_volume"
                    asked[limit.measure] = rims[limit.index] if rim else limit.value
            if asked.get("min_level", 1.0) <= 0.0:  # no level is below its bottom
                del asked["min_level"]
            why = {
                measure: certificate.unproved(measure, value) for measure, value in asked.items()
            }
            if missing := {measure: text for measure, text in why.items() if text is not None}:
                rows[certificate.tank] = missing
        return rows

    def holds(self) -> dict[str, Any]:
        """Return the object `holds` of the JSON: share of plants, interval, certificates."""
        share: dict[str, Any] = {"share": None, "interval95": None, "samples": 0}
        if self.after is not None and self.after.limits:
            share = self.after.share_held()
        open_limits = self.open_limits()
        certified = [
            {"tank": row.tank + 1, "certified": row.tank not in open_limits}
            | {"why": next(iter(open_limits.get(row.tank, {}).values()), row.reason)}
            | {"starts": row.starts or None}
            for row in self.setting.certificates
        ]
        return {"limits_on_validation": share.pop("share"), **share, "certified": certified}

    def to_json(self) -> dict[str, Any]:
        """Return the JSON entries for plants, noise and safety filter."""
        return clean(
            {
                **fields(self.setting, "noise noise_assumed=assumed plants_stated=stated"),
                "objective": dict(self.setting.objective),
                "safety_filter": self.setting.filter,
                "nominal_error": {  # of the run whose measures the JSON has, to the last digit
                    side: float(dict(m)["rms_error_total"]) for side, m in self.measures.items()
                },
                "plants": {name: side.to_json() for name, side in self.sides.items()},
                "kept": [name for name, stays in self.kept.items() if stays],
                **fields(self, "idle_limits_of_tanks=idle limits_tightened=tightened"),
                **fields(self, "search_dt_s=coarse_dt search_integrator=integrator"),
                "mended": None if self.mended is None else dict(self.mended.set),
            }
        )

"""What is minimised and what must hold, as numbers with exact derivatives."""

# functions of jax and of `measures` whose types are not complete
# pyright: reportUnknownMemberType=false

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxtank import measures as ms
from jaxtank.bounds import bounds
from jaxtank.case import Case, Scenario
from jaxtank.core.errors import InputError
from jaxtank.core.tree import get_value, with_values
from jaxtank.limits import UNDEFINED_MARGIN, Limit, limit_scale, resolve_in
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.loop.functions import check_functions
from jaxtank.rig import check_objective
from tuning.problem import scenarios as sc
from tuning.problem.functions import as_measures
from tuning.storage.evaluation_log import EvaluationCache

Floats = NDArray[np.float64]

DIVERGED = 1e9  # size at which a cost, a margin or a slope is no longer a number to search with

NO_VECTOR: Floats = np.zeros(0)
NO_MATRIX: Floats = np.zeros((0, 0))


class Point(NamedTuple):
    """The problem at one point z of the unit cube, derivatives with respect to z."""

    z: Floats  # (P,)
    cost: float  # weighted sum of measures, over the scenarios by `risk`
    gradient: Floats  # (P,)
    # (P, P) second derivative of what `Problem.model` names, without the residuals' own curvature
    gauss_newton: Floats
    margins: Floats  # (limits,) in each measure's unit
    margin_slopes: Floats  # (limits, P)
    measures: tuple[Mapping[str, Any], ...]  # of each scenario, {name: value}
    run_costs: Floats = NO_VECTOR  # (scenarios,)
    run_slopes: Floats = NO_MATRIX  # (scenarios, P)
    rows: tuple[int, ...] = ()  # which of the problem's limits the margins are of, where not all

    @property
    def finite(self) -> bool:
        """True if cost, margins and derivatives are numbers that one can search with."""
        return all(
            bool(np.all(np.abs(v) < DIVERGED))
            for v in (self.cost, self.gradient, self.margins, self.margin_slopes)
        )

    @property
    def valued(self) -> bool:
        """True if cost and margins are numbers that one can compare, whatever the derivatives."""
        return all(bool(np.all(np.abs(v) < DIVERGED)) for v in (self.cost, self.margins))


LANES = 256
"""Runs without derivatives that one program makes side by side: enough to fill the vector units."""

IDLE = 2**23
"""Samples of runs that are made in vain, at most, so as to use a program that is compiled."""

Screened = tuple[Floats, Floats]  # (costs (points,), margins (points, limits))


class Blocks:
    """How many points a program runs: as many as in an earlier call where that serves."""

    # The sizes follow from the calls alone, not from what is known already: a search that is
    # continued gives the same bits.

    def __init__(self, runs: int):
        self.runs = runs
        self.sizes: dict[bool, int] = {}

    def size(self, points: int, coarse: bool, samples: int) -> int:
        """Return the points of a block, for a call with so many points of runs of `samples`."""
        size, wanted = self.sizes.get(coarse, 0), max(1, min(points, LANES // self.runs))
        if size < wanted:
            self.sizes[coarse] = wanted
            return wanted
        return size if -points % size * self.runs * samples <= IDLE else wanted


def in_blocks(screen: Callable[[Floats], Screened], zs: Floats, size: int) -> Screened:
    """Return screen(zs), called with `size` points at a time, the last one repeated to fill up."""
    filled = np.concatenate([zs, np.repeat(zs[-1:], -len(zs) % size, axis=0)])
    found = [screen(filled[i : i + size]) for i in range(0, len(filled), size)]
    costs, margins = (np.concatenate(parts)[: len(zs)] for parts in zip(*found))
    return costs, margins


FORWARD_LIMIT = 60
"""Number of free parameters up to which derivatives run forward with the simulation; above,
checkpointed reverse, without a Gauss-Newton matrix. With 60 a pass with the matrix costs half as
much again as reverse mode, and a search needs fewer of them: 44 instead of 230
(tests/benchmarks/README.md, Many parameters).
"""

ROOT = "rms_error_total"  # the measure that is the root of a sum of squares over all outputs

RISKS = ("mean", "cvar", "worst")
"""The cost of several scenarios: their weighted mean, the mean of the worst TAIL of them, or the
worst.
"""

TAIL = 0.05  # share of the scenarios that "cvar" is the mean of [-]

Row = Mapping[str, Any]  # measures of one scenario, {name: value}


class Problem:
    """A case, its free parameters, its cost and its limits, over one run or several scenarios.

    `tune` takes a Problem in the place of a Case. The search sees z in [0, 1]^P (`Bound`).

    Parameters
    ----------
    case : the Case.
    free : {name: (low, high) or Free}; the case's own where None, as for the next three.
    objective : {measure: weight}; a measure with several entries counts with their sum. Also a
        custom function, or a `tuning.Objective`, alone or in the place of a measure.
    limits : as in `resolve_limits`, or a list with `tuning.Constraint`s; of every scenario.
    scenarios : tuple of Scenario, () for the case's own run alone.
    seed : of the sensor noise, which is the same for every evaluation (common random numbers).
    cache : an EvaluationCache of what was evaluated before.
    risk : how the costs of the scenarios are combined, one of RISKS.
    runs : the runs of the scenarios, where their noise or weights are not those of the seed.
    drawn : True if the noise is drawn once, for a problem that is evaluated many times.

    Raises
    ------
    InputError : for a name, range, measure, limit or scenario that cannot be used.

    Examples
    --------
    >>> from jaxtank import presets
    >>> problem = Problem(presets.find("cascaded/pi"), free={"controller.Kc": (0.5, 2.0)})
    >>> problem.names, problem.risk
    (['controller.Kc[0]'], 'mean')
    """

    def __init__(
        self,
        case: Case,
        free: Mapping[str, Any] | None = None,
        objective: Any = None,
        limits: Any = None,
        scenarios: Sequence[Scenario] | None = None,
        seed: int = 0,
        cache: EvaluationCache | None = None,
        risk: str = "mean",
        *,
        runs: Sequence[sc.ScenarioRun] | None = None,
        drawn: bool = False,
    ):
        self.case, self.loop, self.clock, self.seed = case, case.loop, case.clock, seed
        self.given: dict[str, Any] = dict(
            free=free, objective=objective, scenarios=scenarios, risk=risk
        )
        if risk not in RISKS:
            raise InputError(f"risk = {risk!r}: must be one of {', '.join(RISKS)}")
        self.risk = risk
        objective, limits = as_measures(objective, limits)
        self.bounds = bounds(case.loop, case.free if free is None else free)
        self.objective = check_objective(case.objective if objective is None else objective)
        self.scenarios = sc.check_scenarios(
            case, case.scenarios if scenarios is None else scenarios, self.names
        )
        self.runs = sc.runs_of(case, self.scenarios, seed) if runs is None else list(runs)
        self.groups = sc.groups_of(self.runs)
        if drawn:
            self.groups = [sc.with_noise_drawn(group) for group in self.groups]
        self.given["limits"] = limits
        _, named = as_measures(None, limits, self.objective)
        self.limits: list[Limit] = resolve_in([(run.name, run.case) for run in self.runs], named)
        self.limit_scales: Floats = np.array([limit_scale(x, self.loop) for x in self.limits])
        self.needed = tuple(
            dict.fromkeys([*self.objective, *(limit.measure for limit in self.limits)])
        )
        check_functions(self.loop, self.clock, self.needed)
        self.cache = EvaluationCache() if cache is None else cache
        self.simulations, self.gradients, self.non_finite = 0, 0, 0
        self.blocks = Blocks(len(self.runs))

    def with_limits(self, limits: Any) -> "Problem":
        """Return the problem under other limits, with a cache of its own."""
        more = {**self.given, "limits": limits}
        return Problem(self.case, seed=self.seed, runs=self.runs, **more)

    @property
    def names(self) -> list[str]:
        """Dotted names of the P free scalars."""
        return [b.name for b in self.bounds]

    @property
    def model(self) -> str | None:
        """What the Gauss-Newton matrix is the second derivative of.

        "square" (the cost is one root mean square: its square), "cost", or None where no term of
        the cost is a sum of squares, or the parameters are too many to carry derivatives of.
        """
        if len(self.bounds) > FORWARD_LIMIT:
            return None
        if self.risk != "mean":
            # the worst scenario changes from point to point: the mean's curvature is not its own
            return None
        if set(self.objective) == {ROOT} and len(self.runs) == 1:
            return "square"
        return "cost" if any(m == ROOT or m in ms.squares() for m in self.objective) else None

    def start(self) -> Floats:
        """Return (P,) z of the case's own values. Raises InputError if one is outside its range."""
        z: list[float] = []
        for b, value in zip(self.bounds, self.own_values().values()):
            if not b.low <= value <= b.high:
                raise InputError(
                    f"{b.name} = {value:g} {b.unit}: starts outside its range {b.low:g}:{b.high:g}"
                    f" {b.unit}"
                )
            z.append(float(b.to_unit(value)))
        return np.array(z)

    def own_values(self) -> dict[str, float]:
        """Return {name: value in its unit} of the case itself."""
        return {name: float(get_value(self.loop, name)) for name in self.names}

    def values(self, z: Any) -> dict[str, float]:
        """Return {name: value in its unit} at z (P,)."""
        return {b.name: float(b.from_unit(v)) for b, v in zip(self.bounds, z)}

    def loop_at(self, z: Any) -> ClosedLoop:
        """Return the loop with the values at z (P,)."""
        return with_values(self.loop, self.values(z))

    def cost(self, measures: Row) -> float:
        """Return the weighted sum of the measures of one run."""
        return sum(w * float(np.sum(measures[m])) for m, w in self.objective.items())

    def total(self, table: Sequence[Row]) -> float:
        """Return the cost of `table`, the measures of every scenario, combined by `risk`."""
        costs = np.array([self.cost(row) for row in table])
        return float(self.shares(costs, range(len(self.runs))) @ costs)

    def shares(self, costs: Floats, runs: Sequence[int]) -> Floats:
        """Return the share of each of `runs` in the cost, given their costs (runs,); sums to 1."""
        weights = np.array([self.runs[i].weight for i in runs])
        if self.risk == "mean" or not np.all(np.isfinite(costs)):
            return weights / weights.sum()
        order = np.argsort(-costs, kind="stable")
        count = 1 if self.risk == "worst" else max(1, int(np.ceil(TAIL * len(costs))))
        chosen = np.zeros(len(costs))
        chosen[order[:count]] = weights[order[:count]]
        return chosen / chosen.sum()

    def margins(self, table: Sequence[Row]) -> Floats:
        """Return (limits,) margin of each limit, of the measures of every scenario."""
        return np.array([limit.margin(table[limit.run]) for limit in self.limits])

    def screen(self, zs: Any, coarse: bool = False) -> tuple[Floats, Floats]:
        """Return (costs (points,), margins (points, limits)) at zs (points, P), no derivatives.

        coarse : with the coarse clock of the screening.
        """
        zs = np.asarray(zs, dtype=float)
        self.simulations += len(zs) * len(self.runs)
        samples = max(group.clock.samples for group in self.groups) // (sc.COARSE if coarse else 1)
        size = self.blocks.size(len(zs), coarse, samples)
        found = self.cache.recall(
            "screen",
            [zs, coarse],
            lambda: in_blocks(lambda some: self._screen(some, coarse), zs, size),
        )
        return found[0].copy(), found[1].copy()

    def _screen(self, zs: Floats, coarse: bool) -> tuple[Floats, Floats]:
        points = {b.name: np.asarray(b.from_unit(zs[:, i])) for i, b in enumerate(self.bounds)}
        tables, broken = [self._per_run() for _ in zs], np.zeros(len(zs), dtype=bool)
        for group in self.groups:
            clock = sc.screening_clock(group.clock) if coarse else group.clock
            measures, flags = sc.values_of(group, self.needed, points, clock)
            broken |= np.asarray(flags).any(axis=1)
            arrays = {m: np.asarray(v) for m, v in measures.items()}
            for j, run in enumerate(group.runs):
                for i, table in enumerate(tables):
                    table[run] = {m: v[i, j] for m, v in arrays.items()}
        costs = np.where(broken, np.nan, [self.total(table) for table in tables])
        return costs, np.array([self.margins(table) for table in tables]).reshape(len(zs), -1)

    def point(self, z: Any) -> Point:
        """Return the Point at z (P,): every scenario at its own step, with derivatives."""
        z = self._counted(z, len(self.runs))
        found = Point(z, *self.cache.recall("point", [z], lambda: self._point(z, self.groups)))
        self.non_finite += not found.finite
        return found

    def coarse_point(self, z: Any) -> Point:
        """Return the Point at z (P,) with a tenth of the samples: a start for a search."""
        z = self._counted(z, len(self.runs))
        groups = [group.at(sc.coarse_clock(group.clock)) for group in self.groups]
        return Point(z, *self.cache.recall("coarse", [z], lambda: self._point(z, groups)))

    def batch_point(self, z: Any, batch: int, rng: np.random.Generator) -> Point:
        """Return the Point at z (P,) of about `batch` scenarios drawn by rng.

        The same number of every group, so that nothing is compiled twice.
        """
        groups: list[sc.Group] = []
        for group in self.groups:
            count = min(len(group.runs), max(1, round(batch * len(group.runs) / len(self.runs))))
            groups.append(
                sc.take(group, np.sort(rng.choice(len(group.runs), count, replace=False)))
            )
        drawn = [i for group in groups for i in group.runs]
        z = self._counted(z, len(drawn))
        found = self.cache.recall(
            "batch", [z, np.array(drawn, dtype=float)], lambda: self._point(z, groups)
        )
        rows = tuple(i for i, limit in enumerate(self.limits) if limit.run in drawn)
        return Point(z, *found, rows=rows)

    def _counted(self, z: Any, runs: int) -> Floats:
        """Return z in the unit cube, after `runs` simulations with gradients were counted."""
        self.simulations, self.gradients = self.simulations + runs, self.gradients + runs
        return np.clip(np.asarray(z, dtype=float), 0.0, 1.0)

    def _per_run(self) -> list[Any]:
        return [None] * len(self.runs)

    @np.errstate(over="ignore", invalid="ignore")  # Point.finite reports what diverges
    def _point(self, z: Floats, groups: Sequence[sc.Group]) -> tuple[Any, ...]:
        """Return the fields of the Point at z after z itself, of the runs in `groups` alone."""
        table, slopes, matrices, diverged = self._derivatives(z, groups)
        run = [i for i, row in enumerate(table) if row is not None]
        limits = [limit for limit in self.limits if table[limit.run] is not None]
        margins = np.array([limit.margin(table[limit.run]) for limit in limits])
        margin_slopes = np.array(
            [-limit.sign * slopes[limit.run][limit.measure][limit.index] for limit in limits]
        ).reshape(-1, len(z))
        margin_slopes[np.abs(margins) >= UNDEFINED_MARGIN] = 0.0
        costs = np.array([self.cost(table[i]) for i in run])
        rates = np.array(
            [sum(w * slopes[i][m].sum(axis=0) for m, w in self.objective.items()) for i in run]
        )
        shares = self.shares(costs, run)
        matrix = sum(s * matrices[i] for s, i in zip(shares, run))
        cost = np.nan if diverged else float(shares @ costs)
        measures = tuple(table[i] for i in run)
        return cost, shares @ rates, matrix, margins, margin_slopes, measures, costs, rates

    def _derivatives(
        self, z: Floats, groups: Sequence[sc.Group]
    ) -> tuple[list[Any], list[Any], list[Any], bool]:
        """Return (measures, their slopes by z, Gauss-Newton) of each run, None where not run."""
        values = {name: np.float64(v) for name, v in self.values(z).items()}
        per_z = np.array(
            [float(b.slope(np.float64(v))) for b, v in zip(self.bounds, values.values())]
        )
        table, slopes, matrices, diverged = *(self._per_run() for _ in range(3)), False
        for group in groups:
            measures, rates, curvature, broken = self._run(group, values)
            diverged = diverged or bool(np.asarray(broken).any())
            for j, i in enumerate(group.runs):
                table[i] = {m: np.asarray(v)[j] for m, v in measures.items()}
                slopes[i] = {
                    m: np.asarray(v)[j].reshape(-1, len(z)) * per_z for m, v in rates.items()
                }
                matrices[i] = self._curvature(
                    np.asarray(curvature)[j] * np.outer(per_z, per_z), table[i], slopes[i]
                )
        return table, slopes, matrices, diverged

    def _squares(self) -> tuple[tuple[str, float], ...]:
        """Return ((measure, weight), ...) of the squares of the Gauss-Newton matrix."""
        own = tuple((m, w) for m, w in self.objective.items() if m in ms.squares())
        return (("mean_square_error", 1.0),) if ROOT in self.objective or not own else own

    def _curvature(self, matrix: Floats, measures: Row, slopes: Row) -> Floats:
        if self.model != "cost" or ROOT not in self.objective:
            return matrix
        # of a root: (matrix of its square / 2 - slope slope') / root, which is never negative
        root, slope = max(float(measures[ROOT]), 1e-12), slopes[ROOT][0]
        return self.objective[ROOT] * (0.5 * matrix - np.outer(slope, slope)) / root

    def _run(self, group: sc.Group, values: Mapping[str, Any]) -> tuple[Row, Row, Any, Any]:
        """Return (measures, slopes, Gauss-Newton, diverged) of a group, each (runs, ...)."""
        if len(values) <= FORWARD_LIMIT:
            root = [ROOT] if self.model == "cost" and ROOT in self.objective else []
            needed = tuple(dict.fromkeys([*self.needed, *root]))
            return sc.slopes_of(group, needed, values, self._squares())
        measures, slopes = sc.reverse_slopes_of(group, self.needed, values)
        broken = not all(np.all(np.isfinite(v)) for v in slopes.values())
        none = np.full((len(group.runs), len(values), len(values)), np.nan)
        return measures, slopes, none, broken

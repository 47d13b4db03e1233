"""The optimisation problem: cost, and margins to the limits, with exact derivatives."""

# functions of jax and of `measures` whose types are not complete
# pyright: reportUnknownMemberType=false

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxtank import measures as ms
from jaxtank.bounds import Bound, bounds, free_of
from jaxtank.case import Case, Scenario
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.core.tree import get_value
from jaxtank.limits import UNDEFINED_MARGIN, Limit, limit_scale, resolve_in
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.loop.functions import check_functions
from jaxtank.rig import check_objective
from tuning.problem import scenarios as sc
from tuning.problem.functions import as_measures

Floats = NDArray[np.float64]

DIVERGED = 1e9  # size at which a cost, a margin or a slope is no longer a number to search with

LANES = 256  # runs without derivatives side by side: enough to fill the vector units

FORWARD_LIMIT = 60
"""Number of free parameters up to which derivatives run forward with the simulation; above,
checkpointed reverse, without a Gauss-Newton matrix. With 60 a pass with the matrix costs half as
much again as reverse mode, and a search needs fewer of them: 44 instead of 230
(tests/benchmarks/README.md, Many parameters).
"""

ROOT = "rms_error_total"  # the measure that is the root of a sum of squares over all outputs

RISKS = ("mean", "cvar", "worst")  # weighted mean, mean of the worst TAIL, worst scenario

TAIL = 0.05  # share of the scenarios that "cvar" is the mean of [-]

NO_VECTOR: Floats = np.zeros(0)
NO_MATRIX: Floats = np.zeros((0, 0))

Row = Mapping[str, Any]  # measures of one scenario, {name: value}
Screened = tuple[Floats, Floats]  # (costs (points,), margins (points, limits))


class Point(NamedTuple):
    """The problem at one point z of the unit cube, derivatives with respect to z."""

    z: Floats  # (P,)
    cost: float  # weighted sum of measures, over the scenarios by `risk`
    gradient: Floats  # (P,)
    # (P, P) second derivative of what `Problem.model` names, without the residuals' own curvature
    gauss_newton: Floats
    margins: Floats  # (limits,) in each measure's unit
    margin_slopes: Floats  # (limits, P)
    measures: tuple[Row, ...]  # of each scenario
    run_costs: Floats = NO_VECTOR  # (scenarios,)
    run_slopes: Floats = NO_MATRIX  # (scenarios, P)
    rows: tuple[int, ...] = ()  # which of the problem's limits the margins are of, where not all

    @property
    def finite(self) -> bool:
        """True if cost, margins and derivatives are numbers that one can search with."""
        return self.valued and all(
            bool(np.all(np.abs(v) < DIVERGED)) for v in (self.gradient, self.margin_slopes)
        )

    @property
    def valued(self) -> bool:
        """True if cost and margins are numbers that one can compare, whatever the derivatives."""
        return all(bool(np.all(np.abs(v) < DIVERGED)) for v in (self.cost, self.margins))


@dataclasses.dataclass(frozen=True, init=False, eq=False, repr=False)
class Problem:
    """A case, its free parameters, its cost and its limits, over one run or several scenarios.

    `tune` takes a Problem instead of a Case. The search sees z in [0, 1]^P (`Bound`).

    Parameters
    ----------
    case : the Case.
    free : {name: (low, high) or Free}; the case's own where None, as for the next three.
    objective : {measure: weight}; a measure with several entries counts with their sum. Also a
        custom function, or a `tuning.Objective`, alone or instead of a measure.
    limits : as in `resolve_limits`, or a list with a `tuning.Constraint`; of every scenario.
    scenarios : tuple of Scenario, () for the case's own run alone.
    seed : of the sensor noise, which is the same for every evaluation (common random numbers).
    risk : how the costs of the scenarios are combined, one of RISKS.
    runs : the runs of the scenarios, if noise or weights do not follow from the seed.
    draw_noise : draw the noise once, for a problem that is evaluated many times.

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

    case: Case
    bounds: list[Bound]
    objective: Mapping[str, float]
    limits: list[Limit]
    stated_limits: Mapping[str, Any] | None  # {measure: value}; None: limits of each run's case
    scenarios: tuple[Scenario, ...]
    seed: int
    risk: str
    runs: list[sc.ScenarioRun]
    groups: list[sc.Group]

    def __init__(
        self,
        case: Case,
        free: Mapping[str, Any] | None = None,
        objective: Any = None,
        limits: Any = None,
        scenarios: Sequence[Scenario] | None = None,
        seed: int = 0,
        risk: str = "mean",
        *,
        runs: Sequence[sc.ScenarioRun] | None = None,
        draw_noise: bool = False,
    ):
        if risk not in RISKS:
            raise InputError(f"risk = {risk!r}: must be one of {', '.join(RISKS)}")
        objective, limits = as_measures(objective, limits)
        parameters = bounds(case.loop, free_of(case) if free is None else free)
        weights = check_objective(case.objective if objective is None else objective)
        scenarios = case.scenarios if scenarios is None else scenarios
        scenarios = sc.check_scenarios(scenarios, [b.name for b in parameters])
        runs = sc.runs_of(case, scenarios, seed) if runs is None else list(runs)
        groups = sc.groups_of(runs)
        _, limits = as_measures(None, limits, weights)
        vars(self).update(  # the fields of a frozen class
            case=case,
            bounds=parameters,
            objective=weights,
            limits=resolve_in([(run.name, run.case) for run in runs], limits),
            stated_limits=limits,
            scenarios=scenarios,
            seed=seed,
            risk=risk,
            runs=runs,
            groups=[sc.with_noise_drawn(group) for group in groups] if draw_noise else groups,
        )
        check_functions(self.loop, self.clock, self.needed)

    def replace(self, **changes: Any) -> "Problem":
        """Return the problem with some fields changed."""
        other = object.__new__(Problem)
        vars(other).update(vars(self) | changes)
        return other

    def with_limits(self, limits: Any) -> "Problem":
        """Return the problem under other limits."""
        _, limits = as_measures(None, limits, self.objective)
        runs = [(run.name, run.case) for run in self.runs]
        return self.replace(limits=resolve_in(runs, limits), stated_limits=limits)

    def with_seed(self, seed: int) -> "Problem":
        """Return the problem with the noise of another seed."""
        runs = sc.runs_of(self.case, self.scenarios, seed)
        return self.replace(seed=seed, runs=runs, groups=sc.groups_of(runs))

    @property
    def loop(self) -> ClosedLoop:
        """The loop of the case."""
        return self.case.loop

    @property
    def clock(self) -> Clock:
        """The clock of the case."""
        return self.case.clock

    @property
    def names(self) -> list[str]:
        """Dotted names of the P free scalars."""
        return [b.name for b in self.bounds]

    @property
    def needed(self) -> tuple[str, ...]:
        """The measures of the cost and of the limits."""
        return tuple(dict.fromkeys([*self.objective, *(limit.measure for limit in self.limits)]))

    @property
    def limit_scales(self) -> Floats:
        """The (limits,) sizes by which margins count, see `limit_scale`."""
        return np.array([limit_scale(limit, self.loop) for limit in self.limits])

    @property
    def model(self) -> str | None:
        """The function whose second derivative the Gauss-Newton matrix approximates.

        "square" (the cost is one root mean square: its square), "cost", or None where no term of
        the cost is a sum of squares, or the parameters are too many to carry derivatives of.
        """
        # of the worst scenarios, which change from point to point, the mean's curvature is not that
        if len(self.bounds) > FORWARD_LIMIT or self.risk != "mean":
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
        count = 1 if self.risk == "worst" else max(1, int(np.ceil(TAIL * len(costs))))
        worst = np.argsort(-costs, kind="stable")[:count]
        shares = np.zeros(len(costs))
        shares[worst] = weights[worst]
        return shares / shares.sum()

    def margins(self, table: Sequence[Row]) -> Floats:
        """Return (limits,) margin of each limit, of the measures of every scenario."""
        return np.array([limit.margin(table[limit.run]) for limit in self.limits])

    def screen(self, zs: Any, coarse: bool = False, size: int | None = None) -> Screened:
        """Return (costs (points,), margins (points, limits)) at zs (points, P), no derivatives.

        coarse : with the coarse clock of the screening.
        size : points of a block that one program runs; the last block is filled up.
        """
        zs = np.asarray(zs, dtype=float)
        size = size or max(1, min(len(zs), LANES // len(self.runs)))
        full = np.concatenate([zs, np.repeat(zs[-1:], -len(zs) % size, axis=0)])
        blocks = [self._screen(full[i : i + size], coarse) for i in range(0, len(full), size)]
        costs, margins = (np.concatenate(parts)[: len(zs)] for parts in zip(*blocks))
        return costs, margins

    def _screen(self, zs: Floats, coarse: bool) -> Screened:
        points = {b.name: np.asarray(b.from_unit(zs[:, i])) for i, b in enumerate(self.bounds)}
        tables: list[list[Any]] = [[None] * len(self.runs) for _ in zs]
        broken = np.zeros(len(zs), dtype=bool)
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
        return self._point(z, self.groups)

    def coarse_point(self, z: Any) -> Point:
        """Return the Point at z (P,) with a tenth of the samples: a start for a search."""
        return self._point(z, [g.at(sc.coarse_clock(g.clock)) for g in self.groups])

    def batch(self, count: int, rng: np.random.Generator) -> list[sc.Group]:
        """Return groups of about `count` runs drawn by rng: as many of every group each time."""
        groups: list[sc.Group] = []
        for group in self.groups:
            size = min(len(group.runs), max(1, round(count * len(group.runs) / len(self.runs))))
            groups.append(sc.take(group, np.sort(rng.choice(len(group.runs), size, replace=False))))
        return groups

    def batch_point(self, z: Any, groups: Sequence[sc.Group]) -> Point:
        """Return the Point at z (P,) of the runs of `batch` alone."""
        runs = {i for group in groups for i in group.runs}
        rows = tuple(i for i, limit in enumerate(self.limits) if limit.run in runs)
        return self._point(z, groups)._replace(rows=rows)

    @np.errstate(over="ignore", invalid="ignore")  # Point.finite reports what diverges
    def _point(self, z: Any, groups: Sequence[sc.Group]) -> Point:
        """Return the Point at z of the runs in `groups` alone."""
        z = np.clip(np.asarray(z, dtype=float), 0.0, 1.0)
        table, slopes, matrices, diverged = self._derivatives(z, groups)
        run = sorted(table)
        limits = [limit for limit in self.limits if limit.run in table]
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
        matrix: Any = sum(s * matrices[i] for s, i in zip(shares, run))
        cost = np.nan if diverged else float(shares @ costs)
        measures = tuple(table[i] for i in run)
        gradient = shares @ rates
        return Point(z, cost, gradient, matrix, margins, margin_slopes, measures, costs, rates)

    def _derivatives(
        self, z: Floats, groups: Sequence[sc.Group]
    ) -> tuple[dict[int, Any], dict[int, Any], dict[int, Any], bool]:
        """Return {run: measures}, {run: slopes by z}, {run: Gauss-Newton}, and if one diverged."""
        values = {name: np.float64(v) for name, v in self.values(z).items()}
        per_z = np.array([float(b.slope(v)) for b, v in zip(self.bounds, values.values())])
        table: dict[int, Any] = {}
        slopes: dict[int, Any] = {}
        matrices: dict[int, Any] = {}
        diverged = False
        for group in groups:
            measures, rates, curvature, broken = self._run(group, values)
            diverged = diverged or bool(np.asarray(broken).any())
            for j, i in enumerate(group.runs):
                table[i] = {m: np.asarray(v)[j] for m, v in measures.items()}
                slopes[i] = {
                    m: np.asarray(v)[j].reshape(-1, len(z)) * per_z for m, v in rates.items()
                }
                matrix = np.asarray(curvature)[j] * np.outer(per_z, per_z)
                matrices[i] = self._curvature(matrix, table[i], slopes[i])
        return table, slopes, matrices, diverged

    def _run(self, group: sc.Group, values: Mapping[str, Any]) -> tuple[Row, Row, Any, Any]:
        """Return (measures, slopes, Gauss-Newton, diverged) of a group, each (runs, ...)."""
        if len(values) <= FORWARD_LIMIT:
            squares = tuple((m, w) for m, w in self.objective.items() if m in ms.squares())
            if ROOT in self.objective or not squares:
                squares = (("mean_square_error", 1.0),)
            return sc.slopes_of(group, self.needed, values, squares)
        measures, slopes = sc.reverse_slopes_of(group, self.needed, values)
        nothing = np.full((len(group.runs), len(values), len(values)), np.nan)
        return measures, slopes, nothing, not all(np.all(np.isfinite(v)) for v in slopes.values())

    def _curvature(self, matrix: Floats, measures: Row, slopes: Row) -> Floats:
        if self.model != "cost" or ROOT not in self.objective:
            return matrix
        # of a root: (matrix of its square / 2 - slope slope') / root, which is never negative
        root, slope = max(float(measures[ROOT]), 1e-12), slopes[ROOT][0]
        return self.objective[ROOT] * (0.5 * matrix - np.outer(slope, slope)) / root

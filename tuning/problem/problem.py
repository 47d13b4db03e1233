"""What is made small and what must hold, as numbers with exact derivatives."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxtank import measures as ms
from jaxtank.core.errors import InputError
from jaxtank.core.tree import get_value, with_values
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.rig import check_objective
from tuning.problem import scenarios as sc
from tuning.problem.bounds import bounds
from tuning.problem.limits import NOT_A_NUMBER, resolve_in, room_of
from tuning.storage.evaluation_log import Memo

FORWARD_LIMIT = 24
"""Number of free parameters up to which derivatives run forward with the simulation; above,
checkpointed reverse, without a Gauss-Newton matrix.
"""

ROOT = "rms_error_total"
"""The measure that is the root of a sum of squares over all outputs."""


EXPLODED = 1e9
"""Size at which a cost, a margin or a slope is no longer a number to search with."""

RISKS = ("mean", "cvar", "worst")
"""What the costs of several scenarios come to: their weighted mean, the mean of the worst TAIL of
them, or the worst.
"""

TAIL = 0.05
"""Share of the scenarios that "cvar" is the mean of [-]."""


class Point(NamedTuple):
    """The problem at one point z of the unit cube, derivatives with respect to z."""

    z: np.ndarray  # (P,)
    cost: float  # weighted sum of measures, mean over scenarios
    gradient: np.ndarray  # (P,)
    # (P, P) second derivative of what `Problem.model` names, without the residuals' own curvature
    gauss_newton: np.ndarray
    margins: np.ndarray  # (limits,) in each measure's unit
    margin_slopes: np.ndarray  # (limits, P)
    measures: tuple  # of each scenario, {name: value}
    lane_costs: np.ndarray = np.zeros(0)  # (scenarios,)
    lane_slopes: np.ndarray = np.zeros((0, 0))  # (scenarios, P)
    rows: tuple = ()  # which of the problem's limits the margins are of, where not all

    @property
    def finite(self):
        """True if cost, margins and derivatives are numbers one can search with; a slope of 1e9 is
        that of a loop that has gone unstable.
        """
        return all(
            np.all(np.abs(v) < EXPLODED)
            for v in (self.cost, self.gradient, self.margins, self.margin_slopes)
        )


class Problem:
    """A case, its free parameters, its cost and its limits, over one run or several scenarios.

    free: {name: Free}; objective: {measure: weight} (a list measure counts with the sum of its
    entries; scenarios count with their weighted mean); limits as in resolve_limits, held in every
    scenario; scenarios: tuple of Scenario, () for the case's own run, None for those of the case;
    seed: of the sensor noise, which is the same for every evaluation (common random numbers); memo:
    a Memo of what was evaluated before; risk: what the costs of the scenarios come to, one of
    RISKS. `tune` takes a Problem in the place of a Case.
    """

    def __init__(
        self,
        case,
        free=None,
        objective=None,
        limits=None,
        scenarios=None,
        seed=0,
        memo=None,
        risk="mean",
    ):
        self.case, self.loop, self.clock, self.seed = case, case.loop, case.clock, seed
        self.given = dict(free=free, objective=objective, scenarios=scenarios, risk=risk)
        if risk not in RISKS:
            raise InputError(f"risk = {risk!r}: must be one of {', '.join(RISKS)}")
        self.risk = risk
        self.bounds = bounds(case.loop, case.free if free is None else free)
        self.objective = check_objective(case.objective if objective is None else objective)
        self.scenarios = sc.check_scenarios(
            case, case.scenarios if scenarios is None else scenarios, self.names
        )
        self.lanes = sc.lanes_of(case, self.scenarios, seed)
        self.groups = sc.groups_of(self.lanes)
        self.limit(limits)
        self.memo = Memo() if memo is None else memo
        self.simulations, self.gradients, self.non_finite = 0, 0, 0

    def limit(self, limits: Mapping[str, Any] | None) -> None:
        """Replace the limits by `limits`, as in `resolve_limits`.

        The evaluation cache holds margins of the former limits, and is emptied."""
        self.given["limits"] = limits
        self.limits = resolve_in(self.lanes, limits)
        self.rooms = np.array([room_of(limit, self.loop) for limit in self.limits])
        self.needed = tuple(
            dict.fromkeys([*self.objective, *(limit.measure for limit in self.limits)])
        )
        self.memo = Memo()

    @property
    def names(self) -> list[str]:
        """Dotted names of the P free scalars."""
        return [b.name for b in self.bounds]

    @property
    def model(self) -> str | None:
        """What the Gauss-Newton matrix is the second derivative of: "square" (the cost is one root
        mean square: its square), "cost", or None where no term of the cost is made of squares, or
        the parameters are too many to carry slopes of.
        """
        if len(self.bounds) > FORWARD_LIMIT:
            return None
        if self.risk != "mean":
            # the worst change from point to point: a second derivative of the mean says little
            return None
        if set(self.objective) == {ROOT} and len(self.lanes) == 1:
            return "square"
        return "cost" if any(m == ROOT or m in ms.squares() for m in self.objective) else None

    def start(self) -> np.ndarray:
        """(P,) z of the case's own values. Raises InputError if one lies outside its range."""
        z = []
        for b in self.bounds:
            value = float(get_value(self.loop, b.name))
            if not b.low <= value <= b.high:
                raise InputError(
                    f"{b.name} = {value:g} {b.unit}: starts outside its range {b.low:g}:{b.high:g}"
                    f" {b.unit}"
                )
            z.append(float(b.to_unit(value)))
        return np.array(z)

    def values(self, z: np.ndarray) -> dict[str, float]:
        """{name: value in its unit} at z."""
        return {b.name: float(b.from_unit(v)) for b, v in zip(self.bounds, z)}

    def loop_at(self, z: np.ndarray) -> ClosedLoop:
        """The loop with the values at z."""
        return with_values(self.loop, self.values(z))

    def cost(self, measures: Mapping[str, Any]) -> float:
        """Weighted sum of the measures of one run."""
        return sum(w * float(np.sum(measures[m])) for m, w in self.objective.items())

    def total(self, table: Sequence[Mapping[str, Any]]) -> float:
        """The cost of `table`, the measures of every scenario: what their costs come to by `risk`."""
        costs = np.array([self.cost(row) for row in table])
        return float(self.shares(costs, range(len(self.lanes))) @ costs)

    def shares(self, costs: np.ndarray, lanes: Sequence[int]) -> np.ndarray:
        """What the cost of each of `lanes` counts, given all their costs: its weight, or where it
        is among the worst. Sums to 1.
        """
        weights = np.array([self.lanes[i].weight for i in lanes])
        if self.risk == "mean" or not np.all(np.isfinite(costs)):
            return weights / weights.sum()
        order = np.argsort(-costs, kind="stable")
        count = 1 if self.risk == "worst" else max(1, int(np.ceil(TAIL * len(costs))))
        chosen = np.zeros(len(costs))
        chosen[order[:count]] = weights[order[:count]]
        return chosen / chosen.sum()

    def margins(self, table: Sequence[Mapping[str, Any]]) -> np.ndarray:
        """(limits,) margin of each limit, of the measures of every scenario."""
        return np.array([limit.margin(table[limit.lane]) for limit in self.limits])

    def screen(self, zs: np.ndarray, coarse: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """(costs (points,), margins (points, limits)) at many points (points, P), without
        derivatives; coarse: at the coarse clock.
        """
        zs = np.asarray(zs, dtype=float)
        self.simulations += len(zs) * len(self.lanes)
        return tuple(
            v.copy()
            for v in self.memo.recall("screen", [zs, coarse], lambda: self._screen(zs, coarse))
        )

    def _per_lane(self) -> list[Any]:
        return [None] * len(self.lanes)

    def _screen(self, zs, coarse):
        points = {b.name: jnp.asarray(b.from_unit(zs[:, i])) for i, b in enumerate(self.bounds)}
        tables, broken = [self._per_lane() for _ in zs], np.zeros(len(zs), dtype=bool)
        for group in self.groups:
            clock = sc.coarse_clock(group.clock) if coarse else group.clock
            measures, flags = sc.values_of(group, self.needed, points, clock)
            measures, broken = (
                {m: np.asarray(v) for m, v in measures.items()},
                broken | np.asarray(flags).any(axis=1),
            )
            for j, lane in enumerate(group.lanes):
                for i, table in enumerate(tables):
                    table[lane] = {m: v[i, j] for m, v in measures.items()}
        costs = np.where(broken, np.nan, [self.total(table) for table in tables])
        return costs, np.array([self.margins(table) for table in tables]).reshape(len(zs), -1)

    def point(self, z: np.ndarray) -> Point:
        """The Point at z: every scenario at its own step, with derivatives."""
        z = np.clip(np.asarray(z, dtype=float), 0.0, 1.0)
        self.simulations, self.gradients = (
            self.simulations + len(self.lanes),
            self.gradients + len(self.lanes),
        )
        found = Point(z, *self.memo.recall("point", [z], lambda: self._point(z, self.groups)))
        self.non_finite += not found.finite
        return found

    def rough(self, z: np.ndarray) -> Point:
        """The Point at z with a tenth of the samples, near enough to search with before the true
        one is asked.
        """
        z = np.clip(np.asarray(z, dtype=float), 0.0, 1.0)
        self.simulations, self.gradients = (
            self.simulations + len(self.lanes),
            self.gradients + len(self.lanes),
        )
        groups = [group._replace(clock=sc.rough_clock(group.clock)) for group in self.groups]
        return Point(z, *self.memo.recall("rough", [z], lambda: self._point(z, groups)))

    def part(self, z: np.ndarray, batch: int, rng: np.random.Generator) -> Point:
        """The Point at z of about `batch` scenarios drawn by rng, the same number of every group,
        so that nothing is compiled twice.
        """
        z, groups = np.clip(np.asarray(z, dtype=float), 0.0, 1.0), []
        for group in self.groups:
            count = min(len(group.lanes), max(1, round(batch * len(group.lanes) / len(self.lanes))))
            groups.append(
                sc.take(group, np.sort(rng.choice(len(group.lanes), count, replace=False)))
            )
        drawn = [i for group in groups for i in group.lanes]
        self.simulations, self.gradients = (
            self.simulations + len(drawn),
            self.gradients + len(drawn),
        )
        found = self.memo.recall(
            "part", [z, np.array(drawn, dtype=float)], lambda: self._point(z, groups)
        )
        return Point(
            z, *found, rows=tuple(i for i, limit in enumerate(self.limits) if limit.lane in drawn)
        )

    @np.errstate(over="ignore", invalid="ignore")  # what explodes is told by Point.finite
    def _point(self, z, groups):
        """The fields of the Point at z after z itself, of the lanes in `groups` alone; others count
        nothing.
        """
        values = {name: np.float64(v) for name, v in self.values(z).items()}
        per_z = np.array(
            [float(b.slope(np.float64(v))) for b, v in zip(self.bounds, values.values())]
        )
        count, ruined = len(z), False
        table, slopes, matrices = (self._per_lane() for _ in range(3))
        for group in groups:
            measures, rates, curvature, broken = self._run(group, values)
            ruined = ruined or bool(np.any(broken))
            for j, i in enumerate(group.lanes):
                table[i] = {m: np.asarray(v)[j] for m, v in measures.items()}
                slopes[i] = {
                    m: np.asarray(v)[j].reshape(-1, count) * per_z for m, v in rates.items()
                }
                matrices[i] = self._curvature(
                    np.asarray(curvature)[j] * np.outer(per_z, per_z), table[i], slopes[i]
                )
        mine = [limit for limit in self.limits if table[limit.lane] is not None]
        margins = np.array([limit.margin(table[limit.lane]) for limit in mine])
        margin_slopes = np.array(
            [-limit.sign * slopes[limit.lane][limit.measure][limit.index] for limit in mine]
        ).reshape(-1, count)
        margin_slopes[np.abs(margins) >= NOT_A_NUMBER] = 0.0
        run = [i for i, row in enumerate(table) if row is not None]
        costs = np.array([self.cost(table[i]) for i in run])
        rates = np.array(
            [sum(w * slopes[i][m].sum(axis=0) for m, w in self.objective.items()) for i in run]
        )
        shares = self.shares(costs, run)
        matrix = sum(s * matrices[i] for s, i in zip(shares, run))
        cost = np.nan if ruined else float(shares @ costs)
        return (
            cost,
            shares @ rates,
            matrix,
            margins,
            margin_slopes,
            tuple(table[i] for i in run),
            costs,
            rates,
        )

    def _squares(self):
        """((measure, weight), ...) of the sums of squares that the Gauss-Newton matrix is made of."""
        own = tuple((m, w) for m, w in self.objective.items() if m in ms.squares())
        return (("mean_square_error", 1.0),) if ROOT in self.objective or not own else own

    def _curvature(self, matrix, measures, slopes):
        if self.model != "cost" or ROOT not in self.objective:
            return matrix
        # of a root: (matrix of its square / 2 - slope slope') / root, which is never negative
        root, slope = max(float(measures[ROOT]), 1e-12), slopes[ROOT][0]
        return self.objective[ROOT] * (0.5 * matrix - np.outer(slope, slope)) / root

    def _run(self, group, values):
        if len(values) <= FORWARD_LIMIT:
            needed = tuple(
                dict.fromkeys(
                    [
                        *self.needed,
                        *([ROOT] if self.model == "cost" and ROOT in self.objective else []),
                    ]
                )
            )
            return sc.slopes_of(group, needed, values, self._squares())
        measures, slopes = sc.reverse_slopes_of(group, self.needed, values)
        broken = not all(np.all(np.isfinite(v)) for v in slopes.values())
        return (
            measures,
            slopes,
            np.full((len(group.lanes), len(values), len(values)), np.nan),
            broken,
        )

"""Whether a derivative is a slope to search with: tangents of a limit cycle grow, runs do not."""

from typing import Any, NamedTuple

import numpy as np

from jaxtank import measures as ms
from jaxtank.core.errors import InputError
from tuning.problem.evaluator import Evaluator
from tuning.problem.problem import Point, Problem

STEPS = (1e-3, 3e-4)  # lengths of the two secants, as shares of a range [-]

ORDERS = 2.0  # orders of magnitude by which a contradicted slope exceeds every secant

ROUNDING = 1e-9  # share of a value by which rounding may change it from run to run [-]


class SlopeCheck(NamedTuple):
    """The slope of the cost at a point, along its gradient, beside the runs near it."""

    usable: bool
    secants: tuple[float, ...]  # central differences of the cost, per unit of z, of either length
    # of magnitude by which a derivative that is of no use exceeds them; None: it is not finite
    orders: float | None

    def to_json(self) -> dict[str, Any]:
        """Return the check as plain numbers."""
        secants = [v if np.isfinite(v) else None for v in self.secants]
        return {"usable": self.usable, "secants": secants, "orders_above": self.orders}


def contradicted(predicted: Any, actual: Any, size: Any) -> Any:
    """Return (...,) True where derivatives exceed all actual changes by ORDERS."""
    predicted, actual = np.asarray(predicted), np.asarray(actual)
    actual = np.where(np.isfinite(actual), np.abs(actual), np.inf)
    borne_out = np.abs(predicted) <= 10.0**ORDERS * (actual + ROUNDING * np.abs(size))
    still = predicted == 0.0
    exceeded = np.any(~still, axis=0) & np.all(still | ~borne_out, axis=0)
    return bool(exceeded) if np.ndim(exceeded) == 0 else exceeded


@np.errstate(all="ignore")  # derivatives may be infinite here
def check_slope(evaluator: Evaluator, point: Point) -> SlopeCheck:
    """Return the SlopeCheck of a Point, by the cost and the limits of four runs beside it."""
    # As many points as `diagnostics.neighbours` has, so that one compiled program serves both.
    z, count = point.z, len(point.z)
    norm = float(np.linalg.norm(point.gradient))
    along = point.gradient / norm if 0.0 < norm < np.inf else np.full(count, count**-0.5)
    moves = [np.clip(z + sign * h * along, 0.0, 1.0) - z for h in STEPS for sign in (1.0, -1.0)]
    zs = np.concatenate([z[None], z + moves, np.repeat(z[None], max(0, 2 * count - 4), axis=0)])
    costs, margins = (v[:5] for v in evaluator.screen(zs))
    changes, steps = costs[1:] - costs[0], np.linalg.norm(moves, axis=1)
    predicted = np.array(moves) @ point.gradient
    unusable = contradicted(predicted, changes, costs[0]) or np.any(
        contradicted(np.array(moves) @ point.margin_slopes.T, margins[1:] - margins[0], margins[0])
    )
    secants = (changes[::2] - changes[1::2]) / (steps[::2] + steps[1::2])
    ratio = np.log10(norm / np.max(np.abs(secants)))
    usable = not (point.valued and unusable)
    orders = None if usable or not np.isfinite(ratio) else round(float(ratio), 1)
    return SlopeCheck(usable, tuple(map(float, secants)), orders)


def check_slopes(problem: Problem, point: Point) -> None:
    """Raise InputError for a function of the user's whose derivative at the start is NaN."""
    if not np.isfinite(point.cost):
        return
    bad = [*ms.functions(problem.objective)] if np.isnan(point.gradient).any() else []
    measured = zip(problem.limits, point.margin_slopes)
    bad += [limit.measure for limit, slope in measured if np.isnan(slope).any()]
    for name in ms.functions(bad):
        raise InputError(
            f"function {name}: its derivative by {', '.join(problem.names)} is not a number at the"
            " starting values, as of a root or a quotient at 0"
        )

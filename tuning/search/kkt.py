"""First-order optimality of an answer, and a step downhill where it does not hold."""

import numpy as np
import scipy

SLOPING = 0.05
"""KKT residual, of the scaled cost per unit of z, above which an answer is looked at once more: see
`downhill`.
"""


def optimality(search, point):
    """(gradient norm, KKT residual, multipliers of the limits) at a point, all of the scaled cost
    per unit of z.

    The residual is what is left of the gradient after the best non-negative combination of the
    slopes of active limits and bounds.
    """
    residual, multipliers = _left(search, point)
    return (
        float(np.linalg.norm(point.gradient / search.scale)),
        float(np.linalg.norm(residual)),
        multipliers,
    )


def _left(search, point):
    """(what is left of the gradient (P,), multipliers (limits,)); see `optimality`."""
    g = point.gradient / search.scale
    columns, owners = [], []
    room = point.margins / search.room - search.backoff
    for i, (m, slope) in enumerate(zip(room, point.margin_slopes / search.room[:, None])):
        if m < 1e-4:
            columns.append(slope)
            owners.append(i)
    for p, z in enumerate(point.z):
        if z < 1e-6 or z > 1 - 1e-6:
            columns.append(np.eye(len(g))[p] * (1.0 if z < 0.5 else -1.0))
            owners.append(None)
    multipliers = np.zeros(len(point.margins))
    residual = g
    if columns:
        matrix = np.array(columns).T
        found, _ = scipy.optimize.nnls(matrix, g)
        residual = g - matrix @ found
        for owner, value in zip(owners, found):
            if owner is not None:
                multipliers[owner] = value
    return residual, multipliers


STRIDES = (3e-2, 1e-2, 3e-3, 1e-3, 1e-4)
"""Steps along the slope that is left at an answer, in the unit cube, at which something better is
looked for.
"""

UNSTABLE = 1.0 / STRIDES[-1]
"""KKT residual, of the scaled cost per unit of z, by which the cost would fall below 0 within the
least
of STRIDES: the derivative of an unstable or chaotic run, exact, and of no use for a step.
"""

LOWER_BY = 1e-4
"""Share by which the cost must fall for a point to count as better than an answer at a kink [-]."""


def downhill(search, point):
    """A Point within the limits that is lower than `point` by more than the cost can be trusted to,
    found along the slope that is left of it;
    None where there is none: the point is an optimum, or at a kink.
    """
    residual, _ = _left(search, point)
    if np.linalg.norm(residual) <= SLOPING:
        return None
    for stride in STRIDES:
        other = search.point(point.z - stride * residual / np.linalg.norm(residual))
        if (
            other.finite
            and search.violation(other) == 0.0
            and other.cost < point.cost - LOWER_BY * abs(point.cost)
        ):
            return other
    return None

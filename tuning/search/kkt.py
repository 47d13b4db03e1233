"""First-order optimality of a point, and a step downhill where it does not hold.

Karush-Kuhn-Tucker conditions; imported by the methods, `stages` and `tuner`.
"""

import numpy as np
import scipy

SLOPING = 0.05
"""KKT residual, of the scaled cost per unit of z, above which `downhill` looks for a lower
point.
"""

STRIDES = (3e-2, 1e-2, 3e-3, 1e-3, 1e-4)
"""Steps along the gradient that is left, in the unit cube, at which `downhill` looks for a lower
point.
"""

UNSTABLE = 1.0 / STRIDES[-1]
"""KKT residual, of the scaled cost per unit of z, by which the cost would fall below 0 within the
least of STRIDES: the derivative of an unstable or chaotic run, exact, and of no use for a step.
"""

LOWER_BY = 1e-4
"""Share by which the cost must fall for a point to count as lower than one at a kink [-]."""


def optimality(search, point):
    """Return (gradient norm, KKT residual, multipliers of the limits) at a point."""
    # All of the scaled cost per unit of z. The residual is what is left of the gradient after the
    # best non-negative combination of the slopes of active limits and bounds. Infinite where a
    # derivative is not finite.
    if not point.finite:
        return np.inf, np.inf, np.zeros(len(point.margins))
    residual, multipliers = _residual(search, point)
    return (
        float(np.linalg.norm(point.gradient / search.scale)),
        float(np.linalg.norm(residual)),
        multipliers,
    )


def named_optimality(search, point):
    """Return {"gradient_norm", "kkt_residual", "multipliers": {limit: value}} of a point."""
    if search is None or point is None or not search.slope(point).usable:
        return {"gradient_norm": None, "kkt_residual": None, "multipliers": {}}
    norm, residual, multipliers = optimality(search, point)
    named = {limit.label: float(m) for limit, m in zip(search.problem.limits, multipliers) if m > 0}
    return {"gradient_norm": norm, "kkt_residual": residual, "multipliers": named}


def _residual(search, point):
    """Return (what is left of the gradient (P,), multipliers (limits,)); see `optimality`."""
    g = point.gradient / search.scale
    columns, owners = [], []
    margins = point.margins / search.limit_scale - search.tightening
    slopes = point.margin_slopes / search.limit_scale[:, None]
    for i, (margin, slope) in enumerate(zip(margins, slopes)):
        if margin < 1e-4:
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


def downhill(search, point):
    """Return a feasible Point that is lower than `point`, found along the gradient that is left."""
    if not point.finite:
        return None
    residual, _ = _residual(search, point)
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

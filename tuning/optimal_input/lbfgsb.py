"""L-BFGS in a box, for thousands of unknowns: directions on the free ones, steps bent at the walls."""

from collections import deque

import numpy as np

MEMORY = 12
"""Pairs of steps and slopes remembered."""

FLAT = 5
"""Iterations in a row without progress that end a search."""


def minimise(function, z, iterations, tolerance=1e-8):
    """(z, value, gradient, iterations) of a local minimum of `function` over the unit cube
    (Bertsekas 1982: two-metric projection).

    function: z (n,) -> (value, gradient (n,)); z: (n,) start, inside. The direction is that of
    limited-memory BFGS (Nocedal 1980) in the coordinates that are not held at a wall by their
    slope; the step is halved until the value falls by a ten-thousandth of what the slope promises.
    Ends after `iterations`, or where FLAT iterations in a row gain less than `tolerance` of the
    value or of 1e-2. (SciPy's L-BFGS-B does the same with small dense factorisations, which spend
    more on threads than such a simulation takes.)
    """
    value, gradient = function(z)
    pairs, flat, count = deque(maxlen=MEMORY), 0, 0
    for _ in range(iterations):
        count += 1
        free = ~(((z <= 0.0) & (gradient > 0.0)) | ((z >= 1.0) & (gradient < 0.0)))
        slope = np.where(free, gradient, 0.0)
        if not np.any(slope):
            break
        way = -_inverse_hessian(slope, pairs, free)
        if way @ slope > -1e-12 * np.linalg.norm(way) * np.linalg.norm(slope):
            pairs.clear()
            way = -slope
        step = 1.0 if pairs else min(1.0, 0.1 / np.max(np.abs(way)))
        for _ in range(30):
            new = np.clip(z + step * way, 0.0, 1.0)
            promised = gradient @ (new - z)
            trial, trial_gradient = function(new)
            if trial <= value + 1e-4 * promised:
                break
            step *= 0.5
        else:
            if not pairs:
                break
            pairs.clear()
            continue
        s, y = new - z, trial_gradient - gradient
        if s @ y > 1e-10 * (y @ y):
            pairs.append((s, y))
        flat = flat + 1 if value - trial <= tolerance * max(abs(trial), 1e-2) else 0
        z, value, gradient = new, trial, trial_gradient
        if flat >= FLAT:
            break
    return z, value, gradient, count


def _inverse_hessian(q, pairs, free):
    """The two loops of limited-memory BFGS, in the free coordinates alone."""
    used, q = [], q.copy()
    for s, y in reversed(pairs):
        s, y = np.where(free, s, 0.0), np.where(free, y, 0.0)
        curvature = s @ y
        if curvature <= 1e-10 * (y @ y) or curvature <= 0.0:
            continue
        a = (s @ q) / curvature
        q -= a * y
        used.append((s, y, a, curvature))
    if used:
        _, y, _, curvature = used[0]
        q *= curvature / (y @ y)
    for s, y, a, curvature in reversed(used):
        q += (a - (y @ q) / curvature) * s
    return q

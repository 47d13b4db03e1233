"""L-BFGS and Adam on an augmented Lagrangian, by optax; imported by `methods`."""

import numpy as np

from tuning.search.driver import SETTLED
from tuning.search.kkt import optimality

STEEPEST = 10.0
"""Largest gradient, of the scaled cost per unit of z, that a first-order method is given: a steep
cost near instability should turn it back, and not move it far away.
"""


def lbfgs(search, z, iterations):
    """Return True if optax's L-BFGS converged: halving steps, projected onto the bounds."""
    import optax

    return _augmented(search, z, iterations, optax.scale_by_lbfgs(memory_size=8), descend=True)


def adam(search, z, iterations):
    """Return True if optax's Adam converged: five steps an iteration, projected onto the bounds."""
    import optax

    steps = 5 * iterations
    schedule = optax.cosine_decay_schedule(0.05, max(steps // _rounds(search), 1), 0.002)
    return _augmented(search, z, steps, optax.adam(schedule), descend=False)


def minibatches(search, z, iterations, batch, rng):
    """Return True if optax's Adam converged on `batch` scenarios, drawn anew for every step."""
    import optax

    steps = 5 * iterations
    optimiser = optax.adam(optax.cosine_decay_schedule(0.05, steps, 0.002))
    state, every = optimiser.init(z), max(1, steps // 10)
    for k in range(steps):
        point = search.problem.batch_point(z, batch, rng)
        search.report(search)
        if not point.finite:
            z = 0.5 * (z + search.last_finite.z)
            continue
        scale = search.limit_scale[list(point.rows)]
        penalty = 100.0 * np.maximum(0.0, -point.margins / scale)
        g = point.gradient / search.scale - penalty @ (point.margin_slopes / scale[:, None])
        g = g * min(1.0, STEEPEST / max(float(np.linalg.norm(g)), 1e-300))
        update, state = optimiser.update(g, state, z)
        z = np.clip(z + np.asarray(update), 0.0, 1.0)
        if (k + 1) % every == 0:
            search.point(z)
    search.exhausted = True
    return search.best is not None and optimality(search, search.best)[1] < SETTLED


def _rounds(search):
    """Return how often the multipliers of the limits are updated."""
    return 4 if search.problem.limits else 1


def _augmented(search, z, iterations, optimiser, descend):
    """Return True if an optax optimiser converged on the augmented Lagrangian of the limits."""
    weights, stiffness, rounds = np.zeros(len(search.problem.limits)), 100.0, _rounds(search)

    def value(z):
        f, g = search.cost(z)
        if not len(weights):
            return f, g
        m, slopes = search.margins(z)
        penalty = np.maximum(0.0, weights - stiffness * m)
        return f + float(penalty @ penalty) / (2 * stiffness), g - penalty @ slopes

    for _ in range(rounds):
        state = optimiser.init(z)
        for _ in range(max(1, iterations // rounds)):
            f, g = value(z)
            g = g * min(1.0, STEEPEST / max(float(np.linalg.norm(g)), 1e-300))
            update, state = optimiser.update(g, state, z)
            step = np.asarray(update) if not descend else -np.asarray(update)
            new = np.clip(z + step, 0.0, 1.0)
            halvings = 0
            while descend and value(new)[0] > f - 1e-4 * abs(g @ (new - z)) and halvings < 12:
                step, halvings = 0.5 * step, halvings + 1
                new = np.clip(z + step, 0.0, 1.0)
            moved, z = float(np.linalg.norm(new - z)), new
            search.exhausted = moved >= 1e-6
            if not search.exhausted:
                break
        if len(weights):
            weights = np.maximum(0.0, weights - stiffness * search.margins(z)[0])
            stiffness *= 4
    return search.best is not None and optimality(search, search.best)[1] < SETTLED

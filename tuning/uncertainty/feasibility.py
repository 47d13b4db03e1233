"""Draws of which some plateau of the reference has no steady state; used by `study`."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.analysis.steady_state import steady_flows
from jaxtank.core.tree import with_values

BLOCK = 1 << 14
"""Draws whose steady states are computed at once: a plateau takes some 100 bytes a draw."""


def infeasible(case, values):
    """Return where a plateau of the reference has no steady state within rims and pump limits.

    Parameters
    ----------
    case : Case
    values : dict
        {name: (N, ...)} drawn parameters.

    Returns
    -------
    (N,) array of bool, or None
        None where the steady states of the plant have no closed form.
    """
    plant, plateaus = case.loop.plant, case.loop.reference.plateaus(case.clock.duration)
    if getattr(plant, "pipes", None) != () or plant.pumps != len(plant.outputs) or plateaus is None:
        return None
    plateaus = jnp.asarray(np.array(plateaus))
    count = len(next(iter(values.values())))
    size, found = min(count, BLOCK), []
    # the last draw repeated past the end, so that every block is of one size
    for start in range(0, count, size):
        index = np.minimum(np.arange(start, start + size), count - 1)
        found.append(
            np.asarray(
                _without_steady_state(case.loop, {n: v[index] for n, v in values.items()}, plateaus)
            )
        )
    return np.concatenate(found)[:count]


@jax.jit
def _without_steady_state(loop, values, plateaus):
    def one(values):
        here = with_values(loop, values)

        def at(y):
            speeds, u = steady_flows(here.plant, y)
            levels = speeds * speeds / (2.0 * here.plant.gravity)
            high = levels > here.plant.rim * (1.0 + 1e-12)
            return (
                jnp.any(speeds < 0)
                | jnp.any(high)
                | jnp.any(u < here.actuator.low)
                | jnp.any(u > here.actuator.high)
            )

        return jnp.any(jax.vmap(at)(plateaus))

    return jax.vmap(one)(values)

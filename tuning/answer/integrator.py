"""Whether the midpoint rule follows a plant closely enough for a search. What a search
finds is judged at the case's own step and integrator.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.case import Case
from jaxtank.core.clock import Clock
from jaxtank.loop.closed_loop import takes_arrays
from jaxtank.loop.step_size import unstable_tanks
from jaxtank.plants.runge_kutta import advance

LARGEST_ERROR = 1e-3
"""Largest `midpoint_error` with which the midpoint rule is used [-]: a fiftieth of the 5 % by which
flows differ from plant to plant."""

STATES = 256
"""States and inputs at which both are compared."""

LOWEST = 0.05
"""Least level of these states, as a share of the height [-]: closer to empty, stability limits the
step, which is checked separately."""


def midpoint_error(case: Case, clock: Clock, height: float, span: np.ndarray) -> float:
    """Return the relative difference of the midpoint rule and RK4 over one sample."""
    loop, plant = case.loop, case.loop.plant
    if any(unstable_tanks(loop, dataclasses.replace(clock, integrator="midpoint"))):
        return np.inf
    random, arrays = np.random.default_rng(0), takes_arrays(loop)
    low = np.broadcast_to(np.asarray(loop.actuator.low, float), (plant.pumps,))
    low = np.where(np.isfinite(low), np.maximum(low, -span), 0.0)
    x = height * random.uniform(LOWEST, 1.0, (STATES, plant.tanks))
    u = low + span * random.uniform(size=(STATES, plant.pumps))

    def changes(x: Any, u: Any) -> Any:
        start, inputs = (x, u) if arrays else (tuple(x), tuple(u))
        found = (
            advance(plant, rule, 0.0, start, inputs, None, clock.dt, clock.substeps).x
            for rule in ("midpoint", "rk4")
        )
        midpoint, rk4 = (jnp.asarray(levels) for levels in found)
        return jnp.sum((midpoint - rk4) ** 2), jnp.sum((rk4 - x) ** 2)

    off, moved = (float(jnp.sum(v)) for v in jax.jit(jax.vmap(changes))(x, u))
    share = np.sqrt(off / moved) if moved > 0.0 else np.inf
    return float(share) if np.isfinite(share) else np.inf

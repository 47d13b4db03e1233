"""Linear systems: discretisation. Jittable and differentiable; for use in front of the time loop."""

import jax.numpy as jnp
from jax.scipy.linalg import expm


def zero_order_hold(A, B, dt):
    """(Ad, Bd) of x' = A x + B u sampled every `dt` [s] with u held: exp([[A, B], [0, 0]] dt).

    A: (n, n) [1/s]; B: (n, m) [unit of x per s and unit of u].
    """
    n, m = B.shape
    block = jnp.concatenate([jnp.concatenate([A, B], axis=1), jnp.zeros((m, n + m))], axis=0)
    held = expm(block * dt)
    return held[:n, :n], held[:n, n:]

"""Linear predictive control with increments as sums of Laguerre functions (khalid, sec. IV)."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.controllers.incremental import LinearPredictive
from jaxtank.core.errors import InputError
from jaxtank.core.tree import component, leaf, static
from jaxtank.signals.base import Signal


def laguerre_functions(a, N, samples):
    """L(k)', k = 0 .. samples-1: (samples, N), orthonormal (khalid eq. 25, S4.3)."""
    # L(0) = sqrt(1 - a^2) [1, -a, a^2, ...]', L(k+1) = A_l L(k)
    # A_l: lower triangular, a on its diagonal and (1 - a^2) (-a)^(i-j-1) below. With a = 0 they are
    # unit pulses at k = 0 .. N-1. As z-transforms, sqrt(1-a^2) z/(z-a) [(1-az)/(z-a)]^(i-1): the
    # printed eq. (23) is a sample late (khalid notes E7).
    beta = 1.0 - a * a
    power = [jnp.ones_like(a)]  # products, not powers: 0^0 has no slope
    for _ in range(N):
        power.append(-a * power[-1])
    entry = lambda i, j: a if i == j else beta * power[i - j - 1] if i > j else jnp.zeros_like(a)
    step = jnp.stack([jnp.stack([entry(i, j) for j in range(N)]) for i in range(N)])
    first = jnp.sqrt(beta) * jnp.stack(power[:N])
    return jax.lax.scan(lambda now, _: (step @ now, now), first, None, length=samples)[1]


@component
class Laguerre(LinearPredictive):
    """The increments of pump i over the horizon are N Laguerre functions, du_i(k+m) = L_i(m)' eta_i
    (khalid eqs. 26-31, khalid notes S4.3).

        J = eta' Omega eta + 2 eta' Psi x_e,   eta = -Omega^-1 Psi x_e,   du_i(k) = L_i(0)' eta_i

    with y, r [cm] and du [V]. N numbers per pump replace ten or more increments of GPC; with a = 0
    it is GPC with Nc = N. Modes and constraints as in `LinearPredictive`; with "constrained" they
    are imposed on the next `rows` samples: 5 suffice, the tables of khalid notes S7.2 have 15.

    Examples
    --------
    >>> from jaxtank import presets
    >>> controller = presets.find("khalid/laguerre").loop.controller
    >>> controller.N, controller.a.tolist(), controller.basis().shape
    (4, [0.4], (40, 1, 4))
    """

    a: np.ndarray = leaf(
        "-", "pole of each pump's Laguerre functions (a)", low=0.0, high=0.999, shape="pump"
    )
    N: int = static("-", "Laguerre functions per pump (N)", low=1, high=30, default=4)
    Np: int = static("-", "prediction horizon (Np)", low=1, high=1000, default=40)
    rows: int = static(
        "-", "samples ahead on which constraints are imposed (Ncon)", low=1, high=1000, default=15
    )

    @property
    def ahead(self) -> int:
        return self.rows

    def basis(self) -> jax.Array:
        pumps = self.model.pumps
        blocks = []
        for i in range(pumps):
            functions = laguerre_functions(self.a[i] + jnp.zeros(()), self.N, self.Np)
            blocks.append(jnp.zeros((self.Np, pumps, self.N)).at[:, i].set(functions))
        return jnp.concatenate(blocks, axis=2)

    def check(self, reference: Signal) -> None:
        super().check(reference)
        if np.shape(self.a) != (self.model.pumps,):
            raise InputError(
                f"controller.a has shape {np.shape(self.a)}: must be ({self.model.pumps},), one"
                " pole per pump"
            )
        if self.rows > self.Np:
            raise InputError(
                f"controller.rows = {self.rows}: must be at most controller.Np = {self.Np}"
            )

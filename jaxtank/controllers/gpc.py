"""Generalized predictive control of a linear model (khalid, section III)."""

import jax
import jax.numpy as jnp

from jaxtank.controllers.incremental import LinearPredictive
from jaxtank.core.errors import InputError
from jaxtank.core.tree import component, static
from jaxtank.signals.base import Signal


@component
class GPC(LinearPredictive):
    """The next Nc increments of every pump are free, and later ones are zero.

        Y = F x + Phi dU,   J = |Rs - Y|^2 + r_w |dU|^2,   dU = (Phi'Phi + r_w I)^-1 Phi' (Rs - F x)
        (khalid eqs. 21-22, khalid notes S4.2)

    with y, r [cm] and du [V]. The first increment is applied. Modes and constraints as in
    `LinearPredictive`; with "constrained" they are imposed on the Nc samples.

    Examples
    --------
    >>> from jaxtank import presets
    >>> controller = presets.find("khalid/gpc").loop.controller
    >>> controller.Nc, controller.Np, controller.mode
    (10, 40, 'unconstrained')
    """

    Nc: int = static("-", "control horizon (Nc)", low=1, high=100, default=10)
    Np: int = static("-", "prediction horizon (Np)", low=1, high=1000, default=40)

    @property
    def ahead(self) -> int:
        return self.Nc

    def basis(self) -> jax.Array:
        pumps = self.model.pumps
        free = self.Nc * pumps
        return jnp.eye(self.Np * pumps)[:, :free].reshape(self.Np, pumps, free)

    def check(self, reference: Signal) -> None:
        super().check(reference)
        if self.Nc > self.Np:
            raise InputError(
                f"controller.Nc = {self.Nc}: must be at most controller.Np = {self.Np}"
            )

"""Generalized predictive control of a linear model (khalid, section III)."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.controllers.incremental import MODES, LinearPredictive
from jaxtank.core.errors import InputError
from jaxtank.core.tree import POSITIVE, component, leaf, static
from jaxtank.plants.network import TankNetwork
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

    model: TankNetwork
    operating_point: np.ndarray = leaf(
        "cm", "levels at which the model is linearised (H1, H2)", **POSITIVE, shape="tank"
    )
    r_w: np.ndarray = leaf("cm^2/V^2", "weight of the increments (rw)", **POSITIVE)
    q: np.ndarray = leaf("-", "weight of each output (Qy)", low=0.0, shape="output")
    du_limit: np.ndarray = leaf(
        "V", "largest change of each input in a sample", **POSITIVE, shape="pump"
    )
    u_low: np.ndarray = leaf("V", "lower limit of each input in the constraints", shape="pump")
    u_high: np.ndarray = leaf("V", "upper limit of each input in the constraints", shape="pump")
    Nc: int = static("-", "control horizon (Nc)", low=1, high=100, default=10)
    Np: int = static("-", "prediction horizon (Np)", low=1, high=1000, default=40)
    mode: str = static("-", "how limits enter", choices=MODES, default="unconstrained")

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

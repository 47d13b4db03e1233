"""Extended Kalman filter on the rig's own equations."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.records import Estimate
from jaxtank.core.tree import component, leaf, static
from jaxtank.observers.base import Observer
from jaxtank.observers.kalman import check_measured
from jaxtank.plants.base import Plant
from jaxtank.plants.runge_kutta import integrate


class Belief(NamedTuple):
    """What the filter carries on."""

    x: tuple  # (n) levels [cm]
    P: tuple  # (n) rows of n covariances [cm^2]


@component
class ExtendedKalman(Observer):
    """Extended Kalman filter (Jazwinski 1970): the model is carried on by an integrator step, its covariance by that step's Jacobian.

        correct, for each measured tank i in turn:  K = P e_i / (P_ii + r_i),  x += K (y_i - x_i),  P -= K e_i' P
        carry on:  x = Phi(x, u),  P = F P F' + Q dt,   F = d Phi / d x

    Phi is one or more steps of "rk4" or "midpoint" with u, the input after the pumps' limits, held. The noises of the sensors are independent, so
    that correcting by one after the other is the joint correction and no matrix is inverted.
    """

    model: Plant
    process: np.ndarray = leaf("cm^2/s", "(n,) variance that each level's own disturbance gains per second (Q)", low=0.0)
    measurement: np.ndarray = leaf(
        "cm^2", "(n,) variance of each sensor's noise (r); of unmeasured tanks not used", low=0.0, strict=True
    )
    spread: np.ndarray = leaf("cm^2", "(n,) variance of the levels believed at t = 0", low=0.0)
    start: np.ndarray | None = leaf("cm", "(n,) levels believed at t = 0; absent: the true ones", low=0.0, like="spread")
    measured: tuple = static(doc="tanks whose levels are measured, counted from 0")
    substeps: int = static("-", "integrator steps per sample", low=1, high=10, default=1)
    integrator: str = static(doc="how the model is carried on", choices=("rk4", "midpoint"), default="rk4")

    def init(self, x0):
        n = range(len(x0))
        x = x0 if self.start is None else tuple(self.start[i] + 0.0 * x0[i] for i in n)
        return Belief(x=x, P=tuple(tuple(self.spread[i] + 0.0 * x0[i] if i == j else 0.0 * x0[i] for j in n) for i in n))

    def step(self, state, tick, y):
        x, P = state
        n = range(len(x))
        for i in self.measured:
            K = [P[j][i] / (P[i][i] + self.measurement[i]) for j in n]
            x = tuple(x[j] + K[j] * (y[i] - x[i]) for j in n)
            P = _symmetric([[P[j][k] - K[j] * P[i][k] for k in n] for j in n])
        return Estimate(x=x), Belief(x, P)

    def predict(self, state, tick, command, applied):
        n, h = range(len(state.x)), tick.dt / self.substeps

        def onward(x):
            for j in range(self.substeps):
                x, _ = self.model.spill(integrate(self.model, self.integrator, tick.t + j * h, x, applied, None, h))
            return x

        one, zero = jnp.ones_like(state.x[0]), jnp.zeros_like(state.x[0])
        columns = [jax.jvp(onward, (state.x,), (tuple(one if i == j else zero for i in n),))[1] for j in n]  # columns[j][i] = F_ij
        FP = [[sum(columns[k][i] * state.P[k][j] for k in n) for j in n] for i in n]
        P = [[sum(FP[i][k] * columns[k][j] for k in n) + (self.process[i] * tick.dt if i == j else 0.0) for j in n] for i in n]
        return Belief(onward(state.x), _symmetric(P))

    def check(self, plant):
        check_measured(self, plant)


def _symmetric(P):
    """Rows whose lower half is the upper one: round-off would tear them apart."""
    return tuple(tuple(P[min(i, j)][max(i, j)] for j in range(len(P))) for i in range(len(P)))

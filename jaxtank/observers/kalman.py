"""Kalman filters: extended, and with the steady-state gain about an operating point."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.analysis.linear_model import linearise
from jaxtank.analysis.riccati import discrete_riccati, zero_order_hold
from jaxtank.core.errors import InputError
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import component, leaf, static
from jaxtank.observers.base import Observer
from jaxtank.plants.base import Plant
from jaxtank.plants.runge_kutta import advance


class Belief(NamedTuple):
    """State of the extended filter."""

    x: Sequence  # (n) levels [cm]
    P: tuple  # (n) rows of n covariances [cm^2]


@component
class ExtendedKalman(Observer):
    """Extended Kalman filter (Jazwinski 1970): the levels are predicted by an integrator step,
    their covariance by that step's Jacobian.

        correct, for each measured tank i in turn:  K = P e_i / (P_ii + r_i),  x += K (y_i - x_i),
        P -= K e_i' P
        predict:  x = Phi(x, u),  P = F P F' + Q dt,   F = d Phi / d x

    Phi is one or more steps of "rk4" or "midpoint" with u, the input after the pumps' limits, held.
    The noises of the sensors are independent, so that correcting by one after the other is the
    joint correction and no matrix is inverted. x [cm], P [cm^2].

    Examples
    --------
    >>> from jaxtank.plants.rigs import johansson
    >>> observer = ExtendedKalman(
    ...     model=johansson("minimum")[0],
    ...     process=[0.01] * 4,
    ...     measurement=[0.04] * 4,
    ...     spread=[0.04] * 4,
    ...     measured=(0, 1),
    ... )
    >>> tick = Tick(t=0.0, r=(12.0, 12.0), dr=(0.0, 0.0), ddr=(0.0, 0.0), dt=0.1)
    >>> start = observer.init((12.0, 12.0, 2.0, 2.0))
    >>> estimate, _ = observer.step(start, tick, (12.2, 12.0, 0.0, 0.0))
    >>> [round(float(h), 6) for h in estimate.x]  # equal variances: half the innovation
    [12.1, 12.0, 2.0, 2.0]
    """

    model: Plant
    process: np.ndarray = leaf(
        "cm^2/s", "(n,) variance that each level's own disturbance gains per second (Q)", low=0.0
    )
    measurement: np.ndarray = leaf(
        "cm^2",
        "(n,) variance of each sensor's noise (r); of unmeasured tanks not used",
        low=0.0,
        strict=True,
    )
    spread: np.ndarray = leaf("cm^2", "(n,) variance of the initial estimate at t = 0", low=0.0)
    start: np.ndarray | None = leaf(
        "cm",
        "(n,) initial estimate at t = 0; absent: the true ones",
        low=0.0,
        like="spread",
        default=None,
    )
    measured: tuple = static(doc="tanks whose levels are measured, counted from 0")
    substeps: int = static("-", "integrator steps per sample", low=1, high=10, default=1)
    integrator: str = static(
        doc="how the model is integrated", choices=("rk4", "midpoint"), default="rk4"
    )

    def init(self, x0: tuple) -> Any:
        n = range(len(x0))
        x = x0 if self.start is None else tuple(self.start[i] + 0.0 * x0[i] for i in n)
        return Belief(
            x=x,
            P=tuple(
                tuple(self.spread[i] + 0.0 * x0[i] if i == j else 0.0 * x0[i] for j in n) for i in n
            ),
        )

    def step(self, state: Any, tick: Tick, y: Sequence) -> tuple[Estimate, Any]:
        x, P = state
        n = range(len(x))
        for i in self.measured:
            K = [P[j][i] / (P[i][i] + self.measurement[i]) for j in n]
            x = tuple(x[j] + K[j] * (y[i] - x[i]) for j in n)
            P = _symmetric([[P[j][k] - K[j] * P[i][k] for k in n] for j in n])
        return Estimate(x=x), Belief(x, P)

    def predict(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        n = range(len(state.x))

        def onward(x):
            return advance(
                self.model, self.integrator, tick.t, x, applied, None, tick.dt, self.substeps
            ).x

        one, zero = jnp.ones_like(state.x[0]), jnp.zeros_like(state.x[0])
        # columns[j][i] = F_ij
        columns = [
            jax.jvp(onward, (state.x,), (tuple(one if i == j else zero for i in n),))[1] for j in n
        ]
        FP = [[sum(columns[k][i] * state.P[k][j] for k in n) for j in n] for i in n]
        P = [
            [
                sum(FP[i][k] * columns[k][j] for k in n)
                + (self.process[i] * tick.dt if i == j else 0.0)
                for j in n
            ]
            for i in n
        ]
        return Belief(onward(state.x), _symmetric(P))

    def check(self, plant: Plant) -> None:
        check_measured(self, plant)


def _symmetric(P):
    """Rows whose lower half is the upper one: round-off would make them differ."""
    return tuple(tuple(P[min(i, j)][max(i, j)] for j in range(len(P))) for i in range(len(P)))


@component
class Kalman(Observer):
    """Linear Kalman filter in current form, with its steady-state gain, on the model linearised at
    (levels, inputs).

        x_hat = x_prior + L (y - C x_prior),      L = P C' (C P C' + R)^-1
        x_prior(k+1) = xo + Ad (x_hat - xo) + Bd (u - uo) + drift,   (Ad, Bd) sampled with the input
        held

    P is the prior covariance of the steady filter (Kalman 1960; discrete Riccati equation), Q =
    process * dt, R = measurement. The drift is the model's rate at (xo, uo), 0 at a steady
    state. u [V] is the input after the pumps' limits. Levels that are not in `measured` are
    estimated from the others.

    Examples
    --------
    >>> from jaxtank.plants.rigs import johansson
    >>> observer = Kalman(
    ...     model=johansson("minimum")[0],
    ...     levels=[12.0, 12.0, 2.0, 2.0],
    ...     inputs=[3.0, 3.0],
    ...     process=[0.01] * 4,
    ...     measurement=[0.04] * 4,
    ...     measured=(0, 1),
    ... )
    >>> observer.measured, observer.levels.tolist()
    ((0, 1), [12.0, 12.0, 2.0, 2.0])
    """

    model: Plant
    levels: np.ndarray = leaf("cm", "(n,) operating levels xo", low=0.0)
    inputs: np.ndarray = leaf("V", "(m,) operating inputs uo")
    process: np.ndarray = leaf(
        "cm^2/s",
        "(n,) variance that each level's own disturbance gains per second",
        low=0.0,
        strict=True,
    )
    measurement: np.ndarray = leaf(
        "cm^2",
        "(n,) variance of each sensor's noise; of unmeasured tanks not used",
        low=0.0,
        strict=True,
    )
    measured: tuple = static(doc="tanks whose levels are measured, counted from 0")

    def design(self, dt: float) -> tuple:
        """Return (Ad (n, n), Bd (n, m), drift (n,) [cm], L (n, measured)) for period dt [s]."""
        A, B, _ = linearise(self.model, self.levels, self.inputs)
        rest = jnp.stack(
            self.model.derivative(
                0.0, tuple(jnp.asarray(self.levels)), tuple(jnp.asarray(self.inputs)), None
            )
        )
        Ad, held = zero_order_hold(A, jnp.concatenate([B, rest[:, None]], axis=1), dt)
        C = jnp.eye(self.model.tanks)[np.array(self.measured)]
        R = jnp.diag(jnp.asarray(self.measurement)[np.array(self.measured)])
        P = discrete_riccati(Ad.T, C.T, jnp.diag(jnp.asarray(self.process) * dt), R)
        return Ad, held[:, :-1], held[:, -1], jnp.linalg.solve(C @ P @ C.T + R, C @ P).T

    def init(self, x0: tuple) -> Any:
        return x0

    def step(self, state: Any, tick: Tick, y: Sequence) -> tuple[Estimate, Any]:
        L = self.design(tick.dt)[3]
        innovation = [y[i] - state[i] for i in self.measured]
        x = tuple(
            state[i] + sum(L[i, k] * v for k, v in enumerate(innovation)) for i in range(len(state))
        )
        return Estimate(x=x), x

    def predict(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        Ad, Bd, drift, _ = self.design(tick.dt)
        n, m = range(len(state)), range(len(applied))
        away, more = (
            [state[i] - self.levels[i] for i in n],
            [applied[j] - self.inputs[j] for j in m],
        )
        return tuple(
            self.levels[i]
            + drift[i]
            + sum(Ad[i, j] * away[j] for j in n)
            + sum(Bd[i, j] * more[j] for j in m)
            for i in n
        )

    def check(self, plant: Plant) -> None:
        check_measured(self, plant)
        if np.shape(self.inputs) != (plant.pumps,):
            raise InputError(
                f"observer.inputs has shape {np.shape(self.inputs)}: must be ({plant.pumps},), one"
                " per pump"
            )


def check_measured(observer, plant):
    """Raise InputError unless the observer's model and leaves fit the plant and `measured` names
    its tanks, each once.
    """
    n = plant.tanks
    if observer.model.tanks != n or observer.model.pumps != plant.pumps:
        raise InputError(
            f"observer.model has {observer.model.tanks} tanks and {observer.model.pumps} pumps, the"
            f" plant {n} and {plant.pumps}"
        )
    for name in ("levels", "process", "measurement"):
        if hasattr(observer, name) and np.shape(getattr(observer, name)) != (n,):
            raise InputError(
                f"observer.{name} has shape {np.shape(getattr(observer, name))}: must be ({n},),"
                " one per tank"
            )
    tanks = observer.measured
    if not tanks or len(set(tanks)) != len(tanks) or not all(0 <= i < n for i in tanks):
        raise InputError(
            f"observer.measured = {tanks}: must name at least one of the {n} tanks, counted from 0,"
            " each once"
        )

"""Linear Kalman filter with its steady-state gain about an operating point."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxtank.analysis.elimination import solve_all
from jaxtank.analysis.linear_model import linearise
from jaxtank.analysis.riccati import discrete_riccati, zero_order_hold
from jaxtank.core.errors import InputError
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import POSITIVE, component, leaf, static
from jaxtank.observers.base import Observer
from jaxtank.observers.checks import check_disturbed, check_model, check_tanks
from jaxtank.plants.base import Plant
from jaxtank.plants.network import TankNetwork


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

    `disturbed` names tanks whose level rate has an unknown part w [cm/s], a random walk that gains
    the variance `walk` per second; x is then extended by them, w(k+1) = w(k). There can be no more
    of them than measured tanks, and each must act on one. What the controller receives is the part
    that the model itself does not explain: d = w + f(xo, uo) + A (x_hat - xo) + B (u - uo) -
    f(x_hat, u), which has no share of the curvature that the linear model lacks. Where inputs do
    not act linearly (valves, curves of pumps), their share in it is that of the last sample.

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
    levels: np.ndarray = leaf("cm", "operating levels xo", low=0.0, shape="tank")
    inputs: np.ndarray = leaf("V", "operating inputs uo", shape="pump")
    process: np.ndarray = leaf(
        "cm^2/s",
        "variance that each level's own disturbance gains per second",
        **POSITIVE,
        shape="tank",
    )
    measurement: np.ndarray = leaf(
        "cm^2",
        "variance of each sensor's noise; of unmeasured tanks not used",
        **POSITIVE,
        shape="tank",
    )
    walk: np.ndarray | None = leaf(
        "cm^2/s^3",
        "variance that the disturbance of each level's rate gains per second; of tanks not in"
        " `disturbed` not used",
        **POSITIVE,
        like="process",
        default=None,
        shape="tank",
    )
    measured: tuple = static(doc="tanks whose levels are measured, counted from 0")
    disturbed: tuple = static(
        doc="tanks whose rate has a disturbance that is estimated, counted from 0", default=()
    )

    def design(self, dt: float) -> tuple:
        """Return (Ad, Bd, drift [cm], L) for period dt [s].

        Shapes (n, n), (n, m), (n,) and (n, measured), with n + disturbed for n where
        there are disturbances.
        """
        A, B, _ = linearise(self.model, self.levels, self.inputs)
        n, walks, tanks = self.model.tanks, len(self.disturbed), np.array(self.disturbed, dtype=int)
        rest = jnp.stack(
            self.model.derivative(
                0.0, tuple(jnp.asarray(self.levels)), tuple(jnp.asarray(self.inputs)), None
            )
        )
        A = jnp.pad(A, ((0, walks), (0, walks)))
        A = A.at[tanks, n + np.arange(walks)].set(1.0)
        inputs = jnp.pad(jnp.concatenate([B, rest[:, None]], axis=1), ((0, walks), (0, 0)))
        Ad, sampled = zero_order_hold(A, inputs, dt)
        C = jnp.eye(n + walks)[np.array(self.measured)]
        R = jnp.diag(jnp.asarray(self.measurement)[np.array(self.measured)])
        Q = jnp.asarray(self.process)
        if self.disturbed:
            Q = jnp.concatenate([Q, jnp.asarray(self.walk)[tanks]])
        P = discrete_riccati(Ad.T, C.T, jnp.diag(Q * dt), R)
        return Ad, sampled[:, :-1], sampled[:, -1], solve_all(C @ P @ C.T + R, C @ P).T

    def init(self, x0: tuple) -> Any:
        zero = tuple(0.0 * x0[i] for i in self.disturbed)
        return (*x0, *zero, *(zero if self._curved else ()))

    @property
    def _curved(self) -> bool:
        """Whether the effect of inputs may depend on levels, or be no straight line."""
        m = self.model
        return not isinstance(m, TankNetwork) or bool(m.valves or m.curves or m.lift_curves)

    def step(self, state: Any, tick: Tick, y: Sequence) -> tuple[Estimate, Any]:
        L = self.design(tick.dt)[3]
        innovation = [y[i] - state[i] for i in self.measured]
        n, size = self.model.tanks, self.model.tanks + len(self.disturbed)
        x = tuple(
            state[i] + sum(L[i, k] * v for k, v in enumerate(innovation)) for i in range(size)
        )
        d = self._unexplained(x[:n], x[n:], state[size:])
        return Estimate(x=x[:n], d=d), (*x, *state[size:])

    def _unexplained(self, x, walks, of_inputs):
        """(n) rates that the model itself does not explain [cm/s]; () without `disturbed`."""
        if not self.disturbed:
            return ()
        A, _, _ = linearise(self.model, self.levels, self.inputs)
        # at the operating inputs; `of_inputs`: what others change beyond B (u - uo)
        inputs, n = tuple(jnp.asarray(self.inputs)), range(len(x))
        at = self.model.derivative(0.0, tuple(jnp.asarray(self.levels)), inputs, None)
        rates = self.model.derivative(0.0, tuple(x), inputs, None)
        d = [0.0 * h for h in x]
        for i, w in zip(self.disturbed, walks):
            d[i] = w + ((at[i] + sum(A[i, j] * (x[j] - self.levels[j]) for j in n)) - rates[i])
        for i, beyond in zip(self.disturbed, of_inputs):
            d[i] = d[i] + beyond
        return tuple(d)

    def _of_inputs(self, x, u):
        """Per disturbed tank B (u - uo) - (f(x, u) - f(x, uo)) [cm/s]; () where that is 0."""
        if not self._curved or not self.disturbed:
            return ()
        _, B, _ = linearise(self.model, self.levels, self.inputs)
        at = self.model.derivative(0.0, tuple(x), tuple(jnp.asarray(self.inputs)), None)
        rates = self.model.derivative(0.0, tuple(x), tuple(u), None)
        away = [v - o for v, o in zip(u, self.inputs)]
        return tuple(
            sum(B[i, j] * v for j, v in enumerate(away)) - (rates[i] - at[i])
            for i in self.disturbed
        )

    def predict(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        Ad, Bd, drift, _ = self.design(tick.dt)
        n, m = range(self.model.tanks + len(self.disturbed)), range(len(applied))
        centre = [self.levels[i] if i < self.model.tanks else 0.0 for i in n]
        away, more = ([state[i] - centre[i] for i in n], [applied[j] - self.inputs[j] for j in m])
        forward = tuple(
            centre[i]
            + drift[i]
            + sum(Ad[i, j] * away[j] for j in n)
            + sum(Bd[i, j] * more[j] for j in m)
            for i in n
        )
        return (*forward, *self._of_inputs(state[: self.model.tanks], applied))

    def check(self, plant: Plant) -> None:
        check_model(self, plant)
        if self.model.depends_on_time:
            raise InputError(
                "observer.model: its rates depend on time, and this filter has one linear model:"
                " use the disturbance observer, extended-kalman or moving-horizon"
            )
        check_tanks(self, "measured", plant)
        check_disturbed(self, plant, self.levels)

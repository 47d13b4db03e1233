"""Base of the linear predictive controllers of khalid: incremental model, cost, constraints."""

import abc
import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.analysis import qp
from jaxtank.analysis.elimination import solve_all
from jaxtank.analysis.linear_model import linearise
from jaxtank.analysis.riccati import zero_order_hold
from jaxtank.controllers.base import Controller
from jaxtank.core.errors import InputError
from jaxtank.core.numerics import clip
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import POSITIVE, component, leaf, static
from jaxtank.instruments.base import Actuator
from jaxtank.plants.network import TankNetwork
from jaxtank.signals.base import Signal

MODES = ("unconstrained", "clipped", "constrained")
THRESHOLD = 1e-9  # laminar threshold of the linearisation [cm]: the paper's roots have none


class LastSample(NamedTuple):
    """State of the controller: measured levels (n) [cm] and applied inputs (m) [V]."""

    x: Sequence
    u: Sequence


def incremental_model(model, operating_point, dt, inputs=None):
    """Return (A, B, C) of x = [dx_m; y] (khalid eqs. 16-17, khalid notes S4.1)."""
    # a plain rig is linear in its inputs: their value has no effect
    inputs = jnp.zeros(model.pumps) if inputs is None else inputs
    Ac, Bc, Cm = linearise(dataclasses.replace(model, knee=THRESHOLD), operating_point, inputs)
    Am, Bm = zero_order_hold(Ac, Bc, dt)
    n, q = Am.shape[0], Cm.shape[0]
    A = jnp.block([[Am, jnp.zeros((n, q))], [Cm @ Am, jnp.eye(q)]])
    B = jnp.concatenate([Bm, Cm @ Bm])
    return A, B, jnp.concatenate([jnp.zeros((q, n)), jnp.eye(q)], axis=1)


def quadratic_cost(A, B, C, q, r_w, basis):
    """Return (Omega, Psi) of J = eta' Omega eta + 2 eta' Psi x_e + const (khalid eqs. 29-31).

    The increments are du(k+m) = basis(m) eta (khalid notes S4.3).
    """
    # with Q = C' diag(q) C, x_e = [dx_m; y - r], and sums over m = 1 .. Np:
    #   phi(m)' = A phi(m-1)' + B basis(m-1)
    #   Omega = sum phi(m) Q phi(m)' + r_w I,   Psi = sum phi(m) Q A^m
    # The paper prints sums over the number of terms instead of Np (khalid notes E10).
    n, variables = A.shape[0], basis.shape[2]

    def next_sample(carry, increments):
        phi, power = carry
        phi, power = A @ phi + B @ increments, A @ power
        outputs = C @ phi
        square = outputs.T @ (q[:, None] * outputs)
        return (phi, power), (square, outputs.T @ (q[:, None] * (C @ power)))

    start = jnp.zeros((n, variables)), jnp.eye(n)
    _, (squares, products) = jax.lax.scan(next_sample, start, basis)
    return squares.sum(axis=0) + r_w * jnp.eye(variables), products.sum(axis=0)


@component
class LinearPredictive(Controller):
    """Predictive control u(k) = u(k-1) + du(k) [V] on the incremental model (khalid section III).

    du minimises a quadratic cost over the horizon. u(k-1) is the input after the limits of the
    pumps; there is no other anti-windup. Three modes:

    - "unconstrained": du = -K x_e, without limits.
    - "clipped": the same du clipped to +-du_limit, then u clipped to [u_low, u_high].
    - "constrained": the quadratic programme with these limits on the first `ahead` samples (khalid
      eq. 32, khalid notes S4.4).

    dx_m is the change of the levels since the last sample. Without an estimate of disturbances it
    is the difference of two readings. If the observer estimates disturbances d of the level rates
    [cm/s], dx_m is computed from the model:

        dx_m = W (f(x_hat) + g u(k-1) + d),   W = int_0^dt exp(-A s) ds

    A is the rig linearised at the operating point, f + g u the rates of the nonlinear rig. Then the
    noise of two readings does not enter, and a change of d acts at once. At constant levels dx_m is
    0 in both cases, so that the steady error stays 0.
    """

    bumpless = True
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
    mode: str = static("-", "how limits enter", choices=MODES, default="unconstrained")

    @property
    @abc.abstractmethod
    def ahead(self) -> int:
        """Return the number of samples ahead on which the constraints are imposed [-]."""

    @abc.abstractmethod
    def basis(self) -> jax.Array:
        """Return (Np, m, variables): increments of m pumps over Np samples for each variable."""

    def design(self, dt: float) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return (Omega (v, v), Psi (v, n+q), basis (Np, m, v)) of `quadratic_cost`.

        v is the number of variables, `dt` the sampling period [s].
        """
        basis = self.basis()
        A, B, C = incremental_model(self.model, self.operating_point, dt, self._inputs())
        return *quadratic_cost(A, B, C, jnp.asarray(self.q), self.r_w, basis), basis

    def gain(self, dt: float) -> jax.Array:
        """Return K (m, n+q) [V/cm] in du = -K [dx_m; y - r] at the sampling period `dt` [s]."""
        Omega, Psi, basis = self.design(dt)
        return basis[0] @ solve_all(Omega, Psi)

    def init(self, x0: tuple, u0: tuple) -> Any:
        return LastSample(x=x0, u=u0)

    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence, Any]:
        x = estimate.x
        error = self._change(state, tick, estimate)
        error += [x[i] - r for i, r in zip(self.model.outputs, tick.r)]
        pumps = range(self.model.pumps)
        if self.mode == "constrained":
            du = self._constrained(state.u, jnp.stack(error), tick.dt)
        else:
            K = self.gain(tick.dt)
            du = [-sum(K[i, j] * e for j, e in enumerate(error)) for i in pumps]
        if self.mode == "clipped":
            du = [clip(du[i], -self.du_limit[i], self.du_limit[i]) for i in pumps]
        u = [state.u[i] + du[i] for i in pumps]
        # after the quadratic programme: the interior point may pass a limit by 1e-9 of the range
        if self.mode != "unconstrained":
            u = [clip(u[i], self.u_low[i], self.u_high[i]) for i in pumps]
        return tuple(u), LastSample(x=x, u=state.u)

    def _inputs(self):
        """Return inputs (m,) [V] at which the model is linearised; any value for a plain rig."""
        if getattr(self.model, "plain", True):
            return jnp.zeros(self.model.pumps)
        middle = 0.5 * (jnp.asarray(self.u_low) + jnp.asarray(self.u_high))
        return jnp.where(jnp.isfinite(middle), middle, 0.5)

    def _change(self, state, tick, estimate):
        """Return dx_m (n): the change of each level since the last sample [cm]."""
        if not estimate.d:
            return [a - b for a, b in zip(estimate.x, state.x)]
        model = dataclasses.replace(self.model, knee=THRESHOLD)
        A, _, _ = linearise(model, self.operating_point, self._inputs())
        tanks = range(self.model.tanks)
        W = zero_order_hold(-A, jnp.eye(len(tanks)), tick.dt)[1]
        rates = self.model.derivative(tick.t, tuple(estimate.x), tuple(state.u), None)
        rates = [rate + d for rate, d in zip(rates, estimate.d)]
        return [sum(W[i, j] * rates[j] for j in tanks) for i in tanks]

    def _constrained(self, last_inputs, error, dt):
        """Return du (m,) from the quadratic programme; error: x_e (n+q,)."""
        Omega, Psi, basis = self.design(dt)
        steps = basis[: self.ahead]
        rows = jnp.concatenate([steps, jnp.cumsum(steps, axis=0)]).reshape(-1, Omega.shape[0])
        stacked = lambda v: jnp.stack([v[i] for i in range(self.model.pumps)])
        limit, low, high = map(stacked, (self.du_limit, self.u_low, self.u_high))
        u = jnp.stack(last_inputs)
        lower = jnp.concatenate([jnp.tile(-limit, self.ahead), jnp.tile(low - u, self.ahead)])
        upper = jnp.concatenate([jnp.tile(limit, self.ahead), jnp.tile(high - u, self.ahead)])
        return basis[0] @ qp.solve(2.0 * Omega, 2.0 * (Psi @ error), rows, lower, upper)

    def track(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        return state._replace(u=applied)

    def check_pumps(self, actuator: Actuator) -> None:
        """Raise InputError if the quadratic programme may be infeasible at the first sample."""
        if self.mode != "constrained":
            return
        unit = self.model.units[1]
        ends = self.u_low, self.u_high, actuator.initial, actuator.low, actuator.high
        pumps = zip(*(np.asarray(v, dtype=float) for v in ends))
        for i, (low, high, initial, pump_low, pump_high) in enumerate(pumps):
            limits = f"controller.u_low = {low:g} {unit} to controller.u_high = {high:g} {unit}"
            if not low <= initial <= high:
                raise InputError(
                    f"actuator.initial[{i}] = {initial:g} {unit}: must lie within the limits of a"
                    f" constrained controller, {limits}"
                )
            if pump_low > high or pump_high < low:
                raise InputError(
                    f"actuator.low[{i}] = {pump_low:g} {unit}, actuator.high[{i}] = {pump_high:g}"
                    f" {unit}: the range must overlap the limits of a constrained controller,"
                    f" {limits}"
                )

    def check(self, reference: Signal) -> None:
        point, length = np.asarray(self.operating_point), self.model.units[0]
        for first, second in self.model.pipes:
            if not abs(point[first] - point[second]) > 10 * self.model.knee:
                raise InputError(
                    f"controller.operating_point = {point} {length}: levels joined by a pipe must"
                    f" differ by more than {10 * self.model.knee:g} {length}: at equal levels the"
                    " model has no derivative (khalid notes H4)"
                )
        if not np.all(np.asarray(self.u_low) < np.asarray(self.u_high)):
            raise InputError(
                f"controller.u_low = {self.u_low}: must be below controller.u_high = {self.u_high}"
            )

"""State feedback around the setpoint's steady state (mirakhorli sec. 4.2), also integral."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.analysis.elimination import solve
from jaxtank.analysis.linear_model import linearise
from jaxtank.analysis.riccati import lqr
from jaxtank.analysis.steady_state import check_rest, steady_along, steady_flows, steady_under
from jaxtank.controllers.base import Controller
from jaxtank.core.clock import pointwise
from jaxtank.core.errors import InputError
from jaxtank.core.labels import input_unit, label_of
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import POSITIVE, component, leaf, static
from jaxtank.instruments.base import Actuator
from jaxtank.plants.base import Plant
from jaxtank.plants.network import TankNetwork
from jaxtank.signals.base import Signal


def feedback(K, x, h0, u0):
    """Return (m) u0 - K (h - h0) [V] for K (m, n) [V/cm] and the steady state h0 [cm], u0 [V]."""
    # mirakhorli eqs. (14)-(15) print u = -K'x with K = -R^-1 B'P: the literal sign is unstable, and
    # without u0 the pumps are off (mirakhorli notes E11).
    away = [h - h_s for h, h_s in zip(x, h0)]
    return tuple(u - sum(K[j, i] * a for i, a in enumerate(away)) for j, u in enumerate(u0))


def _steady(controller, plan, d):
    """The steady state (h0, u0) that was prepared, moved by disturbances d of the level rates."""
    h0, u0 = plan
    if not d:
        return h0, u0
    if controller.inflow is not None:
        raise InputError(
            "controller.inflow: leave it out beside an observer that estimates disturbances: these"
            " have the inflow in them"
        )
    return steady_under(controller.model, h0, u0, d)


def _inflow() -> Any:
    return leaf(
        "cm^3/s",
        "steady inflow of each tank that no pump brings; left out: none, or an observer finds it",
        shape="tank",
        like="model.rim",
        default=None,
    )


def check_free_outlets(model):
    """Raise InputError unless steady states of `model` follow from a linear balance."""
    if getattr(model, "pipes", None) != () or model.pumps != len(model.outputs):
        raise InputError(
            "controller.model must be a network without pipes and with as many pumps and valves as"
            " outputs: this controller needs its steady states"
        )
    if not model.plain:
        check_rest(model, "controller.model")


@component
class StateFeedback(Controller):
    """u = u0(r) - K (h - h0(r)), with h0 [cm] and u0 [V] the steady state of the model at the
    setpoint (mirakhorli sec. 4.2).

    No integral action: the steady error is zero only if the model is exact (mirakhorli notes E21),
    or if an observer estimates what it lacks: with disturbances d of the level rates [cm/s], h0 and
    u0 are the steady state of f + g u + d at the setpoint (`steady_under`). The loop then rests
    where h = h0 and u = u0, and the outputs are at their setpoints. A steady `inflow` counts in f.

    Examples
    --------
    >>> from jaxtank.plants.rigs import johansson
    >>> controller = StateFeedback(model=johansson("minimum")[0], K=np.full((2, 4), 0.1))
    >>> h0 = (12.0, 12.0, 2.0, 2.0)
    >>> tick = Tick(t=0.0, r=(12.0, 12.0), dr=(), ddr=(), plan=(h0, (3.0, 3.0)))
    >>> u, _ = controller.step((), tick, Estimate(x=(11.0, 12.0, 2.0, 2.0)))
    >>> [round(float(v), 6) for v in u]
    [3.1, 3.1]
    """

    model: Plant
    K: np.ndarray = leaf("V/cm", "gain K", shape=("pump", "tank"))
    inflow: np.ndarray | None = _inflow()

    @pointwise
    def prepare(self, r: tuple, dr: tuple, ddr: tuple) -> Any:
        return steady_along(self.model, r, self.inflow)

    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence, Any]:
        h0, u0 = _steady(self, tick.plan, estimate.d)
        return feedback(self.K, estimate.x, h0, u0), state

    def check(self, reference: Signal) -> None:
        check_free_outlets(self.model)


@component
class LQI(Controller):
    """State feedback with integrals of the errors, whose gain is designed here (not in the paper:
    mirakhorli notes S4.6).

        u = u0(r) - K (h - h0(r)) - Ki z,    z' = h_outputs - r

    While a pump is at a limit and the integrals would take it further beyond, they move the other
    inputs alone (`anti_windup` = "directional"), or stand still ("frozen": a pump can then stay at
    its limit for good, after operation by hand, or where the model is wrong).
    [K, Ki]: linear-quadratic gain of the model linearised at the steady state of `operating_point`,
    extended by z, for the weights diag(Q) and diag(R); h, r [cm], z [cm s], u [V]. The gain depends
    on its weights, model and operating point, and so do its derivatives. With disturbances d that
    an observer estimates, h0 and u0 are the steady state under them, as in `StateFeedback`: the
    integrals then have nothing to do at a steady state.

    Examples
    --------
    >>> from jaxtank import presets
    >>> controller = presets.find("mirakhorli/lqi").loop.controller
    >>> controller.operating_point.tolist(), controller.R.tolist()
    ([12.0, 12.0], [3.0, 3.0])
    """

    bumpless = True
    model: TankNetwork
    # [1/cm^2], then [1/(cm s)^2]: two units in one field, so that the description names them,
    # whatever the units of a rig
    Q: np.ndarray = leaf(
        "-",
        "weight of each level, over its unit squared, then of each integral, over that times s^2",
        low=0.0,
        shape=("tank + output",),
    )
    R: np.ndarray = leaf("1/V^2", "weight of each input", **POSITIVE, shape="pump")
    operating_point: np.ndarray = leaf(
        "cm", "setpoint at which the model is linearised", **POSITIVE, shape="output"
    )
    inflow: np.ndarray | None = _inflow()
    anti_windup: str = static(
        "-",
        "what the integrals do while a pump is at a limit",
        choices=("directional", "frozen"),
        default="directional",
    )

    @pointwise
    def prepare(self, r: tuple, dr: tuple, ddr: tuple) -> Any:
        return steady_along(self.model, r, self.inflow)

    def init(self, x0: tuple, u0: tuple) -> Any:
        zero = (0.0,) * len(self.model.outputs)
        return zero, zero  # integrals z [cm s], errors of this sample [cm]

    def _rest(self):
        """Levels (n,) and inputs (m,) of the steady state of the operating point."""
        if self.inflow is None:
            speeds, inputs = steady_flows(self.model, self.operating_point)
            return speeds * speeds / (2.0 * self.model.gravity), inputs
        point = tuple(jnp.asarray(self.operating_point)[:, None])
        return tuple(jnp.stack(v)[:, 0] for v in steady_along(self.model, point, self.inflow))

    def gain(self) -> jax.Array:
        """Return [K, Ki] (pumps, tanks + outputs) [V/cm], [V/(cm s)]."""
        levels, inputs = self._rest()
        A, B, C = linearise(self.model, levels, inputs, self.inflow)
        n, p = A.shape[0], C.shape[0]
        A = jnp.block([[A, jnp.zeros((n, p))], [C, jnp.zeros((p, p))]])
        B = jnp.concatenate([B, jnp.zeros((p, B.shape[1]))])
        return lqr(A, B, jnp.diag(jnp.asarray(self.Q)), jnp.diag(jnp.asarray(self.R)))

    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence, Any]:
        z, _ = state
        h0, u0 = _steady(self, tick.plan, estimate.d)
        error = tuple(estimate.x[i] - r for i, r in zip(self.model.outputs, tick.r))
        return feedback(self.gain(), (*estimate.x, *z), (*h0, *(0.0 for _ in z)), u0), (z, error)

    def track(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        z, error = state
        gain = self.gain()[:, -len(z) :]
        push = [-sum(k * e for k, e in zip(row, error)) for row in gain]  # of the commands [V/s]
        outward = [(c - a) * v > 0.0 for c, a, v in zip(command, applied, push)]
        limited = sum(jnp.where(out, 1.0, 0.0) for out in outward) > 0.0
        rates: Any = (0.0,) * len(z)
        if self.anti_windup == "directional":
            within = [jnp.where(out, 0.0, -v) for out, v in zip(outward, push)]
            rates = solve(gain, jnp.stack(within))
        moved = (jnp.where(limited, rate, e) for rate, e in zip(rates, error))
        return tuple(i + tick.dt * rate for i, rate in zip(z, moved)), error

    def transfer(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        z, error = state
        short = jnp.stack([v - u for u, v in zip(applied, command)])  # of Ki z
        move = solve(self.gain()[:, -len(z) :], short)
        return tuple(i + move[j] for j, i in enumerate(z)), error

    def check(self, reference: Signal) -> None:
        check_free_outlets(self.model)

    def check_pumps(self, actuator: Actuator) -> None:
        if self.model.plain:  # whose inputs act alike at any operating point
            return
        u = np.asarray(self._rest()[1], dtype=float)
        low, high = np.asarray(actuator.low, dtype=float), np.asarray(actuator.high, dtype=float)
        near = 1e-6 * np.where(np.isfinite(high - low), high - low, 1.0)
        if bad := np.flatnonzero(~((u >= low - near) & (u <= high + near))).tolist():
            units, j = self.model.units, bad[0]
            unit = input_unit(self.model, j, units[1])
            raise InputError(
                f"controller.operating_point = {np.asarray(self.operating_point).tolist()}"
                f" {units[0]}: is at rest with {label_of(self.model, 'pump', j)} at"
                f" {u[j]:.4g} {unit}, outside its limits: there is no gain to design: state the"
                " steady inflow of the tanks (controller.inflow) or another operating_point"
            )

"""Nonlinear model predictive control of any plant: real-time iteration in the time loop."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from jaxtank.analysis.active_set import SPAN, solve_soft
from jaxtank.analysis.condensing import condensed, slopes_along
from jaxtank.analysis.elimination import times, weighted_squares
from jaxtank.controllers.base import Controller
from jaxtank.core.checks import check_order
from jaxtank.core.clock import INTEGRATORS, Clock
from jaxtank.core.errors import InputError
from jaxtank.core.numerics import clip, portion
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import POSITIVE, component, leaf, static
from jaxtank.instruments.base import Actuator, Sensor
from jaxtank.instruments.sensors import check_unfiltered
from jaxtank.plants.base import Plant
from jaxtank.plants.runge_kutta import predicted
from jaxtank.signals.base import Signal
from jaxtank.xla.barrier import materialised


class Course(NamedTuple):
    """State of the controller: the plan from which the next sample starts."""

    knots: Any  # (moves m,) inputs at the knots, one knot after the other [V]
    applied: Any  # (m,) the last input within the limits of the pumps [V]
    slack: Any  # how far the plan passes a limit of a level [cm]


MOST_FOLLOWED = 100.0  # largest change of an output by that of a limited level that is priced [-]
PRICED = 10.0  # least penalty, in multiples of what the errors gain by a level beyond its limit [-]


def _exact(least, S, Y, weight, e):
    """Penalties (n,) above rough bounds of the multipliers; S, Y: slopes of levels and outputs."""
    sizes = jnp.maximum(jnp.abs(S).max(axis=(0, 2)), 1e-9)
    follow = clip(jnp.abs(Y).max() / sizes, 1.0, MOST_FOLLOWED)  # of outputs, per level
    gained = 2.0 * jnp.sum(weight * jnp.abs(e)) * follow
    return jax.lax.stop_gradient(jnp.maximum(least, PRICED * gained))


@component
class NMPC(Controller):
    """Nonlinear model predictive control by real-time iteration (Diehl, Bock, Schloeder 2005).

        min  sum_j w_j |y(t + j T) - r(t + j T)|_q^2 + sum_j |u_j - u_(j-1)|_(r_w)^2
             + penalty sum_i s_i,
        low <= u <= high,  |u'| <= rate,  h_i <= limit_i + s_i,  s_i >= 0

    over N samples of T = horizon/N, with w_j = 1 and `terminal` for the last. Levels are predicted
    by `integrator` on the model from the estimated levels, with the disturbances d that the
    observer estimates, so that a constant one leaves no offset. In each sample of the clock the
    plan of the last one is moved on by dt, the model is linearised along it, and the quadratic
    programme for its change is solved, `iterations` times. Plans are straight lines between `moves`
    knots, near to each other at first. The penalty, if smaller, is raised to PRICED times what the
    errors of the last plan gain by a level beyond its limit, estimated by the largest slopes: so
    slack s is above 0 where no input keeps a limit (measure `limit_slack`), and not where an input
    that keeps it has large errors.

    Setpoints are known for the next `preview` seconds, and then held. Without preview they are
    expected to keep their present rate for `rate_time`.

    Examples
    --------
    A tank at rest is held there by the inflow that leaves it:

    >>> from jaxtank.plants import network
    >>> tank = network(area=10.0, drain=0.1, pump_gain=1.0, feeds=[(0, None)], rim=20.0)
    >>> controller = NMPC(model=tank, horizon=20.0, r_w=[0.01], low=[0.0], high=[30.0])
    >>> tick = Tick(t=0.0, r=(10.0,), dr=(0.0,), ddr=(0.0,), dt=1.0)
    >>> outflow = 0.1 * (2.0 * 981.0 * 10.0) ** 0.5
    >>> start = controller.init((10.0,), (outflow,))
    >>> (u,), _ = controller.step(start, tick, Estimate(x=(10.0,)))
    >>> bool(abs(float(u) - outflow) < 1e-9)
    True
    """

    limits_levels = True
    sequential = True  # each has as many iterations as its own samples need
    model: Plant
    horizon: float = leaf("s", "length of the prediction, N samples", **POSITIVE)
    r_w: np.ndarray = leaf(
        "cm^2/V^2",
        "weight of the change of each input from sample to sample",
        **POSITIVE,
        shape="pump",
    )
    q: np.ndarray = leaf(
        "-",
        "weight of the error of each output; left out: 1",
        low=0.0,
        default=lambda values: np.ones(len(values["model"].outputs)),
        shape="output",
    )
    terminal: float = leaf(
        "-", "weight of the last predicted error", low=0.0, default=lambda values: 1.0
    )
    rate_time: float = leaf(
        "s",
        "how long a setpoint is expected to keep its rate without preview; left out: horizon/4",
        low=0.0,
        default=lambda values: 0.25 * values["horizon"],
    )
    limit: np.ndarray = leaf(
        "cm",
        "largest level of each tank; left out: its rim",
        infinite=True,
        default=lambda values: values["model"].rim,
        shape="tank",
    )
    penalty: float = leaf(
        "cm", "cost of a level above its limit", **POSITIVE, default=lambda values: 1e3
    )
    low: np.ndarray = leaf("V", "lower limit of each input", shape="pump")
    high: np.ndarray = leaf("V", "upper limit of each input", shape="pump")
    rate: np.ndarray | None = leaf(
        "V/s",
        "largest change of each input per second; left out: any",
        **POSITIVE,
        like="low",
        default=None,
        shape="pump",
    )
    N: int = static("-", "number of predicted samples", low=1, high=200, default=20)
    moves: int = static("-", "number of knots of a plan, at most N", low=1, high=50, default=8)
    iterations: int = static("-", "quadratic programmes a sample", low=1, high=3, default=1)
    preview: float = static(
        "s", "time for which setpoints are known ahead", low=0.0, high=1e5, default=0.0
    )
    integrator: str = static("-", "of the prediction", choices=INTEGRATORS, default="rk4")

    @property
    def period(self) -> Any:
        """Length T of a predicted sample [s]."""
        return self.horizon / self.N

    @property
    def places(self) -> np.ndarray:
        """Knots (moves,) in T from now: T apart at first, the last at the start of the last T."""
        k = np.arange(self.moves)
        return np.maximum(k, (self.N - 1) * (k / max(1, self.moves - 1)) ** 2)

    def blend(self, at: Any) -> jax.Array:
        """Return rows (places m, moves m): inputs at places `at`, in T from now, by a plan."""
        knots: Any = self.places
        at, m = jnp.asarray(at)[:, None], self.model.pumps
        past = portion(at, knots[:-1], knots[1:]) / np.diff(knots)  # 0 before a knot, 1 after
        first, last = jnp.ones_like(at), jnp.zeros_like(at)
        share = jnp.concatenate([first, past], axis=1) - jnp.concatenate([past, last], axis=1)
        return (share[:, None, :, None] * jnp.eye(m)[:, None]).reshape(-1, self.moves * m)

    def announced(self, clock: Clock, r: tuple) -> Any:
        if not self.preview:
            return ()
        ahead = np.arange(max(1, round(self.preview / clock.dt)) + 1)
        which = np.minimum(np.arange(clock.samples)[:, None] + ahead, clock.samples - 1)
        return tuple(jnp.asarray(v)[which] for v in r)

    def setpoints(self, tick: Tick) -> jax.Array:
        """Return setpoints (N, outputs) at the ends of the predicted samples [cm]."""
        ahead = self.period * np.arange(1.0, self.N + 1.0)
        if not self.preview:
            lasting = jnp.minimum(ahead, self.rate_time)
            return jnp.stack([r + dr * lasting for r, dr in zip(tick.r, tick.dr)], axis=1)
        last = tick.own[0].shape[0] - 1
        at = jnp.minimum(ahead / tick.dt, last)
        k = jnp.minimum(jnp.floor(at).astype(int), last - 1)
        return jnp.stack([v[k] + (at - k) * (v[k + 1] - v[k]) for v in tick.own], axis=1)

    def init(self, x0: tuple, u0: tuple) -> Any:
        u = jnp.stack([jnp.asarray(v) for v in u0])
        return Course(jnp.tile(u, self.moves), u, 0.0 * u[0])

    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence, Any]:
        later = self.places + tick.dt / self.period
        plan, r = state._replace(knots=times(self.blend(later), state.knots)), self.setpoints(tick)
        for _ in range(self.iterations):
            plan = self._improved(plan, tick, estimate, r)
        # Exactly within the limits: pumps with the same limits then change nothing, and derivatives
        # do not depend on rounding.
        first = [clip(plan.knots[j], self.low[j], self.high[j]) for j in range(self.model.pumps)]
        return materialised(tuple(first)), plan

    def _improved(self, plan, tick, estimate, r):
        """The plan after one quadratic programme for setpoints r (N, outputs)."""
        N, m, basis = self.N, self.model.pumps, self.blend(np.arange(self.N))
        inputs = times(basis, plan.knots)
        # an input below 0 by rounding would take an empty tank below its bottom
        within = clip(inputs.reshape(N, m), self.low, self.high)
        x, S = self._predict(tick, estimate, within, basis.reshape(N, m, -1))
        outputs = lambda v: jnp.stack([v[:, i] for i in self.model.outputs], axis=1)
        weight = jnp.ones(N).at[N - 1].set(self.terminal)[:, None] * self.q
        Y, e = outputs(S).reshape(-1, basis.shape[1]), (outputs(x) - r).reshape(-1)
        moves = jnp.concatenate([basis[:m], basis[m:] - basis[:-m]])
        du = jnp.concatenate([inputs[:m] - plan.applied, inputs[m:] - inputs[:-m]])
        effort = jnp.tile(jnp.asarray(self.r_w), N)
        H = weighted_squares(moves, effort) + weighted_squares(Y, weight.reshape(-1))
        f = times(Y.T, weight.reshape(-1) * e) + times(moves.T, effort * du)
        rows, low, high = self._input_rows(plan, tick.dt)
        limit = jnp.asarray(self.limit)
        finite = lambda v: jnp.where(jnp.isfinite(v), jnp.abs(v), 0.0)
        size_of = jax.lax.stop_gradient(jnp.maximum(jnp.abs(x).max(), finite(limit).max()))
        room = jnp.minimum(limit - x, SPAN * size_of)
        data = 2.0 * H, 2.0 * f, rows, low, high, S, room
        penalty = Partial(_exact, self.penalty, S, Y, weight.reshape(-1), e)
        change, slack = solve_soft(*data, penalty, SPAN * size_of)
        return plan._replace(knots=plan.knots + change, slack=jnp.max(slack))

    def _predict(self, tick, estimate, inputs, basis):
        """Levels (N, n) at the ends of the samples for inputs (N, m), and their derivatives (N, n,
        K m) by the knots; basis (N, m, K m): of the inputs.
        """
        model, d = self.model, estimate.d
        n = model.tanks

        def onward(x, u):
            levels = tuple(x[i] for i in range(n))
            known = model, self.integrator, tick.t, levels, tuple(u), d, self.period
            return jnp.stack(list(predicted(*known)))

        x = jnp.stack(list(estimate.x))
        last, starts = jax.lax.scan(lambda x, u: (onward(x, u), x), x, inputs)
        slopes = slopes_along(onward, starts, inputs)
        S = condensed(slopes, basis, jnp.zeros((n, basis.shape[2]), x.dtype))
        return jnp.concatenate([starts[1:], last[None]]), S

    def _input_rows(self, plan, dt):
        """(A, low, high) of low <= A change <= high: limits of the knots, and of their rates."""
        knots, size, m = plan.knots, plan.knots.size, self.model.pumps
        least, most = (jnp.tile(jnp.asarray(v), self.moves) for v in (self.low, self.high))
        A = jnp.eye(size)
        if self.rate is None:
            return A, least - knots, most - knots
        # from within the range: the limits of range and rate can then be kept together
        before = clip(plan.applied, self.low, self.high)
        steps = jnp.concatenate([knots[:m] - before, knots[m:] - knots[:-m]])
        times = jnp.concatenate([jnp.full(1, dt), np.diff(self.places) * self.period])
        reach = jnp.minimum(jnp.ravel(times[:, None] * self.rate), most - least)
        between = jnp.eye(size) - jnp.eye(size, k=-m)
        return (
            jnp.concatenate([A, between]),
            jnp.concatenate([least - knots, -reach - steps]),
            jnp.concatenate([most - knots, reach - steps]),
        )

    def track(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        return state._replace(applied=jnp.stack(list(applied)))

    @property
    def reads_ahead(self) -> bool:
        return self.preview > 0.0

    def level_limits(self) -> list[tuple[int, float, float]]:
        return [(tank, -np.inf, float(v)) for tank, v in enumerate(np.asarray(self.limit))]

    def slack(self, state: Any) -> Any:
        return state.slack

    def check_sensor(self, sensor: Sensor) -> None:
        check_unfiltered(sensor, "nmpc")

    def check_pumps(self, actuator: Actuator) -> None:
        if actuator.delay or any(actuator.delays):
            most = actuator.delay + max(actuator.delays, default=0.0)
            raise InputError(
                f"actuator.delay = {most:g} s: nmpc predicts no dead time of the pumps: set it to 0"
                " s, or choose another controller"
            )

    def check(self, reference: Signal) -> None:
        check_order("controller", self, "low", "high", self.model.units[1])
        if self.moves > self.N:
            raise InputError(
                f"controller.moves = {self.moves}: must be at most controller.N = {self.N}"
            )

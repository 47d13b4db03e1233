"""A rig as a Gymnasium environment, for reinforcement learning (pip install ".[gym]")."""

import functools

try:
    import gymnasium
except ImportError:
    raise ImportError(
        'jaxtank.interop.gymnasium needs gymnasium: pip install gymnasium, or "jaxtank[gym]"'
    ) from None
import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.core.text import count, shortened
from jaxtank.loop.closed_loop import initial, inputs
from jaxtank.loop.step import move, readings
from jaxtank.loop.validation import check
from jaxtank.safety.prediction import moved_on

PENALTY = 100.0  # weight of a rise past a rim beside a tracking error of the same size [-]


class TankEnv(gymnasium.Env):
    """An environment of Gymnasium whose episode is one run of a case without its controller."""

    # Action: (m,) inputs of the pumps, scaled to [-1, 1] over their limits. Observation: (n + 2
    # outputs,) readings, setpoints and their rates, each as a share of the highest rim (rates per
    # 100 s). Reward [-]: -mean(e^2)/R^2 - 100 sum(max(h - rim, 0)^2)/R^2, R the highest rim.
    # Truncated at the end of the clock; terminated where a level is not finite. info: {"t" [s], "x"
    # (n,) levels, "y" (n,) readings, "u" (m,) inputs at the plant, "e" (outputs,) errors, "spilled"
    # (n,) volume that has overflowed each rim [cm^3], "filtered" 0.0 or 1.0} in the rig's units.
    # Pumps (dead zone, lag, delay), plant and its faults, disturbances, rims, sensors (noise,
    # offset, ADC) and reference are the case's own: with the inputs of `jaxtank.simulate(case.loop,
    # case.clock, key=jax.random.key(seed))` (its `applied`) as actions, the episode after
    # reset(seed=seed) is that run, to rounding.

    metadata = {"render_modes": []}

    def __init__(self, case):
        self.case, self.state = case, None
        loop, self.clock = case.loop, case.clock
        check(loop, self.clock, jax.random.key(0))
        plant = loop.plant
        self.size = float(np.max(np.asarray(plant.rim)))
        self.low, self.high = (
            np.asarray(getattr(loop.actuator, n), dtype=float) for n in ("low", "high")
        )
        size = plant.tanks + 2 * len(plant.outputs)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float64)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (plant.pumps,), np.float64)

    def reset(self, *, seed=None, options=None):
        """Return (observation, info) at the beginning of an episode; without a seed its noise is
        the next of the last seed's.
        """
        super().reset(seed=seed)
        loop = self.case.loop
        number = int(self.np_random.integers(2**31)) if seed is None else seed
        self.inputs, self.state = _begin(loop, self.clock, jax.random.key(number))
        self.r, self.rate = (
            np.stack([np.asarray(v) for v in part], axis=1)
            for part in (self.inputs.r, self.inputs.dr)
        )
        self.k, self.x = 0, _array(self.state.x)
        y, self.state = _readings(loop, self.clock, self.inputs, self.state)
        self.y = _array(y)
        self.u = np.asarray(loop.actuator.initial, dtype=float)
        self.spilled, self.filtered = np.zeros(len(self.x)), 0.0
        return self._observation(), self._info()

    def step(self, action):
        """Return (observation, reward, terminated, truncated, info) a sample later."""
        if self.state is None:
            raise gymnasium.error.ResetNeeded("step: call reset first")
        loop, action = self.case.loop, np.asarray(action, dtype=float)
        if action.shape != self.low.shape or not np.all(np.isfinite(action)):
            numbers = count(self.low.size, "number")
            raise InputError(
                f"action = {shortened(action)}: must be an array of {numbers} from -1 to 1, one for"
                " each pump"
            )
        command = self.low + 0.5 * (np.clip(action, -1.0, 1.0) + 1.0) * (self.high - self.low)
        self.state, y, u, spilled, filtered = _advance(
            loop, self.clock, self.inputs, self.state, tuple(command), tuple(self.y)
        )
        self.x, self.y, self.u = map(_array, (self.state.x, y, u))
        self.spilled, self.filtered = self.spilled + _array(spilled), float(filtered)
        self.k = min(self.k + 1, self.clock.samples - 1)
        error = self._error() / self.size
        past = np.maximum(self.x - np.asarray(loop.plant.rim), 0.0) / self.size
        diverged = not np.all(np.isfinite(self.x))
        reward = -1e6 if diverged else -float(np.mean(error**2) + PENALTY * np.sum(past**2))
        return self._observation(), reward, diverged, self.k == self.clock.samples - 1, self._info()

    def _error(self):
        return self.x[list(self.case.loop.plant.outputs)] - self.r[self.k]

    def _observation(self):
        return np.concatenate([self.y, self.r[self.k], 100.0 * self.rate[self.k]]) / self.size

    def _info(self):
        return {
            "t": self.k * self.clock.dt,
            "e": self._error(),
            "filtered": self.filtered,
            **{name: getattr(self, name).copy() for name in ("x", "y", "u", "spilled")},
        }


def _array(values):
    return np.array([float(v) for v in values])


@functools.partial(jax.jit, static_argnums=1)
def _begin(loop, clock, key):
    return inputs(loop, clock, (), key), initial(loop, clock)


@functools.partial(jax.jit, static_argnums=1)
def _readings(loop, clock, samples, state):
    """((tanks,) readings of a state, the state after them); of the last sample also after it."""
    return readings(loop, state, _now(samples, state), clock)


@functools.partial(jax.jit, static_argnums=1)
def _advance(loop, clock, samples, state, command, y):
    """(state, readings, inputs at the plant, volumes that overflowed, 1.0 where the safety filter
    changed the inputs `wanted`) a sample after the readings `y`.
    """
    kind, filtered = state.x[0].dtype, 0.0
    applied = tuple(jnp.asarray(v, dtype=kind) for v in command)
    actuator, controller, rated = loop.actuator, state.controller, loop.actuator.rate is not None
    if rated:
        controller, before = controller
        actuator = actuator.reachable(before, clock.dt)
        applied = actuator.limit(applied) if loop.safety_filter is None else applied
    if loop.safety_filter is not None:
        guard, line = loop.safety_filter, None
        if guard.predicted:
            controller, line = controller
        y = tuple(jnp.asarray(v, dtype=kind) for v in y)
        applied, filtered = guard.apply(actuator, applied, None, y, clock.dt, line)
        if line is not None:
            controller = controller, moved_on(line, applied)
    state = state._replace(controller=(controller, applied) if rated else controller)
    state, u, spilled, _ = move(loop, clock, state, applied, _now(samples, state))
    y, state = _readings(loop, clock, samples, state)
    return state, y, u, spilled, filtered


def _now(samples, state):
    return jax.tree.map(lambda a: jax.lax.dynamic_index_in_dim(a, state.k, keepdims=False), samples)

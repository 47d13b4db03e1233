"""A rig as a Gymnasium environment, for those who would rather learn a controller than tune one
(pip install ".[gym]").
"""

import functools

try:
    import gymnasium
except ImportError:
    raise ImportError(
        'jaxtank.environment needs gymnasium: pip install gymnasium, or "jaxtank[gym]"'
    ) from None
import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.loop.closed_loop import initial, inputs
from jaxtank.loop.step import move
from jaxtank.loop.validation import check

PENALTY = 100.0
"""What a rim passed by one unit of length costs more than an error of as much [-]."""


class TankEnv(gymnasium.Env):
    """One episode is one run of a case, without its controller: the action is what the pumps are
    given.

    action: (pumps,) inputs scaled to [-1, 1] over the pumps' limits; observation: readings,
    setpoints and their rates, each as a share of the highest rim (rates per 100 s); reward: minus
    the mean squared error of the outputs over the rim's square, less 100 times the squared rise
    past the rims as the same share. Truncated at the end of the clock; terminated where a level is
    not finite. info: {"t" [s], "x" (tanks,), "y" (tanks,), "u" (pumps,), "e" (outputs,), "spilled"
    (tanks,) [cm^3]} in the rig's units: levels, readings, inputs at the plant, errors, and the
    volume lost over each rim so far.

    Pumps (dead zone, lag, delay), plant and its faults, disturbances, rims, sensors (noise, offset,
    ADC) and reference are the case's own: with the inputs of `jaxtank.simulate(case.loop,
    case.clock, key=jax.random.key(seed))` (its `applied`) as actions, the episode after
    reset(seed=seed) is that run, to rounding. Raises InputError for a case that cannot be run.
    """

    metadata = {"render_modes": []}

    def __init__(self, case):
        self.case = case
        loop, self.clock = case.loop, case.clock
        check(loop, self.clock, jax.random.key(0))
        plant = loop.plant
        self.size = float(np.max(np.asarray(plant.rim)))
        self.low, self.high = (
            np.asarray(getattr(loop.actuator, n), dtype=float) for n in ("low", "high")
        )
        count = plant.tanks + 2 * len(plant.outputs)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (count,), np.float64)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (plant.pumps,), np.float64)

    def reset(self, *, seed=None, options=None):
        """(observation, info) at the beginning of an episode; without a seed its noise is the next
        of the last seed's.
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
        self.spilled = np.zeros(len(self.x))
        return self._seen(), self._told()

    def step(self, action):
        """(observation, reward, terminated, truncated, info) a sample later."""
        loop = self.case.loop
        asked = self.low + 0.5 * (np.clip(np.asarray(action, dtype=float), -1.0, 1.0) + 1.0) * (
            self.high - self.low
        )
        self.state, y, u, spilled = _advance(
            loop, self.clock, self.inputs, self.state, tuple(asked)
        )
        self.x, self.y, self.u = map(_array, (self.state.x, y, u))
        self.spilled = self.spilled + _array(spilled)
        self.k = min(self.k + 1, self.clock.samples - 1)
        error = self._error() / self.size
        past = np.maximum(self.x - np.asarray(loop.plant.rim), 0.0) / self.size
        broken = not np.all(np.isfinite(self.x))
        reward = -1e6 if broken else -float(np.mean(error**2) + PENALTY * np.sum(past**2))
        return self._seen(), reward, broken, self.k == self.clock.samples - 1, self._told()

    def _error(self):
        return self.x[list(self.case.loop.plant.outputs)] - self.r[self.k]

    def _seen(self):
        return np.concatenate([self.y, self.r[self.k], 100.0 * self.rate[self.k]]) / self.size

    def _told(self):
        found = {name: getattr(self, name).copy() for name in ("x", "y", "u", "spilled")}
        return {"t": self.k * self.clock.dt, "e": self._error(), **found}


def _array(values):
    return np.array([float(v) for v in values])


@functools.partial(jax.jit, static_argnums=1)
def _begin(loop, clock, key):
    return inputs(loop, clock, (), key), initial(loop, clock)


@functools.partial(jax.jit, static_argnums=1)
def _readings(loop, clock, every, state):
    """((tanks,) readings of a state, the state after them); of the last sample also after it."""
    y, sensor = loop.sensor.step(state.sensor, state.x, _now(every, state).xi, clock.dt)
    return y, state._replace(sensor=sensor)


@functools.partial(jax.jit, static_argnums=1)
def _advance(loop, clock, every, state, asked):
    """(state, readings, inputs at the plant, volumes lost) a sample later."""
    applied = tuple(jnp.asarray(v, dtype=state.x[0].dtype) for v in asked)
    state, u, spilled, _ = move(loop, clock, state, applied, _now(every, state))
    y, state = _readings(loop, clock, every, state)
    return state, y, u, spilled


def _now(every, state):
    return jax.tree.map(lambda a: jax.lax.dynamic_index_in_dim(a, state.k, keepdims=False), every)

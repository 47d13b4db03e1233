"""A rig as a Gymnasium environment, for those who would rather learn a law than tune one (pip install ".[gym]")."""

import functools

try:
    import gymnasium
except ImportError:
    raise ImportError('jaxtank.environment needs gymnasium: pip install gymnasium, or "jaxtank[gym]"') from None
import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.plants.integration import integrate

PENALTY = 100.0
"""What a rim passed by one unit of length costs more than an error of as much [-]."""


class TankEnv(gymnasium.Env):
    """One episode is one run of a case, without its law: the action is what the pumps are given.

    action: (pumps,) inputs scaled to [-1, 1] over the pumps' limits; observation: readings, setpoints and their rates, each as a share of
    the highest rim (rates per 100 s); reward: minus the mean squared error of the outputs over the rim's square, less 100 times the squared
    rise past the rims as the same share. Truncated at the end of the clock; terminated where a level is no number. info: {"t" [s],
    "x" (tanks,), "u" (pumps,), "e" (outputs,)} in the rig's units. The plant, pumps (dead zone, lag), sensor noise and reference are the
    case's own; reset(seed) decides the noise.
    """

    metadata = {"render_modes": []}

    def __init__(self, case):
        self.case = case
        loop, self.clock = case.loop, case.clock
        plant = loop.plant
        self.size = float(np.max(np.asarray(plant.rim)))
        self.low, self.high = (np.asarray(getattr(loop.actuator, n), dtype=float) for n in ("low", "high"))
        self.reference = [np.stack([np.asarray(v) for v in part], axis=1) for part in loop.reference.sample(self.clock)][:2]
        self.inflow = None
        if loop.disturbance is not None:
            self.inflow = np.stack([np.asarray(v) for v in loop.disturbance.sample(self.clock)[0]], axis=1)
        count = plant.tanks + 2 * len(plant.outputs)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (count,), np.float64)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (plant.pumps,), np.float64)

    def reset(self, *, seed=None, options=None):
        """(observation, info) at the beginning of an episode."""
        super().reset(seed=seed)
        self.k, self.x = 0, np.asarray(self.case.loop.x0, dtype=float)
        self.state = self.case.loop.actuator.init(self.clock)
        self.u = np.asarray(self.case.loop.actuator.initial, dtype=float)
        return self._seen(), self._told()

    def step(self, action):
        """(observation, reward, terminated, truncated, info) a sample later."""
        loop = self.case.loop
        asked = self.low + 0.5 * (np.clip(np.asarray(action, dtype=float), -1.0, 1.0) + 1.0) * (self.high - self.low)
        d = None if self.inflow is None else tuple(self.inflow[self.k])
        x, u, self.state = _advance(loop, self.clock, tuple(self.x), tuple(asked), d, self.state)
        self.x, self.u = np.array([float(v) for v in x]), np.array([float(v) for v in u])
        self.k = min(self.k + 1, self.clock.samples - 1)
        error = self._error() / self.size
        past = np.maximum(self.x - np.asarray(loop.plant.rim), 0.0) / self.size
        broken = not np.all(np.isfinite(self.x))
        reward = -1e6 if broken else -float(np.mean(error**2) + PENALTY * np.sum(past**2))
        return self._seen(), reward, broken, self.k == self.clock.samples - 1, self._told()

    def _error(self):
        return self.x[list(self.case.loop.plant.outputs)] - self.reference[0][self.k]

    def _seen(self):
        noise = np.asarray(self.case.loop.sensor.noise) * self.np_random.standard_normal(len(self.x))
        r, rate = self.reference[0][self.k], self.reference[1][self.k]
        return np.concatenate([self.x + noise, r, 100.0 * rate]) / self.size

    def _told(self):
        return {"t": self.k * self.clock.dt, "x": self.x.copy(), "u": self.u.copy(), "e": self._error()}


@functools.partial(jax.jit, static_argnums=1)
def _advance(loop, clock, x, asked, d, state):
    x = tuple(jnp.asarray(v, dtype=float) for v in x)
    u, state = loop.actuator.deliver(state, tuple(jnp.asarray(v, dtype=float) for v in asked), clock.dt)
    driven, h = loop.actuator.driving(u), clock.dt / clock.substeps
    for _ in range(clock.substeps):
        x, _ = loop.plant.spill(integrate(loop.plant, clock.integrator, 0.0, x, driven, d, h))
    return x, u, state

"""The roles Sensor and Actuator: the interface of the instruments to the closed loop.

Holds abstract classes only; imports core, and may be imported by every folder above.
"""

import abc
import dataclasses
from collections.abc import Sequence
from typing import Any, Self, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxtank.core.clock import CHUNK, Clock
from jaxtank.core.numerics import clip
from jaxtank.core.tree import Role
from jaxtank.core.vectors import each
from jaxtank.xla.barrier import materialised
from jaxtank.xla.normal import is_fast, normal, normal_at


class Sensor(Role):
    """The level sensors of a rig, one per tank: readings of levels.

    A custom sensor is a `component` with its own `step`. A sensor with noise has a leaf
    `noise` (n,) and is given standard normal deviates, which are drawn before the time loop
    (`draw`); a sensor with memory, such as a lag, also has its own `init`.

    Examples
    --------
    >>> from jaxtank import component, leaf
    >>> @component
    ... class Quantised(Sensor):
    ...     resolution: float = leaf("cm", "least difference of two readings", low=0.0, strict=True)
    ...
    ...     def step(self, state, x, xi, dt):
    ...         return tuple(jnp.round(h / self.resolution) * self.resolution for h in x), state
    >>> [float(y) for y in Quantised(resolution=0.5).step((), (1.2, 3.3), None, 1.0)[0]]
    [1.0, 3.5]
    """

    noise: Any = 0.0
    """(n,) standard deviation of the noise on each level [cm]; a run with noise needs a key."""

    def init(self, x0: Sequence[Any]) -> Any:
        """Return the state before the first sample.

        Parameters
        ----------
        x0 : (n,) levels at t = 0 [cm]

        Returns
        -------
        A pytree of arrays; () for a sensor without memory.
        """
        return ()

    @abc.abstractmethod
    def step(
        self, state: Any, x: Sequence[Any], xi: Sequence[Any] | None, dt: Any
    ) -> tuple[Sequence[Any], Any]:
        """Return the readings of a sample and the state after it.

        Parameters
        ----------
        state : as `init` returns it
        x : (n,) levels at the time of the sample [cm]
        xi : (n,) standard normal deviates of the sample [-]; None for a run without a key
        dt : sampling period [s]

        Returns
        -------
        (n,) readings [cm], and the new state
        """

    def draw(
        self, key: jax.Array | None, samples: int, piece: ArrayLike | None = None
    ) -> tuple[Any, ...] | None:
        """Return standard normal deviates of a run, drawn before the time loop.

        Parameters
        ----------
        key : random key of jax, or None; or (n, samples) deviates that were drawn before
        samples : number of samples [-]
        piece : number of the chunk of a long run to which the samples belong. Each chunk has a
            different key, and the deviates of a run are its chunks in sequence.

        Returns
        -------
        (n,) arrays (samples,); None without a key, and for a sensor without noise
        """
        deviates = self.deviates(key, samples, piece)
        return (
            None
            if deviates is None
            else tuple(deviates[i] for i in range(np.shape(self.noise)[-1]))
        )

    def deviates(
        self, key: jax.Array | None, samples: int, piece: ArrayLike | None = None
    ) -> jax.Array | None:
        """Return the result of `draw` as one array (n, samples)."""
        if key is None or np.ndim(self.noise) == 0:
            return None
        tanks = np.shape(self.noise)[-1]
        if jnp.issubdtype(key.dtype, jnp.floating):
            return key
        normals = lambda key, count: normal(key, (tanks, count))
        if piece is not None:
            return normals(jax.random.fold_in(key, piece), samples)
        if samples <= CHUNK:
            return normals(key, samples)
        whole, last = divmod(samples, CHUNK)
        chunks = jax.vmap(lambda b: normals(jax.random.fold_in(key, b), CHUNK))(jnp.arange(whole))
        remainder = normals(jax.random.fold_in(key, whole), last)
        return jnp.concatenate([jnp.moveaxis(chunks, 1, 0).reshape(tanks, -1), remainder], axis=1)

    def draws_in_loop(self, key: Any) -> bool:
        """Return whether `draw_sample` gives the deviates of `draw`, for a key of a run."""
        custom = type(self).draw is not Sensor.draw
        return key is not None and np.ndim(self.noise) > 0 and not custom and is_fast(key)

    def draw_sample(self, key: Any, samples: int, k: Any, arrays: bool = False) -> Any:
        """Return the (n,) deviates that `draw` gives sample k of `samples`, and those alone, as a
        tuple or as an array.

        A batch of long runs then holds no noise in memory, which costs more time than to draw it.
        """
        tanks = np.shape(self.noise)[-1]
        if arrays:
            first = jnp.asarray(np.arange(tanks, dtype=np.uint64) * np.uint64(samples))
            return materialised(normal_at(key, jnp.asarray(k, jnp.uint64) + first))
        places = [jnp.asarray(k, jnp.uint64) + np.uint64(i * samples) for i in range(tanks)]
        return materialised(tuple(normal_at(key, place) for place in places))

    def without_noise(self) -> Self:
        """Return the same sensor with all `noise` 0."""
        if np.ndim(self.noise) == 0:
            return self
        return dataclasses.replace(cast(Any, self), noise=np.zeros(np.shape(self.noise)))


class Actuator(Role):
    """The pumps of a rig: from the commands of a controller to the inputs of the plant.

    In one sample `limit` first holds the command within the limits, which needs no memory:
    controller and observer are given its result. `step` then says what reaches the plant, and
    `driving` which part of that moves liquid.

    A custom actuator is a `component` with leaves `low`, `high` and `initial`, (m,) each,
    and its own `init` and `step`.

    Examples
    --------
    >>> import numpy as np
    >>> from jaxtank import component, leaf
    >>> @component
    ... class RateLimited(Actuator):
    ...     low: np.ndarray = leaf("V", "lower limit of each pump", shape="pump")
    ...     high: np.ndarray = leaf("V", "upper limit of each pump", shape="pump")
    ...     initial: np.ndarray = leaf("V", "input before t = 0", shape="pump")
    ...     rate: float = leaf("V/s", "largest rate of change", low=0.0, strict=True)
    ...
    ...     def init(self, clock):
    ...         return tuple(self.initial)
    ...
    ...     def step(self, state, applied, dt):
    ...         most = self.rate * dt
    ...         u = tuple(v + clip(a - v, -most, most) for v, a in zip(state, applied))
    ...         return u, u
    >>> pumps = RateLimited(low=[0.0], high=[12.0], initial=[1.0], rate=2.0)
    >>> u, state = pumps.step(pumps.init(None), pumps.limit((20.0,)), dt=0.5)
    >>> float(u[0])
    2.0
    """

    low: Any
    """(m,) lower limit of each pump [V]."""

    high: Any
    """(m,) upper limit of each pump [V]."""

    initial: Any
    """(m,) input at which the pumps ran before t = 0 [V]."""

    delay: float = 0.0
    """Transport delay [s], a whole number of samples."""

    delays: tuple[float, ...] = ()
    """(m,) transport delay of each pump beyond `delay` [s], whole samples; () for none."""

    rate: Any = None
    """(m,) largest change of each input per second [V/s], kept by `reachable`; None for none."""

    allocates: bool = False
    """Whether `limit` needs the controller's `input_metric`."""

    offset: Any = 0.0
    """(m,) part of the inputs that moves no liquid (see `driving`) [V]."""

    @property
    def pumps(self) -> int:
        """Number of pumps m [-]."""
        low: Any = self.low  # scalars in the loop, where `reachable` has narrowed them
        return len(low) if isinstance(low, tuple) else np.shape(low)[-1]

    def orders(self) -> Sequence[tuple[str, str, bool]]:
        """Return (leaf, leaf that must be above it, whether both may be equal) of inputs."""
        return ()

    def check(self) -> None:
        """Raise InputError for values that contradict each other."""

    @abc.abstractmethod
    def init(self, clock: Clock) -> Any:
        """Return the state before the first sample: a pytree of arrays; () without memory."""

    def limit(
        self, command: Sequence[Any], metric: tuple[Any, ...] | None = None
    ) -> tuple[Any, ...]:
        """Return the command held within the limits.

        Parameters
        ----------
        command : (m,) inputs that the controller commands [V]
        metric : (g11, g12, g22) of the controller's cost, where `allocates`; else None

        Returns
        -------
        (m,) inputs within [low, high] [V]
        """
        return each(clip, command, self.low, self.high)

    def reachable(self, before: Any, dt: Any) -> "Actuator":
        """Return the pumps within what their `rate` lets them reach a sample after `before`."""
        return self

    @abc.abstractmethod
    def step(self, state: Any, applied: tuple[Any, ...], dt: Any) -> tuple[tuple[Any, ...], Any]:
        """Return the input of the plant over a sample, and the state after it.

        Parameters
        ----------
        state : as `init` returns it
        applied : (m,) inputs within the limits [V]
        dt : sampling period [s]

        Returns
        -------
        (m,) inputs at the plant, held over the sample [V], and the new state
        """

    def driving(self, u: tuple[Any, ...]) -> tuple[Any, ...]:
        """Return the part of the inputs `u` (m,) [V] at the plant that moves liquid: all of it."""
        return u

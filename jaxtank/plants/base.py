"""The role Plant: what a closed loop, observers and model-based controllers ask of a plant."""

import abc
from collections.abc import Callable, Sequence
from typing import Any, Self

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from jaxtank.core.tree import Role
from jaxtank.core.units import DEFAULT
from jaxtank.core.vectors import take, zeros


class Plant(Role):
    """A vector field over levels, held inputs and disturbing inflows. Vectors are tuples of
    scalars; where a class says `arrays = True`, those of many tanks are arrays.

    A plant has `outputs` and `rim` as fields. `TankNetwork` is one; a plant of another kind needs
    no more than its vector field (notebook 08).

    Examples
    --------
    >>> from jaxtank import component, leaf
    >>> @component
    ... class Integrator(Plant):
    ...     outputs = (0,)
    ...     tanks = pumps = 1
    ...     rim: float = leaf("cm", "height", shape="tank")
    ...
    ...     def derivative(self, t, x, u, d):
    ...         return (0.1 * u[0],)
    >>> Integrator(rim=[10.0]).derivative(0.0, (1.0,), (2.0,), None)
    (0.2,)
    """

    outputs: tuple[int, ...]
    """Tanks, counted from 0, whose levels are controlled."""

    rim: Any
    """(n,) height of each tank [cm]."""

    units: tuple[str, str] = DEFAULT
    """(length, pump input): the units that this plant counts in."""

    names: tuple[tuple[str, tuple[str, ...]], ...] = ()
    """(("tank", names), ("pump", names), ("valve", names)), "" for none: see `core.labels`."""

    overflow: bool = False
    """True where a level stops at its rim and the rest overflows."""

    overflow_within: bool = False
    """True where overflow leaves within a step, not at its end: `spill` has a second argument."""

    bottom: bool = False
    """True where a level stops at zero whatever is drawn from it."""

    plain: bool = False
    """True of a `TankNetwork` without valves, transfer pumps, curves, ports and shaped tanks."""

    by_volume: bool = False
    """True where the cross-section of a tank changes with its level: the volumes are integrated, by
    the methods `stored`, `levels` and `net_flows` of the class."""

    @property
    @abc.abstractmethod
    def tanks(self) -> int:
        """Number of levels n [-]."""

    @property
    @abc.abstractmethod
    def pumps(self) -> int:
        """Number of inputs m [-]."""

    @abc.abstractmethod
    def derivative(self, t: ArrayLike, x: Sequence, u: Sequence, d: Sequence | None) -> tuple:
        """Return the rates of the levels.

        Parameters
        ----------
        t : time [s]
        x : (n,) levels [cm]
        u : (m,) inputs [V]
        d : (n,) disturbing inflows [cm^3/s], or None

        Returns
        -------
        (n,) x' [cm/s]
        """

    @property
    def depends_on_time(self) -> bool:
        """Whether the rates depend on the time itself: such a plant has no steady state."""
        rates = lambda t, x, u: self.derivative(t, tuple(x), tuple(u), None)
        jaxpr = jax.make_jaxpr(rates)(0.0, jnp.zeros(self.tanks), jnp.zeros(self.pumps)).jaxpr
        used = [*jaxpr.outvars, *(v for eqn in jaxpr.eqns for v in eqn.invars)]
        return any(v is jaxpr.invars[0] for v in used)

    def limited(self, step: ArrayLike) -> Callable:
        """Return the vector field of one integration step of `step` [s]: `derivative`, unless a
        plant limits what may leave a tank in that time.
        """
        return self.derivative

    def with_bottom(self) -> Self:
        """Return the plant with `bottom`; a plant that has none is returned as it is."""
        return self

    def shortfall(self, x: Sequence) -> tuple:
        """Return (n) volumes [cm^3] by which levels `x` (n) [cm] after a step are below an empty
        tank: what a negative inflow could not take. Zeros where a level has no lower clip."""
        return zeros(x)

    def rates(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """Return `derivative` of arrays x (n,) and u (m,), without time and inflows, as an array
        (n,); a plant of many tanks may have one that is compiled in less time.
        """
        return jnp.stack(self.derivative(0.0, tuple(x), tuple(u), None))

    def spill(self, x: Sequence) -> tuple[Sequence, Sequence]:
        """Return (levels held at their rims, overflow of each tank [cm^3]); unchanged and zeros
        where rims are not physics.
        """
        return x, zeros(x)

    def output(self, x: Sequence[Any]) -> Sequence[Any]:
        """Return the levels that are controlled: those of the tanks in `outputs`, in that order."""
        return take(x, self.outputs)

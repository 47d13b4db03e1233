"""Interface between a controller and the loop."""

import abc
from collections.abc import Sequence
from typing import Any

from jaxtank.core.clock import Clock, pointwise
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import Role
from jaxtank.instruments.base import Actuator, Sensor
from jaxtank.signals.base import Signal


class Controller(Role):
    """A sampled controller. Its model of the plant and the plant itself are different leaves.

    Examples
    --------
    A custom controller needs a `step` alone:

    >>> from jaxtank.core.tree import component, leaf
    >>> @component
    ... class Proportional(Controller):
    ...     gain: float = leaf("V/cm", "gain")
    ...
    ...     def step(self, state, tick, estimate):
    ...         return tuple(self.gain * (r - h) for r, h in zip(tick.r, estimate.x)), state
    >>> tick = Tick(t=0.0, r=(12.0,), dr=(0.0,), ddr=(0.0,))
    >>> (u,), _ = Proportional(gain=2.0).step((), tick, Estimate(x=(11.0,)))
    >>> float(u)
    2.0
    """

    bumpless = False  # the inputs go on from manual ones without a bump, by `transfer` or `track`
    reads_model = True  # the inputs depend on the coefficients of the controller's model
    reads_inflow = False  # inflows are measured for the controller (`tick.inflow`)
    reads_flow = False  # flows of the inputs are measured for the controller (`tick.flow`)
    reads_ahead = False  # later setpoints are known to the controller (`announced`)
    sequential = False  # many runs take less time in sequence than as one vectorised batch
    limits_levels = False  # levels have limits in the controller's own programme (`slack`)
    ignores_disturbance = False  # a setting states that `estimate.d` is not used: no note of it

    @pointwise
    def prepare(self, r: tuple[Any, ...], dr: tuple[Any, ...], ddr: tuple[Any, ...]) -> Any:
        """Return the part that depends on the reference alone, computed before the time loop.

        Parameters
        ----------
        r, dr, ddr : tuples of arrays (samples,), one per output [cm, cm/s, cm/s^2]

        Returns
        -------
        Any tree of arrays (samples,); its row of each sample is `tick.plan`
        """
        return ()

    @pointwise
    def inputs(self, clock: Clock) -> Any:
        """Return signals of the controller itself, sampled on `clock` before the loop starts.

        For a controller that replays a signal (`OpenLoop`).

        Parameters
        ----------
        clock : sampling instants

        Returns
        -------
        Any tree of arrays (samples,); its row of each sample is `tick.own`
        """
        return ()

    @pointwise
    def announced(self, clock: Clock, r: tuple[Any, ...]) -> Any:
        """Return `inputs`, or what each sample knows of later setpoints r (`NMPC`).

        Parameters
        ----------
        clock : sampling instants
        r : tuple of arrays (samples,), one per output [cm]
        """
        return self.inputs(clock)

    def shares(self, x: tuple[Any, ...], r: tuple[Any, ...]) -> tuple[Any, ...] | None:
        """Return the share of the first of two blended controllers in each input [-].

        For a picture of who is at work; None for a controller that is none of several.

        Parameters
        ----------
        x : estimated levels, arrays of one shape [cm]
        r : setpoints [cm]
        """
        return None

    def init(self, x0: tuple[Any, ...], u0: tuple[Any, ...]) -> Any:
        """Return the state before the first sample.

        Parameters
        ----------
        x0 : (n) levels at t = 0 [cm]
        u0 : (m) inputs until t = 0 [V]
        """
        return ()

    @abc.abstractmethod
    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence[Any], Any]:
        """Return the commanded voltages and the new state; the pumps' limits are applied later.

        Coefficients and gains may be computed here from leaves: what does not depend on state or
        estimate is moved in front of the loop. Do not use `jnp.linalg`: in jaxlib 0.10, a program
        with two calls of it on a large batch can deadlock. `jaxtank.analysis.elimination` has
        `solve_all` and `inverse`.

        Parameters
        ----------
        state : from `init`, or from `track` of the sample before
        tick : time, setpoint and what was prepared for this sample
        estimate : levels x [cm] and disturbances d of the level rates [cm/s] from the observer; d
            is () where it estimates none

        Returns
        -------
        ((m) commanded voltages [V], new state)
        """

    def in_force(self) -> dict[str, Any]:
        """Return {leaf: the value that acts} of the leaves that the controller clips itself."""
        return {}

    def track(self, state: Any, tick: Tick, command: Sequence[Any], applied: Sequence[Any]) -> Any:
        """Return the state after the pumps' limits: anti-windup of controllers with memory.

        Parameters
        ----------
        state : from `step`
        tick : of this sample
        command : (m) voltages from `step` [V]
        applied : (m) the command within the pumps' limits [V]
        """
        return state

    def transfer(
        self, state: Any, tick: Tick, command: Sequence[Any], applied: Sequence[Any]
    ) -> Any:
        """Return the state after a sample in manual operation, in exported code: with integral
        action, that from which the same sample gives `applied`. Arguments as of `track`.
        """
        return self.track(state, tick, command, applied)

    def input_metric(self, estimate: Estimate) -> tuple[Any, ...] | None:
        """Return the weights (g11, g12, g22) of a change of the two inputs in the controller's
        cost, for allocation by box QP; None if it has none.
        """
        return None

    @property
    def allocates(self) -> bool:
        """True if there is an `input_metric`, so that the inputs can be allocated by box QP."""
        return type(self).input_metric is not Controller.input_metric

    def joint_inputs(self) -> list[tuple[int, ...]]:
        """Return the inputs that one loop moves together, for each loop with several."""
        return []

    keeps_limits: bool = False
    """Whether its `level_limits` are limits of a case too: they count in searches and verdicts."""

    def level_limits(self) -> list[tuple[int, float, float]]:
        """Return [(tank, least, largest level [cm])] that the controller holds levels within,
        whatever the setpoint.
        """
        return []

    def slack(self, state: Any) -> Any:
        """Return how far a limit of a level is given up in the plan of `state` [cm]."""
        return 0.0

    def check_pumps(self, actuator: Actuator) -> None:
        """Raise InputError for pumps whose limits, or first inputs, do not suit the controller."""

    def check_sensor(self, sensor: Sensor) -> None:
        """Raise InputError for readings that do not suit the controller."""

    def check(self, reference: Signal) -> None:
        """Raise InputError if the reference or the model does not suit the controller."""

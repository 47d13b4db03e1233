"""The closed loop: its components, its state, and what is known of each sample beforehand."""
# pyright: reportUnknownMemberType=false, reportUnknownLambdaType=false
# pyright: reportUnknownArgumentType=false

import dataclasses
import functools
import warnings
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank import measures as ms
from jaxtank.analysis.steady_state import steady_along
from jaxtank.core import vectors
from jaxtank.core.clock import CHUNK, Chunk, Clock
from jaxtank.core.errors import InputError
from jaxtank.core.tree import component, leaf
from jaxtank.core.vectors import columns, form_for, is_array, scalars, serves_arrays, total
from jaxtank.instruments.base import Sensor
from jaxtank.loop.change_windows import jumps, windows
from jaxtank.loop.steady import steady_inflow
from jaxtank.plants.elements import input_flows
from jaxtank.plants.faults import Faults
from jaxtank.safety.filter import SafetyFilter
from jaxtank.safety.outlets import OutletFilter
from jaxtank.safety.prediction import line_of
from jaxtank.signals.base import Signal, sampled

Vector = Any
"""Vector: a tuple of numbers, one per tank, pump or output, or an array (jaxtank.core.vectors)."""


@component
class ClosedLoop:
    """Everything that takes part in a run, and the levels it starts from.

    Parameters
    ----------
    plant : Plant
        What moves.
    sensor : Sensor
    observer : Observer
    controller : Controller
        Its model may differ from the plant.
    actuator : Actuator
    reference : Signal
        Setpoints, one channel per output [cm].
    disturbance : Signal, optional
        Inflows, one channel per tank [cm^3/s].
    faults : Faults, optional
        What changes in the plant during the run, unknown to the controller.
    x0 : (n,) array
        Levels at t = 0 [cm].

    Examples
    --------
    >>> from jaxtank import presets
    >>> loop = presets.load("cascaded/pi").loop
    >>> type(loop.controller).__name__, loop.x0.shape, loop.units
    ('PID', (2,), ('V', 'V'))
    """

    plant: Any
    sensor: Any
    observer: Any
    controller: Any
    actuator: Any
    reference: Signal
    disturbance: Signal | None = None
    faults: Any = None
    safety_filter: SafetyFilter | OutletFilter | None = None
    x0: np.ndarray[Any, Any] = leaf("cm", "levels at t = 0", low=0.0, shape="tank")

    @property
    def units(self) -> tuple[str, str]:
        """(length, pump input) of the rig."""
        return self.plant.units

    @property
    def sequential(self) -> bool:
        """True if controller or observer iterate (`Controller.sequential`)."""
        return self.controller.sequential or self.observer.sequential

    @property
    def signal_units(self) -> dict[str, str]:
        """{signal: the unit of what it carries, for a rig in cm}."""
        return {"reference": "cm", "disturbance": "cm^3/s"}


class State(NamedTuple):
    """State of the loop between two samples."""

    k: Any  # index of the sample
    x: Vector  # levels [cm]
    observer: Any
    controller: Any
    actuator: Any
    sensor: Any = ()
    excess: Vector = ()  # in float32, the rounding error of each level [cm]
    flow: Vector = ()  # of each input [cm^3/s], for a controller that `reads_flow`
    readings: Vector = ()  # of the sample before [cm], where a sensor may freeze


class Inputs(NamedTuple):
    """Data of every sample, computed before the loop: tuples of (samples,), or (samples, n)."""

    r: Vector  # setpoints [cm]
    dr: Vector  # their rates [cm/s]
    ddr: Vector  # their second derivatives [cm/s^2]
    d: Vector | None  # inflow disturbances [cm^3/s]
    xi: Vector | None  # draws of the sensor noise [-]
    context: ms.Context  # reference data of the measures
    plan: Any  # result of the controller's `prepare`
    own: Any  # signals of the controller's own
    fault: Vector | None  # 1 while a fault lasts (`Faults.sample`)


class Partition(NamedTuple):
    """The leaves of a tree in two groups: leaves with tangents, and the rest."""

    structure: Any
    moving: tuple[bool, ...]  # of each leaf, whether it has tangents

    def split(self, tree: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """Return (leaves with tangents, the others)."""
        leaves: list[Any] = jax.tree.leaves(tree)
        with_tangents = tuple(v for v, m in zip(leaves, self.moving) if m)
        return with_tangents, tuple(v for v, m in zip(leaves, self.moving) if not m)

    def join(self, moving: Any, still: Any) -> Any:
        """Return the tree from the results of `split`."""
        moving, still = iter(moving), iter(still)
        leaves: list[Any] = [next(moving) if m else next(still) for m in self.moving]
        return jax.tree.unflatten(self.structure, leaves)


def floats_of(tree: Any) -> Partition:
    """Partition of `tree` by type: only floats have derivatives."""
    leaves: list[Any] = jax.tree.leaves(tree)
    structure = cast(Any, jax.tree.structure(tree))
    return Partition(structure, tuple(bool(jnp.issubdtype(v.dtype, jnp.floating)) for v in leaves))


def takes_arrays(loop: ClosedLoop) -> bool:
    """Whether the vectors of a run are arrays: of many tanks, where plant and faults take them."""
    parts = [part for part in (loop.plant, loop.faults) if part is not None]
    return loop.plant.tanks >= vectors.FROM and all(map(serves_arrays, parts))


def inputs(
    loop: ClosedLoop,
    clock: Clock,
    names: tuple[str, ...],
    key: jax.Array | None,
    batch: Any = None,
    samples: int = 0,
    arrays: bool = False,
) -> Inputs:
    """Return the samples of all signals of a run, or of `samples` of a long run's `batch`."""
    times: Any = clock
    if batch is not None:
        times = Chunk(first=batch * CHUNK, samples=samples, dt=clock.dt)
    return inputs_at(loop, times, names, _drawn(loop.sensor, key, times, batch, arrays), arrays)


def _drawn(sensor: Sensor, key: Any, times: Any, batch: Any, arrays: bool) -> Vector | None:
    """The deviates of the sensor noise (`Sensor.draw`)."""
    if arrays and type(sensor).draw is Sensor.draw:
        deviates = sensor.deviates(key, times.samples, batch)
        return None if deviates is None else deviates.T
    draws = sensor.draw(key, times.samples, batch)
    return columns(draws) if arrays and draws is not None else draws


def inputs_at(
    loop: ClosedLoop,
    times: Clock | Chunk,
    names: tuple[str, ...],
    xi: Vector | None,
    arrays: bool = False,
) -> Inputs:
    """Return `inputs` of a clock or Chunk, for deviates xi of the sensor noise or None."""
    moments: Any = times
    r, dr, ddr = sampled(loop.reference, moments, arrays)
    d = None if loop.disturbance is None else sampled(loop.disturbance, moments, arrays)[0]
    known: tuple[Any, ...] = (r, dr, ddr)
    if not serves_arrays(loop.controller):
        known = tuple(_rows_of(v) for v in known)
    return Inputs(
        r=r,
        dr=dr,
        ddr=ddr,
        d=d,
        xi=xi,
        context=_context(loop, moments, names, r),
        plan=loop.controller.prepare(*known),
        own=loop.controller.announced(moments, known[0]),
        fault=None if loop.faults is None else loop.faults.sample(moments),
    )


def _rows_of(signals: Vector) -> tuple[Any, ...]:
    """Arrays (samples,) of an array (samples, n); a tuple of them unchanged."""
    return scalars(signals.T) if is_array(signals) else signals


def _context(loop: ClosedLoop, times: Any, names: tuple[str, ...], r: Vector) -> ms.Context:
    """Return the Context of the measures `names` for setpoints `r`."""
    fields = ms.refers_to(names)
    window = windows(loop, times, is_array(r)) if "window" in fields else None
    if window is None and "window" in fields:
        raise InputError(
            "overshoot, rise and settling need a reference that changes (signals.Ramps)"
        )
    since = None if loop.disturbance is None else loop.disturbance.since(times)
    if since is None and "since" in fields:
        raise InputError(
            "recovery_time needs a disturbance with a beginning (signals.InflowPulses)"
        )
    steady = _steady_inputs(loop, r) if "steady" in fields else None
    jump = jumps(loop, times, r) if "jump" in fields else None
    return ms.Context(window=window, since=since, steady=steady, jump=jump)


def _steady_inputs(loop: ClosedLoop, r: Vector) -> Any:
    if not ms.serves("input_deviation", loop):
        raise InputError(
            "input_deviation needs a plain rig without pipes, with as many pumps as outputs"
        )
    inputs = steady_along(loop.plant, _rows_of(r), steady_inflow(loop))[1]
    offset = loop.actuator.offset
    if np.ndim(offset):
        inputs = tuple(u + offset[i] for i, u in enumerate(inputs))
    return columns(inputs) if is_array(r) else inputs


def initial(loop: ClosedLoop, clock: Clock, arrays: bool = False) -> State:
    """Return the state before the first sample. arrays: the form of vectors."""
    zero, actuator = zero_of(loop), loop.actuator

    def same_type(v: Any) -> Any:
        return v + zero if jnp.issubdtype(jnp.result_type(v), jnp.floating) else v

    def vector(leaf: Any, size: int) -> Vector:
        return jnp.asarray(leaf) + zero if arrays else tuple(leaf[i] + zero for i in range(size))

    x0, u0 = vector(loop.x0, loop.plant.tanks), vector(actuator.initial, loop.plant.pumps)
    excess: Any = jnp.zeros_like(x0) if arrays else (zero,) * loop.plant.tanks
    flow: Any = ()
    if loop.controller.reads_flow:
        flow = input_flows(loop.plant, x0, loop.actuator.driving(form_for(loop.actuator, u0)))
    begin = actuator.init_arrays if arrays and serves_arrays(actuator) else actuator.init
    return State(
        k=jnp.int32(0),
        x=x0,
        observer=jax.tree.map(same_type, loop.observer.init(form_for(loop.observer, x0))),
        controller=jax.tree.map(same_type, control_state(loop, x0, u0)),
        actuator=jax.tree.map(same_type, begin(clock)),
        sensor=jax.tree.map(same_type, loop.sensor.init(form_for(loop.sensor, x0))),
        excess=excess if zero.dtype == jnp.float32 else (),
        flow=jax.tree.map(same_type, flow),
        readings=x0 if faulty_sensors(loop) and loop.faults.holds else (),
    )


def draws_bursts(loop: ClosedLoop) -> bool:
    """Whether a fault of the loop is noise of a sensor, which needs a key."""
    return faulty_sensors(loop) and loop.faults.noisy


def faulty_sensors(loop: ClosedLoop) -> bool:
    """Whether a fault of the loop is one of a sensor."""
    return isinstance(loop.faults, Faults) and bool(loop.faults.sensors)


def control_state(loop: ClosedLoop, x0: Vector, u0: Vector) -> Any:
    """State of the controller at t = 0, with inputs under way and last inputs where they count."""
    x0, u = form_for(loop.controller, x0), form_for(loop.controller, u0)
    state, safety_filter = loop.controller.init(x0, u), loop.safety_filter
    if safety_filter is not None and safety_filter.predicted:
        state = state, line_of(scalars(u0), safety_filter.predicted)
    return state if loop.actuator.rate is None else (state, u0)


def without_noise(loop: ClosedLoop) -> ClosedLoop:
    """Return the loop without the noise of its sensors, and without faults that are noise."""
    faults = loop.faults.without_noise() if faulty_sensors(loop) else loop.faults
    return dataclasses.replace(loop, sensor=loop.sensor.without_noise(), faults=faults)


def keyed(loop: ClosedLoop, key: jax.Array | None) -> ClosedLoop:
    """Return `loop`; with noise and no key its levels are NaN from the start."""
    # Input validation does not see a traced noise; a run without it would look like an answer.
    if key is not None:
        return loop
    noise = jnp.asarray(loop.sensor.noise)
    # the derivative by the noise is NaN too
    missing = jnp.sum(jnp.where(noise > 0, noise, 0.0) * jnp.where(noise > 0, jnp.nan, 0.0))
    missing = missing + jnp.nan if draws_bursts(loop) else missing
    start: Any = loop.x0 + missing.astype(zero_of(loop).dtype)
    return dataclasses.replace(loop, x0=start)


def run_of(loop: ClosedLoop, clock: Clock, arrays: bool = False) -> ms.Run:
    """Return sizes and constants of a run, for its measures. arrays: the form of vectors."""
    plant, actuator = loop.plant, loop.actuator

    def vector(leaf: Any, size: int) -> Vector:
        return jnp.asarray(leaf) if arrays else tuple(leaf[i] for i in range(size))

    return ms.Run(
        tanks=plant.tanks,
        outputs=len(plant.outputs),
        pumps=plant.pumps,
        samples=clock.samples,
        dt=clock.dt,
        low=vector(actuator.low, plant.pumps),
        high=vector(actuator.high, plant.pumps),
        rim=vector(plant.rim, plant.tanks),
        zero=zero_of(loop),
        arrays=arrays,
    )


def zero_of(loop: ClosedLoop) -> jax.Array:
    """Return 0.0 of the run's type, the most precise of the loop's leaves; warns of float32."""
    kinds: dict[Any, Any] = {}  # one leaf of each: types are looked up slowly
    for v in jax.tree.leaves(loop):
        kinds.setdefault((type(v), getattr(v, "dtype", None), getattr(v, "weak_type", False)), v)
    floats: list[Any] = [
        v for v in kinds.values() if jnp.issubdtype(jnp.result_type(v), jnp.floating)
    ]
    dtype = jnp.result_type(*floats) if floats else jnp.result_type(float)
    if dtype == jnp.float32:
        _warn_float32()
    return jnp.zeros((), dtype)


@functools.cache
def _warn_float32() -> None:
    warnings.warn(
        "this run is in float32. Levels and running sums are compensated for rounding, so levels"
        " are right to about 1e-5 cm (2e-3 cm under gouta2022's controllers, which amplify"
        " rounding; 0.1 to 3 % of input_travel is rounding). Call"
        " jax.config.update('jax_enable_x64', True) first for float64, in which one run is no"
        " slower.",
        stacklevel=6,
    )


def is_broken(state: State) -> Any:
    """Return True if the run diverged: a level that is not finite stays so."""
    return ~jnp.isfinite(total(state.x))

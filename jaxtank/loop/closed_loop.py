"""One sample of the closed loop, and what it needs: the loop itself, its state, and what is known
of every sample beforehand.
"""

import dataclasses
import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank import measures as ms
from jaxtank.analysis.steady_state import steady_along
from jaxtank.controllers.base import Controller
from jaxtank.core.clock import PIECE, Piece
from jaxtank.core.errors import InputError
from jaxtank.core.tree import component, leaf
from jaxtank.instruments.base import Actuator, Sensor
from jaxtank.loop.step import Inputs, State
from jaxtank.observers.base import Observer
from jaxtank.plants.base import Plant
from jaxtank.plants.faults import Faults
from jaxtank.signals.base import Signal


@component
class ClosedLoop:
    """Everything that takes part in a run, and the levels it starts from."""

    plant: Plant
    sensor: Sensor
    observer: Observer
    controller: Controller
    actuator: Actuator
    reference: Signal
    disturbance: Signal | None = None
    faults: Faults | None = None
    x0: np.ndarray = leaf("cm", "(n,) levels at t = 0", low=0.0)

    @property
    def units(self) -> tuple[str, str]:
        """(length, pump input) of the rig."""
        return self.plant.units


def inputs(loop, clock, names, key, piece=None, samples=0):
    """The samples of references, disturbances, noise and windows; of a long run's `piece`, a
    number, its `samples` alone.
    """
    if piece is not None:
        clock = Piece(first=piece * PIECE, samples=samples, dt=clock.dt)
    r, dr, ddr = loop.reference.sample(clock)
    d = None if loop.disturbance is None else loop.disturbance.sample(clock)[0]
    window = None
    if ms.wants_windows(names):
        window = loop.reference.windows(clock)
        if window is None:
            raise InputError(
                "overshoot, rise and settling need a reference that changes (signals.Ramps)"
            )
    since = None if loop.disturbance is None else loop.disturbance.since(clock)
    if since is None and ms.wants_pours(names):
        raise InputError("recovery_time needs a disturbance with a beginning (signals.Pours)")
    if since is not None and window is not None:
        # while a tank recovers from a pour, it is not settling on its setpoint
        window = tuple(
            tuple(jnp.where(since >= 0.0, 0.0, v) for v in channel) for channel in window
        )
    return Inputs(
        r=r,
        dr=dr,
        ddr=ddr,
        d=d,
        xi=loop.sensor.draw(key, clock.samples, piece),
        window=window,
        since=since,
        rest=_rests(loop, r) if ms.wants_rests(names) else None,
        plan=loop.controller.prepare(r, dr, ddr),
        own=loop.controller.inputs(clock),
        fault=None if loop.faults is None else loop.faults.sample(clock),
    )


def _rests(loop, r):
    if not ms.serves("input_deviation", loop):
        raise InputError("input_deviation needs a rig without pipes, with as many pumps as outputs")
    return steady_along(loop.plant, r)[1]


def initial(loop, clock):
    """The state before the first sample."""
    zero = zero_of(loop)

    def typed(tree):
        return jax.tree.map(
            lambda v: v + zero if jnp.issubdtype(jnp.result_type(v), jnp.floating) else v, tree
        )

    x0 = tuple(loop.x0[i] + zero for i in range(loop.plant.tanks))
    u0 = tuple(loop.actuator.initial[i] + zero for i in range(loop.plant.pumps))
    return State(
        k=jnp.int32(0),
        x=x0,
        observer=typed(loop.observer.init(x0)),
        controller=typed(loop.controller.init(x0, u0)),
        actuator=typed(loop.actuator.init(clock)),
        sensor=typed(loop.sensor.init(x0)),
        excess=(zero,) * loop.plant.tanks if zero.dtype == jnp.float32 else (),
    )


def keyed(loop, key):
    """`loop`, if its noise can be drawn: without a key its levels are NaN from the start where
    `sensor.noise` is above 0. A traced noise is not seen by input validation, and a run without it,
    whose slope by it is 0, would look like an answer.
    """
    if key is not None:
        return loop
    noise = jnp.asarray(loop.sensor.noise)
    # its slope by the noise is NaN too
    missing = jnp.sum(jnp.where(noise > 0, noise, 0.0) * jnp.where(noise > 0, jnp.nan, 0.0))
    return dataclasses.replace(loop, x0=loop.x0 + missing.astype(zero_of(loop).dtype))


def run_of(loop, clock):
    """Sizes and constants of a run, for its measures."""
    return ms.Run(
        tanks=loop.plant.tanks,
        outputs=len(loop.plant.outputs),
        pumps=loop.plant.pumps,
        samples=clock.samples,
        dt=clock.dt,
        low=tuple(loop.actuator.low[i] for i in range(loop.plant.pumps)),
        high=tuple(loop.actuator.high[i] for i in range(loop.plant.pumps)),
        rim=tuple(loop.plant.rim[i] for i in range(loop.plant.tanks)),
        zero=zero_of(loop),
    )


def zero_of(loop):
    """0.0 of the type in which the run is done: that of the most precise of the loop's leaves.
    float32 is named, and what it costs.
    """
    leaves = [
        leaf
        for leaf in jax.tree.leaves(loop)
        if jnp.issubdtype(jnp.result_type(leaf), jnp.floating)
    ]
    dtype = jnp.result_type(*leaves) if leaves else jnp.result_type(float)
    if dtype == jnp.float32:
        _warn_float32()
    return jnp.zeros((), dtype)


@functools.cache
def _warn_float32():
    warnings.warn(
        "this run is in float32. Levels and running sums keep what rounding takes from them, so"
        " levels are right to about 1e-5 cm (2e-3 cm under gouta2022's laws, which amplify"
        " rounding; 0.1 to 3 % of input_travel is rounding). Call"
        " jax.config.update('jax_enable_x64', True) first for float64, which one run is no"
        " slower in.",
        stacklevel=6,
    )


def is_broken(state):
    """True if the run left the numbers: a level that is not finite stays so, so the last state
    tells and the loop need not look.
    """
    return ~jnp.isfinite(sum(state.x))

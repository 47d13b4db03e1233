"""One sample of the closed loop, and what it needs: the loop itself, its state, and what is known of every sample beforehand."""

import dataclasses
import functools
import warnings
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank import measures as ms
from jaxtank.actuators import PumpBank
from jaxtank.analysis import steady_along
from jaxtank.compensated import added
from jaxtank.controllers.base import Controller
from jaxtank.errors import InputError
from jaxtank.materialise import materialised
from jaxtank.observers.base import Observer
from jaxtank.pieces import PIECE, Piece
from jaxtank.plants.base import Plant
from jaxtank.plants.faults import Faults
from jaxtank.plants.integration import change, integrate
from jaxtank.records import Sample, Tick
from jaxtank.sensors import LevelSensor
from jaxtank.signals import Signal
from jaxtank.tree import component, is_real, leaf


@component
class ClosedLoop:
    """Everything that takes part in a run, and the levels it starts from."""

    plant: Plant
    sensor: LevelSensor
    observer: Observer
    controller: Controller
    actuator: PumpBank
    reference: Signal
    disturbance: Signal | None = None
    faults: Faults | None = None
    x0: np.ndarray = leaf("cm", "(n,) levels at t = 0", low=0.0)

    @property
    def units(self):
        """(length, pump input) of the rig."""
        return self.plant.units


class State(NamedTuple):
    """What one sample hands to the next."""

    k: Any  # index of the sample
    x: tuple  # levels [cm]
    observer: Any
    controller: Any
    actuator: Any
    excess: tuple = ()  # in float32, what rounding has added to each level too much [cm]


class Inputs(NamedTuple):
    """What is known of every sample before the loop starts: arrays (samples,)."""

    r: tuple
    dr: tuple
    ddr: tuple
    d: tuple | None
    xi: tuple | None
    window: tuple | None
    since: Any  # time since the last pour [s], or None
    rest: tuple | None  # inputs that hold the setpoint [V]
    plan: Any  # what the law has prepared
    own: Any  # signals of the law's own
    fault: tuple | None  # 1 while a fault lasts


def inputs(loop, clock, names, key, piece=None, samples=None):
    """The samples of references, disturbances, noise and windows; of a long run's `piece`, a number, its `samples` alone."""
    if piece is not None:
        clock = Piece(first=piece * PIECE, samples=samples, dt=clock.dt)
    r, dr, ddr = loop.reference.sample(clock)
    d = None if loop.disturbance is None else loop.disturbance.sample(clock)[0]
    window = None
    if ms.wants_windows(names):
        if not hasattr(loop.reference, "windows"):
            raise InputError("overshoot, rise and settling need a reference that changes (signals.Ramps)")
        window = loop.reference.windows(clock)
    since = loop.disturbance.since(clock) if hasattr(loop.disturbance, "since") else None
    if since is None and ms.wants_pours(names):
        raise InputError("recovery_time needs a disturbance with a beginning (signals.Pours)")
    if since is not None and window is not None:
        # while a tank recovers from a pour, it is not settling on its setpoint
        window = tuple(tuple(jnp.where(since >= 0.0, 0.0, v) for v in channel) for channel in window)
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
        return jax.tree.map(lambda v: v + zero if jnp.issubdtype(jnp.result_type(v), jnp.floating) else v, tree)

    x0 = tuple(loop.x0[i] + zero for i in range(loop.plant.tanks))
    u0 = tuple(loop.actuator.initial[i] + zero for i in range(loop.plant.pumps))
    return State(
        k=jnp.int32(0),
        x=x0,
        observer=typed(loop.observer.init(x0)),
        controller=typed(loop.controller.init(x0, u0)),
        actuator=typed(loop.actuator.init(clock)),
        excess=(zero,) * loop.plant.tanks if zero.dtype == jnp.float32 else (),
    )


def keyed(loop, key):
    """`loop`, if its noise can be drawn: without a key its levels are NaN from the start where `sensor.noise` is above 0. A traced noise is
    not seen at the door, and a run without it, whose slope by it is 0, would look like an answer."""
    if key is not None:
        return loop
    noise = jnp.asarray(loop.sensor.noise)
    missing = jnp.sum(jnp.where(noise > 0, noise, 0.0) * jnp.where(noise > 0, jnp.nan, 0.0))  # its slope by the noise is NaN too
    return dataclasses.replace(loop, x0=loop.x0 + missing.astype(zero_of(loop).dtype))


def step(loop, clock, state, now):
    """One sample: (state after it, Sample of it). `now`: this sample's slice of Inputs."""
    t = time_of(state, clock)
    tick = Tick(t=t, r=now.r, dr=now.dr, ddr=now.ddr, dt=clock.dt, plan=now.plan, own=now.own)
    y = loop.sensor.read(state.x, now.xi)
    estimate, observer = loop.observer.step(state.observer, tick, y)
    command, controller = commanded(loop, state.controller, tick, estimate)
    metric = loop.controller.input_metric(estimate) if loop.actuator.saturation == "boxqp" else None
    applied = loop.actuator.limit(command, metric)
    observer = loop.observer.predict(observer, tick, command, applied)
    controller = loop.controller.track(controller, tick, command, applied)
    moved, u, spilled, shortfall = move(loop, clock, state, applied, now)
    e = tuple(z - r for z, r in zip(loop.plant.output(state.x), now.r))
    sample = Sample(
        t=t,
        x=state.x,
        y=y,
        x_hat=estimate.x,
        d_hat=estimate.d or (jnp.zeros_like(state.x[0]),) * loop.plant.tanks,
        r=now.r,
        e=e,
        command=command,
        applied=applied,
        u=u,
        spilled=spilled,
        shortfall=shortfall,
    )
    return moved._replace(observer=observer, controller=controller), sample


def move(loop, clock, state, applied, now):
    """Return (state after a sample, (m) inputs at the plant [V], (n) volume lost over each rim [cm^3], (n) volume that a negative
    inflow could not take [cm^3]) for inputs `applied` (m) [V] within the limits: pumps, faults and plant. Observer and controller
    of the state stay as they are."""
    t = time_of(state, clock)
    u, actuator = loop.actuator.deliver(state.actuator, applied, clock.dt)
    plant = loop.plant if now.fault is None else loop.faults.apply(loop.plant, now.fault)
    x, excess, spilled, shortfall = _advance(plant, clock, t, state.x, state.excess, materialised(loop.actuator.driving(u)), now.d)
    return state._replace(k=state.k + 1, x=x, actuator=actuator, excess=excess), u, spilled, shortfall


def time_of(state, clock):
    """t [s] of a state."""
    return state.k.astype(state.x[0].dtype) * clock.dt


def commanded(loop, state, tick, estimate):
    """Return the controller's ((m,) inputs before their limits, new state).

    Raises InputError, while the loop is traced, for a number of inputs that is not that of the pumps,
    and for an input that is no single real number.
    """
    command, state = loop.controller.step(state, tick, estimate)
    pumps = loop.plant.pumps
    count = (len(command),) if isinstance(command, tuple | list) else np.shape(command)[:1]
    if count != (pumps,):
        law = type(loop.controller).__name__
        found = f"{count[0]} input{'' if count[0] == 1 else 's'}" if count else "one number"
        raise InputError(
            f"controller {law}: its step returns {found} for {pumps} pump{'' if pumps == 1 else 's'}: "
            "must return (inputs, state), a tuple with one input for each pump"
        )
    parts = [(np.shape(v), v) for v in command] if isinstance(command, tuple | list) else [(np.shape(command)[1:], command)]
    switch = np.dtype(bool)  # on or off: 1 or 0
    if any(shape or not (is_real(v) or getattr(v, "dtype", None) == switch) for shape, v in parts):
        raise InputError(
            f"controller {type(loop.controller).__name__}: its step returns an input that is no single real number: "
            "must return (inputs, state), a tuple with one number for each pump"
        )
    return command, state


def _advance(plant, clock, t, x, excess, u, d):
    """Levels after dt with u and d held, what rounding has added to them too much, the volume lost over each rim on the way [cm^3], and
    the volume that a negative inflow could not take from each empty tank [cm^3]."""
    h = clock.dt / clock.substeps
    spilled = shortfall = (0.0,) * plant.tanks
    for j in range(clock.substeps):
        if excess:
            changes = change(plant, clock.integrator, t + j * h, x, u, d, h)
            x, excess = zip(*(added(*each) for each in zip(x, excess, changes)))
        else:
            x = integrate(plant, clock.integrator, t + j * h, x, u, d, h)
        shortfall = tuple(a + b for a, b in zip(shortfall, plant.shortfall(x)))
        x, lost = plant.spill(x)
        spilled = tuple(a + b for a, b in zip(spilled, lost))
    return x, excess, spilled, shortfall


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
    """0.0 of the type in which the run is done: that of the most precise of the loop's leaves. float32 is named, and what it costs."""
    leaves = [leaf for leaf in jax.tree.leaves(loop) if jnp.issubdtype(jnp.result_type(leaf), jnp.floating)]
    dtype = jnp.result_type(*leaves) if leaves else jnp.result_type(float)
    if dtype == jnp.float32:
        _warn_float32()
    return jnp.zeros((), dtype)


@functools.cache
def _warn_float32():
    warnings.warn(
        "this run is in float32. Levels and running sums keep what rounding takes from them, so levels are right to about 1e-5 cm (2e-3 cm "
        "under gouta2022's laws, which amplify rounding; 0.1 to 3 % of input_travel is rounding). Call "
        "jax.config.update('jax_enable_x64', True) first for float64, which one run is no slower in.",
        stacklevel=6,
    )


def is_broken(state):
    """True if the run left the numbers: a level that is not finite stays so, so the last state tells and the loop need not look."""
    return ~jnp.isfinite(sum(state.x))

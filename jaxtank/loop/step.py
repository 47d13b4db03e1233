"""One sample of the closed loop: what it needs, and what it hands to the next."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.core.records import Sample, Tick
from jaxtank.core.tree import is_real
from jaxtank.plants.runge_kutta import advance
from jaxtank.xla.barrier import materialised


class State(NamedTuple):
    """What one sample hands to the next."""

    k: Any  # index of the sample
    x: tuple  # levels [cm]
    observer: Any
    controller: Any
    actuator: Any
    sensor: Any = ()
    excess: tuple = ()  # in float32, what rounding has added to each level too much [cm]


class Decision(NamedTuple):
    """What observer and controller make of one sample."""

    estimate: Any  # Estimate of the levels [cm] and inflows [cm^3/s]
    command: Sequence  # (m) inputs before their limits [V]
    applied: tuple  # (m) inputs within them [V]
    observer: Any  # its state after the sample
    controller: Any  # its state after the sample


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


def step(loop, clock, state, now):
    """One sample: (state after it, Sample of it). `now`: this sample's slice of Inputs."""
    t = time_of(state, clock)
    tick = Tick(t=t, r=now.r, dr=now.dr, ddr=now.ddr, dt=clock.dt, plan=now.plan, own=now.own)
    y, sensor = loop.sensor.step(state.sensor, state.x, now.xi, clock.dt)
    made = decide(loop, state.observer, state.controller, tick, y)
    estimate, command, applied = made.estimate, made.command, made.applied
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
    moved = moved._replace(observer=made.observer, controller=made.controller, sensor=sensor)
    return moved, sample


def decide(loop, observer, controller, tick, y):
    """Return what observer and controller make of one sample: the order of a sample, written once.

    The observer corrects its estimate by the readings, the controller commands, the actuator limits
    the command, and both are given what was applied. Simulation and export call it.

    Parameters
    ----------
    loop : Loop
    observer, controller : states before the sample
    tick : Tick, what is known at its time
    y : (n) readings [cm]

    Returns
    -------
    Decision
    """
    estimate, observer = loop.observer.step(observer, tick, y)
    command, controller = commanded(loop, controller, tick, estimate)
    metric = loop.controller.input_metric(estimate) if loop.actuator.allocates else None
    applied = loop.actuator.limit(command, metric)
    observer = loop.observer.predict(observer, tick, command, applied)
    controller = loop.controller.track(controller, tick, command, applied)
    return Decision(estimate, command, applied, observer, controller)


def move(loop, clock, state, applied, now):
    """Return (state after a sample, (m) inputs at the plant [V], (n) volume lost over each rim
    [cm^3], (n) volume that a negative inflow could not take [cm^3]) for inputs `applied` (m) [V]
    within the limits: pumps, faults and plant. Observer and controller of the state stay as they
    are.
    """
    t = time_of(state, clock)
    u, actuator = loop.actuator.step(state.actuator, applied, clock.dt)
    plant = loop.plant if now.fault is None else loop.faults.apply(loop.plant, now.fault)
    driving = materialised(loop.actuator.driving(u))
    found = advance(
        plant,
        clock.integrator,
        t,
        state.x,
        driving,
        now.d,
        clock.dt,
        clock.substeps,
        excess=state.excess,
    )
    moved = state._replace(k=state.k + 1, x=found.x, actuator=actuator, excess=found.excess)
    return moved, u, found.spilled, found.shortfall


def time_of(state, clock):
    """t [s] of a state."""
    return state.k.astype(state.x[0].dtype) * clock.dt


def commanded(loop, state, tick, estimate):
    """Return the controller's ((m,) inputs before their limits, new state).

    Raises InputError, while the loop is traced, for a number of inputs that is not that of the
    pumps, and for an input that is no single real number.
    """
    command, state = loop.controller.step(state, tick, estimate)
    pumps = loop.plant.pumps
    count = (len(command),) if isinstance(command, tuple | list) else np.shape(command)[:1]
    if count != (pumps,):
        law = type(loop.controller).__name__
        found = f"{count[0]} input{'' if count[0] == 1 else 's'}" if count else "one number"
        raise InputError(
            f"controller {law}: its step returns {found} for {pumps}"
            f" pump{'' if pumps == 1 else 's'}: must return (inputs, state), a tuple with one input"
            " for each pump"
        )
    parts = (
        [(np.shape(v), v) for v in command]
        if isinstance(command, tuple | list)
        else [(np.shape(command)[1:], command)]
    )
    switch = np.dtype(bool)  # on or off: 1 or 0
    if any(shape or not (is_real(v) or getattr(v, "dtype", None) == switch) for shape, v in parts):
        raise InputError(
            f"controller {type(loop.controller).__name__}: its step returns an input that is no"
            " single real number: must return (inputs, state), a tuple with one number for each"
            " pump"
        )
    return command, state

"""One sample of the closed loop: the order of its parts, written once.

Simulation, derivatives, export and Gymnasium call it. May import `loop.closed_loop` and the folders
below `jaxtank.loop`.
"""
# jax leaves the types of zeros, eval_shape, flatten and others partly open.
# pyright: reportUnknownMemberType=false

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import jax.numpy as jnp
import numpy as np

from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.core.records import Estimate, Sample, Tick
from jaxtank.core.tree import is_real
from jaxtank.loop.closed_loop import ClosedLoop, Group, Inputs, State
from jaxtank.plants.runge_kutta import advance
from jaxtank.safety.prediction import moved_on
from jaxtank.xla.barrier import materialised


class Decision(NamedTuple):
    """What observer and controller make of one sample."""

    estimate: Estimate
    command: Sequence[Any]  # (m) inputs before their limits [V]
    applied: Group  # (m) inputs within them [V]
    observer: Any  # its state after the sample
    controller: Any  # its state after the sample
    filtered: Any = 0.0  # 1 where the safety filter changed an input, else 0


def step(loop: ClosedLoop, clock: Clock, state: State, now: Inputs) -> tuple[State, Sample]:
    """Return (state after a sample, Sample of it). now: this sample's slice of Inputs."""
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
        filtered=made.filtered,
    )
    moved = moved._replace(observer=made.observer, controller=made.controller, sensor=sensor)
    return moved, sample


def decide(
    loop: ClosedLoop, observer: Any, controller: Any, tick: Tick, y: Sequence[Any]
) -> Decision:
    """Return what observer and controller make of one sample: the order of a sample, written once.

    The observer corrects its estimate by the readings, the controller commands, the actuator limits
    the command, and both are given what was applied. Simulation and export call it.

    Parameters
    ----------
    loop : ClosedLoop
    observer, controller : tree
        Their states before the sample.
    tick : Tick
        What is known at its time.
    y : (n) sequence
        Readings [cm].

    Returns
    -------
    Decision
    """
    guard, line = loop.safety_filter, None
    if guard is not None and guard.predicted:
        controller, line = controller
    estimate, observer = loop.observer.step(observer, tick, y)
    command, controller = commanded(loop, controller, tick, estimate)
    allocates = loop.actuator.allocates or guard is not None
    metric = loop.controller.input_metric(estimate) if allocates else None
    if guard is None:
        applied, filtered = loop.actuator.limit(command, metric), 0.0
    else:
        applied, filtered = guard.apply(loop.actuator, command, metric, y, tick.dt, line)
    observer = loop.observer.predict(observer, tick, command, applied)
    controller = loop.controller.track(controller, tick, command, applied)
    if line is not None:
        controller = controller, moved_on(line, applied)
    return Decision(estimate, command, applied, observer, controller, filtered)


def move(
    loop: ClosedLoop, clock: Clock, state: State, applied: Group, now: Inputs
) -> tuple[State, Group, Group, Group]:
    """Return (state after a sample, (m) inputs at the plant [V], (n) volume lost over each rim
    [cm^3], (n) volume that a negative inflow could not take [cm^3]) for inputs `applied` (m) [V]
    within the limits: pumps, faults and plant. Observer and controller of the state stay as they
    are.
    """
    t = time_of(state, clock)
    u, actuator = loop.actuator.step(state.actuator, applied, clock.dt)
    plant = loop.plant
    if loop.faults is not None and now.fault is not None:
        plant = loop.faults.apply(plant, now.fault)
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


def time_of(state: State, clock: Clock) -> Any:
    """Return t [s] of a state."""
    return state.k.astype(state.x[0].dtype) * clock.dt


def commanded(
    loop: ClosedLoop, state: Any, tick: Tick, estimate: Estimate
) -> tuple[Sequence[Any], Any]:
    """Return the controller's ((m,) inputs before their limits, new state).

    Raises InputError, while the loop is traced, for a number of inputs that is not that of the
    pumps, and for an input that is no single real number.
    """
    command, state = loop.controller.step(state, tick, estimate)
    _check_command(command, loop.plant.pumps, type(loop.controller).__name__)
    return command, state


def _check_command(command: Any, pumps: int, name: str) -> None:
    """Raise InputError unless `command`, of the controller `name`, is one real number per pump."""
    several = isinstance(command, tuple | list)
    entries: list[Any] = list(cast(Any, command)) if several else []
    count = (len(entries),) if several else np.shape(command)[:1]
    if count != (pumps,):
        found = f"{count[0]} input{'' if count[0] == 1 else 's'}" if count else "one number"
        raise InputError(
            f"controller {name}: its step returns {found} for {pumps}"
            f" pump{'' if pumps == 1 else 's'}: must return (inputs, state), a tuple with one input"
            " for each pump"
        )
    parts = [(np.shape(v), v) for v in entries] if several else [(np.shape(command)[1:], command)]
    switch = np.dtype(bool)  # on or off: 1 or 0
    if any(shape or not (is_real(v) or getattr(v, "dtype", None) == switch) for shape, v in parts):
        raise InputError(
            f"controller {name}: its step returns an input that is no single real number: must"
            " return (inputs, state), a tuple with one number for each pump"
        )

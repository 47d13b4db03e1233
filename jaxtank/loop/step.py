"""One sample of the closed loop, in the order of simulation, derivatives, export and Gymnasium."""
# pyright: reportUnknownMemberType=false

import functools
import operator
from collections.abc import Sequence
from typing import Any, NamedTuple, NoReturn, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.controllers.base import Controller
from jaxtank.core.checks import check_each, traceable
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.core.records import Estimate, Sample, Tick
from jaxtank.core.text import count
from jaxtank.core.tree import is_real
from jaxtank.core.vectors import each, form_for, is_array, keeping_nan, like, scalars, zeros
from jaxtank.loop.closed_loop import ClosedLoop, Inputs, State, Vector, faulty_sensors
from jaxtank.plants.elements import input_flows
from jaxtank.plants.runge_kutta import advance
from jaxtank.safety.prediction import moved_on
from jaxtank.xla.barrier import materialised


class Decision(NamedTuple):
    """Results of observer and controller at one sample."""

    estimate: Estimate
    command: Sequence[Any]  # (m) inputs before their limits [V]
    applied: Vector  # (m) inputs within them [V]
    observer: Any  # its state after the sample
    controller: Any  # its state after the sample
    filtered: Any = 0.0  # 1 where the safety filter changed an input, else 0
    slack: Any = 0.0  # by which the controller gives up a limit of a level [cm]


def step(loop: ClosedLoop, clock: Clock, state: State, now: Inputs) -> tuple[State, Sample]:
    """Return (state after a sample, Sample of it). now: this sample's slice of Inputs."""
    t = time_of(state, clock)
    tick = tick_of(loop, clock, t, state, now)
    y, state = readings(loop, state, now, clock)
    decision = decide(loop, state.observer, state.controller, tick, y)
    estimate, command, applied = decision.estimate, decision.command, decision.applied
    if loop.safety_filter is not None:  # which lets no NaN through
        applied = like(each(keeping_nan, command, applied), state.x)
    moved, u, spilled, shortfall = move(loop, clock, state, applied, now)
    e = each(operator.sub, loop.plant.output(state.x), now.r)
    d_hat, x = estimate.d, state.x
    if not len(d_hat):
        d_hat = zeros(x) if is_array(x) else (jnp.zeros_like(x[0]),) * len(x)
    sample = Sample(
        t=t,
        x=x,
        y=y,
        x_hat=estimate.x,
        d_hat=d_hat,
        r=now.r,
        e=e,
        command=command,
        applied=applied,
        u=u,
        spilled=spilled,
        shortfall=shortfall,
        filtered=decision.filtered,
        slack=decision.slack,
        modes=estimate.modes,
        coefficients=estimate.coefficients,
    )
    return moved._replace(observer=decision.observer, controller=decision.controller), sample


def decide(
    loop: ClosedLoop,
    observer: Any,
    controller: Any,
    tick: Tick,
    y: Sequence[Any],
    manual: tuple[Any, Sequence[Any]] | None = None,
) -> Decision:
    """Run observer and controller for one sample; every simulation and export uses this order."""
    # manual: (whether an operator sets the inputs, these inputs (m) [V]), of exported code
    safety_filter, under_way = loop.safety_filter, None
    actuator, limited_rate = loop.actuator, loop.actuator.rate is not None
    if limited_rate:  # anti-windup is given the inputs that the pumps reach
        controller, before = controller
        actuator = actuator.reachable(form_for(actuator, before), tick.dt)
    if safety_filter is not None and safety_filter.predicted:
        controller, under_way = controller
    tick_of_observer = _tick_for(loop.observer, tick)
    estimate, observer = _estimated(loop, observer, tick_of_observer, y)
    estimate = estimate._replace(x=like(estimate.x, y), d=like(estimate.d, y))
    command, controller = commanded(loop, controller, tick, estimate)
    demand = command
    if manual is not None:
        command = tuple(jnp.where(manual[0], w, u) for w, u in zip(manual[1], scalars(command)))
    slack = loop.controller.slack(controller)
    allocates = actuator.allocates or safety_filter is not None
    metric = loop.controller.input_metric(_estimate_for(loop, estimate)) if allocates else None
    if safety_filter is None:
        applied, filtered = actuator.limit(form_for(actuator, command), metric), 0.0
    else:
        entries = scalars(command)
        applied, filtered = safety_filter.apply(
            actuator, entries, metric, scalars(y), tick.dt, under_way
        )
    applied = materialised(like(applied, y)) if is_array(y) else like(applied, y)
    watched, acting = form_for(loop.observer, command), form_for(loop.observer, applied)
    observer = loop.observer.predict(observer, tick_of_observer, watched, acting)
    tick_of_controller = _tick_for(loop.controller, tick)
    raw, limited = form_for(loop.controller, demand), form_for(loop.controller, applied)
    after = loop.controller.track(controller, tick_of_controller, raw, limited)
    if manual is not None:
        set_by_hand = loop.controller.transfer(controller, tick_of_controller, raw, limited)
        choose: Any = functools.partial(jnp.where, manual[0])
        after = jax.tree.map(choose, set_by_hand, after)
    controller = after
    if under_way is not None:
        controller = controller, moved_on(under_way, scalars(applied))
    if limited_rate:
        controller = controller, applied
    return Decision(estimate, command, applied, observer, controller, filtered, slack)


def tick_of(loop: ClosedLoop, clock: Clock, t: Any, state: State, now: Inputs) -> Tick:
    """Return the Tick of a sample, with the flows that the controller reads."""
    inflow: Any = now.d if loop.controller.reads_inflow and now.d is not None else ()
    setpoints = {"r": now.r, "dr": now.dr, "ddr": now.ddr}
    signals = {"plan": now.plan, "own": now.own, "inflow": inflow, "flow": state.flow}
    return Tick(t=t, dt=clock.dt, **setpoints, **signals)


def readings(loop: ClosedLoop, state: State, now: Inputs, clock: Clock) -> tuple[Vector, State]:
    """Return ((n,) readings of a state [cm], the state with its sensors after them)."""
    sensor, x = loop.sensor, state.x
    faults: Any = loop.faults if faulty_sensors(loop) and now.fault is not None else None
    x = x if faults is None else faults.seen(x, now.xi, now.fault)
    label = f"sensor {type(sensor).__name__}: its step"
    with traceable(label):
        result: Any = sensor.step(
            state.sensor, form_for(sensor, x), form_for(sensor, now.xi), clock.dt
        )
    if not (isinstance(result, tuple) and len(cast(Any, result)) == 2):
        raise InputError(f"{label} must return (readings, state)")
    y, after = cast(tuple[Any, Any], result)
    check_each(label, y, loop.plant.tanks, "reading")
    y = like(y, state.x)
    if faults is not None and faults.holds:
        y = faults.frozen(y, state.readings, now.fault)
        state = state._replace(readings=y)
    return y, state._replace(sensor=after)


def _tick_for(part: Any, tick: Tick) -> Tick:
    """`tick` with setpoints in the form that a component takes."""
    r, dr, ddr = (form_for(part, v) for v in (tick.r, tick.dr, tick.ddr))
    inflow, flow = form_for(part, tick.inflow), form_for(part, tick.flow)
    return tick._replace(r=r, dr=dr, ddr=ddr, inflow=inflow, flow=flow)


def _estimate_for(loop: ClosedLoop, estimate: Estimate) -> Estimate:
    """`estimate` in the form that the controller takes."""
    return Estimate(form_for(loop.controller, estimate.x), form_for(loop.controller, estimate.d))


def move(
    loop: ClosedLoop, clock: Clock, state: State, applied: Vector, now: Inputs
) -> tuple[State, Vector, Vector, Vector]:
    """Return (state after pumps, faults and plant, (m) inputs [V], (n) spilled, (n) shortfall)."""
    # spilled: volume lost over each rim [cm^3]; shortfall: volume that a negative inflow could not
    # take [cm^3]; `applied` (m) [V] are inputs within the limits
    t = time_of(state, clock)
    u, actuator = loop.actuator.step(state.actuator, form_for(loop.actuator, applied), clock.dt)
    plant = loop.plant
    if loop.faults is not None and now.fault is not None:
        faults: Any = loop.faults
        faulty = faults.apply_arrays if is_array(state.x) else faults.apply
        plant = faulty(plant, now.fault)
    driving, u = like(loop.actuator.driving(u), state.x), like(u, state.x)
    if not is_array(u):  # arrays have been so since `decide`
        driving = materialised(driving)
    lengths, excess = (clock.dt, clock.substeps), state.excess
    advanced = advance(plant, clock.integrator, t, state.x, driving, now.d, *lengths, excess=excess)
    moved = state._replace(k=state.k + 1, x=advanced.x, actuator=actuator, excess=advanced.excess)
    if loop.controller.reads_flow:
        moved = moved._replace(flow=input_flows(plant, advanced.x, driving))
    return moved, u, advanced.spilled, advanced.shortfall


def time_of(state: State, clock: Clock) -> Any:
    """Return t [s] of a state."""
    kind = state.x.dtype if is_array(state.x) else state.x[0].dtype
    return state.k.astype(kind) * clock.dt


def _estimated(loop: ClosedLoop, state: Any, tick: Tick, y: Vector) -> tuple[Estimate, Any]:
    """The observer's (Estimate, new state); InputError for a step that returns anything else."""
    label = f"observer {type(loop.observer).__name__}: its step"
    with traceable(label):
        result: Any = loop.observer.step(state, tick, form_for(loop.observer, y))
    if not (isinstance(result, tuple) and len(cast(Any, result)) == 2):
        result = None, ()
    estimate, after = cast(tuple[Any, Any], result)
    if not isinstance(estimate, Estimate):
        raise InputError(f"{label} must return (Estimate(x=...), state)")
    check_each(label, estimate.x, loop.plant.tanks, "level")
    if len(estimate.d):
        check_each(label, estimate.d, loop.plant.tanks, "disturbance")
    return estimate, after


def commanded(
    loop: ClosedLoop, state: Any, tick: Tick, estimate: Estimate
) -> tuple[Sequence[Any], Any]:
    """Return the controller's ((m,) inputs before their limits, new state)."""
    # Raises InputError, while the loop is traced, for a step that jax cannot trace or whose result
    # is not (one real number per pump, a state of the form of `init`).
    controller, pumps = loop.controller, loop.plant.pumps
    label = f"controller {type(controller).__name__}: its step"
    arguments = state, _tick_for(controller, tick), _estimate_for(loop, estimate)
    try:
        with traceable(label):
            result: Any = controller.step(*arguments)
    except (IndexError, TypeError, ValueError) as error:
        if isinstance(error, InputError) or not _is_stateless(controller, state):
            raise
        raise InputError(
            f"{label} raises {type(error).__name__} ({error}), and its state is (): a class with a"
            " state needs init(self, x0, u0), which returns the first one"
        ) from error
    if not (isinstance(result, tuple) and len(cast(Any, result)) == 2):
        _refuse_result(label, result, pumps)
    command, after = cast(tuple[Any, Any], result)
    _check_command(label, command, after, pumps)
    if _form(after) != _form(state):
        first = "(), as its class has no init(self, x0, u0)"
        first = first if _is_stateless(controller, state) else "that of its init"
        raise InputError(
            f"{label} returns a state of another form than the first one, {first}: must return"
            " arrays of the same shapes, in the same order"
        )
    return like(command, estimate.x), after


def _is_stateless(controller: Controller, state: Any) -> bool:
    """Whether the state is () because the class has no `init`."""
    cls: Any = type(controller)
    return isinstance(state, tuple) and not state and cls.init is cast(Any, Controller).init


def _form(state: Any) -> Any:
    """Structure and shapes of the state of a controller."""
    leaves: Any = jax.tree.leaves(state)
    return jax.tree.structure(state), [np.shape(v) for v in leaves]


def _refuse_result(label: str, result: Any, pumps: int, hint: str = "") -> NoReturn:
    """Raise InputError for a result of `step` that is not (inputs, state)."""
    several = isinstance(result, tuple | list)
    sizes = (len(cast(Any, result)),) if several else np.shape(result)[:1]
    words = "None" if result is None else count(sizes[0], "input") if sizes else "one number"
    raise InputError(
        f"{label} returns {words} for {count(pumps, 'pump')}{hint}: must return"
        " (inputs, state), a tuple with one input for each pump"
    )


def _check_command(label: str, command: Any, after: Any, pumps: int) -> None:
    """Raise InputError unless `command` is one real number per pump; after: the new state."""
    several = isinstance(command, tuple | list)
    entries: list[Any] = list(cast(Any, command)) if several else []
    sizes = (len(entries),) if several else np.shape(command)[:1]
    if sizes != (pumps,):
        bare = pumps == 2 and not sizes and is_real(after) and np.ndim(after) == 0
        _refuse_result(label, command, pumps, " and, it seems, no state" if bare else "")
    parts = [(np.shape(v), v) for v in entries] if several else [(np.shape(command)[1:], command)]
    switch = np.dtype(bool)  # on or off: 1 or 0
    if any(shape or not (is_real(v) or getattr(v, "dtype", None) == switch) for shape, v in parts):
        raise InputError(
            f"{label} returns an input that is no single real number: must"
            " return (inputs, state), a tuple with one number for each pump"
        )

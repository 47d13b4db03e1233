"""Stability margins of a closed loop at the steady state of every plateau, and the worst."""
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false, reportUnknownLambdaType=false
# pyright: reportConstantRedefinition=false

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxtank import measures as ms
from jaxtank.analysis import margins as am
from jaxtank.analysis.elimination import solve_all
from jaxtank.analysis.frequency import OpenLoop
from jaxtank.analysis.steady_state import at_rest
from jaxtank.controllers.override import Override
from jaxtank.core import vectors
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.loop.closed_loop import ClosedLoop, Inputs, State, floats_of, initial, run_of, zero_of
from jaxtank.loop.of_case import takes_case
from jaxtank.loop.steady import at_mean_inflow, sharing, steady_inflow
from jaxtank.loop.step import decide, move, tick_of
from jaxtank.loop.validation import check
from jaxtank.measures import Context
from jaxtank.plants.elements import is_unregulated
from jaxtank.plants.tank_network import TankNetwork
from jaxtank.signals.base import Constant
from jaxtank.xla.jit import compiled

PLANT_STEPS, LOOP_STEPS = 40, 10
"""Newton steps to the steady state of the plant, and from it to the steady state of the loop."""

FAR = 1e6
"""Limits of pumps that are inactive, in ranges of the pump."""

PROBES = 2
"""Directions in which differences on both sides of a steady state are compared with slopes."""

NEAR, FLOORS = 1e-2, (1e-3, 1e-8)
"""Of the second, nearer difference in a direction: its length as a share of the first; and, of
both, the least change of a number, in changes of the largest. A kink shows in both; the curvature
of a small variance of an observer in the first alone."""

KINK = 1e-3
"""Largest relative difference of a derivative from a finite difference [-]."""

REASONS = (
    "",
    "the rates of the plant depend on time: it has no steady state",
    "a tank would be at its rim",
    "a tank would be empty, or below its laminar threshold",
    "a pump would run at or beyond its limits",
    "the controller or an instrument has no derivative there (a switch, a dead zone)",
    "no steady state of the loop is found there (a controller that switches, whose action vanishes"
    " at the setpoint, or that reads a tank which fills or runs empty has none)",
    "the controller or an instrument counts samples, and has no steady state",
    "the controller does not use the readings",
)
"""Why a steady state cannot be used, by the number of `Linearised.why`; 0: it can."""


class Linearised(NamedTuple):
    """The loop at the steady state of one plateau."""

    open_loop: OpenLoop
    x: Any  # (n,) levels [cm]
    u: Any  # (m,) inputs within their limits [V]
    why: Any  # 0, or the number of a reason in REASONS


def linearised(loop: ClosedLoop, clock: Clock, r: Any) -> Linearised:
    """Return one sample of the loop linearised at the steady state of constant setpoints."""
    # Opened between the actuator's input and the pumps, so that dead time and lag are in the open
    # loop; without limits, noise, filter, pulses and faults. A, B and C are 0 beside a `why`.
    quiet, dead = _without_limits(loop, clock)
    rest, alone = _rest(clock, quiet, r), _plant_at_rest(quiet, r)
    (closed, B, C, after, u), s, kink = rest.slopes, rest.s, rest.kink
    x = s[: loop.plant.tanks]  # the first numbers of a State
    changed = jnp.abs(after - s) > 1e-8 * jnp.abs(s) + 1e-10 * jnp.max(jnp.abs(s))
    finite = [jnp.all(jnp.isfinite(v)) for v in (s, closed, B, C)]
    lost = jnp.any(changed) | ~jnp.all(jnp.stack(finite))
    # if the loop has no steady state, the steady inputs of the plant, if unique, give the reason
    by_plant = lost & (loop.plant.pumps == len(loop.plant.outputs))
    known = [jnp.where(lost, jnp.nan, v) for v in (x, u)]
    levels, volts = (jnp.where(by_plant, a, b) for a, b in zip(alone, known))
    bank, least = loop.actuator, loop.actuator.driving(tuple(jnp.asarray(loop.actuator.low)))
    low = jnp.where(
        by_plant, jnp.stack(list(least)) + jnp.asarray(bank.offset), jnp.asarray(bank.low)
    )
    high = jnp.asarray(bank.high)
    moved = lost | jnp.any(C != 0.0, axis=1)  # a pump that stands still may be at its limit
    checks = [
        jnp.asarray(loop.plant.depends_on_time),
        jnp.any(levels >= jnp.asarray(loop.plant.rim)) & loop.plant.overflow,
        jnp.any(levels < getattr(loop.plant, "knee", 0.0)),
        jnp.any(jnp.where(moved, (volts >= high) | (volts <= low), (volts > high) | (volts < low))),
        kink,
        lost,
        rest.counts,
        jnp.all(C == 0.0),
    ]
    why = jnp.select(checks, list(range(1, len(REASONS))), 0)
    A, B, C = (jnp.where(why == 0, v, 0.0) for v in (closed - B @ C, B, C))
    inputs, C = _by_loops(loop, C)
    return Linearised(OpenLoop(A, B, -C, dead, clock.dt, inputs), x, u, why)


def _loops_of(loop: ClosedLoop) -> list[tuple[int, ...]]:
    """The inputs of each loop, in the order of their first ones."""
    joint = loop.controller.joint_inputs()
    together = {j for inputs in joint for j in inputs}
    alone = [(j,) for j in range(loop.plant.pumps) if j not in together]
    return sorted([*joint, *alone])


def _by_loops(loop: ClosedLoop, C: Any) -> tuple[Any, Any]:
    """((m, L) inputs that L loops move for a signal of 1, (L, N) signals), from C (m, N)."""
    # the signal of a loop is its input that moves most, in ranges of its pump; an input that stands
    # still is moved by no loop
    pumps = loop.plant.pumps
    ranges = jnp.asarray(loop.actuator.high) - jnp.asarray(loop.actuator.low)
    gains = C / jnp.where(jnp.all(jnp.isfinite(ranges)), ranges, 1.0)[:, None]
    signals: list[Any] = []
    columns: list[Any] = []
    for inputs in _loops_of(loop):
        members = np.array(inputs)
        most = jnp.argmax(jax.lax.stop_gradient(jnp.sum(gains[members] ** 2, axis=1)))
        signal = gains[members][most]
        square = jnp.sum(signal * signal)
        shares = C[members] @ signal / jnp.where(square > 0.0, square, 1.0)
        columns.append(jnp.zeros(pumps, C.dtype).at[members].set(shares))
        signals.append(signal)
    return jnp.stack(columns, axis=1), jnp.stack(signals)


def _without_limits(loop: ClosedLoop, clock: Clock) -> tuple[ClosedLoop, Any]:
    """(the loop without noise, limits, dead time and filter; its dead time in samples)."""
    sensor: Any = loop.sensor.without_noise()
    if getattr(sensor, "bits", 0):
        sensor = dataclasses.replace(sensor, bits=0)
    actuator: Any = loop.actuator
    low, high = jnp.asarray(actuator.low), jnp.asarray(actuator.high)
    far = FAR * jnp.where(jnp.isfinite(high - low), high - low, 1.0)
    changes: dict[str, Any] = {"low": low - far, "high": high + far}
    dead = round(float(actuator.delay) / clock.dt)
    if dead:
        changes["delay"] = 0.0
    if actuator.delays:
        dead = dead + np.array([round(more / clock.dt) for more in actuator.delays])
        changes["delays"] = ()
    if actuator.rate is not None:  # small changes do not reach it
        changes["rate"] = None
    plant: Any = loop.plant
    if getattr(plant, "bottom", False):  # what limits an outflow near empty has no slope
        plant = dataclasses.replace(plant, bottom=False)
    quiet = dataclasses.replace(
        loop,
        plant=plant,
        sensor=sensor,
        actuator=dataclasses.replace(actuator, **changes),
        disturbance=None if steady_inflow(loop) is None else loop.disturbance,
        faults=None,
        safety_filter=None,
    )
    return quiet, dead


def _plant_at_rest(loop: ClosedLoop, r: Any) -> tuple[Any, Any]:
    """(levels (n,), inputs (m,)) of the plant at rest with outputs r, where the search starts."""
    # with the limits of overrides that it passes, one or all, in place of their setpoints
    loop, r = jax.lax.stop_gradient((loop, r))
    x, u = _plant_at_setpoints(loop, r)
    law: Any = getattr(loop.controller, "law", loop.controller)
    if not isinstance(law, Override):
        return x, u
    limited, outputs = cast(Any, law.limited), loop.plant.outputs
    limit, gain = jnp.asarray(law.limit), jnp.asarray(law.limit_Kc)
    upper, level = (gain > 0.0) == (law.select == "low"), x[np.array(limited)]
    passed = jnp.where(upper, level > limit, level < limit)
    single, joint = np.eye(len(outputs), dtype=bool), np.ones((1, len(outputs)), dtype=bool)
    for overridden in np.unique(np.concatenate([single, joint]), axis=0):
        tanks = tuple(i if over else k for i, k, over in zip(limited, outputs, overridden))
        if len(set(tanks)) == len(tanks):
            plant: Any = dataclasses.replace(loop.plant, outputs=tanks)
            at_limits = dataclasses.replace(loop, plant=plant)
            states = _plant_at_setpoints(at_limits, jnp.where(overridden, limit, r))
            x, u = (jnp.where(jnp.all(passed == overridden), a, b) for a, b in zip(states, (x, u)))
    return x, u


def _plant_at_setpoints(loop: ClosedLoop, r: Any) -> tuple[Any, Any]:
    """`_plant_at_rest` without overrides."""
    # levels that are not controlled start at the mean setpoint; a step at most halves them
    shared = sharing(loop)
    if isinstance(loop.plant, TankNetwork) and (shared is not None or not loop.plant.plain):
        ignored = is_unregulated(loop.plant)
        x, u, _ = at_rest(loop.plant, r, steady_inflow(loop), shared=shared, ignored=ignored)
        x = jnp.where(ignored, jnp.stack(list(loop.x0)), jnp.stack(x))
        return x, jnp.stack([jnp.asarray(v, r.dtype) for v in u]) + loop.actuator.offset
    plant, inflow, offset = loop.plant, steady_inflow(loop), loop.actuator.offset
    outputs = np.array(plant.outputs)
    free = np.array([i for i in range(plant.tanks) if i not in plant.outputs], dtype=int)
    x = jnp.full(plant.tanks, jnp.mean(jnp.abs(r))).at[outputs].set(r)

    def rates(x: Any, u: Any) -> Any:
        if inflow is None:
            return plant.rates(x, u)
        return jnp.stack(plant.derivative(0.0, tuple(x), tuple(u), tuple(inflow)))

    slope = jax.jacfwd(rates, argnums=(0, 1))

    def newton(_: Any, state: Any) -> Any:
        x, u = state
        by_x, by_u = slope(x, u)
        J = jnp.concatenate([by_x[:, free], by_u], axis=1)
        scale = jnp.sqrt(jnp.sum(J * J, axis=0))
        J = J / jnp.where(scale > 0.0, scale, 1.0)
        square = J.T @ J + 1e-14 * jnp.eye(J.shape[1])
        step = solve_all(square, -(J.T @ rates(x, u))[:, None])[:, 0]
        step = step / jnp.where(scale > 0.0, scale, 1.0)
        moved = x[free] + step[: len(free)]
        return x.at[free].set(jnp.maximum(moved, 0.5 * x[free])), u + step[len(free) :]

    start = (x, jnp.zeros(plant.pumps, x.dtype))
    x, u = jax.lax.fori_loop(0, PLANT_STEPS, newton, start)
    return x, u + jnp.asarray(offset)


class _Sample:
    """One sample of a loop with constant setpoints as a function of its state, a vector (N,)."""

    def __init__(self, loop: ClosedLoop, clock: Clock, r: Any, guess: tuple[Any, Any]):
        x, u = guess
        actuator: Any = loop.actuator
        started: Any = dataclasses.replace(actuator, initial=u)
        self.loop, self.clock = loop, clock
        self.now = constant_inputs(loop, clock, r)
        first = initial(dataclasses.replace(loop, x0=x, actuator=started), clock)
        settled = loop.observer.settled(first.observer, clock.dt, tuple(u))
        first = first._replace(observer=settled)
        if not getattr(loop.plant, "plain", True):  # a curve may be flat elsewhere
            y, _ = loop.sensor.step(first.sensor, first.x, None, clock.dt)
            tick = tick_of(loop, clock, jnp.zeros_like(first.x[0]), first, self.now)
            parts = loop, first.observer, first.controller
            commanding = decide(*parts, tick, y, manual=(True, tuple(u)))  # u, from then on
            first = first._replace(controller=commanding.controller)
        self.levels = first.x
        self.parts = floats_of(first)
        floats, self.rest = self.parts.split(first)
        self.shapes = [v.shape for v in floats]
        self.start = jax.lax.stop_gradient(_flat(floats))
        self.counts = False  # True where a sample changes whole numbers of the state

    def after(self, s: Any, w: Any) -> tuple[Any, Any]:
        """(state after a sample, (m,) inputs of the loop) with w (m,) added at the pumps."""
        ends = np.cumsum([int(np.prod(shape)) for shape in self.shapes])[:-1]
        floats = [v.reshape(shape) for v, shape in zip(jnp.split(s, ends), self.shapes)]
        state: State = self.parts.join(floats, self.rest)
        loop, clock = self.loop, self.clock
        y, sensor = loop.sensor.step(state.sensor, state.x, None, clock.dt)
        tick = tick_of(loop, clock, jnp.zeros_like(state.x[0]), state, self.now)
        decision = decide(loop, state.observer, state.controller, tick, y)
        parts = dict(observer=decision.observer, controller=decision.controller, sensor=sensor)
        applied = decision.applied
        inputs = tuple(a + v for a, v in zip(applied, w))
        moved = move(loop, clock, state._replace(**parts), inputs, self.now)[0]
        floats, rest = self.parts.split(moved._replace(k=state.k))
        self.counts = any(a is not b for a, b in zip(rest, self.rest))
        return _flat(floats), jnp.stack(list(applied))

    def ignored_levels(self, C: Any) -> Any:
        """(N,) mask of the levels in the state that affect no flow and no controller."""
        n, plant = len(self.levels), self.loop.plant
        network = isinstance(plant, TankNetwork)
        mask = is_unregulated(plant) if network else np.zeros(n, bool)
        return jnp.pad(mask & jnp.all(C[:, :n] == 0.0, axis=0), (0, C.shape[1] - n))

    def slopes(self, s: Any) -> "_Slopes":
        """Result of `after`, and its derivatives."""

        def both(s: Any, w: Any) -> Any:
            results = self.after(s, w)
            return results, results

        jacobian: Any = jax.jacfwd(both, argnums=(0, 1), has_aux=True)
        results: Any = jacobian(s, jnp.zeros(self.loop.plant.pumps, s.dtype))
        ((closed, B), (C, _)), (after, applied) = results
        # where such a tank fills or runs empty, the loop has its margins all the same
        still = self.ignored_levels(C)
        closed, B = (jnp.where(still[:, None], 0.0, v) for v in (closed, B))
        return _Slopes(closed, B, C, jnp.where(still, self.start, after), applied)


def _flat(values: Any) -> Any:
    return jnp.concatenate([jnp.ravel(v) for v in values])


class _Slopes(NamedTuple):
    """A sample of the closed loop and its derivatives, with N numbers in its state."""

    closed: Any  # (N, N) of the state after a sample by the state
    B: Any  # (N, m) of it by inputs added at the pumps
    C: Any  # (m, N) derivative of the applied inputs by the state
    after: Any  # (N,) state after the sample
    applied: Any  # (m,) what the loop applies [V]


class _Rest(NamedTuple):
    """The steady state of a loop, whether it is one or not."""

    slopes: _Slopes
    s: Any  # (N,) state
    kink: Any  # True where differences of a sample differ from its derivatives
    counts: Any  # True where a sample changes whole numbers of the state


def constant_inputs(loop: ClosedLoop, clock: Clock, r: Any) -> Inputs:
    """Return the Inputs of one sample with setpoints r (outputs,) that do not change."""
    columns = tuple(v[None] for v in r)
    zero = tuple(jnp.zeros_like(v) for v in columns)
    plan = loop.controller.prepare(columns, zero, zero)
    signals = loop.controller.announced(dataclasses.replace(clock, duration=clock.dt), columns)
    rows: Any = (columns, zero, zero, plan, signals)
    r, dr, ddr, plan, signals = jax.tree.map(lambda a: a[0], rows)
    inflow = steady_inflow(loop)
    d = None if inflow is None else tuple(inflow[i] for i in range(loop.plant.tanks))
    return Inputs(r, dr, ddr, d, None, Context(), plan, signals, None)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _rest(clock: Clock, loop: ClosedLoop, r: Any) -> _Rest:
    """The state at which a sample changes nothing, by Newton's method; not finite if none is."""
    # then PROBES pairs of differences on each side are compared with the slopes, by one program
    sample = _Sample(loop, clock, r, _plant_at_rest(loop, r))
    eye = jnp.eye(sample.start.shape[0], dtype=sample.start.dtype)
    share = jnp.finfo(eye.dtype).eps ** (1.0 / 3.0)

    def body(state: Any, k: Any) -> Any:
        point, s, reference, far, kink = state
        sampled = sample.slopes(point)
        differs = _differs(sampled, reference, point - s)
        i = k - LOOP_STEPS  # probes are far and near in turn
        kink = kink | ((i > 0) & (i % 2 == 0) & far & differs)
        searching = k <= LOOP_STEPS
        reference = jax.tree.map(lambda a, b: jnp.where(searching, a, b), sampled, reference)
        s = jnp.where(searching, point, s)
        newton = s + solve_all(eye - sampled.closed, (sampled.after - s)[:, None])[:, 0]
        near = i % 2 == 1
        floor = jnp.where(near, FLOORS[1], FLOORS[0]) * jnp.max(jnp.abs(s))
        size = jnp.where(near, NEAR, 1.0) * share * jnp.maximum(jnp.abs(s), floor)
        probe = s + size * _direction(LOOP_STEPS + i // 2, len(eye))
        return (jnp.where(k < LOOP_STEPS, newton, probe), s, reference, differs, kink), None

    nothing = jax.tree.map(
        lambda v: jnp.zeros(v.shape, v.dtype), jax.eval_shape(sample.slopes, sample.start)
    )
    no = jnp.array(False)
    start = (sample.start, sample.start, nothing, no, no)
    sampled: Any = jax.lax.scan(body, start, jnp.arange(LOOP_STEPS + 1 + 4 * PROBES))[0]
    _, s, reference, _, kink = sampled
    return _Rest(reference, s, kink, jnp.array(sample.counts))


@_rest.defjvp
def _rest_jvp(clock: Clock, primals: Any, tangents: Any) -> Any:
    """Derivatives by the implicit function: (I - closed) ds = the change of `after` at s held."""
    loop, r = primals
    rest: Any = _rest(clock, loop, r)
    guess = _plant_at_rest(loop, r)
    none = jnp.zeros(loop.plant.pumps, rest.s.dtype)

    def after(loop: ClosedLoop, r: Any) -> Any:
        return _Sample(loop, clock, r, guess).after(rest.s, none)[0]

    def slopes(s: Any, loop: ClosedLoop, r: Any) -> _Slopes:
        return _Sample(loop, clock, r, guess).slopes(s)

    pushed: Any = jax.jvp(after, primals, tangents)[1]
    still = _Sample(loop, clock, r, guess).ignored_levels(rest.slopes.C)
    eye = jnp.eye(rest.s.shape[0], dtype=rest.s.dtype)
    ds = solve_all(eye - rest.slopes.closed, eye) @ jnp.where(still, 0.0, pushed)
    moved: Any = jax.jvp(slopes, (rest.s, loop, r), (ds, *tangents))[1]
    no = np.zeros((), jax.dtypes.float0)
    return rest, _Rest(moved, ds, no, no)


def _direction(k: Any, n: int) -> Any:
    """(n,) numbers between 0.5 and 1.5 in size, of generic signs; on both sides in turn."""
    turns = (k // 2 + 1.0) * np.sqrt(np.arange(2.0, n + 2.0) + 0.7)
    spread = jnp.mod(turns, 1.0) + 0.5
    signs = jnp.where(jnp.mod(3.0 * turns, 1.0) < 0.5, 1.0, -1.0)
    return spread * signs * jnp.where(k % 2 == 0, 1.0, -1.0)


def _differs(probe: _Slopes, reference: _Slopes, step: Any) -> Any:
    """True where the change of a sample over `step` differs from its tangent."""
    slope = jnp.concatenate([reference.closed, reference.C])
    change = jnp.concatenate([probe.after - reference.after, probe.applied - reference.applied])
    return jnp.any(jnp.abs(change - slope @ step) > KINK * (jnp.abs(slope) @ jnp.abs(step)))


class Plateau(NamedTuple):
    """Margins at the steady state of one plateau; made by `stability_margins`."""

    setpoints: np.ndarray[Any, Any]  # (outputs,) [unit of length]
    x: np.ndarray[Any, Any]  # (n,) levels of the steady state [unit of length]
    u: np.ndarray[Any, Any]  # (m,) inputs of the steady state [unit of the pumps]
    why: str  # why there are no margins; "" where there are
    stable: bool  # True if the linearised loop is stable
    margins: am.Margins  # NaN where there are none, or the loop is not stable


@takes_case
def stability_margins(loop: ClosedLoop, clock: Clock) -> tuple[Plateau, ...]:
    """Return the stability margins of the linearised loop at every plateau of its reference.

    One sample of the loop (sensor without noise, observer, controller, pumps with lag and dead time
    but without limits, plant with its steady inflow) is linearised at the steady state of each
    plateau, with the loop opened at the plant input: exact for the sampled loop. With several
    loops gain, phase and delay margin are of one at a time, the others closed, and the peaks
    of the sensitivities are the largest singular values of (I + L)^-1 and L (I + L)^-1, with
    inputs counted in the ranges of their pumps. Pumps and valves that one loop moves together
    (split range, ratio) are one loop, and have its margins; one that stands still is none.

    Parameters
    ----------
    loop : ClosedLoop; or a Case, whose clock is then used
    clock : Clock; none after a Case
        Its sampling period counts; its duration only for the mean of an inflow by a table.

    Returns
    -------
    One Plateau for each set of setpoints that is held, in order of time; () where the reference
    has none.

    Raises
    ------
    InputError
        For a loop or clock that cannot be run, and for a loop in float32, whose poles near z = 1
        are too inexact.

    Examples
    --------
    >>> import jax
    >>> import jaxtank
    >>> from jaxtank import presets
    >>> jax.config.update("jax_enable_x64", True)
    >>> case = presets.find("cascaded/pi")
    >>> first = jaxtank.stability_margins(case.loop, case.clock)[0]
    >>> first.stable, round(float(first.margins.sensitivity_peak), 2)
    (True, 1.86)
    """
    check(loop, clock, jax.random.key(0))
    if loop.reference.held() is None:
        return ()
    r, linear, margins = _of_plateaus(loop, clock)
    rows: list[Plateau] = []
    for k in range(len(np.asarray(r))):
        row = [np.asarray(v)[k] for v in margins]
        stable, why = bool(row[0]), REASONS[int(linear.why[k])]
        values = [v if stable and not why else np.full(np.shape(v), np.nan) for v in row[1:]]
        setpoints, x, u = (np.asarray(v[k]) for v in (r, linear.x, linear.u))
        rows.append(Plateau(setpoints, x, u, why, stable and not why, am.Margins(stable, *values)))
    return tuple(rows)


def _of_plateaus(loop: ClosedLoop, clock: Clock) -> tuple[Any, Any, am.Margins]:
    """(setpoints (P, outputs), Linearised, Margins), each with the plateaus in front."""
    # What does not matter is left out first, so that loops that differ in it share a program.
    if zero_of(loop).dtype != jnp.float64:
        raise InputError(
            "stability margins need float64: call jax.config.update('jax_enable_x64', True) first,"
            " and give the loop's leaves as float64"
        )
    setpoints: Any = loop.reference.held(clock.duration)
    if setpoints is None:
        kind = type(loop.reference).__name__
        raise InputError(
            f"stability margins need a reference that holds setpoints: a {kind} has none"
            " (signals.Ramps and signals.Constant have)"
        )
    loop = at_mean_inflow(loop, clock)
    traced = any(isinstance(v, Tracer) for v in jax.tree.leaves((loop, setpoints)))
    xp: Any = jnp if traced else np
    r: Any = xp.stack([xp.stack([xp.asarray(v, float) for v in row]) for row in setpoints])
    bare = dataclasses.replace(
        loop,
        reference=Constant(level=r[0]),
        disturbance=None if steady_inflow(loop) is None else loop.disturbance,
        faults=None,
        safety_filter=None,
    )
    # of a small rig compiling takes 1,000 times as long as a run
    function = _compiled if traced or loop.plant.tanks >= vectors.FROM else _unoptimised
    margins_at = functools.partial(
        function, bare, dataclasses.replace(clock, duration=clock.dt), slopes=traced
    )
    if traced:
        # one after the other: a program for one of them is compiled in half the time
        return (r, *cast(tuple[Any, ...], jax.lax.map(margins_at, r)))
    rows = [margins_at(v) for v in r]  # by one program, however many there are
    stack = lambda *values: np.stack([np.asarray(v) for v in values])
    return (r, *cast(tuple[Any, ...], jax.tree.map(stack, *rows)))


def _at_plateau(loop: ClosedLoop, clock: Clock, r: Any, slopes: bool) -> tuple[Any, am.Margins]:
    """(Linearised, Margins) of one plateau with setpoints r; slopes: derivatives wanted."""
    linear = linearised(loop, clock, r)
    margins = am.margins(linear.open_loop, slopes)
    place = {j: k for k, inputs in enumerate(_loops_of(loop)) for j in inputs}
    of_input = np.array([place[j] for j in range(len(place))])
    spread = lambda v: v[of_input] if np.ndim(v) else v  # those of a loop are of all its inputs
    return linear._replace(open_loop=linear.open_loop[:3]), am.Margins(*map(spread, margins))


_compiled = compiled("clock", "slopes", keep=True)(_at_plateau)
_unoptimised = compiled("clock", "slopes", keep=True, optimised=False)(_at_plateau)


def worst(loop: ClosedLoop, clock: Clock) -> ms.Worst:
    """Return the worst margins of all plateaus, for the measures: differentiable, and vmaps."""
    _, linear, margins = _of_plateaus(loop, clock)
    xp: Any = np if isinstance(linear.why, np.ndarray) else jnp  # by numpy nothing is compiled
    good, unstable = linear.why == 0, (linear.why == 0) & ~margins.stable

    def least(values: Any) -> Any:
        used = good.reshape(-1, *(1,) * (values.ndim - 1))
        chosen = xp.min(xp.where(used, values, np.inf), axis=0)
        chosen = xp.where(xp.any(unstable), -np.inf, chosen)
        return xp.where(xp.any(good), chosen, np.nan)

    return ms.Worst(
        -least(-margins.sensitivity_peak),
        -least(-margins.complementary_peak),
        least(margins.gain_margin),
        least(margins.phase_margin),
        least(margins.delay_margin),
    )


def run_with(loop: ClosedLoop, clock: Clock, names: Sequence[str], arrays: bool = False) -> ms.Run:
    """Return `run_of` with the margins that the measures `names` read."""
    run = run_of(loop, clock, arrays)
    linear = any(ms.MEASURES[name].linear for name in names)
    return run._replace(margins=worst(loop, clock)) if linear else run

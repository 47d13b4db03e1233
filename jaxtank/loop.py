"""The closed loop: plant, sensor, observer, law and actuator, compiled to one function.

Row k of a run is the world at t_k before it moves: y_k is read, u_k is decided, and u_k is held over [t_k, t_k + dt).
`simulate` keeps a trajectory for people; `evaluate` keeps running measures for tuning and ensembles; `sensitivities` carries exact
derivatives of the measures along with the run. All are pure: jit, vmap, grad and jacfwd work on them with the loop as an argument.
"""

import functools
import math
import warnings
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxtank import measures as ms
from jaxtank.actuators import PumpBank
from jaxtank.controllers.base import Controller
from jaxtank.errors import InputError, NonFiniteError
from jaxtank.invariants import scan
from jaxtank.observers.base import Observer
from jaxtank.plants.base import Plant
from jaxtank.records import Clock, Sample, Tick, Trajectory, check_clock
from jaxtank.sensors import LevelSensor
from jaxtank.signals import Signal
from jaxtank.tree import check_leaves, component, leaf, parameters, with_values


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
    x0: np.ndarray = leaf("cm", "(n,) levels at t = 0", low=0.0)


class State(NamedTuple):
    """What one sample hands to the next."""

    k: Any  # index of the sample
    x: tuple  # levels [cm]
    observer: Any
    controller: Any
    actuator: Any


class Inputs(NamedTuple):
    """What is known of every sample before the loop starts: arrays (samples,)."""

    r: tuple
    dr: tuple
    ddr: tuple
    d: tuple | None
    xi: tuple | None
    window: tuple | None


def check(loop, clock, key=None):
    """Raise InputError for a loop or clock that cannot be run: values out of range, wrong shapes, a reference the law cannot serve.

    Only concrete leaves are looked at, so that it costs nothing inside a trace.
    """
    check_clock(clock)
    plant, actuator = loop.plant, loop.actuator
    if np.shape(loop.x0)[-1:] != (plant.tanks,):
        raise InputError(f"x0 has shape {np.shape(loop.x0)}: must be ({plant.tanks},), one level per tank")
    if loop.reference.channels != len(plant.outputs):
        raise InputError(f"the reference has {loop.reference.channels} channels for {len(plant.outputs)} outputs")
    if loop.disturbance is not None and loop.disturbance.channels != plant.tanks:
        raise InputError(
            f"the disturbance has {loop.disturbance.channels} channels for {plant.tanks} tanks: give one inflow per tank"
        )
    if actuator.saturation == "boxqp" and (plant.pumps != 2 or type(loop.controller).input_metric is Controller.input_metric):
        raise InputError("actuator.saturation = 'boxqp': needs two pumps and a law with a cost to allocate by (its input_metric)")
    samples = actuator.delay / clock.dt
    if actuator.delay > clock.duration or abs(samples - round(samples)) > 1e-6 * max(1.0, samples):
        raise InputError(
            f"actuator.delay = {actuator.delay:g} s: must be a whole number of samples of {clock.dt:g} s, at most {clock.duration:g} s"
        )
    check_leaves(loop)
    _check_order(actuator, "low", "high")
    if actuator.dead_zone is not None and actuator.dead_zone_kind == "hysteresis":
        _check_order(actuator, "stop", "dead_zone", equal=True)
    if actuator.dead_zone is not None and actuator.dead_zone_kind == "pulse":
        _check_order(actuator, "dead_zone", "pulse")
        _check_order(actuator, "pulse", "high", equal=True)
    if not _traced(loop.controller, loop.reference):
        loop.controller.check(loop.reference)
    if key is None and not _traced(loop.sensor.noise) and np.any(np.asarray(loop.sensor.noise) > 0):
        raise InputError(f"sensor.noise = {np.asarray(loop.sensor.noise)} cm: give a key (or --seed), or set it to 0")


def _traced(*trees):
    return any(isinstance(v, jax.core.Tracer) for v in jax.tree.leaves(trees))


def _check_order(actuator, lower, upper, equal=False):
    """Raise InputError unless each pump's `lower` is below its `upper` (or equal to it)."""
    a, b = getattr(actuator, lower), getattr(actuator, upper)
    if _traced(a, b):
        return
    for i, (low, high) in enumerate(zip(np.ravel(a), np.ravel(b))):
        if not (low <= high if equal else low < high):
            most = "at most" if equal else "below"
            raise InputError(f"actuator.{lower}[{i}] = {low:g} V: must be {most} actuator.{upper}[{i}] = {high:g} V")


def simulate(loop, clock, key=None, save_every=1):
    """Run the loop and keep every `save_every`-th sample.

    loop: ClosedLoop; clock: Clock; key: jax random key for the sensor noise, or None; returns a Trajectory.
    Raises InputError at the door and NonFiniteError if a level stops being finite (outside a trace).
    """
    check(loop, clock, key)
    if not isinstance(save_every, int) or save_every < 1:
        raise InputError(f"save_every = {save_every!r}: must be a whole number of at least 1 sample")
    trajectory, broken = _simulate(loop, clock, key, min(save_every, clock.samples))
    _report_broken(broken, loop, clock, key)
    return trajectory


def evaluate(loop, clock, measures, key=None):
    """Run the loop and keep only running measures.

    measures: names of `jaxtank.measures.MEASURES`; returns {name: scalar, or array with one entry per output, tank or pump}.
    Raises InputError at the door and NonFiniteError if a level stops being finite (outside a trace).
    """
    names = _names(measures)
    check(loop, clock, key)
    values, broken = _evaluate(loop, clock, names, key, False)
    _report_broken(broken, loop, clock, key)
    return values


def evaluate_and_flag(loop, clock, measures, key=None):
    """(`evaluate`'s values, True if the run stopped being finite); checks nothing, raises nothing: for batches and searches."""
    return _evaluate(loop, clock, _names(measures), key, False)


def evaluate_for_reverse(loop, clock, measures, key=None):
    """`evaluate` with the run cut into about sqrt(samples) pieces that are recomputed on the way back, for reverse mode.

    Same values, but never NonFiniteError; memory of a gradient grows with the root of the
    samples. Best above about ten parameters.
    """
    names = _names(measures)
    check(loop, clock, key)
    return _evaluate(loop, clock, names, key, True)[0]


def sensitivities(loop, clock, measures, values, key=None):
    """Measures, their exact derivatives, and the Gauss-Newton matrix of the tracking error, in one run.

    values: {dotted name: number or array} of P numbers in all, the point and the parameters to differentiate by (forward mode: worth
    it to about ten). Returns (measures {name: value}, derivatives {name: value.shape + (P,)}, (P, P) matrix
    2/N sum_k sum_i grad(e_i) grad(e_i)' [cm^2 per unit^2], True if the run stopped being finite), P in the order of `values`.
    key as in `evaluate`. Raises InputError at the door; a run that is not finite is told by the flag.
    """
    if not values:
        raise InputError("sensitivities needs at least one parameter: values is empty")
    check(with_values(loop, values), clock, key)
    return _sensitivities(loop, clock, _names(measures), tuple(values), tuple(values.values()), key)


def _names(measures):
    names = (measures,) if isinstance(measures, str) else tuple(measures)
    ms.check_names(names)
    return names


def inputs(loop, clock, names, key):
    """The samples of references, disturbances, noise and windows."""
    r, dr, ddr = loop.reference.sample(clock)
    d = None if loop.disturbance is None else loop.disturbance.sample(clock)[0]
    window = None
    if ms.wants_windows(names):
        if not hasattr(loop.reference, "windows"):
            raise InputError("overshoot, rise and settling need a reference that changes (signals.Ramps)")
        window = loop.reference.windows(clock)
    return Inputs(r=r, dr=dr, ddr=ddr, d=d, xi=loop.sensor.draw(key, clock.samples), window=window)


def initial(loop, clock):
    """The state before the first sample."""
    zero = _zero(loop)
    return State(
        k=jnp.int32(0),
        x=tuple(loop.x0[i] + zero for i in range(loop.plant.tanks)),
        observer=loop.observer.init(),
        controller=loop.controller.init(),
        actuator=jax.tree.map(
            lambda v: v + zero if jnp.issubdtype(jnp.result_type(v), jnp.floating) else v, loop.actuator.init(clock)
        ),
    )


def step(loop, clock, state, now):
    """One sample: (state after it, Sample of it). `now`: this sample's slice of Inputs."""
    t = state.k.astype(state.x[0].dtype) * clock.dt
    tick = Tick(t=t, r=now.r, dr=now.dr, ddr=now.ddr)
    y = loop.sensor.read(state.x, now.xi)
    estimate, observer = loop.observer.step(state.observer, tick, y)
    command, controller = loop.controller.step(state.controller, tick, estimate)
    metric = loop.controller.input_metric(estimate) if loop.actuator.saturation == "boxqp" else None
    u, actuator = loop.actuator.step(state.actuator, command, metric, clock.dt)
    x, spilled = _advance(loop.plant, clock, t, state.x, u, now.d)
    e = tuple(z - r for z, r in zip(loop.plant.output(state.x), now.r))
    sample = Sample(t=t, x=state.x, y=y, x_hat=estimate.x, r=now.r, e=e, command=command, u=u, spilled=spilled)
    return State(state.k + 1, x, observer, controller, actuator), sample


def _advance(plant, clock, t, x, u, d):
    """Levels after dt with u and d held, and the volume lost over each rim on the way [cm^3]."""
    h = clock.dt / clock.substeps
    spilled = None
    for j in range(clock.substeps):
        x, lost = plant.spill(_integrate(plant, clock.integrator, t + j * h, x, u, d, h))
        spilled = lost if spilled is None else tuple(a + b for a, b in zip(spilled, lost))
    return x, spilled


def _integrate(plant, integrator, t, x, u, d, h):
    def along(k, by):
        return tuple(a + by * b for a, b in zip(x, k))

    k1 = plant.derivative(t, x, u, d)
    k2 = plant.derivative(t + 0.5 * h, along(k1, 0.5 * h), u, d)
    if integrator == "midpoint":
        return along(k2, h)
    k3 = plant.derivative(t + 0.5 * h, along(k2, 0.5 * h), u, d)
    k4 = plant.derivative(t + h, along(k3, h), u, d)
    # k4 is ready last, so it is added last
    return tuple((a + (h / 6.0) * (p + 2.0 * (q + r))) + (h / 6.0) * s for a, p, q, r, s in zip(x, k1, k2, k3, k4))


def _run(loop, clock):
    return ms.Run(
        tanks=loop.plant.tanks,
        outputs=len(loop.plant.outputs),
        pumps=loop.plant.pumps,
        samples=clock.samples,
        dt=clock.dt,
        low=tuple(loop.actuator.low[i] for i in range(loop.plant.pumps)),
        high=tuple(loop.actuator.high[i] for i in range(loop.plant.pumps)),
        rim=tuple(loop.plant.rim[i] for i in range(loop.plant.tanks)),
        zero=_zero(loop),
    )


def _zero(loop):
    """0.0 of the type in which the run is done: what x0 becomes inside jax. float32 is named, for it would be wrong here."""
    dtype = jnp.result_type(loop.x0, jnp.float32 if jnp.result_type(loop.x0) == jnp.float32 else float)
    if dtype == jnp.float32:
        _warn_float32()
    return jnp.zeros((), dtype)


@functools.cache
def _warn_float32():
    warnings.warn(
        "this run is in float32: at dt = 0.01 s a level is then wrong by about 5e-3 cm, because a step changes it by less than float32 "
        "resolves. Call jax.config.update('jax_enable_x64', True) first for float64.",
        stacklevel=6,
    )


@functools.partial(jax.jit, static_argnames=("clock", "names", "checkpoint"))
def _evaluate(loop, clock, names, key, checkpoint):
    run = _run(loop, clock)

    def body(carry, now):
        state, acc = carry
        state, sample = step(loop, clock, state, now)
        return (state, ms.update(run, acc, sample, now.window)), None

    carry = (initial(loop, clock), ms.start(run, names))
    state, acc = (_checkpointed_scan if checkpoint else _plain_scan)(body, carry, inputs(loop, clock, names, key), clock.samples)
    return ms.read(run, acc, names), _broken(state)


def _plain_scan(body, carry, xs, length):
    return scan(body, carry, xs, length=length)[0]


def _checkpointed_scan(body, carry, xs, length):
    """A scan over about sqrt(length) pieces, each recomputed in the reverse pass."""
    inner = math.isqrt(length)
    outer = length // inner
    head = jax.tree.map(lambda a: a[: outer * inner].reshape(outer, inner), xs)
    tail = jax.tree.map(lambda a: a[outer * inner :], xs)
    piece = jax.checkpoint(lambda c, now: (scan(body, c, now, length=inner)[0], None))
    carry = scan(piece, carry, head, length=outer)[0]
    return scan(body, carry, tail, length=length - outer * inner)[0]


@functools.partial(jax.jit, static_argnames=("clock", "save_every"))
def _simulate(loop, clock, key, save_every):
    rows = (clock.samples - 1) // save_every + 1
    xs = inputs(loop, clock, (), key)
    spare = rows * save_every - clock.samples  # steps after the last row: run, but not kept
    xs = jax.tree.map(lambda a: jnp.pad(a, (0, max(spare, 0)), mode="edge")[: rows * save_every].reshape(rows, save_every), xs)

    def one(carry, now):
        state, spilled = carry
        state, sample = step(loop, clock, state, now)
        return (state, tuple(a + b for a, b in zip(spilled, sample.spilled))), sample

    def row(carry, now):
        spilled = carry[1]
        carry, sample = one(carry, jax.tree.map(lambda a: a[0], now))
        if save_every > 1:
            rest = jax.tree.map(lambda a: a[1:], now)
            carry = scan(lambda c, n: (one(c, n)[0], None), carry, rest, length=save_every - 1)[0]
        return carry, sample._replace(spilled=spilled)

    zero = _zero(loop)
    (state, _), saved = scan(row, (initial(loop, clock), (zero,) * loop.plant.tanks), xs, length=rows)
    columns = {name: jnp.stack(value, axis=-1) if isinstance(value, tuple) else value for name, value in saved._asdict().items()}
    return Trajectory(**columns), _broken(state)


def _broken(state):
    """True if the run left the numbers: a level that is not finite stays so, so the last state tells and the loop need not look."""
    return ~jnp.isfinite(sum(state.x))


@functools.partial(jax.jit, static_argnames=("clock", "names", "order"))  # a dict would come back from jit with its keys sorted
def _sensitivities(loop, clock, names, order, values, key):
    flat, unflatten = ravel_pytree(values)

    def at(theta):
        return with_values(loop, dict(zip(order, unflatten(theta))))

    basis = jnp.eye(flat.size, dtype=flat.dtype)

    def pushed(f, point, *tangents):
        """(f(point), tangents of f with the P directions as the last axis)."""
        return jax.vmap(lambda *t: jax.jvp(f, point, t, has_aux=True), in_axes=-1, out_axes=(None, -1, None))(*tangents)

    carried, structure = jax.tree.flatten(jax.eval_shape(lambda: (initial(loop, clock), ms.start(_run(loop, clock), names))))
    moves = tuple(jnp.issubdtype(v.dtype, jnp.floating) for v in carried)  # only floats have derivatives

    def split(tree):
        leaves = jax.tree.leaves(tree)
        return tuple(v for v, m in zip(leaves, moves) if m), tuple(v for v, m in zip(leaves, moves) if not m)

    def join(floats, rest):
        floats, rest = iter(floats), iter(rest)
        return jax.tree.unflatten(structure, [next(floats) if m else next(rest) for m in moves])

    def begin(theta):
        here = at(theta)
        floats, rest = split((initial(here, clock), ms.start(_run(here, clock), names)))
        return (floats, inputs(here, clock, names, key)), rest

    (floats, xs), (dfloats, dxs), rest = pushed(begin, (flat,), basis)
    if not any(name.startswith(("reference.", "disturbance.")) for name in order):
        dxs = None  # the inputs do not depend on the parameters: their tangents need not be carried

    def body(carry, scanned):
        floats, dfloats, rest, gauss_newton = carry
        now, dnow = scanned

        def advance(floats, theta, now=now):
            here = at(theta)
            state, acc = join(floats, rest)
            state, sample = step(here, clock, state, now)
            floats, others = split((state, ms.update(_run(here, clock), acc, sample, now.window)))
            return (floats, sample.e), others

        if dnow is None:
            (floats, _), (dfloats, de), rest = pushed(advance, (floats, flat), dfloats, basis)
        else:
            (floats, _), (dfloats, de), rest = pushed(advance, (floats, flat, now), dfloats, basis, dnow)
        for slope in de:
            gauss_newton = gauss_newton + slope[:, None] * slope[None, :]
        return (floats, dfloats, rest, gauss_newton), None

    carry = (floats, dfloats, rest, jnp.zeros((flat.size, flat.size), flat.dtype))
    (floats, dfloats, rest, gauss_newton), _ = scan(body, carry, (xs, dxs), length=clock.samples)

    def finish(floats, theta):
        _, acc = join(floats, rest)
        return ms.read(_run(at(theta), clock), acc, names), None

    results, slopes, _ = pushed(finish, (floats, flat), dfloats, basis)
    return results, slopes, gauss_newton * (2.0 / clock.samples), _broken(join(floats, rest)[0])


def _report_broken(broken, loop, clock, key):
    """Raise NonFiniteError for a run that left the numbers, with time, tank and what was set. Nothing inside a trace."""
    if isinstance(broken, jax.core.Tracer) or np.ndim(broken) or not broken:
        return
    run = _simulate(loop, clock, key, 1)[0]
    bad = ~np.isfinite(np.asarray(run.x))
    if not bad.any():  # only the step after the last sample
        return
    first = int(np.argmax(bad.any(axis=1)))
    tanks = ", ".join(str(i + 1) for i in np.flatnonzero(bad[first]))
    shown = {n: v for n, v in parameters(loop).items() if n.startswith("controller.") and not n.startswith("controller.model.")}
    text = ", ".join(f"{n} = {np.asarray(v)}" for n, v in shown.items())
    raise NonFiniteError(f"the level of tank {tanks} stopped being finite at t = {first * clock.dt:g} s with {text}")


__all__ = ["Clock", "ClosedLoop", "check", "evaluate", "evaluate_for_reverse", "sensitivities", "simulate"]

"""Simulated readings of a rig for the inputs of experiment data, and their sensitivities."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import lfilter

from jaxtank.core import stamps
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.core.numerics import clip
from jaxtank.core.tree import component, leaf, split_index, with_values
from jaxtank.instruments.base import Actuator
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.plants.base import Plant
from jaxtank.plants.runge_kutta import advance
from jaxtank.rig.signals import parts_of
from jaxtank.signals.base import Constant, Sum
from jaxtank.signals.inflows import InflowPulses, InflowTable
from jaxtank.xla.hoist import scan
from jaxtank.xla.jit import compiled


@component
class Rig:
    """The part of a closed loop that experiment data describe: all but controller and observer."""

    plant: Plant
    sensor: LevelSensor
    actuator: Actuator
    disturbance: Constant | None = None
    x0: np.ndarray = leaf("cm", "levels at the first sample", low=0.0, shape=("tank",))

    @property
    def units(self):
        """(length, pump input) of the rig."""
        return self.plant.units


def check_sensor(loop):
    """Raise InputError for a sensor whose readings experiment data are not compared with."""
    if not isinstance(loop.sensor, LevelSensor):
        raise InputError(
            f"the sensor of this loop is a {type(loop.sensor).__name__}: experiment data are"
            " compared with the readings of a LevelSensor"
        )
    times = loop.sensor.filter
    if times is not None and np.any(times):
        raise InputError(
            f"sensor.filter = {np.max(times):g} s: experiment data are compared with readings"
            " without a filter; if levels change much more slowly, set it to 0 (--set"
            " sensor.filter=0), and write the filter into the resulting rig file"
        )


def rig_of(loop):
    # a varying inflow is of the data (`flows_of`), rate and delay of the pumps are in `padded`
    _, steady, _ = parts_of(loop.disturbance)
    disturbance = steady if isinstance(steady, Constant) else None
    check_sensor(loop)
    actuator = loop.actuator
    if actuator.rate is not None or actuator.delay or actuator.delays:
        actuator = dataclasses.replace(cast(Any, actuator), rate=None, delay=0.0, delays=())
    return Rig(
        plant=loop.plant, sensor=loop.sensor, actuator=actuator, disturbance=disturbance, x0=loop.x0
    )


def delays_of(actuator):
    """Return (pumps,) the dead time of each pump [s], or one of all."""
    return float(actuator.delay) + np.asarray(actuator.delays or 0.0)


class PaddedData(NamedTuple):
    """Experiment data of several runs as arrays, padded to the longest."""

    # padding: steps of length zero, no readings; third axis of dt, u: pieces where inputs change

    dt: np.ndarray  # (logs, samples) time to the next sample [s], 0 at the last one and after
    u: np.ndarray  # (logs, samples, pumps)
    y: np.ndarray  # (logs, samples, channels), NaN where there is no reading
    channels: tuple  # ((tank, in volts), ...)
    flows: Any = None  # (logs, samples, tanks) means over each sample of the inflow that varies

    def inputs_and_flows(self, u: Any = None) -> np.ndarray:
        """Return inputs, those of the data by default, followed by the inflow of each tank."""
        u = self.u if u is None else u
        if self.flows is None:
            return u
        flows = self.flows if u.ndim == 3 else self.flows[:, :, None]
        return np.concatenate([u, np.broadcast_to(flows, (*u.shape[:-1], flows.shape[-1]))], -1)

    @property
    def steps(self):
        """(logs, samples) time to the next sample [s]."""
        return self.dt if self.dt.ndim == 2 else self.dt.sum(axis=-1)


def padded(logs, delays: Any = 0.0, samples=0, courses=None):
    """Return the PaddedData of Logs, of `samples` samples or more; courses: `courses_of` each."""
    # delays act between samples too; truncated data of the same length share a compiled program
    channels = tuple(sorted({pair for log in logs for pair in zip(log.tanks, log.in_volts)}))
    n = max(samples, *(log.samples for log in logs))
    delays = np.broadcast_to(delays, logs[0].u.shape[1])
    courses = courses or [[(log.t, u) for u in log.u.T] for log in logs]
    parts = [_pieces(log, of_log, delays) for log, of_log in zip(logs, courses)]
    most = max(lengths.shape[1] for lengths, _ in parts)
    dt, u = np.zeros((len(logs), n, most)), np.zeros((len(logs), n, most, logs[0].u.shape[1]))
    y = np.full((len(logs), n, len(channels)), np.nan)
    for e, (log, (lengths, inputs)) in enumerate(zip(logs, parts)):
        dt[e, : log.samples, : lengths.shape[1]] = lengths
        u[e, : log.samples, : lengths.shape[1]] = inputs
        columns = [channels.index(pair) for pair in zip(log.tanks, log.in_volts)]
        y[e, : log.samples, columns] = log.y.T
    if most == 1:
        dt, u = dt[:, :, 0], u[:, :, 0]
    return PaddedData(dt, u, y, channels)


def varies(disturbance):
    """Whether an inflow has pulses or a table."""
    pulses, _, table = parts_of(disturbance)
    return pulses is not None or table is not None


MOST_CELLS = 100_000  # cells of the grid on which the inflow of a log of irregular rows is added up


def time_between(begins, log):
    """Return the first sample's time [s] after t = 0 of a rig; None without dates of both."""
    first = stamps.moment(begins)
    if first is None or log.begins is None or first.kind != log.begins.kind:
        return None
    return log.begins.value + float(log.t[0]) - first.value


def disturbance_at(case, log):
    """Return the disturbance of a case with t = 0 at the first sample of a Log, by their dates."""
    return _moved(case.loop.disturbance, time_between(case.begins, log) or 0.0)


def _moved(disturbance, time):
    """A disturbance with the t = 0 of its pulses and tables moved to a later time [s]."""
    if isinstance(disturbance, Sum):
        first, second = (_moved(part, time) for part in (disturbance.first, disturbance.second))
        return Sum(first=first, second=second)
    if isinstance(disturbance, InflowPulses):
        events = ((start - time, duration, tank) for start, duration, tank in disturbance.events)
        return dataclasses.replace(disturbance, events=tuple(events))
    if isinstance(disturbance, InflowTable):
        rows = ((i, how, tuple(np.subtract(t, time).tolist())) for i, how, t in disturbance.rows)
        return dataclasses.replace(disturbance, rows=tuple(rows))
    return disturbance


def flows_of(logs, samples, case):
    """Return (logs, samples, tanks) means over each sample of the inflow that varies, or None."""
    if not varies(case.loop.disturbance):
        return None
    tanks, dt = case.loop.plant.tanks, case.clock.dt
    flows = np.zeros((len(logs), max(samples, *(log.samples for log in logs)), tanks))
    for log, of_log in zip(logs, flows):
        t, steps = log.t - log.t[0], np.diff(log.t)
        even = np.ptp(steps) < 1e-6 * steps.mean()
        fine = float(steps.mean() if even else max(min(dt, steps.mean()), t[-1] / MOST_CELLS))
        clock = Clock(dt=fine, duration=float(fine * np.ceil(t[-1] / fine + 1.0)))
        pulses, _, table = parts_of(disturbance_at(case, log))
        parts = [part for part in (pulses, table) if part is not None]
        courses = [np.array([np.asarray(v) for v in part.sample(clock)[0]]) for part in parts]
        means = np.sum(courses, axis=0).T
        volumes = np.cumsum(np.insert(means, 0, 0.0, axis=0), axis=0) * fine
        edges = fine * np.arange(len(volumes))
        at = np.stack([np.interp(t, edges, column) for column in volumes.T], axis=1)
        of_log[: log.samples - 1] = np.diff(at, axis=0) / steps[:, None]
    return flows


def courses_of(logs, actuator, dt):
    """Return (times [s], inputs) of each pump of each Log; None where they are its rows."""
    if actuator.rate is None:
        if all(log.early is None for log in logs):
            return None
        early = [0.0 * log.u if log.early is None else log.early for log in logs]
        return [[(log.t - e, u) for e, u in zip(es.T, log.u.T)] for log, es in zip(logs, early)]
    rates = np.broadcast_to(np.asarray(actuator.rate, dtype=float), logs[0].u.shape[1])
    inside = [np.clip(log.u, np.asarray(actuator.low), np.asarray(actuator.high)) for log in logs]
    return [
        [_followed(log, column, rate, dt) for column, rate in zip(u.T, rates)]
        for log, u in zip(logs, inside)
    ]


MOST_PIECES = 4  # pieces of a sample at most for the ramp of a slow pump: each is compiled


def _followed(log, u, rate, dt):
    """Return (times [s], inputs) of a pump that follows u (samples,) at a rate per second."""
    steps = np.diff(log.t)
    if np.all(np.abs(np.diff(u)) <= rate * steps * (1 + 1e-6)):
        return log.t, u
    linear = log.hold == "first-order"  # the line to a sample ends at it
    period = steps if linear else np.full(len(steps), min(dt, float(steps.min())))
    times, followed = [log.t[:1]], [u[:1]]
    ends = log.t[1:] if linear else np.append(log.t[2:], np.inf)
    for start, end, target, tick in zip(log.t[1:], ends, u[1:], period):
        now, most = followed[-1][-1], rate * tick  # change in one period
        needed, fit = (np.ceil(v - 1e-9) for v in (abs(target - now) / most, (end - start) / tick))
        k = np.arange(max(1, int(min(needed, fit))))
        times.append(start + k * tick)
        followed.append(now + np.clip(target - now, -most * (k + 1), most * (k + 1)))
    t, followed = np.concatenate(times), np.concatenate(followed)
    coarse = linear or period[0] * MOST_PIECES >= steps.min() * (1 - 1e-9)
    return (t, followed) if coarse else _averaged(log.t, t, followed)


def _averaged(samples, t, u):
    """Return (times, means of the inputs u from times t on) of MOST_PIECES of each sample."""
    share = np.arange(MOST_PIECES) / MOST_PIECES
    edges = (samples[:-1, None] + np.diff(samples)[:, None] * share).ravel()
    edges = np.append(edges, samples[-1])
    t = np.append(t, max(t[-1], samples[-1]) + 1.0)  # the last input lasts
    total = np.append(0.0, np.cumsum(np.diff(t) * u))
    return edges[:-1], np.diff(np.interp(edges, t, total)) / np.diff(edges)


def _pieces(log, courses, delays):
    """Return lengths [s] and inputs of the pieces of each sample, cut where an input changes."""
    near = 1e-9 * max(1.0, float(np.max(delays)), float(np.abs(log.t).max()))
    linear = log.hold == "first-order"
    cuts = [_cuts(t, u, linear, delay) for (t, u), delay in zip(courses, delays)]
    cuts = np.unique(np.concatenate(cuts))
    after = np.minimum(np.searchsorted(log.t, cuts - near), log.samples - 1)
    inside = (np.abs(cuts - log.t[after]) > near) & (cuts > log.t[0]) & (cuts < log.t[-1])
    edges = np.sort(np.concatenate([log.t, cuts[inside]]))
    step = np.searchsorted(log.t, edges, side="right") - 1  # the sample before
    piece = np.arange(len(edges)) - np.searchsorted(edges, log.t)[step]
    lengths = np.append(np.diff(edges), 0.0)
    inputs = np.empty((len(edges), len(delays)))
    for j, (delay, (t, u)) in enumerate(zip(delays, courses)):
        command = edges + lengths / 2 - delay
        if linear:
            inputs[:, j] = np.interp(command, t, u)
        else:
            inputs[:, j] = u[np.maximum(np.searchsorted(t, command, side="right") - 1, 0)]
    shape = (log.samples, int(piece.max()) + 1)
    dt, u = np.zeros(shape), np.zeros((*shape, log.u.shape[1]))
    dt[step, piece], u[step, piece] = lengths, inputs
    return dt, u


def _cuts(t, u, linear, delay):
    """Return the times at which an input of values u at times t changes after a delay [s]."""
    changed = changes_of(u[:, None])
    cuts = t[changed] + delay
    if linear:  # two pieces for each slope: one would delay its volume
        start = t[changed - 1] + delay
        cuts = np.unique(np.concatenate([start, 0.5 * (start + cuts), cuts]))
    return cuts


def changes_of(u):
    """Return the samples at which an input of u (samples, pumps) differs from the one before."""
    return 1 + np.flatnonzero(np.any(np.diff(u, axis=0) != 0.0, axis=1))


def player(rig, dt, u, substeps):
    """Return (levels, pumps, function of one sample, pieces of all samples)."""
    if dt.ndim == 1:
        dt, u = dt[:, None], u[:, None]
    x, d = tuple(rig.x0[i] + 0.0 * dt[0, 0] for i in range(rig.plant.tanks)), None
    if rig.disturbance is not None:
        d = tuple(rig.disturbance.level[i] for i in range(rig.plant.tanks))
    # before the log the pumps ran at its first inputs
    first = tuple(
        clip(u[0, 0, j], rig.actuator.low[j], rig.actuator.high[j]) for j in range(rig.plant.pumps)
    )
    pumps = dataclasses.replace(rig.actuator, initial=jnp.stack(first))
    state = jax.tree.map(
        lambda v: v + 0.0 * x[0] if jnp.issubdtype(jnp.result_type(v), jnp.floating) else v,
        pumps.init(Clock(dt=1.0, duration=1.0)),
    )

    def advanced(x, state, t, step, inputs, entering):
        inputs, flows = inputs[:pumped], inputs[pumped:]
        # experiment data hold the command, which may lie beyond the pump's limits
        low, high = rig.actuator.low, rig.actuator.high
        inputs = tuple(clip(v, low[j], high[j]) for j, v in enumerate(inputs))
        # no division by zero in the padding
        driven, state = rig.actuator.step(state, inputs, jnp.where(step > 0, step, 1.0))
        driven, enters = rig.actuator.driving(driven), d
        for more in (entering, flows):
            if more:
                enters = more if enters is None else tuple(a + b for a, b in zip(enters, more))
        t = 0.0 if t is None else t
        run = advance(rig.plant, "rk4", t, x, driven, enters, step, substeps, rolled=True)
        return run.x, state

    def stepped(x, state, pieces, entering=None):
        t, step, inputs = pieces[0]
        x, state = advanced(x, state, t, step, inputs, entering)
        for t, step, inputs in pieces[1:]:
            # a piece of length zero is none: a pump with memory would see a sample
            x, state = jax.tree.map(
                lambda new, old, step=step: jnp.where(step > 0, new, old),
                advanced(x, state, t, step, inputs, entering),
                (x, state),
            )
        return x, state

    m, pumped = range(u.shape[-1]), rig.plant.pumps  # inputs, followed by inflows
    each, starts = range(dt.shape[1]), [None] * dt.shape[1]
    if rig.plant.depends_on_time:  # [s] since the first row
        starts = list((jnp.cumsum(dt.ravel()) - dt.ravel()).reshape(dt.shape).T)
    pieces = tuple((starts[i], dt[:, i], tuple(u[:, i, j] for j in m)) for i in each)
    return x, state, stepped, pieces


def readings(rig, dt, u, channels, substeps, flows=None):
    """Return (samples, channels) readings without noise; levels where there are no channels."""
    x, state, stepped, pieces = player(rig, dt, u, substeps)
    entering = None if flows is None else tuple(flows[:, i] for i in range(rig.plant.tanks))

    def sample(carry, now):
        y = carry[0]
        if channels is not None:
            y = tuple(rig.sensor.reading_of(i, carry[0][i], volts) for i, volts in channels)
        return stepped(carry[0], carry[1], *now), y

    return jnp.stack(scan(sample, (x, state), (pieces, entering), length=dt.shape[0])[1], axis=-1)


@compiled("coordinates", "tanks", "channels", "substeps", keep=True)
def sensitivities(rig, dt, u, p, first, *, coordinates, tanks, channels, substeps):
    """Return readings (logs, samples, channels) and their slopes by p, then levels `first`."""
    shared = coordinates.size

    def of_log(dt, u, p, first):
        def predicted(q):
            r = with_values(rig, coordinates.values(q[:shared]))
            r = with_values(r, {f"x0[{tank}]": q[shared + i] for i, tank in enumerate(tanks)})
            return readings(r, dt, u, channels, substeps)

        q = jnp.concatenate([p, first])
        slope = lambda tangent: jax.jvp(predicted, (q,), (tangent,))
        return jax.vmap(slope, out_axes=(None, -1))(jnp.eye(q.size, dtype=q.dtype))

    return jax.vmap(of_log, in_axes=(0, 0, 0 if p.ndim == 2 else None, 0))(dt, u, p, first)


@compiled("coordinates", "substeps", keep=True)
def variants(rig, dt, u, flows, p, first, *, coordinates, substeps):
    """Return (variants, logs, samples, tanks) levels of a Rig at p, for inputs, flows, starts."""

    def of_log(dt, u, flows, p, first):
        r = dataclasses.replace(with_values(rig, coordinates.values(p)), x0=first)
        return readings(r, dt, u, None, substeps, flows)

    of_variants = jax.vmap(jax.vmap(of_log, (0, 0, 0, None, 0)), (None, 0, 0, 0, 0))
    return of_variants(dt, u, flows, p, first)


def _play(rig, dt, u, first, *, channels, substeps):
    """Return (logs, samples, channels) readings of a Rig from levels `first` (logs, tanks)."""
    return jax.vmap(
        lambda dt, u, x0: readings(dataclasses.replace(rig, x0=x0), dt, u, channels, substeps)
    )(dt, u, first)


play = compiled("channels", "substeps", keep=True)(_play)
_play_any = compiled("channels", keep=True)(_play)  # one program for any number of substeps

MOST_SUBSTEPS = 64


def substeps_for(rig, data, first, error):
    """Return how many Runge-Kutta steps each sample needs, and the error that is left."""
    run = (rig, data.dt, data.inputs_and_flows(), np.asarray(first))
    simulate = lambda k: np.asarray(_play_any(*run, channels=data.channels, substeps=k))
    count, coarse = 1, simulate(1)
    while True:
        fine = simulate(2 * count)
        with np.errstate(invalid="ignore", over="ignore"):
            moved = np.max(np.abs(fine - coarse), axis=(0, 1))
        if np.all(moved <= error):
            return count, moved
        count, coarse = 2 * count, fine
        if count == MOST_SUBSTEPS:
            return count, moved


class Inputs(NamedTuple):
    """Dead zone, curve, lag and delay that are applied to an input outside the compiled program."""

    delay: float = 0.0  # [s]
    lag: float = 0.0  # time constant [s]
    dead: float = 0.0  # input below which nothing flows
    exponent: float = 1.0  # of the flow in the input, at the same largest flow
    bend: float = 0.0  # of the flow from the power: 1 + bend (1 - x) + twist (1 - x)^2,
    twist: float = 0.0  # x the input as a share of the largest
    threshold: float = 0.0  # input at or below which nothing flows, and above it all

    def curve(self, x: Any) -> Any:
        """Return the flow at inputs x, both as shares of the largest."""
        shape = 1.0 + (1.0 - x) * (self.bend + (1.0 - x) * self.twist)
        return np.maximum(x, 1e-12) ** self.exponent * shape


def with_plant(loop: Any, plant: Any) -> Any:
    """Return a loop with another plant, whose new parts models like the old one have too."""
    old, changed = loop.plant, {}
    new = {f.name: getattr(plant, f.name) for f in dataclasses.fields(plant)}
    new = {name: value for name, value in new.items() if value is not getattr(old, name)}
    for holder in ("controller", "observer"):
        part: Any = getattr(loop, holder)
        model: Any = getattr(part, "model", None)
        if type(model) is type(old) and jax.tree.structure(model) == jax.tree.structure(old):
            changed[holder] = dataclasses.replace(part, model=dataclasses.replace(model, **new))
    return dataclasses.replace(loop, plant=plant, **changed)


STATIC = ("actuator.delays", "plant.curves")  # names of such numbers that no leaf of a rig holds
CURVE = ("exponent", "bend", "twist")  # `plant.curves[j]`, `[j,1]`, `[j,2]`
POINTS = 12  # points of the curve that stands for an exponent in a rig file


def with_inputs(loop: Any, values: Mapping[str, float], top: np.ndarray) -> Any:
    """Return a loop with dead times and curves {name: value}; top (pumps,): the largest inputs."""
    bank, plant = loop.actuator, loop.plant
    delays = float(bank.delay) + np.zeros(bank.pumps) + np.asarray(bank.delays or 0.0)
    curves = list(plant.curves) if values and getattr(plant, "curves", ()) else [None] * bank.pumps
    shapes: dict[int, Inputs] = {}
    for name, value in values.items():
        base, (j, *more) = split_index(name)
        if base == "actuator.delays":
            delays[j] = max(value, 0.0)
        else:
            shapes[j] = shapes.get(j, Inputs())._replace(**{CURVE[more[0] if more else 0]: value})
    for j, shape in shapes.items():
        u = top[j] * np.linspace(0.0, 1.0, POINTS) ** 2
        flow = np.maximum.accumulate(np.where(u > 0.0, top[j] * shape.curve(u / top[j]), 0.0))
        # of two that are level, the first
        rises = np.flatnonzero(np.diff(flow, prepend=-1.0) > 0.0)
        points = ((float(f"{v:.7g}") for v in column[rises]) for column in (u, flow))
        curves[j] = tuple(zip(*points))
    least = float(delays.min())
    more = tuple((delays - least).tolist())
    bank = dataclasses.replace(bank, delay=least, delays=more if any(more) else ())
    if any(curves):
        plant = dataclasses.replace(plant, curves=tuple(curves[: len(plant.feeds)]))
    return dataclasses.replace(with_plant(loop, plant), actuator=bank)


def transformed(dt: np.ndarray, u: np.ndarray, by: Inputs, top: float) -> np.ndarray:
    """Return means over pieces (pieces,) of an input behind dead zone, curve, lag and delay."""
    if by.threshold > 0.0:
        u = np.where(u > by.threshold, u, 0.0)
    if by.dead > 0.0:
        u = np.maximum(u - by.dead, 0.0)
    if (by.exponent, by.bend, by.twist) != (1.0, 0.0, 0.0) and top > 0.0:
        u = np.where(u > 0.0, top * by.curve(u / top), u)
    if by.lag > 0.0:
        u = _lagged(dt, u, by.lag)
    if by.delay != 0.0:
        edges = np.concatenate([[0.0], np.cumsum(dt)])
        volume, at = np.concatenate([[0.0], np.cumsum(u * dt)]), edges - by.delay
        outside = np.minimum(at, 0.0) * u[0] + np.maximum(at - edges[-1], 0.0) * u[-1]
        through = np.interp(at, edges, volume) + outside
        u = np.where(dt > 0.0, np.diff(through) / np.where(dt > 0.0, dt, 1.0), u)
    return u


def _lagged(dt, u, lag):
    """Return the means over the pieces of an input behind a first-order lag [s], solved exactly."""
    keep, regular = np.exp(-dt / lag), dt[dt > 0.0]
    if np.ptp(regular) < 1e-9 * regular[0]:
        end: Any = lfilter([1 - keep[0]], [1.0, -keep[0]], u, zi=[keep[0] * u[0]])[0]
    else:
        end, v = np.empty_like(u), u[0]
        for k, (share, target) in enumerate(zip(keep, u)):
            end[k] = v = target + share * (v - target)
    start = np.concatenate([u[:1], end[:-1]])
    mean = lag / np.where(dt > 0.0, dt, 1.0) * (1.0 - keep) * (start - u)
    return np.where(dt > 0.0, u + mean, u)


def played(data: Any, inputs: tuple, values: Any) -> np.ndarray:
    """Return inputs of PaddedData behind `values` of (field, pump, present value), then inflows."""
    if not inputs:
        return data.inputs_and_flows()
    logs, u = data.u.shape[0], np.array(data.u)
    dt, flat = data.dt.reshape(logs, -1), u.reshape(logs, -1, u.shape[-1])
    for j in dict.fromkeys(pump for _, pump, _ in inputs):
        of_pump = [(field, v, null) for (field, pump, null), v in zip(inputs, values) if pump == j]
        by = Inputs(**{field: v - null * (field == "delay") for field, v, null in of_pump})
        top = float(flat[:, :, j].max())
        for e in range(logs):
            flat[e, :, j] = transformed(dt[e], flat[e, :, j], by, top)
    return data.inputs_and_flows(u)

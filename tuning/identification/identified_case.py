"""The case before an identification, where only a plant is given, and the one after it."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import block_diag

from jaxtank import rig as rigs
from jaxtank.analysis.linear_model import linearise
from jaxtank.case import Case, Free
from jaxtank.controllers import OpenLoop
from jaxtank.core.clock import CLOCK, Clock
from jaxtank.core.errors import InputError
from jaxtank.core.labels import label_of, units_of_inputs
from jaxtank.core.tree import number, split_index, with_values
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.loop.steady import at_mean_inflow, steady_inflow
from jaxtank.observers import Direct
from jaxtank.rig.components import controller_of
from jaxtank.signals.base import Constant
from jaxtank.signals.setpoints import Ramps, ramps
from tuning.identification.residuals import at_samples
from tuning.identification.simulation import STATIC, delays_of, with_inputs

LACKS = ", lacks "  # between the name of a rig and causes that it does not have


def bare(plant):
    """Return a Case around a plant: ideal pumps and sensors, empty tanks, no controller."""
    n, m = plant.tanks, plant.pumps
    zero = number(np.zeros(m))
    nothing: Any = dict.fromkeys(("low", "stop", "initial"), zero)
    top = number(np.max(plant.rim))
    loop = ClosedLoop(
        plant=plant,
        sensor=LevelSensor(gain=number(np.ones(n)), noise=number(np.zeros(n)), full_scale=top),
        observer=Direct(),
        controller=OpenLoop(signal=Constant(level=zero)),
        actuator=PumpBank(high=number(np.full(m, np.inf)), pulse=number(np.ones(m)), **nothing),
        reference=Constant(level=number(np.zeros(len(plant.outputs)))),
        x0=number(np.zeros(n)),
    )
    empty: Any = {name: {} for name in ("limits", "free", "objective")}
    title = "a plant without a controller"
    return Case(name="plant", title=title, loop=loop, clock=Clock(), **empty)


def proposed(result):
    """Return (case, reason): `identified_plant` under a controller of the kind `result.law`."""
    case = identified_plant(result)
    if case.safety is not None:  # its filter is designed around its plant
        case = case.with_safety_filter(**case.safety)
    if result.law is None:
        return case, None
    inputs = np.concatenate([log.u for log in result.estimation.logs]).mean(axis=0)
    try:
        return with_pi(case, inputs), None
    except InputError as error:
        return case, str(error)


def identified_plant(result):
    """Return the Case of an Identification, with the covariance of its estimates."""
    case, static = _with_inputs(result)
    loop, estimation = case.loop, result.estimation
    for name, p in result.parameters.items():
        if name in static:
            continue
        loop = with_values(loop, {name: p["value"]})
        for holder in ("controller", "observer"):
            model = getattr(getattr(loop, holder), "model", None)
            inner = f"{holder}.model.{name.removeprefix('plant.')}"
            if name.startswith("plant.") and model is not None and rigs.has(loop, inner):
                loop = with_values(loop, {inner: p["value"]})
    loop = with_values(loop, {"sensor.noise": _noise(loop, result)})
    names, matrix = _with_earlier(case.covariance, result)
    uncertain = {}
    for name, share in case.uncertain.items():
        uncertain |= rigs.uncovered(loop, name, share, set(names))
    covariance = (tuple(names), tuple(tuple(map(float, row)) for row in matrix)) if names else None
    name = f"{case.name.partition(LACKS)[0]} identified"
    known = {"uncertain": uncertain, "covariance": covariance, "rejected": False}
    known["clock"] = _short_steps(case.clock, estimation)
    return case.replace(name=name, loop=loop, **known)


def _noise(loop, result):
    """Return (tanks,) noise of the readings, those of an Identification where it has some."""
    noise = np.array(loop.sensor.noise, dtype=float)
    by_filter = result.likelihood.get("kind") == "innovations"
    white = result.quality["widened"] <= 1.05 and not by_filter
    channels = result.estimation.data.channels
    each = result.quality["rmse"]
    if result.estimation.moments is not None and white:  # of readings whose moments are not known
        rows = at_samples(result.estimation, result.fit.residual)
        each = np.sqrt(np.nanmean(rows**2, axis=(0, 1))) * result.estimation.noise
    for (tank, volts), rmse, sd in zip(channels, each, result.quality["noise"]):
        gain = float(loop.sensor.gain[tank]) if volts else 1.0
        noise[tank] = (rmse if white else sd if by_filter else min(rmse, sd)) * gain
    return noise


REFINED = (1, 2, 4, 5, 10, 20)  # divisors of the sampling period for whole dead times
NEAR = 0.02  # error of a dead time, as a share of it, that whole samples may make


def _with_inputs(result):
    """Return (case with dead times, in whole samples, and curves of its inputs, their names)."""
    case, u = result.case, result.estimation.data.u
    values = {n: p["value"] for n, p in result.parameters.items() if n.split("[")[0] in STATIC}
    if not values:
        return case, ()
    top, loop = u.reshape(-1, u.shape[-1]).max(axis=0), case.loop
    delays, dt = np.array([v for n, v in values.items() if "delays" in n]), case.clock.dt
    steps = [dt / k for k in (REFINED if isinstance(loop.controller, OpenLoop) else (1,))]
    error = lambda step: np.max(
        np.abs(delays / step - np.round(delays / step)) * step - NEAR * delays
    )
    if delays.size:
        dt = next((step for step in steps if error(step) <= 0.0), steps[-1])
        values = {n: round(v / dt) * dt if "delays" in n else v for n, v in values.items()}
    clock = dataclasses.replace(case.clock, dt=dt) if dt != case.clock.dt else case.clock
    return case.replace(loop=with_inputs(loop, values, top), clock=clock), tuple(values)


def rounded_delays(result):
    """Return [(name, estimate, dead time of the rig)] [s] where whole samples differ from it."""
    _, static = _with_inputs(result)
    bank, rows = result.identified.loop.actuator, []
    for name in (n for n in static if "delays" in n):
        value, (pump, *_) = result.parameters[name]["value"], split_index(name)[1]
        whole = float(np.broadcast_to(delays_of(bank), bank.pumps)[pump])
        if abs(whole - value) > NEAR * value:
            rows.append((name, value, whole))
    return rows


def _short_steps(clock, estimation):
    """The clock with steps of its integrator as short as those of the fit, as far as it may."""
    step = max(np.diff(log.t).max() for log in estimation.logs) / estimation.substeps
    needed = int(np.ceil(clock.dt / step * (1.0 - 1e-9)))
    most = CLOCK["substeps"]["high"]
    return dataclasses.replace(clock, substeps=max(clock.substeps, min(needed, most)))


def _with_earlier(covariance, result):
    """Return (names, matrix) of the estimates, and of parameters that were estimated before."""
    names, matrix = result.covariance
    before, rows = covariance or ((), ())
    others = [i for i, name in enumerate(before) if name not in result.parameters]
    if not others:
        return names, matrix
    joined: Any = block_diag(matrix, np.array(rows)[np.ix_(others, others)])
    return (*names, *(before[i] for i in others)), joined


KINDS = ("pi",)
STEPS = (1.1, 0.9, 1.05, 0.95)  # first feasible new setpoint over its level [-]
LONGEST = 1e8  # time by which a rig with constant inputs must have come to its steady state [s]
MOST = 100_000  # most samples of the proposed run


def check_kind(kind, case):
    """Raise InputError unless `kind` is None or one of KINDS that suits the rig of `case`."""
    if kind is None:
        return
    if kind not in KINDS:
        raise InputError(
            f"--law {kind!r}: must be one of {', '.join(KINDS)}; other controllers go into the"
            " [controller] section of a rig file"
        )
    plant = case.loop.plant
    if len(plant.outputs) != plant.pumps:
        raise InputError(
            f"--law {kind}: needs one pump per controlled tank, the rig has {plant.pumps} pumps and"
            f" {len(plant.outputs)}: add a [controller] section of another kind to the rig file"
        )


def with_pi(case, inputs):
    """Return `case` under one PI controller per pump, output i to pump i, with [free] ranges."""
    # T-sum rule (Kuhn 1995): Kc = 0.5/K, Ti = T/2 of each output's response to its own pump, the
    # delay added to T; Kc is halved until stable. Constant setpoints get a change of 10 % each.
    loop, outputs = case.loop, list(case.loop.plant.outputs)
    inputs = np.clip(inputs, np.asarray(loop.actuator.low), np.asarray(loop.actuator.high))
    at_mean = at_mean_inflow(loop, case.clock)
    x, inflow = _steady(at_mean, inputs), steady_inflow(at_mean)
    model = tuple(np.asarray(M) for M in linearise(loop.plant, x, inputs, inflow))
    gain, total = _gain_and_time(loop, model, inputs)
    Kc, Ti = _stable(model, 0.5 / gain, 0.5 * total), 0.5 * total
    still = isinstance(loop.reference, Ramps) and not loop.reference.changes
    still = still or isinstance(loop.reference, Constant)
    start = x[outputs].tolist() if still else [float(loop.x0[i]) for i in outputs]
    table = {"kind": "pi", "Kc": Kc.tolist(), "Ti": Ti.tolist()}
    table |= {"bias": inputs.tolist()} if still else {}
    # the identified plant is its model, whatever the file's controller has
    open_loop = dataclasses.replace(loop, controller=OpenLoop(signal=loop.reference))
    controller = controller_of(table, open_loop)
    ours = lambda name: name.startswith("controller.")
    least, most = float(Kc.min()), float(Kc.max())
    ends: Any = (least / 30, most * 30)
    if least <= 0:  # a valve in an outlet
        ends = (least * 30, most * (30 if most > 0 else 1 / 30), "linear")
    free = {n: f for n, f in case.free.items() if not ours(n)}
    free["controller.Kc"] = Free(*ends)
    free["controller.Ti"] = Free(float(Ti.min() / 10), float(Ti.max() * 10))
    scenarios = tuple(s for s in case.scenarios if not any(map(ours, s.values)))
    runs = {"objective": case.objective or {"rms_error_total": 1.0}, "scenarios": scenarios}
    loop = dataclasses.replace(loop, controller=controller)
    case = case.replace(loop=loop, free=free, symmetry=None, **runs)
    return _with_changes(case, x, start, inputs, total.max()) if still else rigs.check(case)


def _gain_and_time(loop, model, inputs):
    """Return (K (m,) [cm/V], T (m,) [s]) of each output's response to its own pump."""
    A, B, C = model
    try:
        once = np.linalg.solve(A, B)
        gain, area = -np.diag(C @ once), np.diag(C @ np.linalg.solve(A, once))
    except np.linalg.LinAlgError:
        gain = area = np.zeros(loop.plant.pumps)
    settles = (gain * area > 0) & np.isfinite(area)
    if loop.plant.plain:
        settles &= gain > 0
    for j in np.flatnonzero(~settles)[:1]:
        at, name = ", ".join(f"{v:g}" for v in inputs), label_of(loop.plant, "pump", j)
        tank = label_of(loop.plant, "output", j)
        raise InputError(
            f"{name} does not settle {tank} at inputs ({at}) {units_of_inputs(loop.plant)}:"
            " a PI controller does not fit, use another [controller]"
        )
    return gain, area / gain + loop.actuator.delay


def _stable(model, Kc, Ti):
    """Return Kc, halved until the linear closed loop is stable."""
    A, B, C = model
    for _ in range(8):
        none = np.zeros((Kc.size, Kc.size))
        closed = np.block([[A - B * Kc @ C, B], [-(Kc / Ti)[:, None] * C, none]])
        if np.linalg.eigvals(closed).real.max() < 0:
            return Kc
        Kc = 0.5 * Kc
    raise InputError(
        "output i under a PI of pump i is not stable at any gain tried: use another [controller]"
    )


def _with_changes(case, x, start, inputs, slowest):
    """Return `case` from the steady state x with changes of the setpoints that the rig can hold."""
    loop, outputs = case.loop, range(len(start))
    pause = case.clock.dt * min(math.ceil(5 * slowest / case.clock.dt), MOST // len(start))
    clock = dataclasses.replace(case.clock, duration=pause * len(start))
    times = [round(0.1 * pause / clock.dt) * clock.dt + k * pause for k in outputs]
    pumps = dataclasses.replace(loop.actuator, initial=number(inputs))
    for share in STEPS:
        reference = ramps(start, [(times[k], k, share * start[k]) for k in outputs], ramp=0.0)
        moved = dataclasses.replace(loop, reference=reference, x0=number(x), actuator=pumps)
        changed = case.replace(loop=moved, clock=clock)
        if not rigs.unreachable(changed):
            return rigs.check(changed.replace(reachable=True))
    raise InputError(
        f"no setpoints about {', '.join(f'{v:.4g}' for v in start)} {loop.units[0]} can be held:"
        " add [controller] and [reference]"
    )


def _steady(loop, inputs):
    """Return (n,) steady levels at constant `inputs`; raise InputError unless below the rims."""
    plant = loop.plant
    constant = isinstance(loop.disturbance, Constant)
    inflow = tuple(np.asarray(loop.disturbance.level)) if constant else None
    flows = lambda x: plant.derivative(0.0, tuple(jnp.maximum(x, 0.0)), tuple(inputs), inflow)
    derivative = jax.jit(lambda x: jnp.stack(flows(x)))
    rate = lambda _, x: np.asarray(derivative(x))
    rim, span = np.asarray(plant.rim), 100.0
    x = np.maximum(np.asarray(loop.x0, dtype=float), 1e-3 * rim)
    while span <= LONGEST:
        run = solve_ivp(rate, (0.0, span), x, method="LSODA", rtol=1e-9, atol=1e-9 * rim.min())
        x = np.maximum(run.y[:, -1], 0.0)
        if np.any(x > 10 * rim) or np.all(np.abs(rate(0.0, x)) * span <= 1e-6 * rim):
            break
        span *= 10
    at = ", ".join(f"{v:.4g}" for v in inputs)
    for i in np.flatnonzero((x >= rim) | (x <= 1e-3 * rim) | (span > LONGEST)):
        raise InputError(
            f"{label_of(plant, 'tank', int(i))} has no steady level between 0 and its rim at the"
            f" mean inputs of the data, ({at}) {units_of_inputs(plant)}: add [controller],"
            " [reference] and [free]"
        )
    return x

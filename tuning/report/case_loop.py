"""A loop in sentences: sensors, pumps, signals and faults; imported by the manual of a case."""

import numpy as np

from jaxtank.instruments import LevelSensor, PumpBank
from jaxtank.signals.base import Constant, Sum
from jaxtank.signals.inflows import InflowPulses
from jaxtank.signals.setpoints import Ramps, Sine
from tuning.problem.wording import count


def own_name(case, kind, i):
    """Return " (left)" for the tank or pump `i` that its rig file calls left, else ""."""
    name = case.names.get(kind, {i: ""})[i]
    return f" ({name})" if name else ""


def called(case):
    """Return a sentence on the names that the rig file has for its tanks and pumps."""
    found = [
        f"{kind} {i + 1} is {name!r}"
        for kind in ("tank", "pump")
        for i, name in enumerate(case.names.get(kind, ()))
        if name
    ]
    return [f"The names of its file: {', '.join(found)}."] if found else []


def _list(values):
    found = [f"{float(v):g}" for v in np.ravel(values)]
    return found[0] if len(set(found)) == 1 else ", ".join(found)


def sensor(loop):
    """Return a sentence on how the levels are measured."""
    own, length = loop.sensor, loop.units[0]
    if not isinstance(own, LevelSensor):
        return [f"Sensors: {type(own).__name__}."]
    noise = (
        f"noise of {_list(own.noise)} {length} (standard deviation)"
        if np.any(np.asarray(own.noise) > 0)
        else "no noise (sensor.noise)"
    )
    bits = f"an ADC of {own.bits} bits" if own.bits else "no ADC (sensor.bits)"
    offset = "" if own.offset is None else f", offset {_list(own.offset)} {length}"
    return [f"Sensors: one per tank, {noise}, {bits}{offset}."]


def actuator(loop):
    """Return a sentence on what the pumps do to a command, in that order."""
    bank, drive = loop.actuator, loop.units[1]
    if not isinstance(bank, PumpBank):
        limits = f"from {_list(bank.low)} to {_list(bank.high)} {drive}"
        return [f"Pumps: {bank.pumps}, {limits}, a {type(bank).__name__}."]
    words = {"clip": "each clipped", "boxqp": "allocated by the controller's own cost"}[
        bank.saturation
    ]
    found = [f"Pumps: {bank.pumps}, from {_list(bank.low)} to {_list(bank.high)} {drive} ({words})"]
    found += (
        [f"dead zone {_list(bank.dead_zone)} {drive} ({bank.dead_zone_kind})"]
        if bank.dead_zone is not None
        else ["no dead zone"]
    )
    found += [f"lag {_list(bank.lag)} s"] if bank.lag is not None else ["no lag"]
    found += [f"transport delay {bank.delay:g} s" if bank.delay else "no delay"]
    return ["; ".join(found) + "."]


def signals(loop):
    """Return sentences on reference, disturbances and faults."""
    return [_reference(loop.reference, loop.units[0]), *_disturbance(loop), *_faults(loop)]


def _reference(signal, length):
    if isinstance(signal, Sum):
        return f"{_reference(signal.first, length)} {_reference(signal.second, length)}"
    if isinstance(signal, Ramps):
        course = (
            "steps"
            if signal.ramp == 0
            else f"{'ramps' if signal.shape == 'linear' else 'S-curves'} of {signal.ramp:g} s"
        )
        start = ", ".join(f"r{i + 1} = {float(v):g}" for i, v in enumerate(signal.initial))
        changes = "; ".join(
            f"{t:g} s r{i + 1} to {float(v):g}" for (t, i), v in zip(signal.changes, signal.targets)
        )
        return f"Setpoints [{length}]: {start}" + (f"; {course} at {changes}." if changes else ".")
    if isinstance(signal, Sine):
        size = (
            f"{float(signal.amplitude):g} {length} about {float(signal.offset):g} {length}, period"
            f" {signal.period:g} s"
        )
        return (
            f"On r{signal.channel + 1} a sine of {size}, from {signal.start:g} to {signal.end:g} s."
        )
    return f"Setpoints: {type(signal).__name__} with {signal.channels} channels."


def _disturbance(loop):
    signal, length = loop.disturbance, loop.units[0]
    if signal is None:
        return ["No disturbance."]
    if isinstance(signal, Constant):
        return [
            f"Constant inflow disturbance: {', '.join(f'{float(v):g}' for v in signal.level)}"
            f" {length}^3/s, by tank."
        ]
    if isinstance(signal, InflowPulses):
        each = (
            f"{float(v):g} {length}^3 into tank {tank + 1} at {t:g} s over {s:g} s"
            for (t, s, tank), v in zip(signal.events, signal.volume)
        )
        return ["Inflow disturbance: " + "; ".join(each) + "."]
    return [f"Disturbance: {type(signal).__name__}."]


def _faults(loop):
    if loop.faults is None:
        return []
    rows = zip(loop.faults.windows, loop.faults.factor, loop.faults.extra)
    each = (
        f"plant.{n} times {float(f):g}{f' plus {float(e):g}' if float(e) else ''} from {a:g} to"
        f" {b:g} s"
        for (n, a, b), f, e in rows
    )
    return ["Faults, unknown to the controller: " + "; ".join(each) + "."]


def sampled(case):
    """Return a sentence on sampling and on the initial levels."""
    now = case.clock
    words = f"{count(now.substeps, 'step')} of {now.integrator} per sample"
    start = ", ".join(f"{float(v):.4g}" for v in case.loop.x0)
    return [
        f"Sampled every {now.dt:g} s for {now.duration:g} s, {words}; levels start at {start}"
        f" {case.loop.units[0]}."
    ]

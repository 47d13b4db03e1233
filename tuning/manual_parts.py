"""What a case's sensors, pumps, reference and disturbances do, in sentences with numbers."""

import numpy as np

from jaxtank.signals.base import Constant, Sum
from jaxtank.signals.inflows import Pours
from jaxtank.signals.setpoints import Ramps, Sine


def own_name(case, kind, i):
    """ " (left)" of the `kind`, "tank" or "pump", that its rig file calls left; nothing of one without a name."""
    name = case.names.get(kind, {i: ""})[i]
    return f" ({name})" if name else ""


def called(case):
    """What the rig file calls its tanks and pumps."""
    found = [f"{kind} {i + 1} is {name!r}" for kind in ("tank", "pump") for i, name in enumerate(case.names.get(kind, ())) if name]
    return [f"The names of its file: {', '.join(found)}."] if found else []


def _list(values):
    found = [f"{float(v):g}" for v in np.ravel(values)]
    return found[0] if len(set(found)) == 1 else ", ".join(found)


def sensor(loop):
    """What is read of the levels."""
    own, length = loop.sensor, loop.units[0]
    noise = (
        f"noise of {_list(own.noise)} {length} (standard deviation)"
        if np.any(np.asarray(own.noise) > 0)
        else "no noise (sensor.noise)"
    )
    bits = f"an ADC of {own.bits} bits" if own.bits else "no ADC (sensor.bits)"
    offset = "" if own.offset is None else f", offset {_list(own.offset)} {length}"
    return [f"Sensors: one per tank, {noise}, {bits}{offset}."]


def actuator(loop):
    """What the pumps make of a command, in the order in which they do."""
    bank, drive = loop.actuator, loop.units[1]
    words = {"clip": "each clipped", "boxqp": "allocated by the law's own cost"}[bank.saturation]
    found = [f"Pumps: {bank.pumps}, from {_list(bank.low)} to {_list(bank.high)} {drive} ({words})"]
    found += (
        [f"dead zone {_list(bank.dead_zone)} {drive} ({bank.dead_zone_kind})"] if bank.dead_zone is not None else ["no dead zone"]
    )
    found += [f"lag {_list(bank.lag)} s"] if bank.lag is not None else ["no lag"]
    found += [f"transport delay {bank.delay:g} s" if bank.delay else "no delay"]
    return ["; ".join(found) + "."]


def moved(loop):
    """What moves the loop: reference, disturbances, faults."""
    return [_reference(loop.reference, loop.units[0]), *_disturbance(loop), *_faults(loop)]


def _reference(signal, length):
    if isinstance(signal, Sum):
        return f"{_reference(signal.first, length)} {_reference(signal.second, length)}"
    if isinstance(signal, Ramps):
        course = "steps" if signal.ramp == 0 else f"{'ramps' if signal.shape == 'linear' else 'S-curves'} of {signal.ramp:g} s"
        start = ", ".join(f"r{i + 1} = {float(v):g}" for i, v in enumerate(signal.initial))
        changes = "; ".join(f"{t:g} s r{i + 1} to {float(v):g}" for (t, i), v in zip(signal.changes, signal.targets))
        return f"Setpoints [{length}]: {start}" + (f"; {course} at {changes}." if changes else ".")
    if isinstance(signal, Sine):
        size = f"{float(signal.amplitude):g} {length} about {float(signal.offset):g} {length}, period {signal.period:g} s"
        return f"On r{signal.channel + 1} a sine of {size}, from {signal.start:g} to {signal.end:g} s."
    return f"Setpoints: {type(signal).__name__} with {signal.channels} channels."


def _disturbance(loop):
    signal, length = loop.disturbance, loop.units[0]
    if signal is None:
        return ["No disturbance."]
    if isinstance(signal, Constant):
        return [f"Steady inflow that no pump brings: {', '.join(f'{float(v):g}' for v in signal.level)} {length}^3/s, by tank."]
    if isinstance(signal, Pours):
        each = (
            f"{float(v):g} {length}^3 into tank {tank + 1} at {t:g} s over {s:g} s"
            for (t, s, tank), v in zip(signal.events, signal.volume)
        )
        return ["Poured: " + "; ".join(each) + "."]
    return [f"Disturbance: {type(signal).__name__}."]


def _faults(loop):
    if loop.faults is None:
        return []
    rows = zip(loop.faults.windows, loop.faults.factor, loop.faults.extra)
    each = (
        f"plant.{n} times {float(f):g}{f' plus {float(e):g}' if float(e) else ''} from {a:g} to {b:g} s" for (n, a, b), f, e in rows
    )
    return ["Faults, untold to the law: " + "; ".join(each) + "."]


def sampled(case):
    """When the law samples, and where the levels start."""
    now = case.clock
    words = f"{now.substeps} step{'s' if now.substeps > 1 else ''} of {now.integrator} per sample"
    start = ", ".join(f"{float(v):.4g}" for v in case.loop.x0)
    return [f"Sampled every {now.dt:g} s for {now.duration:g} s, {words}; levels start at {start} {case.loop.units[0]}."]

"""Suggestions of a complete rig file, commented out: what could be set besides, each line of which
can be used as it stands.
"""

import numpy as np

from jaxtank.case import Free
from jaxtank.core.errors import InputError
from jaxtank.core.tree import describe, get_value, is_component, parameters, walk
from jaxtank.measures import MEASURES, of_loop
from jaxtank.measures import unit as measure_unit
from jaxtank.plants.tank_network import TankNetwork
from jaxtank.rig import components
from jaxtank.rig.entry import Block, Line, suggestion, toml
from jaxtank.rig.schema import SECTIONS, SHARE, WEIGHT, Section
from jaxtank.rig.values import schedule, schedule_table
from jaxtank.signals.base import Constant
from jaxtank.signals.setpoints import Ramps


def absent(loop, name, meta):
    """Return the least allowed value of an absent optional leaf, in its shape."""
    *path, _ = name.split(".")
    owner = loop
    for step in path:
        owner = getattr(owner, step)
    shape = np.shape(getattr(owner, meta["like"]))
    low, high = meta["low"], meta["high"]
    if low is None or (low <= 0.0 and not meta["strict"]):
        value = 0.0
    else:
        value = 1.0 if high is None or high >= 1.0 else 0.5 * (low + high)
    return np.full(shape, value).tolist()


def of_measure(case, name):
    """What a measure is, as metadata."""
    per = MEASURES[name].per
    each = "" if per == "run" else f", of each {per}"
    rim = '; "rim": that of each tank' if name == "max_level" else ""
    # where overflow is simulated no level passes a rim (tuning.objective)
    if rim and case.loop.plant.overflow:
        rim += ", which beside overflow = true is a limit on overflow_volume: none may overflow"
    unit = measure_unit(name, case.loop.units)
    return {"unit": unit, "doc": f"{MEASURES[name].doc}{each}{rim}"}


def of_free(case, name):
    """What a parameter is that is free, as metadata."""
    meta = describe(case.loop, name)
    return {**meta, "doc": f"[low, high, scale] of: {meta['doc']}"}


def of_uncertain(case, name):
    """What a share of a parameter is, as metadata."""
    entry = SHARE.meta()
    return {**entry, "doc": f"{entry['doc']}, of: {describe(case.loop, name)['doc']}"}


def _measures(case, but):
    """Suggested lines of the measures that a run of the case has, without those in `but`."""
    return [
        Line(name, WEIGHT.default, of_measure(case, name), False)
        for name in of_loop(case.loop)
        if name not in but
    ]


def limits(case):
    """Lines of the measures that are not limited."""
    return _measures(case, case.limits)


def objective(case):
    """Lines of the measures that are not in the objective."""
    return _measures(case, case.objective)


def free(case):
    """Lines of gains of controller and observer that could be free, over a decade each way."""
    found, taken = [], {name.split("[")[0] for name in case.free} | {"controller.knots"}
    for name, value, meta in walk(case.loop):
        part, _, rest = name.partition(".")
        if part not in ("controller", "observer") or "model." in rest or name in taken:
            continue
        span = None if value is None or meta.get("rows") else around(value, meta)
        if span is not None:
            found.append(Line(toml(name), list(span), of_free(case, name), False))
    return found


def around(value, meta):
    """Return Free of a tenth to ten times a value within its range, None of an empty one."""
    value = np.asarray(value, dtype=float)
    if value.size == 0:
        return None
    low, high = 0.1 * value.min(), 10.0 * value.max()
    if value.min() <= 0:
        high = 1.0 + 2 * np.abs(value).max()
        low = -high
    low = low if meta["low"] is None else max(low, meta["low"])
    high = high if meta["high"] is None else min(high, meta["high"])
    low, high = _rounded(low), _rounded(high)
    return Free(low, high, "log" if low > 0 else "linear") if low < high else None


def _rounded(value):
    return float(f"{value:.3g}")


def uncertain(case):
    """Lines of the plant's parameters whose spread is not given."""
    taken, share = {n.split("[")[0] for n in case.uncertain}, SHARE.default
    return [
        Line(toml(name), share, of_uncertain(case, name), False)
        for name, value in parameters(case.loop).items()
        if name.startswith("plant.") and name not in taken and np.any(np.asarray(value) != 0)
    ]


def suggestions(case, have):
    """Return the Blocks of tables that a case does not have, as they could be."""
    given = have - {section.title for section in SECTIONS.values() if section.many}
    found = []
    for name, example in EXAMPLES.items():
        if SECTIONS[name].title in given or (SECTIONS[name].many and name in given):
            continue
        values = example(case)
        if isinstance(values, Block):
            found.append(values)
        elif values is not None:
            section = values.pop("section", SECTIONS[name])
            found.append(suggestion(section, values, case.loop.units))
    return found


def _seconds(case, share):
    """A share of a run, rounded [s]."""
    return _rounded(share * case.clock.duration)


def _controller(case):
    """The case's own controller, as a start for another."""
    part = case.loop.controller
    known = components.kind_of("controller", part) is not None
    if not known or not is_component(getattr(part, "model", None)):
        return None  # also of a controller with a schedule, whose class has no name
    return _component("controller", part)


def _component(name, part):
    """{key: value} of a controller or observer, and its section."""
    section, values = components.values_of(name, part)
    prose = f"Another {name} than the preset's: {', '.join(components.ROLES[name].classes)}."
    if name == "controller":
        prose += " [values] above then has the names of that controller."
    return {"section": Section(name, section.keys, prose=prose), **values}


def _schedule(case):
    """The first free gain along the first setpoint, None where no schedule is allowed."""
    if schedule_table(case.loop):
        return None
    rim = float(np.asarray(case.loop.plant.rim)[case.loop.plant.outputs[0]])
    knots = [_rounded(share * rim) for share in (0.25, 0.5, 0.75)]
    for name in case.free:
        if name.startswith("controller.") and "model" not in name:
            for variable in ("r1", "h1"):
                try:
                    found = schedule(case, {name: variable}, knots)
                    found.loop.controller.check(found.loop.reference)
                except (InputError, LookupError, TypeError, ValueError):
                    continue
                return {"gains": [name], "variable": variable, "knots": knots}
    return None


def _observer(case):
    """The loop's own observer, or an extended Kalman filter where it has none."""
    part = case.loop.observer
    if components.kind_of("observer", part) not in (None, "direct"):
        return _component("observer", part)
    rim = float(np.asarray(case.loop.plant.rim)[0])
    small, large = (_rounded((share * rim) ** 2) for share in (1e-3, 1e-2))
    kind = "extended-kalman"
    keys = components.section_of("observer", kind).keys
    prose = (
        f"Another observer than the preset's: {', '.join(components.ROLES['observer'].classes)}."
    )
    return {
        "section": Section("observer", keys, prose=prose),
        "kind": kind,
        "process": small,
        "measurement": small,
        "spread": large,
        "measured": range(case.loop.plant.tanks),
    }


def _sine(case):
    """A sine of amplitude 0 on a reference of ramps, whose names no scenario has."""
    named = any(name.startswith("reference.") for s in case.scenarios for name in s.values)
    if not isinstance(case.loop.reference, Ramps) or named:
        return None
    return {"amplitude": 0.0, "period": _seconds(case, 0.1), "end": _seconds(case, 1), "output": 1}


def _disturbance(case):
    """No inflow, of every tank."""
    tanks = case.loop.plant.tanks
    return {"inflow": np.zeros(tanks)} if case.loop.disturbance is None else None


def _inflow(case):
    """A pulse of 1 % of the first tank, where there is no steady inflow."""
    steady, plant = case.loop.disturbance, case.loop.plant
    if isinstance(steady, Constant) and np.any(np.asarray(steady.level)):
        return None
    volume = float(np.asarray(plant.area)[0] * np.asarray(plant.rim)[0])
    times = {"time": _seconds(case, 0.5), "duration": _seconds(case, 0.01)}
    return {**times, "tank": 0, "volume": _rounded(0.01 * volume)}


def _fault(case):
    """A weaker first pump for a while."""
    times = {"start": _seconds(case, 0.5), "end": _seconds(case, 0.7)}
    return {"of": "pump_gain[0]", **times, "factor": 0.6}


def _covariance(case):
    """5 % of the first uncertain parameter."""
    if case.covariance:
        return None
    loop, name = case.loop, "plant.pump_gain"
    for other in case.uncertain:
        if np.size(get_value(loop, other)) and np.ravel(get_value(loop, other))[0] != 0:
            name = other
            break
    value = np.ravel(np.asarray(get_value(loop, name)))[0]
    scalar = "[" in name or np.ndim(get_value(loop, name)) == 0
    return {
        "names": [name if scalar else f"{name}[0]"],
        "matrix": [[_rounded((0.05 * value) ** 2)]],
    }


def _safety_filter(case):
    """Limits at the rims."""
    plant = case.loop.plant
    if case.safety is not None or not isinstance(plant, TankNetwork):
        return None
    return {"limit": np.asarray(plant.rim)}


def _scenario(case):
    """A run with sensor noise of its own."""
    return {"name": "noisy", "seed": 1, "values": {"sensor.noise": 0.0}}


def _log(case):
    """The columns of experiment data of the rig."""
    if case.log:
        return None
    plant, (length, drive) = case.loop.plant, case.loop.units
    columns = {"t": ["time", "s"]}
    columns |= {f"pump{j + 1}": [f"u{j + 1}", drive] for j in range(plant.pumps)}
    columns |= {f"h{i + 1}": [f"level {i + 1}", length] for i in range(plant.tanks)}
    section = SECTIONS["log"]
    lines = [Line(name, value, {"unit": "-", "doc": ""}) for name, value in columns.items()]
    return Block(section.title, lines, (section.prose,), False)


EXAMPLES = {
    "controller": _controller,
    "schedule": _schedule,
    "observer": _observer,
    "reference.sine": _sine,
    "disturbance": _disturbance,
    "inflow": _inflow,
    "fault": _fault,
    "covariance": _covariance,
    "safety_filter": _safety_filter,
    "scenario": _scenario,
    "log": _log,
}
"""{section: function of a case} that gives the values suggested for it, None where it has none."""

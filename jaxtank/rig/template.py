"""Suggestions of a complete rig file, commented out, each of which can be used unchanged."""

import numpy as np

from jaxtank.case import Free
from jaxtank.core.errors import InputError
from jaxtank.core.tree import describe, get_value, is_component, parameters, walk
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.measures import MEASURES, of_loop
from jaxtank.measures import unit as measure_unit
from jaxtank.plants.tank_network import TankNetwork
from jaxtank.rig import components
from jaxtank.rig.entry import Block, Line, suggestion, toml
from jaxtank.rig.schema import SECTIONS, SHARE, WEIGHT, Section
from jaxtank.rig.values import schedule, schedule_table
from jaxtank.signals.setpoints import Ramps


def absent(loop, name, meta):
    """Return the least allowed value of an absent optional leaf, in its shape."""
    sibling = get_value(loop, f"{name.rpartition('.')[0]}.{meta['like']}")
    low, high = meta["low"], meta["high"]
    if name == "sensor.high":  # setpoints are within a span
        value = np.inf
    elif low is None or (low <= 0.0 and not meta["strict"]):
        value = 0.0
    else:
        value = 1.0 if high is None or high >= 1.0 else 0.5 * (low + high)
    return np.full(np.shape(sibling), value).tolist()


def of_measure(case, name):
    """What a measure is, as metadata."""
    per = MEASURES[name].per
    each = "" if per == "run" else f", of each {per}"
    rim = '; "rim": that of each tank' if name == "max_level" else ""
    # where overflow is simulated no level passes a rim (tuning.objective)
    if rim and case.loop.plant.overflow:
        rim += ", which with overflow = true is a limit on overflow_volume: none may overflow"
    return {"unit": measure_unit(name, case.loop.units), "doc": f"{MEASURES[name].doc}{each}{rim}"}


def of_free(case, name):
    """What a free parameter is, as metadata."""
    meta = describe(case.loop, name)
    return {**meta, "doc": f"[low, high, scale] of: {meta['doc']}"}


def of_uncertain(case, name):
    """What the spread of a parameter is, as metadata."""
    meta = SHARE.meta()
    return {**meta, "doc": f"{meta['doc']}, of: {describe(case.loop, name)['doc']}"}


def measures(case, known):
    """Suggested lines of the measures that a run of the case has, without those in `known`."""
    names = [name for name in of_loop(case.loop) if name not in known]
    return [Line(name, WEIGHT.default, of_measure(case, name), False) for name in names]


def free(case):
    """Lines of gains of controller and observer that could be free, over a decade each way."""
    lines, known = [], {name.split("[")[0] for name in case.free} | {"controller.knots"}
    for name, value, meta in walk(case.loop):
        part, _, rest = name.partition(".")
        if part not in ("controller", "observer") or "model." in rest or name in known:
            continue
        span = None if value is None or meta.get("rows") else around(value, meta)
        if span is not None:
            lines.append(Line(toml(name), list(span), of_free(case, name), False))
    return lines


def around(value, meta):
    """Return Free of a tenth to ten times a value within its range, None of an empty one."""
    value = np.asarray(value, dtype=float)
    if value.size == 0:
        return None
    low, high = 0.1 * value.min(), 10.0 * value.max()
    if value.max() < 0:
        low, high = 10.0 * value.min(), 0.1 * value.max()
    elif value.min() <= 0:  # on both sides of 0 where entries are not of one sign
        high = 1.0 + 2 * np.abs(value).max()
        low = -high
    low = _rounded(low if meta["low"] is None else max(low, meta["low"]))
    high = _rounded(high if meta["high"] is None else min(high, meta["high"]))
    return Free(low, high, "log" if low * high > 0 else "linear") if low < high else None


def _rounded(value):
    return float(f"{value:.3g}")


def uncertain(case):
    """Lines of the plant's parameters whose spread is not given."""
    known = {n.split("[")[0] for n in case.uncertain}
    nonzero = (n for n, v in parameters(case.loop).items() if np.any(np.asarray(v) != 0))
    names = [n for n in nonzero if n.startswith("plant.") and n not in known]
    return [Line(toml(n), SHARE.default, of_uncertain(case, n), False) for n in names]


def suggestions(case, titles):
    """Return the Blocks that a case could have; titles: of those it has or has emptied."""
    titles = titles - {section.title for section in SECTIONS.values() if section.many}
    blocks = []
    for name, values in _examples(case).items():
        section = SECTIONS[name]
        if values is None or section.title in titles or (section.many and name in titles):
            continue
        section = values.pop("section", section)
        blocks.append(suggestion(section, values, case.loop.units))
    return blocks if "[log]" in titles else [*blocks, _log(case)]


def _examples(case):
    """{section: {key: value} that could be in a file, None where it cannot}."""
    loop, plant, disturbance = case.loop, case.loop.plant, case.loop.disturbance
    instant = lambda share: _rounded(share * case.clock.duration)  # [s]
    # a sine changes the names of the reference, which a scenario may have
    named = any(name.startswith("reference.") for s in case.scenarios for name in s.values)
    volume = _rounded(0.01 * float(np.asarray(plant.area)[0] * np.asarray(plant.rim)[0]))
    first = f"{_first_input(plant)}[0]"
    control, sensor = loop.controller, loop.sensor
    known = components.kind_of("controller", control) is not None  # no Scheduled
    known = known and is_component(getattr(control, "model", None))
    unspanned = isinstance(sensor, LevelSensor) and sensor.low is None
    return {
        "controller": _component("controller", control) if known else None,
        "schedule": _schedule(case),
        "observer": _observer(loop),
        "reference.sine": {"amplitude": 0.0, "period": instant(0.1), "end": instant(1), "output": 1}
        if isinstance(loop.reference, Ramps) and not named
        else None,
        "disturbance": {"inflow": np.zeros(plant.tanks)} if disturbance is None else None,
        "inflow": {"time": instant(0.5), "duration": instant(0.01), "tank": 0, "volume": volume},
        "fault": {"of": first, "start": instant(0.5), "end": instant(0.7), "factor": 0.6},
        "sensors": {"tank": 0, "span": [0.0, float(np.ravel(plant.rim)[0])]} if unspanned else None,
        "covariance": None if case.covariance else _covariance(case),
        "safety_filter": {"limit": np.asarray(plant.rim)}
        if case.safety is None and isinstance(plant, TankNetwork) and plant.plain
        else None,
        "scenario": {"name": "noisy", "seed": 1, "values": {"sensor.noise": 0.0}},
    }


def _component(name, part):
    """{key: value} of a controller or observer, and its section."""
    section, values = components.values_of(name, part)
    return {"section": _another(name, section.keys), **values}


def _another(name, keys):
    """The Section of a controller or observer instead of the preset's."""
    prose = f"Another {name} than the preset's: {', '.join(components.ROLES[name].classes)}."
    if name == "controller":
        prose += " [values] above then has the names of that controller."
    return Section(name, keys, prose=prose)


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
                    scheduled = schedule(case, {name: variable}, knots)
                    scheduled.loop.controller.check(scheduled.loop.reference)
                except (InputError, LookupError, TypeError, ValueError):
                    continue
                return {"gains": [name], "variable": variable, "knots": knots}
    return None


def _observer(loop):
    """The loop's own observer, or an extended Kalman filter where it has none."""
    part, kind = loop.observer, "extended-kalman"
    if components.kind_of("observer", part) not in (None, "direct"):
        return _component("observer", part)
    rim = float(np.asarray(loop.plant.rim)[0])
    small, large = (_rounded((share * rim) ** 2) for share in (1e-3, 1e-2))
    section = _another("observer", components.section_of("observer", kind).keys)
    variances = {"process": small, "measurement": small, "spread": large}
    return {"section": section, "kind": kind, **variances, "measured": range(loop.plant.tanks)}


def _first_input(plant):
    """The leaf of the first input: a valve where there is no pump."""
    return "pump_gain" if np.size(getattr(plant, "pump_gain", 1.0)) else "valve"


def _covariance(case):
    """5 % of the first uncertain parameter."""
    value_of = lambda name: np.ravel(np.asarray(get_value(case.loop, name)))
    nonzero = (n for n in case.uncertain if value_of(n).size and value_of(n)[0] != 0)
    name = next(nonzero, f"plant.{_first_input(case.loop.plant)}")
    scalar = "[" in name or np.ndim(get_value(case.loop, name)) == 0
    variance = _rounded((0.05 * value_of(name)[0]) ** 2)
    return {"names": [name if scalar else f"{name}[0]"], "matrix": [[variance]]}


def _log(case):
    """The columns of experiment data of the rig."""
    plant, (length, drive) = case.loop.plant, case.loop.units
    columns = {"t": ["time", "s"]}
    columns |= {f"pump{j + 1}": [f"u{j + 1}", drive] for j in range(plant.pumps)}
    columns |= {f"h{i + 1}": [f"level {i + 1}", length] for i in range(plant.tanks)}
    lines = [Line(name, value, {"unit": "-", "doc": ""}) for name, value in columns.items()]
    return Block(SECTIONS["log"].title, lines, (SECTIONS["log"].prose,), False)

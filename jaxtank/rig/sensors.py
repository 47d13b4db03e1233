"""[[sensor]]: spans, names and noise of the level sensors, and readings in % of a span or in mA."""

import dataclasses
import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxtank.core.errors import InputError, unknown
from jaxtank.core.labels import OF_OPENINGS, index_of, input_unit, label_of
from jaxtank.core.quantities import LENGTHS, NUMBER, factor
from jaxtank.core.text import shortened
from jaxtank.core.tree import describe, number
from jaxtank.core.units import local
from jaxtank.rig.schema import SECTIONS

LEVELS = ("initial", "targets", "changes", "x0", "level", "levels", "on", "off", "knots")
LEVELS += ("limit", "low", "max_level", "min_level")
"""Names of values that are levels: 0 % is the level at the lower end of a span."""

WIDTHS = ("noise", "offset", "deadband", "amplitude", "band", "size")
"""Names of values that are differences of levels: 0 % is 0."""

TANKS_OF = {"limit": "limited", "limit_Kc": "limited", "inner_Kc": "inner", "Kc": "inner"}
"""{key of a controller, one entry per output: key of the tanks whose readings its entries are of,
or of a cascade's Kc ask for}, where a controller has that key."""

_READING = re.compile(rf"(?P<number>{NUMBER.pattern})\s*(?P<unit>%|mA)")
_GAIN = re.compile(rf"(?P<number>{NUMBER.pattern})\s*(?P<unit>.*\S)\s*/\s*%")

_LOOP = re.compile(r"\s*4\s*(?:mA)?\s*(?:\.{2,3}|…|-|–|to)\s*20\s*mA\s*")

CURRENTS = (4.0, 20.0)  # current of a sensor at the ends of its span [mA]

LEAST, MOST = 3.6, 22.0
"""Currents beyond which a transmitter reports a failure, and no level (NAMUR NE 43) [mA]."""


class Height(tuple[float, float]):
    """(bottom, rim) of a tank without a sensor that states its span: in %, but not in mA."""


def spans_of(loop: Any) -> list[tuple[float, float]]:
    """Return (level at 0 %, at 100 %) of each tank: the ends of its sensor, else bottom and rim."""
    low, high = (getattr(loop.sensor, name, None) for name in ("low", "high"))
    return _spans(low, high, np.broadcast_to(loop.plant.rim, (loop.plant.tanks,)))


def _spans(low, high, rims):
    """`spans_of` of leaves of a sensor, which may be None or infinite."""
    low = np.broadcast_to(-np.inf if low is None else np.asarray(low), len(rims))
    high = np.broadcast_to(np.inf if high is None else np.asarray(high), len(rims))
    stated = np.isfinite(low) | np.isfinite(high)
    low, high = np.where(np.isfinite(low), low, 0.0), np.where(np.isfinite(high), high, rims)
    spans = zip(stated, low.tolist(), high.tolist())
    return [(a, b) if known else Height((a, b)) for known, a, b in spans]


def is_reading(value: Any) -> bool:
    """Whether a value is a text such as "80 %" or "12 mA"."""
    return isinstance(value, str) and _READING.fullmatch(value.strip()) is not None


def level_of(text: str, span: tuple[float, float], width: bool = False) -> float:
    """Return the level, or the difference of levels, that a text such as "80 %" stands for."""
    match: Any = _READING.fullmatch(text.strip())
    value, unit = float(match["number"]), match["unit"]
    check_current(value, unit, span, width)
    return in_span(value, unit, span, width)


def in_span(value: Any, unit: str, span: tuple[float, float], width: bool = False) -> Any:
    """Return the level of a reading in % or mA, or the difference of two."""
    first, last = CURRENTS if unit == "mA" else (0.0, 100.0)
    share = (value - (0.0 if width else first)) / (last - first)
    return share * (span[1] - span[0]) + (0.0 if width else span[0])


def check_current(value: Any, unit: str, span: Any, width: bool = False) -> None:
    """Raise InputError for currents [mA] that no sensor of the rig gives."""
    if unit != "mA":
        return
    if isinstance(span, Height):
        raise InputError(
            f"{np.ravel(value)[0]:g} mA: no [[sensor]] of this tank says at which levels it gives 4"
            ' and 20 mA: give it unit = "4..20 mA" and span = [level at 4 mA, level at 20 mA]'
        )
    low, high = (LEAST - MOST, MOST - LEAST) if width else (LEAST, MOST)
    with np.errstate(invalid="ignore"):
        beyond = np.ravel(value)[(np.ravel(value) < low) | (np.ravel(value) > high)]
    if beyond.size:
        raise InputError(
            f"{beyond[0]:g} mA: must be from {low:g} to {high:g} mA, as a transmitter's current"
        )


class Manipulated(NamedTuple):
    """Inputs that each loop of a ratio or a split range moves; other loops move one input."""

    inputs: tuple[tuple[int, ...], ...] = ()  # of each output
    span: Any = None  # what each input takes of the output of its PID; None: its range


ONE_INPUT = Manipulated()


def readings(
    label: str,
    name: str,
    value: Any,
    unit: str,
    axes: Any,
    loop: Any,
    manipulated: Manipulated = ONE_INPUT,
) -> Any:
    """Return a value with texts in % or mA as numbers; manipulated: by the value's controller."""
    # axes: "output", "tank", an index, or the tanks of an entry for each output
    texts = list(value) if isinstance(value, (list, tuple)) else [value]
    applies, to_number = _conversion(label, name, unit, axes, loop, manipulated)
    if not any(map(applies, texts)):
        return value
    apply = lambda v, i: to_number(v, i) if applies(v) else v
    count = loop.plant.tanks if axes == "tank" else len(loop.plant.outputs)
    count = min(count, len(axes)) if isinstance(axes, tuple) else count
    if isinstance(axes, int):
        each = [apply(v, axes) for v in texts]
        return each if isinstance(value, (list, tuple)) else each[0]
    if not isinstance(value, (list, tuple)):
        each = [apply(value, i) for i in range(count)]
        return each[0] if len(set(each)) == 1 else each
    return [apply(v, i) if i < count else v for i, v in enumerate(texts)]


def _conversion(label, name, unit, axes, loop, manipulated):
    """(which texts of a level or a gain are in % or mA, function of such a text and an index)."""
    tanks = axes if isinstance(axes, tuple) else loop.plant.outputs
    is_gain = lambda v: isinstance(v, str) and _GAIN.fullmatch(v.strip()) is not None
    if unit in units_of_gain(loop):
        return is_gain, lambda text, i: _gain(label, text, loop, unit, i, tanks[i], manipulated)
    if name == "Kc" and unit == "-" and isinstance(axes, tuple):  # a level for each level

        def ratio(text, i):
            """A gain such as "2 %/%" of the level that a cascade asks a tank for."""
            match: Any = _GAIN.fullmatch(text.strip())
            if match["unit"].strip() != "%":
                raise InputError(f'{label} = {shortened(text)}: must be a number [-], or in "%/%"')
            low, high = zip(*(spans_of(loop)[tank] for tank in (loop.plant.outputs[i], tanks[i])))
            return float(match["number"]) * (high[1] - low[1]) / (high[0] - low[0])

        return is_gain, ratio
    if unit != loop.units[0] or name not in LEVELS + WIDTHS:
        return lambda v: False, lambda text, i: text
    tanks = tanks if axes == "output" or isinstance(axes, tuple) else range(loop.plant.tanks)
    width = name in WIDTHS
    return is_reading, lambda text, i: level_of(text, spans_of(loop)[tanks[i]], width)


GAINS = ("V/cm", OF_OPENINGS["V/cm"])


def units_of_gain(loop):
    """Units of gains that move a pump, and a valve, by the error of a level."""
    return [local(unit, loop.units) for unit in GAINS]


def _gain(label, text, loop, of_number, output, tank, manipulated):
    """A gain such as "2 %/%" or "3 m3/h/%", per % of the span of the sensor of a tank."""
    match: Any = _GAIN.fullmatch(text.strip())
    low, high = spans_of(loop)[tank]
    plant, bank = loop.plant, loop.actuator
    single = plant.pumps == len(plant.outputs)
    inputs = [output] if single else range(plant.pumps) if len(plant.outputs) == 1 else ()
    inputs = manipulated.inputs[output] if output < len(manipulated.inputs) else inputs
    units = {input_unit(plant, j, loop.units[1]) for j in inputs}
    unit = units.pop() if len(units) == 1 else ""
    size = factor(match["unit"], unit) if unit else None
    if size is None and match["unit"] == "%" and inputs:  # of the range of the loop's output
        ranges = np.subtract(bank.high, bank.low) if manipulated.span is None else manipulated.span
        size = sum(float(ranges[j]) for j in inputs) / 100.0
    if size is None:
        more = f", or {unit}/%" if unit else ""
        raise InputError(
            f"{label} = {shortened(text)}: must be a number [{of_number}], or per %"
            f' of the span of a sensor: "2 %/%"{more}'
        )
    return float(match["number"]) * size * 100.0 / (high - low)


def leaves_of(rows, rims, noise, levels=()):
    """({field of the sensor: its value}, levels without texts) of the rows of [[sensor]]."""
    low, high = np.full(len(rims), -np.inf), np.full(len(rims), np.inf)
    usual = {"noise": list(noise), "scale": [1.0] * len(rims)}
    usual |= {name: [0.0] * len(rims) for name in ("offset", "filter")}
    leaves = {k: v for k, v in usual.items() if k == "noise" or any(k in row for row in rows)}
    for row in rows:
        tank = row["tank"]
        if "span" in row or row["unit"] in ("%", "mA"):
            low[tank], high[tank] = row.get("span", (0.0, rims[tank]))
        for name, values in leaves.items():
            values[tank] = row.get(name, values[tank])
    spans = _spans(low, high, rims)
    level = lambda v, span, width: level_of(v, span, width) if is_reading(v) else v
    numbers = lambda values, width: [level(v, span, width) for v, span in zip(values, spans)]
    leaves = {name: numbers(values, True) for name, values in leaves.items()}
    if np.any(np.isfinite(high)):
        leaves |= {"low": low, "high": high}
    leaves |= _curves(rows, len(rims))
    fields = {n: number(value) for n, value in leaves.items()}
    return fields | _display(rows, len(rims)), numbers(levels, False)


def _display(rows, tanks):
    """{"display": the unit of each reading}; {} where all are of levels."""
    of_log = lambda row: row["unit"] if row["unit"] in ("%", "mA") else row.get("log_unit")
    units = {row["tank"]: unit for row in rows if (unit := of_log(row))}
    return {"display": tuple(units.get(i, "") for i in range(tanks))} if units else {}


def _curves(rows, tanks):
    """{leaf: (n, points)} of the curves of rows, as many points for all; {} of none."""
    points = {row["tank"]: row["curve"] for row in rows if "curve" in row}
    if not points:
        return {}
    curves = [points.get(i, ((0.0, 0.0), (1.0, 1.0))) for i in range(tanks)]
    most = max(map(len, curves))
    points = np.stack([longer(np.array(curve).T, most) for curve in curves], axis=1)
    return dict(zip(("curve_level", "curve_reading"), points))


def longer(values: np.ndarray, count: int) -> np.ndarray:
    """Return (.., count) points of (.., k): more on the line through the last two."""
    steps = np.arange(1, count - values.shape[-1] + 1) * (values[..., -1:] - values[..., -2:-1])
    return np.concatenate([values, values[..., -1:] + steps], axis=-1)


def curve_of(sensor: Any, tank: int) -> list[list[float]] | None:
    """Return the [[level, reading], ...] of the sensor of a tank, None where it reads the level."""
    if getattr(sensor, "curve_level", None) is None:
        return None
    levels, readings = (np.asarray(v[tank]) for v in (sensor.curve_level, sensor.curve_reading))
    same = np.array_equal(levels, readings)
    return None if same else np.column_stack([levels, readings]).tolist()


def with_sensors(loop, rows):
    """Return the loop of a preset with the level sensors of rows of [[sensor]]."""
    for i, row in enumerate(rows):
        if row["name"]:
            raise InputError(
                f"sensor {i + 1}: name = {shortened(row['name'])}: leave it out: only a rig that is"
                " described by [[tank]] has names"
            )
    plant, n = loop.plant, loop.plant.tanks
    noise = np.broadcast_to(loop.sensor.noise, (n,)).tolist()
    leaves, _ = leaves_of(rows, np.broadcast_to(plant.rim, (n,)).tolist(), noise)
    return dataclasses.replace(loop, sensor=dataclasses.replace(loop.sensor, **leaves))


def with_names(names, rows, tanks):
    """Return the names of a plant with those of the sensors of its tanks."""
    each = {row["tank"]: row["name"] for row in rows if row["name"]}
    sensors = tuple(each.get(i, "") for i in range(tanks))
    return (*names, ("sensor", sensors)) if each else names


def sensor_rows(table, tanks):
    """The [[sensor]] tables of a file; those of one [sensor] without kind, for all tanks alike."""
    rows = table.get("sensors", [])
    if not isinstance(rows, Mapping):
        return [_with_unit(row) for row in rows] if isinstance(rows, list) else rows
    rows = {k: v for k, v in _with_unit(rows).items() if k in SECTIONS["sensors"].names}
    of = lambda value, i: value[i] if isinstance(value, list) and len(value) == tanks else value
    each = [{k: v if k == "span" else of(v, i) for k, v in rows.items()} for i in range(tanks)]
    return [{**row, "tank": i + 1} for i, row in enumerate(each)]


def _with_unit(row):
    """A row of [[sensor]] whose unit "4..20 mA" is "mA"."""
    unit = row.get("unit") if isinstance(row, Mapping) else None
    return {**row, "unit": "mA"} if isinstance(unit, str) and _LOOP.fullmatch(unit) else row


def stated_units(table, loop):
    """The unit in which the sensor of each output reads, as a file states it; None: it does not."""
    rows = enumerate(sensor_rows(table, loop.plant.tanks))
    at = lambda row, i: index_of("sensor", loop.plant, "tank", row.get("tank", i + 1))
    units = {at(row, i): row.get("unit") for i, row in rows}
    return [units.get(tank) for tank in loop.plant.outputs]


def check_stated(table, loop):
    """Raise InputError for setpoints and gains without a unit where a sensor reads in % or mA."""
    units = stated_units(table, loop)
    spans, length, problems = spans_of(loop), loop.units[0], []
    of = lambda value: value if isinstance(value, list) else [value] * len(units)

    def refuse(label, i, value, like):
        plain = isinstance(value, (int, float)) and not isinstance(value, bool)
        if plain and 0 <= i < len(units) and units[i] in ("%", "mA"):
            name = label_of(loop.plant, "output", i)
            problems.append(
                f"{label} = {value:g} of {name}, whose sensor reads in {units[i]}: give its unit,"
                f" {' or '.join(like(value, spans[loop.plant.outputs[i]]))}"
            )

    level = lambda v, span: (f'"{v:g} %"', f'"{v:g} {length}"')
    reference, control = table.get("reference", {}), table.get("controller", {})
    of_gain = describe(loop, "controller.Kc")["unit"] if hasattr(loop.controller, "Kc") else ""
    units_of_gain = {"-": ("%/%", f"{length}/{length}"), local("cm^2/s", loop.units): (of_gain,)}
    forms = units_of_gain.get(of_gain, ("%/%", of_gain))
    gain = lambda v, span: [f'"{v:g} {unit}"' for unit in forms]
    stated = [("reference.initial", reference.get("initial"), level)]
    stated += [(f"controller.{key}", control.get(key), level) for key in ("on", "off", "deadband")]
    for label, values, like in (*stated, ("controller.Kc", control.get("Kc"), gain)):
        for i, value in enumerate(of(values)):
            refuse(label, i, value, like)
    for change in reference.get("changes", []):
        if isinstance(change, list) and len(change) == 3:
            i = index_of("reference.changes", loop.plant, "output", change[1])
            refuse("reference.changes", i, change[2], level)
    if problems:
        raise InputError("; ".join(problems))


def complete_rows(rows: list[dict[str, Any]], tanks: int, length: str) -> list[dict[str, Any]]:
    """Return rows of [[sensor]] with their tanks, after input validation."""
    problems: list[str] = []
    for i, row in enumerate(rows):
        if "tank" not in row and len(rows) > 1 and len(rows) != tanks:
            problems.append(f"sensor {i + 1} needs tank: the tank whose level it reads, by name")
        row.setdefault("tank", i)
        row.setdefault("unit", length)
        if row["unit"] not in ("%", "mA", length) and factor(row["unit"], length) is None:
            known = ["%", "mA", *LENGTHS]
            problems.append(str(unknown(f"unit of sensor {i + 1}", row["unit"], known)))
        if row.get("log_unit", "%") not in ("%", "mA"):
            problems.append(
                str(unknown(f"log_unit of sensor {i + 1}", row["log_unit"], ["%", "mA"]))
            )
        if "span" in row and not row["span"][0] < row["span"][1]:
            low, high = row["span"]
            problems.append(
                f"sensor {i + 1}: span = [{low:g}, {high:g}]: must be [level at 0 % (4 mA), level"
                " at 100 % (20 mA)], the first below the second"
            )
    for tank in range(tanks):
        same = [str(i + 1) for i, row in enumerate(rows) if row["tank"] == tank]
        if len(same) > 1:
            problems.append(f"sensors {' and '.join(same)} read one tank: give one of them")
    problems += _turning(rows)
    if problems:
        raise InputError("; ".join(problems))
    return rows


def _turning(rows):
    """What is wrong with the curves of rows of [[sensor]]."""
    curves = ([reading for _, reading in row.get("curve", ())] for row in rows)
    turning = [i for i, curve in enumerate(curves) if np.any(np.diff(curve) <= 0)]
    return [f"sensor {i + 1}: curve: its readings must increase with the level" for i in turning]

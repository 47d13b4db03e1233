"""Quantities of a rig in m, s and shares of an input's range, and a rig file in any units."""

import json
import math
from typing import Any, NamedTuple

import numpy as np

LENGTHS = {"m": 1.0, "cm": 100.0, "mm": 1000.0}
RANGES = {"V": 10.0, "%": 100.0, "mA": 20.0, "-": 1.0, "Hz": 50.0, "rpm": 3000.0}
"""{unit of inputs: full range of a pump}; a valve is full open at 1, or 100 in %."""
FLOWS = {"m^3/h": 3600.0, "L/min": 6e4, "m^3/s": 1.0, "cm^3/s": 1e6}
"""{unit of inputs that are flows: how many are 1 m^3/s}; the full range is a flow of the Style."""


class Q(NamedTuple):
    """A quantity in m^length s^time share^drive, and whether the share is that of a valve."""

    value: Any
    length: int = 0
    time: int = 0
    drive: int = 0
    valve: bool = False


class T(NamedTuple):
    """A tank, written by its name or by its number."""

    index: int
    by_name: bool = True


class Reading(NamedTuple):
    """A level [m] as a reading of its sensor, in % or mA of the span [m]."""

    value: float
    span: tuple
    unit: str = "%"


class Gain(NamedTuple):
    """A gain [share/m] as % of the range of its input [shares] per % of the span [m]."""

    value: float
    span: tuple
    range: float


class PerTank(list):
    """A list with an entry for each tank, in the order of the tanks."""


class Style(NamedTuple):
    """How a rig is written: units, order of its tanks, and seed of texts with units, or None."""

    length: str = "m"
    drive: str = "%"
    order: tuple = ()
    texts: int | None = None
    flow: float = 1.0  # of a pump at the end of its range [m^3/s]

    @property
    def range(self):
        """Full range of a pump in the unit of inputs."""
        return self.flow * FLOWS[self.drive] if self.drive in FLOWS else RANGES[self.drive]


TEXTS = {  # {powers of m and s: {unit: how many of it are one in m and s}}
    (1, 0): {"mm": 1e3, "cm": 100.0, "m": 1.0},
    (2, 0): {"cm^2": 1e4, "mm^2": 1e6, "m2": 1.0},
    (3, 0): {"L": 1e3, "m^3": 1.0, "ml": 1e6},
    (3, -1): {"L/min": 6e4, "m3/h": 3600.0, "cm^3/s": 1e6},
    (0, 1): {"min": 1 / 60.0, "s": 1.0, "h": 1 / 3600.0},
    (0, -1): {"1/min": 60.0, "1/s": 1.0},
}


def number(q, style, rng=None):
    """The TOML of a quantity in the units of a style, at times as a text with a unit."""
    units = TEXTS.get((q.length, q.time))
    units = units if isinstance(q.length, int) and not q.drive else None
    if rng is not None and units and math.isfinite(q.value) and rng.random() < 0.3:
        unit = str(rng.choice(list(units)))
        return f'"{float(q.value) * units[unit]!r} {unit}"'
    full = style.range
    if q.valve:
        full = 100.0 if style.drive == "%" else 1.0
    value = float(q.value) * LENGTHS[style.length] ** q.length * full**q.drive
    return repr(value) if math.isfinite(value) else "inf" if value > 0 else "-inf"


def toml(value, style, rng, names):
    """A value of a rig as TOML."""
    if isinstance(value, Q):
        return number(value, style, rng)
    if isinstance(value, Reading):
        share = (value.value - value.span[0]) / (value.span[1] - value.span[0])
        return f'"{100.0 * share!r} %"' if value.unit == "%" else f'"{4.0 + 16.0 * share!r} mA"'
    if isinstance(value, Gain):
        return f'"{value.value * (value.span[1] - value.span[0]) / value.range!r} %/%"'
    if isinstance(value, T):
        order = style.order or range(len(names))
        return (
            json.dumps(names[value.index])
            if value.by_name
            else str(list(order).index(value.index) + 1)
        )
    if isinstance(value, PerTank):
        value = [value[i] for i in style.order or range(len(value))]
    single = isinstance(value, list) and len(value) == 1 and isinstance(value[0], Q)
    if single and rng is not None and rng.random() < 0.3:  # one number for an array of one
        return number(value[0], style, rng)
    if isinstance(value, list):
        return "[" + ", ".join(toml(v, style, rng, names) for v in value) + "]"
    if isinstance(value, dict):
        rows = (f"{json.dumps(k)} = {toml(v, style, rng, names)}" for k, v in value.items())
        return "{" + ", ".join(rows) + "}"
    return json.dumps(value)


def spelled(rig, rng):
    """The rig with some older names of tables, and its clock in a table of its own."""
    if rng is None:
        return rig
    names = {"controller": "law", "inflow": "pour"} if rng.random() < 0.15 else {}
    rig = {names.get(title, title): rows for title, rows in rig.items()}
    if rng.random() < 0.3:
        values = rig.pop("values")
        clock = {k.removeprefix("clock."): v for k, v in values.items() if "clock" in k}
        rig |= {"clock": clock, "values": {k: v for k, v in values.items() if "clock" not in k}}
    return rig


def text(rig, style):
    """The rig file of a rig in a style."""
    rng = None if style.texts is None else np.random.default_rng(style.texts)
    names = [tank["name"] for tank in rig["tank"]]
    lines = [f'units = ["{style.length}", "{style.drive}"]']
    if "reachable" in rig:
        lines.append(f"reachable = {json.dumps(rig['reachable'])}")
    rig = spelled(rig, rng)
    for title, rows in rig.items():
        if title in ("reachable", "units", "files"):
            continue
        many = isinstance(rows, list)
        if title == "tank":
            rows = [rows[i] for i in style.order or range(len(rows))]
        for row in rows if many else [rows]:
            lines += ["", f"[[{title}]]" if many else f"[{title}]"]
            for key, value in row.items():
                key = json.dumps(key) if "." in key else key
                lines.append(f"{key} = {toml(value, style, rng, names)}")
    return "\n".join(lines) + "\n"

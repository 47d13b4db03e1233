"""The numbers of a loop as sliders: name, unit, value, sensible ends, group."""

import math
from typing import Any

import numpy as np

from jaxtank.case import Case, Free
from jaxtank.core.tree import describe, get_value

GROUPS = {
    "controller": "controller",
    "observer": "observer",
    "sensor": "sensor",
    "actuator": "pumps",
    "plant": "plant",
    "reference": "reference",
    "disturbance": "disturbance",
    "faults": "disturbance",
    "safety_filter": "safety filter",
    "x0": "initial",
}
"""{first part of a dotted name: group of its slider}."""

WIDE = {"controller": (0.2, 5.0), "observer": (0.2, 5.0), "plant": (0.5, 1.5), "pumps": (0.5, 1.5)}
"""{group: ends of a slider as multiples of a value that has no bounds}; (0, 2) of the others."""
ABOVE = 1e-3
"""Lower end of a slider above a lower bound that is excluded, as a share of the range [-]."""
NOISE = 0.02
"""Upper end of the sliders of noise, as a share of the height of the tanks [-]."""


def leaf_of(case: Case, name: str, index: tuple[int, ...]) -> dict[str, Any]:
    """Return the slider of one number of a loop, as a JSON object."""
    full = f"{name}[{','.join(map(str, index))}]" if index else name
    meta = describe(case.loop, full)
    value = float(np.asarray(get_value(case.loop, full)))
    group = GROUPS.get(name.split(".")[0], name.split(".")[0])
    if ".model." in name:
        group = "model"
    lower, upper = _ends(case, name, full, value, meta, group)
    return {
        "name": full,
        "unit": meta["unit"],
        "doc": meta["doc"],
        "value": value if math.isfinite(value) else None,
        "lower": lower,
        "upper": upper,
        "group": group,
    }


def _ends(case, name, full, value, meta, group):
    """(lower, upper) of a slider: the bounds of a search, else around the value."""
    for key in (full, name):
        if key in case.free:
            low, high, _ = Free(*case.free[key])
            return min(low, value), max(high, value)
    rim = np.asarray(case.loop.plant.rim, dtype=float)
    height = float(np.max(rim[np.isfinite(rim)], initial=0.0)) or 1.0
    if name == "sensor.noise":
        low, high = 0.0, max(NOISE * height, 2.0 * value)
    elif group in ("reference", "initial") and meta["unit"] == case.loop.units[0]:
        low, high = 0.0, max(height, value)
    elif value == 0.0:
        low, high = 0.0, 1.0
    else:
        least, most = WIDE.get(group, (0.0, 2.0))
        low, high = sorted((least * value, most * value))
    if meta["low"] is not None:
        low = max(low, float(meta["low"]))
        if meta.get("strict") and low <= float(meta["low"]):  # an end that is not allowed itself
            low = float(meta["low"]) + ABOVE * (high - float(meta["low"]))
    if meta["high"] is not None:
        high = min(high, float(meta["high"]))
    return min(low, value), max(high, value)

"""Coordinates of a fit: logarithms of positive parameters, branch gains of pumps that feed two
tanks, and shares of the range for the rest.
"""

import dataclasses
from typing import Any, cast

import jax.numpy as jnp
import numpy as np

from jaxtank.core.tree import get_value, split_index
from jaxtank.signals.base import Constant


@dataclasses.dataclass(frozen=True)
class Coordinates:
    """The coordinates p of the scalars to be estimated, as a hashable description."""

    # items: ("log", name, low, high) with value exp(p); ("linear", name, low, high) with value low
    # + p (high - low); ("branch", gain, split, (low, high) of both branches): p = (log c1, log c2),
    # c1 = k s and c2 = k (1 - s) the gains of a pump's two branches, in which the inflows are
    # linear (mirakhorli notes S11), gain k = c1 + c2, split s = c1 / (c1 + c2).

    items: tuple

    @property
    def names(self):
        """(size,) dotted name of the value of each coordinate; of a branch, gain then split."""
        return tuple(
            n for kind, *rest in self.items for n in (rest[:2] if kind == "branch" else rest[:1])
        )

    @property
    def pairs(self):
        """((i, i + 1), ...): coordinates that are the two branches of one pump."""
        found, i = [], 0
        for kind, *_ in self.items:
            if kind == "branch":
                found.append((i, i + 1))
                i += 1
            i += 1
        return tuple(found)

    @property
    def size(self):
        """Number of coordinates [-]."""
        return len(self.names)

    @property
    def box(self):
        """(low (size,), high (size,)) of the coordinates."""
        pairs = []
        for kind, *rest in self.items:
            if kind == "branch":
                pairs += [tuple(np.log(b)) for b in rest[2]]
            else:
                pairs.append((0.0, 1.0) if kind == "linear" else (np.log(rest[1]), np.log(rest[2])))
        return (
            tuple(np.array(side, dtype=float) for side in zip(*pairs))
            if pairs
            else (np.zeros(0), np.zeros(0))
        )

    def values(self, p):
        """Return {name: value} at coordinates p (size,), of numpy or jax."""
        exp = np.exp if isinstance(p, np.ndarray) else jnp.exp
        found, i = {}, 0
        for kind, *rest in self.items:
            if kind == "log":
                found[rest[0]] = exp(p[i])
            elif kind == "linear":
                found[rest[0]] = rest[1] + p[i] * (rest[2] - rest[1])
            else:
                first, second = exp(p[i]), exp(p[i + 1])
                found[rest[0]], found[rest[1]] = first + second, first / (first + second)
                i += 1
            i += 1
        return found

    def point(self, values):
        """Return (size,) coordinates of {name: value}, projected onto the bounds."""
        p = []
        for kind, *rest in self.items:
            if kind == "log":
                p.append(np.log(max(values[rest[0]], 1e-300)))
            elif kind == "linear":
                p.append((values[rest[0]] - rest[1]) / (rest[2] - rest[1]))
            else:
                gain, split = values[rest[0]], np.clip(values[rest[1]], 1e-9, 1 - 1e-9)
                p += [np.log(gain * split), np.log(gain * (1 - split))]
        return np.clip(np.array(p, dtype=float), *self.box)

    def slopes(self, p):
        """Return (size, size) derivatives of the values, ordered as `names`, by the coordinates."""
        out, i = np.zeros((self.size, self.size)), 0
        for kind, *rest in self.items:
            if kind == "log":
                out[i, i] = np.exp(p[i])
            elif kind == "linear":
                out[i, i] = rest[2] - rest[1]
            else:
                first, second = np.exp(p[i]), np.exp(p[i + 1])
                share = first / (first + second)
                out[i, i : i + 2] = first, second
                out[i + 1, i : i + 2] = share * (1 - share), -share * (1 - share)
                i += 1
            i += 1
        return out


def coordinates(bounds, branches=True):
    """Return the Coordinates of a list of tuning.problem.bounds.Bound."""
    by_name = {b.name: b for b in bounds} if branches else {}
    items, done = [], set()
    for b in bounds:
        if b.name in done:
            continue
        base, index = split_index(b.name)
        split = f"plant.split[{index[0]}]" if base == "plant.pump_gain" and index else None
        if split in by_name:
            s = by_name[split]
            low, high = max(s.low, 1e-6), min(s.high, 1 - 1e-6)
            items.append(
                (
                    "branch",
                    b.name,
                    split,
                    ((b.low * low, b.high * high), (b.low * (1 - high), b.high * (1 - low))),
                )
            )
            done |= {b.name, split}
        elif base == "plant.split" and f"plant.pump_gain[{index[0]}]" in by_name:
            continue  # comes with its gain
        else:
            items.append((b.scale, b.name, b.low, b.high))
            done.add(b.name)
    return Coordinates(tuple(items))


def default_free(loop):
    """Return {name: (low, high, scale)}: the default unknowns of an identification."""
    # Pump gains, splits between two tanks, open orifices, pipes, the captured share of an overflow
    # and a constant disturbance; not areas, which are measured with a ruler.
    plant, found = loop.plant, {}
    for name in ("pump_gain", "drain", "orifice", "pipe"):
        values = np.asarray(getattr(plant, name, ()))
        for i, value in enumerate(np.ravel(values)):
            if value > 0:
                found[f"plant.{name}[{i}]"] = (float(value) / 10, float(value) * 10, "log")
    feeds = cast(Any, getattr(plant, "feeds", ()))
    for j, (_, second) in enumerate(feeds):
        if second is not None:
            found[f"plant.split[{j}]"] = (0.02, 0.98, "linear")
    if getattr(plant, "overflow", False):
        found |= {f"plant.caught[{k}]": (0.0, 1.0, "linear") for k in range(len(plant.spills))}
    if isinstance(loop.disturbance, Constant):
        for i, value in enumerate(np.asarray(loop.disturbance.level)):
            if value != 0:
                found[f"disturbance.level[{i}]"] = (
                    -10 * abs(float(value)),
                    10 * abs(float(value)),
                    "linear",
                )
    return found


def nominal(loop, names):
    """Return {name: value} of a loop as floats."""
    return {name: float(np.asarray(get_value(loop, name))) for name in names}


def specification(loop, free):
    """Return {name: (low, high, scale)} of `free`: logarithmic by default above 0."""
    if free is None:
        return default_free(loop)
    return {n: (*v, "log" if v[0] > 0 else "linear")[:3] for n, v in free.items()}

"""A run for people: arrays with one row per saved sample, as text, table, JSON, CSV, pictures."""

import dataclasses
import functools
import io
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from jaxtank.core.jsonable import clean
from jaxtank.core.labels import Labels, input_unit, label_of, symbol
from jaxtank.core.text import count, csv_line
from jaxtank.core.units import DEFAULT, local
from jaxtank.views import TrajectoryViews

FIELDS = (
    ("h", "x", "cm"),
    ("y", "y", "cm"),
    ("h_hat", "x_hat", "cm"),
    ("r", "r", "cm"),
    ("u", "u", "V"),
    ("command", "command", "V"),
    ("applied", "applied", "V"),
    ("spilled", "spilled", "cm^3"),
    ("d_hat", "d_hat", "cm/s"),
    ("share", "share", "-"),
)
"""Columns of a run: (name, field of `Trajectory`, unit)."""

COLUMNS = (*("t", "x", "y", "x_hat", "d_hat", "r", "e"), *("command", "applied", "u", "spilled"))
"""The fields of a `Trajectory` that are arrays."""


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=(*COLUMNS, "share", "modes", "coefficients"),
    meta_fields=("units", "labels", "mode_names", "coefficient_names"),
)
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Trajectory(TrajectoryViews):
    """A run for people: row k is the state at t_k, before the plant moves on.

    Lengths are in the first of `units`, inputs in the second; "cm" and "V" stand for them here.

    Parameters
    ----------
    t : (rows,) array
        Time [s].
    x, y, x_hat : (rows, tanks) arrays
        Levels, measured levels, estimated levels [cm].
    d_hat : (rows, tanks) array
        Estimated disturbance of each level's rate [cm/s]: all that the observer's model does not
        explain, inflows, errors of the model, and what an offset dead zone of a pump withholds.
    r, e : (rows, outputs) arrays
        Setpoints, and tracking errors x - r [cm].
    command, applied, u : (rows, pumps) arrays
        What the controller asked for, that within the limits, and what the pumps run at over
        [t_k, t_k + dt) [V].
    spilled : (rows, tanks) array
        Volume lost over each rim since the start [cm^3].
    units : (length, pump input)
    labels : the names of tanks and pumps
    share : (rows, pumps) array or None
        If the controller blends two, the share of the first one in each input [-]; the share of
        sliding mode for `FuzzyBlend`.
    modes : (rows, 2 modes) array or None
        Of a `FaultBank`, the probability of each fault [-], then the size it has if it is there.
    mode_names : ((name, unit of the size, "" without one), ...) of these faults; () without a bank
    coefficients : (rows, coefficients) array or None
        Estimates of the entries of the model that the observer estimates.
    coefficient_names : ((name, unit), ...) of these entries, such as ("drain[0]", "cm^2")

    Examples
    --------
    >>> import jaxtank
    >>> from jaxtank import presets
    >>> loop = presets.load("cascaded/open-loop").loop
    >>> run = jaxtank.simulate(loop, jaxtank.Clock(dt=4.0, duration=8.0))
    >>> print(str(run).splitlines()[0])
    run from 0 to 8 s: 3 rows, 2 tanks, 1 pump
    >>> run.to_json()["t"]
    [0.0, 4.0, 8.0]
    """

    t: jax.Array
    x: jax.Array
    y: jax.Array
    x_hat: jax.Array
    d_hat: jax.Array
    r: jax.Array
    e: jax.Array
    command: jax.Array
    applied: jax.Array
    u: jax.Array
    spilled: jax.Array
    units: tuple[str, str] = DEFAULT
    labels: Labels | None = None
    share: Any = None
    modes: Any = None
    mode_names: tuple[tuple[str, str], ...] = ()
    coefficients: Any = None
    coefficient_names: tuple[tuple[str, str], ...] = ()

    def replace(self, **changes: Any) -> "Trajectory":
        """Return a copy with the named fields changed."""
        return dataclasses.replace(self, **changes)

    def to_json(self) -> dict[str, Any]:
        """Return a JSON object: each array as lists of rows, its unit in `units`; null for what is
        not finite.
        """
        units = {"t": "s", "e": local("cm", self.units), "applied": local("V", self.units)}
        units |= {field: local(unit, self.units) for _, field, unit in FIELDS}
        names = [*COLUMNS, *(["share"] if self.share is not None else [])]
        result: dict[str, Any] = {"units": {name: units[name] for name in names}}
        result |= {name: clean(getattr(self, name)) for name in names}
        for k, (name, unit) in enumerate(self.coefficient_names):
            values = clean(np.asarray(self.coefficients)[..., k])
            result.setdefault("coefficients", {})[name] = {"values": values, "unit": unit}
        return result | ({"diagnosis": self.diagnosis} if self.mode_names else {})

    @property
    def diagnosis(self) -> list[dict[str, Any]]:
        """Faults that a `FaultBank` named, one for each time in which no fault is improbable."""
        count, episodes = len(self.mode_names), list[dict[str, Any]]()
        if not count:
            return episodes
        t, (p, sizes) = np.asarray(self.t), np.split(np.asarray(self.modes), [count], axis=1)
        faulty = np.flatnonzero(p[:, 0] < 0.5)
        for rows in np.split(faulty, np.flatnonzero(np.diff(faulty) > 1) + 1):
            if len(rows):
                k = 1 + int(np.argmax(p[rows, 1:].sum(axis=0)))
                best, (name, unit) = rows[p[rows, k] >= 0.5], self.mode_names[k]
                size = float(sizes[best if len(best) else rows, k][-1])
                episodes.append(
                    {
                        "fault": name,
                        "from_s": float(t[rows[0]]),
                        "to_s": float(t[rows[-1]]),
                        "probability": float(p[rows, k].mean()),
                        "size": size if unit else None,
                        "unit": unit,
                    }
                )
        return episodes

    def __str__(self) -> str:
        if np.ndim(self.t) != 1 or isinstance(self.t, Tracer):
            return "Trajectory of several runs, or of a traced one"
        ends = f"run from {float(self.t[0]):g} to {float(self.t[-1]):g} s"
        sizes = {"row": len(self.t), "tank": np.shape(self.x)[1], "pump": np.shape(self.u)[1]}
        lines = [f"{ends}: {', '.join(count(n, word) for word, n in sizes.items())}"]
        for name, *numbers in self._summary():
            lines.append(f"  {name}: from {numbers[0]} to {numbers[1]}, at the end {numbers[2]}")
        return "\n".join(lines)

    def __repr__(self) -> str:
        return str(self)

    def _summary(self) -> list[list[str]]:
        """Rows (what and its unit, least, most, last) of levels, errors and inputs."""
        length, drive = self.units
        rows: list[list[str]] = []
        fields = {"x": ("level", "tank"), "e": ("error", "output"), "u": ("input", "pump")}
        for field, (words, kind) in fields.items():
            for i, column in enumerate(np.asarray(getattr(self, field)).T):
                unit = input_unit(self.labels, i, drive) if field == "u" else length
                numbers = (column.min(), column.max(), column[-1])
                head = f"{words} of {label_of(self.labels, kind, i)} [{unit}]"
                rows.append([head, *(f"{v:.5g}" for v in numbers)])
        return rows


def columns(
    run: Trajectory, units: tuple[str, str] = DEFAULT, dimension: str | None = None
) -> dict[str, Any]:
    """Return the columns of a run, for pandas or xarray: "h1", or "h_LT101" of named tanks."""
    table: dict[tuple[str, str], Any] = {("t", "s"): np.asarray(run.t)}
    for name, field, unit in FIELDS:
        values = getattr(run, field)
        if values is None or (field == "applied" and np.array_equal(run.applied, run.u)):
            continue
        kind = {"share": "pump", "r": "output"}.get(name, "pump" if unit == "V" else "tank")
        for i, column in enumerate(np.asarray(values).T):
            of_entry = input_unit(run.labels, i, units[1]) if unit == "V" else local(unit, units)
            table[symbol(run.labels, name, kind, i), of_entry] = column
    for k, (name, _) in enumerate(run.mode_names):
        table[f"probability of {name}", "-"] = np.asarray(run.modes)[:, k]
    for k, (name, unit) in enumerate(run.coefficient_names):
        table[f"estimate of {name}", unit] = np.asarray(run.coefficients)[:, k]
    if dimension is None:
        return {f"{name} [{unit}]": values for (name, unit), values in table.items()}
    return {
        dimension if name == "t" else name: (dimension, values, {"units": unit})
        for (name, unit), values in table.items()
    }


def stride(samples: int, rows: int = 3000) -> int:
    """Return the distance of saved samples that leaves about `rows` of them."""
    # It is odd, so that a pump that chatters from sample to sample is not drawn as one that is
    # constant, and ends at the end where it can.
    steps = samples - 1
    least = max(1, steps // rows)
    return next((k for k in range(least, 2 * least + 1) if k % 2 and steps % k == 0), least | 1)


def csv(run: Trajectory, units: tuple[str, str] = DEFAULT) -> str:
    """Return a trajectory as CSV with units in the header."""
    hidden = ("h_hat",) if np.asarray(run.d_hat).any() else ("h_hat", "d_hat")
    table = {n: v for n, v in columns(run, units).items() if not n.startswith(hidden)}
    out = io.StringIO()
    out.write(csv_line(table))
    np.savetxt(out, np.column_stack(list(table.values())), delimiter=",", fmt="%.10g")
    return out.getvalue()

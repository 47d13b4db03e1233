"""Pictures of runs: levels, errors and inputs over time.

Each function draws on given matplotlib axes and returns them; `responses` makes a whole figure. The
pictures of searches, sensitivities and many runs can be taken from here too, as notebooks do.
"""

import itertools
import textwrap
from typing import Any

import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.plots.effects import BARS, elementary, panels, shares, tornado
from jaxtank.plots.overview import NAMED, worst
from jaxtank.plots.search import contours, convergence, curve
from jaxtank.plots.spills import above_rim, spill_note, spilled
from jaxtank.plots.style import (
    AFTER,
    BEFORE,
    FORBIDDEN,
    OTHER,
    PUMPS,
    REFERENCE,
    RUNS,
    STYLE,
    beside,
    for_print,
    grid,
    height,
    hide,
    plain,
    printing,
    styled,
    width,
)
from jaxtank.plots.uncertainty import cloud, fan, violations

__all__ = [
    "AFTER",
    "BARS",
    "BEFORE",
    "FORBIDDEN",
    "OTHER",
    "PUMPS",
    "REFERENCE",
    "RUNS",
    "STYLE",
    "cloud",
    "contours",
    "convergence",
    "curve",
    "elementary",
    "error",
    "fan",
    "for_print",
    "level",
    "panels",
    "plain",
    "responses",
    "shares",
    "styled",
    "tornado",
    "violations",
    "voltage",
]

COLUMNS = 4
"""Panels beside each other."""

SHOWN = 16
"""Tanks between, outputs and pumps that are drawn each; of more, those that matter."""


def _example() -> Any:
    """A run of one tank and one pump, for the examples."""
    from jaxtank.loop.trajectory import COLUMNS, Trajectory

    t = np.linspace(0.0, 10.0, 11)
    column = (t / 10.0)[:, None]
    arrays: dict[str, Any] = dict.fromkeys(COLUMNS, column) | {"t": t}
    return Trajectory(**arrays)


def level(ax, trajectories, tank, output=None, rim=None, limit=None, unit="cm", spills=None):
    """Draw the level of one tank, with its setpoint, rim and limit."""
    for name, (run, colour, style) in trajectories.items():
        ax.plot(
            run.t, run.x[:, tank], color=colour, linestyle=style, linewidth=1.4, label=plain(name)
        )
    last = next(iter(trajectories.values()))[0]
    if output is not None:
        ax.plot(
            last.t,
            last.r[:, output],
            color=REFERENCE,
            linestyle=":",
            linewidth=1.2,
            label="setpoint",
        )
    highest = max(float(np.max(run.x[:, tank])) for run, _, _ in trajectories.values())
    # a rim far above all levels would only compress the picture
    for bound, name in ((rim, "rim"), (limit if limit != rim else None, "limit")):
        if bound is not None and (highest > 0.6 * bound):
            top = max(highest * 1.03, bound * 1.05)
            ax.axhspan(bound, top, color=FORBIDDEN, alpha=0.18, linewidth=0)
            ax.axhline(bound, color=FORBIDDEN, linewidth=1.0, label=f"{name} {bound:g} {unit}")
            ax.set_ylim(top=top)
    ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]) if output is None else None)
    ax.set(title=f"tank {tank + 1}{above_rim(ax, trajectories, tank, rim, spills)}")
    ax.set_ylabel(f"level [{unit}]")
    return ax


def voltage(ax, trajectories, pump, low, high, unit="V"):
    """Draw the input of one pump; what lies outside its limits is shaded."""
    for name, (run, colour, style) in trajectories.items():
        ax.plot(
            run.t, run.u[:, pump], color=colour, linestyle=style, linewidth=1.2, label=plain(name)
        )
    ax.set(title=f"pump {pump + 1}", ylabel=f"input [{unit}]" if unit != "V" else "voltage [V]")
    lowest, highest = (
        f([f(run.u[:, pump]) for run, _, _ in trajectories.values()]) for f in (np.min, np.max)
    )
    if highest - lowest < 0.1 * (high - low):  # limits far away are not shown
        return ax
    margin = 0.06 * (high - low)
    ax.axhspan(low - margin, low, color=FORBIDDEN, alpha=0.18, linewidth=0)
    ax.axhspan(high, high + margin, color=FORBIDDEN, alpha=0.18, linewidth=0)
    ax.set_ylim(low - margin, high + margin)
    return ax


def error(ax, trajectories, output, tank, unit="cm"):
    """Draw the tracking error of one output."""
    for name, (run, colour, style) in trajectories.items():
        ax.plot(
            run.t, run.e[:, output], color=colour, linestyle=style, linewidth=1.2, label=plain(name)
        )
    ax.axhline(0.0, color=REFERENCE, linewidth=0.8, linestyle=":")
    ax.set(title=f"tracking error of tank {tank + 1}", ylabel=f"h - r [{unit}]")
    return ax


def responses(loop, trajectories, title="", limits=None):
    """Return a figure of a run, or of several in the same panels."""
    if not trajectories:
        raise InputError("trajectories = {}: there is no run to draw")
    drawn = {
        name: (run, *style)
        for (name, run), style in zip(trajectories.items(), styles_of(trajectories))
    }
    others, note = _other_tanks(loop, trajectories)
    outputs, pumps, more = _worst_outputs(loop, trajectories)
    rows, note = _rows(loop, drawn, (outputs, pumps, others), limits), note + more
    note += spill_note(loop.plant, trajectories)
    columns = max(len(row) for row in rows)
    wide = width(max(4.6 * columns, 6.4))
    with styled():
        high = height(2.05 * len(rows) + 0.5, len(rows))
        figure, axes = grid(len(rows), columns, (wide, high), sharex=True)
        for row, line in zip(rows, axes):
            for draw, ax in zip(row, line):
                draw(ax)
            hide(line[len(row) :])
        for column in axes.T:
            last = [ax for ax in column if ax.get_visible()][-1]
            last.set_xlabel("time [s]")
            last.tick_params(labelbottom=True)
        _legend(figure, axes, wide)
        lines = ("" if printing() else title) + note  # a journal has captions
        figure.suptitle(
            "\n".join(
                plain(textwrap.fill(line, int(12 * wide))) for line in lines.strip().splitlines()
            ),
            fontsize=None if printing() else 10,
        )
    return figure


def styles_of(trajectories):
    """(colour, line style) of each run."""
    if len(trajectories) == 1:
        return [(AFTER, "-")]
    count = len(RUNS)
    colours = zip(range(len(trajectories)), itertools.cycle(RUNS))
    return [(colour, RUNS[(i + i // count) % count][1]) for i, (colour, _) in colours]


def _other_tanks(loop, trajectories):
    """(tanks besides the outputs, at most SHOWN, a line of the title on those left out)."""
    others = [i for i in range(loop.plant.tanks) if i not in loop.plant.outputs]
    if len(others) <= SHOWN:
        return others, ""
    near = {
        i: max(float(np.max(run.x[:, i])) for run in trajectories.values()) / _at(loop.plant.rim, i)
        for i in others
    }
    note = f"\nof the {len(others)} tanks between, the {SHOWN} that come nearest to their rims"
    return sorted(sorted(others, key=near.__getitem__)[-SHOWN:]), note


def _worst_outputs(loop, trajectories):
    """([(output, its tank)], pumps, a line of the title on those left out): of many, the outputs
    with the largest errors and the pumps that move most.
    """
    outputs, pumps = list(enumerate(loop.plant.outputs)), list(range(loop.plant.pumps))
    note = ""
    if len(outputs) > SHOWN:
        off = [np.sqrt(np.mean(run.e**2, axis=0)) for run in trajectories.values()]
        note += f"\nof {len(outputs)} outputs, the {NAMED} with the largest errors"
        outputs = [outputs[k] for k in worst(np.max(off, axis=0))]
    if len(pumps) > SHOWN:
        moved = [np.sum(np.abs(np.diff(run.u, axis=0)), axis=0) for run in trajectories.values()]
        note += f"\nof {len(pumps)} pumps, the {NAMED} that move most"
        pumps = worst(np.max(moved, axis=0))
    return outputs, pumps, note


def _rows(loop, drawn, which, limits):
    """Rows of functions that draw one panel each, of (outputs, pumps, other tanks)."""
    (outputs, pumps, others), (length, drive) = which, loop.units
    rims, low, high = loop.plant.rim, loop.actuator.low, loop.actuator.high
    lost = {name: spilled(loop.plant, run) for name, (run, *_) in drawn.items()}

    def level_of(i, k=None):
        return lambda ax: level(ax, drawn, i, k, _at(rims, i), _at(limits, i), length, lost)

    def error_of(i, k):
        return lambda ax: error(ax, drawn, k, i, length)

    def voltage_of(j):
        return lambda ax: voltage(ax, drawn, j, float(low[j]), float(high[j]), drive)

    kinds = [
        [level_of(i, k) for k, i in outputs],
        [error_of(i, k) for k, i in outputs],
        [level_of(i) for i in others],
        [voltage_of(j) for j in pumps],
    ]
    most = beside(COLUMNS)
    return [row[i : i + most] for row in kinds for i in range(0, len(row), most)]


def _legend(figure, axes, width):
    """One legend for all panels, with each label once."""
    handles = {}
    for ax in axes.flat:
        for handle, label in zip(*ax.get_legend_handles_labels()):
            handles.setdefault(label, handle)
    columns = len(handles) if len(handles) <= 6 else max(4, round(width / 2))
    columns = min(columns, max(2, round(width)))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns)


def _at(array, i) -> Any:
    return None if array is None else float(np.asarray(array)[i])

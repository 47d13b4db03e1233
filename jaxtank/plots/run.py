"""Pictures that a `Trajectory` and a `Case` draw of themselves, and figures as PNG bytes."""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from jaxtank.core.files import write_folder
from jaxtank.core.units import local
from jaxtank.plots.layout import place
from jaxtank.plots.overview import LARGEST, size, worst
from jaxtank.plots.responses import SHOWN
from jaxtank.plots.schematic import schematic
from jaxtank.plots.spills import amount, spilled
from jaxtank.plots.style import RUNS, TALLEST, WIDTHS, for_print, label_time, picture, plain, styled

SOFTWARE = {"Software": None}  # metadata of a PNG file: the same on all machines
SMALL = 62  # pixels per inch of the small picture that a notebook shows below a result


def figures(run: Any) -> dict[str, Any]:
    """Return {"run": figure} of a Trajectory alone: levels, setpoints, errors and inputs."""
    length, drive = run.units
    colours = [colour for colour, _ in RUNS]
    lost = float(np.sum(np.asarray(run.spilled)[-1]))
    spilled = f", {amount(lost, local('cm^3', run.units))} over the rims" if lost > 0 else ""
    groups = [
        (f"levels{spilled}", "h", run.x, length),
        ("setpoints", "r", run.r, length),
        ("tracking errors", "e", run.e, length),
        ("inputs", "u", run.u, drive),
    ]

    def draw(axes):
        for ax, (title, symbol, values, unit) in zip(axes, groups):
            columns, note = range(values.shape[1]), ""
            if len(columns) > SHOWN:  # the range of all, and those that go highest
                columns = worst(np.max(np.abs(values), axis=0))
                note = f": range of {values.shape[1]}, and the {len(columns)} largest"
                low, high = values.min(axis=1), values.max(axis=1)
                ax.fill_between(run.t, low, high, color="0.85", linewidth=0)
            for k, i in enumerate(columns):
                colour, style = colours[k % len(colours)], "-" if k < len(colours) else "--"
                ax.plot(run.t, values[:, i], style, color=colour, label=f"{symbol}{i + 1}")
            ax.set(title=title + note, ylabel=f"[{unit}]")
            # beside the lines
            ax.legend(ncols=1 + (len(columns) > 6), loc="upper left", bbox_to_anchor=(1.0, 1.0))
        label_time(axes[-1])

    return {"run": picture(draw, (6.4, 7.5), len(groups), sharex=True)}


def rig(plant: Any, run: Any = None, title: str = "") -> dict[str, Any]:
    """Return {"rig": drawing of a network of tanks, as at the end of a Trajectory}, else {}."""
    if not hasattr(plant, "links"):
        return {}
    if plant.tanks > LARGEST:
        extent = size(plant.tanks)
    else:
        where = place(plant)
        wide, high = where.right - where.left, where.top - where.bottom
        extent = (4.8, min(7.0, 4.8 * high / wide + 0.35))
    with styled():
        figure = plt.figure(figsize=extent)
        ax = figure.add_axes((0.01, 0.01, 0.98, 0.89))
        if run is not None and np.all(np.isfinite(run.x[-1])):
            schematic(ax, plant, run.x[-1], run.r[-1], run.spilled[-1] if plant.overflow else None)
            above = spilled(plant, run)
            title = f"{title}\n{above.words()}" if above.any else title
        else:
            schematic(ax, plant)
        ax.set_title(plain(title))
    return {"rig": figure}


def png(figure: Any) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, format="png", metadata=SOFTWARE)
    plt.close(figure)
    return out.getvalue()


def for_journal(drawings: Mapping[str, Any], columns: int = 1) -> dict[str, bytes]:
    """Return {file name: bytes} of {name: figure} as SVG and PNG for a journal; closes them."""
    # Figures that `style.for_print` has not made are scaled to that width.
    files: dict[str, bytes] = {}
    for name, figure in drawings.items():
        wide, high = figure.get_size_inches()
        scale = WIDTHS[columns] / wide
        figure.set_size_inches(WIDTHS[columns], min(high * max(scale, 0.6), TALLEST))
        for kind, metadata in (("svg", {"Date": None, "Creator": None}), ("png", SOFTWARE)):
            out = io.BytesIO()
            # the same bytes for the same figure
            with for_print(columns), styled({"svg.hashsalt": name}):
                figure.savefig(out, format=kind, metadata=metadata)
            files[f"{name}.{kind}"] = out.getvalue()
        plt.close(figure)
    return files


def save_for_print(drawings: Mapping[str, Any], folder: str | Path, columns: int = 1) -> list[Path]:
    """Write {name: figure} to a folder as `for_journal` makes them, all or none; return paths."""
    # `result.plot()` inside `style.for_print(columns)` makes the figures
    with for_print(columns):  # which refuses other numbers
        return write_folder(folder, for_journal(drawings, columns))


def small(drawings: Mapping[str, Any]) -> bytes | None:
    """Return the first of {name: figure} as PNG bytes of about half its size; all are closed."""
    out, first = io.BytesIO(), next(iter(drawings.values()), None)
    if first is not None:
        first.savefig(out, format="png", dpi=SMALL, metadata=SOFTWARE)
    for figure in drawings.values():
        plt.close(figure)
    return None if first is None else out.getvalue()


def pngs(drawings: Mapping[str, Any]) -> dict[str, bytes]:
    """Return {file name: PNG bytes} of {name: figure}; the figures are closed."""
    return {f"{name}.png": png(figure) for name, figure in drawings.items()}

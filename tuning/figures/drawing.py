"""A figure of a paper drawn by our runs, with a caption."""

import io
import textwrap
from typing import Any, NamedTuple, cast

import jax
import numpy as np

from jaxtank import presets, rig
from jaxtank.case import Case
from jaxtank.controllers.fuzzy import membership
from jaxtank.core.errors import InputError
from jaxtank.core.labels import label_of, units_of_inputs
from jaxtank.core.units import local
from jaxtank.loop.trajectory import Trajectory
from tuning.figures.figure import Figure
from tuning.problem.scenarios import noisy
from tuning.report.simulated import run_for_people
from tuning.report.tables import number

SHARE = 0.5  # share from which the first of two blended controllers counts as the one at work [-]
FORMATS = ("svg", "png", "pdf")  # file formats of a figure
WIDTH, LINE = (92, 122), 0.17  # characters of a caption's line, its height [inch]


class Drawn(NamedTuple):
    """The runs of a figure: {label: (case, trajectory)}, and sentences on their results."""

    runs: dict[str, tuple[Case, Trajectory]]
    ours: tuple[str, ...]


def run(figure: Figure) -> Drawn:
    """Return the runs of a figure; the noise has seed 0."""
    runs = {}
    for variant in figure.runs:
        case = rig.set_values(presets.find(variant.case), dict(variant.values))
        runs[variant.label] = case, run_for_people(case, jax.random.key(0) if noisy(case) else None)
    kinds = figure.kind.split()
    facts = {n: _facts(kinds, case, trajectory, figure) for n, (case, trajectory) in runs.items()}
    ours = [f"{label}: {'; '.join(texts)}" for label, texts in facts.items() if texts]
    return Drawn(runs, tuple(ours))


def _facts(kinds, case, trajectory, figure):
    """The drawn quantities of a run, in numbers."""
    length, drive = case.loop.units[0], units_of_inputs(case.loop.plant)
    facts, tanks = [], list(figure.tanks or range(case.loop.plant.tanks))
    outputs = [j for j, tank in enumerate(case.loop.plant.outputs) if tank in tanks]
    if "levels" in kinds or "errors" in kinds:
        errors = np.sqrt(np.mean(np.asarray(trajectory.e) ** 2, axis=0))
        facts.append(f"RMS error {_several(errors[outputs])} {length}")
    if "levels" in kinds:
        facts.append(f"error at the end {_several(np.asarray(trajectory.e)[-1][outputs])} {length}")
        facts.append(f"highest level {_several(np.max(trajectory.x, axis=0)[tanks])} {length}")
    if "inputs" in kinds:
        low, high = np.min(trajectory.u, axis=0), np.max(trajectory.u, axis=0)
        spans = [f"{number(a, 3)} to {number(b, 3)}" for a, b in zip(low, high)]
        facts.append(f"inputs from {' and '.join(spans)} {drive}")
    if "estimates" in kinds:
        rate = local("cm/s", case.loop.units)
        facts.append(f"median {_several(np.median(trajectory.d_hat, axis=0), 4)} {rate}")
        facts.append(f"at most {_several(np.max(trajectory.d_hat, axis=0))} {rate}")
    if "shares" in kinds:
        time = 100.0 * np.mean(np.asarray(trajectory.share) > SHARE, axis=0)
        facts.append(f"sliding mode has the larger share in {_several(time)} % of the time")
    return facts


def _several(values, digits=3):
    return " and ".join(number(round(float(v), 6), digits) for v in np.ravel(values))


def caption(figure: Figure, ours: tuple[str, ...]) -> list[str]:
    """Return the paragraphs below a figure: content and statements of the paper, our results."""
    texts = [f"{figure.paper}, figure {figure.number}. {figure.shows}."]
    texts += [f"The paper: {figure.states}"] if figure.states else []
    texts += [f"Here: {'; '.join(ours)}."] if ours else []
    return [*texts, *([figure.remark] if figure.remark else [])]


def draw(figure: Figure, content: Drawn) -> Any:
    from matplotlib.figure import Figure as Blank

    from jaxtank.plots.responses import label_times
    from jaxtank.plots.style import add_legend, hide, styled

    panels = [
        panel for kind in figure.kind.split() for panel in _panels(kind, figure, content.runs)
    ]
    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    width = WIDTH[columns - 1]
    lines = [line for text in caption(figure, content.ours) for line in textwrap.wrap(text, width)]
    high, low = 2.3 * rows + 0.5, LINE * len(lines) + 0.15
    with styled():
        whole = Blank(figsize=(4.2 * columns if columns > 1 else 6.4, high + low))
        upper, lower = cast(Any, whole.subfigures(2, 1, height_ratios=[high, low]))
        whole.set_layout_engine("constrained")
        axes = upper.subplots(rows, columns, squeeze=False, sharex="memberships" not in figure.kind)
        for panel, ax in zip(panels, axes.flat):
            panel(ax)
            if figure.window:
                ax.set_xlim(*figure.window)
        hide(axes.flat[len(panels) :])
        if "memberships" not in figure.kind:
            label_times(axes)
        add_legend(upper, lambda _: 4)
        lower.text(0.02, 1.0, "\n".join(lines), va="top", ha="left", fontsize=8, linespacing=1.35)
    return whole


def _panels(kind, figure, runs):
    """Functions that draw one panel each on an axis."""
    from jaxtank.plots import diagnostics, responses

    case, first = next(iter(runs.values()))
    lines = responses.with_looks({label: trajectory for label, (_, trajectory) in runs.items()})
    loop, plant, (length, drive) = case.loop, case.loop.plant, case.loop.units
    outputs, rate = {tank: j for j, tank in enumerate(plant.outputs)}, local("cm/s", loop.units)
    rims = np.broadcast_to(np.asarray(plant.rim, dtype=float), (plant.tanks,))
    rims = [float(v) if np.isfinite(v) else None for v in rims]
    low, high = (np.asarray(end, float) for end in (loop.actuator.low, loop.actuator.high))
    tanks, pumps, of = range(plant.tanks), range(plant.pumps), {"unit": length, "plant": plant}
    panels: dict[str, Any] = {
        "levels": (
            lambda ax, i: responses.level(ax, lines, i, outputs.get(i), rims[i], **of),
            figure.tanks or tanks,
        ),
        "errors": (lambda ax, i: responses.error(ax, lines, outputs[i], i, **of), outputs),
        "inputs": (
            lambda ax, j: responses.voltage(ax, lines, j, low[j], high[j], drive, plant),
            pumps,
        ),
        "estimates": (
            lambda ax, i: diagnostics.disturbance(ax, first, i, unit=rate, plant=plant),
            tanks,
        ),
        "shares": (lambda ax, j: diagnostics.share(ax, first, j, plant=plant), pumps),
        "setpoints": (lambda ax, _: _setpoints(ax, case, first), range(1)),
        "memberships": (lambda ax, i: _memberships(ax, loop.controller, i, length), range(2)),
    }
    draw, places = panels[kind]
    return [lambda ax, i=i: draw(ax, i) for i in places]


def _setpoints(ax, case, trajectory):
    for j, tank in enumerate(case.loop.plant.outputs):
        name = f"setpoint of {label_of(case.loop.plant, 'tank', tank)}"
        ax.plot(trajectory.t, trajectory.r[:, j], linewidth=1.4, label=name)
    ax.set(ylabel=f"level [{case.loop.units[0]}]", title="setpoints")


def _memberships(ax, law, i, unit):
    b, w = float(law.b[i]), float(law.w[i])
    size = np.linspace(0.0, 2.0 * (b + w), 200)
    high = np.asarray(membership(size, b, w))
    ax.plot(size, 1.0 - high, linewidth=1.4, label="low: state feedback")
    ax.plot(size, high, linewidth=1.4, linestyle="--", label="high: sliding mode")
    ax.set(xlabel=f"size of the error [{unit}]", ylabel="membership [-]")
    ax.set_title(f"memberships of input {i + 1}")


def rendered(figure: Any, name: str) -> bytes:
    """Return a matplotlib figure as the bytes of a file, by the end of its name."""
    import matplotlib

    check_name(name)
    kind, out = name.rpartition(".")[2].lower(), io.BytesIO()
    dated = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind)
    with matplotlib.rc_context({"svg.hashsalt": "jaxtank"}):
        figure.savefig(out, format=kind, dpi=200, metadata=dated)
    return out.getvalue()


def check_name(name: str) -> None:
    """Raise InputError for a file name with an end that is none of FORMATS."""
    if name.rpartition(".")[2].lower() not in FORMATS or "." not in name:
        raise InputError(f"--out {name}: must end in {', '.join('.' + f for f in FORMATS)}")

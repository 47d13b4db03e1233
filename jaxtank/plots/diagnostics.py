"""Pictures of phase planes, saturation, estimates, margins and trade-offs, on given axes."""

import numpy as np

from jaxtank.core.labels import label_of, labels_of
from jaxtank.plots.style import (
    AFTER,
    BEFORE,
    BEYOND,
    FORBIDDEN,
    OTHER,
    REFERENCE,
    label_time,
    plain,
)

SLICES = 240  # intervals of time in a strip of `saturation`
MANY = 16  # largest number of limits in a picture of margins: those with the smallest margins


def phase(ax, runs, tanks, rims=None, unit="cm", plant=None):
    """Draw the level of one tank over that of another; dots at the start, squares at the end."""
    across, up = tanks
    for name, (run, colour, style) in runs.items():
        h = np.asarray(run.x)[:, [across, up]].T
        ax.plot(*h, color=colour, linestyle=style, linewidth=1.1, label=plain(name))
        for row, marker in ((0, "o"), (-1, "s")):
            ax.plot(*h[:, row], marker, color=colour, markersize=4)
    for tank, span, limit in ((across, ax.axvspan, ax.set_xlim), (up, ax.axhspan, ax.set_ylim)):
        top = max(float(np.max(run.x[:, tank])) for run, _, _ in runs.values())
        if rims is not None and top > 0.6 * float(rims[tank]):
            end = max(1.05 * float(rims[tank]), 1.03 * top)
            span(float(rims[tank]), end, **BEYOND, label="past a rim")
            limit(None, end)
    names = [plain(label_of(plant, "tank", tank)) for tank in tanks]
    ax.set(xlabel=f"level of {names[0]} [{unit}]", ylabel=f"level of {names[1]} [{unit}]")
    ax.set_title(plain(labels_of(plant, "tank", tanks)).replace(", ", " and "))


def saturation(ax, runs, low, high, plant=None):
    """Draw when each pump was commanded past its limits, in a strip per pump and run."""
    names, heights = [], []
    colours = (("past the upper limit", AFTER, 1), ("past the lower limit", BEFORE, -1))
    for j in range(len(low)):
        for k, (name, run) in enumerate(runs.items()):
            y = -(j * (len(runs) + 0.4) + k)
            heights.append(y)
            command, t = np.asarray(run.command)[:, j], np.asarray(run.t)
            masks = command > float(high[j]), command < float(low[j])
            up, down = (f"{100 * mask.mean():.3g} %" for mask in masks)
            of = f", {plain(name)}" if len(runs) > 1 else ""
            names.append(f"{plain(label_of(plant, 'pump', j))}{of}\n{up} up, {down} down")
            ax.axhline(y, color="0.7", linewidth=0.8)
            count = min(SLICES, len(t))
            edges = np.linspace(t[0], t[-1], count + 1)
            index = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, count - 1)
            samples = np.maximum(np.bincount(index, minlength=count), 1)
            for mask, (_, colour, sign) in zip(masks, colours):
                share = np.bincount(index, mask, count) / samples
                end = y + sign * 0.42 * np.append(share, share[-1])
                ax.fill_between(edges, y, end, step="post", color=colour, linewidth=0)
    for label, colour, _ in colours:
        ax.fill_between([], [], color=colour, label=label)
    ax.set_yticks(heights, names)
    ax.grid(False, axis="y")
    ax.set(title="commands that the pumps could not follow")
    label_time(ax)
    ax.set_ylim(min(heights) - 0.6, max(heights) + 0.6)


def estimate(ax, run, tank, unit="cm", plant=None):
    """Draw the estimate of one level, with the measured and the true one."""
    if np.any(run.y[:, tank] != run.x[:, tank]):
        dots = {"color": "0.75", "markersize": 1.5, "rasterized": True, "label": "measured"}
        ax.plot(run.t, run.y[:, tank], ".", **dots)
    ax.plot(run.t, run.x[:, tank], color=REFERENCE, linewidth=1.3, label="true")
    ax.plot(run.t, run.x_hat[:, tank], "--", color=AFTER, linewidth=1.2, label="estimated")
    ax.set(title=plain(label_of(plant, "tank", tank)), ylabel=f"level [{unit}]")


def coefficient(ax, run, k, true=None):
    """Draw the estimate of one coefficient of the model, with the plant's own value."""
    name, unit = run.coefficient_names[k]
    if true is not None:
        ax.axhline(true, color=REFERENCE, linewidth=1.3, label="true")
    ax.plot(run.t, run.coefficients[:, k], "--", color=AFTER, linewidth=1.2, label="estimated")
    ax.set(title=plain(name), ylabel=f"estimate [{unit}]")


def disturbance(ax, run, tank, inflow=None, unit="cm/s", plant=None):
    """Draw the estimated disturbance of one level's rate, which holds all model errors."""
    if inflow is not None:
        ax.plot(run.t, inflow, color=REFERENCE, linewidth=1.3, label="inflow disturbance")
    style = "-" if inflow is None else "--"
    ax.plot(run.t, run.d_hat[:, tank], style, color=AFTER, linewidth=1.1, label="estimated")
    ax.axhline(0.0, color="0.6", linewidth=0.8, linestyle=":")
    ax.set(title=f"disturbance of {plain(label_of(plant, 'tank', tank))}", ylabel=f"d_hat [{unit}]")


def share(ax, run, pump, plant=None):
    """Draw the share of two blended controllers in one input."""
    first = run.share[:, pump]
    ax.fill_between(run.t, 0.0, first, color=BEFORE, alpha=0.55, linewidth=0, label="sliding mode")
    ax.fill_between(run.t, first, 1.0, color=AFTER, alpha=0.35, linewidth=0, label="state feedback")
    ax.set(title=f"input of {plain(label_of(plant, 'pump', pump))}", ylabel="share [-]")
    ax.set_ylim(0.0, 1.0)
    ax.margins(x=0.0)


def margins(ax, rows):
    """Draw the margin of each limit as a share of it, the smallest at the top."""
    shares = np.array([100.0 * r["margin"] / (abs(r["limit"]) or 1.0) for r in rows])
    order = np.argsort(shares, kind="stable")[:MANY]
    y, shares, more = np.arange(len(order)), shares[order], len(rows) - len(order)
    ax.barh(y, shares, color=np.where(shares < 0, FORBIDDEN, AFTER), height=0.62)
    short = np.abs(shares) < max(0.1, 0.005 * np.max(np.abs(shares), initial=0.0))
    met = np.flatnonzero((shares >= 0) & short)  # bars too short to be seen
    ax.plot(np.zeros(len(met)), met, "|", color=AFTER, markersize=11, markeredgewidth=3)
    unit = lambda r: "" if r["unit"] == "-" else f" {r['unit']}"
    amount = lambda r: f"{r['value']:.5g} of {r['limit']:.5g}{unit(r)}"
    words = lambda r: plain(getattr(r, "words", "") or r["name"])  # rows of a file have no words
    ax.set_yticks(y, [f"{words(rows[i])}\n{amount(rows[i])}" for i in order])
    ax.invert_yaxis()
    ax.axvline(0.0, color=REFERENCE, linewidth=0.8)
    ax.grid(False, axis="y")
    ax.set_axisbelow(True)
    hidden = f"; {more} with larger margins not shown" if more else ""
    ax.set(xlabel="margin, share of the limit [%]", title=f"margin of each limit{hidden}")


def tradeoff(ax, points, measure, unit, cost_unit):
    """Draw the best objective over the limit of a measure; crosses: none that holds it."""
    points = sorted(points, key=lambda p: p["limit"])

    def plot(some, marker, **look):
        ax.plot([p["limit"] for p in some], [p["objective"] for p in some], marker, **look)

    plot([p for p in points if p["status"] != "infeasible"], "-", color=AFTER, linewidth=1.3)
    for status, marker, colour, label in (
        ("converged", "o", AFTER, "converged"),
        ("not_converged", "s", OTHER, "not converged"),
        ("infeasible", "x", FORBIDDEN, "limit cannot be held"),
    ):
        if some := [p for p in points if p["status"] == status]:
            plot(some, marker, color=colour, markersize=5, label=label)
    ax.set(xlabel=plain(f"limit of {measure} [{unit}]"), ylabel=f"objective [{cost_unit}]")
    ax.set_title("objective against limit")
    ax.legend()

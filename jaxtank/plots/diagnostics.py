"""Pictures of phase planes, saturation, estimates, margins and trade-offs.

Each function draws on given matplotlib axes and returns them.
"""

import numpy as np

from jaxtank.plots.style import AFTER, BEFORE, FORBIDDEN, OTHER, REFERENCE, plain

SLICES = 240
"""Intervals of time in a strip of `saturation`."""


def phase(ax, trajectories, tanks, rims=None, unit="cm"):
    """Draw the level of one tank over that of another; dots at the start, squares at the end."""
    across, up = tanks
    for name, (run, colour, style) in trajectories.items():
        h = np.asarray(run.x)
        ax.plot(
            h[:, across], h[:, up], color=colour, linestyle=style, linewidth=1.1, label=plain(name)
        )
        ax.plot(h[0, across], h[0, up], "o", color=colour, markersize=4)
        ax.plot(h[-1, across], h[-1, up], "s", color=colour, markersize=4)
    for tank, span, side in ((across, ax.axvspan, 1), (up, ax.axhspan, 0)):
        top = max(float(np.max(run.x[:, tank])) for run, _, _ in trajectories.values())
        if rims is not None and top > 0.6 * float(rims[tank]):
            rim = float(rims[tank])
            end = max(1.05 * rim, 1.03 * top)
            span(
                rim,
                end,
                color=FORBIDDEN,
                alpha=0.18,
                linewidth=0,
                label="past a rim" if side or across == up else None,
            )
            (ax.set_xlim if side else ax.set_ylim)(None, end)
    ax.set(
        title=f"tanks {across + 1} and {up + 1}",
        xlabel=f"level of tank {across + 1} [{unit}]",
        ylabel=f"level of tank {up + 1} [{unit}]",
    )
    return ax


def saturation(ax, runs, low, high):
    """Draw when each pump was commanded past its limits, in a strip per pump and run."""
    names, heights = [], []
    for j in range(len(low)):
        for k, (name, run) in enumerate(runs.items()):
            y = -(j * (len(runs) + 0.4) + k)
            heights.append(y)
            command, t = np.asarray(run.command)[:, j], np.asarray(run.t)
            over, under = command > float(high[j]), command < float(low[j])
            names.append(
                "pump"
                f" {j + 1}{f', {plain(name)}' if len(runs) > 1 else ''}\n{_percent(over.mean())}"
                f" up, {_percent(under.mean())} down"
            )
            ax.axhline(y, color="0.7", linewidth=0.8)
            for mask, sign, colour in ((over, 1, AFTER), (under, -1, BEFORE)):
                edges, share = _slices(t, mask)
                ax.fill_between(
                    edges,
                    y,
                    y + sign * 0.42 * np.append(share, share[-1]),
                    step="post",
                    color=colour,
                    linewidth=0,
                )
    for colour, label in ((AFTER, "past the upper limit"), (BEFORE, "past the lower limit")):
        ax.fill_between([], [], color=colour, label=label)
    ax.set_yticks(heights, names)
    ax.grid(False, axis="y")
    ax.set(
        xlabel="time [s]",
        title="commands that the pumps could not follow",
        ylim=(min(heights) - 0.6, max(heights) + 0.6),
    )
    return ax


def _percent(share):
    return f"{100 * share:.3g} %"


def _slices(t, mask):
    """(edges of intervals [s], share of each in which the mask holds)."""
    count = min(SLICES, len(t))
    edges = np.linspace(t[0], t[-1], count + 1)
    index = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, count - 1)
    return edges, np.bincount(index, mask, count) / np.maximum(
        np.bincount(index, minlength=count), 1
    )


def estimate(ax, run, tank, unit="cm"):
    """Draw the estimate of one level, with the measured and the true one."""
    if np.any(run.y[:, tank] != run.x[:, tank]):
        ax.plot(
            run.t,
            run.y[:, tank],
            ".",
            color="0.75",
            markersize=1.5,
            label="measured",
            rasterized=True,
        )
    ax.plot(run.t, run.x[:, tank], color=REFERENCE, linewidth=1.3, label="true")
    ax.plot(
        run.t, run.x_hat[:, tank], color=AFTER, linewidth=1.2, linestyle="--", label="estimated"
    )
    ax.set(title=f"tank {tank + 1}", ylabel=f"level [{unit}]")
    return ax


def disturbance(ax, run, tank, inflow=None, unit="cm/s"):
    """Draw the estimated disturbance of one level's rate, which holds all model errors."""
    if inflow is not None:
        ax.plot(run.t, inflow, color=REFERENCE, linewidth=1.3, label="inflow disturbance")
    ax.plot(
        run.t,
        run.d_hat[:, tank],
        color=AFTER,
        linewidth=1.1,
        linestyle="-" if inflow is None else "--",
        label="estimated",
    )
    ax.axhline(0.0, color="0.6", linewidth=0.8, linestyle=":")
    ax.set(title=f"disturbance of tank {tank + 1}", ylabel=f"d_hat [{unit}]")
    return ax


def share(ax, run, pump, of=("sliding mode", "state feedback")):
    """Draw the share of two blended controllers, named in `of`, in one input; returns the axes."""
    first = run.share[:, pump]
    ax.fill_between(run.t, 0.0, first, color=BEFORE, alpha=0.55, linewidth=0, label=of[0])
    ax.fill_between(run.t, first, 1.0, color=AFTER, alpha=0.35, linewidth=0, label=of[1])
    ax.set(title=f"input of pump {pump + 1}", ylabel="share [-]", ylim=(0.0, 1.0))
    ax.margins(x=0.0)
    return ax


MANY = 16
"""Limits in a picture of margins at most: those with the smallest margins."""


def margins(ax, rows):
    """Draw the margin of each limit as a share of it, the smallest at the top."""
    shares = [100.0 * r["margin"] / (abs(r["limit"]) or 1.0) for r in rows]
    order = np.argsort(shares, kind="stable")[:MANY]
    y = np.arange(len(order))
    ax.barh(
        y,
        [shares[i] for i in order],
        color=[FORBIDDEN if shares[i] < 0 else AFTER for i in order],
        height=0.62,
    )
    met = [k for k, i in enumerate(order) if 0 <= shares[i] < 0.1]  # bars too short to be seen
    ax.plot(np.zeros(len(met)), met, "|", color=AFTER, markersize=11, markeredgewidth=3)
    ax.set_yticks(
        y,
        [
            f"{plain(rows[i]['name'])}\n{rows[i]['value']:.5g} of {rows[i]['limit']:.5g}"
            f" {rows[i]['unit']}"
            for i in order
        ],
    )
    ax.invert_yaxis()
    ax.axvline(0.0, color=REFERENCE, linewidth=0.8)
    ax.grid(False, axis="y")
    ax.set_axisbelow(True)
    more = (
        f"; {len(rows) - len(order)} with larger margins not shown"
        if len(rows) > len(order)
        else ""
    )
    ax.set(xlabel="margin, share of the limit [%]", title=f"margin of each limit{more}")
    return ax


def tradeoff(ax, points, measure, unit, cost_unit):
    """Draw the best objective over the limit of a measure; crosses: none that holds it
    was found.
    """
    points = sorted(points, key=lambda p: p["limit"])
    kept = [p for p in points if p["status"] != "infeasible"]
    ax.plot(
        [p["limit"] for p in kept], [p["objective"] for p in kept], "-", color=AFTER, linewidth=1.3
    )
    for status, marker, colour, label in (
        ("converged", "o", AFTER, "converged"),
        ("not_converged", "s", OTHER, "not converged"),
        ("infeasible", "x", FORBIDDEN, "limit cannot be held"),
    ):
        found = [p for p in points if p["status"] == status]
        if found:
            ax.plot(
                [p["limit"] for p in found],
                [p["objective"] for p in found],
                marker,
                color=colour,
                markersize=5,
                label=label,
            )
    ax.set(
        xlabel=f"limit of {measure} [{unit}]",
        ylabel=f"objective [{cost_unit}]",
        title="objective against limit",
    )
    ax.legend()
    return ax

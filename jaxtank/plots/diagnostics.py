"""Pictures of what lies behind a run and its limits: one function each, drawn on given matplotlib
axes and returning them.
"""

import numpy as np

from jaxtank.plots.style import AFTER, BEFORE, FORBIDDEN, OTHER, REFERENCE, plain

SLICES = 240
"""Slices of time in the strips of `saturation`; each is as dark as the share of it that was spent
at a limit.
"""


def phase(ax, trajectories, tanks, rims=None, unit="cm"):
    """Level of one tank over that of another [unit], one line per {name: (Trajectory, colour,
    style)}; dots where they begin, squares where
    they end. tanks: (across, up); rims: (tanks,) [unit], what lies past them shaded where a line
        comes near.
    """
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
    """When each pump was commanded past its limits: a strip per pump and run, up for the upper
    limit, down for the lower, as tall as the share of each slice of time; the shares of the whole
    run beside it. runs: {name: Trajectory}; low, high: (pumps,) [rig's unit].
    """
    names, places = [], []
    for j in range(len(low)):
        for k, (name, run) in enumerate(runs.items()):
            y = -(j * (len(runs) + 0.4) + k)
            places.append(y)
            asked, t = np.asarray(run.command)[:, j], np.asarray(run.t)
            over, under = asked > float(high[j]), asked < float(low[j])
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
    for colour, words in ((AFTER, "past the upper limit"), (BEFORE, "past the lower limit")):
        ax.fill_between([], [], color=colour, label=words)
    ax.set_yticks(places, names)
    ax.grid(False, axis="y")
    ax.set(
        xlabel="time [s]",
        title="commands that the pumps could not follow",
        ylim=(min(places) - 0.6, max(places) + 0.6),
    )
    return ax


def _percent(share):
    return f"{100 * share:.3g} %"


def _slices(t, mask):
    """(edges [s], share of each slice of time in which the mask holds)."""
    count = min(SLICES, len(t))
    edges = np.linspace(t[0], t[-1], count + 1)
    index = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, count - 1)
    return edges, np.bincount(index, mask, count) / np.maximum(
        np.bincount(index, minlength=count), 1
    )


def estimate(ax, run, tank, unit="cm"):
    """What the observer believes of one level, over what is measured and what is true [unit], over
    time [s].
    """
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
    """Estimated disturbance of one level's rate [unit] over time [s], which lumps all that the
    observer's model leaves out, and what flows in
    unasked, inflow: (rows,) [unit], where it is known.
    """
    if inflow is not None:
        ax.plot(run.t, inflow, color=REFERENCE, linewidth=1.3, label="disturbing inflow")
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


MANY = 16
"""Limits in a picture of margins at most: those with the least room."""


def margins(ax, rows):
    """How far each limit is off, as a share of it [%], the nearest at the top; broken ones to the
    left of zero.

    rows: dicts with name, limit, value, margin, unit, as `TuningResult.constraints` gives them.
    """
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
    more = f"; {len(rows) - len(order)} with more room not shown" if len(rows) > len(order) else ""
    ax.set(xlabel="room left, share of the limit [%]", title=f"room to each limit{more}")
    return ax


def tradeoff(ax, points, measure, unit, cost_unit):
    """The least objective [cost_unit] over the limit of `measure` [unit]; crosses: no point was
    found that keeps it.

    points: dicts with limit, status ("converged", "not_converged", "infeasible") and objective, as
        `tuning.tradeoff` gives them.
    """
    points = sorted(points, key=lambda p: p["limit"])
    kept = [p for p in points if p["status"] != "infeasible"]
    ax.plot(
        [p["limit"] for p in kept], [p["objective"] for p in kept], "-", color=AFTER, linewidth=1.3
    )
    for status, marker, colour, words in (
        ("converged", "o", AFTER, "converged"),
        ("not_converged", "s", OTHER, "not converged"),
        ("infeasible", "x", FORBIDDEN, "limit cannot be kept"),
    ):
        mine = [p for p in points if p["status"] == status]
        if mine:
            ax.plot(
                [p["limit"] for p in mine],
                [p["objective"] for p in mine],
                marker,
                color=colour,
                markersize=5,
                label=words,
            )
    ax.set(
        xlabel=f"limit of {measure} [{unit}]",
        ylabel=f"objective [{cost_unit}]",
        title="what the limit costs",
    )
    ax.legend()
    return ax

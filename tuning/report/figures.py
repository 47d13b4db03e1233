"""Figures of what lies behind a run: the rig, its upper tanks and its pumps, the observer, the
limits.
"""

import sys

import numpy as np

from jaxtank.core.text import one_line
from jaxtank.core.units import local


def failed(name, error, *figures):
    """Report on stderr that the picture `name` could not be drawn, and close its figures."""
    import matplotlib.pyplot as plt

    for figure in figures:
        plt.close(figure)
    print(
        f"jaxtank: note: {name} could not be drawn ({type(error).__name__}:"
        f" {one_line(error, 200)})",
        file=sys.stderr,
    )


def rig(loop, run=None, title=""):
    """Return {"rig": schematic of the loop's plant, filled as at the end of `run`}."""
    from jaxtank.plots.run import rig

    return rig(loop.plant, run, title)


def inner(loop, runs):
    """Return {"inner": phase plot of the first two tanks that are not controlled}, {} without."""
    import matplotlib.pyplot as plt

    from jaxtank.plots import diagnostics, responses

    tanks = [i for i in range(loop.plant.tanks) if i not in loop.plant.outputs]
    if len(tanks) < 2:
        return {}
    styles = (
        [(responses.AFTER, "-")]
        if len(runs) == 1
        else [(responses.BEFORE, "--"), (responses.AFTER, "-")]
    )
    drawn = {name: (run, *style) for (name, run), style in zip(runs.items(), styles)}
    with responses.styled():
        figure, ax = plt.subplots(figsize=(5.0, 4.0), layout="constrained")
        diagnostics.phase(ax, drawn, tanks[:2], np.asarray(loop.plant.rim), loop.units[0])
        figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return {"inner": figure}


def saturation(loop, runs):
    """Return {"saturation": when each pump was commanded beyond its limits}; {} where none was."""
    import matplotlib.pyplot as plt

    from jaxtank.plots import diagnostics, responses

    low, high = (np.asarray(v, dtype=float) for v in (loop.actuator.low, loop.actuator.high))
    if not any(np.any(run.command > high) or np.any(run.command < low) for run in runs.values()):
        return {}
    with responses.styled():
        figure, ax = plt.subplots(
            figsize=(6.4, 1.4 + 0.62 * len(runs) * loop.plant.pumps), layout="constrained"
        )
        diagnostics.saturation(ax, runs, low, high)
        figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return {"saturation": figure}


def estimates(loop, clock, run, title=""):
    """Return {"estimates": levels and disturbances as the observer estimated them}."""
    # {} where the controller takes the levels as they are measured.
    import matplotlib.pyplot as plt

    from jaxtank.plots import diagnostics, responses

    tanks, disturbed = loop.plant.tanks, bool(np.any(run.d_hat))
    if not disturbed and np.array_equal(run.x_hat, run.y):
        return {}
    length = loop.units[0]
    known = None
    if loop.disturbance is not None and not callable(loop.plant.area):
        index = np.clip(np.rint(np.asarray(run.t) / clock.dt).astype(int), 0, clock.samples - 1)
        known = np.stack(
            [np.asarray(d)[index] for d in loop.disturbance.sample(clock)[0]], axis=1
        ) / np.asarray(loop.plant.area)
    rows = 2 if disturbed else 1
    with responses.styled():
        figure, axes = plt.subplots(
            rows,
            tanks,
            figsize=(max(6.4, 3.2 * tanks), 2.3 * rows + 0.5),
            sharex=True,
            squeeze=False,
            layout="constrained",
        )
        for i in range(tanks):
            diagnostics.estimate(axes[0, i], run, i, length)
            if disturbed:
                inflow = None if known is None else known[:, i]
                diagnostics.disturbance(axes[1, i], run, i, inflow, local("cm/s", loop.units))
            axes[-1, i].set_xlabel("time [s]")
        handles = {}
        for ax in axes[:, 0]:
            handles |= dict(
                zip(ax.get_legend_handles_labels()[1], ax.get_legend_handles_labels()[0])
            )
        figure.legend(
            handles.values(), handles.keys(), loc="outside lower center", ncols=len(handles)
        )
        figure.suptitle(responses.plain(title), fontsize=10)
    return {"estimates": figure}


def shares(run, title=""):
    """Return {"shares": share of two blended controllers in each input}; {} without any."""
    import matplotlib.pyplot as plt

    from jaxtank.plots import diagnostics, responses

    if run.share is None:
        return {}
    pumps = run.share.shape[1]
    with responses.styled():
        figure, axes = plt.subplots(
            1, pumps, figsize=(max(6.4, 3.2 * pumps), 2.9), squeeze=False, layout="constrained"
        )
        for j, ax in enumerate(axes[0]):
            diagnostics.share(ax, run, j)
            ax.set_xlabel("time [s]")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=2)
        figure.suptitle(responses.plain(title), fontsize=10)
    return {"shares": figure}


def margins(rows):
    """Return {"margins": margin to every limit}; {} where there are none."""
    import matplotlib.pyplot as plt

    from jaxtank.plots import diagnostics, responses

    if not rows:
        return {}
    with responses.styled():
        figure, ax = plt.subplots(
            figsize=(6.4, 0.9 + 0.42 * min(len(rows), diagnostics.MANY)), layout="constrained"
        )
        diagnostics.margins(ax, rows)
    return {"margins": figure}


def tradeoff(found, unit, cost_unit):
    """Return {"tradeoff": least objective over a limit}; {} where `found` is None."""
    import matplotlib.pyplot as plt

    from jaxtank.plots import diagnostics, responses

    if not found:
        return {}
    with responses.styled():
        figure, ax = plt.subplots(figsize=(6.0, 3.6), layout="constrained")
        diagnostics.tradeoff(ax, found["points"], found["measure"], unit, cost_unit)
    return {"tradeoff": figure}

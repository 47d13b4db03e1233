"""Figures of an Identification: fit, residuals, correlation of the estimates, profile
likelihood.
"""

import numpy as np

from jaxtank.plots import fit as plots
from jaxtank.plots import responses
from tuning.identification import residuals

CAPTIONS = {
    "fit": "Measured readings (dots), the fitted rig (line), and the inputs of the pumps.",
    "residuals": (
        "Residuals of the fitted rig: over time, and their autocorrelation. What lies beyond the"
        " band is not noise."
    ),
    "correlation": (
        "Correlation of the estimates: near 1 or -1, the data determine a combination of the two"
        " better than each."
    ),
    "profile": (
        "Increase of the misfit when one parameter is fixed away from its estimate and all others"
        " are fitted again."
    ),
    "rig": "The rig, drawn from its own topology; a heavier outline is a tank that is controlled.",
}


def figures(found):
    """Return {name: matplotlib Figure}: "fit" (or "fit_1", ..), "residuals", "correlation", .."""
    est = found.estimation
    simulated = est.predicted(est.unknowns(found.fit))
    with responses.styled():
        count = len(est.logs)
        names = ["fit"] if count == 1 else [f"fit_{e + 1}" for e in range(count)]
        drawn = {name: _fit(found, e, simulated[e]) for e, name in enumerate(names)}
        drawn["residuals"] = _residuals(found)
        if len(found.correlation[0]) > 1:
            drawn["correlation"] = _correlation(found)
        if found.profile:
            figure, ax = _figure((5.2, 3.4))
            plots.profile(ax, found.profile)
            drawn["profile"] = _titled(figure, found, "profile likelihood")
    return drawn


def _figure(size, rows=1, columns=1, **more):
    """Return (figure, axes) of matplotlib."""
    import matplotlib.pyplot as plt

    return plt.subplots(rows, columns, figsize=size, layout="constrained", **more)


def _titled(figure, found, title):
    """Return the figure with the case's name and a title."""
    figure.suptitle(responses.plain(f"{found.case.name}: {title}"), fontsize=9)
    return figure


def _fit(found, e, simulated):
    """Return the figure of log e: readings, simulated (samples, channels), and inputs."""
    est, channels = found.estimation, found.channels
    log, rows = est.logs[e], len(channels) + 1
    n, validated = log.samples, found.validation and found.validation["samples"][e]
    begin = log.t[validated] if found.validation and validated < n else None
    figure, axes = _figure((7.0, 1.0 + 1.7 * rows), rows, sharex=True)
    for c, (name, unit) in enumerate(channels):
        plots.measured(axes[c], log.t, est.data.y[e, :n, c], simulated[:n, c], name, unit, begin)
    axes[0].legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=3)
    plots.inputs(axes[-1], log.t, log.u, found.case.loop.units[1])
    if log.u.shape[1] > 1:
        axes[-1].legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=log.u.shape[1])
    figure.align_ylabels(axes)
    return _titled(figure, found, f"{log.name}, measured and simulated with the fitted rig")


def _residuals(found):
    """Return the figure of the residuals over time and their autocorrelation."""
    est, channels = found.estimation, found.channels
    left, log = residuals.residuals_of(est, found.fit), est.logs[0]
    rows = len(channels)
    figure, axes = _figure((8.4, 0.9 + 1.9 * rows), rows, 2, squeeze=False)
    for c, (name, unit) in enumerate(channels):
        r, noise = left[..., c], found.quality["noise"][c]
        plots.residual(axes[c, 0], log.t, r[0, : log.samples], name, unit, noise)
        acf = residuals.autocorrelation(r)
        plots.autocorrelation(axes[c, 1], acf, int(np.isfinite(r).sum()), name)
        for ax in axes[c] if c < rows - 1 else ():
            ax.set_xlabel("")
    for ax in axes[0]:
        ax.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98))
    figure.align_ylabels(axes)
    several = (
        f" (the first of {len(est.logs)} logs; correlations of all)" if len(est.logs) > 1 else ""
    )
    return _titled(figure, found, f"measured less simulated{several}")


def _correlation(found):
    """Return the figure of the correlation of the estimates."""
    names, matrix = found.correlation
    side = 2.6 + 0.42 * len(names)
    figure, ax = _figure((side + 1.0, side))
    plots.correlation(ax, names, matrix)
    return _titled(figure, found, "correlation of the estimates")

"""Pictures of a fit to a record: one function each, drawn on given matplotlib axes and returning
them.
"""

import numpy as np

from jaxtank.plots.style import AFTER, BEFORE, FORBIDDEN, OTHER, REFERENCE


def measured(ax, t, y, told, name, unit, held_from=None):
    """A reading y (samples,) and what the fitted rig says, told (samples,), over time t (samples,)
    [s]; the part not used in the first fit, from held_from [s] on, is shaded.
    """
    ax.plot(t, y, ".", color=BEFORE, markersize=2.0, label="measured")
    ax.plot(t, told, color=AFTER, linewidth=1.2, label="simulated")
    if held_from is not None:
        ax.axvspan(
            held_from, t[-1], color=OTHER, alpha=0.08, linewidth=0, label="held back at first"
        )
    ax.set(ylabel=f"{name} [{unit}]", xlim=(t[0], t[-1]))
    return ax


def inputs(ax, t, u, unit):
    """What the pumps were given, u (samples, pumps), over time [s]."""
    for j in range(u.shape[1]):
        ax.step(
            t,
            u[:, j],
            where="post",
            linewidth=1.0,
            label=f"pump {j + 1}",
            color=(AFTER, BEFORE, OTHER)[j % 3],
        )
    ax.margins(y=0.1)
    ax.set(ylabel=f"input [{unit}]", xlabel="time [s]", xlim=(t[0], t[-1]))
    return ax


def residual(ax, t, r, name, unit, noise=None):
    """Measured less simulated, r (samples,), over time [s]; the band of two standard deviations of
    the noise seen in the record.
    """
    ax.plot(t, r, color=AFTER, linewidth=0.8)
    ax.axhline(0.0, color=REFERENCE, linewidth=0.8, linestyle=":")
    if noise is not None:
        ax.axhspan(
            -2 * noise,
            2 * noise,
            color=OTHER,
            alpha=0.2,
            linewidth=0,
            label="2 sd of the record's noise",
        )
    ax.margins(y=0.15)
    ax.set(ylabel=f"{name}: residual [{unit}]", xlabel="time [s]", xlim=(t[0], t[-1]))
    return ax


def autocorrelation(ax, acf, samples, name):
    """Autocorrelation of a residual (lags + 1,), with the band within which that of white noise
    stays 95 % of the time.
    """
    lags = np.arange(1, len(acf))
    ax.vlines(lags, 0.0, acf[1:], color=AFTER, linewidth=1.4)
    bound = 1.96 / np.sqrt(max(samples, 1))
    ax.axhspan(-bound, bound, color=OTHER, alpha=0.25, linewidth=0, label="white noise, 95 %")
    ax.axhline(0.0, color=REFERENCE, linewidth=0.8)
    ax.set(xlabel="lag [samples]", ylabel=f"{name}: autocorrelation [-]", ylim=(-1.05, 1.05))
    return ax


def correlation(ax, names, matrix):
    """Correlation of the estimates (n, n), numbers written in."""
    image = ax.imshow(matrix, cmap="PuOr", vmin=-1, vmax=1)
    ax.set_xticks(range(len(names)), names, rotation=40, ha="right")
    ax.set_yticks(range(len(names)), names)
    ax.grid(False)
    if len(names) <= 14:
        for i in range(len(names)):
            for j in range(len(names)):
                ax.text(
                    j,
                    i,
                    f"{round(float(matrix[i, j]), 2) + 0.0:.2f}",
                    ha="center",
                    va="center",
                    fontsize=6.5,
                    color="w" if abs(matrix[i, j]) > 0.7 else "k",
                )
    ax.figure.colorbar(image, ax=ax, label="correlation [-]", shrink=0.85)
    return ax


def profile(ax, found):
    """Profile likelihood: rise of twice the log-likelihood over a parameter, with its 95 % line and
    interval.
    """
    values, rise = np.array(found["values"]), np.array(found["rise"])
    ax.plot(
        values,
        rise,
        "o-",
        color=AFTER,
        markersize=3.5,
        linewidth=1.3,
        label="all others fitted again",
    )
    ax.axhline(3.841, color=FORBIDDEN, linewidth=1.0, label="95 %")
    for end in found["interval95"]:
        if end is not None:
            ax.axvline(end, color=OTHER, linewidth=0.9, linestyle="--")
    ax.set(
        xlabel=f"{found['name']} [{found['unit']}]",
        ylabel="rise of -2 log likelihood [-]",
        ylim=(-0.03 * max(rise.max(), 5.0), None),
    )
    ax.legend()
    return ax

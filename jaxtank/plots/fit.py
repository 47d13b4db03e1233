"""Pictures of a fit to experiment data.

Each function draws on given matplotlib axes and returns them.
"""

import numpy as np

from jaxtank.plots.style import AFTER, BEFORE, FORBIDDEN, OTHER, REFERENCE


def measured(ax, t, y, simulated, name, unit, validation_from=None):
    """Draw a measured level and that of the fitted rig; the part for validation is shaded.

    Parameters
    ----------
    ax : matplotlib axes
    t : (samples,) times [s]
    y, simulated : (samples,) levels [unit]
    name, unit : of the level
    validation_from : time from which data were not used in the first fit [s], or None

    Returns
    -------
    The axes.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> t = np.arange(3.0)
    >>> measured(Figure().gca(), t, t, t, "h1", "cm", 1.0).get_ylabel()
    'h1 [cm]'
    """
    ax.plot(t, y, ".", color=BEFORE, markersize=2.0, label="measured")
    ax.plot(t, simulated, color=AFTER, linewidth=1.2, label="simulated")
    if validation_from is not None:
        shaded = {"color": OTHER, "alpha": 0.08, "linewidth": 0}
        ax.axvspan(validation_from, t[-1], label="for validation", **shaded)
    ax.set(ylabel=f"{name} [{unit}]", xlim=(t[0], t[-1]))
    return ax


def inputs(ax, t, u, unit):
    """Draw the inputs of the pumps.

    Parameters
    ----------
    ax : matplotlib axes
    t : (samples,) times [s]
    u : (samples, pumps) inputs [unit]
    unit : of inputs

    Returns
    -------
    The axes.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> inputs(Figure().gca(), np.arange(3.0), np.ones((3, 1)), "V").get_ylabel()
    'input [V]'
    """
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
    """Draw a residual, with a band of two standard deviations of the noise.

    Parameters
    ----------
    ax : matplotlib axes
    t : (samples,) times [s]
    r : (samples,) measured less simulated [unit]
    name, unit : of the level
    noise : standard deviation of the noise in the data [unit], or None

    Returns
    -------
    The axes.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> residual(Figure().gca(), np.arange(3.0), np.zeros(3), "h1", "cm", 0.1).get_ylabel()
    'h1: residual [cm]'
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
            label="2 sd of the noise in the data",
        )
    ax.margins(y=0.15)
    ax.set(ylabel=f"{name}: residual [{unit}]", xlabel="time [s]", xlim=(t[0], t[-1]))
    return ax


def autocorrelation(ax, acf, samples, name):
    """Draw the autocorrelation of a residual, with the 95 % band of white noise.

    Parameters
    ----------
    ax : matplotlib axes
    acf : (lags + 1,) autocorrelation [-]
    samples : number of samples
    name : of the level

    Returns
    -------
    The axes.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> autocorrelation(Figure().gca(), [1.0, 0.1, 0.0], 100, "h1").get_xlabel()
    'lag [samples]'
    """
    lags = np.arange(1, len(acf))
    ax.vlines(lags, 0.0, acf[1:], color=AFTER, linewidth=1.4)
    bound = 1.96 / np.sqrt(max(samples, 1))
    ax.axhspan(-bound, bound, color=OTHER, alpha=0.25, linewidth=0, label="white noise, 95 %")
    ax.axhline(0.0, color=REFERENCE, linewidth=0.8)
    ax.set(xlabel="lag [samples]", ylabel=f"{name}: autocorrelation [-]", ylim=(-1.05, 1.05))
    return ax


def correlation(ax, names, matrix):
    """Draw the correlation of the estimates, with its numbers up to 14 parameters.

    Parameters
    ----------
    ax : matplotlib axes
    names : of the n parameters
    matrix : (n, n) correlation [-]

    Returns
    -------
    The axes.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> len(correlation(Figure().gca(), ["k", "a"], np.eye(2)).texts)
    4
    """
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
    """Draw the profile likelihood of a parameter, with its 95 % line and interval.

    Parameters
    ----------
    ax : matplotlib axes
    found : {"name", "unit", "values" (n,), "rise" (n,) of -2 log likelihood, "interval95": (low,
        high), None for an end that was not found}

    Returns
    -------
    The axes.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> found = {"name": "k", "unit": "-", "values": [1, 2], "rise": [0, 5], "interval95": (1, 2)}
    >>> profile(Figure().gca(), found).get_xlabel()
    'k [-]'
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

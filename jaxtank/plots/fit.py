"""Pictures of a fit to experiment data, on given axes."""

import itertools

import numpy as np

from jaxtank.plots.style import AFTER, BEFORE, FORBIDDEN, OTHER, REFERENCE, label_time, plain, write


def measured(ax, t, y, simulated, name, unit, validation_from=None):
    """Draw a measured level and that of the fitted rig; the part for validation is shaded."""
    ax.plot(t, y, ".", color=BEFORE, markersize=2.0, label="measured")
    ax.plot(t, simulated, color=AFTER, linewidth=1.2, label="simulated")
    if validation_from is not None:
        shaded = {"color": OTHER, "alpha": 0.08, "linewidth": 0}
        ax.axvspan(validation_from, t[-1], label="for validation", **shaded)
    ax.set(ylabel=plain(f"{name} [{unit}]"), xlim=(t[0], t[-1]))


def column(ax, t, values, name, unit):
    """Draw a column of a file, as its cells are."""
    ax.plot(t, values, ".-", color=BEFORE, markersize=2.0, linewidth=0.6)
    ax.margins(x=0.0, y=0.1)
    ax.set(ylabel=plain(f"{name} [{unit}]" if unit else name))


def inputs(ax, t, u, unit):
    for j, colour in zip(range(u.shape[1]), itertools.cycle((AFTER, BEFORE, OTHER))):
        ax.step(t, u[:, j], where="post", linewidth=1.0, label=f"pump {j + 1}", color=colour)
    ax.margins(y=0.1)
    ax.set(ylabel=f"input [{unit}]", xlim=(t[0], t[-1]))
    label_time(ax)


def residual(ax, t, r, name, unit, noise=None):
    """Draw a residual, with a band of two standard deviations of the noise."""
    ax.plot(t, r, color=AFTER, linewidth=0.8)
    ax.axhline(0.0, color=REFERENCE, linewidth=0.8, linestyle=":")
    if noise is not None:
        band = {"color": OTHER, "alpha": 0.2, "linewidth": 0}
        ax.axhspan(-2 * noise, 2 * noise, label="2 sd of the noise in the data", **band)
    ax.margins(y=0.15)
    ax.set(ylabel=plain(f"{name}: residual [{unit}]"), xlim=(t[0], t[-1]))
    label_time(ax)


def autocorrelation(ax, acf, samples, name):
    """Draw the autocorrelation of a residual, with the 95 % band of white noise."""
    ax.vlines(np.arange(1, len(acf)), 0.0, acf[1:], color=AFTER, linewidth=1.4)
    bound = 1.96 / np.sqrt(max(samples, 1))
    ax.axhspan(-bound, bound, color=OTHER, alpha=0.25, linewidth=0, label="white noise, 95 %")
    ax.axhline(0.0, color=REFERENCE, linewidth=0.8)
    ax.set(xlabel="lag [samples]", ylabel=plain(f"{name}: autocorrelation [-]"), ylim=(-1.05, 1.05))


def correlation(ax, names, matrix):
    """Draw the correlation of the estimates, with its numbers up to 14 parameters."""
    names = [plain(name) for name in names]
    image = ax.imshow(matrix, cmap="PuOr", vmin=-1, vmax=1)
    ax.set_xticks(range(len(names)), names, rotation=40, ha="right")
    ax.set_yticks(range(len(names)), names)
    ax.grid(False)
    if len(names) <= 14:
        for (i, j), value in np.ndenumerate(matrix):
            colour = "w" if abs(value) > 0.7 else "k"
            write(ax, j, i, f"{round(float(value), 2) + 0.0:.2f}", 6.5, colour=colour)
    ax.figure.colorbar(image, ax=ax, label="correlation [-]", shrink=0.85)


def profile(ax, likelihood):
    """Draw the profile likelihood of a parameter, with its 95 % line and interval."""
    values, rise = np.array(likelihood["values"]), np.array(likelihood["rise"])
    dots = {"color": AFTER, "markersize": 3.5, "linewidth": 1.3}
    ax.plot(values, rise, "o-", label="all others fitted again", **dots)
    ax.axhline(3.841, color=FORBIDDEN, linewidth=1.0, label="95 %")
    for end in likelihood["interval95"]:
        if end is not None:
            ax.axvline(end, color=OTHER, linewidth=0.9, linestyle="--")
    ax.set(xlabel=plain(f"{likelihood['name']} [{likelihood['unit']}]"))
    ax.set(ylabel="rise of -2 log likelihood [-]", ylim=(-0.03 * max(rise.max(), 5.0), None))
    ax.legend()

"""A fan of many runs that is drawn again and again: its lines and bands are moved, never rebuilt.

What does not move (axes, grid, numbers) is drawn once and kept as pixels.
"""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from PIL import Image

from jaxtank.plots.overview import worst
from jaxtank.plots.style import PUBLISHED, REFERENCE, RIM, TUNED, hide, styled

TANKS, PUMPS_SHOWN = 6, 4
"""Panels of tanks and of pumps, at most."""

BANDS = ((0, 4, 0.2, "5 to 95 %"), (1, 3, 0.35, "25 to 75 %"))
"""(lower quantile, upper quantile, opacity, label) of the bands."""

MEDIAN, HIGHEST = 2, 5
"""Places of the median and of the highest of all plants among the quantiles."""

NEAR = 0.6
"""Share of a rim or limit that a level must reach for it to be in the picture [-]."""

LOOSE = 0.45
"""Share of a panel that must be filled; below it the panel is scaled again [-]."""


UNLIMITED = 1e12
"""Limits above this are those of a pump that has none, in any unit."""


class MovingFan:
    """A figure of the quantiles of levels and inputs over many plants."""

    def __init__(self, loop: Any, t: Any, r: Any, x: Any, u: Any, dpi: int = 90):
        self.t, self.dpi = np.asarray(t), dpi
        plant, (length, drive) = loop.plant, loop.units
        rims = np.broadcast_to(np.asarray(plant.rim, dtype=float), (plant.tanks,))
        low, high = (np.asarray(v, dtype=float) for v in (loop.actuator.low, loop.actuator.high))
        tanks = range(plant.tanks)
        if plant.tanks > TANKS:
            tanks = worst(np.max(x[HIGHEST], axis=0) / rims, TANKS)
        pumps = range(min(plant.pumps, PUMPS_SHOWN))
        columns = max(2, min(4, len(tanks)))
        lines = -(-len(tanks) // columns) + -(-len(pumps) // columns)
        with styled(), np.errstate(all="ignore"):  # as in `draw`
            self.figure = Figure(figsize=(10.0, 2.1 * lines + 0.5), dpi=dpi, layout="constrained")
            self.canvas = FigureCanvasAgg(self.figure)
            axes = self.figure.subplots(lines, columns, sharex=True, squeeze=False)
            first = -(-len(tanks) // columns)
            upper, lower = axes[:first].ravel(), axes[first:].ravel()
            self.panels: list[tuple[str, int, _Panel]] = []
            for ax, i in zip(upper, tanks):
                setpoint = r[:, plant.outputs.index(i)] if i in plant.outputs else None
                panel = _Panel(ax, self.t, x[MEDIAN, :, i], setpoint, [float(rims[i])])
                ax.set_title(f"tank {i + 1}", loc="left")
                ax.set_ylabel(f"level [{length}]")
                self.panels.append(("x", i, panel))
            for ax, j in zip(lower, pumps):
                panel = _Panel(ax, self.t, u[MEDIAN, :, j], None, [float(high[j]), float(low[j])])
                ax.set_title(f"pump {j + 1}", loc="left")
                ax.set_ylabel(f"input [{drive}]")
                self.panels.append(("u", j, panel))
            hide([*upper[len(tanks) :], *lower[len(pumps) :]])
            for column in axes.T:
                last = [ax for ax in column if ax.get_visible()][-1]
                last.set_xlabel("time [s]")
                last.tick_params(labelbottom=True)
            self._legend()
        self.background: Any = None
        self.drawn = 0  # times that everything was drawn

    def draw(self, x: Any, u: Any, over: Sequence[float]) -> bytes:
        """Move everything to quantiles x, u and return the picture as PNG bytes."""
        fits = True
        # a compiled run leaves floating-point flags, which numpy would report as an overflow
        with styled(), np.errstate(all="ignore"):
            for kind, i, panel in self.panels:
                quantiles = (x if kind == "x" else u)[:, :, i]
                text = f"{100 * over[i]:.3g} % over the rim" if kind == "x" and over[i] else ""
                fits = panel.move(quantiles, text) and fits
            if self.background is None or not fits:
                self.canvas.draw()
                self.background = self.canvas.copy_from_bbox(self.figure.bbox)
                self.drawn += 1
            self.canvas.restore_region(self.background)
            for _, _, panel in self.panels:
                for artist in panel.artists:
                    panel.ax.draw_artist(artist)
        return self._png()

    def _png(self) -> bytes:
        """What is on the canvas, lightly compressed: it is looked at and replaced."""
        out = io.BytesIO()
        pixels = np.asarray(self.canvas.buffer_rgba())[:, :, :3]
        Image.fromarray(np.ascontiguousarray(pixels)).save(out, format="PNG", compress_level=1)
        return out.getvalue()

    def save(self, out: Any, kind: str, dpi: int = 300) -> None:
        """Write the picture to a file or a stream as `kind`: "png", "svg" or "pdf"."""
        with styled(), np.errstate(all="ignore"):
            self.figure.savefig(out, format=kind, dpi=dpi)

    def _legend(self) -> None:
        bands = [
            Patch(facecolor=TUNED, alpha=a, label=f"{name} of plants") for *_, a, name in BANDS
        ]
        lines = [
            Line2D([], [], color=TUNED, linewidth=1.4, label="median"),
            Line2D([], [], color=TUNED, linewidth=0.7, label="highest of all plants"),
            Line2D([], [], color=PUBLISHED, linestyle="--", linewidth=1.0, label="median before"),
            Line2D([], [], color=REFERENCE, linestyle=":", linewidth=1.2, label="setpoint"),
            Line2D([], [], color=RIM, linewidth=1.2, label="rim or limit"),
        ]
        self.figure.legend(handles=[*bands, *lines], loc="outside lower center", ncols=7)


class _Panel:
    """One panel: its artists, and limits of its ordinate that hold them."""

    def __init__(self, ax: Any, t: Any, before: Any, setpoint: Any, bounds: Sequence[float]):
        self.ax, self.t = ax, t
        self.bounds = [v if abs(v) < UNLIMITED else np.inf for v in bounds]
        self.still = [v for v in (before, setpoint) if v is not None and np.isfinite(v).all()]
        self.shape = np.zeros((2 * len(t), 2))  # its ordinates are read before the first `move`
        self.shape[:, 0] = np.concatenate([t, t[::-1]])
        self.bands = [
            ax.add_collection(
                PolyCollection([self.shape], facecolor=TUNED, alpha=alpha, linewidth=0)
            )
            for *_, alpha, _ in BANDS
        ]
        line = lambda values, **style: ax.plot(t, values, **style)[0]
        (self.highest,) = ax.plot(t, before, color=TUNED, linewidth=0.7)
        fixed = [line(before, color=PUBLISHED, linestyle="--", linewidth=1.0)]
        if setpoint is not None:
            fixed.append(line(setpoint, color=REFERENCE, linestyle=":", linewidth=1.2))
        fixed += [ax.axhline(v, color=RIM, linewidth=1.2) for v in self.bounds if np.isfinite(v)]
        (self.median,) = ax.plot(t, before, color=TUNED, linewidth=1.4)
        where = {"transform": ax.transAxes, "ha": "right", "va": "bottom", "fontsize": 8}
        self.text = ax.text(1.0, 1.03, "", fontweight="bold", **where)
        self.artists = [*self.bands, self.highest, *fixed, self.median, self.text]
        for artist in self.artists:
            artist.set_animated(True)
        ax.set_xlim(float(t[0]), float(t[-1]))
        self.limits = (np.inf, -np.inf)

    def move(self, quantiles: Any, text: str) -> bool:
        """Move the artists; True if the ordinate stays as it was."""
        n = len(self.t)
        for band, (low, high, *_) in zip(self.bands, BANDS):
            self.shape[:n, 1], self.shape[n:, 1] = quantiles[low], quantiles[high][::-1]
            band.set_verts([self.shape])
        self.median.set_ydata(quantiles[MEDIAN])
        self.highest.set_ydata(quantiles[HIGHEST])
        self.text.set_text(text)
        ends = [np.ravel(v) for v in (quantiles, *self.still)]
        values = np.concatenate([v[np.isfinite(v)] for v in ends])
        low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)
        near = [v for v in self.bounds if np.isfinite(v) and low <= v and high > NEAR * v > 0]
        low, high = min([low, *self.bounds[1:]]), max([high, *near])
        bottom, top = self.limits
        if bottom <= low and high <= top and high - low > LOOSE * (top - bottom):
            return True
        margin = 0.08 * (high - low) or 1.0
        self.limits = (low - margin, high + margin)
        self.ax.set_ylim(*self.limits)
        return False

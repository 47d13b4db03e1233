"""A run, or two beside each other, as a film: levels, liquid above a rim, setpoints, inputs."""

import io
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Rectangle
from PIL import Image

from jaxtank.core.errors import InputError
from jaxtank.core.files import write_atomic
from jaxtank.core.text import one_line
from jaxtank.plots.layout import place
from jaxtank.plots.overview import LARGEST as MOST_TANKS
from jaxtank.plots.schematic import HALO, depth, mark, mark_height, schematic
from jaxtank.plots.spills import Lost, Stack, headroom, spilled
from jaxtank.plots.style import PUMPS, TUNED, WATER, box, plain, styled

RATE = 12  # pictures per second: enough for liquid, which moves slowly
BAR = 0.6  # height of a pump's bar from its lower to its upper limit


def animate(loop, trajectory, path, seconds=8, against=None, titles=()):
    """Write a run as a GIF and return its path; the file is complete or not there."""
    path = Path(path)
    if path.suffix.lower() != ".gif":
        raise InputError(f"animation {str(path)!r}: is written as a GIF: its name must end in .gif")
    write_atomic(path, film(loop, trajectory, seconds, against, titles)[0])
    return path


def film(loop, trajectory, seconds=8, against=None, titles=()):
    """Return (a GIF as bytes, a still as the bytes of a PNG file): the still shows four moments."""
    with styled():
        figure, times, draw = _scene(loop, trajectory, seconds, against, titles)
        canvas: Any = figure.canvas
        pictures = []
        for t in times:
            draw(t)
            canvas.draw()
            pixels = np.asarray(canvas.buffer_rgba())[:, :, :3]
            pictures.append(Image.fromarray(np.ascontiguousarray(pixels)))
        plt.close(figure)
    return gif(pictures), still(pictures)


def gif(pictures):
    """Return the pictures of a film as a GIF, RATE of them per second."""
    # one palette for all, of three of them side by side
    parts = Image.new("RGB", (pictures[0].width, 3 * pictures[0].height))
    for k in range(3):
        parts.paste(pictures[k * (len(pictures) - 1) // 2], (0, k * pictures[0].height))
    palette, out = parts.quantize(64, dither=Image.Dither.NONE), io.BytesIO()
    colours = np.reshape(np.array(palette.getpalette() or ()), (-1, 3))
    colours[colours.min(axis=1) >= 248] = 255  # paper stays white
    palette.putpalette(colours.ravel().tolist())
    first, *others = (p.quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures)
    options = {"save_all": True, "duration": round(1000 / RATE), "loop": 0, "optimize": True}
    first.save(out, "GIF", append_images=others, **options)
    return out.getvalue()


def still(pictures):
    """Return four moments of a film as a PNG file, in two rows where the film is wide."""
    places = np.unique(np.linspace(0, len(pictures) - 1, 5).round().astype(int))[1:]
    chosen = [pictures[k] for k in places] or pictures[:1]
    width, height = chosen[0].size
    columns = len(chosen) if width < 1.3 * height else min(2, len(chosen))
    rows = -(-len(chosen) // columns)
    strip, out = Image.new("RGB", (columns * width, rows * height), "white"), io.BytesIO()
    for k, picture in enumerate(chosen):
        strip.paste(picture, (k % columns * width, k // columns * height))
    strip.save(out, format="PNG", optimize=True)
    return out.getvalue()


def _scene(loop, trajectory, seconds, against, titles):
    """(figure, times of its pictures, what draws one of them) of one rig, or of two."""
    if not (isinstance(seconds, (int, float)) and 1 <= seconds <= 60):
        raise InputError(f"seconds = {seconds!r}: an animation may last 1 to 60 s")
    pairs = [(loop, trajectory), *([] if against is None else [against])]
    for pair in pairs:
        _check(*pair)
    end = max(float(run.t[-1]) for _, run in pairs)
    frames = min(max(len(run.t) for _, run in pairs), round(seconds * RATE))
    places = [place(loop.plant) for loop, _ in pairs]
    shape = max((where.top - where.bottom) / (where.right - where.left) for where in places)
    width = 4.6 if len(pairs) == 1 else 3.9
    figure = plt.figure(figsize=(width * len(pairs), min(6.0, width * shape + 0.8)), dpi=80)
    rows = enumerate(zip(pairs, [*titles, *[""] * len(pairs)]))
    stages = [_Stage(figure, (k, len(pairs)), rig, run, n) for k, ((rig, run), n) in rows]
    raised = max(stage.ax.get_ylim()[1] - stage.where.top for stage in stages)
    for stage in stages:  # to one scale
        stage.ax.set_ylim(top=stage.where.top + raised)
    inch = 1.0 / figure.get_size_inches()[1]
    clock = figure.text(0.5, 1.0 - 0.05 * inch, "", ha="center", va="top", fontsize=10)
    bar = Rectangle((0.0, 0.0), 0.0, 0.05 * inch, color=TUNED, linewidth=0)
    figure.add_artist(bar)

    def draw(t):
        clock.set_text(f"t = {t:.0f} s of {end:.0f} s")
        bar.set_width(t / end if end > 0 else 1.0)
        for stage in stages:
            stage.draw(t)

    return figure, np.linspace(0.0, end, frames), draw


def _check(loop, run):
    """Raise InputError for a run of another rig, and for a rig with too many tanks."""
    if not hasattr(loop.plant, "links") or loop.plant.tanks > MOST_TANKS:
        raise InputError(f"a film shows networks of at most {MOST_TANKS} tanks")
    x, u = np.asarray(run.x), np.asarray(run.u)
    if x.ndim != 2 or x.shape[1] != loop.plant.tanks or u.shape[1] != loop.plant.pumps:
        raise InputError(
            f"the trajectory is one of {x.shape[-1]} tanks and {u.shape[-1]} pumps, the rig has"
            f" {loop.plant.tanks} and {loop.plant.pumps}"
        )


class _Stage:
    """One rig of a film: the artists that move, and what they follow."""

    def __init__(self, figure, place_of, loop, run, title):
        number, of = place_of  # of the rig in the figure, and how many there are
        self.loop, self.where = loop, place(loop.plant)
        self.t, self.x, self.r, self.u = (np.asarray(v) for v in (run.t, run.x, run.r, run.u))
        ends = loop.actuator.low, loop.actuator.high
        self.low, self.high = (np.asarray(v, dtype=float) for v in ends)
        self.spilled = spilled(loop.plant, run)
        inch = 1.0 / figure.get_size_inches()[1]  # as a share of the height
        high = 1.0 - (0.78 if title else 0.56) * inch
        self.ax = ax = figure.add_axes((number / of + 0.005, 0.31 * inch, 1.0 / of - 0.01, high))
        schematic(ax, loop.plant)
        for text in ax.texts:
            text.set_path_effects(HALO)
        middle = (number + 0.5) / of
        words = {"ha": "center", "fontsize": 9}
        name = plain(one_line(title, 60))
        figure.text(middle, 1.0 - 0.25 * inch, name, va="top", fontweight="bold", **words)
        self.words = figure.text(middle, 0.1 * inch, "", va="bottom", **words)
        most, tanks = self.spilled.most, self.where.boxes
        look = {"facecolor": WATER, "zorder": 1.6}
        self.water = [box(ax, (tank.x, tank.y), (tank.width, 0.0), **look) for tank in tanks]
        self.marks, self.bars = [mark(ax, tanks[i], 0.0) for i in loop.plant.outputs], []
        frame = {"facecolor": "white", "edgecolor": "0.5", "linewidth": 0.8, "zorder": 3}
        for j, (x, y) in enumerate(self.where.pumps):
            corner = (x + (0.08 if x < 0 else -0.2), y + 0.3)
            box(ax, corner, (0.12, BAR), **frame)
            look = {"facecolor": PUMPS[j % len(PUMPS)], "zorder": 4}
            self.bars.append(box(ax, corner, (0.12, 0.0), **look))
        area, unit = np.asarray(loop.plant.area, dtype=float), self.spilled.unit
        gone = self.spilled.simulated
        above = lambda i: Lost(ax, tanks[i], unit) if gone else Stack(ax, tanks[i], float(area[i]))
        self.stacks = {i: above(i) for i in np.flatnonzero(most > 0)}
        headroom(ax, [(stack, most[i]) for i, stack in self.stacks.items()])

    def draw(self, t):
        """Move everything to the time t [s], or to the end of a run that ends before."""
        k = max(0, int(np.searchsorted(self.t, t * (1 + 1e-9) + 1e-9, side="right")) - 1)
        for i, tank in enumerate(self.where.boxes):
            self.water[i].set_height(depth(tank, self.x[k, i]))
        for i, stack in self.stacks.items():
            stack.set(self.spilled.volume[k, i])
        for n, (line, triangle) in enumerate(self.marks):
            y = mark_height(self.where.boxes[self.loop.plant.outputs[n]], float(self.r[k, n]))
            line.set_ydata([y, y])
            triangle.set_ydata([y])
        for j, bar in enumerate(self.bars):
            share = (self.u[k, j] - self.low[j]) / (self.high[j] - self.low[j])
            bar.set_height(BAR * float(np.clip(share, 0.0, 1.0)))
        self.words.set_text(self.spilled.words(k))

"""A run as an animation: levels of all tanks, setpoints, inputs of the pumps, and the time.

Imported by reports and notebooks.
"""

import hashlib
import re
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.patches import Rectangle

from jaxtank.core.errors import InputError
from jaxtank.core.files import write_atomic
from jaxtank.plots.layout import place
from jaxtank.plots.schematic import HALO, depth, mark, mark_height, schematic
from jaxtank.plots.style import PUMPS, WATER, styled

RATE = 12
"""Pictures per second: enough for liquid, which moves slowly."""

LONGEST = 60.0
"""Of an animation [s]."""


def animate(loop, trajectory, path, seconds=6):
    """Write a run as a GIF and return its path; the file is complete or not there.

    It needs Pillow, which matplotlib installs.

    Parameters
    ----------
    loop : ClosedLoop
    trajectory : of `jaxtank.simulate(loop, ...)`
    path : ends in .gif
    seconds : duration of the animation, 1 to 60 [s]

    Raises
    ------
    InputError
        For another duration or ending, and for a trajectory of another rig.

    Examples
    --------
    >>> import jaxtank
    >>> from jaxtank import presets
    >>> loop = presets.find("cascaded/pi").loop
    >>> run = jaxtank.simulate(loop, jaxtank.Clock(dt=4.0, duration=40.0))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     animate(loop, run, Path(folder) / "run.gif", seconds=1).name
    'run.gif'
    """
    path = Path(path)
    if path.suffix.lower() != ".gif":
        raise InputError(f"animation {str(path)!r}: is written as a GIF: its name must end in .gif")
    with tempfile.TemporaryDirectory() as folder, styled():
        animation = _animation(loop, trajectory, seconds)
        animation.save(Path(folder) / "run.gif", writer=PillowWriter(fps=RATE), dpi=80)
        plt.close(animation._fig)  # pyright: ignore[reportAttributeAccessIssue]  absent from the stubs
        write_atomic(path, (Path(folder) / "run.gif").read_bytes())
    return path


def to_html(loop, trajectory, seconds=6):
    """Return a run as an HTML fragment with buttons, for `IPython.display.HTML` in a notebook.

    It is complete: fonts and scripts are not loaded from the network. Parameters and errors as of
    `animate`.

    Examples
    --------
    >>> import jaxtank
    >>> from jaxtank import presets
    >>> loop = presets.find("cascaded/pi").loop
    >>> run = jaxtank.simulate(loop, jaxtank.Clock(dt=4.0, duration=40.0))
    >>> "<link" in to_html(loop, run, seconds=1)
    False
    """
    with styled({"animation.embed_limit": 20.0, "figure.dpi": 80, "savefig.dpi": 80}):
        animation = _animation(loop, trajectory, seconds)
        page = animation.to_jshtml(fps=RATE)
        plt.close(animation._fig)  # pyright: ignore[reportAttributeAccessIssue]  absent from the stubs
    # matplotlib takes the pictures on its buttons from the network
    page = re.sub(r"<link\b[^>]*>\s*", "", page)
    for name, sign in SIGNS.items():
        page = re.sub(rf'<i class="fa [^"]*{name}"></i>', sign, page)
    # ids from the content instead of random ones, so that the same run gives the same page
    for chance in sorted(set(re.findall(r"[0-9a-f]{32}", page))):
        if f"anim{chance}" in page:
            page = page.replace(
                chance, hashlib.sha256(page.replace(chance, "").encode()).hexdigest()[:32]
            )
    return page


SIGNS = {
    "fa-minus": "-",
    "fa-fast-backward": "|&lt;",
    "fa-step-backward": "&lt;|",
    "fa-play fa-flip-horizontal": "&#9664;",
    "fa-pause": "||",
    "fa-play": "&#9654;",
    "fa-step-forward": "|&gt;",
    "fa-fast-forward": "&gt;|",
    "fa-plus": "+",
}
"""Labels of the buttons of `to_html`."""


def _animation(loop, trajectory, seconds):
    """A FuncAnimation of about seconds * RATE pictures, evenly spaced in time."""
    if not (isinstance(seconds, (int, float)) and 1 <= seconds <= LONGEST):
        raise InputError(f"seconds = {seconds!r}: an animation may last 1 to {LONGEST:g} s")
    t, x, r, u = (np.asarray(v) for v in (trajectory.t, trajectory.x, trajectory.r, trajectory.u))
    if x.ndim != 2 or x.shape[1] != loop.plant.tanks or u.shape[1] != loop.plant.pumps:
        raise InputError(
            f"the trajectory is one of {x.shape[-1]} tanks and {u.shape[-1]} pumps, the rig has"
            f" {loop.plant.tanks} and {loop.plant.pumps}"
        )
    rows = np.unique(
        np.linspace(0, len(t) - 1, min(len(t), round(seconds * RATE))).round().astype(int)
    )
    where = place(loop.plant)
    wide, high = where.right - where.left, where.top - where.bottom
    figure = plt.figure(figsize=(4.6, min(6.0, 4.6 * high / wide + 0.4)))
    ax = figure.add_axes((0.01, 0.01, 0.98, 0.92))
    schematic(ax, loop.plant)
    for text in ax.texts:
        text.set_path_effects(HALO)
    clock = figure.text(0.5, 0.985, "", ha="center", va="top", fontsize=10)
    water, marks, bars = _moving(ax, loop, where)
    low, top = (np.asarray(v, dtype=float) for v in (loop.actuator.low, loop.actuator.high))

    def draw(k):
        clock.set_text(f"t = {t[k]:.0f} s of {t[-1]:.0f} s")
        for i, box in enumerate(where.boxes):
            water[i].set_height(depth(box, x[k, i]))
        for n, (line, triangle) in enumerate(marks):
            y = mark_height(where.boxes[loop.plant.outputs[n]], float(r[k, n]))
            line.set_ydata([y, y])
            triangle.set_ydata([y])
        for j, bar in enumerate(bars):
            bar.set_height(BAR * float(np.clip((u[k, j] - low[j]) / (top[j] - low[j]), 0.0, 1.0)))

    return FuncAnimation(
        figure, draw, frames=rows.tolist(), interval=1000 / RATE, cache_frame_data=False
    )


BAR = 0.6
"""Height of a pump's bar from its lower to its upper limit."""


def _moving(ax, loop, where):
    """The artists that move: water in each tank, marks of setpoints, a bar for each pump."""
    water, bars = [], []
    for box in where.boxes:
        water.append(
            ax.add_patch(
                Rectangle(
                    (box.x, box.y), box.width, 0.0, facecolor=WATER, edgecolor="none", zorder=1.6
                )
            )
        )
    marks = [mark(ax, where.boxes[i], 0.0) for i in loop.plant.outputs]
    for j, (x, y) in enumerate(where.pumps):
        left = x + (0.08 if x < 0 else -0.2)
        ax.add_patch(
            Rectangle(
                (left, y + 0.3),
                0.12,
                BAR,
                facecolor="white",
                edgecolor="0.5",
                linewidth=0.8,
                zorder=3,
            )
        )
        bars.append(
            ax.add_patch(
                Rectangle((left, y + 0.3), 0.12, 0.0, facecolor=PUMPS[j % len(PUMPS)], zorder=4)
            )
        )
    return water, marks, bars

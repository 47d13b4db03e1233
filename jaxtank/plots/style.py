"""Colours, line styles and settings of all pictures."""

import contextlib
import importlib
import importlib.util
import sys
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from jaxtank.core.errors import InputError
from jaxtank.core.text import PICTURES

# One colour for each role, by Okabe and Ito (Color Universal Design, 2008): first those of a run
# with the values of the case, with those of a search, and with a safety filter
PUBLISHED, TUNED, FILTERED = "#D55E00", "#0072B2", "#009E73"
REFERENCE, RIM = "#000000", "#CC79A7"  # of setpoints; of rims, limits and what is beyond them
BEFORE, AFTER, OTHER, FORBIDDEN = PUBLISHED, TUNED, FILTERED, RIM  # in a comparison
BEYOND: dict[str, Any] = {"color": FORBIDDEN, "alpha": 0.18, "linewidth": 0}  # style beyond a limit

RUNS = (  # (colour, line style) of runs in one picture
    *((BEFORE, "--"), (AFTER, "-"), (OTHER, "-.")),
    *(("#E69F00", "-"), ("#56B4E9", "--"), ("0.45", "-.")),
)

PUMPS = ("#E69F00", "#7A4A00", "#B3A100", "#4C4C1A")  # of different lightness
SHARE = "#56B4E9"  # colour of bars of shares and probabilities
WATER, GLASS = "#9CCEEB", "0.35"  # of the liquid and of the walls of a tank

WIDTHS = {1: 3.5, 2: 7.16}  # {columns of a journal: inch} (IEEE's author guidelines on graphics)
TALLEST = 9.0  # height of a figure for a journal, at most [inch]
PANEL = 2.2  # width of a panel in a figure for a journal, at least [inch]
HERE = Path(__file__).parent
_COLUMNS: list[int] = []  # of a journal, innermost last: figures are made for it

# settings of matplotlib: of all pictures, and over them those of pictures for a journal
STYLE, PRINT = (
    dict[Any, Any](matplotlib.rc_params_from_file(HERE / sheet, use_default_template=False))
    for sheet in ("screen.mplstyle", "journal.mplstyle")
)


@contextlib.contextmanager
def for_print(columns=1):
    """Make figures for a journal within a `with` block: their width, their letters, no title."""
    if columns not in WIDTHS or isinstance(columns, bool):
        raise InputError(f"columns = {columns!r}: a figure is 1 or 2 columns of a journal wide")
    _COLUMNS.append(columns)
    try:
        yield
    finally:
        _COLUMNS.pop()


def printing():
    return bool(_COLUMNS)


def width(usual):
    """Return the width of a figure [inch]: that of a journal's columns, or `usual`."""
    return WIDTHS[_COLUMNS[-1]] if _COLUMNS else usual


def beside(most):
    """Return how many panels stand beside each other: `most`, or what a journal's columns take."""
    return min(most, max(1, int(width(0.0) / PANEL))) if _COLUMNS else most


def height(usual, rows):
    """Return the height of a figure of rows of panels [inch]: 1.3 each in a journal, or `usual`."""
    return min(1.3 * rows + 0.5, TALLEST) if _COLUMNS else usual


@contextlib.contextmanager
def styled(more=None):
    """Set matplotlib's settings to STYLE, and to `more` {setting: value}, within a `with` block."""
    settings = STYLE | (PRINT if _COLUMNS else {}) | (more or {})
    before: dict[Any, Any] = {name: plt.rcParams[name] for name in settings}
    plt.rcParams.update(settings)
    try:
        yield
    finally:
        plt.rcParams.update(before)


def notebook(dpi: int = 110, sharp: bool = False, pictures: bool = True) -> None:
    """Set up a notebook, once in its first cell: float64, the style of the figures, their
    resolution, and a small picture below each result that is shown.

    Parameters
    ----------
    dpi : int
        Size of figures on the screen, 40 to 400 [pixels per inch].
    sharp : bool
        Whether figures have twice as many pixels at the same size, for screens of high resolution.
    pictures : bool
        Whether a result that is shown has a small picture below its table.

    Raises
    ------
    InputError
        For another resolution.

    Examples
    --------
    >>> import jaxtank
    >>> with plt.rc_context():
    ...     jaxtank.notebook(pictures=False)
    ...     plt.rcParams["figure.dpi"]
    110.0
    """
    import jax

    if isinstance(dpi, bool) or not isinstance(dpi, int) or not 40 <= dpi <= 400:
        raise InputError(f"dpi = {dpi!r}: must be a whole number from 40 to 400 pixels per inch")
    jax.config.update("jax_enable_x64", True)
    STYLE["figure.dpi"] = dpi
    plt.rcParams.update(STYLE)
    PICTURES[0] = bool(pictures)
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    if hasattr(shell, "kernel") and importlib.util.find_spec("matplotlib_inline") is not None:
        config: Any = importlib.import_module("matplotlib_inline.config")
        inline: Any = config.InlineBackend.instance(parent=shell)
        inline.shell = shell
        inline.figure_formats = {"retina" if sharp else "png"}


TIMES = ((10.0 * 86400.0, 86400.0, "d"), (3.0 * 3600.0, 3600.0, "h"))
"""(shortest span [s], seconds, name) of the units of a time axis that is long."""


class _Times(MaxNLocator):
    """Ticks at round multiples of `seconds`."""

    def __init__(self, seconds):
        super().__init__(nbins="auto", steps=[1, 2, 3, 6, 10])
        self.seconds = seconds

    def tick_values(self, vmin, vmax):
        return self.seconds * super().tick_values(vmin / self.seconds, vmax / self.seconds)


def label_time(ax):
    """Label an axis of times in s that is drawn: in h or d where it is long."""
    low, high = ax.get_xlim()
    seconds, unit = next((row[1:] for row in TIMES if high - low >= row[0]), (1.0, "s"))
    ax.set_xlabel(f"time [{unit}]")
    if seconds > 1.0:
        ax.xaxis.set_major_locator(_Times(seconds))
        ax.xaxis.set_major_formatter(lambda t, _: f"{t / seconds:g}")


def plain(text):
    """Return a text in which matplotlib takes no dollar sign as the start of mathematics."""
    return text.replace("$", r"\$")


def grid(rows, columns, size, **more):
    return plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained", **more)


def picture(draw, size, rows=1, columns=1, legend=0, title="", **more):
    """Return a figure of `size` [inch] that `draw` draws on; `legend`: columns of one, or 0."""
    with styled():
        figure, axes = plt.subplots(rows, columns, figsize=size, layout="constrained", **more)
        draw(axes)
        if legend:
            add_legend(figure, lambda labels: min(legend, labels))
        if title:
            figure.suptitle(plain(title), fontsize=10)
    return figure


def add_legend(figure, columns):
    """Add one legend below all panels, with each label once, in columns(number of labels)."""
    handles = {}
    for ax in figure.axes:
        for handle, label in zip(*ax.get_legend_handles_labels()):
            handles.setdefault(label, handle)
    if handles:
        place = {"loc": "outside lower center", "ncols": columns(len(handles))}
        figure.legend(handles.values(), handles.keys(), **place)


def hide(axes):
    for ax in axes:
        ax.set_visible(False)


def lines(ax, runs, quantity, column, linewidth=1.2):
    """Draw one column of a quantity of {name: (run, colour, line style)} over time."""
    for name, (run, colour, style) in runs.items():
        look = {"color": colour, "linestyle": style, "linewidth": linewidth, "label": plain(name)}
        ax.plot(run.t, getattr(run, quantity)[:, column], **look)


def box(ax, corner, size, **look):
    """Draw a rectangle without an edge, unless `look` has one; return it."""
    return ax.add_patch(Rectangle(corner, *size, **{"edgecolor": "none", **look}))


def write(ax, x, y, text, size=7.0, at="center center", colour="0.25", **look):
    """Write a text of `size` [points] with the horizontal and vertical alignment `at`."""
    across, up = at.split()
    look = {"fontsize": size, "ha": across, "va": up, "color": colour, **look}
    return ax.text(x, y, plain(text), **look)

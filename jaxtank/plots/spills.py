"""What leaves a tank over its rim, or is above it: volumes, words, drawings."""

from typing import Any, NamedTuple

import numpy as np
from matplotlib.colors import to_rgba
from matplotlib.patches import Rectangle

from jaxtank.core.text import one_line
from jaxtank.core.units import DEFAULT, local
from jaxtank.plots.style import RIM, plain

# above a rim
LIQUID: dict[str, Any] = {"facecolor": to_rgba(RIM, 0.45), "edgecolor": RIM, "hatch": "////"}
HIGHEST = 0.65  # of what is drawn above a rim, at most, in heights of the tallest tank


class Spilled(NamedTuple):
    """Volumes above the rims in the course of a run; made by `spilled`."""

    simulated: bool  # volumes lost since the start, else volumes above the rims at this moment
    volume: Any  # (rows, tanks)
    most: Any  # (tanks,) the largest of each column
    unit: str

    @property
    def any(self) -> bool:
        """Whether something is above a rim, by more than rounding."""
        return bool(np.any(self.most > 0.0))

    def words(self, row: int = -1) -> str:
        """What a picture reports of it, up to a row; whether overflow is simulated in any case."""
        model = "overflow simulated" if self.simulated else "no overflow in the model"
        if not self.any:
            return f"{model}, no level above its rim"
        if self.simulated:
            return f"{model}: {amount(self.volume[row].sum(), self.unit)} on the floor"
        most = self.volume[: None if row == -1 else row + 1].max(axis=0)
        return f"{model}: up to {amount(most.sum(), self.unit)} above the rims"


def spilled(plant: Any, run: Any) -> Spilled:
    """Return the volumes above the rims of a Trajectory of `plant`."""
    # What is captured by another tank is not lost, and not in it.
    x = np.asarray(run.x, dtype=float)
    if getattr(plant, "overflow", False):
        volume = np.asarray(run.spilled, dtype=float)
        volume = np.where(volume > 1e-9 * volume.max(initial=0.0), volume, 0.0)
    elif callable(getattr(plant, "area", callable)):  # a plant of the user's own, as a cone
        volume = np.zeros_like(x)
    else:
        rim = np.asarray(plant.rim, dtype=float)
        volume = np.where(x - rim > 1e-9 * np.abs(rim), volume_above(plant, x), 0.0)
    unit = local("cm^3", getattr(plant, "units", DEFAULT))
    return Spilled(bool(getattr(plant, "overflow", False)), volume, volume.max(axis=0), unit)


def volume_above(plant: Any, x: Any) -> Any:
    """Return the volumes (..., n) above the rims at levels x (..., n), below 0 under them."""
    rim = np.asarray(plant.rim, dtype=float)
    if not getattr(plant, "shapes", ()):
        return np.asarray(plant.area, dtype=float) * (x - rim)
    stored = lambda levels: np.stack([np.asarray(v) for v in plant.stored(tuple(levels.T))], -1)
    return stored(np.asarray(x, dtype=float)) - stored(np.broadcast_to(rim, np.shape(x)))


def amount(volume: float, unit: str) -> str:
    """Return a volume as three figures with its unit."""
    if volume <= 0.0:
        return f"0 {unit}"
    place = 2 - int(np.floor(np.log10(volume)))
    figures = f"{round(volume, place):.{max(0, place)}f}" if volume >= 1e-3 else f"{volume:.3g}"
    return f"{figures} {unit}"


class Stack:
    """Liquid above the rim of a tank, hatched; a triangle where it is higher than drawn."""

    def __init__(self, ax: Any, box: Any, area: float):
        self.box, self.area, top = box, float(area), box.y + box.height
        self.patch = Rectangle((box.x, top), box.width, 0.0, linewidth=0.0, zorder=3.5, **LIQUID)
        ax.add_patch(self.patch)
        ends = [box.x - 0.05, box.x + box.width + 0.05]
        ax.plot(ends, [top, top], color=RIM, linewidth=1.6, zorder=3.6)
        more = {"marker": "^", "color": RIM, "markersize": 5, "zorder": 3.7, "visible": False}
        (self.more,) = ax.plot([box.middle], [top + HIGHEST + 0.05], **more)

    def height(self, volume: float) -> float:
        """Return the height of a volume, to the scale of the levels, before it is cut."""
        return max(float(volume), 0.0) / self.area * self.box.scale

    def set(self, volume: float) -> None:
        height = self.height(volume)
        self.patch.set_height(min(height, HIGHEST))
        self.more.set_visible(height > HIGHEST)


class Lost:
    """Liquid that is gone over the rim of a tank: a drop outside each wall, and its volume."""

    def __init__(self, ax: Any, box: Any, unit: str):
        self.box, self.unit, top = box, unit, box.y + box.height
        sides = [box.x - 0.07, box.x + box.width + 0.07]
        look = {"marker": "v", "color": RIM, "markersize": 5, "zorder": 3.7, "linestyle": "none"}
        (self.drops,) = ax.plot(sides, [top - 0.06] * 2, visible=False, **look)
        words = {"ha": "center", "va": "bottom", "fontsize": 7.5, "zorder": 6, "gid": "above"}
        self.text = ax.text(box.middle, top + 0.03, "", color=RIM, **words)

    def height(self, volume: float) -> float:
        return 0.17 if volume > 0.0 else 0.0

    def set(self, volume: float) -> None:
        self.drops.set_visible(volume > 0.0)
        self.text.set_text(f"{amount(volume, self.unit)} spilled" if volume > 0.0 else "")


def headroom(ax: Any, stacks: Any) -> None:
    top = ax.get_ylim()[1]
    for stack, volume in stacks:
        rim = stack.box.y + stack.box.height
        top = max(top, rim + min(stack.height(volume), HIGHEST + 0.05) + 0.05)
    ax.set_ylim(top=top)


def above_rim(ax: Any, trajectories: Any, tank: int, rim: Any, spills: Any) -> str:
    """Hatch levels above the rim; return ": 774 cm^3 above the rim" for the title, or ""."""
    wet = {name: spill for name, spill in (spills or {}).items() if spill.most[tank] > 0}
    amounts = []
    for name, spill in wet.items():
        _hatch(ax, trajectories[name][0], tank, rim, spill)
        run = f" ({plain(one_line(name, 24))})" if len(trajectories) > 1 else ""
        amounts.append(amount(spill.most[tank], spill.unit) + run)
    if not wet:
        return ""
    where = "over the rim" if next(iter(wet.values())).simulated else "above the rim"
    return f": {', '.join(amounts[:2])}{' and more' if len(wet) > 2 else ''} {where}"


def spill_note(plant: Any, trajectories: Any) -> str:
    """Return lines of a title on the runs with a level above its rim, each after a line break."""
    lines = []
    for name, run in trajectories.items():
        if (spill := spilled(plant, run)).any:
            lines.append(spill.words() if len(trajectories) == 1 else f"{name}: {spill.words()}")
    return "".join(f"\n{line}" for line in lines[:3])


def _hatch(ax: Any, run: Any, tank: int, rim: float, spill: Spilled) -> None:
    """Hatch between rim and level, or all that is above the rim while a rig loses liquid."""
    t, style = np.asarray(run.t), {**LIQUID, "linewidth": 0.0}
    if spill.simulated:
        rises = np.diff(spill.volume[:, tank], append=spill.volume[-1, tank]) > 0
        top = max(ax.get_ylim()[1], 1.12 * rim)
        ax.fill_between(t, rim, top, where=rises | np.concatenate([[False], rises[:-1]]), **style)
        ax.set_ylim(top=top)
    else:
        level = np.asarray(run.x)[:, tank]
        ax.fill_between(t, rim, level, where=level > rim, interpolate=True, **style)

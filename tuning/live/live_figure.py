"""The live figure of a notebook: sliders of the free parameters above a fan of many plants.

Opened by `case.explore(plants=...)`. It needs ipywidgets (`pip install "jaxtank[notebooks]"`) and a
notebook's kernel; elsewhere `of_case` returns the live page.
"""

import base64
import html
import importlib
import importlib.util
import io
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxtank.case import Case, Free
from jaxtank.core.errors import InputError
from jaxtank.core.files import write_folder
from jaxtank.plots.moving_fan import MovingFan
from tuning.live import shown
from tuning.live.fan import PLANTS, Fan, Moved
from tuning.problem.bounds import Bound

MOST = 24
"""Sliders of a figure, at most."""

STEPS = 200
"""Positions of a slider."""

KINDS = ("png", "svg", "pdf")
"""Endings of the pictures that can be saved."""


class LiveFigure:
    """A fan of many plants that follows its sliders; made by `case.explore(plants=...)`."""

    def __init__(self, fan: Fan, widgets: bool = True):
        self.fan = fan
        if len(fan.bounds) > MOST:
            raise InputError(
                f"free: {len(fan.bounds)} numbers, must be at most {MOST}: name some of them"
            )
        self.moved = fan.move()
        self.picture = MovingFan(
            fan.case.loop, self.moved.t, self.moved.r, self.moved.x, self.moved.u
        )
        self.png = b""
        self.words: list[str] = []
        self.widgets: Any = None
        self.sliders: dict[str, Any] = {}
        self._still = False  # sliders are being set together
        self._draw(self.moved)
        if widgets:
            self._build()

    def move(self, values: Mapping[str, float] | None = None) -> Moved:
        """Show the plants at `values`; parameters that are not named are those of the case."""
        # Returns the numbers that are shown. Raises InputError for a name that is not free, and a
        # value outside its range.
        moved = self.fan.move(values)
        self._draw(moved)
        self._still = True
        for name, slider in self.sliders.items():
            slider.value = moved.values[name]
        self._still = False
        return moved

    @property
    def case(self) -> Case:
        """The case with the values that are shown."""
        return self.fan.case_at(self.moved.values)

    def save(self, path: str | Path) -> Path:
        """Write the picture to a file that ends in .png (300 dpi), .svg or .pdf; return its path.

        Raises InputError for another ending, and a path that cannot be written to.
        """
        path, out = Path(path), io.BytesIO()
        kind = path.suffix.lower().removeprefix(".")
        if kind not in KINDS:
            raise InputError(f"{str(path)!r}: must end in .{', .'.join(KINDS)}")
        self.picture.save(out, kind)
        return write_folder(path.parent, {path.name: out.getvalue()})[0]

    def _draw(self, moved: Moved) -> None:
        """Show the numbers of a fan."""
        self.moved, self.words = moved, self.fan.sentences(moved)
        self.png = self.picture.draw(moved.x, moved.u, self.fan.over(moved).mean(axis=0))
        if self.widgets is not None:
            self.image.value, self.text.value = self.png, _list(self.words)

    def _build(self) -> None:
        """Make the sliders and what they move."""
        iw: Any = importlib.import_module("ipywidgets")
        inches, _ = self.picture.figure.get_size_inches()
        size = iw.Layout(width=f"{inches * self.picture.dpi:.0f}px", max_width="100%")
        self.image = iw.Image(value=self.png, format="png", layout=size)
        self.text = iw.HTML(_list(self.words))
        self.sliders = {b.name: self._slider(iw, b) for b in self.fan.bounds}
        for slider in self.sliders.values():
            slider.observe(self._follow, names="value")
        back = iw.Button(description="values of the case", tooltip="set every slider back")
        back.on_click(lambda _: self.move())
        note = iw.HTML(f"<p>{html.escape(self._note())}</p>")
        left = iw.VBox([*self.sliders.values(), back])
        # the words beside the sliders where there is room
        row = iw.Box([left, self.text], layout=iw.Layout(display="flex", flex_flow="row wrap"))
        self.widgets = iw.VBox([row, self.image, note])

    def _slider(self, iw: Any, b: Bound) -> Any:
        unit = "" if b.unit in ("", "-") else f" [{b.unit}]"
        style = {"description_width": "14em"}
        settings: dict[str, Any] = {
            "description": b.name + unit,
            "value": self.moved.values[b.name],
            "readout_format": ".4g",
            "style": style,
            "layout": iw.Layout(width="34em", max_width="98%"),
        }
        log = b.scale == "log"
        low, at, high = (math.log10(v) if log else v for v in (b.low, settings["value"], b.high))
        kind = iw.FloatLogSlider if log else iw.FloatSlider
        return kind(min=low, max=high, step=_step(low, at, high), **settings)

    def _follow(self, _: Any) -> None:
        """Show the plants at the positions of the sliders."""
        if self._still:
            return
        ends = {b.name: (b.low, b.high) for b in self.fan.bounds}
        values = {
            name: min(max(float(slider.value), ends[name][0]), ends[name][1])
            for name, slider in self.sliders.items()
        }
        self._draw(self.fan.move(values))

    def _note(self) -> str:
        """What the fan is a fan of."""
        clock, given = self.fan.case.clock, self.fan.given.clock
        spread = ", ".join(self.fan.rows)
        step = f"step {clock.dt:g} s"
        if clock.dt != given.dt:
            step += f" (that of the case is {given.dt:g} s)"
        return (
            f"{self.fan.given.name}: {self.fan.plants} plants that differ in {spread}; {step};"
            " effects are exact derivatives on the plant of the case"
        )

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, Any]:
        """The widget where it can be shown; else the picture and its words."""
        found = {"text/plain": repr(self), "image/png": base64.b64encode(self.png).decode()}
        if self.widgets is not None:
            view: Any = self.widgets._repr_mimebundle_()
            found |= {k: v for k, v in view.items() if k != "text/plain"}
        return found

    def __repr__(self) -> str:
        values = ", ".join(f"{n} = {v:.4g}" for n, v in self.moved.values.items())
        return f"{self.fan.given.name} on {self.fan.plants} plants, {values}\n" + "\n".join(
            f"  {line}" for line in self.words
        )


def of_case(
    case: Case, free: Mapping[str, Any] | None = None, plants: int | None = None, seed: int = 0
) -> Any:
    """Return the LiveFigure of a case in a notebook with ipywidgets; elsewhere its LivePage."""
    fan = Fan(case, free, PLANTS if plants is None else plants, seed)
    if in_notebook():
        return LiveFigure(fan)
    ranges = case.free if free is None else {n: Free(*spec) for n, spec in free.items()}
    return shown.of_case(case.replace(free=ranges))


def in_notebook() -> bool:
    """Return whether this is a notebook's kernel, and ipywidgets is installed."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return hasattr(shell, "kernel") and importlib.util.find_spec("ipywidgets") is not None


def _step(low: float, at: float, high: float) -> float:
    """The step of a slider, of about STEPS positions of which one is `at`: a browser moves a slider
    that is between two positions.
    """
    step = (high - low) / STEPS
    return (at - low) / max(1, round((at - low) / step)) if at - low > 0.5 * step else step


def _list(words: list[str]) -> str:
    return f"<ul>{''.join(f'<li>{html.escape(line)}</li>' for line in words)}</ul>"

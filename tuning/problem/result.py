"""What every result offers: text, HTML for a notebook, JSON, pictures and files.

The base classes of the results of `tuning`; their reports are opened when they are asked for.
"""

# `report`, which is opened when it is asked for, is not strict
# pyright: reportUnknownVariableType=false

import importlib
from pathlib import Path
from typing import Any, ClassVar

from jaxtank.core.text import with_picture


class Shown:
    """A result that a notebook displays as HTML: what `str` reports, all of it escaped."""

    def _repr_html_(self) -> str:
        """Return the lines and tables of the result as a fragment of HTML, with a small picture
        once `jaxtank.notebook()` has been called.
        """
        from tuning.report.html import fragment

        return with_picture(fragment(self._lines()), lambda: _first_picture(self))

    def _lines(self) -> list[Any]:
        """Return what `str` reports: lines of text and tables."""
        return str(self).splitlines()


class Result(Shown):
    """A result with a report: `print(result)`, `.to_json()`, `.plot()`, `.save(folder)`."""

    REPORT: ClassVar[str]

    def _report(self) -> Any:
        return importlib.import_module(self.REPORT)

    def _lines(self) -> list[Any]:
        return self._report().lines(self)

    def __repr__(self) -> str:
        return "\n".join(map(str, self._lines()))

    def to_json(self) -> dict[str, Any]:
        """Return the JSON object that the command prints with --json: plain numbers, no NaN."""
        return self._report().json_of(self)

    def plot(self) -> dict[str, Any]:
        """Return matplotlib figures {name: Figure} of what there is to show."""
        return self._report().figures(self)

    def explore(self, plants: int | None = None) -> Any:
        """Return the live page of the result's case, a `tuning.live.shown.LivePage`: of a tuned one
        with its values before and after. A notebook shows it, and `.save(path)` writes it.
        """
        # Raises InputError for a case that cannot be run in a browser.
        return importlib.import_module("tuning.live.shown").of_result(self, plants)

    def save(self, folder: str | Path, command: str | None = None) -> list[Path]:
        """Write result.json, tables, pictures and report.html to `folder`; return their paths."""
        return self._report().save(self, folder, command)


def _first_picture(result: Any) -> bytes | None:
    """The first picture of a result as PNG bytes, None where it has none."""
    from jaxtank.plots.run import small

    plot: Any = getattr(result, "plot", None)
    return None if plot is None else small(plot())

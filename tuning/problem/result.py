"""What every result offers: text, HTML for a notebook, JSON, pictures and files.

The base classes of the results of `tuning`; their reports are opened when they are asked for.
"""

# `report`, which is opened when it is asked for, is not strict
# pyright: reportUnknownVariableType=false

import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from jaxtank.core.files import check_folder
from jaxtank.core.text import with_picture


class Shown:
    """A result that a notebook displays as HTML: what `str` reports, all of it escaped."""

    def _repr_html_(self) -> str:
        """Return the texts and tables of the result as a fragment of HTML, with a small picture
        once `jaxtank.notebook()` has been called.
        """
        from tuning.report.html import fragment

        return with_picture(fragment(self._sections()), lambda: _first_picture(self))

    def _sections(self) -> Sequence[Any]:
        """Return the sections of the result's Report."""
        from tuning.report.tables import Table

        return [Table(list(self._rows().items()))]

    def _rows(self) -> Mapping[str, Any]:
        """Return {name: value} of a result without a report."""
        raise NotImplementedError

    def __str__(self) -> str:
        return "\n".join(f"{name}: {value}" for name, value in self._rows().items())


class Result(Shown):
    """A result with a report: `print(result)`, `.to_json()`, `.plot()`, `.save(folder)`."""

    REPORT: ClassVar[str]

    def _report(self) -> Any:
        return importlib.import_module(self.REPORT)

    def _sections(self) -> Sequence[Any]:
        return self._report().report(self).sections

    def __str__(self) -> str:
        return repr(self)

    def __repr__(self) -> str:
        from tuning.report.document import terminal

        return terminal(self._report().report(self))

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
        check_folder(folder)
        return self._report().save(self, folder, command)


def _first_picture(result: Any) -> bytes | None:
    """The first picture of a result as PNG bytes, None where it has none."""
    from jaxtank.plots.run import small

    plot: Any = getattr(result, "plot", None)
    return None if plot is None else small(plot())

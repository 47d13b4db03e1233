"""Methods of every result: text, HTML for a notebook, JSON, pictures, files, a live page.

Made by `tuning.report`, which is registered in `tuning/__init__`.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxtank.core.files import check_folder
from jaxtank.core.lazy import HOMES, call, home
from jaxtank.core.text import with_picture


class Shown:
    """A result that a notebook displays as HTML: what `str` reports, all of it escaped."""

    def _repr_html_(self) -> str:
        """Return the texts and tables of the result as a fragment of HTML, with a small picture
        once `jaxtank.notebook()` has been called.
        """
        return with_picture(call("fragment", self._sections()), lambda: _first_picture(self))

    def _report(self) -> Any:
        return home(next(c.__name__ for c in type(self).__mro__ if c.__name__ in HOMES))

    def _sections(self) -> Sequence[Any]:
        """Return the sections of the result's Report."""
        return [call("Table", list(self._rows().items()))]

    def _rows(self) -> Mapping[str, Any]:
        """Return {name: value} of a result without a report."""
        raise NotImplementedError

    def __str__(self) -> str:
        return "\n".join(f"{name}: {value}" for name, value in self._rows().items())


class Result(Shown):
    """A result with a report: `print(result)`, `.to_json()`, `.plot()`, `.save(folder)`."""

    def _sections(self) -> Sequence[Any]:
        return self.report().sections_with_verdict

    def __str__(self) -> str:
        return repr(self)

    def __repr__(self) -> str:
        return call("terminal", self.report())

    def report(self) -> Any:
        """Return the `tuning.report.document.Report` of the result: what its renderers show."""
        return self._report().report(self)

    def to_json(self) -> dict[str, Any]:
        """Return the JSON object that the command prints with --json: plain numbers, no NaN."""
        return self._report().json_of(self)

    def plot(self) -> dict[str, Any]:
        """Return matplotlib figures {name: Figure} of the result."""
        return self._report().figures(self)

    def explore(self, plants: int | None = None) -> Any:
        """Return the live page of the result's case: of a tuned one with its values before and
        after. A notebook shows it, and `.save(path)` writes it.
        """
        # Raises InputError for a result without a case, and a case that a browser cannot run.
        return call("live_page_of", self, plants)

    def save(self, folder: str | Path, command: str | None = None) -> list[Path]:
        """Write result.json, tables, pictures and report.html to `folder`; return their paths."""
        check_folder(folder)
        module = self._report()
        if hasattr(module, "save"):
            return module.save(self, folder, command)
        return call("save_result", module, self, folder, command)


def _first_picture(result: Any) -> bytes | None:
    """The first picture of a result as PNG bytes, None where it has none."""
    from jaxtank.plots.run import small  # matplotlib, only where pictures are asked for

    plot: Any = getattr(result, "plot", None)
    return None if plot is None else small(plot())

"""The live page of a case or a result: saved as a file, shown by a notebook, put into a report."""

import dataclasses
import html
from pathlib import Path
from typing import Any

import numpy as np

from jaxtank import measures as ms
from jaxtank.core.errors import InputError
from jaxtank.core.files import write_folder
from jaxtank.core.tree import parameters
from tuning.live.page import page
from tuning.problem.functions import as_measures

HEIGHT = 900
"""Height of the page inside another one [px]."""


@dataclasses.dataclass(frozen=True)
class LivePage:
    """The live page of a case, which a notebook shows."""

    name: str
    text: str

    def save(self, path: str | Path) -> Path:
        """Write the page to a file, whole or not at all; return its path."""
        path = Path(path)
        if path.is_dir():
            raise InputError(f"--out {str(path)!r} is a folder: give a file, as {path}/page.html")
        return write_folder(path.parent, {path.name: self.text})[0]

    def _repr_html_(self) -> str:
        return frame(self)

    def __repr__(self) -> str:
        return f"LivePage({self.name!r}, {len(self.text)} characters): .save(path) writes it"


def frame(live: LivePage, height: int = HEIGHT) -> str:
    """Return an element that shows a live page inside another page, without access to that one."""
    title = html.escape(f"{live.name}, live")
    # in an attribute between double quotes; "<" also, for readers that look for elements
    inside = live.text.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")
    return (
        f'<iframe class="live" title="{title}" width="100%" height="{height}"'
        ' sandbox="allow-scripts allow-downloads" allow="clipboard-write" loading="lazy"'
        f' srcdoc="{inside}"></iframe>'
    )


def of_case(
    case: Any, presets: Any = (), source: str | None = None, plants: int | None = None
) -> LivePage:
    """Return the LivePage of a case; the arguments are those of `tuning.live.page.page`."""
    # Raises InputError for a case that cannot be run in a browser.
    return LivePage(case.name, page(case, presets, source, plants))


def of_result(result: Any, plants: int | None = None) -> LivePage:
    """Return the LivePage of a result of `tuning`: of its case, or of the tuned one with the values
    before and after as states to start from.
    """
    # Raises InputError for a result without a case, and a case that cannot be run in a browser.
    case, tuned = getattr(result, "case", None), getattr(result, "tuned", None)
    if case is None:
        raise InputError(f"{type(result).__name__} has no case of its own to explore")
    if tuned is not None and tuned.loop.safety_filter is not None:
        # designed for the plant, which is the same
        loop = dataclasses.replace(case.loop, safety_filter=tuned.loop.safety_filter)
        case = case.replace(loop=loop, safety=tuned.safety)
    problem = getattr(result, "problem", None)
    stated = None if problem is None else problem.given["limits"]
    if getattr(result, "answer", None) is not None:
        stated = result.tuned.limits  # its search leaves out limits that the safety filter keeps
    if stated is not None:
        _, limits = as_measures(None, stated)
        own = set(ms.functions(limits))  # a user's functions do not run in a browser
        limits = {m: value for m, value in limits.items() if m not in own}
        case = case.replace(limits=limits)  # those of the search, with --limit
    return of_case(case, states_of(result), plants=plants)


def states_of(result: Any) -> list[tuple[str, dict[str, Any], bool]]:
    """Return the states "before" and "after" of a TuningResult, [] of another result."""
    tuned = getattr(result, "tuned", None)
    if tuned is None:
        return []
    numbers = {n.split("[")[0] for n in parameters(result.case.loop)}
    changes = [(n, p) for n, p in result.parameters.items() if n.split("[")[0] in numbers]
    return [
        (
            when,
            {name: np.asarray(change[when], dtype=float) for name, change in changes},
            case.loop.safety_filter is not None,
        )
        for when, case in (("before", result.case), ("after", tuned))
    ]

"""All figures of the papers by name."""

from jaxtank.core.errors import InputError, unknown
from tuning.figures import calofir, gouta2015, gouta2022, khalid, mirakhorli
from tuning.figures.figure import Figure

FIGURES = {
    one.name: one
    for paper in (calofir, gouta2015, gouta2022, khalid, mirakhorli)
    for one in paper.FIGURES
}
"""{name: Figure}, in the order of papers and numbers."""


def find(name: str) -> Figure:
    """Return a figure that can be redrawn."""
    if name not in FIGURES:
        raise unknown("figure", name, FIGURES)
    found = FIGURES[name]
    if not found.runs:
        raise InputError(
            f"{name} ({found.shows[0].lower()}{found.shows[1:]}) shows no result that a run could"
            " redraw: jaxtank figure lists those that do"
        )
    return found

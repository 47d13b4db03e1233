"""What a figure of a paper shows, and which of our runs draw it. May import the case files."""

from collections.abc import Mapping
from typing import Any, NamedTuple

KINDS = ("levels", "errors", "inputs", "estimates", "shares", "setpoints", "memberships")
"""What the panels of a figure can show."""


class Run(NamedTuple):
    """One run in a figure.

    label : in the legend.
    case : name of the case.
    values : what is set in it, by dotted names.
    """

    label: str
    case: str
    values: Mapping[str, Any] = {}


class Figure(NamedTuple):
    """One figure of a paper.

    Parameters
    ----------
    paper, number : as in "gouta2015/6".
    shows : what the paper draws.
    states : what its text says of it; "" for nothing that can be checked.
    runs : ours, of which the first gives setpoints, rims and limits of the pumps.
    kind : one or several of KINDS, with spaces between; "" for a figure that is no result.
    tanks : indices of the tanks of "levels"; () for all.
    window : (from, to) [s] that is drawn; None for the whole run.
    remark : on our runs: what was assumed, and what cannot be as in the paper.
    """

    paper: str
    number: int
    shows: str
    states: str = ""
    runs: tuple[Run, ...] = ()
    kind: str = ""
    tanks: tuple[int, ...] = ()
    window: tuple[float, float] | None = None
    remark: str = ""

    @property
    def name(self) -> str:
        """As it is named in a command: "gouta2015/6"."""
        return f"{self.paper}/{self.number}"

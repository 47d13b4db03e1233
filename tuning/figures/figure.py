"""What a figure of a paper shows, and which of our runs draw it. May import the case files."""

from collections.abc import Mapping
from typing import Any, NamedTuple

KINDS = ("levels", "errors", "inputs", "estimates", "shares", "setpoints", "memberships")
"""What the panels of a figure can show."""


class Run(NamedTuple):
    """One run in a figure."""

    label: str
    case: str
    values: Mapping[str, Any] = {}


class Figure(NamedTuple):
    """One figure of a paper."""

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

"""The figures of the papers: content, and the runs that redraw them (figures.toml)."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from jaxtank.core.errors import InputError, unknown

KINDS = ("levels", "errors", "inputs", "estimates", "shares", "setpoints", "memberships")


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
        return f"{self.paper}/{self.number}"


def _figures() -> dict[str, Figure]:
    """{name: Figure}, in the order of papers and numbers."""
    text = Path(__file__).with_name("figures.toml").read_text(encoding="utf-8")
    figures = {}
    for paper, rows in tomllib.loads(text).items():
        for row in rows:
            runs = tuple(Run(**run) for run in row.pop("runs", ()))
            rest: dict[str, Any] = {
                k: tuple(v) if isinstance(v, list) else v for k, v in row.items()
            }
            figure = Figure(paper, runs=runs, **rest)
            figures[figure.name] = figure
    return figures


FIGURES = _figures()


def find(name: str) -> Figure:
    if name not in FIGURES:
        raise unknown("figure", name, FIGURES)
    figure = FIGURES[name]
    if not figure.runs:
        raise InputError(
            f"{name} ({figure.shows[0].lower()}{figure.shows[1:]}) shows no result that a run could"
            " redraw: jaxtank figure lists those that do"
        )
    return figure

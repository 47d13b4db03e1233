"""The papers, one file each: rigs, cases, published numbers, what may be tuned, what is uncertain,
departures.

preset = presets.load("gouta2015")
case = preset.cases["backstepping"]     # .loop .clock .limits

A paper is a module of this folder with a function `preset`; to add one, add its file.
"""

import dataclasses
import functools
import importlib
import pkgutil
from typing import cast

from jaxtank.case import Case, Free, Scenario, Symmetry
from jaxtank.core.errors import InputError, unknown
from jaxtank.presets.paper import Claim, Preset, Published

PAPERS = tuple(
    sorted(
        m.name
        for m in pkgutil.iter_modules(__path__)
        if m.name != "paper" and not m.name.startswith("_")
    )
)


def load(paper: str) -> Preset:
    """The Preset of `paper`, one of PAPERS; the Case of "paper/case", as `find`. Raises InputError
    for another name.

    >>> load("gouta2015/ngpc") is find("gouta2015/ngpc")
    True
    """
    if isinstance(paper, str) and "/" in paper:
        return cast("Preset", find(paper))
    if paper not in PAPERS:
        raise unknown("paper", str(paper), PAPERS)
    return _load(paper)


@functools.cache
def _load(paper):
    preset = importlib.import_module(f"jaxtank.presets.{paper}").preset()
    spread = {name: share for name, (share, _) in preset.uncertain.items()}
    cases = Cases({name: case.replace(uncertain=spread) for name, case in preset.cases.items()})
    return dataclasses.replace(preset, cases=cases)


class Cases(dict):
    """The cases of a paper by name; `cases[name]` raises InputError for an unknown one, with the
    nearest.
    """

    def __missing__(self, name):
        raise unknown("case", str(name), self)


def names() -> list[str]:
    """Every case as "paper/case", in the order of the papers."""
    return [f"{paper}/{case}" for paper in PAPERS for case in load(paper).cases]


def find(name: str) -> Case:
    """The Case of "paper/case". Raises InputError for an unknown one, with the nearest names."""
    if not isinstance(name, str):
        raise InputError(f"case {name!r}: must be a text, as 'gouta2015/ngpc'")
    paper, _, case = name.partition("/")
    if paper not in PAPERS:
        raise unknown("case", name, names())
    if case not in (cases := load(paper).cases):
        raise unknown("case", name, [f"{paper}/{other}" for other in cases])
    return cases[case]


__all__ = [
    "PAPERS",
    "Case",
    "Claim",
    "Free",
    "InputError",
    "Preset",
    "Published",
    "Scenario",
    "Symmetry",
    "find",
    "load",
    "names",
]

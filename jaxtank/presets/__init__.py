"""The papers, one file each: rigs, cases, published numbers, tunable parameters, departures.

A paper is a module of this folder with a function `preset`, found by its name; `register` adds one
from outside. What a paper prints is data, in <paper>.toml; the derivation is in notes/<paper>.md.

preset = presets.load("gouta2015")
case = preset.cases["backstepping"]     # .loop .clock .limits
"""

import dataclasses
import functools
import importlib
import pkgutil
from typing import cast

from jaxtank.case import Case, Free, Scenario, Symmetry
from jaxtank.core.errors import InputError, unknown
from jaxtank.presets.paper import Claim, Preset, Published

PAPERS = sorted(
    m.name
    for m in pkgutil.iter_modules(__path__)
    if m.name != "paper" and not m.ispkg and not m.name.startswith("_")
)
"""Names of the papers: the modules of this folder, then those that were added by `register`."""

_ADDED: dict[str, Preset] = {}


def register(preset: Preset) -> Preset:
    """Add a paper from outside this package.

    Its cases are then found by `find` and by the command line as "paper/case", and are printed by
    `jaxtank list`, `show` and `compare`.

    Parameters
    ----------
    preset : Preset

    Returns
    -------
    The preset.

    Raises
    ------
    InputError
        For a name that is taken by another paper, and for a case whose name does not begin with the
        paper's.

    Examples
    --------
    >>> from jaxtank import presets
    >>> preset = presets.load("cascaded")
    >>> case = preset.cases["pi"].replace(name="tutorial/pi", title="the first example")
    >>> own = dataclasses.replace(preset, paper="tutorial", cases={"pi": case})
    >>> _ = presets.register(own)
    >>> presets.find("tutorial/pi").title
    'the first example'
    """
    paper = preset.paper
    if _ADDED.get(paper) is preset:
        return preset
    if paper in PAPERS:
        raise InputError(f"paper {paper!r} is taken: choose another name")
    for name, case in preset.cases.items():
        if case.name != f"{paper}/{name}":
            raise InputError(f"case {case.name!r}: must be named {paper}/{name}")
    _ADDED[paper] = preset
    PAPERS.append(paper)
    return preset


def load(paper: str) -> Preset:
    """Return the Preset of a paper, or the Case of "paper/case" as `find` does.

    Parameters
    ----------
    paper : one of PAPERS, or "paper/case"

    Returns
    -------
    Preset; a Case for "paper/case"

    Raises
    ------
    InputError
        For an unknown paper or case, with the nearest names.

    Examples
    --------
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
    preset = _ADDED.get(paper) or importlib.import_module(f"jaxtank.presets.{paper}").preset()
    spread = {name: share for name, (share, _) in preset.uncertain.items()}
    known = lambda case: case.replace(uncertain=spread, origin=case.name)
    cases = {name: known(case) for name, case in preset.cases.items()}
    return dataclasses.replace(preset, cases=Cases(cases))


class Cases(dict):
    """The cases of a paper by name; an unknown one raises InputError.

    Examples
    --------
    >>> load("calofir").cases["rest"]
    Traceback (most recent call last):
    ...
    jaxtank.core.errors.InputError: unknown case 'rest'...
    """

    def __missing__(self, name):
        raise unknown("case", str(name), self)


def names() -> list[str]:
    """Return every case as "paper/case", in the order of the papers.

    Returns
    -------
    list of text

    Examples
    --------
    >>> "khalid/gpc" in names()
    True
    """
    return [f"{paper}/{case}" for paper in PAPERS for case in load(paper).cases]


def has(name: str) -> bool:
    """Return whether there is a case "paper/case"; loads its paper alone."""
    paper, _, case = name.partition("/")
    return paper in PAPERS and case in load(paper).cases


def find(name: str) -> Case:
    """Return the Case of "paper/case".

    Parameters
    ----------
    name : "paper/case", as `names` lists them

    Returns
    -------
    Case

    Raises
    ------
    InputError
        For an unknown one, with the nearest names.

    Examples
    --------
    >>> find("mirakhorli/sfc").clock.duration
    400.0
    """
    if not isinstance(name, str):
        raise InputError(f"case {name!r}: must be a text, as 'gouta2015/ngpc'")
    paper, _, case = name.partition("/")
    if "." in name:
        raise InputError(f"unknown case {name!r}: the name of a rig file ends in .toml")
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
    "register",
]

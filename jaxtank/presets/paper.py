"""What a paper is made of: its cases, what it prints, and what is found of that.

Imported by the papers of this folder, and by papers from outside.
"""

import dataclasses
import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from jaxtank.case import Case, Free


class Published(NamedTuple):
    """Something a paper prints: a number (or a tuple of them), or a claim in words.

    value : number, tuple of numbers, or text
    unit : its unit, "" for a claim
    where : section, table or figure of the paper
    tolerance : share of the printed number by which the measured one may differ and still count as
        reproduced; None for a number that is only quoted (a gain, a limit) and for a claim
    reason : why the measured number differs, or why it cannot be measured
    fitted : the assumption of ours that was chosen to come near this number, which is then no
        evidence for the paper; "" for none

    Examples
    --------
    >>> Published(12.0, "V", "eq. (9)").tolerance is None
    True
    """

    value: Any
    unit: str
    where: str
    tolerance: float | None = None
    reason: str = ""
    fitted: str = ""


class Claim(NamedTuple):
    """What was found of a claim in words.

    verdict : "reproduced", "partly" or "not reproduced"
    text : the numbers from which the verdict follows

    Examples
    --------
    >>> Claim("reproduced", "largest error 1e-4 m").verdict
    'reproduced'
    """

    verdict: str
    text: str


def verdict(holds: bool) -> str:
    """Return the verdict of a claim that was measured to hold, or not to.

    Examples
    --------
    >>> verdict(2 > 1)
    'reproduced'
    """
    return "reproduced" if holds else "not reproduced"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Preset:
    """A paper: its rig with several controllers, and its published numbers.

    Parameters
    ----------
    paper : name of the paper; its cases are called paper/case
    citation : authors, title, year
    cases : {name: Case}
    published : {parameter or quantity: Published}
    measured : function of `run` that returns {quantity: number, tuple or Claim} for what can be
        measured, where run(case name, values={}, save_every=1) gives (Case with `values` set,
        Trajectory as host arrays)
    tunable : {parameter: Free}
    uncertain : {parameter: (spread as a share of it, why)}
    departures : sentences, each on what differs from the paper and why

    Examples
    --------
    >>> from jaxtank import presets
    >>> preset = presets.load("calofir")
    >>> sorted(preset.cases), preset.notes.name
    (['backstepping', 'backstepping-perturbed'], 'calofir.md')
    """

    paper: str
    citation: str
    cases: Mapping[str, Case]
    published: Mapping[str, Published]
    measured: Callable
    tunable: Mapping[str, Free]
    uncertain: Mapping[str, tuple]
    departures: tuple

    @property
    def notes(self) -> Path:
        """Path of the derivation: equations as used, errata, assumptions, reference values.

        It is notes/<paper>.md beside the file that defines `measured`. Messages name its sections.
        """
        return Path(inspect.getfile(self.measured)).with_name("notes") / f"{self.paper}.md"

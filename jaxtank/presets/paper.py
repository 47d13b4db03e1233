"""What a preset and a case are made of."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from jaxtank.case import Case, Free


class Published(NamedTuple):
    """Something a paper prints: a number (or a tuple of them), or a claim in words.

    tolerance: how far the measured number may be off, as a share of the printed one, and still
    count as reproduced; None: a number that is only quoted (a gain, a limit), or a claim. reason:
    why the measured one differs, or why it cannot be measured.
    """

    value: Any
    unit: str
    where: str
    tolerance: float | None = None
    reason: str = ""


class Claim(NamedTuple):
    """What was found of a claim: whether it holds ("reproduced", "partly", "not reproduced"), and
    the numbers that say so.
    """

    verdict: str
    text: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class Preset:
    """A paper.

    published: {parameter or quantity: Published}; measured: a function of `run` that returns
    {quantity: number, tuple or Claim} for what can be measured, where run(case name, values={},
    save_every=1) gives (Case with `values` set, Trajectory as host arrays);
    tunable: {parameter: Free}; uncertain: {parameter: (spread as a fraction, why)}; departures:
    sentences, what differs from the paper and why.
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
        Messages name its sections.
        """
        return Path(__file__).with_name("notes") / f"{self.paper}.md"

"""What a preset and a case are made of."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

from jaxtank.loop import ClosedLoop
from jaxtank.records import Clock


class Free(NamedTuple):
    """Where a tunable parameter may lie, in its own unit; "log" for gains and times, "linear" for what may pass through 0."""

    low: float
    high: float
    scale: str = "log"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """One rig, one law, one reference, one clock, with the gains its paper prints.

    limits: {measure: upper limit (number, or one per entry), or "rim" for the rim of each tank}; free: {parameter: Free}, what
    `tune` tunes unless told otherwise; objective: {measure: weight}, what it makes small.
    """

    name: str
    title: str
    loop: ClosedLoop
    clock: Clock
    limits: Mapping[str, Any]
    free: Mapping[str, Free]
    objective: Mapping[str, float]

    def replace(self, **changes):
        """A copy with the named fields changed."""
        return dataclasses.replace(self, **changes)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Preset:
    """A paper.

    published: {parameter or quantity: (value as printed, where)}; tunable: {parameter: Free}; uncertain: {parameter: (spread as a
    fraction, why)}; departures: sentences, what differs from the paper and why.
    """

    paper: str
    citation: str
    cases: Mapping[str, Case]
    published: Mapping[str, tuple]
    tunable: Mapping[str, Free]
    uncertain: Mapping[str, tuple]
    departures: tuple

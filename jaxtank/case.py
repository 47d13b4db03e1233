"""A case: one rig, one controller, one reference, one clock, and what may be tuned on it."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from jaxtank.core.clock import Clock
from jaxtank.loop.closed_loop import ClosedLoop


class Free(NamedTuple):
    """Where a tunable parameter may lie, in its own unit; "log" for gains and times, "linear" for
    what may pass through 0.
    """

    low: float
    high: float
    scale: str = "log"


class Scenario(NamedTuple):
    """One of several runs that a tuning is judged by: the case with `values` set by dotted name
    (sensor noise, a weaker pump, other setpoints, another duration), its sensor noise drawn with
    `seed`, counted with `weight` in the mean over scenarios [-].

    A value is a number in the parameter's unit, or a text relative to the case as it stands:
    "x1.3", "by -0.5", "0.02 if zero", "steady" (`rig.set_scenario`).
    """

    name: str
    values: Mapping[str, Any] = {}
    seed: int = 0
    weight: float = 1.0


class Mirror(NamedTuple):
    """Gains that exchange roles: image({name: value}) are the values, of some or all names, that
    give the same loop or nearly so.
    """

    words: str
    image: Callable


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """One rig, one law, one reference, one clock, with the gains its paper prints.

    limits: {measure: upper limit (number, or one per entry), or "rim" for the rim of each tank};
    free: {parameter: Free}, what `tune` tunes unless told otherwise; objective: {measure: weight},
    what it makes small; reachable: whether every plateau of the reference must have a steady state
    within the pumps' direction (False where the paper asks for one that has none); scenarios: what
    `tune` judges by instead of the case's own run, () for that alone; mirror: gains that exchange
    roles, where the law has such;
    uncertain: {parameter of the plant: spread as a share of it}, what a result is validated on;
    covariance: (names (n,), covariance (n, n) in their units) of parameters that were identified
    together, or None; log: {"t", "pump1", "h1", ..: column of a log, its unit in its header}, where
    a log of this rig names them otherwise; names: {"tank" or "pump": a name of each, "" for none},
    where a rig gives them.
    """

    name: str
    title: str
    loop: ClosedLoop
    clock: Clock
    limits: Mapping[str, Any]
    free: Mapping[str, Free]
    objective: Mapping[str, float]
    reachable: bool = True
    scenarios: tuple[Scenario, ...] = ()
    mirror: Mirror | None = None
    uncertain: Mapping[str, float] = dataclasses.field(default_factory=dict)
    covariance: tuple | None = None
    log: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    names: Mapping[str, tuple] = dataclasses.field(default_factory=dict)

    def replace(self, **changes: Any) -> "Case":
        """A copy with the named fields changed."""
        return dataclasses.replace(self, **changes)

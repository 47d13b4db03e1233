"""Measures that a result reports, of the case's own run and of every scenario."""

# functions of jax and of `measures` whose types are not complete
# pyright: reportUnknownMemberType=false

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from jaxtank import measures as ms
from jaxtank.core.clock import Clock
from jaxtank.core.labels import input_unit, label_of
from jaxtank.core.tree import with_values
from jaxtank.loop import run as lp
from jaxtank.loop.closed_loop import ClosedLoop, zero_of
from jaxtank.loop.margins import worst
from tuning.problem import scenarios as sc
from tuning.problem.problem import Problem
from tuning.problem.tracking import UNJUDGED


def run_measures(
    loop: ClosedLoop, clock: Clock, key: Any, besides: Iterable[str] = ()
) -> dict[str, np.ndarray]:
    """Return {measure: value} of everything that is reported of one run."""
    values = lp.evaluate(loop, clock, reported_names(loop, besides), key)
    return {m: np.asarray(v) for m, v in values.items()}


CHATTER = 0.1
"""Mean change of an input from sample to sample, as a share of its range, above which it is said
to chatter [-]. Of the preset cases only the relay of mirakhorli passes 0.01."""


def chatter(loop: ClosedLoop, clock: Clock, values: Mapping[str, Any]) -> list[str]:
    """Return a sentence where a controller moves an input at every sample; `values`: measures."""
    if isinstance(loop.controller, UNJUDGED) or "input_travel" not in values:
        return []
    pumps, bank = loop.plant.pumps, loop.actuator
    low, high = (np.broadcast_to(np.asarray(v, float), pumps) for v in (bank.low, bank.high))
    most = clock.samples * (high - low)
    travel = np.divide(values["input_travel"], most, out=np.zeros_like(most), where=most > 0.0)
    j = int(np.argmax(travel))
    if not travel[j] > CHATTER:
        return []
    remedy = "smaller gains, a filter of the derivative or the sensor, or less noise"
    zone = getattr(bank, "dead_zone", None)
    zone = 0.0 if zone is None else float(np.broadcast_to(np.asarray(zone), pumps)[j])
    if zone > 0.0 and getattr(bank, "dead_zone_kind", "") == "plain":
        unit = input_unit(loop.plant, j, loop.units[1])
        remedy = f"it stands still below its dead_zone, {zone:g} {unit}; {remedy}"
    return [
        f"the input of {label_of(loop.plant, 'pump', j)} chatters: it changes by"
        f" {100 * travel[j]:.0f} % of its range from sample to sample, in the mean ({remedy})"
    ]


def in_force(loop: ClosedLoop, values: Mapping[str, float]) -> dict[str, float]:
    """Return `values` of free parameters, those that the controller clips as they act."""
    controller: Any = with_values(loop, values).controller
    # a class of the user's may have none
    clipped: dict[str, Any] = getattr(controller, "in_force", dict)()
    acting = dict(values)
    for leaf, value in clipped.items():
        for index in np.ndindex(np.shape(value)):
            entry = f"controller.{leaf}" + (f"[{','.join(map(str, index))}]" if index else "")
            if entry in acting:
                acting[entry] = float(np.asarray(value)[index])
    return acting


class Deferred(Mapping[str, Any]):
    """Measures of a run that is made when one is asked for that is not known yet."""

    def __init__(
        self, names: Iterable[str], known: Mapping[str, Any], make: Callable[[], Mapping[str, Any]]
    ):
        self.names, self.known, self.make = dict.fromkeys(names), dict(known), make
        self.made = False

    def __getitem__(self, name: str) -> Any:
        if name in self.names and name not in self.known and not self.made:
            self.known, self.made = dict(self.make()), True
        return self.known[name]

    def __repr__(self) -> str:
        return repr(dict(self))

    def __reduce__(self) -> Any:
        return dict, (dict(self),)  # another process has no use for a run of this one

    def __contains__(self, name: object) -> bool:
        return name in self.names

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)


def margin_measures(loop: ClosedLoop, clock: Clock) -> dict[str, np.ndarray]:
    """Return {measure: value} of the linearised loop at its worst plateau; {} without setpoints."""
    names = tuple(m for m in ms.linear() if ms.serves(m, loop))
    if not names or zero_of(loop).dtype != np.float64:
        return {}
    margins = worst(loop, clock)
    return {m: np.asarray(getattr(margins, m)) for m in names}


def table_of(problem: Problem, values: dict[str, float]) -> list[dict[str, Any]]:
    """Return {measure: value} of every scenario at {parameter: value}."""
    points = {n: np.array([v]) for n, v in values.items()}
    table: list[Any] = [None] * len(problem.runs)
    for group in problem.groups:
        loop = problem.runs[group.runs[0]].case.loop
        measures, _ = sc.values_of(group, reported_names(loop, problem.needed), points)
        for j, i in enumerate(group.runs):
            table[i] = {m: np.asarray(v)[0, j] for m, v in measures.items()}
    return table


def reported_names(loop: ClosedLoop, besides: Iterable[str] = ()) -> tuple[str, ...]:
    """Return the measures that are reported of a loop, and when levels were reached."""
    known = (m for m in ms.reported() if ms.serves(m, loop))
    besides = tuple(besides)
    linear = (m for m in besides if ms.MEASURES[m].linear)
    return (*known, *ms.times(), *ms.functions(besides), *linear)

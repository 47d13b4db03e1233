"""Limits: a measure, its limit, and the margin to it."""

# functions of jax and of `measures` whose types are not complete
# pyright: reportUnknownMemberType=false

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxtank import measures as ms
from jaxtank.case import Case
from jaxtank.core.errors import InputError
from jaxtank.core.labels import label_of, place_of
from jaxtank.loop.change_windows import windows
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.loop.step_size import DREGS
from jaxtank.rig import check_limits

UNDEFINED_MARGIN = 1e6
"""Amount by which a measure that is infinite (never settled) or undefined (never reached 90 % of
the step) is taken to violate its limit.
"""

SMALLEST_SCALE = 1e-3
"""Share of the size of the measured quantity below which a limit is as good as 0 [-]."""

EMPTY = 1e-4  # share of the rim below which a tank is empty; above DREGS of its rim it never is [-]

PASSED = 2e-3
"""Share of a limit of the controller above which a level passes it [-]."""

NO_OVERFLOW = 1e-6
"""Volume lost that counts as no overflow where overflow is simulated, in tank volumes [-]."""


@dataclasses.dataclass(frozen=True)
class Limit:
    """One hard constraint: entry `index` of `measure` at most (or at least) `value`, in one run."""

    measure: str
    index: int
    value: float
    run: int = 0
    scenario: str = ""
    name: str = ""  # of the entry's tank, pump or valve
    place: str = ""  # the same for people, of an output its tank

    @property
    def sign(self) -> float:
        """+1 for an upper limit, -1 for a lower one."""
        return ms.MEASURES[self.measure].sense

    @property
    def label(self) -> str:
        """Name with the entry, by name or from 1: "max_level of tank 3", and its scenario."""
        per = ms.MEASURES[self.measure].per
        where = f" in {self.scenario}" if self.scenario else ""
        entry = self.name or f"{per} {self.index + 1}"
        return (self.measure if per == "run" else f"{self.measure} of {entry}") + where

    @property
    def words(self) -> str:
        """The limited entry for people: "highest level of tank 3", and its scenario."""
        per, where = ms.MEASURES[self.measure].per, f" in {self.scenario}" if self.scenario else ""
        place = self.place or self.name or f"{per} {self.index + 1}"
        return ms.label(self.measure) + (f" of {place}" if per != "run" else "") + where

    @property
    def key(self) -> tuple[str, int]:
        """The limited measure and its entry, in whatever run."""
        return self.measure, self.index

    def margin(self, measures: Mapping[str, Any]) -> float:
        """Return the distance to the limit, positive where it holds; see `margins`."""
        return float(self.margins(np.ravel(measures[self.measure])[self.index]))

    def margins(self, values: ArrayLike) -> NDArray[np.float64]:
        """Return the margin for each of `values` of the measure, in its unit."""
        # An infinite value (never settled) violates the limit by UNDEFINED_MARGIN, as does an
        # undefined one (a rise that never reached 90 %). An undefined settling time holds: the
        # output never left its band.
        undefined = UNDEFINED_MARGIN if ms.MEASURES[self.measure].nan_holds else -UNDEFINED_MARGIN
        distance = self.sign * (self.value - np.asarray(values))
        clipped = np.clip(distance, -UNDEFINED_MARGIN, UNDEFINED_MARGIN)
        return np.where(np.isnan(values), undefined, clipped)


def limited_levels(case: Case) -> NDArray[np.float64]:
    """Return the (tanks,) limits on the highest levels; inf where there is none."""
    limit = case.limits.get("max_level", np.inf)
    limit = case.loop.plant.rim if isinstance(limit, str) else limit
    return np.broadcast_to(np.asarray(limit, dtype=float), (case.loop.plant.tanks,))


def lowest_levels(case: Case) -> NDArray[np.float64]:
    """Return the (tanks,) limits on the lowest levels; -inf where there is none."""
    limit = np.asarray(case.limits.get("min_level", -np.inf), dtype=float)
    return np.broadcast_to(limit, (case.loop.plant.tanks,))


def dry_level(rim: float, share: float) -> float:
    """Return the level up to which a tank is empty for a pump with this ratio of `pump_draws`."""
    return max(EMPTY, DREGS * min(1.0, share)) * rim if np.isfinite(rim) else 0.0


def tightened(
    plant: Any, limits: Mapping[str, Any], amounts: Mapping[tuple[str, int], float]
) -> dict[str, Any]:
    """Return {measure: value} of `limits`, entries moved inward by {(measure, entry): amount}."""
    tighter = dict(limits)
    for (measure, index), amount in amounts.items():
        if amount:
            value = plant.rim if isinstance(tighter[measure], str) else tighter[measure]
            values = np.array(np.broadcast_to(np.asarray(value, float), ms.entries(measure, plant)))
            values[index] -= ms.MEASURES[measure].sense * amount
            tighter[measure] = values.tolist()
    return tighter


def limit_scale(limit: Limit, loop: ClosedLoop) -> float:
    """Return the size by which a limit's margin counts, in the measure's unit."""
    # The limit's own size, but no less than a thousandth of the measured quantity (the tanks'
    # height or volume, 1 for a share, 100 for percent), which matters where a limit is 0 or nearly.
    plant: Any = loop.plant  # of any class: no other plant overflows, and some have no area to name
    length, rim = loop.units[0], np.asarray(plant.rim)
    area = np.asarray(plant.area) if plant.overflow else 1.0
    size = {
        length: float(np.max(rim)),
        f"{length}^3": float(np.max(rim * area)),
        "%": 100.0,
        "-": 1.0,
    }.get(ms.unit(limit.measure, loop.units))
    if size is None:
        return abs(limit.value) or 1.0
    return max(abs(limit.value), SMALLEST_SCALE * size)


def resolve_limits(
    case: Case, limits: Mapping[str, Any] | None = None, governed: bool = True
) -> list[Limit]:
    """Return the Limits of {measure: number, list or "rim"}; the case's own where None."""
    # governed: with the levels that a reference governor keeps (`Controller.keeps_limits`).
    # With rims as physics a level cannot pass its rim, so a limit at the rim becomes one of no
    # overflow volume. An entry that is undefined on the case's run (see `undefined`) has no Limit.
    # Raises InputError for an unknown measure, a value that is no number, and a measure all of
    # whose entries are undefined.
    return resolve_in([("", case)], limits, governed)


def resolve_in(
    runs: Sequence[tuple[str, Case]], limits: Mapping[str, Any] | None, governed: bool = True
) -> list[Limit]:
    """Return the Limits of `resolve_limits` in each run, a (scenario, case), with its number."""
    resolved: list[Limit] = []
    why: dict[str, tuple[Any, str]] = {}
    for i, (scenario, case) in enumerate(runs):
        loop = case.loop
        stated = check_limits(loop, case.limits if limits is None else limits)
        for measure, value in _with_governor(loop, stated, governed).items():
            reason, missing = undefined(measure, case)
            per = ms.MEASURES[measure].per
            if all(missing):
                why.setdefault(measure, (value, reason))
                continue
            for j, v in enumerate(np.broadcast_to(np.asarray(value, dtype=float), (len(missing),))):
                if not missing[j] and np.isfinite(v):
                    measured, at = _without_overflow(measure, j, float(v), loop.plant)
                    entry = (loop.plant, per, j)
                    names = ("", "") if per == "run" else (label_of(*entry), place_of(*entry))
                    resolved.append(Limit(measured, j, at, i, scenario, *names))
    for measure, (value, reason) in why.items():
        if not any(limit.measure == measure for limit in resolved):
            text = ", ".join(f"{v:g}" for v in np.ravel(value))
            where = "in every scenario" if len(runs) > 1 else "on this run"
            raise InputError(
                f"limit {measure} = {text} {ms.unit(measure, runs[0][1].loop.units)}: undefined"
                f" {where}: {reason}, or drop the limit (--limit {measure}=none)"
            )
    return resolved


def _with_governor(loop: ClosedLoop, limits: Mapping[str, Any], governed: bool) -> dict[str, Any]:
    """{measure: value} of limits, with those of levels that the controller keeps if `governed`."""
    rim = np.asarray(getattr(loop.plant, "rim", np.inf))
    numbers = {m: rim if isinstance(value, str) else value for m, value in limits.items()}
    governed = governed and loop.controller.keeps_limits
    rows = loop.controller.level_limits() if governed else []
    if rows:
        _, lowest, highest = np.transpose(rows)
        highest = np.where(highest < rim, highest, np.inf)
        for measure, ends, sense in (("max_level", highest, 1.0), ("min_level", lowest, -1.0)):
            ends = sense * ends + PASSED * np.abs(ends)
            if np.any(np.isfinite(ends)):
                stated = sense * np.asarray(numbers.get(measure, sense * np.inf), dtype=float)
                numbers[measure] = sense * np.minimum(stated, ends)
    return numbers


def of_drawn_rims(limits: Sequence[Limit], plant: Any, names: Iterable[str]) -> list[Limit]:
    """Return `limits`; where rims are among the drawn `names`, limits on levels keep these below
    the rim of each plant too.
    """
    if not any(name.split("[")[0] == "plant.rim" for name in names):
        return list(limits)
    rim = np.broadcast_to(np.asarray(plant.rim, dtype=float), (plant.tanks,))
    drawn: list[Limit] = []
    for limit in limits:
        if limit.measure != "max_level":
            drawn.append(limit)
            continue
        if limit.value != rim[limit.index]:
            drawn.append(limit)
        above, value = "max_over_rim", 0.0
        if plant.overflow:
            above, value = _without_overflow("max_level", limit.index, np.inf, plant)
        drawn.append(dataclasses.replace(limit, measure=above, value=value))
    return drawn


def _without_overflow(measure: str, index: int, value: float, plant: Any) -> tuple[str, float]:
    """Return (measure, value) of a limit; one at a rim that is physics limits the overflow."""
    if plant.overflow and measure == "max_level" and value >= np.asarray(plant.rim)[index]:
        full = plant.stored(plant.rim) if plant.by_volume else plant.area * plant.rim
        return "overflow_volume", NO_OVERFLOW * float(full[index])
    return measure, value


def without_overflow(loop: ClosedLoop) -> ClosedLoop:
    """Return a loop whose levels may rise past the rims, where that can be seen."""
    plant: Any = loop.plant
    if not plant.overflow:
        return loop
    return dataclasses.replace(loop, plant=dataclasses.replace(plant, overflow=False))


def undefined(measure: str, case: Case) -> tuple[str, list[bool]]:
    """Return (reason and remedy, (entries,) True where `measure` has no value on the run)."""
    references, clock, loop = ms.refers_to([measure]), case.clock, case.loop
    onset = None if loop.disturbance is None else loop.disturbance.since(clock)
    since = np.full(1, -1.0) if onset is None else np.asarray(onset)
    if "since" in references and onset is not None:
        why = f"no inflow disturbance begins within its {clock.duration:g} s; add one ([[inflow]])"
        return why, [not np.any(since >= 0.0)] * ms.entries(measure, loop.plant)
    all_windows = windows(loop, clock) if "window" in references else None
    if all_windows is not None:
        steps = [np.asarray(window[1]) for window in all_windows]
        why = (
            f"no setpoint has a step within its {clock.duration:g} s, and no level starts away from"
            " a constant setpoint; add one (reference.changes, or x0)"
        )
        return why, [not np.any((step != 0.0) & (since < 0.0)) for step in steps]
    return "", [False] * ms.entries(measure, loop.plant)

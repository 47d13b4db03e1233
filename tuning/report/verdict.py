"""The verdict on a result: one sentence; `verdictOf` in jaxtank/live/core.js has the same rules."""

import dataclasses
import decimal
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np

from jaxtank import measures as ms
from jaxtank.case import Case
from jaxtank.controllers import NMPC, ReferenceGovernor
from jaxtank.core.labels import label_of, labels_of
from jaxtank.core.text import count
from jaxtank.limits import PASSED, dry_level, limit_scale, resolve_limits
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.loop.step_size import pump_draws
from jaxtank.observers import Direct
from tuning.problem.tracking import is_averaging, not_tracking, tracked_of
from tuning.search.result import row_of
from tuning.search.robustness import PEAKS

WHEN = "time_of_steady_state_error"
EXACT = 1e-4  # share of a tank's height below which a miss is not worth a number


class Part(NamedTuple):
    """One part of a verdict."""

    words: str
    good: bool = True


@dataclasses.dataclass(frozen=True, kw_only=True)
class Verdict:
    """Whether a result is good, and why; a part that is not known is None."""

    outcome: Part | None = None  # end of a search, or of a command without a run of the loop
    tracking: Part | None = None
    limits: Part | None = None
    plants: Part | None = None
    robustness: Part | None = None

    @property
    def _parts(self) -> list[Part]:
        names = (field.name for field in dataclasses.fields(self))
        return [part for name in names if (part := getattr(self, name)) is not None]

    @property
    def good(self) -> bool:
        return all(part.good for part in self._parts)

    @property
    def sentence(self) -> str:
        """The parts that are known; without the limits where they hold on every plant."""
        implied = self.limits and self.limits.good and self.plants and self.plants.good
        parts = (part for part in self._parts if not (implied and part is self.limits))
        return "; ".join(part.words for part in parts)

    def __str__(self) -> str:
        return self.sentence

    def to_json(self) -> dict[str, Any]:
        names = ("tracking", "limits", "plants", "robustness")
        parts = {n: None if (part := getattr(self, n)) is None else part.words for n in names}
        return {"good": self.good, "sentence": self.sentence, **parts}


def outcome(words: str, good: bool = True) -> Verdict:
    """Return the Verdict of a result that judges no run of a loop."""
    return Verdict(outcome=Part(words, good))


def of_run(case: Case, values: Mapping[str, Any]) -> Verdict:
    rows = limit_rows(case, values)
    return Verdict(
        tracking=tracking(case.loop, values),
        limits=limits(rows, beyond(case, values, rows)),
        robustness=robustness(values),
    )


def beyond(case: Case, values: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return faults without a limit in `rows`: levels above rims, spilling, dry pumps."""
    loop, plant = case.loop, cast(Any, case.loop.plant)
    if "max_level" not in values or not hasattr(plant, "rim"):
        return []
    rims = np.broadcast_to(plant.rim, plant.tanks)
    tops = [row for row in rows if row["measure"] in ("max_level", "overflow_volume")]
    limits = {row["tank"]: row["limit"] for row in tops}
    free = [i for i, rim in enumerate(rims) if not limits.get(i + 1, np.inf) <= 2.0 * rim]
    past = [*_past_rims(loop, values, rims, free), *past_controller_limits(loop, values)]
    return [*past, *_dry_pumps(case, values, rims)]


def _past_rims(loop, values, rims, tanks):
    unit, zero = loop.units[0], np.zeros(len(rims))
    highest, spilled = (
        np.ravel(np.asarray(values.get(name, zero), dtype=float))
        for name in ("max_level", "overflow_volume")
    )
    for i in (i for i in tanks if np.isfinite(rims[i])):
        tank, rim = label_of(loop.plant, "tank", i), f"{shown(rims[i])} {unit}"
        if highest[i] > rims[i] * (1.0 + 1e-9):
            yield f"{tank} rises to {shown(highest[i])} {unit}, above its rim of {rim}"
        elif spilled[i] > 0.0:
            yield f"{shown(spilled[i])} {unit}^3 spill over the rim of {tank}"


def _dry_pumps(case, values, rims):
    plant = case.loop.plant
    lowest = np.ravel(values.get("min_level", np.inf + rims))
    for j, i, share in pump_draws(case.loop, case.clock):
        if lowest[i] <= dry_level(rims[i], share):
            tank, pump = label_of(plant, "tank", i), label_of(plant, "pump", j)
            yield f"{tank}, from which {pump} draws, runs empty"


def past_controller_limits(loop: ClosedLoop, values: Mapping[str, Any]) -> list[str]:
    """Return which levels pass a limit of a controller that predicts them; `values`: measures."""
    controller: Any = loop.controller
    if not isinstance(loop.controller, NMPC | ReferenceGovernor):
        return []
    unit, sentences = loop.units[0], list[str]()
    rows = [("max_level", "limit", 1.0, "rises to", "above")]
    if isinstance(loop.controller, ReferenceGovernor):
        rows.append(("min_level", "lowest", -1.0, "falls to", "below"))
    for measure, name, sign, moves, side in rows:
        if measure not in values:
            continue
        levels, limits = np.asarray(values[measure]), np.asarray(getattr(controller, name))
        violated = np.isfinite(limits) & (sign * (levels - limits) > PASSED * np.abs(limits))
        sentences += [
            f"{label_of(loop.plant, 'tank', int(i))} {moves} {shown(levels[i])} {unit}, {side}"
            f" controller.{name} of {shown(limits[i])} {unit}"
            for i in np.flatnonzero(violated)
        ]
    return sentences


def about_controller_limits(loop: ClosedLoop, values: Mapping[str, Any]) -> list[str]:
    violations = past_controller_limits(loop, values)
    reason = "the prediction of the controller is too short or too coarse (horizon, samples), or "
    if isinstance(loop.observer, Direct):
        reason += 'knows no inflow ([observer] kind = "disturbance" estimates it)'
    else:
        reason += "the plant differs from the controller's model (a fault, for example)"
    offset = getattr(loop.sensor, "offset", None)
    if offset is not None and np.any(offset):
        reason += ", or a sensor has an offset"
    return [f"{'; '.join(violations)}: {reason}"] * bool(violations)


def tracking(loop: ClosedLoop, values: Mapping[str, Any]) -> Part | None:
    """Return how near levels come to setpoints: at plateaus, else by their RMS errors."""
    tracked = tracked_of(loop, values)
    if tracked is None:
        return None
    unit, plant = loop.units[0], loop.plant
    error = np.ravel(values.get("rms_error_total", math.hypot(*tracked.rms)))[0]
    total = f"RMS error {shown(error)} {unit}"
    largest = lambda sizes, where: int(np.argmax(np.where(where, sizes, -np.inf)))
    name = lambda kind, i: label_of(plant, kind, i)
    if not np.all(np.isfinite(tracked.rms)):
        return Part("the run diverged: a level is not a finite number", False)
    if np.any(tracked.off):
        o = largest(tracked.missed / tracked.allowed, tracked.off)
        tank, amount = name("tank", plant.outputs[o]), f"{shown(tracked.missed[o])} {unit}"
        if tracked.swing[o] == tracked.missed[o]:
            return Part(f"{tank} swings {amount} to either side of its setpoint, {total}", False)
        at = f" at {shown(np.ravel(values[WHEN])[o], 5)} s" if WHEN in values else ""
        return Part(f"{tank} is {amount} off its setpoint{at}, {total}", False)
    if np.any(tracked.loose | tracked.stuck):
        o = largest(tracked.rms / tracked.heights, tracked.loose | tracked.stuck)
        tank, amount = name("tank", plant.outputs[o]), f"{shown(tracked.rms[o])} {unit}"
        busy = np.asarray(values["saturated_fraction"], dtype=float)
        j = int(np.argmax(busy))
        at = f", {name('pump', j)} is at a limit in {shown(100.0 * busy[j])} % of the samples"
        return Part(f"{tank} has an RMS error of {amount}" + at * bool(tracked.stuck[o]), False)
    if np.isnan(tracked.missed).all():
        return Part(f"tracks with {total}")
    if np.nanmax(tracked.missed / tracked.heights) < EXACT:
        return Part(f"settles on its setpoints, {total}")
    return Part(f"comes within {shown(np.nanmax(tracked.missed))} {unit} of each setpoint, {total}")


def limit_rows(case: Case, values: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the limits of a run as fields of `ConstraintRow`, the tightest first."""
    rows = []
    for limit in resolve_limits(case, governed=False):
        if limit.measure not in values:
            continue
        entry = lambda name, i=limit.index: float(np.ravel(values[name])[i])
        reached = ms.MEASURES[limit.measure].reached
        time_s = entry(reached) if reached in values else None
        row = row_of(limit, case.loop, entry(limit.measure), time_s=time_s).to_json()
        rows.append(row | {"scale": limit_scale(limit, case.loop)})
    return sorted(rows, key=_share)


def _share(row):
    return row["margin"] / (row.get("scale") or abs(row["limit"]) or 1.0)


def limits(rows: Sequence[Mapping[str, Any]], more: Sequence[str] = ()) -> Part | None:
    """Return the tightest or broken limit, and the faults `more`; None without either."""
    part = _of_limits(rows) if rows else None
    if not more:
        return part
    broken = [] if part is None or part.good else [part.words]
    return Part("; ".join([*broken, *more]), False)


def _of_limits(rows):
    worst = min(rows, key=_share)
    broken = sum(not row["margin"] >= 0.0 for row in rows)
    name, unit, value = worst["words"], worst["unit"], shown(worst["value"])
    of = lambda text: f"{text} {unit}" if unit != "-" else text
    if not broken:
        spare = f", smallest margin {of(shown(worst['margin']))} ({name})"
        finite = np.isfinite(worst["value"]) and worst["measure"] != "overflow_volume"
        scenarios = {row["scenario"] for row in rows if row.get("scenario")}
        where = f" in {count(len(scenarios), 'scenario')}" * bool(scenarios)
        return Part(f"every limit holds{where}" + spare * bool(finite))
    when = "" if worst["time_s"] is None else f" at {shown(worst['time_s'], 5)} s"
    excess, bound = of(shown(-worst["margin"])), of(shown(worst["limit"], 5))
    side = "below" if ms.MEASURES[worst["measure"]].sense < 0 else "above"
    words = f"{name} is {of(value)}{when}, {excess} {side} its limit of {bound}"
    if not np.isfinite(worst["value"]):
        words = f"{name} is undefined, for a limit of {bound}"
    elif worst["measure"] == "overflow_volume":
        words = f"{name} is {of(value)}"
    more = {1: "", 2: "; 1 other limit is broken"}
    return Part(words + more.get(broken, f"; {broken - 1} other limits are broken"), False)


def plants(
    holding: int, samples: int, runs: str = "plants", proved: str = "", interval: Any = None
) -> Part:
    """Return on how many plants every limit holds, and for which tanks that is guaranteed."""
    words = f"limits hold on {holding} of {samples} {runs}"
    if holding < samples and interval is not None:
        low, high = (shown(100.0 * end) for end in interval)
        words += f" (95 % interval {low} to {high} %)"
    return Part(words + (f", proved for {proved}" if proved else ""), holding == samples)


def robustness(values: Mapping[str, Any]) -> Part | None:
    Ms, Mt = (float(values.get(name, math.nan)) for name in PEAKS)
    if math.isnan(Ms):
        return None
    if Ms == math.inf:
        return Part("the linearised loop is unstable", False)
    return Part(f"Ms {shown(Ms)}" + f", Mt {shown(Mt)}" * (not math.isnan(Mt)))


def of_tuning(result: Any) -> Verdict:
    answer, case, values = result.answer, result.tuned, result.measures["after"]
    where = "" if answer is None else " on the worst plant"
    rows = [r.to_json() | {"words": (r.words or r.name) + where} for r in result.constraints]
    return Verdict(
        outcome=Part(result.headline.replace("_", " "), result.success),
        tracking=_tracking_of_answer(result, values),
        limits=limits(rows, beyond(case, values, rows)),
        plants=_validated(result) if answer is None else _judged(answer),
        robustness=robustness(values),
    )


def _tracking_of_answer(result, values):
    """Tracking on the nominal plant, and the number of validation plants without it."""
    loop, answer, runs = result.tuned.loop, result.answer, result.validation
    nominal, words = tracking(loop, values), ""
    if nominal is not None and is_averaging(loop, result.objective["terms"]):
        finite = bool(np.all(np.isfinite(values["rms_error"])))
        return Part(nominal.words + ", which the objective leaves free" * finite, finite)
    share = runs["setpoints_kept"]["after"] if runs and answer is None else None
    if share is not None:
        finite = runs["samples"] - runs["failed"]
        if lost := round((1.0 - share) * finite):
            words = f"{lost} of {finite} validation runs do not keep to their setpoints"
    elif answer is not None and (after := answer.after) is not None:
        astray_on = not_tracking(loop, after.measures, after.failed)
        if astray_on is not None and astray_on.any():
            words = astray(astray_on, answer.setting.runs, after.infeasible, loop)
    if nominal is None or not words:
        return nominal
    return Part(nominal.words + (", but " if nominal.good else "; ") + words, False)


def astray(lost: np.ndarray, runs: str, infeasible: np.ndarray | None, loop: Any) -> str:
    """Return on how many of N runs, `lost` (N,), the setpoints are not kept."""
    words = f"{int(lost.sum())} of {len(lost)} {runs} do not keep to their setpoints"
    # steady states are of plants without faults
    if infeasible is None or loop.faults is not None or not infeasible[lost].all():
        return words
    return words + ", which have no steady state within the limits there"


def _validated(result):
    """The plants of a nominal optimum."""
    runs = result.validation
    share = runs["limits_held"]["after"] if runs and result.constraints else None
    if share is None:
        return None
    finite = runs["samples"] - runs["failed"]
    return plants(round(share * finite), runs["samples"], "validation runs")


def _judged(answer):
    after, certificates = answer.after, answer.setting.certificates
    if after is None or not after.limits:
        return None
    open_limits = answer.open_limits()
    certified = [row.tank for row in certificates if row.tank not in open_limits]
    proved = labels_of(answer.setting.case.loop.plant, "tank", certified) if certified else ""
    interval = after.share_held()["interval95"]
    return plants(int(after.held.sum()), after.samples, answer.setting.runs, proved, interval)


def shown(value: Any, digits: int = 3) -> str:
    """Return a number as the live page writes it (`shown` of core.js), rounded half up."""
    value = float(value)
    if not math.isfinite(value):
        return "–"
    exact = decimal.Decimal(value)
    if not exact:
        return "0"
    place = decimal.Decimal(1).scaleb(exact.adjusted() - digits + 1)
    rounded = exact.quantize(place, decimal.ROUND_HALF_UP)
    if 1e-3 <= abs(value) < 1e6:
        return f"{rounded.normalize():f}"
    exponent = rounded.adjusted()
    return f"{rounded.scaleb(-exponent):.{digits - 1}f}e{exponent:+d}"

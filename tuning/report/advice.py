"""The three sentences above a report: new gains, their result, limits of every gain."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.bounds import is_tunable, remedy
from jaxtank.case import Case
from jaxtank.controllers import FlowCascade, OpenLoop
from jaxtank.core.labels import input_unit, label_of
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.loop.steady import sharing
from jaxtank.measures import MEASURES
from jaxtank.plants.elements import input_flows
from jaxtank.xla.jit import compiled
from tuning.feasible import study
from tuning.feasible.result import PlateauNeed
from tuning.problem.tracking import tracked_of
from tuning.report import verdict as verdicts
from tuning.report.tables import Table, Value
from tuning.report.verdict import shown
from tuning.uncertainty.needs import Needs, plateaus_of, unjudged

FEW = 4  # entries of a list in a sentence
GIVEN = "Nothing to set: the gains are those of the case"  # where no gain changes
BETTER = "jaxtank tune searches for better ones"
NO_GAINS = "Nothing to set: an open loop has no gains."
NO_SETPOINTS = "No setpoints are followed: the loop is open."
BEYOND = "No gain holds every setpoint for long"  # a plateau has no steady state within limits
REACHABLE = "The inputs can hold every setpoint"
FAULTLESS = ", faults left out"
BLOCKED = "Out of reach of the gains"  # though the plant can hold it
NEAR = 1e-3  # share of a height within which a level has settled on its setpoint [-]
TOLERANCE = 1e-6  # share of a limit or range above which a difference counts [-]


class Advice(NamedTuple):
    """Three sentences; the first of `compare` is on claims, of `identify` on the diagnosis."""

    to_set: str
    gives: str
    beyond: str


def listed(words: Sequence[str]) -> str:
    """Return words as a list, of more than FEW the first ones and how many others."""
    return ", ".join(words[:FEW]) + (f" and {len(words) - FEW} more" if len(words) > FEW else "")


def amount(value: Any, unit: str, digits: int = 3) -> str:
    return _with_unit(shown(value, digits), unit)


def _with_unit(text: str, unit: str) -> str:
    return text if unit in ("", "-") else f"{text} {unit}"


def changes(before: Any, after: Any, unit: str, digits: int = 3) -> str:
    return f"{shown(before, digits)} -> {amount(after, unit, digits)}"


def error_of(before: Any, after: Any, unit: str) -> str:
    """Return `changes` of an error, or that it is the same to the digits shown."""
    same = shown(before, 3) == shown(after, 3)
    return f"{amount(after, unit)}, as before" if same else changes(before, after, unit)


def limits_of(
    rows: Sequence[Mapping[str, Any]], heads: Sequence[str] = ("value", "margin", "at")
) -> Table:
    """Return the Table of `ConstraintRow`s for a page; "more": cells in place of the time."""
    cells = []
    for row in rows:
        at_least = MEASURES[row["measure"]].sense < 0
        value = "undefined" if row["reason"] else amount(row["value"], row["unit"], 4)
        bound = _with_unit(f"{row['limit']:.5g}", row["unit"])
        margin = "-" if row["reason"] else amount(row["margin"], row["unit"])
        cells.append([row["words"], ("≥ " if at_least else "≤ ") + bound, value, margin])
        time = "" if row["time_s"] is None else amount(row["time_s"], "s", 5)
        cells[-1] += row.get("more", [time])
    return Table(cells, ["", "limit", *heads], on="page", top=True)


def of_run(case: Case, values: Mapping[str, Any]) -> Advice:
    rows = verdicts.limit_rows(case, values)
    broken = [row["words"] for row in rows if not row["margin"] >= 0.0]
    words = [f"limits held: {len(rows) - len(broken)} of {len(rows)}"] if rows else []
    words += [f"broken: {listed(broken)}"] if broken else []
    words += verdicts.beyond(case, values, rows)
    if "rms_error_total" in values and not follows_none(case):
        error = float(np.ravel(values["rms_error_total"])[0])
        words.insert(0, f"RMS error {amount(error, case.loop.units[0])}")
    return Advice(
        nothing_to_set(case),
        f"It gives: {'; '.join(words) or 'a run without setpoints and limits'}.",
        of_nominal_plant(case, values),
    )


def nothing_to_set(case: Case, search: str = BETTER) -> str:
    """Return the sentence where no gain changes; search: what `tune` does, if it can."""
    if follows_none(case):
        return NO_GAINS
    if is_tunable(case):
        return f"{GIVEN}; {search}."
    return f"Nothing to set: {remedy(case.loop)}."


def of_nominal_plant(case: Case, values: Mapping[str, Any] | None = None) -> str:
    """Return the sentence on setpoints that the plant of a case cannot hold whatever its gains."""
    if follows_none(case):
        return NO_SETPOINTS
    needs = study.of_nominal_plant(case)
    if needs:
        return f"{beyond_gains(case)}: {need(case, needs[0])}.{blocked_too(case, values)}"
    return reachable(case, "this plant" if needs is not None else None, values)


def beyond_gains(case: Case) -> str:
    """Return BEYOND with the conditions of its steady states."""
    conditions = ["with these shares of the inputs"] * shares_inputs(case.loop)
    conditions += ["faults left out"] * (case.loop.faults is not None)
    return BEYOND + (f" ({', '.join(conditions)})" if conditions else "")


def shares_inputs(loop: ClosedLoop) -> bool:
    """Return whether the numbers of the controller share inputs between outputs."""
    if sharing(loop) is None:
        return False
    plant: Any = loop.plant
    law: Any = getattr(loop.controller, "law", loop.controller)
    return plant.pumps - len(getattr(law, "by_hand", ())) > len(plant.outputs)


def reachable(case: Case, where: str | None, values: Mapping[str, Any] | None = None) -> str:
    """Return the sentence on a case whose plants `where` hold its setpoints; None: not known."""
    if blocked := blocked_setpoints(case, values):
        return f"{BLOCKED}: {blocked[0]}."
    if where is None:
        return unknown(case)
    return f"{REACHABLE} on {where}{FAULTLESS * (case.loop.faults is not None)}."


def blocked_too(case: Case, values: Mapping[str, Any] | None = None) -> str:
    """Return a further sentence on a blocked setpoint, after a space; "" where none is."""
    blocked = blocked_setpoints(case, values)
    return f" {BLOCKED}: {blocked[0]}." if blocked else ""


def follows_none(case: Case) -> bool:
    """Whether the inputs of a case are given, whatever its setpoints."""
    return isinstance(getattr(case.loop.controller, "law", case.loop.controller), OpenLoop)


def unknown(case: Case) -> str:
    """Return the sentence on a rig that `tuning.feasibility` does not judge."""
    pipes = "of a rig with pipes jaxtank tune works them out"
    why = unjudged(case) or (pipes if is_tunable(case) else "the rig has pipes")
    return f"Setpoints out of reach are not known: {why}."


def part_of(case: Case, row: PlateauNeed) -> str:
    kind, number = ("tank", row.tank) if row.pump is None else ("pump", row.pump)
    return label_of(case.loop.plant, kind, (number or 1) - 1)


def need(case: Case, row: PlateauNeed, plants: bool = False) -> str:
    """Return the level or input beyond its limit at a plateau; plants: on 95 % of them."""
    part = part_of(case, row)
    setpoints = Value(row.setpoints, 4, case.loop.units[0], ", ")
    if not np.isfinite(row.needed_p95 if plants else row.needed):
        return f"setpoints {setpoints} have no steady state"
    bound = amount(row.limit, row.unit)
    # fewer than 5 % of the plants may be beyond the limit, or each beyond a different one
    if plants and (row.needed_p95 <= row.limit if row.upper else row.needed_p95 >= row.limit):
        return f"a steady state at {setpoints} passes the limit of {part}, {bound}"
    needed = amount(row.needed_p95 if plants else row.needed, row.unit)
    if plants:
        needed = f"{'up' if row.upper else 'down'} to {needed}"
    side = "limit" if row.upper else "lower limit"
    return f"a steady state at {setpoints} takes {needed} in {part}, {side} {bound}"


def blocked_setpoints(case: Case, values: Mapping[str, Any] | None = None) -> list[str]:
    """Return sentences on limits of the controller or the safety filter that block a setpoint."""
    plateaus, plant = plateaus_of(case) or [], case.loop.plant
    if not plateaus or not hasattr(plant, "links"):
        return []
    tracked = tracked_of(case.loop, values or {})
    if tracked is not None and np.all(tracked.missed < NEAR * tracked.heights):
        return []  # the run comes near all setpoints: nothing is in their way
    if study.can_judge(case):
        needed = Needs(case, {}).at()[0]
    else:  # of the levels only the setpoints are known
        needed = np.full((len(plateaus), plant.tanks + plant.pumps), np.nan)
        needed[:, list(plant.outputs)] = [plateau.values for plateau in plateaus]
    words = [f"setpoints {Value(p.values, 4, case.loop.units[0], ', ')}" for p in plateaus]
    levels, inputs = needed[:, : plant.tanks], needed[:, plant.tanks :]
    blocked = [*_by_controller(case, words, levels), *_by_flows(case, words, levels, inputs)]
    return [*blocked, *_by_filter(case, words, levels, inputs)]


def _by_flows(case, words, levels, inputs):
    if not isinstance(case.loop.controller, FlowCascade):
        return
    plant, unit = case.loop.plant, f"{case.loop.units[0]}^3/s"
    with jax.enable_x64(True):
        flows = np.array([input_flows(plant, tuple(h), tuple(u)) for h, u in zip(levels, inputs)])
    for j, (least, most) in enumerate(case.loop.controller.flow_limits()):
        beyond = np.nan_to_num(np.maximum(flows[:, j] - most, least - flows[:, j]))
        k = int(np.argmax(beyond))
        if beyond[k] > TOLERANCE * abs(flows[k, j]):
            side, limit = ("above", least) if flows[k, j] < least else ("below", most)
            yield (
                f"{words[k]} need {flows[k, j]:.4g} {unit} of {label_of(plant, 'pump', j)}, which"
                f" the controller keeps at or {side} {limit:.4g} {unit}"
            )


def _by_controller(case, words, levels):
    unit = case.loop.units[0]
    for tank, least, most in case.loop.controller.level_limits():
        level = levels[:, tank]
        beyond = np.nan_to_num(np.maximum(level - most, least - level))
        k = int(np.argmax(beyond))
        if beyond[k] > TOLERANCE * abs(level[k]):
            side, limit = ("above", least) if level[k] < least else ("below", most)
            name = label_of(case.loop.plant, "tank", tank)
            yield (
                f"{words[k]} need {level[k]:.4g} {unit} in {name}, which the controller keeps at or"
                f" {side} {limit:.4g} {unit}"
            )


def _by_filter(case, words, levels, inputs):
    """On plateaus whose inputs the safety filter changes, as if they were commanded there."""
    loop, plant = case.loop, case.loop.plant
    if loop.safety_filter is None:
        return
    low, high = (np.asarray(end, dtype=float) for end in (loop.actuator.low, loop.actuator.high))
    possible = np.isfinite(levels).all(axis=1) & ((low <= inputs) & (inputs <= high)).all(axis=1)
    with jax.enable_x64(True):
        hold = np.asarray(case.clock.dt)
        filtered = np.asarray(_filtered(loop.safety_filter, loop.actuator, inputs, levels, hold))
    span = np.where(np.isfinite(high - low), high - low, np.maximum(np.abs(inputs), 1.0))
    share = np.where(possible[:, None], (filtered - inputs) / span, 0.0)
    k, j = map(int, np.unravel_index(np.argmax(np.abs(share)), share.shape))
    if abs(share[k, j]) > TOLERANCE:
        unit = input_unit(plant, j, loop.units[1])
        yield (
            f"{words[k]} need {inputs[k, j]:.4g} {unit} of {label_of(plant, 'pump', j)}, which the"
            f" safety filter sets to {float(filtered[k, j]):.4g} {unit} at these levels"
        )


@compiled(keep=True)
def _filtered(safety_filter, actuator, inputs, levels, hold):
    """Filtered inputs (plateaus, m) of inputs (plateaus, m) at levels (plateaus, n)."""

    def at(u, y):
        line = [jnp.full(getattr(safety_filter, "predicted", 0), v) for v in u]
        return jnp.stack(safety_filter.apply(actuator, tuple(u), None, tuple(y), hold, line)[0])

    return jax.vmap(at)(jnp.asarray(inputs), jnp.asarray(levels))

"""Input validation of the sections on tuning, scenarios and columns of experiment data."""

import math
from collections.abc import Iterable, Mapping
from typing import Any

import jax
import numpy as np

from jaxtank.analysis.steady_batch import SteadyStates
from jaxtank.case import Case, Free, Scenario
from jaxtank.controllers import OnOff, OpenLoop
from jaxtank.controllers.pid import SharedPID
from jaxtank.core.checks import check_value
from jaxtank.core.clock import CLOCK_UNITS
from jaxtank.core.errors import EquilibriumError, InputError, unknown
from jaxtank.core.labels import index_of, label_of, name_of
from jaxtank.core.quantities import converted
from jaxtank.core.tables import ORDERS
from jaxtank.core.text import shortened
from jaxtank.core.tree import describe, get_value, split_index
from jaxtank.loop import run
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.loop.steady import steady_inflow, steady_state
from jaxtank.measures import MEASURES, check_names, entries, unit as measure_unit
from jaxtank.plants.elements import closed_circuit, unregulated
from jaxtank.plants.tank_network import TankNetwork
from jaxtank.rig.entry import Problems, is_finite, is_numeric, read_entry, refusal, sizes_of
from jaxtank.rig.schema import SECTIONS
from jaxtank.rig.sensors import CURRENTS, is_reading, level_of, spans_of
from jaxtank.rig.signals import steps
from jaxtank.rig.values import (
    by_dotted_name,
    check_not_scheduled,
    in_unit,
    scheduled_names,
    set_scenario,
)
from jaxtank.signals.setpoints import MANY, Ramps


def check(case: Case) -> Case:
    """Return `case` after input validation: the loop and clock can be run, and every plateau of the
    reference has a steady state.

    Parameters
    ----------
    case : Case

    Returns
    -------
    The case itself.

    Raises
    ------
    InputError for a loop that cannot be run, and for a setpoint outside the span of its sensor;
    EquilibriumError for a plateau without a steady state, unless `case.reachable` is False.

    Examples
    --------
    >>> from jaxtank import presets, rig
    >>> rig.check(presets.find("cascaded/pi")).name
    'cascaded/pi'
    """
    # a key will be given where there is noise
    run.check(case.loop, case.clock, key=jax.ShapeDtypeStruct((), np.uint32))
    check_setpoints(case)
    if case.reachable and (why := unreachable(case)):
        off = "reachable = false at the top of the file leaves this check out"
        raise EquilibriumError(f"{why}; {off}")
    return case


def check_setpoints(case: Case) -> None:
    """Raise InputError for setpoints that no sensor can read; a start below them is allowed."""
    loop, reference = case.loop, steps(case.loop.reference)
    low, high = (getattr(loop.sensor, name, None) for name in ("low", "high"))
    controller = getattr(loop.controller, "law", loop.controller)
    follows = not isinstance(controller, OpenLoop | OnOff)
    if low is None or high is None or reference is None or not follows:
        return
    entries = [(0.0, i, v, "initial") for i, v in enumerate(np.asarray(reference.initial))]
    changes = zip(reference.changes, np.asarray(reference.targets))
    entries += [(t, i, v, "changes") for (t, i), v in changes if t < case.clock.duration]
    # the rounding of "20 mA"
    slack, outside = 1e-9 * np.broadcast_to(loop.plant.rim, np.shape(low)), {}
    for entry in entries:
        _, output, value, _ = entry
        i = loop.plant.outputs[output]
        least = low[i] - slack[i] if entry[-1] == "changes" else -np.inf
        if not least <= value <= high[i] + slack[i]:
            outside.setdefault(output, entry)
    problems = Problems()
    for entry in outside.values():
        with problems.collect(("reference", None, entry[-1])):
            time, output, value, _ = entry
            low, high = spans_of(loop)[loop.plant.outputs[output]]
            share, length = (value - low) / (high - low), loop.units[0]
            first, last = CURRENTS
            raise InputError(
                f"reference: {label_of(loop.plant, 'output', output)} is asked for {value:g}"
                f" {length} ({100.0 * share:.4g} %, {first + share * (last - first):.4g} mA) from"
                f" {time:g} s on, and its sensor reads from {low:g} to {high:g} {length}: no"
                " controller can tell whether it is held; give a setpoint within this span, or"
                " [[sensor]] a wider span"
            )
    problems.check()


def unreachable(case: Case) -> str | None:
    """Return why a plateau of the reference has no steady state, None where all have one."""
    plant, reference = case.loop.plant, case.loop.reference
    controller = getattr(case.loop.controller, "law", case.loop.controller)
    square = plant.pumps == len(plant.outputs) or isinstance(controller, SharedPID)
    inflow = case.loop.disturbance
    varies = inflow is not None and inflow.is_table  # a level may be reached for a while
    if isinstance(controller, OpenLoop | OnOff):  # which follow no setpoint
        return None
    # what it holds decides, or what overflows from one tank into another
    open_ended = isinstance(plant, TankNetwork) and (
        closed_circuit(plant, unregulated(plant)) or (plant.overflow and plant.spills)
    )
    if isinstance(reference, Ramps) and square and not varies and not open_ended:
        plateaus = reference.plateaus(case.clock.duration)
        _, first = np.unique(plateaus, axis=0, return_index=True)
        for values in _doubtful(case.loop, plateaus[np.sort(first)]):
            try:
                steady_state(case.loop, values)
            except EquilibriumError as error:
                return f"reference: {error}"
    return None


def _doubtful(loop: ClosedLoop, plateaus: np.ndarray) -> np.ndarray:
    """The plateaus that may have no steady state; of long tables a choice."""
    plant: Any = loop.plant
    if len(plateaus) <= MANY:
        return plateaus
    if not (plant.plain and plant.pumps == len(plant.outputs)) or plant.pipes:
        extremes = np.concatenate([plateaus.argmin(axis=0), plateaus.argmax(axis=0)])
        some = np.linspace(0, len(plateaus) - 1, MANY).astype(int)
        return plateaus[np.unique([*extremes, *some])]
    inflow: Any = steady_inflow(loop)
    with np.errstate(invalid="ignore"):
        x, u = SteadyStates(plant, {}, 0.0 if inflow is None else np.asarray(inflow)).at(plateaus)
    low = np.asarray(loop.actuator.driving(tuple(np.asarray(loop.actuator.low, dtype=float))))
    fine = np.all(x[0] >= 0.0, axis=1) & np.all(u[0] >= np.minimum(low, 0.0), axis=1)
    return plateaus[~fine]


def check_uncertain(loop: ClosedLoop, uncertain: Mapping[str, Any]) -> dict[str, float]:
    """Return {dotted name: spread as a share} after input validation."""
    shares = {name: converted(f"uncertain {name}", v, "-") for name, v in uncertain.items()}
    for name, share in shares.items():
        get_value(loop, name)
        if not (is_finite(share, 0) and 0 < share < 1):
            words = 'be a share between 0 and 1, as 0.05 or "5 %"'
            raise refusal(f"uncertain {name}", share, words)
    return {name: float(share) for name, share in shares.items()}


def uncovered(
    loop: ClosedLoop, name: str, share: float, covered: Iterable[str]
) -> dict[str, float]:
    """Return {name: share} of the entries of a spread that the names `covered` leave out."""
    if not any(split_index(c)[0] == split_index(name)[0] for c in covered):
        return {name: share}
    if "[" in name:
        return {} if name in covered else {name: share}
    value = np.asarray(get_value(loop, name))
    indices = [i for i in np.ndindex(value.shape) if i and value[i] != 0]
    names = [f"{name}[{','.join(map(str, i))}]" for i in indices]
    return {n: share for n in names if n not in covered}


def check_limits(
    loop: ClosedLoop, limits: Mapping[str, Any], usual: Mapping[str, Any] = {}
) -> dict[str, Any]:
    """Return {measure: limit, one or one per entry} after input validation.

    A limit may be a text with a unit, of levels also in % of each rim, and {name or number from 1:
    limit} of some tanks, pumps or outputs; the others keep the limit of `usual`, or have none.
    """
    limits = by_measure(loop, limits)
    check_names(limits)
    checked = {}
    for measure, value in limits.items():
        if isinstance(value, dict):
            value = _of_entries(loop, measure, value, usual.get(measure))
        checked[measure] = value = _limit(loop, measure, f"limit {measure}", value)
        if isinstance(value, str) and value == "rim" and measure == "max_level":
            continue
        count, unit = entries(measure, loop.plant), measure_unit(measure, loop.units)
        none = MEASURES[measure].sense * np.inf  # of a tank that has no limit
        known = value
        if is_numeric(value) and np.ndim(value) == 1 and np.any(np.asarray(value) != none):
            known = np.where(np.asarray(value) == none, 0.0, value)
        if not (is_finite(known) and np.shape(value) in ((), (count,))):
            many = f", or {count} of them" if count > 1 else ""
            rim = ', or "rim"' if measure == "max_level" else ""
            raise refusal(f"limit {measure}", value, f"be a finite number [{unit}]{many}{rim}")
        _check_range(measure, value, none, "" if unit == "-" else f" {unit}")
    return checked


def _check_range(measure, value, none, unit):
    """Raise InputError for a limit beyond what a run can have; none: of a tank without one."""
    spec, stated = MEASURES[measure], np.asarray(value)
    stated = stated[stated != none]
    for sign, words, end in ((1.0, "least", spec.low), (-1.0, "most", spec.high)):
        if end is not None and np.any(sign * stated < sign * end):
            raise InputError(
                f"limit {measure} = {shortened(value)}{unit}: must be at {words} {end:g}{unit}; no"
                " run has a value beyond"
            )


def _limit(loop, measure, label, value, spans=None):
    """A limit with its texts converted: numbers with a unit, levels also in % of each span."""
    of = measure_unit(measure, loop.units)
    texts = value if isinstance(value, list) else [value]
    kind, width = MEASURES[measure].per, measure not in ("max_level", "min_level")
    if not any(map(is_reading, texts)) or of != loop.units[0] or kind == "run":
        return converted(label, value, of)
    spans = _spans(loop, kind) if spans is None else spans
    texts = texts * len(spans) if len(texts) == 1 else texts
    if len(texts) != len(spans):
        raise refusal(label, value, f"be a limit, or {len(spans)} of them")
    level = lambda v, span: level_of(v, span, width) if is_reading(v) else converted(label, v, of)
    return [level(v, span) for v, span in zip(texts, spans)]


def _spans(loop, kind):
    """Levels at 0 and 100 % of each tank, or each output."""
    spans = spans_of(loop)
    return spans if kind == "tank" else [spans[i] for i in loop.plant.outputs]


def by_measure(loop: ClosedLoop, limits: Mapping[str, Any]) -> dict[str, Any]:
    """{measure: limit}, of "max_level.LT101" and others {measure: {entry: limit}}."""
    grouped: dict[str, Any] = {}
    for name, value in limits.items():
        if any(name in names for _, names in getattr(loop.plant, "names", ())):
            raise InputError(f"limit {name}: is of which measure? as max_level.{name}")
        measure, _, entry = name.partition(".")
        if not entry:
            grouped[name] = value
        elif isinstance(table := grouped.setdefault(measure, {}), dict):
            table[entry] = value
        else:
            raise InputError(f"limit {measure} of all and limit {name}: give one of them")
    return grouped


def _of_entries(loop, measure, table, usual):
    """The limits of all entries of a measure, from {name or number from 1: limit} of some."""
    kind, plant = MEASURES[measure].per, loop.plant
    if kind == "run":
        raise InputError(f"limit {measure}: has no entries: must be one number")
    rims, none = np.asarray(plant.rim).tolist(), MEASURES[measure].sense * np.inf
    usual = none if usual is None else rims if isinstance(usual, str) else usual
    values = np.array(np.broadcast_to(usual, entries(measure, plant)), dtype=float)
    for name, value in table.items():
        i, label = index_of(f"limit {measure}", plant, kind, name), f"limit {measure}.{name}"
        if value is not None:
            rim = rims[i : i + 1] if kind == "tank" else rims
            spans = None if kind == "pump" else _spans(loop, kind)[i : i + 1]
            value = _limit(loop, measure, label, value, spans)
            value = rim[0] if isinstance(value, str) and value == "rim" else value
            if not is_finite(value) or np.size(value) != 1:
                raise refusal(label, value, "be one finite number")
        values[i] = none if value is None else np.ravel(value)[0]
    return values.tolist()


def check_objective(objective: Mapping[str, Any]) -> dict[str, float]:
    """Return {measure: weight} after input validation."""
    check_names(objective)
    weights = {m: converted(f"objective {m}", w, "-") for m, w in objective.items()}
    for measure, weight in weights.items():
        if not (is_finite(weight, 0) and weight >= 0):
            raise refusal(f"objective {measure}", weight, "be a finite weight at or above 0")
    if not any(weights.values()):
        raise InputError("the objective has no measure with a weight above 0")
    return {measure: float(weight) for measure, weight in weights.items()}


def check_free(loop: ClosedLoop, name: str, low: Any, high: Any, scale: str = "log") -> Free:
    """Return the range of a free parameter after input validation; linear where it holds 0."""
    is_clock = name.startswith("clock.") and name.removeprefix("clock.") in CLOCK_UNITS
    meta: dict[str, Any] = {"kind": "static"} if is_clock else describe(loop, name)
    if meta["kind"] == "static":
        raise InputError(
            f"free {name}: cannot be tuned, it is part of the compiled program and not a number"
            " with a derivative"
        )
    check_not_scheduled(loop, name)
    get_value(loop, name)
    low, high = (_end(loop, name, end) for end in (low, high))
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        unit = "" if meta["unit"] == "-" else f" {meta['unit']}"
        raise InputError(
            f"free {name} = {low:g}:{high:g}: must be LOW:HIGH with finite LOW below HIGH{unit}"
        )
    for end in (low, high):
        for row in meta.get("rows") or (meta,):  # an array whose rows are different things
            check_value(f"free {name}", end, row)
    if scale not in ("log", "linear"):
        raise InputError(f"free {name}: scale {scale!r} must be log or linear")
    return Free(float(low), float(high), scale if low * high > 0 else "linear")


def _end(loop: ClosedLoop, name: str, end: Any) -> float:
    """The end of a range of a parameter, a number or a text such as "5 min", as a number."""
    value: Any = in_unit(loop, f"free {name}", name, end) if isinstance(end, str) else end
    value = value[0] if isinstance(value, list) and len(value) == 1 else value
    if not (is_numeric(value) and np.ndim(value) == 0):
        raise refusal(f"free {name}", end, "be LOW:HIGH, two numbers or texts with a unit")
    return float(value)


def free_of(loop, table):
    """{name: Free} of a [free] table."""
    free = {}
    for name, spec in table.items():
        good = isinstance(spec, list) and len(spec) in (2, 3)
        ends = spec[:2] if good else []
        good = good and all((is_numeric(v) and np.ndim(v) == 0) or isinstance(v, str) for v in ends)
        if not good or spec[2:] not in ([], ["log"], ["linear"]):
            form = '[low, high] or [low, high, "log" or "linear"]'
            raise refusal(f"free {name}", spec, f"be {form}")
        for each in scheduled_names(loop, name):
            free[each] = check_free(loop, each, *spec)
    return free


def scenarios_of(case, tables):
    """The Scenarios of the [[scenario]] tables, each of which can be run."""
    scenarios = []
    for i, table in enumerate(tables):
        entry = read_entry(SECTIONS["scenario"], table, sizes_of(case.loop), i)
        name = entry.pop("name", f"scenario {i + 1}")
        try:
            values = by_dotted_name(entry.pop("values"), "scenario.values")
            set_scenario(case, values)
        except EquilibriumError:
            pass  # `check` names the plateau without one; where that is allowed, `tune` refuses
        except InputError as error:
            raise type(error)(f"scenario {name!r}: {error}") from None
        values = {n: tuple(v) if isinstance(v, list) else v for n, v in values.items()}
        scenarios.append(Scenario(name, values, **entry))
    return tuple(scenarios)


LOG_SETTINGS = {"decimal": (".", ","), "time": ORDERS, "hold": ("zero-order", "first-order")}
"""Keys of [log] that are no columns, and what each may be."""


def log_slots(plant):
    """Return {slot: (kind, number from 0)} of columns of experiment data: "t", "pump1", "h1"."""
    pumps = {f"pump{j + 1}": ("pump", j) for j in range(plant.pumps)}
    return {"t": ("t", 0), **pumps, **{f"h{i + 1}": ("h", i) for i in range(plant.tanks)}}


def log_keys(plant):
    """Return {key of [log]: slot}: the slots, and the rig's own names of tanks and pumps."""
    slots, names = log_slots(plant), {}
    for slot, (kind, number) in slots.items():
        for what in {"h": ("tank", "sensor"), "pump": ("pump",)}.get(kind, ()):
            name = name_of(plant, what, number)
            names |= {name: slot} if name else {}
    return {**names, **dict(zip(slots, slots))}


def check_log(plant, table):
    """Return {slot or name: header or (header, unit), setting: value} of a [log] table, checked."""
    # `columns` and `units` may hold headers and units apart; without a header it is found by name
    table = dict(table)
    apart, units = (table.pop(key, {}) for key in ("columns", "units"))
    for key, part in (("columns", apart), ("units", units)):
        if not isinstance(part, dict):
            raise refusal(f"log {key}", part, "be a table")
    table |= apart | {key: [apart.get(key, ""), unit] for key, unit in units.items()}
    keys, columns, headers = log_keys(plant), {}, {}
    for key, spec in table.items():
        if key in LOG_SETTINGS:
            if spec not in LOG_SETTINGS[key]:
                raise refusal(f"log {key}", spec, f"be one of {' '.join(LOG_SETTINGS[key])}")
            columns[key] = spec
            continue
        if key not in keys:
            raise unknown("key of [log]", key, [*keys, *LOG_SETTINGS])
        header, columns[key] = _header_and_unit(key, spec)
        if header in headers and header not in ("", "none"):
            other = headers[header]
            raise InputError(f"log {key} = {shortened(header)}: that column is {other} already")
        if any(other != key and keys.get(other) == keys[key] for other in columns):
            raise InputError(f"log {key}: {keys[key]} is given twice")
        headers[header] = key
    return columns


def _header_and_unit(key, spec):
    """(header, header or (header, unit)) of a line of [log]."""
    pair = [spec] if isinstance(spec, str) else spec
    good = isinstance(pair, (list, tuple)) and 1 <= len(pair) <= 2
    if not (good and all(isinstance(v, str) for v in pair) and pair[-1].strip()):
        raise refusal(f"log {key}", spec, "be a column's header, or [header, unit]")
    return pair[0], pair[0] if len(pair) == 1 else tuple(pair)


def check_covariance(loop, table):
    """Return (names, rows) of a [covariance] table after input validation."""
    values = read_entry(SECTIONS["covariance"], table, sizes_of(loop))
    names, rows, size = values["names"], values["matrix"], len(values["names"])
    if len(set(names)) < size:
        raise InputError("covariance.names: one is given twice")
    for name in names:
        if describe(loop, name)["kind"] == "static" or np.ndim(get_value(loop, name)) != 0:
            raise InputError(f"covariance {name}: must be a number, an array's entry by name[i]")
    good = is_finite(rows) and np.shape(rows) == (size, size)
    if good:
        matrix = np.asarray(rows, dtype=float)
        good = np.allclose(matrix, matrix.T, rtol=1e-9, atol=0) and np.all(np.diag(matrix) > 0)
        sd = np.sqrt(np.abs(np.diag(matrix)))
        good = good and np.linalg.eigvalsh(matrix / np.outer(sd, sd))[0] > 0  # whatever the units
    if not good:
        raise InputError(
            f"covariance.matrix: must be a symmetric, positive definite {size} by {size} matrix of"
            " finite numbers"
        )
    return tuple(names), tuple(tuple(float(v) for v in row) for row in rows)

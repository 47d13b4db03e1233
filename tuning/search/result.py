"""A tuning result, and what it says of itself in words."""

import dataclasses
from typing import Any

import numpy as np

from jaxtank import measures as ms
from jaxtank.core.errors import unknown
from tuning.problem.problem import EXPLODED
from tuning.problem.result import Result
from tuning.problem.status import Status
from tuning.search.diagnostics import flat_words
from tuning.search.kkt import SLOPING, UNSTABLE

BARELY = 0.5
"""Change of the objective [%] for 10 % of a parameter, below which the answer says that the
parameter is barely felt.
"""

CHATTER = 20.0
"""How many times the pumps' travel may grow before the answer says so."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ParameterChange:
    """A tuned parameter: values and range in `unit`; at_bound: "lower", "upper" or None;
    felt_percent,
    exercised: as in `TuningResult.parameters`.
    """

    before: float
    after: float
    unit: str
    lower: float
    upper: float
    at_bound: str | None
    felt_percent: float | None
    exercised: bool


@dataclasses.dataclass(frozen=True, kw_only=True, repr=False)
class TuningResult(Result):
    """What `tune` found. `print(result)` for the table, `.save(dir)` for files, `.plot()` for
    pictures, `result["controller.k"].after`.

    parameters: {name: {before, after, unit, lower, upper, at_bound, felt_percent, exercised}}: how
    much 10 % of the value changes the objective [%], and whether any run depends on the value (if
    none does, the value is that before);
    measures: {"before": {}, "after": {}} of the case's own run; tables: {"before": [], "after": []}
    of every scenario that the search was judged by; constraints: one dict per limit and scenario
    with value, margin, tank and time; history: (start, cost, violation [share of the limit, see
    `objective.room_of`], z) of every evaluation; starts: one dict per local search; curvature,
    validation: see `evidence`; cloud: cost and highest level of every run of the validation, see
    `evidence.summary_of`; mirrored: the answer's mirror image, see `evidence.mirror_of`; choices:
    what each combination of discrete choices gave;
    bound: what no law could beat, tradeoff: what a limit costs,
    certificate: what is known of fresh plants, where asked. case and tuned are the Case before and
        after.
    """

    REPORT = "tuning.report.tuning"

    case: Any
    tuned: Any
    method: str
    status: Status
    message: str
    parameters: dict
    objective: dict
    measures: dict
    tables: dict
    constraints: list
    evaluations: dict
    wall_s: float
    history: list
    starts: list
    optimality: dict
    curvature: dict | None
    mirrored: dict | None
    validation: dict | None
    provenance: dict
    problem: Any
    choices: list = dataclasses.field(default_factory=list)
    bound: Any = None
    tradeoff: Any = None
    certificate: Any = None
    cloud: dict | None = None

    @property
    def success(self) -> bool:
        """True if a search converged and every limit holds at the case's own step, in every
        scenario.
        """
        return self.status == Status.CONVERGED

    def __getitem__(self, name):
        """The ParameterChange of a free parameter. Raises InputError for another name."""
        if name not in self.parameters:
            raise unknown("tuned parameter", str(name), self.parameters)
        return ParameterChange(**self.parameters[name])

    def __contains__(self, name):
        return name in self.parameters

    def __iter__(self):
        return iter(self.parameters)

    def replace(self, **changes: Any) -> "TuningResult":
        """A copy with the named fields changed."""
        return dataclasses.replace(self, **changes)


def constraint_rows(problem, table):
    """One dict for each limit of the problem: {name, measure, unit, limit, value, margin, tank,
    time_s, scenario, reason}, the last why the value is not a finite number, None where it is.
    """
    rows = []
    for limit in problem.limits:
        measures, plant = table[limit.lane], problem.lanes[limit.lane].case.loop.plant
        per = ms.MEASURES[limit.measure].per
        tank = (
            limit.index
            if per == "tank"
            else plant.outputs[limit.index]
            if per == "output"
            else None
        )
        value = float(measures[limit.measure].ravel()[limit.index])
        reached = ms.MEASURES[limit.measure].reached
        rows.append(
            {
                "name": limit.label,
                "measure": limit.measure,
                "unit": ms.unit(limit.measure, problem.loop.units),
                "limit": limit.value,
                "value": value,
                "margin": limit.margin(measures),
                "tank": None if tank is None else tank + 1,
                "time_s": float(measures[reached][limit.index]) if reached else None,
                "scenario": limit.scenario or None,
                "reason": _reason(limit, value),
            }
        )
    return rows


def _reason(limit, value):
    """Why the value of a limited measure is not a finite number; None where it is."""
    if np.isfinite(value):
        return None
    spec = ms.MEASURES[limit.measure]
    return spec.nan_holds if np.isnan(value) and spec.nan_holds else spec.undefined


def _amount(row):
    """The value of one of `constraint_rows` with its unit, or why it has none."""
    return (
        f"{row['value']:.6g} {row['unit']}"
        if row["reason"] is None
        else f"undefined ({row['reason']})"
    )


def _unlimited(problem):
    """Sentences on the entries of a limited measure that are undefined in every run: not limited."""
    words = []
    for measure in dict.fromkeys(
        limit.measure for limit in problem.limits if "window" in ms.refers_to([limit.measure])
    ):
        here = {limit.index for limit in problem.limits if limit.measure == measure}
        absent = [i + 1 for i in range(ms.entries(measure, problem.loop.plant)) if i not in here]
        words += [
            f"{measure} of output {i} is not limited: the setpoint has no step" for i in absent
        ]
    return words


def message(result, z, felt, redone, steps=()):
    """One paragraph for people, parts joined by "; ": what was found, what is tight, what to doubt.
    steps: sentences on steps too long.
    """
    words, problem, checked = list(steps), result.problem, result.constraints
    broken = [c for c in checked if c["margin"] < 0]
    if result.status == "not_converged" and broken:
        words.append(
            "no point that meets every limit was found before the search ended"
            f" ({broken[0]['name']} is {_amount(broken[0])}, limit {broken[0]['limit']:.6g}"
            f" {broken[0]['unit']}): more --iterations, --starts or --screening may find one"
        )
    if result.status == "infeasible":
        worst = sorted(
            zip(
                (c["margin"] / room for c, room in zip(checked, problem.rooms)), range(len(checked))
            )
        )
        worst = [(share, checked[i]) for share, i in worst if share < 0]
        told = [
            f"{c['name']} is {_amount(c)}, limit {c['limit']:.6g} {c['unit']}"
            + (f", missed by {-c['margin']:.3g} {c['unit']}" if c["reason"] is None else "")
            for _, c in worst[:4]
        ]
        more = f" (and {len(worst) - 4} more)" if len(worst) > 4 else ""
        words.append(
            f"no point was found that meets every limit: {', '.join(told)}{more}"
            + (
                f"; the largest of these, {-100 * worst[0][0]:.3g} % of its limit, is the least"
                " that was found"
                if worst[0][1]["reason"] is None
                else ""
            )
        )
    if result.status == "interrupted":
        words.append("interrupted: this is the best point so far")
    residual, steep = result.optimality["kkt_residual"], result.optimality["gradient_norm"]
    if result.status != "infeasible" and steep == 0.0 and result.objective["after"] != 0.0:
        words.append(
            "the objective has no slope here: it changes in steps, as times and counts do, and a"
            " search by gradients cannot tell that this is its least; weigh a smooth measure"
            " beside it"
        )
    elif (
        result.status in ("converged", "not_converged")
        and residual is not None
        and residual > SLOPING
        and not broken
    ):
        words.append(
            f"a slope is left that no limit holds up (KKT residual {residual:.2g} of the objective"
            " per range of a parameter): "
            + (
                "a kink, for steps along it find nothing lower within the limits"
                if result.status == "converged"
                else "not yet an optimum"
            )
        )
    if result.status == "not_converged" and not broken and steep != 0.0:
        words.append(_why_not_converged(result))
    over = [c for c in constraint_rows(problem, result.tables["before"]) if c["margin"] < 0]
    if over and not broken:
        told = ", ".join(
            (
                f"{c['name']} {_amount(c)}"
                if c["reason"]
                else f"{c['name']} {c['value']:.4g} of {c['limit']:.4g} {c['unit']}"
            )
            for c in over[:4]
        )
        more = f" and {len(over) - 4} more" if len(over) > 4 else ""
        words.append(
            f"the starting values break a limit ({told}{more}), so their objective is not one to"
            " reach"
        )
    words += _unlimited(problem)
    holding = result.optimality["multipliers"]
    tight = [
        c
        for c in checked
        if c["margin"] >= 0
        and (c["margin"] < 1e-3 * abs(c["limit"]) or holding.get(c["name"], 0.0) > 0)
    ]
    for c in tight:
        when = f" at {c['time_s']:.2f} s" if c["time_s"] is not None else ""
        words.append(f"tight: {c['name']}{when} ({c['value']:.7g} of {c['limit']:.7g} {c['unit']})")
    if checked and not tight and not broken:
        words.append("no limit is tight")
    before, after = (float(result.measures[k]["input_travel"].sum()) for k in ("before", "after"))
    if after > CHATTER * before > 0:
        unit = ms.unit("input_travel", problem.loop.units)
        words.append(
            f"the pumps travel {after:.4g} {unit} in all, {after / before:.0f} times as far as"
            " before: weigh it or limit it (--objective input_travel=..., --limit"
            " input_travel=...), or take a smaller step"
        )
    idle = [b for b in problem.bounds if not result.parameters[b.name]["exercised"]]
    if idle:
        kept = ", ".join(f"{b.name} {result.parameters[b.name]['after']:g} {b.unit}" for b in idle)
        same = "any value in the range gives the same run, so the start value is kept"
        words.append(f"no run exercises {kept}: {same}")
    for b, v, f in zip(problem.bounds, z, felt):
        if b in idle:
            continue
        if v < 1e-6 or v > 1 - 1e-6:
            words.append(
                f"{b.name} ends at its {'lower' if v < 0.5 else 'upper'} bound,"
                f" {b.low if v < 0.5 else b.high:g} {b.unit}"
            )
        if f is not None and f < BARELY:
            words.append(f"{b.name} is barely felt: 10 % changes the objective by {f:.2g} %")
    flat = flat_words(problem, result.curvature) if result.curvature else ""
    if flat:
        words.append(flat)
    words += _agreement(result)
    if redone:
        words.append(
            f"{redone} screening points are unstable at the coarse step alone and were judged at"
            " the true one"
        )
    if problem.non_finite:
        words.append(
            f"{problem.non_finite} trial points gave numbers that are not finite and were shrunk"
            " away from"
        )
    return "; ".join(words)


def _why_not_converged(result):
    """Why a search that broke no limit did not converge, and the remedy."""
    if _none_finite(result):
        return (
            f"no search could begin: the objective, a limit or a derivative exceeds {EXPLODED:.0e}"
            " at every point that was tried, as where noise and delay make the loop unstable;"
            " start from other values (--set) or narrow the ranges (--free)"
        )
    if (result.optimality["kkt_residual"] or 0.0) >= UNSTABLE:
        return (
            "the slope at this point is that of an unstable or chaotic run (noise and delay at a"
            " high gain give one), and points along it are not lower; try more --starts, or other"
            " ranges (--free)"
        )
    if any(o["exhausted"] for o in result.starts):
        return "no search converged within its iterations: raise --iterations, or try other starts"
    return (
        "the searches stopped before their iterations were used up, at a kink or in the noise of"
        " the objective: no line search found a lower point, and the conditions of an optimum do"
        " not hold there; try more --starts or other starting values"
    )


def _none_finite(result):
    """True if no evaluation gave finite numbers to search with."""
    return all(not np.isfinite(violation) for _, _, violation, _ in result.history)


def _agreement(result):
    outcomes, words = result.starts, []
    held = [o for o in outcomes if o["violation"] == 0.0]
    if not held:  # nothing to agree on
        return words
    best = min(o["cost"] for o in held)
    alike = [
        i for i, o in enumerate(outcomes) if o["violation"] == 0.0 and o["cost"] <= best * 1.001
    ]
    words.append(f"{len(alike)} of {len(outcomes)} searches ended within 0.1 % of the best")
    image = result.mirrored
    if image and image["objective"] is not None:
        at = ", ".join(f"{n} {v:.3g}" for n, v in image["values"].items())
        above = 100 * (image["objective"] / result.objective["after"] - 1)
        same = (
            "the same objective"
            if abs(above) < 1e-3
            else f"an objective {abs(above):.2g} % {'above' if above > 0 else 'below'}"
        )
        ended = (
            f"; {len(image['starts'])} of the searches ended there and count as this answer"
            if image["starts"]
            else ""
        )
        words.append(
            f"mirror image: {image['words']}: {at} gives {same}{ended.replace('; ', ', ')}"
        )
    return words

"""The report of a tuning result: text, JSON, pictures, page and folder."""

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxtank import measures as ms
from jaxtank.core.tree import describe, get_value, parameters
from jaxtank.limits import limited_levels
from jaxtank.loop.trajectory import csv
from tuning.problem.pairing import unstable_signs
from tuning.problem.problem import TAIL
from tuning.problem.rules import ORDER
from tuning.problem.tracking import not_tracking
from tuning.report import advice, feasible, optimal_input, tables, verdict as verdicts
from tuning.report.document import Live, Report, Text, terminal
from tuning.report.folder import earlier, rig_text, save as save_all
from tuning.report.safety import PROMISE, start_of
from tuning.report.simulated import estimates, run_for_people
from tuning.report.tables import Table, Value, clean, fields, number, numbers, undefined
from tuning.search.judged import OF_LEVELS
from tuning.search.result import Message, row_of
from tuning.search.setting import scenarios_to_judge
from tuning.search.small_changes import AGAIN, WORTH
from tuning.search.tuner import rule_row

COSTLIEST, MANY = 5, 12  # scenarios in a table that would have more than MANY rows
SIDES = ("before", "after")

CAPTIONS = {
    "responses": "The run before tuning (orange, dashed) and after (blue): controlled levels with"
    " their setpoints, tracking errors, the other tanks, and the pump inputs. Shaded: beyond a"
    " limit.",
    "margins": "Margin of the tuned run to each limit: left of zero the limit is broken.",
    "inner": "The tanks without a setpoint, one against the other, from the dot to the square.",
    "saturation": "When pumps were commanded beyond their limits: upwards above the upper limit,"
    " downwards below the lower one; the height is the share of the time.",
    "estimates": "Estimates of the observer and true values, in the tuned run.",
    "clouds": "Validation runs, on perturbed plants and with new sensor noise where the case has"
    " them: one dot a run, before tuning on the horizontal axis, after it on the vertical one.",
    "convergence": "Every evaluation of the search in its order.",
    "landscape": "The objective around the tuned values, at the case's own step.",
    "tradeoff": "The least objective that was found under each value of the limit.",
    "rig": "The rig, drawn from its own topology; triangles are setpoints, a heavier outline is a"
    " tank that is controlled.",
}


def json_of(result):
    answer, measures = result.answer, result.measures
    feasibility = None if answer is None else answer.feasibility
    return {
        "case": result.tuned.name,
        "status": str(result.status),
        "verdict": verdicts.of_tuning(result).to_json(),
        "advice": list(advice_of(result)),
        **fields(result, "method success headline message evaluations wall_s starts symmetry"),
        **fields(result, "choices optimality curvature tradeoff validation provenance"),
        "messages": [{"code": m.code, "text": m.text} for m in result.messages],
        "rules": [{name: clean(value) for name, value in row.items()} for row in result.rules],
        "parameters": {n: {**clean(p), "interval": None} for n, p in result.parameters.items()},
        "interval_reason": "no measurements were fitted, so there is no confidence interval",
        "objective": {k: clean(result.objective[k]) for k in ("before", "after", "terms")},
        "measures": {side: tables.measures_json(measures[side]) for side in SIDES},
        "reasons": {**tables.reasons(measures["before"]), **tables.reasons(measures["after"])},
        "units": tables.units(result.tuned.loop.plant),
        "constraints": clean([c.to_json() for c in result.constraints]),
        "scenarios": scenario_rows(result),
        "slopes": {where: check.to_json() for where, check in result.slopes.items()},
        "certificate": None if result.certificate is None else result.certificate.to_json(),
        "holds": None if answer is None else answer.holds(),
        "feasibility": None if feasibility is None else feasibility.to_json(),
        "answer": None if answer is None else answer.to_json(),
        "bound": None if result.bound is None else clean(result.bound.to_json()),
    }


def report(result, page=False):
    """Return the Report of a TuningResult; `page`: with the sections of an HTML page."""
    answer, notes = result.answer, [m.text for m in result.messages]
    sections = sections_of(result) if answer is None else of_answer(answer, result)
    if page and answer is not None:
        sections += [*_by_tank(answer), *(replace(s, on="page") for s in sections_of(result))]
    rig = rig_of(result)[0] if page else None
    effort, counts = f"{result.wall_s:.1f} s", result.evaluations
    facts = [
        ("gains tuned", sum(p["exercised"] for p in result.parameters.values())),
        ("simulations", counts["simulations"]),
        ("time", effort),
    ]
    if answer is None:
        runs = f"{counts['simulations']} simulations, {counts['gradients']} of them with gradients"
        effort = f"{result.method}, {runs}, {effort}"
    noted = [Text(["notes"] if notes else [], gap=True, on="terminal"), Text(notes, items=True)]
    sections = [Live(result), Text([effort], on="terminal"), *sections, *noted]
    verdict, name, title = verdicts.of_tuning(result), result.tuned.name, result.case.title
    files = {"The tuned rig as a file (rig.toml)": rig} if rig else {}
    return Report(name, "tuned", verdict, facts, sections, title, files, advice_of(result))


def advice_of(result):
    changed = [
        f"{name} {advice.changes(p['before'], p['after'], p['unit'], 4)}"
        for name, p in result.parameters.items()
        if p["exercised"] and p["before"] != p["after"]
    ]
    if result.tuned.loop.safety_filter is not None and result.case.loop.safety_filter is None:
        changed.insert(advice.FEW - 1, "safety filter on")
    changed += [f"{name} stays {amount}" for name, amount in _tracking_times(result)]
    better = "no better gains known"
    if result.answer is not None:  # such gains stay as they are
        better += f" (by more than {100 * AGAIN * WORTH:g} % of the cost)"
    to_set = f"Set {advice.listed(changed)}" if changed else f"Nothing to set: {better}"
    unfinished = {"interrupted": "interrupted", "not_converged": "the search has not converged"}
    if why := unfinished.get(result.status):
        to_set += f" ({why})"
    if np.isinf(result.measures.get("after", {}).get("sensitivity_peak", 0.0)):
        reason = "with the best gains found the linearised loop is unstable; other ranges (--free)"
        reason += ", signs, or another input for each output (plant.outputs) may help"
        to_set = f"Nothing to set: {next(unstable_signs(result.tuned), reason)}"
    return advice.Advice(f"{to_set}.", f"It gives: {'; '.join(_gives(result))}.", _beyond(result))


def _tracking_times(result):
    """[(name, value with unit)] of tracking times that stay while their integral times change."""
    controller = result.tuned.loop.controller
    tuned = {name.partition("[")[0] for name in result.parameters}
    items, rows = result.parameters.items(), []
    changed = {name.partition("[")[0] for name, p in items if p["before"] != p["after"]}
    for name, value in parameters(controller).items():
        Tt, Ti = f"controller.{name}", f"controller.{name.removesuffix('Tt')}Ti"
        if name.endswith("Tt") and value is not None and Ti in changed and Tt not in tuned:
            numbers = ", ".join(verdicts.shown(v, 4) for v in np.unique(np.asarray(value)))
            rows.append((Tt, f"{numbers} {describe(controller, name)['unit']}"))
    return rows


def _gives(result):
    """What a tuning gives: its error before and after, and how many runs keep every limit."""
    answer, cost = result.answer, result.objective
    after = getattr(answer, "after", None)
    if after is not None and not answer.setting.own_objective:
        words = _errors_and_changes(answer)
    else:
        terms = next(iter(cost["terms"])) if len(cost["terms"]) == 1 else "objective"
        words = [f"{terms} {advice.changes(cost['before'], cost['after'], cost_unit(result))}"]
    if after is not None and after.limits:
        counts = [int(side.held.sum()) for side in (answer.before, after)]
        words.append(f"limits hold on {counts[0]} -> {counts[1]} of {after.samples} plants")
    elif rows := worst_of_scenarios(result.constraints):
        holding = sum(row["margin"] >= 0.0 for row in rows)
        words.append(f"{holding} of {len(rows)} limits hold in the runs of the search")
        plants = verdicts.of_tuning(result).plants
        words += [plants.words] if plants else []
    return words


def _errors_and_changes(answer):
    """Mean error on the plants before and after; changes of the inputs if only these are better."""
    sides, unit = (answer.before, answer.after), answer.setting.case.loop.units[0]
    before, after = (_mean(side.error, side).value for side in sides)
    words = [f"mean RMS error {advice.error_of(before, after, unit)}"]
    old, new = (100.0 * _mean(side.travel, side).value for side in sides)
    if after > before and new < old:
        words.append(f"rms change of inputs {advice.changes(old, new, '% of range', 2)}")
    return words


def _beyond(result):
    """The sentence on limits that the tuning does not hold, and setpoints out of reach."""
    answer, words, values = result.answer, [], result.measures["after"]
    if answer is not None and answer.after is not None:
        words += [
            f"{row['limit'].words} breaks its limit on {row['broken']} plants"
            for row in answer.after.worst()
            if row["broken"]
        ]
    else:
        rows = worst_of_scenarios(result.constraints)
        words += [f"{row['words']} breaks its limit" for row in rows if not row["margin"] >= 0.0]
    broken = f"Not held: {advice.listed(words)}. " if words else ""
    study = None if answer is None else answer.feasibility
    if study is None:
        return broken + advice.of_nominal_plant(result.tuned, values)
    plants = answer.after if answer and scenarios_to_judge(answer.setting.case) else None
    return broken + feasible.beyond(study, result.tuned, values, plants)


def cost_unit(result):
    # default answer: unit of the squared error, and of the price on input changes
    unit = result.answer and result.answer.setting.cost_unit
    return unit or tables.objective_unit(result.objective["terms"], result.tuned.loop.units)


def of_answer(answer, result=None):
    """Return the sections on an Answer; with the values to set of its result, where given."""
    sections: list[Any] = []
    if answer.mended is not None:
        sections.append(Text([f"mended first: {answer.mended.words}"]))
    if answer.feasibility is not None and answer.feasibility.infeasible_for_any_controller > 0:
        sections += feasible.unreachable(answer.feasibility)
    if result is not None:
        sections.append(_values(result, answer))
    sections.append(_effects(answer, gap=result is not None))
    if result is not None and result.rules:
        sections += _rules(result)
    open_limits = answer.open_limits()
    rows = [row for row in answer.setting.certificates if row.tank not in open_limits]
    if proved := [row.starts for row in rows]:
        sections.append(Text([f"proved: {PROMISE}, {start_of(proved)}"], gap=True))
    return sections


def _by_tank(answer):
    """The table of the worst value of each limit over the validation plants."""
    if answer.after is None or not answer.after.limits:
        return []
    certificates = {row.tank for row in answer.setting.certificates}
    open_limits = answer.open_limits()
    rows, loop, samples = [], answer.setting.case.loop, answer.after.samples
    for row in answer.after.worst():
        measure, tank = row["limit"].key
        limit = row_of(row["limit"], loop, row["value"]).to_json()
        proof = "no"
        if measure in OF_LEVELS and tank in certificates:
            why = open_limits.get(tank, {}).get(measure)
            proof = "yes" if why is None else f"no: {why}"
        rows.append(limit | {"more": [f"{row['broken']} of {samples}", proof]})
    return [advice.limits_of(rows, ["worst", "margin", "broken on plants", "proved"])]


def answer_text(answer):
    return terminal(Report("default answer", "", None, (), of_answer(answer)))


def _values(result, answer):
    rows = []
    for name, p in result.parameters.items():
        remark = f"at its {p['at_bound']} bound" if p["at_bound"] else ""
        if answer.kept.get(name, False):
            remark = "unchanged" + " (a change gains little)" * (answer.least_cost_peaks is None)
        if not p["exercised"]:
            remark = "unchanged: no effect in any run"
        rows.append([f"{name} [{p['unit']}]", *(Value(p[s], 4) for s in SIDES), remark])
    rows += [[name, time, time, "not tuned"] for name, time in _tracking_times(result)]
    loop = result.case.loop
    rows.append(["safety filter", "off" if loop.safety_filter is None else "on", "off", ""])
    if answer.setting.filter is not None:
        chosen = answer.setting.searched.loop.safety_filter
        rate, band = float(np.max(chosen.rate)), float(np.max(chosen.band))
        rows[-1][2:] = ["on", f"rate {rate:.3g} 1/s, noise band {band:.3g} {loop.units[0]}"]
    return Table(rows, ["what to set", "was", "now", ""], top=True)


def _rules(result):
    """The table of tuning rules beside the answer, and why some of them have no gains."""
    loop, unit = result.tuned.loop, cost_unit(result)
    names = [g for g in ORDER if g != "Tt" and any(_of(r["parameters"], g) for r in result.rules)]
    answer = rule_row(loop, "this answer", _gains(loop, names), result.answer.after)
    head = [f"{g} [{describe(loop, f'controller.{g}')['unit']}]" for g in names]
    cost = "cost" if unit == "-" else f"cost [{unit}]"
    head = ["tuning rules", *head, f"error [{loop.units[0]}]", "change [%]", cost, "holds"]
    every = (answer, *result.rules)
    rows = [_rule(row, names) for row in every]
    missed = [row["setpoints_lost"] for row in every]
    if any(missed):
        head.append(f"missed (of {result.answer.after.samples})")
        rows = [[*cells, "-" if n is None else str(n)] for cells, n in zip(rows, missed)]
    reasons = dict.fromkeys(row["why"] for row in result.rules if row["why"])
    return [Table(rows, head, True), *([Text(list(reasons))] if reasons else [])]


def _gains(loop, names):
    """{dotted name: value} of every entry of some gains of a controller."""
    values = {g: np.ravel(get_value(loop, f"controller.{g}")).tolist() for g in names}
    return {f"controller.{g}[{i}]": v for g, row in values.items() for i, v in enumerate(row)}


def _of(values, gain):
    return [v for n, v in values.items() if n.startswith(f"controller.{gain}[")]


def _rule(row, names):
    gains = [Value(_of(row["parameters"], g) or np.nan, 4) for g in names]
    outcome = [Value(row[k], 3) for k in ("error", "travel_percent", "objective")]
    return [row["rule"], *gains, *outcome, {True: "yes", False: "no", None: "-"}[row["holds"]]]


def _effects(answer, gap):
    """The table of the performance before and after, on the validation plants."""
    loop, terms = answer.setting.case.loop, answer.setting.objective
    sides = [side for side in (answer.before, answer.after) if side is not None]
    unit, n, rows = loop.units[0], answer.before.samples, []
    if answer.setting.own_objective:
        of = tables.objective_unit(terms, loop.units)
        name = f"objective{f' {next(iter(terms))}' if len(terms) == 1 else ''}, mean of {n} plants"
        name += "" if of == "-" else f" [{of}]"
        rows.append([name, *(_mean(s.cost, s) for s in sides)])
    rows += _errors(answer, sides, unit) + _margins(answer)
    rows += _shares(answer, sides)
    limited = np.isfinite(limited_levels(answer.setting.case))
    if limited.any():
        levels = [s.level[~s.failed][:, limited] for s in sides]
        highest = [Value(v.max() if v.size else np.nan, 4) for v in levels]
        rows.append([f"highest level [{unit}]", *highest])
    changes = [_mean(100 * s.travel, s, 2) for s in sides]
    rows.append(["rms change of input per sample [% of range]", *changes])
    return Table(rows, ["what it gives", "before", "now"][: 1 + len(sides)], gap)


def _shares(answer, sides):
    """The rows of the shares of plants that violate a limit, or miss a setpoint."""
    rows, share = [], lambda flags: f"{100 * np.mean(flags):.3g} %"
    if answer.before.limits:
        rows.append(["plants that violate a limit", *(share(~s.held) for s in sides)])
    flags = [not_tracking(answer.setting.case.loop, s.measures, s.failed) for s in sides]
    lost = [astray for astray in flags if astray is not None]
    if len(lost) == len(sides) and np.any(lost):
        rows.append(["plants that do not keep to their setpoints", *map(share, lost)])
    return rows


def _errors(answer, sides, unit):
    """The rows of the error on the plants that judged the answer, and on the nominal one."""
    name = f"error, mean of {answer.before.samples} plants [{unit}]"
    rows = [[name, *(_mean(s.error, s) for s in sides)]]
    lost = answer.before.infeasible
    if lost is not None and lost.any() and not lost.all():
        name = f"  plants where every setpoint is reachable ({100 * np.mean(~lost):.0f} %)"
        rows.append([name, *(_mean(s.error[~lost], s, of=~lost) for s in sides)])
    nominal = [Value(error, 3) for error in answer.nominal.values()]
    return [*rows, [f"error, nominal plant [{unit}]", *nominal]]


def _margins(answer):
    """The rows of both sensitivity peaks and the delay margin of the linearised nominal loop."""
    sides = [m for m in answer.measures.values() if "sensitivity_peak" in m]
    peaks = [[float(m["sensitivity_peak"]), float(m["complementary_peak"])] for m in sides]
    delays = np.array([float(np.min(m["delay_margin"])) for m in sides])
    if not np.isfinite(peaks).any():
        return []
    cells = ["unstable" if np.inf in pair else Value(pair, 3, between=", ") for pair in peaks]
    rows = [["sensitivity peaks Ms, Mt, nominal plant [-]", *cells]]
    if np.isfinite(delays).any():
        cells = [Value(v, 3, missing="any" if v == np.inf else "-") for v in delays]
        rows.append(["delay margin, nominal plant [s]", *cells])
    return rows


def _mean(values, side, digits=3, of=slice(None)):
    """The mean over the plants, or those `of` them, whose run is finite."""
    good = values[~side.failed[of]]
    return Value(good.mean() if good.size else np.nan, digits)


def sections_of(result):
    rows = []
    for name, p in result.parameters.items():
        remark = f"at {p['at_bound']} bound" if p["at_bound"] else ""
        ends = Value([p["lower"], p["upper"]], between=" : ")
        change = Value(p["sensitivity_percent"], 2, "%")
        remark = remark if p["exercised"] else "without effect, unchanged"
        rows.append([name, p["unit"], Value(p["before"]), Value(p["after"]), ends, change, remark])
    heads = ["parameter", "unit", "before", "after", "range", "10 % of it changes the objective by"]
    lines = []
    for c in result.choices:
        values = ", ".join(f"{n} = {v}" for n, v in c["values"].items())
        lines.append([values, c["status"], *map(Value, c["objective"].values())])
    columns = [f"objective {side} [{cost_unit(result)}]" for side in SIDES]
    sections = [
        Table(rows, [*heads, ""], gap=True, top=result.answer is None),
        *_measure_table(result),
        *_limit_table(result),
        *_scenario_table(result),
        *_validation_table(result),
        *([Table(lines, ["choice", "status", *columns], gap=True)] if lines else []),
        *_tradeoff_table(result),
    ]
    if result.bound is not None:
        first, *others = optimal_input.report(result.bound).sections
        sections += [replace(first, gap=True), *others]
    dt = result.tuned.clock.dt
    return [*sections, Text([f"{_rims(result)}; evaluated at dt = {dt:g} s"], gap=True)]


def _rims(result):
    """Treatment of overflow in the simulation, in words."""
    if result.tuned.loop.plant.overflow:
        return "overflow is simulated: liquid above a rim leaves its tank"
    if not any(limit["measure"] == "max_level" for limit in result.constraints):
        return (
            "overflow is not simulated and no level limit is set: a level above its rim is not"
            " reported"
        )
    if result.tuned.loop.safety_filter is not None:
        return "rims are limits, for which a safety filter limits the pump inputs"
    return "rims are limits only: overflow is not simulated, and a level may rise above its rim"


def _measure_table(result):
    """The objective and the measures of the case's own run, and a line on which run they are of."""
    objective, measures = result.objective, result.measures
    terms, after = objective["terms"], measures["after"]
    listed = [m for m in (*ms.placed("shown"), *ms.functions(after)) if m in after]
    listed = [m for m in listed if m != "rms_error_total" or {*terms} != {m}]
    rows = [["objective", cost_unit(result), *(Value(objective[side]) for side in SIDES)]]
    for m in listed:
        sides = numbers(measures["before"][m], 4), numbers(after[m], 5 if "level" in m else 4)
        rows.append([m, tables.unit_text(m, result.tuned.loop.plant), *sides])
    weighted = " + ".join(m if w == 1 else f"{w:g} {m}" for m, w in terms.items())
    before, after = ({m: measures[side][m] for m in listed} for side in SIDES)
    lines = [f"objective: {weighted}{_runs_of(result, bool(listed))}"]
    lines += _notes(before, after, result.tuned.loop.units)
    return [Table(rows, ["measure", "unit", "before", "after"], gap=True), Text(lines)]


def _notes(before, after, units):
    """Return sentences on entries that are not plain numbers: undefined ones, negative times."""
    early, late = undefined(before), undefined(after)
    words = [line for line in early if line in late]
    words += [f"before, {line}" for line in early if line not in late]
    words += [f"after, {line}" for line in late if line not in early]
    times = [side["settling_time"] for side in (before, after) if "settling_time" in side]
    if any(np.any(np.asarray(v) < 0) for v in times):
        words.append(
            f"settling_time: a negative time [{ms.unit('settling_time', units)}] is one before the"
            " end of the change of the setpoint"
        )
    return words


def _runs_of(result, others):
    """The runs that the objective is of, where these are scenarios; others: rows beside it."""
    problem = result.problem
    if not problem.scenarios:
        return ""
    runs = "plants" if result.certificate is not None else "scenarios"
    weighted = len({run.weight for run in problem.runs}) > 1
    of = {
        "mean": "the weighted mean" if weighted else "the mean",
        "cvar": f"the mean of the worst {100 * TAIL:g} %",
        "worst": "the worst",
    }
    rest = "; the other rows: the case's own run, on its own plant" if others else ""
    return f"; {of[problem.risk]} of {len(problem.runs)} {runs}{rest}"


def worst_of_scenarios(constraints):
    """Return of the rows of `constraints` that differ by their scenario alone the worst ones."""
    worst = {}
    for c in constraints:
        same = (c["measure"], c["tank"], c["pump"])
        if same not in worst or c["margin"] < worst[same]["margin"]:
            worst[same] = c
    return list(worst.values())


def _limit_table(result):
    rows = worst_of_scenarios(result.constraints)
    if not rows or result.answer is not None:
        return [tables.limit_table(rows)] if rows else []
    of_page = advice.limits_of([row.to_json() for row in rows])
    return [replace(tables.limit_table(rows), on="terminal"), of_page]


def scenario_rows(result):
    """Return one dict for each scenario of a TuningResult, [] for the case's own run alone."""
    problem, rows = result.problem, []
    for i, run in enumerate(problem.runs if problem.scenarios else ()):
        sides = {side: measured[i] for side, measured in result.tables.items()}
        limits = [limit for limit in problem.limits if limit.run == i]
        hold = {s: all(limit.margin(t) >= 0 for limit in limits) for s, t in sides.items()}
        costs = clean({side: problem.cost(table) for side, table in sides.items()})
        row = {"name": run.name, "weight": run.weight, "objective": costs, "limits_held": hold}
        rows.append(row)
    return rows


def _scenario_table(result):
    scenarios, limited = scenario_rows(result), bool(result.problem.limits)
    if not scenarios:
        return []
    cost = lambda s, side="after": np.inf if (v := s["objective"][side]) is None else v
    listed, notes = scenarios, []
    if len(scenarios) > MANY:
        listed = sorted(scenarios, key=lambda s: -cost(s))[:COSTLIEST]
        limits_hold = sum(s["limits_held"]["after"] for s in scenarios)
        rest = f"; limits held after in {limits_hold}" if limited else ""
        notes = [f"the {COSTLIEST} costliest of {len(scenarios)} scenarios{rest}"]
    rows = []
    for s in listed:
        limits_hold = ("yes" if s["limits_held"]["after"] else "no") if limited else "-"
        costs = [Value(cost(s, side)) for side in SIDES]
        rows.append([s["name"], Value(s["weight"], 3), *costs, limits_hold])
    heads = ["scenario", "weight", "objective before", "after", "limits held after"]
    return [Table(rows, heads, gap=True), Text(notes)]


def _validation_table(result):
    checked = result.validation
    if not checked:
        return _no_validation(result)
    rows, limited = [], bool(result.problem.limits)
    for side in SIDES:
        if (share := checked["limits_held"][side]) is not None:
            costs = [Value(checked["objective"][side][k]) for k in ("mean", "p05", "p50", "p95")]
            setpoints = f"{100 * checked['setpoints_kept'][side]:.0f} %"
            rows.append([side, *costs, *([f"{100 * share:.0f} %"] if limited else []), setpoints])
    if not rows:
        return [Text([f"validation runs: all {checked['samples']} failed"], gap=True)]
    heads = [f"on {checked['samples']} validation runs", "mean objective", "5 %", "median", "95 %"]
    heads += ["all limits held in"] * limited + ["setpoints kept in"]
    spread = checked["spread"].items()
    perturbed = [n if share is None else f"{n} +-{100 * share:g} %" for n, share in spread]
    perturbed = ", ".join(perturbed) or "nothing of the plant"
    noise = ", new sensor noise" if checked["noise"] else ""
    failed = f"; {checked['failed']} runs failed and are left out" if checked["failed"] else ""
    note = f"{_improved(checked)}; perturbed: {perturbed}{noise}{failed}"
    return [Table(rows, heads, gap=True), Text([note])]


def _no_validation(result):
    noise = any(run.key is not None for run in result.problem.runs)
    if result.case.uncertain or result.case.covariance or noise:
        return []
    why = (
        "no validation on other plants: the rig names nothing that is uncertain. An [uncertain]"
        ' table in its file ("plant.drain" = 0.05 for +-5 %) makes tune validate the answer'
    )
    return [Text([why], gap=True)]


def _improved(checked):
    """Return in how many validation runs tuning improved the objective, in words."""
    if checked["comparable"] == 1.0:
        return f"tuning improved the objective in {100 * checked['better_share']:.0f} % of them"
    share = checked["better_share_of_comparable"]
    if share is None:
        return (
            "in no run do the starting and the tuned values both hold all limits, so the"
            " objectives cannot be compared"
        )
    runs = round(checked["comparable"] * (checked["samples"] - checked["failed"]))
    return (
        f"the starting and the tuned values both hold all limits in {runs} of these runs"
        f" ({100 * checked['comparable']:.3g} %); there tuning improved the objective in"
        f" {100 * share:.0f} %"
    )


def _tradeoff_table(result):
    if not result.tradeoff:
        return []
    rows, measure = [], result.tradeoff["measure"]
    for p in result.tradeoff["points"]:
        gains = ", ".join(f"{n} {number(v, 4)}" for n, v in p["parameters"].items())
        rows.append([Value(p["limit"]), p["status"], Value(p["objective"]), gains])
    head = f"limit of {measure} [{ms.unit(measure, result.tuned.loop.units)}]"
    return [Table(rows, [head, "status", "objective", "at"], gap=True)]


def rig_of(result):
    """Return (text of rig.toml, None), or (None, why there is none and what to set in Python)."""
    text, why = rig_text(result.tuned)
    if why is None:
        return text, None
    gains = ", ".join(f"{n} = {p['after']!r} {p['unit']}" for n, p in result.parameters.items())
    return None, f"{why}; set in Python what was tuned: {gains}"


def save(result, folder, command=None):
    rig, why = rig_of(result)
    if why:
        warnings.warn(why, stacklevel=3)  # the line that called result.save
        result = result.replace(messages=(*result.messages, Message("no-rig-file", why)))
    runs = _runs(result)
    files = {
        **({"rig.toml": rig} if rig else {}),
        "trajectory.csv": csv(runs["after"], result.tuned.loop.units),
        "before.csv": csv(runs["before"], result.case.loop.units),
    }
    stale = earlier(folder, CAPTIONS)
    if not rig and (Path(folder) / "result.json").is_file():
        # of another result: its gains must not be taken for these
        stale.append(Path(folder) / "rig.toml")
    draw, page = lambda: figures(result, runs), lambda: report(result, page=True)
    return save_all(folder, json_of(result), files, draw, page, CAPTIONS, command, stale)


def _runs(result):
    noise = np.asarray(result.case.loop.sensor.noise)
    key = jax.random.key(result.problem.seed) if bool(np.any(noise > 0)) else None
    return {s: run_for_people(c, key) for s, c in zip(SIDES, (result.case, result.tuned))}


def figures(result, runs=None):
    """Return {name: figure} of a TuningResult: the figures of CAPTIONS that are not empty."""
    from jaxtank.plots import diagnostics, responses, run as plots
    from jaxtank.plots.style import picture

    runs = runs or _runs(result)
    loop, name, unit = result.tuned.loop, result.tuned.name, cost_unit(result)
    changed = lambda p: " -> ".join(number(p[side], 4) for side in SIDES)
    first = list(result.parameters.items())[:4]
    gains = ", ".join(f"{n.removeprefix('controller.')} {changed(p)} {p['unit']}" for n, p in first)
    levels = _level_limits(result)
    drawings = {"responses": responses.responses(loop, runs, f"{name}: {gains}", *levels)}
    drawings |= plots.rig(loop.plant, runs["after"], f"{name} at the end of the tuned run")
    if rows := worst_of_scenarios(result.constraints):
        size = (6.4, 0.9 + 0.42 * min(len(rows), diagnostics.MANY))
        drawings["margins"] = picture(lambda ax: diagnostics.margins(ax, rows), size)
    between = [i for i in range(loop.plant.tanks) if i not in loop.plant.outputs][:2]
    if len(between) == 2:
        lines = responses.with_looks(runs)
        rims = np.asarray(loop.plant.rim)
        phase = lambda ax: diagnostics.phase(ax, lines, between, rims, loop.units[0], loop.plant)
        drawings["inner"] = picture(phase, (5.0, 4.0), legend=3)
    drawings |= _saturation(loop, runs)
    observed = f"{name}, tuned: estimates of the observer"
    drawings |= estimates(loop, result.tuned.clock, runs["after"], observed)
    if result.cloud is not None and len(result.cloud["objective"]):
        drawings["clouds"] = _clouds(result, unit)
    if result.history:
        limited = bool(result.problem.limits)
        course = lambda ax: responses.convergence(ax, result.history, unit, limited)
        drawings["convergence"] = picture(course, (6.4, 3.8))
    around = _curve if len(result.parameters) == 1 else _contours
    drawings["landscape"] = picture(lambda ax: around(ax, result, unit), (6.4, 4.8))
    if result.tradeoff:
        measure, points = result.tradeoff["measure"], result.tradeoff["points"]
        of = (measure, ms.unit(measure, loop.units), unit)
        drawings["tradeoff"] = picture(lambda ax: diagnostics.tradeoff(ax, points, *of), (6.0, 3.6))
    return drawings


def _saturation(loop, runs):
    """{"saturation": when commands are beyond the limits of the pumps}; {} where none is."""
    from jaxtank.plots import diagnostics
    from jaxtank.plots.style import picture

    low, high = (np.asarray(v, dtype=float) for v in (loop.actuator.low, loop.actuator.high))
    if not any(np.any(run.command > high) or np.any(run.command < low) for run in runs.values()):
        return {}
    size = (6.4, 1.4 + 0.62 * len(runs) * loop.plant.pumps)
    strips = lambda ax: diagnostics.saturation(ax, runs, low, high, loop.plant)
    return {"saturation": picture(strips, size, legend=2)}


def _level_limits(result):
    """(highest, lowest) allowed level of each tank: its limits; else its rim, and -inf."""
    levels = np.array(result.tuned.loop.plant.rim, dtype=float)
    lows = np.full(len(levels), -np.inf)
    # the problem of a default answer has tightened limits, and none that no plant comes near
    for measure, values, most in (("max_level", levels, min), ("min_level", lows, max)):
        rows = [c for c in result.constraints if c["measure"] == measure and c["tank"]]
        for tank in {c["tank"] for c in rows}:
            values[tank - 1] = most(c["limit"] for c in rows if c["tank"] == tank)
    return levels, lows


def _clouds(result, unit):
    """Validation runs before against after: the objective, and the level nearest to its limit."""
    from jaxtank.plots.style import picture
    from jaxtank.plots.uncertainty import cloud

    runs, length = result.cloud, result.tuned.loop.units[0]
    level = "highest level over its limit" if runs["past"] else "highest level"

    def draw(axes):
        cloud(axes[0], runs["objective"], runs["held"], "objective", unit)
        cloud(axes[1], runs["level"], runs["held"], level, length, runs["limit"])

    title = f"{result.tuned.name}: {len(runs['objective'])} validation runs"
    return picture(draw, (8.6, 4.9), 1, 2, legend=3, title=title)


def _curve(ax, result, unit):
    """The objective along the only free parameter, at the case's own step."""
    from jaxtank.plots import responses

    grid, b = np.linspace(0.0, 1.0, 128), result.problem.bounds[0]
    costs, margins = result.problem.screen(grid[:, None])
    violation = np.maximum(0.0, -margins).max(axis=1, initial=0.0)
    points = [(result.parameters[b.name][s], result.objective[s]) for s in SIDES]
    responses.curve(ax, b.from_unit(grid), costs, violation, b, unit, *points)


def _contours(ax, result, unit):
    """The objective over the two parameters that it is most sensitive to, the others as tuned."""
    from jaxtank.plots import responses

    problem, start = result.problem, result.problem.start()
    values = zip(problem.bounds, result.parameters.values())
    tuned = np.array([float(b.to_unit(p["after"])) for b, p in values])
    effect = [-(p["sensitivity_percent"] or 0.0) for p in result.parameters.values()]
    pair = sorted(np.argsort(effect, kind="stable")[:2])
    axis = np.linspace(0.0, 1.0, 24)
    across, up = np.meshgrid(axis, axis)
    points = np.tile(tuned, (across.size, 1))
    points[:, pair[0]], points[:, pair[1]] = across.ravel(), up.ravel()
    costs, margins = problem.screen(points)
    worst = -margins.min(axis=1) if margins.size else np.zeros(len(costs))
    costs, worst = costs.reshape(across.shape), worst.reshape(across.shape)
    bounds = [problem.bounds[i] for i in pair]
    scaled = lambda z: [b.from_unit(v) for b, v in zip(bounds, z)]
    before, after, grid = (scaled(z) for z in (start[pair], tuned[pair], (across, up)))
    responses.contours(ax, grid, costs, worst, bounds, unit, before, after)
    if len(tuned) > 2:
        ax.set_title("landscape (the other parameters as tuned)")

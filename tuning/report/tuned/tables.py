"""Tables of a tuning result, as text and for its page; imported by the report of that result."""

import numpy as np

from jaxtank import measures as ms
from tuning.problem.problem import TAIL
from tuning.report.tables import clean, cost_unit, number, numbers, table, undefined

COSTLIEST, MANY = 5, 12
"""Scenarios in a table that would have more than MANY rows."""


def parts_of(result):
    """Return what is printed of a TuningResult but for its message: lines and Tables."""
    evaluations = result.evaluations
    parts = [
        f"{result.tuned.name}: {result.headline} ({result.method},"
        f" {evaluations['simulations']} simulations, {evaluations['gradients']} of them with"
        f" gradients, {result.wall_s:.1f} s)",
        "",
        _parameter_table(result),
        "",
        *_measure_table(result),
        "",
    ]
    parts += _limit_table(result) + _scenario_table(result) + _validation_table(result)
    parts += _choice_table(result) + _tradeoff_table(result)
    if result.bound is not None:
        parts += [str(result.bound), ""]
    if result.tuned.loop.plant.overflow:
        rims = "rims are physics: liquid above them overflows"
    elif any(limit["name"].startswith("max_level") for limit in result.constraints):
        rims = "rims are limits only: nothing spills in the model, so a level may be above its rim"
        if result.tuned.loop.safety_filter is not None:
            rims = "rims are limits, for which a safety filter caps the pumps"
    else:
        rims = (
            "rims are neither physics nor limits here: nothing spills in the model, and a level"
            " above its rim is not reported"
        )
    return [*parts, f"{rims}; evaluated at dt = {result.tuned.clock.dt:g} s"]


def _parameter_table(result):
    """Every free parameter before and after, its range, and the sensitivity of the objective."""
    rows = []
    for name, p in result.parameters.items():
        remark = f"at {p['at_bound']} bound" if p["at_bound"] else ""
        rows.append(
            [
                name,
                p["unit"],
                number(p["before"]),
                number(p["after"]),
                f"{number(p['lower'])} : {number(p['upper'])}",
                "-"
                if p["sensitivity_percent"] is None
                else f"{number(p['sensitivity_percent'], 2)} %",
                remark if p["exercised"] else "without effect, kept",
            ]
        )
    heads = ["parameter", "unit", "before", "after", "range"]
    return table(rows, [*heads, "10 % of it changes the objective by", ""])


def _measure_table(result):
    """The objective and the measures of the case's own run, and a line on which run they are of."""
    units = result.tuned.loop.units
    objective, measures = result.objective, result.measures
    unit = cost_unit(result)
    rows = [["objective", unit, number(objective["before"]), number(objective["after"])]]
    shown = []
    alone = set(objective["terms"])
    for m in (*ms.placed("shown"), *ms.functions(measures["after"])):
        if m not in measures["after"] or (m == "rms_error_total" and alone == {m}):
            continue
        before = numbers(measures["before"][m], 4)
        after = numbers(measures["after"][m], 5 if "level" in m else 4)
        shown.append(m)
        rows.append([m, ms.unit(m, units), before, after])
    heads = ["measure", "unit", "before", "after"]
    terms = " + ".join(m if w == 1 else f"{w:g} {m}" for m, w in objective["terms"].items())
    notes = _notes({m: (measures["before"][m], measures["after"][m]) for m in shown}, units)
    runs = _runs_of(result, len(rows) > 1)
    return [table(rows, heads), "; ".join([f"objective: {terms}", *runs]), *notes]


def _notes(shown, units):
    """Return sentences on entries that are not plain numbers: undefined ones, negative times."""
    before, after = (undefined({m: pair[i] for m, pair in shown.items()}) for i in (0, 1))
    words = [line for line in before if line in after]
    words += [f"before, {line}" for line in before if line not in after]
    words += [f"after, {line}" for line in after if line not in before]
    if any(np.any(np.asarray(v) < 0) for v in shown.get("settling_time", ())):
        words.append(
            f"settling_time: a negative time [{ms.unit('settling_time', units)}] is one before the"
            " end of the change of the setpoint"
        )
    return words


def _limit_table(result):
    """Every limit in its worst scenario: value, margin, and when it was reached."""
    if not result.constraints:
        return []
    rows = [
        [
            c["name"],
            c["unit"],
            (">= " if ms.MEASURES[c["measure"]].sense < 0 else "<= ") + number(c["limit"], 7),
            number(c["value"], 7),
            number(c["margin"], 3) if c["reason"] is None else "undefined",
            f"{c['time_s']:.2f} s" if c["time_s"] is not None else "-",
        ]
        for c in worst_of_scenarios(result.constraints)
    ]
    return [table(rows, ["limit", "unit", "limit", "value", "margin", "reached at"]), ""]


def _runs_of(result, others):
    """Return a line on the runs that the objective is of, where these are scenarios."""
    problem = result.problem
    if not problem.scenarios:
        return []
    what = "plants" if result.certificate is not None else "scenarios"
    weighted = len({run.weight for run in problem.runs}) > 1
    of = {
        "mean": "the weighted mean" if weighted else "the mean",
        "cvar": f"the mean of the worst {100 * TAIL:g} %",
        "worst": "the worst",
    }
    rest = "; the other rows: the case's own run, on its own plant" if others else ""
    return [f"{of[problem.risk]} of {len(problem.runs)} {what}{rest}"]


def worst_of_scenarios(constraints):
    """Return of the rows of `constraints` that differ by their scenario alone the worst ones."""
    worst = {}
    for c in constraints:
        same = (c["measure"], c["tank"], c["name"].removesuffix(f" in {c['scenario']}"))
        if same not in worst or c["margin"] < worst[same]["margin"]:
            worst[same] = c
    return list(worst.values())


def scenario_rows(result):
    """Return one dict for each scenario of a TuningResult, [] for the case's own run alone."""
    problem = result.problem
    if not problem.scenarios:
        return []
    rows = []
    for i, run in enumerate(problem.runs):
        limits = [limit for limit in problem.limits if limit.run == i]
        sides = {side: tables[i] for side, tables in result.tables.items()}
        held = {s: all(limit.margin(t) >= 0 for limit in limits) for s, t in sides.items()}
        costs = clean({side: problem.cost(table) for side, table in sides.items()})
        rows.append(
            {"name": run.name, "weight": run.weight, "objective": costs, "limits_held": held}
        )
    return rows


def _scenario_table(result):
    """Every scenario, or of more than MANY the costliest."""
    scenarios, limited = scenario_rows(result), bool(result.problem.limits)
    if not scenarios:
        return []

    def cost(scenario, side="after"):
        value = scenario["objective"][side]
        return np.inf if value is None else value

    many = len(scenarios) > MANY
    shown = sorted(scenarios, key=lambda s: -cost(s))[:COSTLIEST] if many else scenarios
    rows = [
        [
            s["name"],
            number(s["weight"], 3),
            *(number(cost(s, side)) for side in ("before", "after")),
            ("yes" if s["limits_held"]["after"] else "no") if limited else "-",
        ]
        for s in shown
    ]
    found: list[str] = [
        table(rows, ["scenario", "weight", "objective before", "after", "limits held after"])
    ]
    if many:
        held = sum(s["limits_held"]["after"] for s in scenarios)
        kept = f"; limits held after in {held}" if limited else ""
        found.append(f"the {COSTLIEST} costliest of {len(scenarios)} scenarios{kept}")
    return [*found, ""]


def _validation_table(result):
    """The objective and the limits on the validation set, before and after."""
    found = result.validation
    if not found:
        return _why_not_validated(result)
    rows = [
        [
            side,
            *(number(found["objective"][side][k]) for k in ("mean", "p05", "p50", "p95")),
            f"{100 * found['limits_held'][side]:.0f} %",
        ]
        for side in ("before", "after")
        if found["limits_held"][side] is not None
    ]
    if not rows:
        return [f"validation runs: all {found['samples']} failed", ""]
    heads = [f"on {found['samples']} validation runs", "mean objective", "5 %", "median", "95 %"]
    if result.problem.limits:
        heads.append("all limits held in")
    else:
        rows = [row[:-1] for row in rows]
    perturbed = (
        n if share is None else f"{n} +-{100 * share:g} %" for n, share in found["spread"].items()
    )
    perturbed = ", ".join(perturbed) or "nothing of the plant"
    noise = ", new sensor noise" if found["noise"] else ""
    failed = f"; {found['failed']} runs failed and are left out" if found["failed"] else ""
    return [table(rows, heads), f"{_improved(found)}; perturbed: {perturbed}{noise}{failed}", ""]


def _why_not_validated(result):
    """Return a sentence: the rig names nothing from which validation runs could be drawn."""
    case = result.case
    if case.uncertain or case.covariance or any(run.key is not None for run in result.problem.runs):
        return []
    return [
        "no validation on other plants: the rig names nothing that is uncertain. An [uncertain]"
        ' table in its file ("plant.drain" = 0.05 for +-5 %) makes tune validate the answer',
        "",
    ]


def _improved(found):
    """Return in how many validation runs tuning improved the objective, in words."""
    if found["comparable"] == 1.0:
        return f"tuning improved the objective in {100 * found['better_share']:.0f} % of them"
    share = found["better_share_of_comparable"]
    if share is None:
        return (
            "in no run do the starting and the tuned values both hold all limits, so the"
            " objectives cannot be compared"
        )
    runs = round(found["comparable"] * (found["samples"] - found["failed"]))
    return (
        f"the starting and the tuned values both hold all limits in {runs} of these runs"
        f" ({100 * found['comparable']:.3g} %); there tuning improved the objective in"
        f" {100 * share:.0f} %"
    )


def _choice_table(result):
    if not result.choices:
        return []
    rows = [
        [
            ", ".join(f"{n} = {v}" for n, v in c["values"].items()),
            c["status"],
            *("-" if v is None else number(v) for v in c["objective"].values()),
        ]
        for c in result.choices
    ]
    unit = cost_unit(result)
    sides = [f"objective {side} [{unit}]" for side in ("before", "after")]
    return [table(rows, ["choice", "status", *sides]), ""]


def _tradeoff_table(result):
    if not result.tradeoff:
        return []
    unit = ms.unit(result.tradeoff["measure"], result.tuned.loop.units)
    rows = [
        [
            number(p["limit"]),
            p["status"],
            number(p["objective"]),
            ", ".join(f"{n} {number(v, 4)}" for n, v in p["parameters"].items()),
        ]
        for p in result.tradeoff["points"]
    ]
    return [
        table(
            rows, [f"limit of {result.tradeoff['measure']} [{unit}]", "status", "objective", "at"]
        ),
        "",
    ]

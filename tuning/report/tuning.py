"""What a tuning result says in words, tables and JSON."""

import numpy as np

from jaxtank import measures as ms
from tuning.problem.problem import TAIL
from tuning.report.tables import (
    clean,
    measures_json,
    number,
    numbers,
    objective_unit,
    reasons,
    table,
    units,
    wrap,
)


def json_of(result):
    """The JSON object of `jaxtank tune --json`."""
    return {
        "case": result.tuned.name,
        "method": result.method,
        "success": result.success,
        "status": str(result.status),
        "message": result.message,
        "messages": [{"code": m.code, "text": m.text} for m in result.messages],
        "parameters": {n: {**clean(p), "interval": None} for n, p in result.parameters.items()},
        "interval_reason": "no measurements were fitted, so there is no confidence interval",
        "objective": {k: clean(result.objective[k]) for k in ("before", "after", "terms")},
        "measures": {
            "before": measures_json(result.measures["before"]),
            "after": measures_json(result.measures["after"]),
        },
        "reasons": {**reasons(result.measures["before"]), **reasons(result.measures["after"])},
        "units": units(result.tuned.loop.units),
        "constraints": clean([c.to_json() for c in result.constraints]),
        "evaluations": result.evaluations,
        "scenarios": scenario_rows(result),
        "starts": clean(result.starts),
        "symmetry": clean(result.symmetry),
        "choices": clean(result.choices),
        "optimality": clean(result.optimality),
        "curvature": clean(result.curvature),
        "tradeoff": clean(result.tradeoff),
        "certificate": None if result.certificate is None else result.certificate._asdict(),
        "wall_s": result.wall_s,
        "bound": None if result.bound is None else clean(result.bound.to_json()),
        "validation": clean(result.validation),
        "provenance": result.provenance,
    }


def text(result):
    """The result as a page of text."""
    return "\n".join([*parts_of(result), wrap(result.message)])


def parts_of(result):
    """What `text` says but for the message: a list of lines and Tables."""
    unit = objective_unit(result.objective["terms"], result.tuned.loop.units)
    head = [
        (
            f"{result.tuned.name}: {result.status} ({result.method},"
            f" {result.evaluations['simulations']} simulations, {result.evaluations['gradients']}"
            f" of them with gradients, {result.wall_s:.1f} s)"
        ),
        "",
    ]
    rows = [
        [
            n,
            p["unit"],
            number(p["before"]),
            number(p["after"]),
            f"{number(p['lower'])} : {number(p['upper'])}",
            "-" if p["sensitivity_percent"] is None else f"{number(p['sensitivity_percent'], 2)} %",
            (
                "not exercised, kept"
                if not p["exercised"]
                else f"at {p['at_bound']} bound"
                if p["at_bound"]
                else ""
            ),
        ]
        for n, p in result.parameters.items()
    ]
    parts = [
        table(
            rows,
            [
                "parameter",
                "unit",
                "before",
                "after",
                "range",
                "10 % of it moves the objective by",
                "",
            ],
        ),
        "",
    ]
    rows = [
        ["objective", unit, number(result.objective["before"]), number(result.objective["after"])]
    ]
    for m in ms.placed("shown"):
        if m in result.measures["after"] and not (
            m == "rms_error_total" and set(result.objective["terms"]) == {m}
        ):
            rows.append(
                [
                    m,
                    ms.unit(m, result.tuned.loop.units),
                    numbers(result.measures["before"][m], 4),
                    numbers(result.measures["after"][m], 5 if "level" in m else 4),
                ]
            )
    parts += [
        table(rows, ["measure", "unit", "before", "after"]),
        *_whose(result, len(rows) > 1),
        "",
    ]
    if result.constraints:
        shown = worst_of_scenarios(result.constraints)
        rows = [
            [
                c["name"],
                c["unit"],
                (">= " if ms.MEASURES[c["measure"]].sense < 0 else "<= ") + number(c["limit"], 7),
                number(c["value"], 7),
                number(c["margin"], 3) if c["reason"] is None else "undefined",
                f"{c['time_s']:.2f} s" if c["time_s"] is not None else "-",
            ]
            for c in shown
        ]
        parts += [table(rows, ["limit", "unit", "limit", "value", "margin", "reached at"]), ""]
    parts += (
        _scenario_table(result)
        + _validation_table(result)
        + _choice_table(result)
        + _tradeoff_table(result)
    )
    if result.bound is not None:
        parts += [result.bound.text(), ""]
    if result.tuned.loop.plant.overflow:
        rims = "rims are physics: liquid past them is lost"
    elif any(limit.measure == "max_level" for limit in result.problem.limits):
        rims = "rims are limits: a level may rise past one"
    else:
        rims = (
            "rims are neither physics nor limits here: a level may rise past one, and nothing"
            " holds it"
        )
    return [*head, *parts, f"{rims}; checked at dt = {result.tuned.clock.dt:g} s"]


def _whose(result, others):
    """Whose the rows of the table of measures are, where the objective is of other runs than the
    rest; others: whether there is a rest.
    """
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
    return [f"objective: {of[problem.risk]} of {len(problem.runs)} {what}{rest}"]


def worst_of_scenarios(constraints):
    """The rows of `constraints`, of those that differ by their scenario alone the one with the
    least margin.
    """
    worst = {}
    for c in constraints:
        same = (c["measure"], c["tank"], c["name"].removesuffix(f" in {c['scenario']}"))
        if same not in worst or c["margin"] < worst[same]["margin"]:
            worst[same] = c
    return list(worst.values())


def scenario_rows(result):
    """One dict for each scenario: {name, weight, objective {before, after}, limits_held {before,
    after}}; [] for the case's own run alone.
    """
    problem = result.problem
    if not problem.scenarios:
        return []
    rows = []
    for i, run in enumerate(problem.runs):
        mine = [limit for limit in problem.limits if limit.run == i]
        sides = {k: t[i] for k, t in result.tables.items()}
        rows.append(
            {
                "name": run.name,
                "weight": run.weight,
                "objective": clean({k: problem.cost(row) for k, row in sides.items()}),
                "limits_held": {
                    k: all(limit.margin(row) >= 0 for limit in mine) for k, row in sides.items()
                },
            }
        )
    return rows


COSTLIEST = 5


def _scenario_table(result):
    scenarios = scenario_rows(result)
    many = len(scenarios) > 12
    worst = sorted(
        scenarios,
        key=lambda s: -np.inf if s["objective"]["after"] is None else -s["objective"]["after"],
    )
    rows = [
        [
            s["name"],
            number(s["weight"], 3),
            *(
                number(s["objective"][k]) if s["objective"][k] is not None else "-"
                for k in ("before", "after")
            ),
            ("yes" if s["limits_held"]["after"] else "no") if result.problem.limits else "-",
        ]
        for s in (worst[:COSTLIEST] if many else scenarios)
    ]
    head = ["scenario", "weight", "objective before", "after", "limits held after"]
    held = sum(s["limits_held"]["after"] for s in scenarios)
    kept = f"; limits held after in {held}" if result.problem.limits else ""
    more = [f"the {COSTLIEST} costliest of {len(scenarios)} scenarios{kept}"] if many else []
    return [table(rows, head), *more, ""] if rows else []


def _validation_table(result):
    found = result.validation
    if not found:
        return []
    spread = (
        ", ".join(n if s is None else f"{n} +-{100 * s:g} %" for n, s in found["spread"].items())
        or "the plant as it is"
    )
    noise = ", fresh noise" if found["noise"] else ""
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
        return [f"held-out runs: all {found['samples']} failed", ""]
    head = [
        f"on {found['samples']} held-out runs",
        "mean objective",
        "5 %",
        "median",
        "95 %",
        "all limits held in",
    ]
    if not result.problem.limits:  # nothing to hold
        head, rows = head[:-1], [row[:-1] for row in rows]
    failed = f"; {found['failed']} runs failed and are left out" if found["failed"] else ""
    share = f"{_better(found)}; perturbed: {spread}{noise}{failed}"
    return [table(rows, head), share, ""]


def _better(found):
    """In how many held-out runs tuning gained: a lower cost than that of a run which breaks a limit
    is no gain, and a higher no loss.
    """
    if found["comparable"] == 1.0:
        return f"tuned is better in {100 * found['better_share']:.0f} % of them"
    part = f"before and after both hold every limit in {100 * found['comparable']:.3g} % of them"
    if found["better_share_of_comparable"] is None:
        return f"{part}, so their objectives are not to be compared"
    return (
        f"{part}, and of those tuned is better in {100 * found['better_share_of_comparable']:.0f} %"
    )


def _choice_table(result):
    if not result.choices:
        return []
    rows = [
        [
            ", ".join(f"{n} = {v}" for n, v in c["values"].items()),
            c["status"],
            number(c["objective"]["before"]),
            number(c["objective"]["after"]),
        ]
        for c in result.choices
    ]
    return [table(rows, ["choice", "status", "objective before", "after"]), ""]


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

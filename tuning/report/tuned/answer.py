"""The default answer of `tune` as text and JSON; imported by the report of a tuning result."""

import textwrap
from typing import Any

import numpy as np

from jaxtank import measures as ms
from tuning.problem.wording import numbered
from tuning.report.safety import PROMISE, start_of
from tuning.report.tables import number, objective_unit, table
from tuning.report.tuned.tables import parts_of as all_parts
from tuning.search.setting import limited_levels

WIDTH = 80

SHORT = {"rims": " ({})", "orifices": " ({})", "pumps": " ({})"}
"""How much is printed of a mend; that of the setpoints is long, and JSON and page have it."""

MATTERS = 0.05
"""Share of the plants that a need must concern to be a row [-]."""


def lines_of(result):
    """Return what is printed of a result with a default answer: about 25 lines of 80 columns."""
    found = [_wrapped(_headline(result)), *of_answer(result.answer, result)]
    return [*found, *(_wrapped(m.text, "- ") for m in result.messages)]


def parts_of(result):
    """Return the parts of its page: the summary, and every table of a tuning result."""
    return [_headline(result), *of_answer(result.answer, result), "", *all_parts(result)[1:]]


def of_answer(answer, result=None):
    """Return lines and Tables on an Answer; with the values to set of its result, where given."""
    found = []
    if answer.mended is not None:
        found += [_wrapped(f"mended first: {answer.mended.words}")]
    if answer.feasibility is not None and answer.feasibility.infeasible_for_any_controller > 0:
        found += _beyond(answer)
    if result is not None:
        found += [_values(result, answer), ""]
    found += [_effects(answer)]
    proved = [row.starts for row in answer.setting.certificates if row.certified]
    return [*found, "", _wrapped(f"proved: {PROMISE}, {start_of(proved)}")] if proved else found


def _beyond(answer):
    """Lines and a Table on what no gain can change: the needs of MATTERS of the plants at least."""
    found = answer.feasibility
    unit = found.case.loop.units[0]
    rows = [
        [
            ", ".join(f"{v:g}" for v in row.setpoints) + f" {unit}",
            f"tank {row.tank}" if row.pump is None else f"pump {row.pump}",
            *(f"{v:.3g} {row.unit}" for v in (row.needed, row.needed_p95, row.limit)),
            f"{100 * row.share:.0f} %",
        ]
        for row in found.plateaus
        if row.share >= MATTERS
    ]
    share = number(100 * found.infeasible_for_any_controller, 2)
    text = f"No controller can hold every setpoint on {share} % of {found.samples} plants"
    lines = [_wrapped(text + " within the limits" + (":" if rows else "."))]
    heads = ["setpoints", "", "needs", "95 % need", "limit", "plants that cannot"]
    lines += [table(rows, heads)] if rows else []
    if found.mends:
        kinds = [f"--mend {m.what}" + SHORT.get(m.what, "").format(m.words) for m in found.mends]
        lines.append(_wrapped(f"95 % of the plants can follow with {' or '.join(kinds)}"))
    return lines


def json_parts(result) -> dict[str, Any]:
    """Return {"holds", "feasibility", "answer"} of the JSON, null without a default answer."""
    answer = result.answer
    if answer is None:
        return dict.fromkeys(("holds", "feasibility", "answer"))
    feasibility = None if answer.feasibility is None else answer.feasibility.to_json()
    return {"holds": answer.holds(), "feasibility": feasibility, "answer": answer.to_json()}


def _headline(result):
    """One sentence on the outcome."""
    answer, status = result.answer, result.headline.replace("_", " ")
    start = f"{result.tuned.name}: {status}"
    if answer.after is None:
        return f"{start}; no validation plants ({result.wall_s:.1f} s)"
    held, samples = int(answer.after.held.sum()), answer.after.samples
    on = f"; limits hold on {held} of {samples} {answer.setting.runs}"
    limited = on if answer.after.limits else ""
    tanks = [r.tank + 1 for r in answer.setting.certificates if r.certified]
    proved = f", proved for {numbered('tank', tanks)}" if tanks and limited else ""
    changed = sum(not stays for stays in answer.kept.values())
    gains = f"; {changed} of {len(answer.kept)} gains changed" if answer.kept else ""
    return f"{start}{limited}{proved}{gains} ({result.wall_s:.1f} s)"


def _wrapped(text, first=""):
    return textwrap.fill(
        text,
        WIDTH,
        initial_indent=first,
        subsequent_indent=" " * len(first),
        break_on_hyphens=False,
        break_long_words=False,
    )


def _values(result, answer):
    """The table of what to set."""
    rows = []
    for name, p in result.parameters.items():
        stays = answer.kept.get(name, False)
        remark = "kept (a change gains little)" if stays else ""
        remark = remark if p["exercised"] else "kept: no effect in any run"
        remark = f"at its {p['at_bound']} bound" if p["at_bound"] and not remark else remark
        digits = [number(p[side], 4) for side in ("before", "after")]
        rows.append([f"{name} [{p['unit']}]", *digits, remark])
    rows.append(_filter_row(answer, result.case.loop))
    return table(rows, ["what to set", "was", "now", ""])


def _filter_row(answer, before):
    """The row of the safety filter."""
    was = "on" if before.safety_filter is not None else "off"
    if answer.setting.filter is None:
        return ["safety filter", was, "off", ""]
    found, unit = answer.setting.searched.loop.safety_filter, before.units[0]
    rate, band = float(np.max(found.rate)), float(np.max(found.band))
    return ["safety filter", was, "on", f"rate {rate:.3g} 1/s, noise band {band:.3g} {unit}"]


def _effects(answer):
    """The table of what the answer gives, before and after, on the plants that judged it."""
    unit, after = answer.setting.case.loop.units[0], answer.after
    sides = [answer.before] if after is None else [answer.before, after]
    n = answer.before.samples
    rows = [
        [f"error, mean of {n} plants [{unit}]", *(_mean(s.error, s) for s in sides)],
        *_able(answer, sides, unit),
        [f"error, nominal plant [{unit}]", *(number(e, 3) for e in answer.nominal.values())],
    ]
    rows += _margins(answer)
    if answer.setting.own_objective:
        rows.insert(0, [_objective_words(answer), *(_mean(s.cost, s) for s in sides)])
    if answer.before.limits:
        broken = [f"{100 * (1 - s.held.mean()):.3g} %" for s in sides]
        rows.append(["plants that violate a limit", *broken])
    rows += _levels(answer, sides, unit)
    rows.append(
        [
            "rms change of input per sample [% of range]",
            *(_mean(100 * s.travel, s, 2) for s in sides),
        ]
    )
    heads = ["what it gives", "before", "now"]
    return table(rows, heads[: 1 + len(sides)])


def facts_of(answer):
    """(name, value before -> after) of the errors on the plants that judged an Answer."""
    if answer.after is None:
        return []
    unit, sides = answer.setting.case.loop.units[0], (answer.before, answer.after)
    rows = [
        (f"error, mean of {answer.after.samples} plants", [_mean(s.error, s) for s in sides]),
        ("error, nominal plant", [number(e, 3) for e in answer.nominal.values()]),
    ]
    return [(name, f"{' -> '.join(cells)} {unit}") for name, cells in rows]


def _margins(answer):
    """The rows of the sensitivity peak and the delay margin of the linearised nominal loop."""
    sides = [m for m in answer.measures.values() if "sensitivity_peak" in m]
    if not sides or not any(np.isfinite(m["sensitivity_peak"]) for m in sides):
        return []
    peaks = [float(m["sensitivity_peak"]) for m in sides]
    delays = [float(np.min(m["delay_margin"])) for m in sides]
    cells = ["unstable" if p == np.inf else number(p, 3) for p in peaks]
    rows = [["sensitivity peak Ms, nominal plant [-]", *cells]]
    if any(np.isfinite(delays)):
        cells = ["any" if d == np.inf else number(d, 3) for d in delays]
        rows.append(["delay margin, nominal plant [s]", *cells])
    return rows


def _objective_words(answer):
    """The objective of the user's in the table: its name, if it has one, and its unit, if any."""
    terms = answer.setting.objective
    unit = objective_unit(terms, answer.setting.case.loop.units)
    name = f" {next(iter(terms))}" if len(terms) == 1 else ""
    words = f"objective{name}, mean of {answer.before.samples} plants"
    return words if unit == "-" else f"{words} [{unit}]"


def _mean(values, judged, digits=3):
    good = ~judged.failed
    return number(values[good].mean() if good.any() else np.nan, digits)


def _able(answer, sides, unit):
    """The error where the setpoints can be held, if some plants cannot hold them."""
    cannot = answer.before.infeasible
    if cannot is None or not cannot.any() or cannot.all():
        return []
    able = [s.error[~cannot & ~s.failed] for s in sides]
    cells = [number(v.mean() if v.size else np.nan, 3) for v in able]
    return [[f"  on those that can follow ({100 * np.mean(~cannot):.0f} %)", *cells]]


def _levels(answer, sides, unit):
    """The row of the highest level, of the tanks that have a limit."""
    limited = np.isfinite(limited_levels(answer.setting.case))
    if not limited.any():
        return []
    cells = []
    for s in sides:
        good = ~s.failed
        cells.append(number(s.level[good][:, limited].max() if good.any() else np.nan, 4))
    return [[f"highest level [{unit}]", *cells]]


def objective_words(answer):
    """Return the cost in words, with its unit."""
    terms = " + ".join(f"{w:.3g} {m}" for m, w in answer.setting.objective.items())
    unit = ms.unit(next(iter(answer.setting.objective)), answer.setting.case.loop.units)
    return f"mean of {terms} [{unit}]"

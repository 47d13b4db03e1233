"""The report of a feasibility study: text, JSON, a picture, page and folder."""

import dataclasses

from jaxtank.core.labels import labels_of, short
from tuning.report import advice, verdict as verdicts
from tuning.report.document import Report, Text
from tuning.report.tables import Table, Value, clean, fields
from tuning.search.setting import scenarios_to_judge

LISTED = 0.005  # share of the plants from which on a need is a row of a table [-]
MATTERS = 0.05  # the same for a default answer; unreachable share that needs no mend [-]

CAPTIONS = {
    "needs": "What the steady states at the plateaus need: of the nominal plant, and exceeded by"
    " 5 % of the plants; the line is the limit."
}


def json_of(study):
    return {
        **fields(study, "infeasible_for_any_controller interval95 samples wall_s mends_s"),
        "plateaus": [clean(dataclasses.asdict(row)) for row in study.plateaus],
        "mends": [
            {**fields(m, "what share words"), "set": clean(dict(m.set))} for m in study.mends
        ],
    }


def sentence(study):
    if not study.infeasible.any():
        return f"Each of {study.samples} sampled plants has a steady state at every plateau."
    share = _percent(study.infeasible_for_any_controller)
    run = ", in the case's own run," if scenarios_to_judge(study.case) else ""
    loop, shares = study.case.loop, advice.shares_inputs(study.case.loop)
    by_hand = getattr(loop.controller, "by_hand", ())
    inputs = f" ({labels_of(loop.plant, 'pump', by_hand)} by hand)" if by_hand else ""
    whatever = f"controller{inputs}" if not shares else "gains, with these shares of the inputs"
    return (
        f"On {share} of {study.samples} sampled plants{run} at least one setpoint has no steady"
        f" state within the limits, whatever the {whatever}"
        f"{advice.FAULTLESS * (loop.faults is not None)}."
    )


def beyond(study, case, values, plants=None):
    """Return the sentence of an Advice: the setpoint most often out of reach, and its mends."""
    # case, values: of the answer; plants: its Judged, where the case has scenarios
    if plants is not None and plants.infeasible is not None:
        lost = plants.infeasible
        if not lost.any():
            return advice.reachable(case, f"each of {plants.samples} {plants.runs}", values)
        share = _percent(lost.mean())
        out_of_reach = f"on {share} of {plants.runs} one is out of reach"
        return f"{advice.beyond_gains(case)}: {out_of_reach}.{advice.blocked_too(case, values)}"
    if not study.infeasible.any() or not study.plateaus:
        return advice.reachable(case, f"each of {study.samples} sampled plants", values)
    row = max(study.plateaus, key=lambda row: row.share)
    share = _percent(study.infeasible_for_any_controller)
    mends = " or ".join(m.what for m in study.mends)
    way = f"; --mend {mends} helps" if mends else ""
    need = advice.need(study.case, row, plants=True)
    out_of_reach = f"on {share} of plants one is out of reach"
    blocked = advice.blocked_too(case, values)
    return f"{advice.beyond_gains(case)}: {out_of_reach} ({need}){way}.{blocked}"


def _percent(share):
    return Value(100 * share, 2 if share < 0.995 else 3, "%")  # 38 %, 99 %, 100 %


def needs(study, least=LISTED):
    """Return the Table of needed levels that at least `least` of the plants cannot reach."""
    rows, loop = [], study.case.loop
    for row in (row for row in study.plateaus if row.share >= least):
        tank = row.pump is None and short(loop.plant, "tank", row.tank - 1)
        needed = [Value(v, 3, row.unit) for v in (row.needed, row.needed_p95)]
        limit = Value(row.limit, 6, row.unit)
        ends = [limit if row.upper else f">= {limit}", _percent(row.share)]
        setpoints = Value(row.setpoints, 6, loop.units[0], ", ")
        rows.append([setpoints, tank or advice.part_of(study.case, row), *needed, *ends])
    of = "tank" if all(row.pump is None for row in study.plateaus) else "tank or input"
    heads = ["setpoints", of, "needed", "needed, 95 %", "limit", "not reachable"]
    return [Table(rows, heads)] if rows else []


def unreachable(study):
    """Return the sections of a default answer: lost setpoints, and options that mend them."""
    if not study.case.reachable and study.infeasible.all():
        return []  # the file says so: a tank that nothing holds level, say
    sections = [Text([sentence(study)]), *needs(study, MATTERS)]
    # without the change of setpoints, which is long: see the JSON and the report of the study
    if study.mends:
        words = lambda m: f" ({m.words})" if m.what != "setpoints" else ""
        kinds = " or ".join(f"--mend {m.what}{words(m)}" for m in study.mends)
        sections.append(Text([f"Every setpoint is reachable on 95 % of the plants with {kinds}"]))
    return sections


def report(study):
    share = study.infeasible_for_any_controller
    good = share <= MATTERS
    mends = [f"  {m.what}: {' '.join(m.options)}" for m in study.mends]
    if mends:
        mends = ["Every setpoint is reachable on 95 % of the plants with one of:", *mends]
    elif not good:
        mends = ["No change of setpoints, rims, orifices or pumps alone was found to do for 95 %."]
    facts = [("plants", study.samples), ("infeasible", Value(100 * share, 2, "%"))]
    verdict, sections = verdicts.outcome(sentence(study), good), [*needs(study), Text(mends)]
    what, title = "feasibility of the setpoints", study.case.title
    return Report(study.case.name, what, verdict, facts, sections, title)


def figures(study):
    """Return {"needs": matplotlib Figure}; {} where every setpoint is reachable."""
    from jaxtank.plots.style import AFTER, BEFORE, FORBIDDEN, picture, plain

    rows = [row for row in study.plateaus if row.share >= LISTED]
    part = lambda row: advice.part_of(study.case, row)

    def draw(ax):
        nominal, high, limit = zip(*((r.needed, r.needed_p95, r.limit) for r in rows))
        y = range(len(rows))
        ax.hlines(y, nominal, high, color="0.8", zorder=1)
        ax.plot(nominal, y, "o", color=AFTER, label="nominal plant")
        ax.plot(high, y, "s", color=BEFORE, label="95 % of plants")
        ax.plot(limit, y, "|", color=FORBIDDEN, markersize=18, markeredgewidth=2, label="limit")
        ax.set_yticks(y, [plain(f"{Value(r.setpoints, 6, '', ', ')}: {part(r)}") for r in rows])
        ax.invert_yaxis()
        ax.set_xlabel(f"needed [{' or '.join(dict.fromkeys(row.unit for row in rows))}]")
        ax.set_title(plain(study.case.name))
        ax.legend()

    return {"needs": picture(draw, (6.0, 1.0 + 0.5 * len(rows)))} if rows else {}

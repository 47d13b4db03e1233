"""The report of a feasibility study: text, JSON, a picture, page and folder."""

from tuning.problem import provenance
from tuning.problem.wording import count
from tuning.report.document import Report, Text, figures_of
from tuning.report.folder import save as save_all
from tuning.report.tables import Table, Value, clean

SHOWN = 0.005
"""Share of the plants from which on a need is a row of the table; JSON has all [-]."""

ACCEPTED = 0.05
"""Share of the plants up to which unreachable setpoints need no change of the design [-]."""

CAPTIONS = {
    "needs": "What the steady states at the plateaus need: of the nominal plant, and exceeded by"
    " 5 % of the plants; the line is the limit."
}


def json_of(study):
    """Return the object `feasibility` of `jaxtank tune --json`."""
    return {
        "infeasible_for_any_controller": study.infeasible_for_any_controller,
        "interval95": study.interval95,
        "samples": study.samples,
        "plateaus": [
            {
                "time_s": row.time_s,
                "setpoints": list(row.setpoints),
                "tank": row.tank,
                "pump": row.pump,
                "needed": clean(row.needed),
                "needed_p95": clean(row.needed_p95),
                "limit": clean(row.limit),
                "share": row.share,
                "unit": row.unit,
            }
            for row in study.plateaus
        ],
        "mends": [
            {"what": m.what, "set": clean(dict(m.set)), "share": m.share, "words": m.words}
            for m in study.mends
        ],
        "wall_s": study.wall_s,
        "mends_s": study.mends_s,
    }


def report(study, drawn=None):
    """Return the Report of a Feasibility."""
    bad, plants = int(study.infeasible.sum()), count(study.samples, "plant")
    share, name = Value(100 * study.infeasible_for_any_controller, 2, "%"), study.case.name
    sections = [Text([f"{name}: each of {plants} has a steady state at every plateau"])]
    if bad:
        percent = Value(100 * bad / study.samples, 2, "%")
        words = f"{name}: {percent} of {plants} cannot hold every setpoint within their limits,"
        sections = [Text([f"{words} whatever the controller"]), *_table(study), *_mends(study)]
    return Report(
        f"{name}: feasibility of the setpoints",
        f"{share} of the plants cannot hold every setpoint",
        [("plants", study.samples), ("infeasible", share)],
        [*sections, *figures_of(drawn or {}, CAPTIONS)],
        study.infeasible_for_any_controller <= ACCEPTED,
        study.case.title,
    )


def _table(study):
    """What plateaus need, where a need is passed by SHOWN of the plants."""
    rows = [
        [
            Value(row.setpoints, 6, study.case.loop.units[0], ", "),
            f"tank {row.tank}" if row.pump is None else f"pump {row.pump}",
            *(Value(v, 3, row.unit) for v in (row.needed, row.needed_p95)),
            Value(row.limit, 6, row.unit),
            Value(100 * row.share, 2, "%"),
        ]
        for row in study.plateaus
        if row.share >= SHOWN
    ]
    heads = ["setpoints", "", "needs, nominal", "needs, 95 % of plants", "limit"]
    return [Table(rows, [*heads, "plants that cannot"])] if rows else []


def _mends(study):
    """The changes of the design that are enough, with the options that make them."""
    if study.mends:
        options = [f"  {m.what}: {' '.join(m.options)}" for m in study.mends]
        return [Text(["for 95 % of plants, one of:", *options])]
    if study.infeasible_for_any_controller <= ACCEPTED:
        return []
    words = "no change of setpoints, rims, orifices or pumps alone was found that is enough for"
    return [Text([f"{words} 95 % of plants"])]


def figures(study):
    """Return {"needs": matplotlib Figure}; {} where every plant can follow."""
    from jaxtank.plots.style import AFTER, BEFORE, FORBIDDEN, picture, plain

    rows = [row for row in study.plateaus if row.share >= SHOWN]

    def draw(ax):
        for k, row in enumerate(rows):
            ax.plot([row.needed, row.needed_p95], [k, k], color="0.8", zorder=1)
            first, second = ("nominal plant", "95 % of plants") if k == 0 else (None, None)
            ax.plot(row.needed, k, "o", color=AFTER, label=first)
            ax.plot(row.needed_p95, k, "s", color=BEFORE, label=second)
            ax.plot([row.limit] * 2, [k - 0.3, k + 0.3], color=FORBIDDEN, linewidth=2)
        parts = (f"tank {r.tank}" if r.pump is None else f"pump {r.pump}" for r in rows)
        labels = [f"{Value(r.setpoints, 6, '', ', ')}: {part}" for r, part in zip(rows, parts)]
        ax.set_yticks(range(len(rows)), labels)
        ax.invert_yaxis()
        ax.set_xlabel(f"needed [{' or '.join(dict.fromkeys(row.unit for row in rows))}]")
        ax.set_title(plain(study.case.name))
        ax.legend()

    return {"needs": picture(draw, (6.0, 1.0 + 0.5 * len(rows)))} if rows else {}


def save(study, folder, command=None):
    """Write result.json, needs.png and report.html to `folder`; return their paths."""
    draw, page = lambda: figures(study), lambda drawn: report(study, drawn)
    made = provenance.provenance(study.case, study.seed)
    return save_all(folder, json_of(study), {}, draw, page, command, provenance=made)

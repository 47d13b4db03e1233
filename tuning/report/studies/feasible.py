"""The report of a feasibility study: text, JSON, a picture, page and folder."""

from jaxtank.core.files import check_folder
from tuning.problem import provenance
from tuning.problem.wording import count
from tuning.report import artifacts, html, tables

SHOWN = 0.005
"""Share of the plants from which on a need is a row of the table; JSON has all [-]."""

CAPTION = (
    "What the steady states at the plateaus need: of the nominal plant, and exceeded by 5 % of"
    " the plants; the line is the limit."
)


def json_of(found):
    """Return the object `feasibility` of `jaxtank tune --json`."""
    return {
        "infeasible_for_any_controller": found.infeasible_for_any_controller,
        "interval95": found.interval95,
        "samples": found.samples,
        "plateaus": [
            {
                "time_s": row.time_s,
                "setpoints": list(row.setpoints),
                "tank": row.tank,
                "pump": row.pump,
                "needed": tables.clean(row.needed),
                "needed_p95": tables.clean(row.needed_p95),
                "limit": tables.clean(row.limit),
                "share": row.share,
                "unit": row.unit,
            }
            for row in found.plateaus
        ],
        "mends": [mend_json(mend) for mend in found.mends],
        "wall_s": found.wall_s,
        "mends_s": found.mends_s,
    }


def mend_json(mend):
    """Return the JSON object of a Mend."""
    return {
        "what": mend.what,
        "set": tables.clean(dict(mend.set)),
        "share": mend.share,
        "words": mend.words,
    }


def lines(found):
    """Return what is printed of a Feasibility: lines and Tables."""
    bad, samples = int(found.infeasible.sum()), count(found.samples, "plant")
    if not bad:
        return [f"{found.case.name}: each of {samples} has a steady state at every plateau"]
    return [
        f"{found.case.name}: {percent(bad / found.samples)} of {samples} cannot hold every setpoint"
        " within their limits, whatever the controller",
        *table_of(found),
        *mends_of(found),
    ]


def percent(share):
    """Return a share in per cent, to two digits."""
    return f"{100 * share:.2g} %"


def table_of(found):
    """Return [Table] of what plateaus need, [] where no need is passed by SHOWN of the plants."""
    rows = [
        [
            ", ".join(f"{v:g}" for v in row.setpoints) + f" {found.case.loop.units[0]}",
            f"tank {row.tank}" if row.pump is None else f"pump {row.pump}",
            *(f"{v:.3g} {row.unit}" for v in (row.needed, row.needed_p95)),
            f"{row.limit:g} {row.unit}",
            percent(row.share),
        ]
        for row in found.plateaus
        if row.share >= SHOWN
    ]
    heads = [
        "setpoints",
        "",
        "needs, nominal",
        "needs, 95 % of plants",
        "limit",
        "plants that cannot",
    ]
    return [tables.table(rows, heads)] if rows else []


def mends_of(found):
    """Return a line for each mend, with the options that make it."""
    if not found.mends:
        if found.infeasible_for_any_controller <= 0.05:
            return []
        return [
            "no change of setpoints, rims, orifices or pumps alone was found that is enough for"
            " 95 % of plants"
        ]
    head = ["for 95 % of plants, one of:"]
    return head + [f"  {m.what}: {' '.join(m.options)}" for m in found.mends]


def figures(found):
    """Return {"needs": matplotlib Figure}; {} where every plant can follow."""
    from jaxtank.plots.style import AFTER, BEFORE, FORBIDDEN, grid, plain, styled

    rows = [row for row in found.plateaus if row.share >= SHOWN]
    if not rows:
        return {}
    with styled():
        figure, axes = grid(1, 1, (6.0, 1.0 + 0.5 * len(rows)))
        ax = axes[0, 0]
        for k, row in enumerate(rows):
            ax.plot([row.needed, row.needed_p95], [k, k], color="0.8", zorder=1)
            ax.plot(row.needed, k, "o", color=AFTER, label="nominal plant" if k == 0 else None)
            ax.plot(
                row.needed_p95, k, "s", color=BEFORE, label="95 % of plants" if k == 0 else None
            )
            ax.plot([row.limit] * 2, [k - 0.3, k + 0.3], color=FORBIDDEN, linewidth=2)
        labels = [
            f"{', '.join(f'{v:g}' for v in row.setpoints)}: "
            + (f"tank {row.tank}" if row.pump is None else f"pump {row.pump}")
            for row in rows
        ]
        ax.set_yticks(range(len(rows)), labels)
        ax.invert_yaxis()
        ax.set_xlabel(f"needed [{' or '.join(dict.fromkeys(row.unit for row in rows))}]")
        ax.set_title(plain(found.case.name))
        ax.legend()
    return {"needs": figure}


def save(found, folder, command=None):
    """Write result.json, needs.png and report.html to `folder`; return their paths."""
    check_folder(folder)
    share = percent(found.infeasible_for_any_controller)

    def page(drawn):
        parts = lines(found)
        return html.document(
            f"{found.case.name}: feasibility of the setpoints",
            found.case.title,
            f"{share} of the plants cannot hold every setpoint",
            found.infeasible_for_any_controller <= 0.05,
            [("plants", str(found.samples)), ("infeasible", share)],
            [part for part in parts if not isinstance(part, tables.Table)],
            html.drawings(drawn, dict.fromkeys(drawn, CAPTION)),
            [part for part in parts if isinstance(part, tables.Table)],
            command,
            provenance.provenance(found.case, found.seed),
        )

    files = {"result.json": tables.dumps(json_of(found)) + "\n"}
    return artifacts.write_result(folder, files, lambda: figures(found), page)

"""Proved limits on the levels of a case: the tables of its safety filter."""

import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.core.labels import short
from jaxtank.core.units import local
from jaxtank.safety.checker import CASE, LIMITS
from jaxtank.safety.of_case import certificates_of
from tuning.report.tables import Table, Value, fields

PROMISE = (  # hypotheses of the proofs, without the start
    "on any plant with parameters in the case's intervals, under any controller, while each reading"
    " is within its noise band and no fault takes a parameter out of its interval"
)


def start_of(starts):
    """Return in words from which levels at t = 0 all of several limits are proved."""
    highest = "the limits" if set(starts) == {LIMITS} else "the case's start"
    return f"from levels at or below {highest}"


def certificates(case):
    """Return a dict per tank on the safety filter that a case has or could have, or None."""
    try:
        rows = certificates_of(case)
    except InputError:
        return None
    low = lambda row: fields(row, "limit=low certified=low_certified why=low_reason")
    return [
        {
            "tank": row.tank + 1,
            **fields(row, "limit certified why=reason rate rate_bound gap reach"),
            "starts": row.starts or None,
            "low": low(row) if row.low > 0.0 else None,
        }
        for row in rows
    ]


def table_of(case, rows):
    length, cells = local("cm", case.loop.units), []
    tank = lambda row: short(case.loop.plant, "tank", row["tank"] - 1)
    for row in rows:
        proved, start = "yes" if row["certified"] else "no", row["starts"] or "-"
        rates = [Value(row["rate"], 3), Value(row["rate_bound"], 3)]
        limit, gap = Value(row["limit"], 4), Value(row["gap"], 3)
        cells.append([tank(row), limit, proved, start, *rates, gap, row["why"]])
    for row in rows:
        if low := row["low"]:
            proved, start = "yes" if low["certified"] else "no", CASE if low["certified"] else "-"
            limit = f"low {low['limit']:.4g}"
            rate = Value(row["rate"], 3)
            cells.append([tank(row), limit, proved, start, rate, "-", "-", low["why"]])
    heads = ["tank", f"limit [{length}]", "proved", "start", "kappa [1/s]", "at most [1/s]"]
    heads += [f"gap [{length}]", "by, or why not"]
    return Table(cells, heads, heading="Limits on levels")


def sentences(case):
    length = local("cm", case.loop.units)
    start = ", ".join(f"{h:.4g}" for h in np.asarray(case.loop.x0, dtype=float))
    on = "on" if case.loop.safety_filter is not None else "off: --safety-filter turns it on"
    return [
        f"The safety filter is {on}.",
        f"proved: no level passes its limit {PROMISE}, from the levels at t = 0 in the column"
        " start. limits: every tank at or below its limit; case: every tank at or below the case's"
        f" start, ({start}) {length}, for a low limit from that start. An independent check of the"
        " finished filter confirms it. The last column names the theorem"
        " (jaxtank/safety/README.md), the condition that failed, or the feature that the check does"
        " not cover.",
        "kappa: a level may rise by at most kappa x its distance to the limit; at most: the largest"
        " kappa that is proved.",
        "gap: with its pumps at full command the nominal rig settles this far below the limit, or"
        " below where it would settle without the filter; -: no pump feeds the tank.",
    ]


def passed(case, values):
    """Return sentences on levels of {measure: value} that passed a limit of the safety filter."""
    safety_filter, sentences = case.loop.safety_filter, []
    sides = (("max_level", "limit", 1.0), ("min_level", "low", -1.0))
    reasons = None
    for measure, name, sign in sides:
        limits = np.asarray(getattr(safety_filter, name), dtype=float)
        if name == "limit":
            limits = limits + np.asarray(getattr(safety_filter, "spare", 0.0))
        levels = np.asarray(values.get(measure, limits), dtype=float)
        beyond = (limits > 0.0) & (sign * (levels - limits) > 1e-9 * limits)
        for i in map(int, np.flatnonzero(beyond)):
            reasons = reasons or certificates_of(case)
            row, length = reasons[i], local("cm", case.loop.units)
            certified = (row.low_certified, row.low_reason), (row.certified, row.reason)
            proved, why = certified[sign > 0.0]
            side = "above the limit" if sign > 0.0 else "below the low limit"
            sentences.append(
                f"{short(case.loop.plant, 'tank', i)}: {levels[i]:.4g} {length}, {side}"
                f" {limits[i]:.4g} {length} of the safety filter, which is"
                + (" proved" if proved else f" not proved: {why}")
            )
    return sentences

"""What is proved of the levels of a case: the tables of its safety filter.

Imported by the page of `jaxtank show`.
"""

from jaxtank.core.errors import InputError
from jaxtank.core.units import local
from tuning.report import tables


def certificates(case):
    """Return [{"tank", "limit", "certified", "why", "rate", "rate_bound", "gap", "reach", "low"}],
    one for each tank, of the safety filter that the case has or could have; tanks from 1; None
    where there is no filter for its plant. low: {"limit", "certified", "why"}, None without one.

    Examples
    --------
    >>> from jaxtank import presets
    >>> [row["certified"] for row in certificates(presets.find("cascaded/pi"))]
    [True, True]
    """
    try:
        _, rows = case.safety_design(**(case.safety or {}))
    except InputError:
        return None
    return [
        {
            "tank": row.tank + 1,
            "limit": row.limit,
            "certified": row.certified,
            "why": row.reason,
            "rate": row.rate,
            "rate_bound": row.rate_bound,
            "gap": tables.clean(row.gap),
            "reach": tables.clean(row.reach),
            "low": {"limit": row.low, "certified": row.low_certified, "why": row.low_reason}
            if row.low > 0.0
            else None,
        }
        for row in rows
    ]


def rows_of(case, found):
    """Return (heads, rows) of the table of `certificates`, its numbers in the case's units."""
    length = local("cm", case.loop.units)
    heads = ["tank", f"limit [{length}]", "proved", "kappa [1/s]", "at most [1/s]"]
    heads += [f"gap [{length}]", "by, or why not"]
    rows = [
        [
            row["tank"],
            f"{row['limit']:.4g}",
            "yes" if row["certified"] else "no",
            f"{row['rate']:.3g}",
            f"{row['rate_bound']:.3g}",
            "-" if row["gap"] is None else f"{row['gap']:.3g}",
            row["why"],
        ]
        for row in found
    ]
    rows += [
        [
            row["tank"],
            f"low {low['limit']:.4g}",
            "yes" if low["certified"] else "no",
            f"{row['rate']:.3g}",
            "-",
            "-",
            low["why"],
        ]
        for row in found
        if (low := row["low"])
    ]
    return heads, rows


def sentences(case):
    """Return what the table of `certificates` is about."""
    on = "on" if case.loop.safety_filter is not None else "off: --safety-filter turns it on"
    return [
        f"The safety filter is {on}.",
        "proved: no plant of the case's intervals passes the limit, under any controller and for"
        " readings within their band. The last column names the theorem (jaxtank/safety/README.md),"
        " or the condition that failed.",
        "kappa: a level may rise by at most kappa x its distance to the limit; at most: the largest"
        " kappa that is proved.",
        "gap: with its pumps at full command the nominal rig settles this far below the limit, or"
        " below where it would settle without the filter; -: no pump of its own.",
    ]

"""The text of `jaxtank identify --plan`."""

import numpy as np

from jaxtank.core.tree import get_value
from tuning.report import tables


def plan_text(case, found, best, plan):
    """Return the text of `identify --plan`: a table of `compare_experiments` and the best one."""
    # plan: {"duration" [s], "dt" [s], "noise", "levels": measured tanks or None}.
    letters, rows = dict(zip("ABCDEFGH", found)), []
    for name in next(iter(found.values()))["sd"]:
        value = float(np.asarray(get_value(case.loop, name)))
        shares = [
            "open" if sd is None else f"{100 * sd / abs(value):.2g} %" if value else f"{sd:.2g}"
            for sd in (found[one]["sd"][name] for one in letters.values())
        ]
        rows.append([name, f"{value:.5g}", *shares])
    conditions = (found[one]["condition"] for one in letters.values())
    shown = ["-" if c is None or c > 1e15 else f"{c:.3g}" for c in conditions]
    rows.append(["condition of J'J", "", *shown])
    levels = plan["levels"]
    measured = "every level" if levels is None else ", ".join(f"h{i + 1}" for i in levels)
    return "\n".join(
        [
            f"{case.name}: standard deviations that {plan['duration']:g} s, {measured} read every"
            f" {plan['dt']:g} s with noise of {plan['noise']:g} {case.loop.units[0]} would leave",
            "",
            tables.table(rows, ["parameter", "value", *letters]),
            "",
            *(f"{letter}  {one}" for letter, one in letters.items()),
            "",
            f"Most informative: {best}." if best else "None identifies all of these parameters.",
        ]
    )

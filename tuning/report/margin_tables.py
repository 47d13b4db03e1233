"""Stability margins of the plateaus of a loop as text and JSON; imported by the command line."""

import numpy as np

from jaxtank.core.jsonable import clean
from tuning.report.tables import number, table


def json_of(plateaus):
    """Return the list `margins` of the JSON of `simulate`: an object for each plateau."""
    rows = []
    for p in plateaus:
        values = {m: v for m, v in p.margins._asdict().items() if m != "stable"}
        row = {"setpoints": p.setpoints, "levels": p.x, "inputs": p.u, "stable": p.stable}
        rows.append(clean({**row, "why": p.why or None, **values}))
    return rows


def text(loop, plateaus):
    """Return a table of the margins at each plateau, the worst one marked, and why there
    are none.
    """
    if not plateaus:
        return "no stability margins: the reference holds no setpoints"
    unit, worst = loop.units[0], _worst(plateaus)
    rows, notes = [], []
    for p in plateaus:
        name = ", ".join(f"{v:g}" for v in p.setpoints) + f" {unit}"
        if p.why:
            notes.append(f"{name}: no margins, {p.why}")
        elif not p.stable:
            notes.append(f"{name}: the linearised loop is unstable")
        else:
            m = p.margins
            rows.append([name + (" (worst)" if p is worst else ""), *_cells(m)])
    heads = ["setpoints", "Ms [-]", "gain margin [-]", "phase margin [deg]", "delay margin [s]"]
    title = "stability margins of the linearised loop, one pump at a time (Ms: all)"
    return "\n".join([title, *([table(rows, heads)] if rows else []), *notes])


def _worst(plateaus):
    """The Plateau with the highest sensitivity peak; None where there is none."""
    stable = [p for p in plateaus if p.stable]
    return max(stable, key=lambda p: float(p.margins.sensitivity_peak), default=None)


def _cells(margins):
    """The entries of a row; "any" for a margin without end."""
    shown = lambda v: "any" if v == np.inf else number(v, 3)
    values = (margins.gain_margin, margins.phase_margin, margins.delay_margin)
    cells = ["  ".join(map(shown, np.ravel(v))) for v in values]
    return [number(margins.sensitivity_peak, 3), *cells]

"""The page report.html of one simulated run; imported by `jaxtank simulate`."""

import numpy as np

from jaxtank import measures as ms
from tuning.problem.limits import resolve_limits
from tuning.report import html, tables
from tuning.report.panel import panel

CAPTIONS = {
    "responses": "Levels with setpoints and rims, and the inputs of the pumps.",
    "estimates": (
        "What the observer estimated: levels with their readings, and disturbances of their rates"
        " with the inflow disturbance, where there is one; they hold all errors of the model."
    ),
    "shares": (
        "The share of each of the two blended controllers in each input: the first acts far from"
        " the setpoint, the second near it."
    ),
}
"""{picture: what it shows}."""

WORST = 12
"""Limits that are listed where there are many: the tightest ones."""


def page_of(case, values, drawn, command=None, provenance=None):
    """Return the page of a run: whether the limits hold, the live page, pictures, measures."""
    rows = _limits(case, values)
    broken = [words for words, margin in rows if not margin >= 0.0]
    status = "no limits"
    if rows:
        status = "; ".join(broken) if broken else "every limit holds"
    return html.document(
        case.name,
        case.title,
        status,
        not broken,
        _facts(case, values),
        [words for words, _ in rows],
        html.drawings(drawn, CAPTIONS),
        [tables.measure_table(values, case.loop.units), *tables.undefined(values)],
        command,
        provenance,
        live=panel(case),
    )


def _limits(case, values):
    """[(sentence, margin)] of the limits that the measures show."""
    found = []
    for limit in resolve_limits(case):
        if limit.measure not in values:
            continue
        unit = ms.unit(limit.measure, case.loop.units)
        entries = np.ravel(values[limit.measure])
        value = float(entries[limit.index if len(entries) > 1 else 0])
        margin = limit.sign * (float(limit.value) - value)
        side = "holds" if margin >= 0.0 else "is passed"
        most = f"{tables.number(float(limit.value))} {unit}"
        words = f"{limit.label}: {tables.number(value)} {unit}, the limit of {most} {side}"
        found.append((words, margin))
    if len(found) > tables.MANY:  # the tightest ones
        found = sorted(found, key=lambda one: -np.inf if np.isnan(one[1]) else one[1])
        found, rest = found[:WORST], found[WORST:]
        passed = sum(not margin >= 0.0 for _, margin in rest)
        words = f"{len(rest)} further limits have larger margins"
        words += f", and {passed} of them are passed" if passed else ""
        found.append((words, rest[0][1]))
    return found


def _facts(case, values):
    """(what, value) of the objective's measures and the clock."""
    found = []
    for name in case.objective:
        if name in values:
            unit = ms.unit(name, case.loop.units)
            found.append((name, f"{tables.entries(name, values[name])} {unit}".strip()))
    return [
        *found,
        ("length", f"{case.clock.duration:g} s"),
        ("sampled every", f"{case.clock.dt:g} s"),
    ]

"""The result of an attack as text and JSON; imported by `falsification_page`."""

import shlex

import numpy as np

from jaxtank.core.tree import describe, get_value
from jaxtank.core.units import local
from jaxtank.safety.checker import OWN
from tuning.problem import provenance
from tuning.problem.wording import count, numbered
from tuning.report import tables
from tuning.report.safety import start_of

BOUND = (
    "What an attack finds is a lower bound of the worst: a limit that is not passed here may be"
    " passed by a plant that was not tried, unless it is proved (jaxtank show)."
)


def json_of(attack):
    """The JSON object of `jaxtank attack --json`."""
    case, attacked = attack.case, attack.attacked
    return {
        "case": case.name,
        "passed": bool(attack.passed),
        "worst": [_row(attack, one) for one in attack.found],
        "unit": case.loop.units[0],
        "safety_filter": case.loop.safety_filter is not None,
        "coefficients": {
            c.name: {"nominal": c.nominal, "low": c.low, "high": c.high, "varies": c.varies}
            for c in attacked.coefficients
        },
        "windows": attacked.windows,
        "reading_band": tables.clean(attacked.band),
        "pumps": attacked.pumps,
        "start": attacked.start,
        "starts": attack.starts,
        "draws": attack.draws,
        "history": tables.clean(attack.history),
        "remarks": remarks_of(attack),
        "wall_s": attack.wall_s,
        "provenance": provenance.provenance(case, attack.seed),
    }


def _row(attack, one):
    """The JSON object of one tank."""
    return tables.clean(
        {
            "tank": one.tank + 1,
            "level": one.level,
            "limit": one.limit,
            "time_s": one.time_s,
            "parameters": attack.parameters(one),
            "margin": one.margin,
            "passed": one.passed,
            "certified": one.certified,
            "why": one.reason or None,
            "starts": one.starts or None,
            "nominal": one.nominal,
            "drawn": one.drawn,
            "rise_between_samples": one.rise,
        }
    )


def remarks_of(attack):
    """Return sentences that the figures need."""
    unit = attack.case.loop.units[0]
    found, rises = [], [one.rise for one in attack.found if np.isfinite(one.rise)]
    if rises:
        found.append(
            f"Levels are those at the samples; between two samples a level can rise by at most"
            f" {max(rises):.3g} {unit} (b_max u_max dt, and what flows in from other tanks)."
        )
    if attack.attacked.physical_rims:
        found.append(
            "The rims of this rig are physics: no level passes them, and the rest overflows. The"
            " attack is on the same rig without overflow, whose levels show what would overflow."
        )
    if beyond := [one.tank + 1 for one in attack.found if _starts_elsewhere(attack, one)]:
        found.append(
            f"Proved {start_of([OWN])} only: {numbered('tank', beyond)}. This attack starts"
            " anywhere below the limits; --start own keeps to the case's start."
        )
    if outside := _outside(attack):
        found.append(
            f"The intervals of {', '.join(outside)} are wider than those that the safety filter"
            " was designed for: nothing is proved there."
        )
    guard = attack.case.loop.safety_filter
    if guard is not None and np.any(attack.attacked.band > np.asarray(guard.band) * (1.0 + 1e-12)):
        bands = (attack.attacked.band, np.asarray(guard.band))
        wide, band = (", ".join(f"{v:.3g}" for v in values) for values in bands)
        found.append(
            f"Readings may be off by ({wide}) {unit}, more than the band ({band}) {unit} of the"
            " safety filter: nothing is proved of such readings."
        )
    return [*found, BOUND]


def _starts_elsewhere(attack, one):
    """Whether a limit is proved from the case's start only, and the attack has others."""
    return one.starts == OWN and attack.attacked.start == "any"


def _outside(attack):
    """Names of coefficients of the plant whose interval reaches beyond the filter's box."""
    guard = attack.case.loop.safety_filter
    if guard is None:
        return []
    found = []
    for c in attack.attacked.coefficients:
        if c.name.startswith("plant."):
            name = c.name.removeprefix("plant.")
            least, most = (float(get_value(p, name)) for p in (guard.least, guard.most))
            slack = 1e-12 * abs(c.nominal)
            if c.low < least - slack or c.high > most + slack:
                found.append(c.name)
    return found


def lines(attack):
    """Return what is printed of an Attack: lines and Tables."""
    worst = attack.worst
    found = [
        f"{attack.case.name}: attack from {count(attack.draws, 'draw')}, ascent of"
        f" {count(attack.starts, 'start')} for each tank in {len(attack.history) - 1} steps (seed"
        f" {attack.seed}), {attack.wall_s:.1f} s",
        *_scope(attack),
        "",
        _table(attack),
        "",
        verdict(attack),
        "",
        f"The run that brings tank {worst.tank + 1} highest by its limit:",
        _parameters(attack, worst),
        "",
        f"as options: {settings(attack, worst)}",
    ]
    if attack.case.loop.safety_filter is not None:
        found.append(
            "(--set also moves the intervals that the safety filter is designed for; worst.toml of"
            " --out keeps them, as faults of the nominal plant)"
        )
    return [*found, "", *(f"- {line}" for line in remarks_of(attack))]


def _scope(attack):
    """Lines on what the attack may change."""
    attacked, loop = attack.attacked, attack.case.loop
    clock, varying = attack.case.clock, attacked.shapes["varying"][0]
    words = [f"{count(len(attacked.coefficients), 'coefficient')} in their intervals"]
    if attacked.windows > 1 and varying:
        words.append(
            f"{varying} of them with a value of its own in each of {attacked.windows} windows of"
            f" {(clock.duration + clock.dt) / attacked.windows:.4g} s"
        )
    kept = "any start up to the limits"
    if loop.safety_filter is not None:
        kept = "any start from which the filter can keep the limits"
    words.append(kept if attacked.start == "any" else "the case's start")
    if "bias" in attacked.shapes:
        band = ", ".join(f"{b:.3g}" for b in attacked.band)
        kind = "at each sample" if "noise" in attacked.shapes else "constant"
        words.append(f"reading errors ({kind}) within +-({band}) {loop.units[0]}")
    pumps = {
        "own": "the case's controller",
        "full": "pumps at full command",
        "random": "pumps that switch",
    }[attacked.pumps]
    guard = "with the safety filter" if loop.safety_filter is not None else "no safety filter"
    return [f"over: {', '.join(words)}", f"commands: {pumps}, {guard}"]


def _table(attack):
    """The levels of each tank."""
    unit = attack.case.loop.units[0]
    rows = [
        [
            one.tank + 1,
            tables.number(one.limit, 6),
            {None: "-", True: "yes", False: "no"}[one.certified],
            *(tables.number(v, 6) for v in (one.nominal, one.drawn, one.level)),
            f"{one.margin:.3g}",
            tables.number(one.time_s),
            "passed" if one.passed else "holds",
        ]
        for one in attack.found
    ]
    heads = ["tank", f"limit [{unit}]", "proved", f"nominal [{unit}]", f"draws [{unit}]"]
    heads += [f"highest [{unit}]", f"margin [{unit}]", "at [s]", ""]
    return tables.table(rows, heads)


def verdict(attack):
    """Return one sentence on the limits."""
    unit = attack.case.loop.units[0]
    if not attack.passed:
        return "No limit was passed."
    words = ", ".join(
        f"tank {one.tank + 1} by {-one.margin:.3g} {unit}"
        + (f" ({one.reason})" if one.certified is False else "")
        + (f" (proved {start_of([OWN])} only)" if _starts_elsewhere(attack, one) else "")
        for one in attack.passed
    )
    return f"Limits are passed: {words}."


def _parameters(attack, one):
    """The Table of the coefficients, start and mean reading errors of one run."""
    attacked, loop, rows = attack.attacked, attack.case.loop, []
    known = {c.name: c for c in attacked.coefficients}
    for name, value in attack.parameters(one).items():
        values = value if isinstance(value, list) else [value]
        if name in known:
            c = known[name]
            own, ends = c.nominal, f"{c.low:.4g} : {c.high:.4g}"
            unit = describe(attacked.original.loop, name)["unit"]
        else:
            part, index = name.rstrip("]").split("[")
            band = attacked.band[int(index)]
            top = attacked.ceiling[int(index)]
            own = float(loop.x0[int(index)]) if part == "x0" else 0.0
            ends = f"0 : {top:.4g}" if part == "x0" else f"{-band:.4g} : {band:.4g}"
            ends = "-" if part == "x0" and attacked.start == "own" else ends
            unit = local("cm", loop.units)
        shown = "  ".join(tables.number(v) for v in values)
        rows.append([name, unit, tables.number(own), ends, shown])
    return tables.table(rows, ["", "unit", "nominal", "interval", "value (in each window)"])


def settings(attack, one):
    """Return the run of `one` as --set options, coefficients as in the window of its peak."""
    clock, windows = attack.case.clock, attack.attacked.windows
    at = min(int(one.time_s * windows / (clock.duration + clock.dt)), windows - 1)
    words = []
    for name, value in attack.parameters(one).items():
        if not name.startswith("sensor."):
            number = value[at] if isinstance(value, list) else value
            words.append(shlex.quote(f"{name}={number:.6g}"))
    return " ".join(f"--set {word}" for word in words)

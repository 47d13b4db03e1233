"""Suggestions of a complete rig file, commented out: what could be set besides, each line of which
can be used as it stands.
"""

import numpy as np

from jaxtank.case import Free
from jaxtank.core.errors import InputError
from jaxtank.core.tree import describe, get_value, is_component, number, parameters, walk
from jaxtank.measures.catalogue import MEASURES, TIMES
from jaxtank.measures.catalogue import unit as measure_unit
from jaxtank.rig import components, signals
from jaxtank.rig import schedule as scheduling
from jaxtank.rig.schema import Key, Section, keys_of
from jaxtank.signals.base import Constant
from jaxtank.signals.setpoints import Ramps

RELATIVE = (
    'what is different in it, by name: numbers, or relative to the case "x1.3" (times), "by -0.5" '
    '(less), "0.02 if zero", and "steady" for x0, actuator.initial and reference.initial'
)


def absent(loop, name, meta):
    """A value for an optional leaf that is not in use: the least one that is allowed, in the shape
    of the leaf that it goes with.
    """
    *path, _ = name.split(".")
    owner = loop
    for step in path:
        owner = getattr(owner, step)
    shape = np.shape(getattr(owner, meta["like"]))
    low, high = meta["low"], meta["high"]
    value = (
        0.0
        if low is None or (low <= 0.0 and not meta["strict"])
        else 1.0
        if high is None or high >= 1.0
        else 0.5 * (low + high)
    )
    return np.full(shape, value).tolist()


def of_measure(case, name):
    """What a measure is, as metadata."""
    rim = '; "rim": that of each tank' if name == "max_level" else ""
    # where rims are physics no level passes one (tuning.objective)
    if rim and case.loop.plant.overflow:
        rim += ", which beside overflow = true is a limit on overflow_volume: nothing may be lost"
    return {
        "unit": measure_unit(name, case.loop.units),
        "doc": f"{MEASURES[name].doc}{_each(name)}{rim}",
    }


def of_free(case, name):
    """What a parameter is that is free, as metadata."""
    meta = describe(case.loop, name)
    return {**meta, "doc": f"[low, high, scale] of: {meta['doc']}"}


def _each(name):
    per = MEASURES[name].per
    return "" if per == "run" else f", of each {per}"


def _measures(case, but):
    """Names of the measures that a run of the case has, without those in `but`."""
    known = {m: spec for m, spec in MEASURES.items() if m not in but and m not in TIMES.values()}
    poured, stepped = (
        case.loop.disturbance is not None and case.loop.disturbance.onset is not None,
        case.loop.reference.changes is not None,
    )
    return [
        m
        for m, spec in known.items()
        if (poured or not spec.pours) and (stepped or not spec.windows)
    ]


def limits(case):
    """Keys of the measures that are not limited."""
    return [Key(m, 1.0, of_measure(case, m), False) for m in _measures(case, case.limits)]


def objective(case):
    """Keys of the measures that are not in the objective."""
    return [Key(m, 1.0, of_measure(case, m), False) for m in _measures(case, case.objective)]


def free(case):
    """Keys of the parameters of law and observer that could be free, over a decade each way."""
    found = []
    for name, value, meta in walk(case.loop):
        part, _, rest = name.partition(".")
        taken = any(n.split("[")[0] == name for n in case.free)
        if (
            part not in ("controller", "observer")
            or "model." in rest
            or value is None
            or taken
            or meta.get("rows")
        ):
            continue
        span = _around(np.asarray(value, dtype=float), meta)
        if span is not None and name != "controller.knots":
            found.append(Key(f'"{name}"', list(span), of_free(case, name), False))
    return found


def _around(value, meta):
    """Free of a tenth to ten times a value within its range, or either side of 0 where it is not
    positive; None where there is no room.
    """
    if value.size == 0:
        return None
    low, high = (
        (0.1 * value.min(), 10.0 * value.max())
        if value.min() > 0
        else (-1.0 - 2 * np.abs(value).max(), 1.0 + 2 * np.abs(value).max())
    )
    low = low if meta["low"] is None else max(low, meta["low"])
    high = high if meta["high"] is None else min(high, meta["high"])
    low, high = float(f"{low:.3g}"), float(f"{high:.3g}")
    return Free(low, high, "log" if low > 0 else "linear") if low < high else None


def of_uncertain(case, name):
    """What a share of a parameter is, as metadata."""
    return {
        "unit": "-",
        "doc": f"share, of: {describe(case.loop, name)['doc']}",
        "low": 0.0,
        "high": 1.0,
        "strict": True,
    }


def uncertain(case):
    """Keys of the plant's parameters whose spread is not given."""
    found = []
    for name, value in parameters(case.loop).items():
        taken = any(n.split("[")[0] == name for n in case.uncertain)
        if (
            name.startswith("plant.")
            and np.size(value)
            and np.any(np.asarray(value) != 0)
            and not taken
        ):
            found.append(Key(f'"{name}"', 0.05, of_uncertain(case, name), False))
    return found


def sections(case, have):
    """Tables that a case does not have, as they could be; have: titles and top-level keys that its
    file has already.
    """
    loop, units = case.loop, case.loop.units
    seconds = lambda share: float(f"{share * case.clock.duration:.3g}")
    found = []

    def add(title, rows, *prose, local_units=True):
        if title in have or (title.startswith("[[") and title.strip("[]") in have):
            return
        found.append(Section(title, keys_of(rows, units) if local_units else rows, prose, False))

    if not scheduling.table_of(loop):
        own = (
            components.keys_of(loop.controller, components.LAWS)
            if components.kind_of(loop.controller, components.LAWS)
            else []
        )
        if own and is_component(getattr(loop.controller, "model", None)):
            add(
                "[law]",
                [row for row in own if row[2] is not None],
                f"Another law than the preset's: {', '.join(components.LAWS)}. [values] above then"
                " has that law's names.",
            )
        table = schedule(case)
        if table:
            docs = (
                ("gains", "gains that follow the variable"),
                ("variable", "a setpoint, r1 .., or a level, h1 .."),
                ("knots", f"its values [{units[0]}] at which the gains are given"),
            )
            add(
                "[schedule]",
                [(k, {"unit": "-", "doc": doc}, table[k]) for k, doc in docs],
                "Gains that follow a setpoint or a level, linear between knots; they start from the"
                ' value above. Theirs are then "controller.values", a row per gain; [free] may name'
                " the gain for all its knots.",
            )
    add(
        "[observer]",
        _observer(loop),
        f"Another observer than the preset's: {', '.join(components.OBSERVERS)}.",
    )
    if (
        signals.steps(loop.reference) is loop.reference
        and isinstance(loop.reference, Ramps)
        and not _refers(case)
    ):
        start = signals.Sine(
            amplitude=number(0.0),
            offset=number(0.0),
            period=seconds(0.1),
            zero=0.0,
            start=0.0,
            end=seconds(1),
            channel=0,
            width=1,
        )
        add(
            "[reference.sine]",
            signals.sine_keys(start),
            "A sine on top of the ramps of one output, for a while; names are then"
            " reference.first.ramp and so on.",
        )
    if loop.disturbance is None:
        flows = [0.0] * loop.plant.tanks
        add(
            "[disturbance]",
            [("inflow", signals.INFLOW, flows)],
            "A steady inflow, or volumes that are poured: one of the two.",
        )
    if not isinstance(loop.disturbance, Constant) or not np.any(np.asarray(loop.disturbance.level)):
        some = float(
            f"{0.01 * float(np.asarray(loop.plant.area)[0] * np.asarray(loop.plant.rim)[0]):.3g}"
        )
        add(
            "[[pour]]",
            signals.pour_keys(seconds(0.5), seconds(0.01), 1, some),
            "A volume poured into a tank, for recovery_time; as many as you like.",
        )
    add(
        "[[fault]]",
        signals.fault_keys("pump_gain[0]", seconds(0.5), seconds(0.7), 0.6, 0.0),
        "What breaks while the rig runs, untold to the law; as many as you like.",
    )
    if not case.covariance:
        name = next(
            (
                n
                for n in case.uncertain
                if np.size(get_value(loop, n)) and np.ravel(get_value(loop, n))[0] != 0
            ),
            "plant.pump_gain",
        )
        value = np.ravel(np.asarray(get_value(loop, name)))[0]
        scalar = "[" in name or np.ndim(get_value(loop, name)) == 0
        rows = [
            (
                "names",
                {"unit": "-", "doc": "parameters, an array's entry by name[i]"},
                [name if scalar else f"{name}[0]"],
            ),
            (
                "matrix",
                {"unit": "-", "doc": "their covariance, in their units"},
                [[float(f"{(0.05 * value) ** 2:.3g}")]],
            ),
        ]
        add(
            "[covariance]",
            rows,
            "Parameters that vary together, as `jaxtank identify` writes them; used in the place of"
            " [uncertain].",
        )
    rows = [
        ("name", {"unit": "-", "doc": "what reports call it"}, "noisy"),
        ("seed", {"unit": "-", "doc": "of its sensor noise"}, 1),
        (
            "weight",
            {"unit": "-", "doc": "in the mean over scenarios", "low": 0.0, "strict": True},
            1.0,
        ),
        ("values", {"unit": "-", "doc": RELATIVE}, {"sensor.noise": 0.0}),
    ]
    add(
        "[[scenario]]",
        rows,
        "A run that `tune` judges by, in the place of the case's own; as many as you like.",
    )
    if not case.log:
        slots = [("t", ["time", "s"])]
        slots += [(f"pump{j + 1}", [f"u{j + 1}", units[1]]) for j in range(loop.plant.pumps)]
        slots += [(f"h{i + 1}", [f"level {i + 1}", units[0]]) for i in range(loop.plant.tanks)]
        rows = [Key(slot, value) for slot, value in slots]
        prose = (
            "Which column of a log is what, for jaxtank identify, where its header does not say so:"
            " [header, unit]."
        )
        add("[log]", rows, prose, local_units=False)
    return found


def _refers(case):
    """Whether a scenario names the reference, whose names change where a sine is added."""
    return any(name.startswith("reference.") for s in case.scenarios for name in s.values)


def _observer(loop):
    """Rows of an [observer]: the loop's own, or an extended Kalman filter where it has none."""
    if components.kind_of(loop.observer, components.OBSERVERS) not in (None, "direct"):
        return [
            row
            for row in components.keys_of(loop.observer, components.OBSERVERS)
            if row[2] is not None
        ]
    rim = float(np.asarray(loop.plant.rim)[0])
    meta = lambda field: {**signals.meta_of(components.OBSERVERS["extended-kalman"], field)}
    small = lambda share: float(f"{(share * rim) ** 2:.3g}")
    return [
        (
            "kind",
            {"unit": "-", "doc": f"one of {', '.join(components.OBSERVERS)}"},
            "extended-kalman",
        ),
        ("process", meta("process"), small(1e-3)),
        ("measurement", meta("measurement"), small(1e-3)),
        ("spread", meta("spread"), small(1e-2)),
        (
            "measured",
            {"unit": "-", "doc": "tanks whose levels are measured, from 1"},
            list(range(1, loop.plant.tanks + 1)),
        ),
    ]


def schedule(case):
    """A [schedule] table that the case's law allows, {} where it allows none: its first free gain
    along the first setpoint.
    """
    rim = float(_rim(case.loop))
    knots = [float(f"{share * rim:.3g}") for share in (0.25, 0.5, 0.75)]
    for name in case.free:
        if name.startswith("controller.") and "model" not in name:
            for variable in ("r1", "h1"):
                try:
                    found = scheduling.schedule(case, {name: variable}, knots)
                    found.loop.controller.check(found.loop.reference)
                except (InputError, LookupError, TypeError, ValueError):
                    continue
                return {"gains": [name], "variable": variable, "knots": knots}
    return {}


def _rim(loop):
    """Height of the first controlled tank [cm]."""
    return np.asarray(loop.plant.rim)[loop.plant.outputs[0]]

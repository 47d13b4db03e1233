"""What a rig file says of a case, table by table and key by key: the one source of `dump` and of
the commented file of `init`.
"""

import tomllib

import numpy as np

from jaxtank.case import Free
from jaxtank.core.clock import CLOCK
from jaxtank.core.errors import InputError
from jaxtank.core.tree import walk
from jaxtank.rig import components, network, schedule, signals, template
from jaxtank.rig.preset_match import origin_of, structures
from jaxtank.rig.read import start_of
from jaxtank.rig.schema import BARE, Key, Section, keys_of, lines_of, toml
from jaxtank.rig.validate import unreachable
from jaxtank.rig.values import MODELS
from jaxtank.signals.base import Sum
from jaxtank.signals.setpoints import Ramps

# leaves and statics that the tables of a rig described tank by tank set
TANKWISE = {"x0", "sensor.noise", "actuator.low", "actuator.high", "actuator.initial"}


def sections(case, tankwise=False):
    """The Sections of a case, from the preset it came from, or tank by tank where there is none or
    `tankwise`.
    """
    origin, same = (None, ()) if tankwise else origin_of(case)
    try:
        built = _building(case, origin, same)
        base = start_of(
            tomllib.loads("\n".join(line for s in built if s.on for line in lines_of(s)))
        )
    except InputError as error:
        raise InputError(f"{case.name}: cannot be written as a rig file: {error}") from None
    if structures(schedule.unscheduled(case.loop)) != structures(base.loop):
        raise InputError(
            f"{case.name}: cannot be written as a rig file: its law or observer has another model"
            " than its rig"
        )
    top = [
        *built[0].keys,
        *_reachable(case, base),
        *(
            [Key("scenario", [], {**BARE, "doc": "none of the preset's runs"})]
            if base.scenarios and not case.scenarios
            else []
        ),
    ]
    found = [
        built[0]._replace(keys=top),
        *built[1:],
        *_schedule(case),
        *_values(case, base, origin is None, same),
        *_tuning(case),
    ]
    have = {f.title for f in found} - {"[[pour]]", "[[fault]]", "[[scenario]]"} | {
        k.name for k in top
    }
    if any(k.name == "sine" for f in found for k in f.keys):
        have.add("[reference.sine]")
    return [*found, *template.sections(case, have)]


def _reachable(case, base):
    """The key `reachable` where it is not as in `base`. A file whose plateaus have no steady state
    is only read with `false`, and a plant that was identified or tuned may have lost one: the file
    then says false, and why.
    """
    why = unreachable(case) if case.reachable else None
    if why:
        return [Key("reachable", False, {**BARE, "doc": why})]
    return [Key("reachable", case.reachable, REACHABLE)] if case.reachable != base.reachable else []


def _building(case, origin, same):
    """The Sections that build a case before any value is set."""
    loop, units = schedule.unscheduled(case.loop), case.loop.units
    start = None if origin is None else origin.loop
    name = Key("name", case.name, {**BARE, "doc": "what reports call it"})
    if origin is None:
        top = Section(
            "", [name, Key("units", list(units), {**BARE, "doc": "[length, pump input]"})]
        )
        found = [
            Section(
                t,
                [
                    *_named(kind, own),
                    *keys_of(
                        [(k, network.METAS[kind][k], v) for k, v in own.items() if k != "name"],
                        units,
                    ),
                ],
            )
            for t, kind, own in network.entries_of(loop, case.names)
        ]
    else:
        top = Section(
            "",
            [
                Key("case", origin.name, {**BARE, "doc": "the preset that this file starts from"}),
                name,
            ],
        )
        found = []
    for kind, known, part in (
        ("law", components.LAWS, loop.controller),
        ("observer", components.OBSERVERS, loop.observer),
        ("sensor", components.SENSORS, loop.sensor),
        ("actuator", components.ACTUATORS, loop.actuator),
    ):
        if kind not in same and components.has_table(kind, part):
            keys = keys_of(((n, m, v) for n, m, v in components.keys_of(part, known)), units)
            found.append(Section(f"[{kind}]", [k for k in keys if k.value is not None]))
    found += _reference(loop, start)
    disturbing = signals.disturbance_tables(loop.disturbance)
    if disturbing is None:
        raise InputError("its disturbance has no table")
    if origin is None and disturbing and disturbing[0][1][0][0] == "inflow":
        disturbing = []  # the tanks say it
    for title, rows in [*disturbing, *signals.fault_tables(loop.faults)]:
        found.append(Section(title, keys_of(rows, units)))
    dropped = [("pour", "disturbance"), ("fault", "faults")]
    none = [
        Key(k, [], {**BARE, "doc": "none"})
        for k, f in dropped
        if getattr(loop, f) is None and getattr(start, f, None) is not None
    ]
    return [top._replace(keys=[*top.keys, *none]), *found]


def _named(kind, own):
    """The key of a tank's or a pump's name; a suggestion where it has none."""
    if "name" not in own:
        return []
    name, number = own["name"]
    return [Key("name", name or f"{kind} {number}", network.METAS[kind]["name"], bool(name))]


def _reference(loop, start):
    reference, length = signals.steps(loop.reference), loop.units[0]
    if reference is None:
        if start is None:
            raise InputError("its reference has no table")
        return []
    keys = [
        Key(
            "initial",
            np.asarray(reference.initial).tolist(),
            {"unit": length, "doc": "setpoint of each output before the first change"},
        )
    ]
    keys += [
        Key(
            "changes",
            signals.changes_of(reference),
            {
                "unit": "-",
                "doc": f"[time [s], output (from 1), setpoint [{length}]] of each change",
            },
        )
    ]
    keys += [
        Key(k, getattr(reference, k), signals.meta_of(Ramps, k)) for k in ("ramp", "shape", "band")
    ]
    if isinstance(loop.reference, Sum):
        more = Section(
            "[reference.sine]", keys_of(signals.sine_keys(loop.reference.second), loop.units)
        )
        return [Section("[reference]", keys), more]
    if start is not None and isinstance(start.reference, Sum):
        keys.append(Key("sine", {}, {**BARE, "doc": "none"}))
    return [Section("[reference]", keys)]


def _schedule(case):
    table = schedule.table_of(case.loop)
    docs = {
        "gains": "gains that follow the variable",
        "variable": "a setpoint, r1 .., or a level, h1 ..",
        "knots": "where",
    }
    return (
        [Section("[schedule]", [Key(k, v, {**BARE, "doc": docs[k]}) for k, v in table.items()])]
        if table
        else []
    )


def _values(case, base, tankwise, same):
    """[values]: every leaf and static field that the tables before it have not set, a Section for
    each part of the loop.
    """
    loop, groups = case.loop, {}
    scheduled = bool(schedule.table_of(loop))
    fields = [*walk(base.loop), *walk(base.loop, kind="static")]
    known = {
        name: None if value is None else toml(np.asarray(value).tolist())
        for name, value, _ in fields
        if not isinstance(value, tuple)
    }
    plant = [*walk(loop.plant), *walk(loop.plant, kind="static")]
    plants = {n: toml(np.asarray(v).tolist()) for n, v, _ in plant if v is not None}
    described = (
        ("reference.", "disturbance.", "faults.")
        if signals.steps(loop.reference)
        else ("disturbance.", "faults.")
    )
    for name, value, meta in [*walk(loop), *walk(loop, kind="static")]:
        if (
            isinstance(value, tuple)
            or name.startswith(described)
            or (scheduled and name in ("controller.knots", "controller.variable"))
        ):
            continue
        if value is not None and np.size(value) == 0:
            continue  # of a rig without pipes, say: there is nothing to set
        part = name.partition(".")[0]
        built = {
            "controller": "law" not in same,
            "observer": "observer" not in same,
            "sensor": components.has_table("sensor", loop.sensor),
            "actuator": components.has_table("actuator", loop.actuator),
            "plant": tankwise,
        }.get(part, False)
        built = built or (tankwise and name in TANKWISE)
        value = None if value is None else np.asarray(value).tolist()
        follows = _followed(name, plants)
        if value is None:
            if not (scheduled and part == "controller"):
                groups.setdefault(part, []).append(
                    Key(toml(name), template.absent(loop, name, meta), meta, False)
                )
        elif follows is not None:  # by what the file has of the plant, unless it is written
            groups.setdefault(part, []).append(Key(toml(name), value, meta, follows != toml(value)))
        elif not built or known.get(name) != toml(value):
            groups.setdefault(part, []).append(Key(toml(name), value, meta))
    clock = [Key(toml(f"clock.{k}"), getattr(case.clock, k), meta) for k, meta in CLOCK.items()]
    return [
        Section("[values]", []),
        *(Section("", keys, (PARTS[part],)) for part, keys in groups.items()),
        Section("", clock, (PARTS["clock"],)),
    ]


def _followed(name, plants):
    """The plant's value, as in a file, that `name` of a model follows; None of another name."""
    for model in MODELS:
        if name.startswith(model):
            return plants.get(name.removeprefix(model))
    return None


def _tuning(case):
    """[limits] to [[scenario]]: what is tuned, by what, and what is uncertain."""
    plain = lambda v: np.asarray(v).tolist() if not isinstance(v, str) else v
    found = [
        Section(
            "[limits]",
            [
                *(Key(m, plain(v), template.of_measure(case, m)) for m, v in case.limits.items()),
                *template.limits(case),
            ],
        ),
        Section(
            "[free]",
            [
                *(
                    Key(toml(n), list(Free(*spec)), template.of_free(case, n))
                    for n, spec in case.free.items()
                ),
                *template.free(case),
            ],
        ),
        Section(
            "[objective]",
            [
                *(
                    Key(m, float(w), template.of_measure(case, m))
                    for m, w in case.objective.items()
                ),
                *template.objective(case),
            ],
        ),
        Section(
            "[uncertain]",
            [
                *(
                    Key(toml(n), float(v), template.of_uncertain(case, n))
                    for n, v in case.uncertain.items()
                ),
                *template.uncertain(case),
            ],
        ),
    ]
    if case.covariance is not None:
        names, rows = case.covariance
        found.append(
            Section(
                "[covariance]",
                [Key("names", list(names)), Key("matrix", [list(map(float, row)) for row in rows])],
            )
        )
    if case.log:
        found.append(
            Section(
                "[log]",
                [
                    Key(slot, spec if isinstance(spec, str) else list(spec))
                    for slot, spec in case.log.items()
                ],
            )
        )
    for s in case.scenarios:
        keys = [
            Key("name", s.name),
            Key("seed", s.seed),
            Key("weight", float(s.weight)),
            Key("values", dict(s.values)),
        ]
        found.append(Section("[[scenario]]", keys))
    return found


REACHABLE = {
    **BARE,
    "doc": "whether every plateau of the reference must have a steady state",
    "choices": (True, False),
}
PARTS = {
    "plant": "plant: the rig as it is",
    "sensor": "sensor: what the computer sees of the levels",
    "observer": "observer: estimated levels; observer.model.* follows plant.* unless it is set",
    "controller": (
        "controller; controller.model.* follows plant.* unless it is set, for a wrong model"
    ),
    "actuator": "actuator: the pumps",
    "reference": "reference",
    "x0": "start",
    "clock": "clock: when the law samples, and for how long",
}

"""The blocks of a rig file that describe a case: the one source of `dump`, `complete` and
`short`.
"""

import dataclasses
import tomllib

import numpy as np

from jaxtank.case import Free
from jaxtank.core.clock import CLOCK
from jaxtank.core.errors import InputError
from jaxtank.core.tree import walk
from jaxtank.measures import unreadable
from jaxtank.rig import components, network, schedule, signals, template
from jaxtank.rig.lines import Block, Line, block, lines_of, terse, toml
from jaxtank.rig.preset_match import origin_of, structures
from jaxtank.rig.read import start_of
from jaxtank.rig.schema import SECTIONS, targets
from jaxtank.rig.validation import unreachable
from jaxtank.rig.values import MODELS
from jaxtank.signals.base import Sum

PARTS = {
    "plant": "plant: the rig as it is",
    "sensor": "sensor: how levels are measured",
    "observer": (
        "observer: estimated levels; observer.model.* follows controller.model.*, else plant.*,"
        " unless it is set"
    ),
    "controller": (
        "controller; controller.model.* follows plant.* unless it is set, for a wrong model"
    ),
    "actuator": "actuator: the pumps",
    "reference": "reference",
    "x0": "levels at t = 0",
    "clock": "clock: sampling of the controller, and length of the run",
}
"""{part of the loop: sentence above its lines in [values]}."""


def sections(case, tankwise=False):
    """Return the Blocks of a case."""
    if case.loop.safety_filter is not None and case.safety is None:
        raise InputError(
            f"{case.name}: cannot be written as a rig file: its safety filter is not that of"
            " Case.with_safety_filter"
        )
    case = case.replace(loop=dataclasses.replace(case.loop, safety_filter=None))
    origin, same = (None, ()) if tankwise else origin_of(case)
    try:
        top, *built = _building(case, origin, same)
        text = "\n".join(line for b in (top, *built) for line in terse(b))
        base = start_of(tomllib.loads(text))
    except InputError as error:
        raise InputError(f"{case.name}: cannot be written as a rig file: {error}") from None
    if structures(schedule.unscheduled(case.loop)) != structures(base.loop):
        raise InputError(
            f"{case.name}: cannot be written as a rig file: its controller or observer has another"
            " model than its rig"
        )
    top.lines.extend(_reachable(case, base))
    if base.scenarios and not case.scenarios:
        top.lines.append(_none("scenario", "none of the preset's runs"))
    table = schedule.table_of(case.loop)
    found = [top, *built, *([block(SECTIONS["schedule"], table, case.loop.units)] if table else [])]
    found += [*_values(case, base, origin is None, same), *_tuning(case)]
    return [*found, *template.suggestions(case, _titles(found))]


def _titles(found):
    """The titles of the tables of these Blocks, and the names of the lines above the first."""
    titles = {b.title for b in found} | {line.name for line in found[0].lines}
    if any(line.name == "sine" for b in found for line in b.lines):
        titles.add("[reference.sine]")
    return titles


def _none(name, doc="none"):
    """The line of a list or table that a preset has and the case does not."""
    return Line(name, {} if name == "sine" else [], {"unit": "-", "doc": doc})


def _reachable(case, base):
    """The line `reachable` where it is not as in `base`."""
    why, section = unreachable(case) if case.reachable else None, SECTIONS[""]
    if why:
        return [Line("reachable", False, {"unit": "-", "doc": why})]
    values = {"reachable": case.reachable} if case.reachable != base.reachable else {}
    return lines_of(section, values)


def _building(case, origin, same):
    """The Blocks that build a case before any value is set."""
    loop, units = schedule.unscheduled(case.loop), case.loop.units
    start = None if origin is None else origin.loop
    if origin is None:
        top = {"name": case.name, "units": units}
        entries = network.entries_of(loop, case.names)
        found = [_of_rig(section, own, i, units) for section, i, own in entries]
    else:
        top, found = {"case": origin.name, "name": case.name}, []
    for name, role in components.ROLES.items():
        part = getattr(loop, role.field)
        if name not in same and components.has_section(name, part):
            found.append(block(*components.values_of(name, part), units))
    found += _reference(loop, start)
    disturbing = signals.disturbance_tables(loop.disturbance)
    if disturbing is None:
        raise InputError("its disturbance has no table")
    if origin is None and disturbing and "inflow" in disturbing[0][1]:
        disturbing = []  # it is a key of the tanks
    tables = [*disturbing, *signals.fault_tables(loop.faults)]
    none = [
        _none(name)
        for name, field in (("inflow", "disturbance"), ("fault", "faults"))
        if getattr(loop, field) is None and getattr(start, field, None) is not None
    ]
    first = Block("", [*lines_of(SECTIONS[""], top, units), *none])
    return [first, *found, *(block(section, own, units) for section, own in tables)]


def _of_rig(section, own, number, units):
    """The Block of a table of a rig; a tank or a pump without a name has a suggestion of one."""
    found = block(section, own, units)
    if own.get("name") == "":
        text = f"{section.name} {number}"
        found.lines[0] = found.lines[0]._replace(value=text, on=False)
    return found


def _reference(loop, start):
    """The Blocks of a reference; none of one that only a preset has."""
    reference, units = signals.steps(loop.reference), loop.units
    if reference is None:
        if start is None:
            raise InputError("its reference has no table")
        return []
    found = block(SECTIONS["reference"], signals.ramp_values(reference), units)
    if reference.filter is None:
        key = next(k for k in SECTIONS["reference"].keys if k.name == "filter")
        none = [0.0] * reference.channels
        found.lines.append(Line(key.name, none, key.meta(units), False))
    if isinstance(loop.reference, Sum):
        values = signals.sine_values(loop.reference.second)
        return [found, block(SECTIONS["reference.sine"], values, units)]
    if start is not None and isinstance(start.reference, Sum):
        found.lines.append(_none("sine"))
    return [found]


def _values(case, base, tankwise, same):
    """The Blocks of [values]: every leaf and static field that no table before it has set."""
    groups = {}
    for name, value, meta in _settable(case):
        part = name.partition(".")[0]
        line = _line(case, name, value, meta, _is_built(case, name, tankwise, same), base)
        if line is not None:
            groups.setdefault(part, []).append(line)
    groups["clock"] = [
        Line(toml(f"clock.{name}"), getattr(case.clock, name), meta) for name, meta in CLOCK.items()
    ]
    parts = [Block("", lines, (PARTS[part],)) for part, lines in groups.items()]
    return [Block("[values]", []), *parts]


def _settable(case):
    """[(name, value as in a file, metadata)] of what [values] may have."""
    loop = case.loop
    tables = ("disturbance.", "faults.", *(["reference."] if signals.steps(loop.reference) else []))
    # [schedule] has them
    scheduled = ("controller.knots", "controller.variable") if schedule.table_of(loop) else ()
    for name, value, meta in [*walk(loop), *walk(loop, kind="static")]:
        # a tuple is the topology of the rig; an array of a rig without pipes, say, is empty
        empty = isinstance(value, tuple) or (value is not None and np.size(value) == 0)
        if not empty and not name.startswith(tables) and name not in scheduled:
            yield name, None if value is None else np.asarray(value).tolist(), meta


def _is_built(case, name, tankwise, same):
    """Whether the tables that build a case set the field `name` of its loop."""
    part = name.partition(".")[0]
    built = tankwise and (part == "plant" or name in targets(*network.LISTS))
    return built or any(
        part == role.field and section not in same and components.has_section(section, own)
        for section, role in components.ROLES.items()
        for own in (getattr(case.loop, role.field),)
    )


def _line(case, name, value, meta, built, base):
    """The Line of a field in [values], None where another table has set it already."""
    if value is None:
        if name.startswith("controller.") and schedule.table_of(case.loop):
            return None
        return Line(toml(name), template.absent(case.loop, name, meta), meta, False)
    follows = _followed(case.loop, name)
    if follows is not None:  # that value in the file, unless it is written
        return Line(toml(name), value, meta, follows != toml(value))
    if built and _text_of(base.loop, name) == toml(value):
        return None
    return Line(toml(name), value, meta)


def _text_of(tree, name):
    """The value of the field `name` as a file has it, None where there is none."""
    for step in name.split("."):
        tree = getattr(tree, step, None)
    return None if tree is None else toml(np.asarray(tree).tolist())


def _followed(loop, name):
    """The text of the value that `name` of a model follows; None of another name."""
    for model in MODELS:
        if name.startswith(model):
            inner = name.removeprefix(model)
            owners = ("plant.",) if model != MODELS[-1] else (*MODELS[:-1], "plant.")
            texts = (_text_of(loop, owner + inner) for owner in owners)
            return next((text for text in texts if text is not None), None)
    return None


def _tuning(case):
    """[limits] to [[scenario]]: what is tuned, by what, and what is uncertain."""
    plain = lambda value: value if isinstance(value, str) else np.asarray(value).tolist()
    tables = (
        ("limits", case.limits, plain, template.of_measure, str, template.limits),
        ("free", case.free, lambda spec: list(Free(*spec)), template.of_free, toml, template.free),
        ("objective", case.objective, float, template.of_measure, str, template.objective),
        ("uncertain", case.uncertain, float, template.of_uncertain, toml, template.uncertain),
    )
    found = []
    for title, own, text, about, key, more in tables:
        # functions of Python stay behind, commented out
        off = unreadable(own) if title in ("limits", "objective") else ()
        lines = [
            Line(key(name), text(value), about(case, name), name not in off)
            for name, value in own.items()
        ]
        on = title != "objective" or any(line.on for line in lines)
        found.append(Block(SECTIONS[title].title, [*lines, *more(case)], on=on))
    if case.covariance is not None:
        names, rows = case.covariance
        values = {"names": names, "matrix": [list(map(float, row)) for row in rows]}
        found.append(block(SECTIONS["covariance"], values))
    if case.safety is not None:
        found.append(block(SECTIONS["safety_filter"], dict(case.safety), case.loop.units))
    if case.log:
        bare = {"unit": "-", "doc": ""}
        columns = [Line(slot, plain(spec), bare) for slot, spec in case.log.items()]
        found.append(Block(SECTIONS["log"].title, columns))
    return found + [block(SECTIONS["scenario"], s._asdict()) for s in case.scenarios]

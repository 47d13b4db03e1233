"""From a Case to a rig file: `dump`, `complete` with every key, `short` beside a preset."""

import dataclasses
import textwrap
import tomllib
from pathlib import Path

import jax
import numpy as np

from jaxtank import presets
from jaxtank.case import Case, Free
from jaxtank.core.clock import CLOCK
from jaxtank.core.errors import InputError
from jaxtank.core.files import write_atomic
from jaxtank.core.tree import is_component, walk
from jaxtank.measures import unreadable
from jaxtank.rig import components, network, signals, template
from jaxtank.rig.entry import Block, Line, allowed, block_of, lines_of, terse, toml, unit
from jaxtank.rig.read import start_of
from jaxtank.rig.schema import SECTIONS, targets
from jaxtank.rig.validation import unreachable
from jaxtank.rig.values import MODELS, schedule_table, unscheduled
from jaxtank.signals.base import Sum


def origin_of(case):
    """Return the preset that a case came from."""
    if case.names:
        return None, ()
    loop = unscheduled(case.loop)
    mine, statics = structures(loop), _statics(loop)
    best, found = None, (None, ())
    for paper in presets.PAPERS:
        for other in presets.load(paper).cases.values():
            same = _same_parts(loop, mine, other.loop)
            if same is None:
                continue
            common = sum(a == b for a, b in zip(statics, _statics(other.loop)))
            score = ("controller" in same, "observer" in same, other.name == case.name, common)
            if best is None or score > best:
                best, found = score, (other, same)
    return found


def _same_parts(loop, mine, other):
    """Sections in which `other` is like `loop`; None where no file makes one of the other."""
    theirs = structures(other)
    if mine["rest"] != theirs["rest"] or not _has_optional(other, "plant", loop):
        return None
    same = tuple(
        name
        for name, role in components.ROLES.items()
        if mine[role.field] == theirs[role.field] and _has_optional(other, role.field, loop)
    )
    for name, role in components.ROLES.items():
        if name not in same and not components.is_written(name, getattr(loop, role.field)):
            return None
    return same


def _has_optional(other, field, loop):
    """Whether the optional leaves that a part of `other` uses are in use in `loop`."""
    return {name for name in _optional(other) if name.startswith(f"{field}.")} <= _optional(loop)


def _statics(loop):
    return [value for _, value, _ in walk(loop, kind="static")] + [
        np.asarray(getattr(loop.plant, "area", ())).tolist()
    ]


def _optional(loop):
    """Names of the optional leaves that are in use."""
    return {name for name, value, meta in walk(loop) if meta.get("like") and value is not None}


def structures(loop):
    """Return pytree structures of the parts of a loop, with what a rig file can set made alike."""

    def settle(tree):
        changed = {}
        for field in dataclasses.fields(tree):
            value = getattr(tree, field.name)
            if is_component(value):
                changed[field.name] = settle(value)
            elif field.metadata.get("kind") == "static" and not isinstance(value, tuple):
                changed[field.name] = type(value)()
            elif field.metadata.get("like"):
                changed[field.name] = None
        return dataclasses.replace(tree, **changed)

    described = {"faults": None}
    if signals.steps(loop.reference) is not None:
        described["reference"] = None
    if signals.disturbance_tables(loop.disturbance) is not None:
        described["disturbance"] = None
    plain = settle(dataclasses.replace(loop, **described))
    fields = [role.field for role in components.ROLES.values()]
    rest = dataclasses.replace(plain, **dict.fromkeys(fields))
    parts = {field: jax.tree.structure(getattr(plain, field)) for field in fields}
    return {"rest": jax.tree.structure(rest), **parts}


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
    if structures(unscheduled(case.loop)) != structures(base.loop):
        raise InputError(
            f"{case.name}: cannot be written as a rig file: its controller or observer has another"
            " model than its rig"
        )
    top.lines.extend(_reachable(case, base))
    if base.scenarios and not case.scenarios:
        top.lines.append(_none("scenario", "none of the preset's runs"))
    table = schedule_table(case.loop)
    found = [
        top,
        *built,
        *([block_of(SECTIONS["schedule"], table, case.loop.units)] if table else []),
    ]
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
    loop, units = unscheduled(case.loop), case.loop.units
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
            found.append(block_of(*components.values_of(name, part), units))
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
    return [first, *found, *(block_of(section, own, units) for section, own in tables)]


def _of_rig(section, own, number, units):
    """The Block of a table of a rig; a tank or a pump without a name has a suggestion of one."""
    found = block_of(section, own, units)
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
    found = block_of(SECTIONS["reference"], signals.ramp_values(reference), units)
    if reference.filter is None:
        key = next(k for k in SECTIONS["reference"].keys if k.name == "filter")
        none = [0.0] * reference.channels
        found.lines.append(Line(key.name, none, key.meta(units), False))
    if isinstance(loop.reference, Sum):
        values = signals.sine_values(loop.reference.second)
        return [found, block_of(SECTIONS["reference.sine"], values, units)]
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
    scheduled = ("controller.knots", "controller.variable") if schedule_table(loop) else ()
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
        if name.startswith("controller.") and schedule_table(case.loop):
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
        found.append(block_of(SECTIONS["covariance"], values))
    if case.safety is not None:
        found.append(block_of(SECTIONS["safety_filter"], dict(case.safety), case.loop.units))
    if case.log:
        bare = {"unit": "-", "doc": ""}
        columns = [Line(slot, plain(spec), bare) for slot, spec in case.log.items()]
        found.append(Block(SECTIONS["log"].title, columns))
    return found + [block_of(SECTIONS["scenario"], s._asdict()) for s in case.scenarios]


WIDTH = 110
SHORT = ("[limits]", "[free]", "[objective]")
"""Tables that a short file has also where they are the preset's."""


def dump(case: Case, tankwise: bool = False) -> str:
    """Return the rig file of `case` as text: every leaf, every static field that a file may set,
    what is tuned and what is uncertain.

    Parameters
    ----------
    case : Case
    tankwise : whether to describe it tank by tank even where a preset has the same rig

    Returns
    -------
    The text, TOML.

    Raises
    ------
    InputError for a case that no file can describe.

    Examples
    --------
    >>> from jaxtank import presets, rig
    >>> print(rig.dump(presets.find("cascaded/pi"))[:20])
    case = "cascaded/pi"
    """
    return _text([terse(block) for block in sections(case, tankwise) if block.on])


def save(case: Case, path: str | Path) -> None:
    """Write `dump(case)` to a file, whole or not at all.

    Parameters
    ----------
    case : Case
    path : of the file, which is replaced

    Raises
    ------
    InputError for a case that no file can describe; OSError where nothing can be written.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> from jaxtank import presets, rig
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     rig.save(presets.find("cascaded/pi"), pathlib.Path(folder, "rig.toml"))
    ...     rig.load(pathlib.Path(folder, "rig.toml")).name
    'cascaded/pi'
    """
    write_atomic(Path(path), dump(case))


def complete(case: Case, tankwise: bool = False) -> str:
    """Return `dump` with every other key that can be set, and every table that could be there,
    commented out; each key below its unit, range and meaning.

    A line that begins with "#" and no space is one that may be used as it stands; those of a table
    go together.

    Parameters
    ----------
    case : Case
    tankwise : whether to describe it tank by tank even where a preset has the same rig

    Returns
    -------
    The text, TOML.

    Raises
    ------
    InputError for a case that no file can describe.

    Examples
    --------
    >>> from jaxtank import presets, rig
    >>> "#[[fault]]" in rig.complete(presets.find("cascaded/pi"))
    True
    """
    return _text([HEAD.splitlines()] + [_commented(block) for block in sections(case, tankwise)])


def short(case: Case) -> str:
    """Return what differs from the preset that `case` came from, and what is tuned; `complete`
    where there is no preset.

    Parameters
    ----------
    case : Case

    Returns
    -------
    The text, TOML.

    Raises
    ------
    InputError for a case that no file can describe.

    Examples
    --------
    >>> from jaxtank import presets, rig
    >>> "reference.sine" in rig.short(presets.find("cascaded/pi"))
    False
    """
    origin, _ = origin_of(case)
    if origin is None:
        return complete(case)
    theirs, mine = sections(presets.find(origin.name)), sections(case)
    head = f"# {origin.title}; `jaxtank init {origin.name}` without --short prints every key"
    kept = _kept(mine, theirs, _tuned(case))
    return _text([[head], *(_commented(block._replace(prose=())) for block in kept)])


def _tuned(case):
    """Names of [values] that a short file has as suggestions: what is free, clock and noise."""
    free = {name.split("[")[0] for name in case.free}
    return free | {"clock.dt", "clock.duration", "sensor.noise"}


def _kept(mine, theirs, suggested):
    """The Blocks of a file that differ from its preset's, or that SHORT or `suggested` names."""
    known = {line for block in theirs for line in terse(block)}
    same, in_values, kept = _same_tables(mine, theirs), False, []
    for block in mine:
        in_values = block.title == "[values]" or (in_values and not block.title)
        if in_values:
            found = (_differing(line, known, suggested) for line in block.lines)
            lines = sorted(filter(None, found), key=lambda line: not line.on)
        elif block.on and (block.title in ("", *SHORT) or block.title not in same):
            lines = [line for line in block.lines if line.on]
        else:
            continue
        if lines or block.title:
            kept.append(block._replace(lines=lines))
    return kept


def _differing(line, known, suggested):
    """A line of [values] that the preset lacks, commented out if it is suggested; else None."""
    if not line.on:
        return None
    if not set(terse(Block("", [line]))) <= known:
        return line
    return line._replace(on=False) if line.name.strip('"') in suggested else None


def _same_tables(mine, theirs):
    """Titles of the tables that two files have alike, those of a list in the same number."""
    tables = [{}, {}]
    for found, blocks in zip(tables, (mine, theirs)):
        for block in blocks:
            if block.on:
                found.setdefault(block.title, []).append(terse(block))
    return {title for title, lines in tables[0].items() if tables[1].get(title) == lines}


def _text(blocks):
    """Blocks of lines as text, an empty line before each one that begins a table."""
    lines = []
    for block in blocks:
        first = next((line for line in block if not line.startswith("# ")), "")
        starts = first.lstrip("#").startswith("[")
        lines += ["", *block] if lines and starts else block
    return "\n".join(lines) + "\n"


def _commented(block):
    """The lines of a Block, each key below what it is."""
    lines = [""] * bool(block.prose and not block.title)
    lines += [line for sentence in block.prose for line in _wrapped(sentence)]
    lines += [("" if block.on else "#") + block.title] * bool(block.title)
    for line in block.lines:
        lines += _wrapped(_about(line))
        lines.append(("" if block.on and line.on else "#") + f"{line.name} = {toml(line.value)}")
    return lines


def _about(line):
    """What a key is, its unit and its range."""
    own = f"{line.meta['doc']}{unit(line.meta)}"
    return ", ".join(filter(None, [own, allowed(line.meta, line.value)]))


def _wrapped(sentence):
    return textwrap.wrap(sentence, WIDTH, initial_indent="# ", subsequent_indent="# ")


HEAD = """\
# A complete rig file: delete what you do not change. Lines that begin with "#" and no space are
# suggestions: take the sign away to use one (those of a table together). Shapes: (n,) one per tank,
# (m,) one per pump, (outputs,) one per controlled tank, all in order from 1. Where a name ends in
# [i], as in "plant.drain[0]", entries are counted from 0. `jaxtank show CASE` is the manual."""

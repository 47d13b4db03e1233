"""From a Case to a rig file: `dump`, `complete` with every key, `short` beside a preset."""

import dataclasses
import textwrap
import tomllib
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxtank import presets
from jaxtank.case import Case, Free
from jaxtank.core.checks import allowed
from jaxtank.core.clock import CLOCK
from jaxtank.core.errors import InputError
from jaxtank.core.files import write_atomic
from jaxtank.core.labels import names_of
from jaxtank.core.tree import describe, get_value, is_component, parameters, walk
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.measures import MEASURES, of_loop, unit as measure_unit, unreadable
from jaxtank.plants.tank_network import TankNetwork
from jaxtank.rig import components, network, signals
from jaxtank.rig.entry import Block, Line, block_of, lines_of, terse, toml, unit
from jaxtank.rig.read import renamed, start_of
from jaxtank.rig.schema import LISTS, SECTIONS, SHARE, WEIGHT, Section, targets
from jaxtank.rig.validation import unreachable
from jaxtank.rig.values import MODELS, schedule, schedule_table, unscheduled
from jaxtank.signals.base import Sum
from jaxtank.signals.setpoints import Ramps


def origin_of(case):
    """Return the preset that a case was made from, None without one."""
    return None if case.names or not case.origin else presets.find(case.origin)


def structure(tree):
    """Return the pytree structure of a component, with what a rig file can set made alike."""

    def settle(tree):
        changes = {}
        for field in dataclasses.fields(tree):
            value = getattr(tree, field.name)
            if is_component(value):
                changes[field.name] = settle(value)
            elif field.name == "display":  # a file has levels in lengths
                changes["display"] = ()
            elif field.metadata.get("kind") == "static" and not isinstance(value, tuple):
                changes[field.name] = type(value)()
            elif field.metadata.get("like"):
                changes[field.name] = None
        return dataclasses.replace(tree, **changes)

    return jax.tree.structure(settle(tree))


def _without_tables(loop):
    """A loop without the parts that have tables of their own."""
    parts = {"faults": None}
    if signals.steps(loop.reference) is not None:
        parts["reference"] = None
    if signals.disturbance_tables(loop.disturbance) is not None:
        parts["disturbance"] = None
    signal: Any = getattr(loop.controller, "signal", None)
    if getattr(signal, "begins", None):  # of a table in a file, whose rows are written as changes
        rows = dataclasses.replace(signal, begins=())
        parts["controller"] = dataclasses.replace(loop.controller, signal=rows)
    return dataclasses.replace(loop, **parts)


def _in_use(tree):
    """Names of the optional leaves that are in use, which no file can take away."""
    return {name for name, value, meta in walk(tree) if meta.get("like") and value is not None}


def _alike(part, other):
    """Whether the values of a file make `part` of `other`."""
    return structure(part) == structure(other) and _in_use(other) <= _in_use(part)


PARTS = {  # {part of the loop: sentence above its lines in [values]}
    "plant": "plant: the rig",
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


def sections(case, tankwise=False):
    """Return the Blocks of a case: as its preset with changes, else tank by tank."""
    if case.loop.safety_filter is not None and not _has_designed_filter(case):
        raise InputError(
            f"{case.name}: cannot be written as a rig file: its safety filter was designed for"
            " other values of plant, pumps, noise or dt; design it again:"
            " case.with_safety_filter(**case.safety)"
        )
    case = case.replace(loop=dataclasses.replace(case.loop, safety_filter=None))
    origin = None if tankwise else origin_of(case)
    if origin is not None:
        try:
            return _sections(case, origin)
        except InputError:  # no table makes the preset's parts those of the case
            pass
    try:
        return _sections(case, None)
    except InputError as error:
        raise InputError(f"{case.name}: cannot be written as a rig file: {error}") from None


def _has_designed_filter(case):
    """Whether a file's [safety_filter] makes the safety filter of a case."""
    if case.safety is None:
        return False
    current = case.loop.safety_filter
    designed, _ = case.without_safety_filter().safety_design(**case.safety)
    if not _alike(current, designed) or _statics(current) != _statics(designed):
        return False
    pairs = zip(jax.tree.leaves(current), jax.tree.leaves(designed))
    return all(np.allclose(a, b, rtol=1e-9, atol=0.0, equal_nan=True) for a, b in pairs)


def _statics(part):
    """{name: value} of the static fields of a part, without those of the plants in it."""
    return {name: value for name, value, _ in walk(part, kind="static") if "." not in name}


def _sections(case, origin):
    """`sections` of a case as a preset with changes; tank by tank where `origin` is None."""
    loop = unscheduled(case.loop)
    parts = components.ROLES if origin else ()
    same = [n for n in parts if _alike(getattr(loop, n), getattr(origin.loop, n))]
    top, *built = _building(case, loop, origin, same)
    text = "\n".join(line for block in (top, *built) for line in terse(block))
    base = start_of(renamed(tomllib.loads(text)))
    alike = structure(_without_tables(loop)) == structure(_without_tables(base.loop))
    if not alike or not _in_use(base.loop) <= _in_use(loop):
        raise InputError("its controller or observer has another model than its rig")
    if why := unreachable(case) if case.reachable else None:
        top.lines.append(Line("reachable", False, {"unit": "-", "doc": why}))
    elif case.reachable != base.reachable:
        top.lines.extend(lines_of(SECTIONS[""], {"reachable": case.reachable}))
    if base.scenarios and not case.scenarios:
        top.lines.append(_none("scenario", "none of the preset's runs"))
    table = schedule_table(case.loop)
    if table:
        built.append(block_of(SECTIONS["schedule"], table, case.loop.units))
    return [top, *built, *_values(case, base, origin is None, same), *_tuning(case)]


def _none(name, doc="none"):
    """The line of a list or table that a preset has and the case does not."""
    return Line(name, {} if name == "sine" else [], {"unit": "-", "doc": doc})


def _building(case, loop, origin, same):
    """The Blocks that build a case before any value is set."""
    start, units = (None if origin is None else origin.loop), case.loop.units
    names = names_of(loop.plant, "tank")
    if origin is None:
        top = {"name": case.name, "units": units}
        entries = network.entries_of(loop)
        blocks = [_of_rig(section, i, values, units, names) for section, i, values in entries]
    else:
        top, blocks = {"case": origin.name, "name": case.name}, []
    for name in components.ROLES:
        part = getattr(loop, name)
        if name not in same and type(part) is not components.ROLES[name].default:
            blocks.append(block_of(*components.values_of(name, part), units, names))
    blocks += _reference(loop, start)
    disturbing = signals.disturbance_tables(loop.disturbance)
    if disturbing is None:
        raise InputError("its disturbance has no table")
    if origin is None:  # a steady inflow is a key of the tanks
        disturbing = _without_steady_inflow(disturbing)
    tables = [*disturbing, *signals.fault_tables(loop.faults)]
    gone = lambda field: getattr(loop, field) is None and getattr(start, field, None) is not None
    lists = {"inflow": "disturbance", "fault": "faults"}
    emptied = [_none(name) for name, field in lists.items() if gone(field)]
    top |= {"begins": case.begins} if case.begins else {}
    first = Block("", [*lines_of(SECTIONS[""], top, units), *emptied])
    return [first, *blocks, *(block_of(s, values, units, names) for s, values in tables)]


def _without_steady_inflow(tables):
    rest = [(section, {k: v for k, v in row.items() if k != "inflow"}) for section, row in tables]
    return [(section, row) for section, row in rest if row]


def _of_rig(section, number, values, units, names):
    """The Block of a table of a rig, with suggestions of a name and of further keys."""
    block = block_of(section, values, units, names)
    if values.get("name") == "":
        block.lines[0] = block.lines[0]._replace(value=f"{section.name} {number}", on=False)
    if number > 1 or not section.many:
        return block
    usual = {k.name: k.default for k in section.keys if k.like and k.default is not None}
    usual = {name: value for name, value in usual.items() if values.get(name) is None}
    more = [line._replace(on=False) for line in lines_of(section, usual, units)]
    return block._replace(lines=block.lines + more, prose=(section.prose,) * bool(section.prose))


def _reference(loop, start):
    """The Blocks of a reference; none of one that only a preset has."""
    reference, units, section = signals.steps(loop.reference), loop.units, SECTIONS["reference"]
    if reference is None:
        if start is None:
            raise InputError("its reference has no table")
        return []
    block = block_of(section, signals.ramp_values(reference), units)
    if reference.filter is None:
        none = [0.0] * reference.channels
        block.lines.append(Line("filter", none, section["filter"].meta(units), False))
    if isinstance(loop.reference, Sum):
        values = signals.sine_values(loop.reference.second)
        return [block, block_of(SECTIONS["reference.sine"], values, units)]
    if start is not None and isinstance(start.reference, Sum):
        block.lines.append(_none("sine"))
    return [block]


def _values(case, base, tankwise, same):
    """The Blocks of [values]: every leaf and static field that no table before it has set."""
    groups = {}
    for name, value, meta in _settable(case):
        line = _line(case, name, value, meta, _is_built(case, name, tankwise, same), base)
        if line is not None:
            groups.setdefault(name.partition(".")[0], []).append(line)
    clock = CLOCK.items()
    groups["clock"] = [Line(toml(f"clock.{n}"), getattr(case.clock, n), meta) for n, meta in clock]
    return [Block("[values]", []), *(Block("", rows, (PARTS[p],)) for p, rows in groups.items())]


def _settable(case):
    """[(name, value as in a file, metadata)] of what [values] may have."""
    loop = case.loop
    tables = ("disturbance.", "faults.", *(["reference."] if signals.steps(loop.reference) else []))
    # [schedule] has them
    scheduled = ("controller.knots", "controller.variable") if schedule_table(loop) else ()
    for name, value, meta in [*walk(loop), *walk(loop, kind="static")]:
        # a tuple is the topology of the rig; an array of a rig without pipes, say, is empty
        empty = isinstance(value, tuple) or (value is not None and np.size(value) == 0)
        # what a rig does not have is added by its tables, not by a value
        curve = name.startswith(("sensor.curve", "observer.coefficient_"))
        inside = name.rpartition(".")[0].endswith(("plant", "model"))
        empty = empty or (value is None and (inside or curve))
        if not empty and not name.startswith(tables) and name not in scheduled:
            yield name, None if value is None else np.asarray(value).tolist(), meta


SENSOR = {f"sensor.{name}" for name in ("low", "high", "curve_level", "curve_reading")}
"""Fields that keys of [[sensor]] give together."""


def _is_built(case, name, tankwise, same):
    """Whether the tables that build a case set the field `name` of its loop."""
    part = name.partition(".")[0]
    if tankwise and (part == "plant" or name in targets(*LISTS, "sensors") | SENSOR):
        return True
    if part not in components.ROLES or part in same:
        return False
    # [values] set the fields of LevelSensor and PumpBank
    return type(getattr(case.loop, part)) is not components.ROLES[part].default


def _line(case, name, value, meta, built, base):
    """The Line of a field in [values], None where another table has set it already."""
    if value is None:
        if name.startswith("controller.") and schedule_table(case.loop):
            return None
        return Line(toml(name), absent(case.loop, name, meta), meta, False)
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
            owners = (*MODELS[:-1], "plant.") if model == MODELS[-1] else ("plant.",)
            texts = (_text_of(loop, owner + name.removeprefix(model)) for owner in owners)
            return next((text for text in texts if text is not None), None)
    return None


def _tuning(case):
    """[limits] to [[scenario]]: what is tuned, by what, and what is uncertain."""
    plain = lambda value: value if isinstance(value, str) else np.asarray(value).tolist()
    tables = (
        ("limits", case.limits, plain, _of_measure, _measures(case, case.limits)),
        ("free", case.free, lambda f: list(Free(*f)), _of_free, _free(case)),
        ("objective", case.objective, float, _of_measure, _measures(case, case.objective)),
        ("uncertain", case.uncertain, float, _of_uncertain, _uncertain(case)),
    )
    blocks = []
    for title, values, text, about, more in tables:
        # functions of Python are left out of the file, commented out
        off, key = (unreadable(values), str) if about is _of_measure else ((), toml)
        rows = values.items()
        lines = [Line(key(n), text(v), about(case, n), n not in off) for n, v in rows]
        on = title != "objective" or any(line.on for line in lines)
        blocks.append(Block(SECTIONS[title].title, [*lines, *more], on=on))
    if case.covariance is not None:
        names, rows = case.covariance
        values = {"names": names, "matrix": [list(map(float, row)) for row in rows]}
        values |= {"rejected": True} if case.rejected else {}
        blocks.append(block_of(SECTIONS["covariance"], values))
    if case.safety is not None:
        blocks.append(block_of(SECTIONS["safety_filter"], dict(case.safety), case.loop.units))
    if case.log:
        bare = {"unit": "-", "doc": ""}
        columns = [Line(slot, plain(spec), bare) for slot, spec in case.log.items()]
        blocks.append(Block(SECTIONS["log"].title, columns))
    return blocks + [block_of(SECTIONS["scenario"], s._asdict()) for s in case.scenarios]


WIDTH = 110
SHORT = ("[limits]", "[free]", "[objective]")
"""Tables that a short file has also where they are the preset's."""


def dump(case: Case, tankwise: bool = False) -> str:
    """Return the rig file of `case` as text: every leaf, every static field that a file may set,
    what is tuned and what is uncertain.

    Parameters
    ----------
    case : Case
    tankwise : whether to describe it tank by tank even where it comes from a preset

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
    tankwise : as in `dump`

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
    blocks = sections(case, tankwise)
    titles = {b.title for b in blocks} | {line.name for line in blocks[0].lines}
    if any(line.name == "sine" for block in blocks for line in block.lines):
        titles.add("[reference.sine]")
    blocks += _suggestions(case, titles)
    return _text([HEAD.splitlines(), *map(_commented, blocks)])


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
    origin, blocks = origin_of(case), sections(case)
    if origin is None or blocks[0].lines[0].name != "case":
        return complete(case)
    head = f"# {origin.title}; `jaxtank init {origin.name}` without --short prints every key"
    suggested = {name.split("[")[0] for name in case.free}
    suggested |= {"clock.dt", "clock.duration", "sensor.noise"}
    different = _different(blocks, sections(origin), suggested)
    return _text([[head], *(_commented(block._replace(prose=())) for block in different)])


def _different(blocks, preset, suggested):
    """The Blocks that differ from the preset's, those of SHORT, and suggestions of [values]."""
    known = {line for block in preset for line in terse(block)}
    same, in_values, different = _by_title(preset), False, []
    alike = {title for title, rows in _by_title(blocks).items() if rows == same.get(title)}
    alike -= {"", *SHORT}
    for block in blocks:
        in_values = block.title == "[values]" or (in_values and not block.title)
        lines = [line for line in block.lines if line.on]
        if in_values:
            lines = _new_first(lines, known, suggested)
        elif not block.on or block.title in alike:
            continue
        if lines or block.title:
            different.append(block._replace(lines=lines))
    return different


def _new_first(lines, known, suggested):
    """Lines of [values] that are not `known`, then those that are `suggested`, commented out."""
    new = [line for line in lines if not set(terse(Block("", [line]))) <= known]
    old = [n for n in lines if n not in new and n.name.strip('"') in suggested]
    return new + [line._replace(on=False) for line in old]


def _by_title(blocks):
    """{title: [lines of each table of that title]}."""
    tables = {}
    for block in blocks:
        if block.on:
            tables.setdefault(block.title, []).append(terse(block))
    return tables


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
        about = f"{line.meta['doc']}{unit(line.meta)}", allowed(line.meta, line.value)
        lines += _wrapped(", ".join(filter(None, about)))
        lines.append(("" if block.on and line.on else "#") + f"{line.name} = {toml(line.value)}")
    return lines


def _wrapped(sentence):
    return textwrap.wrap(sentence, WIDTH, initial_indent="# ", subsequent_indent="# ")


HEAD = """\
# A complete rig file: delete what you do not change. Lines that begin with "#" and no space are
# suggestions: take the sign away to use one (those of a table together). Shapes: (n,) one per tank,
# (m,) one per input, pumps and then valves, (outputs,) one per controlled tank, all in order from
# 1. Where a name ends in [i], as in "plant.drain[0]", entries are counted from 0. `jaxtank show
# CASE` is the manual."""


def absent(loop, name, meta):
    """Return the least allowed value of an absent optional leaf, in its shape."""
    sibling = get_value(loop, f"{name.rpartition('.')[0]}.{meta['like']}")
    low, high = meta["low"], meta["high"]
    if name == "sensor.high":  # setpoints are within a span
        value = np.inf
    elif low is None or (low <= 0.0 and not meta["strict"]):
        value = 0.0
    else:
        value = 1.0 if high is None or high >= 1.0 else 0.5 * (low + high)
    return np.full(np.shape(sibling), value).tolist()


def _of_measure(case, name):
    per = MEASURES[name].per
    each = "" if per == "run" else f", of each {per}"
    rim = '; "rim": that of each tank' if name == "max_level" else ""
    # where overflow is simulated no level passes a rim (tuning.objective)
    if rim and case.loop.plant.overflow:
        rim += ", which with overflow = true is a limit on overflow_volume: none may overflow"
    return {"unit": measure_unit(name, case.loop.units), "doc": f"{MEASURES[name].doc}{each}{rim}"}


def _of_free(case, name):
    meta = describe(case.loop, name)
    return {**meta, "doc": f"[low, high, scale] of: {meta['doc']}"}


def _of_uncertain(case, name):
    meta = SHARE.meta()
    return {**meta, "doc": f"{meta['doc']}, of: {describe(case.loop, name)['doc']}"}


def _measures(case, known):
    """Suggested lines of the measures that a run of the case has, without those in `known`."""
    names = [name for name in of_loop(case.loop) if name not in known]
    return [Line(name, WEIGHT.default, _of_measure(case, name), False) for name in names]


def _free(case):
    """Lines of gains of controller and observer that could be free, over a decade each way."""
    lines, known = [], {name.split("[")[0] for name in case.free} | {"controller.knots"}
    for name, value, meta in walk(case.loop):
        part, _, rest = name.partition(".")
        if part not in ("controller", "observer") or "model." in rest or name in known:
            continue
        span = None if value is None or meta.get("rows") else around(value, meta)
        if span is not None:
            lines.append(Line(toml(name), list(span), _of_free(case, name), False))
    return lines


def around(value, meta):
    """Return Free of a tenth to ten times a value within its range, None of an empty one."""
    value = np.asarray(value, dtype=float)
    if value.size == 0:
        return None
    low, high = 0.1 * value.min(), 10.0 * value.max()
    if value.max() < 0:
        low, high = 10.0 * value.min(), 0.1 * value.max()
    elif value.min() <= 0:  # on both sides of 0 where entries are not of one sign
        high = 1.0 + 2 * np.abs(value).max()
        low = -high
    low = _rounded(low if meta["low"] is None else max(low, meta["low"]))
    high = _rounded(high if meta["high"] is None else min(high, meta["high"]))
    return Free(low, high, "log" if low * high > 0 else "linear") if low < high else None


def _rounded(value):
    return float(f"{value:.3g}")


def _uncertain(case):
    """Lines of the plant's parameters whose spread is not given."""
    known = {n.split("[")[0] for n in case.uncertain}
    nonzero = (n for n, v in parameters(case.loop).items() if np.any(np.asarray(v) != 0))
    names = [n for n in nonzero if n.startswith("plant.") and n not in known]
    return [Line(toml(n), SHARE.default, _of_uncertain(case, n), False) for n in names]


def _suggestions(case, titles):
    """Return the Blocks that a case could have; titles: of those it has or has emptied."""
    titles = titles - {section.title for section in SECTIONS.values() if section.many}
    blocks = []
    for name, values in _examples(case).items():
        section = SECTIONS[name]
        if values is None or section.title in titles or (section.many and name in titles):
            continue
        section = values.pop("section", section)
        usual = {k.name: k.default for k in section.keys}
        usual = {n: v for n, v in usual.items() if isinstance(v, (int, float, str))}
        lines = lines_of(section, {**usual, **values}, case.loop.units)
        blocks.append(Block(section.title, lines, (section.prose,), False))
    return blocks if "[log]" in titles else [*blocks, _log(case)]


def _examples(case):
    """{section: {key: value} that could be in a file, None where it cannot}."""
    loop, plant, disturbance = case.loop, case.loop.plant, case.loop.disturbance
    instant = lambda share: _rounded(share * case.clock.duration)  # [s]
    # a sine changes the names of the reference, which a scenario may have
    named = any(name.startswith("reference.") for s in case.scenarios for name in s.values)
    volume = _rounded(0.01 * float(np.asarray(plant.area)[0] * np.asarray(plant.rim)[0]))
    first = f"{_first_input(plant)}[0]"
    control, sensor = loop.controller, loop.sensor
    known = components.kind_of("controller", control) is not None  # no Scheduled
    known = known and is_component(getattr(control, "model", None))
    unspanned = isinstance(sensor, LevelSensor) and sensor.low is None
    return {
        "controller": _component("controller", control) if known else None,
        "schedule": _schedule(case),
        "observer": _observer(loop),
        "reference.sine": {"amplitude": 0.0, "period": instant(0.1), "end": instant(1), "output": 1}
        if isinstance(loop.reference, Ramps) and not named
        else None,
        "disturbance": {"inflow": np.zeros(plant.tanks)} if disturbance is None else None,
        "inflow": {"time": instant(0.5), "duration": instant(0.01), "tank": 0, "volume": volume},
        "fault": {"of": first, "start": instant(0.5), "end": instant(0.7), "factor": 0.6},
        "sensors": {"tank": 0, "span": [0.0, float(np.ravel(plant.rim)[0])]} if unspanned else None,
        "covariance": None if case.covariance else _covariance(case),
        "safety_filter": {"limit": np.asarray(plant.rim)}
        if case.safety is None and isinstance(plant, TankNetwork) and plant.plain
        else None,
        "scenario": {"name": "noisy", "seed": 1, "values": {"sensor.noise": 0.0}},
    }


def _component(name, part):
    """{key: value} of a controller or observer, and its section."""
    section, values = components.values_of(name, part)
    return {"section": _another(name, section.keys), **values}


def _another(name, keys):
    """The Section of a controller or observer instead of the preset's."""
    prose = f"Another {name} than the preset's: {', '.join(components.ROLES[name].classes)}."
    if name == "controller":
        prose += " [values] above then has the names of that controller."
    return Section(name, keys, prose=prose)


def _schedule(case):
    """The first free gain along the first setpoint, None where no schedule is allowed."""
    if schedule_table(case.loop):
        return None
    rim = float(np.asarray(case.loop.plant.rim)[case.loop.plant.outputs[0]])
    knots = [_rounded(share * rim) for share in (0.25, 0.5, 0.75)]
    for name in case.free:
        if name.startswith("controller.") and "model" not in name:
            for variable in ("r1", "h1"):
                try:
                    scheduled = schedule(case, {name: variable}, knots)
                    scheduled.loop.controller.check(scheduled.loop.reference)
                except (InputError, LookupError, TypeError, ValueError):
                    continue
                return {"gains": [name], "variable": variable, "knots": knots}
    return None


def _observer(loop):
    """The loop's own observer, or an extended Kalman filter where it has none."""
    part, kind = loop.observer, "extended-kalman"
    if components.kind_of("observer", part) not in (None, "direct"):
        return _component("observer", part)
    rim = float(np.asarray(loop.plant.rim)[0])
    small, large = (_rounded((share * rim) ** 2) for share in (1e-3, 1e-2))
    section = _another("observer", components.section_of("observer", kind).keys)
    variances = {"process": small, "measurement": small, "spread": large}
    return {"section": section, "kind": kind, **variances, "measured": range(loop.plant.tanks)}


def _first_input(plant):
    """The leaf of the first input: a valve where there is no pump."""
    return "pump_gain" if np.size(getattr(plant, "pump_gain", 1.0)) else "valve"


def _covariance(case):
    """5 % of the first uncertain parameter."""
    value_of = lambda name: np.ravel(np.asarray(get_value(case.loop, name)))
    nonzero = (n for n in case.uncertain if value_of(n).size and value_of(n)[0] != 0)
    name = next(nonzero, f"plant.{_first_input(case.loop.plant)}")
    scalar = "[" in name or np.ndim(get_value(case.loop, name)) == 0
    variance = _rounded((0.05 * value_of(name)[0]) ** 2)
    return {"names": [name if scalar else f"{name}[0]"], "matrix": [[variance]]}


def _log(case):
    plant, (length, drive) = case.loop.plant, case.loop.units
    columns = {"t": ["time", "s"]}
    columns |= {f"pump{j + 1}": [f"u{j + 1}", drive] for j in range(plant.pumps)}
    columns |= {f"h{i + 1}": [f"level {i + 1}", length] for i in range(plant.tanks)}
    lines = [Line(name, value, {"unit": "-", "doc": ""}) for name, value in columns.items()]
    return Block(SECTIONS["log"].title, lines, (SECTIONS["log"].prose,), False)

"""From a Case to a rig file: terse (`dump`), complete with every key that can be set (`complete`),
or what differs from a preset (`short`).
"""

import textwrap
from pathlib import Path

from jaxtank import presets
from jaxtank.case import Case
from jaxtank.core.files import write_atomic
from jaxtank.rig.preset_match import origin_of
from jaxtank.rig.schema import allowed, lines_of, toml
from jaxtank.rig.sections import sections

WIDTH = 110
SHORT = ("[limits]", "[free]", "[objective]")


def dump(case: Case, tankwise: bool = False) -> str:
    """The rig file of `case` as text: every leaf, every static field that a file may set, what is
    tuned and what is uncertain.

    tankwise: described tank by tank even where a preset has the same rig. Raises InputError for a
        case that no file can describe.
    """
    return _text([lines_of(s) for s in sections(case, tankwise) if s.on])


def save(case: Case, path: str | Path) -> None:
    """Write `dump(case)` to a file, whole or not at all."""
    write_atomic(Path(path), dump(case))


def complete(case: Case, tankwise: bool = False) -> str:
    """`dump` with every other key that can be set, and every table that could be there, commented
    out; each key below its unit, range and meaning. A line that begins with "#" and no space is one
    that may be used as it stands; those of a table go together.
    """
    return _text([HEAD.splitlines()] + [_commented(s) for s in sections(case, tankwise)])


def short(case: Case) -> str:
    """What differs from the preset that `case` came from, and what is tuned; `complete` where there
    is no preset.
    """
    origin, _ = origin_of(case)
    if origin is None:
        return complete(case)
    theirs, mine = sections(presets.find(origin.name)), sections(case)
    plain, same = {line for s in theirs for line in lines_of(s)}, _same_tables(mine, theirs)
    found, wanted = (
        [],
        {toml(n).split("[")[0].strip('"') for n in case.free}
        | {"clock.dt", "clock.duration", "sensor.noise"},
    )
    inside = False
    for s in mine:
        inside = s.title == "[values]" or (inside and not s.title)
        if inside:
            own = [k for k in s.keys if not set(lines_of(s._replace(title="", keys=[k]))) <= plain]
            more = [k for k in s.keys if k not in own and k.on and k.name.strip('"') in wanted]
            keys = [*(k for k in own if k.on), *(k._replace(on=False) for k in more)]
            if keys or s.title:
                found.append(_commented(s._replace(keys=keys, prose=())))
        elif s.on and (not s.title or s.title in SHORT or s.title not in same):
            found.append(_commented(s._replace(prose=(), keys=[k for k in s.keys if k.on])))
    return _text(
        [
            [f"# {origin.title}; `jaxtank init {origin.name}` without --short prints every key"],
            *found,
        ]
    )


def _same_tables(mine, theirs):
    """Titles of the tables that two files have alike, those of a list in the same number: an empty
    [uncertain] is not a preset's.
    """
    tables = [{}, {}]
    for found, sections_ in zip(tables, (mine, theirs)):
        for s in sections_:
            if s.on:
                found.setdefault(s.title, []).append(lines_of(s))
    return {title for title, lines in tables[0].items() if tables[1].get(title) == lines}


def _text(blocks):
    """Blocks of lines as text, an empty line before each one that begins a table."""
    lines = []
    for block in blocks:
        starts = (
            next((line for line in block if not line.startswith("# ")), "")
            .lstrip("#")
            .startswith("[")
        )
        lines += ["", *block] if lines and starts else block
    return "\n".join(lines) + "\n"


def _commented(section):
    """The lines of a Section, each key below what it is."""
    lines = [""] * bool(section.prose and not section.title)
    lines += [line for sentence in section.prose for line in _wrapped(sentence)]
    lines += [("" if section.on else "#") + section.title] * bool(section.title)
    for key in section.keys:
        lines += [line for line in _wrapped(_about(key))] if _about(key) else []
        lines.append(("" if section.on and key.on else "#") + f"{key.name} = {toml(key.value)}")
    return lines


def _about(key):
    """What a key is, its unit and its range."""
    unit = "" if key.meta["unit"] == "-" else f" [{key.meta['unit']}]"
    return ", ".join(filter(None, [f"{key.meta['doc']}{unit}", allowed(key.meta, key.value)]))


def _wrapped(sentence):
    return textwrap.wrap(sentence, WIDTH, initial_indent="# ", subsequent_indent="# ")


HEAD = """# A complete rig file: delete what you do not change. Lines that begin with "#" and no space are suggestions: take the sign away to use
# one (those of a table together). Shapes: (n,) one per tank, (m,) one per pump, (outputs,) one per controlled tank, all in order from 1.
# Where a name ends in [i], as in "plant.drain[0]", entries are counted from 0. `jaxtank show CASE` is the manual of the case."""

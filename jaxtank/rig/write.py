"""From a Case to a rig file: terse (`dump`), complete with every key that can be set (`complete`),
or what differs from a preset (`short`).
"""

import textwrap
from pathlib import Path

from jaxtank import presets
from jaxtank.case import Case
from jaxtank.core.files import write_atomic
from jaxtank.rig.entry import allowed, unit
from jaxtank.rig.lines import Block, terse, toml
from jaxtank.rig.preset_match import origin_of
from jaxtank.rig.sections import sections

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

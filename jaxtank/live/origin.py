"""Where a case comes from: the words of the command line that make it, and its filter's twin."""

import contextlib
import shlex
from typing import NamedTuple

import numpy as np

from jaxtank import presets, rig
from jaxtank.core.clock import CLOCK_UNITS
from jaxtank.core.errors import InputError
from jaxtank.core.tree import parameters, walk

GUARD = "safety_filter."
"""Prefix of the names of a safety filter."""

NEW = "rig.toml"
"""Name of the rig file to which a case without a name is copied."""


class Origin(NamedTuple):
    """How `jaxtank simulate` makes a case."""

    words: str
    values: dict[str, float]
    filtered: bool
    guard: str


def origin_of(case, source=None):
    """Return the Origin of a case."""
    source = source or (case.name if case.name in presets.names() else None)
    known, words = None, None
    if source is not None:
        with contextlib.suppress(InputError):  # the file has gone
            known = rig.open_case(source)
            words = _static(case, known)
    if source is None or known is None or words is None:
        return Origin(shlex.quote(source or NEW), {}, case.safety is not None, "")
    current, before = entries(case.loop, parameters(case.loop)), dict(known.safety or {})
    origin = entries(known.loop, parameters(known.loop)).items()
    differing = {name: value for name, value in origin if current[name] != value}
    guard: list[str] = []  # settings of the safety filter that the origin does not have
    for key, value in (case.safety or {}).items():
        if key not in before or not np.array_equal(before[key], value):
            text = f"[{','.join(map(str, value))}]" if np.ndim(value) else str(value)
            guard += ["--set", shlex.quote(f"safety_filter.{key}={text}")]
    words = " ".join([shlex.quote(source), *words])
    return Origin(words, differing, known.safety is not None, " ".join(guard))


def _static(case, known):
    """--set of the static fields and the clock that differ; None where the structure does."""
    mine, theirs = (
        {n: v for n, v, _ in walk(c.loop, kind="static") if not n.startswith(GUARD)}
        for c in (case, known)
    )
    if _shapes(case.loop) != _shapes(known.loop) or mine.keys() != theirs.keys():
        return None
    changes = {name: value for name, value in mine.items() if value != theirs[name]}
    if any(value is None or isinstance(value, tuple) for value in changes.values()):
        return None
    for name in CLOCK_UNITS:
        if getattr(case.clock, name) != getattr(known.clock, name):
            changes[f"clock.{name}"] = getattr(case.clock, name)
    words = []
    for name, value in changes.items():
        text = str(value).lower() if isinstance(value, bool) else value
        words += ["--set", shlex.quote(f"{name}={text}")]
    return words


def _shapes(loop):
    return {n: np.shape(v) for n, v in parameters(loop).items() if not n.startswith(GUARD)}


def entries(loop, values):
    """Return {name of one entry: number} of {dotted name: number or array}."""
    numbers, leaves = {}, parameters(loop)
    for name, value in values.items():
        if name.startswith(GUARD):
            continue
        shape = np.shape(leaves[name]) if name in leaves else ()
        if not shape:
            numbers[name] = float(np.ravel(value)[0])
            continue
        for index, entry in np.ndenumerate(np.broadcast_to(np.asarray(value, float), shape)):
            numbers[f"{name}[{','.join(map(str, index))}]"] = float(entry)
    return numbers


def both(case):
    """Return (case without a safety filter, the same with one or None, whether it has one now)."""
    has = case.loop.safety_filter is not None
    try:
        return case.without_safety_filter(), case if has else rig.filtered(case, on=True), has
    except InputError:  # nothing to keep, or no way to
        return case, None, has

"""Where a case comes from: the words of the command line that make it, and its filter's twin.

Imported by `page`.
"""

import shlex

import numpy as np

from jaxtank import presets, rig
from jaxtank.core.clock import CLOCK_UNITS
from jaxtank.core.errors import InputError
from jaxtank.core.tree import parameters, walk

NEW = "rig.toml"
"""Name of the rig file that a case without a name of its own is copied to."""


def origin_of(case, source=None):
    """Return what `jaxtank simulate` needs to make a case.

    Parameters
    ----------
    case : Case
    source : str or None
        The rig file that it was read from, as the command line names it.

    Returns
    -------
    (words, values) : the words of the case, with --set of its static fields and clock; {name of one
        entry: value before} of the leaves that differ from the preset or the file.

    Examples
    --------
    >>> case = rig.set_values(presets.find("cascaded/pi"), {"clock.dt": 2.0, "plant.rim[0]": 8.0})
    >>> words, values = origin_of(case)
    >>> words, values["plant.rim[0]"]
    ('cascaded/pi --set clock.dt=2.0', 10.0)
    """
    source = source or (case.name if case.name in presets.names() else None)
    try:
        known = None if source is None else rig.open_case(source)
    except InputError:  # the file has gone
        known = None
    words = None if known is None else _static(case, known)
    if words is None:
        return shlex.quote(source or NEW), {}
    differing, own = {}, entries(case.loop, parameters(case.loop))
    for name, value in entries(known.loop, parameters(known.loop)).items():
        if own[name] != value:
            differing[name] = value
    return " ".join([shlex.quote(source), *words]), differing


def _static(case, known):
    """--set of the static fields and the clock that differ; None where the structure does."""
    found = []
    shapes = [{n: np.shape(v) for n, v in parameters(c.loop).items()} for c in (case, known)]
    mine, theirs = (dict(_fields(c.loop)) for c in (case, known))
    if shapes[0] != shapes[1] or mine.keys() != theirs.keys():
        return None
    for name, value in mine.items():
        if value != theirs[name]:
            if isinstance(value, tuple) or value is None:
                return None
            found.append((name, str(value).lower() if isinstance(value, bool) else value))
    for name in CLOCK_UNITS:
        if getattr(case.clock, name) != getattr(known.clock, name):
            found.append((f"clock.{name}", getattr(case.clock, name)))
    return [word for name, value in found for word in ("--set", shlex.quote(f"{name}={value}"))]


def _fields(loop):
    for name, value, _ in walk(loop, kind="static"):
        if not name.startswith("safety_filter."):
            yield name, value


def entries(loop, values):
    """Return {name of one entry: number} of {dotted name: number or array}.

    Examples
    --------
    >>> entries(presets.find("cascaded/pi").loop, {"plant.rim": 5.0})
    {'plant.rim[0]': 5.0, 'plant.rim[1]': 5.0}
    """
    found, own = {}, parameters(loop)
    for name, value in values.items():
        if name.startswith("safety_filter."):
            continue
        shape = np.shape(own[name]) if name in own else ()
        if not shape:
            found[name] = float(np.ravel(value)[0])
        else:
            array = np.broadcast_to(np.asarray(value, dtype=float), shape)
            for index, entry in np.ndenumerate(array):
                found[f"{name}[{','.join(map(str, index))}]"] = float(entry)
    return found


def both(case):
    """Return (case without a safety filter, the same with one or None, whether it has one now).

    Examples
    --------
    >>> off, on, now = both(presets.find("cascaded/pi"))
    >>> off.loop.safety_filter is None, on.loop.safety_filter is None, now
    (True, False, False)
    """
    has = case.loop.safety_filter is not None
    try:
        return case.without_safety_filter(), case if has else rig.filtered(case, on=True), has
    except InputError:  # nothing to keep, or no way to
        return case, None, has

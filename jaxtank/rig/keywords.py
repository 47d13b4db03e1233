"""A rig in Python: the tables and keys of a rig file as keywords, read by the reader of rig files.

Signatures and docstrings of the tables are made from the schema; keywords.pyi has them for editors.
"""

import functools
import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxtank.case import Case
from jaxtank.core.checks import allowed
from jaxtank.core.clock import CLOCK
from jaxtank.core.errors import InputError, unknown
from jaxtank.core.quantities import converted
from jaxtank.core.tree import is_real
from jaxtank.rig.entry import Problems, refusal, unit, unknown_key
from jaxtank.rig.read import from_table
from jaxtank.rig.schema import LISTS, NEEDED, SECTIONS

_spelt = lambda name: f"{name.removesuffix('s')}s" if SECTIONS[name].many else name
KEYWORDS = {_spelt(name): name for name in SECTIONS if name.isidentifier()}
KEYWORDS |= {name: name for name in SECTIONS[""].names}
"""{keyword of `Rig`: table or key of a rig file}, beside those of the clock."""


def Rig(**tables: Any) -> Case:
    """Return the Case of a rig that is described by keywords: the tables of a rig file, with the
    same keys, units, names and messages.

    Parameters
    ----------
    tanks, pumps, valves, orifices, pipes, spills : lists of `Tank`, `Pump`, ..., or of dicts
    controller, observer : dict with `kind` and the keys of its class; or a component
    reference, inputs : dict (`initial`, `changes`, `csv`, ...); or the array (n, 1 + m) of a table:
        times [s], then the m setpoints, or the inputs of an open loop, from each time on
    dt, duration, substeps, integrator : of the clock; dt and duration in s
    units : (length, pump input), ("cm", "V") where left out
    limits, free, objective, uncertain, values : {name: value}
    inflows, faults, scenarios, sensors : lists of dicts
    plant, sensor, actuator, disturbance, schedule, covariance, safety_filter, log : dicts
    name : what reports call it
    case : "paper/case" to start from, instead of tanks
    reachable : whether every setpoint must have a steady state

    Returns
    -------
    Case
        For `simulate`, `evaluate`, `tuning.tune` and the others; `rig.dump` gives its rig file.

    Raises
    ------
    InputError
        With all problems of the description.

    Examples
    --------
    >>> import jaxtank
    >>> rig = jaxtank.Rig(
    ...     units=("m", "%"),
    ...     tanks=[jaxtank.Tank("LT101", area=0.5, rim=1.2, drain="4 cm^2", level=0.4)],
    ...     pumps=[jaxtank.Pump("P101", to="LT101", gain=3e-5, high=100.0)],
    ...     controller={"kind": "pi", "Kc": 200.0, "Ti": "5 min"},
    ...     reference=[[0.0, 0.4], [60.0, 0.6]],
    ...     dt=5.0,
    ...     duration="20 min",
    ... )
    >>> run = jaxtank.simulate(rig)
    >>> run.x.shape, rig.names["pump"]
    ((241, 1), ('P101',))
    """
    known = [*KEYWORDS, *CLOCK]
    Problems(unknown("keyword of Rig", name, known) for name in tables if name not in known).check()
    table = {KEYWORDS.get(k, k): _plain(v) for k, v in tables.items() if v is not None}
    for name in ("reference", "inputs"):
        if isinstance(table.get(name), list):
            table[name] = _steps(name, table[name])
    return from_table(table)


def _plain(value: Any) -> Any:
    """A value as the reader of TOML gives it: lists, paths as texts, without None."""
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items() if v is not None}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, Path):
        return str(value)
    array = hasattr(value, "tolist") and not isinstance(value, type)
    return value.tolist() if array else value


def _steps(name: str, rows: list[Any]) -> dict[str, Any]:
    """{"initial", "changes"} of rows of a time, then a value for each output or input."""
    widths = {len(row) if isinstance(row, list) else 0 for row in rows}
    if len(widths) != 1 or min(widths) < 2:
        raise refusal(name, rows, "be a dict, or rows of a time [s] and a value for each")
    first, changes = rows[0], []
    for k, (before, row) in enumerate(zip(rows, rows[1:])):
        times = converted(f"{name}: row {k + 2}", [before[0], row[0]], "s")
        if all(map(is_real, times)) and not times[0] < times[1]:
            raise refusal(
                f"{name}: time of row {k + 2}", row[0], f"be later than that of row {k + 1}"
            )
        changes += [[row[0], i, row[i]] for i in range(1, len(row)) if row[i] != before[i]]
    return {"initial": first[1:], "changes": changes}


EXAMPLES: dict[str, dict[str, Any]] = {  # {table: keywords of the example in its docstring}
    "tank": {"name": "LT101", "area": "2500 cm^2", "rim": 120.0},
    "orifice": {"from_": "LT101", "to": "LT102", "area": 0.5},
    "pipe": {"between": ["LT101", "LT102"], "area": 0.5},
    "spill": {"from_": "LT101", "to": "LT102"},
    "pump": {"name": "P101", "to": "LT101", "gain": 3.3, "high": 12.0},
    "valve": {"name": "FV101", "from_": "LT102", "area": 0.4},
}


PLACED = inspect.Parameter.POSITIONAL_OR_KEYWORD


def _maker(kind: str) -> Any:
    """The function that returns a table `kind` of a rig from keywords, such as Tank."""
    section, named = SECTIONS[kind], "name" in SECTIONS[kind].names
    title = kind.capitalize()

    def table(*args: Any, **keys: Any) -> dict[str, Any]:
        if len(args) > named:
            most = "only its name" if named else "nothing"
            raise InputError(f"{title}: {len(args)} values without a keyword: must be {most}")
        keys = {"name": args[0], **keys} if args else keys
        keys = {name.removesuffix("_"): value for name, value in keys.items()}
        Problems(unknown_key(section, key) for key in keys if key not in section.names).check()
        return keys

    spell = lambda name: f"{name}_" if name == "from" else name
    parameters, rows = [], []
    for key in section.keys:
        place = PLACED if key.name == "name" else inspect.Parameter.KEYWORD_ONLY
        default = inspect.Parameter.empty if key.default is NEEDED else key.default
        parameters.append(inspect.Parameter(spell(key.name), place, default=default))
        words = ", ".join(filter(None, [key.doc, allowed(key.meta())]))
        rows.append(f"{spell(key.name)} : {words}{unit(key.meta())}")
    example = EXAMPLES[kind]
    call = ", ".join(f"{k}={v!r}" for k, v in example.items())
    result = {k.removesuffix("_"): v for k, v in example.items()}
    table.__signature__ = inspect.Signature(parameters)
    table.__name__ = table.__qualname__ = title
    table.__doc__ = "\n".join(
        [
            f"Return a {section.title} of a `Rig`: a dict of its keys, of which None is left out.",
            "",
            "Numbers are in the units of the rig, below for (cm, V), or texts with a unit.",
            *("", "Parameters", "----------", *rows),
            *("", "Returns", "-------", "dict"),
            *("", "Examples", "--------", ">>> import jaxtank"),
            *(f">>> jaxtank.{title}({call})", repr(result)),
        ]
    )
    return table


_parameter = functools.partial(inspect.Parameter, kind=inspect.Parameter.KEYWORD_ONLY, default=None)
_signature = inspect.Signature([_parameter(name) for name in [*KEYWORDS, *CLOCK]])
Rig.__signature__ = _signature  # pyright: ignore[reportFunctionMemberAccess]
Tank, Orifice, Pipe, Spill, Pump, Valve = map(_maker, LISTS)

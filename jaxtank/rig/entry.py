"""Values of a rig file, read and written by their Key: kinds, ranges, units, lines of TOML."""

import contextlib
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jax.core import Tracer

from jaxtank.core.checks import allowed, check_value
from jaxtank.core.errors import InputError, nearest, unknown
from jaxtank.core.labels import index_of, names_of
from jaxtank.core.quantities import NUMBER, converted
from jaxtank.core.text import shortened
from jaxtank.core.tree import number, sizes_of_shape, split_index
from jaxtank.core.units import DEFAULT, local
from jaxtank.rig.schema import NEEDED, PARTS, SECTIONS, Key, Section
from jaxtank.rig.sensors import GAINS, ONE_INPUT, TANKS_OF, Manipulated, is_reading, readings

LARGEST = 1e300  # magnitude of a number of a rig file: products of two stay finite for most


TORRICELLI = 0.5  # exponent of the head in the flow of an opening that is an area


class Sizes(NamedTuple):
    """What is known of a rig while it is read: counts, units, and {name: index} of its tanks."""

    tanks: int
    pumps: int = 0
    outputs: int = 0
    units: tuple = DEFAULT
    names: Mapping[str, int] = {}
    plant: Any = None
    loop: Any = None
    tanks_of: Mapping[str, tuple[int, ...]] = {}  # of keys that are no readings of the outputs
    manipulated: Manipulated = ONE_INPUT  # by the controller whose table is read

    @property
    def counts(self) -> dict[str, int]:
        """{name in the shape of a leaf: count}."""
        return {"tank": self.tanks, "pump": self.pumps, "output": self.outputs}


def sizes_of(loop) -> Sizes:
    """Return the Sizes of a loop; tanks are called by the names of their sensors too."""
    plant = loop.plant
    named = [(name, i) for k in ("sensor", "tank") for i, name in enumerate(names_of(plant, k))]
    names = {name: i for name, i in named if name}
    return Sizes(plant.tanks, plant.pumps, len(plant.outputs), plant.units, names, plant, loop)


def read_entry(
    section, table: Any, sizes: Sizes, index: int | None = None, title: str = ""
) -> dict[str, Any]:
    """Return the values of a table of a rig file, checked key by key against its section."""
    where = section.name if index is None else f"{section.name} {index + 1}"
    if not isinstance(table, Mapping):
        raise refusal(where, table, "be a table")
    section, problems, values, meant = section.on(sizes.plant), Problems(), {}, set()
    sizes = sizes._replace(tanks_of=_tanks_of(section, table, sizes))
    sizes = sizes._replace(manipulated=_manipulated(section, table, sizes))
    problems += unknown_keys(section, table, where, (section.name, index))
    for _, _, key in (error.place for error in problems):
        word = WORDS.get(f"{section.name}.{key.lower()}", WORDS.get(key.lower(), ""))
        meant |= set(word.partition(":")[0].split(" or "))
    for key in section.keys:
        value = table.get(key.name, None if key.default is NEEDED else key.default)
        if key.name in table or value is not None:
            label = f"{where}: {key.name}" if section.many else f"{where}.{key.name}"
            with problems.collect((section.name, index, key.name)):
                values[key.name] = read_value(key, label, value, sizes)
        elif key.default is NEEDED and key.name not in meant:
            label = where if section.many else title or section.title
            needed = f"{label} needs {key.name}{unit(key.meta(sizes.units))}: {key.doc}"
            problems.append(InputError(needed))
            problems[-1].place = (section.name, index, None)
    problems.check()
    return values


def _tanks_of(section, table, sizes):
    """{key of TANKS_OF: tanks} of the table of a controller."""
    tanks = {}
    for name, of in TANKS_OF.items():
        if {name, of} <= {*section.names} and isinstance(table.get(of), list):
            with contextlib.suppress(InputError):  # reported of the key itself
                tanks[name] = _tanks(section[of], of, table[of], sizes)
    return tanks


def _manipulated(section, table, sizes):
    """The Manipulated of the table of a ratio (the inputs that lead) or of a split range."""
    span = None
    with contextlib.suppress(InputError):  # reported of the key itself
        if "lead" in section.names:
            leads = range(sizes.outputs)
            if isinstance(table.get("lead"), list):
                leads = _tanks(section["lead"], "lead", table["lead"], sizes)
            return Manipulated(tuple((j,) for j in leads))
        if "sequence" in section.names:
            rows = [range(1, sizes.pumps + 1)] if sizes.outputs == 1 else []
            if "span" in table:
                span = read_value(section["span"], "", table["span"], sizes)
            return Manipulated(
                _sequence(section["sequence"], "", table.get("sequence", rows), sizes), span
            )
    return ONE_INPUT


def read_entries(section, table: Mapping[str, Any], sizes: Sizes) -> list[dict[str, Any]]:
    """Return `read_entry` of each table of a list in a rig file, [] where there is none."""
    problems, entries = Problems(), []
    for i, entry in enumerate(table[section.name]):
        with problems.collect():
            entries.append(read_entry(section, entry, sizes, i))
    problems.check()
    return entries


class Problems(list[InputError]):
    """What is wrong in a file, so that one answer has all of it."""

    @contextlib.contextmanager
    def collect(self, place=None):
        """Keep an InputError of the block, and go on after it; place: where in a file it is."""
        try:
            yield
        except InputError as error:
            error.place = error.place or place
            self.append(error)

    def check(self) -> None:
        """Raise the InputError of what was collected."""
        if len(self) == 1:
            raise self[0]
        if self:
            parts = [part for error in self for part in error.parts or (error,)]
            parts = {str(part): part for part in parts}
            joined = InputError("; ".join(parts))
            joined.parts = tuple(parts.values())
            raise joined


def unknown_key(section, key: str, where: str = "") -> InputError:
    """Return the InputError for a key that a section does not have, with what to write."""
    if key in getattr(PARTS.get(section.elsewhere), "__dataclass_fields__", ()):
        return InputError(
            f"{where}: {key} is not a key of {section.title}: it is"
            f' "{section.elsewhere}.{key}" in [values], for all of them at once'
        )
    titles = [s.title for s in SECTIONS.values() if key in s.names and s.name]
    names = section.names if section.name else [*section.names, *SECTIONS]
    if (section.name, key) == ("controller", "action"):
        hint = f"; leave it out: {UNTURNED['on' in section.names]}"
    elif word := WORDS.get(f"{section.name}.{key.lower()}"):
        hint = f"; write {word}"
    elif section.name and key in SECTIONS:
        hint = f"; {SECTIONS[key].title} is a table of its own"
    elif titles:
        hint = f"; it is a key of {', '.join(titles)}"
    else:
        word = WORDS.get(key.lower())
        hint = f"; write {word}" if word else nearest(key, names)
    of = f" of {section.title}" if section.name else ""
    return InputError(f"unknown key{of} {key!r}{hint}")


def unknown_keys(
    section, table: Mapping[str, Any], where: str, place: tuple
) -> Iterator[InputError]:
    """Yield `unknown_key` of the keys of a table in a file, at (its section, its index)."""
    for key in (key for key in table if key not in section.names):
        error = unknown_key(section, key, where)
        error.place = (*place, key)
        yield error


UNTURNED = {  # {whether a kind without `action` switches: what turns its inputs}
    True: "`on` above `off` empties a tank, and `on` below `off` fills it",
    False: "this kind takes the direction of its inputs from its model or the sign of its gains",
}

WORDS = tomllib.loads(Path(__file__).with_name("words.toml").read_text("utf-8"))
"""{word of the field that is no key, or "table.word": what to write}."""


def refusal(label: str, value: Any, must: str) -> InputError:
    """Return the InputError for a value that must be something else."""
    return InputError(f"{label} = {shortened(value)}: must {must}")


def check_coefficient(
    label: str, text: Any, value: Any, exponent: Any, units: tuple[str, str]
) -> None:
    """Raise InputError for an area in a unit that is not the rig's, beside an exponent."""
    if not isinstance(text, str) or exponent is None or float(exponent) == TORRICELLI:
        return
    match = NUMBER.match(text.strip())
    if match is not None and float(match[0]) != float(value):
        raise InputError(
            f"{label} = {shortened(text)} with an exponent of {float(exponent):g}: the flow is area"
            f" sqrt(2 g) head^exponent in {units[0]} and s, so that in another unit of length it is"
            f" another opening: give a number [{local('cm^2', units)}]"
        )


def check_areas(plant: Any, name: str, label: str, texts: Any, values: Any) -> None:
    """`check_coefficient` of values of "drain[0]", "orifice" and others, with their texts."""
    field, index = split_index(name)
    exponents = getattr(plant, f"{field}_exponent", None)
    if exponents is None:
        return
    chosen = np.ravel(np.asarray(exponents)[index] if index else exponents)
    each = np.broadcast_to(np.ravel(np.asarray(values, dtype=float)), chosen.shape)
    for text, value, exponent in zip(np.broadcast_to(texts, chosen.shape), each, chosen):
        check_coefficient(label, str(text), value, exponent, plant.units)


def read_value(key, label: str, value: Any, sizes: Sizes) -> Any:
    """Return the value of a key, checked by its kind; `label` names it in errors."""
    if sizes.loop is not None and (key.unit in ("cm", *GAINS) or key.name in sizes.tanks_of):
        unit, axes = key.local_unit(sizes.units), "tank" if key.shape == ("tank",) else "output"
        axes = sizes.tanks_of.get(key.name, axes)
        value = readings(label, key.name, value, unit, axes, sizes.loop, sizes.manipulated)
    return READ[key.kind](key, label, value, sizes)


def _span(key, label, value, sizes):
    value = converted(label, value, key.meta(sizes.units)["unit"])
    if not (is_finite(value) and np.shape(value) == (2,)):
        raise refusal(label, value, f"be two numbers{unit(key.meta(sizes.units))}: {key.doc}")
    return tuple(map(float, value))


def _number(key, label, value, sizes):
    if key.kind == "reading" and is_reading(value):  # "80 %" waits for the span of its sensor
        return value
    meta = key.meta(sizes.units)
    value = converted(label, value, meta["unit"])
    if not is_plain(value):
        raise refusal(label, value, f"be {_within(f'a finite number{unit(meta)}', meta)}")
    if LARGEST < abs(value) < float("inf"):
        raise InputError(f"{label} = {shortened(value)}{unit(meta)}: must be within +-{LARGEST:g}")
    check_value(label, float(value), meta)
    return float(value)


def _within(what, meta):
    return ", ".join(filter(None, [what, allowed({**meta, "choices": None})]))


def _integer(key, label, value, sizes):
    inside = is_plain(value) and (key.low is None or value >= key.low)
    inside = inside and (key.high is None or value <= key.high)
    if not (inside and float(value).is_integer()):
        raise refusal(label, value, f"be {_within('a whole number', key.meta(sizes.units))}")
    return int(value)


def _texts(key, label, value, sizes):
    if not (value and is_texts(value)):
        raise refusal(label, value, f"be a list of texts: {key.doc}")
    return tuple(name_of(label, text) for text in value)


def is_texts(value):
    return isinstance(value, list | tuple) and all(isinstance(v, str) for v in value)


def hyphened(text: str) -> str:
    """Return a name such as "Equal percentage" as files have it: "equal-percentage"."""
    return text.strip().lower().replace("_", "-").replace(" ", "-")


def _list(key, label, value, sizes):
    shape = sizes_of_shape(key.shape, sizes.counts) or ()
    if isinstance(value, dict) and sizes.plant is not None:  # by name or number, all of them
        places = {index_of(label, sizes.plant, key.shape[0], name): v for name, v in value.items()}
        value = [places[i] for i in sorted(places)]
    elif shape == (1,) and (is_plain(value) or isinstance(value, str)):
        value = [value]
    value = converted(label, value, key.meta(sizes.units)["unit"])
    if not (is_finite(value) and np.shape(value) == shape):
        numbers = f"{shape[0] if shape else 1} finite numbers{unit(key.meta(sizes.units))}"
        each = {"pump": "input (pumps, then valves)"}.get(key.shape[0], key.shape[0])
        raise refusal(label, value, f"be a list of {numbers}, one per {each}")
    return number(value)


def _array(key, label, value, sizes):
    """An array; one number for an array of one entry per pump, tank or output fills it."""
    meta = key.meta(sizes.units)
    value = converted(label, value, meta["unit"])
    if not is_numeric(value):
        raise refusal(label, value, f"be a number or a list of numbers{unit(meta)}")
    array, shape = number(value), sizes_of_shape(key.shape, sizes.counts) or ()
    if key.kind == "scalar" and array.ndim:
        raise refusal(label, value, f"be one number{unit(meta)}")
    return np.full(shape, array) if len(shape) == 1 and array.ndim == 0 else array


def _tank(key, label, value, sizes):
    """Index of a tank given by its name or its number from 1."""
    if isinstance(value, str):
        if value not in sizes.names:
            raise unknown(f"tank of {label}", value, sizes.names or ["1"])
        return sizes.names[value]
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= sizes.tanks:
        of = f"by its name or its number, counted from 1 to {sizes.tanks}"
        raise refusal(label, value, f"be a tank, {of}")
    return value - 1


def _tanks(key, label, value, sizes):
    if not isinstance(value, list):
        of = f"tanks, counted from 1 to {sizes.tanks}" if key.kind == "tanks" else "inputs"
        raise refusal(label, value, f"be a list of {of}")
    if key.kind == "inputs":
        return tuple(_input(label, v, sizes) for v in value)
    return tuple(_tank(key, label, tank, sizes) for tank in value)


def _input(label, value, sizes):
    """Index of an input given by its name or its number from 1: pumps, then valves."""
    if isinstance(value, str):
        return index_of(label, sizes.plant, "pump", value)
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= sizes.pumps:
        raise refusal(label, value, f"be an input, by its name or counted from 1 to {sizes.pumps}")
    return value - 1


def _sequence(key, label, value, sizes):
    """The inputs of each output; of one output, its inputs alone are enough."""
    nested = isinstance(value, list) and value and all(isinstance(v, list) for v in value)
    if not isinstance(value, list) or not value:
        raise refusal(label, value, "be a list of inputs for each output, as [[1, 2], [3]]")
    rows = value if nested else [value]
    return tuple(tuple(_input(label, v, sizes) for v in row) for row in rows)


def _pair(key, label, value, sizes):
    if not isinstance(value, list) or len(value) != 2:
        raise refusal(label, value, "name two tanks")
    return different(label, value, _tanks(key, label, value, sizes))


def _feed(key, label, value, sizes):
    """(first, second) of the tanks that a pump fills, None for a second that is left out."""
    tanks = value if isinstance(value, list) else [value]
    if not 1 <= len(tanks) <= 2:
        raise refusal(label, value, "name one tank, or two; left out: the basin")
    first, *second = different(label, value, _tanks(key, label, tanks, sizes))
    return first, second[0] if second else None


def different(label, value, tanks):
    """Return `tanks`; InputError, with `value` as the file has it, where one is given twice."""
    if len(set(tanks)) < len(tanks):
        raise refusal(label, value, "be two different tanks")
    return tanks


def _curve(key, label, value, sizes):
    """Points ((x, y), ...) with increasing x, or the name of one of the key's choices."""
    if isinstance(value, str) and hyphened(value) in (key.choices or ()):
        return hyphened(value)
    is_pair = lambda point: isinstance(point, list) and len(point) == 2
    if not (isinstance(value, list) and len(value) > 1 and all(map(is_pair, value))):
        names = "".join(f'"{choice}", ' for choice in key.choices or ())
        columns = key.local_unit(sizes.units)
        raise refusal(label, value, f"be {names}or a list of points [{columns}]: {key.doc}")
    columns = [Key(key.name, unit=unit) for unit in key.unit.split(", ")]
    entry = lambda k, c, v: _number(c, f"{label} point {k + 1}", v, sizes)
    rows = enumerate(value)
    points = tuple(tuple(entry(k, c, v) for c, v in zip(columns, row)) for k, row in rows)
    if any(after[0] <= before[0] for before, after in zip(points, points[1:])):
        raise refusal(label, value, "have points whose first numbers increase")
    return points


def _of_type(key, label, value, sizes):
    if not isinstance(value, bool if key.kind == "flag" else dict):
        must = "true or false" if key.kind == "flag" else f"a table: {key.doc}"
        raise refusal(label, value, f"be {must}")
    return value


READ = {  # {kind: function (key, label, value, sizes)} that reads and checks a value of a rig file
    "number": _number,
    "reading": _number,
    "span": _span,
    "integer": _integer,
    "flag": _of_type,
    "choice": lambda key, label, value, sizes: static_value(label, value, key.meta(), str),
    "text": lambda key, label, value, sizes: name_of(label, value),
    "texts": _texts,
    "list": _list,
    "array": _array,
    "scalar": _array,
    "tank": _tank,
    "tanks": _tanks,
    "sequence": _sequence,
    "inputs": _tanks,
    "pair": _pair,
    "feed": _feed,
    "curve": _curve,
    "table": _of_type,
    "any": lambda key, label, value, sizes: value,
}


def written(key, value: Any, names: Sequence[str] = ()) -> Any:
    """Return a value as a rig file has it: tanks by their names or from 1, arrays as lists."""
    tank = lambda i: (names[i] if names else "") or i + 1
    if value is None or isinstance(value, (str, dict)) or key.kind == "any":
        return value
    if key.kind == "tank":
        return tank(value)
    if key.kind in ("sequence", "inputs"):
        return _from_one(value)
    if key.kind in ("tanks", "pair", "feed"):
        tanks = [tank(i) for i in value if i is not None]
        return tanks[0] if key.kind == "feed" and len(tanks) == 1 else tanks
    return np.asarray(value).tolist()


def _from_one(numbers):
    """Return numbers that count from 0 as those that count from 1; lists of lists too."""
    if isinstance(numbers, list | tuple) or np.ndim(numbers):
        return [_from_one(v) for v in numbers]
    return numbers + 1


def name_of(where, value):
    """`value` if it can be a name: a text of one line without control characters."""
    if not isinstance(value, str) or not value.isprintable():
        more = " of printable characters" * isinstance(value, str)
        raise refusal(where, value, f"be a text{more}")
    return value


def is_numeric(value):
    """Whether a value is a number that a float can hold, or a regular array or list of such."""
    if hasattr(value, "dtype"):  # of numpy or jax
        return np.issubdtype(value.dtype, np.number) and not isinstance(value, Tracer)
    if isinstance(value, (list, tuple)):
        try:
            return all(is_numeric(v) for v in value) and len({np.shape(v) for v in value}) <= 1
        except ValueError:  # more lists in lists than an array has dimensions
            return False
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    try:
        return float(value) is not None
    except OverflowError:
        return False


def is_finite(value, ndim=None):
    """Whether a value is numeric and every number finite; ndim: number of axes it must have."""
    # as floats: numpy's own answer to a whole number of 2^64 and more is a TypeError
    finite = is_numeric(value) and bool(np.all(np.isfinite(np.asarray(value, dtype=float))))
    return finite and ndim in (None, np.ndim(value))


def is_plain(value):
    """Whether a value is one number of Python that a float can hold."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and is_numeric(value)


def plain(name, value):
    """`value` as a float; InputError, naming it `name`, unless it is a number."""
    if not is_plain(value):
        raise refusal(name, value, "be a number")
    return float(value)


def static_value(name, value, meta, kind):
    """Return `value` for a static field of type `kind`; InputError for another, or out of range."""
    if (choices := meta["choices"]) is not None:
        good = not isinstance(value, (list, dict)) and value in choices
        if not good or isinstance(value, bool) != (kind is bool):
            names = ", ".join(str(c).lower() if isinstance(c, bool) else c for c in choices)
            raise refusal(name, value, f"be one of {names}")
        return value
    if kind is str:  # a text of which the component itself knows what it may be
        if not isinstance(value, str):
            raise refusal(name, value, "be a text")
        return value
    value = plain(name, value)
    check_value(name, value, meta)
    if kind is int and not value.is_integer():
        raise InputError(f"{name} = {value:g}: must be a whole number")
    return kind(value)


def unit(meta):
    """ " [cm]" of metadata, or nothing where there is no unit."""
    return "" if meta["unit"] == "-" else f" [{meta['unit']}]"


class Line(NamedTuple):
    """A line "name = value" of a rig file; on: False where it is a suggestion, commented out."""

    name: str
    value: Any
    meta: Mapping[str, Any]
    on: bool = True


class Block(NamedTuple):
    """A table of a rig file; prose: sentences above it; on: False where it is commented out."""

    title: str
    lines: list
    prose: tuple = ()
    on: bool = True


def lines_of(
    section: Section, values: Mapping[str, Any], units=DEFAULT, names: Sequence[str] = ()
) -> list[Line]:
    """Return the lines of a section's keys that have a value; names: those of the tanks."""
    lines = []
    for key in (key for key in section.keys if values.get(key.name) is not None):
        value, meta = values[key.name], key.meta(units)
        if key.kind == "curve" and isinstance(value, str):  # a name instead of a curve
            meta["unit"] = "-"
        lines.append(Line(key.name, written(key, value, names), meta))
    return lines


def block_of(
    section: Section, values: Mapping[str, Any], units=DEFAULT, names: Sequence[str] = ()
) -> Block:
    """Return the Block of a section with `lines_of` its values."""
    return Block(section.title, lines_of(section, values, units, names))


def terse(block: Block) -> list[str]:
    """Return the lines of a terse file: title, and "name = value  # [unit] doc" of what is on."""
    note = lambda meta: " ".join(filter(None, [unit(meta).strip(), meta["doc"]]))
    rows = [(f"{e.name} = {toml(e.value)}", note(e.meta)) for e in block.lines if e.on]
    return [block.title] * bool(block.title) + ["  # ".join(filter(None, row)) for row in rows]


def toml(value: Any) -> str:
    """Return `value` as TOML: numbers to their last digit, texts escaped, lists and tuples as
    arrays.

    Parameters
    ----------
    value : number, text, truth value, array, list, tuple or dict of such

    Returns
    -------
    Text of one line.

    Examples
    --------
    >>> toml([0.1, True, "a b"])
    '[0.1, true, "a b"]'
    """
    if isinstance(value, (np.generic, np.ndarray)):
        value = value.tolist()
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return '"' + "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in escaped) + '"'
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(toml(v) for v in value) + "]"
    if isinstance(value, dict):
        inside = ", ".join(f"{toml(k)} = {toml(v)}" for k, v in value.items())
        return f"{{ {inside} }}" if inside else "{}"
    return repr(value)

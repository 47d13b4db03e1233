"""Components, leaves and dotted names.

A component is a frozen keyword-only dataclass that JAX sees as a pytree. Each field is a leaf (a
number or an array that may be differentiated, with a unit and an allowed range), a static value
(hashable: sizes, switching times, topologies), or another
component. Dotted names reach every leaf: "controller.k1", "plant.drain[0]".

A constructor converts leaves given as lists and numbers. JAX rebuilds components without it, with
whatever a transformation carries (tracers, batches, axes, placeholders). Checks: `check_leaves`.
"""

import dataclasses
import functools
import numbers
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, TypeVar, cast, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxtank.core.errors import InputError, unknown
from jaxtank.core.units import DEFAULT, local

_STEP = re.compile(r"([A-Za-z_]\w*)((?:\[\d+(?:,\d+)*\])?)")


T = TypeVar("T")


def leaf(
    unit: str = "-",
    doc: str = "",
    *,
    low: float | None = None,
    high: float | None = None,
    strict: bool = False,
    like: str | None = None,
    default: Any = dataclasses.MISSING,
) -> Any:
    """A differentiable field: its unit, what it is, and the range in which it means something.

    low, high: allowed range, or None; strict: the value `low` itself is excluded. `like` names a
    sibling field: such a leaf may be absent (None), which costs the loop nothing, and takes the
    shape of the sibling when it is set; type checkers see that it may be left out where
    `default=None` is written beside it. default: function of {field: value} of the fields given,
    whose result a leaf has that is left out.
    """
    meta = {
        "kind": "leaf",
        "unit": unit,
        "doc": doc,
        "low": low,
        "high": high,
        "strict": strict,
        "like": like,
    }
    if callable(default):
        meta["default"] = default
    needed = like is None and default is dataclasses.MISSING
    return dataclasses.field(metadata=meta, default=dataclasses.MISSING if needed else None)


def static(
    unit: str = "-",
    doc: str = "",
    *,
    low: float | None = None,
    high: float | None = None,
    strict: bool = False,
    choices: tuple | None = None,
    default: Any = dataclasses.MISSING,
) -> Any:
    """A field that is part of the compiled program: hashable, never an array. Ranges and choices as
    in `leaf`.
    """
    meta = {
        "kind": "static",
        "unit": unit,
        "doc": doc,
        "low": low,
        "high": high,
        "strict": strict,
        "choices": choices,
    }
    return dataclasses.field(metadata=meta, default=default)


@dataclass_transform(
    kw_only_default=True, frozen_default=True, eq_default=False, field_specifiers=(leaf, static)
)
def component(cls: type[T]) -> type[T]:
    """Make `cls` a frozen keyword-only dataclass and register it with JAX: static fields are its
    metadata, the rest its data.

    The constructor converts leaves given as numbers or lists and tuples of numbers to arrays
    (`number`), and gives those that are left out their default.

    >>> from jaxtank.instruments.actuators import PumpBank
    >>> PumpBank(low=[0.0], high=[12.0]).pulse
    array([12.])
    """
    cls = dataclasses.dataclass(frozen=True, kw_only=True, eq=False)(cls)
    fields = dataclasses.fields(cast(Any, cls))
    leaves = {f.name: f.metadata.get("default") for f in fields if f.metadata.get("kind") == "leaf"}
    needed = {f.name for f in fields if f.default is f.default_factory is dataclasses.MISSING}
    construct = cast(Any, cls).__init__

    @functools.wraps(construct)
    def __init__(self, *args, **values):
        for name in leaves.keys() & values.keys():
            values[name] = _converted(values[name])
        if needed <= values.keys():  # else dataclasses name what is missing
            for name, default in leaves.items():
                if default is not None and name not in values:
                    values[name] = _converted(default(values))
        construct(self, *args, **values)

    cast(Any, cls).__init__ = __init__
    _register(
        cls,
        tuple(f.name for f in fields if f.metadata.get("kind") != "static"),
        tuple(f.name for f in fields if f.metadata.get("kind") == "static"),
    )
    return cls


def _register(cls, data, meta):
    """`jax.tree_util.register_dataclass`, which calls the constructor: its conversion must not see
    what a transformation carries, such as the axes 0 and 1 of a vmap."""
    keys = tuple(jax.tree_util.GetAttrKey(name) for name in data)

    def flatten(tree):
        values = vars(tree)
        return tuple(values[name] for name in data), tuple(values[name] for name in meta)

    def flatten_with_keys(tree):
        children, static = flatten(tree)
        return tuple(zip(keys, children)), static

    def unflatten(static, children):
        tree = object.__new__(cls)
        vars(tree).update(zip(data, children), **dict(zip(meta, static)))
        return tree

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)


def _converted(value):
    """`number(value)` of a Python number and of a list or tuple of numbers; any other as it is."""
    if type(value) in (int, float, list, tuple) and is_real(value):
        try:
            return number(value)
        except (TypeError, ValueError, OverflowError):  # traced entries, rows of several lengths
            return value
    return value


def is_component(value: Any) -> bool:
    """True for an instance of a class made by `component`."""
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def number(value: Any) -> Any:
    """`value` as a host array of the default float: the form in which constructors store leaves."""
    return np.asarray(value, dtype=np.float64)


def is_real(value: Any) -> bool:
    """Whether a value, or every entry of a list or array, is a real number: no text, truth value,
    complex number, random key or None.
    """
    if isinstance(value, list | tuple):
        return all(is_real(v) for v in value)
    kind = getattr(value, "dtype", None)
    if kind is None:
        return isinstance(value, numbers.Real) and not isinstance(value, bool)
    if kind == np.dtype(object):  # whole numbers of 2^64 and more, or anything
        return all(is_real(v) for v in np.ravel(value).tolist())
    # jnp: its own short floats too
    return jnp.issubdtype(kind, np.integer) or jnp.issubdtype(kind, np.floating)


def walk(
    tree: Any, prefix: str = "", kind: str = "leaf", units: tuple[str, str] = DEFAULT
) -> Iterator[tuple[str, Any, dict[str, Any]]]:
    """Yield (dotted name, value, metadata) of every field of `kind` ("leaf" or "static") below
    `tree`, units as the rig counts.

    A component whose fields mean what another one's do (the gains in `controllers.Scheduled`) has a
    method `metadata_of(field)` that returns what to change of the class's metadata; "rows" in it is
    the metadata of each row of an array.
    """
    units = getattr(tree, "units", units)
    for field in dataclasses.fields(tree):
        value, name = getattr(tree, field.name), f"{prefix}{field.name}"
        if is_component(value):
            yield from walk(value, f"{name}.", kind, units)
        elif field.metadata.get("kind") == kind:
            own = tree.metadata_of(field.name) if hasattr(tree, "metadata_of") else {}
            yield name, value, _localised({**field.metadata, **own}, units)


def parameters(tree: Any) -> dict[str, Any]:
    """{dotted name: value} of every leaf of a component (a loop, a plant, a law). Absent optional
    leaves are left out.
    """
    return {name: value for name, value, _ in walk(tree) if value is not None}


def describe(tree: Any, name: str) -> dict[str, Any]:
    """The metadata (unit, doc, low, high, strict) of the leaf or static field `name`; InputError if
    there is none.
    """
    base = name.split("[")[0]
    for kind in ("leaf", "static"):
        for other, _, meta in walk(tree, kind=kind):
            if other == base:
                index = split_index(name)[1] if meta.get("rows") else ()
                return meta["rows"][index[0]] if index and index[0] < len(meta["rows"]) else meta
    raise unknown("parameter", name, _all_names(tree))


def get_value(tree: Any, name: str) -> Any:
    """The value of the leaf `name`, an entry of it for "name[i]" or "name[i,j]"; InputError if
    there is none.
    """
    base, index = split_index(name)
    values = parameters(tree)
    if base in values:
        return _entry(values[base], index, name)
    if describe(tree, name)["kind"] == "leaf":
        raise InputError(
            f"{base} is not in use: give it a value first, with --set {base}=VALUE or with_values"
        )
    raise unknown("parameter", name, values)


def with_values(tree: T, values: Mapping[str, Any]) -> T:
    """A copy of `tree` with the leaves named in `values` replaced.

    values: {dotted name: number or array}; "name[i]" sets one entry, a number for an array leaf
        fills it.
    Works under jit, vmap and grad: the values may be traced. Raises InputError for an unknown name
    (with the three closest), for a value that is no real number (a text, a truth value, a complex
    number, None) and for one of the wrong shape.
    """
    for name, value in values.items():
        base, index = split_index(name)
        path = base.split(".")
        try:
            tree = _replace(tree, path, index, value, name)
        except LookupError:
            if base in [other for other, _, _ in walk(tree, kind="static")]:
                raise InputError(
                    f"{base} is no number of the loop but a part of its structure: set it with"
                    " rig.set_values"
                ) from None
            raise unknown("parameter", name, _all_names(tree)) from None
    return tree


def split_index(name: str) -> tuple[str, tuple[int, ...]]:
    """("plant.drain", (0,)) of "plant.drain[0]"; ("plant.drain", ()) without an index. InputError
    for a malformed name.
    """
    parts = name.split(".")
    last = _STEP.fullmatch(parts[-1])
    if (
        last is None
        or not all(_STEP.fullmatch(p) for p in parts)
        or any("[" in p for p in parts[:-1])
    ):
        raise InputError(
            f"{name!r} is not a parameter name: write component.field or component.field[i]"
        )
    base, bracket = last.groups()
    index = tuple(int(i) for i in bracket[1:-1].split(",")) if bracket else ()
    return ".".join([*parts[:-1], base]), index


def check_leaves(tree: Any, names: Iterable[str] | None = None, vacant: Iterable[str] = ()) -> None:
    """Raise InputError if a concrete leaf is no real number, not finite or out of its range. Traced
    leaves are passed over, and so is None of an optional leaf and of the names in `vacant`, which a
    schedule fills.
    """
    for name, value, meta in walk(tree):
        if names is not None and name not in names:
            continue
        if isinstance(value, Tracer) or (
            value is None and (meta.get("like") is not None or name in vacant)
        ):
            continue
        check_value(name, value, meta)


def check_value(name, value, meta):
    """Raise InputError unless every entry of `value` is finite and within the range in `meta`."""
    if isinstance(value, list | tuple | str):  # to jax a list is several leaves, and no array
        raise InputError(
            f"{name} = {shortened(value)}: must be a number or an array, np.array(...)"
        )
    if not is_real(value):
        raise InputError(
            f"{name} = {shortened(value)}: must be a real number or an array of real numbers"
        )
    array, low, high = np.asarray(value), meta["low"], meta["high"]
    # whole numbers of 2^64 and more are no numbers to numpy
    array = number(value) if array.dtype == object else array
    good = np.isfinite(array)
    if low is not None:
        good = good & ((array > low) if meta["strict"] else (array >= low))
    if high is not None:
        good = good & (array <= high)
    if np.all(good):
        return
    unit = "" if meta["unit"] == "-" else f" {meta['unit']}"
    index = tuple(int(i) for i in np.argwhere(~good)[0])
    entry, label = array[index], name + (f"[{','.join(map(str, index))}]" if index else "")
    if not np.isfinite(entry):
        raise InputError(f"{label} = {entry}{unit}: must be a finite number")
    if high is not None and entry > high:
        raise InputError(f"{label} = {entry:g}{unit}: must be at most {high:g}{unit}")
    raise InputError(
        f"{label} = {entry:g}{unit}: must be {'above' if meta['strict'] else 'at least'}"
        f" {low:g}{unit}"
    )


def shortened(value):
    """`value` for a message, cut where it would fill the screen."""
    try:
        text = repr(value)
    # an int of thousands of digits, or a list in a list in a list ...
    except (ValueError, RecursionError):
        return f"a {type(value).__name__} too large to print"
    text = text.replace("\n", " ")  # of an array
    return text if len(text) <= 80 else f"{text[:77]}..."


def _localised(meta, units):
    rows = {"rows": tuple(_localised(row, units) for row in meta["rows"])} if "rows" in meta else {}
    return {**meta, "unit": local(meta["unit"], units), **rows}


def _all_names(tree):
    return [name for kind in ("leaf", "static") for name, _, _ in walk(tree, kind=kind)]


def _entry(value, index, name):
    if not index:
        return value
    if len(index) != np.ndim(value) or any(i >= n for i, n in zip(index, np.shape(value))):
        raise InputError(
            f"{name!r} does not exist: {split_index(name)[0]} has shape {np.shape(value)}"
        )
    return value[index]


def _replace(tree, path, index, value, name):
    head, rest = path[0], path[1:]
    fields = {f.name: f for f in dataclasses.fields(tree)}
    if head not in fields:
        raise LookupError(name)
    child = getattr(tree, head)
    if rest:
        if not is_component(child):
            raise LookupError(name)
        return dataclasses.replace(tree, **{head: _replace(child, rest, index, value, name)})
    if is_component(child) or fields[head].metadata.get("kind") != "leaf":
        raise LookupError(name)
    like = fields[head].metadata.get("like")
    if child is None and like is not None:
        child = np.zeros(np.shape(getattr(tree, like)))
    return dataclasses.replace(tree, **{head: _fitted(child, index, value, name)})


def _fitted(old, index, value, name):
    """`value` in the shape and type of the leaf `old`; a number fills, an index sets one entry."""
    on_device = isinstance(value, jax.Array) or isinstance(old, jax.Array)
    wanted = "must be a real number" + ("" if np.ndim(old) == 0 else " or a list of real numbers")
    if not is_real(value):  # numpy would make 1 of True, 3 of "3", and drop what is imaginary
        raise InputError(f"{name} = {shortened(value)}: {wanted}")
    try:
        value = jnp.asarray(value, dtype=jnp.result_type(float)) if on_device else number(value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name} = {shortened(value)}: {wanted}") from None
    shape = np.shape(old)
    if index:
        _entry(old, index, name)
        if np.ndim(value) != 0:
            raise InputError(f"{name} takes one number, not shape {np.shape(value)}")
        # `where` with a constant mask, not `.at[].set`: a scatter inside the time loop would break
        # its compilation to one function
        mask = np.zeros(shape, dtype=bool)
        mask[index] = True
        return jnp.where(mask, value, old) if on_device else np.where(mask, value, old)
    if np.shape(value) == shape:
        return value
    if np.ndim(value) == 0:
        return jnp.broadcast_to(value, shape) if on_device else np.full(shape, value)
    wanted = (
        f"must be a number or shape {shape}"
        if shape
        else "must be one number, its decimals after a point"
    )
    raise InputError(f"{name} has shape {np.shape(value)}: {wanted}")

"""Components, and the dotted names by which every leaf is reached: "controller.k1".

A component is a frozen keyword-only dataclass that JAX sees as a pytree. Each field is a leaf (a
number or an array that may be differentiated, with a unit and an allowed range), a static value
(hashable: sizes, switching times, topologies), or another component.

A constructor converts leaves given as lists and numbers. JAX rebuilds components without it, with
whatever a transformation carries (tracers, batches, axes, placeholders). Checks of values:
`jaxtank.core.checks`.
"""

import abc
import dataclasses
import functools
import numbers
import operator
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, TypeVar, cast, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.errors import InputError, unknown
from jaxtank.core.text import shortened
from jaxtank.core.units import DEFAULT, local

_STEP = re.compile(r"([A-Za-z_]\w*)((?:\[\d+(?:,\d+)*\])?)")

T = TypeVar("T")
Meta = dict[str, Any]
Shape = tuple[str | int, ...]


def leaf(
    unit: str = "-",
    doc: str = "",
    *,
    low: float | None = None,
    high: float | None = None,
    strict: bool = False,
    shape: Shape | str = (),
    like: str | None = None,
    infinite: bool = False,
    default: Any = dataclasses.MISSING,
) -> Any:
    """Return a differentiable field of a component: a number or an array.

    Parameters
    ----------
    unit : unit of the value for a rig in centimetres and volts, "-" without one
    doc : what it is
    low, high : allowed range, or None
    strict : whether the value `low` itself is excluded
    shape : size of each axis, () for one number; of one axis alone, or of several: a number, or a
        name of what the plant counts:
        "tank", "pump", "output", "orifice", "pipe", "spill", or a sum, "tank + output". A size of
        another name ("knot") is for the component to check.
    like : name of a sibling field, or of a field in one, "model.rim". Such a leaf may be absent
        (None), which costs the loop nothing, and takes the shape of that field when it is set.
        Write `default=None` beside it, so that type checkers see that it may be left out.
    infinite : whether infinity is allowed; an entry of an absent leaf then has it
    default : function of {field: value} of the fields given, whose result a leaf has that is left
        out

    Returns
    -------
    dataclasses.Field

    Examples
    --------
    >>> @component
    ... class Tank:
    ...     area: float = leaf("cm^2", "cross-section", low=0.0, strict=True)
    >>> Tank(area=15.0).area
    array(15.)
    """
    meta: Meta = {
        "kind": "leaf",
        "unit": unit,
        "doc": doc,
        "low": low,
        "high": high,
        "strict": strict,
        "shape": (shape,) if isinstance(shape, str) else tuple(shape),
        "like": like,
    }
    if infinite:
        meta["infinite"] = True
    if callable(default):
        meta["default"] = default
    needed = like is None and default is dataclasses.MISSING
    return dataclasses.field(metadata=meta, default=dataclasses.MISSING if needed else None)


POSITIVE: dict[str, Any] = {"low": 0.0, "strict": True}  # range of a leaf that is above 0


def static(
    unit: str = "-",
    doc: str = "",
    *,
    low: float | None = None,
    high: float | None = None,
    strict: bool = False,
    choices: tuple[Any, ...] | None = None,
    default: Any = dataclasses.MISSING,
) -> Any:
    """Return a field of a component that is part of the compiled program, such as a topology.

    Parameters
    ----------
    unit, doc, low, high, strict : as in `leaf`
    choices : the values allowed, or None
    default : value of a field that is left out; hashable, never an array

    Returns
    -------
    dataclasses.Field

    Examples
    --------
    >>> @component
    ... class Filter:
    ...     order: int = static("-", "order of the filter", low=1, high=4, default=1)
    >>> Filter().order
    1
    """
    meta: Meta = {
        "kind": "static",
        "unit": unit,
        "doc": doc,
        "low": low,
        "high": high,
        "strict": strict,
        "choices": choices,
    }
    return dataclasses.field(metadata=meta, default=default)


class Role(abc.ABC):  # noqa: B024  (each role has its own abstract methods)
    """Base of the parts of a loop, whose classes are made by `component`."""

    if not TYPE_CHECKING:  # a type checker reports keywords that the class does not have

        def __init__(self, *args: Any, **values: Any) -> None:
            """Of a class that `component` has not made a dataclass."""
            name = type(self).__name__
            raise InputError(
                f"the class {name} lacks @jaxtank.component: write this line above the class"
            )


def note(default: Any) -> Any:
    """Return a field of a component that no computation reads, such as names; hashable."""
    return dataclasses.field(metadata={"kind": "note"}, default=default)


@dataclass_transform(
    kw_only_default=True,
    frozen_default=True,
    eq_default=False,
    field_specifiers=(leaf, static, note),
)
def component(cls: type[T]) -> type[T]:
    """Make a class a frozen keyword-only dataclass and a pytree of JAX.

    Static fields are metadata of the pytree; leaves and components in other fields are its data.
    The constructor converts leaves given as numbers or lists and tuples of numbers to arrays
    (`number`), and gives those that are left out their default.

    Parameters
    ----------
    cls : class with fields made by `leaf` and `static`, or annotated with another component

    Returns
    -------
    The dataclass.

    Examples
    --------
    >>> from jaxtank.instruments.actuators import PumpBank
    >>> PumpBank(low=[0.0], high=[12.0]).pulse
    array([12.])
    """
    cls = dataclasses.dataclass(frozen=True, kw_only=True, eq=False)(cls)
    fields = dataclasses.fields(cast(Any, cls))
    leaves = {f.name: f.metadata.get("default") for f in fields if f.metadata.get("kind") == "leaf"}
    needed = {f.name for f in fields if f.default is f.default_factory is dataclasses.MISSING}
    construct: Callable[..., None] = cast(Any, cls).__init__

    @functools.wraps(construct)
    def __init__(self: Any, *args: Any, **values: Any) -> None:
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
        tuple(f.name for f in fields if f.metadata.get("kind") not in ("static", "note")),
        tuple(f.name for f in fields if f.metadata.get("kind") in ("static", "note")),
    )
    return cls


def _register(cls: type[Any], data: tuple[str, ...], meta: tuple[str, ...]) -> None:
    """`jax.tree_util.register_dataclass` without a call of the constructor: its conversion must not
    see what a transformation carries, such as the axes 0 and 1 of a vmap.
    """
    keys = tuple(jax.tree_util.GetAttrKey(name) for name in data)

    def flatten(tree: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        values = cast(dict[str, Any], vars(tree))
        return tuple(values[name] for name in data), tuple(values[name] for name in meta)

    def flatten_with_keys(tree: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        children, static = flatten(tree)
        return tuple(zip(keys, children)), static

    def unflatten(static: Iterable[Any], children: Iterable[Any]) -> Any:
        tree: Any = object.__new__(cls)
        values = cast(dict[str, Any], vars(tree))
        values.update(zip(data, children), **dict(zip(meta, static)))
        return tree

    # the stubs of jax leave types of keys open
    cast(Any, jax.tree_util).register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)


def _converted(value: Any) -> Any:
    """`number(value)` of a Python number and of a list or tuple of numbers; any other unchanged."""
    if type(value) in (int, float, list, tuple) and is_real(value):
        try:
            return number(value)
        except (TypeError, ValueError, OverflowError):  # traced entries, rows of several lengths
            return value
    return value


def sizes_of_shape(shape: Shape, counts: Mapping[str, int]) -> tuple[int, ...] | None:
    """Sizes of a leaf's shape by {name: count} of a plant; None where a name is missing."""
    axes = [axis.split(" + ") if isinstance(axis, str) else [axis] for axis in shape]
    if any(isinstance(term, str) and term not in counts for axis in axes for term in axis):
        return None
    return tuple(
        sum(counts[term] if isinstance(term, str) else term for term in axis) for axis in axes
    )


def is_component(value: Any) -> bool:
    """Return whether `value` is an instance of a class made by `component`."""
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def number(value: Any) -> Any:
    """Return `value` as a host array of float64, the form in which constructors store leaves."""
    return np.asarray(value, dtype=np.float64)


def is_real(value: Any) -> bool:
    """Return whether a value, or every entry of a list or array, is a real number."""
    if isinstance(value, list | tuple):
        return all(is_real(v) for v in cast(Iterable[Any], value))
    kind = getattr(value, "dtype", None)
    if kind is None:
        return not isinstance(value, bool) and isinstance(value, numbers.Real)
    if kind == np.dtype(object):  # whole numbers of 2^64 and more, or anything
        return all(is_real(v) for v in np.ravel(value).tolist())
    # jnp: its own short floats too
    return jnp.issubdtype(kind, np.integer) or jnp.issubdtype(kind, np.floating)


def walk(
    tree: Any,
    prefix: str = "",
    kind: str = "leaf",
    units: tuple[str, str] = DEFAULT,
    carried: str = "",
    only: str | None = None,
) -> Iterator[tuple[str, Any, Meta]]:
    """Yield every field of one kind below a component, in the order of its fields; or `only` that
    of a dotted name.
    """
    units = getattr(tree, "units", units)
    for field in dataclasses.fields(tree):
        value, name = getattr(tree, field.name), f"{prefix}{field.name}"
        if is_component(value):
            if only is not None and not only.startswith(f"{name}."):
                continue
            # the unit of what a signal carries is known to the component that reads it
            unit = getattr(tree, "signal_units", {}).get(field.name, carried)
            yield from walk(value, f"{name}.", kind, units, unit, only)
        elif field.metadata.get("kind") == kind and only in (None, name):
            inside: Meta = tree.metadata_of(field.name) if hasattr(tree, "metadata_of") else {}
            if carried and inside.get("carried"):
                inside = {**inside, "unit": carried}
            yield name, value, _localised({**field.metadata, **inside}, units)


def parameters(tree: Any) -> dict[str, Any]:
    """Return every leaf of a component by its dotted name, absent optional ones left out.

    Parameters
    ----------
    tree : component: a loop, a plant, a controller

    Returns
    -------
    {dotted name: value}

    Examples
    --------
    >>> from jaxtank.signals import ramps
    >>> parameters(ramps([3.0], []))
    {'initial': array([3.]), 'targets': array([], dtype=float64), 'ramp': array(60.)}
    """
    return {name: value for name, value in _leaves(tree, "") if value is not None}


def _leaves(tree: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    """`walk` without metadata, which take most of its time."""
    for field in dataclasses.fields(tree):
        value, name = getattr(tree, field.name), f"{prefix}{field.name}"
        if is_component(value):
            yield from _leaves(value, f"{name}.")
        elif field.metadata.get("kind") == "leaf":
            yield name, value


def describe(tree: Any, name: str) -> Meta:
    """Return the metadata of a leaf or static field."""
    for kind in ("leaf", "static"):
        for _, _, meta in walk(tree, kind=kind, only=name.split("[")[0]):
            index = split_index(name)[1]
            rows, units = meta.get("rows", ()), meta.get("entry_units", ())
            if index and index[0] < len(units):
                meta = {**meta, "unit": units[index[0]]}
            return rows[index[0]] if index and index[0] < len(rows) else meta
    raise unknown("parameter", name, _all_names(tree))


def get_value(tree: Any, name: str) -> Any:
    """Return the value of a leaf, or one entry of it."""
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
    """Return a copy of a component with some leaves replaced.

    Works under jit, vmap and grad: the values may be traced.

    Parameters
    ----------
    tree : component
    values : {dotted name: number or array}; "name[i]" sets one entry, a number fills an array

    Returns
    -------
    A component of the same class

    Raises
    ------
    InputError for an unknown name (with the three closest), for a value that is no real number (a
    text, a truth value, a complex number, None) and for one of the wrong shape.

    Examples
    --------
    >>> from jaxtank.instruments import LevelSensor
    >>> with_values(LevelSensor(noise=[0.1, 0.2]), {"noise[0]": 0.3}).noise
    array([0.3, 0.2])
    """
    for name, value in values.items():
        base, index = split_index(name)
        try:
            tree = _replace(tree, base.split("."), index, value, name)
        except LookupError:
            if base in [other for other, _, _ in walk(tree, kind="static")]:
                raise InputError(
                    f"{base} is no number of the loop but a part of its structure: set it with"
                    " rig.set_values"
                ) from None
            raise unknown("parameter", name, _all_names(tree)) from None
    return tree


def with_entries(tree: T, functions: Iterable[tuple[str, Callable[[Any], Any]]]) -> T:
    """Return a component with entries such as "drain[1]" replaced by functions of them, one after
    the other; their leaves become tuples of numbers."""
    leaves: dict[str, list[Any]] = {}
    for name, function in functions:
        field, (index,) = split_index(name)
        whole: Any = getattr(tree, field)
        entries = leaves.setdefault(field, [whole[i] for i in range(len(whole))])
        entries[index] = function(entries[index])
    values = {field: tuple(entries) for field, entries in leaves.items()}
    return cast(T, dataclasses.replace(cast(Any, tree), **values))


def split_index(name: str) -> tuple[str, tuple[int, ...]]:
    """Return a dotted name without its index, and the index."""
    parts = name.split(".")
    last = _STEP.fullmatch(parts[-1])
    if (
        last is None
        or not all(_STEP.fullmatch(p) for p in parts)
        or any("[" in p for p in parts[:-1])
    ):
        raise InputError(
            f"{name!r} is not a parameter name: write component.field, component.field[i] or, of a"
            " matrix, component.field[i,j]"
        )
    base, bracket = last.groups()
    index = tuple(int(i) for i in bracket[1:-1].split(",")) if bracket else ()
    return ".".join([*parts[:-1], base]), index


def _localised(meta: Meta, units: tuple[str, str]) -> Meta:
    """Return `meta` with its unit and those of its rows and entries in the units of a rig."""
    more: Meta = {}
    if "rows" in meta:
        more["rows"] = tuple(_localised(row, units) for row in meta["rows"])
    if "entry_units" in meta:
        more["entry_units"] = tuple(local(unit, units) for unit in meta["entry_units"])
    return {**meta, "unit": local(meta["unit"], units), **more}


def _all_names(tree: Any) -> list[str]:
    return [name for kind in ("leaf", "static") for name, _, _ in walk(tree, kind=kind)]


def _entry(value: Any, index: tuple[int, ...], name: str) -> Any:
    if not index:
        return value
    if len(index) != np.ndim(value) or any(i >= n for i, n in zip(index, np.shape(value))):
        raise InputError(
            f"{name!r} does not exist: {split_index(name)[0]} has shape {np.shape(value)}"
        )
    return value[index]


def _replace(tree: T, path: list[str], index: tuple[int, ...], value: Any, name: str) -> T:
    """`tree` with the leaf at the end of `path` replaced; LookupError where there is none."""
    head, further = path[0], path[1:]
    fields = {f.name: f for f in dataclasses.fields(cast(Any, tree))}
    if head not in fields:
        raise LookupError(name)
    child = getattr(tree, head)
    if further:
        if not is_component(child):
            raise LookupError(name)
        new = _replace(child, further, index, value, name)
    else:
        if is_component(child) or fields[head].metadata.get("kind") != "leaf":
            raise LookupError(name)
        like = fields[head].metadata.get("like")
        if child is None and like is not None:
            absent = np.inf if fields[head].metadata.get("infinite") else 0.0
            # of a pair that comes together it is absent too
            sibling: Any = operator.attrgetter(like)(tree)
            child = np.full(np.shape(value if sibling is None else sibling), absent)
        new = _fitted(child, index, value, name)
    return cast(T, dataclasses.replace(cast(Any, tree), **{head: new}))


def _fitted(old: Any, index: tuple[int, ...], value: Any, name: str) -> Any:
    """`value` in the shape and type of the leaf `old`; a number fills, an index sets one entry."""
    entries: list[Any] = [old, value]
    if isinstance(value, list | tuple):  # of traced numbers, too
        entries += jax.tree.leaves(cast(Any, value))
    on_device = any(isinstance(v, jax.Array) for v in entries)
    value = _real(old, value, name, on_device)
    shape = np.shape(old)
    if index:
        _entry(old, index, name)
        if np.ndim(value) != 0:
            raise InputError(f"{name} takes one number, not shape {np.shape(value)}")
        # `where` with a constant mask, not `.at[].set`: a scatter inside the time loop would break
        # its compilation to one function
        mask = np.zeros(shape, dtype=bool)
        mask[index] = True
        where: Any = jnp.where if on_device else np.where
        return where(mask, value, old)
    if np.shape(value) == shape:
        return value
    if np.ndim(value) == 0:
        return jnp.broadcast_to(value, shape) if on_device else np.full(shape, value)
    expected = (
        f"must be a number or shape {shape}"
        if shape
        else "must be one number, its decimals after a point"
    )
    raise InputError(f"{name} has shape {np.shape(value)}: {expected}")


def _real(old: Any, value: Any, name: str, on_device: bool) -> Any:
    """`value` as an array of floats; InputError for what is no real number."""
    try:
        if is_real(value):  # numpy would make 1 of True, 3 of "3", and drop what is imaginary
            return (
                cast(Any, jnp).asarray(value, dtype=jnp.result_type(float))
                if on_device
                else number(value)
            )
    except (TypeError, ValueError, OverflowError):
        pass
    expected = "must be a real number" + ("" if np.ndim(old) == 0 else " or a list of real numbers")
    raise InputError(f"{name} = {shortened(value)}: {expected}")

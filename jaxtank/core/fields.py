"""Components and their fields: frozen dataclasses that JAX sees as pytrees.

Part of `jaxtank.core.tree`, through which other folders import it.
"""

import dataclasses
import functools
import numbers
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar, cast, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np

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
    shape: Shape = (),
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
    shape : size of each axis, () for one number: a number, or a name of what the plant counts:
        "tank", "pump", "output", "orifice", "pipe", "spill", or a sum, "tank + output". A size of
        another name ("knot") is for the component to check.
    like : name of a sibling field. Such a leaf may be absent (None), which costs the loop nothing,
        and takes the shape of the sibling when it is set. Write `default=None` beside it, so that
        type checkers see that it may be left out.
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
        "shape": tuple(shape),
        "like": like,
    }
    if infinite:
        meta["infinite"] = True
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


@dataclass_transform(
    kw_only_default=True, frozen_default=True, eq_default=False, field_specifiers=(leaf, static)
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
        tuple(f.name for f in fields if f.metadata.get("kind") != "static"),
        tuple(f.name for f in fields if f.metadata.get("kind") == "static"),
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
    """`number(value)` of a Python number and of a list or tuple of numbers; any other as it is."""
    if type(value) in (int, float, list, tuple) and is_real(value):
        try:
            return number(value)
        except (TypeError, ValueError, OverflowError):  # traced entries, rows of several lengths
            return value
    return value


def sizes_of_shape(shape: Shape, counts: Mapping[str, int]) -> tuple[int, ...] | None:
    """Return the sizes of a leaf's shape for {name: count} of a plant; None where one of its names
    is not in it.
    """
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

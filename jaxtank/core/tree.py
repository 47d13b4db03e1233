"""Components, and the dotted names by which every leaf is reached: "controller.k1".

A component is a frozen keyword-only dataclass that JAX sees as a pytree. Each field is a leaf (a
number or an array that may be differentiated, with a unit and an allowed range), a static value
(hashable: sizes, switching times, topologies), or another component.

A constructor converts leaves given as lists and numbers. JAX rebuilds components without it, with
whatever a transformation carries (tracers, batches, axes, placeholders). Checks of values:
`jaxtank.core.checks`.
"""

import dataclasses
import re
from collections.abc import Iterator, Mapping
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.errors import InputError, unknown
from jaxtank.core.fields import (
    Meta,
    component,
    is_component,
    is_real,
    leaf,
    number,
    sizes_of_shape,
    static,
)
from jaxtank.core.text import shortened
from jaxtank.core.units import DEFAULT, local

__all__ = [
    "component",
    "describe",
    "get_value",
    "is_component",
    "is_real",
    "leaf",
    "number",
    "parameters",
    "sizes_of_shape",
    "split_index",
    "static",
    "walk",
    "with_values",
]

_STEP = re.compile(r"([A-Za-z_]\w*)((?:\[\d+(?:,\d+)*\])?)")

T = TypeVar("T")


def walk(
    tree: Any, prefix: str = "", kind: str = "leaf", units: tuple[str, str] = DEFAULT
) -> Iterator[tuple[str, Any, Meta]]:
    """Yield every field of one kind below a component, in the order of its fields."""
    units = getattr(tree, "units", units)
    for field in dataclasses.fields(tree):
        value, name = getattr(tree, field.name), f"{prefix}{field.name}"
        if is_component(value):
            yield from walk(value, f"{name}.", kind, units)
        elif field.metadata.get("kind") == kind:
            own: Meta = tree.metadata_of(field.name) if hasattr(tree, "metadata_of") else {}
            yield name, value, _localised({**field.metadata, **own}, units)


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
    return {name: value for name, value, _ in walk(tree) if value is not None}


def describe(tree: Any, name: str) -> Meta:
    """Return the metadata of a leaf or static field."""
    base = name.split("[")[0]
    for kind in ("leaf", "static"):
        for other, _, meta in walk(tree, kind=kind):
            if other == base:
                index = split_index(name)[1] if meta.get("rows") else ()
                return meta["rows"][index[0]] if index and index[0] < len(meta["rows"]) else meta
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
    """Return a dotted name without its index, and the index."""
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


def _localised(meta: Meta, units: tuple[str, str]) -> Meta:
    """`meta` with its unit, and those of its rows, in the units of a rig."""
    rows = {"rows": tuple(_localised(row, units) for row in meta["rows"])} if "rows" in meta else {}
    return {**meta, "unit": local(meta["unit"], units), **rows}


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
            child = np.full(np.shape(getattr(tree, like)), absent)
        new = _fitted(child, index, value, name)
    return cast(T, dataclasses.replace(cast(Any, tree), **{head: new}))


def _fitted(old: Any, index: tuple[int, ...], value: Any, name: str) -> Any:
    """`value` in the shape and type of the leaf `old`; a number fills, an index sets one entry."""
    on_device = isinstance(value, jax.Array) or isinstance(old, jax.Array)
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
    wanted = "must be a real number" + ("" if np.ndim(old) == 0 else " or a list of real numbers")
    raise InputError(f"{name} = {shortened(value)}: {wanted}")

"""Input validation of leaves: real, finite and within their ranges; calls of a user's methods."""

import contextlib
import math
from collections.abc import Collection, Generator, Mapping
from typing import Any, cast

import jax
import numpy as np
from jax.core import Tracer

from jaxtank.core.errors import InputError
from jaxtank.core.text import count, shortened
from jaxtank.core.tree import is_real, number, walk

NOT_TRACEABLE = (  # errors of jax if a program uses the number of a traced value
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)
TRACEABLE = (
    "jax cannot trace it, because no value of a run is known while it is compiled: write jnp.where"
    " instead of if, jnp.maximum instead of max(), and functions of jax.numpy instead of float() or"
    " numpy"
)

SMALL = 16  # largest size of an array that is checked number by number


@contextlib.contextmanager
def traceable(label: str) -> Generator[None, None, None]:
    """Raise InputError, beginning with `label`, where the block needs the number of a tracer."""
    try:
        yield
    except NOT_TRACEABLE as error:
        raise InputError(f"{label}: {TRACEABLE} ({type(error).__name__})") from error


def check_leaves(
    tree: Any, names: Collection[str] | None = None, vacant: Collection[str] = ()
) -> None:
    """Check the concrete leaves of a component; traced ones are passed over."""
    for name, value, meta in walk(tree):
        if names is not None and name not in names:
            continue
        if isinstance(value, Tracer) or (
            value is None and (meta.get("like") is not None or name in vacant)
        ):
            continue
        check_value(name, value, meta)


def check_value(name: str, value: Any, meta: Mapping[str, Any]) -> None:
    """Check that every entry of a value is real, finite and within its range."""
    if _is_good(value, meta):
        return
    if isinstance(value, list | tuple | str):  # to jax a list is several leaves, and no array
        raise InputError(
            f"{name} = {shortened(cast(Any, value))}: must be a number or an array, np.array(...)"
        )
    if not is_real(value):
        raise InputError(
            f"{name} = {shortened(value)}: must be a real number or an array of real numbers"
        )
    array: np.ndarray[Any, Any] = np.asarray(value)
    low, high = meta["low"], meta["high"]
    # whole numbers of 2^64 and more are no numbers to numpy
    array = number(value) if array.dtype == object else array
    good = ~np.isnan(array) if meta.get("infinite") else np.isfinite(array)
    if low is not None:
        good = good & ((array > low) if meta["strict"] else (array >= low))
    if high is not None:
        good = good & (array <= high)
    if np.all(good):
        return
    index = tuple(int(i) for i in np.argwhere(~good)[0])
    raise InputError(_out_of_range(name, array[index], index, meta))


def _is_good(value: Any, meta: Mapping[str, Any]) -> bool:
    """True for a small good float64 array, by plain numbers in a third of the time."""
    if type(value) is not np.ndarray or value.dtype != np.float64 or value.size > SMALL:
        return False
    low, high = meta["low"], meta["high"]
    low, high = -math.inf if low is None else low, math.inf if high is None else high
    numbers: list[float] = value.ravel().tolist()
    if meta["strict"]:
        return all(low < v <= high and math.isfinite(v) for v in numbers)
    return all(low <= v <= high and math.isfinite(v) for v in numbers)


def _out_of_range(name: str, entry: Any, index: tuple[int, ...], meta: Mapping[str, Any]) -> str:
    """The message for an entry that is not finite or out of range."""
    unit = "" if meta["unit"] == "-" else f" {meta['unit']}"
    label = name + (f"[{','.join(map(str, index))}]" if index else "")
    if np.isnan(entry) or (np.isinf(entry) and not meta.get("infinite")):
        return f"{label} = {entry}{unit}: must be a finite number"
    if meta["high"] is not None and entry > meta["high"]:
        return f"{label} = {entry:g}{unit}: must be at most {meta['high']:g}{unit}"
    bound = "above" if meta["strict"] else "at least"
    why = f", {meta['why']}" if "why" in meta else ""
    return f"{label} = {entry:g}{unit}: must be {bound} {meta['low']:g}{unit}{why}"


def allowed(meta: Mapping[str, Any], value: Any = 0.0) -> str:
    """Return the range in `meta` in words, "above 0" for one; value: whether numbers are whole."""
    if meta.get("choices") is not None:
        return " or ".join(
            str(c).lower() if isinstance(c, bool) else f'"{c}"' for c in meta["choices"]
        )
    low, high = meta.get("low"), meta.get("high")
    above = "" if low is None else f"{'above' if meta['strict'] else 'at least'} {low:.10g}"
    below = "" if high is None else f"at most {high:.10g}"
    integer = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    integer = integer and meta.get("kind") not in ("tank", "feed")  # by name too
    return ", ".join(filter(None, ["whole number" if integer else "", above, below]))


def check_order(
    name: str, part: Any, lower: str, upper: str, unit: str, equal: bool = False
) -> None:
    """Check that each entry of a leaf is below the entry of another; traced leaves are skipped."""
    a, b = getattr(part, lower), getattr(part, upper)
    if any(isinstance(v, Tracer) for v in jax.tree.leaves((a, b))):
        return
    pairs: list[tuple[float, float]] = list(zip(np.ravel(a).tolist(), np.ravel(b).tolist()))
    for i, (low, high) in enumerate(pairs):
        if not (low <= high if equal else low < high):
            most = "at most" if equal else "below"
            raise InputError(
                f"{name}.{lower}[{i}] = {low:g} {unit}: must be {most} {name}.{upper}[{i}] ="
                f" {high:g} {unit}"
            )


def check_each(label: str, values: Any, size: int, what: str, scalar: bool = True) -> None:
    """Raise InputError unless a method returned one real number for each of `size` tanks.

    scalar: one each, not an array of several runs.
    """
    several = isinstance(values, tuple | list)
    entries: list[Any] = list(cast(Any, values)) if several else []
    sizes = (len(entries),) if several else np.shape(values)[:1]
    shapes = [np.shape(v) for v in entries] or [np.shape(values)[1:]]
    if sizes == (size,) and not (scalar and any(shapes)) and all(map(is_real, entries or [values])):
        return
    words = count(sizes[0], what) if sizes else "no tuple of numbers"
    if sizes == (size,):
        words = f"a {what} that is no single real number"
    raise InputError(
        f"{label} returns {words}: must return one real number for each of {count(size, 'tank')}"
    )


def check_choice(name: str, value: Any, choices: Collection[str]) -> None:
    """Raise InputError unless `value` is one of the choices."""
    if value not in choices:
        raise InputError(f"{name} = {value!r}: must be one of {', '.join(choices)}")


def check_whole(
    name: str, value: Any, low: int, high: int | None = None, *, optional: bool = False
) -> None:
    """Raise InputError unless `value` is a whole number from `low` to `high`, or may be None."""
    if optional and value is None:
        return
    whole: Any = (int, np.integer)
    good = isinstance(value, whole) and not isinstance(value, bool) and value >= low
    if not good or (high is not None and value > high):
        ends = f"of at least {low}" if high is None else f"from {low} to {high}"
        raise InputError(f"{name} = {value!r}: must be a whole number {ends}")

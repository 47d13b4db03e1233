"""Operations on the entries of large arrays as loops over them."""

import math

import numpy as np

from jaxtank.export.simplify import is_number, simplified
from jaxtank.export.statements import REAL, Each, Ref, View

LOOPED = 16  # operations on single entries from which one on arrays is a loop

FEW = 12
"""Largest number of places from which a small array is filled; of more, its entries are listed."""


def filled(shape, f):
    """Return an array of objects f(index)."""
    out = np.empty(shape, dtype=object)
    for i in np.ndindex(out.shape):
        out[i] = f(i)
    return out


def elements_of(name, shape):
    """Return the elements, row by row, of the array `name`."""
    return filled(math.prod(shape), lambda i: Ref(name, *i)).reshape(shape)


def each(writer, kind, op, operands, kinds):
    """Return op of the elements of arrays of these kinds, broadcast against each other."""
    operands = np.broadcast_arrays(*operands)
    if writer.loops and operands[0].size >= LOOPED:
        elements = zip(*(o.ravel() for o in operands))
        different = {tuple((type(a), a) for a in args) for args in elements}
        count = sum(simplified(op, [a for _, a in args]) is None for args in different)
        if count >= LOOPED:
            views = tuple(view_of(writer, o, k) for o, k in zip(operands, kinds))
            return looped(writer, kind, operands[0].shape, op, views)
    return filled(operands[0].shape, lambda i: writer.define(kind, op, *(o[i] for o in operands)))


def looped(writer, kind, shape, op, views, over=()):
    """Return the elements of an `Each` statement."""
    key = op, shape, views, over
    name = next((scope[key] for scope in writer.known if key in scope), None)
    if name is None:
        name = writer.known[-1][key] = writer.new_array(math.prod(shape))
        writer.scopes[-1].append(Each(kind, name, shape, op, views, over))
    return elements_of(name, shape)


def reduced(writer, kind, op, rows, axes, of):
    """Return op over the last `axes` axes of `rows`, an array of kind `of`, in a loop."""
    shape, over = rows.shape[: rows.ndim - axes], rows.shape[rows.ndim - axes :]
    return looped(writer, kind, shape, op, (view_of(writer, rows, of),), over)


def place_of(writer, array):
    """Return (name, offset, strides) of elements at regular places of one array, else None."""
    first = array.flat[0]
    if getattr(first, "name", None) not in writer.sizes:
        return None
    if any(not isinstance(e, Ref) or e.name != first.name for e in array.flat):
        return None
    index = np.array([e.index for e in array.flat]).reshape(array.shape)
    offset = int(index.flat[0])
    seconds = [index.take(min(1, n - 1), axis=k).flat[0] for k, n in enumerate(array.shape)]
    strides = tuple(int(second) - offset for second in seconds)
    grid = np.indices(array.shape).reshape(array.ndim, -1)
    regular = np.array_equal(np.array(strides, int) @ grid + offset, index.ravel())
    return (first.name, offset, strides) if regular else None


def view_of(writer, array, kind):
    """Return an array as the argument of an `Each`."""
    if _same(array, array.ravel()[:1]):
        return array.flat[0]
    place = place_of(writer, array)
    if place is not None:
        return View(*place)
    once = array
    for d in range(array.ndim):  # an axis along which the array repeats itself
        head = once.take([0], axis=d)
        once = head if _same(once, head) else once
    strides = zip(once.shape, row_by_row(once.shape))
    return View(writer.array(once, kind), 0, tuple(0 if n == 1 else s for n, s in strides))


def _same(array, other):
    """Whether the elements of two arrays, which are broadcast, are the same."""
    pairs = zip(*map(np.ravel, np.broadcast_arrays(array, other)))
    return all(type(a) is type(b) and a == b for a, b in pairs)


def row_by_row(shape):
    """Return the strides of an array that is stored row by row."""
    return tuple(math.prod(shape[d + 1 :]) for d in range(len(shape)))


def copied(writer, kind, array):
    """Return the name of a new array with the elements of another, row by row."""
    name = writer.new_array(array.size)
    views = (view_of(writer, array, kind),)
    writer.scopes[-1].append(Each(kind, name, array.shape, "same", views))
    return name


def part_of(writer, kind, name, offset, shape):
    """Return the elements of the part of an array from `offset`, a variable, on."""
    if kind == REAL and math.prod(shape) == 1:
        return filled(shape, lambda _: writer.define(REAL, "item", Ref(name), offset))
    return looped(writer, kind, shape, "same", (View(name, offset, row_by_row(shape)),))


def put(writer, kind, name, offset, array):
    """Return the new name of the array `name` after `array` is written into it."""
    view = view_of(writer, array, kind)
    return _put_view(writer, kind, name, offset, array.shape, view, ())


def _put_view(writer, kind, name, offset, shape, view, steps):
    new = writer.fresh("l")
    writer.sizes[new] = writer.sizes[name]
    statement = Each(kind, new, shape, "same", (view,), (), name, offset, tuple(steps))
    writer.scopes[-1].append(statement)
    return new


def gathered(writer, kind, array):
    """Return the name of an array that loops fill from regular places; None where they are many."""
    if all(map(is_number, array.flat)):
        return None
    groups = _sources(writer, array)
    zeros = groups.pop((float, "0.0"), None)
    if len(groups) > max(FEW, array.size // LOOPED):
        return None
    views = []
    for e, entry, rows in groups.values():
        block = affine(np.array(rows))
        if block is None:
            return None
        strides = tuple(stride for _, stride in block[2])
        views.append((View(e.name, block[1][1], strides) if entry else e, *block))
    name = writer.new_array(array.size)
    if len(views) == 1 and zeros is None:
        view, shape, *_ = views[0]
        writer.scopes[-1].append(Each(kind, name, shape, "same", (view,)))
        return name
    writer.scopes[-1].append(Each(kind, name, (array.size,), "same", (0.0,)))
    for view, shape, (offset, _), strides in views:
        name = _put_view(writer, kind, name, offset, shape, view, [d for d, _ in strides])
    return copied(writer, kind, elements_of(name, array.shape))


def _sources(writer, array):
    """{array or number: (first element, whether it is an entry of an array, (place, index)s)}."""
    groups = {}
    for place, e in enumerate(array.ravel()):
        entry = isinstance(e, Ref) and e.name in writer.sizes and not isinstance(e.index, Ref)
        key = ("entry", e.name) if entry else (type(e), repr(e))  # repr: -0.0 is not 0.0
        groups.setdefault(key, (e, entry, []))[-1].append((place, e.index if entry else 0))
    return groups


def affine(rows):
    """Return (shape, first row, strides) of rows of numbers that counters give, None for others."""
    first, shape, strides = tuple(map(int, rows[0])), [], []
    while len(rows) > 1:
        step = rows[1] - rows[0]
        breaks = np.flatnonzero((np.diff(rows, axis=0) != step).any(axis=1))
        count = int(breaks[0]) + 1 if len(breaks) else len(rows)
        blocks = rows.reshape(-1, count, 2) if len(rows) % count == 0 else None
        if blocks is None or (blocks - blocks[:, :1] != blocks[0] - blocks[0, 0]).any():
            return None
        shape.append(count)
        strides.append(tuple(map(int, step)))
        rows = blocks[:, 0]
    return tuple(shape[::-1]) or (1,), first, strides[::-1] or [(0, 0)]


def whole_of(writer, kind, array, changing=()):
    """Return the name of an array with exactly the elements of another, none of `changing`."""
    place = place_of(writer, array) if array.ndim else None
    if place is not None:
        name, offset, strides = place
        regular = tuple(s if n > 1 else 0 for n, s in zip(array.shape, row_by_row(array.shape)))
        exact = writer.sizes[name] == array.size and (offset, strides) == (0, regular)
        if exact and name not in changing:
            return name
    return copied(writer, kind, array)

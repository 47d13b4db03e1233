"""Arrays of regular places are filled by loops, with the entries that they had."""

import math

import numpy as np
import pytest

from jaxtank.core.errors import InputError
from jaxtank.export.arrays import affine, each, elements_of, filled
from jaxtank.export.lowering import REAL, Writer, product
from jaxtank.export.simplify import simplified
from jaxtank.export.statements import Array, Each, Ref, View, array_kinds

SOURCES = {"m1": np.arange(900.0), "m2": -np.arange(300.0)}
NUMBERS = {"v3": 7.5, "v4": -2.5}


def value_of(e):
    """The value of an entry of an array."""
    if not isinstance(e, Ref):
        return e
    return NUMBERS[e.name] if e.index is None else SOURCES[e.name][e.index]


def entries_after(statements, name):
    """The entries of an array after statements, by the definition of an `Each`."""
    arrays = dict(SOURCES)
    for s in statements:
        assert isinstance(s, Each) and s.op == "same" and not s.over
        (argument,) = s.args
        if s.array:
            arrays[s.name] = arrays[s.array]
        else:
            arrays[s.name] = np.full(math.prod(s.shape), np.nan)
        steps = s.steps or [math.prod(s.shape[d + 1 :]) for d in range(len(s.shape))]
        for counters in np.ndindex(*s.shape):
            if isinstance(argument, View):
                source = argument.offset + int(np.dot(argument.strides, counters))
                value = arrays[argument.name][source]
            else:
                value = value_of(argument)
            arrays[s.name][s.offset + int(np.dot(steps, counters))] = value
    return arrays[name]


def padded(block, rows, columns):
    """A block in the corner of an array of zeros."""
    out = np.full((rows, columns), 0.0, dtype=object)
    out[: block.shape[0], : block.shape[1]] = block
    return out


A, B = elements_of("m1", (30, 30)), elements_of("m2", (300,))
DIAGONAL = np.full((12, 12), 0.0, dtype=object)
np.fill_diagonal(DIAGONAL, B[::25])
STRIPED = filled((8, 10), lambda _: Ref("v3"))
STRIPED[:, ::2], STRIPED[:, 9] = A[:8, :5], -0.0
ARRAYS = {
    "every second row": A[::2],
    "transposed": A[:10, :6].T.copy(),
    "twice strided": A.reshape(10, 3, 30)[:, 0, ::5].T.copy(),
    "padded": padded(A[:9, :9], 13, 11),
    "on a diagonal": DIAGONAL,
    "striped with a variable": STRIPED,
    "of two arrays": np.stack([A[0], B[:30]], axis=1),
    "ones": np.concatenate([np.full(40, 1.0, dtype=object), A[3]]),
}


@pytest.mark.parametrize("name", ARRAYS)
def test_an_array_of_regular_places_is_filled_by_loops(name):
    entries, writer = ARRAYS[name], Writer(loops=True)
    writer.sizes.update({n: len(v) for n, v in SOURCES.items()})
    writer.counter = 10
    array = writer.array(entries)
    statements = writer.scopes[0]
    expected = np.array([value_of(e) for e in entries.ravel()])
    got = entries_after(statements, array)
    assert np.array_equal(got.view(np.uint64), expected.view(np.uint64))  # and -0.0 stays -0.0
    assert array_kinds(statements)[array].size == entries.size
    assert writer.sizes[array] == entries.size


def test_an_array_of_irregular_places_is_listed():
    writer = Writer(loops=True)
    writer.sizes.update({n: len(v) for n, v in SOURCES.items()})
    places = np.random.default_rng(0).permutation(300)
    writer.array(B[places])
    (statement,) = writer.scopes[0]
    assert isinstance(statement, Array) and statement.entries == tuple(B[places])


@pytest.mark.parametrize("shape", [(7,), (3, 4), (2, 3, 4)])
def test_counters_of_rows_of_numbers_are_found(shape):
    strides = [(5 + 11 * d, 2 - 40 * d) for d in range(len(shape))]
    rows = [(3, 200) + np.array(c) @ np.array(strides) for c in np.ndindex(*shape)]
    counts, first, steps = affine(np.array(rows))
    again = [np.array(first) + np.array(c) @ np.array(steps) for c in np.ndindex(*counts)]
    assert np.array_equal(again, rows)
    assert affine(np.array([*rows, (0, 0)])) is None


def test_one_operation_on_a_large_array_is_a_loop():
    writer = Writer(loops=True)
    writer.sizes.update({n: len(v) for n, v in SOURCES.items()})
    negated = each(writer, REAL, "neg", (B[:40],), (REAL,))
    (statement,) = writer.scopes[0]
    assert isinstance(statement, Each) and statement.op == "neg" and negated.shape == (40,)


def test_stacks_of_matrices_have_no_code():
    stack = np.ones((2, 3, 3))
    with pytest.raises(InputError):
        product(Writer(), stack, stack, (((2,), (1,)), ((0,), (0,))))
    assert product(Writer(), np.eye(2), np.eye(2), (((1,), (0,)), ((), ()))).shape == (2, 2)


@pytest.mark.parametrize(("args", "result"), [((1.0, 0), 0), ((0, 1.0), 0), ((2.0, 0), None)])
def test_only_a_factor_of_1_is_left_out(args, result):
    variable = Ref("v3")
    operands = [variable if a == 0 else a for a in args]
    assert simplified("mul", operands) == (variable if result == 0 else None)
    assert simplified("mul", operands[::-1]) == (variable if result == 0 else None)

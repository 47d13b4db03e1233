"""From a traced function to statements on scalars, which a printer turns into a language."""
# Every element of an array becomes a `Ref` or a number. What only moves elements (slices,
# broadcasts) costs nothing, what depends on constants alone is computed here, and what is not used
# is left out. Loops (scan, while_loop) and products of large matrices stay loops.

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal

from jaxtank.core.errors import InputError
from jaxtank.export import arrays
from jaxtank.export.arrays import elements_of, filled
from jaxtank.export.simplify import FUNCTIONS, OPERATORS, is_number, simplified
from jaxtank.export.statements import (
    REAL,
    TRUTH,
    WHOLE,
    Array,
    Define,
    Loop,
    Matrix,
    Ref,
    Store,
    Until,
    Vector,
    names,
    used,
)
from jaxtank.xla.hoist import bind

REDUCTIONS = {"sum": "add", "prod": "mul", "max": "max", "min": "min", "and": "and", "or": "or"}
"""{what reduces an array: the operation on two of its elements}."""

TRUTHS = {"lt", "le", "gt", "ge", "eq", "ne", "and", "or", "not", "is_finite"}
"""Operations whose result is true or false."""


def no_code(reason):
    """Return the InputError for a controller that cannot be exported."""
    return InputError(f"this controller cannot be exported: {reason}")


def kind_of(dtype):
    """Return the kind of variable, REAL, WHOLE or TRUTH, that holds an element of this type."""
    return REAL if jnp.issubdtype(dtype, jnp.floating) else TRUTH if dtype == jnp.bool_ else WHOLE


def elements(value):
    """Return the numbers of an array as Python numbers, in an array of objects."""
    return np.asarray(value).astype(object)


def each(f, *operands):
    """Return f of the elements of arrays, which are broadcast against each other."""
    operands = np.broadcast_arrays(*operands)
    return filled(operands[0].shape, lambda i: f(*(a[i] for a in operands)))


def constant(eqn, operands):
    """Return the result of an operation on numbers, computed by jax."""
    name = eqn.primitive.name
    if name in PLACED:
        return _move(None, eqn, operands)
    values = [o.astype(v.aval.dtype) for o, v in zip(operands, eqn.invars)]
    if name == "convert_element_type":
        return [elements(values[0].astype(eqn.outvars[0].aval.dtype))]
    with jax.ensure_compile_time_eval():
        return [elements(v) for v in bind(eqn, map(jnp.asarray, values))]


def _kinds(eqn):
    """The kinds of the operands."""
    return [kind_of(v.aval.dtype) for v in eqn.invars]


def _out_kind(eqn):
    return kind_of(eqn.outvars[0].aval.dtype)


def _elementwise(op, whole=None):
    """The rule of an operation on one element of each operand, `whole` on whole numbers."""

    def rule(writer, eqn, operands):
        kind = TRUTH if op in TRUTHS else _out_kind(eqn)
        if eqn.primitive.name == "xor" and _out_kind(eqn) != TRUTH:
            raise no_code("it uses the operation xor of whole numbers")
        name = whole or op if kind == WHOLE else op
        return [arrays.each(writer, kind, name, operands, _kinds(eqn))]

    return rule


def _convert(writer, eqn, operands):
    kind, kinds = _out_kind(eqn), _kinds(eqn)
    return operands if kinds[0] == kind else [arrays.each(writer, kind, kind, operands, kinds)]


def _broadcast(x, shape, broadcast_dimensions, **_):
    """`x` with its axes at `broadcast_dimensions` of `shape`, repeated along the others."""
    sizes = [1] * len(shape)
    for axis, size in zip(broadcast_dimensions, x.shape):
        sizes[axis] = size
    return np.broadcast_to(x.reshape(sizes), shape)


PLACED = {  # moves of one array, by numpy: jax takes half a second for those of a loop
    "squeeze": lambda x, dimensions: np.squeeze(x, dimensions),
    "slice": lambda x, start_indices, limit_indices, strides: x[
        tuple(map(slice, start_indices, limit_indices, strides or (1,) * x.ndim))
    ],
    "broadcast_in_dim": _broadcast,
}


def _move(writer, eqn, operands):
    """The elements that an operation only moves, found by moving their numbers."""
    if eqn.primitive.name in PLACED:
        return [PLACED[eqn.primitive.name](operands[0], **eqn.params)]
    table, ids = [], []
    for o, v in zip(operands, eqn.invars):
        if v in eqn.invars[INDICES.get(eqn.primitive.name, slice(0))]:
            if not all(map(is_number, o.ravel())):
                raise no_code("it reads an array at an index that it computes")
            ids.append(o.astype(v.aval.dtype))
            continue
        ids.append(np.arange(len(table), len(table) + o.size, dtype=np.int64).reshape(o.shape))
        table += list(o.ravel())
    with jax.ensure_compile_time_eval():
        outs = bind(eqn, map(jnp.asarray, ids))
    return [each(lambda i: table[int(i)], np.asarray(v)) for v in outs]


def _gather(writer, eqn, operands):
    """The rows of an array at indices that are computed, or elements that are only moved."""
    table, index = operands
    numbers, sizes = eqn.params["dimension_numbers"], eqn.params["slice_sizes"]
    rows = numbers.start_index_map == numbers.collapsed_slice_dims == (0,)
    rows = rows and sizes == (1, *table.shape[1:]) and index.ndim == 2
    if not (writer.loops and rows) or all(map(is_number, index.flat)):
        return _move(writer, eqn, operands)
    kind, out = _out_kind(eqn), np.empty((len(index), *table.shape[1:]), dtype=object)
    name = arrays.whole_of(writer, kind, table)
    for i, (k,) in enumerate(index):
        k = writer.define(WHOLE, "min", writer.define(WHOLE, "max", k, 0), len(table) - 1)
        offset = writer.define(WHOLE, "mul", k, math.prod(table.shape[1:]))
        out[i] = arrays.part_of(writer, kind, name, offset, table.shape[1:])[()]
    return [out]


def _integer_power(writer, eqn, operands):
    y = eqn.params["y"]
    out, unit = operands[0], np.array(1.0, dtype=object)
    for _ in range(abs(y) - 1):
        out = arrays.each(writer, REAL, "mul", [out, operands[0]], [REAL] * 2)
    return [arrays.each(writer, REAL, "div", [unit, out], [REAL] * 2) if y < 0 else out]


def _clamp(writer, eqn, operands):
    kind, (low, x, high) = _out_kind(eqn), operands
    above = arrays.each(writer, kind, "max", [x, low], [kind] * 2)
    return [arrays.each(writer, kind, "min", [above, high], [kind] * 2)]


def _select(writer, eqn, operands):
    kind = _out_kind(eqn)
    if len(operands) == 3:
        return [arrays.each(writer, kind, "select", operands, _kinds(eqn))]
    return [chosen(writer, operands[0], operands[1:], kind)]


def chosen(writer, index, values, kind):
    """Return values[i] where `index` is i (below 0 as 0, past the end as the last)."""
    out = values[0]
    for i, value in enumerate(values[1:], start=1):
        past = arrays.each(writer, TRUTH, "ge", [index, np.array(i, dtype=object)], [WHOLE] * 2)
        out = arrays.each(writer, kind, "select", [past, out, value], [TRUTH, kind, kind])
    return out


def _reduce(op):
    """The rule of a reduction over axes."""

    def rule(writer, eqn, operands):
        (array,), axes, kind = operands, eqn.params["axes"], _out_kind(eqn)
        others = [i for i in range(array.ndim) if i not in axes]
        rows = array.transpose(*others, *axes)
        if writer.loops and array.size >= arrays.LOOPED:
            return [arrays.reduced(writer, kind, op, rows, len(axes), kind)]
        rows = rows.reshape(*(array.shape[i] for i in others), -1)
        both = lambda a, b: writer.define(kind, op, a, b)
        return [filled(rows.shape[:-1], lambda i: functools.reduce(both, rows[i]))]

    return rule


def _cumulate(op):
    """The rule of running sums, products, largest or smallest elements along an axis."""

    def rule(writer, eqn, operands):
        axis, kind = eqn.params["axis"], _out_kind(eqn)
        out = np.moveaxis(operands[0].copy(), axis, -1)
        rows = out[..., ::-1] if eqn.params["reverse"] else out
        for i in np.ndindex(rows.shape):
            if i[-1] > 0:
                rows[i] = writer.define(kind, op, rows[(*i[:-1], i[-1] - 1)], rows[i])
        return [np.moveaxis(out, -1, axis)]

    return rule


def _position(largest):
    """The rule of the first position of the largest (smallest) element along an axis."""

    def rule(writer, eqn, operands):
        kind = kind_of(eqn.invars[0].aval.dtype)

        def better(e, best):
            if kind != TRUTH:
                return writer.define(TRUTH, "gt" if largest else "lt", e, best)
            yes, no = (e, best) if largest else (best, e)
            return writer.define(TRUTH, "and", yes, writer.define(TRUTH, "not", no))

        rows = np.moveaxis(operands[0], eqn.params["axes"][0], -1)
        if writer.loops and rows.size >= arrays.LOOPED:
            return [arrays.reduced(writer, WHOLE, "argmax" if largest else "argmin", rows, 1, kind)]

        def place(i):
            best, at = rows[i][0], 0
            for k, e in enumerate(rows[i][1:], start=1):
                take = better(e, best)
                at = writer.define(WHOLE, "select", take, at, k)
                best = writer.define(kind, "select", take, best, e)
            return at

        return [filled(rows.shape[:-1], place)]

    return rule


def _multiplications(A, B, sparse):
    """Number of products of two elements in A B; sparse: without those with the number 0."""
    if not sparse:
        return A.shape[0] * A.shape[1] * B.shape[1]
    some = lambda M: np.array([[not (is_number(e) and e == 0) for e in row] for row in M], int)
    return int(np.sum(some(A) @ some(B)))


def product(writer, a, b, dimensions):
    """Return the elements of a product of two arrays."""
    (contracted, right), batches = dimensions
    if any(batches):
        raise no_code("it multiplies stacks of matrices")
    rows = [i for i in range(a.ndim) if i not in contracted]
    columns = [i for i in range(b.ndim) if i not in right]
    A = a.transpose(*rows, *contracted).reshape(int(np.prod([a.shape[i] for i in rows])), -1)
    B = b.transpose(*right, *columns).reshape(A.shape[1], -1)
    shape = tuple(a.shape[i] for i in rows) + tuple(b.shape[i] for i in columns)
    if _multiplications(A, B, writer.sparse) > writer.large:
        return writer.matrix("product", (A, B), (*A.shape, B.shape[1]), shape)
    times = lambda a, b: writer.define(REAL, "mul", a, b)
    plus = lambda total, pair: writer.define(REAL, "add", total, times(*pair))

    def inner(at):
        first, *others = zip(A[at[0]], B[:, at[1]])
        return functools.reduce(plus, others, times(*first))

    return filled((A.shape[0], B.shape[1]), inner).reshape(shape)


def _linear_solve(writer, eqn, operands):
    """The solver that a custom_linear_solve states, run on its right sides."""
    lengths, inner = eqn.params["const_lengths"], eqn.params["jaxprs"].solve
    first, right = lengths.matvec + lengths.vecmat, operands[sum(lengths) :]
    return writer.run(inner.jaxpr, inner.consts, [*operands[first:][: lengths.solve], *right])


def _blocks(a):
    """Yield (matrix (n, n), places (n, k) in the vector) of each group of equal diagonal blocks."""
    size = len(a)
    meet = np.array([[not (is_number(e) and e == 0) for e in row] for row in a])
    meet = meet | meet.T | np.eye(size, dtype=bool)
    for _ in range(size.bit_length()):
        meet = meet @ meet
    groups = {}
    for first in range(size):
        group = np.flatnonzero(meet[first])
        if group[0] == first:
            block = a[np.ix_(group, group)]
            groups.setdefault(tuple(block.ravel()), (block, []))[1].append(group)
    for block, places in groups.values():
        yield block, np.stack(places, axis=1)


def _cholesky(writer, a):
    n = a.shape[0]
    return writer.matrix("cholesky", (a,), (n,), (n, n)).T


def _cholesky_solve(writer, upper, b):
    n = len(b)
    y = writer.matrix("forward", (upper.T, b), (n, 1), (n,))
    return writer.matrix("backward", (upper.T, y), (n, 1), (n,))


def inverse(writer, a):
    inverted = elements(np.zeros(a.shape))
    for block, places in _blocks(a):
        n = len(block)
        of_block = writer.matrix("solve", (block, elements(np.eye(n))), (n, n), (n, n))
        for place in places.T:
            inverted[np.ix_(place, place)] = of_block
    return inverted


def weighted_squares(writer, g, weight):
    scaled = arrays.each(writer, REAL, "mul", [g, weight[:, None]], [REAL] * 2)
    return product(writer, scaled.T, g, (((1,), (0,)), ((), ())))


def _cond(writer, eqn, operands):
    """All branches are computed, because none has an effect, and one is chosen."""
    branches = [writer.run(b.jaxpr, b.consts, operands[1:]) for b in eqn.params["branches"]]
    pick = lambda v, *values: chosen(writer, operands[0], values, kind_of(v.aval.dtype))
    return list(map(pick, eqn.outvars, *branches))


def _sizes_of_scan(p):
    """(constants, carried numbers) of the parameters of a scan."""
    if "num_consts" in p:
        return p["num_consts"], p["num_carry"]
    consts, carry, _ = p["ft_in"].unpack()  # since jax 0.12
    return len(consts), len(carry)


def _scan(writer, eqn, operands):
    p = eqn.params
    first, many = _sizes_of_scan(p)
    last = first + many
    closed, sequences = p["jaxpr"], operands[last:]
    if writer.loops:
        return _counted(writer, eqn, operands[:first], operands[first:last], sequences)
    if len(eqn.outvars) > many:
        carry = operands[first:last]  # it writes sequences: pass by pass
        passes, rows = range(p["length"]), []
        for i in reversed(passes) if p["reverse"] else passes:
            inputs = [*operands[:first], *carry, *(s[i] for s in sequences)]
            out = writer.run(closed.jaxpr, closed.consts, inputs)
            carry = out[:many]
            rows.append(out[many:])
        rows = rows[::-1] if p["reverse"] else rows
        return [*carry, *(np.stack(column) for column in zip(*rows))]
    starts, read = operands[first:last], lambda *counter: []
    if sequences:
        starts = [*starts, np.array(0, dtype=object)]
        read = _reader(writer, sequences, eqn.invars[last:], p["reverse"])

    def body(carried):
        carry, counter = (carried[:-1], carried[-1:]) if sequences else (carried, [])
        out = writer.run(closed.jaxpr, closed.consts, [*operands[:first], *carry, *read(*counter)])
        if sequences:
            out = [*out, filled((), lambda _: writer.define(WHOLE, "add", counter[0].item(), 1))]
        return out

    kinds = [kind_of(v.aval.dtype) for v in eqn.outvars] + [WHOLE] * bool(sequences)
    return _loop(writer, kinds, starts, p["length"], body)[: len(eqn.outvars)]


def _counted(writer, eqn, consts, carry, sequences):
    """The results of a scan as a loop that reads and writes its sequences row by row."""
    p, many = eqn.params, len(carry)
    closed, kinds = p["jaxpr"], [kind_of(v.aval.dtype) for v in eqn.outvars]
    read = [kind_of(v.aval.dtype) for v in eqn.invars[len(consts) + many :]]
    tables = [arrays.copied(writer, k, s) for k, s in zip(read, sequences)]
    blank = [filled(v.aval.shape, lambda _: 0) for v in eqn.outvars[many:]]

    def body(carried):
        *carried, counter = carried[:many], carried[many:-1], carried[-1].item()
        k = writer.define(WHOLE, "sub", p["length"] - 1, counter) if p["reverse"] else counter
        start = lambda size: writer.define(WHOLE, "mul", k, size)
        part = lambda kind, name, s: arrays.part_of(writer, kind, name, start(math.prod(s)), s)
        shapes = (s.shape[1:] for s in sequences)
        rows = [part(kind, name, shape) for kind, name, shape in zip(read, tables, shapes)]
        out = writer.run(closed.jaxpr, closed.consts, [*consts, *carried[0], *rows])
        after = [
            arrays.put(writer, kind, table.flat[0].name, start(row.size), row)
            for kind, table, row in zip(kinds[many:], carried[1], out[many:])
        ]
        after = [elements_of(name, table.shape) for name, table in zip(after, blank)]
        return [*out[:many], *after, filled((), lambda _: writer.define(WHOLE, "add", counter, 1))]

    starts = [*carry, *blank, np.array(0, dtype=object)]
    tabled = range(many, many + len(blank))
    return _loop(writer, [*kinds, WHOLE], starts, p["length"], body, tables=tabled)[:-1]


def _reader(writer, sequences, variables, backwards):
    """Return a function of the loop counter that gives the elements of sequences in that pass."""
    tables = []
    for rows, v in zip(sequences, variables):
        rows = rows[::-1] if backwards else rows
        of = lambda i, rows=rows: writer.array(rows[(slice(None), *i)])
        tables.append((kind_of(v.aval.dtype), filled(rows.shape[1:], of)))

    def entry(name, kind, counter):
        ref = Ref(name, counter.item())
        return ref if kind == REAL else writer.define(kind, kind, ref)

    return lambda counter: [
        each(lambda name, kind=kind: entry(name, kind, counter), row) for kind, row in tables
    ]


def _while(writer, eqn, operands):
    p = eqn.params
    test, body = p["cond_jaxpr"], p["body_jaxpr"]
    first, last = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]

    def tested_body(carried):
        (on,) = writer.run(test.jaxpr, test.consts, [*operands[:first], *carried])
        writer.scopes[-1].append(Until(on.item()))
        return writer.run(body.jaxpr, body.consts, [*operands[first:last], *carried])

    kinds = [kind_of(v.aval.dtype) for v in eqn.outvars]
    # the passes of a loop that goes on while a counter is below a number
    ends = [e.invars[1] for e in test.jaxpr.eqns if e.primitive.name == "lt"]
    is_whole = lambda e: isinstance(e, Literal) and kind_of(np.result_type(e.val)) == WHOLE
    most = min((int(e.val) for e in filter(is_whole, ends)), default=None)
    return _loop(writer, kinds, operands[last:], None, tested_body, most)


def _loop(writer, kinds, starts, count, body, most=None, tables=()):
    """The carried variables after a loop of body(carried); tables: places of those as arrays."""
    carried, variables, whole = [], [], []
    for i, (kind, start) in enumerate(zip(kinds, starts)):
        whole.append(i in tables or (writer.loops and start.size >= arrays.LOOPED))
        if whole[-1]:
            name, vector = writer.new_array(start.size), Vector(kind, start.size)
            variables.append(elements_of(name, start.shape))
            carried.append((vector, name, Ref(arrays.whole_of(writer, kind, start))))
            continue
        refs = filled(start.shape, lambda _: Ref(writer.fresh("c")))
        carried += [(kind, ref.name, e) for ref, e in zip(refs.ravel(), start.ravel())]
        variables.append(refs)
    writer.scopes.append([])
    writer.known.append({})
    before, new = {name for kind, name, _ in carried if isinstance(kind, Vector)}, []
    for kind, is_whole, o in zip(kinds, whole, body(variables)):
        new += [Ref(arrays.whole_of(writer, kind, o, before))] if is_whole else list(o.ravel())
    statements = writer.scopes.pop()
    writer.known.pop()
    writer.scopes[-1].append(Loop(count, tuple(carried), statements, tuple(new), most))
    return variables


SMALL = 64
"""Number of entries up to which an array that is read at a computed index is a choice of values."""


def written(jaxpr):
    """Return the inputs of a jaxpr that it writes to at an index that it computes."""
    inputs, variables = set(jaxpr.invars), set()
    for eqn in jaxpr.eqns:
        operands = [None if isinstance(v, Literal) else v for v in eqn.invars]
        if eqn.primitive.name == "dynamic_update_slice" and len(eqn.invars[0].aval.shape) == 1:
            variables.add(operands[0])
        elif eqn.primitive.name in ("jit", "pjit"):
            inner = eqn.params["jaxpr"].jaxpr
            inside = written(inner)
            variables |= {v for v, variable in zip(operands, inner.invars) if variable in inside}
    return variables & inputs


def line_of(array):
    """Return the name of the line that holds exactly the elements of an array, else None."""
    places = enumerate(array)
    whole = array.ndim == 1 and all(isinstance(e, Ref) and e.index == i for i, e in places)
    same = {e.name for e in array.ravel()} if whole else set()
    return same.pop() if len(same) == 1 else None


def _read(writer, eqn, operands):
    array, *index = operands
    if all(is_number(i.item()) for i in index):
        return RULES["slice"](writer, eqn, operands)
    name, sizes = line_of(array), eqn.params["slice_sizes"]
    if writer.loops and name is None and sizes[1:] == array.shape[1:]:
        kind, rows = _out_kind(eqn), array.shape[0] - sizes[0]
        start = writer.define(WHOLE, "min", writer.define(WHOLE, "max", index[0].item(), 0), rows)
        offset = writer.define(WHOLE, "mul", start, array.size // array.shape[0])
        table = arrays.whole_of(writer, kind, array)
        return [arrays.part_of(writer, kind, table, offset, tuple(sizes))]
    if name is None or sizes != (1,):
        return [_chosen_slice(writer, eqn, array, [i.item() for i in index])]
    kind = _out_kind(eqn)
    return [filled((1,), lambda _: writer.define(kind, "item", Ref(name), index[0].item()))]


def _chosen_slice(writer, eqn, array, index):
    """A slice of a small array whose place along one axis is computed: one of all there are."""
    sizes = eqn.params["slice_sizes"]
    moving = [d for d, i in enumerate(index) if not is_number(i) and array.shape[d] > sizes[d]]
    if len(moving) > 1 or array.size > SMALL:
        raise no_code("it reads an array at an index that it computes")
    start = lambda i, n, m: min(max(i, 0), n - m) if is_number(i) else 0
    starts = list(map(start, index, array.shape, sizes))
    ranges = [slice(i, i + m) for i, m in zip(starts, sizes)]
    if not moving:
        return array[tuple(ranges)]
    (d,) = moving
    windows = (slice(i, i + sizes[d]) for i in range(array.shape[d] - sizes[d] + 1))
    choices = [array[(*ranges[:d], window, *ranges[d + 1 :])] for window in windows]
    at = filled(choices[0].shape, lambda _: index[d])
    return chosen(writer, at, choices, _out_kind(eqn))


def _write(writer, eqn, operands):
    array, update, index = operands
    name = line_of(array)
    if name is None or update.shape != (1,):
        raise no_code("it writes to an array at an index")
    new = writer.fresh("l")
    writer.scopes[-1].append(Store(new, name, index.item(), update[0]))
    return [elements_of(new, (array.size,))]


INDICES = {"gather": slice(1, 2), "dynamic_slice": slice(1, None), "scatter": slice(1, 2)}
"""{primitive that reads or writes at indices: its operands that are indices}."""

MOVES = """
broadcast_in_dim reshape transpose squeeze expand_dims slice concatenate pad rev stack unstack tile
split gather dynamic_slice scatter
"""
"""Primitives that only move elements."""

UNCHANGED = ("stop_gradient", "copy", "copy_p", "optimization_barrier", "reduce_precision")
"""Primitives that return their operands."""

NOT_PRIMITIVES = {"quotient", "remainder", "real", "whole", "truth"}
"""Operations that no primitive of jax is called by."""

RULES = {  # {primitive of jax: function (writer, equation, operands) -> list of arrays of elements}
    **{op: _elementwise(op) for op in {*FUNCTIONS, *OPERATORS} - NOT_PRIMITIVES},
    **dict.fromkeys(UNCHANGED, lambda writer, eqn, operands: operands),
    **dict.fromkeys(MOVES.split(), _move),
    **{f"reduce_{name}": _reduce(op) for name, op in REDUCTIONS.items()},
    **{f"cum{name}": _cumulate(REDUCTIONS[name]) for name in ("sum", "prod", "max", "min")},
    "add_any": _elementwise("add"),
    "argmax": _position(largest=True),
    "argmin": _position(largest=False),
    "clamp": _clamp,
    "convert_element_type": _convert,
    "div": _elementwise("div", whole="quotient"),
    "le_to": _elementwise("le"),
    "lt_to": _elementwise("lt"),
    "integer_pow": _integer_power,
    "rem": _elementwise("rem", whole="remainder"),
    "select_n": _select,
    "xor": _elementwise("ne"),
    "cond": _cond,
    "scan": _scan,
    "while": _while,
    "dynamic_slice": _read,
    "gather": _gather,
    "dynamic_update_slice": _write,
    "dot_general": lambda writer, eqn, o: [
        product(writer, o[0], o[1], eqn.params["dimension_numbers"])
    ],
    "custom_linear_solve": _linear_solve,
}

NAMED = {f.__name__: f for f in (_cholesky, _cholesky_solve, inverse, weighted_squares)}
"""{function of `jaxtank.analysis.elimination`: function (writer, *operands) -> its elements}."""


class Writer:
    """The statements of one function while they are written."""

    # scopes: the statements of the function and of the loops that are open; known: in each of them,
    # {operation: its Ref}, so that nothing is computed twice.

    large = 300  # number of multiplications in a matrix product above which it is a loop
    sparse = False  # whether multiplications by the number 0 are not counted

    def __init__(self, loops=False):
        self.counter, self.scopes, self.known = 0, [[]], [{}]
        self.loops, self.sizes = loops, dict[str, int]()

    def fresh(self, letter="v"):
        """Return a name that is not used yet."""
        self.counter += 1
        return f"{letter}{self.counter}"

    def define(self, kind, op, *args):
        """Return a Ref to op(args), or the number or argument that it equals."""
        short = simplified(op, args)
        if short is not None:
            return short
        key = (op, tuple((type(a), a) for a in args))
        for scope in self.known:
            if key in scope:
                return scope[key]
        ref = Ref(self.fresh())
        self.scopes[-1].append(Define(kind, ref.name, op, args))
        self.known[-1][key] = ref
        return ref

    def array(self, entries, kind=REAL):
        """Return the name of an array with these entries (any shape, row by row)."""
        if self.loops and kind == REAL and entries.size > 4 * arrays.FEW:
            joined = arrays.gathered(self, kind, entries)
            if joined is not None:
                return joined
        name = self.fresh("a")
        self.sizes[name] = entries.size
        self.scopes[-1].append(Array(name, tuple(entries.ravel()), kind))
        return name

    def new_array(self, size):
        """Return the name of an array that a statement will fill."""
        name = self.fresh("m")
        self.sizes[name] = size
        return name

    def matrix(self, op, operands, sizes, shape):
        """Return the elements (shape) of a Matrix operation on the arrays of `operands`."""
        name = self.new_array(int(np.prod(shape)))
        self.scopes[-1].append(Matrix(name, op, tuple(self.array(o) for o in operands), sizes))
        return elements_of(name, shape)

    def run(self, jaxpr, consts, arguments):
        """Return the outputs of a jaxpr, arrays of elements, as its `arguments` are."""
        values = dict(zip(jaxpr.constvars, map(elements, consts)))
        values |= dict(zip(jaxpr.invars, arguments))
        read = lambda v: elements(v.val) if isinstance(v, Literal) else values[v]
        for eqn in jaxpr.eqns:
            for v, value in zip(eqn.outvars, self.equation(eqn, [read(v) for v in eqn.invars])):
                values[v] = np.asarray(value, dtype=object).reshape(v.aval.shape)
        return [np.asarray(read(v), dtype=object) for v in jaxpr.outvars]

    def equation(self, eqn, operands):
        """Return the outputs of one equation of a jaxpr, arrays of elements."""
        name = eqn.primitive.name
        numbers = all(is_number(e) for o in operands for e in o.ravel())
        if name in ("jit", "pjit") and eqn.params["name"] in NAMED and not numbers:
            return [NAMED[eqn.params["name"]](self, *operands)]
        parameters = [eqn.params.get(k) for k in ("jaxpr", "call_jaxpr", "fun_jaxpr")]
        inner = next((p for p in parameters if p is not None), None)
        if inner is not None and name not in RULES:
            return self.run(getattr(inner, "jaxpr", inner), getattr(inner, "consts", ()), operands)
        if numbers:
            return constant(eqn, operands)
        if name not in RULES:
            raise no_code(f"it uses the operation {name}")
        return RULES[name](self, eqn, operands)


class WholeWriter(Writer):
    """A Writer for the many matrices that are computed from the numbers of a loop."""

    large = 60
    sparse = True

    def __init__(self, loops=False):
        super().__init__(loops)
        self.arrays = {}

    def array(self, entries, kind=REAL):
        """Return the name of an array with these entries: a result, an earlier one or a new one."""
        elements = tuple(entries.ravel())
        name = getattr(elements[0], "name", "")
        if elements == tuple(Ref(name, i) for i in range(self.sizes.get(name, 0))):
            return name
        if self.loops and arrays.place_of(self, entries) is not None:
            return arrays.copied(self, kind, entries)
        if len(self.scopes) > 1:
            return super().array(entries, kind)
        key = tuple((type(e), e) for e in elements)
        if key not in self.arrays:
            self.arrays[key] = super().array(entries, kind)
        return self.arrays[key]


class Lowered(NamedTuple):
    """Result of `lower_all`."""

    statements: list
    outputs: Any  # results of the function, with arrays of Refs and numbers instead of arrays
    lines: dict
    """{Ref of the first entry of a Line, an array that is read or written at an index: name}."""


def lower_all(f, arguments, writer):
    """Return the Lowered form of a function."""
    closed, shape = jax.make_jaxpr(f, return_shape=True)(*arguments.values())
    inputs, starts, changed = [], {}, written(closed.jaxpr)
    for name, tree in arguments.items():
        for start, array in _inputs(writer, name, tree):
            if closed.jaxpr.invars[len(inputs)] in changed:
                starts[start] = f"{name}_{start.index}"
                array = elements_of(starts[start], (array.size,))
            inputs.append(array)
    outputs = writer.run(closed.jaxpr, closed.consts, inputs)
    statements = used(writer.scopes[0], names(e for out in outputs for e in out.ravel()))
    return Lowered(statements, jax.tree.unflatten(jax.tree.structure(shape), outputs), starts)


def _inputs(writer, name, tree):
    """Yield (Ref of the first element, elements, each of its kind) of each array of an argument."""
    count = 0
    for leaf in jax.tree.leaves(tree):
        size = int(np.prod(leaf.shape))
        kind, refs = kind_of(leaf.dtype), np.empty(size, dtype=object)
        for i in range(size):
            source = Ref(name, None if leaf is tree and leaf.shape == () else count + i)
            refs[i] = source if kind == REAL else writer.define(kind, kind, source)
        yield Ref(name, count), refs.reshape(leaf.shape)
        count += size

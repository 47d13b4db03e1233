"""Operations of a traced function on arrays, each as operations on the elements of the arrays.

RULES holds one function for each primitive of jax; `jaxtank.export.lowering` looks it up there.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.export.simplify import FUNCTIONS, OPERATORS, is_number
from jaxtank.export.statements import REAL, TRUTH, WHOLE

REDUCTIONS = {"sum": "add", "prod": "mul", "max": "max", "min": "min", "and": "and", "or": "or"}
"""{what reduces an array: the operation on two of its elements}."""

TRUTHS = {"lt", "le", "gt", "ge", "eq", "ne", "and", "or", "not", "is_finite"}
"""Operations whose result is true or false."""


def no_code(reason):
    """Return the InputError for a controller that cannot be exported."""
    return InputError(f"this controller cannot be exported: {reason}")


def kind_of(dtype):
    """Return the kind of variable, REAL, WHOLE or TRUTH, that holds an element of this type."""
    if jnp.issubdtype(dtype, jnp.floating):
        return REAL
    return TRUTH if dtype == jnp.bool_ else WHOLE


def elements(value):
    """Return the numbers of an array as Python numbers, in an array of objects."""
    array = np.asarray(value)
    out = np.empty(array.shape, dtype=object)
    plain = {REAL: float, WHOLE: int, TRUTH: bool}[kind_of(array.dtype)]
    for i in np.ndindex(array.shape):
        out[i] = plain(array[i])
    return out


def each(f, *arrays):
    """Return f of the elements of arrays, which are broadcast against each other."""
    arrays = np.broadcast_arrays(*arrays)
    out = np.empty(arrays[0].shape, dtype=object)
    for i in np.ndindex(out.shape):
        out[i] = f(*(a[i] for a in arrays))
    return out


def constant(eqn, operands):
    """Return what an operation on numbers gives, computed by jax."""
    values = [_numbers(o, v) for o, v in zip(operands, eqn.invars)]
    bound = eqn.primitive.get_bind_params(eqn.params)
    functions, params = bound if isinstance(bound, tuple) else ((), bound)
    with jax.ensure_compile_time_eval():
        out = eqn.primitive.bind(*functions, *map(jnp.asarray, values), **params)
    return [elements(v) for v in (out if eqn.primitive.multiple_results else [out])]


def _numbers(operand, variable):
    """The numbers of an operand as an array of the variable's type."""
    return np.array(operand.tolist(), dtype=variable.aval.dtype).reshape(variable.aval.shape)


def _out_kind(eqn):
    return kind_of(eqn.outvars[0].aval.dtype)


def _elementwise(op):
    """The rule of an operation on one element of each operand."""

    def rule(writer, eqn, operands):
        kind = TRUTH if op in TRUTHS else _out_kind(eqn)
        return [each(lambda *a: writer.define(kind, op, *a), *operands)]

    return rule


def _whole_or_real(whole, real):
    """The rule of an operation that whole numbers round towards zero."""

    def rule(writer, eqn, operands):
        op = whole if _out_kind(eqn) == WHOLE else real
        return _elementwise(op)(writer, eqn, operands)

    return rule


def _xor(writer, eqn, operands):
    if _out_kind(eqn) != TRUTH:
        raise no_code("it uses the operation xor of whole numbers")
    return _elementwise("ne")(writer, eqn, operands)


def _same(writer, eqn, operands):
    return operands


def _convert(writer, eqn, operands):
    kind = _out_kind(eqn)
    if kind_of(eqn.invars[0].aval.dtype) == kind:
        return operands
    return [each(lambda a: writer.define(kind, kind, a), operands[0])]


def _move(writer, eqn, operands):
    """The elements that an operation only moves, found by moving their numbers."""
    table, ids = [], []
    for o, v in zip(operands, eqn.invars):
        if v in eqn.invars[INDICES.get(eqn.primitive.name, slice(0))]:
            if not all(map(is_number, o.ravel())):
                raise no_code("it reads an array at an index that it computes")
            ids.append(_numbers(o, v))
            continue
        ids.append(np.arange(len(table), len(table) + o.size, dtype=np.int64).reshape(o.shape))
        table += list(o.ravel())
    with jax.ensure_compile_time_eval():
        params = eqn.primitive.get_bind_params(eqn.params)
        out = eqn.primitive.bind(*map(jnp.asarray, ids), **params)
    outs = out if eqn.primitive.multiple_results else [out]
    return [each(lambda i: table[int(i)], np.asarray(v)) for v in outs]


def _integer_power(writer, eqn, operands):
    y = eqn.params["y"]

    def power(a):
        out = a
        for _ in range(abs(y) - 1):
            out = writer.define(REAL, "mul", out, a)
        return writer.define(REAL, "div", 1.0, out) if y < 0 else out

    return [each(power, operands[0])]


def _clamp(writer, eqn, operands):
    def clamp(low, x, high):
        return writer.define(REAL, "min", writer.define(REAL, "max", x, low), high)

    return [each(clamp, *operands)]


def _select(writer, eqn, operands):
    kind = _out_kind(eqn)
    if len(operands) == 3:
        return [each(lambda *a: writer.define(kind, "select", *a), *operands)]
    index, *values = np.broadcast_arrays(*operands)
    return [chosen(writer, index, values, kind)]


def chosen(writer, index, values, kind):
    """Return values[i] where `index` is i (below 0 as 0, past the end as the last)."""

    def choose(n, no, yes, i):
        return writer.define(kind, "select", writer.define(TRUTH, "ge", n, i), no, yes)

    out = values[0]
    for i, value in enumerate(values[1:], start=1):
        out = each(lambda n, no, yes, i=i: choose(n, no, yes, i), index, out, value)
    return out


def _reduce(op):
    """The rule of a reduction over axes."""

    def rule(writer, eqn, operands):
        (array,), axes, kind = operands, eqn.params["axes"], _out_kind(eqn)
        kept = [i for i in range(array.ndim) if i not in axes]
        rows = array.transpose(*kept, *axes).reshape(*(array.shape[i] for i in kept), -1)
        out = np.empty(rows.shape[:-1], dtype=object)
        for i in np.ndindex(out.shape):
            total = rows[i][0]
            for e in rows[i][1:]:
                total = writer.define(kind, op, total, e)
            out[i] = total
        return [out]

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
        out = np.empty(rows.shape[:-1], dtype=object)
        for i in np.ndindex(out.shape):
            best, out[i] = rows[i][0], 0
            for k, e in enumerate(rows[i][1:], start=1):
                take = better(e, best)
                out[i] = writer.define(WHOLE, "select", take, out[i], k)
                best = writer.define(kind, "select", take, best, e)
        return [out]

    return rule


INDICES = {"gather": slice(1, 2), "dynamic_slice": slice(1, None), "scatter": slice(1, 2)}
"""{primitive that reads or writes at indices: its operands that are indices}."""

MOVES = """
broadcast_in_dim reshape transpose squeeze expand_dims slice concatenate pad rev stack tile split
gather dynamic_slice scatter
"""
"""Primitives that only move elements."""

UNCHANGED = ("stop_gradient", "copy", "copy_p", "optimization_barrier", "reduce_precision")
"""Primitives that return their operands."""

NOT_PRIMITIVES = {"quotient", "remainder", "real", "whole", "truth"}
"""Operations that no primitive of jax is called by."""

RULES = {
    **{op: _elementwise(op) for op in {*FUNCTIONS, *OPERATORS} - NOT_PRIMITIVES},
    **dict.fromkeys(UNCHANGED, _same),
    **dict.fromkeys(MOVES.split(), _move),
    **{f"reduce_{name}": _reduce(op) for name, op in REDUCTIONS.items()},
    **{f"cum{name}": _cumulate(REDUCTIONS[name]) for name in ("sum", "prod", "max", "min")},
    "add_any": _elementwise("add"),
    "argmax": _position(largest=True),
    "argmin": _position(largest=False),
    "clamp": _clamp,
    "convert_element_type": _convert,
    "div": _whole_or_real("quotient", "div"),
    "le_to": _elementwise("le"),
    "lt_to": _elementwise("lt"),
    "integer_pow": _integer_power,
    "rem": _whole_or_real("remainder", "rem"),
    "select_n": _select,
    "xor": _xor,
}
"""{primitive of jax: function (writer, equation, operands) -> list of arrays of elements}."""

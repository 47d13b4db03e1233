"""From a traced function to straight-line statements on scalars, which a printer turns into C or
MATLAB.

Every element of every array becomes a `Ref` or a number; what only moves elements about (slices,
transposes, broadcasts) costs nothing, what depends on constants alone is computed here, and what
nobody uses is left out. Loops (`jax.lax.scan`, `jax.lax.while_loop`) stay loops, products of large
matrices too.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal

from jaxtank.core.errors import InputError

REAL, WHOLE, TRUTH = "real", "whole", "truth"
LARGE = 300
"""Products in a matrix product, above which it is a loop."""


class Ref(NamedTuple):
    """A variable, or an entry of an array."""

    name: str
    index: int | None = None


class Define(NamedTuple):
    """name = op(args)."""

    kind: str
    name: str
    op: str
    args: tuple


class Array(NamedTuple):
    """An array of reals with its entries."""

    name: str
    entries: tuple


class Matrix(NamedTuple):
    """out = op(operands), arrays by name, sizes as the operation needs them: "product" (m, k, n) of
    A (m, k) and B (k, n); "cholesky" (n,); "forward" and "backward" (n, k): L x = b and L' x = b.
    """

    name: str
    op: str
    operands: tuple
    sizes: tuple


class Until(NamedTuple):
    """Where a loop ends: unless `test`, a variable, is true."""

    test: Ref


class Loop(NamedTuple):
    """`count` times (None: until it ends by itself): body, then every carried variable takes its
    new value, all at once.
    """

    count: int | None
    carried: tuple  # ((kind, name, start), ...)
    body: list
    new: tuple


MOVES = {
    "broadcast_in_dim",
    "reshape",
    "transpose",
    "squeeze",
    "expand_dims",
    "slice",
    "concatenate",
    "pad",
    "rev",
    "stack",
    "tile",
    "split",
    "gather",
    "dynamic_slice",
    "copy",
    "copy_p",
}
SAME = {"stop_gradient", "copy", "copy_p", "optimization_barrier", "reduce_precision"}
PLAIN = {
    "add": "add",
    "add_any": "add",
    "sub": "sub",
    "mul": "mul",
    "div": "div",
    "neg": "neg",
    "sqrt": "sqrt",
    "rsqrt": "rsqrt",
    "abs": "abs",
    "max": "max",
    "min": "min",
    "exp": "exp",
    "log": "log",
    "tanh": "tanh",
    "sin": "sin",
    "cos": "cos",
    "floor": "floor",
    "round": "round",
    "pow": "pow",
    "square": "square",
    "lt": "lt",
    "le": "le",
    "gt": "gt",
    "ge": "ge",
    "eq": "eq",
    "ne": "ne",
    "and": "and",
    "or": "or",
    "not": "not",
    "sign": "sign",
    "is_finite": "is_finite",
}
FUNCTIONS = {
    "logistic": lambda a: 1.0 / (1.0 + np.exp(-a)),
    "erf": math.erf,
    "erfc": math.erfc,
    "log1p": np.log1p,
    "expm1": np.expm1,
    "exp2": np.exp2,
    "cbrt": np.cbrt,
    "ceil": np.ceil,
    "rem": np.fmod,
    "tan": np.tan,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "atan2": np.arctan2,
    "sinh": np.sinh,
    "cosh": np.cosh,
    "asinh": np.arcsinh,
    "acosh": np.arccosh,
    "atanh": np.arctanh,
}
"""Functions of real numbers that keep their names, and what they are of numbers."""
PLAIN |= {name: name for name in FUNCTIONS}
TRUTHS = {"lt", "le", "gt", "ge", "eq", "ne", "and", "or", "not", "is_finite"}
WHOLES = {"div": "quotient", "rem": "remainder"}  # of whole numbers, rounded towards zero


def kind_of(dtype):
    """REAL, WHOLE or TRUTH."""
    if jnp.issubdtype(dtype, jnp.floating):
        return REAL
    return TRUTH if dtype == jnp.bool_ else WHOLE


class Writer:
    """Statements of one function in the making."""

    def __init__(self):
        self.counter, self.scopes, self.known = 0, [[]], [{}]

    def fresh(self, letter="v"):
        """A name nobody has."""
        self.counter += 1
        return f"{letter}{self.counter}"

    def define(self, kind, op, *args):
        """A Ref to op(args), or the number where the arguments tell it."""
        short = _simplified(op, args)
        if short is not None:
            return short
        key = (op, tuple((type(a), a) for a in args))
        for known in self.known:
            if key in known:
                return known[key]
        ref = Ref(self.fresh())
        self.scopes[-1].append(Define(kind, ref.name, op, args))
        self.known[-1][key] = ref
        return ref

    def array(self, elements):
        """The name of an array of reals with these elements (any shape, row by row)."""
        name = self.fresh("a")
        self.scopes[-1].append(Array(name, tuple(elements.ravel())))
        return name

    def matrix(self, op, operands, sizes, shape):
        """Elements (shape) of a Matrix operation on the arrays of `operands`."""
        name = self.fresh("m")
        self.scopes[-1].append(Matrix(name, op, tuple(self.array(o) for o in operands), sizes))
        out = np.empty(int(np.prod(shape)), dtype=object)
        out[:] = [Ref(name, i) for i in range(out.size)]
        return out.reshape(shape)


def _number(value):
    return not isinstance(value, Ref)


def _simplified(op, args):
    """The value of op(args) where it is a number or one of the arguments, else None."""
    if op == "select":
        condition, no, yes = args
        if _number(condition):
            return yes if condition else no
        return no if (no is yes or no == yes) and type(no) is type(yes) else None
    if all(map(_number, args)):
        return _compute(op, args)
    zero, one = ([_number(a) and not isinstance(a, bool) and a == v for a in args] for v in (0, 1))
    if op == "add" and any(zero):
        return args[1] if zero[0] else args[0]
    if op == "sub" and (zero[1] or args[0] == args[1]):
        return args[0] if zero[1] else 0.0
    if op == "mul" and any(one):
        return args[1] if one[0] else args[0]
    if op == "mul" and any(zero):
        return 0.0
    if op == "div" and (one[1] or zero[0]):
        return args[0] if one[1] else 0.0
    if op == "and" and any(_number(a) for a in args):
        other = args[1] if _number(args[0]) else args[0]
        return other if (args[0] if _number(args[0]) else args[1]) else False
    if op == "real":
        return None
    return None


def _compute(op, args):
    f = {
        "add": lambda a, b: a + b,
        "sub": lambda a, b: a - b,
        "mul": lambda a, b: a * b,
        "div": lambda a, b: float(np.divide(a, b)),
        "neg": lambda a: -a,
        "sqrt": lambda a: float(np.sqrt(a)),
        "rsqrt": lambda a: float(1 / np.sqrt(a)),
        "abs": abs,
        "max": max,
        "min": min,
        "exp": lambda a: float(np.exp(a)),
        "log": lambda a: float(np.log(a)),
        "tanh": lambda a: float(np.tanh(a)),
        "sin": lambda a: float(np.sin(a)),
        "cos": lambda a: float(np.cos(a)),
        "floor": lambda a: float(np.floor(a)),
        "round": lambda a: float(np.round(a)),
        "pow": lambda a, b: a**b,
        "square": lambda a: a * a,
        "sign": lambda a: float(np.sign(a)),
        "lt": lambda a, b: a < b,
        "le": lambda a, b: a <= b,
        "gt": lambda a, b: a > b,
        "ge": lambda a, b: a >= b,
        "eq": lambda a, b: a == b,
        "ne": lambda a, b: a != b,
        "and": lambda a, b: a and b,
        "or": lambda a, b: a or b,
        "not": lambda a: not a,
        "is_finite": np.isfinite,
        "quotient": lambda a, b: int(a / b),
        "remainder": math.fmod,
        "real": float,
        "whole": int,
        "truth": bool,
    }.get(op)
    return f(*args) if f is not None else float(FUNCTIONS[op](*args))


def function(f, *shapes):
    """(statements, inputs, outputs) of f(*arguments), a function of trees of arrays.

    shapes: trees of jax.ShapeDtypeStruct. inputs: Refs "x", index, in the order of all elements of
    all arguments; outputs: list of arrays of elements, one for each leaf of what f returns. Raises
    InputError for an operation that has no counterpart here.
    """
    closed = jax.make_jaxpr(f)(*shapes)
    writer, inputs, count = Writer(), [], 0
    for leaf in jax.tree.leaves(shapes):
        size = int(np.prod(leaf.shape))
        kind, elements = kind_of(leaf.dtype), np.empty(size, dtype=object)
        for i in range(size):
            source = Ref("x", count + i)
            elements[i] = source if kind == REAL else writer.define(kind, kind, source)
        inputs.append(elements.reshape(leaf.shape))
        count += size
    outputs = _run(writer, closed.jaxpr, closed.consts, inputs)
    statements = _used(
        writer.scopes[0], {e.name for out in outputs for e in out.ravel() if isinstance(e, Ref)}
    )
    return statements, count, outputs


def _run(writer, jaxpr, consts, arguments):
    values = {}

    def read(v):
        return _elements(v.val) if isinstance(v, Literal) else values[v]

    for v, value in (*zip(jaxpr.constvars, map(_elements, consts)), *zip(jaxpr.invars, arguments)):
        values[v] = value
    for eqn in jaxpr.eqns:
        out = _equation(writer, eqn, [read(v) for v in eqn.invars])
        for v, value in zip(eqn.outvars, out):
            values[v] = np.asarray(value, dtype=object).reshape(v.aval.shape)
    return [np.asarray(read(v), dtype=object) for v in jaxpr.outvars]


def _elements(value):
    array = np.asarray(value)
    out = np.empty(array.shape, dtype=object)
    plain = {REAL: float, WHOLE: int, TRUTH: bool}[kind_of(array.dtype)]
    for i in np.ndindex(array.shape):
        out[i] = plain(array[i])
    return out


def _equation(writer, eqn, operands):
    name, params = eqn.primitive.name, eqn.params
    if name in ("jit", "pjit") and params["name"] in NAMED:
        return [NAMED[params["name"]](writer, *operands)]
    inner = next(
        (params[k] for k in ("jaxpr", "call_jaxpr", "fun_jaxpr") if k in params and name != "scan"),
        None,
    )
    if inner is not None and name != "custom_linear_solve":
        return _run(writer, getattr(inner, "jaxpr", inner), getattr(inner, "consts", ()), operands)
    if all(_number(e) for o in operands for e in o.ravel()):
        return _constant(eqn, operands)
    kind = kind_of(eqn.outvars[0].aval.dtype)
    if name in SAME:
        return operands
    if name in MOVES:
        return _moved(eqn, operands)
    if name == "convert_element_type":
        source = kind_of(eqn.invars[0].aval.dtype)
        return [_each(lambda a: a if source == kind else writer.define(kind, kind, a), operands[0])]
    if name == "xor" and kind == TRUTH:
        return [
            _each(lambda a, b: writer.define(TRUTH, "ne", a, b), *np.broadcast_arrays(*operands))
        ]
    if kind == WHOLE and name in WHOLES:
        return [
            _each(
                lambda a, b: writer.define(WHOLE, WHOLES[name], a, b),
                *np.broadcast_arrays(*operands),
            )
        ]
    if name in PLAIN:
        out = TRUTH if PLAIN[name] in TRUTHS else kind
        return [
            _each(lambda *a: writer.define(out, PLAIN[name], *a), *np.broadcast_arrays(*operands))
        ]
    if name == "integer_pow":
        return [_each(lambda a: _power(writer, a, params["y"]), operands[0])]
    if name == "clamp":
        low, x, high = np.broadcast_arrays(*operands)
        return [
            _each(
                lambda a, b, c: writer.define(REAL, "min", writer.define(REAL, "max", b, a), c),
                low,
                x,
                high,
            )
        ]
    if name == "select_n" and len(operands) == 3:
        return [
            _each(
                lambda c, no, yes: writer.define(kind, "select", c, no, yes),
                *np.broadcast_arrays(*operands),
            )
        ]
    if name == "select_n":
        index, *values = np.broadcast_arrays(*operands)
        return [_chosen(writer, index, values, kind)]
    if name == "cond":  # every branch is computed: none has an effect
        branches = [_run(writer, b.jaxpr, b.consts, operands[1:]) for b in params["branches"]]
        chosen = zip(*branches), (kind_of(v.aval.dtype) for v in eqn.outvars)
        return [
            _chosen(writer, np.broadcast_to(operands[0], v[0].shape), v, k) for v, k in zip(*chosen)
        ]
    if name in ("reduce_sum", "reduce_prod", "reduce_max", "reduce_min", "reduce_and", "reduce_or"):
        return [_reduced(writer, operands[0], params["axes"], SUMS.get(name[7:], name[7:]), kind)]
    if name in ("argmax", "argmin"):
        return [
            _place(
                writer,
                operands[0],
                params["axes"][0],
                name == "argmax",
                kind_of(eqn.invars[0].aval.dtype),
            )
        ]
    if name in ("cumsum", "cumprod", "cummax", "cummin"):
        return [
            _running(
                writer,
                operands[0],
                params["axis"],
                params["reverse"],
                SUMS.get(name[3:], name[3:]),
                kind,
            )
        ]
    if name == "dot_general":
        return [_product(writer, *operands, dimensions=params["dimension_numbers"])]
    if name == "scan":
        return _scan(writer, eqn, operands)
    if name == "while":
        return _while(writer, eqn, operands)
    if name == "cholesky":
        n = operands[0].shape[-1]
        return [writer.matrix("cholesky", operands, (n,), (n, n))]
    if name == "triangular_solve":
        return [_triangular(writer, *operands, params=params)]
    if name == "custom_linear_solve" and all(_number(e) and e == 0 for e in operands[-1].ravel()):
        return [operands[-1]]  # nothing to solve for: a term that carries derivatives alone
    if name == "lu":  # of a matrix whose equations have a right side of zero: see above
        return [
            _each(lambda a: a, operands[0]),
            *(np.zeros(v.aval.shape, dtype=object) for v in eqn.outvars[1:]),
        ]
    raise InputError(f"this law cannot be written as code: it uses the operation {name}")


def _each(f, *arrays):
    out = np.empty(arrays[0].shape, dtype=object)
    for i in np.ndindex(out.shape):
        out[i] = f(*(a[i] for a in arrays))
    return out


def _constant(eqn, operands):
    """What an operation on numbers gives, computed by jax."""
    values = [
        np.array(o.tolist(), dtype=v.aval.dtype).reshape(v.aval.shape)
        for o, v in zip(operands, eqn.invars)
    ]
    bound = eqn.primitive.get_bind_params(eqn.params)
    functions, params = bound if isinstance(bound, tuple) else ((), bound)
    with jax.ensure_compile_time_eval():
        out = eqn.primitive.bind(*functions, *map(jnp.asarray, values), **params)
    return [_elements(v) for v in (out if eqn.primitive.multiple_results else [out])]


def _moved(eqn, operands):
    """The elements that an operation moves about, found by moving their numbers."""
    table, ids = [], []
    for o, v in zip(operands, eqn.invars):
        whole = eqn.primitive.name in ("gather", "dynamic_slice") and o is not operands[0]
        if whole:  # indices, which must be numbers
            if not all(_number(e) for e in o.ravel()):
                raise InputError(
                    "this law cannot be written as code: it looks something up by a number that it"
                    " computes"
                )
            ids.append(np.array(o.tolist(), dtype=v.aval.dtype).reshape(v.aval.shape))
            continue
        ids.append(np.arange(len(table), len(table) + o.size, dtype=np.int64).reshape(o.shape))
        table += list(o.ravel())
    with jax.ensure_compile_time_eval():
        out = eqn.primitive.bind(
            *map(jnp.asarray, ids), **eqn.primitive.get_bind_params(eqn.params)
        )
    outs = out if eqn.primitive.multiple_results else [out]
    return [_each(lambda i: table[int(i)], np.asarray(v)) for v in outs]


def _power(writer, a, y):
    out = a
    for _ in range(abs(y) - 1):
        out = writer.define(REAL, "mul", out, a)
    return writer.define(REAL, "div", 1.0, out) if y < 0 else out


def _reduced(writer, array, axes, op, kind):
    kept = [i for i in range(array.ndim) if i not in axes]
    rows = array.transpose(*kept, *axes).reshape(*(array.shape[i] for i in kept), -1)
    out = np.empty(rows.shape[:-1], dtype=object)
    for i in np.ndindex(out.shape):
        total = rows[i][0]
        for e in rows[i][1:]:
            total = writer.define(kind, op, total, e)
        out[i] = total
    return out


SUMS = {"sum": "add", "prod": "mul"}


def _chosen(writer, index, values, kind):
    """values[i] where index is i (below 0 as 0, past the end as the last)."""
    out = values[0]
    for i, value in enumerate(values[1:], start=1):
        out = _each(
            lambda n, no, yes, i=i: writer.define(
                kind, "select", writer.define(TRUTH, "ge", n, i), no, yes
            ),
            index,
            out,
            value,
        )
    return out


def _place(writer, array, axis, largest, kind):
    """The first place along an axis at which the largest (smallest) element is."""
    rows = np.moveaxis(array, axis, -1)
    out = np.empty(rows.shape[:-1], dtype=object)
    for i in np.ndindex(out.shape):
        best, place = rows[i][0], 0
        for k, e in enumerate(rows[i][1:], start=1):
            if kind == TRUTH:
                pair = (e, best) if largest else (best, e)
                better = writer.define(TRUTH, "and", pair[0], writer.define(TRUTH, "not", pair[1]))
            else:
                better = writer.define(TRUTH, "gt" if largest else "lt", e, best)
            place = writer.define(WHOLE, "select", better, place, k)
            best = writer.define(kind, "select", better, best, e)
        out[i] = place
    return out


def _running(writer, array, axis, reverse, op, kind):
    """Running sums, products, largest or smallest elements along an axis."""
    out = np.moveaxis(array.copy(), axis, -1)
    rows = out[..., ::-1] if reverse else out
    for i in np.ndindex(rows.shape):
        if i[-1] > 0:
            rows[i] = writer.define(kind, op, rows[(*i[:-1], i[-1] - 1)], rows[i])
    return np.moveaxis(out, -1, axis)


def _product(writer, a, b, dimensions):
    (left, right), (batch_a, batch_b) = dimensions
    if batch_a or batch_b:
        raise InputError("this law cannot be written as code: it multiplies stacks of matrices")
    rows = [i for i in range(a.ndim) if i not in left]
    columns = [i for i in range(b.ndim) if i not in right]
    A = a.transpose(*rows, *left).reshape(int(np.prod([a.shape[i] for i in rows])), -1)
    B = b.transpose(*right, *columns).reshape(A.shape[1], -1)
    shape = tuple(a.shape[i] for i in rows) + tuple(b.shape[i] for i in columns)
    if A.shape[0] * A.shape[1] * B.shape[1] > LARGE:
        return writer.matrix("product", (A, B), (*A.shape, B.shape[1]), shape)
    out = np.empty((A.shape[0], B.shape[1]), dtype=object)
    for i, j in np.ndindex(out.shape):
        total = writer.define(REAL, "mul", A[i, 0], B[0, j])
        for k in range(1, A.shape[1]):
            total = writer.define(REAL, "add", total, writer.define(REAL, "mul", A[i, k], B[k, j]))
        out[i, j] = total
    return out.reshape(shape)


def _triangular(writer, a, b, params):
    if params["unit_diagonal"] or params["conjugate_a"] or not params["left_side"]:
        # x A = b is A' x' = b'
        if params["unit_diagonal"] or params["conjugate_a"]:
            raise InputError(
                "this law cannot be written as code: a triangular solve of an unusual kind"
            )
        turned = {**params, "left_side": True, "transpose_a": not params["transpose_a"]}
        return _triangular(writer, a, b.T, turned).T
    lower = a if params["lower"] else a.T
    forward = params["lower"] != params["transpose_a"]
    n, k = b.shape
    return writer.matrix("forward" if forward else "backward", (lower, b), (n, k), (n, k))


def _cholesky(writer, a):
    n = a.shape[0]
    return writer.matrix("cholesky", (a,), (n,), (n, n)).T


def _cholesky_solve(writer, upper, b):
    n = len(b)
    y = writer.matrix("forward", (upper.T, b), (n, 1), (n,))
    return writer.matrix("backward", (upper.T, y), (n, 1), (n,))


def _weighted(writer, g, weight):
    scaled = _each(
        lambda a, w: writer.define(REAL, "mul", a, w), g, np.broadcast_to(weight[:, None], g.shape)
    )
    return _product(writer, scaled.T, g, (((1,), (0,)), ((), ())))


NAMED = {f.__name__: f for f in (_cholesky, _cholesky_solve, _weighted)}
"""Functions of `jaxtank.analysis.qp` whose loops go through arrays by an index: written as matrix
operations.
"""


def _scan(writer, eqn, operands):
    p = eqn.params
    consts, carry, xs = (
        operands[: p["num_consts"]],
        operands[p["num_consts"] : p["num_consts"] + p["num_carry"]],
        operands[p["num_consts"] + p["num_carry"] :],
    )
    if xs or len(eqn.outvars) > p["num_carry"]:
        raise InputError(
            "this law cannot be written as code: a loop in it reads or writes a sequence"
        )
    closed = p["jaxpr"]
    return _loop(
        writer,
        eqn,
        carry,
        p["length"],
        lambda names: _run(writer, closed.jaxpr, closed.consts, [*consts, *names]),
    )


def _while(writer, eqn, operands):
    p = eqn.params
    test, body = p["cond_jaxpr"], p["body_jaxpr"]
    first, second = (
        operands[: p["cond_nconsts"]],
        operands[p["cond_nconsts"] : p["cond_nconsts"] + p["body_nconsts"]],
    )

    def once(names):
        (on,) = _run(writer, test.jaxpr, test.consts, [*first, *names])
        writer.scopes[-1].append(Until(on.item()))
        return _run(writer, body.jaxpr, body.consts, [*second, *names])

    return _loop(writer, eqn, operands[p["cond_nconsts"] + p["body_nconsts"] :], None, once)


def _loop(writer, eqn, carry, count, once):
    """The carried variables after a loop of `once`, a function of them."""
    carried, names = [], []
    for v, start in zip(eqn.outvars, carry):
        kind, mine = kind_of(v.aval.dtype), np.empty(start.shape, dtype=object)
        for i in np.ndindex(start.shape):
            ref = mine[i] = Ref(writer.fresh("c"))
            carried.append((kind, ref.name, start[i]))
        names.append(mine)
    writer.scopes.append([])
    writer.known.append({})
    out = once(names)
    body = writer.scopes.pop()
    writer.known.pop()
    new = tuple(e for o in out for e in o.ravel())
    writer.scopes[-1].append(Loop(count, tuple(carried), body, new))
    return names


def _names(entries):
    return {e.name for e in entries if isinstance(e, Ref)}


def _used(statements, wanted):
    """The statements that `wanted` names depend on, in order."""
    kept = []
    for s in reversed(statements):
        if isinstance(s, Loop):
            if not wanted & {name for _, name, _ in s.carried}:
                continue
            body = _used(s.body, _names(s.new))
            s = s._replace(body=body)
            wanted = (
                wanted | _names(start for _, _, start in s.carried) | _inside(body) | _names(s.new)
            )
        elif isinstance(s, Until):
            wanted = wanted | _names([s.test])
        elif s.name not in wanted:
            continue
        elif isinstance(s, Define):
            wanted = wanted | _names(s.args)
        elif isinstance(s, Array):
            wanted = wanted | _names(s.entries)
        else:
            wanted = wanted | set(s.operands)
        kept.append(s)
    return kept[::-1]


def _inside(body):
    """Every name that a loop's body reads."""
    found = set()
    for s in body:
        if isinstance(s, Define):
            found |= _names(s.args)
        elif isinstance(s, Array):
            found |= _names(s.entries)
        elif isinstance(s, Matrix):
            found |= set(s.operands)
        elif isinstance(s, Until):
            found |= _names([s.test])
        else:
            found |= _names(start for _, _, start in s.carried) | _inside(s.body) | _names(s.new)
    return found


__all__ = ["Any", "Array", "Define", "Loop", "Matrix", "Ref", "Until", "Writer", "function"]

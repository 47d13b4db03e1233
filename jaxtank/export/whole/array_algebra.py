"""Sums, products and linear systems of arrays. RULES holds the primitives of jax."""

import numpy as np
from jax.core import eval_jaxpr

from jaxtank.export.primitives import REDUCTIONS, no_code
from jaxtank.export.whole.array_moves import place, view
from jaxtank.export.whole.array_values import is_literal, strides_of

FOLDS = {
    "add": "{0}+{1}",
    "mul": "{0}*{1}",
    "max": "max({0},{1})",
    "min": "min({0},{1})",
    "and": "{0}&&{1}",
    "or": "{0}||{1}",
}


def _rows(text, eqn, operand, axes):
    """(array with `axes` last, number of rows, width of one)."""
    shape = eqn.invars[0].aval.shape
    own, kept = strides_of(shape), [d for d in range(len(shape)) if d not in axes]
    order = [*kept, *axes]
    width = int(np.prod([shape[d] for d in axes]))
    rows = int(np.prod([shape[d] for d in kept]))
    if order != list(range(len(shape))):
        operand = view(text, operand, [shape[d] for d in order], [own[d] for d in order])
    return operand, rows, width


def _reduce(op):
    def rule(text, eqn, operands):
        moved, rows, width = _rows(text, eqn, operands[0], list(eqn.params["axes"]))
        if is_literal(moved):
            moved = text.filled(rows * width, "", moved)
        at = "0" if rows == 1 else f"x*{width}"
        s, k = next(text.names), next(text.names)
        next_ = FOLDS[op].format(s, f"{moved}[{place(at, [(k, 1)])}]")
        lines = f"let {s}={moved}[{at}];for(let {k}=1;{k}<{width};++{k}){s}={next_};"
        return text.filled(rows, lines, s)

    return rule


def _cumulate(op):
    def rule(text, eqn, operands):
        axis, shape = eqn.params["axis"], eqn.invars[0].aval.shape
        if eqn.params["reverse"]:
            raise no_code("it sums an array from its end")
        moved, rows, width = _rows(text, eqn, operands[0], [axis])
        f = FOLDS[op].format("x", "y")
        done = text.let(f"running((x,y)=>{f},{rows},{width},{moved})")
        order = [*(d for d in range(len(shape)) if d != axis), axis]
        if order == list(range(len(shape))):
            return done
        own = strides_of([shape[d] for d in order])
        return view(text, done, shape, [own[order.index(d)] for d in range(len(shape))])

    return rule


def _dot(text, eqn, operands):
    (left, right), (batch_a, batch_b) = eqn.params["dimension_numbers"]
    sides, sizes = [], []
    for v, operand, own, batch, last in zip(
        eqn.invars, operands, (left, right), (batch_a, batch_b), (True, False)
    ):
        shape = v.aval.shape
        free = [d for d in range(len(shape)) if d not in own and d not in batch]
        order = [*batch, *free, *own] if last else [*batch, *own, *free]
        strides = strides_of(shape)
        if order != list(range(len(shape))):
            operand = view(text, operand, [shape[d] for d in order], [strides[d] for d in order])
        sides.append(operand)
        sizes.append([int(np.prod([shape[d] for d in part])) for part in (batch, free, own)])
    (b, m, k), (_, n, _) = sizes
    return text.product((b, m, k, n), *sides)


def _solve(text, eqn, operands):
    lengths, jaxprs = eqn.params["const_lengths"], eqn.params["jaxprs"]
    closed, consts = jaxprs.matvec, operands[: lengths.matvec]
    shape = eqn.outvars[0].aval.shape
    n, k, across = _block(closed, shape)
    inner = text.inner()
    z = next(text.names)
    (out,) = inner.run(closed.jaxpr, closed.consts, [*consts, z])
    body = "\n".join([*inner.live([out]), f"return {out};"])
    right = operands[sum(lengths)]
    return text.let(f"solved({n},{k},{str(across).lower()},{z}=>{{{body}}},{right})")


def _block(closed, shape):
    """(n, k, whether the vectors are rows) of k solves with one matrix (n, n)."""
    if len(shape) == 1:
        return shape[0], 1, False
    if len(shape) != 2:
        raise no_code("it solves for a stack of matrices")
    rng = np.random.default_rng(0)
    consts = [rng.random(v.aval.shape) for v in closed.jaxpr.invars[:-1]]

    def matvec(z):
        return np.array(eval_jaxpr(closed.jaxpr, closed.consts, *consts, z)[0])

    for across in (False, True):
        z = np.zeros(shape)
        one = (0, slice(None)) if across else (slice(None), 0)
        z[one] = rng.random(z[one].shape)
        other = matvec(z)
        other[one] = 0.0
        if not np.any(other):
            return (shape[1], shape[0], True) if across else (shape[0], shape[1], False)
    return int(np.prod(shape)), 1, False


RULES = {
    **{f"reduce_{name}": _reduce(op) for name, op in REDUCTIONS.items()},
    **{f"cum{name}": _cumulate(REDUCTIONS[name]) for name in ("sum", "prod", "max", "min")},
    "dot_general": _dot,
    "custom_linear_solve": _solve,
}
"""{primitive of jax: function (text, equation, operands) -> text of the result}."""

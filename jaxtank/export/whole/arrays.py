"""Work on larger arrays as calls of JavaScript functions, where single elements would fill pages.

Designs of gains, quadratic programmes and their derivatives: whatever has an array of more than
`LARGEST` entries. Imported by `jaxtank.export.whole.loop`.
"""

import functools
import itertools
import re
from collections.abc import Callable
from importlib import resources
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal

from jaxtank.export.javascript import MATRICES, ROUND
from jaxtank.export.lowering import Writer
from jaxtank.export.primitives import REDUCTIONS, elements, no_code
from jaxtank.export.primitives import constant as folded
from jaxtank.export.simplify import FUNCTIONS, OPERATORS, is_number
from jaxtank.export.statements import Matrix, Ref
from jaxtank.export.whole.compact import Text, literal, short_names

LARGEST = 16
"""Number of entries of an array up to which its elements are computed one by one."""
ALIASES = ("reshape", "squeeze", "expand_dims", "stop_gradient", "copy", "copy_p", "reduce_precision")
CALLED = ("jaxpr", "call_jaxpr", "fun_jaxpr")
CONTROL = ("scan", "while", "cond")
ELEMENTWISE = {*FUNCTIONS, *OPERATORS, "add_any", "clamp", "integer_pow", "select_n", "xor"}
ELEMENTWISE |= {"convert_element_type", "div", "rem"}
NAMED = ("_cholesky", "_cholesky_solve", "_weighted")
"""Functions of `jaxtank.analysis.elimination` that are written as matrix operations."""


class ArrayWriter(Writer):
    """A Writer that turns work on larger arrays into calls; `functions`: {name: its text}."""

    def __init__(self):
        super().__init__()
        self.functions: dict[str, str] = {}
        self.sizes: dict[str, int] = {}
        self.whole: dict[tuple, str] = {}

    def equation(self, eqn, operands):
        """Return the outputs of one equation of a jaxpr."""
        name = eqn.primitive.name
        if name not in ("lu", *ALIASES) and _is_large(eqn, operands):
            if all(is_number(e) for o in operands for e in o.ravel()) and name not in CONTROL:
                return super().equation(eqn, operands)
            if name in CONTROL or _called(eqn) is None or eqn.params.get("name") in NAMED:
                return self._call(eqn, operands)
        return super().equation(eqn, operands)

    def _call(self, eqn, operands):
        """The elements of the results of an equation as a function of arrays; of a loop, a function
        for each group of results that depend on the same arguments.
        """
        groups = groups_of(eqn) if eqn.primitive.name == "scan" else [range(len(eqn.outvars))]
        out = [None] * len(eqn.outvars)
        for group in groups:
            for i, found in zip(group, self._results(eqn, operands, list(group))):
                out[i] = found
        return out

    def _results(self, eqn, operands, wanted):
        """The elements of some results of an equation."""
        shapes = [eqn.outvars[i].aval.shape for i in wanted]
        sizes = [int(np.prod(s)) for s in shapes]
        text = ArrayText(short_names(["F", "x", "y", "z"]))
        own = []
        for o in operands:
            number = all(map(is_number, o.ravel()))
            array = np.array(o.ravel().tolist(), dtype=float) if number else None
            own.append(text.constant(array) if number else next(text.names))
        if eqn.primitive.name == "scan":
            found = _scan(text, eqn, own, wanted)
        else:
            found = text.equation(eqn, own)
        result = found[0] if len(found) == 1 else f"chain(1,{_list(sizes)},[{','.join(found)}])"
        lines = [*text.live(found, top=True), f"return {result};"]
        read = set(re.findall(r"\w+", " ".join(lines)))
        used = [i for i, n in enumerate(own) if n in read and not _known(text, n)]
        body = f"({','.join(own[i] for i in used)}){{" + "\n".join(lines) + "}"
        names = {v: k for k, v in self.functions.items()}
        function = names.get(body) or f"f{len(self.functions)}"
        self.functions[function] = body
        key = (function, tuple(self._array(operands[i]) for i in used))
        name = self._once(key, lambda: self._added(function, key[1], ()))
        self.sizes[name] = sum(sizes)
        out, at = [], 0
        for shape, size in zip(shapes, sizes):
            part = np.empty(size, dtype=object)
            part[:] = [Ref(name, at + i) for i in range(size)]
            out.append(part.reshape(shape))
            at += size
        return out

    def _array(self, operand):
        """The name of an array with these elements: that of a result, a part of one, or a new one."""
        entries = tuple(operand.ravel())
        first = entries[0] if entries else None
        if isinstance(first, Ref) and first.index is not None and first.name in self.sizes:
            follows = tuple(Ref(first.name, first.index + i) for i in range(len(entries)))
            if entries == follows:
                if first.index == 0 and len(entries) == self.sizes[first.name]:
                    return first.name
                ends = (first.index, first.index + len(entries))
                key = ("part", first.name, ends)
                return self._once(key, lambda: self._added("part", (first.name,), ends))
        return self._once(("array", entries), lambda: self.array(operand))

    def _added(self, op, operands, sizes):
        """The name of the result of a new operation on arrays."""
        name = self.fresh("m")
        self.scopes[-1].append(Matrix(name, op, operands, sizes))
        return name

    def _once(self, key, make):
        """The name of an array that is made once, unless in a loop, where it may change."""
        if len(self.scopes) > 1:
            return make()
        if key not in self.whole:
            self.whole[key] = make()
        return self.whole[key]


def _known(text, name):
    """Whether a value of a text is a constant."""
    return _is_literal(name) or name in text.numbers


def groups_of(eqn):
    """Return the results of a loop in groups that depend on the same arguments: lists of numbers.

    The tangents of a loop and the loop itself are one equation; the loop does not depend on them.
    """
    groups: dict[frozenset, list[int]] = {}
    for i, found in enumerate(_scan_dependence(eqn, [{i} for i in range(len(eqn.invars))])):
        groups.setdefault(frozenset(found), []).append(i)
    return list(groups.values())


def _scan_dependence(eqn, given):
    """What each result of a loop depends on, for what its operands depend on."""
    p = eqn.params
    consts, carry = p["num_consts"], p["num_carry"]
    starts = [set(v) for v in given[consts : consts + carry]]
    while True:
        out = _dependence(p["jaxpr"].jaxpr, [*given[:consts], *starts, *given[consts + carry :]])
        new = [a | b for a, b in zip(starts, out)]
        if new == starts:
            return [*new, *out[carry:]]
        starts = new


def _dependence(jaxpr, given):
    """What each result of a jaxpr depends on."""
    known = {v: set() for v in jaxpr.constvars} | dict(zip(jaxpr.invars, given))

    def read(v):
        return set() if isinstance(v, Literal) else known[v]

    for eqn in jaxpr.eqns:
        operands = [read(v) for v in eqn.invars]
        inner = _called(eqn) if eqn.primitive.name not in CONTROL else None
        if eqn.primitive.name == "scan":
            out = _scan_dependence(eqn, operands)
        elif eqn.primitive.name == "cond":
            found = [_dependence(b.jaxpr, operands[1:]) for b in eqn.params["branches"]]
            out = [operands[0].union(*own) for own in zip(*found)]
        elif inner is not None:
            out = _dependence(getattr(inner, "jaxpr", inner), operands)
        else:
            out = [set().union(*operands)] * len(eqn.outvars)
        known.update(zip(eqn.outvars, out))
    return [read(v) for v in jaxpr.outvars]


def _is_large(eqn, operands):
    shapes = [*(o.shape for o in operands), *(v.aval.shape for v in eqn.outvars)]
    if eqn.primitive.name == "scan":
        p = eqn.params
        moved = len(operands) > p["num_consts"] + p["num_carry"] or len(eqn.outvars) > p["num_carry"]
        return moved or any(np.prod(s, dtype=int) > LARGEST for s in shapes)
    return any(np.prod(s, dtype=int) > LARGEST for s in shapes)


def _called(eqn):
    return next((eqn.params[k] for k in CALLED if eqn.params.get(k) is not None), None)


class ArrayText:
    """The lines of a function on arrays. Values are texts: names of arrays, or numbers."""

    def __init__(self, names, outer=None):
        self.names = names
        self.lines: list[tuple[str, str, frozenset]] = []
        self.constants: dict[str, str] = outer.constants if outer else {}
        self.numbers: dict[str, np.ndarray] = outer.numbers if outer else {}

    def constant(self, array):
        """Return the text of an array of numbers, which stands in front of everything else."""
        text = constant(array)
        if _is_literal(text):
            return text
        if text not in self.constants:
            self.constants[text] = next(self.names)
        self.numbers[self.constants[text]] = np.ravel(array)
        return self.constants[text]

    def live(self, results, top=False):
        """Return the lines that results depend on; top: with the constants that they read."""
        wanted, kept = set(re.findall(r"\w+", " ".join(results))), []
        for name, line, reads in reversed(self.lines):
            if name in wanted:
                kept += [line] if line else []
                wanted |= reads
        if top:
            kept += [f"const {n}={t};" for t, n in self.constants.items() if n in wanted]
        return kept[::-1]

    def let(self, expression):
        """Return the name of a new constant."""
        name = next(self.names)
        self._line(name, f"const {name}={expression};")
        return name

    def _line(self, name, line):
        self.lines.append((name, line, frozenset(re.findall(r"\w+", line))))

    def run(self, jaxpr, consts, arguments):
        """Return the texts of the outputs of a jaxpr."""
        values = dict(zip(jaxpr.invars, arguments))
        for v, c in zip(jaxpr.constvars, consts):
            values[v] = self.constant(np.asarray(c, dtype=float))

        def read(v):
            if isinstance(v, Literal):
                return self.constant(np.asarray(v.val, dtype=float))
            return values[v]

        for eqn in jaxpr.eqns:
            found = self.equation(eqn, [read(v) for v in eqn.invars])
            values.update(zip(eqn.outvars, found))
        return [read(v) for v in jaxpr.outvars]

    def equation(self, eqn, operands):
        """Return the texts of the outputs of an equation."""
        name = eqn.primitive.name
        if all(_known(self, o) for o in operands) and _called(eqn) is None and name not in CONTROL:
            return self._folded(eqn, operands)
        if name in ALIASES:
            return operands[:1] if len(eqn.outvars) == 1 else operands
        if name in ("lu", "lu_pivots_to_permutation", "sort"):
            return ["0"] * len(eqn.outvars)
        if name == "optimization_barrier":
            return operands
        if name in RULES:
            found = RULES[name](self, eqn, operands)
            return found if isinstance(found, list) else [found]
        inner = _called(eqn)
        if inner is not None:
            if eqn.params.get("name") in NAMED:
                return [self._named(eqn, operands)]
            return self.run(getattr(inner, "jaxpr", inner), getattr(inner, "consts", ()), operands)
        return [self._elementwise(eqn, operands)]

    def _folded(self, eqn, operands):
        """The results of an operation on numbers, computed by jax."""
        values = []
        for v, o in zip(eqn.invars, operands):
            found = self.numbers.get(o)
            found = np.full(v.aval.shape, float(o)) if found is None else found
            found = np.broadcast_to(found, (int(np.prod(v.aval.shape)),)) if found.size == 1 else found
            values.append(elements(found.reshape(v.aval.shape)))
        return [self.constant(np.array(e.tolist(), dtype=float)) for e in folded(eqn, values)]

    def _named(self, eqn, operands):
        """The matrix operations of `jaxtank.analysis.elimination`."""
        shape = eqn.invars[0].aval.shape
        n = shape[-1]
        turn = f"[{n},{n}],[1,{n}],0"
        if eqn.params["name"] == "_cholesky":
            return self.let(f"view(cholesky({n},{operands[0]}),{turn})")
        if eqn.params["name"] == "_cholesky_solve":
            upper, b = operands
            return self.let(
                f"backward({n},1,view({upper},{turn}),forward({n},1,view({upper},{turn}),{b}))"
            )
        g, weight = operands
        rows = shape[0]
        scaled = f"map((x,y)=>x*y,{rows * n},{g},view({weight},[{rows},{n}],[1,0],0))"
        return self.let(f"matmul(1,{n},{rows},{n},view({scaled},[{n},{rows}],[1,{n}],0),{g})")

    def _elementwise(self, eqn, operands):
        """An operation on each element, by the expression that single elements have."""
        op, writer = eqn.primitive.name, Writer()
        if op not in ELEMENTWISE:
            raise no_code(f"it uses the operation {op} of larger arrays")
        inputs = [_single(Ref(x)) for x in "xyz"[: len(operands)]]
        scalar = eqn.replace(
            invars=[_scalar(v) for v in eqn.invars], outvars=[_scalar(v) for v in eqn.outvars]
        )
        (out,) = writer.equation(scalar, inputs)
        text = Text({Ref(x): x for x in "xyz"}, (f"x{i}" for i in itertools.count()))
        e = np.asarray(out, dtype=object).item()
        lines = text.write(writer.scopes[0], [e])
        body = text.of(e)
        if body == "x":
            return operands[0]
        operands = [_spread(self, v, eqn.outvars[0], o) for v, o in zip(eqn.invars, operands)]
        arguments = ",".join("xyz"[: len(operands)])
        f = f"({arguments})=>{{{''.join(lines)}return {body}}}" if lines else f"({arguments})=>{body}"
        size = int(np.prod(eqn.outvars[0].aval.shape))
        return self.let(f"map({f},{size},{','.join(operands)})")


def _single(e):
    out = np.empty((), dtype=object)
    out[()] = e
    return out


class _Scalar:
    """A variable of a scalar program that stands for an array's element."""

    def __init__(self, aval):
        self.aval = jax.core.ShapedArray((), aval.dtype)


def _scalar(v):
    return _Scalar(v.aval)


def constant(array: np.ndarray) -> str:
    """Return an array of numbers as text.

    Examples
    --------
    >>> constant(np.ones(3)), constant(np.array([0.0, 2.0])), constant(np.eye(9))[:30]
    ('1', 'F(0,2)', 'sparse(81,[0,10,20,30,40,50,60')
    """
    flat = np.asarray(array, dtype=float).ravel()
    if flat.size and np.all(flat == flat[0]):
        return literal(float(flat[0]))
    if flat.size == 0:
        return "F()"
    if flat.size > 8 and np.array_equal(flat, np.arange(flat.size)):
        return f"F(...Array({flat.size}).keys())"
    places = np.flatnonzero(flat)
    if flat.size > 8 and places.size * 2 < flat.size:
        values = [literal(float(v)) for v in flat[places]]
        return f"sparse({flat.size},{_list(places)},[{','.join(values)}])"
    return f"F({','.join(literal(float(v)) for v in flat)})"


def _list(numbers):
    return f"[{','.join(str(int(v)) for v in numbers)}]"


def _strides(shape):
    return [int(np.prod(shape[i + 1 :])) for i in range(len(shape))]


def _view(text, operand, shape, strides, start="0"):
    """A view of an array as a new one; itself where nothing moves."""
    return text.let(f"view({operand},{_list(shape)},{_list(strides)},{start})")


def _spread(text, v, out, operand):
    """An operand in the shape of the result, where its axes of length 1 stand for longer ones."""
    own, shape = v.aval.shape, out.aval.shape
    if own == shape or int(np.prod(own)) == 1:
        return operand
    strides = [0 if n == 1 else s for n, s in zip(own, _strides(own))]
    return _view(text, operand, shape, strides)


def _broadcast(text, eqn, operands):
    shape, dimensions = eqn.params["shape"], eqn.params["broadcast_dimensions"]
    source = eqn.invars[0].aval.shape
    own, strides = _strides(source), [0] * len(shape)
    for i, d in enumerate(dimensions):
        strides[d] = own[i] if source[i] != 1 else 0
    if int(np.prod(source)) == int(np.prod(shape)):
        return operands[0]
    return _view(text, operands[0], shape, strides)


def _transpose(text, eqn, operands):
    order = eqn.params["permutation"]
    source = eqn.invars[0].aval.shape
    own = _strides(source)
    return _view(text, operands[0], [source[i] for i in order], [own[i] for i in order])


def _slice(text, eqn, operands):
    p, own = eqn.params, _strides(eqn.invars[0].aval.shape)
    steps = p["strides"] or [1] * len(own)
    start = sum(a * b for a, b in zip(p["start_indices"], own))
    return _view(
        text, operands[0], eqn.outvars[0].aval.shape, [a * b for a, b in zip(own, steps)], start
    )


def _rev(text, eqn, operands):
    shape = eqn.invars[0].aval.shape
    own = _strides(shape)
    back = eqn.params["dimensions"]
    start = sum(own[d] * (shape[d] - 1) for d in back)
    return _view(text, operands[0], shape, [-s if d in back else s for d, s in enumerate(own)], start)


def _concatenate(text, eqn, operands):
    axis = eqn.params.get("dimension", eqn.params.get("axis", 0))
    if eqn.primitive.name == "stack":
        outer = int(np.prod(eqn.invars[0].aval.shape[:axis]))
    else:
        outer = int(np.prod(eqn.outvars[0].aval.shape[:axis]))
    sizes = [int(np.prod(v.aval.shape)) // outer for v in eqn.invars]
    return text.let(f"chain({outer},{_list(sizes)},[{','.join(operands)}])")


def _split(text, eqn, operands):
    axis, shape = eqn.params["axis"], eqn.invars[0].aval.shape
    own, start, out = _strides(shape), 0, []
    for v in eqn.outvars:
        out.append(_view(text, operands[0], v.aval.shape, own, start * own[axis]))
        start += v.aval.shape[axis]
    return out


def _pad(text, eqn, operands):
    shape, out = eqn.invars[0].aval.shape, eqn.outvars[0].aval.shape
    config = eqn.params["padding_config"]
    if any(low < 0 or high < 0 or inner for low, high, inner in config):
        raise no_code("it cuts an array by padding it")
    own = _strides(out)
    start = sum(low * s for (low, _, _), s in zip(config, own))
    size = int(np.prod(out))
    fill = operands[1] if _is_literal(operands[1]) else f"{operands[1]}[0]"
    return text.let(f"put({size},{fill},{operands[0]},{_list(shape)},{_list(own)},{start})")


def _is_literal(operand):
    return re.fullmatch(r"-?[\d.][\w.+-]*|-?Infinity|NaN", operand) is not None


def _offset(shape, sizes, own, indices):
    places = [
        f"within({i},{n - m})*{s}" for i, n, m, s in zip(indices, shape, sizes, own) if n > m
    ]
    return "+".join(places) or "0"


def _dynamic_slice(text, eqn, operands):
    shape, sizes = eqn.invars[0].aval.shape, eqn.params["slice_sizes"]
    own = _strides(shape)
    return _view(text, operands[0], sizes, own, _offset(shape, sizes, own, operands[1:]))


def _dynamic_update(text, eqn, operands):
    shape, sizes = eqn.invars[0].aval.shape, eqn.invars[1].aval.shape
    own = _strides(shape)
    start = _offset(shape, sizes, own, operands[2:])
    size = int(np.prod(shape))
    return text.let(
        f"put({size},{operands[0]},{operands[1]},{_list(sizes)},{_list(own)},{start})"
    )


FOLDS = {"add": "(x,y)=>x+y", "mul": "(x,y)=>x*y", "max": "max", "min": "min"}
FOLDS |= {"and": "(x,y)=>x&&y", "or": "(x,y)=>x||y"}


def _rows(text, eqn, operand, axes):
    """(array with `axes` last, number of rows, width of one)."""
    shape = eqn.invars[0].aval.shape
    own, kept = _strides(shape), [d for d in range(len(shape)) if d not in axes]
    order = [*kept, *axes]
    width = int(np.prod([shape[d] for d in axes]))
    rows = int(np.prod([shape[d] for d in kept]))
    if order != list(range(len(shape))):
        operand = _view(text, operand, [shape[d] for d in order], [own[d] for d in order])
    return operand, rows, width


def _reduce(op):
    def rule(text, eqn, operands):
        moved, rows, width = _rows(text, eqn, operands[0], list(eqn.params["axes"]))
        return text.let(f"fold({FOLDS[op]},{rows},{width},{moved})")

    return rule


def _cumulate(op):
    def rule(text, eqn, operands):
        axis, shape = eqn.params["axis"], eqn.invars[0].aval.shape
        if eqn.params["reverse"]:
            raise no_code("it sums an array from its end")
        moved, rows, width = _rows(text, eqn, operands[0], [axis])
        done = text.let(f"running({FOLDS[op]},{rows},{width},{moved})")
        order = [*(d for d in range(len(shape)) if d != axis), axis]
        if order == list(range(len(shape))):
            return done
        own = _strides([shape[d] for d in order])
        return _view(text, done, shape, [own[order.index(d)] for d in range(len(shape))])

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
        strides = _strides(shape)
        if order != list(range(len(shape))):
            operand = _view(text, operand, [shape[d] for d in order], [strides[d] for d in order])
        sides.append(operand)
        sizes.append([int(np.prod([shape[d] for d in part])) for part in (batch, free, own)])
    (b, m, k), (_, n, _) = sizes
    return text.let(f"matmul({b},{m},{k},{n},{sides[0]},{sides[1]})")


def _solve(text, eqn, operands):
    lengths, jaxprs = eqn.params["const_lengths"], eqn.params["jaxprs"]
    closed, consts = jaxprs.matvec, operands[: lengths.matvec]
    shape = eqn.outvars[0].aval.shape
    n, k, across = _block(closed, shape)
    inner = ArrayText(text.names, text)
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
        return np.array(jax.core.eval_jaxpr(closed.jaxpr, closed.consts, *consts, z)[0])

    for across in (False, True):
        z = np.zeros(shape)
        one = (0, slice(None)) if across else (slice(None), 0)
        z[one] = rng.random(z[one].shape)
        other = matvec(z)
        other[one] = 0.0
        if not np.any(other):
            return (shape[1], shape[0], True) if across else (shape[0], shape[1], False)
    return int(np.prod(shape)), 1, False


def _block_lines(text, jaxpr, consts, arguments):
    """(lines, results) of a jaxpr in a block of its own."""
    inner = ArrayText(text.names, text)
    results = inner.run(jaxpr, consts, arguments)
    return inner, results


def _state(text, eqn, starts, size_of):
    """Variables of a loop with their first values, as lines."""
    own = [next(text.names) for _ in starts]
    lines = [
        f"let {n}=flat({size},{start});" for n, start, size in zip(own, starts, size_of)
    ]
    return own, lines


def _moved(text, own, new, sizes):
    """Lines that give the variables of a loop their next values, all at once."""
    temporary = [next(text.names) for _ in own]
    first = [f"const {t}=flat({s},{e});" for t, e, s in zip(temporary, new, sizes)]
    return first + [f"{n}={t};" for n, t in zip(own, temporary)]


def _loop(text, own, lines):
    """Add a loop whose variables are `own` as one line."""
    whole = "\n".join(lines)
    reads = frozenset(re.findall(r"\w+", whole))
    for i, name in enumerate(own):
        # the loop stands once, where its first variable is defined
        text.lines.append((name, whole if i == 0 else "", reads | set(own)))


def _scan(text, eqn, operands, wanted=None):
    p = eqn.params
    consts, carry = p["num_consts"], p["num_carry"]
    closed, count = p["jaxpr"], p["length"]
    wanted = list(range(len(eqn.outvars))) if wanted is None else wanted
    state = _needed(closed.jaxpr, consts, carry, wanted)
    sequences = [i for i in wanted if i >= carry]
    sizes = [int(np.prod(eqn.outvars[i].aval.shape)) for i in state]
    own, lines = _state(text, eqn, [operands[consts + i] for i in state], sizes)
    counter, outs = next(text.names), [next(text.names) for _ in sequences]
    totals = [int(np.prod(eqn.outvars[i].aval.shape)) for i in sequences]
    lines += [f"const {n}=new Float64Array({s});" for n, s in zip(outs, totals)]
    first, up = (count - 1, "--") if p["reverse"] else (0, "++")
    end = f"{counter}>=0" if p["reverse"] else f"{counter}<{count}"
    lines.append(f"for(let {counter}={first};{end};{up}{counter}){{")
    slices, reading = [], []
    for v, x in zip(eqn.invars[consts + carry :], operands[consts + carry :]):
        each, name = int(np.prod(v.aval.shape)) // count, next(text.names)
        part = f"flat({each * count},{x}).slice({counter}*{each},{counter}*{each}+{each})"
        reading.append((name, f"const {name}={part};"))
        slices.append(name)
    inside = ["0"] * carry
    for i, name in zip(state, own):
        inside[i] = name
    inner, results = _block_lines(
        text, closed.jaxpr, closed.consts, [*operands[:consts], *inside, *slices]
    )
    results = [results[i] for i in (*state, *sequences)]
    body = inner.live(results)
    read = set(re.findall(r"\w+", " ".join([*body, *results])))
    lines += [line for name, line in reading if name in read] + body
    for name, total, e in zip(outs, totals, results[len(state) :]):
        each = total // count
        lines.append(f"{name}.set(flat({each},{e}),{counter}*{each});")
    lines += [*_moved(text, own, results[: len(state)], sizes), "}"]
    _loop(text, [*own, *outs], lines)
    found = dict(zip([*state, *sequences], [*own, *outs]))
    return [found[i] for i in wanted]


def _needed(jaxpr, consts, carry, wanted):
    """The carried variables that some results of a loop need, themselves among them."""
    alone = [set() for _ in range(consts)] + [{i} for i in range(carry)]
    alone += [set() for _ in jaxpr.invars[consts + carry :]]
    out = _dependence(jaxpr, alone)
    need = {i for i in wanted if i < carry}
    while True:
        new = need.union(*(out[i] for i in [*need, *wanted]))
        if new == need:
            return sorted(need)
        need = new


def _while(text, eqn, operands):
    p = eqn.params
    first, last = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]
    sizes = [int(np.prod(v.aval.shape)) for v in eqn.outvars]
    own, lines = _state(text, eqn, operands[last:], sizes)
    test, body = p["cond_jaxpr"], p["body_jaxpr"]
    inner, (on,) = _block_lines(text, test.jaxpr, test.consts, [*operands[:first], *own])
    lines += ["for(;;){", *inner.live([on]), f"if(!flat(1,{on})[0])break;"]
    inner, results = _block_lines(text, body.jaxpr, body.consts, [*operands[first:last], *own])
    lines += [*inner.live(results), *_moved(text, own, results, sizes), "}"]
    _loop(text, own, lines)
    return own


def _cond(text, eqn, operands):
    sizes = [int(np.prod(v.aval.shape)) for v in eqn.outvars]
    own = [next(text.names) for _ in eqn.outvars]
    lines = [f"let {','.join(own)};"]
    branches = eqn.params["branches"]
    for i, branch in enumerate(branches):
        inner, results = _block_lines(text, branch.jaxpr, branch.consts, operands[1:])
        last = i == len(branches) - 1
        at = f"flat(1,{operands[0]})[0]"
        head = ("" if i == 0 else "else") + ("{" if last else f" if({at}<={i}){{")
        sets = [f"{n}=flat({s},{e});" for n, s, e in zip(own, sizes, results)]
        lines += [head, *inner.live(results), *sets, "}"]
    _loop(text, own, lines)
    return own


def _moved_by_number(text, eqn, operands):
    """What moves elements in another way, by the numbers of its elements."""
    table, ids, texts = 0, [], []
    for v, operand in zip(eqn.invars, operands):
        shape, size = v.aval.shape, int(np.prod(v.aval.shape))
        if jnp.issubdtype(v.aval.dtype, jnp.integer) and len(ids):
            if not _is_literal(operand) and operand not in text.numbers:
                raise no_code("it reads an array at an index that it computes")
            found = text.numbers.get(operand)
            found = np.full(shape, float(operand)) if found is None else found
            ids.append(np.broadcast_to(found, found.shape).reshape(shape).astype(v.aval.dtype))
            continue
        ids.append(np.arange(table, table + size, dtype=np.int64).reshape(shape))
        table += size
        texts.append(f"flat({size},{operand})")
    params = eqn.primitive.get_bind_params(eqn.params)
    functions, params = params if isinstance(params, tuple) else ((), params)
    with jax.ensure_compile_time_eval():
        out = eqn.primitive.bind(*functions, *map(jnp.asarray, ids), **params)
    return text.let(f"pick({_list(np.ravel(np.asarray(out)))},{','.join(texts)})")


def _iota(text, eqn, operands):
    p = eqn.params
    array = np.arange(p["shape"][p["dimension"]])
    shape = [-1 if d == p["dimension"] else 1 for d in range(len(p["shape"]))]
    return text.constant(np.broadcast_to(array.reshape(shape), p["shape"]))


RULES: dict[str, Callable[..., Any]] = {
    "broadcast_in_dim": _broadcast,
    "transpose": _transpose,
    "slice": _slice,
    "rev": _rev,
    "concatenate": _concatenate,
    "split": _split,
    "pad": _pad,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update,
    **{f"reduce_{name}": _reduce(op) for name, op in REDUCTIONS.items()},
    **{f"cum{name}": _cumulate(REDUCTIONS[name]) for name in ("sum", "prod", "max", "min")},
    "dot_general": _dot,
    "custom_linear_solve": _solve,
    "scan": _scan,
    "while": _while,
    "cond": _cond,
    "gather": _moved_by_number,
    "scatter": _moved_by_number,
    "tile": _moved_by_number,
    "stack": _concatenate,
    "iota": _iota,
}
"""{primitive of jax: function (text, equation, operands) -> text of the result, or a list}."""


@functools.cache
def library() -> dict[str, str]:
    """Return {name: text} of the functions that calls of arrays call."""
    source = resources.files("jaxtank.export.whole").joinpath("arrays.js").read_text("utf-8")
    parts = re.split(r"\n(?=function )", source)[1:]
    found = {re.findall(r"function (\w+)", part)[0]: part.strip() for part in parts}
    own = {name: text.strip() for name, text in MATRICES.items()}
    return {**found, **own, "rint": ROUND.strip(), "part": PART, "F": "const F=(...v)=>new Float64Array(v);"}


PART = "function part(a, b, m) {\n  return m.subarray(a, b);\n}"


def called(text: str) -> list[str]:
    """Return the functions of `library` that a text calls, and those that they call."""
    found: dict[str, str] = {}
    rest = [text]
    while rest:
        now = rest.pop()
        for name, source in library().items():
            if name not in found and re.search(rf"(?<![\w.]){name}\(", now):
                found[name] = source
                rest.append(source)
    return list(found.values())

"""The operations of a jaxpr on whole arrays as lines of JavaScript."""

import itertools
import re
from collections.abc import Callable
from typing import Any

import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Literal

from jaxtank.export.lowering import Writer
from jaxtank.export.primitives import constant as folded
from jaxtank.export.primitives import elements, no_code
from jaxtank.export.simplify import FUNCTIONS, OPERATORS
from jaxtank.export.statements import Ref
from jaxtank.export.whole import array_algebra, array_loops, array_moves
from jaxtank.export.whole.array_dependence import CONTROL
from jaxtank.export.whole.array_moves import spread, view
from jaxtank.export.whole.array_values import called_by, constant, is_literal
from jaxtank.export.whole.compact import Text

ALIASES = (
    "reshape",
    "squeeze",
    "expand_dims",
    "stop_gradient",
    "copy",
    "copy_p",
    "reduce_precision",
)
ELEMENTWISE = {*FUNCTIONS, *OPERATORS, "add_any", "clamp", "integer_pow", "select_n", "xor"}
ELEMENTWISE |= {"convert_element_type", "div", "rem"}
NAMED = ("_cholesky", "_cholesky_solve", "_weighted")
"""Functions of `jaxtank.analysis.elimination` that are written as matrix operations."""
RULES: dict[str, Callable[..., Any]] = {
    **array_moves.RULES,
    **array_algebra.RULES,
    **array_loops.RULES,
}
"""{primitive of jax: function (text, equation, operands) -> text of the result, or a list}."""


class ArrayText:
    """The lines of a function on arrays. Values are texts: names of arrays, or numbers."""

    def __init__(self, names, outer=None):
        self.names = names
        self.sizes: dict[str, int] = outer.sizes if outer else {}
        self.made: set[str] = set()  # arrays that lines of this block fill
        self.lines: list[tuple[str, str, frozenset]] = []
        self.constants: dict[str, str] = outer.constants if outer else {}
        self.numbers: dict[str, np.ndarray] = outer.numbers if outer else {}

    def inner(self):
        """Return an empty text for the lines of a block inside."""
        return ArrayText(self.names, self)

    def constant(self, array):
        """Return the text of an array of numbers, which stands in front of everything else."""
        text = constant(array)
        if is_literal(text):
            return text
        if text not in self.constants:
            self.constants[text] = next(self.names)
        self.numbers[self.constants[text]] = np.ravel(array)
        return self.constants[text]

    def live(self, results):
        """Return the lines that results depend on."""
        wanted, kept = set(re.findall(r"\w+", " ".join(results))), []
        for name, line, reads in reversed(self.lines):
            if name in wanted:
                kept += [line] if line else []
                wanted |= reads
        return kept[::-1]

    def kept(self, lines):
        """Return the lines that make the arrays which lines read and are there before them."""
        read = set(re.findall(r"\w+", " ".join(lines)))
        found = [f"const {n}={t};" for t, n in self.constants.items() if n in read]
        own = [n for n in self.sizes if n in read]
        if own:
            sizes = ",".join(str(self.sizes[n]) for n in own)
            found.append(f"const[{','.join(own)}]=arrays({sizes});")
        return found

    def array(self, size):
        """Return the name of an array that lines fill."""
        name = next(self.names)
        self.sizes[name] = size
        self.made.add(name)
        return name

    def let(self, expression):
        """Return the name of a new constant."""
        name = next(self.names)
        self.line(name, f"const {name}={expression};")
        return name

    def line(self, name, line):
        """Add a line that defines a name."""
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
        if (
            all(is_known(self, o) for o in operands)
            and called_by(eqn) is None
            and name not in CONTROL
        ):
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
        inner = called_by(eqn)
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
            found = (
                np.broadcast_to(found, (int(np.prod(v.aval.shape)),)) if found.size == 1 else found
            )
            values.append(elements(found.reshape(v.aval.shape)))
        return [self.constant(np.array(e.tolist(), dtype=float)) for e in folded(eqn, values)]

    def _named(self, eqn, operands):
        """The matrix operations of `jaxtank.analysis.elimination`."""
        shape = eqn.invars[0].aval.shape
        n = shape[-1]

        def turned(operand):
            return view(self, operand, [n, n], [1, n])

        if eqn.params["name"] == "_cholesky":
            return turned(self.let(f"cholesky({n},{operands[0]})"))
        if eqn.params["name"] == "_cholesky_solve":
            upper, b = operands
            lower = turned(upper)
            return self.let(f"backward({n},1,{lower},forward({n},1,{lower},{b}))")
        g, weight = operands
        rows = shape[0]
        scaled = self.array(rows * n)
        self.line(scaled, f"scaled({rows},{n},{g},{weight},{scaled});")
        return self.product((1, n, rows, n), scaled, g)

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
        e = np.asarray(out, dtype=object).item()
        if e == Ref("x"):
            return operands[0]
        operands = [spread(self, v, eqn.outvars[0], o) for v, o in zip(eqn.invars, operands)]
        size = int(np.prod(eqn.outvars[0].aval.shape))
        own = [entry(o, v.aval.size, size) for v, o in zip(eqn.invars, operands)]
        text = Text({Ref(x): o for x, o in zip("xyz", own)}, (f"x{i}" for i in itertools.count()))
        lines = text.write(writer.scopes[0], [e])
        return self.filled(size, "".join(lines), text.of(e))

    def filled(self, size, lines, body):
        """Return the name of an array filled with `body` of its entry x, after `lines`."""
        name = self.array(size)
        place = "0" if size == 1 else "x"
        inside = f"{lines}{name}[{place}]={body};"
        inside = f"{{{inside}}}" if lines else inside
        self.line(name, inside if size == 1 else f"for(let x=0;x<{size};++x){inside}")
        return name

    def product(self, sizes, left, right):
        """Return the name of the matrix product of sizes (batch, m, k, n)."""
        name = self.array(sizes[0] * sizes[1] * sizes[3])
        self.line(name, f"matmul({','.join(map(str, sizes))},{left},{right},{name});")
        return name


def entry(operand, size, of):
    """Return the text of entry x of an operand with `size` entries, in an array of `of`."""
    if is_literal(operand):
        return f"({operand})" if operand.startswith("-") else operand
    return f"{operand}[{0 if size == 1 or of == 1 else 'x'}]"


def is_known(text, name):
    """Whether a value of a text is a constant."""
    return is_literal(name) or name in text.numbers


def _single(e):
    out = np.empty((), dtype=object)
    out[()] = e
    return out


class _Scalar:
    """A variable of a scalar program that stands for an array's element."""

    def __init__(self, aval):
        self.aval = ShapedArray((), aval.dtype)


def _scalar(v):
    return _Scalar(v.aval)

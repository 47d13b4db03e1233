"""The operations of a jaxpr on whole arrays as lines of JavaScript.

Imported by `jaxtank.export.whole.arrays`.
"""

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
from jaxtank.export.whole.array_moves import spread
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
        operands = [spread(self, v, eqn.outvars[0], o) for v, o in zip(eqn.invars, operands)]
        arguments = ",".join("xyz"[: len(operands)])
        f = (
            f"({arguments})=>{{{''.join(lines)}return {body}}}"
            if lines
            else f"({arguments})=>{body}"
        )
        size = int(np.prod(eqn.outvars[0].aval.shape))
        return self.let(f"map({f},{size},{','.join(operands)})")


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

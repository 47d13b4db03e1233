"""From a traced function to statements on scalars, which a printer turns into a language.

Every element of an array becomes a `Ref` or a number. What only moves elements (slices, transposes,
broadcasts) costs nothing, what depends on constants alone is computed here, and what is not used is
left out. Loops (`jax.lax.scan`, `jax.lax.while_loop`) and products of large matrices stay loops.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend.core import Literal

from jaxtank.export.arrays import FEW, assembled, copied, elements_of, place_of
from jaxtank.export.primitives import NAMED, RULES, constant, elements, kind_of, no_code, written
from jaxtank.export.simplify import is_number, simplified
from jaxtank.export.statements import REAL, Array, Define, Matrix, Ref, names, used


class Writer:
    """The statements of one function while they are written."""

    # scopes: the statements of the function and of the loops that are open; known: in each of them,
    # {operation: its Ref}, so that nothing is computed twice.

    large = 300
    """Number of multiplications in a matrix product above which it is a loop."""
    sparse = False
    """Whether multiplications by the number 0 are not counted."""

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
        for known in self.known:
            if key in known:
                return known[key]
        ref = Ref(self.fresh())
        self.scopes[-1].append(Define(kind, ref.name, op, args))
        self.known[-1][key] = ref
        return ref

    def array(self, entries, kind=REAL):
        """Return the name of an array with these entries (any shape, row by row)."""
        name = self.fresh("a")
        self.sizes[name] = entries.size
        self.scopes[-1].append(Array(name, tuple(entries.ravel()), kind))
        return name

    def new_array(self, kind, size):
        """Return the name of an array that a statement will fill."""
        name = self.fresh("m")
        self.sizes[name] = size
        return name

    def matrix(self, op, operands, sizes, shape):
        """Return the elements (shape) of a Matrix operation on the arrays of `operands`."""
        name = self.new_array(REAL, int(np.prod(shape)))
        self.scopes[-1].append(Matrix(name, op, tuple(self.array(o) for o in operands), sizes))
        return elements_of(name, shape)

    def run(self, jaxpr, consts, arguments):
        """Return the outputs of a jaxpr, arrays of elements, as its `arguments` are."""
        values = {
            **dict(zip(jaxpr.constvars, map(elements, consts))),
            **dict(zip(jaxpr.invars, arguments)),
        }

        def read(v):
            return elements(v.val) if isinstance(v, Literal) else values[v]

        for eqn in jaxpr.eqns:
            out = self.equation(eqn, [read(v) for v in eqn.invars])
            for v, value in zip(eqn.outvars, out):
                values[v] = np.asarray(value, dtype=object).reshape(v.aval.shape)
        return [np.asarray(read(v), dtype=object) for v in jaxpr.outvars]

    def equation(self, eqn, operands):
        """Return the outputs of one equation of a jaxpr, arrays of elements."""
        name = eqn.primitive.name
        if name in ("jit", "pjit") and eqn.params["name"] in NAMED:
            return [NAMED[eqn.params["name"]](self, *operands)]
        inner = None if name in RULES else _called(eqn)
        if inner is not None:
            return self.run(getattr(inner, "jaxpr", inner), getattr(inner, "consts", ()), operands)
        if all(is_number(e) for o in operands for e in o.ravel()):
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
        whole = tuple(Ref(name, i) for i in range(self.sizes.get(name, 0)))
        if elements == whole:
            return name
        if self.loops and place_of(self, entries) is not None:
            return copied(self, kind, entries)
        if self.loops and kind == REAL and entries.size > 4 * FEW:
            joined = assembled(self, kind, entries)
            if joined is not None:
                return joined
        if len(self.scopes) > 1:
            return super().array(entries, kind)
        key = tuple((type(e), e) for e in elements)
        if key not in self.arrays:
            self.arrays[key] = super().array(entries, kind)
        return self.arrays[key]


def _called(eqn):
    """The jaxpr that an equation calls, None of one that calls none."""
    parameters = (eqn.params.get(k) for k in ("jaxpr", "call_jaxpr", "fun_jaxpr"))
    return next((p for p in parameters if p is not None), None)


class Lowered(NamedTuple):
    """Result of `lower_all`."""

    statements: list
    outputs: Any
    """Results of the function, with arrays of Refs and numbers instead of arrays."""
    lines: dict
    """{Ref of the first entry of a Line, an array that is read or written at an index: name}."""


def lower_all(f, arguments, writer=None):
    """Return the Lowered form of a function."""
    closed, shape = jax.make_jaxpr(f, return_shape=True)(*arguments.values())
    writer, moved = writer or Writer(), written(closed.jaxpr)
    inputs, starts = [], {}
    for name, tree in arguments.items():
        for start, array in _inputs(writer, name, tree):
            if closed.jaxpr.invars[len(inputs)] in moved:
                starts[start] = f"{name}_{start.index}"
                array = elements_of(starts[start], (array.size,))
            inputs.append(array)
    outputs = writer.run(closed.jaxpr, closed.consts, inputs)
    read = names(e for out in outputs for e in out.ravel())
    statements = used(writer.scopes[0], read)
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

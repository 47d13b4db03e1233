"""Work on larger arrays as calls of JavaScript functions, where single elements would fill pages.

Designs of gains, quadratic programmes and their derivatives: whatever has an array of more than
`LARGEST` entries.
"""

import re

import numpy as np

from jaxtank.export import lines
from jaxtank.export.lowering import Writer
from jaxtank.export.simplify import is_number
from jaxtank.export.statements import Matrix, Ref
from jaxtank.export.whole.array_dependence import CONTROL, groups_of
from jaxtank.export.whole.array_text import ALIASES, NAMED, RULES, ArrayText, is_known
from jaxtank.export.whole.array_values import called_by, listed
from jaxtank.export.whole.compact import short_names

LARGEST = 16
"""Number of entries of an array up to which its elements are computed one by one."""
PARTED = ("scan", "cond")
"""Those whose results are computed apart where they depend on different arguments."""


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
        if name in lines.RULES and lines.line_of(operands[0]) not in (None, *self.sizes):
            return super().equation(eqn, operands)
        if name not in ("lu", *ALIASES) and _is_large(eqn, operands):
            if all(is_number(e) for o in operands for e in o.ravel()) and name not in CONTROL:
                return super().equation(eqn, operands)
            if name in CONTROL or called_by(eqn) is None or eqn.params.get("name") in NAMED:
                return self._call(eqn, operands)
        return super().equation(eqn, operands)

    def _call(self, eqn, operands):
        """The elements of the results of an equation as a function of arrays; of a loop, a function
        for each group of results that depend on the same arguments.
        """
        parts = eqn.primitive.name in PARTED
        groups = groups_of(eqn) if parts else [range(len(eqn.outvars))]
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
        if eqn.primitive.name in PARTED:
            found = RULES[eqn.primitive.name](text, eqn, own, wanted)
        else:
            found = text.equation(eqn, own)
        if len(found) > 1:
            result = f"chain(1,{listed(sizes)},[{','.join(found)}])"
        else:
            result = f"{found[0]}.slice()" if found[0] in text.sizes else found[0]
        body = [*text.live(found), f"return {result};"]
        read = set(re.findall(r"\w+", " ".join(body)))
        used = [i for i, n in enumerate(own) if n in read and not is_known(text, n)]
        kept = text.kept(body)
        body = f"({','.join(own[i] for i in used)})=>{{" + "\n".join(body) + "}"
        if kept:
            body = "(()=>{" + "\n".join(kept) + f"\nreturn{body}}})()"
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
        """The name of an array with these elements: a result, a part of one, or a new one."""
        entries = tuple(operand.ravel())
        first = entries[0] if entries else None
        if isinstance(first, Ref) and isinstance(first.index, int) and first.name in self.sizes:
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


def _is_large(eqn, operands):
    shapes = [*(o.shape for o in operands), *(v.aval.shape for v in eqn.outvars)]
    if eqn.primitive.name == "scan":
        p = eqn.params
        moved = (
            len(operands) > p["num_consts"] + p["num_carry"] or len(eqn.outvars) > p["num_carry"]
        )
        return moved or any(np.prod(s, dtype=int) > LARGEST for s in shapes)
    return any(np.prod(s, dtype=int) > LARGEST for s in shapes)

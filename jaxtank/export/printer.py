"""How statements are printed: templates that a language fills in, and the header of a file."""

import re
from collections.abc import Mapping

import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.core.labels import labels_of, names_of
from jaxtank.core.tree import walk
from jaxtank.export.statements import REAL, TRUTH, WHOLE, Array, Define, Loop, Matrix, Ref, Until

WIDTH = 126
"""Length of a line of an array, without its indentation."""

OPERATIONS = {
    "add": "{0} + {1}",
    "sub": "{0} - {1}",
    "mul": "{0} * {1}",
    "div": "{0} / {1}",
    "neg": "-{0}",
    "square": "{0} * {0}",
    "lt": "{0} < {1}",
    "le": "{0} <= {1}",
    "gt": "{0} > {1}",
    "ge": "{0} >= {1}",
    "eq": "{0} == {1}",
    "truth": "{0} != 0",
}
"""Operations that most languages write in the same way, as formats of their arguments."""

_FUNCTIONS = """
sqrt exp log tanh sin cos floor erf erfc log1p expm1 tan asin acos atan sinh cosh asinh acosh atanh
ceil
"""
FUNCTIONS = _FUNCTIONS.split()
"""Functions of one number that most languages have by the same name; atan2 is one of two."""


class Printer:
    """The statements of a language: templates, of which a derived class sets its own."""

    operations: Mapping[str, str] = OPERATIONS
    kinds: Mapping[str, str] = {REAL: "", WHOLE: "", TRUTH: ""}
    rename: Mapping[str, str] = {}
    """{argument of the program (s, t, y, r, dr, ddr, u): its name in the language}."""
    first = 0
    """Index of the first entry of an array."""
    entry = "{0}[{1}]"
    real = "{0}"
    truths = ("false", "true")
    nan, infinity = "NAN", "INFINITY"
    assign = constant = variable = "{name} = {value};"
    open_array, close_array, line_break = "{name} = [", "];", ""
    matrix_call = ""
    """A Matrix statement, of name, op, size and arguments; "": the language has none."""
    matrices = ("product", "cholesky", "forward", "backward")
    """Operations of Matrix statements that the language has."""
    counted, endless, end = "for i = 1:{0}", "while true", "end"
    until = "if not ({0}) break"

    def value(self, e):
        """Return a number or a Ref as text."""
        if isinstance(e, Ref):
            name = self.rename.get(e.name, e.name)
            return name if e.index is None else self.entry.format(name, self._index(e.index))
        if isinstance(e, bool):
            return self.truths[e]
        if np.isnan(e):
            return self.nan
        if np.isinf(e):
            return self.infinity if e > 0 else f"(-{self.infinity})"
        text = f"({e!r})" if str(e).startswith("-") else repr(e)
        return text if isinstance(e, int) else self.real.format(text)

    def _index(self, index):
        if isinstance(index, Ref):
            return f"{index.name} + {self.first}" if self.first else index.name
        return index + self.first

    def right(self, op, args):
        """Return op(args) as an expression."""
        if op not in self.operations:
            raise InputError(f"--lang: this language has no counterpart of the operation {op}")
        return self.operations[op].format(*map(self.value, args))

    def lines(self, statements, indent="    "):
        """Return the lines of a list of statements."""
        methods = {
            Define: self._define,
            Array: self._array,
            Matrix: self._matrix,
            Until: self._until,
            Loop: self._loop,
        }
        return [indent + line for s in statements for line in methods[type(s)](s)]

    def _set(self, template, kind, name, value):
        return template.format(kind=self.kinds[kind], name=name, value=value)

    def _define(self, s):
        return [self._set(self.constant, s.kind, s.name, self.right(s.op, s.args))]

    def _array(self, s):
        rows, line = [], self.open_array.format(name=s.name, size=len(s.entries))
        for item in map(self.value, s.entries):
            if len(line) + len(item) > WIDTH:
                rows.append(line.rstrip() + self.line_break)
                line = "    "
            line += f"{item}, "
        return [*rows, line.rstrip(", ") + self.close_array]

    def _matrix(self, s):
        if not self.matrix_call or s.op not in self.matrices:
            raise InputError(f"--lang: this language has no counterpart of the operation {s.op}")
        rows = {"product": lambda m, k, n: m * n, "cholesky": lambda n: n * n}
        size = rows.get(s.op, lambda n, k: n * k)(*s.sizes)
        arguments = ", ".join([*map(str, s.sizes), *s.operands])
        call = self.matrix_call.format(name=s.name, op=s.op, size=size, arguments=arguments)
        return call.split("\n")

    def _until(self, s):
        return [self.until.format(self.value(s.test))]

    def _loop(self, s):
        lines = [self._set(self.variable, k, n, self.value(start)) for k, n, start in s.carried]
        lines.append(self.endless if s.count is None else self.counted.format(s.count))
        lines += self.lines(s.body)
        for (kind, name, _), new in zip(s.carried, s.new):
            lines.append("    " + self._set(self.constant, kind, f"n{name}", self.value(new)))
        for kind, name, _ in s.carried:
            lines.append("    " + self._set(self.assign, kind, name, f"n{name}"))
        return [*lines, self.end] if self.end else lines


def function_name(case):
    """Return the name of a case with each character that no language allows replaced by _."""
    return re.sub(r"[^A-Za-z0-9]+", "_", case.name).strip("_")


def comment(text):
    """Return a text as one line that may stand in a comment of any language and does not end it."""
    # Characters that do not print, line breaks of every script among them, are replaced by spaces,
    # backslashes by slashes; the ends of comments and the trigraphs of C are taken apart.
    text = "".join(c if c.isprintable() else " " for c in text).replace("\\", "/")
    return re.sub(r"\*(?=/)|/(?=\*)|\?(?=\?)", lambda found: found[0] + " ", text)


def header(program, mark, call, begin):
    """Return the comment at the top of a file: the case, the arguments with units, the gains."""
    case = program.case
    length, drive = case.loop.units
    outputs, pumps = (s * (n > 1) for s, n in (("s", program.outputs), ("s", program.pumps)))
    lines = [
        f"{case.name}: {case.title}",
        "Generated by `jaxtank export` from the controller and the observer that jaxtank"
        " simulates. Do not edit.",
        "",
        f"Sampling period {case.clock.dt:g} s: call {call} once each period.",
        f"t: time [s]; y: {program.tanks} measured levels [{length}], of every tank in the order of"
        " the rig;",
        f"r, dr, ddr: {program.outputs} setpoint{outputs} [{length}], with first [{length}/s] and"
        f" second [{length}/s^2] derivative;",
        f"u: {program.pumps} pump input{pumps} [{drive}], within the limits of the pumps. {begin}",
        *_order(case.loop.plant),
        "",
        *sorted(_gains(case)),
    ]
    return [f"{mark} {comment(line)}".rstrip() for line in lines]


def _order(plant):
    """Lines with the names of tanks, outputs and inputs in their order, where they have some."""
    for symbol, kind, many in (("y", "tank", plant.tanks), ("r", "output", len(plant.outputs))):
        if any(names_of(plant, kind)):
            yield f"{symbol}: {labels_of(plant, kind, range(many))}"
    if any(names_of(plant, "pump")):
        yield f"u: {labels_of(plant, 'pump', range(plant.pumps))}"


def _gains(case):
    """A line for each parameter of the controller: name, value and unit."""
    for name, value, meta in walk(case.loop.controller, "controller.", units=case.loop.units):
        if value is not None and ".model." not in name:
            unit = "" if meta["unit"] == "-" else f" {meta['unit']}"
            text = np.array2string(np.asarray(value), separator=", ", precision=10, threshold=64)
            yield f"{name} = {text.replace(chr(10), '')}{unit}"

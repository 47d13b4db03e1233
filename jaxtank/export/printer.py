"""How statements are printed: templates that a language fills in, and the header of a file."""

import math
import re
from collections.abc import Mapping

import numpy as np

from jaxtank.core.checks import allowed
from jaxtank.core.errors import InputError
from jaxtank.core.labels import labels_of, names_of, units_of_inputs
from jaxtank.core.tree import parameters, walk
from jaxtank.core.units import local
from jaxtank.export.program import CONTROL, PLANT
from jaxtank.export.statements import REAL, TRUTH, WHOLE, Ref, Vector, View, size_of, template

SMALLEST_SINGLE, LARGEST_SINGLE = (
    float(v) for v in (np.finfo(np.float32).tiny, np.finfo(np.float32).max)
)

WIDTH = 126  # length of a line of an array, without its indentation

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
    "same": "{0}",
}
"""Operations that most languages write in the same way, as formats of their arguments."""

BRACES = {  # operations that C and JavaScript write in the same way
    "not": "!{0}",
    "and": "{0} && {1}",
    "or": "{0} || {1}",
    "remainder": "{0} % {1}",
    "select": "{0} ? {2} : {1}",
    "item": "{0}[{1}]",
}

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
    first = 0  # index of the first entry of an array
    entry = "{0}[{1}]"
    single = False  # whether numbers are of single precision
    when, close_when = "if ({0})", ""
    truths = ("false", "true")
    nan, infinity = "NAN", "INFINITY"
    assign = constant = variable = "{name} = {value};"
    open_array, close_array, line_break = "{name} = [", "];", ""
    matrix_call = ""  # a Matrix statement, of name, op, size and arguments
    empty, each, put = "", "", "{place} = {value};"
    """An array before it is filled; the loop over one of its axes; an assignment to an entry."""
    counted, endless, end = "for i = 1:{0}", "while true", "end"
    """`endless` "": the language has loops of a bounded number of passes alone."""
    store = ""  # a Store statement, of name, array, index and value; "": the language has none
    places: Mapping[Ref, str] = {}  # {Ref: its text, where that is another than its name}
    until = "if not ({0}) break"

    def value(self, e):
        """Return a number or a Ref as text."""
        if isinstance(e, Ref):
            if e in self.places:
                return self.places[e]
            name = self.places.get(Ref(e.name), self.rename.get(e.name, e.name))
            return name if e.index is None else self.entry.format(name, self._index(e.index))
        if isinstance(e, bool):
            return self.truths[e]
        if np.isnan(e):
            return self.nan
        if np.isinf(e):
            return self.infinity if e > 0 else f"(-{self.infinity})"
        if self.single and isinstance(e, float) and e != 0.0:  # as near as single precision has it
            size = float(np.clip(abs(e), SMALLEST_SINGLE, LARGEST_SINGLE))
            e = e if size == abs(e) else float(np.copysign(size, e))
        return f"({e!r})" if str(e).startswith("-") else repr(e)

    def _index(self, index):
        if isinstance(index, Ref):
            return f"{index.name} + {self.first}" if self.first else index.name
        return index + self.first

    def right(self, op, args):
        """Return op(args) as an expression."""
        if op not in self.operations:
            raise InputError(f"--lang: this language has no counterpart of the operation {op}")
        return self._applied(op, args, [self.value(e) for e in args])

    def _applied(self, op, args, texts):
        """An operation on arguments, which are written as `texts`."""
        return self.operations[op].format(*texts)

    def lines(self, statements, indent="    "):
        """Return the lines of a list of statements."""
        method = lambda s: getattr(self, f"_{type(s).__name__.lower()}")
        return [indent + line for s in statements for line in method(s)(s)]

    def _set(self, template, kind, name, value):
        return template.format(kind=self.kinds[kind], name=name, value=value)

    def _define(self, s):
        return [self._set(self.constant, s.kind, s.name, self.right(s.op, s.args))]

    def _array(self, s):
        words = {"name": s.name, "size": len(s.entries), "real": self.kinds[s.kind]}
        rows, line = [], self.open_array.format(**words)
        for item in map(self.value, s.entries):
            if len(line) + len(item) > WIDTH:
                rows.append(line.rstrip() + self.line_break)
                line = "    "
            line += f"{item}, "
        return [*rows, line.rstrip(", ") + self.close_array]

    def _matrix(self, s):
        arguments = ", ".join([*map(str, s.sizes), *(self.value(Ref(o)) for o in s.operands)])
        words = {"name": s.name, "op": s.op, "size": size_of(s), "arguments": arguments}
        return self.matrix_call.format(**words, real=self.kinds[REAL]).split("\n")

    def _each(self, s):
        counters = [f"e{d}" for d in range(len(s.shape) + len(s.over))]
        steps = s.steps or [math.prod(s.shape[d + 1 :]) for d in range(len(s.shape))]
        if s.array:
            target = self.rename.get(s.array, s.array)
            self.rename = {**self.rename, s.name: target}
            declared = []
        else:
            target, declared = s.name, self._empty(s.kind, s.name, math.prod(s.shape))
        place = self._entry_at(target, s.offset, steps, counters)
        if s.over:
            filling = self._reduction(s, place, counters)
        else:
            value = self._applied(s.op, s.args, [self._argument(a, counters) for a in s.args])
            filling = [self.put.format(place=place, value=value)]
        return [*declared, *self._around(s.shape, counters, filling)]

    def _reduction(self, s, place, counters):
        """The lines that reduce one entry of an `Each`."""
        (view,), outer = s.args, counters[: len(s.shape)]
        ahead = [*outer, *(["0"] * len(s.over))]
        put = lambda value: self.put.format(place=place, value=value)
        if s.op in ("argmax", "argmin"):
            best = self._argument(view, [*outer, place])
            test = f"{self._argument(view, counters)} {'><'[s.op == 'argmin']} {best}"
            start, step = put("0"), f"{self.when.format(test)} {put(counters[-1])}{self.close_when}"
        else:
            neutral = {"add": self.value(0.0), "mul": self.value(1.0)}
            start = put(neutral.get(s.op, self._argument(view, ahead)))
            step = put(self.operations[s.op].format(place, self._argument(view, counters)))
        return [start, *self._around(s.over, counters[len(outer) :], [step])]

    def _around(self, shape, counters, lines):
        """Lines in loops over the axes of a shape."""
        for counter, size in reversed(list(zip(counters, shape))):
            inside = ["    " + line for line in lines]
            head = self.each.format(counter, size, size - 1)
            if self.end != "}":
                lines = [head, *inside, self.end]
            elif sum(not line.startswith(" ") for line in lines) > 1:
                lines = [head + " {", *inside, "}"]
            else:
                lines = [head, *inside]
        return lines

    def _argument(self, a, counters):
        if not isinstance(a, View):
            return self.value(a)
        return self._entry_at(a.name, a.offset, a.strides, counters)

    def _entry_at(self, name, offset, strides, counters):
        """The text of an entry of an array at offset + sum_d strides[d] counters[d]."""
        terms = [f"{s} * {c}" if s > 1 else c for s, c in zip(strides, counters) if s and c != "0"]
        start = offset.name if isinstance(offset, Ref) else offset + self.first
        if isinstance(offset, Ref) and self.first:
            terms = [*terms, str(self.first)]
        terms = [*terms, str(start)] if start or not terms else terms
        return self.entry.format(self.value(Ref(name)), " + ".join(terms))

    def _empty(self, kind, name, size):
        """The lines that declare an array."""
        text = self.empty.format(kind=self.kinds[kind], name=name, size=size)
        return [text] if text else []

    def _copy(self, vector, name, source):
        """The lines that copy an array."""
        place, value = (self._entry_at(n, 0, [1], ["e0"]) for n in (name, source))
        return self._around((vector.size,), ["e0"], [self.put.format(place=place, value=value)])

    def _store(self, s):
        if not self.store:
            raise InputError("--lang: this language has no arrays that are changed entry by entry")
        words = {"name": s.name, "array": s.array, "real": self.kinds[REAL]}
        words |= {"index": self.value(s.index), "value": self.value(s.value)}
        return self.store.format(**words).split("\n")

    def _until(self, s):
        return [self.until.format(self.value(s.test))]

    def _passes(self, count):
        return self.counted.format(count)

    def _loop(self, s):
        lines, ends = [], []
        for kind, name, start in s.carried:
            if isinstance(kind, Vector):
                lines += self._empty(kind.kind, name, kind.size)
                lines += self._copy(kind, name, start.name)
            else:
                lines.append(self._set(self.variable, kind, name, self.value(start)))
        passes = s.count if self.endless or s.count is not None else s.most
        if passes is None and not self.endless:
            raise InputError("--lang: a loop of this controller has no bound on its passes")
        lines.append(self.endless if passes is None else self._passes(passes))
        lines += self.lines(s.body)
        for (kind, name, _), new in zip(s.carried, s.new):
            if not isinstance(kind, Vector):
                lines.append("    " + self._set(self.constant, kind, f"n{name}", self.value(new)))
                ends.append(self._set(self.assign, kind, name, f"n{name}"))
            elif self.rename.get(new.name, new.name) != name:
                ends += self._copy(kind, name, new.name)
        lines += ["    " + line for line in ends]
        return [*lines, self.end] if self.end else lines


def function_name(case):
    """Return the name of a case with each character that no language allows replaced by _."""
    return re.sub(r"[^A-Za-z0-9]+", "_", case.name).strip("_")


def comment(text):
    """Return a text as one line that may stand in a comment of any language and does not end it."""
    # Characters that do not print, line breaks of every script among them, are replaced by spaces,
    # backslashes by slashes; ends of comments and the trigraphs of C are taken apart.
    text = "".join(c if c.isprintable() else " " for c in text).replace("\\", "/")
    return re.sub(r"\*(?=[/)])|[/(](?=\*)|\?(?=\?)", lambda match: match[0] + " ", text)


def header(program, mark, call, begin):
    """Return the comment at the top of a file: the case, the arguments with units, the gains."""
    case = program.case
    part = "plant with its instruments" if program.plant else "controller and the observer"
    lines = [
        f"{case.name}: {case.title}",
        f"Generated by `jaxtank export` from the {part} that jaxtank simulates. Do not edit.",
        "",
        f"Sampling period {case.clock.dt:g} s: call {call} once each period.",
        *_arguments(program, begin),
        *_order(case.loop.plant),
        "",
        *(_compiled_in(program) if program.entries else sorted(_gains(case))),
    ]
    return [f"{mark} {comment(line)}".rstrip() for line in lines]


def _arguments(program, begin):
    """Lines on the arguments of a controller or plant."""
    names = {"length": "cm", "flow": "cm^3/s", "volume": "cm^3"}
    loop = program.case.loop
    words = {name: local(unit, loop.units) for name, unit in names.items()}
    words["drive"] = units_of_inputs(loop.plant)
    counted = lambda n, what: f"{n} {what}{'s' * (n > 1)}"
    words |= {"tanks": program.tanks, "pumps": program.pumps, "begin": begin}
    words |= {"setpoints": counted(program.outputs, "setpoint")}
    words |= {"inputs": counted(program.pumps, "pump input")}
    lines = template("plant.txt" if program.plant else "control.txt", **words).splitlines()
    if program.plant or not program.entries:
        return lines
    bump = (
        "returns to automatic operation without a bump, as far as it can command the manual inputs"
        " (its limits; inputs that it moves together): its state follows them."
    )
    if not program.case.loop.controller.bumpless:
        bump = (
            "has no integral action of its own to follow the manual inputs: back in automatic"
            " operation its inputs may jump."
        )
    return [*lines, f"Manual operation applies inputs of an operator. The controller {bump}"]


def _compiled_in(program):
    """Lines on structure, sampling and long tables, which are not parameters."""
    loop, roots = program.case.loop, PLANT if program.plant else CONTROL
    facts = [f"clock.dt = {program.case.clock.dt:g}"]
    facts += [
        f"{name} = {value}"
        for name, value, _ in walk(loop, kind="static")
        if name.split(".")[0] in roots and ".model." not in name and value not in (None, ())
    ]
    traced = {name for name, _ in program.entries}
    long = [n for n in parameters(loop) if n.split(".")[0] in roots and n not in traced]
    facts += [f"{name} (a table)" for name in long if np.size(parameters(loop)[name])]
    yield "Compiled in, and changed by a new export alone:"
    yield from (f"    {fact}" for fact in facts)


def field_of(name):
    """Return the dotted name of a parameter as a name of most languages."""
    return name.replace(".", "_")


def note_of(parameter):
    """Return the dotted name, description, unit and range of a parameter."""
    unit = "" if parameter.meta["unit"] == "-" else f" [{parameter.meta['unit']}]"
    range_ = allowed(parameter.meta, 0.0)
    words = f"{parameter.name}: {parameter.meta['doc']}{unit}"
    return comment(f"{words}, {range_}" if range_ else words)


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

"""Controllers and plants as C99: a header with the parameters, and a file of functions."""

import json

import numpy as np

from jaxtank.core.labels import signal_units
from jaxtank.export import statements as ir
from jaxtank.export.printer import BRACES, FUNCTIONS, OPERATIONS, Printer, field_of, header, note_of

WHOLES = {"sign": "({0} > 0) - ({0} < 0)", "abs": "{0} < 0 ? -{0} : {0}"}
"""Operations on whole numbers whose result is one, where those on real ones give a real one."""


class C(Printer):
    """The statements of C99, in double or single precision."""

    kinds = {ir.REAL: "double", ir.WHOLE: "int", ir.TRUTH: "int"}
    truths = ("0", "1")
    constant, variable = "const {kind} {name} = {value};", "{kind} {name} = {value};"
    empty, each = "{kind} {name}[{size}];", "for (int {0} = 0; {0} < {1}; ++{0})"
    open_array, close_array = "const {real} {name}[{size}] = {{", "};"
    matrix_call = "{real} {name}[{size}];\n{op}({arguments}, {name});"
    counted, endless, end = "for (int i = 0; i < {0}; ++i) {{", "", "}"
    until = "if (!({0})) break;"
    store = "{array}[{index}] = {value};\n{real} *const {name} = {array};"

    def __init__(self, precision="double", places=()):
        f = "f" if precision == "float" else ""
        self.type, self.suffix, self.places = precision, f, dict(places)
        self.single = precision == "float"
        self.kinds = {**self.kinds, ir.REAL: precision}
        self.rename = {"s": "state->s"}
        unit = f"1.0{f}"
        self.operations = {
            **OPERATIONS,
            **BRACES,
            **{name: f"{name}{f}({{0}})" for name in [*FUNCTIONS, "cbrt", "exp2"]},
            **{name: f"{name}{f}({{0}}, {{1}})" for name in ("atan2", "pow")},
            "abs": f"fabs{f}({{0}})",
            "max": "{0} > {1} ? {0} : {1}",
            "min": "{0} < {1} ? {0} : {1}",
            "round": f"rint{f}({{0}})",
            "rem": f"fmod{f}({{0}}, {{1}})",
            "is_finite": "isfinite({0})",
            "ne": "{0} != {1}",
            "rsqrt": f"{unit} / sqrt{f}({{0}})",
            "logistic": f"{unit} / ({unit} + exp{f}(-{{0}}))",
            "quotient": "{0} / {1}",
            "sign": f"({precision})(({{0}} > 0) - ({{0}} < 0))",
            "real": f"({precision}){{0}}",
            "whole": "(int){0}",
        }

    def value(self, e):
        text = super().value(e)
        if isinstance(e, float) and self.suffix and np.isfinite(e):
            return f"{text[:-1]}f)" if text.endswith(")") else f"{text}f"
        return text

    def _define(self, s):
        if s.kind != ir.WHOLE or s.op not in WHOLES:
            return super()._define(s)
        value = WHOLES[s.op].format(*map(self.value, s.args))
        return [self._set(self.constant, s.kind, s.name, value)]

    def as_real(self, e):
        return self.value(e) if isinstance(e, float) else f"({self.type}){self.value(e)}"

    def _array(self, s):
        first, *others = super()._array(s)
        fixed = not any(isinstance(e, ir.Ref) for e in s.entries)
        return [f"static {first}" if fixed else first, *others]


MATRICES = dict(zip(ir.MATRIX_OPERATIONS, ir.parts("functions.c"), strict=True))
"""{matrix operation: a function of its sizes, its operands, row by row, and its result}."""

MANUAL = " * manual: inputs that an operator sets; NULL in automatic operation."


class Text:
    """The two files of a Program."""

    def __init__(self, program, name, precision):
        self.program, self.name, self.real = program, name, precision
        entries = enumerate(program.entries)
        places = {ir.Ref("p", j): f"p->{field_of(n)}{_index(i)}" for j, (n, i) in entries}
        self.plain = C(precision, places)
        for e, (kind, i) in program.constants.items():
            cast = "" if kind == ir.REAL else "(int)"
            places[e] = f"{cast}state->c[{i}]"
        places |= {ir.Ref(n): f"(state->c + {at})" for n, (at, _) in program.arrays.items()}
        self.printer = C(precision, places)
        self.printer.rename = {**self.printer.rename, "on": "manual"}
        arrays = "".join(f", const {precision} *{v}" for v in program.inputs if v != "w")
        results = "".join(f", {precision} *{v}" for v in program.outputs_of)
        first = f"{name}_state *state, const {name}_parameters *p"
        before = results
        if not program.plant:
            before = f", const {precision} *y, const {precision} *u"
            arrays = f", {precision} t{arrays}, const {precision} *manual"
        self.init_call = f"void {name}_init({first}{before})"
        self.step_call = f"void {name}_step({first}{arrays}{results})"

    @property
    def units(self):
        """The declaration of the units of a controller's signals."""
        return f"const char *const {self.name}_units[1 + {self.name.upper()}_PUMPS]"

    def header(self):
        """Return the text of the header."""
        program, name, real = self.program, self.name, self.real
        plant = program.plant
        begin = f"{name}_init takes levels and inputs before the first period (NULL: of the case)."
        begin = f"{name}_init gives those at t = 0." if plant else begin
        counts = max(program.state, 1), program.tanks, program.outputs, program.pumps
        sizes = zip(("STATE", "TANKS", "OUTPUTS", "PUMPS"), counts)
        facts = ", ".join(f"{name.upper()}_{key} = {value}" for key, value in sizes)
        prepared = [f"    {real} c[{program.kept}]; /* results of p alone */"] * bool(program.kept)
        prepared += [f"    {name}_parameters p;"] * bool(program.prepare)
        units = [] if plant else [f"extern {self.units}; /* of y and r, of each u */"]
        names = {"name": name, "NAME": name.upper(), "real": real, "facts": facts}
        names |= {"zero": "d" if plant else "dr, ddr", "manual": "" if plant else f"\n{MANUAL}"}
        names |= {"init": self.init_call, "step": self.step_call, "units": ir.below(units)}
        return ir.template(
            "header.h",
            head="\n".join(header(program, " *", f"{name}_step", begin)),
            fields=ir.below(map(self._declared, program.parameters)),
            prepared=ir.below(prepared),
            **names,
        )

    def _declared(self, p):
        """The line of a parameter in the structure."""
        words = {"separator": ", ", "threshold": 99, "max_line_width": 9999, "precision": 10}
        value = np.array2string(p.value, **words).replace("\n", "")
        field = f"{self.real} {field_of(p.name)}{_index(np.shape(p.value))}"
        return f"    {field}; /* {note_of(p)}; default {value} */"

    def source(self):
        """Return the text of the functions, without the line that includes the header."""
        program, real, loop = self.program, self.real, self.program.case.loop
        includes = ["#include <string.h>"] if program.prepare else []
        words = ", ".join(json.dumps(unit) for unit in signal_units(loop.plant, loop.units))
        start = {} if program.plant else {"y": loop.x0, "u": loop.actuator.initial}
        before = "static const {} {}_before[{}] = {};".format
        zeros = {v: n for v, n in program.inputs.items() if v in ("d", "dr", "ddr")}
        unused = ["state", *(v for v in program.inputs if v != "w")]
        unused += [] if program.plant else ["t", "w"]
        given = [f"    if (!{v}) {v} = zeros;" for v in zeros]
        if not program.plant:
            given += [f"    const {real} *const w = manual ? manual : u_before;"]
        return ir.template(
            "source.c",
            name=self.name,
            real=real,
            functions=ir.below([*includes, *self._matrix_functions()]),
            dt=self.plain.value(float(program.case.clock.dt)),
            units=ir.below([] if program.plant else [f"{self.units} = {{{words}}};"]),
            values=ir.below(f"    {self._initialiser(p.value)}," for p in program.parameters),
            before=ir.below(
                before(real, v, np.size(e), self._initialiser(e)) for v, e in start.items()
            ),
            prepare=ir.below(self._prepare()),
            init=self.init_call,
            first=ir.below(self._init()),
            step=self.step_call,
            longest=max(zeros.values()),
            given=ir.below(given),
            unused=" ".join(f"(void){v};" for v in unused),
            law=ir.below(self._step()),
        )

    def _initialiser(self, value):
        value = np.asarray(value, dtype=float)
        if not value.ndim:
            return self.plain.value(float(value))
        return f"{{{', '.join(map(self._initialiser, value))}}}"

    def _matrix_functions(self):
        """The functions that the statements call for their matrix operations."""
        program = self.program
        statements = [*program.begin, *program.prepare, *program.step]
        used = [s for s in ir.every(statements) if isinstance(s, ir.Matrix)]
        suffix = "f" if self.real == "float" else ""
        largest = max((s.sizes[0] ** 2 for s in used if s.op == "solve"), default=0)
        words = {"real": self.real, "SQRT": f"sqrt{suffix}", "FABS": f"fabs{suffix}"}
        for op, text in MATRICES.items():
            if any(s.op == op for s in used):
                for word, meant in {**words, "LARGEST": str(largest)}.items():
                    text = text.replace(word, meant)
                yield text.rstrip()

    def _prepare(self):
        program, name = self.program, self.name
        if not program.prepare:
            return []
        return [
            "",
            f"static void prepare({name}_state *state, const {name}_parameters *p)",
            "{",
            *self.plain.lines(program.prepare),
            *(
                f"    state->c[{i}] = {self.plain.as_real(e)};"
                for e, (_, i) in program.constants.items()
            ),
            *(
                f"    for (int i = 0; i < {size}; ++i) state->c[{at} + i] = {array}[i];"
                for array, (at, size) in program.arrays.items()
            ),
            "    state->p = *p;",
            "}",
        ]

    def _init(self):
        """The lines of the first call."""
        program, printer = self.program, self.plain
        first = [f"    state->s[{i}] = {printer.as_real(e)};" for i, e in enumerate(program.first)]
        before = ["    (void)y; (void)u;"]
        if not program.plant:
            before = [f"    if (!{v}) {v} = {v}_before;" for v in ("y", "u")] + before
        else:
            before = [f"    (void){v};" for v in program.start]
        lines = [*before, *printer.lines(program.begin), *(first or ["    state->s[0] = 0;"])]
        lines += self._results(printer, program.start)
        return lines + ["    prepare(state, p);"] * bool(program.prepare)

    def _results(self, printer, results):
        rows = [(v, j, e) for v, entries in results.items() for j, e in enumerate(entries)]
        return [f"    {v}[{j}] = {printer.value(e)};" for v, j, e in rows]

    def _step(self):
        """The lines of a period."""
        program, real, printer = self.program, self.real, self.printer
        changing = list(_changing(program))
        differs = "    if (memcmp(&state->p, p, sizeof *p) != 0) prepare(state, p);"
        return [
            *[differs] * bool(program.prepare),
            *(f"    {real} *const {v} = state->s + {at};" for v, at in program.lines.items()),
            *printer.lines(program.step),
            # a state that is returned as it was must be read before it is written
            *(f"    const {real} next{i} = {printer.as_real(e)};" for i, e in changing),
            *self._results(printer, program.outputs_of),
            *(f"    state->s[{i}] = next{i};" for i, _ in changing),
        ]


def _changing(program):
    """(place, entry) of the state after a step, without what stays and what is changed in place."""
    root = dict(zip(program.lines, program.lines))
    for s in ir.every(program.step):
        if isinstance(s, ir.Store):
            root[s.name] = root[s.array]
    for i, e in enumerate(program.after):
        line = root.get(e.name) if isinstance(e, ir.Ref) else None
        if e != ir.Ref("s", i) and (line is None or program.lines[line] + e.index != i):
            yield i, e


def _index(index):
    return "".join(f"[{i}]" for i in index)


def print_c(program, name, precision):
    """Return {file: text} of a Program."""
    text = Text(program, name, precision)
    return {f"{name}.h": text.header(), f"{name}.c": f'#include "{name}.h"\n\n{text.source()}'}

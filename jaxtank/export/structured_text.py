"""Controllers as a function block in Structured Text (IEC 61131-3)."""

import numpy as np

from jaxtank.core.labels import units_of_inputs
from jaxtank.export import statements as ir
from jaxtank.export.printer import OPERATIONS, Printer, field_of, header, note_of

LARGEST = "3.4028234E+38"
"""Stands for infinity and for NaN, of which the language has no numbers. Some compilers, as matiec
of OpenPLC, take no literals beyond single precision.
"""

NUMBERS = {ir.REAL: float, ir.WHOLE: int, ir.TRUTH: bool}

INPUTS = {  # {argument of a step: its name}
    "y": "level",
    "r": "setpoint",
    "dr": "setpoint_rate",
    "ddr": "setpoint_second",
    "w": "manual_input",
}


class StructuredText(Printer):
    """The statements of Structured Text."""

    truths = ("FALSE", "TRUE")
    nan = infinity = LARGEST
    single = True  # of its literals
    assign = constant = variable = "{name} := {value};"
    counted, endless, end = "FOR {1} := 0 TO {0} DO", "", "END_FOR;"
    each, put = "FOR {0} := 0 TO {2} DO", "{place} := {value};"
    when, close_when = "IF {0} THEN", " END_IF;"
    until = "IF NOT ({0}) THEN EXIT; END_IF;"
    rename = {**INPUTS, "s": "state", "t": "time_s", "u": "input_before"}

    def __init__(self, precision, places, variables):
        real = "LREAL" if precision == "double" else "REAL"
        self.places, self.counters = places, 0
        self.kinds = {ir.REAL: real, ir.WHOLE: "DINT", ir.TRUTH: "BOOL"}
        self.kind_of = variables
        whole = f"DINT_TO_{real}(TRUNC({{0}}))"
        same = ["sqrt", "exp", "sin", "cos", "tan", "asin", "acos", "atan", "abs"]
        self.operations = {
            **OPERATIONS,
            **{name: f"{name.upper()}({{0}})" for name in same},
            **{name: f"{name.upper()}({{0}}, {{1}})" for name in ("max", "min", "atan2")},
            "log": "LN({0})",
            "log1p": "LN(1.0 + {0})",
            "expm1": "EXP({0}) - 1.0",
            "exp2": "EXPT(2.0, {0})",
            "pow": "EXPT({0}, {1})",
            "sinh": "0.5 * (EXP({0}) - EXP(-{0}))",
            "cosh": "0.5 * (EXP({0}) + EXP(-{0}))",
            "tanh": "1.0 - 2.0 / (EXP(2.0 * {0}) + 1.0)",
            "logistic": "1.0 / (1.0 + EXP(-{0}))",
            "rsqrt": "1.0 / SQRT({0})",
            "floor": f"{whole} - SEL({{0}} < {whole}, 0.0, 1.0)",
            "ceil": f"{whole} + SEL({{0}} > {whole}, 0.0, 1.0)",
            "round": f"DINT_TO_{real}({real}_TO_DINT({{0}}))",
            "rem": f"{{0}} - {{1}} * DINT_TO_{real}(TRUNC({{0}} / {{1}}))",
            "is_finite": f"ABS({{0}}) < {self.infinity}",
            "sign": "SEL({0} > 0.0, SEL({0} < 0.0, 0.0, -1.0), 1.0)",
            "eq": "{0} = {1}",
            "ne": "{0} <> {1}",
            "truth": "{0} <> 0.0",
            "not": "NOT {0}",
            "and": "{0} AND {1}",
            "or": "{0} OR {1}",
            "select": "SEL({0}, {1}, {2})",
            "quotient": "{0} / {1}",
            "remainder": "{0} MOD {1}",
            "real": f"DINT_TO_{real}({{0}})",
            "item": "{0}[{1}]",
            "whole": "TRUNC({0})",
        }

    def value(self, e):
        text = super().value(e)
        if isinstance(e, float) and np.isfinite(e) and "e" in text:
            return (text if "." in text else text.replace("e", ".0e")).upper()
        return text

    def _applied(self, op, args, texts):
        if op in ("real", "whole") and self._kind(args[0]) == ir.TRUTH:
            return f"SEL({texts[0]}, {'0.0, 1.0' if op == 'real' else '0, 1'})"
        return super()._applied(op, args, texts)

    def _each(self, s):
        if s.op == "same" and not isinstance(s.args[0], ir.Ref | ir.View):
            s = s._replace(args=(NUMBERS[s.kind](s.args[0]),))
        return super()._each(s)

    def as_real(self, e):
        plain = isinstance(e, float) or self._kind(e) == ir.REAL
        return self.value(e) if plain else self.right("real", (e,))

    def _kind(self, e):
        if isinstance(e, ir.Ref | ir.View):
            return self.kind_of.get(e.name, ir.REAL)
        return ir.TRUTH if isinstance(e, bool) else ir.WHOLE if isinstance(e, int) else ir.REAL

    def _passes(self, count):
        self.counters += 1
        return self.counted.format(count - 1, f"k{self.counters}")

    def _array(self, s):
        if not any(isinstance(e, ir.Ref) for e in s.entries):
            return []  # declared with its numbers
        number = self.as_real if s.kind == ir.REAL else self.value
        return [f"{s.name}[{i}] := {number(e)};" for i, e in enumerate(s.entries)]

    def _matrix(self, s):
        a, *b = (self.value(ir.Ref(o)) for o in s.operands)
        words = {"x": s.name, "a": a, "b": b[0] if b else ""}
        sizes = dict(zip({"product": "mkn", "cholesky": "n"}.get(s.op, "nk"), s.sizes))
        ends = {f"{key}_": size - 1 for key, size in sizes.items()}
        return MATRICES[s.op].strip().format(**words, **sizes, **ends).split("\n")


MATRICES = dict(zip(ir.MATRIX_OPERATIONS, ir.parts("functions.st"), strict=True))
"""{matrix operation: loops over its operands, row by row}."""

_RESERVED = """
abs acos and array asin atan atan2 begin bool by byte case configuration constant continue cos date
dint do dword else elsif end_case end_for end_function end_function_block end_if end_repeat end_var
end_while exit exp expt false for function function_block if int limit ln log lreal lword max min
mod mux not of or real repeat retain return sel sin sint sqrt string struct tan then time to true
trunc type udint uint until usint var var_input var_output var_temp while word xor
"""
_OWN = "reset level setpoint setpoint_rate setpoint_second manual manual_input input_before pump"
RESERVED = {form(word) for word in f"{_RESERVED} {_OWN}".split() for form in (str.lower, str.upper)}
"""Names that the function block must not have: keywords, functions, its inputs."""


def print_structured_text(program, name, precision):
    """Return a Program as the text of a function block."""
    statements = [*ir.every(program.begin), *ir.every(program.prepare), *ir.every(program.step)]
    kinds = {s.name: s.kind for s in statements if isinstance(s, ir.Define)}
    for s in statements:
        if isinstance(s, ir.Loop):
            single = {n: kind for kind, n, _ in s.carried if not isinstance(kind, ir.Vector)}
            kinds |= single | {f"n{n}": kind for n, kind in single.items()}
    entries = enumerate(program.entries)
    places = {ir.Ref("p", j): f"{field_of(n)}{_index(i)}" for j, (n, i) in entries}
    places[ir.Ref("on")] = "SEL(manual, 0.0, 1.0)"
    of_arrays = {n: vector.kind for n, vector in ir.array_kinds(statements).items()}
    of_arrays |= {s.name: s.kind for s in statements if isinstance(s, ir.Each)}
    printer = StructuredText(precision, places, kinds | of_arrays)
    body = _body(printer, program)
    begin = "The first call, and each one with reset, begins anew from level and input_before."
    order = "t is time_s, y level, r setpoint, dr setpoint_rate, ddr setpoint_second, u pump."
    real, loop = printer.kinds[ir.REAL], program.case.loop
    length, drive = loop.units[0], units_of_inputs(loop.plant)
    units = {"y": length, "r": length, "dr": f"{length}/s", "ddr": f"{length}/s^2", "w": drive}
    inputs = (
        f"    {INPUTS[v]} : {_array(size, real)}; (* [{units[v]}] *)"
        for v, size in program.inputs.items()
    )
    variable = lambda p: f"{_array(np.shape(p.value), real)}{_initial(printer, p.value)}"
    parameters = (
        f"    {field_of(p.name)} : {variable(p)}; (* {note_of(p)} *)" for p in program.parameters
    )
    pumps = _array(program.pumps, real)
    return ir.template(
        "block.st",
        name=name,
        head="\n".join(header(program, " *", name, f"{begin} Here {order}")),
        real=real,
        inputs=ir.below(inputs),
        before=f"{pumps}{_initial(printer, np.ravel(loop.actuator.initial))}",
        pumps=pumps,
        drive=drive,
        parameters=ir.below(parameters),
        variables=ir.below(_variables(printer, program, statements, kinds)),
        body=ir.below(line.rstrip() for line in body),
    )


def _body(printer, program):
    """The statements of the function block."""
    indented = lambda lines: [f"    {line}" for line in lines]
    first = [f"state[{i}] := {printer.as_real(e)};" for i, e in enumerate(program.first)]
    lines = ["IF reset OR NOT started THEN", *printer.lines(program.begin), *indented(first)]
    lines += ["    started := TRUE;", "END_IF;"]
    if program.prepare:
        for j, (name, _) in enumerate(program.entries):
            if any(p.name == name for p in program.parameters):
                now = printer.places[ir.Ref("p", j)]
                lines += [f"IF {now} <> before[{j}] OR NOT prepared THEN"]
                lines += [f"    before[{j}] := {now};", "    changed := TRUE;", "END_IF;"]
        lines += ["IF changed THEN", *printer.lines(program.prepare)]
        lines += indented(["changed := FALSE;", "prepared := TRUE;"]) + ["END_IF;"]
    changing = [(i, e) for i, e in enumerate(program.after) if e != ir.Ref("s", i)]
    lines += printer.lines(program.step, "")
    lines += [f"next[{i}] := {printer.as_real(e)};" for i, e in changing]
    lines += [f"pump[{j}] := {printer.value(e)};" for j, e in enumerate(program.u)]
    return lines + [f"state[{i}] := next[{i}];" for i, _ in changing]


def _variables(printer, program, statements, kinds):
    """Declarations of state and results of the statements; kinds: of single numbers."""
    real = printer.kinds[ir.REAL]
    tables = [s for s in statements if isinstance(s, ir.Array) and not ir.reads(s)]
    types = {n: printer.kinds[kind] for n, kind in kinds.items()}
    sized = ir.array_kinds(s for s in statements if s not in tables)
    types |= {n: _array(vector.size, printer.kinds[vector.kind]) for n, vector in sized.items()}
    lasting = {e.name for e in program.constants} | set(program.arrays)
    persistent = {"state": _array(max(program.state, 1), real), "started": "BOOL"}
    if program.prepare:
        persistent |= {"before": _array(len(program.entries), real)}
        persistent |= dict.fromkeys(["changed", "prepared"], "BOOL")
    variables = {"next": persistent["state"]} | _helpers(printer, statements) | types
    # matiec, the compiler of OpenPLC, writes no valid code for arrays in VAR_TEMP
    lasts = lambda n: n in lasting or variables[n].startswith("ARRAY")
    persistent |= {n: variables.pop(n) for n in [*filter(lasts, variables)]}
    size_of = lambda s: _array(len(s.entries), printer.kinds[s.kind])
    constant = {s.name: f"{size_of(s)}{_initial(printer, s.entries, s.kind)}" for s in tables}
    lines = _block("VAR CONSTANT", constant) if constant else []
    return [*lines, *_block("VAR", persistent), *_block("VAR_TEMP", variables)]


def _block(kind, variables):
    return [kind, *(f"    {n} : {t};" for n, t in variables.items()), "END_VAR"]


def _helpers(printer, statements):
    """{variable of the loops: its type}."""
    counters = {f"k{i + 1}": "DINT" for i in range(printer.counters)}
    deep = [len(s.shape) + len(s.over) for s in statements if isinstance(s, ir.Each)]
    counters |= {f"e{d}": "DINT" for d in range(max(deep, default=0))}
    matrices = [s for s in statements if isinstance(s, ir.Matrix)]
    if not matrices:
        return counters
    work = max((s.sizes[0] ** 2 for s in matrices if s.op == "solve"), default=1)
    counters |= dict.fromkeys(["i", "j", "l", "best"], "DINT")
    return counters | {"sum": printer.kinds[ir.REAL], "work": _array(work, printer.kinds[ir.REAL])}


def _initial(printer, values, kind=ir.REAL):
    """The initial value of a variable."""
    numbers = [printer.value(NUMBERS[kind](v)).strip("()") for v in np.ravel(values)]
    return f" := {numbers[0]}" if np.ndim(values) == 0 else f" := [{', '.join(numbers)}]"


def _index(index):
    return f"[{', '.join(map(str, index))}]" if index else ""


def _array(shape, kind):
    """The type of an array, or of one number for shape ()."""
    sizes = (shape,) if isinstance(shape, int) else shape
    ends = ", ".join(f"0..{n - 1}" for n in sizes)
    return f"ARRAY [{ends}] OF {kind}" if sizes else kind

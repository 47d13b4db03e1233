"""Controllers as JavaScript."""

import json

import numpy as np

from jaxtank.core.labels import signal_units
from jaxtank.export import statements as ir
from jaxtank.export.printer import BRACES, FUNCTIONS, OPERATIONS, Printer, header

MISSING = ("erf", "erfc")  # functions that most languages have and JavaScript has not


class JavaScript(Printer):
    """The statements of JavaScript (ECMAScript 2015), in double precision."""

    operations = {
        **OPERATIONS,
        **BRACES,
        **{name: f"Math.{name}({{0}})" for name in FUNCTIONS if name not in MISSING},
        **{name: f"Math.{name}({{0}})" for name in ("abs", "cbrt", "sign")},
        **{name: f"Math.{name}({{0}}, {{1}})" for name in ("atan2", "max", "min", "pow")},
        "round": "rint({0})",
        "rem": "{0} % {1}",
        "is_finite": "Number.isFinite({0})",
        "ne": "{0} !== {1}",
        "eq": "{0} === {1}",
        "rsqrt": "1 / Math.sqrt({0})",
        "exp2": "Math.pow(2, {0})",
        "logistic": "1 / (1 + Math.exp(-{0}))",
        "quotient": "Math.trunc({0} / {1})",
        "real": "+{0}",
        "whole": "Math.trunc({0})",
        "truth": "{0} != 0",
    }
    nan, infinity = "NaN", "Infinity"
    constant, variable = "const {name} = {value};", "let {name} = {value};"
    empty = "const {name} = new Float64Array({size});"
    each = "for (let {0} = 0; {0} < {1}; ++{0})"
    open_array = "const {name} = ["
    matrix_call = "const {name} = {op}({arguments});"
    counted, endless, end = "for (let i = 0; i < {0}; ++i) {{", "for (;;) {", "}"
    until = "if (!({0})) break;"

    def value(self, e):
        text = super().value(e)
        return text.replace(".0)", ")").removesuffix(".0") if isinstance(e, float) else text

    def as_real(self, e):
        return self.value(e) if isinstance(e, float) else f"+{self.value(e)}"


*_MATRICES, ROUND = ir.parts("functions.js")
MATRICES = dict(zip(ir.MATRIX_OPERATIONS, _MATRICES, strict=True))
"""{matrix operation: a function of its sizes and of its operands, row by row}."""

_RESERVED = """
arguments await break case catch class const continue debugger default delete do else enum eval
export extends false finally for function if implements import in instanceof interface let module
new null package private protected public return static super switch this throw true try typeof
undefined var void while with yield Math Number NaN Infinity Float64Array rint product cholesky
forward backward solve s t y r dr ddr u
"""
RESERVED = frozenset(_RESERVED.split())
"""Names that the functions must not have: keywords, called functions, their variables."""


def print_javascript(program, name, precision):
    """Return a Program as the text of a JavaScript file."""
    printer = JavaScript()
    begin = f"{name}.init(y, u) returns the state; u: inputs before the first sample, optional."
    loop = program.case.loop
    counts = program.state, program.tanks, program.outputs, program.pumps
    sizes = zip(("dt", "state", "tanks", "outputs", "pumps"), (program.case.clock.dt, *counts))
    facts = ", ".join(f"{key}: {printer.value(value)}" for key, value in sizes)
    facts += f", units: {json.dumps(signal_units(loop.plant, loop.units))}"
    return ir.template(
        "module.js",
        name=name,
        head="\n".join(header(program, "//", f"{name}.step(s, t, y, r, dr, ddr)", begin)),
        helpers=ir.below(ir.called([*program.begin, *program.step], {"round": ROUND, **MATRICES})),
        initial=", ".join(printer.value(float(v)) for v in np.ravel(loop.actuator.initial)),
        begin=ir.below(printer.lines(program.begin)),
        first=", ".join(map(printer.as_real, program.first)),
        step=ir.below(_step(printer, program)),
        facts=facts,
    )


def _step(printer, program):
    # a state that is returned as it was must be read before it is written
    changing = [(i, e) for i, e in enumerate(program.after) if e != ir.Ref("s", i)]
    inputs = ", ".join(printer.value(e) for e in program.u)
    return [
        *printer.lines(program.step),
        *(f"    const next{i} = {printer.as_real(e)};" for i, e in changing),
        *(f"    s[{i}] = next{i};" for i, _ in changing),
        f"    return [{inputs}];",
    ]

"""Controllers as a MATLAB function."""

from jaxtank.export import statements as ir
from jaxtank.export.printer import FUNCTIONS, OPERATIONS, Printer, header


class Matlab(Printer):
    """The statements of MATLAB."""

    operations = {
        **OPERATIONS,
        **{name: f"{name}({{0}})" for name in [*FUNCTIONS, "abs", "sign", "round"]},
        **{name: f"{name}({{0}}, {{1}})" for name in ("max", "min", "rem", "atan2")},
        "not": "~{0}",
        "ne": "{0} ~= {1}",
        "and": "{0} && {1}",
        "or": "{0} || {1}",
        "rsqrt": "1 / sqrt({0})",
        "logistic": "1 / (1 + exp(-{0}))",
        "exp2": "2 ^ {0}",
        "cbrt": "nthroot({0}, 3)",
        "is_finite": "isfinite({0})",
        "quotient": "fix({0} / {1})",
        "remainder": "rem({0}, {1})",
        "pow": "{0} ^ {1}",
        "select": "pick({0}, {2}, {1})",
        "real": "double({0})",
        "whole": "fix({0})",
        "truth": "{0} ~= 0",
        "item": "{0}({1} + 1)",
    }
    first = 1
    entry = "{0}({1})"
    nan, infinity = "NaN", "Inf"
    line_break = " ..."
    empty, each = "{name} = zeros(1, {size});", "for {0} = 0:{2}"
    when, close_when = "if {0},", " end"
    matrix_call = "{name} = {op}_({arguments});"
    until = "if ~({0}), break; end"


# the statements store arrays by rows, MATLAB by columns: reshape gives the transpose
*_MATRICES, PICK = ir.parts("functions.m")
MATRICES = dict(zip(ir.MATRIX_OPERATIONS, _MATRICES, strict=True))

_RESERVED = """
break case catch classdef continue else elseif end for function global if otherwise parfor
persistent return spmd switch try while isempty zeros reshape chol double true false pi NaN Inf
nthroot isfinite fix abs max min sign rem round atan2 s t y r dr ddr u pick
"""
RESERVED = frozenset(_RESERVED.split()) | set(FUNCTIONS)
"""Names that the exported function must not have: keywords, called functions, its variables."""


def print_matlab(program, name, precision):
    """Return a Program as the text of a MATLAB file with one function."""
    printer = Matlab()
    first_call = "s: state; [] in the first period, when u must be the inputs before it."
    first, after, u = (map(printer.value, e) for e in (program.first, program.after, program.u))
    first = (f"        s({i + 1}) = {e};" for i, e in enumerate(first))
    step = [*printer.lines(program.step), *(f"    next{i + 1} = {e};" for i, e in enumerate(after))]
    results = [f"    u({j + 1}) = {e};" for j, e in enumerate(u)]
    results += [f"    s({i + 1}) = next{i + 1};" for i in range(program.state)]
    functions = ir.called([*program.step, *program.begin], {**MATRICES, "select": PICK})
    return ir.template(
        "function.m",
        name=name,
        head="\n".join(header(program, "%", name, first_call)),
        begin=ir.below(printer.lines(program.begin, "        ")),
        state=max(program.state, 1),
        first=ir.below(first),
        step=ir.below(step),
        pumps=program.pumps,
        results=ir.below(results),
        functions=ir.below(functions),
    )

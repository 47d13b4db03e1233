"""Statements as a MATLAB function."""

import numpy as np

from jaxtank.export import lowering as cg
from jaxtank.export.c import INFIX, C
from jaxtank.export.printer import SAME_NAME, every, header, wrapped


class Matlab(C):
    """How a statement is written in MATLAB."""

    def value(self, e):
        if isinstance(e, cg.Ref):
            return (
                self.inputs(e.index)
                if e.name == "x"
                else e.name
                if e.index is None
                else f"{e.name}({e.index + 1})"
            )
        if isinstance(e, bool):
            return "true" if e else "false"
        if isinstance(e, int):
            return str(e) if e >= 0 else f"({e})"
        if not np.isfinite(e):
            return "NaN" if np.isnan(e) else "Inf" if e > 0 else "(-Inf)"
        return repr(e) if not str(e).startswith("-") else f"({e!r})"

    def right(self, op, args):
        a = [self.value(v) for v in args]
        if op in INFIX:
            return f"{a[0]} {INFIX[op]} {a[1]}"
        if op in (
            "sqrt",
            "abs",
            "exp",
            "log",
            "tanh",
            "sin",
            "cos",
            "floor",
            "max",
            "min",
            "sign",
            *SAME_NAME,
        ):
            return f"{op}({', '.join(a)})"
        return {
            "neg": "-{0}",
            "not": "~{0}",
            "ne": "{0} ~= {1}",
            "and": "{0} && {1}",
            "or": "{0} || {1}",
            "square": "{0} * {0}",
            "rsqrt": "1 / sqrt({0})",
            "logistic": "1 / (1 + exp(-{0}))",
            "exp2": "2 ^ {0}",
            "cbrt": "nthroot({0}, 3)",
            "rem": "rem({0}, {1})",
            "is_finite": "isfinite({0})",
            "quotient": "fix({0} / {1})",
            "remainder": "rem({0}, {1})",
            "pow": "{0} ^ {1}",
            "round": "round({0})",
            "select": "pick({0}, {2}, {1})",
            "real": "double({0})",
            "whole": "fix({0})",
            "truth": "{0} ~= 0",
        }[op].format(*a)

    def lines(self, statements, indent="    "):
        out = []
        for s in statements:
            if isinstance(s, cg.Define):
                out.append(f"{indent}{s.name} = {self.right(s.op, s.args)};")
            elif isinstance(s, cg.Array):
                out += wrapped(
                    f"{indent}{s.name} = [", map(self.value, s.entries), indent, "];", more=" ..."
                )
            elif isinstance(s, cg.Matrix):
                out.append(
                    f"{indent}{s.name} = {s.op}_({', '.join([*map(str, s.sizes), *s.operands])});"
                )
            elif isinstance(s, cg.Until):
                out.append(f"{indent}if ~({self.value(s.test)}), break; end")
            else:
                out += [f"{indent}{name} = {self.value(start)};" for _, name, start in s.carried]
                head = "while true" if s.count is None else f"for i = 1:{s.count}"
                out += [f"{indent}{head}", *self.lines(s.body, indent + "    ")]
                out += [
                    f"{indent}    n{name} = {self.value(new)};"
                    for (_, name, _), new in zip(s.carried, s.new)
                ]
                out += [f"{indent}    {name} = n{name};" for _, name, _ in s.carried] + [
                    f"{indent}end"
                ]
        return out


# arrays are written row by row, MATLAB keeps them column by column
MATRIX_M = {
    "product": (
        """
function out = product_(m, k, n, a, b)
    c = reshape(b, n, k) * reshape(a, k, m);
    out = c(:).';
end"""
    ),
    "cholesky": (
        """
function out = cholesky_(n, a)
    c = chol(reshape(a, n, n));
    out = c(:).';
end"""
    ),
    "forward": (
        """
function out = forward_(n, k, a, b)
    c = (reshape(a, n, n).' \\ reshape(b, k, n).').';
    out = c(:).';
end"""
    ),
    "backward": (
        """
function out = backward_(n, k, a, b)
    c = (reshape(a, n, n) \\ reshape(b, k, n).').';
    out = c(:).';
end"""
    ),
}

PICK_M = """
function out = pick(condition, yes, no)
    if condition
        out = yes;
    else
        out = no;
    end
end"""


TAKEN_M = """
break case catch classdef continue else elseif end for function global if otherwise parfor persistent return spmd switch try while
isempty zeros reshape chol double true false pi NaN Inf nthroot isfinite fix rem round
sqrt abs exp log tanh sin cos floor max min sign erf erfc log1p expm1 tan asin acos atan atan2 sinh cosh asinh acosh atanh ceil
s t y r dr ddr u pick
"""
"""What a function of MATLAB may not be called: keywords, what such a file calls, and its own
variables.
"""


def print_matlab(law, case, name, precision):
    ends = np.cumsum([law.state, 1, law.tanks, law.outputs, law.outputs, law.outputs])

    def stepped(k):
        part = int(np.searchsorted(ends, k, side="right"))
        i = k - (ends[part - 1] if part else 0)
        return "t" if part == 1 else f"{('s', 't', 'y', 'r', 'dr', 'ddr')[part]}({i + 1})"

    def begun(k):
        return f"y({k + 1})" if k < law.tanks else f"u({k - law.tanks + 1})"

    lines = [f"function [u, s] = {name}(s, t, y, r, dr, ddr, u)"]
    lines += header(
        law, case, "%", name, "s: state; give [] in the first period, and u, the inputs before it."
    )
    printer = Matlab(begun)
    lines += ["    if isempty(s)", *printer.lines(law.begin, "        ")]
    lines += [f"        s = zeros(1, {max(law.state, 1)});"]
    lines += [f"        s({i + 1}) = {printer.value(e)};" for i, e in enumerate(law.begun)] + [
        "    end"
    ]
    printer = Matlab(stepped)
    lines += printer.lines(law.step)
    lines += [f"    next{i + 1} = {printer.value(e)};" for i, e in enumerate(law.after)]
    lines += [
        f"    u = zeros(1, {law.pumps});",
        *(f"    u({j + 1}) = {printer.value(e)};" for j, e in enumerate(law.u)),
    ]
    lines += [f"    s({i + 1}) = next{i + 1};" for i in range(law.state)] + ["end"]
    used = {s.op for s in every(law.step) if isinstance(s, cg.Matrix)}
    picks = any(
        isinstance(s, cg.Define) and s.op == "select" for s in every([*law.step, *law.begin])
    )
    lines += [MATRIX_M[op] for op in MATRIX_M if op in used] + ([PICK_M] if picks else [])
    return "\n".join(lines) + "\n"

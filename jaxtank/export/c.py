"""Statements as C99."""

import re

import numpy as np

from jaxtank.export import lowering as cg
from jaxtank.export.printer import MATHS, as_real, every, has, header, wrapped

INFIX = {
    "add": "+",
    "sub": "-",
    "mul": "*",
    "div": "/",
    "lt": "<",
    "le": "<=",
    "gt": ">",
    "ge": ">=",
    "eq": "==",
}

C_CALLS = {
    "sqrt": "SQRT",
    "abs": "FABS",
    "exp": "EXP",
    "log": "LOG",
    "tanh": "TANH",
    "sin": "SIN",
    "cos": "COS",
    "floor": "FLOOR",
    "pow": "POW",
}

C_TYPES = {cg.REAL: "real", cg.WHOLE: "int", cg.TRUTH: "int"}


class C:
    """How a statement is written in C."""

    def __init__(self, inputs):
        self.inputs = inputs  # how the k-th input is written

    def value(self, e):
        """A number or a Ref."""
        if isinstance(e, cg.Ref):
            return (
                self.inputs(e.index)
                if e.name == "x"
                else e.name
                if e.index is None
                else f"{e.name}[{e.index}]"
            )
        if isinstance(e, bool):
            return str(int(e))
        if isinstance(e, int):
            return str(e) if e >= 0 else f"({e})"
        if not np.isfinite(e):
            return "NAN" if np.isnan(e) else "INFINITY" if e > 0 else "(-INFINITY)"
        return f"R({e!r})" if e >= 0 and not str(e).startswith("-") else f"R(({e!r}))"

    def right(self, op, args):
        """op(args) as an expression."""
        a = [self.value(v) for v in args]
        if op in INFIX:
            return f"{a[0]} {INFIX[op]} {a[1]}"
        if op in C_CALLS:
            return f"{C_CALLS[op]}({', '.join(a)})"
        return {
            "neg": "-{0}",
            "not": "!{0}",
            "ne": "{0} != {1}",
            "and": "{0} && {1}",
            "or": "{0} || {1}",
            "square": "{0} * {0}",
            "rsqrt": "R(1.0) / SQRT({0})",
            "logistic": "R(1.0) / (R(1.0) + EXP(-{0}))",
            "quotient": "{0} / {1}",
            "remainder": "{0} % {1}",
            "sign": "(real)(({0} > R(0.0)) - ({0} < R(0.0)))",
            "select": "{0} ? {2} : {1}",
            "real": "(real){0}",
            "whole": "(int){0}",
            "truth": "{0} != 0",
        }[op].format(*a)

    def lines(self, statements, indent="    "):
        """The lines of a list of statements."""
        out = []
        for s in statements:
            if isinstance(s, cg.Define):
                out.append(
                    f"{indent}const {C_TYPES[s.kind]} {s.name} = {self.right(s.op, s.args)};"
                )
            elif isinstance(s, cg.Array):
                fixed = (
                    "static const" if not any(isinstance(e, cg.Ref) for e in s.entries) else "const"
                )
                out += wrapped(
                    f"{indent}{fixed} real {s.name}[{len(s.entries)}] = {{",
                    map(self.value, s.entries),
                    indent,
                    "};",
                )
            elif isinstance(s, cg.Matrix):
                size = {"product": lambda m, k, n: m * n, "cholesky": lambda n: n * n}.get(
                    s.op, lambda n, k: n * k
                )(*s.sizes)
                out.append(f"{indent}real {s.name}[{size}];")
                out.append(
                    f"{indent}{s.op}({', '.join([*map(str, s.sizes), *s.operands, s.name])});"
                )
            elif isinstance(s, cg.Until):
                out.append(f"{indent}if (!({self.value(s.test)})) break;")
            else:
                out += [
                    f"{indent}{C_TYPES[kind]} {name} = {self.value(start)};"
                    for kind, name, start in s.carried
                ]
                head = "for (;;)" if s.count is None else f"for (int i = 0; i < {s.count}; ++i)"
                out += [f"{indent}{head} {{", *self.lines(s.body, indent + "    ")]
                for (kind, name, _), new in zip(s.carried, s.new):
                    out.append(f"{indent}    const {C_TYPES[kind]} n{name} = {self.value(new)};")
                out += [f"{indent}    {name} = n{name};" for _, name, _ in s.carried] + [
                    f"{indent}}}"
                ]
        return out


MATRIX_C = """
static void product(int m, int k, int n, const real *a, const real *b, real *out)
{
    for (int i = 0; i < m; ++i)
        for (int j = 0; j < n; ++j) {
            real s = R(0.0);
            for (int l = 0; l < k; ++l) s += a[i * k + l] * b[l * n + j];
            out[i * n + j] = s;
        }
}

static void cholesky(int n, const real *a, real *out)
{
    for (int j = 0; j < n; ++j)
        for (int i = 0; i < n; ++i) {
            real s = a[i * n + j];
            if (i < j) { out[i * n + j] = R(0.0); continue; }
            for (int l = 0; l < j; ++l) s -= out[i * n + l] * out[j * n + l];
            out[i * n + j] = i == j ? SQRT(s) : s / out[j * n + j];
        }
}

static void forward(int n, int k, const real *a, const real *b, real *out)
{
    for (int c = 0; c < k; ++c)
        for (int i = 0; i < n; ++i) {
            real s = b[i * k + c];
            for (int l = 0; l < i; ++l) s -= a[i * n + l] * out[l * k + c];
            out[i * k + c] = s / a[i * n + i];
        }
}

static void backward(int n, int k, const real *a, const real *b, real *out)
{
    for (int c = 0; c < k; ++c)
        for (int i = n - 1; i >= 0; --i) {
            real s = b[i * k + c];
            for (int l = i + 1; l < n; ++l) s -= a[l * n + i] * out[l * k + c];
            out[i * k + c] = s / a[i * n + i];
        }
}
"""


def print_c(law, case, name, precision):
    short = "f" if precision == "float" else ""
    sizes = {"state": law.state, "tanks": law.tanks, "outputs": law.outputs, "pumps": law.pumps}
    upper = name.upper()
    ends = np.cumsum([law.state, 1, law.tanks, law.outputs, law.outputs, law.outputs])

    def stepped(k):
        part = int(np.searchsorted(ends, k, side="right"))
        i = k - (ends[part - 1] if part else 0)
        return "t" if part == 1 else f"{('state->s', 't', 'y', 'r', 'dr', 'ddr')[part]}[{i}]"

    def begun(k):
        return f"y[{k}]" if k < law.tanks else f"u[{k - law.tanks}]"

    head = [
        *header(
            law,
            case,
            " *",
            name,
            f"{name}_init takes the levels and inputs before the first period.",
        )
    ]
    lines = [
        "/*",
        *head,
        " */",
        "#include <math.h>",
        "",
        f"typedef {precision} real;",
        "#define R(x) ((real)(x))",
    ]
    lines += [f"#define {m.upper()} {m}{short}" for m in MATHS]
    lines += [
        "#define MAX(a, b) ((a) > (b) ? (a) : (b))",
        "#define MIN(a, b) ((a) < (b) ? (a) : (b))",
        "",
    ]
    lines += [
        f"#define {upper}_DT {case.clock.dt!r}",
        *(f"#define {upper}_{n.upper()} {max(v, 1)}" for n, v in sizes.items()),
    ]
    lines += ["", f"typedef struct {{ real s[{upper}_STATE]; }} {name}_state;"]
    if has(law.step, cg.Matrix):
        used = {s.op for s in every(law.step) if isinstance(s, cg.Matrix)}
        lines += [
            b
            for b in MATRIX_C.strip("\n").split("\n\n")
            if used & set(re.findall(r"void (\w+)", b)[:1])
        ]
    printer = C(begun)
    lines += [
        "",
        f"void {name}_init({name}_state *state, const real *y, const real *u)",
        "{",
        "    (void)y; (void)u;",
    ]
    lines += printer.lines(law.begin) + [
        f"    state->s[{i}] = {as_real(printer, e)};" for i, e in enumerate(law.begun)
    ]
    lines += ["}" if law.state else "    state->s[0] = R(0.0);\n}"]
    printer = C(stepped)
    lines += [
        "",
        (
            f"void {name}_step({name}_state *state, real t, const real *y, const real *r, const"
            " real *dr, const real *ddr, real *u)"
        ),
        "{",
    ]
    lines += [
        "    (void)t; (void)y; (void)r; (void)dr; (void)ddr; (void)state;",
        *printer.lines(law.step),
    ]
    # a state that is only handed on must be read before it is written
    lines += [f"    const real next{i} = {as_real(printer, e)};" for i, e in enumerate(law.after)]
    lines += [f"    u[{j}] = {printer.value(e)};" for j, e in enumerate(law.u)]
    lines += [f"    state->s[{i}] = next{i};" for i in range(law.state)] + ["}", ""]
    return "\n".join(lines)

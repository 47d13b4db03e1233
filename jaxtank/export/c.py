"""Controllers as C99."""

import re

from jaxtank.export.printer import FUNCTIONS, OPERATIONS, Printer, header
from jaxtank.export.statements import REAL, TRUTH, WHOLE, Ref, matrix_operations

MATHS = [*FUNCTIONS, "fabs", "pow", "rint", "fmod", "cbrt", "exp2", "atan2"]
"""Functions of math.h, each with a macro in capitals that is the one of the file's precision."""


class C(Printer):
    """The statements of C99."""

    operations = {
        **OPERATIONS,
        **{name: f"{name.upper()}({{0}})" for name in [*FUNCTIONS, "cbrt", "exp2"]},
        "abs": "FABS({0})",
        "atan2": "ATAN2({0}, {1})",
        "pow": "POW({0}, {1})",
        "max": "MAX({0}, {1})",
        "min": "MIN({0}, {1})",
        "round": "RINT({0})",
        "rem": "FMOD({0}, {1})",
        "is_finite": "isfinite({0})",
        "not": "!{0}",
        "ne": "{0} != {1}",
        "and": "{0} && {1}",
        "or": "{0} || {1}",
        "rsqrt": "R(1.0) / SQRT({0})",
        "logistic": "R(1.0) / (R(1.0) + EXP(-{0}))",
        "quotient": "{0} / {1}",
        "remainder": "{0} % {1}",
        "sign": "(real)(({0} > R(0.0)) - ({0} < R(0.0)))",
        "select": "{0} ? {2} : {1}",
        "real": "(real){0}",
        "whole": "(int){0}",
    }
    kinds = {REAL: "real", WHOLE: "int", TRUTH: "int"}
    rename = {"s": "state->s"}
    real = "R({0})"
    truths = ("0", "1")
    constant, variable = "const {kind} {name} = {value};", "{kind} {name} = {value};"
    open_array, close_array = "const real {name}[{size}] = {{", "};"
    matrix_call = "real {name}[{size}];\n{op}({arguments}, {name});"
    counted, endless, end = "for (int i = 0; i < {0}; ++i) {{", "for (;;) {", "}"
    until = "if (!({0})) break;"

    def _array(self, s):
        first, *others = super()._array(s)
        fixed = not any(isinstance(e, Ref) for e in s.entries)
        return [f"static {first}" if fixed else first, *others]

    def as_real(self, e):
        """Return a number or a Ref of any kind as a real."""
        return self.value(e) if isinstance(e, float) else f"(real)({self.value(e)})"


MATRICES = """
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


def print_c(program, name, precision):
    """Return a Program as the text of a C99 file."""
    begin = f"{name}_init takes the levels and inputs before the first period."
    lines = [
        "/*",
        *header(program, " *", f"{name}_step", begin),
        " */",
        *_definitions(program, name.upper(), precision),
        "",
        f"typedef struct {{ real s[{name.upper()}_STATE]; }} {name}_state;",
        *_matrix_functions(program),
        "",
        *_init(program, name),
        "",
        *_step(program, name),
        "",
    ]
    return "\n".join(lines)


def _definitions(program, prefix, precision):
    """The type of a number, the functions of math.h, and the sizes of the arguments."""
    suffix = "f" if precision == "float" else ""
    sizes = {
        "STATE": max(program.state, 1),
        "TANKS": program.tanks,
        "OUTPUTS": program.outputs,
        "PUMPS": program.pumps,
    }
    return [
        "#include <math.h>",
        "",
        f"typedef {precision} real;",
        "#define R(x) ((real)(x))",
        *(f"#define {m.upper()} {m}{suffix}" for m in MATHS),
        "#define MAX(a, b) ((a) > (b) ? (a) : (b))",
        "#define MIN(a, b) ((a) < (b) ? (a) : (b))",
        "",
        f"#define {prefix}_DT {program.case.clock.dt!r}",
        *(f"#define {prefix}_{size} {value}" for size, value in sizes.items()),
    ]


def _matrix_functions(program):
    """The functions that the step calls for its matrix operations."""
    used = matrix_operations(program.step)
    functions = MATRICES.strip("\n").split("\n\n")
    return [f for f in functions if re.findall(r"void (\w+)", f)[0] in used]


def _init(program, name):
    printer = C()
    first = [f"    state->s[{i}] = {printer.as_real(e)};" for i, e in enumerate(program.first)]
    return [
        f"void {name}_init({name}_state *state, const real *y, const real *u)",
        "{",
        "    (void)y; (void)u;",
        *printer.lines(program.begin),
        *(first or ["    state->s[0] = R(0.0);"]),
        "}",
    ]


def _step(program, name):
    printer, after = C(), program.after
    return [
        f"void {name}_step({name}_state *state, real t, const real *y, const real *r, const"
        " real *dr, const real *ddr, real *u)",
        "{",
        "    (void)t; (void)y; (void)r; (void)dr; (void)ddr; (void)state;",
        *printer.lines(program.step),
        # a state that is returned as it was must be read before it is written
        *(f"    const real next{i} = {printer.as_real(e)};" for i, e in enumerate(after)),
        *(f"    u[{j}] = {printer.value(e)};" for j, e in enumerate(program.u)),
        *(f"    state->s[{i}] = next{i};" for i in range(program.state)),
        "}",
    ]

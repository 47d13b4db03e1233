"""A law and its observer as one file without dependencies: C99, or a MATLAB function, made from the same step function that is simulated."""

import functools
import re

import jax
import numpy as np

from jaxtank import codegen as cg
from jaxtank.controllers import OpenLoop
from jaxtank.errors import InputError
from jaxtank.records import Tick
from jaxtank.stepping import commanded, initial

LANGUAGES = ("c", "m")
PRECISIONS = ("double", "float")


def law_of(case):
    """(step, begin): functions of one sample, of arrays.

    step(state, t, y, r, dr, ddr) -> (u, state): t [s]; y: (tanks,) readings; r, dr, ddr: (outputs,) setpoints with their first and second
    derivatives by time; u: (pumps,) inputs within the pumps' limits. begin(y, u) -> state, for readings and inputs before the first sample. The
    order is that of `stepping.step`: observer, law, limits, and both are told what was applied.
    """
    loop, dt = case.loop, case.clock.dt

    def one(array):
        return tuple(array[i] for i in range(array.shape[0]))

    def begin(y, u):
        return loop.observer.init(one(y)), loop.controller.init(one(y), one(u))

    def step(state, t, y, r, dr, ddr):
        observer, controller = state
        r, dr, ddr = map(one, (r, dr, ddr))
        samples = [tuple(v[None] for v in signal) for signal in (r, dr, ddr)]
        plan = jax.tree.map(lambda a: a[0], loop.controller.prepare(*samples))
        tick = Tick(t=t, r=r, dr=dr, ddr=ddr, dt=dt, plan=plan, own=())
        estimate, observer = loop.observer.step(observer, tick, one(y))
        command, controller = commanded(loop, controller, tick, estimate)
        metric = loop.controller.input_metric(estimate) if loop.actuator.saturation == "boxqp" else None
        applied = loop.actuator.limit(command, metric)
        observer = loop.observer.predict(observer, tick, command, applied)
        controller = loop.controller.track(controller, tick, command, applied)
        return jax.numpy.stack(list(applied)), (observer, controller)

    return step, begin


def function_name(case):
    """The name of a Case with what no language allows in a name as _."""
    return re.sub(r"[^A-Za-z0-9]+", "_", case.name).strip("_")


def comment(text):
    """`text` as what may stand in a comment of C and of MATLAB, on one line that ends nothing and goes on nowhere.

    Characters that do not print, line breaks of every script among them, are spaces; a backslash is a slash; the ends of comments and the
    trigraphs of C are taken apart.
    """
    text = "".join(c if c.isprintable() else " " for c in text).replace("\\", "/")
    return re.sub(r"\*(?=/)|/(?=\*)|\?(?=\?)", lambda found: found[0] + " ", text)


def export(case, language="c", precision="double", name=None):
    """The law of a Case as source code.

    language: "c" (C99) or "m" (MATLAB); precision: "double" or "float" (of C); name: of the functions, made from the case's where None.
    Returns the text of one file. Raises InputError for a law that plays a signal back, and one that uses an operation without a counterpart.
    """
    if language not in LANGUAGES:
        raise InputError(f"--lang {language!r}: must be one of {', '.join(LANGUAGES)}")
    if precision not in PRECISIONS:
        raise InputError(f"--precision {precision!r}: must be one of {', '.join(PRECISIONS)}")
    if language == "m" and precision == "float":
        raise InputError("--precision float: is for C; MATLAB computes in double")
    if isinstance(case.loop.controller, OpenLoop):
        raise InputError(f"{case.name}: its law plays a signal back and feeds nothing back: there is nothing to export")
    if case.loop.controller.inputs(case.clock) != ():
        raise InputError(f"{case.name}: its law plays a signal of its own back, which code without a run cannot have")
    given, name = name, name or function_name(case)
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,50}", name):
        whose = f"--name {given!r}" if given else f"{case.name!r} gives no name for the function; --name NAME"
        raise InputError(f"{whose}: must be a name in the language: letters, digits and _, beginning with a letter, at most 51")
    if language == "m" and name in TAKEN_M.split():
        raise InputError(f"--name {name!r}: MATLAB, or the file itself, has this name already; give another")
    law = Code(case)
    return (_c if language == "c" else _matlab)(law, case, name, precision)


class Code:
    """Statements of begin and step, and the sizes of what goes in and out."""

    def __init__(self, case):
        loop = case.loop
        step, begin = law_of(case)
        self.tanks, self.outputs, self.pumps = loop.plant.tanks, len(loop.plant.outputs), loop.plant.pumps
        real = functools.partial(jax.ShapeDtypeStruct, dtype=jax.numpy.result_type(float))
        y, r, u = real((self.tanks,)), real((self.outputs,)), real((self.pumps,))
        # what a state begins with need not have the type it goes on with: a number from the law, an array from the run
        ran = initial(loop, case.clock)
        state = jax.tree.map(lambda a: jax.ShapeDtypeStruct(np.shape(a), jax.numpy.result_type(a)), (ran.observer, ran.controller))
        self.state = sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(state))
        self.begin, _, first = cg.function(begin, y, u)
        self.step, _, after = cg.function(step, state, real(()), y, r, r, r)
        self.begun = [e for leaf in first for e in np.ravel(leaf)]
        self.u, self.after = list(after[0].ravel()), [e for leaf in after[1:] for e in np.ravel(leaf)]
        if not len(self.begun) == len(self.after) == self.state:
            raise InputError(f"{case.name}: its law begins with a state of another size than it goes on with")


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
SAME_NAME = (
    "erf",
    "erfc",
    "log1p",
    "expm1",
    "tan",
    "asin",
    "acos",
    "atan",
    "atan2",
    "sinh",
    "cosh",
    "asinh",
    "acosh",
    "atanh",
    "ceil",
)
"""Functions that C and MATLAB have by the same name."""
C_CALLS |= {name: name.upper() for name in (*SAME_NAME, "cbrt", "exp2")}
C_CALLS |= {"max": "MAX", "min": "MIN", "round": "RINT", "rem": "FMOD", "is_finite": "isfinite"}
C_TYPES = {cg.REAL: "real", cg.WHOLE: "int", cg.TRUTH: "int"}


class C:
    """How a statement is written in C."""

    def __init__(self, inputs):
        self.inputs = inputs  # how the k-th input is written

    def value(self, e):
        """A number or a Ref."""
        if isinstance(e, cg.Ref):
            return self.inputs(e.index) if e.name == "x" else e.name if e.index is None else f"{e.name}[{e.index}]"
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
                out.append(f"{indent}const {C_TYPES[s.kind]} {s.name} = {self.right(s.op, s.args)};")
            elif isinstance(s, cg.Array):
                fixed = "static const" if not any(isinstance(e, cg.Ref) for e in s.entries) else "const"
                out += _wrapped(f"{indent}{fixed} real {s.name}[{len(s.entries)}] = {{", map(self.value, s.entries), indent, "};")
            elif isinstance(s, cg.Matrix):
                size = {"product": lambda m, k, n: m * n, "cholesky": lambda n: n * n}.get(s.op, lambda n, k: n * k)(*s.sizes)
                out.append(f"{indent}real {s.name}[{size}];")
                out.append(f"{indent}{s.op}({', '.join([*map(str, s.sizes), *s.operands, s.name])});")
            elif isinstance(s, cg.Until):
                out.append(f"{indent}if (!({self.value(s.test)})) break;")
            else:
                out += [f"{indent}{C_TYPES[kind]} {name} = {self.value(start)};" for kind, name, start in s.carried]
                head = "for (;;)" if s.count is None else f"for (int i = 0; i < {s.count}; ++i)"
                out += [f"{indent}{head} {{", *self.lines(s.body, indent + "    ")]
                for (kind, name, _), new in zip(s.carried, s.new):
                    out.append(f"{indent}    const {C_TYPES[kind]} n{name} = {self.value(new)};")
                out += [f"{indent}    {name} = n{name};" for _, name, _ in s.carried] + [f"{indent}}}"]
        return out


def _wrapped(head, items, indent, tail, width=130, more=""):
    rows, line = [], head
    for item in items:
        if len(line) + len(item) > width:
            rows.append(line.rstrip() + more)
            line = indent + "    "
        line += f"{item}, "
    return [*rows, line.rstrip(", ") + tail]


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
MATHS = ("sqrt", "fabs", "exp", "log", "tanh", "sin", "cos", "floor", "pow", "rint", "fmod", "cbrt", "exp2", *SAME_NAME)


def _about(law, case, mark, name, begin):
    """What the file says of itself."""
    length, drive = case.loop.units
    gains = [(n, v) for n, v in sorted(_shown(case).items())]
    lines = [
        f"{case.name}: {case.title}",
        "Made by `jaxtank export` from the law and observer that jaxtank simulates; not to be edited.",
        "",
        f"Sampling period {case.clock.dt:g} s: call {name}{'_step' if mark != '%' else ''} once each period.",
        f"t: time [s]; y: {law.tanks} measured levels [{length}], of every tank in the order of the rig;",
        f"r, dr, ddr: {law.outputs} setpoint{'s' if law.outputs > 1 else ''} [{length}], with first [{length}/s] and second [{length}/s^2] "
        "derivative;",
        f"u: {law.pumps} pump input{'s' if law.pumps > 1 else ''} [{drive}], within the limits of the pumps. {begin}",
        "",
        *(f"{n} = {v}" for n, v in gains),
    ]
    return [f"{mark} {comment(line)}".rstrip() for line in lines]


def _shown(case):
    from jaxtank.tree import walk

    found = {}
    for name, value, meta in walk(case.loop.controller, "controller.", units=case.loop.units):
        if value is not None and ".model." not in name:
            unit = "" if meta["unit"] == "-" else f" {meta['unit']}"
            found[name] = (
                f"{np.array2string(np.asarray(value), separator=', ', precision=10, threshold=64).replace(chr(10), '')}{unit}"
            )
    return found


def _c(law, case, name, precision):
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
        *_about(law, case, " *", name, f"{name}_init takes the levels and inputs before the first period."),
    ]
    lines = ["/*", *head, " */", "#include <math.h>", "", f"typedef {precision} real;", "#define R(x) ((real)(x))"]
    lines += [f"#define {m.upper()} {m}{short}" for m in MATHS]
    lines += ["#define MAX(a, b) ((a) > (b) ? (a) : (b))", "#define MIN(a, b) ((a) < (b) ? (a) : (b))", ""]
    lines += [f"#define {upper}_DT {case.clock.dt!r}", *(f"#define {upper}_{n.upper()} {max(v, 1)}" for n, v in sizes.items())]
    lines += ["", f"typedef struct {{ real s[{upper}_STATE]; }} {name}_state;"]
    if _has(law.step, cg.Matrix):
        used = {s.op for s in _every(law.step) if isinstance(s, cg.Matrix)}
        lines += [b for b in MATRIX_C.strip("\n").split("\n\n") if re.search(r"void (\w+)", b).group(1) in used]
    printer = C(begun)
    lines += ["", f"void {name}_init({name}_state *state, const real *y, const real *u)", "{", "    (void)y; (void)u;"]
    lines += printer.lines(law.begin) + [f"    state->s[{i}] = {_as_real(printer, e)};" for i, e in enumerate(law.begun)]
    lines += ["}" if law.state else "    state->s[0] = R(0.0);\n}"]
    printer = C(stepped)
    lines += [
        "",
        f"void {name}_step({name}_state *state, real t, const real *y, const real *r, const real *dr, const real *ddr, real *u)",
        "{",
    ]
    lines += ["    (void)t; (void)y; (void)r; (void)dr; (void)ddr; (void)state;", *printer.lines(law.step)]
    # a state that is only handed on must be read before it is written
    lines += [f"    const real next{i} = {_as_real(printer, e)};" for i, e in enumerate(law.after)]
    lines += [f"    u[{j}] = {printer.value(e)};" for j, e in enumerate(law.u)]
    lines += [f"    state->s[{i}] = next{i};" for i in range(law.state)] + ["}", ""]
    return "\n".join(lines)


def _as_real(printer, e):
    text = printer.value(e)
    return f"(real)({text})" if not isinstance(e, float) else text


def _every(statements):
    for s in statements:
        yield s
        if isinstance(s, cg.Loop):
            yield from _every(s.body)


def _has(statements, kind):
    return any(isinstance(s, kind) for s in _every(statements))


class Matlab(C):
    """How a statement is written in MATLAB."""

    def value(self, e):
        if isinstance(e, cg.Ref):
            return self.inputs(e.index) if e.name == "x" else e.name if e.index is None else f"{e.name}({e.index + 1})"
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
        if op in ("sqrt", "abs", "exp", "log", "tanh", "sin", "cos", "floor", "max", "min", "sign", *SAME_NAME):
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
                out += _wrapped(f"{indent}{s.name} = [", map(self.value, s.entries), indent, "];", more=" ...")
            elif isinstance(s, cg.Matrix):
                out.append(f"{indent}{s.name} = {s.op}_({', '.join([*map(str, s.sizes), *s.operands])});")
            elif isinstance(s, cg.Until):
                out.append(f"{indent}if ~({self.value(s.test)}), break; end")
            else:
                out += [f"{indent}{name} = {self.value(start)};" for _, name, start in s.carried]
                head = "while true" if s.count is None else f"for i = 1:{s.count}"
                out += [f"{indent}{head}", *self.lines(s.body, indent + "    ")]
                out += [f"{indent}    n{name} = {self.value(new)};" for (_, name, _), new in zip(s.carried, s.new)]
                out += [f"{indent}    {name} = n{name};" for _, name, _ in s.carried] + [f"{indent}end"]
        return out


# arrays are written row by row, MATLAB keeps them column by column
MATRIX_M = {
    "product": """
function out = product_(m, k, n, a, b)
    c = reshape(b, n, k) * reshape(a, k, m);
    out = c(:).';
end""",
    "cholesky": """
function out = cholesky_(n, a)
    c = chol(reshape(a, n, n));
    out = c(:).';
end""",
    "forward": """
function out = forward_(n, k, a, b)
    c = (reshape(a, n, n).' \\ reshape(b, k, n).').';
    out = c(:).';
end""",
    "backward": """
function out = backward_(n, k, a, b)
    c = (reshape(a, n, n) \\ reshape(b, k, n).').';
    out = c(:).';
end""",
}
TAKEN_M = """
break case catch classdef continue else elseif end for function global if otherwise parfor persistent return spmd switch try while
isempty zeros reshape chol double true false pi NaN Inf nthroot isfinite fix rem round
sqrt abs exp log tanh sin cos floor max min sign erf erfc log1p expm1 tan asin acos atan atan2 sinh cosh asinh acosh atanh ceil
s t y r dr ddr u pick
"""
"""What a function of MATLAB may not be called: keywords, what such a file calls, and its own variables."""
PICK_M = """
function out = pick(condition, yes, no)
    if condition
        out = yes;
    else
        out = no;
    end
end"""


def _matlab(law, case, name, precision):
    ends = np.cumsum([law.state, 1, law.tanks, law.outputs, law.outputs, law.outputs])

    def stepped(k):
        part = int(np.searchsorted(ends, k, side="right"))
        i = k - (ends[part - 1] if part else 0)
        return "t" if part == 1 else f"{('s', 't', 'y', 'r', 'dr', 'ddr')[part]}({i + 1})"

    def begun(k):
        return f"y({k + 1})" if k < law.tanks else f"u({k - law.tanks + 1})"

    lines = [f"function [u, s] = {name}(s, t, y, r, dr, ddr, u)"]
    lines += _about(law, case, "%", name, "s: state; give [] in the first period, and u, the inputs before it.")
    printer = Matlab(begun)
    lines += ["    if isempty(s)", *printer.lines(law.begin, "        ")]
    lines += [f"        s = zeros(1, {max(law.state, 1)});"]
    lines += [f"        s({i + 1}) = {printer.value(e)};" for i, e in enumerate(law.begun)] + ["    end"]
    printer = Matlab(stepped)
    lines += printer.lines(law.step)
    lines += [f"    next{i + 1} = {printer.value(e)};" for i, e in enumerate(law.after)]
    lines += [f"    u = zeros(1, {law.pumps});", *(f"    u({j + 1}) = {printer.value(e)};" for j, e in enumerate(law.u))]
    lines += [f"    s({i + 1}) = next{i + 1};" for i in range(law.state)] + ["end"]
    used = {s.op for s in _every(law.step) if isinstance(s, cg.Matrix)}
    picks = any(isinstance(s, cg.Define) and s.op == "select" for s in _every([*law.step, *law.begin]))
    lines += [MATRIX_M[op] for op in MATRIX_M if op in used] + ([PICK_M] if picks else [])
    return "\n".join(lines) + "\n"

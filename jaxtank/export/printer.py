"""A controller and its observer as statements, and what the printers of all languages share."""

import functools
import re

import jax
import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.core.records import Tick
from jaxtank.export import lowering as cg
from jaxtank.loop.closed_loop import initial
from jaxtank.loop.step import decide


def law_of(case):
    """(step, begin): functions of one sample, of arrays.

    step(state, t, y, r, dr, ddr) -> (u, state): t [s]; y: (tanks,) readings; r, dr, ddr: (outputs,)
    setpoints with their first and second derivatives by time; u: (pumps,) inputs within the pumps'
    limits. begin(y, u) -> state, for readings and inputs before the first sample. The order is that
    of `jaxtank.loop.step.decide`, which is called.
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
        made = decide(loop, observer, controller, tick, one(y))
        return jax.numpy.stack(list(made.applied)), (made.observer, made.controller)

    return step, begin


def function_name(case):
    """The name of a Case with what no language allows in a name as _."""
    return re.sub(r"[^A-Za-z0-9]+", "_", case.name).strip("_")


def comment(text):
    """`text` as what may stand in a comment of C and of MATLAB, on one line that ends nothing and
    goes on nowhere.

    Characters that do not print, line breaks of every script among them, are spaces; a backslash is
    a slash; the ends of comments and the trigraphs of C are taken apart.
    """
    text = "".join(c if c.isprintable() else " " for c in text).replace("\\", "/")
    return re.sub(r"\*(?=/)|/(?=\*)|\?(?=\?)", lambda found: found[0] + " ", text)


class Code:
    """Statements of begin and step, and the sizes of what goes in and out."""

    def __init__(self, case):
        loop = case.loop
        step, begin = law_of(case)
        self.tanks, self.outputs, self.pumps = (
            loop.plant.tanks,
            len(loop.plant.outputs),
            loop.plant.pumps,
        )
        real = functools.partial(jax.ShapeDtypeStruct, dtype=jax.numpy.result_type(float))
        y, r, u = real((self.tanks,)), real((self.outputs,)), real((self.pumps,))
        # what a state begins with need not have the type it goes on with: a number from the law, an
        # array from the run
        ran = initial(loop, case.clock)
        state = jax.tree.map(
            lambda a: jax.ShapeDtypeStruct(np.shape(a), jax.numpy.result_type(a)),
            (ran.observer, ran.controller),
        )
        self.state = sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(state))
        self.begin, _, first = cg.function(begin, y, u)
        self.step, _, after = cg.function(step, state, real(()), y, r, r, r)
        self.begun = [e for leaf in first for e in np.ravel(leaf)]
        self.u, self.after = (
            list(after[0].ravel()),
            [e for leaf in after[1:] for e in np.ravel(leaf)],
        )
        if not len(self.begun) == len(self.after) == self.state:
            raise InputError(
                f"{case.name}: its law begins with a state of another size than it goes on with"
            )


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


def wrapped(head, items, indent, tail, width=130, more=""):
    rows, line = [], head
    for item in items:
        if len(line) + len(item) > width:
            rows.append(line.rstrip() + more)
            line = indent + "    "
        line += f"{item}, "
    return [*rows, line.rstrip(", ") + tail]


MATHS = (
    "sqrt",
    "fabs",
    "exp",
    "log",
    "tanh",
    "sin",
    "cos",
    "floor",
    "pow",
    "rint",
    "fmod",
    "cbrt",
    "exp2",
    *SAME_NAME,
)


def header(law, case, mark, name, begin):
    """What the file says of itself."""
    length, drive = case.loop.units
    gains = [(n, v) for n, v in sorted(_shown(case).items())]
    lines = [
        f"{case.name}: {case.title}",
        (
            "Made by `jaxtank export` from the law and observer that jaxtank simulates; not to be"
            " edited."
        ),
        "",
        (
            f"Sampling period {case.clock.dt:g} s: call {name}{'_step' if mark != '%' else ''} once"
            " each period."
        ),
        (
            f"t: time [s]; y: {law.tanks} measured levels [{length}], of every tank in the order of"
            " the rig;"
        ),
        (
            f"r, dr, ddr: {law.outputs} setpoint{'s' if law.outputs > 1 else ''} [{length}], with"
            f" first [{length}/s] and second [{length}/s^2] derivative;"
        ),
        (
            f"u: {law.pumps} pump input{'s' if law.pumps > 1 else ''} [{drive}], within the limits"
            f" of the pumps. {begin}"
        ),
        "",
        *(f"{n} = {v}" for n, v in gains),
    ]
    return [f"{mark} {comment(line)}".rstrip() for line in lines]


def _shown(case):
    from jaxtank.core.tree import walk

    found = {}
    for name, value, meta in walk(case.loop.controller, "controller.", units=case.loop.units):
        if value is not None and ".model." not in name:
            unit = "" if meta["unit"] == "-" else f" {meta['unit']}"
            found[name] = (
                f"{np.array2string(np.asarray(value), separator=', ', precision=10, threshold=64).replace(chr(10), '')}{unit}"
            )
    return found


def as_real(printer, e):
    text = printer.value(e)
    return f"(real)({text})" if not isinstance(e, float) else text


def every(statements):
    for s in statements:
        yield s
        if isinstance(s, cg.Loop):
            yield from every(s.body)


def has(statements, kind):
    return any(isinstance(s, kind) for s in every(statements))

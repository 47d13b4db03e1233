"""One sample of the whole closed loop as statements, and their text as short JavaScript."""
# The functions that are simulated are traced with every number of the loop as an input. Statements
# are sorted by what they depend on, so that each is computed as seldom as possible.

import dataclasses
import itertools
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank import measures as ms
from jaxtank.analysis.elimination import rolled
from jaxtank.case import Case
from jaxtank.core.clock import Chunk
from jaxtank.core.errors import InputError
from jaxtank.core.tree import with_values
from jaxtank.export import statements as ir
from jaxtank.export.javascript import MATRICES, ROUND
from jaxtank.export.lowering import WholeWriter, lower_all
from jaxtank.export.program import entries_of, flat, traced_leaves
from jaxtank.export.source import check_prepared
from jaxtank.export.statements import names
from jaxtank.export.tables import Columns, columns_of, looked_up, runs_by_samples, tables_of
from jaxtank.loop.closed_loop import initial, inputs_at, run_of, zero_of
from jaxtank.loop.step import step

SAVED = ("x", "y", "r", "u", "command", "applied", "spilled", "d_hat")
"""Fields of a Trajectory that are stored at each sample."""

LARGEST = 24  # tanks of a loop that is written as code


@dataclasses.dataclass(frozen=True)
class WholeLoop:
    """The statements of one sample, in order, and their results."""

    case: Case
    leaves: tuple[tuple[str, tuple[int, ...]], ...]  # (dotted name, index in it) of each entry of p
    statements: list[ir.Statement]
    first: list[Any]  # entries of c before the first sample
    after: list[Any]  # entries of c after a sample
    saved: dict[str, list[Any]]  # {field of `SAVED`, or "errors": its entries at a sample}
    weights: list[tuple[str, float]]  # (measure, weight of the square) of each of the errors
    measures: dict[str, list[Any]]  # {measure: its entries}, read of c after the last sample
    lines: dict[int, str]  # {entry of c at which a Line begins: its name}
    tables: int  # columns of tables, the entries of t


def served(case: Case) -> tuple[str, ...]:
    """Return the names of the measures that are defined for a case, including times."""
    return (*(m for m in ms.reported() if ms.serves(m, case.loop)), *ms.times())


def sample_of(
    case: Case, names: Sequence[str], squares: Sequence[tuple[str, float]], columns: Columns
) -> Any:
    """Return (p, k, c, n, t) -> (first c, next c, saved, measures, residuals) of a sample."""
    clock, names = case.clock, tuple(names)

    def whole(p: Any, k: Any, c: Any, n: Any, t: Any) -> Any:
        loop = looked_up(with_values(case.loop, p), columns, t)
        state, acc, spilled = c
        state = state._replace(k=k)
        xi = tuple(v[None] for v in n) if np.ndim(loop.sensor.noise) > 0 else None
        now = inputs_at(loop, Chunk(first=k, samples=1, dt=clock.dt), names, xi)
        now = jax.tree.map(lambda a: a[0], now)
        run = run_of(loop, clock)
        after, sample = step(loop, clock, state, now)
        errors = ms.residuals(run, acc, sample, now.context, squares)
        update = ms.update(run, acc, sample, now.context)
        saved = {f: tuple(getattr(sample, f)) for f in SAVED} | {"spilled": spilled}
        total = tuple(a + b for a, b in zip(spilled, sample.spilled))
        start = initial(loop, clock)._replace(k=())
        before = (start, ms.start(run, names), (zero_of(loop),) * loop.plant.tanks)
        values = ms.read(run, acc, names)
        return before, (after._replace(k=()), update, total), saved, values, errors

    return whole


def whole_loop(
    case: Case, names: Sequence[str] | None = None, squares: Sequence[tuple[str, float]] = ()
) -> WholeLoop:
    """Return the WholeLoop of a case with the measures `names`, all that it serves if None."""
    # with `squares` all that it saves is "errors", the residuals of these weighted measures
    check_pointwise(case)
    names = served(case) if names is None else tuple(names)
    carried_names = tuple(dict.fromkeys([*names, *(m for m, _ in squares)]))
    columns = columns_of(case)
    shapes = arguments(case, carried_names, columns)
    with rolled():
        sample = sample_of(case, carried_names, squares, columns)
        lowered = lower_all(sample, shapes, WholeWriter())
    before, after, saved, values, errors = lowered.outputs
    run = run_of(case.loop, case.clock)
    weights_of = lambda measure, weight: ms.residual_weights(run, ((measure, weight),))
    return WholeLoop(
        case=case,
        leaves=entries_of(shapes["p"]),
        statements=lowered.statements,
        first=flat(before),
        after=flat(after),
        saved={"errors": flat(errors)} if squares else {f: flat(saved[f]) for f in SAVED},
        weights=[(m, float(w)) for m, weight in squares for w in weights_of(m, weight)],
        measures={m: flat(values[m]) for m in names},
        lines={start.index: name for start, name in lowered.lines.items()},
        tables=len(columns.varying),
    )


def check_pointwise(case: Case) -> None:
    """Raise InputError for signals that do not follow from their times alone, and many tanks."""
    # of more tanks the code, a statement for each number, takes minutes to write
    if case.loop.plant.tanks > LARGEST:
        raise InputError(
            f"{case.name}: its rig has {case.loop.plant.tanks} tanks: a loop as code may have at"
            f" most {LARGEST}"
        )
    if case.loop.sequential:
        part = "controller nmpc" if case.loop.controller.sequential else "observer moving-horizon"
        raise InputError(
            f"{case.name}: its {part} solves quadratic programmes, whose code for a page has"
            " megabytes; `jaxtank simulate --gif` draws a run, and `jaxtank export` writes"
            " controller and observer alone, in each of its languages"
        )
    if not runs_by_samples(case.loop):
        raise InputError(
            f"{case.name}: its controller looks ahead, or has signals of its own that need the"
            " whole run, and a page computes one sample at a time: set controller.preview = 0"
        )
    check_prepared(case.loop.controller)


def numbers_of(case: Case) -> dict[str, np.ndarray]:
    """Return {dotted name: value} of the numbers of a loop that a page may change."""
    tables = tuple(f"{name}." for name in tables_of(case.loop))
    return {n: v for n, v in traced_leaves(case).items() if not n.startswith(tables)}


def arguments(case: Case, names: Sequence[str], columns: Columns) -> dict[str, Any]:
    """Return {name: shapes and types} of the arguments of `sample_of`, with measures `names`."""
    real = jnp.result_type(float)

    def start() -> Any:
        run = run_of(case.loop, case.clock)
        state = initial(case.loop, case.clock)._replace(k=())
        return state, ms.start(run, names), (zero_of(case.loop),) * case.loop.plant.tanks

    return {
        "p": {n: jax.ShapeDtypeStruct(v.shape, real) for n, v in numbers_of(case).items()},
        "k": jax.ShapeDtypeStruct((), jnp.int32),
        "c": jax.eval_shape(start),
        "n": (jax.ShapeDtypeStruct((), real),) * case.loop.plant.tanks,
        "t": (jax.ShapeDtypeStruct((), real),) * len(columns.varying),
    }


_CHEAP = """
add sub mul neg abs max min lt le gt ge eq ne and or not select real square truth
"""
CHEAP = frozenset(_CHEAP.split())
"""Operations that cost less than a number that is kept for every sample."""


def kept_in_time(timed, needed, rank) -> tuple[set[ir.Ref], list[ir.Statement]]:
    """Return (values of rank 1 to keep for every sample, statements that follow from them)."""
    definitions = {s.name: s for s in timed if isinstance(s, ir.Define)}
    stored, again = set(needed), set()

    def free(ref: ir.Ref, depth: int) -> bool:
        """Whether a value needs nothing to be kept that is not."""
        if rank[ref.name] == 0 or ref in stored or ref.name == "k":
            return True
        s = definitions.get(ref.name)
        if s is None or s.op not in CHEAP or depth == 0:
            return False
        return all(free(a, depth - 1) for a in s.args if isinstance(a, ir.Ref))

    place = {name: i for i, s in enumerate(timed) for name in ir.defined(s)}
    for ref in sorted(needed, key=lambda r: place.get(r.name, -1), reverse=True):
        s = definitions.get(ref.name)
        if s is not None and s.op in CHEAP:
            stored.discard(ref)
            computable = all(free(a, 1) for a in s.args if isinstance(a, ir.Ref))
            (again if computable else stored).add(ref)
    rest = [s for s in timed if not isinstance(s, ir.Define) or ir.Ref(s.name) not in stored]
    return stored, ir.used(rest, names(again))


CHOICE, TIGHT = 2, 20
BINARY = {  # {operation: (operator, how tightly it binds)}
    "or": ("||", 3),
    "and": ("&&", 4),
    "eq": ("===", 8),
    "ne": ("!==", 8),
    "lt": ("<", 9),
    "le": ("<=", 9),
    "gt": (">", 9),
    "ge": (">=", 9),
    "add": ("+", 11),
    "sub": ("-", 11),
    "mul": ("*", 12),
    "div": ("/", 12),
    "rem": ("%", 12),
    "remainder": ("%", 12),
}

LAZY = {"select": 1, "and": 1, "or": 1}
"""{operation: first argument that JavaScript may leave out}. Work on it is done all the same: V8
throws compiled code away when a branch that it has never seen is taken.
"""

UNARY = {"neg": "-", "not": "!", "real": "+"}
_MATHS = """
abs max min pow atan2 sign sqrt exp log tanh sin cos floor ceil log1p expm1 tan asin acos atan sinh
cosh asinh acosh atanh cbrt trunc
"""
MATHS = _MATHS.split()  # functions of Math that a text has by their own names

FORMS = {  # operations on names and numbers alone, as formats
    "square": "{0}*{0}",
    "rsqrt": "1/sqrt({0})",
    "exp2": "pow(2,{0})",
    "logistic": "1/(1+exp(-{0}))",
    "quotient": "trunc({0}/{1})",
    "whole": "trunc({0})",
    "truth": "{0}!=0",
    "round": "rint({0})",
    "is_finite": "isFinite({0})",
}

_TAKEN = "do if in of as is for let new try var get set int Map Set"
_ARGUMENTS = "every p k c q o S T N L R K"  # of the printed functions
TAKEN = frozenset([*_TAKEN.split(), *_ARGUMENTS.split(), *MATHS])
LETTERS = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ"


def short_names() -> Iterator[str]:
    """Yield names, short ones first, without keywords, functions of Math and arguments."""
    for size in itertools.count(1):
        for letters in itertools.product(LETTERS, repeat=size):
            name = "".join(letters)
            if name not in TAKEN:
                yield name


def literal(value: Any) -> str:
    """Return a number as text, in as few characters as it takes."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float) and not np.isfinite(value):
        return "NaN" if np.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    text = repr(value).removesuffix(".0").replace("e-0", "e-").replace("e+", "e")
    return text[1:] if text.startswith("0.") else text.replace("-0.", "-.", 1)


class Text:
    """The statements of one function as they are written."""

    def __init__(self, given: Mapping[Any, str]):
        self.given, self.names = dict(given), short_names()
        self.pending: dict[str, tuple[str, int]] = {}
        self.uses: Counter = Counter()

    def write(self, statements, outputs: Iterable[Any], hold: Iterable[Any] = ()) -> list[str]:
        """Return the lines of statements whose results `outputs` are read; `hold`: variables."""
        self.uses = _uses(statements, outputs)
        for e in hold:
            if isinstance(e, ir.Ref):
                self.uses[e.name] += 2
        return self._block(statements)

    def of(self, e: Any) -> str:
        """Return a number or a Ref as text."""
        return self._expression(e)[0]

    def _block(self, statements):
        return [line for s in statements for line in self._lines(s)]

    def _expression(self, e) -> tuple[str, int]:
        if not isinstance(e, ir.Ref):
            text = literal(e)
            return text, 14 if text.startswith("-") else TIGHT
        if e in self.given:
            return self.given[e], TIGHT
        if e.index is None and e.name in self.pending:
            return self.pending.pop(e.name)
        name = self.given[e.name]
        if e.index is None:
            return name, TIGHT
        at = self.of(e.index) if isinstance(e.index, ir.Ref) else e.index
        return f"{name}[{at}]", TIGHT

    def _bound(self, e, least):
        """The text of an operand that binds at least as tightly as `least`."""
        text, tight = self._expression(e)
        return text if tight >= least else f"({text})"

    def _operation(self, op, args):
        """(text, how tightly it binds) of an operation."""
        if op in BINARY:
            sign, tight = BINARY[op]
            first, right = self._bound(args[0], tight), self._bound(args[1], tight + 1)
            clash = right[0] in "+-" and sign == right[0]
            return f"{first}{sign}{f'({right})' if clash else right}", tight
        if op in UNARY:
            inner = self._bound(args[0], 14)
            return UNARY[op] + (f"({inner})" if inner[0] in "+-" else inner), 14
        if op == "select":
            test, no, yes = args
            # the last branch may be a choice itself
            texts = [self._bound(test, CHOICE + 1), self._bound(yes, CHOICE + 1)]
            return f"{texts[0]}?{texts[1]}:{self._bound(no, CHOICE)}", CHOICE
        if op == "item":
            return f"{self.given[args[0].name]}[{self.of(args[1])}]", TIGHT
        if op in MATHS:
            return f"{op}({','.join(map(self.of, args))})", TIGHT
        if op not in FORMS:
            raise InputError(f"this loop has no JavaScript: it uses the operation {op}")
        loose = op in ("whole", "round", "is_finite")
        texts = [self.of(a) if loose else self._bound(a, 14) for a in args]
        return FORMS[op].format(*texts), 8 if op == "truth" else 12 if "/" in FORMS[op] else TIGHT

    def _lines(self, s):
        if isinstance(s, ir.Define):
            return self._define(s)
        if isinstance(s, ir.Array):
            return [f"const {self._named(s.name)}=[{','.join(map(self.of, s.entries))}];"]
        if isinstance(s, ir.Matrix):
            operands = [*map(str, s.sizes), *(self.given[o] for o in s.operands)]
            return [f"const {self._named(s.name)}={s.op}({','.join(operands)});"]
        if isinstance(s, ir.Store):
            line = f"{self.given[s.array]}[{self.of(s.index)}]={self.of(s.value)};"
            self.given[s.name] = self.given[s.array]
            return [line]
        if isinstance(s, ir.Until):
            return [f"if(!{self._bound(s.test, 14)})break;"]
        return self._loop(s)

    def _named(self, name):
        self.given[name] = next(self.names)
        return self.given[name]

    def _define(self, s):
        text, tight = self._operation(s.op, s.args)
        if self.uses[s.name] == 1 and s.op != "item":
            self.pending[s.name] = text, 12 if s.op == "square" else tight
            return []
        return [f"const {self._named(s.name)}={text};"]

    def _loop(self, s):
        starts = [self.of(start) for *_, start in s.carried]
        carried = [self._named(name) for _, name, _ in s.carried]
        lines = [f"let {n}={v};" for n, v in zip(carried, starts)]
        counter = next(self.names)
        counted = f"for(let {counter}=0;{counter}<{s.count};++{counter}){{"
        lines.append("for(;;){" if s.count is None else counted)
        lines += self._block(s.body)
        moves = lambda n, e: self.given.get(getattr(e, "name", "")) != n
        new = [(n, self.of(e)) for n, e in zip(carried, s.new) if moves(n, e)]
        temporary = [next(self.names) for _ in new]
        lines += [f"const {t}={e};" for t, (_, e) in zip(temporary, new)]
        return [*lines, *(f"{n}={t};" for t, (n, _) in zip(temporary, new)), "}"]


def _uses(statements, outputs):
    """{name: number of reads}; a read by a loop, of a variable outside it, counts twice."""
    counts: Counter = Counter()

    def read(e, times=1):
        if isinstance(e, ir.Ref):
            counts[e.name] += times
            read(e.index, 2)

    for e in outputs:
        read(e)
    for s in statements:
        if isinstance(s, ir.Loop):
            inside = {inner.name for inner in s.body if isinstance(inner, ir.Define)}
            for name, count in _uses(s.body, s.new).items():
                counts[name] += count if name in inside else 2
        for e, times in _reads(s):
            read(e, times)
    return counts


def _reads(s):
    """[(expression, how often it is read)] of a statement, without the body of a loop."""
    if isinstance(s, ir.Define):
        twice = lambda i: s.op == "square" or i >= LAZY.get(s.op, 9)
        return [(e, 2 if twice(i) else 1) for i, e in enumerate(s.args)]
    if isinstance(s, ir.Array):
        return [(e, 1) for e in s.entries]
    if isinstance(s, ir.Store):
        return [(s.index, 1), (s.value, 1)]
    if isinstance(s, ir.Until):
        return [(s.test, 1)]
    return [(start, 1) for *_, start in s.carried] if isinstance(s, ir.Loop) else []


def library(text: str) -> list[str]:
    """Return the functions that a text calls and JavaScript does not have."""
    functions = {**MATRICES, "rint": ROUND}
    return [source.strip() for name, source in functions.items() if f"{name}(" in text]

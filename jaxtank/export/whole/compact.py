"""Statements as short JavaScript: values that are read once become part of what reads them."""

import itertools
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.export.statements import Array, Define, Loop, Matrix, Ref, Statement, Store, Until

LOOSE, CHOICE, TIGHT = 1, 2, 20
BINARY = {
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
"""{operation: (operator, how tightly it binds)}."""

LAZY = {"select": 1, "and": 1, "or": 1}
"""{operation: first argument that JavaScript may leave out}. Work on it is done all the same: V8
throws compiled code away when a branch that it has never seen is taken.
"""

UNARY = {"neg": "-", "not": "!", "real": "+"}
_MATHS = """
abs max min pow atan2 sign sqrt exp log tanh sin cos floor ceil log1p expm1 tan asin acos atan sinh
cosh asinh acosh atanh cbrt trunc
"""
MATHS = _MATHS.split()
"""Functions of Math that a text has by their own names."""

FORMS = {
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
"""Operations on names and numbers alone, as formats."""

_TAKEN = "do if in of as is for let new try var get set int Map Set"
TAKEN = frozenset(_TAKEN.split())
LETTERS = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ"


def short_names(taken: Iterable[str] = ()) -> Iterator[str]:
    """Yield names, short ones first, without keywords, functions of Math and `taken`."""
    avoid = TAKEN | set(MATHS) | set(taken)
    for size in itertools.count(1):
        for letters in itertools.product(LETTERS, repeat=size):
            name = "".join(letters)
            if name not in avoid:
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

    def __init__(self, given: Mapping[Any, str], names: Iterator[str]):
        self.given, self.names = dict(given), names
        self.pending: dict[str, tuple[str, int]] = {}
        self.uses: Counter = Counter()

    def write(
        self, statements: list[Statement], outputs: Iterable[Any], hold: Iterable[Any] = ()
    ) -> list[str]:
        """Return the lines of statements whose results `outputs` are read afterwards, once each;
        those of `hold` get a variable.
        """
        self.uses = _uses(statements, outputs)
        for e in hold:
            if isinstance(e, Ref):
                self.uses[e.name] += 2
        return self._block(statements)

    def of(self, e: Any) -> str:
        """Return a number or a Ref as text."""
        return self._expression(e)[0]

    def _block(self, statements):
        return [line for s in statements for line in self._lines(s)]

    def _expression(self, e) -> tuple[str, int]:
        if not isinstance(e, Ref):
            text = literal(e)
            return text, 14 if text.startswith("-") else TIGHT
        if e in self.given:
            return self.given[e], TIGHT
        if e.index is None and e.name in self.pending:
            return self.pending.pop(e.name)
        name = self.given[e.name]
        if e.index is None:
            return name, TIGHT
        at = self.of(e.index) if isinstance(e.index, Ref) else e.index
        return f"{name}[{at}]", TIGHT

    def _bound(self, e, least):
        """The text of an operand that binds at least as tightly as `least`."""
        text, tight = self._expression(e)
        return text if tight >= least else f"({text})"

    def _operation(self, op, args):
        """(text, how tightly it binds) of an operation."""
        if op in BINARY:
            sign, tight = BINARY[op]
            left, right = self._bound(args[0], tight), self._bound(args[1], tight + 1)
            clash = right[0] in "+-" and sign == right[0]
            return f"{left}{sign}{f'({right})' if clash else right}", tight
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
        if isinstance(s, Define):
            return self._define(s)
        if isinstance(s, Array):
            return [f"const {self._named(s.name)}=[{','.join(map(self.of, s.entries))}];"]
        if isinstance(s, Matrix):
            operands = [*map(str, s.sizes), *(self.given[o] for o in s.operands)]
            return [f"const {self._named(s.name)}={s.op}({','.join(operands)});"]
        if isinstance(s, Store):
            line = f"{self.given[s.array]}[{self.of(s.index)}]={self.of(s.value)};"
            self.given[s.name] = self.given[s.array]
            return [line]
        if isinstance(s, Until):
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
        own = [self._named(name) for _, name, _ in s.carried]
        lines = [f"let {n}={v};" for n, v in zip(own, starts)]
        counter = next(self.names)
        lines.append(
            "for(;;){"
            if s.count is None
            else f"for(let {counter}=0;{counter}<{s.count};++{counter}){{"
        )
        lines += self._block(s.body)
        new = [
            (n, self.of(e))
            for n, e in zip(own, s.new)
            if self.given.get(getattr(e, "name", "")) != n
        ]
        temporary = [next(self.names) for _ in new]
        lines += [f"const {t}={e};" for t, (_, e) in zip(temporary, new)]
        return [*lines, *(f"{n}={t};" for t, (n, _) in zip(temporary, new)), "}"]


def _uses(statements, outputs):
    """{name: how often it is read}; what a loop reads of outside counts as often."""
    found: Counter = Counter()

    def read(e, times=1):
        if isinstance(e, Ref):
            found[e.name] += times
            read(e.index, 2)

    for e in outputs:
        read(e)
    for s in statements:
        if isinstance(s, Define):
            for i, e in enumerate(s.args):
                read(e, 2 if s.op == "square" or i >= LAZY.get(s.op, 9) else 1)
        elif isinstance(s, Array):
            for e in s.entries:
                read(e)
        elif isinstance(s, Store):
            read(s.index)
            read(s.value)
        elif isinstance(s, Until):
            read(s.test)
        elif isinstance(s, Loop):
            inside = {one.name for one in s.body if isinstance(one, Define)}
            for name, count in _uses(s.body, s.new).items():
                found[name] += count if name in inside else 2
            for *_, start in s.carried:
                read(start)
    return found

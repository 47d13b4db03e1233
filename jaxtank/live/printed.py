"""The functions of one case as JavaScript: constants of the loop, signals, the run."""

from collections.abc import Iterable
from typing import Any, cast

from jaxtank.export.statements import (
    TRUTH,
    Array,
    Define,
    Matrix,
    Ref,
    Statement,
    every,
    hoisted,
    names,
    of_rank,
    ranks,
    refs,
    used,
)
from jaxtank.export.whole import MATHS, Text, WholeLoop, kept_in_time, short_names

ALONE, TIMED, MOVING = 0, 1, 2
"""Ranks of values: from the numbers of the loop alone, also from time, also from the state."""
FIXED = frozenset({"every", *"pkcqoSNLRK"})
"""Names of arguments of the printed functions."""


class Printed:
    """The printed functions of a WholeLoop."""

    def __init__(self, loop: WholeLoop):
        self.loop, self.statements = loop, hoisted(loop.statements)
        lines = dict.fromkeys(loop.lines.values(), MOVING)
        given = {"p": ALONE, "k": TIMED, "c": MOVING, "n": MOVING, **lines}
        self.rank = ranks(self.statements, given)
        self.truths = {s.name for s in self.statements if isinstance(s, Define) and s.kind == TRUTH}
        both = every(loop.statements)
        self.arrays = {s.name for s in both if isinstance(s, Array | Matrix)}
        self.state = self._live()
        self.moving = used(self._ranked(MOVING), names(self._outputs()))
        self.measured = used(self._ranked(MOVING), names(self._measures()))
        needed = refs(self.moving, self._outputs())
        needed = {e for e in needed if self.rank[e.name] == TIMED and e.name != "k"}
        # data that is stored for every sample, and data that is computed again from it
        self.kept, self.again = kept_in_time(self._ranked(TIMED), needed, self.rank)
        self.crossing = {
            "signals": self._alone(self._timed(), self.kept),
            "run": self._alone([*self.again, *self.moving], self._outputs()),
            "read": self._alone(self.measured, self._measures()),
        }

    def text(self) -> str:
        """Return the four functions as an object, without the helpers that they call."""
        return "\n".join([self._lead(), self._signals(), self._run(), self._read()])

    def streams(self) -> list[Ref]:
        """Return the precomputed data of each sample, in the order of S."""
        return sorted(self.kept)

    def _live(self):
        """The entries of c, without delay lines, that what is saved or measured depends on."""
        results = [*self._saved(), *self._measures(), *(self.loop.after[i] for i in self._levels())]
        lines = [self.loop.after[i] for i in self.loop.lines]
        every, live = self._ranked(MOVING), []
        while True:
            after = [*results, *lines, *(self.loop.after[i] for i in live)]
            read = refs(used(every, names(after)), after)
            new = sorted(cast(int, e.index) for e in read if e.name == "c")
            if new == live:
                return live
            live = new

    def _outputs(self):
        after = [self.loop.after[i] for i in (*self.state, *self.loop.lines)]
        return [*after, *self._saved()]

    def _saved(self):
        return [e for entries in self.loop.saved.values() for e in entries]

    def _measures(self):
        return [e for entries in self.loop.measures.values() for e in entries]

    def _levels(self):
        """Indices of the levels in c: their sum is not finite if the run has diverged."""
        return range(self.loop.case.loop.plant.tanks)

    def _ranked(self, rank):
        return of_rank(self.statements, self.rank, rank)

    def _timed(self):
        return used(self._ranked(TIMED), names(self.kept))

    def _alone(self, statements: list[Statement], outputs: Iterable[Any]) -> list[Ref]:
        """Values of rank ALONE that are read: numbers, then whole arrays as Refs without index."""
        numbers = {e for e in refs(statements, outputs) if self.rank[e.name] == ALONE}
        read = {o for s in every(statements) if isinstance(s, Matrix) for o in s.operands}
        whole = {Ref(name) for name in read if self.rank.get(name) == ALONE}
        return [*sorted(numbers, key=place), *sorted(whole)]

    def _is_array(self, e):
        return e.index is None and e.name in self.arrays

    def _lead(self):
        outputs = [self.loop.first[i] for i in self.state]
        outputs += [self.loop.first[i] for i in self.loop.lines]
        for group_read in self.crossing.values():
            outputs += group_read
        alone = used(self._ranked(ALONE), names(outputs))
        text = Text({"p": "p"}, short_names(FIXED))
        lines = text.write(alone, outputs, hold=outputs)
        groups = [*self.crossing.values(), [self.loop.first[i] for i in self.state]]
        parts, delays = [self._numbers(text, group) for group in groups], []
        for i in sorted(self.loop.lines):
            root = self.loop.after[i].name
            size = sum(isinstance(e, Ref) and e.name == root for e in self.loop.after)
            delays.append(f"new Float64Array({size}).fill({text.of(self.loop.first[i])})")
        lines.append(f"return[{','.join(parts)},[{','.join(delays)}]];")
        return function("lead", "p", lines)

    def _numbers(self, text, group):
        """Numbers as one array, with whole arrays, if any, as its property A."""
        numbers = [e for e in group if not (isinstance(e, Ref) and self._is_array(e))]
        whole = [text.given[e.name] for e in group if isinstance(e, Ref) and self._is_array(e)]
        out = f"Float64Array.of({','.join(map(text.of, numbers))})"
        return f"Object.assign({out},{{A:[{','.join(whole)}]}})" if whole else out

    def _begin(self, name, extra):
        """The Text of a function, and its first lines: names of what `_numbers` put together."""
        text, lines = Text(extra, short_names(FIXED)), []
        for whole, where in ((False, "q"), (True, "q.A")):
            entries = [e for e in self.crossing[name] if self._is_array(e) == whole]
            variables = [next(text.names) for _ in entries]
            text.given.update(zip([e.name if whole else e for e in entries], variables))
            lines += [f"const[{','.join(variables)}]={where};"] if variables else []
        return text, lines

    def _signals(self):
        text, lines = self._begin("signals", {Ref("k"): "k"})
        streams = self.streams()
        variables = [next(text.names) for _ in streams]
        if variables:
            lines.append(f"const[{','.join(variables)}]=S;")
        body = text.write(self._timed(), streams)
        values = (text.of(e) for e in streams)
        body += [f"{a}[k]={v if v[0] == '+' else f'+{v}'};" for a, v in zip(variables, values)]
        lines += ["for(;k<K;++k){", *body, "}"] if variables else []
        return function("signals", "q,k,K,S", lines)

    def _run(self):
        text, lines, body, state = self._sample()
        rows = [f"R[o++]={self._real(e)}{text.of(e)};" for e in self._saved()]
        body += ["if(k%every===0){", *rows, "}", *self._next(text)]
        lines += ["let o=0;", "for(;k<K;++k){", *body, "}"]
        lines += [f"c[{j}]={variable};" for j, variable in enumerate(state)]
        return function("run", "q,c,L,S,N,k,K,every,R", [*lines, "return o;"])

    def _sample(self):
        """Return (Text, lines in front of the loop, lines of a sample, variables of the state)."""
        text, lines = self._begin("run", {Ref("k"): "k"})
        streams = self.streams()
        streams_read = [next(text.names) for _ in streams]
        noise = [next(text.names) for _ in range(self.loop.case.loop.plant.tanks)]
        if streams_read:
            lines.append(f"const[{','.join(streams_read)}]=S;")
        lines.append(f"const[{','.join(noise)}]=N;")
        state = [next(text.names) for _ in self.state]
        text.given |= {Ref("c", i): variable for i, variable in zip(self.state, state)}
        delays = [next(text.names) for _ in self.loop.lines]
        text.given |= dict(zip(self.loop.lines.values(), delays))
        lines.append(f"let[{','.join(state)}]=c;")
        lines += [f"const[{','.join(delays)}]=L;"] if delays else []
        body, deviates = [], (Ref("n", i) for i in range(len(noise)))
        for e, array in zip([*streams, *deviates], [*streams_read, *noise]):
            text.given[e] = next(text.names)
            body.append(f"const {text.given[e]}={array}[k];")
        outputs = self._outputs()
        body += text.write([*self.again, *self.moving], outputs, hold=outputs)
        return text, lines, body, state

    def _next(self, text):
        """Lines that replace the last state by the next one."""
        moved = []
        for i in self.state:
            e, name = self.loop.after[i], text.given[Ref("c", i)]
            if e != Ref("c", i):
                moved.append((name, text.of(e), self._real(e)))
        old = {name for name, *_ in moved}
        temporary = {value: next(text.names) for _, value, _ in moved if value in old}
        first = [f"const {new}={value};" for value, new in temporary.items()]
        return first + [f"{n}={sign}{temporary.get(v, v)};" for n, v, sign in moved]

    def _real(self, e):
        """Prefix that converts a truth value to a number; "" for a number."""
        return "+" if isinstance(e, Ref) and e.name in self.truths else ""

    def _read(self):
        text, lines = self._begin("read", {})
        state = [next(text.names) for _ in self.state]
        text.given |= {Ref("c", i): variable for i, variable in zip(self.state, state)}
        lines.append(f"const[{','.join(state)}]=c;")
        outputs = self._measures()
        lines += text.write(self.measured, outputs, hold=outputs)
        return function("read", "q,c", [*lines, f"return[{','.join(map(text.of, outputs))}];"])


def place(e: Ref) -> tuple[str, Any]:
    """Return the sort key of Refs."""
    return e.name, -1 if e.index is None else e.index


def function(name: str, arguments: str, lines: Iterable[str]) -> str:
    """Return a function as text, with constants that follow each other in one statement."""
    short: list[str] = []
    constant = False
    for line in lines:
        now = line.startswith(("const ", "const[")) and line.endswith(";")
        if now and constant:
            short[-1] = short[-1][:-1] + ","
            line = line.removeprefix("const").lstrip()
        short.append(line)
        constant = now
    return f"function {name}({arguments}){{" + "\n".join(short) + "}"


def maths(text: str) -> str:
    """Return the line that gives the functions of Math in `text` their own names."""
    return f"const{{{','.join(m for m in MATHS if f'{m}(' in text)}}}=Math;"

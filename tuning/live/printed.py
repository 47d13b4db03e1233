"""The functions of one case as JavaScript: what depends on its numbers alone, signals, the run.

Imported by `tuning.live.engine`.
"""

from collections.abc import Iterable
from typing import Any

from jaxtank.export.compact import MATHS, Text, short_names
from jaxtank.export.javascript import helpers
from jaxtank.export.regions import hoisted, kept_in_time, of_rank, ranks, refs
from jaxtank.export.statements import Array, Define, Matrix, Ref, Statement, names, used
from jaxtank.export.whole_loop import SAVED, WholeLoop

ALONE, TIMED, MOVING = 0, 1, 2
"""Ranks: what depends on the numbers of the loop alone, on time too, on the state too."""
FIXED = frozenset("p k c n q S N L R K every o Q".split())
"""Names of arguments of the printed functions."""


class Printed:
    """The printed functions of a WholeLoop.

    lead(p) -> [numbers for signals, run and read, and the first state]; signals(q, k, K, S) fills
    S, arrays of what is known of each sample k to K - 1; run(q, c, L, S, N, k, K, every, R) moves
    the state c over those samples, with the deviates N of the noise, and writes a row to R every
    so many; read(q, c) returns the measures.
    """

    def __init__(self, loop: WholeLoop):
        self.loop = loop
        self.statements = hoisted(loop.statements)
        lines = dict.fromkeys(loop.lines.values(), MOVING)
        given = {"p": ALONE, "k": TIMED, "c": MOVING, "n": MOVING, **lines}
        self.rank = ranks(self.statements, given)
        self.moving = self._moving()
        self.measured = self._measured()
        self.kept, self.again = self._kept()
        self.crossing = {
            "signals": self._alone(self._timed(), self.kept),
            "run": self._alone([*self.again, *self.moving], self._outputs()),
            "read": self._alone(self.measured, self._measures()),
        }

    def text(self) -> str:
        """Return the four functions as an object, without the helpers that they call."""
        functions = [self._lead(), self._signals(), self._run(), self._read()]
        return "\n".join(functions)

    def helpers(self) -> list[str]:
        """Return the functions that the printed ones call."""
        return helpers(self.statements)

    def streams(self) -> list[Ref]:
        """Return what is known of each sample, in the order of S."""
        return sorted(self.kept)

    def columns(self) -> dict[str, int]:
        """Return {saved field: number of its entries}, in the order of a row of R."""
        return {field: len(self.loop.saved[field]) for field in SAVED}

    def _outputs(self):
        return [*self.loop.after, *(e for f in SAVED for e in self.loop.saved[f])]

    def _measures(self):
        return [e for found in self.loop.measures.values() for e in found]

    def _ranked(self, rank):
        return of_rank(self.statements, self.rank, rank)

    def _timed(self):
        return used(self._ranked(TIMED), names(self.kept))

    def _moving(self):
        return used(self._ranked(MOVING), names(self._outputs()))

    def _measured(self):
        return used(self._ranked(MOVING), names(self._measures()))

    def _kept(self):
        """What is kept of every sample, and what is computed again of it."""
        wanted = refs(self.moving, self._outputs())
        wanted = {e for e in wanted if self.rank[e.name] == TIMED and e.name != "k"}
        timed = self._ranked(TIMED)
        kept, again = kept_in_time(timed, wanted, self.rank)
        return kept, again

    def _alone(self, statements: list[Statement], outputs: Iterable[Any]) -> list[Ref]:
        """What of rank ALONE is read, entries of arrays in place of the arrays."""
        inside = {s.name for s in statements if isinstance(s, Array)}
        found = {e for e in refs(statements, outputs) if self.rank[e.name] == ALONE}
        arrays = [s for s in self._arrays(statements) if s.name not in inside]
        found |= {e for s in arrays for e in s.entries if isinstance(e, Ref)}
        return sorted(found, key=lambda e: (e.name, -1 if e.index is None else e.index))

    def _arrays(self, statements):
        """Arrays of rank ALONE that matrix operations of a higher rank read."""
        read = {o for s in statements if isinstance(s, Matrix) for o in s.operands}
        return [s for s in self._ranked(ALONE) if isinstance(s, Array) and s.name in read]

    def _lead(self):
        outputs = [*self.loop.first]
        for found in self.crossing.values():
            outputs += found
        alone = used(self._ranked(ALONE), names(outputs))
        text = Text({"p": "p"}, short_names(FIXED))
        lines = text.write(alone, outputs, hold=outputs)
        parts = [",".join(map(text.of, found)) for found in self.crossing.values()]
        first = ",".join(self._first(text))
        return _function(
            "lead", "p", [*lines, f"return[[{parts[0]}],[{parts[1]}],[{parts[2]}],[{first}]];"]
        )

    def _first(self, text):
        """The first state; a line is an array in place of its first entry, the others are left."""
        sizes, skip = self._line_sizes(), 0
        for i, e in enumerate(self.loop.first):
            if i in sizes:
                skip = sizes[i]
                yield f"new Float64Array({skip}).fill({text.of(e)})"
            if skip:
                skip -= 1
                continue
            yield f"+{text.of(e)}"

    def _line_sizes(self):
        """{entry of c at which a line begins: its size}."""
        sizes = {}
        for start, name in self.loop.lines.items():
            root = self.loop.after[start].name
            sizes[start] = sum(isinstance(e, Ref) and e.name == root for e in self.loop.after)
            assert name
        return sizes

    def _begin(self, name, extra):
        """Return the first lines of a function, and its Text with the numbers it reads."""
        text = Text(extra, short_names(FIXED))
        found = self.crossing[name]
        own = [next(text.names) for _ in found]
        text.given.update(zip(found, own))
        return text, [f"const[{','.join(own)}]=q;"] if own else []

    def _signals(self):
        text, lines = self._begin("signals", {Ref("k"): "k"})
        streams = self.streams()
        own = [next(text.names) for _ in streams]
        if own:
            lines.append(f"const[{','.join(own)}]=S;")
        body = text.write(self._timed(), streams)
        body += [f"{array}[k]=+{text.of(e)};" for array, e in zip(own, streams)]
        lines += ["for(;k<K;++k){", *body, "}"] if own else []
        return _function("signals", "q,k,K,S", lines)

    def _run(self):
        text, lines = self._begin("run", {Ref("k"): "k"})
        streams = [next(text.names) for _ in self.kept]
        noise = [next(text.names) for _ in range(self.loop.case.loop.plant.tanks)]
        text.given |= {e: f"{own}[k]" for e, own in zip(self.streams(), streams)}
        text.given |= {Ref("n", i): f"{own}[k]" for i, own in enumerate(noise)}
        if streams:
            lines.append(f"const[{','.join(streams)}]=S;")
        lines.append(f"const[{','.join(noise)}]=N;")
        state = self._state(text)
        lines.append(f"let[{','.join(state)}]=c;")
        lines += text.write(self._arrays(self.moving), [])
        outputs = self._outputs()
        body = text.write([*self.again, *self.moving], outputs, hold=self.loop.after)
        rows = [f"R[o++]={text.of(e)};" for f in SAVED for e in self.loop.saved[f]]
        body += ["if(k%every===0){", *rows, "}", *self._next(text)]
        lines += ["let o=0;", "for(;k<K;++k){", *body, "}", f"c.splice(0,c.length,{','.join(state)});"]
        return _function("run", "q,c,S,N,k,K,every,R", lines)

    def _state(self, text):
        """The variables of the state: one for each entry of c, or for a line as a whole."""
        sizes, skip, own = self._line_sizes(), 0, []
        for i in range(len(self.loop.first)):
            if i in sizes:
                skip = sizes[i]
                own.append(next(text.names))
                text.given[self.loop.lines[i]] = own[-1]
            if skip:
                skip -= 1
                continue
            own.append(next(text.names))
            text.given[Ref("c", i)] = own[-1]
        return own

    def _next(self, text):
        """Lines that put the next state in the place of the last one."""
        moved = []
        lines = set(self.loop.lines.values())
        for i, e in enumerate(self.loop.after):
            if e == Ref("c", i) or Ref("c", i) not in text.given:
                continue
            moved.append((text.given[Ref("c", i)], text.of(e), self._real(e)))
        assert lines or moved
        old = {name for name, *_ in moved}
        temporary = {value: next(text.names) for _, value, _ in moved if value in old}
        first = [f"const {new}={value};" for value, new in temporary.items()]
        return first + [f"{n}={sign}{temporary.get(v, v)};" for n, v, sign in moved]

    def _real(self, e):
        """What makes a number of a value that may be true or false."""
        kinds = self.__dict__.setdefault(
            "kinds", {s.name: s.kind for s in self.statements if isinstance(s, Define)}
        )
        return "+" if isinstance(e, Ref) and kinds.get(e.name) == "truth" else ""

    def _read(self):
        text, lines = self._begin("read", {})
        lines.append(f"const[{','.join(self._state(text))}]=c;")
        outputs = self._measures()
        lines += text.write(self.measured, outputs, hold=outputs)
        return _function("read", "q,c", [*lines, f"return[{','.join(map(text.of, outputs))}];"])


def _function(name, arguments, lines):
    return f"function {name}({arguments}){{" + "\n".join(lines) + "}"


def maths(text: str) -> str:
    """Return the line that gives the functions of Math in `text` their own names."""
    return f"const{{{','.join(m for m in MATHS if f'{m}(' in text)}}}=Math;"


__all__ = ["Define", "Printed", "maths"]

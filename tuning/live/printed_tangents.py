"""The functions of the derivatives of one case as JavaScript."""

from jaxtank.export.statements import Array, Matrix, Ref, Statement, every, names, used
from jaxtank.export.whole.compact import Text
from jaxtank.export.whole.regions import hoisted, of_rank, ranks, refs, split
from jaxtank.export.whole.tangents import TangentLoop
from tuning.live.printed import ALONE, MOVING, TIMED, Printed, function, place


class PrintedTangents(Printed):
    """The printed functions of a TangentLoop: lead, signals, read, as those of `Printed`, and"""

    def __init__(self, tangents: TangentLoop):
        self.tangents = tangents
        both = every(tangents.loop.statements)
        self.arrays = {s.name for s in both if isinstance(s, Array | Matrix)}
        statements = hoisted(tangents.loop.statements)
        lines = [*tangents.lines.values(), *tangents.loop.lines.values()]
        along = {**dict.fromkeys("pkcn", 0), "d": 1, "e": 1}
        along |= {name: int(name in tangents.lines.values()) for name in lines}
        statements = split(statements, along)
        given = {"p": ALONE, "d": ALONE, "k": TIMED, **dict.fromkeys("cen", MOVING)}
        self.order = ranks(statements, {**given, **dict.fromkeys(lines, MOVING)})
        self.along = ranks(statements, along)
        self.directed = of_rank(statements, self.along, 1)
        plain = [s for s in of_rank(statements, self.along, 0)]
        after = [*tangents.after, *tangents.errors]
        slopes = [e for found in tangents.measures.values() for e in found]
        self.pushed = self._later(used(self.directed, names(after)))
        self.sloped = self._later(used(self.directed, names(slopes)))
        self.slopes, self.after = slopes, after
        aimed = [*self._aimed(self.pushed, after), *self._aimed(self.sloped, slopes)]
        aimed += [e for e in tangents.first if isinstance(e, Ref)]
        self.aiming = used(of_rank(self.directed, self.order, ALONE), names(aimed))
        super().__init__(
            tangents.loop,
            plain,
            others=self._plain(self.pushed, after),
            at_end=self._plain(self.sloped, slopes),
        )
        self.crossing["aim"] = sorted(set(self._plain(self.aiming, tangents.first)), key=place)
        at_end = [e for e in self._plain(self.sloped, slopes) if self.rank[e.name] == ALONE]
        self.crossing["slope"] = self._alone(
            used(self._ranked(MOVING), names(self.at_end)), [*self.at_end, *at_end]
        )

    def used(self) -> list[Statement]:
        """Return every statement that is printed."""
        return [*self.statements, *self.directed]

    def text(self) -> str:
        """Return the functions."""
        parts = [self._lead(), self._signals(), self._read()]
        return "\n".join([*parts, self._aim(), self._push(), self._slope()])

    def _later(self, statements: list[Statement]) -> list[Statement]:
        """Those that are not done before the run."""
        return [s for s in statements if s not in of_rank([s], self.order, ALONE)]

    def _reads(self, statements, outputs):
        """Every Ref that is read, whole arrays without an index."""
        read = {o for s in every(statements) if isinstance(s, Matrix) for o in s.operands}
        own = {s.name for s in every(statements) if isinstance(s, Array | Matrix)}
        return refs(statements, outputs) | {Ref(name) for name in read - own}

    def _aimed(self, statements, outputs):
        """What of the direction alone is read."""
        found = self._reads(statements, outputs)
        aimed = [e for e in found if self.along[e.name] and self.order[e.name] == ALONE]
        return sorted(aimed, key=lambda e: (self._is_array(e), place(e)))

    def _plain(self, statements, outputs):
        """What does not depend on a direction and is read."""
        found = self._reads(statements, outputs)
        own = {s.name for s in every(statements) if isinstance(s, Array | Matrix)}
        plain = [e for e in found if self.along.get(e.name) == 0 and e.name not in ("k", *own)]
        return sorted(plain, key=place)

    def _aim(self):
        text, lines = self._begin("aim", {"d": "d"})
        groups = [
            self._aimed(self.pushed, self.after),
            self._aimed(self.sloped, self.slopes),
            [e for i, e in enumerate(self.tangents.first) if i not in self._skipped()],
        ]
        outputs = [e for group in groups for e in group]
        lines += text.write(self.aiming, outputs, hold=outputs)
        parts = [self._numbers(text, group) for group in groups]
        sizes = self._tangent_lines()
        delays = [
            f"new Float64Array({n}).fill({text.of(self.tangents.first[i])})" for i, n in sizes
        ]
        return function("aim", "q,d", [*lines, f"return[{','.join(parts)},[{','.join(delays)}]];"])

    def _tangent_lines(self):
        """[(entry of e at which a line begins, its size)]."""
        after = self.tangents.after
        roots = [(i, after[i].name) for i in self.tangents.lines]
        return [(i, sum(isinstance(e, Ref) and e.name == root for e in after)) for i, root in roots]

    def _skipped(self):
        """Entries of e that are in a line."""
        return {i + j for i, n in self._tangent_lines() for j in range(n)}

    def _push(self):
        text, lines, body, state = self._sample()
        body += self._inner(text)
        weights = self.tangents.weights
        count = len(weights)
        products = "+".join(
            f"{w!r}*E[a*{count}+{i}]*E[b*{count}+{i}]" for i, w in enumerate(weights)
        )
        body += [f"for(let a=0;a<P;++a)for(let b=0;b<=a;++b)G[a*P+b]+={products or 0};"]
        body += self._next(text)
        lines += [f"const E=new Float64Array(P*{max(1, count)});", "for(;k<K;++k){", *body, "}"]
        lines += [f"c[{j}]={own};" for j, own in enumerate(state)]
        return function("push", "q,c,L,S,N,k,K,P,D,T,M,G", lines)

    def _inner(self, text):
        """Lines that move the tangents along every direction over one sample."""
        t, outer = self.tangents, dict(text.given)
        aimed = self._aimed(self.pushed, self.after)
        places = [i for i in range(len(t.first)) if i not in self._skipped()]
        whole = [e for e in aimed if self._is_array(e)]
        aimed = [e for e in aimed if not self._is_array(e)]
        loads = [*((e, "D", len(aimed)) for e in aimed)]
        loads += [(Ref("e", i), "T", len(places)) for i in places]
        lines = ["for(let j=0;j<P;++j){"]
        at = {"D": 0, "T": 0}
        for e, array, size in loads:
            text.given[e] = next(text.names)
            lines.append(f"const {text.given[e]}={array}[j*{size}+{at[array]}];")
            at[array] += 1
        for i, e in enumerate(whole):
            text.given[e.name] = next(text.names)
            lines.append(f"const {text.given[e.name]}=D.A[j][{i}];")
        for i, name in enumerate(t.lines.values()):
            text.given[name] = next(text.names)
            lines.append(f"const {text.given[name]}=M[j][{i}];")
        after = [t.after[i] for i in places]
        outputs = [*after, *t.errors]
        inner = Text(text.given, text.names)
        lines += inner.write(self.pushed, outputs, hold=outputs)
        lines += [f"T[j*{len(places)}+{i}]={inner.of(e)};" for i, e in enumerate(after)]
        lines += [f"E[j*{len(t.errors)}+{i}]={inner.of(e)};" for i, e in enumerate(t.errors)]
        text.given = outer
        return [*lines, "}"]

    def _slope(self):
        text, lines = self._begin("slope", {})
        state = [next(text.names) for _ in self.state]
        text.given |= {Ref("c", i): own for i, own in zip(self.state, state)}
        aimed = self._aimed(self.sloped, self.slopes)
        places = [i for i in range(len(self.tangents.first)) if i not in self._skipped()]
        moved = {Ref("e", i): next(text.names) for i in places}
        text.given |= moved
        lines.append(f"const[{','.join(state)}]=c;")
        lines += self._unpacked(text, aimed, "D")
        lines += [f"const[{','.join(moved.values())}]=T;"] if moved else []
        plain = used(self._ranked(MOVING), names(self.at_end))
        outputs = [*self.at_end, *self.slopes]
        lines += text.write([*plain, *self.sloped], outputs, hold=outputs)
        return function(
            "slope", "q,c,D,T", [*lines, f"return[{','.join(map(text.of, self.slopes))}];"]
        )

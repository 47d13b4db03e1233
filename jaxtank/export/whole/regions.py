"""Statements sorted by what they depend on, so that each is computed as seldom as possible."""

from collections.abc import Iterable, Mapping
from typing import cast

from jaxtank.export.statements import (
    Array,
    Define,
    Loop,
    Matrix,
    Ref,
    Statement,
    Store,
    Until,
    names,
    used,
)

_CHEAP = """
add sub mul neg abs max min lt le gt ge eq ne and or not select real square truth
"""
CHEAP = frozenset(_CHEAP.split())
"""Operations that cost less than a number that is kept for every sample."""


def hoisted(statements: Iterable[Statement]) -> list[Statement]:
    """Return statements with those of a loop's body that no pass changes moved in front of it."""
    out: list[Statement] = []
    for s in statements:
        if not isinstance(s, Loop):
            out.append(s)
            continue
        inside, own = {name for _, name, _ in s.carried}, []
        for one in hoisted(s.body):
            free = isinstance(one, Define | Array) and not one.reads & inside
            if free:
                out.append(one)
                continue
            own.append(one)
            inside |= defined(one)
        out.append(s._replace(body=own))
    return out


def defined(statement: Statement) -> set[str]:
    """Return the names that a statement defines for those after it."""
    if isinstance(statement, Loop):
        return {name for _, name, _ in statement.carried}
    return set() if isinstance(statement, Until) else {statement.name}


def ranks(statements: Iterable[Statement], given: Mapping[str, int]) -> dict[str, int]:
    """Return {name: rank} of every variable: the largest rank of what it depends on."""
    found = dict(given)
    for s in statements:
        own = s.reads if not isinstance(s, Loop) else s.reads - local(s)
        rank = max((found[n] for n in own), default=0)
        if isinstance(s, Store):
            rank = max(rank, found[s.array])
        found.update(dict.fromkeys(defined(s), rank))
    return found


def split(statements: Iterable[Statement], given: Mapping[str, int]) -> list[Statement]:
    """Return statements with each loop of mixed ranks, 0 and 1, as two: one of what has rank 0, and
    one of all, of which only the rest is read.
    """
    rank, out = dict(given), []
    for s in statements:
        if isinstance(s, Loop):
            mixed = _ranks_of(s, rank)
            low = [i for i, (_, name, _) in enumerate(s.carried) if not mixed[name]]
            if low and len(low) < len(s.carried):
                carried, new = (tuple(part[i] for i in low) for part in (s.carried, s.new))
                plain = s._replace(carried=carried, new=new, body=used(s.body, names(new)))
                s = _renamed(s, {s.carried[i][1] for i in low} | (local(s) - defined(s)))
                out.append(plain)
                rank.update(ranks([plain], rank))
        out.append(s)
        rank.update(ranks([s], rank))
    return out


def _ranks_of(loop, rank):
    """{carried variable of a loop: its rank}."""
    found = {
        name: max((rank[n] for n in names([start])), default=0) for _, name, start in loop.carried
    }
    while True:
        inside = ranks(loop.body, {**rank, **found})
        new = {
            name: max([found[name], *(inside[n] for n in names([e]))])
            for (_, name, _), e in zip(loop.carried, loop.new)
        }
        if new == found:
            return found
        found = new


def _renamed(s, own):
    """A statement with other names of the variables `own`."""

    def other(e):
        if not isinstance(e, Ref):
            return e
        return Ref(f"{e.name}_" if e.name in own else e.name, other(e.index))

    def name(n):
        return f"{n}_" if n in own else n

    if isinstance(s, Loop):
        return s._replace(
            carried=tuple((kind, name(n), other(start)) for kind, n, start in s.carried),
            body=[_renamed(one, own) for one in s.body],
            new=tuple(map(other, s.new)),
        )
    if isinstance(s, Define):
        return s._replace(name=name(s.name), args=tuple(map(other, s.args)))
    if isinstance(s, Array):
        return s._replace(name=name(s.name), entries=tuple(map(other, s.entries)))
    if isinstance(s, Until):
        return s._replace(test=other(s.test))
    if isinstance(s, Matrix):
        return s._replace(name=name(s.name), operands=tuple(map(name, s.operands)))
    return s


def local(loop: Loop) -> set[str]:
    """Return the names that exist in a loop's body alone, and its carried variables."""
    inside = {name for _, name, _ in loop.carried}
    for s in loop.body:
        inside |= local(s) if isinstance(s, Loop) else defined(s)
    return inside


def of_rank(
    statements: Iterable[Statement], rank: Mapping[str, int], wanted: int
) -> list[Statement]:
    """Return the statements of one rank, in order."""
    return [s for s in statements if any(rank[n] == wanted for n in defined(s))]


def refs(statements: Iterable[Statement], entries: Iterable = ()) -> set[Ref]:
    """Return every Ref that statements and entries read, without those that a loop has inside; of
    an array that is read at a variable index, the array and the index.
    """
    found = {e for e in entries if isinstance(e, Ref)}
    for s in statements:
        if isinstance(s, Loop):
            inside = refs(s.body, [*s.new, *(start for *_, start in s.carried)])
            own = local(s)
            found |= {e for e in inside if e.name not in own}
        else:
            found |= {e for e in entries_read(s) if isinstance(e, Ref)}
    moving = {e for e in found if isinstance(e.index, Ref)}
    return (found - moving) | {r for e in moving for r in (Ref(e.name), cast(Ref, e.index))}


def entries_read(s: Statement) -> tuple:
    """Return the numbers and Refs that a statement, not a loop, reads one by one."""
    if isinstance(s, Define):
        return s.args
    if isinstance(s, Array):
        return s.entries
    if isinstance(s, Store):
        return s.index, s.value, Ref(s.array)
    return (s.test,) if isinstance(s, Until) else ()


def kept_in_time(
    timed: list[Statement], wanted: set[Ref], rank: Mapping[str, int]
) -> tuple[set[Ref], list[Statement]]:
    """Return (values of rank 1 to keep for every sample, statements that follow from them)."""
    made = {s.name: s for s in timed if isinstance(s, Define)}
    kept, again = set(wanted), set()

    def free(ref: Ref, depth: int) -> bool:
        """Whether a value needs nothing to be kept that is not."""
        if rank[ref.name] == 0 or ref in kept or ref.name == "k":
            return True
        s = made.get(ref.name)
        if s is None or s.op not in CHEAP or depth == 0:
            return False
        return all(free(a, depth - 1) for a in s.args if isinstance(a, Ref))

    for ref in sorted(wanted, key=lambda r: order(timed, r), reverse=True):
        s = made.get(ref.name)
        if s is None or s.op not in CHEAP:
            continue
        kept.discard(ref)
        if all(free(a, 1) for a in s.args if isinstance(a, Ref)):
            again.add(ref)
        else:
            kept.add(ref)
    rest = [s for s in timed if not isinstance(s, Define) or Ref(s.name) not in kept]
    return kept, used(rest, names(again))


def order(statements: list[Statement], ref: Ref) -> int:
    """Return the position of the statement that defines a Ref, -1 for an input."""
    return next((i for i, s in enumerate(statements) if ref.name in defined(s)), -1)

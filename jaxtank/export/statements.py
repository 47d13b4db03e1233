"""The statements of exported code, on scalars: output of lowering, input of the printers."""

import math
import string
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

REAL, WHOLE, TRUTH = "real", "whole", "truth"
MATRIX_OPERATIONS = ("product", "cholesky", "forward", "backward", "solve")


class Ref(NamedTuple):
    """A variable, or an entry of an array, whose index is a number or a variable."""

    name: str
    index: "int | Ref | None" = None


class Define(NamedTuple):
    """name = op(args)."""

    kind: str
    name: str
    op: str
    args: tuple


class Vector(NamedTuple):
    """The kind of an array of `size` entries that a loop carries."""

    kind: str
    size: int


class View(NamedTuple):
    """Entries of an array at offset + sum_d strides[d] i_d, for the counters i_d of loops."""

    name: str
    offset: "int | Ref"
    strides: tuple


class Each(NamedTuple):
    """name[i] = op(args at i), for every i below `shape`, row by row; over: what is reduced by op.

    An argument is a number, a Ref or a View. With `over`, (sizes) of more counters, the one View
    has strides for them too. `array`: the larger array that is written instead, from `offset` on,
    in place; `name` is what it is called from then on.
    """

    kind: str
    name: str
    shape: tuple
    op: str
    args: tuple
    over: tuple = ()
    array: str = ""
    offset: Any = 0
    steps: tuple = ()  # strides in it, where not row by row


class Array(NamedTuple):
    """An array with its entries."""

    name: str
    entries: tuple
    kind: str = REAL


class Matrix(NamedTuple):
    """A matrix operation, name = op(operands), on arrays by name."""

    # Operations and their `sizes`: "product" (m, k, n) of A (m, k) and B (k, n); "cholesky" (n,);
    # "forward" and "backward" (n, k): solve L x = b and L' x = b; "solve" (n, k): A x = b, any A.

    name: str
    op: str
    operands: tuple
    sizes: tuple


class Store(NamedTuple):
    """array[index] = value, in place; the array is called `name` from then on."""

    name: str
    array: str
    index: Any
    value: Any


class Until(NamedTuple):
    """The end of a loop: leave it unless `test`, a variable, is true."""

    test: Any


class Loop(NamedTuple):
    """A loop of `count` passes, or until it ends by itself where `count` is None."""

    count: int | None
    carried: tuple  # ((kind, name, start), ...)
    body: list
    new: tuple
    most: int | None = None  # passes after which a loop without a count has ended


Statement = Define | Array | Each | Matrix | Store | Until | Loop


def template(file: str, **words: Any) -> str:
    """Return a file of the folder templates, with `words` in place of ${word}."""
    text = (Path(__file__).parent / "templates" / file).read_text("utf-8")
    return string.Template(text).substitute(words) if words else text


def below(lines: Iterable[str]) -> str:
    """Return lines for a place in a template, a line break before each."""
    return "".join(f"\n{line}" for line in lines)


def parts(file: str) -> list[str]:
    """Return the functions of a file of the folder templates, a line break before each."""
    return [f"\n{part.strip()}" for part in template(file).split("\n\n")]


def names(entries: Iterable) -> set[str]:
    """Return the names of the variables among numbers and Refs."""
    variables = [e for e in entries if isinstance(e, Ref)]
    indices = {e.index.name for e in variables if isinstance(e.index, Ref)}
    return {e.name for e in variables} | indices


def reads(s: Statement) -> set[str]:
    """Return the names of the variables that a statement reads, of a loop in its body too."""
    if isinstance(s, Loop):
        inside = set().union(*map(reads, s.body))
        return inside | names(s.new) | names(start for *_, start in s.carried)
    if isinstance(s, Matrix):
        return set(s.operands)
    array = s.array if isinstance(s, Each) else ""
    return names(entries_read(s)) | ({array} if array else set())


def every(statements: Iterable[Statement]) -> Iterator[Statement]:
    """Yield each statement; the statements in a loop's body follow the loop."""
    for s in statements:
        yield s
        if isinstance(s, Loop):
            yield from every(s.body)


def called(statements: Iterable[Statement], texts: Mapping[Any, str]) -> list[str]:
    """Return the texts of the operations that occur in statements."""
    operations = {s.op for s in every(statements) if isinstance(s, Define | Matrix)}
    return [text for op, text in texts.items() if op in operations]


def used(statements: list[Statement], read: set[str]) -> list[Statement]:
    """Return the statements that the variables named in `read` depend on, in order."""
    needed, read = [], set(read)
    for s in reversed(statements):
        if isinstance(s, Loop):
            if not read & {name for _, name, _ in s.carried}:
                continue
            s = s._replace(body=used(s.body, names(s.new)))
        elif not isinstance(s, Until) and s.name not in read:
            continue
        read |= reads(s)
        needed.append(s)
    return needed[::-1]


def hoisted(statements: Iterable[Statement]) -> list[Statement]:
    """Return statements with the loop-invariant ones moved in front of their loop."""
    out: list[Statement] = []
    for s in statements:
        if not isinstance(s, Loop):
            out.append(s)
            continue
        inside, body = {name for _, name, _ in s.carried}, []
        for inner in hoisted(s.body):
            free = isinstance(inner, Define | Array | Each) and not reads(inner) & inside
            (out if free else body).append(inner)
            inside |= set() if free else defined(inner)
        out.append(s._replace(body=body))
    return out


def defined(statement: Statement) -> set[str]:
    """Return the names that a statement defines for those after it."""
    if isinstance(statement, Loop):
        return {name for _, name, _ in statement.carried}
    return set() if isinstance(statement, Until) else {statement.name}


def ranks(statements: Sequence[Statement], inputs: Mapping[str, int]) -> dict[str, int]:
    """Return {name: rank} of every variable: the largest rank of its operands."""
    rank_of = dict(inputs)
    for s in statements:
        read = reads(s) - local(s) if isinstance(s, Loop) else reads(s)
        rank = max((rank_of[n] for n in read), default=0)
        if isinstance(s, Array | Each) and s.kind != REAL:  # constants that are kept are reals
            rank = max(rank, 1)
        rank_of.update(dict.fromkeys(defined(s), rank))
    first: dict[str, str] = {}  # an array that is written in place has one rank
    for s in statements:
        if isinstance(s, Each) and s.array:
            first[s.name] = first.get(s.array, s.array)
    for name, array in first.items():
        rank_of[array] = max(rank_of[array], rank_of[name])
    return rank_of | {name: rank_of[array] for name, array in first.items()}


def local(loop: Loop) -> set[str]:
    """Return the names that exist in a loop's body alone, and its carried variables."""
    inside = {name for _, name, _ in loop.carried}
    for s in loop.body:
        inside |= local(s) if isinstance(s, Loop) else defined(s)
    return inside


def of_rank(
    statements: Iterable[Statement], rank: Mapping[str, int], level: int
) -> list[Statement]:
    """Return the statements of one rank, in order."""
    return [s for s in statements if any(rank[n] == level for n in defined(s))]


def refs(statements: Iterable[Statement], entries: Iterable = ()) -> set[Ref]:
    """Return every Ref that statements and entries read, with arrays and indices apart."""
    read = {e for e in entries if isinstance(e, Ref)}
    for s in statements:
        if isinstance(s, Loop):
            inside = refs(s.body, [*s.new, *(start for *_, start in s.carried)])
            private = local(s)
            read |= {e for e in inside if e.name not in private}
        else:
            read |= {e for e in entries_read(s) if isinstance(e, Ref)}
    moving = {e for e in read if isinstance(e.index, Ref)}
    return (read - moving) | {r for e in moving for r in (Ref(e.name), cast(Ref, e.index))}


def entries_read(s: Statement) -> tuple:
    """Return the numbers and Refs that a statement, not a loop, reads one by one."""
    if isinstance(s, Define):
        return s.args
    if isinstance(s, Array):
        return s.entries
    if isinstance(s, Each):
        views = [a for a in s.args if isinstance(a, View)]
        read = [Ref(a.name) for a in views] + [a.offset for a in views]
        return *(a for a in s.args if not isinstance(a, View)), *read, s.offset
    if isinstance(s, Store):
        return s.index, s.value, Ref(s.array)
    return (s.test,) if isinstance(s, Until) else ()


def size_of(s: Array | Each | Matrix) -> int:
    """Return the number of entries of an Array or of the result of an Each or a Matrix."""
    if isinstance(s, Array):
        return len(s.entries)
    if isinstance(s, Each):
        return math.prod(s.shape)
    rows: dict[str, Any] = {"product": lambda m, k, n: m * n, "cholesky": lambda n: n * n}
    return rows.get(s.op, lambda n, k: n * k)(*s.sizes)


def array_kinds(statements: Iterable[Statement]) -> dict[str, Vector]:
    """Return {array that the statements define, but for those written in place: its kind, size}."""
    kinds: dict[str, Vector] = {}
    for s in every(statements):
        if isinstance(s, Array) or (isinstance(s, Each) and not s.array):
            kinds[s.name] = Vector(s.kind, size_of(s))
        elif isinstance(s, Matrix):
            kinds[s.name] = Vector(REAL, size_of(s))
        elif isinstance(s, Loop):
            kinds |= {name: kind for kind, name, _ in s.carried if isinstance(kind, Vector)}
    return kinds

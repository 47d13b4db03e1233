"""The statements of exported code, on scalars: output of lowering, input of the printers."""

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

REAL, WHOLE, TRUTH = "real", "whole", "truth"


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

    @property
    def reads(self):
        """Names of the variables that it reads."""
        return names(self.args)


class Array(NamedTuple):
    """An array of reals with its entries."""

    name: str
    entries: tuple

    @property
    def reads(self):
        """Names of the variables that it reads."""
        return names(self.entries)


class Matrix(NamedTuple):
    """A matrix operation, name = op(operands), on arrays by name."""

    # Operations and their `sizes`: "product" (m, k, n) of A (m, k) and B (k, n); "cholesky" (n,);
    # "forward" and "backward" (n, k): solve L x = b and L' x = b; "solve" (n, k): A x = b, any A.

    name: str
    op: str
    operands: tuple
    sizes: tuple

    @property
    def reads(self):
        """Names of the variables that it reads."""
        return set(self.operands)


class Store(NamedTuple):
    """array[index] = value, in place; `name` is what the array is called from then on."""

    name: str
    array: str
    index: Any
    value: Any

    @property
    def reads(self):
        """Names of the variables that it reads, the array as it was among them."""
        return {self.array} | names([self.index, self.value])


class Until(NamedTuple):
    """The end of a loop: leave it unless `test`, a variable, is true."""

    test: Any

    @property
    def reads(self):
        """Names of the variables that it reads."""
        return names([self.test])


class Loop(NamedTuple):
    """A loop of `count` passes, or until it ends by itself where `count` is None."""

    count: int | None
    carried: tuple  # ((kind, name, start), ...)
    body: list
    new: tuple

    @property
    def reads(self):
        """Names of the variables that it reads, in its body too."""
        inside = set().union(*(s.reads for s in self.body))
        return inside | names(self.new) | names(start for _, _, start in self.carried)


Statement = Define | Array | Matrix | Store | Until | Loop


def names(entries: Iterable) -> set[str]:
    """Return the names of the variables among numbers and Refs."""
    variables = [e for e in entries if isinstance(e, Ref)]
    return {e.name for e in variables} | {
        e.index.name for e in variables if isinstance(e.index, Ref)
    }


def every(statements: Iterable[Statement]) -> Iterator[Statement]:
    """Yield each statement; the statements in a loop's body follow the loop."""
    for s in statements:
        yield s
        if isinstance(s, Loop):
            yield from every(s.body)


def matrix_operations(statements: Iterable[Statement]) -> set[str]:
    """Return the matrix operations that occur in the statements."""
    return {s.op for s in every(statements) if isinstance(s, Matrix)}


def used(statements: list[Statement], read: set[str]) -> list[Statement]:
    """Return the statements that the variables named in `wanted` depend on, in order."""
    needed, read = [], set(read)
    for s in reversed(statements):
        if isinstance(s, Loop):
            if not read & {name for _, name, _ in s.carried}:
                continue
            s = s._replace(body=used(s.body, names(s.new)))
        elif not isinstance(s, Until) and s.name not in read:
            continue
        read |= s.reads
        needed.append(s)
    return needed[::-1]

"""The derivative of one sample of the whole loop along one direction, as statements."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank import measures as ms
from jaxtank.analysis.elimination import rolled
from jaxtank.case import Case
from jaxtank.export.lowering import lower_all
from jaxtank.export.simplify import is_number, simplified
from jaxtank.export.statements import Array, Define, Matrix, Ref, Statement
from jaxtank.export.whole.arrays import ArrayWriter
from jaxtank.export.whole.loop import (
    SAVED,
    WholeLoop,
    arguments,
    check_pointwise,
    entries_of,
    flat,
    sample_of,
)
from jaxtank.loop.closed_loop import run_of

LINEAR = ("product", "forward", "backward", "solve")
"""Matrix operations that give 0 for a last operand of 0."""


@dataclasses.dataclass(frozen=True)
class TangentLoop:
    """A WholeLoop without saved columns, and the tangents of its sample along one direction."""

    loop: WholeLoop
    leaves: tuple[tuple[str, tuple[int, ...]], ...]
    places: list[int]
    first: list[Any]
    after: list[Any]
    measures: dict[str, list[Any]]
    errors: list[Any]
    """Tangents of the residuals of a sample."""
    weights: list[float]
    """What the square of each residual counts in the Gauss-Newton matrix."""
    lines: dict[int, str]
    """{entry of e at which a Line begins: its name}."""


def tangent_loop(
    case: Case, names: Sequence[str], free: Sequence[str], squares: Sequence[tuple[str, float]]
) -> TangentLoop:
    """Return the TangentLoop of a case."""
    check_pointwise(case)
    kept = tuple(dict.fromkeys([*names, *(m for m, _ in squares)]))
    shapes = arguments(case, kept)
    leaves, structure = jax.tree.flatten(shapes["c"])
    floats = [i for i, v in enumerate(leaves) if jnp.issubdtype(v.dtype, jnp.floating)]
    directions = {n: v for n, v in shapes["p"].items() if n in free}
    pushed = _pushed(sample_of(case, kept, squares), floats, structure)
    given = {
        "p": shapes["p"],
        "d": directions,
        "k": shapes["k"],
        "c": shapes["c"],
        "e": tuple(leaves[i] for i in floats),
        "n": shapes["n"],
    }
    writer = ArrayWriter()
    with rolled():
        made = lower_all(pushed, given, writer)
    (before, after, found), (dbefore, dafter, dfound, errors) = made.outputs
    sizes = np.cumsum([0, *(int(np.prod(v.shape)) for v in leaves)])
    places = [int(j) for i in floats for j in range(sizes[i], sizes[i + 1])]
    lines = {start: name for start, name in made.lines.items()}
    loop = WholeLoop(
        case=case,
        leaves=entries_of(shapes["p"]),
        statements=made.statements,
        first=flat(before),
        after=flat(after),
        saved={f: [] for f in SAVED},
        measures={m: flat(found[m]) for m in names},
        functions=writer.functions,
        lines={s.index: n for s, n in lines.items() if s.name == "c"},
    )
    all_tangents = TangentLoop(
        loop=loop,
        leaves=entries_of(directions),
        places=places,
        first=flat(dbefore),
        after=flat(dafter),
        measures={m: flat(dfound[m]) for m in names},
        errors=flat(errors),
        weights=[float(w) for w in ms.residual_weights(run_of(case.loop, case.clock), squares)],
        lines={s.index: n for s, n in lines.items() if s.name == "e"},
    )
    return _without_zeros(all_tangents)


def _pushed(whole, floats, structure):
    """The function (p, d, k, c, e, n) -> (values, tangents) of a sample."""

    def pushed(p, d, k, c, e, n):
        rest = jax.tree.leaves(c)

        def parts(tree):
            found = jax.tree.leaves(tree)
            return tuple(found[i] for i in floats)

        def values(free, moving):
            entries = list(rest)
            for i, v in zip(floats, moving):
                entries[i] = v
            own = jax.tree.unflatten(structure, entries)
            before, after, _, found, errors = whole({**p, **free}, k, own, n)
            return (parts(before), parts(after), found, errors), (before, after, found)

        point = {name: p[name] for name in d}, parts(c)
        _, tangents, kept = jax.jvp(values, point, (d, e), has_aux=True)
        return kept, tangents

    return pushed


def _without_zeros(all_tangents):
    """The same, without the tangents that are always 0."""
    t = all_tangents
    lines = {Ref(name, i) for name in t.lines.values() for i in range(len(t.after))}
    zero = {i for i, e in enumerate(t.first) if is_number(e) and e == 0}
    zero -= {i for i in range(len(t.first)) if isinstance(t.after[i], Ref) and t.after[i] in lines}
    while True:
        known = {Ref("e", i): 0.0 for i in zero}
        statements, known = pruned(t.loop.statements, known)
        after = [known.get(e, e) for e in t.after]
        wrong = {i for i in zero if not (is_number(after[i]) and after[i] == 0)}
        if not wrong:
            break
        zero -= wrong
    keep = [i for i in range(len(t.places)) if i not in zero]

    def of(entries):
        return [known.get(e, e) for e in entries]

    def moved(entries):
        """Entries of e by their new numbers."""
        return [Ref("e", place[e.index]) if _is_input(e) else e for e in entries]

    place = {old: new for new, old in enumerate(keep)}
    renamed = [_renamed(s, place) for s in statements]
    loop = dataclasses.replace(
        t.loop,
        statements=renamed,
        first=of(t.loop.first),
        after=of(t.loop.after),
        measures={m: of(v) for m, v in t.loop.measures.items()},
    )
    return dataclasses.replace(
        t,
        loop=loop,
        places=[t.places[i] for i in keep],
        first=of([t.first[i] for i in keep]),
        after=moved([after[i] for i in keep]),
        measures={m: moved(of(v)) for m, v in t.measures.items()},
        errors=moved(of(t.errors)),
        lines={place[i]: name for i, name in t.lines.items() if i in place},
    )


def _is_input(e):
    return isinstance(e, Ref) and e.name == "e"


def _renamed(s, place):
    """A statement with the entries of e by their new numbers."""

    def new(e):
        return Ref("e", place[e.index]) if _is_input(e) else e

    if isinstance(s, Define):
        return s._replace(args=tuple(map(new, s.args)))
    if isinstance(s, Array):
        return s._replace(entries=tuple(map(new, s.entries)))
    if hasattr(s, "value"):
        return s._replace(value=new(s.value), index=new(s.index))
    if hasattr(s, "carried"):
        return s._replace(
            carried=tuple((k, n, new(start)) for k, n, start in s.carried),
            body=[_renamed(one, place) for one in s.body],
            new=tuple(map(new, s.new)),
        )
    return s


def pruned(
    statements: list[Statement], known: dict[Ref, Any]
) -> tuple[list[Statement], dict[Ref, Any]]:
    """Return statements with known values put in, and every value that is known then."""
    known, kept, arrays = dict(known), [], {}
    for s in statements:
        if isinstance(s, Define):
            args = tuple(known.get(a, a) for a in s.args)
            short = simplified(s.op, args)
            if short is None:
                kept.append(s._replace(args=args))
            else:
                known[Ref(s.name)] = short
        elif isinstance(s, Array):
            arrays[s.name] = entries = tuple(known.get(a, a) for a in s.entries)
            kept.append(s._replace(entries=entries))
        elif isinstance(s, Matrix) and s.op in LINEAR and _is_nothing(arrays.get(s.operands[-1])):
            for i in range(s.sizes[0] * s.sizes[-1]):
                known[Ref(s.name, i)] = 0.0
        else:
            kept.append(_put_in(s, known))
    return kept, known


def _is_nothing(entries):
    return entries is not None and all(is_number(e) and e == 0 for e in entries)


def _put_in(s, known):
    """A statement of another kind, with known values put in."""
    if hasattr(s, "value"):
        return s._replace(value=known.get(s.value, s.value), index=known.get(s.index, s.index))
    if hasattr(s, "carried"):
        carried = tuple((k, n, known.get(start, start)) for k, n, start in s.carried)
        body = [_put_in(one, known) for one in s.body]
        return s._replace(carried=carried, body=body, new=tuple(known.get(e, e) for e in s.new))
    if isinstance(s, Define):
        return s._replace(args=tuple(known.get(a, a) for a in s.args))
    if isinstance(s, Array):
        return s._replace(entries=tuple(known.get(a, a) for a in s.entries))
    return s

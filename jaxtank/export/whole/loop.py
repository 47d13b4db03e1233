"""One sample of the whole closed loop as statements, with every number of the loop as an input.

References, disturbances, sensor, observer, controller, safety filter, pumps, plant, overflow and
measures: the functions that are simulated, traced.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank import measures as ms
from jaxtank.analysis.elimination import rolled
from jaxtank.case import Case
from jaxtank.core.clock import Chunk, is_pointwise
from jaxtank.core.errors import InputError
from jaxtank.core.tree import parameters, with_values
from jaxtank.export.lowering import lower_all
from jaxtank.export.statements import Statement
from jaxtank.export.whole.arrays import ArrayWriter
from jaxtank.loop.closed_loop import initial, inputs_at, run_of, zero_of
from jaxtank.loop.step import step

SAVED = ("x", "y", "r", "u", "command", "spilled", "d_hat")
"""What is kept of a sample: fields of a Trajectory."""


LARGEST = 24
"""Tanks of a loop that is written as code."""


@dataclasses.dataclass(frozen=True)
class WholeLoop:
    """The statements of one sample, in order, and what they lead to."""

    case: Case
    leaves: tuple[tuple[str, tuple[int, ...]], ...]
    """(dotted name, index in it) of each entry of p."""
    statements: list[Statement]
    first: list[Any]
    """Entries of c before the first sample."""
    after: list[Any]
    """Entries of c after a sample."""
    saved: dict[str, list[Any]]
    """{field of `SAVED`: its entries at a sample}."""
    measures: dict[str, list[Any]]
    """{measure: its entries}, read of c after the last sample."""
    functions: dict[str, str]
    """{name of a function on arrays that statements call: its text}."""
    lines: dict[int, str]
    """{entry of c at which a Line begins: its name}."""


def traced_leaves(case: Case, largest: int = 64) -> dict[str, np.ndarray]:
    """Return {dotted name: value} of the numbers of a loop that are inputs of its statements."""
    found = {n: np.asarray(v, dtype=float) for n, v in parameters(case.loop).items()}
    return {n: v for n, v in found.items() if 0 < v.size <= largest}


def served(case: Case) -> tuple[str, ...]:
    """Return the names of the measures that mean something for a case, those of times included."""
    return (*(m for m in ms.reported() if ms.serves(m, case.loop)), *ms.times())


def sample_of(case: Case, names: Sequence[str], squares: Sequence[tuple[str, float]] = ()) -> Any:
    """Return the function (p, k, c, n) -> (c before the first sample, c after this one, saved,
    measures, residuals) of a case.
    """
    clock, names = case.clock, tuple(names)

    def whole(p: Any, k: Any, c: Any, n: Any) -> Any:
        loop = with_values(case.loop, p)
        state, acc, spilled = c
        state = state._replace(k=k)
        noisy = np.ndim(loop.sensor.noise) > 0
        xi = tuple(v[None] for v in n) if noisy else None
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
        found = ms.read(run, acc, names)
        return before, (after._replace(k=()), update, total), saved, found, errors

    return whole


def whole_loop(case: Case, names: Sequence[str] | None = None) -> WholeLoop:
    """Return the WholeLoop of a case with the measures `names`; None: all that it serves."""
    check_pointwise(case)
    names = served(case) if names is None else tuple(names)
    whole, shapes = sample_of(case, names), arguments(case, names)
    writer = ArrayWriter()
    with rolled():
        made = lower_all(whole, shapes, writer)
    before, after, saved, found, _ = made.outputs
    return WholeLoop(
        case=case,
        leaves=entries_of(shapes["p"]),
        statements=made.statements,
        first=flat(before),
        after=flat(after),
        saved={f: flat(saved[f]) for f in SAVED},
        measures={m: flat(found[m]) for m in names},
        functions=writer.functions,
        lines={start.index: name for start, name in made.lines.items()},
    )


def check_pointwise(case: Case) -> None:
    """Raise InputError for a loop whose signals do not follow from their times alone, and for one
    of too many tanks: their code, a statement for each number, takes minutes to write.
    """
    if case.loop.plant.tanks > LARGEST:
        raise InputError(
            f"{case.name}: its rig has {case.loop.plant.tanks} tanks: a loop as code may have at"
            f" most {LARGEST}"
        )
    if not is_pointwise(case.loop):
        raise InputError(
            f"{case.name}: its signals are recorded samples, or its controller looks ahead; its"
            " loop has no code of single samples"
        )


def arguments(case: Case, names: Sequence[str]) -> dict[str, Any]:
    """Return {name: shapes and types} of the arguments of `sample_of`, with measures `names`."""
    real = jnp.result_type(float)
    return {
        "p": {n: jax.ShapeDtypeStruct(v.shape, real) for n, v in traced_leaves(case).items()},
        "k": jax.ShapeDtypeStruct((), jnp.int32),
        "c": carried(case, names),
        "n": (jax.ShapeDtypeStruct((), real),) * case.loop.plant.tanks,
    }


def entries_of(shapes: dict[str, Any]) -> tuple[tuple[str, tuple[int, ...]], ...]:
    """Return (dotted name, index in it) of each entry of arrays, in the order of an argument."""
    return tuple((name, i) for name in sorted(shapes) for i in np.ndindex(shapes[name].shape))


def carried(case: Case, names: Sequence[str]) -> Any:
    """Return the shapes and types of what one sample hands to the next, with measures `names`."""

    def start() -> Any:
        run = run_of(case.loop, case.clock)
        state = initial(case.loop, case.clock)._replace(k=())
        zero = (zero_of(case.loop),) * case.loop.plant.tanks
        return state, ms.start(run, names), zero

    return jax.eval_shape(start)


def flat(tree: Any) -> list[Any]:
    """Return the entries of all arrays of a tree."""
    return [e for array in jax.tree.leaves(tree) for e in np.ravel(array)]

"""A run that keeps every so many samples and its measures, in one pass over the samples.

For studies that draw many runs and report their measures too: half of the work of two runs. May
import `loop.closed_loop`, `loop.step` and the folders below `jaxtank.loop`.
"""
# jax leaves the types of zeros, eval_shape, flatten and others partly open.
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxtank import measures as ms
from jaxtank.core.clock import Clock
from jaxtank.core.vectors import is_array
from jaxtank.loop.closed_loop import (
    ClosedLoop,
    initial,
    inputs,
    is_broken,
    keyed,
    run_of,
    takes_arrays,
)
from jaxtank.loop.step import step
from jaxtank.xla.hoist import scan
from jaxtank.xla.jit import compiled


class Rows(NamedTuple):
    """The saved samples of a run: arrays with one row each."""

    t: Any  # (rows,) [s]
    x: Any  # (rows, tanks) levels [unit of length]
    r: Any  # (rows, outputs) setpoints [unit of length]
    u: Any  # (rows, pumps) inputs [unit of the pumps]


@compiled("clock", "save_every", "names")
def rows_and_measures(
    loop: ClosedLoop, clock: Clock, key: jax.Array | None, save_every: int, names: tuple[str, ...]
) -> tuple[Rows, dict[str, jax.Array], jax.Array]:
    """Return (Rows, {measure: value}, True if the run diverged), unchecked."""
    # The rows are those of `simulate`, the measures those of `evaluate`; functions of the user's
    # and stability margins are not among them.
    loop, arrays = keyed(loop, key), takes_arrays(loop)
    run: Any = run_of(loop, clock, arrays)
    xs: Any = inputs(loop, clock, names, key, arrays=arrays)
    whole, remainder = divmod(clock.samples, save_every)

    def one(carry: Any, now: Any) -> Any:
        state, acc = carry
        state, sample = step(loop, clock, state, now)
        return (state, ms.update(run, acc, sample, now.context)), sample

    def unsaved(carry: Any, now: Any) -> Any:
        return one(carry, now)[0], None

    def row(carry: Any, now: Any) -> Any:
        carry, sample = one(carry, _cut(now, 0))
        count = jax.tree.leaves(now)[0].shape[0] - 1
        if count:
            carry = scan(unsaved, carry, _cut(now, slice(1, None)), length=count)[0]
        return carry, Rows(t=sample.t, x=sample.x, r=sample.r, u=sample.u)

    def in_rows(a: Any) -> Any:
        return a[: whole * save_every].reshape(whole, save_every, *a.shape[1:])

    carry: Any = (initial(loop, clock, arrays), ms.start(run, names))
    carry, saved = scan(row, carry, jax.tree.map(in_rows, xs), length=whole)
    saved = jax.tree.map(jnp.asarray, saved)
    if remainder:
        carry, last = row(carry, _cut(xs, slice(whole * save_every, None)))
        saved = jax.tree.map(_appended, saved, last)
    columns = {name: _column(getattr(saved, name)) for name in Rows._fields}
    return Rows(**columns), ms.read(run, carry[1], names), is_broken(carry[0])


def _cut(tree: Any, where: Any) -> Any:
    """The entries `where` of every array of a tree."""

    def entries(a: Any) -> Any:
        return a[where]

    return jax.tree.map(entries, tree)


def _appended(rows: Any, last: Any) -> Any:
    return jnp.concatenate([rows, jnp.asarray(last)[None]])


def _column(value: Any) -> Any:
    """(rows, n) of a tuple of n arrays; an array as it is."""
    return value if is_array(value) else jnp.stack(value, axis=-1)

"""A run that keeps every so many samples, compiled, for `simulate` and functions of a run."""
# pyright: reportUnknownMemberType=false, reportUnknownLambdaType=false
# pyright: reportUnknownArgumentType=false

import operator
from typing import Any, cast

import jax
import jax.numpy as jnp

from jaxtank.core.clock import Clock
from jaxtank.core.labels import Labels
from jaxtank.core.tree import describe
from jaxtank.core.vectors import each, is_array, zeros
from jaxtank.loop.closed_loop import (
    ClosedLoop,
    initial,
    inputs,
    is_broken,
    keyed,
    takes_arrays,
    zero_of,
)
from jaxtank.loop.step import step
from jaxtank.loop.trajectory import COLUMNS, Trajectory
from jaxtank.xla.hoist import scan
from jaxtank.xla.jit import compiled


@compiled("clock", "save_every", "checkpoint", keep=True)
def simulate_compiled(
    loop: ClosedLoop, clock: Clock, key: jax.Array | None, save_every: int, checkpoint: bool = False
) -> tuple[Trajectory, jax.Array]:
    """Return (Trajectory, True if the run diverged), unchecked."""
    loop, arrays = keyed(loop, key), takes_arrays(loop)
    rows = (clock.samples - 1) // save_every + 1
    spare = rows * save_every - clock.samples  # steps after the last row: run, but not kept

    def in_rows(a: Any) -> Any:
        ends = [(0, max(spare, 0)), *[(0, 0)] * (a.ndim - 1)]
        padded = jnp.pad(a, ends, mode="edge")
        return padded[: rows * save_every].reshape(rows, save_every, *a.shape[1:])

    def next_sample(carry: Any, now: Any) -> Any:
        state, spilled = carry
        state, sample = step(loop, clock, state, now)
        return (state, each(operator.add, spilled, sample.spilled)), sample

    def unsaved(carry: Any, now: Any) -> Any:
        return next_sample(carry, now)[0], None

    def row(carry: Any, now: Any) -> Any:
        spilled = carry[1]
        carry, sample = next_sample(carry, jax.tree.map(lambda a: a[0], now))
        if save_every > 1:
            others = jax.tree.map(lambda a: a[1:], now)
            carry = scan(unsaved, carry, others, length=save_every - 1)[0]
        return carry, sample._replace(spilled=spilled)

    zero = zero_of(loop)
    xs = jax.tree.map(in_rows, inputs(loop, clock, (), key, arrays=arrays))
    first = initial(loop, clock, arrays)
    start = (first, zeros(first.x) if arrays else (zero,) * loop.plant.tanks)
    row_of = cast(Any, jax.checkpoint)(row) if checkpoint else row
    (state, _), saved = scan(row_of, start, xs, length=rows)
    columns: dict[str, Any] = {}
    for name in COLUMNS:
        value: Any = getattr(saved, name)
        columns[name] = value if is_array(value) else jnp.stack(value, axis=-1)
    shares = loop.controller.shares(*(tuple(columns[name].T) for name in ("x_hat", "r")))
    share = None if shares is None else jnp.stack(shares, axis=-1)
    names = loop.observer.mode_names(loop.plant)
    modes = saved.modes if names else None
    columns |= {"share": share, "modes": modes, "mode_names": names}
    run = Trajectory(**columns, units=loop.units, labels=Labels.of(loop.plant))
    if drifting := loop.observer.coefficients:
        meta = [describe(loop.observer.model, name) for name in drifting]
        run = run.replace(
            coefficients=jnp.stack(saved.coefficients, axis=-1),
            coefficient_names=tuple((n, m["unit"]) for n, m in zip(drifting, meta)),
        )
    return run, is_broken(state)

"""Running measures of one loop at many values, in batches that fit the cache, or in a kernel."""
# jax leaves the types of its trees partly open.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false, reportUnknownLambdaType=false

from collections.abc import Mapping, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike

from jaxtank import measures as ms
from jaxtank.core.checks import check_value
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.core.text import shortened
from jaxtank.core.tree import describe, get_value, with_values
from jaxtank.loop.closed_loop import ClosedLoop, initial, inputs, is_broken, run_of, takes_arrays
from jaxtank.loop.run import BATCH, evaluate_and_flag
from jaxtank.loop.step import step
from jaxtank.loop.validation import check
from jaxtank.xla.jit import compiled
from jaxtank.xla.kernel import Unfit, looped
from jaxtank.xla.reachability import reached


def evaluate_many(
    loop: ClosedLoop,
    clock: Clock,
    measures: Sequence[str],
    values: Mapping[str, ArrayLike],
    key: jax.Array | None = None,
    *,
    batch: int = BATCH,
    kernel: bool = False,
) -> dict[str, jax.Array]:
    """Run the loop at N sets of values and keep only running measures.

    The values of `jax.vmap` of `evaluate`, in batches: memory and the time of each run do not
    depend on N, with derivatives too. It can be differentiated, and called inside `jax.jit`.

    Parameters
    ----------
    loop : ClosedLoop
    clock : Clock
    measures : sequence of str
        Names of `jaxtank.measures.MEASURES`.
    values : {dotted name: (N, ...) array}
        What differs from run to run, in the units of its leaf.
    key : jax random key, optional
        For the sensor noise; run i has that of jax.random.fold_in(key, i).
    batch : int
        Runs side by side; in a kernel a power of 2.
    kernel : bool
        Run the samples in one Pallas kernel, for a GPU: a loop without a launch for each step. It
        has no noise, no derivatives, and setpoints that are the same in all runs. Without a GPU it
        is interpreted, which is slow and for tests.

    Returns
    -------
    {name: (N, ...) array}
        NaN for a run that diverges.

    Raises
    ------
    InputError
        For invalid input; with `kernel` for what it cannot run.

    Examples
    --------
    >>> import numpy as np
    >>> import jaxtank
    >>> loop = jaxtank.presets.load("cascaded/pi").loop
    >>> clock = jaxtank.Clock(dt=4.0, duration=40.0)
    >>> gains = {"controller.Kc": np.linspace(0.5, 2.0, 5)[:, None]}
    >>> jaxtank.evaluate_many(loop, clock, ["max_level"], gains)["max_level"].shape
    (5, 2)
    """
    names = (measures,) if isinstance(measures, str) else tuple(measures)
    ms.check_names(names)
    rows = _rows(values)
    count = _count(loop, rows, batch)
    check(with_values(loop, {n: v[0] for n, v in rows.items()}), clock, key)
    if kernel:
        if batch & (batch - 1):
            raise InputError(f"batch = {batch}: must be a power of 2 runs in a kernel")
        return _in_kernel(loop, clock, names, rows, key, batch)
    return _mapped(loop, rows, key, clock, names, min(batch, count))


def _rows(values: Any) -> dict[str, jax.Array]:
    """`values` as arrays; raises InputError for what is none."""
    if not isinstance(values, Mapping) or not values:
        raise InputError(
            "values: must be {parameter: array with a row for each run}, of one parameter at least"
        )
    rows: dict[str, jax.Array] = {}
    for name, value in values.items():
        try:
            rows[str(name)] = jnp.asarray(value, dtype=float)
        except (TypeError, ValueError) as error:
            raise InputError(
                f"{name} = {shortened(value)}: must be an array of numbers, a row for each run"
            ) from error
    return rows


def _count(loop: ClosedLoop, rows: Mapping[str, jax.Array], batch: Any) -> int:
    """The number of runs; raises InputError for rows of several lengths, shapes or out of range."""
    if not isinstance(batch, int) or isinstance(batch, bool) or batch < 1:
        raise InputError(f"batch = {batch!r}: must be a whole number of at least 1 run")
    for name, value in rows.items():
        shape = np.shape(get_value(loop, name))
        if value.ndim < 1 or value.shape[1:] != shape or not value.shape[0]:
            raise InputError(
                f"{name} has shape {value.shape}: must be {('N', *shape)}, a row for each of N runs"
            )
        if not isinstance(value, Tracer):
            check_value(name, np.asarray(value), describe(loop, name))
    counts = {name: value.shape[0] for name, value in rows.items()}
    if len(set(counts.values())) > 1:
        found = ", ".join(f"{n} of {name}" for name, n in counts.items())
        raise InputError(f"values have rows for different numbers of runs: {found}")
    return next(iter(counts.values()))


@compiled("clock", "names", "batch", keep=True)
def _mapped(
    loop: ClosedLoop,
    rows: dict[str, jax.Array],
    key: jax.Array | None,
    clock: Clock,
    names: tuple[str, ...],
    batch: int,
) -> dict[str, jax.Array]:
    def one(row: Any) -> Any:
        index, values = row
        noise = None if key is None else jax.random.fold_in(key, index)
        return evaluate_and_flag(with_values(loop, values), clock, names, noise)[0]

    count = next(iter(rows.values())).shape[0]
    return cast(Any, jax.lax.map(one, (jnp.arange(count), rows), batch_size=batch))


def _in_kernel(
    loop: ClosedLoop,
    clock: Clock,
    names: tuple[str, ...],
    rows: Mapping[str, jax.Array],
    key: jax.Array | None,
    block: int,
) -> dict[str, jax.Array]:
    """The same of checked rows, `block` runs to a program of a kernel."""
    arrays = takes_arrays(loop)
    _check_kernel(loop, clock, names, rows, key, arrays)
    xs = inputs(loop, clock, names, None, None, clock.samples, arrays)

    def begin(row: Any) -> Any:
        here = with_values(loop, row)
        return initial(here, clock, arrays), ms.start(run_of(here, clock, arrays), names)

    def advance(row: Any, carry: Any, now: Any) -> Any:
        here, (state, sums) = with_values(loop, row), carry
        state, sample = step(here, clock, state, now)
        return state, ms.update(run_of(here, clock, arrays), sums, sample, now.context)

    def finish(row: Any, carry: Any) -> Any:
        state, sums = carry
        found = ms.read(run_of(with_values(loop, row), clock, arrays), sums, names)
        return jax.tree.map(lambda v: jnp.where(is_broken(state), jnp.nan, v), found)

    count = next(iter(rows.values())).shape[0]
    index = np.minimum(np.arange(-(-count // block) * block), count - 1)  # the last one repeated
    padded = {name: v[index] for name, v in rows.items()}
    start = jax.vmap(begin)(padded)
    try:
        ended = looped(jax.vmap(advance, in_axes=(0, 0, None)), padded, start, xs, block)
    except Unfit as error:
        raise InputError(
            "kernel: a step of this loop has arrays (a quadratic programme, a Kalman filter, ten"
            " tanks or more), which a kernel of single numbers cannot hold: kernel=False"
        ) from error
    found: Any = jax.vmap(finish)(padded, ended)
    return jax.tree.map(lambda v: v[:count], found)


def _check_kernel(
    loop: ClosedLoop, clock: Clock, names: Any, rows: Any, key: Any, arrays: bool
) -> None:
    """Raise InputError for what the kernel cannot run."""
    beyond = [n for n in names if ms.MEASURES[n].linear or n in ms.functions(names)]
    if beyond:
        raise InputError(
            f"kernel: {beyond[0]} is no running measure; leave it out, or kernel=False"
        )
    if key is not None:
        raise InputError("kernel: it has no noise: leave key out, or kernel=False")
    short = Clock(dt=clock.dt, duration=clock.dt, substeps=clock.substeps)
    for name, value in rows.items():

        def prepared(v: Any, name: str = name) -> Any:
            here = with_values(loop, {name: v})
            return jax.tree.leaves(inputs(here, short, names, None, None, short.samples, arrays))

        if any(reached(prepared, value[0])):
            raise InputError(
                f"kernel: setpoints, or what the controller prepares from them, depend on {name},"
                " and must be the same in all runs; leave it out, or kernel=False"
            )

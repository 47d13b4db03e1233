"""Running measures of one loop at many values, in batches that fit the cache."""
# pyright: reportUnknownMemberType=false

from collections.abc import Mapping, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike

from jaxtank import measures as ms
from jaxtank.core.checks import check_value, check_whole
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.core.text import shortened
from jaxtank.core.tree import describe, get_value, with_values
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.loop.of_case import check_is_values, takes_case
from jaxtank.loop.run import BATCH, evaluate_and_flag
from jaxtank.loop.validation import check
from jaxtank.xla.jit import compiled


@takes_case
def evaluate_many(
    loop: ClosedLoop,
    clock: Clock,
    measures: Sequence[str],
    values: Mapping[str, ArrayLike],
    key: jax.Array | None = None,
    *,
    batch: int = BATCH,
) -> dict[str, jax.Array]:
    """Run the loop at N sets of values and keep only running measures.

    The values of `jax.vmap` of `evaluate`, in batches: memory and the time of each run do not
    depend on N, with derivatives too. It can be differentiated, and called inside `jax.jit`.

    Parameters
    ----------
    loop : ClosedLoop; or a Case, whose clock is then used
    clock : Clock; none after a Case
    measures : sequence of str
        Names of `jaxtank.measures.MEASURES`.
    values : {dotted name: (N, ...) array}
        What differs from run to run, in the units of its leaf.
    key : jax random key, optional
        For the sensor noise; run i uses jax.random.fold_in(key, i).
    batch : int
        Runs side by side.

    Returns
    -------
    {name: (N, ...) array}
        NaN for a run that diverges.

    Raises
    ------
    InputError
        For invalid input.

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
    check_is_values(values)
    names = (measures,) if isinstance(measures, str) else tuple(measures)
    ms.check_names(names)
    rows = _rows(values)
    count = _count(loop, rows, batch)
    check(with_values(loop, {n: v[0] for n, v in rows.items()}), clock, key)
    return _mapped(loop, rows, key, clock, names, min(batch, count))


def _rows(values: Mapping[str, Any]) -> dict[str, jax.Array]:
    """`values` as arrays; raises InputError for what is none."""
    if not values:
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
    check_whole("batch", batch, 1)
    for name, value in rows.items():
        shape = np.shape(get_value(loop, name))
        if value.ndim < 1 or value.shape[1:] != shape or not value.shape[0]:
            raise InputError(
                f"{name} has shape {value.shape}: must be {('N', *shape)}, a row for each of N runs"
            )
        if not isinstance(value, Tracer):
            check_value(name, np.asarray(value), describe(loop, name))
    if len({len(value) for value in rows.values()}) > 1:
        lengths = ", ".join(f"{len(value)} of {name}" for name, value in rows.items())
        raise InputError(f"values have rows for different numbers of runs: {lengths}")
    return len(next(iter(rows.values())))


@compiled("clock", "names", "batch", keep=True)
def _mapped(
    loop: ClosedLoop,
    rows: dict[str, jax.Array],
    key: jax.Array | None,
    clock: Clock,
    names: tuple[str, ...],
    batch: int,
) -> dict[str, jax.Array]:
    def run_row(row: Any) -> Any:
        index, values = row
        noise = None if key is None else jax.random.fold_in(key, index)
        return evaluate_and_flag(with_values(loop, values), clock, names, noise)[0]

    count = next(iter(rows.values())).shape[0]
    return cast(Any, jax.lax.map(run_row, (jnp.arange(count), rows), batch_size=batch))

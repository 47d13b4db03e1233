"""Runs of a case on drawn plants and on the nominal one, side by side in one program."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxtank.case import Case
from jaxtank.core.tree import get_value
from jaxtank.loop import run as lp
from tuning.problem.scenarios import noisy
from tuning.uncertainty.batches import batch_size, run_batch
from tuning.uncertainty.draws import Draws
from tuning.uncertainty.sampling import Points

LANES = 8
"""Runs in a batch are a multiple of this: numbers in a vector register."""

NOISE = "sensor.noise"


class PlantRuns(NamedTuple):
    """Measures of N drawn plants, and of the nominal one."""

    values: Mapping[str, Any]  # {parameter: (N, ...)} as drawn
    measures: dict[str, np.ndarray[Any, Any]]  # {name: (N, ...)}
    failed: np.ndarray[Any, Any]  # (N,) True where the run diverged
    # {name: value} of the nominal plant without noise; None where it diverged, or was not run
    nominal: dict[str, np.ndarray[Any, Any]] | None


def run_plants(
    case: Case,
    distributions: Mapping[str, Any],
    samples: int,
    seed: int,
    names: Sequence[str],
    quiet: bool = False,
) -> PlantRuns:
    """Run a case on `samples` drawn plants with the noise of its sensors."""
    space = Draws(case.loop, distributions)
    random = noisy(case) or any(n.startswith(NOISE) for n in space.labels)
    lp.check(case.loop, case.clock, jax.random.key(0) if random else None)
    drawn = space.values(Points("random", space.dimensions, samples, seed).rows(0, samples))
    last = _nominal(case, drawn) if quiet else None
    count = samples + (last is not None)
    size = _batch(batch_size(case, random, count), count)
    rows = np.minimum(np.arange(-(-count // size) * size), count - 1)  # the last one repeated
    values = dict(drawn) if last is None else _with_row(drawn, last, case)
    numbers, key = np.arange(len(rows)), seed if random else None
    batches: list[Any] = []
    for one in np.split(numbers, len(rows) // size):
        here = {n: np.asarray(v)[rows[one]] for n, v in values.items()}
        batches.append(run_batch(case, tuple(names), key, here, one))
    found = {n: np.concatenate([b[n] for b in batches]) for n in batches[0]}
    failed, own = found.pop("failed") > 0, None
    if last is not None and not failed[samples]:
        own = {n: v[samples] for n, v in found.items()}
    return PlantRuns(drawn, {n: v[:samples] for n, v in found.items()}, failed[:samples], own)


def _batch(most: int, count: int) -> int:
    """Runs in a batch: the multiple of LANES with the fewest runs in vain, between a half of `most`
    and an eighth above it.
    """
    if most < LANES:
        return most
    sizes = range(max(LANES, most // 2), most + most // 8 + 1, LANES)
    return min(sizes, key=lambda size: (-(-count // size) * size, -size))


def _nominal(case: Case, drawn: Mapping[str, Any]) -> dict[str, Any] | None:
    """{name: value} of the nominal plant without noise; None where the noise is drawn by entries,
    or the sensor has none.
    """
    entries = any(n.startswith(f"{NOISE}[") for n in drawn)
    if entries or np.ndim(case.loop.sensor.noise) == 0:
        return None
    own = {n: np.asarray(get_value(case.loop, n), dtype=float) for n in drawn}
    return own | {NOISE: np.zeros(np.shape(case.loop.sensor.noise))}


def _with_row(drawn: Mapping[str, Any], last: Mapping[str, Any], case: Case) -> dict[str, Any]:
    """{name: (N + 1, ...)} of the drawn values and those of the last run."""
    count = len(next(iter(drawn.values())))
    noise = np.asarray(case.loop.sensor.noise, dtype=float)
    every = {NOISE: np.broadcast_to(noise, (count, *noise.shape))} | dict(drawn)
    return {n: np.concatenate([np.asarray(v), last[n][None]]) for n, v in every.items()}

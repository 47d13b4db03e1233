"""The same loop over many draws of what is uncertain: fixed-size batches, running measures only, on
one device or many.
"""

import dataclasses
import functools
import math
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank import measures as ms
from jaxtank.analysis.steady_state import steady_flows
from jaxtank.case import Case
from jaxtank.core.errors import InputError
from jaxtank.core.tree import with_values
from jaxtank.loop import run as lp
from jaxtank.xla.flags import WIDE
from tuning.problem.limits import resolve_limits
from tuning.problem.scenarios import noisy
from tuning.storage.batch_store import BatchStore
from tuning.storage.checkpoint import checkpoint_folder
from tuning.storage.fingerprint import fingerprint
from tuning.uncertainty import manifest as shards
from tuning.uncertainty.distributions import Draws, stated
from tuning.uncertainty.sampling import clopper_pearson, probabilities, spread_of

LANES = 256
"""Draws in a batch, on each device: enough to fill the vector units, few enough for the cache."""

NOISE = 1 << 27
"""Bytes of sensor noise that a batch may hold: long noisy runs have smaller batches."""

TAIL = 0.05
"""Share of the draws that the conditional value at risk is the mean of [-]."""

RESTS = 1 << 14
"""Draws whose steady states are looked for at once: a plateau takes some 100 bytes a draw."""

FAN_DRAWS, FAN_ROWS = 512, 240
"""Draws and time stamps of a fan chart."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ensemble:
    """What `ensemble` gives: N draws and what each came to.

    values: {name: (N, ...)} drawn parameters; measures: {name: (N, ...)}; failed: (N,) True where
    the run left the numbers; infeasible: (N,) True where some plateau of the reference has no
    steady state below the rims and within the pumps' limits, None where that is not known in closed
    form; fan: {"t", "r", "x", "u": quantiles (5, rows, ...)} of the first draws, or None.
    """

    case: Any
    distributions: dict
    labels: list
    values: dict
    measures: dict
    failed: np.ndarray
    infeasible: np.ndarray | None
    limits: list
    fan: dict | None
    wall_s: float
    seed: int
    method: str

    @property
    def samples(self) -> int:
        """Number of draws N."""
        return len(self.failed)

    def summary(self) -> dict[str, Any]:
        """{measure: {mean, mean_interval95, sd, p05, p50, p95, cvar95, max}} over the draws whose
        run is finite; one entry per output, tank or pump where the measure has several. cvar95 is
        of the worse side: the lower one for a level's minimum. sd and the mean's interval, which is
        cut at what the measure cannot pass, are None for a single draw.
        """
        found = {}
        for name, values in self.measures.items():
            kept = values[~self.failed]
            sign = ms.MEASURES[name].sense
            if not len(kept):
                found[name] = {
                    k: None
                    for k in ("mean", "mean_interval95", "sd", "p05", "p50", "p95", "cvar95", "max")
                }
                continue
            with np.errstate(invalid="ignore"):
                worst = sign * np.sort(sign * kept, axis=0)[-max(1, math.ceil(TAIL * len(kept))) :]
                mean, sd = (
                    kept.mean(axis=0),
                    (kept.std(axis=0, ddof=1) if len(kept) > 1 else np.zeros(kept.shape[1:])),
                )
                p05, p50, p95 = np.quantile(kept, (0.05, 0.5, 0.95), axis=0, method="inverted_cdf")
                half = 1.959964 * sd / math.sqrt(len(kept))
                found[name] = {
                    "mean": mean,
                    "mean_interval95": [
                        _within(name, kept, end) for end in (mean - half, mean + half)
                    ],
                    "sd": sd,
                    "p05": p05,
                    "p50": p50,
                    "p95": p95,
                    "cvar95": worst.mean(axis=0),
                    "max": kept.max(axis=0),
                }
                if len(kept) == 1:
                    found[name] |= {"sd": None, "mean_interval95": None}
        return found

    def violations(self) -> list[dict[str, Any]]:
        """[{name, limit, count, probability, interval95}]: how often each limit is broken; a run
        that failed counts as breaking it. The intervals are those of Clopper and Pearson.
        """
        rows = []
        for limit in self.limits:
            values = self.measures[limit.measure].reshape(self.samples, -1)[:, limit.index]
            broken = int(np.sum(self.failed | (limit.margins(values) < 0)))
            rows.append(
                {
                    "name": limit.label,
                    "limit": limit.value,
                    "unit": ms.unit(limit.measure, self.case.loop.units),
                    "count": broken,
                    "probability": broken / self.samples,
                    "interval95": clopper_pearson(broken, self.samples),
                }
            )
        return rows

    def to_json(self) -> dict[str, Any]:
        """The JSON object of `jaxtank uncertainty --json`."""
        from tuning.report.uncertainty import json_of

        return json_of(self)

    def plot(self):
        """Matplotlib figures {name: figure}: fan of the levels, violations, rig."""
        from tuning.report.uncertainty import figures

        return figures(self)

    def save(self, folder: str | Path, command: str | None = None) -> list[Path]:
        """Write result.json, draws.csv, the pictures and report.html, which says the line
        `command`, to a folder.
        """
        from tuning.report.uncertainty import save

        return save(self, folder, command)

    def __repr__(self):
        from tuning.report.uncertainty import text

        return text(self)


def _within(name, values, end):
    """`end` of an interval of measure `name`, moved to what the measure cannot pass (a share 0 and
    1, say); values: (N, ...) that it had.
    """
    low, high = ms.MEASURES[name].low, ms.MEASURES[name].high
    end = (
        end if low is None else np.maximum(end, np.minimum(low, values.min(axis=0)))
    )  # a value that did pass it is not argued with
    return end if high is None else np.minimum(end, np.maximum(high, values.max(axis=0)))


def ensemble(
    case: Case,
    distributions: Mapping[str, Any] | None = None,
    samples: int = 1000,
    key: int = 0,
    *,
    draws: str = "random",
    measures: Sequence[str] | None = None,
    limits: Mapping[str, Any] | None = None,
    fan: bool = True,
    lanes: int | None = None,
    devices: int = 1,
    shard: tuple[int, int] | None = None,
    folder: str | Path | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    merge: bool = False,
    progress: Callable | None = None,
) -> Ensemble | None:
    """Run a case on `samples` draws of what is uncertain.

    distributions: {dotted name: distribution, or a share as in a case's `uncertain`}, the case's
    own where None; key: seed of draws and sensor noise (draw i has the noise of fold_in(key, i),
    whatever the layout); draws: "random", "latin" or "sobol"; measures: names, those of a summary
    where None; limits as in `tune`; fan: keep quantiles of the first draws' levels; lanes: draws in
    a batch;
    devices: local devices to use; shard: (i, n), run only the i-th of n shares of the batches, into
    `folder` (`merge` joins them); checkpoint (or folder): where finished batches are kept, with
    which resume=True goes on; merge: run nothing, only join what lies there, and refuse an
    incomplete set; progress: called with the number of draws done. Under `jax.distributed` every
    process runs its share of the batches and all get the whole. Numbers of a draw do not depend on
    any of it. Returns an Ensemble (None for a shard). Raises InputError before anything is run.
    """
    began, folder = time.perf_counter(), checkpoint_folder(checkpoint, folder=folder)
    if shard is not None and not (
        isinstance(shard, tuple) and len(shard) == 2 and 1 <= shard[0] <= shard[1]
    ):
        raise InputError(f"shard = {shard!r}: must be (i, n), i from 1 to n")
    for name, value in (("samples", samples), ("key", key)):
        if (
            isinstance(value, bool)
            or not isinstance(value, int)
            or not (0 if name == "key" else 1) <= value <= 2**31 - 1
        ):
            raise InputError(
                f"{name} = {value!r}: must be a whole number from {0 if name == 'key' else 1} to"
                f" {2**31 - 1}"
            )
    distributions = spread_of(case) if distributions is None else stated(distributions)
    space = Draws(case.loop, distributions)
    held = resolve_limits(case, limits)
    wanted = (
        tuple(m for m in ms.placed("summary") if ms.serves(m, case.loop))
        if measures is None
        else tuple(measures)
    )
    ms.check_names(wanted)
    wanted = tuple(dict.fromkeys([*wanted, *(limit.measure for limit in held)]))
    random = noisy(case) or any(n.startswith("sensor.noise") for n in space.labels)
    lp.check(case.loop, case.clock, jax.random.key(0) if random else None)
    check_devices(devices)
    lanes = lanes or _lanes(case, random, samples)
    p = probabilities(draws, space.dimensions, samples, key)
    count = -(-samples // lanes)
    store: Any = None
    if folder is not None:
        what = fingerprint(
            case,
            distributions=shards.to_json(distributions),
            samples=samples,
            key=key,
            draws=draws,
            measures=wanted,
            lanes=lanes,
        )
        store = BatchStore(
            folder,
            what,
            shards.notes(case, case.limits if limits is None else limits),
            resume=resume,
            shared=shard is not None or jax.process_count() > 1,
            begin=not merge,
        )
    mine = [k for k in range(count) if shard is None or k % shard[1] == shard[0] - 1]
    mine = [k for k in mine if k % jax.process_count() == jax.process_index()]
    todo = [k for k in mine if store is None or not store.has(k)]
    if merge and todo:
        raise InputError(
            f"merge: {len(todo)} of {count} batches are missing in {str(folder)!r}, the first of"
            f" them number {todo[0]}"
        )
    run = _Runner(case, wanted, key if random else None, devices)
    batches = {}
    for group in (todo[i : i + devices] for i in range(0, len(todo), devices)):
        indices = [np.arange(k * lanes, (k + 1) * lanes) for k in group]
        found = run([_rows(space, p, i) for i in indices], indices)
        for k, batch in zip(group, found):
            if store is not None:
                store.put(k, batch)
            batches[k] = batch
        if progress is not None:
            progress(min(samples, lanes * (len(mine) - len(todo) + len(batches))))
    if shard is not None:
        return None
    shapes = {
        m: (lanes,) if ms.MEASURES[m].per == "run" else (lanes, ms.entries(m, case.loop.plant))
        for m in wanted
    }
    for k in mine:
        if k not in batches:
            batches[k] = cast(Any, store).get(k, {**shapes, "failed": (lanes,)})
    if jax.process_count() > 1:
        batches = _gather(batches, count)
    whole = {
        name: np.concatenate([batches[k][name] for k in range(count)])[:samples]
        for name in batches[0]
    }
    values = space.values(p)
    return Ensemble(
        case=case,
        distributions=distributions,
        labels=space.labels,
        values=values,
        measures={m: whole[m] for m in wanted},
        failed=whole["failed"] > 0,
        infeasible=_infeasible(case, values),
        limits=held,
        fan=(
            _fan(case, {n: v[:FAN_DRAWS] for n, v in values.items()}, key if random else None)
            if fan
            else None
        ),
        wall_s=time.perf_counter() - began,
        seed=key,
        method=draws,
    )


def check_devices(devices):
    """Raise InputError unless this process has so many."""
    if isinstance(devices, bool) or not isinstance(devices, int) or devices < 1:
        raise InputError(f"devices = {devices!r}: must be a whole number of at least 1")
    if devices > jax.local_device_count():
        raise InputError(
            f"devices = {devices}: this process has {jax.local_device_count()} (jax_num_cpu_devices"
            " before jax starts)"
        )


def _lanes(case, random, samples):
    size = case.clock.samples * case.loop.plant.tanks * 8 if random else 1
    most = max(1, min(LANES, NOISE // size))
    return 1 << (min(most, max(1, samples)).bit_length() - 1)


def _rows(space, p, indices):
    """Values of the draws at `indices`, the last draw repeated past the end."""
    return space.values(p[np.minimum(indices, len(p) - 1)])


class _Runner:
    """A batch on each of `devices` at once, by the program that one device runs alone, on a thread
    of its own. One program partitioned over the devices (shard_map) rounds the last bit differently
    from the program of a single device; this does not.
    """

    def __init__(self, case, names, seed, devices):
        self.case, self.names, self.seed = case, names, seed
        self.devices = jax.local_devices()[:devices]
        self.pool = ThreadPoolExecutor(devices)

    def __call__(self, rows, indices):
        """[{measure: (lanes, ...), "failed": (lanes,)}] of batches, at most one for each device."""
        return list(self.pool.map(self._one, self.devices, rows, indices))

    def _one(self, device, rows, indices):
        values, indices = jax.device_put((rows, indices.astype(np.uint32)), device)
        found = _run(self.case.loop, values, indices, self.seed, self.case.clock, self.names)
        return {n: np.asarray(v) for n, v in found.items()}


@functools.partial(jax.jit, static_argnames=("clock", "names", "seed"), compiler_options=WIDE)
def _run(loop, values, indices, seed, clock, names):
    def one(values, index):
        noise = None if seed is None else jax.random.fold_in(jax.random.key(seed), index)
        measures, broken = lp.evaluate_and_flag(with_values(loop, values), clock, names, noise)
        return {**measures, "failed": broken.astype(jnp.result_type(float))}

    return jax.vmap(one)(values, indices)


def _gather(batches, count):
    """The batches of all processes, in order."""
    from jax.experimental import multihost_utils

    most = -(-count // jax.process_count())
    template = next(iter(batches.values()))
    padded = {
        n: np.stack([batches.get(k, template)[n] for k in _share(count, most)]) for n in template
    }
    everywhere = multihost_utils.process_allgather(padded)
    return {
        k: {n: v[k % jax.process_count(), k // jax.process_count()] for n, v in everywhere.items()}
        for k in range(count)
    }


def _share(count, most):
    return [i * jax.process_count() + jax.process_index() for i in range(most)]


def _infeasible(case, values):
    """(N,) True where a plateau of the reference has no steady state within rims and pumps; None
    where the plant has no closed form.
    """
    plant, plateaus = case.loop.plant, case.loop.reference.plateaus(case.clock.duration)
    if getattr(plant, "pipes", None) != () or plant.pumps != len(plant.outputs) or plateaus is None:
        return None
    plateaus = jnp.asarray(np.array(plateaus))
    count = len(next(iter(values.values())))
    size, found = min(count, RESTS), []
    # the last draw repeated past the end, so that every block is of one size
    for start in range(0, count, size):
        index = np.minimum(np.arange(start, start + size), count - 1)
        found.append(
            np.asarray(_no_rest(case.loop, {n: v[index] for n, v in values.items()}, plateaus))
        )
    return np.concatenate(found)[:count]


@jax.jit
def _no_rest(loop, values, plateaus):
    def one(values):
        here = with_values(loop, values)

        def at(y):
            speeds, u = steady_flows(here.plant, y)
            levels = speeds * speeds / (2.0 * here.plant.gravity)
            high = levels > here.plant.rim * (1.0 + 1e-12)
            return (
                jnp.any(speeds < 0)
                | jnp.any(high)
                | jnp.any(u < here.actuator.low)
                | jnp.any(u > here.actuator.high)
            )

        return jnp.any(jax.vmap(at)(plateaus))

    return jax.vmap(one)(values)


def _fan(case, values, seed):
    """{"t" (rows,), "r" (rows, outputs), "x" (5, rows, tanks), "u" (5, rows, pumps), "draws" that
    are finite, "of" how many}: quantiles 5, 25, 50, 75, 95 % at fixed times.
    """
    every, lanes = max(1, (case.clock.samples - 1) // FAN_ROWS), 64
    size, found = len(next(iter(values.values()))), []
    for start in range(0, size, lanes):
        index = np.minimum(np.arange(start, start + lanes), size - 1)
        rows = {n: v[index] for n, v in values.items()}
        t, r, x, u = _trajectories(
            case.loop, rows, index.astype(np.uint32), seed, case.clock, every
        )
        keep = min(lanes, size - start)
        found.append((np.asarray(x)[:keep], np.asarray(u)[:keep]))
    x, u = (np.concatenate(column) for column in zip(*found))
    good = np.isfinite(x).all(axis=(1, 2))
    if not good.any():
        return None
    cuts = (0.05, 0.25, 0.5, 0.75, 0.95)
    return {
        "t": np.asarray(t)[0],
        "r": np.asarray(r)[0],
        "x": np.quantile(x[good], cuts, axis=0),
        "u": np.quantile(u[good], cuts, axis=0),
        "draws": int(good.sum()),
        "of": size,
    }


@functools.partial(jax.jit, static_argnames=("seed", "clock", "every"))
def _trajectories(loop, values, indices, seed, clock, every):
    def one(values, index):
        noise = None if seed is None else jax.random.fold_in(jax.random.key(seed), index)
        run = lp.simulate_compiled(with_values(loop, values), clock, noise, every)[0]
        return run.t, run.r, run.x, run.u

    return jax.vmap(one)(values, indices)

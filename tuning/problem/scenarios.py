"""Several runs behind one cost: scenarios that differ in numbers run as one compiled batch."""

# jax's transformations have no complete types
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false

import contextlib
import dataclasses
import functools
import operator
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank import rig
from jaxtank.case import Case, Scenario
from jaxtank.core.checks import check_whole
from jaxtank.core.clock import CHUNK, Clock
from jaxtank.core.errors import EquilibriumError, InputError
from jaxtank.core.tree import split_index, with_values
from jaxtank.loop import run as lp
from jaxtank.loop.closed_loop import ClosedLoop, draws_bursts
from jaxtank.loop.derivatives import sensitivities_compiled
from jaxtank.xla.jit import compiled

MANY = 1024  # scenarios that one tuning may have
COARSE = 10  # how many samples of the case make one of the coarse stage
FEWEST = 200  # samples that a first local search needs at least
SIDE_BY_SIDE = 32  # runs of one program that fill the vector units
LARGEST_NOISE = 2**24  # numbers of sensor noise that are kept, at most: 128 MiB

Measures = dict[str, Any]  # {name: array}

Shape = tuple[Any, tuple[bool, ...], int]  # structure, which leaves differ, runs


def coarse_clock(clock: Clock, fewest: int = FEWEST) -> Clock:
    """Return the clock of a first local search: ten times the step."""
    if clock.samples < fewest * COARSE:
        return clock
    return dataclasses.replace(clock, dt=clock.dt * COARSE)


def screening_clock(clock: Clock) -> Clock:
    return coarse_clock(clock, 1000)


class ScenarioRun(NamedTuple):
    """One scenario with its case, noise and weight."""

    name: str
    case: Case  # with the scenario's values set
    key: Any  # of the sensor noise, None where there is none
    weight: float  # share of the mean [-]; the weights of all runs sum to 1


class Group(NamedTuple):
    """Runs with one structure and one clock: only values that differ are stacked."""

    runs: tuple[int, ...]  # their indices
    clock: Clock
    structure: Any
    leaves: tuple[Any, ...]  # of the loop, stacked where `apart`
    apart: tuple[bool, ...]  # True where the runs differ
    keys: Any  # (runs,) or None
    noise: Any = None  # (runs, tanks, samples) that was drawn with these keys, None: in the run

    @property
    def shape(self) -> Shape:
        """Static key of the compiled functions."""
        return self.structure, self.apart, len(self.runs)

    @property
    def draws(self) -> Any:
        """Source of the noise of a run: drawn numbers if present, else the keys."""
        return self.keys if self.noise is None else self.noise

    def at(self, clock: Clock) -> "Group":
        """Return the group at a clock, to whose samples drawn noise may not belong."""
        return self if clock == self.clock else self._replace(clock=clock, noise=None)


def noisy(case: Case) -> bool:
    return draws_bursts(case.loop) or bool(np.any(np.asarray(case.loop.sensor.noise) > 0))


def check_scenarios(scenarios: Sequence[Any], free: Sequence[str] = ()) -> tuple[Scenario, ...]:
    """Return `scenarios` as a tuple of Scenario, if each can be run and none sets what is free."""
    checked = tuple(s if isinstance(s, Scenario) else Scenario(**s) for s in scenarios)
    if len(checked) > MANY:
        raise InputError(f"scenarios: {len(checked)} of them, must be at most {MANY}")
    for s in checked:
        if not np.isfinite(s.weight) or s.weight <= 0:
            raise InputError(
                f"scenario {s.name!r}: weight = {s.weight!r} must be a finite number above 0"
            )
        check_whole(f"scenario {s.name!r}: seed", s.seed, 0, 2**31 - 1)
        for name in s.values:
            for other in free:
                if name == other or split_index(name)[0] == other or name == split_index(other)[0]:
                    raise InputError(f"scenario {s.name!r} sets {name}, which is free")
    if len({s.name for s in checked}) < len(checked):
        raise InputError("scenarios: two have the same name")
    return checked


def runs_of(case: Case, scenarios: Sequence[Scenario], seed: int) -> list[ScenarioRun]:
    """Return the ScenarioRuns of a case: one for each scenario, or one for the case itself."""
    if not scenarios:
        key = jax.random.key(seed) if noisy(case) else None
        return [ScenarioRun("", case, key, 1.0)]
    total = sum(s.weight for s in scenarios)
    runs: list[ScenarioRun] = []
    for s in scenarios:
        try:
            changed = rig.set_scenario(case, s.values)
            lp.check(changed.loop, changed.clock, jax.random.key(0))
        except EquilibriumError as error:
            remedy = "give numbers in its place, or leave the scenario out"
            raise InputError(f"scenario {s.name!r}: {error}; {remedy}") from None
        except InputError as error:
            raise InputError(f"scenario {s.name!r}: {error}") from None
        key = jax.random.fold_in(jax.random.key(seed), s.seed) if noisy(changed) else None
        runs.append(ScenarioRun(s.name, changed, key, s.weight / total))
    return runs


def groups_of(runs: Sequence[ScenarioRun]) -> list[Group]:
    """Return the Groups of runs that share a compiled loop, in the order of their first run."""
    kinds: dict[Any, list[tuple[int, list[Any]]]] = {}
    for i, run in enumerate(runs):
        leaves: list[Any]
        structure: Any
        leaves, structure = jax.tree.flatten(run.case.loop)
        kind: Any = (structure, tuple(np.shape(v) for v in leaves), run.case.clock, run.key is None)
        kinds.setdefault(kind, []).append((i, leaves))
    groups: list[Group] = []
    for (structure, _, clock, quiet), members in kinds.items():
        columns = list(zip(*(leaves for _, leaves in members)))
        apart = tuple(any(not np.array_equal(c[0], v) for v in c[1:]) for c in columns)
        stacked = tuple(
            np.stack([np.asarray(v) for v in c]) if a else c[0] for c, a in zip(columns, apart)
        )
        keys = None if quiet else jnp.stack([runs[i].key for i, _ in members])
        groups.append(Group(tuple(i for i, _ in members), clock, structure, stacked, apart, keys))
    return groups


def take(group: Group, picked: Any) -> Group:
    """Return the group with the runs at the positions `picked` alone."""
    picked = np.asarray(picked)
    leaves = tuple(v[picked] if a else v for v, a in zip(group.leaves, group.apart))
    keys, noise = (None if v is None else v[picked] for v in (group.keys, group.noise))
    runs = tuple(group.runs[i] for i in picked)
    return group._replace(runs=runs, leaves=leaves, keys=keys, noise=noise)


def with_noise_drawn(group: Group) -> Group:
    """Return the group with its noise drawn once, for runs that are repeated many times."""
    samples, sensor = group.clock.samples, jax.tree.unflatten(group.structure, group.leaves).sensor
    count = len(group.runs) * samples * int(np.size(np.asarray(sensor.noise)))
    if group.keys is None or samples > CHUNK or count > LARGEST_NOISE:
        return group
    return group._replace(noise=_drawn(sensor, group.keys, samples=samples))


@compiled("samples", keep=True)
def _drawn(sensor: Any, keys: Any, samples: int) -> Any:
    """The noise of each run, (runs, sensors, samples)."""

    def draw(key: Any) -> Any:
        return jnp.stack(sensor.draw(key, samples))

    return jax.vmap(draw)(keys)


def at_once(
    function: Callable[[Any], Any], tasks: Sequence[Any], most: int | None = None
) -> list[Any]:
    """Return function(task) of each task, in `most` threads at once (default: one a processor)."""

    config: Any = jax.config
    double = config.jax_enable_x64

    def run(task: Any) -> Any:
        # `with jax.enable_x64(...)` around the call holds in the thread of the caller alone
        same = config.jax_enable_x64 == double
        with contextlib.nullcontext() if same else jax.enable_x64(double):
            return jax.block_until_ready(function(task))

    if len(tasks) < 2:
        return list(map(function, tasks))
    with ThreadPoolExecutor(min(len(tasks), most or threads())) as pool:
        return list(pool.map(run, tasks))


def threads() -> int:
    """Number of programs to run at once: one on each processor; 1 on an accelerator."""
    return processors() if jax.default_backend() == "cpu" else 1


def processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _is_sequential(structure: Any, leaves: Any) -> bool:
    return jax.tree.unflatten(structure, leaves).sequential


def _shares(group: Group) -> list[Group]:
    """Return a group in equal parts, for processors to run at once."""
    count = len(group.runs)
    if _is_sequential(group.structure, group.leaves):
        parts = max(n for n in range(1, processors() + 1) if count % n == 0)
    else:  # of one size on every machine: others round the last bit differently
        parts = 1 if count % SIDE_BY_SIDE else count // SIDE_BY_SIDE
    return [take(group, rows) for rows in np.split(np.arange(count), parts)]


def _in_shares(function: Callable[..., Any], group: Group, axis: int, *static: Any) -> Any:
    """Return what a program gives for a group, its shares joined along their axis of runs."""

    def run(g: Group) -> Any:
        return function(g.leaves, g.draws, g.shape, g.clock, *static)

    first, *others = at_once(run, _shares(group))
    if not others:
        return first
    return jax.tree.map(lambda *v: np.concatenate(list(map(np.asarray, v)), axis), first, *others)


def values_of(
    group: Group, names: Sequence[str], points: Mapping[str, Any], clock: Clock | None = None
) -> tuple[Measures, Any]:
    """Return (measures {name: (points, runs, ...)}, (points, runs) True where not finite)."""
    return _in_shares(_values, group.at(clock or group.clock), 1, tuple(names), dict(points))


def slopes_of(
    group: Group,
    names: Sequence[str],
    values: Mapping[str, Any],
    squares: tuple[tuple[str, float], ...],
) -> tuple[Measures, Measures, Any, Any]:
    """Return measures, slopes, Gauss-Newton and flags of a group at `values`, by forward mode."""
    # (runs, ...), (runs, ..., P), (runs, P, P) of `squares`, (runs,) True where not finite
    static = tuple(names), tuple(values), tuple(values.values()), squares
    return _in_shares(_slopes, group, 0, *static)


def reverse_slopes_of(
    group: Group, names: Sequence[str], values: Mapping[str, Any]
) -> tuple[Measures, Measures]:
    """Return (measures, slopes) as `slopes_of`, by reverse mode through checkpoints."""
    order, theta = tuple(values), np.array(list(values.values()))
    static = group.shape, group.clock, tuple(names), order
    return _reverse(group.leaves, group.draws, *static, theta)


def _mapped(function: Callable[..., Any], leaves: Any, keys: Any, shape: Shape) -> Any:
    """Return function(loop, key) over the runs of a group; one run runs as it would alone."""
    structure, apart, count = shape

    def run_lane(leaves: Any, key: Any) -> Any:
        return function(jax.tree.unflatten(structure, leaves), key)

    if count == 1:
        mine = leaves if not any(apart) else [v[0] if a else v for v, a in zip(leaves, apart)]
        first: Callable[[Any], Any] = operator.itemgetter(None)
        return jax.tree.map(first, run_lane(mine, None if keys is None else keys[0]))
    if _is_sequential(structure, leaves):
        moving = [v for v, a in zip(leaves, apart) if a]

        def row(now: Any) -> Any:
            rest = iter(now[0])
            return run_lane([next(rest) if a else v for v, a in zip(leaves, apart)], now[1])

        return jax.lax.map(row, (moving, keys))
    axes = (tuple(0 if a else None for a in apart), None if keys is None else 0)
    return jax.vmap(run_lane, in_axes=axes, axis_size=count)(leaves, keys)


@compiled("shape", "clock", "names", keep=True)
def _values(
    leaves: Any, keys: Any, shape: Shape, clock: Clock, names: tuple[str, ...], points: Any
) -> Any:
    def at(values: Any) -> Any:
        def run(loop: ClosedLoop, key: Any) -> Any:
            return lp.evaluate_and_flag(with_values(loop, values), clock, names, key)

        return _mapped(run, leaves, keys, shape)

    if _is_sequential(shape[0], leaves):
        return jax.lax.map(at, points)
    return jax.vmap(at)(points)


@compiled("shape", "clock", "names", "order", "squares", keep=True)
def _slopes(
    leaves: Any,
    keys: Any,
    shape: Shape,
    clock: Clock,
    names: tuple[str, ...],
    order: tuple[str, ...],
    values: Any,
    squares: Any,
) -> Any:
    def run(loop: ClosedLoop, key: Any) -> Any:
        several = shape[-1] > 1 and not loop.sequential
        return sensitivities_compiled(loop, clock, names, order, values, key, squares, several)

    return _mapped(run, leaves, keys, shape)


@functools.partial(jax.jit, static_argnames=("shape", "clock", "names", "order"))
def _reverse(
    leaves: Any,
    keys: Any,
    shape: Shape,
    clock: Clock,
    names: tuple[str, ...],
    order: tuple[str, ...],
    theta: Any,
) -> Any:
    def one(loop: ClosedLoop, key: Any) -> Any:
        def run(theta: Any) -> Any:
            changed = with_values(loop, dict(zip(order, theta)))
            measures: Any = lp.evaluate_for_reverse(changed, clock, names, key)
            return measures, measures

        derivative: Any = jax.jacrev(run, has_aux=True)
        slopes, measures = derivative(theta)
        return measures, slopes

    return _mapped(one, leaves, keys, shape)

"""Several runs behind one cost: scenarios that differ in numbers run as lanes of one compiled loop."""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank import rig
from jaxtank.case import Scenario
from jaxtank.core.errors import EquilibriumError, InputError
from jaxtank.core.tree import split_index, with_values
from jaxtank.loop import run as lp
from jaxtank.loop.derivatives import sensitivities_compiled
from jaxtank.xla import flags

MANY = 1024
"""Scenarios that one tuning may have."""


COARSE = 10
"""How many samples of the case make one of the coarse stage."""

FEWEST = 200
"""Samples that a first local search needs at least."""


def coarse_clock(clock):
    """The clock of the coarse stage: ten times the step, where that leaves at least a thousand
    samples; else the clock itself.
    """
    if clock.samples < 1000 * COARSE:
        return clock
    return dataclasses.replace(clock, dt=clock.dt * COARSE)


def rough_clock(clock):
    """The clock of a first local search: ten times the step, where that leaves at least FEWEST
    samples; else the clock itself.
    """
    return (
        clock
        if clock.samples < FEWEST * COARSE
        else dataclasses.replace(clock, dt=clock.dt * COARSE)
    )


class Lane(NamedTuple):
    """One scenario as it is run."""

    name: str
    case: Any  # the case with the scenario's values set
    key: Any  # of the sensor noise, None where there is none
    weight: float  # share of the mean [-]; those of all lanes sum to 1


class Group(NamedTuple):
    """Lanes with one structure and one clock: what differs is stacked, what is shared is not."""

    lanes: tuple  # their indices
    clock: Any
    structure: Any
    leaves: tuple  # of the loop, stacked where `apart`
    apart: tuple  # True where the lanes differ
    keys: Any  # (lanes,) or None


def noisy(case):
    """True if a run of the case draws noise."""
    return bool(np.any(np.asarray(case.loop.sensor.noise) > 0))


def check_scenarios(case, scenarios, free=()):
    """`scenarios` as a tuple of Scenario, if each can be run and none sets what is free."""
    found = tuple(s if isinstance(s, Scenario) else Scenario(**s) for s in scenarios)
    if len(found) > MANY:
        raise InputError(f"scenarios: {len(found)} of them, must be at most {MANY}")
    for s in found:
        if not np.isfinite(s.weight) or s.weight <= 0:
            raise InputError(
                f"scenario {s.name!r}: weight = {s.weight!r} must be a finite number above 0"
            )
        if isinstance(s.seed, bool) or not isinstance(s.seed, int) or not 0 <= s.seed < 2**31:
            raise InputError(
                f"scenario {s.name!r}: seed = {s.seed!r} must be a whole number from 0 to"
                f" {2**31 - 1}"
            )
        for name in s.values:
            for other in free:
                if name == other or split_index(name)[0] == other or name == split_index(other)[0]:
                    raise InputError(f"scenario {s.name!r} sets {name}, which is free")
    if [s.name for s in found] != list(dict.fromkeys(s.name for s in found)):
        raise InputError("scenarios: two have the same name")
    return found


def lanes_of(case, scenarios, seed):
    """The Lanes of a case: one for each scenario, or one for the case itself. Raises InputError,
    naming the scenario.
    """
    if not scenarios:
        key = jax.random.key(seed) if noisy(case) else None
        return [Lane("", case, key, 1.0)]
    total, found = sum(s.weight for s in scenarios), []
    for s in scenarios:
        try:
            here = rig.set_scenario(case, s.values)
            lp.check(here.loop, here.clock, jax.random.key(0))
        except EquilibriumError as error:
            remedy = "give numbers in its place, or leave the scenario out"
            raise InputError(f"scenario {s.name!r}: {error}; {remedy}") from None
        except InputError as error:
            raise InputError(f"scenario {s.name!r}: {error}") from None
        key = jax.random.fold_in(jax.random.key(seed), s.seed) if noisy(here) else None
        found.append(Lane(s.name, here, key, s.weight / total))
    return found


def groups_of(lanes):
    """The Groups of lanes that can share a compiled loop, in the order of their first lane."""
    sorts = {}
    for i, lane in enumerate(lanes):
        leaves, structure = jax.tree.flatten(lane.case.loop)
        sort = (structure, tuple(np.shape(v) for v in leaves), lane.case.clock, lane.key is None)
        sorts.setdefault(sort, []).append((i, leaves))
    found = []
    for (structure, _, clock, quiet), members in sorts.items():
        columns = list(zip(*(leaves for _, leaves in members)))
        apart = tuple(any(not np.array_equal(c[0], v) for v in c[1:]) for c in columns)
        leaves = tuple(
            np.stack([np.asarray(v) for v in c]) if a else c[0] for c, a in zip(columns, apart)
        )
        keys = None if quiet else jnp.stack([lanes[i].key for i, _ in members])
        found.append(Group(tuple(i for i, _ in members), clock, structure, leaves, apart, keys))
    return found


def take(group, picked):
    """The group with the lanes at the positions `picked` alone."""
    picked = np.asarray(picked)
    leaves = tuple(v[picked] if a else v for v, a in zip(group.leaves, group.apart))
    keys = None if group.keys is None else group.keys[picked]
    return group._replace(lanes=tuple(group.lanes[i] for i in picked), leaves=leaves, keys=keys)


def values_of(group, names, points, clock=None):
    """(measures {name: (points, lanes, ...)}, (points, lanes) True where a run is not finite);
    points {parameter: (points,)}.
    """
    shape = (group.structure, group.apart, len(group.lanes))
    return _values(group.leaves, group.keys, shape, clock or group.clock, names, points)


def slopes_of(group, names, values, squares):
    """(measures {name: (lanes, ...)}, slopes {name: (lanes, ..., P)}, (lanes, P, P) Gauss-Newton,
    (lanes,) broken): forward mode.
    """
    shape = (group.structure, group.apart, len(group.lanes))
    return _slopes(
        group.leaves,
        group.keys,
        shape,
        group.clock,
        names,
        tuple(values),
        tuple(values.values()),
        squares,
    )


def reverse_slopes_of(group, names, values):
    """(measures, slopes) as `slopes_of`, by reverse mode through checkpointed pieces."""
    shape = (group.structure, group.apart, len(group.lanes))
    return _reverse(
        group.leaves,
        group.keys,
        shape,
        group.clock,
        names,
        tuple(values),
        np.array(list(values.values())),
    )


def _mapped(function, leaves, keys, shape):
    """function(loop, key) over the lanes of a group; one lane runs as it would alone."""
    structure, apart, count = shape
    if count == 1:
        one = jax.tree.unflatten(
            structure,
            leaves if not any(apart) else [v[0] if a else v for v, a in zip(leaves, apart)],
        )
        return jax.tree.map(lambda v: v[None], function(one, None if keys is None else keys[0]))
    return jax.vmap(
        lambda leaves, key: function(jax.tree.unflatten(structure, leaves), key),
        in_axes=(tuple(0 if a else None for a in apart), None if keys is None else 0),
        axis_size=count,
    )(leaves, keys)


@functools.partial(
    jax.jit, static_argnames=("shape", "clock", "names"), compiler_options=flags.WIDE
)
def _values(leaves, keys, shape, clock, names, points):
    def at(values):
        return _mapped(
            lambda loop, key: lp.evaluate_and_flag(with_values(loop, values), clock, names, key),
            leaves,
            keys,
            shape,
        )

    return jax.vmap(at)(points)


@functools.partial(
    jax.jit,
    static_argnames=("shape", "clock", "names", "order", "squares"),
    compiler_options=flags.WIDE,
)
def _slopes(leaves, keys, shape, clock, names, order, values, squares):
    several = shape[-1] > 1
    return _mapped(
        lambda loop, key: sensitivities_compiled(
            loop, clock, names, order, values, key, squares, several
        ),
        leaves,
        keys,
        shape,
    )


@functools.partial(jax.jit, static_argnames=("shape", "clock", "names", "order"))
def _reverse(leaves, keys, shape, clock, names, order, theta):
    def one(loop, key):
        def run(theta):
            measures = lp.evaluate_for_reverse(
                with_values(loop, dict(zip(order, theta))), clock, names, key
            )
            return measures, measures

        slopes, measures = jax.jacrev(run, has_aux=True)(theta)
        return measures, slopes

    return _mapped(one, leaves, keys, shape)

"""Where to start: Sobol points at a coarse step, and which of them only that step makes unstable.

Imported by `stages` and `pareto`.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import scipy  # its parts are imported when they are first used
from jax.flatten_util import ravel_pytree

from jaxtank import measures as ms
from jaxtank.analysis.steady_state import equilibrium
from jaxtank.core.errors import InputError
from jaxtank.core.tree import with_values
from jaxtank.loop.closed_loop import Inputs, initial
from jaxtank.loop.step import step
from tuning.problem.scenarios import screening_clock

TRIED = 3
"""Screened points that are run again at the true step, at most, to find one that is better than the
best: the coarse step may rate many too low."""

LARGEST_STATE = 60
"""Numbers in the loop's state above which its stability is not computed: eigenvalues cost their
cube.
"""


def sobol(count, dimensions, seed):
    """Return (count, dimensions) scrambled Sobol points in the unit cube.

    count : should be a power of 2. seed : of the scrambling.

    Examples
    --------
    >>> sobol(4, 2, seed=0).shape
    (4, 2)
    """
    return scipy.stats.qmc.Sobol(dimensions, scramble=True, rng=np.random.default_rng(seed)).random(
        count
    )


def spectral_radius(problem, zs, clock):
    """Return (points,) the largest eigenvalue modulus of one sample of the linearised loop.

    Linearised at the reference's plateaus, at zs (points, P). Above 1, the sampled loop is unstable
    there: it chatters between the limits of the pumps however good its gains would be at a smaller
    step. NaN where no plateau has a steady state, or a transport delay makes the state too long.
    """
    steady = []
    plateaus = problem.loop.reference.plateaus()
    for r in () if plateaus is None else plateaus:
        try:
            steady.append((r, *equilibrium(problem.loop.plant, r)))
        except InputError:
            continue
    if not steady:
        return np.full(len(zs), np.nan)
    r, x, u = (jnp.asarray(np.array(column)) for column in zip(*steady))
    if (
        sum(
            np.size(v)
            for v in jax.tree.leaves(jax.eval_shape(lambda: initial(problem.loop, clock)))
        )
        > LARGEST_STATE
    ):
        return np.full(len(zs), np.nan)
    values = {b.name: jnp.asarray(b.from_unit(zs[:, i])) for i, b in enumerate(problem.bounds)}
    steps = np.asarray(_one_step_jacobians(problem.loop, clock, values, r, x, u))
    return np.abs(np.linalg.eigvals(steps)).max(axis=(1, 2))


@functools.partial(jax.jit, static_argnames=("clock",))
def _one_step_jacobians(loop, clock, values, r, x, u):
    """Return (points, plateaus, n, n) derivative of the loop's state by that a sample before."""

    def jacobian(values, r, x, u):
        here = with_values(loop, {**values, "x0": x, "actuator.initial": u})
        state = initial(here, clock)
        leaves, structure = jax.tree.flatten(state)
        moves = [jnp.issubdtype(jnp.result_type(v), jnp.floating) for v in leaves]
        zero = jnp.zeros_like(r)
        d = None if loop.disturbance is None else tuple(jnp.zeros(loop.plant.tanks))
        plan = here.controller.prepare(
            tuple(r[:, None]), tuple(zero[:, None]), tuple(zero[:, None])
        )
        now = Inputs(
            r=tuple(r),
            dr=tuple(zero),
            ddr=tuple(zero),
            d=d,
            xi=None,
            context=ms.Context(),
            plan=jax.tree.map(lambda a: a[0], plan),
            own=jax.tree.map(lambda a: a[0], here.controller.inputs(clock)),
            fault=None if loop.faults is None else (0.0,) * len(loop.faults.windows),
        )

        def after(flat):
            floats, rest = iter(unravel(flat)), iter([v for v, m in zip(leaves, moves) if not m])
            state = jax.tree.unflatten(
                structure, [next(floats) if m else next(rest) for m in moves]
            )
            out = jax.tree.leaves(step(here, clock, state, now)[0])
            return jnp.concatenate([jnp.ravel(v) for v, m in zip(out, moves) if m])

        flat, unravel = ravel_pytree([v for v, m in zip(leaves, moves) if m])
        return jax.jacfwd(after)(flat)

    return jax.vmap(lambda v: jax.vmap(lambda *at: jacobian(v, *at))(r, x, u))(values)


def screen(problem, count, seed):
    """Return (zs, costs, margins, redone) of `count` Sobol points.

    zs (points, P), costs (points,), margins (points, limits). Points that the coarse step alone
    makes unstable, or whose coarse run is not finite, are run again at the true step; `redone`
    counts the first.
    """
    zs = sobol(count, len(problem.bounds), seed)
    clock = screening_clock(problem.clock)
    costs, margins = problem.screen(zs, coarse=True)
    unstable = np.zeros(count, dtype=bool)
    if clock != problem.clock:
        unstable = (spectral_radius(problem, zs, clock) > 1.0) & ~(
            spectral_radius(problem, zs, problem.clock) > 1.0
        )
        suspect = unstable | ~np.isfinite(costs)
        if suspect.any():
            # always the same number of points, so that one compiled program serves every search
            again = np.concatenate(
                [zs[suspect], np.repeat(zs[suspect][:1], count - suspect.sum(), axis=0)]
            )
            true_costs, true_margins = problem.screen(again)
            costs[suspect], margins[suspect] = (
                true_costs[: suspect.sum()],
                true_margins[: suspect.sum()],
            )
    return zs, costs, margins, int(unstable.sum())


def distinct_starts(zs, merits, count, first):
    """Return up to `count` points: `first`, then those of lowest merit at a distance from these.

    Examples
    --------
    >>> zs = np.array([[0.5], [0.51], [0.9]])
    >>> [float(z[0]) for z in distinct_starts(zs, np.array([1.0, 2.0, 3.0]), 3, np.array([0.1]))]
    [0.1, 0.5, 0.9]
    """
    taken = [np.asarray(first, dtype=float)]
    apart = 0.5 / max(2, count) * np.sqrt(len(first))
    order = [i for i in np.argsort(merits, kind="stable") if np.isfinite(merits[i])]
    while len(taken) < count and order and apart > 1e-4:
        for i in order:
            if len(taken) < count and min(np.linalg.norm(zs[i] - t) for t in taken) > apart:
                taken.append(zs[i])
        apart /= 2
    return taken


def best_screened(search, zs, costs, margins):
    """Return the screened point (P,) that keeps the limits and is better than the best of a Search.

    None where none is, at the true step. zs (points, P), costs (points,) and margins (points,
    limits) as `screen` returns them. A point that is run again enters the Search.
    """
    held = np.isfinite(costs) & np.all(margins >= 0, axis=1)
    new = [
        i
        for i in np.argsort(costs, kind="stable")
        if held[i] and zs[i].tobytes() not in search.memory
    ]
    for i in new[:TRIED]:
        if (
            search.best is not None
            and search.violation(search.best) == 0
            and costs[i] >= search.best.cost
        ):
            return None
        if search.point(zs[i]) is search.best:
            return zs[i]
    return None

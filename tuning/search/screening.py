"""Where to start: Sobol points at a coarse step, and those that only this step makes unstable."""

import contextlib
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxtank.core.errors import InputError
from jaxtank.core.tree import with_values
from jaxtank.loop.closed_loop import floats_of, initial
from jaxtank.loop.margins import constant_inputs
from jaxtank.loop.steady import steady_state
from jaxtank.loop.step import step
from tuning.problem.scenarios import screening_clock
from tuning.uncertainty.sobol import Sobol

FEWEST, MEMBERS = 32, 64  # of a differential evolution: as many as were screened

GENERATIONS, RUNS = 14, 100_000  # its generations, and its coarse runs, at most
MUCH = 1e12  # merit of a point that violates a limit: above every cost (see `DIVERGED`) [-]

CROSSED = 0.9  # share of parameters that a member takes from its move [-]
AFFORDED = 2**23  # samples up to which a screening is done at the true step: no compiling
LARGEST_STATE = 60  # numbers above which stability is not computed: cubic cost


def sobol(count, dimensions, seed):
    """Return (count, dimensions) scrambled Sobol points in the unit cube."""
    return Sobol(dimensions, seed).rows(0, count)


def spectral_radius(problem, zs, clock):
    """Return (points,) the largest eigenvalue modulus of one sample of the linearised loop."""
    # At the reference's plateaus; above 1 the sampled loop chatters, however good its gains at a
    # smaller step. NaN without a steady state, or where a transport delay makes the state too long.
    steady = []
    plateaus = problem.loop.reference.plateaus()
    for r in () if plateaus is None else plateaus:
        with contextlib.suppress(InputError):
            steady.append((r, *steady_state(problem.loop, r)))
    if not steady or state_size(problem.loop, clock) > LARGEST_STATE:
        return np.full(len(zs), np.nan)
    r, x, u = (jnp.asarray(np.array(column)) for column in zip(*steady))
    values = {b.name: jnp.asarray(b.from_unit(zs[:, i])) for i, b in enumerate(problem.bounds)}
    steps = np.asarray(_one_step_jacobians(problem.loop, clock, values, r, x, u))
    return np.abs(np.linalg.eigvals(steps)).max(axis=(1, 2))


def state_size(loop, clock):
    """Return how many numbers the state of a loop has."""
    state = jax.eval_shape(lambda: initial(loop, clock))
    return sum(np.size(v) for v in jax.tree.leaves(state))


@functools.partial(jax.jit, static_argnames=("clock",))
def _one_step_jacobians(loop, clock, values, r, x, u):
    """Return (points, plateaus, n, n) derivative of the loop's state by that a sample before."""

    def jacobian(values, r, x, u):
        changed = with_values(loop, {**values, "x0": x, "actuator.initial": u})
        state, now = initial(changed, clock), constant_inputs(changed, clock, r)
        parts = floats_of(state)
        floats, rest = parts.split(state)
        flat, unravel = ravel_pytree(floats)

        def after(flat):
            moved, _ = step(changed, clock, parts.join(unravel(flat), rest), now)
            return ravel_pytree(parts.split(moved)[0])[0]

        return jax.jacfwd(after)(flat)

    return jax.vmap(lambda v: jax.vmap(lambda *at: jacobian(v, *at))(r, x, u))(values)


def screen(evaluator, count, seed, coarse=True):
    """Return (Population of `count` Sobol points, how many the coarse step makes unstable)."""
    # At a coarse step unless runs are short; points that it makes unstable run at the true one.
    problem = evaluator.problem
    zs = sobol(count, len(problem.bounds), seed)
    unstable = np.zeros(count, dtype=bool)
    coarse = coarse and count * len(problem.runs) * problem.clock.samples > AFFORDED
    clock = screening_clock(problem.clock) if coarse else None
    coarse = coarse and clock != problem.clock
    costs, margins = evaluator.screen(zs, coarse)
    if coarse:
        unstable = (spectral_radius(problem, zs, clock) > 1.0) & ~(
            spectral_radius(problem, zs, problem.clock) > 1.0
        )
        suspect = unstable | ~np.isfinite(costs)
        if suspect.any():
            costs[suspect], margins[suspect] = evaluator.screen(zs[suspect])
    return Population(zs, costs, margins), int(unstable.sum())


def distinct_starts(zs, merits, count, first):
    """Return up to `count` points: `first`, then points of low merit, at a distance from others."""
    taken = [np.asarray(first, dtype=float)]
    apart = 0.5 / max(2, count) * np.sqrt(len(first))
    order = [i for i in np.argsort(merits, kind="stable") if np.isfinite(merits[i])]
    while len(taken) < count and order and apart > 1e-4:
        for i in order:
            if len(taken) < count and min(np.linalg.norm(zs[i] - t) for t in taken) > apart:
                taken.append(zs[i])
        apart /= 2
    return taken


def best_screened(search, screened):
    """Return the feasible screened point (P,) better than the best of a Search, or None."""
    zs, costs, margins = screened
    feasible = np.isfinite(costs) & np.all(margins >= 0, axis=1)
    for i in np.argsort(costs, kind="stable"):
        if not feasible[i] or zs[i].tobytes() in search.memory:
            continue
        best = search.best
        if best is not None and search.violation(best) == 0 and costs[i] >= best.cost:
            return None
        if search.point(zs[i]) is search.best:
            return zs[i]
    return None


class Population(NamedTuple):
    """Points and what was measured there."""

    zs: np.ndarray  # (points, P) in the unit cube
    costs: np.ndarray  # (points,)
    margins: np.ndarray  # (points, limits)

    def merits(self, search):
        """Return (points,) costs where limits hold, else large values that grow with violation."""
        short = search.violations(self.margins)
        merits = np.where(short > 0, MUCH * (1.0 + short), self.costs)
        return np.where(np.isfinite(self.costs) & np.isfinite(merits), merits, np.inf)


def evolution_size(search, screened):
    """Return (members, generations) of a differential evolution, within RUNS coarse runs."""
    members = min(max(len(screened.zs), FEWEST), MEMBERS)
    return members, max(2, min(GENERATIONS, RUNS // (members * len(search.problem.runs))))


def evolve(search, zs, generations, seed, coarse=True):
    """Return the Populations after and before differential evolution of the points zs."""
    rng, count = np.random.default_rng([seed, 1997]), len(zs)
    first = now = Population(zs, *search.evaluator.screen(zs, coarse))
    merits = now.merits(search)
    for _ in range(generations):
        a, b, c = (rng.permutation(count) for _ in range(3))
        factor = rng.uniform(0.4, 0.9, (count, 1))
        towards = now.zs + factor * (now.zs[np.argmin(merits)] - now.zs)
        base = np.where(rng.random((count, 1)) < 0.5, towards, now.zs[a])
        moved = np.clip(base + factor * (now.zs[b] - now.zs[c]), 0.0, 1.0)
        trial = np.where(rng.random(moved.shape) < CROSSED, moved, now.zs)
        new = Population(trial, *search.evaluator.screen(trial, coarse))
        ranks = new.merits(search)
        better = ranks < merits
        merits = np.where(better, ranks, merits)
        now = Population(
            np.where(better[:, None], new.zs, now.zs),
            np.where(better, new.costs, now.costs),
            np.where(better[:, None], new.margins, now.margins),
        )
        search.report(search)
    return now, first


def around(z, count, seed):
    """Return (count, P) points about z in the unit cube, at distances from 0.002 to 0.2."""
    rng = np.random.default_rng([seed, 2])
    radius = np.exp(rng.uniform(np.log(0.002), np.log(0.2), (count, 1)))
    return np.clip(z + radius * rng.standard_normal((count, len(z))), 0.0, 1.0)

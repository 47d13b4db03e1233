"""A problem as a search evaluates it: every result is kept, every run is counted."""

import functools
from typing import Any

import numpy as np

from tuning.problem import scenarios as sc
from tuning.problem.problem import LANES, Point, Problem, Screened
from tuning.storage.evaluation_log import EvaluationCache

IDLE = 2**23  # samples of runs made in vain, at most, to use a compiled program


class Blocks:
    """How many points a program runs: as many as in an earlier call where that serves."""

    # sizes follow from the calls alone: a search that is continued gives the same bits

    def __init__(self, runs: int):
        self.runs = runs
        self.sizes: dict[bool, int] = {}

    def size(self, points: int, coarse: bool, samples: int) -> int:
        """Return the points of a block, for a call with so many points of runs of `samples`."""
        size, enough = self.sizes.get(coarse, 0), max(1, min(points, LANES // self.runs))
        if size < enough:
            self.sizes[coarse] = enough
            return enough
        return size if -points % size * self.runs * samples <= IDLE else enough


class Evaluator:
    """Evaluates one Problem: `cache` has the results, `simulations` and `gradients` are counts."""

    def __init__(self, problem: Problem, cache: EvaluationCache | None = None):
        self.problem = problem
        self.cache = EvaluationCache() if cache is None else cache
        self.simulations, self.gradients, self.non_finite = 0, 0, 0
        self.blocks = Blocks(len(problem.runs))

    def screen(self, zs: Any, coarse: bool = False) -> Screened:
        zs = np.asarray(zs, dtype=float)
        self.simulations += len(zs) * len(self.problem.runs)
        samples = max(group.clock.samples for group in self.problem.groups)
        size = self.blocks.size(len(zs), coarse, samples // (sc.COARSE if coarse else 1))
        costs, margins = self.cache.recall(
            "screen", [zs, coarse], lambda: self.problem.screen(zs, coarse, size)
        )
        return costs.copy(), margins.copy()

    def point(self, z: Any) -> Point:
        point = self._counted("point", z, len(self.problem.runs), self.problem.point)
        self.non_finite += not point.finite
        return point

    def coarse_point(self, z: Any) -> Point:
        return self._counted("coarse", z, len(self.problem.runs), self.problem.coarse_point)

    def batch_point(self, z: Any, batch: int, rng: np.random.Generator) -> Point:
        groups = self.problem.batch(batch, rng)
        runs = np.array([i for group in groups for i in group.runs], dtype=float)
        evaluate = functools.partial(self.problem.batch_point, groups=groups)
        point = self._counted("batch", z, len(runs), evaluate, runs)
        limits = enumerate(self.problem.limits)
        return point._replace(rows=tuple(i for i, limit in limits if limit.run in runs))

    def _counted(self, kind: str, z: Any, runs: int, evaluate: Any, *more: Any) -> Point:
        """Return evaluate(z), after `runs` simulations with gradients were counted."""
        self.simulations, self.gradients = self.simulations + runs, self.gradients + runs
        z = np.clip(np.asarray(z, dtype=float), 0.0, 1.0)
        # `rows`, which are no numbers of a log, are left out
        return Point(z, *self.cache.recall(kind, [z, *more], lambda: tuple(evaluate(z)[1:-1])))

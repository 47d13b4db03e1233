"""Plants that are looked at during a search: on them too, limits that nothing proves shall hold."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxtank import measures as ms
from jaxtank.case import Case, Scenario
from tuning.answer.setting import Setting
from tuning.problem.limits import UNDEFINED_MARGIN
from tuning.problem.problem import Problem
from tuning.problem.scenarios import ScenarioRun

CHECKED = 256
"""Plants that are looked at."""

SEED = 20_011
"""Of these plants and their noise, whatever the seed of a search, so that limits bind alike."""

ADDED = 8
"""Plants that join those of the search."""

WORST = 2
"""Of each limit, the plants that come nearest to it are added, as many as this."""

SHARE = 0.4
"""Tightening of a limit, as a share of the distance from the 90 % quantile over the plants to their
worst: other plants are worse than all of them now and then [-]."""

LARGEST = 0.25
"""Largest tightening, as a share of the limit [-]."""

LIGHT = 1e-9
"""Weight of an added plant in the cost [-]: it serves the limits alone."""

Key = tuple[str, int]
"""(measure, entry) of a limit."""


class Checks:
    """Limits on CHECKED plants: how much each is tightened, and which plants a search needs."""

    def __init__(
        self, setting: Setting, case: Case, free: Any, limits: Mapping[str, Any], least: Mapping
    ):
        plants = [s._replace(name=f"added {s.name}") for s in setting.plants(case, CHECKED, SEED)]
        self.problem = Problem(case, free, setting.objective, limits, plants, SEED)
        self.given, self.least = limits, least
        keys = [(limit.measure, limit.index) for limit in self.problem.limits]
        self.rows = {
            key: [i for i, k in enumerate(keys) if k == key] for key in dict.fromkeys(keys)
        }
        self.tightening: dict[Key, float] = {}
        self.margins: dict[Key, np.ndarray] = {}
        self.added: list[int] = []

    def look(self, z: np.ndarray) -> None:
        """Run every plant at z (P,): its margins set the tightening, the worst plants are added."""
        _, margins = self.problem.screen(np.asarray(z)[None])
        worst: list[int] = []
        for key, rows in self.rows.items():
            found = self.margins[key] = margins[0, rows]
            self.tightening[key] = self._tightening(key, found)
            order = np.argsort(found, kind="stable")
            worst += [self.problem.limits[rows[i]].run for i in order[:WORST]]
        self.added = list(dict.fromkeys([*worst, *self.added, *range(ADDED)]))[:ADDED]

    def _tightening(self, key, margins):
        limit = self.problem.limits[self.rows[key][0]]
        least, size = self.least.get(key, 0.0), abs(limit.value)
        known = margins[np.abs(margins) < UNDEFINED_MARGIN]
        if size == 0.0 or key[0] not in self.given or not len(known):
            return 0.0
        spread = float(np.quantile(known, 0.1) - known.min())
        # far past its limit, a measure spreads more than at it
        reached = abs(limit.value - limit.sign * known.min())
        return min(max(SHARE * spread * min(1.0, size / reached), least), LARGEST * size)

    def hold(self, share: float = 0.5) -> bool:
        """Return True if all plants keep all limits, with this share of the tightening left."""
        return all(m.min() >= share * self.tightening[k] for k, m in self.margins.items())

    def slack(self, problem: Problem) -> np.ndarray:
        """Return (limits,) by how much the limits of a problem are tighter than they were given."""
        keys = ((limit.measure, limit.index) for limit in problem.limits)
        return np.array([self.tightening.get(key, 0.0) for key in keys])

    @property
    def share(self) -> float:
        """Largest tightening as a share of its limit [-]."""
        sizes = {k: abs(self.problem.limits[rows[0]].value) for k, rows in self.rows.items()}
        return max((v / sizes[k] for k, v in self.tightening.items() if v > 0.0), default=0.0)

    def limits(self) -> dict[str, Any]:
        """Return {measure: value} tightened."""
        found = dict(self.given)
        plant = self.problem.loop.plant
        for (measure, index), tightening in self.tightening.items():
            if not tightening:
                continue
            value: Any = found[measure]
            if isinstance(value, str):
                value = plant.rim
            values = np.array(np.broadcast_to(np.asarray(value, float), ms.entries(measure, plant)))
            values[index] -= ms.MEASURES[measure].sense * tightening
            found[measure] = values.tolist()
        return found

    def scenarios(self) -> list[Scenario]:
        """Return the added plants."""
        return [self.problem.scenarios[i]._replace(weight=LIGHT) for i in self.added]

    def runs(self, share: float) -> list[ScenarioRun]:
        """Return the added plants as runs with the noise of here; share : of the cost."""
        return [self.problem.runs[i]._replace(weight=share) for i in self.added]

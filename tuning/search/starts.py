"""One local search and its outcome, as `TuningResult.starts` lists it."""

from collections.abc import Callable
from typing import Any

import numpy as np

from tuning.search.driver import Search


def search_from(
    search: Search, starts: list[dict[str, Any]], z: Any, run: Callable, count: int | None = None
) -> None:
    """Make a local search from z, run(search, z); its outcome is added to `starts`."""
    count = len(search.history) if count is None else count
    z, search.exhausted = np.clip(z, 0.0, 1.0), False
    blind = search.slopes.get(z.tobytes())
    converged = bool(run(search, z)) if blind is None or blind.usable else False
    mine = search.history[count:]
    reached = min(mine, key=lambda h: (h[2] > 0, h[2] if h[2] > 0 else h[1]), default=None)
    if reached is None:  # every point it asked for was known already
        point = search.memory.get(z.tobytes(), search.best or search.last_finite)
        reached = (search.start, float(point.cost), search.violation(point), tuple(point.z))
    if np.array_equal(reached[3], z):
        blind = search.slope(search.point(z))
    usable = None if blind is None else blind.usable
    starts.append(
        {
            "from": search.problem.values(z),
            "to": search.problem.values(reached[3]),
            "cost": reached[1],
            "violation": reached[2],
            "evaluations": len(mine),
            "converged": converged and usable is not False,
            "exhausted": search.exhausted,
            "slope_usable": usable,
        }
    )

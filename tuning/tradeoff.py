"""What a limit costs: the problem solved again for a row of values of one limit, each search begun where the last one ended."""

import math

import numpy as np

from jaxtank.errors import InputError
from jaxtank.measures import check_names
from tuning.objective import LOWER, Problem, resolve_limits, room_of
from tuning.solvers import Search, restore, slsqp

MANY = 50
"""Values of the limit at most."""


def tradeoff(case, measure, values, *, free=None, objective=None, limits=None, scenarios=None, seed=0, iterations=60, start=None):
    """The least objective for each of `values` as the limit of `measure` (the epsilon-constraint method), the loosest first.

    case, free, objective, limits, scenarios, seed, iterations: as in `tune`; the limit holds for every entry of the measure, the other
    limits stay; start: {name: value} to begin at, the case's own where None. Returns {"measure", "points": [{"limit", "status" ("converged",
    "not_converged" or "infeasible"), "objective", "violation", "parameters"}]}. Raises InputError for an unknown measure and for values
    that are not finite.
    """
    check_names([measure])
    values = [float(v) for v in values]
    if not 1 <= len(values) <= MANY or not all(math.isfinite(v) for v in values):
        raise InputError(f"tradeoff of {measure}: must have 1 to {MANY} finite values of its limit")
    others = {m: v for m, v in (case.limits if limits is None else limits).items() if m != measure}
    values = sorted(values, reverse=measure not in LOWER)
    problem = Problem(case, free=free, objective=objective, limits={**others, measure: values[0]}, scenarios=scenarios, seed=seed)
    z = problem.start()
    if start is not None:
        z = np.clip([float(b.to_unit(start[b.name])) for b in problem.bounds], 0.0, 1.0)
    points = []
    for value in values:
        problem.limits = [
            limit
            for i, lane in enumerate(problem.lanes)
            for limit in resolve_limits(lane.case, {**others, measure: value}, i, lane.name)
        ]
        problem.rooms = np.array([room_of(limit, problem.loop) for limit in problem.limits])
        problem.memo = type(problem.memo)()  # margins are of the limits: what is remembered would be of the last ones
        search = Search(problem, problem.point(problem.start()), lambda s: None)
        converged = slsqp(search, z, iterations)
        if search.best is not None and search.violation(search.best) > 0:
            restore(search, search.best.z, iterations)
            converged = slsqp(search, search.best.z, iterations)
        best = search.best
        broken = np.inf if best is None else search.violation(best)
        z = z if best is None else best.z
        points.append(
            {
                "limit": value,
                "status": "infeasible" if broken > 0 else "converged" if converged else "not_converged",
                "objective": np.nan if best is None else float(best.cost),
                "violation": float(broken),
                "parameters": problem.values(z),
            }
        )
    return {"measure": measure, "points": points}

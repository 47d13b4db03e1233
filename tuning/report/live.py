"""The live page of a result: of its case, or of the tuned one with both states to start from."""

import dataclasses
from typing import Any

import numpy as np

from jaxtank import measures as ms
from jaxtank.core.errors import InputError
from jaxtank.core.tree import parameters
from jaxtank.live.page import LivePage, live_page
from tuning.problem.functions import as_measures


def live_page_of(result: Any, plants: int | None = None) -> LivePage:
    """Return the LivePage of a result: of its case, or of the tuned one before and after."""
    # Raises InputError for a result without a case, and a case that cannot be run in a browser.
    case, tuned = getattr(result, "case", None), getattr(result, "tuned", None)
    if case is None:
        raise InputError(f"{type(result).__name__} has no case to explore")
    if tuned is not None and tuned.loop.safety_filter is not None:
        # designed for the plant, which is the same
        loop = dataclasses.replace(case.loop, safety_filter=tuned.loop.safety_filter)
        case = case.replace(loop=loop, safety=tuned.safety)
    problem = getattr(result, "problem", None)
    stated = None if problem is None else problem.stated_limits
    if getattr(result, "answer", None) is not None:
        stated = result.tuned.limits  # its search leaves out limits that the safety filter keeps
    if stated is not None:
        _, limits = as_measures(None, stated)
        functions = set(ms.functions(limits))  # a user's functions do not run in a browser
        limits = {m: value for m, value in limits.items() if m not in functions}
        case = case.replace(limits=limits)  # the limits of the search, with --limit
    return live_page(case, states_of(result), plants=plants)


def states_of(result: Any) -> list[tuple[str, dict[str, Any], bool]]:
    """Return the states "before" and "after" of a TuningResult, [] of another result."""
    tuned = getattr(result, "tuned", None)
    if tuned is None:
        return []
    numbers = {n.split("[")[0] for n in parameters(result.case.loop)}
    changes = [(n, p) for n, p in result.parameters.items() if n.split("[")[0] in numbers]
    values = lambda when: {n: np.asarray(p[when], dtype=float) for n, p in changes}
    sides = (("before", result.case.loop), ("after", tuned.loop))
    return [(when, values(when), loop.safety_filter is not None) for when, loop in sides]

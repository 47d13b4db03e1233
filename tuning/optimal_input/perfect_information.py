"""`bound`: the perfect-information open-loop optimum of a case, the best inputs when the whole run
is known in advance. Imported as `tuning.bound` and by the command `tune --bound`.
"""

import dataclasses
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from jaxtank import measures as ms
from jaxtank.case import Case
from jaxtank.core.errors import NonFiniteError
from jaxtank.loop import run as lp
from jaxtank.loop.trajectory import Trajectory
from tuning.optimal_input.cost import open_loop
from tuning.optimal_input.problem import InputProblem
from tuning.optimal_input.search import InputSearch
from tuning.problem.result import Result


@dataclasses.dataclass(frozen=True, kw_only=True, repr=False)
class InputBound(Result):
    """Result of `tuning.bound`; costs and measures are exact, at the case's own step."""

    REPORT = "tuning.report.optimal_input"

    case: Any
    objective: dict
    cost: float
    measures: dict
    u: np.ndarray
    interval: float
    constraints: list
    holds: bool
    closed_loop: dict | None
    source: str
    grids: list
    slope: float
    iterations: int
    gradients: int
    simulations: int
    interrupted: bool
    wall_s: float

    @property
    def gain_percent(self) -> float | None:
        """Most that another controller could save [% of the cost of the case's own]."""
        if (
            self.closed_loop is None
            or not self.closed_loop["holds"]
            or not self.holds
            or self.closed_loop["cost"] <= 0
        ):
            return None
        return 100.0 * (1.0 - self.cost / self.closed_loop["cost"])

    @property
    def worst(self) -> dict[str, Any] | None:
        """The constraint with the least margin as a share of its limit, None without limits."""
        return min(
            self.constraints, key=lambda c: c["margin"] / (abs(c["limit"]) or 1.0), default=None
        )

    def trajectory(self, save_every: int = 1) -> Trajectory:
        """Return the run with these inputs, as `jaxtank.simulate` does."""
        loop = open_loop(self.case.loop, self.u.T, self.interval)
        return lp.simulate(loop, self.case.clock, save_every=save_every)


def bound(
    case: Case,
    objective: Mapping[str, float] | None = None,
    limits: Mapping[str, Any] | None = None,
    *,
    interval: float | None = None,
    iterations: int = 200,
    progress: Callable | None = None,
) -> InputBound:
    """Compute the perfect-information open-loop optimum: a lower bound on any controller's cost.

        min over u_1 .. u_K in [low, high] of  sum_m weight_m measure_m(run with u)   under the
        limits, at every sample

    The search starts from the inputs of the case's own controller and from those of steady state,
    with exact gradients by reverse mode at a coarser clock, and holds limits on levels by one
    multiplier per sample (augmented Lagrangian). The result is checked, and its limits tightened
    until they hold, at the case's own step.

    It is a numerical optimum of a non-convex problem, not a certificate. A controller that samples
    faster than the interval may have a lower cost; if the case's own has, its inputs are the
    result. Dead zone, lag and delay act on the inputs as on those of a controller; sensor noise is
    left out. Ctrl-C ends the search with the best inputs so far.

    Parameters
    ----------
    case : Case
    objective : mapping, optional
        {measure: weight} as in `tune`; the case's own by default.
    limits : mapping, optional
        {measure: value} as in `tune`; the case's own by default.
    interval : float, optional
        For which each input is held [s], a whole number of the case's samples; by default for 600
        to 1200 intervals, where the case has as many samples.
    iterations : int
        Most iterations of L-BFGS in each round.
    progress : callable, optional
        Called with a dict after every round.

    Returns
    -------
    InputBound

    Raises
    ------
    InputError
        For measures that are maxima, times or counts: they have no derivative by every input
        (levels and errors may be limited, not minimised).
    NonFiniteError
        Where neither start gives a run that stays finite.

    Examples
    --------
    >>> import jax, tuning
    >>> from jaxtank import presets
    >>> jax.config.update("jax_enable_x64", True)
    >>> case = presets.load("gouta2015").cases["backstepping"]
    >>> result = tuning.bound(case)  # doctest: +SKIP
    >>> result.holds, result.cost < result.closed_loop["cost"]  # doctest: +SKIP
    (True, True)
    """
    began = time.perf_counter()
    problem = InputProblem(case, objective, limits, interval)
    search = InputSearch(problem, iterations, progress)
    interrupted = False
    try:
        search.run()
    except KeyboardInterrupt:
        interrupted = True
    found, source, closed = search.best, "search", search.closed
    if closed is not None and (
        found is None
        or (closed["holds"] and (not found["holds"] or closed["cost"] < found["cost"]))
    ):
        found, source = closed, "closed loop"
    if found is None:
        raise NonFiniteError(
            "neither the case's own inputs nor those of steady state give a run that stays finite"
        )
    shared = ("cost", "holds", "constraints")
    return InputBound(
        case=case,
        objective=problem.objective,
        **{name: found[name] for name in (*shared, "u", "interval")},
        measures=_measures(case, found),
        closed_loop=None if closed is None else {name: closed[name] for name in shared},
        source=source,
        grids=search.grids,
        slope=search.slope,
        iterations=search.iterations,
        gradients=search.gradients,
        simulations=search.simulations,
        interrupted=interrupted,
        wall_s=time.perf_counter() - began,
    )


def _measures(case, found):
    """Return {name: value} of the measures that are defined for the run with the inputs found."""
    loop = open_loop(case.loop, found["u"].T, found["interval"])
    names = tuple(m for m in ms.reported() if ms.serves(m, loop) and m != "estimation_rms")
    return {m: np.asarray(v) for m, v in lp.evaluate(loop, case.clock, names).items()}

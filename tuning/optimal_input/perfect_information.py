"""bound: what no law could beat. The best inputs one can find for a case when the whole run is
known in advance.
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
from tuning.optimal_input.cost import open_loop
from tuning.optimal_input.search import InputSearch
from tuning.problem.result import Shown


@dataclasses.dataclass(frozen=True, kw_only=True, repr=False)
class InputBound(Shown):
    """What `bound` found; costs and measures are exact, at the case's own step. `print(result)` for
    a table, `to_json()` for a dict.

    cost: weighted sum of `objective`; measures: {name: value} of every measure that has a meaning
    without a law; u: (intervals, pumps) inputs [V], each held for `interval` [s]; constraints: one
    dict per limit with value, margin, tank and time; holds: True if each limit holds to 3e-5 of it;
    closed_loop: {cost, holds, constraints} of the case's own law on the same run without noise, or
    None where it does not stay finite; source: "search", or "closed loop" where no search went
    below the law itself, whose inputs are then given; grids: {interval, cost, excess} of each grid,
    coarse to fine; slope: largest slope of the search's cost (scaled to 1) per share of an input's
    range, of those that are free to move; iterations of L-BFGS, gradients and simulations: what it
    took.
    """

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
    def gain_percent(self):
        """By how much the case's own law could still be improved on, at most [% of its cost]; None
        where it breaks a limit or is not finite.
        """
        if (
            self.closed_loop is None
            or not self.closed_loop["holds"]
            or not self.holds
            or self.closed_loop["cost"] <= 0
        ):
            return None
        return 100.0 * (1.0 - self.cost / self.closed_loop["cost"])

    @property
    def worst(self):
        """The constraint with the least margin as a share of its limit, or None where there is
        none.
        """
        return min(
            self.constraints, key=lambda c: c["margin"] / (abs(c["limit"]) or 1.0), default=None
        )

    def trajectory(self, save_every=1):
        """The run with the inputs found, as `jaxtank.simulate` gives it."""
        return lp.simulate(
            open_loop(self.case.loop, self.u.T, self.interval),
            self.case.clock,
            save_every=save_every,
        )

    def to_json(self):
        """A dict of plain numbers, without the inputs and the case."""
        return {
            "cost": self.cost,
            "objective": self.objective,
            "measures": {m: _plain(v) for m, v in self.measures.items()},
            "constraints": self.constraints,
            "holds": self.holds,
            "closed_loop": self.closed_loop,
            "gain_percent": self.gain_percent,
            "source": self.source,
            "interval_s": self.interval,
            "intervals": len(self.u),
            "grids": self.grids,
            "slope": _plain(self.slope),
            "evaluations": {
                "simulations": self.simulations,
                "gradients": self.gradients,
                "iterations": self.iterations,
            },
            "interrupted": self.interrupted,
            "wall_s": self.wall_s,
            "note": NOTE,
        }

    def text(self):
        """What was found, in words and numbers."""
        terms = " + ".join(f"{w:g} {m}" if w != 1 else m for m, w in self.objective.items())
        lines = [
            f"bound: {terms} = {self.cost:.6g} with the best inputs found, each held for"
            f" {self.interval:g} s ({len(self.u)} intervals)"
        ]
        if self.closed_loop is None:
            lines.append("the case's own law does not stay finite on this run")
        else:
            state = (
                ""
                if self.closed_loop["holds"]
                else ", which breaks a limit: the two cannot be compared"
            )
            gain = (
                ""
                if self.gain_percent is None
                else f": another law could take off at most {self.gain_percent:.3g} %"
            )
            lines.append(
                f"the case's own law, without noise: {self.closed_loop['cost']:.6g}{gain}{state}"
            )
        if self.source == "closed loop":
            lines.append("no search went below the law itself: its own inputs are the bound")
        worst = self.worst
        if worst is not None:
            when = "" if worst["time_s"] is None else f" at {worst['time_s']:.2f} s"
            verdict = "held" if self.holds else "NOT HELD"
            lines.append(
                f"limits {verdict}; tightest: {worst['name']} {worst['value']:.6g} against"
                f" {worst['limit']:g}{when}"
            )
        grids = ", ".join(f"{g['cost']:.6g} ({g['interval_s']:g} s)" for g in self.grids)
        lines.append(f"by interval: {grids}; largest free slope {self.slope:.1e}")
        lines.append(
            f"{self.gradients} gradients, {self.simulations} simulations, {self.wall_s:.1f} s"
            + "; INTERRUPTED" * self.interrupted
        )
        return "\n".join([*lines, NOTE])

    __repr__ = text


NOTE = (
    "a numerical optimum of a problem with more than one, on a grid of inputs, for a run known in"
    " advance and without noise: not a certificate"
)


def bound(
    case: Case,
    objective: Mapping[str, float] | None = None,
    limits: Mapping[str, Any] | None = None,
    *,
    interval: float | None = None,
    iterations: int = 200,
    progress: Callable | None = None,
) -> InputBound:
    """The inputs that make a case's cost smallest when the whole run is known in advance: what no
    law could beat.

        min over u_1 .. u_K in [low, high] of  sum_m weight_m measure_m(run with u)   under the
        limits, at every sample

    case: presets Case; objective: {measure: weight} and limits: {measure: value}, as `tune` takes
        them, the case's own where None;
    interval: for which each input is held [s], a whole number of the case's samples, or None for
    600 to 1200 intervals where the case has as many samples; iterations: of L-BFGS in each round;
    progress: called with a dict after every round. The
    inputs are what the pumps are told: dead zone, lag and delay act on them as on a law's. Ctrl-C
        ends the search with the best so far.

    The search starts from the law's own inputs and from those of steady state, takes exact
    gradients by reverse mode at a coarser clock, and holds limits on levels by one multiplier per
    sample (augmented Lagrangian); the result is checked, and its limits tightened until they hold,
    at the case's own step. It is a numerical optimum of a non-convex problem, not a certificate; a
    law that samples faster than the interval may go below it by what the grid costs, and if the
    case's own law does, its inputs are the
    result. Sensor noise is left out: an input that knows the future needs no sensor. Returns an
    InputBound. Raises InputError for measures that are maxima, times or counts: they have no slope
    to follow (levels and errors may be limited, not made small).
    """
    began = time.perf_counter()
    search = InputSearch(case, objective, limits, interval, iterations, progress)
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
            "neither the law's own inputs nor those of steady state give a run that stays finite"
        )
    shared = ("cost", "holds", "constraints")
    return InputBound(
        case=case,
        objective=search.objective,
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


def _plain(value):
    """A number or a list of numbers; None for what is not finite (never settled, no change to
    follow).
    """
    value = np.asarray(value, dtype=float)
    return (
        [_plain(v) for v in value] if value.ndim else float(value) if np.isfinite(value) else None
    )


def _measures(case, found):
    """{name: value} of what can be said of the run with the inputs found."""
    loop = open_loop(case.loop, found["u"].T, found["interval"])
    names = tuple(
        m for m in ms.MEASURES if ms.serves(m, loop) and m not in ("estimation_rms", *ms.times())
    )
    return {m: np.asarray(v) for m, v in lp.evaluate(loop, case.clock, names).items()}

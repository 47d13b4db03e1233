"""The TuningResult of a default answer; imported by `recommend`."""

import numpy as np

from tuning.answer.answer import Answer
from tuning.answer.judged import Judged
from tuning.answer.stay_put import Found
from tuning.problem.problem import Problem
from tuning.problem.provenance import provenance
from tuning.problem.status import Status
from tuning.search import diagnostics
from tuning.search.kkt import named_optimality
from tuning.search.result import ConstraintRow, TuningResult, row_of
from tuning.uncertainty.validation import summary_of


def result_of(
    answer: Answer, found: Found, problem: Problem, values: dict[str, float], validation: int
) -> TuningResult:
    """Return the TuningResult of an Answer, without messages."""
    setting, search = answer.setting, found.search
    tuned, point = setting.tuned(values), found.point
    summary, cloud = _validation(answer, problem) if validation else (None, None)
    first = search.point(problem.start()) if search is not None else None
    tables = {
        side: [] if p is None else list(p.measures)
        for side, p in {"before": first, "after": point}.items()
    }
    return TuningResult(
        case=setting.case,
        tuned=tuned,
        method="default answer",
        status=_status(answer, found),
        parameters=_parameters(problem, found, values),
        objective={"before": _mean(answer.before), "after": _mean(answer.after)}
        | {"terms": dict(setting.objective)},
        measures=dict(answer.measures),
        tables=tables,
        constraints=_rows(answer, problem),
        symmetry=None,
        evaluations={
            "simulations": problem.simulations,
            "gradients": problem.gradients,
            "non_finite": problem.non_finite,
            "redone_at_true_step": 0,
        },
        wall_s=0.0,
        history=search.history if search else [],
        starts=found.starts,
        optimality=named_optimality(search, point),
        curvature=None,
        validation=summary,
        cloud=cloud,
        provenance=provenance(setting.case, problem.seed),
        problem=problem,
        lost=answer.lost,
        answer=answer,
        slopes=found.slopes,
    )


def _mean(judged: Judged | None) -> float:
    """Return the mean cost of the plants whose run is finite; NaN where there is none."""
    if judged is None or judged.failed.all():
        return float("nan")
    return float(np.mean(judged.cost[~judged.failed]))


def _status(answer, found):
    """Return how the search ended, and whether its answer holds where it was judged."""
    if found.interrupted:
        return Status.INTERRUPTED
    if found.point is None or answer.after is None:
        return Status.NOT_CONVERGED
    if not answer.held:
        return Status.INFEASIBLE
    return Status.CONVERGED if found.agreed and not answer.lost else Status.NOT_CONVERGED


def _parameters(problem, found, values):
    """Return {name: values before and after, range, sensitivity} of the parameters."""
    own, point = problem.own_values(), found.point
    change: list[float | None] = [None] * len(own)
    if point is not None and not found.interrupted:
        change = _sensitivities(problem, point.z)
    idle = np.zeros(len(own), dtype=bool) if found.idle is None else found.idle
    rows = {}
    for i, b in enumerate(problem.bounds):
        z = float(b.to_unit(values[b.name]))
        rows[b.name] = {
            "before": own[b.name],
            "after": values[b.name],
            "unit": b.unit,
            "lower": b.low,
            "upper": b.high,
            "at_bound": "lower" if z < 1e-6 else "upper" if z > 1 - 1e-6 else None,
            "sensitivity_percent": change[i],
            "exercised": not idle[i],
        }
    return rows


def _sensitivities(problem, z):
    """Return the change of the cost [%] for 10 % of each parameter."""
    return diagnostics.sensitivities(problem.screen(diagnostics.neighbours(problem, z))[0])


def _rows(answer: Answer, problem: Problem) -> list[ConstraintRow]:
    """Return a ConstraintRow for each limit: its worst value on the plants that judged."""
    if answer.after is None:
        return []
    before, samples = answer.before.worst(), answer.after.samples
    return [
        row_of(
            row["limit"],
            problem,
            row["value"],
            before=old["value"],
            scenario=f"the worst of {samples} plants",
        )
        for row, old in zip(answer.after.worst(), before)
    ]


def _validation(answer, problem):
    """Return (summary, cloud) of the plants that judged, as `validation.summary_of`."""
    if answer.after is None:
        return None, None
    sides, setting = (answer.before, answer.after), answer.setting
    cost, held, level = (
        np.stack([getattr(s, n) for s in sides], axis=1) for n in ("cost", "held", "level")
    )
    failed = sides[0].failed | sides[1].failed
    spread = {n: getattr(d, "relative", None) for n, d in setting.distributions.items()}
    judged = Problem(setting.case, problem.given["free"], setting.objective, None, ())
    return summary_of(judged, cost, held, level, failed, spread, True)

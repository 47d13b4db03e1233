"""What a log leaves open, decided by what the data fit: inputs between rows, and whether the rig's
inflow that varies acted.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from tuning.identification import diagnosis, moments as between_rows
from tuning.identification.data_checks import assuming, with_steps
from tuning.identification.experiment import Log
from tuning.identification.least_squares import Fit, solve
from tuning.identification.problem import Estimation
from tuning.identification.residuals import is_white, residuals_of, rms_of
from tuning.identification.simulation import substeps_for, time_between, varies

LATE = {"pump-delay", "pump-lag"}  # kinds of causes that inputs between irregular rows resemble
LARGE = 1.5  # mean square of white residuals, in noise, that may have a reason
LARGER = 1.15  # RMS residual with moments, in that of white ones without, that no moments explain
CLEAR = 10.0  # twice the difference of log likelihoods from which an assumption is preferred


class Assumption(NamedTuple):
    """What inputs do between rows, where not as in the log, and whether the inflow acts."""

    inputs: str  # "", "steps" in place of lines, "moments", or "rows" where these are not told
    inflow: bool
    early: Any = None  # (samples, pumps) of the moments, as in Log

    def applied(self, log: Log, case: Any) -> Log:
        """Return the Log under this assumption."""
        log = with_steps(log) if self.inputs == "steps" else log
        log = assuming(log, "inputs", "rows") if self.inputs == "rows" else log
        if self.inputs in ("rows", "moments") and between_rows.turns_back(log):
            log = assuming(log, "loop", "fast")
        if self.inputs == "moments":
            log = assuming(log, "inputs", "moments")
            log = dataclasses.replace(log, hold="zero-order", early=self.early)
        if not varies(case.loop.disturbance):
            return log
        dated = time_between(case.begins, log) is not None
        acts = "acts by date" if dated else "acts"
        return assuming(log, "inflow", acts if self.inflow else "left out")


class Choice(NamedTuple):
    """Two assumptions on a log of a controller, of which one fits clearly better or not."""

    rows: Assumption
    moments: Assumption
    evidence: float  # for rows: twice the difference of log likelihoods


def open_assumptions(case: Any, log: Log, acts: bool = False) -> list[Assumption]:
    """Return the assumptions that a Log leaves open, that of the least change first; acts: the
    inflow is known to act. (Moments of changes are `_moments`.)
    """
    lines, varying = log.assumed.get("inputs") == "lines", varies(case.loop.disturbance)
    inflows = [varying] if acts or not varying else [False, True]
    return [Assumption(s, i) for i in inflows for s in (["", "steps"] if lines else [""])]


def named(assumption: Assumption, log: Log, case: Any) -> Assumption:
    """Return an Assumption that says of a controller between the rows that it is not told."""
    if log.hold or assumption.inputs or not between_rows.acts_between(log, case):
        return assumption
    return assumption._replace(inputs="rows")


def needs_inflow(case: Any, logs: Sequence[Log], options: Any) -> bool:
    """Whether a simulation is finite only with the inflow that varies: a tank may run empty."""
    if not varies(case.loop.disturbance):
        return False
    alone = Estimation(case, logs, **{**options, "substeps": 1, "inflow": False})
    z = alone.nominal()
    at = (alone.rig_at(z), alone.data, alone.first_levels(z))
    return not np.all(np.isfinite(substeps_for(*at, error=np.inf)[1]))


def best_assumptions(
    estimation: Estimation,
    fit: Fit,
    logs: Sequence[Log],
    options: Any,
    acts: bool = False,
    moments: bool = False,
    **settings: Any,
) -> list[Assumption]:
    """Return for each Log the first of its `open_assumptions` that no later one fits clearly
    better, from the Fit of an Estimation; moments: or inputs that change between its rows.
    """
    case, best = estimation.case, list[Assumption | Choice]()
    for e, log in enumerate(logs):
        every, alone = open_assumptions(case, log, acts), estimation.of_log(e)
        z = np.concatenate([fit.p, fit.levels[e] / alone.level_scale])
        count, misfit = int(alone.mask.sum()), None
        if len(every) > 1:
            fits = [_fit(alone, z, a, log, options, settings) for a in every]
            chosen = _preferred([value for value, _ in fits], count)
            every, misfit = [every[chosen]], fits[chosen]
        if moments and settings.get("loss") == "linear" and between_rows.are_open(log, case):
            misfit = misfit or _fit(alone, z, every[0], log, options, settings)
            every = [_moments(misfit, every[0], log, settings)]
        elif moments:
            every = [named(every[0], log, case)]
        best.append(every[0])
    # parts of a log are alike: chance would decide for each of them
    parts = sum(
        choice.evidence
        for log, choice in zip(logs, best)
        if isinstance(choice, Choice) and "parts" in log.assumed
    )
    return [_chosen(a, parts if "parts" in log.assumed else None) for a, log in zip(best, logs)]


def _chosen(choice, evidence):
    """The Assumption of a Choice, by its own evidence or another one."""
    if not isinstance(choice, Choice):
        return choice
    evidence = choice.evidence if evidence is None else evidence
    return choice.rows if evidence > CLEAR else choice.moments


def _evidence(before, after, readings):
    """Twice the difference of log likelihoods, of half sums of squares before and after."""
    return readings * float(np.log(before / max(after, 1e-300))) if np.isfinite(after) else -np.inf


def _clear(before, after, readings):
    """Whether half a sum of squares is clearly less than another."""
    return _evidence(before, after, readings) > CLEAR


def _preferred(misfits, readings):
    """The first assumption that no later one fits clearly better."""
    best = 0
    for k, value in enumerate(misfits):
        best = k if _clear(misfits[best], value, readings) else best
    return best


def _moments(misfit, other, log, settings):
    """The Assumption of changes between rows, if the residual of another is more than noise, and
    it does not fit as well, nor with the causes that a diagnosis finds; of a controller that acts
    between the rows a Choice, where moments leave noise.
    """
    value, (alone, fit) = misfit
    count = int(alone.mask.sum())
    if fit is None:
        return other
    between = between_rows.acts_between(log, alone.case)
    noise_alone = value < LARGE * 0.5 * count and _is_white(alone, fit)
    # estimates may hide that the inputs of a controller come late
    if noise_alone and not between_rows.of_controller(log):
        return other
    z = alone.unknowns(fit)
    of_moments, moved, rms = between_rows.misfit(alone, z, log, **settings)
    if between and not np.isfinite(of_moments):
        return other._replace(inputs="rows")
    if between:
        evidence = _evidence(of_moments, value, count)
        return Choice(other, Assumption("moments", other.inflow, moved.early), evidence)
    # of a controller at the rows, moments explain noise of the readings, which its inputs have too
    larger = noise_alone and bool(np.any(rms > LARGER * rms_of(alone, fit)))
    if larger or not _clear(value, of_moments, count):
        return other
    by_causes, kinds = diagnosis.explained(alone, z)
    # later than a row is a dead time or a lag; than lines between irregular rows none
    late = kinds & LATE and not (log.assumed.get("inputs") == "lines" and kinds <= LATE)
    if late:
        better = _clear(by_causes, of_moments, count)
    else:
        better = not _clear(of_moments, by_causes, count)
    if better:
        return Assumption("moments", other.inflow, moved.early)
    return other


def _is_white(alone, fit):
    return all(is_white(r) for r in np.moveaxis(residuals_of(alone, fit), -1, 0))


def _fit(alone, z, assumption, log, options, settings):
    """(Half the weighted sum of squares of the readings, without a prior, or the cost of a robust
    loss; (the Estimation of the log, its Fit or None where it diverged)).
    """
    same = {"noise": alone.noise, "substeps": alone.substeps, "inflow": assumption.inflow}
    logs = [assumption.applied(log, alone.case)]
    other = Estimation(alone.case, logs, **{**options, **same})
    fits = [solve(other, start, **settings) for start in (z, other.nominal())]
    linear = all(fit.loss == "linear" and np.isfinite(fit.cost) for fit in fits)
    costs = [0.5 * float(np.sum(fit.residual**2)) if linear else fit.cost for fit in fits]
    best = fits[int(np.argmin(costs))]
    return min(costs), (other, best if np.isfinite(best.cost) else None)

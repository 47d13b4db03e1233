"""The sentences about a default answer; imported by `recommend`.

===============================  =============================================================
code                             reported when
===============================  =============================================================
step-too-long                    the integration step is too long for the answer
edge-of-stability                the sampled linearised loop is unstable or has Ms above 2.5
sensitivity-peak                 the linearised loop is less robust than before, Ms above PEAK
input-total-variation            the inputs change ten times as much per sample as before, or more
interrupted                      Ctrl-C ended the search
limit-violated-out-of-sample     a limit is violated on a validation plant
no-longer-follows                the answer leaves a setpoint that the start held
not-converged                    searches disagree, and differential evolution found better points
slope-not-usable                 runs beside the answer or the start contradict the exact slope
limit-not-certified              the safety filter is on, and a limit is not proved
parameter-not-exercised          no run depends on the parameter
parameter-at-bound               the value ended at an end of its range
constraints-tightened            limits were tightened for the search, to hold on other plants
noise-assumed                    the case states no sensor noise
plants-assumed                   the case does not say what is uncertain
limit-idle                       no plant comes near a limit on a level
===============================  =============================================================
"""

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from jaxtank.core.tree import parameters
from tuning.answer.answer import Answer
from tuning.answer.setting import SPREAD
from tuning.problem.status import Status
from tuning.problem.wording import numbered
from tuning.search.result import Message, TuningResult
from tuning.search.verdicts import FRAGILE, near_the_edge, slope_not_usable

Found = Iterator[Message]

PEAK = 2.0
"""Sensitivity peak above which a loop that became less robust is reported [-]."""

BUSIER = 10.0
"""Growth of the rms change of the inputs per sample above which it is reported [-]."""


def findings_of(result: TuningResult, steps: Iterable[str] = ()) -> tuple[Message, ...]:
    """Return the findings about a default answer, most important first."""
    first = [Message("step-too-long", text) for text in steps]
    answer: Answer = result.answer
    return (*first, *(m for rule in RULES for m in rule(result, answer)))


def _interrupted(result, answer) -> Found:
    if result.status == Status.INTERRUPTED:
        words = "not yet validated" if answer.after is None else "of the search before this one"
        yield Message("interrupted", f"interrupted: these are the best gains so far, {words}")


def _violated(result, answer) -> Found:
    if answer.after is None or answer.held:
        return
    worst = [row for row in result.constraints if row.margin < 0]
    parts = [f"{c.name} is {c.amount()}, limit {c.limit:.4g} {c.unit}" for c in worst[:4]]
    if answer.after.failed.any():
        parts.append(f"{int(answer.after.failed.sum())} runs diverged")
    remedy = (
        "a limit that is not proved may be violated on some plants; try other --free ranges, or a"
        " limit that leaves more margin"
    )
    if answer.setting.filter is None and any(c.measure == "max_level" for c in worst):
        remedy = "--safety-filter keeps levels below their limits"
    yield Message(
        "limit-violated-out-of-sample",
        f"limits hold on {int(answer.after.held.sum())} of {answer.after.samples}"
        f" {answer.setting.runs}"
        f" ({'; '.join(parts)}): {remedy}",
    )


def _lost(result, answer) -> Found:
    for row in answer.lost:
        yield Message(
            "no-longer-follows",
            f"output {row.output} no longer follows its setpoint: at the end of a plateau it is"
            f" {row.after:.3g} {row.unit} off, {row.before:.3g} {row.unit} before",
        )


def _not_agreed(result, answer) -> Found:
    if result.status != Status.INTERRUPTED and not answer.agreed:
        yield Message(
            "not-converged",
            "no two of the local searches ended within 1 % of each other, and differential"
            " evolution found better points: raise --starts or --iterations, or narrow the ranges"
            " (--free)",
        )


def _slopes(result, answer) -> Found:
    yield from slope_not_usable(result)


def _certificates(result, answer) -> Found:
    for row in answer.setting.certificates:
        if not row.certified:
            yield Message(
                "limit-not-certified",
                f"the limit of tank {row.tank + 1} is not proved: {row.reason}",
            )


def _idle(result, answer) -> Found:
    if answer.idle:
        tanks = numbered("tank", answer.idle)
        yield Message(
            "limit-idle", f"no plant comes within 10 % of the limit on the level of {tanks}"
        )


def _bounds(result, answer) -> Found:
    for name in result:
        p = result[name]
        if not p.exercised:
            yield Message(
                "parameter-not-exercised",
                f"{name} has no effect in any run and is left at {p.after:g} {p.unit}",
            )
        elif p.at_bound:
            end = p.lower if p.at_bound == "lower" else p.upper
            yield Message(
                "parameter-at-bound",
                f"{name} ended at its {p.at_bound} bound {end:g} {p.unit}: a wider range (--free)"
                " may give more",
            )


def _busier(result, answer) -> Found:
    if answer.after is None or answer.after.failed.all():
        return
    old, new = (float(np.nanmean(side.travel)) for side in (answer.before, answer.after))
    if new > BUSIER * old > 0:
        yield Message(
            "input-total-variation",
            f"the rms change of the inputs per sample is {100 * new:.2g} % of their range,"
            f" {new / old:.0f} times that before",
            f"inputs change {new / old:.0f} times as much as before",
        )


def _less_robust(result, answer) -> Found:
    yield from near_the_edge(result)
    peaks = [float(m.get("sensitivity_peak", np.nan)) for m in answer.measures.values()]
    if len(peaks) == 2 and max(PEAK, 1.05 * peaks[0]) < peaks[1] <= FRAGILE:
        yield Message(
            "sensitivity-peak",
            f"the sensitivity peak of the linearised loop is {peaks[1]:.3g}, {peaks[0]:.3g} before:"
            f" --limit sensitivity_peak={PEAK:g} bounds it",
        )


def _assumed(result, answer) -> Found:
    setting = answer.setting
    if setting.assumed:
        unit = setting.case.loop.units[0]
        yield Message(
            "noise-assumed",
            f"sensor noise of {setting.noise:.3g} {unit} is assumed (0.1 % of the height; --set"
            " sensor.noise)",
        )
    if not setting.plants_vary:
        plant = [f'"{n}"' for n in parameters(setting.case.loop) if n.startswith("plant.")]
        yield Message(
            "plants-assumed",
            "nothing of this plant is known to vary, so that nothing is claimed on other plants:"
            f" name it in `uncertain`, as {{{plant[0] if plant else 'NAME'}: 0.05}} for +-5 %, or"
            f" with --vary (of {', '.join(plant)})",
        )
    elif not setting.stated:
        yield Message(
            "plants-assumed",
            f"the case names nothing uncertain: every flow is taken to be within"
            f" {100 * SPREAD:g} %; a table [uncertain] or --vary states it",
        )


def _tightened(result, answer) -> Found:
    if answer.tightened and not all(answer.kept.values()):
        yield Message(
            "constraints-tightened",
            f"the search tightened limits by up to {100 * answer.tightened:.2g} %, so that they"
            " hold on validation plants",
        )


RULES: tuple[Callable[..., Found], ...] = (
    _less_robust,
    _busier,
    _interrupted,
    _violated,
    _lost,
    _not_agreed,
    _slopes,
    _certificates,
    _bounds,
    _tightened,
    _assumed,
    _idle,
)

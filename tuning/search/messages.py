"""Findings about a tuning result as Messages: one small function for each, in the order of RULES.

The codes are stable: programs filter by them, and texts may change.

===============================  =============================================================
code                             reported when
===============================  =============================================================
step-too-long                    the integration step is too long for the answer
edge-of-stability                the sampled linearised loop is unstable or has Ms above 2.5
input-total-variation            the total variation of the inputs grew tenfold or more
no-longer-follows                the answer leaves a setpoint that the start held
no-feasible-point-found          the search ended before a point met every limit
infeasible                       the least violation of the limits is not zero
interrupted                      Ctrl-C ended the search
slope-not-usable                 runs beside the answer or the start contradict the exact slope
objective-without-slope          the gradient of the objective is zero: it changes in steps
gradient-not-zero                a slope of the objective is left that no active limit blocks
kink                             the same, but no lower value was found along it
not-converged                    no search converged
start-violates-limit             the values before tuning violate a limit
limit-not-applicable             an output has no step, so a limit of its step does not apply
limit-active                     a limit determines the answer
no-limit-active                  limits are given, and none is active
parameter-not-exercised          no run depends on the parameter
parameter-at-bound               the value ended at an end of its range
parameter-insensitive            10 % of the value hardly changes the objective
least-sensitive-direction        the smallest eigenvalue of the second derivative
nothing-better-found             differential evolution found nothing better than the answer
starts-agree                     how many searches ended at the answer
permutation-symmetry             exchanged gains give an equivalent answer
limit-violated-out-of-sample     a limit is violated on a validation plant
limits-hold-out-of-sample        no limit was violated on validation plants (`tune_robust`)
scenario-bound                   bound of the violation probability (`tune_robust`)
constraints-tightened            limits were tightened for the search (`back_off=`)
support-scenarios                violations on validation plants that were to be expected
screened-at-true-step            screening points were unstable at the coarse step only
non-finite-points                trial points gave non-finite numbers
best-of-choices                  which discrete choice is best (`choices=`)
choice-does-not-fit              a discrete choice that the rig cannot have, and why
no-rig-file                      no rig file describes the case (`save`)
===============================  =============================================================
"""

from collections.abc import Callable, Iterable

from jaxtank import measures as ms
from tuning.problem.wording import count
from tuning.search.diagnostics import direction_words, symmetry_words
from tuning.search.result import Message, TuningResult, constraint_rows
from tuning.search.stages import AGREE
from tuning.search.verdicts import ENDINGS, Found, first_of, near_the_edge, violated

INSENSITIVE = 0.5
"""Change of the objective [%] for 10 % of a parameter, below which the objective is called
insensitive to the parameter.
"""

CHATTER = 10.0
"""Growth of the total variation of the input above which it is reported [-]."""


def messages_of(result: TuningResult, steps: Iterable[str] = ()) -> tuple[Message, ...]:
    """Return the findings about a result, most important first."""
    first = [Message("step-too-long", text) for text in steps]
    return (*first, *(message for rule in RULES for message in rule(result)))


def _start_violates(result: TuningResult) -> Found:
    over = constraint_rows(result.problem, result.tables["before"])
    parts = [
        f"{c.name} {c.amount()}"
        if c.reason
        else f"{c.name} {c.value:.4g} of {c.limit:.4g} {c.unit}"
        for c in over
        if c.margin < 0
    ]
    if parts and not violated(result):
        yield Message(
            "start-violates-limit",
            f"the starting values violate a limit ({first_of(parts)}), so the"
            " objectives before and after do not compare",
        )


def _not_applicable(result: TuningResult) -> Found:
    """Entries of a limited measure that are undefined in every run."""
    limits, plant = result.problem.limits, result.problem.loop.plant
    for measure in dict.fromkeys(
        x.measure for x in limits if "window" in ms.refers_to([x.measure])
    ):
        limited = {limit.index for limit in limits if limit.measure == measure}
        for i in sorted(set(range(ms.entries(measure, plant))) - limited):
            yield Message(
                "limit-not-applicable",
                f"{measure} of output {i + 1} is not limited: the setpoint has no step",
            )


def _active(result: TuningResult) -> Found:
    for c in result.constraints:
        if c.active:
            when = f" at {c.time_s:.2f} s" if c.time_s is not None else ""
            yield Message(
                "limit-active",
                f"active limit: {c.name}{when} ({c.value:.7g} of {c.limit:.7g} {c.unit})",
            )
    if result.constraints and not any(c.active or c.margin < 0 for c in result.constraints):
        yield Message("no-limit-active", "no limit is active")


def _total_variation(result: TuningResult) -> Found:
    before, after = (float(result.measures[k]["input_travel"].sum()) for k in ("before", "after"))
    if after > CHATTER * before > 0:
        times = f"{after / before:.0f} times that before"
        unit = ms.unit("input_travel", result.problem.loop.units)
        yield Message(
            "input-total-variation",
            f"the total variation of the inputs is {after:.4g} {unit}, {times}: weigh it or"
            " limit it (--objective input_travel=..., --limit"
            " input_travel=...), or take a smaller step",
            f"total variation of the inputs {times}",
        )


def _not_exercised(result: TuningResult) -> Found:
    idle = [n for n in result if not result[n].exercised]
    if idle:
        kept = ", ".join(f"{n} {result[n].after:g} {result[n].unit}" for n in idle)
        yield Message(
            "parameter-not-exercised",
            f"{kept} {'has' if len(idle) == 1 else 'have'} no effect in any run: any value in the"
            " range gives the same run, so the start value is kept",
        )


def _at_bound_or_insensitive(result: TuningResult) -> Found:
    for name in result:
        p = result[name]
        change = p.sensitivity_percent
        insensitive = change is not None and change < INSENSITIVE
        changes = f"(10 % changes it by {change:.2g} %)" if insensitive else ""
        if not p.exercised:
            continue
        if p.at_bound:
            end = p.lower if p.at_bound == "lower" else p.upper
            yield Message(
                "parameter-at-bound",
                f"{name} ended at its {p.at_bound} bound {end:g} {p.unit}"
                + (f"; the objective is insensitive to it {changes}" if insensitive else ""),
            )
        elif insensitive:
            yield Message(
                "parameter-insensitive", f"the objective is insensitive to {name} {changes}"
            )


def _least_sensitive(result: TuningResult) -> Found:
    words = direction_words(result.problem, result.curvature) if result.curvature else ""
    if words:
        yield Message("least-sensitive-direction", words)


def _agreement(result: TuningResult) -> Found:
    feasible = [o["cost"] for o in result.starts if o["violation"] == 0.0]
    if not feasible:  # nothing to agree on
        return
    alike = sum(cost <= min(feasible) * AGREE for cost in feasible)
    searches = count(len(result.starts), "search")
    yield Message(
        "starts-agree", f"{alike} of {searches} ended within 0.1 % of the best objective found"
    )
    if result.symmetry and result.symmetry["objective"] is not None:
        words = symmetry_words(result.symmetry, result.objective["after"])
        yield Message("permutation-symmetry", words)


def _out_of_sample(result: TuningResult) -> Found:
    found = result.validation
    share = found["limits_held"]["after"] if found else None
    if found and share is not None and share < 1.0 and result.problem.limits:
        wanted = {x.measure for x in result.problem.limits if not result.problem.loop.safety_filter}
        caps = "--safety-filter keeps levels below their limits, " if "max_level" in wanted else ""
        runs = found["samples"] - found["failed"]
        yield Message(
            "limit-violated-out-of-sample",
            f"limits hold on {round(share * runs)} of {runs} validation plants:"
            f" {caps}--robust tunes for perturbed plants",
        )


def _screened_again(result: TuningResult) -> Found:
    redone = result.evaluations["redone_at_true_step"]
    if redone:
        yield Message(
            "screened-at-true-step",
            f"{count(redone, 'screening point')} diverged at the coarse step of the screening and"
            f" {'was' if redone == 1 else 'were'} run again at the case's own step: no action is"
            " needed",
        )


def _non_finite(result: TuningResult) -> Found:
    points = result.evaluations["non_finite"]
    if points:
        yield Message(
            "non-finite-points", f"{count(points, 'trial point')} gave non-finite numbers, rejected"
        )


RULES: tuple[Callable[[TuningResult], Found], ...] = (
    near_the_edge,
    _total_variation,
    *ENDINGS,
    _start_violates,
    _not_applicable,
    _active,
    _not_exercised,
    _at_bound_or_insensitive,
    _least_sensitive,
    _agreement,
    _out_of_sample,
    _screened_again,
    _non_finite,
)

"""Findings about a tuning result as Messages, in the order of RULES; codes: tuning/README.md."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from jaxtank import measures as ms
from jaxtank.core.labels import entry_label, label_of, labels_of
from jaxtank.core.text import count
from jaxtank.core.tree import parameters, split_index
from jaxtank.safety.of_case import SPREAD
from tuning.problem import reported
from tuning.problem.problem import DIVERGED
from tuning.problem.status import Status
from tuning.search.driver import SLOPING, UNSTABLE
from tuning.search.result import ConstraintRow, Message, TuningResult, constraint_rows
from tuning.search.robustness import FRAGILE, FRAGILITY_LIMIT, MT_WEIGHT, PEAKS
from tuning.search.setting import NEAR, scenarios_to_judge
from tuning.search.solve import AGREE, RENEWED

LISTED = 4  # limits that one message names at most

BOUNDS = {"sensitivity_peak": FRAGILITY_LIMIT, "complementary_peak": FRAGILITY_LIMIT / MT_WEIGHT}
"""Peaks above which a loop that became less robust is reported [-]."""

INSENSITIVE = 0.5  # change of the objective for 10 % of a parameter that is not felt [%]
GROWTH = 10.0  # reported growth of the inputs' total variation, or rms change [-]
FELT = 0.02  # rms change of inputs per sample below which no growth is reported [-]
BUSY = 0.2  # rms change of inputs per sample from which on they chatter, as a share of range [-]


def messages_of(result: TuningResult) -> tuple[Message, ...]:
    """Return the findings about a result, most important first; those on its step stay first."""
    first = [m for m in result.messages if m.code == "step-too-long"]
    those = (ANY, OPTIMUM if result.answer is None else ANSWER)
    rules = [(function, code) for function, of, code in RULES if of in those]
    found = ((code, m) for function, code in rules for m in function(result))
    return (*first, *(Message(code, m) if isinstance(m, str) else m for code, m in found))


def violated(result: TuningResult) -> list[ConstraintRow]:
    return [c for c in result.constraints if c.margin < 0]


def first_of(parts: list[str]) -> str:
    """Return the first LISTED parts, and how many more there are."""
    more = len(parts) - LISTED
    return ", ".join(parts[:LISTED]) + (f" (and {more} more)" if more > 0 else "")


def against_limit(c: ConstraintRow, digits: int = 6) -> str:
    return f"{c.name} is {c.amount()}, limit {c.limit:.{digits}g} {c.unit}"


ANY, OPTIMUM, ANSWER = "any", "optimum", "answer"
"""Results to which a rule applies: all; `--nominal` and `--robust`; default answers."""

Messages = Iterator[Message | str]

RULES: list[tuple[Callable[[TuningResult], Messages], str, str]] = []
"""Every (rule, results to which it applies, code of its texts), most important first."""


def rule(of: str, code: str = ""):
    """Add a function that yields texts with a code, or Messages, to RULES."""
    return lambda function: RULES.append((function, of, code)) or function


@rule(OPTIMUM)
def _on_new_plants(result: TuningResult) -> Messages:
    known = result.certificate
    if known is None:
        return
    (low, high), risk = known.interval95, result.problem.risk
    run = ", in the case's own run," if result.case.scenarios else ""
    yield Message(
        "limit-violated-out-of-sample" if known.broken else "limits-hold-out-of-sample",
        f"on {known.fresh} new plants{run} a limit was violated {known.broken} times (95 % interval"
        f" {low:.2g} to {high:.2g})",
    )
    indication = (
        f", an indication: plants at no limit change the {risk} too, and are not counted in it"
    )
    yield Message(
        "scenario-bound",
        f"by scenario theory, the probability is at most {known.bound:.2g} (confidence 1 -"
        f" 1e-6, support {known.support} of {known.scenarios} plants"
        f"{'' if risk == 'worst' else indication})",
    )
    if known.back_off:
        yield Message(
            "constraints-tightened",
            f"the search tightened every limit by {100 * known.back_off:g} %, new plants are judged"
            " by the limits themselves",
        )
    elif known.broken and known.support:
        expected = 100 * known.support / (known.scenarios + 1)
        yield Message(
            "support-scenarios",
            f"{known.support} of {known.scenarios} plants determine the answer: up to about"
            f" {expected:.2g} % of new plants were to be expected past a limit (more plants or"
            " a constraint tightening, --back-off 0.03, reduce both)",
        )


@rule(ANY)
def _near_the_edge(result: TuningResult) -> Messages:
    """The answer's linearised loop is unstable, or nearly so."""
    sides = (result.measures[side] for side in ("before", "after"))
    before, after = (float(m.get("sensitivity_peak", np.nan)) for m in sides)
    if not after > FRAGILE:  # NaN: it has none
        return
    unstable = np.isinf(after)
    where = "beyond the edge of sampled stability" if unstable else "near the edge of stability"
    peak = "the linearised loop is unstable" if unstable else f"Ms = {after:.3g}"
    step = "a smaller step or " * bool(unstable)
    old = "unstable" if np.isinf(before) else f"{before:.3g}"
    yield Message(
        "edge-of-stability",
        f"{where}: {peak} at a plateau, {old} before (sensitivity peak of the sampled loop, at most"
        f" 2 is usual): --limit sensitivity_peak=2 bounds it, {step}narrower ranges (--free) may"
        " help",
        f"{where} ({peak})",
    )


@rule(ANSWER, "sensitivity-peak")
def _less_robust(result: TuningResult) -> Messages:
    last = result.measures.get("after", {})
    if not last.get("sensitivity_peak", np.nan) <= FRAGILE:  # NaN: it has none
        return
    for name, bound in BOUNDS.items():
        before, after = (float(m.get(name, np.nan)) for m in result.measures.values())
        if after > max(bound, 1.05 * before):
            yield (
                f"the {ms.label(name)} of the linearised loop is {after:.3g}, {before:.3g} before:"
                f" --limit {name}={bound:.2g} bounds it"
            )


@rule(ANSWER, "margins-not-known")
def _margins_not_known(result: TuningResult) -> Messages:
    moved = any(p["before"] != p["after"] for p in result.parameters.values())
    if moved and np.isnan(float(result.measures.get("after", {}).get(PEAKS[0], np.nan))):
        yield (
            "the stability margins are not known at any plateau (jaxtank simulate --margins says"
            " why): the gains may be fragile, for no search could tell"
        )


@rule(ANSWER, "moved-back")
def _moved_back(result: TuningResult) -> Messages:
    if result.answer.least_cost_peaks is not None:
        Ms, Mt = result.answer.least_cost_peaks
        after = [float(result.measures["after"].get(name, np.nan)) for name in PEAKS]
        if np.allclose(after, [Ms, Mt], rtol=2e-3):  # other gains that are as robust
            return
        peaks = f"have Ms {Ms:.3g} and Mt {Mt:.3g}"
        if not np.isfinite(Ms):
            peaks = "make the linearised loop unstable"
        yield f"gains of least cost {peaks}: more robust ones were chosen"


@rule(OPTIMUM)
def _total_variation(result: TuningResult) -> Messages:
    before, after = (float(result.measures[k]["input_travel"].sum()) for k in ("before", "after"))
    if after > GROWTH * before > 0:
        times = f"{after / before:.0f} times that before"
        unit = ms.unit("input_travel", result.problem.loop.units)
        yield Message(
            "input-total-variation",
            f"the total variation of the inputs is {after:.4g} {unit}, {times}: weigh it or"
            " limit it (--objective input_travel=..., --limit"
            " input_travel=...), or take a smaller step",
            f"total variation of the inputs {times}",
        )


@rule(ANSWER)
def _busier(result: TuningResult) -> Messages:
    before, after = result.answer.before, result.answer.after
    if after is None or after.failed.all():
        return
    old, new = float(np.nanmean(before.travel)), float(np.nanmean(after.travel))
    if new > GROWTH * old > 0 and new > FELT:
        yield Message(
            "input-total-variation",
            f"the rms change of the inputs per sample is {100 * new:.2g} % of their range,"
            f" {new / old:.0f} times that before",
            f"inputs change {new / old:.0f} times as much as before",
        )


@rule(OPTIMUM, "input-chatters")
def _chatters(result: TuningResult) -> Messages:
    problem, values = result.problem, result.measures.get("after", {})
    yield from reported.chatter(problem.loop, problem.clock, values)


@rule(ANSWER, "input-chatters")
def _chatters_on_plants(result: TuningResult) -> Messages:
    after = result.answer.after
    if after is None or after.failed.all():
        return
    travel = float(np.nanmean(after.travel))
    if travel > BUSY:
        yield (
            f"the inputs chatter: their rms change per sample is {100 * travel:.2g} % of their"
            " range (a filter of the derivative or the sensor; --objective input_travel=...)"
        )


@rule(OPTIMUM, "no-feasible-point-found")
def _no_feasible_point(result: TuningResult) -> Messages:
    missed = violated(result)
    if result.status == Status.NOT_CONVERGED and missed:
        yield (
            "no point that meets every limit was found before the search ended"
            f" ({against_limit(missed[0])}): more --iterations,"
            " --starts or --screening may find one"
        )


@rule(OPTIMUM, "infeasible")
def _infeasible(result: TuningResult) -> Messages:
    if result.status != Status.INFEASIBLE:
        return
    scales = result.problem.limit_scales
    shares = [(c.margin / scale, c) for c, scale in zip(result.constraints, scales)]
    shares = sorted((pair for pair in shares if pair[0] < 0), key=lambda pair: pair[0])
    missed = [
        against_limit(c) + ("" if c.reason else f", missed by {-c.margin:.3g} {c.unit}")
        for _, c in shares
    ]
    share, worst = shares[0]
    text = f"no point was found that meets every limit: {first_of(missed)}"
    least = (
        f"; the largest violation, {-100 * share:.3g} % of its limit, is the least that was found"
    )
    yield text if worst.reason else text + least


@rule(ANY, "interrupted")
def _interrupted(result: TuningResult) -> Messages:
    if result.status == Status.INTERRUPTED:
        words = "this is the best point so far"
        if result.answer is not None:
            validated = result.answer.after is not None
            words = "of the search before this one" if validated else "not yet validated"
            words = f"these are the best gains so far, {words}"
        yield f"interrupted: {words}"


@rule(ANSWER, "limit-violated-out-of-sample")
def _violated_on_plants(result: TuningResult) -> Messages:
    answer = result.answer
    if answer.after is None or answer.held:
        return
    worst = violated(result)
    parts = [against_limit(c, 4) for c in worst[:LISTED]]
    if answer.after.failed.any():
        parts.append(f"{int(answer.after.failed.sum())} runs diverged")
    remedy = (
        "a limit that is not proved may be violated on some plants; try other --free ranges, or a"
        " limit that leaves more margin"
    )
    if answer.setting.filter is None and any(c.measure == "max_level" for c in worst):
        remedy = "--safety-filter keeps levels below their limits"
    yield (
        f"limits hold on {int(answer.after.held.sum())} of {answer.after.samples}"
        f" {answer.setting.runs} ({'; '.join(parts)}): {remedy}"
    )


@rule(ANY, "no-longer-follows")
def _no_longer_follows(result: TuningResult) -> Messages:
    remedy = (
        "the active limits force it: loosen them or change the setpoints (--limit, --set)"
        if any(c.active for c in result.constraints)
        else "weigh the error in the objective or narrow the ranges (--objective, --free)"
    )
    for x in result.lost:
        yield (
            f"output {x.output} no longer follows its setpoint: at the end of a plateau it is"
            f" {x.after:.3g} {x.unit} off ({100 * x.share:.3g} % of the setpoint change),"
            f" {x.before:.3g} {x.unit} before tuning; {remedy}"
        )


@rule(ANSWER, "not-converged")
def _not_agreed(result: TuningResult) -> Messages:
    ruled = not result.starts and result.method.startswith("rule ")
    if result.status != Status.INTERRUPTED and not result.answer.agreed and not ruled:
        yield (
            "no two of the local searches ended within 1 % of each other, and differential"
            " evolution found better points: raise --starts or --iterations, or narrow the ranges"
            " (--free)"
        )


@rule(ANY, "slope-not-usable")
def _slope_not_usable(result: TuningResult) -> Messages:
    """At the answer and at the values before tuning; once where these are the same."""
    places = {"answer": "the answer", "start": "the values before tuning"}
    same = all(p["before"] == p["after"] for p in result.parameters.values())
    for where, words in places.items():
        check = result.slopes.get(where)
        if check is None or check.usable or (same and where == "start"):
            continue
        role = "judged the answer" if where == "answer" else "searched on"
        times = (
            "is not finite" if check.orders is None else f"is 1e{check.orders:.0f} times as large"
        )
        yield (
            f"at {words} the loop is chaotic or unstable: runs near this point give"
            f" a slope of the objective of {check.secants[0]:.2g} per range of a parameter, the"
            f" exact derivative {times}; it was not used: other starts and differential evolution"
            f" {role}"
        )


@rule(ANSWER, "limit-not-certified")
def _certificates(result: TuningResult) -> Messages:
    for tank, reasons in result.answer.open_limits().items():
        place = label_of(result.problem.loop.plant, "tank", tank)
        sides = ("low limit" if measure == "min_level" else "limit" for measure in reasons)
        # of a highest level and of the overflow at the same rim once
        for limit, reason in dict.fromkeys(zip(sides, reasons.values())):
            yield f"the {limit} of {place} is not proved: {reason}"


def _flat(result: TuningResult) -> bool:
    """Return True if the gradient is exactly zero at an objective that is not."""
    return result.optimality["gradient_norm"] == 0.0 and result.objective["after"] != 0.0


@rule(OPTIMUM, "objective-without-slope")
def _without_slope(result: TuningResult) -> Messages:
    if result.status != Status.INFEASIBLE and _flat(result):
        yield (
            "the gradient of the objective is zero here: the objective changes in steps, as times"
            " and counts do, and a search by gradients cannot show that this is its minimum; add a"
            " smooth measure to the objective"
        )


@rule(OPTIMUM)
def _gradient_left(result: TuningResult) -> Messages:
    residual, kink = result.optimality["kkt_residual"], result.status == Status.CONVERGED
    ended = kink or result.status == Status.NOT_CONVERGED
    if _flat(result) or not ended or violated(result):
        return
    if residual is not None and residual > SLOPING:
        why = "a kink, because no lower value was found along it within the limits"
        yield Message(
            "kink" if kink else "gradient-not-zero",
            "the objective has a slope in a direction that no active limit blocks (KKT residual"
            f" {residual:.2g} of the objective per range of a parameter):"
            f" {why if kink else 'not yet an optimum'}",
        )


@rule(OPTIMUM, "not-converged")
def _not_converged(result: TuningResult) -> Messages:
    """Why a search that violates no limit did not converge, and the remedy."""
    zero, probe = result.optimality["gradient_norm"] == 0.0, result.probe or {"lower": 0}
    ended = result.status != Status.NOT_CONVERGED or bool(result.lost)
    if ended or violated(result) or zero:
        return
    check = result.slopes.get("answer")
    useless = check is not None and not check.usable
    reasons = (
        (
            all(not np.isfinite(violation) for _, _, violation, _ in result.history),
            f"no search could begin: the objective, a limit or a derivative exceeds {DIVERGED:.0e}"
            " at every point that was tried, as where noise and delay make the loop unstable;"
            " start from other values (--set) or narrow the ranges (--free)",
        ),
        (
            useless or (result.optimality["kkt_residual"] or 0.0) >= UNSTABLE,
            "the run at this point is unstable or chaotic (noise and delay with a high gain can"
            " cause this), and the objective is not lower along its gradient; try more --starts, or"
            " other ranges (--free)",
        ),
        (
            any(start["exhausted"] for start in result.starts),
            "no search met the conditions of an optimum before its iterations were used up: raise"
            " --iterations, or try other starts",
        ),
        (
            probe["lower"] >= RENEWED,
            f"{probe['lower']} searches from points of differential evolution each ended"
            " lower than what was found before, and there may be better points still: raise"
            " --starts and --screening",
        ),
        (
            True,
            "the searches stopped before their iterations were used up, at a kink or in the noise"
            " of the objective: no line search found a lower point, and the conditions of an"
            " optimum do not hold there; try more --starts or other starting values",
        ),
    )
    yield next(text for holds, text in reasons if holds)


@rule(OPTIMUM, "nothing-better-found")
def _nothing_better(result: TuningResult) -> Messages:
    if result.status == Status.CONVERGED and result.probe:
        yield f"differential evolution found nothing better in {result.probe['runs']} runs"


@rule(OPTIMUM, "start-violates-limit")
def _start_violates(result: TuningResult) -> Messages:
    rows = [c for c in constraint_rows(result.problem, result.tables["before"]) if c.margin < 0]
    parts = [
        f"{c.name} " + (c.amount() if c.reason else f"{c.value:.4g} of {c.limit:.4g} {c.unit}")
        for c in rows
    ]
    if parts and not violated(result):
        yield (
            f"the starting values violate a limit ({first_of(parts)}), so the"
            " objectives before and after do not compare"
        )


@rule(OPTIMUM, "limit-not-applicable")
def _not_applicable(result: TuningResult) -> Messages:
    """Entries of a limited measure that are undefined in every run."""
    keys, plant = {limit.key for limit in result.problem.limits}, result.problem.loop.plant
    for measure in dict.fromkeys(limit.measure for limit in result.problem.limits):
        if "window" not in ms.refers_to([measure]):
            continue
        for i in range(ms.entries(measure, plant)):
            if (measure, i) in keys:
                continue
            yield (
                f"{entry_label(plant, measure, 'output', i)} is not limited: the setpoint has no"
                " step"
            )


@rule(OPTIMUM)
def _active(result: TuningResult) -> Messages:
    for c in result.constraints:
        if c.active:
            when = f" at {c.time_s:.2f} s" if c.time_s is not None else ""
            yield Message(
                "limit-active",
                f"active limit: {c.name}{when} ({c.value:.7g} of {c.limit:.7g} {c.unit})",
            )
    if result.constraints and not any(c.active or c.margin < 0 for c in result.constraints):
        yield Message("no-limit-active", "no limit is active")


@rule(ANY, "parameter-not-exercised")
def _not_exercised(result: TuningResult) -> Messages:
    idle = [n for n in result if not result[n].exercised]
    if idle:
        values = ", ".join(f"{n} {result[n].after:g} {result[n].unit}" for n in idle)
        yield (
            f"{values} {'has' if len(idle) == 1 else 'have'} no effect in any run: any value in the"
            " range gives the same run, so the start value is kept"
        )


@rule(ANY, "integral-action-slow")
def _slow_integral(result: TuningResult) -> Messages:
    duration = result.case.clock.duration
    slow = [n for n in result if ".Ti" in n and 2.0 * result[n].after > duration]
    if slow := [n for n in slow if result[n].exercised]:
        values = ", ".join(f"{n} {result[n].after:.4g} {result[n].unit}" for n in slow)
        yield (
            f"{values} in a run of {duration:g} s: this integral action hardly acts within the run,"
            " and would remove the offset of a constant load only slowly; a longer run, or one"
            " with a load ([[inflow]]), shows its effect"
        )


@rule(ANY)
def _at_bound_or_insensitive(result: TuningResult) -> Messages:
    for name in result:
        p = result[name]
        change = p.sensitivity_percent
        insensitive = not result.answer and change is not None and change < INSENSITIVE
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


@rule(ANSWER, "filter-offset")
def _filter_offset(result: TuningResult) -> Messages:
    answer = result.answer
    loop, unit = answer.setting.case.loop, answer.setting.case.loop.units[0]
    for i, (alone, offset) in answer.filter_offsets.items():
        name, off = label_of(loop.plant, "output", i), f"{offset:.3g} {unit} off its setpoint"
        if answer.setting.filter is None:
            yield (
                f"no safety filter was added: with it {name} would end a plateau {off}, at a"
                " higher cost (--safety-filter adds it)"
            )
        else:
            yield (
                f"under the safety filter {name} ends a plateau {off} ({alone:.3g} {unit} without):"
                " the setpoint is nearer to the limit than the noise band and the dead time of the"
                " filter allow"
            )
    if answer.setting.filter is None and answer.filter_lost and not answer.filter_offsets:
        yield (
            f"no safety filter was added: with it {answer.filter_lost} of {answer.after.samples}"
            f" {answer.setting.runs} would not keep to their setpoints, at a higher cost"
            " (--safety-filter adds it)"
        )


@rule(ANSWER, "level-held-tightly")
def _averaging(result: TuningResult) -> Messages:
    setting, before, after = (getattr(result.answer, n) for n in ("setting", "before", "after"))
    loop = setting.case.loop
    plateaus = loop.reference.plateaus()
    if after is None or setting.own_objective or loop.disturbance is None or plateaus is None:
        return
    old, new = (float(np.nanmean(side.travel)) for side in (before, after))
    if np.ptp(plateaus, axis=0).any() or new <= old:
        return
    yield (
        "no setpoint changes: these gains hold the level, and the inputs follow the inflow. For"
        " averaging control, with a smooth flow and the level between two limits: --objective"
        " mean_square_jitter=1 --limit max_level=... --limit min_level=..."
    )


@rule(ANSWER, "constraints-tightened")
def _tightened(result: TuningResult) -> Messages:
    answer = result.answer
    near = answer.after is not None and any(
        row["margin"] < (1.0 - NEAR) * abs(row["limit"].value) for row in answer.after.worst()
    )
    if answer.tightened and near and not all(answer.kept.values()):
        yield (
            f"the search tightened limits by up to {100 * answer.tightened:.2g} %, so that they"
            " hold on validation plants"
        )


@rule(ANSWER, "tolerance-left-out")
def _stated_in_scenarios(result: TuningResult) -> Messages:
    setting = result.answer.setting
    bases = lambda names: {split_index(name)[0] for name in names}
    stated = bases(name for s in scenarios_to_judge(setting.case) for name in s.values)
    if lost := sorted(stated & bases(setting.distributions)):
        yield f"scenarios state {', '.join(lost)}, which then do not vary within their tolerance"


@rule(ANSWER)
def _assumed(result: TuningResult) -> Messages:
    setting = result.answer.setting
    if setting.assumed:
        unit = setting.case.loop.units[0]
        least, most = (f"{f(setting.noise):.3g}" for f in (np.min, np.max))
        size = f"{most} {unit}" if least == most else f"{least} to {most} {unit}"
        yield Message(
            "noise-assumed",
            f"sensor noise of {size} is assumed (0.1 % of the height; --set sensor.noise)",
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
        values = parameters(setting.case.loop)
        names = [name for name in setting.distributions if np.any(np.asarray(values[name]))]
        are = "is" if len(names) == 1 else "are"
        yield Message(
            "plants-assumed",
            f"the case names nothing uncertain: {', '.join(names)} {are} varied by"
            f" {100 * SPREAD:g} %, and nothing else; a table [uncertain] or --vary states it",
        )


@rule(ANSWER, "limit-idle")
def _idle(result: TuningResult) -> Messages:
    if result.answer.idle:
        idle = [number - 1 for number in result.answer.idle]
        tanks = labels_of(result.problem.loop.plant, "tank", idle)
        if len(result.answer.idle) == 2:
            tanks = tanks.replace(", ", " and ")
        words = f"limits of {tanks} are not active: no plant comes within 10 % of them"
        if len(result.answer.idle) == 1:
            words = f"the limit of {tanks} is not active: no plant comes within 10 % of it"
        yield words


@rule(OPTIMUM, "least-sensitive-direction")
def _least_sensitive(result: TuningResult) -> Messages:
    parts: list[str] = []
    least = result.curvature["least_sensitive"] if result.curvature else {"factors": {}}
    for b, factor in zip(result.problem.bounds, least["factors"].values()):
        if b.scale == "log" and factor != 1:
            parts.append(f"{b.name} x {factor:.10g}")
        elif b.scale != "log" and factor != 0:
            parts.append(f"{b.name} {factor:+.10g}{'' if b.unit == '-' else f' {b.unit}'}")
    if parts:
        together = parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} with {parts[-1]}"
        yield (
            f"least sensitive direction: {together} changes the objective by"
            f" {least['changes_percent']:.2g} %"
        )


def _symmetry(result: TuningResult) -> str:
    """Return the equivalent answer in words."""
    image: Any = result.symmetry
    gains = ", ".join(f"{n} {v:.3g}" for n, v in image["values"].items())
    after = result.objective["after"]
    above = 100 * (image["objective"] - after) / abs(after)
    side = f"an objective {abs(above):.2g} % {'above' if above > 0 else 'below'}"
    same = "the same objective" if abs(above) < 1e-3 else side
    searches = len(image["starts"])
    ended = f", {searches} of the searches ended there and count as this answer" * (searches > 0)
    return f"permutation symmetry: {image['words']}: {gains} gives {same}{ended}"


@rule(OPTIMUM)
def _agreement(result: TuningResult) -> Messages:
    feasible = [o["cost"] for o in result.starts if o["violation"] == 0.0]
    if not feasible:  # nothing to agree on
        return
    best = min(feasible)
    alike = sum(cost <= best + AGREE * abs(best) for cost in feasible)
    searches = count(len(result.starts), "search")
    yield Message(
        "starts-agree", f"{alike} of {searches} ended within 0.1 % of the best objective found"
    )
    if result.symmetry and result.symmetry["objective"] is not None:
        yield Message("permutation-symmetry", _symmetry(result))


@rule(OPTIMUM, "limit-violated-out-of-sample")
def _out_of_sample(result: TuningResult) -> Messages:
    summary = result.validation if result.certificate is None else None
    share = summary["limits_held"]["after"] if summary else None
    problem = result.problem
    if summary and share is not None and share < 1.0 and problem.limits:
        limited = any(limit.measure == "max_level" for limit in problem.limits)
        plain = limited and not problem.loop.safety_filter
        caps = "--safety-filter keeps levels below their limits, " if plain else ""
        runs = summary["samples"] - summary["failed"]
        yield (
            f"limits hold on {round(share * runs)} of {runs} validation plants:"
            f" {caps}--robust tunes for perturbed plants"
        )


@rule(OPTIMUM, "screened-at-true-step")
def _screened_again(result: TuningResult) -> Messages:
    redone = result.evaluations["redone_at_true_step"]
    if redone:
        yield (
            f"{count(redone, 'screening point')} diverged at the coarse step of the screening and"
            f" {'was' if redone == 1 else 'were'} run again at the case's own step: no action is"
            " needed"
        )


@rule(OPTIMUM, "non-finite-points")
def _non_finite(result: TuningResult) -> Messages:
    points = result.evaluations["non_finite"]
    if points:
        yield f"{count(points, 'trial point')} gave non-finite numbers, rejected"

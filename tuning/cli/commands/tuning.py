"""`jaxtank tune`: gains under limits, for the scenarios of the case or for many drawn plants."""

import contextlib
import dataclasses
import sys
from typing import Any

from jaxtank.core.errors import InputError
from tuning.cli import values
from tuning.cli.interrupts import Interrupts
from tuning.cli.options import (
    CASE,
    CLUSTER,
    COMMON,
    RESUME,
    RUN,
    UNCERTAIN,
    Command,
    Option,
    grouped,
)
from tuning.cli.steps import (
    distributions_of,
    finish,
    limits_of,
    open_case,
    picked,
    report_unreachable,
    scenarios_of,
)
from tuning.cli.terminal import Line


class Progress(Interrupts):
    """A line per evaluation on a terminal, a line per local search elsewhere."""

    def __init__(self, unit, quiet, option=None):
        super().__init__()
        self.unit, self.last, self.line = unit, None, Line(quiet)
        self.note = option and f"{option} implies --nominal: the optimum of the unchanged case"
        self.line.compiling("the simulation and its derivatives", 15)

    def __call__(self, event):
        if self.note:  # not before the search begins: an error is one line
            print(f"jaxtank: note: {self.note}", file=sys.stderr)
            self.note = None
        if event["evaluations"] > 1:
            self.check()
        if not self.line.terminal and event["start"] == self.last:
            return
        self.last = event["start"]
        breaks = " (breaks a limit)" if event["best_violation"] else ""
        unit = event.get("unit") or self.unit
        best = "none yet" if event["best"] is None else f"{event['best']:.6g} {unit}{breaks}"
        self.line.show(
            f"start {min(event['start'] + 1, event['starts'])}/{event['starts']}  evaluation"
            f" {event['evaluations']}  best {best}"
        )


CODES = """exit codes:
  0    converged (two searches within 1 % of each other (--nominal: 0.1 %), or
       differential evolution found nothing better), and limits hold on every
       validation plant (--nominal: in every run or scenario of the case)
  2    bad input: one line on stderr, nothing written
  3    not converged
  4    a limit is violated
  130  interrupted (Ctrl-C): the best point so far is printed and written
  143  terminated (SIGTERM): the same; so ends a job that a script runs with &,
       which ignores Ctrl-C. A second signal stops at once; --resume DIR goes on
       where either stopped"""

EXIT = {"converged": 0, "not_converged": 3, "infeasible": 4, "interrupted": 130}


def tune(args):
    """Tune, add trade-off and bound if requested, write and print the result."""
    seed, case = args.seed, open_case(args)
    from tuning.report import tables

    task, sweep = _task(args, case, seed), args.tradeoff
    if args.rule is not None:
        result = _ruled(args, case, task)
        written = finish(result, args)
        report_unreachable(result.tuned, written, args)
        return EXIT[result.status]
    if sweep:  # before the long search
        from jaxtank.limits import resolve_in
        from tuning.problem.scenarios import check_scenarios, runs_of

        scenarios = case.scenarios if task["scenarios"] is None else task["scenarios"]
        measure, values = sweep
        runs = runs_of(case, check_scenarios(scenarios), task["seed"])
        resolve_in([(run.name, run.case) for run in runs], {measure: values[0]})
    finder, case, keywords, mended = _finder(args, case, task)
    unit = tables.objective_unit(task["objective"] or case.objective, case.loop.units)
    option = None if args.robust or args.nominal or args.quiet else _goes_with_nominal(args)
    progress = Progress(unit, args.quiet, option)
    folder = {"checkpoint": args.out, "resume": args.resumed}
    result = finder(case, method=_options(args), **keywords, **folder, progress=progress)
    if mended is not None:
        result = result.replace(answer=dataclasses.replace(result.answer, mended=mended))
    progress.line.end()
    result = _with_studies(args, case, result, task, sweep, progress)
    written = finish(result, args)
    report_unreachable(result.tuned, written, args)
    if not args.out and not args.json and not args.quiet:
        print("Add --out DIR for the tuned rig, the trajectory and pictures.", file=sys.stderr)
    return progress.code if progress.stop else EXIT[result.status]


def _ruled(args, case, task):
    """The gains of a tuning rule, judged like an answer."""
    others = picked(args, "nominal robust mend free starts iterations resume")
    option = _goes_with_nominal(args) or next((f"--{n}" for n, v in others.items() if v), None)
    if option:
        raise InputError(
            f"--rule {args.rule}: computes gains and searches none: leave out {option}"
        )
    from tuning.search.judged import FRESH
    from tuning.search.tuner import tune_by_rule

    return tune_by_rule(
        case,
        args.rule,
        **{name: task[name] for name in ("objective", "limits", "seed")},
        distributions=_varied(args, case),
        safety_filter=args.safety_filter,
        validation=FRESH if args.validation is None else args.validation,
    )


def _task(args, case, seed) -> dict[str, Any]:
    """Keywords of `tuning.tune`: free parameters, limits, objective, scenarios."""
    from jaxtank.rig import check_objective

    return {
        "free": args.free or None,
        "objective": check_objective(args.objective) if args.objective else None,
        "limits": limits_of(args, case),
        "scenarios": scenarios_of(args),
        "seed": seed,
    }


def _finder(args, case, task) -> Any:
    """(function that tunes, case or Problem, its keywords, the Mend that was made first)."""
    choices, varied = args.choose or None, _varied(args, case)
    if args.robust is None:
        if any(value is not None for value in (args.samples, args.fresh, args.back_off)):
            raise InputError("--samples, --fresh and --back-off of tune belong to --robust")
        return _not_robust(args, case, task, choices, varied)
    for name, value in (("--nominal", args.nominal), ("--mend", args.mend)):
        if value:
            raise InputError(f"{name} and --robust: give one of them")
    if choices or task["scenarios"]:
        raise InputError(
            "--robust draws its scenarios: omit --choose, and --scenario unless it is none"
        )
    from tuning.search.robust import tune_robust

    if task["scenarios"] == ():  # --scenario none: plants of the case's own run alone
        case = case.replace(scenarios=())
    task["scenarios"] = None
    options = picked(args, "samples fresh back_off")
    keywords = {name: value for name, value in options.items() if value is not None}
    keywords |= {"distributions": varied, "risk": args.robust}
    return tune_robust, case, _stated(task) | keywords, None


def _varied(args, case):
    """{name: distribution} of --vary or --spread, None without."""
    from tuning.search.setting import is_stated, plants_of

    if args.robust is None and (args.spread or args.vary) and _is_nominal(args):
        raise InputError("--spread and --vary of tune belong to the default answer and to --robust")
    if args.spread is None or args.robust is not None or is_stated(case):
        return distributions_of(args, case)
    return distributions_of(args, case.replace(uncertain=dict.fromkeys(plants_of(case), 0.05)))


def _not_robust(args, case, task, choices, varied):
    """`_finder` without --robust: the default answer, or the optimum of the unchanged case."""
    from tuning.search.tuner import tune as finder

    if not _is_nominal(args):
        keywords, mended = {"distributions": varied, "safety_filter": args.safety_filter}, None
        if args.mend is not None:
            from tuning.feasible.study import apply_mend
            from tuning.search.setting import plants_of

            case, mended = apply_mend(
                case, args.mend, varied or plants_of(case), seed=task["seed"], limits=task["limits"]
            )
        return finder, case, _stated(task) | keywords, mended
    if args.mend is not None:
        raise InputError("--mend belongs to the default answer, not to --nominal")
    if choices:
        from tuning.search.discrete import tune_choices

        return tune_choices, case, {"choices": choices, **task}, None
    if task["scenarios"] is None:
        return finder, case, _stated(task) | {"nominal": True}, None
    from tuning.problem.problem import Problem

    return finder, Problem(case, **task), {}, None


def _stated(task):
    return {name: value for name, value in task.items() if name != "scenarios"}


def _goes_with_nominal(args):
    """Return the first option given that goes with --nominal alone; None without."""
    options = picked(args, "scenario method screening batch choose tradeoff bound")
    return next((f"--{name}" for name, v in options.items() if v and v != "auto"), None)


def _is_nominal(args):
    return args.nominal or _goes_with_nominal(args) is not None


def _options(args):
    """Return the Options of the search: its method and its numbers."""
    from tuning.search.options import options_of

    method = args.method
    if args.batch is not None:
        if method not in ("auto", "adam"):
            raise InputError(
                f"batch = {args.batch}: only method adam draws scenarios, not {method}"
            )
        method = "adam"
    numbers = picked(args, "validation starts screening iterations cluster")
    return options_of(method, **numbers, **({} if args.batch is None else {"batch": args.batch}))


def _with_studies(args, case, result, task, sweep, progress):
    """Return `result` with trade-off and bound, if requested and not interrupted."""
    if sweep and not progress.stop and result.status != "interrupted":
        from tuning.search.pareto import tradeoff

        start = {n: p["after"] for n, p in result.parameters.items()}
        screening = args.screening or 64
        with contextlib.suppress(KeyboardInterrupt):  # the answer is given without it
            points = tradeoff(
                case, *sweep, start=start, screening=screening, progress=progress.check, **task
            )
            result = result.replace(tradeoff=points)
    if args.bound and not progress.stop and result.status != "interrupted":
        from tuning.optimal_input.perfect_information import bound

        best = bound(result.tuned, task["objective"], task["limits"], progress=progress.check)
        result = result.replace(bound=best)
    return result


# fmt: off
PROBLEM = grouped(
    "what to tune",
    Option("--free", "NAME=LOW:HIGH", "a parameter to tune; replaces the parameters of the case",
           values.free_range, kind="pairs"),
    Option("--limit", "MEASURE=VALUE", "a hard limit; MEASURE=none drops one, none drops all",
           values.limit, kind="pairs"),
    Option("--objective", "MEASURE=WEIGHT", "a term of the objective, which is minimised (default:"
           " [objective] of a rig file, else squared error + a price on changes of the inputs;"
           " --nominal: the objective of the case)", values.weight, kind="pairs"),
    Option("--scenario", "NAME=VALUE[;NAME=VALUE]", "a run to tune for, as"
           ' "sensor.noise=0.05;plant.pump_gain=x0.8" (x0.8: 0.8 times the value of the case);'
           " replaces the scenarios of the case; none: its run", values.scenario, kind="list"),
    Option("--choose", "NAME=V1,V2", "a static number or text to try the values of;"
           " controller.kind=pid,lqi: the controllers that a rig file may name, each with its gains"
           " and ranges", values.pair(values.candidates), kind="pairs"),
    Option("--validation", "N", "validation plants (default 256; --nominal: 64, 0 for none)",
           values.whole(0, 100000)),
    Option("--mend", "KIND", "first make the smallest design change of one kind (setpoints, rims,"
           " orifices, pumps or ramps) with which 95 % of the plants can hold the setpoints (ramps:"
           " with which the nominal run keeps its limits)",
           choices=("setpoints", "rims", "orifices", "pumps", "ramps")),
    Option("--nominal", help="the optimum of the unchanged case: its objective, its run or"
           " scenarios; no noise, plants or filter are added; implied by --scenario,"
           " --method, --screening, --batch, --choose, --tradeoff, --bound", kind="flag"),
    Option("--rule", "NAME", "no search: the gains of a tuning rule for a PI or PID controller,"
           " judged like an answer (simc, lambda, ziegler-nichols, amigo, relay)",
           choices=("simc", "lambda", "ziegler-nichols", "amigo", "relay")),
    Option("--tradeoff", "MEASURE=LOW:HIGH[:N]", "also: the best objective for N (6) values of one"
           " limit", values.tradeoff),
    Option("--bound", help="also: the best open-loop inputs found, with perfect information",
           kind="flag"),
)
SEARCH = grouped(
    "search",
    Option("--method", "NAME", "auto, trf, coarse-trf, slsqp, lbfgs or adam", default="auto",
           choices=("auto", "trf", "coarse-trf", "slsqp", "lbfgs", "adam")),
    Option("--starts", "N", "most local searches, until two agree (default 4; --nominal: 8)",
           values.whole(1, 1000)),
    Option("--screening", "N", "Sobol points of --nominal (default 64)", values.whole(1, 65536)),
    Option("--iterations", "N", "iterations of each local search (default 40; --nominal: 60)",
           values.whole(1, 100000)),
    Option("--batch", "N", "scenarios drawn for each step of method adam (default all)",
           values.whole(1, 100000)),
    RESUME,
)
ROBUST = grouped(
    "robust search (--robust)",
    Option("--robust", "RISK", "many drawn plants at once: mean, cvar or worst of their costs,"
           " limits kept on every one", choices=("mean", "cvar", "worst")),
    Option("--samples", "N", "plants of --robust (default 64)", values.whole(2, 100000)),
    Option("--fresh", "N", "validation plants of --robust (default 1024)", values.whole(1, 100000)),
    Option("--back-off", "SHARE", "constraint tightening of --robust, as a share of each limit;"
           " validation is without it", values.number),
)
# fmt: on
COMMANDS = {
    "tune": Command(
        tune,
        "tune the gains of a case under its limits",
        (*COMMON, *CASE, *RUN, *UNCERTAIN, *CLUSTER, *PROBLEM, *SEARCH, *ROBUST),
        epilog=CODES,
    )
}

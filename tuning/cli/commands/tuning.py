"""`jaxtank tune`: gains under limits, for the scenarios of the case or for many drawn plants."""

import argparse
import contextlib
import sys
from typing import Any

from jaxtank.core.errors import InputError
from tuning.cli.arguments import on_cluster, option, repeatable, uncertain, whole
from tuning.cli.interrupts import Interrupts, put_back
from tuning.cli.options import (
    choices_of,
    distributions_of,
    finish,
    limits_of,
    report_unreachable,
    scenarios_of,
    tradeoff_of,
)
from tuning.cli.terminal import Line
from tuning.cli.values import number, once, open_case, pair, span


class Progress(Interrupts):
    """A line per evaluation on a terminal, a line per local search elsewhere."""

    def __init__(self, unit, quiet, option=None):
        super().__init__()
        self.unit, self.last, self.line = unit, None, Line(quiet)
        self.note = option and f"{option} implies --nominal: the optimum of the case as it is"
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
  0    converged (two searches within 1 % of each other (--nominal: 0.1 %), or differential
       evolution found nothing better), and limits hold on every validation plant (--nominal:
       in every run or scenario of the case)
  2    bad input: one line on stderr, nothing written
  3    not converged
  4    a limit is violated
  130  interrupted (Ctrl-C): the best point so far is printed and written
  143  terminated (SIGTERM): the same; so ends a job that a script runs with &, which ignores
       Ctrl-C. A second signal stops at once; --resume DIR goes on where either stopped"""

EXIT = {"converged": 0, "not_converged": 3, "infeasible": 4, "interrupted": 130}


def add(commands, parents):
    """Add the command to the parser's `commands`."""
    one = commands.add_parser(
        "tune",
        parents=[*parents, uncertain(), on_cluster()],
        help="tune the gains of a case under its limits",
        epilog=CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    one.set_defaults(run=tune)
    _add_problem(one)
    _add_search(one)
    _add_robust(one)


def _add_problem(one):
    """Options on what is tuned, under which limits, and judged by which runs."""
    text = "a parameter to tune; replaces those of the case"
    repeatable(one, "--free", "NAME=LOW:HIGH", text)
    text = "a hard limit; MEASURE=none drops one, none drops all"
    repeatable(one, "--limit", "MEASURE=VALUE", text)
    text = (
        "a term of the objective, which is minimised (default: that of a rig file's [objective],"
        " else squared error + a price on changes of the inputs; --nominal: that of the case)"
    )
    repeatable(one, "--objective", "MEASURE=WEIGHT", text)
    repeatable(
        one,
        "--scenario",
        "NAME=VALUE[;NAME=VALUE]",
        'a run to tune for, as "sensor.noise=0.05;plant.pump_gain=x0.8" (x0.8: 0.8 times the value'
        " of the case); replaces those of the case; none: the case's own run",
    )
    text = (
        "a static number or text to try the values of; controller.kind=pid,lqi: the controllers"
        " that a rig file may name, each with gains and ranges of its own"
    )
    repeatable(one, "--choose", "NAME=V1,V2", text)
    text = "validation plants (default 256; --nominal: 64, 0 for none)"
    option(one, "--validation", "N", text, None, whole(0, 100_000))
    text = (
        "first make the smallest design change of one kind (setpoints, rims, orifices, pumps or"
        " ramps) with which 95 % of the plants can hold the setpoints (ramps: with which the"
        " nominal run keeps its limits)"
    )
    option(one, "--mend", "KIND", text.replace("%", "%%"))
    one.add_argument(
        "--nominal",
        action="store_true",
        help="the optimum of the case as it is, with its own objective: its own run or scenarios,"
        " without adding noise, plants or a filter; implied by"
        " --scenario, --method, --screening, --batch, --choose, --tradeoff, --bound",
    )
    text = "also: the best objective for N (6) values of one limit"
    option(one, "--tradeoff", "MEASURE=LOW:HIGH[:N]", text)
    one.add_argument(
        "--bound",
        action="store_true",
        help="also: the best open-loop inputs found, with perfect information",
    )


def _add_search(one):
    """Options on how the search runs."""
    text = "auto (default), trf, coarse-trf, slsqp, lbfgs or adam"
    option(one, "--method", "NAME", text, "auto")
    text = "local searches at most, until two agree (default 4; --nominal: 8)"
    option(one, "--starts", "N", text, None, whole(1, 1000))
    text = "Sobol points of --nominal (default 64)"
    option(one, "--screening", "N", text, None, whole(1, 65536))
    text = "iterations of each local search (default 40; --nominal: 60)"
    option(one, "--iterations", "N", text, None, whole(1, 100_000))
    text = "scenarios drawn for each step of method adam (default all)"
    option(one, "--batch", "N", text, None, whole(1, 100_000))
    text = "go on where a killed run with --out DIR ended, to the same answer"
    option(one, "--resume", "DIR", text)


def _add_robust(one):
    """Options on many plants at once."""
    text = "many drawn plants at once: mean, cvar or worst of their costs, limits kept on every one"
    option(one, "--robust", "RISK", text)
    option(one, "--samples", "N", "plants of --robust (default 64)", None, whole(2, 100_000))
    text = "validation plants of --robust (default 1024)"
    option(one, "--fresh", "N", text, None, whole(1, 100_000))
    text = "constraint tightening of --robust, as a share of each limit; validation is without it"
    option(one, "--back-off", "SHARE", text, None, number)


def tune(args):
    """`_tune`, with the handler of SIGINT put back afterwards."""
    with put_back():
        code = _tune(args)
        sys.stdout.flush()  # the answer is out before Ctrl-C ends the program at once again
        return code


def _tune(args):
    """Tune, then what was asked for besides; write and print the result."""
    seed, case = args.seed, open_case(args)
    from tuning.report import tables

    task, sweep = _task(args, case, seed), tradeoff_of(args)
    if sweep:  # before the search, which would be in vain
        _check_tradeoff(case, task, sweep)
    finder, case, own = _finder(args, case, task)
    folder = args.resume or args.out
    unit = tables.objective_unit(task["objective"] or case.objective, case.loop.units)
    option = None if args.robust or args.nominal or args.quiet else _goes_with_nominal(args)
    progress = Progress(unit, args.quiet, option)
    result = finder(
        case,
        **{k: v for k, v in task.items() if k != "scenarios"},
        **own,
        **_numbers(args),
        checkpoint=folder,
        resume=args.resume is not None,
        progress=progress,
        cluster=args.cluster,
    )
    progress.line.end()
    result = _besides(args, case, result, task, sweep, progress)
    args.out = folder
    written = finish(result, args)
    report_unreachable(result.tuned, written, args)
    if not args.out and not args.json and not args.quiet:
        print("Add --out DIR for the tuned rig, the trajectory and pictures.", file=sys.stderr)
    return progress.code if progress.stop else EXIT[result.status]


def _task(args, case, seed) -> dict[str, Any]:
    """What is tuned, under which limits, for which runs: keywords of `tuning.tune`."""
    from jaxtank.rig import check_objective

    free = once("--free", [pair("--free", text, span) for text in args.free])
    weights = [pair("--objective", t, lambda v: number("--objective", v)) for t in args.objective]
    objective = once("--objective", weights)
    return {
        "free": free,
        "objective": check_objective(objective) if objective else objective,
        "limits": limits_of(args, case),
        "scenarios": scenarios_of(args),
        "seed": seed,
    }


def _check_tradeoff(case, task, sweep):
    """Raise InputError where the limit of --tradeoff is undefined in every run."""
    from tuning.problem.limits import resolve_in
    from tuning.problem.scenarios import check_scenarios, runs_of

    scenarios = case.scenarios if task["scenarios"] is None else task["scenarios"]
    measure, values = sweep
    runs = runs_of(case, check_scenarios(case, scenarios), task["seed"])
    resolve_in(runs, {measure: values[0]})


def _finder(args, case, task):
    """(function that tunes, case, its own keywords): `tune`, or `tune_robust` under --robust."""
    choices, varied = choices_of(args), _varied(args, case)
    if args.robust is None:
        if any(value is not None for value in (args.samples, args.fresh, args.back_off)):
            raise InputError("--samples, --fresh and --back-off of tune belong to --robust")
        return _not_robust(args, case, task, choices, varied)
    for name, given in (("--nominal", args.nominal), ("--mend", args.mend is not None)):
        if given:
            raise InputError(f"{name} and --robust: give one of them")
    if choices or task["scenarios"]:
        raise InputError(
            "--robust makes scenarios of its own: no --choose and no --scenario but none beside it"
        )
    from tuning.search.robust import tune_robust

    if task["scenarios"] == ():  # --scenario none: plants of the case's own run alone
        case = case.replace(scenarios=())
    task["scenarios"] = None
    return (
        tune_robust,
        case,
        {
            "distributions": varied,
            "risk": args.robust,
            "samples": args.samples or 64,
            "fresh": args.fresh or 1024,
            "back_off": args.back_off or 0.0,
        },
    )


def _varied(args, case):
    """{name: distribution} of --vary or --spread, None without."""
    from tuning.search.setting import is_stated, plants_of

    if args.robust is None and (args.spread or args.vary) and _is_nominal(args):
        raise InputError("--spread and --vary of tune belong to the default answer and to --robust")
    if args.spread is None or args.robust is not None or is_stated(case):
        return distributions_of(args, case)
    return distributions_of(args, case.replace(uncertain=dict.fromkeys(plants_of(case), 0.05)))


def _not_robust(args, case, task, choices, varied):
    """`_finder` without --robust: the default answer, or the optimum of the case as it is."""
    from tuning.search.tuner import tune as finder

    if not _is_nominal(args):
        own = {"distributions": varied, "safety_filter": args.safety_filter, "mend": args.mend}
        return finder, case, own
    if args.mend is not None:
        raise InputError("--mend belongs to the default answer, not to --nominal")
    own = {"nominal": True, "choices": choices, "scenarios": task["scenarios"]}
    return finder, case, own


def _goes_with_nominal(args):
    """Return the first option given that goes with --nominal alone; None without."""
    given = {
        "--scenario": args.scenario,
        "--method": args.method != "auto",
        "--screening": args.screening is not None,
        "--batch": args.batch is not None,
        "--choose": args.choose,
        "--tradeoff": args.tradeoff is not None,
        "--bound": args.bound,
    }
    return next((name for name, value in given.items() if value), None)


def _is_nominal(args):
    """Return True if the optimum of the case as it is was asked for."""
    return args.nominal or _goes_with_nominal(args) is not None


def _numbers(args) -> dict[str, Any]:
    """Method and numbers of the search that are given: keywords of the finder."""
    names = ("batch", "validation", "starts", "screening", "iterations")
    given = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    return given | ({} if args.method == "auto" else {"method": args.method})


def _besides(args, case, result, task, sweep, progress):
    """`result` with the trade-off and the bound, where asked for and not interrupted."""
    if sweep and not progress.stop and result.status != "interrupted":
        from tuning.search.pareto import tradeoff

        start = {n: p["after"] for n, p in result.parameters.items()}
        screening = args.screening or 64
        with contextlib.suppress(KeyboardInterrupt):  # the answer is given without it
            found = tradeoff(
                case, *sweep, start=start, screening=screening, progress=progress.check, **task
            )
            result = result.replace(tradeoff=found)
    if args.bound and not progress.stop and result.status != "interrupted":
        from tuning.optimal_input.perfect_information import bound

        found = bound(result.tuned, task["objective"], task["limits"], progress=progress.check)
        result = result.replace(bound=found)
    return result

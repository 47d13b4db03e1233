"""`jaxtank tune`."""

import contextlib
import functools
import sys
from typing import Any

from jaxtank.core.errors import InputError
from tuning.cli.interrupts import Interrupts, put_back
from tuning.cli.options import (
    choices_of,
    distributions_of,
    limits_of,
    scenarios_of,
    tell_unreachable,
    tell_written,
    tradeoff_of,
)
from tuning.cli.values import number, once, open_case, pair, span, whole
from tuning.cli.values import seed as seed_of

EXIT = {"converged": 0, "not_converged": 3, "infeasible": 4, "interrupted": 130}


def tune(args):
    """`_tune`, with the handler of SIGINT put back afterwards."""
    with put_back():
        code = _tune(args)
        sys.stdout.flush()  # the answer is out before Ctrl-C ends the program at once again
        return code


def _tune(args):
    seed, case = seed_of(args), open_case(args)
    from jaxtank.rig import check_objective
    from tuning.report import tables, tuning
    from tuning.search import tuner

    free = once("--free", [pair("--free", text, span) for text in args.free])
    objective = once(
        "--objective",
        [pair("--objective", text, lambda v: number("--objective", v)) for text in args.objective],
    )
    if objective:
        objective = check_objective(objective)
    limits, scenarios, sweep = limits_of(args, case), scenarios_of(args), tradeoff_of(args)
    if sweep:  # before the search, which would be lost
        from tuning.problem.limits import resolve_in
        from tuning.problem.scenarios import check_scenarios, runs_of

        runs = check_scenarios(case, case.scenarios if scenarios is None else scenarios)
        resolve_in(runs_of(case, runs, seed), {sweep[0]: sweep[1][0]})
    folder = args.resume or args.out
    choices, varied = choices_of(args), distributions_of(args, case)
    only = (args.samples, args.fresh, args.back_off)
    if (varied is not None or any(v is not None for v in only)) and args.robust is None:
        raise InputError(
            "--samples, --fresh, --back-off, --spread and --vary of tune belong to --robust"
        )
    finder = tuner.tune
    more: dict[str, Any] = {"choices": choices, "scenarios": scenarios}
    if args.robust is not None:
        from tuning.search.robust import tune_robust

        if choices or scenarios:
            raise InputError(
                "--robust makes scenarios of its own: no --choose and no --scenario but none"
                " beside it"
            )
        if scenarios == ():  # --scenario none: plants of the case's own run alone
            case = case.replace(scenarios=())
        finder = functools.partial(
            tune_robust,
            distributions=varied,
            risk=args.robust,
            samples=whole("--samples", args.samples or "64", 2, 100_000),
            fresh=whole("--fresh", args.fresh or "1024", 1, 100_000),
            back_off=number("--back-off", args.back_off or "0"),
        )
        scenarios, more = None, {}
    progress = Progress(
        tables.objective_unit(objective or case.objective, case.loop.units), args.quiet
    )
    result = finder(
        case,
        method=args.method,
        free=free,
        objective=objective,
        limits=limits,
        **more,
        batch=None if args.batch is None else whole("--batch", args.batch, 1, 100_000),
        validation=whole("--validation", args.validation, 0, 100_000),
        log=folder,
        resume=args.resume is not None,
        starts=whole("--starts", args.starts, 1, 1000),
        seed=seed,
        screening=whole("--screening", args.screening, 1, 65536),
        iterations=whole("--iterations", args.iterations, 1, 100_000),
        progress=progress,
    )
    if not args.quiet and sys.stderr.isatty():
        print(file=sys.stderr)
    if sweep and not progress.stop and result.status != "interrupted":
        from tuning.search.pareto import tradeoff

        answer = {n: p["after"] for n, p in result.parameters.items()}
        options = {
            "free": free,
            "objective": objective,
            "limits": limits,
            "scenarios": scenarios,
            "seed": seed,
        }
        options["screening"] = whole("--screening", args.screening, 1, 65536)
        with contextlib.suppress(KeyboardInterrupt):  # the answer is given without it
            result = result.replace(
                tradeoff=tradeoff(case, *sweep, start=answer, progress=progress.check, **options)
            )
    if args.bound and not progress.stop and result.status != "interrupted":
        from tuning.optimal_input.perfect_information import bound

        result = result.replace(
            bound=bound(result.tuned, objective, limits, progress=progress.check)
        )
    args.out = folder
    try:
        written = result.save(folder, args.line) if folder else []
    finally:  # a disk that is full costs the files, not the answer; and the log is kept
        print(tables.dumps(result.to_json()) if args.json else tuning.text(result))
    if folder and result.status != "interrupted":
        from tuning.storage.evaluation_log import discard

        discard(folder)  # the result is whole: there is nothing left to go on with
    tell_written(written, args)
    tell_unreachable(result.tuned, written, args)
    if not args.out and not args.json and not args.quiet:
        print("Add --out DIR for the tuned rig, the trajectory and pictures.", file=sys.stderr)
    return EXIT["interrupted" if progress.stop else result.status]


class Progress(Interrupts):
    """A line per evaluation on a terminal, a line per local search elsewhere. Ctrl-C is taken
    between evaluations, from the second on: the first is of the values that the case has, and what
    follows it is compiled first.
    """

    def __init__(self, unit, quiet):
        super().__init__()
        self.unit, self.quiet, self.last, self.terminal = unit, quiet, None, sys.stderr.isatty()

    def __call__(self, event):
        if event["evaluations"] > 1:
            self.check()
        if self.quiet or (not self.terminal and event["start"] == self.last):
            return
        self.last = event["start"]
        breaks = " (breaks a limit)" if event["best_violation"] else ""
        best = "none yet" if event["best"] is None else f"{event['best']:.6g} {self.unit}{breaks}"
        line = (
            f"start {min(event['start'] + 1, event['starts'])}/{event['starts']}  evaluation"
            f" {event['evaluations']}  best {best}"
        )
        print(
            f"\r{line:<70}" if self.terminal else line,
            end="" if self.terminal else "\n",
            file=sys.stderr,
            flush=True,
        )

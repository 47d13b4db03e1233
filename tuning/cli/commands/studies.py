"""`jaxtank uncertainty`, `sensitivity` and `attack`: many runs of a case."""

from tuning.cli import values
from tuning.cli.options import CASE, COMMON, DEVICES, RESUME, RUN, UNCERTAIN, Command, Option
from tuning.cli.steps import (
    distributions_of,
    finish,
    limits_of,
    measures_of,
    open_case,
    picked,
    use_devices,
)
from tuning.cli.terminal import Line

ANSWERS = {"kept": 0, "not kept": 4, "undecided": 3}


def uncertainty(args):
    """Run a case on many draws of its uncertain parameters."""
    use_devices(args)
    case = open_case(args)
    from tuning.uncertainty.study import ensemble

    line = Line(args.quiet).compiling("the simulation", 5)
    result = ensemble(
        case,
        distributions_of(args, case),
        **picked(args, "samples draws promise devices cluster"),
        key=args.seed,
        measures=measures_of(args, case),
        limits=limits_of(args, case),
        checkpoint=args.out,
        resume=args.resumed,
        progress=lambda done: line.show(f"{done} draws"),
    )
    line.end()
    finish(result, args)
    return 0 if result.promise is None else ANSWERS[result.promise.answer]


def sensitivity(args):
    """Print which parameter changes which measure."""
    use_devices(args)
    case = open_case(args)
    distributions = distributions_of(args, case)
    from tuning.uncertainty import sensitivity_study as study

    derivatives = " and its derivatives" if args.method == "local" else ""
    line = Line(args.quiet).compiling(f"the simulation{derivatives}", 5)
    same = picked(args, "method samples seed devices cluster")
    measures = measures_of(args, case)
    result = study.sensitivity(case, distributions, measures=measures, progress=line.runs, **same)
    line.end()
    finish(result, args)
    return 0


PASSED = 4  # exit code where a limit is passed


def attack(args):
    """Print the highest levels found; returns 4 where a limit is passed."""
    case = open_case(args)
    distributions = distributions_of(args, case)
    from tuning.falsification import study
    from tuning.falsification.attacked import is_chosen

    if args.spread is not None and distributions:
        distributions = {n: d for n, d in distributions.items() if not is_chosen(n)}

    line = Line(args.quiet).compiling("the simulation and its derivatives", 15)
    result = study.attack(
        case,
        distributions,
        **picked(args, "starts iterations seed windows draws pumps start"),
        noise=not args.constant_errors,
        progress=lambda done, total: line.show(f"step {done}/{total}"),
    )
    line.end()
    finish(result, args)
    return PASSED if result.passed or result.below else 0


# fmt: off
COMMANDS = {
    "uncertainty": Command(
        uncertainty,
        "the same loop over N draws: bands, percentiles, violations",
        (
            *COMMON, *CASE,
            *RUN, *UNCERTAIN, *DEVICES,
            Option("--samples", "N", "draws", values.whole(1, 10**8), 1000),
            Option("--draws", "KIND", "random, latin or sobol", default="random",
                   choices=("random", "latin", "sobol")),
            Option("--limit", "MEASURE=VALUE", "a limit to count violations of", values.limit,
                   kind="pairs"),
            Option("--promise", "SHARE", "whether any limit is broken in fewer plants than this"
                   " share, as 0.001: importance sampling around the most likely failures, at most"
                   " 100 N runs; exit code 0 kept, 4 not kept, 3 undecided", values.share),
            Option("--measure", "NAME", "a measure to keep, in place of the default ones;"
                   " max_level.LT101 keeps max_level of every tank",
                   values.measure_and_part, kind="list"),
            RESUME,
        ),
    ),
    "sensitivity": Command(
        sensitivity,
        "which parameter changes which measure: local, Morris, Sobol",
        (
            *COMMON, *CASE,
            *RUN, *UNCERTAIN, *DEVICES,
            Option("--method", "NAME", "local (exact derivatives), morris or sobol",
                   default="local", choices=("local", "morris", "sobol")),
            Option("--samples", "N", "trajectories of morris (default 32), base points of sobol"
                   " (default 512, a power of 2)", values.whole(1, 1 << 20)),
            Option("--measure", "NAME", "a measure to study (default: measures of the"
                   " objective, rms_error_total, max_level)", values.measure_and_part, kind="list"),
        ),
    ),
    "attack": Command(
        attack,
        "the plant, start and reading errors of the box that drive a level past its limit, if any",
        (
            *COMMON, *CASE,
            *RUN, *UNCERTAIN,
            Option("--starts", "N", "ascents for each tank, from the best draws",
                   values.whole(1, 10**4), 8),
            Option("--iterations", "N", "most steps of the ascent", values.whole(0, 10**4), 12),
            Option("--draws", "N", "random draws, half of them corners",
                   values.whole(1, 10**6), 64),
            Option("--windows", "N", "windows of time in each of which a flow coefficient has its"
                   " own value", values.whole(1, 1000), 4),
            Option("--pumps", "KIND", "what commands the pumps: own (the controller), full, or"
                   " random switching", default="own", choices=("own", "full", "random")),
            Option("--start", "KIND", "levels at t = 0: any up to the limits, or own: the levels of"
                   " the case", default="any", choices=("any", "own")),
            Option("--constant-errors", help="reading errors that do not change in time (default:"
                   " any sequence in the band)", kind="flag"),
        ),
        epilog="Exit codes: 0 no limit was passed, 2 bad input, 4 a limit is passed, 130"
        " interrupted.",
    ),
}
# fmt: on

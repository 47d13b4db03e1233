"""`jaxtank attack`: the plant, start and reading errors that drive levels highest."""

from tuning.cli.arguments import option, uncertain, whole
from tuning.cli.options import distributions_of, finish
from tuning.cli.terminal import Line
from tuning.cli.values import open_case

PASSED = 4
"""Exit code where a limit is passed."""


def add(commands, parents):
    """Add the command of this module to the parser's `commands`."""
    common, case, run = parents
    one = commands.add_parser(
        "attack",
        parents=[common, case, run, uncertain()],
        help="the worst plant, start and reading errors in the box: can a level pass its limit?",
        epilog="Exit codes: 0 no limit was passed, 2 bad input, 4 a limit is passed, 130"
        " interrupted.",
    )
    one.set_defaults(run=attack)
    option(
        one,
        "--starts",
        "N",
        "ascents for each tank, from the best draws (default 8)",
        8,
        whole(1, 10**4),
    )
    text = "most steps of the ascent (default 12)"
    option(one, "--iterations", "N", text, 12, whole(0, 10**4))
    text = "random draws, half of them corners (default 64)"
    option(one, "--draws", "N", text, 64, whole(1, 10**6))
    text = "windows of time in each of which a flow coefficient has its own value (default 4)"
    option(one, "--windows", "N", text, 4, whole(1, 1000))
    text = "what commands the pumps: own (default: the controller), full, or random switching"
    option(one, "--pumps", "KIND", text, "own")
    text = "levels at t = 0: any (default) up to the limits, or own: those of the case"
    option(one, "--start", "KIND", text, "any")
    one.add_argument(
        "--constant-errors",
        action="store_true",
        help="reading errors that do not change in time (default: any sequence in the band)",
    )


def attack(args):
    """Print the highest levels found; returns 4 where a limit is passed."""
    case = open_case(args)
    distributions = distributions_of(args, case)
    from tuning.falsification import study

    line = Line(args.quiet)
    line.compiling("the simulation and its derivatives", 15)
    found = study.attack(
        case,
        distributions,
        starts=args.starts,
        iterations=args.iterations,
        seed=args.seed,
        windows=args.windows,
        draws=args.draws,
        pumps=args.pumps,
        start=args.start,
        noise=not args.constant_errors,
        progress=lambda done, total: line.show(f"step {done}/{total}"),
    )
    line.end()
    finish(found, args)
    return PASSED if found.passed else 0

"""`jaxtank attack`: the plant, start and reading errors that drive levels highest."""

from tuning.cli.options import CASE, COMMON, RUN, UNCERTAIN, Command, Option
from tuning.cli.steps import distributions_of, finish, open_case, picked
from tuning.cli.terminal import Line
from tuning.cli.values import whole

PASSED = 4  # exit code where a limit is passed


def attack(args):
    """Print the highest levels found; returns 4 where a limit is passed."""
    case = open_case(args)
    distributions = distributions_of(args, case)
    from tuning.falsification import study

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
    return PASSED if result.passed else 0


# fmt: off
COMMANDS = {
    "attack": Command(
        attack,
        "the worst plant, start and reading errors in the box: can a level pass its limit?",
        (
            *COMMON, *CASE,
            *RUN, *UNCERTAIN,
            Option("--starts", "N", "ascents for each tank, from the best draws", whole(1, 10**4),
                   8),
            Option("--iterations", "N", "most steps of the ascent", whole(0, 10**4), 12),
            Option("--draws", "N", "random draws, half of them corners", whole(1, 10**6), 64),
            Option("--windows", "N", "windows of time in each of which a flow coefficient has its"
                   " own value", whole(1, 1000), 4),
            Option("--pumps", "KIND", "what commands the pumps: own (the controller), full, or"
                   " random switching", default="own", choices=("own", "full", "random")),
            Option("--start", "KIND", "levels at t = 0: any up to the limits, or own: the levels of"
                   " the case", default="any", choices=("any", "own")),
            Option("--constant-errors", help="reading errors that do not change in time (default:"
                   " any sequence in the band)", kind="flag"),
        ),
        epilog="Exit codes: 0 no limit was passed, 2 bad input, 4 a limit is passed, 130"
        " interrupted.",
    )
}
# fmt: on

"""`jaxtank uncertainty` and `sensitivity`: many runs of a case."""

from tuning.cli.arguments import on_devices, option, repeatable, uncertain, whole
from tuning.cli.options import devices_of, distributions_of, finish, limits_of
from tuning.cli.terminal import Line
from tuning.cli.values import open_case


def add(commands, parents):
    """Add the commands of this module to the parser's `commands`."""
    common, case, run = parents
    one = commands.add_parser(
        "uncertainty",
        parents=[common, case, run, uncertain(), on_devices()],
        help="the same loop over N draws: bands, percentiles, violations",
    )
    one.set_defaults(run=uncertainty)
    option(one, "--samples", "N", "draws (default 1000)", 1000, whole(1, 10**8))
    option(one, "--draws", "KIND", "random (default), latin or sobol", "random")
    repeatable(one, "--limit", "MEASURE=VALUE", "a limit to count violations of")
    repeatable(one, "--measure", "NAME", "a measure to keep, in place of the default ones")
    option(one, "--resume", "DIR", "go on where a killed run with --out DIR ended")
    _add_sensitivity(commands, [common, case, run, uncertain(), on_devices()])


def _add_sensitivity(commands, parents):
    one = commands.add_parser(
        "sensitivity",
        parents=parents,
        help="which parameter changes which measure: local, Morris, Sobol",
    )
    one.set_defaults(run=sensitivity)
    text = "local (default: exact derivatives), morris or sobol"
    option(one, "--method", "NAME", text, "local")
    text = "trajectories of morris (default 32), base points of sobol (default 512, a power of 2)"
    option(one, "--samples", "N", text, None, whole(1, 1 << 20))
    repeatable(
        one,
        "--measure",
        "NAME",
        "a measure to look at (default: those of the objective, rms_error_total, max_level)",
    )


def uncertainty(args):
    """Run a case on many draws of its uncertain parameters."""
    args.out = args.resume or args.out
    devices = devices_of(args)
    case = open_case(args)
    from tuning.uncertainty.study import ensemble

    line = Line(args.quiet)
    line.compiling("the simulation", 5)
    found = ensemble(
        case,
        distributions_of(args, case),
        samples=args.samples,
        key=args.seed,
        draws=args.draws,
        measures=tuple(args.measure) or None,
        limits=limits_of(args, case),
        devices=devices,
        cluster=args.cluster,
        checkpoint=args.out,
        resume=args.resume is not None,
        progress=lambda done: line.show(f"{done} draws"),
    )
    line.end()
    finish(found, args)
    return 0


def sensitivity(args):
    """Print which parameter changes which measure."""
    devices = devices_of(args)
    case = open_case(args)
    varied = distributions_of(args, case)
    from tuning.uncertainty import sensitivity_study as study

    line = Line(args.quiet)
    derivatives = " and its derivatives" if args.method == "local" else ""
    line.compiling(f"the simulation{derivatives}", 5)
    result = study.sensitivity(
        case,
        varied,
        method=args.method,
        measures=args.measure or None,
        samples=args.samples,
        seed=args.seed,
        devices=devices,
        cluster=args.cluster,
        progress=line.runs,
    )
    line.end()
    finish(result, args)
    return 0

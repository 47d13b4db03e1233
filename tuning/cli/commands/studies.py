"""`jaxtank uncertainty`, `merge` and `sensitivity`: many runs of a case."""

import os
import sys

from jaxtank.core.errors import InputError
from jaxtank.core.text import printable
from tuning.cli.arguments import Parser, changes, on_devices, option, repeatable, uncertain
from tuning.cli.options import devices_of, distributions_of, limits_of, report_written
from tuning.cli.terminal import Line
from tuning.cli.values import open_case, whole
from tuning.cli.values import seed as seed_of


def add(commands, parents):
    """Add the commands of this module to the parser's `commands`."""
    common, case, run = parents
    one = commands.add_parser(
        "uncertainty",
        parents=[common, case, run, _draws(), on_devices()],
        help="the same loop over N draws: bands, percentiles, violations",
    )
    one.set_defaults(run=uncertainty)
    option(one, "--shard", "I/N", "run the I-th of N shares into --out DIR; merge joins them")
    option(one, "--resume", "DIR", "go on where a killed run with --out DIR ended")
    one = commands.add_parser(
        "merge",
        parents=[common, run, changes(), _draws()],
        help="join the shards of an ensemble in a folder",
    )
    one.set_defaults(run=merge)
    one.add_argument(
        "case",
        metavar="DIR",
        help="where the shards are; or their case, with their options and --out DIR",
    )
    _add_sensitivity(commands, [common, case, run, uncertain(), on_devices()])


def _draws():
    """The parent parser of the options that shards of one ensemble share."""
    found = Parser(add_help=False, parents=[uncertain()])
    option(found, "--samples", "N", "draws (default 1000)", "1000")
    option(found, "--draws", "KIND", "random (default), latin or sobol", "random")
    repeatable(found, "--limit", "MEASURE=VALUE", "a limit to count violations of")
    repeatable(found, "--measure", "NAME", "a measure to keep, in place of the default ones")
    return found


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
    option(one, "--samples", "N", text)
    repeatable(
        one,
        "--measure",
        "NAME",
        "a measure to look at (default: those of the objective, rms_error_total, max_level)",
    )


def uncertainty(args):
    """Run a case on many draws of its uncertain parameters."""
    shard = None
    if args.shard is not None:
        shard = _shard(args.shard)
        if not args.out and not args.resume:
            raise InputError(f"--shard {args.shard!r}: needs --out DIR, where the shares meet")
    args.out = args.resume or args.out
    devices = devices_of(args)
    line = Line(args.quiet)
    line.compiling("the simulation", 5)
    found = _ensemble(
        args,
        devices=devices,
        cluster=args.cluster,
        shard=shard,
        folder=args.out,
        resume=args.resume is not None,
        progress=lambda done: line.show(f"{done} draws"),
    )
    line.end()
    if found is None:
        if not args.quiet:
            print(
                f"shard {args.shard} is in {printable(args.out)}; `jaxtank merge` joins the shards"
                " when all are",
                file=sys.stderr,
            )
        return 0
    return _report(found, args)


def merge(args):
    """Join shards: of a folder by its manifest, or of a case with the options of its shards."""
    if args.out:
        return _report(_ensemble(args, folder=args.out, resume=True, merge=True), args)
    if not os.path.isdir(args.case):
        raise InputError(
            f"merge {args.case!r}: is no folder; give the one that the shards were written to"
            " (their --out DIR)"
        )
    import jax

    jax.config.update("jax_enable_x64", True)
    from tuning.uncertainty.manifest import restore
    from tuning.uncertainty.study import ensemble

    given = [
        a for a in ("values", "schedule", "dt", "spread", "vary", "measure") if getattr(args, a)
    ]
    if given or args.samples != "1000" or args.draws != "random" or args.seed != "0":
        raise InputError(
            f"merge {args.case!r}: its manifest has the options of the shards; leave out all"
            " options but --limit"
        )
    case, options = restore(args.case)
    if args.limit:
        options["limits"] = limits_of(args, case.replace(limits=options["limits"]))
    args.out = args.case
    return _report(ensemble(case, folder=args.out, resume=True, merge=True, **options), args)


def _ensemble(args, **options):
    from tuning.uncertainty.study import ensemble

    case = open_case(args)
    return ensemble(
        case,
        distributions_of(args, case),
        samples=whole("--samples", args.samples, 1, 10**8),
        key=seed_of(args),
        draws=args.draws,
        measures=tuple(args.measure) or None,
        limits=limits_of(args, case),
        **options,
    )


def _report(found, args):
    """Write and print an Ensemble; returns the exit code."""
    from tuning.report import tables

    try:
        written = found.save(args.out, args.line) if args.out else []
    finally:  # a full disk costs the files, not the printed result
        print(tables.dumps(found.to_json()) if args.json else str(found))
    report_written(written, args)
    return 0


def _shard(text):
    """(i, n) of --shard I/N."""
    try:
        i, n = (int(part) for part in text.split("/"))
    except ValueError:
        raise InputError(
            f"--shard {text!r}: must be I/N, as 1/4 for the first of four shares"
        ) from None
    if not 1 <= n <= 10**6:
        raise InputError(f"--shard {text!r}: there may be 1 to 1000000 shares")
    if not 1 <= i <= n:
        raise InputError(f"--shard {text!r}: with {n} shares they are 1/{n} to {n}/{n}")
    return i, n


def sensitivity(args):
    """Print which parameter changes which measure."""
    devices = devices_of(args)
    seed, case = seed_of(args), open_case(args)
    varied = distributions_of(args, case)
    from tuning.report import tables
    from tuning.uncertainty import sensitivity_study as study

    line = Line(args.quiet)
    derivatives = " and its derivatives" if args.method == "local" else ""
    line.compiling(f"the simulation{derivatives}", 5)
    result = study.sensitivity(
        case,
        varied,
        method=args.method,
        measures=args.measure or None,
        samples=None if args.samples is None else whole("--samples", args.samples, 1, study.MOST),
        seed=seed,
        devices=devices,
        cluster=args.cluster,
        progress=line.runs,
    )
    line.end()
    try:
        written = result.save(args.out, args.line) if args.out else []
    finally:
        print(tables.dumps(result.to_json()) if args.json else str(result))
    report_written(written, args)
    return 0

"""`jaxtank uncertainty`, `merge` and `sensitivity`: many runs of a case."""

import os
import sys

from jaxtank.core.errors import InputError
from jaxtank.core.text import printable
from tuning.cli.options import devices_of, distributions_of, limits_of, tell_written
from tuning.cli.values import open_case, whole
from tuning.cli.values import seed as seed_of


def uncertainty(args):
    shard = None
    if args.shard is not None:
        shard = _shard(args.shard)
        if not args.out and not args.resume:
            raise InputError(f"--shard {args.shard!r}: needs --out DIR, where the shares meet")
    args.out = args.resume or args.out
    devices = devices_of(args)
    progress = (
        None if args.quiet else lambda done: print(f"{done} draws", file=sys.stderr, flush=True)
    )
    found = _ensemble(
        args,
        devices=devices,
        shard=shard,
        folder=args.out,
        resume=args.resume is not None,
        progress=progress,
    )
    if found is None:
        if not args.quiet:
            print(
                f"shard {args.shard} is in {printable(args.out)}; `jaxtank merge` joins the shards"
                " when all are",
                file=sys.stderr,
            )
        return 0
    return _told(found, args)


def merge(args):
    """Of a folder alone, by what its manifest says; of a case with the options of its shards and
    --out DIR.
    """
    if args.out:
        return _told(_ensemble(args, folder=args.out, resume=True, merge=True), args)
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
            f"merge {args.case!r}: the folder says what its shards are of; leave the other options"
            " out (but --limit)"
        )
    case, options = restore(args.case)
    if args.limit:
        options["limits"] = limits_of(args, case.replace(limits=options["limits"]))
    args.out = args.case
    return _told(ensemble(case, folder=args.out, resume=True, merge=True, **options), args)


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


def _told(found, args):
    """Write, print and end with an Ensemble."""
    from tuning.report import tables

    try:
        written = found.save(args.out, args.line) if args.out else []
    finally:  # a disk that is full costs the files, not the answer
        print(tables.dumps(found.to_json()) if args.json else str(found))
    tell_written(written, args)
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
    devices = devices_of(args)
    seed, case = seed_of(args), open_case(args)
    varied = distributions_of(args, case)
    from tuning.report import tables
    from tuning.uncertainty.sensitivity_study import MOST, sensitivity

    terminal, told = sys.stderr.isatty(), [0]

    def progress(done, total):
        if args.quiet or (not terminal and done < total and done - told[0] < total / 10):
            return
        told[0] = done
        start, end = ("\r", "") if terminal else ("", "\n")
        print(f"{start}run {done}/{total}", end=end, file=sys.stderr, flush=True)

    result = sensitivity(
        case,
        varied,
        method=args.method,
        measures=args.measure or None,
        samples=None if args.samples is None else whole("--samples", args.samples, 1, MOST),
        seed=seed,
        devices=devices,
        progress=progress,
    )
    if terminal and not args.quiet:
        print(file=sys.stderr)
    try:
        written = result.save(args.out, args.line) if args.out else []
    finally:
        print(tables.dumps(result.to_json()) if args.json else str(result))
    tell_written(written, args)
    return 0

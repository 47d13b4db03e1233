"""Values of the options that several commands share, and the report of written files."""

import re
import sys

from jaxtank.core.errors import InputError
from jaxtank.core.text import printable
from tuning.cli.values import number, once, pair, parse_value, plain_number, settings


def limits_of(args, case):
    """Return the limits of a case as --limit changes them."""
    limits, given = dict(case.limits), [text.partition("=")[0].strip() for text in args.limit]
    for name in given:
        if given.count(name) > 1:
            raise InputError(
                f"--limit {name} is given {given.count(name)} times: give it once (several tanks:"
                f" {name}=[30,28])"
            )
    for text in args.limit:
        if text == "none":
            limits = {}
            continue
        measure, value = pair("--limit", text)
        from jaxtank.measures import check_names

        check_names([measure])
        if value == "none":
            limits.pop(measure, None)
        else:
            limits[measure] = value
    return limits


def scenarios_of(args):
    """Return the Scenarios of --scenario, None without, () for "none"."""
    if not args.scenario:
        return None
    if args.scenario == ["none"]:
        return ()
    return tuple(_scenario(args, i, text) for i, text in enumerate(args.scenario))


def _scenario(args, i, text):
    """The Scenario of the i-th --scenario."""
    from jaxtank import rig
    from jaxtank.presets import Scenario

    pairs = [pair("--scenario", part) for part in text.split(";") if part.strip()]
    values = once("--scenario", pairs) or {}
    for name, value in values.items():
        set_too = any(rig.overlap(name, given) for given in settings(args))
        if set_too and not rig.is_change(value):
            raise InputError(
                f"--scenario {text!r} sets {name}, which --set or --dt sets too: give one of them,"
                f" or a factor, as {name}=x1.1"
            )
    seed, weight = values.pop("seed", i), values.pop("weight", 1.0)
    return Scenario(values.pop("name", text), values, seed, weight)


def choices_of(args):
    """Return {name: values} of --choose, None without."""

    def values(name, text):
        parts = [part.strip() for part in text.split(",")]
        if "" in parts or any(re.match(r"[+-]?0\d", part) for part in parts):
            raise InputError(
                f"--choose {name}={text}: must be values with commas between them, decimals with a"
                " point, as 0.5,1.5"
            )
        return [parse_value(part, f"--choose {name}") for part in parts]

    pairs = [pair("--choose", text, str) for text in args.choose]
    return once("--choose", [(name, values(name, text)) for name, text in pairs])


def tradeoff_of(args):
    """Return (measure, values) of --tradeoff, None without."""
    if args.tradeoff is None:
        return None
    measure, text = pair("--tradeoff", args.tradeoff, str)
    parts, low, high, count = text.split(":"), 0.0, 0.0, 0
    try:
        low, high = (float(plain_number(p)) for p in parts[:2])
        count = int(parts[2]) if len(parts) > 2 else 6
        good = len(parts) <= 3 and low < high and 2 <= count <= 50
    except ValueError:
        good = False
    if not good:
        raise InputError(
            f"--tradeoff {args.tradeoff!r}: must be MEASURE=LOW:HIGH or MEASURE=LOW:HIGH:N, LOW"
            " below HIGH, N from 2 to 50"
        )
    from jaxtank.measures import check_names

    check_names([measure])
    return measure, [low + (high - low) * i / (count - 1) for i in range(count)]


def distributions_of(args, case):
    """Return {name: distribution} of --vary or --spread, None without."""
    from tuning.uncertainty.sampling import spread_of

    if args.vary and args.spread is not None:
        raise InputError(
            "--vary names what varies, --spread how much all that the case calls uncertain varies:"
            " give one of them"
        )
    if args.vary:
        varied = [_pair_of(text, case) for text in args.vary]
        if len({name for name, _ in varied}) < len(varied):
            raise InputError("--vary: a parameter is given twice")
        return dict(varied)
    if args.spread is None:
        return None
    share = number("--spread", args.spread)
    if not 0 < share < 1:
        raise InputError(f"--spread {args.spread!r}: must be a share between 0 and 1")
    return spread_of(case, share)


def _pair_of(text, case):
    """(name, distribution) of one --vary, if every draw of it is a value that the case may have."""
    from tuning.uncertainty.distributions import parse
    from tuning.uncertainty.draws import Draws

    name, value = pair("--vary", text, str)
    try:
        found = parse(name, value)
        Draws(case.loop, {name: found})
    except InputError as error:
        raise InputError(f"--vary {text}: {error}") from None
    return name, found


def devices_of(args):
    """Return the number of --devices; jax must be configured before it starts."""
    if args.devices > 1:
        import jax

        jax.config.update("jax_num_cpu_devices", args.devices)
    return args.devices


def finish(result, args):
    """Write a result to --out and print it; return the paths that were written."""
    from tuning.report import tables

    written = []
    try:
        written = result.save(args.out, args.line) if args.out else []
    finally:  # a full disk costs the files, not the printed result; and the checkpoint is kept
        print(tables.dumps(result.to_json()) if args.json else str(result))
    if args.out and hasattr(args, "resume") and getattr(result, "status", "") != "interrupted":
        from tuning.storage.store import discard

        discard(args.out)
    report_written(written, args)
    return written


def report_written(paths, args):
    """Print the names of written files on stderr."""
    if paths and not args.quiet:
        print(
            f"written to {printable(args.out)}: " + ", ".join(p.name for p in paths),
            file=sys.stderr,
        )


def report_unreachable(case, paths, args):
    """Print a note where the written rig.toml of `case` states `reachable = false` anew."""
    from jaxtank import rig

    if (
        any(p.name == "rig.toml" for p in paths)
        and case.reachable
        and not args.quiet
        and (why := rig.unreachable(case))
    ):
        print(
            f"jaxtank: {printable(args.out.rstrip('/'))}/rig.toml: note: {why}; the file says"
            " reachable = false for it",
            file=sys.stderr,
        )

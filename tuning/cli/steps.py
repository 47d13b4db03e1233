"""Steps of several commands: open the case, read its options, write and print the result."""

import contextlib
import sys

from jaxtank.core.errors import InputError
from jaxtank.core.text import printable
from tuning.cli.terminal import coloured, end_lines, phase

FILTER = "safety_filter."


def note(args, sentence):
    if not args.quiet:
        print(f"jaxtank: note: {sentence}", file=sys.stderr)


def picked(args, names):
    """Return {name: value} of several arguments, named in one text."""
    return {name: getattr(args, name) for name in names.split()}


def use_float64():
    """Have jax compute in float64."""
    import jax

    jax.config.update("jax_enable_x64", True)


def open_case(args):
    """Return the checked case of the command line, in float64; warnings go to stderr."""
    use_float64()
    from jaxtank import rig
    from jaxtank.loop import tank_bottom

    phase.show("opening the case")
    duration = args.values.get("clock.duration")
    opened = noted = rig.open_case(args.case, duration)
    if duration is not None:
        with contextlib.suppress(InputError):  # which is raised where it is set
            noted = rig.set_values(opened, {"clock.duration": duration})
    args.values = rig.by_rig_name(opened.loop, args.values)
    for option in ("free", "vary"):
        if pairs := getattr(args, option, None):
            named = {rig.dotted_name(opened.loop, name): value for name, value in pairs.items()}
            setattr(args, option, named)
    values = settings(args)
    file_notes = [] if args.quiet else rig.case_warnings(noted)
    for sentence in file_notes if args.case.endswith(".toml") else ():
        print(f"jaxtank: {printable(args.case)}: note: {sentence}", file=sys.stderr)
    of_filter = {n.removeprefix(FILTER): v for n, v in values.items() if n.startswith(FILTER)}
    values = {n: v for n, v in values.items() if not n.startswith(FILTER)}
    case = rig.set_and_schedule(opened, values, _schedule(args.schedule))
    case, replaced = rig.overridden(case, values)
    if "plant.bottom" not in values and not tank_bottom.can_withdraw(opened.loop):
        case = rig.with_bottom(case)
    case = rig.filtered(rig.check(case), args.safety_filter, of_filter)
    if not args.quiet:
        _note_warnings(args, case, replaced, file_notes)
    return case


def _note_warnings(args, case, replaced, file_notes):
    """Print the notes on a case, without those on its file, which are printed before."""
    from jaxtank import rig
    from jaxtank.loop import step_size

    stated = case.replace(limits=limits_of(args, case)) if getattr(args, "limit", None) else case
    sentences = rig.case_warnings(stated) + _not_proved(case)
    sentences += step_size.step_warnings(case.loop, case.clock)
    if args.command == "tune" and not args.scenario:
        sentences = [*(_replaced(*item) for item in replaced.items()), *sentences]
    for sentence in sentences:
        if sentence not in file_notes:
            note(args, sentence)


def settings(args):
    """Return {name: value} of --set and --dt."""
    if args.dt is None:
        return args.values
    if "clock.dt" in args.values:
        both = f"--dt {args.dt:g} beside --set clock.dt={args.values['clock.dt']}"
        raise InputError(f"{both}: give one of them")
    return args.values | {"clock.dt": args.dt}


def _replaced(name, scenarios):
    """A sentence: a value of --set replaces the values in scenarios."""
    from jaxtank.core.text import count

    names = [repr(printable(s)) for s in scenarios[:3]] + ["..."] * (len(scenarios) > 3)
    return (
        f"--set {name} also replaces the value of {name} in {count(len(scenarios), 'scenario')}"
        f" ({', '.join(names)})"
    )


def _not_proved(case):
    """Sentences on tanks whose limits the safety filter of the case is not proved to keep."""
    if case.loop.safety_filter is None:
        return []
    from jaxtank.core.labels import label_of
    from jaxtank.safety.of_case import certificates_of

    rows = certificates_of(case)
    high = [("limit", row.tank, row.reason) for row in rows if not row.certified]
    unproved = (row for row in rows if row.low > 0.0 and not row.low_certified)
    low = [("low limit", row.tank, row.low_reason) for row in unproved]
    return [
        f"safety filter: the {limit} of {label_of(case.loop.plant, 'tank', tank)} is not proved:"
        f" {reason}"
        for limit, tank, reason in high + low
    ]


def _schedule(gains):
    """Return the table [schedule] of a rig file for {gain: (variable, knots)} of --schedule."""
    if not gains:
        return {}
    (variable, knots), *others = gains.values()
    if any(other != (variable, knots) for other in others):
        raise InputError("--schedule: variable and knots must be the same for all gains")
    return {"gains": list(gains), "variable": variable, "knots": knots}


def limits_of(args, case):
    """Return the limits of a case as --limit changes them, numbers in its units."""
    from jaxtank import rig

    limits = {} if "none" in args.limit else dict(case.limits)
    limits |= {name: limit for name, limit in args.limit.items() if "." not in name}
    stated = {m: limit for m, limit in limits.items() if limit is not None}
    limits = rig.check_limits(case.loop, stated)
    entries = {name: limit for name, limit in args.limit.items() if "." in name}
    return limits | rig.check_limits(case.loop, entries, limits)


def measures_of(args, case):
    """Return the measures of --measure, None without; the parts that it names must be the rig's."""
    from jaxtank.core.labels import index_of
    from jaxtank.measures import MEASURES

    for measure, part in args.measure:
        per, label = MEASURES[measure].per, f"--measure {measure}"
        if part and per == "run":
            raise InputError(
                f"{label}.{part}: {measure} is one number of the run: leave .{part} out"
            )
        if part:
            index_of(label, case.loop.plant, per, part)
    return tuple(dict.fromkeys(measure for measure, _ in args.measure)) or None


def scenarios_of(args):
    """Return the Scenarios of --scenario, None without, () for "none"."""
    if not args.scenario:
        return None
    if args.scenario == [None]:
        return ()
    from jaxtank import rig
    from jaxtank.presets import Scenario

    scenarios = []
    for i, (text, values) in enumerate(args.scenario):
        for name, value in values.items():
            set_too = any(rig.overlap(name, other) for other in settings(args))
            if set_too and not rig.is_change(value):
                raise InputError(
                    f"--scenario {text!r} sets {name}, which --set or --dt sets too: give one of"
                    f" them, or a factor, as {name}=x1.1"
                )
        stated = {"name": text, "seed": i, "weight": 1.0} | values
        name, seed, weight = (stated.pop(key) for key in ("name", "seed", "weight"))
        scenarios.append(Scenario(name, stated, seed, weight))
    return tuple(scenarios)


def distributions_of(args, case):
    """Return {name: distribution} of --vary or --spread, None without."""
    from tuning.uncertainty.distributions import parse
    from tuning.uncertainty.draws import Draws
    from tuning.uncertainty.sampling import spread_of

    if args.vary and args.spread is not None:
        raise InputError(
            "--vary names what varies, --spread how much all that the case calls uncertain varies:"
            " give one of them"
        )
    if not args.vary:
        return None if args.spread is None else spread_of(case, args.spread)
    distributions = {}
    for name, text in args.vary.items():
        try:
            distributions[name] = parse(name, text)
            Draws(case.loop, {name: distributions[name]}).check_effect()  # and may be drawn
        except InputError as error:
            raise InputError(f"--vary {name}={text}: {error}") from None
    return distributions


def use_devices(args):
    """Have jax use the number of --devices; before it starts."""
    if args.devices > 1:
        import jax

        jax.config.update("jax_num_cpu_devices", args.devices)


def print_result(args, payload, text, outcome="", written=()):
    """Print `text()`, or with --json an object, to which `outcome` adds a verdict."""
    if not args.json:
        output = text()
    else:
        from tuning.report import tables, verdict

        more = {"verdict": verdict.outcome(outcome).to_json()} if outcome else {}
        output = tables.dumps({**payload, **more})
    end_lines()
    print(output)
    report_written(written, args)


def printed(report):
    """Return the text of a Report, in colours where stdout takes them."""
    from tuning.report.document import terminal

    return terminal(report, coloured(sys.stdout), advice=True)


def show_end(args):
    """Show the phase after the search."""
    phase.show("writing results and pictures" if args.out else "working out what to report")


def finish(result, args):
    """Write a result to --out and print it; return the paths that were written."""
    written = []
    show_end(args)
    try:
        written = result.save(args.out, args.line) if args.out else []
    finally:  # a full disk costs the files, not the printed result; and the checkpoint is kept
        payload = result.to_json() if args.json else None
        print_result(args, payload, lambda: printed(result.report()))
    if args.out and hasattr(args, "resume") and getattr(result, "status", "") != "interrupted":
        from tuning.storage.store import discard

        discard(args.out)
    report_written(written, args)
    return written


def report_written(paths, args):
    """Print the names of written files on stderr."""
    if paths and not args.quiet:
        names = ", ".join(path.name for path in paths)
        print(f"written to {printable(args.out)}: {names}", file=sys.stderr)


def report_unreachable(case, paths, args):
    """Print a note where the written rig.toml of `case` states `reachable = false` anew."""
    from jaxtank import rig

    if args.quiet or not case.reachable or all(path.name != "rig.toml" for path in paths):
        return
    if why := rig.unreachable(case):
        file = f"{printable(args.out.rstrip('/'))}/rig.toml"
        says = "the file says reachable = false for it"
        print(f"jaxtank: {file}: note: {why}; {says}", file=sys.stderr)

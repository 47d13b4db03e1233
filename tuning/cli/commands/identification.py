"""The command `jaxtank identify`: experiment data in, a rig to tune out; `--plan` compares
experiments before one is made.
"""

import sys

from jaxtank.core.errors import InputError
from jaxtank.core.text import printable
from tuning.cli import values
from tuning.cli.arguments import option, repeatable, whole
from tuning.cli.interrupts import Interrupts, put_back
from tuning.cli.options import finish, report_unreachable
from tuning.cli.terminal import Line
from tuning.cli.values import number

LONGEST = 1e7
"""Longest planned experiment [s]: four months."""

STATUS = {"converged": 0, "not_converged": 3, "not_identifiable": 5, "interrupted": 130}
PLANNED = ("duration", "voltage", "measure")
"""Options of a planned experiment."""


def add(commands, parents):
    """Add the command to the parser's `commands`."""
    one = commands.add_parser(
        "identify",
        parents=parents,
        help="plant parameters from experiment data, with intervals; --out DIR writes a rig to"
        " tune",
    )
    one.set_defaults(run=run)
    _add_data(one)
    _add_fit(one)
    _add_plan(one)


def _add_data(one):
    """Options on the experiment data."""
    text = "experiment data; repeatable: several experiments with first levels each"
    one.add_argument("--data", action="append", default=[], metavar="CSV", help=text)
    repeatable(
        one,
        "--column",
        "SLOT=HEADER[;UNIT]",
        "which column is t, pump1, .., h1, .., where its header is in other words; h3=none: leave"
        " that level out",
    )
    option(one, "--decimal", "SIGN", "decimal sign of the data: . (default) or ,", ".")
    option(
        one,
        "--gap",
        "X",
        "longest step between samples, in median steps (default 1.5)",
        1.5,
        number,
    )
    text = "inputs between samples: zero-order (each until the next row) or first-order (a line)"
    option(one, "--hold", "HOW", text, "")
    text = "end of the data that validates a first fit: share, or samples (default 0.25)"
    option(one, "--hold-back", "SHARE", text, 0.25, number)
    text = "standard deviation of the readings, one or one per channel (default: from the data)"
    option(one, "--noise", "SD", text)


def _add_fit(one):
    """Options on what is estimated and how."""
    repeatable(
        one,
        "--free",
        "NAME=LOW:HIGH",
        "what to estimate, of plant, sensor, actuator, disturbance (default: pump gains, splits,"
        " orifices, pipes)",
    )
    option(one, "--start", "HOW", "first levels: free (default), measured, or case", "free")
    option(one, "--starts", "N", "searches (default 8)", 8, whole(1, 1000))
    text = "evaluations of each search (default 100)"
    option(one, "--iterations", "N", text, 100, whole(1, 100_000))
    option(one, "--loss", "NAME", "linear (default), soft_l1 or huber", "linear")
    text = "write the rig under a controller to tune: pi, with gains from the identified model"
    option(one, "--law", "KIND", text)
    one.add_argument(
        "--profile",
        action="store_true",
        help="also: profile likelihood of the least certain parameter",
    )
    text = "continue a killed run with --out DIR, to the same result"
    option(one, "--resume", "DIR", text)


def _add_plan(one):
    """Options on a planned experiment."""
    one.add_argument(
        "--plan",
        action="store_true",
        help="no data: compare experiments by the standard deviations they would leave",
    )
    option(one, "--duration", "S", "of a planned experiment [s] (default 300)", None, number)
    text = "inputs about which a planned experiment works (default: the case's own)"
    option(one, "--voltage", "V1,V2", text)
    option(one, "--measure", "H1,H2", "tanks measured in a planned experiment (default all)")


def run(args):
    """Run the command; returns the exit code."""
    with put_back():
        case = values.open_case(args)
        pairs = [values.pair("--free", text, values.span) for text in args.free]
        free = values.once("--free", pairs)
        code = _plan(args, case, free) if args.plan else _identify(args, case, free)
        sys.stdout.flush()  # the result is out before Ctrl-C ends the program at once again
        return code


def _identify(args, case, free):
    """Identify, then write and print the result; returns the exit code."""
    args.out = args.resume or args.out
    _check_data_given(args)
    from tuning.identification.fit import identify

    logs = _read(args, case)
    options = _options(args, logs)

    def ready():  # not before: data that are refused get one line
        if not args.quiet:
            names, samples = ", ".join(one.name for one in logs), sum(one.samples for one in logs)
            print(f"{names}: {samples} samples", file=sys.stderr, flush=True)
            line.compiling("the simulation and its derivatives", 10)

    line, interrupts = Line(args.quiet), Interrupts()
    found = identify(case, logs, free, progress=interrupts.check, ready=ready, **options)
    line.end()
    _report_next(args, found, free, finish(found, args))
    return interrupts.code if interrupts.stop else STATUS[found.status]


def _check_data_given(args):
    """Raise InputError for options of a planned experiment, and without experiment data."""
    for name in PLANNED:
        if getattr(args, name) is not None:
            raise InputError(
                f"--{name} {getattr(args, name)}: belongs to a planned experiment, with --plan"
            )
    if not args.data:
        raise InputError(
            "identify needs --data CSV, experiment data of the rig (or --plan, to compare"
            " experiments before making one)"
        )


def _read(args, case):
    """Return the Logs of --data."""
    from tuning.identification.csv_log import read_log

    pairs = [values.pair("--column", text, _column) for text in args.column]
    columns = dict(case.log) | (values.once("--column", pairs) or {})
    return [read_log(path, case.loop, columns, args.decimal, args.hold) for path in args.data]


def _column(text):
    """Return HEADER, or (HEADER, UNIT) of HEADER;UNIT."""
    header, semicolon, unit = text.rpartition(";")
    return (header.strip(), unit.strip()) if semicolon else text


def _options(args, logs):
    """Return the keyword arguments of `identify`."""
    if not args.gap >= 1:
        raise InputError(f"--gap {args.gap:g}: must be at least 1")
    return {
        "start": args.start,
        "starts": args.starts,
        "seed": args.seed,
        "hold_back": _hold_back(args, logs),
        "noise": _noise(args),
        "loss": args.loss,
        "profile": args.profile,
        "iterations": args.iterations,
        "gap": args.gap,
        "checkpoint": args.out,
        "resume": args.resume is not None,
        "law": args.law,
    }


def _hold_back(args, logs):
    """Return the share, or number of samples, of the validation set."""
    hold = args.hold_back
    if not 0 <= hold < min(one.samples for one in logs) or (hold >= 1 and hold != int(hold)):
        raise InputError(
            f"--hold-back {hold:g}: must be a share from 0 to below 1, or a whole number"
            " of samples, fewer than the data have"
        )
    return hold if hold < 1 else int(hold)


def _noise(args):
    """Return --noise: a standard deviation, a list of them, or None."""
    if args.noise is None:
        return None
    noise = values.parse_value(args.noise, "--noise")
    entries = noise if isinstance(noise, list) else [noise]
    if not entries or any(isinstance(v, (str, bool)) or not v > 0 for v in entries):
        raise InputError(
            f"--noise {args.noise!r}: must be a number above 0, or [SD1,SD2,...], one per channel"
        )
    return noise


def _report_next(args, found, free, written):
    """Print on stderr why no rig is written, or what to do with the one that is."""
    from tuning.report.identification import not_identifiable

    if written:
        report_unreachable(found.identified, written, args)
    if found.directions and not found.identifiable:
        names = "; ".join(not_identifiable(d) for d in found.directions)
        print(
            f"jaxtank: {printable(', '.join(args.data))}: not identifiable from these data:"
            f" {names}: no rig is written; {_advice(found, free)}",
            file=sys.stderr,
        )
    elif (
        any(path.name == "rig.toml" for path in written)
        and found.status == "converged"
        and not args.quiet
    ):
        print(_next_command(found, f"{printable(args.out.rstrip('/'))}/rig.toml"), file=sys.stderr)


def _next_command(found, file):
    """Return what to do with the rig that was written to `file`."""
    case, why = found.proposed
    if why:
        return f"jaxtank: {file}: note: --law {found.law}: {why}"
    if case.free:
        return f"go on with: jaxtank tune {file} --robust cvar"
    return (
        f"{file} has no controller to tune: identify with --law pi for a PI controller with gains"
        " from this model, or give the file a [controller], a [reference] with changes, and [free]"
    )


def _advice(found, free):
    """Return what to do about parameters that are not identifiable from the data."""
    directions = [list(d["parameters"]) for d in found.directions]
    alone = [names[0] for names in directions if len(names) == 1 and names[0] in found.parameters]
    if free is None:
        which = f"all but {', '.join(alone)}" if alone else "fewer than by default"
        return (
            f"choose with --free NAME=LOW:HIGH what to estimate ({which}), or use data that excite"
            f" {'it' if len(alone) == 1 else 'them'}"
        )
    if alone:
        return f"leave {', '.join(alone)} out of --free"
    return "free fewer, or use data that excite them"


def _plan(args, case, free):
    """Compare experiments and print the result; returns the exit code."""
    _check_plan(args)
    from tuning.identification.design import compare_experiments, most_informative
    from tuning.report import tables
    from tuning.report.document import terminal
    from tuning.report.identification import plan_report

    duration = 300.0 if args.duration is None else args.duration
    if not 0 < duration <= LONGEST:
        raise InputError(f"--duration {duration:g}: must be above 0 s and at most {LONGEST:g} s")
    plan = {
        "duration": duration,
        "dt": duration / 300,
        "levels": _measured(args, case),
        "voltage": _voltage(args, case),
        "noise": _planned_noise(args, case),
    }
    found = compare_experiments(case, free, start="known", **plan)
    best = most_informative(found)
    if not args.json:
        print(terminal(plan_report(case, found, best, plan)))
        return 0
    given = {n: plan[n] for n in ("noise", "duration", "dt")}
    result = {"case": case.name, **given, "experiments": found, "most_informative": best}
    print(tables.dumps(tables.clean(result)))
    return 0


def _check_plan(args):
    """Raise InputError for options that are not of a planned experiment."""
    if args.data:
        raise InputError(
            "--plan compares experiments before there are data: leave it out to fit --data"
            f" {args.data[0]!r}"
        )
    if args.law:
        raise InputError(f"--plan identifies nothing: leave --law {args.law!r} out")
    if args.out:
        raise InputError(
            f"--plan writes no files: leave --out {args.out!r} out (--json prints what it found)"
        )


def _measured(args, case):
    """Return the tanks of --measure, counted from 0, or None for all."""
    if not args.measure:
        return None
    names = [f"h{i + 1}" for i in range(case.loop.plant.tanks)]
    words = [word.strip() for word in args.measure.split(",")]
    for word in words:
        if word not in names:
            raise InputError(f"--measure {word!r}: must be among {', '.join(names)}")
    return sorted({names.index(word) for word in words})


def _voltage(args, case):
    """Return the inputs of --voltage, or None for the case's own."""
    if args.voltage is None:
        return None
    voltage = [number("--voltage", text) for text in args.voltage.split(",")]
    high = [float(v) for v in case.loop.actuator.high]
    if len(voltage) != len(high) or not all(0 < v <= top for v, top in zip(voltage, high)):
        raise InputError(
            f"--voltage {args.voltage!r}: must be {len(high)} numbers above 0 and at most"
            f" {', '.join(f'{v:g}' for v in high)} {case.loop.units[1]}"
        )
    return voltage


def _planned_noise(args, case):
    """Return the standard deviation of the readings: given, the case's, or 0.5 % of the rim."""
    if args.noise:
        noise = number("--noise", args.noise)
    else:
        noise = max(map(float, case.loop.sensor.noise)) or 0.005 * max(
            map(float, case.loop.plant.rim)
        )
    if not noise > 0:
        raise InputError(f"--noise {args.noise!r}: must be above 0")
    return noise

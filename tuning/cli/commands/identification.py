"""The command `jaxtank identify`: a log in, a rig out; or, with --plan, which experiment to make.
Imports nothing heavy before it runs.
"""

import sys

from jaxtank.core.errors import InputError
from jaxtank.core.text import printable
from tuning.cli import values
from tuning.cli.interrupts import Interrupts, put_back
from tuning.cli.options import report_unreachable

LONGEST = 1e7
"""Longest experiment that is planned [s]: four months."""

STATUS = {"converged": 0, "not_converged": 3, "not_identifiable": 5, "interrupted": 130}


def add(commands, parents):
    """Add the command to the parser's `commands`."""
    one = commands.add_parser(
        "identify",
        parents=parents,
        help="plant parameters from a log, with intervals; --out DIR writes a rig to tune",
    )
    one.add_argument(
        "--data",
        action="append",
        default=[],
        metavar="CSV",
        help="a log; repeatable: several experiments with a start each",
    )
    one.add_argument(
        "--free",
        action="append",
        default=[],
        metavar="NAME=LOW:HIGH",
        help=(
            "what to estimate, of plant, sensor, actuator, disturbance (default: pump gains,"
            " splits, orifices, pipes); repeatable"
        ),
    )
    one.add_argument(
        "--column",
        action="append",
        default=[],
        metavar="SLOT=HEADER[;UNIT]",
        help=(
            "which column is t, pump1, .., h1, .., where its header does not say so; h3=none: leave"
            " that level out; repeatable"
        ),
    )
    one.add_argument(
        "--decimal", default=".", metavar="SIGN", help="decimal sign of the log: . (default) or ,"
    )
    one.add_argument(
        "--gap",
        default="1.5",
        metavar="X",
        help="longest step between samples, in median steps (default 1.5)",
    )
    one.add_argument(
        "--resume",
        metavar="DIR",
        help="go on where a killed run with --out DIR ended, to the same answer",
    )
    one.add_argument(
        "--start",
        default="free",
        metavar="HOW",
        help="first levels: free (default), measured, or case",
    )
    one.add_argument("--starts", default="8", metavar="N", help="searches (default 8)")
    one.add_argument(
        "--iterations", default="100", metavar="N", help="evaluations of each search (default 100)"
    )
    one.add_argument(
        "--hold-back",
        default="0.25",
        metavar="SHARE",
        help="end of the log to predict before all is fitted: share, or samples",
    )
    one.add_argument(
        "--noise",
        metavar="SD",
        help="standard deviation of the readings, one or one per channel (default: from the log)",
    )
    one.add_argument(
        "--loss", default="linear", metavar="NAME", help="linear (default), soft_l1 or huber"
    )
    one.add_argument(
        "--law",
        metavar="KIND",
        help="write the rig under a controller to tune: pi, with gains from the identified model",
    )
    one.add_argument(
        "--profile",
        action="store_true",
        help="also: profile likelihood of the parameter known worst",
    )
    one.add_argument(
        "--plan",
        action="store_true",
        help="no log: compare experiments by the standard deviations they would leave",
    )
    one.add_argument("--duration", metavar="S", help="of a planned experiment [s] (default 300)")
    one.add_argument(
        "--voltage",
        metavar="V1,V2",
        help="pump inputs that a planned experiment works about (default: the case's own)",
    )
    one.add_argument(
        "--measure",
        metavar="H1,H2",
        help="tanks that are measured in a planned experiment (default all)",
    )


def run(args):
    """Run the command; returns the exit code."""
    args.out = args.resume or args.out
    seed, case = values.seed(args), values.open_case(args)
    free = values.once("--free", [values.pair("--free", text, values.span) for text in args.free])
    if args.plan:
        return plan(args, case, free)
    for option, given in (
        ("--duration", args.duration),
        ("--voltage", args.voltage),
        ("--measure", args.measure),
    ):
        if given is not None:
            raise InputError(
                f"{option} {given!r}: is of an experiment that is planned, with --plan"
            )
    if not args.data:
        raise InputError(
            "identify needs --data CSV, a log of the rig (or --plan, to compare experiments before"
            " making one)"
        )
    from tuning.identification.csv_log import read_log
    from tuning.identification.fit import identify
    from tuning.report import identification, tables
    from tuning.storage.evaluation_log import discard

    given = values.once(
        "--column", [values.pair("--column", text, _column) for text in args.column]
    )
    columns = dict(case.log) | (given or {})
    logs = [read_log(path, case.loop, columns, args.decimal) for path in args.data]
    hold = values.number("--hold-back", args.hold_back)
    if not 0 <= hold < min(one.samples for one in logs):
        raise InputError(
            f"--hold-back {args.hold_back!r}: must be a share from 0 to below 1, or a number of"
            " samples of the log"
        )
    noise = None
    if args.noise is not None:
        noise = values.parse_value(args.noise, "--noise")
        entries = noise if isinstance(noise, list) else [noise]
        if not entries or any(isinstance(v, (str, bool)) or not v > 0 for v in entries):
            raise InputError(
                f"--noise {args.noise!r}: must be a number above 0, or [SD1,SD2,...], one per"
                " channel"
            )
    gap = values.number("--gap", args.gap)
    if not gap >= 1:
        raise InputError(f"--gap {args.gap!r}: must be at least 1")

    def ready():  # not before: data that are refused get one line
        if not args.quiet:
            print(
                f"{', '.join(one.name for one in logs)}: {sum(one.samples for one in logs)}"
                " samples",
                file=sys.stderr,
                flush=True,
            )

    interrupts = Interrupts()
    found = identify(
        case,
        logs,
        free,
        start=args.start,
        starts=values.whole("--starts", args.starts, 1, 1000),
        seed=seed,
        hold_back=hold if hold < 1 else _samples(args.hold_back),
        noise=noise,
        loss=args.loss,
        profile=args.profile,
        iterations=values.whole("--iterations", args.iterations, 1, 100_000),
        gap=gap,
        folder=args.out,
        resume=args.resume is not None,
        progress=interrupts.check,  # between two searches
        ready=ready,
        law=args.law,
    )
    try:
        written = found.save(args.out, args.line) if args.out else []
    finally:  # a disk that is full costs the files, not the answer; and the log is kept
        print(tables.dumps(found.to_json()) if args.json else repr(found))
    if args.out and found.status != "interrupted":
        discard(args.out)  # the result is whole: there is nothing left to go on with
    if written and not args.quiet:
        print(
            f"written to {printable(args.out)}: " + ", ".join(p.name for p in written),
            file=sys.stderr,
        )
        report_unreachable(found.identified, written, args)
    if found.directions and not all(p["identifiable"] for p in found.parameters.values()):
        words = "; ".join(f"cannot tell {identification.untold(d)}" for d in found.directions)
        print(
            f"jaxtank: {printable(', '.join(args.data))}: {words}: no rig is written;"
            f" {_advice(found, free)}",
            file=sys.stderr,
        )
    elif (
        any(path.name == "rig.toml" for path in written)
        and found.status == "converged"
        and not args.quiet
    ):
        print(_next(found, f"{printable(args.out.rstrip('/'))}/rig.toml"), file=sys.stderr)
    return STATUS["interrupted" if interrupts.stop else found.status]


def _next(found, file):
    """What to do with the rig that was written to `file`."""
    case, why = found.proposed
    if why:
        return f"jaxtank: {file}: note: --law {found.law}: {why}"
    if case.free:
        return f"go on with: jaxtank tune {file} --robust cvar"
    return (
        f"{file} has no controller to tune: identify with --law pi for a PI controller with gains"
        " from this model, or give the file a [law], a [reference] that changes and [free] ranges"
    )


def _advice(found, free):
    """What to do about parameters that the data cannot tell."""
    alone = [
        n
        for d in found.directions
        if len(d["parameters"]) == 1
        for n in d["parameters"]
        if n in found.parameters
    ]
    if free is None:
        which = f"all but {', '.join(alone)}" if alone else "fewer than the usual"
        return (
            f"say with --free NAME=LOW:HIGH what to estimate ({which}), or take a log that moves"
            f" {'it' if len(alone) == 1 else 'them'}"
        )
    return (
        f"leave {', '.join(alone)} out of --free"
        if alone
        else "free fewer, or take a log that moves them"
    )


def run_interruptibly(args):
    """`run`, with the handler of SIGINT put back afterwards."""
    with put_back():
        code = run(args)
        sys.stdout.flush()  # the answer is out before Ctrl-C ends the program at once again
        return code


def _samples(text):
    """A number of samples: a share below 1 has been taken already."""
    if not float(text).is_integer():
        raise InputError(
            f"--hold-back {text!r}: must be a share from 0 to below 1, or a whole number of samples"
        )
    return int(float(text))


def _column(text):
    header, semicolon, unit = text.rpartition(";")
    return (header.strip(), unit.strip()) if semicolon else text


def plan(args, case, free):
    """Compare experiments; returns the exit code."""
    if args.data:
        raise InputError(
            "--plan compares experiments before there is a log: leave it out to fit --data"
            f" {args.data[0]!r}"
        )
    if args.law:
        raise InputError(f"--plan identifies nothing: leave --law {args.law!r} out")
    if args.out:
        raise InputError(
            f"--plan writes no files: leave --out {args.out!r} out (--json prints what it found)"
        )
    import numpy as np

    from tuning.identification.design import compare_experiments, most_telling
    from tuning.report import tables

    duration = 300.0 if args.duration is None else values.number("--duration", args.duration)
    if not 0 < duration <= LONGEST:
        raise InputError(
            f"--duration {args.duration!r}: must be above 0 s and at most {LONGEST:g} s"
        )
    dt = duration / 300
    tanks = None
    if args.measure:
        names = [f"h{i + 1}" for i in range(case.loop.plant.tanks)]
        for word in args.measure.split(","):
            if word.strip() not in names:
                raise InputError(f"--measure {word!r}: must be among {', '.join(names)}")
        tanks = sorted({names.index(w.strip()) for w in args.measure.split(",")})
    voltage = None
    if args.voltage is not None:
        voltage = [values.number("--voltage", text) for text in args.voltage.split(",")]
        high = np.asarray(case.loop.actuator.high)
        if len(voltage) != high.size or not all(0 < v <= top for v, top in zip(voltage, high)):
            tops = ", ".join(f"{v:g}" for v in high)
            raise InputError(
                f"--voltage {args.voltage!r}: must be {high.size} numbers above 0 and at most"
                f" {tops} {case.loop.units[1]}"
            )
    length = case.loop.units[0]
    own = float(np.max(np.asarray(case.loop.sensor.noise)))
    noise = (
        values.number("--noise", args.noise)
        if args.noise
        else own or 0.005 * float(np.max(np.asarray(case.loop.plant.rim)))
    )
    if not noise > 0:
        raise InputError(f"--noise {args.noise!r}: must be above 0")
    found = compare_experiments(
        case,
        free,
        noise=noise,
        duration=duration,
        dt=dt,
        levels=tanks,
        start="known",
        voltage=voltage,
    )
    best = most_telling(found)
    if args.json:
        print(
            tables.dumps(
                tables.clean(
                    {
                        "case": case.name,
                        "noise": noise,
                        "duration": duration,
                        "dt": dt,
                        "experiments": found,
                        "most_telling": best,
                    }
                )
            )
        )
        return 0
    from jaxtank.core.tree import get_value

    letters, rows = dict(zip("ABCDEFGH", found)), []
    for name in next(iter(found.values()))["sd"]:
        value = float(np.asarray(get_value(case.loop, name)))
        sds = [found[words]["sd"][name] for words in letters.values()]
        shares = [
            "open" if sd is None else f"{100 * sd / abs(value):.2g} %" if value else f"{sd:.2g}"
            for sd in sds
        ]
        rows.append([name, f"{value:.5g}", *shares])
    conditions = [found[words]["condition"] for words in letters.values()]
    rows.append(
        [
            "condition of J'J",
            "",
            *("-" if c is None or c > 1e15 else f"{c:.3g}" for c in conditions),
        ]
    )
    measured = "every level" if tanks is None else ", ".join(f"h{i + 1}" for i in tanks)
    print(
        f"{case.name}: standard deviations that {duration:g} s, {measured} read every {dt:g} s with"
        f" noise of {noise:g} {length} would leave\n"
    )
    print(tables.table(rows, ["parameter", "value", *letters]) + "\n")
    print("\n".join(f"{letter}  {words}" for letter, words in letters.items()))
    print(f"\nIt tells most: {best}." if best else "\nNone of them tells all of these parameters.")
    return 0

"""`jaxtank identify`, `learn` and `predict`: experiment data in, a rig to tune out."""

import sys
from typing import Any

from jaxtank.core.errors import InputError
from jaxtank.core.labels import index_of, names_of, reading_label, units_of_inputs
from jaxtank.core.text import printable
from tuning.cli import values
from tuning.cli.interrupts import Interrupts
from tuning.cli.options import CASE, COMMON, RESUME, RUN, Command, Option, grouped
from tuning.cli.steps import (
    finish,
    note,
    open_case,
    picked,
    print_result,
    printed,
    report_unreachable,
    show_end,
)
from tuning.cli.terminal import Line

LONGEST = 1e7  # longest planned experiment [s]: four months
PLANNED = 300.0  # length of a planned experiment [s]

STATUS = {"converged": 0, "not_converged": 3, "not_identifiable": 5, "interrupted": 130}


def run(args):
    """Run the command; returns the exit code."""
    if args.case is None and not args.inspect:
        raise InputError("identify needs a case: PAPER/CASE (see jaxtank list) or a rig file .toml")
    _check_together(args)
    case = open_case(args) if args.case else None
    if args.inspect:
        from tuning.identification.inspection import inspect
        from tuning.report import inspection

        loop, columns = (None, {}) if case is None else (case.loop, dict(case.log))
        settings = (columns | args.column, args.decimal, args.hold, args.time)
        result = inspect(args.inspect, loop, *settings, gap=args.gap)
        written = inspection.save(result, args.out, args.line) if args.out else []
        text = lambda: printed(inspection.report(result))
        print_result(args, inspection.json_of(result), text, written=written)
        return 5 if result.problems else 0
    return _plan(args, case) if args.plan else _identify(args, case)


def _check_together(args):
    """Raise InputError if options of a planned experiment and of experiment data are both given."""
    if args.inspect:
        words = f"--inspect {args.inspect!r} reads one file and fits nothing"
        checks = [(args.data or args.plan, f"{words}: leave --data and --plan out")]
    elif args.plan:
        fit = "--plan compares experiments before there are data: leave it out to fit --data"
        files = f"--plan writes no files: leave --out {args.out!r} out (--json prints the result)"
        checks = [
            (args.data, f"{fit} {(args.data or [''])[0]!r}"),
            (args.law, f"--plan identifies nothing: leave --law {args.law!r} out"),
            (args.out, files),
        ]
    else:
        needs = "identify needs --data CSV, experiment data of the rig (or --plan, to compare"
        checks = [
            (getattr(args, n) is not None, f"--{n} belongs to a planned experiment, with --plan")
            for n in ("duration", "voltage", "measure")
        ]
        checks.append((not args.data, f"{needs} experiments before making one)"))
    if problems := [sentence for wrong, sentence in checks if wrong]:
        raise InputError("; ".join(problems))


def read_logs(args, case):
    """Return the experiment data of --data; their assumptions go to stderr."""
    from tuning.identification.csv_log import read_log

    settings = (dict(case.log) | args.column, args.decimal, args.hold, args.time)
    logs = [read_log(path, case.loop, *settings) for path in args.data]
    for log in logs:
        for sentence in log.notes:
            note(args, sentence)
    return logs


def _identify(args, case):
    """Identify, then write and print the result; returns the exit code."""
    from tuning.identification.fit import identify

    accept = tuple(_numbered(text, case.loop.plant) for text in args.accept or ())
    logs = read_logs(args, case)
    if args.posterior == "hmc":
        from tuning.identification import posterior

        posterior.blackjax()  # before the long search
        if args.likelihood != "output-error":
            raise InputError(
                f"--posterior hmc beside --likelihood {args.likelihood}: its draws are of the"
                " likelihood output-error: leave one of them out"
            )
    shortest = min(log.samples for log in logs)
    if args.hold_back >= shortest:
        raise InputError(
            f"--hold-back {args.hold_back}: must be fewer samples than the data have, {shortest}"
        )

    def ready():  # not before: data that are refused get one line
        if not args.quiet:
            names, samples = ", ".join(log.name for log in logs), sum(log.samples for log in logs)
            print(f"{names}: {samples} samples", file=sys.stderr, flush=True)
            line.compiling("the simulation and its derivatives", 10)

    line, interrupts = Line(args.quiet), Interrupts()
    result = identify(
        *(case, logs, args.free or None),
        **picked(args, "start starts seed hold_back noise loss profile iterations gap law"),
        **picked(args, "refine likelihood"),
        checkpoint=args.out,
        resume=args.resumed,
        progress=interrupts.check,
        ready=ready,
        prior=not args.no_prior,
        accept=accept,
    )
    if args.posterior == "hmc" and result.identifiable and not interrupts.stop:
        result = posterior.with_draws(result, args.seed)
    line.end()
    _report_next(args, result, finish(result, args))
    return interrupts.code if interrupts.stop else STATUS[result.status]


def predict(args):
    """Predict experiment data with an unchanged rig; returns the exit code."""
    if not args.data:
        raise InputError("predict needs --data CSV, experiment data that the rig was not fitted to")
    case = open_case(args)
    import tuning

    prediction, logs = tuning.predict, read_logs(args, case)
    finish(prediction(case, logs, start_samples=args.start_samples, gap=args.gap), args)
    return 0


def learn(args):
    """Update a rig by its last batches and tune it; returns the exit code of the tuning."""
    if not args.data:
        raise InputError("learn needs --data CSV, the log of a batch that ran with this rig")
    case = open_case(args)
    import tuning
    from tuning.cli.commands.tuning import EXIT, Progress
    from tuning.identification.prediction import achieved
    from tuning.report.document import Report, Text
    from tuning.report.identification import contradicted, marked
    from tuning.report.prediction import achieved_table, setpoints_used

    logs = read_logs(args, case)
    rows = [row | {"data": log.name} for log in logs for row in achieved(case, log)]
    line = Line(args.quiet).compiling("the simulation and its derivatives", 10)
    fit = tuning.identify(case, logs, gap=args.gap, seed=args.seed)
    if contradicted(fit):  # the rig has changed
        note(args, "these data contradict the earlier ones: identified from these alone")
        fit = tuning.identify(case, logs, gap=args.gap, seed=args.seed, prior=False)
    parts: dict[str, Any] = {"identification": fit}
    line.end()
    code = STATUS[fit.status]
    if fit.identifiable:
        progress, filtered = Progress("", args.quiet), args.safety_filter is not False
        answer = tuning.tune(marked(fit), safety_filter=filtered, seed=args.seed, progress=progress)
        progress.line.end()
        parts["tuning"] = answer
        code = progress.code if progress.stop else EXIT[answer.status]
    last, written = list(parts.values())[-1], []
    show_end(args)
    if args.out:
        written = fit.save(f"{args.out}/identified", args.line)
        written = last.save(args.out, args.line) if last is not fit else written
    payload = {"case": case.name, "achieved": rows}
    payload |= {name: part.to_json() for name, part in parts.items()}
    payload["verdict"] = last.to_json()["verdict"]
    table = Report("", "", None, [], [achieved_table(rows), Text([setpoints_used(rows)])])
    texts = [printed(table), *(printed(part.report()) for part in parts.values())]
    print_result(args, payload, lambda: "\n\n".join(texts), written=written)
    return code


def _report_next(args, result, written):
    """Print on stderr why no rig is written, or the next command for the written one."""
    from tuning.report.identification import not_identifiable

    if written:
        report_unreachable(result.identified, written, args)
    rig_written = any(path.name == "rig.toml" for path in written)
    if result.directions and not result.identifiable:
        names = "; ".join(not_identifiable(d) for d in result.directions)
        print(
            f"jaxtank: {printable(', '.join(args.data))}: not identifiable from these data:"
            f" {names}: no rig is written; {_advice(result, args.free)}",
            file=sys.stderr,
        )
    elif rig_written and result.status == "converged" and not args.quiet:
        print(_next_command(result, f"{printable(args.out.rstrip('/'))}/rig.toml"), file=sys.stderr)


def _next_command(result, file):
    """Return the next step for the rig that was written to `file`."""
    from jaxtank.bounds import is_tunable
    from tuning.report.identification import lacking

    case, why = result.proposed
    if lacks := lacking(result):
        options = " ".join(f"--accept {cause}" for cause in lacks)
        return f"{file} lacks what the data require: identify again with {options} before you tune"
    if why:
        return f"jaxtank: {file}: note: --law {result.law}: {why}"
    if is_tunable(case):
        return f"go on with: jaxtank tune {file}"
    return (
        f"{file} has no controller to tune: identify with --law pi for a PI controller with gains"
        " from this model, or give the file a [controller], a [reference] with changes, and [free]"
    )


def _advice(result, free):
    """Return remedies for parameters that are not identifiable from the data."""
    directions = [list(d["parameters"]) for d in result.directions]
    alone = [names[0] for names in directions if len(names) == 1 and names[0] in result.parameters]
    if not free:
        which = f"all but {', '.join(alone)}" if alone else "fewer than by default"
        return (
            f"choose with --free NAME=LOW:HIGH what to estimate ({which}), or use data that excite"
            f" {'it' if len(alone) == 1 else 'them'}"
        )
    if alone:
        return f"leave {', '.join(alone)} out of --free"
    return "free fewer, or use data that excite them"


def _plan(args, case):
    """Compare experiments and print the result; returns the exit code."""
    levels, voltage, noise = _measured(args, case), _voltage(args, case), args.noise
    from tuning.identification.design import compare_experiments, most_informative
    from tuning.report import tables
    from tuning.report.identification import plan_report, plan_verdict

    if isinstance(noise, list):
        raise InputError(f"--noise {noise}: must be one number with --plan")
    if noise is None:  # the case's, or 0.5 % of the rim
        largest = max(map(float, case.loop.sensor.noise))
        noise = largest or 0.005 * max(map(float, case.loop.plant.rim))
    duration = args.duration or PLANNED
    plan = {"noise": float(noise), "duration": duration, "dt": duration / 300}
    settings = plan | {"levels": levels, "voltage": voltage}
    experiments = compare_experiments(case, args.free or None, start="known", **settings)
    best = most_informative(experiments)
    payload = {"case": case.name, **plan, "inputs": experiments.inputs}
    payload |= {"experiments": experiments, "most_informative": best}
    payload["verdict"] = plan_verdict(best).to_json()
    text = lambda: printed(plan_report(case, experiments, best, settings))
    print_result(args, tables.clean(payload), text)
    return 0


def _measured(args, case):
    """Return the tanks of --measure, counted from 0, or None for all."""
    if not args.measure:
        return None
    plant = case.loop.plant
    labels = [reading_label(plant, i) for i in range(plant.tanks)]
    numbers = {f"h{i + 1}": i for i in range(plant.tanks)}
    tanks = {name: i for i, name in enumerate(names_of(plant, "tank"))}
    places = numbers | tanks | {label: i for i, label in enumerate(labels)}
    for name in args.measure:
        if name not in places:
            raise InputError(f"--measure {name!r}: must be among {', '.join(labels)}")
    return sorted({places[name] for name in args.measure})


def _numbered(text, plant):
    """Return KIND:PLACE of --accept with the number, from 1, of each tank or pump of PLACE."""
    from tuning.identification.fit import CAUSE_KINDS, SWAPS
    from tuning.report.identification import PUMPS

    kind, _, place = text.partition(":")
    if kind not in CAUSE_KINDS or not place:
        return text
    part, names = ("pump" if kind in PUMPS else "tank"), place.split(",")
    if kind not in SWAPS or place in names_of(plant, part):
        names = [place]  # a name may hold a comma
    numbers = [index_of(f"--accept {kind}", plant, part, name.strip()) + 1 for name in names]
    return f"{kind}:{','.join(map(str, numbers))}"


def _voltage(args, case):
    """Return the inputs of --voltage, or None."""
    if args.voltage is None:
        return None
    high = [float(v) for v in case.loop.actuator.high]
    inside = [0 < v <= top for v, top in zip(args.voltage, high)]
    if len(args.voltage) != len(high) or not all(inside):
        raise InputError(
            f"--voltage {args.voltage}: must be {len(high)} numbers above 0 and at most"
            f" {', '.join(f'{v:g}' for v in high)} {units_of_inputs(case.loop.plant)}"
        )
    return args.voltage


# fmt: off
CASE_OR_NONE = (*CASE[:-1], CASE[-1]._replace(nargs="?"))
INSPECT = Option("--inspect", "CSV", "print what a file holds: columns, units, ranges, oddities and"
                 " a [log] table to paste; fits nothing, needs no case")
DATA = grouped(
    "data",
    Option("--data", "CSV", "experiment data; several experiments have first levels each",
           kind="list"),
    Option("--column", "SLOT=HEADER[;UNIT]", "which column is t, pump1, .., h1, .., where its"
           " header is in other words; h3=none: leave that level out", values.pair(values.column),
           kind="pairs"),
    Option("--decimal", "SIGN", "decimal sign of the data: . or , (default: from the numbers)",
           default="", choices=".,"),
    Option("--time", "HOW", "how times that can be read twice are meant: day-first, month-first,"
           " h:m, m:s", default=""),
    Option("--gap", "X", "longest step between samples, in usual steps; where an input"
           " has changed in a longer one than 1.5, the log is cut",
           values.above(1, including=True), 1.5),
    Option("--hold", "HOW", "inputs between samples: zero-order (each until the next row) or"
           " first-order (a line)", default=""),
)
HELD_BACK = grouped(
    "data",
    Option("--hold-back", "SHARE", "end of the data that validates a first fit: share, or samples",
           values.held_back, 0.25),
    Option("--noise", "SD", "standard deviation of the readings, one or one per channel (default:"
           " from the data)", values.deviations),
)
FIT = grouped(
    "fit",
    Option("--free", "NAME=LOW:HIGH", "what to estimate, of plant, sensor, actuator, disturbance"
           " (default: pump gains, splits, orifices, pipes)", values.free_range,
           kind="pairs"),
    Option("--start", "HOW", "first levels: free, measured, or case", default="free",
           choices=("free", "measured", "case")),
    Option("--starts", "N", "searches", values.whole(1, 1000), 8),
    Option("--iterations", "N", "evaluations of each search", values.whole(1, 100000), 100),
    Option("--loss", "NAME", "linear, soft_l1 or huber", default="linear",
           choices=("linear", "soft_l1", "huber")),
    Option("--law", "KIND", "write the rig under a controller to tune: pi, with gains from the"
           " identified model", choices=("pi",)),
    Option("--accept", "KIND[:PLACE]", "add a cause to the rig and identify again; PLACE:"
           " name or number of the input or tank (default: the best). KIND: pump-delay, pump-lag,"
           " dead-zone,"
           " pump-curve, sensor-offset, sensor-scale, leak, outlet-exponent, inflow, area,"
           " rangeability (of a valve),"
           " swapped:1,2 (tanks), swapped-inputs:1,2 (pumps)", kind="list"),
    Option("--no-prior", help="these data alone: without the [covariance] of an earlier"
           " identification", kind="flag"),
    Option("--likelihood", "KIND", "output-error (noise of the readings alone), innovations"
           " (also process noise, by an extended Kalman filter), or auto", default="output-error",
           choices=("output-error", "innovations", "auto")),
    Option("--refine", help="add parts that predict left-out blocks of the data better: curves of"
           " sensors, exponents or linear terms of outlets, areas of tanks without a reading",
           kind="flag"),
    Option("--posterior", "KIND", "laplace (normal approximation), or hmc (No-U-Turn sampler;"
           " pip install \".[posterior]\"): intervals and covariance of draws, also in draws.csv",
           default="laplace", choices=("laplace", "hmc")),
    Option("--profile", help="also: profile likelihood of the least certain parameter",
           kind="flag"),
    RESUME,
)
PLAN = grouped(
    "planned experiment (--plan)",
    Option("--plan", help="no data: compare experiments by the standard deviations they would"
           " leave", kind="flag"),
    Option("--duration", "S", f"of a planned experiment [s] (default {PLANNED:g})",
           values.above(0, LONGEST, read=values.seconds("--duration"))),
    Option("--voltage", "V1,V2", "inputs about which a planned experiment works (default:"
           " actuator.initial; where one is about 0, inputs of the first setpoint, or half of the"
           " range; less where a level would settle above 80 % of its rim)",
           values.entries(values.number)),
    Option("--measure", "H1,H2", "tanks measured in a planned experiment, h1 or by name (default"
           " all)",
           values.entries()),
)
START_SAMPLES = Option("--start-samples", "N", "samples at the beginning that the first levels"
                       " follow from (default: all)", values.whole(1, 10**8))
# fmt: on
COMMANDS = {
    "identify": Command(
        run,
        "plant parameters from experiment data, with intervals; --out DIR writes a rig to tune",
        (*COMMON, *CASE_OR_NONE, *RUN, INSPECT, *DATA, *HELD_BACK, *FIT, *PLAN),
    ),
    "learn": Command(
        learn,
        "the next rig after a batch: update by its log, tune through the safety filter, predicted"
        " beside achieved",
        (*COMMON, *CASE, *RUN, *DATA),
    ),
    "predict": Command(
        predict,
        "a rig as it is on experiment data that it was not fitted to: residuals and their tests",
        (*COMMON, *CASE, *RUN, *DATA, START_SAMPLES),
    ),
}

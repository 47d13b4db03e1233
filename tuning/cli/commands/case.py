"""`jaxtank list`, `show`, `simulate`, `init` and `export`: the cases, and one case as it is."""

import argparse
import dataclasses
import sys
from pathlib import Path

from jaxtank.core.errors import InputError
from jaxtank.core.files import write_folder
from tuning.cli.arguments import option
from tuning.cli.options import report_written
from tuning.cli.values import open_case


def add(commands, parents):
    """Add the commands of this module to the parser's `commands`."""
    common, case, run = parents
    one = commands.add_parser("list", parents=[common], help="print every case")
    one.set_defaults(run=list_cases)
    one = commands.add_parser(
        "show",
        parents=[common, case],
        help="one case: rig, controller, every parameter, published numbers, departures",
    )
    one.set_defaults(run=show)
    option(one, "--out", "DIR", "folder for rig.png and rig.svg, the rig drawn from its topology")
    one = commands.add_parser(
        "simulate",
        parents=[common, case, run],
        help="one run: measures; with --out its trajectory, pictures and report.html",
    )
    one.set_defaults(run=simulate)
    one.add_argument(
        "others",
        nargs="*",
        metavar="CASE",
        help="further cases, on one page and in one table with the first: under its disturbances,"
        " faults and noise",
    )
    one.add_argument(
        "--gif",
        action="store_true",
        help="with --out also run.gif, the tanks of the rig filling and emptying, and film.png with"
        " four of its pictures",
    )
    option(
        one,
        "--against",
        "CASE",
        "with --gif: a second case or rig file, as it is, beside the first in the film",
    )
    text = "with --out also print.svg and print.png (300 dpi): the run in the width of one or two"
    option(one, "--columns", "N", f"{text} columns of a journal: 1 or 2")
    one.add_argument(
        "--margins",
        action="store_true",
        help="also print the stability margins of the linearised loop at each plateau of the"
        " reference",
    )
    _add_init(commands, [common, case])
    _add_export(commands, [common, case])


def _add_init(commands, parents):
    one = commands.add_parser(
        "init",
        parents=parents,
        help="print a complete rig file to edit: every key, its unit and range",
    )
    one.set_defaults(run=init)
    one.add_argument(
        "--short", action="store_true", help="only what differs from the preset, and what is tuned"
    )
    one.add_argument(
        "--tanks", action="store_true", help="described tank by tank, without its preset"
    )


def _add_export(commands, parents):
    one = commands.add_parser(
        "export",
        parents=parents,
        help="the controller and its observer as one C99 or JavaScript file or MATLAB function",
    )
    one.set_defaults(run=export)
    option(one, "--lang", "LANG", "c (default), m or js", "c")
    option(one, "--precision", "TYPE", "double (default) or float, of C", "double")
    option(one, "--name", "NAME", "of the functions (default: the case's)")
    option(one, "--out", "DIR", "folder for the file (default: print it)")


def list_cases(args):
    """Print every case with its title."""
    from jaxtank import presets
    from tuning.report import tables

    cases = {f"{p}/{n}": c.title for p in presets.PAPERS for n, c in presets.load(p).cases.items()}
    rows = [[name, title] for name, title in cases.items()]
    print(tables.dumps(cases) if args.json else tables.table(rows, ["case", ""]))
    return 0


def show(args):
    """Print the manual of one case; with --out draw its rig."""
    case = open_case(args)
    from tuning.report import case as manual
    from tuning.report.document import terminal
    from tuning.report.tables import dumps

    written = _draw_rig(case, Path(args.out)) if args.out else []
    print(dumps(manual.json_of(case)) if args.json else terminal(manual.report(case)))
    report_written(written, args)
    return 0


def _draw_rig(case, folder):
    """Write rig.svg and rig.png; where the rig cannot be drawn, remove those of another one."""
    from jaxtank.plots.run import rig
    from tuning.report import html
    from tuning.report.document import failed
    from tuning.report.folder import pngs

    try:
        drawn = rig(case.loop.plant, None, case.name)
        alone = {f"{name}.svg": html.alone(figure, name) for name, figure in drawn.items()}
    except Exception as error:
        failed("rig", error)
        for name in ("rig.svg", "rig.png"):
            (folder / name).unlink(missing_ok=True)
        return []
    return write_folder(folder, alone | pngs(drawn))


def simulate(args):
    """Run a case once and print its measures; with --out write the run."""
    if args.others:
        return _together(args)
    columns = _checked_columns(args)
    seed, case = args.seed, open_case(args)
    other = None if args.against is None else _other(args.against)
    import jax

    from jaxtank.loop import run
    from jaxtank.loop.halving import halving_warnings
    from jaxtank.loop.margins import stability_margins
    from tuning.problem import provenance, reported
    from tuning.problem.scenarios import noisy
    from tuning.report import simulated, tables
    from tuning.report.document import terminal

    key = jax.random.key(seed) if noisy(case) else None
    of_run = halving_warnings(case.loop, case.clock, key)
    values = dict(reported.run_measures(case.loop, case.clock, key))
    of_run += _of_run(case, values, key)
    for sentence in [] if args.quiet else of_run:
        print(f"jaxtank: note: {sentence}", file=sys.stderr)
    plateaus = stability_margins(case.loop, case.clock) if args.margins else None
    values |= reported.margin_measures(case.loop, case.clock) if args.margins else {}
    payload = {
        "case": case.name,
        "measures": tables.measures_json(values),
        "units": tables.units(case.loop.units),
        "reasons": tables.reasons(values),
        "clock": dataclasses.asdict(case.clock),
        "parameters": tables.clean(run.parameters(case.loop)),
        "provenance": provenance.provenance(case, seed),
    }
    if plateaus is not None:
        payload["margins"] = simulated.margins_json(plateaus)
    written = []
    if args.out:
        trajectory = simulated.run_for_people(case, key)
        page = lambda drawn: simulated.report(case, values, plateaus, drawn)
        beside = None
        if other is not None:
            noise = jax.random.key(seed) if noisy(other) else None
            beside = (other, simulated.run_for_people(other, noise))
        written = simulated.save(
            case, trajectory, payload, args.out, page, args.line, args.gif, beside, columns
        )
    if args.json:
        print(tables.dumps(payload))
    else:
        print(terminal(simulated.report(case, values, plateaus)))
    report_written(written, args)
    return 0


def _of_run(case, values, key):
    """Sentences on levels that fell below 0 in the run of these measures, and on its estimates."""
    import numpy as np

    from jaxtank.loop import estimate_notes, tank_bottom
    from jaxtank.loop.saved_rows import simulate_compiled

    below = np.any(np.asarray(values["min_level"]) < tank_bottom.lower_bounds(case.loop.plant))
    if not below and not estimate_notes.needs_run(case.loop):
        return []
    run, _ = simulate_compiled(case.loop, case.clock, key, 1)
    below = tank_bottom.tank_bottom_warnings(case.loop, run)
    return below + estimate_notes.estimate_notes(case.loop, run)


def _checked_columns(args):
    """The number of --columns, None without; InputError for options that do not fit together."""
    if args.gif and not args.out:
        raise InputError("--gif needs --out DIR, where run.gif is written")
    if args.columns not in (None, "1", "2"):
        raise InputError(f"--columns {args.columns}: must be 1 or 2")
    if args.columns is not None and not args.out:
        raise InputError("--columns needs --out DIR, where print.svg and print.png are written")
    if args.against is not None and not args.gif:
        raise InputError("--against needs --gif, the film in which the second case stands")
    return None if args.columns is None else int(args.columns)


def _together(args):
    """Run several cases under the same conditions; one table, and with --out one page."""
    alone = {"--gif": args.gif, "--margins": args.margins, "--columns": args.columns}
    alone["--against"] = args.against
    for flag, given in alone.items():
        if given:
            raise InputError(f"{flag}: of one case alone, and {1 + len(args.others)} are given")
    seed, names = args.seed, [args.case, *args.others]
    cases = [open_case(argparse.Namespace(**{**vars(args), "case": name})) for name in names]
    from tuning.report import tables, together
    from tuning.report.document import terminal

    runs = together.run_together(cases, seed)
    written = together.save(runs, args.out, seed, args.line) if args.out else []
    if args.json:
        print(tables.dumps(together.json_of(runs, seed)))
    else:
        print(terminal(together.report(runs)))
    report_written(written, args)
    return 0


def _other(name):
    """The second case of a film; InputError where it is none, or cannot be drawn."""
    from jaxtank import rig

    try:
        return rig.check(rig.open_case(name))
    except InputError as error:
        raise InputError(f"--against: {error}") from None


def init(args):
    """Print a rig file of the case."""
    if args.short and args.tanks:
        raise InputError(
            "--short and --tanks: the short file names its preset; give one of the two"
        )
    case = open_case(args)
    from jaxtank import rig
    from tuning.report import tables

    text = rig.short(case) if args.short else rig.complete(case, tankwise=args.tanks)
    if args.json:
        print(tables.dumps({"case": case.name, "rig": text}))
    else:
        sys.stdout.write(text)
    return 0


def export(args):
    """Print the controller and its observer as source text, or write it to --out."""
    case = open_case(args)
    from jaxtank.export import source
    from jaxtank.export.printer import function_name
    from tuning.report import tables

    text = source.export(case, args.lang, args.precision, args.name)
    name = args.name or function_name(case)
    if args.json:
        print(tables.dumps({"case": case.name, "lang": args.lang, "name": name, "source": text}))
    if args.out:
        written = write_folder(Path(args.out), {f"{name}.{args.lang}": text})
        report_written(written, args)
    elif not args.json:
        sys.stdout.write(text)
    return 0

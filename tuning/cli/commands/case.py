"""`jaxtank list`, `show`, `simulate`, `init` and `export`: the cases, and one unchanged case."""

import argparse
import shlex
import shutil
import sys
import textwrap
from pathlib import Path

from jaxtank.core.errors import InputError
from jaxtank.core.files import write_folder
from tuning.cli import values
from tuning.cli.commands.identification import DATA, read_logs
from tuning.cli.completion import titles
from tuning.cli.options import CASE, COMMON, RUN, Command, Option
from tuning.cli.steps import note, open_case, print_result, printed, report_written
from tuning.cli.terminal import Line, end_lines, phase


def list_cases(args):
    """Print every case with its title; without --all those of one controller as one line."""
    cases = titles()  # neither jax nor numpy is imported
    groups = {}  # {part of a name before the first "-": names}
    for name in cases:
        groups.setdefault(name if args.all else name.partition("-")[0], []).append(name)
    wide = max(len(first) for first, *_ in groups.values())
    counts = ["" if args.all else str(len(names) - 1 or "") for names in groups.values()]
    room = max(shutil.get_terminal_size().columns, 60) - wide - 7
    lines = [
        f"{first:{wide}}  {count:>2}  {textwrap.shorten(cases[first], room, placeholder=' ...')}"
        for (first, *_), count in zip(groups.values(), counts)
    ]
    more = "" if args.all else "; numbers count variants (--all)"
    lines.append(f"{len(cases)} cases{more}; jaxtank show CASE describes one")
    print_result(args, cases, lambda: "\n".join(lines), f"{len(cases)} cases")
    return 0


def show(args):
    """Print the manual of one case; with --out draw its rig."""
    case = open_case(args)
    from tuning.report import case as manual

    written = _draw_rig(case, Path(args.out)) if args.out else []
    payload = manual.json_of(case) if args.json else None
    text = lambda: printed(manual.report(case, shlex.quote(args.case)))
    print_result(args, payload, text, written=written)
    return 0


def _draw_rig(case, folder):
    """Write rig.svg and rig.png; if the rig cannot be drawn, remove the pictures of another one."""
    from jaxtank.plots.run import rig
    from tuning.report import html
    from tuning.report.document import failed
    from tuning.report.folder import pngs

    try:
        figures = rig(case.loop.plant, None, case.name)
        pages = {f"{name}.svg": html.alone(figure, name) for name, figure in figures.items()}
    except Exception as error:
        failed("rig", error)
        for name in ("rig.svg", "rig.png"):
            (folder / name).unlink(missing_ok=True)
        return []
    return write_folder(folder, pages | pngs(figures))


def simulate(args):
    """Run a case once and print its measures; with --out write the run."""
    needs = {"--gif": (args.gif, args.out, "--out DIR, where run.gif is written")}
    needs["--columns"] = (args.columns, args.out, "--out DIR, where print.svg and .png are written")
    needs["--against"] = (args.against, args.gif, "--gif, the film of both cases")
    for name in ("time", "decimal", "hold", "column"):
        needs[f"--{name}"] = (getattr(args, name), args.data, "--data, the log that it is about")
    for flag, (value, other, what) in needs.items():
        if value and not other:
            raise InputError(f"{flag} needs {what}")
    if args.others:
        return _simulate_together(args)
    case, second = open_case(args), None if args.against is None else _second_case(args.against)
    case, log = _experiment(args, case)
    import jax

    from jaxtank.loop.halving import halving_warnings
    from jaxtank.loop.margins import stability_margins
    from tuning.problem import reported
    from tuning.problem.scenarios import noisy
    from tuning.report import simulated
    from tuning.report.verdict import about_controller_limits

    key_of = lambda case: jax.random.key(args.seed) if noisy(case) else None
    key, line = key_of(case), Line(args.quiet).compiling("the simulation", 5)
    sentences = halving_warnings(case.loop, case.clock, key)
    measures = dict(reported.run_measures(case.loop, case.clock, key, case.limits))
    line.end()
    phase.show("checking the run")
    sentences += reported.chatter(case.loop, case.clock, measures)
    sentences += about_controller_limits(case.loop, measures)
    for sentence in [*sentences, *_notes_on_run(case, measures, key)]:
        note(args, sentence)
    plateaus = stability_margins(case.loop, case.clock) if args.margins else None
    measures |= reported.margin_measures(case.loop, case.clock) if args.margins else {}
    payload = simulated.json_of_run(case, measures, args.seed, plateaus)
    payload |= (estimated := simulated.estimates_of_run(case, key))
    page = lambda: simulated.report(case, measures, plateaus, args.all, estimated)
    if log is not None:
        page = _with_data(case, log, key, payload, page)
    written = []
    if args.out:
        phase.show("writing results and pictures")
        trajectory = simulated.run_for_people(case, key)
        beside = second and (second, simulated.run_for_people(second, key_of(second)))
        columns = args.columns and int(args.columns)
        written = simulated.save(
            case, trajectory, payload, args.out, page, args.line, args.gif, beside, columns
        )
    print_result(args, payload, lambda: printed(page()), written=written)
    return _checked(args, payload)


def _checked(args, payload):
    """Return the exit code: 4 with --check where the verdict is not good."""
    return 4 if args.check and not payload["verdict"]["good"] else 0


def _experiment(args, case):
    """Return (case under the inputs of --data, its Log); (case, None) without."""
    if not args.data:
        return case, None
    if len(args.data) > 1 or args.against:
        raise InputError("--data: of one log and one case: leave the others, and --against, out")
    from tuning.identification.prediction import as_played, played

    read = read_logs(args, case)[0]
    log = as_played(case, read)
    for sentence in log.remarks[len(read.notes) :]:
        note(args, sentence)
    return played(case, log), log


def _with_data(case, log, key, payload, page):
    """Add measured beside simulated readings to the JSON object; return the page with them."""
    import jaxtank
    from jaxtank.core.jsonable import clean
    from tuning.identification.prediction import beside
    from tuning.report.prediction import with_data

    compared = beside(case, log, jaxtank.simulate(case.loop, case.clock, key))
    payload["data"] = clean(compared)
    return lambda: with_data(page(), compared)


def _notes_on_run(case, measures, key):
    """Sentences on levels that fell below 0 in the run of these measures, and on its estimates."""
    import numpy as np

    from jaxtank.loop import estimate_notes, tank_bottom
    from jaxtank.loop.saved_rows import simulate_compiled

    below = np.any(np.asarray(measures["min_level"]) < tank_bottom.lower_bounds(case.loop.plant))
    if not below and not estimate_notes.needs_run(case.loop):
        return []
    run, _ = simulate_compiled(case.loop, case.clock, key, 1)
    below = tank_bottom.tank_bottom_warnings(case.loop, run)
    return below + estimate_notes.estimate_notes(case.loop, run)


def _simulate_together(args):
    """Run several cases under the same conditions; one table, and with --out one page."""
    names = [args.case, *args.others]
    for flag in ("gif", "margins", "columns", "against", "data"):
        if getattr(args, flag):
            raise InputError(f"--{flag}: of one case alone, and {len(names)} are given")
    cases = [open_case(argparse.Namespace(**{**vars(args), "case": name})) for name in names]
    from tuning.report import together

    line = Line(args.quiet).compiling("the simulations", 5 * len(cases))
    runs = together.run_together(cases, args.seed)
    line.end()
    phase.show("writing results and pictures")
    written = together.save(runs, args.out, args.seed, args.line) if args.out else []
    payload = together.json_of(runs, args.seed)
    print_result(args, payload, lambda: printed(together.report(runs)), written=written)
    return _checked(args, payload)


def _second_case(name):
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

    text = rig.short(case) if args.short else rig.complete(case, tankwise=args.tanks)
    _print_source(args, {"case": case.name, "rig": text}, text, f"the rig file of {case.name}")
    return 0


def export(args):
    """Print the controller and its observer, or the plant, as source text, or write it to --out."""
    case = open_case(args)
    from jaxtank.export import source

    files = source.files(case, args.lang, args.precision, args.name, args.plant, args.fmi)
    if any(isinstance(content, bytes) for content in files.values()) and not args.out:
        raise InputError(f"--lang {args.lang} is no text: give --out DIR, where it is written")
    if args.json or not args.out:
        texts = {file: text for file, text in files.items() if isinstance(text, str)}
        payload = {"case": case.name, "lang": args.lang, "name": Path(next(iter(files))).stem}
        payload |= {"source": "\n".join(texts.values()), "files": list(files)}
        outcome = f"the controller of {case.name} in the language {args.lang}"
        outcome = outcome.replace("controller", "plant") if args.plant else outcome
        _print_source(args, payload, payload["source"], outcome)
    if args.out:
        report_written(write_folder(Path(args.out), files), args)
    return 0


def replay(args):
    """Run an export against a log and print the largest difference of each input."""
    if not args.data:
        raise InputError("replay needs --data CSV, a log of readings, setpoints and inputs")
    from jaxtank.export.replay import replay as run
    from tuning.report import tables

    result = run(args.export, args.data)
    worst = max(result["inputs"], key=lambda row: row["largest_difference"])
    outcome = f"largest difference {worst['largest_difference']:.6g} of {worst['name']}"
    outcome += f" at {worst['time_s']:g} s, in {result['samples']} samples"
    rows = [
        (row["name"], f"{row['largest_difference']:.6g}", f"{row['time_s']:g}")
        for row in result["inputs"]
    ]
    head = ["input", "largest difference", "at time [s]"]
    print_result(args, result, lambda: f"{tables.table(rows, head)}\n{outcome}", outcome)
    return 0


def _print_source(args, payload, text, outcome):
    """Print a JSON object with --json, else the text unchanged."""
    if args.json:
        print_result(args, payload, str, outcome)
    else:
        end_lines()
        sys.stdout.write(text)


# fmt: off
COMMANDS = {
    "list": Command(
        list_cases,
        "the cases, one line for each controller of a paper; --all: every variant",
        (*COMMON, Option("--all", help="every variant in a line of its own", kind="flag")),
        compiles=False,
    ),
    "show": Command(
        show,
        "one case: rig, controller, every parameter, published numbers, departures",
        (
            *COMMON, *CASE,
            Option("--out", "DIR", "folder for rig.png and rig.svg, the rig drawn from its"
                   " topology", values.folder),
        ),
    ),
    "simulate": Command(
        simulate,
        "one run: measures; with --out its trajectory, pictures and report.html",
        (
            *COMMON, *CASE, *RUN,
            Option("others", "CASE", "further cases, on one page and in one table with the first:"
                   " under its disturbances, faults and noise", nargs="*"),
            Option("--gif", help="with --out also run.gif, the tanks of the rig filling and"
                   " emptying, and film.png with four of its pictures", kind="flag"),
            Option("--against", "CASE", "with --gif: a second case or rig file, unchanged, next to"
                   " the first in the film"),
            Option("--columns", "N", "with --out also print.svg and print.png (300 dpi): the run in"
                   " the width of one or two columns of a journal: 1 or 2", choices=("1", "2")),
            *DATA[:-2],
            Option("--hold", "HOW", "inputs of --data between samples: zero-order or first-order",
                   default=""),
            Option("--all", help="print every measure, not the most important five", kind="flag"),
            Option("--check", help="exit code 4 where the verdict is not good", kind="flag"),
            Option("--margins", help="also print the stability margins of the linearised loop at"
                   " each plateau of the reference", kind="flag"),
        ),
    ),
    "init": Command(
        init,
        "print a complete rig file to edit: every key, its unit and range",
        (
            *COMMON, *CASE,
            Option("--short", help="only what differs from the preset, and what is tuned",
                   kind="flag"),
            Option("--tanks", help="described tank by tank, without its preset", kind="flag"),
        ),
    ),
    "export": Command(
        export,
        "the controller and its observer, or the plant, as C99, Structured Text, JavaScript, MATLAB"
        " or FMU",
        (
            *COMMON, *CASE,
            Option("--lang", "LANG", "c, st, m, js or fmu", default="c"),
            Option("--fmi", "VERSION", "of an FMU: 3 (if left out) or 2", choices=("3", "2")),
            Option("--precision", "TYPE", "double or float, of c and st", default="double"),
            Option("--name", "NAME", "of the functions (default: the case's)"),
            Option("--plant", help="the plant with its pumps and gauges instead of the controller",
                   kind="flag"),
            Option("--out", "DIR", "folder for the files (default: print them)", values.folder),
        ),
    ),
    "replay": Command(
        replay,
        "run an export (C, JavaScript, FMU) that you trust against a log: differences of inputs",
        (
            *COMMON,
            Option("export", "EXPORT", "NAME.c, NAME.js or NAME.fmu of `jaxtank export`"),
            Option("--data", "CSV", "log with one row a period: t [s], y1, .., r1, .., u1, .."),
        ),
        compiles=False,
    ),
}
# fmt: on

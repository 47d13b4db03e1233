"""`jaxtank compare`, `figure`, `completion`, `bench` and `cache`: the papers and their figures, the
shell, the speed of this machine, the programs that are kept."""

import os
import sys
import textwrap
from pathlib import Path

from jaxtank.core.errors import InputError, nearest
from jaxtank.core.files import check_folder, write_folder
from jaxtank.core.text import printable
from tuning.cli.options import COMMON, Command, Option
from tuning.cli.steps import print_result, report_written, use_float64
from tuning.cli.values import folder, whole


def figure(args):
    """List the figures of the papers, print the caption of one, or draw it to --out."""
    use_float64()
    from tuning.figures.figure import FIGURES, find
    from tuning.report import tables

    if args.figure is None:
        if args.picture:
            raise InputError("--out needs a figure, as gouta2015/6: jaxtank figure lists them")
        rows = [[f.name, "" if f.runs else "no result", f.shows] for f in FIGURES.values()]
        payload = {f.name: {"shows": f.shows, "result": bool(f.runs)} for f in FIGURES.values()}
        print_result(args, payload, lambda: tables.table(rows, ["figure", "", "it shows"]))
        return 0
    printed = find(args.figure)
    from tuning.figures import drawing

    if args.picture:
        drawing.check_name(args.picture)
        check_folder(Path(args.picture).parent)
    result = drawing.run(printed)
    if args.picture:
        picture = Path(args.picture)
        data = drawing.rendered(drawing.draw(printed, result), args.picture)
        write_folder(picture.parent, {picture.name: data})
    if args.json:
        cases = [{"label": r.label, "case": r.case, "values": dict(r.values)} for r in printed.runs]
        texts = {"shows": printed.shows, "states": printed.states, "here": list(result.ours)}
        payload = {"figure": printed.name, **texts, "remark": printed.remark, "cases": cases}
        print_result(args, tables.clean(payload), str)
    elif not args.quiet or not args.picture:
        print("\n".join(textwrap.fill(p, 80) for p in drawing.caption(printed, result.ours)))
    if args.picture and not args.quiet:
        print(f"written to {printable(args.picture)}", file=sys.stderr)
    return 0


def compare(args):
    """Print what a paper publishes beside what is measured here."""
    use_float64()
    from jaxtank import presets
    from tuning.report import papers as report
    from tuning.report.document import terminal

    papers = presets.PAPERS if args.paper == "all" else (args.paper,)
    for paper in papers:
        presets.load(paper)  # an unknown one is refused before anything runs
    rows = {}
    for paper in papers:
        if not args.quiet:
            print(f"running {paper}", file=sys.stderr, flush=True)
        rows[paper] = report.measure(paper)
    written = report.save(rows, args.out, args.line) if args.out else []
    text = report.markdown if args.markdown else lambda rows: terminal(report.report(rows))
    print_result(args, rows if args.paper == "all" else rows[args.paper], lambda: text(rows))
    report_written(written, args)
    return 0


def bench(args):
    """Time the closed loop on this machine."""
    use_float64()
    from jaxtank import presets, rig
    from tuning.bench import bench as timing

    if args.cases:
        names = presets.names() if args.cases == ["all"] else args.cases
        rows = timing.measure_cases({name: rig.open_case(name) for name in names}, args.rounds)
        print_result(args, rows, lambda: timing.text_of_cases(rows))
    else:
        rows = timing.measure(args.rounds)
        print_result(args, rows, lambda: timing.text(rows))
    return 0


def cache(args):
    """Print where compiled programs are kept, or remove them."""
    from jaxtank.xla import program_cache as programs

    if args.what not in (None, "clear"):
        close = nearest(args.what, ["clear"])
        raise InputError(f"cache: unknown action {args.what!r}{close}: must be clear, or left out")
    base = programs.base_folder()
    if base is None:
        why = "JAXTANK_CACHE=0" if os.environ.get(programs.SWITCH) else "there is no home folder"
        print_result(args, {"folder": None, "why": why}, lambda: f"off: {why}")
        return 0
    if base.exists() and (why := programs.refused(base)):
        raise InputError(f"cache: {why}")
    removed = {"removed": programs.clear(base)} if args.what else {}
    count, size = (sum(column) for column in zip((0, 0), *programs.contents(base).values()))
    payload = {"folder": str(base), "programs": count, "bytes": size, "largest": programs.LARGEST}
    limit = f"at most {programs.LARGEST / 2**20:.0f} MiB for each version"
    lines = [f"{number} programs removed" for number in removed.values()]
    lines.append(f"{base}: {count} programs, {size / 2**20:.2g} MiB ({limit})")
    print_result(args, payload | removed, lambda: "\n".join(lines))
    return 0


def completion(args):
    """Print the completion script of a shell, or the words that complete a line for it."""
    from tuning.cli import completion as shells

    if args.shell == "words":
        print("\n".join(shells.candidates(args.parser, args.words)))
    else:
        sys.stdout.write(shells.script(args.shell))
    return 0


# fmt: off
COMMANDS = {
    "compare": Command(
        compare,
        "published numbers beside measured ones, and why they differ; PAPER or all",
        (
            *COMMON,
            Option("paper", "PAPER", 'a paper (see jaxtank list), or "all"'),
            Option("--out", "DIR", "folder for report.html, result.json and pictures", folder),
            Option("--markdown", help="as a Markdown table", kind="flag"),
        ),
    ),
    "figure": Command(
        figure,
        "a figure of a paper redrawn by our runs, as gouta2015/6; without one the list of all",
        (
            *COMMON,
            Option("figure", "PAPER/N", "the figure (default: list all)", nargs="?"),
            Option("--out", "FILE", "the picture: .svg, .png or .pdf (default: print its caption)",
                   dest="picture"),
        ),
    ),
    "completion": Command(
        completion,
        "a script that completes commands, options, cases and parameters: bash, zsh or fish",
        (
            Option("shell", "SHELL", 'as in: eval "$(jaxtank completion bash)"'),
            Option("words", "...", "of a line to complete, for these scripts", nargs="..."),
        ),
        compiles=False,
    ),
    "cache": Command(
        cache,
        "where compiled programs are kept, and their size; cache clear removes them"
        " (JAXTANK_CACHE=0: none are kept; JAXTANK_CACHE=DIR: there)",
        (*COMMON, Option("what", "clear", "remove the programs of all versions", nargs="?")),
        "Print where the programs that XLA has compiled are kept for the next call, and their"
        " size. With JAXTANK_CACHE=0 none are kept, with JAXTANK_CACHE=DIR they are kept in DIR.",
        compiles=False,
    ),
    "bench": Command(
        bench,
        "ns per closed-loop step here, beside a C loop",
        (
            *COMMON,
            Option("cases", "CASE", 'cases to time instead, or "all"', nargs="*"),
            Option("--rounds", "N", "interleaved rounds to take the median of", whole(1, 1000), 7),
        ),
    ),
}
# fmt: on

"""`jaxtank compare`, `figure`, `completion`, `bench` and `cache`: papers and this machine."""

import os
import sys
import textwrap
from pathlib import Path

from jaxtank.core.errors import InputError, nearest
from jaxtank.core.files import check_folder, write_folder
from jaxtank.core.text import printable
from tuning.cli.options import COMMON, SEEDS, Command, Option
from tuning.cli.steps import finish, picked, print_result, printed, use_float64
from tuning.cli.terminal import Line
from tuning.cli.values import folder, whole


def figure(args):
    """List the figures of the papers, print the caption of one, or draw it to --out."""
    use_float64()
    from tuning.figures.figure import FIGURES, find
    from tuning.report import tables

    if args.figure is None:
        if args.picture:
            raise InputError("--out needs a figure such as gouta2015/6: jaxtank figure lists them")
        rows = [[f.name, "" if f.runs else "no result", f.shows] for f in FIGURES.values()]
        payload = {f.name: {"shows": f.shows, "result": bool(f.runs)} for f in FIGURES.values()}
        text = lambda: tables.table(rows, ["figure", "", "it shows"])
        print_result(args, payload, text, f"{len(rows)} figures")
        return 0
    selected = find(args.figure)
    from tuning.figures import drawing

    if args.picture:
        drawing.check_name(args.picture)
        check_folder(Path(args.picture).parent)
    result = drawing.run(selected)
    if args.picture:
        picture = Path(args.picture)
        data = drawing.rendered(drawing.draw(selected, result), args.picture)
        write_folder(picture.parent, {picture.name: data})
    if args.json:
        runs = [{"label": r.label, "case": r.case, "values": dict(r.values)} for r in selected.runs]
        texts = {"shows": selected.shows, "states": selected.states, "here": list(result.ours)}
        payload = {"figure": selected.name, **texts, "remark": selected.remark, "cases": runs}
        print_result(args, tables.clean(payload), str, f"{selected.name} is redrawn")
    elif not args.quiet or not args.picture:
        print("\n".join(textwrap.fill(p, 80) for p in drawing.caption(selected, result.ours)))
    if args.picture and not args.quiet:
        print(f"written to {printable(args.picture)}", file=sys.stderr)
    return 0


OF_CONTROLLERS: dict[str, object] = {"kind": [], "samples": 256, "seed": 0}
"""Options of `compare` that need --controllers, with their defaults."""


def compare(args):
    """Print published numbers beside ours, or every controller that fits a rig."""
    use_float64()
    if args.controllers:
        from jaxtank import rig
        from tuning.search.comparison import compare_controllers

        if args.markdown:
            raise InputError("--markdown: is of published numbers, not of --controllers")
        line = Line(args.quiet).compiling("the simulation and its derivatives", 15)
        result = compare_controllers(
            rig.check(rig.open_case(args.paper)),
            kinds=args.kind or None,
            **picked(args, "samples seed"),
            progress=lambda name: line.show(f"{name}: search and judging"),
        )
        line.end()
        finish(result, args)
        return 0
    from jaxtank import presets
    from tuning.report import papers as report

    for name, default in OF_CONTROLLERS.items():
        if getattr(args, name) != default:
            raise InputError(f"--{name}: is of --controllers, not of published numbers")
    if args.paper.endswith(".toml"):
        raise InputError(f"compare {args.paper}: takes a paper; of a rig file add --controllers")
    papers = presets.PAPERS if args.paper == "all" else (args.paper,)
    for paper in papers:
        presets.load(paper)  # an unknown paper is refused before the first run
    rows = {}
    for paper in papers:
        if not args.quiet:
            print(f"running {paper}", file=sys.stderr, flush=True)
        rows[paper] = report.measure(paper)
    written = report.save(rows, args.out, args.line) if args.out else []
    text = report.markdown if args.markdown else lambda rows: printed(report.report(rows))
    print_result(args, report.json_of(rows), lambda: text(rows), written=written)
    return 0


def bench(args):
    """Time the closed loop on this machine."""
    use_float64()
    from jaxtank import presets, rig
    from tuning.bench import bench as timing

    if args.cases:
        names = presets.names() if args.cases == ["all"] else args.cases
        rows = timing.measure_cases({name: rig.open_case(name) for name in names}, args.rounds)
        print_result(args, rows, lambda: timing.text_of_cases(rows), f"{len(names)} cases timed")
    else:
        rows = timing.measure(args.rounds)
        print_result(args, rows, lambda: timing.text(rows), "the closed loop is timed")
    return 0


def cache(args):
    """Print where compiled programs are kept, or remove them."""
    from jaxtank.xla import program_cache as programs

    if args.what not in (None, "clear"):
        close = nearest(args.what, ["clear"])
        raise InputError(f"cache: unknown action {args.what!r}{close}: must be clear, or omitted")
    base = programs.base_folder()
    if base is None:
        why = "JAXTANK_CACHE=0" if os.environ.get(programs.SWITCH) else "there is no home folder"
        off = f"off: {why}"
        print_result(args, {"folder": None, "why": why}, lambda: off, off)
        return 0
    if base.exists() and (why := programs.refused(base)):
        raise InputError(f"cache: {why}")
    removed = {"removed": programs.clear(base)} if args.what else {}
    count, size = (sum(column) for column in zip((0, 0), *programs.contents(base).values()))
    payload = {"folder": str(base), "programs": count, "bytes": size, "largest": programs.LARGEST}
    limit = f"at most {programs.LARGEST / 2**20:.0f} MiB for each version"
    lines = [f"{number} programs removed" for number in removed.values()]
    lines.append(f"{base}: {count} programs, {size / 2**20:.2g} MiB ({limit})")
    print_result(args, payload | removed, lambda: "\n".join(lines), f"{count} programs are kept")
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
        "published and measured numbers side by side, and why they differ; PAPER or all",
        (
            *COMMON,
            Option("paper", "PAPER", 'a paper (see jaxtank list), or "all"; with --controllers a'
                   " case or rig file"),
            Option("--controllers", help="instead: every controller that fits the rig, at its first"
                   " gains and tuned, with and without the safety filter, on the same plants"
                   " (about a minute for each)", kind="flag"),
            Option("--kind", "NAME", "with --controllers: this one only, as the table names it",
                   kind="list"),
            Option("--samples", "N", "with --controllers: plants", whole(1, 10**6),
                   OF_CONTROLLERS["samples"]),
            Option("--seed", "N", "with --controllers: seed of plants, noise and searches", SEEDS,
                   0),
            Option("--out", "DIR", "folder for report.html, result.json and pictures", folder),
            Option("--markdown", help="as a Markdown table", kind="flag"),
        ),
    ),
    "figure": Command(
        figure,
        "a figure of a paper redrawn from our runs, such as gouta2015/6; default: list all figures",
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
            Option("words", "...", "words of the command line, passed by the script", nargs="..."),
        ),
        compiles=False,
    ),
    "cache": Command(
        cache,
        "folder and size of the cache of compiled programs; cache clear empties it"
        " (JAXTANK_CACHE=0: no cache; JAXTANK_CACHE=DIR: another folder)",
        (*COMMON, Option("what", "clear", "remove the programs of all versions", nargs="?")),
        "Print the folder in which programs compiled by XLA are kept for the next call, and its"
        " size. JAXTANK_CACHE=0 turns the cache off, JAXTANK_CACHE=DIR chooses the folder.",
        compiles=False,
    ),
    "bench": Command(
        bench,
        "time of a closed-loop step on this machine [ns], compared with a C loop",
        (
            *COMMON,
            Option("cases", "CASE", 'cases to time instead, or "all"', nargs="*"),
            Option("--rounds", "N", "interleaved rounds; the median is printed", whole(1, 1000), 7),
        ),
    ),
}
# fmt: on

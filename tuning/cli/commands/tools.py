"""`jaxtank compare`, `figure`, `completion`, `bench` and `cache`: the papers and their figures, the
shell, the speed of this machine, the programs that are kept."""

import os
import sys
import textwrap
from pathlib import Path

from jaxtank.core.errors import InputError
from jaxtank.core.files import check_folder, write_folder
from jaxtank.core.text import printable
from tuning.cli.arguments import option, whole
from tuning.cli.options import report_written


def add(commands, parents):
    """Add the commands of this module to the parser's `commands`."""
    one = commands.add_parser(
        "compare",
        parents=[parents.common],
        help="published numbers beside measured ones, and why they differ; PAPER or all",
    )
    one.set_defaults(run=compare)
    one.add_argument("paper", metavar="PAPER", help='a paper (see jaxtank list), or "all"')
    option(one, "--out", "DIR", "folder for report.html, result.json and the rigs as pictures")
    one.add_argument("--markdown", action="store_true", help="as a Markdown table")
    one = commands.add_parser(
        "figure",
        parents=[parents.common],
        help="a figure of a paper redrawn by our runs, as gouta2015/6; without one the list of all",
    )
    one.set_defaults(run=figure)
    one.add_argument("figure", nargs="?", metavar="PAPER/N", help="the figure (default: list all)")
    one.add_argument(
        "--out",
        dest="picture",
        metavar="FILE",
        help="the picture: .svg, .png or .pdf (default: print its caption)",
    )
    one = commands.add_parser(
        "completion",
        help="a script that completes commands, options, cases and parameters: bash, zsh or fish",
    )
    one.set_defaults(run=completion)
    one.add_argument("shell", metavar="SHELL", help='as in: eval "$(jaxtank completion bash)"')
    one = commands.add_parser(
        "cache",
        parents=[parents.common],
        help="where compiled programs are kept, and their size; cache clear removes them"
        " (JAXTANK_CACHE=0: none are kept; JAXTANK_CACHE=DIR: there)",
        description="Print where the programs that XLA has compiled are kept for the next call, and"
        " their size. With JAXTANK_CACHE=0 none are kept, with JAXTANK_CACHE=DIR they are kept in"
        " DIR.",
    )
    one.set_defaults(run=cache)
    one.add_argument("what", nargs="?", metavar="clear", help="remove the programs of all versions")
    one = commands.add_parser(
        "bench", parents=[parents.common], help="ns per closed-loop step here, beside a C loop"
    )
    one.set_defaults(run=bench)
    one.add_argument("cases", nargs="*", metavar="CASE", help='cases to time instead, or "all"')
    option(
        one,
        "--rounds",
        "N",
        "interleaved rounds to take the median of (default 7)",
        7,
        whole(1, 1000),
    )


def figure(args):
    """List the figures of the papers, print the caption of one, or draw it to --out."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from tuning.figures.figure import FIGURES, find
    from tuning.report import tables

    if args.figure is None:
        if args.picture:
            raise InputError("--out needs a figure, as gouta2015/6: jaxtank figure lists them")
        rows = [[f.name, "" if f.runs else "no result", f.shows] for f in FIGURES.values()]
        shown = {f.name: {"shows": f.shows, "result": bool(f.runs)} for f in FIGURES.values()}
        print(tables.dumps(shown) if args.json else tables.table(rows, ["figure", "", "it shows"]))
        return 0
    one = find(args.figure)
    from tuning.figures import drawing

    if args.picture:
        drawing.check_name(args.picture)
        check_folder(Path(args.picture).parent)
    drawn, written = drawing.run(one), []
    if args.picture:
        data = drawing.rendered(drawing.draw(one, drawn), args.picture)
        written = write_folder(Path(args.picture).parent, {Path(args.picture).name: data})
    if args.json:
        cases = [{"label": r.label, "case": r.case, "values": dict(r.values)} for r in one.runs]
        texts = {"shows": one.shows, "states": one.states, "here": list(drawn.ours)}
        payload = {"figure": one.name, **texts, "remark": one.remark, "cases": cases}
        print(tables.dumps(tables.clean(payload)))
    elif not args.quiet or not args.picture:
        print("\n".join(textwrap.fill(p, 80) for p in drawing.caption(one, drawn.ours)))
    if written and not args.quiet:
        print(f"written to {printable(args.picture)}", file=sys.stderr)
    return 0


def compare(args):
    """Print what a paper publishes beside what is measured here."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from jaxtank import presets
    from tuning.report import papers as report
    from tuning.report import tables
    from tuning.report.document import terminal

    papers = presets.PAPERS if args.paper == "all" else (args.paper,)
    for paper in papers:
        presets.load(paper)  # an unknown one is refused before anything runs
    found = {}
    for paper in papers:
        if not args.quiet:
            print(f"running {paper}", file=sys.stderr, flush=True)
        found[paper] = report.measure(paper)
    written = report.save(found, args.out, args.line) if args.out else []
    if args.json:
        print(tables.dumps(found if args.paper == "all" else found[args.paper]))
    elif args.markdown:
        print(report.markdown(found))
    else:
        print(terminal(report.report(found)))
    report_written(written, args)
    return 0


def bench(args):
    """Time the closed loop on this machine."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from tuning.bench import bench as timing
    from tuning.report import tables

    if args.cases:
        from jaxtank import presets, rig

        names = presets.names() if args.cases == ["all"] else args.cases
        found = timing.measure_cases({name: rig.open_case(name) for name in names}, args.rounds)
        print(tables.dumps(found) if args.json else timing.text_of_cases(found))
        return 0
    found = timing.measure(args.rounds)
    print(tables.dumps(found) if args.json else timing.text(found))
    return 0


def cache(args):
    """Print where compiled programs are kept, or remove them."""
    from jaxtank.core.errors import InputError, nearest
    from jaxtank.xla import program_cache as kept
    from tuning.report import tables

    if args.what not in (None, "clear"):
        close = nearest(args.what, ["clear"])
        raise InputError(f"cache: unknown action {args.what!r}{close}: must be clear, or left out")
    base = kept.base_folder()
    if base is None:
        why = "JAXTANK_CACHE=0" if os.environ.get(kept.SWITCH) else "there is no home folder"
        print(tables.dumps({"folder": None, "why": why}) if args.json else f"off: {why}")
        return 0
    why = kept.refused(base) if base.exists() else ""
    if why:
        raise InputError(f"cache: {why}")
    removed = kept.clear(base) if args.what else None
    count, size = (sum(column) for column in zip((0, 0), *kept.contents(base).values()))
    found = {"folder": str(base), "programs": count, "bytes": size, "largest": kept.LARGEST}
    if args.json:
        print(tables.dumps(found if removed is None else found | {"removed": removed}))
        return 0
    if removed is not None:
        print(f"{removed} programs removed")
    limit = f"at most {kept.LARGEST / 2**20:.0f} MiB for each version"
    print(f"{base}: {count} programs, {size / 2**20:.2g} MiB ({limit})")
    return 0


def completion(args):
    """Print the completion script of a shell."""
    from tuning.cli import completion as scripts

    sys.stdout.write(scripts.script(args.shell, args.top))
    return 0

"""`jaxtank compare`, `completion` and `bench`: the papers, the shell, the speed of this machine."""

import sys

from tuning.cli.arguments import option
from tuning.cli.options import report_written
from tuning.cli.values import whole


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
        "completion",
        help="a script that completes commands, options, cases and parameters: bash, zsh or fish",
    )
    one.set_defaults(run=completion)
    one.add_argument("shell", metavar="SHELL", help='as in: eval "$(jaxtank completion bash)"')
    one = commands.add_parser(
        "bench", parents=[parents.common], help="ns per closed-loop step here, beside a C loop"
    )
    one.set_defaults(run=bench)
    one.add_argument("cases", nargs="*", metavar="CASE", help='cases to time instead, or "all"')
    option(one, "--rounds", "N", "interleaved rounds to take the median of (default 7)", "7")


def compare(args):
    """Print what a paper publishes beside what is measured here."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from jaxtank import presets
    from tuning.report import papers as report
    from tuning.report import tables

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
        print("\n\n".join(report.text(page) for page in found.values()))
    report_written(written, args)
    return 0


def bench(args):
    """Time the closed loop on this machine."""
    rounds = whole("--rounds", args.rounds, 1, 1000)
    import jax

    jax.config.update("jax_enable_x64", True)
    from tuning.bench import bench as timing
    from tuning.report import tables

    if args.cases:
        from jaxtank import presets, rig

        names = presets.names() if args.cases == ["all"] else args.cases
        found = timing.measure_cases({name: rig.open_case(name) for name in names}, rounds)
        print(tables.dumps(found) if args.json else timing.text_of_cases(found))
        return 0
    found = timing.measure(rounds)
    print(tables.dumps(found) if args.json else timing.text(found))
    return 0


def completion(args):
    """Print the completion script of a shell."""
    from tuning.cli import completion as scripts

    sys.stdout.write(scripts.script(args.shell, args.top))
    return 0

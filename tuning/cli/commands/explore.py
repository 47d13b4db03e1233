"""`jaxtank explore`: the live page of a case, and a gallery of all of them."""

import sys
import tempfile
import webbrowser
from pathlib import Path

from jaxtank.core.errors import InputError
from jaxtank.core.text import printable
from tuning.cli.arguments import changes
from tuning.cli.values import open_case


def add(commands, parents):
    """Add the command of this module to the parser's `commands`."""
    one = commands.add_parser(
        "explore",
        parents=[parents.common, changes()],
        help="one HTML file in which the loop runs and is tuned while its sliders move",
        description="Write the closed loop of a case as one HTML file that needs no network: in a"
        " browser it runs again whenever a slider moves, it is tuned there, and it gives the"
        " command, the rig file and the CSV file of what it shows.",
    )
    one.set_defaults(run=explore)
    one.add_argument(
        "case",
        metavar="CASE",
        nargs="?",
        help='"paper/case" (see jaxtank list) or a rig file ending in .toml',
    )
    one.add_argument(
        "--out",
        dest="page",
        metavar="HTML",
        help="file to write, as page.html; with --all the folder of the pages",
    )
    one.add_argument("--open", action="store_true", help="open the page in the browser")
    one.add_argument("--all", action="store_true", help="a page of each case, and index.html")


def explore(args):
    """Write the live page of a case, or of all cases with a page that lists them."""
    if args.all == (args.case is not None):
        raise InputError("explore: give a case (see jaxtank list), or --all for every case")
    if args.page is None and (args.all or not args.open):
        raise InputError(
            f"explore: give --out {'DIR' if args.all else 'page.html'}"
            + ("" if args.all else ", or --open to look at it")
        )
    if args.page is not None and not args.page.strip():
        raise InputError("--out '': must name a file")
    written = _gallery(args) if args.all else _page(args)
    if args.open:
        webbrowser.open_new_tab(written[0].resolve().as_uri())
    return 0


def _page(args):
    """Write the page of one case; returns its path."""
    path = Path(args.page or Path(tempfile.mkdtemp(prefix="jaxtank-"), "page.html"))
    if path.is_dir():
        raise InputError(f"--out {str(path)!r} is a folder: give a file, as {path}/page.html")
    from jaxtank.core.files import check_folder

    check_folder(path.parent)
    case = open_case(args)
    from tuning.live import shown

    live = shown.of_case(case, source=args.case if args.case.endswith(".toml") else None)
    live.save(path)
    _report(args, {"case": case.name, "page": str(path), "bytes": len(live.text.encode())})
    return [path]


def _gallery(args):
    """Write the pages of all cases and index.html; returns their paths."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from tuning.live.gallery import gallery

    def note(name):
        if not args.quiet:
            print(f"writing {name}", file=sys.stderr, flush=True)

    paths = gallery(args.page, each=note)
    if args.json:
        from tuning.report import tables

        print(tables.dumps({"pages": [str(path) for path in paths]}))
    return paths


def _report(args, payload):
    from tuning.report import tables

    if args.json:
        print(tables.dumps(payload))
    elif not args.quiet:
        size = f"{payload['bytes'] / 1000:.0f} kB"
        print(f"written: {printable(payload['page'])}, {size}", file=sys.stderr)

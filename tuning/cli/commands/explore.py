"""`jaxtank explore`: the live page of a case."""

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
        "case", metavar="CASE", help='"paper/case" (see jaxtank list) or a rig file ending in .toml'
    )
    one.add_argument("--out", dest="page", metavar="HTML", help="file to write, as page.html")
    one.add_argument("--open", action="store_true", help="open the page in the browser")


def explore(args):
    """Write the live page of a case."""
    if args.page is None and not args.open:
        raise InputError("explore: give --out page.html, or --open to look at it")
    if args.page is not None and not args.page.strip():
        raise InputError("--out '': must name a file")
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
    if args.open:
        webbrowser.open_new_tab(path.resolve().as_uri())
    return 0


def _report(args, payload):
    from tuning.report import tables

    if args.json:
        print(tables.dumps(payload))
    elif not args.quiet:
        size = f"{payload['bytes'] / 1000:.0f} kB"
        print(f"written: {printable(payload['page'])}, {size}", file=sys.stderr)

"""`jaxtank explore`: the live page of a case."""

import sys
import tempfile
import webbrowser
from pathlib import Path

from jaxtank.core.errors import InputError
from jaxtank.core.files import check_folder
from jaxtank.core.text import printable
from tuning.cli.options import CASE, COMMON, Command, Option
from tuning.cli.steps import open_case, print_result
from tuning.cli.terminal import Line


def explore(args):
    """Write the live page of a case."""
    if args.page is None and not args.open:
        raise InputError("explore: give --out page.html, or --open to look at it")
    if args.page is not None and not args.page.strip():
        raise InputError("--out '': must name a file")
    path = Path(args.page or Path(tempfile.mkdtemp(prefix="jaxtank-"), "page.html"))
    if path.is_dir():
        raise InputError(f"--out {str(path)!r} is a folder: give a file, as {path}/page.html")
    check_folder(path.parent)
    case = open_case(args)
    from jaxtank.live.page import live_page

    line = Line(args.quiet).compiling("the page", 10)
    live = live_page(case, source=args.case if args.case.endswith(".toml") else None)
    line.end()
    live.save(path)
    size = len(live.text.encode())
    if args.json:
        payload = {"case": case.name, "page": str(path), "bytes": size}
        print_result(args, payload, str, f"the live page of {case.name} is written")
    elif not args.quiet:
        print(f"written: {printable(path)}, {size / 1000:.0f} kB", file=sys.stderr)
    if args.open:
        webbrowser.open_new_tab(path.resolve().as_uri())
    return 0


# fmt: off
COMMANDS = {
    "explore": Command(
        explore,
        "one HTML file in which the loop runs and is tuned while its sliders move",
        (
            *COMMON, *CASE,
            Option("--out", "HTML", "file to write, as page.html", dest="page"),
            Option("--open", help="open the page in the browser", kind="flag"),
        ),
        "Write the closed loop of a case as one HTML file that needs no network: in a browser it"
        " runs again whenever a slider moves, it is tuned there, and it gives the command, the rig"
        " file and the CSV file of the run.",
    )
}
# fmt: on

"""`--watch`: a page in the folder of a search that follows it."""

import contextlib
import re
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxtank.core.errors import InputError
from jaxtank.core.text import printable
from tuning.cli.interrupts import before_leaving

PERIOD = 1.0
"""Least time between two pages [s]."""
SHARE = 20.0
"""Least ratio of that time to the time that writing one takes."""
MOST = 1500
"""Evaluations whose dots a page shows, the latest."""


class Watch:
    """Writes watch.html and watch.js to a folder while a search runs; no failure of it ends one."""

    def __init__(
        self,
        folder: str | Path,
        case: Any,
        written: Callable[[Path], Any] = lambda path: None,
        clock: Callable[[], float] = time.time,
    ):
        from tuning.live.watch import Watched

        self.folder, self.written, self.clock = Path(folder), written, clock
        self.state = Watched(case.name, case.title, clock())
        self.last, self.took, self.before = -PERIOD, 0.0, 0
        self.there, self.details = False, None

    def __call__(self, event: dict[str, Any]) -> None:
        """Take an event of a search (`tuning.search.driver.event_of`); write at times."""
        state, number = self.state, event["evaluations"]
        if not state.bests or number < self.before or event.get("unit", state.unit) != state.unit:
            state.bests.append([])
        if number != self.before:
            state.evaluations += 1
            held = not event["violation"]
            state.costs = [*state.costs[1 - MOST :], (state.evaluations, event["cost"], held)]
        self.before = number
        state.unit = event.get("unit") or state.unit
        state.best, state.violation = event["best"], event["best_violation"]
        if state.best is not None:
            state.bests[-1].append((state.evaluations, state.best))
        state.stage, self.details = _stage(event), event["details"]
        if self.clock() - self.last >= max(PERIOD, SHARE * self.took):
            self.write()

    def write(self) -> None:
        """Write the page as it is now; what cannot be written is left out."""
        from jaxtank.core.files import write_together
        from tuning.live.watch import PAGE, files

        began = self.last = self.state.now = self.clock()
        details = self.details() if self.details else {"parameters": [], "limits": []}
        self.state.parameters, self.state.limits = details["parameters"], details["limits"]
        with contextlib.suppress(OSError):
            self.folder.mkdir(parents=True, exist_ok=True)
            write_together(self.folder, files(self.state))
            if not self.there:
                self.there = True
                self.written(self.folder / PAGE)
        self.took = self.clock() - began

    def end(
        self,
        state: str,
        lines: list[str] | tuple[str, ...] = (),
        result: bool = False,
        values: dict[str, float] | None = None,
    ) -> None:
        """Write the last page, if there was one before; state : "ended", "interrupted",
        "failed".
        """
        if not self.there:
            return
        report = "report.html"
        self.state.state, self.state.answer = state, tuple(lines)
        self.state.values = values or {}
        self.state.report = report if result and (self.folder / report).exists() else None
        self.write()

    def __enter__(self) -> "Watch":
        self.leaving = before_leaving(
            lambda: self.end("interrupted", ["Stopped by a second signal: no result was written."])
        )
        self.leaving.__enter__()
        return self

    def __exit__(self, *_: Any) -> None:
        self.leaving.__exit__()
        if self.state.state == "running":
            self.end("failed")


def watch_of(args: Any, case: Any, folder: str | None, line: Any) -> Watch | None:
    """Return the Watch of a search with the options `args`; None where nothing is to follow it."""
    if args.watch and folder is None:
        raise InputError("--watch writes DIR/watch.html: give --out DIR")
    if folder is None or not (args.watch or (line.terminal and not args.quiet)):
        return None

    def written(path: Path) -> None:
        if not args.quiet:
            line.end()
            print(f"jaxtank: note: {printable(str(path))} follows the search", file=sys.stderr)

    return Watch(folder, case, written)


def first_sentence(text: str) -> str:
    """Return the first lines of a result up to the one that ends in its time, as one line."""
    return re.split(r"(?<= s\))\n|\n\n", text, maxsplit=1)[0].replace("\n", " ")


def _stage(event):
    """What is done now, in words."""
    start, starts = event["start"] + 1, event["starts"]
    words = f"local search {start} of {starts}" if start <= starts else "last searches"
    stage = event.get("stage", "")
    return ", ".join(filter(None, [stage, "" if stage.startswith("judging") else words]))

"""What `tune` reports of its search while it runs."""

import sys

from tuning.cli.interrupts import Interrupts
from tuning.cli.terminal import Line


class Progress(Interrupts):
    """A line per evaluation on a terminal, a line per local search elsewhere."""

    def __init__(self, unit, quiet, option=None):
        super().__init__()
        self.unit, self.last, self.line = unit, None, Line(quiet)
        self.note = option and f"{option} implies --nominal: the optimum of the case as it is"
        self.line.compiling("the simulation and its derivatives", 15)

    def __call__(self, event):
        if self.note:  # not before the search begins: an error is one line
            print(f"jaxtank: note: {self.note}", file=sys.stderr)
            self.note = None
        if event["evaluations"] > 1:
            self.check()
        if not self.line.terminal and event["start"] == self.last:
            return
        self.last = event["start"]
        breaks = " (breaks a limit)" if event["best_violation"] else ""
        unit = event.get("unit") or self.unit
        best = "none yet" if event["best"] is None else f"{event['best']:.6g} {unit}{breaks}"
        self.line.show(
            f"start {min(event['start'] + 1, event['starts'])}/{event['starts']}  evaluation"
            f" {event['evaluations']}  best {best}"
        )

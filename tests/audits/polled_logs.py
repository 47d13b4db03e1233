"""Intervals of `identify` on logs that poll a pump which steps between their rows, or a controller.

    python tests/audits/polled_logs.py [seeds]

For each way to poll: how many 95 % intervals of gain and drain hold the truth, and of how many logs
the structure is rejected, with the moments of the changes and with changes at the rows
(--hold zero-order). The logs are those of tests/unit/identification/test_moments.py.
"""

import dataclasses
import sys
from pathlib import Path

import jax

sys.path.insert(0, str(Path(__file__).parents[1]))  # helpers
sys.path.insert(0, str(Path(__file__).parents[1] / "unit" / "identification"))

from test_moments import identified, outside, record, record_of_loop

from tuning.report import tables
from tuning.report.identification import diagnosis_of

POLLED = ((7.0, 40.0), (3.0, 40.0), (2.0, 41.3), (2.0, 40.0))  # rows, changes [s]; the last at rows
LOOPS = ((5.0, 0.5), (5.0, 5.0))  # rows, sampling period of a PI, from another moment on [s]
END, LONG = 1200.0, 30_000.0  # of a log of a loop [s]; the long one is identified in parts


def main(seeds):
    rows = []
    of_loops = [(*loop, END) for loop in LOOPS] + [(*LOOPS[0], LONG)]
    for period, every, end in (*((*steps, None) for steps in POLLED), *of_loops):
        row = [f"{period:g} s", f"{'a PI' if end else 'steps'}, {every:g} s"]
        row[1] += f", {end / period:,.0f} rows" if end == LONG else ""
        make = (lambda seed, p, e, end=end: record_of_loop(seed, e, p, end=end)) if end else record
        for hold in ("", "zero-order"):
            logs = [make(seed, period, every) for seed in range(seeds)]
            fits = [identified(dataclasses.replace(log, hold=hold))[0] for log in logs]
            missed = sum(len(outside(fit)) for fit in fits)
            rejected = sum(not diagnosis_of(fit)["clean"] for fit in fits)
            row += [f"{2 * seeds - missed} of {2 * seeds}", f"{rejected} of {seeds}"]
        rows.append(row)
    heads = ["rows every", "inputs change every", "hold the truth", "rejected"]
    print(tables.table(rows, [*heads, "with zero-order", "rejected"]))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 8)

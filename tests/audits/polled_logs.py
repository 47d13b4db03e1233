"""Intervals of `identify` on logs that poll a pump which steps between their rows, or a controller.

    python tests/audits/polled_logs.py [seeds]
    python tests/audits/polled_logs.py two     the intervals of two tanks with a PI each: five
                                               parameters, logs of 300 and of 3,000 rows, and of
                                               the latter with every change of the inputs (40 min)
    python tests/audits/polled_logs.py gaps    logs of one tank that lost the rows at which its
                                               pump steps, with --gap 5

For each way to poll: how many 95 % intervals of gain and drain hold the truth, and of how many logs
the structure is rejected, with the moments of the changes and with changes at the rows
(--hold zero-order). The logs are those of tests/unit/identification/test_moments.py.
"""

import dataclasses
import sys
from pathlib import Path

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # helpers
sys.path.insert(0, str(Path(__file__).parents[1] / "unit" / "identification"))

from test_moments import identified, outside, record, record_of_loop

import tuning
from jaxtank import rig
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


def of_gaps(seeds=20):
    """Each tenth row and those of a third of the steps are missing."""
    rows = []
    for hold in ("", "zero-order"):
        missed = rejected = 0
        for seed in range(seeds):
            rng, log = np.random.default_rng(seed), record(seed, 2.0, 40.0)
            keep = rng.random(log.samples) > 0.1
            keep[np.flatnonzero(np.diff(log.u[:, 0]))[::3] + 1] = False
            keep[0] = True
            data = {"t": log.t[keep], "u": log.u[keep], "y": log.y[keep], "hold": hold}
            fit, _ = identified(tuning.log(**data), gap=5.0)
            missed += len(outside(fit))
            rejected += not diagnosis_of(fit)["clean"]
        right = f"{2 * seeds - missed} of {2 * seeds}"
        rows.append([hold or "not stated", right, f"{rejected} of {seeds}"])
    print(tables.table(rows, ["hold", "hold the truth", "rejected"]))


PAIR = """
units = ["cm", "V"]
tank = [{ area = 100.0, rim = 40.0, drain = 1.2, level = 12.0 },
    { area = 150.0, rim = 40.0, drain = 0.8, level = 10.0 }]
orifice = [{ from = 1, to = 2, area = 0.6 }]
pump = [{ gain = 30.0, to = 1, high = 10.0, initial = 6.0 },
    { gain = 20.0, to = 2, high = 10.0, initial = 4.0 }]
plant = { outputs = [1, 2] }
controller = { kind = "pi", Kc = [1.0, 1.0], Ti = [60.0, 60.0], bias = [6.0, 4.0] }
reference = { initial = [12.0, 10.0] }
values = { "clock.dt" = 1.0 }
"""
GAINS, DRAINS, ORIFICE, AREAS = np.array([25.0, 22.0]), np.array([1.0, 0.9]), 0.5, [100.0, 150.0]
TRUE = {f"plant.pump_gain[{i}]": v for i, v in enumerate(GAINS)}
TRUE |= {f"plant.drain[{i}]": v for i, v in enumerate(DRAINS)} | {"plant.orifice[0]": ORIFICE}
FREE = {"plant.pump_gain": (5.0, 100.0), "plant.drain": (0.1, 5.0), "plant.orifice": (0.05, 5.0)}


def record_of_pair(seed, end, regular, dt=0.1, gain=0.15):
    """(log with rows every 5 s, from a drawn moment on, of two tanks under PIs of 0.5 s, whose
    setpoints change every 300 s (regular) or at drawn times; the same readings with all changes).
    """
    rng, h, rows = np.random.default_rng(seed), np.array([12.0, 10.0]), []
    u = integral = np.array([6.0, 4.0])
    first = rng.integers(50)
    times = np.arange(0.0, end, 300.0) if regular else np.sort(rng.uniform(0, end, int(end / 250)))
    setpoints = rng.uniform(8.0, 16.0, (len(times) + 1, 2))

    def rates(h, u):
        speeds = np.sqrt(2 * 981.0 * np.maximum(h, 0.0))
        return (GAINS * u - DRAINS * speeds + np.array([-1.0, 1.0]) * ORIFICE * speeds[0]) / AREAS

    for k in range(int(end / dt)):
        if k % 5 == 0:
            r = setpoints[np.searchsorted(times, k * dt, side="right")]
            error = r - (h + 0.05 * rng.standard_normal(2))
            integral = integral + gain * error * 0.5 / 60.0
            u = np.clip(integral + gain * error, 0.0, 10.0)
        y = h + 0.05 * rng.standard_normal(2) if k % 50 == first else np.full(2, np.nan)
        if k >= first and (k % 5 == 0 or k % 50 == first):
            rows.append((k * dt, *u, *y))
        h = h + dt * rates(h + 0.5 * dt * rates(h, u), u)
    rows = np.array(rows)
    as_log = lambda rows: tuning.log(t=rows[:, 0], u=rows[:, 1:3], y=rows[:, 3:])
    return as_log(rows[np.isfinite(rows[:, 3])]), dataclasses.replace(
        as_log(rows), hold="zero-order"
    )


PAIRS = ((1500.0, True, 4), (1500.0, False, 4), (15e3, True, 7), (15e3, False, 6))
"""(end of a log [s], whether setpoints change every 300 s, seeds)"""


def of_pair():
    case, rows = rig.loads(PAIR), []
    for end, regular, seeds in PAIRS:
        counts = [0, 0]
        for seed in range(seeds):
            for i, log in enumerate(record_of_pair(seed, end, regular)[: 1 + (end > 1500.0)]):
                fit = tuning.identify(case, log, FREE, starts=1, hold_back=0.0).parameters
                ends = {name: fit[name]["interval95"] or (np.nan, np.nan) for name in TRUE}
                counts[i] += sum(ends[n][0] <= value <= ends[n][1] for n, value in TRUE.items())
        times = "every 300 s" if regular else "drawn"
        shares = [f"{count} of {5 * seeds}" for count in counts]
        rows.append([f"{end / 5:,.0f}", times, shares[0], shares[1] if end > 1500.0 else ""])
    heads = ["rows", "setpoints change", "hold the truth", "with all changes"]
    print(tables.table(rows, heads))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    if sys.argv[1:] in (["two"], ["gaps"]):
        sys.exit({"two": of_pair, "gaps": of_gaps}[sys.argv[1]]())
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 8)

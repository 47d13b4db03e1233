"""The record of the cascaded tanks: fit, blocked cross-validation and error by level.

python tests/audits/cascaded_tanks.py               the record of tests/data
python tests/audits/cascaded_tanks.py OTHER.csv     the same fit, on another record too
"""

import sys
from pathlib import Path

import jax
import numpy as np

import tuning
from jaxtank import presets

RECORD = Path(__file__).parents[1] / "data" / "cascaded_tanks.csv"
BLOCKS = 4
START = 50
"""Samples that the first levels of a prediction follow from."""
EDGES = (0.0, 3.0, 3.5, 4.0, 5.0, 6.0, 8.0, 9.9, 11.0)
"""Readings between which errors are averaged [V]."""


def fitted(case, logs):
    """The identified case of `jaxtank identify cascaded/open-loop --refine`."""
    result = tuning.identify(case, logs, refine=True, starts=2, hold_back=0)
    parts = ", ".join(f"{p.kind} {p.where + 1}" for p in result.refinements) or "no part added"
    return result, parts


def errors(case, log):
    """Measured less predicted readings, levels free from the first samples."""
    result = tuning.predict(case, log, start_samples=START)
    y = result.estimation.predicted(result.estimation.unknowns(result.fit))
    return log.y[:, 0] - y[0, :, 0]


def print_errors(words, error, y):
    """Print RMS, and mean and RMS error by level."""
    rms = lambda e: float(np.sqrt(np.mean(e**2)))
    print(f"{words}: {rms(error):.4f} V RMS")
    for low, high in zip(EDGES, EDGES[1:]):
        inside = error[(y >= low) & (y < high)]
        if inside.size:
            print(
                f"  {low:4.1f} to {high:4.1f} V: {inside.size:4d} readings, mean"
                f" {inside.mean():+.3f} V, {rms(inside):.3f} V RMS"
            )


def main(other=None):
    jax.config.update("jax_enable_x64", True)
    case = presets.find("cascaded/open-loop")
    log = tuning.read_log(RECORD, case.loop, case.log)
    result, parts = fitted(case, [log])
    print(f"fit to all: {result.quality['rmse'][0]:.4f} V RMS, {parts}")
    edges = np.linspace(0, log.samples, BLOCKS + 1).astype(int)
    blocks = []
    for a, b in zip(edges, edges[1:]):
        rest = [log.part(i, j) for i, j in ((0, a), (b, log.samples)) if j > i]
        block = log.part(a, b)
        fit, parts = fitted(case, rest)
        blocks.append(errors(fit.identified, block))
        rms = np.sqrt(np.mean(blocks[-1] ** 2))
        print(f"  samples {a} to {b}, fitted to the others ({parts}): {rms:.4f} V RMS")
    print_errors(
        "blocks, each predicted by a fit to the others", np.concatenate(blocks), log.y[:, 0]
    )
    if other is not None:
        log = tuning.read_log(other, case.loop, case.log)
        print_errors(
            f"{other}, predicted by the fit to all", errors(result.identified, log), log.y[:, 0]
        )


if __name__ == "__main__":
    main(*sys.argv[1:2])

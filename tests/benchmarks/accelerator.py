"""Many uncertain plants on a GPU: one Pallas kernel beside a scan, both checked on this processor.

    python tests/benchmarks/accelerator.py [plants] [samples] [blocks ...]

The four-tank under backstepping in float64, pump gains drawn within 5 %. Wall time: the least of
three later calls, and how much longer the first one takes. The first 64 plants are compared with
runs on the CPU. Defaults: 1,000,000 plants of 120,001 samples in the kernel, blocks of 32 to 128
plants; the scan has a hundredth of the samples, because its time grows with the number of launches.
Exits without a GPU. It has not been run on one yet.
"""

import dataclasses
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxtank
from jaxtank import presets
from tuning.report import tables

NAMES = ("rms_error_total", "max_level", "input_travel")
CHECKED = 64
ROUNDS = 3
HEADS = ["form", "plants", "samples", "first call, s more", "run, s", "ns per step and plant"]
HEADS += ["1e6 plants x 120,001, s", "largest difference to the CPU"]


def row(form, loop, clock, gains, **options):
    """A row of the table for one form."""
    values = {"plant.pump_gain": gains}
    call = lambda v: jaxtank.evaluate_many(loop, clock, NAMES, v, **options)
    began = time.perf_counter()
    found = jax.block_until_ready(call(values))
    first, spent = time.perf_counter() - began, []
    for _ in range(ROUNDS):
        began = time.perf_counter()
        jax.block_until_ready(call(values))
        spent.append(time.perf_counter() - began)
    least, count = min(spent), len(gains)
    with jax.default_device(jax.devices("cpu")[0]):
        true = jaxtank.evaluate_many(
            loop, clock, NAMES, {n: v[:CHECKED] for n, v in values.items()}
        )
        true = jax.device_get(true)
    off = max(np.max(np.abs(np.asarray(found[n])[:CHECKED] / true[n] - 1.0)) for n in NAMES)
    per = 1e9 * least / (count * clock.samples)
    return [form, f"{count:,}", f"{clock.samples:,}", f"{first - least:.1f}", f"{least:.3g}"] + [
        f"{per:.3g}",
        f"{per * 1e-3 * 120_001:.3g}",
        f"{off:.1e}",
    ]


def main(words):
    jax.config.update("jax_enable_x64", True)
    if jax.default_backend() == "cpu":
        sys.exit("jax found no GPU")
    asked = [int(w.replace(",", "")) for w in words] + [1_000_000, 120_001][len(words) :]
    plants, samples, *blocks = asked
    case = presets.find("gouta2015/backstepping")
    clock = dataclasses.replace(case.clock, duration=(samples - 1) * case.clock.dt)
    short = dataclasses.replace(case.clock, duration=(samples - 1) // 100 * case.clock.dt)
    nominal = np.asarray(case.loop.plant.pump_gain)
    drawn = np.random.default_rng(0).uniform(0.95, 1.05, (plants, *nominal.shape))
    gains = jnp.asarray(nominal * drawn)
    print(jax.devices()[0].device_kind, "jax", jax.__version__)
    rows = []
    for block in blocks or (32, 64, 128):
        rows.append(row(f"kernel of {block}", case.loop, clock, gains, kernel=True, batch=block))
        print(tables.table(rows[-1:], HEADS), flush=True)
    rows.append(row("scan", case.loop, short, gains, batch=plants))
    print("\n".join(f"| {' | '.join(r)} |" for r in [HEADS, ["---"] * len(HEADS), *rows]))


if __name__ == "__main__":
    main(sys.argv[1:])

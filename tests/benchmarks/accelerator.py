"""Many plants on an accelerator beside the same runs on the processor.

    python tests/benchmarks/accelerator.py [--plants 10000 100000 1000000] [--dt 0.1]

Wall time of `evaluate_many` on gouta2015/backstepping, compiled before, arrays already there.
Without an accelerator it says so and prints the processor alone.
"""

import argparse
import time

import jax
import numpy as np

import jaxtank
from jaxtank import presets, rig
from tuning.uncertainty.draws import Draws
from tuning.uncertainty.sampling import probabilities, spread_of

NAMES = ("rms_error_total", "max_level")
ON_PROCESSOR = 10_000
"""Plants that the processor runs: its time per plant does not depend on their number."""


def timed(case, plants, device, dtype):
    """(wall time [s], {measure: array}) of a second call with the plants on a device."""
    space = Draws(case.loop, spread_of(case))
    values = space.values(probabilities("random", space.dimensions, plants, 0))
    with jax.default_device(device):
        values = {name: jax.numpy.asarray(v, dtype=dtype) for name, v in values.items()}
        loop = jax.tree.map(lambda leaf: np.asarray(leaf, dtype=dtype), case.loop)
        batch = {} if device.platform == "cpu" else {"batch": plants}

        def run():
            measures = jaxtank.evaluate_many(loop, case.clock, NAMES, values, **batch)
            return {name: np.asarray(v) for name, v in measures.items()}

        run()
        began = time.perf_counter()
        measures = run()
        return time.perf_counter() - began, measures


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--plants", type=int, nargs="*", default=[10_000, 100_000, 1_000_000])
    parser.add_argument("--dt", type=float, default=0.1)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    case = rig.set_values(presets.find("gouta2015/backstepping"), {"clock.dt": options.dt})
    processor, device = jax.devices("cpu")[0], jax.devices()[0]
    few = min(ON_PROCESSOR, *options.plants)
    for dtype in (np.float64, np.float32):
        spent, right = timed(case, few, processor, dtype)
        each = 1e9 * spent / few / case.clock.samples
        kind, name = np.dtype(dtype).name, processor.device_kind
        print(f"{kind} {name}, {few:,} plants: {spent:.2f} s, {each:.2f} ns a step and plant")
        if device.platform == "cpu":
            print("no accelerator is here")
            continue
        for plants in options.plants:
            spent, measures = timed(case, plants, device, dtype)
            one = 1e9 * spent / plants / case.clock.samples
            apart = ""
            if plants == few:
                error = max(float(np.abs(right[n] - measures[n]).max()) for n in NAMES)
                apart = f", {error:.1e} cm from the processor"
            print(
                f"{kind} {device.device_kind}, {plants:,} plants: {spent:.2f} s, {one:.3f} ns a"
                f" step and plant, {each / one:.1f} times as fast{apart}"
            )


if __name__ == "__main__":
    main()

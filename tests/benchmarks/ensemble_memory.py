"""Peak memory of an ensemble: 1,000,000 draws beside 1,000, each in a process of its own.

    python tests/benchmarks/ensemble_memory.py [--samples 1000000]

A water tank under PI (tests/data/rigs/watertank.toml, 10 s in steps of 0.1 s), all measures of the
summary, percentiles and violations computed. Peak resident memory by getrusage, with programs that
are compiled anew and with programs that an earlier process has kept: the compiler itself takes
some 60 MiB. The last column is what the draws take, the difference to 1,000 of them.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

RIG = Path(__file__).parents[1] / "data" / "rigs" / "watertank.toml"

CHILD = """
import resource, sys, time
import jax
jax.config.update("jax_enable_x64", True)
import tuning
from jaxtank import rig
case = rig.set_values(rig.load(sys.argv[1]), {"clock.dt": 0.1, "clock.duration": 10.0})
began = time.process_time()
spread = {"plant.drain": 0.05, "plant.pump_gain": 0.05}
found = tuning.ensemble(case, spread, samples=int(sys.argv[2]), fan=False)
found.summary(), found.violations()
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(peak, time.process_time() - began)
"""


def child(samples, kept):
    """(peak memory [MiB], core time [s]) of an ensemble in a process of its own.

    kept : folder of compiled programs, None for none.
    """
    settings = {
        "JAX_COMPILATION_CACHE_DIR": kept,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }
    without = {n: v for n, v in os.environ.items() if n not in settings}
    out = subprocess.run(
        [sys.executable, "-c", CHILD, str(RIG), str(samples)],
        capture_output=True,
        text=True,
        check=True,
        env=without | (settings if kept else {}),
    )
    return tuple(map(float, out.stdout.split()))


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--samples", type=int, default=1_000_000)
    samples = parser.parse_args().samples
    with tempfile.TemporaryDirectory() as folder:
        for words, kept in (("compiled anew", None), ("kept programs", folder)):
            if kept:
                child(1000, kept)
            few, many = child(1000, kept), child(samples, kept)
            print(
                f"{words}: 1,000 draws {few[0]:.0f} MiB, {samples:,} draws {many[0]:.0f} MiB"
                f" ({many[0] - few[0]:+.0f}), {many[1]:.0f} core-seconds",
                flush=True,
            )


if __name__ == "__main__":
    main()

"""Ensembles: time per closed-loop step and lane beside the C loop, what many draws cost, what they hold in memory, what a second device gives.

    python tests/benchmarks/ensemble.py [--rounds 3]

Every figure is of this machine in this run; compilation is apart. The C loop runs one plant at a time
(gcc -O3 -march=native), without vector lanes.
"""

import argparse
import statistics
import subprocess
import sys
import tempfile
import time

import jax
import numpy as np

import tuning
from jaxtank import presets, rig
from tuning import bench

NAMES = ("rms_error_total", "max_level")


def seconds(call, rounds):
    """Median wall time [s] of `call` over rounds, after one that compiles."""
    call()
    times = []
    for _ in range(rounds):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return statistics.median(times)


def draw(case, samples, **options):
    """The ensemble that is timed: error and highest levels, no fan."""
    return tuning.ensemble(case, samples=samples, measures=NAMES, fan=False, **options)


CHILD = """
import re, sys, jax, tuning, time
devices, samples, dt = int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", devices)
from jaxtank import presets, rig
case = rig.set_values(presets.find("gouta2015/backstepping"), {"clock.dt": dt})
run = lambda n: tuning.ensemble(case, samples=n, measures=("rms_error_total", "max_level"), fan=False, devices=devices)
run(512)
began = time.perf_counter()
run(samples)
print(time.perf_counter() - began, int(re.search(r"VmHWM:\\s*(\\d+)", open("/proc/self/status").read())[1]) / 1024)
"""


def child(devices, samples, dt):
    """(wall time [s], peak memory [MiB]) of an ensemble in a process of its own."""
    out = subprocess.run(
        [sys.executable, "-c", CHILD, str(devices), str(samples), str(dt)], capture_output=True, text=True, check=True
    )
    return tuple(float(v) for v in out.stdout.split())


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    rounds = parser.parse_args().rounds
    jax.config.update("jax_enable_x64", True)
    fine = presets.find("gouta2015/backstepping")
    coarse = rig.set_values(fine, {"clock.dt": 0.1})
    with tempfile.TemporaryDirectory() as folder:
        function = bench.c_loop(folder)
        c = None if function is None else seconds(bench.c_runner(function, fine), rounds) / fine.clock.samples
    ns = seconds(lambda: draw(fine, 1024), rounds) / (1024 * fine.clock.samples) * 1e9
    beside = "no gcc" if c is None else f"{ns / (1e9 * c):.2f} x the scalar C loop ({1e9 * c:.1f} ns)"
    print(f"1,024 plants x {fine.clock.samples} samples: {ns:.1f} ns per step and plant, {beside}")
    for words, case in (("RK4", coarse), ("midpoint", rig.set_values(coarse, {"clock.integrator": "midpoint"}))):
        draw(case, 1024)
        began = time.process_time()
        draw(case, 10_000)
        print(f"10,000 plants x {case.clock.samples} samples, {words}: {time.process_time() - began:.2f} core-seconds")
    few, many = child(1, 1_000, 1.0)[1], child(1, 100_000, 1.0)[1]
    print(f"peak memory: 1,000 plants {few:.0f} MiB, 100,000 plants {many:.0f} MiB ({many - few:+.0f})")
    one, two = (np.median([child(n, 4096, 0.1)[0] for _ in range(rounds)]) for n in (1, 2))
    print(f"4,096 plants: one device {one:.2f} s, two devices {two:.2f} s, {one / two:.2f} times")


if __name__ == "__main__":
    main()

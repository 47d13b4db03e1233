"""The four-tank against a C loop of the same arithmetic, and what derivatives cost.

    python tests/benchmarks/four_tank.py [rounds]

Every line is a median over interleaved rounds of one process, with the ratio to its rival in the same round and the spread of that ratio.
Compile time is apart. Nothing is asserted: machines differ and are noisy. The structural causes are pinned in tests/test_compiled_loop.py.
"""

import dataclasses
import statistics
import sys
import tempfile

import jax
import numpy as np

import jaxtank  # noqa: F401  (before jax starts)
from jaxtank import loop, presets
from jaxtank.tree import with_values
from tuning import bench, report

NAMES = bench.MEASURES


def main(rounds):
    jax.config.update("jax_enable_x64", True)
    case = presets.find("gouta2015/backstepping")
    midpoint = case.replace(clock=dataclasses.replace(case.clock, integrator="midpoint"))
    gains = {"controller.k": np.float64(0.03), "controller.k1": np.float64(0.088)}
    run = lambda v: loop.evaluate(with_values(case.loop, v), case.clock, NAMES)
    forward = jax.jit(jax.jacfwd(lambda v: run(v)["rms_error_total"]))
    reverse = jax.jit(
        jax.grad(lambda v: loop.evaluate_for_reverse(with_values(case.loop, v), case.clock, NAMES)["rms_error_total"])
    )
    lanes = {"controller.k": np.full(256, 0.03), "controller.k1": np.geomspace(0.01, 1.0, 256)}
    batch = jax.jit(jax.vmap(run))
    with tempfile.TemporaryDirectory() as folder:
        function = bench.c_loop(folder)
        calls = {
            "run, RK4": lambda: loop.evaluate(case.loop, case.clock, NAMES),
            "run, midpoint": lambda: loop.evaluate(midpoint.loop, midpoint.clock, NAMES),
            "jacfwd, 2 gains": lambda: forward(gains),
            "reverse, 2 gains": lambda: reverse(gains),
            "sensitivities, 2 gains": lambda: loop.sensitivities(case.loop, case.clock, NAMES, gains),
            "256 lanes": lambda: batch(lanes),
        }
        rivals = dict.fromkeys(calls, "run, RK4")
        if function is None:
            print("no gcc here: no C loop")
        else:
            calls["C loop, RK4"] = bench.c_runner(function, case)
            calls["C loop, midpoint"] = bench.c_runner(function, case, rk4=False)
            rivals |= {"run, RK4": "C loop, RK4", "run, midpoint": "C loop, RK4"}
        seconds, results = bench.timed(calls, rounds)
    rows = []
    for name, spent in seconds.items():
        steps = case.clock.samples * (256 if name == "256 lanes" else 1)
        rival = rivals.get(name)
        ratio = [a / b for a, b in zip(spent, seconds[rival])] if rival else None
        shown = "" if ratio is None else f"{statistics.median(ratio):.2f} ({min(ratio):.2f} to {max(ratio):.2f}) x {rival}"
        rows.append([name, f"{1e3 * statistics.median(spent):.2f}", f"{1e9 * statistics.median(spent) / steps:.1f}", shown])
    print(report.table(rows, ["what", "ms", "ns per step and lane", "median ratio (range)"]))
    if function is not None:
        rms, top = results["C loop, RK4"]
        ours = results["run, RK4"]
        apart = max(abs(rms - float(ours["rms_error_total"])), float(np.max(np.abs(top - np.asarray(ours["max_level"])))))
        print(f"jaxtank and the C loop agree to {apart:.1e} cm on the error and the highest levels")
    slopes = [np.array([float(d[g]) for g in gains]) for d in (results["jacfwd, 2 gains"], results["reverse, 2 gains"])]
    print(f"forward and reverse derivatives agree to {np.max(np.abs(slopes[1] / slopes[0] - 1)):.1e}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 15)

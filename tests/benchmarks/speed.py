"""How far this machine's runs are from a C loop, what derivatives cost beside the run, and what a
first use waits for.

    python tests/benchmarks/speed.py [rounds] [--markdown]

Within a block every line is measured in turn, round by round, in one process on one core: medians
of core time, and of the ratio to its rival in the same round, with the range. Compilation is apart.
"at most" is what we set out to reach. Nothing is asserted of time: machines differ. The structural
causes are pinned in tests/unit/loop/test_compiled_loop.py.
"""

import dataclasses
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import ensemble
import jax
import measuring
import numpy as np
from measuring import core_times, ratio

from jaxtank import presets
from jaxtank.core.tree import with_values
from jaxtank.loop import run as loop
from jaxtank.loop.derivatives import sensitivities_compiled
from tuning.bench import bench
from tuning.problem.scenarios import noisy

BEGIN, END = "<!-- tests/benchmarks/speed.py -->", "<!-- end of speed -->"
HEADS = ["what", "measured", "ratio (range)", "to", "at most"]
NAMES = bench.MEASURES
COST = ("rms_error_total",)
BATCHES = 16


def parameters(case):
    """Values of 2, 8 and 30 parameters of the four-tank: gains; areas and pumps; every coefficient
    of the plant and of the law's model.
    """
    controller, plant = case.loop.controller, case.loop.plant
    two = {f"controller.{n}": np.float64(getattr(controller, n)) for n in ("k", "k1")}
    eight = {**two, **{f"plant.{n}": np.array(getattr(plant, n)) for n in ("area", "pump_gain")}}
    of = {"plant": plant, "controller.model": controller.model}
    every = {
        f"{where}.{n}": np.array(getattr(part, n))
        for where, part in of.items()
        for n in ("area", "drain", "orifice", "pump_gain")
    }
    return {2: two, 8: eight, 30: {**two, **every}}


def gradient(case, values):
    """(call, MB of temporary memory) of the gradient of the RMS error by `values`, forward mode."""
    cost = lambda v: loop.evaluate(with_values(case.loop, v), case.clock, COST)[COST[0]]
    call = jax.jit(jax.jacfwd(cost)).lower(values).compile()
    return (lambda: call(values)), call.memory_analysis().temp_size_in_bytes / 1e6


def of_step(dt):
    return f"{1e9 * dt:.0f} ns per step"


def one_run(rounds):
    """Rows of a single run of the four-tank and of its gradients."""
    case = presets.find("gouta2015/backstepping")
    midpoint = case.replace(clock=dataclasses.replace(case.clock, integrator="midpoint"))
    calls = {
        "run": lambda: loop.evaluate(case.loop, case.clock, NAMES),
        "midpoint": lambda: loop.evaluate(midpoint.loop, midpoint.clock, NAMES),
        "cost": lambda: loop.evaluate(case.loop, case.clock, COST),
    }
    memory = {}
    for count, values in parameters(case).items():
        assert sum(np.size(v) for v in values.values()) == count
        calls[count], memory[count] = gradient(case, values)
    with tempfile.TemporaryDirectory() as folder:
        function = bench.c_loop(folder)
        if function is not None:
            calls["C"] = bench.c_runner(function, case)
        seconds = core_times(calls, rounds)
        if function is not None:
            (rms, top), ours = calls["C"](), calls["run"]()
            apart = max(abs(rms - ours[COST[0]]), np.max(np.abs(top - ours["max_level"])))
            print(f"jaxtank and the C loop agree to {apart:.1e} cm on error and highest levels")
    per = {n: of_step(statistics.median(s) / case.clock.samples) for n, s in seconds.items()}
    rows = []
    if function is None:
        print("no gcc here: no C loop")
    else:
        run, half = (ratio(seconds, name, "C") for name in ("run", "midpoint"))
        c = f"C loop, {per['C']}"
        rows.append(["one run, 120,001 steps, RK4", per["run"], run, c, "1.25"])
        rows.append(["the same, midpoint", per["midpoint"], half, "RK4 C loop", "0.85"])
    for count, most in ((2, "3.0"), (8, "4.5"), (30, "6")):
        spent = f"{1e3 * statistics.median(seconds[count]):.0f} ms, {memory[count]:.1f} MB"
        of_run, limit = ratio(seconds, count, "cost"), f"{most}, 10 MB"
        rows.append([f"gradient, {count} parameters", spent, of_run, "the run", limit])
    return rows


def batch(rounds):
    """Rows of many plants in one compiled loop, beside a C loop in vector lanes."""
    case = presets.find("gouta2015/backstepping")
    halves = case.replace(clock=dataclasses.replace(case.clock, integrator="midpoint"))
    fewer = case.replace(clock=dataclasses.replace(case.clock, duration=200.0))
    rows, rounds = [], max(rounds // 4, 3)

    def row(words, ours, theirs, between, rival, most):
        measured = f"{ours:.1f} ns per step and plant"
        rows.append([words, measured, f"{between:.2f}", f"{rival}, {theirs:.1f} ns", most])

    with tempfile.TemporaryDirectory() as folder:
        function = ensemble.c_batch(folder)
        if function is None:
            return rows
        for words, which, plants in (
            ("RK4", case, 256),
            ("RK4", fewer, 4096),
            ("midpoint", halves, 256),
        ):
            *times, apart = ensemble.beside_batch(function, which, plants, rounds)
            assert apart < 1e-10, f"{words}: jaxtank and the C loop are {apart:.1e} cm apart"
            row(f"batch of {plants:,}, {words}", *times, "vectorised C loop", "1.5")
    program = [sys.executable, "-W", "ignore", "-c", SINGLE, str(rounds)]
    options = {"capture_output": True, "text": True, "cwd": Path(__file__).parent}
    times = map(float, subprocess.run(program, check=True, **options).stdout.split())
    rival = "vectorised C loop, float32 not compensated"
    row("batch of 256, RK4, float32 with compensated sums", *times, rival, "2.0")
    return rows


SINGLE = """
import sys, tempfile
sys.path.insert(0, ".")
import ensemble
from jaxtank import presets
with tempfile.TemporaryDirectory() as folder:
    function, case = ensemble.c_batch(folder, single=True), presets.find("gouta2015/backstepping")
    print(*ensemble.beside_batch(function, case, 256, int(sys.argv[1]), single=True)[:3])
"""


def drawing(rounds):
    """Row of sensor noise that is drawn for 256 plants as they run, beside the runs without it."""
    case = presets.find("gouta2015/backstepping")
    keys = jax.random.split(jax.random.key(0), 256)
    gains = np.random.default_rng(0).uniform(0.95, 1.05, (256, 1)) * case.loop.plant.pump_gain

    def compiled(noise):
        def one(gain, key):
            at = {"plant.pump_gain": gain, "sensor.noise": noise}
            return loop.evaluate(with_values(case.loop, at), case.clock, COST, key)

        keyless = lambda gain, key: one(gain, None)
        call = jax.jit(jax.vmap(one if noise.any() else keyless)).lower(gains, keys).compile()
        return lambda: call(gains, keys)

    quiet = np.zeros_like(np.asarray(case.loop.sensor.noise))
    calls = {"quiet": compiled(quiet), "noisy": compiled(quiet + 0.1)}
    seconds = core_times(calls, max(rounds // 4, 3))
    steps = 256 * case.clock.samples
    spent = f"{1e9 * statistics.median(seconds['noisy']) / steps:.0f} ns per step and plant"
    of_run = ratio(seconds, "noisy", "quiet")
    return [["batch of 256, noise of 4 sensors drawn", spent, of_run, "without noise", "2"]]


def gauss_newton(rounds):
    """Row of the tuner's pass: gradient and Gauss-Newton matrix of 8 parameters over 16 scenarios,
    beside the run of the same lanes.
    """
    case = presets.find("gouta2015/backstepping")
    values = parameters(case)[8]
    factors = np.random.default_rng(0).uniform(0.95, 1.05, (BATCHES, 4))
    orifice = factors * np.asarray(case.loop.plant.orifice)
    names, point = tuple(values), tuple(values.values())

    def compiled(one):
        call = jax.jit(jax.vmap(one)).lower(orifice).compile()
        return lambda: call(orifice)

    at = lambda o: with_values(case.loop, {"plant.orifice": o})
    slopes = lambda o: sensitivities_compiled(
        at(o), case.clock, COST, names, point, None, batched=True
    )
    run = compiled(lambda o: loop.evaluate_and_flag(at(o), case.clock, COST))
    seconds = core_times({"run": run, "pass": compiled(slopes)}, max(rounds // 3, 3))
    spent = f"{1e3 * statistics.median(seconds['pass']):.0f} ms"
    of_run, words = ratio(seconds, "pass", "run"), "Gauss-Newton pass, 8 parameters, 16 scenarios"
    return [[words, spent, of_run, "the run of the same batch", "8"]]


def controllers(rounds):
    """Rows of the other papers' laws."""
    rows = []
    for name in ("gouta2022/chadpc", "mirakhorli/hybrid", "mirakhorli/sfc", "calofir/backstepping"):
        case = presets.find(name)
        key = jax.random.key(0) if noisy(case) else None
        once = case.clock
        tenfold = dataclasses.replace(once, duration=10 * once.duration)

        def run(clock, case=case, key=key):
            return lambda: loop.evaluate(case.loop, clock, COST, key)

        runs = {"once": run(once), "tenfold": run(tenfold)}
        # a run of microseconds is mostly the call: what ten times the samples take longer tells the
        # sample
        short, long = map(statistics.median, core_times(runs, rounds).values())
        step = of_step((long - short) / ((tenfold.samples - once.samples) * once.substeps))
        words = f"{name}, {once.integrator}"
        words += f", {once.substeps} steps to a sample" if once.substeps > 1 else ""
        run = f" ({1e3 * short:.1f} ms the run of {once.samples:,} samples)"
        rows.append([words, step + run, "", "", "150 ns"])
    case = presets.find("khalid/laguerre-constrained")
    case = case.replace(clock=dataclasses.replace(case.clock, duration=600 * case.clock.dt))
    cost = lambda v: loop.evaluate(with_values(case.loop, v), case.clock, COST)[COST[0]]
    point = {"controller.r_w": np.asarray(case.loop.controller.r_w, dtype=float)}
    run, slope = jax.jit(cost), jax.jit(jax.jacfwd(cost))
    seconds = core_times({"run": lambda: run(point), "slope": lambda: slope(point)}, rounds)
    run, slope = (f"{1e3 * statistics.median(s):.1f} ms" for s in seconds.values())
    words = f"khalid/laguerre-constrained, {case.clock.samples} samples"
    rows.append([words, run, "", "", "20 ms"])
    rows.append(["its gradient", slope, ratio(seconds, "slope", "run"), "the run", "3"])
    return rows


BLOCKS = one_run, batch, drawing, gauss_newton, controllers

COMPILE = """
import time, jax, jaxtank, numpy as np
jax.config.update("jax_enable_x64", True)
from jaxtank import presets
from jaxtank.loop import run as loop
case = presets.find("gouta2015/backstepping")
gains = {"controller.k": np.float64(0.03), "controller.k1": np.float64(0.088)}
names = ("rms_error_total",)
values = lambda: loop.evaluate(case.loop, case.clock, names)
slopes = lambda: loop.sensitivities(case.loop, case.clock, names, gains)
for call in (values, slopes):
    began = time.perf_counter()
    jax.block_until_ready(call())
    first = time.perf_counter() - began
    began = time.perf_counter()
    jax.block_until_ready(call())
    print(first - (time.perf_counter() - began))
"""


def cold():
    """Rows of what a first use waits for, each in a process of its own: wall time."""

    def wall(*words):
        times = []
        for _ in range(3):
            began = time.perf_counter()
            subprocess.run([sys.executable, "-m", *words], check=True, capture_output=True)
            times.append(time.perf_counter() - began)
        return f"{statistics.median(times):.2f} s"

    program = [sys.executable, "-c", COMPILE]
    reported = [
        subprocess.run(program, check=True, capture_output=True, text=True).stdout.split()
        for _ in range(3)
    ]
    first = [[float(word) for word in words] for words in reported]
    run, slope = (f"{statistics.median(v):.2f} s" for v in zip(*first))
    simulated, helped = wall("jaxtank", "simulate", "gouta2015/ngpc", "--json"), "`jaxtank --help`"
    words = "`jaxtank simulate gouta2015/ngpc --json`, a new process, wall time"
    slopes = "first call of a gradient with Gauss-Newton, less the second"
    return [
        [words, simulated, "", "", "3.5 s"],
        [helped, wall("jaxtank", "--help"), "", "", "0.3 s"],
        ["first call of a run less the second", run, "", "", "0.5 s"],
        [slopes, slope, "", "", "1.5 s"],
    ]


def main(words):
    jax.config.update("jax_enable_x64", True)
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
    if cores:
        os.sched_setaffinity(0, {max(cores)})  # before jax starts its threads
    rounds = measuring.first_number(words, 15)
    rows = [row for block in BLOCKS for row in block(rounds)]
    if cores:
        os.sched_setaffinity(0, cores)
    rows += cold()
    measuring.report(words, HEADS, rows, BEGIN, END)


if __name__ == "__main__":
    main(sys.argv[1:])

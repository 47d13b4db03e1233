"""The whole tune of two gains, start-up included: `jaxtank tune --nominal` beside the loop written
in C and searched by SciPy, as an engineer would who wants this one answer.

    python tests/benchmarks/whole_tune.py [rounds] [--markdown]

gouta2015/backstepping: the RMS error under the limits on the levels. Each row is a process of its
own: C is compiled and called by ctypes without jax, its derivatives are differences. Core time, the
least of `rounds` (3), in turn.
"""

import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve()
ROOT = HERE.parents[2]
BEGIN, END = "<!-- tests/benchmarks/whole_tune.py -->", "<!-- end of whole_tune -->"
CASE = "gouta2015/backstepping"
METHODS = {
    "slsqp": "C, SciPy SLSQP from the published gains",
    "slsqp 8": "C, SciPy SLSQP from eight starts",
    "nelder-mead": "C, SciPy Nelder-Mead from the published gains",
    "evolution": "C, SciPy differential evolution",
}
PENALTY = 1e3  # cost of a level above its limit, of the methods without constraints [cm/cm]


def write_problem(path):
    """Write what the engineer knows: numbers of the rig, setpoints, ranges and limits."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from jaxtank import presets
    from tuning.problem.problem import Problem

    problem = Problem(presets.find(CASE))
    assert list(problem.objective) == ["rms_error_total"], problem.objective
    plant, controller, clock = problem.loop.plant, problem.loop.controller, problem.clock
    hydraulics = (plant.area, plant.drain[:2], plant.orifice, plant.pump_gain)
    limits = np.full(plant.tanks, np.inf)
    for limit in problem.limits:
        assert limit.measure == "max_level"
        limits[limit.index] = limit.value
    np.savez(
        path,
        numbers=np.concatenate([*hydraulics, [float(plant.gravity), plant.knee]]),
        r=np.ascontiguousarray(np.array(problem.loop.reference.sample(clock)[0])),
        x0=np.array(problem.loop.x0, dtype=float),
        fixed=[float(controller.level_floor), float(problem.loop.actuator.high[0])],
        clock=[clock.samples, clock.dt],
        start=[float(controller.k), float(controller.k1)],
        ranges=[[b.low, b.high] for b in problem.bounds],
        limits=limits,
    )


def search(path, method):
    """Search in this process, without jax, and print the answer."""
    import ctypes

    with np.load(path) as data:
        problem = dict(data)
    with tempfile.TemporaryDirectory() as folder:
        library = f"{folder}/loop.so"
        source = str(ROOT / "tuning" / "bench" / "floor.c")
        words = ["gcc", "-O3", "-march=native", "-shared", "-fPIC", "-o", library, source, "-lm"]
        subprocess.run(words, check=True)
        function = ctypes.CDLL(library).four_tank
    function.restype = ctypes.c_double
    pointer = lambda array: array.ctypes.data_as(ctypes.POINTER(ctypes.c_double))
    floor, high = map(ctypes.c_double, problem["fixed"])
    samples, dt = ctypes.c_long(int(problem["clock"][0])), ctypes.c_double(problem["clock"][1])
    low, span = problem["ranges"][:, 0], np.log(problem["ranges"][:, 1] / problem["ranges"][:, 0])
    limits, result, known = problem["limits"], np.zeros(5), {}

    def run(z):
        """(RMS error, margins of the limits) at z in the unit square, on logarithmic scales."""
        if z.tobytes() not in known:
            k, k1 = map(ctypes.c_double, low * np.exp(np.clip(z, 0.0, 1.0) * span))
            arrays = map(pointer, (problem["x0"], problem["r"], result))
            rms = function(pointer(problem["numbers"]), samples, dt, 1, k, k1, floor, high, *arrays)
            margins = np.minimum(limits - result[1:], 1e3)
            known[z.tobytes()] = (rms if np.isfinite(rms) else 1e3), np.nan_to_num(margins)
        return known[z.tobytes()]

    import scipy.optimize as so

    penalised = lambda z: run(z)[0] + PENALTY * np.maximum(0.0, -run(z)[1]).sum()
    begin = np.log(problem["start"] / low) / span
    box = [(0.0, 1.0)] * 2
    if method.startswith("slsqp"):
        starts = [begin]
        if method.endswith("8"):
            starts += list(np.random.default_rng(0).random((7, 2)))
        held = {"type": "ineq", "fun": lambda z: run(z)[1]}
        ends = [
            so.minimize(
                lambda z: run(z)[0], z, method="SLSQP", bounds=box, constraints=held, tol=1e-10
            ).x
            for z in starts
        ]
        best = min(ends, key=penalised)
    elif method == "nelder-mead":
        words = {"method": "Nelder-Mead", "bounds": box, "options": {"xatol": 1e-7, "fatol": 1e-10}}
        best = so.minimize(penalised, begin, **words).x
    else:
        best = so.differential_evolution(penalised, box, seed=0, tol=1e-8).x
    gains = low * np.exp(np.clip(best, 0.0, 1.0) * span)
    print(*(f"{v:.6g}" for v in (*gains, run(best)[0])), len(known))


def core_seconds(words, **more):
    """(core time [s], output) of a command."""
    left_out = ("JAX", "PYTHONDONTWRITEBYTECODE")
    env = {n: v for n, v in os.environ.items() if not n.startswith(left_out)} | more
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(words, env=env, check=True, capture_output=True, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, done.stdout


def main(words):
    import json

    rounds = next((int(w) for w in words if w.isdigit()), 3)
    times, answers = {}, {}
    for _ in range(rounds):
        with tempfile.TemporaryDirectory() as folder:
            os.chmod(folder, 0o700)
            path, cache = f"{folder}/problem.npz", f"{folder}/cache"
            write_problem(path)
            for method, name in METHODS.items():
                seconds, out = core_seconds([sys.executable, str(HERE), "--search", path, method])
                times.setdefault(name, []).append(seconds)
                answers[name] = out.split()
            ours = [sys.executable, "-m", "jaxtank", "tune", CASE, "--nominal", "--json"]
            for call in ("first", "second"):
                name = f"`jaxtank tune --nominal`, {call} call"
                seconds, out = core_seconds(ours, JAXTANK_CACHE=cache, PYTHONPATH=str(ROOT))
                times.setdefault(name, []).append(seconds)
                result = json.loads(out)
                gains = [p["after"] for p in result["parameters"].values()]
                answers[name] = [f"{v:.6g}" for v in (*gains, result["objective"]["after"])]
                runs = result["evaluations"]
                answers[name].append(f"{runs['simulations']}, {runs['gradients']} with gradients")
    heads = [
        "whole tune of two gains",
        "core time, s",
        "k, 1/s",
        "k1, 1/s",
        "RMS error, cm",
        "runs",
    ]
    rows = [[name, f"{min(t):.2f}", *answers[name]] for name, t in times.items()]
    lines = [f"| {' | '.join(row)} |" for row in (heads, ["---"] * len(heads), *rows)]
    print("\n".join(lines))
    if "--markdown" in words:
        page = HERE.with_name("README.md")
        before, rest = page.read_text().split(BEGIN)
        after = rest.split(END)[1]
        page.write_text(before + "\n".join([BEGIN, *lines, END]) + after)


if __name__ == "__main__":
    if "--search" in sys.argv:
        search(*sys.argv[2:])
    else:
        main(sys.argv[1:])

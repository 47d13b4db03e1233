"""How time grows with the size of a rig: a chain of tanks joined by pipes, one pump under PID.

python tests/benchmarks/large_networks.py [rounds]

For each number of tanks: core time to trace and compile a run and its gradient by two gains, both
without a cache; time of a step for each tank, beside a C loop of the same arithmetic (chain.c) in
the same interleaved rounds; the gradient as a multiple of the run. Then the exponents of growth
from the smallest rig on arrays to the largest, and the command line on a rig file of the largest,
with no kept programs: 2,001 samples, to JSON, and with trajectory, pictures and report.
"""

import ctypes
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np
from measuring import core_times, environment, of_command

import jaxtank
from jaxtank import rig
from jaxtank.case import Case
from jaxtank.controllers import PID
from jaxtank.core.tree import with_values
from jaxtank.instruments import LevelSensor, PumpBank
from jaxtank.loop.closed_loop import ClosedLoop, takes_arrays
from jaxtank.loop.run import evaluate_compiled
from jaxtank.observers import Direct
from jaxtank.plants.network import network
from jaxtank.signals import ramps

jax.config.update("jax_enable_x64", True)

SIZES = (3, 10, 30, 100, 300, 1000)
MEASURES = ("rms_error_total", "max_level")
GAINS = {"controller.Kc": np.array([2.0]), "controller.Ti": np.array([10.0])}
NUMBERS = {"area": 15.0, "drain": 0.05, "last_drain": 0.2, "pipe": 0.3, "pump_gain": 8.0}
OPTIONS = ("-march=native", "-fno-math-errno", "-fno-trapping-math")  # so that roots vectorise
PUMP = {"low": 0.0, "high": 20.0}
CONTROL = {"Kc": 2.0, "Ti": 10.0, "Td": 0.5, "Tt": 10.0, "bias": 0.0}


def chain(tanks):
    """A ClosedLoop of the first tank's level, which its pump holds."""
    drain = np.r_[np.full(tanks - 1, NUMBERS["drain"]), NUMBERS["last_drain"]]
    plant = network(
        area=np.full(tanks, NUMBERS["area"]), drain=drain,
        pipes=[(i, i + 1) for i in range(tanks - 1)], pipe=NUMBERS["pipe"],
        pump_gain=NUMBERS["pump_gain"], feeds=[(0, None)], rim=30.0,
    )  # fmt: skip
    return ClosedLoop(
        plant=plant,
        sensor=LevelSensor(noise=np.zeros(tanks)),
        observer=Direct(),
        controller=PID(model=plant, **{name: [value] for name, value in CONTROL.items()}),
        actuator=PumpBank(**{name: [value] for name, value in PUMP.items()}),
        reference=ramps([10.0], [(20.0, 0, 12.0)], ramp=20.0),
        x0=np.full(tanks, 10.0),
    )


class Chain(ctypes.Structure):
    """The struct `chain` of chain.c."""

    _fields_ = [
        *((name, ctypes.c_long) for name in ("n", "output")),
        *((name, ctypes.c_double) for name in [*NUMBERS, "gravity", "knee", "dt"]),
        *((name, ctypes.c_double) for name in [*PUMP, *CONTROL]),
    ]


def c_runner(library, loop, clock):
    """() -> (rms error [cm], highest levels) of the C loop."""
    plant = loop.plant
    more = {"gravity": float(plant.gravity), "knee": plant.knee, "dt": clock.dt}
    given = Chain(n=plant.tanks, output=0, **NUMBERS, **PUMP, **CONTROL, **more)
    r = np.ascontiguousarray(loop.reference.sample(clock)[0][0])
    pointer = lambda array: array.ctypes.data_as(ctypes.POINTER(ctypes.c_double))

    def run():
        x, top = np.array(loop.x0), np.zeros(plant.tanks)
        samples = ctypes.c_long(clock.samples)
        rms = library.run(ctypes.byref(given), samples, pointer(r), pointer(x), pointer(top))
        return rms, top

    return run


def compiled(function, *args):
    """(compiled program, core time to trace, lower and compile it)."""
    jax.clear_caches()
    began = time.process_time()
    program = jax.jit(function).lower(*args).compile()
    return program, time.process_time() - began


def row(tanks, libraries, rounds):
    """The figures of one size."""
    loop = chain(tanks)
    clock = jaxtank.Clock(dt=0.1, duration=max(20.0, 2e4 / tanks))

    def run(loop, values):
        found = evaluate_compiled.__wrapped__(
            with_values(loop, values), clock, MEASURES, None, False
        )
        return found[0]

    def gradient(loop, values):
        return jax.jacfwd(lambda v: run(loop, v)["rms_error_total"])(values)

    one, to_run = compiled(run, loop, GAINS)
    many, to_derive = compiled(gradient, loop, GAINS)
    calls = {"run": lambda: one(loop, GAINS), "gradient": lambda: many(loop, GAINS)}
    calls |= {name: c_runner(library, loop, clock) for name, library in libraries.items()}
    results = {name: jax.block_until_ready(call()) for name, call in calls.items()}
    seconds = core_times(calls, rounds)
    median = {name: float(np.median(s)) for name, s in seconds.items()}
    each = 1e9 / (clock.samples * tanks)
    top = np.max(np.abs(results["run"]["max_level"] - results["gcc -O3"][1]))
    rms = abs(float(results["run"]["rms_error_total"]) - results["gcc -O3"][0])
    return {
        "form": "arrays" if takes_arrays(loop) else "scalars",
        "compile run": to_run,
        "compile gradient": to_derive,
        "ns": each * median["run"],
        **{name: each * median[name] for name in libraries},
        "times C": median["run"] / min(median[name] for name in libraries),
        "times the run": median["gradient"] / median["run"],
        "difference": max(float(top), rms),
    }


def built(folder):
    """{name: library} of chain.c."""
    found = {}
    for level in ("-O2", "-O3"):
        path = Path(folder, f"chain{level}.so")
        source = Path(__file__).with_name("chain.c")
        command = ["gcc", level, *OPTIONS, "-shared", "-fPIC", "-o", path, source, "-lm"]
        subprocess.run(command, check=True)
        found[f"gcc {level}"] = ctypes.CDLL(str(path))
        found[f"gcc {level}"].run.restype = ctypes.c_double
    return found


def from_file(tanks, folder):
    """{options: (core time, wall time) of `jaxtank simulate` of a rig file of so many tanks}."""
    clock = jaxtank.Clock(dt=0.1, duration=200.0)
    names = {"name": "chain", "title": "a chain of tanks"}
    case = Case(**names, loop=chain(tanks), clock=clock, limits={}, free={}, objective={})
    Path(folder, "chain.toml").write_text(rig.dump(case))
    found = {}
    for options in ("--json", "--out run"):
        words = [sys.executable, "-m", "jaxtank", "simulate", "chain.toml", *options.split()]
        began, env = time.perf_counter(), environment(JAXTANK_CACHE="0")
        core, _ = of_command(words, cwd=folder, env=env)
        found[options] = core, time.perf_counter() - began
    return found


def main(rounds=9):
    """Print the table."""
    with tempfile.TemporaryDirectory() as folder:
        libraries = built(folder)
        rows = {n: row(n, libraries, rounds) for n in SIZES}
        commands = from_file(SIZES[-1], folder)
    names = ["compile run", "compile gradient", "ns", *libraries, "times C", "times the run"]
    units = ["s", "s", *["ns"] * (1 + len(libraries)), "", ""]
    print("| tanks | form |", " | ".join(names), "|")
    print("|---" * (2 + len(names)) + "|")
    for n, found in rows.items():
        cells = [f"{found[name]:.3g} {unit}".strip() for name, unit in zip(names, units)]
        print(f"| {n} | {found['form']} |", " | ".join(cells), "|")
    on_arrays = [n for n in SIZES if rows[n]["form"] == "arrays"]
    first, last = on_arrays[0], on_arrays[-1]
    grown = {
        name: np.log(rows[last][name] / rows[first][name]) / np.log(last / first)
        for name in ("compile run", "compile gradient")
    }
    grown["time of a step"] = 1.0 + np.log(rows[last]["ns"] / rows[first]["ns"]) / np.log(
        last / first
    )
    print(f"\nexponents of growth from {first} to {last} tanks:", end=" ")
    print(", ".join(f"{name} {value:.2f}" for name, value in grown.items()))
    print(f"largest difference to C: {max(r['difference'] for r in rows.values()):.1e} cm")
    for options, (core, wall) in commands.items():
        print(f"simulate {SIZES[-1]} tanks {options}: {core:.1f} core-seconds, {wall:.1f} s")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))

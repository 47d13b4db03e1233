"""Ensembles: what many draws cost, and what a second device gives.

    python tests/benchmarks/ensemble.py [--rounds 3]

Also the C loop in vector lanes for `speed.py`: floor_lanes.c (gcc -O3 -march=native
-mprefer-vector-width=512, no -ffast-math) on the same plants, one core.
"""

import argparse
import ctypes
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
from measuring import core_times

import tuning
from jaxtank import presets, rig
from tuning.uncertainty.draws import Draws
from tuning.uncertainty.sampling import probabilities, spread_of

SOURCE = Path(__file__).with_name("floor_lanes.c")
FLAGS = ["-O3", "-march=native", "-mprefer-vector-width=512", "-fno-math-errno"]
FLAGS += ["-fno-trapping-math", "-shared", "-fPIC"]
BLOCK = 32  # lanes that the C loop holds in registers and L1; 8 to 64 differ by a tenth
NAMES = ("rms_error_total", "max_level")


def draw(case, samples, **options):
    """The ensemble that is timed: error and highest levels, no fan."""
    return tuning.ensemble(case, samples=samples, measures=NAMES, fan=False, **options)


# the same source in float32, its sums not compensated
SINGLE = ("-DSINGLE", "-fsingle-precision-constant")


def c_batch(folder, single=False):
    """The C loop of floor_lanes.c, None where there is no gcc."""
    if shutil.which("gcc") is None:
        return None
    library = str(Path(folder) / "lanes.so")
    flags = [*FLAGS, *(SINGLE if single else ()), f"-DLANES={BLOCK}"]
    command = ["gcc", *flags, "-o", library, str(SOURCE), "-lm"]
    subprocess.run(command, check=True, capture_output=True)
    function = ctypes.CDLL(library).four_tanks
    function.restype = None
    return function


def c_run(function, case, samples, single=False):
    """A call of the C loop on the plants that `draw` draws: () -> (total rms error (samples,),
    highest levels (samples, 4)) [cm].
    """
    plant, controller, clock = case.loop.plant, case.loop.controller, case.clock
    space = Draws(case.loop, spread_of(case))
    v = space.values(probabilities("random", space.dimensions, samples, 0))
    rows = np.concatenate([v["plant.drain"][:, :2].T, v["plant.orifice"].T, v["plant.pump_gain"].T])
    real, c_real = (np.float32, ctypes.c_float) if single else (np.float64, ctypes.c_double)
    rows = np.ascontiguousarray(
        np.pad(rows, ((0, 0), (0, -samples % BLOCK)), mode="edge"), dtype=real
    )
    model = controller.model
    area, drain, orifice, gain = (
        np.array(x, dtype=float) for x in (model.area, model.drain, model.orifice, model.pump_gain)
    )
    w = float(2.0 * model.gravity) ** 0.5
    out = (
        np.array([drain[0], orifice[0], orifice[2], drain[1], orifice[1], orifice[3]])
        * w
        / area[[0, 0, 0, 1, 1, 1]]
    )
    upper = [
        orifice[:2].sum() * w / area[2],
        gain[0] / area[2],
        orifice[2:].sum() * w / area[3],
        gain[1] / area[3],
    ]
    nominal, own = np.concatenate([out, upper]).astype(real), np.array(plant.area, dtype=real)
    r, x0 = (
        np.array(case.loop.reference.sample(clock)[0], dtype=real),
        np.array(case.loop.x0, dtype=real),
    )
    found = np.zeros((rows.shape[1], 5), dtype=real)

    def at(array):
        return array.ctypes.data_as(ctypes.POINTER(c_real))

    scalars = [
        c_real(float(x))
        for x in (
            *(plant.gravity, plant.knee, clock.dt, controller.k, controller.k1),
            *(controller.level_floor, case.loop.actuator.high[0]),
        )
    ]
    gravity, knee, dt, *rest = scalars

    def run():
        function(
            ctypes.c_long(rows.shape[1]), at(rows), at(own), gravity, knee, at(nominal),
            ctypes.c_long(clock.samples), dt,
            int(clock.integrator == "rk4"), *rest, at(x0), at(r), at(found),
        )  # fmt: skip
        return np.sqrt(found[:samples, 0] / clock.samples), found[:samples, 1:]

    return run


def beside_batch(function, case, samples, rounds, single=False):
    """(ns per step and plant of ours, of the C loop, ratio, largest difference [cm]): medians of
    core time, the two in turn.
    """
    ours, theirs = (lambda: draw(case, samples)), c_run(function, case, samples, single)
    measures, (rms, top) = ours().measures, theirs()
    apart = abs(rms - measures["rms_error_total"]).max()
    apart = max(apart, abs(top - measures["max_level"]).max())
    times = core_times({"ours": ours, "theirs": theirs}, rounds)
    steps = samples * case.clock.samples
    a, b = (1e9 * statistics.median(spent) / steps for spent in times.values())
    return a, b, statistics.median(p / q for p, q in zip(*times.values())), apart


CHILD = """
import sys, jax, tuning, time
devices, samples, dt = int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", devices)
from jaxtank import presets, rig
case = rig.set_values(presets.find("gouta2015/backstepping"), {"clock.dt": dt})
names = ("rms_error_total", "max_level")
run = lambda n: tuning.ensemble(case, samples=n, measures=names, fan=False, devices=devices)
run(512)
began = time.perf_counter()
run(samples)
print(time.perf_counter() - began)
"""


def child(devices, samples, dt):
    """Wall time [s] of an ensemble in a process of its own."""
    words = [sys.executable, "-c", CHILD, str(devices), str(samples), str(dt)]
    return float(subprocess.run(words, capture_output=True, text=True, check=True).stdout)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=3)
    rounds = parser.parse_args().rounds
    jax.config.update("jax_enable_x64", True)
    coarse = rig.set_values(presets.find("gouta2015/backstepping"), {"clock.dt": 0.1})
    for words, values in (("RK4", {}), ("midpoint", {"clock.integrator": "midpoint"})):
        case = rig.set_values(coarse, values)
        draw(case, 1024)
        began = time.process_time()
        draw(case, 10_000)
        spent = time.process_time() - began
        print(f"10,000 plants x {case.clock.samples} samples, {words}: {spent:.2f} core-seconds")
    one, two = (np.median([child(n, 4096, 0.1) for _ in range(rounds)]) for n in (1, 2))
    print(f"4,096 plants: one device {one:.2f} s, two devices {two:.2f} s, {one / two:.2f} times")


if __name__ == "__main__":
    main()

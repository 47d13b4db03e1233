"""Probabilities of rare failures by `tuning.ensemble(promise=)` beside brute force.

python tests/audits/rare_events.py            both, for every case (some ten minutes on two cores)
python tests/audits/rare_events.py --quick    the estimates alone
"""

import sys
import time
from pathlib import Path

import jax
import numpy as np

import jaxtank
import tuning
from jaxtank import rig
from jaxtank.limits import resolve_limits
from tuning.uncertainty.draws import Draws

RIGS = Path(__file__).parents[1] / "data" / "rigs"

BLOCK = 1 << 16
Normal, Uniform = tuning.Normal, tuning.Uniform


def overflow():
    """A tank overflows, which shows no slope below its rim; normal distributions."""
    case = rig.load(RIGS / "two_tanks.toml")
    values = {"reference.targets": [5.0, 3.0], "clock.duration": 300.0}
    names = ("plant.drain", "plant.orifice", "plant.pump_gain")
    spread = {n: Normal(relative=0.05, cut=7.0) for n in names}
    return rig.set_values(case, values), spread, None, 10**6


def two_limits():
    """Corners of a box of six coefficients, in two tanks."""
    case = rig.set_values(rig.load(RIGS / "quadruple_tank.toml"), {"clock.duration": 400.0})
    names = ("plant.drain", "plant.pump_gain", "plant.split")
    limits = {"max_level": [14.31, 13.2, 20.0, 20.0]}
    return case, {n: Uniform(relative=0.05) for n in names}, limits, 10**6


def identified():
    """An error limit with the noise of the readings; a covariance block."""
    values = {"clock.duration": 200.0, "sensor.noise": 0.02}
    case = rig.set_values(rig.load(RIGS / "quadruple_tank.toml"), values)
    names = tuple(f"plant.{n}[{i}]" for n in ("drain", "orifice", "pump_gain") for i in (0, 1))
    sd = 0.03 * np.array([0.071, 0.057, 0.071, 0.057, 3.33, 3.35])
    matrix = np.outer(sd, sd) * (0.5 * np.eye(6) + 0.5)
    block = tuning.Correlated(names=names, covariance=tuple(map(tuple, matrix)), cut=5.0)
    return case, {"identified": block}, {"rms_error_total": 0.475}, 4 * 10**6


def brute_force(case, distributions, limits, runs):
    """(probability, its standard deviation) of independent draws."""
    space, rng, broken = Draws(case.loop, distributions), np.random.default_rng(1), 0
    limits = resolve_limits(case, limits)
    names = list(dict.fromkeys(limit.measure for limit in limits))
    noisy = np.any(np.asarray(case.loop.sensor.noise) > 0)
    for k in range(-(-runs // BLOCK)):
        values = space.values(rng.random((BLOCK, space.dimensions)))
        key = jax.random.key(1000 + k) if noisy else None
        measures = jaxtank.evaluate_many(case.loop, case.clock, names, values, key)
        columns = [np.reshape(measures[v.measure], (BLOCK, -1))[:, v.index] for v in limits]
        margins = np.array([v.margins(column) for v, column in zip(limits, columns)])
        broken += int(np.sum(np.min(margins, axis=0) < 0))
    total = BLOCK * -(-runs // BLOCK)
    return broken / total, np.sqrt(broken) / total


def main(quick):
    for make in (overflow, two_limits, identified):
        case, distributions, limits, runs = make()
        began = time.perf_counter()
        ensemble = tuning.ensemble(
            case, distributions, limits=limits, promise=1e-3, fan=False, measures=["max_level"]
        )
        p = ensemble.promise
        low, high = p.interval95
        print(
            f"{make.__name__}: {p.answer}, {p.probability:.3g} ({low:.3g} to {high:.3g}),"
            f" {p.runs} runs, {time.perf_counter() - began:.1f} s",
            flush=True,
        )
        if not quick:
            began = time.perf_counter()
            exact, sd = brute_force(case, distributions, limits, runs)
            print(
                f"  brute force: {exact:.3g} +- {sd:.2g} of {runs} runs,"
                f" {time.perf_counter() - began:.0f} s; ratio {p.probability / exact:.3f}, runs"
                f" {runs / p.runs:.0f} times fewer",
                flush=True,
            )


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main("--quick" in sys.argv)

"""Many runs by one `jax.vmap` and by `evaluate_many`, and what `evaluate` costs around a short run.

    python tests/benchmarks/many_runs.py [rounds]

Core time of the second and later calls, the least of `rounds` (3): the four-tank under backstepping
with samples of 1 s, and the 701 samples of cascaded/pi.
"""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np
from measuring import core_times, first_number

import jaxtank
from jaxtank import presets
from jaxtank.loop import validation
from jaxtank.loop.run import evaluate_compiled
from tuning.report import tables

NAMES = ("rms_error_total", "max_level")


def least(call, rounds, calls=1):
    """Least core time of a call [s]."""
    return min(core_times({"": call}, rounds, calls)[""])


def many(rounds):
    """Rows of 256 to 65,536 runs: ns per step and run."""
    case = presets.find("gouta2015/backstepping")
    clock = dataclasses.replace(case.clock, dt=1.0)

    def run(k1):
        loop = jaxtank.with_values(case.loop, {"controller.k1": k1})
        return jaxtank.evaluate(loop, clock, NAMES)

    one, rows = jax.jit(jax.vmap(run)), []
    for count in (256, 4096, 65536):
        k1 = jnp.linspace(0.05, 0.15, count)
        batches = lambda k1=k1: jaxtank.evaluate_many(
            case.loop, clock, NAMES, {"controller.k1": k1}
        )
        spent = [least(lambda k1=k1: one(k1), rounds), least(batches, rounds)]
        per = [1e9 * s / (count * clock.samples) for s in spent]
        rows.append([f"{count:,}", *(f"{ns:.3g}" for ns in per), f"{per[0] / per[1]:.2f}"])
    return rows


def short(rounds):
    """Rows of one short run: ms of a call."""
    case = presets.find("cascaded/pi")
    loop, clock = case.loop, case.clock
    gains = iter(np.linspace(0.5, 1.5, 10_000))

    def forgotten():
        validation._PASSED.clear()
        jaxtank.check(loop, clock)

    def other():
        return jaxtank.evaluate(
            jaxtank.with_values(loop, {"controller.Kc": next(gains)}), clock, NAMES
        )

    calls = {
        "the compiled run": lambda: evaluate_compiled(loop, clock, NAMES, None, False),
        "evaluate": lambda: jaxtank.evaluate(loop, clock, NAMES),
        "evaluate, another gain each time": other,
        "check": lambda: jaxtank.check(loop, clock),
        "check, nothing remembered": forgotten,
    }
    return [[name, f"{1e3 * least(call, rounds, 200):.3f}"] for name, call in calls.items()]


def main(words):
    jax.config.update("jax_enable_x64", True)
    rounds = first_number(words, 3)
    heads = ["runs", "one jax.vmap, ns per step and run", "evaluate_many, ns", "ratio"]
    print(tables.table(many(rounds), heads))
    print(tables.table(short(rounds), ["701 samples", "ms a call"]))


if __name__ == "__main__":
    main(sys.argv[1:])

"""Derivatives with respect to many parameters at once: forward mode, a Gauss-Newton pass, reverse.

    python tests/benchmarks/many_parameters.py [rounds]

Core time of second calls over that of a run, the least of `rounds` (3): five measures of the
four-tank under backstepping with samples of 0.1 s, with respect to its two gains, then to the
parameters of its plant, then to all others. Then a search of a gain scheduled at sixty knots, with
the Gauss-Newton matrix and by reverse mode (`pip install ".[bench]"`).
"""

import dataclasses
import sys
import time

import jax
import numpy as np
from many_runs import least
from measuring import first_number

import jaxtank
import tuning
from jaxtank import presets
from jaxtank.core.tree import parameters, with_values
from jaxtank.loop.derivatives import sensitivities_compiled
from jaxtank.loop.run import evaluate_for_reverse
from tuning.problem import problem
from tuning.report import tables

NAMES = ("rms_error_total", "max_level", "min_level", "rms_input", "input_travel")
SQUARES = (("mean_square_error", 1.0),)
COUNTS = (8, 24, 30, 40, 50, 60, 70)


def chosen(loop, count):
    """Return {name: value} of about `count` numbers, gains first, and how many there are."""
    every = parameters(loop)
    order = ["controller.k", "controller.k1"]
    order += sorted((n for n in every if n not in order), key=lambda n: not n.startswith("plant."))
    found, size = {}, 0
    for name in order:
        value = np.asarray(every[name])
        finite = value.dtype == float and value.size and np.isfinite(value).all()
        if finite and size + value.size <= count:
            found[name], size = value, size + value.size
    return found, size


def rows(rounds):
    """Rows of numbers of parameters: multiples of a run."""
    case = presets.find("gouta2015/backstepping")
    loop, clock = case.loop, dataclasses.replace(case.clock, dt=0.1)
    run = jax.jit(lambda k: jaxtank.evaluate(with_values(loop, {"controller.k": k}), clock, NAMES))
    once = least(lambda: run(loop.controller.k), rounds, 50)
    reverse = jax.jit(
        jax.jacrev(lambda v: evaluate_for_reverse(with_values(loop, v), clock, NAMES))
    )
    found = []
    for count in COUNTS:
        values, size = chosen(loop, count)

        def slopes(squares, values=values):
            names, leaves = tuple(values), tuple(values.values())
            return sensitivities_compiled(loop, clock, NAMES, names, leaves, None, squares)

        calls = (lambda: slopes(()), lambda: slopes(SQUARES), lambda v=values: reverse(v))
        found.append([str(size), *(f"{least(c, rounds, 10) / once:.1f}" for c in calls)])
    return found


def searches(knots=60):
    """Rows of two searches of a schedule: method, passes with derivatives, cost, core time [s]."""
    from optimisers import twenty_values

    asked = twenty_values(knots)
    options = {"objective": dict(asked.objective), "limits": {}}
    found = []
    for limit in (knots, knots - 1):
        jax.clear_caches()
        problem.FORWARD_LIMIT, began = limit, time.process_time()
        result = tuning.tune(
            asked.case, tuning.Options(starts=1, validation=0), nominal=True, **options
        )
        took = time.process_time() - began
        counts, cost = result.evaluations, result.objective["after"]
        found.append([result.method, f"{counts['gradients']}", f"{cost:.6g}", f"{took:.0f} s"])
    return found


def main(words):
    jax.config.update("jax_enable_x64", True)
    rounds = first_number(words, 3)
    heads = ["parameters", "forward, runs", "Gauss-Newton pass, runs", "reverse, runs"]
    print(tables.table(rows(rounds), heads))
    print(tables.table(searches(), ["60 gains", "passes", "cost", "core time"]))


if __name__ == "__main__":
    main(sys.argv[1:])

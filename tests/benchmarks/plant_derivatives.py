"""Derivatives of 32 plants side by side: the pass of the default answer, beside the run of them.

    python tests/benchmarks/plant_derivatives.py [rounds] [--other TREE] [--only CASE ...]

Core time a plant and step of a second pass (cost, gradient and Gauss-Newton matrix with respect to
the gains of the case, noise drawn before): the least of `rounds` (5); its ratio to the run of the
same plants; and core time of the first pass, which compiles. TREE: a checkout of another version,
which runs in a process of its own. Programs are not kept.
"""

import argparse
import json
import os
import subprocess
import sys
import time

import jax

from jaxtank import presets
from tuning.problem.problem import Problem
from tuning.report import tables
from tuning.search.setting import PLANTS, setting_of

CASES = (
    *("gouta2015/backstepping", "cascaded/pi", "calofir/backstepping", "gouta2022/chadpc"),
    *("gouta2022/pi", "mirakhorli/sfc", "mirakhorli/lqi", "gouta2022/fopi"),
    *("khalid/gpc", "khalid/laguerre", "khalid/laguerre-mimo"),
)
HEADS = ("case", "gains", "a plant and step", "times its run", "first pass")


def core_seconds(call):
    """Core time of a call [s]."""
    began = time.process_time()
    call()
    return time.process_time() - began


def measure(name, rounds):
    """[number of gains, ns a plant and step, ratio to the run, first pass [s]] of a case."""
    setting = setting_of(presets.find(name))
    case = setting.searched
    plants = setting.plants(case, PLANTS, 0)
    problem = Problem(case, None, setting.objective, {}, plants, 0, draw_noise=True)
    z = problem.start()
    first = core_seconds(lambda: problem.point(z))
    problem.screen(z[None])
    passes = [core_seconds(lambda: problem.point(z)) for _ in range(rounds)]
    runs = [core_seconds(lambda: problem.screen(z[None])) for _ in range(rounds)]
    steps = PLANTS * problem.clock.samples
    return [len(z), 1e9 * min(passes) / steps, min(passes) / min(runs), first]


def elsewhere(tree, rounds, names):
    """`measure` of each case by the packages in another tree."""
    words = [sys.executable, __file__, str(rounds), "--json", "--only", *names]
    environment = {**os.environ, "PYTHONPATH": tree}
    done = subprocess.run(words, env=environment, check=True, capture_output=True, text=True)
    return json.loads(done.stdout)


def main():
    """Print a row for each case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rounds", nargs="?", type=int, default=5)
    parser.add_argument("--other", metavar="TREE")
    parser.add_argument("--only", nargs="+", default=CASES)
    parser.add_argument("--json", action="store_true", help="numbers alone")
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    numbers = {name: measure(name, asked.rounds) for name in asked.only}
    if asked.json:
        print(json.dumps(numbers))
        return
    other = elsewhere(asked.other, asked.rounds, asked.only) if asked.other else {}
    words = lambda ns, ratio, first: [f"{ns:,.0f} ns", f"{ratio:.1f}", f"{first:.1f} s"]
    rows = [
        [name, str(int(count)), *words(*rest), *(words(*other[name][1:]) if other else [])]
        for name, (count, *rest) in numbers.items()
    ]
    heads = [*HEADS, *(f"{head}, other" for head in HEADS[2:] if other)]
    print(tables.table(rows, heads))


if __name__ == "__main__":
    main()

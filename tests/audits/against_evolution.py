"""`tune --starts 1` on six textbook loops, beside SciPy's differential evolution of many runs.

    python tests/audits/against_evolution.py [--seeds 10] [--problems N] [--markdown]

Prints, for each loop, the optimum of differential evolution (the best of three seeds), and the
objective that one start reaches with each seed. An answer agrees if it is at most 0.1 % above.
"""

import argparse
import re
import sys
from pathlib import Path

import jax
import numpy as np
import scipy.optimize

import tuning
from jaxtank import presets, rig
from jaxtank.core.files import write_atomic

RIGS = Path(__file__).parents[1] / "data" / "rigs"
README = Path(__file__).parents[1] / "benchmarks" / "README.md"
BEGIN, END = "<!-- tests/audits/against_evolution.py -->", "<!-- end of against_evolution -->"
AGREES = 1e-3
CROSS = {  # the other pairing, where it belongs: in the non-minimum-phase setting P+
    "split = 0.7": "split = 0.43",
    "split = 0.6": "split = 0.34",
    "outputs = [1, 2]": "outputs = [2, 1]",
    "initial = [12.4, 12.7]": "initial = [12.7, 12.4]",
}


def crossed():
    """The quadruple tank in its setting P+, each pump controlling the level opposite."""
    text = (RIGS / "quadruple_tank.toml").read_text()
    for old, new in CROSS.items():
        assert old in text
        text = text.replace(old, new)
    return rig.loads(text)


PROBLEMS = {
    "water tank": lambda: rig.load(RIGS / "watertank.toml"),
    "tanks in series": lambda: rig.load(RIGS / "tanks_in_series.toml"),
    "three coupled tanks": lambda: rig.load(RIGS / "three_coupled_tanks.toml"),
    "quadruple tank, direct pairing": lambda: rig.load(RIGS / "quadruple_tank.toml"),
    "quadruple tank, crossed pairing": crossed,
    "cascaded PI": lambda: presets.find("cascaded/pi"),
}


def evolved(case, seeds=3, generations=300):
    """The least objective that scipy's differential evolution finds within the limits, and where.

    A point that violates a limit is worse than any that does not, and better the less it does.
    """
    problem = tuning.Problem(case)

    def merits(zs):
        costs, margins = problem.screen(zs.T)
        short = np.maximum(0.0, -margins / problem.limit_scales).max(axis=1, initial=0.0)
        return np.nan_to_num(np.where(short > 0, 1e9 * (1 + short), costs), nan=1e12)

    size = len(problem.bounds)
    found = [
        scipy.optimize.differential_evolution(
            merits,
            [(0.0, 1.0)] * size,
            rng=seed,
            popsize=64 // size,
            maxiter=generations,
            tol=1e-10,
            vectorized=True,
            updating="deferred",
            polish=False,
        )
        for seed in range(seeds)
    ]
    best = min(found, key=lambda f: f.fun)
    return float(best.fun), problem.values(best.x)


def tuned(case, seed):
    """The TuningResult of one start."""
    return tuning.tune(case, tuning.Options(starts=1, validation=0), nominal=True, seed=seed)


def main(words=None):
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--problems", default="")
    parser.add_argument("--markdown", action="store_true")
    args = parser.parse_args(words)
    rows, wrong = [], 0
    for name, make in PROBLEMS.items():
        if args.problems not in name:
            continue
        case = make()
        least, _ = evolved(case)
        results = [tuned(case, seed) for seed in range(args.seeds)]
        ours = np.array([r.objective["after"] for r in results])
        held = [all(c.margin >= 0 for c in r.constraints) for r in results]
        agree = (ours <= least * (1 + AGREES)) & np.array(held)
        wrong += int((~agree).sum())
        done = sum(r.success for r in results)
        runs = int(np.median([r.evaluations["simulations"] for r in results]))
        rows.append(
            [name, f"{least:.6g}", f"{ours.min():.6g} to {ours.max():.6g}"]
            + [f"{agree.sum()} of {len(ours)}", f"{done} of {len(ours)}", f"{runs}"]
        )
        print(" | ".join(rows[-1]), flush=True)
        for seed in np.flatnonzero(~agree):
            print(f"  seed {seed}: {ours[seed]:.8g}, {results[seed].status}", flush=True)
    heads = [
        "loop",
        "differential evolution",
        f"one start, {args.seeds} seeds",
        "within 0.1 %",
        "converged",
    ]
    heads += ["runs (median)"]
    if args.markdown:
        lines = ["|" + "|".join(f" {c} " for c in row) + "|" for row in (heads, *rows)]
        lines.insert(1, "|---" * len(heads) + "|")
        text, table = README.read_text(), "\n".join(lines)
        new = re.sub(f"{BEGIN}.*?{END}", f"{BEGIN}\n{table}\n{END}", text, flags=re.DOTALL)
        write_atomic(README, new)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())

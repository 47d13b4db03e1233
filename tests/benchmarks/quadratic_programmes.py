"""Core time of quadratic programmes above 40 variables, beside LAPACK's Cholesky in their place.

python tests/benchmarks/quadratic_programmes.py    # two minutes; with nothing else on the machine
"""

import jax
import numpy as np
from measuring import core_times

from jaxtank.analysis import elimination, qp

jax.config.update("jax_enable_x64", True)
SIZES, BATCHES, ROUNDS, CALLS = (48, 60, 100), 16, 5, 4


def programme(n):
    """(H, f, G, l, u) of a predictive controller: n increments, limits on them and their sums."""
    response = 1.0 - 0.95 ** np.arange(1, 2 * n + 1)
    ahead = np.array([[response[i - j] if i >= j else 0.0 for j in range(n)] for i in range(2 * n)])
    H, f = 2.0 * (ahead.T @ ahead + 0.05 * np.eye(n)), -2.0 * ahead.sum(axis=0)
    G = np.concatenate([np.eye(n), np.tril(np.ones((n, n)))])
    low, high = (
        np.concatenate([np.full(n, a), np.full(n, b)]) for a, b in ((-0.1, -0.3), (0.1, 0.7))
    )
    return H, f, G, low, high


def core_us(n, batch, slope):
    """Core time [us] of one programme of a call, the least of ROUNDS."""
    H, f, G, low, high = programme(n)
    one = lambda e: qp.solve(H, e * f, G, low, high)
    one = jax.jacfwd(one) if slope else one
    run = jax.jit(jax.vmap(one) if batch > 1 else one)
    size = np.linspace(0.05, 0.5, batch) if batch > 1 else 0.3
    return 1e6 * min(core_times({"": lambda: run(size)}, ROUNDS, CALLS)[""]) / batch


def main():
    names = ("_cholesky", "_cholesky_solve", "weighted_squares")
    ours = [getattr(elimination, name) for name in names]
    lapack = (
        lambda A: jax.scipy.linalg.cholesky(A),
        lambda U, b: jax.scipy.linalg.cho_solve((U, False), b),
        lambda G, weight: (G.T * weight) @ G,
    )
    print("variables  lanes  what   ours us  LAPACK us")
    for n in SIZES:
        for batch in (1, BATCHES):
            for slope in (False, True):
                times = []
                for functions in (ours, lapack):
                    for name, function in zip(names, functions):
                        setattr(elimination, name, function)
                    times.append(core_us(n, batch, slope))
                what = "slope" if slope else "run"
                print(f"{n:9d}  {batch:5d}  {what:5}  {times[0]:7.0f}  {times[1]:9.0f}", flush=True)


if __name__ == "__main__":
    main()

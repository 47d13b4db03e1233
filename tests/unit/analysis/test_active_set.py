"""The programme with soft limits: against SciPy, and its slopes against central differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from jaxtank.analysis.active_set import solve_soft

N, K, SAMPLES, SPAN = 6, 2, 5, 1000.0


def programme(seed):
    """Random arguments of `solve_soft`, with limits tight enough for many rows to bind."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(8, N))
    ends = -rng.uniform(0, 1, N), rng.uniform(0, 1, N)
    rows = rng.normal(size=(SAMPLES, K, N)), rng.uniform(-0.3, 0.5, size=(SAMPLES, K))
    H, f = root.T @ root + 0.01 * np.eye(N), 3 * rng.normal(size=N)
    return H, f, np.eye(N), *ends, *rows, 10.0 ** rng.uniform(-1, 2)


solve = jax.jit(lambda *data: jnp.concatenate(solve_soft(*data, SPAN)))


def reference(H, f, A, l, u, G, room, penalty):
    """The same by SLSQP, and how many limits are given up."""
    price = lambda s: penalty * np.sum(s + 50.0 * s**2 / SPAN)
    cost = lambda z: 0.5 * z[:N] @ H @ z[:N] + f @ z[:N] + price(z[N:])
    slope = lambda z: np.concatenate([H @ z[:N] + f, penalty * (1.0 + 100.0 * z[N:] / SPAN)])
    rows = np.concatenate([-G, np.broadcast_to(np.eye(K), (SAMPLES, K, K))], axis=2)
    limits = {"type": "ineq", "fun": lambda z: np.ravel(room + z[N:] - G @ z[:N])}
    return minimize(
        cost,
        np.zeros(N + K),
        jac=slope,
        bounds=[*zip(l, u), *[(0.0, None)] * K],
        constraints=limits | {"jac": lambda _: rows.reshape(-1, N + K)},
        options={"ftol": 1e-15, "maxiter": 500},
    ).x


@pytest.mark.extended_for("0")
@pytest.mark.parametrize("seed", range(8))
def test_the_minimum_is_that_of_another_solver(seed):
    data = programme(seed)
    np.testing.assert_allclose(solve(*data), reference(*data), atol=2e-6)


@pytest.mark.extended_for("0")
@pytest.mark.parametrize("seed", range(4))
def test_slopes_are_those_of_differences(seed):
    data = programme(seed)
    rng = np.random.default_rng(100 + seed)
    along = [rng.normal(size=np.shape(v)) for v in data]
    along[0], along[2] = along[0] + along[0].T, 0.0 * along[2]
    moved = lambda h: solve(*(v + h * w for v, w in zip(data, along)))
    exact = jax.jvp(moved, (0.0,), (1.0,))[1]
    np.testing.assert_allclose(exact, (moved(1e-5) - moved(-1e-5)) / 2e-5, atol=1e-6)


@pytest.mark.parametrize("which", range(8))
def test_reverse_mode_by_one_argument_alone_is_forward_mode(which):
    data = list(map(jnp.asarray, programme(7)))
    of_one = lambda v: solve(*data[:which], v, *data[which + 1 :])
    backward, forward = (mode(of_one)(data[which]) for mode in (jax.jacrev, jax.jacfwd))
    assert np.any(forward)
    np.testing.assert_allclose(backward, forward, rtol=1e-9, atol=1e-12)

"""Riccati and Lyapunov equations, and small systems, against SciPy; derivatives by differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import python
from scipy import linalg

import jaxtank
from jaxtank import Clock, presets
from jaxtank.analysis import elimination
from jaxtank.analysis.riccati import (
    discrete_lyapunov,
    discrete_riccati,
    lqr,
    lyapunov,
    matrix_exponential,
    riccati,
    zero_order_hold,
)

RICCATI, LQR, DISCRETE_RICCATI = jax.jit(riccati), jax.jit(lqr), jax.jit(discrete_riccati)
QUADRUPLE = (  # mirakhorli at 12/12: mirakhorli notes S2.3
    np.array(
        [
            [-0.0231362, 0, 0.0525823, 0],
            [0, -0.0231362, 0, 0.0299175],
            [0, 0, -0.0525823, 0],
            [0, 0, 0, -0.0299175],
        ]
    ),
    np.array([[0.0829417, 0], [0, 0.0478546], [0, 0.0928942], [0.1145385, 0]]),
)


def system(seed, n=5, m=2):
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, m))
    q, r = rng.normal(size=(n, n)), rng.normal(size=(m, m))
    return A, B, q @ q.T, r @ r.T + 0.3 * np.eye(m)


def augmented(weight=1e-3):
    """The quadruple tank with an integrator of each error: its open loop has two poles at 0."""
    A, B = np.zeros((6, 6)), np.zeros((6, 2))
    A[:4, :4], B[:4] = QUADRUPLE
    A[4, 0] = A[5, 1] = 1.0
    return A, B, np.diag([1.0, 1, 0, 0, weight, weight]), 3.0 * np.eye(2)


CONTINUOUS = [
    system(0),
    system(1),
    system(2, n=8, m=1),
    (*QUADRUPLE, np.diag([1.0, 1, 0, 0]), 3 * np.eye(2)),
    augmented(),
    augmented(1e-8),
]


@pytest.mark.slow_for("1", "2", "3", "5", "4")
@pytest.mark.parametrize("case", CONTINUOUS, ids=range(len(CONTINUOUS)))
def test_riccati_against_scipy(case):
    A, B, Q, R = case
    P = linalg.solve_continuous_are(A, B, Q, R)
    np.testing.assert_allclose(RICCATI(*case), P, rtol=1e-8, atol=1e-9 * np.abs(P).max())
    K = LQR(*case)
    np.testing.assert_allclose(K, np.linalg.solve(R, B.T @ P), rtol=1e-7, atol=1e-9)
    assert np.all(np.linalg.eigvals(A - B @ K).real < 0)


DISCRETE = [
    system(3),
    (np.zeros((3, 3)), *system(4, n=3)[1:]),  # nothing carried over: P = Q
    (0.98 * linalg.orth(system(5)[0]), *system(6)[1:]),
    tuple(
        np.asarray(a)
        for a in (*zero_order_hold(*QUADRUPLE, 0.1), np.diag([1.0, 1, 0, 0]), 3 * np.eye(2))
    ),
    # a random walk in little noise: closed-loop poles at 0.999
    (np.eye(2), np.eye(2), 1e-6 * np.eye(2), np.eye(2)),
]


@pytest.mark.extended_for("3", "4")
@pytest.mark.slow_for("1", "2")
@pytest.mark.parametrize("case", DISCRETE, ids=range(len(DISCRETE)))
def test_discrete_riccati_against_scipy(case):
    P = linalg.solve_discrete_are(*case)
    np.testing.assert_allclose(DISCRETE_RICCATI(*case), P, rtol=1e-8, atol=1e-9 * np.abs(P).max())


def test_lyapunov_against_scipy():
    A, _, Q, _ = system(7)
    A = A / np.abs(np.linalg.eigvals(A)).max() - 1.01 * np.eye(len(A))  # stable
    np.testing.assert_allclose(
        lyapunov(A, Q), linalg.solve_continuous_lyapunov(A, -Q), rtol=1e-9, atol=1e-11
    )
    np.testing.assert_allclose(
        discrete_lyapunov(0.4 * A, Q),
        linalg.solve_discrete_lyapunov(0.4 * A, Q),
        rtol=1e-9,
        atol=1e-11,
    )


@pytest.mark.slow
def test_they_work_in_batches_and_on_a_scalar_by_hand():
    """a = 0, b = q = r = 1: P = 1, and dP/dq = 1/2; the discrete one with a = 1 is the golden
    ratio.
    """
    one, zero = np.ones((1, 1)), np.zeros((1, 1))
    value, slope = jax.jit(jax.value_and_grad(lambda q: riccati(zero, one, q * one, one)[0, 0]))(
        1.0
    )
    np.testing.assert_allclose((value, slope), (1.0, 0.5), rtol=1e-13)
    np.testing.assert_allclose(
        DISCRETE_RICCATI(one, one, one, one)[0, 0], (1 + 5**0.5) / 2, rtol=1e-14
    )
    A, B, Q, R = system(8)
    batch = jax.jit(jax.vmap(lambda s: riccati(A, B, s * Q, R)))(np.array([0.5, 2.0]))
    np.testing.assert_allclose(batch[1], RICCATI(A, B, 2 * Q, R), rtol=1e-9, atol=1e-9)


def test_small_systems_are_solved_as_lapack_does_with_their_slopes():
    rng = np.random.default_rng(0)
    for n in (2, 5):
        A, b, moved = rng.normal(size=(n, n)), rng.normal(size=n), rng.normal(size=(n, n))
        A[np.arange(n), np.arange(n)] *= rng.integers(2, size=n)  # pivots that are 0
        if np.linalg.cond(A) > 1e4:
            A += np.roll(np.eye(n), 1, axis=0)
        x = np.linalg.solve(A, b)
        both = jax.jit(lambda m, b, v: jax.jvp(lambda m: elimination.solve(m, b), (m,), (v,)))
        found, slope = both(A, b, moved)
        np.testing.assert_allclose(found, x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(slope, -np.linalg.solve(A, moved @ x), rtol=1e-7, atol=1e-7)
    singular = jax.jit(elimination.solve)(np.array([[1.0, 2.0], [2.0, 4.0]]), np.ones(2))
    assert not np.isfinite(singular).any()


def test_inverses_are_those_of_lapack_with_their_slopes():
    rng = np.random.default_rng(1)
    for n in (1, 2, 5, 40):
        A, moved, B = rng.normal(size=(n, n)), rng.normal(size=(n, n)), rng.normal(size=(n, 3))
        A[0] = np.roll(np.eye(n)[0], 1)  # its first pivot is 0
        both = jax.jit(lambda A, v, B: jax.jvp(lambda A: elimination.solve_all(A, B), (A,), (v,)))
        solution, slope = both(A, moved, B)
        x = np.linalg.solve(A, B)
        np.testing.assert_allclose(solution, x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(slope, -np.linalg.solve(A, moved @ x), rtol=1e-7, atol=1e-7)
        weights = rng.normal(size=(n, n))
        back = jax.jit(jax.grad(lambda A, w: jnp.sum(w * elimination.inverse(A))))(A, weights)
        inverted = np.linalg.inv(A)
        np.testing.assert_allclose(back, -inverted.T @ weights @ inverted.T, rtol=1e-7, atol=1e-7)
    singular = jax.jit(elimination.inverse)(np.array([[1.0, 2.0], [2.0, 4.0]]))
    assert not np.isfinite(singular).any()


@pytest.mark.parametrize("size", [1e-6, 0.3, 1.0, 4.0, 60.0])
def test_matrix_exponentials_are_those_of_scipy(size):
    rng = np.random.default_rng(2)
    for n in (1, 3, 8):
        A = rng.normal(size=(n, n))
        A *= size / np.abs(A).sum(axis=0).max()
        exact, moved = linalg.expm(A), rng.normal(size=(n, n))
        both = jax.jit(lambda A, v: jax.jvp(matrix_exponential, (A,), (v,)))
        value, slope = both(A, moved)
        atol = 1e-13 * max(1.0, size) * np.abs(exact).max()
        np.testing.assert_allclose(value, exact, rtol=0, atol=atol)
        exact = linalg.expm_frechet(A, moved, compute_expm=False)
        np.testing.assert_allclose(slope, exact, rtol=0, atol=1e-11 * np.abs(exact).max())
    assert np.isnan(matrix_exponential(np.array([[1e12]]))).all()


BATCH = """
import jax, numpy as np
import jaxtank
from jaxtank.analysis.riccati import discrete_lyapunov, lqr
jax.config.update("jax_enable_x64", True)
A, B, Q, R = -np.eye(3), np.ones((3, 1)), np.eye(3), np.eye(1)
both = lambda s: (lqr(s * A, B, Q, R), discrete_lyapunov(0.1 * s * A, Q))
for _ in range(20):
    K, X = jax.jit(jax.vmap(both))(np.linspace(0.5, 2.0, 5000))
print(bool(np.isfinite(K).all() and np.isfinite(X).all()))
"""


@pytest.mark.extended
def test_large_batches_of_several_systems_return():
    """The time limit ends a run that would never end: it takes some seconds."""
    assert python(BATCH, timeout=200) == "True"


def test_a_run_with_steady_inputs_has_no_lapack():
    """A kept program would take longer to load: jax looks LAPACK up in scipy."""
    case = presets.find("gouta2015/ngpc")
    clock = Clock(dt=0.1, duration=10.0)
    run = jax.jit(lambda loop: jaxtank.evaluate(loop, clock, ["input_deviation"]))
    assert "lapack" not in run.lower(case.loop).as_text()

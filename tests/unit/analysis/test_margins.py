"""Margins of sampled open loops against python-control, eigenvalues and dense grids."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

import jaxtank.analysis.margins as analysis
from jaxtank.analysis.frequency import OpenLoop, is_stable
from jaxtank.analysis.margins import margins

control = pytest.importorskip("control", reason="python-control is the independent answer")


def lags_under_pi(rng):
    """Two lags under a sampled PI controller, of generic gains, as python-control builds it."""
    dt, plant = 0.5, control.tf([1.0], [1.0])
    for _ in range(2):
        plant = plant * control.tf([rng.uniform(0.7, 1.5)], [rng.uniform(2.0, 30.0), 1.0])
    gain, time = rng.uniform(0.5, 6.0), rng.uniform(4.0, 30.0)
    pi = control.ss([[1.0]], [[1.0]], [[gain * dt / time]], [[gain]], dt)
    return pi * control.ss(control.c2d(plant, dt))


def delayed(A, B, C, dead):
    """(A, B, C) with the dead time as states."""
    m = B.shape[1]
    for _ in range(dead):
        n = len(A)
        A = np.block([[A, B], [np.zeros((m, n + m))]])
        B = np.concatenate([np.zeros((n, m)), np.eye(m)])
        C = np.concatenate([C, np.zeros((len(C), m))], axis=1)
    return A, B, C


def gain_of(system, dt):
    return lambda w: abs(system(np.exp(1j * w * dt)))


def peak_of(gain, grid):
    """Largest value of gain(w), between the neighbours of the largest on a grid."""
    k = np.argmax([gain(w) for w in grid])
    ends = grid[[max(k - 1, 0), min(k + 1, len(grid) - 1)]]
    least = scipy.optimize.minimize_scalar(
        lambda w: -gain(w), bounds=ends, method="bounded", options={"xatol": 1e-12}
    )
    return -least.fun


def of_all(systems, dead, dt):
    """Margins of systems [(A, B, C), ...] of one size, the same with slopes and without."""
    stacked = [jnp.asarray(np.stack(part)) for part in zip(*systems)]

    def found(slopes):
        one = lambda A, B, C: margins(OpenLoop(A, B, C, dead, dt), slopes)
        return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(*stacked))

    with_slopes, without = found(True), found(False)
    np.testing.assert_array_equal(without.stable, with_slopes.stable)
    peaks = "sensitivity_peak", "complementary_peak"
    for name in (*peaks, "gain_margin", "phase_margin", "delay_margin"):
        a, b = (getattr(one, name)[with_slopes.stable] for one in (without, with_slopes))
        np.testing.assert_allclose(a, b, rtol=1e-7)
    return with_slopes


@pytest.mark.slow_for("0", "4")
@pytest.mark.parametrize("dead", [0, 4])
def test_margins_of_two_lags_under_pi_are_those_of_python_control(dead):
    rng = np.random.default_rng(3)
    loops = [lags_under_pi(rng) for _ in range(24)]
    found = of_all([(s.A, s.B, s.C) for s in loops], dead, 0.5)
    compared = 0
    for k, one in enumerate(loops):
        A, B, C = delayed(one.A, one.B, one.C, dead)
        stable = np.abs(np.linalg.eigvals(A - B @ C)).max() < 1.0
        assert bool(found.stable[k]) == stable
        if not stable:
            continue
        compared += 1
        L = control.tf(control.ss(A, B, C, [[0.0]], 0.5))
        gain, phase, distance, _, crossover, _ = control.stability_margins(L)
        assert found.gain_margin[k, 0] == pytest.approx(np.exp(abs(np.log(gain))), rel=1e-6)
        assert found.phase_margin[k, 0] == pytest.approx(abs(phase), rel=1e-6)
        assert found.sensitivity_peak[k] == pytest.approx(1.0 / distance, rel=1e-6)
        peak = peak_of(gain_of(control.feedback(L), 0.5), np.geomspace(1e-6, np.pi / 0.5, 4_000))
        assert found.complementary_peak[k] == pytest.approx(peak, rel=1e-6)
        assert found.delay_margin[k, 0] == pytest.approx(np.radians(phase) / crossover, rel=1e-6)
    assert compared > 8


@pytest.mark.slow
def test_with_two_inputs_the_peak_is_that_of_the_largest_singular_value():
    rng = np.random.default_rng(5)
    systems = []
    while len(systems) < 8:
        A = scipy.linalg.expm(-0.3 * (np.diag(rng.uniform(0.1, 2.0, 4)) + 0.1 * np.ones((4, 4))))
        B, C = 0.3 * rng.normal(size=(4, 2)), 0.5 * rng.normal(size=(2, 4))
        if np.abs(np.linalg.eigvals(A - B @ C)).max() < 0.99:
            systems.append((A, B, C))
    found = of_all(systems, 0, 0.3)
    z = np.exp(1j * np.geomspace(1e-5, np.pi, 40_000))
    for k, (A, B, C) in enumerate(systems):
        L = C @ np.linalg.solve(
            z[:, None, None] * np.eye(4) - A, np.broadcast_to(B, (len(z), 4, 2))
        )
        S = np.linalg.inv(np.eye(2) + L)
        peak = np.linalg.norm(S, 2, axis=(1, 2)).max()
        assert found.sensitivity_peak[k] == pytest.approx(peak, rel=1e-6)
        peak = np.linalg.norm(L @ S, 2, axis=(1, 2)).max()
        assert found.complementary_peak[k] == pytest.approx(peak, rel=1e-6)
        for i in range(2):  # the other loop closed in the state space: nothing of S is used
            j = 1 - i
            closed = A - np.outer(B[:, j], C[j])
            alone = control.tf(control.ss(closed, B[:, [i]], C[[i]], [[0.0]], 0.3))
            gains = [g for g in control.stability_margins(alone, returnall=True)[0] if g > 0]
            grid = control.frequency_response(alone, np.angle(z[-1:]) / 0.3).complex
            gains += [-1.0 / np.real(grid).item()] if np.real(grid) < 0 else []
            least = min((abs(np.log(g)) for g in gains), default=np.inf)
            assert np.log(found.gain_margin[k, i]) == pytest.approx(least, rel=1e-4, abs=1e-6)


def are_called_stable(systems, dead):
    """(calls of `margins`, verdicts of the eigenvalues) of systems (A, B, C) with a dead time."""
    stable = lambda A, B, C: margins(OpenLoop(A, B, C, dead, 1.0), False).stable
    calls = jax.jit(jax.vmap(stable))(*(np.stack(part) for part in zip(*systems)))
    matrices = (a - b @ c for a, b, c in (delayed(*s, dead) for s in systems))
    radius = np.array([np.abs(np.linalg.eigvals(matrix)).max() for matrix in matrices])
    return np.asarray(calls), radius < 1.0


@pytest.mark.parametrize("short", [0, 100])
def test_a_dead_time_makes_a_loop_unstable_where_eigenvalues_do(short, monkeypatch):
    """By the winding, as with more than SHORT samples of dead time, and by the matrix."""
    monkeypatch.setattr(analysis, "SHORT", short)
    rng, systems = np.random.default_rng(7), []
    for _ in range(60):
        A = np.diag(1.0 - rng.uniform(0.005, 0.3, 3)) + np.triu(0.1 * rng.normal(size=(3, 3)), 1)
        A[0, 0] = 1.0  # an integrator
        systems.append((A, 0.3 * rng.normal(size=(3, 1)), 0.3 * rng.normal(size=(1, 3))))
    calls, stable = are_called_stable(systems, 7)
    np.testing.assert_array_equal(calls, stable)
    assert 5 < stable.sum() < 55


@pytest.mark.parametrize("inputs", [3, 6])
def test_coupled_loops_with_dead_time_are_as_stable_as_their_eigenvalues(inputs):
    """Also with integrators, unstable open loops and light damping, a thousandth."""
    rng, n, systems = np.random.default_rng(3), 2 * inputs + 1, []
    turned = 0.999 * np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
    for k in range(40):
        A = np.diag(1.0 - rng.uniform(0.003, 0.3, n)) + np.triu(0.1 * rng.normal(size=(n, n)), 1)
        A[0, 0] = (1.0, 1.01, 0.9)[k % 3]
        if k % 2:
            A[-2:, -2:] = turned
        B = 0.25 * rng.normal(size=(n, inputs))
        C = B.T * rng.uniform(0.02, 0.5 / inputs) + 0.01 * rng.normal(size=(inputs, n))
        systems.append((A, B, C))
    calls, stable = are_called_stable(systems, 5)
    np.testing.assert_array_equal(calls, stable)
    assert 4 < stable.sum() < 36


def test_many_loops_are_as_stable_as_the_worst_of_them():
    """30 tanks under PI, alike: their determinant turns by turns between two frequencies."""
    A, B, C = [[1.0, 0.01], [0.0, 1.0]], [[1.0], [1.0]], [[0.1, 0.0]]
    A, B, C = (np.kron(np.eye(30), part) for part in (A, B, C))
    is_called = jax.jit(lambda *parts: margins(OpenLoop(*parts, 7, 1.0), False).stable)
    for gain, stable in ((0.5, True), (5.0, False)):
        unlike = np.where(np.arange(30) == 17, gain, 0.5)
        a, b, c = delayed(A, B * unlike, C, 7)
        assert (np.abs(np.linalg.eigvals(a - b @ c)).max() < 1.0) == stable
        assert bool(is_called(A, B * unlike, C)) == stable


def test_the_spectral_radius_is_compared_with_one_next_to_it():
    rng = np.random.default_rng(1)
    A = rng.normal(size=(6, 6))
    A /= np.abs(np.linalg.eigvals(A)).max()
    check = jax.jit(is_stable)
    assert bool(check(A * (1.0 - 1e-7))) and not bool(check(A * (1.0 + 1e-7)))
    assert bool(check(np.triu(np.ones((4, 4)), 1)))  # all poles at 0


def test_margins_of_five_inputs_are_those_of_a_root_finder_beside_light_damping():
    """Each crossover again by Brent's method on the loop of one input, the others closed."""
    rng, m, dt = np.random.default_rng(1), 5, 0.5
    rotation = np.array([[np.cos(0.4), np.sin(0.4)], [-np.sin(0.4), np.cos(0.4)]])
    A = scipy.linalg.block_diag(np.diag(rng.uniform(0.5, 0.9, 5)), 0.998 * rotation)
    B, C = 0.3 * rng.normal(size=(7, m)), 0.3 * rng.normal(size=(m, 7))
    assert np.abs(np.linalg.eigvals(A - B @ C)).max() < 1.0
    result = jax.jit(lambda *parts: margins(OpenLoop(*parts, 0, dt), False))(A, B, C)

    def sensitivity(w):
        z = np.exp(1j * w * dt)
        return np.linalg.inv(np.eye(m) + C @ np.linalg.solve(z * np.eye(7) - A, B))

    def phase_margin(i):
        """The least over every frequency at which the gain of an input is 1."""
        alone = lambda w: 1.0 / sensitivity(w)[i, i] - 1.0
        gain = lambda w: np.log(np.abs(alone(w)))
        cuts = np.flatnonzero(np.diff(np.abs(1.0 / every[:, i, i] - 1.0) < 1.0))
        roots = [scipy.optimize.brentq(gain, *grid[[k, k + 1]], xtol=1e-14) for k in cuts]
        angles = [np.degrees(np.pi - np.abs(np.angle(alone(w)))) for w in roots]
        return min(angles, default=np.inf)

    grid = np.geomspace(1e-6, np.pi / dt, 4_000)
    every = np.array([sensitivity(w) for w in grid])
    peak = peak_of(lambda w: np.linalg.norm(sensitivity(w), 2), grid)
    assert float(result.sensitivity_peak) == pytest.approx(peak, rel=1e-9)
    peak = peak_of(lambda w: np.linalg.norm(np.eye(m) - sensitivity(w), 2), grid)
    assert float(result.complementary_peak) == pytest.approx(peak, rel=1e-9)
    least = np.array([phase_margin(i) for i in range(m)])
    np.testing.assert_allclose(result.phase_margin, least, rtol=1e-7)
    assert np.isfinite(least).sum() >= 2

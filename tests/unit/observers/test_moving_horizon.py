"""The moving-horizon estimator against the Kalman filter, and against scipy on the same window."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import RIGS, Compiled, estimates_along, needs_gcc, rk4, signals_of
from scipy.optimize import least_squares, lsq_linear

import jaxtank
from jaxtank import rig
from jaxtank.core.errors import InputError
from jaxtank.core.tree import component, get_value, leaf, static, with_values
from jaxtank.observers import MovingHorizon
from jaxtank.plants.base import Plant
from jaxtank.plants.network import network

A = np.array([[-0.1, 0.0], [0.1, -0.2]])
DT, SAMPLES = 0.5, 4
# Runge-Kutta's step of a linear model is Taylor's series to the fourth power
F = sum(np.linalg.matrix_power(A * DT, k) / f for k, f in enumerate([1.0, 1.0, 2.0, 6.0, 24.0]))
G = (
    DT
    * sum(np.linalg.matrix_power(A * DT, k) / f for k, f in enumerate([1.0, 2.0, 6.0, 24.0]))
    @ np.array([0.5, 0.0])
)
Q, R, P0 = np.array([0.02, 0.03]), 0.05, np.array([0.3, 0.4])


@component
class Linear(Plant):
    """Two tanks in series with linear outlets: h' = A h + (0.5 u, 0)."""

    rim: np.ndarray = leaf("cm", "height", shape="tank")
    tanks: int = static(default=2)
    pumps: int = static(default=1)
    outputs: tuple = static(default=(1,))

    def derivative(self, t, x, u, d):
        return A[0, 0] * x[0] + 0.5 * u[0], A[1, 0] * x[0] + A[1, 1] * x[1]


@component
class Emptied(Linear):
    """Nothing leaves a tank whose level is below 0."""

    def derivative(self, t, x, u, d):
        return super().derivative(t, [jnp.where(h >= 0.0, h, 0.0) for h in x], u, d)


def estimator(**changes):
    values = {"process": Q, "measurement": [R, R], "spread": P0, "measured": (1,)}
    return MovingHorizon(model=Linear(rim=[10.0, 10.0]), samples=SAMPLES, **values, **changes)


def readings(level, count=20):
    """Readings (count, 2) of levels about `level`, and inputs (count, 1)."""
    rng = np.random.default_rng(1)
    return level + 0.4 * rng.standard_normal((count, 2)), 0.4 * level + rng.uniform(
        0, 0.2, (count, 1)
    )


def window(ys, us, prior, P):
    """(rows, right) of the least squares of a window whose first state is `prior` +- P."""
    root, weight, eye = (
        np.linalg.inv(np.linalg.cholesky(P)),
        np.diag(1 / np.sqrt(Q * DT)),
        np.eye(2),
    )
    blocks = [[(0, root)], *([(j, eye[1:] / np.sqrt(R))] for j in range(len(ys)))]
    blocks += [[(j + 1, weight), (j, -weight @ F)] for j in range(len(ys) - 1)]
    right = [root @ prior, *(y[1:] / np.sqrt(R) for y in ys), *(weight @ G * u for u in us[:-1])]
    rows = []
    for block in blocks:
        row = np.zeros((len(block[0][1]), 2 * len(ys)))
        for j, values in block:
            row[:, 2 * j : 2 * j + 2] = values
        rows.append(row)
    return np.vstack(rows), np.concatenate(right)


def solved(ys, us, x0, most):
    """Estimates (samples, 2) by one bounded least-squares problem of scipy in each sample."""
    last, prior, P = [], x0, np.diag(P0)
    for k in range(len(ys)):
        first = max(0, k - SAMPLES + 1)
        if first:  # a sample leaves the window: the filter's recursion, from its estimate
            K = P[:, 1] / (P[1, 1] + R)
            prior = F @ last[first - 1] + G * us[first - 1]
            P = F @ (P - np.outer(K, P[1])) @ F.T + np.diag(Q) * DT
        rows, right = window(ys[first : k + 1], us[first : k + 1], prior, P)
        limits = (0.0, np.tile(most, k + 1 - first))
        solution = lsq_linear(rows, right, limits, method="bvls", tol=1e-15)
        last.append(solution.x[-2:])
    return np.array(last)


def test_without_a_limit_that_binds_it_is_the_kalman_filter():
    """In windows that grow and in full ones; a linear model."""
    (ys, us), x = readings(5.0), np.array([5.0, 2.5])
    observer = estimator(limit=[np.inf, np.inf])
    estimate, P = estimates_along(observer, x, ys, us, DT).x, np.diag(P0)
    for k, y in enumerate(ys):
        K = P[:, 1] / (P[1, 1] + R)
        x, P = x + K * (y[1] - x[1]), P - np.outer(K, P[1])
        np.testing.assert_allclose(estimate[k], x, rtol=0, atol=1e-9)
        x, P = F @ x + G * us[k], F @ P @ F.T + np.diag(Q) * DT


@pytest.mark.extended_for("0.1-most0-Emptied")
@pytest.mark.parametrize("plant", [Linear, Emptied])
@pytest.mark.parametrize("level, most", [(0.1, [4.0, 3.0]), (3.0, [3.2, 2.8])])
def test_with_limits_that_bind_it_is_the_bounded_least_squares_of_scipy(plant, level, most):
    """At the bottoms, and at the largest levels of both tanks."""
    (ys, us), x0 = readings(level), np.array([level, level])
    observer = dataclasses.replace(estimator(limit=most), model=plant(rim=[10.0, 10.0]))
    estimate = estimates_along(observer, x0, ys, us, DT).x
    reference = solved(ys, us, x0, most)
    at = np.isclose(reference, 0.0 if level < 1.0 else most, rtol=0, atol=1e-12)
    assert at.any() and not at.all()
    np.testing.assert_allclose(estimate, reference, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_its_derivatives_are_the_differences_where_limits_bind():
    """By variances, limits and readings, of a run in which no limit begins or ceases to bind."""
    (ys, us), x0 = readings(3.0), np.array([3.0, 3.0])
    observer = estimator(limit=[3.2, 2.8])
    names = ("process[0]", "measurement[1]", "spread[1]", "limit[1]", "limit[0]")

    def run(z):
        values = {name: get_value(observer, name) * (1.0 + z[i]) for i, name in enumerate(names)}
        moved = with_values(observer, values)
        return estimates_along(moved, x0, ys + z[-1], us, DT).x.ravel()

    z, step = np.zeros(len(names) + 1), 1e-6
    binds = np.isclose(run(z).reshape(-1, 2), [3.2, 2.8], rtol=0, atol=1e-12)
    assert binds.any()
    eye = step * np.eye(len(z))
    differences = np.stack([(run(z + d) - run(z - d)) / (2 * step) for d in eye], axis=1)
    np.testing.assert_allclose(jax.jacfwd(run)(z), differences, rtol=1e-4, atol=1e-6)


TANKS = network(
    area=[5.0, 4.0], drain=[0.0, 0.06], links=[(0, 1)], orifice=[0.05], pump_gain=[1.0],
    feeds=[(0, None)], rim=[8.0, 8.0],
)  # fmt: skip


def onward(h, u):
    """Levels of TANKS after DT: Runge-Kutta of its two balances."""

    def rates(h):
        upper, lower = np.array([0.05, 0.06]) * np.sqrt(2 * 981.0 * h)
        return np.array([(u - upper) / 5.0, (upper - lower) / 4.0])

    return rk4(rates, h, DT)


@pytest.mark.slow
def test_its_iterations_converge_to_the_nonlinear_least_squares_of_scipy():
    """A limit of the upper level, which is not read, binds."""
    (ys, us), x0, most = readings(5.0, SAMPLES), np.array([5.0, 4.0]), np.array([5.2, 8.0])
    observer = dataclasses.replace(estimator(limit=most, iterations=3), model=TANKS)
    estimate = estimates_along(observer, x0, ys, us, DT).x[-1]

    def residuals(states):
        x = states.reshape(SAMPLES, 2)
        noises = [(x[j + 1] - onward(x[j], us[j, 0])) / np.sqrt(Q * DT) for j in range(SAMPLES - 1)]
        prior = (x[0] - x0) / np.sqrt(P0)
        return np.concatenate([prior, (x[:, 1] - ys[:, 1]) / np.sqrt(R), *noises])

    limits = (0.0, np.tile(most, SAMPLES))
    start, tight = np.tile([5.0, 4.5], SAMPLES), dict.fromkeys(("xtol", "ftol", "gtol"), 1e-15)
    solution = least_squares(residuals, start, bounds=limits, method="dogbox", **tight)
    assert solution.active_mask.any()
    np.testing.assert_allclose(estimate, solution.x[-2:], rtol=0, atol=1e-6)


def test_variances_that_are_0_are_refused():
    for name in ("process", "coefficient_walk"):
        with pytest.raises(InputError, match=f"observer.{name} = 0: must be above 0"):
            drift = {"coefficient_spread": 0.1, "coefficient_walk": 1e-6}
            observer = estimator(**drift, coefficients=("drain[1]",))
            observer = dataclasses.replace(observer, model=TANKS)
            with_values(observer, {name: 0.0}).check(TANKS)


WINDOW = (RIGS / "moving_horizon.toml").read_text()
RIG = WINDOW.replace('"moving-horizon", samples = 4', '"extended-kalman"')


@pytest.mark.slow
def test_in_a_loop_it_keeps_the_levels_that_a_filter_estimates_below_the_bottom():
    plain, window = rig.loads(RIG), rig.loads(WINDOW)
    least = [jaxtank.simulate(c, key=jax.random.key(0)).x_hat.min() for c in (plain, window)]
    assert least[0] < -0.01 and least[1] >= -1e-9
    again = rig.loads(rig.dump(window)).loop.observer
    assert isinstance(again, MovingHorizon) and again.samples == 4


@pytest.mark.slow
def test_the_margins_of_a_loop_are_those_with_the_extended_filter():
    """At rest no limit binds, and both are linear there with the same gain."""
    cases = [rig.set_values(rig.loads(t), {"reference.initial": 3.0}) for t in (RIG, WINDOW)]
    filtered, window = (jaxtank.stability_margins(case)[0].margins for case in cases)
    assert filtered.stable and np.isfinite(filtered.sensitivity_peak)
    for extended, moving in zip(filtered[1:], window[1:]):
        np.testing.assert_allclose(moving, extended, rtol=1e-5)


@needs_gcc
@pytest.mark.slow
def test_a_page_refuses_it_and_code_in_c_gives_the_inputs_of_the_loop(tmp_path):
    case = rig.set_values(rig.loads(WINDOW), {"sensor.noise": 0.0})
    with pytest.raises(InputError, match="observer moving-horizon solves quadratic programmes"):
        case.explore()
    run = jaxtank.simulate(case)
    inputs = Compiled(case, tmp_path).run(case, run, signals_of(case))
    np.testing.assert_allclose(inputs, run.applied, rtol=0, atol=1e-9 * 9.0)


def test_a_window_of_one_tank_begins_at_its_level():
    tank = network(area=[50.0], drain=[0.5], pump_gain=[8.0], feeds=[(0, None)], rim=[40.0])
    values = {"process": [0.1], "measurement": [0.1], "spread": [0.1], "measured": (0,)}
    state = MovingHorizon(model=tank, samples=SAMPLES, **values).init((12.0,))
    np.testing.assert_array_equal(state.x, np.full((SAMPLES, 1), 12.0))

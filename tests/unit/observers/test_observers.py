"""Kalman filters against plain numpy, scipy's Riccati solver, and the noise they are there to
remove.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import loops_in
from scipy.linalg import expm, solve_discrete_are

import jaxtank
from jaxtank.analysis.steady_state import equilibrium
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.core.records import Tick
from jaxtank.core.tree import component, number, static, with_values
from jaxtank.loop.run import evaluate_compiled
from jaxtank.observers import ExtendedKalman, Kalman, UnscentedKalman
from jaxtank.plants import state_coupled_four_tank
from jaxtank.plants.base import Plant
from jaxtank.plants.network import network

PLANT = state_coupled_four_tank(15 * 2**0.5)
LEVELS, INPUTS = equilibrium(PLANT, (8.0, 8.0))
Q, R = np.array([1e-4, 2e-4, 3e-4, 4e-4]), np.array([0.04, 0.05, 0.06, 0.07])
A, B = jaxtank.analysis.linearise(PLANT, LEVELS, INPUTS)[:2]
A, B = np.asarray(A), np.asarray(B)


@component
class Linear(Plant):
    """x' = A x + B u of the rig's linearisation: a model on which an extended filter is an ordinary
    one.
    """

    tanks: int = static(default=4)
    pumps: int = static(default=2)

    def derivative(self, t, x, u, d):
        return tuple(
            sum(A[i, j] * x[j] for j in range(4)) + sum(B[i, j] * u[j] for j in range(2))
            for i in range(4)
        )

    def spill(self, x):
        return x, (0.0,) * 4


def kalman(**changes):
    return Kalman(
        **{
            **dict(
                model=PLANT, levels=LEVELS, inputs=INPUTS, process=Q, measurement=R, measured=(0, 1)
            ),
            **changes,
        }
    )


def extended(of=ExtendedKalman, **changes):
    return of(
        **{
            **dict(model=PLANT, process=Q, measurement=R, spread=np.full(4, 1.0), measured=(0, 1)),
            **changes,
        }
    )


def filtered(observer, ys, us, x0, dt):
    state, found = observer.init(tuple(x0)), []
    for k, (y, u) in enumerate(zip(ys, us)):
        tick = Tick(t=k * dt, r=(), dr=(), ddr=(), dt=dt)
        estimate, state = observer.step(state, tick, tuple(y))
        found.append(estimate.x)
        state = observer.predict(state, tick, tuple(u), tuple(u))
    return np.array(found), state


@pytest.mark.extended_for("measured1-extended", "measured1-unscented")
@pytest.mark.slow_for("measured0-extended", "measured2-extended", "measured2-unscented")
@pytest.mark.parametrize("of", [ExtendedKalman, UnscentedKalman], ids=["extended", "unscented"])
@pytest.mark.parametrize("measured", [(0, 1), (1,), (0, 1, 2, 3)])
def test_on_a_linear_model_the_filter_is_the_ordinary_one(measured, of):
    """Joint correction and matrix inverse in numpy; the step's matrix is Taylor's series to h^4,
    which is what RK4 makes of A.
    """
    rng, dt = np.random.default_rng(0), 0.5
    ys, us = rng.normal(5.0, 1.0, (20, 4)), rng.normal(3.0, 1.0, (20, 2))
    found, state = filtered(
        extended(of, model=Linear(), measured=measured), ys, us, np.full(4, 5.0), dt
    )
    H = A * dt
    F = np.eye(4) + H @ (np.eye(4) + H / 2 @ (np.eye(4) + H / 3 @ (np.eye(4) + H / 4)))
    G = dt * (np.eye(4) + H / 2 @ (np.eye(4) + H / 3 @ (np.eye(4) + H / 4))) @ B
    C, x, P = np.eye(4)[list(measured)], np.full(4, 5.0), np.eye(4)
    for k in range(20):
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + np.diag(R[list(measured)]))
        x, P = x + K @ (C @ ys[k] - C @ x), P - K @ C @ P
        np.testing.assert_allclose(found[k], x, rtol=1e-11)
        x, P = F @ x + G @ us[k], F @ P @ F.T + np.diag(Q) * dt
    np.testing.assert_allclose(state.P, P, rtol=1e-10, atol=1e-14)


def test_near_the_bottom_the_unscented_filter_predicts_the_mean_that_levels_have():
    """A tank that empties by Torricelli's law: after t its level is (root of the level - c t/2)^2,
    whose mean over normal levels is a quadrature.
    """
    dt, c = 8.0, 0.2
    after = lambda level: (np.sqrt(level) - c * dt / 2) ** 2
    nodes, weights = np.polynomial.hermite_e.hermegauss(9)
    exact = weights @ after(3.0 + 0.5 * nodes) / weights.sum()
    tank = network(
        area=[1.0], drain=[c / np.sqrt(2 * 981.0)], pump_gain=[1.0], feeds=[(0, None)], rim=[10.0],
        gravity=981.0, knee=1e-6,
    )  # fmt: skip
    mean = {}
    for of in (ExtendedKalman, UnscentedKalman):
        observer = of(
            model=tank, process=[0.0], measurement=[1.0], spread=[0.25], measured=(0,), substeps=10
        )
        tick = Tick(t=0.0, r=(), dr=(), ddr=(), dt=dt)
        state = observer.predict(observer.init((3.0,)), tick, (0.0,), (0.0,))
        mean[of] = state.x[0]
    assert abs(mean[UnscentedKalman] - exact) < 0.1 * abs(mean[ExtendedKalman] - exact)
    np.testing.assert_allclose(mean[UnscentedKalman], (after(3.5) + after(2.5)) / 2, rtol=1e-5)
    np.testing.assert_allclose(state.P[0][0], ((after(3.5) - after(2.5)) / 2) ** 2, rtol=1e-5)


@pytest.mark.slow
def test_a_level_without_a_variance_has_finite_slopes():
    """The start of a filter that is told the levels: the root of a variance of 0."""
    observer = extended(UnscentedKalman, spread=np.zeros(4), process=np.zeros(4))

    def level(x):
        tick = Tick(t=0.0, r=(), dr=(), ddr=(), dt=0.5)
        return observer.predict(observer.init(tuple(x)), tick, (3.0, 3.0), (3.0, 3.0)).x[0]

    x, step = np.full(4, 5.0), 1e-5 * np.eye(4)[0]
    slope = jax.grad(level)(x)[0]
    assert abs(slope - (level(x + step) - level(x - step)) / 2e-5) < 1e-8


@pytest.mark.slow_for("measured0", "measured1", "measured2")
@pytest.mark.parametrize("measured", [(0, 1), (1,), (0, 1, 2, 3)])
def test_the_steady_gain_is_scipys(measured):
    Ad, _, drift, L = kalman(measured=measured).design(0.5)
    C, N = np.eye(4)[list(measured)], np.diag(R[list(measured)])
    np.testing.assert_allclose(Ad, expm(A * 0.5), atol=1e-13)
    np.testing.assert_allclose(drift, 0.0, atol=1e-12)
    P = solve_discrete_are(expm(A * 0.5).T, C.T, np.diag(Q) * 0.5, N)
    np.testing.assert_allclose(L, P @ C.T @ np.linalg.inv(C @ P @ C.T + N), rtol=1e-8, atol=1e-12)


@pytest.mark.slow
def test_near_the_steady_state_both_filters_agree_once_settled():
    """Small moves about the operating point: what differs is the curvature of the roots and RK4,
    both of second order.
    """
    rng, dt = np.random.default_rng(1), 0.5
    ys, us = LEVELS + 1e-4 * rng.normal(size=(400, 4)), np.tile(INPUTS, (400, 1))
    one, _ = filtered_in_jax(kalman(), ys, us, dt)
    other, _ = filtered_in_jax(extended(), ys, us, dt)
    np.testing.assert_allclose(one[200:], other[200:], atol=1e-7)


def filtered_in_jax(observer, ys, us, dt):
    def body(state, now):
        tick = Tick(t=0.0, r=(), dr=(), ddr=(), dt=dt)
        estimate, state = observer.step(state, tick, tuple(now[0]))
        return observer.predict(state, tick, tuple(now[1]), tuple(now[1])), jnp.stack(estimate.x)

    state = jax.tree.map(jnp.asarray, observer.init(tuple(jnp.asarray(LEVELS))))
    state, found = jax.lax.scan(body, state, (jnp.asarray(ys), jnp.asarray(us)))
    return np.asarray(found), state


def noisy(gouta, observer):
    """The benchmark with 0.5 cm of noise on every level, sampled every 0.5 s."""
    case = gouta(
        "backstepping",
        {"sensor.noise": 0.5, "clock.dt": 0.5, "clock.duration": 300.0, "clock.substeps": 2},
    )
    return dataclasses.replace(case.loop, observer=observer), case.clock


@pytest.mark.slow
def test_the_extended_filter_beats_noise_and_open_loop_prediction(gouta):
    start = number([6.0, 1.0, 2.0, 6.0])
    noise = number(np.full(4, 0.25))
    belief = dict(
        process=number(np.full(4, 1e-3)),
        measurement=noise,
        spread=number(np.full(4, 9.0)),
        start=start,
    )
    key = jax.random.key(3)

    def rms(observer):
        loop, clock = noisy(gouta, observer)
        return np.asarray(jaxtank.evaluate(loop, clock, "estimation_rms", key)["estimation_rms"])

    model = with_values(PLANT, {"pump_gain": 1.05 * PLANT.pump_gain})  # the model is 5 % wrong
    ekf = rms(extended(model=model, **belief))
    blind = rms(
        extended(
            model=model, **{**belief, "process": number(np.zeros(4)), "spread": number(np.zeros(4))}
        )
    )
    # of the noise on the measured tanks; 0.64 of it is what was found
    assert np.all(ekf[:2] < 0.7 * 0.5)
    assert np.sum(ekf**2) < 0.5 * np.sum(blind**2)


@pytest.mark.slow
@pytest.mark.parametrize("make", [kalman, extended])
def test_the_loop_still_compiles_to_one_function(gouta, make):

    loop, clock = noisy(gouta, make())
    quiet = with_values(loop, {"sensor.noise": 0.0})
    clock = Clock(dt=0.5, duration=300.0, substeps=1)
    assert (
        loops_in(
            evaluate_compiled.lower(
                quiet, clock, ("rms_error_total", "estimation_rms"), None, False
            ).compile()
        )
        >= 1
    )


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"measured": ()}, "at least one"),
        ({"measured": (0, 0)}, "each once"),
        ({"measured": (4,)}, "of the 4 tanks"),
    ],
)
@pytest.mark.parametrize("make", [kalman, extended])
def test_by_input_validation(make, changes, words):
    with pytest.raises(InputError, match=words):
        make(**changes).check(PLANT)

"""calofir: two coupled tanks in metres against notes/calofir.md, the matrix exponential and another
form of the law.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import jaxtank
from jaxtank import presets, rig
from jaxtank.analysis.steady_state import equilibrium
from jaxtank.controllers import OpenLoop
from jaxtank.core.errors import InputError
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import with_values
from jaxtank.plants.runge_kutta import integrate
from jaxtank.presets import calofir
from jaxtank.signals.setpoints import ramps

CASES = presets.load("calofir").cases
NAMES = ["controller.K_phi", "controller.K_y"]
A, B = calofir.C1 / calofir.A, calofir.C2 / calofir.A


def gains(K_phi, K_y):
    return dict(zip(NAMES, (K_phi, K_y)))


def run(name, values=None, save_every=1):
    case = rig.set_values(CASES[name], values or {})
    return case, jax.tree.map(
        np.asarray, jaxtank.simulate(case.loop, case.clock, save_every=save_every)
    )


def open_loop(loop):
    """The loop with the constant flow u_s of each setpoint instead of the law."""
    flow = [calofir.C1 * np.sqrt(h * (1 - calofir.KAPPA)) for h in (0.48, 0.30)]
    control = OpenLoop(signal=ramps([flow[0]], [(600.0, 0, flow[1])], ramp=0.0))
    return dataclasses.replace(loop, controller=control)


@pytest.mark.parametrize(
    "h1, h3, z3, u",
    [
        (0.48, 0.1237217, 0.5968905, 0.6068586),
        (0.30, 0.0773260, 0.4718834, 0.4797638),
        (0.60, 0.1546521, 0.6673439, 0.6784886),
    ],
)
def test_equilibria(h1, h3, z3, u):
    """Notes S2.2, by the law's own plan and by the balance of the network."""
    controller = CASES["backstepping"].loop.controller
    h3r, flow = controller.prepare((jnp.array([h1]),), None, None)
    np.testing.assert_allclose(
        [h3r[0], np.sqrt(h1 - h3r[0]), flow[0] / 1e-4], [h3, z3, u], atol=5.1e-8
    )
    x, q = equilibrium(controller.model, [h1])
    np.testing.assert_allclose([x[1], q[0] / 1e-4], [h3, u], rtol=1e-6)  # the pipe's knee of 1e-4 m


def command(controller, x, r):
    plan = jax.tree.map(lambda a: a[0], controller.prepare((jnp.array([r]),), None, None))
    return controller.step(
        (), Tick(t=0.0, r=(r,), dr=(0.0,), ddr=(0.0,), plan=plan), Estimate(x=x)
    )[0][0]


LEVELS = st.tuples(
    st.floats(0.01, 0.6),
    st.floats(0.02, 0.95),
    st.floats(0.05, 0.6),
    st.floats(1e-3, 1.0),
    st.floats(1e-3, 1.0),
)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(LEVELS)
def test_the_controller_is_a_feedback_linearisation_and_the_papers_form(point):
    """Notes S4.2: with sigma, pi; and eqs. (16)-(21) as mended in notes S4.1, with z0 and Q0. Both
    to round-off of the largest term.
    """
    h1, share, r, K_phi, K_y = point
    h3 = share * h1
    controller = with_values(CASES["backstepping"].loop.controller, {"K_phi": K_phi, "K_y": K_y})
    q = float(command(controller, (h1, h3), r))
    s, Z, h3r = np.sqrt(h3), np.sqrt(h1 - h3), calofir.KAPPA * r
    e, w = h3 - h3r, A * Z - B * s
    sigma, pi = K_phi + K_y, K_phi * K_y + A * A
    terms = np.array([A, -B * s / (2 * Z), B / (2 * s) * w / A, -sigma * w / A, -pi * e / A])
    scale = 2 * calofir.A * Z * np.abs(terms).max()
    np.testing.assert_allclose(q, 2 * calofir.A * Z * terms.sum(), atol=1e-13 * scale + 3e-17)
    permuted = float(command(with_values(controller, {"K_phi": K_y, "K_y": K_phi}), (h1, h3), r))
    np.testing.assert_allclose(q, permuted, atol=1e-13 * scale + 3e-17)
    z0, Q0, z3r = 0.6, 1e-4, np.sqrt(r - h3r)
    eta1, eta2 = (h3 - h3r) / z0, (Z - z3r) / z0
    f = -B / z0 * np.sqrt(z0 * eta1 + h3r) + A / z0 * z3r
    y = eta2 + (f + K_phi * eta1) / A
    v_i = (B / (2 * A * np.sqrt(z0 * eta1 + h3r)) - K_phi / A) * (A * y - K_phi * eta1)
    v_ii = (B * np.sqrt(z0 * eta1 + h3r) + A * z3r) / (2 * z0 * (z0 * eta2 + z3r))
    v = 2 * calofir.A * z0 * (z0 * eta2 + z3r) / Q0 * (v_i - A * eta1 - K_y * y - v_ii + A / z0)
    np.testing.assert_allclose(q, Q0 * (A * calofir.A / Q0 * z3r + v), atol=1e-12 * scale + 1e-16)


@pytest.mark.extended_for("0.05-0.4")
@pytest.mark.parametrize("K_phi, K_y", [(0.02, 0.1), (0.02, 0.02), (0.05, 0.4)])
def test_continuous_loop_is_the_matrix_exponential(K_phi, K_y):
    """e' = -K_phi e + a Y, Y' = -a e - K_y Y (notes S4.1), the plant integrated by scipy at 1e-13
    with a knee of 1e-12 m.
    """
    plant = rig.set_values(CASES["backstepping"], {"plant.knee": 1e-12}).loop.plant
    controller = with_values(CASES["backstepping"].loop.controller, {"K_phi": K_phi, "K_y": K_y})
    r, h3r = 0.30, calofir.KAPPA * 0.30
    rate = jax.jit(
        lambda x: jnp.stack(
            plant.derivative(0.0, tuple(x), (command(controller, tuple(x), r),), None)
        )
    )
    found = solve_ivp(
        lambda t, x: np.asarray(rate(x)),
        (0, 100),
        [0.33, 0.06],
        method="DOP853",
        rtol=1e-13,
        atol=1e-15,
    )

    def errors(x):
        e = x[1] - h3r
        return np.array([e, np.sqrt(x[0] - x[1]) - (B * np.sqrt(x[1]) - K_phi * e) / A])

    matrix = np.array([[-K_phi, A], [-A, -K_y]])
    for t, x in zip(found.t, found.y.T):
        np.testing.assert_allclose(errors(x), expm(matrix * t) @ errors(found.y[:, 0]), atol=1e-12)


TABLE = [  # notes S7.1: run, gains, RMSE, OS, US, ts up, ts down, RMS Q, saturated, TV
    ("backstepping", (0.01, 0.01), 0.11096, 1.22, 1.08, 271, 286, 5.725e-5, 0.0, 1.03e-4),
    ("backstepping", (0.02, 0.02), 0.08147, 0.12, 0.03, 179, 185, 5.898e-5, 0.0592, 1.775e-4),
    ("backstepping", (0.02, 0.1), 0.07718, 0.0, 0.0, 139, 146, 5.953e-5, 0.1250, 1.480e-4),
    ("backstepping", (0.1, 0.1), 0.07786, 15.35, 27.36, 193, 116, 6.057e-5, 0.1875, 2.651e-4),
    ("backstepping-perturbed", (0.01, 0.01), 0.12005, 0.0, 55.8, None, None, 5.456e-5, 0.0, None),
    ("backstepping-perturbed", (0.02, 0.02),
     0.08243, 0.12, 23.3, None, None, 5.899e-5, 0.0592, None),
    ("backstepping-perturbed", (0.02, 0.1),
     0.07727, 0.33, 5.26, 139, 465, 6.008e-5, 0.125, 1.782e-4),
]  # fmt: skip


@pytest.mark.slow_for(
    "backstepping-perturbed-K4-0.12005-0.0-55.8-None-None-5.456e-05-0.0-None",
    "backstepping-perturbed-K5-0.08243-0.12-23.3-None-None-5.899e-05-0.0592-None",
)
@pytest.mark.parametrize("name, K, rmse, over, under, up, down, rms_q, saturated, travel", TABLE)
def test_acceptance_table(name, K, rmse, over, under, up, down, rms_q, saturated, travel):
    """Tolerances of notes S7.1: RMSE 1e-4 m, overshoots 0.1 points, times 2 s, saturation 0.003;
    RMS and travel of the flow, for which it states none, to half a unit of the last digit printed
    (1.03e-4 has three digits, the others four).
    """
    case, t = run(name, gains(*K))
    e, u = t.e[:, 0], t.u[:, 0]
    values = jaxtank.evaluate(
        case.loop,
        case.clock,
        ("rms_error", "rms_input", "input_travel", "overshoot_percent", "settling_time"),
    )
    assert abs(float(values["rms_error"][0]) - rmse) <= 1e-4
    assert abs(max(0.0, 100 * e[:600].max() / 0.43) - over) <= 0.1
    assert abs(max(0.0, -100 * e[600:].min() / 0.18) - under) <= 0.1
    assert abs(float(values["overshoot_percent"][0]) - max(over, under)) <= 0.1
    if up is not None:
        times = [
            np.nonzero(np.abs(part) > 0.02 * step)[0][-1] + 1
            for part, step in ((e[:600], 0.43), (e[600:], 0.18))
        ]
        np.testing.assert_allclose(times, (up, down), atol=2)
        # that of the last sample outside
        assert abs(float(values["settling_time"][0]) - max(up, down)) <= 3
    assert abs(float(values["rms_input"][0]) - rms_q) <= 0.51e-8
    assert abs(np.mean((u <= 0) | (u >= 1e-4)) - saturated) <= 0.003
    if travel is not None:
        assert abs(float(values["input_travel"][0]) - travel) <= (
            0.51e-6 if travel == 1.03e-4 else 0.51e-7
        )


@pytest.mark.extended
@pytest.mark.slow_for("backstepping-perturbed-0.13495-errors1")
@pytest.mark.parametrize(
    "name, rmse, errors",
    [("backstepping", 0.13376, None), ("backstepping-perturbed", 0.13495, (-0.0395, -0.0490))],
)
def test_the_constant_flow(name, rmse, errors):
    case = CASES[name]
    t = jax.tree.map(np.asarray, jaxtank.simulate(open_loop(case.loop), case.clock))
    assert abs(np.sqrt(np.mean(t.e**2)) - rmse) <= 1e-4
    assert abs(np.sqrt(np.mean(t.u**2)) - 5.470e-5) <= 0.51e-8
    if errors:
        np.testing.assert_allclose(t.e[[449, 1049], 0], errors, atol=5.1e-5)


def test_errors_during_the_faults():
    np.testing.assert_allclose(
        run("backstepping-perturbed")[1].e[[449, 1049], 0], (-0.00033, -0.00946), atol=5.1e-6
    )


FAULTS = {
    "c2*0.75": ("plant.drain[1]", 0.75),
    "c2*1.25": ("plant.drain[1]", 1.25),
    "c1*0.75": ("plant.pipe[0]", 0.75),
    "leak": None,
}
# notes S7.2: fault, h1r, offset at (.01,.01), (.02,.02), (.02,.1), (.05,.05), (.1,.1), with u_s
# alone
OFFSETS = [
    ("c2*0.75", 0.48, (-0.331, -0.012, -0.001, -0.065, -0.107, 0.096)),
    ("c2*0.75", 0.30, (-0.300, -0.015, 0.025, -0.028, -0.059, 0.060)),
    ("c2*1.25", 0.48, (0.120, 0.027, -0.010, 0.055, 0.111, -0.045)),
    # printed -0.003 and 0.082: the balance at rest (exact roots, notes S4.2) has these
    ("c1*0.75", 0.48, (0.120, 0.088, -0.00248, 0.0815, 0.120, 0.277)),
    ("leak", 0.48, (-0.137, -0.044, -0.010, -0.008, -0.002, -0.164)),
]
OFFSET_GAINS = [(0.01, 0.01), (0.02, 0.02), (0.02, 0.1), (0.05, 0.05), (0.1, 0.1)]


@pytest.mark.slow
@pytest.mark.parametrize("fault, r, offsets", OFFSETS)
def test_permanent_faults(fault, r, offsets):
    """h1 - h1r after 6000 s (notes S7.2), to half a unit of the last digit; the constant flow
    without a rim, as the prototype has it.
    """
    case = rig.set_values(CASES["backstepping"], {"clock.duration": 6000.0})
    plant = case.loop.plant
    values = {"plant.drain[0]": 0.2 * plant.pipe[0]} if FAULTS[fault] is None else {}
    if FAULTS[fault]:
        name, factor = FAULTS[fault]
        values[name] = jaxtank.parameters(case.loop)[name[:-3]][int(name[-2])] * factor
    loop = dataclasses.replace(with_values(case.loop, values), reference=ramps([r], [], ramp=0.0))
    found = [
        float(jaxtank.simulate(with_values(loop, gains(*K)), case.clock, save_every=6000).e[-1, 0])
        for K in OFFSET_GAINS
    ]
    steady = OpenLoop(signal=ramps([calofir.C1 * np.sqrt(r * (1 - calofir.KAPPA))], [], ramp=0.0))
    no_rim = dataclasses.replace(
        loop, controller=steady, plant=dataclasses.replace(loop.plant, overflow=False)
    )
    found.append(float(jaxtank.simulate(no_rim, case.clock, save_every=6000).e[-1, 0]))
    np.testing.assert_allclose(found, offsets, atol=0.5e-3)


@pytest.mark.slow
def test_slopes_of_the_mean_square_error():
    """Notes S10, RMSE^2 by the logarithms of the gains.

    The prototype smooths both roots over 1e-4 m; our outlet's is exact above it. Measured: with
    both smoothed the slopes are 4.2e-6 and
    4.5e-6 (relative) from ours; ours are within 1e-6 of the digits printed.
    """
    case = CASES["backstepping"]
    f = lambda z: (
        jaxtank.evaluate(with_values(case.loop, gains(*jnp.exp(z))), case.clock, "rms_error")[
            "rms_error"
        ][0]
        ** 2
    )
    np.testing.assert_allclose(
        jax.jacfwd(f)(np.log([0.02, 0.1])), (-1.714143e-4, -1.20920e-5), rtol=1e-5
    )


def test_exchanging_the_gains_changes_nothing():
    a, b = (run("backstepping-perturbed", gains(*K))[1].x for K in ((0.02, 0.3), (0.3, 0.02)))
    np.testing.assert_allclose(a, b, atol=1e-12)


@pytest.mark.slow
@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    st.floats(0.0, 0.6),
    st.floats(0.0, 1.0),
    st.lists(st.floats(0.0, 1e-4), min_size=5, max_size=5),
    st.floats(0.0, 1.0),
)
def test_the_first_tank_is_never_below_the_second(h1, share, flows, leak):
    """Notes S2.2, by trial: five flows of 10 s each and a leak up to c2; h1 - h3 above -1e-6 m
    after every step of 0.25 s.
    """
    plant = with_values(calofir.rig(), {"drain[0]": leak * calofir.C2 / calofir.SPEED})
    x = (jnp.float64(h1), jnp.float64(h1 * share))
    for q in flows:
        for _ in range(40):
            x, _ = plant.spill(INTEGRATE(plant, x, q))
            assert x[0] - x[1] > -1e-6


INTEGRATE = jax.jit(lambda plant, x, q: integrate(plant, "rk4", 0.0, x, (q,), None, 0.25))


def test_empty_tanks_fill_with_floors_and_never_without():
    """Notes H1: RMS error 0.0890 m and 147 s with the floors; without the one under h1 - h3 no flow
    at all, 0.400 m.
    """
    _, t = run("backstepping", {"x0": [0.0, 0.0]})
    assert abs(np.sqrt(np.mean(t.e**2)) - 0.0890) <= 1e-4
    assert abs(np.nonzero(np.abs(t.e[:600, 0]) > 0.02 * 0.48)[0][-1] + 1 - 147) <= 2
    _, dead = run("backstepping", {"x0": [0.0, 0.0], "controller.difference_floor": 1e-12})
    np.testing.assert_array_equal(dead.x, 0.0)
    assert abs(np.sqrt(np.mean(dead.e**2)) - 0.400) <= 5e-4


def test_the_controller_refuses_another_rig():
    m = calofir.rig()
    lengths = {n: getattr(m, n)[::-1] for n in ("area", "drain", "rim")}
    turned = dataclasses.replace(m, **lengths, feeds=((1, None),), outputs=(1,))
    controller = dataclasses.replace(CASES["backstepping"].loop.controller, model=turned)
    with pytest.raises(InputError, match="two coupled tanks"):
        controller.check(CASES["backstepping"].loop.reference)

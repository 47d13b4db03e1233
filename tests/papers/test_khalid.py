"""The acceptance values of the re-derived khalid: linearisation, Laguerre functions, gains, tables
of closed loops, cross-checks.

The tables (notes S7.2, S7.3) were made by an independent prototype and checked with solve_ivp and
qpOASES. Tolerances are theirs: RMS error 1e-4 m, overshoot 0.15 points, settling 4 s, travel 1 % (2
% where tanks run empty), saturation 0.01.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import minimize
from scipy.signal import dimpulse

import jaxtank
from jaxtank import presets, rig
from jaxtank.controllers.incremental import incremental_model
from jaxtank.controllers.laguerre import laguerre_functions
from jaxtank.core.errors import InputError
from jaxtank.core.tree import with_values
from jaxtank.presets import khalid, khalid as paper

DT = 2.0
PRESET = presets.load("khalid")


def control(kind, **changes):
    return dataclasses.replace(khalid.build(kind).controller, **changes)


_design = jax.jit(lambda part: (*part.design(DT), part.gain(DT)))
_model = jax.jit(lambda plant, point: incremental_model(plant, point, DT))


def designed(part):
    """(Omega, Psi, basis, gain, A, B, C) of a controller and of its incremental model."""
    found = (*_design(part), *_model(part.model, jnp.array(part.operating_point)))
    return [np.asarray(m) for m in found]


@functools.cache
def closed(kind, where="S2", mode="unconstrained", du=0.5, r_w=1e-2):
    """(loop, Trajectory in numpy) of a scenario; what is not static shares one compiled run."""
    loop = with_values(
        khalid.build(kind, where, mode), {"controller.du_limit": du, "controller.r_w": r_w}
    )
    return loop, jax.tree.map(np.asarray, jaxtank.simulate(loop, khalid.CLOCK))


def summary(kind, *setting, **more):
    """What the tables print of a run, one entry per output or pump."""
    loop, run = closed(kind, *setting, **more)
    edge = paper.edges(loop.reference, run)
    held = (run.u < 3e-6) | (run.u > 3.0 - 3e-6)
    return {
        "rmse": np.sqrt(np.mean(run.e**2, axis=0)),
        "over": [pair["overshoot"][0] for pair in edge],
        "under": [pair["overshoot"][1] for pair in edge],
        "settling": edge[0]["settling"],
        "rms_u": np.sqrt(np.mean(run.u**2, axis=0)),
        "travel": np.abs(np.diff(run.u, axis=0)).sum(axis=0),  # the change at t = 0 is not in it
        "held": held.mean(axis=0),
        "top": run.x[:, 0].max(),
    }


# S2.3: the linear model


@pytest.mark.extended
@pytest.mark.slow_for("2")
@pytest.mark.parametrize("pumps", [1, 2])
def test_linear_model_is_the_printed_one_with_its_signs_mended(pumps):
    """Eqs. 10-13 and the matrix exponential of SciPy."""
    area, (h1, h2) = 9350e-6, khalid.MIDDLE[pumps]
    a1, a2, a3 = (78.5e-6 * c * np.sqrt(2 * 9.8) for c in (1.0, 1.0, 0.5))
    k1, k2, k3 = (
        a / (2 * area * np.sqrt(h))
        for a, h in ((a1 if pumps == 2 else 0.0, h1), (a2, h2), (a3, abs(h1 - h2)))
    )
    block = np.zeros((2 + pumps, 2 + pumps))
    block[:2, :2], block[:2, 2:] = (
        [[-(k1 + k3), k3], [k3, -(k2 + k3)]],
        (khalid.U0 / area * np.eye(2))[:, :pumps],
    )
    held = expm(block * DT)
    model = jax.jit(lambda level: incremental_model(khalid.tanks(pumps), level, DT))
    A, B, C = model(jnp.array(khalid.MIDDLE[pumps]))
    np.testing.assert_allclose(A[:2, :2], held[:2, :2], rtol=1e-12)
    np.testing.assert_allclose(B[:2], held[:2, 2:], rtol=1e-12)
    Cm = np.eye(2)[[1] if pumps == 1 else [0, 1]]
    np.testing.assert_allclose(A[2:, :2], Cm @ held[:2, :2], rtol=1e-12)
    np.testing.assert_allclose(B[2:], Cm @ held[:2, 2:], rtol=1e-12)
    np.testing.assert_array_equal(A[2:, 2:], np.eye(pumps))
    np.testing.assert_array_equal(C, np.concatenate([np.zeros((pumps, 2)), np.eye(pumps)], axis=1))


# S4.2, S4.3: Laguerre functions and the cost


def test_laguerre_functions():
    L = np.asarray(laguerre_functions(jnp.float64(0.4), 4, 400))
    np.testing.assert_allclose(L.T @ L, np.eye(4), atol=1e-14)
    printed = [
        [0.91651514, -0.36660606, 0.14664242, -0.05865697],
        [0.36660606, 0.62323029, -0.5572412, 0.34607612],
        [0.14664242, 0.5572412, 0.17743733, -0.48978569],
    ]
    np.testing.assert_allclose(L[:3], printed, atol=5e-9)


@pytest.mark.parametrize("a", [0.0, 0.4, 0.8])
def test_laguerre_functions_are_impulse_responses(a):
    """Gamma_i = sqrt(1-a^2) z/(z-a) [(1-az)/(z-a)]^(i-1): eq. 24 from the corrected eq. 23."""
    L = np.asarray(laguerre_functions(jnp.float64(a), 5, 60))
    top, bottom = np.sqrt(1 - a * a) * np.array([1.0, 0.0]), np.array([1.0, -a])
    for i in range(5):
        np.testing.assert_allclose(
            dimpulse((top, bottom, 1.0), n=60)[1][0][:, 0], L[:, i], atol=1e-12
        )
        top, bottom = np.polymul(top, [-a, 1.0]), np.polymul(bottom, [1.0, -a])


@pytest.mark.slow_for("0.0")
@pytest.mark.parametrize("pole", [0.0, 0.4])
def test_slopes_of_laguerre_functions_by_their_pole(pole):
    """At a = 0 too, where a power would have none: the one-sided limit is the polynomial's."""
    f = jax.jit(lambda a: laguerre_functions(a, 4, 12))
    slope, step = jax.jit(jax.jacfwd(f))(jnp.float64(pole)), 1e-6
    np.testing.assert_allclose(
        slope, (f(jnp.float64(pole + step)) - f(jnp.float64(pole - step))) / (2 * step), atol=1e-8
    )
    np.testing.assert_allclose(jax.jit(jax.jacrev(f))(jnp.float64(pole)), slope, atol=1e-13)


@pytest.mark.extended
def test_cost_of_the_laguerre_controller():
    Omega, Psi, *_ = designed(control("laguerre"))
    np.testing.assert_allclose(
        np.diag(Omega), [0.28060482, 0.23929632, 0.2014798, 0.16722567], atol=5e-9
    )
    np.testing.assert_allclose(Psi[0], [8.60191649, 14.52418331, 2.80666436], atol=5e-8)
    assert np.linalg.cond(Omega) == pytest.approx(85.5, abs=0.05)


@pytest.mark.extended_for("laguerre-mimo")
@pytest.mark.slow_for("gpc", "gpc-mimo")  # whose matrices are written out below
@pytest.mark.parametrize("kind", ["laguerre", "laguerre-mimo", "gpc", "gpc-mimo"])
def test_cost_equals_brute_force(kind):
    """The closed form against the sum over a simulated horizon; the prototype's 6153.648319620 does
    not name its x_e and eta.
    """
    rng = np.random.default_rng(1)
    Omega, Psi, basis, _, A, B, C = designed(control(kind))
    eta, x = rng.normal(size=Omega.shape[0]), rng.normal(size=A.shape[0])
    cost = constant = 0.0
    state, free = x, x
    for m in range(40):
        state, free = A @ state + B @ basis[m] @ eta, A @ free
        cost, constant = cost + np.sum((C @ state) ** 2), constant + np.sum((C @ free) ** 2)
    cost += 1e-2 * eta @ eta
    assert eta @ Omega @ eta + 2 * eta @ Psi @ x + constant == pytest.approx(cost, rel=1e-11)


@pytest.mark.extended_for("gpc-10", "gpc-mimo-10")
@pytest.mark.slow_for("gpc-nc30-30")
@pytest.mark.parametrize(
    "kind, Nc", [("gpc-nc2", 2), ("gpc", 10), ("gpc-nc30", 30), ("gpc-mimo", 10)]
)
def test_gpc_is_that_of_its_own_matrices(kind, Nc):
    """Eqs. 21-22 with F and Phi written out."""
    Omega, Psi, _, gain, A, B, C = designed(control(kind))
    power = [np.linalg.matrix_power(A, i) for i in range(41)]
    F = np.concatenate([C @ power[i + 1] for i in range(40)])
    blocks = [
        [C @ power[i - j] @ B if i >= j else np.zeros((len(C), B.shape[1])) for j in range(Nc)]
        for i in range(40)
    ]
    Phi = np.block(blocks)
    np.testing.assert_allclose(Omega, Phi.T @ Phi + 1e-2 * np.eye(Phi.shape[1]), atol=1e-12)
    np.testing.assert_allclose(Psi, Phi.T @ F, atol=1e-11)
    K = np.linalg.solve(Phi.T @ Phi + 1e-2 * np.eye(Phi.shape[1]), Phi.T @ F)[: B.shape[1]]
    np.testing.assert_allclose(gain, K, rtol=1e-9)


@pytest.mark.extended_for("laguerre-mimo-3")
@pytest.mark.slow_for("laguerre-4")
@pytest.mark.parametrize("kind, N", [("laguerre", 4), ("laguerre", 10), ("laguerre-mimo", 3)])
def test_laguerre_with_pole_0_is_gpc(kind, N):
    flat = control(kind, a=np.zeros(control(kind).a.shape), N=N)
    pulses = control(kind.replace("laguerre", "gpc"), Nc=N)
    (Omega, Psi, _, gain, *_), (*theirs, _, their_gain, _, _, _) = map(designed, (flat, pulses))
    np.testing.assert_allclose(gain, their_gain, rtol=1e-11)
    # pumps within samples, as GPC has them
    order = np.arange(N * flat.model.pumps).reshape(flat.model.pumps, N).T.ravel()
    for mine, other in zip((Omega[np.ix_(order, order)], Psi[order]), theirs):
        np.testing.assert_allclose(mine, other, rtol=1e-12, atol=1e-14)


# K in the order [dH1, dH2, H2 - r], spectral radius of the closed loop, condition of Omega (notes
# S7.1)
GAINS = [
    ("gpc-nc2", [[23.71115, 44.216947, 8.986818]], 0.91980, 24.4),
    ("gpc", [[10.789869, 39.860804, 9.59925]], 0.89069, 89.4),
    ("gpc-nc30", [[10.335214, 36.536922, 8.888984]], 0.89580, 127.2),
    ("laguerre", [[10.823708, 40.513695, 9.755752]], 0.89033, 85.5),
    (
        "laguerre-mimo",
        [[14.36394, 3.59520, 8.07391, -0.35721], [3.59520, 14.74350, -0.35721, 8.03620]],
        0.71033,
        None,
    ),
]


@pytest.mark.slow_for("gpc-nc30-printed2-0.8958-127.2")
@pytest.mark.parametrize("kind, printed, radius, condition", GAINS)
def test_gains(kind, printed, radius, condition):
    Omega, _, _, K, A, B, _ = designed(control(kind))
    digits = 6 if condition else 5  # as printed
    np.testing.assert_allclose(K, printed, rtol=1e-6 if condition else 0, atol=0.5 * 10.0**-digits)
    assert np.abs(np.linalg.eigvals(A - B @ K)).max() == pytest.approx(radius, abs=5e-6)
    if condition:
        assert np.linalg.cond(Omega) == pytest.approx(condition, abs=0.05)


@pytest.mark.slow
def test_gains_with_other_horizons():
    """Notes H6: with few functions the gain depends on the horizon, with eight it does not; the
    condition of Omega grows.
    """
    short, long = (control("laguerre", Np=n) for n in (40, 800))
    assert float(short.gain(DT)[0, 2]) == pytest.approx(9.76, abs=5e-3)
    assert np.linalg.cond(np.asarray(control("laguerre", Np=100).design(DT)[0])) == pytest.approx(
        820, rel=0.02
    )
    assert np.linalg.cond(np.asarray(long.design(DT)[0])) == pytest.approx(1.4e4, rel=0.05)
    assert float(long.gain(DT)[0, 2]) == pytest.approx(13.3, abs=0.05)
    assert float(control("laguerre", N=8).gain(DT)[0, 2]) == pytest.approx(8.96, abs=0.1)


# S7.2: one pump

LATER = pytest.mark.slow
UNC, CLIP, QP = "unconstrained", "clipped", "constrained"
# scenario, law, mode, du, RMSE, OS, US, ts up, down, RMS u, TV, saturated, highest H1; None: not
# printed
ONE_PUMP = [
    ("S2", "gpc-nc2", UNC, 0.5, 0.03449, 0.43, 0, 84, 86, 1.1456, 11.36, None, 0.756),
    ("S2", "gpc", UNC, 0.5, 0.02915, 11.80, 4.65, 80, 34, 1.2908, 27.38, None, 0.910),
    ("S2", "gpc-nc30", UNC, 0.5, 0.02956, 12.24, 5.32, 82, 48, 1.2822, 26.41, None, 0.909),
    ("S2", "laguerre", UNC, 0.5, 0.02905, 11.90, 4.71, 80, 32, 1.2943, 27.77, None, 0.912),
    ("S2", "gpc-nc2", CLIP, 0.5, 0.03696, 0.42, 0, 86, 96, 1.1378, 9.475, 0.050, 0.756),
    ("S2", "gpc-nc2", QP, 0.5, 0.03696, 0.42, 0, 86, 96, 1.1378, 9.475, 0.050, 0.756),
    ("S2", "gpc", QP, 0.5, 0.03543, 8.85, 0.24, 88, 70, 1.1911, 13.61, 0.110, 0.870),
    ("S2", "gpc", CLIP, 0.5, 0.03542, None, None, None, None, None, None, None, None),
    ("S2", "gpc-nc30", QP, 0.5, 0.03545, 9.43, 0.42, 90, 70, 1.1913, 13.62, 0.107, 0.873),
    ("S2", "gpc-nc30", CLIP, 0.5, 0.03543, None, None, None, None, None, None, None, None),
    ("S2", "laguerre", QP, 0.5, 0.03545, 8.84, 0.23, 88, 70, 1.1913, 13.65, 0.107, 0.871),
    ("S2", "laguerre", CLIP, 0.5, 0.03542, None, None, None, None, None, None, None, None),
    ("S2", "gpc-nc2", QP, 0.1, 0.04382, 0.38, 0, 104, 108, 1.1164, 8.831, 0.027, 0.755),
    ("S2", "gpc", QP, 0.1, 0.04306, 6.35, 0.24, 108, 80, 1.1459, 12.11, 0.063, 0.836),
    ("S2", "gpc", CLIP, 0.1, 0.04309, 14.58, None, None, None, 1.1648, 14.64, None, 0.900),
    ("S2", "gpc-nc30", QP, 0.1, 0.04302, 9.59, 0.43, 112, 80, 1.1554, 13.44, 0.060, 0.866),
    ("S2", "gpc-nc30", CLIP, 0.1, 0.04308, 13.61, None, None, None, 1.1627, 14.29, None, 0.894),
    ("S2", "laguerre", QP, 0.1, 0.04314, 5.01, 0.20, 104, 82, 1.1384, 11.33, 0.060, 0.819),
    ("S2", "laguerre", CLIP, 0.1, 0.04310, 15.08, None, None, None, 1.1659, 14.80, None, 0.904),
    ("S1", "gpc-nc2", UNC, 0.5, 0.03399, 0.08, 0, 90, 94, 0.9649, 10.90, None, 0.601),
    ("S1", "gpc-nc2", QP, 0.5, 0.03719, 0.08, 0, 92, 110, 0.9561, 8.544, 0.067, 0.601),
    ("S1", "gpc", UNC, 0.5, 0.02837, 8.18, 0, 76, 34, 1.1021, 24.73, None, 0.709),
    ("S1", "gpc", QP, 0.5, 0.03533, 7.18, 0, 82, 84, 1.0246, 13.53, 0.127, 0.696),
    ("S1", "gpc-nc30", UNC, 0.5, 0.02878, 8.57, 0, 80, 34, 1.0938, 23.78, None, 0.709),
    ("S1", "gpc-nc30", QP, 0.5, 0.03535, 7.69, 0, 84, 84, 1.0244, 13.53, 0.120, 0.698),
    ("S1", "laguerre", UNC, 0.5, 0.02827, 8.24, 0, 76, 34, 1.1052, 25.07, None, 0.711),
    ("S1", "laguerre", QP, 0.5, 0.03535, 7.18, 0, 80, 84, 1.0247, 13.55, 0.123, 0.697),
    ("S1", "laguerre", QP, 0.1, 0.04396, 3.76, 0, 84, 94, 0.9507, 10.31, 0.09, 0.651),
    ("S1", "laguerre", CLIP, 0.1, 0.04386, 8.89, 0, None, None, 0.9708, 12.71, 0.09, 0.702),
]
# compiled in the default run; a compilation takes 5 to 10 s
QUICK = {("laguerre", UNC), ("laguerre", QP)}


def rows(table, quick):
    for row in table:
        yield pytest.param(
            row, marks=() if (row[1], row[2]) in quick else LATER, id="-".join(map(str, row[:4]))
        )


@pytest.mark.slow
@pytest.mark.parametrize("row", list(rows(ONE_PUMP, QUICK)))
def test_rows_with_one_pump(row):
    where, kind, mode, du, rmse, over, under, up, down, rms_u, travel, held, top = row
    got = summary(kind, where, mode, du=du)
    np.testing.assert_allclose(got["rmse"], rmse, atol=1e-4)
    if over is not None:
        np.testing.assert_allclose(got["over"], over, atol=0.15)
        # printed to 1e-4; no tolerance is given
        np.testing.assert_allclose(got["rms_u"], rms_u, atol=1e-3)
        np.testing.assert_allclose(got["travel"], travel, rtol=0.02 if where == "S1" else 0.01)
        np.testing.assert_allclose(got["top"], top, atol=1e-3)
    if under is not None:
        np.testing.assert_allclose(got["under"], under, atol=0.15)
    if up is not None:
        np.testing.assert_allclose(got["settling"], (up, down), atol=4.0)
    if held is not None:
        np.testing.assert_allclose(got["held"], held, atol=0.01)


# u of the first samples, S2, Laguerre, unconstrained
SPOT = [1.77263736, 2.64963504, 3.26998347, 3.67895546]


@pytest.mark.slow
def test_spot_values_unconstrained():
    """To 4e-6: the prototype's outlet flows through a regularised root, which at 0.03 m is short by
    (1e-4/0.03)^2/4 = 3e-6 of itself.
    """
    _, run = closed("laguerre")
    np.testing.assert_allclose(run.u[:4, 0], SPOT, atol=4e-6)
    np.testing.assert_allclose(run.x[20], (0.9121953, 0.14468663), atol=1e-6)


def test_spot_values_to_their_last_digit_with_the_roots_of_the_prototype():
    levels, inputs = own_loop("laguerre", "S2", 20, limited=False, root=regular)
    np.testing.assert_allclose(inputs[:4, 0], SPOT, atol=1e-8)
    np.testing.assert_allclose(levels[20], (0.9121953, 0.14468663), atol=1e-7)


@pytest.mark.slow
def test_spot_values_constrained():
    _, tight = closed("laguerre", mode=QP, du=0.1)
    np.testing.assert_allclose(tight.u[:8, 0], 0.70194709 + 0.1 * np.arange(8), atol=1e-8)
    np.testing.assert_allclose(tight.x[40], (0.81901629, 0.14598189), atol=1e-6)  # the roots again
    _, run = closed("laguerre", mode=QP)
    np.testing.assert_allclose(
        run.u[:6, 0], [1.10194709, 1.60194709, 2.10194709, 2.60194709, 2.93741665, 3.0], atol=4e-6
    )


# S7.3: two pumps

TWO_PUMPS = [  # scenario, law, mode, r_w, RMSE, OS, US, TV; None: not printed
    ("M1", "laguerre-mimo", UNC, 1e-2, (0.01556, 0.01969), (4.59, 3.92), (0, 0), (8.37, 10.53)),
    ("M1", "laguerre-mimo", QP, 1e-2, (0.01808, 0.02312), (5.20, 3.27), (0, 0), (7.46, 9.42)),
    ("M1", "gpc-mimo", QP, 1e-2, (0.01808, 0.02311), (5.42, 3.39), (0, 0), (7.48, 9.43)),
    ("M2", "laguerre-mimo", UNC, 0.01, (0.01504, 0.0191), (8.21, 3.52), (6.25, 0.71), (9.72, 9.68)),
    ("M2", "laguerre-mimo", QP, 1e-2, (0.01694, 0.02209), (9.20, 2.36), (4.91, 0.38), (9.15, 8.95)),
    ("M2", "gpc-mimo", QP, 1e-2, (0.01694, 0.02209), (9.45, 2.49), (5.07, 0.45), (9.17, 8.98)),
    ("M3", "laguerre-mimo", CLIP, 1e-2, (0.02475, 0.02340), (6.00, 2.79), None, (9.54, 9.67)),
    ("M3", "laguerre-mimo", QP, 1e-2, (0.02444, 0.02290), (6.34, 1.17), None, (8.92, 10.34)),
    ("M1", "laguerre-mimo", UNC, 1e-3, (0.01209, 0.01522), (4.22, 3.92), (0, 0), None),
    ("M1", "laguerre-mimo", QP, 1e-3, (0.01791, 0.02292), (4.49, 2.51), (0, 0), None),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    "row",
    [
        pytest.param(row, marks=() if row[1:3] == ("laguerre-mimo", UNC) else LATER)
        for row in TWO_PUMPS
    ],
    ids=lambda row: "-".join(map(str, row[:4])),
)
def test_rows_with_two_pumps(row):
    where, kind, mode, r_w, rmse, over, under, travel = row
    got = summary(kind, where, mode, r_w=r_w)
    np.testing.assert_allclose(got["rmse"], rmse, atol=1e-4)
    np.testing.assert_allclose(got["over"], over, atol=0.15)
    if under is not None:
        np.testing.assert_allclose(got["under"], under, atol=0.15)
    if travel is not None:
        np.testing.assert_allclose(got["travel"], travel, rtol=0.01 if where == "M2" else 0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("where", "mode", "start"),
    [
        ("M2", UNC, 6.040),
        ("M3", UNC, 6.484),
        pytest.param("M2", QP, 7.842, marks=LATER),
        pytest.param("M3", QP, 11.319, marks=LATER),
    ],
)
def test_costs_from_which_two_pumps_are_tuned(where, mode, start):
    """J of notes S10 over 300 samples, travel as a mean over both pumps. For M3 with the programme
    it prints 14.40, which its own RMS errors (notes S7.3: .02444, .02290 m, of which the first 300
    samples have no less than half) rule out at r_w = 0.01; we get 11.319 there, and its tuned 11.12
    at its tuned values.
    """
    _, run = closed("laguerre-mimo", where, mode)
    e, moved = run.e[:300], np.diff(run.u[:300], axis=0)  # the change at t = 0 is not in it
    cost = 1e4 * np.sum(np.mean(e**2, axis=0)) + 20 * np.sum(moved**2) / (2 * 300)
    assert cost == pytest.approx(start, rel=3e-4)  # M3 touches empty tanks


def short_gpc(where, mode, r_w):
    """RMS errors and overshoots of GPC with two pumps and a control horizon of 2."""
    loop = khalid.build("gpc-mimo", where, mode)
    loop = dataclasses.replace(
        loop, controller=dataclasses.replace(loop.controller, Nc=2, r_w=np.float64(r_w))
    )
    run = jax.tree.map(np.asarray, jaxtank.simulate(loop, khalid.CLOCK))
    return np.sqrt(np.mean(run.e**2, axis=0)), [
        pair["overshoot"][0] for pair in paper.edges(loop.reference, run)
    ]


@LATER
def test_the_programme_matters_where_clipping_couples_the_channels():
    """Notes S7.3: GPC 2 with two pumps."""
    assert short_gpc("M1", CLIP, 1e-3)[1][0] == pytest.approx(9.6, abs=0.15)
    assert short_gpc("M1", QP, 1e-3)[1][0] == pytest.approx(1.7, abs=0.15)
    rmse, over = short_gpc("M3", CLIP, 1e-2)
    np.testing.assert_allclose(rmse, (0.0257, 0.0250), atol=1e-4)
    np.testing.assert_allclose(over, (5.2, 13.3), atol=0.15)
    rmse, over = short_gpc("M3", QP, 1e-2)
    np.testing.assert_allclose(rmse, (0.0251, 0.0229), atol=1e-4)
    np.testing.assert_allclose(over, (0.0, 0.0), atol=0.15)


# an implementation of its own: explicit sums (27)-(31), exact roots, solve_ivp, SLSQP


def exact(x):
    return np.sign(x) * np.sqrt(abs(x))


def regular(x, eps=1e-4):
    """The root of the prototype, in pipes and outlets alike; ours is exact in an outlet above the
    knee.
    """
    return x / (x * x + eps * eps) ** 0.25


def own_loop(kind, where, samples, limited, du=0.5, root=exact):
    """Levels (samples+1, 2) and inputs (samples, m) from numpy and SciPy alone, with the design of
    eqs. 27-31 written as sums.
    """
    pumps, spans, x, delay = khalid.SCENARIOS[where]
    area, out = (
        9350e-6,
        [78.5e-6 * c * np.sqrt(2 * 9.8) for c in (0.0 if pumps == 1 else 1.0, 1.0, 0.5)],
    )
    A, B, C = designed(control(kind))[4:]
    N, Np, ahead, a = 4, 40, 15, 0.4
    step = np.array(
        [
            [a if i == j else (1 - a * a) * (-a) ** (i - j - 1) if i > j else 0.0 for j in range(N)]
            for i in range(N)
        ]
    )
    L = [np.sqrt(1 - a * a) * (-a) ** np.arange(N)]
    for _ in range(Np):
        L.append(step @ L[-1])
    wide = [np.kron(np.eye(pumps), v) for v in L]
    power = [np.linalg.matrix_power(A, m) for m in range(Np + 1)]
    phi = [sum(power[m - j - 1] @ B @ wide[j] for j in range(m)) for m in range(1, Np + 1)]
    Omega = sum(p.T @ C.T @ C @ p for p in phi) + 1e-2 * np.eye(N * pumps)
    Psi = sum(p.T @ C.T @ C @ power[m] for m, p in enumerate(phi, 1))
    rows = np.concatenate(
        [np.concatenate(wide[:ahead]), np.concatenate(np.cumsum(wide[:ahead], axis=0))]
    )
    x, u = np.array(x), np.array(khalid.steady_input(pumps, x))
    before, levels, inputs = x, [x], []
    for k in range(samples):
        y = x[1:] if pumps == 1 else x
        r = [
            spans[i][1 - int((2 * k - (delay if i == len(spans) - 1 else 0)) // 300) % 2]
            for i in range(len(spans))
        ]
        error = np.concatenate([x - before, y - r])
        eta = -np.linalg.solve(Omega, Psi @ error)
        if limited:
            least = np.concatenate([np.full(ahead * pumps, -du), np.tile(-u, ahead)])
            most = np.concatenate([np.full(ahead * pumps, du), np.tile(3.0 - u, ahead)])
            bounds = [
                {
                    "type": "ineq",
                    "fun": lambda z, most=most, least=least: np.concatenate(
                        [most - rows @ z, rows @ z - least]
                    ),
                    "jac": lambda z: np.concatenate([-rows, rows]),
                }
            ]
            cost, slope = (
                (lambda z, pull=Psi @ error: z @ Omega @ z + 2 * z @ pull),
                (lambda z, pull=Psi @ error: 2 * (Omega @ z + pull)),
            )
            found = minimize(
                cost,
                np.zeros(len(eta)),
                jac=slope,
                method="SLSQP",
                constraints=bounds,
                options={"ftol": 1e-16, "maxiter": 300},
            )
            eta = found.x
        before, u = x, u + wide[0] @ eta

        def rate(t, h, u=u):
            q = out[2] * root(h[0] - h[1])
            pumped = khalid.U0 * np.append(u, 0.0)[:2]
            return (
                pumped - [out[0] * root(max(h[0], 0)) + q, out[1] * root(max(h[1], 0)) - q]
            ) / area

        x = solve_ivp(rate, (0, DT), x, rtol=1e-10, atol=1e-12).y[:, -1]
        levels.append(x)
        inputs.append(u)
    return np.array(levels), np.array(inputs)


@pytest.mark.extended
def test_against_a_loop_of_numpy_and_solve_ivp():
    """The first pulse and the fall after it. The regularised roots move levels by less than 1e-6 m
    here (notes H2).
    """
    _, run = closed("laguerre")
    levels, inputs = own_loop("laguerre", "S2", 200, limited=False)
    np.testing.assert_allclose(run.x[:200], levels[:200], atol=2e-6)
    np.testing.assert_allclose(run.u[:200], inputs, atol=2e-5)


@pytest.mark.slow
def test_against_a_loop_with_slsqp():
    _, run = closed("laguerre", mode=QP, du=0.1)
    levels, inputs = own_loop("laguerre", "S2", 60, limited=True, du=0.1)
    np.testing.assert_allclose(run.x[:60], levels[:60], atol=2e-6)
    np.testing.assert_allclose(run.u[:60], inputs, atol=2e-5)


@LATER
def test_against_a_loop_with_slsqp_and_two_pumps():
    _, run = closed("laguerre-mimo", "M2", QP)
    levels, inputs = own_loop("laguerre-mimo", "M2", 25, limited=True)
    # H1 - H2 passes through the knee of 1e-4 m (notes H2)
    np.testing.assert_allclose(run.x[:25], levels[:25], atol=5e-5)
    np.testing.assert_allclose(run.u[:25], inputs, atol=1e-3)


# what needs no reference run


COARSE = dataclasses.replace(khalid.CLOCK, substeps=2, duration=398.0)


@pytest.mark.slow_for("laguerre")
@pytest.mark.parametrize("kind", ["laguerre", pytest.param("gpc", marks=LATER)])
def test_a_programme_whose_limits_are_far_is_the_linear_controller(kind):
    loop = khalid.build(kind, mode=QP)
    far = {
        "controller.du_limit": 50.0,
        "controller.u_low": -50.0,
        "controller.u_high": 50.0,
        "actuator.low": -50.0,
        "actuator.high": 50.0,
    }
    run = jaxtank.simulate(with_values(loop, far), COARSE)
    plain = jaxtank.simulate(khalid.build(kind), COARSE)
    np.testing.assert_allclose(run.u, plain.u, atol=1e-7)
    np.testing.assert_allclose(run.x, plain.x, atol=1e-9)


def test_inputs_before_the_start_are_those_of_the_notes():
    assert khalid.steady_input(1, (0.15, 0.03))[0] == pytest.approx(0.60194709, abs=5e-9)
    assert khalid.steady_input(1, (0.60, 0.12))[0] == pytest.approx(1.2039, abs=5e-5)
    np.testing.assert_allclose(khalid.steady_input(2, (0.12, 0.15)), (0.90292, 1.6470), atol=5e-5)


# slopes


@LATER
@pytest.mark.parametrize("samples", [150])
def test_slopes_of_the_prototype_through_150_programmes(samples):
    """Notes S7.4, one pump: J = 1e4 mean(e^2) + 0.1 mean(du^2), S2, du 0.5, by (log r_w, logit a):
    (.1438265, -.0759848).

    The weight and that the first change of u is left out are not written there; they are found by
    its figures, seven digits of both.
    """
    clock = dataclasses.replace(khalid.CLOCK, duration=DT * (samples - 1))
    loop = khalid.build("laguerre", mode=QP)

    def cost(z):
        run = jaxtank.simulate(
            with_values(
                loop, {"controller.r_w": jnp.exp(z[0]), "controller.a": jax.nn.sigmoid(z[1])}
            ),
            clock,
        )
        return 1e4 * jnp.mean(run.e**2) + 0.1 * jnp.mean(jnp.diff(run.u, axis=0) ** 2)

    z = jnp.array([np.log(1e-2), np.log(0.4 / 0.6)])
    forward = np.asarray(jax.jit(jax.jacfwd(cost))(z))
    np.testing.assert_allclose(forward, (0.1438265, -0.0759848), rtol=1e-5)


# the compiled loop and the preset


@pytest.mark.parametrize(
    "values, message",
    [
        ({"controller.operating_point": [0.06, 0.06]}, "must differ"),
        ({"controller.u_high": -1.0}, "must be below"),
        ({"controller.r_w": 0.0}, "must be above 0"),
        ({"controller.a": 1.0}, "must be at most"),
        ({"controller.rows": 50}, "at most controller.Np"),
        (
            {"controller.u_high": 1.0, "actuator.initial": 3.0},
            r"actuator.initial\[0\] = 3 U0: must lie within",
        ),
        (
            {
                "controller.u_low": 3.5,
                "controller.u_high": 5.0,
                "actuator.initial": 3.6,
                "actuator.high": 2.0,
            },
            r"actuator.low\[0\] = 0 U0, actuator.high\[0\] = 2 U0: the range must overlap",
        ),
    ],
)
def test_errors_by_input_validation(values, message):
    with pytest.raises(InputError, match=message):
        rig.check(rig.set_values(PRESET.cases["laguerre-constrained"], values))


@LATER
def test_slopes_of_the_prototype_with_two_pumps():
    """Notes S7.4, two pumps, by (log r_w, logit a1, logit a2, log q2): (.01710786, .0284815,
    .00051297, .8263606).

    Found by its figures as for one pump: M3, du 0.5, r_w 1e-3, J = 1e4 mean |e|^2 + 0.1 mean(du^2),
    Runge-Kutta steps of 0.5 s. To 1e-3: M3 stands on its limits half of the time and H1 - H2 passes
    through the knee, where steps of 0.25 s alone move the first slope by 8 %. The slopes are those
    of J as it is computed: central differences agree to 1e-6 of the largest.
    """
    clock = dataclasses.replace(khalid.CLOCK, duration=DT * 149, substeps=4)
    loop = khalid.build("laguerre-mimo", "M3", QP)

    def cost(z):
        moved = {
            "controller.r_w": jnp.exp(z[0]),
            "controller.a": jax.nn.sigmoid(z[1:3]),
            "controller.q[1]": jnp.exp(z[3]),
        }
        run = jaxtank.simulate(with_values(loop, moved), clock)
        return 1e4 * jnp.mean(jnp.sum(run.e**2, axis=1)) + 0.1 * jnp.mean(
            jnp.diff(run.u, axis=0) ** 2
        )

    z = jnp.array([np.log(1e-3), *[np.log(0.4 / 0.6)] * 2, 0.0])
    forward = np.asarray(jax.jit(jax.jacfwd(cost))(z))
    np.testing.assert_allclose(forward, (0.01710786, 0.0284815, 0.00051297, 0.8263606), rtol=1.1e-3)
    ends = np.asarray(jax.jit(jax.vmap(cost))(z + 1e-5 * np.concatenate([np.eye(4), -np.eye(4)])))
    np.testing.assert_allclose(
        forward, (ends[:4] - ends[4:]) / 2e-5, rtol=0, atol=1e-6 * np.abs(forward).max()
    )

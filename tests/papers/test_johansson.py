"""The quadruple-tank process: printed numbers, signs, pairings, slope of a negative gain."""

import dataclasses

import jax
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxtank
from jaxtank import presets, rig
from jaxtank.core.errors import InputError
from jaxtank.presets.johansson import JOHANSSON, PRINTED_GAINS
from tuning.report.papers import measure

CASES = presets.load("johansson").cases
PHASES = {"pi-minimum": "minimum", "pi-nonminimum": "non-minimum"}


def closed_loop_poles(case, Kc, Ti, pairing):
    """Poles of the linear loop written out by hand: level i by pump pairing[i]."""
    plant, (k, g, _) = case.loop.plant, JOHANSSON[PHASES[case.name.split("/")[1]]]
    A, a = np.asarray(plant.area), np.array([0.071, 0.057, 0.071, 0.057])
    h = np.asarray(case.loop.x0)
    T = A / a * np.sqrt(2 * h / 981.0)
    M = np.diag(-1 / T)
    M[0, 2], M[1, 3] = A[2] / (A[0] * T[2]), A[3] / (A[1] * T[3])
    B = np.zeros((4, 2))
    B[0, 0], B[1, 1] = g[0] * k[0] / A[0], g[1] * k[1] / A[1]
    B[2, 1], B[3, 0] = (1 - g[1]) * k[1] / A[2], (1 - g[0]) * k[0] / A[3]
    C = np.eye(4)[:2]
    K = np.zeros((2, 2))
    K[pairing, [0, 1]] = Kc
    integral = np.zeros((2, 2))
    integral[pairing, [0, 1]] = np.asarray(Kc) / np.asarray(Ti)
    whole = np.block([[M - B @ K @ C, B @ integral], [-C, np.zeros((2, 2))]])
    return np.linalg.eigvals(whole)


@pytest.mark.slow_for("pi-minimum")
@pytest.mark.parametrize("name", CASES)
def test_what_is_printed_is_reproduced(name):
    rows = [r for r in measure("johansson")["rows"] if PHASES[name] in r["quantity"]]
    verdicts = {r["quantity"]: r["verdict"] for r in rows}
    for what in ("levels", "time constants", "zeros", "relative gain"):
        assert verdicts[f"{what}, {PHASES[name]} phase"] == "reproduced", verdicts


@pytest.mark.slow_for("pi-nonminimum")
@pytest.mark.parametrize("name", CASES)
def test_the_run_is_that_of_scipy(name):
    """The equations and the PI written out, integrated from sample to sample."""
    case = CASES[name]
    k, g, u0 = JOHANSSON[PHASES[name]]
    K, Ti = (np.array(v) for v in PRINTED_GAINS[PHASES[name]])
    Kc = 0.5 * K
    run = jaxtank.simulate(case.loop, dataclasses.replace(case.clock, duration=200.0))
    a, A = np.array([0.071, 0.057, 0.071, 0.057]), np.array([28.0, 32.0, 28.0, 32.0])
    h, integral = np.asarray(case.loop.x0, float), np.zeros(2)
    for i in range(200):
        np.testing.assert_allclose(run.x[i], h, rtol=1e-6)
        e = np.asarray(run.r[i]) - h[:2]
        u = np.array(u0) + Kc * e + integral
        assert np.all((u > 0) & (u < 10))
        integral = integral + Kc / Ti * e

        def rate(_, h, u=u):
            out = a * np.sqrt(2 * 981.0 * h)
            flow = np.array(k) * u
            first, second = np.array(g) * flow
            upper = (1 - np.array(g)) * flow
            return (
                np.array(
                    [
                        first - out[0] + out[2],
                        second - out[1] + out[3],
                        upper[1] - out[2],
                        upper[0] - out[3],
                    ]
                )
                / A
            )

        h = solve_ivp(rate, (0, 1), h, rtol=1e-9, atol=1e-11).y[:, -1]


@pytest.mark.slow
def test_signs_and_pairings():
    """The printed pairing at P+ is stable with the printed, negative, gain and unstable with its
    opposite; positive gains are stable with the other pairing.
    """
    case = CASES["pi-nonminimum"]
    Kc, Ti = np.asarray(case.loop.controller.Kc), np.asarray(case.loop.controller.Ti)
    assert closed_loop_poles(case, Kc, Ti, [0, 1]).real.max() < 0
    assert closed_loop_poles(case, np.abs(Kc), Ti, [0, 1]).real.max() > 0
    crossed = np.array([0.1, 0.1])
    assert closed_loop_poles(case, crossed, Ti, [1, 0]).real.max() < 0
    assert closed_loop_poles(case, crossed, Ti, [0, 1]).real.max() > 0

    def error(outputs, Kc, x0=case.loop.x0):
        plant = dataclasses.replace(case.loop.plant, outputs=outputs)
        controller = dataclasses.replace(case.loop.controller, model=plant, Kc=Kc)
        at = jaxtank.signals.ramps(
            [float(x0[i]) for i in outputs], [(100.0, 0, float(x0[outputs[0]]) + 0.1)], 0.0
        )
        loop = dataclasses.replace(case.loop, plant=plant, controller=controller, reference=at)
        run = jaxtank.simulate(
            loop, dataclasses.replace(case.clock, duration=6000.0), save_every=100
        )
        return np.abs(np.asarray(run.e)[-5:]).max()

    assert error((0, 1), Kc) < 1e-3
    assert error((0, 1), np.abs(Kc)) > 0.1
    assert error((1, 0), crossed) < 1e-3


@pytest.mark.slow
def test_a_negative_gain_has_its_slope():
    case = rig.set_values(CASES["pi-nonminimum"], {"clock.duration": 600.0})
    cost = lambda k: jaxtank.evaluate(
        jaxtank.with_values(case.loop, {"controller.Kc": k}), case.clock, ["rms_error_total"]
    )["rms_error_total"]
    k = np.asarray(case.loop.controller.Kc, float)
    slope = jax.grad(cost)(k)
    for i, d in enumerate(np.eye(2) * 1e-6):
        assert float(slope[i]) == pytest.approx(float(cost(k + d) - cost(k - d)) / 2e-6, rel=1e-5)


def test_a_gain_of_zero_is_refused():
    with pytest.raises(InputError, match=r"controller\.Kc = .*must not be 0"):
        case = rig.set_values(CASES["pi-minimum"], {"controller.Kc": [1.0, 0.0]})
        jaxtank.evaluate(case.loop, case.clock, ["rms_error_total"])

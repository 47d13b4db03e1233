"""The three-tank rig: printed linear model, rest by algebra, faults against scipy.

The laminar threshold of 0.01 cm changes a root by (0.01/15)^2, 4e-7 of itself, and not more.
"""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxtank
from jaxtank import presets
from jaxtank.analysis.steady_state import equilibrium
from jaxtank.presets.dts200 import rig
from tuning.report.papers import measure

CASES = presets.load("dts200").cases
A, S, C1, C2, C3 = 154.0, 0.5, 0.46, 0.60, 0.45  # written again: the table of the source


def flow(coefficient, difference):
    return coefficient * S * np.sign(difference) * np.sqrt(2 * 981.0 * np.abs(difference))


def test_the_linear_model_is_that_printed():
    rows = {r["quantity"]: r for r in measure("dts200")["rows"]}
    half = np.sqrt(2 * 981.0) / (2 * A * np.sqrt(15.0)) * S
    by_hand = [[-C1, 0, C1], [0, -C2 - C3, C3], [C1, C3, -C1 - C3]]
    np.testing.assert_allclose(
        np.reshape(rows["linear model, A"]["measured"], (3, 3)), half * np.array(by_hand), rtol=1e-6
    )
    assert {rows[f"linear model, {m}"]["verdict"] for m in "AB"} == {"reproduced"}
    np.testing.assert_array_equal(
        np.round(half * np.array(by_hand), 4).ravel(), rows["linear model, A"]["published"]
    )


def test_rest_by_algebra():
    levels, flows = equilibrium(rig(), np.array([45.0, 15.0]))
    third = (C1**2 * 45.0 + C3**2 * 15.0) / (C1**2 + C3**2)
    np.testing.assert_allclose(levels, [45.0, 15.0, third], rtol=1e-8)
    through = flow(C1, 45.0 - third)
    np.testing.assert_allclose(flows, [through, flow(C2, 15.0) - through], rtol=1e-6)


@pytest.mark.slow_for("1250.0")
@pytest.mark.parametrize("start", [450.0, 1250.0])
def test_the_faults_are_those_of_scipy(start):
    """The equations with a leak, and with a half plugged pipe, under the inputs of the run."""
    case = CASES["pi-faults"]
    run = jaxtank.simulate(case.loop, dataclasses.replace(case.clock, duration=start + 100.0))
    k = int(start)
    h = np.asarray(run.x[k])
    for i in range(k, k + 99):
        leak = 0.2 if 500 <= i < 700 else 0.0
        wide = 0.5 if 1300 <= i < 1500 else 1.0

        u = np.asarray(run.u[i])

        def rate(_, h, u=u, leak=leak, wide=wide):
            q13, q32 = flow(wide * C1, h[0] - h[2]), flow(C3, h[2] - h[1])
            out, lost = flow(C2, h[1]), leak * np.sqrt(2 * 981.0 * h[2])
            return np.array([u[0] - q13, u[1] + q32 - out, q13 - q32 - lost]) / A

        h = solve_ivp(rate, (0, 1), h, rtol=1e-9, atol=1e-11).y[:, -1]
        np.testing.assert_allclose(run.x[i + 1], h, atol=1e-5)


@pytest.mark.slow
def test_setpoints_are_reached_and_faults_are_removed():
    """Setpoint 1 and 2 within 0.2 cm before the next step; the faults move level 1 by more than
    that, and are integrated away.
    """
    sound, faulty = (jaxtank.simulate(CASES[n].loop, CASES[n].clock) for n in ("pi", "pi-faults"))
    assert np.abs(np.asarray(sound.e)[[899, 1699, 2399]]).max() < 0.2
    apart = np.abs(np.asarray(faulty.x - sound.x)[:, 0])
    assert apart[:500].max() == 0.0 and apart[500:700].max() > 0.2
    assert apart[1300:1500].max() > 0.2 and apart[2399] < 0.05

"""Coefficients that a filter estimates with the levels, on readings of an independent rig."""

import dataclasses

import numpy as np
import pytest
from helpers import estimates_along, rk4

import jaxtank
from jaxtank import rig
from jaxtank.core.errors import InputError
from jaxtank.core.tree import parameters
from jaxtank.observers import ExtendedKalman, MovingHorizon, UnscentedKalman
from jaxtank.plants.network import network
from tuning.report.simulated import estimates

MODEL = network(
    area=[50.0, 40.0], drain=[0.0, 0.5], links=[(0, 1)], orifice=[0.5], pump_gain=[8.0],
    feeds=[(0, None)], rim=[40.0, 40.0],
)  # fmt: skip
VALUES = {"process": [1e-6] * 2, "measurement": [4e-4] * 2, "spread": [0.01] * 2}
DRIFT = {"coefficient_spread": 0.01, "coefficient_walk": 1e-8}
US = np.repeat([9.6, 11.0, 8.5, 10.0], 60)[:, None]


def readings(gain, drain):
    """Levels (samples, 2) of the rig by Runge-Kutta of its two balances, with noise of 0.02 cm."""

    def rates(h, u):
        upper, lower = 0.5 * np.sqrt(2 * 981.0 * h[0]), drain * np.sqrt(2 * 981.0 * h[1])
        return np.array([(gain * u - upper) / 50.0, (upper - lower) / 40.0])

    h, rows, step = np.array([12.0, 12.0]), [], 0.1
    for (u,) in US:
        rows.append(h)
        for _ in range(10):
            h = rk4(lambda h, u=u: rates(h, u), h, step)
    levels = np.array(rows)
    return levels, levels + 0.02 * np.random.default_rng(0).standard_normal(levels.shape)


def estimated(observer, ys):
    return estimates_along(observer, np.full(2, 12.0), ys, US, 1.0)


@pytest.mark.extended_for("pump_gain[0]-8.8-0.5-ExtendedKalman")
@pytest.mark.parametrize(
    "of",
    [
        ExtendedKalman,
        pytest.param(UnscentedKalman, marks=pytest.mark.slow),
        pytest.param(MovingHorizon, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("name, gain, drain", [("pump_gain[0]", 8.8, 0.5), ("drain[1]", 8.0, 0.45)])
def test_a_coefficient_that_is_wrong_by_a_tenth_is_estimated_and_the_levels_with_it(
    of, name, gain, drain
):
    """Only the lower level is read. What the model lacks in the level rates is in d."""
    levels, ys = readings(gain, drain)
    plain = of(model=MODEL, measured=(1,), **VALUES)
    x, joined = estimated(plain, ys).x, estimated(joint(of, name), ys)
    settled = slice(120, None)
    assert np.abs(x - levels)[settled].max(axis=0).min() > 0.3
    assert np.abs(joined.x - levels)[settled].max() < 0.02  # below the noise
    truth, other = (gain, 8.0) if name == "pump_gain[0]" else (drain, 0.5)
    np.testing.assert_allclose(joined.coefficients[settled, 0], truth, rtol=1e-3)
    lower = (other - truth) * np.sqrt(2 * 981.0 * levels[settled, 1]) / 40.0
    upper = (truth - other) * US[119:-1, 0] / 50.0
    pumped, zero = name == "pump_gain[0]", 0.0 * lower
    lacking = np.column_stack([upper, zero] if pumped else [zero, lower])
    np.testing.assert_allclose(joined.d[settled], lacking, atol=1e-3)


def joint(of=ExtendedKalman, *names, **changes):
    values = {"measured": (1,), "coefficients": names, **VALUES, **DRIFT, **changes}
    return of(model=MODEL, **values)


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"coefficients": ("drain[1]", "drain[1]")}, "each entry once"),
        ({"coefficients": ("drain[0]",)}, r"drain\[0\] = 0 cm\^2: must be above 0"),
        ({"coefficients": ("rim[0]",)}, "of an area or of a gain"),
        ({"coefficients": ("drain",)}, "of an area or of a gain"),
        ({"coefficients": ("drains[0]",)}, "drain"),
        ({"coefficients": ("drain[1]", "orifice[0]")}, "not identifiable"),
        ({"coefficients": ("drain[1]",), "coefficient_walk": None}, "coefficient_walk: needs"),
    ],
)
def test_coefficients_that_cannot_be_estimated_are_refused(changes, words):
    with pytest.raises(InputError, match=words):
        joint(**changes).check(MODEL)


RIG = """
tank = [{name = "LT1", area = 50.0, rim = 40.0, level = 12.0},
        {name = "LT2", area = 40.0, rim = 40.0, level = 12.0, drain = 0.1}]
orifice = [{from = 1, to = 2, area = 0.1}]
pump = [{name = "P1", to = 1, gain = 8.0, high = 20.0, initial = 2.0}]
plant = {outputs = [2]}
controller = {kind = "pi", Kc = 0.5, Ti = 60.0}
reference = {initial = [12.0]}
[observer]
kind = "extended-kalman"
process = 1e-6
measurement = 4e-4
measured = [2]
coefficients = ["P1"]
coefficient_spread = 0.01
coefficient_walk = 1e-8
[values]
plant.pump_gain = [8.8]
observer.model.pump_gain = [8.0]
clock.dt = 1.0
clock.duration = 300.0
"""


@pytest.mark.extended
def test_a_rig_file_names_coefficients_by_its_own_names_and_a_run_has_their_estimates():
    case = rig.loads(RIG)
    run = jaxtank.simulate(case)
    assert run.coefficient_names == (("pump_gain[0]", "cm^3/(s V)"),)
    np.testing.assert_allclose(run.coefficients[-1], 8.8, rtol=0.01)
    assert run.to_json()["coefficients"]["pump_gain[0]"]["values"][-1] == run.coefficients[-1, 0]
    again = rig.loads(rig.dump(case)).loop.observer
    assert again.coefficients == ("pump_gain[0]",)
    assert parameters(again).keys() == parameters(case.loop.observer).keys()


@pytest.mark.slow
def test_a_loop_whose_filter_estimates_a_coefficient_has_a_steady_state_and_margins():
    case = rig.set_values(rig.loads(RIG), {"observer.coefficient_walk": 1e-4})
    (plateau,) = jaxtank.stability_margins(case)
    assert plateau.why == "" and plateau.stable and plateau.margins.sensitivity_peak > 1.0


KNOWN = """
units = ["m", "%"]
tank = [{area = 0.5, rim = 1.2, level = 0.5, drain = 0.0006}]
pump = [{to = 1, gain = 4e-5, high = 100.0, initial = 37.0}]
controller = {kind = "pi", Kc = 200.0, Ti = 200.0, bias = 37.0}
reference = {initial = [0.5]}
values = {"clock.dt" = 2.0, "clock.duration" = 40.0}
observer = {kind = "extended-kalman", process = [1e-6], measurement = [1e-6], spread = [1e-6]}
"""
WALK = ', coefficients = ["drain[0]"], coefficient_spread = 0.01, coefficient_walk = 1e-8}'
DRIFTING = KNOWN.replace("spread = [1e-6]}", "spread = [1e-6]" + WALK)


@pytest.mark.slow
def test_a_slow_drift_leaves_the_margins_that_the_known_model_has():
    """Readings weigh the same in the limit of no drift; its tiny variances are no kinks."""
    cases = [rig.loads(KNOWN), rig.loads(DRIFTING)]
    (known,), (drifting,) = (jaxtank.stability_margins(case) for case in cases)
    assert (known.why, drifting.why) == ("", "")
    peaks = [float(plateau.margins.sensitivity_peak) for plateau in (known, drifting)]
    np.testing.assert_allclose(*peaks, rtol=0.02)


def test_the_picture_of_estimates_has_a_panel_for_each_coefficient():
    case = rig.loads(DRIFTING)
    run = jaxtank.simulate(case)
    run = dataclasses.replace(run, x_hat=run.y)  # estimates that are the readings to the last bit
    axes = estimates(case.loop, case.clock, run)["estimates"].axes
    panels = {ax.get_title(): ax.lines[-1].get_ydata() for ax in axes if ax.get_visible()}
    for k, (name, _) in enumerate(run.coefficient_names):
        np.testing.assert_array_equal(panels[name], run.coefficients[:, k])

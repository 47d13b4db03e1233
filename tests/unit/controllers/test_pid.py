"""PID: anti-windup, setpoint weight and dead band against a scalar simulation of plain Python."""

import itertools
import math

import numpy as np
import pytest

import jaxtank
from jaxtank import rig
from jaxtank.core.records import Estimate, Tick

AREA, GAIN, LEAK, DT, SAMPLES = 2.0, 0.05, 0.03, 0.5, 240
LOW, HIGH = 0.0, 2.0

TANK = f"""
units = ["m", "-"]
reachable = false
tank = [{{ area = {AREA}, rim = 50.0, level = 1.0, inflow = {-LEAK} }}]
pump = [{{ gain = {GAIN}, to = 1, low = {LOW}, high = {HIGH}, initial = 0.6 }}]
plant = {{ gravity = 9.81, bottom = false }}
reference = {{ initial = [1.0], changes = [[10.0, 1, 2.5], [70.0, 1, 1.2]], ramp = 0.0 }}
values = {{ "clock.dt" = {DT}, "clock.duration" = {DT * (SAMPLES - 1)} }}
"""


def simulated(
    Kc,
    Ti=math.inf,
    Td=None,
    Tt=None,
    b=1.0,
    deadband=0.0,
    gap_gain=0.0,
    error_span=None,
    N=8.0,
    anti_windup="back-calculation",
):
    """(levels, inputs) of the tank, which integrates exactly, under the textbook's PID."""
    h, slow = 1.0, 1.0
    integral = 0.0 if math.isinf(Ti) else Kc * (1.0 - b) * h
    levels, inputs = [], []
    for k in range(SAMPLES):
        t = k * DT
        r = 1.0 if t < 10.0 else 2.5 if t < 70.0 else 1.2
        e = r - h
        inside = min(abs(e), deadband)
        e = math.copysign(gap_gain * inside + abs(e) - inside, e)
        e = e if error_span is None else e * abs(e) / error_span
        v = 0.6 + Kc * (e + (b - 1.0) * r) + integral
        if Td is not None:
            v -= Kc * min(N, Td / DT) * (h - slow)
            slow = h + (slow - h) * math.exp(-N * DT / Td)
        u = min(max(v, LOW), HIGH)
        if not math.isinf(Ti):
            rate = Kc / Ti * e
            if anti_windup == "back-calculation":
                rate += (u - v) / Tt
            elif anti_windup == "conditioned":
                rate += (u - v) / Ti
            elif (v > HIGH and Kc * e > 0.0) or (v < LOW and Kc * e < 0.0):
                rate = 0.0
            integral += DT * rate
        levels.append(h)
        inputs.append(u)
        h += DT * (GAIN * u - LEAK) / AREA
    return np.array(levels), np.array(inputs)


GAINS = {
    "P": {"Kc": 1.7},
    "PI": {"Kc": 1.7, "Ti": 20.0},
    "PID": {"Kc": 1.7, "Ti": 20.0, "Td": 3.0},
    "weighted": {"Kc": 1.7, "Ti": 20.0, "b": 0.3},
    "dead band": {"Kc": 1.7, "Ti": 20.0, "deadband": 0.2},
    "gap": {"Kc": 1.7, "Ti": 20.0, "deadband": 0.2, "gap_gain": 0.3},
    "squared": {"Kc": 1.7, "Ti": 20.0, "error_span": 0.8},
    "filtered": {"Kc": 1.7, "Ti": 20.0, "Td": 3.0, "N": 4.0},
}


@pytest.mark.extended_for("P-back-calculation")
@pytest.mark.parametrize(
    ("name", "anti_windup"),
    [
        (name, kind)
        for name, kind in itertools.product(GAINS, ("back-calculation", "clamping", "conditioned"))
        if name != "P" or kind == "back-calculation"
    ],
)
def test_a_loop_is_that_of_a_scalar_simulation(name, anti_windup):
    gains = dict(GAINS[name], anti_windup=anti_windup)
    if anti_windup == "back-calculation" and name != "P":
        gains["Tt"] = 7.0
    table = {"kind": "pid", **gains, "bias": 0.6}
    case = rig.loads(f"{TANK}controller = {rig.toml(table)}")
    run = jaxtank.simulate(case.loop, case.clock)
    levels, inputs = simulated(**gains)
    np.testing.assert_allclose(np.asarray(run.x)[:, 0], levels, rtol=0, atol=1e-11)
    np.testing.assert_allclose(np.asarray(run.applied)[:, 0], inputs, rtol=0, atol=1e-10)
    assert inputs.max() == HIGH and inputs.min() == LOW


def test_a_setpoint_weight_needs_an_integral():
    with pytest.raises(jaxtank.InputError, match=r"controller\.b"):
        rig.loads(f'{TANK}controller = {{ kind = "pid", Kc = 1.0, b = 0.5 }}')


@pytest.mark.parametrize(("gain", "warned"), [(1.0, False), (-1.0, True)])
def test_a_gain_of_the_wrong_sign_is_a_warning(gain, warned):
    case = rig.loads(f'{TANK}controller = {{ kind = "pid", Kc = {gain} }}')
    assert any("Kc" in sentence for sentence in rig.case_warnings(case)) is warned


@pytest.mark.parametrize(("N", "most"), [(0.5, 1.6), (2.0, 1.02), (1e4, 1.0)])
def test_the_derivative_of_a_ramp_is_that_of_Td_however_short_the_filter(N, most):
    """With the lag as long as the sample it acts as one of 1.58 Td."""
    Td, slope = 0.5 * DT, 0.3
    text = f'{TANK}controller = {{ kind = "pid", Kc = 1.7, Td = {Td}, N = {N} }}'
    controller = rig.loads(text).loop.controller
    state = controller.init((0.0,), (0.0,))
    for k in range(200):
        level = (k * DT * slope,)
        tick = Tick(t=k * DT, r=level, dr=(0.0,), ddr=(0.0,), dt=DT)
        (v,), state = controller.step(state, tick, Estimate(x=level))
    acts = (controller.bias[0] - v) / (1.7 * slope)
    assert Td * (1.0 - 1e-9) <= acts <= most * Td * (1.0 + 1e-9)

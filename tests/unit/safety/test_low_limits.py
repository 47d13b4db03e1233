"""Low limits on levels: closed forms, attacks by a simulation of its own, and each condition broken
by 10 %.
"""

import dataclasses
import math

import numpy as np
import pytest
from helpers import command
from safety_attacks import attack, of, sensor_of
from scipy.integrate import solve_ivp

from jaxtank import rig
from jaxtank.core.errors import InputError
from jaxtank.instruments.actuators import PumpBank
from jaxtank.plants import network
from jaxtank.safety import design
from tuning.report.safety import certificates

W = math.sqrt(2 * 981.0)
HOLD, LOW = 0.5, 4.0


def tank(gain=8.0, **pumps):
    """A tank with a pump of `gain` [cm^3/(s V)]."""
    plant = network(area=[20.0], drain=[0.3], feeds=[(0, None)], pump_gain=[gain], rim=[30.0])
    return plant, PumpBank(low=[0.0], high=[12.0], **pumps)


def designed(plant, actuator, **given):
    given = {"widths": of(plant, 0.1), "low": np.full(plant.tanks, LOW)} | given
    return design(plant, actuator, sensor_of(plant), HOLD, **given)


def falls_below(plant, actuator, found, eps=0.0):
    how = {"seconds": 100, "count": 24, "eps": eps, "down": True}
    _, lowest = attack(plant, actuator, found, HOLD, 0.1, **how)
    return lowest < LOW - 1e-6


def test_one_tank_with_scipy_and_the_floor_written_apart():
    """The worst plant (largest drain, weakest pump) under a command of 0 V comes to rest at L."""
    plant, actuator = tank()
    found, _ = designed(plant, actuator)
    kappa, h = float(found.rate[0]), 12.0
    c_max, b_min = 0.33 * W / 20.0, 7.2 / 20.0
    for _ in range(80):
        floor = max(0.0, c_max * math.sqrt(h) - kappa * (h - LOW)) / b_min
        u, acts = found.apply(actuator, (0.0,), None, (h,), HOLD)
        assert float(u[0]) == pytest.approx(floor, rel=1e-12)
        assert acts == (floor > 0.0)
        field = lambda t, x, u=floor: [(7.2 * u - 0.33 * W * math.sqrt(max(x[0], 0.0))) / 20.0]
        h = solve_ivp(field, (0.0, HOLD), [h], rtol=1e-10, atol=1e-12).y[0, -1]
        assert h >= LOW - 1e-9
    assert h == pytest.approx(LOW, abs=1e-3)


def test_the_strength_of_the_pump_decides_and_its_lack_is_found():
    """b_min u_high >= c_max s(L), worked out by hand; 10 % less and the level falls below."""
    gain = 0.33 * W * math.sqrt(LOW) / 12.0 / 0.9
    for factor, proved in ((1.0001, True), (0.9, False)):
        plant, actuator = tank(gain * factor)
        found, (row,) = designed(plant, actuator)
        assert row.low_certified == proved
        assert falls_below(plant, actuator, found)[0] != proved
    leaves, enters = 0.33 * W * 2.0 / 20.0, 0.9 * 0.33 * W * 2.0 / 20.0
    assert f"{leaves:.3g} cm/s may leave" in row.low_reason
    assert f"{enters:.3g} enter for certain" in row.low_reason


BROKEN = {
    "least for largest drain": lambda f: dataclasses.replace(
        f, most=dataclasses.replace(f.most, drain=f.least.drain)
    ),
    "strongest for weakest pump": lambda f: dataclasses.replace(
        f, least=dataclasses.replace(f.least, pump_gain=f.most.pump_gain)
    ),
    "kappa T = 1.1": lambda f: dataclasses.replace(f, rate=np.array([1.1 / HOLD])),
    "no band": lambda f: dataclasses.replace(f, band=np.zeros(1)),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_the_floor_counts_on_is_needed(name):
    plant, actuator = tank()
    eps = 0.1 if name == "no band" else 0.0
    found, (row,) = designed(plant, actuator, band=eps, rate=1.0 / HOLD)
    assert row.low_certified and not falls_below(plant, actuator, found, eps).any()
    assert falls_below(plant, actuator, BROKEN[name](found), eps).any()


def test_reasons_name_the_condition_that_fails():
    plant, actuator = tank()
    pumps = lambda **changes: dataclasses.replace(actuator, **changes)
    reason = lambda a, **given: designed(plant, a, **given)[1][0].low_reason
    assert reason(actuator) == "Low limits"
    assert reason(pumps(delay=HOLD)) == "not proved with dead time or lag"
    assert reason(pumps(lag=[1.0])) == "not proved with dead time or lag"
    assert reason(pumps(dead_zone=[1.0])) == "not proved with a dead zone"
    assert reason(actuator, start=[3.0]) == "start at 3 cm, below the low limit"
    assert reason(actuator, rate=2.2) == "kappa T = 1.1 above 1"
    assert reason(actuator, draws=True) == "not proved with inflow pulses that draw liquid"
    assert reason(actuator, low=[29.0], band=0.6, rate=2.0) == (
        "floor above cap: the upper limit is kept first"
    )
    with pytest.raises(
        InputError, match=r"safety_filter.low\[0\] = 31 cm: must be from 0 to below"
    ):
        designed(plant, actuator, low=[31.0])


def test_where_floor_and_cap_exclude_each_other_the_upper_limit_is_kept():
    plant, actuator = tank()
    given = {"low": [29.0], "band": 0.6, "rate": 2.0}
    found, (row,) = designed(plant, actuator, **given)
    assert row.certified and not row.low_certified
    for down in (False, True):
        how = {"seconds": 100, "eps": 0.6, "down": down, "count": 12}
        highest, _ = attack(plant, actuator, found, HOLD, 0.1, **how)
        assert highest[0] <= 30.0 + 1e-9


def test_a_tank_without_a_pump_is_kept_by_the_low_limit_above_it():
    """c_min s(L_above) >= c_max s(L): the largest L by hand, and 10 % above it."""
    plant = network(
        area=20.0, drain=[0.3, 0.0], links=[(1, 0)], orifice=[0.3], feeds=[(1, None)],
        pump_gain=[12.0], rim=[40.0, 30.0],
    )  # fmt: skip
    actuator = PumpBank(low=[0.0], high=[12.0])
    above = 6.0
    for share, proved in ((0.9999, True), (1.1, False)):
        low = [share * (0.9 / 1.1) ** 2 * above, above]
        found, rows = designed(plant, actuator, low=low, limit=[40.0, 20.0])
        assert [r.low_certified for r in rows] == [proved, True]
        how = {"seconds": 150, "count": 24, "down": True}
        _, lowest = attack(plant, actuator, found, HOLD, 0.1, **how)
        assert np.all(lowest >= np.array(low) - 1e-9) == proved


def test_two_pumps_into_one_tank_share_the_floor():
    plant = network(
        area=[20.0], drain=[0.5], feeds=[(0, None)] * 2, pump_gain=[5.0, 3.0], rim=[30.0]
    )
    actuator = PumpBank(low=[0.0, 0.0], high=[12.0, 12.0])
    found, (row,) = designed(plant, actuator)
    assert row.low_certified and not falls_below(plant, actuator, found).any()
    u, acts = found.apply(actuator, (0.0, 0.0), None, (LOW,), HOLD)
    needed = 0.55 * W * math.sqrt(LOW)
    assert 0.9 * (5.0 * u[0] + 3.0 * u[1]) == pytest.approx(needed, rel=1e-12) and acts == 1.0
    u, acts = found.apply(actuator, (9.0, 8.0), None, (LOW,), HOLD)
    assert [float(v) for v in u] == [9.0, 8.0] and acts == 0.0


RIG = """
case = "calofir/backstepping"
[values]
clock.duration = 300.0
[safety_filter]
low = [0.1, 0.0]
"""


def test_a_rig_file_and_the_command_take_low_limits(tmp_path):
    case = rig.loads(RIG)
    assert rig.loads(rig.dump(case)).loop.safety_filter.low.tolist() == [0.1, 0.0]
    path = tmp_path / "rig.toml"
    path.write_text(RIG)
    rows = certificates(case)
    assert rows[0]["low"]["limit"] == 0.1 and rows[1]["low"] is None
    words = [str(path), "--set", "safety_filter.low=[0.7,0]"]
    code, _, err = command("simulate", *words)
    assert code == 2 and "safety_filter.low[0] = 0.7 m: must be" in err.splitlines()[-1]
    limited = case.replace(limits={"min_level": 0.05}, safety=None).with_safety_filter()
    assert limited.loop.safety_filter.low.tolist() == [0.05, 0.05]

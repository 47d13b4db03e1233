"""Setpoints that the plant can hold and its controller or safety filter does not: runs stay off
them, and the advice says why.
"""

import numpy as np
import pytest

import jaxtank
from jaxtank import rig
from tuning.report import advice
from tuning.report.advice import blocked_setpoints

ONE = """
units = ["m", "m^3/h"]
dt = 5.0
duration = "1 h"
tank = [{ name = "TK", area = 1.5, rim = 2.0, level = 1.0, drain = "8 cm^2" }]
pump = [{ name = "P1", to = "TK", high = 40.0 }]
sensor = [{ name = "LT", tank = "TK", unit = "%", span = [0.2, TOP] }]
controller = { kind = "pi", Kc = "3 %/%", Ti = 300.0 }
reference = { initial = ["1 m"], changes = [["10 min", 1, "1.45 m"]] }
limits = { max_level = [1.7] }
"""
TWO = """
units = ["m", "%"]
dt = 2.0
duration = "2 h"
tank = [
  { name = "A", area = 0.5, rim = 1.2, level = 0.4 },
  { name = "B", area = 0.5, rim = 1.2, drain = 4e-4, level = 0.4 },
]
orifice = [{ from = "A", to = "B", area = 4e-4 }]
pump = [{ name = "P", gain = 3e-5, to = "A", high = 100.0 }]
plant = { outputs = ["B"], gravity = 9.81 }
controller = { kind = "override", Kc = 300.0, Ti = 300.0, limited = ["A"], KEYS }
reference = { initial = [0.4], changes = [[60.0, 1, 0.6]] }
"""


@pytest.mark.extended_for("1.5-1.45")
@pytest.mark.parametrize(("top", "level"), [(1.5, 1.45), (2.0, None)])
def test_a_safety_filter_that_keeps_a_level_off_its_setpoint_is_named(top, level):
    case = rig.loads(ONE.replace("TOP", str(top))).with_safety_filter()
    run = jaxtank.simulate(case)
    off = abs(float(run.x[-1, 0]) - 1.45)
    sentence = advice.of_nominal_plant(case)
    if level is None:
        assert off < 0.01 and not blocked_setpoints(case)
        assert sentence.startswith(advice.REACHABLE)
        return
    needed = 8e-4 * np.sqrt(2.0 * 9.81 * level) * 3600.0
    assert off > 0.1
    assert sentence.startswith(f"{advice.BLOCKED}: setpoints 1.45 m need {needed:.4g} m^3/h of P1")
    assert "which the safety filter sets to 0 m^3/h" in sentence
    assert not blocked_setpoints(case.without_safety_filter())


def test_a_pump_without_a_limit_and_a_filter_are_told_of_too():
    case = rig.loads(ONE.replace("TOP", "1.5")).with_safety_filter()
    endless = case.replace(loop=jaxtank.with_values(case.loop, {"actuator.high": [np.inf]}))
    assert blocked_setpoints(endless) == blocked_setpoints(case)


def test_a_limit_that_is_scheduled_is_not_taken_for_one():
    text = TWO.replace("KEYS", 'limit = 0.5, limit_Kc = 300.0, select = "low"')
    schedule = 'schedule = { gains = ["controller.limit[0]"], variable = "r1", knots = [0.4, 0.6] }'
    values = 'values = { "controller.values" = [[0.5, 0.9]] }'
    assert not blocked_setpoints(rig.loads(f"{text}{schedule}\n{values}"))


@pytest.mark.parametrize(("high", "level"), [(0.5, 0.5), (0.7, 0.6)])
def test_a_limit_of_the_inner_setpoint_of_a_cascade_in_the_way_is_named(high, level):
    cascade = f'kind = "cascade", inner = ["A"], inner_Kc = 900.0, inner_high = [{high}]'
    text = TWO.replace('kind = "override"', cascade).replace(
        'limited = ["A"], KEYS', "inner_Ti = 99"
    )
    case = rig.loads(text.replace("Kc = 300.0, Ti", "Kc = 2.0, Ti"))
    sentence = advice.of_nominal_plant(case)
    assert float(jaxtank.simulate(case).x[-1, 1]) == pytest.approx(level, abs=0.01)
    assert sentence.startswith(advice.REACHABLE if high > 0.6 else advice.BLOCKED)
    assert high > 0.6 or "need 0.6 m in A, which the controller keeps at or below 0.5 m" in sentence


def test_the_opening_of_a_valve_that_a_setpoint_needs_has_no_unit():
    """3 m^3/h through 6 cm^2 under 1 m: 0.314 of the valve, which is open by 0.4 at least."""
    case = rig.loads("""
    units = ["m", "m^3/h"]
    tank = [{ area = 0.5, rim = 2.0, level = 1.0, inflow = "3 m3/h" }]
    valve = [{ name = "V", from = 1, area = "6 cm^2", low = 0.4, initial = 0.4 }]
    controller = { kind = "pi", Kc = -1.0, Ti = 100.0 }
    reference = { initial = [1.0] }
    """)
    assert "takes 0.314 in V, lower limit 0.4." in advice.of_nominal_plant(case)


@pytest.mark.parametrize(
    ("keys", "side"),
    [
        ('limit = 0.5, limit_Kc = 300.0, select = "low"', "at or below 0.5 m"),
        ('limit = 0.5, limit_Kc = -300.0, select = "high"', "at or below 0.5 m"),
        ('limit = 0.7, limit_Kc = 300.0, select = "high"', "at or above 0.7 m"),
        ('limit = 0.9, limit_Kc = 300.0, select = "low"', None),
    ],
)
def test_a_limit_of_an_override_in_the_way_of_a_setpoint_is_named(keys, side):
    """Both openings are alike: tank A stands as high as tank B."""
    case = rig.loads(TWO.replace("KEYS", keys))
    sentence = advice.of_nominal_plant(case)
    off = abs(float(jaxtank.simulate(case).x[-1, 1]) - 0.6)
    assert off < 0.01 if side is None else off > 0.05
    if side is None:
        assert sentence.startswith(advice.REACHABLE)
    else:
        assert (
            sentence.startswith(advice.BLOCKED)
            and f"in A, which the controller keeps {side}" in sentence
        )
    # beside what no gains could hold either
    both = advice.of_nominal_plant(rig.set_values(case, {"plant.rim[1]": 0.55}))
    assert both.startswith(advice.BEYOND) and (advice.BLOCKED in both) is (side is not None)

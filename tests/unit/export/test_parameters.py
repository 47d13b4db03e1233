"""Parameters of exported C, manual operation, and code of the plant."""

import functools

import jax
import numpy as np
import pytest
from helpers import SERIES, Compiled, needs_gcc, signals_of

import jaxtank
from jaxtank import presets, rig
from jaxtank.core.tree import get_value
from jaxtank.export import printer

SAMPLES = 1500


@functools.cache
def shortened(name):
    """A preset case of 1,500 samples without noise and delay, from other levels."""
    case = presets.find(name)
    values = {"clock.duration": (SAMPLES - 1) * case.clock.dt, "sensor.noise": 0.0}
    levels = 0.98 * np.asarray(case.loop.x0) + 0.01  # away from the first setpoint
    return rig.set_values(case, {**values, "actuator.delay": 0.0, "x0": levels.tolist()})


@pytest.mark.extended
@pytest.mark.slow_for("cascaded/pi")
@needs_gcc
@pytest.mark.parametrize(
    "name",
    [
        "cascaded/pi",
        "gouta2015/backstepping",
        *(
            pytest.param(n, marks=pytest.mark.slow)
            for n in (
                *("calofir/backstepping", "gouta2015/ngpc", "gouta2022/chadpc"),
                *("gouta2022/fopi-ff", "gouta2022/pid-ff", "johansson/pi-minimum"),
                *("khalid/gpc-nc2-constrained", "khalid/laguerre", "mirakhorli/hybrid"),
                *("mirakhorli/lqi", "mirakhorli/smc"),
            )
        ),
    ],
)
def test_a_changed_gain_gives_the_inputs_of_a_simulation_with_it(name, tmp_path):
    """Of every tunable gain, within 1e-9 of the pumps' range, without compiling again."""
    case = shortened(name)
    code, signals, default = Compiled(case, tmp_path), signals_of(case), None
    for gain in ["", *(n for n in case.free if n.split(".")[0] in ("controller", "observer"))]:
        values = {gain: 0.97 * np.asarray(get_value(case.loop, gain))} if gain else {}
        loop = jaxtank.with_values(case.loop, values)
        run = jax.tree.map(np.asarray, jaxtank.simulate(loop, case.clock))
        base = gain.split("[")[0]
        p = code.set({base: get_value(loop, base)} if gain else {})
        reach = max(1.0, float(np.abs(run.applied).max()))
        inputs = code.run(case, run, signals, p)
        np.testing.assert_allclose(inputs, run.applied, atol=1e-9 * reach, rtol=0, err_msg=gain)
        if gain:
            assert np.abs(run.applied - default).max() > 1e-6, gain
        else:
            default = run.applied


@pytest.mark.extended
@needs_gcc
def test_a_gain_may_change_between_two_samples(tmp_path):
    """A new controller of the changed gain, in the same state, goes on alike."""
    case = shortened("mirakhorli/sfc")
    code, (r, dr, ddr) = Compiled(case, tmp_path), signals_of(case)
    y = 0.8 * np.ones(4) * r[0].max()
    other = code.set({"controller.K": 1.5 * np.asarray(case.loop.controller.K)})
    code.init()
    first = code.step(0.0, y, r[0], dr[0], ddr[0])[:2]
    later = code.step(0.1, y, r[0], dr[0], ddr[0], p=other)[:2]
    code.init(p=other)
    np.testing.assert_array_equal(later, code.step(0.1, y, r[0], dr[0], ddr[0], p=other)[:2])
    assert np.abs(later - first).max() > 1e-3


PI = {"kind": "pi", "Kc": 2.0, "Ti": 30.0}
TABLES = [
    PI,
    {"kind": "pid", "Kc": 2.0, "Ti": 30.0, "Td": 2.0, "b": 0.4, "anti_windup": "clamping"},
    {"kind": "pid", "Kc": 2.0, "Ti": 30.0, "order": 0.8},
    {"kind": "cascade", "Kc": 3.0, "Ti": 60.0, "inner": [1], "inner_Kc": 1.5, "inner_Ti": 15.0},
    {"kind": "cascade", "Kc": 3.0, "Ti": 60.0, "inner": [1], "inner_Kc": 1.5},
    {"kind": "cascade", "Kc": 3.0, "inner": [1], "inner_Kc": 1.5, "inner_Ti": 15.0},
    {"kind": "override", "Kc": 2.0, "Ti": 40.0, "limited": [1], "limit": 1.6, "limit_Kc": 3.0}
    | {"limit_Ti": 10.0},
    {"kind": "reference-governor", "Kc": 2.0, "Ti": 30.0, "limit": [9.0, 2.0], "horizon": 60.0},
]


def bump(case, code, y, r, manual):
    """Inputs of the last manual sample and of the first automatic one after it, alike otherwise."""
    code.init()
    zero = np.zeros_like(r)
    for k in range(5):
        code.step(k, y * (1.0 + 0.1 * k), r, zero, zero)
    for k in range(40):  # until a derivative part has settled
        last = code.step(5 + k, y, r, zero, zero, manual=manual)
    m = case.loop.plant.pumps
    return last[:m], code.step(45, y, r, zero, zero)[:m]


@needs_gcc
@pytest.mark.parametrize(
    "table", [TABLES[0], *(pytest.param(t, marks=pytest.mark.slow) for t in TABLES[1:])]
)
def test_the_return_from_manual_operation_has_no_bump(tmp_path, table):
    case = rig.loads(f"{SERIES}controller = {rig.toml(table)}").replace(name="law")
    assert case.loop.controller.bumpless
    code, y, r = Compiled(case, tmp_path), np.array([1.1, 0.9]), np.array([1.0])
    last, first = bump(case, code, y, r, np.array([0.37]))
    np.testing.assert_allclose(last, 0.37)  # and not what the controller would apply
    np.testing.assert_allclose(first, 0.37, atol=1e-12)
    limited, _ = bump(case, code, y, r, np.array([1.7]))
    np.testing.assert_allclose(limited, 1.0)
    if table is PI:  # goes on as a PI from there: dt Kc/Ti e a sample
        _, first = bump(case, code, y, r, np.array([0.37]))
        second = code.step(46, y, r, np.zeros(1), np.zeros(1))[0]
        np.testing.assert_allclose(second - first[0], 0.5 * 2.0 / 30.0 * 0.1, atol=1e-12)


@pytest.mark.slow
@needs_gcc
def test_lqi_returns_from_manual_operation_without_a_bump(tmp_path):
    case = shortened("mirakhorli/lqi")
    code, y = Compiled(case, tmp_path), np.array([12.0, 12.5, 3.0, 2.0])
    last, first = bump(case, code, y, np.array([12.0, 12.0]), np.array([4.0, 4.5]))
    np.testing.assert_allclose(last, [4.0, 4.5])
    np.testing.assert_allclose(first, [4.0, 4.5], atol=1e-9)


PAIR = """
tank = [{ area = 100.0, drain = 0.3, rim = 60.0, level = 12.17 },
    { area = 80.0, drain = 0.5, rim = 60.0, level = 5.04 }]
orifice = [{ from = 1, to = 2, area = 0.2 }]
pump = [{ to = 1, gain = 20.0, high = 10.0, initial = 3.86 },
    { to = 2, gain = 20.0, high = 10.0, initial = 0.94 }]
plant = { outputs = [1, 2] }
reference = { initial = [12.17, 5.04] }
values = { "clock.dt" = 1.0, "clock.duration" = 10.0 }
[controller]
kind = "lqi"
Q = [1.0, 1.0, 0.7445507292383455, 0.7445507292383455]
R = [12.05951434, 0.12303419]
operating_point = [20.0, 15.0]
"""


@pytest.mark.extended_for("directional-True")
@pytest.mark.slow_for("frozen-False")
@needs_gcc
@pytest.mark.parametrize(("anti_windup", "returns"), [("directional", True), ("frozen", False)])
def test_lqi_returns_after_a_pump_was_off_by_hand(tmp_path, anti_windup, returns):
    """Levels by Euler's rule, in a hundredth of a sample."""
    case = rig.loads(PAIR + f'anti_windup = "{anti_windup}"\n').replace(name="law")
    code, r = Compiled(case, tmp_path), np.array([12.17, 5.04])
    code.init()
    zero, levels = np.zeros(2), r.copy()
    for k in range(2000):
        hand = np.array([10.0, 0.0]) if 50 <= k < 150 else None
        u = code.step(k, levels, r, zero, zero, **({} if hand is None else {"manual": hand}))[:2]
        for _ in range(100):
            out = np.sqrt(2.0 * 981.0 * np.maximum(levels, 0.0))
            flows = 20.0 * u - [0.5 * out[0], 0.5 * out[1] - 0.2 * out[0]]
            levels = levels + 0.01 * flows / [100.0, 80.0]
    assert bool(np.abs(levels - r).max() < 0.01) is returns


@needs_gcc
def test_a_controller_without_memory_of_its_own_may_jump_and_says_so(tmp_path):
    case = shortened("mirakhorli/sfc")
    code, y = Compiled(case, tmp_path), np.array([9.0, 9.0, 1.0, 1.0])
    last, first = bump(case, code, y, np.array([12.0, 12.0]), np.array([4.0, 4.5]))
    np.testing.assert_allclose(last, [4.0, 4.5])
    assert np.abs(first - last).max() > 0.1
    assert "may jump" in (tmp_path / "law.h").read_text()


def test_inputs_are_listed_in_their_order_where_any_has_a_name():
    plant = rig.loads("""
tank = [{ area = 50.0, rim = 20.0, drain = 0.6, level = 5.0 }]
pump = [{ gain = 20.0, to = 1, high = 20.0 }, { name = "P7", gain = 20.0, to = 1, high = 20.0 }]
controller = { kind = "pi", Kc = 1.0, Ti = 50.0, lead = [1] }
""").loop.plant
    (line,) = (line for line in printer._order(plant) if line.startswith("u:"))
    assert line.endswith("P7")

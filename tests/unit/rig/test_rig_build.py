"""Rigs described tank by tank in a rig file."""

import dataclasses
import tomllib

import jax
import numpy as np
import pytest
from helpers import RIGS, assert_same_case
from scipy.integrate import solve_ivp

import jaxtank
import tuning
from jaxtank import controllers, presets, rig, with_values
from jaxtank.core.errors import InputError
from jaxtank.plants.network import network
from jaxtank.rig.components import section_of
from jaxtank.rig.network import _flow_gain
from tuning.cli import main

FOUR = """
tank = [
    { name = "left", area = 21.2, rim = 30.0, drain = 0.18, level = 3.0 },
    { name = "right", area = 21.2, rim = 30.0, drain = 0.18, level = 3.0 },
    { name = "upper left", area = 21.2, rim = 30.0, level = 1.0 },
    { name = "upper right", area = 21.2, rim = 30.0, level = 1.0 },
]
orifice = [{ from = "upper left", to = "left", area = 0.18 }, { from = 4, to = 2, area = 0.18 }]
pipe = [{ between = ["left", "right"], area = 0.05 }]
pump = [
    { gain = 7.7, to = ["left", "upper right"], split = 0.4, high = 12.0 },
    { gain = 7.7, to = ["right", "upper left"], split = 0.34, high = 12.0 },
]
controller = { kind = "pid", Kc = [0.5, 0.6], Ti = 60.0 }
reference = { initial = [3.0, 3.0], changes = [[20.0, 1, 4.0], [20.0, 2, 3.5]], ramp = 30.0 }
"""

GPC = {"kind": "gpc", "operating_point": [4.0, 3.0, 2.0, 2.0], "q": 1.0, "du_limit": 1.0}
GPC |= {"u_low": 0.0, "u_high": 10.0}


def table(text=FOUR, **changes):
    return {**tomllib.loads(text), **changes}


def test_two_tanks_against_scipy():
    """The cascaded two-tank loop with its PI law written out, held between samples, by LSODA."""
    case = rig.load(RIGS / "two_tanks.toml")
    case = rig.set_values(case, {"controller.Kc": 0.4, "clock.duration": 600.0})
    run = jax.tree.map(np.asarray, jaxtank.simulate(case.loop, case.clock))
    k1, k3, k4, integral, x, u0 = (
        0.05,
        0.05,
        0.06,
        0.0,
        np.array([4.0, 4.0]),
        float(case.loop.controller.bias[0]),
    )
    assert u0 == pytest.approx(1.7)  # `initial` of the file, 2 % above the steady 1.667 V
    for k in range(len(run.t)):
        np.testing.assert_allclose(run.x[k], x, atol=1e-5)
        t = 4.0 * k
        r = 4.0 if t < 40 else 7.0 if t < 500 else 3.0
        e = r - x[1]
        v = u0 + 0.4 * e + integral
        u = min(max(v, 0.0), 10.0)
        integral += 4.0 * (0.4 / 200.0 * e + (u - v) / 30.0)
        assert run.u[k, 0] == pytest.approx(u, abs=1e-5)

        def rate(_, h, u=u):
            q = np.sqrt(np.maximum(h, 0.0))
            return [k4 * u - k1 * q[0], k1 * q[0] - k3 * q[1]]

        x = np.minimum(
            solve_ivp(rate, (0, 4), x, method="LSODA", rtol=1e-10, atol=1e-10).y[:, -1], 10.0
        )
    assert run.x[:, 0].max() < 10.0


@pytest.mark.extended
def test_names_numbers_and_shares_make_the_topology():
    plant = rig.from_table(table()).loop.plant
    assert plant.links == ((2, 0), (3, 1))
    assert plant.pipes == ((0, 1),) and plant.feeds == ((0, 3), (1, 2))
    assert plant.outputs == (0, 1) and plant.units == ("cm", "V")
    np.testing.assert_array_equal(plant.split, [0.4, 0.34])
    np.testing.assert_array_equal(plant.drain, [0.18, 0.18, 0.0, 0.0])


@pytest.mark.parametrize("source", ["two_tanks", "watertank", None])
def test_read_back_as_written(source, tmp_path):
    case = rig.from_table(table()) if source is None else rig.load(RIGS / f"{source}.toml")
    rig.save(case, tmp_path / "rig.toml")
    again = rig.load(tmp_path / "rig.toml")
    assert_same_case(again, case)
    assert rig.dump(again) == rig.dump(case)


@pytest.mark.slow
def test_the_step_task_of_the_watertank_is_met(tmp_path):
    """Rise below 2.5 s, settling below 20 s, overshoot below 5 %, which the starting gains miss."""
    case = rig.load(RIGS / "watertank.toml")
    result = tuning.tune(case, tuning.Options(starts=2, screening=32, validation=0))
    measures = result.measures
    assert result.success and measures["before"]["overshoot_percent"][0] > 5.0
    assert measures["before"]["rise_time"][0] > 2.5
    run = jax.tree.map(np.asarray, jaxtank.simulate(result.tuned.loop, result.tuned.clock))
    h, t = run.x[:, 0], run.t
    assert h.max() <= 2.05 + 1e-6
    assert t[np.argmax(h >= 1.9)] - t[np.argmax(h >= 1.1)] < 2.5 + 0.06
    assert np.all(np.abs(h[t > 21.0] - 2.0) < 0.05)


PUMP = {"gain": 1.0, "to": 1, "high": 1.0}
PID = {"kind": "pid", "Kc": 1.0, "Ti": 1.0}
SLIDING = {"kind": "sliding-mode", "surface": 0.1, "ks": [0.1, 0.2], "phi": 0.1}
WRONG = [
    ({"tank": []}, "at least one"),
    ({"pump": [PUMP | {"to": "middle"}]}, "'middle'; nearest"),
    ({"pump": [PUMP | {"to": 7}]}, "from 1 to 4"),
    ({"pump": [{"gain": 1.0, "to": 1}]}, r"pump 1 needs high \[V\]: upper limit"),
    ({"pump": [PUMP | {"gain": True}]}, "gain = True"),
    ({"pump": [PUMP | {"gian": 1.0}]}, "unknown key of \\[\\[pump\\]\\] 'gian'; nearest: gain"),
    ({"pipe": [{"between": [1, 1], "area": 0.1}]}, "two different tanks"),
    ({"controller": {}}, "needs kind"),
    ({"controller": {"kind": "pdi"}}, "unknown controller kind 'pdi'; nearest: pi, pid"),
    ({"controller": PID | {"K": 2.0}}, "unknown key of \\[controller\\] 'K'"),
    ({"controller": PID | {"Kc": "much"}}, "controller.Kc = 'much': must be a number"),
    ({"controller": PID | {"Kc": True}}, "controller.Kc = True: must be a number"),
    ({"controller": {**GPC, "r_w": [0.1, 0.2]}}, r"controller.r_w = .*: must be one number"),
    ({"controller": SLIDING}, r"controller.ks = \[0.1, 0.2\]: must be one number"),
    ({"controller": PID | {"Ti": -1.0}}, "controller.Ti\\[0\\] = -1"),
    ({"controller": PID | {"Kc": 0.0}}, "controller.Kc = .*must not be 0"),
    ({"plant": {"outputs": [1]}}, "split-range"),
    ({"plant": {"outputs": [1, 9]}}, "from 1 to 4"),
    ({"plant": {"overflow": 1}}, "true or false"),
    ({"units": ["yd", "V"]}, "'yd' is no unit of a level"),
    ({"units": ["cm", "V\x1b[31m\n"]}, "units: entry = .*: must be a text of printable characters"),
    ({"case": "gouta2015/ngpc"}, "leave out case"),
    ({"observer": {"kind": "luenberger"}}, "unknown observer kind"),
]


@pytest.mark.parametrize(("changes", "words"), WRONG)
def test_what_is_wrong_is_named(changes, words):
    with pytest.raises(InputError, match=words):
        rig.from_table(table(**changes))


def test_neither_case_nor_tanks(tmp_path, capsys):
    (tmp_path / "rig.toml").write_text("[values]\n")
    assert main.main(["simulate", str(tmp_path / "rig.toml")]) == 2
    assert "[[tank]]" in capsys.readouterr().err


@pytest.mark.extended
def test_a_controller_of_a_paper_on_a_rig_of_ones_own():
    """Backstepping of gouta2015 on its own rig, written tank by tank: the run of the preset."""
    case = presets.find("gouta2015/backstepping")
    changes = [[20.0, 1, 8.0], [20.0, 2, 6.0]]
    reference = {"initial": [3.0, 3.0], "changes": changes, "ramp": 60.0}
    clock = {"clock.dt": 0.1, "clock.duration": 50.0}
    tanks = tomllib.loads(rig.dump(case, tankwise=True))
    built = rig.set_values(rig.from_table({**tanks, "reference": reference}), clock)
    preset = {"case": "gouta2015/backstepping", "values": clock, "reference": reference}
    same = rig.from_table(preset)
    ours, theirs = (np.asarray(jaxtank.simulate(c.loop, c.clock).x) for c in (built, same))
    np.testing.assert_array_equal(ours, theirs)


def test_gravity_and_laminar_zone_of_a_network_are_those_of_its_unit():
    one = {"area": 1.0, "drain": 1.0, "pump_gain": 1.0, "feeds": [(0, None)], "rim": 1.0}
    file = 'units = ["{}", "V"]\n[[tank]]\narea = 1e6\nrim = 1.0\ndrain = 1e-3\n'
    file += '[[pump]]\ngain = 1.0\nto = 1\nhigh = 1.0\n[controller]\nkind = "open-loop"\n'
    for unit, gravity, knee in (
        ("cm", 981.0, 0.01),
        ("m", 9.81, 1e-4),
        ("mm", 9810.0, 0.1),
        ("ft", 981.0 / 30.48, 0.01 / 30.48),
    ):
        for plant in (network(**one, units=(unit, "V")), rig.loads(file.format(unit)).loop.plant):
            assert float(plant.gravity) == pytest.approx(gravity, rel=1e-15)
            assert plant.knee == pytest.approx(knee, rel=1e-15)
        floors = section_of("controller", "two-tank-backstepping", (unit, "V"))
        for name in ("level_floor", "difference_floor"):
            assert floors[name].default == pytest.approx(knee, rel=1e-15)
    for unit, why in (
        ("V", 'plant.gravity: must be given for a rig whose length is "V"'),
        ("furlong", "'furlong' is unknown: must be one of m, dm, cm"),
    ):  # no length, or none that is known: refused in both
        with pytest.raises(InputError, match=why):
            network(**one, units=(unit, "V"))
        with pytest.raises(InputError, match=why):
            rig.loads(file.format(unit))
    assert network(**one, units=("V", "V"), gravity=0.5).knee == 0.01
    with pytest.raises(InputError, match="at least 1e-15 m"):
        network(**one, units=("m", "V"), knee=0.0)


SPILLING = """
plant = {{ overflow = true }}
tank = [
    {{ area = 10.0, rim = 5.0, drain = 0.01, level = 5.0 }},
    {{ area = 10.0, rim = 500.0, drain = 0.01 }},
    {{ area = 10.0, rim = 500.0, drain = 0.01 }},
]
spill = [{{ from = 1, to = 2{} }}, {{ from = 1, to = 3{} }}]
pump = [{{ gain = 5.0, to = 1, high = 10.0, initial = 10.0 }}]
controller = {{ kind = "open-loop" }}
values = {{ "clock.dt" = 0.1, "clock.duration" = 20.0 }}
"""
CAUGHT = [
    ("", "", "spill 1 and 2, from tank 1: caught is 2 in sum, 1 where it is left out"),
    (", caught = 0.4", "", "spill 1 and 2, from tank 1: caught is 1.4 in sum, 1 where"),
    (
        ", caught = 0.6",
        ", caught = 0.5",
        r"plant.caught: the 2 spills of tank 1 catch 0.6 \+ 0.5 = 1.1",
    ),
]


@pytest.mark.parametrize(("first", "second", "words"), CAUGHT)
def test_spills_that_catch_more_than_there_is_are_refused(first, second, words):
    with pytest.raises(InputError, match=words):
        rig.loads(SPILLING.format(first, second))


@pytest.mark.extended
def test_spills_are_weighed_wherever_their_shares_are_given(tmp_path, capsys):
    """In a file all that is caught is there again; by the command's --set, in Python and in a law's
    model more is refused.
    """
    text = SPILLING.format(", caught = 0.7", ", caught = 0.3")
    case = rig.loads(text)
    run = jaxtank.simulate(case.loop, case.clock)
    gained = (run.x[-1] - run.x[0]) @ case.loop.plant.area
    out = 0.01 * 0.1 * np.sqrt(2 * 981 * np.asarray(run.x[:-1])).sum()
    np.testing.assert_allclose(
        [gained + out, np.abs(run.spilled).max()], [5.0 * 10.0 * 20.0, 0.0], atol=0.5
    )
    (tmp_path / "rig.toml").write_text(text)
    assert main.main(["simulate", str(tmp_path / "rig.toml"), "--set", "plant.caught=0.8,0.3"]) == 2
    assert (
        "plant.caught: the 2 spills of tank 1 catch 0.8 + 0.3 = 1.1 of" in capsys.readouterr().err
    )
    with pytest.raises(InputError, match=r"catch 0.7 \+ 0.9 = 1.6"):
        jaxtank.simulate(with_values(case.loop, {"plant.caught[1]": 0.9}), case.clock)
    believed = controllers.NGPC(
        model=dataclasses.replace(case.loop.plant, caught=np.array([1.0, 1.0])),
        Tp=1.0,
        level_floor=0.01,
    )
    with pytest.raises(
        InputError, match=r"controller.model.caught: the 2 spills of tank 1 catch 1 \+ 1 = 2"
    ):
        jaxtank.check(dataclasses.replace(case.loop, controller=believed), case.clock)
    one = {"drain": 1.0, "pump_gain": 1.0, "feeds": [(0, None)], "rim": 1.0}
    with pytest.raises(InputError, match=r"catch 1 \+ 1 = 2"):
        network(**one, area=[1.0] * 3, spills=[(0, 1), (0, 2)], caught=1.0)
    thirds = [np.float32(1 / 3)] * 3  # a little more than 1 in sum
    network(**one, area=[1.0] * 4, spills=[(0, 1), (0, 2), (0, 3)], caught=thirds)


def test_sections_of_older_files_are_read_under_their_present_names():
    pulse = "time = 1\nduration = 1\ntank = 1\nvolume = 1\n"
    new = 'case = "gouta2022/pi"\n[controller]\nkind = "pid"\nKc = 2.0\n[[inflow]]\n' + pulse
    old = new.replace("[controller]", "[law]").replace("[[inflow]]", "[[pour]]")
    assert rig.dump(rig.loads(old)) == rig.dump(rig.loads(new))
    assert "[[inflow]]" in rig.dump(rig.loads(old)) and "pour" not in rig.complete(rig.loads(old))
    for name, extra in (("law", "law = {}"), ("pour", "pour = []")):
        with pytest.raises(InputError, match=rf"\[{name}\] .* \[(controller|inflow)\]"):
            rig.loads(f"{extra}\n{new}")


@pytest.mark.extended
def test_an_orifice_into_the_basin_is_the_drain_of_its_tank():
    head = """
        tank = [{ name = "T1", area = 15.0, rim = 40.0, DRAIN }]
        pump = [{ gain = 10.0, to = 1, high = 12.0 }]
        controller = { kind = "pi", Kc = 1.0, Ti = 50.0 }
        """
    orifice = 'orifice = [{ from = "T1", area = 0.5, port = 2.0 }]\n'
    drain = head.replace("DRAIN", "drain = 0.5, drain_port = 2.0")
    left, right = (rig.loads(text) for text in (head.replace(", DRAIN", "") + orifice, drain))
    assert rig.dump(left) == rig.dump(right)
    with pytest.raises(InputError, match="another opening"):
        rig.loads(drain + orifice)


def test_the_clock_may_stand_at_the_top_of_a_file():
    short = 'case = "cascaded/pi"\ndt = "2 s"\nduration = "5 min"\n'
    long = 'case = "cascaded/pi"\n[values]\n"clock.dt" = 2.0\n"clock.duration" = 300.0\n'
    assert rig.loads(short).clock == rig.loads(long).clock
    with pytest.raises(InputError, match=r"clock\.dt is given twice"):
        rig.loads(short + '[values]\n"clock.dt" = 2.0\n')


def test_the_gain_of_an_input_that_is_a_flow_is_that_flow_or_a_share_of_it():
    gain = lambda gain, flow=10.0: _flow_gain("pump[0]", gain, flow, ("m", "m^3/h"))
    assert gain(9.0) == 9.0 and gain(1.0) == 10.0 and gain(0.8) == 8.0 and gain(-1.0) == -1.0
    assert gain(1.0, 1.0) == 1.0
    for wrong in (0.05, 3.0, 30.0):
        with pytest.raises(InputError):
            gain(wrong)

"""The safety filter of a case: rig files, the command line, and what is claimed of its box."""

import dataclasses

import numpy as np
import pytest
import scipy.stats
from helpers import command

import jaxtank
import tuning
from jaxtank import presets, rig
from jaxtank.core.errors import InputError
from jaxtank.safety import of_case
from jaxtank.safety.of_case import certificates_of
from tuning.report.safety import certificates

RIG = """
case = "cascaded/pi"
[safety_filter]
rate = 0.1
limit = [9.5, 9.0]
"""


def simulated(*words):
    result = command("simulate", *words, "--json")
    assert result.code == 0, result.err
    return np.array(result.json["measures"]["max_level"]), result


@pytest.mark.slow
def test_options_and_rig_files_turn_the_filter_on_and_off(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(RIG)
    highest, result = simulated("cascaded/pi")
    assert highest[0] == 10.0 and result.json["measures"]["filter_active_fraction"] is None
    highest, result = simulated("cascaded/pi", "--safety-filter")
    assert highest[0] < 9.7 and result.json["measures"]["filter_active_fraction"] > 0.0
    assert "not proved" not in result.err
    highest, _ = simulated(str(path))
    assert np.all(highest <= [9.5, 9.0]) and highest[0] > 8.0
    assert simulated(str(path), "--no-safety-filter")[0][0] == 10.0
    lower = ("--set", "safety_filter.limit=[9.0,9.0]")
    highest, result = simulated("cascaded/pi", "--safety-filter", *lower)
    assert np.all(highest <= 9.0)
    # the share of samples with an input other than the command within the pumps' limits
    case = presets.find("cascaded/pi").with_safety_filter(limit=[9.0, 9.0])
    run = jaxtank.simulate(case.loop, case.clock)
    free = np.clip(run.command, case.loop.actuator.low, case.loop.actuator.high)
    share = np.mean(np.any(np.asarray(run.applied) != free, axis=1))
    assert 0.01 < share < 0.5
    assert result.json["measures"]["filter_active_fraction"] == pytest.approx(share, rel=1e-9)
    fast = ("--set", "safety_filter.rate=0.3")
    _, result = simulated("cascaded/pi", "--safety-filter", *fast)
    assert "tank 1 is not proved: kappa 0.3 above its bound 0.25 1/s" in result.err


def test_a_filtered_case_comes_back_from_its_rig_file():
    case = rig.loads(RIG)
    for text in (rig.dump(case), rig.complete(case)):
        again = rig.loads(text)
        assert again.safety == {"rate": 0.1, "limit": pytest.approx([9.5, 9.0])}
        assert again.loop.safety_filter.limit.tolist() == case.loop.safety_filter.limit.tolist()
    assert rig.loads(rig.dump(case.without_safety_filter())).loop.safety_filter is None


def test_a_filter_that_its_settings_do_not_make_is_not_written():
    """A file would design another one around its plant."""
    case = presets.find("cascaded/pi").with_safety_filter()
    changes = {"plant.pump_gain": [5.0]}, {"safety_filter.most.pump_gain": [9.0]}
    others = [case.replace(loop=jaxtank.with_values(case.loop, change)) for change in changes]
    part = dataclasses.replace(case.loop.safety_filter, allocate=False)
    others.append(case.replace(loop=dataclasses.replace(case.loop, safety_filter=part)))
    for other in (case.replace(safety=None), *others):
        with pytest.raises(InputError, match="its safety filter was designed for other values"):
            rig.dump(other)
    gains = case.replace(loop=jaxtank.with_values(case.loop, {"controller.Kc": [0.5]}))
    assert rig.loads(rig.dump(gains)).loop.safety_filter.rate == pytest.approx(
        case.loop.safety_filter.rate
    )


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ("rate = -1.0", r"safety_filter\.rate = -1"),
        ("limits = [1.0, 2.0]", r"\[limits\] is a table of its own"),
        ("limit = [1.0]", r"safety_filter\.limit"),
        ('widths = { "plant.drian" = 0.1 }', r"plant\.drian"),
    ],
)
def test_a_wrong_setting_in_a_rig_file_is_one_line(lines, words):
    with pytest.raises(InputError, match=words):
        rig.loads(f'case = "cascaded/pi"\n[safety_filter]\n{lines}\n')


def test_show_has_limits_hypotheses_and_reasons():
    """The filter is designed for the values that are set; k1 of gouta2015 has a gap of 0.108 cm."""
    wider = ("cascaded/pi", "--set", "plant.rim=[12,13]")
    assert [row["limit"] for row in command("show", *wider, "--json").json["safety_filter"]] == [
        12.0,
        13.0,
    ]
    table = command("show", *wider).out.split("Limits on levels")[1]
    assert "no fault takes a parameter out of its interval" in " ".join(table.split())
    case = presets.find("gouta2015/ngpc")
    rows = certificates(case)
    assert [row["starts"] for row in rows] == ["case", "case", "limits", "limits"]
    assert [row["why"] for row in rows] == ["Theorem 2"] * 2 + ["Theorem 1"] * 2
    assert rows[2]["gap"] == pytest.approx(0.108, abs=5e-4)
    pulses = {"actuator.dead_zone": [1.0, 1.0], "actuator.dead_zone_kind": "pulse"}
    row = certificates(rig.set_values(case, pulses))[2]
    assert not row["certified"] and "pays out more than was commanded" in row["why"]


# --------------------------------------------------------------------------- the box of a case

TANKS = """
name = "two"
tank = [
    { area = 50.0, rim = 20.0, drain = 0.6, level = 5.0 },
    { area = 50.0, rim = 20.0, drain = 0.6, level = 5.0 },
]
pump = [
    { gain = 20.0, to = 1, low = 0.0, high = 20.0, initial = 0.0 },
    { gain = 20.0, to = 2, low = 0.0, high = 20.0, initial = 0.0 },
]
plant = { outputs = [1, 2] }
controller = { kind = "pid", Kc = [1.0, 1.0], Ti = [50.0, 50.0], Tt = [20.0, 20.0] }
reference = { initial = [5.0, 5.0], changes = [[1.0, 1, 30.0], [1.0, 2, 30.0]], ramp = 0.0 }
values = { "clock.dt" = 0.5, "clock.duration" = 100.0 }
reachable = false
"""
COVARIANCE = """
uncertain = { "plant.drain[1]" = 0.3, "plant.pump_gain" = 0.3 }
covariance = { names = ["plant.drain[0]"], matrix = [[1e-8]] }
safety_filter = {}
"""
FAULT = 'fault = [{ of = "drain[0]", start = 60.0, end = 80.0, factor = 0.5 }]\nsafety_filter = {}'
NARROW = """
uncertain = { "plant.drain" = 0.3, "plant.pump_gain" = 0.3, "controller.Kc" = 0.5 }
safety_filter = { widths = { "plant.drain" = 0.001 } }
"""


def test_stated_widths_are_those_of_the_plant_and_a_covariance_gives_the_others():
    covariance = """
    covariance = { names = ["plant.drain[0]", "sensor.noise[0]"], matrix = [[1e-4, 0], [0, 1e-6]] }
    """
    case = rig.loads(TANKS + covariance)
    box, _ = of_case._box(case, {"plant.pump_gain": 0.5})
    assert set(box) == {"plant.pump_gain", "sensor.noise[0]"} and box["plant.pump_gain"] == 0.5
    assert box["sensor.noise[0]"] > 2e-3  # of two estimates, more than two standard deviations


def test_the_box_is_that_of_the_covariance_and_of_the_spreads_beside_it():
    """With the extreme plant of the spreads in the loop, the level passes no proved limit."""
    case = rig.loads(TANKS + COVARIANCE)
    least, most = case.loop.safety_filter.least, case.loop.safety_filter.most
    np.testing.assert_allclose(least.drain[1], 0.7 * 0.6)
    np.testing.assert_allclose([least.pump_gain, most.pump_gain], [[14.0] * 2, [26.0] * 2])
    assert 0.0 < 0.6 - least.drain[0] < 0.001
    assert all(row["certified"] for row in certificates(case))
    plant = dataclasses.replace(
        case.loop.plant, drain=np.array([0.6, 0.45]), pump_gain=np.array([25.0, 25.0])
    )
    loop = dataclasses.replace(case.loop, plant=plant)
    highest = jaxtank.evaluate(loop, case.clock, ["max_level"])["max_level"]
    assert np.all(highest <= 20.0) and np.all(highest > 19.0)


def test_the_box_of_two_parameters_is_that_of_their_ellipsoid_and_has_two_ends():
    matrix = "covariance = { names = %s, matrix = [[1e-8, 0.0], [0.0, 4e-8]] }\n"
    names = '["plant.drain[0]", "plant.drain[1]"]'
    case = rig.loads(TANKS + matrix % names + "safety_filter = {}\n")
    safety_filter = case.loop.safety_filter
    half = np.sqrt(scipy.stats.chi2.ppf(0.99, 2)) * np.array([1e-4, 2e-4])
    np.testing.assert_allclose(0.6 - safety_filter.least.drain, half, rtol=1e-9)
    np.testing.assert_allclose(safety_filter.most.drain - 0.6, half, rtol=1e-9)
    assert of_case._beyond(case, safety_filter) == []
    for end in ("least", "most"):
        narrow = dataclasses.replace(safety_filter, **{end: case.loop.plant})
        assert of_case._beyond(case, narrow) == ["plant.drain[0]", "plant.drain[1]"]


@pytest.mark.parametrize(
    ("lines", "reason"),
    [
        (NARROW, "not covered: plant.drain, plant.pump_gain beyond the widths of the filter"),
        (FAULT, "not covered: fault of plant.drain[0]"),
    ],
)
def test_what_lies_outside_the_box_is_not_proved_and_noted(lines, reason, tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(TANKS + lines)
    row = certificates(rig.loads(path.read_text()))[0]
    assert not row["certified"] and row["starts"] is None and row["why"].startswith(reason)
    result = command("show", str(path), "--json")
    assert result.code == 0 and reason in result.err
    assert not result.json["safety_filter"][0]["certified"]
    path.write_text(TANKS + lines.replace("= 0.001", "= 0.3").replace("factor = 0.5", "factor = 1"))
    assert reason not in command("show", str(path)).err


@pytest.mark.parametrize(
    "changes", [{"safety_filter.rate": np.array([30.0, 30.0])}, {"plant.pump_gain": [60.0, 60.0]}]
)
def test_a_filter_that_was_designed_for_another_rig_is_not_certified(changes):
    case = rig.loads(TANKS + "safety_filter = {}")
    assert all(row.certified for row in certificates_of(case))
    changed = case.replace(loop=jaxtank.with_values(case.loop, changes))
    assert not any(row.certified for row in certificates_of(changed))
    assert all("not designed for this rig" in row["why"] for row in certificates(changed))


def test_numbers_of_the_filter_are_not_tuned():
    case = presets.find("cascaded/pi").with_safety_filter()
    with pytest.raises(InputError, match=r"safety_filter\.rate: .* \[safety_filter\]"):
        tuning.Problem(case, free={"safety_filter.rate": (0.1, 1.0)})


OVERFED = """
units = ["m", "-"]
reachable = false
tank = [{ area = 1.0, rim = 2.0, level = 1.0, inflow = 0.08 }]
pump = [{ gain = 0.05, to = 1, low = -1.0, high = 0.0 }]
plant = { gravity = 9.81, overflow = false }
law = { kind = "pid", Kc = 5.0, Ti = 20.0 }
reference = { initial = [0.5] }
values = { "clock.dt" = 0.5, "clock.duration" = 120.0 }
safety_filter = { limit = [1.8] }
"""


def test_simulate_names_a_level_that_passed_a_limit_and_why_it_is_not_proved(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(OVERFED)
    result = command("simulate", str(path))
    # 0.08 m^3/s enter, the pump takes at most 0.05: the level is 1 m + 0.03 m/s 120 s at the end
    (note,) = (line for line in result.out.splitlines() if "of the safety filter" in line)
    level = float(note.split(": ")[1].split()[0])
    assert level == pytest.approx(1.0 + 0.03 * 120.0, rel=1e-3)
    assert "1.8 m of the safety filter, which is not proved: " in note
    path.write_text(OVERFED.replace("inflow = 0.08", "inflow = 0.03"))
    assert "of the safety filter, which" not in command("simulate", str(path)).out

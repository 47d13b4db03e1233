"""Faults, and keys of a rig file: what makes no physics is refused, what has no effect is noted."""

import re

import numpy as np
import pytest

import jaxtank
from jaxtank import rig
from jaxtank.core.errors import InputError
from jaxtank.core.tree import walk
from jaxtank.plants.faults import faults
from tuning.cli.main import main

RIG = """
tank = [{ area = 20.0, rim = 20.0, level = 5.0, drain = 0.1 },
        { area = 20.0, rim = 20.0, level = 8.0 }]
orifice = [{ from = 2, to = 1, area = 0.2 }]
pipe = [{ between = [1, 2], area = 0.1 }]
spill = [{ from = 2, to = 1, caught = 0.5 }]
pump = [{ gain = 8.0, to = [1, 2], split = 0.6, high = 12.0, initial = 6.0 }]
plant = { outputs = [2], overflow = true }
law = { kind = "open-loop", initial = [6.0] }
values = { "clock.dt" = 0.5, "clock.duration" = 20.0 }
"""
VALUES = {name: value for name, value, _ in walk(rig.loads(RIG).loop.plant)}
FIELDS, UNUSED = list(VALUES), [name for name, value in VALUES.items() if value is None]


def fault(of, start=5.0, end=10.0, **more):
    keys = "".join(f", {name} = {value}" for name, value in more.items())
    return f'{RIG}fault = [{{ of = "{of}", start = {start}, end = {end}{keys} }}]\n'


def levels(text):
    case = rig.loads(text)
    return np.asarray(jaxtank.simulate(case.loop, case.clock).x)


def command(text, tmp_path, capsys, *words):
    """(exit code, stderr) of `simulate`."""
    (tmp_path / "rig.toml").write_text(text)
    code = main(["simulate", str(tmp_path / "rig.toml"), *words])
    return code, capsys.readouterr().err


@pytest.mark.extended_for("caught", "drain")
@pytest.mark.slow_for(*(set(FIELDS) - {"area", "caught", "drain", "pump_gain"}))
@pytest.mark.parametrize("field", FIELDS)
def test_every_leaf_of_a_plant_has_faults_or_is_refused_in_one_line(field, tmp_path, capsys):
    """A little less of each, for a while: it acts, or the file is refused and says why."""
    text = fault("gravity" if field == "gravity" else f"{field}[0]", factor=0.9)
    if field in ("area", "gravity", *UNUSED):
        code, printed = command(text, tmp_path, capsys)
        assert code == 2 and printed.count("\n") == 1 and field in printed
        return
    apart = np.abs(levels(text) - levels(RIG)).max(axis=1)
    # tank 1 fills up, tank 2, whose overflow could be caught, does not
    assert apart[:11].max() == 0.0 and (field == "caught") != (apart[11:].max() > 1e-3)


@pytest.mark.extended
def test_a_rim_that_breaks_lets_out_what_is_above_it():
    case = rig.loads(fault("rim[1]", factor=0.2))
    run = jaxtank.simulate(case.loop, case.clock)
    x, lost = np.asarray(run.x), np.asarray(run.spilled)
    np.testing.assert_allclose(x[11:21, 1], 4.0, rtol=1e-12)
    assert lost[10].sum() == 0.0 and lost[-1, 1] > 20.0  # half of 80 cm^3 at once
    many = jaxtank.evaluate(case.loop, case.clock, ["overflow_volume"])["overflow_volume"]
    np.testing.assert_allclose(many, lost[-1], rtol=1e-12)


def test_an_area_may_be_another_for_the_whole_run():
    whole = fault("area[0]", start=0.0, end=100.0, factor=2.0)
    other = RIG.replace(
        "area = 20.0, rim = 20.0, level = 5.0", "area = 40.0, rim = 20.0, level = 5.0"
    )
    np.testing.assert_allclose(levels(whole), levels(other), rtol=1e-12)


@pytest.mark.parametrize(
    ("of", "more", "words"),
    [
        ("drain[0]", {"extra": -0.2}, r"makes it -0.1 cm^2: must be at least 0 cm^2"),
        ("orifice[0]", {"extra": -0.3}, r"makes it -0.1 cm^2: must be at least 0"),
        ("pump_gain[0]", {"extra": -9.0}, r"makes it -1 cm^3/(s V): must be at least 0"),
        ("split[0]", {"factor": 2.0}, r"makes it 1.2: must be at most 1"),
        ("area[0]", {"factor": 2.0}, r"volume would come from nowhere as the area changes"),
        ("rim[0]", {"factor": 0.0}, r"makes it 0 cm: must be above 0 cm"),
        ("caught[0]", {"extra": 0.6}, r"makes it 1.1: must be at most 1"),
    ],
)
def test_a_fault_that_makes_no_physics_is_refused(of, more, words):
    with pytest.raises(InputError, match=re.escape(words)) as error:
        rig.loads(fault(of, **more))
    assert f"fault 1 of {of} from 5 s to 10 s: " in str(error.value)


def test_all_such_faults_are_refused_at_once_and_also_those_that_overlap():
    two = (
        RIG
        + """fault = [
        { of = "drain[0]", start = 1.0, end = 9.0, extra = -0.06 },
        { of = "drain[0]", start = 4.0, end = 6.0, extra = 0.05 },
        { of = "drain[0]", start = 5.0, end = 9.0, extra = -0.06 },
        { of = "split[0]", start = 5.0, end = 9.0, factor = 3.0 }]\n"""
    )
    with pytest.raises(InputError) as error:
        rig.loads(two)
    text = str(error.value)
    # 0.1 - 0.06 - 0.06 from the end of the second one on
    assert text.count("makes it -0.02 cm^2: must be at least 0 cm^2") == 2
    assert "fault 2" not in text and "fault 4 of split[0]" in text


def test_a_pump_may_stand_still():
    assert levels(fault("pump_gain[0]", factor=0.0))[20, 0] < levels(RIG)[20, 0] - 1.0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            fault("pump_gain[0]", 5.1, 5.4, factor=0.0),
            "fault 1 of pump_gain[0] from 5.1 s to 5.4 s: no sample, every 0.5 s, lies in it",
        ),
        (fault("drain[0]", 500.0, 600.0, factor=0.0), "1 of 1 faults come after the end"),
        (fault("drain[0]", 20.0, 30.0, factor=0.0), "1 of 1 faults come after the end"),
        (
            fault("rim[0]", factor=0.9).replace("overflow = true", "overflow = false"),
            "fault 1 of rim[0]: rims are limits here",
        ),
        (
            RIG.replace("initial = [6.0]", "initial = [6.0], ramp = 0.0, changes = [[5.1, 1, 0.0],"
                        " [5.2, 1, 6.0]]"),
            "inputs: the change of 1 at 5.1 s is followed by another one at 5.2 s",
        ),
        (
            RIG.replace("initial = [6.0]", "initial = [6.0], changes = [[50.0, 1, 0.0]]"),
            "1 of 1 changes of the inputs come after the end",
        ),
        (
            RIG + "reference = { ramp = 0.0, changes = [[5.1, 1, 9.0], [5.3, 1, 8.0]] }",
            "reference: the change of 1 at 5.1 s is followed by another one at 5.3 s",
        ),
        (
            RIG + "reference = { sine = { amplitude = 1.0, period = 9.0, start = 5.1, end = 5.3,"
            " output = 1 } }",
            "reference.sine from 5.1 s to 5.3 s: no sample",
        ),
        (
            RIG + "disturbance = { window = 0.2 }\n"
            "inflow = [{ time = 5.1, duration = 1.0, tank = 1, volume = 5.0 }]",
            "disturbance.window = 0.2 s after the pulse at 5.1 s: no sample",
        ),
    ],
)  # fmt: skip
def test_what_no_sample_sees_is_noted(text, words):
    assert words in " ".join(rig.case_warnings(rig.loads(text)))


def test_a_fault_of_one_sample_acts_and_has_no_note():
    text = fault("pump_gain[0]", 5.0, 5.5, factor=0.0)
    assert "fault" not in " ".join(rig.case_warnings(rig.loads(text)))
    assert np.abs(levels(text) - levels(RIG)).max() > 0.01


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            RIG.replace("level = 5.0", "level = 5.0, inflow = 5.0")
            + "disturbance = { inflow = [0.0, 0.0] }",
            "tank 1: inflow = 5.0, and [disturbance] inflow has 0.0 for it: give one of them",
        ),
        (
            RIG.replace("level = 5.0", "level = 5.0, noise = 0.1")
            + 'sensor = { kind = "level", noise = [0.2, 0.2] }',
            "tank 1: noise = 0.1, and [sensor] noise has 0.2 for it: give one of them",
        ),
        (
            RIG + 'actuator = { kind = "pumps", high = [6.0], initial = [6.0] }',
            "pump 1: high = 12.0, and [actuator] high has 6.0 for it: give one of them",
        ),
    ],
)
def test_a_number_that_two_tables_give_differently_is_refused(text, words):
    with pytest.raises(InputError, match=re.escape(words)):
        rig.loads(text)


@pytest.mark.extended
@pytest.mark.slow_for("words1-tank 1 starts at 50 cm")
@pytest.mark.parametrize(
    ("words", "note"),
    [
        (["clock.duration=4", "x0=[5,4]"], "1 of 1 changes of the reference come after the end"),
        (["x0=[50,4]", "actuator.initial=70", "clock.dt=0.7"], "tank 1 starts at 50 cm"),
    ],
)
def test_what_an_option_breaks_is_noted_as_in_a_file(words, note, tmp_path, capsys):
    text = RIG + "reference = { ramp = 0.0, changes = [[5.0, 1, 9.0]] }"
    options = [word for pair in words for word in ("--set", pair)]
    code, printed = command(text, tmp_path, capsys, *options)
    assert code == 0 and printed.count(note) == 1


def test_a_fault_begins_and_ends_at_the_samples_of_its_times():
    case = rig.loads(fault("drain[0]", start=5.04, end=9.04, factor=0.5))
    (active,) = case.loop.faults.sample(case.clock)
    t = case.clock.dt * np.arange(case.clock.samples)
    np.testing.assert_array_equal(active, (t >= 5.04) & (t < 9.04))
    exact = rig.loads(fault("drain[0]", start=0.5 * 7, end=0.5 * 11, factor=0.5))
    np.testing.assert_array_equal(
        np.flatnonzero(exact.loop.faults.sample(exact.clock)[0]), range(7, 11)
    )


@pytest.mark.parametrize(("factor", "notes"), [(2.0, 0), (2.1, 1)])
def test_more_than_all_that_passes_a_rim_is_not_caught(factor, notes):
    plant = rig.loads(RIG).loop.plant
    faulty = faults(plant, [("caught[0]", 5.0, 10.0, factor, 0.0)])
    assert len(faulty._caught_twice("", plant, 0, 6.0)) == notes


def test_a_fault_is_of_one_entry():
    plant = rig.loads(RIG).loop.plant
    for name in ("drain", "gravity"):
        with pytest.raises(InputError):
            faults(plant, [(name, 5.0, 10.0, 0.5, 0.0)])

"""Rig files: what is written is read back whole, and what cannot be used is told in one line that
names the file and the thing.
"""

import dataclasses
import re

import numpy as np
import pytest
from helpers import ONE_TANK, assert_same_case as assert_same, command

from jaxtank import presets, rig
from jaxtank.case import Free
from jaxtank.core.errors import EquilibriumError, InputError
from jaxtank.core.files import LARGEST_TEXT
from jaxtank.core.tree import parameters
from jaxtank.rig.entry import toml
from jaxtank.signals.base import Constant
from jaxtank.signals.setpoints import ramps

HEAD = 'case = "gouta2015/backstepping"\n'


def round_trip(case, folder):
    path = folder / "rig.toml"
    rig.save(case, path)
    assert path.read_text(encoding="utf-8") == rig.dump(case)
    return rig.load(path)


@pytest.mark.parametrize(
    "values",
    [
        {"actuator.dead_zone": 3.0, "actuator.dead_zone_kind": "hysteresis"},
        {
            "actuator.dead_zone[1]": 2.5,
            "actuator.dead_zone_kind": "pulse",
            "actuator.lag": [0.5, 1 / 3],
        },
        {"plant.overflow": True, "plant.rim": [30.0, 31.0, 32.0, 33.0]},
        {"reference.ramp": 0.0},
        {"reference.ramp": 12.5, "reference.shape": "quintic", "reference.targets[0]": 7.0},
        {
            "clock.dt": 0.1,
            "clock.duration": 500,
            "clock.substeps": 3,
            "clock.integrator": "midpoint",
        },
        {
            "actuator.saturation": "boxqp",
            "actuator.delay": 0.5,
            "sensor.noise": 0.02,
            "sensor.bits": 12,
        },
        {"controller.k1": 1 / 3, "plant.area[2]": 1e5, "plant.pump_gain": 1e22, "plant.knee": 0.02},
    ],
    ids=lambda values: next(iter(values)),
)
def test_overrides_are_read_back(gouta, values, tmp_path):
    case = gouta("backstepping-ff", values)
    assert_same(round_trip(case, tmp_path), case)


def test_another_reference_limits_free_and_objective_are_read_back(gouta, tmp_path):
    case = gouta("backstepping")
    start, changes = (4.0, 5.0), [(30.0, 1, 6.0), (10.0, 0, 5.0), (30.0, 0, 7.0)]
    case = case.replace(
        name="mine",
        loop=dataclasses.replace(
            case.loop, reference=ramps(start, changes, ramp=25.0, shape="quintic")
        ),
        limits={
            "max_level": [20.0, 21.0, 22.0, 23.0],
            "min_level": 0.5,
            "overshoot_percent": np.array([5.0, 6.0]),
        },
        free={
            "controller.k": Free(0.001, 2.0),
            "plant.area[1]": Free(10.0, 30.0, "linear"),
            "x0": (0, 10, "linear"),
        },
        objective={"iae": 1, "input_travel": 0.25},
    )
    again = round_trip(case, tmp_path)
    assert_same(again, case)
    assert again.limits["max_level"] == [20.0, 21.0, 22.0, 23.0]
    assert again.loop.reference.changes == ((10.0, 0), (30.0, 1), (30.0, 0))


@pytest.mark.parametrize("name", ['a "rig" \\ of mine', "r\u00e9servoir \U0001f600", ""])
def test_a_name_of_any_text_is_read_back(gouta, name, tmp_path):
    assert round_trip(gouta("ngpc").replace(name=name), tmp_path).name == name


@pytest.mark.parametrize(
    "name", ["of\tmine", "two\nlines", "\x1b[2J", "\x7f", "an unprintable \U000e0001 tag"]
)
def test_a_name_that_a_terminal_would_obey_is_refused(gouta, name):
    for printed in (f"name = {toml(name)}", f"[[scenario]]\nname = {toml(name)}"):
        with pytest.raises(InputError, match="printable") as caught:
            rig.loads(f'case = "gouta2015/ngpc"\n{printed}\n')
        assert str(caught.value).isprintable()
    with pytest.raises(InputError, match="printable"):
        rig.dump(gouta("ngpc").replace(name=name))


def test_a_case_that_no_file_can_describe_is_not_written(gouta):
    case = gouta("ngpc")
    case = case.replace(
        loop=dataclasses.replace(case.loop, reference=Constant(level=np.array([3.0, 3.0])))
    )
    # no preset has such a reference, and [reference] makes ramps
    with pytest.raises(InputError, match="cannot be written"):
        rig.dump(case)


def test_a_file_that_names_a_case_alone_is_that_case(tmp_path):
    (tmp_path / "rig.toml").write_text(HEAD, encoding="utf-8")
    assert_same(rig.load(tmp_path / "rig.toml"), presets.find("gouta2015/backstepping"))
    assert_same(rig.open_case(str(tmp_path / "rig.toml")), presets.find("gouta2015/backstepping"))


def test_a_file_changes_what_it_names_and_nothing_else(tmp_path):
    text = (
        HEAD + 'name = "mine"\n[values]\n"plant.area[1]" = 20\n"reference.ramp" ='
        " 30\n[reference]\nchanges = [[50, 2, 4.5]]\n"
    )
    (tmp_path / "rig.toml").write_text(text, encoding="utf-8")
    case, old = rig.load(tmp_path / "rig.toml"), presets.find("gouta2015/backstepping")
    assert case.name == "mine"
    assert case.loop.reference.changes == ((50.0, 1),) and case.loop.reference.ramp == 30.0
    np.testing.assert_array_equal(case.loop.reference.targets, [4.5])
    changed = {
        n
        for n, v in parameters(case.loop).items()
        if not np.array_equal(v, parameters(old.loop)[n])
    }
    # the model is the plant's
    assert changed == {"plant.area", "controller.model.area", "reference.ramp", "reference.targets"}
    assert (case.clock, case.limits, case.free) == (old.clock, old.limits, old.free)


@pytest.mark.extended_for("mirakhorli/sfc")
@pytest.mark.parametrize(
    "name", ["mirakhorli/sfc", "gouta2022/chadpc", "calofir/backstepping-perturbed"]
)
def test_a_model_follows_its_plant_in_a_file_unless_it_is_set(name):
    """Controller and observer; entries too. A file written of a case with a wrong model has it."""
    case = presets.find(name)
    gain, drain = 1.3 * case.loop.plant.pump_gain, 1.01 * case.loop.plant.drain[-1]
    last = case.loop.plant.tanks - 1
    text = (
        f'case = "{name}"\n[values]\n"plant.pump_gain" = {gain.tolist()}\n"plant.drain[{last}]" ='
        f" {drain}\n"
    )
    loop = rig.loads(text).loop
    models = [
        m for m in (loop.controller.model, getattr(loop.observer, "model", None)) if m is not None
    ]
    for model in models:
        assert np.array_equal(model.pump_gain, gain) and model.drain[-1] == drain
        np.testing.assert_array_equal(model.drain, loop.plant.drain)
    apart = rig.loads(text + f'"controller.model.drain[{last}]" = 0.125\n').loop
    assert apart.controller.model.drain[-1] == 0.125 and apart.plant.drain[-1] == drain
    assert "model." not in rig.dump(case)
    wrong = rig.set_values(case, {"plant.pump_gain": gain.tolist()})
    assert_same(rig.loads(rig.dump(wrong)), wrong)
    assert len([s for s in rig.case_warnings(wrong) if "model.pump_gain" in s]) == len(models)


def test_a_model_of_a_rig_of_ones_own_follows_what_is_set(tmp_path):
    text = """
tank = [{ area = 10.0, rim = 20.0, drain = 0.2 }]
pump = [{ gain = 3.0, to = 1, high = 10.0 }]
controller = { kind = "pid", Kc = 1.0, Ti = 50.0 }
values = { "plant.drain" = 0.3 }
"""
    case = rig.loads(text)
    assert case.loop.controller.model.drain[0] == case.loop.plant.drain[0] == 0.3
    assert rig.case_warnings(case) == []
    wrong = rig.set_values(case, {"controller.model.drain": 0.2})
    assert_same(rig.loads(rig.dump(wrong)), wrong)
    assert rig.case_warnings(wrong) == []  # PID reads its model for the feed-forward alone
    assert len(rig.case_warnings(rig.set_values(wrong, {"controller.feed_forward": True}))) == 1


def test_values_relative_to_the_case_are_written_as_they_are():
    changes = {
        "plant.pump_gain[0]": "x1.3",
        "x0": "steady",
        "sensor.noise": "0.05 if zero",
        "plant.drain[0]": "by -0.01",
    }
    case = presets.find("mirakhorli/sfc")
    case = case.replace(scenarios=(case.scenarios[1]._replace(values=changes),))
    assert rig.loads(rig.dump(case)).scenarios == case.scenarios
    assert rig.loads(rig.complete(case)).scenarios == case.scenarios


BIG = "9" * 400  # a whole number that no float holds
LARGE = 10**20  # a whole number that a float holds and no integer of numpy does

WHOLE = {  # text of a file: words its message must have
    "case = = 3": ["not TOML", "line 1"],
    "\0": ["not TOML"],
    f"case = {'9' * 5000}": ["more digits than can be read"],
    "a = " + "[" * 90_000: ["nested too deeply"],
    "": ["case"],
    "case = 3": ["case = 3"],
    'case = "gouta2015/backsteping"': ["gouta2015/backsteping", "nearest: gouta2015/backstepping"],
    'case = "a\\nb"': ["unknown case"],
    HEAD + HEAD: ["not TOML"],
    HEAD + "[valeus]": ["valeus", "nearest: values"],
    HEAD + "values = 3": ["values = 3", "table"],
    HEAD + '[log]\nh1 = "level"\nh2 = ["level", "cm"]': ["log h2 = 'level'", "h1 already"],
    HEAD + '[values]\n"controller.k" = ' + "{a = " * 45_000: ["nested too deeply"],
    HEAD + 'scenario = "x"': ["scenario = 'x': must be a list of tables"],
    HEAD + "scenario = [3]": ["scenario 1 = 3: must be a table"],
}
LINES = {  # table: {line: words its message must have}
    "values": {
        '"plant.area" = ' + "[" * 400 + "1" + "]" * 400: [],
        '"controller.kk" = 1': ["controller.kk", "nearest: controller.k"],
        # without its quotation marks TOML reads a table
        "controller.kk = 1": ["controller.kk", "nearest: controller.k"],
        'controller.k = 1\n"controller.k" = 2': ["[values] controller.k is given twice"],
        '"plant.area[9]" = 1': ["plant.area[9]", "(4,)"],
        '"plant.area[x]" = 1': ["plant.area[x]"],
        '"plant.links" = [1]': ["plant.links", "topology"],
        '"controller.k" = "a"': ["controller.k = 'a'", "number"],
        '"controller.k" = true': ["controller.k = True", "number"],
        '"controller.k" = 2020-01-01': ["controller.k", "number"],
        '"controller.k" = {a = 1}': ["controller.k", "number"],
        '"controller.k" = nan': ["controller.k = nan", "finite"],
        '"controller.k" = 0': ["controller.k = 0 1/s", "above 0"],
        f'"controller.k" = {BIG}': ["controller.k"],
        '"controller.k" = [1.0]': ["controller.k", "(1,)"],
        '"plant.area" = [1, 2, 3]': ["plant.area", "(3,)", "(4,)"],
        '"plant.area" = [[1, 2], [3]]': ["plant.area"],
        '"plant.area" = [1, inf, 1, 1]': ["plant.area[1] = inf cm^2", "finite"],
        '"plant.area" = [1, 1, -1, 1]': ["plant.area[2] = -1 cm^2", "above 0"],
        '"actuator.low" = 13': ["actuator.low[0] = 13 V", "actuator.high[0] = 12 V"],
        '"actuator.saturation" = "clipp"': ["actuator.saturation = 'clipp'", "clip, boxqp"],
        '"actuator.saturation" = ["clip"]': ["actuator.saturation", "clip, boxqp"],
        '"actuator.saturation[0]" = "clip"': ["actuator.saturation[0]"],
        '"plant.overflow" = 1': ["plant.overflow = 1", "true"],
        '"controller.model.knee" = 1e-300': ["controller.model.knee = 1e-300 cm", "1e-15 cm"],
        '"sensor.bits" = 2.5': ["sensor.bits = 2.5", "whole"],
        '"sensor.bits" = nan': ["sensor.bits = nan"],
        '"clock.dtt" = 1': ["clock.dtt", "nearest: clock.dt"],
        '"clock.dt" = nan': ["clock.dt = nan"],
        '"clock.dt" = "x"': ["clock.dt = 'x'", "number"],
        '"clock.dt" = 5e-324': ["samples"],
        '"clock.duration" = 0': ["clock.duration = 0"],
        '"clock.duration" = 1e308': ["samples"],
        f'"clock.duration" = {BIG}': ["clock.duration"],
        '"clock.substeps" = inf': ["clock.substeps = inf"],
        '"clock.substeps" = true': ["clock.substeps = True"],
        '"clock.integrator" = "euler"': ["clock.integrator = 'euler'", "rk4"],
    },
    "reference": {
        "inital = [3, 3]": ["inital", "nearest: initial"],
        "initial = 3": ["reference.initial = 3"],
        "initial = [3, 3, 3]": ["reference.initial = [3, 3, 3]"],
        "initial = [[3], [3, 4]]": ["reference.initial"],
        "initial = [-1.0, 3.0]": ["reference.initial[0] = -1 cm", "above 0"],
        "initial = [nan, 3.0]": ["reference.initial = [nan, 3.0]", "finite"],
        'changes = "x"': ["reference.changes = 'x'"],
        "changes = [[20.0, 1, 0.0]]": ["reference.targets[0] = 0 cm", "above 0"],
        "changes = [[20.0, 1, nan]]": ["reference.changes has [20.0, 1, nan]", "finite"],
        "changes = [[20.0, 3, 5.0]]": ["[20.0, 3, 5.0]", "from 1 to 2"],
        "changes = [[20.0, 1.5, 5.0]]": ["[20.0, 1.5, 5.0]"],
        "changes = [[20.0, 1]]": ["[20.0, 1]"],
        'changes = [["a", 1, 5]]': ["'a'"],
        "changes = [[[20.0], 1, 5.0]]": ["reference.changes", "[[20.0], 1, 5.0]"],
        "changes = [[-1.0, 1, 5.0]]": ["-1", "0 s"],
        f"changes = [[20.0, 1, {BIG}]]": ["reference"],
        "changes = [[30.0, 1, 5.0], [20.0, 2, 5.0]]": ["[20.0, 2, 5.0] after [30.0, 1, 5.0]"],
        "changes = [[30.0, 1, 5.0], [30.0, 1, 6.0]]": ["two changes of output 1 at 30 s"],
        "ramp = -1": ["reference.ramp = -1 s"],
        'shape = "cubic"': ["reference.shape = 'cubic'", "quintic"],
    },
    "limits": {
        "max_levl = 3": ["max_levl", "nearest: max_level"],
        "max_level = nan": ["max_level", "nan"],
        "max_level = -1.0": ["limit max_level = -1.0 cm", "at least 0 cm"],
        "max_level = true": ["max_level"],
        'max_level = "high"': ["max_level", "high"],
        'rms_error = "rim"': ["rms_error", "rim"],
        "max_level = [1, 2]": ["max_level", "4"],
        'max_level = ["a", "b", "c", "d"]': ["max_level"],
        "max_level = {a = 1}": ["max_level"],
    },
    "free": {
        '"controller.kk" = [1, 2]': ["controller.kk", "nearest: controller.k"],
        '"controller.k" = "a"': ["controller.k", "'a'"],
        '"controller.k" = [1]': ["controller.k", "[low, high]"],
        '"controller.k" = [[1], [2]]': ["controller.k", "[low, high]"],
        '"controller.k" = [0.1, 1.0, "cubic"]': ["controller.k", "cubic"],
        '"controller.k" = [5.0, 1.0]': ["controller.k"],
        '"controller.k" = [0.01, inf]': ["controller.k", "inf"],
        '"controller.k" = [-1.0, 1.0]': ["controller.k", "-1"],
        '"reference.band" = [0.1, 0.9]': ["reference.band"],
        '"plant.area[9]" = [1.0, 30.0]': ["plant.area[9]"],
    },
    "objective": {
        "rms = 1": ["rms", "nearest: "],
        'rms_error = "a"': ["objective rms_error = 'a'", "weight"],
        "rms_error = -1": ["rms_error", "-1"],
        "rms_error = 0": ["objective"],
    },
    "uncertain": {
        '"plant.drain" = 2.0': ["uncertain plant.drain = 2.0", "a share between 0 and 1"],
        '"plant.drian" = 0.1': ["unknown parameter 'plant.drian'"],
    },
    "[scenario]": {
        "value = 3": ["unknown key of [[scenario]] 'value'; nearest: values"],
        'values = { "plant.drian" = 1.0 }': ["'plant.drian'; nearest: plant.drain"],
        'name = "a"\nvalues = { "sensor.noise" = -1.0 }': ["scenario 'a': sensor.noise[0] = -1 cm"],
        "seed = 1.5": ["seed = 1.5: must be a whole number, at least 0, at most 2147483647"],
        "weight = 0.0": ["scenario 1: weight = 0: must be above 0"],
    },
}
BAD = WHOLE | {
    f"{HEAD}[{table}]\n{line}\n": words
    for table, lines in LINES.items()
    for line, words in lines.items()
}


def test_of_many_problems_the_first_twenty_are_named():
    values = "\n".join(f"wrong{k} = 1.0" for k in range(30))
    with pytest.raises(InputError, match=r"wrong19.*; and 10 more problems$") as error:
        rig.loads(f"{HEAD}[[scenario]]\n{values}\n")
    assert "wrong20" not in str(error.value) and len(error.value.parts) == 30


def label(text):
    return re.sub(r"\s+", " ", text.removeprefix(HEAD))[:50]


@pytest.mark.parametrize(("text", "words"), BAD.items(), ids=map(label, BAD))
def test_a_bad_file_is_reported_in_one_line_that_names_it(text, words, tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        rig.load(path)
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    assert repr(str(path)) in message
    for word in words:
        assert word in message


def test_a_reference_without_a_steady_state_names_outputs_and_tank():
    """Tank 3 feeds both lower tanks: what keeps tank 1 at 16 cm is too much for tank 2 at 3 cm."""
    text = HEAD + "[reference]\ninitial = [3.0, 3.0]\nchanges = [[20.0, 1, 16.0]]"
    with pytest.raises(EquilibriumError, match=r"^rig file: reference: .*\(16, 3\) cm.*tank 4"):
        rig.loads(text)
    both = rig.loads(text.replace("]]", "], [20.0, 2, 16.0]]"))
    np.testing.assert_array_equal(both.loop.reference.plateaus(), [[3.0, 3.0], [16.0, 16.0]])


def unreadable(path, prepare):
    prepare(path)
    with pytest.raises(InputError) as caught:
        rig.load(path)
    assert len(str(caught.value).splitlines()) == 1
    assert repr(str(path)) in str(caught.value)
    return str(caught.value)


def test_what_is_no_text_file_is_reported(tmp_path):
    assert "does not exist" in unreadable(tmp_path / "missing.toml", lambda p: None)
    assert "does not exist" in unreadable(tmp_path / "nul\0.toml", lambda p: None)
    assert "not a file" in unreadable(tmp_path / "folder.toml", lambda p: p.mkdir())
    assert "UTF-8" in unreadable(
        tmp_path / "binary.toml", lambda p: p.write_bytes(b"\x89PNG\r\n\x1a\n\x00\xff")
    )


def test_a_file_of_4_mib_is_read_and_a_longer_one_is_not(tmp_path):
    path = tmp_path / "long.toml"
    path.write_text(HEAD + "#" * (LARGEST_TEXT - len(HEAD)), encoding="utf-8")
    assert rig.load(path).name == "gouta2015/backstepping"
    message = unreadable(
        path, lambda p: p.write_text(HEAD + "#" * (LARGEST_TEXT + 1 - len(HEAD)), encoding="utf-8")
    )
    assert str(LARGEST_TEXT) in message and str(4 * 2**20 + 1) in message


def test_a_file_is_replaced_whole_and_leaves_no_other(gouta, tmp_path):
    path = tmp_path / "rig.toml"
    rig.save(gouta("ngpc"), path)
    rig.save(gouta("backstepping"), path)
    assert path.read_text(encoding="utf-8") == rig.dump(gouta("backstepping"))
    assert [p.name for p in tmp_path.iterdir()] == ["rig.toml"]


def test_scenarios_and_what_is_uncertain_go_through_a_file(tmp_path):
    for name in ("mirakhorli/sfc", "calofir/backstepping", "gouta2015/ngpc"):
        case = presets.find(name)
        back = round_trip(case, tmp_path)
        assert back.scenarios == case.scenarios and dict(back.uncertain) == dict(case.uncertain)
    case = presets.find("gouta2022/chadpc").replace(scenarios=(), uncertain={"plant.drain": 0.3})
    back = round_trip(case, tmp_path)
    assert back.scenarios == () and back.uncertain == {"plant.drain": 0.3}


@pytest.mark.parametrize("big", [2**63, LARGE])
@pytest.mark.parametrize(
    "line",
    [
        '[values]\n"plant.area" = [BIG, 20, 20, 20]',
        "[limits]\nmax_level = BIG",
        "[objective]\nrms_error = BIG",
        '[free]\n"controller.k" = [0.1, BIG]',
        '[[scenario]]\nweight = BIG\nvalues = { "sensor.noise" = BIG }',
        "[[inflow]]\ntime = 1\nduration = BIG\ntank = 1\nvolume = BIG",
        "reachable = false\n[disturbance]\ninflow = [0, 0, 0, BIG]",
        '[[fault]]\nof = "drain[0]"\nstart = 1\nend = BIG\nextra = BIG',
    ],
)
def test_a_large_whole_number_is_the_float_next_to_it(line, big):
    whole, real = (
        rig.loads(HEAD + line.replace("BIG", text)) for text in (str(big), repr(float(big)))
    )
    assert_same(whole, real)
    assert [s.weight for s in whole.scenarios] == [s.weight for s in real.scenarios]


def test_names_without_quotation_marks_are_dotted_names(gouta):
    text = (
        HEAD + "[values]\nclock.dt = 0.5\n[values.controller]\nk = 0.5\n[values.plant]\n'area[1]' ="
        " 20.0\n"
    )
    text += (
        "[free]\ncontroller.k = [0.1, 9.0]\n[uncertain.plant]\ndrain ="
        " 0.1\n[[scenario]]\nvalues.sensor.noise = 0.1\n"
    )
    case = rig.loads(text)
    assert_same(
        case.replace(free={}),
        gouta(
            "backstepping",
            {
                "clock.dt": 0.5,
                "controller.k": 0.5,
                "plant.area[1]": 20.0,
                "controller.model.area[1]": 20.0,
            },
        ).replace(free={}),
    )
    assert set(case.free) == {"controller.k"} and case.uncertain == {"plant.drain": 0.1}
    assert dict(case.scenarios[0].values) == {"sensor.noise": 0.1}


def test_a_byte_order_mark_is_read_over():
    assert rig.loads('\ufeffcase = "gouta2015/ngpc"\n').name == "gouta2015/ngpc"


@pytest.mark.parametrize("kind", ["tank", "pipe", "orifice", "spill", "pump"])
def test_more_of_a_kind_than_a_loop_can_hold_are_refused(kind):
    text = "[[tank]]\narea = 1.0\nrim = 9.0\n" * 2 + "[[pump]]\ngain = 1.0\nto = 1\nhigh = 1.0\n"
    with pytest.raises(InputError, match=rf"\[\[{kind}\]\]: \d+ {kind}s: must be at most 5000"):
        rig.loads(text + f"[[{kind}]]\n" * 5001)


@pytest.mark.parametrize(
    ("limits", "plant", "notes"),
    [
        ({"max_level": 2.7}, {}, []),
        ({"max_level": 0.9}, {}, ["starts at 1 cm, above its limit of 0.9 cm"]),
        ({"min_level": 1.2}, {}, ["starts at 1 cm, below its limit of 1.2 cm"]),
        ({"max_level": 3.2}, {}, ["above its rim at 3 cm: the simulation goes on"]),
        ({"max_level": 3.2}, {"overflow": True}, ["3 cm, where the tank overflows"]),
        ({"max_level": 30.0}, {}, ["far above its rim at 3 cm"]),
    ],
)
def test_a_limit_that_says_nothing_or_is_broken_at_once_is_noted(limits, plant, notes):
    loop = rig.loads(ONE_TANK).loop
    loop = dataclasses.replace(loop, plant=dataclasses.replace(loop.plant, **plant))
    case = rig.loads(ONE_TANK).replace(limits=limits, loop=loop)
    sentences = rig.case_warnings(case)
    assert len(sentences) == len(notes)
    assert all(note in sentence for note, sentence in zip(notes, sentences))


def test_constraints_of_a_controller_beyond_its_pumps_are_noted():
    case = presets.find("khalid/gpc-constrained")
    assert rig.case_warnings(case) == []
    low = rig.set_values(case, {"actuator.high": np.asarray(case.loop.controller.u_high) - 0.5})
    (sentence,) = rig.case_warnings(low)
    assert "controller.u_high[0] = 3 U0 is beyond the limit of pump 1, 2.5 U0" in sentence


def test_limits_of_the_command_line_are_noted_as_those_of_a_file(tmp_path):
    path = tmp_path / "tank.toml"
    path.write_text(ONE_TANK)
    words = ["tune", str(path), "--nominal", "--starts", "1", "--limit", "max_level=0.9"]
    assert "above its limit of 0.9 cm" in command(*words).err


@pytest.mark.extended_for("text0")
@pytest.mark.parametrize(
    "text",
    [
        ONE_TANK.replace("drain = 2.0", "drain = AREA, drain_exponent = 0.7"),
        ONE_TANK.replace("drain = 2.0, ", "")
        + "orifice = [{ from = 1, area = AREA, exponent = 0.7 }]\n",
    ],
)
def test_an_area_beside_an_exponent_is_a_number_of_the_rigs_units(text):
    """It is a coefficient there: with head^0.7 an area of 2 cm^2 is another opening in metres."""
    drain = lambda text, area: rig.loads(text.replace("AREA", area)).loop.plant.drain[0]
    assert drain(text, '"2 cm^2"') == drain(text, "2.0") == 2.0
    with pytest.raises(InputError, match="200 mm"):
        drain(text, '"200 mm^2"')
    case = rig.loads(text.replace("AREA", "2.0"))
    for name in ("plant.drain", "plant.drain[0]"):
        assert rig.set_values(case, {name: "3 cm^2"}).loop.plant.drain[0] == 3.0
        with pytest.raises(InputError, match="200 mm"):
            rig.set_values(case, {name: "200 mm^2"})
    fault = '[[fault]]\nstart = 5.0\nend = 9.0\nof = "drain[0]"\nextra = "{}"\n'
    rig.loads(text.replace("AREA", "2.0") + fault.format("0.3 cm^2"))
    with pytest.raises(InputError, match="30 mm"):
        rig.loads(text.replace("AREA", "2.0") + fault.format("30 mm^2"))
    plain = re.sub(r", (drain_)?exponent = 0\.7", "", text)
    assert drain(plain, '"200 mm^2"') == pytest.approx(2.0)


@pytest.mark.parametrize("more", ["", "delay = 10.0\n"])
def test_an_actuator_table_keeps_what_pumps_and_valves_have_of_their_own(more):
    rows = """
tank = [{ area = 100.0, rim = 40.0, level = 10.0 }]
pump = [{ to = 1, gain = 10.0, high = 12.0, dead_zone = 3.0, rate = 0.2, lag = 8.0, delay = 10.0 }]
valve = [{ from = 1, area = 0.3, rate = 0.1, delay = 10.0 }]
controller = { kind = "split-range", Kc = 1.0, Ti = 60.0, sequence = [1, 2], reverse = [2] }
values = { "clock.dt" = 1.0 }
"""
    table = '[actuator]\nkind = "pumps"\ndead_zone_kind = "offset"\n'
    bank = rig.loads(rows + table + more).loop.actuator
    alone = rig.loads(rows).loop.actuator
    assert bank.dead_zone_kind == "offset"
    for name in ("low", "high", "initial", "dead_zone", "rate", "lag", "delay", "delays"):
        np.testing.assert_array_equal(getattr(bank, name), getattr(alone, name))
    with pytest.raises(InputError, match="give one of them"):
        rig.loads(rows + table + "delay = 5.0\n")

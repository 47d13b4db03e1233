"""The complete rig file of `init`: it is the case, every suggestion in it can be used, and a rig is
described without Python.
"""

import json
import pathlib
import re
import tomllib
import types
import warnings

import jax
import numpy as np
import pytest
from helpers import assert_same_tree

from jaxtank import presets, rig
from jaxtank.core.clock import Clock, clock_warnings
from jaxtank.core.errors import InputError
from jaxtank.core.tree import walk
from jaxtank.measures import MEASURES, times
from tuning.cli import main, steps

HEAD = 'case = "gouta2015/backstepping"\n'
EIGHT = [
    *("gouta2015/backstepping-observer", "gouta2022/chadpc", "gouta2022/fopi", "mirakhorli/lqi"),
    *("mirakhorli/hybrid", "calofir/backstepping-perturbed", "cascaded/open-loop"),
    "khalid/laguerre-mimo",
]
"""Presets with every kind of plant, reference, disturbance, fault and observer between them."""


def assert_same_loop(a, b):
    assert_same_tree(a.loop, b.loop)
    assert a.clock == b.clock


def used(text):
    """A block of a rig file with its suggestions taken."""
    return re.sub(r"(?m)^#(?=\S)", "", text)


@pytest.mark.extended_for("calofir/backstepping-perturbed", "gouta2015/backstepping-observer")
@pytest.mark.slow_for(*EIGHT[1:4], EIGHT[7], "mirakhorli/hybrid")
@pytest.mark.parametrize("name", EIGHT)
def test_a_preset_is_read_back_from_each_of_its_files(name, tmp_path):
    case = presets.find(name)
    text, terse, tanks = rig.complete(case), rig.dump(case), rig.complete(case, tankwise=True)
    # what is not a suggestion is what `dump` says
    assert tomllib.loads(text) == tomllib.loads(terse)
    rig.save(case, tmp_path / "rig.toml")
    assert (tmp_path / "rig.toml").read_text(encoding="utf-8") == terse
    again = rig.loads(text)
    assert rig.dump(again) == terse and rig.complete(again) == text
    assert dict(again.uncertain) == dict(case.uncertain)
    assert len(again.scenarios) == len(case.scenarios)
    assert (again.symmetry is None) == (case.symmetry is None)
    by_tank = tomllib.loads(tanks)
    assert "case" not in by_tank and len(by_tank["tank"]) == case.loop.plant.tanks
    for other in (
        again,
        rig.load(tmp_path / "rig.toml"),
        rig.loads(rig.short(case)),
        rig.loads(tanks),
    ):
        assert_same_loop(other, case)
        assert other.reachable == case.reachable and dict(other.limits) == dict(case.limits)


@pytest.mark.extended_for("gouta2015/backstepping-observer")
@pytest.mark.slow_for(*EIGHT[1:6], EIGHT[7])
@pytest.mark.parametrize("name", EIGHT)
def test_every_suggestion_can_be_used(name):
    """Tables one by one; the lines of a table that is there, all of them at once."""
    blocks, tried = rig.complete(presets.find(name)).split("\n\n"), []
    for i, block in enumerate(blocks):
        taken = used(block)
        if taken != block:
            rig.loads("\n\n".join([*blocks[:i], taken, *blocks[i + 1 :]]))
            tried += re.findall(r"(?m)^#(\S.*)", block)
    assert {"[observer]", "[[fault]]", "[covariance]", "[[scenario]]", "rms_error = 1.0"} <= {
        *tried,
        *"\n".join(blocks).splitlines(),
    }
    assert len(tried) > 60


@pytest.mark.extended
def test_every_suggestion_for_a_rig_with_a_valve_can_be_used():
    text = """
    reachable = false
    units = ["m", "-"]
    tank = [{ area = 1.0, rim = 0.6, level = 0.3, inflow = 0.02 }]
    valve = [{ from = 1, area = 0.01 }]
    plant = { gravity = 9.81 }
    controller = { kind = "pid", Kc = -20.0, Ti = 100.0, bias = 0.0 }
    """
    case = rig.loads(text)
    blocks = rig.complete(case).split("\n\n")
    assert rig.complete(rig.loads("\n\n".join(blocks))) == "\n\n".join(blocks)
    assert any("#drain_linear = inf" in block for block in blocks)
    for i, block in enumerate(blocks):
        if used(block) != block:
            rig.loads("\n\n".join([*blocks[:i], used(block), *blocks[i + 1 :]]))


@pytest.mark.parametrize("tankwise", [False, True])
def test_what_is_written_is_read_where_the_plant_has_lost_a_steady_state(tankwise):
    case = rig.set_values(
        presets.find("gouta2015/backstepping"), {"reference.initial": [16.0, 3.0]}
    )
    text = rig.dump(case, tankwise)
    again = rig.loads(text)
    assert case.reachable and not again.reachable
    assert f"reachable = false  # {rig.unreachable(case)}" in text.splitlines()
    assert_same_loop(again, case)


@pytest.mark.parametrize("quiet", [False, True])
def test_a_written_rig_that_states_unreachable_is_reported(quiet, capsys):
    whole = presets.find("gouta2015/backstepping")
    case = rig.set_values(whole, {"reference.initial": [16.0, 3.0]})
    args = types.SimpleNamespace(out="found/", quiet=quiet)
    for path in ("rig.toml", "fit.csv"):
        steps.report_unreachable(case, [pathlib.Path("found") / path], args)
    steps.report_unreachable(whole, [pathlib.Path("found/rig.toml")], args)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == (not quiet)
    assert all(line.startswith("jaxtank: found/rig.toml: note: ") for line in lines)
    assert all(rig.unreachable(case) in line for line in lines)


def test_every_name_stands_in_the_file_with_its_unit_and_range():
    case = presets.find("gouta2022/pid")
    text = rig.complete(case)
    for kind in ("leaf", "static"):
        for name, value, meta in walk(case.loop, kind=kind):
            if (
                isinstance(value, tuple)
                or np.size(value) == 0
                or (value is None and name.rpartition(".")[0].endswith(("plant", "model")))
                or name.startswith(("reference.", "disturbance.", "sensor.curve"))
            ):
                continue
            above = re.search(rf'(?m)^(# .*)\n#?"{re.escape(name)}" = ', text)
            assert above, name
            shown = re.findall(rf'(?ms)((?:^# [^\n]*\n)+)#?"{re.escape(name)}" = ', text)[
                0
            ].replace("\n# ", " ")
            assert meta["doc"] in shown and (meta["unit"] == "-" or f"[{meta['unit']}]" in shown)
            if meta["low"] is not None:
                assert f"{'above' if meta['strict'] else 'at least'} {meta['low']:g}" in shown
    for measure in MEASURES:
        # to limit, and to make small
        assert measure in times() or len(re.findall(rf"(?m)^#?{measure} = ", text)) == 2


def test_the_short_file_has_what_differs_and_what_is_tuned():
    own = {"plant.area[1]": 20.0, "plant.overflow": True}
    model = {"controller.model.area[1]": 20.0, "controller.model.overflow": True}
    case = rig.set_values(presets.find("gouta2015/backstepping"), own | model)
    text = rig.short(case)
    table = tomllib.loads(text)
    assert set(table["values"]) == {"plant.area", "plant.overflow"}
    assert set(table) == {"case", "name", "values", "limits", "free", "objective"}
    assert_same_loop(rig.loads(text), case)
    rig.loads(used(text))
    assert len(text.splitlines()) < 50


def test_the_example_of_the_module_can_be_used():
    again = rig.loads(rig.__doc__.partition("\n\n")[2])
    assert type(again.loop.observer).__name__ == "ExtendedKalman"
    assert again.loop.faults.windows == (("pump_gain[0]", 300.0, 400.0),)
    assert set(again.free) == {f"controller.values[1,{j}]" for j in range(3)}
    assert again.loop.safety_filter.rate.tolist() == [1.0] * 4


def test_faults_inflow_pulses_and_a_sine_over_a_preset_are_those_of_python():
    from jaxtank.plants.faults import faults
    from jaxtank.signals.inflows import inflow_pulses
    from jaxtank.signals.setpoints import Sine

    text = (
        HEAD + "[reference.sine]\namplitude = 0.5\nperiod = 100.0\noutput = 2\nstart = 50.0\nend ="
        " 150.0\n"
        "[[inflow]]\ntime = 30.0\nduration = 2.0\ntank = 2\nvolume = 40.0\n"
        '[[fault]]\nof = "plant.pump_gain[1]"\nstart = 10.0\nend = 20.0\nfactor = 0.6\n'
    )
    loop = rig.loads(text).loop
    old = presets.find("gouta2015/backstepping").loop
    sine = Sine(
        amplitude=0.5, offset=0.0, period=100.0, zero=0.0, start=50.0, end=150.0, channel=1, width=2
    )
    assert_same_tree(loop.reference.second, sine)
    assert jax.tree.structure(loop.reference.first) == jax.tree.structure(old.reference)
    for ours, theirs in (
        (loop.disturbance, inflow_pulses(4, [(30.0, 2.0, 1, 40.0)])),
        (loop.faults, faults(old.plant, [("pump_gain[1]", 10, 20, 0.6, 0.0)])),
    ):
        assert_same_tree(ours, theirs)
    # and are read back, over the preset and tank by tank
    case = rig.loads(text)
    for tankwise in (False, True):
        again = rig.loads(rig.dump(case, tankwise))
        assert_same_loop(again, case)
        assert rig.dump(again, tankwise) == rig.dump(case, tankwise)


def test_what_a_preset_has_can_be_taken_away():
    text = (
        'case = "gouta2022/chadpc"\ninflow = []\nscenario = []\nreachable = false\n'
        "[reference]\nsine = {}\n"
    )
    case = rig.loads(text)
    assert case.loop.disturbance is None
    assert case.scenarios == () and type(case.loop.reference).__name__ == "Ramps"
    assert_same_loop(rig.loads(rig.dump(case)), case)
    assert rig.loads('case = "calofir/backstepping-perturbed"\nfault = []\n').loop.faults is None


def test_another_controller_and_observer_over_a_preset():
    text = (
        'case = "gouta2022/pi"\n[controller]\nkind = "enmpc"\nTp = 0.5\ncompensation ='
        ' "single"\n[observer]\nkind = "disturbance"\nl = 2.0\n[values]\n"controller.Tp" ='
        ' 0.4\n[free]\n"observer.l" = [0.1, 9.0]\n'
    )
    case, preset = rig.loads(text), presets.find("gouta2022/chadpc")
    values = {"controller.Tp": 0.4, "observer.l": 2.0}
    assert_same_loop(case, rig.set_values(preset, values))  # the same loop, another way
    kalman = rig.loads(
        'case = "mirakhorli/sfc"\n[observer]\nkind = "kalman"\nprocess = 1e-3\nmeasurement ='
        " 0.01\nmeasured = [1, 2]\n"
    )
    assert kalman.loop.observer.measured == (0, 1)
    assert np.shape(kalman.loop.observer.process) == (4,)
    assert_same_loop(rig.loads(rig.dump(kalman)), kalman)


def test_a_case_without_an_optional_part_of_its_preset_is_read_back():
    """gouta2022's pumps have a dead zone: a rig without one is not written as that preset."""
    import dataclasses

    case = presets.find("gouta2022/pi")
    case = case.replace(
        uncertain={},
        loop=dataclasses.replace(
            case.loop, actuator=dataclasses.replace(case.loop.actuator, dead_zone=None)
        ),
    )
    assert_same_loop(rig.loads(rig.dump(case)), case)


TANK = (
    "[[tank]]\narea = 20.0\nrim = 30.0\ndrain = 1.0\nlevel = 3.0\n[[pump]]\ngain = 5.0\nto ="
    " 1\nhigh = 12.0\n"
)
TANK += '[controller]\nkind = "pid"\nKc = 1.0\nTi = 9.0\n'


PULSE = "[[inflow]]\ntime = {}\nduration = {}\ntank = {}\nvolume = 1.0\n"
FAULT = "[[fault]]\nof = {}\nstart = 1.0\nend = 2.0\n"
KALMAN = '[observer]\nkind = "extended-kalman"\nprocess = 1.0\n'
OVER_A_PRESET = {
    PULSE.format(1.0, 1.0, 9): r"inflow 1: tank = 9: .* from 1 to 4",
    PULSE.format(1.0, 0.0, 1): "inflow 1: duration = 0 s: must be above 0 s",
    PULSE.format(-1.0, 1.0, 1): "inflow 1: time = -1 s: must be at least",
    "[[inflow]]\nvolum = 1.0\n": r"unknown key of \[\[inflow\]\] 'volum'; nearest: volume",
    "[[inflow]]\ntime = 1\nduration = 1\ntank = 1\n": r"inflow 1 needs volume \[cm\^3\]",
    FAULT.format('"pump_gian[0]"'): "fault 1: unknown parameter 'pump_gian.*nearest: pump_gain",
    FAULT.format('"pump_gain"'): "fault 1: fault of pump_gain: name one entry",
    FAULT.format('"gravity"'): "fault 1: fault of gravity: name one entry",
    FAULT.format('"drain[0]"').replace("1.0", "3.0"): "at or after 0 s and end later",
    FAULT.format('"drain[0]"') + "factor = -1.0\n": "fault 1: factor = -1: must be at least 0",
    "[disturbance]\ninflow = [1.0]\n": r"a list of 4 finite numbers \[cm\^3/s\], one per",
    "[disturbance]\ninflw = [1.0]\n": r"unknown key of \[disturbance\] 'inflw'; nearest: inflow",
    "[disturbance]\nwindow = 3.0\n": "there is none",
    "[reference.sine]\nperiod = 3.0\n": r"\[reference.sine\] needs amplitude",
    "[reference.sine]\namplitude = 1.0\nperiod = 0.0\noutput = 1\n": "sine.period = 0 s: .*above 0",
    "[reference.sine]\namplitude = 1.0\nperiod = 3.0\noutput = 3\n": "from 1 to 2",
    '[observer]\nkind = "kalmn"\n': "unknown observer kind 'kalmn'; nearest: kalman",
    '[observer]\nkind = "kalman"\nprocess = 1.0\n': r"needs measurement \[cm\^2\]",
    KALMAN + "measurement = 1.0\nmeasured = [0]\n": "counted from 1 to 4",
    KALMAN + "measurement = -1.0\n": r"observer.measurement\[0\] = -1 cm\^2",
    KALMAN + "measurement = 1.0\nsubsteps = 2.5\n": "substeps = 2.5: must be a whole",
    "reachable = 1\n": "reachable = 1: must be true or false",
}
OF_A_TANK = {  # (words of the file, others instead): words of the message
    ("[controller]", "[plant]\nknee = 1e-300\n[controller]"): "plant.knee = 1e-300 cm: .* 1e-15 cm",
    ("high = 12.0", "high = 0.0"): "pump 1: high = 0 V: must be above its low, 0 V",
    ("high = 12.0", "low = 13.0\nhigh = 12.0"): "pump 1: high = 12 V: must be above its low, 13 V",
    ("high = 12.0", "high = 12.0\npulse = 2.0"): r'pump 1: pulse .*"actuator.pulse" in \[values\]',
    ("rim = 30.0", "rim = 30.0\nbits = 12"): r'tank 1: bits .*"sensor.bits" in \[values\]',
    ("to = 1", "to = 1\nsplit = 0.5"): "pump 1: split is the share of the first of two tanks",
    ("area = 20.0", "area = -20.0"): r"tank 1: area = -20 cm\^2: must be above 0 cm\^2",
    ("gain = 5.0", "gain = 0.0"): r"pump 1: gain = 0 cm\^3/\(s V\): must be above 0",
    ("drain = 1.0", "drian = 1.0"): r"unknown key of \[\[tank\]\] 'drian'; nearest: drain",
    ("level = 3.0", "level = nan"): "tank 1: level = nan",
}


@pytest.mark.parametrize(
    ("text", "words"),
    [(HEAD + text, words) for text, words in OVER_A_PRESET.items()]
    + [(TANK.replace(*change), words) for change, words in OF_A_TANK.items()],
)
def test_what_is_wrong_is_named_with_its_unit_and_range(text, words):
    with pytest.raises(InputError, match=words):
        rig.loads(text)


def test_what_a_preset_states_in_more_tables_does_not_come_back():
    """A short file without [uncertain], or with one pour of two, would have the preset's."""
    from jaxtank.signals.inflows import inflow_pulses

    case = presets.find("gouta2015/ngpc").replace(uncertain={})
    assert rig.loads(rig.short(case)).uncertain == {}
    assert rig.complete(rig.loads(rig.short(case))) == rig.complete(case)
    case = presets.find("gouta2022/chadpc")
    own = case.loop.disturbance
    first = [(t, d, i, v) for (t, d, i), v in zip(own.events, np.asarray(own.volume).tolist())][:1]
    assert len(own.events) > 1
    case = case.replace(
        loop=case.loop.__class__(
            **{**vars(case.loop), "disturbance": inflow_pulses(own.width, first)}
        )
    )
    assert rig.loads(rig.short(case)).loop.disturbance.events == own.events[:1]


def test_names_of_tanks_and_pumps_are_kept():
    text = TANK.replace("[[tank]]", '[[tank]]\nname = "left"').replace(
        "[[pump]]", '[[pump]]\nname = "P-101"'
    )
    case = rig.loads(text)
    assert case.names == {"tank": ("left",), "pump": ("P-101",)}
    case = rig.set_values(case, {"plant.area": 21.0})
    for written in (rig.dump(case), rig.complete(case), rig.short(case)):
        table = tomllib.loads(written)
        assert table["tank"][0]["name"] == "left" and table["pump"][0]["name"] == "P-101"
        assert rig.loads(written).names == case.names
    assert (
        '#name = "tank 1"' in rig.complete(rig.loads(TANK))
        and rig.loads(rig.dump(rig.loads(TANK))).names == {}
    )
    # the tanks of a preset's rig, called by names: the preset cannot say them
    four = rig.complete(presets.find("gouta2015/ngpc"), tankwise=True).replace(
        '#name = "tank 3"', 'name = "upper left"'
    )
    assert rig.loads(rig.dump(rig.loads(four))).names == {"tank": ("", "", "upper left", "")}


def test_tanks_and_pumps_are_called_by_their_names(tmp_path, capsys):
    text = TANK.replace("[[tank]]", '[[tank]]\nname = "left"').replace(
        "level = 3.0", "level = 31.0"
    )
    path = tmp_path / "rig.toml"
    path.write_text(text.replace("[[pump]]", '[[pump]]\nname = "P-101"').replace("5.0", "90.0"))
    sentences = rig.case_warnings(rig.load(path))
    assert sentences[0].startswith("left starts at 31 cm")
    assert "above the rim of left" in sentences[1]
    assert main.main(["show", str(path)]) == 0
    printed, notes = capsys.readouterr()
    assert "h1 (left)" in printed and "pump 1 is 'P-101'" in printed
    assert f"jaxtank: {path}: note: {sentences[0]}" in notes.splitlines()
    assert main.main(["show", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["names"] == {"tank": ["left"], "pump": ["P-101"]}


@pytest.mark.parametrize("option", ["--dt", "--set", "--free"])
def test_a_whole_number_that_no_float_holds_is_refused_in_one_line(option, capsys):
    printed = {"--dt": "", "--set": "controller.k=", "--free": "controller.k=0.1:"}[
        option
    ] + "9" * 400
    assert (
        main.main(
            ["tune" if option == "--free" else "show", "gouta2015/backstepping", option, printed]
        )
        == 2
    )
    assert capsys.readouterr().err.count("\n") == 1


def test_numpy_states_nothing_beside_a_refusal():
    text = TANK.replace("area = 20.0", "area = 1e-300").replace(
        "[[pump]]", "[[tank]]\narea = 9.0\nrim = 9.0\n[[pump]]"
    )
    with (
        warnings.catch_warnings(),
        pytest.raises(InputError, match=r"runs empty in|no steady state"),
    ):
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message="steps too long for an empty ")
        rig.loads(text + "[[pipe]]\nbetween = [1, 2]\narea = 0.5\n")
    with warnings.catch_warnings(), pytest.raises(InputError, match="no unique steady state"):
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message="steps too long for an empty ")
        rig.loads(TANK + "[reference]\ninitial = [1e308]\n")


HARDLY_MEANT = {
    "[reference]\nchanges = [[100.0, 1, 4.0], [700.0, 1, 5.0]]\n": (
        "1 of 2 changes of the reference come after the end of the run at 600 s"
    ),
    PULSE.format(600.0, 1.0, 1): "1 of 1 inflow pulses come after the end",
    "[reference]\nchanges = [[100.0, 1, 4.0], [150.0, 1, 5.0]]\nramp = 60.0\n": (
        "1 of 2 changes begin before the one before is over (ramp 60 s), the first of output 1 at"
    ),
    "[reference]\nchanges = [[100.0, 1, 31.0]]\n": (
        "asked for 31 cm, above the rim of tank 1 at 30 cm: rims are limits"
    ),
    "[plant]\noverflow = true\n[reference]\ninitial = [31.0]\n": "a level cannot get there",
    '[values]\nx0 = 31.0\n"actuator.initial" = 3.0\n': (
        "tank 1 starts at 31 cm, above its rim at 30 cm"
    ),
    "[values]\nclock.dt = 7.0\n": "of samples of clock.dt = 7 s: the run ends at 602 s",
    '[values]\n"actuator.initial" = 13.0\n': (
        "pump 1 runs at 13 V before t = 0, outside its limits of 0 and 12 V"
    ),
}


@pytest.mark.parametrize(("change", "words"), HARDLY_MEANT.items())
def test_what_can_hardly_be_meant_is_reported_and_not_refused(change, words):
    text = TANK.replace("drain = 1.0", "drain = 0.2").replace("gain = 5.0", "gain = 50.0")
    (sentence,) = rig.case_warnings(rig.loads(text + change))
    assert words in sentence


def test_a_run_of_another_length_than_asked_for_is_reported(capsys):
    options = ["--dt", "7", "--set", "clock.duration=300"]
    assert main.main(["show", "mirakhorli/sfc", *options]) == 0
    note = "jaxtank: note: clock.duration = 300 s is no whole number of samples of clock.dt = 7 s"
    assert capsys.readouterr().err.splitlines()[0].startswith(note)
    assert main.main(["show", "mirakhorli/sfc", *options, "--quiet"]) == 0
    assert capsys.readouterr().err == ""


def test_whole_samples_in_floating_point_are_no_doubt():
    for dt, duration in ((0.1, 0.3), (0.01, 1200.0), (1e-3, 9e4), (0.7, 0.7 * 3), (1 / 3, 100.0)):
        assert clock_warnings(Clock(dt=dt, duration=duration)) == []


@pytest.mark.extended
def test_no_preset_is_doubted():
    assert [n for n in presets.names() if rig.case_warnings(presets.find(n))] == []

"""Units as they are printed: those of the rig, with its powers."""

import re

import pytest

from jaxtank import rig
from jaxtank.core.errors import InputError
from jaxtank.core.units import flow_per_input, local
from jaxtank.measures import MEASURES
from tuning import read_log
from tuning.cli import main

FLOW = ("m", "m^3/s")


@pytest.mark.parametrize(
    ("unit", "units", "printed"),
    [
        ("V", FLOW, "m^3/s"),
        ("V^2", FLOW, "(m^3/s)^2"),
        ("V^2 s", FLOW, "(m^3/s)^2 s"),
        ("cm^2/V^2", FLOW, "m^2/(m^3/s)^2"),
        ("1/V^2", FLOW, "1/(m^3/s)^2"),
        ("V/cm", FLOW, "(m^3/s)/m"),
        ("cm^3/(s V)", FLOW, "-"),
        ("cm^2 s", FLOW, "m^2 s"),
        ("V^2 s", ("m", "U0"), "U0^2 s"),
        ("V^2 s", ("cm", "V"), "V^2 s"),
        ("cm/volt", ("m", "V"), "m/V"),
        # a pump input that holds the name of a length, and one that looks like a group of an
        # expression
        ("V", ("m", "cm^3/s"), "cm^3/s"),
        ("cm/V", ("mm", "cm^3/s"), "mm/(cm^3/s)"),
        ("V", ("m", r"a\1"), r"a\1"),
    ],
)
def test_a_unit_in_those_of_a_rig(unit, units, printed):
    assert local(unit, units) == printed


@pytest.mark.slow
def test_a_rig_in_litres_per_minute_has_no_volts_in_its_files_and_measures(tmp_path, capsys):
    file = tmp_path / "rig.toml"
    file.write_text(
        'name = "litres"\nunits = ["cm", "L/min"]\n'
        "[[tank]]\narea = 100.0\nrim = 50.0\ndrain = 0.5\nlevel = 10.0\n"
        "[[pump]]\ngain = 16.67\nto = 1\nlow = 0.0\nhigh = 20.0\n"
        '[controller]\nkind = "pid"\nKc = 1.0\nTi = 30.0\n'
        "[reference]\ninitial = [10.0]\nchanges = [[5.0, 1, 12.0]]\n"
    )
    for language in ("c", "m"):
        assert (
            main.main(["export", str(file), "--lang", language, "--out", str(tmp_path / language)])
            == 0
        )
        text = "".join(path.read_text() for path in (tmp_path / language).iterdir())
        assert "(L/min)/cm" in text and "controller.Kc" in text
        assert "V/cm" not in text and "] V\n" not in text
    capsys.readouterr()
    assert main.main(["simulate", str(file), "--set", "clock.duration=20", "--all"]) == 0
    rows = [row for row in capsys.readouterr().out.splitlines() if row.startswith("RMS input")]
    assert rows and all("[L/min]" in row for row in rows)
    assert not any("voltage" in each.doc for each in MEASURES.values())


PUMPED = """
units = [{}]
[[tank]]
area = 0.5
rim = 1.2
drain = 4e-4
level = 0.4
[[pump]]
gain = {}
to = 1
high = 100.0
[plant]
gravity = 9.81
[controller]
kind = "pid"
Kc = 1.0
Ti = 100.0
[reference]
initial = [0.4]
"""


@pytest.mark.parametrize(
    ("spellings", "size"),
    [
        (("m^3/h", "m3/h", "m³/h"), 1 / 3600),
        (("L/min", "l/min"), 1e-3 / 60),
        (("cm3/s", "cc/s", "mL/s", "ml / s"), 1e-6),
        (("gpm",), 3.785411784e-3 / 60),  # US gallon
        (("m3/s",), 1.0),
    ],
)
def test_a_flow_in_any_spelling_is_the_same_flow(tmp_path, spellings, size):
    """In a rig, whose gain must be the size of the unit, and in a column of another rig's log."""
    other = rig.loads(PUMPED.format('"m", "l/s"', 1e-3)).loop
    for spelling in spellings:
        case = rig.loads(PUMPED.format(f'"m", "{spelling}"', size))
        assert rig.loads(rig.dump(case)).loop.units == case.loop.units
        assert flow_per_input(case.loop.units) == pytest.approx(size, rel=1e-12)
        for share in (1.0, 0.9, "'90 %'"):  # of the flow that the input asks for
            case = rig.loads(PUMPED.format(f'"m", "{spelling}"', share))
            gain = size * (share if isinstance(share, float) else 0.9)
            assert case.loop.plant.pump_gain[0] == pytest.approx(gain, rel=1e-12)
        (tmp_path / "log.csv").write_text(f"t [s],pump1 [{spelling}],h1 [m]\n0,3,0.4\n1,6,0.4\n")
        read = read_log(tmp_path / "log.csv", other)
        assert read.u[1, 0] == pytest.approx(6 * size / 1e-3, rel=1e-12)


@pytest.mark.parametrize(
    ("units", "why"),
    [
        ('"m", "furlong"', "'furlong' is unknown: must be one of V, mV, "),
        ('"m", "cm"', "'cm' is no unit of a pump input"),
        ('"m", "s"', "'s' is no unit of a pump input"),
        ('"m^3/h", "V"', "'m^3/h' is no unit of a level"),
        ('"parsec", "V"', "'parsec' is unknown: must be one of m, dm, cm"),
    ],
)
def test_a_unit_that_is_unknown_or_of_another_dimension_is_refused(tmp_path, capsys, units, why):
    (tmp_path / "rig.toml").write_text(PUMPED.format(units, 1.0))
    assert main.main(["show", str(tmp_path / "rig.toml")]) == 2
    out, err = capsys.readouterr()
    assert why in err and not out and err.count("\n") == 1


def test_a_gain_that_is_neither_a_share_nor_the_flow_is_refused(tmp_path, capsys):
    (tmp_path / "rig.toml").write_text(PUMPED.format('"m", "m^3/h"', 0.01))
    assert main.main(["simulate", str(tmp_path / "rig.toml")]) == 2
    assert "must be the share of it that the pump delivers" in capsys.readouterr().err


@pytest.mark.extended_for("[[0.0, 0.0], [20.0, 0.005], [40.0, 0.0083]]-True")
@pytest.mark.parametrize(
    ("flows", "right"),
    [
        ("[[0.0, 0.0], [20.0, 0.005], [40.0, 0.0083]]", True),
        ('[[0.0, 0.0], [20.0, "18 m3/h"], [40.0, "30 m3/h"]]', True),
        ("[[0.0, 0.0], [20.0, 18.0], [40.0, 30.0]]", False),
    ],
)
def test_a_curve_of_flows_in_another_unit_than_those_of_its_inputs_is_refused(flows, right):
    text = PUMPED.format('"m", "m3/h"', 1.0).replace("gain = 1.0", f"curve = {flows}")
    if right:
        points = rig.loads(text).loop.plant.curves[0]
        assert points[-1] == (40.0, pytest.approx(30.0 / 3600.0, rel=5e-3))
        return
    with pytest.raises(InputError, match=r'which is 1.08e.05 m\^3/h: .* write "30 m'):
        rig.loads(text)


def test_a_pump_whose_input_is_a_flow_needs_no_gain():
    text = PUMPED.format('"m", "m3/h"', 1.0).replace("gain = 1.0\n", "")
    case = rig.loads(text)
    assert case.loop.plant.pump_gain[0] == pytest.approx(1 / 3600, rel=1e-15)
    assert rig.loads(rig.dump(case)).loop.plant.pump_gain[0] == case.loop.plant.pump_gain[0]
    with pytest.raises(InputError, match="pump 1 needs gain"):
        rig.loads(text.replace("m3/h", "%"))


FLOW_RIG = PUMPED.format('"m", "m^3/h"', 1 / 3600).replace("100.0\n[plant]", "5.0\n[plant]") + (
    'changes = [[20.0, 1, 0.5]]\n[free]\n"controller.Kc" = [0.1, 10.0]\n'
    '[values]\n"clock.duration" = 120.0\n'
)


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [
        "show RIG",
        "init RIG",
        "simulate RIG --margins",
        "tune RIG --starts 1 --iterations 3 --validation 8 --quiet",
        "tune RIG --nominal --starts 1 --iterations 3 --quiet",
        "uncertainty RIG --samples 8 --vary plant.drain=uniform:5% --quiet",
        "sensitivity RIG --samples 8 --vary plant.drain=uniform:5% --quiet",
        "attack RIG --starts 1 --quiet",
        "export RIG --lang c",
        "export RIG --lang m",
        "export RIG --lang js",
        "identify RIG --plan",
    ],
)
@pytest.mark.parametrize("units", ["m^3/h", "%"])
def test_no_command_prints_centimetres_or_volts_of_another_rig(tmp_path, capsys, command, units):
    file = tmp_path / "rig.toml"
    file.write_text(FLOW_RIG.replace("m^3/h", units))
    assert main.main(command.replace("RIG", str(file)).split()) in (0, 3, 4)
    printed = "".join(capsys.readouterr()).replace(str(tmp_path), "")
    alien = re.findall(r".*(?:\bcm\b|(?<![\w/.])V\b).*", printed)
    # a sensor's voltage is one in any rig
    alien = [row for row in alien if "ADC" not in row and "sensor." not in row]
    assert not alien, "\n".join(alien[:10])

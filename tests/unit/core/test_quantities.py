"""Numbers with a unit against figures of tables: NIST SP 811 (2008), appendix B, and the SI."""

import json

import numpy as np
import pytest

from jaxtank import rig
from jaxtank.core.errors import InputError
from jaxtank.core.quantities import factor, quantity
from tuning.cli import main

FIGURES = [
    ("2500 cm^2", "m^2", 0.25),
    ("5 min", "s", 300.0),
    ("1.5h", "min", 90.0),
    ("36 m3/h", "m^3/s", 0.01),
    ("36 m³/h", "l/s", 10.0),
    ("36 m^3/h", "L/min", 600.0),
    ("80 %", "-", 0.8),
    ("1 in", "cm", 2.54),
    ("1 ft", "m", 0.3048),
    ("1 ft^2", "m^2", 9.290304e-2),
    ("1 gal", "m^3", 3.785412e-3),
    ("1 gpm", "m^3/s", 6.309020e-5),
    ("2 MLD", "m^3/h", 83.3333333),
    ("1 MGD", "gpm", 694.444444),
    ("24 m3/day", "m^3/h", 1.0),
    ("1 bbl/hour", "l/min", 2.64978825),
    ("4 inH2O", "cm", 10.16),
    ("10 mWC", "m", 10.0),
    ("2 weeks", "s", 1209600.0),
    ("1 cfm", "m^3/s", 4.719474e-4),
    ("1 bar", "m", 10.197162),  # of water at 4 C: 1e5 Pa / 9.80665e3 Pa/m
    ("1 psi", "ft", 2.306659),
    ("1000 mV", "V", 1.0),
    ("-4e-1 cc/s", "ml/min", -24.0),
    ("2 cm^3/(s V)", "l/(min V)", 0.12),
    ("2 (l/min)/m", "l/(min cm)", 0.02),
]


@pytest.mark.parametrize(("text", "unit", "number"), FIGURES)
def test_a_number_with_a_unit_is_that_of_the_tables(text, unit, number):
    assert quantity("x", text, unit) == pytest.approx(number, rel=3e-7)


@pytest.mark.parametrize(
    ("text", "unit", "words"),
    [
        ("1 furlong", "m", "furlong is unknown"),
        ("5 mn", "s", "nearest"),
        ("5 s", "m", "must be in m"),
        ("3000 rpm", "Hz", "must be in Hz"),  # of a drive, not of its shaft
        ("5 m^3", "m^3/h", "must be in m^3/h"),
        ("2,5 m", "m", "a point as the decimal sign"),
        ("2.5", "m", "one with a unit"),
        ("m", "m", "one with a unit"),
        ("3 L/s", "m^3/(s %)", 'Write "3 L/(s %)" or "0.03 L/(s %)"'),
        ("3 m", "m/%", 'Write "3 m/%" or "0.03 m/%"'),
    ],
)
def test_a_text_that_is_no_such_number_is_refused(text, unit, words):
    with pytest.raises(InputError, match="tank 1: level = ") as refused:
        quantity("tank 1: level", text, unit)
    assert words in str(refused.value) and text in str(refused.value)


def test_units_of_different_dimensions_have_no_factor():
    assert factor("m", "s") is None and factor("parsec", "m") is None
    assert factor("U0", "U0") == 1.0


RIG = """
units = ["m", "{flow}"]
tank = [
    {{ name = "LT101", area = {area}, rim = {rim}, drain = {drain}, level = {level} }},
    {{ name = "LT102", area = 0.25, rim = 1.0, drain = 4.15e-4, level = 0.3 }},
]
orifice = [{{ from = "LT101", to = "LT102", area = 3.2e-4 }}]
pump = [
    {{ name = "P101", to = "LT101", high = {high} }},
    {{ name = "P102", gain = 0.9, to = "LT102", high = 6.0 }},
]
controller = {{ kind = "pid", Kc = {Kc}, Ti = {Ti} }}
reference = {{ initial = [0.4, 0.3], changes = {changes} }}
limits = {{ max_level = {limit} }}
free = {{ {free} }}
values = {{ clock.duration = {duration} }}
"""
VALUES = {  # {name in RIG: (a number, the same as text with a unit or a name)}
    "flow": ("m^3/h", "m³/h"),
    "area": (0.5, '"5000 cm^2"'),
    "rim": (1.2, '"120 cm"'),
    "drain": (4e-4, '"4 cm^2"'),
    "level": (0.4, '"40 cm"'),
    "high": (6.0, '"100 L/min"'),
    "Kc": ("[5.0, 5.0]", '["5 (m3/h)/m", 5.0]'),
    "Ti": ("[300.0, 300.0]", '"5 min"'),
    "changes": ("[[120.0, 2, 0.35]]", '[["2 min", "LT102", "35 cm"]]'),
    "limit": ("[1.2, 0.8]", '{ LT102 = "80 %" }'),
    "free": ('"controller.Kc[0]" = [1.0, 10.0]', '"controller.Kc[P101]" = ["1 m^2/h", 10.0]'),
    "duration": (600.0, '"10 min"'),
}
NUMBERS, TEXTS = ({name: pair[k] for name, pair in VALUES.items()} for k in (0, 1))


def leaves(case):
    return {
        name: np.asarray(entry["value"]).tolist()
        for name, entry in case.to_json()["parameters"].items()
    }


def test_a_rig_written_with_units_and_names_is_that_of_numbers():
    numbers, texts = (rig.loads(RIG.format(**values)) for values in (NUMBERS, TEXTS))
    expected = leaves(numbers)
    for name, value in leaves(texts).items():
        if np.asarray(value).dtype != float:
            assert value == expected[name]
        else:
            np.testing.assert_allclose(value, expected[name], rtol=1e-14, err_msg=name)
    assert texts.loop.reference.changes == numbers.loop.reference.changes
    assert texts.limits["max_level"] == numbers.limits["max_level"]
    assert texts.free == numbers.free and texts.loop.units == numbers.loop.units
    again = rig.dump(texts)
    assert 'from = "LT101"' in again and leaves(rig.loads(again)) == leaves(texts)


@pytest.mark.parametrize(
    ("key", "text", "words"),
    [
        ("area", '"0.5 m"', ["tank 1: area = '0.5 m'", "must be in m^2"]),
        ("level", '"2 furlong"', ["tank 1: level = '2 furlong'", "furlong is unknown", "[m]"]),
        ("Ti", '"5 m"', ["controller.Ti = '5 m'", "must be in s"]),
        ("changes", '[[120.0, "LT103", 0.35]]', ["reference.changes", "'LT103'", "LT102"]),
        ("limit", "{ LT103 = 0.8 }", ["limit max_level", "'LT103'", "LT101"]),
        ("duration", '"1 km"', ["clock.duration = '1 km'", "must be in s"]),
    ],
)
def test_what_is_no_quantity_of_a_key_is_refused(key, text, words):
    with pytest.raises(InputError) as refused:
        rig.loads(RIG.format(**{**NUMBERS, key: text}))
    for word in words[: len(words) - words.count("[m]")]:
        assert word in str(refused.value)


@pytest.mark.extended
def test_options_take_units_and_names(tmp_path, capsys):
    file = tmp_path / "rig.toml"
    file.write_text(RIG.format(**NUMBERS))
    options = ["--set", "LT101.level=45 cm", "--set", "P102.high=50 L/min", "--dt", "0.05 min"]
    options += ["--set", "clock.duration=1 min", "--set", "plant.drain[LT102]=5 cm^2", "--json"]
    assert main.main(["simulate", str(file), *options]) == 0
    result = json.loads(capsys.readouterr().out)
    parameters = result["parameters"]
    assert parameters["x0"] == [0.45, 0.3] and result["clock"]["dt"] == 3.0
    assert parameters["actuator.high"] == pytest.approx([6.0, 3.0])
    assert parameters["plant.drain"] == pytest.approx([4e-4, 5e-4])
    for option in ("LT101.level=45 s", "LT103.level=0.2", "LT101.colour=3", "LT101.level=45 ell"):
        assert main.main(["simulate", str(file), "--set", option]) == 2
        assert option.split("=")[0].split(".")[1] in capsys.readouterr().err

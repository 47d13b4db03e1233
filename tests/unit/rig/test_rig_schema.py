"""One schema for each section of a rig file: reading, validation, writing and `init` follow it."""

import dataclasses
import re
import tomllib

import numpy as np
import pytest

from jaxtank import rig
from jaxtank.core.errors import InputError
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.rig import components, schema
from jaxtank.rig.entry import Sizes, read_value, toml, written
from jaxtank.rig.schema import NEEDED, SECTIONS, Key

# every key of every section, none of them at its default
EVERY = """
name = "mine"
reachable = false
begins = "2026-05-01 06:00:00"
units = ["dm", "W"]
tank = [
    { name = "left", area = 20.0, rim = 30.0, drain = 0.2, level = 3.0, noise = 0.01 },
    { name = "right", area = 21.0, rim = 31.0, drain = 0.3, level = 4.0, noise = 0.02 },
]
orifice = [{ from = "left", to = "right", area = 0.1 }]
pipe = [{ between = ["left", "right"], area = 0.15 }]
spill = [{ from = "left", to = "right", caught = 0.5 }]
plant = { outputs = ["right"], gravity = 98.0, overflow = true, bottom = true, knee = 0.002 }
controller = { kind = "pid", Kc = [1.0], Ti = [9.0] }
disturbance = { window = 50.0 }
inflow = [{ time = 100.0, duration = 2.0, tank = "right", volume = 10.0 }]
fault = [
    { of = "drain[0]", start = 200.0, end = 250.0, factor = 0.5, extra = 0.01 },
    { sensor = "left", kind = "spikes", start = 20.0, end = 80.0, size = 0.3, every = 7.0 },
]
schedule = { gains = ["controller.Kc[0]"], variable = "r1", knots = [3.0, 6.0] }
covariance = { names = ["plant.drain[0]"], matrix = [[0.0001]], rejected = true }
scenario = [{ name = "noisy", seed = 7, weight = 2.0, values = { "sensor.noise" = 0.1 } }]
[[pump]]
name = "P-101"
gain = 5.0
to = ["left", "right"]
split = 0.4
low = 0.5
high = 12.0
initial = 2.0
[observer]
kind = "extended-kalman"
process = [0.1, 0.1]
measurement = [0.2, 0.2]
spread = [0.3, 0.3]
measured = ["right"]
[reference]
initial = [4.5]
changes = [[20.0, 1, 5.0]]
ramp = 30.0
shape = "linear"
band = 0.02
filter = [0.4]
[reference.sine]
amplitude = 0.5
offset = 0.1
period = 40.0
zero = 3.0
start = 100.0
end = 300.0
output = 1
[safety_filter]
limit = [2.5, 2.4]
low = [0.2, 0.1]
predict = false
band = [0.01, 0.02]
rate = 0.5
widths = { "plant.drain" = 0.01 }
"""
# values that replace a key of EVERY
ELEMENTS = """
reachable = false
units = ["m", "-"]
orifice = [{ from = 1, to = 2, area = 0.001, port = 0.05, exponent = 0.55, linear = 900.0 }]
pipe = [{ between = [2, 3], area = 0.002, port = 0.02 }]
spill = [{ from = 1, to = 2, port = 1.7 }]
plant = { gravity = 9.81 }
controller = { kind = "open-loop", initial = [0.4, 0.2, 0.1, 0.3, 0.3] }
[[tank]]
name = "LT1"
shape = "cone"
height = 2.0
diameter = 1.5
level = 0.5
drain = 0.001
drain_port = 0.1
drain_exponent = 0.6
drain_linear = 400.0
[[tank]]
name = "LT2"
shape = "sphere"
diameter = 1.3
rim = 1.2
level = 0.5
[[tank]]
shape = "horizontal-cylinder"
diameter = 1.1
length = 3.3
level = 0.4
[[tank]]
shape = [[0.0, 0.3], [0.7, 1.1], [1.3, 0.9]]
level = 0.3
[[tank]]
diameter = 0.7
height = 1.7
level = 0.9
[[pump]]
name = "P1"
to = 1
curve = [[0.0, 0.0], [0.5, 0.01], [1.0, 0.014]]
high = 1.0
initial = 0.4
dead_zone = 0.1
rate = 0.25
lag = 3.0
delay = 2.0
[[pump]]
from = 3
to = 1
gain = 0.01
curve_head = [[-2.0, 1.2], [2.0, 0.5]]
high = 1.0
initial = 0.2
[[pump]]
from = 4
gain = 0.003
high = 1.0
initial = 0.1
[[valve]]
name = "FV1"
from = "LT2"
area = 0.004
characteristic = "equal-percentage"
rangeability = 30.0
port = 0.01
low = 0.1
high = 0.9
initial = 0.3
dead_zone = 0.2
rate = 0.05
lag = 2.5
delay = 1.0
[[valve]]
from = 5
to = 4
area = 0.002
characteristic = [[0.0, 0.0], [0.5, 0.2], [1.0, 1.0]]
check = true
initial = 0.3
[[sensor]]
name = "LI2"
tank = "LT2"
span = [0.05, 0.9]
noise = 0.002
offset = 0.01
scale = 1.02
filter = 3.0
log_unit = "%"
curve = [[0.0, 0.01], [0.5, 0.4], [0.9, 0.9]]
"""
# read beside another one only: a steady inflow is no [[inflow]], a file with tanks is no case
APART = {("tank", "inflow"), ("disturbance", "inflow"), ("", "case"), ("reference", "sine")}
# a table in a file is written as changes (test_tables.py)
APART |= {
    ("reference", key) for key in ("csv", "column", "time", "time_order", "decimal", "repeat")
}
APART |= {("tank", "volume"), ("sensors", "unit")}  # numbers are written in the unit of the rig
KEYS = [
    (section.name, key.name)
    for section in SECTIONS.values()
    for key in section.keys
    if (section.name, key.name) not in APART
]


def tables_of(table, section):
    """The tables of a section in a parsed rig file."""
    for step in filter(None, section.replace("sensors", "sensor").split(".")):
        table = table.get(step, {})
    return table if isinstance(table, list) else [table]


@pytest.fixture(scope="module")
def round_trips():
    trips = []
    for text in (EVERY, ELEMENTS):
        written = rig.dump(rig.loads(text))
        trips.append(
            (tomllib.loads(text), tomllib.loads(written), rig.complete(rig.loads(written)))
        )
    return trips


@pytest.mark.parametrize(("section", "key"), KEYS)
def test_every_key_of_every_section_is_read_written_and_described(section, key, round_trips):
    (given, again, complete), i = next(
        (trip, i)
        for trip in round_trips
        for i, entry in enumerate(tables_of(trip[0], section))
        if key in entry
        and not (section == "tank" and isinstance(entry[key], str) and key == "shape")
    )
    value = tables_of(given, section)[i][key]
    assert tables_of(again, section)[i][key] == value
    own, own_title = SECTIONS[section][key], SECTIONS[section].title
    line = f"{key} = {toml(value)}"
    complete = complete.partition(f"\n{own_title}\n")[2] if own_title else complete
    above = re.search(rf"(?m)((?:^# .*\n)+){re.escape(line)}$", complete)
    assert above, line
    about = above[1].replace("\n# ", " ")
    assert own.doc in about
    unit = own.meta(tuple(given["units"]))["unit"]
    assert unit == "-" or f"[{unit}]" in about


@pytest.mark.parametrize("line", ["[[tank]]\ninflow = 3.0", "[disturbance]\ninflow = [3.0]"])
def test_a_steady_inflow_is_a_key_of_its_tank(line):
    text = TANK.replace("[[tank]]", line) if "tank" in line else f"{TANK}{line}\n"
    case = rig.loads(text)
    np.testing.assert_array_equal(case.loop.disturbance.level, [3.0])
    assert tomllib.loads(rig.dump(case))["tank"][0]["inflow"] == 3.0


TANK = """
[[tank]]
area = 20.0
rim = 30.0
drain = 0.2
level = 3.0
[[pump]]
gain = 5.0
to = 1
high = 12.0
[controller]
kind = "pid"
Kc = 1.0
Ti = 9.0
"""


@pytest.mark.parametrize(
    ("section", "key", "line", "name", "wrong"),
    [
        (
            "pump",
            Key.of(PumpBank, "stop", doc="input below which it stops", target="actuator.stop"),
            "stop = 0.25",
            "actuator.stop",
            ("stop = -1.0", "pump 1: stop = -1 V: must be at least 0 V"),
        ),
        (
            "tank",
            Key.of(LevelSensor, "gain", doc="level per volt", default=1.0, target="sensor.gain"),
            "gain = 2.5",
            "sensor.gain",
            ("gain = 'x'", "tank 1: gain = 'x': must be a finite number [cm/V], above 0"),
        ),
    ],
)
def test_a_key_added_to_a_section_is_read_checked_written_and_listed(
    section, key, line, name, wrong, monkeypatch
):
    head = f"[[{section}]]"
    with pytest.raises(InputError, match=f"{key.name} is not a key of"):
        rig.loads(TANK.replace(head, f"{head}\n{line}"))
    own = SECTIONS[section]
    added = dataclasses.replace(own, keys=(*own.keys, key))
    monkeypatch.setitem(schema.SECTIONS, section, added)
    case = rig.loads(TANK.replace(head, f"{head}\n{line}"))
    value = float(line.split("=")[1])
    np.testing.assert_array_equal(value_of(case.loop, name), [value])
    dumped = tomllib.loads(rig.dump(case))
    assert dumped[section][0][key.name] == value and name not in dumped["values"]
    about = f"# {key.doc} [{key.meta()['unit']}], "
    assert re.search(rf"(?m)^{re.escape(about)}.*\n{re.escape(line)}$", rig.complete(case))
    with pytest.raises(InputError, match=re.escape(wrong[1])):
        rig.loads(TANK.replace(head, f"{head}\n{wrong[0]}"))
    if key.default is NEEDED:
        with pytest.raises(InputError, match=rf"{section} 1 needs {key.name} \[V\]: {key.doc}"):
            rig.loads(TANK)
    else:
        np.testing.assert_array_equal(value_of(rig.loads(TANK).loop, name), [key.default])


def value_of(loop, name):
    part, field = name.split(".")
    return getattr(getattr(loop, part), field)


def test_a_key_added_to_a_suggested_section_is_in_the_file_of_init(monkeypatch):
    own = SECTIONS["fault"]
    note = Key("note", "why it is there", "text", default="leak")
    monkeypatch.setitem(schema.SECTIONS, "fault", dataclasses.replace(own, keys=(*own.keys, note)))
    text = rig.complete(rig.open_case("cascaded/pi"))
    assert '# why it is there\n#note = "leak"\n' in text
    fault = '[[fault]]\nof = "drain[0]"\nstart = 1.0\nend = 2.0\nnote = 3\n'
    with pytest.raises(InputError, match="fault 1: note = 3: must be a text"):
        rig.loads(f'case = "cascaded/pi"\n{fault}')


def test_the_fields_of_a_class_are_the_keys_of_its_section():
    """A controller's leaves are not repeated: unit, range and description are its own."""
    section = components.section_of("controller", "backstepping")
    fields = components.ROLES["controller"].classes["backstepping"].__dataclass_fields__
    for key in section.keys[1:]:
        meta = fields[key.name].metadata
        assert (key.unit, key.low, key.high) == (meta["unit"], meta["low"], meta["high"])
        assert key.doc == meta["doc"]


SIZES = Sizes(4, 2, 2, names={"left": 0})
KINDS = {
    "number": (1.5, "x"),
    "integer": (3, 2.5),
    "flag": (True, 1),
    "choice": ("clip", 3),
    "text": ("a b", "a\nb"),
    "texts": (["a", "b"], [1]),
    "list": ([1.0, 2.0, 3.0, 4.0], [1.0]),
    "array": ([1.0, 2.0, 3.0, 4.0], "x"),
    "scalar": (2.0, [1.0, 2.0]),
    "tank": (3, 5),
    "tanks": ([1, 4], 3),
    "pair": ([1, 4], [1, 1]),
    "feed": ([2, 3], [1, 2, 3]),
    "curve": ([[0.0, 1.0], [2.0, 3.0]], [[0.0, 1.0]]),
    "table": ({"a": 1}, 3),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_value_of_each_kind_is_written_as_it_is_read_and_another_is_refused(kind):
    shape = () if kind == "scalar" else ("tank",)
    columns = "cm, V" if kind == "curve" else "cm"
    key = Key("key", "what it is", kind, unit=columns, shape=shape)
    good, bad = KINDS[kind]
    assert written(key, read_value(key, "tank 1: key", good, SIZES)) == good
    with pytest.raises(InputError, match=r"tank 1: key.* must .*") as refused:
        read_value(key, "tank 1: key", bad, SIZES)
    assert repr(bad).replace("\\", "") in str(refused.value).replace("\\", "")


@pytest.mark.parametrize("value", [-1.0, 0.0, 11.0, float("nan"), float("inf"), True, "x", 1e301])
def test_a_wrong_number_is_refused_with_key_value_unit_and_range(value):
    key = Key("level", "level at t = 0", unit="cm", low=0.0, high=10.0, strict=True)
    with pytest.raises(InputError, match=r"tank 1: level = .*: must be .+") as refused:
        read_value(key, "tank 1: level", value, SIZES._replace(units=("m", "V")))
    assert " m" in str(refused.value) or "[m]" in str(refused.value)

"""The rigs of `tests/audits/elements_by_command.py`: every key, and names in faults and limits."""

import tomllib

import elements_by_command as audit
import numpy as np
import pytest

import jaxtank
from jaxtank.export.source import files
from jaxtank.export.whole import check_pointwise
from jaxtank.rig.entry import unknown_key
from jaxtank.rig.read import load, loads
from jaxtank.rig.schema import INFLOW_TABLE, SECTIONS
from jaxtank.rig.write import dump
from tuning.identification import simulation

ELSEWHERE = {
    "values": "any dotted name; the base rig sets its clock",
    "objective": "tests/unit/problem",
    "covariance": "tests/unit/identification",
    "scenario": "tests/unit/problem",
    "log": "tests/unit/identification",
    "": "its name, units and preset: tests/unit/rig/test_rig_schema.py",
    "observer": "tests/unit/observers",
    "sensor": "its keys are those of [[sensors]] for all tanks: tests/unit/rig/test_rig_schema.py",
    "actuator": "its keys are those of [[pump]] for all pumps: tests/unit/rig/test_rig_schema.py",
}
RIGS = "\n".join(str({**audit.BASE, **changes}) for changes in audit.RIGS.values())


def tables_of(name):
    """The tables of a rig, [reference.sine] among them."""
    lines = [f"{k} = {v}" for k, v in {**audit.BASE, **audit.RIGS[name]}.items() if v is not None]
    tables = tomllib.loads("\n".join(lines))
    tables["sensors"] = tables.pop("sensor", [])
    return {**tables, "reference.sine": tables["reference"].get("sine", {})}


def test_every_key_of_the_schema_is_in_a_rig_that_the_audit_runs():
    used = set()
    for name in audit.RIGS:
        for section, table in tables_of(name).items():
            rows = table if isinstance(table, list) else [table]
            used |= {(section, key) for row in rows if isinstance(row, dict) for key in row}
    sections = {s for s in SECTIONS if s not in ELSEWHERE}
    keys = {(s, k) for s in sections for k in SECTIONS[s].names}
    keys |= {("inflow", key) for key in INFLOW_TABLE.names}
    assert sorted(keys - used) == []


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return audit.rig_file(tmp_path_factory.mktemp("rig"), "base").read_text()


@pytest.mark.parametrize(
    "of, target",
    [("P101", "pump_gain[0]"), ("LT102.drain", "drain[1]"), ("drain.LT102", "drain[1]")],
)
def test_a_fault_is_of_a_part_by_its_name(base, of, target):
    loop = loads(base + f'fault = [{{of = "{of}", start = 1.0, end = 2.0, factor = 0.5}}]').loop
    assert loop.faults.windows[0][0] == target


def test_a_fault_of_a_tank_asks_of_which_of_its_numbers(base):
    with pytest.raises(jaxtank.InputError, match=r"LT102\.drain"):
        loads(base + 'fault = [{of = "LT102", start = 1.0, end = 2.0, factor = 0.5}]')


def test_limits_of_a_file_name_their_tank_in_either_way(base):
    quoted = loads(base + 'limits = {"max_level.LT102" = "80 %"}').limits
    assert quoted == loads(base + 'limits = {max_level = {LT102 = "80 %"}}').limits
    assert quoted["max_level"] == [1.2, 0.8]
    with pytest.raises(jaxtank.InputError):
        loads(base + 'limits = {"max_level" = 0.8, "max_level.LT102" = 0.7}')


def test_a_steady_inflow_and_a_pulse_are_one_rig():
    """Into a closed tank of 2 m^2: 0.01 m^3/s for 100 s and 0.5 m^3 besides."""
    text = """units = ["m", "%"]
reachable = false
tank = [{name = "T1", area = 2.0, rim = 50.0, level = 1.0, inflow = 0.01}]
pump = [{to = 1, gain = 0.0005, high = 100.0, initial = 0.0}]
controller = {kind = "open-loop", initial = [0.0]}
inflow = [{time = 10.0, duration = 10.0, tank = "T1", volume = 0.5}]
values = {"clock.dt" = 1.0, "clock.duration" = 100.0}
"""
    case = loads(text)
    run = jaxtank.simulate(case)
    assert np.isclose(np.ravel(run.x)[-1], 1.0 + (1.0 + 0.5) / 2.0, rtol=1e-12)
    assert case.loop.disturbance.since(case.clock)[15] == 5.0
    again = loads(dump(case))
    assert dump(again) == dump(case)
    np.testing.assert_array_equal(jaxtank.simulate(again).x, run.x)
    check_pointwise(case)  # a page and code hold it
    assert files(case, "c", plant=True)
    levels = simulation.rig_of(case.loop).disturbance.level
    np.testing.assert_array_equal(levels, [0.01])


SPELLINGS = {
    "controller": '{kind = "PI", Kc = 200.0, Ti = "200 s", bias = 37.0}',
    "reference": "{initial = {LT101 = 0.5}, changes = [[100.0, 0.6]]}",
    "uncertain": '{"LT101.area" = "2 %", "LT102.area" = 0.02}',
    "values": None,
    "clock": "{dt = 2.0, duration = 400.0}",
}


def test_a_rig_may_be_spelled_as_people_spell_it(base):
    lines = {**audit.BASE, **SPELLINGS}
    other = loads("\n".join(f"{k} = {v}" for k, v in lines.items() if v is not None))
    case = loads(base)
    assert other.clock == case.clock
    assert other.loop.reference.initial == case.loop.reference.initial == [0.5]
    assert other.loop.reference.changes == case.loop.reference.changes
    assert type(other.loop.controller) is type(case.loop.controller)
    assert other.uncertain == {"plant.area[0]": 0.02, "plant.area[1]": 0.02}


@pytest.mark.parametrize(
    "section, key, word",
    [
        ("valve", "R", "rangeability"),
        ("valve", "curve", "characteristic"),
        ("valve", "stroke_time", "rate"),
        ("pump", "dead_time", "delay"),
        ("pump", "flow", "gain"),
        ("pipe", "from", "between"),
        ("orifice", "diameter", "area"),
        ("inflow", "flow", "changes"),
        ("controller", "hysteresis", "on or off"),
    ],
)
def test_a_word_of_the_field_is_answered_with_the_key(section, key, word):
    assert f"; write {word}" in str(unknown_key(SECTIONS[section], key))


@pytest.mark.slow
def test_all_rigs_are_read_and_start_where_they_say(tmp_path):
    for i, name in enumerate(audit.RIGS):
        folder = tmp_path / str(i)
        folder.mkdir()
        case = load(audit.rig_file(folder, name))
        first = tables_of(name)["tank"][0]["level"]
        assert np.isclose(np.asarray(case.loop.x0)[0], first), name

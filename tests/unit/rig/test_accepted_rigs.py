"""Rig files that are accepted do what they say: what random files found, and a few of them."""

import accepted_rigs
import elements_by_command as audit
import jax
import numpy as np
import pytest
from drawn_physics import balance_errors

import jaxtank
from jaxtank.plants import elements
from jaxtank.rig.read import loads
from jaxtank.rig.values import set_values
from jaxtank.rig.warnings import case_warnings, idle_parts
from jaxtank.rig.write import dump


def base(**changes):
    """The text of the base rig of the audit of elements, with other tables."""
    tables = {**audit.BASE, **changes}
    return "\n".join(f"{key} = {value}" for key, value in tables.items() if value is not None)


def scheduled(knots):
    """The base rig with a gain that follows the first setpoint."""
    gains = '{variable = "r1", gains = ["controller.Kc"], knots = KNOTS}'.replace("KNOTS", knots)
    return base(free=None, schedule=gains)


def test_knots_of_a_schedule_may_have_units():
    case = loads(scheduled('["30 cm", "50 %", 0.8]'))
    np.testing.assert_allclose(case.loop.controller.knots, [0.3, 0.6, 0.8])


@pytest.mark.parametrize(
    "knots", ['["low", 0.8]', "[[0.3], [0.8]]", "[[0.3], 0.8]", "0.3", '"3 V"']
)
def test_knots_that_are_no_levels_are_refused(knots):
    with pytest.raises(jaxtank.InputError, match="knots"):
        loads(scheduled(knots))


@pytest.mark.parametrize("table", ["reference", "inputs"])
def test_a_filter_behind_a_course_that_is_no_ramp_is_refused_when_the_file_is_read(table):
    """That of an open loop passed, and the run ended with a sentence on the reference."""
    values = {
        "reference": "{initial = [0.5], filter = [20.0], shape = 'quintic'}",
        "inputs": "{initial = [37.0], filter = [20.0], shape = 'quintic'}",
    }
    open_loop = {"controller": None, "free": None} if table == "inputs" else {}
    with pytest.raises(jaxtank.InputError, match=rf"{table}\.filter: is for ramps"):
        loads(base(**{table: values[table]}, **open_loop))


@pytest.mark.parametrize(
    "drive, more, count", [("V", "", 1), ("V", "span = [9, 9]", 0), ("%", "", 0)]
)
def test_a_split_range_over_different_units_without_spans_is_noted(drive, more, count):
    """By its range a valve took 1 of the output of the PID, and a pump 10 V or 20 mA."""
    keys = f'kind = "split-range", Kc = 9.0, Ti = 200.0, sequence = ["FV101", "P101"], {more}'
    text = base(
        units=f'["m", "{drive}"]',
        tank=audit.OUTLET,
        orifice=None,
        free=None,
        uncertain=None,
        reachable="false",
        pump='[{name = "P101", to = "LT101", gain = 4e-4, high = 9.0, initial = 3.7}]',
        valve='[{name = "FV101", from = "LT101", area = 0.001, initial = 0.5}]',
        controller="{" + keys.rstrip(", ") + ', reverse = ["FV101"]}',
    )
    notes = [line for line in case_warnings(loads(text)) if line.startswith("controller.span")]
    assert len(notes) == count


SPAN = 'tank = "LT101", span = [0.0, 1.2], unit = "%"'
SPANS = f"[{{{SPAN}}}, {{{SPAN.replace('LT101', 'LT102').replace('1.2', '0.5')}}}]"


def shared(name, **controller):
    """A rig of the audit with sensors in % of different spans, and another controller."""
    tables = {**audit.RIGS[name], "sensor": SPANS, "reference": '{initial = ["42 %"]}'}
    keys = dict(part.split(" = ", 1) for part in tables["controller"][1:-1].split(", "))
    keys |= controller
    tables["controller"] = "{" + ", ".join(f"{k} = {v}" for k, v in keys.items()) + "}"
    return base(**tables)


def test_readings_of_another_tank_than_the_output_are_of_its_own_span():
    """A pump on LT101 whose override keeps LT102 below 50 % of its own span; and a cascade."""
    keys = {"Kc": '"2 %/%"', "limit": '["50 %"]', "limit_Kc": '["3 %/%"]'}
    override = loads(shared("override", **keys)).loop.controller
    np.testing.assert_allclose(override.Kc, [200.0 / 1.2])
    np.testing.assert_allclose(override.limit, [0.25])
    np.testing.assert_allclose(override.limit_Kc, [300.0 / 0.5])
    cascade = loads(shared("cascade", Kc='"2 %/%"', inner_Kc='"2 %/%"'))  # LT102 asks LT101
    np.testing.assert_allclose(cascade.loop.controller.Kc, [2.0 * 1.2 / 0.5])
    np.testing.assert_allclose(cascade.loop.controller.inner_Kc, [200.0 / 1.2])


def test_a_gain_in_percent_is_of_the_range_of_the_input_that_leads():
    """A pump of 10 V that another one of 5 V follows: % of 10 V; it was of 15 V."""
    pump = audit.RIGS["ratio"]["pump"].replace("high = 100.0", "high = 10.0", 1)
    pump = pump.replace("high = 100.0", "high = 5.0").replace("initial = 37.0", "initial = 3.7")
    text = shared("ratio", Kc='"2 %/%"').replace('units = ["m", "%"]', 'units = ["m", "V"]')
    text = text.replace(audit.RIGS["ratio"]["pump"], pump).replace("free =", "# free =")
    case = loads(text.replace("uncertain =", "# uncertain ="))
    np.testing.assert_allclose(case.loop.controller.Kc, [2.0 * 0.1 * 100.0 / 1.2])
    other = set_values(case, {"controller.Kc[0]": "4 %/%"})
    np.testing.assert_allclose(other.loop.controller.Kc, [4.0 * 0.1 * 100.0 / 1.2])


def test_a_sine_in_percent_is_of_the_span_of_its_output():
    """Of outputs with other spans it was a list of both, and refused."""
    sine = 'sine = {amplitude = "5 %", offset = "4 %", period = 99.0, output = 2}'
    tables = {**audit.TWO, "sensor": SPANS, "free": None}
    tables["controller"] = '{kind = "pi", Kc = ["2 %/%", "2 %/%"], Ti = [200.0, 200.0]}'
    reference = f'{{initial = ["42 %", "60 %"], {sine}}}'
    second = loads(base(**{**tables, "reference": reference})).loop.reference.second
    np.testing.assert_allclose([second.amplitude, second.offset], [0.025, 0.02])


@pytest.mark.parametrize("entry", ["", "[0]"])
def test_a_set_reading_of_another_tank_is_of_its_own_span(entry):
    case = loads(shared("override", Kc='"2 %/%"', limit='["50 %"]'))
    values = {f"controller.limit{entry}": "80 %", f"controller.limit_Kc{entry}": "3 %/%"}
    controller = set_values(case, values).loop.controller
    np.testing.assert_allclose(controller.limit, [0.4])
    np.testing.assert_allclose(controller.limit_Kc, [600.0])


@pytest.mark.parametrize("name", ["cascade", "flow cascade", "PID", "override"])
def test_a_gain_without_a_unit_is_refused_with_forms_that_are_read(name):
    with pytest.raises(jaxtank.InputError, match="give its unit") as refused:
        loads(shared(name, Kc="0.5"))
    for form in str(refused.value).split("give its unit, ")[1].split(" or "):
        loads(shared(name, Kc=form))


def leak(extra):
    """The base rig with a fault that adds to the drain of its first tank."""
    return loads(base(fault=f'[{{of = "LT101.drain", start = 9.0, end = 99.0, extra = {extra}}}]'))


def test_what_a_fault_adds_is_in_the_unit_of_its_entry():
    """ "80 %" was an area of 0.8 m^2, and "2 cm^2" was refused."""
    np.testing.assert_allclose(leak('"2 cm^2"').loop.faults.extra, [2e-4])
    for extra in ('"80 %"', '"2 cm"', "true", "[1e-4]", '"large"'):
        with pytest.raises(jaxtank.InputError, match="extra"):
            leak(extra)


def test_a_fault_adds_nothing_to_the_gain_of_a_pump_with_a_curve():
    """1e-3 m^3/s per % was added to a factor of 1."""
    tables = audit.RIGS["pump curve"]
    fault = '[{of = "P101", start = 9.0, end = 99.0, KEY}]'
    loads(base(**tables, fault=fault.replace("KEY", "factor = 0.9")))
    with pytest.raises(jaxtank.InputError, match="is a curve"):
        loads(base(**tables, fault=fault.replace("KEY", "extra = 1e-3")))


def filtered(width):
    """The base rig under a safety filter with a width of the area of its tanks."""
    widths = f'{{widths = {{"plant.area" = {width}}}}}'
    return base(safety_filter=widths, limits='{"max_level" = [1.1, 0.9]}')


def test_widths_of_a_safety_filter_may_have_units():
    case = loads(filtered('["20 cm^2", 0.003]'))
    np.testing.assert_allclose(case.safety["widths"]["plant.area"], [0.002, 0.003])
    for width in ('"2 cm"', "[0.01]", "[0.01, 0.01, 0.01]", "-0.01", '"wide"', "true"):
        with pytest.raises(jaxtank.InputError, match="widths"):
            loads(filtered(width))


def test_a_schedule_of_a_controller_that_serves_no_such_rig_is_refused_by_that():
    """Its gains were looked for by tracing it, which ended in an error of an index."""
    text = scheduled("[0.3, 0.8]").replace("bias = 37.0", "bias = 37.0, feed_forward = true")
    with pytest.raises(jaxtank.InputError, match="not covered"):
        loads(text.replace("drain = 0.0006", "drain = 0.0006, drain_port = 0.01"))


def test_a_limit_of_a_tank_is_no_problem_of_a_file_that_has_another():
    with pytest.raises(jaxtank.InputError) as refused:
        loads(base(pump="[{to = 7, gain = 1.0}]", limits='{"max_level.LT101" = 0.9}'))
    assert "max_level" not in str(refused.value)


def valve(more):
    """The base rig with a valve in the outlet of its first tank."""
    return {**audit.valve(more), "free": None}


def tanks(first="", second=""):
    """The tables of the tanks of the base rig with more keys."""
    parts = audit.BASE["tank"].split("}, ")
    parts = [f"{part.rstrip(',')}{more}" for part, more in zip(parts, (first, ""))]
    table = f"{parts[0]}}}, {parts[1].rstrip(']').rstrip('}')}{second}}}]"
    return {"tank": table.replace("}}", "}")}


CHANGED = 'initial = [0.5], changes = [[100.0, "LT101", 0.6]]'
PUMPS = '{of = "P101", start = 9.0, end = 99.0, '
LOST = "[{time = 50.0, duration = 20.0, tank = 2, volume = "
IDLE = {  # {key: (tables in which it has no effect, tables in which it has one)}
    "rangeability": (
        valve(", rangeability = 30.0"),
        valve(', characteristic = "equal-percentage", rangeability = 30.0'),
    ),
    "check": (valve(", check = true"), audit.RIGS["valve between tanks"]),
    "port": (valve(", port = 3.0"), valve(", port = 0.1")),
    "exponent": (tanks(", drain_exponent = 0.7"), tanks("", ", drain_exponent = 0.7")),
    "closed": (tanks(", drain_port = 0.1"), tanks("", ", drain_port = 0.1")),
    "spill": (
        {"spill": "[{from = 1, to = 2}]", "plant": "{outputs = [1], overflow = false}"},
        {"spill": "[{from = 1, to = 2}]"},
    ),
    "dead_zone": (audit.pump("dead_zone = 150.0"), audit.pump("dead_zone = 5.0")),
    "dead_zone_kind": (
        {"values": '{"actuator.dead_zone_kind" = "offset"}'},
        {"values": '{"actuator.dead_zone_kind" = "offset", "actuator.dead_zone" = [5.0]}'},
    ),
    "fault": (
        {"fault": f"[{PUMPS}factor = 1.0}}, {PUMPS.replace('P101', 'LT101.drain')}factor = 0.5}}]"},
        {"fault": f"[{PUMPS}factor = 0.9}}, {PUMPS}factor = 1.0}}]"},
    ),
    "anti_windup": (
        {"controller": '{kind = "pid", Kc = 9.0, anti_windup = "clamping"}', "free": None},
        {"controller": '{kind = "pid", Kc = 9.0, Ti = 9.0, anti_windup = "clamping"}'},
    ),
    "shape": (
        {"reference": f'{{{CHANGED}, shape = "quintic"}}'},
        {"reference": f'{{{CHANGED}, shape = "quintic", ramp = 20.0}}'},
    ),
    "sine": (
        {"reference": "{initial = [0.5], sine = {amplitude = 0.1, period = 3.0, output = 1}}"},
        {"reference": "{initial = [0.5], sine = {amplitude = 0.1, period = 30.0, output = 1}}"},
    ),
    "volume": ({"inflow": LOST + "0.0}]"}, {"inflow": LOST + "0.1}]"}),
}


@pytest.mark.parametrize("name", IDLE)
def test_a_key_that_no_run_follows_is_noted(name):
    idle, acting = (list(idle_parts(loads(base(**tables)))) for tables in IDLE[name])
    assert len(idle) == (2 if name == "fault" else 1) and not acting


def test_a_spill_overflows_unless_a_file_says_that_it_does_not():
    """A rig with [[spill]] and no word on overflow ran as if it had none."""
    case = loads(base(spill="[{from = 1, to = 2}]"))
    assert case.loop.plant.overflow
    idle = loads(base(**IDLE["spill"][0]))
    assert not loads(dump(idle)).loop.plant.overflow


def test_few_random_files_pass_every_oracle():
    """A valve and a fault; a PI of a pump in m^3/h and a pulse; an open loop."""
    for first in (64, 256, 736):
        counts, failed = accepted_rigs.audit(4, first)
        assert counts["accepted"] > 2 and not failed


@pytest.mark.slow
def test_many_random_files_pass_every_oracle():
    counts, failed = accepted_rigs.audit(200)
    assert counts["accepted"] > 100 and not failed


def test_the_oracles_notice_a_wrong_flow(monkeypatch, tmp_path):
    """A fiftieth more through every opening of a plant that is not plain."""
    flow = elements.opening_flow
    monkeypatch.setattr(elements, "opening_flow", lambda *args: 1.02 * flow(*args))
    jax.clear_caches()
    trial = accepted_rigs.Judged(64, tmp_path)
    assert trial.read()
    run, _ = accepted_rigs.run_of(trial.case)
    jax.clear_caches()  # of the wrong program
    run = accepted_rigs.in_si(run, trial.rig, trial.style)
    assert list(balance_errors(trial.rig, run, trial.case.clock))

"""Which plants can hold their setpoints at all: one plant at a time, other draws, brute force."""

import dataclasses
import json
import types

import numpy as np
import pytest

import jaxtank
import tuning
from jaxtank import presets, rig
from jaxtank.analysis.steady_state import equilibrium
from jaxtank.core.errors import EquilibriumError, InputError
from jaxtank.core.tree import get_value, parameters, with_values
from jaxtank.signals import inflow_table
from tuning.feasible import study
from tuning.feasible.study import of_nominal_plant
from tuning.search.setting import setting_of
from tuning.uncertainty.draws import Draws
from tuning.uncertainty.needs import Needs, unjudged
from tuning.uncertainty.sampling import spread_of

CASE = presets.find("gouta2015/backstepping")


def others(case, count=4096, seed=11):
    """Random draws that no search has seen."""
    draws = Draws(case.loop, spread_of(case))
    return draws.values(np.random.default_rng(seed).random((count, draws.dimensions)))


@pytest.fixture(scope="module")
def found():
    return tuning.feasibility(CASE)


def holds_alone(loop):
    """Whether one plant has every steady state within its limits, one plateau at a time."""
    low, high = np.asarray(loop.actuator.low), np.asarray(loop.actuator.high)
    for y in loop.reference.plateaus():
        try:
            x, u = equilibrium(loop.plant, y)
        except EquilibriumError:
            return False
        if np.any(x > loop.plant.rim) or np.any(u < low) or np.any(u > high):
            return False
    return True


def test_it_is_the_answer_of_one_plant_at_a_time():
    values = others(CASE, 200)
    values = {"plant.drain[0]": values["plant.drain"][:, 0], **values}
    alone = [
        holds_alone(with_values(CASE.loop, {n: v[s] for n, v in values.items()}))
        for s in range(200)
    ]
    assert 20 < sum(alone) < 120
    np.testing.assert_array_equal(tuning.can_follow(CASE, values), alone)


def test_three_of_four_rigs_of_gouta2015_cannot_hold_their_setpoints(found):
    assert 0.74 < found.infeasible_for_any_controller < 0.77
    rows = {(row.setpoints, row.tank): row for row in found.plateaus}
    for setpoints, tank, nominal, most, share in (
        ((8.0, 14.0), 4, 28.36, 37.8, 0.37),
        ((16.0, 10.0), 3, 29.47, 39.6, 0.46),
    ):
        row = rows[setpoints, tank]
        assert row.needed == pytest.approx(equilibrium(CASE.loop.plant, setpoints)[0][tank - 1])
        assert row.needed == pytest.approx(nominal, abs=0.01)
        assert row.needed_p95 == pytest.approx(most, abs=0.3)
        assert row.share == pytest.approx(share, abs=0.02) and row.limit == 30.0
    assert [row.time_s for row in found.plateaus] == sorted(row.time_s for row in found.plateaus)


@pytest.mark.parametrize("kind", ["setpoints", "rims", "orifices"])
def test_a_mend_is_enough_on_other_plants_and_nine_tenths_of_it_are_not(found, kind):
    mend = next(m for m in found.mends if m.what == kind)
    part = {}
    for name, value in mend.set.items():
        old = np.asarray(get_value(CASE.loop, name))
        part[name] = (old + 0.9 * (np.asarray(value) - old)).tolist()
    shares = []
    for values in (dict(mend.set), part):
        mended = rig.set_values(CASE, values)
        shares.append(tuning.can_follow(mended, others(mended)).mean())
    assert shares[0] >= 0.95 and shares[1] < 0.94


@pytest.mark.extended
def test_what_is_printed_is_what_is_applied():
    found = tuning.feasibility(CASE, samples=256)
    for mend in found.mends:
        words = [option.removeprefix("--set ").partition("=") for option in mend.options]
        by_hand = rig.set_values(CASE, {name: json.loads(value) for name, _, value in words})
        applied, same = tuning.apply_mend(CASE, mend.what, samples=256)
        assert same == mend and all(option in str(found) for option in mend.options)
        for name in mend.set:
            np.testing.assert_array_equal(
                get_value(applied.loop, name), get_value(by_hand.loop, name)
            )
    # the controller's model follows the plant
    np.testing.assert_array_equal(applied.loop.controller.model.orifice, applied.loop.plant.orifice)


def test_the_json_object_is_that_of_the_interface(found):
    page = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert page["infeasible_for_any_controller"] == pytest.approx(np.mean(found.infeasible))
    for row in page["plateaus"]:
        assert {"time_s", "tank", "needed", "needed_p95", "limit"} <= set(row)
    assert [m["what"] for m in page["mends"]] == ["setpoints", "rims", "orifices"]
    assert page["mends"][1]["set"].keys() == {"plant.rim[2]", "plant.rim[3]"}
    assert "not reachable" in found._repr_html_() and set(found.plot()) == {"needs"}


def test_a_limit_of_its_own_takes_the_place_of_the_rim():
    share = lambda limits: tuning.can_follow(CASE, others(CASE, 500), limits).mean()
    raised = rig.set_values(CASE, {"plant.rim": 35.0})
    assert share({"max_level": 35.0}) == tuning.can_follow(raised, others(CASE, 500)).mean()
    assert share({"max_level": 25.0}) < share(None) < share({"max_level": 35.0})
    limited = tuning.feasibility(CASE, samples=512, limits={"max_level": 30.0})
    assert "rims" not in [mend.what for mend in limited.mends]


@pytest.mark.extended
def test_a_weak_pump_is_found_and_mended():
    case = rig.set_values(
        presets.find("calofir/backstepping"),
        {"actuator.high": 1.005 * pump_of("calofir/backstepping")},
    )
    found = tuning.feasibility(case, {"plant.drain": 0.1, "plant.pump_gain": 0.05}, samples=256)
    assert found.infeasible_for_any_controller > 0.3
    assert found.plateaus[-1].pump == 1 and found.plateaus[-1].tank is None
    mended, mend = tuning.apply_mend(
        case, "pumps", {"plant.drain": 0.1, "plant.pump_gain": 0.05}, samples=256
    )
    assert list(mend.set) == ["actuator.high[0]"]
    again = tuning.feasibility(
        mended, {"plant.drain": 0.1, "plant.pump_gain": 0.05}, samples=512, seed=3
    )
    assert again.infeasible_for_any_controller < 0.05 and again.mends == ()


def pump_of(name):
    """The largest steady input of a case."""
    loop = presets.find(name).loop
    return max(float(equilibrium(loop.plant, y)[1].max()) for y in loop.reference.plateaus())


def test_the_least_offset_is_that_of_a_search_of_all_setpoints():
    values = others(CASE, 40)
    offsets = tuning.least_offset(CASE, values)
    follow = tuning.can_follow(CASE, values)
    np.testing.assert_array_equal(offsets == 0.0, follow)
    grid = np.stack(np.meshgrid(*[np.linspace(-4.0, 4.0, 161)] * 2), axis=-1).reshape(-1, 2)
    grid = grid[np.argsort(np.sum(grid**2, axis=1), kind="stable")]  # the first that serves
    for s in np.flatnonzero(~follow)[:5]:
        loop = with_values(CASE.loop, {n: v[s] for n, v in values.items()})
        total = 0.0
        for y in loop.reference.plateaus():
            near = (move for move in grid if np.all(y + move > 0) and holds_at(loop, y + move))
            move = next(near)
            total += move @ move
        count = len(loop.reference.plateaus())
        assert offsets[s] == pytest.approx(np.sqrt(total / (2 * count)), abs=0.03)


def holds_at(loop, y):
    """Whether one plant has a steady state within its limits at outputs y."""
    w = np.sqrt(2.0 * float(loop.plant.gravity))
    a, b = (np.asarray(loop.plant.orifice)[[0, 2]], np.asarray(loop.plant.orifice)[[1, 3]])
    flows = np.asarray(loop.plant.drain)[:2] * w * np.sqrt(y)
    upper = np.linalg.solve(np.array([a, b]), flows)  # efflux speeds of tanks 3 and 4
    return bool(np.all(upper >= 0) and np.all((upper / w) ** 2 <= np.asarray(loop.plant.rim)[2:]))


def test_the_shortest_ramps_hold_the_limits_and_shorter_ones_do_not():
    case = rig.set_values(CASE, {"clock.dt": 0.1})
    mended, mend = tuning.apply_mend(case, "ramps")
    ramp = float(mended.loop.reference.ramp)
    assert mend.set == {"reference.ramp": ramp} and 165.0 < ramp < 175.0
    high = []
    for shown in (ramp, 0.98 * ramp):
        own = rig.set_values(case, {"reference.ramp": shown})
        measured = jaxtank.evaluate(own.loop, own.clock, ["max_level"])
        high.append(float(np.max(measured["max_level"])))
    assert high[0] <= 30.0 < high[1]


@pytest.mark.extended_for("rims")
@pytest.mark.parametrize("kind", ["rims", "orifices"])
def test_a_mended_case_has_the_safety_filter_of_its_new_design(kind):
    """Equal to that of a case on which the changed values are set before the filter is designed."""
    filtered = CASE.with_safety_filter()
    mended, mend = tuning.apply_mend(filtered, kind, samples=512)
    fresh = rig.set_values(CASE, {**dict(mend.set), **_of_models(mend)}).with_safety_filter()
    found, before = mended.loop.safety_filter, filtered.loop.safety_filter
    for name, value in parameters(fresh.loop.safety_filter).items():
        np.testing.assert_array_equal(parameters(found)[name], value, err_msg=name)
    old = parameters(before)
    assert any(not np.array_equal(old[n], v) for n, v in parameters(found).items()), "another one"
    assert setting_of(mended).filter is not None
    searched = setting_of(mended).searched.loop.safety_filter
    np.testing.assert_array_equal(searched.limit, found.limit)


def _of_models(mend):
    """The values of the controller's model that follow those of the plant."""
    return {
        name.replace("plant.", "controller.model."): value
        for name, value in mend.set.items()
        if name.startswith("plant.")
    }


def test_a_case_that_needs_no_mend_is_left_as_it_is():
    case = presets.find("cascaded/pi")
    found = tuning.feasibility(case, samples=64)
    assert (found.infeasible_for_any_controller, found.plateaus, found.mends) == (0.0, (), ())
    same, mend = tuning.apply_mend(case, "setpoints", samples=64)
    assert mend.set == {} and mend.options == []
    np.testing.assert_array_equal(same.loop.reference.targets, case.loop.reference.targets)


STAGED = """
units = ["cm", "V"]
tank = [{area = 2500.0, rim = 100.0, level = 30.0, drain = 3.0}]
pump = [{to = 1, gain = 40.0, high = 10.0}, {to = 1, gain = 60.0, low = 1.0, high = 8.0}]
plant = {outputs = [1]}
controller = {kind = "split-range", Kc = 0.5, span = [5.0, 10.0]}
reference = {initial = [30.0], changes = [[60.0, 1, 70.0]]}
values = {"clock.dt" = 1.0, "clock.duration" = 200.0}
"""


@pytest.mark.extended
def test_pumps_that_share_a_level_are_judged_by_their_total():
    (row,) = of_nominal_plant(rig.loads(STAGED))
    flow = 3.0 * np.sqrt(2.0 * 981.0 * 70.0)
    assert row.pump == 2 and row.limit == 8.0
    assert row.needed == pytest.approx((flow - 40.0 * 10.0) / 60.0, rel=1e-9)


def test_a_store_that_no_level_empties_is_not_judged():
    store = "{name = 'S', area = 1e4, rim = 100.0, level = 50.0, inflow = 10.0}, "
    text = STAGED.replace("tank = [", "tank = [" + store).replace("to = 1,", "from = 1, to = 2,")
    text = text.replace("outputs = [1]", "outputs = [2]")
    case = rig.loads("reachable = false\n" + text)
    assert of_nominal_plant(case) is None and "S has no outflow" in unjudged(case)


def with_inflow_table(case):
    """A case with a flow into tank 1 that never rests."""
    table = inflow_table(4, [(0, [0.0, 50.0, 100.0], [0.0, 5.0, 1.0])])
    return case.replace(loop=dataclasses.replace(case.loop, disturbance=table))


@pytest.mark.parametrize(
    "call, words",
    [
        (
            lambda: tuning.apply_mend(CASE, "setpoint"),
            "one of setpoints, rims, orifices, pumps, ramps",
        ),
        (
            lambda: tuning.apply_mend(CASE, "pumps", samples=256),
            "no change of its pumps alone was found",
        ),
        (lambda: tuning.feasibility(presets.find("gouta2022/pi")), "never held"),
        (lambda: tuning.feasibility(with_inflow_table(CASE)), "follows a table"),
        (lambda: tuning.feasibility(CASE, samples=0), "samples = 0"),
    ],
)
def test_what_cannot_be_answered_is_refused_by_name(call, words):
    with pytest.raises(InputError, match=words):
        call()


def test_a_number_is_rounded_away_from_what_it_was():
    assert study._rounded(2.76543, 2.0) == 2.766 and study._rounded(1.23456, 2.0) == 1.234
    assert study._rounded(12345.6, 100.0) == 12400.0 and study._rounded(3.0, 3.0) == 3.0


def test_a_setpoint_that_every_plant_holds_needs_no_offset():
    case = presets.find("cascaded/pi")
    needs = Needs(case, {"plant.drain": np.stack([case.loop.plant.drain] * 3)})
    offsets = study.least_offsets(needs)
    assert not np.any(needs.excess() > 0) and np.all(offsets == 0.0)
    assert offsets.shape == needs.setpoints.shape[:2]


@pytest.mark.parametrize(("needed", "value"), [(0.12, 10.124), (0.1246, 10.125)])
def test_setpoints_are_rounded_away_and_a_little_more_where_that_lost_some(needed, value):
    share = lambda change: float(change[0] >= needed)
    change = np.array([0.12345, -0.0001])
    mend = study._rounded_setpoints(("a", "b"), np.array([10.0, 5.0]), change, share)
    assert mend.set == {"a": value} and mend.share == 1.0
    assert study._rounded_setpoints(("a",), np.array([10.0]), change[:1], lambda _: 0.5) is None


def test_rims_that_differ_from_plant_to_plant_are_not_raised():
    assert study._rims(types.SimpleNamespace(rim=np.array([[10.0, 9.0], [11.0, 9.0]]))) is None


ZONE = """
tank = [{ area = 20.0, rim = 30.0, drain = 0.2, level = 10.0, inflow = 25.0 }]
pump = [{ to = 1, gain = 15.0, high = 10.0 }]
controller = { kind = "pi", Kc = 0.5, Ti = 40.0 }
reference = { initial = [10.0] }
values = { "actuator.dead_zone" = 3.0, "actuator.stop" = 1.0, "actuator.dead_zone_kind" = "plain" }
"""


@pytest.mark.parametrize(
    ("kind", "inputs"),  # {input that the setpoint needs [V]: whether it can be held}
    [
        ("plain", {0.5: False, 2.9: False, 3.1: True, 0.0: True}),
        ("hysteresis", {0.5: False, 2.9: True}),
        ("pulse", {0.5: True}),  # in the mean
    ],
)
def test_an_input_inside_a_dead_zone_is_not_to_be_had(kind, inputs):
    """Nothing flows there; a pump that is off stays to be had."""
    case = rig.loads(ZONE.replace('"plain"', f'"{kind}"'))
    out = 0.2 * np.sqrt(2 * 981.0 * 10.0)
    for volts, reachable in inputs.items():
        other = rig.set_values(case, {"disturbance.level": [out - 15.0 * volts]})
        assert Needs(other, {}).feasible().tolist() == [reachable], volts
    row = of_nominal_plant(rig.set_values(case, {"disturbance.level": [out - 7.5]}))
    assert [r.limit for r in row or ()] == {"plain": [3.0], "hysteresis": [1.0]}.get(kind, [])


CASCADE = """
tank = [{ area = 40.0, rim = 20.0, drain = 0.1, level = 20.0 },
    { area = 80.0, rim = 35.0, drain = 0.25, level = 10.0 }]
spill = [{ from = 1, to = 2, caught = 1.0 }]
pump = [{ to = 1, gain = 12.0, high = 8.0, initial = 4.5 }]
plant = { outputs = [2], overflow = true }
controller = { kind = "pi", Kc = 1.0, Ti = 50.0 }
reference = { initial = [10.0], changes = [[5.0, 1, 14.0]], ramp = 0.0 }
values = { "clock.dt" = 0.5, "clock.duration" = 300.0 }
"""


def test_a_tank_that_only_an_overflow_fills_is_simulated():
    """It has steady states, which those of the network without its overflow do not count."""
    case = rig.loads(CASCADE)
    assert "what overflows" in unjudged(case)
    end = np.asarray(jaxtank.simulate(case.loop, case.clock).x)[-1]
    np.testing.assert_allclose(end, [20.0, 14.0], atol=0.05)

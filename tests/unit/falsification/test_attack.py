"""Attacks against closed forms of one tank, central differences, and filters broken on purpose."""

import dataclasses
import math

import numpy as np
import pytest
from helpers import RIGS
from scipy.optimize import brentq

import tuning
from jaxtank import evaluate, presets, rig, simulate
from jaxtank.controllers import PID
from jaxtank.core.errors import InputError
from jaxtank.core.tree import with_values
from jaxtank.safety.box import widths_of
from jaxtank.safety.checker import CASE
from jaxtank.safety.worst_case import rates_of
from tuning.falsification.attacked import Attacked, coefficients_of, programs
from tuning.falsification.study import ascend
from tuning.report.falsification import _levels, advice_of, remarks_of, verdict_of

TANK = RIGS / "watertank.toml"  # A h' = b u - a sqrt(h), A = 20 cm^2, b = 5, a = 2 (g = 0.5)
SPREAD = {"plant.drain": 0.1, "plant.pump_gain": 0.1}
LEAST = {"starts": 1, "draws": 2, "iterations": 0, "windows": 1}


def tank(gain=None, **values):
    """The water tank; with `gain` under u = gain (1 - y) + 0.4 alone."""
    case = rig.set_values(rig.load(TANK), {"clock.dt": 0.2, "clock.duration": 60.0, **values})
    if gain is None:
        return case
    law = case.loop.controller
    assert isinstance(law, PID)
    law = dataclasses.replace(law, Kc=np.array([gain]), Ti=np.array([1e12]), bias=np.array([0.4]))
    case = rig.set_values(case, {"reference.targets": [1.0]})
    return case.replace(loop=dataclasses.replace(case.loop, controller=law))


def steady(b, a, gain, error):
    """Level at which b u = a sqrt(h) under u = gain (1 - h - error) + 0.4."""
    return brentq(lambda h: b * (gain * (1.0 - h - error) + 0.4) - a * math.sqrt(h), 1e-9, 20.0)


@pytest.mark.extended
def test_the_worst_plant_and_reading_error_of_one_tank_are_those_of_its_closed_form():
    """The steady level rises with b and falls with a and with the error of the reading: the worst
    is a corner, for a proportional controller brentq's root there."""
    values = {"sensor.noise": [0.01], "clock.dt": 0.5, "clock.duration": 200.0}
    case = tank(gain=0.3, **values)
    found = tuning.attack(case, SPREAD, starts=2, draws=4, iterations=6, windows=2, start="own")
    (one,) = found.found
    assert one.level == pytest.approx(steady(5.5, 1.8, 0.3, -0.06), rel=1e-7)
    assert one.level > one.drawn > one.nominal
    assert one.nominal == pytest.approx(steady(5.0, 2.0, 0.3, 0.0), rel=1e-6)
    worst = found.parameters(one)
    assert worst["plant.drain[0]"] == pytest.approx(1.8)  # in both windows
    assert worst["plant.pump_gain[0]"] == pytest.approx(5.5)
    assert np.min(one.values["error"]) == pytest.approx(-0.06)


def test_the_worst_run_is_that_of_the_case_where_nothing_higher_is_found():
    more = dict(starts=1, draws=1, iterations=0, windows=1, noise=False)
    (worst,) = tuning.attack(tank(), SPREAD, seed=1, **more).found
    assert worst.drawn < worst.nominal == worst.level
    np.testing.assert_array_equal(worst.values["x0"], tank().loop.x0)


@pytest.mark.slow
def test_slopes_of_the_objective_are_those_of_central_differences():
    """By each kind of variable: coefficients constant and in windows, start, bias, one reading."""
    case = rig.set_values(
        presets.find("cascaded/pi"),
        {"clock.duration": 160.0, "clock.substeps": 1, "sensor.noise": 0.02},
    ).with_safety_filter()
    spread = {"plant.drain": 0.05, "plant.pump_gain": 0.05, "plant.area": 0.05}
    attacked = Attacked(
        case=case, coefficients=coefficients_of(case, spread), windows=2, pumps="own", start="any",
        noise=True, ceiling=np.asarray(case.loop.safety_filter.limit),
    )  # fmt: skip
    rng = np.random.default_rng(3)
    z = {k: rng.uniform(0.4, 0.6, s) for k, s in attacked.shapes.items()}
    z["start"] = np.array([0.5, 0.3])
    run, slopes = programs(attacked)
    tanks = np.arange(2)
    (level, _), slope = slopes({k: np.stack([v, v]) for k, v in z.items()}, tanks)
    assert level == pytest.approx(np.asarray(run(_stack(attacked, [z])).highest)[0], rel=1e-12)
    step, moved, at = 1e-6, [], []
    for name, v in z.items():
        for index in [*np.ndindex(v.shape)][:6]:
            for sign in (1.0, -1.0):
                other = {**z, name: v.copy()}
                other[name][index] += sign * step
                moved.append(other)
            at.append((name, index))
    levels = np.asarray(run(_stack(attacked, moved)).highest)
    differences = (levels[::2] - levels[1::2]) / (2.0 * step)
    for (name, index), own in zip(at, differences):
        exact = [slope[name][(i, *index)] for i in tanks]
        assert exact == pytest.approx(own, rel=1e-5, abs=1e-7), (name, index)
    assert np.any(np.abs(differences) > 0.01, axis=0).all()


def _stack(attacked, points):
    rows = [attacked.values(z) for z in points]
    return {k: np.stack([np.asarray(row[k]) for row in rows]) for k in rows[0]}


@pytest.fixture(scope="module")
def filtered():
    """What an attack finds of the water tank with full pumps, by the settings of its filter."""
    kept = {}

    def found(*, noise=0.0, **settings):
        key = (noise, *settings.items())
        if key not in kept:
            case = tank(**{"sensor.noise": [noise]})
            case = case.with_safety_filter(widths=widths_of(case.loop.plant, SPREAD), **settings)
            kept[key] = tuning.attack(
                case, starts=2, draws=16, iterations=3, windows=2, pumps="full"
            )
        return kept[key]

    return found


@pytest.mark.extended
def test_a_proved_limit_holds_and_is_nearly_reached(filtered):
    (one,) = filtered().found
    assert one.certified and not one.passed
    assert 0.999 * 40.0 < one.level <= 40.0 * (1.0 + 1e-9)


def test_plants_beyond_those_of_the_filter_are_not_called_proved():
    case = tank(**{"sensor.noise": [0.0]})
    case = case.with_safety_filter(widths=widths_of(case.loop.plant, SPREAD))
    wider = SPREAD | {"plant.drain": 0.3}
    (of_tank,) = (attack := tuning.attack(case, wider, starts=1, draws=4, iterations=1)).found
    assert of_tank.certified is False and "beyond what the safety filter" in of_tank.reason
    assert "plant.drain[0]" in remarks_of(attack)[-2] and "proved for" not in str(attack)
    assert advice_of(attack)[-1].startswith("Nothing is proved")


@pytest.mark.parametrize(("high", "why"), [(0.8, "the attack reaches beyond"), (0.11, "")])
def test_an_interval_of_the_lag_is_covered_where_the_case_names_it(high, why):
    """The filter is designed for a lag of 0.1 s, known to 10 %."""
    case = tank(**{"sensor.noise": [0.0], "actuator.lag": [0.1]})
    case = case.replace(uncertain=SPREAD | {"actuator.lag": 0.1}).with_safety_filter()
    vary = {"actuator.lag": tuning.Uniform(low=0.09, high=high)}
    (of_tank,) = tuning.attack(case, vary, **LEAST).found
    assert of_tank.certified is (not why) and of_tank.reason.startswith(why)


def test_a_proof_from_the_start_of_the_case_is_called_so_in_the_table():
    attack = tuning.attack(tank().with_safety_filter(), **LEAST)
    (of_tank,) = attack.found
    for starts, word in ((of_tank.starts, "yes"), (CASE, "start")):
        row = dataclasses.replace(of_tank, certified=True, starts=starts)
        assert _levels(dataclasses.replace(attack, found=(row,))).rows[0][2] == word


def test_a_limit_from_below_counts_in_the_cases_own_run():
    case = tank(**{"clock.duration": 20.0}).replace(limits={"min_level": 30.0})
    attack = tuning.attack(case, **LEAST)
    assert list(attack.below) == [0] and not attack.passed and not verdict_of(attack).good
    least = evaluate(case.loop, case.clock, ["min_level"])["min_level"]
    assert attack.lowest == pytest.approx(np.asarray(least))
    without = tuning.attack(case.replace(limits={}), **LEAST)
    assert without.lowest is None and without.below == {}


def test_an_uncertain_entry_may_have_a_fault_too():
    """Half the drain from the start is the run of half the drain."""
    fault = '[[fault]]\nof = "drain[0]"\nstart = 0.0\nend = 1000.0\nfactor = 0.5\n'
    case = tank(**{"clock.duration": 20.0})
    faulty = case.replace(loop=rig.loads(TANK.read_text() + fault).loop)
    half = case.replace(loop=with_values(case.loop, {"plant.drain": 0.5 * case.loop.plant.drain}))
    levels = [tuning.attack(each, SPREAD, **LEAST).found[0].nominal for each in (faulty, half)]
    assert levels[0] == pytest.approx(levels[1], rel=1e-12)


def test_a_rate_above_its_bound_is_found_out(filtered):
    """kappa T = 10, where 1 is proved."""
    (one,) = filtered(rate=50.0).found
    assert one.certified is False and "above its bound" in one.reason
    assert one.passed and one.margin < -0.1


@pytest.mark.slow
def test_a_band_of_0_with_noise_is_found_out(filtered):
    """The limit is passed by the band that the noise needs, 0.06 cm, and no more."""
    found = filtered(noise=0.01, band=0.0)
    (one,) = found.found
    assert "more than the band (0) cm" in " ".join(found.to_json()["remarks"])
    assert one.passed and one.margin == pytest.approx(-0.06, rel=0.3)
    (one,) = filtered(noise=0.01).found
    assert not one.passed


def test_between_two_samples_a_level_rises_by_at_most_what_full_pumps_bring(filtered):
    (one,) = filtered().found
    assert one.rise == pytest.approx(5.5 / 20.0 * 50.0 * 0.2)  # b_max u_max dt


@pytest.mark.extended
def test_without_a_filter_gouta2015_passes_its_rims(gouta):
    case = gouta("backstepping", {"clock.dt": 0.2, "clock.duration": 400.0})
    found = tuning.attack(case, starts=1, draws=32, iterations=0, start="own")
    assert max(one.level for one in found.found) > 40.0  # of 30 cm; 33.1 cm nominal
    assert found.worst.tank in (2, 3) and found.worst.certified is None


@pytest.mark.slow
def test_ascent_finds_more_than_draws_and_the_filter_holds_all_of_it(gouta):
    case = gouta("backstepping-ff", {"clock.dt": 0.1})
    free = tuning.attack(case)
    assert free.worst.level > 50.0 and free.worst.level > free.worst.drawn + 1.0
    for pumps in ("own", "random"):
        held = tuning.attack(case.with_safety_filter(), pumps=pumps)
        assert held.passed == [] and held.worst.level > 0.9999 * 30.0


@pytest.mark.extended
def test_rims_that_are_physics_do_not_hide_what_passes_them():
    case = rig.set_values(presets.find("cascaded/pi"), {"clock.substeps": 1})
    found = tuning.attack(case, starts=1, draws=4, iterations=0, windows=1)
    assert np.asarray(simulate(case.loop, case.clock).x).max() == 10.0
    assert found.found[0].nominal > 10.5
    assert "without overflow" in " ".join(found.to_json()["remarks"])


def test_starts_are_those_that_a_second_order_row_can_hold():
    """g >= 0 at t = 0 for the lower tanks of gouta2015, whatever the variables."""
    case = presets.find("gouta2015/backstepping").with_safety_filter()
    guard = case.loop.safety_filter
    attacked = Attacked(
        case=case, coefficients=coefficients_of(case), windows=1, pumps="own", start="any",
        noise=False, ceiling=np.asarray(guard.limit),
    )  # fmt: skip
    rates = rates_of(guard.least, guard.most, guard.inflow, 0.0)
    rng, lowered = np.random.default_rng(0), 0
    for _ in range(100):
        z = {k: np.round(rng.random(s), 1) for k, s in attacked.shapes.items()}
        x = np.asarray(attacked.values(z)["x0"])
        lowered += np.any(x < z["start"] * guard.limit - 1e-3)
        for i in (0, 1):
            above = sum(
                c * max(math.sqrt(x[j]), 0.05 * math.sqrt(30.0))
                for j, to, _, c in rates.links
                if to == i
            )
            assert rates.out[i] * math.sqrt(x[i]) + guard.slope[i] * (30.0 - x[i]) >= above
    assert 0 < lowered < 100


def test_coefficients_are_the_filters_box_or_the_ranges_of_distributions():
    case = presets.find("cascaded/pi").with_safety_filter(widths={"plant.drain[1]": 0.01})
    (one,) = coefficients_of(case)
    own = float(case.loop.plant.drain[1])
    assert (one.name, one.low, one.high) == ("plant.drain[1]", own - 0.01, own + 0.01)
    given = {
        "plant.pump_gain": tuning.Normal(relative=0.1, cut=2.0),
        "pair": tuning.Correlated(names=("plant.area[0]",), covariance=((1e-4,),), cut=3.0),
    }
    found = {c.name: c for c in coefficients_of(presets.find("cascaded/pi"), given)}
    gain, area = found["plant.pump_gain[0]"], found["plant.area[0]"]
    assert gain.low == pytest.approx(0.8 * gain.nominal) and gain.varies
    assert area.high == pytest.approx(area.nominal + 0.03) and not area.varies


@pytest.mark.parametrize(("case", "splits"), [("cascaded/pi", 0), ("mirakhorli/sfc", 2)])
def test_the_split_of_a_pump_into_one_tank_is_left_alone(case, splits):
    shares = {"plant.split": tuning.Uniform(low=0.5, high=0.9), "plant.drain": 0.05}
    names = [c.name for c in coefficients_of(presets.find(case), shares)]
    assert sum(name.startswith("plant.split") for name in names) == splits


def test_ascent_finds_the_corner_of_a_linear_function_and_the_top_of_a_hill():
    weights = np.array([1.0, -2.0, 0.5])
    linear = lambda z: (z["a"] @ weights, {"a": np.broadcast_to(weights, z["a"].shape)})
    found = ascend(linear, {"a": np.full((2, 3), 0.3)}, 5)
    assert found.z["a"].tolist() == [[1.0, 0.0, 1.0]] * 2
    top = np.array([0.3, 0.7])
    hill = lambda z: (-np.sum((z["a"] - top) ** 2, axis=1), {"a": 2.0 * (top - z["a"])})
    found = ascend(hill, {"a": np.array([[0.0, 0.0], [1.0, 0.2]])}, 60)
    assert found.z["a"] == pytest.approx(np.stack([top, top]), abs=0.05)
    assert np.all(np.diff(found.history, axis=0) >= 0.0)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"pumps": "ful"}, "pumps = 'ful': must be one of own, full, random"),
        ({"starts": 0}, "starts = 0"),
        ({"distributions": {"plant.drain": tuning.Discrete(values=(1.0, 2.0))}}, "is discrete"),
        ({"distributions": {"plant.drian": 0.1}}, "plant.drain"),
        ({"distributions": {"sensor.noise": 0.1}}, "leave out sensor.noise"),
        ({"distributions": {"x0[0]": 0.1}}, "leave out x0"),
    ],
)
def test_what_cannot_be_attacked_is_refused(given, words):
    with pytest.raises(InputError, match=words.replace(".", r"\.")):
        tuning.attack(presets.find("cascaded/pi"), **given)


@pytest.mark.slow
@pytest.mark.parametrize("pumps", ["own", pytest.param("random", marks=pytest.mark.slow)])
def test_the_filter_of_an_outflow_pump_withstands_attacks_that_pass_its_limit_without_it(pumps):
    case = rig.load(RIGS.parent / "cases" / "case31_safety_filter_outflow_pump.toml")
    case = rig.set_values(case, {"clock.duration": 200.0})
    few = {"starts": 1, "draws": 4, "iterations": 1, "windows": 1, "pumps": pumps}
    held = tuning.attack(case, **few)
    assert held.passed == [] and held.worst.certified and held.worst.level <= 2.0
    free = tuning.attack(case.without_safety_filter(), **few)
    # from the limit, with the pump off, 0.03 m^3/s raise 1 m^2 by 6 m in 200 s
    assert free.worst.level == pytest.approx(2.0 + 0.03 * 200.0)


OUTLET = """
units = ["m", "m3/h"]
dt = 5.0
duration = 7200.0
limits = {{ max_level = [9.0] }}
tank = [{{ name = "A", area = 2.0, rim = 20.0, level = 1.0 }}]
pump = [{{ name = "P", to = "A", high = 20.0, initial = 9.0 }}]
valve = [{{ name = "W", from = "A", area = 0.0015, low = 0.1, initial = 0.5 }}]
controller = {{ kind = {kind}, Kc = 20.0, Ti = 600.0 }}
reference = {{ initial = [1.0] }}
"""


@pytest.mark.parametrize(
    ("kind", "opening"), [('"ratio", lead = ["P"]', 0.5), ('"split-range", sequence = [1, 2]', 0.1)]
)
def test_full_commands_leave_an_outlet_by_hand_and_close_another(kind, opening):
    case = rig.loads(OUTLET.format(kind=kind))
    (run,) = tuning.attack(case, {"plant.pump_gain": 0.1}, **LEAST, pumps="full", start="own").found
    area = opening * 0.0015 * math.sqrt(2 * 9.81)
    h = 1.0
    for _ in range(72_000):  # steps of 0.1 s
        h += 0.1 * (20.0 / 3600.0 - area * math.sqrt(h)) / 2.0
    assert run.nominal == pytest.approx(h, rel=2e-4)

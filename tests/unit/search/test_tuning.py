"""The tuner: the acceptance figures of the four-tank, and what it promises of any problem."""

import dataclasses

import numpy as np
import pytest
from helpers import ONE_TANK

import jaxtank
import tuning
from jaxtank import rig
from jaxtank.core.errors import InputError
from tuning.problem.evaluator import Evaluator
from tuning.problem.problem import Problem
from tuning.problem.reported import run_measures
from tuning.problem.scenarios import screening_clock
from tuning.search import messages, screening
from tuning.search.options import options_of
from tuning.search.screening import screen, spectral_radius

FAST = {"clock.dt": 0.1, "clock.duration": 400.0}


# acceptance: at the case's own step of 0.01 s


@pytest.mark.slow
def test_ngpc_on_tracking_error_alone(gouta):
    """RMS 0.0820 -> at most 0.0405 cm, Tp near 5.15 s."""
    result = tuning.tune(
        gouta("ngpc"), nominal=True, free={"controller.Tp": (1.0, 60.0)}, limits={}
    )
    assert result.success and result.method == "trf"
    np.testing.assert_allclose(result.objective["before"], 0.0820, atol=5e-5)
    assert result.objective["after"] <= 0.0405
    np.testing.assert_allclose(result.parameters["controller.Tp"]["after"], 5.15, atol=0.02)
    assert len(result.starts) > 1 and all(s["cost"] < 0.0405 for s in result.starts)


@pytest.mark.slow
def test_backstepping_under_the_rims(gouta):
    """The published gains reach 33.1 cm in tank 4; the tuned ones keep every tank at or below
    30.000 cm, 0.636 cm or better.
    """
    few = tuning.Options(starts=2, screening=32)
    limited = tuning.tune(gouta("backstepping"), few)
    assert limited.success and limited.method == "slsqp"
    np.testing.assert_allclose(limited.measures["before"]["max_level"][3], 33.08, atol=0.05)
    again = jaxtank.evaluate(
        limited.tuned.loop, gouta("backstepping").clock, ["max_level", "rms_error_total"]
    )
    assert np.all(np.asarray(again["max_level"]) <= 30.0)
    assert float(again["rms_error_total"]) <= 0.636
    assert again["rms_error_total"] == pytest.approx(limited.objective["after"], rel=1e-9)
    side = np.linspace(0, 1, 24)
    zs = np.array([(a, b) for a in side for b in np.linspace(0.1, 0.6, 24)])
    costs, margins = limited.problem.screen(zs)
    best = costs[(margins >= 0).all(axis=1)].min()
    assert best >= limited.objective["after"] * (1 - 1e-6)


@pytest.fixture(scope="module")
def limited(gouta):
    few = tuning.Options(starts=2, screening=32, validation=0)
    return tuning.tune(gouta("backstepping"), few)


def of_one_tank(limits, most):
    """A search for both gains of a PI controller, the first one at most `most` [V/cm]."""
    few = tuning.Options(starts=2, screening=16, validation=0)
    free = {"controller.Kc": (0.05, most), "controller.Ti": (0.5, 100.0)}
    return tuning.tune(rig.loads(ONE_TANK), few, free=free, limits=limits)


@pytest.fixture(scope="module")
def bounded():
    return of_one_tank({"max_level": 2.7}, 8.0)


def test_the_answer_names_the_gain_that_the_objective_is_insensitive_to(bounded):
    """Above 8 V/cm the pump is at its limit during the step: a tenth of Kc changes the error by a
    hundredth of a percent (checked by runs).
    """
    gains = {name: bounded[name].after for name in bounded}
    for name, gain in gains.items():
        loop = jaxtank.with_values(bounded.case.loop, {**gains, name: 0.9 * gain})
        error = float(
            jaxtank.evaluate(loop, bounded.case.clock, "rms_error_total")["rms_error_total"]
        )
        change = 100 * abs(error / bounded.objective["after"] - 1)
        np.testing.assert_allclose(bounded[name].sensitivity_percent, change, rtol=1e-4)
    (found,) = [m.text for m in bounded.messages if m.code == "parameter-at-bound"]
    assert found.startswith("controller.Kc[0] ended at its upper bound")
    assert "the objective is insensitive to it (10 % changes it by" in found


@pytest.mark.parametrize(("runs", "codes"), [(0.6, ["integral-action-slow"]), (0.4, [])])
def test_integral_action_slower_than_half_the_run_is_reported(bounded, runs, codes):
    after = runs * bounded.case.clock.duration
    ti = bounded.parameters["controller.Ti[0]"] | {"after": after}
    result = dataclasses.replace(bounded, parameters={"controller.Ti[0]": ti})
    assert [m.code for m in messages.messages_of(result) if m.code.startswith("integral")] == codes


def test_distinct_starts_agree(bounded):
    starts = np.log([list(s["from"].values()) for s in bounded.starts])
    costs = [s["cost"] for s in bounded.starts if s["violation"] == 0]
    assert len(costs) == 2 and max(costs) < 1.002 * min(costs)
    assert np.linalg.norm(starts[0] - starts[1]) > 0.1


def test_first_order_conditions_hold(bounded):
    """At the end of a range, and where the total variation of the input is at its limit."""
    limited = of_one_tank({"input_travel": 2.2}, 50.0)
    for result, active in ((bounded, set()), (limited, {"input_travel of pump 1"})):
        assert result.optimality["kkt_residual"] < 1e-3 * result.optimality["gradient_norm"]
        assert set(result.optimality["multipliers"]) == active
    (row,) = limited.constraints
    assert row.active and row.multiplier > 0 and 0 <= row.margin < 1e-3


@pytest.mark.slow
def test_the_true_step_decides_on_gains_that_only_the_coarse_step_makes_unstable(
    gouta, monkeypatch
):
    """k + k1 = 30 1/s: three times the coarse step's stability limit of 2/0.1 s is passed, the true
    step's 2/0.01 s is not.
    """
    problem = Problem(gouta("backstepping"))
    coarse = screening_clock(problem.clock)
    assert coarse.dt == pytest.approx(0.1)
    at = lambda k: np.array([[float(problem.bounds[0].to_unit(k)), 0.3]])
    for k, unstable in ((5.0, False), (19.0, False), (21.0, True), (45.0, True)):
        assert (spectral_radius(problem, at(k), coarse)[0] > 1) == unstable
        assert spectral_radius(problem, at(k), problem.clock)[0] < 1
    monkeypatch.setattr(screening, "AFFORDED", 0)  # 32 points are few enough for the true step
    (zs, costs, _), redone = screen(Evaluator(problem), 32, 0)
    suspect = spectral_radius(problem, zs, coarse) > 1
    assert redone == suspect.sum() > 0
    true_costs, _ = problem.screen(zs)
    np.testing.assert_allclose(costs[suspect], true_costs[suspect], rtol=1e-9)
    chattering, _ = problem.screen(zs, coarse=True)
    assert np.any(np.abs(chattering[suspect] / true_costs[suspect] - 1) > 1e-3)


PENALISED = {"rms_error_total": 1.0, "rms_over_rim": 1.0, "saturation_excess": 0.5}


@pytest.mark.slow_for("46.0")
@pytest.mark.parametrize("Tp", [pytest.param(3.0, marks=pytest.mark.slow), 46.0])
def test_the_better_of_two_minima_is_found_from_either_side(gouta, Tp):
    """D = 30 s, penalised cost of gouta2015 notes S10: minima at 7.33 s (1.796) and 46 s (2.257), a
    ridge near 24 s between.
    """
    case = gouta("ngpc", {"reference.ramp": 30.0, "controller.Tp": Tp})
    result = tuning.tune(
        case,
        nominal=True,
        free={"controller.Tp": (1.0, 100.0)},
        objective=PENALISED,
        limits={},
        starts=4,
    )
    np.testing.assert_allclose(result.parameters["controller.Tp"]["after"], 7.33, atol=0.15)
    np.testing.assert_allclose(result.objective["after"], 1.796, rtol=5e-3)


@pytest.mark.extended_for("1-1.901")
@pytest.mark.parametrize(
    "Tp, cost",
    [(1, 1.901), (5, 1.833), (7.33, 1.796), (11, 1.956), (18, 2.340), (46, 2.257), (100, 2.648)],
)
def test_the_penalised_cost_is_that_of_the_tuning_study(gouta, Tp, cost):
    """At 0.05 s, the step of that study; at 0.01 s the far end, Tp = 100 s, is 0.5 % higher."""
    case = gouta("ngpc", {"reference.ramp": 30.0, "controller.Tp": float(Tp), "clock.dt": 0.05})
    values = jaxtank.evaluate(case.loop, case.clock, list(PENALISED))
    np.testing.assert_allclose(
        sum(w * float(values[m]) for m, w in PENALISED.items()), cost, rtol=5e-4
    )


# any problem


def quick(gouta, name="backstepping", values=None, method="auto", iterations=60, **options):
    few = {"starts": 2, "screening": 8, "validation": 0, "iterations": iterations}
    case = gouta(name, {**FAST, **(values or {})})
    return tuning.tune(case, options_of(method, **few), **options)


@pytest.mark.slow
def test_a_limit_of_no_overflow_can_be_met_and_is_held_by_the_answer(gouta):
    case = gouta("backstepping", {**FAST, "plant.overflow": True})
    few = tuning.Options(starts=2, screening=8)
    result = tuning.tune(case, few)
    assert result.success and max(c["value"] for c in result.constraints) <= 1e-3
    numeric = tuning.tune(case, few, limits={"max_level": 30.0})
    assert {c["measure"] for c in numeric.constraints} == {"overflow_volume"}


@pytest.mark.parametrize(
    "options, words",
    [
        ({"method": "newton"}, "newton"),
        ({"method": "trf"}, "--limit none"),
        ({"method": "trf", "limits": {}, "objective": {"iae": 1.0}}, "a mean of squares"),
        ({"free": {"controller.k": (0.1, 1.0)}}, "starts outside"),
        ({"free": {}}, "nothing to tune"),
        ({"limits": {"max_levels": 3}}, "max_level"),
        ({"limits": {"max_level": [30, 30]}}, "or 4 of them"),
        ({"objective": {"rms_error_total": 0.0}}, "above 0"),
        ({"starts": 0}, "whole number"),
    ],
)
def test_what_cannot_be_used_is_refused_before_anything_runs(gouta, options, words):
    with pytest.raises(InputError, match=words):
        quick(gouta, **options)


@pytest.mark.slow
def test_chatter_is_told_and_drawn(gouta, limited):
    """k + k1 = 22 1/s at a step of 0.1 s, past 2/dt: the pumps jump from limit to limit at every
    sample.
    """
    from tuning.report.simulated import run_for_people
    from tuning.search.messages import messages_of

    wild = gouta("backstepping", {"clock.dt": 0.1, "controller.k": 22.0})
    # and not the same sample of every pair
    assert np.abs(np.diff(run_for_people(wild).u, axis=0)).max() > 5.0
    result = limited
    calm = result.measures["before"]
    told = {"before": calm, "after": run_measures(wild.loop, wild.clock, None)}
    codes = lambda measures: [m.code for m in messages_of(result.replace(measures=measures))]
    assert "input-total-variation" in codes(told)
    everywhere = calm | {"input_travel": 1e9 * calm["input_travel"]}
    assert "input-chatters" in codes({"before": calm, "after": everywhere})
    same = codes({"before": calm, "after": calm})
    assert not {"input-total-variation", "input-chatters"} & set(same)


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_an_objective_of_zero_gives_no_share_and_no_warning():
    case = rig.set_values(
        rig.loads('case = "cascaded/pi"\n[reference]\ninitial = [4.0]\nchanges = []\n'),
        {"clock.duration": 40.0},
    )
    few = tuning.Options(starts=1, screening=4, validation=0)
    result = tuning.tune(case, few, free={"controller.Kc": (0.5, 2.0)})
    assert result.objective["after"] == 0.0
    assert result.parameters["controller.Kc[0]"]["sensitivity_percent"] is None

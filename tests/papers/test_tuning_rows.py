"""The table of tuned gains in benchmarks/README.md: every row is tuned anew, and compared with the
number of our re-derivation.
"""

import dataclasses
import functools
import json

import jax
import numpy as np
import pytest
import tuning_table
from tuning_rows import BOUNDS, ROWS, case_of

import jaxtank
import tuning
from jaxtank import presets


@functools.cache
def tuned(name):
    """The result of a row; the programs it was compiled to are let go, which over all rows would
    fill the memory.
    """
    result = tuning_table.tuned(name)
    jax.clear_caches()
    return result


def gain(name):
    """What tuning takes off the objective of a row [%]."""
    aim = tuned(name).objective
    return 100.0 * (1.0 - aim["after"] / aim["before"])


def own(name, values):
    """Cost of another case on what `name` is tuned for, at its own values with `values` set: the
    mean over the scenarios.
    """
    row = ROWS[name]
    problem = tuning.Problem(
        case_of(row),
        free=row.free,
        objective=row.objective,
        limits=row.limits,
        scenarios=row.scenarios,
    )
    z = [
        float(b.to_unit(values.get(b.name, b.from_unit(s))))
        for b, s in zip(problem.bounds, problem.start())
    ]
    return float(problem.screen(np.array([z]))[0][0])


def held(result):
    """Every limit holds at the case's own step, to the last digit."""
    return all(c["margin"] >= 0.0 for c in result.constraints)


SLOW = pytest.mark.slow


@SLOW
def test_calofir_ends_on_the_ridge():
    """The error is least for the smaller gain between 0.0205 and 0.024 1/s and the larger at or
    above 0.1 (calofir notes S10); which is which is free.
    """
    result = tuned("calofir-backstepping")
    small, large = sorted(p["after"] for p in result.parameters.values())
    assert held(result)
    ends = [s["cost"] for s in result.starts]  # searched until two agree
    assert len(ends) > 1 and max(ends) <= 1.001 * result.objective["after"]
    assert 0.0205 <= small <= 0.024 and large >= 0.1
    assert "exchange roles" in result.message


@SLOW
@pytest.mark.parametrize("name", [n for n, row in ROWS.items() if row.target])
def test_target(name):
    """Within 1 % of the number that was reached before, or half a unit of its last printed digit,
    or below.
    """
    row, result = ROWS[name], tuned(name)
    cost, near = result.objective["after"], float(row.target)
    # the error is 2 % less at the prototype's step, with the gains found at the case's own
    if row.step is not None:
        clock = dataclasses.replace(result.tuned.clock, dt=row.step)
        assert cost <= 1.03 * near
        cost = float(
            jaxtank.evaluate(result.tuned.loop, clock, ["rms_error_total"])["rms_error_total"]
        )
    digit = 0.5 * 10.0 ** -len(row.target.split(".")[1])
    assert cost <= near + max(0.01 * near, digit) and held(result)


@SLOW
@pytest.mark.parametrize("name", [n for n, row in ROWS.items() if not row.target])
def test_no_row_loses_and_limits_hold(name):
    result = tuned(name)
    assert held(result) and result.status != "infeasible"
    # the published gains pass the rim there, so their error is not one to reach
    if "-held-" not in name:
        assert result.objective["after"] <= result.objective["before"]


@SLOW
@pytest.mark.parametrize("controller", ["ngpc", "backstepping", "backstepping-ff"])
def test_plant_b_comes_within_half_of_the_open_loop_optimum(controller):
    asked = BOUNDS["gouta2015-B-60"]
    best = _bound("gouta2015-B-60")
    assert best.holds and asked.limits == {"max_level": "rim"}
    assert tuned(f"gouta2015-B-60-clip-free-{controller}").objective["after"] <= 1.5 * best.cost


@functools.cache
def _bound(name):
    return tuning.bound(case_of(BOUNDS[name]), BOUNDS[name].objective, BOUNDS[name].limits)


# published over tuned, gouta2022 notes S10: 1.602/.505, .885/.534, .815/.579, 1.105/.657; noise is
# another draw: 1 %
@SLOW
@pytest.mark.parametrize(
    "delay, ratio", [("0", 3.172), ("0.2", 1.657), ("0.5", 1.408), ("1", 1.682)]
)
def test_chadpc_with_a_delay(delay, ratio):
    result = tuned(f"gouta2022-delay-{delay}")
    assert result.objective["before"] / result.objective["after"] >= 0.99 * ratio
    assert "the gain k = 1.5/Tp and the observer's l exchange roles" in result.message


@SLOW
def test_state_feedback_is_better_by_a_fifth_on_plants_and_seeds_out_of_sample():
    """mirakhorli notes S10: 10846 to 8566 in sum over nine plants at twice the step; the published
    K costs the same to 2 % here.
    """
    found = tuning_table.held_out(ROWS["mirakhorli-sfc"], tuned("mirakhorli-sfc"))
    assert found["runs"] == 27 and found["after"] <= 0.8 * found["before"]
    np.testing.assert_allclose(9 * found["before"], 10846.2, rtol=0.02)


@pytest.mark.slow
def test_on_the_nominal_run_there_is_nothing_to_gain():
    """mirakhorli notes S10: the printed K is the linear-quadratic gain, 0.03 % above the best; and
    no law could do better, by another search.
    """
    result = tuned("mirakhorli-sfc-nominal")
    assert result.success and held(result) and 0.0 <= gain("mirakhorli-sfc-nominal") < 0.1
    # without the price of travel, left sum of 0.1 s: the notes have 4512.7 by trapezoids, and 14.4
    # for the first half sample
    cost = (
        result.measures["after"]["ise"].sum()
        + 3.0 * result.measures["after"]["input_deviation"].sum()
    )
    np.testing.assert_allclose(cost - 14.4, 4512.7, rtol=1e-3)


@SLOW
@pytest.mark.parametrize("name", ["mirakhorli-hybrid", "mirakhorli-hybrid-K"])
def test_the_hybrid_is_not_worse_than_the_published_state_feedback(name):
    assert tuned(name).objective["after"] <= own("mirakhorli-sfc", {})


@SLOW
def test_integral_action_beats_tuned_state_feedback_before_it_is_tuned():
    """On runs unseen, mirakhorli notes S10: 6801 against 8566 in sum."""
    integral = tuning_table.held_out(ROWS["mirakhorli-lqi"], tuned("mirakhorli-lqi"))
    proportional = tuning_table.held_out(ROWS["mirakhorli-sfc"], tuned("mirakhorli-sfc"))
    assert integral["before"] < proportional["after"]


# least gains of khalid notes S10 [%]: without limits, and with the price of overshoot that makes
# the rest felt. The prototype prices the
# first rise alone and has 6.3 % there; here the falls are priced too
@SLOW
@pytest.mark.parametrize(
    "name, least",
    [
        ("khalid-laguerre", 11.0),
        ("khalid-clipped-priced", 6.1),
        ("khalid-constrained-priced", 6.1),
        ("khalid-mimo", 31.0),
        ("khalid-mimo-constrained", 1.5),
        # prototype: 23 %, from a first value of 14.40 that its own table rules out
        # (test_khalid.py); its last value is met by `test_target`
        ("khalid-mimo-constrained-M3", 1.7),
    ],
)
def test_gains_of_the_predictive_controllers(name, least):
    assert gain(name) >= least


def test_the_table_is_that_of_the_store():
    """Every stored row is one of ours, its limits hold, and benchmarks/README.md shows it."""
    stored = json.loads(tuning_table.STORE.read_text())
    assert set(stored["rows"]) <= set(ROWS) and set(stored["bounds"]) <= set(BOUNDS)
    limits = [row["limits"]["after"] for row in stored["rows"].values()]
    assert all(limit is None or limit["violation"] == 0.0 for limit in limits)
    assert all(bound["holds"] for bound in stored["bounds"].values())
    text = tuning_table.measuring.README.read_text()
    assert f"{tuning_table.BEGIN}\n{tuning_table.markdown(stored)}\n{tuning_table.END}" in text


def test_rows_name_what_exists():
    for row in [*ROWS.values(), *BOUNDS.values()]:
        case = case_of(row)
        assert row.case in presets.names() and case.loop is not None
    assert {row.bound for row in ROWS.values()} - {None} <= set(BOUNDS)

"""What is known of a measure stands in its entry of the catalogue: reports, limits and studies read
it there.
"""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest

import jaxtank
import tuning
from jaxtank import measures as ms, presets, rig
from jaxtank.core.errors import InputError
from jaxtank.limits import Limit
from jaxtank.measures import Accumulator, Measure
from tuning.cli.main import main
from tuning.report.tables import reasons
from tuning.uncertainty.sensitivity_study import check_measures

MINE = Measure(
    "cm", "tank", ("min_level",), ms.MEASURES["min_level"].read, "lowest level, again", sense=-1.0,
    counts=True, summary=65, shown=45, reached="time_of_min_level",
    undefined="no reason of its own",
)  # fmt: skip


@pytest.fixture
def with_mine(monkeypatch):
    """A measure added from outside the packages: one entry of one table."""
    monkeypatch.setitem(ms.MEASURES, "mine", MINE)
    return "mine"


def test_a_limit_of_a_measure_added_from_outside_has_the_side_that_the_measure_names(with_mine):
    low, high = Limit(with_mine, 0, 2.0), Limit("max_level", 0, 2.0)
    assert [limit.margins([3.0])[0] for limit in (low, high)] == [1.0, -1.0]
    assert Limit("settling_time", 0, 2.0).margins([np.nan])[0] > 0.0  # it never left its band
    assert low.margins([np.nan])[0] < 0.0


def test_a_measure_added_from_outside_is_listed_where_it_asks_to_be(with_mine):
    summary, shown = ms.placed("summary"), ms.placed("shown")
    assert summary[summary.index(with_mine) - 1] == "max_level"
    assert shown[shown.index(with_mine) - 1] == "max_level"


def test_a_settling_time_that_is_none_has_the_one_cause_that_applies():
    outside, inside = (
        reasons({"settling_time": [v, v]})["settling_time"] for v in (np.inf, np.nan)
    )
    assert "the run ended" in outside and "took the output out of its band" in inside
    both = reasons({"settling_time": [np.inf, 2.0, np.nan]})["settling_time"]
    assert both == f"output 1: {outside}, output 3: {inside}"
    assert "settling_time" not in reasons({"settling_time": [1.0, 2.0]})


def test_what_a_measure_added_from_outside_states_is_reported_and_enforced(with_mine):
    case = presets.find("cascaded/pi")
    assert reasons({with_mine: [np.nan, 1.0]})[with_mine] == "no reason of its own"
    with pytest.raises(InputError, match="counts whole samples"):
        check_measures(case, with_mine, "local")
    assert check_measures(case, with_mine, "morris") == (with_mine,)
    with pytest.raises(InputError, match="has no derivative by every input"):
        tuning.bound(case, objective={with_mine: 1.0})


@pytest.mark.slow
def test_an_ensemble_takes_the_worse_side_of_a_measure_added_from_outside(with_mine):
    case = presets.find("cascaded/pi")
    clock = dataclasses.replace(case.clock, duration=20.0 * case.clock.dt)
    found = tuning.ensemble(
        dataclasses.replace(case, clock=clock),
        samples=4,
        measures=[with_mine, "min_level"],
        limits={},
        fan=False,
    )
    summary = found.summary()
    np.testing.assert_array_equal(summary[with_mine]["cvar95"], summary["min_level"]["cvar95"])
    assert np.all(summary[with_mine]["cvar95"] <= summary[with_mine]["mean"])


def _fastest(run, state, sample, context):
    before, largest = state
    rate = jnp.abs(sample.u[0] - before) / run.dt
    return sample.u[0], jnp.maximum(largest, jnp.where(sample.t > 0.0, rate, 0.0))


FASTEST = Accumulator(lambda run: (run.zero, run.zero), _fastest)
RATE = Measure(
    "V/s", "run", ("fastest",), lambda run, acc: acc["fastest"][1], "fastest change of the input"
)
ERROR = Measure(
    "cm^2", "output", ("e2",), lambda run, acc: jnp.stack([3.0 * e for e in acc["e2"]]),
    "three times the sum of the squared errors", residual="e2", scale=lambda run: 3.0,
)  # fmt: skip
RIG = """
case = "cascaded/pi"
name = "own"
values = { "clock.dt" = 0.5, "clock.duration" = 450.0 }
objective = { triple = 1.0 }
limits = { input_rate = 40.0 }
uncertain = { "plant.pump_gain" = 0.05 }
"""


@pytest.fixture
def registered():
    """Two measures of a user's own, "input_rate" and "triple"; afterwards there are none."""
    ms.register("input_rate", RATE, {"fastest": FASTEST})
    ms.register("triple", ERROR)
    yield
    for table in (ms.MEASURES, ms.ACCUMULATORS):
        for key in ("input_rate", "triple", "fastest"):
            table.pop(key, None)


@pytest.mark.parametrize("measures", [max, [max], ["max_level", 3], 3, None])
def test_what_is_no_name_is_refused_as_a_measure(measures):
    with pytest.raises(InputError, match="must be a name"):
        jaxtank.evaluate(presets.find("cascaded/pi"), measures)


@pytest.mark.slow
def test_a_registered_measure_is_evaluated_with_its_derivative(registered):
    case = rig.loads(RIG)
    run = jaxtank.simulate(case.loop, case.clock)
    values = jaxtank.evaluate(case.loop, case.clock, ["input_rate", "triple"])
    rate = np.abs(np.diff(np.asarray(run.u)[:, 0])).max() / case.clock.dt
    np.testing.assert_allclose(values["input_rate"], rate, rtol=1e-12)
    np.testing.assert_allclose(values["triple"], 3.0 * np.sum(run.e**2, axis=0), rtol=1e-12)
    point = {"controller.Kc": case.loop.controller.Kc}
    found = jaxtank.sensitivities(case.loop, case.clock, ["triple"], point, squares={"triple": 1.0})
    step = {"controller.Kc": case.loop.controller.Kc * (1 + 1e-6)}
    away = jaxtank.evaluate(jaxtank.with_values(case.loop, step), case.clock, ["triple"])
    slope = (away["triple"] - found[0]["triple"]) / (1e-6 * point["controller.Kc"])
    np.testing.assert_allclose(found[1]["triple"][:, 0], slope, rtol=1e-4)
    assert found[2].shape == (1, 1) and float(found[2][0, 0]) > 0.0


@pytest.mark.slow
def test_a_registered_measure_is_tuned_by_limited_and_drawn(registered):
    case = rig.loads(RIG)
    assert rig.loads(rig.dump(case)).objective == {"triple": 1.0}
    result = tuning.tune(case, tuning.SQP(starts=1, screening=2, iterations=5, validation=0))
    assert result.objective["after"] <= result.objective["before"]
    assert result.measures["after"]["triple"] == pytest.approx([result.objective["after"]])
    assert [row["name"] for row in result.constraints] == ["input_rate"]
    draws = tuning.ensemble(case, samples=4, measures=["input_rate", "triple"], fan=False)
    rates = np.asarray(draws.measures["input_rate"])
    assert rates.shape[0] == 4 and len(np.unique(rates)) == 4


def test_the_command_reports_a_registered_measure_of_a_rig_file(registered, tmp_path, capsys):
    path = tmp_path / "own.toml"
    path.write_text(RIG)
    assert main(["simulate", str(path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["measures"]["input_rate"] > 0.0 and found["units"]["input_rate"] == "V/s"


def test_measures_that_no_run_could_compute_are_refused():
    for name, measure, own, words in (
        ("max_level", RATE, {}, "measure 'max_level' is built in"),
        ("two words", RATE, {}, "must be a text of letters"),
        ("rate", "max_level", {}, "is a str: must be a jaxtank.measures.Measure"),
        ("rate", RATE, {}, "unknown accumulator 'fastest'"),
        ("rate", RATE, {"e2": FASTEST}, "accumulator 'e2' is built in"),
        ("rate", RATE, {"fastest": len}, "must be a jaxtank.measures.Accumulator"),
        ("rate", RATE._replace(per="pipe"), {"fastest": FASTEST}, "per = 'pipe': must be one of"),
        ("rate", RATE._replace(reached="never"), {"fastest": FASTEST}, "unknown measure 'never'"),
        ("rate", ERROR._replace(residual="u2"), {}, "needs an accumulator with a residual"),
        (
            "rate",
            RATE,
            {"fastest": FASTEST._replace(refers_to="pump")},
            "refers_to = 'pump': must be one of",
        ),
    ):
        with pytest.raises(InputError, match=words) as refused:
            ms.register(name, measure, own)
        assert "\n" not in str(refused.value)
    assert "rate" not in ms.MEASURES and "fastest" not in ms.ACCUMULATORS


def test_a_measure_registered_again_is_computed_anew():
    case = presets.find("cascaded/pi")
    clock = dataclasses.replace(case.clock, duration=4.0 * case.clock.dt)
    values = []
    for factor in (2.0, 5.0):
        read = lambda run, acc, factor=factor: factor * acc["slack"] + factor
        ms.register("again", Measure("cm", "run", ("slack",), read, "a factor"))
        values.append(float(jaxtank.evaluate(case.loop, clock, ["again"])["again"]))
    assert values == [2.0, 5.0]


def test_a_function_that_no_package_has_can_be_named_in_no_rig_file():
    ms.register("peak", ms.from_function(lambda run: jnp.max(run.x)))
    assert ms.unreadable(["peak", "ise"]) == ("peak",) and ms.unreadable(["ise"]) == ()


def test_margins_need_setpoints_that_are_held(monkeypatch):
    loop = presets.find("cascaded/pi").loop
    assert ms.serves("gain_margin", loop)
    monkeypatch.setattr(type(loop.reference), "held", lambda self: None)
    assert not ms.serves("gain_margin", loop) and ms.serves("max_level", loop)

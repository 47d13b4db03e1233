"""The default answer of `tune`: what it minimises, where it stays, how it is judged and printed."""

import dataclasses
import gc
import json
import pickle
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from helpers import ONE_TANK as TANK, command, programs_compiled

import jaxtank
import tuning
from jaxtank import presets, rig
from jaxtank.case import Scenario
from jaxtank.core.errors import InputError
from jaxtank.core.tree import with_values
from jaxtank.live import page
from jaxtank.xla import jit
from tuning.problem.pairing import unstable_signs
from tuning.problem.problem import Problem
from tuning.report.tuned import advice_of
from tuning.search import default
from tuning.search.judged import judge
from tuning.search.messages import _margins_not_known, _stated_in_scenarios, messages_of
from tuning.search.setting import input_range, setting_of
from tuning.search.tuner import _parameters
from tuning.uncertainty.draws import Draws
from tuning.uncertainty.sampling import Points
from tuning.uncertainty.validation import SEED_OFFSET


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    file = tmp_path_factory.mktemp("rig") / "one.toml"
    file.write_text(TANK)
    return str(file)


@pytest.fixture(scope="module")
def case(path):
    return rig.load(path)


@pytest.fixture(scope="module")
def counted(case):
    """(the default answer, how often it compiled each program until it was printed)."""
    with programs_compiled() as programs:
        result = tuning.tune(case, tuning.Options(validation=24))
        assert "converged" in str(result.report())
        assert not any(result.measures[side].made for side in ("before", "after"))
        return result, programs


@pytest.fixture(scope="module")
def result(counted):
    return counted[0]


TWO = """
units = ["cm", "V"]
tank = [{{ area = 200.0, rim = 40.0, drain = 0.8, level = 10.0 }},
    {{ area = 200.0, rim = 40.0, drain = 0.8, level = 10.0 }}]
pump = [{{ to = 1, gain = 1.0, high = 400.0, initial = 112.0 }},
    {{ to = 2, gain = {gain}, high = {high}, initial = {initial} }}]
plant = {{ outputs = [1, 2] }}
sensor = [{{ noise = 0.04 }}, {{ noise = 0.04 }}]
controller = {{ kind = "pi", Kc = [20.0, {Kc}], Ti = [60.0, 40.0] }}
reference = {{ initial = [10.0, 10.0], changes = [[20.0, 2, 12.0]], ramp = 0.0 }}
values = {{ "clock.dt" = 1.0, "clock.duration" = 200.0 }}
"""


@pytest.mark.extended
def test_changes_of_each_input_are_priced_in_its_own_range():
    key, costs = jax.random.key(3), []
    for scale in (1.0, 400.0):  # the second pump from 0 to 400, and from 0 to 1
        numbers = dict(gain=scale, high=400 / scale, initial=112 / scale, Kc=30 / scale)
        case = rig.loads(TWO.format(**numbers))
        objective = setting_of(case).objective
        measures = jaxtank.evaluate(case.loop, case.clock, list(objective), key)
        costs.append([w * np.sum(np.asarray(measures[m])) for m, w in objective.items()])
    np.testing.assert_allclose(costs[0], costs[1], rtol=1e-9)
    assert costs[0][1] > 0.05 * costs[0][0]  # a price that counts


def test_the_cost_is_the_squared_error_and_one_percent_of_range_for_half_a_percent_of_rim():
    found = setting_of(presets.find("gouta2015/backstepping"))
    # (0.005 x 30 cm)^2 / (2 pumps x (0.01 x 12 V)^2)
    assert found.objective == {"mean_square_error": 1.0, "mean_square_jitter": 0.0225 / 0.0288}
    assert (found.noise.max(), found.assumed, found.stated) == (0.03, True, True)
    assert np.array_equal(found.searched.loop.sensor.noise, np.full(4, 0.03))


def test_noise_that_the_case_or_a_scenario_states_is_used():
    assert np.all(setting_of(presets.find("gouta2022/chadpc")).noise == 0.02)  # of its scenario
    own = rig.set_values(presets.find("cascaded/pi"), {"sensor.noise": 0.05})
    assert (setting_of(own).noise.max(), setting_of(own).assumed) == (0.05, False)


def test_noise_that_nobody_states_is_a_share_of_the_height_of_each_tank():
    case = presets.find("gouta2015/backstepping")
    low = case.replace(loop=with_values(case.loop, {"plant.rim": [30.0, 5.0, 30.0, 30.0]}))
    setting = setting_of(low)
    np.testing.assert_allclose(setting.noise, [0.03, 0.005, 0.03, 0.03])
    assert np.array_equal(setting.searched.loop.sensor.noise, setting.noise) and setting.assumed


def test_an_objective_of_the_users_own_is_minimised_as_it_is(case):
    own = case.replace(name="mine", objective={"iae": 2.0})
    assert setting_of(own).objective == {"iae": 2.0} and setting_of(own).own_objective
    assert setting_of(case, {"ise": 1.0}).objective == {"ise": 1.0}
    preset = presets.find("gouta2022/chadpc")  # its objective belongs to --nominal
    assert not setting_of(preset).own_objective
    assert setting_of(preset.replace(objective={"iae": 2.0})).own_objective


def test_limits_of_a_model_are_not_the_range_of_a_pump(case):
    assert input_range(case).tolist() == [2.0]
    model = rig.set_values(case, {"actuator.low": [-1000.0], "actuator.high": [1000.0]})
    used = jaxtank.evaluate(model.loop, model.clock, ["rms_input"])["rms_input"]
    assert input_range(model).tolist() == pytest.approx([2.0 * float(used[0])])
    both_ways = rig.set_values(case, {"actuator.low": [-3.0], "actuator.high": [3.0]})
    assert input_range(both_ways).tolist() == [6.0]


def test_a_rig_that_names_nothing_uncertain_has_flows_five_percent_off(case):
    found = setting_of(case.replace(uncertain={}))
    assert not found.stated
    assert {n: d.relative for n, d in found.distributions.items()} == {
        "plant.drain": 0.05,
        "plant.pump_gain": 0.05,
    }


def test_shares_that_are_asked_for_are_the_box_of_the_filter(case):
    found = setting_of(case, distributions={"plant.drain": 0.2}).with_filter()
    assert dict(found.case.uncertain) == {"plant.drain": 0.2}
    least, own = found.searched.loop.safety_filter.least, case.loop.plant
    assert np.allclose(least.drain, 0.8 * np.asarray(own.drain))
    assert np.allclose(least.pump_gain, own.pump_gain)


@pytest.mark.parametrize("share", [0.1, 0.099, 0.101])
def test_an_interval_is_proved_where_it_lies_within_those_of_the_filter(case, share):
    """Whatever its form: the case states 10 % of the drain, 2."""
    interval = tuning.Uniform(low=2.0 * (1.0 - share), high=2.0 * (1.0 + share))
    (row,) = setting_of(case, distributions={"plant.drain": interval}).with_filter().certificates
    assert row.certified == (share <= 0.1)


@pytest.mark.parametrize(
    "changes, distributions, why",
    [
        ({}, {"plant.drain": tuning.Normal(relative=0.1)}, "reach beyond the tolerances"),
        ({}, {"plant.drain": tuning.Uniform(low=1.8, high=2.5)}, "reach beyond the tolerances"),
        ({"limit": [2.9]}, None, "is above that on max_level, 2.7"),
        ({"band": [0.012]}, None, "below 5 standard deviations of the noise"),
    ],
)
@pytest.mark.parametrize("names_tolerances", [True, False])
def test_nothing_is_called_proved_that_the_filter_does_not_cover(
    case, changes, distributions, why, names_tolerances
):
    case = case if names_tolerances else case.replace(uncertain={})
    case = case.with_safety_filter(**changes) if changes else case
    found = setting_of(case, distributions=distributions)
    found = found if changes else found.with_filter()
    (row,) = found.certificates
    assert not row.certified and why in row.reason
    assert dict(found.limits) == {"max_level": 2.7}  # still to be kept by the search


@pytest.mark.extended
def test_scenarios_are_what_an_answer_is_judged_on(case):
    """Every second plant in each of two scenarios, with the numbers of the scenario alone."""
    weak = {"plant.drain[0]": 0.5 * float(case.loop.plant.drain[0])}
    quiet = case.replace(loop=with_values(case.loop, {"sensor.noise": [1e-9]}))
    mixed = quiet.replace(scenarios=(Scenario("weak", weak), Scenario("as it is", {})))
    judged = tuning.validate(mixed, samples=7)
    assert judged.runs == "plants in 2 scenarios" and judged.error.shape == (7,)
    usual = tuning.validate(quiet, samples=7)
    np.testing.assert_allclose(judged.error[1::2], usual.error[1::2], rtol=1e-6)
    gains = rig.loads(TANK).loop.plant.pump_gain  # half the outflow, and the drawn gain of the pump
    space = Draws(quiet.loop, setting_of(quiet).distributions)
    drawn = space.values(Points("random", space.dimensions, 7, SEED_OFFSET).rows(0, 7))
    for i in range(0, 7, 2):
        gain = np.ravel(drawn["plant.pump_gain"][i]) * np.ones_like(gains)
        loop = with_values(quiet.loop, weak | {"plant.pump_gain": gain})
        error = jaxtank.evaluate(loop, quiet.clock, ["rms_error_total"], jax.random.key(0))
        assert judged.error[i] == pytest.approx(float(error["rms_error_total"]), rel=1e-6)
    assert judged.infeasible.shape == (7,)
    result = SimpleNamespace(answer=SimpleNamespace(setting=setting_of(mixed)))
    assert list(_stated_in_scenarios(result)) == [
        "scenarios state plant.drain, which then do not vary within their tolerance"
    ]
    (row,) = setting_of(mixed).with_filter().certificates
    assert not row.certified and setting_of(quiet).with_filter().certificates[0].certified


def test_a_scenario_that_lasts_until_more_flows_in_is_no_part_of_a_proof():
    """The inflow rises at 15 s, after the end of the case's own run of 10 s."""
    inflow = "[[inflow]]\ntank = 1\nchanges = [[15.0, 1.0]]\n"
    case = rig.set_values(rig.loads(TANK + inflow), {"clock.duration": 10.0})
    case = case.replace(limits={"max_level": "rim"}, uncertain={"plant.drain": 0.05})
    case = case.with_safety_filter()
    durations = lambda *s: tuple(Scenario(f"{v:g}", {"clock.duration": v}) for v in s)
    for scenarios, proved in ((durations(8.0, 14.0), True), (durations(8.0, 20.0), False)):
        (row,) = setting_of(case.replace(scenarios=scenarios)).certificates
        assert row.certified is proved


def test_scenarios_by_the_names_of_a_rig_each_with_a_plant_and_its_own_rim():
    """One tank that stands at 1 cm: 9 scenarios for 4 plants, of which the last has a low rim."""
    text = TANK.replace("{ area = 20.0,", '{ name = "LT1", area = 20.0,').replace("2.6]]", "1.0]]")
    case = rig.loads(text.replace("limits = { max_level = 2.7 }", 'limits = { max_level = "rim" }'))
    others = [Scenario(f"s{k}", {"LT1.drain": 2.0}) for k in range(8)]
    case = case.replace(scenarios=(*others, Scenario("low", {"LT1.rim": 0.9})))
    judged = tuning.validate(case, samples=4)
    assert judged.samples == 9 and judged.held.tolist() == [True] * 8 + [False]
    assert judged.runs == "plants in 9 scenarios"
    assert len(setting_of(case).plants(case, 4, 0)) == 9
    weak = case.replace(scenarios=(Scenario("weak", {"LT1.drain": 1.0}),))
    dotted = case.replace(scenarios=(Scenario("weak", {"plant.drain[0]": 1.0}),))
    errors = [tuning.validate(c, samples=4).error for c in (weak, dotted)]
    np.testing.assert_array_equal(*errors)
    with pytest.raises(InputError, match="samples = 4: must be at least the number of scenarios"):
        tuning.tune_robust(case, samples=4)


@pytest.mark.slow
def test_a_share_is_that_of_every_flow_where_a_rig_names_nothing(path, tmp_path):
    (tmp_path / "bare.toml").write_text(TANK.replace("uncertain = {", "# {"))
    words = ["--validation", "8", "--starts", "1", "--iterations", "1", "--json", "--quiet"]
    said = command("tune", str(tmp_path / "bare.toml"), "--spread", "0.2", *words)
    assert set(said.json["validation"]["spread"].values()) == {0.2}


@pytest.mark.extended
def test_plants_that_cannot_follow_are_those_of_the_limits(case):
    """2.6 cm is the highest setpoint: 2.5 cm as the limit leaves no plant that can follow."""
    limited = setting_of(case, limits={"max_level": 2.5})
    assert judge(limited, 3, 0).infeasible.all()
    assert not judge(setting_of(case), 3, 0).infeasible.any()


@pytest.mark.slow
def test_noise_that_is_drawn_once_gives_the_same_bits(case):
    setting = setting_of(case)
    plants = setting.plants(setting.searched, 3, 0)
    stated = setting.searched, None, setting.objective, {}, plants
    a, b = (Problem(*stated, draw_noise=drawn) for drawn in (False, True))
    assert b.groups[0].noise.shape == (3, 1, case.clock.samples)
    z = a.start()
    assert a.point(z).cost == b.point(z).cost
    assert np.array_equal(a.point(z).gradient, b.point(z).gradient)


@pytest.mark.extended
def test_a_judged_plant_is_the_run_alone(case):
    setting = setting_of(case)
    judged = judge(setting, 3, 5)
    found = tuning.ensemble(
        setting.searched, samples=3, key=1_000_008, measures=["rms_error_total"], fan=False
    )
    for i in range(3):
        values = {n: v[i] for n, v in found.values.items()}
        key = jax.random.fold_in(jax.random.key(1_000_008), i)
        names = ["rms_error_total", "mean_square_jitter", "mean_square_error"]
        loop = with_values(setting.searched.loop, values)
        alone = jaxtank.evaluate(loop, setting.searched.clock, names, key)
        assert float(alone["rms_error_total"]) == pytest.approx(judged.error[i], rel=1e-9)
        changes = np.sqrt(np.asarray(alone["mean_square_jitter"]))
        assert changes[0] / 2.0 == pytest.approx(judged.travel[i], rel=1e-9)  # 2 V
        price = setting.objective["mean_square_jitter"]
        cost = float(np.sum(alone["mean_square_error"])) + price * changes[0] ** 2
        assert cost == pytest.approx(judged.cost[i], rel=1e-9)


@pytest.mark.extended
def test_the_nominal_plant_runs_beside_the_judged_ones(case):
    """Without noise, as the run alone; how many plants there are changes nothing."""
    setting = setting_of(case)
    few, many = judge(setting, 3, 5), judge(setting, 300, 5)
    assert few.error == pytest.approx(many.error[:3], rel=1e-12)
    names = ["rms_error_total", "rms_error", "settling_time"]
    alone = jaxtank.evaluate(case.loop, case.clock, names)
    for judged in (few, many):
        for name in names:
            np.testing.assert_allclose(judged.nominal[name], alone[name], rtol=1e-12)


@pytest.mark.slow
def test_noise_that_a_case_states_is_in_its_own_run():
    noisy = presets.find("gouta2015/ngpc-observer")
    noisy = rig.set_values(noisy, {"sensor.noise": 0.02, "clock.dt": 1.0})
    assert judge(setting_of(noisy), 2, 0).nominal is None


@pytest.mark.slow
def test_what_only_a_report_shows_is_run_when_it_is_asked_for(case):
    result = tuning.tune(case, tuning.Options(validation=8, starts=1, iterations=2))
    str(result)
    before = result.measures["before"]
    assert not before.made and "iae" in before and "nothing" not in before
    with pytest.raises(KeyError):
        before["nothing"]
    assert not before.made
    alone = jaxtank.evaluate(case.loop, case.clock, ["iae", "rms_error_total"])
    np.testing.assert_allclose(before["iae"], alone["iae"], rtol=1e-12)
    assert before.made and len(dict(before)) == len(before)
    other = pickle.loads(pickle.dumps(result.measures))
    assert type(other["after"]) is dict
    assert sorted(other["after"]) == sorted(result.measures["after"])
    assert repr(result.measures["after"]).startswith("{'")
    error = float(alone["rms_error_total"])
    assert result.answer.nominal["before"] == pytest.approx(error, rel=1e-12)
    assert result.to_json()["measures"]["before"]["rms_error_total"] == pytest.approx(error)


def test_margins_that_are_not_known_are_told_where_gains_were_changed():
    change = {"before": 1.0, "after": 2.0}
    notes = lambda peak, **p: [
        *_margins_not_known(
            SimpleNamespace(parameters={"k": {**change, **p}}, measures={"after": peak})
        )
    ]
    assert "may be fragile" in notes({})[0] and notes({"sensitivity_peak": np.nan})
    assert not notes({"sensitivity_peak": 1.3}) and not notes({"sensitivity_peak": np.inf})
    assert not notes({}, after=1.0)


DEFAULT_ANSWER = {"_run": 2, "_slopes": 1, "_values": 1, "_at_plateau": 1}
DEFAULT_ANSWER |= {"simulate_compiled": 1, "_drawn": 1}
"""Programs of a default answer: judging without the safety filter and with it, derivatives and
values of the search's plants, stability margins; the run of the answer, the noise of the search."""


def test_a_default_answer_has_seven_programs(counted):
    large = {part.__name__ for part in gc.get_objects() if isinstance(part, jit.Kept)}
    assert {name: n for name, n in counted[1].items() if name in large} == DEFAULT_ANSWER


def test_another_value_in_the_same_process_compiles_nothing(case):
    result = tuning.tune(case, tuning.Options(validation=24))  # between tests programs may go
    other = rig.set_values(case, {"plant.drain[0]": 1.01 * float(case.loop.plant.drain[0])})
    with programs_compiled(cold=False) as programs:
        again = tuning.tune(other, tuning.Options(validation=24))
    assert again.tuned.loop.safety_filter.held == result.tuned.loop.safety_filter.held
    assert not programs


def test_validate_gives_what_judged_the_answer(result, case):
    again = tuning.validate(result.tuned, 24)
    assert np.array_equal(again.error, result.answer.after.error)
    assert again.to_json() == result.to_json()["answer"]["plants"]["after"]
    assert "limits held: 100 % of 24 plants" in str(again) and "<" in again._repr_html_()
    with pytest.raises(InputError, match="samples = 0"):
        tuning.validate(case, 0)


def test_limits_hold_on_plants_that_no_search_has_used(result):
    answer = result.answer
    assert result.status == "converged" and answer.held and answer.after.samples == 24
    assert answer.before.held.mean() < 0.5 and answer.before.level.max() > 2.75
    assert result.tuned.loop.safety_filter.held == (0,)
    assert [row.certified for row in answer.setting.certificates] == [True]
    assert answer.after.level.max() < 2.7
    # the same plants and noise before and after: a run of the case as given repeats the first row
    assert answer.after.error.mean() < answer.before.error.mean()
    assert np.corrcoef(answer.after.error, answer.before.error)[0, 1] > 0.5


def test_the_json_has_the_keys_of_the_contract(result):
    found = json.loads(json.dumps(result.to_json(), allow_nan=False))
    holds = found["holds"]
    assert (holds["limits_on_validation"], holds["samples"]) == (1.0, 24)
    assert [row["tank"] for row in holds["certified"]] == [1]
    assert set(holds["certified"][0]) == {"tank", "certified", "why", "starts"}
    assert found["answer"]["safety_filter"]["band"] == pytest.approx(
        [0.018]
    )  # 6 x 0.1 % of the rim
    row = found["constraints"][0]
    assert row["margin"] >= 0 and row["scenario"] == "the worst of 24 plants"


def test_the_page_of_an_answer_judges_the_limits_that_the_filter_keeps(result, monkeypatch):
    """The search itself has none of them: they are proved."""
    monkeypatch.setattr(page, "page", lambda case, *_: str(dict(case.limits)))
    assert not result.problem.limits
    assert result.explore().text == "{'max_level': 2.7}"


def test_the_answer_fits_a_terminal(result):
    text = str(result)
    # beside the tuning rules, which have a table of their own
    assert len(text.splitlines()) <= 27 + 4 + len(result.rules)
    assert max(map(len, text.splitlines())) <= 80
    assert "limits hold on 24 of 24 validation plants, proved for tank 1" in " ".join(text.split())
    assert "safety filter" in text and "noise band 0.018 cm" in text
    assert "<table" in result._repr_html_() and "<table" in result.answer._repr_html_()


@pytest.mark.slow
def test_the_answer_is_a_rig_that_is_left_alone_when_tuned_again(result, tmp_path):
    result.save(tmp_path)
    saved = rig.load(str(tmp_path / "rig.toml"))
    assert saved.loop.safety_filter is not None and set(saved.safety) == {"band", "rate"}
    assert dict(saved.objective) == dict(result.answer.setting.objective)
    again = tuning.tune(saved, tuning.Options(validation=24))
    assert all(again.answer.kept.values())
    assert again["controller.Kc[0]"].after == result["controller.Kc[0]"].after
    page = (tmp_path / "report.html").read_text()
    assert "what it gives" in page and "what to set" in page
    sides = (result.answer.before, result.answer.after)
    held = [int(side.held.sum()) for side in sides]
    errors = [f"{side.error.mean():.3g}" for side in sides]
    assert f"limits hold on {held[0]} -&gt; {held[1]} of {sides[1].samples} plants" in page
    assert f"mean RMS error {errors[0]} -&gt; {errors[1]} {saved.loop.units[0]}" in page


@pytest.mark.slow
def test_a_limit_that_no_gain_can_hold_is_said_and_ends_with_4(path):
    words = ["tune", path, "--limit", "max_level=0.9", "--quiet", "--no-safety-filter"]
    said = command(*words, "--validation", "8", "--starts", "1", "--iterations", "1")
    assert said.code == 4
    assert "limits hold on 0 of 8 validation plants" in " ".join(said.out.split())


@pytest.mark.parametrize(
    "options, words",
    [
        ({"nominal": False, "method": "trf"}, "method: belongs to the nominal optimum"),
        ({"nominal": False, "method": tuning.Options(screening=2)}, "screening: belongs to"),
        ({"nominal": True, "safety_filter": True}, "safety_filter: belongs to the default answer"),
        ({"free": {"controller.Kc": (2.0, 3.0)}}, "starts outside its range"),
        ({"limits": {"max_levl": 3.0}}, "nearest: max_level"),
        ({"starts": 0}, "starts = 0"),
        ({"method": tuning.Options(validation=0)}, "validation = 0: the default answer is judged"),
    ],
)
def test_input_that_cannot_be_used_is_an_error_before_anything_runs(case, options, words):
    with pytest.raises(InputError, match=words):
        tuning.tune(case, **options)


@pytest.mark.extended
def test_options_of_the_nominal_optimum_imply_it_and_say_so(path):
    words = ["tune", path, "--starts", "1", "--validation", "0"]
    said = command(*words, "--method", "slsqp", "--iterations", "2")
    assert "note: --method implies --nominal" in said.err
    assert "validation" not in said.out and "what it gives" not in said.out


@pytest.mark.slow
def test_progress_is_a_line_for_each_local_search(path):
    said = command("tune", path, "--validation", "8")
    lines = [line for line in said.err.splitlines() if line.startswith("start ")]
    assert 2 <= len(lines) <= 8 and all("cm^2" in line for line in lines)


@pytest.mark.parametrize("other", ["--robust=mean", "--nominal"])
def test_a_mend_belongs_to_the_default_answer(path, other):
    said = command("tune", path, "--mend", "rims", other)
    assert said.code == 2 and "--mend" in said.err and said.err.count("\n") == 1


def test_an_interrupted_search_gives_its_best_gains(case, monkeypatch):
    settled = []
    monkeypatch.setattr(
        "tuning.search.default.prefer_robust", lambda _, solution: settled.append(solution.point)
    )

    def stop(event):
        if event["evaluations"] > 3:
            raise KeyboardInterrupt

    result = tuning.tune(case, tuning.Options(validation=4), progress=stop)
    assert result.status == "interrupted" and result.answer.after is None
    assert len(settled) == 1, "a robust one is looked for, see test_robustness.py"
    assert "not yet validated" in str(result)
    assert result.objective["after"] != result.objective["after"]  # NaN: not known
    assert result.to_json()["objective"]["after"] is None


@pytest.mark.slow
def test_an_interrupt_keeps_the_answer_of_an_earlier_search_that_was_judged(case, monkeypatch):
    """A judgement that is not held leads to another search; Ctrl-C comes as that one is judged."""
    few = tuning.Options(validation=24, starts=2, iterations=4)
    options = dict(method=few, safety_filter=False, limits={"max_level": 2.62})
    whole, calls = tuning.tune(case, **options), []

    def judged(*given, **keywords):
        calls.append(given)
        if len(calls) > 1:
            raise KeyboardInterrupt
        return dataclasses.replace(judge(*given, **keywords), held=np.zeros(24, dtype=bool))

    monkeypatch.setattr("tuning.search.default.judge", judged)
    result = tuning.tune(case, **options)
    assert len(calls) == 2, "there was a second search"
    assert result.status == "interrupted" and result.answer.after is not None
    assert {n: result[n].after for n in result} == {n: whole[n].after for n in whole}
    np.testing.assert_array_equal(result.answer.after.cost, whole.answer.after.cost)
    words = "these are the best gains so far, of the search before this one"
    assert words in " ".join(str(result).split())


def with_sides(result, before=None, after=None):
    """The result with other values of the fields of its judged sides."""
    answer = result.answer
    before = dataclasses.replace(answer.before, **(before or {}))
    after = dataclasses.replace(answer.after, **(after or {}))
    answer = dataclasses.replace(answer, before=before, after=after)
    return result.replace(answer=answer, messages=())


def test_a_larger_error_comes_with_the_smaller_changes_of_the_inputs_that_it_buys(result):
    after = result.answer.after
    half = with_sides(result, {"error": 0.5 * after.error, "travel": 3.0 * after.travel})
    gives = " ".join(advice_of(half).gives.split())
    before, now = (f"{100 * factor * after.travel.mean():.2g}" for factor in (3.0, 1.0))
    assert f"rms change of inputs {before} -> {now} % of range" in gives
    assert "rms change" not in advice_of(with_sides(result, {"error": 2.0 * after.error})).gives


@pytest.mark.parametrize(("share", "news"), [(0.005, False), (0.03, True)])
def test_inputs_that_hardly_change_are_no_news_however_still_they_were(result, share, news):
    travel = np.full(result.answer.after.samples, share)
    other = with_sides(result, {"travel": travel / 44.0}, {"travel": travel})
    assert ("input-total-variation" in [m.code for m in messages_of(other)]) is news


def test_a_gain_at_an_end_of_its_range_is_named_at_the_tolerance_of_a_search(result):
    bound = result.problem.bounds[0]
    solution = SimpleNamespace(point=None, interrupted=False, change=None, idle=None)
    for share, at in ((1.0 - 1e-5, "upper"), (0.99, None)):
        values = {n: p["after"] for n, p in result.parameters.items()}
        values |= {bound.name: bound.low * (bound.high / bound.low) ** share}
        rows = _parameters(SimpleNamespace(problem=result.problem), solution, values)
        assert rows[bound.name]["at_bound"] == at


def test_tightened_limits_are_named_only_where_a_plant_comes_near_one(result):
    limit = result.answer.after.limits[0]
    for share, news in ((0.5, False), (0.95, True)):
        level = np.full_like(result.answer.after.level, share * limit.value)
        after = {"measures": {**result.answer.after.measures, "max_level": level}}
        other = with_sides(result, after=after)
        other = other.replace(answer=dataclasses.replace(other.answer, tightened=0.01))
        assert ("constraints-tightened" in [m.code for m in messages_of(other)]) is news


@pytest.mark.parametrize(("changes", "news"), [("", True), ("[40.0, 1, 1.5]", False)])
def test_a_level_held_against_an_inflow_names_averaging_control(result, changes, news):
    """The answer of a buffer tank, whose inputs change more than before."""
    text = TANK.replace("changes = [[1.0, 1, 2.6]]", f"changes = [{changes}]")
    text += "[[inflow]]\ntime = 5.0\nduration = 5.0\ntank = 1\nvolume = 3.0\n"
    other = with_sides(result, {"travel": 0.5 * result.answer.after.travel})
    setting = dataclasses.replace(other.answer.setting, case=rig.loads(text), own_objective=False)
    other = other.replace(answer=dataclasses.replace(other.answer, setting=setting))
    assert ("level-held-tightly" in [m.code for m in messages_of(other)]) is news


def test_a_level_that_the_filter_keeps_off_its_setpoint_is_named(result):
    assert result.answer.setting.filter is not None and not result.answer.filter_offsets
    answer = dataclasses.replace(result.answer, filter_offsets={0: (0.001, 0.02)})
    bare = dataclasses.replace(
        result.answer, setting=result.answer.setting.without_filter(), filter_lost=105
    )
    words = {"0.02 cm off its setpoint (0.001 cm without)": answer, "with it 105 of": bare}
    for expected, answer in words.items():
        texts = messages_of(result.replace(answer=answer))
        assert [expected in m.text for m in texts if m.code == "filter-offset"] == [True]


@pytest.mark.parametrize(
    ("error", "first", "alone", "outputs"),
    [
        (0.02, 1e-3, 1e-3, [0]),
        (0.004, 1e-3, 1e-3, []),  # no more than five times that before
        (1.6, 1.0, 1e-3, [0]),  # but more than a verdict allows
        (0.005, 1e-4, 1e-3, []),  # no more than twice the noise
        (0.02, 1e-3, 0.015, []),  # no more than twice that of the same gains alone
        (np.nan, 1e-3, 1e-3, []),
    ],
)
def test_an_offset_under_the_filter_is_larger_than_before_and_than_the_noise(
    result, error, first, alone, outputs, monkeypatch
):
    """Noise of 0.003 cm."""
    answer = result.answer
    before, after = (
        dataclasses.replace(side, nominal=side.nominal | {"steady_state_error": np.array([e])})
        for side, e in ((answer.before, first), (answer.after, error))
    )
    after = dataclasses.replace(after, infeasible=np.zeros(after.samples, dtype=bool))
    attempt = default.Attempt(answer.setting, after=after)
    monkeypatch.setattr(default, "_tuned", lambda attempt: attempt.setting)
    monkeypatch.setattr(
        default.lp, "evaluate", lambda *_: {"steady_state_error": np.array([alone])}
    )
    assert list(default._offsets(attempt, before)) == outputs


def test_gains_of_an_unstable_loop_are_not_advised(result):
    after = {**result.measures["after"], "sensitivity_peak": np.inf}
    unstable = result.replace(measures={**result.measures, "after": after})
    assert advice_of(result).to_set.startswith("Set controller.")
    assert advice_of(unstable).to_set.startswith("Nothing to set: with the best gains found")


@pytest.mark.parametrize("second", ["", ", { gain = 2.0, to = 1, high = 2.0, initial = 0.1 }]"])
def test_gains_of_the_wrong_sign_are_refused_where_ranges_are_about_them(second):
    """second: a pump into the same tank, which the controller leaves where it is."""
    wrong = TANK.replace("Kc = 1.0", "Kc = -1.0").partition("free = {")[0]
    if second:
        wrong = wrong.replace("initial = 0.4 }]", "initial = 0.4 }" + second)
        wrong = wrong.replace('kind = "pid"', 'kind = "pid", lead = [1]')
    with pytest.raises(InputError, match="pump 1 fills tank 1, and this sign drives its level"):
        tuning.tune(rig.loads(wrong), tuning.Options(validation=2))


CHAIN = """
units = ["cm", "V"]
tank = [{ name = "T1", area = 15.0, rim = 30.0, level = 6.0, inflow = 40.0 },
    { name = "T2", area = 15.0, rim = 30.0, drain = 0.2, level = 6.0 },
    { name = "T3", area = 15.0, rim = 30.0, level = 6.0 }]
orifice = [{ from = "T1", to = "T2", area = 0.2 }, { from = "T3", to = "T2", area = 0.1 }]
INPUT
plant = { outputs = ["T2"] }
controller = { kind = "pi", Kc = GAIN, Ti = 20.0 }
reference = { initial = [6.0], changes = [] }
reachable = false
"""


@pytest.mark.parametrize(
    ("ends", "rises"),
    [
        ('pump = [{ name = "P", gain = 9.0, high = 9.0, to = "T1" }]', 1),
        ('pump = [{ name = "P", gain = 9.0, high = 9.0, from = "T1" }]', -1),
        ('valve = [{ name = "P", from = "T1", area = 0.1 }]', -1),
        ('valve = [{ name = "P", from = "T3", to = "T1", area = 0.1 }]', 0),
        (
            'pump = [{ name = "P", gain = 9.0, high = 9.0, from = "T1", to = "T3" }]',
            0,
        ),  # not known before it is computed
    ],
)
def test_gains_of_the_wrong_sign_are_named_through_the_tanks_between(ends, rises):
    for gain in (-1.0, 1.0):
        case = rig.loads(CHAIN.replace("INPUT", ends).replace("GAIN", str(gain)))
        [noted] = [[s for s in rig.case_warnings(case) if "change the sign" in s]]
        assert bool(noted) is (gain * rises < 0.0), noted
        assert all("T1, upstream of T2, and this sign" in s for s in noted)


def test_the_tank_named_between_is_one_on_the_way():
    """A pump into two tanks, of which the second feeds the output."""
    split = 'pump = [{ name = "P", gain = 9.0, high = 9.0, to = ["T4", "T1"], split = 0.5 }]'
    tank = '    { name = "T4", area = 15.0, rim = 30.0, level = 6.0 },\n    { name = "T3"'
    text = CHAIN.replace('    { name = "T3"', tank).replace("GAIN", "-1.0")
    sentences = rig.case_warnings(rig.loads(text.replace("INPUT", split)))
    assert any("P fills T1, upstream of T2" in sentence for sentence in sentences)


BACKWARDS = """
units = ["m", "m^3/s"]
tank = [{ name = "A", area = 1.0, rim = 4.0, level = 0.5, drain = "10 cm^2" },
    { name = "B", area = 1.0, rim = 4.0, level = 1.5, drain = "3 cm^2", inflow = 0.005 }]
valve = [{ name = "V1", from = "A", to = "B", area = "20 cm^2", initial = 0.36 }]
plant = { outputs = ["A"] }
controller = { kind = "pi", Kc = GAIN, Ti = 500.0 }
reference = { initial = [0.5], changes = [[100.0, 1, 0.6]] }
values = { "clock.dt" = 5.0, "clock.duration" = 3000.0 }
"""


@pytest.mark.parametrize("gain", [0.5, -0.5])
def test_the_sign_of_a_valve_that_runs_backwards_is_that_of_its_steady_gain(gain):
    """B stands above A: the valve from A to B fills A."""
    case = rig.loads(BACKWARDS.replace("GAIN", str(gain)))
    error = float(jaxtank.evaluate(case, ["steady_state_error"])["steady_state_error"][0])
    assert (error < 0.05) is (gain > 0.0)
    assert not any("change the sign" in sentence for sentence in rig.case_warnings(case))
    assert bool(list(unstable_signs(case))) is (gain < 0.0)

"""Parts of a search by themselves: rules, the step of a screening, moves of rounded answers."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

from jaxtank import presets, rig
from jaxtank.bounds import Bound, bounds, gain_ranges, widened
from jaxtank.case import Free
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from tuning.problem.problem import Problem
from tuning.search import default, diagnostics, judged, messages, robust, screening, setting
from tuning.search.options import Options


def test_a_range_below_0_is_logarithmic_in_the_size_of_the_value():
    below, above = Bound("k", -30.0, -0.03, "log", ""), Bound("k", 0.03, 30.0, "log", "")
    for z in (0.0, 0.2, 0.7, 1.0):
        value = float(below.from_unit(z))
        np.testing.assert_allclose(value, -above.from_unit(1.0 - z), rtol=1e-12)
        np.testing.assert_allclose(below.to_unit(value), z, atol=1e-12)
        np.testing.assert_allclose(below.slope(value), above.slope(-value), rtol=1e-12)
    assert below.end_at(-30.0) == "lower" and below.end_at(-0.03) == "upper"
    loop = rig.set_values(presets.find("cascaded/pi"), {"controller.Kc": [-2.0]}).loop
    ranges = gain_ranges(loop) | {"stated": rig.check_free(loop, "controller.Kc[0]", -9.0, -1.0)}
    assert {ranges[name].scale for name in ("controller.Kc[0]", "stated")} == {"log"}
    assert rig.check_free(loop, "controller.Kc[0]", -9.0, 1.0).scale == "linear"


def test_plants_vary_where_anything_but_a_sensor_is_uncertain():
    case = presets.find("cascaded/pi")
    runs = {}
    for names in (("sensor.gain",), ("sensor.gain", "plant.drain"), ("plant.drain",)):
        row = setting.setting_of(case, None, None, dict.fromkeys(names, 0.05))
        runs[names] = row.plants_vary, "new noise" in row.runs
    assert list(runs.values()) == [(False, True), (True, False), (True, False)]


@pytest.mark.parametrize(
    ("before", "after", "codes"),
    [
        (1.5, 1.9, []),
        (1.5, np.nan, []),
        (1.5, 8.0, ["edge-of-stability"]),
        (np.inf, np.inf, ["edge-of-stability"]),
    ],
)
def test_an_answer_near_the_edge_of_stability_is_named(before, after, codes):
    sides = {"before": {"sensitivity_peak": before}, "after": {"sensitivity_peak": after}}
    rule = messages._near_the_edge
    assert [m.code for m in rule(SimpleNamespace(measures=sides))] == codes


def test_every_plant_of_a_search_has_noise_of_its_own():
    scenarios = setting.scenarios_of(presets.find("cascaded/pi"), samples=200)
    assert len({scenario.seed for scenario in scenarios}) == 200


@pytest.mark.parametrize("tolerance", [2.0, 1.0, 0.0, -0.1, np.nan, 1, True, "0.1"])
def test_a_tolerance_is_a_share_between_0_and_1(tolerance):
    assert Options(tolerance=0.1).tolerance == 0.1
    with pytest.raises(InputError, match="tolerance"):
        Options(tolerance=tolerance)


def test_limits_that_a_message_has_no_room_for_are_counted():
    assert messages.first_of(list("abcd")) == "a, b, c, d"
    for more in (1, 3):
        text = messages.first_of(list("abcd") + ["e"] * more)
        assert "e" not in text.split("(")[0] and re.findall(r"\d+", text) == [str(more)]


@pytest.mark.parametrize("names", [("k",), ("k", "h"), ("h",), ("k", "g", "h")])
def test_the_least_sensitive_direction_names_what_moves_along_it(names):
    scales = {"k": "log", "g": "log", "h": "linear"}
    factors = {n: 1.25 if scale == "log" else -0.5 for n, scale in scales.items()}
    still = {n: 1.0 if scale == "log" else 0.0 for n, scale in scales.items()}
    least = {"factors": {n: (factors if n in names else still)[n] for n in scales}}
    least["changes_percent"] = 3.0
    bounds = [Bound(n, 0.1, 10.0, scale, "-") for n, scale in scales.items()]
    result = SimpleNamespace(
        curvature={"least_sensitive": least}, problem=SimpleNamespace(bounds=bounds)
    )
    (text,) = messages._least_sensitive(result)
    words = re.split(r", | with ", text.split(": ")[1].split(" changes")[0])
    numbers = {w.split()[0]: float(w.split()[-1]) for w in words}
    assert numbers == {n: factors[n] for n in names}
    least["factors"] = still
    assert not [*messages._least_sensitive(result)]


@pytest.mark.parametrize("offset", [0.0, -20.0])
@pytest.mark.parametrize(("risk", "support"), [("mean", 1), ("worst", 3), ("cvar", 3)])
def test_plants_at_the_largest_cost_and_at_a_limit_are_counted_once_as_support(
    risk, support, offset
):
    """Of five plants: c at a limit of 20, d and e at the largest cost."""
    costs = np.array([9.0, 9.5, 10.0, 10.0005, 8.0]) + offset
    names, margins = "abdec", [1.0, 0.03, 2.0, 3.0, 0.01]
    runs = [SimpleNamespace(name=name, weight=1.0) for name in names]
    rows = [SimpleNamespace(scenario=n, margin=m) for n, m in zip(names, margins)]
    problem = SimpleNamespace(runs=runs, risk=risk, limit_scales=[20.0] * 5, cost=lambda row: row)
    problem.shares = lambda costs, runs: Problem.shares(problem, costs, runs)
    tables = {"after": list(costs)}
    result = SimpleNamespace(constraints=rows, problem=problem, tables=tables)
    assert robust._support(result) == support


@pytest.mark.parametrize("offset", [0.0, -20.0])
def test_searches_that_agree_are_counted_where_the_objective_is_negative_too(offset):
    costs = np.array([10.0, 10.005, 10.02]) + offset
    starts = [{"cost": c, "violation": 0.0} for c in costs] + [{"cost": -99.0, "violation": 0.1}]
    (message,) = messages._agreement(SimpleNamespace(starts=starts, symmetry=None))
    alike, searches = map(int, re.findall(r"\d+", message.text)[:2])
    assert (alike, searches) == (2, 4)  # a share of 1e-3 of 10 is 0.01


@pytest.mark.parametrize("after", [10.0, -10.0])
def test_an_exchange_of_gains_that_costs_more_is_above_the_answer(after):
    image = {"values": {"k": 2.0}, "words": "k and g", "starts": [], "objective": after + 0.5}
    result = SimpleNamespace(symmetry=image, objective={"after": after})
    assert " 5 % above" in messages._symmetry(result)
    image["objective"] = after - 0.5
    assert " 5 % below" in messages._symmetry(result)
    image["objective"] = after * (1 + 1e-7)
    assert "%" not in messages._symmetry(result)


def test_no_move_leaves_a_value_as_it_is_to_the_last_bit():
    loop = presets.find("cascaded/pi").loop
    ranges = {"controller.Kc[0]": (0.5, 7.0), "x0[0]": Free(0.0, 9.0, "linear")}
    for bound in bounds(loop, ranges):
        none, other = (1, 0) if bound.scale == "log" else (0, 1)
        for old in np.random.default_rng(0).random(50):
            assert diagnostics._moved(bound, old, none) == old
        assert abs(diagnostics._moved(bound, 1.0 / 3.0, none + 0.5) - 1.0 / 3.0) > 1e-3
        if bound.scale != "log":
            assert diagnostics._moved(bound, 1.0 / 3.0, other) > 1.0 / 3.0


@pytest.mark.parametrize(("samples", "coarse"), [(20_001, False), (2_000_001, True)])
def test_a_screening_is_coarse_where_its_samples_are_many(samples, coarse, monkeypatch):
    """32 points: 640,032 samples are run at the true step, 64 million are not."""
    clock = Clock(dt=0.01, duration=0.01 * (samples - 1))
    problem = SimpleNamespace(runs=[0], clock=clock, bounds=[0, 0])
    asked = []

    def values(zs, coarse=False):
        asked.append(coarse)
        return np.ones(len(zs)), np.ones((len(zs), 0))

    monkeypatch.setattr(screening, "spectral_radius", lambda problem, zs, clock: np.zeros(len(zs)))
    evaluator = SimpleNamespace(problem=problem, screen=values)
    points, redone = screening.screen(evaluator, 32, 0)
    assert asked == [coarse] and redone == 0 and points.zs.shape == (32, 2)
    asked.clear()
    screening.screen(evaluator, 32, 0, coarse=False)
    assert asked == [False]


def test_gains_of_a_rival_are_taken_within_the_ranges():
    """On a logarithmic range a number of the other sign, or 0, is none."""
    bounds = [Bound("k", 0.1, 10.0, "log", ""), *(Bound(n, -1.0, 1.0, "linear", "") for n in "abc")]
    problem, first = SimpleNamespace(bounds=bounds), np.full(4, 0.7)
    gains = {"k": 0.0, "a": -0.5, "b": 3.0}
    np.testing.assert_allclose(default._at(problem, first, gains), [0.7, 0.25, 1.0, 0.7])
    np.testing.assert_allclose(default._at(problem, first, {"k": 1.0})[0], 0.5)
    below = SimpleNamespace(bounds=[Bound("k", -10.0, -0.1, "log", "")])
    for value, z in [(-1.0, 0.5), (-100.0, 0.0), (1.0, 0.7), (0.0, 0.7)]:
        assert default._at(below, first[:1], {"k": value})[0] == pytest.approx(z)


@pytest.mark.parametrize("size", [0.05, 20.0])
@pytest.mark.parametrize(
    ("before", "after", "suspect"), [(0.01, 0.06, True), (0.01, 0.04, False), (0.04, 0.06, False)]
)
def test_an_output_is_looked_at_where_its_error_grew_and_is_no_small_share_of_its_setpoint(
    size, before, after, suspect, monkeypatch
):
    """By more than twice, to more than 5 % of the largest setpoint; the other output follows."""
    setpoints = np.array([[0.0, size, -size / 2], [size, size, size]])
    monkeypatch.setattr(diagnostics, "_setpoints", lambda loop, clock: (setpoints, None))
    run = SimpleNamespace(case=SimpleNamespace(loop=None, clock=None))
    rows = ({"rms_error": np.array([share, 0.03]) * size} for share in (before, after))
    assert diagnostics._suspect(run, *rows) == ({0} if suspect else set())


@pytest.mark.parametrize("seed", [0, 2**31 - 1])
def test_validation_plants_of_any_seed_have_a_seed_of_31_bits(seed, monkeypatch):
    seeds = []

    def run_plants(case, distributions, samples, seed, *_):
        seeds.append(seed)
        raise KeyboardInterrupt

    monkeypatch.setattr(judged, "run_plants", run_plants)
    row = setting.setting_of(presets.find("cascaded/pi"))
    for number in range(3):
        with pytest.raises(KeyboardInterrupt):
            judged.judge(row, 8, seed, number)
    assert len(set(seeds)) == 3 and all(0 <= s < 2**31 for s in seeds)


@pytest.mark.parametrize(
    ("name", "ends", "end", "longest", "expected"),
    [
        ("controller.Kc", (0.1, 10.0), "upper", 500.0, (0.1, 300.0)),
        ("controller.Kc", (0.1, 10.0), "lower", 500.0, (0.00333, 10.0)),
        ("controller.Kc", (-10.0, -0.1), "lower", 500.0, (-300.0, -0.1)),
        ("controller.Kc", (-10.0, -0.1), "upper", 500.0, (-10.0, -0.00333)),
        ("controller.Kc", (-1.0, 3.0), "upper", 500.0, (-1.0, 7.0)),
        ("controller.Ti", (10.0, 100.0), "upper", 500.0, (10.0, 500.0)),
        ("controller.Ti", (10.0, 100.0), "upper", 50.0, (10.0, 100.0)),
        ("plant.caught", (0.1, 0.5), "upper", 500.0, (0.1, 1.0)),
    ],
)
def test_a_widened_range_stays_within_the_run_and_what_a_parameter_allows(
    name, ends, end, longest, expected
):
    loop = presets.find("cascaded/pi").loop
    (bound,) = bounds(loop, {name: ends})
    assert widened(loop, bound, end, longest)[:2] == expected

"""Answers near the edge of stability are news of the headline; values are reported as they act."""

import numpy as np
import pytest
from helpers import command

import jaxtank
import tuning
from jaxtank import presets, rig
from tuning.problem.reported import in_force
from tuning.uncertainty.sensitivity_study import UNUSABLE

WORDS = ["--nominal", "--starts", "1", "--screening", "1", "--validation", "0", "--quiet"]


@pytest.mark.slow
def test_an_answer_beyond_sampled_stability_is_news_of_the_headline(tmp_path):
    """k = 39.9 1/s at a step of 0.05 s: 1 - k dt = -0.997, and more between the tanks."""
    case = ["gouta2015/backstepping-slow", "--dt", "0.05", "--set", "controller.k=20"]
    done = command("tune", *case, *WORDS, "--json", "--out", str(tmp_path / "run"))
    found = done.json
    assert done.code == 0 and found["status"] == "converged"
    k = found["parameters"]["controller.k"]["after"]
    assert abs(1.0 - k * 0.05) > 0.98
    assert found["measures"]["after"]["sensitivity_peak"] is None  # not finite: unstable
    assert found["messages"][0]["code"] == "edge-of-stability"
    assert "edge of sampled stability" in found["headline"]
    assert "edge of sampled stability" in found["message"].split(";")[0]
    assert "converged, beyond the edge" in (tmp_path / "run" / "report.html").read_text()


RIG = """
units = ["m", "%"]
tank = [
    {area = 0.5, rim = 1.2, level = 0.55},
    {area = 0.25, rim = 1.0, level = 0.5},
    {area = 0.25, rim = 0.8, level = 0.4, drain = 4.15e-4},
]
orifice = [{from = 1, to = 2, area = 3.2e-4}, {from = 2, to = 3, area = 2.6e-4}]
pump = [{gain = 2.64e-5, to = 1, high = 100.0}, {gain = 1.144e-5, to = 3, high = 100.0}]
plant = {outputs = [2, 3], gravity = 9.81}
law = {kind = "pid", Kc = [100.0, 100.0], Ti = [200.0, 200.0], Tt = [200.0, 200.0]}
reference = {initial = [0.5, 0.4], changes = [[100.0, 1, 0.6], [1500.0, 2, 0.45]], ramp = 0.0}
values = {"clock.dt" = 1.0, "clock.duration" = 3000.0}
free = {"controller.Kc" = [10.0, 3000.0], "controller.Ti" = [20.0, 3000.0]}
"""
"""Levels in m, pumps in %; Ms of the start is 6.56."""


@pytest.fixture
def fragile(tmp_path):
    """A rig file whose PI controllers are nearly unstable."""
    path = tmp_path / "fragile.toml"
    path.write_text(RIG)
    return path


@pytest.mark.slow
def test_a_nominal_answer_with_a_high_sensitivity_peak_is_news_of_the_headline(fragile):
    fixed = [f"--free=controller.Kc[{i}]=10:3000" for i in range(2)]
    found = command("tune", str(fragile), *fixed, *WORDS, "--json").json
    assert found["measures"]["before"]["sensitivity_peak"] > 6.0
    assert found["measures"]["after"]["sensitivity_peak"] > 4.0
    assert "near the edge of stability (Ms = " in found["headline"]


def test_a_width_that_the_controller_clips_is_reported_as_it_acts():
    case = presets.find("mirakhorli/hybrid")
    values = {"controller.b[0]": 0.63, "controller.w[0]": 4.4, "controller.w[1]": 0.2}
    acting = in_force(case.loop, values)
    assert acting == values | {"controller.w[0]": 0.63}
    clock = jaxtank.Clock(dt=case.clock.dt, duration=20.0)
    runs = [
        jaxtank.evaluate(jaxtank.with_values(case.loop, v), clock, ["rms_error_total"])
        for v in (values, acting)
    ]
    assert runs[0] == runs[1]


@pytest.mark.slow
def test_a_tuned_width_is_at_most_its_size():
    case = presets.find("mirakhorli/hybrid").replace(scenarios=())
    clock = jaxtank.Clock(dt=case.clock.dt, duration=100.0)
    found = tuning.tune(
        case.replace(clock=clock),
        tuning.Options(starts=2, screening=8, iterations=8, validation=0),
        free={"controller.b": (0.3, 12.0), "controller.w": (0.05, 12.0)},
    )
    for i in range(2):
        b, w = (found[f"controller.{n}[{i}]"].after for n in "bw")
        assert w <= b or w == found[f"controller.w[{i}]"].before


@pytest.mark.slow
def test_a_search_without_a_slope_has_not_converged():
    """calofir far from its gains: a limit cycle, exact slope 1e12 times that of runs beside it."""
    gains = ["--set", "controller.K_phi=0.9", "--set", "controller.K_y=0.9"]
    words = ["--nominal", "--starts", "1", "--screening", "1", "--validation", "0", "--json"]
    done = command("tune", "calofir/backstepping", *gains, *words, "--quiet")
    found = done.json
    first = found["starts"][0]
    assert (first["evaluations"], first["converged"], first["slope_usable"]) == (0, False, False)
    assert not found["slopes"]["start"]["usable"] and found["slopes"]["start"]["orders_above"] > 2
    (text,) = (m["text"] for m in found["messages"] if m["code"] == "slope-not-usable")
    assert "the values before tuning" in text and "differential evolution" in text
    # the derivative-free stages went on: 0.0213 and 0.139 (or exchanged) are the optimum
    assert done.code == 0 and found["slopes"]["answer"]["usable"]
    assert found["objective"]["after"] == pytest.approx(0.005951265, rel=1e-5)


@pytest.fixture(scope="module")
def exploding():
    """k dt = 3: the sampled loop doubles its error in each sample until the pumps saturate."""
    settings = {"clock.dt": 0.1, "clock.duration": 60.0, "controller.k": 30.0}
    return rig.set_values(presets.find("gouta2015/backstepping"), settings)


@pytest.mark.slow
def test_the_local_table_has_no_slope_that_runs_contradict(exploding):
    found = tuning.sensitivity(exploding, {"controller.k": 0.1}, method="local")
    error = next(c for c in found.columns if c.measure == "rms_error_total")
    assert np.isnan(error.effects["effect"]).all()
    assert error.reason == UNUSABLE and UNUSABLE in " ".join(str(found).split())

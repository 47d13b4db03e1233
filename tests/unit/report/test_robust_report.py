"""What the page of a tuning over several plants or scenarios says: whose numbers they are, and what
was measured apart from what was expected.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers import RIGS

import jaxtank
import tuning
from jaxtank import rig
from tuning.report import tuned as report
from tuning.search import messages
from tuning.search.robust import Certificate
from tuning.search.setting import setting_of

SEARCH = tuning.Options(starts=1, screening=1, iterations=2, validation=0)
RESTS = "; the other rows: the case's own run, on its own plant"


@pytest.fixture(scope="module")
def case():
    """The rig with one tank, a coarse clock, one uncertain parameter."""
    one = rig.load(RIGS / "watertank.toml").replace(
        uncertain={"plant.drain": 0.1}, objective={"rms_error_total": 1.0}
    )
    return rig.set_values(one, {"clock.dt": 0.5, "clock.duration": 40.0})


def of_certificate(certificate, risk):
    """The messages about a certificate."""
    parts = {"problem": SimpleNamespace(risk=risk), "case": SimpleNamespace(scenarios=())}
    result = SimpleNamespace(certificate=certificate, **parts)
    return list(messages._on_new_plants(result))


def row(page, name):
    """The cells of the first row of that name: unit, before, after."""
    return next(line for line in page.splitlines() if line.startswith(f"{name} ")).split()[1:]


@pytest.mark.slow
def test_the_objective_is_of_the_plants_and_the_other_rows_are_of_the_case(case):
    result = tuning.tune_robust(case, samples=3, fresh=4, limits={}, method=SEARCH)
    page = repr(result)
    assert f"objective: rms_error_total; the mean of 3 plants{RESTS}" in " ".join(page.split())
    costs = [s["objective"]["after"] for s in report.scenario_rows(result)]
    assert float(row(page, "objective")[2]) == pytest.approx(np.mean(costs), rel=1e-4)
    alone = jaxtank.evaluate(result.tuned.loop, result.tuned.clock, ["max_error"])["max_error"]
    assert float(row(page, "max_error")[2]) == pytest.approx(float(alone[0]), rel=1e-3)


def test_what_is_assumed_uncertain_is_named():
    cone = jaxtank.Rig(
        name="cone",
        tanks=[jaxtank.Tank("C", shape="cone", height=30.0, diameter=20.0, drain=0.5)],
        pumps=[jaxtank.Pump("P", to="C", gain=20.0, high=10.0, initial=2.0)],
        controller={"kind": "pi", "Kc": 0.5, "Ti": 100.0},
        reference=[[0.0, 9.0]],
        dt=1.0,
        duration=60.0,
    )
    result = SimpleNamespace(answer=SimpleNamespace(setting=setting_of(cone)))
    words = [str(line) for line in messages._assumed(result)]
    assert any("plant.pump_gain, plant.extent are varied by 5 %, and nothing" in w for w in words)


@pytest.mark.parametrize(
    ("weights", "words"),
    [((1.0, 1.0), "the mean of 2 scenarios"), ((1.0, 3.0), "the weighted mean of 2 scenarios")],
)
def test_scenarios_are_reported_as_such(weights, words):
    runs = [SimpleNamespace(weight=weight) for weight in weights]
    problem = SimpleNamespace(scenarios=True, runs=runs, risk="mean")
    result = SimpleNamespace(problem=problem, certificate=None)
    assert report._runs_of(result, True) == f"; {words}{RESTS}"


def test_what_was_expected_stands_apart_from_what_was_measured():
    """One plant of 16 at a limit: 1/17 is expected before a new one is run, 2 of 256 is what was
    found.
    """
    known = Certificate(16, 1, 0.8, 256, 2, [0.00095, 0.028])
    measured, bound, expected = of_certificate(known, "worst")
    assert measured.code == "limit-violated-out-of-sample" and "256" in measured.text
    assert "at most 0.8 " in bound.text
    assert expected.code == "support-scenarios" and "5.9 %" in expected.text
    assert "--back-off 0.03" in expected.text


def test_nothing_is_expected_where_nothing_was_violated_or_limits_were_tightened():
    for broken, back_off, code in (
        (0, 0.0, "limits-hold-out-of-sample"),
        (2, 0.03, "limit-violated-out-of-sample"),
    ):
        known = Certificate(16, 1, 0.8, 256, broken, [0.0, 0.028], back_off)
        codes = [m.code for m in of_certificate(known, "mean")]
        assert codes[0] == code and "support-scenarios" not in codes
        assert ("constraints-tightened" in codes) == (back_off > 0)

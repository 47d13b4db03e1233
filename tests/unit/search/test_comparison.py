"""Every controller that fits a rig, tuned and judged on the same plants."""

import dataclasses
import shutil

import numpy as np
import pytest

import tuning
from jaxtank import presets
from jaxtank.core.errors import InputError
from jaxtank.export.timing import step_time
from tuning.report import controllers as report
from tuning.search import comparison
from tuning.search.comparison import ControllerComparison, Rival
from tuning.search.judged import Judged

N = 4


def judged(errors, broken=(), failed=(), infeasible=None):
    flags = lambda rows: np.isin(np.arange(N), rows)
    return Judged(
        cost=np.asarray(errors) ** 2, error=np.asarray(errors), level=np.ones((N, 2)),
        travel=np.full(N, 0.01), held=~flags(broken) & ~flags(failed), failed=flags(failed),
        infeasible=None if infeasible is None else flags(infeasible), limits=[], measures={},
        unit="cm",
    )  # fmt: skip


def comparison_of(*rows, name="cascaded/pi"):
    """Rows: (controller, Judged) of tuned gains, or with the origin of its gains."""
    case = presets.find(name)
    rows = [(*row, "tuned")[:3] for row in rows]
    rivals = [Rival(n, n, gains, case, runs, 1.3, None) for n, runs, gains in rows]
    rivals.sort(key=comparison.order)
    return ControllerComparison(case=case, rivals=tuple(rivals), refused={}, samples=N, seed=0)


def test_limits_come_before_error():
    result = comparison_of(
        ("lqi", judged([0.1] * N, broken=[2])),
        ("pi", judged([0.5] * N)),
        ("gpc", judged([0.4] * N)),
        ("laguerre", judged([0.05] * N, broken=[1, 2])),
    )
    assert [r.name for r in result.rivals] == ["gpc", "pi", "lqi", "laguerre"]
    assert result.best.name == "gpc" and result.own.name == "pi"
    rows = report.json_of(result)["controllers"]
    assert [row["violations"] for row in rows] == [0, 0, 1, 2]
    assert rows[0]["error"] == pytest.approx(0.4) and rows[0]["travel_percent"] == pytest.approx(1)


def test_error_counts_plants_that_can_follow():
    runs = judged([1.0, 2.0, 30.0, 400.0], failed=[3], infeasible=[2])
    (rival,) = comparison_of(("pi", runs)).rivals
    assert rival.error == pytest.approx(1.5)
    assert rival.violations == 1  # the run that diverged
    (nobody,) = comparison_of(("pi", judged([1.0] * N, infeasible=range(N)))).rivals
    assert nobody.error is None


def published_and_tuned(**errors):
    """Rows of controllers, each with its errors at published and at tuned gains."""
    sides = ("published", "tuned")
    rows = ((n, e, side) for n, two in errors.items() for e, side in zip(two, sides))
    return [(n, judged([e] * N), side) for n, e, side in rows if e is not None]


@pytest.mark.parametrize(
    ("errors", "outcome", "margin"),
    [
        ({"hybrid": (3.0, 1.0), "sfc": (4.0, 2.0)}, ("first", "first"), "50 % less"),
        ({"hybrid": (3.0, 2.0), "sfc": (4.0, 1.5)}, ("first", "behind"), "25 % less"),
        ({"hybrid": (4.0, 2.0), "sfc": (3.0, 1.0)}, ("behind", "behind"), "50 % less"),
        ({"hybrid": (4.0, 1.0), "sfc": (3.0, 2.0)}, ("behind", "first"), "50 % less"),
        ({"hybrid": (4.0, 2.0), "lqi": (None, 1.0)}, (None, "behind"), "50 % less"),
        ({"hybrid": (4.0, 1.0), "lqi": (None, 2.0)}, (None, "first"), "50 % less"),
        ({"hybrid": (3.0, 1.0), "sfc": (3.02, 1.005)}, ("tie", "tie"), "0.5 % less"),
        ({"hybrid": (3.02, 1.005), "sfc": (3.0, 1.0)}, ("tie", "tie"), "0.5 % less"),
    ],
)
def test_the_sentence_says_whether_the_claim_of_the_paper_survives(errors, outcome, margin):
    result = comparison_of(*published_and_tuned(**errors), name="mirakhorli/hybrid")
    sentence = report.sentence(result)
    at_published, of_all = outcome
    words = [report.OUTCOMES[at_published][0]] if at_published else []
    words = ", and ".join([*words, report.OUTCOMES[of_all][1]])
    assert f"hybrid is the best (sec. 6) {words}" in sentence
    assert margin in sentence and ("within 1 % of another" in sentence) == (of_all == "tie")
    leads = errors["hybrid"][1] < min(e[1] for n, e in errors.items() if n != "hybrid")
    assert ("is number 2 of 2" in sentence) is not leads
    assert report.json_of(result)["sentence"] == sentence


def test_every_claim_of_a_best_controller_names_a_case():
    for paper in presets.PAPERS:
        preset = presets.load(paper)
        assert set(preset.best) <= set(preset.cases)
    assert set(presets.load("gouta2015").best) == {"backstepping", "ngpc"}


def test_one_controller_alone_is_no_test_of_a_claim():
    result = comparison_of(*published_and_tuned(hybrid=(2.0, 1.0)), name="mirakhorli/hybrid")
    assert "claim" not in report.sentence(result)


def test_a_comparison_without_the_own_controller_has_a_sentence():
    result = comparison_of(("lqi", judged([1.0] * N)), ("gpc", judged([2.0] * N, broken=[0])))
    assert result.own is None and result.best.name == "lqi"
    assert "lqi" in report.sentence(result) and "on 1 plant" in report.sentence(result)


def test_total_travel_is_that_of_plants_that_can_follow():
    runs = judged([1.0, 2.0, 3.0, 4.0], failed=[3], infeasible=[2])
    travel = np.array([[1.0, 2.0], [3.0, 4.0], [50.0, 60.0], [7.0, 8.0]])
    runs = dataclasses.replace(runs, measures={comparison.TRAVEL: travel})
    (rival,) = comparison_of(("pi", runs)).rivals
    assert rival.travel == pytest.approx((3.0 + 7.0) / 2)
    assert report.json_of(comparison_of(("pi", runs)))["controllers"][0]["input_travel"] == 5.0


def test_a_paper_brings_its_controllers_and_rules_bring_others():
    refused = {}
    case = presets.find("gouta2015/backstepping")
    fitting = {n: (origin, c) for n, origin, c in comparison._candidates(case, refused)}
    assert {"ngpc", "backstepping", "backstepping-ff"} <= {
        n for n, (origin, _) in fitting.items() if origin == "published"
    }
    assert not any(name.endswith(("-slow", "-table1")) for name in fitting)  # other conditions
    assert {"pid", "lqi", "gpc", "laguerre"} <= set(fitting)
    assert "fuzzy" in refused and "fuzzy" not in fitting
    same = [c.loop.reference is not None and c.clock == case.clock for _, c in fitting.values()]
    assert all(same)


@pytest.mark.slow
def test_an_observer_comes_with_its_controller():
    case, refused = presets.find("gouta2022/pi"), {}
    fitting = {n: c for n, _, c in comparison._candidates(case, refused)}
    assert type(fitting["chadpc"].loop.observer) is not type(fitting["pi"].loop.observer)
    assert not any(name.endswith("-printed") for name in fitting)


@pytest.mark.slow
def test_rows_are_the_judgement_of_the_same_plants():
    case = presets.find("cascaded/pi")
    result = tuning.compare_controllers(case, kinds=["pi"], samples=32)
    first = next(r for r in result.rivals if not r.tuned and not r.filtered)
    assert np.array_equal(first.judged.error, tuning.validate(case, 32).error)
    tuned = next(r for r in result.rivals if r.tuned and r.filtered)
    assert tuned.holds and not first.holds
    assert tuned.judged.cost.mean() <= first.judged.cost.mean() * 1.2


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc on this machine")
def test_a_step_is_timed_in_c():
    time, why = step_time(presets.find("cascaded/pi"))
    assert time > 0.0 and not why
    time, why = step_time(presets.find("cascaded/open-loop"))
    assert time is None and why  # it plays a signal back, and has no code


def test_an_unknown_controller_is_named_with_what_fits():
    with pytest.raises(InputError, match="lqi"):
        tuning.compare_controllers(presets.find("cascaded/pi"), kinds=["lqii"])

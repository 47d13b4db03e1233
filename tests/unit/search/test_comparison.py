"""Every controller that fits a rig, tuned and judged on the same plants."""

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
        cost=np.asarray(errors) ** 2,
        error=np.asarray(errors),
        level=np.ones((N, 2)),
        travel=np.full(N, 0.01),
        held=~flags(broken) & ~flags(failed),
        failed=flags(failed),
        infeasible=None if infeasible is None else flags(infeasible),
        limits=[],
        measures={},
        unit="cm",
    )


def comparison_of(*rows):
    case = presets.find("cascaded/pi")
    rivals = [Rival(name, name, "tuned", case, runs, 1.3, None) for name, runs in rows]
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

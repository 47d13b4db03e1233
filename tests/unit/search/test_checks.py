"""Limits that nothing proves: tightened by what many plants need, and held when tuned again."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers import ONE_TANK

import jaxtank
import tuning
from jaxtank import rig
from jaxtank.core.tree import with_values
from jaxtank.limits import Limit
from tuning.search.default import LARGEST, SHARE, Checks
from tuning.search.setting import setting_of

TANK = ONE_TANK
for old, new in {
    **{"rim = 3.0": "rim = 9.0", "high = 2.0": "high = 4.0", "1, 2.6]": "1, 2.0]"},
    **{'duration" = 40.0': 'duration" = 30.0', "max_level = 2.7": "overshoot_percent = 4.0"},
}.items():
    TANK = TANK.replace(old, new)


@pytest.fixture(scope="module")
def case():
    return rig.loads(TANK)


@pytest.fixture(scope="module")
def looked(case):
    setting = setting_of(case)
    checks = Checks(setting, setting.searched, None, setting.limits, {})
    checks.look(checks.problem.start())
    return setting, checks


def test_the_tightening_and_the_added_plants_are_those_of_single_runs(looked):
    """Every plant alone: its overshoot, the spread beyond the 90 % quantile, the two worst."""
    setting, checks = looked
    problem, found = checks.problem, []
    for run in problem.runs[:40]:
        loop = with_values(setting.searched.loop, problem.scenarios[len(found)].values)
        run = jaxtank.evaluate(loop, run.case.clock, ["overshoot_percent"], run.key)
        found.append(float(run["overshoot_percent"][0]))
    margins = checks.margins["overshoot_percent", 0]
    np.testing.assert_allclose(4.0 - np.array(found), margins[:40], rtol=1e-9)
    every = 4.0 - margins
    spread = every.max() - np.sort(every)[int(0.9 * 255)]  # linear quantiles lie one draw apart
    wanted = SHARE * spread * 4.0 / every.max()
    assert checks.tightening["overshoot_percent", 0] == pytest.approx(wanted, rel=0.1)
    assert checks.added[:2] == np.argsort(-every)[:2].tolist()
    (limit,) = checks.limits()["overshoot_percent"]
    assert limit == pytest.approx(4.0 - checks.tightening["overshoot_percent", 0], rel=1e-12)
    assert not checks.hold() and 0.0 < checks.share < LARGEST


@pytest.mark.parametrize("size", [0.1, 4.0])
@pytest.mark.parametrize(
    ("measure", "worst", "next_", "least", "share"),
    [
        ("overshoot_percent", 1.5, 1.2, 0.0, SHARE * 0.3 / 1.5),  # far past the limit: less
        ("overshoot_percent", 0.9, 0.8, 0.0, SHARE * 0.1),
        ("min_level", 0.5, 0.8, 0.0, SHARE * 0.3),
        ("min_level", 0.0, 0.3, 0.0, SHARE * 0.3),  # an empty tank
        ("min_level", 0.5, 0.8, 0.2, 0.2),
        ("min_level", 0.5, 0.8, 0.9, LARGEST),
    ],
)
def test_a_tightening_is_a_share_of_the_spread_of_the_worst_tenth(
    measure, worst, next_, least, share, size
):
    """Of eleven plants the second worst is the 90 % quantile; one without the measure is left
    out.
    """
    limit = Limit(measure, 0, size)
    better = next_ - 0.1 * np.sign(worst - next_) * np.arange(1, 10)
    values = size * np.array([*better[:4], next_, worst, *better[4:], np.nan])
    checks = Checks.__new__(Checks)
    checks.problem, checks.rows = SimpleNamespace(limits=[limit]), {limit.key: [0]}
    checks.stated, checks.least = {measure: size}, {limit.key: least * size}
    with np.errstate(divide="raise"):
        amount = checks._tightening(limit.key, limit.margins(values))
    assert amount == pytest.approx(share * size)
    checks.stated = {}
    assert checks._tightening(limit.key, limit.margins(values)) == 0.0


@pytest.mark.extended
def test_plants_do_not_follow_the_seed_and_a_violation_tightens_more(looked, case):
    setting, checks = looked
    key = "overshoot_percent", 0
    more = Checks(setting, setting.searched, None, setting.limits, {key: 0.7})
    assert [r.case.loop.plant.drain[0] for r in more.problem.runs] == [
        r.case.loop.plant.drain[0] for r in checks.problem.runs
    ]
    more.margins, more.problem = {}, checks.problem
    more.look(checks.problem.start())
    assert more.tightening[key] == 0.7 > checks.tightening[key]


@pytest.fixture(scope="module")
def result(case):
    return tuning.tune(case, tuning.Options(validation=64))


@pytest.mark.slow
def test_the_answer_keeps_its_limits(result):
    answer = result.answer
    assert result.status == "converged" and answer.held and 0.0 < answer.tightened <= LARGEST
    assert answer.before.held.mean() < 0.5  # the limit is one that the start violates
    worst = answer.after.measures["overshoot_percent"].max()
    assert 3.0 < worst <= 4.0  # near its limit


@pytest.mark.slow
def test_the_answer_is_left_alone_when_tuned_again(result):
    again = tuning.tune(result.tuned, tuning.Options(validation=64))
    assert all(again.answer.kept.values()) and again.answer.held
    assert again["controller.Ti[0]"].after == result["controller.Ti[0]"].after

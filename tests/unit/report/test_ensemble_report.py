"""What the page of an ensemble says, beside numbers worked out from its draws."""

import dataclasses
import importlib

import matplotlib.pyplot as plt
import numpy as np
import pytest
from helpers import ONE_TANK
from scipy import stats

import tuning
from jaxtank import measures as measured, presets, rig
from tuning.problem.reported import run_measures
from tuning.report import uncertainty, verdict

MEASURES = ("max_level", "overflow_volume", "saturated_fraction", "settling_time", "iae")


@pytest.fixture(scope="module")
def five():
    """Five draws of a rig of two tanks, with a fan of the first three."""
    short = {"clock.dt": 4.0, "clock.duration": 200.0}
    case = rig.set_values(presets.find("cascaded/pi"), short)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(importlib.import_module("tuning.uncertainty.study"), "FAN_DRAWS", 3)
        return tuning.ensemble(case, samples=5, measures=MEASURES, key=0)


def first(ensemble, samples):
    """The first draws of an ensemble, as an ensemble."""
    cut = lambda table: {name: values[:samples] for name, values in table.items()}
    parts = {"values": cut(ensemble.values), "measures": cut(ensemble.measures)}
    parts |= {"failed": ensemble.failed[:samples], "infeasible": None}
    return dataclasses.replace(ensemble, **parts)


def row(page, label):
    """The cells of one row of the table of measures: unit, mean, its interval, sd, ..."""
    lines = [line.removeprefix(label) for line in page.splitlines() if line.startswith(label)]
    return [cell.strip() for line in lines for cell in line.split("  ") if cell.strip()]


@pytest.mark.parametrize(
    ("failed", "words"), [([True, False], "1 run finite"), ([True, True], "0 runs finite")]
)
def test_runs_that_left_the_numbers_leave_no_spread(five, failed, words):
    page = repr(dataclasses.replace(first(five, 2), failed=np.array(failed)))
    assert f"{words}: a standard deviation" in page
    for tank in (1, 2):
        assert row(page, f"max_level of tank {tank}")[2:4] == ["-", "-"]


def test_an_interval_of_a_mean_ends_where_the_measure_does(five):
    """Skew draws, whose mean and 1.96 standard errors reach past what the measure can be; the
    settling time alone may be negative.
    """
    skew, share = np.array([0.0, 0.0, 0.0, 3.0]), np.array([1.0, 1.0, 1.0, 0.2])
    measures = {
        "overflow_volume": np.stack([skew, skew + 10], axis=1),
        "saturated_fraction": share[:, None],
        "settling_time": skew[:, None],
        "iae": skew[:, None],
    }
    found = dataclasses.replace(first(five, 4), measures=measures, limits=[]).summary()

    def plain(values):
        half = stats.norm.ppf(0.975) * np.std(values, ddof=1) / np.sqrt(len(values))
        return values.mean() - half, values.mean() + half

    ends = {name: np.array(found[name]["mean_interval95"]) for name in measures}
    assert plain(skew)[0] < 0.0 and plain(share)[1] > 1.0
    np.testing.assert_allclose(ends["overflow_volume"][:, 0], [0.0, plain(skew)[1]], rtol=1e-7)
    np.testing.assert_allclose(ends["overflow_volume"][:, 1], plain(skew + 10), rtol=1e-7)
    np.testing.assert_allclose(ends["saturated_fraction"][:, 0], [plain(share)[0], 1.0], rtol=1e-7)
    np.testing.assert_allclose(ends["settling_time"][:, 0], plain(skew), rtol=1e-7)
    np.testing.assert_allclose(ends["iae"][:, 0], [0.0, plain(skew)[1]], rtol=1e-7)
    endless = {m for m, spec in measured.MEASURES.items() if spec.low is None}
    assert endless - set(measured.functions(measured.MEASURES)) == {"settling_time"}


@pytest.mark.parametrize(("samples", "words"), [(5, "the first 3 of 5 draws"), (3, "3 draws")])
def test_a_fan_of_some_draws_states_of_which(five, samples, words):
    figure = uncertainty.figures(first(five, samples))["fan"]
    assert figure.get_suptitle() == f"{five.case.name}: {words}"
    plt.close("all")


@pytest.mark.extended
def test_draws_that_do_not_keep_to_the_setpoints_are_not_good():
    """A step for which the pump is too small on most draws, though every limit holds: each draw
    is judged as a run of it alone.
    """
    case = rig.set_values(rig.loads(ONE_TANK), {"actuator.high": 0.75})
    case = case.replace(limits={"max_level": "rim"})
    drawn = {"plant.drain": tuning.Uniform(relative=0.3)}
    found = tuning.ensemble(case, drawn, samples=6, fan=False)
    alone = []
    for value in found.values["plant.drain"]:
        run = rig.set_values(case, {"plant.drain[0]": float(np.ravel(value)[0])})
        alone.append(verdict.tracking(run.loop, run_measures(run.loop, run.clock, None)))
    lost = [part.words for part in alone if not part.good]
    judged = uncertainty.verdict_of(found)
    assert 0 < len(lost) < 6 and not judged.good and judged.limits.good
    assert f"{len(lost)} of 6 draws" in judged.tracking.words
    assert lost[0].partition(" at ")[0] in judged.tracking.words
    enough = rig.set_values(case, {"actuator.high": 2.0})
    judged = uncertainty.verdict_of(tuning.ensemble(enough, drawn, samples=6, fan=False))
    assert judged.tracking.good and "every draw keeps to its setpoints" in judged.sentence

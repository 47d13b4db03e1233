"""Parts of a search by themselves: rules, the step of a screening, moves of rounded answers."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxtank import presets
from jaxtank.bounds import bounds
from jaxtank.case import Free
from jaxtank.core.clock import Clock
from tuning.search import diagnostics, messages, screening
from tuning.search.setting import setting_of


def test_plants_vary_where_anything_but_a_sensor_is_uncertain():
    case = presets.find("cascaded/pi")
    runs = {}
    for names in (("sensor.gain",), ("sensor.gain", "plant.drain"), ("plant.drain",)):
        setting = setting_of(case, None, None, dict.fromkeys(names, 0.05))
        runs[names] = setting.plants_vary, "new noise" in setting.runs
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

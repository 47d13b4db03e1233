"""The choice of the controller: first gains against closed forms, the best against searches of each
kind described in a rig file of its own."""

import json

import numpy as np
import pytest
from helpers import RIGS

import tuning
from jaxtank import presets, rig
from jaxtank.bounds import free_of
from jaxtank.core.errors import InputError
from tuning.cli import main
from tuning.problem.controllers import START, with_kind
from tuning.search import discrete

QUICK = tuning.Options(starts=1, screening=8, validation=0, iterations=40)


@pytest.fixture(scope="module")
def watertank():
    """A dH/dt = b V - a sqrt(H): A = 20, b = 5, a = 2, from 1 to 2 cm."""
    case = rig.load(RIGS / "watertank.toml")
    case = rig.set_values(case, {"clock.dt": 0.1, "clock.duration": 20.0})
    return case.replace(limits={}, objective={"rms_error_total": 1.0})


@pytest.mark.extended
def test_first_gains_of_one_tank_are_those_of_its_closed_forms(watertank):
    """Linear about 2 cm: T dh' = -dh + k du with T = 2 A sqrt(H) / a, k = 2 b sqrt(H) / a."""
    area, gain, drain, level = 20.0, 5.0, 2.0, 2.0
    k, T = 2 * gain * level**0.5 / drain, 2 * area * level**0.5 / drain
    T, slow = min(T, 20.0), T  # the length of the run
    pid = with_kind(with_kind(watertank, "state-feedback"), "pid").loop.controller
    at_rest = k / (1 + 1e-3 * slow / T)  # the gain of a pole moved by 1e-3 / T
    np.testing.assert_allclose(pid.Kc, [T / (at_rest * T / 10)], rtol=1e-9)
    np.testing.assert_allclose(pid.Ti, [4 * T / 10], rtol=1e-9)
    # scalar Riccati equation: 2 a p - p^2 b^2 / r + q = 0
    a, b = -1 / slow, gain / area
    q, r = (0.05 * 40.0) ** -2, (0.25 * 50.0) ** -2
    p = r / b**2 * (a + np.sqrt(a**2 + q * b**2 / r))
    feedback = with_kind(watertank, "state-feedback")
    np.testing.assert_allclose(feedback.loop.controller.K, [[b * p / r]], rtol=1e-6)
    largest = 4 * b * p / r
    assert free_of(feedback)["controller.K[0,0]"][:2] == pytest.approx((-largest, largest), 1e-2)
    lqi = with_kind(watertank, "lqi").loop.controller
    np.testing.assert_allclose(lqi.Q, [q, q / (T / 10) ** 2], rtol=1e-12)
    np.testing.assert_allclose(lqi.R, [r], rtol=1e-12)


def test_ranges_are_those_of_a_case_that_names_none_and_what_else_is_free_stays(watertank):
    alone = with_kind(watertank, "enmpc")
    assert not alone.free  # so that a search widens ranges at whose ends it stops
    case = watertank.replace(free={**watertank.free, "reference.ramp": (0.1, 2.0)})
    both = with_kind(case, "enmpc")
    assert both.free == {**free_of(alone), "reference.ramp": (0.1, 2.0)}
    assert list(free_of(alone)) == ["controller.Tp"]
    assert with_kind(case, "pid") is case


def test_a_rig_with_more_inputs_than_outputs_has_the_controllers_that_can_use_them():
    case = rig.load(RIGS.parent / "others" / "staged.toml")
    for kind in ("gpc", "laguerre", "nmpc"):
        controller = with_kind(case, kind).loop.controller
        assert controller.model.pumps == 2 and len(controller.model.outputs) == 1
    with pytest.raises(InputError, match="one pump per output: the model has 2 and 1"):
        with_kind(case, "pid")


@pytest.mark.extended
def test_published_gains_of_the_same_plant_are_taken():
    case = presets.find("gouta2015/backstepping")
    other, published = with_kind(case, "ngpc"), presets.find("gouta2015/ngpc")
    assert float(other.loop.controller.Tp) == float(published.loop.controller.Tp)
    assert other.free == published.free and other.symmetry is None
    weaker = rig.set_values(case, {"plant.pump_gain[0]": 1.0, "controller.model.pump_gain[0]": 1.0})
    assert float(with_kind(weaker, "ngpc").loop.controller.Tp) != float(other.loop.controller.Tp)


@pytest.mark.extended_for("state-feedback")
@pytest.mark.slow_for("enmpc")
@pytest.mark.parametrize("kind", START)
def test_every_kind_has_first_gains_for_a_rig_that_it_fits(kind):
    """They are finite, pass input validation, and are written to a file and read back."""
    rigs = {
        "two-tank-backstepping": "calofir/backstepping",
        "ngpc": "gouta2015/backstepping",
        "backstepping": "gouta2015/ngpc",
        "enmpc": "gouta2022/pi",
    }
    case = rig.open_case(rigs.get(kind, str(RIGS / "quadruple_tank.toml")))
    found = with_kind(case.replace(name="own"), kind)
    assert rig.loads(rig.dump(found)).free == found.free
    values = [rig.values.get_value(found.loop, name) for name in free_of(found)]
    assert values and all(np.all(np.isfinite(np.asarray(v))) for v in values)


@pytest.mark.slow
def test_the_best_kind_is_that_of_searches_of_each_kind_alone(watertank):
    """Each described in a rig file, with the gains and ranges that the choice begins with."""
    kinds, watertank = ["pid", "lqi"], rig.set_values(watertank, {"clock.dt": 0.2})
    chosen = tuning.tune_choices(watertank, {"controller.kind": kinds}, QUICK)
    alone = {}
    for kind in kinds:
        case = rig.loads(rig.dump(with_kind(watertank, kind)))
        alone[kind] = tuning.tune(case, QUICK)
    after = {kind: found.objective["after"] for kind, found in alone.items()}
    rows = {row["values"]["controller.kind"]: row for row in chosen.choices}
    for kind in kinds:
        assert rows[kind]["objective"]["after"] == pytest.approx(after[kind], rel=1e-6)
    best = min(after, key=after.get)
    assert chosen.objective["after"] == pytest.approx(after[best], rel=1e-6)
    assert type(chosen.tuned.loop.controller) is type(alone[best].tuned.loop.controller)
    assert set(chosen.parameters) == set(alone[best].parameters)
    assert f"best of 2 choices: controller.kind = {best}" in chosen.message
    assert f"controller.kind = {best}" in str(chosen)


@pytest.mark.slow
def test_a_kind_that_does_not_fit_is_a_row_with_the_reason(watertank, capsys):
    """On the command line, by the name of the table of a rig file."""
    options = ["--starts", "1", "--screening", "4", "--validation", "0", "--iterations", "5"]
    settings = ["--set", "clock.dt=0.2", "--limit", "none", "--objective", "rms_error_total=1"]
    path = str(RIGS / "watertank.toml")
    free = ["--free", "controller.Kc=1:10"]
    code = main.main(
        ["tune", path, *settings, *options, *free, "--choose", "law.kind=pid,ngpc", "--json"]
    )
    found = json.loads(capsys.readouterr().out)
    assert code in (0, 3)
    first, second = found["choices"]
    assert first["reason"] is None and set(first["parameters"]) == {"controller.Kc[0]"}
    assert second["status"] == "does not fit" and "state-coupled four-tank" in second["reason"]
    assert second["objective"] == {"before": None, "after": None}
    assert any(m["code"] == "choice-does-not-fit" for m in found["messages"])


@pytest.mark.parametrize(
    ("choices", "free", "words"),
    [
        ({"controller.kind": ["pdi"]}, None, "unknown controller kind 'pdi'; nearest: pi, pid"),
        ({"controller.kind": ["ngpc", "fuzzy"]}, None, "none fits the rig; controller.kind = ngpc"),
        ({"controller.kind": ["open-loop"]}, None, "has no gains to start from"),
        ({"controller.kind": "pid"}, None, "must be a list of values to try"),
        (
            {"controller.kind": ["pid"], "law.kind": ["lqi"]},
            None,
            "law.kind: is controller.kind by another name",
        ),
        (
            {"controller.kind": ["pid", "lqi"]},
            {"controller.Kd": (0.1, 1.0)},
            r"unknown parameter 'controller.Kd'; nearest: controller.Td",
        ),
    ],
)
def test_a_choice_that_cannot_be_made_is_refused_in_one_line(watertank, choices, free, words):
    with pytest.raises(InputError, match=words) as error:
        tuning.tune_choices(watertank, choices, QUICK, free=free)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_what_is_named_free_counts_for_the_kinds_that_have_it(watertank):
    free = {"controller.Kc": (1.0, 10.0)}
    few = tuning.Options(starts=1, screening=4, validation=0, iterations=3)
    kinds = {"controller.kind": ["pid", "enmpc"]}
    result = tuning.tune_choices(watertank, kinds, few, free=free)
    pid, other = (set(row["parameters"]) for row in result.choices)
    assert pid == {"controller.Kc[0]"} and other == {"controller.Tp"}


@pytest.mark.parametrize("kinds", [("pid", "enmpc"), ("enmpc", "pid")])
def test_a_gain_that_one_of_two_kinds_has_is_free_for_this_one_in_either_order(watertank, kinds):
    choices, gains = {"controller.kind": list(kinds)}, {"controller.Kc": (1.0, 10.0)}
    rows = {v.values["controller.kind"]: v for v in discrete._variants(watertank, choices, gains)}
    assert rows["pid"].free == gains and rows["enmpc"].free is None
    assert list(free_of(rows["enmpc"].case)) == ["controller.Tp"]


def test_choices_that_are_no_mapping_are_refused(watertank):
    with pytest.raises(InputError, match=r"choices = \['controller.kind'\]: must be \{name:"):
        tuning.tune_choices(watertank, ["controller.kind"], QUICK)

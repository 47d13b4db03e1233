"""Measures that count whole samples: a closed list, and no derivative that is a silent zero."""

import dataclasses
import types

import jax
import numpy as np
import pytest

import jaxtank
from jaxtank import measures as ms, presets, rig
from jaxtank.core.errors import InputError
from jaxtank.loop import change_windows, closed_loop

COUNTS = (
    *("saturated_fraction", "filter_active_fraction", "rise_time", "settling_time"),
    *("recovery_time", "time_of_max_level", "time_of_min_level", "time_of_steady_state_error"),
)


@pytest.fixture(scope="module")
def case():
    case = presets.find("cascaded/pi")
    return case.replace(clock=dataclasses.replace(case.clock, duration=800.0))


def at(case, Kc):
    return jaxtank.with_values(case.loop, {"controller.Kc[0]": Kc})


@pytest.mark.extended
def test_the_list_is_that_of_the_catalogue_and_the_values_have_steps(case):
    """Close enough together, two gains give the same number, and others do not."""
    assert tuple(m for m, spec in ms.MEASURES.items() if spec.counts) == COUNTS
    names = ("settling_time", "rise_time", "rms_error_total")
    a, b, far = (jaxtank.evaluate(at(case, k), case.clock, names) for k in (1.0, 1 + 1e-9, 2.0))
    for name in names[:2]:
        assert a[name] == b[name] != far[name]
    assert a["rms_error_total"] != b["rms_error_total"]


@pytest.mark.slow
@pytest.mark.slow_for("jacfwd-settling_time")
@pytest.mark.parametrize(
    "transform, name", [(jax.jacfwd, "settling_time"), (jax.jacrev, "time_of_max_level")]
)
def test_a_derivative_of_a_count_of_samples_is_refused(case, transform, name):
    def measured(Kc):
        return jaxtank.evaluate(at(case, Kc), case.clock, [name])[name]

    for f in (transform(measured), jax.jit(transform(measured))):
        with pytest.raises(InputError, match=f"{name}: counts whole samples"):
            f(1.0)


def test_sensitivities_of_a_count_are_refused(case):
    with pytest.raises(InputError, match="settling_time: counts whole samples"):
        jaxtank.sensitivities(case.loop, case.clock, ["settling_time"], {"controller.Kc[0]": 1.0})


@pytest.mark.slow
def test_other_measures_keep_their_derivatives_and_counts_their_values(case):
    def error(Kc):
        return jaxtank.evaluate(at(case, Kc), case.clock, ["rms_error_total"])["rms_error_total"]

    assert jax.grad(error)(1.0) != 0.0
    both = jax.vmap(lambda Kc: jaxtank.evaluate(at(case, Kc), case.clock, ["settling_time"]))
    one = jaxtank.evaluate(at(case, 1.0), case.clock, ["settling_time"])["settling_time"]
    assert both(jax.numpy.array([1.0, 2.0]))["settling_time"][0] == one


@pytest.mark.extended
def test_a_plateau_ends_at_the_sample_at_which_its_ramp_begins():
    """k dt rounded once and once more is not the start of a ramp to the last bit."""
    case = presets.find("gouta2015/ngpc-table1")
    run = jaxtank.simulate(case.loop, case.clock, None, 1)
    names = ["steady_state_error", "time_of_steady_state_error"]
    measured = jaxtank.evaluate(case.loop, case.clock, names)
    for output in range(2):
        time = float(measured["time_of_steady_state_error"][output])
        (k,) = np.flatnonzero(np.abs(run.t - time) < 1e-6)
        assert abs(run.e[k, output]) == pytest.approx(measured["steady_state_error"][output])
        later = np.asarray(run.r)[k : k + 2, output]
        assert time == pytest.approx(1200.0) or later[0] != later[1]


def test_an_output_that_starts_away_from_its_setpoint_has_a_change_at_0():
    t = np.arange(3.0)
    target, step, since, band = change_windows._from_start((10.0, 0.0, None, None), t, 8.0, 0.05)
    assert (float(target), float(step), float(band)) == (10.0, 2.0, 0.1) and since is t
    near = change_windows._from_start((10.0, 0.0, None, None), t, 9.95, 0.05)
    assert float(near[1]) == 0.0
    none = types.SimpleNamespace(windows=lambda times: None, band=0.05, changes=[])
    assert change_windows.windows(types.SimpleNamespace(reference=none), None) is None


PULSED = """
name = "pulsed"
tank = [{ area = 20.0, rim = 30.0, level = 10.0, drain = 0.3 }]
pump = [{ gain = 8.0, to = 1, high = 12.0, initial = 5.0 }]
controller = { kind = "pi", Kc = 2.0, Ti = 20.0 }
reference = { initial = [10.0], changes = [[1.0, 1, 11.0]] }
inflow = [{ time = 60.0, duration = 5.0, tank = 1, volume = 60.0 }]
values = { "clock.dt" = 0.5, "clock.duration" = 140.0 }
"""


@pytest.mark.parametrize("arrays", [False, True])
def test_a_tank_that_recovers_from_a_pulse_is_not_settling(arrays, monkeypatch):
    monkeypatch.setattr("jaxtank.core.vectors.FROM", 1 if arrays else 10**9)
    jax.clear_caches()
    case = rig.loads(PULSED)
    run, names = jaxtank.simulate(case.loop, case.clock), ("overshoot_percent", "settling_time")
    values = jaxtank.evaluate(case.loop, case.clock, names)
    outside, past = np.abs(run.x[:, 0] - 11.0) > 0.05, 100.0 * (run.x[:, 0] - 11.0)
    watched = (run.t >= 60.0) & (run.t <= 120.0)
    assert past[watched].max() > 20.0 > past[~watched].max()  # of a step of 1 cm
    expected = [max(past[~watched].max(), 0.0)]
    np.testing.assert_allclose(values["overshoot_percent"], expected, rtol=1e-9)
    assert not outside[119] and np.any(outside & watched)
    np.testing.assert_allclose(values["settling_time"], [run.t[:120][outside[:120]][-1] - 1.0])


def test_a_recovery_needs_a_pulse(case):
    with pytest.raises(InputError):
        closed_loop._context(case.loop, case.clock, ("recovery_time",), ())

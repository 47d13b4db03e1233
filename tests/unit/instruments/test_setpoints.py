"""Setpoints whose levels, durations and filter are leaves: closed forms, other solvers, slopes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal as linear_systems

import jaxtank
from jaxtank import presets, rig
from jaxtank.core.clock import Chunk, Clock
from jaxtank.core.errors import InputError
from jaxtank.core.tree import with_values
from jaxtank.signals import setpoints
from jaxtank.signals.inflows import inflow_pulses
from jaxtank.signals.setpoints import ramps

CLOCK = Clock(dt=0.1, duration=60.0)
# the second change begins before the first has ended; the other channel has one of its own
CHANGES = [(5.0, 0, 8.0), (12.0, 0, 2.0), (20.0, 1, 6.0), (40.0, 0, 5.0)]
INITIAL = np.array([3.0, 4.0])
TIMES = np.arange(CLOCK.samples) * CLOCK.dt


def reference(ramp=10.0, filter=None):
    return ramps(INITIAL.tolist(), CHANGES, ramp=ramp, filter=filter)


@jax.jit
def sample(signal):
    return tuple(jnp.stack(v) for v in signal.sample(CLOCK))


@pytest.mark.slow
def test_the_filter_of_ramps_is_that_of_another_solver():
    lags = (4.0, 0.3)
    plain, found = np.asarray(sample(reference())[0]), np.asarray(sample(reference(10.0, lags))[0])
    for start, lag, r, f in zip(INITIAL, lags, plain, found):
        # exact for an input that is a straight line between samples
        _, other, _ = linear_systems.lsim(([1.0], [lag, 1.0]), r - start, TIMES)
        np.testing.assert_allclose(f, start + other, atol=1e-11)


def test_the_filter_of_a_step_is_an_exponential_and_its_rates_are_its_slopes():
    f, rate, second = (np.asarray(v)[1] for v in sample(reference(0.0, (1.0, 2.5))))
    since = np.maximum(TIMES - 20.0, 0.0)
    after = np.exp(-since / 2.5) * (TIMES >= 20.0 - 1e-9)
    np.testing.assert_allclose(f, 6.0 - 2.0 * np.where(TIMES < 20.0 - 1e-9, 1.0, after), atol=1e-12)
    np.testing.assert_allclose(rate, 2.0 / 2.5 * after, atol=1e-12)
    np.testing.assert_allclose(second, -2.0 / 2.5**2 * after, atol=1e-12)
    value, rate, second = (np.asarray(v)[0] for v in sample(reference(10.0, (4.0, 1.0))))
    corners = [0.0, 5.0, 12.0, 22.0, 40.0, 50.0, 60.0]
    inner = np.abs(TIMES[:, None] - corners).min(axis=1) > 0.15
    np.testing.assert_allclose(np.gradient(value, 0.1)[inner], rate[inner], atol=2e-4)
    np.testing.assert_allclose(np.gradient(rate, 0.1)[inner], second[inner], atol=2e-4)


@pytest.mark.slow_for("calofir/backstepping")
@pytest.mark.parametrize(
    "name",
    ["calofir/backstepping", pytest.param("gouta2015/backstepping-ff", marks=pytest.mark.slow)],
)
def test_a_time_constant_of_zero_changes_no_bit_of_a_run(name):
    case = presets.find(name)
    case = rig.set_values(case, {"clock.dt": max(case.clock.dt, 0.1)})
    other = rig.set_values(case, {"reference.filter": 0.0})
    runs = [jaxtank.simulate(c.loop, c.clock, save_every=10) for c in (case, other)]
    for column in ("r", "x", "u", "e"):
        np.testing.assert_array_equal(*(getattr(run, column) for run in runs))


@pytest.mark.extended_for("filter1")
@pytest.mark.parametrize("filter", [None, (4.0, 0.0)])
def test_a_part_of_the_samples_is_as_in_the_whole(filter):
    part = jax.jit(lambda s: s.sample(Chunk(first=93, samples=200, dt=CLOCK.dt)))
    for whole, own in zip(sample(reference(7.23, filter)), part(reference(7.23, filter))):
        np.testing.assert_allclose(jnp.stack(own), whole[:, 93:293], atol=1e-13)


@pytest.mark.parametrize("ramp", [10.0, 7.0, 7.23, 7.299, 0.04])
def test_the_rates_of_a_ramp_add_up_to_its_step_for_any_duration(ramp):
    _, rate, _ = sample(ramps([3.0], [(20.0, 0, 8.0)], ramp=ramp))
    np.testing.assert_allclose(CLOCK.dt * np.sum(rate), 5.0, rtol=1e-12)


def weighted(signal):
    """Sums of values and of rates that weigh each sample differently."""
    value, rate, _ = sample(signal)
    weights = jnp.sin(0.37 * jnp.arange(CLOCK.samples))
    return jnp.stack([jnp.sum(weights * value), jnp.sum(weights * rate)])


def test_slopes_by_every_leaf_are_central_differences():
    names = ["ramp", "targets[1]", "initial[0]", "filter[0]", "filter[1]"]
    signal, point = reference(7.23, (4.0, 0.5)), jnp.array([7.23, 2.0, 3.0, 4.0, 0.5])
    f = jax.jit(lambda z: weighted(with_values(signal, dict(zip(names, z)))))
    steps = 1e-5 * np.eye(len(names))
    central = np.stack([(f(point + e) - f(point - e)) / 2e-5 for e in steps], axis=1)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(f))(point), central, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("ramp", [7.5])
def test_where_a_ramp_ends_on_a_sample_its_slope_is_the_one_from_below(ramp):
    @jax.jit
    def f(x):
        return weighted(with_values(reference(), {"ramp": x}))

    slope, below = jax.jit(jax.jacfwd(f))(ramp), (f(ramp - 1e-4) - f(ramp - 2e-4)) / 1e-4
    np.testing.assert_allclose(slope, below, rtol=1e-3)
    above = (f(ramp + 2e-4) - f(ramp + 1e-4)) / 1e-4
    assert not np.allclose(above, below, rtol=1e-2)  # it is a kink


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, signal", [("ramp", reference(0.0)), ("filter", reference(0.0, (0.0, 0.0)))]
)
def test_slopes_of_steps_and_of_no_filter_are_finite(name, signal):
    total = lambda v: sum(map(jnp.sum, sample(with_values(signal, {name: v}))))
    assert np.all(np.isfinite(jax.jacfwd(total)(jnp.asarray(getattr(signal, name)))))


def test_a_filter_is_for_ramps():
    curves = ramps([3.0], [(20.0, 0, 8.0)], shape="quintic", filter=[1.0])
    with pytest.raises(InputError, match=r"reference\.filter.*'quintic'"):
        curves.sample(CLOCK)


@pytest.mark.extended_for("course0", "course2")
@pytest.mark.slow_for("course3")
@pytest.mark.parametrize(
    "course", [{"ramp": 0.0}, {"ramp": 9.3}, {"ramp": 5.0, "shape": "quintic"}, {"filter": [3.0]}]
)
def test_many_changes_give_what_as_many_pieces_give(course, monkeypatch):
    rng = np.random.default_rng(0)
    times = np.sort(rng.choice(np.arange(1, 400), 8, replace=False)) * 0.25
    changes = [(float(t), 0, float(v)) for t, v in zip(times, rng.uniform(1.0, 3.0, 8))]
    reference = ramps([2.0], changes, **{"ramp": 4.0, **course})
    clock = Clock(dt=0.5, duration=90.0)
    monkeypatch.setattr(setpoints, "MANY", 5)
    sampled = lambda: jax.jit(lambda r: (r.sample(clock), r.windows(clock)))(reference)
    looked_up = sampled()
    monkeypatch.setattr(setpoints, "MANY", 1000)
    pieces = sampled()
    for values, expected in zip(jax.tree.leaves(looked_up), jax.tree.leaves(pieces)):
        np.testing.assert_allclose(values, expected, rtol=1e-13, atol=1e-13)


def test_a_short_ramp_is_as_steep_as_it_is_short():
    t = jnp.array([0.125, 0.25, 0.5, 1.0])
    r, *_ = setpoints._lagged(1.0, 1.0, 3.0, 0.0, 0.5, 2.0, t)
    np.testing.assert_allclose(r, [1.5, 2.0, 3.0, 3.0], rtol=1e-12)


def test_a_time_has_the_first_sample_at_or_after_it():
    clock, times = Clock(dt=0.5, duration=10.0), [-1.0, 0.0, 0.2, 0.5, 0.7, 2.0]
    assert [setpoints.index(time, clock) for time in times] == [0, 0, 1, 1, 2, 4]
    assert setpoints.index(np.array(times), clock).tolist() == [0, 0, 1, 1, 2, 4]


@pytest.mark.parametrize("pulse", [(-1.0, 1.0, 0), (1.0, 0.0, 0), (1.0, 1.0, 2), (1.0, 1.0, -1)])
def test_a_pulse_begins_in_the_run_lasts_and_enters_a_tank(pulse):
    with pytest.raises(InputError):
        inflow_pulses(2, [(*pulse, 5.0)])

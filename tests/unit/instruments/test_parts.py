"""Signals, sensors, pumps and measures, each alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import sampled
from scipy.integrate import solve_ivp

import jaxtank
from jaxtank import measures as ms
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.core.numerics import decay
from jaxtank.core.tree import number
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.signals.setpoints import ramps

# signals


@pytest.mark.slow_for("0.01-linear", "0.01-quintic")
@pytest.mark.parametrize("shape", ["linear", "quintic"])
@pytest.mark.parametrize("dt", [0.01, 0.7])
def test_a_ramp_against_its_definition(shape, dt):
    clock = Clock(dt=dt, duration=200.0)
    r, dr, ddr = (
        np.asarray(v[0])
        for v in sampled(ramps([3.0], [(20.0, 0, 8.0), (90.0, 0, 5.0)], 60.0, shape), clock)
    )
    t = np.arange(clock.samples) * dt
    x1, x2 = np.clip((t - 20) / 60, 0, 1), np.clip((t - 90) / 60, 0, 1)
    s = (lambda x: x) if shape == "linear" else lambda x: 10 * x**3 - 15 * x**4 + 6 * x**5
    np.testing.assert_allclose(r, 3 + 5 * s(x1) - 3 * s(x2), atol=1e-12)
    if shape == "linear":
        # of the last sample, its part before the end of the ramp
        part = lambda start: (t >= start - 1e-9) * np.clip((start + 60 - t) / dt, 0, 1)
        np.testing.assert_allclose(dr, 5 / 60 * part(20) - 3 / 60 * part(90), atol=1e-12)
        assert not ddr.any()
    else:
        ds, dds = (
            lambda x: 30 * x**2 * (1 - x) ** 2 / 60,
            lambda x: 60 * x * (1 - x) * (1 - 2 * x) / 3600,
        )
        np.testing.assert_allclose(dr, 5 * ds(x1) - 3 * ds(x2), atol=1e-13)
        np.testing.assert_allclose(ddr, 5 * dds(x1) - 3 * dds(x2), atol=1e-14)


def test_steps_and_overlapping_ramps():
    clock = Clock(dt=0.1, duration=30.0)
    r, dr, _ = (np.asarray(v[0]) for v in sampled(ramps([1.0], [(10.0, 0, 4.0)], 0.0), clock))
    assert r[99] == 1.0 and r[100] == 4.0 and not dr.any()
    # the second change starts from where the first has got to, half way
    r = np.asarray(sampled(ramps([0.0], [(0.0, 0, 10.0), (10.0, 0, 0.0)], 20.0), clock)[0][0])
    np.testing.assert_allclose(r[[50, 100, 150, 200, 300]], (2.5, 5.0, 3.75, 2.5, 0.0), atol=1e-12)


def test_plateaus_and_windows():
    reference = ramps([3.0, 3.0], [(20.0, 0, 8.0), (20.0, 1, 8.0), (40.0, 1, 14.0)], 5.0)
    np.testing.assert_array_equal(reference.plateaus(), [[3, 3], [8, 8], [8, 14]])
    target, step, since, band = (
        np.asarray(v) for v in reference.windows(Clock(dt=1.0, duration=60.0))[1]
    )
    assert (target[10], step[10]) == (3.0, 0.0)
    assert (target[30], step[30], since[30]) == (8.0, 5.0, 5.0)
    assert (target[50], step[50], since[50]) == (14.0, 6.0, 5.0)
    np.testing.assert_allclose(band[50], 0.3)


def test_gradient_of_a_reference_by_its_targets():
    clock = Clock(dt=1.0, duration=100.0)
    reference = ramps([3.0], [(20.0, 0, 8.0)], 60.0)
    slope = jax.jit(
        jax.jacfwd(lambda v: jaxtank.with_values(reference, {"targets[0]": v}).sample(clock)[0][0])
    )(8.0)
    np.testing.assert_allclose(slope, np.clip((np.arange(101) - 20) / 60, 0, 1), atol=1e-12)


@pytest.mark.parametrize("change", [(-1.0, 0, 4.0), (1.0, 2, 4.0)])
def test_a_change_at_a_bad_time_or_channel_is_refused(change):
    with pytest.raises(InputError):
        ramps([1.0, 1.0], [change])


# sensor


def sensor(**more):
    plain = {"gain": number([2.0, 3.0]), "noise": number([0.0, 0.0]), "full_scale": number(3.3)}
    return LevelSensor(**{**plain, **more})


@pytest.mark.extended
def test_noise_has_its_standard_deviation_and_its_own_stream_per_tank():
    s = sensor(noise=number([0.1, 0.5]))
    xi = np.array(s.draw(jax.random.key(0), 20_000))
    y = np.array(s.read((np.full(20_000, 4.0), np.full(20_000, 4.0)), tuple(xi)))
    np.testing.assert_allclose(y.mean(axis=1), 4.0, atol=5 * 0.5 / np.sqrt(20_000))
    # 1/sqrt(2 n) = 0.5 %, six of them
    np.testing.assert_allclose(y.std(axis=1), (0.1, 0.5), rtol=0.03)
    assert abs(np.corrcoef(xi)[0, 1]) < 0.03


def test_the_adc_rounds_and_clips():
    s = sensor(bits=12)
    step = 3.3 / 4096 * 2.0  # of the first sensor [cm]
    y = float(s.read((1.0, 1.0), None)[0])
    assert abs(y - 1.0) <= step / 2 and round(y / step, 9) == round(y / step)
    np.testing.assert_allclose(s.read((-1.0, 99.0), None), (0.0, 3.3 * 3.0))


def test_noise_without_a_key_is_refused_inside_jit_and_by_sensitivities(gouta):
    case = gouta("ngpc", {"sensor.noise": 0.1})
    run = lambda Tp: jaxtank.evaluate(
        jaxtank.with_values(case.loop, {"controller.Tp": Tp}), case.clock, "rms_error"
    )
    with pytest.raises(InputError, match=r"sensor\.noise"):
        jax.jit(run)(11.0)
    with pytest.raises(InputError, match=r"sensor\.noise"):
        jaxtank.sensitivities(case.loop, case.clock, "rms_error", {"controller.Tp": 11.0})


@pytest.mark.parametrize(
    "values, words",
    [
        ({"actuator.dead_zone": 5.0, "actuator.dead_zone_kind": "pulse"}, "actuator.dead_zone"),
        ({"actuator.dead_zone": 1.0, "actuator.dead_zone_kind": "hysteresis"}, "actuator.stop"),
        ({"actuator.delay": 0.015}, "whole number of samples"),
    ],
)
def test_pumps_that_make_no_sense_are_refused(gouta, values, words):
    case = gouta("ngpc", values)
    with pytest.raises(InputError, match=words):
        jaxtank.evaluate(case.loop, case.clock, "rms_error")


@pytest.mark.slow
def test_noise_makes_the_voltage_travel_as_the_notes_say(gouta):
    """5 mV on each sensor: travel of pump 1 is about 19,400 V with NGPC and 11,100 V with
    backstepping (gouta2015 notes S8.1).
    """
    noise = [0.005 * a for a in (9.4458, 8.7106, 8.5106, 9.3458)]
    for name, travel in (("ngpc", 19_400), ("backstepping", 11_100)):
        case = gouta(name, {"sensor.noise": noise})
        values = jaxtank.evaluate(
            case.loop, case.clock, ["input_travel", "rms_error_total"], key=jax.random.key(1)
        )
        np.testing.assert_allclose(values["input_travel"][0], travel, rtol=0.03)


# pumps


def pumps(**more):
    plain = {"low": [0, 0], "high": [12, 12], "stop": [1.5, 1.5], "pulse": [3.3, 3.3]}
    values = {**plain, "initial": [2, 4], **more}
    return PumpBank(**{k: number(v) if isinstance(v, list) else v for k, v in values.items()})


def drive(bank, commands, dt=0.1):
    state, out = bank.init(Clock(dt=dt, duration=10.0)), []
    for command in commands:
        held = bank.limit(tuple(jnp.asarray(float(v)) for v in command))
        u, state = bank.step(state, held, dt)
        out.append([float(v) for v in u])
    return np.array(out)


def test_saturation_alone():
    np.testing.assert_array_equal(drive(pumps(), [(-1, 13), (5, 6)]), [[0, 12], [5, 6]])


def test_dead_zone():
    np.testing.assert_array_equal(
        drive(pumps(dead_zone=[3, 3]), [(3.0, 3.01), (0, 12)]), [[0, 3.01], [0, 12]]
    )


def test_hysteresis():
    got = drive(
        pumps(dead_zone=[3, 3], dead_zone_kind="hysteresis"),
        [(2, 2), (1.4, 2), (2, 2), (3.1, 1.4), (1.6, 2.9)],
    )
    np.testing.assert_array_equal(got, [[2, 2], [0, 2], [0, 2], [3.1, 0], [1.6, 0]])


def test_pulses_deliver_the_mean():
    got = drive(pumps(dead_zone=[3, 3], dead_zone_kind="pulse"), [(1.0, 5.0)] * 330)
    assert set(np.round(got[:, 0], 9)) == {0.0, 3.3}
    np.testing.assert_allclose(got.mean(axis=0), (1.0, 5.0), atol=3.3 / 330)


def test_lag_is_exact_over_a_sample():
    """The mean over each sample of 0.1 s of 6 - 4 exp(-t / 1 s)."""
    got = drive(pumps(lag=[1.0, 0.0]), [(6.0, 6.0)] * 20)
    t = 0.1 * np.arange(21)
    np.testing.assert_allclose(got[:, 0], 6 + (2 - 6) * -np.diff(np.exp(-t)) / 0.1, rtol=1e-12)
    np.testing.assert_array_equal(got[:, 1], 6.0)


@pytest.mark.parametrize("dt", [0.2, 1.0, 4.0])
def test_a_lag_delivers_its_volume_whatever_the_sampling_period(dt):
    """Pumps of 0.8 s whose command changes every 4 s: the volume is that of lag v' = u - v by
    scipy, sampled fast or slowly.
    """
    lag, commands = 0.8, (5.0, 1.0, 8.0)
    got = drive(
        pumps(lag=[lag, lag]), [(u, u) for u in commands for _ in range(round(4.0 / dt))], dt=dt
    )
    v, volume = 2.0, 0.0
    for u in commands:
        rate = lambda t, y, u=u: [(u - y[0]) / lag, y[0]]
        run = solve_ivp(rate, (0.0, 4.0), [v, volume], rtol=1e-11, atol=1e-12)
        v, volume = run.y[:, -1]
    assert got[:, 0].sum() * dt == pytest.approx(volume, rel=1e-9)


def test_the_slope_by_a_lag_that_follows_at_once():
    """From 2 V to 6 V: the mean over a sample of 0.1 s is short by 4 V lag / 0.1 s, of a lag of 0 s
    too.
    """
    start = pumps(lag=[1.0, 1.0]).init(Clock(dt=0.1, duration=1.0))
    at = lambda lag: pumps(lag=jnp.stack([lag, lag])).step(start, (6.0, 6.0), 0.1)[0][0]
    assert float(at(0.0)) == 6.0 and float(at(1e-3)) == pytest.approx(6.0 - 0.04, rel=1e-12)
    assert float(jax.grad(at)(0.0)) == pytest.approx(-40.0, rel=1e-12)


def test_delay_is_whole_samples_and_starts_from_the_initial_voltage():
    got = drive(pumps(delay=0.3), [(float(i), 6.0) for i in range(6)])
    np.testing.assert_array_equal(got[:, 0], [2, 2, 2, 0, 1, 2])
    np.testing.assert_array_equal(got[:, 1], [4, 4, 4, 6, 6, 6])


# measures


def fake_run(error, dt=1.0):
    one = dict.fromkeys(("tanks", "outputs", "pumps"), 1)
    limits = {"low": (0.0,), "high": (12.0,), "rim": (10.0,)}
    return ms.Run(samples=len(error), dt=dt, zero=jnp.zeros(()), **one, **limits)


def folded(names, levels, target, step, since, u=None, command=None, r=None):
    """Measures of a hand-made run of one tank."""
    from jaxtank.core.records import Sample

    run = fake_run(levels)
    states = ms.start(run, names)
    for k, h in enumerate(levels):
        rk = target[k] if r is None else r[k]
        uk = 0.0 if u is None else u[k]
        sample = Sample(
            t=jnp.float64(k), x=(jnp.float64(h),), y=(h,), x_hat=(h,), d_hat=(0.0,), r=(rk,),
            e=(jnp.float64(h - rk),), command=(uk if command is None else command[k],),
            applied=(jnp.float64(uk),), u=(jnp.float64(uk),), spilled=(0.0,),
        )  # fmt: skip
        window = tuple(map(jnp.float64, (target[k], step[k], since[k], 0.05 * abs(step[k]))))
        states = ms.update(run, states, sample, ms.Context((window,)))
    return {m: np.asarray(v) for m, v in ms.read(run, states, names).items()}


def test_overshoot_rise_and_settling_of_a_hand_made_step():
    levels, step = [0, 0, 2, 5, 8, 11, 10.6, 9.3, 10.2, 10], [0] * 2 + [10] * 8
    names = ("overshoot_percent", "rise_time", "settling_time")
    got = folded(names, levels, step, step, [0, 0, *range(8)])
    np.testing.assert_allclose(got["overshoot_percent"], 10.0)
    np.testing.assert_allclose(got["rise_time"], 3.0)  # from t = 2 (past 10 %) to t = 5 (past 90 %)
    # 9.3 at t = 7, five seconds after the change, is the last outside
    np.testing.assert_allclose(got["settling_time"], 5.0)


def test_what_never_settles_is_not_given_a_time():
    levels, target = [0, 0, 5, 9.8, 10, 10, 15, 15], [0, 0, 10, 10, 10, 10, 20, 20]
    step, since = [0, 0, 10, 10, 10, 10, 10, 10], [0, 0, 0, 1, 2, 3, 0, 1]
    assert folded(("settling_time",), levels, target, step, since)["settling_time"] == np.inf
    # outside at the end of the first change, settled in the second: still not settled
    levels = [0, 0, 5, 5, 5, 5, 20, 20]
    assert folded(("settling_time",), levels, target, step, since)["settling_time"] == np.inf
    assert np.isnan(folded(("settling_time",), [1] * 4, [1] * 4, [0] * 4, [0] * 4)["settling_time"])


def test_a_downward_step_has_its_overshoot_below():
    levels, step, since = [10, 10, 4, 1, 2], [0, 0, -8, -8, -8], [0, 0, 0, 1, 2]
    got = folded(("overshoot_percent",), levels, [10, 10, 2, 2, 2], step, since)
    np.testing.assert_allclose(got["overshoot_percent"], 12.5)


def test_saturation_is_of_the_command_and_its_excess_is_bounded():
    got = folded(
        ("saturated_fraction", "saturation_excess"), [1] * 4, [1] * 4, [0] * 4, [0] * 4,
        u=[0, 5, 12, 12], command=[-12, 5, 12, 24],
    )  # fmt: skip
    np.testing.assert_allclose(got["saturated_fraction"], 0.5)
    np.testing.assert_allclose(got["saturation_excess"], 0.25)  # (1/2 + 0 + 0 + 1/2) / 4


def test_levels_over_the_rim_and_when():
    names = ("max_level", "min_level", "rms_over_rim", "mean_square_over_rim", "time_of_max_level")
    got = folded(names, [9, 12, 14, 14, 9], [9] * 5, [0] * 5, [0] * 5)
    np.testing.assert_allclose(got["rms_over_rim"], np.sqrt((4 + 16 + 16) / 5))
    np.testing.assert_allclose(got["mean_square_over_rim"], [(4 + 16 + 16) / 5])
    assert (got["max_level"], got["min_level"], got["time_of_max_level"]) == (14, 9, 2)


def test_an_unknown_measure_is_answered_with_the_nearest(gouta):
    case = gouta("ngpc")
    with pytest.raises(InputError, match="rms_error_total"):
        jaxtank.evaluate(case.loop, case.clock, "rms_eror_total")


@pytest.mark.extended
def test_estimation_rms_is_the_noise_where_levels_are_taken_as_measured(gouta):
    case = gouta("backstepping", {"sensor.noise": [0.1, 0.2, 0.0, 0.05], "clock.duration": 100.0})
    got = jaxtank.evaluate(case.loop, case.clock, "estimation_rms", key=jax.random.key(0))[
        "estimation_rms"
    ]
    np.testing.assert_allclose(got, (0.1, 0.2, 0.0, 0.05), rtol=0.04)


def test_two_pumps_share_what_one_cannot_give_by_the_metric():
    """min (u - c)' G (u - c) with u1 <= 10: u2 = c2 + g12/g22 (c1 - 10)."""
    bank = PumpBank(low=[0.0, 0.0], high=[10.0, 10.0], saturation="boxqp")
    shared = bank.limit((12.0, 5.0), (1.0, 0.5, 1.0))
    np.testing.assert_allclose(shared, (10.0, 6.0), rtol=1e-9)


def test_noise_is_added_to_a_reading_and_is_the_same_drawn_at_once_or_by_samples():
    sensor, key = LevelSensor(noise=[0.1, 0.2], offset=[0.5, -0.25]), jax.random.key(3)
    np.testing.assert_allclose(sensor.read((3.0, 4.0), (1.0, -2.0)), [3.6, 3.35], rtol=1e-14)
    whole = sensor.deviates(key, 7)
    for k in (0, 4):
        alone = np.asarray(sensor.draw_sample(key, 7, k))
        np.testing.assert_array_equal(alone, sensor.draw_sample(key, 7, k, arrays=True))
        np.testing.assert_allclose(alone, [np.asarray(v)[k] for v in whole], rtol=1e-12)


def test_a_filter_follows_readings_with_their_noise_by_its_time_constant():
    sensor = LevelSensor(noise=[0.1, 0.2], offset=[0.5, 0.0], filter=[2.0, 0.0])
    rng = np.random.default_rng(1)
    x, xi = rng.uniform(1.0, 5.0, (40, 2)), rng.normal(size=(40, 2))
    raw, state, y = x + [0.5, 0.0] + [0.1, 0.2] * xi, sensor.init(tuple(x[0])), []
    for level, noise in zip(x, xi):
        reading, state = sensor.step(state, tuple(level), tuple(noise), 0.3)
        y.append(np.array(reading))
    # before the first sample it was at rest; the level of each sample counts for 1 - exp(-dt/T)
    ages = np.exp(-0.3 / 2.0) ** np.arange(41)
    weights = (1.0 - ages[1]) * ages
    before = x[0, 0] + 0.5
    expected = [weights[: k + 1][::-1] @ raw[: k + 1, 0] + ages[k + 1] * before for k in range(40)]
    np.testing.assert_allclose(np.array(y)[:, 0], expected, rtol=1e-12)
    np.testing.assert_array_equal(np.array(y)[:, 1], raw[:, 1])
    slope = jax.grad(decay, argnums=1)
    assert slope(0.3, 2.0) == pytest.approx(0.3 / 4.0 * np.exp(-0.15), rel=1e-6)
    assert slope(0.3, 0.0) == 0.0 == decay(0.3, 0.0)


def test_an_adc_needs_its_gain():
    with pytest.raises(InputError):
        LevelSensor(noise=[0.1], bits=8, full_scale=5.0)

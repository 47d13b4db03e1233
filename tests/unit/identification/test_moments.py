"""Inputs that change between the rows of a log: logs of a tank with an integrator of this file."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from helpers import rk4

import tuning
from jaxtank import rig, simulate
from tuning.cli.main import main
from tuning.identification import assumptions, posterior
from tuning.identification.assumptions import Assumption
from tuning.identification.data_checks import assuming
from tuning.identification.least_squares import solve
from tuning.identification.moments import (
    SD,
    Moments,
    OfLog,
    acts_between,
    are_open,
    changes,
    groups_of,
    in_parts,
    shares_of,
    too_many,
    with_mean,
    with_shares,
    without_gaps,
)
from tuning.report.identification import diagnosis_of

TANK = """
units = ["cm", "V"]
tank = [{ area = 100.0, rim = 40.0, drain = 1.2, level = 12.0 }]
pump = [{ gain = 30.0, to = 1, high = 10.0, initial = 6.0 }]
controller = { kind = "pi", Kc = 1.0, Ti = 60.0, bias = 6.0 }
reference = { initial = [12.0] }
values = { "clock.dt" = 2.0 }
"""
TRUE = {"plant.pump_gain[0]": 25.0, "plant.drain[0]": 1.0}
FREE = {"plant.pump_gain": (5.0, 100.0), "plant.drain": (0.1, 5.0)}


def record(seed, period, every, exponent=0.5, end=800.0):
    """Log with rows every `period` s of a tank whose pump steps every `every` s."""
    rng, dt = np.random.default_rng(seed), 0.1
    inputs, t = rng.uniform(4.0, 8.0, int(end / every) + 1), np.arange(0.0, end, period)
    at = lambda time: inputs[np.floor(time / every + 1e-9).astype(int)]

    def rate(h, u):
        return (25.0 * u - np.sqrt(2 * 981.0) * np.maximum(h, 0.0) ** exponent) / 100.0

    h, levels = np.array([12.0]), []
    for k in range(int(end / dt)):
        levels.append(h[0])
        u = at((k + 0.5) * dt)
        h = rk4(lambda h, u=u: rate(h, u), h, dt)
    y = np.interp(t, dt * np.arange(len(levels)), levels) + 0.1 * rng.standard_normal(t.size)
    return tuning.log(t=t, u=at(t), y=y)


def record_of_loop(seed, every, period, gain=0.1, first=None, end=1200.0):
    """Log with rows every `period` s, from `first` tenths of a second on (drawn if None), of the
    tank under a PI that acts every `every` s.
    """
    rng, dt = np.random.default_rng(seed), 0.1
    setpoints, drawn = rng.uniform(8.0, 16.0, int(end / 300.0) + 1), rng.integers(int(period / dt))
    first = drawn if first is None else first
    h, integral, u, rows = 12.0, 6.0, 6.0, []
    for k in range(int(end / dt)):
        if k % round(every / dt) == 0:
            error = setpoints[int(k * dt / 300.0)] - (h + 0.05 * rng.standard_normal())
            integral += gain * error * every / 60.0
            u = min(max(integral + gain * error, 0.0), 10.0)
        if k % round(period / dt) == first:
            rows.append((k * dt, u, h + 0.05 * rng.standard_normal()))
        half = h + 0.5 * dt * (25.0 * u - (1962.0 * h) ** 0.5) / 100.0
        h += dt * (25.0 * u - (1962.0 * max(half, 0.0)) ** 0.5) / 100.0
    t, u, y = np.array(rows).T
    return tuning.log(t=t, u=u, y=y)


def identified(log, **options):
    fit = tuning.identify(rig.loads(TANK), log, FREE, starts=1, hold_back=0.0, **options)
    return fit, fit.estimation.logs[0].assumed


def outside(fit):
    interval = {name: fit.parameters[name]["interval95"] for name in TRUE}
    return [name for name, v in TRUE.items() if not interval[name][0] <= v <= interval[name][1]]


@pytest.mark.extended_for("0", "1", "2")
@pytest.mark.parametrize("seed", [0, 1, 2, 4])
def test_a_log_polled_between_the_changes_is_told_and_intervals_hold(seed):
    """Rows every 7 s, changes every 40 s: a step at its row acts up to 7 s late. Levels move far
    from row to row: of seed 4 second differences show 2.5 times the noise.
    """
    log = record(seed, 7.0, 40.0)
    fit, assumed = identified(log)
    assert assumed == {"inputs": "moments"}
    assert outside(fit) == [] and diagnosis_of(fit)["clean"]
    assert fit.quality["rmse"][0] < 0.13  # noise of 0.1 cm
    late, assumed = identified(tuning.log(t=log.t, u=log.u, y=log.y, hold="zero-order"))
    assert assumed == {} and late.quality["rmse"][0] > 2 * fit.quality["rmse"][0]


@pytest.mark.extended_for("0", "2")
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_intervals_hold_where_a_controller_acts_between_the_rows(seed):
    """A PI of 0.5 s, rows every 5 s: with changes at the rows gain and drain are 20 % off, and the
    residual may be noise.
    """
    log = record_of_loop(seed, 0.5, 5.0)
    fit, assumed = identified(log)
    assert assumed == {"inputs": "moments"}
    assert outside(fit) == [] and diagnosis_of(fit)["clean"]
    late, _ = identified(dataclasses.replace(log, hold="zero-order"))
    assert outside(late) == list(TRUE)


@pytest.mark.extended
def test_a_controller_that_acts_at_the_rows_is_told():
    """Moments fit clearly worse, for what their freedom costs, but where rows come 3 s late."""
    assert identified(record_of_loop(1, 5.0, 5.0, gain=0.2, first=0))[1] == {}
    fit, assumed = identified(record_of_loop(1, 5.0, 5.0, gain=0.2, first=30))
    assert assumed == {"inputs": "moments"} and outside(fit) == []


@pytest.mark.parametrize(("gain", "noted"), [(0.1, False), (0.8, True)])
def test_a_loop_that_is_faster_than_the_rows_is_noted(gain, noted):
    log = record_of_loop(0, 0.5, 5.0, gain=gain)
    remarks = Assumption("moments", False, 0.0 * log.u).applied(log, rig.loads(TANK)).remarks
    assert any("jump and return" in remark for remark in remarks) is noted


@pytest.mark.parametrize("hold", ["", "zero-order"])
def test_a_log_without_the_rows_of_changes_is_cut_there(hold):
    log = record(3, 2.0, 40.0)
    missing = np.isin(log.t, [80.0, 200.0, 202.0, 204.0, 480.0])
    data = {"t": log.t[~missing], "u": log.u[~missing], "y": log.y[~missing]}
    fit, assumed = identified(tuning.log(**data, hold=hold), gap=5.0)
    assert assumed["parts"] == "gaps" and len(fit.estimation.logs) == 4
    assert outside(fit) == [] and diagnosis_of(fit)["clean"] and not fit.oddities
    whole, _ = identified(log)
    widths = [np.ptp(f.parameters["plant.drain[0]"]["interval95"]) for f in (fit, whole)]
    assert widths[0] < 1.3 * widths[1]


def test_gaps_at_which_a_log_is_not_cut():
    t, case = np.delete(2.0 * np.arange(100.0), [20, 50]), rig.loads(TANK)
    u = np.where((t > 39.0) & (t < 120.0), 5.0, 7.0)
    log = tuning.log(t=t, u=u, y=12.0 + 0.01 * u)
    assert [part.samples for part in without_gaps([log], case)] == [20, 78]  # none moves at 100 s
    slow = rig.loads(TANK.replace("high = 10.0,", "high = 10.0, lag = 3.0,"))
    assert [part.assumed for part in without_gaps([log], slow)] == [{"gaps": "at rows"}]
    whole = 2.0 * np.arange(100.0)
    inputs = np.where((whole > 42.0) & (whole < 120.0), 5.0, 7.0)[:, None]  # 5 from row 22 on
    some = dataclasses.replace(log, t=whole, u=inputs, y=np.full((100, 1), 12.0))
    unknown = np.zeros((100, 1), dtype=bool)
    unknown[[19, 20, 21, 80, 81]] = True
    parts = without_gaps([dataclasses.replace(some, unknown=unknown)], case)
    assert [(part.t[0], part.t[-1]) for part in parts] == [(0.0, 36.0), (44.0, 198.0)]
    on_change = tuning.log(t=t[::7] + 0.1 * np.arange(14) ** 2, u=u[::7], y=log.y[::7])
    for other in (on_change, dataclasses.replace(log, hold="first-order")):
        assert without_gaps([other], case) == [other]


def test_a_long_log_of_a_controller_is_taken_in_parts():
    u = np.arange(2100.0) % 7
    log = tuning.log(t=5.0 * np.arange(u.size), u=u, y=12.0 + 0.01 * u)
    case = rig.loads(TANK)
    parts = in_parts([log], case)
    assert [part.samples for part in parts] == [420] * 5
    assert parts[1].name == "log, rows 421 to 840" and parts[1].t[0] == log.t[420]
    assert all(part.assumed == {"parts": "own levels"} for part in parts)
    assert all(are_open(part, case) for part in parts)
    slow = rig.loads(TANK.replace("high = 10.0,", "high = 10.0, lag = 3.0,"))
    pulse = "inflow = [{ tank = 1, time = 5.0, volume = 20.0, duration = 2.0 }]\n"
    varying = rig.loads(TANK + pulse)
    short = dataclasses.replace(case, clock=dataclasses.replace(case.clock, dt=5.0))
    hold = dataclasses.replace(log, hold="zero-order")
    for whole, rig_of in ((log, slow), (log, varying), (log, short), (hold, case)):
        assert in_parts([whole], rig_of) == [whole]
    assert in_parts([log.part(0, 900)], case)[0].samples == 900


@pytest.mark.parametrize(("evidence", "inputs"), [((-9, 17, -9), "moments"), ((9, 9, -6), "")])
def test_the_parts_of_a_log_are_decided_together(monkeypatch, evidence, inputs):
    """Twice the difference of log likelihoods above 10 is for changes at the rows."""
    case, values = rig.loads(TANK), iter(evidence)
    log = record_of_loop(0, 0.5, 5.0, end=600.0)
    parts = [assuming(log.part(a, a + 40), "parts", "own levels") for a in (0, 40, 80)]
    choice = lambda misfit, other, part, settings: assumptions.Choice(
        other, Assumption("moments", False, 0.0 * part.u), next(values)
    )
    monkeypatch.setattr(assumptions, "_moments", choice)
    monkeypatch.setattr(assumptions, "_fit", lambda *_: (1.0, (None, None)))
    problem = tuning.Estimation(case, parts, FREE, noise=0.05, substeps=1)
    fit = solve(problem, problem.nominal(), iterations=1)
    best = assumptions.best_assumptions(problem, fit, parts, {}, moments=True, loss="linear")
    assert [a.inputs for a in best] == [inputs] * 3


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3])
def test_intervals_of_a_long_log_hold(seed):
    """Setpoints that change at one part of the rows' period had put errors above 2 % beside
    intervals of 0.6 %: of ramps and jumps each group has a mean moment. Of seed 1 chance prefers
    changes at the rows in one part.
    """
    log = record_of_loop(seed, 0.5, 5.0, end=30_000.0)
    fit, assumed = identified(log)
    assert assumed == {"parts": "own levels", "inputs": "moments"}
    assert [part.assumed for part in fit.estimation.logs] == [assumed] * 12
    assert outside(fit) == [] and fit.parameters["plant.drain[0]"]["sd"] < 0.008


def test_jumps_of_an_input_are_a_group():
    u = np.array([[1.0, 5.0], [1.1, 5.0], [1.2, 5.0], [3.2, 4.0], [3.3, 4.0], [3.4, 4.0]])
    log = tuning.log(t=np.arange(6.0), u=u, y=np.ones(6))
    assert changes(log).tolist() == [[1, 0], [2, 0], [3, 0], [3, 1], [4, 0], [5, 0]]
    assert groups_of(log).tolist() == [0, 0, 1, 2, 0, 0]


def test_inputs_between_the_rows_that_are_not_told_are_named():
    u = np.arange(2100.0) % 7
    log = tuning.log(t=5.0 * np.arange(u.size), u=u, y=12.0 + 0.01 * u)
    case = rig.loads(TANK)
    assert acts_between(log, case) and not are_open(log, case)
    sentence = Assumption("rows", False).applied(log, case).remarks[-1]
    assert "intervals do not allow for it" in sentence
    for options in ({"loss": "huber"}, {"likelihood": "innovations"}):
        assert identified(record_of_loop(0, 0.5, 5.0), **options)[1] == {"inputs": "rows"}


@pytest.mark.extended
def test_moments_are_those_of_the_changes():
    """A change at 40 k s has its row 0 to 7 s later."""
    log = record(5, 7.0, 40.0)
    fit, _ = identified(log)
    true = np.array([(log.t[k] % 40.0) / 7.0 for k, _ in changes(log)])
    sizes = np.array([abs(log.u[k, j] - log.u[k - 1, j]) for k, j in changes(log)])
    error = shares_of(fit.estimation.logs[0]) - true
    assert np.max(np.abs(error)[sizes > 1.0]) < 0.15


def test_changes_at_the_rows_are_left_there():
    fit, assumed = identified(record(1, 2.0, 40.0))
    assert assumed == {} and outside(fit) == []


@pytest.mark.extended
def test_noise_that_is_correlated_is_no_matter_of_moments():
    log = record(1, 2.0, 40.0)
    noise, rng = np.zeros(log.samples), np.random.default_rng(0)
    for k in range(1, log.samples):
        noise[k] = 0.9 * noise[k - 1] + 0.1 * rng.standard_normal()
    fit, assumed = identified(tuning.log(t=log.t, u=log.u, y=log.y[:, 0] + noise))
    assert assumed == {} and outside(fit) == []


def test_moments_of_rows_that_are_held_back_are_mean_ones():
    """Their readings would judge a fit to themselves."""
    log = record(3, 7.0, 40.0)
    shares = np.full(len(changes(log)), 0.1)
    problem = tuning.Estimation(rig.loads(TANK), [with_shares(log, shares)], FREE, noise=0.1)
    (judged,) = with_mean(problem, [60]).logs
    rows = np.array([k for k, _ in changes(log)])
    np.testing.assert_allclose(shares_of(judged), np.where(rows < 60, 0.1, 0.5))


def test_more_changes_than_are_estimated_are_told():
    u = np.arange(2100.0) % 7
    log = tuning.log(t=np.arange(u.size), u=u, y=u)
    assert too_many(log) and not too_many(tuning.log(t=log.t, u=u, y=u, hold="zero-order"))
    assert not too_many(log.part(0, 400))


@pytest.mark.extended
def test_another_exponent_is_no_matter_of_moments():
    """The cause explains as much: it is named, and rows are taken as they are."""
    log = record(2, 2.0, 40.0, exponent=0.62)
    fit, assumed = identified(log)
    assert assumed == {}
    assert diagnosis_of(fit)["causes"][0]["kind"] == "outlet-exponent"
    fit, assumed = identified(log, accept=["outlet-exponent:1"])
    assert assumed == {} and diagnosis_of(fit)["clean"]
    # a controller whose model is that of the rig has the exponent too: the rig can be written
    assert "drain_exponent = 0.6" in rig.dump(fit.identified)


def test_whitened_rows_and_moments_are_those_of_generalised_least_squares():
    rng = np.random.default_rng(0)
    slopes, noise = rng.standard_normal((12, 3)) * 4.0, np.array([0.5, 2.0])
    channels = np.arange(12) % 2
    shares = np.array([0.2, 0.5, 0.9])
    moments = Moments([OfLog(slopes, shares, channels, np.array([0, 0, 1]))])
    weighted = slopes / noise[channels, None]
    of_moments = SD**2 * np.array([[2.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 2.0]])
    covariance = np.eye(12) + weighted @ of_moments @ weighted.T
    root = moments.whitened(np.eye(12), noise)
    np.testing.assert_allclose(root @ covariance @ root.T, np.eye(12), atol=1e-12)
    assert moments.penalty(noise) == pytest.approx(np.linalg.slogdet(covariance)[1])
    small = 0.01 * rng.standard_normal(12)
    precision = np.linalg.inv(of_moments)
    ridge = np.linalg.solve(weighted.T @ weighted + precision, -weighted.T @ small)
    shares = moments.most_likely(moments.whitened(small, noise), noise)
    np.testing.assert_allclose(shares, 0.5 + ridge, atol=1e-12)


def test_a_log_with_moments_acts_between_its_rows():
    log = tuning.log(t=[0.0, 2.0, 4.0, 6.0], u=[1.0, 1.0, 3.0, 3.0], y=[1.0, 1.0, 1.0, 1.0])
    assert changes(log).tolist() == [[2, 0]]
    early = with_shares(log, np.array([0.25]))
    assert early.early[:, 0].tolist() == [0.0, 0.0, 0.5, 0.0]
    assert early.part(1, 4).early[:, 0].tolist() == [0.0, 0.5, 0.0]
    assert shares_of(early).tolist() == [0.25] and shares_of(log).tolist() == [0.0]
    assert "at moments within their steps" in early.remarks[-1]


@pytest.mark.slow
def test_the_command_says_so(tmp_path, capsys):
    log = record(0, 7.0, 40.0)
    rows = [f"{t:g},{u:g},{y:g}" for t, u, y in zip(log.t, log.u[:, 0], log.y[:, 0])]
    (tmp_path / "log.csv").write_text("t [s],pump1 [V],h1 [cm]\n" + "\n".join(rows) + "\n")
    (tmp_path / "rig.toml").write_text(TANK)
    files = [str(tmp_path / "rig.toml"), "--data", str(tmp_path / "log.csv")]
    assert main(["identify", *files, "--json", "--quiet"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert "at moments within their steps" in result["data"][0]["notes"][-1]
    assert result["diagnosis"]["clean"]


@pytest.mark.extended
def test_a_rig_that_is_right_predicts_a_log_polled_between_the_changes():
    right = TANK.replace("gain = 30.0", "gain = 25.0").replace("drain = 1.2", "drain = 1.0")
    prediction = tuning.predict(rig.loads(right), record(1, 7.0, 40.0))
    assert prediction.quality["white"][0] > 0.01 and prediction.quality["rmse"][0] < 0.13
    wrong = TANK.replace("gain = 30.0", "gain = 25.0")
    wrong = tuning.predict(rig.loads(wrong), record(1, 7.0, 40.0))
    assert wrong.quality["rmse"][0] > 0.4


@pytest.mark.slow
def test_draws_of_the_posterior_allow_for_the_moments():
    """Sd as of the normal approximation; 0.7 of it where the moments counted as known."""
    fit, assumed = identified(record(0, 7.0, 40.0))
    drawn = posterior.with_draws(fit, 0)
    assert assumed == {"inputs": "moments"}
    for name in TRUE:
        ratio = drawn.parameters[name]["sd"] / fit.parameters[name]["sd"]
        assert ratio == pytest.approx(1.0, abs=0.15)


TWO_LOOPS = """
units = ["cm", "V"]
dt = 2.0
duration = 800.0
tank = [{ area = 100.0, rim = 40.0, level = 20.0, drain = 0.3, noise = 0.05 },
    { area = 80.0, rim = 30.0, level = 15.0, drain = 0.5, noise = 0.05 }]
pipe = [{ between = [1, 2], area = 0.2 }]
pump = [{ to = 1, gain = 10.0, high = 24.0, initial = 8.0 },
    { to = 2, gain = 6.0, high = 20.0, initial = 9.0 }]
controller = { kind = "pi", Kc = [0.8, 0.8], Ti = [60.0, 60.0] }
reference = { initial = [20.0, 15.0], changes = [[100.0, 1, 30.0], [400.0, 2, 22.0]] }
"""


def test_a_loop_that_acts_at_the_rows_of_its_log_is_played_so():
    """What inputs have of the noise of the readings is nothing that moments explain."""
    case = rig.loads(TWO_LOOPS)
    truth = {"plant.pump_gain": [10.6, 5.7], "plant.drain": [0.29, 0.52], "plant.pipe": [0.21]}
    true = rig.set_values(case, truth)
    run = simulate(true.loop, true.clock, key=jax.random.key(1))
    log = tuning.log(t=run.t, u=run.u, y=run.y, tanks=[0, 1])
    fit = tuning.identify(case, log, starts=1, hold_back=0.0)
    assert fit.estimation.logs[0].assumed == {} and diagnosis_of(fit)["clean"]
    estimates = fit.parameters
    for name, values in truth.items():
        for i, value in enumerate(values):
            known = estimates[f"{name}[{i}]"]
            assert abs(known["value"] - value) < 3.5 * known["sd"]

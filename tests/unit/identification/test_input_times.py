"""Inputs that reach the tanks between samples: dead times, irregular logs. Logs are made by an
integrator of their own (numpy), in which every input acts at its own time.
"""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import PROCESS as RIG, rk4

import tuning
from jaxtank import rig, simulate
from jaxtank.core.tree import component, number
from jaxtank.plants.tank_network import TankNetwork
from tuning.cli.main import main
from tuning.identification import simulation
from tuning.identification.data_checks import with_even_times, with_hold
from tuning.identification.prediction import as_played, played

TRUTH = {"plant.pump_gain[0]": 2.64e-5, "plant.orifice[0]": 3.2e-4, "plant.drain[1]": 4.15e-4}
FREE = {
    "plant.pump_gain": (1e-5, 1e-4),
    "plant.orifice": (1e-4, 1e-3),
    "plant.drain[1]": (1e-4, 1e-3),
}
NOISE = 0.002  # m


def _rate(h, u):
    root = np.sqrt(2 * 9.81 * np.maximum(h, 0.0)) * [3.2e-4, 4.15e-4]
    return np.array([(2.64e-5 * u - root[0]) / 0.5, (root[0] - root[1]) / 0.25])


def _levels(t, input_at, h=(0.4, 0.5), dt=0.05):
    """(samples, 2) levels at the times t, multiples of dt, of a plant under input_at(time)."""
    h, result, sampled = np.array(h), [], set(np.round(t / dt).astype(int))
    for k in range(round(t[-1] / dt) + 1):
        if k in sampled:
            result.append(h)
        u = input_at((k + 0.5) * dt)
        h = rk4(lambda h, u=u: _rate(h, u), h, dt)
    return np.array(result)


def _commands(seed, every=60.0, end=3600.0):
    """(times, inputs) of steps every 5 s at least, `every` on average."""
    rng = np.random.default_rng(seed)
    t = np.concatenate([[0.0], 5.0 * np.cumsum(rng.integers(1, int(every / 2.5), 400))])
    t = t[t < end]
    return t, rng.uniform(20.0, 70.0, len(t))


def _held(times, inputs):
    return lambda t: inputs[np.maximum(np.searchsorted(times, t, side="right") - 1, 0)]


def _write(folder, t, u, y):
    rows = [
        f"{a:.10g},{b:.10g}," + ",".join("" if np.isnan(v) else f"{v:.10g}" for v in c)
        for a, b, c in zip(t, u, y)
    ]
    (folder / "log.csv").write_text("t [s],pump1 [%],h1 [m],h2 [m]\n" + "\n".join(rows) + "\n")
    (folder / "rig.toml").write_text(RIG)


def _identify(folder, capsys, *options):
    """(exit code, result, stderr) of the command."""
    free = [f"--free={name}={low}:{high}" for name, (low, high) in FREE.items()]
    files = [str(folder / "rig.toml"), "--data", str(folder / "log.csv")]
    code = main(["identify", *files, *free, "--starts", "1", "--json", *options])
    out, err = capsys.readouterr()
    return code, json.loads(out) if code == 0 else {}, err


def _outside(result):
    interval = {n: row["interval95"] for n, row in result["parameters"].items()}
    return [n for n, v in TRUTH.items() if not interval[n][0] <= v <= interval[n][1]]


@pytest.mark.slow
def test_a_dead_time_within_a_step_of_the_log_is_its_own(tmp_path, capsys):
    """Log every 5 s of a plant with 3 s of dead time: with 3 s residuals are the noise and the
    intervals hold the truth; 2 and 5 s are other models, not the same one.
    """
    times, inputs = _commands(0)
    t = np.arange(0.0, 3600.0, 5.0)
    played = _levels(t, lambda at: _held(times, inputs)(at - 3.0))
    noise = NOISE * np.random.default_rng(1).standard_normal(played.shape)
    _write(tmp_path, t, _held(times, inputs)(t), played + noise)
    rmse = {}
    for delay in (2, 3, 5):
        options = ["--set", f"actuator.delay={delay}", "--hold", "zero-order"]
        code, result, err = _identify(tmp_path, capsys, *options)
        assert code == 0, err
        rmse[delay] = result["fit"]["rmse"][0]
        if delay == 3:
            assert not _outside(result)
    assert rmse[3] == pytest.approx(np.std(noise[:, 0]), rel=0.02)
    assert rmse[2] > 1.03 * rmse[3] and rmse[5] > 1.15 * rmse[3]


def _irregular(seed=2):
    """(times of readings every 3 to 10 s, times of inputs, inputs, readings)."""
    rng = np.random.default_rng(seed)
    times, inputs = _commands(seed)
    t = np.round(np.concatenate([[0.0], np.cumsum(rng.uniform(3.0, 10.0, 700))]), 1)
    t = t[t < 3600.0]
    y = _levels(t, _held(times, inputs)) + NOISE * rng.standard_normal((len(t), 2))
    return t, times, inputs, y


@pytest.mark.slow
def test_inputs_of_an_irregular_log_change_between_its_rows(tmp_path, capsys):
    """At moments of their own; steps at the rows, which act late, fit worse than lines."""
    t, times, inputs, y = _irregular()
    _write(tmp_path, t, _held(times, inputs)(t), y)
    code, moments, err = _identify(tmp_path, capsys)
    assert code == 0 and "at moments within" in moments["data"][0]["notes"][-1], err
    assert not _outside(moments)
    code, line, err = _identify(tmp_path, capsys, "--hold", "first-order")
    assert code == 0 and line["fit"]["rmse"][0] > moments["fit"]["rmse"][0], err
    code, steps, err = _identify(tmp_path, capsys, "--hold", "zero-order")
    # 1.18: neither knows when between the rows an input changed
    assert code == 0 and steps["fit"]["rmse"][0] > 1.15 * line["fit"]["rmse"][0], err


@pytest.mark.slow
def test_inputs_that_a_controller_sets_with_the_readings_step_at_their_rows(tmp_path, capsys):
    """Irregular readings: steps fit better and are taken; lines would make a dead time."""
    t, *_ = _irregular()
    t = t[:300]
    u = np.repeat(np.random.default_rng(3).uniform(20.0, 70.0, 15), 20)
    y = _levels(t, _held(t, u)) + NOISE * np.random.default_rng(4).standard_normal((len(t), 2))
    _write(tmp_path, t, u, y)
    code, line, err = _identify(tmp_path, capsys, "--hold", "first-order")
    assert code == 0 and line["diagnosis"]["causes"][0]["kind"] in ("pump-delay", "pump-lag"), err
    assert "or inputs that step at each row (--hold zero-order)" in line["diagnosis"]["sentence"]
    code, steps, err = _identify(tmp_path, capsys, "--out", str(tmp_path / "out"))
    assert code == 0 and steps["diagnosis"]["clean"] and not _outside(steps), err
    assert "inputs step at each row (--hold zero-order)" in steps["data"][0]["notes"][-1]
    written = rig.load(tmp_path / "out" / "rig.toml")
    assert written.log["hold"] == "zero-order"
    data = tuning.read_log(tmp_path / "log.csv", written)
    lines = dataclasses.replace(data, hold="")
    errors = [tuning.predict(written, log).quality["rmse"] for log in (data, lines)]
    np.testing.assert_allclose(errors[1], errors[0], rtol=1e-6)


@pytest.mark.parametrize("steps", [False, True])
def test_an_irregular_log_is_played_as_its_readings_fit(steps):
    t, u = np.array([0.0, 3, 10, 14, 24, 28, 35]), np.array([30.0, 80, 35, 90, 50, 85, 50])
    along = _held(t, u) if steps else lambda at: np.interp(at, t, u)
    data = tuning.log(t=t, u=u, y=_levels(t, along))
    signal = played(rig.loads(RIG), data).loop.controller.signal
    assert signal.values[0, round(12.0 / signal.period)] == pytest.approx(35.0 if steps else 62.5)


@pytest.mark.extended
@pytest.mark.slow_for("7.3")
@pytest.mark.parametrize("delay", [0.0, 7.3])
def test_rows_of_inputs_between_readings_act_at_their_own_times(tmp_path, capsys, delay):
    """Irregular readings, and a row without readings where an input changes."""
    t, times, inputs, y = _irregular()
    if delay:
        rng = np.random.default_rng(5)
        played = _levels(t, lambda at: _held(times, inputs)(at - delay))
        y = played + NOISE * rng.standard_normal(y.shape)
    rows = np.union1d(t, times)
    table = np.full((len(rows), 2), np.nan)
    table[np.searchsorted(rows, t)] = y
    _write(tmp_path, rows, _held(times, inputs)(rows), table)
    options = ["--gap", "5", "--set", f"actuator.delay={delay:g}"]
    code, result, err = _identify(tmp_path, capsys, *options)
    assert code == 0 and not _outside(result), err


def test_a_record_cut_where_delayed_inputs_change():
    """By hand: samples every 2 s, 3 s of delay, and lines between samples."""
    data = {"t": [0.0, 2, 4, 6, 8], "u": [1.0, 1, 3, 3, 5], "y": np.zeros(5)}
    cut = simulation.padded([tuning.log(**data)], 3.0)
    assert cut.dt[0].tolist() == [[2, 0], [2, 0], [2, 0], [1, 1], [0, 0]]
    assert cut.u[0, :4, :, 0].tolist() == [[1, 0], [1, 0], [1, 0], [1, 3]]
    assert cut.steps[0].tolist() == [2, 2, 2, 2, 0]
    cut = simulation.padded([tuning.log(**data, hold="first-order")], 0.0)
    assert cut.dt[0].tolist() == [[2, 0], [1, 1], [2, 0], [1, 1], [0, 0]]
    assert cut.u[0, :4, :, 0].tolist() == [[1, 0], [1.5, 2.5], [3, 0], [3.5, 4.5]]


@pytest.mark.extended
def test_a_piece_of_length_zero_is_none_to_pumps_with_memory(tmp_path):
    """A lag: whole steps, and steps with a piece of length zero behind."""
    (tmp_path / "rig.toml").write_text(RIG)
    loop = rig.load(tmp_path / "rig.toml").loop
    lagged = dataclasses.replace(loop.actuator, lag=number([4.0]))
    played = simulation.rig_of(dataclasses.replace(loop, actuator=lagged))
    dt, u = np.full((1, 40), 2.0), np.random.default_rng(0).uniform(20, 80, (1, 40, 1))
    options = {"channels": ((0, False), (1, False)), "substeps": 2}
    whole = simulation.play(played, dt, u, np.array([[0.4, 0.5]]), **options)
    dt, u = np.stack([dt, 0 * dt], axis=-1), np.stack([u, u + 50], axis=2)
    cut = simulation.play(played, dt, u, np.array([[0.4, 0.5]]), **options)
    np.testing.assert_allclose(cut, whole, rtol=1e-13)


@pytest.mark.slow
def test_two_logs_in_sequence_give_what_both_together_give(tmp_path, capsys):
    """The rig of the first log, with its covariance, on the second: estimates and intervals."""
    times, inputs = _commands(0)
    t = np.arange(0.0, 1200.0, 5.0)
    levels = _levels(t, _held(times, inputs))
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        noise = NOISE * np.random.default_rng(len(name)).standard_normal(levels.shape)
        _write(tmp_path / name, t, _held(times, inputs)(t), levels + noise)
    options = ["--hold-back", "0"]
    code, _, err = _identify(tmp_path / "first", capsys, *options, "--out", str(tmp_path / "r"))
    assert code == 0, err
    second = str(tmp_path / "second" / "log.csv")
    code, joint, err = _identify(tmp_path / "first", capsys, *options, "--data", second)
    assert code == 0, err
    (tmp_path / "second" / "rig.toml").write_text((tmp_path / "r" / "rig.toml").read_text())
    code, later, err = _identify(tmp_path / "second", capsys, *options)
    assert code == 0, err
    _, alone, _ = _identify(tmp_path / "second", capsys, *options, "--no-prior")
    for name in TRUTH:
        both, sequence, one = (r["parameters"][name] for r in (joint, later, alone))
        assert sequence["sd"] == pytest.approx(both["sd"], rel=0.15), name
        assert abs(sequence["value"] - both["value"]) < 0.3 * both["sd"], name
        assert one["sd"] > 1.2 * both["sd"], name
    assert sorted(later["prior"]["names"]) == sorted(TRUTH) and alone["prior"] is None


@pytest.mark.slow
def test_inputs_along_a_line_from_row_to_row(tmp_path, capsys):
    """Irregular rows, inputs that move steadily in between: a line fits, steps do not."""
    rng = np.random.default_rng(6)
    t = np.round(np.concatenate([[0.0], np.cumsum(rng.uniform(10.0, 30.0, 200))]), 1)
    t = t[t < 3600.0]
    u = rng.uniform(20.0, 70.0, len(t))
    y = _levels(t, lambda at: np.interp(at, t, u)) + NOISE * rng.standard_normal((len(t), 2))
    _write(tmp_path, t, u, y)
    code, line, err = _identify(tmp_path, capsys, "--gap", "2", "--hold", "first-order")
    assert code == 0 and not _outside(line), err
    code, steps, err = _identify(tmp_path, capsys, "--gap", "2", "--hold", "zero-order")
    assert code == 0 and steps["fit"]["rmse"][0] > 3 * line["fit"]["rmse"][0]
    assert main(["identify", str(tmp_path / "rig.toml"), "--data", "log.csv", "--hold", "foh"]) == 2


RATE = RIG.replace("high = 100.0", "high = 100.0, rate = 0.5")


@pytest.fixture(scope="module")
def slow_valve():
    """(commands, inputs that a pump of 0.5 %/s has, levels) every 5 s, by an own integrator."""
    t = np.arange(0.0, 2000.0, 5.0)
    command = np.where(t % 400.0 < 200.0, 30.0, 60.0)
    applied = [command[0]]
    for u in command[1:]:
        applied.append(applied[-1] + np.clip(u - applied[-1], -2.5, 2.5))
    applied = np.array(applied)
    return t, command, applied, _levels(t, _held(t, applied), dt=0.5)


@pytest.mark.extended_for("command")
@pytest.mark.parametrize("column", ["command", "applied"])
def test_a_pump_with_a_rate_is_identified_from_commands_and_from_what_it_reached(
    slow_valve, column
):
    t, command, applied, y = slow_valve
    u = {"command": command, "applied": applied}[column]
    case = rig.loads(RATE)
    case = case.replace(clock=dataclasses.replace(case.clock, dt=5.0))
    data = tuning.log(t=t, u=u, y=y)
    problem = tuning.Estimation(case, [data], FREE, noise=NOISE, substeps=4)
    np.testing.assert_allclose(problem.data.u[0, :-1, 0], applied[:-1], atol=1e-9)
    values = problem.coordinates.point({**TRUTH})
    z = np.concatenate([values, y[0] / problem.level_scale])
    np.testing.assert_allclose(problem.predicted(z)[0], y, atol=1e-6)
    z[:3] += 0.05
    _, jacobian = problem.residual_and_jacobian(z)
    for j, step in enumerate(1e-5 * np.eye(z.size)):
        high, low = (problem.residual_and_jacobian(z + sign * step)[0] for sign in (1, -1))
        scale = np.abs(jacobian[:, j]).max()
        np.testing.assert_allclose(jacobian[:, j], (high - low) / 2e-5, atol=1e-6 * scale)


def test_commands_too_fast_for_the_pump_move_it_from_their_row_on():
    """A step of 80 % at 100 s, 1 %/s: 80 s later it is there, though rows are 50 s apart."""
    case = rig.loads(RATE.replace("rate = 0.5", "rate = 1.0"))
    t = np.array([0.0, 50.0, 100.0, 150.0, 200.0])
    log = tuning.log(t=t, u=[20.0, 20.0, 100.0, 100.0, 100.0], y=np.full((5, 2), 0.5))
    courses = simulation.courses_of([log], case.loop.actuator, 0.25)
    data = simulation.padded([log], courses=courses)
    np.testing.assert_allclose(data.dt.sum(axis=-1)[0], [50, 50, 50, 50, 0])
    means = (data.dt * data.u[..., 0]).sum(axis=-1)[0, :4] / 50.0
    np.testing.assert_allclose(means, [20.0, 20.0, 45.0, 91.0], atol=0.25)


@pytest.mark.extended
def test_a_planned_experiment_moves_a_pump_no_faster_than_its_rate():
    """Steps from sample to sample through a pump that needs twenty of them say less."""
    t = np.arange(0.0, 400.0, 5.0)
    inputs = {"steps": (t, np.where(t % 20.0 < 10.0, 30.0, 60.0)[:, None], np.array([0.4, 0.5]))}
    sd = [
        tuning.compare_experiments(
            rig.loads(text), {"plant.drain[1]": (1e-4, 1e-3)}, noise=0.002, duration=400, dt=5,
            inputs=inputs, start="known",
        )["steps"]["sd"]["plant.drain[1]"]
        for text in (RIG, RATE.replace("rate = 0.5", "rate = 0.02"))
    ]  # fmt: skip
    assert sd[1] > 1.01 * sd[0]


def test_days_with_few_decimals_are_taken_at_the_even_times_that_they_round():
    """45376.0001 is of a raster of 8.64 s; samples every 10 s."""
    t = np.arange(60) * 10.0
    days = np.round(45376.0 + t / 86400.0, 4)
    u, y = np.where(np.arange(60) % 7 < 3, 4.0, 2.0)[:, None], np.linspace(10.0, 20.0, 60)[:, None]
    rounded = tuning.log(t=(days - days[0]) * 86400.0, u=u, y=y)
    read = with_even_times(rounded)
    np.testing.assert_allclose(read.t, t, atol=1e-6)
    assert "8.64 s" in read.notes[-1]
    few = tuning.log(t=[0.0, 864.0, 2592.0], u=u[:3], y=y[:3])  # 0, 0.01 and 0.03 days, by hand
    assert with_even_times(few) is few
    uneven = tuning.log(t=np.cumsum(np.where(np.arange(60) % 5, 8.64, 25.92)), u=u, y=y)
    read = with_even_times(uneven)
    np.testing.assert_array_equal(read.t, uneven.t)


@pytest.mark.parametrize("long", [False, True])
@pytest.mark.parametrize("every", [1, 10])
def test_inputs_that_are_logged_on_change_step_at_their_rows(tmp_path, long, every):
    """Irregular samples; inputs in every row follow a line, in the rows of changes they step."""
    rng = np.random.default_rng(7)
    t = np.cumsum(rng.integers(3, 10, 100))
    u = np.repeat(rng.uniform(20, 70, 10), 10)
    inputs = [f"{u[k]:.3f}" if k % every == 0 else "" for k in range(100)]
    lines = [f"{a},{b},0.4,0.5" for a, b in zip(t, inputs)]
    if long:
        tags = (("pump1", inputs), ("h1", ["0.4"] * 100), ("h2", ["0.5"] * 100))
        lines = [f"{t[k]},{tag},{v[k]}" for k in range(100) for tag, v in tags if v[k]]
    header = "t [s],tag,value" if long else "t [s],pump1 [%],h1 [m],h2 [m]"
    (tmp_path / "log.csv").write_text("\n".join([header, *lines]) + "\n")
    data = tuning.read_log(tmp_path / "log.csv", rig.loads(RIG).loop)
    np.testing.assert_allclose(data.u[:, 0], u, atol=1e-3)
    assert with_hold(data).hold == ("first-order" if every == 1 else "zero-order")


@pytest.mark.parametrize(("kind", "noted"), [("ramps", True), ("steps", False), ("noise", False)])
def test_even_samples_of_inputs_along_lines_are_noted(kind, noted):
    t, rng = 2.0 * np.arange(200), np.random.default_rng(3)
    u = {
        "ramps": 40.0 + 10.0 * np.abs((t / 40.0) % 2.0 - 1.0),
        "steps": np.repeat(rng.uniform(20, 70, 20), 10),
        "noise": rng.uniform(20, 70, 200),
    }[kind]
    log = with_hold(tuning.log(t=t, u=u[:, None], y=(0.4 + 0 * t)[:, None]))
    assert any("--hold first-order" in note for note in log.notes) is noted and log.hold == ""


SURGE = """
units = ["m", "m^3/h"]
tank = [{ name = "drum", area = 4.5, rim = 4.0, level = 2.0, inflow = "40 m3/h" }]
pump = [{ name = "out", from = "drum", high = 100.0, gain = 1.1 }]
plant = { outputs = ["drum"] }
controller = { kind = "open-loop" }
inputs = { initial = [40.0] }
reference = { initial = [2.0] }
inflow = [{ tank = "drum", changes = [[700.0, "15 m3/h"], [1500.0, "-10 m3/h"]] }]
values = { "clock.dt" = 5.0, "clock.duration" = 100.0 }
"""


def _surge_log(feeds, rows=200):
    """A log of irregular rows with the inflow of SURGE, or a steady one, by volume balance."""
    rng = np.random.default_rng(3 + feeds)
    t = np.cumsum(np.append(0.0, rng.uniform(10.0, 20.0, rows)))
    u = np.repeat(rng.uniform(35.0, 45.0, rows // 10 + 1), 10)[: len(t)]
    fine = np.arange(0.0, t[-1] + 1.0, 0.05)
    feed = np.where(fine < 700.0, 40.0, np.where(fine < 1500.0, 55.0, 30.0)) if feeds else 40.0
    rate = 0.05 * (feed - _held(t, u)(fine)) / 3600.0 / 4.5
    level = np.interp(t, fine, 2.0 + np.append(0.0, np.cumsum(rate)[:-1]))
    return tuning.log(t=t, u=u, y=level + 0.003 * rng.standard_normal(len(t)))


@pytest.mark.extended
def test_an_inflow_that_varies_acts_in_the_logs_that_it_fits():
    """Inputs step at irregular rows, which is not stated; the inflow is in the first log alone."""
    case, free = rig.loads(SURGE), {"plant.pump_gain": (1e-4, 1e-3)}
    logs = [_surge_log(True), _surge_log(False)]
    expected = [{"inputs": "steps", "inflow": words} for words in ("acts", "left out")]
    for data, assumed in ((logs, expected), (logs[:1], expected[:1]), (logs[1:], expected[1:])):
        result = tuning.identify(case, data, free, starts=1)
        assert [log.assumed for log in result.estimation.logs] == assumed
        gain = result.parameters["plant.pump_gain[0]"]["value"]
        assert 3600.0 * gain == pytest.approx(1.0, rel=2e-3)
        assert result.structure.clean
        prediction = tuning.predict(result.identified, data)
        assert [log.assumed for log in prediction.estimation.logs] == assumed


@component
class Dry(TankNetwork):
    """A network of no value for an empty tank."""

    def derivative(self, t, x, u, d):
        rates = super().derivative(t, x, u, d)
        return tuple(jnp.where(h < 0.0, jnp.nan, rate) for h, rate in zip(x, rates))


def test_an_inflow_acts_where_the_tank_runs_empty_without_it():
    text = SURGE.replace(', inflow = "40 m3/h"', "").replace('700.0, "15', '0.0, "40')
    case = rig.loads(text.replace(', [1500.0, "-10 m3/h"]', ""))
    values = {f.name: getattr(case.loop.plant, f.name) for f in dataclasses.fields(TankNetwork)}
    plant = Dry(**values | {"bottom": False})
    case = case.replace(loop=dataclasses.replace(case.loop, plant=plant))
    result = tuning.identify(case, _surge_log(False), {"plant.pump_gain": (1e-4, 1e-3)}, starts=1)
    assert [log.assumed["inflow"] for log in result.estimation.logs] == ["acts"]
    gain = result.parameters["plant.pump_gain[0]"]["value"]
    assert 3600.0 * gain == pytest.approx(1.0, rel=2e-3)


def test_the_inflow_of_irregular_rows_is_added_up_on_a_bounded_grid(monkeypatch):
    """200 rows over a day, two of them 0.01 s apart; the volume of the table, by hand."""
    clocks, make = [], simulation.Clock
    recorded = lambda **values: clocks.append(make(**values)) or clocks[-1]
    monkeypatch.setattr(simulation, "Clock", recorded)
    t = np.sort(np.append(np.linspace(0.0, 86400.0, 199) ** 1.01, 5000.0))
    t = np.sort(np.append(t, t[50] + 0.01))
    data = tuning.log(t=t, u=np.full(len(t), 40.0), y=np.full(len(t), 2.0))
    flows = simulation.flows_of([data], 0, rig.loads(SURGE))[0, :-1, 0]
    volume = np.sum(flows * np.diff(t)) * 3600.0
    assert volume == pytest.approx(15.0 * 800.0 - 10.0 * (t[-1] - 1500.0), rel=1e-3)
    assert max(clock.samples for clock in clocks) <= 1.1 * simulation.MOST_CELLS


@pytest.mark.parametrize("zone", ["", "Z"])
@pytest.mark.parametrize("newest_first", [False, True])
def test_an_inflow_and_a_log_with_dates_are_aligned(tmp_path, zone, newest_first):
    """The inflow is stamped from 6:00 on, the log ten minutes later; its volume by hand."""
    inflow = [("06:00:00", 0), ("06:11:40", 15), ("06:25:00", -10)]
    rows = [f"2026-05-01 {clock}{zone},{flow}" for clock, flow in inflow]
    (tmp_path / "inflow.csv").write_text("time,feed [m3/h]\n" + "\n".join(rows))
    table = 'inflow = [{ tank = "drum", csv = "inflow.csv", column = "feed" }]'
    text = "\n".join(table if line.startswith("inflow") else line for line in SURGE.split("\n"))
    case = rig.loads(text, folder=tmp_path)
    data = _surge_log(True)
    data = data.part(int(np.searchsorted(data.t, 600.0)), None)
    start = np.datetime64("2026-05-01T06:00:00.000")
    stamps = start + np.round(1000 * data.t).astype("timedelta64[ms]")
    rows = [f"{at}{zone},{u},{y}" for at, u, y in zip(stamps, data.u[:, 0], data.y[:, 0])]
    (tmp_path / "log.csv").write_text(
        "time,out,drum [m]\n" + "\n".join(rows[::-1] if newest_first else rows)
    )
    log = tuning.read_log(tmp_path / "log.csv", case)
    again = rig.loads(rig.dump(case))
    assert again.begins == case.begins == f"2026-05-01 06:00:00{zone}"
    for known in (case, again):
        flows = 3600.0 * simulation.flows_of([log], 0, known)[0, :-1, 0]
        volume = np.sum(flows * np.diff(log.t)) / 3600.0
        expected = (15.0 * 800.0 - 10.0 * (data.t[-1] - 1500.0)) / 3600.0
        assert volume == pytest.approx(expected, rel=1e-4)
        run = played(rig.set_values(known, {"plant.pump_gain": 1.0 / 3600.0}), log)
        run = simulate(run.loop, run.clock)
        assert float(run.x[-1, 0]) == pytest.approx(data.y[-1, 0], abs=0.02)
    result = tuning.identify(case, log, {"plant.pump_gain": (1e-4, 1e-3)}, starts=1)
    assert [log.assumed["inflow"] for log in result.estimation.logs] == ["acts by date"]
    gain = result.parameters["plant.pump_gain[0]"]["value"]
    assert 3600.0 * gain == pytest.approx(1.0, rel=2e-3)


def test_a_played_inflow_is_not_said_to_fit_better():
    """`simulate --data` applies the inflow of the rig without a comparison."""
    log = as_played(rig.loads(SURGE), _surge_log(False))
    assert "inflow" not in log.assumed and "inputs" in log.assumed


TWO = """
units = ["cm", "V"]
dt = 1.0
duration = 300.0
tank = [{ name = "A", area = 60.0, rim = 40.0, drain = 0.4, level = 9.0 },
        { name = "B", area = 50.0, rim = 40.0, drain = 0.4, level = 9.0 }]
pump = [{ PUMP, to = "A", gain = 9.0, high = 5.5, initial = 4.0, lag = 5.0 },
        { OTHER, to = "B", gain = 9.0, high = 5.5, initial = 4.0, delay = 7.0 }]
controller = { kind = "open-loop", initial = [4.0, 4.0], changes = [[100, 1, 6.0], [200, 2, 3.0]] }
"""


@pytest.mark.parametrize("names", [("P", "Q"), ("", "")])
def test_a_run_is_predicted_from_what_its_pumps_were_given(names, tmp_path, capsys):
    """Its columns hold inputs before and behind lag and dead time, of commands beyond a limit."""
    first, other = (f'name = "{name}"' if name else "rate = 50.0" for name in names)
    path, out = tmp_path / "rig.toml", tmp_path / "out"
    path.write_text(TWO.replace("PUMP", first).replace("OTHER", other))
    main(["simulate", str(path), "--out", str(out), "--quiet"])
    capsys.readouterr()
    main(["predict", str(path), "--data", str(out / "trajectory.csv"), "--json", "--quiet"])
    rmse = json.loads(capsys.readouterr().out)["fit"]["rmse"]
    np.testing.assert_allclose(rmse, 0.0, atol=1e-6)

"""A batch, its log, and the next rig."""

import jax
import numpy as np
import pytest
from calibration import ONE
from helpers import ONE_TANK, command

import jaxtank
import tuning
from jaxtank import rig
from tuning.identification.prediction import achieved
from tuning.report.prediction import achieved_table, setpoints_used

RIG = f"""{ONE}
[limits]
max_level = 13.0
[free]
"controller.Kc" = [0.1, 10.0]
[objective]
rms_error_total = 1.0
[uncertain]
"plant.drain" = 0.1
"""


@pytest.fixture
def case(tmp_path):
    (tmp_path / "rig.toml").write_text(RIG.replace(', "sensor.noise" = [0.05]', ""))
    return rig.load(tmp_path / "rig.toml")


def test_levels_achieved_stand_beside_those_that_the_rig_predicted(case):
    """The log of a loop whose levels are all 1 cm higher; its error is that of the setpoints."""
    run = jaxtank.simulate(case.loop, case.clock)
    t, u, h, r = (np.asarray(v) for v in (run.t, run.u, run.x, run.r))
    log = tuning.log(t=t[:100] + 7.0, u=u[:100], y=h[:100] + 1.0)
    (row,) = achieved(case, log)
    h, r = h[:100, 0], r[:100, 0]
    assert row["limit"] == 13.0 and row["unit"] == "cm"
    expected = {"predicted": h, "achieved": h + 1.0}
    for side, level in expected.items():
        assert row["highest"][side] == pytest.approx(level.max())
        assert row["lowest"][side] == pytest.approx(level.min())
        assert row["error"][side] == pytest.approx(np.sqrt(np.mean((level - r) ** 2)))
    long = row | {"name": "level transmitter LT-101 of the buffer tank", "unit": "cm"}
    assert max(map(len, achieved_table([row, long]).lines())) <= 80


def test_a_batch_that_is_longer_than_the_rigs_run_is_compared_to_its_end(case):
    """It goes on at its last level, and in its last row passes all before."""
    run = jaxtank.simulate(case.loop, case.clock)
    t, u, h = (np.asarray(v) for v in (run.t, run.u, run.x))
    more = np.arange(1, 51)[:, None] * case.clock.dt
    y = np.concatenate([h, np.full((50, 1), h[-1, 0])])
    y[-1] = 20.0
    later = np.concatenate([t, t[-1] + more[:, 0]])
    (row,) = achieved(case, tuning.log(t=later, u=np.concatenate([u, u[-50:]]), y=y))
    assert row["highest"]["achieved"] == 20.0 > row["limit"]
    assert row["error"]["achieved"] > row["error"]["predicted"] > 0.0


def test_what_a_noisy_rig_predicts_is_its_level_without_noise(case):
    run = jaxtank.simulate(case.loop, case.clock)
    log = tuning.log(t=run.t[:100], u=run.u[:100], y=run.x[:100])
    (row,) = achieved(rig.set_values(case, {"sensor.noise": 0.05}), log)
    assert row["highest"]["predicted"] == pytest.approx(float(run.x[:100].max()))


@pytest.mark.slow
def test_a_batch_is_learned_and_its_covariance_is_the_next_prior(case, tmp_path):
    values = {"plant.pump_gain": [2.85], "plant.drain": [0.053], "sensor.noise": 0.03}
    other = rig.set_values(case, values)
    for k in (1, 2):
        run = jaxtank.simulate(other.loop, other.clock, jax.random.key(k))
        rows = np.column_stack([run.t, run.u[:, 0], run.y[:, 0]])
        heads = "t [s],pump1 [V],h1 [cm]"
        np.savetxt(tmp_path / f"{k}.csv", rows, "%.6f", ",", header=heads, comments="")
    widths = []
    for k, file in ((1, "rig.toml"), (2, "next1/rig.toml")):
        words = [str(tmp_path / file), "--data", str(tmp_path / f"{k}.csv"), "--json", "--quiet"]
        done = command("learn", *words, "--out", str(tmp_path / f"next{k}"))
        assert done.code == 0
        gain = done.json["identification"]["parameters"]["plant.pump_gain[0]"]
        low, high = gain["interval95"]
        assert low < 2.85 < high
        widths.append(high - low)
        assert done.json["tuning"]["holds"]["limits_on_validation"] == 1.0
    assert widths[1] < 0.85 * widths[0]
    learned = rig.load(tmp_path / "next2" / "rig.toml")
    assert learned.covariance is not None and learned.loop.safety_filter is not None


def of_gain(case, gain, seed):
    """A log of one tank by Torricelli's law with a gain of its pump, and noise."""
    dt, u, y = case.clock.dt, np.repeat([1.0, 0.4, 0.8, 0.5], 50), [1.0]
    for v in np.repeat(u, 20)[: 20 * (len(u) - 1)]:
        y.append(y[-1] + dt / 20 * (gain * v - 2.0 * np.sqrt(2.0 * 0.5 * y[-1])) / 20.0)
    y = np.array(y[::20]) + 0.003 * np.random.default_rng(seed).standard_normal(len(u))
    return tuning.log(t=dt * np.arange(len(u)), u=u[:, None], y=y[:, None])


def test_a_value_at_the_end_of_its_range_asks_for_a_wider_one():
    case = rig.loads(ONE_TANK)
    free = {"plant.pump_gain[0]": (3.0, 4.5), "plant.drain[0]": (1.0, 4.0)}
    fit = tuning.identify(case, of_gain(case, 5.0, 0), free, starts=1)
    assert "Stays open: plant.pump_gain[0], at an end of its range" in " ".join(
        fit.to_json()["advice"]
    )


@pytest.mark.extended_for("5.0-False")
@pytest.mark.parametrize(("second", "contradicts"), [(5.0, False), (5.4, True)])
def test_data_that_contradict_the_prior_are_said_to(second, contradicts):
    case, fits = rig.loads(ONE_TANK), []
    free = {"plant.pump_gain[0]": (3.0, 8.0), "plant.drain[0]": (1.0, 4.0)}
    for k, gain in enumerate((5.0, second)):
        fits.append(tuning.identify(case, of_gain(case, gain, k), free, starts=1))
        case = fits[-1].identified
    later = fits[1]
    assert (later.prior["probability"] < 1e-6) is contradicts
    assert later.to_json()["verdict"]["good"] is not contradicts
    assert ("contradict" in str(later)) is contradicts
    if not contradicts:
        assert later.prior["probability"] > 1e-3


SETPOINTS = ["h1.SP", "SP1", "setpoint", "r1", "LIC1.SP", "Level 1 set point"]


@pytest.mark.parametrize("header", SETPOINTS)
def test_the_error_of_a_batch_is_to_its_own_setpoints(case, tmp_path, header):
    """A batch that kept setpoints of its own without an error; the rig's are others."""
    run = jaxtank.simulate(case.loop, case.clock)
    t, u, h, r = (np.asarray(v)[:100] for v in (run.t, run.u, run.x, run.r))
    own = h[:, 0] - 0.25
    rows = np.column_stack([t, u[:, 0], h[:, 0], own])
    rows[:, 3] *= 10.0
    heads = f"t [s],pump1 [V],h1 [cm],{header} [mm]"
    np.savetxt(tmp_path / "log.csv", rows, "%.9g", ",", header=heads, comments="")
    log = tuning.read_log(tmp_path / "log.csv", case.loop)
    (row,) = achieved(case, log)
    assert row["setpoints"] == f"{header} [mm]" and not log.notes
    assert row["error"]["achieved"] == pytest.approx(0.25)
    assert row["error"]["predicted"] == pytest.approx(np.sqrt(np.mean((h - r) ** 2)))
    assert row["setpoints"] in setpoints_used([row])
    np.testing.assert_allclose(log.part(10, 20).setpoints[0][1], own[10:20])


def test_a_setpoint_that_is_written_on_change_is_held(case, tmp_path):
    """Of a row each 1 s of t; one that is never written is none."""
    rows = [(k, 2, 10 + k, 12.5 if k == 4 else "", "") for k in range(8)]
    text = "\n".join(",".join(map(str, row)) for row in rows)
    (tmp_path / "log.csv").write_text(f"t [s],pump1 [V],h1 [cm],h1.SP [cm],SP7 [cm]\n{text}\n")
    log = tuning.read_log(tmp_path / "log.csv", case.loop)
    _, held = log.setpoints[0]
    np.testing.assert_array_equal(held, [np.nan] * 4 + [12.5] * 4)
    (tmp_path / "log.csv").write_text((tmp_path / "log.csv").read_text().replace("12.5", ""))
    assert not tuning.read_log(tmp_path / "log.csv", case.loop).setpoints


def test_columns_that_are_no_setpoint_of_a_level_leave_those_of_the_rig(case, tmp_path):
    """A setpoint of a flow, of a unit that no level has, and of another loop."""
    run = jaxtank.simulate(case.loop, case.clock)
    rows = np.column_stack(
        [*(np.asarray(v)[:50] for v in (run.t, run.u, run.x)), *3 * [run.t[:50]]]
    )
    heads = "t [s],pump1 [V],h1 [cm],FIC1.SP,LIC1.SP [degC],LIC7.SP"
    np.savetxt(tmp_path / "log.csv", rows, "%.9g", ",", header=heads, comments="")
    log = tuning.read_log(tmp_path / "log.csv", case.loop)
    (row,) = achieved(case, log)
    assert row["setpoints"] is None and "of the rig" in setpoints_used([row])
    assert not log.setpoints and all(head in log.notes[0] for head in heads.split(",")[3:])

"""What is odd in experiment data: faults put into logs that an integrator of the test makes."""

import functools
import json
import types

import numpy as np
import pytest
from helpers import PROCESS as RIG

import tuning
from jaxtank import rig
from jaxtank.core.errors import DataError
from tuning.cli.main import main
from tuning.identification import coordinates, problem, residuals
from tuning.identification.sanity import oddities

NOISE = 0.002  # m


@functools.cache
def _played(seed, samples=600, dt=5.0):
    """(inputs, levels) of the rig under steps of its pump, by Euler steps of 0.5 s."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(15.0, 75.0, samples // 20), 20)
    return u, _levels(u, [0.4, 0.5], dt)


def _levels(u, h, dt):
    h, y = np.array(h), np.empty((len(u), 2))
    for k in range(len(u)):
        y[k] = h
        for _ in range(round(dt / 0.5)):
            out = np.sqrt(2 * 9.81 * np.maximum(h, 0.0)) * [3.2e-4, 4.15e-4]
            h = h + 0.5 * np.array([2.64e-5 * u[k] - out[0], out[0] - out[1]]) / [0.5, 0.25]
    return y


def record(seed, noise=NOISE):
    """(t, u, y) of a run with noise."""
    u, y = _played(seed)
    return 5.0 * np.arange(len(u)), u, y + noise * np.random.default_rng(seed).normal(size=y.shape)


def kinds(t, u, y, loop=None):
    return {(odd.kind, odd.where) for odd in oddities(tuning.log(t=t, u=u, y=y), loop)}


@pytest.mark.parametrize("resolution", [0.0, 0.0005, 0.005])
@pytest.mark.parametrize("noise", [0.0, 2e-4, NOISE, 0.02])
def test_a_clean_log_is_not_accused(noise, resolution):
    """Without noise too, and of sensors that round."""
    for seed in range(10):
        t, u, y = record(seed, noise)
        rounded = np.round(y / resolution) * resolution if resolution else y
        assert not kinds(t, u, rounded)


@pytest.mark.parametrize("share", [0.003, 0.02, 0.1, 0.5])
def test_a_sensor_that_flickers_by_one_step_is_not_accused(share):
    """Also where its unit was converted, and equal readings differ by rounding."""
    for seed in range(10):
        t, u, _ = record(seed)
        rng = np.random.default_rng(seed)
        y = 0.4 + 0.005 * (rng.random((len(t), 2)) < share)
        assert not kinds(t, 0.0 * u + u[0], y) - {("still", "pump1")}
        y *= 1.0 + 1e-15 * rng.integers(-1, 2, y.shape)
        assert not kinds(t, 0.0 * u + u[0], y) - {("still", "pump1")}


def frozen(y):
    y[200:245, 1] = y[200, 1]


def saturated(y):
    y[:, 1] = np.minimum(y[:, 1], np.quantile(y[:, 1], 0.9))


def spiked(y):
    y[[50, 300, 431], 0] += [0.3, -0.2, 0.25]


def dropped(y):
    """A transmitter that reads 0 for three samples, between two steps of the pump."""
    y[205:208, 0] = 0.0


def held(y):
    """Compression by exception: written when it has changed by 0.02 m, and repeated until then."""
    for k in range(1, len(y)):
        y[k, 0] = y[k, 0] if abs(y[k, 0] - y[k - 1, 0]) > 0.02 else y[k - 1, 0]


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (frozen, ("frozen", "h2")),
        (saturated, ("saturated", "h2")),
        (spiked, ("spike", "h1")),
        (dropped, ("spike", "h1")),
        (held, ("held", "h1")),
    ],
)
def test_a_fault_of_a_sensor_is_named_with_its_place(fault, expected):
    for seed in range(10):
        t, u, y = record(seed)
        fault(y)
        assert kinds(t, u, y) == {expected}, seed


def test_the_readings_of_a_fault_are_counted():
    t, u, y = record(0)
    spiked(y)
    (spikes,) = oddities(tuning.log(t=t, u=u, y=y))
    assert (spikes.count, spikes.first, spikes.value) == (3, t[50], y[50, 0])
    t, u, y = record(0)
    frozen(y)
    (stuck,) = oddities(tuning.log(t=t, u=u, y=y))
    assert (stuck.count, stuck.first) == (45, t[200])


def test_inputs_that_never_move_are_named():
    t, u, y = record(0)
    assert kinds(t, 0 * u, y) == {("off", "pump1")}
    assert kinds(t, 0 * u + 40, y) == {("still", "pump1")}


def _files(folder, t, u, y, header="t [s],pump1 [%],h1 [m],h2 [m]"):
    (folder / "rig.toml").write_text(RIG)
    rows = "\n".join(",".join(f"{v:.8g}" for v in row) for row in np.column_stack([t, u, y]))
    (folder / "log.csv").write_text(f"{header}\n{rows}\n")
    return [str(folder / "rig.toml"), "--data", str(folder / "log.csv"), "--starts", "1"]


@pytest.mark.slow
def test_the_gain_of_a_pump_that_is_off_is_not_estimated(tmp_path, capsys):
    """A drain test: drain and orifice follow, and the rig keeps its gain."""
    y = _levels(np.zeros(200), [0.9, 0.6], 1.0)
    y += NOISE * np.random.default_rng(1).standard_normal(y.shape)
    files = _files(tmp_path, np.arange(200.0), np.zeros(200), y)
    code = main(["identify", *files, "--json"])
    result = json.loads(capsys.readouterr().out)
    assert code == 0 and set(result["parameters"]) == {"plant.orifice[0]", "plant.drain[1]"}
    low, high = result["parameters"]["plant.drain[1]"]["interval95"]
    assert low <= 4.15e-4 <= high
    assert [(o["kind"], o["where"]) for o in result["oddities"]] == [("off", "pump1")]
    assert rig.load(tmp_path / "rig.toml").loop.plant.pump_gain[0] == 2.64e-5


def test_an_inspected_log_is_read_with_the_table_that_is_printed(tmp_path, capsys):
    """Names of nobody's rig: refused at first, read with the [log] table pasted."""
    t, u, y = record(0)
    spiked(y)
    y[7, 1] = np.nan
    header = "when [s],flow valve 1 [%],basin 1 [m],basin 2 [m]"
    files = _files(tmp_path, t, u, y, header)
    words = ["identify", "--inspect", files[2], files[0], "--json"]
    assert main(words) == 5
    refused = json.loads(capsys.readouterr().out)
    assert refused["problems"] and [c["slot"] for c in refused["columns"]] == [None] * 3
    (tmp_path / "rig.toml").write_text(RIG + refused["log"] + "\n")
    assert main([*words, "--out", str(tmp_path / "out")]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [c["slot"] for c in result["columns"]] == ["pump1", "h1", "h2"]
    assert [c["missing"] for c in result["columns"]] == [0, 0, 1]
    assert result["columns"][1]["high"] == pytest.approx(y[:, 0].max(), rel=1e-6)
    assert result["time"] == {
        "header": "when [s]", "samples": 600, "length": 2995.0, "step": 5.0, "longest_step": 5.0,
    }  # fmt: skip
    assert [(o["kind"], o["where"]) for o in result["oddities"]] == [("spike", "h1")]
    assert (tmp_path / "out" / "log.png").stat().st_size > 1000
    assert main(["identify", "--inspect", files[2], "--json"]) == 0
    alone = json.loads(capsys.readouterr().out)
    assert alone["columns"][2]["missing"] == 1 and 'h2 = "basin 2 [m]"' in alone["log"]


@pytest.mark.extended_for("False")
@pytest.mark.parametrize("irregular", [False, True])
def test_the_inputs_of_a_log_are_played(tmp_path, capsys, irregular):
    """Against the integrator of this file; with some rows left out, too."""
    t, u, y = record(0)
    rows = np.arange(len(t))
    if irregular:
        rows = rows[(rows % 20 == 0) | (rows % 7 != 3)]
    files = _files(tmp_path, t[rows], u[rows], y[rows])
    code = main(["simulate", *files[:3], "--json"])
    (first, second) = json.loads(capsys.readouterr().out)["data"]["channels"]
    assert code == 0
    for c, channel in enumerate((first, second)):
        assert len(channel["simulated"]) == len(rows)
        # from the first reading and its noise on, which the rig forgets
        late = t[rows] > 1500
        clean = _played(0)[1][rows, c]
        np.testing.assert_allclose(np.array(channel["simulated"])[late], clean[late], atol=2e-3)
        assert channel["rmse"] < 1.5 * NOISE


def test_the_gain_of_a_pump_that_is_off_in_every_log_is_not_free(monkeypatch):
    monkeypatch.setattr(coordinates, "_is_flow", lambda loop, logs, j: False)
    logs = [types.SimpleNamespace(u=np.array(u)) for u in ([[0.0, 0.0, 1.0]], [[0.0, 2.0, 0.0]])]
    free = {f"plant.pump_gain[{j}]": (0.1, 9.0) for j in range(3)}
    assert list(coordinates._without_idle(free, None, logs)) == [
        "plant.pump_gain[1]",
        "plant.pump_gain[2]",
    ]


def test_noise_is_at_least_a_thousandth_of_the_range_of_a_channel():
    line = np.linspace(0.0, 4.0, 3001)[None, :, None]
    data = types.SimpleNamespace(y=line, channels=[(0, False)])
    assert residuals.noise_of(data) == pytest.approx([4e-3], rel=1e-9)


@pytest.mark.parametrize(("share", "refused"), [(0.9, False), (1.1, True)])
def test_samples_too_far_apart_to_be_simulated_are_refused(share, refused, monkeypatch):
    log = types.SimpleNamespace(t=np.array([0.0, 1.0, 9.0]), where=lambda *place: "log")
    stub = types.SimpleNamespace(
        rig_at=lambda z: None, first_levels=lambda z: None, noise=np.array([1e-9]), logs=[log],
        data=types.SimpleNamespace(y=np.array([[[0.0], [-20.0]]])),
    )  # fmt: skip
    change = np.array([share * problem.LARGEST_ERROR * 20.0])
    monkeypatch.setattr(problem.simulation, "substeps_for", lambda *_: (5, change))
    if refused:
        with pytest.raises(DataError, match="8 s"):
            problem.Estimation.substeps_for(stub, None)
    else:
        assert problem.Estimation.substeps_for(stub, None) == 5

"""What `simulate --out` writes beside levels and inputs: disturbances, shares of a blend."""

import csv

import numpy as np
import pytest
from helpers import ONE_TANK, command, no_live_page

import jaxtank
import tuning
from jaxtank import presets
from jaxtank.bounds import is_tunable
from jaxtank.core.text import csv_line
from jaxtank.loop.trajectory import csv as text
from jaxtank.plots import responses
from tuning.report import advice


def written(tmp_path, case, *words):
    done = command("simulate", case, *words, "--out", str(tmp_path), "--quiet")
    assert done.code == 0, done.err
    with open(tmp_path / "trajectory.csv") as file:
        head, *rows = csv.reader(file)
    return dict(zip(head, np.array(rows, dtype=float).T)), {p.name for p in tmp_path.iterdir()}


@pytest.mark.slow
def test_the_share_of_sliding_mode_is_the_smoothstep_of_the_other_outputs_error(tmp_path):
    """Eqs. (16)-(17) of mirakhorli with the pairing of the text: input i by output 3 - i."""
    found, files = written(tmp_path, "mirakhorli/hybrid", "--set", "sensor.noise=0")
    law = presets.find("mirakhorli/hybrid").loop.controller
    for i, j in ((0, 1), (1, 0)):
        size = np.abs(found[f"h{j + 1} [cm]"] - found[f"r{j + 1} [cm]"])
        b, w = float(law.b[i]), min(float(law.w[i]), float(law.b[i]))
        x = np.clip((size - b + w) / (2 * w), 0.0, 1.0)
        share = found[f"share{i + 1} [-]"]
        np.testing.assert_allclose(share, x**2 * (3 - 2 * x), atol=1e-7)
        assert share.max() == 1.0 and share.min() == 0.0
    assert list(found)[-2:] == ["share1 [-]", "share2 [-]"]
    assert "shares.png" in files and "estimates.png" not in files


@pytest.mark.slow
def test_an_estimated_disturbance_is_drawn_and_kept_and_an_earlier_picture_goes(tmp_path):
    (tmp_path / "trajectory.csv").write_text("of an earlier run")
    (tmp_path / "shares.png").write_bytes(b"of an earlier run")
    found, files = written(tmp_path, "gouta2022/chadpc")
    assert list(found)[-2:] == ["d_hat1 [cm/s]", "d_hat2 [cm/s]"]
    assert "estimates.png" in files and "shares.png" not in files
    # while the kick lasts, the pump of its tank is off, and its dead zone no model error
    case = presets.find("gouta2022/chadpc")
    inflow = np.max(np.asarray(case.loop.disturbance.sample(case.clock)[0][0]))
    rate = inflow / float(np.asarray(case.loop.plant.area)[0])
    assert found["d_hat1 [cm/s]"].max() == pytest.approx(rate, rel=0.02)


@pytest.mark.slow
def test_only_a_blend_has_shares():
    clock = jaxtank.Clock(dt=4.0, duration=40.0)
    run = jaxtank.simulate(presets.find("cascaded/pi").loop, clock)
    assert run.share is None and "share" not in run.to_json()
    assert "share" not in text(run) and "d_hat" not in text(run)
    blend = presets.find("mirakhorli/hybrid")
    run = jaxtank.simulate(blend.loop, jaxtank.Clock(dt=0.1, duration=1.0))
    assert np.shape(run.to_json()["share"]) == (11, 2) and run.to_json()["units"]["share"] == "-"


@pytest.mark.extended_for("1")
@pytest.mark.parametrize("cases", [1, 2])
def test_the_picture_of_a_run_shows_the_limit_that_is_not_the_rim(cases, tmp_path, monkeypatch):
    """A verdict said that a limit is broken, over a picture without it."""
    figures, draw = [], responses.responses
    keep = lambda *words: figures.append(draw(*words)) or figures[-1]
    monkeypatch.setattr(responses, "responses", keep)
    paths = [tmp_path / f"{i}.toml" for i in range(cases)]
    for path in paths:
        path.write_text(
            ONE_TANK.replace("one tank", path.stem).replace("2.7", "2.2, min_level = 0.9")
        )
    with no_live_page():
        output = command("simulate", *map(str, paths), "--out", str(tmp_path / "out"))
    assert output.code == 0
    heights = {line.get_label(): line.get_ydata()[0] for line in figures[0].axes[0].lines}
    assert heights["limit 2.2 cm"] == 2.2 and heights["low limit 0.9 cm"] == 0.9


def test_no_search_is_advised_where_there_is_nothing_to_search():
    tanks = [jaxtank.Tank("T", area=50.0, rim=30.0, level=9.0, drain=0.5)]
    pumps = [jaxtank.Pump("P", to="T", gain=20.0, high=10.0, initial=2.0)]
    run = {"reference": [[0.0, 9.0]], "dt": 1.0, "duration": 60.0, "limits": {"max_level": 25.0}}
    case = lambda **law: jaxtank.Rig(name="T", tanks=tanks, pumps=pumps, controller=law, **run)
    switch, pi = case(kind="on-off", on=7.0, off=11.0), case(kind="pi", Kc=0.5, Ti=100.0)
    values = jaxtank.evaluate(switch.loop, switch.clock, ["max_level"])
    assert not is_tunable(switch) and is_tunable(pi)
    assert "tune" not in " ".join(advice.of_run(switch, values))
    assert "set controller.on=VALUE" in advice.of_run(switch, values).to_set
    assert "jaxtank tune searches for better ones" in advice.of_run(pi, values).to_set
    for each, limit, words in (
        (switch, 25.0, "set controller.on=VALUE"),
        (pi, 25.0, "jaxtank tune searches for better ones"),
        (pi, 5.0, "for gains that hold on such plants"),
    ):
        drawn = tuning.ensemble(
            each, {"plant.pump_gain": 0.05}, samples=4, limits={"max_level": limit}, fan=False
        )
        assert words in drawn.to_json()["advice"][0]


def test_names_with_commas_are_quoted_in_every_table(tmp_path):
    rig = jaxtank.Rig(
        name="commas",
        tanks=[jaxtank.Tank("T,1", area=50.0, rim=30.0, level=9.0, drain=0.5)],
        pumps=[jaxtank.Pump('P,"main"', to="T,1", gain=20.0, high=10.0, initial=2.0)],
        controller={"kind": "open-loop"},
        inputs=[[0.0, 2.0]],
        reference=[[0.0, 9.0]],
        dt=1.0,
        duration=10.0,
    )
    head, *rows = csv.reader(text(jaxtank.simulate(rig.loop, rig.clock)).splitlines())
    assert {len(row) for row in rows} == {len(head)} and 'u_P,"main" [V]' in head
    assert list(csv.reader([csv_line(head)])) == [head]
    (tmp_path / "log.csv").write_text(text(jaxtank.simulate(rig.loop, rig.clock)))
    log = tuning.read_log(tmp_path / "log.csv", rig)
    assert log.samples == 11 and np.all(log.u == 2.0)

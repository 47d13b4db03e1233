"""Figures of the papers: every one is listed, and curves are those of the cases."""

import json
import re

import numpy as np
import pytest
from helpers import command

import jaxtank
from jaxtank import presets, rig
from tuning.figures import drawing
from tuning.figures.figure import FIGURES, KINDS, find

# figures of each paper, by its last number
COUNTS = {"calofir": 3, "gouta2015": 17, "gouta2022": 13, "khalid": 7, "mirakhorli": 11}
RESULTS = [name for name, figure in FIGURES.items() if figure.runs]
QUICK = ["mirakhorli/3", "mirakhorli/10"]


def test_every_figure_of_every_paper_is_listed_once_and_in_order():
    wanted = [f"{paper}/{n + 1}" for paper, count in COUNTS.items() for n in range(count)]
    assert list(FIGURES) == wanted
    assert len(RESULTS) == 35


def test_the_cases_kinds_and_parameters_of_all_figures_exist():
    for figure in FIGURES.values():
        assert set(figure.kind.split()) <= set(KINDS) and bool(figure.kind) == bool(figure.runs)
        for run in figure.runs:
            rig.set_values(presets.find(run.case), dict(run.values))  # InputError for a wrong name
        if "shares" in figure.kind:
            assert figure.runs[0].case.startswith("mirakhorli/hybrid")


def same_curves(name):
    """The curves of a picture against runs of the cases alone; returns the picture's caption."""
    figure = find(name)
    drawn = drawing.run(figure)
    picture = drawing.draw(figure, drawn)
    for one in figure.runs:
        case = rig.set_values(presets.find(one.case), dict(one.values))
        run = drawn.runs[one.label][1]
        if np.any(np.asarray(case.loop.sensor.noise) > 0):
            continue  # of its own seed: compared with the command below
        every = round((run.t[1] - run.t[0]) / case.clock.dt)
        alone = jaxtank.simulate(case.loop, case.clock, save_every=every)
        np.testing.assert_array_equal(run.x, np.asarray(alone.x))
        lines = [line.get_ydata() for ax in picture.axes for line in ax.lines]
        if "levels" in figure.kind:
            for tank in figure.tanks or range(case.loop.plant.tanks):
                assert any(np.array_equal(y, run.x[:, tank]) for y in lines)
        if "inputs" in figure.kind:
            assert all(any(np.array_equal(y, u) for y in lines) for u in run.u.T)
    words = " ".join(t.get_text() for t in picture.texts + picture.subfigs[1].texts)
    assert f"{figure.paper}, figure {figure.number}." in words
    assert drawing.rendered(picture, "a.svg").startswith(b"<?xml")


@pytest.mark.parametrize("name", QUICK)
def test_curves_are_those_of_the_cases(name):
    same_curves(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in RESULTS if name not in QUICK])
def test_curves_of_all_figures_are_those_of_the_cases(name):
    same_curves(name)


@pytest.mark.slow
def test_the_command_lists_states_and_draws(tmp_path):
    listed = json.loads(command("figure", "--json").out)
    assert [name for name, row in listed.items() if row.get("result")] == RESULTS
    out = tmp_path / "new" / "share.pdf"
    done = command("figure", "mirakhorli/10", "--out", str(out), "--json")
    assert done.code == 0, done.err
    found = json.loads(done.out)
    assert found["cases"][0]["values"]["plant.drain"][0] == pytest.approx(1.3 * 0.50265)
    assert out.read_bytes().startswith(b"%PDF") and len(list(out.parent.iterdir())) == 1
    first = out.read_bytes()
    command("figure", "mirakhorli/10", "--out", str(out), "--quiet")
    assert out.read_bytes() == first
    # the share of the time is that of the CSV file of the same run
    share = float(re.search(r"in ([\d.]+) and", found["here"][0])[1])
    setting = "plant.drain=[0.653445,0.50265,0,0]"
    run = ["simulate", "mirakhorli/hybrid", "--set", setting, "--out", str(tmp_path / "run")]
    assert command(*run, "--quiet").code == 0
    head, *rows = (tmp_path / "run" / "trajectory.csv").read_text().splitlines()
    column = head.split(",").index("share1 [-]")
    numbers = np.array([row.split(",")[column] for row in rows], dtype=float)
    assert share == pytest.approx(100 * np.mean(numbers > 0.5), abs=0.5)

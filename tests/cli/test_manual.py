"""`show`: the manual of a case. Its equations are those that are integrated, and everything of the
case is on the page.
"""

import dataclasses
import re

import numpy as np
import pytest
from helpers import RIGS

from jaxtank import presets, rig
from jaxtank.core.tree import walk
from jaxtank.plots.equations import equations
from tuning.cli import main
from tuning.report import case as manual
from tuning.report.document import terminal

NAMES = list(
    {
        (
            n.split("/")[0],
            type(presets.find(n).loop.controller),
            presets.find(n).loop.faults is None,
        ): n
        for n in presets.names()
    }.values()
)


def text_of(case):
    return terminal(manual.report(case))


def rate(line, h, u):
    """The right-hand side of an equation "in numbers", read as a person would."""
    right = line.partition(" = ")[2].partition(" + d")[0]
    right = re.sub(
        r"sqrt\|(h\d - h\d)\|", r"np.sqrt(abs(\1))", re.sub(r"(?<![.\w])sqrt\(", "np.sqrt(", right)
    ).replace("sgn(", "np.sign(")
    right = re.sub(r"(\d|\)) (?=[nuh]|np)", r"\1 * ", right)
    names = {f"h{i + 1}": v for i, v in enumerate(h)} | {f"u{i + 1}": v for i, v in enumerate(u)}
    return eval(right, {"np": np, **names})


@pytest.fixture(autouse=True)
def wide(monkeypatch):
    """Cells that no narrow terminal breaks."""
    monkeypatch.setenv("COLUMNS", "100")


@pytest.mark.parametrize("paper", presets.PAPERS)
def test_the_equations_in_numbers_are_those_of_the_plant(paper):
    loop = next(iter(presets.load(paper).cases.values())).loop
    plant, rng = loop.plant, np.random.default_rng(1)
    for _ in range(5):
        h = rng.uniform(0.2, 0.9, plant.tanks) * np.asarray(plant.rim)
        u = rng.uniform(0.1, 1.0, plant.pumps) * np.asarray(loop.actuator.high)
        lines = equations(plant)[-plant.tanks :]
        reported = [rate(line, h, u) for line in lines]
        actual = np.array(plant.derivative(0.0, tuple(h), tuple(u), None))
        # four digits are printed of each coefficient, and the terms are at most some times their
        # sum
        np.testing.assert_allclose(reported, actual, atol=2e-3 * np.abs(actual).max())


def test_the_letters_follow_the_topology():
    lines = equations(presets.find("mirakhorli/sfc").loop.plant)
    assert lines[0] == "A1 h1' = gamma1 k1 u1 + s31 q(h3) - a1 q(h1)"
    assert lines[3] == "A4 h4' = (1 - gamma1) k1 u1 - s42 q(h4)"
    lines = equations(presets.find("gouta2022/pi").loop.plant, disturbed=True)
    assert lines[1] == "A2 h2' = k2 u2 - p12 w(h2 - h1) - a2 q(h2) + d2"
    assert "m^3/s" in " ".join(
        equations(presets.find("calofir/backstepping").loop.plant, disturbed=True)
    )


@pytest.mark.slow_for(*(set(NAMES) - {"khalid/gpc-mimo-constrained"}))
@pytest.mark.parametrize("name", NAMES)
def test_everything_of_a_case_is_on_its_page(name):
    case, page = presets.find(name), text_of(presets.find(name))
    preset = presets.load(name.split("/")[0])
    assert max(map(len, page.splitlines())) <= 100
    squeeze = lambda text: re.sub(r"\s+", "", text)
    flat, every = (
        squeeze(page),
        squeeze(page.partition("Every parameter\n")[2].partition("What is measured\n")[0]),
    )
    for kind in ("leaf", "static"):
        for leaf, value, _ in walk(case.loop, kind=kind):
            absent = value is None and leaf.startswith("plant.")  # what the rig does not have
            listed = isinstance(value, tuple) or np.size(value) == 0 or absent
            if not listed and not leaf.startswith(manual.MODELS):
                # a longer name may be broken where its column ends
                assert squeeze(leaf)[:20] in every, leaf
    for what in (
        *preset.departures,
        preset.citation,
        *(p.where for p in preset.published.values() if len(p.where) < 15),
    ):
        assert squeeze(what) in flat, what
    for parameter, (_, why) in preset.uncertain.items():
        assert squeeze(parameter) in flat and squeeze(why) in flat
    doc = (type(case.loop.controller).__doc__ or "").split("\n\n")[0]
    assert squeeze(doc) in flat
    for heading in (
        *("The rig:", "The loop", "The controller:", "The observer:", "What is tuned"),
        *("Every parameter", "What is measured"),
    ):
        assert f"\n{heading}" in page


def test_what_is_set_is_what_is_reported():
    case = presets.find("gouta2022/chadpc")
    values = {
        "sensor.noise": 0.02,
        "sensor.bits": 12,
        "actuator.lag": 0.5,
        "actuator.delay": 0.2,
        "reference.second.amplitude": 2.5,
    }
    page = " ".join(text_of(rig.set_values(case, values)).split())
    for words in (
        "noise of 0.02 cm",
        "an ADC of 12 bits",
        "dead zone 2.7538, 4.3248 V (offset); lag 0.5 s; transport delay 0.2 s",
        "On r1 a sine of 2.5 cm about 3 cm, period 250 s, from 50 to 800 s",
        "500 cm^3 into tank 2 at 500 s over 1.1 s",
        "steps at 0 s r2 to 10; 10 s r1 to 8",
    ):
        assert words in page, words
    faulty = " ".join(text_of(presets.find("calofir/backstepping-perturbed")).split())
    assert "plant.drain[1] times 0.75 from 300 to 450 s" in faulty
    assert "a level stops at its rim (0.6, 0.6 m)" in faulty
    loop = dataclasses.replace(case.loop, disturbance=None)
    assert "No disturbance." in text_of(case.replace(loop=loop))
    assert (
        "recovery_time"
        not in text_of(case.replace(loop=loop))
        .partition("What is measured")[2]
        .partition("What the paper")[0]
    )


@pytest.mark.slow
def test_a_rig_of_a_file_is_printed(capsys):
    assert main.main(["show", str(RIGS / "two_tanks.toml")]) == 0
    page = capsys.readouterr().out
    assert "A2 h2' = s12 q(h1) - a2 q(h2)" in page and "The controller: PID" in page
    assert "departures" not in page and "The rig: 2 tanks, 1 pump; " in page


@pytest.mark.slow
def test_the_page_prints_the_description_of_a_class_without_its_sections():
    case = presets.find("gouta2015/backstepping")
    page = text_of(case)
    assert "Examples\n--------" in (type(case.loop.controller).__doc__ or "").replace("    ", "")
    assert "Examples" not in page and "Parameters\n---" not in page and ">>>" not in page

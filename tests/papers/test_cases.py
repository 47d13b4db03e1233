"""What must hold of every case of every paper: it can be shown, written, read back, run and
compared.
"""

import dataclasses

import matplotlib.pyplot as plt
import numpy as np
import pytest
from helpers import KINDS, assert_same_tree

import jaxtank
from jaxtank import presets, rig
from jaxtank.core.errors import InputError
from jaxtank.core.tree import get_value, walk
from jaxtank.loop.run import evaluate_compiled
from jaxtank.presets.paper import Claim, Published
from tuning.bench.bench import is_one_function
from tuning.cli import main
from tuning.report.papers import VERDICTS, measure, overview, runner, verdict

NEW = [name for name in presets.names() if not name.startswith("gouta2015")]
CONTRACT = {
    "gouta2015": (
        "ngpc backstepping backstepping-ff ngpc-table1 backstepping-boxqp ngpc-slow ngpc-observer"
        " backstepping-observer nmpc nmpc-preview"
    ),
    "gouta2022": (
        "enmpc chadpc pi pi-ff pid pid-ff fopi fopi-ff enmpc-printed chadpc-printed"
        " chadpc-trapezoid enmpc-fitted chadpc-fitted"
    ),
    "mirakhorli": (
        "sfc smc hybrid smc-printed lqi sfc-warm smc-warm hybrid-warm smc-printed-warm lqi-warm"
        " smc-fitted sfc-fitted hybrid-fitted"
    ),
    "calofir": "backstepping backstepping-perturbed",
    "cascaded": "pi open-loop",
    "dts200": "pi pi-faults",
    "johansson": "pi-minimum pi-nonminimum",
    "khalid": (
        "gpc gpc-nc2 gpc-nc30 laguerre gpc-mimo laguerre-mimo gpc-constrained gpc-nc2-constrained"
        " gpc-nc30-constrained laguerre-constrained gpc-mimo-constrained laguerre-mimo-constrained"
    ),
}
NAMES_THAT_MUST_EXIST = {
    "gouta2022/chadpc": "controller.Tp observer.l plant.pump_gain actuator.dead_zone",
    "gouta2015/nmpc": "controller.horizon controller.r_w controller.q controller.terminal",
    "gouta2015/backstepping-observer": "controller.k controller.k1 observer.l",
    "gouta2022/pid": "controller.Kc controller.Ti controller.Td",
    "gouta2022/fopi": "controller.order",
    "mirakhorli/sfc": "controller.K",
    "mirakhorli/hybrid": (
        "controller.K controller.surface controller.ks controller.phi controller.b controller.w"
    ),
    "mirakhorli/lqi": "controller.Q controller.R",
    "calofir/backstepping": "controller.K_phi controller.K_y",
    "khalid/laguerre": "controller.r_w controller.a controller.operating_point",
    "khalid/gpc": "controller.r_w controller.operating_point",
}
STATICS_THAT_MUST_EXIST = {
    "mirakhorli/hybrid": "controller.pairing actuator.delay",
    "khalid/gpc": "controller.Nc controller.Np",
    "khalid/laguerre": "controller.N controller.Np",
}
# a quadratic programme inside the loop: an inner loop of matrix factorisations
# (controllers/incremental.py)
NOT_ONE_FUNCTION = {
    name for name in KINDS if name.startswith("khalid") and name.endswith("-constrained")
}


def test_every_case_of_the_contract_is_there():
    for paper, cases in CONTRACT.items():
        assert set(cases.split()) <= set(presets.load(paper).cases), paper


def test_a_preset_of_each_kind_is_run_by_the_long_tests():
    """They leave out presets that differ in numbers from one that they run."""

    def kind(name):
        loop = presets.find(name).loop
        forms = [
            (field, value)
            for field, value, _ in walk(loop, kind="static")
            if field.startswith(("controller.", "observer.")) and isinstance(value, str | bool)
        ]
        parts = (loop.controller, loop.observer, loop.actuator)
        return len(loop.plant.outputs), *map(type, parts), *forms

    assert {kind(name) for name in presets.names()} == {kind(name) for name in KINDS}


def test_names_of_the_contract():
    for name, leaves in NAMES_THAT_MUST_EXIST.items():
        for leaf in [*leaves.split(), "x0", "sensor.noise", "actuator.low", "actuator.high"]:
            assert np.all(np.isfinite(np.asarray(get_value(presets.find(name).loop, leaf)))), (
                name,
                leaf,
            )
    for name, fields in STATICS_THAT_MUST_EXIST.items():
        assert set(fields.split()) <= {
            n for n, _, _ in walk(presets.find(name).loop, kind="static")
        }


STRONGER = {"actuator.high": 5.8, "plant.pump_gain": [1.05 * 27.43, 1.05 * 19.55]}
RELAY = {"controller.surface": 10.0, "controller.ks": 100.0}
ORDINARY = {  # gouta2022 notes S2.4
    **{"plant.pump_gain": 16.7, "plant.drain": 0.66 * 0.7854, "plant.pipe": 0.66 * 0.9143},
    **{"actuator.dead_zone": [1.5, 4.3], "actuator.delay": 0.98, "actuator.lag": 0.93},
    **{"sensor.noise": 0.08, "x0": 0.3},
}
FITTED = {  # case: (the one it starts from, what is changed)
    "gouta2022/enmpc-fitted": ("gouta2022/enmpc", ORDINARY),
    "gouta2022/chadpc-fitted": ("gouta2022/chadpc", ORDINARY),
    "mirakhorli/smc-fitted": ("mirakhorli/smc-printed", RELAY | STRONGER),
    "mirakhorli/sfc-fitted": ("mirakhorli/sfc", STRONGER),
    "mirakhorli/hybrid-fitted": (
        "mirakhorli/hybrid",
        RELAY
        | STRONGER
        | {"controller.form": "printed", "controller.switch": "sign"}
        | {"controller.b": 3.25, "controller.w": 1.5, "controller.high": 5.8},
    ),
}


@pytest.mark.parametrize("name", FITTED)
def test_a_fitted_case_is_another_one_with_what_the_notes_list(name):
    case, (other, changes) = presets.find(name), FITTED[name]
    wanted = rig.set_values(presets.find(other), changes)
    assert_same_tree(case.loop, wanted.loop)
    assert case.free and case.clock == wanted.clock
    assert rig.case_warnings(case) == []  # its own difference between plant and model is meant
    far = rig.set_values(case, {"plant.pump_gain": [3.0, 3.0]})
    assert "plant.pump_gain = [3, 3]" in rig.case_warnings(far)[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_a_case_is_checked_and_its_rig_file_is_itself(name):
    case = rig.check(presets.find(name))
    again = rig.loads(rig.dump(case))
    assert_same_tree(again.loop, case.loop)
    assert again.clock == case.clock and dict(again.free) == dict(case.free)


@pytest.mark.parametrize("name", NEW)
def test_what_a_case_frees_is_a_leaf_within_its_range(name):
    case, preset = presets.find(name), presets.load(name.split("/")[0])
    for parameter, free in case.free.items():
        value = np.asarray(get_value(case.loop, parameter))
        assert np.all((value >= free.low) & (value <= free.high)), (parameter, value, free)
        rig.check_free(case.loop, parameter, *free)
    for parameter, free in preset.tunable.items():
        assert free.low < free.high, parameter


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in KINDS if n not in NOT_ONE_FUNCTION])
def test_a_case_is_one_function(name):
    case = presets.find(name)
    program = (
        evaluate_compiled.lower(
            case.loop, case.clock, ("rms_error_total", "max_level"), None, False
        )
        .compile()
        .as_text()
    )
    assert is_one_function(program, case.clock.samples)


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_a_case_is_simulated_by_the_command(name, tmp_path, capsys):
    assert main.main(["simulate", name, "--out", str(tmp_path), "--quiet"]) == 0
    assert (tmp_path / "responses.png").stat().st_size > 10_000


# rows of each paper: one that goes missing is a number that nobody looks at any more
ROWS = {
    **{"calofir": 22, "cascaded": 3, "dts200": 8, "gouta2015": 53, "gouta2022": 61},
    **{"johansson": 23, "khalid": 24, "mirakhorli": 40},
}


def test_no_row_of_a_paper_is_missing():
    assert {paper: len(presets.load(paper).published) for paper in presets.PAPERS} == ROWS


PART, NOT = "partly", "not reproduced"
CLAIMS = {  # claims of a paper that hold in part, or not; every other one that is listed holds
    "calofir": {
        "same performance in any operating point": PART,
        "globally asymptotically stabilises": NOT,
        "larger gains settle sooner": PART,
        "reacts rapidly to faults": "reproduced",
        "some steady state errors": "reproduced",
    },
    "gouta2015": {
        "uncertain plants: size of the error": NOT,
        "uncertain plants: steady error": NOT,
        "uncertain plants: feasible trajectories": NOT,
        "uncertain plants: growth of the error": "reproduced",
    },
    "gouta2022": {
        "pump constant as printed": NOT,
        "a delay makes d^ negative": NOT,
        "eq. (12) tracks without offset": NOT,
        "the observer spares the pumps": NOT,
        "rise of tank 2 and 1 by an inflow pulse": PART,
    },
    "khalid": {
        "a long control horizon improves performance": PART,
        "control horizon beyond 10": "reproduced",
        "overshoot against control horizon": PART,
        "overshoot of Laguerre against GPC 30": PART,
        "parameters of Laguerre": "reproduced",
        "Laguerre against GPC with two pumps": NOT,
        # lower with constraints alone: without, both are a fixed gain
        "computational cost of Laguerre": PART,
        "undershoot against control horizon": PART,
        "pulses from 0 m: long control horizon": PART,
        "pulses from 0 m: control horizon beyond 10": "reproduced",
        "pulses from 0 m: overshoot and undershoot": PART,
        "pulses from 0 m: overshoot of Laguerre": PART,
        "pulses from 0 m: Laguerre with two pumps": NOT,
    },
    "mirakhorli": {
        "chattering of the SMC": "reproduced",
        # on the rig that was fitted to Table 3, and not with the cases as they are
        "SFC rises more slowly": PART,
        "Table 3 with the cases as they are": PART,
        "hybrid against SMC and SFC": PART,  # by the printed gains, and not once both are tuned
        "settling time, SMC": "reproduced",
        "sign of the SFC": NOT,
        "settling of the hybrid": NOT,
        "non-minimum phase": "reproduced",
        "hybrid: steady-state error": "reproduced",
        "SFC is an optimal gain": "reproduced",  # by a choice of Q, R and gamma
        "hybrid switches between the controllers": "reproduced",
        "30 % change of an outlet": PART,
        "zero steady-state error of the SFC": PART,
    },
}
NUMBERS = {  # measured numbers that are not the printed ones, and what they are
    "mirakhorli": {
        "overshoot, SMC": (43.7, 0.1),
        "overshoot, SFC": (9.0, 0.1),
        "overshoot, hybrid": (13.5, 0.1),
        "rise time, SMC": (27.5, 0.1),
        "rise time, SFC": (34.7, 0.1),
        "rise time, hybrid": (28.4, 0.1),
    },
    "khalid": {"pulses of H2, one pump": ((0.03, 0.15), 0.0)},
}


@pytest.mark.slow_for(
    "calofir", "dts200", "gouta2015", "gouta2022", "johansson", "khalid", "mirakhorli"
)
@pytest.mark.parametrize("paper", presets.PAPERS)
def test_rows_of_a_paper_are_measured(paper, monkeypatch):
    """Every number and claim of a paper: what holds of it, and why where it does not."""
    preset = presets.load(paper)
    measured = preset.measured(runner(paper))
    once = dataclasses.replace(preset, measured=lambda run: measured)
    monkeypatch.setattr(presets, "load", lambda name: once)
    rows = measure(paper)["rows"]
    assert len(rows) == ROWS[paper]
    assert any(row["verdict"] in ("reproduced", "input") for row in rows)
    for row in rows:
        # of a claim that holds the measured text has the numbers
        assert row["reason"] or isinstance(row["measured"], str), row["quantity"]
        printed = preset.published[row["quantity"]]
        assert row["verdict"] in VERDICTS and (row["verdict"] == "fitted") <= bool(printed.fitted)
        assert not (printed.fitted and row["verdict"] == "reproduced")
    claims = {name: v.verdict for name, v in measured.items() if isinstance(v, Claim)}
    assert claims.items() >= CLAIMS.get(paper, {}).items()
    for name, (value, within) in NUMBERS.get(paper, {}).items():
        np.testing.assert_allclose(measured[name], value, atol=within)


def test_a_comparison_counts_its_rows():
    page = measure("cascaded")
    assert len(page["rows"]) == ROWS["cascaded"]
    counts = [page["headline"][kind]["of"] for kind in ("numbers", "claims")]
    counts += [page["headline"][word] for word in ("input", "not reproducible")]
    assert sum(counts) == len(page["rows"])


def test_each_verdict_is_given_where_it_belongs():
    printed = Published(2.0, "cm", "Table 1", 0.1, "too slow")
    assert verdict(printed, 2.1) == ("reproduced", 2.1, "within 10 %: largest difference 5.0 %")
    assert verdict(printed, 2.3) == ("differs", 2.3, "too slow")
    assert verdict(printed, None) == ("not reproducible", None, "too slow")
    fitted = printed._replace(fitted="chosen for it")
    within = "within 10 %: largest difference 5.0 %"
    assert verdict(fitted, 2.1) == ("fitted", 2.1, f"chosen for it; {within}")
    assert verdict(fitted, 2.3)[0] == "differs"
    assert verdict(printed._replace(tolerance=None), 2.0)[0] == "input"
    assert verdict(printed._replace(tolerance=None), 2.1) == ("differs", 2.1, "too slow")
    claim = Published("fast", "", "sec. 5", reason="no limits")
    assert verdict(claim, Claim(True, "1 s")) == ("reproduced", "1 s", "")
    assert verdict(claim, Claim((True, False), "1 s")) == ("differs", "1 s", "in part: no limits")
    assert verdict(claim, Claim(False, "9 s")) == ("differs", "9 s", "no limits")
    chosen = claim._replace(fitted="chosen")
    assert verdict(chosen, Claim((True, False), "1 s")) == ("fitted", "1 s", "chosen; no limits")


def test_the_picture_of_all_papers_has_the_ratio_of_every_number():
    row = {"quantity": "a", "unit": "cm", "where": "x", "reason": "y"}
    rows = [
        row | {"published": 2.0, "measured": 3.0, "verdict": "differs"},
        row | {"published": (1.0, 4.0), "measured": (1.0, 2.0), "verdict": "fitted"},
        row | {"published": 1.0, "measured": 1.0, "verdict": "input"},
        row | {"published": "fast", "measured": "1 s", "verdict": "reproduced"},
        row | {"published": -1.0, "measured": 1.0, "verdict": "differs"},
    ]
    figure = overview({"p": {"rows": rows}})["published"]
    drawn = [list(line.get_xdata()) for line in figure.axes[0].lines if len(line.get_xdata())]
    assert drawn[:2] == [[1.5], [0.5, 1.0]] and len(drawn) == 3  # and the line at 1
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == ["a", "a"]
    assert {t.get_text() for t in figure.legends[0].get_texts()} == {"fitted", "differs"}
    two = overview({"p": {"rows": rows[:1]}, "q": {"rows": rows[:1]}})["published"]
    assert [t.get_text() for t in two.axes[0].get_yticklabels()] == ["p: a", "q: a"]
    assert overview({"p": {"rows": rows[2:]}}) == {}
    plt.close(two)
    plt.close(figure)


def test_printed_units_follow_the_rig(capsys):
    assert main.main(["simulate", "calofir/backstepping", "--set", "clock.duration=50"]) == 0
    printed = capsys.readouterr().out
    assert " m " in printed and "m^3/s" in printed and "cm" not in printed
    assert (
        jaxtank.core.tree.describe(presets.find("khalid/gpc").loop, "plant.pump_gain")["unit"]
        == "m^3/(s U0)"
    )


@pytest.mark.parametrize(
    ("name", "nearest"),
    [
        ("gouta2015/backsteping", "gouta2015/backstepping"),
        ("mirakhorli/SFC", "mirakhorli/sfc"),
        ("Gouta2022/PI", "gouta2022/pi"),
        ("khalid/ngpc", "khalid/gpc"),  # of the paper that is named, not of the others
        ("laguerre-constrained", "khalid/laguerre-constrained"),
    ],
)
def test_a_mistyped_case_is_answered_with_the_nearest(name, nearest):
    with pytest.raises(InputError, match=rf"^unknown case {name!r}; nearest: {nearest}(,|$)"):
        presets.find(name)
    paper, _, case = name.partition("/")
    if paper in presets.PAPERS:
        with pytest.raises(
            InputError, match=rf"^unknown case {case!r}; nearest: {nearest.partition('/')[2]}(,|$)"
        ):
            presets.load(paper).cases[case]


@pytest.mark.parametrize("name", [None, 3, ("gouta2015", "ngpc")])
def test_a_case_that_is_no_text_is_refused(name):
    with pytest.raises(InputError, match="must be a text, as 'gouta2015/ngpc'"):
        presets.find(name)
    with pytest.raises(InputError, match="unknown paper"):
        presets.load(name)

"""Which parameter moves which measure: closed forms, SALib, differences, and the command."""

import csv
import functools
import json

import jax
import matplotlib.image
import matplotlib.pyplot as plt
import numpy as np
import pytest
import scipy.stats
from helpers import command, python

import jaxtank
from jaxtank import presets, rig
from jaxtank.core.errors import InputError
from jaxtank.core.tree import get_value, with_values
from jaxtank.plots import responses, uncertainty
from tuning.problem.scenarios import ScenarioRun, groups_of, values_of
from tuning.report import effects as report
from tuning.uncertainty import distributions, sensitivity_study, sensitivity_study as indices
from tuning.uncertainty.distributions import Discrete, LogUniform, Normal, Uniform
from tuning.uncertainty.draws import Draws
from tuning.uncertainty.sensitivity_study import sensitivity, what_varies

VARIED = {"plant.drain": Uniform(relative=0.05), "plant.pump_gain": LogUniform(factor=1.2)}
D = 4
CUBE = {"num_vars": D, "names": list("abcd"), "bounds": [[0.0, 1.0]] * D}
ISHIGAMI = {"num_vars": 3, "names": list("abc"), "bounds": [[0.0, 1.0]] * 3}

say = functools.partial(command, "sensitivity")


def ishigami(p):
    """sin x1 + 7 sin^2 x2 + 0.1 x3^4 sin x1, x uniform in (-pi, pi); Ishigami and Homma 1990."""
    x = np.pi * (2.0 * np.asarray(p) - 1.0)
    return (
        np.sin(x[..., 0]) + 7.0 * np.sin(x[..., 1]) ** 2 + 0.1 * x[..., 2] ** 4 * np.sin(x[..., 0])
    )


def ishigami_shares(a=7.0, b=0.1):
    """First and total shares in closed form: the variances V1, V2, V13."""
    v1, v2, v13 = 0.5 * (1 + b * np.pi**4 / 5) ** 2, a * a / 8, b * b * np.pi**8 * (1 / 18 - 1 / 50)
    whole = v1 + v2 + v13
    return np.array([v1, v2, 0.0]) / whole, np.array([v1 + v13, v2, v13]) / whole


@pytest.fixture(scope="module")
def case():
    """A short run of gouta2015 in which both setpoints move and the loop is never at rest."""
    return rig.set_values(
        presets.load("gouta2015").cases["backstepping"], {"clock.duration": 100.0, "clock.dt": 0.5}
    )


@pytest.fixture(scope="module")
def at_cube(case):
    """f(p (n, 4)) -> (n,) rms_error_total by runs one at a time: what the study does in batches."""
    draws = Draws(case.loop, VARIED)
    assert draws.dimensions == D

    def f(p):
        values, total = draws.values(np.asarray(p)), "rms_error_total"
        loops = (
            with_values(case.loop, {n: v[i] for n, v in values.items()}) for i in range(len(p))
        )
        return np.array([float(jaxtank.evaluate(a, case.clock, total)[total]) for a in loops])

    return f


def test_intervals_cover_the_closed_form():
    """Of 60 random studies about 57 should; fewer than 50 has a chance of 1 in 2000."""
    first, total = ishigami_shares()
    rng, hits = np.random.default_rng(5), np.zeros(6)
    for k in range(60):
        a, b = rng.random((2, 256, 3))
        points = np.repeat(a[:, None], 5, axis=1)
        points[:, 4] = b
        for j in range(3):
            points[:, j + 1, j] = b[:, j]
        found = indices.sobol_indices(ishigami(points), seed=k)
        ends = np.concatenate([found["first_interval95"], found["total_interval95"]])
        exact = np.concatenate([first, total])
        hits += (ends[:, 0] <= exact) & (exact <= ends[:, 1])
    assert (hits >= 50).all()


def test_additive_linear_model():
    """y = sum c p: shares c^2 / sum c^2, first and total alike; elementary effects c, without
    spread.
    """
    c = np.array([3.0, -2.0, 1.0, 0.0])
    found = indices.sobol_indices(indices.sobol_points(4, 4096, seed=1) @ c)
    np.testing.assert_allclose(found["first"], c**2 / 14, atol=0.005)
    np.testing.assert_allclose(found["total"], c**2 / 14, atol=0.005)
    assert found["total"][3] == 0.0
    points = indices.morris_points(4, 20, seed=1)
    found = indices.morris_indices(indices.morris_effects(points, points @ c + 7.0))
    np.testing.assert_allclose(found["mu"], c, atol=1e-12)
    np.testing.assert_allclose(found["mu_star"], np.abs(c), atol=1e-12)
    np.testing.assert_allclose(found["sigma"], 0.0, atol=1e-12)


def test_morris_points():
    points = indices.morris_points(5, 200, seed=3)
    assert points.min() == 0.0 and points.max() == 1.0
    moved = np.abs(np.diff(points, axis=1))
    assert (np.isclose(moved, 2 / 3).sum(axis=2) == 1).all()
    assert np.isclose(moved.sum(axis=(1, 2)), 5 * 2 / 3).all()
    levels = np.round(points[:, 0] * 3)
    np.testing.assert_allclose(points[:, 0] * 3, levels, atol=1e-12)
    # 4 sd of a binomial
    assert [int((levels == k).sum()) for k in range(4)] == pytest.approx([250] * 4, abs=55)


def test_sobol_agrees_with_salib():
    sampler = pytest.importorskip("SALib.sample.sobol")
    analysis = pytest.importorskip("SALib.analyze.sobol")
    theirs = sampler.sample(ISHIGAMI, 512, calc_second_order=False, seed=np.random.default_rng(4))
    np.testing.assert_array_equal(theirs.reshape(512, 5, 3), indices.sobol_points(3, 512, seed=4))
    y = ishigami(theirs)
    other = analysis.analyze(ISHIGAMI, y, calc_second_order=False, num_resamples=1000, seed=7)
    found = indices.sobol_indices(y.reshape(512, 5))
    np.testing.assert_allclose(found["first"], other["S1"], atol=1e-12)
    np.testing.assert_allclose(found["total"], other["ST"], atol=1e-12)
    assert found["sd"] == pytest.approx(np.sqrt(13.8446), rel=0.02)
    for name, theirs in (("first", other["S1_conf"]), ("total", other["ST_conf"])):
        half = 0.5 * np.diff(found[f"{name}_interval95"], axis=1)[:, 0]
        # quantiles against 1.96 sd, 1000 resamples each: 4 % of noise on both
        np.testing.assert_allclose(half, theirs, rtol=0.15)


def test_morris_agrees_with_salib():
    sampler = pytest.importorskip("SALib.sample.morris")
    analysis = pytest.importorskip("SALib.analyze.morris")
    theirs = sampler.sample(ISHIGAMI, 40, num_levels=4, seed=2)
    for points in (theirs.reshape(40, 4, 3), indices.morris_points(3, 40, seed=2)):
        y = ishigami(points)
        other = analysis.analyze(
            ISHIGAMI, points.reshape(-1, 3), y.ravel(), num_levels=4, num_resamples=1000, seed=1
        )
        found = indices.morris_indices(indices.morris_effects(points, y))
        for mine, his in (("mu", "mu"), ("mu_star", "mu_star"), ("sigma", "sigma")):
            np.testing.assert_allclose(found[mine], np.array(other[his], dtype=float), atol=1e-11)
        half = 0.5 * np.diff(found["mu_star_interval95"], axis=1)[:, 0]
        # Student's 2.02 for 1.96, n - 1 for n: 5 %; the bootstrap's own noise 2 sd of 5 %
        np.testing.assert_allclose(
            half, np.array(other["mu_star_conf"], dtype=float), rtol=0.15, atol=1e-9
        )


@pytest.mark.slow
def test_a_closed_loop_agrees_with_salib(case, at_cube):
    sobol = pytest.importorskip("SALib.analyze.sobol")
    morris = pytest.importorskip("SALib.analyze.morris")
    sampler = pytest.importorskip("SALib.sample.sobol")
    options = {"seed": 9, "measures": "rms_error_total", "batch": 32}
    x = sampler.sample(CUBE, 16, calc_second_order=False, seed=np.random.default_rng(9))
    other = sobol.analyze(CUBE, at_cube(x), calc_second_order=False, seed=1)
    study = sensitivity(case, VARIED, method="sobol", samples=16, **options)
    (column,) = study.columns
    assert study.runs == len(x) == 16 * (D + 2)
    np.testing.assert_allclose(column.effects["first"], other["S1"], atol=1e-9)
    np.testing.assert_allclose(column.effects["total"], other["ST"], atol=1e-9)

    points = indices.morris_points(D, 8, seed=9)
    y = at_cube(points.reshape(-1, D))
    other = morris.analyze(CUBE, points.reshape(-1, D), y, num_levels=4, seed=1)
    (column,) = sensitivity(case, VARIED, method="morris", samples=8, **options).columns
    for name in ("mu", "mu_star", "sigma"):
        theirs = np.array(other[name], dtype=float)
        np.testing.assert_allclose(column.effects[name], theirs, atol=1e-9)
    own = float(jaxtank.evaluate(case.loop, case.clock, "rms_error_total")["rms_error_total"])
    assert column.nominal == pytest.approx(own, rel=1e-12)


def test_local_against_central_differences(case, monkeypatch):
    """In chunks of 4 numbers; with tied entries, absolute, normal and discrete distributions. A
    step of 1e-5 of the half-width leaves 1e-9 of third derivatives and 1e-11 of rounding over a
    slope of 1e-2 or more.
    """
    monkeypatch.setattr(sensitivity_study, "CHUNK", 4)
    loop, names = case.loop, ("rms_error_total", "max_level", "rms_input")
    varied = {
        "plant.drain": Uniform(relative=0.05),
        "plant.pump_gain": Normal(relative=0.02, tied=True),
        "plant.orifice[0]": LogUniform(factor=1.3),
        "x0[1]": Discrete(values=(5.0, 2.0, 4.0)),
        "controller.k": Normal(mean=1.0, sd=0.004),
    }
    study = sensitivity(case, varied, measures=names)
    own = {n: np.asarray(get_value(loop, n)) for n in varied}
    drain = own["plant.drain"]
    moves = {
        "plant.drain[0]": 0.05 * drain[0],
        "plant.drain[1]": 0.05 * drain[1],
        "plant.pump_gain": 0.04 * own["plant.pump_gain"],
        "plant.orifice[0]": own["plant.orifice[0]"] * (1.3 - 1 / 1.3) / 2,
        "x0[1]": 1.5,
        "controller.k": 0.008,
    }
    assert study.parameters == list(moves)
    step, large = 1e-5, 0
    for i, (name, width) in enumerate(moves.items()):
        ends = [get_value(loop, name) + sign * step * width for sign in (1, -1)]
        high, low = (
            jaxtank.evaluate(with_values(loop, {name: end}), case.clock, names) for end in ends
        )
        slopes = np.concatenate([np.ravel(high[m] - low[m]) / (2 * step) for m in names])
        effects = np.array([c.effects["effect"][i] for c in study.columns])
        np.testing.assert_allclose(effects, slopes, rtol=1e-5, atol=1e-7)
        large += int((np.abs(effects) > 1e-3).sum())
    assert large > 15
    effects = study.columns[0].effects
    assert effects["derivative"][0] * 0.05 * drain[0] == pytest.approx(effects["effect"][0])
    relative = effects["effect"][0] / 0.05 / study.columns[0].nominal
    assert effects["elasticity"][0] == pytest.approx(relative)
    assert np.isnan(effects["derivative"][2])
    sizes = np.abs(effects["effect"])[study.order(study.columns[0])]
    assert (np.diff(sizes) <= 0).all()
    printed = study.to_json()
    gain = printed["parameters"]["plant.pump_gain"]
    assert gain["half_width_is"] == "2 standard deviations"
    assert printed["parameters"]["x0[1]"]["half_width"] == 1.5
    row = printed["measures"]["max_level of tank 1"]["parameters"]["plant.drain[0]"]
    assert row["derivative_unit"] == "cm per cm^2" and "effect [cm]" in str(study)


@pytest.mark.slow
def test_batches_and_seeds(case):
    """A run is the same in any batch, but for the last bits; the same seed gives the same bits,
    another one others.
    """
    options = {"method": "sobol", "samples": 16, "measures": ("rms_error", "max_level")}
    counts = []
    first = sensitivity(case, VARIED, seed=3, progress=lambda *n: counts.append(n), **options)
    assert counts[-1] == (96, 96)
    batched = sensitivity(case, VARIED, seed=3, batch=7, **options)
    again, other = (sensitivity(case, VARIED, seed=seed, **options) for seed in (3, 4))
    labels = ["rms_error of output 1", "rms_error of output 2", "max_level of tank 1"]
    assert [c.label for c in first.columns][:3] == labels
    for a, b, c, d in zip(first.columns, batched.columns, again.columns, other.columns):
        np.testing.assert_allclose(a.effects["total"], b.effects["total"], rtol=1e-9, atol=1e-12)
        for name, value in a.effects.items():
            np.testing.assert_array_equal(value, c.effects[name])
        assert not np.array_equal(a.effects["total"], d.effects["total"])


@pytest.mark.slow
def test_noise_is_the_same_in_every_run(case):
    """That of `evaluate` with the key of the seed. A parameter that does nothing has no effect at
    all, although every run is noisy.
    """
    noisy, total = rig.set_values(case, {"sensor.noise": 0.1}), "rms_error_total"
    varied = {"plant.rim": Uniform(relative=0.01), "plant.drain": Uniform(relative=0.05, tied=True)}
    options = {"method": "morris", "samples": 4, "seed": 6}
    (column,) = sensitivity(noisy, varied, measures=total, **options).columns
    assert not column.effects["mu_star"][:4].any() and column.effects["mu_star"][4] > 0
    own = jaxtank.evaluate(noisy.loop, noisy.clock, total, jax.random.key(6))[total]
    assert column.nominal == pytest.approx(float(own), rel=1e-12)


@pytest.mark.slow
def test_noise_may_vary_from_none(case):
    """Travel of the pumps grows with the noise, which the case itself has none of."""
    varied = {"sensor.noise": Uniform(low=0.0, high=0.2, tied=True)}
    study = sensitivity(case, varied, method="morris", samples=4, measures="input_travel")
    for column in study.columns:
        assert 0 < column.effects["mu"][0] == column.effects["mu_star"][0]


def test_runs_that_fail_are_counted_and_reported(case):
    wide = LogUniform(low=1e-3, high=1e300)
    varied = {"plant.drain[0]": wide, "plant.pump_gain": Uniform(relative=0.05)}
    study = sensitivity(case, varied, method="sobol", samples=32, measures="max_level")
    values = Draws(case.loop, varied).values(indices.sobol_points(3, 32, 0).reshape(-1, 3))
    (group,) = groups_of([ScenarioRun("", case, None, 1.0)])
    broken = np.asarray(values_of(group, ("max_level",), values)[1])
    count = int(np.sum(broken))
    assert 0 < count < study.runs and study.failed == count
    printed = study.to_json()
    assert printed["failed"] == count
    assert any(f"{count} of {study.runs} runs diverged" in note for note in printed["notes"])
    assert all(c.not_finite >= count for c in study.columns)
    whole = int((~broken.reshape(32, 5).any(axis=1)).sum())
    assert [m["base_points_used"] for m in printed["measures"].values()] == [whole] * 4
    json.dumps(printed, allow_nan=False)


def test_estimators_leave_out_what_is_not_finite():
    y = ishigami(indices.sobol_points(3, 64, seed=0))
    holed = y.copy()
    holed[5, 2], holed[9, 0] = np.nan, np.inf
    found, rest = indices.sobol_indices(holed), indices.sobol_indices(np.delete(y, [5, 9], axis=0))
    np.testing.assert_array_equal(found["total"], rest["total"])
    assert found["kept"] == 62
    assert np.isnan(indices.sobol_indices(np.full((8, 5), 0.1))["first"]).all()  # does not vary
    assert np.isnan(indices.sobol_indices(np.full((8, 5), np.nan))["total_interval95"]).all()
    points = indices.morris_points(3, 6, seed=0)
    y = ishigami(points)
    y[2, 1] = np.inf
    steps = indices.morris_effects(points, y)
    assert np.isnan(steps[2]).sum() == 2 and np.isfinite(np.delete(steps, 2, axis=0)).all()
    found = indices.morris_indices(steps)
    assert sorted(found["kept"]) == [5, 5, 6]
    np.testing.assert_allclose(found["mu"], np.nanmean(steps, axis=0))
    np.testing.assert_allclose(
        1e300 * indices.sobol_indices(holed)["sd"], indices.sobol_indices(1e300 * holed)["sd"]
    )


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"method": "moris"}, "nearest: morris"),
        ({"method": "morris", "samples": 1}, "samples = 1"),
        ({"method": "sobol", "samples": True}, "samples = True"),
        ({"measures": "rms_eror"}, "nearest: rms_error"),
        ({"measures": "settling_time"}, "has no derivative"),
        ({"measures": "recovery_time", "method": "sobol"}, "is undefined for"),
        ({"spread": 1.5}, "spread = 1.5"),
        ({"spread": float("nan")}, "spread = nan"),
        ({"spread": 0.1, "distributions": VARIED}, "give one of them"),
        ({"distributions": {}}, "nothing is uncertain"),
        ({"distributions": {"plant.drian": Uniform(relative=0.1)}}, "nearest: plant.drain"),
        ({"distributions": {"clock.dt": Uniform(relative=0.1)}}, "clock.dt"),
        ({"distributions": {"plant.drain": Normal(mean=0.0, sd=1.0)}}, "at least 0"),
        ({"seed": -1}, "seed = -1"),
        ({"batch": 0}, "batch = 0"),
    ],
)
def test_bad_input(case, options, words):
    with pytest.raises(InputError) as error:
        sensitivity(case, **options)
    assert words in str(error.value) and "\n" not in str(error.value)


def test_correlated_parameters_have_local_effects_only(case):
    names = ("plant.drain[0]", "plant.drain[1]")
    joint = {"fit": distributions.Correlated(names=names, covariance=((4e-4, 3e-4), (3e-4, 9e-4)))}
    assert sensitivity_study.half_widths(Draws(case.loop, joint)) == [
        {names[0]: 0.04},
        {names[1]: pytest.approx(0.06)},
    ]
    with pytest.raises(InputError, match="vary together"):
        sensitivity(case, joint, method="sobol")


def test_defaults_are_the_cases_own(case):
    study = sensitivity(case, method="morris", samples=4)
    assert {n: d.relative for n, d in study.distributions.items()} == dict(case.uncertain)
    assert {c.measure for c in study.columns} == {*case.objective, "rms_error_total", "max_level"}
    assert {d.relative for d in what_varies(case, spread=0.02)[0].values()} == {0.02}
    with pytest.raises(InputError, match="names nothing uncertain"):
        sensitivity(case.replace(uncertain={}))


SHORT = ("cascaded/pi", "--set", "clock.duration=400")
MORE = "--vary plant.drain=uniform:5% --vary plant.pump_gain=normal:2%:tied --measure max_level"
MORE += " --measure ise --json --out"


@pytest.mark.slow_for("local-5-tornado", "morris-4-tornado")
@pytest.mark.parametrize(
    ("method", "samples", "picture"),
    [("local", "5", "tornado"), ("morris", "4", "tornado"), ("sobol", "20", "sobol")],
)
def test_command(tmp_path, method, samples, picture):
    folder = tmp_path / "found"
    found = say(*SHORT, "--method", method, "--samples", samples, *MORE.split(), str(folder))
    assert found.code == 0 and "run " in found.err and "written to" in found.err
    printed = found.json
    assert (printed["case"], printed["method"], printed["failed"]) == ("cascaded/pi", method, 0)
    assert list(printed["parameters"]) == ["plant.drain[1]", "plant.pump_gain"]
    assert printed["runs"] == {"local": 1, "morris": 4 * 3, "sobol": 32 * 4}[method]
    assert {m: v["unit"] for m, v in printed["measures"].items()} == {
        "max_level of tank 1": "V",
        "max_level of tank 2": "V",
        "ise of output 1": "V^2 s",
    }
    for measure in printed["measures"].values():
        assert set(measure["parameters"]) == {"plant.drain[1]", "plant.pump_gain"}
    assert any("rounded up to 32" in n for n in printed["notes"]) == (method == "sobol")
    assert json.loads((folder / "result.json").read_text()) == printed
    rows = list(csv.DictReader((folder / "sensitivity.csv").open()))
    assert len(rows) == 6 and {r["rank"] for r in rows} == {"1", "2"}
    index = report.METHODS[method].heads
    (key,) = [k for k in index if k in ("effect", "mu_star", "total")]
    for row in rows:
        value = printed["measures"][row["measure"]]["parameters"][row["parameter"]][key]
        value = np.nan if value is None else value
        assert float(row[key] or "nan") == pytest.approx(value, rel=1e-9, nan_ok=True)
    assert matplotlib.image.imread(folder / f"{picture}.png").shape[0] > 100
    files = {"result.json", "sensitivity.csv", "report.html", f"{picture}.png"}
    assert {p.name for p in folder.iterdir()} == files


FILLED = """
tank = [{ area = 20.0, rim = 30.0, drain = 0.2, level = 5.0 }]
pump = [{ to = 1, gain = 15.0, high = 12.0, initial = 3.0 }]
controller = { kind = "open-loop", initial = [3.0] }
reference = { initial = [5.0] }
values = { "clock.dt" = 1.0, "clock.duration" = 60.0 }
"""


def test_no_parameter_is_named_where_none_has_an_effect(tmp_path):
    """The lowest level is that of the start."""
    path = tmp_path / "rig.toml"
    path.write_text(FILLED)
    words = ["sensitivity", str(path), "--vary", "plant.pump_gain=uniform:5%", "--quiet"]
    done = command(*words, "--measure", "min_level")
    assert "most sensitive" not in done.out and "best:" not in done.out
    assert "--method sobol" in done.out
    done = command(*words, "--measure", "min_level", "--method", "morris", "--samples", "4")
    assert "no measure depends on a parameter" in done.out


DEVICES = """
import sys, jax, numpy as np
import jaxtank, tuning
from jaxtank import presets, rig
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 3)
values = {"clock.dt": 0.1, "clock.duration": 60.0}
case = rig.set_values(presets.find("gouta2015/backstepping"), values)
for devices in (1, 3):
    options = dict(devices=devices, progress=lambda *done: print(*done))
    found = tuning.sensitivity(case, method="morris", samples=6, batch=8, **options)
    effects = [(c, v) for c in found.columns for v in c.effects.values() if hasattr(v, "tolist")]
    print([(c.label, c.nominal, v.tolist()) for c, v in effects])
"""


@pytest.mark.slow
def test_three_devices_give_the_bits_of_one():
    lines = python(DEVICES).splitlines()
    half = len([line for line in lines if line.startswith("[")])
    numbers = [line for line in lines if line.startswith("[")]
    assert half == 2 and numbers[0] == numbers[1] and "nan" not in numbers[0]
    done = [int(line.split()[0]) for line in lines if not line.startswith("[")]
    assert done.count(54) == 2 and len(done) == 7 + 7  # 55 runs in batches of 8
    with pytest.raises(InputError, match="devices = 2: this process has 1"):
        sensitivity(presets.find("cascaded/pi"), method="morris", devices=2)


def test_a_cloud_shows_who_broke_a_limit_and_when():
    pairs = np.array([[1.0, 0.5], [2.0, 1.0], [3.0, 3.5], [2.5, 1.5]])
    held = np.array([[True, True], [False, True], [False, False], [False, True]])
    ax = uncertainty.cloud(plt.subplots()[1], pairs, held, "highest level", "cm", 3.2)
    assert (ax.get_xlabel(), ax.get_ylabel()) == (
        "highest level before [cm]",
        "highest level after [cm]",
    )
    drawn = {c.get_label(): np.asarray(c.get_offsets()).tolist() for c in ax.collections}
    assert drawn == {
        "violated a limit before, none after (2 of 4)": [[2.0, 1.0], [2.5, 1.5]],
        "holds every limit, before and after (1 of 4)": [[1.0, 0.5]],
        # it broke one before, too: the counts are of runs, each in one place
        "violates a limit after (1 of 4)": [[3.0, 3.5]],
    }
    labels = [line.get_label() for line in ax.lines]
    assert "limit 3.2 cm" in labels and "no change" in labels and ax.get_xlim() == ax.get_ylim()
    far = uncertainty.cloud(plt.subplots()[1], pairs * [1.0, 20.0], held, "cost", "-", 1e3)
    assert far.get_xscale() == "log" and not any("limit" in line.get_label() for line in far.lines)
    plt.close("all")


def test_pictures():
    figure, axes = plt.subplots(1, 3)
    names, few = [f"p{i}" for i in range(20)], ["p0", "p1", "p2"]
    effect = np.linspace(1.0, 0.05, 20) * (-1.0) ** np.arange(20)
    ends = np.abs(effect)[:, None] + [-0.1, 0.1]
    ax = responses.tornado(axes[0], names, effect, "cm", "x")
    assert ax.get_xlabel() == "change [cm]"
    assert len(ax.patches) == 2 * responses.BARS and "6 smaller ones not shown" in ax.get_title()
    assert [p.get_width() for p in ax.patches[:2]] == list(effect[:2]) and ax.yaxis_inverted()
    ax = responses.elementary(
        axes[1], names[:3], np.abs(effect[:3]), ends[:3], np.ones(3), "cm", "x"
    )
    assert ax.get_xlabel() == "change over the range [cm]"
    assert [t.get_text() for t in ax.get_yticklabels()] == names[:3]
    ax = responses.shares(axes[2], few, *[(np.ones(3), ends[:3])] * 2, "x")
    assert "[-]" in ax.get_xlabel() and len(ax.patches) == 6
    segments = np.sort(np.array(ax.collections[0].get_segments())[:, :, 0], axis=1)
    ends = np.stack([np.minimum(ends[:3, 0], 1), np.maximum(ends[:3, 1], 1)], axis=1)
    np.testing.assert_allclose(segments, ends)
    plt.close(figure)


@pytest.mark.parametrize(
    ("unit", "of", "words"),
    [
        ("cm", "cm^2", "cm per cm^2"),
        ("cm", "-", "cm"),
        ("-", "V", "1 per V"),
        ("-", "-", "-"),
        ("V^2 s", "cm^3/(s V)", "V^2 s per cm^3/(s V)"),
    ],
)
def test_the_unit_of_a_derivative(unit, of, words):
    assert report.per(unit, of) == words


def test_the_interval_of_a_mean_effect_is_students():
    effects = np.array([[1.0], [2.0], [4.0], [4.5], [np.nan]])
    shares = indices.morris_indices(effects)
    expected = scipy.stats.t.interval(0.95, 3, effects[:4].mean(), scipy.stats.sem(effects[:4, 0]))
    np.testing.assert_allclose(shares["mu_interval95"][0], expected, rtol=1e-12)
    assert shares["kept"][0] == 4


def test_measures_that_count_samples_are_left_out_of_local_effects_alone(case):
    counted = case.replace(objective={"settling_time": 1.0, "rms_error": 1.0})
    names = {m: sensitivity_study.check_measures(counted, None, m) for m in ("local", "morris")}
    assert "settling_time" in names["morris"] and "settling_time" not in names["local"]
    assert "rms_error" in names["local"]

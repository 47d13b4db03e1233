"""The engine of a live page, run by node, against the library: runs, noise, slopes, searches."""

import dataclasses
from importlib import resources

import jax
import numpy as np
import pytest
from helpers import KINDS, NODE, node

import jaxtank
from jaxtank import presets, rig
from jaxtank.core.errors import InputError
from jaxtank.core.tree import get_value
from jaxtank.export.tables import line_segments
from jaxtank.export.whole import served, whole_loop
from jaxtank.live import engine as live
from jaxtank.live.engine import data, engine, facts_of, program_of, squares_of
from jaxtank.live.page import _script
from jaxtank.xla import program_cache
from jaxtank.xla.normal import DENOMINATOR, NUMERATOR

pytestmark = pytest.mark.skipif(NODE is None, reason="no node on this machine")
# {case: what makes it short}
SHORT = {
    "cascaded/pi": {},
    "gouta2015/backstepping": {"clock.dt": 0.5, "clock.duration": 300.0},
    "gouta2022/pi": {"clock.dt": 0.2, "actuator.delay": 1.0, "actuator.lag": 0.9},
}
NO_PAGE = ("gouta2015/nmpc", "gouta2015/nmpc-preview")
LONG = [n for n in KINDS if n not in ("cascaded/pi", "gouta2015/backstepping", *NO_PAGE)]

RUN = """
const entries = (m) => Object.entries(m).map(([k, v]) => [k, [].concat(v).map(String)]);
const text = (m) => Object.fromEntries(entries(m));
const d = GIVEN, e = makeEngine();
console.log(JSON.stringify(d.settings.map((s) => {
  const r = e.run(s, { every: d.every, seed: d.seed, filter: d.filter });
  const part = (a) => a.map((column) => Array.from(column, String));
  return { h: part(r.h), u: part([...r.u, ...r.applied]), measures: text(r.measures) };
})));
"""
SLOPES = """
const d = GIVEN, e = makeEngine();
const r = e.slopes(d.values, e.info.free, { seed: d.seed });
const jacobian = Object.entries(r.jacobian).map(([k, v]) => [k, Array.from(v)]);
console.log(JSON.stringify([e.info.free, jacobian, Array.from(r.gauss_newton)]));
"""
RUNNER = """
const sent = [], shown = [], worker = { postMessage: (m) => sent.push(m.values) };
globalThis.performance ??= { now: () => 0 };
const done = (run, { values }) => shown.push([run, values]);
const on = { done, failed: (text) => shown.push(text) };
const answer = (run) => worker.onmessage({ data: { kind: "run", run, milliseconds: 1 } });
const runner = makeRunner(() => worker, ({ values }) => -values, on);
[1, 2, 3].forEach((values) => runner.ask({ values }));
answer("a");
answer("b");
const quiet = !runner.busy;
runner.ask({ values: 4 });
worker.onerror();
setTimeout(() => {
  runner.ask({ values: 5 });
  const fail = () => { throw new Error("x"); }, forbidden = makeRunner(fail, fail, on);
  forbidden.ask({ values: 6 });
  console.log(JSON.stringify({ sent, shown, quiet }));
}, 5);
"""


def short(name):
    return rig.set_values(presets.find(name), SHORT.get(name, {}))


def settings_of(case, count=1, leaves=10, seed=0):
    """Random settings of `leaves` sliders: within 5 %, between their ends, and at their ends."""
    rng, found = np.random.default_rng(seed), []
    sliders = facts_of(case, [program_of(case)])["leaves"]
    sliders = [s for s in sliders if s["value"] and s["group"] != "model"]
    for _ in range(count):
        chosen = rng.choice(len(sliders), min(leaves, len(sliders)), replace=False)
        own = [sliders[i] for i in chosen]
        near = {s["name"]: s["value"] * (1.0 + 0.05 * rng.uniform(-1.0, 1.0)) for s in own}
        ends = {s["name"]: (s["lower"], s["upper"]) for s in own}
        found.append({name: float(np.clip(near[name], *ends[name])) for name in near})
        found.append({s["name"]: float(rng.uniform(s["lower"], s["upper"])) for s in own})
        found.append({s["name"]: s[rng.choice(["lower", "upper"])] for s in own})
    return found


def runs(case, every, seed):
    """(levels, inputs behind and before their lag, {measure: values}) of the library."""
    key = jax.random.key(seed) if np.any(np.asarray(case.loop.sensor.noise) > 0) else None
    run = jaxtank.simulate(case.loop, case.clock, key, every)
    names = [m for m in served(case) if not m.startswith("time_of")]
    found = jaxtank.evaluate(case.loop, case.clock, names, key)
    inputs = np.concatenate([run.u, run.applied], axis=1).T
    return np.asarray(run.x).T, inputs, {m: np.ravel(found[m]) for m in names}


def same(expected, actual, tolerance, rounding=0.0):
    """Whether two arrays are the same but for `tolerance` of their largest finite entry."""
    size = np.max(np.abs(expected[np.isfinite(expected)]), initial=1e-12)
    return np.allclose(actual, expected, rtol=0, atol=tolerance * size + rounding, equal_nan=True)


def nearby(case, every, seed):
    """`runs` of a plant and a start that are 1e-13 off: a run that moves with them by much more
    than that is not determined by its numbers. (The plant too: a start of 0 cm stays 0.)
    """

    def off(part):
        return jax.tree.map(lambda leaf: np.asarray(leaf) * (1.0 - 1e-13), part)

    loop = dataclasses.replace(case.loop, x0=off(case.loop.x0), plant=off(case.loop.plant))
    return runs(case.replace(loop=loop), every, seed)


def agrees(case, settings, tolerance, seed=0, filtered=None):
    """Assert that levels, inputs and measures of the engine are those of the library.

    Return how many settings were compared: those that the library allows, and whose runs do not
    multiply rounding by a thousand.
    """
    every, compared = max(1, case.clock.samples // 100), 0
    given = {"settings": settings, "every": every, "seed": seed, "filter": filtered is not None}
    found = node(engine(case, filtered) + RUN, given)
    for values, got in zip(settings, found, strict=True):
        one = filtered or case
        try:
            one = rig.check(rig.set_values(one, values)) if values else one
        except InputError:
            continue
        levels, inputs, measures = runs(one, every, seed)
        other, _, moved = nearby(one, every, seed)
        if not same(levels, other, 1e-10):
            continue
        compared += 1
        pairs = [("h", got["h"], levels), ("u", got["u"], inputs)]
        pairs += [
            (m, got["measures"][m], theirs)
            for m, theirs in measures.items()
            if same(theirs, moved[m], 1e-10)  # not a count of samples that are at a limit
        ]
        rounding = 1e-14 * np.nanmax(np.abs(levels))  # of an error that is the rest of two levels
        for what, mine, theirs in pairs:
            assert same(theirs, np.array(mine, dtype=float), tolerance, rounding), (what, values)
    return compared


@pytest.mark.slow
@pytest.mark.parametrize("name", SHORT)
def test_runs_are_those_of_the_library(name):
    case = short(name)
    assert agrees(case, [{}, *settings_of(case, 2)], 1e-9) >= 3


INFINITE = """
units = ["m", "%"]
tank = [
    {name = "A", area = 0.5, rim = 1.2, level = 0.5, drain = 2e-4, drain_linear = 2000.0},
    {name = "B", area = 0.4, rim = 1.2, level = 0.5, drain = 2e-4},
]
pump = [
    {to = "A", gain = 4e-5, high = 100.0, initial = 20.0, rate = 2.0},
    {to = "B", gain = 4e-5, high = 100.0, initial = 20.0},
]
sensor = [{tank = "A", unit = "m", span = [0.1, 0.62], filter = 4.0}]
controller = {kind = "p", Kc = 300.0}
reference = {initial = [0.5, 0.5], changes = [[10.0, 1, 0.6], [20.0, 2, 0.6]]}
values = {"clock.dt" = 1.0, "clock.duration" = 60.0}
"""


TABLES = """
units = ["m", "m^3/s"]
tank = [{ name = "LT101", area = 10.0, rim = 9.0, level = 2.0, drain = 0.02 }]
pump = [{ name = "P101", gain = 1.0, to = 1, high = 1.0, initial = 0.1, delay = 20.0 }]
plant = { gravity = 9.81 }
inflow = [
    { csv = "table.csv", column = "q", interpolate = "linear", tank = 1 },
    { time = 500.0, duration = 100.0, tank = 1, volume = 2.0 },
]
values = { "clock.dt" = 5.0, "clock.duration" = 8000.0 }
"""
BY_TABLE = {
    "setpoints": 'reference = { csv = "table.csv", column = "SP" }\n'
    'controller = { kind = "pi", Kc = 0.5, Ti = 700.0, bias = 0.1 }',
    "inputs": 'inputs = { csv = "table.csv" }',
}


@pytest.mark.extended_for("setpoints")
@pytest.mark.parametrize("table", BY_TABLE)
def test_tables_are_data_of_the_engine(table, tmp_path):
    rng, head = np.random.default_rng(0), "t,SP,q,P101\n"
    rows = rng.uniform((1.5, 0.0, 0.0), (2.5, 0.02, 0.2), (90, 3)).round(4)
    text = (f"{70 * k + 7},{','.join(map(str, row))}\n" for k, row in enumerate(rows))
    (tmp_path / "table.csv").write_text(head + "".join(text))
    (tmp_path / "rig.toml").write_text(TABLES + BY_TABLE[table])
    case = rig.load(tmp_path / "rig.toml")
    assert agrees(case, [{}, *settings_of(case)], 1e-9) >= 2


def test_times_and_columns_of_a_page_are_those_of_files():
    """Ticks at round numbers of s, h and d; inputs before a lag where they are not those behind."""
    run = "{t:[0],h:[[1]],y:[[1]],r:[[1]],u:[[2]],command:[[4]],applied:[[A]],spilled:[[0]]}"
    names = '{tank:["1"],output:["1"],pump:["1"]}'
    info = f'{{units:{{length:"m",drive:"V"}},pumps:[{{unit:"V"}}],columns:{names}}}'
    texts = [f"csvOf({run.replace('A', u)}, {info})" for u in "23"]
    texts += [f"[momentOf({t}, {t}), roundTimes({t})[12]]" for t in (60, 36_000, 1_728_000)]
    script = f"{_script('core')}\nconsole.log(JSON.stringify([{','.join(texts)}]))"
    plain, lagged, *times = node(script)
    assert "applied" not in plain and "applied1 [V]" in lagged
    assert times == [["60 s", 1], ["10 h", 3600], ["20 d", 86400]]


def test_straight_line_segments_of_columns_give_them_back():
    rng = np.random.default_rng(1)
    t = np.arange(900.0)
    steps = np.repeat(rng.normal(size=90), 10)
    lag = np.exp(-t / 1e6)  # each of its bends is 1e-12
    straight = steps, np.cumsum(steps), steps + np.cumsum(steps), t - 300.0 * (t // 300)
    for column, most in [*((v, 200) for v in straight), (lag, 900)]:
        parts = [np.linspace(*piece) for piece in zip(*line_segments(column), strict=True)]
        size = np.abs(column).max()
        np.testing.assert_allclose(np.concatenate(parts), column, rtol=0, atol=2e-12 * size)
        assert len(parts) <= most


def test_the_code_of_a_known_structure_is_read_for_other_numbers(tmp_path, monkeypatch):
    """Other gains and levels need no trace; another clock, and values that are no input, do."""
    monkeypatch.setattr(program_cache, "folder", tmp_path)
    traced = []
    whole = whole_loop
    monkeypatch.setattr(live, "whole_loop", lambda *words: traced.append(1) or whole(*words))
    case = presets.find("cascaded/pi")
    other = rig.set_values(case, {"controller.Kc[0]": 3.0, "x0[0]": 1.1})
    engine(case)
    assert len(traced) == 2  # what is shown, and what a search needs
    text = engine(other)
    assert len(traced) == 2
    monkeypatch.setattr(program_cache, "folder", None)
    assert engine(other) == text
    monkeypatch.setattr(program_cache, "folder", tmp_path)
    traced.clear()
    engine(rig.set_values(case, {"clock.dt": 2.0}))
    assert len(traced) == 2


@pytest.mark.extended
def test_numbers_that_are_infinite_are_so_in_the_engine():
    """Rates, resistances and ends of spans of the parts that have none."""
    case = rig.loads(INFINITE)
    assert agrees(case, [{}, *settings_of(case, 2)], 1e-9) >= 5


@pytest.mark.slow
@pytest.mark.parametrize("name", LONG)
def test_a_case_of_each_kind_runs_as_in_the_library(name):
    case = presets.find(name)
    tolerance = 1e-6 if "constrained" in name else 1e-9
    assert agrees(case, [{}, *settings_of(case, 4)], tolerance) >= 3


@pytest.mark.slow
def test_where_a_run_differs_much_so_does_that_of_a_plant_as_good_as_equal():
    """With sliders anywhere, levels may differ by centimetres: rounding that the loop amplifies."""
    case = short("gouta2015/backstepping")
    settings, differ = settings_of(case, 40, seed=7), []
    given = {"settings": settings, "every": 1, "seed": 0, "filter": False}
    for values, got in zip(settings, node(engine(case) + RUN, given), strict=True):
        try:
            one = rig.check(rig.set_values(case, values))
        except InputError:
            continue
        levels, other = runs(one, 1, 0)[0], nearby(one, 1, 0)[0]
        mine, theirs = (np.max(np.abs(h - levels)) for h in (np.array(got["h"], float), other))
        assert mine < 3.0 * theirs + 1e-9, values
        differ.append(mine > 1e-3)
    assert 3 < sum(differ) < 0.5 * len(differ)


@pytest.mark.slow
def test_noise_is_that_of_a_seed():
    agrees(short("cascaded/pi"), [{"sensor.noise[0]": 0.05, "sensor.noise[1]": 0.02}], 1e-9, 7)


def test_deviates_are_those_of_jax():
    text = resources.files("jaxtank.live").joinpath("engine.js").read_text("utf-8")
    facts = f"{{leaves: []}}, programs = [], inverseErf = {[[*NUMERATOR], [*DENOMINATOR]]}"
    script = f"const info = {facts};\n{text}"
    found = node(script + "console.log(JSON.stringify(deviates(5, 2, 400).map((v) => [...v])))")
    expected = jax.random.normal(jax.random.key(5), (2, 400), dtype=float)
    np.testing.assert_allclose(np.array(found), expected, rtol=1e-12, atol=1e-14)


@pytest.mark.slow
def test_the_safety_filter_is_switched_on():
    case = short("gouta2015/backstepping")
    agrees(case, [{}], 1e-9, filtered=rig.filtered(case, True))


@pytest.mark.slow_for("cascaded/pi")
@pytest.mark.parametrize(
    "name",
    [
        "cascaded/pi",
        pytest.param("gouta2022/pi", marks=pytest.mark.slow),
        pytest.param("khalid/gpc", marks=pytest.mark.slow),
    ],
)
def test_derivatives_are_those_of_the_library(name):
    case = short(name)
    given = {"values": {}, "seed": 0}
    names, jacobian, matrix = node(engine(case) + SLOPES, given)
    point = {n: np.float64(get_value(case.loop, n)) for n in names}
    key = jax.random.key(0) if np.any(np.asarray(case.loop.sensor.noise) > 0) else None
    squares = dict(squares_of(case.objective))
    measures = [m for m, _ in jacobian]
    found = jaxtank.sensitivities(case.loop, case.clock, measures, point, key, squares)
    for m, slopes in jacobian:
        expected = np.ravel(found[1][m])
        size = np.max(np.abs(expected))
        np.testing.assert_allclose(slopes, expected, rtol=0, atol=1e-4 * max(size, 1e-9))
    np.testing.assert_allclose(matrix, np.ravel(found[2]), rtol=1e-3, atol=1e-12)


def test_of_runs_asked_for_meanwhile_the_newest_is_sent_and_without_a_worker_it_runs_here():
    runner = resources.files("jaxtank.live").joinpath("runner.js").read_text("utf-8")
    found = node(runner + RUNNER)
    assert found["sent"] == [1, 3, 4] and found["quiet"]
    assert found["shown"] == [["a", 1], ["b", 3], [-4, 4], [-5, 5], "x"]


@pytest.mark.slow
def test_names_of_a_rig_stay_text():
    hostile = "</script><script>alert(1)//\u2028"
    case = presets.find("cascaded/pi").replace(name=hostile, title=hostile, limits={})
    text = engine(case)
    assert "</" not in text and "<!--" not in text and "\u2028" not in text
    script = text + "console.log(JSON.stringify(makeEngine().info.case))"
    assert node(script) == hostile and "</" not in data({"a": hostile})

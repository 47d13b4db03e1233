"""The search of a live page, run by node, against scans and the search of the command."""

import json
from importlib import resources

import jax
import numpy as np
import pytest
from helpers import NODE, ONE_TANK, node

import jaxtank
from jaxtank import measures as ms, presets, rig
from jaxtank.limits import limit_scale, resolve_limits
from jaxtank.live.engine import engine
from jaxtank.live.page import _script, _worker, both, data_of
from tuning.report import verdict as verdicts
from tuning.search.judged import judge
from tuning.search.setting import setting_of

pytestmark = pytest.mark.skipif(NODE is None, reason="no node on this machine")
TUNE = resources.files("jaxtank.live").joinpath("tune.js").read_text("utf-8")
SEARCH = """
const e = makeEngine();
const found = tune(e, {}, e.info.free, e.info.limits, null, null, { starts: 3 });
found.then((found) => console.log(JSON.stringify(found)));
"""


@pytest.mark.slow
def test_a_search_ends_where_a_scan_has_its_minimum():
    """Of one gain, within 0.5 % of the cost of the best of 60 values."""
    case = presets.find("cascaded/pi").replace(limits={})
    case = case.replace(free={"controller.Kc": (0.05, 3.3, "log")})
    found = node(engine(case) + TUNE + SEARCH)
    scan = []
    for gain in np.geomspace(0.05, 3.3, 60):
        loop = jaxtank.with_values(case.loop, {"controller.Kc": gain})
        scan.append(
            float(jaxtank.evaluate(loop, case.clock, ["rms_error_total"])["rms_error_total"])
        )
    assert found["status"] == "converged" and found["violation"] == 0
    assert found["objective"] <= 1.005 * min(scan)


@pytest.mark.slow
def test_a_search_keeps_the_limits():
    """The answer, run by the library: no limit is passed."""
    case = rig.loads(ONE_TANK).replace(limits={"max_level": 2.8})
    case = case.replace(free={"controller.Ti": (0.5, 100.0, "log")})  # Ti = 4 s is best without
    found = node(engine(case) + TUNE + SEARCH)
    loop = jaxtank.with_values(case.loop, found["values"])
    levels = jaxtank.evaluate(loop, case.clock, ["max_level"])["max_level"]
    start = jaxtank.evaluate(case.loop, case.clock, ["max_level"])["max_level"]
    assert np.max(start) > 2.9 > 2.8 >= np.max(levels) > 2.79


def test_a_search_on_plants_keeps_the_limits_of_each_and_minimises_their_mean():
    """The answer, run by the library on every plant."""
    case = rig.loads(ONE_TANK).replace(limits={"max_level": 2.8})
    name, usual = "plant.pump_gain[0]", float(case.loop.plant.pump_gain[0])
    plants = [{}, {name: 0.9 * usual}, {name: 1.1 * usual}]
    script = f"""
const e = makeEngine(), plants = {json.dumps(plants)}.map((values) => ({{ values, seed: 0 }}));
const found = tune(e, {{}}, e.info.free, e.info.limits, null, null, {{ plants }});
found.then((found) => console.log(JSON.stringify(found)));
"""
    found = node(engine(case) + TUNE + script)
    costs, highest = [], []
    for plant in plants:
        loop = jaxtank.with_values(case.loop, found["values"] | plant)
        values = jaxtank.evaluate(loop, case.clock, ["rms_error_total", "max_level"])
        costs.append(float(values["rms_error_total"]))
        highest.append(float(np.max(values["max_level"])))
    assert found["violation"] == 0 and max(highest) <= 2.8
    assert found["objective"] == pytest.approx(np.mean(costs), rel=1e-6)


@pytest.mark.slow
def test_a_search_without_a_way_ends_at_the_least_violation():
    """Of one gain, against the least of the largest violation on a scan of 60 values."""
    case = presets.find("cascaded/pi").replace(limits={"max_level": [6.0, 5.0]})
    case = case.replace(free={"controller.Kc": (0.05, 3.3, "log")})
    found = node(engine(case) + TUNE + SEARCH)
    scan = []
    for gain in np.geomspace(0.05, 3.3, 60):
        loop = jaxtank.with_values(case.loop, {"controller.Kc": gain})
        levels = np.asarray(jaxtank.evaluate(loop, case.clock, ["max_level"])["max_level"])
        scan.append(np.max(levels / [6.0, 5.0] - 1.0))
    assert found["status"] == "limits not met" and min(scan) > 0.01
    assert found["violation"] == pytest.approx(min(scan), rel=0.01, abs=1e-4)
    assert found["violation"] <= min(scan) + 1e-6


def ends_like_the_command(name):
    """Within 0.5 % of `tune --nominal` of the case's own run, with the same limits passed.

    Of the same point: the library runs what the search in JavaScript has found.
    """
    import tuning

    case = presets.find(name).replace(scenarios=())
    found = node(engine(case) + TUNE + SEARCH)
    wanted = tuning.tune(case, tuning.Options(validation=0), nominal=True)
    loop = jaxtank.with_values(case.loop, found["values"])
    measures = [*case.objective, *(limit.measure for limit in resolve_limits(case))]
    own = jaxtank.evaluate(loop, case.clock, list(dict.fromkeys(measures)))
    cost = sum(weight * float(np.sum(own[m])) for m, weight in case.objective.items())
    assert found["objective"] == pytest.approx(cost, rel=1e-6)
    assert found["objective"] <= 1.005 * wanted.objective["after"]
    passed = max(
        [0.0]
        + [
            float(limit.sign * (np.ravel(own[limit.measure])[limit.index] - limit.value))
            / float(limit_scale(limit, case.loop))
            for limit in resolve_limits(case)
        ]
    )
    assert found["violation"] == pytest.approx(passed, abs=1e-6)
    return found["violation"], wanted


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        *("calofir/backstepping", "cascaded/pi", "gouta2015/backstepping", "gouta2022/chadpc"),
        *("dts200/pi", "gouta2022/pi", "johansson/pi-minimum", "khalid/gpc", "mirakhorli/sfc"),
    ],
)
def test_searches_of_all_papers_end_where_those_of_the_command_end(name):
    assert ends_like_the_command(name)[0] == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gouta2015/backstepping-ff", "gouta2015/ngpc"])
def test_limits_that_no_gains_keep_are_passed_as_little_as_by_the_command(name):
    violation, wanted = ends_like_the_command(name)
    assert violation > 0.01 and not wanted.success


COSTS = """
const e = makeEngine(), { objective, values } = e.info.task;
console.log(JSON.stringify([e.info.task, GIVEN.map(([plant, seed, filter]) => {
  const { measures } = e.run({ ...values, ...plant }, { seed, filter, search: true });
  const total = (m) => [measures[m]].flat().reduce((a, b) => a + b);
  return Object.entries(objective).reduce((sum, [m, w]) => sum + w * total(m), 0);
})]));
"""


MIXED = """
units = ["cm", "cm^3/s"]
tank = [{ area = 200.0, rim = 40.0, drain = 0.2, level = 15.0 },
    { area = 100.0, rim = 20.0, drain = 0.3, level = 10.0 }]
pump = [{ to = 1, high = 300.0 }]
valve = [{ from = 1, to = 2, area = 2.0 }]
plant = { outputs = [1, 2] }
controller = { kind = "pi", Kc = [20.0, 0.05], Ti = [60.0, 60.0] }
reference = { initial = [15.0, 10.0], changes = [[100.0, 2, 12.0]], ramp = 0.0 }
values = { "clock.dt" = 1.0, "clock.duration" = 300.0 }
"""


@pytest.mark.slow
@pytest.mark.parametrize("mixed", [False, True])
def test_a_search_on_plants_has_the_cost_the_noise_and_the_filter_of_the_command(mixed):
    """A price on changes of inputs; the runs of the library, with the same deviates."""
    case = rig.set_values(presets.find("cascaded/pi"), {"clock.duration": 400.0})
    plants, gain = [({}, 3, False)], "plant.pump_gain[0]"
    plants += [({gain: 0.044}, 4, False), ({gain: 0.048, "x0[0]": 4.6}, 5, True)]
    if mixed:  # a pump and a valve of different ranges, tanks of different heights
        case, plants = rig.loads(MIXED), [({}, 3, False), ({"plant.drain[0]": 0.22}, 4, False)]
    off, on, _ = both(case)
    setting = setting_of(case)
    task, costs = node(engine(off, on) + COSTS, plants)
    assert task["objective"] == pytest.approx(dict(setting.objective))
    assert mixed or task["proved"]
    assert min(task["objective"].values()) > 0.0 and len(task["objective"]) == 2
    filtered = setting.with_filter()
    for (values, seed, guard), cost in zip(plants, costs, strict=True):
        loop = (filtered if guard else setting).searched.loop
        varied, clock = jaxtank.with_values(loop, values), setting.searched.clock
        measures = jaxtank.evaluate(varied, clock, list(setting.objective), jax.random.key(seed))
        expected = sum(w * float(np.sum(measures[m])) for m, w in setting.objective.items())
        assert cost == pytest.approx(expected, rel=1e-9)


PLANTS = """
let served = 0;
const postMessage = () => {}, spread = {}, values = { ...makeEngine().info.task.values };
let onmessage;
WORKER
for (const { name, value, group } of engine.info.leaves) {
  const share = GIVEN[name] ?? GIVEN[name.split("[")[0]];
  if (share !== undefined && !["model", "safety filter"].includes(group))
    [spread[name], values[name]] = [share, value];
}
const { info } = engine, { limits, free } = info, filter = info.filter.default_on;
const base = { values, spread, limits, free, filter, seed: 0, every: 100 };
"""
TUNED = """
search({ ...base, searched: 16, judged: 64 }).then(
  ({ plants, ...found }) => console.log(JSON.stringify({ ...found, served })));
"""


def in_worker(case, script):
    """What a script prints in the worker of a page."""
    off, on, _ = both(case)
    worker = PLANTS.replace("WORKER", "\n".join([_script("core"), _worker()]))
    return node(engine(off, on) + worker + script, data_of(case)["uncertain"])


HELPED = """
const port = () => ({
  postMessage(tasks) {
    served += tasks.length;
    const own = makeEngine(), run = (task) => runOfTask(own, task);
    const found = structuredClone(structuredClone(tasks).map(run)); // as between workers
    setTimeout(() => this.onmessage({ data: { found } }));
  },
});
helpers = [port(), port()];
"""


@pytest.mark.extended
def test_workers_that_share_the_plants_find_the_same_as_one():
    case = rig.loads(ONE_TANK)
    alone = in_worker(case, TUNED)
    shared = in_worker(case, HELPED + TUNED)
    assert shared["values"] == alone["values"] and shared["objective"] == alone["objective"]
    assert shared["iterations"] == alone["iterations"] > 1 and alone["served"] == 0
    assert shared["served"] > 100


COUNTED = """
many({ ...base, count: 64 }).then(({ astray }) =>
  console.log(JSON.stringify([astray, plantsOf({ ...base, count: 64 })])));
"""


def test_plants_that_miss_their_setpoints_are_counted():
    """Those that the command would count; among them all whose pump at its limit fills the tank to
    less than the setpoint of 2.6 cm.
    """
    weak = ONE_TANK.replace("high = 2.0", "high = 0.66").replace("= 40.0", "= 400.0")
    case = rig.loads(weak)
    astray, plants = in_worker(case, COUNTED)
    names = ["plant.pump_gain[0]", "plant.drain[0]", "sensor.noise[0]"]

    def run(plant, seed):
        loop = jaxtank.with_values(case.loop, {n: plant[n] for n in names})
        return jaxtank.evaluate(loop, case.clock, ms.TRACKED, jax.random.key(seed))

    values = [run(plant, seed) for seed, plant in enumerate(plants)]
    columns = {m: np.array([v[m] for v in values]) for m in ms.TRACKED}
    lost = verdicts.not_tracking(case.loop, columns, np.zeros(64, dtype=bool))
    gain, drain, _ = np.array([[p[n] for p in plants] for n in names])
    assert lost[(gain * 0.66 / drain) ** 2 / (2.0 * 0.5) < 2.6].all()
    assert 10 < lost.sum() == astray < 54


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["cascaded/pi", "gouta2015/backstepping", "dts200/pi", "johansson/pi-minimum"]
)
def test_tune_of_the_page_is_the_answer_of_the_command_on_its_plants(name):
    """The cost of the command, on its 256 plants: at most 3 % more, and the limits hold as well."""
    import tuning

    case = presets.find(name)
    found = in_worker(case, TUNED)
    setting = setting_of(case).with_filter() if found["filter"] else setting_of(case)
    answer = tuning.tune(case)
    gains, command = {name: found["values"][name] for name in answer}, answer.answer.after
    loop = jaxtank.with_values(setting.searched.loop, gains)
    own = judge(setting.replace(searched=setting.searched.replace(loop=loop)), 256, 0)
    assert np.mean(own.cost) <= 1.03 * np.mean(command.cost)
    assert own.held.sum() >= 0.97 * command.held.sum()

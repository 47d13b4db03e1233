"""What a user writes in Python: names for components, solver options, results that are read."""

import abc
import contextlib
import dataclasses
import inspect
import json
import sqlite3
from html.parser import HTMLParser

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fault_drill import kept
from helpers import ONE_TANK, assert_same_tree, registries_kept

import jaxtank
import tuning
from jaxtank import measures as ms, presets, rig
from jaxtank.controllers import Controller
from jaxtank.core.errors import InputError
from jaxtank.core.tree import number
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.observers import Observer
from jaxtank.plants.base import Plant
from jaxtank.rig import components
from tuning.cli.main import main
from tuning.optimal_input.perfect_information import InputBound
from tuning.search.options import options_of
from tuning.search.result import constraint_rows


@jaxtank.component
class Proportional(Controller):
    """u = bias + Kc (r - h), after Kc is divided by `divisor`."""

    model: Plant
    Kc: float = jaxtank.leaf("V/cm", "gain", low=0.0)
    bias: "float" = jaxtank.leaf("V", "voltage at no error")
    divisor: "int" = jaxtank.static("-", "what the gain is divided by", low=1, default=1)

    def step(self, state, tick, estimate):
        output = self.model.outputs[0]
        error = tick.r[0] - estimate.x[output]
        return (self.bias + self.Kc / self.divisor * error,), state


@jaxtank.component
class Offset(Observer):
    """Levels as they are measured, less a known offset."""

    offset: np.ndarray = jaxtank.leaf("cm", "offset of each sensor", shape=("tank",))

    def step(self, state, tick, y):
        x = tuple(h - self.offset[i] for i, h in enumerate(y))
        return jaxtank.core.records.Estimate(x=x), state


RIG = ONE_TANK.partition("\nfree")[0].replace("one tank", "own")
for old, new in {
    "limits = { max_level = 2.7 }": "limits = {}",
    "law = ": 'observer = { kind = "offset", offset = [0.01] }\nlaw = ',
    'kind = "pid", Kc = 1.0, Ti = 4.0, Tt = 5.0': (
        'kind = "proportional", Kc = 2.0, bias = 0.4, divisor = 2'
    ),
}.items():
    RIG = RIG.replace(old, new)
RIG += '\nfree = { "controller.Kc" = [0.1, 10.0] }\n'


QUICK = dict(starts=1, screening=2, iterations=3, validation=0)


@pytest.fixture(scope="module", autouse=True)
def own():
    """The case of RIG; the registry of rig files is put back after these tests."""
    with registries_kept():
        rig.register("proportional", Proportional)
        rig.register("offset", Offset)
        yield rig.loads(RIG)


@pytest.fixture(scope="module")
def tuned(own):
    return tuning.tune(own, tuning.Options(**QUICK))


def test_a_registered_controller_and_observer_are_read_and_written(own):
    assert isinstance(own.loop.controller, Proportional) and own.loop.controller.divisor == 2
    assert isinstance(own.loop.observer, Offset)
    for text in (rig.dump(own), rig.dump(own, tankwise=True), rig.complete(own)):
        again = rig.loads(text)
        assert_same_tree(again.loop, own.loop)
        assert again.free == own.free


@pytest.mark.slow
def test_save_writes_the_rig_file_of_a_registered_controller(tuned, tmp_path, monkeypatch):
    monkeypatch.setattr("tuning.report.tuned.figures", lambda *_: {})
    tuned.save(tmp_path)
    controller = rig.load(tmp_path / "rig.toml").loop.controller
    assert isinstance(controller, Proportional)
    assert float(controller.Kc) == tuned.parameters["controller.Kc"]["after"] != 2.0


def test_init_and_export_take_a_rig_file_with_a_registered_controller(own, tmp_path, capsys):
    path = tmp_path / "own.toml"
    path.write_text(RIG)
    assert main(["init", str(path)]) == 0
    text = capsys.readouterr().out
    assert 'kind = "proportional"' in text and rig.loads(text).loop.controller.divisor == 2
    assert main(["export", str(path), "--out", str(tmp_path / "code")]) == 0


def test_keys_of_a_registered_controller_are_checked(own):
    for text, words in (
        (RIG.replace("Kc = 2.0, ", ""), r"needs Kc \[V/cm\]: gain"),
        (RIG.replace("bias = 0.4, ", ""), "needs bias"),
        (RIG.replace("divisor = 2", "divisor = 0.5"), "controller.divisor = 0.5: must be"),
        (RIG.replace("divisor = 2", "divider = 2"), "unknown key of .controller. 'divider'"),
        (RIG.replace("Kc = 2.0", "Kc = [2.0]"), "controller.Kc = .*one number"),
        (RIG.replace('kind = "offset"', 'kind = "proportional"'), "unknown observer kind"),
    ):
        with pytest.raises(InputError, match=words):
            rig.loads(text)


def test_a_taken_name_and_a_class_that_is_no_component_are_refused(own):
    @jaxtank.component
    class Other(Controller):
        def step(self, state, tick, estimate):
            return (0.0,), state

    class Plain(Proportional):
        pass

    @jaxtank.component
    class Abstract(Controller):
        @abc.abstractmethod
        def gain(self): ...

    @jaxtank.component
    class Nested(Controller):
        inner: Controller

        def step(self, state, tick, estimate):
            return self.inner.step(state, tick, estimate)

    for kind, cls, words in (
        ("proportional", Other, "'proportional' is taken, by Proportional"),
        ("offset", Other, "'offset' is taken, by Offset"),
        ("pid", Other, "'pid' is taken, by PID"),
        ("other", Proportional, "name in rig files already: 'proportional'"),
        ("plain", Plain, "Plain is no component"),
        ("abstract", Abstract, "Abstract is no component"),
        ("rig", type(own.loop.plant), "is no component"),
        ("five", 5, "5 is no component"),
        ("nested", Nested, "Nested.inner: a rig file sets fields made by"),
        ("two words", Other, "must be a text of letters"),
        (None, Other, "must be a text of letters"),
    ):
        with pytest.raises(InputError, match=words) as refused:
            rig.register(kind, cls)
        assert "\n" not in str(refused.value)
    assert rig.register("proportional", Proportional) is Proportional  # a cell that is run again
    assert sorted(components.REGISTERED) == ["offset", "proportional"]


def test_a_constructor_converts_lists_and_numbers():
    short = PumpBank(low=[0.0, 1], high=(12.0, 10.0))
    full = PumpBank(
        low=number([0.0, 1.0]),
        high=number([12.0, 10.0]),
        stop=number([0.0, 0.0]),
        pulse=number([12.0, 10.0]),
        initial=number([0.0, 0.0]),
    )
    sensors = (LevelSensor(noise=[0.1]), LevelSensor(gain=[1], noise=(0.1,), full_scale=5))
    for one, other in ((short, full), sensors):
        assert_same_tree(one, other)
        assert all(type(a) is np.ndarray and a.dtype == np.float64 for a in jax.tree.leaves(one))
    assert dataclasses.replace(short, low=[2, 3]).low.tolist() == [2.0, 3.0]
    assert PumpBank(low=[0.0], high=[np.inf]).pulse == 1.0


def test_a_constructor_refuses_what_it_cannot_fill():
    with pytest.raises(TypeError, match="low"):
        PumpBank(high=[12.0])
    with pytest.raises(InputError, match="bits = 10: an ADC needs"):
        LevelSensor(noise=[0.1], bits=10)


def test_what_is_no_number_passes_a_constructor_and_a_transformation_untouched():
    bank = PumpBank(low=[0.0], high=[12.0])
    marks = [
        object(),
        jax.ShapeDtypeStruct((1,), np.float64),
        None,
        "x",
        np.float32(1.0),
        [[1.0], 2.0],
    ]
    for mark in marks:
        assert PumpBank(low=mark, high=[12.0], stop=0.0, initial=0.0).low is mark
    for mark in (*marks, 0, 1.0, (1, 2)):
        assert jax.tree.map(lambda _, m=mark: m, bank).high is mark
    assert jax.eval_shape(lambda b: b, bank).high == jax.ShapeDtypeStruct((1,), np.float64)
    axes = jax.tree.map(lambda _: 0, bank)  # a constructor would make arrays of them
    many = jax.tree.map(lambda v: jnp.stack([v, v + 1.0]), bank)
    sums = jax.jit(jax.vmap(lambda b: b.low + b.high, in_axes=(axes,)))(many)
    np.testing.assert_array_equal(sums, [[12.0], [14.0]])
    made = jax.jit(lambda v: PumpBank(low=[0.0], high=v))(jnp.array([3.0]))
    assert made.pulse == 3.0
    slopes = jax.grad(lambda b: (b.low * b.high).sum())(bank)
    assert isinstance(slopes, PumpBank) and slopes.low == 12.0
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(bank)]
    assert paths == [".low", ".high", ".stop", ".pulse", ".initial"]


def test_load_answers_with_a_case_where_one_is_named():
    assert presets.load("cascaded/pi") is presets.find("cascaded/pi")
    for name, words in (("cascaded/pj", "unknown case"), ("cascade/pi", "unknown case")):
        with pytest.raises(InputError, match=words):
            presets.load(name)
    with pytest.raises(InputError, match="unknown paper"):
        presets.load("cascade")


def reported(result):
    """What a search came to: its method, gains and every evaluation."""
    return result.method, result.parameters, result.history, result.message


@pytest.mark.slow
def test_solver_options_are_the_keywords_they_stand_for(own, tuned):
    assert reported(tuning.tune(own, tuning.TRF(**QUICK))) == reported(tuned)
    problem = tuning.Problem(own, free=own.free, limits={})
    assert reported(tuning.tune(problem, tuning.TRF(**QUICK))) == reported(tuned)
    by_name = tuning.tune(own, options_of("slsqp", **QUICK))
    assert options_of("slsqp") == tuning.SQP()
    assert by_name.method == "slsqp" and reported(by_name) != reported(tuned)


def test_solver_options_are_checked_when_they_are_made_and_against_keywords(own):
    for make, words in (
        (lambda: tuning.SQP(starts=0), "starts = 0: must be a whole number from 1"),
        (lambda: tuning.SQP(tolerance=2.0), "tolerance = 2.0: must be"),
        (lambda: tuning.Adam(batch=True), "batch = True: must be"),
        (lambda: tuning.TRF(coarse=1), "coarse = 1: must be True or False"),
        (lambda: tuning.tune(tuning.Problem(own), limits={}), "limits: the Problem has it already"),
        (lambda: tuning.tune(own, "newton"), "method = 'newton': must be one of auto, trf"),
    ):
        with pytest.raises(InputError, match=words):
            make()
    with pytest.raises(TypeError, match="batch"):
        tuning.TRF(batch=2)
    keywords = inspect.signature(tuning.tune).parameters
    assert len(keywords) <= 13  # the case, and twelve more


@pytest.mark.slow
def test_a_problem_keeps_its_seed_and_its_limits(own):
    problem = tuning.Problem(own, limits={"max_level": 9.0}, seed=3)
    few = tuning.SQP(**QUICK)
    kept, other = tuning.tune(problem, few), tuning.tune(problem, few, seed=5)
    assert kept.problem is problem and kept.provenance["seed"] == 3
    assert other.problem.limits == problem.limits and other.problem.seed == 5
    assert problem.seed == 3


def test_a_parameter_of_a_result_is_read_by_name(tuned):
    change = tuned["controller.Kc"]
    assert dataclasses.asdict(change) == tuned.parameters["controller.Kc"]
    assert (change.before, change.lower, change.upper, change.unit) == (2.0, 0.1, 10.0, "V/cm")
    assert change.after == float(tuned.tuned.loop.controller.Kc)
    assert change.at_bound == "upper"
    assert "controller.Kc" in tuned and "controller.Kd" not in tuned
    assert list(tuned) == ["controller.Kc"]
    with pytest.raises(dataclasses.FrozenInstanceError):
        change.after = 1.0
    with pytest.raises(InputError, match=r"'controller.Kd'; nearest: controller.Kc"):
        tuned["controller.Kd"]


def test_messages_have_codes_and_their_texts_are_the_message(tuned):
    assert type(tuned.messages) is tuple and len(tuned.messages) > 1
    assert all(type(m) is tuning.Message for m in tuned.messages)
    assert tuned.message == "; ".join(m.text for m in tuned.messages)
    assert all(m.text == str(m) and "\n" not in m.text for m in tuned.messages)
    listed = tuned.to_json()["messages"]
    assert listed == [{"code": m.code, "text": m.text} for m in tuned.messages]
    codes = [m.code for m in tuned.messages]
    assert "parameter-at-bound" in codes and "starts-agree" in codes
    assert "infeasible" not in codes
    with pytest.raises(dataclasses.FrozenInstanceError):
        tuned.messages[0].code = "other"


def test_a_limit_is_a_typed_row_with_the_values_before_and_after(tuned):
    limits = {"max_level": [9.0, 9.5], "input_travel": 1e9}
    problem = tuning.Problem(presets.find("cascaded/pi"), limits=limits)
    before, after = (
        {"max_level": np.array(levels), "input_travel": np.array([travel])}
        | dict.fromkeys(ms.times(), np.array([12.5, 20.0]))
        for levels, travel in (([9.25, 8.0], 70.0), ([8.5, 9.499], 80.0))
    )
    rows = constraint_rows(problem, [after], [before], {"max_level of tank 1": 0.25})
    first, _, travel = rows
    assert all(type(row) is tuning.ConstraintRow for row in rows)
    assert (first.name, first.measure, first.unit) == ("max_level of tank 1", "max_level", "V")
    assert [(row.tank, row.pump) for row in rows] == [(1, None), (2, None), (None, 1)]
    assert [row.before for row in rows] == [9.25, 8.0, 70.0]
    assert [row.value for row in rows] == [8.5, 9.499, 80.0]
    assert [row.limit for row in rows] == [9.0, 9.5, 1e9]
    assert (first.margin, first.time_s, travel.time_s) == (0.5, 12.5, None)
    # by its multiplier; by its margin, a tenth of a thousandth of the limit; not at all
    assert [row.active for row in rows] == [True, True, False]
    assert [row.multiplier for row in rows] == [0.25, 0.0, 0.0]
    (violated, *_) = constraint_rows(problem, [before], None, {"max_level of tank 1": 0.25})
    assert violated.margin == -0.25 and not violated.active and violated.before is None
    assert first["margin"] == first.margin
    with pytest.raises(KeyError):
        first["price"]
    with pytest.raises(dataclasses.FrozenInstanceError):
        first.limit = 1.0
    found = tuned.replace(constraints=rows).to_json()["constraints"]
    assert {"name", "limit", "value", "margin", "tank", "time_s"} < set(found[0])
    assert [row["before"] for row in found] == [9.25, 8.0, 70.0]


def test_a_status_is_typed_and_is_its_text(tuned):
    assert type(tuned.status) is tuning.Status and tuned.success
    assert tuned.status is tuning.Status.CONVERGED and tuned.status == "converged"
    assert {"converged": 0}[tuned.status] == 0 and f"{tuned.status}" == "converged"
    assert json.dumps(tuned.status) == '"converged"'
    with pytest.raises(ValueError, match="done"):
        tuning.Status("done")


def test_every_result_has_the_same_ways_out(tuned):
    from tuning.uncertainty.sensitivity_study import SensitivityResult

    for kind in (tuning.TuningResult, tuning.Ensemble, SensitivityResult, tuning.Identification):
        assert all(callable(getattr(kind, name)) for name in ("to_json", "plot", "save"))
    found = tuned.to_json()
    assert type(found["status"]) is str and found["case"] == "own"
    assert found["parameters"]["controller.Kc"]["after"] == tuned["controller.Kc"].after
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert str(tuned).startswith("own: converged") and "controller.Kc" in str(tuned)


@pytest.mark.slow
def test_tune_keeps_its_log_in_the_checkpoint_and_goes_on_from_it(own, tuned, tmp_path):
    few = tuning.TRF(**QUICK)
    assert reported(tuning.tune(own, few, checkpoint=tmp_path)) == reported(tuned)
    count = kept(tmp_path)
    with contextlib.closing(sqlite3.connect(tmp_path / "checkpoint.sqlite3")) as file, file:
        file.execute("DELETE FROM record WHERE rowid > 4")
    assert kept(tmp_path) == 3 < count
    again = tuning.tune(own, few, checkpoint=tmp_path, resume=True)
    assert reported(again) == reported(tuned)
    assert kept(tmp_path) == count


@pytest.fixture(scope="module")
def run(own):
    return jaxtank.simulate(own.loop, own.clock, save_every=100)


def test_a_trajectory_has_the_ways_out_of_a_result(run, own, tmp_path):
    found = run.to_json()
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    np.testing.assert_array_equal(found["x"], run.x)
    assert found["units"] == dict.fromkeys(("x", "y", "x_hat", "r", "e"), "cm") | dict.fromkeys(
        ("command", "applied", "u"), "V"
    ) | {"t": "s", "d_hat": "cm/s", "spilled": "cm^3"}
    lines = str(run).splitlines()
    assert lines[0] == "run from 0 to 40 s: 5 rows, 1 tank, 1 pump"
    assert lines[1].startswith("  level of tank 1 [cm]: from ") and len(lines) == 4
    paths = run.save(tmp_path / "run")
    assert [path.name for path in paths] == ["trajectory.csv", "run.png"]
    header, *rows = paths[0].read_text().splitlines()
    assert header.startswith("t [s],h1 [cm],") and len(rows) == len(run.t)
    assert run.plot().keys() == {"run"}


def test_a_trajectory_is_data_to_jax_and_keeps_its_units(run):
    doubled = jax.jit(lambda r: jax.tree.map(lambda v: 2.0 * v, r))(run)
    assert type(doubled) is jaxtank.Trajectory and doubled.units == ("cm", "V")
    np.testing.assert_array_equal(doubled.x, 2.0 * np.asarray(run.x))
    several = jax.vmap(lambda a: jax.tree.map(lambda v: a * v, run))(jnp.arange(3.0))
    assert str(several).startswith("Trajectory of several runs")
    assert "<table>" in (several._repr_html_())
    assert run.replace(units=("m", "V")).to_json()["units"]["x"] == "m"
    broken = run.replace(x=np.asarray(run.x) * np.nan)
    assert broken.to_json()["x"][0] == [None]


def test_a_case_has_the_ways_out_of_a_result(own, tmp_path):
    found = own.to_json()
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert found["parameters"]["controller.Kc"] == {"value": 2.0, "unit": "V/cm"}
    assert found["parameters"]["clock.dt"] == {"value": 0.1, "unit": "s"}
    assert found["free"] == {"controller.Kc": [0.1, 10.0, "log"]}
    text = str(own.replace(limits={"max_level": "rim", "min_level": 1.0}))
    assert text.startswith("own: ") and "controller Proportional, observer Offset" in text
    assert "tunable: controller.Kc = 2.0 V/cm, from 0.1 to 10 V/cm" in text
    assert "limit: max_level at most rim" in text and "min_level at least 1.0 cm" in text
    paths = own.save(tmp_path / "case")
    assert [path.name for path in paths] == ["case.json", "rig.toml", "rig.png"]
    assert rig.load(paths[1]).loop.controller.Kc == 2.0
    assert own.plot().keys() == {"rig"}


def test_a_case_that_no_rig_file_can_describe_is_saved_without_one(own, tmp_path):
    @jaxtank.component
    class Still(Controller):
        model: Plant

        def step(self, state, tick, estimate):
            return (0.0,) * self.model.pumps, state

    controller = Still(model=own.loop.plant)
    case = own.replace(loop=dataclasses.replace(own.loop, controller=controller), free={})
    with pytest.warns(UserWarning, match=r"rig.toml is not written \(.*Still has no name"):
        paths = case.save(tmp_path)
    assert [path.name for path in paths] == ["case.json", "rig.png"]


def test_tables_for_a_notebook_escape_what_a_user_wrote(own, run):
    page = own.replace(title="<script>alert(1)</script> & more")._repr_html_()
    assert "<script>" not in page and "&lt;script&gt;alert(1)&lt;/script&gt; &amp; more" in page
    page = run.replace(units=("<b>", "V"))._repr_html_()
    assert "<b>" not in page and "level of tank 1 [&lt;b&gt;]" in page
    assert page.count("<tr>") == 4  # headings, a level, an error, an input


class Page(HTMLParser):
    """The tags and the words of a fragment of HTML."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.text = [], []
        self.feed(text)
        self.words = set(" ".join(self.text).split())

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)

    def handle_data(self, data):
        self.text.append(data)


NASTY = "a<script>alert(1)</script>\"'&b"


@pytest.fixture(scope="module")
def results(own, tuned):
    """{kind: () -> result}, of a case whose name is hostile, under a custom class."""
    with pytest.MonkeyPatch.context() as patch:  # a class that has no name in a file
        patch.setattr(components, "REGISTERED", {})
        for name, role in components.ROLES.items():
            left = {k: v for k, v in role.classes.items() if v not in (Proportional, Offset)}
            patch.setitem(components.ROLES, name, role._replace(classes=left))
        case = own.replace(name=NASTY)
        spread = {"plant.pump_gain": tuning.Normal(relative=0.05)}
        t = np.arange(0.0, 60.0, 2.0)
        level = 1.5 + 0.5 * np.sin(t / 10.0)
        data = tuning.log(t=t, u=1.0 + np.cos(t) / 2.0, y=level[:, None])
        free = {"plant.pump_gain": (0.1, 20.0)}
        cell = {"name": NASTY, "value": 1.0, "limit": 2.0, "margin": 1.0, "time_s": None}
        numbers = dict(cost=1.0, measures={}, u=np.zeros((3, 1)), interval=2.0, slope=0.0)
        bound = dict(objective={NASTY: 1.0}, constraints=[cell], holds=True, closed_loop=None)
        bound |= dict(case=case, source="search", grids=[])
        counts = dict(iterations=1, gradients=1, simulations=1, wall_s=0.1, interrupted=False)
        yield {
            "tuning": lambda: tuned.replace(case=case, tuned=case),
            "ensemble": lambda: tuning.ensemble(
                case, spread, 4, measures=("max_level",), limits={}
            ),
            "sensitivity": lambda: tuning.sensitivity(case, spread, measures=["max_level"]),
            "identification": lambda: tuning.identify(case, [data], free, starts=1, iterations=2),
            "certificate": lambda: tuning.Certificate(64, 3, 0.4, 1024, 12, [0.006, 0.02]),
            "bound": lambda: InputBound(**bound, **numbers, **counts),
        }


KINDS = ("tuning", "ensemble", "sensitivity", "identification", "certificate", "bound")
SLOW_KINDS = KINDS[1:4]  # each is a study of its own


@pytest.mark.slow_for(*SLOW_KINDS)
@pytest.mark.parametrize("kind", KINDS)
def test_a_notebook_shows_a_result_as_tables_with_every_text_escaped(results, kind):
    result = results[kind]()
    page = Page(result._repr_html_())
    assert {"table", "p"} & set(page.tags) and not {"script", "b"} & set(page.tags)
    rule = {w for w in str(result).split() if not w.strip("-")}  # under the heads of a table
    joined = " ".join(page.words)
    for word in set(str(result).split()) - rule - {":"}:
        bare = word.strip("(:)")  # an option in brackets is an element of its own
        assert word in page.words or bare in page.words or word in joined, word
    assert ("alert(1)" in joined) == (kind != "certificate")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ("tuning", "identification"))
def test_save_leaves_out_the_rig_file_of_a_class_without_a_name_with_a_note(
    results, kind, tmp_path, monkeypatch
):
    module = {"tuning": "tuned"}.get(kind, kind)
    monkeypatch.setattr(f"tuning.report.{module}.figures", lambda *_: {})
    with pytest.warns(UserWarning, match=r"rig\.toml is not written .*no name in a rig file"):
        names = {path.name for path in results[kind]().save(tmp_path)}
    assert {"result.json", "report.html"} <= names and "rig.toml" not in names
    assert names == {path.name for path in tmp_path.iterdir()}
    assert (
        "rig.toml is not written" in json.loads((tmp_path / "result.json").read_text())["message"]
    )
    assert "rig.toml is not written" in (tmp_path / "report.html").read_text()


OF_A_CASE = {  # {function of a case: its other arguments}
    **{name: {} for name in ("attack", "bound", "compare_controllers", "ensemble", "feasibility")},
    **{name: {} for name in ("sensitivity", "tune", "tune_robust", "validate")},
    **{"can_follow": {"draws": {}}, "least_offset": {"draws": {}}},
    **{"identify": {"log": None}, "predict": {"log": None}, "tune_by_rule": {"rule": "simc"}},
    "tradeoff": {"measure": "rise_time", "values": [9.0]},
    "tune_choices": {"choices": {}},
}


@pytest.mark.parametrize("name", OF_A_CASE)
def test_what_is_no_case_and_a_seed_that_is_none_are_refused(name):
    function, case = getattr(tuning, name), presets.find("cascaded/pi")
    for wrong in ("cascaded/pi", None, case.loop):
        with pytest.raises(InputError, match="must be a Case"):
            function(wrong, **OF_A_CASE[name])
    if "seed" in inspect.signature(function).parameters:
        for seed in (-1, 1.5, None):
            with pytest.raises(InputError, match="seed"):
                function(case, **OF_A_CASE[name], seed=seed)


@pytest.mark.parametrize("free", [3, {"controller.Kc": 1.0}, {3: (1.0, 2.0)}, ["controller.Kc"]])
def test_free_parameters_without_a_range_are_refused(free):
    with pytest.raises(InputError, match="free"):
        tuning.tune(presets.find("cascaded/pi"), nominal=True, free=free)

"""What a user writes in Python: names for components, solver options, results that are read."""

import abc

import jax
import numpy as np
import pytest

import jaxtank
import tuning
from jaxtank import rig
from jaxtank.controllers import Controller
from jaxtank.core.errors import InputError
from jaxtank.observers import Observer
from jaxtank.plants.base import Plant
from jaxtank.rig import components
from tuning.cli.main import main


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

    offset: np.ndarray = jaxtank.leaf("cm", "(n,) offset of each sensor")

    def step(self, state, tick, y):
        x = tuple(h - self.offset[i] for i, h in enumerate(y))
        return jaxtank.core.records.Estimate(x=x), state


RIG = """
case = "cascaded/pi"
name = "own"
[law]
kind = "proportional"
Kc = 2.0
bias = 4.0
divisor = 2
[observer]
kind = "offset"
offset = [0.01, 0.02]
[free]
"controller.Kc" = [0.1, 10.0]
[values]
"clock.dt" = 0.5
"clock.duration" = 450.0
[limits]
"""


QUICK = dict(starts=1, screening=2, iterations=3, validation=0)


@pytest.fixture(scope="module", autouse=True)
def own():
    """The case of RIG; the registry of rig files is put back after these tests."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("LAWS", "OBSERVERS", "REGISTERED"):
            known = getattr(components, name)
            patch.setattr(components, name, type(known)(known))
        rig.register("proportional", Proportional)
        rig.register("offset", Offset)
        yield rig.loads(RIG)


@pytest.fixture(scope="module")
def tuned(own):
    return tuning.tune(own, **QUICK)


def test_a_registered_controller_and_observer_are_read_and_written(own):
    assert isinstance(own.loop.controller, Proportional) and own.loop.controller.divisor == 2
    assert isinstance(own.loop.observer, Offset)
    for text in (rig.dump(own), rig.dump(own, tankwise=True), rig.complete(own)):
        again = rig.loads(text)
        assert jax.tree.structure(again.loop) == jax.tree.structure(own.loop)
        for one, other in zip(jax.tree.leaves(again.loop), jax.tree.leaves(own.loop)):
            np.testing.assert_array_equal(one, other)
        assert again.free == own.free


def test_save_writes_the_rig_file_of_a_registered_controller(tuned, tmp_path, monkeypatch):
    monkeypatch.setattr("tuning.report.tuning_figures.figures", lambda *_: {})
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
        (RIG.replace("Kc = 2.0\n", ""), r"needs Kc \[V/V\]: gain"),
        (RIG.replace("bias = 4.0\n", ""), "needs bias"),
        (RIG.replace("divisor = 2", "divisor = 0.5"), "law.divisor = 0.5: must be"),
        (RIG.replace("divisor = 2", "divider = 2"), "unknown key of .law. 'divider'"),
        (RIG.replace("Kc = 2.0", "Kc = [2.0]"), "law.Kc = .*one number"),
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

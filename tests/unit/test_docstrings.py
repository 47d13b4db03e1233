"""Docstrings: what a user calls has numpydoc sections, and every example of both packages runs."""

import doctest
import importlib
import inspect
import re
from enum import Enum
from pathlib import Path

import pytest
from helpers import registries_kept

import jaxtank
import tuning
from jaxtank import presets, rig

# What is public beyond the names that the packages themselves export.
NAMED = {presets: ("load", "find", "names"), rig: ("load", "dump", "register", "set_values")}
SECTIONS = {"Parameters", "Returns", "Examples"}
# Objects that functions return: the example is that of the function.
RESULTS = {
    *("Attack", "Trajectory", "Bound", "Certificate", "Ensemble", "Estimation", "Identification"),
    *("Answer", "Comparison", "Feasibility", "Judged"),
    *("Identifications", "Log", "ParameterChange", "Prediction", "TuningResult"),
}


def public():
    """{name: function or class} of what a user calls."""
    found = {f"{p.__name__}.{n}": getattr(p, n) for p in (jaxtank, tuning) for n in p.__all__}
    found |= {f"{p.__name__}.{n}": getattr(p, n) for p, names in NAMED.items() for n in names}
    return {name: thing for name, thing in found.items() if callable(thing)}


def lacking(thing):
    """The sections that the docstring of a function or class should have and has not."""
    text = inspect.getdoc(thing) or ""
    has = {s for s in re.findall(r"^(\w+)\n-{3,}$", text, re.M) if s in SECTIONS}
    if inspect.isclass(thing):  # fields carry their own descriptions (leaf, static)
        exempt = thing.__name__ in RESULTS or issubclass(thing, (Exception, Enum))
        wanted = set() if exempt else {"Examples"}
    else:
        signature = inspect.signature(thing)
        wanted = {"Returns", "Examples"} | ({"Parameters"} if signature.parameters else set())
        if signature.return_annotation in (None, "None"):
            wanted -= {"Returns"}
    return sorted(wanted - has)


def test_what_a_user_calls_has_the_sections_of_numpydoc():
    assert {n: missing for n, thing in public().items() if (missing := lacking(thing))} == {}


def test_a_docstring_without_sections_is_reported():
    def f(x):
        """Return x.

        Parameters
        ----------
        x : float
        """
        return x

    assert lacking(f) == ["Examples", "Returns"]


# seconds of compilation: what these examples show has tests of its own
LONG = {
    *("jaxtank.controllers.nmpc", "jaxtank.observers.moving_horizon"),
    *("jaxtank.loop.margins", "jaxtank.live.engine", "tuning.figures.comparison"),
    *("tuning.search.judged", "tuning.identification.design", "tuning.falsification.study"),
    *("tuning.uncertainty.study", "tuning.uncertainty.sensitivity_study"),
    *("jaxtank.analysis.linear_model", "jaxtank.analysis.steady_state", "tuning.search.tuner"),
    *("jaxtank.signals.inflows", "jaxtank.measures.functions", "jaxtank.loop.many"),
    *("tuning.identification.prediction", "tuning.identification.fit", "tuning.feasible.study"),
    *("tuning.identification.problem", "tuning.identification.batch"),
}


def modules_with_examples():
    for package in (jaxtank, tuning):
        root = Path(package.__file__).parent
        for path in sorted(root.rglob("*.py")):
            if ">>> " in path.read_text():
                parts = path.relative_to(root.parent).with_suffix("").parts
                name = ".".join(parts).removesuffix(".__init__")
                yield pytest.param(name, marks=[pytest.mark.slow] if name in LONG else [])


@pytest.mark.parametrize("name", list(modules_with_examples()))
def test_examples_run(name, tmp_path, monkeypatch):
    if name == "jaxtank.interop.gymnasium":
        pytest.importorskip("gymnasium")
    monkeypatch.chdir(tmp_path)
    module = importlib.import_module(name)
    with registries_kept():
        found = doctest.testmod(module, optionflags=doctest.ELLIPSIS)
    assert found.failed == 0 and found.attempted > 0

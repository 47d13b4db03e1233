"""What is written once has one caller: other code goes through it, so that no copy can differ."""

import ast
import dataclasses
import functools
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxtank
import tuning
from jaxtank.core.tree import with_values
from jaxtank.plants import state_coupled_four_tank
from jaxtank.plants.runge_kutta import advance

ROOTS = tuple(Path(p.__file__).parent for p in (jaxtank, tuning))
ONLY = {  # function or method: the one file that calls it
    "integrate": "jaxtank/plants/runge_kutta.py",
    "change": "jaxtank/plants/runge_kutta.py",
    "spill": "jaxtank/plants/runge_kutta.py",
    "shortfall": "jaxtank/plants/runge_kutta.py",
    "predict": "jaxtank/loop/step.py",
    "commanded": "jaxtank/loop/step.py",
}


def calls(tree):
    """Names of the functions and methods that a syntax tree calls, and of what it imports."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            found.update(a.name for a in node.names)
        elif isinstance(node, ast.Call):
            of_super = isinstance(node.func, ast.Attribute) and isinstance(
                node.func.value, ast.Call
            )
            if not of_super:  # a method of a plant may call that of its base class
                found.add(getattr(node.func, "attr", getattr(node.func, "id", "")))
    return found


@functools.cache
def calls_of(text):
    """As `calls`, of the text of a module."""
    return calls(ast.parse(text))


def callers(name, texts):
    return {path for path, text in texts.items() if name in calls_of(text)}


@pytest.fixture(scope="module")
def texts():
    """{path: text} of every module of both packages."""
    return {
        path.relative_to(root.parent).as_posix(): path.read_text()
        for root in ROOTS
        for path in root.rglob("*.py")
    }


@pytest.mark.parametrize("name", ONLY)
def test_one_file_calls_it_and_a_second_caller_is_found(texts, name):
    assert callers(name, texts) == {ONLY[name]}
    planted = f"def mine(plant, x):\n    return plant.{name}(x)\n"
    assert callers(name, texts | {"tuning/mine.py": planted}) == {ONLY[name], "tuning/mine.py"}


def test_one_function_decides_whether_a_run_draws_noise(texts):
    found = [path for path, text in texts.items() if "\ndef noisy(" in text]
    assert found == ["tuning/problem/scenarios.py"]


PLANT = dataclasses.replace(
    state_coupled_four_tank(15.0), overflow=True, bottom=True, rim=np.full(4, 0.5)
)  # so low that all tanks overflow


@pytest.mark.slow_for("midpoint", "rk4")
@pytest.mark.parametrize("integrator", ["rk4", "midpoint"])
def test_a_rolled_sample_is_the_unrolled_one(integrator):
    """Levels and lost volumes agree, also for a number of substeps that is traced."""
    x, u = tuple(0.1 * np.ones(4)), (30.0, 25.0)
    one = jax.jit(lambda x: advance(PLANT, integrator, 0.0, x, u, None, 2.0, 8))(x)
    two = jax.jit(lambda x: advance(PLANT, integrator, 0.0, x, u, None, 2.0, 8, rolled=True))(x)
    three = jax.jit(lambda x, n: advance(PLANT, integrator, 0.0, x, u, None, 2.0, n, rolled=True))(
        x, 8
    )
    assert np.sum(one.spilled) > 0.0
    for other in (two, three):
        for a, b in zip(one, other):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)


def test_overflow_is_taken_after_each_substep_and_volume_is_conserved():
    """What is pumped in is stored, drained or lost: with drains closed, stored and lost alone."""
    plant = PLANT
    closed = with_values(plant, {"drain": np.zeros(4), "orifice": np.zeros(len(plant.links))})
    u = (30.0, 25.0)
    found = advance(closed, "rk4", 0.0, (0.0,) * 4, u, None, 2.0, 8)
    stored = np.sum(np.asarray(plant.area) * np.asarray(found.x))
    pumped = 2.0 * np.sum(np.asarray(plant.pump_gain) * np.asarray(u))
    assert stored + np.sum(found.spilled) == pytest.approx(pumped, rel=1e-12)
    assert np.all(np.asarray(found.x) <= np.asarray(plant.rim))

"""Whole programs kept between processes: the same bits, and found only where all is the same."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
import tanks_in_a_row
from helpers import python

import jaxtank
from jaxtank import measures, presets
from jaxtank.loop import saved_rows
from jaxtank.loop.run import evaluate_compiled
from jaxtank.xla import jit, program_cache, signatures

SCRIPT = """
import json, sys, jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_log_compiles", True)
import jaxtank
from jaxtank import presets
if sys.argv[1] != "none":
    jaxtank.cache(sys.argv[1])
case = presets.find("khalid/laguerre")
clock = jaxtank.Clock(dt=case.clock.dt, duration=100 * case.clock.dt)
names = ["rms_error_total", "input_travel", "settling_time"]
found = jaxtank.evaluate(case.loop, clock, names)
slopes = jaxtank.sensitivities(case.loop, clock, names[:1], {"controller.r_w": 0.02})
run = jaxtank.simulate(case.loop, clock, save_every=10)
flat = [v for part in (found, *slopes[:2]) for v in part.values()] + [slopes[2], run.x, run.u]
print(json.dumps([[float(x).hex() for x in jax.numpy.ravel(v)] for v in flat]))
"""

LARGE = ["evaluate_compiled", "sensitivities_compiled", "simulate_compiled"]


def run(folder):
    """(what the script prints, names of the programs that it has compiled)."""
    env = {n: v for n, v in os.environ.items() if not n.startswith("JAX_")}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(folder)], capture_output=True, text=True, env=env
    )
    assert done.returncode == 0, done.stderr
    lines = [line for line in done.stderr.splitlines() if "Compiling" in line]
    large = [n for n in LARGE if n in " ".join(lines)]
    return json.loads(done.stdout), large


def whole(folder):
    return sorted(folder.glob(f"*/*{jit.ENDING}"))


@pytest.mark.slow
def test_a_program_that_is_known_is_not_traced_and_gives_the_same_bits(tmp_path):
    """And where an entry is damaged."""
    folder = tmp_path / "kept"
    plain, compiled = run("none")
    assert compiled == LARGE
    first, compiled = run(folder)
    assert len(compiled) == 3 and len(whole(folder)) == 3
    second, compiled = run(folder)
    assert compiled == [] and plain == first == second
    assert not list(folder.glob("*/*.tried"))
    one, other, _ = whole(folder)
    one.with_name(f"{one.name}.tried").touch()  # a process ended in its first run
    other.write_bytes(other.read_bytes()[:-50])
    third, compiled = run(folder)
    assert len(compiled) == 2 and third == first
    assert run(folder) == (first, [])


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(program_cache, "folder", tmp_path)
    monkeypatch.setattr(evaluate_compiled, "programs", {})
    return tmp_path


def evaluated(loop, names=("iae",), dt=4.0, duration=104.0):
    return jaxtank.evaluate(loop, jaxtank.Clock(dt=dt, duration=duration), list(names))


def names_of(folder):
    return {path.name for path in folder.glob(f"*{jit.ENDING}")}


@pytest.mark.extended
def test_whatever_changes_a_program_changes_its_name(folder, monkeypatch):
    loop = presets.find("cascaded/pi").loop
    evaluated(loop)
    assert len(names_of(folder)) == 1
    evaluated(jaxtank.with_values(loop, {"controller.Kc": 2.0}))  # a number is no other program
    assert len(names_of(folder)) == 1
    evaluated(loop, dt=2.0)
    evaluated(loop, names=("ise",))
    # a switch of the plant, which is static
    evaluated(
        dataclasses.replace(
            loop, plant=dataclasses.replace(loop.plant, overflow=not loop.plant.overflow)
        )
    )
    count = len(names_of(folder))
    assert count == 4
    evaluate_compiled.programs.clear()
    monkeypatch.setattr(signatures, "_process", lambda: ["another version"])
    evaluated(loop)
    assert len(names_of(folder)) == count + 1


def test_a_class_or_a_measure_of_the_users_own_is_never_kept(folder):
    loop = presets.find("cascaded/pi").loop

    @jaxtank.component
    class Own(type(loop.controller)):
        pass

    fields = {f.name: getattr(loop.controller, f.name) for f in dataclasses.fields(loop.controller)}
    # of another length: what is not kept is in the cache of jax, from which nothing is kept
    evaluated(dataclasses.replace(loop, controller=Own(**fields)), duration=100.0)
    assert names_of(folder) == set()
    spec = measures.MEASURES["iae"]._replace(doc="another")
    measures.register("own_measure", spec)
    try:
        evaluated(loop, names=("own_measure",), duration=100.0)
    finally:
        del measures.MEASURES["own_measure"]
    assert names_of(folder) == set()


@pytest.mark.extended
def test_inside_a_transformation_nothing_is_kept(folder):
    loop = presets.find("cascaded/pi").loop

    def cost(gain):
        here = jaxtank.with_values(loop, {"controller.Kc": gain})
        return evaluated(here, names=("rms_error_total",))["rms_error_total"]

    step = 1e-6
    slope = float(jax.grad(lambda k: cost(k[None]))(np.float64(1.0)))
    difference = (cost(np.array([1.0 + step])) - cost(np.array([1.0 - step]))) / (2 * step)
    assert slope == pytest.approx(float(difference), rel=1e-5)
    assert len(names_of(folder)) == 1  # that of the two runs


def test_a_structure_of_results_is_read_as_it_was_written():
    case = presets.find("cascaded/pi")
    shape = lambda loop: saved_rows.simulate_compiled(loop, case.clock, None, 1)
    structure = jax.tree.structure(jax.eval_shape(shape, case.loop))
    words = jit._words(jax.tree.unflatten(structure, range(structure.num_leaves)))
    read = jit._tree(json.loads(json.dumps(words)))
    assert jax.tree.structure(read) == structure and jax.tree.leaves(read)[:2] == [0, 1]
    with pytest.raises(signatures.Unknown):
        jit._tree(["os:stat_result", {}])


def test_names_of_static_values_are_exact():
    of = signatures.words_of
    assert of(1) != of(1.0) != of("1") and of(0.0) != of(-0.0) and of((1,)) != of([1])
    assert of(np.arange(3)) != of(np.arange(4)) and of({"a": 1}) != of({"a": 2})
    for unknown in (object(), lambda: None, os.environ):
        with pytest.raises(signatures.Unknown):
            of(unknown)


@jit.compiled("power", keep=True)
def _raised(x, power):
    return x**power


@pytest.mark.extended_for("None")
@pytest.mark.parametrize("where", [None, "folder"])
def test_a_process_holds_a_bounded_number_of_programs(where, monkeypatch, tmp_path):
    """Those used last, where they are kept; all are dropped together where jax holds them."""
    monkeypatch.setattr(jit, "MOST", 4)
    monkeypatch.setattr(program_cache, "folder", where and tmp_path)
    _raised.programs.clear()
    _raised.clear_cache()
    for power in range(2, 30):
        assert float(_raised(1.5, power)) == 1.5**power
        assert float(_raised(1.5, 2)) == 2.25
        assert len(_raised.programs) <= 4 and _raised.compiled._cache_size() <= 4
    powers = [dict(statics)["power"] for _, _, statics, _ in _raised.programs]
    assert powers == ([27, 28, 29, 2] if where else [])


MANY = """
import jax
jax.config.update("jax_enable_x64", True)
from jaxtank import evaluate, presets, rig
from tanks_in_a_row import rig_text
for samples in range(20, 100):
    case = rig.set_values(rig.loads(rig_text(6)), {"clock.duration": float(samples)})
    evaluate(case, ["rms_error_total"])
print(open("/proc/self/maps").read().count(chr(10)))
# of this process alone: getrusage counts what the one that started it had
(line,) = (line for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(line.split()[1])
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="memory maps are counted on Linux")
def test_eighty_structures_take_the_memory_of_some():
    """1,900 and 0.55 GB; without a bound 8,400 and 0.98 GB. Linux ends a process at 65,530 maps."""
    folder = Path(tanks_in_a_row.__file__).parent
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *filter(None, sys.path)])}
    maps, kilobytes = map(int, python(MANY, env=env).split())
    assert maps < 4_000 and kilobytes < 750_000

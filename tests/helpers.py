"""What several test files use: where files are, ranks of folders, small routines. On pytest's path
(pyproject.toml), so that every test imports it by name.
"""

import collections
import contextlib
import ctypes
import dataclasses
import functools
import io
import json
import logging
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtank import presets, rig
from jaxtank.core.records import Estimate, Tick
from jaxtank.export import source
from jaxtank.export.program import program
from jaxtank.measures import accumulators, catalogue
from jaxtank.presets import Free
from jaxtank.rig import components
from tuning.cli import main

ROOT = Path(__file__).parents[1]
TESTS = ROOT / "tests"
DATA = TESTS / "data"
RIGS = DATA / "rigs"
CASCADED_TANKS = DATA / "cascaded_tanks.csv"  # its source and licence: data/README.md
NODE = shutil.which("node")

KINDS = (
    *("calofir/backstepping", "cascaded/open-loop", "cascaded/pi", "dts200/pi"),
    *("gouta2015/backstepping", "gouta2015/backstepping-boxqp", "gouta2015/backstepping-ff"),
    *("gouta2015/backstepping-observer", "gouta2015/ngpc", "gouta2015/ngpc-observer"),
    *("gouta2015/nmpc", "gouta2015/nmpc-preview", "gouta2022/chadpc", "gouta2022/chadpc-printed"),
    *("gouta2022/chadpc-trapezoid", "gouta2022/enmpc", "gouta2022/enmpc-printed"),
    *("gouta2022/fopi", "gouta2022/pi", "gouta2022/pi-ff", "khalid/gpc", "khalid/gpc-constrained"),
    *("khalid/gpc-mimo", "khalid/gpc-mimo-constrained", "khalid/laguerre"),
    *("khalid/laguerre-constrained", "khalid/laguerre-mimo", "khalid/laguerre-mimo-constrained"),
    *("mirakhorli/hybrid", "mirakhorli/hybrid-fitted", "mirakhorli/lqi", "mirakhorli/sfc"),
    *("mirakhorli/smc", "mirakhorli/smc-printed"),
)
"""A preset of each controller, observer and choice between their forms; the others differ in
numbers alone.
"""

# Folders of both packages: a folder imports those of its own or of an earlier line.
RANKS = [
    "jaxtank.core jaxtank.xla",
    "jaxtank.views",
    "jaxtank.signals jaxtank.instruments jaxtank.plants",
    "jaxtank.analysis",
    "jaxtank.controllers jaxtank.observers jaxtank.measures jaxtank.safety",
    "jaxtank.loop",
    "jaxtank.case",
    "jaxtank.presets",
    "jaxtank.rig jaxtank.plots jaxtank.export jaxtank.interop",
    "jaxtank.limits jaxtank.bounds jaxtank.task",
    "jaxtank.live",
    "jaxtank.__main__",
    "tuning.views",
    "tuning.problem tuning.storage",
    "tuning.cluster",
    "tuning.uncertainty tuning.identification tuning.optimal_input",
    "tuning.feasible",
    "tuning.search tuning.falsification",
    "tuning.report",
    "tuning.figures",
    "tuning.bench",
    "tuning.cli",
]
RANK = {folder: rank for rank, folders in enumerate(RANKS) for folder in folders.split()}


PROGRAMMES = {"gouta2015/nmpc": 220, "moving_horizon": 220}
"""{case that solves programmes in the loop: samples that are replayed by slow interpreters}."""


def opened(name):
    """A case of a paper ("paper/case"), or of a rig file of the tests, by its name alone."""
    return presets.find(name) if "/" in name else rig.open_case(str(RIGS / f"{name}.toml"))


def faulty_pictures(usual):
    """In place of a function that draws: a text that matplotlib cannot set, and one that fails."""

    def unset(*args):
        drawn = usual(*args)
        for figure in drawn.values() if isinstance(drawn, dict) else [drawn]:
            figure.suptitle(r"$\x{$")
        return drawn

    def undrawn(*_):
        from matplotlib import pyplot

        pyplot.figure()
        raise ZeroDivisionError

    return unset, undrawn


ONE_FUNCTION = 'xla_cpu_small_call="true"'


def loops_in(compiled):
    """Number of loops that a compiled program runs as one function."""
    return compiled.as_text().count(ONE_FUNCTION)


@jax.jit
def estimates_along(observer, x0, ys, us, dt):
    """The Estimate (x, d, coefficients: (samples, .) arrays or None) of an observer after each of
    the readings (samples, n), with inputs (samples, m) after them, from levels x0 (n).
    """

    def body(state, now):
        y, u = now
        tick = Tick(t=0.0, r=(), dr=(), ddr=(), dt=dt)
        estimate, state = observer.step(state, tick, tuple(y))
        state = observer.predict(state, tick, tuple(u), tuple(u))
        rows = [jnp.stack(list(v)) if len(v) else None for v in estimate]
        return state, Estimate(*rows)

    return jax.lax.scan(body, observer.init(tuple(x0)), (ys, us))[1]


@functools.partial(jax.jit, static_argnums=1)
def sampled(reference, clock):
    """What `reference.sample(clock)` gives, as one program: part by part it takes ten times as long
    to compile.
    """
    return reference.sample(clock)


def signals_of(case):
    """Setpoints of a case and their first and second rates, (samples, outputs) each."""
    parts = sampled(case.loop.reference, case.clock)
    return [np.stack([np.asarray(v) for v in part], axis=1) for part in parts]


def in_metres(plant):
    """The same rig of centimetres with lengths in m and flows in m^3/s."""
    powers = dict(area=2, drain=2, orifice=2, pipe=2, pump_gain=3, gravity=1, rim=1, knee=1)
    leaves = {name: getattr(plant, name) * 1e-2**power for name, power in powers.items()}
    return dataclasses.replace(plant, **leaves, units=("m", "V"))


class Output(NamedTuple):
    """What a command returned and printed."""

    code: int
    out: str
    err: str

    @property
    def json(self):
        """The one object on stdout; refuses NaN and infinity, which are not JSON."""
        return json.loads(self.out, parse_constant=lambda word: pytest.fail(f"{word} is not JSON"))

    @property
    def errors(self):
        """stderr without notes, as that changes come after the end of a run cut short."""
        lines = self.err.splitlines(keepends=True)
        return "".join(line for line in lines if not line.startswith("jaxtank: note: "))


def command(*words):
    """Run the command in this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main.main(list(words))
    return Output(code, out.getvalue(), err.getvalue())


@contextlib.contextmanager
def no_live_page():
    """Reports are written without the live page in a frame, which takes most of their time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tuning.report.html._frame", lambda _: "")
        yield


def rk4(rate, x, h):
    """The state after a step h of the classical Runge-Kutta method, in NumPy."""
    a = rate(x)
    b = rate(x + 0.5 * h * a)
    c = rate(x + 0.5 * h * b)
    return x + h / 6.0 * (a + 2.0 * b + 2.0 * c + rate(x + h * c))


def python(code, *words, **options):
    """What a program prints in a process of its own, which must end well."""
    pipes = {"capture_output": True, "text": True, "timeout": 600, **options}
    done = subprocess.run([sys.executable, "-c", code, *map(str, words)], **pipes)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout.strip()


def assert_same_tree(a, b):
    """Components, static fields and absent leaves agree, and every leaf to the last bit."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b)):
        np.testing.assert_array_equal(one, other)


def assert_same_case(a, b):
    """Names, clocks, every leaf and static field, limits, free parameters and objective agree."""
    assert (a.name, a.clock) == (b.name, b.clock)
    assert_same_tree(a.loop, b.loop)
    assert a.limits.keys() == b.limits.keys()
    assert all(np.array_equal(limit, b.limits[measure]) for measure, limit in a.limits.items())
    assert {n: Free(*s) for n, s in a.free.items()} == {n: Free(*s) for n, s in b.free.items()}
    assert dict(a.objective) == dict(b.objective)


REGISTRIES = (
    *(role.classes for role in components.ROLES.values()),
    components.REGISTERED,
    catalogue.MEASURES,
    accumulators.ACCUMULATORS,
    presets._ADDED,
    source.LANGUAGES,
)
"""Where classes, measures, papers and languages of a user's own are registered."""


@contextlib.contextmanager
def registries_kept():
    """Take out afterwards what is registered inside."""
    papers = list(presets.PAPERS)
    before = [dict(t) if isinstance(t, dict) else set(t) for t in REGISTRIES]
    try:
        yield
    finally:
        for table, old in zip(REGISTRIES, before):
            table.clear()
            table.update(old)
        presets.PAPERS[:] = papers
        presets._load.cache_clear()


def node(script, given=None):
    """What a script prints, as JSON; it knows `given` as GIVEN."""
    text = f"const GIVEN = {json.dumps(given)};\n{script}"
    done = subprocess.run([NODE, "-"], input=text, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def programs_in(jaxpr):
    """A program and all those that it calls."""
    yield jaxpr
    for equation in jaxpr.eqns:
        for value in equation.params.values():
            for inner in value if isinstance(value, tuple | list) else [value]:
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from programs_in(inner)


LISTED = re.compile(r"Compiling (?:jit\()?(\w+)\)? with global shapes")


@contextlib.contextmanager
def programs_compiled(cold=True):
    """A Counter of how often each program is compiled inside; cold: where none is at hand."""
    counter = collections.Counter()
    handler = logging.Handler()
    logger = logging.getLogger("jax")

    def emit(record):
        if listed := LISTED.match(record.getMessage()):
            counter[listed[1]] += 1

    handler.emit = emit
    logger.addHandler(handler)
    if cold:
        jax.clear_caches()
    jax.config.update("jax_log_compiles", True)  # of every thread, as `jax.log_compiles` is not
    try:
        yield counter
    finally:
        jax.config.update("jax_log_compiles", False)
        logger.removeHandler(handler)


PROCESS = """
units = ["m", "%"]
tank = [
    { area = 0.5, rim = 1.2, level = 0.4 },
    { area = 0.25, rim = 1.0, drain = 4.15e-4, level = 0.5 },
]
orifice = [{ from = 1, to = 2, area = 3.2e-4 }]
pump = [{ gain = 2.64e-5, to = 1, high = 100.0 }]
plant = { outputs = [2], gravity = 9.81 }
controller = { kind = "open-loop", initial = [40.0], changes = [[10.0, 1, 50.0]] }
reference = { initial = [0.5] }
values = { "clock.dt" = 0.1 }
"""
"""Two tanks in m with a pump in %, of which the tests of logs make data."""


GCC = shutil.which("gcc")
FLAGS = ["-O1", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-pedantic", "-Werror"]
needs_gcc = pytest.mark.skipif(GCC is None, reason="no gcc on this machine")

SERIES = """
units = ["m", "-"]
reachable = false
tank = [
    { area = 1.0, rim = 3.0, level = 1.0 },
    { area = 0.5, rim = 3.0, level = 1.0, drain = 0.01 },
]
orifice = [{ from = 1, to = 2, area = 0.01 }]
pump = [{ gain = 0.1, to = 1, high = 1.0, initial = 0.44 }]
plant = { gravity = 9.81, outputs = [2] }
reference = { initial = [1.0], changes = [[5.0, 1, 2.0], [60.0, 1, 0.8]], ramp = 0.0 }
values = { "clock.dt" = 0.5, "clock.duration" = 150.0 }
"""
"""A rig of two tanks in series, the second one controlled, as a rig file without a controller."""

INTEGRATOR = """
units = ["m", "-"]
reachable = false
tank = [{ area = 1.0, rim = 5.0, level = 0.98, inflow = -0.01 }]
pump = [{ gain = 0.02, to = 1, low = 0.0, high = 1.0, initial = 0.5 }]
plant = { gravity = 9.81 }
reference = { initial = [1.0], changes = [] }
values = { "clock.dt" = 0.05, "clock.duration" = 300.0, "actuator.delay" = 5.0 }
"""
"""A tank that only stores, above a constant outflow, whose pump has a dead time of 5 s."""

ONE_TANK = """
name = "one tank"
tank = [{ area = 20.0, rim = 3.0, drain = 2.0, level = 1.0 }]
pump = [{ gain = 5.0, to = 1, low = 0.0, high = 2.0, initial = 0.4 }]
plant = { gravity = 0.5 }
law = { kind = "pid", Kc = 1.0, Ti = 4.0, Tt = 5.0 }
reference = { initial = [1.0], changes = [[1.0, 1, 2.6]], ramp = 0.0 }
values = { "clock.dt" = 0.1, "clock.duration" = 40.0 }
limits = { max_level = 2.7 }
uncertain = { "plant.drain" = 0.1, "plant.pump_gain" = 0.1 }
free = { "controller.Kc" = [0.05, 50.0], "controller.Ti" = [0.5, 100.0] }
"""
"""A tank whose outflow at 1 cm is 2 cm^3/s, with a PI controller: what is studied anywhere on it
compiles in a fifth of the time of a case of four tanks.
"""


class Compiled:
    """An exported controller as Python functions."""

    def __init__(self, case, folder, precision="double"):
        for file, text in source.files(case, "c", precision, name="law").items():
            (folder / file).write_text(text)
        library = folder / "law.so"
        words = [GCC, *FLAGS, "-std=c99", "-shared", "-fPIC", "-o", library, folder / "law.c"]
        compiled = subprocess.run([*words, "-lm"], capture_output=True, text=True)
        assert compiled.returncode == 0, compiled.stderr
        self.library = ctypes.CDLL(str(library))
        self.type = np.dtype(precision if precision == "double" else np.float32)
        self.real = ctypes.c_double if precision == "double" else ctypes.c_float
        shapes = [(p.name, p.value.shape) for p in program(case).parameters]
        count = sum(int(np.prod(shape)) for _, shape in shapes)
        size = self.real * count
        self.defaults = np.array(size.in_dll(self.library, "law_defaults"))
        ends = np.cumsum([int(np.prod(shape)) for _, shape in shapes])
        self.slices = {n: slice(e - int(np.prod(s)), e) for (n, s), e in zip(shapes, ends)}
        self.state = np.zeros(20_000, dtype=self.type)  # larger than that of any controller

    def set(self, values):
        """The parameters with some of them changed."""
        p = self.defaults.copy()
        for name, value in values.items():
            p[self.slices[name]] = np.ravel(value)
        return p

    def pointer(self, array):
        return None if array is None else array.ctypes.data_as(ctypes.c_void_p)

    def init(self, y=None, u=None, p=None):
        """Begin from levels and inputs, those of the case for None."""
        self.library.law_init(*map(self.pointer, (self.state, p, y, u)))

    def step(self, t, y, r, dr, ddr, manual=None, p=None):
        """The inputs of a sample."""
        u = np.zeros(16, dtype=self.type)
        arrays = map(self.pointer, (y, r, dr, ddr, manual, u))
        self.library.law_step(self.pointer(self.state), self.pointer(p), self.real(t), *arrays)
        return u

    def run(self, case, run, signals, p=None):
        y, r, dr, ddr = (np.ascontiguousarray(v, dtype=self.type) for v in (run.y, *signals))
        self.init(p=p)
        out = [self.step(run.t[k], y[k], r[k], dr[k], ddr[k], p=p) for k in range(len(y))]
        return np.stack(out)[:, : case.loop.plant.pumps]

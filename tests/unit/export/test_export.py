"""Exported laws, compiled by gcc, against the law in the loop they were made from: 10,000 samples
of every law of every paper.
"""

import copy
import dataclasses
import functools
import json
import math
import re
import shutil
import subprocess
import tempfile
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import FLAGS, GCC, KINDS, PROGRAMMES, SERIES, Compiled, needs_gcc, opened, signals_of

import jaxtank
from jaxtank import presets, rig
from jaxtank.analysis import elimination
from jaxtank.controllers.base import Controller
from jaxtank.core import units
from jaxtank.core.errors import InputError
from jaxtank.core.tree import component
from jaxtank.export import lowering
from jaxtank.export.c import C
from jaxtank.export.program import program
from jaxtank.export.source import LANGUAGES, export
from jaxtank.plants.network import network
from tuning.cli import main

SAMPLES = 10_000
# one case of every law, observer and way of saturating; the rest differ in numbers alone
QUICK = [
    *("gouta2015/ngpc", "gouta2015/backstepping-boxqp", "gouta2022/chadpc", "gouta2022/fopi"),
    *("calofir/backstepping", "cascaded/pi", "mirakhorli/hybrid", "mirakhorli/smc"),
]
SLOW = [
    name
    for name in KINDS
    if name not in (*QUICK, "cascaded/open-loop", "gouta2015/nmpc-preview")  # it reads ahead
    and "printed" not in name
]


@functools.cache
def replayed(name, noise=1e-4, values=(), filtered=False):
    """(Case, Trajectory, setpoints with rates) of a run of 10,000 samples as host arrays; noise: as
    a share of the highest rim; values: what is set, as pairs; filtered: with a safety filter.
    """
    case = opened(name)
    noise = noise * float(np.max(np.asarray(case.loop.plant.rim)))
    values = {
        "clock.duration": (SAMPLES - 1) * case.clock.dt,
        "sensor.noise": noise,
        "actuator.delay": 0.0,
        **dict(values),
    }
    case = rig.filtered(rig.set_values(case, values), filtered or None)
    run = jax.tree.map(np.asarray, jaxtank.simulate(case.loop, case.clock, jax.random.key(1)))
    return case, run, signals_of(case)


@pytest.mark.slow
@needs_gcc
@pytest.mark.parametrize("name", [*QUICK, *SLOW])
def test_c_gives_the_inputs_of_the_loop(name, tmp_path):
    """Within 1e-9 of the pumps' range."""
    case, run, signals = replayed(name)
    reported = Compiled(case, tmp_path).run(case, run, signals)
    reach = max(1.0, float(np.abs(run.applied).max()))
    assert len(reported) == SAMPLES and np.ptp(run.applied) > 0
    np.testing.assert_allclose(reported, run.applied, atol=1e-9 * reach, rtol=0)


@pytest.mark.extended
@needs_gcc
def test_c_has_the_safety_filter_of_the_loop(tmp_path):
    """Within 1e-9 of the pumps' range, of a run in which the filter acts."""
    case, run, signals = replayed("cascaded/pi", filtered=True)
    applied = Compiled(case, tmp_path).run(case, run, signals)
    high = float(case.loop.actuator.high[0])
    assert np.any((run.command > run.applied + 0.1) & (run.applied < high - 0.1))
    np.testing.assert_allclose(applied, run.applied, atol=1e-9 * high, rtol=0)


DELAYED = (("actuator.delay", 40.0),)  # ten samples of cascaded/pi


@pytest.mark.slow
@needs_gcc
def test_c_has_the_safety_filter_that_predicts_over_the_dead_time(tmp_path):
    """Within 1e-9 of the pumps' range, where the cap is another than that of the readings alone."""
    case, run, signals = replayed("cascaded/pi", values=DELAYED, filtered=True)
    guard, high = case.loop.safety_filter, float(case.loop.actuator.high[0])
    assert guard.predicted == 10
    capped = (run.command > run.applied + 0.1) & (run.applied < high - 0.1)
    assert capped.sum() > 100
    applied = Compiled(case, tmp_path).run(case, run, signals)
    np.testing.assert_allclose(applied, run.applied, atol=1e-9 * high, rtol=0)
    # the inputs under way matter: a state that forgets them gives other caps
    dry = [np.zeros(10)]
    k = int(np.flatnonzero(capped)[-1])
    y, now = tuple(run.y[k]), (float(run.command[k, 0]),)
    (u,), _ = guard.apply(case.loop.actuator, now, None, y, case.clock.dt, dry)
    assert abs(float(u) - run.applied[k, 0]) > 0.1


@pytest.mark.slow
@needs_gcc
def test_a_programme_of_many_variables_gives_the_inputs_of_the_loop(tmp_path, monkeypatch):
    """As above 40 variables, where loops find the factor; of 4, which compile in less time."""
    monkeypatch.setattr(elimination, "UNROLLED", 3)
    case = presets.find("khalid/laguerre-constrained")
    case = rig.set_values(case, {"clock.duration": 300 * case.clock.dt, "controller.rows": 3})
    run = jax.tree.map(np.asarray, jaxtank.simulate(case.loop, case.clock))
    reported = Compiled(case, tmp_path).run(case, run, signals_of(case))
    assert np.ptp(run.applied) > 0.1 * np.abs(run.applied).max()
    np.testing.assert_allclose(
        reported, run.applied, atol=1e-9 * float(np.abs(run.applied).max()), rtol=0
    )


TUNED = (("controller.Tp", 1.63), ("observer.l", (0.257, 0.115)))  # gouta2022 notes S10


@pytest.mark.extended
@pytest.mark.slow_for(
    "gouta2015/backstepping-values0-0.0001",
    "gouta2022/chadpc-values1-0.0001",
    "gouta2022/chadpc-values2-0.0002",
    "mirakhorli/hybrid-values3-0.0001",
)
@needs_gcc
@pytest.mark.parametrize(
    ("name", "values", "share"),
    [
        ("gouta2015/backstepping", (), 1e-4),
        ("gouta2022/chadpc", TUNED, 1e-4),
        # the published observer, l = 10 1/s, magnifies what single precision cuts off a level
        ("gouta2022/chadpc", (), 2e-4),
        ("mirakhorli/hybrid", (), 1e-4),
        ("cascaded/pi", (), 1e-4),
        pytest.param("khalid/laguerre", (), 1e-4, marks=pytest.mark.slow),
    ],
)
def test_c_in_single_precision(name, values, share, tmp_path):
    """Within 1e-4 of the pumps' range."""
    case, run, signals = replayed(name, values=values)
    reported = Compiled(case, tmp_path, "float").run(case, run, signals)
    np.testing.assert_allclose(
        reported, run.applied, atol=share * float(np.abs(run.applied).max()), rtol=0
    )


def test_numbers_beyond_single_precision_are_its_largest_and_smallest():
    largest = float(np.finfo(np.float32).max)
    for number, text in ((1e300, largest), (-1e300, -largest), (1e-300, 1.1754943508222875e-38)):
        assert C("float").value(number).strip("()") == f"{text!r}f"
        assert C("double").value(number).strip("()") == repr(number)


NODE = shutil.which("node")
needs_node = pytest.mark.skipif(NODE is None, reason="no node on this machine")

REPLAY = """
const d = JSON.parse(require("fs").readFileSync(0)), s = law.init(d.start, d.u);
const out = d.t.map((t, k) => law.step(s, t, d.y[k], d.r[k], d.dr[k], d.ddr[k]));
console.log(JSON.stringify(out));
"""


def run_node(text, data=None):
    """What a script of JavaScript prints, as JSON."""
    with tempfile.NamedTemporaryFile("w", suffix=".js") as file:  # too long for a command line
        file.write(text)
        file.flush()
        words = {"input": json.dumps(data), "capture_output": True, "text": True, "timeout": 300}
        done = subprocess.run([NODE, file.name], **words)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def inputs_of(case, run, signals):
    """Inputs (samples, pumps) that the exported controller gives."""
    data = {name: np.asarray(v).tolist() for name, v in zip(("r", "dr", "ddr"), signals)}
    data |= {"t": run.t.tolist(), "y": run.y.tolist(), "start": np.asarray(case.loop.x0).tolist()}
    data["u"] = np.asarray(case.loop.actuator.initial).tolist()
    return np.array(run_node(export(case, "js", name="law") + REPLAY, data))


PROPORTIONAL = """
case = "cascaded/pi"
controller = { kind = "pid", Kc = 2.0, bias = 1.5 }
"""


@pytest.mark.extended_for("m")
@pytest.mark.slow_for("c")
@pytest.mark.parametrize(
    "lang", [pytest.param("c", marks=needs_gcc), "m", pytest.param("js", marks=needs_node)]
)
def test_a_proportional_controller_is_exported(lang, tmp_path, capsys):
    """Of the command, saturated at times: bias + Kc e within the limits of the pump."""
    path = tmp_path / "p.toml"
    path.write_text(PROPORTIONAL)
    assert main.main(["show", str(path)]) == 0
    assert re.search(r"controller.Ti +not in use", capsys.readouterr().out)
    assert main.main(["export", str(path), "--lang", lang, "--name", "law"]) == 0
    case = rig.load(path)
    run = jaxtank.simulate(case.loop, case.clock)
    run = jax.tree.map(np.asarray, run)
    expected = np.clip(1.5 + 2.0 * (run.r - run.y[:, list(case.loop.plant.outputs)]), 0.0, 10.0)
    np.testing.assert_allclose(run.applied, expected, atol=1e-9)
    assert 0 < np.mean((expected <= 0.0) | (expected >= 10.0)) < 1
    assert capsys.readouterr().out.strip() == export(case, lang, name="law").strip()
    signals = (run.r, 0.0 * run.r, 0.0 * run.r)
    if lang == "c":
        inputs = Compiled(case, tmp_path).run(case, run, signals)
    elif lang == "js":
        inputs = inputs_of(case, run, signals)
    else:
        controller, s, inputs = matlab(export(case, "m")), None, []
        for k in range(len(run.t)):
            last = inputs[-1] if inputs else list(map(float, case.loop.actuator.initial))
            u, s = controller(s, run.t[k], run.y[k], *(v[k] for v in signals), last)
            inputs.append(u)
    np.testing.assert_allclose(inputs, expected, atol=1e-9)


@needs_node
@pytest.mark.parametrize(
    "name",
    [
        "cascaded/pi",
        *(
            pytest.param(n, marks=pytest.mark.slow)
            for n in (
                *("gouta2022/chadpc", "gouta2022/fopi", "mirakhorli/hybrid", "mirakhorli/smc"),
                *PROGRAMMES,
            )
        ),
    ],
)
def test_javascript_gives_the_inputs_of_the_loop(name):
    """Within 1e-9 of the pumps' range, over 10,000 samples; less of a programme in each."""
    case, run, signals = replayed(name)
    first = lambda tree: jax.tree.map(lambda a: a[: PROGRAMMES.get(name, SAMPLES)], tree)
    run, reach = first(run), max(1.0, float(np.abs(run.applied).max()))
    found = inputs_of(case, run, first(signals))
    np.testing.assert_allclose(found, run.applied, atol=1e-9 * reach, rtol=0)


@pytest.mark.slow
@needs_node
@needs_gcc
def test_javascript_and_c_of_a_quadratic_programme_agree(tmp_path):
    case, run, signals = replayed("gouta2015/backstepping-boxqp")
    c = Compiled(case, tmp_path).run(case, run, signals)
    np.testing.assert_allclose(inputs_of(case, run, signals), c, atol=1e-10)


def test_a_function_is_not_called_what_javascript_has():
    case = replayed("cascaded/pi")[0]
    with pytest.raises(InputError, match="has this name already"):
        export(case, "js", name="function")


def indexed(line):
    """A statement of MATLAB with the entries of its arrays as those of Python."""
    closes, words, at = [], [], 0  # for each open bracket: how it is closed
    for token in re.finditer(r"\b(?:s|y|r|dr|ddr|u|[a-z]\d+)\(|[()]", line):
        words.append(line[at : token.start()])
        at = token.end()
        if token[0] == ")":
            words.append(closes.pop())
        else:
            closes.append(") - 1]" if token[0] != "(" else ")")
            words.append(f"{token[0][:-1]}[int(" if token[0] != "(" else "(")
    return "".join([*words, line[at:]])


OF_MATLAB = (
    (r"~=", "!="),
    (r"&&", " and "),
    (r"\|\|", " or "),
    (r"~", " not "),
    (r"\^", "**"),
    (r"isempty\(s\)", "s is None"),
    (r"zeros\(1, (\d+)\)", r"np.zeros(\1)"),
    (r"^for (\w+) = (\d+):(\d+)$", r"for \1 in range(\2, \3 + 1)"),
    (r"^while true$", "while True"),
    (r"^if (.*), (.*); end$", r"if \1: \2"),
    (r"^(\w+) = ([a-z]\d+)$", r"\1 = copy(\2)"),
)


def matlab(text):
    """A generated MATLAB function as a Python one, by rewriting its few kinds of statement;
    independent of the printer of C.
    """
    lines, depth = [], 1
    body = text.split("\n\nfunction out")[0].replace(" ...\n", " ")
    for line in body.splitlines()[1:]:
        line = line.strip().rstrip(";")
        if not line or line.startswith("%"):
            continue
        if line in ("end", "else"):
            depth -= 1
            if line == "end":
                continue
        for pattern, words in OF_MATLAB:
            line = re.sub(pattern, words, line)
        line = indexed(line)
        opens = line.startswith(("if ", "for ", "while ")) and ": " not in line
        lines.append("    " * depth + line + (":" if opens else ""))
        depth += opens
    same = "sqrt exp log tanh sin cos floor erf erfc log1p expm1 tan asin acos atan atan2 sinh cosh"
    same += " asinh acosh atanh ceil isfinite"
    matrix = lambda rows, columns, values: np.reshape(values, (rows, columns))
    known = {name: getattr(math, name) for name in same.split()} | {
        "pick": lambda c, yes, no: yes if c else no,
        **{"abs": abs, "max": max, "min": min, "round": round, "double": float},
        **{"true": True, "false": False, "Inf": math.inf, "NaN": math.nan},
        **{"rem": math.fmod, "fix": lambda v: math.trunc(float(v)), "sign": np.sign},
        "nthroot": lambda v, n: math.copysign(abs(v) ** (1 / n), v),
        "sqrt": lambda v: math.sqrt(v) if v >= 0 else math.nan,
        **{"np": np, "copy": copy.copy},
        "product_": lambda m, k, n, a, b: np.ravel(matrix(m, k, a) @ matrix(k, n, b)),
        "cholesky_": lambda n, a: np.ravel(np.linalg.cholesky(matrix(n, n, a))),
        **dict.fromkeys(
            ("forward_", "solve_"),
            lambda n, k, a, b: np.ravel(np.linalg.solve(matrix(n, n, a), matrix(n, k, b))),
        ),
        "backward_": lambda n, k, a, b: np.ravel(
            np.linalg.solve(matrix(n, n, a).T, matrix(n, k, b))
        ),
    }
    exec("def law(s, t, y, r, dr, ddr, u):\n" + "\n".join(lines) + "\n    return u, s", known)
    return known["law"]


@pytest.mark.extended_for("gouta2022/chadpc-values1")
@pytest.mark.slow_for(
    "gouta2015/backstepping-values0", "mirakhorli/hybrid-values2", "cascaded/pi-values4"
)
@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("gouta2015/backstepping", ()),
        ("gouta2022/chadpc", ()),
        ("mirakhorli/hybrid", ()),
        ("cascaded/pi", ()),
        ("cascaded/pi", DELAYED),  # with a filter that predicts
        *(
            pytest.param(name, (), marks=pytest.mark.slow)
            for name in ("khalid/laguerre", "mirakhorli/lqi", *PROGRAMMES)
        ),
    ],
)
def test_matlab_gives_the_inputs_of_the_loop(name, values):
    # it begins with the first readings, the loop with the true levels
    case, run, signals = replayed(name, noise=0.0, values=values, filtered=values == DELAYED)
    controller, s, u = (
        matlab(export(case, "m")),
        None,
        list(map(float, np.asarray(case.loop.actuator.initial))),
    )
    for k in range(PROGRAMMES.get(name, 2000)):
        u, s = controller(s, run.t[k], run.y[k], *(v[k] for v in signals), u)
        np.testing.assert_allclose(
            u, run.applied[k], atol=1e-9 * max(1.0, float(np.abs(run.applied).max())), rtol=0
        )


OCTAVE = shutil.which("octave-cli")
SCRIPT = """
rows = load("in.txt"); u = [{first}]; s = []; widths = cumsum([1, {widths}]);
for k = 1:size(rows, 1)
  part = @(i) rows(k, widths(i) + 1:widths(i + 1));
  [u, s] = law(s, rows(k, 1), part(1), part(2), part(3), part(4), u);
  printf("%.17g ", u); printf("\\n");
end
"""


def in_octave(case, folder, run, signals):
    """The inputs that GNU Octave computes by the MATLAB code of a case."""
    (folder / "law.m").write_text(export(case, "m", name="law"))
    parts = [np.asarray(part) for part in (run.y, *signals)]
    np.savetxt(folder / "in.txt", np.column_stack([run.t, *parts]), "%.17g")
    first = ", ".join(repr(float(v)) for v in np.asarray(case.loop.actuator.initial))
    widths = ", ".join(str(part.shape[1]) for part in parts)
    (folder / "main.m").write_text(SCRIPT.format(first=first, widths=widths))
    done = subprocess.run([OCTAVE, "-q", "main.m"], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return np.loadtxt(done.stdout.splitlines(), ndmin=2)


@pytest.mark.slow
@pytest.mark.skipif(OCTAVE is None, reason="no octave on this machine")
@pytest.mark.parametrize("name", [*QUICK, *SLOW])
def test_octave_gives_the_inputs_of_the_loop(name, tmp_path):
    case, run, signals = replayed(name, noise=0.0)
    first = lambda tree: jax.tree.map(lambda a: a[: min(PROGRAMMES.get(name, 300), 300)], tree)
    inputs, run = in_octave(case, tmp_path, first(run), first(signals)), first(run)
    reach = max(1.0, float(np.abs(run.applied).max()))
    np.testing.assert_allclose(inputs, run.applied, atol=1e-9 * reach, rtol=0)


STAIRS = np.array([-1.0, 0.5, 1.0])

FUNCTIONS = (
    *(jax.nn.sigmoid, jax.nn.softplus, jax.nn.relu, jax.nn.silu, jax.nn.gelu),
    *(jax.scipy.special.erf, jax.scipy.special.erfc, jnp.tanh, jnp.exp, jnp.exp2, jnp.expm1),
    *(jnp.sinh, jnp.cosh, jnp.sin, jnp.cos, jnp.tan, jnp.arctan, jnp.arcsinh, jnp.sign, jnp.floor),
    *(jnp.ceil, jnp.round, jnp.trunc, jnp.abs, jnp.square, jnp.cbrt, jnp.sinc, jnp.isfinite),
    lambda x: jnp.log(jnp.abs(x)),
    lambda x: jnp.log1p(jnp.abs(x)),
    lambda x: jnp.log10(jnp.abs(x)),
    lambda x: jnp.sqrt(jnp.abs(x)),
    lambda x: jnp.arcsin(0.4 * x),
    lambda x: jnp.arccos(0.4 * x),
    lambda x: jnp.arctanh(0.4 * x),
    lambda x: jnp.arccosh(1.0 + x * x),
    lambda x: jnp.arctan2(x, -0.4),
    lambda x: jnp.arctan2(-0.3, x),
    lambda x: jnp.hypot(x, 0.4),
    lambda x: jnp.logaddexp(x, 0.4),
    lambda x: jnp.fmod(x, 0.3),
    lambda x: jnp.mod(x, 0.3),
    lambda x: x // 0.3,
    lambda x: (x * 10).astype(int) % 3,
    lambda x: (x * 10).astype(int) // 3,
    lambda x: jnp.abs(x) ** 1.7,
    lambda x: 2.0**x,
    lambda x: x**3,
    lambda x: x**-2,
    lambda x: jnp.clip(x, -0.3, 0.9),
    lambda x: jnp.where(x > 0.5, x, 2 * x),
    lambda x: jnp.maximum(x, 0.3),
    lambda x: jnp.where((x > 0.0) ^ (x > 1.0), 1.0, 2.0),
    lambda x: jnp.select([x > 1.0, x > 0.0], [x, 2 * x], 0.1),
    lambda x: jnp.prod(jnp.stack([x, x + 1.0])),
    lambda x: jnp.cumsum(jnp.stack([x, x * x, 1.0])),
    lambda x: jnp.argmax(jnp.stack([0.2, x])),
    lambda x: jnp.cumprod(jnp.stack([x, x + 1.0])),
    lambda x: jnp.mean(jnp.stack([x, x * x])),
    lambda x: jnp.argmin(jnp.stack([0.2, x])),
    lambda x: jax.lax.cond(x > 0.5, lambda y: y, lambda y: 2 * y, x),
    lambda x: jnp.heaviside(x, 0.5),
    lambda x: jnp.linalg.norm(x * jnp.arange(3)),
    lambda x: jax.lax.scan(lambda c, a: (0.4 * c + a, None), x, jnp.stack([x, 1.0, -x]))[0],
    lambda x: jax.lax.scan(  # last to first, of pairs, whole numbers and truths
        lambda c, a: (jnp.where(a[2], 0.3 * c + a[0][1] * a[1] - a[0][0], c), None),
        x,
        (jnp.stack([x, x * x, 0.2, 1.0, x, -1.0]).reshape(3, 2), jnp.arange(3), x > STAIRS),
        reverse=True,
    )[0],
    lambda x: jax.lax.switch((x > 0.0).astype(int) + (x > 1.0), [jnp.sin, jnp.cos, jnp.square], x),
)
"""Functions of one number that a custom controller may use."""


@component
class EveryFunction(Controller):
    """Its state is what they are of the error."""

    def _values(self, x):
        return tuple(jnp.asarray(f(x), dtype=float) for f in FUNCTIONS)

    def init(self, x0, u0):
        return tuple(0.0 * v for v in self._values(jnp.asarray(0.7)))

    def step(self, state, tick, estimate):
        return (jnp.tanh(estimate.x[0]),), self._values(estimate.x[0] - tick.r[0])


ERRORS = (-1.7, -0.61, 0.23, 0.7, 1.37, 2.06)
"""Errors at which the functions are tried."""


def case_of_every_function():
    case = presets.find("cascaded/pi")
    return case.replace(loop=dataclasses.replace(case.loop, controller=EveryFunction()))


def expected(error):
    return np.concatenate([np.ravel(f(jnp.float64(error))).astype(float) for f in FUNCTIONS])


@pytest.mark.slow
@needs_gcc
def test_c_of_the_functions_that_a_controller_of_ones_own_may_use(tmp_path):
    code = Compiled(case_of_every_function(), tmp_path)
    for error in ERRORS:
        y, right = np.array([error + 3.0, 1.0]), expected(error + 3.0 - 3.0)
        code.init(y, np.zeros(1))
        code.step(0.0, y, np.array([3.0]), None, None)
        np.testing.assert_allclose(code.state[: len(right)], right, rtol=1e-12, atol=1e-15)


@pytest.mark.slow
def test_matlab_of_the_functions_that_a_controller_of_ones_own_may_use():
    controller = matlab(export(case_of_every_function(), "m"))
    for error in ERRORS:
        _, state = controller(None, 0.0, [error + 3.0, 1.0], [3.0], [0.0], [0.0], [0.0])
        np.testing.assert_allclose(state, expected(error + 3.0 - 3.0), rtol=1e-12, atol=1e-15)


def test_what_cannot_be_exported_is_reported():
    with pytest.raises(InputError, match="plays a signal back"):
        export(presets.find("cascaded/open-loop"))
    for option, words in (
        ({"language": "rust"}, "must be one of c, m"),
        ({"precision": "half"}, "double, float"),
        ({"name": "2x"}, "--name"),
    ):
        with pytest.raises(InputError, match=words):
            export(presets.find("cascaded/pi"), **option)


def test_the_command_writes_a_file_that_names_units_and_gains(tmp_path, capsys):
    words = "export gouta2015/backstepping --set controller.k1=0.01 --lang c --out"
    assert main.main([*words.split(), str(tmp_path)]) == 0
    text = (tmp_path / "gouta2015_backstepping.h").read_text()
    assert re.search(r"double controller_k1; /\* .*\[1/s\], above 0; default 0\.01 \*/", text)
    assert "measured levels [cm]" in text and "pump inputs [V]" in text
    assert main.main(["export", "gouta2015/backstepping", "--lang", "m"]) == 0
    assert capsys.readouterr().out.startswith("function [u, s] = gouta2015_backstepping(")
    assert main.main(["export", "gouta2015/backstepping", "--lang", "rust"]) == 2


HOSTILE_RIG = """
name = {name}
units = ["cm", "V"]
tank = [{{ name = "t*/ int taken = 1; /*", area = 20.0, rim = 40.0, drain = 2.0 }}]
pump = [{{ name = "??/", gain = 5.0, to = 1, low = 0.0, high = 12.0 }}]
plant = {{ gravity = 0.5 }}
controller = {{ kind = "pid", Kc = 1.6, Ti = 10.0 }}
"""
HOSTILE = [
    "t*/ int taken(void) { return 1; } /*",
    "t*\\/ int taken(void) { return 1; } /*",
    "t**//* /*/ int taken(void) { return 1; } /*",
    "t*??/",
    "t ??/ ??( ??) \\",
    "t %{ %} ... '' \" ??'",
]


@pytest.fixture(scope="module")
def traced():
    """The Programs of a rig whose tank and pump have hostile names, by whether they have
    parameters.
    """
    case = rig.loads(HOSTILE_RIG.format(name='"r"'))
    return {kind: program(case, adjustable=kind) for kind in (True, False)}


def printed(traced, name, language, title="r"):
    """{file: text} of an export of the same case with other words."""
    target = LANGUAGES[language]
    original = traced[target.adjustable]
    case = dataclasses.replace(original.case, name=name, title=title)
    text = target.write(dataclasses.replace(original, case=case), "law", "double")
    return text if isinstance(text, dict) else {f"law.{language}": text}


@needs_gcc
@pytest.mark.parametrize("standard", ["c99", "gnu99"])  # with trigraphs and without
@pytest.mark.parametrize("name", HOSTILE)
def test_a_name_stays_within_the_comment_of_c(traced, name, standard, tmp_path):
    for file, text in printed(traced, name, "c").items():
        (tmp_path / file).write_text(text)
    source, code = tmp_path / "law.c", tmp_path / "law.o"
    words = [GCC, *FLAGS, f"-std={standard}", "-c", "-o", code, source]
    compiled = subprocess.run(words, capture_output=True, text=True)
    assert compiled.returncode == 0, compiled.stderr
    words = ["nm", "-g", "--defined-only", code]
    symbols = subprocess.run(words, capture_output=True, text=True, check=True)
    names = {line.split()[-1] for line in symbols.stdout.splitlines()}
    assert names == {"law_init", "law_step", "law_dt", "law_units", "law_defaults"}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_name_stays_within_the_comments_of_matlab_and_of_c(traced, name):
    """One comment in C; every line before the first statement begins with % in MATLAB."""
    texts = printed(traced, name, "c")
    head, after = texts["law.h"].split("*/", 1)
    assert head.startswith("/*") and "/*" not in head[2:] and "taken" not in after
    assert after.startswith("\n#ifndef") and not re.search(r"\\|\?\?", texts["law.h"])
    assert "taken" not in texts["law.c"]
    lines = printed(traced, name, "m")["law.m"].splitlines()[1:]
    body = [line for line in lines if not line.startswith("% ") and line != "%"]
    assert "taken" not in "\n".join(body) and body[0].strip() == "if isempty(s)"


@pytest.mark.parametrize(
    "separator", ["\n", "\r", "\v", "\f", "\x1c", "\x85", "\u2028", "\u2029", "\0", "\ud800"]
)
def test_a_line_break_in_the_name_of_a_case_ends_no_comment(traced, separator):
    """A rig file may not hold one; a Case made in Python may."""
    name = f"t{separator}taken = 1;"
    for language, marks in (("c", (" *", "/*")), ("m", ("%",))):
        plain = printed(traced, "r", language)
        for file, text in printed(traced, name, language, f"{name} */").items():
            lines = text.split("\n")
            assert all(line.startswith(marks) for line in lines if "taken" in line)
            assert len(lines) == len(plain[file].split("\n"))
            text.encode()


@pytest.mark.parametrize(
    "unit",
    [
        *("V*/ int taken; /*", "V\\\\", "??/", "$\\\\x{$", "cm, V", "<b>", "V\\u2028", "a" * 41),
        *("^2", "V V V*"),
    ],
)
def test_a_unit_that_is_none_is_refused_in_one_line(unit, tmp_path, capsys):
    text = HOSTILE_RIG.format(name='"r"').replace('["cm", "V"]', f'["cm", "{unit}"]')
    (tmp_path / "rig.toml").write_text(text)
    assert main.main(["export", str(tmp_path / "rig.toml"), "--out", str(tmp_path / "out")]) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.count("\n") == 1
    assert "units: entry = " in printed.err and not (tmp_path / "out").exists()


def test_units_of_rigs_are_taken():
    known = [
        *("cm", "V", "U0", "m^3/s", "cm^3/(s V)", "L/min", "%", "-", "°C", "m³/s", "ml / s"),
        *("(m^3/s)^2", "m^0.5"),
    ]
    assert [units.check_unit("unit", one) for one in known] == known
    with pytest.raises(InputError, match=r"plant\.units: entry = 'cm\*/'"):
        network(area=1.0, drain=1.0, pump_gain=1.0, feeds=[(0, None)], rim=1.0, units=("cm*/", "V"))


@pytest.mark.parametrize("name", ["end", "max", "pick", "s"])
def test_a_matlab_function_is_not_called_what_matlab_or_the_file_has(name):
    """Its file would not be read, or would call itself."""
    case = dataclasses.replace(presets.find("cascaded/pi"), name=name)
    with pytest.raises(InputError, match=f"--name '{name}'"):
        export(case, "m")
    assert f"void {name}_step(" in export(case, "c")


@pytest.mark.parametrize("name", ["2 tanks", "日本"])
def test_a_case_whose_name_is_none_of_the_language_asks_for_one(name):
    case = dataclasses.replace(presets.find("cascaded/pi"), name=name)
    with pytest.raises(InputError, match=f"'{name}' gives no name for the function; --name NAME"):
        export(case)
    assert "void controller_step(" in export(case, name="controller")


@pytest.mark.parametrize("name", ["é", "a²", "a b", "1a", "a;b", "a*/", ""])
def test_a_function_has_a_name_of_the_language(name, tmp_path, capsys):
    assert main.main(
        ["export", "cascaded/pi", f"--name={name}", "--out", str(tmp_path / "out")]
    ) == (2 if name else 0)
    assert (tmp_path / "out").exists() is not bool(name)


AT_ONCE = ("cascaded/pi", "mirakhorli/lqi")  # the others are extended


@pytest.mark.extended_for(*(name for name in [*QUICK, *SLOW] if name not in AT_ONCE))
@pytest.mark.parametrize("name", [*QUICK, *SLOW])
def test_every_language_has_what_a_controller_needs(name):
    case = opened(name)
    for language in ("c", "m", "js", "st"):
        assert len(export(case, language)) > 1000


def test_gains_that_are_compiled_in_are_computed_once():
    """An LQI whose Riccati equation is solved in the code has 560 kB."""
    assert len(export(presets.find("mirakhorli/lqi"), "m")) < 10_000


CASCADE = {"kind": "cascade", "Kc": 3.0, "Ti": 60.0, "inner": [1], "inner_Kc": 1.5}
OVERRIDE = {"kind": "override", "Kc": 2.0, "Ti": 40.0, "limited": [1], "limit": 1.6}
GOVERNOR = {"kind": "reference-governor", "Kc": 2.0, "Ti": 40.0, "limit": [2.4, math.inf]}


@pytest.mark.extended_for("override", "reference-governor")
@pytest.mark.slow_for("cascade")
@needs_gcc
@pytest.mark.parametrize(
    "table",
    [
        CASCADE | {"inner_Ti": 15.0},
        OVERRIDE | {"limit_Kc": 3.0, "limit_Ti": 10.0},
        GOVERNOR | {"horizon": 60.0, "samples": 30},
        {"kind": "pid", "Kc": 2.0, "Ti": 30.0, "Td": 2.0, "N": 5.0, "error_span": 0.5},
    ],
    ids=lambda table: table["kind"],
)
def test_exported_loops_of_rig_files_are_those_of_the_simulation(tmp_path, table):
    case = rig.loads(f"{SERIES}controller = {rig.toml(table)}").replace(name="law")
    run = jax.tree.map(np.asarray, jaxtank.simulate(case.loop, case.clock))
    inputs = Compiled(case, tmp_path).run(case, run, signals_of(case))
    np.testing.assert_allclose(inputs, run.applied, rtol=0, atol=1e-12)
    assert inputs.max() == 1.0 and inputs.min() == 0.0


def test_code_that_reads_levels_alone_has_no_measured_flow():
    flow = {"kind": "flow-cascade", "Kc": 0.1, "Ti": 80.0, "inner_Kc": 2.0, "inner_Ti": 1.5}
    for table in (flow, {"kind": "p", "Kc": 1.0, "inflow_gain": -2.0}):
        with pytest.raises(InputError, match="measured flows"):
            export(rig.loads(f"{SERIES}controller = {rig.toml(table)}"))


def test_sizes_of_a_scan_are_read_of_both_forms_that_jax_has():
    """Since 0.12 in a tree of its own; the exports of `versions.sh newest` run with it."""
    older = {"num_consts": 2, "num_carry": 3}
    newer = {"ft_in": types.SimpleNamespace(unpack=lambda: ([0] * 2, [0] * 3, [0]))}
    assert lowering._sizes_of_scan(older) == lowering._sizes_of_scan(newer) == (2, 3)

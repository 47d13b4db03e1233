"""The structural causes of speed, and that no transformation changes a result."""

import dataclasses
import os
import re
import subprocess
import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import loops_in

import jaxtank
from jaxtank import rig
from jaxtank.controllers.base import Controller
from jaxtank.core.clock import Clock
from jaxtank.core.errors import NonFiniteError
from jaxtank.core.kahan import nothing, plus, totals
from jaxtank.loop.derivatives import sensitivities_compiled
from jaxtank.loop.run import evaluate_compiled, evaluate_for_reverse
from jaxtank.loop.trajectory import COLUMNS
from jaxtank.plants.base import Plant
from jaxtank.xla import flags as _xla, hoist
from jaxtank.xla.barrier import materialised
from tuning.bench import bench

MEASURES = ("rms_error_total", "max_level")
GAINS = {"controller.k": np.float64(0.03), "controller.k1": np.float64(0.088)}


def of_two_gains(case):
    """The program of the derivatives by two gains."""
    names, values = tuple(GAINS), tuple(GAINS.values())
    lowered = sensitivities_compiled.lower(case.loop, case.clock, MEASURES, names, values, None)
    return lowered.compile()


@pytest.mark.extended_for("backstepping")
@pytest.mark.parametrize("name", ["backstepping", "ngpc-boxqp"])
def test_the_loop_compiles_to_one_function(gouta, name):
    case = gouta(name)
    program = evaluate_compiled.lower(case.loop, case.clock, MEASURES, None, False).compile()
    assert loops_in(program) >= 1


@pytest.mark.slow
def test_the_loop_with_every_measure_noise_lag_and_delay_compiles_to_one_function(gouta):
    """Two calls: the random generator has a loop of its own."""
    from jaxtank.measures import MEASURES as every, serves

    pumps = {"actuator.delay": 1.0, "actuator.lag": 0.5, "actuator.dead_zone": 1.0}
    case = gouta("ngpc", {**pumps, "sensor.noise": 0.01, "sensor.bits": 12})
    names = tuple(m for m in every if serves(m, case.loop))
    program = evaluate_compiled.lower(case.loop, case.clock, names, jax.random.key(0), False)
    assert loops_in(program.compile()) >= 2


def test_the_loop_of_the_derivatives_compiles_to_one_function(gouta):
    assert loops_in(of_two_gains(gouta("backstepping"))) >= 1


def test_measures_do_not_make_memory_grow_with_the_samples(gouta):
    """The only arrays as long as the run are the samples of the reference."""
    sizes = []
    for duration in (100.0, 1200.0):
        case = gouta("backstepping", {"clock.duration": duration})
        program = evaluate_compiled.lower(case.loop, case.clock, MEASURES, None, False).compile()
        stats = program.memory_analysis()
        sizes.append(stats.temp_size_in_bytes / case.clock.samples)
    assert max(sizes) < 8 * 8  # bytes per sample: at most eight float64 arrays of inputs


@pytest.mark.slow
def test_a_gradient_of_two_gains_takes_less_than_ten_megabytes(gouta):
    case = gouta("backstepping")
    assert of_two_gains(case).memory_analysis().temp_size_in_bytes < 10e6
    reverse = jax.jit(
        jax.grad(
            lambda k1: evaluate_for_reverse(
                jaxtank.with_values(case.loop, {"controller.k1": k1}), case.clock, MEASURES
            )["rms_error_total"]
        )
    )
    assert reverse.lower(0.088).compile().memory_analysis().temp_size_in_bytes < 10e6


def test_invariant_work_leaves_the_loop_and_nothing_else_changes():
    """Coefficients are computed before the loop, once each; results and derivatives are those of
    jax.lax.scan.
    """

    def run(scan, a, b):
        def body(carry, x):
            c = jnp.sqrt(a / b)  # invariant
            same = jnp.sqrt(a / b)  # and again
            return carry * c + same * jnp.sin(x), carry

        return scan(body, jnp.float64(1.0), jnp.arange(7.0), length=7)

    def loop_of(scan):
        jaxpr = jax.make_jaxpr(lambda a, b: run(scan, a, b))(2.0, 3.0)
        return [e for e in jaxpr.eqns if e.primitive.name == "scan"][0].params["jaxpr"].jaxpr, jaxpr

    inside, whole = loop_of(hoist.scan)
    assert not {"sqrt", "div"} & {e.primitive.name for e in inside.eqns}
    assert [e.primitive.name for e in whole.eqns].count("sqrt") == 1
    assert {"sqrt", "div"} <= {e.primitive.name for e in loop_of(jax.lax.scan)[0].eqns}
    plain, lean = (run(s, 2.0, 3.0) for s in (jax.lax.scan, hoist.scan))
    np.testing.assert_allclose(lean[0], plain[0], rtol=1e-15)
    np.testing.assert_allclose(lean[1], plain[1], rtol=1e-15)
    for derivative in (jax.grad, jax.jacfwd):
        a, b = (
            derivative(lambda a, s=s: run(s, a, 3.0)[0])(2.0) for s in (jax.lax.scan, hoist.scan)
        )
        np.testing.assert_allclose(a, b, rtol=1e-14)


@pytest.mark.slow
def test_jit_equals_no_jit(gouta):
    case = gouta(
        "backstepping",
        {"clock.dt": 0.1, "clock.duration": 4.0, "reference.ramp": 2.0, "reference.targets": 9.0},
    )
    compiled = jaxtank.evaluate(case.loop, case.clock, MEASURES)
    outer = jax.jit(lambda loop: jaxtank.evaluate(loop, case.clock, MEASURES))(case.loop)
    with jax.disable_jit():
        plain = jaxtank.evaluate(case.loop, Clock(dt=0.1, duration=4.0), MEASURES)
    for name in MEASURES:
        np.testing.assert_allclose(outer[name], compiled[name], rtol=1e-12)
        np.testing.assert_allclose(plain[name], compiled[name], rtol=1e-12)


def test_a_run_repeats_bit_for_bit(gouta):
    case = gouta("ngpc", {"sensor.noise": 0.02, "clock.duration": 100.0})
    one, two = (
        jaxtank.evaluate(case.loop, case.clock, MEASURES, key=jax.random.key(5)) for _ in range(2)
    )
    other = jaxtank.evaluate(case.loop, case.clock, MEASURES, key=jax.random.key(6))
    assert all(np.array_equal(one[m], two[m]) for m in MEASURES)
    assert one["rms_error_total"] != other["rms_error_total"]


@pytest.mark.extended
@pytest.mark.slow_for("7")
@pytest.mark.parametrize("save_every", [7, 1000])
def test_saved_rows_are_the_rows_of_the_run(gouta, save_every):
    case = gouta("backstepping", {"clock.duration": 100.0, "clock.dt": 0.05})  # a run that is known
    every = jaxtank.simulate(case.loop, case.clock)
    some = jaxtank.simulate(case.loop, case.clock, save_every=save_every)
    assert len(some.t) == (case.clock.samples - 1) // save_every + 1
    for name in COLUMNS:
        rows = np.asarray(getattr(every, name))[::save_every]
        np.testing.assert_allclose(getattr(some, name), rows, rtol=1e-12, atol=1e-12)


WIDTH, OURS = _xla.VECTOR_WIDTH, _xla.OPTION
EXTRA, REST = "--xla_backend_extra_options", f"{_xla.ROLLED},{_xla.OLD_EMITTERS}"


@pytest.mark.parametrize(
    "flags, expected",
    [
        ("", f"{WIDTH} {EXTRA}={OURS}"),
        (f"{EXTRA}=a=1 --b", f"{WIDTH} {EXTRA}=a=1,{OURS} --b"),
        (f"{EXTRA}={_xla.KEY}=5", f"{WIDTH} {EXTRA}={_xla.KEY}=5,{REST}"),
        (f"{WIDTH[:-3]}128 {EXTRA}={OURS}", f"{WIDTH[:-3]}128 {EXTRA}={OURS}"),
        (f'--dump="/a  b" {EXTRA}=a', f'{WIDTH} --dump="/a  b" {EXTRA}=a,{OURS}'),
        (f"{EXTRA}='a=1,b' --c", f"{WIDTH} {EXTRA}='a=1,b,{OURS}' --c"),
        ("/a/file/of/flags", "/a/file/of/flags"),
    ],
)
def test_the_option_joins_what_the_user_set(flags, expected):
    assert _xla.append_option(flags) == expected


def test_a_flag_that_a_later_xla_may_not_know_is_left_out(monkeypatch):
    """XLA ends the process at an unknown flag."""
    monkeypatch.setattr(_xla.jaxlib.version, "__version_info__", _xla.UNTRIED)
    assert _xla.append_option("") == f"--xla_backend_extra_options={_xla.OPTION}"


def test_the_options_are_set_before_jax_starts_or_missed_with_a_warning(monkeypatch, tmp_path):
    monkeypatch.delenv(_xla.SWITCH, raising=False)
    ours = f"{WIDTH} --xla_backend_extra_options={_xla.OPTION}"
    file = tmp_path / "flags.txt"
    cases = [  # started, XLA_FLAGS before, after, warning
        (False, "", ours, None),
        (False, ours, ours, None),
        (True, "", "", "jax had started before jaxtank"),
        (False, str(file), str(file), "names a file"),
    ]
    for started, before, after, words in cases:
        monkeypatch.setattr(_xla, "backend_started", lambda started=started: started)
        monkeypatch.setenv("XLA_FLAGS", before)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            _xla.enable_small_loop_compilation()
        assert os.environ["XLA_FLAGS"] == after
        assert [words in str(w.message) for w in caught] == ([True] if words else [])
    file.write_text(ours)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _xla.enable_small_loop_compilation()  # a file that holds the options
        monkeypatch.setenv("XLA_FLAGS", "")
        monkeypatch.setenv(_xla.SWITCH, "0")
        _xla.enable_small_loop_compilation()
    assert os.environ["XLA_FLAGS"] == ""


def python(code, *words, **env):
    """Run code in a fresh process; (stdout, stderr)."""
    clean = {k: v for k, v in os.environ.items() if k not in ("XLA_FLAGS", _xla.SWITCH)}
    pipes = {"capture_output": True, "text": True, "env": {**clean, **env}, "check": True}
    done = subprocess.run([sys.executable, "-c", code, *words], **pipes)
    return done.stdout.strip(), done.stderr


@pytest.mark.slow
def test_float32_keeps_what_rounding_takes_and_states_what_is_lost():
    """Levels, error and its slope of a run in float32 beside float64. Plain float32 sums are 5e-3
    cm and 6e-5 off (methods 2.5).
    """
    code = (
        "import jax, jaxtank, sys; jax.config.update('jax_enable_x64', sys.argv[1] == '64'); from"
        " jaxtank import presets\ncase = presets.find('gouta2015/backstepping'); run ="
        " jaxtank.simulate(case.loop, case.clock, save_every=10_000)\nloop = lambda k:"
        " jaxtank.with_values(case.loop, {'controller.k1': k})\nerror = lambda k:"
        " jaxtank.evaluate(loop(k), case.clock,"
        " 'rms_error_total')['rms_error_total']\nprint(run.x.dtype, *map(float, run.x.ravel()),"
        " float(error(0.088)), float(jax.jacfwd(error)(0.088)))"
    )
    (single, err), (double, quiet) = python(code, "32"), python(code, "64")
    assert single.split()[0] == "float32" and double.split()[0] == "float64"
    assert "float32" in err and "jax_enable_x64" in err and not quiet
    (*levels, error, slope), (*exact, true_error, true_slope) = (
        [float(v) for v in words.split()[1:]] for words in (single, double)
    )
    assert np.abs(np.subtract(levels, exact)).max() < 3e-5
    assert error == pytest.approx(true_error, rel=3e-6)
    assert slope == pytest.approx(true_slope, rel=1e-4)


def operations_in_batch(program, batch):
    """Arithmetic on all lanes in the fused parts of a compiled program's largest loop body, and how
    many calls wall them off.
    """
    text = program.as_text()
    parts = {piece.split()[0]: piece for piece in text.split("\n\n") if piece.startswith("%")}
    body = max((parts[name] for name in re.findall(r"body=(%[\w.-]+)", text)), key=len)
    fused = [parts[name] for name in re.findall(r"calls=(%[\w.-]+)", body)]
    done = re.findall(
        rf"= f64\[{batch}\]\S* (?:add|subtract|multiply|divide|select|sqrt)\(", "\n".join(fused)
    )
    return len(done), sum(
        " call(" in line and 'inlineable="false"' in line for line in body.splitlines()
    )


@pytest.mark.extended
def test_what_several_read_is_made_once(gouta):
    """Without the walls the parts of this loop repeat most of the step: about 1000 operations on
    every lane instead of 550.
    """
    case = gouta("backstepping", {"clock.duration": 2.0})
    gains = {
        "controller.k": np.full(64, 0.03),
        "plant.drain": np.tile(case.loop.plant.drain, (64, 1)),
    }
    run = jax.vmap(
        lambda v: evaluate_compiled(
            jaxtank.with_values(case.loop, v), case.clock, MEASURES, None, False
        )
    )
    count, walls = operations_in_batch(jax.jit(run).lower(gains).compile(), 64)
    assert walls == 4  # the voltages, and the rates of three Runge-Kutta stages
    assert 250 < count < 650


@pytest.mark.extended
def test_materialised_values_pass_every_transformation():
    f = lambda x: materialised({"a": jnp.sin(x), "b": (x * x,)})
    g = lambda x: f(x)["a"] * f(x)["b"][0]
    x = 0.7
    slope = np.cos(x) * x * x + 2 * x * np.sin(x)
    assert jax.jit(g)(x) == pytest.approx(np.sin(x) * x * x, rel=1e-15)
    looped = lambda y: jax.lax.scan(lambda c, _: (g(c), None), y, None, 1)[0]
    for found in (
        jax.grad(g)(x),
        jax.jacfwd(g)(x),
        jax.vmap(jax.grad(g))(jnp.array([x]))[0],
        jax.grad(looped)(x),
        jax.jacfwd(looped)(x),
    ):
        assert found == pytest.approx(slope, rel=1e-14)


def test_bench_states_why_a_loop_is_slow():
    """The reasons that `jaxtank bench CASE` prints, each from a program that has the fault."""

    def program(body):
        return (
            jax.jit(lambda x: jax.lax.scan(lambda c, _: (body(c), None), x, None, length=50)[0])
            .lower(jnp.eye(2))
            .compile()
            .as_text()
        )

    plain, solving = (
        program(lambda c: 0.5 * c),
        program(lambda c: jnp.linalg.solve(c + 3.0 * jnp.eye(2), c)),
    )
    assert bench.reasons(plain, 50, True, np.float64, 0) == []
    assert "custom-call" in bench.reasons(solving, 50, True, np.float64, 0)[0]
    assert "JAXTANK_XLA_OPTION" in bench.reasons(solving, 50, False, np.float64, 0)[0]
    assert "no faster" in bench.reasons(plain, 50, True, np.float32, 0)[0]
    assert "3 of 3" in bench.reasons(plain, 50, True, np.float64, 3)[0]


def test_compensated_sums_lose_nothing():
    """A million terms of 1e-4 on 10 in float32: the plain sum is lost by a percent."""
    term, count = jnp.float32(1e-4), 1_000_000
    kept = jax.lax.fori_loop(
        0,
        count,
        lambda _, s: plus(s, term),
        nothing(jnp.float32(0.0))._replace(total=jnp.float32(10.0)),
    )
    plain = jax.lax.fori_loop(0, count, lambda _, s: s + term, jnp.float32(10.0))
    exact = 10.0 + count * float(term)
    assert abs(float(totals(kept)) - exact) < 1e-5
    assert abs(float(plain) - exact) > 0.1
    assert nothing(np.float64(0.0)) == 0.0


@pytest.mark.slow
def test_the_older_code_generator_changes_the_program_and_not_its_numbers():
    code = (
        "import jax, jaxtank, numpy as np; jax.config.update('jax_enable_x64', True); from jaxtank"
        " import presets, Clock\nfrom jaxtank.loop import run as loop\ncase ="
        " presets.find('cascaded/pi'); clock = Clock(dt=4.0, duration=400.0)\nrun ="
        " jax.jit(lambda loop_: loop.simulate(loop_, clock).x).lower(case.loop).compile()\n"
        "print(len(run.runtime_executable().serialize()))\nx = np.asarray(run(case.loop))\n"
        "print(float(np.sum(x)).hex())"
    )
    both = f"{_xla.KEY}=100000000000,{_xla.ROLLED}"
    without = f"--xla_backend_extra_options={both}"
    new = {"JAX_ENABLE_COMPILATION_CACHE": "false"}
    ours = python(code, **new)[0].split()
    theirs = python(code, XLA_FLAGS=without, JAXTANK_XLA_OPTION="0", **new)[0].split()
    assert ours[0] != theirs[0]
    np.testing.assert_allclose(float.fromhex(ours[1]), float.fromhex(theirs[1]), rtol=1e-12)


@pytest.mark.slow
def test_loops_over_batches_stay_loops():
    """LLVM would unroll sixteen plants into sixteen single runs, 36 against 11 ns per step and
    plant: the program is longer.
    """
    assert (
        "xla_cpu_disable_loop_unrolling"
        in python("import jaxtank, os; print(os.environ['XLA_FLAGS'])")[0]
    )
    code = (
        "import jax, jaxtank, numpy as np; jax.config.update('jax_enable_x64', True); from jaxtank"
        " import presets, Clock\nfrom jaxtank.loop import run as loop\ncase ="
        " presets.find('gouta2015/backstepping'); clock = Clock(duration=2.0)\nrun ="
        " jax.vmap(lambda k: loop.evaluate_and_flag(jaxtank.with_values(case.loop,"
        " {'controller.k1': k}), clock, ('ise',)))\nprint(len(jax.jit(run).lower(np.linspace(0.1,"
        " 0.2, 16)).compile().runtime_executable().serialize()))"
    )
    without = f"--xla_backend_extra_options={_xla.KEY}=100000000000"
    # compiled anew: the size of a program that was kept is another
    new = {"JAX_ENABLE_COMPILATION_CACHE": "false"}
    unrolled = python(code, XLA_FLAGS=without, JAXTANK_XLA_OPTION="0", **new)
    assert int(python(code, **new)[0]) < int(unrolled[0])


@jaxtank.component
class Failing(Controller):
    """A controller whose command is no number from 10 s on."""

    model: Plant

    def step(self, state, tick, estimate):
        return tuple(50.0 + 0.0 * jnp.log(10.0 - tick.t) for _ in range(self.model.pumps)), state


ONE_TANK = """
units = ["m", "%"]
tank = [{ TANK, rim = 1.2, level = 0.4, drain = "4 cm^2" }]
pump = [{ to = 1, gain = "0.08 m3/(h %)", high = 100.0, initial = 20.0 }]
controller = { kind = "pi", Kc = 9.0, Ti = 60.0 }
reference = { initial = [0.4] }
reachable = false
dt = 1.0
duration = 30.0
"""
UPRIGHT, CONE = "area = 0.5", 'shape = "cone", diameter = 1.0, height = 1.2'
PULSE = "kind = 'pumps', dead_zone = [3.0], pulse = [9.0], dead_zone_kind = 'pulse'"
HYSTERESIS = "kind = 'pumps', dead_zone = [3.0], stop = [1.0], dead_zone_kind = 'hysteresis'"


@pytest.mark.extended
@pytest.mark.parametrize("tank", [UPRIGHT, CONE])
@pytest.mark.parametrize(
    "more",
    [
        "",
        "plant = { bottom = true }",
        "plant = { overflow = true }",
        "actuator = { kind = 'pumps', dead_zone = [3.0] }",
        f"actuator = {{ {HYSTERESIS} }}",
        f"actuator = {{ {PULSE} }}",
        "safety_filter = { limit = [1.1] }",
    ],
)
def test_a_command_that_is_no_number_stops_the_run(tank, more):
    """A comparison with NaN would make it a number: a limit, a dead zone, an empty tank."""
    loop = rig.loads(ONE_TANK.replace("TANK", tank) + more).loop
    loop = dataclasses.replace(loop, controller=Failing(model=loop.plant))
    with pytest.raises(NonFiniteError, match="stopped being finite"):
        jaxtank.evaluate(loop, Clock(dt=1.0, duration=30.0), ["max_level"])

"""One closed loop in everything a user might pick instead: the four-tank under backstepping,
fourth-order Runge-Kutta, inputs held.

    pip install ".[bench]"
    python tests/benchmarks/rivals.py [rounds] [--markdown]
    python tests/benchmarks/rivals.py --simulators [rounds] [--markdown]  # run and gradient

With --simulators: jaxonomy and fugacio, two differentiable simulators (`simulators.py`).
All of them do the same arithmetic on the same setpoints and are timed in turn within one process;
medians, the ratio to ours in the same round with its range, time of the first call (compilation)
apart, and how far the RMS error is from ours. Slow ones run a part of the samples, and are told per
step. Rivals that are not installed are named. Nothing is asserted: machines differ.
"""

import atexit
import dataclasses
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import four_tank
import jax
import jax.numpy as jnp
import numpy as np
from four_tank import controller, field, runge_kutta
from measuring import first_number, report, with_range

import jaxtank
from jaxtank import presets
from tuning.bench import bench

BEGIN, END = "<!-- tests/benchmarks/rivals.py -->", "<!-- end of rivals -->"
# samples of the slow ones, from the beginning of the first ramp on, until when the rig rests
FEW = 6000


def constants(case):
    """(c (10,), gain k + k1, k1, coefficients of the decoupling (6,), floor, high) as the C loop
    has them.
    """
    p, controller = case.loop.plant, case.loop.controller
    rows = (np.asarray(getattr(p, n)) for n in ("area", "drain", "orifice", "pump_gain"))
    c, b = four_tank.coefficients(*rows, float(p.gravity))
    return (
        c,
        float(controller.k) + float(controller.k1),
        float(controller.k1),
        b,
        float(controller.level_floor),
        float(case.loop.actuator.high[0]),
    )


def numba_loop(case, r, x0):
    c, gain, k1, b, floor, high = constants(case)
    run = four_tank.numba_loop(c, b, floor, high)
    return lambda: run(r, gain, k1, *x0, case.clock.dt)[0], r.shape[1]


def jax_as_it_comes(case, r, x0):
    """`plain_scan` in a process of its own, without the XLA option that importing jaxtank sets: one
    line in, one number out.
    """
    script = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import rivals;"
        " rivals.serve()"
    )
    child = subprocess.Popen(
        [sys.executable, "-c", script],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "JAXTANK_XLA_OPTION": "0"},
    )
    atexit.register(child.kill)

    def call():
        child.stdin.write("\n")
        child.stdin.flush()
        return float(child.stdout.readline())

    return call, r.shape[1]


def serve():
    """The other end of `jax_as_it_comes`."""
    jax.config.update("jax_enable_x64", True)
    case = presets.find("gouta2015/backstepping")
    r = np.array([np.asarray(v) for v in case.loop.reference.sample(case.clock)[0]])
    run, _ = plain_scan(case, r, tuple(map(float, case.loop.x0)))
    for _ in sys.stdin:
        print(float(run()), flush=True)


def plain_scan(case, r, x0):
    """What one writes first: jax.lax.scan over a state vector (`rollout` of most libraries), with
    the XLA option that jaxtank sets.
    """
    c, gain, k1, b, floor, high = constants(case)
    h = case.clock.dt

    def body(x, now):
        u = jnp.stack(controller(c, gain, k1, b, floor, high, x, now, jnp))
        f = lambda x: jnp.stack(field(c, x, u, jnp))
        a = f(x)
        p = f(x + 0.5 * h * a)
        q = f(x + 0.5 * h * p)
        s = f(x + h * q)
        return x + h / 6 * (a + 2 * (p + q) + s), jnp.sum((x[:2] - now) ** 2)

    run = jax.jit(lambda r: jnp.sqrt(jnp.mean(jax.lax.scan(body, jnp.asarray(x0), r)[1])))
    rows = jnp.asarray(r.T)
    return lambda: run(rows), r.shape[1]


def diffrax_steps(case, r, x0):
    import diffrax

    c, gain, k1, b, floor, high = constants(case)
    h = case.clock.dt
    term = diffrax.ODETerm(lambda t, x, u: jnp.stack(field(c, x, u, jnp)))
    constant = diffrax.ConstantStepSize()

    def body(x, now):
        u = jnp.stack(controller(c, gain, k1, b, floor, high, x, now, jnp))
        solved = diffrax.diffeqsolve(
            term, diffrax.Tsit5(), 0.0, h, h, x, args=u, stepsize_controller=constant, max_steps=2
        )
        return solved.ys[-1], jnp.sum((x[:2] - now) ** 2)

    run = jax.jit(lambda r: jnp.sqrt(jnp.mean(jax.lax.scan(body, jnp.asarray(x0), r)[1])))
    rows = jnp.asarray(r[:, :FEW].T)
    return lambda: run(rows), FEW


def casadi_accumulated(case, r, x0):
    import casadi as ca

    c, gain, k1, b, floor, high = constants(case)

    Namespace = four_tank.casadi_names()
    x, now = ca.SX.sym("x", 4), ca.SX.sym("r", 2)
    u = controller(
        c, gain, k1, b, floor, high, [x[i] for i in range(4)], [now[0], now[1]], Namespace
    )
    parts = runge_kutta(
        lambda z: field(c, z, u, Namespace), tuple(x[i] for i in range(4)), case.clock.dt
    )
    step = ca.Function("step", [x, now], [ca.vertcat(*parts)])
    run = step.mapaccum("run", r.shape[1])

    def call():
        levels = np.array(run(x0, r))[:2]
        levels = np.concatenate([np.asarray(x0)[:2, None], levels[:, :-1]], axis=1)
        return np.sqrt(np.mean(np.sum((levels - r) ** 2, axis=0)))

    return call, r.shape[1]


def scipy_lsoda(case, r, x0):
    from scipy.integrate import solve_ivp

    c, gain, k1, b, floor, high = constants(case)
    few = FEW // 10

    def call():
        x, total = np.asarray(x0, dtype=float), 0.0
        for k in range(few):
            u = controller(c, gain, k1, b, floor, high, x, r[:, k], np)
            total += np.sum((x[:2] - r[:, k]) ** 2)
            x = solve_ivp(
                lambda t, x, u=u: field(c, x, u, np), (0, case.clock.dt), x, method="LSODA"
            ).y[:, -1]
        return np.sqrt(total / few)

    return call, few


def plain_python(case, r, x0):
    c, gain, k1, b, floor, high = (
        list(map(float, v)) if np.ndim(v) else v for v in constants(case)
    )
    import math

    class Namespace:
        sqrt, maximum = math.sqrt, max
        clip = staticmethod(lambda v, low, top: min(max(v, low), top))

    rows = r[:, :FEW].T.tolist()

    def call():
        x, total = tuple(map(float, x0)), 0.0
        for now in rows:
            u = controller(c, gain, k1, b, floor, high, x, now, Namespace)
            total += (x[0] - now[0]) ** 2 + (x[1] - now[1]) ** 2
            x = runge_kutta(lambda z, u=u: field(c, z, u, Namespace), x, case.clock.dt)
        return math.sqrt(total / len(rows))

    return call, FEW


def python_control(case, r, x0):
    import control

    c, gain, k1, b, floor, high = constants(case)
    few = FEW // 10
    closed = lambda t, x, w, p: np.array(
        field(c, x, controller(c, gain, k1, b, floor, high, x, w, np), np)
    )
    loop = control.nlsys(closed, None, inputs=2, outputs=4, states=4)
    t = np.arange(few) * case.clock.dt

    def call():
        run = control.input_output_response(loop, t, r[:, :few], x0, solve_ivp_method="LSODA")
        return np.sqrt(np.mean(np.sum((run.states[:2] - r[:, :few]) ** 2, axis=0)))

    return call, few


RIVALS = {
    "numba": numba_loop,
    "casadi, mapaccum": casadi_accumulated,
    "JAX, lax.scan over a vector, with our XLA option": plain_scan,
    "JAX, the same as it comes": jax_as_it_comes,
    "diffrax, Tsit5 in a scan": diffrax_steps,
    "plain Python": plain_python,
    "scipy, LSODA between samples": scipy_lsoda,
    "python-control (continuous controller)": python_control,
}
WHOLE = (numba_loop, casadi_accumulated, plain_scan, jax_as_it_comes)


def main(words):
    if "--simulators" in words:
        import simulators

        return simulators.main(words)
    jax.config.update("jax_enable_x64", True)
    rounds = first_number(words, 7)
    case = presets.find("gouta2015/backstepping")
    r = np.array([np.asarray(v) for v in case.loop.reference.sample(case.clock)[0]])
    x0 = tuple(map(float, case.loop.x0))
    resting = int(np.argmax(np.any(r != r[:, :1], axis=0)))
    names = ("rms_error_total",)
    ours = lambda: jaxtank.evaluate(case.loop, case.clock, names)["rms_error_total"]
    calls, steps, missing = {"jaxtank": ours}, {"jaxtank": case.clock.samples}, []
    with tempfile.TemporaryDirectory() as folder:
        function = bench.c_loop(folder)
        if function is None:
            missing.append("C loop (no gcc)")
        else:
            run = bench.c_runner(function, case)
            name = "C, gcc -O3 -march=native"
            calls[name], steps[name] = (lambda: run()[0]), case.clock.samples
        for name, make in RIVALS.items():
            try:
                calls[name], steps[name] = make(case, r if make in WHOLE else r[:, resting:], x0)
            except ImportError as error:
                missing.append(f"{name} ({error.name} is not installed)")
        first = {}
        for name, call in calls.items():
            began = time.perf_counter()
            jax.block_until_ready(call())
            first[name] = time.perf_counter() - began
        seconds, results = bench.timed(calls, rounds)
    rows, whole = [], float(results["jaxtank"])
    for name, spent in seconds.items():
        per = [1e9 * s / steps[name] for s in spent]
        ratio = [a / (1e9 * b / steps["jaxtank"]) for a, b in zip(per, seconds["jaxtank"])]
        until = resting + steps[name]
        clock = dataclasses.replace(case.clock, duration=(until - 1) * case.clock.dt)
        same = whole
        if steps[name] < case.clock.samples:
            error = float(jaxtank.evaluate(case.loop, clock, names)["rms_error_total"])
            same = error * (until / steps[name]) ** 0.5
        cells = [f"{statistics.median(per):,.0f}", with_range(ratio)]
        cells += [f"{max(first[name] - statistics.median(spent), 0.0):.2g}"]
        cells += [f"{abs(float(results[name]) - same):.1e}", f"{steps[name]:,}"]
        rows.append([name, *cells])
    heads = [
        *("one run in float64", "ns per step", "times ours (range)", "first call, s more"),
        *("RMS error from ours, cm", "samples"),
    ]
    if missing:
        print(f"not here: {', '.join(missing)}")
    return report(words, heads, rows, BEGIN, END)


if __name__ == "__main__":
    main(sys.argv[1:])

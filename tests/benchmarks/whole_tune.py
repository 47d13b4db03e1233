"""The whole tune of two gains, start-up included: `jaxtank tune --nominal` beside the loop written
in C, numba, JAX or CasADi and searched by SciPy, IPOPT, CMA-ES or Optuna, as an engineer would who
wants this one answer.

    pip install ".[bench]"
    python tests/benchmarks/whole_tune.py [rounds] [--markdown] [--only TEXT]

gouta2015/backstepping: the RMS error under the limits on the levels. Each row is a process of its
own: C is compiled and called by ctypes without jax. Derivatives are differences of C and numba, and
exact of the others. Core time, the least of `rounds` (3), in turn. --only: rows whose name has it.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve()
ROOT = HERE.parents[2]
BEGIN, END = "<!-- tests/benchmarks/whole_tune.py -->", "<!-- end of whole_tune -->"
CASE = "gouta2015/backstepping"
METHODS = {  # "the loop, what searches, starts": name
    "c slsqp": "C, SciPy SLSQP from the published gains",
    "c slsqp 8": "C, SciPy SLSQP from eight starts",
    "c nelder-mead": "C, SciPy Nelder-Mead from the published gains",
    "c evolution": "C, SciPy differential evolution",
    "c cma": "C, CMA-ES",
    "c optuna": "C, Optuna (TPE), 300 trials",
    "numba slsqp": "numba, SciPy SLSQP from the published gains",
    "scan slsqp": "JAX, lax.scan over a vector, SciPy SLSQP from the published gains",
    "diffrax slsqp": "diffrax (Tsit5) in lax.scan, SciPy SLSQP from the published gains",
    "casadi ipopt": "CasADi, IPOPT from the published gains",
}
TRIALS = 300  # of Optuna
PENALTY = 1e3  # cost of a level above its limit, of the methods without constraints [cm/cm]


def write_problem(path):
    """Write what the engineer knows: numbers of the rig, setpoints, ranges and limits."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from jaxtank import presets
    from tuning.problem.problem import Problem

    problem = Problem(presets.find(CASE))
    assert list(problem.objective) == ["rms_error_total"], problem.objective
    plant, controller, clock = problem.loop.plant, problem.loop.controller, problem.clock
    hydraulics = (plant.area, plant.drain[:2], plant.orifice, plant.pump_gain)
    limits = np.full(plant.tanks, np.inf)
    for limit in problem.limits:
        assert limit.measure == "max_level"
        limits[limit.index] = limit.value
    np.savez(
        path,
        numbers=np.concatenate([*hydraulics, [float(plant.gravity), plant.knee]]),
        r=np.ascontiguousarray(np.array(problem.loop.reference.sample(clock)[0])),
        x0=np.array(problem.loop.x0, dtype=float),
        fixed=[float(controller.level_floor), float(problem.loop.actuator.high[0])],
        clock=[clock.samples, clock.dt],
        start=[float(controller.k), float(controller.k1)],
        ranges=[[b.low, b.high] for b in problem.bounds],
        limits=limits,
    )


class Loop:
    """The problem as the engineer knows it; z in the unit square: gains on logarithmic scales."""

    def __init__(self, path):
        with np.load(path) as data:
            self.data = dict(data)
        ranges, fixed, clock = (self.data[n] for n in ("ranges", "fixed", "clock"))
        self.low, self.span = ranges[:, 0], np.log(ranges[:, 1] / ranges[:, 0])
        self.floor, self.high = map(float, fixed)
        self.samples, self.dt = int(clock[0]), float(clock[1])
        self.limits, self.limited = self.data["limits"], np.isfinite(self.data["limits"])
        self.known = {}

    def gains(self, z):
        return self.low * np.exp(np.clip(z, 0.0, 1.0) * self.span)

    def coefficients(self):
        import four_tank

        A, d, o, g, (gravity, _) = np.split(self.data["numbers"], [4, 6, 10, 12])
        return four_tank.coefficients(A, d, o, g, gravity)

    def run(self, z):
        """(RMS error, margins of the limits) at z."""
        if z.tobytes() not in self.known:
            rms, *tops = self.outcome(*self.gains(z))
            margins = np.nan_to_num((self.limits - np.array(tops))[self.limited])
            self.known[z.tobytes()] = (float(rms) if np.isfinite(rms) else 1e3), margins
        return self.known[z.tobytes()]

    def penalised(self, z):
        rms, margins = self.run(np.asarray(z, dtype=float))
        return rms + PENALTY * np.maximum(0.0, -margins).sum()


class CLoop(Loop):
    def __init__(self, path):
        import ctypes

        super().__init__(path)
        with tempfile.TemporaryDirectory() as folder:
            library = f"{folder}/loop.so"
            source = str(ROOT / "tuning" / "bench" / "floor.c")
            words = ["gcc", "-O3", "-march=native", "-shared", "-fPIC", "-o", library, source]
            subprocess.run([*words, "-lm"], check=True)
            self.function = ctypes.CDLL(library).four_tank
        self.function.restype = ctypes.c_double

    def outcome(self, k, k1):
        import ctypes

        pointer = lambda array: array.ctypes.data_as(ctypes.POINTER(ctypes.c_double))
        double, result = ctypes.c_double, np.zeros(5)
        numbers, *arrays = (pointer(self.data[n]) for n in ("numbers", "x0", "r"))
        fixed = ctypes.c_long(self.samples), double(self.dt), 1
        gains = map(double, (k, k1, self.floor, self.high))
        return self.function(numbers, *fixed, *gains, *arrays, pointer(result)), *result[1:]


class NumbaLoop(Loop):
    def __init__(self, path):
        import four_tank

        super().__init__(path)
        self.function = four_tank.numba_loop(*self.coefficients(), self.floor, self.high)

    def outcome(self, k, k1):
        return self.function(self.data["r"], k + k1, k1, *self.data["x0"], self.dt)


class ScanLoop(Loop):
    """jax.lax.scan over a vector, as one writes it first; slopes by two tangents."""

    def __init__(self, path):
        import jax
        import jax.numpy as jnp
        from four_tank import controller, field

        super().__init__(path)
        jax.config.update("jax_enable_x64", True)
        (c, b), r = self.coefficients(), jnp.asarray(self.data["r"].T)

        def body(k, k1, state, now):
            x, total, tops = state
            u = jnp.stack(controller(c, k + k1, k1, b, self.floor, self.high, x, now, jnp))
            total, tops = total + jnp.sum((x[:2] - now) ** 2), jnp.maximum(tops, x)
            return (self.advanced(lambda x: jnp.stack(field(c, x, u, jnp)), x), total, tops), None

        def outcome(z):
            k, k1 = self.low * jnp.exp(z * self.span)
            start = jnp.asarray(self.data["x0"])
            step = lambda state, now: body(k, k1, state, now)
            (_, total, tops), _ = jax.lax.scan(step, (start, 0.0, start), r)
            return jnp.concatenate([jnp.sqrt(total / self.samples)[None], tops])

        self.function, self.slopes = jax.jit(outcome), jax.jit(jax.jacfwd(outcome))

    def advanced(self, f, x):
        a = f(x)
        p = f(x + 0.5 * self.dt * a)
        q = f(x + 0.5 * self.dt * p)
        return x + self.dt / 6 * (a + 2 * (p + q) + f(x + self.dt * q))

    def run(self, z):
        if z.tobytes() not in self.known:
            rms, *tops = np.asarray(self.function(np.clip(z, 0.0, 1.0)))
            self.known[z.tobytes()] = float(rms), (self.limits - np.array(tops))[self.limited]
        return self.known[z.tobytes()]


class DiffraxLoop(ScanLoop):
    def advanced(self, f, x):
        import diffrax

        solved = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, x, f: f(x)),
            diffrax.Tsit5(),
            *(0.0, self.dt, self.dt, x),
            args=f,
            stepsize_controller=diffrax.ConstantStepSize(),
            adjoint=diffrax.ForwardMode(),
            max_steps=2,
        )
        return solved.ys[-1]


class CasadiLoop(Loop):
    def solved(self, z):
        """z of the optimum by IPOPT, whose Hessian is an approximation; exact slopes."""
        import casadi as ca
        from four_tank import casadi_names, controller, field, runge_kutta

        (c, b), names = self.coefficients(), casadi_names()
        state, now, gains = ca.SX.sym("s", 9), ca.SX.sym("r", 2), ca.SX.sym("k", 2)
        x, total, tops = ca.vertsplit(state[:4]), state[4], state[5:]
        law = c, gains[0] + gains[1], gains[1], b, self.floor, self.high
        u = controller(*law, x, ca.vertsplit(now), names)
        after = runge_kutta(lambda x: field(c, x, u, names), tuple(x), self.dt)
        error = (x[0] - now[0]) ** 2 + (x[1] - now[1]) ** 2
        step = ca.Function(
            "step",
            [state, now, gains],
            [ca.vertcat(*after, total + error, ca.fmax(tops, state[:4]))],
        )
        unit, r, n = ca.MX.sym("z", 2), self.data["r"], self.samples
        start = np.concatenate([self.data["x0"], [0.0], self.data["x0"]])
        value = self.low * ca.exp(unit * self.span)
        end = step.fold(n)(start, r, ca.repmat(value, 1, n))
        rows = [5 + int(i) for i in np.flatnonzero(self.limited)]
        problem = {"x": unit, "f": ca.sqrt(end[4] / n), "g": ca.vertcat(*(end[i] for i in rows))}
        options = {"ipopt.hessian_approximation": "limited-memory", "ipopt.print_level": 0}
        options |= {"ipopt.sb": "yes"}  # without a banner
        solver = ca.nlpsol("s", "ipopt", problem, options | {"print_time": False})
        answer = solver(x0=z, lbx=0.0, ubx=1.0, ubg=self.limits[self.limited])
        counts = solver.stats()
        calls = counts["n_call_nlp_f"], counts["n_call_nlp_grad_f"]
        self.runs = f"{calls[0]}, {calls[1]} with gradients"
        return np.array(answer["x"]).ravel(), float(answer["f"])


def by_slsqp(loop, begin, starts):
    import scipy.optimize as so

    starts = [begin, *np.random.default_rng(0).random((starts - 1, 2))]
    limits = {"type": "ineq", "fun": lambda z: loop.run(z)[1]}
    slopes, exact = {}, hasattr(loop, "slopes")

    def slope(z):
        if z.tobytes() not in slopes:
            slopes[z.tobytes()] = np.asarray(loop.slopes(np.clip(z, 0.0, 1.0)))
        return slopes[z.tobytes()]

    more = {"jac": lambda z: slope(z)[0]} if exact else {}
    limits |= {"jac": lambda z: -slope(z)[1:][loop.limited]} if exact else {}
    words = {"bounds": [(0.0, 1.0)] * 2, "constraints": limits, "tol": 1e-10} | more
    ends = [so.minimize(lambda z: loop.run(z)[0], z, method="SLSQP", **words).x for z in starts]
    loop.runs = f"{len(loop.known)}" + (f", {len(slopes)} with gradients" if exact else "")
    return min(ends, key=loop.penalised)


def without_slopes(loop, begin, method):
    box = [(0.0, 1.0)] * 2
    if method == "cma":
        import cma

        options = {"bounds": [0.0, 1.0], "seed": 1, "verbose": -9, "tolfun": 1e-9, "tolx": 1e-7}
        return cma.fmin2(loop.penalised, begin, 0.3, options)[0]
    if method == "optuna":
        import optuna

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=0))
        study.enqueue_trial({"k": begin[0], "k1": begin[1]})
        names = "k", "k1"
        of_trial = lambda t: loop.penalised([t.suggest_float(name, 0.0, 1.0) for name in names])
        study.optimize(of_trial, n_trials=TRIALS)
        return np.array([study.best_params[name] for name in names])
    import scipy.optimize as so

    if method == "nelder-mead":
        words = {"method": "Nelder-Mead", "bounds": box, "options": {"xatol": 1e-7, "fatol": 1e-10}}
        return so.minimize(loop.penalised, begin, **words).x
    return so.differential_evolution(loop.penalised, box, seed=0, tol=1e-8).x


LOOPS = {"c": CLoop, "numba": NumbaLoop, "scan": ScanLoop, "diffrax": DiffraxLoop}
LOOPS["casadi"] = CasadiLoop


def search(path, words):
    """Search in this process, without jaxtank, and print the answer."""
    kind, method, *starts = words.split()
    loop = LOOPS[kind](path)
    begin = np.log(loop.data["start"] / loop.low) / loop.span
    if method == "ipopt":
        best, rms = loop.solved(begin)
    elif method == "slsqp":
        best = by_slsqp(loop, begin, int(*starts) if starts else 1)
    else:
        best = without_slopes(loop, begin, method)
        loop.runs = len(loop.known)
    rms = rms if method == "ipopt" else loop.run(best)[0]
    print(";".join([*(f"{v:.6g}" for v in (*loop.gains(best), rms)), str(loop.runs)]))


def main(words):
    import json

    from measuring import environment, first_number, markdown, of_command, store

    rounds, left_out = first_number(words, 3), ("JAX", "PYTHONDONTWRITEBYTECODE")
    only = words[words.index("--only") + 1] if "--only" in words else ""
    methods = {method: name for method, name in METHODS.items() if only in name}
    times, answers = {}, {}
    for _ in range(rounds):
        with tempfile.TemporaryDirectory() as folder:
            os.chmod(folder, 0o700)
            path, cache = f"{folder}/problem.npz", f"{folder}/cache"
            write_problem(path)
            for method, name in methods.items():
                words_of = [sys.executable, str(HERE), "--search", path, method]
                seconds, out = of_command(words_of, env=environment(*left_out))
                times.setdefault(name, []).append(seconds)
                answers[name] = out.strip().split(";")
            ours = [sys.executable, "-m", "jaxtank", "tune", CASE, "--nominal", "--json"]
            for call in ("first", "second"):
                name = f"`jaxtank tune --nominal`, {call} call"
                kept = environment(*left_out, JAXTANK_CACHE=cache, PYTHONPATH=str(ROOT))
                seconds, out = of_command(ours, env=kept)
                times.setdefault(name, []).append(seconds)
                result = json.loads(out)
                gains = [p["after"] for p in result["parameters"].values()]
                answers[name] = [f"{v:.6g}" for v in (*gains, result["objective"]["after"])]
                runs = result["evaluations"]
                answers[name].append(f"{runs['simulations']}, {runs['gradients']} with gradients")
    heads = [
        *("whole tune of two gains", "core time, s", "k, 1/s", "k1, 1/s", "RMS error, cm", "runs")
    ]
    rows = [[name, f"{min(t):.2f}", *answers[name]] for name, t in times.items()]
    print(markdown(heads, rows))
    if "--markdown" in words and not only:
        store(BEGIN, END, markdown(heads, rows))


if __name__ == "__main__":
    if "--search" in sys.argv:
        search(*sys.argv[2:])
    else:
        main(sys.argv[1:])

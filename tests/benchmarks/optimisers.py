"""How many simulations it takes to tune: the tuner's local searches beside derivative-free
optimisers on the same compiled cost.

    python tests/benchmarks/optimisers.py [--quick] [--problem 2 8 20] [--starts 8] [--json FILE]

Every method has the same starts, the same unit cube (logarithmic where the case says so) and the
same common random numbers. A search has arrived when it is within 0.1 % of the best cost that any
of them found. Counted are

    evaluations   of the cost, each of all scenarios; one with derivatives, or one at a tenth of the
        samples, counts as one
    runs          the same by the samples simulated: one at a tenth of the samples counts as a tenth
    work          in simulations of the cost: a pass with derivatives counts as its measured time
                  over that of one without, a pass at a tenth of the samples as its own measured
                  time over the same

Compile time is apart. Nothing is asserted here;
tests/unit/search/test_optimisers.py pins the structural cause,
the few evaluations.
"""

import argparse
import contextlib
import dataclasses
import itertools
import json
import statistics
import sys
import time
import warnings

import jax
import numpy as np
from scipy.optimize import minimize

import jaxtank  # noqa: F401  (before jax starts)
from jaxtank import presets
from jaxtank.case import Free
from jaxtank.rig.values import schedule
from jaxtank.signals.setpoints import ramps
from tuning.problem.evaluator import Evaluator
from tuning.problem.problem import Problem
from tuning.problem.scenarios import coarse_clock
from tuning.report import tables
from tuning.search.driver import Search
from tuning.search.methods import METHODS
from tuning.search.screening import distinct_starts, screen

NEAR = 1e-3
"""A search has arrived within this share above the best cost found [-]."""

STUDY = {"mean_square_error": 1.0, "mean_square_travel": 100.0}
OURS = ("trf", "coarse-trf", "slsqp")
BUDGET = {2: 500, 8: 2000, 20: 4000}
"""Evaluations that a derivative-free search may spend from one start."""


class Arrived(Exception):
    """Raised inside a rival's cost function to end it: it has arrived, or spent what it may."""


def two_gains():
    """gouta2015 backstepping, k and k1, limits off, the law sampled every 0.1 s."""
    case = presets.find("gouta2015/backstepping")
    case = case.replace(
        clock=dataclasses.replace(case.clock, dt=0.1),
        free={"controller.k": Free(1e-3, 5.0), "controller.k1": Free(1e-3, 1.0)},
    )
    return Problem(case, objective=STUDY, limits={})


def eight_gains():
    """mirakhorli state feedback, the entries of K, its own seven noisy scenarios, J = ise + 3
    input_deviation + 100 mean_square_travel.

    The squares stand for the preset's 0.1 input_travel: with noise, a sum of absolute changes grows
    with the number of samples, a mean of squared ones does not, and it has no kinks. The two prices
    are of one size at the best gains.
    """
    case = presets.find("mirakhorli/sfc")
    objective = {"ise": 1.0, "input_deviation": 3.0, "mean_square_travel": 100.0}
    return Problem(case, objective=objective, limits={})


def twenty_values(knots=20):
    """gouta2015 backstepping with k1 scheduled at `knots` values of the setpoint of tank 1, over
    a staircase through all of them.

    k keeps its printed value: at such a price of travel it would end at its lower bound at every
        knot, ten parameters that are none.
    """
    case = presets.find("gouta2015/backstepping")
    first, second = (4, 6, 8, 10, 12, 14, 16, 13, 9, 5), (5, 7, 8, 8, 10, 11, 10, 12, 8, 6)
    changes = [(20.0 + 120 * i, 0, float(r)) for i, r in enumerate(first)] + [
        (80.0 + 120 * i, 1, float(r)) for i, r in enumerate(second)
    ]
    case = case.replace(
        loop=dataclasses.replace(
            case.loop, reference=ramps((3.0, 3.0), tuple(sorted(changes)), ramp=30.0)
        ),
        clock=dataclasses.replace(case.clock, dt=0.1, duration=1300.0),
        free={"controller.k1": Free(1e-3, 1.0)},
    )
    case = schedule(case, {"controller.k1": "r1"}, np.linspace(3.0, 16.0, knots))
    return Problem(case, objective=STUDY, limits={})


PROBLEMS = {2: two_gains, 8: eight_gains, 20: twenty_values}


class Trace:
    """What a search saw: (seconds, evaluations, runs, work) spent when each cost was known, and the
    cost.
    """

    def __init__(self):
        self.rows, self.began = [], time.perf_counter()

    def add(self, cost, evaluations, runs, work):
        """Enter one cost and what it took."""
        last = self.rows[-1][1:4] if self.rows else (0, 0.0, 0.0)
        spent = (last[0] + evaluations, last[1] + runs, last[2] + work)
        self.rows.append(
            (time.perf_counter() - self.began, *spent, cost if np.isfinite(cost) else np.inf)
        )

    @property
    def best(self):
        """Lowest cost seen."""
        return min((row[4] for row in self.rows), default=np.inf)

    def until(self, target):
        """(seconds, evaluations, runs, work) when the cost first was at most `target`; None if it
        never was.
        """
        return next((row[:4] for row in self.rows if row[4] <= target), None)

    def within(self, seconds):
        """Lowest cost known after so many seconds."""
        return min((row[4] for row in self.rows if row[0] <= seconds), default=np.inf)


def prices(problem, z, batch, rounds=7):
    """What things cost, in seconds: {what: (compile, run)}, medians over interleaved rounds. lanes:
    size of a population run as one batch.
    """
    calls = {
        "simulation": lambda z: problem.screen(z[None]),
        "pass": problem.point,
        "rough pass": problem.coarse_point,
        "population": lambda z: problem.screen(np.tile(z, (batch, 1))),
    }
    spent = {name: [] for name in calls}
    for k in range(rounds + 1):
        for name, call in calls.items():
            began = time.perf_counter()
            # elsewhere each time: what was evaluated before is remembered
            call(np.clip(z + 1e-7 * k, 0, 1))
            spent[name].append(time.perf_counter() - began)
    return {name: (s[0], statistics.median(s[1:])) for name, s in spent.items()}


def ours(problem, method, z, reference, price, iterations):
    """Trace of a local search of tuning.solvers."""
    trace, search = Trace(), None
    unit = price["simulation"][1]
    tenth = coarse_clock(problem.clock).samples / problem.clock.samples

    def seen(search):
        coarse = len(search.history) == seen.known
        seen.known = len(search.history)
        what = "rough pass" if coarse else "pass"
        spent = (1, tenth if coarse else 1.0, price[what][1] / unit)
        trace.add(np.inf if coarse else search.history[-1][1], *spent)

    seen.known = 0
    search = Search(Evaluator(problem), reference, seen)
    METHODS[method](search, z, iterations)
    return trace


def rival(problem, method, z, seed, stop, budget, seconds=np.inf):
    """Trace of a derivative-free optimiser, ended at the cost `stop`, after `budget` evaluations or
    some seconds.
    """
    trace, count = Trace(), len(z)

    def costs(zs):
        found, _ = problem.screen(np.clip(zs, 0.0, 1.0))
        found = np.where(np.isfinite(found), found, 1e9)
        trace.add(float(found.min()), len(zs), len(zs), len(zs))
        seconds_gone, gone = trace.rows[-1][:2]
        if trace.rows[-1][4] <= stop or gone >= budget or seconds_gone >= seconds:
            raise Arrived
        return found

    def cost(z):
        return float(costs(np.asarray(z)[None])[0])

    with contextlib.suppress(Arrived):
        RIVALS[method](cost, costs, z, count, seed, budget)
    return trace


def nelder_mead(cost, costs, z, count, seed, budget):
    options = {"maxfev": budget, "xatol": 1e-9, "fatol": 1e-9, "adaptive": count > 2}
    minimize(cost, z, method="Nelder-Mead", bounds=[(0, 1)] * count, options=options)


def cobyqa(cost, costs, z, count, seed, budget, **options):
    minimize(
        cost, z, method="COBYQA", bounds=[(0, 1)] * count, options={"maxfev": budget, **options}
    )


def cobyqa_small(cost, costs, z, count, seed, budget):
    cobyqa(cost, costs, z, count, seed, budget, initial_tr_radius=0.1)


def cma_es(cost, costs, z, count, seed, budget):
    import cma

    strategy = cma.CMAEvolutionStrategy(
        z, 0.2, {"bounds": [0, 1], "seed": seed + 1, "verbose": -9, "tolfun": 0, "tolfunhist": 0}
    )
    while not strategy.stop():
        population = strategy.ask()
        strategy.tell(population, costs(np.array(population)))


def tpe(cost, costs, z, count, seed, budget):
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed, multivariate=True))
    names = [f"z{i}" for i in range(count)]
    study.enqueue_trial(dict(zip(names, map(float, z))))
    study.optimize(
        lambda trial: cost([trial.suggest_float(n, 0.0, 1.0) for n in names]), n_trials=budget
    )


RIVALS = {
    "Nelder-Mead": nelder_mead,
    "COBYQA": cobyqa,
    "COBYQA, radius 0.1": cobyqa_small,
    "CMA-ES": cma_es,
    "TPE": tpe,
}
NEEDS = {"CMA-ES": "cma", "TPE": "optuna"}


def available(names):
    """Those of `names` whose package is here; the others are named on stderr."""
    found = []
    for name in names:
        try:
            if name in NEEDS:
                __import__(NEEDS[name])
            found.append(name)
        except ImportError:
            print(f"{name} is left out: pip install {NEEDS[name]}", file=sys.stderr)
    return found


def starts_of(problem, count):
    """The starts that `tune` would take: the case's own values and the best distinct ones of 64
    Sobol points, z of the unit cube.
    """
    screened, _ = screen(Evaluator(problem), 64, 0)
    return distinct_starts(screened.zs, screened.costs, count, problem.start())


def compare(parameters, options):
    """Every method from every start. Returns what is printed, as plain numbers."""
    problem = PROBLEMS[parameters]()
    starts = starts_of(
        problem, options.starts if parameters != 20 else min(options.starts, options.race_starts)
    )
    batch = 4 + int(3 * np.log(parameters))  # what cma takes
    price = prices(problem, starts[0], batch)
    unit = price["simulation"][1]
    reference = problem.point(starts[0])
    traces = {
        m: [ours(problem, m, z, reference, price, options.iterations) for z in starts] for m in OURS
    }
    best = min(t.best for many in traces.values() for t in many)
    raced = available(RIVALS) if parameters != 20 else []
    for method in raced:
        few = options.slow_starts if method == "TPE" else len(starts)
        budget = options.budget or BUDGET[parameters]
        budget = min(budget, options.trials) if method == "TPE" else budget
        # a little inside the 0.1 %, so that a rival that finds better still is seen to
        traces[method] = [
            rival(problem, method, z, k, best * (1 + 0.8 * NEAR), budget)
            for k, z in enumerate(starts[:few])
        ]
    best = min(t.best for many in traces.values() for t in many)
    found = {
        "parameters": parameters,
        "scenarios": len(problem.runs),
        "samples": problem.clock.samples,
        "best": best,
        "compile_s": {name: p[0] for name, p in price.items()},
        "run_ms": {name: 1e3 * p[1] for name, p in price.items()},
        "relative": {
            name: p[1] / unit / (batch if name == "population" else 1) for name, p in price.items()
        },
        "methods": {m: summary(many, best * (1 + NEAR)) for m, many in traces.items()},
    }
    if parameters == 20:
        found["race"] = race(problem, traces, starts, best * (1 + NEAR))
    return found


def summary(traces, target):
    """Successes, medians and ranges of a method's traces; a search that never arrived counts as
    infinite in the medians.
    """
    reached = [t.until(target) for t in traces]
    columns = {}
    for i, name in enumerate(("seconds", "evaluations", "runs", "work")):
        values = [np.inf if r is None else r[i] for r in reached]
        middle = statistics.median(values)
        columns[name] = {"median": middle, "low": min(values), "high": max(values)}
    return {"starts": len(traces), "successes": sum(r is not None for r in reached), **columns}


def race(problem, traces, starts, target):
    """Against CMA-ES in five times the wall time, from each start: the costs of both, when ours has
    arrived and when it has ended.
    """
    rows = []
    if not available(["CMA-ES"]):
        return rows
    limit = 5 * max(t.rows[-1][0] for m in ("trf", "coarse-trf") for t in traces[m])
    for k, z in enumerate(starts):
        theirs = rival(problem, "CMA-ES", z, k, -np.inf, 10**9, limit)
        for method in ("trf", "coarse-trf"):
            ours = traces[method][k]
            near = ours.until(target) or ours.rows[-1]
            for when, (seconds, passes, *_) in (("arrived", near), ("ended", ours.rows[-1])):
                until = [row[1] for row in theirs.rows if row[0] <= 5 * seconds]
                row = {"method": method, "start": k, "when": when, "seconds": seconds}
                row |= {"evaluations": passes, "ours": ours.within(seconds)}
                row |= {"cma": theirs.within(5 * seconds)}
                rows.append(row | {"cma_evaluations": max(until, default=0)})
    return rows


def row_of(m, least):
    """The cells of a method's row; least: {column: median of the best derivative-free one}, {} for
    those themselves.
    """
    number = lambda v, digits: f"{v:.{digits}g}" if np.isfinite(v) else "-"
    whole = lambda v: f"{v:.0f}" if np.isfinite(v) else "-"
    spread = lambda c, f: f"{f(m[c]['median'])} ({f(m[c]['low'])} to {f(m[c]['high'])})"
    ratio = lambda c: f"{least[c] / m[c]['median']:.1f}" if c in least else ""
    return [
        f"{m['successes']}/{m['starts']}",
        *(spread(c, whole) for c in ("evaluations", "runs", "work")),
        *(ratio(c) for c in ("evaluations", "runs", "work")),
        spread("seconds", lambda v: number(v, 2)),
    ]


def shown(found):
    """The text of one problem's result."""
    free = [m for m in found["methods"] if m in RIVALS]
    least = {
        c: min((found["methods"][m][c]["median"] for m in free), default=np.inf)
        for c in ("evaluations", "runs", "work")
    }
    rows = [
        [name, *row_of(m, least if free and name in OURS else {})]
        for name, m in found["methods"].items()
    ]
    head = [
        *("method", "arrived", "evaluations", "runs", "work", "fewer evaluations", "fewer runs"),
        *("less work", "seconds"),
    ]
    cost = ", ".join(
        f"{n} {found['run_ms'][n]:.2f} ms ({found['relative'][n]:.2f})" for n in found["run_ms"]
    )
    text = [
        (
            f"{found['parameters']} parameters, {found['scenarios']} scenario(s) of"
            f" {found['samples']} samples; best cost {found['best']:.6g}"
        ),
        (
            f"run times (over a simulation; population: per lane): {cost}; compiling took"
            f" {sum(found['compile_s'].values()):.0f} s"
        ),
        tables.table(rows, head),
    ]
    for method, when in itertools.product(("trf", "coarse-trf"), ("arrived", "ended")):
        mine = [r for r in found.get("race", []) if (r["method"], r["when"]) == (method, when)]
        if mine:
            middle = {
                k: statistics.median([r[k] for r in mine])
                for k in ("seconds", "evaluations", "cma_evaluations")
            }
            over = [100 * (r["cma"] / r["ours"] - 1) for r in mine]
            text.append(
                f"{method}, when it has {when}, against CMA-ES in five times that wall time: lower"
                f" from {sum(o > 0 for o in over)} of {len(mine)} starts; CMA-ES is"
                f" {statistics.median(over):.2g} % above it ({min(over):.2g} to {max(over):.2g});"
                f" {middle['seconds']:.2f} s, {middle['evaluations']:.0f} passes; CMA-ES"
                f" {middle['cma_evaluations']:.0f} simulations"
            )
    return "\n".join(text)


def plain(value):
    """`value` for JSON: what is not finite becomes None."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, list):
        return [plain(v) for v in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


COUNTS = {
    "starts": (8, "local searches of each method"),
    "race-starts": (3, "starts of the problem of 20 parameters"),
    "slow-starts": (3, "searches of TPE"),
    "budget": (0, "evaluations of a derivative-free search; 0: 500 or 2000"),
    "trials": (300, "evaluations of a TPE search"),
    "iterations": (100, "evaluations of a local search of ours"),
}


def main(arguments=None):
    """Run the problems asked for and print a table of each."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    sizes = list(PROBLEMS)
    parser.add_argument("--problem", type=int, nargs="+", choices=sizes, default=sizes)
    parser.add_argument("--quick", action="store_true", help="three starts, small budgets")
    for name, (default, words) in COUNTS.items():
        parser.add_argument(f"--{name}", type=int, default=default, help=f"{words} ({default})")
    parser.add_argument("--json", metavar="FILE", help="write the numbers to a file as well")
    options = parser.parse_args(arguments)
    if options.quick:
        options.starts, options.slow_starts, options.trials, options.budget = 3, 1, 60, 300
    jax.config.update("jax_enable_x64", True)
    warnings.filterwarnings("ignore", module="cma|optuna")
    results = []
    for parameters in options.problem:
        results.append(compare(parameters, options))
        print(shown(results[-1]), end="\n\n", flush=True)
    if options.json:
        with open(options.json, "w") as file:
            json.dump(plain(results), file, indent=1)


if __name__ == "__main__":
    main()

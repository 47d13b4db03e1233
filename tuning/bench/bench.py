"""`jaxtank bench`: time of a closed-loop step here, beside a C loop; for command and benchmarks."""

import ctypes
import functools
import re
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np

from jaxtank import presets
from jaxtank.core.tree import with_values
from jaxtank.loop import run as lp
from tuning.problem.provenance import provenance
from tuning.problem.scenarios import noisy
from tuning.report import tables

MEASURES = ("rms_error_total", "max_level")
CASES = (
    "gouta2015/backstepping",
    "gouta2015/ngpc",
    "gouta2015/backstepping-ff",
    "gouta2015/ngpc-boxqp",
)
SOURCE = Path(__file__).with_name("floor.c")


def c_loop(folder):
    """Return the C loop of floor.c, built by gcc -O3 in `folder`; None without gcc."""
    if shutil.which("gcc") is None:
        return None
    library = Path(folder) / "floor.so"
    subprocess.run(
        ["gcc", "-O3", "-march=native", "-shared", "-fPIC", "-o", str(library), str(SOURCE), "-lm"],
        check=True,
        capture_output=True,
    )
    function = ctypes.CDLL(str(library)).four_tank
    function.restype = ctypes.c_double
    return function


def c_runner(function, case, rk4=True):
    """Return a call of the C loop for a case: () -> (rms error [cm], highest levels [cm])."""
    plant, controller, clock = case.loop.plant, case.loop.controller, case.clock
    hydraulics = (plant.area, plant.drain[:2], plant.orifice, plant.pump_gain)
    numbers = np.concatenate([*hydraulics, [float(plant.gravity), plant.knee]])
    r = np.ascontiguousarray(np.array(case.loop.reference.sample(clock)[0]))
    x0, result = np.array(case.loop.x0, dtype=float), np.zeros(5)
    pointer = lambda array: array.ctypes.data_as(ctypes.POINTER(ctypes.c_double))
    gains = (controller.k, controller.k1, controller.level_floor, case.loop.actuator.high[0])
    settings = [ctypes.c_double(float(v)) for v in gains]
    samples, dt = ctypes.c_long(clock.samples), ctypes.c_double(float(clock.dt))

    def run():
        arrays = map(pointer, (x0, r, result))
        rms = function(pointer(numbers), samples, dt, int(rk4), *settings, *arrays)
        return rms, result[1:].copy()

    return run


def timed(calls, rounds):
    """Return {name: [seconds of each round]} and {name: first result} of functions."""
    results = {name: jax.block_until_ready(call()) for name, call in calls.items()}
    seconds = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            began = time.perf_counter()
            jax.block_until_ready(call())
            seconds[name].append(time.perf_counter() - began)
    return seconds, results


def measure(rounds=7):
    """Return the figures of `jaxtank bench`, as a dict for JSON."""
    cases = {name: presets.find(name) for name in CASES}
    first, calls, compile_s = cases[CASES[0]], _calls(cases), {}
    for name, call in calls.items():
        began = time.perf_counter()
        jax.block_until_ready(call())
        compile_s[name] = time.perf_counter() - began
    with tempfile.TemporaryDirectory() as folder:
        function = c_loop(folder)
        if function is not None:
            calls[C_LOOP] = c_runner(function, first)
        seconds, results = timed(calls, rounds)
    medians = {name: statistics.median(s) for name, s in seconds.items()}
    rows = {
        name: {
            "ns_per_step": 1e9 * medians[name] / first.clock.samples,
            "ms": 1e3 * medians[name],
            "spread": (max(s) - min(s)) / medians[name],
            "first_call_s": compile_s.get(name),
            "times_the_run": medians[name] / medians[CASES[0]],
        }
        for name, s in seconds.items()
    }
    origin = provenance(first, None)
    beside, notes = {}, [] if origin["xla_option"] else [OFF]
    if function is None:
        notes.append("no gcc here, so there is no C loop to compare with")
    else:
        rms, top = results[C_LOOP]
        error = abs(rms - float(results[CASES[0]]["rms_error_total"]))
        level = np.max(np.abs(top - np.asarray(results[CASES[0]]["max_level"])))
        ratios = [a / b for a, b in zip(seconds[CASES[0]], seconds[C_LOOP])]
        beside["ratio_to_c"] = statistics.median(ratios)
        beside["difference_to_c_cm"] = float(max(error, level))
    if origin["backend"] != "cpu":
        notes.append(
            f"these runs are on {origin['backend']}: a single loop is a chain of small steps and"
            " belongs on a CPU"
        )
    figures = {"steps": first.clock.samples, "rounds": rounds, "rows": rows, **beside}
    return figures | {"provenance": origin, "notes": notes}


C_LOOP = "C loop, backstepping"


def _calls(cases) -> dict[str, Callable[[], Any]]:
    """{name: call} of the timed programs: the cases, and two derivatives of the first one."""
    first = cases[CASES[0]]
    gains = {"controller.k": np.float64(0.03), "controller.k1": np.float64(0.088)}

    def error(values):
        measures = lp.evaluate(with_values(first.loop, values), first.clock, MEASURES)
        return measures["rms_error_total"]

    bind, both = functools.partial, "gradient, Gauss-Newton and maxima for 2 gains"
    runs: dict[str, Any] = {
        n: bind(lp.evaluate, case.loop, case.clock, MEASURES) for n, case in cases.items()
    }
    runs["jacfwd for 2 gains"] = bind(jax.jit(jax.jacfwd(error)), gains)
    runs[both] = bind(lp.sensitivities, first.loop, first.clock, MEASURES, gains)
    return runs


def text(figures):
    """Return the page of `jaxtank bench`."""
    rows = []
    for name, r in figures["rows"].items():
        first = "-" if r["first_call_s"] is None else f"{r['first_call_s']:.2f}"
        times = [f"{r['ns_per_step']:.0f}", f"{r['ms']:.2f}", f"{100 * r['spread']:.0f} %", first]
        rows.append([name, *times, f"{r['times_the_run']:.2f}"])
    lines = [
        f"one run of {figures['steps']} steps, float64, {figures['provenance']['integrator']};"
        f" medians of {figures['rounds']} interleaved rounds",
        "",
        tables.table(rows, ["run", "ns/step", "ms", "spread", "first call s", "x backstepping"]),
    ]
    if "ratio_to_c" in figures:
        lines.append(
            "\nbackstepping over the C loop of the same arithmetic (gcc -O3 -march=native):"
            f" {figures['ratio_to_c']:.2f}; the two agree to {figures['difference_to_c_cm']:.1e} cm"
        )
    return "\n".join([*lines, *figures["notes"]])


def is_one_function(program, samples):
    """Return whether XLA runs the time loop of a compiled program as one function."""
    call = r'to_apply=(%[\w.-]+), frontend_attributes={xla_cpu_small_call="true"'
    small, inside = set(re.findall(call, program)), None
    for line in program.splitlines():
        if line.startswith(("%", "ENTRY")):
            inside = line.split()[0]
        elif " while(" in line and inside in small and f'_count":{{"n":"{samples}"}}' in line:
            return True
    return False


BLOCKING = ("custom-call", "scatter", "sort", "fft", "partition-id", "outfeed", "infeed")
"""Operations that keep XLA from compiling a loop to one function (methods 2.1): LAPACK, callbacks,
`.at[].set`, sorting.
"""

OFF = (
    "the XLA options are off (JAXTANK_XLA_OPTION=0, or jax started before jaxtank): each operation"
    " of the loop is dispatched by itself"
)


def reasons(program, samples, option, dtype, compiled):
    """Return why a run is slower or less exact than it could be, as sentences."""
    # program: text of the compiled run; samples: of its loop; option: whether the XLA options are
    # on; dtype: of the levels; compiled: how many programs three further runs compiled.
    sentences = []
    if not is_one_function(program, samples):
        named = ", ".join(word for word in BLOCKING if f" {word}(" in program)
        holds = named or "more than XLA takes for a small loop"
        sentences.append(
            OFF if not option else f"the time loop is not one function: it holds {holds}"
        )
    if dtype == np.float32:
        sentences.append(
            "float32: less exact, and no faster for one run; a batch of runs takes half the time"
        )
    if compiled:
        sentences.append(
            f"traced anew at every call: {compiled} of 3 further runs compiled a program (a static"
            " field changes between calls)"
        )
    return sentences


def measure_cases(cases, rounds=3):
    """Return the time of a run with two measures of each of {name: Case}, median of `rounds`."""
    compilations = cast(Any, lp.evaluate_compiled)._cache_size
    rows = {}
    for name, case in cases.items():
        key = jax.random.key(0) if noisy(case) else None
        program = lp.evaluate_compiled.lower(case.loop, case.clock, MEASURES, key, False)
        began = time.perf_counter()
        program = program.compile().as_text()
        first = time.perf_counter() - began
        run = functools.partial(lp.evaluate, case.loop, case.clock, MEASURES, key)
        seconds, results = timed({name: run}, rounds)
        median, before = statistics.median(seconds[name]), compilations()
        for _ in range(3):
            run()
        option, samples = provenance(case, None)["xla_option"], case.clock.samples
        dtype = results[name]["rms_error_total"].dtype
        rows[name] = {
            "ns_per_step": 1e9 * median / samples,
            "ms": 1e3 * median,
            "samples": samples,
            "one_function": is_one_function(program, samples),
            "first_call_s": first,
            "reasons": reasons(program, samples, option, dtype, compilations() - before),
        }
    return rows


def text_of_cases(figures):
    """Return the page of `jaxtank bench CASE ...`."""
    rows = []
    for name, r in figures.items():
        whole = "yes" if r["one_function"] else "no"
        cells = [f"{r['ns_per_step']:.0f}", r["samples"], f"{r['ms']:.2f}", whole]
        rows.append([name, *cells, f"{r['first_call_s']:.1f}"])
    why = [f"{name}: {reason}" for name, r in figures.items() for reason in r["reasons"]]
    heads = ["case", "ns/step", "steps", "ms", "one function", "compile s"]
    return "\n".join([tables.table(rows, heads), *why])

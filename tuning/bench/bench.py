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


def _compilations():
    """How often `evaluate` has been compiled."""
    return cast(Any, lp.evaluate_compiled)._cache_size()


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
    numbers = np.concatenate(
        [
            plant.area,
            plant.drain[:2],
            plant.orifice,
            plant.pump_gain,
            [float(plant.gravity), plant.knee],
        ]
    )
    r = np.ascontiguousarray(np.array(case.loop.reference.sample(clock)[0]))
    x0, result = np.array(case.loop.x0, dtype=float), np.zeros(5)

    def pointer(array):
        return array.ctypes.data_as(ctypes.POINTER(ctypes.c_double))

    real = [
        float(clock.dt),
        float(controller.k),
        float(controller.k1),
        float(controller.level_floor),
        float(case.loop.actuator.high[0]),
    ]
    dt, *rest = (ctypes.c_double(v) for v in real)

    def run():
        rms = function(
            pointer(numbers),
            ctypes.c_long(clock.samples),
            dt,
            int(rk4),
            *rest,
            pointer(x0),
            pointer(r),
            pointer(result),
        )
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
    found = {
        "steps": first.clock.samples,
        "rounds": rounds,
        "rows": rows,
        "provenance": provenance(first, None),
        **_beside_c(seconds, results),
    }
    found["notes"] = _notes(found, function)
    return found


C_LOOP = "C loop, backstepping"


def _calls(cases) -> dict[str, Callable[[], Any]]:
    """{name: call} of what is timed: the cases, and two derivatives of the first one."""
    first = cases[CASES[0]]
    gains = {"controller.k": np.float64(0.03), "controller.k1": np.float64(0.088)}

    def error(values):
        measures = lp.evaluate(with_values(first.loop, values), first.clock, MEASURES)
        return measures["rms_error_total"]

    derivative = jax.jit(jax.jacfwd(error))
    calls: dict[str, Callable[[], Any]] = {
        name: functools.partial(lp.evaluate, case.loop, case.clock, MEASURES)
        for name, case in cases.items()
    }
    calls["jacfwd for 2 gains"] = functools.partial(derivative, gains)
    calls["gradient, Gauss-Newton and maxima for 2 gains"] = functools.partial(
        lp.sensitivities, first.loop, first.clock, MEASURES, gains
    )
    return calls


def _beside_c(seconds, results):
    """Time and numbers of the first case beside those of the C loop, where there is one."""
    if C_LOOP not in seconds:
        return {}
    rms, top = results[C_LOOP]
    ours = results[CASES[0]]
    ratios = [a / b for a, b in zip(seconds[CASES[0]], seconds[C_LOOP])]
    error = abs(rms - float(ours["rms_error_total"]))
    level = np.max(np.abs(top - np.asarray(ours["max_level"])))
    return {"ratio_to_c": statistics.median(ratios), "difference_to_c_cm": float(max(error, level))}


def _notes(found, function):
    notes = []
    if not found["provenance"]["xla_option"]:
        notes.append(OFF)
    if function is None:
        notes.append("no gcc here, so there is no C loop to compare with")
    if found["provenance"]["backend"] != "cpu":
        notes.append(
            f"these runs are on {found['provenance']['backend']}: a single loop is a chain of small"
            " steps and belongs on a CPU"
        )
    return notes


def text(found):
    """Return the page of `jaxtank bench`."""
    rows = [
        [
            n,
            f"{r['ns_per_step']:.0f}",
            f"{r['ms']:.2f}",
            f"{100 * r['spread']:.0f} %",
            "-" if r["first_call_s"] is None else f"{r['first_call_s']:.2f}",
            f"{r['times_the_run']:.2f}",
        ]
        for n, r in found["rows"].items()
    ]
    lines = [
        (
            f"one run of {found['steps']} steps, float64, {found['provenance']['integrator']};"
            f" medians of {found['rounds']} interleaved rounds"
        ),
        "",
        tables.table(rows, ["run", "ns/step", "ms", "spread", "first call s", "x backstepping"]),
    ]
    if "ratio_to_c" in found:
        lines += [
            "",
            (
                "backstepping over the C loop of the same arithmetic (gcc -O3 -march=native):"
                f" {found['ratio_to_c']:.2f}; the two agree to {found['difference_to_c_cm']:.1e} cm"
            ),
        ]
    return "\n".join([*lines, *found["notes"]])


def is_one_function(program, samples):
    """Return whether XLA runs the time loop of a compiled program as one function."""
    small = set(
        re.findall(r'to_apply=(%[\w.-]+), frontend_attributes={xla_cpu_small_call="true"', program)
    )
    inside = None
    for line in program.splitlines():
        if line.startswith(("%", "ENTRY")):
            inside = line.split()[0]
        elif (
            " while(" in line
            and f'"known_trip_count":{{"n":"{samples}"}}' in line
            and inside in small
        ):
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
    found = []
    if not is_one_function(program, samples):
        named = [word for word in BLOCKING if f" {word}(" in program]
        found.append(
            OFF
            if not option
            else (
                "the time loop is not one function: it holds"
                f" {', '.join(named) or 'more than XLA takes for a small loop'}"
            )
        )
    if dtype == np.float32:
        found.append(
            "float32: less exact, and no faster for one run; a batch of runs takes half the time"
        )
    if compiled:
        found.append(
            f"traced anew at every call: {compiled} of 3 further runs compiled a program (a static"
            " field changes between calls)"
        )
    return found


def measure_cases(cases, rounds=3):
    """Return the time of a run with two measures of each of {name: Case}, median of `rounds`."""
    found = {}
    for name, case in cases.items():
        key = jax.random.key(0) if noisy(case) else None
        program = lp.evaluate_compiled.lower(case.loop, case.clock, MEASURES, key, False)
        began = time.perf_counter()
        text_of_program = program.compile().as_text()
        first = time.perf_counter() - began
        seconds, results = timed(
            {name: lambda case=case, key=key: lp.evaluate(case.loop, case.clock, MEASURES, key)},
            rounds,
        )
        median = statistics.median(seconds[name])
        before = _compilations()
        for _ in range(3):
            lp.evaluate(case.loop, case.clock, MEASURES, key)
        found[name] = {
            "ns_per_step": 1e9 * median / case.clock.samples,
            "ms": 1e3 * median,
            "samples": case.clock.samples,
            "one_function": is_one_function(text_of_program, case.clock.samples),
            "first_call_s": first,
            "reasons": reasons(
                text_of_program,
                case.clock.samples,
                provenance(case, None)["xla_option"],
                results[name]["rms_error_total"].dtype,
                _compilations() - before,
            ),
        }
    return found


def text_of_cases(found):
    """Return the page of `jaxtank bench CASE ...`."""
    rows = [
        [
            name,
            f"{r['ns_per_step']:.0f}",
            r["samples"],
            f"{r['ms']:.2f}",
            "yes" if r["one_function"] else "no",
            f"{r['first_call_s']:.1f}",
        ]
        for name, r in found.items()
    ]
    why = [f"{name}: {reason}" for name, r in found.items() for reason in r["reasons"]]
    return "\n".join(
        [tables.table(rows, ["case", "ns/step", "steps", "ms", "one function", "compile s"]), *why]
    )

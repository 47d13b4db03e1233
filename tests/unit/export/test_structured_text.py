"""Structured Text: parsed by blark, and run by a small interpreter against the simulation."""

import functools
import math
import os
import re
import subprocess

import jax
import numpy as np
import pytest
from helpers import GCC, PROGRAMMES, needs_gcc, opened, signals_of

import jaxtank
from jaxtank import rig
from jaxtank.export import export, structured_text
from jaxtank.export.statements import Ref

SAMPLES = 1000
TOKENS = re.compile(r"\(\*.*?\*\)|:=|<=|>=|<>|\.\.|\d+(?:\.\d+)?(?:E[+-]?\d+)?|\w+|\S", re.S)
WORDS = {"AND": "and", "OR": "or", "NOT": "not", "TRUE": "True", "FALSE": "False", "=": "=="}
WORDS |= {"<>": "!=", ":=": "=", "MOD": "%"}
KNOWN = {
    "SEL": lambda g, no, yes: yes if g else no,
    "SQRT": lambda x: math.sqrt(x) if x >= 0.0 else math.nan,
    "EXPT": lambda x, y: x**y if x > 0.0 or y == round(y) else math.nan,
    **{"MAX": max, "MIN": min, "ABS": abs, "TRUNC": math.trunc, "DINT_TO_LREAL": float},
    **{"EXP": math.exp, "LN": math.log, "LREAL_TO_DINT": round},
}


class Block:
    """A function block, whose body is translated statement by statement to Python."""

    def __init__(self, text):
        tokens = [t for t in TOKENS.findall(text) if not t.startswith("(*")]
        assert tokens[0] == "FUNCTION_BLOCK" and tokens[-1] == "END_FUNCTION_BLOCK"
        self.variables, self.whole, at = {}, set(), 2
        while tokens[at].startswith("VAR"):
            end = tokens.index("END_VAR", at)
            start = at + 1 + (tokens[at + 1] == "CONSTANT")
            for declaration in split(tokens[start:end]):
                self._declare(declaration)
            at = end + 1
        lines, depth = [], 1
        for words in split(tokens[at:-1], "THEN", "DO", "ELSE"):
            if words[0] in self.whole:  # whole numbers are divided without a rest
                words = ["//" if word == "/" else word for word in words]
            depth -= words[0] in ("END_IF", "END_FOR", "ELSE", "ELSIF")
            if not words[0].startswith("END_"):
                lines.append("    " * depth + python(words))
            depth += words[-1] in ("THEN", "DO", "ELSE")
        names = ", ".join(self.variables)
        code = f"def body(V):\n    {names}, = V.values()\n" + "\n".join(lines)
        code += f"\n    V.update({', '.join(f'{n}={n}' for n in self.variables)})"
        space = dict(KNOWN)
        exec(code, space)
        self.body = space["body"]

    def _declare(self, words):
        name, kind = words[0], words[words.index(":") + 1]
        values = words[words.index(":=") + 1 :] if ":=" in words else []
        if kind == "DINT":
            self.whole.add(name)
        if kind != "ARRAY":
            self.variables[name] = eval("".join(values)) if values else {"BOOL": False}.get(kind, 0)
            return
        ends = [int(words[i + 1]) + 1 for i, w in enumerate(words) if w == ".."]
        flat = eval(expression(values)) if values else [0.0] * math.prod(ends)
        array = np.array(flat, dtype=int if "DINT" in words else float).reshape(ends)
        self.variables[name] = array

    def __call__(self, **inputs):
        self.variables.update(inputs)
        self.body(self.variables)
        return self.variables["pump"].copy()


def split(tokens, *openers):
    """Statements, each a list of tokens: up to ";" or to a word that opens a block."""
    words = []
    for token in tokens:
        if token == ";":
            if words:
                yield words
            words = []
            continue
        words.append(token)
        if token in openers:
            yield words
            words = []


def python(words):
    """A statement of Structured Text in Python."""
    if words[0] == "FOR":
        name, rest = words[1], words[3:-1]
        to, by = rest.index("TO"), rest.index("BY") if "BY" in rest else len(rest)
        first, last = expression(rest[:to]), expression(rest[to + 1 : by])
        step = expression(rest[by + 1 :]) or "1"
        return f"for {name} in range({first}, {last} + (1 if {step} > 0 else -1), {step}):"
    if words[0] in ("IF", "ELSIF"):
        return f"{'if' if words[0] == 'IF' else 'elif'} {expression(words[1:-1])}:"
    return {"ELSE": "else:", "EXIT": "break"}.get(words[0]) or expression(words)


def expression(words):
    return " ".join(WORDS.get(word, word) for word in words)


@functools.cache
def block_and_run(name):
    """The function block of a case, and a run without noise of 1,000 samples, as host arrays."""
    case = opened(name)
    values = {"clock.duration": (SAMPLES - 1) * case.clock.dt, "sensor.noise": 0.0}
    case = rig.set_values(case, {**values, "actuator.delay": 0.0})
    run = jax.tree.map(np.asarray, jaxtank.simulate(case.loop, case.clock))
    return export(case, "st", name="law"), run, signals_of(case)


SLOW = pytest.mark.slow
ALL = ["cascaded/pi", "mirakhorli/sfc", "gouta2015/ngpc", "gouta2015/backstepping-boxqp"]
ALL += ["gouta2022/chadpc", "gouta2022/fopi", "calofir/backstepping", "mirakhorli/hybrid"]
ALL += ["mirakhorli/lqi", "khalid/gpc-nc2", "khalid/gpc-nc2-constrained"]
ALL += ["khalid/laguerre-constrained", "gouta2015/nmpc", "moving_horizon"]
NAMES = [*ALL[:2], *(pytest.param(name, marks=SLOW) for name in ALL[2:])]


@pytest.mark.extended
@pytest.mark.slow_for("mirakhorli/sfc")
@pytest.mark.parametrize("name", NAMES)
def test_structured_text_gives_the_inputs_of_the_loop(name):
    text, run, signals = block_and_run(name)
    block, reach = Block(text), max(1.0, float(np.abs(run.applied).max()))
    samples = 100 if "khalid" in name else PROGRAMMES.get(name, SAMPLES)
    for k in range(min(len(run.t), samples)):
        r, dr, ddr = (v[k] for v in signals)
        words = {"level": run.y[k], "setpoint": r, "setpoint_rate": dr, "setpoint_second": ddr}
        u = block(time_s=float(run.t[k]), **words)
        np.testing.assert_allclose(u, run.applied[k], atol=1e-9 * reach, rtol=0)


def test_manual_operation_and_a_changed_gain_of_structured_text():
    """A PI goes on from the manual input, with the gain that it then has."""
    block = Block(block_and_run("cascaded/pi")[0])
    signals = {"level": np.array([2.0, 3.0]), "setpoint": np.array([3.5])}
    for _ in range(3):
        block(**signals)
    assert block(**signals, manual=True, manual_input=np.array([4.0])) == 4.0
    assert block(**signals, manual=False) == pytest.approx(4.0, abs=1e-12)
    block.variables["controller_Ti"][:] = 50.0
    block(**signals)
    before, after = block(**signals), block(**signals)
    Kc = block.variables["controller_Kc"][0]
    assert after - before == pytest.approx(4.0 * Kc / 50.0 * 0.5, abs=1e-12)


@pytest.mark.slow
def test_structured_text_is_of_the_language():
    """By the grammar of blark, which is not ours."""
    parser = pytest.importorskip("blark.parse", reason="blark is not installed")
    result = parser.parse_source_code(block_and_run("cascaded/pi")[0])
    assert result.exception is None, result.exception


@pytest.mark.parametrize("name", ["cascaded/pi", pytest.param("gouta2022/fopi", marks=SLOW)])
def test_structured_text_is_of_the_compilers_that_take_less(name):
    """No array in VAR_TEMP and no literal beyond single precision, which matiec does not take."""
    text = re.sub(r"\(\*.*?\*\)", "", block_and_run(name)[0], flags=re.S)
    (passing,) = re.findall(r"VAR_TEMP(.*?)END_VAR", text, re.S)
    assert passing.strip() and "ARRAY" not in passing
    literals = [abs(float(v)) for v in re.findall(r"[^\w.](\d+\.\d*(?:E[-+]?\d+)?)", text)]
    assert max(literals) < 3.4028235e38 and min(v for v in literals if v) > 1.17e-38


MATIEC = os.environ.get("MATIEC", "")  # the folder of the IEC 61131-3 compiler of OpenPLC
PROGRAM = """
PROGRAM main
VAR block : law; END_VAR
block(time_s := 0.0);
END_PROGRAM
CONFIGURATION plc
  RESOURCE cpu ON cpu
    TASK often(INTERVAL := T#1s, PRIORITY := 0);
    PROGRAM instance WITH often : main;
  END_RESOURCE
END_CONFIGURATION
"""
DRIVER = r"""
#include <stdio.h>
#include "iec_std_lib.h"
TIME __CURRENT_TIME;
BOOL __DEBUG;
#include "POUS.h"
#include "POUS.c"
static void take(double *to, int count) {
    for (int i = 0; i < count; i++) if (scanf("%lf", to + i) != 1) to[i] = 0.0;
}
int main(void) {
    static LAW b;
    LAW_init__(&b, 0);
    for (double t; scanf("%lf", &t) == 1;) {
        b.TIME_S.value = t;
        ARRAYS
        LAW_body__(&b);
        for (unsigned i = 0; i < sizeof b.PUMP.value.table / sizeof(double); i++)
            printf("%.17g ", b.PUMP.value.table[i]);
        printf("\n");
    }
}
"""


@pytest.mark.slow
@pytest.mark.skipif(not MATIEC, reason="no matiec on this machine")
@needs_gcc
@pytest.mark.parametrize("name", ALL)
def test_matiec_gives_the_inputs_of_the_loop(name, tmp_path):
    text, run, signals = block_and_run(name)
    (tmp_path / "law.st").write_text(text + PROGRAM)
    parts = {"LEVEL": run.y, **dict(zip(["SETPOINT", "SETPOINT_RATE", "SETPOINT_SECOND"], signals))}
    arrays = [f"take(b.{n}.value.table, {np.shape(v)[1]});" for n, v in parts.items()]
    (tmp_path / "main.c").write_text(DRIVER.replace("ARRAYS", "\n        ".join(arrays)))
    count = min(PROGRAMMES.get(name, 300), 300)
    rows = np.column_stack([run.t, *map(np.asarray, parts.values())])[:count]
    np.savetxt(tmp_path / "in.txt", rows, "%.17g")
    run_in = functools.partial(subprocess.run, cwd=tmp_path, check=True)
    run_in([f"{MATIEC}/iec2c", "-I", f"{MATIEC}/lib", "law.st"], stdout=subprocess.DEVNULL)
    run_in([GCC, "-w", "-I", f"{MATIEC}/lib/C", "main.c", "-o", "main", "-lm"])
    with open(tmp_path / "in.txt") as file:
        printed = run_in(["./main"], stdin=file, stdout=subprocess.PIPE, text=True).stdout
    inputs, reach = np.loadtxt(printed.splitlines(), ndmin=2), max(1.0, np.abs(run.applied).max())
    np.testing.assert_allclose(inputs, run.applied[:count], atol=1e-9 * reach, rtol=0)


def test_a_truth_value_as_a_number_is_0_or_1():
    printer = structured_text.StructuredText("double", {}, {})
    printer._kind = lambda e: structured_text.ir.TRUTH
    for op, numbers in (("real", "0.0, 1.0"), ("whole", "0, 1")):
        assert printer.right(op, [Ref("v1")]).endswith(f"{numbers})")

"""One change of the code at a time, and whether a default test notices it.

    python tests/audits/mutants.py jaxtank/safety [COUNT [SEED]]
    python tests/audits/mutants.py tuning/uncertainty/study.py 40 7

Works on a copy of the tracked files. The tests that mirror a folder (TESTS names others) run once,
line by line; then COUNT places (20) are drawn from the lines that they reach, each is changed in
one way, and the files of tests that reach the line run until one fails. Prints a line for each
change and the share that was noticed; exit code 1 where one was not. A change that alters nothing
that a user sees (an equal bound, the words of a message) counts as not noticed: read the lines.
"""

import ast
import collections
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]
LIMIT = 900  # seconds of a run of tests, after which a change counts as noticed
TESTS = {
    "jaxtank/plants": ("tests/unit/plants", "tests/audits/test_properties.py"),
    "jaxtank/controllers": ("tests/unit/controllers", "tests/papers"),
    "jaxtank/signals": ("tests/unit/instruments", "tests/unit/plants"),
    "jaxtank/xla": ("tests/unit/core", "tests/unit/loop"),
}
"""Folders without a mirror in tests/unit, and those with tests elsewhere too."""

RECORDER = """
import json, os, sys, time
FOLDER, REACHED, TIMES = os.environ["MUTATED"], {}, {}

def follow(frame, event, argument):
    name = frame.f_code.co_filename
    if not name.startswith(FOLDER):
        return None
    lines = REACHED.setdefault(TEST, {}).setdefault(name, set())
    def line(frame, event, argument):
        lines.add(frame.f_lineno)
        return line
    return line(frame, event, argument)

def pytest_runtest_logstart(nodeid, location):
    global TEST, SINCE
    TEST, SINCE = nodeid.split("::")[0], time.perf_counter()
    sys.settrace(follow)

def pytest_runtest_logfinish(nodeid, location):
    sys.settrace(None)
    TIMES[TEST] = TIMES.get(TEST, 0.0) + time.perf_counter() - SINCE

def pytest_sessionfinish(session):
    lines = {t: {f: sorted(s) for f, s in files.items()} for t, files in REACHED.items()}
    with open(os.environ["REACHED"], "w") as file:
        json.dump([lines, TIMES], file)
"""
OPERATORS = {ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*", ast.Pow: "*"}
COMPARISONS = {"<": ">=", ">": "<=", "<=": ">", ">=": "<", "==": "!=", "!=": "=="}
NAMES = {"minimum": "maximum", "min": "max", "floor": "ceil", "any": "all", "upper": "lower"}
NAMES |= {b: a for a, b in NAMES.items()}


def changes(source):
    """(line, what, changed source) of every change of a module."""
    tree = ast.parse(source)
    starts = [0]
    for line in source.encode().split(b"\n"):
        starts.append(starts[-1] + len(line) + 1)
    raw = source.encode()
    at = lambda line, column: starts[line - 1] + column
    span = lambda node: (at(node.lineno, node.col_offset), at(node.end_lineno, node.end_col_offset))

    def changed(node, start, end, text):
        before = raw[start:end].decode()
        text_after = (raw[:start] + text.encode() + raw[end:]).decode()
        return node.lineno, f"{before.strip()[:40]} -> {text.strip()[:40]}", text_after

    for node in ast.walk(tree):
        if isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
            start, end = span(node.left)[1], span(node.right)[0]
            between = raw[start:end].decode()
            signs = between.strip(" ()\n")
            if signs in ("+", "-", "*", "/", "**"):
                text = between.replace(signs, OPERATORS[type(node.op)])
                yield changed(node, start, end, text)
        elif isinstance(node, ast.Compare) and len(node.ops) == 1:
            start, end = span(node.left)[1], span(node.comparators[0])[0]
            between = raw[start:end].decode()
            if between.strip(" ()\n") in COMPARISONS:
                sign = between.strip(" ()\n")
                yield changed(node, start, end, between.replace(sign, COMPARISONS[sign]))
        elif isinstance(node, ast.Attribute) and node.attr in NAMES:
            end = span(node)[1]
            yield changed(node, end - len(node.attr), end, NAMES[node.attr])
        elif isinstance(node, ast.Name) and node.id in NAMES:
            yield changed(node, *span(node), NAMES[node.id])
        elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
            number = node.value + 1 if isinstance(node.value, int) else 1.5 * node.value + 0.1
            yield changed(node, *span(node), repr(number))
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not):
            yield changed(node, *span(node), ast.unparse(node.operand))
        elif isinstance(node, ast.If) and isinstance(node.body[-1], ast.Raise | ast.Return):
            yield changed(node.test, *span(node.test), "False")
        elif isinstance(node, ast.BoolOp):
            start, end = span(node.values[0])[1], span(node.values[1])[0]
            between = raw[start:end].decode()
            word = "and" if isinstance(node.op, ast.And) else "or"
            if word in between:
                other = "or" if word == "and" else "and"
                yield changed(node, start, end, between.replace(word, other))


def pytest_run(copy, words, limit=LIMIT, **more):
    """Whether the tests pass, on the copy, within a limit [s]."""
    environment = {**os.environ, "PYTHONPATH": str(copy), **more}
    environment["JAX_COMPILATION_CACHE_DIR"] = str(copy / "xla")
    line = [sys.executable, "-m", "pytest", "-n", "0", "-q", "-p", "no:cacheprovider", *words]
    try:
        ran = subprocess.run(
            line, cwd=copy, env=environment, capture_output=True, text=True, timeout=limit
        )
    except subprocess.TimeoutExpired:
        return False
    if ran.returncode not in (0, 1, 2):
        raise SystemExit(ran.stdout[-2000:] + ran.stderr[-2000:])
    return ran.returncode == 0


def copy_of(root, copy):
    """The tracked files of the project, copied."""
    listed = subprocess.run(["git", "ls-files"], cwd=root, capture_output=True, text=True)
    for name in listed.stdout.split("\n"):
        if name and (root / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(root / name, copy / name)


def reached(copy, target, tests):
    """({(file, line): tests that reach it}, {test: its seconds})."""
    (copy / "recorder.py").write_text(RECORDER)
    variables = {"MUTATED": str(copy / target), "REACHED": str(copy / "reached.json")}
    if not pytest_run(copy, ["-p", "recorder", *tests], None, **variables):
        raise SystemExit("the tests fail before anything is changed")
    lines, times = json.loads((copy / "reached.json").read_text())
    by_line = collections.defaultdict(set)
    for test, files in lines.items():
        for name, numbers in files.items():
            for number in numbers:
                by_line[name, number].add(test)
    return by_line, times


def main(target, count=20, seed=0):
    """Print what changed and what was noticed; return the number of changes that were not."""
    folder = target if "." not in target else str(Path(target).parent)
    tests = TESTS.get(folder, ("tests/unit/" + folder.split("/", 1)[1],))
    with tempfile.TemporaryDirectory() as name:
        copy = Path(name)
        copy_of(ROOT, copy)
        by_line, times = reached(copy, target, tests)
        files = [copy / target] if "." in target else sorted((copy / target).rglob("*.py"))
        every = [(f, *change) for f in files for change in changes(f.read_text())]
        known = [c for c in every if (str(c[0]), c[1]) in by_line]
        print(f"{target}: {len(every)} changes, {len(known)} on lines that a default test reaches")
        drawn = random.Random(seed).sample(known, min(count, len(known)))
        missed = 0
        for file, line, what, text in sorted(drawn, key=lambda c: (c[0], c[1])):
            before, since = file.read_text(), time.perf_counter()
            file.write_text(text)
            covering = sorted(by_line[str(file), line], key=times.get)
            noticed = not pytest_run(copy, ["-x", *covering])
            file.write_text(before)
            missed += not noticed
            word = "noticed" if noticed else "MISSED "
            place = f"{file.relative_to(copy)}:{line}"
            print(f"{word} {place}  {what!r}  ({time.perf_counter() - since:.0f} s)", flush=True)
        print(f"{len(drawn) - missed} of {len(drawn)} noticed")
    return missed


if __name__ == "__main__":
    words = sys.argv[1:]
    sys.exit(min(1, main(words[0], *map(int, words[1:]))))

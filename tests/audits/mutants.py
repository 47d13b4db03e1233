"""One change of the code at a time, and whether a default test notices it.

    python tests/audits/mutants.py jaxtank/safety [COUNT [SEED]] [--record]
    python tests/audits/mutants.py tuning/uncertainty/study.py 40 7
    python tests/audits/mutants.py --again [FOLDER ...]      the tests named for those missed
    python tests/audits/mutants.py --markdown                the table in benchmarks/README.md

Works on a copy of the tracked files. The tests that mirror a folder (TESTS names others) run once,
line by line; then COUNT places (20) are drawn from the lines that they reach, and each is changed
in one way. The tests that reach the line run, fastest first, until one fails; then their files,
whole: what jax has traced in one test is used, and not reached, in the next. Messages, types and
decorators are not changed. Prints a line for each change and the share that was noticed; exit
code 1 where one was not. A change that alters nothing that a user sees counts as not noticed.

mutants.json holds {folder: {"seeds", "reached", "drawn", "noticed", "missed": [change]}}. A draw
with another seed adds to a folder's, and draws no change that was missed before; one with a seed
that is there replaces it. To a change, {"place", "what", "line"}, a person adds the "test" that was
written for it, or the "reason" why none can be; --again runs each such test on its change, found by
the text of its "line", and takes out the name of one that passes.
"""

import ast
import collections
import contextlib
import functools
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]
README = ROOT / "tests" / "benchmarks" / "README.md"
KEPT = ROOT / "tests" / "data" / "mutants.json"
BEGIN, END = "<!-- tests/audits/mutants.py -->", "<!-- end of mutants -->"
SHORT = 20  # seconds of the tests of a line that run for one change
WHOLE = 25  # and of their files
LIMIT = 300  # seconds of a run of tests, after which a change counts as noticed
TESTS = {
    "jaxtank/measures": (
        "tests/unit/measures",
        "tests/unit/loop",
        "tests/audits/test_recorded_runs.py",
    ),
    "jaxtank/plants": ("tests/unit/plants", "tests/audits/test_properties.py"),
    "jaxtank/controllers": ("tests/unit/controllers", "tests/papers"),
    "jaxtank/signals": ("tests/unit/instruments", "tests/unit/plants"),
    "jaxtank/xla": ("tests/unit/core", "tests/unit/loop"),
}
"""Folders without a mirror in tests/unit, and those with tests elsewhere too."""

OPERATORS = {ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*", ast.Pow: "*"}
COMPARISONS = {"<": ">=", ">": "<=", "<=": ">", ">=": "<", "==": "!=", "!=": "=="}
NAMES = {"minimum": "maximum", "min": "max", "floor": "ceil", "any": "all", "upper": "lower"}
NAMES |= {b: a for a, b in NAMES.items()}
UNSEEN = ("annotation", "returns", "decorator_list")  # fields of a node
MESSAGES = ("warn", "stacklevel", "LOGGER")


def visible(node):
    """The nodes of a module, without messages, types and decorators."""
    yield node
    for field, value in ast.iter_fields(node):
        for child in value if isinstance(value, list) else [value]:
            if not isinstance(child, ast.AST) or field in UNSEEN:
                continue
            if isinstance(child, ast.Raise | ast.JoinedStr | ast.Assert):
                continue
            called = child.func if isinstance(child, ast.Call) else child
            name = getattr(called, "attr", getattr(called, "id", getattr(child, "arg", "")))
            if name not in MESSAGES:
                yield from visible(child)


def changes(source):
    """(line, column, what, changed source) of every change of a module."""
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
        what = f"{before.strip()[:40]} -> {text.strip()[:40]}"
        return node.lineno, node.col_offset, what, text_after

    for node in visible(tree):
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


class Recorder:
    """What tests reach of a folder: {test: {file: lines}}, and how long each takes [s]."""

    def __init__(self, folder):
        self.folder, self.reached, self.times, self.file = folder, {}, {}, ""

    def follow(self, frame, event, argument):
        name = frame.f_code.co_filename
        if not name.startswith(self.folder):
            return None
        lines = self.reached.setdefault(self.test, {}).setdefault(name, set())

        def line(frame, event, argument):
            lines.add(frame.f_lineno)
            return line

        return line(frame, event, argument)

    def pytest_runtest_logstart(self, nodeid, location):
        file = nodeid.split("::")[0]
        if file != self.file:
            import jax

            jax.clear_caches()  # what an earlier file has traced is reached here too
        self.file, self.test, self.since = file, nodeid, time.perf_counter()
        sys.settrace(self.follow)

    def pytest_runtest_logfinish(self, nodeid, location):
        sys.settrace(None)
        self.times[nodeid] = time.perf_counter() - self.since

    def pytest_sessionfinish(self, session):
        lines = {t: {f: sorted(s) for f, s in files.items()} for t, files in self.reached.items()}
        Path("reached.json").write_text(json.dumps([lines, self.times]))


def prepare(copy):
    """Import what all tests need, once: a fork has it."""
    os.environ["PYTHONPATH"] = str(copy)
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(copy / "xla"))
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.1"
    sys.path[:] = [str(copy), *(p for p in sys.path if not Path(p or ".").is_relative_to(ROOT))]
    import hypothesis  # noqa: F401
    import jax.experimental  # noqa: F401
    import matplotlib.figure  # noqa: F401
    import pytest  # noqa: F401
    import scipy.optimize
    import scipy.signal  # noqa: F401


def run_tests(copy, words, limit=LIMIT, plugins=()):
    """(exit code of pytest on the copy, or None after a limit [s], the first test that failed)."""
    child = os.fork()
    if child == 0:
        os.setsid()
        os.chdir(copy)
        printed = os.open("printed", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(printed, 1)
        os.dup2(printed, 2)
        import pytest

        line = ["-n", "0", "-q", "-x", "--tb=no", "-rfE", "-p", "no:cacheprovider", *words]
        code = pytest.main(line, plugins=plugins)
        sys.stdout.flush()
        os._exit(code)
    until = time.monotonic() + limit
    status = (0, 0)
    while status[0] == 0 and time.monotonic() < until:
        time.sleep(0.05)
        status = os.waitpid(child, os.WNOHANG)
    if status[0] == 0:
        os.killpg(child, signal.SIGKILL)
        os.waitpid(child, 0)
        return None, "after the limit of time"
    failed = re.search("^(?:FAILED|ERROR) (.*?)(?: - .*)?$", (copy / "printed").read_text(), re.M)
    return os.waitstatus_to_exitcode(status[1]), failed[1] if failed else ""


def copy_of(root, copy):
    """The tracked files of the project, copied."""
    listed = subprocess.run(["git", "ls-files"], cwd=root, capture_output=True, text=True)
    for name in listed.stdout.split("\n"):
        if name and (root / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(root / name, copy / name)


def reached(copy, target, tests):
    """({(file, line): tests that reach it}, {test: its seconds})."""
    if run_tests(copy, tests, 3600, [Recorder(str(copy / target))])[0] != 0:
        raise SystemExit("before anything is changed: " + (copy / "printed").read_text()[-2000:])
    lines, times = json.loads((copy / "reached.json").read_text())
    by_line = collections.defaultdict(set)
    for test, files in lines.items():
        for name, numbers in files.items():
            for number in numbers:
                by_line[name, number].add(test)
    return by_line, times


def fastest(times, limit):
    """The tests, fastest first, that take a limit [s] together; at least one."""
    total, chosen = 0.0, []
    for test in sorted(times, key=times.get):
        total += times[test]
        if chosen and total > limit:
            break
        chosen.append(test)
    return chosen


def noticed_by(copy, covering, times):
    """Whether a test fails, of those that reach a line or of their files; prints which."""
    files = collections.Counter()
    for test, seconds in times.items():
        files[test.split("::")[0]] += seconds
    files = {f: t for f, t in files.items() if any(c.startswith(f + "::") for c in covering)}
    for words in (fastest({c: times[c] for c in covering}, SHORT), fastest(files, WHOLE)):
        code, test = run_tests(copy, words)
        if code != 0 and not (code == 4 and words[0] not in files):  # 4: a parameter is gone
            print(f"noticed by {test or f'exit code {code}'}", end=" ")
            return True
    print("MISSED", end=" ")
    return False


@contextlib.contextmanager
def changed(copy, change, number):
    """The copy with one change: {"place", "what", "line"}; prints what came of it."""
    file, line, column, what, text = change
    status, before, since = file.stat(), file.read_text(), time.perf_counter()
    file.write_text(text)
    os.utime(file, (number, number))  # two changes within a second are two to the interpreter
    place = f"{file.relative_to(copy)}:{line}:{column}"
    print(f"{place}  {what!r}", end=" ", flush=True)
    yield {"place": place, "what": what, "line": before.splitlines()[line - 1].strip()}
    print(f"({time.perf_counter() - since:.0f} s)", flush=True)
    file.write_text(before)
    os.utime(file, ns=(status.st_atime_ns, status.st_mtime_ns))


def nearest(known, entry):
    """The change of a record among those known now: the closest with the same words on a line of
    the same text; None without any.
    """
    name, line, column = entry["place"].split(":")
    same = [c for c in known if c[3] == entry["what"] and str(c[0]).endswith("/" + name)]
    same = [c for c in same if source_line(str(c[0]), c[1]) == entry["line"]]
    distance = lambda c: (abs(c[1] - int(line)), abs(c[2] - int(column)))
    return min(same, key=distance, default=None)


@functools.cache
def source_lines(path):
    return [line.strip() for line in Path(path).read_text().splitlines()]


def source_line(path, number):
    return source_lines(path)[number - 1]


def recorded():
    """The rows of the file."""
    return json.loads(KEPT.read_text()) if KEPT.exists() else {}


def record(target, row):
    """Keep what was found of a folder."""
    rows = dict(sorted({**recorded(), target: row}.items()))
    KEPT.write_text(json.dumps(rows, indent=1) + "\n")


def load_row(target, seed):
    """The record of a folder that a draw with this seed adds to."""
    row = recorded().get(target, {"seeds": [seed]})
    return {"seeds": [], "drawn": 0, "noticed": 0, "missed": []} if seed in row["seeds"] else row


def join_rows(row, latest):
    """The record of a folder with what one more draw found of it."""
    return latest | {k: row[k] + latest[k] for k in ("seeds", "drawn", "noticed", "missed")}


def table():
    """The rows of what is recorded, as markdown."""
    lines = [
        "| code | changes of lines that tests reach | drawn | noticed at first | noticed now"
        " | alter nothing that a user sees | left |",
        "|---|---|---|---|---|---|---|",
    ]
    counts = []
    for folder, row in recorded().items():
        tests = sum("test" in m for m in row["missed"])
        reasons = sum("reason" in m for m in row["missed"])
        now, missed = row["noticed"] + tests, len(row["missed"]) - tests - reasons
        counts.append([row["reached"], row["drawn"], row["noticed"], now, reasons, missed])
        lines.append(f"| `{folder}` | " + " | ".join(f"{n:,}" for n in counts[-1]) + " |")
    total = " | ".join(f"{sum(column):,}" for column in zip(*counts))
    return "\n".join([*lines, f"| all | {total} |"])


def write_table():
    """Write the table to its page."""
    rows = f"{BEGIN}\n{table()}\n{END}"
    page = re.sub(f"{BEGIN}.*?{END}", lambda _: rows, README.read_text(), flags=re.DOTALL)
    README.write_text(page)


def draw(target, count=20, seed=0, keep=False):
    """Print what changed and what was noticed, and record it; return how many were not."""
    folder = target if "." not in target else str(Path(target).parent)
    tests = TESTS.get(folder, ("tests/unit/" + folder.split("/", 1)[1],))
    with tempfile.TemporaryDirectory() as name:
        copy = Path(name).resolve()
        copy_of(ROOT, copy)
        prepare(copy)
        by_line, times = reached(copy, target, tests)
        files = [copy / target] if "." in target else sorted((copy / target).rglob("*.py"))
        every = [(f, *change) for f in files for change in changes(f.read_text())]
        missed_before = [nearest(every, entry) for entry in load_row(target, seed)["missed"]]
        known = [c for c in every if (str(c[0]), c[1]) in by_line]
        print(f"{target}: {len(every)} changes, {len(known)} on lines that a default test reaches")
        unknown = [c for c in known if c not in missed_before]
        drawn = sorted(random.Random(seed).sample(unknown, min(count, len(unknown))))
        missed = []
        for number, change in enumerate(drawn):
            covering = by_line[str(change[0]), change[1]]
            with changed(copy, change, number) as place:
                if not noticed_by(copy, covering, times):
                    missed.append(place)
    print(f"{len(drawn) - len(missed)} of {len(drawn)} noticed")
    if keep:
        counts = {"seeds": [seed], "reached": len(known), "drawn": len(drawn)}
        counts |= {"noticed": len(drawn) - len(missed), "missed": missed}
        record(target, join_rows(load_row(target, seed), counts))
    return len(missed)


def again(target):
    """Run the test that is named for each change that was missed; one that passes is taken out."""
    row, wrong = recorded()[target], 0
    with tempfile.TemporaryDirectory() as name:
        copy = Path(name).resolve()
        copy_of(ROOT, copy)
        prepare(copy)
        named = [m for m in row["missed"] if "test" in m]
        if named and run_tests(copy, sorted({m["test"] for m in named}))[0] != 0:
            raise SystemExit("before anything is changed: " + (copy / "printed").read_text())
        for number, entry in enumerate(named):
            file = copy / entry["place"].split(":")[0]
            change = nearest([(file, *c) for c in changes(file.read_text())], entry)
            if change is None:
                print(f"{entry['place']}  {entry['what']!r} is no longer there")
                continue
            with changed(copy, change, number) as place:
                if not noticed_by(copy, [entry["test"]], {entry["test"]: 0.0}):
                    del entry["test"]
                    wrong += 1
            entry |= place
    record(target, row)
    return wrong


if __name__ == "__main__":
    options = {w for w in sys.argv[1:] if w.startswith("--")}
    words = [w for w in sys.argv[1:] if w not in options]
    if "--markdown" in options:
        write_table()
    elif "--again" in options:
        sys.exit(min(1, sum(map(again, words or recorded()))))
    else:
        sys.exit(min(1, draw(words[0], *map(int, words[1:]), keep="--record" in options)))

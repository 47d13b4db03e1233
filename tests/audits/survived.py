"""What was tried on this program and what came of it: the table in benchmarks/README.md.

    python tests/audits/survived.py                 the table of what is recorded
    python tests/audits/survived.py --markdown      the same into benchmarks/README.md
    python tests/audits/survived.py fuzz kills ...  runs these drills first (all: hours)

A drill that fails is recorded as what it is. survived.json holds {drill: {"count", "outcome"}}.
"""

import json
import re
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

from jaxtank.core.files import write_atomic

HERE = Path(__file__).parent
TESTS = HERE.parent
README, KEPT = TESTS / "benchmarks" / "README.md", TESTS / "data" / "survived.json"
BEGIN, END = "<!-- tests/audits/survived.py -->", "<!-- end of survived -->"

SLOW = ["-p", "no:cacheprovider", "-n", "0", "-m", "slow or not slow"]
PYTEST = "pytest -m 'slow or not slow' tests/audits/"
DRILLS = {  # {name: (what is tried, command)}
    "fuzz": (
        "broken rig files, logs and command lines",
        "pytest -m slow tests/audits/test_fuzz.py",
    ),
    "rig files": (
        "random complete rig files: what is accepted is run and judged by other means",
        "python tests/audits/accepted_rigs.py 2560",
    ),
    "gradient audit": (
        "points at which derivatives are compared with differences",
        "python tests/audits/gradient_audit.py",
    ),
    "properties": (
        "random rigs, over all properties",
        "pytest -m slow tests/audits/test_properties.py",
    ),
    "stiff rigs": (
        "random stiff rigs with tanks that are drawn empty, against small steps",
        "python tests/audits/stiff_rigs.py",
    ),
    "kills": (
        "SIGKILLs of eight commands: tune, uncertainty, identify, simulate, sensitivity, attack,"
        " export, explore",
        "python tests/audits/fault_drill.py 50",
    ),
    "interrupts": (
        "cold SIGINT and SIGTERM, 0 to 5 s after the start of ten commands",
        "python tests/audits/interrupt_drill.py 200",
    ),
    "other faults": (
        "full disks, read-only folders, Ctrl-C, two runs in one folder",
        f"{PYTEST}test_faults.py",
    ),
    "long and large": (
        "runs of up to 10^7 samples, ensembles of up to 10^6 draws",
        "pytest -m slow tests/audits/test_long_runs.py",
    ),
    "versions, oldest": ("tests with the oldest versions", "tests/audits/versions.sh oldest"),
    "versions, newest": ("tests with the newest versions", "tests/audits/versions.sh newest"),
    "supply": ("checks of wheel, sdist and source", f"{PYTEST}test_supply.py"),
}
FUZZED = re.compile(
    r"rig files: (\d+) read, (\d+) refused; logs: (\d+) read, (\d+) refused; command lines refused:"
    r" (\d+) of (\d+)"
)


def recorded():
    """{drill: {"count", "outcome"}} of the file."""
    return json.loads(KEPT.read_text()) if KEPT.exists() else {}


def record(name, count, outcome):
    """Keep what drill `name` found: how many were tried, and what came of it."""
    rows = {**recorded(), name: {"count": count, "outcome": outcome}}
    write_atomic(KEPT, json.dumps(rows, indent=1) + "\n")


def cases(report):
    """{test: "passed", "failed" or "skipped"} of a report in JUnit's XML."""
    outcomes = {}
    for case in ElementTree.parse(report).iter("testcase"):
        kinds = {child.tag for child in case}
        failed = "failed" if kinds & {"failure", "error"} else "passed"
        outcomes[case.get("name")] = "skipped" if "skipped" in kinds else failed
    return outcomes


def summed(outcomes):
    """'all passed', or how many did not."""
    counts = Counter(outcomes.values())
    if not counts["passed"]:
        return "none ran"
    others = [f"{counts[kind]} {kind}" for kind in ("failed", "skipped") if counts[kind]]
    return ", ".join([f"{counts['passed']} passed", *others]) if others else "all passed"


def suite(*words):
    """(report of pytest, what it printed)."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        done = subprocess.run(
            [sys.executable, "-m", "pytest", *SLOW, f"--junitxml={report}", *words],
            cwd=TESTS.parent,
            capture_output=True,
            text=True,
        )
        print(done.stdout[-400:], file=sys.stderr)
        return cases(report), done.stdout


def run(name):
    """Run a drill and record it."""
    command = DRILLS[name][1]
    path = command.split()[-1]
    if name == "fuzz":
        outcomes, printed = suite("-s", path)
        numbers = FUZZED.search(printed)
        if numbers is None:
            return record(name, 0, summed(outcomes))
        rigs, bad_rigs, logs, bad_logs, bad_lines, lines = map(int, numbers.groups())
        refused, count = bad_rigs + bad_logs + bad_lines, rigs + bad_rigs + logs + bad_logs + lines
        words = f"{refused} refused in one line, the rest read; {summed(outcomes)}"
        record(name, count, words)
    elif name == "properties":
        outcomes, _ = suite(path)
        # of each property: how many examples its few and its many are, or, where there are more, of
        # its cases
        sizes = {}
        for test in outcomes:
            title, size = re.fullmatch(r"(\w+)(?:\[(\d+)\])?.*", test).groups()
            sizes.setdefault(title, []).append(int(size or 1))
        # the few are the first of the many
        count = sum(max(v) if len(v) <= 2 else len(v) for v in sizes.values())
        record(name, count, f"of {len(sizes)} properties; {summed(outcomes)}")
    elif command.startswith("pytest"):
        # kills and hundreds of signals have a row of their own
        outcomes, _ = suite(path, "-k", "not kills and not hundred")
        record(name, len(outcomes), summed(outcomes))
    else:
        words = command.removeprefix("python ").split()
        program = [sys.executable] if command.startswith("python") else []
        subprocess.run([*program, *words, "--record"], cwd=TESTS.parent)


def table():
    """The rows of what is recorded, as markdown."""
    rows, lines = recorded(), ["| tried | how many | outcome | again |", "|---|---|---|---|"]
    for name, (what, command) in DRILLS.items():
        if name in rows:
            count, outcome = rows[name]["count"], rows[name]["outcome"]
            lines.append(f"| {what} | {count:,} | {outcome} | `{command}` |")
    return "\n".join(lines)


def main(words):
    if "--versions" in words:
        which, report, versions = words[words.index("--versions") + 1 :]
        outcomes, name = cases(report), f"versions, {which}"
        text = f"{Path(versions).read_text().strip()}: {summed(outcomes)}"
        return record(name, len(outcomes), text)
    names = [w for w in words if not w.startswith("-")]
    for name in DRILLS if names == ["all"] else names:
        full = next((n for n in DRILLS if name in n), None)
        if full is None:
            sys.exit(f"no drill {name!r}: {', '.join(DRILLS)}, or all")
        run(full)
    if "--markdown" in words:
        page = README.read_text()
        rows = f"{BEGIN}\n{table()}\n{END}"
        write_atomic(README, re.sub(f"{BEGIN}.*?{END}", lambda _: rows, page, flags=re.DOTALL))
    else:
        print(table())


if __name__ == "__main__":
    main(sys.argv[1:])

"""What was tried on this program and what came of it: the table in benchmarks/README.md, from what
the drills recorded.

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
from pathlib import Path
from xml.etree import ElementTree

from jaxtank.core.files import write_atomic

HERE = Path(__file__).parent
TESTS = HERE.parent
README, KEPT = TESTS / "benchmarks" / "README.md", TESTS / "data" / "survived.json"
BEGIN, END = "<!-- tests/audits/survived.py -->", "<!-- end of survived -->"

SLOW = ["-p", "no:cacheprovider", "-n", "0", "-m", "slow or not slow"]
DRILLS = {
    "fuzz": (
        "broken rig files, logs and command lines",
        "`pytest -m slow tests/audits/test_fuzz.py`",
    ),
    "gradient audit": (
        "points at which derivatives are compared with differences",
        "`python tests/audits/gradient_audit.py`",
    ),
    "properties": (
        "random rigs, over all properties",
        "`pytest -m slow tests/audits/test_properties.py`",
    ),
    "stiff rigs": (
        "random stiff rigs with tanks that are drawn empty, against small steps",
        "`python tests/audits/stiff_rigs.py`",
    ),
    "kills": (
        "SIGKILLs of tune, uncertainty and identify",
        "`python tests/audits/fault_drill.py 50`",
    ),
    "interrupts": (
        "cold SIGINT and SIGTERM, 0 to 5 s after the start of ten commands",
        "`python tests/audits/interrupt_drill.py 200`",
    ),
    "other faults": (
        "full disks, read-only folders, Ctrl-C, two runs in one folder",
        "`pytest -m 'slow or not slow' tests/audits/test_faults.py`",
    ),
    "long and large": (
        "runs of up to 10^7 samples, ensembles of up to 10^6 draws",
        "`pytest -m slow tests/audits/test_long_runs.py`",
    ),
    "versions, oldest": ("tests with the oldest versions", "`tests/audits/versions.sh oldest`"),
    "versions, newest": ("tests with the newest versions", "`tests/audits/versions.sh newest`"),
    "supply": (
        "checks of wheel, sdist and source",
        "`pytest -m 'slow or not slow' tests/audits/test_supply.py`",
    ),
}


def record(name, count, outcome):
    """Keep what drill `name` found: how many were tried, and what came of it."""
    kept = json.loads(KEPT.read_text()) if KEPT.exists() else {}
    write_atomic(
        KEPT, json.dumps({**kept, name: {"count": count, "outcome": outcome}}, indent=1) + "\n"
    )


def cases(report):
    """{test: "passed", "failed" or "skipped"} of a report in JUnit's XML."""
    found = {}
    for case in ElementTree.parse(report).iter("testcase"):
        kinds = {child.tag for child in case}
        found[case.get("name")] = (
            "failed"
            if kinds & {"failure", "error"}
            else "skipped"
            if "skipped" in kinds
            else "passed"
        )
    return found


def summed(found):
    """'all passed', or how many did not."""
    counts = {
        kind: sum(v == kind for v in found.values()) for kind in ("passed", "failed", "skipped")
    }
    if not found or not counts["passed"]:
        return "none ran"
    rest = ", ".join(f"{counts[kind]} {kind}" for kind in ("failed", "skipped") if counts[kind])
    return f"{counts['passed']} passed, {rest}" if rest else "all passed"


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
    if name == "fuzz":
        found, printed = suite("-s", "tests/audits/test_fuzz.py")
        reported = re.search(
            r"rig files: (\d+) read, (\d+) refused; logs: (\d+) read, (\d+) refused; command lines"
            r" refused: (\d+) of (\d+)",
            printed,
        )
        if reported is None:
            return record(name, 0, summed(found))
        rigs, bad, logs, worse, refused, lines = map(int, reported.groups())
        record(
            name,
            rigs + bad + logs + worse + lines,
            f"{bad + worse + refused} refused in one line, the rest read; {summed(found)}",
        )
    elif name == "properties":
        found, _ = suite("tests/audits/test_properties.py")
        # of each property: how many examples its few and its many are, or, where there are more, of
        # its cases
        sizes = {}
        for test in found:
            title, size = re.fullmatch(r"(\w+)(?:\[(\d+)\])?.*", test).groups()
            sizes.setdefault(title, []).append(int(size or 1))
        # the few are the first of the many
        count = sum(max(v) if len(v) <= 2 else len(v) for v in sizes.values())
        record(name, count, f"of {len(sizes)} properties; {summed(found)}")
    elif name in ("long and large", "other faults", "supply"):
        home = {
            "long and large": "test_long_runs.py",
            "other faults": "test_faults.py",
            "supply": "test_supply.py",
        }[name]
        # which have a row of their own
        found, _ = suite(f"tests/{home}", "-k", "not kills and not hundred")
        record(name, len(found), summed(found))
    elif name == "kills":
        subprocess.run([sys.executable, HERE / "fault_drill.py", "50", "--record"])
    elif name == "stiff rigs":
        subprocess.run([sys.executable, HERE / "stiff_rigs.py", "--record"])
    elif name == "interrupts":
        subprocess.run([sys.executable, HERE / "interrupt_drill.py", "200", "--record"])
    elif name == "gradient audit":
        subprocess.run([sys.executable, HERE / "gradient_audit.py", "--record"])
    else:
        subprocess.run([HERE / "versions.sh", name.split()[-1], "--record"])


def table():
    """The rows of what is recorded, as markdown."""
    kept = json.loads(KEPT.read_text()) if KEPT.exists() else {}
    lines = ["| tried | how many | outcome | again |", "|---|---|---|---|"]
    for name, (what, command) in DRILLS.items():
        if name in kept:
            lines.append(
                f"| {what} | {kept[name]['count']:,} | {kept[name]['outcome']} | {command} |"
            )
    return "\n".join(lines)


def main(words):
    if "--versions" in words:
        which, report, reported = words[words.index("--versions") + 1 :]
        found = cases(report)
        return record(
            f"versions, {which}",
            len(found),
            f"{Path(reported).read_text().strip()}: {summed(found)}",
        )
    wanted = [w for w in words if not w.startswith("-")]
    for name in DRILLS if wanted == ["all"] else wanted:
        full = next((n for n in DRILLS if n.startswith(name) or name in n), None)
        if full is None:
            sys.exit(f"no drill {name!r}: {', '.join(DRILLS)}, or all")
        run(full)
    if "--markdown" in words:
        page = README.read_text()
        write_atomic(
            README,
            re.sub(
                f"{BEGIN}.*?{END}", lambda _: f"{BEGIN}\n{table()}\n{END}", page, flags=re.DOTALL
            ),
        )
    else:
        print(table())


if __name__ == "__main__":
    main(sys.argv[1:])

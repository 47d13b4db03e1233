"""What a command costs the first time, with its programs kept, and where none are kept.

    python tests/benchmarks/first_calls.py [rounds] [--python OTHER] [nominal default ...]

Core time (user and system) of each command in a process of its own: the least of `rounds` (3),
in turn, for other programs on the machine only add to it. OTHER, a python with another version of
jaxtank, is measured in the same rounds, without kept programs.
"""

import os
import resource
import subprocess
import sys
import tempfile

from tuning.report import tables

COMMANDS = {
    "simulate": "simulate gouta2015/ngpc --json",
    "uncertainty": "uncertainty gouta2015/backstepping --dt 0.1 --samples 1000",
    "nominal": "tune gouta2015/backstepping --nominal",
    "default": "tune gouta2015/backstepping",
}
AT_MOST = {
    "simulate": (3.0, 1.2),
    "uncertainty": (5.0, 3.0),
    "nominal": (9.0, 4.0),
    "default": (20.0, 14.0),
}
HEADS = ["`jaxtank` ...", "other version", "first", "second", "at most"]


def core_seconds(python, words, folder):
    """Core time of a command [s] with programs kept in `folder`, "0" for none."""
    env = {n: v for n, v in os.environ.items() if not n.startswith("JAX_")}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [python, "-m", "jaxtank", *words.split()],
        env=env | {"JAXTANK_CACHE": folder},
        cwd=tempfile.gettempdir(),
        check=True,
        capture_output=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def measure(words, rounds, other):
    """(other version, first, second) least core times [s] of a command."""
    found = [[], [], []]
    for _ in range(rounds):
        if other:
            found[0].append(core_seconds(other, words, "0"))
        with tempfile.TemporaryDirectory() as folder:
            os.chmod(folder, 0o700)
            for column in found[1:]:
                column.append(core_seconds(sys.executable, words, folder))
    return [f"{min(column):.1f} s" if column else "" for column in found]


def main(words):
    rounds = next((int(w) for w in words if w.isdigit()), 3)
    other = words[words.index("--python") + 1] if "--python" in words else None
    rows = []
    for name in [w for w in words if w in COMMANDS] or COMMANDS:
        measured = measure(COMMANDS[name], rounds, other)
        rows.append([COMMANDS[name], *measured, "{:g}, {:g} s".format(*AT_MOST[name])])
        print(tables.table(rows[-1:], HEADS), flush=True)
    print("\n".join(f"| {' | '.join(row)} |" for row in [HEADS, ["---"] * len(HEADS), *rows]))


if __name__ == "__main__":
    main(sys.argv[1:])

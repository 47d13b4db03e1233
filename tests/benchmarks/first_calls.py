"""What a command costs the first time, and with its programs kept.

    python tests/benchmarks/first_calls.py [rounds] [--other TREE] [nominal default ...]

Core time (user and system) of each command in a process of its own: the least of `rounds` (3), in
turn with TREE, a checkout of another version, for other programs on the machine only add to it.
"""

import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from tanks_in_a_row import rig_text

from tuning.report import tables

COMMANDS = {
    "list": "list",
    "show": "show gouta2015/backstepping",
    "simulate": "simulate gouta2015/ngpc --json",
    "out": "simulate gouta2015/backstepping --out OUT",
    "uncertainty": "uncertainty gouta2015/backstepping --dt 0.1 --samples 1000",
    "nominal": "tune gouta2015/backstepping --nominal",
    "default": "tune gouta2015/backstepping",
    "report": "tune gouta2015/backstepping --out OUT",
    "ten": "tune 10.toml",
    "twenty": "tune 20.toml",
}
TANKS = (10, 20)  # in a row, each with a pump under a PI of its own
HEADS = ["`jaxtank` ...", "first, other", "second, other", "first", "second"]
HERE = str(Path(__file__).parents[2])
LEFT_OUT = ("JAX", "PYTHONPATH", "PYTHONDONTWRITEBYTECODE")  # beginnings of names


def core_seconds(tree, words, cache):
    """Core time of a command of the packages in `tree` [s], with programs kept in `cache`."""
    env = {n: v for n, v in os.environ.items() if not n.startswith(LEFT_OUT)}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory() as folder:
        for tanks in TANKS:
            Path(folder, f"{tanks}.toml").write_text(rig_text(tanks))
        subprocess.run(
            [sys.executable, "-m", "jaxtank", *words.replace("OUT", folder + "/out").split()],
            env=env | {"JAXTANK_CACHE": cache, "PYTHONPATH": tree},
            cwd=folder,
            check=True,
            capture_output=True,
        )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def measure(words, rounds, trees):
    """(first, second) least core times [s] of a command, of one tree after the other."""
    times = [[[], []] for _ in trees]
    for _ in range(rounds):
        for tree, columns in zip(trees, times):
            with tempfile.TemporaryDirectory() as cache:
                os.chmod(cache, 0o700)
                for column in columns:
                    column.append(core_seconds(tree, words, cache))
    return [f"{min(column):.2g} s" for columns in times for column in columns]


def main(words):
    rounds = next((int(w) for w in words if w.isdigit()), 3)
    trees = [words[words.index("--other") + 1]] if "--other" in words else []
    rows, heads = [], HEADS if trees else [HEADS[0], *HEADS[3:]]
    for name in [w for w in words if w in COMMANDS] or COMMANDS:
        rows.append([COMMANDS[name], *measure(COMMANDS[name], rounds, [*trees, HERE])])
        print(tables.table(rows[-1:], heads), flush=True)
    print("\n".join(f"| {' | '.join(row)} |" for row in [heads, ["---"] * len(heads), *rows]))


if __name__ == "__main__":
    main(sys.argv[1:])

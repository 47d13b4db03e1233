"""What a command costs the first time, and with its programs kept.

    python tests/benchmarks/first_calls.py [rounds] [--other TREE] [nominal default ... warm]

Core time (user and system) of each command in a process of its own: the least of `rounds` (3), in
turn with TREE, a checkout of another version, for other programs on the machine only add to it.
`warm`: tuning a second time in one Python process, with a drain that is 1 % wider, and how many
programs XLA compiles for that.
"""

import os
import sys
import tempfile
from pathlib import Path

from measuring import environment, first_number, markdown, of_command
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
    "fragile": "tune cascaded/pi",
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
    env = environment(*LEFT_OUT, JAXTANK_CACHE=cache, PYTHONPATH=tree)
    with tempfile.TemporaryDirectory() as folder:
        for tanks in TANKS:
            Path(folder, f"{tanks}.toml").write_text(rig_text(tanks))
        words = words.replace("OUT", folder + "/out").split()
        return of_command([sys.executable, "-m", "jaxtank", *words], env=env, cwd=folder)[0]


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


WARM = """
import sys, time, jax, tuning
jax.config.update("jax_enable_x64", True)
from jaxtank import presets, rig
compiled = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, *_, **__: compiled.append(event) if "backend_compile" in event else None
)
case, nominal = presets.find("gouta2015/backstepping"), sys.argv[1] == "nominal"
drain = float(case.loop.plant.drain[0])
for value in (drain, 1.01 * drain):
    before, began = len(compiled), time.process_time()
    print(tuning.tune(rig.set_values(case, {"plant.drain[0]": value}), nominal=nominal))
seconds, programs = time.process_time() - began, len(compiled) - before
print(f"{seconds:.2g} s and {programs} programs")
"""


def warm(kind):
    """What the second of two tunings in one process takes."""
    env = environment(*LEFT_OUT, PYTHONPATH=HERE)
    return of_command([sys.executable, "-c", WARM, kind], env=env)[1].splitlines()[-1]


def main(words):
    rounds = first_number(words, 3)
    trees = [words[words.index("--other") + 1]] if "--other" in words else []
    rows, heads = [], HEADS if trees else [HEADS[0], *HEADS[3:]]
    named = [w for w in words if w in COMMANDS]
    if not named or "warm" in words:
        print("\n".join(f"one value changed, {k}: {warm(k)}" for k in ("nominal", "default")))
    for name in named or ([] if "warm" in words else COMMANDS):
        rows.append([COMMANDS[name], *measure(COMMANDS[name], rounds, [*trees, HERE])])
        print(tables.table(rows[-1:], heads), flush=True)
    if rows:
        print(markdown(heads, rows))


if __name__ == "__main__":
    main(sys.argv[1:])

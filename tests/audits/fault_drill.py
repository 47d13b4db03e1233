"""Kills eight commands at random moments and goes on: python tests/audits/fault_drill.py 50
[uncertainty ...] [--record]

Each trial starts one of the commands with --out and sends SIGKILL at a seeded moment. Those of
RESUMES are killed half of the time anywhere in what an undisturbed run takes, half just after some
number of evaluations has been kept, and go on with --resume (or once more, where nothing had been
kept yet); the others run once more into the same folder. What goes on may be killed as well, up to
four times. The folder must then hold the files of an undisturbed run, byte by byte but for the wall
time and the command line that the report tells, and nothing else.

Processes are forked from one that has imported everything and started no jax, and find the programs
that the runs left alone compiled (jax's compilation cache): a kill tells more in a search than in
seconds of imports and compilation.
"""

import contextlib
import json
import os
import random
import re
import shutil
import signal
import sqlite3
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import NamedTuple

SHORT = ["cascaded/pi", "--set", "clock.dt=1", "--set", "clock.duration=400", "--quiet"]
LOG = ["--data", "log/trajectory.csv", "--column", "t=t [s]", "--column", "pump1=u1 [V]"]
LOG += ["--column", "h1=y1 [V]", "--column", "h2=y2 [V]"]
FREE = ("plant.pump_gain[0]=0.02:0.1", "plant.orifice[0]=0.02:0.08", "plant.drain[1]=0.02:0.08")
FIT = ["--start", "case", "--starts", "4", "--hold-back", "0", "--quiet"]
COMMANDS = {
    "tune": ["tune", *SHORT, "--starts", "2", "--screening", "4", "--validation", "4"],
    "uncertainty": ["uncertainty", *SHORT, "--samples", "3000"],
    "identify": ["identify", "cascaded/pi", *LOG, *FIT]
    + [word for name in FREE for word in ("--free", name)],
}
RESUMES = tuple(COMMANDS)
COMMANDS |= {
    "simulate": ["simulate", *SHORT],
    "sensitivity": ["sensitivity", *SHORT, "--method", "morris", "--samples", "4"],
    "attack": ["attack", *SHORT, "--starts", "1", "--iterations", "2", "--draws", "8"],
    "export": ["export", "cascaded/pi", "--quiet"],
    "explore": ["explore", "cascaded/pi", "--quiet"],
}
AFRESH = re.compile(r"holds no checkpoint to continue|had ended")
PATIENCE = 300.0  # s


def prepare(cache):
    """Import what the commands need, here, once; `cache`: where compiled programs are kept."""
    import jax
    import matplotlib

    matplotlib.use("Agg")

    import tuning.identification.fit
    import tuning.report.identification
    import tuning.report.uncertainty
    import tuning.search.tuner  # noqa: F401
    from tuning.cli import main as cli

    jax.config.update("jax_compilation_cache_dir", cache)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)  # nothing of jax has started
    return cli


def start(cli, words):
    """The id of a process that runs `jaxtank words` here; what it says is in said.txt."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            file = os.open("said.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
            os.dup2(file, 1)
            os.dup2(file, 2)
            code = cli.main(words)
            sys.stdout.flush()
        finally:
            os._exit(code)
    return child


def ended(child, patience=PATIENCE):
    """The exit code of a process, None where it has not ended within `patience` [s]."""
    until = time.monotonic() + patience
    while time.monotonic() < until:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.002)
    return None


def kept(folder):
    """How many evaluations or batches of a run are kept in its folder."""
    path = (Path(folder) / "checkpoint.sqlite3").absolute()
    try:
        with contextlib.closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as file:
            (count,) = file.execute("SELECT count(*) FROM record").fetchone()
    except sqlite3.Error:
        return 0
    return max(0, count - 1)  # one says what the others are of


def kill(child, folder, seconds, count):
    """SIGKILL after `seconds`, or, where count is given, that long after `count` has been kept. The
    exit code of a run that had ended before, else None.
    """
    until = time.monotonic() + PATIENCE
    while count is not None and kept(folder) < count:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > until:
            raise TimeoutError(f"{folder}: {kept(folder)} of {count} kept")
        time.sleep(0.001)
    code = ended(child, seconds)
    if code is None:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    return code


def contents(folder):
    """{name: bytes} of a folder, less the wall time and the command line."""
    found = {}
    for path in sorted(folder.iterdir()):
        data = path.read_bytes()
        if path.name == "result.json":
            page = json.loads(data)
            page.pop("wall_s", None)
            data = json.dumps(page, sort_keys=True).encode()
        if path.name == "report.html":
            data = re.sub(rb"jaxtank (%s) [^<]*" % "|".join(COMMANDS).encode(), b"", data)
            data = re.sub(rb"<p>[\d.]+ s, |[\d.]+ s(?=</)", b"", data)
        found[path.name] = data
    return found


def drill(count, seed=0, commands=tuple(COMMANDS)):
    """{"kills", "trials", "afresh", "wrong"}: kills in all until there are `count`, runs begun once
    more, what did not come out right.
    """
    home, here = Path(tempfile.mkdtemp()), Path.cwd()
    cli, rng = prepare(str(home / "cache")), random.Random(seed)
    os.chdir(home)
    try:
        log = ["simulate", *SHORT, "--set", "sensor.noise=0.02", "--out", "log"]
        if ended(start(cli, log)) != 0:
            raise RuntimeError(Path("said.txt").read_text())
        alone = {name: alone_run(cli, name) for name in commands}
        total = {"kills": 0, "trials": 0, "afresh": 0, "wrong": []}
        while total["kills"] < count:
            name = commands[total["trials"] % len(commands)]
            total["trials"] += 1
            shutil.rmtree("run", ignore_errors=True)
            code, kills, afresh = killed_run(cli, name, alone[name], count - total["kills"], rng)
            total["kills"] += kills
            total["afresh"] += afresh
            files = contents(Path("run")) if Path("run").exists() else {}
            differing = [n for n, data in alone[name].files.items() if files.get(n) != data]
            if code != alone[name].code:
                text = Path("said.txt").read_text()[-500:]
                total["wrong"].append(f"{name}: exit code {code}: {text}")
            elif differing or files.keys() - alone[name].files.keys():
                total["wrong"].append(f"{name}: differs in {differing}; {sorted(files)}")
            print(f"{name}: {kills} killed; {len(total['wrong'])} wrong", flush=True)
        return total
    finally:
        os.chdir(here)
        shutil.rmtree(home, ignore_errors=True)


class Alone(NamedTuple):
    """A run left alone: exit code, most that was kept on the way, seconds, {name: bytes}."""

    code: int
    kept: int
    seconds: float
    files: dict


def alone_run(cli, name):
    """The Alone of a command, the second run of it: its programs are compiled."""
    undisturbed(cli, COMMANDS[name], Path("compiled") / name)
    began, folder = time.monotonic(), Path("alone") / name
    code, most = undisturbed(cli, COMMANDS[name], folder)
    seconds = time.monotonic() - began
    print(f"{name}: exit code {code}, {most} kept on the way, {seconds:.1f} s", flush=True)
    return Alone(code, most, seconds, contents(folder))


def killed_run(cli, name, alone, most, rng):
    """(exit code, kills, runs begun once more) of a command that is killed up to four times."""
    folder, again, kills, afresh, code = Path("run"), False, 0, 0, None
    for attempt in range(12):
        child = start(cli, [*COMMANDS[name], *_where(name, folder, again)])
        if attempt < 4 and kills < most and (attempt == 0 or rng.random() < 0.5):
            few = rng.randint(1, max(1, alone.kept)) if rng.random() < 0.5 else None
            few = few if name in RESUMES else None
            # the others write at their end
            first = 0.8 if name not in RESUMES and rng.random() < 0.5 else 0.0
            share = rng.uniform(first, 0.9 if name in RESUMES else 1.0)
            seconds = rng.uniform(0.0, 0.3) if few else share * alone.seconds
            code = kill(child, folder, seconds, few)
            if code is None:
                kills, again = kills + 1, name in RESUMES
                continue
        else:
            code = ended(child)
        if not (again and code == 2 and AFRESH.search(Path("said.txt").read_text())):
            break
        # nothing had been kept yet, or all was done and only the log went
        again, afresh = False, afresh + 1
    return code, kills, afresh


def _where(name, folder, again=False):
    """The option that names the folder of a run, or a file in it."""
    file = folder / "page.html" if name == "explore" else folder
    return "--resume" if again else "--out", str(file)


def undisturbed(cli, words, folder):
    """(exit code, most that was kept on the way) of a run left alone."""
    child, most = start(cli, [*words, *_where(words[0], folder)]), 0
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status), most
        most = max(most, kept(folder))
        time.sleep(0.005)


if __name__ == "__main__":
    count = int(next((w for w in sys.argv[1:] if w.isdigit()), "50"))
    began = time.monotonic()
    found = drill(count, commands=tuple(n for n in COMMANDS if n in sys.argv) or tuple(COMMANDS))
    print(
        f"{found['kills']} kills of {found['trials']} runs in {time.monotonic() - began:.0f} s;"
        f" {found['afresh']} had kept nothing yet; {len(found['wrong'])} did not end as the run"
        " left alone"
    )
    print("\n".join(found["wrong"]))
    if "--record" in sys.argv:
        from survived import record

        right = found["trials"] - len(found["wrong"])
        words = f"{right} of {found['trials']} runs ended with the bytes of a run left alone"
        record("kills", found["kills"], words)
    sys.exit(1 if found["wrong"] else 0)

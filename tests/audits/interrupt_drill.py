"""Sends SIGINT and SIGTERM to cold runs of `jaxtank` at random moments of their first five seconds.

    python tests/audits/interrupt_drill.py 200 [tune ...] [--record]

Half of the moments are SIGINT, half SIGTERM. Each run must end with exit code 130 or 143 and one
line, without a traceback or an abort, and leave no lock and no unfinished file in its folder; a
search that was interrupted must have written its result. A signal before the first line of this
program, or after its last, is answered by the interpreter or the system; a shell sees 130 or 143
then, too. These are counted apart.
"""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from jaxtank.core import files

# what the console script `jaxtank` does
JAXTANK = [sys.executable, "-c", "import sys; from tuning.cli.main import main; sys.exit(main())"]
SHORT = ["cascaded/pi", "--set", "clock.dt=1", "--set", "clock.duration=400"]
COLUMNS = ["t=t [s]", "pump1=u1 [V]", "h1=y1 [V]", "h2=y2 [V]"]
COMMANDS = {
    "tune": ["tune", *SHORT, "--quiet"],
    "simulate": ["simulate", *SHORT, "--quiet"],
    "uncertainty": ["uncertainty", *SHORT, "--samples", "3000", "--quiet"],
    "sensitivity": ["sensitivity", *SHORT, "--quiet"],
    "identify": [
        *["identify", "cascaded/pi", "--data", "log/trajectory.csv", "--start", "case", "--quiet"],
        *[word for column in COLUMNS for word in ("--column", column)],
    ],
    "compare": ["compare", "cascaded"],
    "export": ["export", "cascaded/pi"],
    "show": ["show", "cascaded/pi"],
    "init": ["init", "cascaded/pi"],
    "list": ["list"],
}
WRITE = set(COMMANDS) - {"init", "list"}
LONGEST = 5.0  # s after the start
PATIENCE = 300.0  # s


def launch(name, folder):
    """The process of a command that writes to `folder`, if it writes."""
    words = [*COMMANDS[name], *(["--out", str(folder)] if name in WRITE else [])]
    return subprocess.Popen(
        [*JAXTANK, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def duration(name, folder):
    """Seconds that a command takes, LONGEST at most."""
    began, process = time.monotonic(), launch(name, folder)
    try:
        process.communicate(timeout=LONGEST)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
    shutil.rmtree(folder, ignore_errors=True)
    return min(time.monotonic() - began, LONGEST)


def wrong(number, code, out, err, folder):
    """What is wrong with a run that got signal `number`, None where it ended as it should."""
    messages = [line for line in err.splitlines() if line.startswith("jaxtank: ")]
    lines = [line for line in messages if "note: " not in line]
    word = "interrupted" if number == signal.SIGINT else "terminated"
    if code != 128 + number:
        return f"exit code {code}"
    fatal = any(mark in err for mark in ("Traceback", "Exception", "Fatal"))
    # a fit that was interrupted may also say why it writes no rig
    lines = [line for line in lines if "no rig is written" not in line]
    if fatal or len(lines) != 1 or word not in lines[0]:
        return "more or less than one line"
    if "best point so far" in lines[0] and not (folder / "result.json").exists():
        return "no result"
    left = [p.name for p in folder.iterdir()] if folder.exists() else []
    if any(name == files.LOCK or name.endswith(files.ASIDE) for name in left):
        return f"left {left}"
    return None


def drill(count, seed=0, commands=tuple(COMMANDS)):
    """Send `count` signals; return {"signals", "outside", "slowest", "wrong"}.

    These are how many were sent, how many of them before the first line of the program or after its
    last, the longest time until the end [s], and what did not end as it should.
    """
    rng, home, here = random.Random(seed), Path(tempfile.mkdtemp()), Path.cwd()
    # what is ignored here is ignored in a child
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.chdir(home)
    try:
        if "identify" in commands:
            log = ["simulate", *SHORT, "--set", "sensor.noise=0.02", "--out", "log", "--quiet"]
            subprocess.run([*JAXTANK, *log], check=True, capture_output=True)
        takes = {name: duration(name, home / "run") for name in commands}
        total = {"signals": 0, "outside": 0, "slowest": 0.0, "wrong": []}
        while total["signals"] < count:
            name = commands[total["signals"] % len(commands)]
            number = rng.choice([signal.SIGINT, signal.SIGTERM])
            moment, folder = rng.uniform(0.0, takes[name]), home / "run"
            shutil.rmtree(folder, ignore_errors=True)
            process = launch(name, folder)
            time.sleep(moment)
            if process.poll() is not None:  # it had ended: another moment
                process.communicate()
                continue
            process.send_signal(number)
            sent = time.monotonic()
            try:
                out, err = process.communicate(timeout=PATIENCE)
            except subprocess.TimeoutExpired:
                process.kill()
                out, err = process.communicate()
            took, code = time.monotonic() - sent, process.returncode
            if code >= 0 and code != 128 + number and "jaxtank: " not in err and took < 0.1:
                continue  # it ended by itself as the signal was sent
            total["signals"] += 1
            total["slowest"] = max(total["slowest"], took)
            outside = code == -number and "jaxtank: " not in err
            total["outside"] += outside
            why = None if outside else wrong(number, code, out, err, folder)
            row = f"{total['signals']} {name} {number.name} at {moment:.2f} s: {code}"
            row += f" after {took:.2f} s{' (interpreter)' if outside else ''}"
            if why:
                total["wrong"].append(f"{row}: {why}: {err[-1500:]}")
            print(row + (f" WRONG: {why}" if why else ""), flush=True)
        return total
    finally:
        os.chdir(here)
        shutil.rmtree(home, ignore_errors=True)


if __name__ == "__main__":
    count = int(next((w for w in sys.argv[1:] if w.isdigit()), "200"))
    total = drill(count, commands=tuple(n for n in COMMANDS if n in sys.argv) or tuple(COMMANDS))
    print(json.dumps(total, indent=1))
    if "--record" in sys.argv:
        from survived import record

        good = total["signals"] - len(total["wrong"]) - total["outside"]
        record(
            "interrupts",
            total["signals"],
            f"{good} ended with 130 or 143 and one line, the slowest after {total['slowest']:.1f}"
            f" s; {total['outside']} came before the first line of this program or after its last,"
            f" where the interpreter answers; {len(total['wrong'])} ended otherwise",
        )
    sys.exit(1 if total["wrong"] else 0)

"""The longest time in which a command shows nothing before it ends, in a pseudo-terminal.

python tests/audits/silence.py [COMMAND ...]     # on a quiet machine; exit code 1 above MOST
"""

import os
import pty
import select
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path

MOST = 2.0
"""Longest silence that is accepted [s]."""

LOG = "tests/data/cascaded_tanks.csv"

LINES = {
    "list": "list",
    "show": "show gouta2015/backstepping",
    "simulate": "simulate gouta2015/backstepping --out {out}",
    "together": "simulate gouta2015/backstepping gouta2015/ngpc --out {out}",
    "film": "simulate cascaded/pi --out {out} --gif",
    "init": "init gouta2015/backstepping",
    "export": "export gouta2015/backstepping --lang c",
    "explore": "explore gouta2015/backstepping --out {out}/page.html",
    "tune": "tune cascaded/pi --starts 1 --out {out}",
    "nominal": "tune cascaded/pi --nominal --starts 1 --out {out}",
    "uncertainty": "uncertainty cascaded/pi --samples 200 --out {out}",
    "sensitivity": "sensitivity cascaded/pi --out {out}",
    "attack": "attack cascaded/pi --starts 2 --iterations 3 --out {out}",
    "compare": "compare calofir --out {out}",
    "figure": "figure calofir/3 --out {out}",
    "identify": "identify cascaded/pi --data {log} --out {out}",
    "predict": "predict cascaded/pi --data {log}",
    "learn": "learn cascaded/pi --data {log}",
}
"""{name: command line}"""


def watched(line: str) -> tuple[int, float, list[tuple[float, str]]]:
    """Return (exit code, seconds, [(silence [s], what was last shown)]) of a command."""
    master, slave = pty.openpty()
    start = last = time.monotonic()
    run = subprocess.Popen(
        [sys.executable, "-m", "jaxtank", *shlex.split(line)],
        stdin=slave, stdout=slave, stderr=slave, env=os.environ | {"TERM": "xterm"},
    )  # fmt: skip
    os.close(slave)
    silences, shown = [], "(nothing)"
    while True:
        ready, _, _ = select.select([master], [], [], 0.05)
        now = time.monotonic()
        if ready:
            try:
                text = os.read(master, 65536).decode(errors="replace")
            except OSError:  # the other end is closed
                break
            if not text:
                break
            silences.append((now - last, shown))
            last, shown = now, (text.replace("\r", "\n").split("\n")[-1].strip() or shown)
        elif run.poll() is not None:
            break
    code = run.wait()
    os.close(master)
    silences.append((time.monotonic() - last, shown))
    return code, time.monotonic() - start, silences


def main(names: list[str]) -> int:
    """Print the longest silence of each command; 1 where one is too long."""
    worst = 0.0
    for name in names or LINES:
        with tempfile.TemporaryDirectory() as out:
            line = LINES[name].format(out=out, log=LOG)
            code, seconds, silences = watched(line)
        silence, shown = max(silences)
        worst = max(worst, silence)
        mark = "  <--" if silence > MOST else ""
        print(f"{name:12} {silence:6.1f} s of {seconds:6.1f} s, code {code}; {shown[:60]!r}{mark}")
    return int(worst > MOST)


if __name__ == "__main__":
    os.chdir(Path(__file__).parents[2])
    sys.exit(main(sys.argv[1:]))

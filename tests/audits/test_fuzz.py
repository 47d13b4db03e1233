"""Ten thousand broken rig files, command lines and logs: an answer in one line, no traceback,
nothing left behind.

The default run does a few hundred of each; `pytest -m slow tests/audits/test_fuzz.py` does the
rest, and prints what was tried.
"""

import functools
import importlib
import random
import time
import tomllib

import jax
import numpy as np
import pytest
from helpers import RIGS

from jaxtank import presets, rig
from jaxtank.core.errors import InputError
from tuning.cli import main
from tuning.identification.csv_log import read_log

WORDS = [
    "nan", "inf", "-inf", "1e400", "-1", "0", "1e-300", "true", "''", '"x"', "[]", "{}", "[[1.0]]",
    "[1.0, 2.0]", "9" * 400, "0x10", "1_000",
    '"rim"', '"\\u0000"', '"../../etc/passwd"', "1979-05-27", "[nan]", "[true, false]", '["a", 1]',
    "-0.0", "1e18", "0.5",
]  # fmt: skip
PATIENCE = 5.0  # s


SMALL = ("gouta2015/backstepping", "calofir/backstepping", "cascaded/pi", "mirakhorli/hybrid")


@functools.cache
def sources():
    """Texts of rig files that can be read."""
    cases = [rig.dump(presets.find(name)) for name in SMALL]
    return [*cases, *(path.read_text() for path in sorted(RIGS.glob("*.toml")))]


NAMES = ("tank", "values", "x", "clock.dt", "controller", "case")
TABLES = "[values] [[tank]] [controller] [reference] [] [[ [limits.max_level] [free] [[scenario]]"
CHARACTERS = [chr(i) for i in (0, 9, 34, 39, 91, 93, 61, 46, 48, 97, 233, 0x4E2D, 0x1F600)]


CHANGES = "delete", "repeat", "cut"
RIG_CHANGES = [*CHANGES, "word", "character", "entry", "table", "swap", "number"]
LOG_CHANGES = [*CHANGES, "cell", "short", "long", "head", "word", "comma"]


def changed_lines(lines, change, rng):
    """Lines with one of the changes that a rig file and a log have alike, None for another."""
    i = rng.randrange(len(lines))
    if change == "delete":
        return lines[:i] + lines[i + 1 :]
    if change == "repeat":
        return [*lines[:i], rng.choice(lines), *lines[i:]]
    if change == "cut":
        return lines[: rng.randrange(1, len(lines) + 1)]
    return None


def broken(text, rng):
    """A rig file with one to three things wrong, or none."""
    lines = text.splitlines()
    for _ in range(rng.randint(1, 3)):
        i = rng.randrange(len(lines))
        name, equals, _ = lines[i].partition("=")
        change = rng.choice(RIG_CHANGES)
        if (fewer := changed_lines(lines, change, rng)) is not None:
            lines = fewer or [""]
        elif change == "word" and equals:
            lines[i] = f"{name}= {rng.choice(WORDS)}"
        elif change == "character" and lines[i]:
            k = rng.randrange(len(lines[i]))
            lines[i] = lines[i][:k] + rng.choice(CHARACTERS) + lines[i][k + 1 :]
        elif change == "entry":
            lines.insert(i, f"{rng.choice(NAMES)} = {rng.choice(WORDS)}")
        elif change == "table":
            lines.insert(i, rng.choice(TABLES.split()))
        elif change == "swap":
            k = rng.randrange(len(lines))
            lines[i], lines[k] = lines[k], lines[i]
        elif change == "number" and equals:
            value = rng.random() * 10.0 ** rng.randint(-12, 12)
            lines[i] = f"{name}= {rng.choice(['-', ''])}{value!r}"
    return "\n".join(lines)


def read_rigs(count, seed, folder):
    """(read, refused) of `count` files; a message is one line that names the file."""
    rng, texts, read, refused = random.Random(seed), sources(), 0, 0
    path = folder / "rig.toml"
    for _ in range(count):
        text = broken(rng.choice(texts), rng)
        path.write_bytes(text.encode("utf-8", "surrogatepass"))
        began = time.perf_counter()
        try:
            case = rig.load(path)
            read += 1
            rig.dump(case)
        except InputError as error:
            refused += 1
            assert "rig.toml" in str(error) or "cannot be written" in str(error), text
            assert len(str(error)) < 2000
        assert time.perf_counter() - began < 10 * PATIENCE
    return read, refused


def test_broken_rig_files(tmp_path):
    read, refused = read_rigs(60, 0, tmp_path)
    assert read > 2 and refused > 20


OPTIONS = [
    "--set", "--dt", "--seed", "--out", "--free", "--limit", "--objective", "--scenario",
    "--choose", "--tradeoff", "--starts",
    "--robust", "--samples", "--spread", "--vary", "--resume", "--data", "--column",
    "--gap", "--start", "--lang",
    "--precision", "--name", "--schedule", "--method", "--batch", "--validation", "--iterations",
    "--screening", "--devices",
    "--measure", "--draws", "--noise", "--hold-back", "--loss", "--duration",
]  # fmt: skip
VALUES = [
    "", "nan", "-1", "0", "1e400", "x", "controller.k=1", "controller.k=nan", "controller.q=1",
    "clock.dt=0", "max_level=",
    "max_level=x", "a=b=c", "=", "plant.drain[9]=1",
    "plant.drain[=1", "1:2", "controller.k=2:1", "r1:1,2", "controller.k=r9:1,2",
    "../..", "\0", "é", "9" * 50, "uniform:5%", "plant.drain=uniform:x", "3/2", "0/0", "none",
    "h1=level", "🙂", "--", "[1,2",
    "true", "actuator.delay=1e9", "sensor.noise=-1", "x0=[1]",
]  # fmt: skip
COMMANDS = "simulate tune uncertainty sensitivity identify init export compare bench list fly"
COMMANDS = [*COMMANDS.split(), ""]
CASES = ["gouta2015/backstepping", "gouta2015", "gouta2051/ngpc", "nothing.toml", "/dev/null"]
CASES += ["", "..", "cascaded/pi"]
HARMLESS = {"list", "compare", "bench"}


def reported(words, capsys):
    """(exit code, lines of stderr) of a command that is meant to be refused before it runs
    anything.
    """
    began = time.perf_counter()
    try:
        code = main.main(words)
    except SystemExit as stop:  # --help
        code = stop.code
    found = capsys.readouterr()
    assert time.perf_counter() - began < 4 * PATIENCE, words
    return code, found.err


def refused_lines(count, seed, folder, capsys, monkeypatch):
    """How many of `count` command lines were refused. What would run is not let to: the work behind
    the door is replaced.
    """
    rng, refused = random.Random(seed), 0

    def stop(*_, **__):
        raise InputError("would run")

    homes = {
        "tuning.search.tuner": ("tune", "run_measures"),
        "tuning.uncertainty.study": ("ensemble",),
        "tuning.search.robust": ("tune_robust",),
        "tuning.identification.fit": ("identify",),
        "tuning.uncertainty.sensitivity_study": ("sensitivity",),
        "jaxtank.export.source": ("export",),
    }
    for home, names in homes.items():
        for name in names:
            monkeypatch.setattr(importlib.import_module(home), name, stop)
    monkeypatch.chdir(folder)
    before = sorted(p.name for p in folder.iterdir())
    for _ in range(count):
        command = rng.choice(COMMANDS)
        words = [w for w in [command] if w]
        if command in HARMLESS:
            words += [rng.choice(["nobody", "--sett", "--rounds=x", "-1"])]
        else:
            words += [rng.choice(CASES)]
            for _ in range(rng.randint(1, 3)):
                words += [rng.choice(OPTIONS), rng.choice(VALUES)]
        code, err = reported(words, capsys)
        assert "Traceback" not in err and "internal error" not in err, (words, err)
        assert code in (0, 2, 5), (words, code, err)
        if code:
            refused += 1
            last = [line for line in err.splitlines() if line.startswith("jaxtank: ")]
            assert len(last) == 1 and len(last[0]) < 3000, (words, err)
        assert sorted(p.name for p in folder.iterdir()) == before, words
    return refused


@pytest.mark.extended
def test_broken_command_lines(tmp_path, capsys, monkeypatch):
    assert refused_lines(60, 0, tmp_path, capsys, monkeypatch) > 40


LOG = "t [s],pump1 [V],pump2 [V],h1 [cm],h2 [cm],h3 [cm],h4 [cm]\n" + "".join(
    f"{k},{3 + 0.1 * (k % 5):.1f},2.8,{10 + 0.01 * k:.2f},{9 - 0.01 * k:.2f},2.6,4.6\n"
    for k in range(60)
)
CELLS = "|nan|inf|-inf|1e400|1,5|1.5.2|x|-|0x1f|1_0|1e-320|-5|99999|\"|'|\0|é|=1+1|3 |+3|1e5000"
HEAD = LOG.splitlines()[0]
HEADS = ["", "t,h1", "a,b,c,d,e,f,g", HEAD * 2]
HEADS += [HEAD.replace(*pair) for pair in (("[cm]", "[V]"), ("[s]", "[h]"), (",", ";"))]


def broken_log(rng):
    """A log with one to three things wrong, or none."""
    lines = LOG.splitlines()
    for _ in range(rng.randint(1, 3)):
        i = rng.randrange(len(lines))
        cells = lines[i].split(",")
        change = rng.choice(LOG_CHANGES)
        if (fewer := changed_lines(lines, change, rng)) is not None:
            lines = fewer or [""]
        elif change == "cell":
            cells[rng.randrange(len(cells))] = rng.choice(CELLS.split("|"))
            lines[i] = ",".join(cells)
        elif change == "short":
            lines[i] = ",".join(cells[: rng.randrange(len(cells) + 1)])
        elif change == "long":
            lines[i] = lines[i] + "," * rng.randint(1, 4)
        elif change == "head":
            lines[0] = rng.choice(HEADS)
        elif change == "word":
            lines[i] = rng.choice(["#", "# comment", "\ufeff", " ", "\t\t\t", '"' + lines[i]])
        elif change == "comma":
            lines = [line.replace(",", rng.choice([";", "\t", ", "])) for line in lines]
    return rng.choice(["\n", "\r\n", "\n"]).join(lines)


def read_logs(count, seed, folder):
    rng, loop, read, refused = random.Random(seed), presets.find("mirakhorli/sfc").loop, 0, 0
    path = folder / "log.csv"
    for _ in range(count):
        text = broken_log(rng)
        path.write_bytes(text.encode())
        try:
            log = read_log(path, loop, decimal=rng.choice([".", ".", ","]))
            read += 1
            assert np.all(np.diff(log.t) > 0) and np.all(np.isfinite(log.u))
            assert not np.isinf(log.y).any()
        except InputError as error:
            refused += 1
            message = str(error)
            assert "log.csv" in message and "\n" not in message and len(message) < 1000, text
    return read, refused


def test_broken_logs(tmp_path):
    read, refused = read_logs(100, 0, tmp_path)
    assert read > 5 and refused > 30


@pytest.mark.slow
def test_ten_thousand(tmp_path, capsys, monkeypatch):
    jax.config.update("jax_enable_x64", True)
    (tmp_path / "empty").mkdir()
    lines = refused_lines(3000, 1, tmp_path / "empty", capsys, monkeypatch)
    rigs = read_rigs(3000, 1, tmp_path)
    logs = read_logs(4000, 1, tmp_path)
    with capsys.disabled():
        print(
            f"\nrig files: {rigs[0]} read, {rigs[1]} refused; logs: {logs[0]} read, {logs[1]}"
            f" refused; command lines refused: {lines} of 3000"
        )


@pytest.mark.extended
def test_the_files_these_begin_with_are_good():
    for text in sources():
        assert tomllib.loads(text)
        rig.loads(text, "rig file")

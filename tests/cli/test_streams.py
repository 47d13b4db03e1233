"""The command with streams that are closed, full or left by their reader, in a process of its own:
exit codes and answers as promised.
"""

import io
import re
import subprocess
import sys
import time

import pytest
from helpers import ONE_TANK

from tuning.cli import terminal
from tuning.cli.commands.tuning import Progress

JAXTANK = [sys.executable, "-m", "tuning.cli.main"]
SHORT = ["cascaded/pi", "--set", "clock.dt=1", "--set", "clock.duration=400"]
SEARCH = ["tune", *SHORT, "--starts", "1", "--screening", "2", "--validation", "0"]
SEARCH += ["--iterations", "3"]


def shell(words, tail):
    """The command followed by redirections in the shell's words."""
    line = " ".join(f"'{w}'" for w in [*JAXTANK, *words])
    return subprocess.run(
        ["bash", "-c", f"{line} {tail}"], capture_output=True, text=True, timeout=120
    )


def figures(out):
    """What a tuning said, less its time."""
    return re.sub(r"[\d.]+ s\b", "", out)


@pytest.mark.extended
def test_a_closed_stdout_is_output_that_cannot_be_written(tmp_path):
    (tmp_path / "one.toml").write_text(ONE_TANK)
    out = tmp_path / "out"
    done = shell(["export", str(tmp_path / "one.toml"), "--json", "--out", str(out)], ">&-")
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1] == "jaxtank: output: Bad file descriptor"
    for path in out.iterdir():  # nothing that was printed got into a file
        assert not path.read_text().startswith("{")


@pytest.mark.parametrize("words", [["completion", "bash"], ["--help"], ["tune", "--help"]])
@pytest.mark.parametrize("tail", [">&-", ">/dev/full"])
def test_what_is_printed_alone_and_cannot_be(words, tail):
    done = shell(words, tail)
    assert done.returncode == 2 and re.fullmatch(r"jaxtank: output: [\w ]+\n", done.stderr), (
        done.stderr
    )


@pytest.mark.parametrize("tail", ["2>/dev/full", "2>&-", "2>&- <&-", "2> >(exec true)"])
def test_bad_input_keeps_its_exit_code(tail):
    assert shell(["completion", "cmd"], tail).returncode == 2


@pytest.mark.slow
def test_progress_that_cannot_be_reported_ends_no_run():
    """Full or closed: the answer is that of a run whose progress was read."""
    reported = shell(SEARCH, "")
    assert reported.returncode in (0, 3) and "start 1/1" in reported.stderr
    for tail in ("2>/dev/full", "2>&-"):
        silent = shell(SEARCH, tail)
        assert (silent.returncode, figures(silent.stdout)) == (
            reported.returncode,
            figures(reported.stdout),
        ), tail


def test_ctrl_c_where_nothing_can_be_reported():
    """The handler of the signal speaks, too."""
    code = (
        "import os, signal, sys; from tuning.cli import interrupts, terminal; terminal.guard();"
        " signal.signal(signal.SIGINT, signal.default_int_handler);"  # a shell may have it ignored
        " found = interrupts.Interrupts(); found.check()\nos.kill(os.getpid(),"
        " signal.SIGINT)\nprint(found.stop)"
    )
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=full, text=True
        )
    assert (done.returncode, done.stdout) == (0, "True\n")


def test_a_forgiving_stream_writes_what_is_taken(tmp_path):
    with open(tmp_path / "told", "w+b") as file:
        raw = terminal.Forgiving(file.fileno())
        assert raw.write(b"start 1/8\n") == 10
        assert not raw.isatty() and raw.fileno() == file.fileno()
        assert (tmp_path / "told").read_bytes() == b"start 1/8\n"
    assert terminal.Forgiving(10**6).write(b"lost") == 4  # no descriptor has that number


class Screen(io.StringIO):
    """A stderr that is a terminal."""

    def isatty(self):
        return True


@pytest.mark.parametrize("quiet", [False, True])
@pytest.mark.parametrize("stream", [Screen, io.StringIO])
def test_a_long_compilation_is_announced_on_a_terminal_only(monkeypatch, stream, quiet):
    monkeypatch.setattr(sys, "stderr", stream())
    Progress("cm", quiet)
    terminal.end_lines()
    announced = "compiling the simulation and its derivatives, about" in sys.stderr.getvalue()
    assert announced == (stream is Screen and not quiet)


def test_a_line_is_overwritten_on_a_terminal_and_elsewhere_printed_at_each_tenth(monkeypatch):
    printed = []
    for stream in (Screen, io.StringIO):
        monkeypatch.setattr(sys, "stderr", stream())
        line = terminal.Line(False)
        for done in range(1, 101):
            line.runs(done, 100)
        line.end()
        printed.append(sys.stderr.getvalue())
    screen, file = printed
    assert screen.count("\r") == 100 and screen.count("\n") == 1
    assert file.splitlines() == [f"run {done}/100" for done in range(10, 101, 10)]


def test_a_phase_is_shown_after_a_while_and_erased_before_anything_else(monkeypatch):
    wrote = []
    monkeypatch.setattr(terminal.os, "write", lambda fd, data: wrote.append(data) or len(data))
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    phase = terminal.Phase()
    phase.show("importing")
    assert phase.clock is None  # --quiet
    phase.quiet, phase.DELAY = False, 0.0
    monkeypatch.setattr(terminal, "phase", phase)
    phase.show("importing")
    deadline = time.monotonic() + 10.0
    while not phase.there and time.monotonic() < deadline:
        time.sleep(0.01)
    terminal.Forgiving(2).write(b"a note")
    shown, erased, note = wrote[0], *wrote[-2:]
    assert shown.startswith(b"\rimporting") and erased == b"\r\033[K" and note == b"a note"
    terminal.end_lines()
    assert phase.clock is None and not phase.there

"""What reaches a terminal: one line that is not too long, of characters that the terminal prints
and does not obey.
"""

import pytest

from jaxtank import rig
from jaxtank.core.errors import InputError
from jaxtank.core.text import MOST, one_line, printable
from tuning.cli import main

RED = "a\033[31m.csv"
ESCAPED = r"a\x1b[31m.csv"
HEADER = "t [s],pump1 [V],pump2 [V],h1 [cm],h2 [cm],h3 [cm],h4 [cm]"
IDENTIFY = (
    *("identify", "mirakhorli/sfc", "--free", "plant.pump_gain=5:60", "--starts", "1", "--data"),
)
SHORT = ("--set", "clock.dt=1", "--set", "clock.duration=100")


@pytest.fixture
def say(tmp_path, monkeypatch, capsys):
    """say(words) -> (exit code, stdout, stderr) in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def run(*words):
        code = main.main(list(words))
        return code, *capsys.readouterr()

    return run


def test_characters_that_a_terminal_obeys_are_escaped():
    assert printable(RED) == ESCAPED and printable("Füllstand 水位.csv") == "Füllstand 水位.csv"
    assert printable("a\nb\tc\x7f\x9b\u202e") == r"a\nb\tc\x7f\x9b\u202e"
    # a file name that is not UTF-8
    assert printable(b"\xff.csv".decode("utf-8", "surrogateescape")) == r"\udcff.csv"


def test_a_long_line_keeps_both_its_ends():
    line = one_line("file.csv, line 3: " + 10_000 * "x" + " is no unit; nearest: cm")
    assert len(line) == MOST
    assert line.startswith("file.csv, line 3: xx") and line.endswith("xx is no unit; nearest: cm")
    assert one_line("a\n  b ") == "a b" and one_line("x" * MOST) == "x" * MOST


@pytest.mark.extended_for("words3-None")
@pytest.mark.slow_for("words0-None")
@pytest.mark.parametrize(
    ("words", "end"),
    [
        (("--set", "a" * 100_000 + "=1"), None),
        (("--seed", "1" * 5000), "must be a whole number from 0 to 2147483647"),
        (("--set", "clock.dt=" + "x" * 100_000), None),
        (("--" + "a" * 100_000,), None),
    ],
)
def test_an_error_of_a_long_word_is_a_short_line(say, words, end):
    code, out, err = say("simulate", "cascaded/pi", *words)
    (line,) = err.splitlines()
    assert code == 2
    assert out == "" and len(line) <= MOST + len("jaxtank: ") and line.endswith(end or "")


@pytest.mark.extended
def test_a_log_of_many_columns_is_refused_in_a_short_line(say, tmp_path):
    header = ",".join(f"column {i}" for i in range(3_000))
    (tmp_path / "wide.csv").write_text(header + "\n" + ",".join(["1"] * 3_000) + "\n")
    code, out, err = say(*IDENTIFY, "wide.csv")
    assert code == 5 and out == ""
    assert max(map(len, err.splitlines())) <= MOST + len("jaxtank: ")  # a [log] table below
    assert "no column for t (time) among 'column 0', 'column 1'" in err
    assert "and 2980 more; name it with --column" in err


@pytest.mark.parametrize("content", [None, "", HEADER + "\n0,3,2,1,1,1,x\n", b"\xff"])
def test_names_of_logs_are_reported_escaped(say, tmp_path, content):
    if content is not None:
        (tmp_path / RED).write_bytes(content.encode() if isinstance(content, str) else content)
    code, out, err = say(*IDENTIFY, RED)
    assert code == 5 and out == "" and ESCAPED in err and "\033" not in err


@pytest.mark.slow
def test_names_of_logs_in_what_is_found(say, tmp_path):
    rows = [
        f"{k},3,2.8,{2 + 0.1 * k:.2f},{2 + 0.12 * k:.2f},{1 + 0.02 * k:.2f},{1 + 0.03 * k:.2f}"
        for k in range(12)
    ]
    (tmp_path / RED).write_text("\n".join([HEADER, *rows]) + "\n")
    _, out, err = say(*IDENTIFY, RED, "--iterations", "2")
    assert f"{ESCAPED}: 12 samples" in err and ESCAPED in out and "\033" not in out + err


@pytest.mark.slow
def test_names_of_rigs_and_folders(say, tmp_path):
    """A note about a rig file, and where the result went."""
    _, text, _ = say("init", "cascaded/pi", "--short")
    (tmp_path / "b\033[31m.toml").write_text(
        text.replace("[values]\n", "[values]\nx0 = [11.0, 11.0]\n", 1)
    )
    code, _, err = say("simulate", "b\033[31m.toml", *SHORT, "--out", "c\033[31m")
    assert code == 0 and r"jaxtank: b\x1b[31m.toml: note:" in err
    assert r"written to c\x1b[31m:" in err and "\033" not in err


def test_a_number_of_thousands_of_digits_in_a_rig_file_is_reported_in_our_words():
    with pytest.raises(InputError, match="has more digits than can be read") as caught:
        rig.loads("[clock]\ndt = " + "1" * 10_000)
    assert "sys." not in str(caught.value)

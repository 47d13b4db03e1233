"""What the README shows is run: its Python as written, its commands by the same parser or in full."""

import re
import shlex
from pathlib import Path

import pytest

from tuning.cli import main
from tuning.cli.commands import identification, tuning
from tuning.cli.parser import parser

README = Path(__file__).parent.parent / "README.md"
pytestmark = pytest.mark.skipif(not README.exists(), reason="the README is not beside the tests")


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README.read_text(), re.DOTALL) if README.exists() else []


COMMANDS = [shlex.split(line, comments=True)[1:] for block in blocks("sh") for part in block.splitlines() for line in part.split("&&")
            if line.strip().startswith("jaxtank")]  # fmt: skip


def test_the_python_example_runs_and_is_short(capsys):
    (example,) = blocks("python")
    assert len([line for line in example.splitlines() if line.strip()]) <= 12
    exec(compile(example, "README", "exec"), {})
    said = capsys.readouterr().out
    assert said.startswith("0.0819")
    assert "converged" in said and "0.03987" in said


def test_the_rig_it_shows_is_the_one_that_is_tested():
    (shown,) = blocks("toml")
    assert shown == (Path(__file__).parent / "rigs" / "watertank.toml").read_text()


def test_commands_parse():
    assert len(COMMANDS) >= 10
    for words in COMMANDS:
        args, rest = parser().parse_known_args(words)
        assert not rest and args.command in main.COMMANDS


@pytest.mark.slow
@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_commands_run(words, tmp_path_factory, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path_factory.getbasetemp())
    assert main.main(words) == 0, capsys.readouterr().err


def test_the_picture_is_there_and_small():
    for name in re.findall(r"!\[.*?\]\((.*?)\)", README.read_text()):
        assert (README.parent / name).stat().st_size < 300_000


def test_every_exit_code_is_told():
    """Those of a search, of an identification, of refused input and of refused data."""
    told = re.search(r"Exit codes: (.*?)\. Results", README.read_text(), re.DOTALL)[1]
    codes = {int(code) for code in re.findall(r"(?:^|, )(\d+) ", told.replace("\n", " "))}
    assert codes == {*tuning.EXIT.values(), *identification.STATUS.values(), 2, 143}

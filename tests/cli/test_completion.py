"""Shell completion: the words that complete a line, and the scripts in the shells themselves."""

import argparse
import ast
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import python

import jaxtank
import tuning
from tuning.cli import completion, main, parser as options
from tuning.cli.parser import COMMANDS, parser

SHELLS = {shell: shutil.which(shell) for shell in completion.SCRIPTS}


def need(shell):
    return pytest.mark.skipif(SHELLS[shell] is None, reason=f"{shell} is not installed here")


def words(line):
    return completion.candidates(parser(), line.split(" ")[1:])


OTHERS = {"--xla", "--preload", "--version"}
"""Options of XLA and Dask, and the one of no command."""


@pytest.mark.extended
def test_options_in_texts_are_options_of_a_command():
    options = {option for name in COMMANDS for option in parser().options(name)} | OTHERS
    for path in (p for root in (jaxtank, tuning) for p in Path(root.__file__).parent.rglob("*.py")):
        if path.parent.name == "export":  # --i of C and JavaScript
            continue
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", node.value))
                assert named <= options, f"{path.name}, line {node.lineno}"


def test_commands_options_cases_parameters_and_measures(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert words("jaxtank s") == ["sensitivity", "show", "simulate"]
    assert set(words("jaxtank ")) >= set(COMMANDS)
    assert words("jaxtank --v") == ["--version"]
    expected = ["", "-boxqp", "-boxqp-slow", "-slow"]
    assert words("jaxtank tune gouta2015/backstepping-ff-t") == [
        f"gouta2015/backstepping-ff-table1{more}" for more in expected
    ]
    flags = [o for o in parser().options("tune") if o.startswith("--s")]
    assert words("jaxtank tune calofir/backstepping --s") == sorted(flags)
    assert words("jaxtank simulate calofir/backstepping --set plant.pump") == ["plant.pump_gain="]
    assert words("jaxtank tune calofir/backstepping --limit max_l") == ["max_level="]
    assert words("jaxtank sensitivity cascaded/pi --measure max_l") == ["max_level"]
    assert words("jaxtank tune calofir/backstepping --method ") == sorted(
        ["auto", "trf", "coarse-trf", "slsqp", "lbfgs", "adam"]
    )
    assert words("jaxtank sensitivity cascaded/pi --method ") == ["local", "morris", "sobol"]
    assert words("jaxtank compare gouta2015") == ["gouta2015"]
    assert words("jaxtank figure khalid/") == [f"khalid/{n}" for n in range(2, 8)]
    assert words("jaxtank completion ") == sorted(completion.SCRIPTS)


def test_rig_files_and_folders(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").write_text("")
    (tmp_path / "mine.csv").write_text("")
    (tmp_path / "more").mkdir()
    cases = words("jaxtank tune mirakhorli")
    assert words("jaxtank tune m") == sorted(["mine.toml", "more/", *cases])
    assert words("jaxtank tune mine.toml --out m") == ["more/"]
    assert words("jaxtank identify mine.toml --data m") == ["mine.csv", "mine.toml", "more/"]
    assert words("jaxtank tune mine.toml --set plant.area=3") == []  # a value is not completed
    assert words("jaxtank tune mine.toml --set plant.area=3 --quie") == ["--quiet"]


def in_shell(shell, code, line, tmp_path):
    """Words that a shell prints by `code`, whose arguments are `line`."""
    flags = {"bash": ["--norc", "--noprofile"], "zsh": ["-f"], "fish": ["--no-config"]}[shell]
    define = f'jaxtank() {{ {sys.executable} -m jaxtank "$@"; }}'
    if shell == "fish":
        define = f"function jaxtank; {sys.executable} -m jaxtank $argv; end"
    (tmp_path / "script").write_text(completion.script(shell), encoding="utf-8")
    environment = {**os.environ, "TERM": "dumb", "HOME": str(tmp_path)}
    done = subprocess.run(
        [SHELLS[shell], *flags, "-c", f"{define}\n{code}", shell, *line],
        capture_output=True,
        text=True,
        timeout=60,
        env=environment,
    )
    assert done.returncode == 0 and done.stderr == "", done.stderr
    return done.stdout.split()


LINES = ["jaxtank tune calofir/backstepping --limit max_l", "jaxtank tune x --set plant.area=3"]


@need("bash")
def test_bash(tmp_path):
    code = (
        f'source {tmp_path}/script; complete -p jaxtank; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1));'
        " _jaxtank; printf '%s\\n' \"${COMPREPLY[@]}\""
    )
    for line, expected in zip(LINES, (["max_level="], [])):
        split = [w for w in re.split(r"\s+|(=)", line) if w]  # as bash itself does
        out = in_shell("bash", code, split, tmp_path)
        assert out == ["complete", "-F", "_jaxtank", "jaxtank", *expected]


@need("zsh")
def test_zsh(tmp_path):
    stub = (
        "compdef() { :; }; compadd() { while [[ $1 != -- ]]; do shift; done; shift; print -r $@; };"
    )
    code = f'{stub} source {tmp_path}/script; words=("$@"); CURRENT=$#; _jaxtank'
    assert in_shell("zsh", code, LINES[0].split(), tmp_path) == ["max_level="]


@need("fish")
def test_fish(tmp_path):
    code = f"source {tmp_path}/script; complete -C '{LINES[0]}'"
    assert in_shell("fish", code, [], tmp_path) == ["max_level="]


def test_it_knows_what_the_parser_and_the_library_have():
    assert completion.NAMES.read_text(encoding="utf-8") == completion.gather(), (
        "python -c 'from tuning.cli.completion import refresh; refresh()'"
    )
    assert all(command.help for command in COMMANDS.values())
    with_names = {
        action.metavar
        for command in COMMANDS
        for action in parser().options(command).values()
        if action.metavar and "=" in action.metavar
    }
    assert {metavar.partition("=")[0] for metavar in with_names} == {"NAME", "MEASURE", "SLOT"}


LIGHT = """
import contextlib, io, sys
from tuning.cli import main as cli
lines = [["completion", "bash"], ["completion", "words", "tune", "c"], ["list"], ["--help"]]
with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.suppress(SystemExit):
    for words in lines:
        assert cli.main(words) == 0
heavy = "jax", "numpy", "scipy", "matplotlib", "optax"
print("usage: jaxtank" in out.getvalue(), [m for m in heavy if m in sys.modules])
"""


def test_help_completion_and_list_do_not_start_jax():
    assert python(LIGHT) == "True []"


def test_an_unknown_shell_is_refused(capsys):
    assert main.main(["completion", "bahs"]) == 2
    assert "unknown shell 'bahs'; nearest: bash" in capsys.readouterr().err


def test_every_option_is_made_to_be_repeated_or_refuses_it():
    for command in COMMANDS:
        for action in parser().options(command).values():
            kinds = (options.Once, options.Pairs, argparse._AppendAction)
            assert action.nargs == 0 or isinstance(action, kinds)

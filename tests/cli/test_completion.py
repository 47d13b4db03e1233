"""Shell completion: the scripts run in the shells themselves, and hold what the parser and the
library have.
"""

import os
import re
import shutil
import subprocess
import sys

import pytest

from tuning.cli import completion, main
from tuning.cli.parser import parser

COMMANDS = {
    *("list", "show", "simulate", "tune", "uncertainty", "sensitivity", "identify"),
    *("attack", "explore"),
    *("init", "export", "compare", "figure", "completion", "bench", "cache"),
}
SHELLS = {shell: shutil.which(shell) for shell in completion.SHELLS}


def need(shell):
    return pytest.mark.skipif(SHELLS[shell] is None, reason=f"{shell} is not installed here")


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    """Path of the script of each shell."""
    folder = tmp_path_factory.mktemp("completion")
    for shell in completion.SHELLS:
        (folder / shell).write_text(completion.script(shell, parser()), encoding="utf-8")
    return lambda shell: str(folder / shell)


def printed(shell, code, *args, cwd=None):
    flags = {"bash": ["--norc", "--noprofile"], "zsh": ["-f"], "fish": ["--no-config"]}[shell]
    environment = {**os.environ, "TERM": "dumb", "HOME": str(cwd or "/nonexistent")}
    done = subprocess.run(
        [SHELLS[shell], *flags, "-c", code, *args],
        capture_output=True,
        text=True,
        timeout=60,
        cwd=cwd,
        env=environment,
    )
    assert done.returncode == 0 and done.stderr == "", done.stderr
    return done.stdout.split("\n")[:-1]


def bash_words(path, line, cwd=None):
    """What bash's own split of a line and the function make of its last word."""
    words = [w for w in re.split(r"\s+|(=)", line) if w is not None and (w or line.endswith(" "))]
    words = [w for i, w in enumerate(words) if w or i == len(words) - 1]
    code = (
        f'source {path}; shift; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _jaxtank; printf'
        " '%s\\n' \"${COMPREPLY[@]}\""
    )
    return [w for w in printed("bash", code, "bash", "x", *words, cwd=cwd) if w]


def zsh_words(path, line, cwd=None):
    """The same of zsh, with `compadd` and `_files` in the place of its completion system."""
    stub = (
        "compdef() { :; }; _files() { [[ $1 == -/ ]] && print folders || print files; }; compadd()"
        " { local w; while [[ $1 != -- ]]; do shift; done; shift; for w; do [[ $w =="
        " ${words[CURRENT]}* ]] && print -r -- $w; done; return 0; };"
    )
    code = f'{stub} source {path}; words=("$@"); CURRENT=$#; _jaxtank'
    return printed("zsh", code, "zsh", *line.split(" "), cwd=cwd)


def fish_words(path, line, cwd=None):
    return [
        w.split("\t")[0]
        for w in printed("fish", f"source {path}; complete -C $argv[1]", line, cwd=cwd)
    ]


READ = {"bash": bash_words, "zsh": zsh_words, "fish": fish_words}
EACH = [pytest.param(shell, marks=need(shell)) for shell in completion.SHELLS]


@need("bash")
def test_bash_registers_it(script):
    assert printed("bash", f"source {script('bash')}; complete -p jaxtank") == [
        "complete -F _jaxtank jaxtank"
    ]


@pytest.mark.parametrize("shell", EACH)
def test_commands_options_cases_parameters_and_measures(script, shell, tmp_path):
    asked = lambda line: READ[shell](script(shell), line, cwd=tmp_path)
    assert set(asked("jaxtank s")) == {"show", "simulate", "sensitivity"}
    assert set(asked("jaxtank ")) >= COMMANDS
    wanted = {
        f"gouta2015/backstepping-ff-table1{more}" for more in ("", "-slow", "-boxqp", "-boxqp-slow")
    }
    assert set(asked("jaxtank tune gouta2015/backstepping-ff-t")) - {"files"} == wanted
    assert set(asked("jaxtank tune calofir/backstepping --s")) == {
        o
        for a in parser()._subparsers._group_actions[0].choices["tune"]._actions
        for o in a.option_strings
        if o.startswith("--s")
    }
    assert asked("jaxtank simulate calofir/backstepping --set plant.pump") == ["plant.pump_gain="]
    assert asked("jaxtank tune calofir/backstepping --limit max_l") == ["max_level="]
    assert asked("jaxtank sensitivity cascaded/pi --measure max_l") == ["max_level"]
    assert set(asked("jaxtank tune calofir/backstepping --method ")) == {
        "auto",
        "trf",
        "coarse-trf",
        "slsqp",
        "lbfgs",
        "adam",
    }
    assert set(asked("jaxtank sensitivity cascaded/pi --method ")) == {"local", "morris", "sobol"}
    assert asked("jaxtank compare gouta2015") == ["gouta2015"]
    assert asked("jaxtank figure khalid/") == [f"khalid/{n}" for n in range(2, 8)]
    assert set(asked("jaxtank completion ")) == set(completion.SHELLS)


@need("bash")
def test_bash_completes_rig_files_and_folders(script, tmp_path):
    (tmp_path / "mine.toml").write_text("")
    (tmp_path / "mine.csv").write_text("")
    (tmp_path / "more").mkdir()
    asked = lambda line: bash_words(script("bash"), line, cwd=tmp_path)
    assert set(asked("jaxtank tune m")) == {"mine.toml", "more/"} | set(
        asked("jaxtank tune mirakhorli")
    )
    assert asked("jaxtank tune mine.toml --out m") == ["more"]
    assert asked("jaxtank tune mine.toml --set plant.area=3") == []  # a value is not completed
    assert asked("jaxtank tune mine.toml --set plant.area=3 --quie") == ["--quiet"]


def test_it_knows_what_the_parser_and_the_library_have():
    assert completion.NAMES.read_text(encoding="utf-8") == completion.gather(), (
        "python -c 'from tuning.cli.completion import refresh; refresh()'"
    )
    found = completion.commands_of(parser())
    assert set(found) - {""} == COMMANDS == set(parser().commands) and all(
        c.help for n, c in found.items() if n
    )
    for (command, option), values in completion.FEW.items():
        assert any(
            option in o.flags and o.value == " ".join(values) for o in found[command].options
        )
    for action in (
        a for p in parser()._subparsers._group_actions[0].choices.values() for a in p._actions
    ):
        if action.metavar and "=" in action.metavar:
            # a new kind of option says what its names are
            assert action.metavar in completion.KINDS, action.option_strings


def test_help_and_completion_do_not_start_jax(capsys):
    code = (
        "import sys, contextlib, io; from tuning.cli import main as cli\nwith"
        " contextlib.redirect_stdout(io.StringIO()):\n    assert cli.main(['completion',"
        " sys.argv[1]]) == 0\nprint([m for m in ('jax', 'numpy', 'scipy', 'matplotlib') if m in"
        " sys.modules])"
    )
    for shell in completion.SHELLS:
        assert (
            subprocess.run(
                [sys.executable, "-c", code, shell], capture_output=True, text=True
            ).stdout.strip()
            == "[]"
        )
    assert main.main(["completion", "bahs"]) == 2
    assert "unknown shell 'bahs'; nearest: bash" in capsys.readouterr().err

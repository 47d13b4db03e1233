"""Shell completion, generated from the parser: `jaxtank completion bash|zsh|fish` prints a script.

The words that only a started jax knows (cases, parameters, measures) are kept in names.txt beside
this file; `refresh()` writes it anew and a test holds it to what the library has. Nothing here
imports jax.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

from jaxtank.core.errors import unknown

NAMES = Path(__file__).with_name("names.txt")
SHELLS = ("bash", "zsh", "fish")
# what the values of an option are, by what the help calls them
KINDS = {
    "DIR": "folders",
    "NAME=VALUE": "parameters",
    "NAME=LOW:HIGH": "parameters",
    "NAME=DIST": "parameters",
    "NAME=DISTRIBUTION": "parameters",
    "NAME=V1,V2": "parameters",
    "NAME=VARIABLE:K1,K2,...": "parameters",
    "NAME=VALUE[;NAME=VALUE]": "parameters",
    "MEASURE=VALUE": "limits",
    "MEASURE=WEIGHT": "limits",
    "MEASURE=LOW:HIGH[:N]": "limits",
    "SLOT=HEADER[;UNIT]": "text",
    "CSV": "files",
    "CASE": "cases",
    "PAPER": "papers",
    "SHELL": "shells",
}
# options whose values are a few words
FEW = {
    ("tune", "--method"): ("auto", "trf", "coarse-trf", "slsqp", "lbfgs", "adam"),
    ("tune", "--robust"): ("mean", "cvar", "worst"),
    ("sensitivity", "--method"): ("local", "morris", "sobol"),
    ("uncertainty", "--draws"): ("random", "latin", "sobol"),
    ("merge", "--draws"): ("random", "latin", "sobol"),
    ("identify", "--loss"): ("linear", "soft_l1", "huber"),
    ("identify", "--start"): ("free", "measured", "case"),
    ("export", "--lang"): ("c", "m"),
    ("export", "--precision"): ("double", "float"),
}


class Option(NamedTuple):
    """An option of a command: its spellings, what its value is ("" for a flag, "text" for what is
    not completed), a line of help.
    """

    flags: tuple
    value: str
    help: str


class Command(NamedTuple):
    """A command: a line of help, its options, what its arguments are ("" for none)."""

    help: str
    options: list
    argument: str


def script(shell, parser):
    """The completion script of a shell, of SHELLS, for a parser with subcommands. Raises InputError
    for another shell.
    """
    if shell not in SHELLS:
        raise unknown("shell", shell, SHELLS)
    return {"bash": bash, "zsh": zsh, "fish": fish}[shell](commands_of(parser), words())


def commands_of(parser):
    """{name: Command} of a parser, with what stands before a command under ""."""
    sub = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    lines = {a.dest: a.help or "" for a in sub._choices_actions}
    found = {"": Command("", _options("", parser), "commands")}
    for name, own in sub.choices.items():
        places = [KINDS.get(a.metavar, "text") for a in own._actions if not a.option_strings]
        found[name] = Command(lines.get(name, ""), _options(name, own), places[0] if places else "")
    return found


def _options(command, parser):
    found = []
    for a in parser._actions:
        if not a.option_strings:
            continue
        few = next(
            (" ".join(FEW[command, o]) for o in a.option_strings if (command, o) in FEW), None
        )
        measured = command and "--measure" in a.option_strings and command != "identify"
        kind = (
            ""
            if a.nargs == 0
            else few or ("measures" if measured else KINDS.get(a.metavar, "text"))
        )
        found.append(Option(tuple(a.option_strings), kind, (a.help or "").replace("%%", "%")))
    return found


def words():
    """{"cases", "papers", "parameters", "limits", "measures", "shells"}: the words of each kind."""
    found = {"cases": [], "parameters": [], "measures": []}
    for line in NAMES.read_text(encoding="utf-8").splitlines():
        kind, _, word = line.partition(" ")
        found[kind].append(word)
    papers = list(dict.fromkeys(c.split("/")[0] for c in found["cases"]))
    with_value = {
        "parameters": [f"{p}=" for p in found["parameters"]],
        "limits": [f"{m}=" for m in found["measures"]],
    }
    return {**found, **with_value, "papers": [*papers, "all"], "shells": list(SHELLS)}


def gather():
    """The text of names.txt as the library has it. Starts jax."""
    from jaxtank import presets
    from jaxtank.core.clock import CLOCK
    from jaxtank.core.tree import walk
    from jaxtank.measures import MEASURES

    names = {f"clock.{k}" for k in CLOCK}
    for case in presets.names():
        for kind in ("leaf", "static"):
            names |= {
                n
                for n, v, _ in walk(presets.find(case).loop, kind=kind)
                if not isinstance(v, tuple)
            }
    lines = [f"cases {c}" for c in presets.names()] + [f"parameters {n}" for n in sorted(names)]
    return "\n".join([*lines, *(f"measures {m}" for m in MEASURES)]) + "\n"


def refresh():
    """Write names.txt anew."""
    NAMES.write_text(gather(), encoding="utf-8")


def bash(commands, words):
    """A function that bash calls with the words of the line, and its registration."""
    lines = [
        '# jaxtank completion for bash: eval "$(jaxtank completion bash)", or a file in'
        " ~/.local/share/bash-completion/completions/jaxtank"
    ]
    lines += [f"_jaxtank_{kind}='{' '.join(own)}'" for kind, own in words.items()]
    lines += BASH_HEAD.splitlines()
    for name, command in commands.items():
        if not name:
            continue
        lines.append(f"    {name})")
        lines.append('        case "$prev" in')
        for option in command.options:
            if option.value:
                lines.append(
                    f"        {'|'.join(option.flags)}) {_bash_value(option.value)}; return ;;"
                )
        lines += ["        =) return ;;", "        esac"]
        flags = " ".join(f for o in command.options for f in o.flags)
        lines.append(
            f'        if [[ $cur == -* ]]; then _jaxtank_words "{flags}"; else'
            f" {_bash_value(command.argument or 'text')}; fi ;;"
        )
    starts = " ".join(
        [*(n for n in commands if n), *(f for o in commands[""].options for f in o.flags)]
    )
    lines += [
        f"    '') _jaxtank_words '{starts}' ;;",
        "    esac",
        "}",
        "complete -F _jaxtank jaxtank",
    ]
    return "\n".join(lines) + "\n"


def _bash_value(kind):
    if kind in ("parameters", "limits"):
        return f'_jaxtank_words "$_jaxtank_{kind}"; compopt -o nospace 2>/dev/null'
    if kind == "cases":
        return '_jaxtank_words "$_jaxtank_cases"; _jaxtank_files'
    if kind in ("papers", "measures", "shells"):
        return f'_jaxtank_words "$_jaxtank_{kind}"'
    if kind in ("folders", "files"):
        return (
            f'COMPREPLY=( $(compgen -{"d" if kind == "folders" else "f"} -- "$cur") ); compopt -o'
            " filenames 2>/dev/null"
        )
    return ":" if kind == "text" else f"_jaxtank_words '{kind}'"


BASH_HEAD = """_jaxtank_words() { COMPREPLY+=( $(compgen -W "$1" -- "$cur") ); }
_jaxtank_files() {
    COMPREPLY+=( $(compgen -f -X '!*.toml' -- "$cur") )
    [[ -n $cur ]] && COMPREPLY+=( $(compgen -d -S / -- "$cur") )
    [[ ${COMPREPLY[0]} == */ && ${#COMPREPLY[@]} == 1 ]] && compopt -o nospace 2>/dev/null
    return 0
}
_jaxtank() {
    local cur="${COMP_WORDS[COMP_CWORD]}" prev="${COMP_WORDS[COMP_CWORD-1]}" command='' i
    COMPREPLY=()
    for (( i = 1; i < COMP_CWORD; i++ )); do
        if [[ ${COMP_WORDS[i]} != -* ]]; then command="${COMP_WORDS[i]}"; break; fi
    done
    case "$command" in"""


def zsh(commands, words):
    """A function for zsh's own completion system, and its registration."""
    lines = [
        "#compdef jaxtank",
        (
            '# jaxtank completion for zsh: eval "$(jaxtank completion zsh)" after compinit, or a'
            " file _jaxtank in $fpath"
        ),
    ]
    lines += [f"_jaxtank_{kind}=({' '.join(own)})" for kind, own in words.items()]
    lines += ZSH_HEAD.splitlines()
    for name, command in commands.items():
        if not name:
            continue
        lines += [f"    {name})", '        case "$prev" in']
        for option in command.options:
            if option.value:
                lines.append(
                    f"        {'|'.join(option.flags)}) {_zsh_value(option.value)}; return ;;"
                )
        flags = " ".join(f for o in command.options for f in o.flags)
        lines += [
            "        esac",
            (
                f"        if [[ $cur == -* ]]; then compadd -- {flags}; else"
                f" {_zsh_value(command.argument or 'text')}; fi ;;"
            ),
        ]
    starts = " ".join(
        [*(n for n in commands if n), *(f for o in commands[""].options for f in o.flags)]
    )
    lines += [f"    '') compadd -- {starts} ;;", "    esac", "}", ZSH_TAIL]
    return "\n".join(lines) + "\n"


def _zsh_value(kind):
    if kind in ("parameters", "limits"):
        return f"compadd -S '' -- $_jaxtank_{kind}"
    if kind == "cases":
        return "compadd -- $_jaxtank_cases; _files -g '*.toml'"
    if kind in ("papers", "measures", "shells"):
        return f"compadd -- $_jaxtank_{kind}"
    if kind in ("folders", "files"):
        return "_files -/" if kind == "folders" else "_files"
    return ":" if kind == "text" else f"compadd -- {kind}"


ZSH_TAIL = (
    'if [[ "${funcstack[1]}" == _jaxtank ]]; then _jaxtank "$@"; else compdef _jaxtank jaxtank; fi'
)

ZSH_HEAD = """_jaxtank() {
    local cur="${words[CURRENT]}" prev="${words[CURRENT-1]}" command='' word
    for word in "${(@)words[2,CURRENT-1]}"; do
        if [[ $word != -* ]]; then command="$word"; break; fi
    done
    case "$command" in"""


def fish(commands, words):
    """Lines `complete -c jaxtank ...`, one per command and option."""
    lines = [
        (
            "# jaxtank completion for fish: jaxtank completion fish >"
            " ~/.config/fish/completions/jaxtank.fish"
        ),
        "complete -c jaxtank -f",
    ]
    quote = lambda text: "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"
    for name, command in commands.items():
        here = f"'__fish_seen_subcommand_from {name}'" if name else "'__fish_use_subcommand'"
        if name:
            lines.append(
                f"complete -c jaxtank -n '__fish_use_subcommand' -a {name} -d {quote(command.help)}"
            )
            values = _fish_value(command.argument, words)
            lines += [f"complete -c jaxtank -n {here} {values}"] if values else []
        for option in command.options:
            spelled = " ".join(
                f"-l {f[2:]}" if f.startswith("--") else f"-s {f[1:]}" for f in option.flags
            )
            value = f"-r {_fish_value(option.value, words)}".rstrip() if option.value else ""
            lines.append(
                " ".join(
                    filter(
                        None,
                        [
                            f"complete -c jaxtank -n {here} {spelled}",
                            value,
                            f"-d {quote(option.help)}",
                        ],
                    )
                )
            )
    return "\n".join(lines) + "\n"


def _fish_value(kind, words):
    if kind in ("", "text"):
        return ""
    if kind in ("folders", "files"):
        return "-a '(__fish_complete_directories)'" if kind == "folders" else "-F"
    if kind == "cases":
        return f"-a '{' '.join(words['cases'])} (__fish_complete_suffix .toml)'"
    return f"-a '{' '.join(words.get(kind) or [kind])}'"

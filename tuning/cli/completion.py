"""Shell completion, generated from the parser: `jaxtank completion bash|zsh|fish` prints a script.

The words that only a started jax knows
(cases, parameters, measures) are in names.txt beside this file: `refresh()` writes it anew, and a
test compares it with the library.
"""

import argparse
from collections.abc import Callable
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
    "HTML": "files",
    "CASE": "cases",
    "PAPER": "papers",
    "PAPER/N": "figures",
    "SHELL": "shells",
}
# options whose values are a few words
FEW = {
    ("tune", "--method"): ("auto", "trf", "coarse-trf", "slsqp", "lbfgs", "adam"),
    ("tune", "--mend"): ("setpoints", "rims", "orifices", "pumps", "ramps"),
    ("tune", "--robust"): ("mean", "cvar", "worst"),
    ("sensitivity", "--method"): ("local", "morris", "sobol"),
    ("uncertainty", "--draws"): ("random", "latin", "sobol"),
    ("attack", "--pumps"): ("own", "full", "random"),
    ("attack", "--start"): ("any", "own"),
    ("identify", "--loss"): ("linear", "soft_l1", "huber"),
    ("identify", "--start"): ("free", "measured", "case"),
    ("export", "--lang"): ("c", "m"),
    ("export", "--precision"): ("double", "float"),
}


class Option(NamedTuple):
    """An option of a command: spellings, kind of value ("" for a flag, "text" for any), help."""

    flags: tuple
    value: str
    help: str


class Command(NamedTuple):
    """A command: a line of help, its options, kind of its arguments ("" for none)."""

    help: str
    options: list
    argument: str


def script(shell, parser):
    """Return the completion script of a shell."""
    if shell not in SHELLS:
        raise unknown("shell", shell, SHELLS)
    commands = commands_of(parser)
    if shell == "fish":
        return fish(commands, words())
    return _function({"bash": BASH, "zsh": ZSH}[shell], commands, words())


def commands_of(parser):
    """Return {name: Command} of a parser, the options before any command under ""."""
    sub = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    lines = {a.dest: a.help or "" for a in sub._choices_actions}
    found = {"": Command("", _options("", parser), "commands")}
    for name, own in sub.choices.items():
        places = [KINDS.get(a.metavar, "text") for a in own._actions if not a.option_strings]
        found[name] = Command(lines.get(name, ""), _options(name, own), places[0] if places else "")
    return found


def _options(command, parser):
    """The Options of a command."""
    return [
        Option(tuple(a.option_strings), _kind(command, a), (a.help or "").replace("%%", "%"))
        for a in parser._actions
        if a.option_strings
    ]


def _kind(command, action):
    """What the value of an option is: a kind of `words`, a path, or the words that it can be."""
    if action.nargs == 0:
        return ""
    for spelling in action.option_strings:
        if (command, spelling) in FEW:
            return " ".join(FEW[command, spelling])
    if "--measure" in action.option_strings and command != "identify":
        return "measures"
    return KINDS.get(action.metavar, "text")


def words():
    """Return the words of each kind: cases, papers, figures, parameters, limits and others."""
    found = {"cases": [], "parameters": [], "measures": [], "figures": []}
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
    """Return the text of names.txt as the library has it. Starts jax."""
    from jaxtank import presets
    from jaxtank.core.clock import CLOCK
    from jaxtank.core.tree import walk
    from jaxtank.measures import MEASURES, functions
    from tuning.figures.figure import FIGURES

    names = {f"clock.{k}" for k in CLOCK}
    for case in presets.names():
        for kind in ("leaf", "static"):
            names |= {
                n
                for n, v, _ in walk(presets.find(case).loop, kind=kind)
                if not isinstance(v, tuple)
            }
    lines = [f"cases {c}" for c in presets.names()] + [f"parameters {n}" for n in sorted(names)]
    known = [m for m in MEASURES if m not in functions(MEASURES)]  # without a user's own functions
    lines += [f"measures {m}" for m in known]
    return "\n".join([*lines, *(f"figures {n}" for n, f in FIGURES.items() if f.runs)]) + "\n"


def refresh():
    """Write names.txt anew."""
    NAMES.write_text(gather(), encoding="utf-8")


class Dialect(NamedTuple):
    """How a shell with a `case` statement writes a completion function."""

    head: str  # before the lists of words
    array: str  # a list of words, of a kind
    start: str  # of the function, up to the commands
    extra: tuple  # lines of every command
    complete: str  # the given words
    value: Callable  # code that completes a kind of value
    end: str


def _function(shell, commands, words):
    """A completion function of a Dialect, and its registration."""
    lines = [shell.head, *(shell.array.format(kind, " ".join(own)) for kind, own in words.items())]
    lines.append(shell.start)
    for name, command in commands.items():
        if not name:
            continue
        lines += [f"    {name})", '        case "$prev" in']
        for option in command.options:
            if option.value:
                code = shell.value(option.value)
                lines.append(f"        {'|'.join(option.flags)}) {code}; return ;;")
        flags = shell.complete.format(" ".join(f for o in command.options for f in o.flags))
        argument = shell.value(command.argument or "text")
        lines += [
            *shell.extra,
            "        esac",
            f"        if [[ $cur == -* ]]; then {flags}; else {argument}; fi ;;",
        ]
    first = [*filter(None, commands), *(f for o in commands[""].options for f in o.flags)]
    lines += [f"    '') {shell.complete.format(' '.join(first))} ;;", "    esac", "}", shell.end]
    return "\n".join(lines) + "\n"


def _bash_value(kind):
    if kind in ("parameters", "limits"):
        return f'_jaxtank_words "$_jaxtank_{kind}"; compopt -o nospace 2>/dev/null'
    if kind == "cases":
        return '_jaxtank_words "$_jaxtank_cases"; _jaxtank_files'
    if kind in ("papers", "figures", "measures", "shells"):
        return f'_jaxtank_words "$_jaxtank_{kind}"'
    if kind in ("folders", "files"):
        flag = "-d" if kind == "folders" else "-f"
        found = f'COMPREPLY=( $(compgen {flag} -- "$cur") )'
        return f"{found}; compopt -o filenames 2>/dev/null"
    return ":" if kind == "text" else f'_jaxtank_words "{kind}"'


def _zsh_value(kind):
    if kind in ("parameters", "limits"):
        return f"compadd -S '' -- $_jaxtank_{kind}"
    if kind == "cases":
        return "compadd -- $_jaxtank_cases; _files -g '*.toml'"
    if kind in ("papers", "figures", "measures", "shells"):
        return f"compadd -- $_jaxtank_{kind}"
    if kind in ("folders", "files"):
        return "_files -/" if kind == "folders" else "_files"
    return ":" if kind == "text" else f"compadd -- {kind}"


BASH = Dialect(
    head="""# jaxtank completion for bash: eval "$(jaxtank completion bash)", or a file in\
 ~/.local/share/bash-completion/completions/jaxtank""",
    array="_jaxtank_{}='{}'",
    start="""_jaxtank_words() { COMPREPLY+=( $(compgen -W "$1" -- "$cur") ); }
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
    case "$command" in""",
    extra=("        =) return ;;",),
    complete='_jaxtank_words "{}"',
    value=_bash_value,
    end="complete -F _jaxtank jaxtank",
)
ZSH = Dialect(
    head="""#compdef jaxtank
# jaxtank completion for zsh: eval "$(jaxtank completion zsh)" after compinit, or a file _jaxtank\
 in $fpath""",
    array="_jaxtank_{}=({})",
    start="""_jaxtank() {
    local cur="${words[CURRENT]}" prev="${words[CURRENT-1]}" command='' word
    for word in "${(@)words[2,CURRENT-1]}"; do
        if [[ $word != -* ]]; then command="$word"; break; fi
    done
    case "$command" in""",
    extra=(),
    complete="compadd -- {}",
    value=_zsh_value,
    end=(
        'if [[ "${funcstack[1]}" == _jaxtank ]]; then _jaxtank "$@"; else compdef _jaxtank'
        " jaxtank; fi"
    ),
)


def fish(commands, words):
    """Return lines `complete -c jaxtank ...`, one per command and option."""
    lines = [
        "# jaxtank completion for fish: jaxtank completion fish >"
        " ~/.config/fish/completions/jaxtank.fish",
        "complete -c jaxtank -f",
    ]
    for name, command in commands.items():
        start = "complete -c jaxtank -n"
        here = f"{start} '__fish_seen_subcommand_from {name}'"
        if name:
            line = f"{start} '__fish_use_subcommand' -a {name} -d {_fish_quoted(command.help)}"
            values = _fish_value(command.argument, words)
            lines += [line, *([f"{here} {values}"] if values else [])]
        else:
            here = f"{start} '__fish_use_subcommand'"
        for option in command.options:
            flags = [f"-l {f[2:]}" if f.startswith("--") else f"-s {f[1:]}" for f in option.flags]
            value = f"-r {_fish_value(option.value, words)}".rstrip() if option.value else ""
            parts = [here, *flags, value, "-d", _fish_quoted(option.help)]
            lines.append(" ".join(filter(None, parts)))
    return "\n".join(lines) + "\n"


def _fish_quoted(text):
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


def _fish_value(kind, words):
    if kind in ("", "text"):
        return ""
    if kind in ("folders", "files"):
        return "-a '(__fish_complete_directories)'" if kind == "folders" else "-F"
    if kind == "cases":
        return f"-a '{' '.join(words['cases'])} (__fish_complete_suffix .toml)'"
    return f"-a '{' '.join(words.get(kind) or [kind])}'"

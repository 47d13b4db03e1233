"""Shell completion: `jaxtank completion bash|zsh|fish` prints a script; names.txt has the words."""

import glob
import os
import sys
from pathlib import Path

from jaxtank.core.errors import InputError, nearest

NAMES = Path(__file__).with_name("names.txt")
SCRIPTS = {
    "bash": """\
# jaxtank completion for bash: eval "$(jaxtank completion bash)", or a file in\
 ~/.local/share/bash-completion/completions/jaxtank
_jaxtank() {
    local words=("${COMP_WORDS[@]:1:COMP_CWORD}")
    mapfile -t COMPREPLY < <(jaxtank completion words "${words[@]}" 2>/dev/null)
    [[ ${COMPREPLY[0]} == *[=/] ]] && compopt -o nospace 2>/dev/null
    return 0
}
complete -F _jaxtank jaxtank
""",
    "zsh": """\
#compdef jaxtank
# jaxtank completion for zsh: eval "$(jaxtank completion zsh)" after compinit, or a file _jaxtank\
 in $fpath
_jaxtank() {
    local out="$(jaxtank completion words "${(@)words[2,CURRENT]}" 2>/dev/null)"
    [[ -z $out ]] && return
    if [[ $out == *[=/] ]]; then compadd -S '' -- "${(@f)out}"; else compadd -- "${(@f)out}"; fi
}
if [[ "${funcstack[1]}" == _jaxtank ]]; then _jaxtank "$@"; else compdef _jaxtank jaxtank; fi
""",
    "fish": """\
# jaxtank completion for fish: jaxtank completion fish > ~/.config/fish/completions/jaxtank.fish
complete -c jaxtank -f -a '(jaxtank completion words (commandline -opc)[2..] (commandline -ct))'
""",
}
KINDS = {  # kind of the values of an option, by its metavar up to "="
    "DIR": "folders",
    "CSV": "files",
    "HTML": "files",
    "FILE": "files",
    "CASE": "cases",
    "PAPER": "papers",
    "PAPER/N": "figures",
    "SHELL": "shells",
    "LANG": "languages",
    "TYPE": "precisions",
    "MEASURE": "measures",
}


def script(shell):
    if shell not in SCRIPTS:
        close = nearest(shell, SCRIPTS)
        raise InputError(f"unknown shell {shell!r}{close}; must be one of {', '.join(SCRIPTS)}")
    return SCRIPTS[shell]


def candidates(parser, words):
    """Return the completions of the last of the words after "jaxtank"."""
    *before, word = words or [""]
    if "=" in (word, *before[-1:]):  # a value after NAME=, which bash splits off
        return []
    command = next((w for w in before if not w.startswith("-")), None)
    if command not in parser.commands:
        choices = [*parser.commands, *parser.options()]
    else:
        options = parser.options(command)
        action = options.get(before[-1])
        if action is not None and action.nargs != 0:
            choices = _values(action, word)
        elif word.startswith("-"):
            choices = list(options)
        else:
            places = [a for a in parser.commands[command]._actions if not a.option_strings]
            choices = _values(places[0], word) if places else []
    return sorted(w for w in choices if w.startswith(word))


def _values(action, word):
    """Return the words that the value of an option, or an argument, may be."""
    if action.choices:
        return action.choices
    metavar, equals, _ = str(action.metavar or "").partition("=")
    kind = "parameters" if equals and metavar == "NAME" else KINDS.get(metavar)
    if kind is None and "--measure" in action.option_strings:
        kind = "measures"
    if kind in ("folders", "files", "cases"):
        paths = [p + "/" if os.path.isdir(p) else p for p in glob.glob(glob.escape(word) + "*")]
        ends = {"folders": "/", "files": "", "cases": ("/", ".toml")}[kind]
        paths = [p for p in paths if p.endswith(ends)]
        return paths if kind != "cases" else [*paths, *names()["cases"]]
    return [f"{name}{equals}" for name in names().get(kind or "", [])]


def names():
    """Return the words of each kind: cases, papers, figures, parameters, measures and others."""
    words = {"shells": list(SCRIPTS), "languages": ["c", "st", "m", "js", "fmu"]}
    words["precisions"] = ["double", "float"]
    for line in _lines():
        kind, _, word = line.partition("\t")[0].partition(" ")
        words.setdefault(kind, []).append(word)
    return words | {"papers": [*dict.fromkeys(c.split("/")[0] for c in words["cases"]), "all"]}


def _lines():
    return NAMES.read_text(encoding="utf-8").splitlines()


def titles():
    """Return {case: title} of names.txt, and of the papers that were registered since."""
    pairs = (line.removeprefix("cases ").partition("\t") for line in _lines() if "\t" in line)
    cases = {name: title for name, _, title in pairs}
    if presets := sys.modules.get("jaxtank.presets"):  # none is registered where it is not imported
        cases |= {
            f"{p}/{n}": c.title for p in presets.PAPERS for n, c in presets.load(p).cases.items()
        }
    return cases


def gather():
    """Return the text of names.txt as the library has it. Starts jax."""
    from jaxtank import presets
    from jaxtank.core.clock import CLOCK
    from jaxtank.core.tree import walk
    from jaxtank.measures import MEASURES, functions
    from tuning.figures.figure import FIGURES

    loops = [presets.find(case).loop for case in presets.names()]
    leaves = [
        leaf for loop in loops for kind in ("leaf", "static") for leaf in walk(loop, kind=kind)
    ]
    parameters = {name for name, value, _ in leaves if not isinstance(value, tuple)}
    kinds = {
        "cases": [f"{name}\t{presets.find(name).title}" for name in presets.names()],
        "parameters": sorted(parameters | {f"clock.{k}" for k in CLOCK}),
        # without custom functions
        "measures": [m for m in MEASURES if m not in functions(MEASURES)],
        "figures": [name for name, figure in FIGURES.items() if figure.runs],
    }
    return "".join(f"{kind} {word}\n" for kind, words in kinds.items() for word in words)


def refresh():
    NAMES.write_text(gather(), encoding="utf-8")

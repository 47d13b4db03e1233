"""The table of commands, and the parser that is made of it."""

import argparse
import sys
import textwrap

from jaxtank.core.errors import InputError, nearest
from tuning.cli.commands import case, explore, identification, studies, tools, tuning

MODULES = (case, explore, tuning, studies, identification, tools)
COMMANDS = {name: command for m in MODULES for name, command in m.COMMANDS.items()}


class Parser(argparse.ArgumentParser):
    """A parser that collects what is wrong with the values, one sentence for each."""

    problems: list[str] = []  # of all parsers

    def error(self, message):
        raise InputError("; ".join([*self.problems, message]))

    def _get_value(self, action, arg_string):
        """Return the value of an option; argparse would reword the error of its type."""
        if not callable(action.type):
            return arg_string
        try:
            return action.type(arg_string)
        except InputError as error:
            self.problems.append(str(error))
        except ValueError as error:
            self.problems.append(f"{name_of(action)} {arg_string!r}: {error}")

    def _check_value(self, action, value):
        """Add to the problems a word that is not among the choices."""
        if action.choices is None or value is None or value in action.choices:
            return
        if isinstance(action, argparse._SubParsersAction):
            self.error(f"unknown command {value!r}{nearest(value, action.choices)}")
        words = ", ".join(map(str, action.choices))
        self.problems.append(f"{name_of(action)} {value!r}: must be one of {words}")

    def _print_message(self, message, file=None):
        """Print help; argparse would ignore an OSError."""
        (sys.stderr if file is None else file).write(message)

    @property
    def commands(self):
        """{name: Parser} of the commands."""
        groups = (a for a in self._actions if isinstance(a, argparse._SubParsersAction))
        return next(groups).choices

    def options(self, command=None):
        """Return {spelling: action} of the options of a command, or of those before any command."""
        parser = self if command is None else self.commands[command]
        return {spelling: a for a in parser._actions for spelling in a.option_strings}


def name_of(action):
    return action.option_strings[0] if action.option_strings else action.metavar


class Once(argparse.Action):
    """Stores the value of an option that may be given once."""

    def __call__(self, parser, namespace, values, option_string=None):
        """Store the value; a second one is a problem."""
        stored = vars(namespace).setdefault("given", set())
        if option_string is not None and self.dest in stored:
            Parser.problems.append(f"{option_string} is given twice: give it once")
        stored.add(self.dest)
        setattr(namespace, self.dest, values)


class Pairs(argparse.Action):
    """Collects (name, value) of an option that may be repeated as {name: value}."""

    def __call__(self, parser, namespace, values, option_string=None):
        """Add a pair; a name that is there is a problem."""
        if not isinstance(values, tuple):  # a problem of its type
            return
        pairs, (name, value) = dict(getattr(namespace, self.dest)), values
        if name in pairs:
            Parser.problems.append(f"{option_string} {name} is given twice: give it once")
        setattr(namespace, self.dest, pairs | {name: value})


EXAMPLES = {  # {command: what may follow it}
    "list": ("", "--all"),
    "show": ("gouta2015/backstepping", "tank.toml --json"),
    "simulate": ("cascaded/pi --set controller.Kc=2", "gouta2015/ngpc --safety-filter --out run"),
    "init": ("cascaded/pi > tank.toml", "gouta2015/ngpc --tanks > rig.toml"),
    "export": ("cascaded/pi --lang c", "tuned/rig.toml --lang js --out controller"),
    "explore": ("cascaded/pi --out page.html", "tuned/rig.toml --open"),
    "tune": (
        "gouta2015/backstepping --out tuned",
        "cascaded/pi --free controller.Kc=0.1:5 --limit max_level=9",
    ),
    "uncertainty": ("cascaded/pi --samples 500", "tuned/rig.toml --promise 0.001 --out plants"),
    "sensitivity": ("cascaded/pi", "cascaded/pi --method sobol --measure max_level"),
    "attack": ("gouta2015/backstepping --safety-filter", "tuned/rig.toml --out worst"),
    "identify": ("rig.toml --data log.csv --out identified", "--inspect log.csv"),
    "learn": ("tuned/rig.toml --data batch.csv --out next", "tuned/rig.toml --data batch.csv"),
    "predict": ("identified/rig.toml --data other.csv", "rig.toml --data log.csv --json"),
    "replay": ("law.js --data log.csv", "law.fmu --data log.csv --json"),
    "compare": ("calofir", "all --markdown"),
    "figure": ("", "gouta2015/6 --out figure.svg"),
    "completion": ("bash > ~/.local/share/bash-completion/completions/jaxtank", "zsh"),
    "cache": ("", "clear"),
    "bench": ("", "cascaded/pi --rounds 3"),
}

GROUPS = {"the case": 1, "uncertain plants": 2, "machines": 3, "output": 4}  # {group: place}

ACTIONS = {"pairs": (Pairs, {}), "list": ("append", []), "flag": ("store_true", False)}
ACTIONS |= {"switch": (argparse.BooleanOptionalAction, None), "once": (Once, None)}


def add(parser, option):
    action, default = ACTIONS[option.kind]
    default = default if option.default is None else option.default
    text = option.help.replace("%", "%%")
    if option.default not in (None, ""):
        text += f" (default {option.default})"
    if option.kind in ("pairs", "list"):
        text += "; repeatable"
    words = {"action": action, "help": text, "default": default}
    if option.kind not in ("flag", "switch"):
        words |= {"metavar": option.metavar, "type": option.type, "choices": option.choices}
    if not option.flag.startswith("-"):
        words |= {"nargs": option.nargs}
    elif option.dest:
        words |= {"dest": option.dest}
    parser.add_argument(option.flag, **words)


def parser():
    """Return the argument parser of every command."""
    top = Parser(
        prog="jaxtank",
        description=(
            "Differentiable liquid-tank rigs, the controllers of five papers, and a tuner that"
            " works through the simulation."
        ),
        epilog="Start with: jaxtank list; jaxtank tune gouta2015/backstepping --out tuned",
    )
    top.add_argument("--version", action="store_true", help="print the version and exit")
    group = top.add_subparsers(dest="command", metavar="COMMAND")
    for name, command in COMMANDS.items():
        places = [_place(o) for o in command.options if not o.flag.startswith("-")]
        words = command.description or f"{command.help[0].upper()}{command.help[1:]}."
        examples = ["examples:", *(f"  jaxtank {name} {e}" for e in EXAMPLES.get(name, ()))]
        more = f"\n\n{_filled(command.epilog)}" if command.epilog else ""
        sub = group.add_parser(
            name,
            help=command.help,
            description=_filled(words),
            usage=" ".join([f"jaxtank {name}", *places, "[options]"]),
            epilog="\n".join(examples) + more,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        groups = {}
        for option in command.options:
            if not option.flag.startswith("-"):
                add(sub, option)
        named = (option for option in command.options if option.flag.startswith("-"))
        for option in sorted(named, key=lambda o: GROUPS.get(o.group, 0)):
            if option.group not in groups:
                groups[option.group] = sub.add_argument_group(option.group)
            add(groups[option.group], option)
        sub.set_defaults(run=command.run)
    return top


def _filled(text):
    """A text in lines of a terminal; one that has lines is a layout."""
    return text if "\n" in text else textwrap.fill(text, 78)


def _place(option):
    """An argument in the line of usage."""
    names = {None: "{}", "?": "[{}]", "*": "[{} ...]", "...": "..."}
    return names[option.nargs].format(option.metavar)


def arguments(argv):
    """Return the Namespace of the words of a command line; InputError with all that is wrong."""
    top = parser()
    Parser.problems = []
    words = sys.argv[1:] if argv is None else argv
    if words[:1] == ["help"]:  # jaxtank help, jaxtank help tune
        argv = [*(word for word in words[1:2] if word in COMMANDS), "--help"]
    args, rest = top.parse_known_args(argv)
    if rest and not rest[0].startswith("-"):
        top.error(f"unknown argument {rest[0]!r}")
    if rest:
        close = nearest(rest[0].split("=")[0], top.options(args.command))
        top.error(f"unknown option {rest[0]!r}{close}")
    if args.command is None and not args.version:
        top.print_help(sys.stdout)
        raise SystemExit(0)
    resume, out = getattr(args, "resume", None), getattr(args, "out", None)
    if resume and out and resume != out:
        Parser.problems.append(
            "--resume and --out name different folders: a run is continued in its own"
        )
    if Parser.problems:
        raise InputError("; ".join(Parser.problems))
    args.out, args.resumed, args.parser = resume or out, resume is not None, top
    return args

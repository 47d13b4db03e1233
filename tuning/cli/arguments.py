"""The argument parser of the command line and the options that several commands share."""

import argparse
import functools
import sys
from typing import NamedTuple

from jaxtank.core.errors import InputError, nearest
from tuning.cli.values import number, whole_number


class Once(argparse.Action):
    """Stores the value of an option; InputError where the option is given a second time."""

    def __call__(self, parser, namespace, values, option_string=None):
        given = vars(namespace).setdefault("given", set())
        if option_string is not None and self.dest in given:
            raise InputError(
                f"{option_string} is given twice, the second time as {values}: give it once"
            )
        given.add(self.dest)
        setattr(namespace, self.dest, values)


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line with the nearest valid word."""

    # An option that is not made to be repeated is refused the second time.

    def __init__(self, **options):
        super().__init__(**options)
        for kind in (None, "store"):
            self.register("action", kind, Once)

    def error(self, message):
        """Raise InputError with the message."""
        if "invalid choice" in message:
            words = [w.strip("'") for w in message.split() if w.startswith("'")]
            choices = [w.strip("(),'") for w in message.split("choose from")[-1].split()]
            message = f"unknown command {words[0]!r}{nearest(words[0], choices)}"
        raise InputError(message)

    def _get_value(self, action, arg_string):
        """Return the value of an option; argparse would reword the error of its type."""
        return action.type(arg_string) if callable(action.type) else arg_string

    def _print_message(self, message, file=None):
        """Print help; argparse would ignore an OSError."""
        (sys.stderr if file is None else file).write(message)

    @property
    def commands(self):
        """{name: Parser} of the commands."""
        groups = (a for a in self._actions if isinstance(a, argparse._SubParsersAction))
        return next(groups).choices

    def options(self, command=None):
        """Return the spellings of all options of a command, or of those before any command."""
        parser = self if command is None else self.commands[command]
        actions = parser._actions
        return [spelling for a in actions for spelling in a.option_strings]


def option(parser, flag, metavar, text, default=None, read=None):
    """Add an option with a value: text, or what read(flag, text) makes of it."""
    kind = None if read is None else functools.partial(read, flag)
    parser.add_argument(flag, default=default, metavar=metavar, help=text, type=kind)


def whole(low, high):
    """Return what reads a whole number from `low` to `high`."""
    return functools.partial(whole_number, low=low, high=high)


def repeatable(parser, flag, metavar, text, dest=None):
    """Add an option that may be given several times; its values are a list of texts."""
    more = {} if dest is None else {"dest": dest}
    parser.add_argument(
        flag, action="append", default=[], metavar=metavar, help=f"{text}; repeatable", **more
    )


class Shared(NamedTuple):
    """Parent parsers: `common` of every command, `case` of one case, `run` of a run or a study."""

    common: Parser
    case: Parser
    run: Parser


def shared():
    """Return the parent parsers that most commands have."""
    common = Parser(add_help=False)
    common.add_argument(
        "--json", action="store_true", help="one JSON object on stdout instead of tables"
    )
    common.add_argument("--quiet", action="store_true", help="no progress on stderr")
    case = Parser(add_help=False, parents=[changes()])
    case.add_argument(
        "case", metavar="CASE", help='"paper/case" (see jaxtank list) or a rig file ending in .toml'
    )
    run = Parser(add_help=False)
    text = "seed of what is drawn: noise, plants, search points (default 0)"
    option(run, "--seed", "N", text, 0, whole(0, 2**31 - 1))
    option(
        run,
        "--out",
        "DIR",
        "folder for result.json, report.html, CSV, pictures and the rig (attack: worst.toml)",
    )
    return Shared(common, case, run)


def changes():
    """Return the parent parser of the options that change a case."""
    found = Parser(add_help=False)
    text = "set a parameter by its dotted name"
    repeatable(found, "--set", "NAME=VALUE", text, "values")
    repeatable(
        found,
        "--schedule",
        "NAME=VARIABLE:K1,K2,...",
        "a gain that follows a setpoint (r1, ..) or a level (h1, ..), linear between knots; the"
        " same variable and knots for all gains",
    )
    option(found, "--dt", "S", "sampling period [s], short for --set clock.dt=S", None, number)
    found.add_argument(
        "--safety-filter",
        action=argparse.BooleanOptionalAction,
        help="caps on the pumps under which no level passes its limit on any plant that the case"
        " calls uncertain (see jaxtank show); tune: automatic where a level comes near its limit;"
        " --no-safety-filter: none",
    )
    return found


def uncertain():
    """Return the parent parser of the options on what varies and by how much."""
    found = Parser(add_help=False)
    option(
        found,
        "--spread",
        "FRACTION",
        "one relative half-width for all parameters that the case calls uncertain, as 0.1 for"
        " +-10 %% (tune: not with --nominal)",
    )
    repeatable(
        found,
        "--vary",
        "NAME=DISTRIBUTION",
        "an uncertain parameter, in place of those of the case, as plant.drain=uniform:5%% or"
        " normal:MEAN:SD (tune: not with --nominal)",
    )
    return found


def on_cluster():
    """Return the parent parser of --cluster."""
    found = Parser(add_help=False)
    option(
        found,
        "--cluster",
        "ADDRESS",
        "run on a Dask cluster: HOST:PORT of its scheduler, or local:N for N workers on this"
        ' machine (pip install ".[cluster]")',
    )
    return found


def on_devices():
    """Return the parent parser of --devices and --cluster."""
    found = Parser(add_help=False, parents=[on_cluster()])
    option(found, "--devices", "N", "devices of this machine to use (default 1)", 1, whole(1, 1024))
    return found

"""The argument parser of the command `jaxtank`: what may be said, apart from what is done. Nothing
heavy is imported.
"""

import argparse
import sys

from jaxtank.core.errors import InputError, nearest
from tuning.cli.commands import identification


class Once(argparse.Action):
    """Keeps the value of an option that may be given once: of two neither can be known to be meant."""

    def __call__(self, parser, namespace, values, option_string=None):
        given = vars(namespace).setdefault("given", set())
        if option_string is not None and self.dest in given:
            raise InputError(
                f"{option_string} is given twice, the second time as {values!r}: give it once"
            )
        given.add(self.dest)
        setattr(namespace, self.dest, values)


class Parser(argparse.ArgumentParser):
    """Errors in one line, with the nearest valid word; an option that is not made to be repeated is
    refused the second time.
    """

    def __init__(self, **options):
        super().__init__(**options)
        for kind in (None, "store"):
            self.register("action", kind, Once)

    def error(self, message):
        words = (
            [w.strip("'") for w in message.split() if w.startswith("'")]
            if "invalid choice" in message
            else []
        )
        if words:
            choices = [w.strip("(),'") for w in message.split("choose from")[-1].split()]
            message = f"unknown command {words[0]!r}{nearest(words[0], choices)}"
        raise InputError(message)

    def _print_message(self, message, file=None):
        """Help that cannot be written is an OSError; argparse passes over it."""
        (sys.stderr if file is None else file).write(message)

    def options(self, command):
        """The options of one command."""
        for action in self._actions:
            if isinstance(action, argparse._SubParsersAction) and command in action.choices:
                return [o for a in action.choices[command]._actions for o in a.option_strings]
        return [o for a in self._actions for o in a.option_strings]


def parser():
    """The argument parser of every command."""
    top = Parser(
        prog="jaxtank",
        description=(
            "Differentiable liquid-tank rigs, the controllers of five papers, and a tuner that"
            " works through the simulation."
        ),
        epilog="Start with: jaxtank list; jaxtank tune gouta2015/backstepping --out tuned",
    )
    top.add_argument("--version", action="store_true", help="print the version and exit")
    commands = top.add_subparsers(dest="command", metavar="COMMAND")

    common = Parser(add_help=False)
    common.add_argument(
        "--json", action="store_true", help="one JSON object on stdout instead of tables"
    )
    common.add_argument("--quiet", action="store_true", help="no progress on stderr")

    case = Parser(add_help=False)
    case.add_argument(
        "case", metavar="CASE", help='"paper/case" (see jaxtank list) or a rig file ending in .toml'
    )
    case.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        dest="values",
        help="set a parameter by its dotted name; repeatable",
    )
    case.add_argument(
        "--schedule",
        action="append",
        default=[],
        metavar="NAME=VARIABLE:K1,K2,...",
        help=(
            "a gain that follows a setpoint (r1, ..) or a level (h1, ..), linear between knots;"
            " repeatable, same variable and knots"
        ),
    )
    case.add_argument(
        "--dt", type=str, metavar="S", help="sampling period [s], short for --set clock.dt=S"
    )

    run = Parser(add_help=False)
    run.add_argument(
        "--seed",
        default="0",
        metavar="N",
        help="seed of the sensor noise and of the search (default 0)",
    )
    run.add_argument(
        "--out", metavar="DIR", help="folder for result.json, CSV, pictures and the rig"
    )

    commands.add_parser("list", parents=[common], help="print every case")
    show = commands.add_parser(
        "show",
        parents=[common, case],
        help="one case: rig, law, every parameter, published numbers, departures",
    )
    show.add_argument(
        "--out",
        metavar="DIR",
        help="folder for rig.png and rig.svg, the rig drawn from its topology",
    )
    simulate = commands.add_parser(
        "simulate",
        parents=[common, case, run],
        help="one run: measures; with --out its trajectory and pictures",
    )
    simulate.add_argument(
        "--gif",
        action="store_true",
        help="with --out also run.gif, the tanks of the rig filling and emptying",
    )
    tune = commands.add_parser(
        "tune", parents=[common, case, run], help="tune the gains of a case under its limits"
    )
    tune.add_argument(
        "--method",
        default="auto",
        metavar="NAME",
        help="auto (default), trf, coarse-trf, slsqp, lbfgs or adam",
    )
    tune.add_argument(
        "--free",
        action="append",
        default=[],
        metavar="NAME=LOW:HIGH",
        help="a parameter to tune; replaces the case's own; repeatable",
    )
    tune.add_argument(
        "--limit",
        action="append",
        default=[],
        metavar="MEASURE=VALUE",
        help="a hard limit; MEASURE=none drops one, none drops all; repeatable",
    )
    tune.add_argument(
        "--objective",
        action="append",
        default=[],
        metavar="MEASURE=WEIGHT",
        help="what is made small (default rms_error_total=1); repeatable",
    )
    tune.add_argument(
        "--scenario",
        action="append",
        default=[],
        metavar="NAME=VALUE[;NAME=VALUE]",
        help=(
            'a run to judge by, as "sensor.noise=0.05;plant.pump_gain=x0.8" (x0.8: 0.8 times the'
            " case's own); replaces those of the case; none: its own run; repeatable"
        ),
    )
    tune.add_argument(
        "--choose",
        action="append",
        default=[],
        metavar="NAME=V1,V2",
        help="a static number or text to try the values of; repeatable",
    )
    tune.add_argument(
        "--validation",
        default="64",
        metavar="N",
        help="held-out runs to judge the answer on (default 64, 0 for none)",
    )
    tune.add_argument(
        "--tradeoff",
        metavar="MEASURE=LOW:HIGH[:N]",
        help="also: the best objective for N (6) values of one limit",
    )
    tune.add_argument(
        "--bound",
        action="store_true",
        help="also: what no law could beat, by optimising the input itself",
    )
    tune.add_argument(
        "--batch", metavar="N", help="scenarios drawn for each step of method adam (default all)"
    )
    tune.add_argument(
        "--resume",
        metavar="DIR",
        help="go on where a killed run with --out DIR ended, to the same answer",
    )
    tune.add_argument("--starts", default="8", metavar="N", help="local searches (default 8)")
    tune.add_argument(
        "--screening", default="64", metavar="N", help="Sobol points before them (default 64)"
    )
    tune.add_argument(
        "--iterations",
        default="60",
        metavar="N",
        help="iterations of each local search (default 60)",
    )
    tune.add_argument(
        "--robust",
        metavar="RISK",
        help="on many plants at once: mean, cvar or worst of their costs, limits held on every one",
    )
    tune.add_argument("--samples", metavar="N", help="plants of --robust (default 64)")
    tune.add_argument(
        "--fresh", metavar="N", help="plants that its answer is run on afterwards (default 1024)"
    )
    tune.add_argument(
        "--back-off",
        metavar="SHARE",
        help=(
            "share of each limit that --robust keeps off it, as 0.03; fresh plants are judged"
            " without"
        ),
    )
    uncertain = commands.add_parser(
        "uncertainty",
        parents=[common, case, run],
        help="the same loop over N draws: bands, percentiles, violations",
    )
    uncertain.add_argument("--samples", default="1000", metavar="N", help="draws (default 1000)")
    for command in (tune, uncertain):
        command.add_argument(
            "--spread",
            metavar="FRACTION",
            help="one spread for all that the case calls uncertain, as 0.1 for +-10 %%",
        )
        command.add_argument(
            "--vary",
            action="append",
            default=[],
            metavar="NAME=DIST",
            help="what varies instead: uniform:5%%, normal:MEAN:SD, ...; repeatable",
        )
    uncertain.add_argument(
        "--draws", default="random", metavar="KIND", help="random (default), latin or sobol"
    )
    uncertain.add_argument(
        "--limit",
        action="append",
        default=[],
        metavar="MEASURE=VALUE",
        help="a limit to count violations of; repeatable",
    )
    uncertain.add_argument(
        "--measure",
        action="append",
        default=[],
        metavar="NAME",
        help="a measure to keep, not the usual ones; repeatable",
    )
    uncertain.add_argument(
        "--devices", default="1", metavar="N", help="devices of this machine to use (default 1)"
    )
    uncertain.add_argument(
        "--shard", metavar="I/N", help="run the I-th of N shares into --out DIR; merge joins them"
    )
    uncertain.add_argument(
        "--resume", metavar="DIR", help="go on where a killed run with --out DIR ended"
    )
    merge = commands.add_parser(
        "merge", parents=[common, run], help="join the shards of an ensemble in a folder"
    )
    merge.add_argument(
        "case",
        metavar="DIR",
        help="where the shards are; or their case, with their options and --out DIR",
    )
    for action in uncertain._actions:
        if action.dest in (
            "values",
            "schedule",
            "dt",
            "samples",
            "spread",
            "vary",
            "draws",
            "limit",
            "measure",
        ):
            merge._add_action(action)
    sense = commands.add_parser(
        "sensitivity",
        parents=[common, case, run],
        help="which parameter moves which measure: local, Morris, Sobol",
    )
    sense.add_argument(
        "--method",
        default="local",
        metavar="NAME",
        help="local (default: exact derivatives), morris or sobol",
    )
    sense.add_argument(
        "--samples",
        metavar="N",
        help=(
            "trajectories of morris (default 32), base points of sobol (default 512, a power of 2)"
        ),
    )
    sense.add_argument(
        "--devices", default="1", metavar="N", help="devices of this machine to use (default 1)"
    )
    sense.add_argument(
        "--spread",
        metavar="FRACTION",
        help="one share for all that the case calls uncertain, as 0.05",
    )
    sense.add_argument(
        "--vary",
        action="append",
        default=[],
        metavar="NAME=DISTRIBUTION",
        help="what varies instead, as plant.drain=uniform:5%% or normal:MEAN:SD; repeatable",
    )
    sense.add_argument(
        "--measure",
        action="append",
        default=[],
        metavar="NAME",
        help=(
            "a measure to look at (default: those of the objective, rms_error_total, max_level);"
            " repeatable"
        ),
    )
    identification.add(commands, [common, case, run])
    init = commands.add_parser(
        "init",
        parents=[common, case],
        help="print a complete rig file to edit: every key, its unit and range",
    )
    init.add_argument(
        "--short", action="store_true", help="only what differs from the preset, and what is tuned"
    )
    init.add_argument(
        "--tanks", action="store_true", help="described tank by tank, without its preset"
    )
    exported = commands.add_parser(
        "export",
        parents=[common, case],
        help="the law and its observer as one C99 file or MATLAB function",
    )
    exported.add_argument("--lang", default="c", metavar="LANG", help="c (default) or m")
    exported.add_argument(
        "--precision", default="double", metavar="TYPE", help="double (default) or float, of C"
    )
    exported.add_argument("--name", metavar="NAME", help="of the functions (default: the case's)")
    exported.add_argument("--out", metavar="DIR", help="folder for the file (default: print it)")
    compare = commands.add_parser(
        "compare",
        parents=[common],
        help="published numbers beside measured ones, and why they differ; PAPER or all",
    )
    compare.add_argument("paper", metavar="PAPER", help='a paper (see jaxtank list), or "all"')
    compare.add_argument(
        "--out", metavar="DIR", help="folder for report.html, result.json and the rigs as pictures"
    )
    compare.add_argument("--markdown", action="store_true", help="as a Markdown table")
    completed = commands.add_parser(
        "completion",
        help="a script that completes commands, options, cases and parameters: bash, zsh or fish",
    )
    completed.add_argument(
        "shell", metavar="SHELL", help='as in: eval "$(jaxtank completion bash)"'
    )
    bench = commands.add_parser(
        "bench", parents=[common], help="ns per closed-loop step here, beside a C loop"
    )
    bench.add_argument("cases", nargs="*", metavar="CASE", help='cases to time instead, or "all"')
    bench.add_argument(
        "--rounds",
        default="7",
        metavar="N",
        help="interleaved rounds to take the median of (default 7)",
    )
    return top

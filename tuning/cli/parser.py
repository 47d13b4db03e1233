"""The parser of the command `jaxtank`: each module of commands adds its own."""

from tuning.cli.arguments import Parser, shared
from tuning.cli.commands import case, explore, falsification, identification, studies, tools, tuning


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
    commands, parents = top.add_subparsers(dest="command", metavar="COMMAND"), shared()
    for module in (case, explore, tuning, studies, falsification, identification, tools):
        module.add(commands, parents)
    for one in commands._choices_actions:  # what the list of commands says, where nothing else is
        own, text = commands.choices[one.dest], one.help or one.dest
        own.description = own.description or f"{text[0].upper()}{text[1:]}."
    return top

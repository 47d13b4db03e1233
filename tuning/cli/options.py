"""Options that several commands share."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from tuning.cli import values


class Option(NamedTuple):
    """An option or argument of a command."""

    flag: str  # without "-": an argument
    metavar: str | None = None
    help: str = ""
    type: Callable | None = None
    default: Any = None
    choices: Sequence | None = None
    kind: str = "once"  # or "flag", "switch", "list", "pairs"
    dest: str | None = None
    nargs: Any = None
    group: str = "options of this command"  # its heading in the help


class Command(NamedTuple):
    """A command: `run(args)` returns the exit code."""

    run: Callable
    help: str
    options: Sequence[Option]
    description: str = ""
    epilog: str = ""
    compiles: bool = True


def grouped(group: str, *options: Option) -> tuple[Option, ...]:
    return tuple(option._replace(group=group) for option in options)


SEEDS = values.whole(0, 2**31 - 1)
# fmt: off
COMMON = grouped(
    "output",
    Option("--json", help="one JSON object on stdout instead of tables", kind="flag"),
    Option("--quiet", help="no progress and no notes on stderr", kind="flag"),
)
CASE = grouped(
    "the case",
    Option("--set", "NAME=VALUE", "set a parameter by its dotted name",
           values.pair(values.value_or_matrix), kind="pairs", dest="values"),
    Option("--schedule", "NAME=VARIABLE:K1,K2,...", "a gain that follows a setpoint (r1, ..) or a"
           " level (h1, ..), linear between knots; the same variable and knots for all gains",
           values.pair(values.knots), kind="pairs"),
    Option("--dt", "S", "sampling period [s], short for --set clock.dt=S", values.seconds("--dt")),
    Option("--safety-filter", help="caps on the pumps under which no level passes its limit on any"
           " plant that the case calls uncertain (see jaxtank show); tune: automatic where a level"
           " comes near its limit; --no-safety-filter: none", kind="switch"),
    Option("case", "CASE", '"paper/case" (see jaxtank list) or a rig file ending in .toml'),
)
RUN = grouped(
    "output",
    Option("--seed", "N", "seed of noise, plants and search points", SEEDS, 0),
    Option("--out", "DIR", "folder for result.json, report.html, CSV, pictures and the rig (attack:"
           " worst.toml)", values.folder),
)
UNCERTAIN = grouped(
    "uncertain plants",
    Option("--spread", "FRACTION", "one relative half-width for all parameters that the case calls"
           " uncertain, as 0.1 for +-10 % (tune: not with --nominal)", values.share),
    Option("--vary", "NAME=DISTRIBUTION", "an uncertain parameter; replaces the ones of the case;"
           " plant.drain=uniform:5% or normal:MEAN:SD (tune: not with --nominal)",
           values.pair(str), kind="pairs"),
)
CLUSTER = grouped(
    "machines",
    Option("--cluster", "ADDRESS", "run on a Dask cluster: HOST:PORT of its scheduler, or local:N"
           ' for N workers on this machine (pip install ".[cluster]")'),
)
DEVICES = grouped(
    "machines",
    *CLUSTER,
    Option("--devices", "N", "accelerators; else every processor runs", values.whole(1, 1024), 1),
)
(RESUME,) = grouped(
    "output",
    Option("--resume", "DIR", "go on where a killed run with --out DIR ended, to the same result",
           values.earlier_folder),
)
# fmt: on

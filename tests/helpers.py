"""What several test files use: where files are, ranks of folders, small routines. On pytest's path
(pyproject.toml), so that every test imports it by name.
"""

import dataclasses
from pathlib import Path

ROOT = Path(__file__).parents[1]
TESTS = ROOT / "tests"
DATA = TESTS / "data"
RIGS = DATA / "rigs"
CASCADED_TANKS = DATA / "cascaded_tanks.csv"  # its source and licence: data/README.md

# Folders of both packages: a folder imports those of its own or of an earlier line.
RANKS = [
    "jaxtank.core jaxtank.xla",
    "jaxtank.signals jaxtank.instruments jaxtank.plants",
    "jaxtank.analysis",
    "jaxtank.controllers jaxtank.observers jaxtank.measures",
    "jaxtank.loop",
    "jaxtank.case",
    "jaxtank.presets",
    "jaxtank.rig jaxtank.plots jaxtank.export jaxtank.interop",
    "tuning.problem tuning.storage",
    "tuning.uncertainty tuning.identification tuning.optimal_input",
    "tuning.search",
    "tuning.report",
    "tuning.bench",
    "tuning.cli",
]
RANK = {folder: rank for rank, folders in enumerate(RANKS) for folder in folders.split()}

ONE_FUNCTION = 'xla_cpu_small_call="true"'


def loops_in(compiled):
    """Number of loops that a compiled program runs as one function."""
    return compiled.as_text().count(ONE_FUNCTION)


def in_metres(plant):
    """The same rig of centimetres with lengths in m and flows in m^3/s."""
    powers = {
        "area": 2,
        "drain": 2,
        "orifice": 2,
        "pipe": 2,
        "pump_gain": 3,
        "gravity": 1,
        "rim": 1,
        "knee": 1,
    }
    return dataclasses.replace(
        plant,
        **{name: getattr(plant, name) * 1e-2**power for name, power in powers.items()},
        units=("m", "V"),
    )

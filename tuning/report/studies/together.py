"""Several cases under the same conditions: a table, one picture, a page (`simulate A B C`)."""

import dataclasses
import re
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxtank import measures as ms
from jaxtank.case import Case
from jaxtank.core.errors import InputError
from jaxtank.core.files import check_folder
from jaxtank.loop.trajectory import csv
from tuning.problem import provenance, reported
from tuning.problem.scenarios import noisy
from tuning.problem.wording import count, numbered
from tuning.report import html, tables
from tuning.report.artifacts import run_for_people, write_result

MOST = 6
"""Cases in one picture: as many as have a colour of their own."""

PARTS = {"plant": "plant", "reference": "setpoints", "actuator": "pumps", "x0": "start"}
"""{part of a loop in which cases may differ: what it is called}."""

CAPTIONS = {"responses": "The runs over each other, on the rims and limits of the first case."}


class Run(NamedTuple):
    """One of several runs."""

    case: Case
    measures: dict[str, np.ndarray]
    differs: tuple[str, ...]


def run_together(cases: list[Case], seed: int = 0) -> list[Run]:
    """Return the runs of cases under the disturbances, faults and noise of the first."""
    first = _checked(cases)[0]
    found = []
    for case in cases:
        loop = dataclasses.replace(
            case.loop,
            disturbance=first.loop.disturbance,
            faults=first.loop.faults,
            sensor=first.loop.sensor,
        )
        same = case.replace(loop=loop)
        key = jax.random.key(seed) if noisy(same) else None
        values = dict(reported.run_measures(loop, case.clock, key))
        found.append(Run(same, values, _differences(first, case)))
    return found


def _checked(cases):
    """The cases; InputError where they cannot be drawn over each other."""
    names = [case.name for case in cases]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{name} is given {names.count(name)} times: give each case once")
    if len(cases) > MOST:
        raise InputError(f"{len(cases)} cases: at most {MOST} can be told apart in one picture")
    for case in cases[1:]:
        for mine, own in zip(_sizes(case), _sizes(cases[0])):
            if mine != own:
                raise InputError(
                    f"{case.name} has {mine} and {names[0]} has {own}: cases on one page must have"
                    " the same tanks, outputs, pumps, units and length"
                )
    return cases


def _sizes(case):
    """What must be the same in all cases, in words."""
    plant, (length, drive) = case.loop.plant, case.loop.units
    return [
        count(plant.tanks, "tank"),
        f"control of {numbered('tank', [i + 1 for i in plant.outputs])}",
        count(plant.pumps, "pump"),
        f"levels in {length} and inputs in {drive}",
        f"a run of {case.clock.duration:g} s",
    ]


def _differences(first, case):
    """Words for the parts in which a case differs from the first, besides its controller."""
    words = [
        word
        for part, word in PARTS.items()
        if not _equal(getattr(first.loop, part), getattr(case.loop, part))
    ]
    if first.clock.dt != case.clock.dt:
        words.append(f"sampling period ({case.clock.dt:g} s for {first.clock.dt:g} s)")
    for part, word in (("disturbance", "disturbances"), ("faults", "faults"), ("sensor", "sensor")):
        if not _equal(getattr(first.loop, part), getattr(case.loop, part)):
            words.append(f"{word} (those of {first.name} are used)")
    return tuple(words)


def _equal(one, other):
    """Whether two parts of a loop have the same structure and numbers."""
    if jax.tree.structure(one) != jax.tree.structure(other):
        return False
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other))
    return all(np.shape(a) == np.shape(b) and np.array_equal(a, b) for a, b in pairs)


def lines_of(runs: list[Run]) -> list[Any]:
    """Return the Table of measures, a column for each case, and sentences on what differs."""
    units = runs[0].case.loop.units
    shown = [m for m in ms.MEASURES if all(m in r.measures for r in runs) and m not in ms.times()]
    rows = [
        [m, ms.unit(m, units), *(tables.entries(m, run.measures[m]) for run in runs)] for m in shown
    ]
    found: list[Any] = [tables.table(rows, ["measure", "unit", *(r.case.name for r in runs)])]
    for run in runs:
        found += [f"{run.case.name}: {line}" for line in tables.undefined(run.measures)]
        if run.differs:
            found.append(f"{run.case.name} has its own {', '.join(run.differs)}")
    return found


def json_of(runs: list[Run], seed: int) -> dict[str, Any]:
    """Return {"cases": one object for each, as of a single run, with "differs"}."""
    rows = []
    for run in runs:
        loop = run.case.loop
        rows.append(
            {
                "case": run.case.name,
                "measures": tables.measures_json(run.measures),
                "units": tables.units(loop.units),
                "reasons": tables.reasons(run.measures),
                "clock": dataclasses.asdict(run.case.clock),
                "parameters": tables.clean(reported.lp.parameters(loop)),
                "differs": list(run.differs),
                "provenance": provenance.provenance(run.case, seed),
            }
        )
    return {"cases": rows}


def save(runs: list[Run], folder: str | Path, seed: int, command: str | None = None) -> list[Path]:
    """Write result.json, a CSV file for each case, responses.png and report.html; return the paths.

    Raises InputError for a folder that cannot be written to.
    """
    from jaxtank.plots import responses

    check_folder(folder)
    names = {run.case.name: _file_of(run.case.name) for run in runs}
    keys = [jax.random.key(seed) if noisy(run.case) else None for run in runs]
    drawn = {r.case.name: run_for_people(r.case, key) for r, key in zip(runs, keys)}
    files = {"result.json": tables.dumps(json_of(runs, seed)) + "\n"}
    files |= {names[n]: csv(run, runs[0].case.loop.units) for n, run in drawn.items()}
    title = ", ".join(drawn)
    return write_result(
        folder,
        files,
        lambda: {"responses": responses.responses(runs[0].case.loop, drawn, title)},
        lambda pictures: _page(runs, pictures, command, json_of(runs, seed)["cases"][0]),
    )


def _file_of(name):
    """The CSV file of a case: its name without what a file name cannot hold."""
    return f"{re.sub(r'[^A-Za-z0-9._-]+', '-', name).strip('.-') or 'case'}.csv"


def _page(runs, pictures, command, first):
    """The page of all runs."""
    parts = lines_of(runs)
    return html.document(
        f"{len(runs)} cases",
        ", ".join(run.case.name for run in runs),
        "the disturbances, faults and sensor noise of the first case for all",
        True,
        [
            (run.case.name, f"{_error(run)} {run.case.loop.units[0]} rms error")
            for run in runs
            if "rms_error_total" in run.measures
        ],
        parts[1:],
        html.drawings(pictures, CAPTIONS),
        parts[:1],
        command,
        first["provenance"],
    )


def _error(run):
    return tables.number(float(run.measures["rms_error_total"]), 4)

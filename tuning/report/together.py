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
from tuning.report.document import Report, Text, figures_of
from tuning.report.folder import save as save_all
from tuning.report.simulated import run_for_people
from tuning.report.tables import (
    Table,
    Value,
    clean,
    entries,
    measures_json,
    reasons,
    undefined,
    units,
)

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


def report(runs: list[Run], drawn: Any = None) -> Report:
    """Return the Report of several runs: measures, a column for each case, and what differs."""
    of_rig = runs[0].case.loop.units
    shown = [m for m in ms.MEASURES if all(m in r.measures for r in runs) and m not in ms.times()]
    rows = [[m, ms.unit(m, of_rig), *(entries(m, run.measures[m]) for run in runs)] for m in shown]
    words = []
    for run in runs:
        words += [f"{run.case.name}: {line}" for line in undefined(run.measures)]
        if run.differs:
            words.append(f"{run.case.name} has its own {', '.join(run.differs)}")
    errors = [
        (run.case.name, f"{Value(run.measures['rms_error_total'], 4, of_rig[0])} rms error")
        for run in runs
        if "rms_error_total" in run.measures
    ]
    return Report(
        f"{len(runs)} cases",
        "the disturbances, faults and sensor noise of the first case for all",
        errors,
        [
            Table(rows, ["measure", "unit", *(r.case.name for r in runs)]),
            Text(words, on="terminal"),
            Text(words, items=True, on="page"),
            *figures_of(drawn or {}, CAPTIONS),
        ],
        subtitle=", ".join(run.case.name for run in runs),
    )


def json_of(runs: list[Run], seed: int) -> dict[str, Any]:
    """Return {"cases": one object for each, as of a single run, with "differs"}."""
    rows = []
    for run in runs:
        loop = run.case.loop
        rows.append(
            {
                "case": run.case.name,
                "measures": measures_json(run.measures),
                "units": units(loop.units),
                "reasons": reasons(run.measures),
                "clock": dataclasses.asdict(run.case.clock),
                "parameters": clean(reported.lp.parameters(loop)),
                "differs": list(run.differs),
                "provenance": provenance.provenance(run.case, seed),
            }
        )
    return {"cases": rows}


def save(runs: list[Run], folder: str | Path, seed: int, command: str | None = None) -> list[Path]:
    """Write result.json, a CSV file for each case, responses.png and report.html."""
    from jaxtank.plots import responses

    check_folder(folder)
    keys = [jax.random.key(seed) if noisy(run.case) else None for run in runs]
    drawn = {r.case.name: run_for_people(r.case, key) for r, key in zip(runs, keys)}
    loop, title, payload = runs[0].case.loop, ", ".join(drawn), json_of(runs, seed)
    files = {_file_of(name): csv(run, loop.units) for name, run in drawn.items()}
    draw = lambda: {"responses": responses.responses(loop, drawn, title)}
    page, made = lambda pictures: report(runs, pictures), payload["cases"][0]["provenance"]
    return save_all(folder, payload, files, draw, page, command, provenance=made)


def _file_of(name: str) -> str:
    """The CSV file of a case: its name without what a file name cannot hold."""
    return f"{re.sub(r'[^A-Za-z0-9._-]+', '-', name).strip('.-') or 'case'}.csv"

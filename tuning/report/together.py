"""Several cases under the same conditions: a table, one picture, a page (`simulate A B C`)."""

import dataclasses
import re
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxtank import measures as ms
from jaxtank.bounds import is_tunable
from jaxtank.case import Case
from jaxtank.core.errors import InputError
from jaxtank.core.files import check_folder
from jaxtank.core.labels import numbered, units_of_inputs
from jaxtank.core.text import count
from jaxtank.loop.trajectory import csv
from tuning.problem import provenance, reported
from tuning.problem.controllers import equal
from tuning.problem.scenarios import noisy
from tuning.report import verdict as verdicts
from tuning.report.advice import (
    BETTER,
    GIVEN,
    Advice,
    amount,
    listed,
    nothing_to_set,
    of_nominal_plant,
)
from tuning.report.document import Report, Text
from tuning.report.folder import save as save_all
from tuning.report.simulated import json_of_run, responses_of, run_for_people
from tuning.report.tables import Table, entries, undefined

MOST = 6  # number of cases in one picture: each has a different colour
# {part of a loop: its name}: parts in which cases may differ; parts taken from the first case
PARTS = {"plant": "plant", "reference": "setpoints", "actuator": "pumps", "x0": "start"}
SHARED = {"disturbance": "disturbances", "faults": "faults", "sensor": "sensor"}
CAPTIONS = {"responses": "The runs over each other, on the rims and limits of the first case."}


class Run(NamedTuple):
    """One of several runs."""

    case: Case
    measures: dict[str, np.ndarray]
    differs: tuple[str, ...]


def run_together(cases: list[Case], seed: int = 0) -> list[Run]:
    """Return the runs of cases under the disturbances, faults and noise of the first."""
    _check(cases)
    first, runs = cases[0], []
    for case in cases:
        shared = {part: getattr(first.loop, part) for part in SHARED}
        same = case.replace(loop=dataclasses.replace(case.loop, **shared))
        key = jax.random.key(seed) if noisy(same) else None
        values = dict(reported.run_measures(same.loop, case.clock, key, case.limits))
        runs.append(Run(same, values, _differences(first, case)))
    return runs


def _check(cases):
    """Raise InputError where cases cannot be drawn over each other."""
    names = [case.name for case in cases]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{name} is given {names.count(name)} times: give each case once")
    if len(cases) > MOST:
        raise InputError(f"{len(cases)} cases: at most {MOST} can be told apart in one picture")
    for case in cases[1:]:
        for size, first in zip(_sizes(case), _sizes(cases[0])):
            if size != first:
                raise InputError(
                    f"{case.name} has {size} and {names[0]} has {first}: cases on one page must"
                    " have the same tanks, outputs, pumps, units and length"
                )


def _sizes(case):
    plant, length = case.loop.plant, case.loop.units[0]
    return [
        count(plant.tanks, "tank"),
        f"control of {numbered('tank', [i + 1 for i in plant.outputs])}",
        count(plant.pumps, "pump"),
        f"levels in {length} and inputs in {units_of_inputs(plant)}",
        f"a run of {case.clock.duration:g} s",
    ]


def _differences(first, case):
    """Words for the parts in which a case differs from the first, other than its controller."""
    differ = lambda part: not equal(getattr(first.loop, part), getattr(case.loop, part))
    words = [word for part, word in PARTS.items() if differ(part)]
    if first.clock.dt != case.clock.dt:
        words.append(f"sampling period ({case.clock.dt:g} s for {first.clock.dt:g} s)")
    used = f"(those of {first.name} are used)"
    return (*words, *(f"{word} {used}" for part, word in SHARED.items() if differ(part)))


def report(runs: list[Run]) -> Report:
    units, words = runs[0].case.loop.units, []
    each = {run.case.name: verdicts.of_run(run.case, run.measures) for run in runs}
    listed = [m for m in ms.MEASURES if all(m in r.measures for r in runs) and m not in ms.times()]
    rows = [
        [m, ms.unit(m, units), *(entries(m, r.measures[m], r.case.loop.plant) for r in runs)]
        for m in listed
    ]
    for run in runs:
        none = undefined(run.measures, run.case.loop.plant)
        words += [f"{run.case.name}: {line}" for line in none]
        if run.differs:
            words.append(f"{run.case.name} has its own {', '.join(run.differs)}")
    sections = [
        Text([f"{name}: {verdict}" for name, verdict in each.items()], items=True),
        Text(["The disturbances, faults and sensor noise of the first case are used for all."]),
        Table(rows, ["measure", "unit", *(r.case.name for r in runs)]),
        Text(words, on="terminal"),
        Text(words, items=True, on="page"),
    ]
    names, verdict, advised = ", ".join(each), verdict_of(runs), advice_of(runs)
    return Report(f"{len(runs)} cases", "", verdict, (), sections, names, advice=advised)


def advice_of(runs: list[Run]) -> Advice:
    good = [run for run in runs if verdicts.of_run(run.case, run.measures).good]
    tracking = [run for run in good or runs if "rms_error_total" in run.measures]
    error = lambda run: float(np.ravel(run.measures["rms_error_total"])[0])
    words = f"{len(good)} of {count(len(runs), 'run')} settle and keep their limits"
    if tracking:
        best = min(tracking, key=error)
        least = amount(error(best), best.case.loop.units[0])
        words += f"; least RMS error{' of these' * bool(good)}: {best.case.name}, {least}"
    each = {run.case.name: of_nominal_plant(run.case) for run in runs}
    same = len(set(each.values())) == 1
    beyond = " ".join(list(each.values())[:1] if same else [f"{n}: {w}" for n, w in each.items()])
    tunable = [run.case for run in runs if is_tunable(run.case)]
    to_set = nothing_to_set((tunable or [runs[0].case])[0])
    if 0 < len(tunable) < len(runs):
        to_set = f"{GIVEN}; {BETTER} of {listed([case.name for case in tunable])}."
    return Advice(to_set, f"{words}.", beyond)


def json_of(runs: list[Run], seed: int) -> dict[str, Any]:
    rows = [json_of_run(r.case, r.measures, seed) | {"differs": list(r.differs)} for r in runs]
    return {"verdict": verdict_of(runs).to_json(), "advice": list(advice_of(runs)), "cases": rows}


def verdict_of(runs: list[Run]) -> verdicts.Verdict:
    good = [verdicts.of_run(run.case, run.measures).good for run in runs]
    return verdicts.outcome(f"{sum(good)} of {len(runs)} runs are good", all(good))


def save(runs: list[Run], folder: str | Path, seed: int, command: str | None = None) -> list[Path]:
    check_folder(folder)
    key_of = lambda case: jax.random.key(seed) if noisy(case) else None
    trajectories = {r.case.name: run_for_people(r.case, key_of(r.case)) for r in runs}
    loop, title = runs[0].case.loop, ", ".join(trajectories)
    of = provenance.provenance(runs[0].case, seed)
    # characters that a file name cannot have become dashes
    file = lambda name: re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip(".-") or "case"
    files = {f"{file(name)}.csv": csv(run, loop.units) for name, run in trajectories.items()}
    draw = lambda: {"responses": responses_of(runs[0].case, trajectories, title)}
    payload, page = json_of(runs, seed), lambda: report(runs)
    return save_all(folder, payload, files, draw, page, CAPTIONS, command, provenance=of)

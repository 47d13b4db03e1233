"""Discrete choices (a number of Laguerre terms, a pairing, the controller) by enumeration."""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxtank import rig
from jaxtank.bounds import bounds, free_of
from jaxtank.case import Case, Scenario, check_case
from jaxtank.core.errors import InputError, unknown
from jaxtank.core.text import shortened
from jaxtank.core.tree import split_index
from jaxtank.rig.components import ROLES
from tuning.cluster.engine import connect
from tuning.problem.controllers import NAMES, with_kind
from tuning.problem.problem import Problem
from tuning.problem.status import Status
from tuning.search.options import Options, check_precision, options_of
from tuning.search.result import Message, TuningResult
from tuning.search.tuner import tune
from tuning.storage.store import NAME

MANY = 64  # combinations that are tried at most
UNFIT = "does not fit"  # status of a combination that the rig cannot have


class Variant(NamedTuple):
    """One combination of choices: its case and what is free in it, or why there is none."""

    values: dict[str, Any]
    case: Any
    free: Any
    why: str = ""

    @property
    def words(self) -> str:
        return ", ".join(f"{n} = {v}" for n, v in self.values.items())


def tune_choices(
    case: Case,
    choices: Mapping[str, Sequence[Any]],
    method: str | Options = "auto",
    *,
    free: Mapping[str, Any] | None = None,
    objective: Any = None,
    limits: Any = None,
    scenarios: Sequence[Scenario] | None = None,
    risk: str = "mean",
    seed: int = 0,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    **options: Any,
) -> TuningResult:
    """Return the best nominal optimum of all combinations of choices.

    One that keeps every limit is preferred to one that does not, then the smaller violation, then
    the lower objective.

    Parameters
    ----------
    case, objective, limits, scenarios, risk, seed : as in `Problem`.
    choices : {static name: [values]}; {"controller.kind": ["pid", "lqi"]} tunes each of these
        controllers with its gains and ranges.
    free : as in `Problem`; of controllers that differ, each has what it has a parameter for.
    method, checkpoint, resume, options : as in `tune`.

    Returns
    -------
    TuningResult, with a dict for each combination as `choices`.

    Raises
    ------
    InputError : for a choice that cannot be made, and as `tune`.

    Examples
    --------
    >>> import tuning
    >>> from jaxtank import presets
    >>> case = presets.find("cascaded/pi")
    >>> tuning.tune_choices(case, {"clock.substeps": [1, 2]}).choices  # doctest: +SKIP
    """
    check_case(case, seed)
    check_precision()
    variants = _variants(case, choices, free)
    folders = [Path(checkpoint or ".") / f"choice_{i + 1}" for i in range(len(variants))]
    if resume and not any(folder.is_dir() for folder in folders):
        raise InputError(
            f"--resume: {str(checkpoint)!r} holds no checkpoint to continue: there is no choice_1"
        )
    results: list[tuple[Variant, TuningResult]] = []
    rows: list[dict[str, Any]] = []
    chosen = options_of(method)
    with connect(chosen.cluster) as engine:
        chosen = dataclasses.replace(chosen, cluster=engine)
        for variant, folder in zip(variants, folders):
            if variant.case is None:
                rows.append(_row(variant, None))
                continue
            parts = variant.free, objective, limits, scenarios, seed, risk
            resumed = resume and (folder / NAME).exists()
            keep: Any = {"checkpoint": None if checkpoint is None else folder, "resume": resumed}
            result = tune(Problem(variant.case, *parts), chosen, **keep, **options)
            results.append((variant, result))
            rows.append(_row(variant, result))
            if result.status == Status.INTERRUPTED:
                break
    variant, best = min(results, key=lambda pair: _rank(pair[1]))
    first = Message("best-of-choices", f"best of {len(results)} choices: {variant.words}")
    unfit = [Message("choice-does-not-fit", f"{v.words}: {v.why}") for v in variants if v.why]
    return best.replace(choices=rows, messages=(first, *best.messages, *unfit))


def _row(variant, result):
    """Return the row of one combination; result : None where it does not fit."""
    objective: dict[str, Any] = {"before": None, "after": None}
    row = {"values": variant.values, "status": UNFIT, "objective": objective, "parameters": {}}
    if result is None:
        return row | {"reason": variant.why}
    objective = {side: result.objective[side] for side in objective}
    after = {n: p["after"] for n, p in result.parameters.items()}
    row |= {"status": str(result.status), "objective": objective, "parameters": after}
    return row | {"reason": None}


def _variants(case, choices, free):
    """Return the Variants of all combinations. Raises InputError for one that cannot be."""
    _check_choices(choices)
    combinations = list(itertools.product(*choices.values()))
    if len(combinations) > MANY:
        raise InputError(f"choices: {len(combinations)} combinations, must be at most {MANY}")
    kinds = [name for name in choices if name in NAMES]
    if len(kinds) > 1:
        raise InputError(f"choices {kinds[1]}: is {kinds[0]} by another name; leave one out")
    variants = [_variant(case, dict(zip(choices, c)), kinds, free) for c in combinations]
    fitting = [variant.case for variant in variants if variant.case is not None]
    if not fitting:
        raise InputError(f"choices: none fits the rig; {variants[0].words}: {variants[0].why}")
    for name in free or {}:
        if kinds and not any(rig.has(variant.loop, name) for variant in fitting):
            bounds(fitting[0].loop, {name: free[name]})  # raises, with the nearest name
    return variants


def _check_choices(choices):
    if not isinstance(choices, Mapping):
        raise InputError(
            f"choices = {shortened(choices)}: must be {{name: [values to try]}}, as"
            ' {"controller.kind": ["pid", "lqi"]}'
        )
    for name, values in choices.items():
        if not isinstance(values, (list, tuple)) or not values:
            raise InputError(f"choices {name}: must be a list of values to try")


def _variant(case, values, kinds, free):
    rest = {name: value for name, value in values.items() if name not in kinds}
    if kinds:
        kind = values[kinds[0]]
        if kind not in ROLES["controller"].classes:
            raise unknown("controller kind", str(kind), ROLES["controller"].classes)
        try:
            case = with_kind(case, kind)
        except InputError as error:
            return Variant(values, None, None, str(error))
        free = None if free is None else _free_of(case, free)
    taken = {
        split_index(b.name)[0] for b in bounds(case.loop, free_of(case) if free is None else free)
    }
    for name in rest:
        if split_index(name)[0] in taken:
            raise InputError(
                f"choices {name}: is free, and cannot be chosen as well; leave it out of one of"
                " them"
            )
    return Variant(values, rig.check(rig.set_values(case, rest)), free)


def _free_of(case, free):
    """Return what is free of a new controller: of `free`, else its gains; None: as without."""
    present = {name: spec for name, spec in free.items() if rig.has(case.loop, name)}
    if any(name.startswith("controller.") for name in present):
        return present
    gains = {n: f for n, f in free_of(case).items() if n.startswith("controller.")}
    return gains | present if present else None


def _rank(result):
    """Return the largest violation as a share of its limit, then the objective; least is best."""
    scales = result.problem.limit_scales
    shares = [-c.margin / scale for c, scale in zip(result.constraints, scales)]
    return max(0.0, *shares) if shares else 0.0, result.objective["after"]

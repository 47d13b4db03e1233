"""Discrete choices (a number of Laguerre terms, a pairing, the controller) by enumeration: the best
is taken.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxtank import rig
from jaxtank.bounds import bounds
from jaxtank.core.errors import InputError, unknown
from jaxtank.core.text import shortened
from jaxtank.core.tree import split_index
from jaxtank.rig.components import ROLES
from tuning.problem.controllers import NAMES, with_kind
from tuning.problem.status import Status
from tuning.search.result import Message, TuningResult
from tuning.storage.store import NAME

MANY = 64  # combinations that are tried at most
UNFIT = "does not fit"  # status of a combination that the rig cannot have


def tune_choices(
    tune: Callable[..., TuningResult],
    case: Any,
    method: str,
    choices: Mapping[str, Sequence[Any]],
    *,
    checkpoint: Any = None,
    resume: bool = False,
    **options: Any,
) -> TuningResult:
    """Return the best TuningResult of all combinations, with `choices` a row for each."""
    # One that holds every limit is preferred to one that does not, then the smaller violation, then
    # the lower objective.
    variants = _variants(case, choices, options.get("free"))
    if resume and not any(_folder(checkpoint, i).is_dir() for i in range(len(variants))):
        raise InputError(
            f"--resume: {str(checkpoint)!r} holds no checkpoint to continue: there is no choice_1"
        )
    results: list[tuple[dict[str, Any], TuningResult]] = []
    rows: list[dict[str, Any]] = []
    for i, variant in enumerate(variants):
        if variant.case is None:
            rows.append(_row(variant, UNFIT, None, None, reason=variant.why))
            continue
        folder = None if checkpoint is None else _folder(checkpoint, i)
        old = resume and folder is not None and (folder / NAME).exists()
        own = options | {"free": variant.free}
        result = tune(variant.case, method, checkpoint=folder, resume=old, **own)
        results.append((variant.values, result))
        after = {n: p["after"] for n, p in result.parameters.items()}
        before, now = (result.objective[side] for side in ("before", "after"))
        rows.append(_row(variant, str(result.status), before, now, after))
        if result.status == Status.INTERRUPTED:
            break
    chosen, best = min(results, key=lambda found: _rank(found[1]))
    text = ", ".join(f"{n} = {v}" for n, v in chosen.items())
    first = Message("best-of-choices", f"best of {len(results)} choices: {text}")
    unfit = [Message("choice-does-not-fit", f"{_words(v)}: {v.why}") for v in variants if v.why]
    return best.replace(choices=rows, messages=(first, *best.messages, *unfit))


class Variant(NamedTuple):
    """One combination of choices: its case and what is free in it, or why there is none."""

    values: dict[str, Any]
    case: Any
    free: Any
    why: str = ""


def _words(variant):
    return ", ".join(f"{n} = {v}" for n, v in variant.values.items())


def _row(variant, status, before, after, parameters=None, reason=None):
    """Return the row of one combination in a result."""
    return {
        "values": variant.values,
        "status": status,
        "objective": {"before": before, "after": after},
        "parameters": parameters or {},
        "reason": reason,
    }


def _variants(case, choices, free):
    """Return the Variants of all combinations. Raises InputError for one that cannot be."""
    if not isinstance(choices, Mapping):
        raise InputError(
            f"choices = {shortened(choices)}: must be {{name: [values to try]}}, as"
            ' {"controller.kind": ["pid", "lqi"]}'
        )
    for name, values in choices.items():
        if not isinstance(values, (list, tuple)) or not values:
            raise InputError(f"choices {name}: must be a list of values to try")
    combinations = list(itertools.product(*choices.values()))
    if len(combinations) > MANY:
        raise InputError(f"choices: {len(combinations)} combinations, must be at most {MANY}")
    kinds = [name for name in choices if name in NAMES]
    if len(kinds) > 1:
        raise InputError(f"choices {kinds[1]}: is {kinds[0]} by another name; leave one out")
    found = [_variant(case, dict(zip(choices, c)), kinds, free) for c in combinations]
    if all(variant.case is None for variant in found):
        raise InputError(f"choices: none fits the rig; {_words(found[0])}: {found[0].why}")
    fitting = [variant.case for variant in found if variant.case is not None]
    for name in free or {}:
        if kinds and not any(rig.has(variant.loop, name) for variant in fitting):
            bounds(fitting[0].loop, {name: free[name]})  # raises, with the nearest name
    return found


def _variant(case, values, kinds, free):
    """Return the Variant of one combination."""
    rest = {name: value for name, value in values.items() if name not in kinds}
    if kinds:
        kind = values[kinds[0]]
        if kind not in ROLES["controller"].classes:
            raise unknown("controller kind", str(kind), ROLES["controller"].classes)
        try:
            case = with_kind(case, kind)
        except InputError as error:
            return Variant(values, None, None, str(error))
        free = _free_of(case, free)
    taken = {split_index(b.name)[0] for b in bounds(case.loop, case.free if free is None else free)}
    for name in rest:
        if split_index(name)[0] in taken:
            raise InputError(
                f"choices {name}: is free, and cannot be chosen as well; leave it out of one of"
                " them"
            )
    return Variant(values, rig.check(rig.set_values(case, rest)), free)


def _free_of(case, free):
    """Return what is free with another controller: of `free` what it has, else its own gains."""
    if free is None:
        return None
    found = {name: spec for name, spec in free.items() if rig.has(case.loop, name)}
    if any(name.startswith("controller.") for name in found):
        return found
    return {n: f for n, f in case.free.items() if n.startswith("controller.")} | found


def _folder(checkpoint, i):
    """Return the folder of the log of combination i."""
    return Path(checkpoint) / f"choice_{i + 1}"


def _rank(result):
    """Return the largest violation as a share of its limit, then the objective; least is best."""
    scales = result.problem.limit_scales
    shares = [-c.margin / scale for c, scale in zip(result.constraints, scales)]
    return max(0.0, *shares) if shares else 0.0, result.objective["after"]

"""Discrete choices (a number of Laguerre terms, a pairing) by enumeration: the best is taken.

Imported by `tuner`, which it calls through its argument.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxtank import rig
from jaxtank.core.errors import InputError
from jaxtank.core.tree import split_index
from tuning.problem.bounds import bounds
from tuning.search.result import Message, TuningResult
from tuning.storage.evaluation_log import NAME

MANY = 64
"""Combinations that are tried at most."""


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
    """Return the best TuningResult of all combinations of `choices`, with `choices` a row for each.

    One that holds every limit is preferred to one that does not, then the smaller violation, then
    the lower objective.

    Parameters
    ----------
    tune : what is called for each combination, with `options`.
    choices : {static name: [values]}.
    checkpoint : folder with a log of its own for every combination, which resume=True continues.

    Raises
    ------
    InputError : for a choice that the case cannot have.
    """
    variants = _variants(case, choices, options.get("free"))
    if resume and not any(_folder(checkpoint, i).is_dir() for i in range(len(variants))):
        raise InputError(
            f"--resume: {str(checkpoint)!r} holds no checkpoint to continue: there is no choice_1"
        )
    results: list[tuple[dict[str, Any], TuningResult]] = []
    for i, (values, variant) in enumerate(variants):
        folder = None if checkpoint is None else _folder(checkpoint, i)
        old = resume and folder is not None and (folder / NAME).exists()
        results.append((values, tune(variant, method, checkpoint=folder, resume=old, **options)))
    rows = [
        {
            "values": values,
            "status": str(r.status),
            "objective": {k: r.objective[k] for k in ("before", "after")},
            "parameters": {n: p["after"] for n, p in r.parameters.items()},
        }
        for values, r in results
    ]
    chosen, best = min(results, key=lambda found: _rank(found[1]))
    text = ", ".join(f"{n} = {v}" for n, v in chosen.items())
    first = Message("best-of-choices", f"best of {len(rows)} choices: {text}")
    return best.replace(choices=rows, messages=(first, *best.messages))


def _variants(case, choices, free):
    """Return [(values, Case)] of all combinations. Raises InputError for one that cannot be."""
    for name, values in choices.items():
        if not isinstance(values, (list, tuple)) or not values:
            raise InputError(f"choices {name}: must be a list of values to try")
    taken = {split_index(b.name)[0] for b in bounds(case.loop, case.free if free is None else free)}
    for name in choices:
        if split_index(name)[0] in taken:
            raise InputError(
                f"choices {name}: is free, and cannot be chosen as well; leave it out of one of"
                " them"
            )
    combinations = list(itertools.product(*choices.values()))
    if len(combinations) > MANY:
        raise InputError(f"choices: {len(combinations)} combinations, must be at most {MANY}")
    named = [dict(zip(choices, c)) for c in combinations]
    return [(values, rig.check(rig.set_values(case, values))) for values in named]


def _folder(checkpoint, i):
    """Return the folder of the log of combination i."""
    return Path(checkpoint) / f"choice_{i + 1}"


def _rank(result):
    """Return the largest violation as a share of its limit, then the objective; least is best."""
    scales = result.problem.limit_scales
    shares = [-c.margin / scale for c, scale in zip(result.constraints, scales)]
    return max(0.0, *shares) if shares else 0.0, result.objective["after"]

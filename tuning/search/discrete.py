"""Discrete choices (a number of Laguerre terms, a pairing) by enumeration: each combination is
tuned, the best taken.
"""

import itertools
from pathlib import Path

from jaxtank import rig
from jaxtank.core.errors import InputError
from jaxtank.core.tree import split_index
from tuning.problem.bounds import bounds
from tuning.storage.evaluation_log import NAME


def _folder(log, i):
    return Path(log) / f"choice_{i + 1}"


def _rank(result):
    """What a result is preferred by: the largest share by which a limit is broken, then the
    objective.
    """
    shares = [-c["margin"] / room for c, room in zip(result.constraints, result.problem.rooms)]
    return max(0.0, *shares) if shares else 0.0, result.objective["after"]


MANY = 64
"""Combinations that are tried at most."""


def tune_choices(tune, case, method, choices, *, log=None, resume=False, **options):
    """`tune` of every combination of `choices`, {static name: [values]}: the best TuningResult,
    with `choices` a row for each.

    One that holds every limit is preferred to one that does not, then the smaller violation, then
    the lower objective. log: folder with a log of its own for every combination, which resume=True
    continues. Raises InputError for a choice that the case cannot have.
    """
    for name, values in choices.items():
        if not isinstance(values, (list, tuple)) or not values:
            raise InputError(f"choices {name}: must be a list of values to try")
    taken = [
        b.name
        for b in bounds(case.loop, case.free if options.get("free") is None else options["free"])
    ]
    for name in choices:
        if any(split_index(name)[0] == split_index(t)[0] for t in taken):
            raise InputError(
                f"choices {name}: is free, and cannot be chosen as well; leave it out of one of"
                " them"
            )
    combinations = list(itertools.product(*choices.values()))
    if len(combinations) > MANY:
        raise InputError(f"choices: {len(combinations)} combinations, must be at most {MANY}")
    variants = [
        (dict(zip(choices, c)), rig.check(rig.set_values(case, dict(zip(choices, c)))))
        for c in combinations
    ]
    if resume and not any(_folder(log, i).is_dir() for i in range(len(variants))):
        raise InputError(f"{str(log)!r} holds no log of a search over choices to go on with")
    results = []
    for i, (values, variant) in enumerate(variants):
        folder = None if log is None else _folder(log, i)
        old = resume and folder is not None and (folder / NAME).exists()
        results.append((values, tune(variant, method, log=folder, resume=old, **options)))
    rows = [
        {
            "values": values,
            "status": str(r.status),
            "objective": {k: r.objective[k] for k in ("before", "after")},
            "parameters": {n: p["after"] for n, p in r.parameters.items()},
        }
        for values, r in results
    ]
    best = min((r for _, r in results), key=_rank)
    chosen = next(values for values, r in results if r is best)
    told = ", ".join(f"{n} = {v}" for n, v in chosen.items())
    return best.replace(
        choices=rows, message=f"best of {len(rows)} choices: {told}; {best.message}"
    )

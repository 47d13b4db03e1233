"""Discrete choices (a number of Laguerre terms, a pairing) by enumeration: each combination is tuned, the best taken."""

import itertools

from jaxtank import rig
from jaxtank.errors import InputError
from jaxtank.tree import split_index
from tuning.bounds import bounds

MANY = 64
"""Combinations that are tried at most."""


def tune_choices(case, method, choices, *, log=None, resume=False, **options):
    """`tune` of every combination of `choices`, {static name: [values]}: the best TuningResult, with `choices` a row for each.

    A success is preferred to anything else, then the lower objective. Raises InputError for a choice that the case cannot have.
    """
    from tuning.search import tune

    if log is not None or resume:
        raise InputError("a search over choices keeps no log: resume is for one combination at a time")
    for name, values in choices.items():
        if not isinstance(values, (list, tuple)) or not values:
            raise InputError(f"choices {name}: must be a list of values to try")
    taken = [b.name for b in bounds(case.loop, case.free if options.get("free") is None else options["free"])]
    for name in choices:
        if any(split_index(name)[0] == split_index(t)[0] for t in taken):
            raise InputError(f"choices {name}: is free, and cannot be chosen as well; leave it out of one of them")
    combinations = list(itertools.product(*choices.values()))
    if len(combinations) > MANY:
        raise InputError(f"choices: {len(combinations)} combinations, must be at most {MANY}")
    variants = [(dict(zip(choices, c)), rig.check(rig.set_values(case, dict(zip(choices, c))))) for c in combinations]
    results = [(values, tune(variant, method, **options)) for values, variant in variants]
    rows = [
        {
            "values": values,
            "status": r.status,
            "objective": {k: r.objective[k] for k in ("before", "after")},
            "parameters": {n: p["after"] for n, p in r.parameters.items()},
        }
        for values, r in results
    ]
    best = min(results, key=lambda item: (not item[1].success, item[1].objective["after"]))[1]
    chosen = next(values for values, r in results if r is best)
    told = ", ".join(f"{n} = {v}" for n, v in chosen.items())
    return best.replace(choices=rows, message=f"best of {len(rows)} choices: {told}; {best.message}")

"""What `tune` searches with: the slope of the own cost of a case of each kind, over its own
scenarios, by every parameter that its preset calls tunable.
"""

import numpy as np
import pytest
from helpers import KINDS

from jaxtank import presets, rig
from jaxtank.core.tree import parameters, split_index
from tuning.problem.problem import Problem

COARSE = {
    # why the slope is only good to this share of the largest one
    "mirakhorli/smc-printed": (
        np.inf,
        "the law switches at every sample: a staircase in the gains (mirakhorli notes S4.2)",
    ),
    **dict.fromkeys(
        ("mirakhorli/smc-fitted", "mirakhorli/hybrid-fitted"),
        (np.inf, "a relay (mirakhorli notes S7.2): a staircase in the gains"),
    ),
    "khalid/*-constrained": (
        1e-3,
        (
            "rows of the programme come and go, and its interior point stops at 1e-6 (khalid notes"
            " S4.5)"
        ),
    ),
    "gouta2015/*-table1": (1e-3, "saturated for 98 % of the run (gouta2015 notes S9.1)"),
}
# of 900 and 1200 s: saturated starts, both setpoints, the first pours left to their own tests
SHORT = {"clock.duration": 200.0}


def tolerance(name):
    for part in ("table1", "constrained"):
        if name.endswith(part) or f"-{part}-" in name:
            return next(share for key, (share, _) in COARSE.items() if key.endswith(f"*-{part}"))
    return COARSE.get(name.removesuffix("-warm"), (1e-5,))[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in KINDS if np.isfinite(tolerance(name))])
def test_slopes_of_the_default_cost(name):
    paper = presets.load(name.split("/")[0])
    case = presets.find(name)
    if name.startswith(("gouta2015", "gouta2022")):
        case = rig.set_values(case, SHORT)
    present = parameters(case.loop)
    if np.size(present.get("controller.horizon", ())) == 1 and "nmpc" in name:
        # one of whole samples is a kink: slopes from above and below differ by a thousandth
        case = rig.set_values(case, {"controller.horizon": 0.993 * present["controller.horizon"]})
    whole = {
        n: spec
        for n, spec in paper.tunable.items()
        if split_index(n)[0] in present and not split_index(n)[1]
    }
    entries = {
        n: spec
        for n, spec in paper.tunable.items()
        if split_index(n)[1] and split_index(n)[0] in present
    }
    free = {
        n: spec for n, spec in whole.items() if not any(split_index(e)[0] == n for e in entries)
    }
    for n, spec in entries.items():
        if split_index(n)[1][0] < np.size(present[split_index(n)[0]]):
            free[n] = spec
    # the narrow ranges of its entries are for one pump
    if name.startswith("khalid") and case.loop.plant.pumps == 2:
        free = {n: v for n, v in free.items() if n not in entries} | {
            n: whole[n] for n in {split_index(e)[0] for e in entries}
        }
    # apart from the programme's own limits, where those of the pump would be a kink
    if name.endswith("-constrained"):
        case = rig.set_values(case, {"actuator.low": -0.5, "actuator.high": 3.5})
    problem = Problem(case, free=free, limits={})
    z = np.clip(problem.start(), 0.02, 0.98)
    found, count = problem.point(z), len(z)
    errors = []
    for h in (1e-5, 1e-6, 1e-7):
        moves = np.concatenate([h * np.eye(count), -h * np.eye(count)])
        costs, _ = problem.screen(z + moves)
        errors.append(np.abs((costs[:count] - costs[count:]) / (2 * h) - found.gradient))
    worst = np.min(errors, axis=0) / np.abs(found.gradient).max()
    assert found.finite and np.any(found.gradient != 0)
    assert worst.max() < tolerance(name), dict(zip(problem.names, worst))

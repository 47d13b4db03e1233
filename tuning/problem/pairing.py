"""Whether gains of these signs, and outputs paired with inputs in this order, can be stable.

Niederlinski, Automatica 7 (1971); Bristol, IEEE Trans. Automatic Control 11 (1966).
"""

# the linear models of jaxtank.analysis have no types
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxtank.analysis.linear_model import linearise_compiled
from jaxtank.case import Case
from jaxtank.controllers import PID, Cascade, Override
from jaxtank.core.errors import InputError
from jaxtank.core.labels import label_of, name_of
from jaxtank.loop.steady import at_mean_inflow, steady_inflow
from jaxtank.rig.warnings import wrong_signs
from tuning.problem.controllers import operating_point
from tuning.problem.rules import slopes_of

SINGULAR = 1e10  # condition number from which a level has no steady gain, or inputs act alike
MOST = 5  # outputs of which every pairing is compared


def check_signs(case: Case, free: Any) -> None:
    """Raise InputError where no ranges are stated and no gains about the first can be stable."""
    if free is not None or case.free:
        return
    sentences: list[str] = [*wrong_signs(case)] or [*unstable_signs(case)]
    if sentences:
        raise InputError(
            f"{'; '.join(sentences)} (or state ranges with --free: those of tune are about these"
            " gains)"
        )


def unstable_signs(case: Case) -> Iterator[str]:
    """The sentence, with the remedy, on integral action that is unstable whatever its gains."""
    # det(G(0) diag(k)) < 0: the closed loop's determinant is < 0 near s = 0 and 1 at infinity:
    # there is a real pole in the right half plane
    part: Any = getattr(case.loop.controller, "law", case.loop.controller)
    if not _has_integral_action(part):
        return
    gains = np.asarray(part.signed_gain, dtype=float)
    # of one loop, `wrong_signs` knows all but the valves that may run backwards
    between = any(None not in pair for pair in getattr(case.loop.plant, "valves", ()))
    G = _steady_gains(case, len(gains)) if between or len(gains) > 1 else None
    if G is None or np.prod(np.sign(gains)) * np.linalg.det(G) >= 0.0:
        return
    plant, direct = case.loop.plant, np.diag(G)
    if np.all(direct) and np.linalg.det(G) / np.prod(direct) > 0.0:
        wrong = [
            label_of(plant, "output", i) for i in range(len(gains)) if gains[i] * direct[i] < 0.0
        ]
        remedy = f": change the sign of controller.Kc of {', '.join(wrong)}"
    else:
        remedy = _other_pairing(plant, G) if type(part) is PID and len(gains) <= MOST else ""
    yield (
        f"controller.Kc: {_paired(plant, range(len(gains)))}: with integral action, gains of these"
        f" signs are unstable whatever their sizes{remedy}"
    )


def _has_integral_action(part: Any) -> bool:
    """Whether a controller is a PID alone, with integral action in every loop."""
    alone = isinstance(part, PID) and not isinstance(part, Cascade | Override)
    return alone and part.Ti is not None and not np.any(np.isinf(np.asarray(part.Ti)))


def _steady_gains(case: Case, loops: int) -> np.ndarray | None:
    """G(0) (outputs, loops) at the last setpoint, None where a level has no steady gain."""
    case = case.replace(loop=at_mean_inflow(case.loop, case.clock))
    try:
        _, levels, inputs = operating_point(case, case.loop.plant)
    except InputError:
        return None
    linear = linearise_compiled(case.loop.plant, levels, inputs, steady_inflow(case.loop))
    A, B, C = (np.asarray(v, dtype=float) for v in linear)
    if np.linalg.cond(A) > SINGULAR:
        return None
    slopes = np.column_stack([slopes_of(case, inputs, i) for i in range(loops)])
    G = -C @ np.linalg.solve(A, B @ slopes)
    return G if np.linalg.cond(G) < SINGULAR else None


def _other_pairing(plant: Any, G: np.ndarray) -> str:
    """The pairing with relative gains nearest to 1, of those that can be stable; "" if none."""
    relative: Any = G * np.linalg.inv(G).T  # of Bristol
    outputs = range(len(G))
    choices = [
        inputs
        for inputs in itertools.permutations(outputs)
        if min(relative[outputs, inputs]) > 0.0
        and np.linalg.det(G[:, inputs]) / np.prod(G[outputs, inputs]) > 0.0
    ]
    if not choices:
        return ""
    best = min(choices, key=lambda inputs: np.max(np.abs(relative[outputs, inputs] - 1.0)))
    order = np.argsort(best)  # the output of each input
    values = [
        f'"{name}"' if (name := name_of(plant, "output", i)) else f"{plant.outputs[i] + 1}"
        for i in order
    ]
    now, then = min(relative.diagonal()), max(relative[outputs, best], key=abs)
    return (
        f" (relative gain {now:.3g}): write plant.outputs = [{', '.join(values)}], and setpoints"
        f" and gains in this order, so that {_paired(plant, best)} (relative gain {then:.3g})"
    )


def _paired(plant: Any, inputs: Any) -> str:
    """Words on which input controls which output."""
    pairs = sorted((j, i) for i, j in enumerate(inputs))
    labels = ((label_of(plant, "pump", j), label_of(plant, "output", i)) for j, i in pairs)
    return " and ".join(f"{pump} controls {output}" for pump, output in labels)

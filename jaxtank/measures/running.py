"""What the time loop calls: start, update and read the accumulators that some measures need.

May import `jaxtank.core` and the other modules of `measures` only.
"""

from collections.abc import Callable, Sequence
from typing import Any, cast

from jaxtank.core.kahan import totals
from jaxtank.core.records import Sample
from jaxtank.measures.accumulators import ACCUMULATORS, Context, Run
from jaxtank.measures.catalogue import MEASURES

States = dict[str, Any]
"""{accumulator: its state}"""
Weights = Sequence[tuple[str, float]]
"""(measure, weight) of sums of squares"""


def needs(names: Sequence[str]) -> tuple[str, ...]:
    """Return the accumulators that `names` need, in a fixed order."""
    wanted = {a for name in names for a in MEASURES[name].needs}
    return tuple(a for a in ACCUMULATORS if a in wanted)


def start(run: Run, names: Sequence[str]) -> States:
    """Return {accumulator: state} before the first sample."""
    return {a: ACCUMULATORS[a].start(run) for a in needs(names)}


def update(run: Run, states: States, sample: Sample, context: Context) -> States:
    """Return {accumulator: state} after `sample`."""
    return {a: ACCUMULATORS[a].update(run, s, sample, context) for a, s in states.items()}


def residuals(
    run: Run, states: States, sample: Sample, context: Context, squares: Weights
) -> tuple[Any, ...]:
    """Return the residuals of one sample, a flat tuple, of the sums of squares in `squares`."""
    found: list[Any] = []
    for measure, _ in squares:
        name = MEASURES[measure].residual
        of = cast(Callable[..., tuple[Any, ...]], ACCUMULATORS[name].residual)
        found.extend(of(run, states[name], sample, context))
    return tuple(found)


def residual_weights(run: Run, squares: Weights) -> tuple[Any, ...]:
    """Return what the square of each of `residuals` counts in the weighted sum of the measures."""
    counts = {"output": run.outputs, "tank": run.tanks, "pump": run.pumps}
    found: list[Any] = []
    for measure, weight in squares:
        spec = MEASURES[measure]
        scale = cast(Callable[[Run], Any], spec.scale)  # of a sum of squares
        found.extend(weight * scale(run) for _ in range(counts[spec.per]))
    return tuple(found)


def read(run: Run, states: States, names: Sequence[str]) -> dict[str, Any]:
    """Return {measure: value} at the end of a run."""
    states = totals(states)
    return {name: MEASURES[name].read(run, states) for name in names}

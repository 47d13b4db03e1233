"""What the time loop calls: start, update and read the accumulators that some measures need."""

from collections.abc import Callable, Sequence
from typing import Any, cast

import jax.numpy as jnp

from jaxtank.core.kahan import totals
from jaxtank.core.records import Sample
from jaxtank.core.vectors import scalars
from jaxtank.measures.accumulators import ACCUMULATORS, Accumulator, Context, Run
from jaxtank.measures.catalogue import MEASURES

States = dict[str, Any]
"""{accumulator: its state}"""
Weights = Sequence[tuple[str, float]]
"""(measure, weight) of sums of squares"""


def needs(names: Sequence[str]) -> tuple[str, ...]:
    """Return the accumulators that `names` need, in a fixed order."""
    needed = {a for name in names for a in MEASURES[name].needs}
    return tuple(a for a in ACCUMULATORS if a in needed)


def start(run: Run, names: Sequence[str]) -> States:
    """Return {accumulator: state} before the first sample."""
    return {a: ACCUMULATORS[a].start(_run_for(run, ACCUMULATORS[a])) for a in needs(names)}


def update(run: Run, states: States, sample: Sample, context: Context) -> States:
    """Return {accumulator: state} after `sample`."""
    updated: States = {}
    for a, s in states.items():
        accumulator = ACCUMULATORS[a]
        known = run, s, sample, context
        if run.arrays and not accumulator.arrays:
            known = _run_for(run, accumulator), s, *_in_scalars(sample, context)
        updated[a] = accumulator.update(*known)
    return updated


def residuals(
    run: Run, states: States, sample: Sample, context: Context, squares: Weights
) -> tuple[Any, ...]:
    """Return the residuals of one sample of the sums of squares in `squares`: a flat tuple, or a
    tuple of arrays, one for each of `squares`.
    """
    values: list[Any] = []
    for measure, _ in squares:
        name = MEASURES[measure].residual
        of = cast(Callable[..., Any], ACCUMULATORS[name].residual)
        if run.arrays and not ACCUMULATORS[name].arrays:
            entries = of(_in_tuples(run), states[name], *_in_scalars(sample, context))
            values.append(jnp.stack(list(entries)))
        elif run.arrays:
            values.append(of(run, states[name], sample, context))
        else:
            values.extend(of(run, states[name], sample, context))
    return tuple(values)


def residual_weights(run: Run, squares: Weights) -> tuple[Any, ...]:
    """Return what the square of each of `residuals` counts in the weighted sum of the measures."""
    counts = {"output": run.outputs, "tank": run.tanks, "pump": run.pumps}
    if run.arrays:
        counts = dict.fromkeys(counts, 1)  # one array each
    weights: list[Any] = []
    for measure, weight in squares:
        spec = MEASURES[measure]
        scale = cast(Callable[[Run], Any], spec.scale)  # of a sum of squares
        weights.extend(weight * scale(run) for _ in range(counts[spec.per]))
    return tuple(weights)


def read(run: Run, states: States, names: Sequence[str]) -> dict[str, Any]:
    """Return {measure: value} at the end of a run."""
    states = totals(states)
    values: dict[str, Any] = {}
    for name in names:
        spec = MEASURES[name]
        if run.arrays and not spec.arrays:
            rows = {
                a: _rows_of(states[a]) if ACCUMULATORS[a].rows else states[a] for a in spec.needs
            }
            values[name] = spec.read(_in_tuples(run), rows)
        else:
            values[name] = spec.read(run, states)
    return values


def _rows_of(state: Any) -> tuple[Any, ...]:
    """A tuple of numbers for each entry, of a tuple of arrays."""
    return tuple(zip(*(scalars(column) for column in state)))


def _run_for(run: Run, accumulator: Accumulator) -> Run:
    """`run` in the form that an accumulator takes."""
    return run if accumulator.arrays or not run.arrays else _in_tuples(run)


def _in_tuples(run: Run) -> Run:
    """`run` with tuples of scalars as vectors."""
    low, high, rim = (scalars(v) for v in (run.low, run.high, run.rim))
    return run._replace(low=low, high=high, rim=rim, arrays=False)


def _in_scalars(sample: Sample, context: Context) -> tuple[Sample, Context]:
    """The same with tuples of scalars as vectors."""
    window = None if context.window is None else _rows_of(context.window)
    context = context._replace(window=window, steady=scalars(context.steady))
    alone = {"t": sample.t, "filtered": sample.filtered}
    vectors = {f: scalars(v) for f, v in sample._asdict().items() if f not in alone}
    return Sample(**alone, **vectors), context

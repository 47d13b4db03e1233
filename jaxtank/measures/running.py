"""Accumulators in the time loop: start, update and read them for some measures."""

from collections.abc import Sequence
from typing import Any

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
    tuples = _in_tuples(run) if run.arrays else run
    specs = {a: ACCUMULATORS[a] for a in needs(names)}
    return {a: spec.start(run if spec.arrays else tuples) for a, spec in specs.items()}


def update(run: Run, states: States, sample: Sample, context: Context) -> States:
    """Return {accumulator: state} after `sample`."""
    updated: States = {}
    for name, state in states.items():
        known, *signals = _in_form(ACCUMULATORS[name], run, sample, context)
        updated[name] = ACCUMULATORS[name].update(known, state, *signals)
    return updated


def residuals(
    run: Run, states: States, sample: Sample, context: Context, squares: Weights
) -> tuple[Any, ...]:
    """Return a sample's residuals of `squares`: a flat tuple, or one array for each of them."""
    values: list[Any] = []
    for measure, _ in squares:
        name = MEASURES[measure].residual
        accumulator: Any = ACCUMULATORS[name]
        known, *signals = _in_form(accumulator, run, sample, context)
        entries = accumulator.residual(known, states[name], *signals)
        if run.arrays:
            values.append(entries if accumulator.arrays else jnp.stack(list(entries)))
        else:
            values.extend(entries)
    return tuple(values)


def residual_weights(run: Run, squares: Weights) -> tuple[Any, ...]:
    """Return the weight of the square of each of `residuals` in the sum of the measures."""
    counts = {"output": run.outputs, "tank": run.tanks, "pump": run.pumps}
    if run.arrays:
        counts = dict.fromkeys(counts, 1)  # one array each
    weights: list[Any] = []
    for measure, weight in squares:
        spec: Any = MEASURES[measure]
        weights.extend(weight * spec.scale(run) for _ in range(counts[spec.per]))
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


def _in_form(accumulator: Accumulator, run: Run, sample: Sample, context: Context) -> Any:
    """(run, sample, context) with vectors in the form that an accumulator takes."""
    if accumulator.arrays or not run.arrays:
        return run, sample, context
    return _in_tuples(run), *_in_scalars(sample, context)


def _in_tuples(run: Run) -> Run:
    """`run` with tuples of scalars as vectors."""
    low, high, rim = (scalars(v) for v in (run.low, run.high, run.rim))
    return run._replace(low=low, high=high, rim=rim, arrays=False)


def _in_scalars(sample: Sample, context: Context) -> tuple[Sample, Context]:
    """The same with tuples of scalars as vectors."""
    window = None if context.window is None else _rows_of(context.window)
    context = context._replace(window=window, steady=scalars(context.steady))
    alone = {"t": sample.t, "filtered": sample.filtered, "slack": sample.slack}
    vectors = {f: scalars(v) for f, v in sample._asdict().items() if f not in alone}
    return Sample(**alone, **vectors), context

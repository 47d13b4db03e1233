"""The measures: numbers that describe a run, each with all that is known of it.

A measure reads accumulators at the end of a run. Means are over its N + 1 samples, t = 0 to T.
Integrals and volumes are over [0, T]: sums over the first N samples, each held for dt, which is
exact for inputs and volumes, and the left rectangle rule for levels.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxtank.core.numerics import lower_clip, root_of_mean
from jaxtank.core.vectors import each, is_array, total
from jaxtank.measures.accumulators import Run, ended_plateau, settled, swing_of


class Measure(NamedTuple):
    """A named number or list, and all that reports, limits and searches need to know of it.

    `jaxtank.measures.register` adds a custom one.

    Examples
    --------
    >>> from jaxtank.measures import MEASURES
    >>> MEASURES["max_level"].unit, MEASURES["max_level"].per, MEASURES["min_level"].sense
    ('cm', 'tank', -1.0)
    """

    unit: str  # "cm" stands for the rig's unit of length, "V" for the unit of its inputs
    per: str  # "run", "output", "tank" or "pump"
    needs: tuple[str, ...]  # names of accumulators
    read: Callable[[Run, dict[str, Any]], Any]  # (run, {accumulator: state}) -> scalar or array
    doc: str
    residual: str = ""  # the accumulator of squares that it is a multiple of, if it is one
    scale: Callable[[Run], Any] | None = None  # run -> factor of that sum
    low: float | None = 0.0  # least and largest value that it can have, None where there is none
    high: float | None = None
    sense: float = 1.0  # +1 where a larger value is worse (limits are upper ones), -1 a smaller
    counts: bool = False  # counts whole samples: a step function of the parameters, no derivative
    by_input: bool = False  # a sum over the run with a slope in every input: `bound` minimises it
    shown: int = 0  # its place in the table of a tuning result; 0: not in it
    summary: int = 0  # its place in an ensemble's summary unless others are named; 0: not in it
    reached: str = ""  # the measure that holds the time at which this one was reached
    undefined: str = "the value is not a finite number"  # why a run has no value of it
    worst: str = ""  # why it is infinite on the side that is worse; "": as `undefined`
    unlimited: str = ""  # why it is infinite on the side that is better; "": as `undefined`
    unserved: str = ""  # why a case has none, reported where it is not computed
    nan_holds: str = ""  # meaning of NaN if NaN satisfies a limit; "": NaN violates it
    linear: bool = False  # of the linearised loop (`Run.margins`): computed where it is named only
    arrays: bool = False  # whether `read` takes states of either form; else of tuples of scalars

    def cause(self, value: float) -> str:
        """Return why a value is not a finite number.

        Examples
        --------
        >>> from jaxtank.measures import MEASURES
        >>> MEASURES["settling_time"].cause(float("nan"))
        'no change of its setpoint took the output out of its band'
        """
        if math.isnan(value):
            return self.nan_holds or self.undefined
        return (self.worst if value * self.sense > 0.0 else self.unlimited) or self.undefined


def _stacked(values) -> Any:
    return values if is_array(values) else jnp.stack([jnp.asarray(v) for v in values])


def _means(run, values):
    return each(lambda v: v / run.samples, values)


def _mean(run):
    """Factor that makes a mean over the samples of a sum."""
    return 1.0 / run.samples


def _integral(run):
    """Factor that makes an integral over time of a sum."""
    return run.dt


def _measure(unit, per, accumulator, read, doc, **facts) -> Measure:
    """A measure of one accumulator, whose state is what `read` takes."""
    read_state = lambda run, states: read(run, states[accumulator])
    return Measure(unit, per, (accumulator,), read_state, doc, **facts)


def _root_mean(unit, per, accumulator, doc, **facts) -> Measure:
    read = lambda run, sums: root_of_mean(_stacked(_means(run, sums)))
    return _measure(unit, per, accumulator, read, doc, **facts)


def _root_mean_total(accumulator, doc, **facts) -> Measure:
    read = lambda run, sums: root_of_mean(total(_means(run, sums)))
    return _measure("cm", "run", accumulator, read, doc, by_input=True, **facts)


def _scaled(unit, per, accumulator, scale, doc, **facts) -> Measure:
    read = lambda run, sums: _stacked(each(lambda s: s * scale(run), sums))
    return _measure(unit, per, accumulator, read, doc, **facts)


def _summed(accumulator, doc) -> Measure:
    """A volume of each tank."""
    read = lambda run, sums: _stacked(sums)
    return _measure("cm^3", "tank", accumulator, read, doc, by_input=True)


def _sum_of_squares(unit, per, accumulator, scale, doc) -> Measure:
    measure = _scaled(unit, per, accumulator, scale, doc, by_input=True)
    return measure._replace(residual=accumulator, scale=scale)


def _mean_square_change(accumulator, doc, unit="V^2") -> Measure:
    read = lambda run, state: _stacked(state[1]) / run.samples
    measure = _measure(unit, "pump", accumulator, read, doc, by_input=True)
    return measure._replace(residual=accumulator, scale=_mean)


def _of_rows(unit, per, accumulator, entry, doc, **facts) -> Measure:
    """A measure of a state of `rows`: entry(*numbers) of each row."""

    def read(run, state):
        return entry(*state) if run.arrays else _stacked([entry(*row) for row in state])

    return _measure(unit, per, accumulator, read, doc, **facts)


def _first(extreme, time):
    return extreme


def _highest(run, state):
    return state[0] if run.arrays else _stacked([extreme for extreme, _ in state])


def _second(extreme, time):
    return time


def _settling(_, last, outside, worst, pulse):
    worst = jnp.maximum(worst, settled(last, outside))
    return jnp.where(worst < -1e8, jnp.nan, worst)


def _worst_plateau(constant, samples, start, begun, worst, ended):
    """(error, more numbers) of the worst plateau that counts; the last one ends with the run."""
    start = jnp.where(start < 0, 0.0, start)
    _, _, worst = ended_plateau(constant > 0, samples, start, begun, worst, ended)
    alone = worst[0] < 0  # no plateau but the first
    return tuple(jnp.where(alone, *pair) for pair in zip(begun, worst))


def _steady_state_error(setpoint, constant, samples, start, *pairs):
    error, _ = _worst_plateau(constant, samples, start, pairs[:2], pairs[2:4], pairs[4:])
    return jnp.where(error < 0, jnp.nan, error)


def _steady_state_swing(setpoint, constant, samples, start, begun, worst, end, *parts):
    swing = (swing_of(*parts),)
    (largest,) = _worst_plateau(constant, samples, start, (begun,), (worst,), swing)
    return jnp.where(largest < 0, jnp.nan, largest)


def _steady_state_time(setpoint, constant, samples, start, *pairs):
    return _worst_plateau(constant, samples, start, pairs[:2], pairs[2:4], pairs[4:])[1]


def _margin(field, unit, doc, unlimited="", low=0.0, high=None, per="pump", sense=-1.0) -> Measure:
    """A stability margin of the linearised loop: infinite where nothing crosses."""
    return Measure(
        unit,
        per,
        (),
        lambda run, accumulated: getattr(run.margins, field),
        doc,
        low=low,
        high=high,
        sense=sense,
        undefined=(
            "at no plateau of the reference is there a steady state at which the loop can be"
            " linearised; jaxtank.stability_margins says why of each"
        ),
        worst="the linearised loop is unstable at a steady state",
        unlimited=unlimited,
        unserved="the reference holds no setpoints at which the loop could be linearised",
        linear=True,
    )


NO_CHANGES = "the reference has no changes that end"

_BUILT_IN: dict[str, Measure] = {
    "rms_error": _root_mean("cm", "output", "e2", "root mean square tracking error", by_input=True),
    "rms_error_total": _root_mean_total(
        "e2", "root of the mean squared errors of all outputs, summed"
    ),
    "mean_square_error": _sum_of_squares(
        "cm^2", "output", "e2", _mean, "mean square tracking error"
    ),
    "ise": _sum_of_squares(
        "cm^2 s", "output", "lasting_e2", _integral, "integral of the squared error"
    ),
    "iae": _scaled(
        "cm s", "output", "abs_e", _integral, "integral of the absolute error", by_input=True
    ),
    "max_error": _of_rows("cm", "output", "max_error", _first, "largest absolute tracking error"),
    "steady_state_error": _of_rows(
        "cm",
        "output",
        "plateau",
        _steady_state_error,
        "largest absolute error at the end of a plateau of the setpoint; the plateau that a run"
        " begins on its setpoint counts if a later one is no longer than it",
        reached="time_of_steady_state_error",
        undefined="its setpoint is at no time constant",
        nan_holds="its setpoint is at no time constant",
    ),
    "steady_state_swing": _of_rows(
        "cm",
        "output",
        "swing",
        _steady_state_swing,
        "smaller of the largest errors above and below the setpoint, over the last sixth to three"
        " tenths of a plateau",
        undefined="its setpoint is at no time constant",
        nan_holds="its setpoint is at no time constant",
    ),
    "mean_square_overshoot": _sum_of_squares(
        "cm^2",
        "output",
        "past2",
        _mean,
        "mean square of the level past the target of a change, in its direction",
    ),
    "rms_input": _root_mean("V", "pump", "u2", "root mean square input", by_input=True),
    "input_travel": _measure(
        "V",
        "pump",
        "travel",
        lambda run, state: _stacked(state[1]),
        "sum of the absolute changes of the input",
        by_input=True,
    ),
    "mean_square_travel": _mean_square_change(
        "changes2", "mean of the squared changes of the input from sample to sample"
    ),
    "mean_square_jitter": _mean_square_change(
        "jitter2",
        "mean of the squared changes of the input from sample to sample, without the change at a"
        " sample at which a constant setpoint jumps",
    ),
    "mean_square_relative_jitter": _mean_square_change(
        "relative_jitter2",
        "`mean_square_jitter` with the input counted in the range of its pump; 0 without limits",
        "-",
    ),
    "input_deviation": _sum_of_squares(
        "V^2 s",
        "pump",
        "deviation2",
        _integral,
        "integral of the squared distance of the input from the one that holds the setpoint",
    ),
    "saturated_fraction": _scaled(
        "-",
        "pump",
        "outside",
        _mean,
        "share of samples commanded outside the limits",
        high=1.0,
        counts=True,
    ),
    "filter_active_fraction": _measure(
        "-",
        "run",
        "filtered",
        lambda run, count: count / run.samples,
        "share of samples in which the safety filter changed an input",
        high=1.0,
        counts=True,
        unserved="the safety filter is off",
    ),
    "limit_slack": _measure(
        "cm",
        "run",
        "slack",
        lambda run, largest: largest,
        "largest level above a limit in the plans of the controller: above 0, no input keeps it",
        unserved="the controller has no limits of levels",
    ),
    "saturation_excess": _measure(
        "-",
        "run",
        "saturation_excess",
        lambda run, sums: total(sums) / (run.samples * run.pumps),
        "mean of x/(1+x), x = input commanded outside the limits over their span",
        high=1.0,
        by_input=True,
    ),
    "max_level": _of_rows(
        "cm", "tank", "max_level", _first, "highest level", reached="time_of_max_level"
    ),
    "min_level": _of_rows(
        "cm", "tank", "min_level", _first, "lowest level", sense=-1.0, reached="time_of_min_level"
    ),
    "max_over_rim": _measure(
        "cm",
        "tank",
        "max_level",
        lambda run, state: _highest(run, state) - jnp.asarray(run.rim),
        "highest level above the rim; below 0 where none rises past it",
    ),
    "rms_over_rim": _root_mean_total(
        "over_rim2", "root of the mean squared rise past the rims, summed over tanks"
    ),
    "mean_square_over_rim": _sum_of_squares(
        "cm^2", "tank", "over_rim2", _mean, "mean square of the rise past the rim"
    ),
    "overflow_volume": _summed("spilled", "volume lost over the rim"),
    "inflow_shortfall": _summed(
        "shortfall", "volume that a negative inflow could not take from an empty tank"
    ),
    "overshoot_percent": _of_rows(
        "%",
        "output",
        "overshoot",
        lambda share, time: 100.0 * lower_clip(share, 0.0),
        "worst overshoot of a change, in percent of it; not counted within `disturbance.window`"
        " after an inflow pulse",
        undefined="the reference does not change",
        unserved=NO_CHANGES,
    ),
    "rise_time": _of_rows(
        "s",
        "output",
        "rise",
        lambda *state: jnp.where(state[3] > 0, state[3], jnp.nan),
        "longest time from 10 % to 90 % of a change, of those followed so far",
        counts=True,
        undefined="no change of the setpoint was followed to 90 % of its height",
        unserved=NO_CHANGES,
    ),
    "settling_time": _of_rows(
        "s",
        "output",
        "settling",
        _settling,
        "longest time from the end of a change to its last sample outside its band (+-5 % of it); "
        "negative: inside before the change ended; none: never settled; an output that is inside as"
        " an inflow pulse begins may leave the band within `disturbance.window`, until it is back",
        low=None,
        counts=True,
        undefined="the output was outside its band as the setpoint changed again or the run ended",
        unserved=NO_CHANGES,
        nan_holds="no change of its setpoint took the output out of its band",
    ),
    "recovery_time": _of_rows(
        "s",
        "output",
        "recovery",
        lambda last, outside, worst, earlier, now: jnp.maximum(worst, settled(last, outside)),
        "longest time from the start of an inflow pulse to the last sample outside +-5 % of the"
        " setpoint, of those within `disturbance.window`; a pulse that comes before"
        " begins no new one; none: never recovered",
        counts=True,
        undefined="an output was still outside the band when it was watched no longer",
        unserved="this case has no disturbance to recover from",
    ),
    "estimation_rms": _root_mean(
        "cm", "tank", "estimate2", "root mean square error of the level estimate"
    ),
    "time_of_max_level": _of_rows(
        "s", "tank", "max_level", _second, "when the highest level was reached", counts=True
    ),
    "time_of_min_level": _of_rows(
        "s", "tank", "min_level", _second, "when the lowest level was reached", counts=True
    ),
    "time_of_steady_state_error": _of_rows(
        "s",
        "output",
        "plateau",
        _steady_state_time,
        "when the largest error at the end of a plateau occurred",
        counts=True,
    ),
    "sensitivity_peak": _margin(
        "sensitivity_peak",
        "-",
        "Ms of the linearised loop: largest gain of 1/(1 + L), at the pumps",
        low=1.0,  # the mean of log|S| over frequency is at least 0 (Bode), as L is strictly proper
        per="run",
        sense=1.0,
    ),
    "complementary_peak": _margin(
        "complementary_peak",
        "-",
        "Mt of the linearised loop: largest gain of L/(1 + L), at the pumps; large where the loop"
        " is poorly damped",
        per="run",
        sense=1.0,
    ),
    "gain_margin": _margin(
        "gain_margin",
        "-",
        "factor on the loop gain, up or down, that the linearised loop stands",
        "the phase never reaches -180 deg",
        low=1.0,
    ),
    "phase_margin": _margin(
        "phase_margin",
        "deg",
        "change of the phase that the linearised loop stands",
        "the gain never reaches 1",
        high=180.0,
    ),
    "delay_margin": _margin(
        "delay_margin",
        "s",
        "additional dead time that the linearised loop stands",
        "the gain never reaches 1",
    ),
}

SHOWN = (  # measures in the table of a tuning result, in order
    *("rms_error", "rms_error_total", "max_error", "max_level", "min_level", "overshoot_percent"),
    *("settling_time", "rms_input", "input_travel", "saturated_fraction"),
    *("sensitivity_peak", "complementary_peak", "gain_margin", "phase_margin", "delay_margin"),
)
SUMMARY = (  # measures in an ensemble's summary unless others are named, in order
    *("rms_error", "rms_error_total", "max_error", "overshoot_percent", "settling_time"),
    *("max_level", "min_level", "overflow_volume", "rms_input", "input_travel"),
    *("saturated_fraction", "steady_state_error", "steady_state_swing"),
)

TRACKED = ("steady_state_error", "steady_state_swing", "rms_error", "max_level")
TRACKED += ("saturated_fraction",)
"""Measures by which a run is judged on tracking."""


LABELS = {  # {measure: its name for people}, where that is not the name itself
    "rms_error": "RMS error",
    "rms_error_total": "total RMS error",
    "ise": "integral of the squared error",
    "iae": "integral of the absolute error",
    "max_error": "largest error",
    "steady_state_error": "steady-state error",
    "steady_state_swing": "steady-state swing",
    "rms_input": "RMS input",
    "input_travel": "total variation of the input",
    "mean_square_travel": "mean square change of the input",
    "mean_square_jitter": "mean square change of the input between jumps of the setpoints",
    "mean_square_relative_jitter": "mean square change of the input between jumps, in its range",
    "saturated_fraction": "share of saturated samples",
    "filter_active_fraction": "share of filtered samples",
    "saturation_excess": "command beyond the limits",
    "max_level": "highest level",
    "min_level": "lowest level",
    "max_over_rim": "highest level above the rim",
    "rms_over_rim": "RMS rise above the rims",
    "mean_square_over_rim": "mean square rise above the rim",
    "overshoot_percent": "overshoot",
    "estimation_rms": "RMS error of the estimate",
    "sensitivity_peak": "sensitivity peak Ms",
    "complementary_peak": "complementary sensitivity peak Mt",
}


def label(name: str) -> str:
    """Return the name of a measure for people: "highest level" for max_level.

    Examples
    --------
    >>> label("max_level"), label("settling_time")
    ('highest level', 'settling time')
    """
    return LABELS.get(name, name.replace("_", " "))


def _place(name: str, names: tuple[str, ...]) -> int:
    return 10 * (names.index(name) + 1) if name in names else 0


MEASURES: dict[str, Measure] = {
    m: spec._replace(arrays=True, shown=_place(m, SHOWN), summary=_place(m, SUMMARY))
    for m, spec in _BUILT_IN.items()
}
"""{name: Measure}; `register` adds custom ones."""

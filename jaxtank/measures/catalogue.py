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
from jaxtank.measures.accumulators import Run, settled


class Measure(NamedTuple):
    """A named number or list, and all that reports, limits and searches need to know of it.

    `jaxtank.measures.register` adds one of a user's own.

    Examples
    --------
    >>> from jaxtank.measures import MEASURES
    >>> MEASURES["max_level"].unit, MEASURES["max_level"].per, MEASURES["min_level"].sense
    ('cm', 'tank', -1.0)
    """

    unit: str  # with "cm" standing for the rig's length unit and "V" for that of its inputs
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
    nan_holds: str = ""  # what NaN means where a limit holds with it; "": NaN breaks a limit
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


UNSTABLE = "the linearised loop is unstable at a steady state"
NONE_LEFT = (
    "at no plateau of the reference is there a steady state at which the loop can be linearised;"
    " jaxtank.stability_margins says why of each"
)
NOTHING_HELD = "the reference holds no setpoints at which the loop could be linearised"


def _margin(
    field: str, unit: str, doc: str, unlimited: str, shown: int, low: float, high: float | None
) -> Measure:
    """A margin of each pump: larger is better, infinite where nothing crosses."""

    def read(run: Run, accumulated: dict[str, Any]) -> Any:
        return getattr(run.margins, field)

    return Measure(
        unit,
        "pump",
        (),
        read,
        doc,
        low=low,
        high=high,
        sense=-1.0,
        shown=shown,
        undefined=NONE_LEFT,
        worst=UNSTABLE,
        unlimited=unlimited,
        unserved=NOTHING_HELD,
        linear=True,
    )


MARGINS: dict[str, Measure] = {
    "sensitivity_peak": Measure(
        "-",
        "run",
        (),
        lambda run, accumulated: run.margins.sensitivity_peak,
        "Ms of the linearised loop: largest gain of 1/(1 + L), at the pumps",
        low=1.0,  # the mean of log|S| over frequency is at least 0 (Bode), as L is strictly proper
        shown=110,
        undefined=NONE_LEFT,
        worst=UNSTABLE,
        unserved=NOTHING_HELD,
        linear=True,
    ),
    "gain_margin": _margin(
        "gain_margin",
        "-",
        "factor on the loop gain, up or down, that the linearised loop stands",
        "the phase never reaches -180 deg",
        120,
        low=1.0,
        high=None,
    ),
    "phase_margin": _margin(
        "phase_margin",
        "deg",
        "change of the phase that the linearised loop stands",
        "the gain never reaches 1",
        130,
        low=0.0,
        high=180.0,
    ),
    "delay_margin": _margin(
        "delay_margin",
        "s",
        "additional dead time that the linearised loop stands",
        "the gain never reaches 1",
        140,
        low=0.0,
        high=None,
    ),
}
"""{name: Measure}, entries of the catalogue."""


NO_CHANGES = "the reference has no changes that end"


def _stacked(values) -> Any:
    return values if is_array(values) else jnp.stack([jnp.asarray(v) for v in values])


def _means(run, values):
    return each(lambda v: v / run.samples, values)


def _root_mean(name):
    return lambda run, acc: root_of_mean(_stacked(_means(run, acc[name])))


def _mean(run):
    """Factor that makes a mean over the samples of a sum."""
    return 1.0 / run.samples


def _integral(run):
    """Factor that makes an integral over time of a sum."""
    return run.dt


def _scaled(name, scale):
    return lambda run, acc: _stacked(each(lambda s: s * scale(run), acc[name]))


def _sum_of_squares(unit, per, name, scale, doc, read=None):
    """Measure of the accumulator of squares `name`, times scale(run)."""
    return Measure(
        unit,
        per,
        (name,),
        read or _scaled(name, scale),
        doc,
        residual=name,
        scale=scale,
        by_input=True,
    )


def _column(run, state, read) -> Any:
    """The vector of read(*numbers) of a state of `rows`."""
    return read(*state) if run.arrays else _stacked([read(*row) for row in state])


def _extremes(name, index=0):
    return lambda run, acc: _column(run, acc[name], lambda *pair: pair[index])


def _settling(run, acc):
    worst = _column(
        run,
        acc["settling"],
        lambda _, last, outside, worst: jnp.maximum(worst, settled(last, outside)),
    )
    return jnp.where(worst < -1e8, jnp.nan, worst)


def _rise(run, acc):
    longest = _column(run, acc["rise"], lambda *state: state[3])
    return jnp.where(longest > 0, longest, jnp.nan)


def _recovery(run, acc):
    return _column(
        run,
        acc["recovery"],
        lambda last, outside, worst: jnp.maximum(worst, settled(last, outside)),
    )


def _overshoot_percent(run, acc):
    return 100.0 * lower_clip(_extremes("overshoot")(run, acc), 0.0)


_BUILT_IN: dict[str, Measure] = {
    "rms_error": Measure(
        "cm",
        "output",
        ("e2",),
        _root_mean("e2"),
        "root mean square tracking error",
        by_input=True,
        shown=10,
        summary=10,
    ),
    "rms_error_total": Measure(
        "cm",
        "run",
        ("e2",),
        lambda run, acc: root_of_mean(total(_means(run, acc["e2"]))),
        "root of the mean squared errors of all outputs, summed",
        by_input=True,
        shown=20,
        summary=20,
    ),
    "mean_square_error": _sum_of_squares(
        "cm^2", "output", "e2", _mean, "mean square tracking error"
    ),
    "ise": _sum_of_squares(
        "cm^2 s", "output", "lasting_e2", _integral, "integral of the squared error"
    ),
    "iae": Measure(
        "cm s",
        "output",
        ("abs_e",),
        _scaled("abs_e", _integral),
        "integral of the absolute error",
        by_input=True,
    ),
    "max_error": Measure(
        "cm",
        "output",
        ("max_error",),
        _extremes("max_error"),
        "largest absolute tracking error",
        shown=30,
        summary=30,
    ),
    "mean_square_overshoot": _sum_of_squares(
        "cm^2",
        "output",
        "past2",
        _mean,
        "mean square of the level past the target of a change, in its direction",
    ),
    "rms_input": Measure(
        "V",
        "pump",
        ("u2",),
        _root_mean("u2"),
        "root mean square input",
        by_input=True,
        shown=80,
        summary=90,
    ),
    "input_travel": Measure(
        "V",
        "pump",
        ("travel",),
        lambda run, acc: _stacked(acc["travel"][1]),
        "sum of the absolute changes of the input",
        by_input=True,
        shown=90,
        summary=100,
    ),
    "mean_square_travel": _sum_of_squares(
        "V^2",
        "pump",
        "changes2",
        _mean,
        "mean of the squared changes of the input from sample to sample",
        read=lambda run, acc: _stacked(acc["changes2"][1]) / run.samples,
    ),
    "input_deviation": _sum_of_squares(
        "V^2 s",
        "pump",
        "deviation2",
        _integral,
        "integral of the squared distance of the input from the one that holds the setpoint",
    ),
    "saturated_fraction": Measure(
        "-",
        "pump",
        ("outside",),
        _scaled("outside", _mean),
        "share of samples commanded outside the limits",
        high=1.0,
        counts=True,
        shown=100,
        summary=110,
    ),
    "filter_active_fraction": Measure(
        "-",
        "run",
        ("filtered",),
        lambda run, acc: acc["filtered"] / run.samples,
        "share of samples in which the safety filter changed an input",
        high=1.0,
        counts=True,
        unserved="the safety filter is off",
    ),
    "saturation_excess": Measure(
        "-",
        "run",
        ("saturation_excess",),
        lambda run, acc: total(acc["saturation_excess"]) / (run.samples * run.pumps),
        "mean of x/(1+x), x = input commanded outside the limits over their span",
        high=1.0,
        by_input=True,
    ),
    "max_level": Measure(
        "cm",
        "tank",
        ("max_level",),
        _extremes("max_level"),
        "highest level",
        shown=40,
        summary=60,
        reached="time_of_max_level",
    ),
    "min_level": Measure(
        "cm",
        "tank",
        ("min_level",),
        _extremes("min_level"),
        "lowest level",
        sense=-1.0,
        shown=50,
        summary=70,
        reached="time_of_min_level",
    ),
    "rms_over_rim": Measure(
        "cm",
        "run",
        ("over_rim2",),
        lambda run, acc: root_of_mean(total(_means(run, acc["over_rim2"]))),
        "root of the mean squared rise past the rims, summed over tanks",
        by_input=True,
    ),
    "mean_square_over_rim": _sum_of_squares(
        "cm^2", "tank", "over_rim2", _mean, "mean square of the rise past the rim"
    ),
    "overflow_volume": Measure(
        "cm^3",
        "tank",
        ("spilled",),
        lambda run, acc: _stacked(acc["spilled"]),
        "volume lost over the rim",
        by_input=True,
        summary=80,
    ),
    "inflow_shortfall": Measure(
        "cm^3",
        "tank",
        ("shortfall",),
        lambda run, acc: _stacked(acc["shortfall"]),
        "volume that a negative inflow could not take from an empty tank",
        by_input=True,
    ),
    "overshoot_percent": Measure(
        "%",
        "output",
        ("overshoot",),
        _overshoot_percent,
        "worst overshoot of a change, in percent of it",
        shown=60,
        summary=40,
        undefined="the reference does not change",
        unserved=NO_CHANGES,
    ),
    "rise_time": Measure(
        "s",
        "output",
        ("rise",),
        _rise,
        "longest time from 10 % to 90 % of a change, of those followed so far",
        counts=True,
        undefined="no change of the setpoint was followed to 90 % of its height",
        unserved=NO_CHANGES,
    ),
    "settling_time": Measure(
        "s",
        "output",
        ("settling",),
        _settling,
        "longest time from the end of a change to its last sample outside its band (+-5 % of it); "
        "negative: inside before the change ended; none: never settled",
        low=None,
        counts=True,
        shown=70,
        summary=50,
        undefined="the output was outside its band as the setpoint changed again or the run ended",
        unserved=NO_CHANGES,
        nan_holds="no change of its setpoint took the output out of its band",
    ),
    "recovery_time": Measure(
        "s",
        "output",
        ("recovery",),
        _recovery,
        "longest time from the start of an inflow pulse to the last sample outside +-5 % of the"
        " setpoint; none: never recovered",
        counts=True,
        undefined="an output was still outside the band when it was watched no longer",
        unserved="this case has no disturbance to recover from",
    ),
    "estimation_rms": Measure(
        "cm",
        "tank",
        ("estimate2",),
        _root_mean("estimate2"),
        "root mean square error of the level estimate",
    ),
    "time_of_max_level": Measure(
        "s",
        "tank",
        ("max_level",),
        _extremes("max_level", 1),
        "when the highest level was reached",
        counts=True,
    ),
    "time_of_min_level": Measure(
        "s",
        "tank",
        ("min_level",),
        _extremes("min_level", 1),
        "when the lowest level was reached",
        counts=True,
    ),
    **MARGINS,
}

MEASURES: dict[str, Measure] = {m: spec._replace(arrays=True) for m, spec in _BUILT_IN.items()}
"""{name: Measure}; `register` adds those of a user's own."""

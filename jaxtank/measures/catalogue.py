"""What is said of a run in numbers, folded into the time loop: memory does not grow with the number
of samples.

A measure reads accumulators at the end of a run. An accumulator starts from a state, is updated at
every sample, and holds tuples of scalars. Only the accumulators that the requested measures need
are carried.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxtank.core.errors import InputError, unknown
from jaxtank.core.kahan import totals
from jaxtank.core.numerics import lower_clip, root_of_mean
from jaxtank.core.units import DEFAULT, local
from jaxtank.measures.accumulators import (
    ACCUMULATORS,
    RESIDUALS,
    as_list,
    mean,
    recovery,
    root_mean,
    settled,
)


class Measure(NamedTuple):
    """A named number or list: read(run, {accumulator: state}) -> scalar or array."""

    unit: str  # with "cm" standing for the rig's length unit
    per: str  # "run", "output", "tank" or "pump"
    needs: tuple  # names of accumulators
    read: Callable
    doc: str
    windows: bool = False  # needs Ramps.windows: the target and step each sample refers to
    pours: bool = False  # needs Pours.since: the time since the last pour
    rests: bool = False  # needs the inputs that hold the setpoint of each sample
    residual: str = ""  # the residual of RESIDUALS whose squares it sums, if it is such a sum
    scale: Callable | None = None  # run -> factor of that sum
    low: float | None = 0.0  # least and largest value that it can have, None where there is none
    high: float | None = None
    sense: float = 1.0  # +1 where a larger value is worse (limits are upper ones), -1 a smaller
    counts: bool = False  # counts whole samples: a step function of the parameters, no derivative
    by_input: bool = False  # a sum over the run with a slope in every input: `bound` minimises it
    shown: int = 0  # its place in the table of a tuning result; 0: not in it
    summary: int = 0  # its place in an ensemble's summary unless others are named; 0: not in it
    reached: str = ""  # the measure that holds the time at which this one was reached
    undefined: str = "the value is not a finite number"  # why a run has no value of it
    unserved: str = ""  # why a case has none, reported where it is not computed
    nan_holds: str = ""  # what NaN means where a limit holds with it; "": NaN breaks a limit


def _extremes(name, index=0):
    return lambda run, acc: as_list([pair[index] for pair in acc[name]])


def _per_run(name, scale):
    return lambda run, acc: as_list([s * scale(run) for s in acc[name]])


def _settling(run, acc):
    worst = as_list(
        [jnp.maximum(worst, settled(last, outside)) for _, last, outside, worst in acc["settling"]]
    )
    return jnp.where(worst < -1e8, jnp.nan, worst)


def _rise(run, acc):
    longest = as_list([state[3] for state in acc["rise"]])
    return jnp.where(longest > 0, longest, jnp.nan)


def _overshoot_percent(run, acc):
    return 100.0 * lower_clip(_extremes("overshoot")(run, acc), 0.0)


MEASURES = {
    "rms_error": Measure(
        "cm",
        "output",
        ("e2",),
        root_mean("e2"),
        "root mean square tracking error",
        by_input=True,
        shown=10,
        summary=10,
    ),
    "rms_error_total": Measure(
        "cm",
        "run",
        ("e2",),
        lambda run, acc: root_of_mean(sum(mean(run, acc["e2"]))),
        "root of the mean squared errors of all outputs, summed",
        by_input=True,
        shown=20,
        summary=20,
    ),
    "mean_square_error": Measure(
        "cm^2",
        "output",
        ("e2",),
        _per_run("e2", lambda run: 1.0 / run.samples),
        "mean square tracking error",
        residual="e2",
        scale=lambda run: 1.0 / run.samples,
        by_input=True,
    ),
    "ise": Measure(
        "cm^2 s",
        "output",
        ("e2",),
        _per_run("e2", lambda run: run.dt),
        "integral of the squared error",
        residual="e2",
        scale=lambda run: run.dt,
        by_input=True,
    ),
    "iae": Measure(
        "cm s",
        "output",
        ("abs_e",),
        _per_run("abs_e", lambda run: run.dt),
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
    "mean_square_overshoot": Measure(
        "cm^2",
        "output",
        ("past2",),
        _per_run("past2", lambda run: 1.0 / run.samples),
        "mean square of the level past the target of a change, in its direction",
        windows=True,
        residual="past2",
        scale=lambda run: 1.0 / run.samples,
        by_input=True,
    ),
    "rms_input": Measure(
        "V",
        "pump",
        ("u2",),
        root_mean("u2"),
        "root mean square input",
        by_input=True,
        shown=80,
        summary=90,
    ),
    "input_travel": Measure(
        "V",
        "pump",
        ("travel",),
        lambda run, acc: as_list(acc["travel"][1]),
        "sum of the absolute changes of the input",
        by_input=True,
        shown=90,
        summary=100,
    ),
    "mean_square_travel": Measure(
        "V^2",
        "pump",
        ("changes2",),
        lambda run, acc: as_list(acc["changes2"][1]) / run.samples,
        "mean of the squared changes of the input from sample to sample",
        residual="changes2",
        scale=lambda run: 1.0 / run.samples,
        by_input=True,
    ),
    "input_deviation": Measure(
        "V^2 s",
        "pump",
        ("deviation2",),
        _per_run("deviation2", lambda run: run.dt),
        "integral of the squared distance of the input from the one that holds the setpoint",
        rests=True,
        residual="deviation2",
        scale=lambda run: run.dt,
        by_input=True,
    ),
    "saturated_fraction": Measure(
        "-",
        "pump",
        ("outside",),
        _per_run("outside", lambda run: 1.0 / run.samples),
        "share of samples commanded outside the limits",
        high=1.0,
        counts=True,
        shown=100,
        summary=110,
    ),
    "saturation_excess": Measure(
        "-",
        "run",
        ("saturation_excess",),
        lambda run, acc: sum(acc["saturation_excess"]) / (run.samples * run.pumps),
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
        lambda run, acc: root_of_mean(sum(mean(run, acc["over_rim2"]))),
        "root of the mean squared rise past the rims, summed over tanks",
        by_input=True,
    ),
    "mean_square_over_rim": Measure(
        "cm^2",
        "tank",
        ("over_rim2",),
        _per_run("over_rim2", lambda run: 1.0 / run.samples),
        "mean square of the rise past the rim",
        residual="over_rim2",
        scale=lambda run: 1.0 / run.samples,
        by_input=True,
    ),
    "overflow_volume": Measure(
        "cm^3",
        "tank",
        ("spilled",),
        lambda run, acc: as_list(acc["spilled"]),
        "volume lost over the rim",
        by_input=True,
        summary=80,
    ),
    "inflow_shortfall": Measure(
        "cm^3",
        "tank",
        ("shortfall",),
        lambda run, acc: as_list(acc["shortfall"]),
        "volume that a negative inflow could not take from an empty tank",
        by_input=True,
    ),
    "overshoot_percent": Measure(
        "%",
        "output",
        ("overshoot",),
        _overshoot_percent,
        "worst overshoot of a change, in percent of it",
        windows=True,
        shown=60,
        summary=40,
        undefined="the reference does not change",
        unserved="the reference has no changes that end",
    ),
    "rise_time": Measure(
        "s",
        "output",
        ("rise",),
        _rise,
        "longest time from 10 % to 90 % of a change, of those followed so far",
        windows=True,
        counts=True,
        undefined="no change of the setpoint was followed to 90 % of its height",
        unserved="the reference has no changes that end",
    ),
    "settling_time": Measure(
        "s",
        "output",
        ("settling",),
        _settling,
        "longest time from the end of a change to its last sample outside its band (+-5 % of it); "
        "negative: inside before the change ended; none: never settled",
        windows=True,
        low=None,
        counts=True,
        shown=70,
        summary=50,
        undefined="the output was outside its band as the setpoint changed again or the run ended",
        unserved="the reference has no changes that end",
        nan_holds="no change of its setpoint took the output out of its band",
    ),
    "recovery_time": Measure(
        "s",
        "output",
        ("recovery",),
        recovery,
        "longest time from the start of a pour to the last sample outside +-5 % of the setpoint;"
        " none: never recovered",
        pours=True,
        counts=True,
        undefined="an output was still outside the band when it was watched no longer",
        unserved="this case has no disturbance to recover from",
    ),
    "estimation_rms": Measure(
        "cm",
        "tank",
        ("estimate2",),
        root_mean("estimate2"),
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
}

TIMES = {m: spec.reached for m, spec in MEASURES.items() if spec.reached}
"""Measures that say when another one was reached: not reported by themselves."""

SQUARES = tuple(m for m, spec in MEASURES.items() if spec.residual)
"""Measures that are sums of squares over the run."""


def register(name, measure, accumulators=None):
    """Add a measure of one's own, known by `name` wherever measures are named from then on.

    Parameters
    ----------
    name : a name that no other measure has
    measure : Measure
    accumulators : {name: Accumulator}, what it needs besides ACCUMULATORS

    Raises
    ------
    InputError
        For a name that another measure or accumulator has.
    """
    for known, added in ((MEASURES, {name: measure}), (ACCUMULATORS, accumulators or {})):
        for key, value in added.items():
            if known.get(key, value) is not value:
                raise InputError(f"{key!r} is taken: choose another name")
        known.update(added)
    return measure


def check_names(names):
    """Raise InputError for a name that is no measure."""
    for name in names:
        if name not in MEASURES:
            raise unknown("measure", name, MEASURES)


def reported():
    """Return the names of the measures in a result: all but the times of others."""
    return tuple(m for m in MEASURES if m not in TIMES.values())


def placed(field):
    """Return the names of the measures with a place in `field`, "shown" or "summary", in order."""
    found = {m: getattr(spec, field) for m, spec in MEASURES.items()}
    return tuple(sorted((m for m in found if found[m]), key=lambda m: found[m]))


def unit(name, units=DEFAULT):
    """Unit of measure `name` on a rig with these (length, pump input) units."""
    return local(MEASURES[name].unit, units)


def entries(name, plant):
    """Number of entries of measure `name` for a plant: 1, or one per output, tank or pump."""
    return {"run": 1, "output": len(plant.outputs), "tank": plant.tanks, "pump": plant.pumps}[
        MEASURES[name].per
    ]


def needs(names):
    """The accumulators that `names` need, in a fixed order."""
    wanted = {a for name in names for a in MEASURES[name].needs}
    return tuple(a for a in ACCUMULATORS if a in wanted)


def wants_windows(names):
    """True if a measure in `names` refers to the reference's changes."""
    return any(MEASURES[name].windows for name in names)


def wants_pours(names):
    """True if a measure in `names` refers to pours."""
    return any(MEASURES[name].pours for name in names)


def wants_rests(names):
    """True if a measure in `names` refers to the inputs that hold the setpoint."""
    return any(MEASURES[name].rests for name in names)


def serves(name, loop):
    """True if the measure `name` means something for this loop: its reference changes, its tanks
    are poured into, its steady inputs are known in closed form, its levels have a lower clip.
    """
    spec = MEASURES[name]
    if spec.rests and (
        getattr(loop.plant, "pipes", None) != () or loop.plant.pumps != len(loop.plant.outputs)
    ):
        return False
    if "shortfall" in spec.needs and not loop.plant.bottom:
        return False
    onset = None if loop.disturbance is None else loop.disturbance.onset
    return (not spec.windows or loop.reference.changes is not None) and (
        not spec.pours or onset is not None
    )


def start(run, names):
    """{accumulator: state} before the first sample."""
    return {a: ACCUMULATORS[a].start(run) for a in needs(names)}


def update(run, states, sample, window, since=None, rest=None):
    """{accumulator: state} after `sample`."""
    known = {"recovery": since, "deviation2": rest}
    return {
        a: ACCUMULATORS[a].update(run, state, sample, known.get(a, window))
        for a, state in states.items()
    }


def residuals(run, states, sample, window, rest, squares):
    """The residuals of one sample, a flat tuple. squares: ((measure, weight), ...), each a sum of
    squares (`Measure.residual`).
    """
    return tuple(
        v
        for m, _ in squares
        for a in [MEASURES[m].residual]
        for v in RESIDUALS[a](run, states[a], sample, window, rest)
    )


def _scale(measure) -> Any:
    return MEASURES[measure].scale  # of a measure that is a sum of squares: never None


def residual_weights(run, squares):
    """What the square of each of `residuals` counts in the weighted sum of the measures."""
    counts = {"output": run.outputs, "tank": run.tanks, "pump": run.pumps}
    return tuple(w * _scale(m)(run) for m, w in squares for _ in range(counts[MEASURES[m].per]))


def read(run, states, names):
    """{measure: value} at the end of a run."""
    states = totals(states)
    return {name: MEASURES[name].read(run, states) for name in names}

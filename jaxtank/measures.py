"""What is said of a run in numbers, folded into the time loop: memory does not grow with the number of samples.

A measure reads accumulators at the end of a run. An accumulator starts from a state, is updated at every sample, and holds tuples of
scalars. Only the accumulators that the requested measures need are carried.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxtank.core.errors import unknown
from jaxtank.core.kahan import nothing, plus, totals
from jaxtank.core.numerics import at_least, magnitude, root_of_mean
from jaxtank.core.units import DEFAULT, local

BAND = 0.05
"""Half width of the recovery band, as a share of the setpoint [-]."""


class Run(NamedTuple):
    """Sizes and constants of a run, for accumulators and measures."""

    tanks: int
    outputs: int
    pumps: int
    samples: int
    dt: float  # [s]
    low: tuple  # lower limit of each pump [V]
    high: tuple  # upper limit of each pump [V]
    rim: tuple  # rim of each tank [cm]
    zero: Any  # 0.0 of the run's type


class Accumulator(NamedTuple):
    """start(run) -> state; update(run, state, sample, window) -> state, at every sample; window: of the setpoint's changes, or, for
    `recovery`, the time since the last pour."""

    start: Callable
    update: Callable


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


def _filled(run, count, value):
    return (run.zero + value,) * count


def _sums(run, count):
    return (nothing(run.zero),) * count


def _sum(size, term):
    """Accumulator of sums over the run: `term(run, sample)` gives one number per output, tank or pump."""

    def update(run, state, sample, window):
        return tuple(plus(s, v) for s, v in zip(state, term(run, sample)))

    return Accumulator(lambda run: _sums(run, size(run)), update)


def _extreme(size, pick, better, worst):
    """Accumulator of (extreme, time it was reached), one pair per output, tank or pump; the first sample wins a tie."""

    def update(run, state, sample, window):
        new = []
        for (value, time), v in zip(state, pick(run, sample, window)):
            take = better(v, value)
            new.append((jnp.where(take, v, value), jnp.where(take, sample.t, time)))
        return tuple(new)

    return Accumulator(lambda run: tuple((run.zero + worst, run.zero) for _ in range(size(run))), update)


def _excess(run, command):
    """How far a command is outside its limits [V], 0 inside."""
    return tuple(
        jnp.where(v > high, v - high, jnp.where(v < low, low - v, 0.0)) for v, low, high in zip(command, run.low, run.high)
    )


def _saturation_excess(run, sample):
    # x/(1+x) of x = excess / span: gouta2015 notes S10; bounded, so that one wild sample does not rule a cost
    span = tuple(high - low for low, high in zip(run.low, run.high))
    return tuple(x / (s + x) for x, s in zip(_excess(run, sample.command), span))


def _outside(run, sample):
    return tuple(jnp.where((v < low) | (v > high), 1.0, 0.0) for v, low, high in zip(sample.command, run.low, run.high))


def _overshoot(run, sample, window):
    """Level past the target in the direction of the step, as a share of the step [-]; -1 where there is no step yet."""
    return tuple(
        jnp.where(step == 0.0, -1.0, (r + e - target) / jnp.where(step == 0.0, 1.0, step))
        for (target, step, _, _), r, e in zip(window, sample.r, sample.e)
    )


def _start_settling(run):
    return tuple((run.zero, run.zero - 1e9, run.zero, run.zero - 1e9) for _ in range(run.outputs))


def _update_settling(run, state, sample, window):
    """Per output (target now, time since its change ended at the last sample outside the band [s], 1 if still outside, worst so far)."""
    new = []
    for (old, last, outside, worst), (target, step, since, band), r, e in zip(state, window, sample.r, sample.e):
        worst = jnp.where((target != old) & (_settled(last, outside) > worst), _settled(last, outside), worst)
        last = jnp.where(target != old, -1e9, last)
        out = (step != 0.0) & (jnp.abs(r + e - target) > band)
        new.append((target, jnp.where(out, since, last), jnp.where(out, 1.0, 0.0), worst))
    return tuple(new)


def _settled(last, outside):
    """Settling time of a change that is over: infinite if its last sample was outside the band."""
    return jnp.where(outside > 0, jnp.inf, last)


def _start_rise(run):
    return tuple((run.zero, run.zero - 1.0, run.zero - 1.0, run.zero) for _ in range(run.outputs))


def _update_rise(run, state, sample, window):
    """Per output (target now, time of the first 10 %, time of the first 90 %, longest rise so far)."""
    new = []
    for (old, t10, t90, longest), (target, step, _, _), r, e in zip(state, window, sample.r, sample.e):
        fresh = target != old
        t10, t90 = jnp.where(fresh, -1.0, t10), jnp.where(fresh, -1.0, t90)
        done = jnp.where(step == 0.0, 0.0, 1.0 + (r + e - target) / jnp.where(step == 0.0, 1.0, step))
        t10 = jnp.where((t10 < 0) & (done >= 0.1), sample.t, t10)
        reached = (t90 < 0) & (done >= 0.9)
        t90 = jnp.where(reached, sample.t, t90)
        longest = jnp.where(reached & (sample.t - t10 > longest), sample.t - t10, longest)
        new.append((target, t10, t90, longest))
    return tuple(new)


def _update_recovery(run, state, sample, since):
    """Per output (time since the pour at the last sample outside the band [s], 1 if that was the last one watched, worst so far)."""
    new = []
    for (last, outside, worst), r, e in zip(state, sample.r, sample.e):
        fresh = since < last
        done = _settled(last, outside)
        worst = jnp.where(fresh & (done > worst), done, worst)
        out, watched = jnp.abs(e) > BAND * jnp.abs(r), since >= 0.0
        last = jnp.where(watched, jnp.where(out, since, jnp.where(fresh, 0.0, last)), last)
        new.append((last, jnp.where(watched, jnp.where(out, 1.0, 0.0), outside), worst))
    return tuple(new)


def _recovery(run, acc):
    return _list([jnp.maximum(worst, _settled(last, outside)) for last, outside, worst in acc["recovery"]])


def _deviation(run, sample, rest):
    return tuple(u - held for u, held in zip(sample.u, rest))


def _past(sample, window):
    """Level past the target in the direction of the step [cm], one per output; 0 before the first step."""
    return tuple(
        at_least(jnp.where(step > 0, r + e - target, jnp.where(step < 0, target - r - e, 0.0)), 0.0)
        for (target, step, _, _), r, e in zip(window, sample.r, sample.e)
    )


def _update_past(run, state, sample, window):
    return tuple(plus(s, v * v) for s, v in zip(state, _past(sample, window)))


def _update_deviation(run, state, sample, rest):
    return tuple(plus(s, d * d) for s, d in zip(state, _deviation(run, sample, rest)))


def _over_rim(run, sample):
    """Rise past the rim [cm], one per tank."""
    return tuple(at_least(x - h, 0.0) for x, h in zip(sample.x, run.rim))


def _changes(state, sample):
    """Changes of the inputs since the last sample; 0 at the first."""
    previous, _, first = state
    return tuple(jnp.where(first, 0.0, v - p) for v, p in zip(sample.u, previous))


def _update_changes(run, state, sample, window):
    return sample.u, tuple(plus(s, d * d) for s, d in zip(state[1], _changes(state, sample))), jnp.zeros_like(state[2])


def _start_travel(run):
    return _filled(run, run.pumps, 0.0), _sums(run, run.pumps), run.zero == 0.0


def _update_travel(run, state, sample, window):
    previous, total, first = state
    step = tuple(magnitude(v - p) for v, p in zip(sample.u, previous))
    return sample.u, tuple(plus(s, jnp.where(first, 0.0, d)) for s, d in zip(total, step)), jnp.zeros_like(first)


ACCUMULATORS = {
    "e2": _sum(lambda run: run.outputs, lambda run, s: tuple(e * e for e in s.e)),
    "abs_e": _sum(lambda run: run.outputs, lambda run, s: tuple(magnitude(e) for e in s.e)),
    "u2": _sum(lambda run: run.pumps, lambda run, s: tuple(u * u for u in s.u)),
    "estimate2": _sum(lambda run: run.tanks, lambda run, s: tuple((a - b) * (a - b) for a, b in zip(s.x_hat, s.x))),
    "outside": _sum(lambda run: run.pumps, _outside),
    "saturation_excess": _sum(lambda run: run.pumps, _saturation_excess),
    "over_rim2": _sum(lambda run: run.tanks, lambda run, s: tuple(v * v for v in _over_rim(run, s))),
    "spilled": _sum(lambda run: run.tanks, lambda run, s: s.spilled),
    "shortfall": _sum(lambda run: run.tanks, lambda run, s: s.shortfall),
    "max_level": _extreme(lambda run: run.tanks, lambda run, s, w: s.x, lambda a, b: a > b, -jnp.inf),
    "min_level": _extreme(lambda run: run.tanks, lambda run, s, w: s.x, lambda a, b: a < b, jnp.inf),
    "max_error": _extreme(
        lambda run: run.outputs, lambda run, s, w: tuple(magnitude(e) for e in s.e), lambda a, b: a > b, -jnp.inf
    ),
    "overshoot": _extreme(lambda run: run.outputs, _overshoot, lambda a, b: a > b, -1.0),
    "settling": Accumulator(_start_settling, _update_settling),
    "rise": Accumulator(_start_rise, _update_rise),
    "recovery": Accumulator(lambda run: tuple((run.zero, run.zero, run.zero) for _ in range(run.outputs)), _update_recovery),
    "past2": Accumulator(lambda run: _sums(run, run.outputs), _update_past),
    "deviation2": Accumulator(lambda run: _sums(run, run.pumps), _update_deviation),
    "travel": Accumulator(_start_travel, _update_travel),
    "changes2": Accumulator(_start_travel, _update_changes),
}

RESIDUALS = {
    "e2": lambda run, state, sample, window, rest: sample.e,
    "past2": lambda run, state, sample, window, rest: _past(sample, window),
    "deviation2": lambda run, state, sample, window, rest: _deviation(run, sample, rest),
    "changes2": lambda run, state, sample, window, rest: _changes(state, sample),
    "over_rim2": lambda run, state, sample, window, rest: _over_rim(run, sample),
}
"""{accumulator: (run, its state, sample, window, rest) -> the numbers whose squares it sums at this sample}: what Gauss-Newton works on."""


def _mean(run, values):
    return tuple(v / run.samples for v in values)


def _list(values):
    return jnp.stack([jnp.asarray(v) for v in values])


def _root_mean(name):
    return lambda run, acc: root_of_mean(_list(_mean(run, acc[name])))


def _extremes(name, index=0):
    return lambda run, acc: _list([pair[index] for pair in acc[name]])


def _per_run(name, scale):
    return lambda run, acc: _list([s * scale(run) for s in acc[name]])


def _settling(run, acc):
    worst = _list([jnp.maximum(worst, _settled(last, outside)) for _, last, outside, worst in acc["settling"]])
    return jnp.where(worst < -1e8, jnp.nan, worst)


def _rise(run, acc):
    longest = _list([state[3] for state in acc["rise"]])
    return jnp.where(longest > 0, longest, jnp.nan)


def _overshoot_percent(run, acc):
    return 100.0 * at_least(_extremes("overshoot")(run, acc), 0.0)


MEASURES = {
    "rms_error": Measure("cm", "output", ("e2",), _root_mean("e2"), "root mean square tracking error"),
    "rms_error_total": Measure(
        "cm",
        "run",
        ("e2",),
        lambda run, acc: root_of_mean(sum(_mean(run, acc["e2"]))),
        "root of the mean squared errors of all outputs, summed",
    ),
    "mean_square_error": Measure(
        "cm^2",
        "output",
        ("e2",),
        _per_run("e2", lambda run: 1.0 / run.samples),
        "mean square tracking error",
        residual="e2",
        scale=lambda run: 1.0 / run.samples,
    ),
    "ise": Measure(
        "cm^2 s",
        "output",
        ("e2",),
        _per_run("e2", lambda run: run.dt),
        "integral of the squared error",
        residual="e2",
        scale=lambda run: run.dt,
    ),
    "iae": Measure("cm s", "output", ("abs_e",), _per_run("abs_e", lambda run: run.dt), "integral of the absolute error"),
    "max_error": Measure("cm", "output", ("max_error",), _extremes("max_error"), "largest absolute tracking error"),
    "mean_square_overshoot": Measure(
        "cm^2",
        "output",
        ("past2",),
        _per_run("past2", lambda run: 1.0 / run.samples),
        "mean square of the level past the target of a change, in its direction",
        windows=True,
        residual="past2",
        scale=lambda run: 1.0 / run.samples,
    ),
    "rms_input": Measure("V", "pump", ("u2",), _root_mean("u2"), "root mean square input"),
    "input_travel": Measure(
        "V",
        "pump",
        ("travel",),
        lambda run, acc: _list(acc["travel"][1]),
        "sum of the absolute changes of the input",
    ),
    "mean_square_travel": Measure(
        "V^2",
        "pump",
        ("changes2",),
        lambda run, acc: _list(acc["changes2"][1]) / run.samples,
        "mean of the squared changes of the input from sample to sample",
        residual="changes2",
        scale=lambda run: 1.0 / run.samples,
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
    ),
    "saturated_fraction": Measure(
        "-",
        "pump",
        ("outside",),
        _per_run("outside", lambda run: 1.0 / run.samples),
        "share of samples commanded outside the limits",
        high=1.0,
    ),
    "saturation_excess": Measure(
        "-",
        "run",
        ("saturation_excess",),
        lambda run, acc: sum(acc["saturation_excess"]) / (run.samples * run.pumps),
        "mean of x/(1+x), x = input commanded outside the limits over their span",
        high=1.0,
    ),
    "max_level": Measure("cm", "tank", ("max_level",), _extremes("max_level"), "highest level"),
    "min_level": Measure("cm", "tank", ("min_level",), _extremes("min_level"), "lowest level"),
    "rms_over_rim": Measure(
        "cm",
        "run",
        ("over_rim2",),
        lambda run, acc: root_of_mean(sum(_mean(run, acc["over_rim2"]))),
        "root of the mean squared rise past the rims, summed over tanks",
    ),
    "mean_square_over_rim": Measure(
        "cm^2",
        "tank",
        ("over_rim2",),
        _per_run("over_rim2", lambda run: 1.0 / run.samples),
        "mean square of the rise past the rim",
        residual="over_rim2",
        scale=lambda run: 1.0 / run.samples,
    ),
    "overflow_volume": Measure("cm^3", "tank", ("spilled",), lambda run, acc: _list(acc["spilled"]), "volume lost over the rim"),
    "inflow_shortfall": Measure(
        "cm^3",
        "tank",
        ("shortfall",),
        lambda run, acc: _list(acc["shortfall"]),
        "volume that a negative inflow could not take from an empty tank",
    ),
    "overshoot_percent": Measure(
        "%", "output", ("overshoot",), _overshoot_percent, "worst overshoot of a change, in percent of it", windows=True
    ),
    "rise_time": Measure(
        "s", "output", ("rise",), _rise, "longest time from 10 % to 90 % of a change, of those followed so far", windows=True
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
    ),
    "recovery_time": Measure(
        "s",
        "output",
        ("recovery",),
        _recovery,
        "longest time from the start of a pour to the last sample outside +-5 % of the setpoint; none: never recovered",
        pours=True,
    ),
    "estimation_rms": Measure(
        "cm", "tank", ("estimate2",), _root_mean("estimate2"), "root mean square error of the level estimate"
    ),
    "time_of_max_level": Measure("s", "tank", ("max_level",), _extremes("max_level", 1), "when the highest level was reached"),
    "time_of_min_level": Measure("s", "tank", ("min_level",), _extremes("min_level", 1), "when the lowest level was reached"),
}

TIMES = {"max_level": "time_of_max_level", "min_level": "time_of_min_level"}
"""Measures that say when another one was reached: not reported by themselves."""

SQUARES = tuple(m for m, spec in MEASURES.items() if spec.residual)
"""Measures that are sums of squares over the run."""


def check_names(names):
    """Raise InputError for a name that is no measure."""
    for name in names:
        if name not in MEASURES:
            raise unknown("measure", name, MEASURES)


def unit(name, units=DEFAULT):
    """Unit of measure `name` on a rig with these (length, pump input) units."""
    return local(MEASURES[name].unit, units)


def entries(name, plant):
    """Number of entries of measure `name` for a plant: 1, or one per output, tank or pump."""
    return {"run": 1, "output": len(plant.outputs), "tank": plant.tanks, "pump": plant.pumps}[MEASURES[name].per]


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
    """True if the measure `name` means something for this loop: its reference changes, its tanks are poured into, its steady inputs
    are known in closed form, its levels have a lower clip."""
    spec = MEASURES[name]
    if spec.rests and (getattr(loop.plant, "pipes", None) != () or loop.plant.pumps != len(loop.plant.outputs)):
        return False
    if "shortfall" in spec.needs and not loop.plant.bottom:
        return False
    return (not spec.windows or hasattr(loop.reference, "windows")) and (not spec.pours or hasattr(loop.disturbance, "since"))


def start(run, names):
    """{accumulator: state} before the first sample."""
    return {a: ACCUMULATORS[a].start(run) for a in needs(names)}


def update(run, states, sample, window, since=None, rest=None):
    """{accumulator: state} after `sample`."""
    known = {"recovery": since, "deviation2": rest}
    return {a: ACCUMULATORS[a].update(run, state, sample, known.get(a, window)) for a, state in states.items()}


def residuals(run, states, sample, window, rest, squares):
    """The residuals of one sample, a flat tuple. squares: ((measure, weight), ...), each a sum of squares (`Measure.residual`)."""
    return tuple(v for m, _ in squares for a in [MEASURES[m].residual] for v in RESIDUALS[a](run, states[a], sample, window, rest))


def residual_weights(run, squares):
    """What the square of each of `residuals` counts in the weighted sum of the measures."""
    counts = {"output": run.outputs, "tank": run.tanks, "pump": run.pumps}
    return tuple(w * MEASURES[m].scale(run) for m, w in squares for _ in range(counts[MEASURES[m].per]))


def read(run, states, names):
    """{measure: value} at the end of a run."""
    states = totals(states)
    return {name: MEASURES[name].read(run, states) for name in names}

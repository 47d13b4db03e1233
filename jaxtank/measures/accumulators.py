"""What the time loop carries for each measure: running sums, extremes and times.

`measures.catalogue` names what it reads of them. May import `jaxtank.core` only.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxtank.core.kahan import nothing, plus
from jaxtank.core.numerics import lower_clip, magnitude
from jaxtank.core.records import Sample

BAND = 0.05
"""Half width of the recovery band, as a share of the setpoint [-]."""


class Run(NamedTuple):
    """Sizes and constants of a run, for accumulators and measures."""

    tanks: int
    outputs: int
    pumps: int
    samples: int
    dt: float  # [s]
    low: tuple[Any, ...]  # lower limit of each pump [V]
    high: tuple[Any, ...]  # upper limit of each pump [V]
    rim: tuple[Any, ...]  # rim of each tank [cm]
    zero: Any  # 0.0 of the run's type
    margins: Any = None  # Worst margins of the linearised loop, where a measure reads them


class Worst(NamedTuple):
    """The worst stability margins of all steady states of a loop."""

    sensitivity_peak: Any  # Ms [-]
    gain_margin: Any  # (m,) [-]
    phase_margin: Any  # (m,) [deg]
    delay_margin: Any  # (m,) [s]


class Context(NamedTuple):
    """What an accumulator may refer to besides the sample; None where no measure of a run does."""

    # of the last setpoint change of each output: (target [cm], step [cm], time since its end [s],
    # half width of its band [cm]); step 0 before the first
    window: Any = None
    since: Any = None  # time since the last inflow pulse began [s], negative before the first
    steady: Any = None  # (m) inputs that hold the setpoint [V]


class Accumulator(NamedTuple):
    """A running quantity: start(run) gives its state before the first sample, update(run, state,
    sample, context) its state after each.

    refers_to: the field of `Context` that it reads, "" for none; residual(run, state, sample,
    context): of a sum of squares, the numbers whose squares it adds at this sample, which is what
    the Gauss-Newton matrix is made of.

    Examples
    --------
    The largest rate of change of the first input, which `jaxtank.measures.register` takes:

    >>> import jax.numpy as jnp
    >>> from jaxtank.measures import Accumulator
    >>> def update(run, state, sample, context):
    ...     before, largest = state
    ...     rate = jnp.abs(sample.u[0] - before) / run.dt
    ...     return sample.u[0], jnp.maximum(largest, rate)
    >>> fastest = Accumulator(lambda run: (run.zero, run.zero), update)
    """

    start: Callable[[Run], Any]
    update: Callable[[Run, Any, Sample, Context], Any]
    refers_to: str = ""
    residual: Callable[[Run, Any, Sample, Context], tuple[Any, ...]] | None = None


def _sums(run, size):
    """Empty sums, one per output, tank or pump."""
    return (nothing(run.zero),) * getattr(run, size)


def _sum(size, term):
    """Accumulator of sums over the run: `term(run, sample)` gives one number for each of `size`,
    "outputs", "tanks" or "pumps".
    """

    def update(run, state, sample, context):
        return tuple(plus(s, v) for s, v in zip(state, term(run, sample)))

    return Accumulator(lambda run: _sums(run, size), update)


def _sum_of_squares(size, term, refers_to=""):
    """Accumulator of sums of the squares of the numbers that `term(run, sample, context)` gives."""

    def update(run, state, sample, context):
        return tuple(plus(s, v * v) for s, v in zip(state, term(run, sample, context)))

    return Accumulator(
        lambda run: _sums(run, size),
        update,
        refers_to,
        lambda run, state, sample, context: tuple(term(run, sample, context)),
    )


def _extreme(size, pick, better, worst, refers_to=""):
    """Accumulator of (extreme, time it was reached), one pair for each of `size`; the first sample
    wins a tie.
    """

    def update(run, state, sample, context):
        new = []
        for (value, time), v in zip(state, pick(sample, context)):
            take = better(v, value)
            new.append((jnp.where(take, v, value), jnp.where(take, sample.t, time)))
        return tuple(new)

    return Accumulator(
        lambda run: tuple((run.zero + worst, run.zero) for _ in range(getattr(run, size))),
        update,
        refers_to,
    )


def _excess(run, command):
    """How far a command is outside its limits [V], 0 inside."""
    return tuple(
        jnp.where(v > high, v - high, jnp.where(v < low, low - v, 0.0))
        for v, low, high in zip(command, run.low, run.high)
    )


def _saturation_excess(run, sample):
    # x/(1+x) of x = excess / span: gouta2015 notes S10; bounded, so that one outlier does not
    # dominate a cost
    span = tuple(high - low for low, high in zip(run.low, run.high))
    return tuple(x / (s + x) for x, s in zip(_excess(run, sample.command), span))


def _outside(run, sample):
    return tuple(
        jnp.where((v < low) | (v > high), 1.0, 0.0)
        for v, low, high in zip(sample.command, run.low, run.high)
    )


def _overshoot(sample, context):
    """Level past the target in the direction of the step, as a share of the step [-]; -1 where
    there is no step yet.
    """
    return tuple(
        jnp.where(step == 0.0, -1.0, (r + e - target) / jnp.where(step == 0.0, 1.0, step))
        for (target, step, _, _), r, e in zip(context.window, sample.r, sample.e)
    )


def _start_settling(run):
    return tuple((run.zero, run.zero - 1e9, run.zero, run.zero - 1e9) for _ in range(run.outputs))


def _update_settling(run, state, sample, context):
    """Per output (target now, time since its change ended at the last sample outside the band [s],
    1 if still outside, worst so far).
    """
    new = []
    for (old, last, outside, worst), (target, step, since, band), r, e in zip(
        state, context.window, sample.r, sample.e
    ):
        worst = jnp.where(
            (target != old) & (settled(last, outside) > worst), settled(last, outside), worst
        )
        last = jnp.where(target != old, -1e9, last)
        out = (step != 0.0) & (jnp.abs(r + e - target) > band)
        new.append((target, jnp.where(out, since, last), jnp.where(out, 1.0, 0.0), worst))
    return tuple(new)


def settled(last, outside):
    """Settling time of a change that is over: infinite if its last sample was outside the band."""
    return jnp.where(outside > 0, jnp.inf, last)


def _start_rise(run):
    return tuple((run.zero, run.zero - 1.0, run.zero - 1.0, run.zero) for _ in range(run.outputs))


def _update_rise(run, state, sample, context):
    """Per output (target now, time of the first 10 %, that of the first 90 %, longest rise)."""
    new = []
    for (old, t10, t90, longest), (target, step, _, _), r, e in zip(
        state, context.window, sample.r, sample.e
    ):
        fresh = target != old
        t10, t90 = jnp.where(fresh, -1.0, t10), jnp.where(fresh, -1.0, t90)
        done = jnp.where(
            step == 0.0, 0.0, 1.0 + (r + e - target) / jnp.where(step == 0.0, 1.0, step)
        )
        t10 = jnp.where((t10 < 0) & (done >= 0.1), sample.t, t10)
        reached = (t90 < 0) & (done >= 0.9)
        t90 = jnp.where(reached, sample.t, t90)
        longest = jnp.where(reached & (sample.t - t10 > longest), sample.t - t10, longest)
        new.append((target, t10, t90, longest))
    return tuple(new)


def _update_recovery(run, state, sample, context):
    """Per output (time since the inflow pulse at the last sample outside the band [s], 1 if that
    was the last one watched, worst so far).
    """
    new, since = [], context.since
    for (last, outside, worst), r, e in zip(state, sample.r, sample.e):
        fresh = since < last
        done = settled(last, outside)
        worst = jnp.where(fresh & (done > worst), done, worst)
        out, watched = jnp.abs(e) > BAND * jnp.abs(r), since >= 0.0
        last = jnp.where(watched, jnp.where(out, since, jnp.where(fresh, 0.0, last)), last)
        new.append((last, jnp.where(watched, jnp.where(out, 1.0, 0.0), outside), worst))
    return tuple(new)


def _deviation(run, sample, context):
    """Distance of each input from the one that holds the setpoint [V]."""
    return tuple(u - held for u, held in zip(sample.u, context.steady))


def _past(run, sample, context):
    """Level past the target in the direction of the step [cm], one per output; 0 before the first
    step.
    """
    return tuple(
        lower_clip(
            jnp.where(step > 0, r + e - target, jnp.where(step < 0, target - r - e, 0.0)), 0.0
        )
        for (target, step, _, _), r, e in zip(context.window, sample.r, sample.e)
    )


def _over_rim(run, sample, context):
    """Rise past the rim [cm], one per tank."""
    return tuple(lower_clip(x - h, 0.0) for x, h in zip(sample.x, run.rim))


def _estimation_error(run, sample):
    return tuple((a - b) * (a - b) for a, b in zip(sample.x_hat, sample.x))


def _changes(state, sample):
    """Changes of the inputs since the last sample; 0 at the first."""
    previous, _, first = state
    return tuple(jnp.where(first, 0.0, v - p) for v, p in zip(sample.u, previous))


def _update_changes(run, state, sample, context):
    return (
        sample.u,
        tuple(plus(s, d * d) for s, d in zip(state[1], _changes(state, sample))),
        jnp.zeros_like(state[2]),
    )


def _start_travel(run):
    return (run.zero + 0.0,) * run.pumps, _sums(run, "pumps"), run.zero == 0.0


def _update_travel(run, state, sample, context):
    previous, total, first = state
    step = tuple(magnitude(v - p) for v, p in zip(sample.u, previous))
    return (
        sample.u,
        tuple(plus(s, jnp.where(first, 0.0, d)) for s, d in zip(total, step)),
        jnp.zeros_like(first),
    )


ACCUMULATORS: dict[str, Accumulator] = {
    "e2": _sum_of_squares("outputs", lambda run, s, context: s.e),
    "abs_e": _sum("outputs", lambda run, s: tuple(magnitude(e) for e in s.e)),
    "u2": _sum("pumps", lambda run, s: tuple(u * u for u in s.u)),
    "estimate2": _sum("tanks", _estimation_error),
    "outside": _sum("pumps", _outside),
    "saturation_excess": _sum("pumps", _saturation_excess),
    "filtered": Accumulator(
        lambda run: nothing(run.zero),
        lambda run, state, sample, context: plus(state, sample.filtered),
    ),
    "over_rim2": _sum_of_squares("tanks", _over_rim),
    "spilled": _sum("tanks", lambda run, s: s.spilled),
    "shortfall": _sum("tanks", lambda run, s: s.shortfall),
    "max_level": _extreme("tanks", lambda s, context: s.x, lambda a, b: a > b, -jnp.inf),
    "min_level": _extreme("tanks", lambda s, context: s.x, lambda a, b: a < b, jnp.inf),
    "max_error": _extreme(
        "outputs", lambda s, context: tuple(magnitude(e) for e in s.e), lambda a, b: a > b, -jnp.inf
    ),
    "overshoot": _extreme("outputs", _overshoot, lambda a, b: a > b, -1.0, "window"),
    "settling": Accumulator(_start_settling, _update_settling, "window"),
    "rise": Accumulator(_start_rise, _update_rise, "window"),
    "recovery": Accumulator(
        lambda run: ((run.zero, run.zero, run.zero),) * run.outputs, _update_recovery, "since"
    ),
    "past2": _sum_of_squares("outputs", _past, "window"),
    "deviation2": _sum_of_squares("pumps", _deviation, "steady"),
    "travel": Accumulator(_start_travel, _update_travel),
    "changes2": Accumulator(
        _start_travel,
        _update_changes,
        residual=lambda run, state, sample, context: _changes(state, sample),
    ),
}
"""{name: Accumulator}; `jaxtank.measures.register` adds those of a user's own."""

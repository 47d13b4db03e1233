"""State of the measures in the time loop: running sums, extremes and times."""

import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxtank.core.kahan import nothing, plus
from jaxtank.core.numerics import lower_clip, magnitude
from jaxtank.core.records import Sample
from jaxtank.core.vectors import each

UNSET = -1e9  # setpoint before the first sample
BAND = 0.05  # half width of the recovery band, as a share of the setpoint [-]
BEGINS = 0.01  # share of its setpoint within which an output begins a run on it [-]


class Run(NamedTuple):
    """Sizes and constants of a run, for accumulators and measures."""

    tanks: int
    outputs: int
    pumps: int
    samples: int
    dt: float  # [s]
    low: Any  # (m,) lower limit of each pump [V]
    high: Any  # (m,) upper limit of each pump [V]
    rim: Any  # (n,) rim of each tank [cm]
    zero: Any  # 0.0 of the run's type
    arrays: bool = False  # whether the vectors of the run are arrays (jaxtank.core.vectors)
    margins: Any = None  # Worst margins of the linearised loop, where a measure reads them

    def lasting(self, sample: Sample, value: Any) -> Any:
        """Return `value` of a sample, 0 at the last: it is held for dt, but for that at the end."""
        return jnp.where(sample.t < (self.samples - 1.5) * self.dt, value, 0.0)


class Worst(NamedTuple):
    """The worst stability margins of all steady states of a loop."""

    sensitivity_peak: Any  # Ms [-]
    complementary_peak: Any  # Mt [-]
    gain_margin: Any  # (m,) [-]
    phase_margin: Any  # (m,) [deg]
    delay_margin: Any  # (m,) [s]


class Context(NamedTuple):
    """Data for accumulators in addition to the sample; None if no measure uses them."""

    # of the last setpoint change of each output: (target [cm], step [cm], time since its end [s],
    # half width of its band [cm]); step 0 before the first
    window: Any = None
    since: Any = None  # time since the last inflow pulse began [s], negative before the first
    steady: Any = None  # (m) inputs that hold the setpoint [V]
    # (m) whether a constant setpoint jumps at this sample, later by the delay of the pump
    jump: Any = None


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
    residual: Callable[[Run, Any, Sample, Context], Any] | None = None
    arrays: bool = False  # whether it takes vectors in either form; else tuples of scalars
    rows: bool = False  # whether the state is a tuple of numbers for each entry; of arrays a tuple


def _filled(run, size, value=0.0):
    """A vector of the run with one number for each output, tank or pump."""
    if run.arrays:
        return jnp.full(getattr(run, size), value, run.zero.dtype)
    return (run.zero + value,) * getattr(run, size)


def _rows(run, size, *values):
    """A state of `rows`, with these numbers for each output, tank or pump."""
    columns = tuple(_filled(run, size, value) for value in values)
    return columns if run.arrays else tuple(zip(*columns))


def _sums(run, size):
    """Empty sums, one per output, tank or pump."""
    return nothing(_filled(run, size)) if run.arrays else (nothing(run.zero),) * getattr(run, size)


def _sum(size, term):
    """Accumulator of sums over the run of term(run, sample), for each output, tank or pump."""

    def update(run, state, sample, context):
        return each(lambda v, s: plus(s, v), term(run, sample), state)

    return Accumulator(lambda run: _sums(run, size), update)


def _sum_of_squares(size, term, refers_to=""):
    """Accumulator of sums of the squares of the numbers that `term(run, sample, context)` gives."""

    def update(run, state, sample, context):
        return each(lambda v, s: plus(s, v * v), term(run, sample, context), state)

    residual = lambda run, state, sample, context: term(run, sample, context)
    return Accumulator(lambda run: _sums(run, size), update, refers_to, residual)


def _lasting(term):
    """`term` of the samples that last for dt: the terms of an integral over the run."""
    lasting = lambda run, sample: lambda v: run.lasting(sample, v)
    return lambda run, sample, *context: each(lasting(run, sample), term(run, sample, *context))


def _extreme(size, pick, better, worst, refers_to=""):
    """Accumulator of (extreme, time it was reached) for each; the first sample wins a tie."""

    def update(run, state, sample, context):
        def extreme(v, now):
            value, time = now
            take = better(v, value)
            return jnp.where(take, v, value), jnp.where(take, sample.t, time)

        return each(extreme, pick(sample, context), state)

    return Accumulator(lambda run: _rows(run, size, worst, 0.0), update, refers_to, rows=True)


def _saturation_excess(run, sample):
    # x/(1+x) of x = excess / span: gouta2015 notes S10; bounded, so that one outlier does not
    # dominate a cost
    span = each(lambda low, high: high - low, run.low, run.high)
    past = lambda v, low, high: jnp.where(v > high, v - high, jnp.where(v < low, low - v, 0.0))
    excess = each(past, sample.command, run.low, run.high)
    return each(lambda x, s: x / (s + x), excess, span)


def _outside(run, sample):
    def past(v, low, high):  # by more than rounding: a share of a range may end at a limit
        rounding = 4.0 * jnp.finfo(jnp.result_type(run.zero)).eps
        below, above = low - rounding * magnitude(low), high + rounding * magnitude(high)
        return jnp.where((v < below) | (v > above), 1.0, 0.0)

    return each(past, sample.command, run.low, run.high)


def _recovering(context):
    """Whether tanks are watched after an inflow pulse, when levels move by it."""
    return False if context.since is None else context.since >= 0.0


def _overshoot(sample, context):
    """Level past the target as a share of the step [-]; -1 before the first step."""
    recovering = _recovering(context)

    def share(r, e, window):
        target, step, _, _ = window
        none = (step == 0.0) | recovering
        return jnp.where(none, -1.0, (r + e - target) / jnp.where(none, 1.0, step))

    return each(share, sample.r, sample.e, context.window)


def _update_settling(run, state, sample, context):
    """Per output (target, time since its change at the last sample outside, outside, worst, 1 where
    it was inside as the inflow pulse began that is watched, 2 where it is outside since)."""
    recovering = _recovering(context)
    begins = recovering if context.since is None else recovering & (context.since < 0.999 * run.dt)

    def update(r, e, window, before):
        (target, step, since, band), (old, last, outside, worst, pulse) = window, before
        changed, done = target != old, settled(last, outside)
        worst = jnp.where(changed & (done > worst), done, worst)
        last = jnp.where(changed, -1e9, last)
        out = (step != 0.0) & (jnp.abs(r + e - target) > band)
        counts = jnp.where(begins, outside == 0.0, pulse > 0.0) & ~changed
        by_pulse = out & counts & (recovering | (pulse == 2.0))
        pulse = jnp.where(by_pulse, 2.0, jnp.where(counts & recovering, 1.0, 0.0))
        out = out & ~by_pulse
        return target, jnp.where(out, since, last), jnp.where(out, 1.0, 0.0), worst, pulse

    return each(update, sample.r, sample.e, context.window, state)


def settled(last, outside):
    """Settling time of a change that is over: infinite if its last sample was outside the band."""
    return jnp.where(outside > 0, jnp.inf, last)


def _moves(r, before):
    """Whether a setpoint has changed by more than rounding, by which pages and XLA differ."""
    return magnitude(r - before) > 4.0 * jnp.finfo(jnp.result_type(r)).eps * magnitude(r)


def ended_plateau(ends, samples, start, begun, worst, ended):
    """(start, begun, worst) after the end of a plateau, `ended` its (error, more numbers).

    A run that begins on its setpoint says by its first plateau how plants drift from where the run
    starts, and not how they follow: that one counts where a later one is no longer than it.

    start: below 0 in a first plateau that begins on its setpoint, then its samples, 0 where it
    counts; begun: what it ended with; worst: what the worst that counts ended with.
    """
    larger = lambda where, new, old: _choose(where & (new[0] > old[0]), new, old)
    first, later = ends & (start < 0), ends & (start >= 0)
    enough = later & (samples <= start)
    worst = larger(enough, begun, larger(later, ended, worst))
    start = jnp.where(first, samples, jnp.where(enough, 0.0, start))
    return start, _choose(first, ended, begun), worst


def _choose(where, new, old):
    return tuple(jnp.where(where, *pair) for pair in zip(new, old))


def _start(r, e, setpoint, start):
    """`start` of `ended_plateau`, which a run's first sample sets."""
    on_setpoint = jnp.where(magnitude(e) <= BEGINS * magnitude(r), -1.0, 0.0)
    return jnp.where(setpoint == UNSET, on_setpoint, start)


def _update_plateau(run, state, sample, context):
    """Per output (setpoint, constant, samples, start, begun, worst, |error|, time): the last four
    of them (error, time) at the end of the first plateau, of the worst, and now."""

    def update(r, e, before):
        setpoint, constant, samples, start, *pairs, error, time = before
        moved = _moves(r, setpoint)
        ends, rest = moved & (constant > 0), (pairs[:2], pairs[2:], (error, time))
        start, begun, worst = ended_plateau(ends, samples, start, *rest)
        start, now = _start(r, e, setpoint, start), jnp.broadcast_to(sample.t, jnp.shape(e))
        constant, samples = jnp.where(moved, 0.0, 1.0), jnp.where(moved, 1.0, samples + 1.0)
        return r, constant, samples, start, *begun, *worst, magnitude(e), now

    return each(update, sample.r, sample.e, state)


def _update_swing(run, state, sample, context):
    """Per output what `swing_of` reads: parts of a plateau, each a fifth longer than begun."""

    def update(r, e, before):
        setpoint, constant, count, start, begun, worst, end, *parts = before
        above, below, above_old, below_old = parts
        moved = _moves(r, setpoint)
        ends, swing = moved & (constant > 0), (swing_of(*parts),)
        start, (begun,), (worst,) = ended_plateau(ends, count, start, (begun,), (worst,), swing)
        start = _start(r, e, setpoint, start)
        count = jnp.where(moved, 1.0, count + 1.0)
        fresh = moved | (count >= end)
        old = lambda now, before: jnp.where(moved, 0.0, jnp.where(fresh, now, before))
        new = lambda now, v: jnp.where(fresh | (v > now), lower_clip(v, 0.0), now)
        parts = new(above, e), new(below, -e), old(above, above_old), old(below, below_old)
        end = jnp.where(fresh, lower_clip(1.2 * count, 4.0), end)
        return r, jnp.where(moved, 0.0, 1.0), count, start, begun, worst, end, *parts

    return each(update, sample.r, sample.e, state)


def swing_of(above, below, above_old, below_old):
    """Smaller of the largest errors above and below, over the last two parts of a plateau."""
    return magnitude(jnp.minimum(jnp.maximum(above, above_old), jnp.maximum(below, below_old)))


def _update_rise(run, state, sample, context):
    """Per output (target, times of the first 10 % and of the first 90 %, longest rise)."""

    def update(r, e, window, before):
        (target, step, _, _), (old, t10, t90, longest) = window, before
        fresh = target != old
        t10, t90 = jnp.where(fresh, -1.0, t10), jnp.where(fresh, -1.0, t90)
        done = jnp.where(
            step == 0.0, 0.0, 1.0 + (r + e - target) / jnp.where(step == 0.0, 1.0, step)
        )
        t10 = jnp.where((t10 < 0) & (done >= 0.1), sample.t, t10)
        reached = (t90 < 0) & (done >= 0.9)
        t90 = jnp.where(reached, sample.t, t90)
        longest = jnp.where(reached & (sample.t - t10 > longest), sample.t - t10, longest)
        return target, t10, t90, longest

    return each(update, sample.r, sample.e, context.window, state)


def _update_recovery(run, state, sample, context):
    """Per output (time from the first pulse at the last sample outside, outside, worst, time from
    the first pulse to the last, time since that): one that comes before the recovery from another
    begins no new one."""
    since = context.since

    def update(r, e, before):
        last, outside, worst, earlier, now = before
        watched = since >= 0.0
        begins = watched & ((now < 0.0) | (since < now + 0.5 * run.dt))
        joined = begins & (outside > 0.0) & (now >= 0.0)
        fresh, done = begins & ~joined, settled(last, outside)
        worst = jnp.where(fresh & (done > worst), done, worst)
        longer = jnp.where(joined, earlier + now + run.dt - since, earlier)
        earlier = jnp.where(fresh, 0.0, longer)
        out = watched & (jnp.abs(e) > BAND * jnp.abs(r))
        last = jnp.where(out, earlier + since, jnp.where(fresh, 0.0, last))
        outside = jnp.where(watched, jnp.where(out, 1.0, 0.0), outside)
        return last, outside, worst, earlier, jnp.broadcast_to(since, jnp.shape(e))

    return each(update, sample.r, sample.e, state)


def _deviation(run, sample, context):
    """Distance of each input from the one that holds the setpoint [V]."""
    return each(operator.sub, sample.u, context.steady)


def _past(run, sample, context):
    """Level past the target [cm], in the direction of the step, one per output."""
    recovering = _recovering(context)

    def past(r, e, window):
        target, step, _, _ = window
        up, down = r + e - target, target - r - e
        beyond = jnp.where(step > 0, up, jnp.where(step < 0, down, 0.0))
        return lower_clip(jnp.where(recovering, 0.0, beyond), 0.0)

    return each(past, sample.r, sample.e, context.window)


def _over_rim(run, sample, context):
    """Rise past the rim [cm], one per tank."""
    return each(lambda x, rim: lower_clip(x - rim, 0.0), sample.x, run.rim)


def _estimation_error(run, sample):
    return each(lambda a, b: (a - b) * (a - b), sample.x_hat, sample.x)


def _changes(run, state, sample, context):
    """Changes of the inputs since the last sample; 0 at the first."""
    previous, _, first = state
    return each(lambda v, p: jnp.where(first, 0.0, v - p), sample.u, previous)


def _jitter(run, state, sample, context):
    """Changes of the inputs since the last sample; 0 where a setpoint jumps."""
    changes = _changes(run, state, sample, context)
    return each(lambda d, j: jnp.where(j, 0.0, d), changes, context.jump)


def _relative_jitter(run, state, sample, context):
    """The same in ranges of the pumps, whose inverses are the same in all samples."""
    changes = _jitter(run, state, sample, context)
    return each(lambda d, low, high: d * (1.0 / (high - low)), changes, run.low, run.high)


def _sum_of_changes(term, changes, refers_to="", residual=None):
    """Accumulator of sums of term(change) over the changes of each input."""

    def update(run, state, sample, context):
        sums = each(lambda d, s: plus(s, term(d)), changes(run, state, sample, context), state[1])
        return sample.u, sums, jnp.zeros_like(state[2])

    start = lambda run: (_filled(run, "pumps"), _sums(run, "pumps"), run.zero == 0.0)
    return Accumulator(start, update, refers_to, residual)


def _squared_changes(changes, refers_to=""):
    """Accumulator of the sums of the squares of those changes."""
    return _sum_of_changes(lambda d: d * d, changes, refers_to, residual=changes)


def _magnitudes(vector):
    return each(magnitude, vector)


_BUILT_IN: dict[str, Accumulator] = {
    "e2": _sum_of_squares("outputs", lambda run, s, context: s.e),
    "lasting_e2": _sum_of_squares("outputs", _lasting(lambda run, s, context: s.e)),
    "abs_e": _sum("outputs", _lasting(lambda run, s: _magnitudes(s.e))),
    "u2": _sum("pumps", lambda run, s: each(lambda u: u * u, s.u)),
    "estimate2": _sum("tanks", _estimation_error),
    "outside": _sum("pumps", _outside),
    "saturation_excess": _sum("pumps", _saturation_excess),
    "filtered": Accumulator(
        lambda run: nothing(run.zero),
        lambda run, state, sample, context: plus(state, sample.filtered),
    ),
    "slack": Accumulator(
        lambda run: run.zero, lambda run, state, sample, context: jnp.maximum(state, sample.slack)
    ),
    "over_rim2": _sum_of_squares("tanks", _over_rim),
    "spilled": _sum("tanks", _lasting(lambda run, s: s.spilled)),
    "shortfall": _sum("tanks", _lasting(lambda run, s: s.shortfall)),
    "max_level": _extreme("tanks", lambda s, context: s.x, lambda a, b: a > b, -jnp.inf),
    "min_level": _extreme("tanks", lambda s, context: s.x, lambda a, b: a < b, jnp.inf),
    "max_error": _extreme(
        "outputs", lambda s, context: _magnitudes(s.e), lambda a, b: a > b, -jnp.inf
    ),
    "overshoot": _extreme("outputs", _overshoot, lambda a, b: a > b, -1.0, "window"),
    "settling": Accumulator(
        lambda run: _rows(run, "outputs", 0.0, -1e9, 0.0, -1e9, 0.0),
        _update_settling,
        "window",
        rows=True,
    ),
    "plateau": Accumulator(
        lambda run: _rows(run, "outputs", UNSET, *(0.0,) * 3, *(-1.0, 0.0) * 2, 0.0, 0.0),
        _update_plateau,
        rows=True,
    ),
    "swing": Accumulator(
        lambda run: _rows(run, "outputs", UNSET, *(0.0,) * 3, -1.0, -1.0, 4.0, *(0.0,) * 4),
        _update_swing,
        rows=True,
    ),
    "rise": Accumulator(
        lambda run: _rows(run, "outputs", 0.0, -1.0, -1.0, 0.0), _update_rise, "window", rows=True
    ),
    "recovery": Accumulator(
        lambda run: _rows(run, "outputs", 0.0, 0.0, 0.0, 0.0, -1.0),
        _update_recovery,
        "since",
        rows=True,
    ),
    "past2": _sum_of_squares("outputs", _past, "window"),
    "deviation2": _sum_of_squares("pumps", _lasting(_deviation), "steady"),
    "travel": _sum_of_changes(magnitude, _changes),
    "changes2": _squared_changes(_changes),
    "jitter2": _squared_changes(_jitter, "jump"),
    "relative_jitter2": _squared_changes(_relative_jitter, "jump"),
}

ACCUMULATORS: dict[str, Accumulator] = {a: v._replace(arrays=True) for a, v in _BUILT_IN.items()}
"""{name: Accumulator}; `jaxtank.measures.register` adds custom ones."""

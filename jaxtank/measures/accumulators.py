"""What the time loop carries for each measure: running sums, extremes and times."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxtank.core.kahan import nothing, plus
from jaxtank.core.numerics import lower_clip, magnitude, root_of_mean

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
    """start(run) -> state; update(run, state, sample, window) -> state, at every sample; window: of
    the setpoint's changes, or, for `recovery`, the time since the last pour.
    """

    start: Callable
    update: Callable


def _filled(run, count, value):
    return (run.zero + value,) * count


def _sums(run, count):
    return (nothing(run.zero),) * count


def _sum(size, term):
    """Accumulator of sums over the run: `term(run, sample)` gives one number per output, tank or
    pump.
    """

    def update(run, state, sample, window):
        return tuple(plus(s, v) for s, v in zip(state, term(run, sample)))

    return Accumulator(lambda run: _sums(run, size(run)), update)


def _extreme(size, pick, better, worst):
    """Accumulator of (extreme, time it was reached), one pair per output, tank or pump; the first
    sample wins a tie.
    """

    def update(run, state, sample, window):
        new = []
        for (value, time), v in zip(state, pick(run, sample, window)):
            take = better(v, value)
            new.append((jnp.where(take, v, value), jnp.where(take, sample.t, time)))
        return tuple(new)

    return Accumulator(
        lambda run: tuple((run.zero + worst, run.zero) for _ in range(size(run))), update
    )


def _excess(run, command):
    """How far a command is outside its limits [V], 0 inside."""
    return tuple(
        jnp.where(v > high, v - high, jnp.where(v < low, low - v, 0.0))
        for v, low, high in zip(command, run.low, run.high)
    )


def _saturation_excess(run, sample):
    # x/(1+x) of x = excess / span: gouta2015 notes S10; bounded, so that one wild sample does not
    # rule a cost
    span = tuple(high - low for low, high in zip(run.low, run.high))
    return tuple(x / (s + x) for x, s in zip(_excess(run, sample.command), span))


def _outside(run, sample):
    return tuple(
        jnp.where((v < low) | (v > high), 1.0, 0.0)
        for v, low, high in zip(sample.command, run.low, run.high)
    )


def _overshoot(run, sample, window):
    """Level past the target in the direction of the step, as a share of the step [-]; -1 where
    there is no step yet.
    """
    return tuple(
        jnp.where(step == 0.0, -1.0, (r + e - target) / jnp.where(step == 0.0, 1.0, step))
        for (target, step, _, _), r, e in zip(window, sample.r, sample.e)
    )


def _start_settling(run):
    return tuple((run.zero, run.zero - 1e9, run.zero, run.zero - 1e9) for _ in range(run.outputs))


def _update_settling(run, state, sample, window):
    """Per output (target now, time since its change ended at the last sample outside the band [s],
    1 if still outside, worst so far).
    """
    new = []
    for (old, last, outside, worst), (target, step, since, band), r, e in zip(
        state, window, sample.r, sample.e
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


def _update_rise(run, state, sample, window):
    """Per output (target now, time of the first 10 %, time of the first 90 %, longest rise so far)."""
    new = []
    for (old, t10, t90, longest), (target, step, _, _), r, e in zip(
        state, window, sample.r, sample.e
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


def _update_recovery(run, state, sample, since):
    """Per output (time since the pour at the last sample outside the band [s], 1 if that was the
    last one watched, worst so far).
    """
    new = []
    for (last, outside, worst), r, e in zip(state, sample.r, sample.e):
        fresh = since < last
        done = settled(last, outside)
        worst = jnp.where(fresh & (done > worst), done, worst)
        out, watched = jnp.abs(e) > BAND * jnp.abs(r), since >= 0.0
        last = jnp.where(watched, jnp.where(out, since, jnp.where(fresh, 0.0, last)), last)
        new.append((last, jnp.where(watched, jnp.where(out, 1.0, 0.0), outside), worst))
    return tuple(new)


def recovery(run, acc):
    return as_list(
        [jnp.maximum(worst, settled(last, outside)) for last, outside, worst in acc["recovery"]]
    )


def _deviation(run, sample, rest):
    return tuple(u - held for u, held in zip(sample.u, rest))


def _past(sample, window):
    """Level past the target in the direction of the step [cm], one per output; 0 before the first
    step.
    """
    return tuple(
        lower_clip(
            jnp.where(step > 0, r + e - target, jnp.where(step < 0, target - r - e, 0.0)), 0.0
        )
        for (target, step, _, _), r, e in zip(window, sample.r, sample.e)
    )


def _update_past(run, state, sample, window):
    return tuple(plus(s, v * v) for s, v in zip(state, _past(sample, window)))


def _update_deviation(run, state, sample, rest):
    return tuple(plus(s, d * d) for s, d in zip(state, _deviation(run, sample, rest)))


def _over_rim(run, sample):
    """Rise past the rim [cm], one per tank."""
    return tuple(lower_clip(x - h, 0.0) for x, h in zip(sample.x, run.rim))


def _changes(state, sample):
    """Changes of the inputs since the last sample; 0 at the first."""
    previous, _, first = state
    return tuple(jnp.where(first, 0.0, v - p) for v, p in zip(sample.u, previous))


def _update_changes(run, state, sample, window):
    return (
        sample.u,
        tuple(plus(s, d * d) for s, d in zip(state[1], _changes(state, sample))),
        jnp.zeros_like(state[2]),
    )


def _start_travel(run):
    return _filled(run, run.pumps, 0.0), _sums(run, run.pumps), run.zero == 0.0


def _update_travel(run, state, sample, window):
    previous, total, first = state
    step = tuple(magnitude(v - p) for v, p in zip(sample.u, previous))
    return (
        sample.u,
        tuple(plus(s, jnp.where(first, 0.0, d)) for s, d in zip(total, step)),
        jnp.zeros_like(first),
    )


ACCUMULATORS = {
    "e2": _sum(lambda run: run.outputs, lambda run, s: tuple(e * e for e in s.e)),
    "abs_e": _sum(lambda run: run.outputs, lambda run, s: tuple(magnitude(e) for e in s.e)),
    "u2": _sum(lambda run: run.pumps, lambda run, s: tuple(u * u for u in s.u)),
    "estimate2": _sum(
        lambda run: run.tanks, lambda run, s: tuple((a - b) * (a - b) for a, b in zip(s.x_hat, s.x))
    ),
    "outside": _sum(lambda run: run.pumps, _outside),
    "saturation_excess": _sum(lambda run: run.pumps, _saturation_excess),
    "over_rim2": _sum(
        lambda run: run.tanks, lambda run, s: tuple(v * v for v in _over_rim(run, s))
    ),
    "spilled": _sum(lambda run: run.tanks, lambda run, s: s.spilled),
    "shortfall": _sum(lambda run: run.tanks, lambda run, s: s.shortfall),
    "max_level": _extreme(
        lambda run: run.tanks, lambda run, s, w: s.x, lambda a, b: a > b, -jnp.inf
    ),
    "min_level": _extreme(
        lambda run: run.tanks, lambda run, s, w: s.x, lambda a, b: a < b, jnp.inf
    ),
    "max_error": _extreme(
        lambda run: run.outputs,
        lambda run, s, w: tuple(magnitude(e) for e in s.e),
        lambda a, b: a > b,
        -jnp.inf,
    ),
    "overshoot": _extreme(lambda run: run.outputs, _overshoot, lambda a, b: a > b, -1.0),
    "settling": Accumulator(_start_settling, _update_settling),
    "rise": Accumulator(_start_rise, _update_rise),
    "recovery": Accumulator(
        lambda run: tuple((run.zero, run.zero, run.zero) for _ in range(run.outputs)),
        _update_recovery,
    ),
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
"""{accumulator: (run, its state, sample, window, rest) -> the numbers whose squares it sums at this
sample}: what Gauss-Newton works on.
"""


def mean(run, values):
    return tuple(v / run.samples for v in values)


def as_list(values):
    return jnp.stack([jnp.asarray(v) for v in values])


def root_mean(name):
    return lambda run, acc: root_of_mean(as_list(mean(run, acc[name])))

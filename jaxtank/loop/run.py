"""The closed loop: plant, sensor, observer, law and actuator, compiled to one function.

Row k of a run is the world at t_k before it moves: y_k is read, u_k is decided, and u_k is held
over [t_k, t_k + dt). `simulate` keeps a trajectory for people; `evaluate` keeps running measures
for tuning and ensembles; `sensitivities` carries exact derivatives of the measures along with the
run. All are pure: jit, vmap, grad and jacfwd work on them with the loop as an argument.
"""

import functools
import math
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike

from jaxtank import measures as ms
from jaxtank.core.clock import CHUNK, Clock, is_pointwise
from jaxtank.core.errors import InputError, NonFiniteError
from jaxtank.core.records import Trajectory
from jaxtank.core.tree import parameters, with_values
from jaxtank.loop.closed_loop import ClosedLoop, initial, inputs, is_broken, keyed, run_of, zero_of
from jaxtank.loop.derivatives import sensitivities_compiled
from jaxtank.loop.step import step
from jaxtank.loop.validation import check
from jaxtank.xla.hoist import scan


def simulate(
    loop: ClosedLoop, clock: Clock, key: jax.Array | None = None, save_every: int = 1
) -> Trajectory:
    """Run the loop and keep every `save_every`-th sample.

    loop: ClosedLoop; clock: Clock; key: jax random key for the sensor noise, or None; returns a
    Trajectory. Raises InputError for invalid input and NonFiniteError if a level stops being finite
    (outside a trace).
    """
    check(loop, clock, key)
    if not isinstance(save_every, int) or save_every < 1:
        raise InputError(
            f"save_every = {save_every!r}: must be a whole number of at least 1 sample"
        )
    trajectory, broken = simulate_compiled(loop, clock, key, min(save_every, clock.samples))
    _report_broken(broken, loop, clock, key)
    return trajectory


def evaluate(
    loop: ClosedLoop, clock: Clock, measures: Sequence[str], key: jax.Array | None = None
) -> dict[str, jax.Array]:
    """Run the loop and keep only running measures.

    measures: names of `jaxtank.measures.MEASURES`; key: jax random key for the sensor noise, or
    None; returns {name: scalar, or array with one entry per output, tank or pump}. Raises
    InputError for invalid input and NonFiniteError if a level stops being finite (outside a trace;
    inside one, the values of such a run are NaN, and so are those of a run with noise and no key).
    """
    names = _names(measures)
    check(loop, clock, key)
    values, broken = evaluate_compiled(loop, clock, names, key, False)
    _report_broken(broken, loop, clock, key)
    return values


def evaluate_and_flag(loop, clock, measures, key=None):
    """(`evaluate`'s values, True if the run stopped being finite); checks nothing, raises nothing:
    for batches and searches.
    """
    return evaluate_compiled(loop, clock, _names(measures), key, False)


def evaluate_for_reverse(loop, clock, measures, key=None):
    """`evaluate` with the run cut into about sqrt(samples) pieces that are recomputed on the way
    back, for reverse mode.

    Same values, but never NonFiniteError; memory of a gradient grows with the root of the
    samples. Best above about ten parameters.
    """
    names = _names(measures)
    check(loop, clock, key)
    return evaluate_compiled(loop, clock, names, key, True)[0]


def sensitivities(
    loop: ClosedLoop,
    clock: Clock,
    measures: Sequence[str],
    values: Mapping[str, ArrayLike],
    key: jax.Array | None = None,
    squares: Mapping[str, float] | None = None,
) -> tuple[dict[str, jax.Array], dict[str, jax.Array], jax.Array, jax.Array]:
    """Measures, their exact derivatives, and a Gauss-Newton matrix, in one run.

    values: {dotted name: number or array} of P numbers in all, the point and the parameters to
    differentiate by (forward mode: worth it to about ten). squares: {measure: weight} of measures
    that are sums of squares, sum_k w_k v_k^2: the matrix is 2 sum_k w_k grad(v_k) grad(v_k)', the
    second derivative of their weighted sum but for the residuals' own curvature; None: the mean
    square tracking error of all outputs. Returns (measures {name: value}, derivatives {name:
    value.shape + (P,)}, (P, P) matrix, True if the run stopped being finite), P in the order of
    `values`. key as in `evaluate`. Raises InputError for invalid input; a run that is not finite is
    told by the flag.
    """
    if not values:
        raise InputError("sensitivities needs at least one parameter: values is empty")
    check(with_values(loop, values), clock, key)
    squares = {"mean_square_error": 1.0} if squares is None else squares
    for name in _names(squares):
        if not ms.MEASURES[name].residual:
            raise InputError(
                f"squares: {name} is not a sum of squares; those are {', '.join(ms.SQUARES)}"
            )
    chosen = tuple((m, float(w)) for m, w in squares.items())
    return sensitivities_compiled(
        loop, clock, _names(measures), tuple(values), tuple(values.values()), key, chosen
    )


def _names(measures):
    names = (measures,) if isinstance(measures, str) else tuple(measures)
    ms.check_names(names)
    return names


@functools.partial(jax.jit, static_argnames=("clock", "names", "checkpoint"))
def evaluate_compiled(loop, clock, names, key, checkpoint):
    loop = keyed(loop, key)
    run = run_of(loop, clock)

    def body(carry, now):
        state, acc = carry
        state, sample = step(loop, clock, state, now)
        return (state, ms.update(run, acc, sample, now.window, now.since, now.rest)), None

    carry = (initial(loop, clock), ms.start(run, names))
    if checkpoint:
        state, acc = checkpointed_scan(body, carry, inputs(loop, clock, names, key), clock.samples)
    elif clock.samples > CHUNK and is_pointwise(loop):
        whole, rest = divmod(clock.samples, CHUNK)
        piece = lambda c, number, samples=CHUNK: (
            scan(body, c, inputs(loop, clock, names, key, number, samples), samples)[0],
            None,
        )
        carry = jax.lax.scan(piece, carry, jnp.arange(whole))[0]
        state, acc = piece(carry, whole, rest)[0] if rest else carry
    else:
        state, acc = scan(body, carry, inputs(loop, clock, names, key), clock.samples)[0]
    return ms.read(run, acc, names), is_broken(state)


def checkpointed_scan(body, carry, xs, length):
    """A scan over about sqrt(length) pieces, each recomputed in the reverse pass."""
    inner = math.isqrt(length)
    outer = length // inner
    head = jax.tree.map(lambda a: a[: outer * inner].reshape(outer, inner), xs)
    tail = jax.tree.map(lambda a: a[outer * inner :], xs)
    piece = jax.checkpoint(lambda c, now: (scan(body, c, now, length=inner)[0], None))
    carry = scan(piece, carry, head, length=outer)[0]
    return scan(body, carry, tail, length=length - outer * inner)[0]


@functools.partial(jax.jit, static_argnames=("clock", "save_every"))
def simulate_compiled(loop, clock, key, save_every):
    loop = keyed(loop, key)
    rows = (clock.samples - 1) // save_every + 1
    xs = inputs(loop, clock, (), key)
    spare = rows * save_every - clock.samples  # steps after the last row: run, but not kept
    xs = jax.tree.map(
        lambda a: jnp.pad(a, (0, max(spare, 0)), mode="edge")[: rows * save_every].reshape(
            rows, save_every
        ),
        xs,
    )

    def one(carry, now):
        state, spilled = carry
        state, sample = step(loop, clock, state, now)
        return (state, tuple(a + b for a, b in zip(spilled, sample.spilled))), sample

    def row(carry, now):
        spilled = carry[1]
        carry, sample = one(carry, jax.tree.map(lambda a: a[0], now))
        if save_every > 1:
            rest = jax.tree.map(lambda a: a[1:], now)
            carry = scan(lambda c, n: (one(c, n)[0], None), carry, rest, length=save_every - 1)[0]
        return carry, sample._replace(spilled=spilled)

    zero = zero_of(loop)
    (state, _), saved = scan(
        row, (initial(loop, clock), (zero,) * loop.plant.tanks), xs, length=rows
    )
    columns = {
        name: jnp.stack(value, axis=-1) if isinstance(value, tuple) else value
        for name, value in saved._asdict().items()
        if name in Trajectory._fields
    }
    return Trajectory(**columns), is_broken(state)


def _report_broken(broken, loop, clock, key):
    """Raise NonFiniteError for a run that left the numbers, with time, tank and what was set.
    Nothing inside a trace.
    """
    if isinstance(broken, Tracer) or np.ndim(broken) or not broken:
        return
    loop = jax.lax.stop_gradient(loop)  # under grad its leaves are known, and traced all the same
    run = simulate_compiled(loop, clock, key, 1)[0]
    bad = ~np.isfinite(np.asarray(run.x))
    if not bad.any():  # only the step after the last sample
        return
    first = int(np.argmax(bad.any(axis=1)))
    if first == 0 and key is None:  # `keyed` saw to it
        raise InputError("sensor.noise is above 0: give a key, or set it to 0")
    tanks = ", ".join(str(i + 1) for i in np.flatnonzero(bad[first]))
    shown = {
        n: v
        for n, v in parameters(loop).items()
        if n.startswith("controller.") and not n.startswith("controller.model.")
    }
    text = ", ".join(f"{n} = {np.asarray(v)}" for n, v in shown.items())
    raise NonFiniteError(
        f"the level of tank {tanks} stopped being finite at t = {first * clock.dt:g} s with {text}"
    )


__all__ = [
    "Clock",
    "ClosedLoop",
    "check",
    "evaluate",
    "evaluate_for_reverse",
    "sensitivities",
    "simulate",
]

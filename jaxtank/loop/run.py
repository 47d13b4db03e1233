"""A whole run: a trajectory for people, measures for tuning, and exact derivatives of the measures.

Row k of a run is the state at t_k: y_k is measured, u_k is computed, and held over [t_k, t_k + dt).
All are pure: jit, vmap, grad and jacfwd work on them with the loop as an argument.
"""
# pyright: reportUnknownMemberType=false

import functools
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike

from jaxtank import measures as ms
from jaxtank.core.checks import check_whole
from jaxtank.core.clock import CHUNK, Clock, ClockWarning, clock_warnings, is_pointwise
from jaxtank.core.errors import InputError, NonFiniteError
from jaxtank.core.labels import labels_of
from jaxtank.core.tree import parameters, with_values
from jaxtank.loop.closed_loop import (
    ClosedLoop,
    Inputs,
    initial,
    inputs,
    is_broken,
    keyed,
    run_of,
    takes_arrays,
)
from jaxtank.loop.derivatives import sensitivities_compiled
from jaxtank.loop.functions import needed_by, values_of
from jaxtank.loop.margins import run_with
from jaxtank.loop.of_case import check_is_values, takes_case
from jaxtank.loop.saved_rows import simulate_compiled
from jaxtank.loop.step import step
from jaxtank.loop.tank_bottom import TankBottomWarning, tank_bottom_warnings
from jaxtank.loop.trajectory import Trajectory
from jaxtank.loop.validation import check
from jaxtank.xla.batching import in_batches
from jaxtank.xla.hoist import checkpointed_scan, scan
from jaxtank.xla.jit import compiled

BATCH = 256
"""Runs side by side: enough to fill the vector units, few enough for the cache. 65,536 at once take
1.6 to 3 times as long each, by the size of the cache.
"""


@takes_case
def simulate(
    loop: ClosedLoop, clock: Clock, key: jax.Array | None = None, save_every: int = 1
) -> Trajectory:
    """Run the loop and keep every `save_every`-th sample.

    Warns (TankBottomWarning) where a level falls below an empty tank: liquid was drawn that was not
    there; and ClockWarning where the duration is no whole number of samples.

    Parameters
    ----------
    loop : ClosedLoop; or a Case, whose clock is then used
    clock : Clock; none after a Case
    key : jax random key, optional
        For the sensor noise; needed where `sensor.noise` is above 0.
    save_every : int
        Distance of the saved samples [samples].

    Returns
    -------
    Trajectory
        Arrays with one row per saved sample.

    Raises
    ------
    InputError
        For invalid input.
    NonFiniteError
        If a level stops being finite (outside a trace).

    Examples
    --------
    >>> import jaxtank
    >>> from jaxtank import presets
    >>> loop = presets.load("cascaded/pi").loop
    >>> run = jaxtank.simulate(loop, jaxtank.Clock(dt=4.0, duration=40.0), save_every=5)
    >>> run.x.shape, [float(t) for t in run.t]
    ((3, 2), [0.0, 20.0, 40.0])
    """
    check(loop, clock, key)
    check_whole("save_every", save_every, 1)
    for line in clock_warnings(clock):
        warnings.warn(line, ClockWarning, stacklevel=3)
    trajectory, broken = simulate_compiled(loop, clock, key, min(save_every, clock.samples))
    _report_broken(broken, loop, clock, key)
    if not isinstance(trajectory.x, Tracer) and np.ndim(trajectory.x) == 2:
        for line in tank_bottom_warnings(loop, trajectory):
            warnings.warn(line, TankBottomWarning, stacklevel=3)
    return trajectory


@takes_case
def evaluate(
    loop: ClosedLoop, clock: Clock, measures: Sequence[str], key: jax.Array | None = None
) -> dict[str, jax.Array]:
    """Run the loop and keep only running measures.

    On a CPU `jax.vmap` of it, without derivatives, runs 256 values at a time.

    Parameters
    ----------
    loop : ClosedLoop; or a Case, whose clock is then used
    clock : Clock; none after a Case
    measures : sequence of str
        Names of `jaxtank.measures.MEASURES`.
    key : jax random key, optional
        For the sensor noise.

    Returns
    -------
    {name: scalar, or array with one entry per output, tank or pump}
        In the units of `jaxtank.measures.unit`. Inside a trace, a run that diverges gives NaN,
        and so does a run with noise and no key.

    Raises
    ------
    InputError
        For invalid input, and for a derivative of a measure that counts whole samples (times of
        events, shares of samples).
    NonFiniteError
        If a level stops being finite (outside a trace).

    Examples
    --------
    >>> import jaxtank
    >>> from jaxtank import presets
    >>> loop = presets.load("cascaded/pi").loop
    >>> clock = jaxtank.Clock(dt=4.0, duration=40.0)
    >>> values = jaxtank.evaluate(loop, clock, ["max_level", "iae"])
    >>> values["max_level"].shape, values["iae"].shape
    ((2,), (1,))
    """
    names = _names(measures)
    check(loop, clock, key)

    def run(loop: ClosedLoop, key: Any) -> tuple[dict[str, jax.Array], jax.Array]:
        return evaluate_compiled(loop, clock, names, key, checkpoint=False)

    traced = any(isinstance(v, Tracer) for v in cast(Any, jax.tree.leaves((loop, key))))
    values, broken = (in_batches(run, BATCH) if traced else run)(loop, key)
    _report_broken(broken, loop, clock, key)
    return {
        m: _without_slope(m, v, loop) if ms.MEASURES[m].counts else v for m, v in values.items()
    }


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _without_slope(name: str, value: Any, loop: Any) -> Any:
    """Return the value of a measure that counts samples; its derivative is an InputError."""
    return value


@_without_slope.defjvp
def _refused(name: str, primals: Any, tangents: Any) -> Any:
    raise InputError(_no_slope([name]))


def _no_slope(names: Sequence[str]) -> str:
    return (
        f"{', '.join(names)}: counts whole samples, so that its derivative is 0 or does not exist;"
        " differentiate another measure (mean_square_error, mean_square_overshoot,"
        " saturation_excess), or evaluate this one outside the function that is differentiated"
    )


def evaluate_and_flag(
    loop: ClosedLoop, clock: Clock, measures: Sequence[str], key: jax.Array | None = None
) -> tuple[dict[str, jax.Array], jax.Array]:
    """Return (`evaluate`'s values, True if the run diverged), unchecked."""
    return evaluate_compiled(loop, clock, _names(measures), key, checkpoint=False)


def evaluate_for_reverse(
    loop: ClosedLoop, clock: Clock, measures: Sequence[str], key: jax.Array | None = None
) -> dict[str, jax.Array]:
    """Return `evaluate`'s values by sqrt(samples) chunks that reverse mode recomputes."""
    # Same values, but never NonFiniteError; memory of a gradient grows with the root of the
    # samples. Best above about ten parameters.
    names = _names(measures)
    check(loop, clock, key)
    return evaluate_compiled(loop, clock, names, key, checkpoint=True)[0]


@takes_case
def sensitivities(
    loop: ClosedLoop,
    clock: Clock,
    measures: Sequence[str],
    values: Mapping[str, ArrayLike],
    key: jax.Array | None = None,
    squares: Mapping[str, float] | None = None,
) -> tuple[dict[str, jax.Array], dict[str, jax.Array], jax.Array, jax.Array]:
    """Return measures, their exact derivatives, and a Gauss-Newton matrix, from one run.

    With sums of squares sum_k w_k v_k^2 the matrix is 2 sum_k w_k grad(v_k) grad(v_k)', the second
    derivative of their weighted sum but for the residuals' own curvature.

    Parameters
    ----------
    loop : ClosedLoop; or a Case, whose clock is then used
    clock : Clock; none after a Case
    measures : sequence of str
    values : {dotted name: number or array}
        P numbers in all: the point, and the parameters to differentiate by (forward mode: worth it
        to about ten).
    key : jax random key, optional
        For the sensor noise.
    squares : {measure: weight}, optional
        Measures that are sums of squares; the mean square tracking error of all outputs where left
        out.

    Returns
    -------
    measures : {name: value}
    derivatives : {name: value.shape + (P,) array}
        In the order of `values`.
    matrix : (P, P) array
    broken : bool array
        True if the run diverged.

    Raises
    ------
    InputError
        For invalid input; a run that is not finite is reported by `broken`.

    Examples
    --------
    >>> import jaxtank
    >>> from jaxtank import presets
    >>> case = presets.load("cascaded/pi")
    >>> clock = jaxtank.Clock(dt=4.0, duration=20.0)
    >>> point = {"controller.Kc": case.loop.controller.Kc}
    >>> found = jaxtank.sensitivities(case.loop, clock, ["rms_error_total"], point)
    >>> found[1]["rms_error_total"].shape, found[2].shape
    ((1,), (1, 1))
    """
    check_is_values(values)
    if not values:
        raise InputError("sensitivities needs at least one parameter: values is empty")
    check(with_values(loop, values), clock, key)
    if steps := [m for m in _names(measures) if ms.MEASURES[m].counts]:
        raise InputError(_no_slope(steps))
    squares = {"mean_square_error": 1.0} if squares is None else squares
    for name in _names(squares):
        if not ms.MEASURES[name].residual:
            raise InputError(
                f"squares: {name} is not a sum of squares; those are {', '.join(ms.squares())}"
            )
    chosen = tuple((m, float(w)) for m, w in squares.items())
    return sensitivities_compiled(
        loop, clock, _names(measures), tuple(values), tuple(values.values()), key, chosen
    )


def _names(measures: str | Sequence[str] | Mapping[str, Any]) -> tuple[str, ...]:
    stated: Any = measures  # of any type, from a caller
    several = hasattr(stated, "__iter__") and not isinstance(measures, str)
    names: tuple[str, ...] = tuple(stated) if several else (stated,)
    ms.check_names(names)
    return names


@compiled("clock", "names", "checkpoint", keep=True)
def evaluate_compiled(
    loop: ClosedLoop, clock: Clock, names: tuple[str, ...], key: jax.Array | None, checkpoint: bool
) -> tuple[dict[str, jax.Array], jax.Array]:
    """Return (measures, True if the run diverged), unchecked; checkpoint: for reverse mode."""
    if ms.functions(names):
        needed = needed_by(loop, clock, names)
        values, broken = evaluate_compiled(loop, clock, needed, key, checkpoint=checkpoint)
        return values_of(loop, clock, names, key, values, checkpoint), broken
    loop, arrays = keyed(loop, key), takes_arrays(loop)
    run = run_of(loop, clock, arrays)
    pointwise = clock.samples > CHUNK and is_pointwise(loop)
    in_loop = not checkpoint and (clock.samples <= CHUNK or pointwise)
    in_loop = in_loop and loop.sensor.draws_in_loop(key)  # else before the loop

    def scanned(carry: Any, number: Any, samples: int, first: Any = 0) -> Any:
        chunk_key = jax.random.fold_in(cast(Any, key), number) if in_loop and pointwise else key

        def body(carry: Any, now: Inputs) -> Any:
            state, acc = carry
            if in_loop:
                drawn_now = loop.sensor.draw_sample(chunk_key, samples, state.k - first, arrays)
                now = now._replace(xi=drawn_now)
            state, sample = step(loop, clock, state, now)
            return (state, ms.update(run, acc, sample, now.context)), None

        xs = inputs(loop, clock, names, None if in_loop else key, number, samples, arrays)
        if checkpoint:
            return checkpointed_scan(body, carry, xs, samples)
        return scan(body, carry, xs, samples)[0]

    def batch(carry: Any, number: Any, samples: int = CHUNK) -> Any:
        return scanned(carry, number, samples, number * CHUNK), None

    carry: Any = (initial(loop, clock, arrays), ms.start(run, names))
    if pointwise and not checkpoint:
        whole, remainder = divmod(clock.samples, CHUNK)
        carry = jax.lax.scan(batch, carry, jnp.arange(whole))[0]
        carry = batch(carry, whole, remainder)[0] if remainder else carry
    else:
        carry = scanned(carry, None, clock.samples)
    state, acc = carry
    return ms.read(run_with(loop, clock, names, arrays), acc, names), is_broken(state)


def _report_broken(
    broken: jax.Array, loop: ClosedLoop, clock: Clock, key: jax.Array | None
) -> None:
    """Raise NonFiniteError for a run that diverged, with time, tank and the controller's values."""
    if isinstance(broken, Tracer) or np.ndim(broken) or not broken:
        return
    loop = jax.lax.stop_gradient(loop)  # under grad its leaves are known, and traced all the same
    run = simulate_compiled(loop, clock, key, 1)[0]
    bad = ~np.isfinite(np.asarray(run.x))
    if not bad.any():  # only the step after the last sample
        return
    first = int(np.argmax(bad.any(axis=1)))
    if first == 0 and key is None:  # the NaN of `keyed`
        raise InputError("sensor.noise is above 0: give a key, or set it to 0")
    tanks = labels_of(loop.plant, "tank", np.flatnonzero(bad[first]).tolist())
    text = ", ".join(
        f"{name} = {np.asarray(value)}"
        for name, value in parameters(loop).items()
        if name.startswith("controller.") and not name.startswith("controller.model.")
    )
    raise NonFiniteError(
        f"the level of {tanks} stopped being finite at t = {first * clock.dt:g} s with {text}"
    )

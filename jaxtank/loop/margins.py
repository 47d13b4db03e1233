"""Stability margins of a closed loop: at the steady state of every plateau, and the worst
of them.
"""
# jax leaves the types of zeros, eval_shape, flatten and others partly open.
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxtank import measures as ms
from jaxtank.analysis import margins as am
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.loop.closed_loop import ClosedLoop, run_of, zero_of
from jaxtank.loop.operating_point import REASONS, linearised
from jaxtank.loop.steady import steady_inflow
from jaxtank.loop.validation import check
from jaxtank.signals.base import Constant
from jaxtank.xla.jit import compiled


class Plateau(NamedTuple):
    """Margins at the steady state of one plateau; made by `stability_margins`."""

    setpoints: np.ndarray[Any, Any]  # (outputs,) [unit of length]
    x: np.ndarray[Any, Any]  # (n,) levels of the steady state [unit of length]
    u: np.ndarray[Any, Any]  # (m,) inputs of the steady state [unit of the pumps]
    why: str  # why there are no margins; "" where there are
    stable: bool  # True if the linearised loop is stable
    margins: am.Margins  # NaN where there are none, or the loop is not stable


def stability_margins(loop: ClosedLoop, clock: Clock) -> tuple[Plateau, ...]:
    """Return the stability margins of the linearised loop at every plateau of its reference.

    One sample of the loop (sensor without noise, observer, controller, pumps with lag and dead time
    but without limits, plant with its steady inflow) is linearised at the steady state of each
    plateau, and broken at the pumps: exact for the sampled loop. With several pumps gain, phase and
    delay margin are of one pump at a time, the other loops closed, and the sensitivity peak is that
    of the largest singular value of (I + L)^-1.

    Parameters
    ----------
    loop : ClosedLoop
    clock : Clock
        Its sampling period counts, not its duration.

    Returns
    -------
    One Plateau for each set of setpoints that is held, in order of time; () where the reference
    has none.

    Raises
    ------
    InputError
        For a loop or clock that cannot be run, and for a loop in float32, whose poles near z = 1
        are too inexact.

    Examples
    --------
    >>> import jax
    >>> import jaxtank
    >>> from jaxtank import presets
    >>> jax.config.update("jax_enable_x64", True)
    >>> case = presets.find("cascaded/pi")
    >>> first = jaxtank.stability_margins(case.loop, case.clock)[0]
    >>> first.stable, round(float(first.margins.sensitivity_peak), 2)
    (True, 1.86)
    """
    check(loop, clock, jax.random.key(0))
    if not serves(loop):
        return ()
    r, linear, found = _of_plateaus(loop, clock)
    rows: list[Plateau] = []
    for k in range(len(np.asarray(r))):
        one = [np.asarray(v)[k] for v in found]
        stable, why = bool(one[0]), REASONS[int(linear.why[k])]
        values = [v if stable and not why else np.full(np.shape(v), np.nan) for v in one[1:]]
        setpoints, x, u = (np.asarray(v[k]) for v in (r, linear.x, linear.u))
        rows.append(Plateau(setpoints, x, u, why, stable and not why, am.Margins(stable, *values)))
    return tuple(rows)


def serves(loop: ClosedLoop) -> bool:
    """Return True if the reference of a loop holds setpoints at which it can be linearised."""
    return loop.reference.held() is not None


def _of_plateaus(loop: ClosedLoop, clock: Clock) -> tuple[Any, Any, am.Margins]:
    """(setpoints (P, outputs), Linearised, Margins), each with the plateaus in front."""
    # What does not matter is left out first, so that loops that differ in it share a program.
    if zero_of(loop).dtype != jnp.float64:
        raise InputError(
            "stability margins need float64: call jax.config.update('jax_enable_x64', True) first,"
            " and give the loop's leaves as float64"
        )
    held: Any = loop.reference.held()
    if held is None:
        kind = type(loop.reference).__name__
        raise InputError(
            f"stability margins need a reference that holds setpoints: a {kind} has none"
            " (signals.Ramps and signals.Constant have)"
        )
    traced = any(isinstance(v, Tracer) for v in jax.tree.leaves((loop, held)))
    xp: Any = jnp if traced else np
    r: Any = xp.stack([xp.stack([xp.asarray(v, float) for v in row]) for row in held])
    bare = dataclasses.replace(
        loop,
        reference=Constant(level=r[0]),
        disturbance=None if steady_inflow(loop) is None else loop.disturbance,
        faults=None,
        safety_filter=None,
    )
    one = functools.partial(
        _compiled, bare, dataclasses.replace(clock, duration=clock.dt), slopes=traced
    )
    if traced:
        # one after the other: a program for one of them is compiled in half the time
        return (r, *cast(tuple[Any, ...], jax.lax.map(one, r)))
    rows = [one(v) for v in r]  # by one program, however many there are
    return (r, *cast(tuple[Any, ...], jax.tree.map(_stacked, *rows)))


def _stacked(*values: Any) -> Any:
    return np.stack([np.asarray(v) for v in values])


@compiled("clock", "slopes", keep=True)
def _compiled(loop: ClosedLoop, clock: Clock, r: Any, slopes: bool) -> tuple[Any, am.Margins]:
    """(Linearised, Margins) of one plateau with setpoints r (outputs,); slopes: whether their
    derivatives may be asked for.
    """
    found = linearised(loop, clock, r)
    return found._replace(open_loop=found.open_loop[:3]), am.margins(found.open_loop, slopes)


def worst(loop: ClosedLoop, clock: Clock) -> ms.Worst:
    """Return the worst margins of all plateaus, for the measures: differentiable, and vmaps."""
    _, linear, found = _of_plateaus(loop, clock)
    xp: Any = np if isinstance(linear.why, np.ndarray) else jnp  # by numpy nothing is compiled
    good, unstable = linear.why == 0, (linear.why == 0) & ~found.stable

    def least(values: Any) -> Any:
        used = good.reshape(-1, *(1,) * (values.ndim - 1))
        chosen = xp.min(xp.where(used, values, np.inf), axis=0)
        chosen = xp.where(xp.any(unstable), -np.inf, chosen)
        return xp.where(xp.any(good), chosen, np.nan)

    return ms.Worst(
        -least(-found.sensitivity_peak),
        least(found.gain_margin),
        least(found.phase_margin),
        least(found.delay_margin),
    )


def run_with(loop: ClosedLoop, clock: Clock, names: Sequence[str], arrays: bool = False) -> ms.Run:
    """Return `run_of` with the margins that the measures `names` read."""
    run = run_of(loop, clock, arrays)
    wanted = any(ms.MEASURES[name].linear for name in names)
    return run._replace(margins=worst(loop, clock)) if wanted else run

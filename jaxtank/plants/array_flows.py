"""The flows of a `TankNetwork` of many tanks on arrays: the same formulas, by fixed gathers.

The number of operations does not depend on the number of tanks.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxtank.core.numerics import (
    limited_flow,
    limited_sqrt,
    lower_clip,
    smooth_signed_sqrt,
    smooth_sqrt,
)
from jaxtank.core.vectors import take
from jaxtank.xla.barrier import materialised, with_one_slope
from jaxtank.xla.gather import gathered


def first_of(pairs: tuple[tuple[int, ...], ...]) -> tuple[int, ...]:
    """Return the first entry of each pair."""
    return tuple(a for a, _ in pairs)


def second_of(pairs: tuple[tuple[int, ...], ...]) -> tuple[int, ...]:
    """Return the second entry of each pair."""
    return tuple(b for _, b in pairs)


def pumped(net: Any, u: Any) -> Any:
    """Return (n,) what the pumps bring to each tank [cm^3/s] for inputs u (m,)."""
    one = [(j, first, second is not None) for j, (first, second) in enumerate(net.feeds)]
    two = [(j, second) for j, (_, second) in enumerate(net.feeds) if second is not None]
    gain, split = jnp.asarray(net.pump_gain), jnp.asarray(net.split)
    # a pump without a second tank brings all to its first, whatever its split is
    shared = np.array([s for *_, s in one])
    shares = gain * jnp.where(shared, split, 1.0)
    pumps, ends = [j for j, *_ in one], [tank for _, tank, _ in one]
    if two:
        at = np.array([j for j, _ in two])
        shares = jnp.concatenate([shares, take(gain * (1.0 - split), at)])
        pumps, ends = pumps + [j for j, _ in two], ends + [tank for _, tank in two]
    return gathered(shares, u, tuple(ends), net.tanks, of=pumps)


def outlets(net: Any) -> Any:
    """Return (n,) area of the outlets of each tank, orifices and drain [cm^2]."""
    leaving = gathered(jnp.asarray(net.orifice), None, first_of(net.links), net.tanks)
    return jnp.asarray(net.drain) + (0.0 if leaving is None else leaving)


def supply(net: Any, step: Any) -> Any:
    """Return (n,) largest ratio of root to level in a step [cm^-0.5] (`TankNetwork.limited`)."""
    pipe = jnp.asarray(net.pipe)
    areas = outlets(net)
    for ends in (first_of(net.pipes), second_of(net.pipes)):
        if ends:
            areas = areas + gathered(pipe, None, ends, net.tanks)
    # of the inverse, which is 0 and not infinite for a tank without outlets
    turnover = step * jnp.sqrt(2.0 * net.gravity)
    return 1.0 / lower_clip(turnover * areas / jnp.asarray(net.area), net.knee**0.5 / 1.5)


def flows(net: Any, x: Any, u: Any, d: Any, step: Any = None) -> Any:
    """Return the rates (n,) [cm/s] of levels x (n,), as `TankNetwork.derivative`; with `step`, of
    the vector field of `TankNetwork.limited`.
    """
    w, per_area = jnp.sqrt(2.0 * net.gravity), 1.0 / jnp.asarray(net.area)
    enters = pumped(net, u) if d is None else pumped(net, u) + d
    most: Any = None if step is None else supply(net, step)
    root = with_one_slope(lambda h: smooth_sqrt(h, net.knee))
    q = root(x) if step is None else limited_sqrt(x, net.knee, most)
    v = w * q
    if net.links:
        v = materialised(v)  # read by every orifice
        orifice, ends = jnp.asarray(net.orifice), second_of(net.links)
        enters = enters + gathered(orifice, v, ends, net.tanks, of=first_of(net.links))
    rate = (enters - outlets(net) * v) * per_area
    return rate + piped(net, x, most) * per_area if net.pipes else rate


def piped(net: Any, x: Any, most: Any) -> Any:
    """Return (n,) what the pipes bring to each tank [cm^3/s]."""
    one, other = first_of(net.pipes), second_of(net.pipes)
    held = x if most is None else lower_clip(x, 0.0)
    root = with_one_slope(lambda h: smooth_signed_sqrt(h, net.knee))
    s = root(take(held, one) - take(held, other))
    if most is not None:
        s = limited_flow(s, take(most * held, one), take(most * held, other))
    flow = materialised(jnp.asarray(net.pipe) * jnp.sqrt(2.0 * net.gravity) * s)
    pipes = range(len(one))
    signs = np.repeat([-1.0, 1.0], len(one))
    return gathered(signs, flow, one + other, net.tanks, of=(*pipes, *pipes))

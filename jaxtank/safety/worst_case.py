"""The largest and least rates that levels can have over a box of plants, tank by tank."""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxtank.core.numerics import lower_clip, smooth_signed_sqrt, smooth_sqrt
from jaxtank.plants.tank_network import TankNetwork


class Rates(NamedTuple):
    """Coefficients of h' over a box of plants, each divided by the area of its tank."""

    out: tuple
    out_most: tuple
    links: tuple
    pipes: tuple
    pumps: tuple
    inflow: tuple
    knee: float
    empty: tuple
    draw: tuple


def rates_of(
    least: TankNetwork, most: TankNetwork, inflow: Any, step: Any, draw: Any = None
) -> Rates:
    """Return the Rates of all plants whose parameters lie between those of two networks."""
    n = least.tanks
    numbers = isinstance(least.gravity, float | int | np.ndarray | np.generic)
    xp = np if numbers else jnp  # of numbers nothing is compiled
    slow, fast = xp.sqrt(2.0 * least.gravity), xp.sqrt(2.0 * most.gravity)
    out, out_most = _free_outlets(least), _free_outlets(most)
    outlets = list(out_most)
    for k, ends in enumerate(least.pipes):
        for i in ends:
            outlets[i] = outlets[i] + most.pipe[k]
    links = tuple(
        (i, j, least.orifice[k] * slow / most.area[j], most.orifice[k] * fast / least.area[j])
        for k, (i, j) in enumerate(least.links)
    )
    pipes = tuple(
        (i, j, least.pipe[k] * slow / most.area[i], most.pipe[k] * fast / least.area[i])
        for k, ends in enumerate(least.pipes)
        for i, j in (ends, ends[::-1])
    )
    # with `bottom`, outflow is limited below this level (see TankNetwork.limited)
    empty = [
        (step * fast * outlets[i] / least.area[i]) ** 2 if least.bottom else 0.0 for i in range(n)
    ]
    return Rates(
        out=tuple(out[i] * slow / most.area[i] for i in range(n)),
        out_most=tuple(out_most[i] * fast / least.area[i] for i in range(n)),
        links=links,
        pipes=pipes,
        pumps=_pumps(least, most),
        inflow=tuple(inflow[i] / least.area[i] for i in range(n)),
        knee=least.knee,
        empty=tuple(empty),
        draw=tuple(0.0 if draw is None else draw[i] / least.area[i] for i in range(n)),
    )


def _free_outlets(plant):
    """[area of what leaves each tank freely, drain and orifices [cm^2]]."""
    out = [plant.drain[i] for i in range(plant.tanks)]
    for k, (source, _) in enumerate(plant.links):
        out[source] = out[source] + plant.orifice[k]
    return out


def _pumps(least, most):
    """(n) {pump: (least, largest) gain into the tank [cm/(s V)]}."""
    pumps: tuple[dict, ...] = tuple({} for _ in range(least.tanks))
    for j, (first, second) in enumerate(least.feeds):
        share = (least.split[j], most.split[j]) if second is not None else (1.0, 1.0)
        _feed(pumps[first], j, least, most, first, *share)
        if second is not None:
            _feed(pumps[second], j, least, most, second, 1.0 - share[1], 1.0 - share[0])
    return pumps


def _feed(pumps, pump, least, most, tank, share_least, share_most):
    """Add the gains of one pump into `tank` to {pump: (least, largest)} [cm/(s V)]."""
    before = pumps.get(pump, (0.0, 0.0))
    pumps[pump] = (
        before[0] + least.pump_gain[pump] * share_least / most.area[tank],
        before[1] + most.pump_gain[pump] * share_most / least.area[tank],
    )


def rise(rates: Rates, tank: int, level: Any, others: Any, operations: Any = None) -> Any:
    """Return Phi_max [cm/s]: the largest rate of a tank's level when its pumps stand still."""
    # Phi_max(h) = -c_min s(h) + sum_in c_max s(h_k) + sum_pipes P(h_k - h) + d_max, P(z) = p_max
    # s(z) for z >= 0, p_min s(z) for z < 0
    root, signed_root, at_least, where = operations or _operations()
    h = at_least(level, 0.0)
    inflows = rates.inflow[tank]  # without outflow, where that may be limited
    rate = inflows - rates.out[tank] * root(h, rates.knee)
    for i, j, least, most in rates.pipes:
        if i == tank:
            s = signed_root(others[j] - h, rates.knee)
            rate = rate + where(s >= 0.0, most, least) * s
            inflows = inflows + most * at_least(s, 0.0)
    rate = where(h < rates.empty[tank], inflows, rate)
    for source, sink, _, most in rates.links:
        if sink == tank:
            rate = rate + most * root(at_least(others[source], 0.0), rates.knee)
    return rate


def fall(rates: Rates, tank: int, level: Any, others: Any, operations: Any = None) -> Any:
    """Return Phi_min [cm/s]: the least rate of a tank's level when its pumps stand still."""
    # Phi_min(h) = -c_max s(h) + sum_in c_min s(h_k) + sum_pipes P(h_k - h) + d_min, P(z) = p_min
    # s(z) for z >= 0, p_max s(z) for z < 0
    root, signed_root, at_least, where = operations or _operations()
    h = at_least(level, 0.0)
    rate = rates.draw[tank] - rates.out_most[tank] * root(h, rates.knee)
    flow = lambda source, value: where(others[source] < rates.empty[source], 0.0, value)
    for i, j, least, most in rates.pipes:
        if i == tank:
            s = signed_root(others[j] - h, rates.knee)
            rate = rate + where(s >= 0.0, flow(j, least * s), most * s)
    for source, sink, least, _ in rates.links:
        if sink == tank:
            rate = rate + flow(source, least * root(at_least(others[source], 0.0), rates.knee))
    return rate


def _operations():
    return smooth_sqrt, smooth_signed_sqrt, lower_clip, jnp.where


def plain_root(h, knee):
    """`smooth_sqrt` of a level h >= 0 in plain numbers."""
    return math.sqrt(h) if h >= knee else math.sqrt(knee) * (1.5 * h / knee - 0.5 * (h / knee) ** 2)


def _plain_signed_root(z, knee):
    if math.isinf(z):
        return z
    exact = math.copysign(math.sqrt(abs(z)), z)
    return z / (z * z + knee * knee) ** 0.25 if abs(z) < 1e6 else exact


PLAIN = (plain_root, _plain_signed_root, max, lambda condition, a, b: a if condition else b)
"""Operations on plain numbers, for `rise` and `fall` before a run."""

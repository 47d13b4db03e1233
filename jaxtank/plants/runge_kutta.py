"""Integration of a plant over a sample: the only copy, for the loop, observers and experiments.

Imports core and xla only.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxtank.core.kahan import added
from jaxtank.plants.base import Plant
from jaxtank.xla.barrier import materialised


class Advanced(NamedTuple):
    """Levels after a sample, and the volumes that overflowed or were missing; (n,) each."""

    x: Sequence[Any]  # levels [cm]
    # what rounding has added to each level too much [cm]; () where not compensated
    excess: tuple[Any, ...]
    spilled: tuple[Any, ...]  # overflow over each rim [cm^3]
    shortfall: tuple[Any, ...]  # volume that a negative inflow could not take [cm^3]


def advance(
    plant: Plant,
    integrator: str,
    t: Any,
    x: Sequence[Any],
    u: Sequence[Any],
    d: Sequence[Any] | None,
    dt: Any,
    substeps: Any,
    *,
    excess: tuple[Any, ...] = (),
    rolled: bool = False,
) -> Advanced:
    """Return the plant's levels a sample later, with overflow after each of its substeps.

    Parameters
    ----------
    plant : Plant
    integrator : "rk4" or "midpoint"
    t : time at the start of the sample [s]
    x : (n) levels [cm]
    u : (m) inputs at the plant, held over the sample [V]
    d : (n) inflows, held over the sample [cm^3/s], or None
    dt : length of the sample [s]
    substeps : number of integrator steps, of equal length; may be traced where `rolled`
    excess : (n) of the sample before [cm]: sums are compensated (float32); () for plain sums
    rolled : a compiled loop over the substeps. Many unrolled steps take minutes to compile with
        their derivatives; one that may be traced cannot be differentiated in reverse mode.

    Returns
    -------
    Advanced

    Examples
    --------
    >>> from jaxtank.plants import state_coupled_four_tank
    >>> empty = (0.0,) * 4
    >>> found = advance(
    ...     state_coupled_four_tank(15.0), "rk4", 0.0, empty, (3.0, 3.0), None, dt=1.0, substeps=2
    ... )
    >>> all(level >= 0.0 for level in found.x)
    True
    """
    h = dt / substeps

    def substep(j, before):
        x, excess, spilled, shortfall = before
        if excess:
            changes = change(plant, integrator, t + j * h, x, u, d, h)
            x, excess = zip(*(added(*each) for each in zip(x, excess, changes)))
        else:
            x = integrate(plant, integrator, t + j * h, x, u, d, h)
        shortfall = tuple(a + b for a, b in zip(shortfall, plant.shortfall(x)))
        x, over = plant.spill(x)
        return Advanced(x, excess, tuple(a + b for a, b in zip(spilled, over)), shortfall)

    if rolled and not (isinstance(substeps, int) and substeps == 1):
        zeros = (jnp.zeros_like(x[0]),) * plant.tanks
        return jax.lax.fori_loop(0, substeps, substep, Advanced(tuple(x), excess, zeros, zeros))
    zeros = (0.0,) * plant.tanks
    found = Advanced(x, excess, zeros, zeros)
    for j in range(substeps):
        found = substep(j, found)
    return found


def integrate(plant, integrator, t, x, u, d, h):
    """Return the levels a step `h` [s] later, by one step of "rk4" or "midpoint" with u and d
    held.
    """
    rates = _rates(plant, integrator, t, x, u, d, h)
    if integrator == "midpoint":
        return _along(x, rates, h)
    # k4 is ready last, so it is added last
    return tuple(
        (a + (h / 6.0) * (p + 2.0 * (q + r))) + (h / 6.0) * s for a, p, q, r, s in zip(x, *rates)
    )


def euler(plant: Plant, x: Sequence[Any], rates: Sequence[Any], h: Any) -> tuple[Any, ...]:
    """Return the levels a step `h` [s] later at given rates, with overflow: forward Euler.

    Parameters
    ----------
    plant : Plant
    x : (n) levels [cm]
    rates : (n) [cm/s]
    h : [s]

    Returns
    -------
    (n) levels [cm]

    Examples
    --------
    >>> from jaxtank.plants import state_coupled_four_tank
    >>> euler(state_coupled_four_tank(15.0), (5.0,) * 4, (1.0, 2.0, 0.0, -1.0), 0.5)
    (5.5, 6.0, 5.0, 4.5)
    """
    return tuple(plant.spill(_along(x, rates, h))[0])


def change(plant, integrator, t, x, u, d, h):
    """Return the change of the levels in that step, for compensated sums (`jaxtank.core.kahan`)."""
    rates = _rates(plant, integrator, t, x, u, d, h)
    if integrator == "midpoint":
        return tuple(h * k for k in rates)
    return tuple((h / 6.0) * (p + 2.0 * (q + r) + s) for p, q, r, s in zip(*rates))


def _along(x, rates, by):
    return tuple(a + by * b for a, b in zip(x, rates))


def _rates(plant, integrator, t, x, u, d, h):
    """Rates of the midpoint, or of the four stages."""
    rate = plant.limited(h)
    if integrator == "midpoint":
        return rate(t + 0.5 * h, _along(x, rate(t, x, u, d), 0.5 * h), u, d)
    # each rate is read by the next stage and by the sum. The two of the midpoint rule are read
    # once.
    k1 = materialised(rate(t, x, u, d))
    k2 = materialised(rate(t + 0.5 * h, _along(x, k1, 0.5 * h), u, d))
    k3 = materialised(rate(t + 0.5 * h, _along(x, k2, 0.5 * h), u, d))
    return k1, k2, k3, rate(t + h, _along(x, k3, h), u, d)

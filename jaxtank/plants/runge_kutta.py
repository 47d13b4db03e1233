"""Integration of a plant over a sample: the only copy, for the loop, observers and experiments."""

import operator
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.checks import check_each, traceable
from jaxtank.core.kahan import added
from jaxtank.core.numerics import lower_clip
from jaxtank.core.vectors import each, is_array, unzipped, zeros
from jaxtank.plants.base import Plant
from jaxtank.plants.elements import sections
from jaxtank.xla.barrier import materialised


class Advanced(NamedTuple):
    """Levels after a sample, and the volumes that overflowed or were missing; (n,) each."""

    x: Sequence[Any]  # levels [cm]
    # what rounding has added to each level too much [cm]; () where not compensated
    excess: Sequence[Any]
    spilled: Sequence[Any]  # overflow over each rim [cm^3]
    shortfall: Sequence[Any]  # volume that a negative inflow could not take [cm^3]


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
    excess: Sequence[Any] = (),
    rolled: bool = False,
) -> Advanced:
    """Return the plant's levels a sample later, with what overflowed in its substeps."""
    h = dt / substeps

    def moved(j, x, excess, d):
        if not len(excess):
            return integrate(plant, integrator, t + j * h, x, u, d, h), excess
        changes = change(plant, integrator, t + j * h, x, u, d, h)
        return unzipped(x, each(added, x, excess, changes))

    def substep(j, before):
        x, excess, spilled, shortfall = before
        if not plant.overflow_within:
            x, excess = moved(j, x, excess, d)
            shortfall = each(operator.add, shortfall, plant.shortfall(x))
            x, over = plant.spill(x)
        else:
            # If all overflow moved at the end of a step, a full tank would stand above its rim
            # until then and a tank below a weir would stand too high, by half of what falls into
            # it in a step. The overflow at the rates of the start is therefore an outflow and an
            # inflow of the step, and only what differs from it moves at the end: none at rest
            within = overflowing(plant, t + j * h, x, u, d, h)
            x, excess = moved(j, x, excess, entering(d, within, h))
            shortfall = each(operator.add, shortfall, plant.shortfall(x))
            network: Any = plant
            x, over = network.spill(x, within)
        return Advanced(x, excess, each(operator.add, spilled, over), shortfall)

    if rolled and not (isinstance(substeps, int) and substeps == 1):
        none = (jnp.zeros_like(x[0]),) * plant.tanks
        return jax.lax.fori_loop(0, substeps, substep, Advanced(tuple(x), excess, none, none))
    advanced = Advanced(x, excess, zeros(x), zeros(x))
    for j in range(substeps):
        advanced = substep(j, advanced)
    return advanced


def predicted(
    model: Plant, integrator: str, t: Any, x: Sequence[Any], u: Sequence[Any], d: Any, dt: Any
) -> Sequence[Any]:
    """Levels (n,) [cm] of a model after dt, for disturbances d of the level rates [cm/s] or ()."""
    # A predicted sample is much longer than a step of the loop. Without a bottom, the slopes at an
    # empty tank grow from sample to sample without limit.
    model = model.with_bottom()
    if model.bottom:
        x = each(lambda h: lower_clip(h, 0.0), x)  # a level of -1e-30 has the slopes of 0
    area = sections(model, x) if d else None
    inflow = None if area is None else tuple(a * v for a, v in zip(area, d))
    x = advance(model, integrator, t, x, u, inflow, dt, 1).x
    if d and area is None:  # a plant that counts in no volumes
        x = [h + dt * v for h, v in zip(x, d)]
    return x


def overflowing(plant, t, x, u, d, h):
    """Volumes (n,) that overflow brings to each tank within `h` [s], or takes, by Euler's rule."""
    if plant.by_volume:
        stored, levels = plant.stored, plant.levels
        after = levels(_along(stored(x), plant.net_flows(h)(t, x, u, d), h))
    else:
        stored = lambda levels: each(operator.mul, levels, plant.area)
        after = _along(x, _field(plant, h)(t, x, u, d), h)
    full = each(lambda v: lower_clip(v, 0.0), after) if plant.bottom else after
    return each(operator.sub, stored(plant.spill(full)[0]), stored(full))


def entering(d, volumes, h):
    """Inflows `d`, and volumes besides that enter within `h` [s]."""
    length = h if isinstance(h, float) else jnp.where(h > 0.0, h, 1.0)  # padded rows of a log: 0 s
    rates = each(lambda v: v / length, volumes)
    return rates if d is None else each(operator.add, d, rates)


def integrate(plant, integrator, t, x, u, d, h):
    """Return the levels a step `h` [s] later, by "rk4" or "midpoint" with u and d held."""
    if plant.by_volume:  # so that no volume is lost where the cross-section changes
        flows = plant.net_flows(h)
        rate = lambda t, volumes, u, d: flows(t, plant.levels(volumes), u, d)
        return plant.levels(_step(rate, integrator, t, plant.stored(x), u, d, h))
    return _step(_field(plant, h), integrator, t, x, u, d, h)


def _field(plant, h):
    """The vector field of a step; InputError for one that jax cannot trace, or of another size."""
    rate = plant.limited(h)
    label = f"plant {type(plant).__name__}: its derivative"

    def rates(t, x, u, d):
        with traceable(label):
            result = rate(t, x, u, d)
        alone = is_array(x) or not any(np.shape(v) for v in (*x, *u))
        check_each(label, result, len(x), "rate", scalar=alone)
        return result

    return rates


def _step(rate, integrator, t, x, u, d, h):
    rates = _rates(rate, integrator, t, x, u, d, h)
    if integrator == "midpoint":
        return _along(x, rates, h)
    # k4 is ready last, so it is added last
    return each(
        lambda a, p, q, r, s: (a + (h / 6.0) * (p + 2.0 * (q + r))) + (h / 6.0) * s, x, *rates
    )


def euler(plant: Plant, x: Sequence[Any], rates: Sequence[Any], h: Any) -> tuple[Any, ...]:
    """Return the levels a step `h` [s] later at given rates, with overflow: forward Euler."""
    return tuple(plant.spill(_along(x, rates, h))[0])


def change(plant, integrator, t, x, u, d, h):
    """Return the change of the levels in that step, for compensated sums (`jaxtank.core.kahan`)."""
    if plant.by_volume:
        return each(operator.sub, integrate(plant, integrator, t, x, u, d, h), x)
    rates = _rates(_field(plant, h), integrator, t, x, u, d, h)
    if integrator == "midpoint":
        return each(lambda k: h * k, rates)
    return each(lambda p, q, r, s: (h / 6.0) * (p + 2.0 * (q + r) + s), *rates)


def _along(x, rates, by):
    return each(lambda a, b: a + by * b, x, rates)


def _rates(rate, integrator, t, x, u, d, h):
    """Rates of the midpoint, or of the four stages."""
    if integrator == "midpoint":
        return rate(t + 0.5 * h, _along(x, rate(t, x, u, d), 0.5 * h), u, d)
    # each rate is read by the next stage and by the sum. The two of the midpoint rule are read
    # once.
    k1 = materialised(rate(t, x, u, d))
    k2 = materialised(rate(t + 0.5 * h, _along(x, k1, 0.5 * h), u, d))
    k3 = materialised(rate(t + 0.5 * h, _along(x, k2, 0.5 * h), u, d))
    return k1, k2, k3, rate(t + h, _along(x, k3, h), u, d)

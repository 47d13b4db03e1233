"""One step of an integrator: what the time loop takes, and observers that carry a model on."""

from jaxtank.xla.barrier import materialised


def integrate(plant, integrator, t, x, u, d, h):
    """Levels a step `h` [s] later, by one step of "rk4" or "midpoint" with u and d held."""
    rates = _rates(plant, integrator, t, x, u, d, h)
    if integrator == "midpoint":
        return _along(x, rates, h)
    # k4 is ready last, so it is added last
    return tuple((a + (h / 6.0) * (p + 2.0 * (q + r))) + (h / 6.0) * s for a, p, q, r, s in zip(x, *rates))


def change(plant, integrator, t, x, u, d, h):
    """What the levels change by in that step, for sums that keep what rounding takes (`jaxtank.core.kahan`)."""
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
    # each rate is read by the next stage and by the sum. The two of the midpoint rule are read once.
    k1 = materialised(rate(t, x, u, d))
    k2 = materialised(rate(t + 0.5 * h, _along(x, k1, 0.5 * h), u, d))
    k3 = materialised(rate(t + 0.5 * h, _along(x, k2, 0.5 * h), u, d))
    return k1, k2, k3, rate(t + h, _along(x, k3, h), u, d)

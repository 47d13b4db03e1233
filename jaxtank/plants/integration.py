"""One step of an integrator: what the time loop takes, and observers that carry a model on."""

from jaxtank.materialise import materialised


def integrate(plant, integrator, t, x, u, d, h):
    """Levels a step `h` [s] later, by one step of "rk4" or "midpoint" with u and d held."""

    def along(k, by):
        return tuple(a + by * b for a, b in zip(x, k))

    if integrator == "midpoint":
        return along(plant.derivative(t + 0.5 * h, along(plant.derivative(t, x, u, d), 0.5 * h), u, d), h)
    # each rate is read by the next stage and by the sum. The two of the midpoint rule are read once.
    k1 = materialised(plant.derivative(t, x, u, d))
    k2 = materialised(plant.derivative(t + 0.5 * h, along(k1, 0.5 * h), u, d))
    k3 = materialised(plant.derivative(t + 0.5 * h, along(k2, 0.5 * h), u, d))
    k4 = plant.derivative(t + h, along(k3, h), u, d)
    # k4 is ready last, so it is added last
    return tuple((a + (h / 6.0) * (p + 2.0 * (q + r))) + (h / 6.0) * s for a, p, q, r, s in zip(x, k1, k2, k3, k4))

"""One step of an integrator: what the time loop takes, and observers that carry a model on."""


def integrate(plant, integrator, t, x, u, d, h):
    """Levels a step `h` [s] later, by one step of "rk4" or "midpoint" with u and d held."""

    def along(k, by):
        return tuple(a + by * b for a, b in zip(x, k))

    k1 = plant.derivative(t, x, u, d)
    k2 = plant.derivative(t + 0.5 * h, along(k1, 0.5 * h), u, d)
    if integrator == "midpoint":
        return along(k2, h)
    k3 = plant.derivative(t + 0.5 * h, along(k2, 0.5 * h), u, d)
    k4 = plant.derivative(t + h, along(k3, h), u, d)
    # k4 is ready last, so it is added last
    return tuple((a + (h / 6.0) * (p + 2.0 * (q + r))) + (h / 6.0) * s for a, p, q, r, s in zip(x, k1, k2, k3, k4))

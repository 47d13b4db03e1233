"""The safety filter against plants simulated by a code of its own: corners of the box, pumps full or
switching at random, readings off by the whole band.
"""

import dataclasses
import math

import jax
import numpy as np
import pytest

from jaxtank import presets
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.plants import network
from jaxtank.safety import design
from jaxtank.safety.certificate import rate_bound

NAMES = ("drain", "orifice", "pipe", "pump_gain", "split")


def root(h, knee):
    h = np.maximum(h, 0.0)
    x = h / knee
    return np.where(h >= knee, np.sqrt(h), math.sqrt(knee) * (1.5 * x - 0.5 * x * x))


def derivative(plant, p, x, u):
    """Rates (P, n) [cm/s] of P plants at once with parameters p, levels x (P, n), inputs u (P, m)."""
    w, n = math.sqrt(2.0 * float(plant.gravity)), plant.tanks
    q = np.stack([root(x[:, i], plant.knee) for i in range(n)], axis=1) * w
    flow = -p["drain"] * q
    for k, (i, j) in enumerate(plant.links):
        flow[:, i] -= p["orifice"][:, k] * q[:, i]
        flow[:, j] += p["orifice"][:, k] * q[:, i]
    for k, (i, j) in enumerate(plant.pipes):
        z = x[:, i] - x[:, j]
        s = w * p["pipe"][:, k] * z / (z * z + plant.knee**2) ** 0.25
        flow[:, i] -= s
        flow[:, j] += s
    for k, (i, j) in enumerate(plant.feeds):
        pumped = p["pump_gain"][:, k] * u[:, k]
        share = p["split"][:, k] if j is not None else 1.0
        flow[:, i] += share * pumped
        if j is not None:
            flow[:, j] += (1.0 - share) * pumped
    return flow / np.asarray(plant.area)


def attack(plant, actuator, found, hold, spread, *, seconds, count=60, seed=0, substeps=4, delay=0, lag=0.0, eps=0.0):
    """Highest level (n,) [cm] over plants at random corners of the box, starts at or below the limits
    and readings off by +-eps; a third with pumps full, the rest switching at random.
    """
    rng = np.random.default_rng(seed)
    n, m, limit = plant.tanks, plant.pumps, np.asarray(found.limit)
    p = {}
    for name in NAMES:
        value = np.asarray(getattr(plant, name), dtype=float)
        off = rng.choice([-1.0, 1.0], (count, *value.shape)) * spread
        p[name] = value * (1.0 + off)
    p["split"] = np.minimum(p["split"], 1.0)
    low, high = np.asarray(actuator.low, float), np.asarray(actuator.high, float)

    @jax.jit
    @jax.vmap
    def filtered(y, u):
        caps, shared = found.limits(tuple(y), hold, tuple(low), tuple(high))
        u = tuple(jax.numpy.clip(u[j], low[j], caps[j]) for j in range(m))
        return jax.numpy.stack(found.scaled(u, shared))

    x = rng.uniform(0.2, 1.0, (count, 1)) * limit * rng.uniform(0.0, 1.0, (count, n)) ** 0.3
    if delay or lag:
        x = 0.02 * x
    line, turning = [np.zeros((count, m)) for _ in range(delay)], np.zeros((count, m))
    want, highest = np.broadcast_to(high, (count, m)).copy(), x.max(0)
    for k in range(int(seconds / hold)):
        if k % max(1, int(2.0 / hold)) == 0:
            switched = np.where(rng.random((count, m)) < 0.5, low, high)
            want = np.where((np.arange(count) % 3 == 0)[:, None], high, switched)
        y = x + eps * rng.choice([-1.0, 1.0], (count, n))
        u = np.asarray(filtered(y, want))
        line.append(u)
        u = line.pop(0)
        h = hold / substeps
        for _ in range(substeps):
            if lag:
                after = u + (turning - u) * math.exp(-h / lag)
                v = u + lag / h * (1.0 - math.exp(-h / lag)) * (turning - u)
                turning = after
            else:
                v = u
            a = derivative(plant, p, x, v)
            b = derivative(plant, p, x + 0.5 * h * a, v)
            c = derivative(plant, p, x + 0.5 * h * b, v)
            d = derivative(plant, p, x + h * c, v)
            x = x + h / 6.0 * (a + 2 * b + 2 * c + d)
            highest = np.maximum(highest, x.max(0))
    return highest


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    import time
    for name, seconds, eps in [("gouta2015/backstepping", 150, 0.1), ("gouta2022/enmpc", 300, 0.1), ("mirakhorli/sfc", 600, 0.1), ("calofir/backstepping", 2000, 0.001), ("khalid/gpc", 3000, 0.001), ("cascaded/pi", 2000, 0.02)]:
        case = presets.find(name)
        loop = case.loop
        hold = max(case.clock.dt, 0.05)
        found, rows = design(loop.plant, loop.actuator, loop.sensor, hold, spread={k: 0.05 for k in NAMES}, band=eps)
        t = time.time()
        actuator = dataclasses.replace(loop.actuator, low=np.maximum(loop.actuator.low, 0.0), high=np.minimum(loop.actuator.high, 50))
        top = attack(loop.plant, actuator, found, hold, 0.05, seconds=seconds, eps=eps)
        print(name, hold, [r.certified for r in rows], found.limit, top, top / found.limit, time.time() - t)

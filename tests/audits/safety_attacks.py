"""Search for a plant, a start and readings that take a level past a limit of the safety filter.

    python tests/audits/safety_attacks.py 0 200        random rigs 0 to 199, one line each
    python tests/audits/safety_attacks.py 0 200 --low  with low limits too, pumps mostly off

Plants at random corners of the box (for odd rigs they change in time), readings off by the whole
band, pumps full or off or switching at random; simulated by a code of its own, in numpy. Exit
code 1 where a certified level passes its limit.
"""

import dataclasses
import math
import sys

import jax
import numpy as np

from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.plants import network
from jaxtank.safety import design
from jaxtank.safety.box import widths_of
from jaxtank.safety.certificate import rate_bound

NAMES = ("drain", "orifice", "pipe", "pump_gain", "split")


def of(plant, share):
    """Half widths of the box of plants whose flows are off by up to `share`."""
    return widths_of(plant, dict.fromkeys(NAMES, share))


def root(h, knee):
    h = np.maximum(h, 0.0)
    x = h / knee
    return np.where(h >= knee, np.sqrt(h), math.sqrt(knee) * (1.5 * x - 0.5 * x * x))


def derivative(plant, p, x, u, d=0.0):
    """Rates (P, n) [cm/s] of P plants with parameters p, levels x (P, n), inputs u (P, m), inflows
    d (P, n) [cm^3/s].
    """
    w, n = math.sqrt(2.0 * float(plant.gravity)), plant.tanks
    q = np.stack([root(x[:, i], plant.knee) for i in range(n)], axis=1) * w
    flow = d - p["drain"] * q
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


def corners(rng, plant, count, spread):
    """{parameter: (count, ..) values} of plants at random corners of the box."""
    p = {}
    for name in NAMES:
        value = np.asarray(getattr(plant, name), dtype=float)
        p[name] = value * (1.0 + rng.choice([-1.0, 1.0], (count, *value.shape)) * spread)
    p["split"] = np.minimum(p["split"], 1.0)
    return p


def filtered_by(found, actuator, hold):
    """Return (readings (P, n), commands (P, m), inputs under way (d, P, m)) -> inputs (P, m)."""
    clipping = dataclasses.replace(found, allocate=False)

    @jax.jit
    @jax.vmap
    def inputs(y, u, line):
        applied = clipping.apply(actuator, tuple(u), None, tuple(y), hold, tuple(line))[0]
        return jax.numpy.stack(applied)

    return lambda y, u, line: np.asarray(inputs(y, u, np.moveaxis(line, 0, 2)))


def begin(rng, found, start, count):
    """Levels (count, n) [cm] between low limits and `start`, a quarter of them at `start`."""
    limit, low = np.asarray(found.limit), np.asarray(found.low)
    start = limit if start is None else np.minimum(start, limit)
    share = rng.uniform(0.2, 1.0, (count, 1)) * rng.uniform(0.0, 1.0, (count, len(limit))) ** 0.3
    x = low + (start - low) * share
    x[: count // 4] = start
    return x


def runge_kutta(plant, p, x, v, d, h):
    a = derivative(plant, p, x, v, d)
    b = derivative(plant, p, x + 0.5 * h * a, v, d)
    c = derivative(plant, p, x + 0.5 * h * b, v, d)
    e = derivative(plant, p, x + h * c, v, d)
    return x + h / 6.0 * (a + 2 * b + 2 * c + e)


def attack(
    plant,
    actuator,
    found,
    hold,
    spread,
    *,
    seconds,
    start=None,
    count=60,
    seed=0,
    substeps=4,
    delay=0,
    lag=0.0,
    eps=0.0,
    inflow=0.0,
    varying=False,
    down=False,
    before=0.0,
    pulses=None,
    each=False,
):
    """(highest, lowest) levels (n,) [cm] over plants of the box, (count, n) where `each`; a third
    with pumps full (off where `down`), the rest switching at random. Inflows at 0 or `inflow` (n,),
    or `pulses` (samples, n) [cm^3/s]. `before`: inputs (m,) that are under way at the start [V].
    """
    rng = np.random.default_rng(seed)
    n, m = plant.tanks, plant.pumps
    p, filtered = corners(rng, plant, count, spread), filtered_by(found, actuator, hold)
    low, high = np.asarray(actuator.low, float), np.asarray(actuator.high, float)
    x = begin(rng, found, start, count)
    turning, dead = np.zeros((count, m)) + before, np.asarray(found.offset)
    line, under_way = [turning] * delay, np.zeros((delay, count, m)) + before
    highest, lowest, d, h = x, x, 0.0, hold / substeps
    for k in range(int(seconds / hold)):
        if k % max(1, int(2.0 / hold)) == 0:
            switched = np.where(rng.random((count, m)) < 0.5, low, high)
            steady = low if down else high
            want = np.where((np.arange(count) % 3 == 0)[:, None], steady, switched)
            d = np.where(rng.random((count, n)) < 0.5, 0.0, inflow)
            p = corners(rng, plant, count, spread) if varying else p
        d = d if pulses is None else pulses[k]
        y = x + eps * rng.choice([-1.0, 1.0], (count, n))
        u = filtered(y, want, under_way[delay - found.predicted :])
        under_way = np.concatenate([under_way, u[None]])[1:]
        line.append(np.maximum(u - dead, 0.0))
        u = line.pop(0)
        for _ in range(substeps):
            v = u
            if lag:
                v = u + lag / h * (1.0 - math.exp(-h / lag)) * (turning - u)
                turning = u + (turning - u) * math.exp(-h / lag)
            x = runge_kutta(plant, p, x, v, d, h)
            highest, lowest = np.maximum(highest, x), np.minimum(lowest, x)
    return (highest, lowest) if each else (highest.max(0), lowest.min(0))


def random_rig(rng):
    """A rig of 1 to 4 tanks with random orifices, pipes, splits and pumps, and its PumpBank."""
    n = int(rng.integers(1, 5))
    links = [(i, j) for i in range(n) for j in range(i + 1, n) if rng.random() < 0.5]
    free = [(i, j) for i in range(n) for j in range(i + 1, n) if (i, j) not in links]
    pipes = [pair for pair in free if rng.random() < 0.3]
    feeds = []
    for _ in range(int(rng.integers(1, 3))):
        first, second = int(rng.integers(n)), int(rng.integers(n))
        feeds.append((first, second if n > 1 and second != first and rng.random() < 0.5 else None))
    plant = network(
        area=rng.uniform(10, 60, n),
        drain=rng.uniform(0.05, 0.6, n),
        links=links,
        orifice=rng.uniform(0.05, 0.4, len(links)),
        pipes=pipes,
        pipe=rng.uniform(0.05, 0.4, len(pipes)),
        feeds=feeds,
        pump_gain=rng.uniform(2, 15, len(feeds)),
        split=rng.uniform(0.2, 0.8, len(feeds)),
        rim=rng.uniform(15, 40, n),
        outputs=(0,),
    )
    return plant, PumpBank(low=np.zeros(len(feeds)), high=np.full(len(feeds), 12.0))


def sensor_of(plant):
    return LevelSensor(noise=np.zeros(plant.tanks))


def trial(seed, with_low=False):
    """(rows of the certificate, highest, lowest levels under attack [cm]) of a random rig."""
    rng = np.random.default_rng(seed)
    plant, actuator = random_rig(rng)
    hold, spread = float(rng.choice([0.1, 0.5, 1.0])), float(rng.choice([0.05, 0.2]))
    eps, start = float(rng.choice([0.0, 0.1])), plant.rim * rng.uniform(0.05, 0.9, plant.tanks)
    delay, lag = [(0, 0.0), (5, 0.0), (3, 0.0), (2, 0.7)][0 if with_low else seed % 4]
    actuator = dataclasses.replace(actuator, delay=delay * hold)
    predict = seed % 8 != 2 and lag == 0.0 and delay > 0 and plant.pipes == ()
    if delay and not predict:
        start = 0.02 * start
    if lag:
        actuator = dataclasses.replace(actuator, lag=np.full(plant.pumps, lag))
    kappa = 0.999 * min(2.0, rate_bound(hold, 0.0 if predict else delay * hold, lag))
    inflow = rng.uniform(0.0, 20.0, plant.tanks) * (seed % 3 == 0)
    given = {"widths": of(plant, spread), "band": eps, "rate": kappa, "start": start}
    given |= {"inflow": inflow, "predict": predict, "substeps": 4}
    if with_low:
        plant = dataclasses.replace(plant, pump_gain=plant.pump_gain * 3.0)
        given |= {"low": start * rng.uniform(0.0, 0.6, plant.tanks), "widths": of(plant, spread)}
    found, rows = design(plant, actuator, sensor_of(plant), hold, **given)
    how = {"seconds": 400 * hold, "count": 30, "seed": seed, "start": start, "inflow": inflow}
    how |= {"delay": delay, "lag": lag, "eps": eps, "varying": seed % 2 == 1, "down": with_low}
    return rows, *attack(plant, actuator, found, hold, spread, **how)


def passed(rows, highest, lowest):
    """[(tank, "upper" or "low")] of the certified limits that a level has passed."""
    over = [r for r in rows if r.certified and highest[r.tank] > min(r.limit, r.reach) + 1e-9]
    under = [r for r in rows if r.low_certified and lowest[r.tank] < r.low - 1e-9]
    return [(r.tank, "upper") for r in over] + [(r.tank, "low") for r in under]


def line_of(row, highest, lowest):
    """Highest level over limit and lowest over low limit [-], and whether each is proved."""
    word = {True: "proved", False: "open"}
    text = f"{word[row.certified]} {highest[row.tank] / min(row.limit, row.reach):.4f}"
    if row.low == 0.0:
        return text
    return f"{text}, low {word[row.low_certified]} {lowest[row.tank] / row.low:.4f}"


def main(first, last, with_low):
    """Print a line for each random rig; return 1 where a certified limit is passed."""
    proved = np.zeros(2, int)
    found = []
    for seed in range(first, last):
        rows, highest, lowest = trial(seed, with_low)
        found += [(seed, *one) for one in passed(rows, highest, lowest)]
        proved += [sum(r.certified for r in rows), sum(r.low_certified for r in rows)]
        print(seed, " | ".join(line_of(r, highest, lowest) for r in rows), flush=True)
    print(f"{proved[0]} upper and {proved[1]} low limits proved; passed: {found or 'none'}")
    return 1 if found else 0


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    words = [w for w in sys.argv[1:] if w != "--low"]
    sys.exit(main(int(words[0]), int(words[1]), "--low" in sys.argv))

"""Random rigs of valves, transfer pumps, curves, ports and shaped tanks beside an integrator of our
own: plain numpy formulas and SciPy's DOP853. Rigs of one structure share their compiled programs.
"""

import functools
import math

import jax
import numpy as np
from outlet_attacks import streams
from scipy.integrate import solve_ivp

from jaxtank.plants.network import network
from jaxtank.plants.runge_kutta import advance

KNEE, GRAVITY = 1e-3, 9.81
STRUCTURES = 20
"""Topologies and shapes among which the rigs are."""
DURATION = 20.0


def random_rig(seed):
    """Return (keywords of `network`, levels, inputs) of a random rig in m, with no kink nearby."""
    rng = np.random.default_rng(seed % STRUCTURES)
    n = int(rng.integers(3, 6))
    shapes = [str(rng.choice(["prism", "cone", "sphere", "horizontal-cylinder"])) for _ in range(n)]
    if rng.random() < 0.4:
        shapes[0] = ((0.0, 0.3), (0.4, 1.0), (0.7, 0.8), (1.0, 0.5))
    pairs = [(int(i), int(j)) for i in range(n) for j in range(n) if i != j]
    chosen = [pairs[k] for k in rng.permutation(len(pairs))]
    links, pipes, valves = chosen[:2], [tuple(sorted(p)) for p in chosen[2:3]], chosen[3:4]
    valves = [*valves, (int(rng.integers(n)), None)]
    feeds = [(int(rng.integers(n)), None) for _ in range(2)]
    bottom = bool(rng.random() < 0.5)
    rng = np.random.default_rng([seed, STRUCTURES])
    height = rng.uniform(1.0, 4.0, n)
    curve = ((0.0, 0.0), (0.3, 0.004), (0.8, 0.006), (1.0, 0.02))
    keywords = {
        "area": rng.uniform(0.5, 3.0, n),
        "extent": height,
        "shapes": shapes,
        "rim": height,
        "drain": rng.uniform(0.0, 2e-3, n),
        "links": links,
        "orifice": rng.uniform(5e-4, 2e-3, len(links)),
        "pipes": pipes,
        "pipe": rng.uniform(1e-3, 5e-3, len(pipes)),
        "feeds": feeds,
        "sources": [None, int((feeds[1][0] + 1) % n)],
        "pump_gain": [1.0, 0.01],
        "curves": [curve, None],
        "lift_curves": [None, ((-5.0, 1.2), (0.0, 1.0), (5.0, 0.4))],
        "valves": valves,
        "valve": rng.uniform(1e-3, 4e-3, 2),
        "characteristics": ["equal-percentage", ((0.0, 0.0), (0.5, 0.2), (1.0, 1.0))],
        "rangeability": 30.0,
        "ports": {  # the second orifice is above all levels, and dry
            "orifice": [float(rng.uniform(0.02, 0.2)), 0.97 * height[links[1][0]]],
            "valve": [0.05, 0.1],
            "pipe": [0.03],
        },
        "exponents": {"drain": rng.uniform(0.4, 1.6, n)},
        "resistances": {"orifice": rng.uniform(200.0, 900.0, 2)},
        "gravity": GRAVITY,
        "knee": KNEE,
        "units": ("m", "-"),
        "bottom": bottom,
    }
    levels = height * rng.uniform(0.45, 0.6, n)
    return keywords, levels, rng.uniform(0.1, 0.9, 4)


def section(shape, area, extent, h):
    """Cross-section at a level, from the shape's definition."""
    y = h / extent
    if shape == "prism":
        return area
    if shape == "cone":
        return area * y**2
    if shape == "sphere":
        return area * 4.0 * y * (1.0 - y)
    if shape == "horizontal-cylinder":
        return area * 2.0 * math.sqrt(y * (1.0 - y))
    return area * float(np.interp(y, *zip(*shape)))


def net_flows(plant, x, u):
    """Net inflow of each tank, by the flows of `outlet_attacks`."""
    names = ("drain", "orifice", "pipe", "pump_gain", "split", "valve")
    p = {name: np.asarray(getattr(plant, name))[None] for name in names}
    rates = np.zeros(len(x))
    for source, sink, (flow,) in streams(plant, p, x[None], np.asarray(u)[None]):
        if source is not None:
            rates[source] -= flow
        if sink is not None:
            rates[sink] += flow
    return rates


@jax.jit
def run(plant, x, u, duration, steps):
    """Levels (n,) [m] after a time."""
    step = duration / steps
    body = lambda k, x: tuple(advance(plant, "rk4", k * step, x, tuple(u), None, step, 1).x)
    return jax.lax.fori_loop(0, steps, body, tuple(x))


@functools.cache
def exact(seed):
    """(seconds, levels (n,) [m] then) of our own integrator, until a level comes near a kink: the
    top, an opening that falls dry, or a corner of a table.
    """
    rig, start, u = random_rig(seed)
    plant = network(**rig)
    sizes = list(zip(rig["shapes"], rig["area"], rig["extent"]))
    heights = np.array(rig["extent"])
    opening = 0.15 * np.ones(len(heights))
    opening[rig["links"][0][0]] = rig["ports"]["orifice"][0] + 0.05
    corners = [k * heights[0] for k in (0.4, 0.7) if not isinstance(rig["shapes"][0], str)]

    def near(t, x):
        away = [np.min(x - np.maximum(opening, 0.1 * heights)), np.min(0.95 * heights - x)]
        return min([*away, *(abs(x[0] - c) - 0.01 for c in corners)])

    near.terminal = True
    solution = solve_ivp(
        lambda t, x: net_flows(plant, x, u) / [section(*s, h) for s, h in zip(sizes, x)],
        (0.0, DURATION),
        start,
        method="DOP853",
        rtol=1e-12,
        atol=1e-13,
        events=near,
    )
    return solution.t[-1], solution.y[:, -1]


def errors(seed, steps=1000):
    """Return the worst error of a level as a share of the tank's height."""
    rig, start, u = random_rig(seed)
    duration, right = exact(seed)
    levels = np.array(run(network(**rig), start, np.asarray(u), float(duration), steps))
    return float(np.max(np.abs(levels - right) / rig["extent"]))


def lost(seed, steps=200):
    """Return by how much the volume of a rig without outlets changes, as a share of it, while its
    tanks run empty and its openings dry.
    """
    rig, start, u = random_rig(seed)
    rig["drain"], rig["bottom"] = 0.0 * rig["drain"], True
    rig["valve"] = np.array([rig["valve"][0], 1e-300])
    u = np.array([0.0, *u[1:]])  # no supply
    rng = np.random.default_rng([seed, 7])
    start = start * rng.choice([1.0, 0.1, 1e-3], len(start))
    plant = network(**rig)
    after = run(plant, start, u, float(10.0 * DURATION), steps)
    before, now = (sum(float(v) for v in plant.stored(x)) for x in (tuple(start), after))
    return abs(now - before) / before


@functools.partial(jax.jit, static_argnames="steps")
def _slope(plant, x, u, duration, direction, weights, steps):
    """Slope of a weighted sum of the levels along a direction (plant, x, u)."""
    level = lambda *args: sum(w * h for w, h in zip(weights, run(*args, duration, steps)))
    return jax.jvp(level, (plant, x, u), direction)[1]


def slope_error(seed, steps=400):
    """Return the difference of a slope, in a random direction of all numbers of a rig, from a
    difference of fourth order, as a share of it.
    """
    rig, start, u = random_rig(seed)
    duration, _ = exact(seed)
    rng, plant = np.random.default_rng([seed, 8]), network(**rig)
    point = jax.tree.map(np.asarray, (plant, start, u))
    direction = jax.tree.map(lambda v: v * rng.uniform(-1.0, 1.0, v.shape), point)
    weights = rng.uniform(0.5, 1.0, len(start)) / rig["extent"]
    at = lambda h: float(
        weights
        @ np.array(run(*jax.tree.map(lambda a, b: a + h * b, point, direction), duration, steps))
    )
    h = 2e-5
    difference = (8.0 * (at(h) - at(-h)) - (at(2.0 * h) - at(-2.0 * h))) / (12.0 * h)
    slope = float(_slope(*point, duration, direction, weights, steps))
    return abs(slope - difference) / max(abs(difference), 0.1)

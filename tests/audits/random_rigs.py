"""Random rigs of one to six tanks that share one compiled program: every orifice, pipe, spill and
pump that six tanks can have is there, and what a rig does not have is closed. A rig of fewer tanks
is padded with dry ones that nothing feeds.
"""

import dataclasses
import itertools

import numpy as np

from jaxtank.plants.network import network

SIZE = 6
LINKS = tuple(itertools.permutations(range(SIZE), 2))
PIPES = tuple(itertools.combinations(range(SIZE), 2))
# a pump for every pair, split between the two; alone on a tank where the split is 0 or 1
FEEDS = PIPES
SPILLS = PIPES  # an upper tank spills into those after it
KINDS = ("series", "parallel", "valve-coupled", "quadruple", "mixed")
RIM = 20.0


class Parts:
    """The leaves of a rig while it is put together."""

    def __init__(self, rng, tanks):
        self.rng, self.tanks = rng, tanks
        self.area = np.r_[rng.uniform(50, 400, tanks), np.full(SIZE - tanks, 50.0)]
        # padded tanks have an outlet too, so that a linear balance has one solution
        self.drain = np.r_[rng.uniform(0.05, 0.3, tanks), np.full(SIZE - tanks, 0.1)]
        self.orifice, self.pipe = np.zeros(len(LINKS)), np.zeros(len(PIPES))
        self.caught = np.zeros(len(SPILLS))
        self.split = np.ones(len(FEEDS))
        self.pumps = []

    def pour(self, source, sink, low=0.03, high=0.1):
        self.orifice[LINKS.index((source, sink))] = self.rng.uniform(low, high)

    def join(self, one, other):
        self.pipe[PIPES.index((min(one, other), max(one, other)))] = self.rng.uniform(0.03, 0.3)

    def feed(self, one, other=None):
        """A pump into one tank, or split between two."""
        # alone: any pair with the tank in it; one that is not in use yet, for every pump has an
        # input of its own
        pairs = [(one, other)] if other is not None else [(one, k) for k in range(SIZE) if k != one]
        first, second = next(p for p in pairs if FEEDS.index((min(p), max(p))) not in self.pumps)
        pump = FEEDS.index((min(first, second), max(first, second)))
        share = 1.0 if other is None else self.rng.uniform(0.1, 0.9)
        self.split[pump] = share if first < second else 1.0 - share
        self.pumps.append(pump)


def random_rig(seed, tanks, kind, *, rim=1e6, knee=0.01):
    """(TankNetwork of SIZE tanks of which `tanks` are in use, numpy generator, pumps in use) of one
    of KINDS. Rims are physics; by default they are out of reach [cm].
    """
    rng = np.random.default_rng([seed, tanks, KINDS.index(kind)])
    parts, every = Parts(rng, tanks), range(tanks)
    if kind == "series":  # a cascade that the last tank leaves
        parts.drain[: tanks - 1] = 0.0
        for i in range(tanks - 1):
            parts.pour(i, i + 1, 0.05, 0.3)
        parts.feed(0)
    elif kind == "parallel":  # each for itself, neighbours sharing a pump
        for i in range(0, tanks - 1, 2):
            parts.feed(i, i + 1)
        for i in every:
            parts.feed(i)
    elif kind == "valve-coupled":  # a row joined below the surface; the ends leave
        parts.drain[1 : max(1, tanks - 1)] = 0.0
        for i in range(tanks - 1):
            parts.join(i, i + 1)
        parts.feed(0)
        if tanks > 1:
            parts.feed(tanks - 1)
    # upper tanks pour into lower ones, pumps feed a lower tank and the upper one of its neighbour
    elif kind == "quadruple":
        half = tanks // 2
        for i in range(half):
            parts.pour(half + i, i, 0.05, 0.3)
        for i in range(half):
            parts.feed(i, half + (i + 1) % half)
        if tanks % 2:
            parts.feed(tanks - 1)
    else:
        for pair in LINKS:  # in rings too
            if max(pair) < tanks and rng.random() < 0.3:
                parts.pour(*pair, 0.02, 0.06)
        for pair in PIPES:
            if max(pair) < tanks and rng.random() < 0.3:
                parts.join(*pair)
        for i in every:
            parts.feed(i)
        for pair in PIPES:
            if max(pair) < tanks and rng.random() < 0.2 and FEEDS.index(pair) not in parts.pumps:
                parts.feed(*pair)
    for source in every:  # what passes a rim may fall into another tank, in part
        below = [k for k, (a, b) in enumerate(SPILLS) if a == source and b < tanks]
        if below and rng.random() < 0.5:
            parts.caught[rng.choice(below)] = rng.uniform(0, 1)
    plant = network(
        area=parts.area, drain=parts.drain, links=LINKS, orifice=parts.orifice, pipes=PIPES,
        pipe=parts.pipe, pump_gain=rng.uniform(2, 10, len(FEEDS)), split=parts.split, feeds=FEEDS,
        spills=SPILLS, caught=parts.caught, rim=rim, outputs=tuple(range(SIZE)), overflow=True,
        knee=knee,
    )  # fmt: skip
    return plant, rng, parts.pumps


def levels(rng, tanks, low=0.0, high=RIM):
    """(SIZE,) levels: of the tanks in use between low and high, 0 of the rest."""
    return np.r_[rng.uniform(low, high, tanks), np.zeros(SIZE - tanks)]


def voltages(rng, pumps, low=0.0, high=10.0):
    """(pumps,) inputs, 0 of the pumps that are not in use."""
    u = np.zeros(len(FEEDS))
    u[pumps] = rng.uniform(low, high, len(pumps))
    return u


def flows(plant, x, u, d):
    """(net inflow of each tank [cm^3/s], what leaves for the basin [cm^3/s]) by matrices and numpy,
    from the equations and not the library; for levels above the knee.
    """
    w = np.sqrt(2.0 * float(plant.gravity))
    q = np.where(x > 0, w * np.sqrt(np.abs(x)), 0.0)
    pour, valve = np.zeros((SIZE, SIZE)), np.zeros((SIZE, SIZE))
    for (a, b), s in zip(LINKS, plant.orifice):
        pour[b, a] = s
    for (a, b), s in zip(PIPES, plant.pipe):
        valve[a, b] = valve[b, a] = s
    apart = x[None, :] - x[:, None]  # [i, j]: h_j - h_i drives liquid from j into i
    through = (valve * w * apart / (apart**2 + plant.knee**2) ** 0.25).sum(axis=1)
    pumped = np.zeros(SIZE)
    for (a, b), gain, share, volts in zip(FEEDS, plant.pump_gain, plant.split, u):
        pumped[a] += gain * share * volts
        pumped[b] += gain * (1.0 - share) * volts
    basin = plant.drain * q
    return pour @ q - pour.sum(axis=0) * q - basin + through + pumped + d, basin


def relabelled(plant, order):
    """The same rig with its tanks in another order: new tank k is the old tank order[k]. Spills are
    closed, for they go downwards only. Returns (rig, pumps: new pump k is the old pump pumps[k]).
    """
    links = [LINKS.index((order[a], order[b])) for a, b in LINKS]
    pairs = [PIPES.index((min(order[a], order[b]), max(order[a], order[b]))) for a, b in PIPES]
    turned = np.array([order[a] > order[b] for a, b in PIPES])
    leaves = {name: np.asarray(getattr(plant, name)) for name in ("area", "drain", "rim")}
    changed = {name: value[list(order)] for name, value in leaves.items()}
    split = np.asarray(plant.split)[pairs]
    changed |= {"orifice": plant.orifice[links], "pipe": plant.pipe[pairs]}
    changed |= {"pump_gain": plant.pump_gain[pairs]}
    changed |= {"split": np.where(turned, 1.0 - split, split), "caught": 0.0 * plant.caught}
    return dataclasses.replace(plant, **changed), pairs

"""Random stiff rigs with negative inflows into tanks that run empty, against small steps of numpy.

    python tests/audits/stiff_rigs.py 120             120 rigs of each of the four kinds
    python tests/audits/stiff_rigs.py 120 --record    also keeps the counts in data/survived.json

Printed: how many are off, and how many of these without a warning.

A rig is off where a level differs from the reference by more than 5 % of its rim at any sample, in
silence where no StepWarning was given. The reference is the projected Euler rule on the equations
written in numpy (levels at or above zero, no flow out of an empty tank, rims and spills), in steps
that follow the film, driven by the inputs of the run: it shares no code with the package.
"""

import sys
import warnings
from functools import partial

import jax
import numpy as np

import jaxtank
from jaxtank import presets
from jaxtank.controllers import OpenLoop
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.core.tree import with_values
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.loop import step_size
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.observers import Direct
from jaxtank.plants.network import network
from jaxtank.signals.base import Constant
from jaxtank.signals.setpoints import ramps

OFF = 0.05  # share of the rim
RIM = 10.0
STEP = 1.0  # of the samples [s]
SAMPLES = 240
FINE = 0.25  # most lambda h of the reference
KINDS = ("cascaded", "coupled", "quadruple", "network")
LINKS = {
    "coupled": ((), ((0, 1),)),
    "quadruple": (((2, 0), (3, 1)), ()),
    "network": (((0, 1), (1, 2), (2, 0)), ((0, 2), (1, 3))),  # a ring of orifices, closed by a pipe
}
FEEDS = {"coupled": ((0, None),), "quadruple": ((0, 3), (1, 2)), "network": ((0, None), (3, None))}


def spread(rng, low, high, size=None):
    """Numbers from low to high, uniform in their logarithm."""
    return np.exp(rng.uniform(np.log(low), np.log(high), size))


def cascaded(rng):
    """The preset with its PI controller; its pump offset draws from tank 1."""
    case = presets.find("cascaded/pi")
    values = {
        "plant.area": rng.uniform(0.5, 5.0, 2),
        "plant.orifice": np.array([spread(rng, 0.02, 2.0)]),
        "plant.drain": np.array([0.0, spread(rng, 0.003, 0.3)]),
        "plant.pump_gain": np.array([spread(rng, 0.003, 0.3)]),
        "x0": rng.uniform(0.0, RIM, 2),
    }
    return with_values(case.loop, values), Clock(dt=4.0, duration=600.0, substeps=4)


def other(kind, rng):
    """Open loop: pumps that stop for a third of the run, tanks of which one is drawn from."""
    links, pipes = LINKS[kind]
    feeds, n = FEEDS[kind], 2 if kind == "coupled" else 4
    area = rng.uniform(0.5, 5.0, n)
    plant = network(
        area=area, drain=area * spread(rng, 0.003, 1.0, n), links=links,
        orifice=[area[i] * spread(rng, 0.01, 1.0) for i, _ in links], pipes=pipes,
        pipe=[min(area[i], area[k]) * spread(rng, 0.01, 0.2) for i, k in pipes],
        pump_gain=[area[i] * spread(rng, 0.02, 0.3) for i, _ in feeds],
        split=rng.uniform(0.2, 0.8, len(feeds)), feeds=feeds, rim=RIM, gravity=0.5, outputs=(0,),
        overflow=True, bottom=True, units=("V", "V"),
    )  # fmt: skip
    m, each = len(feeds), np.ones(len(feeds))
    drawn = np.zeros(n)
    drawn[rng.integers(n)] = -rng.uniform(0.0, 0.3)
    changes = [(80.0, j, 0.0) for j in range(m)]
    changes += [(160.0, j, float(rng.uniform(0.5, 5.0))) for j in range(m)]
    pumps = PumpBank(low=0 * each, high=10 * each, stop=0 * each, pulse=10 * each, initial=0 * each)
    loop = ClosedLoop(
        plant=plant,
        sensor=LevelSensor(gain=np.ones(n), noise=np.zeros(n), full_scale=np.asarray(RIM)),
        observer=Direct(),
        controller=OpenLoop(signal=ramps(list(rng.uniform(0.5, 5.0, m)), changes, ramp=0.0)),
        actuator=pumps,
        reference=ramps([1.0], [(80.0, 0, 2.0)], ramp=0.0),
        disturbance=Constant(level=drawn * area),
        x0=rng.uniform(0.0, RIM, n),
    )
    return loop, Clock(dt=STEP, duration=STEP * SAMPLES)


RIGS = {"cascaded": cascaded, **{kind: partial(other, kind) for kind in KINDS[1:]}}


def drawn(kind, seed):
    """(ClosedLoop, Clock) number `seed` of a kind."""
    return RIGS[kind](np.random.default_rng([seed, KINDS.index(kind)]))


def reference(loops, inputs, dt):
    """(rigs, samples, n) levels of rigs of one kind with `inputs` (rigs, samples, m) held for dt
    [s] each.
    """
    plant = loops[0].plant
    stack = lambda read: np.array([np.asarray(read(loop), dtype=float) for loop in loops])
    leaf = lambda name: stack(lambda loop: getattr(loop.plant, name))
    area, drain, orifice, pipe = map(leaf, ("area", "drain", "orifice", "pipe"))
    gain, split, rim, caught = map(leaf, ("pump_gain", "split", "rim", "caught"))
    x, d, knee = stack(lambda loop: loop.x0), stack(lambda loop: loop.disturbance.level), plant.knee
    fastest = max(step_size.emptying_rates(loop.plant).max() for loop in loops)
    parts = int(np.ceil(dt * fastest / FINE))
    path = []
    for k in range(inputs.shape[1]):
        path.append(x)
        into = d.copy()
        for j, (first, second) in enumerate(plant.feeds):
            share = split[:, j] if second is not None else 1.0
            into[:, first] += gain[:, j] * share * inputs[:, k, j]
            if second is not None:
                into[:, second] += gain[:, j] * (1.0 - share) * inputs[:, k, j]
        for _ in range(parts):
            film = knee**0.5 * (1.5 * x / knee - 0.5 * (x / knee) ** 2)
            q = np.where(x >= knee, np.sqrt(x), film)
            flow = into - drain * q
            for i, (a, b) in enumerate(plant.links):
                flow[:, a] -= orifice[:, i] * q[:, a]
                flow[:, b] += orifice[:, i] * q[:, a]
            for i, (a, b) in enumerate(plant.pipes):
                apart = x[:, a] - x[:, b]
                through = pipe[:, i] * apart / (apart**2 + knee**2) ** 0.25
                flow[:, a] -= through
                flow[:, b] += through
            x = np.maximum(x + dt / parts * flow / area, 0.0)
            for i, (a, b) in enumerate(plant.spills):
                spilt = caught[:, i] * area[:, a] * np.maximum(x[:, a] - rim[:, a], 0.0)
                x[:, b] += spilt / area[:, b]
            x = np.minimum(x, rim)
    return np.stack(path, axis=1)


def tried(kind, seeds):
    """[(error as a share of the rim, True if it was reported)] of rigs of a kind; None of one that
    is refused beforehand.
    """
    loops, runs, reported = [], [], []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", step_size.StepWarning)
        for seed in seeds:
            loop, clock = drawn(kind, seed)
            try:
                run = jaxtank.simulate(loop, clock)
                step_size.check_run(loop, clock, run)
            except InputError:
                continue
            loops.append(loop)
            runs.append((run.x, run.u))
            reported.append(bool(step_size.step_warnings(loop, clock)))
    levels, inputs = (np.stack([np.asarray(run[i]) for run in runs]) for i in (0, 1))
    error = np.abs(levels - reference(loops, inputs, clock.dt)).max(axis=(1, 2)) / RIM
    return list(zip(error, reported))


def main(words):
    jax.config.update("jax_enable_x64", True)
    count = int(next((w for w in words if w.isdigit()), 120))
    off = silent = 0
    worst = 0.0
    for kind in KINDS:
        found = tried(kind, range(count))
        quiet = [error for error, reported in found if not reported]
        off += (here := sum(error > OFF for error, _ in found))
        silent += (unsaid := sum(error > OFF for error in quiet))
        largest = max(quiet, default=0.0)
        worst = max(worst, largest)
        print(
            f"{kind}: {count - len(found)} refused, {len(found) - len(quiet)} reported,"
            f" {here} off, {unsaid} in silence, worst in silence {100 * largest:.2g} %"
        )
    if "--record" in words:
        from survived import record

        record("stiff rigs", 4 * count,
               f"{silent} off by more than {100 * OFF:.0f} % of the rim without a warning "
               f"({off} with one or without; worst without {100 * worst:.1f} %)")  # fmt: skip


if __name__ == "__main__":
    main(sys.argv[1:])

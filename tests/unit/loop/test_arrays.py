"""Vectors as arrays against tuples of scalars: the same runs, on random rigs of any topology."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

from jaxtank import measures as ms
from jaxtank.controllers import PID
from jaxtank.core import vectors
from jaxtank.core.clock import Clock
from jaxtank.core.tree import with_values
from jaxtank.instruments import LevelSensor, PumpBank
from jaxtank.loop.closed_loop import ClosedLoop, takes_arrays
from jaxtank.loop.derivatives import sensitivities_compiled
from jaxtank.loop.run import evaluate_compiled
from jaxtank.loop.saved_rows import simulate_compiled
from jaxtank.observers import Direct
from jaxtank.plants.faults import faults
from jaxtank.plants.network import network
from jaxtank.signals import ramps
from jaxtank.signals.inflows import inflow_pulses

CLOCK = Clock(dt=1.0, duration=60.0, substeps=2)
KEY = jax.random.key(3)


def pairs(rng, tanks, most):
    """Up to `most` different pairs of different tanks, in any order and in rings too."""
    every = [(a, b) for a in range(tanks) for b in range(tanks) if a != b]
    chosen = rng.permutation(len(every))[: rng.integers(1, most + 1)]
    return [every[k] for k in chosen]


def random_plant(rng, tanks):
    """A rig of every kind of part, at rims that overflow, with pumps that feed one or two tanks."""
    links, pipes = pairs(rng, tanks, tanks), pairs(rng, tanks, tanks)
    if rng.random() < 0.3:  # a hub that many pipes meet
        pipes = [(0, i) for i in range(1, tanks)]
    spills = pairs(rng, tanks, tanks)
    count = {a: sum(source == a for source, _ in spills) for a, _ in spills}
    pumps = int(rng.integers(1, min(tanks, 6) + 1))
    outputs = tuple(int(i) for i in rng.permutation(tanks)[:pumps])
    second = [int(rng.choice([t for t in range(tanks) if t != i])) for i in outputs]
    return network(
        area=rng.uniform(15.0, 60.0, tanks),
        drain=rng.uniform(0.05, 0.3, tanks),
        links=links,
        orifice=rng.uniform(0.0, 0.1, len(links)),
        pipes=pipes,
        pipe=rng.uniform(0.0, 0.1, len(pipes)),
        pump_gain=rng.uniform(5.0, 15.0, pumps),
        split=rng.uniform(0.3, 1.0, pumps),
        feeds=[(i, j if rng.random() < 0.5 else None) for i, j in zip(outputs, second)],
        spills=spills,
        caught=[rng.uniform(0.2, 1.0) / count[source] for source, _ in spills],
        rim=rng.uniform(6.0, 20.0, tanks),
        outputs=outputs,
        overflow=bool(rng.random() < 0.8),
        bottom=bool(rng.random() < 0.5),
    )


def random_loop(seed, tanks):
    """A loop with faults, inflow pulses, delay, lag, dead zone, noise and a PID for each output."""
    rng = np.random.default_rng([seed, tanks])
    plant = random_plant(rng, tanks)
    m, kinds = plant.pumps, ("plain", "offset", "hysteresis", "pulse")
    changes = [(float(rng.uniform(0, 50)), int(rng.integers(m)), float(rng.uniform(2, 9)))]
    changes += [(5.0 + k, k, float(rng.uniform(3, 8))) for k in range(m) if rng.random() < 0.7]
    some = lambda value: value if rng.random() < 0.5 else None
    return ClosedLoop(
        plant=plant,
        sensor=LevelSensor(
            noise=rng.uniform(0.0, 0.05, tanks),
            offset=some(rng.uniform(-0.1, 0.1, tanks)),
            gain=np.full(tanks, 8.0),
            full_scale=np.float64(5.0),
            bits=int(rng.choice([0, 12])),
        ),
        observer=Direct(),
        controller=PID(
            model=plant,
            Kc=rng.uniform(0.2, 1.0, m),
            Ti=rng.uniform(10.0, 40.0, m),
            Td=some(rng.uniform(0.5, 2.0, m)),
            Tt=rng.uniform(10.0, 40.0, m),
            bias=rng.uniform(1.0, 3.0, m),
        ),
        actuator=PumpBank(
            low=np.zeros(m),
            high=rng.uniform(6.0, 12.0, m),
            initial=rng.uniform(0.0, 3.0, m),
            dead_zone=some(rng.uniform(0.1, 0.8, m)),
            dead_zone_kind=str(rng.choice(kinds)),
            lag=some(rng.uniform(0.0, 3.0, m)),
            delay=float(rng.choice([0.0, 2.0])),
        ),
        reference=ramps(rng.uniform(3.0, 8.0, m), changes, ramp=float(rng.choice([0.0, 7.5]))),
        disturbance=inflow_pulses(
            tanks, [(9.0, 4.0, 0, 120.0), (12.5, 5.0, tanks - 1, -30.0), (11.0, 3.0, 0, 50.0)]
        ),
        faults=faults(
            plant, [("pump_gain[0]", 20.0, 40.0, 0.6, 0.0), ("drain[1]", 25.0, 50.0, 1.0, 0.1)]
        ),
        x0=rng.uniform(1.0, 8.0, tanks),
    )


def measures_of(loop):
    """Every measure of a run that means something for a loop."""
    return tuple(m for m in (*ms.reported(), *ms.times()) if ms.serves(m, loop))


def in_form(monkeypatch, arrays, function, *args, **static):
    """function(*args) with vectors of the form wanted, compiled anew."""
    monkeypatch.setattr(vectors, "FROM", 1 if arrays else 10**9)
    assert takes_arrays(args[0]) == arrays
    plain = functools.partial(function.__wrapped__, **static)
    return jax.tree.map(np.asarray, jax.jit(plain)(*args))


def compare(monkeypatch, loop, names):
    """Assert that both forms give the same run, measures, slopes and Gauss-Newton matrix."""
    kept = {"clock": CLOCK, "save_every": 3}
    one, many = (
        in_form(monkeypatch, arrays, simulate_compiled, loop, key=KEY, **kept)[0]
        for arrays in (False, True)
    )
    for name in ("t", "x", "y", "r", "e", "command", "applied", "u", "spilled", "d_hat"):
        np.testing.assert_allclose(getattr(many, name), getattr(one, name), rtol=0, atol=1e-9)
    values = {"controller.Kc": loop.controller.Kc[0], "plant.gravity": loop.plant.gravity}
    static = {"clock": CLOCK, "names": names, "order": tuple(values)}
    point = {"values": tuple(values.values()), "key": KEY}
    one, many = (
        in_form(monkeypatch, arrays, sensitivities_compiled, loop, **static, **point)
        for arrays in (False, True)
    )
    for a, b, tolerance in zip(one[:3], many[:3], (1e-9, 1e-7, 1e-7)):
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
            size = max(1.0, float(np.max(np.abs(x), initial=0.0, where=np.isfinite(x))))
            np.testing.assert_allclose(y, x, rtol=0, atol=tolerance * size)


@pytest.mark.parametrize(("seed", "tanks"), [(0, 3), (1, 5), (2, 8)])
def test_arrays_and_scalars_give_the_same_run(monkeypatch, seed, tanks):
    loop = random_loop(seed, tanks)
    compare(monkeypatch, loop, measures_of(loop))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3, 23))
def test_arrays_and_scalars_give_the_same_run_on_many_rigs(monkeypatch, seed):
    loop = random_loop(seed, 3 + seed % 28)
    compare(monkeypatch, loop, measures_of(loop))

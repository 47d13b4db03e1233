"""Vectors as arrays against tuples of scalars: the same runs, on random rigs of any topology."""

import functools

import jax
import numpy as np
import pytest
from helpers import programs_in

from jaxtank import measures as ms
from jaxtank.controllers import PID
from jaxtank.core import vectors
from jaxtank.core.clock import Clock
from jaxtank.instruments import LevelSensor, PumpBank
from jaxtank.loop.closed_loop import ClosedLoop, takes_arrays
from jaxtank.loop.derivatives import sensitivities_compiled
from jaxtank.loop.run import evaluate_compiled
from jaxtank.loop.saved_rows import simulate_compiled
from jaxtank.observers import Direct
from jaxtank.plants.faults import SensorFault, faults
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
        area=rng.uniform(15.0, 60.0, tanks), drain=rng.uniform(0.05, 0.3, tanks), links=links,
        orifice=rng.uniform(0.0, 0.1, len(links)), pipes=pipes,
        pipe=rng.uniform(0.0, 0.1, len(pipes)), pump_gain=rng.uniform(5.0, 15.0, pumps),
        split=rng.uniform(0.3, 1.0, pumps),
        feeds=[(i, j if rng.random() < 0.5 else None) for i, j in zip(outputs, second)],
        spills=spills, caught=[rng.uniform(0.2, 1.0) / count[source] for source, _ in spills],
        rim=rng.uniform(6.0, 20.0, tanks), outputs=outputs, overflow=bool(rng.random() < 0.8),
        bottom=bool(rng.random() < 0.5),
    )  # fmt: skip


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
            plant,
            [("pump_gain[0]", 20.0, 40.0, 0.6, 0.0), ("drain[1]", 25.0, 50.0, 1.0, 0.1)],
            [
                (SensorFault(0, "freeze", 15.0, 30.0), 0.0),
                (SensorFault(0, "spikes", 32.0, 50.0, 5.0), 0.4),
                (SensorFault(1, "noise", 25.0, 40.0), 0.3),
            ],
        ),
        x0=rng.uniform(1.0, 8.0, tanks),
    )


def measures_of(loop):
    """Every measure of a run that means something for a loop; but times at which an extreme was
    reached, of which rounding decides where a level stays at a bound.
    """
    return tuple(m for m in ms.reported() if ms.serves(m, loop))


def in_form(monkeypatch, arrays, function, *args, **static):
    """function(*args) with vectors of the form wanted, compiled anew."""
    monkeypatch.setattr(vectors, "FROM", 1 if arrays else 10**9)
    assert takes_arrays(args[0]) == arrays
    plain = functools.partial(function.__wrapped__, **static)
    return jax.tree.map(np.asarray, jax.jit(plain)(*args))


def compare_runs(monkeypatch, loop):
    """Assert that both forms give the same run."""
    kept = {"clock": CLOCK, "save_every": 3}
    one, many = (
        in_form(monkeypatch, arrays, simulate_compiled, loop, key=KEY, **kept)[0]
        for arrays in (False, True)
    )
    for name in ("t", "x", "y", "r", "e", "command", "applied", "u", "spilled", "d_hat"):
        np.testing.assert_allclose(getattr(many, name), getattr(one, name), rtol=0, atol=1e-9)


def compare_measures(monkeypatch, loop, names, clock=CLOCK):
    """Assert that both forms give the same measures, slopes and Gauss-Newton matrix."""
    values = {"controller.Kc": loop.controller.Kc[0], "plant.gravity": loop.plant.gravity}
    static = {"clock": clock, "names": names, "order": tuple(values)}
    point = {"values": tuple(values.values()), "key": KEY}
    one, many = (
        in_form(monkeypatch, arrays, sensitivities_compiled, loop, **static, **point)
        for arrays in (False, True)
    )
    for a, b, tolerance in zip(one[:3], many[:3], (1e-9, 1e-7, 1e-7)):
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
            size = max(1.0, float(np.max(np.abs(x), initial=0.0, where=np.isfinite(x))))
            np.testing.assert_allclose(y, x, rtol=0, atol=tolerance * size)


def row(tanks):
    """Tanks in a row with every kind of part, whose structure is the same for any number."""
    ends = [(i, i + 1) for i in range(tanks - 1)]
    plant = network(
        area=15.0 + np.arange(tanks) % 3, drain=0.05, links=ends[::2], orifice=0.05, pipes=ends,
        pipe=0.2, pump_gain=8.0, feeds=[(0, 1), (tanks // 2, None)], split=0.5, spills=ends,
        caught=0.5, rim=20.0, outputs=(0, tanks // 2), overflow=True, bottom=True,
    )  # fmt: skip
    two = {name: [value] * 2 for name, value in {"Kc": 1.0, "Ti": 10.0, "Tt": 10.0}.items()}
    return ClosedLoop(
        plant=plant,
        sensor=LevelSensor(noise=np.full(tanks, 0.01)),
        observer=Direct(),
        controller=PID(model=plant, Td=[1.0, 1.0], bias=[1.0, 1.0], **two),
        actuator=PumpBank(low=[0.0] * 2, high=[9.0] * 2, lag=[1.0] * 2, delay=2.0),
        reference=ramps([5.0, 5.0], [(5.0, 0, 8.0), (9.0, 1, 6.0)]),
        disturbance=inflow_pulses(tanks, [(9.0, 4.0, 0, 120.0)]),
        faults=faults(plant, [("drain[1]", 25.0, 50.0, 1.0, 0.1)]),
        x0=np.full(tanks, 5.0),
    )


def loop_of(tanks):
    """The programs of the body of the time loop of a run with its measures."""
    loop = row(tanks)
    plain = functools.partial(
        evaluate_compiled.__wrapped__, clock=CLOCK, names=measures_of(loop), checkpoint=False
    )
    whole = jax.make_jaxpr(lambda loop: plain(loop, key=KEY))(loop).jaxpr
    bodies = [e.params["jaxpr"].jaxpr for e in whole.eqns if e.primitive.name == "scan"]
    (body,) = [b for b in bodies if len(b.eqns) > 100]
    return list(programs_in(body))


@pytest.mark.slow
def test_the_body_of_the_loop_does_not_grow_with_the_number_of_tanks():
    """What makes the time to compile a rig grow is the number of operations in the loop."""
    few, many = loop_of(16), loop_of(200)
    assert sum(len(p.eqns) for p in few) == sum(len(p.eqns) for p in many)
    names = {e.primitive.name for p in many for e in p.eqns}
    assert not {name for name in names if "scatter" in name or name in ("sort", "while")}
    assert "gather" in names


def test_what_is_computed_once_is_read_through_its_barrier_alone():
    """An array that is read beside its barrier may have been overwritten by then."""
    walls = 0
    for program in loop_of(16):
        for wall in program.eqns:
            if wall.params.get("name") != "_as_it_is":
                continue
            walls += 1
            for v in (v for v in wall.invars if getattr(v.aval, "ndim", 0)):
                readers = [e for e in program.eqns if e is not wall and v in list(e.invars)]
                assert not readers and v not in list(program.outvars)
    assert walls >= 12


def test_arrays_and_scalars_give_the_same_measures_and_slopes(monkeypatch):
    clock = Clock(dt=1.0, duration=60.0)
    names = ("rms_error", "max_level", "overflow_volume", "input_travel", "settling_time")
    compare_measures(monkeypatch, random_loop(0, 2), names, clock)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_arrays_and_scalars_give_the_same_run_on_many_rigs(monkeypatch, seed):
    loop = random_loop(seed, 3 + seed % 8)  # scalars of 20 tanks compile for minutes
    compare_runs(monkeypatch, loop)
    compare_measures(monkeypatch, loop, measures_of(loop))

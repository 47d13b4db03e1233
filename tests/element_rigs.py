"""Rigs of valves, transfer pumps, curves, ports and shaped tanks, as cases built in Python."""

import numpy as np

from jaxtank import controllers, observers
from jaxtank.case import Case
from jaxtank.core.clock import Clock
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.plants.network import network
from jaxtank.signals import Constant
from jaxtank.signals.setpoints import ramps


def valve():
    """A tank with a steady inflow and a valve in its outlet: the more it opens, the lower h."""
    plant = network(
        area=[50.0], drain=[0.0], pump_gain=(), feeds=(), rim=[40.0], valves=[(0, None)],
        valve=[0.8], bottom=True,
    )  # fmt: skip
    return plant, {"Kc": [-0.1], "bias": [0.5]}, {"inflow": [60.0], "level": [15.0], "high": 1.0}


def recycle():
    """A tank above another one from which a pump with curve and head loss brings liquid back."""
    plant = network(
        area=[60.0, 90.0], drain=0.0, links=[(0, 1)], orifice=[0.4], pump_gain=[1.0],
        feeds=[(0, None)], sources=[1],
        curves=[((0.0, 0.0), (3.0, 20.0), (8.0, 90.0), (12.0, 120.0))],
        lift_curves=[((-20.0, 1.1), (0.0, 1.0), (40.0, 0.7))], rim=[40.0, 40.0], bottom=True,
    )  # fmt: skip
    return plant, {"Kc": [0.6], "bias": [6.0]}, {"level": [12.0, 25.0]}


def cone():
    """A cone that a pump fills, with an outlet above its bottom and a leak linear in its level."""
    plant = network(
        area=[120.0], drain=[0.2], pump_gain=[10.0], feeds=[(0, None)], rim=[30.0], shapes=["cone"],
        extent=[30.0], ports={"drain": [2.0]}, exponents={"drain": [0.6]},
        resistances={"drain": [4.0]}, overflow=True, bottom=True,
    )  # fmt: skip
    return plant, {"Kc": [1.0], "bias": [6.0]}, {"level": [15.0]}


def joined():
    """Two tanks joined by a valve, an outlet by another one; a pump fills the first."""
    plant = network(
        area=[60.0, 40.0], drain=[0.0, 0.0], pump_gain=[12.0], feeds=[(0, None)],
        valves=[(0, 1), (1, None)], valve=[1.2, 0.9],
        characteristics=["equal-percentage", "linear"], rangeability=30.0,
        ports={"valve": [0.5, 0.0]}, rim=[40.0, 40.0], outputs=(0, 1),
    )  # fmt: skip
    more = {"level": [20.0, 12.0], "high": [12.0, 1.0, 1.0]}
    return plant, {}, more


RIGS = {f.__name__: f for f in (valve, recycle, cone)}


def case(name, step=1.2, controller=None, **changes):
    """A Case of a rig by name: PI control, a setpoint that is changed by a factor after 20 s."""
    plant, gains, more = RIGS[name]()
    level = np.array(more["level"])
    outputs = level[list(plant.outputs)]
    if controller is None:
        controller = controllers.PID(model=plant, Ti=[40.0], Tt=[20.0], **gains)
    loop = ClosedLoop(
        plant=plant,
        sensor=LevelSensor(gain=np.ones(plant.tanks), noise=np.zeros(plant.tanks), full_scale=40.0),
        observer=changes.pop("observer", observers.Direct()),
        controller=controller,
        actuator=PumpBank(
            low=np.zeros(plant.pumps),
            high=np.full(plant.pumps, more.get("high", 12.0)),
            initial=np.asarray(gains.get("bias", np.zeros(plant.pumps))),
        ),
        reference=ramps(outputs, [(20.0, 0, step * outputs[0])], ramp=10.0),
        disturbance=Constant(level=more["inflow"]) if "inflow" in more else None,
        x0=level,
    )
    clock = Clock(dt=changes.pop("dt", 0.5), duration=changes.pop("duration", 100.0))
    options = {
        "title": name,
        "limits": {"max_level": "rim"},
        "free": {"controller.Kc[0]": (-2.0, -0.01) if name == "valve" else (0.01, 10.0)},
        "objective": {"rms_error_total": 1.0},
    }
    return Case(name=name, loop=loop, clock=clock, **{**options, **changes})

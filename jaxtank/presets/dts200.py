"""The three-tank laboratory rig DTS200: two pumps, two pipes, leaks; PI (notes/dts200.md)."""

import functools
from typing import Any

import numpy as np

from jaxtank.analysis.linear_model import linearise
from jaxtank.analysis.steady_state import equilibrium
from jaxtank.case import Case, Free
from jaxtank.controllers import PID
from jaxtank.core.clock import Clock
from jaxtank.plants.faults import faults
from jaxtank.plants.network import network
from jaxtank.presets.paper import Claim, Preset, closed_loop, printed
from jaxtank.signals.setpoints import ramps

AREA, PIPE, HEIGHT, FLOW = 154.0, 0.5, 62.0, 150.0  # [cm^2], [cm^2], [cm], [cm^3/s]
COEFFICIENTS = (0.46, 0.60, 0.45)  # of pipe 1 to 3, of the outlet of tank 2, of pipe 3 to 2
POINT = (45.0, 15.0, 30.0)  # levels at which the printed model is linearised [cm]

KC, TI = 10.0, 100.0  # ours [cm^2/s], [s]
DURATION = 2400.0
STEPS = [(100.0, 0, 45.0), (900.0, 1, 20.0), (1700.0, 0, 38.0)]
LEAK = 0.2  # area of a leak of tank 3, ours [cm^2]
PLUGGED = 0.5  # share of the pipe from tank 1 to 3 that stays open, ours

TIMES = dict.fromkeys(("controller.Ti", "controller.Tt"), Free(5.0, 2000.0))
TUNABLE = {"controller.Kc": Free(0.5, 100.0), **TIMES}


def rig():
    """Return the three tanks: pumps into 1 and 2, pipes 1 to 3 and 3 to 2, outlet at tank 2."""
    first, outlet, second = COEFFICIENTS
    return network(
        area=[AREA] * 3,
        drain=[0.0, outlet * PIPE, 0.0],
        pipes=[(0, 2), (2, 1)],
        pipe=[first * PIPE, second * PIPE],
        pump_gain=[1.0, 1.0],
        feeds=[(0, None), (1, None)],
        rim=HEIGHT,
        outputs=(0, 1),
        bottom=True,
        units=("cm", "cm^3/s"),
    )


def loop(faulty=False):
    """Return the closed loop, with a leak of tank 3 and a plugged pipe if `faulty`."""
    plant = rig()
    x0, u0 = equilibrium(plant, np.array([40.0, 15.0]))
    events = [("drain[2]", 500.0, 700.0, 1.0, LEAK), ("pipe[0]", 1300.0, 1500.0, PLUGGED, 0.0)]
    gains: Any = {"Kc": [KC, KC], "Ti": [TI, TI], "Tt": [TI, TI], "bias": u0}
    return closed_loop(
        plant,
        PID(model=plant, **gains),
        ramps([40.0, 15.0], STEPS, ramp=0.0),
        x0,
        sensor=(1.0, 70.0),
        pumps={"low": 0.0, "high": FLOW, "initial": u0},
        faults=faults(plant, events) if faulty else None,
    )


def measured(run):
    """Return measured values of the published rows (see `paper.Preset`)."""
    plant = run("pi")[0].loop.plant
    levels = np.array(POINT)
    speed = np.sqrt(2 * 981.0)
    through, out, back = (c * PIPE * speed * np.sqrt(15.0) for c in COEFFICIENTS)
    A, B, _ = linearise(plant, levels, np.array([through, out - back]))
    rest, flows = equilibrium(plant, levels[:2])
    return {
        "linear model, A": tuple(map(float, np.ravel(A))),
        "linear model, B": float(B[0, 0]),
        "rest at the operating point": Claim(
            abs(float(rest[2]) - POINT[2]) < 0.5,
            f"with tanks 1 and 2 at 45 and 15 cm tank 3 rests at {float(rest[2]):.2f} cm, with"
            f" pumps at {float(flows[0]):.1f} and {float(flows[1]):.1f} cm^3/s",
        ),
    }


@functools.cache
def preset():
    """Return the Preset of this rig."""
    cases = {
        name: Case(
            name=f"dts200/{name}",
            title=f"three tanks in a row, two pumps, {title}",
            loop=loop(faulty),
            clock=Clock(dt=1.0, duration=DURATION),
            limits={"max_level": "rim"},
            free={p: TUNABLE[p] for p in ("controller.Kc", "controller.Ti")},
            objective={"rms_error_total": 1.0},
        )
        for name, title, faulty in (
            ("pi", "PI", False),
            ("pi-faults", "PI; a leak of tank 3, then a half plugged pipe", True),
        )
    }
    return Preset(**printed("dts200"), cases=cases, measured=measured, tunable=TUNABLE)

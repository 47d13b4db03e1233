"""Johansson (2000): quadruple tank with an adjustable zero, PI (notes/johansson.md)."""

import functools
from typing import Any

import numpy as np

from jaxtank.analysis.linear_model import linearise, relative_gain_array, transmission_zeros
from jaxtank.analysis.steady_state import steady_levels
from jaxtank.case import Case, Free
from jaxtank.controllers import PID
from jaxtank.core.clock import Clock
from jaxtank.plants.rigs import JOHANSSON, johansson
from jaxtank.presets.paper import Claim, Preset, closed_loop, printed
from jaxtank.signals.setpoints import ramps

VOLTS_PER_CM = 0.5  # kc, Table I: the gains are printed for levels in volts
# (K [V/V], Ti [s]) of the two loops, sec. V
PRINTED_GAINS = {
    "minimum": ((3.0, 2.7), (30.0, 40.0)),
    "non-minimum": ((1.5, -0.12), (110.0, 220.0)),
}
STEP = 2.0  # of each setpoint [cm], ours: notes A2
# times of the step of each setpoint, and length of the run [s], ours: notes A2
TIMES = {"minimum": (50.0, 650.0, 1250.0), "non-minimum": (100.0, 5100.0, 10100.0)}
NAMES = {"minimum": "pi-minimum", "non-minimum": "pi-nonminimum"}

TUNABLE = {
    "controller.Kc[0]": Free(0.01, 20.0),
    "controller.Kc[1]": Free(-0.6, 20.0, "linear"),  # of both signs: notes S4
    "controller.Ti": Free(5.0, 3000.0),
    "controller.Tt": Free(2.0, 3000.0),
}
# where each case is tuned: a gain keeps its sign
FREE = {
    "pi-minimum": {"controller.Kc": Free(0.05, 20.0), "controller.Ti": Free(5.0, 1000.0)},
    "pi-nonminimum": {
        "controller.Kc[0]": Free(0.01, 5.0),
        "controller.Kc[1]": Free(-0.6, -0.002, "linear"),
        "controller.Ti": Free(10.0, 3000.0),
    },
}

# h0 at P- and P+ [cm]
LEVELS = {"minimum": (12.4, 12.7, 1.8, 1.4), "non-minimum": (12.6, 13.0, 4.8, 4.9)}


def loop(phase):
    """Return the closed loop at one of the two operating points."""
    rig, volts = johansson(phase)
    levels = np.asarray(steady_levels(rig, volts))
    K, Ti = PRINTED_GAINS[phase]
    first, second, _ = TIMES[phase]
    start = [float(h) for h in levels[:2]]
    gains: Any = {"Kc": [VOLTS_PER_CM * k for k in K], "Ti": Ti, "Tt": Ti, "bias": volts}
    return closed_loop(
        rig,
        PID(model=rig, **gains),
        ramps(start, [(first, 0, start[0] + STEP), (second, 1, start[1] + STEP)], ramp=0.0),
        levels,
        sensor=(1.0 / VOLTS_PER_CM, 10.0),
        pumps={"low": 0.0, "high": 10.0, "initial": volts},
    )


def measured(run):
    """Return measured values of the published rows (see `paper.Preset`)."""
    rows, slowest = {}, {}
    for phase, levels in LEVELS.items():
        plant, volts = run(NAMES[phase])[0].loop.plant, JOHANSSON[phase][2]
        at = np.asarray(steady_levels(plant, volts))
        A, B, C = linearise(plant, levels, volts)
        point = levels if phase == "minimum" else at
        zeros = sorted(float(z.real) for z in transmission_zeros(*linearise(plant, point, volts)))
        slowest[phase] = zeros[-1]
        controller = run(NAMES[phase])[0].loop.controller
        rows |= {
            f"pump gains, {phase} phase": tuple(map(float, plant.pump_gain)),
            f"splits, {phase} phase": tuple(map(float, plant.split)),
            f"voltages, {phase} phase": tuple(map(float, controller.bias)),
            f"gains K, {phase} phase": tuple(map(float, controller.Kc / VOLTS_PER_CM)),
            f"integral times, {phase} phase": tuple(map(float, controller.Ti)),
            f"levels, {phase} phase": tuple(map(float, at)),
            f"time constants, {phase} phase": tuple(map(float, -1.0 / np.diag(A))),
            f"zeros, {phase} phase": tuple(zeros),
            f"relative gain, {phase} phase": float(relative_gain_array(A, B, C)[0, 0]),
        }
    return {
        **rows,
        "the zero's half-plane": Claim(
            (slowest["minimum"] < 0.0, slowest["non-minimum"] > 0.0),
            f"{slowest['minimum']:.3f} 1/s with splits of 0.70 and 0.60,"
            f" {slowest['non-minimum']:+.3f} 1/s with 0.43 and 0.34",
        ),
    }


@functools.cache
def preset():
    """Return the Preset of this paper."""
    cases = {
        name: Case(
            name=f"johansson/{name}",
            title=f"quadruple tank, {phase} phase, decentralised PI",
            loop=loop(phase),
            clock=Clock(dt=1.0, duration=TIMES[phase][2]),
            limits={"max_level": "rim"},
            free=FREE[name],
            objective={"rms_error_total": 1.0},
        )
        for phase, name in NAMES.items()
    }
    return Preset(**printed("johansson"), cases=cases, measured=measured, tunable=TUNABLE)

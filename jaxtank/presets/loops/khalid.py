"""The rig, the scenarios and the closed loops of khalid: GPC and Laguerre functions.

Lengths in m, inputs in U0 = 1e-4 m^3/s.
"""

import math

from jaxtank.case import Free
from jaxtank.controllers import GPC, Laguerre
from jaxtank.core.clock import Clock
from jaxtank.core.tree import number
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.observers import Direct
from jaxtank.plants import coupled_tanks
from jaxtank.signals.setpoints import ramps

U0 = 1e-4  # unit of the inputs (notes S2.1) [m^3/s]


CHANNEL = 78.5e-6  # s1 = s2 = s3, Table I [m^2]
DISCHARGE = (1.0, 1.0, 0.5)  # a0, a0, a1, Table I [-]
GRAVITY = 9.8  # g, Table I [m/s^2]
WIDE = 1e3  # limit of pumps that have none [U0]
HALF = 300.0  # half period of the pulses (notes A5) [s]
# Ts, 600 samples (notes A1, S3), Runge-Kutta steps of 0.25 s
CLOCK = Clock(dt=2.0, duration=1198.0, substeps=8)

MIDDLE = {
    1: (0.30, 0.06),
    2: (0.06, 0.075),
}  # where the model is linearised: the middle of the pulse, by number of pumps (notes A4) [m]

# scenario: (pumps, (low, high) of each output [m], start (H1, H2) [m], delay of the last output's
# pulses [s])
SCENARIOS = {
    "S1": (1, ((0.0, 0.12),), (0.0, 0.0), 0.0),
    "S2": (1, ((0.03, 0.15),), (0.15, 0.03), 0.0),
    "M1": (2, ((0.0, 0.12), (0.0, 0.15)), (0.0, 0.0), 0.0),
    "M2": (2, ((0.04, 0.16), (0.03, 0.18)), (0.04, 0.03), 0.0),
    "M3": (2, ((0.0, 0.12), (0.0, 0.15)), (0.0, 0.0), 150.0),
}

TUNABLE = {
    "controller.r_w": Free(1e-5, 1.0),
    "controller.a": Free(0.0, 0.95, "linear"),
    "controller.q": Free(0.1, 10.0),
    "controller.operating_point": Free(0.01, 1.0),
    # with one pump: apart from the highest H2, where the model has no slope
    "controller.operating_point[0]": Free(0.18, 0.8),
    "controller.operating_point[1]": Free(0.02, 0.16),
    "controller.du_limit": Free(0.05, 3.0),
    "controller.u_low": Free(0.0, 0.5, "linear"),
    "controller.u_high": Free(1.7, 5.0),
}


CONTROLLERS = {  # case: (controller, its static fields, scenario, title)
    "gpc": (GPC, {"Nc": 10}, "S2", "one pump, GPC with a control horizon of 10"),
    "gpc-nc2": (GPC, {"Nc": 2}, "S2", "one pump, GPC with a control horizon of 2"),
    "gpc-nc30": (GPC, {"Nc": 30}, "S2", "one pump, GPC with a control horizon of 30"),
    "laguerre": (Laguerre, {"N": 4}, "S2", "one pump, four Laguerre functions"),
    "gpc-mimo": (GPC, {"Nc": 10}, "M2", "two pumps, GPC with a control horizon of 10"),
    "laguerre-mimo": (Laguerre, {"N": 4}, "M2", "two pumps, four Laguerre functions each"),
}


def tanks(pumps):
    """Return the coupled tanks with one pump or with two."""
    first, second, between = (CHANNEL * a for a in DISCHARGE)
    return coupled_tanks(
        area=9350e-6,  # A1 = A2, Table I [m^2]
        drain=[0.0 if pumps == 1 else first, second],
        pipe=between,
        pump_gain=U0,
        rim=1.0,
        outputs=(1,) if pumps == 1 else (0, 1),
        feeds=tuple(range(pumps)),
        gravity=GRAVITY,
        knee=1e-4,
        bottom=True,
        units=("m", "U0"),
    )


def steady_input(pumps, x):
    """Return the inputs (pumps,) [U0] that hold the levels x = (H1, H2) [m] (notes S2.2)."""
    alpha = [CHANNEL * a * math.sqrt(2 * GRAVITY) / U0 for a in DISCHARGE]
    between = alpha[2] * math.copysign(math.sqrt(abs(x[0] - x[1])), x[0] - x[1])
    return (
        (between,)
        if pumps == 1
        else (alpha[0] * math.sqrt(x[0]) + between, alpha[1] * math.sqrt(x[1]) - between)
    )


def scenario(name):
    """Return (reference, x0 [m], inputs before t = 0 [U0]) of a scenario of notes S3."""
    pumps, spans, x0, delay = SCENARIOS[name]
    changes = []
    for channel, (low, high) in enumerate(spans):
        begin = delay if channel == len(spans) - 1 else 0.0
        changes += [(begin + k * HALF, channel, low if k % 2 else high) for k in range(4)]
    return (
        ramps([low for low, _ in spans], changes, ramp=0.0),
        number(x0),
        number(steady_input(pumps, x0)),
    )


def build(kind, where=None, mode="unconstrained"):
    """Return the closed loop of a case of CONTROLLERS."""
    controller, sizes, default, _ = CONTROLLERS[kind]
    reference, x0, u0 = scenario(where or default)
    pumps = len(u0)
    plant, free = tanks(pumps), mode == "unconstrained"
    poles = {"a": number([0.4] * pumps)} if controller is Laguerre else {}  # sec. V.A
    return ClosedLoop(
        plant=plant,
        sensor=LevelSensor(
            gain=number([0.1] * 2), noise=number([0.0] * 2), full_scale=number(10.0)
        ),
        observer=Direct(),
        controller=controller(
            model=plant,
            operating_point=number(MIDDLE[pumps]),
            r_w=number(1e-2),
            q=number([1.0] * pumps),
            du_limit=number([0.5] * pumps),
            u_low=number([0.0] * pumps),
            u_high=number([3.0] * pumps),
            mode=mode,
            **poles,
            **sizes,
        ),
        actuator=PumpBank(
            low=number([-WIDE if free else 0.0] * pumps),
            high=number([WIDE if free else 3.0] * pumps),
            stop=number([0.0] * pumps),
            pulse=number([1.0] * pumps),
            initial=u0,
        ),
        reference=reference,
        x0=x0,
    )

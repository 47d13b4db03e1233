"""The rig and the closed loops of mirakhorli: state feedback, sliding mode, and their
fuzzy blend.
"""

import dataclasses
from typing import Any

from jaxtank.analysis.steady_state import equilibrium
from jaxtank.case import Free, Scenario
from jaxtank.controllers import LQI, FuzzyBlend, SlidingMode, StateFeedback
from jaxtank.core.tree import number, with_values
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.observers import Direct
from jaxtank.plants import quadruple_tank
from jaxtank.signals.setpoints import ramps

SETPOINT = (12.0, 12.0)  # Fig. 6 [cm]
WARM = (6.0, 6.0)  # where the -warm cases start [cm]
HIGH = 5.0  # upper limit of the pumps, not in the paper [V]
SPLIT = (0.42, 0.34)  # gamma, Table 1
# with which Q = C'C, R = 3 I gives the printed K to its last digit (notes S4.1)
UNROUNDED_SPLIT = (0.4165, 0.3414)

GAIN = ((0.2422, 0.1954, 0.0522, 0.1541), (0.1932, 0.1409, 0.1675, -0.0144))  # K, sec. 6 [V/cm]


def plant(split=SPLIT):
    """Return the paper's rig: Tables 1 and 2."""
    return quadruple_tank(
        area=[138.9] * 4,  # Table 2 [cm^2]
        outlet=[0.50265] * 4,  # Table 2 [cm^2]: bores of 8 mm
        pump_gain=[27.43, 19.55],  # Table 1 [cm^3/(s V)]
        split=split,
        rim=30.0,  # sec. 6 [cm]
    )


def sliding(model, printed=False):
    """Return the sliding-mode controller: as printed (sec. 6), or corrected (notes S4.4)."""
    values = (10.0, 1.0, 0.1) if printed else (0.05, 0.03, 0.1)
    surface, ks, phi = (number(v) for v in values)
    form, switch = ("printed", "sign") if printed else ("corrected", "tanh")
    return SlidingMode(model=model, surface=surface, ks=ks, phi=phi, form=form, switch=switch)


def blend(model):
    """Return the fuzzy blend of the corrected sliding mode and the state feedback (notes S4.5)."""
    return FuzzyBlend(
        model=model,
        K=number(GAIN),
        surface=number(0.05),
        ks=number(0.03),
        phi=number(0.1),
        b=number([1.0, 1.0]),
        w=number([0.5, 0.5]),
        low=number([0.0, 0.0]),
        high=number([HIGH, HIGH]),
    )


def integral(model):
    """Return the state feedback with integral action (notes S4.6)."""
    return LQI(
        model=model,
        Q=number([1.0, 1.0, 0.0, 0.0, 1e-3, 1e-3]),
        R=number([3.0, 3.0]),
        operating_point=number(SETPOINT),
    )


# the printed controller as a relay: ks 100 hides its chatter
RELAY = {
    "controller.surface": 10.0,
    "controller.ks": 100.0,
    "controller.form": "printed",
    "controller.switch": "sign",
}

SLIDING = ("controller.surface", "controller.ks", "controller.phi")

TUNABLE = {
    "controller.K": Free(-2.0, 2.0, "linear"),
    "controller.surface": Free(0.01, 0.085),
    "controller.ks": Free(3e-3, 0.2),
    "controller.phi": Free(0.04, 1.0),
    "controller.b": Free(0.1, 12.0),
    "controller.w": Free(0.05, 12.0),
    "controller.Q": Free(0.0, 10.0, "linear"),
    "controller.Q[4]": Free(1e-5, 0.1),
    "controller.Q[5]": Free(1e-5, 0.1),
    "controller.R": Free(0.1, 100.0),
}


CONTROLLERS = {  # title, controller for a model, what `tune` changes
    "sfc": ("state feedback", lambda m: StateFeedback(model=m, K=number(GAIN)), ("controller.K",)),
    "smc": ("sliding mode, corrected", sliding, SLIDING),
    "hybrid": (
        "fuzzy blend of sliding mode and state feedback",
        blend,
        (*SLIDING, "controller.b", "controller.w"),
    ),
    "smc-printed": ("sliding mode as printed", lambda m: sliding(m, printed=True), SLIDING[:2]),
    "lqi": (
        "state feedback with integral action",
        integral,
        ("controller.Q[4]", "controller.Q[5]", "controller.R"),
    ),
}

# cases of notes S7.2: what Table 3 needs besides what is printed
FITTED = {"smc-fitted": "smc-printed", "sfc-fitted": "sfc", "hybrid-fitted": "hybrid"}


def fitted(name):
    """Return the closed loop of a case of FITTED (notes S7.2): pumps to 5.8 V and 5 % stronger than
    modelled; the printed sliding mode as a relay; memberships of 3.25 +- 1.5 cm.
    """
    loop = build(FITTED[name])
    values: dict = {"actuator.high": [5.8] * 2, "plant.pump_gain": [1.05 * 27.43, 1.05 * 19.55]}
    if name != "sfc-fitted":
        values |= {name: RELAY[name] for name in ("controller.surface", "controller.ks")}
    if name == "hybrid-fitted":
        values |= {
            "controller.b": [3.25] * 2,
            "controller.w": [1.5] * 2,
            "controller.high": [5.8] * 2,
        }
        kind: Any = loop.controller
        kind = dataclasses.replace(kind, form="printed", switch="sign")
        loop = dataclasses.replace(loop, controller=kind)
    return with_values(loop, values)


def tuning_scenarios():
    """Return the scenarios that `tune` evaluates (notes S10)."""
    # They are the case's own start, and starts from the steady state at the setpoint with one
    # parameter of the plant changed; all with 0.05 cm of noise where the case has none, without
    # which the optimal gains are not bounded.
    steady = {
        **dict.fromkeys(("x0", "actuator.initial", "reference.initial"), "steady"),
        "clock.duration": "x0.75",
    }
    off = {
        "pump 1 +30 %": {"plant.pump_gain[0]": "x1.3"},
        "pump 1 -20 %": {"plant.pump_gain[0]": "x0.8"},
        "pump 2 +30 %": {"plant.pump_gain[1]": "x1.3"},
        "outlet 1 +10 %": {"plant.drain[0]": "x1.1"},
        "outlet 1 -10 %": {"plant.drain[0]": "x0.9"},
        "gamma 1 -10 %": {"plant.split[0]": "x0.9"},
    }
    noise = {"sensor.noise": "0.05 if zero"}
    runs = [
        ("own start", noise),
        *((name, {**steady, **one, **noise}) for name, one in off.items()),
    ]
    return tuple(Scenario(name, values, seed=11 + i) for i, (name, values) in enumerate(runs))


def build(kind, warm=False):
    """Return the closed loop of a controller, from empty tanks or the steady state at WARM."""
    rig = plant()
    x0, u0 = equilibrium(rig, WARM) if warm else ((0.0,) * 4, (0.0,) * 2)
    return ClosedLoop(
        plant=rig,
        sensor=LevelSensor(gain=number([6.0] * 4), noise=number([0.0] * 4), full_scale=number(5.0)),
        observer=Direct(),
        controller=CONTROLLERS[kind][1](rig),
        actuator=PumpBank(
            low=number([0.0] * 2),
            high=number([HIGH] * 2),
            stop=number([0.0] * 2),
            pulse=number([HIGH] * 2),
            initial=number(u0),
        ),
        reference=ramps(
            WARM if warm else (0.0, 0.0),
            [(0.0, i, level) for i, level in enumerate(SETPOINT)],
            ramp=0.0,
        ),
        x0=number(x0),
    )

"""The rig and the closed loops of gouta2022: ENMPC, CHADPC, PI, PID and fractional PI."""

import dataclasses

import numpy as np

from jaxtank.case import Free, Symmetry
from jaxtank.controllers import ENMPC, PID
from jaxtank.core.tree import number, with_values
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.observers import Direct, DisturbanceObserver
from jaxtank.plants import coupled_tanks
from jaxtank.signals.base import Sum
from jaxtank.signals.inflows import inflow_pulses
from jaxtank.signals.setpoints import Sine, ramps

# Kp of Table 1, and ten times that (notes S2.2) [cm^3/(s V)]
PRINTED_GAIN, RECONCILED_GAIN = 3.4717, 34.717

# what the reported mean of d^ amounts to at the reconciled Kp (notes S2.3) [V]
DEAD_ZONE = (2.7538, 4.3248)

SENSOR = 1 / 0.04413  # MPX5010DP: 450 mV/kPa [cm/V]
PULSE = 1.1  # duration that follows from the reported peak of d^, 2 cm/s (notes S3.2) [s]
PULSES = [(500.0, PULSE, 1, 500.0), (700.0, PULSE, 0, 500.0)]
TUNABLE = {
    "controller.Tp": Free(0.1, 20.0),
    "observer.l": Free(0.01, 15.0),
    "controller.Kc": Free(0.5, 20.0),
    "controller.Ti": Free(1.0, 60.0),
    "controller.Td": Free(0.02, 3.0),
    "controller.order": Free(0.5, 1.0, "linear"),
    "controller.Tt": Free(1.0, 100.0),
}


CONTROLLERS = {  # title, what `tune` changes
    "enmpc": ("ENMPC", ("controller.Tp",)),
    "chadpc": (
        "CHADPC: ENMPC and disturbance observer, single compensation",
        ("controller.Tp", "observer.l"),
    ),
    "pi": ("PI", ("controller.Kc", "controller.Ti")),
    "pi-ff": ("PI with feed-forward", ("controller.Kc", "controller.Ti")),
    "pid": ("PID", ("controller.Kc", "controller.Ti", "controller.Td")),
    "pid-ff": ("PID with feed-forward", ("controller.Kc", "controller.Ti", "controller.Td")),
    "fopi": ("fractional PI", ("controller.Kc", "controller.Ti", "controller.order")),
    "fopi-ff": (
        "fractional PI with feed-forward",
        ("controller.Kc", "controller.Ti", "controller.order"),
    ),
    "enmpc-printed": ("ENMPC with the sign of f as printed in eq. (12)", ("controller.Tp",)),
    "chadpc-printed": (
        "CHADPC as printed: sign of f, double compensation, observer before eq. (28)",
        ("controller.Tp", "observer.l"),
    ),
    "enmpc-fitted": ("ENMPC on a rig fitted to Table 3", ("controller.Tp",)),
    "chadpc-fitted": ("CHADPC on a rig fitted to Table 3", ("controller.Tp", "observer.l")),
    "chadpc-trapezoid": (
        "CHADPC on the trapezoids of benchmark 2",
        ("controller.Tp", "observer.l"),
    ),
}


def rig(pump_gain=RECONCILED_GAIN):
    """Return the two-tank rig of Table 1 with pumps of `pump_gain` [cm^3/(s V)]."""
    return coupled_tanks(
        area=225.0,  # A [cm^2]; 500 cm^3 raise it by 2.222 cm, the reported 22 % of 10 cm
        drain=[0.7854, 0.7854],  # a [cm^2]
        pipe=0.9143,  # a12 [cm^2]
        pump_gain=[pump_gain, pump_gain],
        rim=30.0,  # "1 < h < 30 cm"
        outputs=(0, 1),
        feeds=(0, 1),
    )


def benchmark(band=0.05):
    """Return the reference of benchmark 1 (sec. 5.1; notes S3.1)."""
    # r1 = 8 from 10 s on, plus a raised sine with a period of 250 s from 50 to 800 s; r2 = 10.
    steps = ramps((0.0, 0.0), [(0.0, 1, 10.0), (10.0, 0, 8.0)], ramp=0.0, band=band)
    sine = Sine(
        amplitude=number(3.0),
        offset=number(3.0),
        period=250.0,
        zero=112.5,
        start=50.0,
        end=800.0,
        channel=0,
        width=2,
    )  # in phase with its limits: it begins and ends at 0 with no rate
    return Sum(first=steps, second=sine)


def trapezoids():
    """Return the reference of benchmark 2, with both levels starting at 1 cm."""
    # Slopes that last 40 s are two of 20 s (notes S3.3, assumed but for 330 to 560 s).
    first = [(20.0, 8.0), (330.0, 14.0), (790.0, 12.0), (810.0, 10.0), (1250.0, 12.0)]
    second = [(20.0, 8.0), (560.0, 14.0), (1020.0, 12.0), (1040.0, 10.0)]
    return ramps(
        (1.0, 1.0), [(t, 0, v) for t, v in first] + [(t, 1, v) for t, v in second], ramp=20.0
    )


def _exchanged(values):
    # 1.5/Tp is the gain of the error, l that of its integral's observer: the loop knows their sum
    # and product (notes S4.4)
    rates = [v for n, v in values.items() if n.startswith("observer.l")]
    if "controller.Tp" not in values or not rates:
        return {}
    mean = float(np.exp(np.mean(np.log(rates))))
    return {
        n: 1.5 / mean if n == "controller.Tp" else 1.5 / values["controller.Tp"] for n in values
    }


SYMMETRY = Symmetry("the gain k = 1.5/Tp and the observer's l exchange roles", _exchanged)


def controller_of(name, model):
    """Return (controller, observer) of a case; gains of sec. 5.1 or of SIMC (notes S4.5)."""
    if name.startswith(("enmpc", "chadpc")):
        printed, compensated = name.endswith("-printed"), name.startswith("chadpc")
        return (
            ENMPC(
                model=model,
                Tp=number(0.13),
                compensation=("double" if printed else "single") if compensated else "none",
                drift="printed" if printed else "derived",
            ),
            DisturbanceObserver(
                model=model, l=number([10.0, 10.0]), before_compensation=printed and compensated
            ),
        )
    kind = name.removesuffix("-ff")
    return (
        PID(
            model=model,
            Kc=number([4.32, 4.32]),
            Ti=number([6.0, 6.0]),
            Td=number([0.25, 0.25]) if kind == "pid" else None,
            order=number([0.85, 0.85]) if kind == "fopi" else None,
            Tt=number([36.0, 36.0]),
            bias=number([6.34, 7.17]),  # mean voltages of the benchmark (notes S4.5)
            feed_forward=name.endswith("-ff"),
        ),
        Direct(),
    )


def fitted(loop):
    """Return the loop with what an ordinary rig would add: discharge coefficients of 0.66, weaker
    pumps with delay and lag, noise; fitted to Table 3, not unique (notes S2.4; its inflow pulse of
    0.7 s is left at 1.1 s). Controller and observer keep their model.
    """
    bank = dataclasses.replace(
        loop.actuator, dead_zone=number([1.5, 4.3]), delay=0.98, lag=number([0.93] * 2)
    )
    changed = {
        "plant.pump_gain": [16.7] * 2,
        "plant.drain": [0.66 * 0.7854] * 2,
        "plant.pipe": [0.66 * 0.9143],
        "sensor.noise": [0.08] * 2,
        "x0": [0.3] * 2,
    }
    return with_values(dataclasses.replace(loop, actuator=bank), changed)


def build(name):
    """Return the closed loop of a case of CONTROLLERS."""
    plant, trapezoid = rig(), name.endswith("-trapezoid")
    controller, observer = controller_of(name, plant)
    loop = ClosedLoop(
        plant=plant,
        sensor=LevelSensor(
            gain=number([SENSOR] * 2), noise=number([0.0] * 2), full_scale=number(5.0)
        ),
        observer=observer,
        controller=controller,
        actuator=PumpBank(
            low=number([0.0] * 2),
            high=number([12.0] * 2),
            dead_zone=number(DEAD_ZONE),
            dead_zone_kind="offset",
            stop=number([0.0] * 2),
            pulse=number([5.0] * 2),
            initial=number([0.0] * 2),
        ),
        reference=trapezoids() if trapezoid else benchmark(),
        disturbance=None if trapezoid else inflow_pulses(2, PULSES),
        x0=number([1.0, 1.0]),
    )
    return fitted(loop) if name.endswith("-fitted") else loop

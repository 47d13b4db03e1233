"""Gouta, Hadj Said, M'sahli (2015): state-coupled four-tank, NGPC and backstepping.

The derivation is in `notes/gouta2015.md`.
"""

import functools
import itertools

import numpy as np

from jaxtank.analysis.steady_state import equilibrium
from jaxtank.case import Case, Free
from jaxtank.controllers import NGPC, Backstepping
from jaxtank.core.clock import Clock
from jaxtank.core.tree import number
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.observers import Direct, DisturbanceObserver
from jaxtank.plants import state_coupled_four_tank
from jaxtank.plants.hydraulics import disc
from jaxtank.presets.paper import Claim, Preset, printed
from jaxtank.presets.rows import gouta2015 as rows
from jaxtank.presets.rows import robustness
from jaxtank.signals.setpoints import ramps

PRINTED_AREA = disc(15 * 2**0.5)  # D = 15 sqrt(2) cm, Table 1 [cm^2]
FAST_AREA = 15 * 2**0.5  # the same figure read as an area (notes A1) [cm^2]

# Fig. 5 as described in sec. 5.3: (time [s], output counted from 0, setpoint [cm])
BENCHMARK = (
    (20.0, 0, 8.0),
    (20.0, 1, 8.0),
    (270.0, 1, 14.0),
    (470.0, 0, 16.0),
    (760.0, 1, 10.0),
    (900.0, 0, 12.0),
)
START = (3.0, 3.0)  # r(0) [cm]

TUNABLE = {
    "controller.Tp": Free(1.0, 60.0),
    "controller.k": Free(1e-3, 50.0),
    "controller.k1": Free(1e-3, 5.0),
    "observer.l": Free(2e-3, 5.0),
}

CONTROLLERS = {
    "ngpc": ("nonlinear predictive control", ("controller.Tp",)),
    "backstepping": ("backstepping as printed", ("controller.k", "controller.k1")),
    "backstepping-ff": (
        "backstepping with the reference's rates",
        ("controller.k", "controller.k1"),
    ),
}
OBSERVED = {
    "ngpc-observer": (
        "nonlinear predictive control with the disturbance observer of gouta2022 (CHADPC)",
        ("controller.Tp", "observer.l"),
    ),
    "backstepping-observer": (
        "backstepping as printed with the disturbance observer of gouta2022",
        ("controller.k", "controller.k1", "observer.l"),
    ),
}
GAIN = 0.5  # l of every tank in OBSERVED (notes A10) [1/s]
VARIANTS = {
    "-table1": "plant A: areas as printed in Table 1",
    "-boxqp": "inputs allocated by box QP instead of clipped",
    "-slow": "ramps of 200 s, with which backstepping holds the 30 cm limit",
}


def controller_of(kind, model):
    """Return a controller with the gains of sec. 5.1 and `model` as its model of the plant."""
    if kind == "ngpc":
        return NGPC(model=model, Tp=number(11.0), level_floor=number(0.01))
    return Backstepping(
        model=model,
        k=number(0.03),
        k1=number(0.088),
        level_floor=number(0.01),
        reference_rates=kind == "backstepping-ff",
    )


def observer_of(kind, model):
    """Return the observer of a case: none but for those of OBSERVED."""
    if kind not in OBSERVED:
        return Direct()
    return DisturbanceObserver(model=model, l=number([GAIN] * 4))


def build(kind, area=FAST_AREA, saturation="clip", ramp=60.0):
    """Return the closed loop of a controller; area of the tanks [cm^2], ramp [s]."""
    plant = state_coupled_four_tank(area)
    x0, u0 = _steady(area)
    return ClosedLoop(
        plant=plant,
        sensor=LevelSensor(
            gain=number([9.4458, 8.7106, 8.5106, 9.3458]),  # a1 .. a4, sec. 5.2 [cm/V]
            noise=number([0.0] * 4),
            full_scale=number(3.3),  # of the STM32 board's converter; not in the paper
        ),
        observer=observer_of(kind, plant),
        controller=controller_of(kind.removesuffix("-observer"), plant),
        actuator=PumpBank(
            low=number([0.0, 0.0]),
            high=number([12.0, 12.0]),
            stop=number([1.5, 1.5]),
            pulse=number([3.3, 3.3]),
            initial=u0,
            saturation=saturation,
        ),
        reference=ramps(START, BENCHMARK, ramp=ramp),
        x0=x0,
    )


@functools.cache
def _steady(area):
    return equilibrium(state_coupled_four_tank(area), START)


def _diameters(areas):
    """Diameters of bores [cm] of areas [cm^2]."""
    return [float(d) for d in np.sqrt(4.0 * np.asarray(areas) / np.pi)]


def _changes(trajectory):
    """Times [s] at which a setpoint begins to move."""
    moves = np.any(np.diff(trajectory.r, axis=0) != 0.0, axis=1)
    begins = np.flatnonzero(moves[1:] & ~moves[:-1]) + 1
    return tuple(float(t) for t in trajectory.t[begins])


def _setpoints(reference):
    """Setpoints of each output, one output after the other [cm]."""
    return tuple(
        float(level)
        for output, start in enumerate(reference.initial)
        for level in (
            start,
            *(v for (_, i), v in zip(reference.changes, reference.targets) if i == output),
        )
    )


def measured(run):
    """Return what can be measured of the published rows (see `jaxtank.presets.paper.Preset`)."""
    case, near = run("ngpc")
    slow = rows.total(run("ngpc-table1")[1])
    still = run("ngpc", {"actuator.dead_zone": 3.0})[1]
    stuck, plant = rows.total(still), case.loop.plant
    return {
        "diameters of outlets 1 and 2": tuple(_diameters(plant.drain)[:2]),
        "diameters of orifices 31, 32, 41, 42": tuple(_diameters(plant.orifice)),
        "changes of the setpoints": _changes(near),
        "setpoints of h1 and of h2": _setpoints(case.loop.reference),
        "areas as printed": Claim(slow < 1.0, f"total RMS error {slow:.1f} cm (NGPC)"),
        "dead zone of 3 V": Claim(
            (stuck > 10.0 * rows.total(near), bool(still.u.max() == 0.0)),
            f"total RMS error {stuck:.1f} cm: the pumps run at {still.u.max():.2g} V at most",
        ),
        **rows.measured(run),
        **robustness.claims(*robustness.everything(run)),
    }


@functools.cache
def preset():
    """Return the Preset of this paper."""
    suffixes = itertools.product(("", "-table1"), ("", "-boxqp"), ("", "-slow"))
    cases, kinds = {}, CONTROLLERS | OBSERVED
    every = [*itertools.product(CONTROLLERS, suffixes), *((kind, ("",) * 3) for kind in OBSERVED)]
    for kind, (table1, boxqp, slow) in every:
        title, free = kinds[kind]
        name = f"{kind}{table1}{boxqp}{slow}"
        variants = [VARIANTS[v] for v in (table1, boxqp, slow) if v]
        cases[name] = Case(
            name=f"gouta2015/{name}",
            title="; ".join([f"state-coupled four-tank, {title}", *variants]),
            loop=build(
                kind,
                area=PRINTED_AREA if table1 else FAST_AREA,
                saturation="boxqp" if boxqp else "clip",
                ramp=200.0 if slow else 60.0,
            ),
            clock=Clock(dt=0.01, duration=1200.0),
            limits={"max_level": "rim"},
            free={p: TUNABLE[p] for p in free},
            objective={"rms_error_total": 1.0},
        )
    return Preset(**printed("gouta2015"), cases=cases, measured=measured, tunable=TUNABLE)

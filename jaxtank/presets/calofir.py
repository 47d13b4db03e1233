"""Calofir and others: two coupled tanks in metres, backstepping.

The derivation is in `notes/calofir.md`.
"""

import dataclasses
import functools

import numpy as np

from jaxtank.case import Case, Free, Scenario, Symmetry
from jaxtank.controllers import OpenLoop
from jaxtank.controllers.two_tank_backstepping import TwoTankBackstepping
from jaxtank.core.clock import Clock
from jaxtank.core.tree import number
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.loop.run import simulate
from jaxtank.observers import Direct
from jaxtank.plants.faults import faults
from jaxtank.plants.rigs import coupled_tanks
from jaxtank.presets.paper import Claim, Preset, Published
from jaxtank.presets.rows import calofir as rows
from jaxtank.signals.setpoints import ramps

A, C1, C2 = 0.0154, 1.0167e-4, 1.7253e-4  # sec. 3.1 [m^2], sec. 3.2 [m^2.5/s]
Q0, H0 = 1e-4, 0.6  # sec. 3.1: largest flow [m^3/s] and level [m]
GRAVITY = 9.81  # not printed; only c = (effective area) sqrt(2 g) matters [m/s^2]
KAPPA = C1**2 / (C1**2 + C2**2)  # h3/h1 in the steady state (notes S2.2)
SPEED = (2 * GRAVITY) ** 0.5
START = 0.05  # h1 at t = 0 [m] (notes A2)

TUNABLE = {"controller.K_phi": Free(1e-3, 1.0), "controller.K_y": Free(1e-3, 1.0)}

KS = tuple(TUNABLE)

DEPARTURES = (
    (
        "Equations: the errata of the paper are corrected (notes S5): signs of (12a), (14) and of"
        " the first term of f_a in (16); d phi/d z in (4); (20) is v, not phi; in (21) a/z0 for"
        " z/z0, and the denominators of v_i and v_ii. As printed, the controller does not settle at"
        " the reference."
    ),
    (
        "The controller computes in physical units (notes S4.2): z0 and Q0 cancel exactly, as long"
        " as z0 is one number."
    ),
    (
        "Gains: none are printed. K_phi = 0.02 1/s, K_y = 0.1 1/s: no overshoot, because K_phi is"
        " below b/(2 sqrt(h3r)) + a/(2 z3r) (notes S4.3)."
    ),
    (
        "Scenario: Figs. 2 and 3 are missing in our copy. 0.48 m for 600 s, then 0.30 m for 600 s,"
        " from h = (0.05, 0.05 kappa) m (notes A2)."
    ),
    (
        "Perturbed: c2 at 75 % for 300-450 s and a leak 0.2 c1 sqrt(h1) out of the first tank for"
        " 900-1050 s; the paper does not say what its faults were (notes A3)."
    ),
    (
        "Lower clips in the controller only: h3 and h1 - h3 are taken as at least 1e-4 m, without"
        " which it never starts from empty tanks (notes A4, H1)."
    ),
    (
        "Gravity: only the products c1, c2 are printed; orifice areas are c/sqrt(2 g) with g = 9.81"
        " m/s^2."
    ),
    "Rims are physics: levels stop at 0.6 m and at 0 m.",
)

PUBLISHED = {
    "plant.area": Published(A, "m^2", "sec. 3.1"),
    "c1": Published(C1, "m^2.5/s", "sec. 3.2"),
    "c2": Published(C2, "m^2.5/s", "sec. 3.2"),
    "actuator.high": Published(Q0, "m^3/s", "sec. 3.1"),
    "plant.rim": Published(H0, "m", "sec. 3.1"),
    "clock.dt": Published(1.0, "s", "sec. 4"),
    "plant.pipe": Published(
        5e-5,
        "m^2",
        "sec. 3.1, S1 = S3",
        reason="a section; ours is c1/sqrt(2 g), that times a flow coefficient of 0.46",
    ),
    "setpoints, share of h0": Published((0.8, 0.5), "-", "sec. 4"),
    "steady state follows very accurately": Published(
        "level of the first tank, without perturbation", "", "sec. 4, Fig. 2"
    ),
    "reacts rapidly to faults": Published(
        "in the direction to counteract them",
        "",
        "sec. 4, Fig. 3 (whose faults are not described)",
        reason="faults of ours",
    ),
    "some steady state errors": Published(
        "due to unmodelled dynamics",
        "",
        "sec. 5",
        reason="no integral action, and h3 rather than h1 is regulated",
    ),
    "same performance in any operating point": Published(
        "whatever the level", "", "sec. 5", reason="the pump's limits"
    ),
    "globally asymptotically stabilises": Published(
        "Proposition 2.1", "", "sec. 2", reason="needs h3 > 0, h1 > h3 and a pump without limits"
    ),
    **rows.PUBLISHED,
}


def rig():
    """Return the paper's tanks T1 and T3 in m and m^3/s."""
    return coupled_tanks(
        area=A,
        drain=[0.0, C2 / SPEED],
        pipe=C1 / SPEED,
        pump_gain=1.0,
        rim=H0,
        outputs=(0,),
        feeds=(0,),
        gravity=GRAVITY,
        overflow=True,
        bottom=True,
        units=("m", "m^3/s"),
        knee=1e-4,
    )


def build(perturbed=False):
    """Return the closed loop, with the faults of notes S3 if `perturbed`."""
    plant = rig()
    events = [("drain[1]", 300, 450, 0.75, 0.0), ("drain[0]", 900, 1050, 1.0, 0.2 * C1 / SPEED)]
    return ClosedLoop(
        plant=plant,
        sensor=LevelSensor(
            gain=number([0.06, 0.06]), noise=number([0.0, 0.0]), full_scale=number(10.0)
        ),  # 10 V at 0.6 m; not printed
        observer=Direct(),
        controller=TwoTankBackstepping(
            model=plant,
            K_phi=number(0.02),
            K_y=number(0.1),
            level_floor=number(1e-4),
            difference_floor=number(1e-4),
        ),
        actuator=PumpBank(
            low=number([0.0]),
            high=number([Q0]),
            stop=number([0.0]),
            pulse=number([Q0]),
            initial=number([0.0]),
        ),
        reference=ramps([START], [(0.0, 0, 0.8 * H0), (600.0, 0, 0.5 * H0)], ramp=0.0, band=0.02),
        faults=faults(plant, events) if perturbed else None,
        x0=number([START, START * KAPPA]),
    )


# levels from which `same_everywhere` steps up by 0.1 m [m]; ours, the paper names none
STEP = (0.10, 0.40)
# what counts as accurate [m], and as the same decay [share of the step]; ours too
ACCURATE, SAME = 1e-3, 0.05


def constant_flow(case):
    """Return the error of h1 (samples,) [m] with the steady flow of each setpoint instead of the
    controller (u_s alone, notes S7.1).
    """
    up, down = (C1 * (h * (1 - KAPPA)) ** 0.5 for h in (0.8 * H0, 0.5 * H0))
    flow = OpenLoop(signal=ramps([up], [(600.0, 0, down)], ramp=0.0))
    return np.asarray(simulate(dataclasses.replace(case.loop, controller=flow), case.clock).e[:, 0])


def same_everywhere(run, values):
    """Return the largest difference between two decays of h3 - h3r, as a share of the step."""
    shares = []
    for level in STEP:
        start = {
            "reference.initial": level,
            "reference.targets": [level, level + 0.1],
            "x0": [level, KAPPA * level],
        }
        t = run("backstepping", {**start, **values})[1]
        shares.append((t.x[600:, 1] - KAPPA * (level + 0.1)) / (KAPPA * 0.1))
    return float(np.abs(shares[0] - shares[1]).max())


def measured(run):
    """Return what can be measured of PUBLISHED (see `jaxtank.presets.paper.Preset`)."""
    case, plain = run("backstepping")
    hurt_case, hurt = run("backstepping-perturbed")
    plant, ends, e = case.loop.plant, [449, 1049], plain.e[:, 0]
    w = float(np.sqrt(2 * plant.gravity))
    steady = np.abs(e[[599, 1199]]).max()
    # the effect of the faults on h1 at their ends, with the controller and with a constant flow,
    # and the change of the flow by the controller
    shift, push = (hurt.e - plain.e)[ends, 0], (hurt.u - plain.u)[ends, 0]
    left = constant_flow(hurt_case)
    open_shift = (left - constant_flow(case))[ends]
    reacts = (np.abs(shift) < 0.5 * np.abs(open_shift)) & (push * open_shift < 0.0)
    offsets = hurt.e[ends, 0]
    unlimited, limited = (
        same_everywhere(run, {"actuator.low": -1.0, "actuator.high": 1.0}),
        same_everywhere(run, {}),
    )
    dry = run("backstepping", {"x0": [0.0, 0.0], "controller.difference_floor": 1e-12})[1]
    return {
        "c1": float(plant.pipe[0]) * w,
        "c2": float(plant.drain[1]) * w,
        "setpoints, share of h0": (plain.r[0, 0] / H0, plain.r[-1, 0] / H0),
        "steady state follows very accurately": Claim(
            bool(steady < ACCURATE),
            f"error at the end of each plateau at most {steady:.1e} m (counts if below"
            f" {ACCURATE:g} m)",
        ),
        "reacts rapidly to faults": Claim(
            bool(reacts.all()),
            "faults of ours (notes A3): by its end, the partly closed outlet has moved h1 by"
            f" {shift[0]:.5f} m and the leak by {shift[1]:.5f} m; with a constant flow"
            f" {open_shift[0]:.4f} and {open_shift[1]:.4f} m. The controller has changed the flow"
            f" by {push[0]:.1e} and {push[1]:.1e} m^3/s"
            " (counts if against the shift, and less than half of it is left)",
        ),
        "some steady state errors": Claim(
            bool(np.abs(offsets).max() > ACCURATE),
            f"{offsets[0]:.5f} and {offsets[1]:.5f} m at the ends of the faults (a constant flow:"
            f" {left[449]:.4f} and {left[1049]:.4f} m)",
        ),
        "same performance in any operating point": Claim(
            (unlimited < SAME, limited < SAME),
            f"steps of 0.1 m from {STEP[0]:g} and {STEP[1]:g} m: the decays of h3 differ by"
            f" {100 * unlimited:.2g} % of the step without limits of the pump, by"
            f" {100 * limited:.2g} % with them (the same: below {100 * SAME:g} %)",
        ),
        "globally asymptotically stabilises": Claim(
            bool(np.abs(dry.e[[599, 1199], 0]).max() < ACCURATE),
            "from empty tanks, without a lower clip of h1 - h3, h1"
            f" {f'stays below {top:.0e}' if (top := dry.x[:, 0].max()) else 'stays at 0'} m",
        ),
        **rows.measured(run),
    }


@functools.cache
def preset():
    """Return the Preset of this paper."""
    titles = {
        "backstepping": "backstepping",
        "backstepping-perturbed": "backstepping; outlet partly closed, then a leak",
    }
    cases = {
        name: Case(
            name=f"calofir/{name}",
            title=f"two coupled tanks, {title}",
            loop=build(name.endswith("perturbed")),
            clock=Clock(dt=1.0, duration=1199.0, substeps=4),
            limits={"max_level": "rim"},
            free=TUNABLE,
            # the error alone is set by the limit of the pump (notes S10): overshoot counts a
            # hundredfold, and changes of 1e-6 m^3/s from sample to sample, which noise of 1 mm
            # causes, as 0.3 mm
            objective={
                "mean_square_error": 1.0,
                "mean_square_overshoot": 100.0,
                "mean_square_travel": 1e5,
            },
            scenarios=(Scenario("noise", {"sensor.noise": "0.001 if zero"}, seed=1),),
            symmetry=Symmetry(
                "K_phi and K_y exchange roles",
                lambda v: {KS[0]: v[KS[1]], KS[1]: v[KS[0]]} if set(KS) <= set(v) else {},
            ),
        )
        for name, title in titles.items()
    }
    return Preset(
        paper="calofir",
        citation=(
            "V. Calofir, V. Tanasa, I. Fagarasan, I. Stamatescu, N. Arghira, G. Stamatescu, A"
            " backstepping control method for a nonlinear process - two coupled-tanks"
        ),
        cases=cases,
        published=PUBLISHED,
        measured=measured,
        tunable=TUNABLE,
        uncertain={
            "plant.pipe": (0.05, "c1: 'experimentally determined' (sec. 3.2), no interval printed"),
            "plant.drain": (0.05, "c2: likewise"),
            "plant.pump_gain": (0.05, "the pump's calibration is not printed"),
        },
        departures=DEPARTURES,
    )

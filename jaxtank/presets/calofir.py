"""Calofir and others: two coupled tanks in metres, backstepping (notes/calofir.md)."""

import dataclasses
import functools

import numpy as np

from jaxtank.case import Case, Free, Scenario, Symmetry
from jaxtank.controllers import OpenLoop
from jaxtank.controllers.two_tank_backstepping import TwoTankBackstepping
from jaxtank.core.clock import Clock
from jaxtank.loop.run import simulate
from jaxtank.plants.faults import faults
from jaxtank.plants.rigs import coupled_tanks
from jaxtank.presets.paper import Claim, Preset, closed_loop, printed
from jaxtank.signals.setpoints import ramps

GAINS = ((0.01, 0.01), (0.02, 0.02), (0.02, 0.1), (0.1, 0.1))  # K_phi, K_y of notes S7.1 [1/s]
FINE = 0.05  # sampling period that stands for continuous time [s]


def settling(trajectory):
    """Return when h1 has entered 2 % of its first step for the last time [s]."""
    first = trajectory.e[:600, 0]
    step = abs(float(trajectory.r[0, 0] - trajectory.x[0, 0]))
    outside = np.flatnonzero(np.abs(first) > 0.02 * step)
    return float(trajectory.t[outside[-1] + 1]) if outside.size else 0.0


def measured_rows(run):
    """Return {quantity: Claim} of the published rows, but for what cannot be measured."""
    (case, plain), hurt = run("backstepping"), run("backstepping-perturbed")[1]
    runs = [run("backstepping", dict(zip(KS, pair)))[1] for pair in GAINS]
    times = [settling(t) for t in runs]
    limits = [float(case.loop.actuator.low[0]), float(case.loop.actuator.high[0])]
    full = [100.0 * float(np.isin(t.u, limits).mean()) for t in runs]
    sooner = np.diff(times) < 0.0
    listed = ", ".join(f"{a:g} and {b:g} 1/s" for a, b in GAINS)
    drain = np.asarray(case.loop.plant.drain)
    off = run("backstepping", {"plant.drain": (0.75 * drain).tolist()})[1]
    ends = np.abs(off.e[[599, 1199], 0])
    share = plain.x[[599, 1199], 1] / plain.x[[599, 1199], 0]
    above = min(float((t.x[:, 0] - t.x[:, 1]).min()) for t in (plain, hurt))
    fine = run("backstepping", {"clock.dt": FINE}, round(1.0 / FINE))[1]
    apart = np.abs(plain.x[:, 0] - fine.x[:, 0])
    alike = float(np.corrcoef(plain.x[:, 0], plain.x[:, 1])[0, 1])
    return {
        "h1 is at least h3": Claim(
            above >= 0.0, f"h1 - h3 is at least {above:.4f} m, with and without faults"
        ),
        "sampling period of 1 s": Claim(
            bool(apart.max() < 1e-3),
            f"h1 is at most {1e3 * apart.max():.3f} mm from that with {FINE:g} s, at"
            f" {plain.t[np.argmax(apart)]:.0f} s (counts if below 1 mm)",
        ),
        "larger gains settle sooner": Claim(
            sooner, f"step to 0.48 m with {listed}: {', '.join(f'{t:.0f} s' for t in times)}"
        ),
        "larger gains saturate the pump": Claim(
            bool(np.all(np.diff(full) >= 0.0)) and full[-1] > full[0],
            f"at a limit with {listed}: {', '.join(f'{s:.3g} %' for s in full)} of the time",
        ),
        "level of the second tank": Claim(
            (alike > 0.9, bool(abs(share[0] / share[1] - 1.0) < 0.01)),
            f"correlation with h1 {alike:.3f}; h3/h1 {share[0]:.4f} and {share[1]:.4f} at the ends"
            " of the plateaus",
        ),
        "needs an exact model": Claim(
            bool(ends.max() > 1e-3),
            f"c2 smaller by 25 % than in the model leaves {ends[0]:.4f} and {ends[1]:.4f} m (counts"
            " if above 0.001 m)",
        ),
    }


A, C1, C2 = 0.0154, 1.0167e-4, 1.7253e-4  # sec. 3.1 [m^2], sec. 3.2 [m^2.5/s]
Q0, H0 = 1e-4, 0.6  # sec. 3.1: largest flow [m^3/s] and level [m]
GRAVITY = 9.81  # not printed; only c = (effective area) sqrt(2 g) matters [m/s^2]
KAPPA = C1**2 / (C1**2 + C2**2)  # h3/h1 in the steady state (notes S2.2)
SPEED = (2 * GRAVITY) ** 0.5
START = 0.05  # h1 at t = 0 [m] (notes A2)

TUNABLE = {"controller.K_phi": Free(1e-3, 1.0), "controller.K_y": Free(1e-3, 1.0)}

KS = tuple(TUNABLE)


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
    return closed_loop(
        plant,
        TwoTankBackstepping(
            model=plant, K_phi=0.02, K_y=0.1, level_floor=1e-4, difference_floor=1e-4
        ),
        ramps([START], [(0.0, 0, 0.8 * H0), (600.0, 0, 0.5 * H0)], ramp=0.0, band=0.02),
        [START, START * KAPPA],
        sensor=(0.06, 10.0),  # 10 V at 0.6 m; not printed
        pumps={"low": 0.0, "high": Q0},
        faults=faults(plant, events) if perturbed else None,
    )


# levels from which `same_everywhere` steps up by 0.1 m [m]; ours, the paper names none
STEP = (0.10, 0.40)
# what counts as accurate [m], and as the same decay [share of the step]; ours too
ACCURATE, SAME = 1e-3, 0.05


def constant_flow(case):
    """Return the error of h1 (samples,) [m] with the steady flow u_s alone (notes S7.1)."""
    up, down = (C1 * (h * (1 - KAPPA)) ** 0.5 for h in (0.8 * H0, 0.5 * H0))
    flow = OpenLoop(signal=ramps([up], [(600.0, 0, down)], ramp=0.0))
    return np.asarray(simulate(dataclasses.replace(case.loop, controller=flow), case.clock).e[:, 0])


def same_everywhere(run, values):
    """Return the largest difference between two decays of h3 - h3r, as a share of the step."""
    shares = []
    for level in STEP:
        start = {"reference.initial": level, "reference.targets": [level, level + 0.1]}
        start |= {"x0": [level, KAPPA * level]}
        t = run("backstepping", {**start, **values})[1]
        shares.append((t.x[600:, 1] - KAPPA * (level + 0.1)) / (KAPPA * 0.1))
    return float(np.abs(shares[0] - shares[1]).max())


def measured(run):
    """Return measured values of the published rows (see `jaxtank.presets.paper.Preset`)."""
    case, plain = run("backstepping")
    hurt_case, hurt = run("backstepping-perturbed")
    plant, ends, e = case.loop.plant, [449, 1049], plain.e[:, 0]
    w = float(np.sqrt(2 * plant.gravity))
    steady = np.abs(e[[599, 1199]]).max()
    # the effect of the faults on h1 at their ends, with the controller and with a constant flow,
    # and the change of the flow by the controller
    shift, push = (hurt.e - plain.e)[ends, 0], (hurt.u - plain.u)[ends, 0]
    constant = constant_flow(hurt_case)
    open_shift = (constant - constant_flow(case))[ends]
    reacts = (np.abs(shift) < 0.5 * np.abs(open_shift)) & (push * open_shift < 0.0)
    offsets = hurt.e[ends, 0]
    unlimited = same_everywhere(run, {"actuator.low": -1.0, "actuator.high": 1.0})
    limited = same_everywhere(run, {})
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
            "assumed faults (notes A3): by its end, the partly closed outlet has moved h1 by"
            f" {shift[0]:.5f} m and the leak by {shift[1]:.5f} m; with a constant flow"
            f" {open_shift[0]:.4f} and {open_shift[1]:.4f} m. The controller has changed the flow"
            f" by {push[0]:.1e} and {push[1]:.1e} m^3/s"
            " (counts if against the shift, and less than half of it is left)",
        ),
        "some steady state errors": Claim(
            bool(np.abs(offsets).max() > ACCURATE),
            f"{offsets[0]:.5f} and {offsets[1]:.5f} m at the ends of the faults (a constant flow:"
            f" {constant[449]:.4f} and {constant[1049]:.4f} m)",
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
        **measured_rows(run),
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
    return Preset(**printed("calofir"), cases=cases, measured=measured, tunable=TUNABLE)

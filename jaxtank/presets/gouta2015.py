"""Gouta, Hadj Said, M'sahli (2015): state-coupled four-tank (notes/gouta2015.md)."""

import dataclasses
import functools
import itertools

import numpy as np

from jaxtank.analysis.steady_state import equilibrium
from jaxtank.case import Case, Free
from jaxtank.controllers import NGPC, NMPC, Backstepping
from jaxtank.core.clock import Clock
from jaxtank.core.tree import number
from jaxtank.loop.margins import stability_margins
from jaxtank.loop.run import simulate
from jaxtank.observers import Direct, DisturbanceObserver
from jaxtank.plants import state_coupled_four_tank
from jaxtank.plants.hydraulics import disc
from jaxtank.presets.paper import Claim, Preset, closed_loop, printed
from jaxtank.presets.rows import robustness
from jaxtank.signals.inflows import inflow_pulses
from jaxtank.signals.setpoints import ramps

RAMPS = (20.0, 30.0, 60.0, 200.0)  # durations of the setpoint ramps, not printed [s]
OWN = 60.0  # sampling period of the cases [s]
EVERY = 10  # samples between those that are kept of these runs: 0.1 s
INFLOW = (620.0, 1.0, 0, 100.0)  # assumed disturbance: time, duration [s], tank, volume [cm^3]


def total(trajectory):
    """Return the RMS error of both outputs together [cm]."""
    return float(np.sqrt((trajectory.e**2).mean(axis=0).sum()))


def outside(trajectory):
    """Return the share of samples with a command outside 0 to 12 V [%], mean of both pumps."""
    return 100.0 * float(np.mean((trajectory.command < 0.0) | (trajectory.command > 12.0)))


PAIR = ("ngpc", "backstepping")


def _claims(run, ramp):
    """The claims of BY_RAMP with ramps of `ramp` [s]; parts: NGPC, backstepping."""
    wide = {"actuator.low": -1e3, "actuator.high": 1e3}
    pair = [run(name, {"reference.ramp": ramp}, EVERY)[1] for name in PAIR]
    unlimited = [run(name, {"reference.ramp": ramp, **wide}, EVERY)[1] for name in PAIR]
    actuator = run("ngpc")[0].loop.actuator
    lowest, highest = float(np.min(actuator.low)), float(np.max(actuator.high))
    near, far = map(total, pair)
    errors = f"total RMS error {near:.4f} cm (NGPC), {far:.3f} cm (backstepping)"
    travel = [float(np.abs(np.diff(t.u, axis=0)).sum()) for t in pair]
    effort = [np.sqrt((t.u**2).mean(axis=0)) for t in pair]
    commands = [(float(t.command.min()), float(t.command.max())) for t in pair]
    weak = [100.0 * (t.u <= 3.0).mean(axis=0) for t in pair]
    return {
        "tracking error": Claim((near < 0.1, far > near), f"{errors} (negligible: below 0.1 cm)"),
        "which tracks better": Claim(far < near, errors),
        "which moves the pumps less": Claim(
            travel[1] < travel[0], f"total variation of both inputs {_pair(travel, 'V')}"
        ),
        "inputs within the limits of the pumps": Claim(
            [lowest < least and most < highest for least, most in commands],
            "commands from {:.2f} to {:.2f} V (NGPC), {:.2f} to {:.2f} V (backstepping)".format(
                *commands[0], *commands[1]
            ),
        ),
        **_levels(pair),
        "voltages of 3 V and less": Claim(
            [bool(np.all(share > 10.0)) for share in weak],
            "pumps 1 and 2 are there for {:.1f} and {:.1f} % (NGPC), {:.1f} and {:.1f} %"
            " (backstepping) of the time (counts if more than 10 %)".format(*weak[0], *weak[1]),
        ),
        "control effort": Claim(
            effort[0] > effort[1],
            "RMS voltages {:.3f}, {:.3f} V (NGPC), {:.3f}, {:.3f} V (backstepping)".format(
                *effort[0], *effort[1]
            ),
        ),
        **_without_limits(pair, unlimited),
        **_responses(pair, ramp),
        "NGPC follows the setpoint's rate": _ise(run, pair[0]),
    }


def _pair(values, unit):
    return f"{values[0]:.2f} {unit} (NGPC), {values[1]:.2f} {unit} (backstepping)"


def _levels(pair):
    top = [float(t.x.max()) for t in pair]
    low = [100.0 * float((t.x < 3.0).any(axis=1).mean()) for t in pair]
    bottom = [float(t.x.min()) for t in pair]
    return {
        "levels below the rims": Claim(
            [h <= 30.0 for h in top], f"the highest level is {_pair(top, 'cm')}"
        ),
        "levels above 3 cm": Claim(
            [share == 0.0 for share in low],
            f"a level is below 3 cm for {_pair(low, '%')} of the time; the lowest is"
            f" {_pair(bottom, 'cm')}",
        ),
    }


def _without_limits(pair, unlimited):
    """The same runs with pumps that have no limits."""
    beyond = [outside(t) for t in unlimited]
    growth = [100.0 * (total(t) / total(free) - 1.0) for t, free in zip(pair, unlimited)]
    return {
        "commands outside the range without limits": Claim(
            [share > 10.0 for share in beyond],
            f"{_pair(beyond, '%')} of the samples (counts if more than 10 %)",
        ),
        "effect of the limits on the error": Claim(
            (growth[0] > 10.0, abs(growth[1]) < 1.0),
            f"total RMS error grows by {_pair(growth, '%')} (counts if NGPC's grows by more"
            " than 10 %, that of backstepping by less than 1 %)",
        ),
    }


def _responses(pair, ramp):
    """Responses to the first change, and to changes of one setpoint alone."""
    t = pair[0].t
    first = [float(np.abs(run.e[(t >= 20.0) & (t < 270.0)]).max()) for run in pair]
    rest = max(900.0, 760.0 + ramp + 60.0)  # when the ramp of r2 is over
    late = [
        max(
            float(np.abs(run.e[(t >= begin) & (t < end), other]).max())
            for begin, end, other in ((760.0, 900.0, 0), (rest, 1200.0, 1))
        )
        for run in pair
    ]
    return {
        "first change of both setpoints": Claim(
            max(first) < 2.0 * min(first),
            f"largest error {first[0]:.3f} cm (NGPC), {first[1]:.3f} cm (backstepping; similar:"
            " within a factor of 2)",
        ),
        "changes of one setpoint at 760 and 900 s": Claim(
            [error < 0.1 for error in late],
            f"error of the other level at most {late[0]:.4f} cm (NGPC), {late[1]:.4f} cm"
            " (backstepping; counts if below 0.1 cm)",
        ),
    }


def _inflow(run):
    """Effect on both levels of a volume that flows into tank 1: difference to the calm run."""
    area, peak = [], []
    for name in PAIR:
        case, calm = run(name, {"reference.ramp": OWN}, EVERY)
        loop = dataclasses.replace(case.loop, disturbance=inflow_pulses(4, [INFLOW]))
        e = np.abs(np.asarray(simulate(loop, case.clock, None, EVERY).e) - calm.e)
        part = e[calm.t < 760.0]
        area.append(float(part[:, 0].sum()) * EVERY * case.clock.dt)
        peak.append(float(part[:, 1].max()))
    return Claim(
        (area[1] < area[0], peak[1] < peak[0]),
        f"{INFLOW[3]:g} cm^3 into tank 1 at {INFLOW[0]:g} s (ours): integral of the absolute change"
        f" of h1 {area[0]:.1f} cm s (NGPC), {area[1]:.1f} cm s (backstepping); h2 moves by"
        f" {peak[0]:.3f} cm, {peak[1]:.3f} cm",
    )


def _fluctuations(run, far):
    """The claim on levels that fluctuate on plateaus, without noise and with 0.05 cm of it."""

    def ripple(trajectory):  # standard deviation of the levels at the ends of two plateaus [cm]
        t = trajectory.t
        plateaus = [(t > 650.0) & (t < 760.0), (t > 1050.0) & (t <= 1200.0)]
        return max(float(trajectory.x[plateau, :2].std(axis=0).max()) for plateau in plateaus)

    noisy = [run(name, {"sensor.noise": 0.05})[1] for name in ("backstepping", "ngpc")]
    still, rough, other = ripple(far), *map(ripple, noisy)
    return Claim(
        still > 0.1 or rough > 0.1,
        f"standard deviation of the levels {still:.1e} cm, {rough:.1e} cm with 0.05 cm of sensor"
        f" noise (NGPC {other:.1e} cm; counts if above 0.1 cm)",
    )


def _theorem(run, far):
    """Constant setpoints from three starts, and the error while a setpoint moves."""
    changes = run("backstepping")[0].loop.reference.changes
    constant = {
        "reference.initial": [12.0, 10.0],
        "reference.targets": [(12.0, 10.0)[output] for _, output in changes],
    }
    starts = ([3.0, 3.0, 3.0, 3.0], [20.0, 2.0, 1.0, 25.0], [1.0, 18.0, 28.0, 1.0])
    runs = (run("backstepping", {**constant, "x0": list(x0)}, 100)[1] for x0 in starts)
    ends = [float(np.abs(t.e[-1]).max()) for t in runs]
    moving = float(np.abs(far.e).max())
    return Claim(
        (max(ends) < 1e-3, moving < 0.1),
        f"with setpoints of 12 and 10 cm the error after 1200 s is at most {max(ends):.1e} cm from"
        f" {len(starts)} starts; while a setpoint moves it reaches {moving:.2f} cm",
    )


def _ise(run, near):
    """The ISE of NGPC beside its closed form 0.12 Tp^3 sum(rate^2) (notes S7.4)."""
    case = run("ngpc")[0]
    closed, tp, dt = [], float(case.loop.controller.Tp), EVERY * case.clock.dt
    for moves in np.round(np.diff(near.r, axis=0) / dt, 6).T:
        begins = moves[1:][np.diff(moves) != 0.0]
        closed.append(0.12 * tp**3 * float((begins**2).sum()))
    ise = (near.e[:-1] ** 2).sum(axis=0) * dt
    apart = np.abs(ise / closed - 1.0).max()
    return Claim(
        bool(apart < 0.01),
        "integral of the squared error {:.3f}, {:.3f} cm^2 s; {:.3f}, {:.3f} cm^2 s follows from"
        " it (notes S7.4)".format(*ise, *closed),
    )


def _margins(run):
    """Sensitivity peak and delay margin of both controllers, the worst of all plateaus."""
    worst = []
    for name in PAIR:
        case = run(name)[0]
        margins = [p.margins for p in stability_margins(case.loop, case.clock) if p.margins]
        peaks = [float(m.sensitivity_peak) for m in margins]
        worst.append((max(peaks), min(float(np.min(m.delay_margin)) for m in margins)))
    (peak, delay), (peak_b, delay_b) = worst
    return Claim(
        (peak_b < peak, delay_b > delay),
        f"sensitivity peak {peak:.2f} (NGPC), {peak_b:.2f} (backstepping); delay margin"
        f" {delay:.2f} s, {delay_b:.2f} s: the worst of all plateaus",
    )


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
    "controller.horizon": Free(10.0, 200.0),
    "controller.rate_time": Free(1.0, 60.0),
    "controller.r_w": Free(1e-6, 1.0),
    "controller.k": Free(1e-3, 50.0),
    "controller.k1": Free(1e-3, 5.0),
    "observer.l": Free(2e-3, 5.0),
}

GAINS = ("controller.k", "controller.k1")

CONTROLLERS = {
    "ngpc": ("nonlinear predictive control", ("controller.Tp",)),
    "backstepping": ("backstepping as printed", GAINS),
    "backstepping-ff": ("backstepping with the reference's rates", GAINS),
}
OBSERVED = {
    "ngpc-observer": (
        "nonlinear predictive control with the disturbance observer of gouta2022 (CHADPC)",
        ("controller.Tp", "observer.l"),
    ),
    "backstepping-observer": (
        "backstepping as printed with the disturbance observer of gouta2022",
        (*GAINS, "observer.l"),
    ),
}
# a1 .. a4, sec. 5.2 [cm/V]; full scale of the STM32 board's converter, not in the paper [V]
PREDICTIVE = {
    "nmpc": (
        "nonlinear predictive control by programmes in the loop, with the rims as limits",
        ("controller.horizon", "controller.rate_time"),
    ),
    "nmpc-preview": (
        "nonlinear predictive control that knows setpoints a minute ahead, with the rims as limits",
        ("controller.horizon", "controller.r_w"),
    ),
}
SENSOR = ((9.4458, 8.7106, 8.5106, 9.3458), 3.3)
MARGIN = 1e-4  # below the rims: a programme is solved to about 1e-6 cm [cm]
SECOND = Clock(dt=1.0, duration=1200.0, substeps=10)  # of the predictive controllers
GAIN = 0.5  # l of every tank in OBSERVED (notes A10) [1/s]
VARIANTS = {
    "-table1": "plant A: areas as printed in Table 1",
    "-boxqp": "inputs allocated by box QP instead of clipped",
    "-slow": "ramps of 200 s, with which backstepping holds the 30 cm limit",
}


def controller_of(kind, model):
    """Return a controller with the gains of sec. 5.1 and `model` as its model of the plant."""
    if kind == "ngpc":
        return NGPC(model=model, Tp=11.0, level_floor=0.01)
    if kind in PREDICTIVE:
        preview, each = kind == "nmpc-preview", lambda value: number([value] * 2)
        return NMPC(
            model=model,
            horizon=50.0 if preview else 30.0,
            r_w=each(1e-4),
            rate_time=8.0,
            limit=np.asarray(model.rim) - MARGIN,
            low=each(0.0),
            high=each(12.0),
            preview=60.0 if preview else 0.0,
        )
    rates = kind == "backstepping-ff"
    return Backstepping(model=model, k=0.03, k1=0.088, level_floor=0.01, reference_rates=rates)


def build(kind, area=FAST_AREA, saturation="clip", ramp=60.0):
    """Return the closed loop of a controller; area of the tanks [cm^2], ramp [s]."""
    plant = state_coupled_four_tank(area)
    x0, u0 = _steady(area)
    pumps = {"low": 0.0, "high": 12.0, "stop": 1.5, "pulse": 3.3, "initial": u0}
    observed = kind in OBSERVED
    return closed_loop(
        plant,
        controller_of(kind.removesuffix("-observer"), plant),
        ramps(START, BENCHMARK, ramp=ramp),
        x0,
        sensor=SENSOR,
        observer=DisturbanceObserver(model=plant, l=number([GAIN] * 4)) if observed else Direct(),
        pumps=pumps | {"saturation": saturation},
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
    rows = list(zip(reference.changes, reference.targets))
    later = lambda output: (v for (_, i), v in rows if i == output)
    starts = enumerate(reference.initial)
    return tuple(float(v) for output, start in starts for v in (start, *later(output)))


def measured(run):
    """Return measured values of the published rows (see `jaxtank.presets.paper.Preset`)."""
    case, near = run("ngpc")
    slow = total(run("ngpc-table1")[1])
    still = run("ngpc", {"actuator.dead_zone": 3.0})[1]
    stuck, plant = total(still), case.loop.plant
    far, claims = run("backstepping")[1], {ramp: _claims(run, ramp) for ramp in RAMPS}
    # with the ramps of the cases, and whether they hold with each other
    holds = lambda name: {ramp: claims[ramp][name].holds for ramp in RAMPS}
    return {
        "diameters of outlets 1 and 2": tuple(_diameters(plant.drain)[:2]),
        "diameters of orifices 31, 32, 41, 42": tuple(_diameters(plant.orifice)),
        "changes of the setpoints": _changes(near),
        "setpoints of h1 and of h2": _setpoints(case.loop.reference),
        "areas as printed": Claim(slow < 1.0, f"total RMS error {slow:.1f} cm (NGPC)"),
        "dead zone of 3 V": Claim(
            (stuck > 10.0 * total(near), bool(still.u.max() == 0.0)),
            f"total RMS error {stuck:.1f} cm: the pumps run at {still.u.max():.2g} V at most",
        ),
        **{n: dataclasses.replace(c, by_ramp=holds(n)) for n, c in claims[OWN].items()},
        "disturbance rejection": _inflow(run),
        "fluctuations with backstepping": _fluctuations(run, far),
        "Theorem 1": _theorem(run, far),
        "relative stability": _margins(run),
        "parameters to tune, NGPC and backstepping": tuple(len(run(p)[0].free) for p in PAIR),
        **robustness.claims(*robustness.everything(run)),
    }


@functools.cache
def preset():
    """Return the Preset of this paper."""
    suffixes = itertools.product(("", "-table1"), ("", "-boxqp"), ("", "-slow"))
    cases, kinds = {}, CONTROLLERS | OBSERVED | PREDICTIVE
    single = [(kind, ("",) * 3) for kind in OBSERVED | PREDICTIVE]
    for kind, (table1, boxqp, slow) in [*itertools.product(CONTROLLERS, suffixes), *single]:
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
            clock=SECOND if kind in PREDICTIVE else Clock(dt=0.01, duration=1200.0),
            limits={"max_level": "rim"},
            free={p: TUNABLE[p] for p in free},
            objective={"rms_error_total": 1.0},
        )
    return Preset(**printed("gouta2015"), cases=cases, measured=measured, tunable=TUNABLE)

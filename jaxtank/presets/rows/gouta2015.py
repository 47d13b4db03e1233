"""gouta2015, secs. 4 to 6: rows of `jaxtank compare` on the nominal plant."""

import dataclasses

import numpy as np

from jaxtank.loop.margins import stability_margins
from jaxtank.loop.run import simulate
from jaxtank.presets.paper import Claim
from jaxtank.signals.inflows import inflow_pulses

RAMPS = (20.0, 30.0, 60.0, 200.0)  # durations of the setpoint ramps, not printed [s]
OWN = 60.0  # that of the cases [s]
EVERY = 10  # samples between those that are kept of these runs: 0.1 s
POUR = (620.0, 1.0, 0, 100.0)  # disturbance of ours: time, duration [s], tank, volume [cm^3]


def total(trajectory):
    """Return the RMS error of both outputs together [cm]."""
    return float(np.sqrt((trajectory.e**2).mean(axis=0).sum()))


def outside(trajectory):
    """Return the share of samples with a command outside 0 to 12 V [%], mean of both pumps."""
    return 100.0 * float(np.mean((trajectory.command < 0.0) | (trajectory.command > 12.0)))


def measured(run):
    """Return {quantity: what was measured} of the rows that can be measured."""
    far = run("backstepping")[1]
    return {
        **_by_ramp(run),
        "disturbance rejection": _pour(run),
        "fluctuations with backstepping": _fluctuations(run, far),
        "Theorem 1": _theorem(run, far),
        "relative stability": _margins(run),
        "parameters to tune, NGPC and backstepping": tuple(len(run(p)[0].free) for p in PAIR),
    }


PAIR = ("ngpc", "backstepping")


def _by_ramp(run):
    """The claims of BY_RAMP with the ramps of the cases, and whether they hold with each other."""
    claims = {ramp: _claims(run, ramp) for ramp in RAMPS}
    return {
        name: dataclasses.replace(claim, by_ramp={r: claims[r][name].holds for r in RAMPS})
        for name, claim in claims[OWN].items()
    }


def _claims(run, ramp):
    """The claims of BY_RAMP with ramps of `ramp` [s]; their parts are NGPC and backstepping where
    both are meant.
    """
    wide = {"actuator.low": -1e3, "actuator.high": 1e3}
    pair = [run(name, {"reference.ramp": ramp}, EVERY)[1] for name in PAIR]
    unlimited = [run(name, {"reference.ramp": ramp, **wide}, EVERY)[1] for name in PAIR]
    actuator = run("ngpc")[0].loop.actuator
    lowest, highest = float(np.min(actuator.low)), float(np.max(actuator.high))
    near, far = map(total, pair)
    errors = f"total RMS error {near:.4f} cm (NGPC), {far:.3f} cm (backstepping)"
    growth = [100.0 * (total(t) / total(free) - 1.0) for t, free in zip(pair, unlimited)]
    travel = [float(np.abs(np.diff(t.u, axis=0)).sum()) for t in pair]
    effort = [np.sqrt((t.u**2).mean(axis=0)) for t in pair]
    commands = [(float(t.command.min()), float(t.command.max())) for t in pair]
    top = [float(t.x.max()) for t in pair]
    low = [100.0 * float((t.x < 3.0).any(axis=1).mean()) for t in pair]
    bottom = [float(t.x.min()) for t in pair]
    weak = [100.0 * (t.u <= 3.0).mean(axis=0) for t in pair]
    beyond = [outside(t) for t in unlimited]
    words = "{:.2f} {unit} (NGPC), {:.2f} {unit} (backstepping)".format
    return {
        "tracking error": Claim((near < 0.1, far > near), f"{errors} (negligible: below 0.1 cm)"),
        "which tracks better": Claim(far < near, errors),
        "which moves the pumps less": Claim(
            travel[1] < travel[0], f"total variation of both inputs {words(*travel, unit='V')}"
        ),
        "inputs within the limits of the pumps": Claim(
            [lowest < least and most < highest for least, most in commands],
            "commands from {:.2f} to {:.2f} V (NGPC), {:.2f} to {:.2f} V (backstepping)".format(
                *commands[0], *commands[1]
            ),
        ),
        "levels below the rims": Claim(
            [h <= 30.0 for h in top], f"the highest level is {words(*top, unit='cm')}"
        ),
        "levels above 3 cm": Claim(
            [share == 0.0 for share in low],
            f"a level is below 3 cm for {words(*low, unit='%')} of the time; the lowest is"
            f" {words(*bottom, unit='cm')}",
        ),
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
        "commands outside the range without limits": Claim(
            [share > 10.0 for share in beyond],
            f"{words(*beyond, unit='%')} of the samples (counts if more than 10 %)",
        ),
        "effect of the limits on the error": Claim(
            (growth[0] > 10.0, abs(growth[1]) < 1.0),
            f"total RMS error grows by {words(*growth, unit='%')} (counts if NGPC's grows by more"
            " than 10 %, that of backstepping by less than 1 %)",
        ),
        **_changes(pair, ramp),
        "NGPC follows the setpoint's rate": _ise(run, pair[0]),
    }


def _changes(pair, ramp):
    """The responses to the first change, and to those of one setpoint alone."""
    t = pair[0].t
    first = [float(np.abs(one.e[(t >= 20.0) & (t < 270.0)]).max()) for one in pair]
    rest = max(900.0, 760.0 + ramp + 60.0)  # when the ramp of r2 is over
    late = [
        max(
            float(np.abs(one.e[(t >= begin) & (t < end), other]).max())
            for begin, end, other in ((760.0, 900.0, 0), (rest, 1200.0, 1))
        )
        for one in pair
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


def _pour(run):
    """What a volume poured into tank 1 does to both levels, beside the undisturbed run."""
    area, peak = [], []
    for name in PAIR:
        case, calm = run(name, {"reference.ramp": OWN}, EVERY)
        loop = dataclasses.replace(case.loop, disturbance=inflow_pulses(4, [POUR]))
        e = np.abs(np.asarray(simulate(loop, case.clock, None, EVERY).e) - calm.e)
        part = e[calm.t < 760.0]
        area.append(float(part[:, 0].sum()) * EVERY * case.clock.dt)
        peak.append(float(part[:, 1].max()))
    return Claim(
        (area[1] < area[0], peak[1] < peak[0]),
        f"{POUR[3]:g} cm^3 into tank 1 at {POUR[0]:g} s (ours): integral of the absolute change of"
        f" h1 {area[0]:.1f} cm s (NGPC), {area[1]:.1f} cm s (backstepping); h2 moves by"
        f" {peak[0]:.3f} cm, {peak[1]:.3f} cm",
    )


def _fluctuations(run, far):
    """The claim on levels that fluctuate on plateaus, without noise and with 0.05 cm of it."""

    def ripple(trajectory):  # standard deviation of the levels at the ends of two plateaus [cm]
        t = trajectory.t
        plateaus = [(t > 650.0) & (t < 760.0), (t > 1050.0) & (t <= 1200.0)]
        return max(float(trajectory.x[held, :2].std(axis=0).max()) for held in plateaus)

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
    held = {
        "reference.initial": [12.0, 10.0],
        "reference.targets": [(12.0, 10.0)[output] for _, output in changes],
    }
    starts = ([3.0, 3.0, 3.0, 3.0], [20.0, 2.0, 1.0, 25.0], [1.0, 18.0, 28.0, 1.0])
    ends = [
        float(np.abs(run("backstepping", {**held, "x0": list(x0)}, 100)[1].e[-1]).max())
        for x0 in starts
    ]
    moving = float(np.abs(far.e).max())
    return Claim(
        (max(ends) < 1e-3, moving < 0.1),
        f"with setpoints of 12 and 10 cm the error after 1200 s is at most {max(ends):.1e} cm from"
        f" {len(starts)} starts; while a setpoint moves it reaches {moving:.2f} cm",
    )


def _ise(run, near):
    """The ISE of NGPC beside its closed form 0.12 Tp^3 sum(rate^2) (notes S7.4)."""
    case = run("ngpc")[0]
    closed, tp = [], float(case.loop.controller.Tp)
    dt = EVERY * case.clock.dt
    rates = np.diff(near.r, axis=0) / dt
    for output in range(2):
        moves = np.round(rates[:, output], 6)
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
    for name in ("ngpc", "backstepping"):
        case = run(name)[0]
        found = [p.margins for p in stability_margins(case.loop, case.clock) if p.margins]
        worst.append(
            (
                max(float(m.sensitivity_peak) for m in found),
                min(float(np.min(m.delay_margin)) for m in found),
            )
        )
    (peak, delay), (peak_b, delay_b) = worst
    return Claim(
        (peak_b < peak, delay_b > delay),
        f"sensitivity peak {peak:.2f} (NGPC), {peak_b:.2f} (backstepping); delay margin"
        f" {delay:.2f} s, {delay_b:.2f} s: the worst of all plateaus",
    )

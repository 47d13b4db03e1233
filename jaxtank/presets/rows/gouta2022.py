"""gouta2022, secs. 3 to 5: rows of `jaxtank compare` beside those of Tables 3 and 4."""

import dataclasses

import numpy as np

from jaxtank.core.tree import get_value
from jaxtank.observers import Direct
from jaxtank.presets.paper import Claim
from jaxtank.presets.rows.operations import sample_operations

CALM = 60.0  # when the start has passed [s]


def _cm(values):
    return ", ".join(f"{v:.3g}" for v in values) + " cm"


def quiet(t):
    """Return the samples at which means of d^ and offsets are taken (notes A6)."""
    # They are later than 60 s, and not within 30 s after an inflow pulse. t: times [s].
    return (t > 60) & ~((t >= 500) & (t < 530)) & ~((t >= 700) & (t < 730))


def figures(run):
    """Return the numbers of a run of benchmark 1 as Table 3 defines them (notes A6)."""
    t, e = run.t, np.abs(run.e)

    def last(mask, output, band, begin):
        outside = t[mask & (e[:, output] > band)]
        return float(outside[-1] - begin) if outside.size else 0.0

    return {
        "error": tuple(np.sqrt((run.e**2).mean(axis=0))),
        "voltage": tuple(np.sqrt((run.applied**2).mean(axis=0))),
        "settling": (last((t >= 10) & (t < 50), 0, 0.4, 10), last(t < 500, 1, 0.5, 0)),
        "recovery": (
            last((t >= 700) & (t <= 760), 0, 0.05 * run.r[t >= 700][0, 0], 700),
            last((t >= 500) & (t <= 560), 1, 0.5, 500),
        ),
        "d": tuple(run.d_hat[quiet(t)].mean(axis=0)),
    }


PULSES = ((1, 500.0), (0, 700.0))  # tank, time of its inflow pulse [s]


def jumps(trajectory):
    """Return (levels before, largest rises within 10 s) of the inflow pulses of PULSES [cm]."""
    t, x = trajectory.t, trajectory.x
    before = np.array([x[t < begin][-1, tank] for tank, begin in PULSES])
    after = [x[(t >= begin) & (t < begin + 10.0), tank].max() for tank, begin in PULSES]
    return before, np.array(after) - before


def instant(case):
    """Return the rises of the levels if the inflow pulses came in no time [cm]."""
    return np.asarray(case.loop.disturbance.volume) / np.asarray(case.loop.plant.area)[[1, 0]]


def errors_of(trajectory):
    """Return the RMS error of each output [cm]."""
    return np.sqrt((trajectory.e**2).mean(axis=0))


def total(trajectory):
    """Return the RMS error of both outputs together [cm]."""
    return float(np.sqrt((errors_of(trajectory) ** 2).sum()))


def measured(run):
    """Return {quantity: what was measured} of the published rows."""
    (plain, enmpc), (case, chadpc) = run("enmpc"), run("chadpc")
    return {
        **_third(run("chadpc-trapezoid")[1]),
        **_pulses(enmpc, chadpc),
        **_inputs(enmpc, chadpc),
        "range of d^": _range(chadpc),
        "steady error of ENMPC": _offset(enmpc, chadpc),
        "tracking with noise": _noise(run),
        "Proposition 3.1": _decay(run, enmpc),
        **_observer(run, case, chadpc),
        "levels between 1 and 30 cm": _levels(enmpc, chadpc),
        "computation of CHADPC": _operations(plain, case),
        "parameters to tune, ENMPC and CHADPC": tuple(
            sum(np.size(get_value(one.loop, name)) for name in one.free) for one in (plain, case)
        ),
        **_others(run),
    }


def _third(t):
    """Claims on the trapezoids of benchmark 2."""
    calm, high = t.t > CALM, (t.t > 400.0) & (t.t < 560.0)
    before = (t.t > 300.0) & (t.t < 330.0)
    worst, rms = np.abs(t.e[calm]).max(axis=0), np.sqrt((t.e[calm] ** 2).mean(axis=0))
    u = [float(t.applied[part, 1].mean()) for part in (before, high)]
    d = t.d_hat[calm & (t.applied[:, 0] > 0.0), 0]
    level = t.x[calm & (t.applied[:, 0] > 0.0), 0]
    low, up = (float(np.abs(d[part]).mean()) for part in (level < 8.5, level > 13.5))
    share = 100.0 * float((t.d_hat[calm] < 0.0).mean())
    return {
        "third experiment, error": Claim(
            bool(worst.max() < 0.1),
            f"after {CALM:g} s RMS error {_cm(rms)}, at most {_cm(worst)}: pump 2 is off while 14"
            " and 8 cm are asked for (counts if below 0.1 cm)",
        ),
        "third experiment, pump 2 from 330 to 560 s": Claim(
            u[1] < u[0], f"mean voltage {u[0]:.2f} V before, {u[1]:.2f} V then"
        ),
        "third experiment, sign of d^": Claim(
            share > 99.0, f"negative in {share:.3g} % of the samples after {CALM:g} s"
        ),
        "third experiment, d^ against the level": Claim(
            up < 0.95 * low,
            f"mean |d^| of tank 1 {low:.4f} cm/s below 8.5 cm, {up:.4f} cm/s above 13.5 cm",
        ),
    }


def _pulses(enmpc, chadpc):
    """What an inflow pulse does to the other tank, and to the level itself."""

    def kick(t):  # largest change of the other tank's error within 30 s [cm]
        found = []
        for begin, other in ((500.0, 0), (700.0, 1)):
            before = t.e[(t.t >= begin - 10.0) & (t.t < begin), other].mean()
            after = t.e[(t.t >= begin) & (t.t < begin + 30.0), other]
            found.append(float(np.abs(after - before).max()))
        return max(found)

    over = [max(0.0, 100.0 * float(t.e[t.t < 100.0, 1].max()) / 10.0) for t in (enmpc, chadpc)]
    a, b = kick(enmpc), kick(chadpc)
    return {
        "kick on the other tank": Claim(
            (a > 0.01, b < 0.01),
            f"the other level moves by at most {a:.1e} cm with ENMPC, {b:.1e} cm with CHADPC"
            " (counts if above 0.01 cm)",
        ),
        "overshoot of CHADPC": Claim(
            over[1] < over[0],
            f"step of r2: {over[0]:.1g} % with ENMPC, {over[1]:.1g} % with CHADPC",
        ),
        "jump of the level by an inflow pulse": tuple(jumps(chadpc)[1].tolist()),
    }


def _inputs(enmpc, chadpc):
    """The voltages while r1 follows its sine, and after the inflow pulses."""
    t = chadpc
    period = (t.t >= 100.0) & (t.t < 350.0)
    alike = [float(np.corrcoef(t.applied[period, i], t.x[period, 0])[0, 1]) for i in (0, 1)]
    least = [
        float(run.applied[(run.t >= begin) & (run.t < begin + 5.0), pump].min())
        for run in (enmpc, chadpc)
        for begin, pump in ((500.0, 1), (700.0, 0))
    ]
    return {
        "u2 in antiphase to h1": Claim(
            (alike[0] > 0.9, alike[1] < -0.9),
            f"over one period correlation of h1 with u1 {alike[0]:+.3f}, with u2 {alike[1]:+.3f}"
            " (counts beyond +-0.9)",
        ),
        "pumps stop after an inflow pulse": Claim(
            max(least) <= 0.0,
            f"least voltage within 5 s {max(least):.2g} V, of both controllers and pulses",
        ),
    }


def _range(chadpc):
    d = chadpc.d_hat[quiet(chadpc.t)]
    low, high = d.min(axis=0), d.max(axis=0)
    least, most = np.array([-1.0, -1.25]), np.array([0.0, -0.5])
    inside = bool(np.all(low >= least) and np.all(high <= most))
    return Claim(
        (inside, bool(np.all(high - low > 0.5 * (most - least)))),
        f"{low[0]:.4f} to {high[0]:.4f} and {low[1]:.4f} to {high[1]:.4f} cm/s apart from the"
        " pulses",
    )


def _offset(enmpc, chadpc):
    a, b = (np.abs(t.e[quiet(t.t)].mean(axis=0)) for t in (enmpc, chadpc))
    return Claim(
        bool(a.max() < 0.01), f"mean error {_cm(a)}, with CHADPC {_cm(b)} (counts if below 0.01 cm)"
    )


def _noise(run):
    noisy = [run(name, {"sensor.noise": 0.02})[1] for name in ("enmpc", "chadpc")]
    a, b = (np.sqrt((t.e[quiet(t.t)] ** 2).mean(axis=0)) for t in noisy)
    return Claim(
        b < a,
        f"with 0.02 cm of sensor noise RMS error {_cm(a)} with ENMPC, {_cm(b)} with CHADPC, apart"
        " from start and pulses: ENMPC keeps an offset d/k",
    )


def _decay(run, enmpc):
    """The rate at which the error of tank 2 decays after the step at 0 s, without limits."""
    free = {"actuator.dead_zone": 0.0, "actuator.low": -1e4, "actuator.high": 1e4, "x0": [6.0, 6.0]}
    case, t = run("enmpc", free)
    part = t.t <= 0.3
    rate = -float(np.polyfit(t.t[part], np.log(np.abs(t.e[part, 1])), 1)[0])
    k = 1.5 / float(case.loop.controller.Tp)
    sampled = -np.log(1.0 - k * case.clock.dt) / case.clock.dt
    left = np.abs(enmpc.e[quiet(enmpc.t)].mean(axis=0))
    return Claim(
        (bool(abs(rate / sampled - 1.0) < 0.05), bool(left.max() < 0.01)),
        f"without limits the error decays at {rate:.2f} 1/s; k is {k:.2f} 1/s, {sampled:.2f} 1/s"
        f" with inputs held over a sample; with the pumps as they are {_cm(left)} are left (counts"
        " if below 0.01 cm)",
    )


def _observer(run, case, chadpc):
    """The decay of d^ after an inflow pulse, and an observer that is fed the unlimited command."""
    begin, duration, tank = case.loop.disturbance.events[0]
    t = chadpc.t
    # the pump stands still then, and with it its dead zone: d is 0
    after = (t > begin + duration) & (t < begin + duration + 0.3)
    rate = -float(np.polyfit(t[after], np.log(np.abs(chadpc.d_hat[after, tank])), 1)[0])
    gain = float(case.loop.observer.l[tank])
    wrong = run("chadpc", {"observer.fed": "command"})[1]
    calm = (t > 30.0) & (t < begin)
    errors = [float(np.abs(one.e[calm]).max()) for one in (wrong, chadpc)]
    return {
        "decay of the estimation error": Claim(
            abs(rate / gain - 1.0) < 0.1,
            f"{rate:.2f} 1/s after the pulse of tank 2; l = {gain:g} 1/s is"
            f" {-np.log(1.0 - gain * case.clock.dt) / case.clock.dt:.2f} 1/s sampled (counts within"
            " 10 %)",
        ),
        "divergence by a wrong estimate": Claim(
            errors[0] > 1.0 > errors[1],
            "fed the command before its limits, the observer winds up to"
            f" {np.abs(wrong.d_hat).max():.1e} cm/s and the commands to"
            f" {np.abs(wrong.command).max():.1e} V: after 30 s the largest error is"
            f" {errors[0]:.2f} cm for {errors[1]:.1e} cm (counts if above 1 cm)",
        ),
    }


def _levels(enmpc, chadpc):
    low, high = ([float(f(t.x)) for t in (enmpc, chadpc)] for f in (np.min, np.max))
    below = [100.0 * float((t.x < 1.0).any(axis=1).mean()) for t in (enmpc, chadpc)]
    return Claim(
        (min(low) > 1.0, max(high) < 30.0),
        "{:.3f} to {:.2f} cm with ENMPC, {:.3f} to {:.2f} cm with CHADPC; below 1 cm for {:.2g} and"
        " {:.2g} % of the time".format(low[0], high[0], low[1], high[1], *below),
    )


def _operations(plain, case):
    """Arithmetic operations of a sample: the observer's estimate is not used without it."""
    counts = [sample_operations(one.loop, one.clock) for one in (plain, case)]
    bare = sample_operations(dataclasses.replace(plain.loop, observer=Direct()), plain.clock)
    return Claim(
        counts[1] > bare,
        f"{bare} arithmetic operations a sample with ENMPC, {counts[1]} with"
        " CHADPC (counted in the traced program, not timed)",
    )


def _others(run):
    """The controllers of Table 4 on one rig, without delay and with 0.5 s."""
    names = {"ENMPC": "enmpc", "CHADPC": "chadpc", "PI": "pi", "PID": "pid"}
    names |= {"fractional PI with feed-forward": "fopi-ff"}
    late, soon = (
        {shown: total(run(name, {"actuator.delay": delay})[1]) for shown, name in names.items()}
        for delay in (0.5, 0.0)
    )

    def best(errors):
        ours = max(errors["ENMPC"], errors["CHADPC"])
        return ours < min(v for shown, v in errors.items() if shown not in ("ENMPC", "CHADPC"))

    def listed(errors):
        return ", ".join(f"{v:.4f} cm with {shown}" for shown, v in errors.items())

    order = ("fractional PI with feed-forward", "PI", "PID")
    each = [errors_of(run(names[n], {"actuator.delay": 0.5})[1]) for n in order]
    rising = [each[0][i] < each[1][i] < each[2][i] for i in (0, 1)]
    totals = [late[n] for n in order]
    return {
        "order of fractional PI, PI and PID": Claim(
            [*rising, totals[0] < totals[1] < totals[2]],
            "RMS error with a delay of 0.5 s and the gains of notes S4.5: tank 1 {:.4f}, {:.4f} and"
            " {:.4f} cm, tank 2 {:.4f}, {:.4f} and {:.4f} cm, total {:.4f}, {:.4f} and {:.4f}"
            " cm".format(*(e[0] for e in each), *(e[1] for e in each), *totals),
        ),
        "smaller error than PI, PID and fractional PI": Claim(
            (best(soon), best(late)),
            f"total RMS error without delay: {listed(soon)}; with a delay of 0.5 s: {listed(late)}",
        ),
    }

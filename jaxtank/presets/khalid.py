"""Khalid, Kadri: linear predictive control of coupled tanks, GPC and Laguerre functions.

The rig, scenarios and closed loops are in `loops/khalid.py`, the derivation in `notes/khalid.md`.
"""

import functools

import numpy as np

from jaxtank.case import Case
from jaxtank.controllers import Laguerre
from jaxtank.presets.loops.khalid import CLOCK, CONTROLLERS, TUNABLE, build
from jaxtank.presets.paper import Claim, Preset, Published
from jaxtank.presets.rows import khalid as rows

DEPARTURES = (
    (
        "Not printed, so chosen (notes A1-A5): sampling period 2 s, r_w = 0.01 (levels in m, inputs"
        " in 1e-4 m^3/s), half period of the pulses 300 s, linearisation at the middle of the"
        " pulse, (0.30, 0.06) m with one pump and (0.06, 0.075) m with two."
    ),
    (
        "Pulses: the cases run between 0.03 m and 0.15 m with one pump, 0.04-0.16 m and 0.03-0.18 m"
        " with two (scenarios S2 and M2 of notes S3). The printed pulses down to 0 m end at empty"
        " tanks, where gravity alone decides; `scenario('S1')` and 'M1' are those."
    ),
    (
        "Limits: the paper's simulations show none, and its conclusion leaves constraints to"
        " further work. The base cases let the flow go negative (limits of 1000 U0, levels stop at"
        " 0 m); '-constrained' solves the programme of eq. (32) with u in [0, 3] U0 and du within"
        " 0.5 U0 per sample. controller.mode = clipped clips the linear controller to the same"
        " limits."
    ),
    (
        "Pipe: sgn(H1-H2) sqrt|H1-H2| for the printed sqrt(H1-H2), since the references with two"
        " pumps have H1 < H2; its root and those of the outlets are smooth within 1e-4 m, which"
        " moves no level by more than 4e-5 m (notes H2)."
    ),
    (
        "Signs of eq. (2) and (9), C_m of eq. (16), the numerator of eq. (23), the sums of eq. (31)"
        " to Np: corrected (notes S5)."
    ),
    (
        "Rim: the height of the tanks is not given; 1 m is above the highest level of the base"
        " cases, 0.91 m."
    ),
    "Sensor: both levels are measured without noise; the converter's range is ours, and it is off.",
)

_SAME_RW = (
    "figures without numbers; r_w and the sampling period are not printed, and the finding depends"
    " on them (notes S8)"
)
PUBLISHED = {
    "plant.area": Published(9350e-6, "m^2", "Table I"),
    "plant.drain": Published(78.5e-6, "m^2", "Table I, s times a0 = 1"),
    "plant.pipe": Published(39.25e-6, "m^2", "Table I, s times a1 = 0.5"),
    "plant.gravity": Published(9.8, "m/s^2", "Table I"),
    "controller.Np": Published(40, "-", "sec. V"),
    "controller.Nc": Published((2, 10, 30), "-", "sec. V.A, Figs. 2-4"),
    "controller.a": Published(0.4, "-", "sec. V.A, Fig. 5"),
    "controller.N": Published(4, "-", "sec. V.A"),
    "a long control horizon improves performance": Published(
        "required",
        "",
        "sec. V.A, Figs. 2-3",
        reason=f"the error falls and the overshoot grows; {_SAME_RW}",
    ),
    "control horizon beyond 10": Published("not much improvement", "", "sec. V.A, Figs. 3-4"),
    "overshoot against control horizon": Published(
        "not eliminated by any", "", "sec. V.A", reason=f"true of 10 and 30, not of 2; {_SAME_RW}"
    ),
    "overshoot of Laguerre against GPC 30": Published(
        "reduced considerably",
        "",
        "sec. V.A, Fig. 5",
        reason=f"a different r_w in the two figures would explain it; {_SAME_RW}",
    ),
    "parameters of Laguerre": Published("4 are enough", "", "sec. V.A"),
    "Laguerre against GPC with two pumps": Published(
        "outperforms", "", "sec. V.B", reason=f"equal, with 8 variables for 20; {_SAME_RW}"
    ),
    **rows.PUBLISHED,
}

UNCERTAIN = {
    "plant.drain": (0.05, "discharge coefficients of 1 are idealised"),
    "plant.pipe": (0.05, "the discharge coefficient of 0.5 is rounded"),
    "plant.pump_gain": (0.05, "pumps are not described"),
}


def edges(reference, run, dt=2.0):
    """Return the response of each output to the edges of its pulses."""
    found = []
    levels, samples = np.asarray(run.r) + np.asarray(run.e), len(run.t)
    for channel in range(reference.channels):
        mine = [
            (round(t / dt), float(v))
            for (t, i), v in zip(reference.changes, reference.targets)
            if i == channel
        ]
        before, ends = (
            [float(reference.initial[channel]), *(v for _, v in mine)],
            [*(k for k, _ in mine[1:]), samples],
        )
        past, slow = {1: [], -1: []}, {1: [], -1: []}
        for (start, target), old, end in zip(mine, before, ends):
            share = (levels[start:end, channel] - target) / (target - old)
            sign = 1 if target > old else -1
            outside = np.flatnonzero(np.abs(share) > 0.05)
            past[sign].append(100.0 * max(share.max(), 0.0))
            slow[sign].append(dt * (outside[-1] + 1 if outside.size else 0))
        found.append(
            {"overshoot": (max(past[1]), max(past[-1])), "settling": (max(slow[1]), max(slow[-1]))}
        )
    return found


def measured(run):
    """Return what can be measured of PUBLISHED (see `jaxtank.presets.paper.Preset`)."""
    # The claims are decided at the reference point, r_w = 0.01 in S2 and M2, with Runge-Kutta steps
    # of 1 s instead of 0.25 s, which compile faster and change no RMS error by more than 2e-7 m.
    error, over, loops = {}, {}, {}  # RMS [m] and overshoot [%] of each output, by case
    for kind in CONTROLLERS:
        case, trajectory = run(kind, {"clock.substeps": 2})
        error[kind] = np.sqrt(np.mean(np.asarray(trajectory.e) ** 2, axis=0))
        over[kind] = [channel["overshoot"][0] for channel in edges(case.loop.reference, trajectory)]
        loops[kind] = case.loop
    plant, laguerre = loops["gpc-mimo"].plant, loops["laguerre"].controller
    return {
        "plant.area": float(plant.area[0]),
        "plant.drain": float(plant.drain[0]),
        "plant.pipe": float(plant.pipe[0]),
        "plant.gravity": float(plant.gravity),
        "controller.Np": laguerre.Np,
        "controller.Nc": tuple(loops[k].controller.Nc for k in ("gpc-nc2", "gpc", "gpc-nc30")),
        "controller.a": float(laguerre.a[0]),
        "controller.N": laguerre.N,
        **_horizon_claims({k: 1e3 * v[0] for k, v in error.items()}, over),
        **_laguerre_claims(error, over),
        **rows.measured(run, edges),
    }


def _horizon_claims(one, over):
    """The claims on the control horizon; one: RMS error of the first output [mm]."""
    worst = "; ".join(
        f"Nc {n}: {over[k][0]:.2f} %" for n, k in ((2, "gpc-nc2"), (10, "gpc"), (30, "gpc-nc30"))
    )
    return {
        "a long control horizon improves performance": Claim(
            (one["gpc"] < one["gpc-nc2"], over["gpc"][0] <= over["gpc-nc2"][0]),
            f"RMS error {one['gpc-nc2']:.2f} mm with Nc 2, {one['gpc']:.2f} mm with Nc 10;"
            f" overshoot {worst}",
        ),
        "control horizon beyond 10": Claim(
            one["gpc-nc30"] > 0.95 * one["gpc"],
            f"RMS error {one['gpc']:.2f} mm with Nc 10, {one['gpc-nc30']:.2f} mm with Nc 30",
        ),
        "overshoot against control horizon": Claim(
            [over[k][0] > 1.0 for k in ("gpc-nc2", "gpc", "gpc-nc30")],
            f"{worst} (counts if above 1 %)",
        ),
    }


def _laguerre_claims(error, over):
    """The claims on Laguerre functions against GPC; error [m] and over [%] by output."""

    def both(kind):
        (e1, e2), (o1, o2) = 1e3 * error[kind], over[kind]
        return f"{e1:.2f}, {e2:.2f} mm and {o1:.1f}, {o2:.1f} %"

    gain = 1.0 - over["laguerre"][0] / over["gpc-nc30"][0]
    laguerre, gpc = 1e3 * error["laguerre"][0], 1e3 * error["gpc"][0]
    better = error["laguerre-mimo"] < 0.98 * error["gpc-mimo"]
    return {
        "overshoot of Laguerre against GPC 30": Claim(
            (gain > 0.0, gain >= 0.2),
            f"{over['laguerre'][0]:.2f} % against {over['gpc-nc30'][0]:.2f} %: {100 * gain:.0f} %"
            " less at the same r_w (considerable: 20 %)",
        ),
        "parameters of Laguerre": Claim(
            abs(laguerre / gpc - 1.0) < 0.05,
            f"RMS error {laguerre:.2f} mm with 4 variables, {gpc:.2f} mm with the 10 of GPC",
        ),
        "Laguerre against GPC with two pumps": Claim(
            better,
            f"RMS errors and overshoots {both('laguerre-mimo')}; GPC {both('gpc-mimo')} (counts if"
            " 2 % less)",
        ),
    }


@functools.cache
def preset():
    """Return the Preset of this paper."""
    cases = {}
    for kind, (controller, _, _, title) in CONTROLLERS.items():
        for suffix, mode in (("", "unconstrained"), ("-constrained", "constrained")):
            loop = build(kind, mode=mode)
            free = ["controller.r_w"] + (["controller.a"] if controller is Laguerre else [])
            # the parameter with the largest effect for one pump (notes S10): overshoot falls where
            # the model is that of a high level
            free += (
                ["controller.operating_point[1]"] if loop.plant.pumps == 1 else ["controller.q[1]"]
            )
            cases[kind + suffix] = Case(
                name=f"khalid/{kind}{suffix}",
                title=f"coupled tanks, {title}"
                + ("; limits in the programme (eq. 32)" if suffix else ""),
                loop=loop,
                clock=CLOCK,
                limits={"max_level": "rim"},
                free={name: TUNABLE[name.replace("q[1]", "q")] for name in free},
                # J of notes S10 with its weight of overshoot: the error alone does not change once
                # the pumps saturate
                objective={
                    "mean_square_error": 1e4,
                    "mean_square_travel": 20.0,
                    "mean_square_overshoot": 1e5,
                },
            )
    return Preset(
        paper="khalid",
        citation=(
            "M. U. Khalid, M. B. Kadri, Liquid level control of nonlinear coupled tanks system"
            " using linear model predictive control, Pakistan Navy Engineering College, National"
            " University of Sciences and Technology, Karachi"
        ),
        cases=cases,
        published=PUBLISHED,
        measured=measured,
        tunable=TUNABLE,
        uncertain=UNCERTAIN,
        departures=DEPARTURES,
    )

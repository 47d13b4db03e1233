"""Gouta, Al-Ashek, Saad (2022): coupled two-tank rig, ENMPC, CHADPC; PI, PID, fractional PI.

The rig and the closed loops are in `loops/gouta2022.py`, the derivation in `notes/gouta2022.md`.
"""

import functools

import numpy as np

from jaxtank.case import Case, Scenario
from jaxtank.core.clock import Clock
from jaxtank.presets.loops.gouta2022 import CONTROLLERS, PRINTED_GAIN, SYMMETRY, TUNABLE, build
from jaxtank.presets.paper import Claim, Preset, Sample, printed
from jaxtank.presets.rows import gouta2022 as rows
from jaxtank.presets.rows.gouta2022 import figures, quiet

SEEDS = range(6)  # draws of the noise of the paper-like rig: one is no measurement


def _rises(case, run):
    """The claim on the inflow pulses of tank 2 at 500 s and tank 1 at 700 s."""
    before, jumps = rows.jumps(run)
    by_volume = 100.0 * rows.instant(case) / before
    by_level = 100.0 * jumps / before
    agree = [
        np.allclose(
            v,
            printed("gouta2022")["published"]["rise of tank 2 and 1 by an inflow pulse"].value,
            rtol=0.03,
        )
        for v in (by_volume, by_level)
    ]
    return Claim(
        agree,
        "volume over area {:.1f}, {:.1f} %; simulated levels {:.1f}, {:.1f} %".format(
            *by_volume, *by_level
        ),
    )


def measured(run):
    """Return what can be measured of the published rows (see `jaxtank.presets.paper.Preset`)."""
    enmpc, (case, chadpc) = run("enmpc")[1], run("chadpc")
    return {
        **_tables(run, enmpc, chadpc),
        "mean of d^": figures(chadpc)["d"],
        "peak of d^ after an inflow pulse": float(
            chadpc.d_hat[(chadpc.t > 499) & (chadpc.t < 530), 1].max()
        ),
        "rise of tank 2 and 1 by an inflow pulse": _rises(case, chadpc),
        **_claims(run),
        **rows.measured(run),
    }


def _tables(run, enmpc, chadpc):
    """The numbers of Tables 3 and 4, on the ideal rig and on one like the paper's."""
    fitted = {
        name: [figures(run(f"{name.lower()}-fitted", {}, 1, seed)[1]) for seed in SEEDS]
        for name in ("ENMPC", "CHADPC")
    }
    keys = {"error": "RMS error", "voltage": "RMS voltage"}
    more = {"settling": "settling time", "recovery": "recovery time"}
    ideal = {"ENMPC": figures(enmpc), "CHADPC": figures(chadpc)}
    measures = {}
    for key, name in (keys | more).items():
        for controller, numbers in ideal.items():
            measures[f"{name} of {controller}"] = numbers[key]
            measures[f"{name} of {controller}, paper-like rig"] = Sample(
                [numbers[key] for numbers in fitted[controller]]
            )
    for key, name in keys.items():
        measures[f"{name}, CHADPC against ENMPC"] = _gain(ideal["CHADPC"][key], ideal["ENMPC"][key])
        pairs = zip(fitted["CHADPC"], fitted["ENMPC"])
        measures[f"{name}, CHADPC against ENMPC, paper-like rig"] = Sample(
            [_gain(first[key], second[key]) for first, second in pairs]
        )
    return measures


def _gain(first, second):
    """How much the numbers `first` are above `second` [%]."""
    return tuple(100.0 * (a / b - 1.0) for a, b in zip(first, second))


def _claims(run):
    """The claims in words that further runs decide."""
    owners = ("plant", "controller.model", "observer.model")
    gain = {f"{owner}.pump_gain": PRINTED_GAIN for owner in owners}
    low = run("enmpc", {**gain, "actuator.dead_zone": 0.0})[1]
    off, full = figures(low)["error"], np.mean(low.applied[low.t > 60] > 11.9, axis=0)
    slow = {"controller.Tp": 1.7, "observer.l": 0.1}
    late = run("chadpc", {**slow, "actuator.delay": 0.2, "actuator.dead_zone": 0.0})[1]
    bias = figures(late)["d"]
    wrong = run("enmpc-printed", {"actuator.dead_zone": 0.0})[1]
    left = wrong.e[quiet(wrong.t)].mean(axis=0)
    noisy = [run(name, {"sensor.noise": 0.005})[1] for name in ("enmpc", "chadpc")]
    spread = [float(np.diff(r.command[(r.t > 200) & (r.t < 490), 1]).std()) for r in noisy]
    return {
        "pump constant as printed": Claim(
            max(off) < 1.0,
            "RMS error {:.2f}, {:.2f} cm with the pumps at 12 V for {:.0f}, {:.0f} % of the"
            " time".format(*off, *(100 * full)),
        ),
        "a delay makes d^ negative": Claim(
            max(bias) < -0.1,
            "mean d^ {:.4f}, {:.4f} cm/s with a delay of 0.2 s and no dead zone".format(*bias),
        ),
        "eq. (12) tracks without offset": Claim(
            bool(np.abs(left).max() < 0.01),
            "mean error {:.3f}, {:.3f} cm (counts if below 0.01 cm)".format(*left),
        ),
        "the observer spares the pumps": Claim(
            spread[1] < spread[0],
            f"sample-to-sample voltage noise {spread[0]:.2f} -> {spread[1]:.2f} V rms with 0.005 cm"
            " of sensor noise",
        ),
    }


@functools.cache
def preset():
    """Return the Preset of this paper."""
    return Preset(
        **printed("gouta2022"),
        cases={
            name: Case(
                name=f"gouta2022/{name}",
                title=f"coupled two-tank MIMO, {title}",
                loop=build(name),
                clock=Clock(dt=0.01, duration=1500.0 if name.endswith("-trapezoid") else 900.0),
                limits={"max_level": "rim"},
                free={p: TUNABLE[p] for p in free},
                # without noise, delay or a weight on the input the run is insensitive to the
                # gains (notes S10): 0.1 V from sample to sample counts as 0.02 cm
                objective={"mean_square_error": 1.0, "mean_square_travel": 0.04},
                scenarios=(Scenario("noise", {"sensor.noise": "0.02 if zero"}, seed=1),),
                symmetry=SYMMETRY if "chadpc" in name else None,
                reachable=not name.endswith("-trapezoid"),
            )
            for name, (title, free) in CONTROLLERS.items()
        },
        measured=measured,
        tunable=TUNABLE,
    )

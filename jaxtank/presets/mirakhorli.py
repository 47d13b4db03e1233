"""Mirakhorli, Farrokhi (2016): non-minimum phase quadruple tank, sliding mode, state feedback.

The rig and the closed loops are in `loops/mirakhorli.py`, the derivation in `notes/mirakhorli.md`.
"""

import functools

import numpy as np

from jaxtank.analysis.steady_state import equilibrium
from jaxtank.case import Case, Free
from jaxtank.core.clock import Clock
from jaxtank.presets.loops.mirakhorli import (
    CONTROLLERS,
    FITTED,
    RELAY,
    SETPOINT,
    TUNABLE,
    build,
    fitted,
    plant,
    tuning_scenarios,
)
from jaxtank.presets.paper import Claim, Preset, printed
from jaxtank.presets.rows import mirakhorli as rows
from jaxtank.presets.rows.mirakhorli import response

# J of notes S3, with its weight of the total variation of the input
COST = {"ise": 1.0, "input_deviation": 3.0, "input_travel": 0.1}
# for the controller that chatters: its derivatives are not worth seven runs
CHATTER_COST = {"rms_error_total": 1.0, "input_travel": 1e-3}


def steady_error(run, kind, values):
    """Return the mean error (2,) [cm] of the last 100 s of 400 s."""
    x0, u0 = equilibrium(plant(), SETPOINT)
    start = {
        "x0": x0.tolist(),
        "actuator.initial": u0.tolist(),
        "reference.initial": list(SETPOINT),
    }
    return run(kind, {**start, **values})[1].e[-1000:].mean(axis=0)


def measured(run):
    """Return what can be measured of the published rows (see `jaxtank.presets.paper.Preset`)."""
    assumed = {name: response(run(case)[1]) for name, case in zip(("SMC", "SFC", "hybrid"), FITTED)}
    return {
        **rows.measured(run, assumed),
        "gamma1 + gamma2": float(np.sum(run("sfc")[0].loop.plant.split)),
        "chattering of the SMC": _chattering(run),
        **_steady_errors(run),
    }


def _chattering(run):
    variation = {
        kind: float(np.abs(np.diff(run(kind)[1].u, axis=0)).sum())
        for kind in ("sfc", "hybrid", "smc-printed")
    }
    return Claim(
        (variation["smc-printed"] > 1e3, variation["hybrid"] < 100.0),
        f"total variation of the inputs in 400 s: {variation['smc-printed']:.0f} V as printed,"
        f" {variation['sfc']:.1f} V with SFC, {variation['hybrid']:.1f} V with the hybrid of the"
        " corrected controller (counts if above 1000 V, and below 100 V)",
    )


def _steady_errors(run):
    """The claims on steady errors: a narrower outlet, a stronger pump, an exact model."""
    narrow = {"plant.drain": [0.7 * 0.50265, 0.50265, 0.0, 0.0]}
    stronger = {"plant.pump_gain": [1.3 * 27.43, 19.55]}
    relay = {**RELAY, "controller.b": 3.0, "controller.w": 1.0}
    sfc, hybrid, corrected = (
        steady_error(run, kind, {**narrow, **more})[0]
        for kind, more in (("sfc", {}), ("hybrid", relay), ("hybrid", {}))
    )
    pump = {kind: steady_error(run, kind, stronger) for kind in ("sfc", "hybrid", "lqi")}
    parked = np.abs(steady_error(run, "hybrid", {**narrow, **relay}))
    exact = float(np.abs(steady_error(run, "sfc", {})).max())
    readings = ((hybrid, sfc), (corrected, sfc), (pump["hybrid"][1], pump["sfc"][1]))
    offset = max(map(abs, pump["sfc"]))
    return {
        "30 % change of an outlet": Claim(
            [abs(blend) < 0.7 * abs(alone) for blend, alone in readings],
            f"outlet of tank 1 narrower by 30 %: {sfc:+.2f} cm with SFC, {hybrid:+.2f} cm with the"
            f" hybrid of the printed controller (b 3, w 1), {corrected:+.2f} cm with that of the"
            " corrected one (b 1, w 0.5; 12 cm has no steady state then); pump 1 stronger by 30 %:"
            f" tank 2 {pump['sfc'][1]:+.2f} and {pump['hybrid'][1]:+.2f} cm (corrected controller;"
            " counts if 30 % less)",
        ),
        "hybrid switches between the controllers": Claim(
            bool(np.all((parked > 2.0) & (parked < 4.0))),
            "outlet of tank 1 narrower by 30 %: the errors stay at {:.2f} and {:.2f} cm, between 2"
            " and 4 cm, where both controllers have a share".format(*parked),
        ),
        "zero steady-state error of the SFC": Claim(
            (exact <= 0.01, bool(offset <= 0.01)),
            f"with an exact model at most {exact:.1e} cm; {pump['sfc'][1]:+.2f} cm in tank 2 once"
            f" pump 1 is 30 % stronger, where lqi leaves {pump['lqi'][1]:+.1e} cm (zero: below"
            " 0.01 cm)",
        ),
    }


def _fitted(name, case):
    """The case `name` of FITTED, made of the one that it starts from."""
    loop, blend = fitted(name), ("controller.b", "controller.w")
    more = {"free": {p: TUNABLE[p] for p in blend}, "objective": CHATTER_COST, "scenarios": ()}
    return case.replace(
        name=f"mirakhorli/{name}",
        title=f"{case.title}; rig fitted to Table 3",
        loop=loop,
        **(more if name.startswith("hybrid") else {}),
    )


@functools.cache
def preset():
    """Return the Preset of this paper."""
    cases = {}
    for kind, (title, _, free) in CONTROLLERS.items():
        for warm in (False, True):
            name = f"{kind}-warm" if warm else kind
            cases[name] = Case(
                name=f"mirakhorli/{name}",
                title=(
                    f"quadruple tank, non-minimum phase, {title}; step to 12 cm from"
                    f" {'rest at 6 cm' if warm else 'empty tanks'}"
                ),
                loop=build(kind, warm),
                clock=Clock(dt=0.1, duration=400.0),
                limits={"max_level": "rim"},
                # the printed gains are far outside the range in which a sliding mode exists
                free={p: Free(1e-3, 100.0) if kind == "smc-printed" else TUNABLE[p] for p in free},
                objective=CHATTER_COST if kind == "smc-printed" else COST,
                scenarios=() if kind == "smc-printed" else tuning_scenarios(),
            )
    for name in FITTED:
        cases[name] = _fitted(name, cases[FITTED[name]])
    return Preset(**printed("mirakhorli"), cases=cases, measured=measured, tunable=TUNABLE)

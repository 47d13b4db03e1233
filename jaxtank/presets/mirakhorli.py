"""Mirakhorli, Farrokhi (2016): non-minimum phase quadruple tank (notes/mirakhorli.md)."""

import dataclasses
import functools
from typing import Any

import numpy as np

from jaxtank.analysis.linear_model import linearise, transmission_zeros
from jaxtank.analysis.riccati import lqr
from jaxtank.analysis.steady_state import equilibrium
from jaxtank.case import Case, Free, Scenario
from jaxtank.controllers import LQI, FuzzyBlend, SlidingMode, StateFeedback
from jaxtank.core.clock import Clock
from jaxtank.core.tree import number, with_values
from jaxtank.plants import quadruple_tank
from jaxtank.presets.paper import Claim, Preset, closed_loop, printed
from jaxtank.signals.setpoints import ramps

SETPOINT = (12.0, 12.0)  # Fig. 6 [cm]
WARM = (6.0, 6.0)  # where the -warm cases start [cm]
HIGH = 5.0  # upper limit of the pumps, not in the paper [V]
SPLIT = (0.42, 0.34)  # gamma, Table 1
# with which Q = C'C, R = 3 I gives the printed K to its last digit (notes S4.1)
UNROUNDED_SPLIT = (0.4165, 0.3414)

GAIN = ((0.2422, 0.1954, 0.0522, 0.1541), (0.1932, 0.1409, 0.1675, -0.0144))  # K, sec. 6 [V/cm]


def plant(split=SPLIT):
    """Return the paper's rig: Tables 1 and 2."""
    return quadruple_tank(
        area=[138.9] * 4,  # Table 2 [cm^2]
        outlet=[0.50265] * 4,  # Table 2 [cm^2]: bores of 8 mm
        pump_gain=[27.43, 19.55],  # Table 1 [cm^3/(s V)]
        split=split,
        rim=30.0,  # sec. 6 [cm]
    )


def sliding(model, printed=False):
    """Return the sliding-mode controller: as printed (sec. 6), or corrected (notes S4.4)."""
    if printed:
        gains: Any = {"surface": 10.0, "ks": 1.0, "form": "printed", "switch": "sign"}
    else:
        gains = {"surface": 0.05, "ks": 0.03, "form": "corrected", "switch": "tanh"}
    return SlidingMode(model=model, phi=0.1, **gains)


def blend(model):
    """Return the fuzzy blend of the corrected sliding mode and the state feedback (notes S4.5)."""
    slide: Any = {"surface": 0.05, "ks": 0.03, "phi": 0.1}
    span: Any = {"b": [1.0, 1.0], "w": [0.5, 0.5], "low": [0.0, 0.0], "high": [HIGH, HIGH]}
    return FuzzyBlend(model=model, K=number(GAIN), **slide, **span)


def integral(model):
    """Return the state feedback with integral action (notes S4.6)."""
    weights: Any = {"Q": [1.0, 1.0, 0.0, 0.0, 1e-3, 1e-3], "R": [3.0, 3.0]}
    return LQI(model=model, **weights, operating_point=number(SETPOINT), anti_windup="frozen")


# the printed controller as a relay: ks 100 hides its chatter
RELAY = {
    "controller.surface": 10.0,
    "controller.ks": 100.0,
    "controller.form": "printed",
    "controller.switch": "sign",
}

SLIDING = ("controller.surface", "controller.ks", "controller.phi")

TUNABLE = {
    "controller.K": Free(-2.0, 2.0, "linear"),
    "controller.surface": Free(0.01, 0.085),
    "controller.ks": Free(3e-3, 0.2),
    "controller.phi": Free(0.04, 1.0),
    "controller.b": Free(0.1, 12.0),
    "controller.w": Free(0.05, 12.0),
    "controller.Q": Free(0.0, 10.0, "linear"),
    "controller.Q[4]": Free(1e-5, 0.1),
    "controller.Q[5]": Free(1e-5, 0.1),
    "controller.R": Free(0.1, 100.0),
}


CONTROLLERS = {  # title, controller for a model, free parameters
    "sfc": ("state feedback", lambda m: StateFeedback(model=m, K=number(GAIN)), ("controller.K",)),
    "smc": ("sliding mode, corrected", sliding, SLIDING),
    "hybrid": (
        "fuzzy blend of sliding mode and state feedback",
        blend,
        (*SLIDING, "controller.b", "controller.w"),
    ),
    "smc-printed": ("sliding mode as printed", lambda m: sliding(m, printed=True), SLIDING[:2]),
    "lqi": (
        "state feedback with integral action",
        integral,
        ("controller.Q[4]", "controller.Q[5]", "controller.R"),
    ),
}

# cases of notes S7.2: data for Table 3 that the paper does not print
FITTED = {"smc-fitted": "smc-printed", "sfc-fitted": "sfc", "hybrid-fitted": "hybrid"}


def fitted(name):
    """Return the closed loop of a case of FITTED (notes S7.2)."""
    # pumps to 5.8 V and 5 % stronger than modelled; the printed sliding mode as a relay;
    # memberships of 3.25 +- 1.5 cm
    loop = build(FITTED[name])
    values: dict = {"actuator.high": [5.8] * 2, "plant.pump_gain": [1.05 * 27.43, 1.05 * 19.55]}
    if name != "sfc-fitted":
        values |= {name: RELAY[name] for name in ("controller.surface", "controller.ks")}
    if name == "hybrid-fitted":
        span = {"b": 3.25, "w": 1.5, "high": 5.8}
        values |= {f"controller.{name}": [value] * 2 for name, value in span.items()}
        kind: Any = loop.controller
        kind = dataclasses.replace(kind, form="printed", switch="sign")
        loop = dataclasses.replace(loop, controller=kind)
    return with_values(loop, values)


def tuning_scenarios():
    """Return the scenarios that `tune` evaluates (notes S10)."""
    # They are the case's own start, and starts from the steady state at the setpoint with one
    # parameter of the plant changed; all with 0.05 cm of noise where the case has none, without
    # which the optimal gains are not bounded.
    steady = {
        **dict.fromkeys(("x0", "actuator.initial", "reference.initial"), "steady"),
        "clock.duration": "x0.75",
    }
    off = {
        "pump 1 +30 %": {"plant.pump_gain[0]": "x1.3"},
        "pump 1 -20 %": {"plant.pump_gain[0]": "x0.8"},
        "pump 2 +30 %": {"plant.pump_gain[1]": "x1.3"},
        "outlet 1 +10 %": {"plant.drain[0]": "x1.1"},
        "outlet 1 -10 %": {"plant.drain[0]": "x0.9"},
        "gamma 1 -10 %": {"plant.split[0]": "x0.9"},
    }
    noise = {"sensor.noise": "0.05 if zero"}
    runs = {"own start": noise, **{name: {**steady, **v, **noise} for name, v in off.items()}}
    rows = enumerate(runs.items())
    return tuple(Scenario(name, values, seed=11 + i) for i, (name, values) in rows)


def build(kind, warm=False):
    """Return the closed loop of a controller, from empty tanks or the steady state at WARM."""
    rig = plant()
    x0, u0 = equilibrium(rig, WARM) if warm else ((0.0,) * 4, (0.0,) * 2)
    steps = [(0.0, i, level) for i, level in enumerate(SETPOINT)]
    return closed_loop(
        rig,
        CONTROLLERS[kind][1](rig),
        ramps(WARM if warm else (0.0, 0.0), steps, ramp=0.0),
        x0,
        sensor=(6.0, 5.0),
        pumps={"low": 0.0, "high": HIGH, "initial": u0},
    )


def response(trajectory, output=0):
    """Return the characteristics of a step from the steady state to SETPOINT (notes S3)."""
    t, h, r = trajectory.t, trajectory.x[:, output], SETPOINT[output]
    first = lambda level: float(t[np.argmax(h >= level)]) if np.any(h >= level) else None
    low, high = (first(h[0] + share * (r - h[0])) for share in (0.1, 0.9))
    outside = np.flatnonzero(np.abs(h - r) > 0.05 * r)
    never = outside.size and outside[-1] == len(t) - 1
    return {
        "overshoot": float(100.0 * (h.max() - r) / r),
        "rise": None if high is None or low is None else high - low,
        "arrival": first(r),
        "settling": None if never else float(t[outside[-1]]) if outside.size else 0.0,
        "mean_square": float(np.mean((h - r) ** 2) / r**2),
    }


QUANTITIES = {  # {quantity of `response`: (name in Table 3, unit)}
    "overshoot": ("overshoot", " %"),
    "arrival": ("rise time", " s"),
    "settling": ("settling time", " s"),
    "mean_square": ("LMSE", ""),
}
# {controller of Table 3: our cases}
SAME_CONTROLLER = {"SMC": ("smc", "smc-printed"), "SFC": ("sfc",), "hybrid": ("hybrid",)}


def measured(run):
    """Return measured values of the published rows (see `jaxtank.presets.paper.Preset`)."""
    # {controller of Table 3: its `response` with what notes S7.2 assumes}
    assumed = {name: response(run(case)[1]) for name, case in zip(("SMC", "SFC", "hybrid"), FITTED)}
    rise = {name: values["arrival"] for name, values in assumed.items()}
    settled = [assumed[name]["settling"] for name in ("SFC", "hybrid")]
    cases = {name: response(run(kinds[0])[1])["arrival"] for name, kinds in SAME_CONTROLLER.items()}
    error = float(np.abs(run("hybrid")[1].e[-1]).max())
    slowest = lambda t: None not in t.values() and max(t["SMC"], t["hybrid"]) < t["SFC"]
    before = {kind: run.cost(kind) for kind in ("hybrid", "smc", "sfc", "lqi")}
    tuned = {kind: run.cost(kind, values) for kind, values in TUNED.items()}
    return {
        **_table_3(run, assumed),
        "SFC rises more slowly": Claim(
            [slowest(times) for times in (rise, cases)],
            f"first at 12 cm: {_times(rise)} under the assumptions of notes S7.2; {_times(cases)}"
            " with the cases as they are",
        ),
        "settling of the hybrid": Claim(
            None not in settled and settled[1] < 0.9 * settled[0],
            f"{_text(settled[1], ' s')}, SFC {_text(settled[0], ' s')} under the assumptions of"
            " notes S7.2 (counts if 10 % sooner)",
        ),
        "hybrid: steady-state error": Claim(
            error < 0.01, f"{error:.1e} cm after 400 s (counts if below 0.01 cm)"
        ),
        "hybrid against SMC and SFC": Claim(
            (before["hybrid"] < min(before["smc"], before["sfc"]), tuned["hybrid"] < tuned["sfc"]),
            "mean J of notes S10: hybrid {:.0f}, SMC {:.0f}, SFC {:.0f}, lqi {:.0f} with the given"
            " gains; hybrid {:.0f}, SFC {:.0f}, lqi {:.0f} once tuned for it".format(
                *before.values(), *(tuned[kind] for kind in ("hybrid", "sfc", "lqi"))
            ),
        ),
        **_linear(run("sfc")[0].loop),
        "gamma1 + gamma2": float(np.sum(run("sfc")[0].loop.plant.split)),
        "chattering of the SMC": _chattering(run),
        **_steady_errors(run),
    }


def _times(times):
    return ", ".join(f"{name} {_text(value, ' s')}" for name, value in times.items())


# gains that `jaxtank tune mirakhorli/KIND --nominal` ends at
TUNED = {
    "sfc": {
        "controller.K": [
            [0.618277, 0.983796, 0.541849, 0.989077],
            [1.02128, -0.394448, -0.141067, -0.687492],
        ]
    },
    "hybrid": {
        "controller.surface": 0.0585926,
        "controller.ks": 0.0608694,
        "controller.phi": 0.413365,
        "controller.b": [0.496406, 0.678736],
        "controller.w": [2.00124, 1.31036],
    },
    "lqi": {
        "controller.Q[4]": 0.00162565,
        "controller.Q[5]": 0.00171357,
        "controller.R": [4.15314, 2.67737],
    },
}


def _text(value, unit):
    return "never" if value is None else f"{value:.3g}{unit}"


def _table_3(run, assumed):
    """The numbers of Table 3 under the assumptions of notes S7.2, and as the cases are."""
    responses, rows = {kind: response(run(kind)[1]) for kind in CONTROLLERS}, {}
    near, words, published = [], [], printed("mirakhorli")["published"]
    for quantity, (name, unit) in QUANTITIES.items():
        for controller in SAME_CONTROLLER:
            value = assumed[controller][quantity]
            target = published[f"{name}, {controller}"].value
            if value is None or isinstance(target, str):  # it never settles
                value = Claim(value is None and isinstance(target, str), _text(value, unit))
            rows[f"{name}, {controller}"] = value
            values = (responses[case][quantity] for case in SAME_CONTROLLER[controller])
            near += [_near(each, target) for each in values]
        cases = [case for cases in SAME_CONTROLLER.values() for case in cases]
        each = ", ".join(f"{_text(responses[case][quantity], unit)} in {case}" for case in cases)
        words.append(f"{name} {each}")
    words.append(f"{sum(near)} of {len(near)} are within 10 % of Table 3")
    return rows | {"Table 3 with the cases as they are": Claim(near, "; ".join(words))}


def _near(value, target):
    """Return True if a measured value (None: never) is within 10 % of the printed one."""
    if value is None or isinstance(target, str):
        return value is None and isinstance(target, str)
    return abs(value / target - 1.0) <= 0.1


def _linear(loop):
    """Rows that follow from the linear model at the setpoint."""
    model = lambda tanks: map(np.asarray, linearise(tanks, *equilibrium(tanks, SETPOINT)))
    A, B, C = model(loop.plant)
    K = np.asarray(loop.controller.K)
    direct = np.abs(C @ B).max(axis=1) > 0.0
    zeros = np.sort(np.real(np.asarray(transmission_zeros(A, B, C))))
    wrong, right = (float(np.linalg.eigvals(A + s * B @ K).real.max()) for s in (1.0, -1.0))
    A_fit, B_fit, _ = model(dataclasses.replace(loop.plant, split=np.asarray(UNROUNDED_SPLIT)))
    optimal = np.asarray(lqr(A_fit, B_fit, C.T @ C, 3.0 * np.eye(2)))
    near = float(np.abs(optimal - K).max())
    return {
        "relative degree": tuple(1 if acts else 2 for acts in direct),
        "non-minimum phase": Claim(
            bool(zeros[-1] > 0.0), f"zeros at {zeros[0]:+.4f} and {zeros[-1]:+.4f} 1/s"
        ),
        "SFC is an optimal gain": Claim(
            near < 1e-4,
            f"with Q = C'C, R = 3 I and gamma = {UNROUNDED_SPLIT[0]}, {UNROUNDED_SPLIT[1]} every"
            f" entry of K to {near:.0e} V/cm",
        ),
        "sign of the SFC": Claim(
            wrong < 0.0,
            f"largest real part of the poles {wrong:+.4f} 1/s as printed, {right:+.4f} 1/s with"
            " the sign of notes E11",
        ),
    }


# J of notes S3, with its weight of the total variation of the input
COST = {"ise": 1.0, "input_deviation": 3.0, "input_travel": 0.1}
# for the controller that chatters: its derivatives are not worth seven runs
CHATTER_COST = {"rms_error_total": 1.0, "input_travel": 1e-3}


def steady_error(run, kind, values):
    """Return the mean error (2,) [cm] of the last 100 s of 400 s."""
    x0, u0 = equilibrium(plant(), SETPOINT)
    start = {"x0": x0.tolist(), "actuator.initial": u0.tolist()}
    start |= {"reference.initial": list(SETPOINT)}
    return run(kind, {**start, **values})[1].e[-1000:].mean(axis=0)


def _chattering(run):
    total = lambda kind: float(np.abs(np.diff(run(kind)[1].u, axis=0)).sum())
    variation = {kind: total(kind) for kind in ("sfc", "hybrid", "smc-printed")}
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
    error = lambda kind, more: steady_error(run, kind, {**narrow, **more})[0]
    sfc, hybrid, corrected = error("sfc", {}), error("hybrid", relay), error("hybrid", {})
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
    more |= {} if name.startswith("hybrid") else {f: getattr(case, f) for f in more}
    title = f"{case.title}; rig fitted to Table 3"
    return case.replace(name=f"mirakhorli/{name}", title=title, loop=loop, **more)


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

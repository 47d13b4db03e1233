"""khalid, sec. V: further rows of `jaxtank compare`, of the pulses from 0 m as printed."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.analysis import qp
from jaxtank.presets.loops.khalid import CLOCK, scenario
from jaxtank.presets.paper import Claim
from jaxtank.presets.rows.operations import operations

SISO = ("gpc-nc2", "gpc", "gpc-nc30", "laguerre")
MIMO = ("gpc-mimo", "laguerre-mimo")


def from_empty(name):
    """Return the values that make scenario `name` of notes S3 of a case with its pumps."""
    reference, x0, u0 = scenario(name)
    return {
        "reference.initial": np.asarray(reference.initial).tolist(),
        "reference.targets": np.asarray(reference.targets).tolist(),
        "x0": np.asarray(x0).tolist(),
        "actuator.initial": np.asarray(u0).tolist(),
    }


def measured(run, edges):
    """Return {quantity: what was measured}; edges: of `jaxtank.presets.khalid`."""
    error, over, under = {}, {}, {}  # RMS [mm], overshoot and undershoot [%] of each output
    for names, start in ((SISO, "S1"), (MIMO, "M1")):
        for name in names:
            case, t = run(name, from_empty(start))
            found = edges(case.loop.reference, t)
            error[name] = 1e3 * np.sqrt((t.e**2).mean(axis=0))
            over[name] = [channel["overshoot"][0] for channel in found]
            under[name] = [channel["overshoot"][1] for channel in found]
    return {**_sizes(run), **_undershoot(run, edges), **_from_empty(error, over, under)}


def _pulses(case):
    """(low, high) of each output's pulses [m]."""
    reference = case.loop.reference
    levels = [
        [float(v) for (_, i), v in zip(reference.changes, reference.targets) if i == output]
        for output in range(reference.channels)
    ]
    return tuple(v for one in levels for v in (min(one), max(one)))


def _sizes(run):
    """The pulses of our cases, and the variables of the programmes."""
    loops = {name: run(name, {"clock.substeps": 2})[0].loop for name in (*SISO, *MIMO)}
    count = {
        name: loop.plant.pumps * getattr(loop.controller, "N", getattr(loop.controller, "Nc", 0))
        for name, loop in loops.items()
    }
    fixed = {  # du = -K x_e
        name: operations(jax.make_jaxpr(jnp.matmul)(K, K[0]).jaxpr)
        for name, loop in loops.items()
        for K in [np.asarray(loop.controller.gain(CLOCK.dt))]
    }
    programme = {name: _programme(loop) for name, loop in loops.items()}
    order = ("laguerre", "gpc", "gpc-nc30")
    return {
        "pulses of H2, one pump": _pulses(run("gpc", {"clock.substeps": 2})[0]),
        "pulses of H1 and H2, two pumps": _pulses(run("gpc-mimo", {"clock.substeps": 2})[0]),
        "controller.N, two pumps": loops["laguerre-mimo"].controller.N,
        "computational cost of Laguerre": Claim(
            [
                cost[laguerre] < cost[gpc]
                for cost in (fixed, programme)
                for laguerre, gpc in (("laguerre", "gpc"), ("laguerre-mimo", "gpc-mimo"))
            ],
            "arithmetic operations, counted and not timed, with Laguerre functions, GPC 10 and GPC"
            " 30: without constraints {}, {} and {} a sample; with constraints {}, {} and {} an"
            " iteration of the programme, of {}, {} and {} variables; with two pumps {} for {} of"
            " GPC without and {} for {} with constraints".format(
                *(cost[n] for cost in (fixed, programme, count) for n in order),
                *(cost[n] for cost in (fixed, programme) for n in reversed(MIMO)),
            ),
        ),
    }


def _programme(loop):
    """Operations of the programme of eq. (32): its setting up and one iteration."""
    control = loop.controller
    Omega, Psi, basis = control.design(CLOCK.dt)
    steps = basis[: control.ahead]
    rows = jnp.concatenate([steps, jnp.cumsum(steps, axis=0)]).reshape(-1, Omega.shape[0])
    ends = jnp.ones(rows.shape[0])
    return operations(jax.make_jaxpr(qp.solve)(Omega, Psi[:, 0], rows, -ends, ends).jaxpr)


def _undershoot(run, edges):
    """The undershoot at falling edges of the cases' own pulses [%]."""
    under = {}
    for name in SISO[:3]:
        case, t = run(name, {"clock.substeps": 2})
        under[name] = edges(case.loop.reference, t)[0]["overshoot"][1]
    return {
        "undershoot against control horizon": Claim(
            [value > 1.0 for value in under.values()],
            "below the lower level with Nc 2, 10, 30: "
            + ", ".join(f"{value:.2f} %" for value in under.values())
            + " of the step (counts if above 1 %)",
        )
    }


def _from_empty(error, over, under):
    """The claims on pulses from 0 m."""
    one = [error[name][0] for name in SISO]
    top = [over[name][0] for name in SISO]
    low = [under[name][0] for name in SISO]
    gain = 1.0 - top[3] / top[2]
    both = "; ".join(
        "{:.2f}, {:.2f} mm and {:.1f}, {:.1f} % with {}".format(*error[n], *over[n], shown)
        for n, shown in zip(MIMO, ("GPC", "Laguerre functions"))
    )
    return {
        "pulses from 0 m: long control horizon": Claim(
            (one[1] < one[0], top[1] <= top[0]),
            f"RMS error {one[0]:.2f} mm with Nc 2, {one[1]:.2f} mm with Nc 10; overshoot"
            f" {top[0]:.2f} and {top[1]:.2f} %",
        ),
        "pulses from 0 m: control horizon beyond 10": Claim(
            one[2] > 0.95 * one[1],
            f"RMS error {one[1]:.2f} mm with Nc 10, {one[2]:.2f} mm with Nc 30",
        ),
        "pulses from 0 m: overshoot and undershoot": Claim(
            [value > 1.0 for value in (*top[:3], *low[:3])],
            f"overshoot {top[0]:.2f}, {top[1]:.2f}, {top[2]:.2f} % with Nc 2, 10, 30; undershoot at"
            f" most {max(low[:3]):.2g} % (lots: above 1 %)",
        ),
        "pulses from 0 m: overshoot of Laguerre": Claim(
            (gain > 0.0, gain >= 0.2),
            f"{top[3]:.2f} % against {top[2]:.2f} %: {100 * gain:.0f} % less at the same r_w",
        ),
        "pulses from 0 m: Laguerre with two pumps": Claim(
            error["laguerre-mimo"] < 0.98 * error["gpc-mimo"],
            f"RMS errors and overshoots {both} (counts if 2 % less)",
        ),
    }

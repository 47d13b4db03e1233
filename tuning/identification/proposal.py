"""A first controller for an identified rig (`identify --law pi`): gains to start a tuning from."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from jaxtank import rig as rigs
from jaxtank.analysis.steady_state import linearise
from jaxtank.case import Free
from jaxtank.core.errors import InputError
from jaxtank.core.tree import number
from jaxtank.rig.components import law_of
from jaxtank.signals.base import Constant
from jaxtank.signals.setpoints import Ramps, ramps

LAWS = ("pi",)
STEPS = (1.1, 0.9, 1.05, 0.95)
"""Setpoint of each output after its change, over its steady level; the first that the rig can hold
is taken [-].
"""

LONGEST = 1e8
"""Time by which a rig with constant inputs must have come to its steady state [s]."""

MOST = 100_000
"""Samples of the proposed run at most."""


def check_law(law, case):
    """Raise InputError unless `law` is None or one of LAWS that suits the rig of `case`."""
    if law is None:
        return
    if law not in LAWS:
        raise InputError(
            f"--law {law!r}: must be one of {', '.join(LAWS)}; other controllers go into the [law]"
            " section of a rig file"
        )
    plant = case.loop.plant
    if len(plant.outputs) != plant.pumps:
        raise InputError(
            f"--law {law}: needs one pump per controlled tank, the rig has {plant.pumps} pumps and"
            f" {len(plant.outputs)}: add a [law] section of another kind to the rig file"
        )


def with_pi(case, inputs):
    """Return `case` under one PI controller per pump, output i to pump i, with [free] ranges about
    its gains.

    T-sum rule (Kuhn 1995): Kc = 0.5/K, Ti = T/2, with the gain K [cm/V] and the sum of time
    constants T [s] of each output's response to its own pump, linearised at the steady state for
    `inputs` (m,) [V], the pumps' delay added to T. Kc of all loops is halved until the linear
    closed loop is stable. A case whose setpoints never change is given a change of each, by 10 %,
    from that steady state. Raises InputError where there is no such steady state, model or
    setpoint.
    """
    loop, clock = case.loop, case.clock
    plant, (length, drive) = loop.plant, loop.units
    inputs = np.clip(inputs, np.asarray(loop.actuator.low), np.asarray(loop.actuator.high))
    x = _steady(loop, inputs)
    A, B, C = (np.asarray(M) for M in linearise(plant, x, inputs))
    try:
        once = np.linalg.solve(A, B)
        gain, lag = -np.diag(C @ once), np.diag(C @ np.linalg.solve(A, once))
    except np.linalg.LinAlgError:
        gain = lag = np.zeros(plant.pumps)
    for j, (k, area) in enumerate(zip(gain, lag)):
        if not (k > 0 and area > 0 and math.isfinite(area / k)):
            at = ", ".join(f"{v:g}" for v in inputs)
            raise InputError(
                f"pump {j + 1} does not settle tank {plant.outputs[j] + 1} at inputs ({at})"
                f" {drive}: no PI of its own, use another [law]"
            )
    total = lag / gain + loop.actuator.delay
    Kc, Ti = 0.5 / gain, 0.5 * total
    for _ in range(8):
        closed = np.block(
            [[A - B * Kc @ C, B], [-(Kc / Ti)[:, None] * C, np.zeros((plant.pumps,) * 2)]]
        )
        if np.linalg.eigvals(closed).real.max() < 0:
            break
        Kc = 0.5 * Kc
    else:
        raise InputError(
            "output i under a PI of pump i is not stable at any gain tried: use another [law]"
        )
    moving = not isinstance(loop.reference, Constant) and not (
        isinstance(loop.reference, Ramps) and not loop.reference.changes
    )
    outputs = list(plant.outputs)
    start = [float(loop.x0[i]) for i in outputs] if moving else x[outputs].tolist()
    table = {"kind": "pid", "Kc": Kc.tolist(), "Ti": Ti.tolist(), "Tt": Ti.tolist()} | (
        {} if moving else {"bias": inputs.tolist()}
    )
    law = law_of(table, plant, start, loop.actuator.initial)
    free = {n: f for n, f in case.free.items() if not n.startswith("controller.")}
    free |= {"controller.Kc": Free(float(Kc.min() / 30), float(Kc.max() * 30))}
    free |= {"controller.Ti": Free(float(Ti.min() / 10), float(Ti.max() * 10))}
    proposed = case.replace(
        loop=dataclasses.replace(loop, controller=law),
        free=free,
        symmetry=None,
        objective=case.objective or {"rms_error_total": 1.0},
        scenarios=tuple(
            s for s in case.scenarios if not any(n.startswith("controller.") for n in s.values)
        ),
    )
    if moving:
        return rigs.check(proposed)
    pause = clock.dt * min(math.ceil(5 * total.max() / clock.dt), MOST // len(outputs))
    clock = dataclasses.replace(clock, duration=pause * len(outputs))
    changes = [
        (round(0.1 * pause / clock.dt) * clock.dt + k * pause, k) for k in range(len(outputs))
    ]
    pumps = dataclasses.replace(loop.actuator, initial=number(inputs))
    for share in STEPS:
        reference = ramps(start, [(t, k, share * start[k]) for t, k in changes], ramp=0.0)
        whole = dataclasses.replace(
            proposed.loop, reference=reference, x0=number(x), actuator=pumps
        )
        one = proposed.replace(loop=whole, clock=clock)
        if not rigs.unreachable(one):
            return rigs.check(one.replace(reachable=True))
    raise InputError(
        f"no setpoints about {', '.join(f'{v:.4g}' for v in start)} {length} can be held: add [law]"
        " and [reference]"
    )


def _steady(loop, inputs):
    """(n,) levels at which the rig stands with `inputs` held. Raises InputError where there are
    none below the rims.
    """
    plant = loop.plant
    inflow = (
        tuple(np.asarray(loop.disturbance.level))
        if isinstance(loop.disturbance, Constant)
        else None
    )
    derivative = jax.jit(
        lambda x: jnp.stack(
            plant.derivative(0.0, tuple(jnp.maximum(x, 0.0)), tuple(inputs), inflow)
        )
    )
    rate = lambda _, x: np.asarray(derivative(x))
    x, span, rim = (
        np.maximum(np.asarray(loop.x0, dtype=float), 1e-3 * np.asarray(plant.rim)),
        100.0,
        np.asarray(plant.rim),
    )
    while span <= LONGEST:
        x = np.maximum(
            solve_ivp(rate, (0.0, span), x, method="LSODA", rtol=1e-9, atol=1e-9 * rim.min()).y[
                :, -1
            ],
            0.0,
        )
        if np.any(x > 10 * rim) or np.all(np.abs(rate(0.0, x)) * span <= 1e-6 * rim):
            break
        span *= 10
    at = ", ".join(f"{v:.4g}" for v in inputs)
    for i in np.flatnonzero((x >= rim) | (x <= 1e-3 * rim) | (span > LONGEST)):
        raise InputError(
            f"tank {i + 1} has no steady level between 0 and its rim at the mean inputs of the log,"
            f" ({at}) {loop.units[1]}: add [law], [reference] and [free]"
        )
    return x

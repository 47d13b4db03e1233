"""Sliding-mode control of the quadruple tank (mirakhorli sec. 4.1), as printed and corrected."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxtank.analysis.steady_state import steady_along, steady_under
from jaxtank.controllers.base import Controller
from jaxtank.core.clock import pointwise
from jaxtank.core.numerics import clip, smooth_signed_sqrt, smooth_signed_sqrt_slope
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import POSITIVE, component, leaf, static
from jaxtank.plants.base import Plant
from jaxtank.plants.rigs import QUADRUPLE_FEEDS, QUADRUPLE_LINKS, check_topology
from jaxtank.signals.base import Signal

SWITCHES = {"tanh": jnp.tanh, "clip": lambda x: clip(x, -1.0, 1.0), "sign": jnp.sign}
FORMS = ("corrected", "printed")
# least size of the determinant, as a share of its antidiagonal part: at the design -0.83
# (mirakhorli notes S4.3)
SMALLEST = 1e-3


class LowerTanks(NamedTuple):
    """Coefficients of the model at tanks 1 and 2: pairs, tank 1 first."""

    drift: tuple  # phi_i: rate of the level without the tank's own pump [cm/s]
    slope: tuple  # D_i: how the drift falls with the level [1/s]
    cross: tuple  # how it rises with the level of the tank above [1/s]
    above: tuple  # rate at which the tank above would fall without its pump [cm/s]
    own: tuple  # gamma_i k_i / A_i: rate that the tank's own pump gives it [cm/(s V)]
    # rate that the other pump gives the tank above: (1 - gamma2) k2 / A3, (1 - gamma1) k1 / A4
    # [cm/(s V)]
    upper: tuple


def lower_tanks(model, x):
    """Return `LowerTanks` of a quadruple tank at levels x (4) [cm]."""
    # phi1 = (-q1 + q3)/A1 and phi2 = (-q2 + q4)/A2 with q_i = a_i sqrt(2 g h_i): mirakhorli eq. (2)
    # less the direct flow; smooth roots, whose slope has no kink at an empty tank
    w, area = jnp.sqrt(2.0 * model.gravity), [model.area[i] for i in range(4)]
    q = [w * smooth_signed_sqrt(h, model.knee) for h in x]
    dq = [w * smooth_signed_sqrt_slope(h, model.knee) for h in x]
    drain, link = [model.drain[i] for i in range(4)], [model.orifice[k] for k in range(2)]
    gain, split = model.pump_gain, model.split
    return LowerTanks(
        drift=tuple((link[i] * q[i + 2] - drain[i] * q[i]) / area[i] for i in range(2)),
        slope=tuple(drain[i] * dq[i] / area[i] for i in range(2)),
        cross=tuple(link[i] * dq[i + 2] / area[i] for i in range(2)),
        above=tuple((link[i] + drain[i + 2]) * q[i + 2] / area[i + 2] for i in range(2)),
        own=tuple(split[i] * gain[i] / area[i] for i in range(2)),
        upper=tuple((1.0 - split[j]) * gain[j] / area[i + 2] for i, j in ((0, 1), (1, 0))),
    )


class Acceleration(NamedTuple):
    """d/dt of (damping h_i' + ...) as an affine map of the voltages: f + M u [cm/s^2]."""

    f: tuple
    diagonal: tuple  # M11, M22
    across: tuple  # M12, M21


def acceleration(tanks, damping):
    """Return f and M of d/dt(damping h_i + phi_i) = f_i + (M u)_i."""
    # damping: [1/s]; 0 gives f and G of mirakhorli eq. (4), all terms of which are right except
    # that gamma_i k_i u_i'/A_i is missing from it (mirakhorli notes E2).
    net = tuple(damping - d for d in tanks.slope)
    return Acceleration(
        f=tuple(n * p - c * a for n, p, c, a in zip(net, tanks.drift, tanks.cross, tanks.above)),
        diagonal=tuple(n * g for n, g in zip(net, tanks.own)),
        across=tuple(c * g for c, g in zip(tanks.cross, tanks.upper)),
    )


def slide(model, surface, ks, phi, switch, form, x, r, u0, previous, d=()) -> tuple[Any, Any]:
    """Return the (2) voltages [V] of the sliding-mode control law, not limited."""
    printed = form == "printed"
    tanks = lower_tanks(model, x)
    if d:
        tanks = tanks._replace(
            drift=tuple(phi + w for phi, w in zip(tanks.drift, d[:2])),
            above=tuple(fall - w for fall, w in zip(tanks.above, d[2:])),
        )
    rate = tuple(p + g * u for p, g, u in zip(tanks.drift, tanks.own, previous if printed else u0))
    s = tuple(surface * (h - target) + v for h, target, v in zip(x, r, rate))
    f, (m11, m22), (m12, m21) = acceleration(tanks, 0.0 if printed else surface)
    v1, v2 = (
        -f_i - (surface * v if printed else 0.0) - ks * SWITCHES[switch](s_i / phi)
        for f_i, v, s_i in zip(f, rate, s)
    )
    least, det = SMALLEST * m12 * m21, m11 * m22 - m12 * m21
    det = jnp.where(jnp.abs(det) < least, jnp.where(det > 0.0, least, -least), det)
    return (m22 * v1 - m12 * v2) / det, (m11 * v2 - m21 * v1) / det


def check_quadruple(model):
    """Raise InputError unless `model` is a quadruple tank."""
    check_topology(
        model,
        "a quadruple tank (plants.quadruple_tank)",
        links=QUADRUPLE_LINKS,
        feeds=QUADRUPLE_FEEDS,
        pipes=(),
        outputs=(0, 1),
    )


@component
class SlidingMode(Controller):
    """Sliding-mode controller of the quadruple tank (mirakhorli sec. 4.1):

        M u = -f - ks sw(s / phi),   sw one of tanh, clip to [-1, 1], sign

    with u [V], s [cm/s], f [cm/s^2].

    "corrected" (mirakhorli notes S4.4): s_i = surface e_i + phi_i(h) + gamma_i k_i u0_i / A_i,
    whose rate f + M u is exact in u and needs no u'. The surface is zero at the steady state of the
    setpoint. A sliding mode exists and is stable for surfaces between two bounds: 0.0088 and 0.088
    1/s for the paper's rig at 12 cm (mirakhorli notes S4.3). For constant setpoints: their rates
    are not used.

    "printed" (mirakhorli eq. 10): s_i = surface e_i + h_i', f and M without the surface, and
    surface h_i' subtracted; h_i' from the full model with the voltages applied in the last sample
    (the paper does not define how h_i' is obtained: reading (a) of mirakhorli notes S4.2).

    Gradients: with tanh they are good while ks Ts / phi < 2; above, the sampled loop chatters and
    they grow without bound (mirakhorli notes H2). With sign, phi has no effect and the other
    derivatives omit the jumps.

    With disturbances d of the level rates that an observer estimates [cm/s], phi_i(h) has d_i in
    it, the tank above falls by d less, and u0 is the steady input under d (`steady_under`): the
    surfaces are then zero at the steady state of the disturbed plant.

    Examples
    --------
    >>> from jaxtank.plants.rigs import johansson
    >>> rig, _ = johansson("non-minimum")
    >>> controller = SlidingMode(model=rig, surface=0.05, ks=0.03, phi=0.1)
    >>> controller.switch, controller.form
    ('tanh', 'corrected')
    """

    model: Plant
    surface: float = leaf("1/s", "slope lambda of the sliding surface", **POSITIVE)
    ks: float = leaf("cm/s^2", "switching gain ks, of both surfaces", low=0.0)
    phi: float = leaf("cm/s", "half width of the boundary layer", **POSITIVE)
    switch: str = static("-", "switching function", choices=tuple(SWITCHES), default="tanh")
    form: str = static("-", "which control law", choices=FORMS, default="corrected")

    @pointwise
    def prepare(self, r: tuple, dr: tuple, ddr: tuple) -> Any:
        return steady_along(self.model, r)[1]

    def init(self, x0: tuple, u0: tuple) -> Any:
        return u0 if self.form == "printed" else ()

    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence, Any]:
        design = (self.model, self.surface, self.ks, self.phi, self.switch, self.form)
        u0 = tick.plan
        if estimate.d:  # the inputs alone, which do not depend on the levels given
            _, u0 = steady_under(self.model, estimate.x, u0, estimate.d)
        return slide(*design, estimate.x, tick.r, u0, state, estimate.d), state

    def track(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        return applied if self.form == "printed" else state

    def check(self, reference: Signal) -> None:
        check_quadruple(self.model)

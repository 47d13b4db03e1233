"""Fuzzy blend of sliding mode and state feedback for the quadruple tank (mirakhorli sec. 4.3)."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxtank.analysis.steady_state import steady_along
from jaxtank.controllers.base import Controller
from jaxtank.controllers.sliding_mode import FORMS, SWITCHES, check_quadruple, slide
from jaxtank.controllers.state_feedback import feedback
from jaxtank.core.clock import pointwise
from jaxtank.core.errors import InputError
from jaxtank.core.numerics import clip, magnitude
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import component, leaf, static
from jaxtank.plants.base import Plant
from jaxtank.signals.base import Signal

PAIRINGS = {"cross": (1, 0), "same": (0, 1)}


def membership(size, b, w):
    """Membership of a size |e| [cm] in "high": 0 up to b - w, 1 from b + w, the C1 smoothstep 3x^2
    - 2x^3 between.

    "Low" is 1 less this (mirakhorli notes S4.5).

    b: where it is 1/2 [cm]; w: half width [cm], taken as at most b, so that it is exactly 0 at no
        error.
    """
    w = jnp.where(w > b, b, w)
    x = clip((size - b + w) / (2.0 * w), 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


@component
class FuzzyBlend(Controller):
    """u_i = mu_H(|e_j|) u_SMC,i + (1 - mu_H(|e_j|)) u_SFC,i: sliding mode far from the setpoint,
    state feedback near it (eqs. 16-17).

    The sliding-mode voltages are held within [low, high] before they are blended. pairing: which
    error decides on input i: "cross", j = 3 - i, as the text of sec. 4.3 has it (in the non-minimum
    phase each output is moved by the other pump), or "same", j = i, as eq. (17) prints it. b and w
    are indexed by input. The inner laws are those of `SlidingMode` and `StateFeedback`.
    """

    model: Plant
    K: np.ndarray = leaf("V/cm", "(2, 4) gain K of the state feedback")
    surface: float = leaf("1/s", "slope lambda of the sliding surface", low=0.0, strict=True)
    ks: float = leaf("cm/s^2", "switching gain ks, of both surfaces", low=0.0)
    phi: float = leaf("cm/s", "half width of the boundary layer", low=0.0, strict=True)
    b: np.ndarray = leaf(
        "cm", "(2,) size of error at which both laws count half, per input", low=0.0, strict=True
    )
    w: np.ndarray = leaf(
        "cm", "(2,) half width of the blend, per input; at most b", low=0.0, strict=True
    )
    low: np.ndarray = leaf("V", "(2,) lower limit of the sliding-mode inputs")
    high: np.ndarray = leaf("V", "(2,) upper limit of the sliding-mode inputs")
    pairing: str = static(
        "-", "whose error decides on an input", choices=tuple(PAIRINGS), default="cross"
    )
    switch: str = static("-", "switching function", choices=tuple(SWITCHES), default="tanh")
    form: str = static("-", "which sliding-mode law", choices=FORMS, default="corrected")

    @pointwise
    def prepare(self, r: tuple, dr: tuple, ddr: tuple) -> Any:
        return steady_along(self.model, r)

    def init(self, x0: tuple, u0: tuple) -> Any:
        return u0 if self.form == "printed" else ()

    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence, Any]:
        h0, u0 = tick.plan
        law = (self.model, self.surface, self.ks, self.phi, self.switch, self.form)
        far = [
            clip(u, self.low[i], self.high[i])
            for i, u in enumerate(slide(*law, estimate.x, tick.r, u0, state))
        ]
        near = feedback(self.K, estimate.x, h0, u0)
        size = [magnitude(h - r) for h, r in zip(estimate.x, tick.r)]
        share = [
            membership(size[j], self.b[i], self.w[i]) for i, j in enumerate(PAIRINGS[self.pairing])
        ]
        return tuple(n + m * (f - n) for m, f, n in zip(share, far, near)), state

    def track(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        return applied if self.form == "printed" else state

    def check(self, reference: Signal) -> None:
        check_quadruple(self.model)
        for name, shape in (("K", (2, 4)), ("b", (2,)), ("w", (2,)), ("low", (2,)), ("high", (2,))):
            if np.shape(getattr(self, name)) != shape:
                raise InputError(
                    f"controller.{name} has shape {np.shape(getattr(self, name))}: must be {shape}"
                )

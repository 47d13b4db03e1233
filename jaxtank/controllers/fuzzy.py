"""Fuzzy blend of sliding mode and state feedback for the quadruple tank (mirakhorli sec. 4.3)."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxtank.analysis.steady_state import steady_along, steady_under
from jaxtank.controllers.sliding_mode import SlidingMode, slide
from jaxtank.controllers.state_feedback import feedback
from jaxtank.core.clock import pointwise
from jaxtank.core.numerics import clip, magnitude
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import POSITIVE, component, leaf, static

PAIRINGS = {"cross": (1, 0), "same": (0, 1)}


def membership(size, b, w):
    """Return the membership of |e| in "high": C1 smoothstep from b - w (0) to b + w (1)."""
    # The membership in "low" is 1 minus this (mirakhorli notes S4.5).
    w = jnp.minimum(w, b)  # its slopes at a tie are halves: the mean of both sides
    x = clip((size - b + w) / (2.0 * w), 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


@component
class FuzzyBlend(SlidingMode):
    """u_i = mu_H(|e_j|) u_SMC,i + (1 - mu_H(|e_j|)) u_SFC,i: sliding mode far from the setpoint,
    state feedback near it (eqs. 16-17).

    The sliding-mode voltages are clipped to [low, high] [V] before they are blended. pairing: which
    error weights input i: "cross", j = 3 - i, as in the text of sec. 4.3 (in the non-minimum phase
    each output is moved by the other pump), or "same", j = i, as eq. (17) is printed. b and w [cm]
    are indexed by input. The blended controllers are `SlidingMode` and `StateFeedback`, which use
    disturbances that an observer estimates.

    Examples
    --------
    >>> from jaxtank.plants.rigs import johansson
    >>> controller = FuzzyBlend(
    ...     model=johansson("non-minimum")[0],
    ...     K=np.zeros((2, 4)),
    ...     surface=0.05,
    ...     ks=0.03,
    ...     phi=0.1,
    ...     b=[1.0, 1.0],
    ...     w=[0.5, 0.5],
    ...     low=[0.0, 0.0],
    ...     high=[5.0, 5.0],
    ... )
    >>> h0, u0 = (12.0, 12.0, 4.0, 5.0), (3.0, 3.0)
    >>> tick = Tick(t=0.0, r=(12.0, 12.0), dr=(0.0, 0.0), ddr=(0.0, 0.0), plan=(h0, u0))
    >>> u, _ = controller.step(controller.init(h0, u0), tick, Estimate(x=h0))
    >>> [float(v) for v in u]  # no error: state feedback alone
    [3.0, 3.0]
    """

    K: np.ndarray = leaf("V/cm", "gain K of the state feedback", shape=(2, 4))
    b: np.ndarray = leaf(
        "cm",
        "size of error at which both controllers weigh half, per input",
        **POSITIVE,
        shape=(2,),
    )
    w: np.ndarray = leaf(
        "cm", "half width of the blend, per input; at most b", **POSITIVE, shape=(2,)
    )
    low: np.ndarray = leaf("V", "lower limit of the sliding-mode inputs", shape=(2,))
    high: np.ndarray = leaf("V", "upper limit of the sliding-mode inputs", shape=(2,))
    pairing: str = static(
        "-", "which error weights an input", choices=tuple(PAIRINGS), default="cross"
    )

    @pointwise
    def prepare(self, r: tuple, dr: tuple, ddr: tuple) -> Any:
        return steady_along(self.model, r)

    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence, Any]:
        h0, u0 = tick.plan
        if estimate.d:
            h0, u0 = steady_under(self.model, h0, u0, estimate.d)
        design = (self.model, self.surface, self.ks, self.phi, self.switch, self.form)
        sliding = slide(*design, estimate.x, tick.r, u0, state, estimate.d)
        far = [clip(u, self.low[i], self.high[i]) for i, u in enumerate(sliding)]
        near = feedback(self.K, estimate.x, h0, u0)
        share = self.shares(tuple(estimate.x), tuple(tick.r))
        return tuple(n + m * (f - n) for m, f, n in zip(share, far, near)), state

    def shares(self, x: tuple[Any, ...], r: tuple[Any, ...]) -> tuple[Any, ...]:
        """Return the share of sliding mode in each input [-], mu_H; the rest is state feedback."""
        size = [magnitude(h - target) for h, target in zip(x, r)]
        pairs = enumerate(PAIRINGS[self.pairing])
        return tuple(membership(size[j], self.b[i], self.w[i]) for i, j in pairs)

    def in_force(self) -> dict[str, Any]:
        return {"w": np.minimum(self.w, self.b)}

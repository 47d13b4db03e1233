"""The steady state of a closed loop: with its steady inflow, and the dead zones and lower limits
of its pumps (upper limits are not checked).
"""

import functools
from typing import Any

import numpy as np
from jax.core import Tracer

from jaxtank.analysis.steady_state import equilibrium


def steady_inflow(loop: Any) -> Any:
    """Steady inflow (n,) [cm^3/s] that no pump brings, of a table its mean; None without any:
    pulses end.
    """
    level: Any = None if loop.disturbance is None else loop.disturbance.steady()
    return level if level is not None and _lasts(level) else None


def _lasts(level: Any) -> bool:
    """Whether an inflow is not 0, or traced."""
    return isinstance(level, Tracer) or bool(np.any(np.asarray(level)))


def steady_state(loop: Any, y: Any, plant: Any = None) -> tuple[Any, Any]:
    """Return levels and inputs at which a loop stands still with outputs y."""
    low = loop.actuator.driving(tuple(np.asarray(loop.actuator.low, dtype=float)))
    # a controller that shares its output between inputs knows which of them runs
    controller = getattr(loop.controller, "law", loop.controller)
    shared, inflow = getattr(controller, "shared", None), steady_inflow(loop)
    if shared is not None and controller.reads_inflow and inflow is not None:
        shared = functools.partial(shared, inflow=tuple(np.asarray(inflow, dtype=float)))
    x, u = equilibrium(
        loop.plant if plant is None else plant, y, inflow, np.asarray(low, dtype=float), shared
    )
    return x, u + np.asarray(loop.actuator.offset)

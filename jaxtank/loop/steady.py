"""The steady state of a closed loop: with its steady inflow, and the dead zones and lower limits
of its pumps (upper limits are not checked).
"""

from typing import Any

import numpy as np
from jax.core import Tracer

from jaxtank.analysis.steady_state import equilibrium
from jaxtank.signals.base import Constant


def steady_inflow(loop: Any) -> Any:
    """Steady inflow (n,) [cm^3/s] that no pump brings; None without any: pulses end."""
    disturbance = loop.disturbance
    if not isinstance(disturbance, Constant):
        return None
    level: Any = disturbance.level
    unknown: bool = isinstance(disturbance.level, Tracer)
    return level if unknown or np.any(np.asarray(level)) else None


def steady_state(loop: Any, y: Any, plant: Any = None) -> tuple[Any, Any]:
    """Return levels and inputs at which a loop stands still with outputs y."""
    low = loop.actuator.driving(tuple(np.asarray(loop.actuator.low, dtype=float)))
    # a controller that shares its output between inputs knows which of them runs
    controller = getattr(loop.controller, "law", loop.controller)
    x, u = equilibrium(
        loop.plant if plant is None else plant,
        y,
        steady_inflow(loop),
        np.asarray(low, dtype=float),
        getattr(controller, "shared", None),
    )
    return x, u + np.asarray(loop.actuator.offset)

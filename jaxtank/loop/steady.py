"""The steady state of a closed loop: with its steady inflow, and the dead zones and lower limits
of its pumps (upper limits are not checked).
"""

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from jax.core import Tracer
from jax.tree_util import Partial

from jaxtank.analysis.steady_state import equilibrium


def steady_inflow(loop: Any) -> Any:
    """Steady inflow (n,) [cm^3/s] that no pump brings, of a table its mean; None without any:
    pulses end.
    """
    level: Any = None if loop.disturbance is None else loop.disturbance.steady()
    return level if level is not None and _lasts(level) else None


def start_inflow(loop: Any) -> Any:
    """Inflow (n,) [cm^3/s] at t = 0 that no pump brings; None without any."""
    level: Any = None if loop.disturbance is None else loop.disturbance.at_start()
    return level if level is not None and _lasts(level) else None


def _is_traced(level: Any) -> bool:
    return isinstance(level, Tracer)


def _lasts(level: Any) -> bool:
    """Whether an inflow is not 0, or traced."""
    return _is_traced(level) or bool(np.any(np.asarray(level)))


def sharing(loop: Any) -> Any:
    """The function (outputs,) -> (m,) inputs of a controller that shares its outputs between them,
    and so knows which of them runs; None of others.
    """
    controller: Any = getattr(loop.controller, "law", loop.controller)
    if not hasattr(controller, "shared"):
        return None
    inflow = steady_inflow(loop) if controller.reads_inflow else None
    numbers: Any = inflow if inflow is None or _is_traced(inflow) else np.asarray(inflow, float)
    measured: tuple[Any, ...] = () if numbers is None else tuple(numbers)
    # its numbers are arguments: one program for all of its kind
    cls = cast(Any, type(controller))
    return Partial(cls.shared, controller, inflow=measured)


def steady_state(
    loop: Any, y: Any, plant: Any = None, inflow: Callable[[Any], Any] = steady_inflow
) -> tuple[Any, Any]:
    """Return levels and inputs at which a loop stands still with outputs y and an inflow."""
    low = loop.actuator.driving(tuple(np.asarray(loop.actuator.low, dtype=float)))
    x, u = equilibrium(
        loop.plant if plant is None else plant,
        y,
        inflow(loop),
        np.asarray(low, dtype=float),
        sharing(loop),
    )
    return x, u + np.asarray(loop.actuator.offset)

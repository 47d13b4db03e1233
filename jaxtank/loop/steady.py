"""The steady state of a closed loop: steady inflow, dead zones and lower limits of its pumps."""

import dataclasses
from collections.abc import Callable
from typing import Any, cast

import numpy as np
from jax.core import Tracer
from jax.tree_util import Partial

from jaxtank.analysis.steady_state import circuit_at_rest, equilibrium
from jaxtank.controllers.pid import SharedPID
from jaxtank.signals.base import Constant, Sum
from jaxtank.signals.inflows import InflowTable


def steady_inflow(loop: Any) -> Any:
    """Steady inflow (n,) [cm^3/s] that no pump brings; None: pulses end."""
    # of a table its mean up to the last row; where the run is known, `at_mean_inflow` first
    return None if loop.disturbance is None else _unless_zero(loop.disturbance.steady())


def at_mean_inflow(loop: Any, clock: Any) -> Any:
    """Return the loop with the mean over its run in place of an inflow by a table."""
    if loop.disturbance is None:
        return loop
    return dataclasses.replace(loop, disturbance=_mean(loop.disturbance, clock.duration))


def _mean(inflow: Any, duration: float) -> Any:
    if isinstance(inflow, Sum):
        return Sum(first=_mean(inflow.first, duration), second=_mean(inflow.second, duration))
    if isinstance(inflow, InflowTable):
        return Constant(level=inflow.steady(duration))
    return inflow


def start_inflow(loop: Any) -> Any:
    """Inflow (n,) [cm^3/s] at t = 0 that no pump brings; None without any."""
    return None if loop.disturbance is None else _unless_zero(loop.disturbance.at_start())


def _unless_zero(level: Any) -> Any:
    """An inflow that is traced or not 0, else None."""
    lasts = level is not None and (_is_traced(level) or np.any(np.asarray(level)))
    return level if lasts else None


def _is_traced(level: Any) -> bool:
    return isinstance(level, Tracer)


def sharing(loop: Any) -> Any:
    """The function (outputs,) -> (m,) inputs of a controller that shares outputs between inputs."""
    controller: Any = getattr(loop.controller, "law", loop.controller)
    if not isinstance(controller, SharedPID):
        return None
    inflow = steady_inflow(loop) if controller.reads_inflow else None
    measured: tuple[Any, ...] = ()
    if inflow is not None:
        measured = tuple(inflow if _is_traced(inflow) else np.asarray(inflow, float))
    # its numbers are arguments: one program for all of its kind
    cls = cast(Any, type(controller))
    return Partial(cls.shared, controller, inflow=measured)


def steady_state(
    loop: Any, y: Any, plant: Any = None, inflow: Callable[[Any], Any] = steady_inflow
) -> tuple[Any, Any]:
    """Return levels and inputs at which a loop stands still with outputs y and an inflow."""
    low = loop.actuator.driving(tuple(np.asarray(loop.actuator.low, dtype=float)))
    plant = loop.plant if plant is None else plant
    x, u = equilibrium(plant, y, inflow(loop), np.asarray(low, dtype=float), sharing(loop))
    return x, u + np.asarray(loop.actuator.offset)


def circulating(
    loop: Any, plant: Any, y: Any, inflow: Callable[[Any], Any] = steady_inflow
) -> tuple[Any, Any] | None:
    """Levels and inputs at rest with outputs y of tanks that keep their volume, None without."""
    rest = circuit_at_rest(plant, y, loop.x0, loop.actuator.initial, inflow(loop))
    return None if rest is None else (rest[0], rest[1] + np.asarray(loop.actuator.offset))

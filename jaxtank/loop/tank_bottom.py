"""Tank bottom: rigs from which liquid can be withdrawn, and runs with a level below 0."""

from typing import Any, cast

import numpy as np

from jaxtank.core.labels import label_of
from jaxtank.core.tree import is_component, walk
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.loop.trajectory import Trajectory
from jaxtank.plants.tank_network import TankNetwork


class TankBottomWarning(UserWarning):
    """A level fell below 0. The command prints a note instead."""


def can_withdraw(loop: ClosedLoop) -> bool:
    """Return True if inflows, pumps, valves or shapes of tanks may take a level below 0."""
    if any(getattr(loop.plant, name, ()) for name in ("sources", "valves", "shapes")):
        return True
    actuator: Any = loop.actuator
    numbers = [getattr(actuator, name, 0.0) for name in ("low", "initial")]
    if is_component(loop.disturbance):
        numbers += [v for _, v, _ in walk(loop.disturbance)]
    return any(np.any(np.asarray(v, dtype=float) < 0.0) for v in numbers if v is not None)


def lower_bounds(plant: Any) -> Any:
    """Return (n,) levels [cm] that are below 0 by more than rounding."""
    rim = np.broadcast_to(np.asarray(plant.rim, dtype=float), (plant.tanks,))
    return -np.minimum(getattr(plant, "knee", np.inf), 1e-3 * np.where(np.isfinite(rim), rim, 1.0))


def is_open(loop: ClosedLoop) -> bool:
    """Return True if levels may fall below 0: a network without `bottom`, or a custom plant."""
    kind = cast(Any, type(loop.plant))  # a subclass may define other flows
    network = kind.derivative is cast(Any, TankNetwork).derivative
    return not loop.plant.bottom and (not network or can_withdraw(loop))


def tank_bottom_warnings(loop: ClosedLoop, run: Trajectory) -> list[str]:
    """Return a sentence for each tank whose level falls below 0: level, time and volume."""
    plant: Any = loop.plant
    x, length = np.asarray(run.x), loop.units[0]
    sentences: list[str] = []
    for i, limit in enumerate(lower_bounds(plant)):
        column = np.where(np.isfinite(x[:, i]), x[:, i], 0.0)
        if not column.min() < limit:
            continue
        area = np.ravel(np.asarray(getattr(plant, "area", np.nan), dtype=float))
        volume = -column.min() * (area[i] if area.size == plant.tanks else np.nan)
        amount = f", {volume:.4g} {length}^3 more than the tank held" if np.isfinite(volume) else ""
        remedy = "limit the outflow in the derivative of the plant"
        if isinstance(plant, TankNetwork):
            remedy = "plant.bottom = true stops it at 0"
        first, last = (run.t[np.argmax(v)] for v in (column < limit, -column))
        sentences.append(
            f"the level of {label_of(plant, 'tank', i)} falls below 0 at t = {first:g} s"
            f" and reaches {column.min():.4g} {length} at t = {last:g} s{amount}: {remedy}"
        )
    return sentences

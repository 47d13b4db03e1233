"""What editors see of keywords.py; test_keywords.py compares both."""

from collections.abc import Mapping, Sequence
from typing import Any, SupportsFloat, TypeAlias

import numpy as np

from jaxtank.case import Case
from jaxtank.controllers.base import Controller
from jaxtank.observers.base import Observer

Quantity: TypeAlias = SupportsFloat | str
Points: TypeAlias = Sequence[Sequence[Quantity]] | np.ndarray
Table: TypeAlias = Mapping[str, Any]

def Rig(
    *,
    tanks: Sequence[Table] | None = ...,
    pumps: Sequence[Table] | None = ...,
    valves: Sequence[Table] | None = ...,
    orifices: Sequence[Table] | None = ...,
    pipes: Sequence[Table] | None = ...,
    spills: Sequence[Table] | None = ...,
    controller: Table | Controller | None = ...,
    observer: Table | Observer | None = ...,
    reference: Table | Points | None = ...,
    inputs: Table | Points | None = ...,
    dt: Quantity | None = ...,
    duration: Quantity | None = ...,
    substeps: int | None = ...,
    integrator: str | None = ...,
    units: Sequence[str] | None = ...,
    begins: str | None = ...,
    limits: Table | None = ...,
    free: Table | None = ...,
    objective: Table | None = ...,
    sensors: Sequence[Table] | None = ...,
    plant: Table | None = ...,
    sensor: Table | None = ...,
    actuator: Table | None = ...,
    disturbance: Table | None = ...,
    inflows: Sequence[Table] | None = ...,
    faults: Sequence[Table] | None = ...,
    schedule: Table | None = ...,
    values: Table | None = ...,
    uncertain: Table | None = ...,
    covariance: Table | None = ...,
    safety_filter: Table | None = ...,
    scenarios: Sequence[Table] | None = ...,
    log: Table | None = ...,
    case: str | None = ...,
    name: str | None = ...,
    reachable: bool | None = ...,
) -> Case: ...
def Tank(
    name: str = ...,
    *,
    shape: str | Points | None = ...,
    area: Quantity | None = ...,
    diameter: Quantity | None = ...,
    length: Quantity | None = ...,
    height: Quantity | None = ...,
    volume: Quantity | None = ...,
    rim: Quantity | None = ...,
    drain: Quantity = ...,
    drain_port: Quantity = ...,
    drain_exponent: Quantity = ...,
    drain_linear: Quantity = ...,
    level: Quantity = ...,
    inflow: Quantity = ...,
    noise: Quantity = ...,
) -> dict[str, Any]: ...
def Orifice(
    *,
    from_: str | int,
    to: str | int,
    area: Quantity = ...,
    port: Quantity = ...,
    exponent: Quantity = ...,
    linear: Quantity = ...,
) -> dict[str, Any]: ...
def Pipe(
    *, between: Sequence[str | int], area: Quantity, port: Quantity = ...
) -> dict[str, Any]: ...
def Spill(
    *, from_: str | int, to: str | int, caught: Quantity = ..., port: Quantity | None = ...
) -> dict[str, Any]: ...
def Pump(
    name: str = ...,
    *,
    gain: Quantity | None = ...,
    curve: Points | None = ...,
    curve_head: Points | None = ...,
    from_: str | int | None = ...,
    to: str | int | Sequence[str | int] | None = ...,
    split: Quantity = ...,
    low: Quantity = ...,
    high: Quantity,
    initial: Quantity = ...,
    dead_zone: Quantity = ...,
    rate: Quantity = ...,
    lag: Quantity = ...,
    delay: Quantity = ...,
) -> dict[str, Any]: ...
def Valve(
    name: str = ...,
    *,
    from_: str | int,
    to: str | int | None = ...,
    area: Quantity,
    characteristic: str | Points = ...,
    rangeability: Quantity = ...,
    port: Quantity = ...,
    check: bool = ...,
    low: Quantity = ...,
    high: Quantity | None = ...,
    initial: Quantity = ...,
    dead_zone: Quantity = ...,
    rate: Quantity = ...,
    lag: Quantity = ...,
    delay: Quantity = ...,
) -> dict[str, Any]: ...

"""From the command of a pump to its flow: dead zone, curve, lag and delay, to estimate."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import lfilter

from jaxtank.core.tree import split_index


class Inputs(NamedTuple):
    """Dead zone, curve, lag and delay that are applied to an input outside the compiled program."""

    delay: float = 0.0  # [s]
    lag: float = 0.0  # time constant [s]
    dead: float = 0.0  # input below which nothing flows
    exponent: float = 1.0  # of the flow in the input, at the same largest flow
    bend: float = 0.0  # of the flow from the power: 1 + bend (1 - x) + twist (1 - x)^2,
    twist: float = 0.0  # x the input as a share of the largest
    threshold: float = 0.0  # input at or below which nothing flows, and above it all

    def curve(self, x: Any) -> Any:
        """Return the flow at inputs x, both as shares of the largest."""
        shape = 1.0 + (1.0 - x) * (self.bend + (1.0 - x) * self.twist)
        return np.maximum(x, 1e-12) ** self.exponent * shape


STATIC = ("actuator.delays", "plant.curves")  # names of such numbers that no leaf of a rig holds
CURVE = ("exponent", "bend", "twist")  # `plant.curves[j]`, `[j,1]`, `[j,2]`
POINTS = 12  # points of the curve that stands for an exponent in a rig file


def with_inputs(loop: Any, values: Mapping[str, float], top: np.ndarray) -> Any:
    """Return a loop with dead times and curves {name: value}; top (pumps,): the largest inputs."""
    bank, plant = loop.actuator, loop.plant
    delays = float(bank.delay) + np.zeros(bank.pumps) + np.asarray(bank.delays or 0.0)
    curves = list(plant.curves) if values and getattr(plant, "curves", ()) else [None] * bank.pumps
    shapes: dict[int, Inputs] = {}
    for name, value in values.items():
        base, (j, *more) = split_index(name)
        if base == "actuator.delays":
            delays[j] = max(value, 0.0)
        else:
            shapes[j] = shapes.get(j, Inputs())._replace(**{CURVE[more[0] if more else 0]: value})
    for j, shape in shapes.items():
        u = top[j] * np.linspace(0.0, 1.0, POINTS) ** 2
        flow = np.maximum.accumulate(np.where(u > 0.0, top[j] * shape.curve(u / top[j]), 0.0))
        # of two that are level, the first
        rises = np.flatnonzero(np.diff(flow, prepend=-1.0) > 0.0)
        points = ((float(f"{v:.7g}") for v in column[rises]) for column in (u, flow))
        curves[j] = tuple(zip(*points))
    least = float(delays.min())
    more = tuple((delays - least).tolist())
    bank = dataclasses.replace(bank, delay=least, delays=more if any(more) else ())
    if any(curves):
        plant = dataclasses.replace(plant, curves=tuple(curves[: len(plant.feeds)]))
    return dataclasses.replace(loop, actuator=bank, plant=plant)


def transformed(dt: np.ndarray, u: np.ndarray, by: Inputs, top: float) -> np.ndarray:
    """Return means over pieces (pieces,) of an input behind dead zone, curve, lag and delay."""
    if by.threshold > 0.0:
        u = np.where(u > by.threshold, u, 0.0)
    if by.dead > 0.0:
        u = np.maximum(u - by.dead, 0.0)
    if (by.exponent, by.bend, by.twist) != (1.0, 0.0, 0.0) and top > 0.0:
        u = np.where(u > 0.0, top * by.curve(u / top), u)
    if by.lag > 0.0:
        u = _lagged(dt, u, by.lag)
    if by.delay != 0.0:
        edges = np.concatenate([[0.0], np.cumsum(dt)])
        volume, at = np.concatenate([[0.0], np.cumsum(u * dt)]), edges - by.delay
        outside = np.minimum(at, 0.0) * u[0] + np.maximum(at - edges[-1], 0.0) * u[-1]
        through = np.interp(at, edges, volume) + outside
        u = np.where(dt > 0.0, np.diff(through) / np.where(dt > 0.0, dt, 1.0), u)
    return u


def _lagged(dt, u, lag):
    """Return the means over the pieces of an input behind a first-order lag [s], solved exactly."""
    keep, regular = np.exp(-dt / lag), dt[dt > 0.0]
    if np.ptp(regular) < 1e-9 * regular[0]:
        end: Any = lfilter([1 - keep[0]], [1.0, -keep[0]], u, zi=[keep[0] * u[0]])[0]
    else:
        end, v = np.empty_like(u), u[0]
        for k, (share, target) in enumerate(zip(keep, u)):
            end[k] = v = target + share * (v - target)
    start = np.concatenate([u[:1], end[:-1]])
    mean = lag / np.where(dt > 0.0, dt, 1.0) * (1.0 - keep) * (start - u)
    return np.where(dt > 0.0, u + mean, u)


def played(data: Any, inputs: tuple, values: Any) -> np.ndarray:
    """Return inputs of PaddedData behind `values` (inputs,) of (field, pump, value in the data)."""
    if not inputs:
        return data.u
    logs, u = data.u.shape[0], np.array(data.u)
    dt, flat = data.dt.reshape(logs, -1), u.reshape(logs, -1, u.shape[-1])
    for j in dict.fromkeys(pump for _, pump, _ in inputs):
        of_pump = [(field, v, null) for (field, pump, null), v in zip(inputs, values) if pump == j]
        by = Inputs(**{field: v - null * (field == "delay") for field, v, null in of_pump})
        top = float(flat[:, :, j].max())
        for e in range(logs):
            flat[e, :, j] = transformed(dt[e], flat[e, :, j], by, top)
    return u

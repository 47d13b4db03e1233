"""Missing parts of a rig, added one at a time by cross-validation."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxtank.core.tree import get_value, number, with_values
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.plants.tank_network import TankNetwork
from jaxtank.rig.sensors import longer
from tuning.identification.least_squares import solve
from tuning.identification.problem import Estimation
from tuning.identification.residuals import at_samples, is_white

FOLDS = 4  # blocks of the data, each predicted by a fit to the others
CROSS_VALIDATION_RATIO = 0.95  # of mean squares, below which a part is added [-]
MOST_POINTS = 8  # most points of a curve of a sensor
SUBSTEPS = 8  # most Runge-Kutta steps per sample while parts are compared
READINGS = 20  # fewest readings per point


class Part(NamedTuple):
    """What may be added to a rig: what is free in it, and the loop with it, without effect."""

    kind: str  # "sensor-curve", "outlet-exponent", "outlet-linear", "area"
    where: int  # tank, counted from 0
    free: dict[str, tuple[float, float, str]]
    attach: Callable[[Any], Any]


class Refinement(NamedTuple):
    """A part that was added: RMS of predicted blocks, in the noise, without it and with it."""

    kind: str
    where: int  # tank, counted from 0
    before: float
    after: float


def parts_of(estimation: Estimation) -> list[Part]:
    """Return the Parts that the rig of an estimation could have."""
    loop, taken = estimation.case.loop, {b.name for b in estimation.bounds}
    read = zip(np.moveaxis(estimation.data.y, -1, 0), estimation.data.channels)
    curves = (_sensor_curve(loop.sensor, y, *channel) for y, channel in read)
    parts = [part for part in curves if part is not None]
    plant: Any = loop.plant
    if type(plant) is not TankNetwork:
        return parts
    read = {tank for tank, _ in estimation.data.channels}
    for tank in sorted({*range(plant.tanks)} - read):
        area, name = float(np.asarray(plant.area)[tank]), f"plant.area[{tank}]"
        parts.append(Part("area", tank, {name: (area / 5, area * 5, "log")}, lambda loop: loop))
    for kind, sources in (("drain", range(plant.tanks)), ("orifice", [a for a, _ in plant.links])):
        areas = np.asarray(getattr(plant, kind))
        for k, tank in ((k, tank) for k, tank in enumerate(sources) if areas[k] > 0):
            parts += _outlet(plant, f"plant.{kind}", k, tank, float(areas[k]))
    return [part for part in parts if not part.free.keys() & taken]


def _outlet(plant, kind, k, tank, area):
    """Return the Parts of an open outlet: a free exponent, and a linear outlet beside it."""
    # flows are alike at half the height where area sqrt(2 g / head) = 1 / resistance
    usual = (0.5 * float(np.asarray(plant.rim)[tank])) ** 0.5
    usual /= area * (2.0 * float(plant.gravity)) ** 0.5
    name, other = f"{kind}_exponent", f"{kind}_resistance[{k}]"
    every = np.full(np.shape(get_value(plant, kind.removeprefix("plant."))), 0.5)

    def with_exponents(loop):
        absent = getattr(loop.plant, name.removeprefix("plant.")) is None
        return with_values(loop, {name: every}) if absent else loop

    linear = lambda loop: with_values(loop, {other: 1e3 * usual})
    return [
        Part("outlet-exponent", tank, {f"{name}[{k}]": (0.1, 1.5, "linear")}, with_exponents),
        Part("outlet-linear", tank, {other: (0.1 * usual, 1e4 * usual, "log")}, linear),
    ]


def _sensor_curve(sensor, y, tank, volts):
    """Return the Part of a sensor whose readings are a curve of the level; None of too few."""
    present = np.isfinite(y)
    count = min(MOST_POINTS, int(present.sum()) // READINGS)
    if not isinstance(sensor, LevelSensor) or sensor.curve_level is not None or count < 3:
        return None
    readings = np.asarray(sensor.level_of(tank, y[present], volts))
    points = np.linspace(readings.min(), readings.max(), count)
    # a piece without readings goes with the one above; the last point stays
    points = points[np.append(np.histogram(readings, points)[0] >= READINGS // 4, True)]
    if len(points) < 3 or points[-1] <= 0:
        return None
    # the last point holds the scale of the levels, which outlets and pumps could else take up
    names = [f"sensor.curve_level[{tank},{k}]" for k in range(len(points) - 1)]
    ends = (-float(points[-1]), float(points[-1]), "linear")

    def with_curve(loop):
        sensor, every = loop.sensor, np.tile(points, (loop.plant.tanks, 1))
        if sensor.curve_level is not None:  # of another tank: as many points for all
            rows = np.array(sensor.curve_level), np.array(sensor.curve_reading)
            most = max(every.shape[1], rows[0].shape[1])
            every, *rows = (longer(v, most) for v in (every, *rows))
            levels, readings = rows
            levels[tank] = readings[tank] = every[tank]
        else:
            levels = readings = every
        curve = {"curve_level": number(levels), "curve_reading": number(readings)}
        return dataclasses.replace(loop, sensor=dataclasses.replace(sensor, **curve))

    return Part("sensor-curve", tank, dict.fromkeys(names, ends), with_curve)


class _Search:
    """The rig with every Part, those that are not added yet held without effect: one program."""

    def __init__(self, result, settings):
        self.result, self.settings, before = result, settings, result.estimation
        self.parts, self.added = parts_of(before), []
        self.loop = with_values(result.case.loop, before.coordinates.values(result.fit.p))
        loop, free = self.loop, {b.name: (b.low, b.high, b.scale) for b in before.bounds}
        for part in self.parts:
            loop, free = part.attach(loop), free | part.free
        case = result.case.replace(loop=loop, covariance=None)
        first, substeps = "free" if before.tanks else "case", min(before.substeps, SUBSTEPS)
        self.problem = Estimation(case, before.logs, free, first, before.noise, substeps)
        self.problem.initial = before.first_levels(before.unknowns(result.fit))
        self.start = self.problem.nominal()
        names = self.problem.coordinates.names
        self.places = [[names.index(name) for name in part.free] for part in self.parts]

    def free(self, chosen):
        """Return the free unknowns where the Parts `chosen` are added."""
        absent = {i for k, places in enumerate(self.places) if k not in chosen for i in places}
        return np.array([i for i in range(self.problem.size) if i not in absent])

    def fit(self, chosen, start):
        """Return (Fit with the Parts `chosen`, its squares of predicted blocks)."""
        absent = {*range(self.problem.size)} - set(self.free(chosen).tolist())
        fixed = {i: float(self.start[i]) for i in absent}
        fit = solve(self.problem, start, fixed=fixed, tolerance=1e-6, **self.settings)
        return fit, self.predicted(fit, chosen)

    def predicted(self, fit, chosen):
        """Return (FOLDS,) squares of each block after a Gauss-Newton step to the others."""
        # the ridge keeps what the others do not determine: as if known to within 1, levels included
        free = self.free(chosen)
        J = fit.jacobian[:, free[free < self.problem.coordinates.size]]
        r, squares = fit.residual, np.zeros(FOLDS)
        ridge = np.sqrt(np.mean(r**2)) * np.eye(J.shape[1])
        fold = np.nonzero(self.problem.mask)[1] * FOLDS // self.problem.mask.shape[1]
        for f in range(FOLDS):
            block = fold == f
            rows = np.concatenate([J[~block], ridge])
            change = np.concatenate([-r[~block], np.zeros(len(ridge))])
            step = np.linalg.lstsq(rows, change)[0]
            squares[f] = np.sum((r[block] + J[block] @ step) ** 2)
        return squares


def refined(result: Any, settings: Mapping[str, Any]) -> tuple[Any, dict, list[Refinement]]:
    """Return (case, free, Refinements) with the Parts that predict left-out blocks better."""
    free = {b.name: (b.low, b.high, b.scale) for b in result.estimation.bounds}
    residuals = at_samples(result.estimation, result.fit.residual)
    if all(map(is_white, np.moveaxis(residuals, -1, 0))):
        return result.case, free, []
    search = _Search(result, settings)
    chosen, added = [], []
    fit, best = search.fit(chosen, search.start)
    root = lambda squares: float(np.sqrt(squares.sum() / search.problem.mask.sum()))
    while len(chosen) < len(search.parts):
        others = [k for k in range(len(search.parts)) if k not in chosen]
        start = search.problem.unknowns(fit)
        trials = [(search.fit([*chosen, k], start), k) for k in others]
        (trial, after), k = min(trials, key=lambda t: t[0][1].sum())
        less = after.sum() < CROSS_VALIDATION_RATIO * best.sum()
        if not less or (after < best).sum() <= FOLDS / 2:
            break
        part = search.parts[k]
        added.append(Refinement(part.kind, part.where, root(best), root(after)))
        chosen, fit, best = [*chosen, k], trial, after
    loop, values = search.loop, search.problem.coordinates.values(fit.p)
    for k in chosen:
        loop, free = search.parts[k].attach(loop), free | search.parts[k].free
    loop = with_values(loop, {name: float(values[name]) for name in free})
    return result.case.replace(loop=loop), free, added

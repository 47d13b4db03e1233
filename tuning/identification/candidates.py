"""What a rig may lack: Candidates for its structure, and an Estimation with all of them."""

import copy
import dataclasses
from typing import Any, NamedTuple

import numpy as np

from jaxtank.core.tree import get_value, split_index, with_values
from jaxtank.plants.tank_network import TankNetwork
from jaxtank.signals.base import Constant
from tuning.identification import simulation
from tuning.identification.coordinates import Coordinates, Scalar
from tuning.identification.problem import Estimation
from tuning.identification.simulation import CURVE, played

STEP = 1e-6  # change of an unknown, in its coordinate, by which slopes are computed
FIELD = {
    "actuator.delays": "delay",
    "actuator.lag": "lag",
    "actuator.dead_zone": "dead",
    "actuator.threshold": "threshold",
    "plant.curves": "exponent",
}
"""{name: field of Inputs} of what changes an input before it reaches its pump. A dead zone is
subtracted from larger inputs; above a threshold the input is unchanged.
"""


class Candidate(NamedTuple):
    """A possible error of the structure: kind, place, name, present value, range of the search."""

    kind: str
    where: int
    name: str
    null: float
    low: float
    high: float

    @property
    def field(self) -> str:
        """Field of Inputs that its value is, "" of another."""
        base, index = split_index(self.name)
        return CURVE[index[1]] if len(index) > 1 and base in FIELD else FIELD.get(base, "")


def candidates_of(estimation: Estimation) -> list[Candidate]:
    """Return the Candidates of an Estimation: what is not among its unknowns already."""
    loop, data = estimation.case.loop, estimation.data
    sensor, tanks, rows = estimation.rig.sensor, range(loop.plant.tanks), []
    value = lambda name, usual: _value(estimation.rig, name, usual)
    for c, (tank, volts) in enumerate(data.channels):
        most = float(np.nanmax(np.abs(data.y[..., c])))
        most *= float(sensor.gain[tank]) if volts else 1.0
        for kind, leaf, usual, low, high in (
            ("sensor-offset", "offset", 0.0, -most, most),
            ("sensor-scale", "scale", 1.0, 0.4, 2.5),
        ):
            name = f"sensor.{leaf}[{tank}]"
            rows.append(Candidate(kind, tank, name, value(name, usual), low, high))
    if loop.disturbance is None or isinstance(loop.disturbance, Constant):
        flow = _largest_flow(loop.plant, data)
        for i in tanks:
            name = f"disturbance.level[{i}]"
            rows.append(Candidate("inflow", i, name, value(name, 0.0), -flow, flow))
    if isinstance(loop.plant, TankNetwork):
        rows += _of_network(loop.plant)
    known = set(estimation.coordinates.names)
    return [c for c in (*rows, *_of_inputs(loop, data)) if c.name not in known]


def _value(rig, name, usual):
    part, leaf = name.split("[")[0].split(".")
    absent = getattr(getattr(rig, part), leaf, None) is None
    return usual if absent else float(np.asarray(get_value(rig, name)))


def _of_inputs(loop, data):
    """Yield the Candidates of what may be between a command and its flow."""
    bank, u = loop.actuator, data.u.reshape(-1, data.u.shape[-1])
    longest = 0.1 * float(data.steps.sum(axis=1).max())
    for j in range(len(getattr(loop.plant, "feeds", ()))):
        levels = np.unique(u[:, j])
        top = float(levels.max())
        if levels.size < 2:
            continue
        present = float(np.broadcast_to(simulation.delays_of(bank), bank.pumps)[j])
        yield Candidate("pump-delay", j, f"actuator.delays[{j}]", present, 0.0, present + longest)
        if bank.lag is None:
            yield Candidate("pump-lag", j, f"actuator.lag[{j}]", 0.0, 0.0, longest)
        if bank.dead_zone is None and top > 0.0:
            for name in ("dead_zone", "threshold"):
                yield Candidate("dead-zone", j, f"actuator.{name}[{j}]", 0.0, 0.0, 0.9 * top)
        if not (loop.plant.curves and loop.plant.curves[j]) and top > 0.0:
            ranges = ("", 1.0, 0.25, 4.0), (",1", 0.0, -1.0, 3.0), (",2", 0.0, -3.0, 3.0)
            for more, *values in ranges[: levels.size - 1]:
                yield Candidate("pump-curve", j, f"plant.curves[{j}{more}]", *values)


def _largest_flow(plant, data):
    """Return a flow [cm^3/s] that no inflow exceeds."""
    gains = np.asarray(getattr(plant, "pump_gain", ()))
    u = np.abs(data.u.reshape(-1, data.u.shape[-1])).max(axis=0)[: gains.size]
    if np.any(u):
        return 2.0 * float(gains @ u)
    return float(np.max(np.asarray(getattr(plant, "area", 1.0)) * np.asarray(plant.rim))) / 60.0


def _of_network(plant):
    """Return the Candidates leak, area, outlet-exponent and rangeability of a TankNetwork."""
    area, drain = np.asarray(plant.area).tolist(), np.asarray(plant.drain).tolist()
    largest = max(float(np.max(v, initial=0.0)) for v in (drain, plant.orifice, plant.pipe))
    rows = [
        Candidate("leak", i, f"plant.drain[{i}]", v, 0.0, v + 10 * (largest or 1.0))
        for i, v in enumerate(drain)
    ]
    rows += [Candidate("area", i, f"plant.area[{i}]", v, v / 4, v * 4) for i, v in enumerate(area)]
    for opening, tanks in _outlets(plant).items():
        exponents = getattr(plant, f"{opening}_exponent")
        rows += [
            Candidate("outlet-exponent", tank, f"plant.{opening}_exponent[{k}]",
                      0.5 if exponents is None else float(exponents[k]), 0.15, 1.5)
            for k, tank in enumerate(tanks) if float(getattr(plant, opening)[k]) > 0.0
        ]  # fmt: skip
    for k, kind in enumerate(plant.characteristics):
        if kind == "equal-percentage":
            name, v = f"plant.rangeability[{k}]", float(plant.rangeability[k])
            place = len(plant.feeds) + k  # among the inputs
            rows.append(Candidate("rangeability", place, name, v, 1.0 + (v - 1.0) / 4, v * 4))
    return rows


def _outlets(plant):
    """Return {opening: tank that each leaves}."""
    return {"drain": list(range(plant.tanks)), "orifice": [a for a, _ in plant.links]}


def with_exponents(plant: TankNetwork) -> TankNetwork:
    """Return a plant whose outlets have exponents, 0.5 where there was none."""
    sizes = {f"{opening}_exponent": len(tanks) for opening, tanks in _outlets(plant).items()}
    absent = [name for name, size in sizes.items() if size and getattr(plant, name) is None]
    return dataclasses.replace(plant, **{name: np.full(sizes[name], 0.5) for name in absent})


class AugmentedEstimation(Estimation):
    """A fitted Estimation with an unknown for each Candidate; slopes by finite differences."""

    # Sensors and inputs act outside the compiled program; an absent exponent to first order only,
    # unless `exponents` recompiles the plant with it.

    def __init__(self, estimation: Estimation, z: np.ndarray, loss: str, exponents: bool = False):
        vars(self).update(vars(estimation))
        self.loss, self.prior = loss, None
        self.original, self.candidates = estimation, candidates_of(estimation)
        rig, limits = estimation.rig, estimation.case.loop.actuator
        u = np.clip(estimation.data.u, np.asarray(limits.low), np.asarray(limits.high))
        self.data = estimation.data._replace(u=u)
        wide = np.full(rig.actuator.pumps, np.inf)
        plant: Any = rig.plant
        plant = with_exponents(plant) if exponents else plant
        bank: Any = rig.actuator
        actuator = dataclasses.replace(bank, low=-wide, high=wide)
        self.rig = dataclasses.replace(rig, plant=plant, actuator=actuator)
        names = [f"sensor.{leaf}" for leaf in ("offset", "scale")]
        self.sensor = with_leaves(estimation.case.loop, names).sensor
        known, candidates = estimation.coordinates, self.candidates
        items = [Scalar(c.name, c.low, c.high, "linear") for c in candidates]
        of_plant = [c.name.startswith("plant.") and not c.field for c in candidates]
        present = lambda c: (
            getattr(plant, split_index(c.name)[0].removeprefix("plant.")) is not None
        )
        leaves = [i for i in np.flatnonzero(of_plant) if present(candidates[i])]
        self.coordinates = Coordinates((*known.items, *items))
        size = known.leaves.size
        self.inside = Coordinates((*known.leaves.items, *(items[i] for i in leaves)))
        self.inside_at = [*range(size), *(known.size + i for i in leaves)]
        self.fields = dict(zip(known.names[size:], known.inputs))
        self.fields |= {c.name: (c.field, c.where, c.null) for c in candidates if c.field}
        self.known, self.swapped = known.size, ("", ())
        self.usual = np.delete(np.arange(self.size), known.size + np.arange(len(candidates)))
        self.columns = self.usual
        self.lanes = len(self.columns) + 4
        shares = [(c.null - c.low) / (c.high - c.low) for c in candidates]
        self.begin = np.insert(z, known.size, shares)
        self.by_exponent: dict[str, np.ndarray] = {}
        if len(leaves) < sum(of_plant):
            self.by_exponent = _by_exponent(self.rig_at(z), self._levels(self.begin[None])[0])

    def rig_at(self, z):
        return self.original.rig_at(z)

    def exchanged(self, a: int, b: int, z: np.ndarray) -> "AugmentedEstimation":
        """Return the same with the readings of channels a and b exchanged, to begin at z."""
        order = list(range(len(self.data.channels)))
        order[a], order[b] = b, a
        tanks = [self.data.channels[a][0], self.data.channels[b][0]]
        estimation = copy.copy(self.original)
        estimation.moments = None  # of the readings in their order
        estimation.data = self.original.data._replace(y=self.data.y[..., order])
        estimation.mask, estimation.noise = self.mask[..., order], self.noise[order]
        estimation.initial = self.initial.copy()
        estimation.initial[:, tanks] = self.initial[:, tanks[::-1]]
        return self._exchanged(estimation, z, ("swapped", tuple(tanks)))

    def exchanged_inputs(self, a: int, b: int, z: np.ndarray) -> "AugmentedEstimation":
        """Return the same with the inputs of pumps a and b exchanged, to begin at z."""
        u = self.original.data.u.copy()
        u[..., [a, b]] = u[..., [b, a]]
        estimation = copy.copy(self.original)
        estimation.moments = None
        estimation.data = self.original.data._replace(u=u)
        return self._exchanged(estimation, z, ("swapped-inputs", (a, b)))

    def _exchanged(self, estimation, z, swapped):
        other = AugmentedEstimation(estimation, z, self.loss)
        other.swapped = swapped
        return other

    def _levels(self, points):
        """Return (points, logs, samples, tanks) levels at points (points, unknowns)."""
        parts = []
        for begin in range(0, len(points), self.lanes):
            # the last is filled up: one compiled program
            rows = points[np.arange(begin, begin + self.lanes).clip(max=len(points) - 1)]
            values = [self.coordinates.values(z[: self.coordinates.size]) for z in rows]
            u, flows = (np.stack(list(map(of, values))) for of in (self._inputs, self._flows))
            first = np.stack([self.first_levels(z) for z in rows])
            run = (self.rig, self.data.dt, u, flows, rows[:, self.inside_at], first)
            static = {"coordinates": self.inside, "substeps": self.substeps}
            parts.append(np.asarray(simulation.variants(*run, **static))[: len(points) - begin])
        return np.concatenate(parts)

    def _inputs(self, values):
        changed = {n: way for n, way in self.fields.items() if values[n] != way[-1]}
        return played(self.data, tuple(changed.values()), [values[n] for n in changed])

    def _flows(self, values):
        flows = np.zeros((*self.data.u.shape[:2], self.rig.plant.tanks))
        for c in self.candidates:
            change = values[c.name] - c.null
            if c.kind == "inflow":
                flows[..., c.where] += change
            elif change != 0.0 and c.name in self.by_exponent:
                flows += change * self.by_exponent[c.name]
        return flows

    def simulated(self, points: np.ndarray) -> np.ndarray:
        """Return (points, rows) weighted readings at points (points, unknowns)."""
        rows = []
        for z, h in zip(points, self._levels(points)):
            values = self.coordinates.values(z[: self.coordinates.size])
            head = "sensor."
            values = {n.removeprefix(head): v for n, v in values.items() if n.startswith(head)}
            sensor = with_values(self.sensor, values)
            y = [sensor.reading_of(i, h[..., i], volts) for i, volts in self.data.channels]
            rows.append((np.stack(y, axis=-1) / self.noise)[self.mask])
        return self.whitened(np.stack(rows, axis=-1)).T

    def residual_and_jacobian(self, z):
        """Return (residual (rows,), Jacobian (rows, unknowns)), 0 beside `columns`."""
        self.evaluations += 1
        lanes = np.arange(len(self.columns))
        points = np.tile(z, (1 + len(lanes), 1))
        points[1 + lanes, self.columns] += STEP
        y = self.simulated(points)
        residual = y[0] - self.whitened((self.data.y / self.noise)[self.mask] + self.shift)
        jacobian = np.zeros((y.shape[1], self.size))
        jacobian[:, self.columns] = (y[1:] - y[0]).T / STEP
        if not np.all(np.isfinite(jacobian)):
            return np.full_like(residual, np.nan), np.zeros_like(jacobian)
        return residual, jacobian


def _by_exponent(rig, levels):
    """Return {name: (logs, samples, tanks) flow by an outlet's exponent, to first order}."""
    plant, flows = rig.plant, {}
    h = np.maximum(levels, 1e-9)
    h = np.concatenate([0.5 * (h[:, 1:] + h[:, :-1]), h[:, -1:]], axis=1)
    for opening, tanks in _outlets(plant).items():
        for k, tank in enumerate(tanks):
            size = float(getattr(plant, opening)[k] * np.sqrt(2.0 * plant.gravity))
            flow, change = size * np.sqrt(h[..., tank]) * np.log(h[..., tank]), np.zeros(h.shape)
            change[..., tank] -= flow
            if opening == "orifice":
                change[..., plant.links[k][1]] += flow
            flows[f"plant.{opening}_exponent[{k}]"] = change
    return flows


def with_leaves(loop: Any, names: list[str]) -> Any:
    """Return a loop that has the leaves of these values, as it was without them."""
    n, bases = loop.plant.tanks, {name.split("[")[0] for name in names}
    absent = lambda base: base in bases and _value(loop, f"{base}[0]", None) is None
    if absent("disturbance.level"):
        loop = dataclasses.replace(loop, disturbance=Constant(level=np.zeros(n)))
    if any("exponent" in base for base in bases):
        loop = simulation.with_plant(loop, with_exponents(loop.plant))
    sensor = {leaf: np.full(n, usual) for leaf, usual in (("offset", 0.0), ("scale", 1.0))
              if absent(f"sensor.{leaf}")}  # fmt: skip
    bank: dict[str, Any] = {leaf: np.zeros(loop.actuator.pumps) for leaf in ("lag", "dead_zone")
                            if absent(f"actuator.{leaf}")}  # fmt: skip
    bank |= {"dead_zone_kind": "offset"} if "dead_zone" in bank else {}
    parts = {"sensor": sensor, "actuator": bank}
    changed = {n: dataclasses.replace(getattr(loop, n), **leaves) for n, leaves in parts.items()}
    return dataclasses.replace(loop, **changed)

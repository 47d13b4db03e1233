"""Is the structure of a fitted rig right? Score tests of what a rig may have that its file does not
say, fits of what passes them, and what the data cannot tell apart.
"""

import copy
import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2

from jaxtank.bounds import Bound
from jaxtank.core.errors import InputError, unknown
from jaxtank.core.tree import describe, get_value, split_index, with_values
from jaxtank.plants.tank_network import TankNetwork
from jaxtank.signals.base import Constant
from tuning.identification import simulation
from tuning.identification.coordinates import Coordinates, Scalar
from tuning.identification.inputs import CURVE, Inputs, played
from tuning.identification.least_squares import Fit
from tuning.identification.problem import Estimation
from tuning.identification.residuals import ROBUST_LIMIT, autocorrelation, residuals_of

ALPHA = 0.02
"""Probability that a log of a right structure is accused, over all candidates."""
ALIKE = 6.0
"""Difference of two fits in BIC below which the data do not tell them apart."""
CAUSES = 3
"""Most causes that are named."""
TRIED = 10
"""Most candidates that are fitted at once."""
ITERATIONS = 15
ENOUGH = 0.01
"""Reduction of the sum of squares, in its mean, below which a fit has converged."""
STRIDE = 5
"""Every which of the inputs that occur is tried first as a threshold."""
STEP = 1e-6
"""Change of an unknown, in its coordinate, by which slopes are computed."""
BAD_FIT = 3.0
"""RMS of a residual, in the noise of its channel, from which exchanged columns are tried."""
BETTER = 0.5
"""Share of the sum of squares that an exchange of columns must come below."""
FIELD = {
    "actuator.delays": "delay",
    "actuator.lag": "lag",
    "actuator.dead_zone": "dead",
    "actuator.threshold": "threshold",
    "plant.curves": "exponent",
}
"""{name: field of Inputs} of what changes an input before it reaches its pump; a dead zone takes
its width from the input above it, a threshold nothing."""


class Candidate(NamedTuple):
    """What may be wrong with the structure: kind and place, the name of its value, its value in the
    rig as it is, and the range in which it is sought.
    """

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
    """Return the value of a leaf, `usual` where the rig has none."""
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
        most = present + longest
        yield Candidate("pump-delay", j, f"actuator.delays[{j}]", present, 0.0, most)
        if bank.lag is None:
            yield Candidate("pump-lag", j, f"actuator.lag[{j}]", 0.0, 0.0, longest)
        if bank.dead_zone is None and top > 0.0:
            for name in ("dead_zone", "threshold"):
                yield Candidate("dead-zone", j, f"actuator.{name}[{j}]", 0.0, 0.0, 0.9 * top)
        if not (loop.plant.curves and loop.plant.curves[j]) and top > 0.0:
            yield Candidate("pump-curve", j, f"plant.curves[{j}]", 1.0, 0.25, 4.0)
            if levels.size > 2:
                yield Candidate("pump-curve", j, f"plant.curves[{j},1]", 0.0, -1.0, 3.0)
            if levels.size > 3:
                yield Candidate("pump-curve", j, f"plant.curves[{j},2]", 0.0, -3.0, 3.0)


def _largest_flow(plant, data):
    """Return a flow [cm^3/s] that no inflow exceeds."""
    gains = np.asarray(getattr(plant, "pump_gain", ()))
    u = np.abs(data.u.reshape(-1, data.u.shape[-1])).max(axis=0)[: gains.size]
    if np.any(u):
        return 2.0 * float(gains @ u)
    return float(np.max(np.asarray(getattr(plant, "area", 1.0)) * np.asarray(plant.rim))) / 60.0


def _of_network(plant):
    """Return the Candidates leak, area and outlet-exponent of a TankNetwork."""
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
    return rows


def _outlets(plant):
    """Return {opening: tank that each leaves}."""
    return {"drain": list(range(plant.tanks)), "orifice": [a for a, _ in plant.links]}


def with_exponents(plant: TankNetwork) -> TankNetwork:
    """Return a plant whose outlets have exponents, 0.5 where there was none."""
    return dataclasses.replace(
        plant,
        **{
            f"{opening}_exponent": np.full(len(tanks), 0.5)
            for opening, tanks in _outlets(plant).items()
            if tanks and getattr(plant, f"{opening}_exponent") is None
        },
    )


class Enlarged(Estimation):
    """A fitted Estimation with an unknown more for each Candidate; slopes by differences, of one
    program without derivatives.
    """

    # In the program are the plant's own leaves. Sensors act on its levels, and dead zone, curve,
    # lag and delay on its inputs, outside of it; an exponent that the plant has not acts as the
    # flow that it adds to first order, unless `exponents`, which takes another program.

    def __init__(self, estimation: Estimation, z: np.ndarray, loss: str, exponents: bool = False):
        vars(self).update(vars(estimation))
        self.loss = loss
        self.original, self.candidates = estimation, candidates_of(estimation)
        rig, bank, wide = estimation.rig, estimation.case.loop.actuator, np.inf
        u = np.clip(estimation.data.u, np.asarray(bank.low), np.asarray(bank.high))
        self.data = estimation.data._replace(u=u)
        wide = np.full(rig.actuator.pumps, np.inf)
        plant: Any = rig.plant
        plant = with_exponents(plant) if exponents else plant
        own: Any = rig.actuator
        actuator = dataclasses.replace(own, low=-wide, high=wide)
        self.rig = dataclasses.replace(rig, plant=plant, actuator=actuator)
        names = [f"sensor.{leaf}" for leaf in ("offset", "scale")]
        self.sensor = with_leaves(estimation.case.loop, names).sensor
        known, more = estimation.coordinates, self.candidates
        items = [Scalar(c.name, c.low, c.high, "linear") for c in more]
        leaves = [i for i, c in enumerate(more) if _is_leaf(plant, c)]
        self.coordinates = Coordinates((*known.items, *items))
        own = known.leaves
        self.inside = Coordinates((*own.items, *(items[i] for i in leaves)))
        self.inside_at = [*range(own.size), *(known.size + i for i in leaves)]
        self.fields = dict(zip(known.names[own.size :], known.inputs))
        self.fields |= {c.name: (c.field, c.where, c.null) for c in more if c.field}
        self.known, self.swapped = known.size, ()
        self.usual = np.delete(np.arange(self.size), known.size + np.arange(len(more)))
        self.columns = self.usual
        self.lanes = len(self.columns) + 4
        shares = [(c.null - c.low) / (c.high - c.low) for c in more]
        self.begin = np.insert(z, known.size, shares)
        self.by_exponent: dict[str, np.ndarray] = {}
        if len(leaves) < sum(c.name.startswith("plant.") and not c.field for c in more):
            self.by_exponent = _by_exponent(self.rig_at(z), self._levels(self.begin[None])[0])

    def rig_at(self, z):
        """Return the Rig at the unknowns z, its candidates as they are."""
        return self.original.rig_at(z)

    def exchanged(self, a: int, b: int, z: np.ndarray) -> "Enlarged":
        """Return the same with the readings of channels a and b exchanged, to begin at z."""
        order = list(range(len(self.data.channels)))
        order[a], order[b] = b, a
        tanks = [self.data.channels[a][0], self.data.channels[b][0]]
        estimation = copy.copy(self.original)
        estimation.data = self.original.data._replace(y=self.data.y[..., order])
        estimation.mask, estimation.noise = self.mask[..., order], self.noise[order]
        estimation.initial = self.initial.copy()
        estimation.initial[:, tanks] = self.initial[:, tanks[::-1]]
        other = Enlarged(estimation, z, self.loss)
        other.swapped = tuple(tanks)
        return other

    def _levels(self, points):
        """Return (points, logs, samples, tanks) levels at points (points, unknowns)."""
        parts = []
        for begin in range(0, len(points), self.lanes):
            # the last is filled up: one compiled program
            rows = points[np.arange(begin, begin + self.lanes).clip(max=len(points) - 1)]
            values = [self.coordinates.values(z[: self.coordinates.size]) for z in rows]
            levels = simulation.variants(
                self.rig,
                self.data.dt,
                np.stack([self._inputs(v) for v in values]),
                np.stack([self._flows(v) for v in values]),
                rows[:, self.inside_at],
                np.stack([self.first_levels(z) for z in rows]),
                coordinates=self.inside,
                substeps=self.substeps,
            )
            parts.append(np.asarray(levels)[: len(points) - begin])
        return np.concatenate(parts)

    def _inputs(self, values):
        moved = {n: way for n, way in self.fields.items() if values[n] != way[-1]}
        return played(self.data, tuple(moved.values()), [values[n] for n in moved])

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
            values = {name: v for name, v in values.items() if name.startswith("sensor.")}
            sensor = with_values(
                self.sensor, {n.removeprefix("sensor."): v for n, v in values.items()}
            )
            y = [sensor.reading_of(i, h[..., i], volts) for i, volts in self.data.channels]
            rows.append((np.stack(y, axis=-1) / self.noise)[self.mask])
        return np.stack(rows)

    def residual_and_jacobian(self, z):
        """Return (residual (rows,), Jacobian (rows, unknowns)), 0 beside `columns`."""
        self.evaluations += 1
        lanes = np.arange(len(self.columns))
        points = np.tile(z, (1 + len(lanes), 1))
        points[1 + lanes, self.columns] += STEP
        y = self.simulated(points)
        residual, jacobian = (
            y[0] - (self.data.y / self.noise)[self.mask],
            np.zeros((y.shape[1], self.size)),
        )
        jacobian[:, self.columns] = (y[1:] - y[0]).T / STEP
        if not np.all(np.isfinite(jacobian)):
            return np.full_like(residual, np.nan), np.zeros_like(jacobian)
        return residual, jacobian


def _is_leaf(plant, candidate):
    """Whether the value of a Candidate is a leaf of the plant."""
    part, _, leaf = candidate.name.split("[")[0].partition(".")
    of_plant = part == "plant" and not candidate.field
    return of_plant and getattr(plant, leaf) is not None


def _by_exponent(rig, levels):
    """Return {name: (logs, samples, tanks) flow that the exponent of an outlet adds to first order}
    at levels (logs, samples, tanks).
    """
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


class Trial(NamedTuple):
    """A fit with some Candidates as further unknowns."""

    problem: Enlarged
    chosen: tuple[int, ...]
    point: np.ndarray  # (unknowns,)
    residual: np.ndarray  # (rows,) weighted
    jacobian: np.ndarray  # (rows, unknowns)
    loss: float  # weighted sum of squares, or twice the cost of a robust loss [-]
    effective: float  # readings that are independent of each other, by their autocorrelation [-]

    def better(self, other):
        """Return 2 log of the likelihood ratio to another Trial."""
        return self.effective * float(np.log(other.loss / self.loss))


class Cause(NamedTuple):
    """What the structure lacks: kind, place from 1, its value, and what it cannot be told from."""

    kind: str
    where: Any
    name: str
    unit: str
    value: float | None
    interval95: list[float] | None
    delta_bic: float
    equivalent: Sequence[tuple[str, Any]]


class Diagnosis(NamedTuple):
    """Whether the structure of a rig is right."""

    clean: bool
    causes: list[Cause]
    white: bool  # whether what the causes leave is noise


def diagnose(estimation: Estimation, fit: Fit) -> Diagnosis:
    """Return the Diagnosis of a fit."""
    weighted, causes = copy.copy(estimation), []
    weighted.noise = _fast_noise(estimation, fit)
    problem = Enlarged(weighted, estimation.unknowns(fit), loss=fit.loss)
    # a prior stays outside: what it holds back is no structure
    trial = _trial(problem, (), problem.begin) if estimation.prior is None else _fit(problem, ())
    while len(causes) <= CAUSES:
        options = _fitted(trial) + ([] if causes else _exchanged(trial))
        best = min(options, key=lambda t: t.loss, default=None)
        if best is None or not _passes(best, trial):
            break
        cause = _cause(best, trial, options)
        same = [i for i, c in enumerate(causes) if (c.kind, c.where) == (cause.kind, cause.where)]
        if same:  # another coefficient of it
            bic = causes[same[0]].delta_bic + cause.delta_bic
            causes[same[0]] = causes[same[0]]._replace(delta_bic=bic)
        elif len(causes) == CAUSES:
            break
        else:
            causes.append(cause)
        trial = best
    causes = [_with_value(cause, trial) for cause in causes]
    white = _is_white(trial)
    return Diagnosis(not causes and white, causes, white)


KINDS = (
    *("pump-delay", "pump-lag", "dead-zone", "pump-curve", "sensor-offset", "sensor-scale"),
    *("leak", "outlet-exponent", "inflow", "area", "swapped"),
)


def place_of(text: str) -> tuple[str, tuple]:
    """Return (kind, place from 1 or ()) of a text such as "pump-delay" or "swapped:1,2"."""
    kind, _, place = str(text).partition(":")
    numbers = place.split(",") if place else []
    if kind not in KINDS:
        raise unknown("cause to accept", kind, KINDS)
    if not all(number.isascii() and number.isdigit() for number in numbers):
        raise InputError(
            f"accept {text!r}: the place must be the number of a pump or tank, from 1, as {kind}:1;"
            " swapped takes two tanks, swapped:1,2"
        )
    return kind, tuple(map(int, numbers))


class Accepted(NamedTuple):
    """A structure that was accepted: what to identify again, and from where."""

    case: Any
    logs: list
    free: dict[str, tuple]
    inputs: list[tuple[Bound, tuple]]
    begin: dict[str, float]


def accepted(estimation: Estimation, fit: Fit, places: list[tuple[str, tuple]]) -> Accepted:
    """Return what `places`, (kind, place from 1 or ()) each, make of an identification."""
    weighted, logs = copy.copy(estimation), list(estimation.logs)
    weighted.noise = _fast_noise(estimation, fit)
    problem = Enlarged(weighted, estimation.unknowns(fit), fit.loss)
    trial = _trial(problem, (), problem.begin)
    # an exchange is fitted without the other causes, so it comes first
    for kind, where in sorted(places, key=lambda place: place[0] != "swapped"):
        if kind == "swapped":
            trial = _best_exchange(trial, where)
            logs = [_exchanged_log(log, trial.problem.swapped) for log in logs]
        else:
            trial = _best_of_kind(trial, kind, where)
    chosen = [trial.problem.candidates[i] for i in trial.chosen]
    of = trial.problem.coordinates
    values = of.values(trial.point[: of.size])
    known = {*estimation.coordinates.names, *(c.name for c in chosen)}
    loop = with_leaves(estimation.case.loop, [c.name for c in chosen])
    inputs = [c for c in chosen if c.field not in ("", "threshold")]
    leaves = {c.name: (c.low, c.high, "linear") for c in chosen if not c.field}
    loop = _with_thresholds(loop, chosen, values)
    bound = lambda c: Bound(c.name, c.low, c.high, "linear", _unit(loop, c))
    return Accepted(
        case=estimation.case.replace(loop=loop, log=_columns(estimation, logs)),
        logs=logs,
        free={b.name: (b.low, b.high, b.scale) for b in estimation.bounds} | leaves,
        inputs=[(bound(c), (c.field, c.where, c.null)) for c in inputs],
        begin={n: float(v) for n, v in values.items() if n in known},
    )


def _with_thresholds(loop, chosen, values):
    """Return a loop with the thresholds among the chosen Candidates, which no search estimates."""
    rows = [c for c in chosen if c.field == "threshold"]
    if not rows:
        return loop
    dead_zone = np.zeros(loop.actuator.pumps)
    for c in rows:
        dead_zone[c.where] = values[c.name]
    actuator = dataclasses.replace(loop.actuator, dead_zone=dead_zone, dead_zone_kind="plain")
    return dataclasses.replace(loop, actuator=actuator)


def _best_of_kind(trial, kind, where):
    """Return the Trial with a Candidate of a kind at a place from 1, or at the best one."""
    candidates = trial.problem.candidates
    options = [i for i, c in enumerate(candidates) if c.kind == kind]
    chosen = [i for i in options if where in ((), (candidates[i].where + 1,))]
    if not chosen:
        places = ", ".join(f"{kind}:{candidates[i].where + 1}" for i in options)
        raise InputError(
            f"accept {':'.join([kind, *map(str, where)])}: "
            + (f"must be one of {places}" if places else "is estimated already, or no part has it")
        )
    best = min((_with(trial, i) for i in chosen), key=lambda t: t.loss)
    return _with_all(best) if kind == "pump-curve" else best


def _with_all(trial):
    """Return the Trial with all coefficients of its last cause that the data ask for."""
    candidates = trial.problem.candidates
    place = candidates[trial.chosen[-1]][:2]
    while True:
        rest = [i for i, c in enumerate(candidates) if c[:2] == place and i not in trial.chosen]
        more = min((_with(trial, i) for i in rest), key=lambda t: t.loss, default=trial)
        if not _passes(more, trial):
            return trial
        trial = more


def with_leaves(loop: Any, names: list[str]) -> Any:
    """Return a loop that has the leaves of these values, as it was without them."""
    n, bases = loop.plant.tanks, {name.split("[")[0] for name in names}
    absent = lambda base: base in bases and _value(loop, f"{base}[0]", None) is None
    if absent("disturbance.level"):
        loop = dataclasses.replace(loop, disturbance=Constant(level=np.zeros(n)))
    if any("exponent" in base for base in bases):
        loop = dataclasses.replace(loop, plant=with_exponents(loop.plant))
    sensor = {leaf: np.full(n, usual) for leaf, usual in (("offset", 0.0), ("scale", 1.0))
              if absent(f"sensor.{leaf}")}  # fmt: skip
    bank: dict[str, Any] = {leaf: np.zeros(loop.actuator.pumps) for leaf in ("lag", "dead_zone")
                            if absent(f"actuator.{leaf}")}  # fmt: skip
    bank |= {"dead_zone_kind": "offset"} if "dead_zone" in bank else {}
    return dataclasses.replace(
        loop,
        sensor=dataclasses.replace(loop.sensor, **sensor),
        actuator=dataclasses.replace(loop.actuator, **bank),
    )


def _unit(loop, candidate):
    """Return the unit of the value of a Candidate."""
    if candidate.kind == "pump-delay":
        return "s"
    if candidate.field == "threshold":
        return loop.units[1]
    return "-" if candidate.kind == "pump-curve" else describe(loop, candidate.name)["unit"]


def _best_exchange(trial, where):
    """Return the Trial with two channels exchanged: those of tanks `where`, or the best pair."""
    options = [t for t in _exchanged(trial, always=True)
               if sorted(where) in ([], sorted(i + 1 for i in t.problem.swapped))]  # fmt: skip
    if not options:
        raise InputError("--accept swapped: needs two levels that are measured in the same unit")
    return min(options, key=lambda t: t.loss)


def _columns(estimation, logs):
    """Return the [log] table of a case with the headers of the columns that were exchanged."""
    columns = dict(estimation.case.log)
    for old, log in zip(estimation.logs, logs):
        moved = log.headers is not None and log.tanks != old.tanks
        for header, a, b in zip((log.headers or ())[1 + log.u.shape[1] :], old.tanks, log.tanks):
            if moved and a != b:
                columns[f"h{b + 1}"] = header
    return columns


def _exchanged_log(log, tanks):
    """Return a Log whose readings of two tanks are each the other's."""
    other = dict(zip(tanks, tanks[::-1]))
    return dataclasses.replace(log, tanks=tuple(other.get(i, i) for i in log.tanks))


def _fast_noise(estimation, fit):
    """Return (channels,) noise of the residuals from sample to sample, which a slow misfit does not
    reach.
    """
    steps = np.diff(residuals_of(estimation, fit), axis=1) / np.sqrt(2.0)
    noise = np.sqrt(np.nanmean(steps**2, axis=(0, 1)))
    return np.where(np.isfinite(noise), np.maximum(noise, 0.1 * estimation.noise), estimation.noise)


def _trial(problem, chosen, point):
    """Return the Trial at a point, with the slopes of all unknowns."""
    problem.columns = np.arange(problem.size)
    residual, jacobian = problem.residual_and_jacobian(point)
    loss = _loss(problem.loss, residual)[0]
    return Trial(problem, chosen, point, residual, jacobian, loss, _effective(problem, residual))


def _loss(kind, residual):
    """Return (twice the cost, weights of the residuals) of a loss."""
    size = np.abs(residual)
    if kind == "huber":
        outside = size > ROBUST_LIMIT
        rho = np.where(outside, ROBUST_LIMIT * (2 * size - ROBUST_LIMIT), size**2)
        return float(rho.sum()), np.where(outside, ROBUST_LIMIT / np.maximum(size, 1e-300), 1.0)
    if kind == "soft_l1":
        root = np.sqrt(1 + (size / ROBUST_LIMIT) ** 2)
        return float(2 * ROBUST_LIMIT**2 * np.sum(root - 1)), 1 / root
    return float(residual @ residual), np.ones_like(residual)


def _fit(problem, chosen, start=None):
    """Return the Trial of a bounded Levenberg-Marquardt search over the Candidates `chosen` and the
    unknowns of the Estimation.
    """
    z = problem.begin if start is None else start
    problem.columns = columns = np.sort([*problem.usual, *(problem.known + i for i in chosen)])
    low, high = (side[columns] for side in problem.box)
    residual, jacobian = problem.residual_and_jacobian(z)
    (cost, weights), damping = _loss(problem.loss, residual), 1e-4
    for _ in range(ITERATIONS):
        J = jacobian[:, columns]
        slope, H = J.T @ (weights * residual), (J.T * weights) @ J
        inside = ~((z[columns] <= low) & (slope > 0) | (z[columns] >= high) & (slope < 0))
        scale = inside / np.sqrt(np.maximum(np.diag(H), 1e-300))  # 0 of what stays at its bound
        H = H * np.outer(scale, scale) + (damping + 1e-12) * np.eye(len(scale))
        step = -scale * np.linalg.solve(H, scale * slope)
        after = z.copy()
        after[columns] = np.clip(z[columns] + step, low, high)
        moved = problem.residual_and_jacobian(after)
        new, new_weights = _loss(problem.loss, moved[0])
        gain, damping = cost - new, damping / 10 if new < cost else damping * 30
        if gain > 0.0:
            z, (residual, jacobian), cost, weights = after, moved, new, new_weights
        if abs(gain) < ENOUGH * cost / len(residual) or damping > 1e6:
            break
    return _trial(problem, chosen, z)


def _by_channel(problem, residual):
    """Yield residuals (logs, samples) of each channel."""
    full = np.full(problem.mask.shape, np.nan)
    full[problem.mask] = residual
    yield from np.moveaxis(full, -1, 0)


def _effective(problem, residual):
    """Return how many independent readings are worth the residuals, by their autocorrelation."""
    total = 0.0
    for r in _by_channel(problem, residual):
        n = int(np.isfinite(r).sum())
        rho = float(autocorrelation(r, 1)[1]) if n > 3 else 0.0
        rho = rho if rho > 3.0 / np.sqrt(max(n, 1)) else 0.0
        total += n * (1.0 - min(rho, 0.999)) / (1.0 + rho)
    return max(total, 4.0)


def _is_white(trial):
    """Whether residuals are noise: nearly all readings count."""
    return bool(trial.effective > 0.5 * trial.problem.mask.sum())


def _scores(trial):
    """Return (candidates,) by how much a step of each reduces the sum of squares."""
    problem, J, r = trial.problem, trial.jacobian, trial.residual
    extra = np.delete(np.arange(problem.size), problem.usual)
    inside = [*problem.usual, *extra[list(trial.chosen)]]
    basis, _ = np.linalg.qr(J[:, inside])
    columns = J[:, extra]
    left = columns - basis @ (basis.T @ columns)
    left -= basis @ (basis.T @ left)
    r = r - basis @ (basis.T @ r)
    size, whole = np.sum(left**2, axis=0), np.sum(columns**2, axis=0)
    apart = size > 1e-9 * np.maximum(whole, 1e-300)
    steps = np.where(apart, -(left.T @ r) / np.where(apart, size, 1.0), 0.0)
    share = trial.point[extra]
    outside = (share < 1e-9) & (steps < 0.0) | (share > 1 - 1e-9) & (steps > 0.0)
    steps[outside | np.isin(np.arange(len(extra)), trial.chosen)] = 0.0
    gains = steps**2 * size
    for i, c in enumerate(problem.candidates):
        if c.field == "threshold" and i not in trial.chosen:
            gains[i] = _best_threshold(trial, i, _thresholds(problem, c)[::STRIDE], basis)[0]
    return gains


def _thresholds(problem, candidate):
    """Return inputs between those that occur, below the range of a Candidate's top."""
    levels = np.unique(problem.data.u[..., candidate.where])
    between = 0.5 * (levels[1:] + levels[:-1])
    return between[(between > candidate.low) & (between < candidate.high)]


def _best_threshold(trial, i, options, basis=None):
    """Return (reduction of the sum of squares to first order, value) of the best threshold."""
    problem, c = trial.problem, trial.problem.candidates[i]
    if not len(options):
        return 0.0, c.null
    if basis is None:
        inside = [*problem.usual, *(problem.known + k for k in trial.chosen)]
        basis, _ = np.linalg.qr(trial.jacobian[:, inside])
    points = np.tile(trial.point, (1 + len(options), 1))
    points[1:, problem.known + i] = (options - c.low) / (c.high - c.low)
    y = problem.simulated(points)
    rows = trial.residual + (y - y[0])
    left = np.sum(rows**2, axis=1) - np.sum((rows @ basis) ** 2, axis=1)
    best = int(np.argmin(left[1:]))
    return max(float(left[0] - left[1 + best]), 0.0), float(options[best])


def _limit(problem):
    """Return the largest score of all candidates that noise makes."""
    return chi2.isf(ALPHA / max(len(problem.candidates), 1), 1)


def _passes(trial, before):
    """Whether a Trial is better than one with a cause less by more than noise makes."""
    return trial.better(before) > _limit(trial.problem)


def _fitted(trial):
    """Return Trials with a Candidate more each, those that the scores promise most of."""
    gains = _scores(trial)
    variance = trial.loss / max(len(trial.residual) - trial.problem.size, 1)
    promising = [i for i in np.argsort(-gains) if gains[i] > variance * _limit(trial.problem)]
    return [_with(trial, int(i)) for i in promising[:TRIED]]


def _with(trial, i):
    """Return the Trial with Candidate i beside those that it has."""
    problem, start = trial.problem, trial.point
    if problem.candidates[i].name in problem.by_exponent:
        problem = Enlarged(problem.original, start[problem.usual], problem.loss, exponents=True)
    if problem.candidates[i].field == "threshold":
        return _with_threshold(trial, i)
    return _fit(problem, (*trial.chosen, i), start)


def _with_threshold(trial, i):
    """Return the Trial with the best threshold: between the inputs about the best of a few."""
    problem, c, at = trial.problem, trial.problem.candidates[i], trial.problem.known + i
    options, chosen = _thresholds(problem, c), (*trial.chosen, i)
    value = _best_threshold(trial, i, options[::STRIDE])[1]
    for _ in range(3):
        near = np.argmin(np.abs(options - value))
        value = _best_threshold(trial, i, options[max(near - STRIDE, 0) : near + STRIDE + 1])[1]
        start = trial.point.copy()
        start[at] = (value - c.low) / (c.high - c.low)
        if trial.chosen == chosen and np.isclose(trial.point[at], start[at]):
            break
        trial = _fit(problem, chosen, start)
    return trial


def _exchanged(trial, always=False):
    """Return Trials with two channels of a bad fit exchanged; `always`: of any."""
    problem, trials = trial.problem, []
    rms = [float(np.sqrt(np.nanmean(r**2))) for r in _by_channel(problem, trial.residual)]
    channels = problem.data.channels
    for a, b in itertools.combinations(range(len(channels)), 2):
        bad = always or max(rms[a], rms[b]) >= BAD_FIT
        if not bad or channels[a][1] != channels[b][1]:
            continue
        other = problem.exchanged(a, b, trial.point[problem.usual])
        nominal = other.begin.copy()
        nominal[other.usual] = other.original.nominal()
        best = min((_fit(other, (), z) for z in (nominal, other.begin)), key=lambda t: t.loss)
        trials += [best] * (always or best.loss < BETTER * trial.loss)
    return trials


def _place(trial):
    """Return (kind, place from 1) of the last cause of a Trial."""
    if not trial.chosen:
        return "swapped", [i + 1 for i in trial.problem.swapped]
    c = trial.problem.candidates[trial.chosen[-1]]
    return c.kind, c.where + 1


def _cause(best, before, options):
    """Return the Cause of the best Trial, without its value."""
    kind, where = _place(best)
    alike = [t for t in options if t is not best and best.better(t) < ALIKE]
    alike = sorted(alike, key=lambda t: t.loss)
    equivalent = list(dict.fromkeys(_key(t) for t in alike))
    equivalent = [place for place in equivalent if place != _key(best)]
    name, unit = "", ""
    if best.chosen:
        c = best.problem.candidates[best.chosen[-1]]
        name, unit = c.name, _unit(with_leaves(best.problem.case.loop, [c.name]), c)
    bic = best.better(before) - float(np.log(best.effective)) * bool(best.chosen)
    return Cause(kind, where, name, unit, None, None, bic, equivalent)


def _key(trial):
    kind, where = _place(trial)
    return kind, tuple(where) if isinstance(where, list) else where


def _with_value(cause, trial):
    """Return a Cause with its value and interval, from the Trial with all causes."""
    problem = trial.problem
    names = [c.name for c in problem.candidates]
    if cause.name not in names:
        return cause
    i = names.index(cause.name)
    inside = np.sort([*problem.usual, *(problem.known + k for k in trial.chosen)])
    J, r = trial.jacobian[:, inside], trial.residual
    scale = np.linalg.norm(J, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    covariance = np.linalg.pinv((J / scale).T @ (J / scale)) / np.outer(scale, scale)
    covariance *= float(r @ r) / max(len(r) - len(inside), 1) * len(r) / trial.effective
    at = list(inside).index(problem.known + i)
    c = problem.candidates[i]
    value = c.low + trial.point[problem.known + i] * (c.high - c.low)
    if c.kind == "pump-curve":
        return _with_exponent(cause, trial, covariance, list(inside))
    if c.field == "threshold":
        levels = np.unique(problem.data.u[..., c.where])
        ends = [float(levels[levels < value].max()), float(levels[levels > value].min())]
        return cause._replace(value=float(value), interval95=ends)
    half = 1.96 * float(np.sqrt(covariance[at, at])) * (c.high - c.low)
    return cause._replace(value=float(value), interval95=[float(value - half), float(value + half)])


def _with_exponent(cause, trial, covariance, inside):
    """Return a Cause with the exponent that gives the flow of its curve at half the input."""
    problem, chosen = trial.problem, [trial.problem.candidates[i] for i in trial.chosen]
    rows = [c for c in chosen if c.kind == cause.kind and c.where + 1 == cause.where]
    names = [c.name for c in problem.candidates]
    at = [problem.known + names.index(c.name) for c in rows]
    ranges = np.array([c.high - c.low for c in rows])
    values = np.array([c.low for c in rows]) + trial.point[at] * ranges
    exponent = lambda v: -float(np.log2(Inputs(**{c.field: x for c, x in zip(rows, v)}).curve(0.5)))
    value, steps = exponent(values), 1e-6 * np.eye(len(rows))
    slopes = np.array([exponent(values + step) - value for step in steps]) / 1e-6 * ranges
    entries = [inside.index(i) for i in at]
    sd = float(np.sqrt(slopes @ covariance[np.ix_(entries, entries)] @ slopes))
    return cause._replace(value=value, interval95=[value - 1.96 * sd, value + 1.96 * sd])

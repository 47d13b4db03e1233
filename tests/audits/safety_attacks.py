"""Search for a plant, a start and readings that take a level past a limit of the safety filter.

    python tests/audits/safety_attacks.py 0 3000        random rig files 0 to 2999: counts
    python tests/audits/safety_attacks.py 0 200 --lines a line for each rig as well
    python tests/audits/safety_attacks.py 0 200 --low   each with low limits, pumps mostly off
    python tests/audits/safety_attacks.py 0 200 --any-start  also from any level below the limits

Rig files are drawn over all that a file can describe (`rig_files`). Plants at random corners of the
box, some changing in time; readings off by the whole band; lags, dead zones and noise at the ends
of their tolerances; pumps full, off, switching or following setpoints; simulated by a code of its
own, in numpy: of jaxtank it runs the filter's `apply` alone. Exit code 1 where a certified level
passes its limit.
"""

import collections
import contextlib
import dataclasses
import math
import sys
import warnings
from typing import Any, NamedTuple

import jax
import numpy as np
import rig_files
from scipy.stats import chi2

from jaxtank import rig
from jaxtank.core import numerics
from jaxtank.core.errors import InputError
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.safety.box import widths_of
from jaxtank.xla.barrier import materialised

NAMES = ("drain", "orifice", "pipe", "pump_gain", "split")
SIGMAS = 6.0
"""Standard deviations of noise by which a reading may be off."""


# --------------------------------------------------------------------------- the plants


class Shape(NamedTuple):
    """What all plants of a rig share; tanks counted from 0."""

    n: int
    links: tuple = ()
    pipes: tuple = ()
    feeds: tuple = ()
    spills: tuple = ()
    knee: float = 0.01
    overflow: bool = False
    step: float | None = None  # [s], over which no tank gives more than it holds (`bottom`)


class Flows(NamedTuple):
    """Coefficients of P plants: rates (P, n) = own q + piped s + gain u."""

    own: np.ndarray  # (P, n, n) per root of a level
    piped: np.ndarray  # (P, n, pipes) per root of a difference of levels
    gain: np.ndarray  # (P, n, m)
    area: np.ndarray  # (P, n)
    rim: np.ndarray
    caught: np.ndarray  # (P, spills)
    supply: np.ndarray | None  # (P, n) largest root for a level, with `bottom`


def flows(shape, p):
    """Flows of plants with parameters p {name: (P, entries)}."""
    count, n = len(p["area"]), shape.n
    w = np.sqrt(2.0 * p["gravity"])
    out = -w * p["drain"]
    own, piped = np.zeros((count, n, n)), np.zeros((count, n, len(shape.pipes)))
    outlets = np.array(p["drain"])
    for k, (i, j) in enumerate(shape.links):
        out[:, i] -= w[:, 0] * p["orifice"][:, k]
        own[:, j, i] += w[:, 0] * p["orifice"][:, k]
        outlets[:, i] += p["orifice"][:, k]
    own[:, range(n), range(n)] += out
    for k, (i, j) in enumerate(shape.pipes):
        piped[:, i, k], piped[:, j, k] = -w[:, 0] * p["pipe"][:, k], w[:, 0] * p["pipe"][:, k]
        outlets[:, [i, j]] += p["pipe"][:, k : k + 1]
    gain = np.zeros((count, n, len(shape.feeds)))
    for k, (i, j) in enumerate(shape.feeds):
        share = 1.0 if j is None else p["split"][:, k]
        gain[:, i, k] += share * p["pump_gain"][:, k]
        if j is not None:
            gain[:, j, k] += (1.0 - share) * p["pump_gain"][:, k]
    area = p["area"][:, :, None]
    supply = None if shape.step is None else p["area"] / (shape.step * w * outlets + 1e-12)
    return Flows(own / area, piped / area, gain / area, p["area"], p["rim"], p["caught"], supply)


def root(h, knee):
    h = np.maximum(h, 0.0)
    x = np.minimum(h / knee, 1.0)
    return np.sqrt(np.maximum(h, knee)) - math.sqrt(knee) * (1.0 - x * (1.5 - 0.5 * x))


def rates(shape, f, x, brought):
    """Rates (P, n) [cm/s] of levels x (P, n); brought: by pumps and from outside [cm/s]."""
    q = root(x, shape.knee)
    q = q if f.supply is None else np.minimum(q, np.maximum(x, 0.0) * f.supply)
    rate = brought + (f.own @ q[:, :, None])[:, :, 0]
    if shape.pipes:
        one, other = zip(*shape.pipes)
        h = np.maximum(x, 0.0)
        z = h[:, one] - h[:, other]
        s = z / np.sqrt(np.sqrt(z * z + shape.knee**2))
        if f.supply is not None:
            most = h * f.supply
            s = np.clip(s, -most[:, other], most[:, one])
        rate = rate + (f.piped @ s[:, :, None])[:, :, 0]
    return _over_rims(shape, f, x, rate) if shape.overflow else rate


def _over_rims(shape, f, x, rate):
    """Rates where full tanks rise no further and what they spill falls into others."""
    full = x >= f.rim - 1e-12
    if not full.any():
        return rate
    total = rate
    for _ in range(shape.n if shape.spills else 0):
        over = np.where(full, np.maximum(total, 0.0), 0.0) * f.area
        total = rate.copy()
        for k, (i, j) in enumerate(shape.spills):
            total[:, j] += f.caught[:, k] * over[:, i] / f.area[:, j]
    return np.where(full, np.minimum(total, 0.0), total)


def rk4(rate, x, h):
    a = rate(x)
    b = rate(x + 0.5 * h * a)
    c = rate(x + 0.5 * h * b)
    return x + h / 6.0 * (a + 2 * b + 2 * c + rate(x + h * c))


def step(shape, f, x, brought, h):
    """(levels, highest levels meanwhile) (P, n) [cm] after a Runge-Kutta step of h [s]."""
    x = np.maximum(rk4(lambda x: rates(shape, f, x, brought), x, h), 0.0)
    if not shape.overflow:
        return x, x
    highest = x
    for _ in range(shape.n):
        over = np.maximum(x - f.rim, 0.0) * f.area
        if not over.any():
            break
        x = np.minimum(x, f.rim)
        for k, (i, j) in enumerate(shape.spills):
            x[:, j] += f.caught[:, k] * over[:, i] / f.area[:, j]
    return np.minimum(x, f.rim), highest


# --------------------------------------------------------------------------- the pumps


class Pumps:
    """Limits, dead zones, lags and dead time of the pumps of P plants, and their memory."""

    def __init__(self, p, kind, delay, hold, substeps):
        """p : {name: (P, m)}; delay : samples; kind : of the dead zone, "" for none."""
        self.p, self.kind, self.hold, self.h = p, kind, hold, hold / substeps
        start = p["initial"]
        self.running, self.owed = np.ones(start.shape, bool), np.zeros(start.shape)
        self.lagged = np.maximum(start, p["dead_zone"]) if kind == "offset" else start
        self.line = collections.deque([self.lagged] * (delay * substeps))
        self.lags = bool(np.any(p["lag"] > 0.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            self.keep = np.where(p["lag"] > 0.0, np.exp(-self.h / p["lag"]), 0.0)
        self.mean = p["lag"] / self.h * (1.0 - self.keep)

    def hold_input(self, u):
        """Behind limits and dead zone, once a sample [V]."""
        p, u = self.p, np.clip(u, self.p["low"], self.p["high"])
        if self.kind == "plain":
            return np.where(u > p["dead_zone"], u, 0.0)
        if self.kind == "offset":
            return np.maximum(u, p["dead_zone"])
        if self.kind == "hysteresis":
            self.running = np.where(self.running, u >= p["stop"], u > p["dead_zone"])
            return np.where(self.running, u, 0.0)
        if self.kind == "pulse":
            turning, due = u > p["dead_zone"], u + self.owed / self.hold
            paid = np.where(turning, u, np.where(due >= p["pulse"], p["pulse"], 0.0))
            self.owed = np.where(turning, self.owed, (due - paid) * self.hold)
            return paid
        return u

    def arriving(self, u):
        """What moves liquid at the tanks over the next sub-step [V]."""
        if self.lags:
            short = self.lagged - u
            self.lagged, u = u + self.keep * short, u + self.mean * short
        if self.line:
            self.line.append(u)
            u = self.line.popleft()
        return np.maximum(u - self.p["dead_zone"], 0.0) if self.kind == "offset" else u


# --------------------------------------------------------------------------- the filter


def _scan(body, carry, parts):
    for k in range(len(parts[0])):
        carry, _ = body(carry, tuple(part[k] for part in parts))
    return carry, None


class _Jax:
    """Stands for `jax` in the filter's modules while they compute in numpy."""

    class lax:
        scan = staticmethod(_scan)


def _clip(x, low, high):
    return np.where(x < low, low, np.where(x > high, high, x))


def _materialised(value):
    """The same with numpy's numbers in place of Python's, which raise for 0/0."""
    if isinstance(value, tuple | list):
        return type(value)(_materialised(v) for v in value)
    return np.float64(value) if isinstance(value, float) else value


IN_NUMPY = {
    id(jax): _Jax,
    id(jax.numpy): np,
    id(materialised): _materialised,
    id(numerics.smooth_sqrt): lambda h, knee: root(h, knee) + np.minimum(h, 0.0) * 1.5 * knee**-0.5,
    id(numerics.smooth_signed_sqrt): lambda x, knee: x / np.sqrt(np.sqrt(x * x + knee * knee)),
    id(numerics.lower_clip): np.maximum,
    id(numerics.clip): _clip,
}
"""{function or module of the filter's code: what computes the same for plain numbers}"""


@contextlib.contextmanager
def in_numpy():
    """The filter computes in numpy, without compilation: its code as it stands, on (P,) arrays."""
    names = [n for n in sys.modules if n.startswith("jaxtank.safety.")]
    replaced = []
    for module in (sys.modules[n] for n in [*names, "jaxtank.instruments.actuators"]):
        for name, value in list(vars(module).items()):
            if id(value) in IN_NUMPY:
                replaced.append((module, name, value))
                setattr(module, name, IN_NUMPY[id(value)])
    try:
        with np.errstate(divide="ignore", invalid="ignore"):
            yield
    finally:
        for module, name, value in replaced:
            setattr(module, name, value)


def filtered(safety_filter, actuator, y, command, hold, line):
    """(P, m) inputs [V] for readings y (P, n), commands (P, m), inputs under way (d, P, m)."""
    way = tuple(np.moveaxis(line, 2, 0)) if safety_filter.predicted else None
    u, _ = safety_filter.apply(actuator, tuple(command.T), None, tuple(y.T), hold, way)
    return np.stack(np.broadcast_arrays(*u, y[:, 0])[:-1], axis=1)


# --------------------------------------------------------------------------- a run


class Plan(NamedTuple):
    """What P plants are put through; a sample is one hold."""

    start: np.ndarray  # (P, n) [cm]
    wanted: np.ndarray  # (samples, P, m) [V]
    errors: np.ndarray  # (samples, P, n) of readings [cm]
    parameters: Any  # function of the sample: {name: (P, entries)}, None where nothing has changed
    inflow: np.ndarray  # (samples, P, n) [cm^3/s], or 0
    setpoint: Any = None  # (samples, P, m) levels [cm] that some plants' pumps follow, nan: none
    top: Any = np.inf  # (n,) largest reading [cm]


def run(shape, safety_filter, actuator, pumps, plan, hold, substeps):
    """(highest, lowest) levels (P, n) [cm] of a plan."""
    x, count = plan.start, len(plan.start)
    highest, lowest, h = x, x, hold / substeps
    f: Any = None
    initial = np.asarray(actuator.initial, float)
    under_way = np.broadcast_to(initial, (max(safety_filter.predicted, 1), count, len(initial)))
    first = [i for i, _ in shape.feeds]
    for k in range(len(plan.wanted)):
        p = plan.parameters(k)
        f = f if p is None else flows(shape, p)
        y = np.clip(x + plan.errors[k], 0.0, plan.top)
        command = plan.wanted[k]
        if plan.setpoint is not None:
            follow = np.isfinite(plan.setpoint[k])
            command = np.where(follow, 5.0 * (plan.setpoint[k] - y[:, first]), command)
        u = filtered(safety_filter, actuator, y, command, hold, under_way)
        if safety_filter.predicted:
            under_way = np.concatenate([under_way[1:], u[None]])
        v, entering = pumps.hold_input(u), plan.inflow[k] / f.area
        for _ in range(substeps):
            brought = (f.gain @ pumps.arriving(v)[:, :, None])[:, :, 0] + entering
            x, top = step(shape, f, x, brought, h)
            highest, lowest = np.maximum(highest, top), np.minimum(lowest, x)
    return highest, lowest


def held(rng, samples, count, draw, periods):
    """(samples, P, ..) of draws (samples, P, ..), each held for a while of random length."""
    redraw = rng.random((samples, count)) < 1.0 / rng.choice(periods, count)
    redraw[0] = True
    last = np.maximum.accumulate(np.where(redraw, np.arange(samples)[:, None], 0), axis=0)
    return draw[last, np.arange(count)]


# --------------------------------------------------------------------------- rig files


class Box(NamedTuple):
    """Values of all numbers of a rig file by dotted name, and how far each may be off."""

    values: dict
    widths: dict


def shape_of(table):
    """The Shape of the table of a rig file."""
    number = lambda part, *keys: tuple(tuple(e[k] - 1 for k in keys) for e in table.get(part, ()))
    both = lambda to: (to[0] - 1, to[1] - 1) if isinstance(to, list) else (to - 1, None)
    plant, values = table["plant"], table["values"]
    step = values["clock.dt"] / values.get("clock.substeps", 1)
    return Shape(
        n=len(table["tank"]),
        links=number("orifice", "from", "to"),
        pipes=tuple((e["between"][0] - 1, e["between"][1] - 1) for e in table.get("pipe", ())),
        feeds=tuple(both(e["to"]) for e in table["pump"]),
        spills=number("spill", "from", "to"),
        overflow=plant.get("overflow", False),
        step=step if plant.get("bottom") else None,
    )


def values_of(table):
    """{dotted name: (entries,)} of all numbers of a rig file, defaults filled in."""
    column = lambda part, key, default=None: np.array(
        [e.get(key, default) for e in table.get(part, ())], dtype=float
    )
    n, m = len(table["tank"]), len(table["pump"])
    found = {
        "plant.area": column("tank", "area"),
        "plant.rim": column("tank", "rim"),
        "plant.drain": column("tank", "drain"),
        "plant.orifice": column("orifice", "area"),
        "plant.pipe": column("pipe", "area"),
        "plant.caught": column("spill", "caught"),
        "plant.pump_gain": column("pump", "gain"),
        "plant.split": column("pump", "split", 1.0),
        "plant.gravity": np.array([981.0]),
        "actuator.low": column("pump", "low"),
        "actuator.high": column("pump", "high"),
        "actuator.initial": column("pump", "initial"),
        "actuator.lag": np.zeros(m),
        "actuator.dead_zone": np.zeros(m),
        "actuator.stop": np.zeros(m),
        "actuator.pulse": column("pump", "high"),
        "sensor.noise": np.zeros(n),
        "sensor.offset": np.zeros(n),
        "sensor.gain": np.ones(n),
        "sensor.full_scale": np.array([5.0]),
        "disturbance.level": column("tank", "inflow", 0.0),
        "disturbance.volume": column("inflow", "volume"),
        "faults.factor": column("fault", "factor"),
        "x0": column("tank", "level"),
    }
    given = {f"sensor.{key}": v for key, v in table.get("sensor", {}).items()} | table["values"]
    return found | {n: np.atleast_1d(np.array(given[n], float)) for n in given if n in found}


def box_of(table):
    """The Box of the table of a rig file: what it calls uncertain, or 5 % of every flow."""
    values, widths = values_of(table), {}

    def add(name, half):
        field, _, entry = name.partition("[")
        width = widths.setdefault(field, np.zeros(values[field].shape))
        width[int(entry[:-1]) if entry else ...] = half

    uncertain = table.get("uncertain", {})
    if "covariance" in table:
        names, matrix = table["covariance"]["names"], np.array(table["covariance"]["matrix"])
        flows_in = sum(name.startswith("plant.") for name in names)
        reach = math.sqrt(chi2.ppf(0.99, max(flows_in, 1)))
        for name, variance in zip(names, np.diag(matrix)):
            add(name, reach * math.sqrt(variance))
    elif uncertain:
        for name, share in uncertain.items():
            field, _, entry = name.partition("[")
            value = values[field]
            add(name, share * np.abs(value[int(entry[:-1])] if entry else value))
    else:
        for name in NAMES:
            add(f"plant.{name}", 0.05 * values[f"plant.{name}"])
    own = table["safety_filter"].get("widths")
    if own is not None:
        widths = {n: w for n, w in widths.items() if not n.startswith("plant.")}
        for name, half in own.items():
            add(name, half)
    return Box(values, widths)


def plants_of(rng, box, shape, count, target):
    """{name: (P, entries)}: random corners; where `target` (P,) is a tank, flows fill that tank."""
    found = {}
    for name, value in box.values.items():
        drawn = np.broadcast_to(value, (count, *value.shape)).copy()
        if name in box.widths and value.size:
            sign = rng.choice([-1.0, 1.0], drawn.shape)
            _towards(sign, name, shape, target)
            drawn += sign * box.widths[name]
        found[name.removeprefix("plant.").removeprefix("actuator.")] = drawn
    for name in ("split", "caught"):
        found[name] = np.clip(found[name], 0.0, 1.0)
    return found


def _towards(sign, name, shape, target):
    """Set signs (P, entries) of a parameter so that the flows fill the tank `target` (P,)."""
    rows, entries = np.arange(len(sign)), range(sign.shape[1])
    if name == "plant.drain":
        at = target >= 0
        sign[rows[at], target[at]] = -1.0
    if name == "plant.orifice":
        for k in entries:
            i, j = shape.links[k]
            sign[target == i, k], sign[target == j, k] = -1.0, 1.0
    if name == "plant.pump_gain":
        for k in entries:
            sign[
                (target >= 0) & np.isin(target, [t for t in shape.feeds[k] if t is not None]), k
            ] = 1.0
    if name == "plant.split":
        for k in entries:
            i, j = shape.feeds[k]
            sign[target == i, k] = 1.0
            if j is not None:
                sign[target == j, k] = -1.0


def band_of(table, box):
    """(n,) how far a reading may be from the level [cm]."""
    if "band" in table["safety_filter"]:
        return np.array(table["safety_filter"]["band"])
    most = {n: np.abs(v) + box.widths.get(n, 0.0) for n, v in box.values.items()}
    band = SIGMAS * most["sensor.noise"] + most["sensor.offset"]
    if bits := table.get("sensor", {}).get("bits", 0):
        band = band + 0.5 * most["sensor.gain"] * most["sensor.full_scale"] / 2**bits
    return band


def inflow_of(rng, table, box, samples, count):
    """(samples, P, n) [cm^3/s] between nothing and what the file gives, pulses at any time."""
    hold, n = table["values"]["clock.dt"], len(table["tank"])
    level = box.values["disturbance.level"]
    width = box.widths.get("disturbance.level", np.zeros(n))
    inflow = np.zeros((samples, count, n))
    if np.any(level):
        drawn = rng.choice([0.0, 1.0, 1.0], (samples, count, n))
        signs = rng.choice([-1.0, 1.0], (samples, count, n))
        inflow += held(rng, samples, count, drawn * (level + signs * width), [10, 100])
    for k, pulse in enumerate(table.get("inflow", ())):
        volume, off = box.values["disturbance.volume"], box.widths.get("disturbance.volume")
        for row in range(count):
            length = max(1, round(pulse["duration"] / hold)) if row % 2 else 1
            begin = int(pulse["time"] / hold) if row % 2 else int(rng.integers(samples))
            size = volume[k] + (0.0 if off is None else rng.choice([-1.0, 1.0]) * off[k])
            inflow[begin : begin + length, row, pulse["tank"] - 1] += size / (length * hold)
    return inflow


def faulty(table, p, time):
    """Parameters p of the plants at a time [s], with the faults of the file."""
    changed = dict(p)
    for k, fault in enumerate(table.get("fault", ())):
        if fault["start"] <= time < fault["end"]:
            field, _, entry = fault["of"].partition("[")
            value = changed[field].copy()
            value[:, int(entry[:-1])] *= p["faults.factor"][:, k]
            changed[field] = value
    return changed


def parameters_of(rng, table, box, shape, count, p, target):
    """Function of the sample: parameters of the plants where they change, else None. Half of the
    plants have parameters that change in time, at the ends of the box.
    """
    hold = table["values"]["clock.dt"]
    edges = {round(f[key] / hold) for f in table.get("fault", ()) for key in ("start", "end")}
    steady = (np.arange(count) % 2 == 0)[:, None]
    rim, instruments = p["rim"], ("low", "high", "initial", "lag", "dead_zone", "x0")
    present = dict(p)

    def at(k):
        changes = k > 0 and k % 25 == 0
        if changes:
            drawn = plants_of(rng, box, shape, count, target)
            for name in present:
                if name not in instruments:
                    present[name] = np.where(steady, present[name], drawn[name])
        present["rim"] = rim
        return faulty(table, present, k * hold) if changes or k == 0 or k in edges else None

    return at


def starts(rng, table, rows, x0, count, any_start):
    """(P, n) levels at the start: the file's x0 (P, n), or between low limits and it for every
    fourth plant; where any_start (P,), between them and the limits, at them for some.
    """
    limit = np.array([min(r.limit, 2.0 * t["rim"]) for r, t in zip(rows, table["tank"])])
    low = np.array([r.low for r in rows])
    share = rng.uniform(0.0, 1.0, (count, len(limit))) ** rng.choice([0.1, 0.5, 1.0], (count, 1))
    share = np.where(rng.random((count, 1)) < 0.3, np.round(share), share)
    elsewhere = low + (limit - low) * share
    below = np.where(x0 > low, low + (x0 - low) * share, x0)
    own = np.where((np.arange(count) % 4 == 1)[:, None], below, x0)
    return np.where(any_start[:, None], elsewhere, own)


def commands(rng, box, samples, count, down):
    """((samples, P, m) inputs that are wanted [V], (samples, P, m) shares of limits that pumps
    follow [-], nan: none).
    """
    low, high = box.values["actuator.low"], box.values["actuator.high"]
    shape = (samples, count, len(low))
    kind = np.arange(count) % 8
    switched = np.where(rng.random(shape) < 0.55, 2.0 * high, low - 1.0)
    switched = np.where(rng.random(shape) < 0.2, rng.uniform(low, high, shape), switched)
    wanted = held(rng, samples, count, switched, [1, 3, 10, 40])
    wanted[:, kind == (2 if down else 0)] = 2.0 * high
    wanted[:, (kind == 1) | (down & ((kind == 0) | (kind > 5)))] = low - 1.0
    late = rng.integers(1, samples, count)
    filling = (kind == 3) | (kind == 1) & ~np.bool_(down)
    wanted = np.where(
        (np.arange(samples)[:, None] > late)[:, :, None] & filling[None, :, None],
        2.0 * high,
        wanted,
    )
    follow = held(rng, samples, count, rng.uniform(0.3, 1.2, shape), [20, 100])
    return wanted, np.where((kind == 4)[None, :, None], follow, np.nan)


class Outcome(NamedTuple):
    """What came of one rig file."""

    seed: int
    features: tuple
    refused: str  # why the file, or the filter, was refused
    rows: tuple  # TankCertificate of each tank
    highest: np.ndarray  # (n,) [cm], over the starts for which each tank's statement holds
    lowest: np.ndarray
    own: np.ndarray  # (n,) highest levels from the file's start [cm]


def trial(seed, low=False, any_start=False, count=64):
    """The Outcome of a random rig file."""
    return outcome_of(*rig_files.draw(seed, low), seed, low, any_start, count)


def outcome_of(table, features=(), seed=0, low=False, any_start=False, count=64):
    """The Outcome of the table of a rig file."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            case = rig.from_table(table)
            safety_filter, rows = case.safety_design(**(case.safety or {}))
    except InputError as error:
        return Outcome(seed, features, str(error), (), *3 * (np.zeros(0),))
    if not any(r.certified or r.low_certified for r in rows):
        return Outcome(seed, features, "", rows, *3 * (np.full(len(rows), np.nan),))
    pumps = case.loop.actuator
    levels = attack_file(table, pumps, safety_filter, rows, seed, low, any_start, count)
    return Outcome(seed, features, "", rows, *levels)


def attack_file(table, actuator, safety_filter, rows, seed, low, any_start, count):
    """(highest, lowest, highest from the file's start) levels (n,) [cm] of the plants of a rig
    file; the first two over the starts that the certificate of each tank allows.
    """
    rng = np.random.default_rng([seed, 7])
    shape, box, hold = shape_of(table), box_of(table), table["values"]["clock.dt"]
    samples = int(np.clip(90.0 / hold, 200, 500))
    target = np.where(rng.random(count) < 0.6, rng.integers(0, shape.n, count), -1)
    p = plants_of(rng, box, shape, count, target)
    anywhere = np.array([any_start or r.starts == "limits" for r in rows])
    elsewhere = np.arange(count) % 4 >= 2 if anywhere.any() else np.zeros(count, bool)
    start = starts(rng, table, rows, p["x0"], count, elsewhere)
    wanted, share = commands(rng, box, samples, count, low)
    limits = np.array([r.limit for r in rows])[[i for i, _ in shape.feeds]]
    signs = rng.choice([-1.0, 1.0], (samples, count, shape.n))
    signs[:, np.arange(count) % 5 == 0] = -1.0
    signs[:, np.arange(count) % 5 == 1] = 1.0
    top = np.inf
    if table.get("sensor", {}).get("bits", 0):
        top = np.array(table["sensor"]["gain"]) * table["sensor"]["full_scale"]
    plan = Plan(
        start=start,
        wanted=wanted,
        errors=signs * band_of(table, box),
        parameters=parameters_of(rng, table, box, shape, count, p, target),
        inflow=inflow_of(rng, table, box, samples, count),
        setpoint=share * limits,
        top=top,
    )
    kind = table["values"].get("actuator.dead_zone_kind", "")
    delay = round(table["values"].get("actuator.delay", 0.0) / hold)
    substeps = substeps_of(shape, p, hold)
    pumps = Pumps(p, kind, delay, hold, substeps)
    with in_numpy():
        high, least = run(shape, safety_filter, actuator, pumps, plan, hold, substeps)
    own, own_least = high[~elsewhere].max(0), least[~elsewhere].min(0)
    return (np.where(anywhere, high.max(0), own), np.where(anywhere, least.min(0), own_least), own)


def substeps_of(shape, p, hold):
    """Runge-Kutta steps of a hold, enough for the pipes."""
    w = np.sqrt(2.0 * p["gravity"])
    steep = np.zeros(len(w))
    for k, (i, j) in enumerate(shape.pipes):
        s = w[:, 0] * p["pipe"][:, k] / math.sqrt(shape.knee)
        steep = np.maximum(steep, s / p["area"][:, i] + s / p["area"][:, j])
    return int(np.clip(math.ceil(hold * steep.max() / 1.2), max(2, round(hold / 0.125)), 24))


def passed(outcome):
    """[(tank, "upper", "reach" or "low", by how much [cm])] of the certified levels that a level
    passed: the limit, what it never passes from the file's start, and the low limit.
    """
    found = []
    for r in outcome.rows:
        if r.certified and outcome.highest[r.tank] > r.limit + 1e-9:
            found.append((r.tank, "upper", float(outcome.highest[r.tank] - r.limit)))
        elif r.certified and outcome.own[r.tank] > r.reach + 1e-9:
            found.append((r.tank, "reach", float(outcome.own[r.tank] - r.reach)))
        if r.low_certified and outcome.lowest[r.tank] < r.low - 1e-9:
            found.append((r.tank, "low", float(r.low - outcome.lowest[r.tank])))
    return found


# --------------------------------------------------------------------------- networks


def of(plant, share):
    """Half widths of the box of plants whose flows are off by up to `share`."""
    return widths_of(plant, dict.fromkeys(NAMES, share))


def sensor_of(plant):
    return LevelSensor(noise=np.zeros(plant.tanks))


def corners(rng, plant, count, spread):
    """{parameter: (count, ..) values} of plants at random corners of the box."""
    p = {}
    for name in NAMES:
        value = np.asarray(getattr(plant, name), dtype=float)
        p[name] = value * (1.0 + rng.choice([-1.0, 1.0], (count, *value.shape)) * spread)
    p["split"] = np.minimum(p["split"], 1.0)
    return p


def random_rig(rng):
    """The plant and the pumps of a random rig file."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        table, _ = rig_files.draw(int(rng.integers(10**9)))
        loop = rig.from_table({k: v for k, v in table.items() if k != "safety_filter"}).loop
    return loop.plant, loop.actuator


def attack(
    plant,
    actuator,
    found,
    hold,
    spread,
    *,
    seconds,
    start=None,
    count=60,
    seed=0,
    substeps=4,
    delay=0,
    lag=0.0,
    eps=0.0,
    inflow=0.0,
    varying=False,
    down=False,
    before=0.0,
    pulses=None,
    each=False,
):
    """(highest, lowest) levels (n,) [cm] over plants of the box, (count, n) where `each`; a third
    with pumps full (off where `down`), the rest switching at random. Inflows at 0 or `inflow` (n,),
    or `pulses` (samples, n) [cm^3/s]. `before`: inputs (m,) that are under way at the start [V].
    """
    rng = np.random.default_rng(seed)
    n, m, samples = plant.tanks, plant.pumps, int(seconds / hold)
    shape = Shape(n, plant.links, plant.pipes, plant.feeds, knee=plant.knee)
    low, high = np.asarray(actuator.low, float), np.asarray(actuator.high, float)
    every = lambda value, size: np.broadcast_to(np.asarray(value, float), (count, size)).copy()
    period = max(1, int(2.0 / hold))

    def drawn():
        p = {"area": every(plant.area, n), "rim": every(plant.rim, n), "caught": every(0.0, 1)}
        p["gravity"] = every(plant.gravity, 1)
        return p | corners(rng, plant, count, spread)

    p = drawn()
    at = lambda k: p if k == 0 else drawn() if varying and k % period == 0 else None
    shown = lambda draw: np.repeat(draw, period, axis=0)[:samples]
    blocks = -(-samples // period)
    wanted = shown(np.where(rng.random((blocks, count, m)) < 0.5, low, high))
    wanted[:, np.arange(count) % 3 == 0] = low if down else high
    entering = shown(np.where(rng.random((blocks, count, n)) < 0.5, 0.0, inflow))
    if pulses is not None:
        entering = np.broadcast_to(np.asarray(pulses)[:samples, None], (samples, count, n))
    limit, least = np.asarray(found.limit), np.asarray(found.low)
    top = limit if start is None else start
    x = rng.uniform(0.2, 1.0, (count, 1)) * rng.uniform(0.0, 1.0, (count, n)) ** 0.3
    x = least + (top - least) * x
    x[: count // 4] = top
    errors = eps * rng.choice([-1.0, 1.0], (samples, count, n))
    dead = np.asarray(found.offset)
    of_pumps = {"low": low, "high": high, "lag": lag, "dead_zone": dead}
    of_pumps["initial"] = np.zeros(m) + before + dead
    pumps = Pumps({k: every(v, m) for k, v in of_pumps.items()}, "offset", delay, hold, substeps)
    plan = Plan(x, wanted, errors, at, entering)
    actuator = dataclasses.replace(actuator, initial=np.zeros(m) + before)
    clipping = dataclasses.replace(found, allocate=False)
    with in_numpy():
        highest, lowest = run(shape, clipping, actuator, pumps, plan, hold, substeps)
    return (highest, lowest) if each else (highest.max(0), lowest.min(0))


# --------------------------------------------------------------------------- the command


def line_of(outcome):
    """A line of one rig: highest level over limit and lowest over low limit [-] of each tank."""
    if outcome.refused:
        return f"refused: {outcome.refused}"
    words = []
    for r in outcome.rows:
        word = "proved" if r.certified else "open"
        text = f"{word} {outcome.highest[r.tank] / r.limit:.4f}"
        if r.low > 0.0:
            word = "proved" if r.low_certified else "open"
            text += f", low {word} {outcome.lowest[r.tank] / r.low:.4f}"
        words.append(text)
    return " | ".join(words)


def main(first, last, low, any_start, lines):
    """Print what came of random rig files; return 1 where a certified limit is passed."""
    table, passes = collections.defaultdict(lambda: np.zeros(6, int)), 0
    for seed in range(first, last):
        outcome = trial(seed, low, any_start)
        over = passed(outcome)
        passes += len(over)
        counts = [1, bool(outcome.refused), len(outcome.rows)]
        counts += [sum(r.certified for r in outcome.rows)]
        counts += [sum(r.low_certified for r in outcome.rows), len(over)]
        for name in ("all", *outcome.features):
            table[name] += counts
        if lines:
            print(seed, line_of(outcome), flush=True)
        for tank, side, excess in over:
            row = outcome.rows[tank]
            reason = "low limit" if side == "low" else f"{row.reason} ({row.starts})"
            where = f"seed {seed} tank {tank + 1} {side} by {excess:.3g} cm"
            print(f"PASSED {where}: {reason} [{', '.join(outcome.features)}]", flush=True)
    print("feature | rigs | refused | tanks | upper limits proved | low limits proved | passed")
    order = ("all", *rig_files.TOPOLOGIES, *rig_files.FEATURES)
    for name in order:
        print(" | ".join([name, *(str(v) for v in table[name])]))
    return 1 if passes else 0


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    numbers = [int(w) for w in sys.argv[1:] if not w.startswith("--")]
    flags = [f"--{w}" in sys.argv for w in ("low", "any-start", "lines")]
    sys.exit(main(*numbers, *flags))

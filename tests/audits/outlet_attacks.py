"""Search for a plant, a start and readings that take a level past a limit that Theorem 6 proves.

    python tests/audits/outlet_attacks.py 0 500     random rigs 0 to 499: counts

Rigs of valves, pumps in outlets and between tanks, inputs of either sign, shaped tanks, ports,
exponents. Plants at corners of the box, half of them changing in time; readings off by the whole
band; inputs full, off or switching; simulated by a code of its own in numpy, with volumes
as the state (a level divides by a section that is 0 at the tip of a cone): of jaxtank it runs the
filter's `apply` alone. Exit code 1 where a proved limit is passed.
"""

import collections
import functools
import sys
from typing import Any

import jax
import numpy as np
from safety_attacks import held, rk4
from scipy.interpolate import CubicHermiteSpline

from jaxtank.core.errors import InputError
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.plants.network import network
from jaxtank.safety.box import widths_of
from jaxtank.safety.outlet_design import outlet_design

GRAVITY, KNEE = 981.0, 0.01
PERIODS = (1, 5, 30)
"""Samples for which a draw is held, on average."""
STEADY = ("area", "extent")
"""Parameters that do not change in time: the volume in a tank depends on them."""
TABLE = ((0.0, 0.4), (0.5, 1.0), (1.0, 0.6))


def random_rig(seed):
    """Return (plant, actuator, sensor, settings of `outlet_design`, hold) of a random rig."""
    rng = np.random.default_rng([seed, 39])
    n = int(rng.choice([1, 1, 2, 3]))
    tanks = range(n)
    rim = rng.uniform(15.0, 40.0, n)
    kinds = ["prism", "cone", "sphere", "horizontal-cylinder", TABLE]
    shapes = [kinds[int(rng.choice(5, p=[0.6, 0.1, 0.1, 0.1, 0.1]))] for _ in tanks]
    chain = [(i, i + 1) for i in range(n - 1)]
    links = [pair for pair in chain if rng.random() < 0.4]
    pipes = [pair for pair in chain if pair not in links and rng.random() < 0.3]
    feeds, sources, low, high, gain, lifts = [], [], [], [], [], []
    lift = ((-40.0, 1.2), (0.0, 1.0), (40.0, 0.6))

    def pump(source, sinks, least, most=10.0, loss=None):
        feeds.append(sinks)
        sources.append(source)
        low.append(least)
        high.append(most)
        gain.append(rng.uniform(2.0, 20.0))
        lifts.append(loss)

    for i in tanks:
        word = rng.choice(["fill", "draw", "either", "out", "none"], p=[0.3, 0.2, 0.15, 0.2, 0.15])
        if word == "fill":
            pump(None, (i, None), 0.0)
        elif word == "draw":  # into the tank by its name, but always backwards
            pump(None, (i, None), -10.0, 0.0)
        elif word == "either":
            pump(None, (i, None), -5.0)
        elif word == "out":
            pump(i, (None, None), 0.0)
    for i, j in chain:
        if rng.random() < 0.5:
            a, b = (i, j) if rng.random() < 0.7 else (j, i)
            loss = lift if rng.random() < 0.3 else None
            pump(a, (b, None), 0.0 if loss or rng.random() < 0.7 else -4.0, loss=loss)
    if n > 1 and rng.random() < 0.2:
        pump(None, (0, 1), 0.0)
    more = np.random.default_rng([seed, 41])
    if n == 3 and more.random() < 0.4:  # one pump for two tanks, or back from both
        forth = more.random() < 0.5
        pump(0, (1, 2), -4.0, 10.0 if forth else 0.0)
    valves = [(i, None) for i in tanks if rng.random() < 0.4]
    valves += [pair for pair in chain if rng.random() < 0.25]
    if not feeds and not valves:
        valves = [(0, None)]
    inflow = rng.uniform(0.0, 60.0, n) * (rng.random(n) < 0.5)
    draw = -rng.uniform(0.0, 20.0, n) * (rng.random(n) < 0.2)
    ported = rng.random() < 0.3
    plant = network(
        area=rng.uniform(20.0, 120.0, n),
        drain=rng.uniform(0.05, 0.6, n) * (rng.random(n) < 0.6),
        pump_gain=gain,
        feeds=feeds,
        sources=sources,
        lift_curves=lifts,
        split=[0.4 if None not in pair else 1.0 for pair in feeds],
        rim=rim,
        links=links,
        orifice=rng.uniform(0.05, 0.4, len(links)),
        pipes=pipes,
        pipe=rng.uniform(0.05, 0.4, len(pipes)),
        valves=valves,
        valve=rng.uniform(0.3, 2.0, len(valves)) if valves else (),
        characteristics=[str(rng.choice(["linear", "equal-percentage"])) for _ in valves],
        one_way=[bool(rng.random() < 0.3) for _ in valves],
        shapes=shapes if set(shapes) != {"prism"} else (),
        extent=rim * 1.2 if set(shapes) != {"prism"} else None,
        ports={"drain": rng.uniform(0.0, 2.0, n), "valve": np.full(len(valves), 1.0)}
        if ported and valves
        else {},
        exponents={"drain": rng.uniform(0.4, 1.2, n)} if rng.random() < 0.2 else {},
        resistances={"drain": rng.uniform(0.5, 9.0, n)} if rng.random() < 0.2 else {},
        overflow=bool(rng.random() < 0.3),
        bottom=True,
    )
    m = plant.pumps
    actuator = PumpBank(
        low=np.array(low + [0.0] * len(valves)),
        high=np.array(high + [1.0] * len(valves)),
        initial=np.zeros(m),
    )
    noise = 0.02 if rng.random() < 0.3 else 0.0
    span: dict[str, Any] = {"full_scale": np.array(100.0)}
    if more.random() < 0.3:
        span |= {"low": more.uniform(-1.0, 4.0, n), "high": rim * more.uniform(0.4, 1.2, n)}
    if more.random() < 0.2:
        span["bits"] = int(more.integers(4, 9))
    sensor = LevelSensor(gain=np.ones(n), noise=np.full(n, noise), **span)
    spread = {"drain": 0.05, "orifice": 0.05, "pipe": 0.05, "pump_gain": 0.1, "split": 0.05}
    spread |= {"valve": 0.1} if valves else {}
    spread |= {"area": 0.05} if rng.random() < 0.3 else {}
    if plant.extent is not None and TABLE not in shapes and rng.random() < 0.5:
        spread["extent"] = 0.03
    limit = rim * rng.uniform(0.7, 1.0, n)
    least = np.where(rng.random(n) < 0.6, rim * rng.uniform(0.05, 0.3, n), 0.0)
    settings = {
        "widths": widths_of(plant, spread),
        "limit": limit,
        "low": least,
        "inflow": inflow,
        "draw": draw,
        "start": least + (limit - least) * rng.uniform(0.05, 1.0, n),
        "substeps": int(rng.integers(1, 4)),
    }
    if more.random() < 0.2:  # perhaps narrower than the sensor is
        settings["band"] = np.full(n, more.choice([0.0, 0.1, 1.0]))
    hold = float(rng.choice([0.1, 0.25, 0.5, 1.0]))
    return plant, actuator, sensor, settings, hold


def volume_of(shape, area, extent, h):
    """Volume (P,) below levels h (P,) of tanks, from geometry."""
    if shape == "prism":
        return area * h
    y = np.clip(h / extent, 0.0, 1.0)
    if shape == "cone":
        return area * extent * y**3 / 3.0
    if shape == "sphere":
        return area * extent * y**2 * (2.0 - 4.0 / 3.0 * y)
    if shape == "horizontal-cylinder":
        half = np.arccos(1.0 - 2.0 * y)
        return area * extent / 4.0 * (half - np.sin(half) * np.cos(half))
    levels, shares = (np.array(column) for column in zip(*shape))
    at = np.interp(y, levels, shares)
    below = np.concatenate([[0.0], np.cumsum(np.diff(levels) * (shares[1:] + shares[:-1]) / 2)])
    k = np.clip(np.searchsorted(levels, y, side="right") - 1, 0, len(levels) - 2)
    return area * extent * (below[k] + (y - levels[k]) * (shares[k] + at) / 2.0)


def level_of(shape, area, extent, volume):
    """Level (P,) of volumes (P,)."""
    if shape == "prism":
        return volume / area
    if shape == "cone":
        return extent * np.cbrt(3.0 * volume / (area * extent))
    y, below = table_of(shape)
    share = np.minimum(volume / (area * extent), below[-1])
    at = np.interp(share, below, y)
    for _ in range(5):  # Newton, with the section by a central difference
        step = 1e-6 * np.maximum(at, 1e-6)
        section = (of_unit(shape, at + step) - of_unit(shape, at - step)) / (2.0 * step)
        at = np.clip(at - (of_unit(shape, at) - share) / np.maximum(section, 1e-9), 0.0, 1.0)
    return extent * at


def of_unit(shape, y):
    return volume_of(shape, 1.0, 1.0, y)


@functools.cache
def table_of(shape):
    """(levels, volumes) of a tank of unit size."""
    y = np.linspace(0.0, 1.0, 4001)
    return y, of_unit(shape, y)


def power(h, exponent=0.5, knee=KNEE):
    y = np.maximum(h, 0.0) / knee
    shallow = np.maximum(y * (2.0 - exponent + (exponent - 1.0) * y), 0.0)
    return knee**exponent * np.where(y >= 1.0, np.maximum(y, 1.0) ** exponent, shallow)


def share_of(points, lift):
    """Share of a pump's flow at lifts (P,): monotone cubics, straight beyond the ends."""
    x, y = (np.array(column) for column in zip(*points))
    slope = np.diff(y) / np.diff(x)
    width = np.diff(x)
    inner = [
        0.0 if s * t <= 0.0 else 3 * (b + c) / ((2 * c + b) / s + (c + 2 * b) / t)
        for s, t, b, c in zip(slope, slope[1:], width, width[1:])
    ]
    spline = CubicHermiteSpline(x, y, [slope[0], *inner, slope[-1]])
    inside = spline(np.clip(lift, x[0], x[-1]))
    beyond = slope[0] * np.minimum(lift - x[0], 0.0) + slope[-1] * np.maximum(lift - x[-1], 0.0)
    return np.maximum(inside + beyond, 0.0)


def streams(plant, p, x, u):
    """[(source, sink, flow (P,))] of plants with parameters p {name: (P, entries)}."""
    w, knee, flows = np.sqrt(2.0 * float(plant.gravity)), plant.knee, []
    port = lambda name, k: 0.0 if getattr(plant, name) is None else getattr(plant, name)[k]
    above = lambda i, at: np.maximum(x[:, i] - at, 0.0)
    signed = lambda z: z / np.sqrt(np.hypot(z, knee))

    def through(name, k, i):
        """Flow through a drain or an orifice of tank i."""
        head = above(i, port(f"{name}_port", k))
        fixed, linear = (getattr(plant, f"{name}_{n}") for n in ("exponent", "resistance"))
        flow = p[name][:, k] * w * power(head, 0.5 if fixed is None else fixed[k], knee)
        return flow if linear is None else flow + head / linear[k]

    flows += [(i, None, through("drain", i, i)) for i in range(plant.tanks)]
    flows += [(i, j, through("orifice", k, i)) for k, (i, j) in enumerate(plant.links)]
    for k, (i, j) in enumerate(plant.pipes):
        at = port("pipe_port", k)
        flows.append((i, j, p["pipe"][:, k] * w * signed(above(i, at) - above(j, at))))
    for j, (first, second) in enumerate(plant.feeds):
        source = plant.sources[j] if plant.sources else None
        curve = plant.curves[j] if plant.curves else None
        flow = p["pump_gain"][:, j] * (u[:, j] if curve is None else share_of(curve, u[:, j]))
        if plant.lift_curves and plant.lift_curves[j] is not None:
            flow = flow * share_of(plant.lift_curves[j], x[:, first] - x[:, source])
        if second is None:
            flows.append((source, first, flow))
        else:
            flows.append((source, first, p["split"][:, j] * flow))
            flows.append((source, second, (1.0 - p["split"][:, j]) * flow))
    for k, (i, j) in enumerate(plant.valves):
        opening, kind = u[:, len(plant.feeds) + k], plant.characteristics[k]
        if kind == "equal-percentage":
            opening = plant.rangeability[k] ** (opening - 1.0)
        elif kind != "linear":
            opening = share_of(kind, opening)
        area, at = p["valve"][:, k] * opening, port("valve_port", k)
        if j is None:
            flow = area * w * power(above(i, at), knee=knee)
        else:
            flow = area * w * signed(above(i, at) - above(j, at))
        flows.append((i, j, np.maximum(flow, 0.0) if plant.one_way[k] else flow))
    return flows


def by_tank(plant, p, function, values):
    """(P, n) of a function of the shape, area and extent of each tank, and of values (P, n)."""
    shapes = plant.shapes or ("prism",) * plant.tanks
    size = lambda i: (shapes[i], p["area"][:, i], p["extent"][:, i])
    return np.stack([function(*size(i), values[:, i]) for i in range(plant.tanks)], axis=1)


def rates(plant, p, volume, u, entering, step):
    """Net inflow (P, n) at volumes (P, n); no tank gives more than it holds in `step`."""
    volume = np.maximum(volume, 0.0)
    x = by_tank(plant, p, level_of, volume)
    flows, leaving = streams(plant, p, x, u), np.zeros(x.shape)
    for source, sink, flow in flows:
        if source is not None:
            leaving[:, source] += np.maximum(flow, 0.0)
        if sink is not None:
            leaving[:, sink] += np.maximum(-flow, 0.0)
    most = volume / step
    share = np.where(leaving > most, most / np.where(leaving > 0.0, leaving, 1.0), 1.0)
    total = entering.copy()
    for source, sink, flow in flows:
        forth = np.maximum(flow, 0.0) * (1.0 if source is None else share[:, source])
        back = np.maximum(-flow, 0.0) * (1.0 if sink is None else share[:, sink])
        if source is not None:
            total[:, source] -= forth - back
        if sink is not None:
            total[:, sink] += forth - back
    return total


def parameters(rng, plant, widths, count, wanted):
    """{name: (P, entries)} at corners of the box; `wanted` (P,): 1 fills, -1 empties, 0 either."""
    found = {}
    for name in ("area", "drain", "orifice", "pipe", "pump_gain", "split", "valve", "extent"):
        value = getattr(plant, name)
        value = np.ones(plant.tanks) if value is None else np.asarray(value, float)
        sign = rng.choice([-1.0, 1.0], (count, len(value)))
        if name in ("drain", "valve"):
            sign = np.where(wanted[:, None] != 0, -wanted[:, None], sign)
        if name == "pump_gain":
            outward = [bool(plant.sources) and s is not None for s in plant.sources or [None] * 9]
            for j in range(len(value)):
                by = -wanted if outward[j] and plant.feeds[j][0] is None else sign[:, j]
                sign[:, j] = np.where(wanted != 0, by, sign[:, j])
        found[name] = value + sign * np.broadcast_to(widths.get(name, 0.0), value.shape)
    found["split"] = np.minimum(found["split"], 1.0)
    return found


def attack(rig, outlet_filter, rows, seed, count=32, samples=240):
    """(highest, lowest) levels (n,) [cm] from starts that the certificates allow."""
    plant, actuator, sensor, settings, hold = rig
    rng = np.random.default_rng([seed, 40])
    span = [
        none if end is None else np.maximum(end, 0.0)
        for none, end in ((0.0, sensor.low), (np.inf, sensor.high))
    ]
    n, m = plant.tanks, plant.pumps
    wanted = rng.choice([-1, 0, 1], count)
    p = parameters(rng, plant, settings["widths"], count, wanted)
    low, high = (np.asarray(end, float) for end in (actuator.low, actuator.high))
    least, limit = settings["low"], np.array([r.limit for r in rows])
    anywhere = all(r.starts == "limits" for r in rows)
    x = np.tile(settings["start"], (count, 1))
    if anywhere:
        share = np.where(rng.random((count, n)) < 0.4, np.round(rng.random((count, n))), 0.5)
        x[::2] = (least + (limit - least) * share)[::2]
    command = held(rng, samples, count, rng.choice([0.0, 1.0], (samples, count, m)), PERIODS)
    for j in range(m):  # a third of the runs does all it can to fill, or to empty
        outlet = j >= len(plant.feeds) and plant.valves[j - len(plant.feeds)][1] is None
        outlet |= j < len(plant.feeds) and plant.feeds[j][0] is None
        extreme = (wanted > 0) != outlet
        command[:, (np.arange(count) % 3 == 0), j] = extreme[np.arange(count) % 3 == 0]
    command = low + (high - low) * command
    errors = np.asarray(outlet_filter.band) * rng.choice([-1.0, 1.0], (samples, count, n))
    errors[:, np.arange(count) % 4 == 0] = np.asarray(outlet_filter.band)
    errors[:, np.arange(count) % 4 == 1] = -np.asarray(outlet_filter.band)
    inflow = settings["draw"] + (settings["inflow"] - settings["draw"]) * held(
        rng, samples, count, rng.choice([0.0, 1.0], (samples, count, n)), PERIODS
    )
    inflow[:, wanted > 0] = settings["inflow"]
    inflow[:, wanted < 0] = settings["draw"]
    call = lambda y, u: outlet_filter.apply(actuator, tuple(u), None, tuple(y), hold)[0]
    filtered = jax.jit(jax.vmap(call))
    highest, lowest = x, x
    parts = max(4, settings["substeps"])
    step, fine = hold / settings["substeps"], hold / parts
    changing = np.arange(count) % 2 == 1
    for k in range(samples):
        if k and k % 20 == 0:
            new = parameters(rng, plant, settings["widths"], count, wanted)
            for name in (name for name in new if name not in STEADY):
                p[name] = np.where(changing[:, None], new[name], p[name])
        y = np.minimum(np.maximum(x + errors[k], span[0]), span[1])
        u = np.stack([np.asarray(v) for v in filtered(y, command[k])], axis=1)
        assert np.all(u >= low - 1e-12) and np.all(u <= high + 1e-12)
        v = by_tank(plant, p, volume_of, x)
        for _ in range(parts):
            f = lambda at, u=u, k=k: rates(plant, p, at, u, inflow[k], step)
            v = np.maximum(rk4(f, v, fine), 0.0)
            x = by_tank(plant, p, level_of, v)
            if plant.overflow:
                x = np.minimum(x, np.asarray(plant.rim))
                v = by_tank(plant, p, volume_of, x)
            highest, lowest = np.maximum(highest, x), np.minimum(lowest, x)
    return highest.max(0), lowest.min(0)


def trial(seed, **sizes):
    """(rows or why the rig was refused, [(tank, side, by how much)] of proved limits passed)."""
    rig = random_rig(seed)
    plant, actuator, sensor, settings, hold = rig
    try:
        outlet_filter, rows = outlet_design(plant, actuator, sensor, hold, **settings)
    except InputError as error:
        return str(error), []
    if not any(r.certified or r.low_certified for r in rows):
        return rows, []
    highest, lowest = attack(rig, outlet_filter, rows, seed, **sizes)
    passes = []
    for r in rows:
        over, under = highest[r.tank] - r.limit, r.low - lowest[r.tank]
        passes += [(r.tank, "upper", float(over))] * bool(r.certified and over > 1e-9)
        passes += [(r.tank, "low", float(under))] * bool(r.low_certified and under > 1e-9)
    return rows, passes


def main(first, last):
    """Print what came of random rigs; return 1 where a proved limit is passed."""
    counts, reasons = collections.Counter(), collections.Counter()
    for seed in range(first, last):
        rows, passes = trial(seed)
        counts["rigs"] += 1
        if isinstance(rows, str):
            counts["refused"] += 1
            reasons[rows] += 1
            continue
        counts["rigs with a proved limit"] += any(r.certified or r.low_certified for r in rows)
        for r in rows:
            counts["upper limits"] += 1
            counts["upper limits proved"] += r.certified
            counts["low limits"] += r.low > 0.0
            counts["low limits proved"] += r.low_certified
            for why in [r.reason] * (not r.certified) + [r.low_reason] * (
                r.low > 0.0 and not r.low_certified
            ):
                reasons["".join(c for c in why if not c.isdigit())] += 1
        counts["passed"] += len(passes)
        for tank, side, by in passes:
            print(f"PASSED seed {seed} tank {tank + 1} {side} by {by:.3g} cm", flush=True)
        if counts["rigs"] % 25 == 0:
            proved = counts["upper limits proved"], counts["low limits proved"]
            line = f"{counts['rigs']} rigs, proved {proved[0]} upper and {proved[1]} low limits"
            print(f"{line}, passed {counts['passed']}", flush=True)
    for name, count in counts.items():
        print(f"{name} | {count}")
    for why, count in reasons.most_common(12):
        print(f"not proved | {count} | {why}")
    return 1 if counts["passed"] else 0


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sys.exit(main(*(int(word) for word in sys.argv[1:3])))

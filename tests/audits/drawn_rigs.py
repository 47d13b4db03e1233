"""Random complete rigs over the tables and keys of a rig file (`rig_text` writes them).

Seeds of one group of GROUP have one structure (tables, keys, times), and values of their own.
"""

import math
from typing import Any

import numpy as np
from drawn_loops import add_controller, add_observer
from drawn_signals import add_disturbances, add_faults, add_judged, add_reference
from rig_text import FLOWS, LENGTHS, RANGES, Q, Reading, Style, T

GROUP = 32
"""Seeds of one structure, which share compiled programs."""
G = 9.81
USUAL_VOLUME = 0.4 * 1.2
"""Of a tank [m^3]; filled by the usual flow in the time `tau` of a rig."""


def style_of(seed):
    """The Style in which the rig of a seed is written first."""
    rng = np.random.default_rng([seed // GROUP, 3])
    drive = str(rng.choice([*RANGES, *FLOWS, "%", "V"]))
    flow = 2.5 * USUAL_VOLUME / Draw(seed).tau
    return Style(str(rng.choice(list(LENGTHS))), drive, (), seed // GROUP, flow)


class Draw:
    """The two generators of a seed: `s` of its structure, `v` of its values."""

    def __init__(self, seed):
        self.s = np.random.default_rng([seed // GROUP, 1])
        self.v = np.random.default_rng([seed, 2])
        self.extreme = self.s.random() < 0.12
        self.tau = self.choose(40.0, 200.0, 1500.0)

    def maybe(self, share):
        return bool(self.s.random() < share)

    def choose(self, *options, p=None):
        return options[int(self.s.choice(len(options), p=p))]

    def near(self, middle, spread=1.6):
        """A value about `middle`, by a factor of `spread` (of a few: 300) up or down."""
        spread = 300.0 if self.extreme and self.v.random() < 0.04 else spread
        return float(middle * spread ** self.v.uniform(-1.0, 1.0))

    def share(self, low=0.0, high=1.0):
        return float(self.v.uniform(low, high))

    def fixed(self, low=0.0, high=1.0):
        """A number of the structure: a program is compiled for it."""
        return float(self.s.uniform(low, high))


def draw(seed):
    """The rig of a seed, {table: {key: value}} with quantities in m, s and shares."""
    d = Draw(seed)
    n = d.choose(1, 2, 3, 4, p=[0.25, 0.4, 0.25, 0.1])
    d.n = n
    d.dt = d.tau / d.choose(50.0, 100.0, 200.0)
    d.samples = int(d.choose(100, 150, 240))
    d.height = [d.near(1.2) for _ in range(n)]
    d.area = [d.near(0.4) for _ in range(n)]
    d.flow = float(np.mean(d.area) * np.mean(d.height) / d.tau)
    d.usual_flow = USUAL_VOLUME / d.tau
    d.end = d.dt * d.samples
    d.tank = lambda i: T(int(i), d.named_by_name)
    d.named_by_name = d.maybe(0.7)
    d.opening = lambda share=1.0: Q(
        d.near(share * d.flow / math.sqrt(2 * G * 0.5 * np.mean(d.height)), 1.8), 2
    )
    d.level = lambda i, low=0.1, high=0.85: Q(d.height[i] * d.share(low, high), 1)
    d.read = lambda i, low, high: (
        Reading(d.level(i, low, high).value, *d.readings[i])
        if i in d.readings
        else d.level(i, low, high)
    )
    rig: dict[str, Any] = {"reachable": False}
    _tanks(d, rig)
    _openings(d, rig)
    _inputs(d, rig)
    _sensors(d, rig)
    rig["plant"] = {"outputs": [d.tank(i) for i in d.outputs]}
    _options(d, rig)
    add_controller(d, rig)
    add_observer(d, rig)
    add_reference(d, rig)
    add_disturbances(d, rig)
    add_faults(d, rig)
    add_judged(d, rig)
    values = {"clock.dt": Q(d.dt, 0, 1), "clock.duration": Q(d.end, 0, 1)}
    if d.maybe(0.3):
        values["clock.substeps"] = d.choose(2, 3)
    if d.maybe(0.1):
        values["clock.integrator"] = "midpoint"
    rig["values"] = {**rig.get("values", {}), **values}
    return {k: v for k, v in rig.items() if v not in ({}, [])}


def _tanks(d, rig):
    shaped = d.maybe(0.45)
    names = d.choose("TK", "LT10", "tank ")
    rig["tank"] = []
    for i in range(d.n):
        shape = "area"
        if shaped:
            shape = d.choose("area", "cone", "sphere", "horizontal-cylinder", "table", "table")
        elif d.maybe(0.25):
            shape = d.choose("diameter", "volume")
        H, A = d.height[i], d.area[i]
        row = {"name": f"{names}{i + 1}"}
        if shape == "area":
            row |= {"area": Q(A, 2), d.choose("rim", "height"): Q(H, 1)}
        elif shape == "diameter":
            row |= {"diameter": Q(math.sqrt(4 * A / math.pi), 1), "rim": Q(H, 1)}
        elif shape == "volume":
            row |= {"volume": Q(A * H, 3), "rim": Q(H, 1)}
        elif shape == "cone":
            row |= {"shape": "cone", "area": Q(A, 2), "height": Q(H, 1)}
        elif shape == "sphere":
            d.height[i] = H = math.sqrt(4 * A / math.pi)
            row |= {"shape": "sphere", "diameter": Q(H, 1)}
        elif shape == "horizontal-cylinder":
            row |= {"shape": shape, "diameter": Q(H, 1), "length": Q(A / H, 1)}
        else:
            d.height[i] = H = d.fixed(0.6, 2.0)  # shares of these are part of the program
            A, mid = d.fixed(0.2, 0.8), H * d.fixed(0.3, 0.7)
            points = [(0.0, A * d.fixed(0.3, 1.0)), (mid, A), (H, A * d.fixed(0.4, 1.0))]
            row["shape"] = [[Q(h, 1), Q(a, 2)] for h, a in points]
        if shaped and shape not in ("area", "diameter", "volume") and d.maybe(0.2):
            d.height[i] = H = H * 0.9
            row["rim"] = Q(H, 1)
        row["level"] = d.level(i, 0.0 if d.maybe(0.1) else 0.1)
        rig["tank"].append(row)
    d.names = [row["name"] for row in rig["tank"]]


def _openings(d, rig):
    d.simple = d.maybe(0.5)  # no ports, exponents or linear outlets
    order = [int(i) for i in d.s.permutation(d.n)]
    links, pipes = [], []
    for a, b in zip(order, order[1:]):
        kind = d.choose("orifice", "pipe", "none", p=[0.5, 0.3, 0.2])
        links += [(a, b)] if kind == "orifice" else []
        pipes += [(a, b)] if kind == "pipe" else []
    if d.n > 2 and d.maybe(0.2):
        links.append((order[-1], order[0]))
    sources = {a for a, _ in links}
    port = lambda i: Q(d.height[i] * d.share(0.0, 0.25), 1)
    for i, row in enumerate(rig["tank"]):
        if i in sources and d.maybe(0.6):
            continue
        row["drain"] = d.opening(d.choose(0.5, 1.0))
        if not d.simple:
            if d.maybe(0.3):
                row["drain_port"] = port(i)
            if d.maybe(0.25):
                row["drain_linear"] = Q(d.near(d.height[i] / d.flow), -2, 1)
            if d.maybe(0.25):  # the flow is area sqrt(2 g) head^exponent in the rig's own numbers
                row["drain_exponent"] = exponent = d.choose(0.4, 0.7, 1.0, 1.5)
                row["drain"] = Q(row["drain"].value, 2.5 - exponent)
    rig["orifice"] = []
    for a, b in links:
        row = {"from": d.tank(a), "to": d.tank(b), "area": d.opening()}
        if not d.simple and d.maybe(0.3):
            row["port"] = port(a)
        if not d.simple and d.maybe(0.2):
            row["linear"] = Q(d.near(d.height[a] / d.flow), -2, 1)
        if not d.simple and d.maybe(0.2):
            row["exponent"] = exponent = d.choose(0.4, 0.7, 1.0, 1.5)
            row["area"] = Q(row["area"].value, 2.5 - exponent)
        rig["orifice"].append(row)
    rig["pipe"] = []
    for a, b in pipes:
        row = {"between": [d.tank(a), d.tank(b)], "area": d.opening()}
        if not d.simple and d.maybe(0.3):
            row["port"] = Q(min(d.height[a], d.height[b]) * d.share(0.0, 0.25), 1)
        rig["pipe"].append(row)
    rig["spill"] = []
    if d.n > 1 and d.maybe(0.2):
        a, b = order[0], order[1]
        row = {"from": d.tank(a), "to": d.tank(b), "caught": d.share(0.2, 1.0)}
        if d.maybe(0.4):
            row["port"] = Q(d.height[a] * d.share(0.5, 0.95), 1)
        rig["spill"].append(row)


def _inputs(d, rig):
    """Pumps and valves; d.inputs: [(tank that it acts on, 1 or -1, whether a valve)]."""
    m = int(d.choose(1, 2, p=[0.65, 0.35])) if d.n > 1 else 1
    ends = [int(i) for i in d.s.permutation(d.n)[:m]]
    kinds = [d.choose("pump", "valve", p=[0.8, 0.2]) for _ in ends]
    order = sorted(range(m), key=lambda j: kinds[j] == "valve")
    rig["pump"], rig["valve"], d.inputs = [], [], []
    for j in order:
        i = ends[j]
        others = [k for k in range(d.n) if k != i]
        other = int(d.s.choice(others)) if others else None
        valve = kinds[j] == "valve"
        share = lambda v, valve=valve: Q(v, 0, 0, 1, valve)
        row: dict[str, Any] = {"name": f"{'FV' if valve else 'P'}{len(d.inputs) + 1}"}
        if valve:
            _valve(d, row, i, other)
            sign = -1
        else:
            sign = _pump(d, row, i, other)
            row["high"] = share(d.share(0.8, 1.0) if d.maybe(0.3) else 1.0)
        if d.maybe(0.15):
            row["low"] = share(d.share(0.0, 0.2))
        row["initial"] = share(d.share(0.2, 0.7))
        if d.maybe(0.12):
            row["dead_zone"] = share(d.share(0.0, 0.1))
        if d.maybe(0.15):
            row["rate"] = Q(d.near(5.0 / d.tau), 0, -1, 1, valve)
        if d.maybe(0.15):
            row["lag"] = Q(d.near(0.1 * d.tau), 0, 1)
        if d.maybe(0.15):
            row["delay"] = Q(d.dt * int(d.choose(1, 2, 5)), 0, 1)
        rig["valve" if valve else "pump"].append(row)
        d.inputs.append((i, sign, valve))
    d.outputs = [i for i, *_ in d.inputs]
    for i, sign, _ in d.inputs:
        if sign < 0:  # something must fill it
            rig["tank"][i]["inflow"] = Q(d.near(d.flow), 3, -1)


def _valve(d, row, i, other):
    row |= {"from": d.tank(i)}
    if other is not None and d.maybe(0.3):
        row["to"] = d.tank(other)
        if d.maybe(0.4):
            row["check"] = True
    row["area"] = d.opening(2.0)
    kind = d.choose("linear", "equal-percentage", "curve")
    if kind == "equal-percentage":
        row["characteristic"] = kind
        if d.maybe(0.5):
            row["rangeability"] = d.share(10.0, 60.0)
    elif kind == "curve":
        row["characteristic"] = [[0.0, 0.0], [0.5, d.fixed(0.1, 0.6)], [1.0, 1.0]]
    if not d.simple and d.maybe(0.3):
        row["port"] = Q(d.height[i] * d.share(0.0, 0.2), 1)


def _pump(d, row, i, other):
    """Add the keys of a pump that acts on tank i; return whether it fills or empties it."""
    sign = 1
    if other is not None and d.maybe(0.2):
        row |= {"to": [d.tank(i), d.tank(other)], "split": d.share(0.3, 0.9)}
    elif d.maybe(0.15):
        row |= {"from": d.tank(i)}
        if other is not None and d.maybe(0.6):
            row["to"] = d.tank(other)
        sign = -1
    else:
        row["to"] = d.tank(i)
        if other is not None and d.maybe(0.1):
            row["from"] = d.tank(other)
    full = d.near(2.5 * d.flow)
    if d.maybe(0.2):
        full = 2.5 * d.usual_flow
        points = [(0.0, 0.0), (0.4, full * d.fixed(0.2, 0.5)), (1.0, full)]
        row["curve"] = [[Q(u, 0, 0, 1), Q(q, 3, -1)] for u, q in points]
    else:
        row["gain"] = Q(full, 3, -1, -1)
    if d.maybe(0.12):
        H = 1.2
        points = [(-H, 1.1), (0.0, 1.0), (2 * H, d.fixed(0.3, 0.8))]
        row["curve_head"] = [[Q(h, 1), share] for h, share in points]
    return sign


def _sensors(d, rig):
    noisy = d.maybe(0.3)
    d.readings = {}
    if d.maybe(0.7):
        for i, row in enumerate(rig["tank"]):
            if noisy:
                row["noise"] = Q(d.height[i] * d.share(0.0, 0.005), 1)
        return
    rig["sensor"] = []
    for i in range(d.n):
        row: dict[str, Any] = {"tank": d.tank(i)}
        if noisy:
            row["noise"] = Q(d.height[i] * d.share(0.0, 0.005), 1)
        if d.maybe(0.5):
            span = d.choose((0.0, 1.0), (0.0, 1.1), (-0.1, 0.95))
            span = tuple(end * d.height[i] for end in span)
            row["span"] = [Q(end, 1) for end in span]
            if d.maybe(0.5):
                d.readings[i] = span, d.choose("%", "mA")
                row["unit"] = d.readings[i][1]
        if d.maybe(0.2):
            row["offset"] = Q(d.height[i] * d.share(-0.02, 0.02), 1)
        if d.maybe(0.2):
            row["scale"] = d.share(0.97, 1.03)
        elif d.maybe(0.15):
            points = [(0.0, 0.0), (0.5, d.share(0.45, 0.55)), (1.0, 1.0)]
            row["curve"] = [[Q(a * d.height[i], 1), Q(b * d.height[i], 1)] for a, b in points]
        rig["sensor"].append(row)
    if d.maybe(0.3):
        rig["values"] = {"sensor.bits": d.choose(8, 12, 16)}


def _options(d, rig):
    if d.maybe(0.12) and any("dead_zone" in row for row in rig["pump"] + rig["valve"]):
        kind = d.choose("plain", "offset", "hysteresis", "pulse")
        rig.setdefault("values", {})["actuator.dead_zone_kind"] = kind
    if d.maybe(0.4):
        rig["plant"]["overflow"] = d.maybe(0.7)
    if d.maybe(0.25):
        rig["plant"]["bottom"] = d.maybe(0.8)
    if d.maybe(0.1):
        rig["plant"]["gravity"] = Q(d.share(9.7, 9.9), 1, -2)
    if d.maybe(0.1):
        rig["plant"]["knee"] = Q(d.fixed(1e-4, 4e-3), 1)


def without_noise(rig):
    """The rig with sensors without noise."""
    quiet = dict(rig)
    for title in ("tank", "sensor"):
        if title in rig:
            rows = [dict(row) for row in rig[title]]
            for row in rows:
                row |= {"noise": Q(0.0, 1)} if "noise" in row else {}
            quiet[title] = rows
    return quiet


NEEDED = {"name", "tank", "from", "to", "between", "of", "sensor", "kind", "start", "end", "every"}
NEEDED |= {
    *("csv", "column", "time", "duration", "volume", "diameter", "length", "shape", "size"),
    "split",
}
WHOLE = ("inflow", "fault", "spill", "orifice", "pipe", "observer", "reference.sine")
WHOLE += ("safety_filter", "disturbance", "uncertain", "limits")
JUDGING = ("limits", "uncertain", "disturbance")  # no run depends on these


def without_a_key(rig, seed):
    """(name of a key or table that is taken away at random, the rig without it)."""
    rng = np.random.default_rng([seed, 6])
    places = [(title, None, None) for title in WHOLE if title in rig and title not in JUDGING]
    for title, rows in rig.items():
        if title in ("schedule", "reference.sine", "reachable", "files", *JUDGING):
            continue
        many = rows if isinstance(rows, list) else [rows]
        places += [(title, k, key) for k, row in enumerate(many) for key in row]
    places = [p for p in places if p[2] not in NEEDED and "clock" not in str(p[2])]
    if not places:
        return None, rig
    title, k, key = places[int(rng.integers(len(places)))]
    changed = {name: rows for name, rows in rig.items() if key or name != title}
    if key is not None and isinstance(rig[title], list):
        changed[title] = [dict(row) for row in rig[title]]
        del changed[title][k][key]
    elif key is not None:
        changed[title] = {name: v for name, v in rig[title].items() if name != key}
    kind = f" ({rig['controller']['kind']})" if title == "controller" else ""
    return f"{title}.{key or '*'}{kind}", changed

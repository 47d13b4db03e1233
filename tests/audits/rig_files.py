"""Random rig files for the attacks on the safety filter: tables as a user can write them, drawn
over all that a rig file can describe. A rig has a topology and 0 to 3 further features.
"""

import numpy as np

FEATURES = (
    *("low above 0", "low below 0", "initial", "initial beyond limits", "plain dead zone"),
    *("offset dead zone", "hysteresis", "pulse dead zone", "equal lags", "different lags"),
    *("dead time", "spill", "spill ring", "overflow", "own limit", "limit above rim", "low limit"),
    *("bottom", "inflow", "leak", "inflow pulses", "pulses that draw", "fault", "uncertain lag"),
    *("uncertain noise", "uncertain instruments", "uncertain inflow", "uncertain areas"),
    *("uncertain start", "covariance", "noise", "sensor offset", "ADC", "own band", "own rate"),
    *("no prediction", "no box", "wide box", "own widths", "start above limit", "even start"),
    *("split pumps", "several pumps"),
)
TOPOLOGIES = ("single", "chain", "ring", "tree", "orifices", "pipes", "quadruple")
LIQUID = ("inflow", "leak", "inflow pulses", "pulses that draw")
DEAD_ZONES = ("plain dead zone", "offset dead zone", "hysteresis", "pulse dead zone")


def draw(seed, low=False):
    """(table of a rig file, names of its features) of a random rig; low: with low limits."""
    rng = np.random.default_rng([seed, int(low)])
    topology = str(rng.choice(TOPOLOGIES, p=[0.1, 0.25, 0.15, 0.15, 0.15, 0.1, 0.1]))
    count = int(rng.choice(4, p=[0.25, 0.35, 0.25, 0.15]))
    features = [str(f) for f in rng.choice(FEATURES, count, replace=False)]
    features += ["low limit"] * (low and "low limit" not in features)
    for group in (LIQUID, DEAD_ZONES):  # a file holds one of them
        features = [f for f in features if f not in group[1:] or not set(group[:1]) & {*features}]
    features = _one_of(_one_of(features, LIQUID), DEAD_ZONES)
    table = _tanks(rng, topology, features)
    for name in features:
        if name in ADDITIONS:
            ADDITIONS[name](rng, table)
    _box(rng, table, features)
    return table, (topology, *features)


def _one_of(features, group):
    """`features` with the first of a group only."""
    first = next((f for f in features if f in group), None)
    return [f for f in features if f == first or f not in group]


def _pairs(rng, topology, n):
    """[(from, to)] of orifices and [(one, other)] of pipes, from 0."""
    chain = list(rng.permutation(n))
    pairs = list(zip(chain, chain[1:]))
    if topology == "ring":
        return [*pairs, (chain[-1], chain[0])] if n > 1 else [], []
    if topology == "tree":
        return [(chain[k], chain[int(rng.integers(k))]) for k in range(1, n)], []
    if topology == "orifices":
        every = [(i, j) for i in range(n) for j in range(n) if i != j]
        return [p for p in every if rng.random() < 0.4], []
    if topology == "pipes":
        links = [p for p in pairs if rng.random() < 0.5]
        return links, [p for p in pairs if p not in links]
    if topology == "quadruple":
        return [(2, 0), (3, 1)], []
    return pairs, []


def _tanks(rng, topology, features):
    """Tables of tanks, what joins them, and pumps."""
    n = 1 if topology == "single" else 4 if topology == "quadruple" else int(rng.integers(2, 6))
    rim = rng.uniform(15.0, 40.0, n)
    area = rng.uniform(10.0, 60.0, n) if rng.random() < 0.6 else np.full(n, rng.uniform(10.0, 60.0))
    closed = rng.random(n) < 0.25
    drain = np.where(closed, 0.0, rng.uniform(0.05, 0.6, n))
    links, pipes = _pairs(rng, topology, n)
    share = rng.uniform(0.02, 0.9, n) * (rng.uniform(0.02, 1.0) if rng.random() < 0.5 else 1.0)
    if "even start" in features:
        share = rng.uniform(0.05, 0.95) * np.ones(n)
    table = {
        "tank": [
            {"area": float(a), "rim": float(r), "drain": float(d), "level": float(s * r)}
            for a, r, d, s in zip(area, rim, drain, share)
        ],
        "orifice": [
            {"from": int(i) + 1, "to": int(j) + 1, "area": float(rng.uniform(0.05, 0.4))}
            for i, j in links
        ],
        "pipe": [
            {"between": [int(i) + 1, int(j) + 1], "area": float(rng.uniform(0.05, 0.4))}
            for i, j in pipes
        ],
        "plant": {},
        "reachable": False,
        "pump": _pumps(rng, topology, features, links, n),
        "values": {"clock.dt": float(rng.choice([0.1, 0.25, 0.5]))},
        "safety_filter": {},
    }
    table["plant"]["outputs"] = [int(rng.integers(n)) + 1]
    table["controller"] = {"kind": "open-loop", "initial": [0.0] * len(table["pump"])}
    table["values"] |= {"clock.duration": 600.0, "clock.substeps": int(rng.choice([1, 4]))}
    return {name: part for name, part in table.items() if part != []}


def _pumps(rng, topology, features, links, n):
    """Tables of one to four pumps; half of the rigs have them on tanks without inflow only."""
    below = {int(j) for _, j in links}
    tops = [i for i in range(n) if i not in below] or [0]
    free = tops if rng.random() < 0.5 else list(range(n))
    pumps = []
    for _ in range(int(rng.integers(1, 4))):
        first = int(rng.choice(free))
        if "several pumps" in features and pumps:
            first = pumps[0]["first"]
        pump = {"gain": float(rng.uniform(2.0, 20.0)), "low": 0.0, "initial": 0.0}
        pump |= {"high": float(rng.choice([5.0, 10.0, 12.0])), "first": first, "to": first + 1}
        others = [i for i in range(n) if i != first]
        split = 0.7 if "split pumps" in features or topology == "quadruple" else 0.2
        if others and rng.random() < split:
            pump |= {"to": [first + 1, int(rng.choice(others)) + 1]}
            pump |= {"split": float(rng.uniform(0.1, 0.9))}
        pumps.append(pump)
    return [{key: v for key, v in pump.items() if key != "first"} for pump in pumps]


def _box(rng, table, features):
    """What is uncertain: some flows, unless the features say otherwise."""
    if "no box" in features or "covariance" in features:
        if "no box" in features:
            table["safety_filter"]["widths"] = {}
        return
    flows = {"drain": "tank", "orifice": "orifice", "pipe": "pipe", "pump_gain": "pump"}
    have = [name for name, part in flows.items() if part in table]
    if any("split" in pump for pump in table["pump"]):
        have.append("split")
    if "own widths" in features:
        keys = {"pump_gain": ("pump", "gain"), "drain": ("tank", "drain")}
        for name, (part, key) in keys.items():
            half = [float(0.1 * p[key]) for p in table[part]]
            table["safety_filter"].setdefault("widths", {})[f"plant.{name}"] = half
        return
    if rng.random() < 0.4 and "uncertain" not in table and "wide box" not in features:
        return  # 5 % of every flow
    share = 0.3 if "wide box" in features else float(rng.choice([1e-4, 0.02, 0.05, 0.1]))
    names = [f"plant.{name}" for name in have if rng.random() < 0.8]
    table.setdefault("uncertain", {}).update(dict.fromkeys(names, share))


def _values(table, **values):
    table["values"] |= {name.replace("__", "."): v for name, v in values.items()}


def _each(rng, table, part, low, high):
    """A list of random numbers, one for each entry of a part."""
    return [float(v) for v in rng.uniform(low, high, len(table[part]))]


def _sensor(table, **keys):
    n = len(table["tank"])
    sensor = table.setdefault("sensor", {"kind": "level", "noise": [0.0] * n})
    sensor.update(keys)


def _of_pumps(key, value):
    """Return (rng, table): sets a key of every pump to a number or to value(rng, pump)."""

    def addition(rng, table):
        for pump in table["pump"]:
            pump[key] = float(value(rng, pump))

    return addition


def _dead_zone(kind):
    def addition(rng, table):
        _values(table, actuator__dead_zone=_each(rng, table, "pump", 0.3, 2.0))
        _values(table, actuator__dead_zone_kind=kind)
        if kind == "hysteresis":
            _values(table, actuator__stop=_each(rng, table, "pump", 0.0, 0.3))

    return addition


def _equal_lags(rng, table):
    lag = float(rng.choice([0.05, 0.3, 1.0, 3.0]))
    _values(table, actuator__lag=[lag] * len(table["pump"]))
    _slower(rng, table)


def _different_lags(rng, table):
    lags = np.exp(rng.uniform(np.log(0.01), np.log(3.0), len(table["pump"])))
    _values(table, actuator__lag=[float(v) for v in lags])
    _slower(rng, table)


def _slower(rng, table):
    """Wider tanks, so that what full pumps bring within a lag is less than a tank."""
    for tank in table["tank"]:
        tank["area"] *= 4.0


def _dead_time(rng, table):
    samples = int(rng.choice([1, 2, 3, 8, 20]))
    _values(table, actuator__delay=samples * table["values"]["clock.dt"])
    _slower(rng, table)
    for tank in table["tank"]:
        tank["level"] *= float(rng.choice([0.02, 0.3, 1.0]))


def _spill(ring):
    def addition(rng, table):
        n, order = len(table["tank"]), [int(i) for i in rng.permutation(len(table["tank"]))]
        pairs = list(zip(order, order[1:]))[: int(rng.integers(1, 4))]
        pairs += [(pairs[-1][1], order[0])] if ring and n > 1 else []
        if n > 1:
            caught = [float(rng.choice([0.3, 1.0])) for _ in pairs]
            table["spill"] = [
                {"from": i + 1, "to": j + 1, "caught": c} for (i, j), c in zip(pairs, caught)
            ]
        table["plant"]["overflow"] = True

    return addition


def _own_limit(low, high):
    def addition(rng, table):
        if rng.random() < 0.5 or high > 1.0:
            limits = [float(t["rim"] * rng.uniform(low, high)) for t in table["tank"]]
            table["safety_filter"]["limit"] = limits
        else:
            limits = [float(t["rim"] * rng.uniform(low, high)) for t in table["tank"]]
            table["limits"] = {"max_level": limits}

    return addition


def _low_limit(rng, table):
    for tank in table["tank"]:
        tank["level"] = max(tank["level"], 0.15 * tank["rim"])
    low = [float(t["level"] * rng.uniform(0.0, 0.6)) for t in table["tank"]]
    table["safety_filter"]["low"] = low
    for pump in table["pump"]:
        pump["gain"] *= 3.0


def _inflow(low, high):
    def addition(rng, table):
        for tank in table["tank"]:
            tank["inflow"] = float(rng.uniform(low, high) * (rng.random() < 0.5))

    return addition


def _pulses(low, high):
    def addition(rng, table):
        for tank in table["tank"]:
            tank.pop("inflow", None)
        table["inflow"] = [
            {
                "time": float(rng.uniform(0.0, 60.0)),
                "duration": float(rng.uniform(0.2, 5.0)),
                "tank": int(rng.integers(len(table["tank"]))) + 1,
                "volume": float(rng.uniform(low, high)),
            }
            for _ in range(int(rng.integers(1, 4)))
        ]

    return addition


def _fault(rng, table):
    parts = {"drain": "tank", "orifice": "orifice", "pump_gain": "pump", "pipe": "pipe"}
    name = str(rng.choice([f for f, part in parts.items() if part in table]))
    start = float(rng.uniform(1.0, 30.0))
    fault = {"of": f"{name}[{int(rng.integers(len(table[parts[name]])))}]", "start": start}
    factor = float(rng.choice([0.3, 0.6, 1.5]))
    table["fault"] = [fault | {"end": start + float(rng.uniform(5.0, 60.0)), "factor": factor}]


def _uncertain(*names):
    """Return (rng, table): shares of some of the parameters `names` that the rig has."""

    def addition(rng, table):
        have = [n for n in names if _there(table, n)]
        if not have:
            return
        name = str(rng.choice(have))
        table.setdefault("uncertain", {})[name] = float(rng.choice([0.1, 0.3, 0.9]))

    return addition


def _there(table, name):
    """Whether the rig of a table has the parameter `name`."""
    part, _, field = name.partition(".")
    if part == "sensor":
        return field in table.get("sensor", {"noise": 0}) or field == "noise"
    if part == "actuator":
        return field in ("low", "high", "initial") or name in table["values"]
    if part == "disturbance":
        return "inflow" in table if field == "volume" else _inflow_there(table)
    return "fault" in table if part == "faults" else True


def _inflow_there(table):
    return any(tank.get("inflow") for tank in table["tank"])


def _uncertain_lag(rng, table):
    _equal_lags(rng, table)
    table.setdefault("uncertain", {})["actuator.lag"] = float(rng.choice([0.3, 0.9]))


def _uncertain_noise(rng, table):
    _noise(rng, table)
    table.setdefault("uncertain", {})["sensor.noise"] = float(rng.choice([0.3, 0.9]))


def _uncertain_instruments(rng, table):
    names = ("low", "high", "initial", "dead_zone", "lag")
    table["pump"][0]["low"] = 0.5
    table["pump"][0]["initial"] = 2.0
    _uncertain(*(f"actuator.{n}" for n in names), "sensor.offset", "sensor.gain")(rng, table)


def _uncertain_inflow(rng, table):
    if "inflow" not in table and not _inflow_there(table):
        _inflow(0.0, 25.0)(rng, table)
    _uncertain("disturbance.level", "disturbance.volume")(rng, table)


def _noise(rng, table):
    _sensor(table, noise=_each(rng, table, "tank", 0.0, 0.1))


def _sensor_offset(rng, table):
    _sensor(table, offset=_each(rng, table, "tank", -0.4, 0.4))


def _adc(rng, table):
    top = [float(t["rim"] * rng.choice([0.7, 1.3])) for t in table["tank"]]
    _sensor(table, gain=[t / 5.0 for t in top], full_scale=5.0, bits=int(rng.choice([6, 10])))


def _own_band(rng, table):
    table["safety_filter"]["band"] = _each(rng, table, "tank", 0.0, 0.6)


def _own_rate(rng, table):
    table["safety_filter"]["rate"] = float(rng.choice([0.05, 0.3, 1.0, 2.0, 5.0]))


def _covariance(rng, table):
    names, values = ["plant.pump_gain[0]"], [table["pump"][0]["gain"]]
    if table["tank"][0]["drain"] > 0.0:
        names, values = [*names, "plant.drain[0]"], [*values, table["tank"][0]["drain"]]
    if "actuator.lag" in table["values"] and rng.random() < 0.5:
        names.append("actuator.lag[0]")
        values.append(table["values"]["actuator.lag"][0])
    sigma = np.array(values) * rng.uniform(0.01, 0.1)
    rho = rng.uniform(-0.5, 0.9) if len(values) == 2 else 0.0
    matrix = np.outer(sigma, sigma) * (rho + (1.0 - rho) * np.eye(len(values)))
    table["covariance"] = {"names": names, "matrix": matrix.tolist()}


def _start_above(rng, table):
    tank = table["tank"][int(rng.integers(len(table["tank"])))]
    limit = [t["rim"] for t in table["tank"]]
    tank["rim"] *= 2.0
    tank["level"] = 0.9 * tank["rim"]
    table["safety_filter"]["limit"] = limit


ADDITIONS = {
    "low above 0": _of_pumps("low", lambda rng, pump: rng.uniform(0.1, 1.5)),
    "low below 0": _of_pumps("low", lambda rng, pump: rng.uniform(-3.0, -0.5)),
    "initial": _of_pumps("initial", lambda rng, pump: rng.uniform(0.0, 1.0) * pump["high"]),
    "initial beyond limits": _of_pumps(
        "initial", lambda rng, pump: rng.uniform(1.0, 8.0) * pump["high"]
    ),
    "plain dead zone": _dead_zone("plain"),
    "offset dead zone": _dead_zone("offset"),
    "hysteresis": _dead_zone("hysteresis"),
    "pulse dead zone": _dead_zone("pulse"),
    "equal lags": _equal_lags,
    "different lags": _different_lags,
    "dead time": _dead_time,
    "spill": _spill(ring=False),
    "spill ring": _spill(ring=True),
    "overflow": lambda rng, table: table["plant"].update(overflow=True),
    "own limit": _own_limit(0.4, 0.95),
    "limit above rim": _own_limit(1.05, 1.4),
    "low limit": _low_limit,
    "bottom": lambda rng, table: table["plant"].update(bottom=True),
    "inflow": _inflow(0.0, 25.0),
    "leak": _inflow(-25.0, 0.0),
    "inflow pulses": _pulses(5.0, 100.0),
    "pulses that draw": _pulses(-60.0, 40.0),
    "fault": _fault,
    "uncertain lag": _uncertain_lag,
    "uncertain noise": _uncertain_noise,
    "uncertain instruments": _uncertain_instruments,
    "uncertain inflow": _uncertain_inflow,
    "uncertain areas": _uncertain("plant.area", "plant.gravity", "plant.area[0]"),
    "uncertain start": _uncertain("x0"),
    "covariance": _covariance,
    "noise": _noise,
    "sensor offset": _sensor_offset,
    "ADC": _adc,
    "own band": _own_band,
    "own rate": _own_rate,
    "no prediction": lambda rng, table: table["safety_filter"].update(predict=False),
    "start above limit": _start_above,
}
"""{feature: function (rng, table)} that adds it to a rig."""

"""References, disturbances, faults and limits of `drawn_rigs`."""

from rig_text import PerTank, Q


def event_times(d, channels, most=4):
    """[(time, channel)] in order, at samples and between them, one at least."""
    count = int(d.choose(1, 2, most))
    times = sorted(float(t) for t in d.s.uniform(0.05, 0.9, count) * d.end)
    if d.maybe(0.6):
        times = sorted({round(t / d.dt) * d.dt for t in times})
    return [(t, int(d.s.integers(channels))) for t in times]


def add_reference(d, rig):
    """Add [reference]: changes, ramps, filters, a sine, gains that follow it."""
    outputs = d.outputs
    row = {"initial": [d.read(i, 0.25, 0.6) for i in outputs]}
    if d.maybe(0.8):
        row["changes"] = [
            [Q(t, 0, 1), d.choose(j + 1, d.names[outputs[j]]), d.read(outputs[j], 0.2, 0.75)]
            for t, j in event_times(d, len(outputs))
        ]
        if d.maybe(0.4):
            row["ramp"] = Q(d.dt * d.choose(5.0, 12.7), 0, 1)
            row["shape"] = d.choose("linear", "quintic")
        elif d.maybe(0.2):
            row["filter"] = [Q(d.near(5 * d.dt), 0, 1) for _ in outputs]
        if d.maybe(0.15):
            row["band"] = d.fixed(0.01, 0.1)
    if len(outputs) == 1 and "changes" in row and "ramp" not in row and d.maybe(0.15):
        rows = [[Q(0.0, 0, 1), 1, row.pop("initial")[0]], *row.pop("changes")]
        if all(isinstance(level, Q) for *_, level in rows):
            lines = [f"{t.value!r},{1000.0 * level.value!r}" for t, _, level in rows]
            rig["files"] = {"sp.csv": "t [s],SP [mm]\n" + "\n".join(lines) + "\n"}
            row |= {"csv": "sp.csv", "column": "SP"}
        else:
            row |= {"initial": [rows[0][2]], "changes": rows[1:]}
    rig["reference"] = row
    if d.maybe(0.15):
        rig["reference.sine"] = {
            "amplitude": Q(0.1 * d.height[outputs[0]] * d.share(), 1),
            "period": Q(d.end * d.choose(0.2, 0.37), 0, 1),
            "output": 1,
        }
        if d.maybe(0.3):
            rig["reference.sine"]["offset"] = Q(0.05 * d.height[outputs[0]] * d.share(-1.0), 1)
        if d.maybe(0.3):
            rig["reference.sine"]["zero"] = Q(0.1 * d.end, 0, 1)
        if d.maybe(0.5):
            rig["reference.sine"] |= {"start": Q(0.3 * d.end, 0, 1), "end": Q(0.8 * d.end, 0, 1)}
    if d.kind in ("p", "pi", "pid") and d.maybe(0.12):
        variable = d.choose("r1", "h1" if d.outputs[0] == 0 and d.n == 1 else "r1")
        rig["schedule"] = {
            "variable": variable,
            "knots": [Q(s * d.height[outputs[0]], 1) for s in (0.2, 0.5, 0.8)],
            "gains": ["controller.Kc"],
        }


def add_disturbances(d, rig):
    """Add pulses and tables of inflow."""
    pulses = []
    if d.maybe(0.3):
        for t, i in event_times(d, d.n, 2):
            volume = 0.15 * d.area[i] * d.height[i] * d.share(-0.2, 1.0)
            row = {"time": Q(t, 0, 1), "duration": Q(d.dt * d.choose(0.4, 3.0, 8.5), 0, 1)}
            pulses.append(row | {"tank": d.tank(i), "volume": Q(volume, 3)})
        if d.maybe(0.3):
            rig["disturbance"] = {"window": Q(10.0 * d.dt, 0, 1)}
    if d.maybe(0.2):
        i = int(d.s.integers(d.n))
        times = [0.0, *(d.end * f for f in (0.3, 0.55))]
        changes = [[Q(t, 0, 1), Q(0.4 * d.flow * d.share(-0.2, 1.0), 3, -1)] for t in times]
        row = {"tank": d.tank(i), "changes": changes}
        if d.maybe(0.5):
            row["interpolate"] = d.choose("hold", "linear")
        pulses.append(row)
    rig["inflow"] = pulses
    if d.maybe(0.25):
        i = int(d.s.integers(d.n))
        rig["tank"][i].setdefault("inflow", Q(d.flow * d.share(-0.1, 0.5), 3, -1))


def add_faults(d, rig):
    """Add faults of the plant and of sensors."""
    rig["fault"] = []
    for _ in range(int(d.choose(0, 1, 2, p=[0.65, 0.2, 0.15]))):
        start, end = sorted(float(t) for t in d.s.uniform(0.1, 1.0, 2) * d.end)
        row = {"start": Q(start, 0, 1), "end": Q(end, 0, 1)}
        i = int(d.s.integers(d.n))
        what = d.choose(
            "input", "drain", "leak", "rim", "offset", "drift", "freeze", "spikes", "noise"
        )
        if what == "input":
            names = [p["name"] for p in [*rig["pump"], *rig["valve"]]]
            row |= {"of": names[int(d.s.integers(len(names)))], "factor": d.share(0.2, 1.3)}
        elif what == "drain":
            row |= {"of": f"{d.names[i]}.drain", "factor": d.share(0.0, 1.5)}
        elif what == "leak":
            exponent = rig["tank"][i].get("drain_exponent", 0.5)
            extra = Q(d.opening(0.5).value, 2.5 - exponent)
            row |= {"of": f"drain.{d.names[i]}", "extra": extra}
        elif what == "rim":
            row |= {"of": f"{d.names[i]}.rim", "factor": d.share(0.6, 0.95)}
        else:
            size = d.height[i] * d.share(0.005, 0.06)
            row |= {"sensor": d.tank(i), "kind": what}
            if what == "drift":
                row["size"] = Q(size / (end - start), 1, -1)
            elif what != "freeze":
                row["size"] = Q(size if what != "noise" else 0.1 * size, 1)
            if what == "spikes":
                row["every"] = Q(d.dt * d.choose(3.0, 7.5), 0, 1)
        rig["fault"].append(row)


def add_judged(d, rig):
    """Add what a run is judged by, and the safety filter."""
    if d.maybe(0.3):
        limits = {f"max_level.{d.names[i]}": d.level(i, 0.7, 1.0) for i in range(d.n)}
        rig["limits"] = limits if d.maybe(0.5) else {"max_level": PerTank(limits.values())}
    if d.maybe(0.2):
        rig["uncertain"] = {"plant.area": d.share(0.01, 0.1)}
        if rig["pump"]:
            rig["uncertain"]["plant.pump_gain"] = d.share(0.01, 0.1)
    curved = any(
        "curve" in row or "characteristic" in row
        for title in ("pump", "valve", "sensor")
        for row in rig.get(title, [])
    )
    if d.maybe(0.02 if curved else 0.15):
        rig["safety_filter"] = {}
        if d.maybe(0.6):
            rig["safety_filter"]["limit"] = PerTank(d.level(i, 0.75, 0.98) for i in range(d.n))
        if d.maybe(0.3):
            rig["safety_filter"]["rate"] = Q(d.near(2 / d.tau), 0, -1)
        if d.maybe(0.3):
            rig["safety_filter"]["predict"] = d.maybe(0.5)
        if d.maybe(0.3):
            rig["safety_filter"]["low"] = PerTank(d.level(i, 0.02, 0.1) for i in range(d.n))
        if d.maybe(0.3):
            rig["safety_filter"]["band"] = PerTank(
                Q(d.height[i] * d.share(0.001, 0.02), 1) for i in range(d.n)
            )
        if d.maybe(0.3):
            rig["safety_filter"]["widths"] = {"plant.area": Q(d.share(0.001, 0.02), 2)}
        if not rig["safety_filter"]:
            rig["safety_filter"]["predict"] = True

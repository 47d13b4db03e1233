"""Flows of a rig of `drawn_rigs` by formulas in numpy; each sample of a run from the one before.

Nothing of the plant of the package is used: volumes, Torricelli's law with the laminar part below
the knee, pumps, valves, overflow, inflows and faults are written from their definitions, in m and
s, for all samples of a run at once.
"""

import math

import numpy as np
from outlet_attacks import share_of

FINE = 48
"""Steps in a sample of the reference."""
FLOOR, TOP = 0.03, 0.97
"""Shares of a tank between which a sample is compared: tips and empty tanks are left out."""


class Tank:
    """Volume and section of a [[tank]] at levels."""

    def __init__(self, row):
        value = lambda key: row[key].value
        kind = row.get("shape", "prism")
        self.kind = kind if isinstance(kind, str) else "table"
        if self.kind == "prism":
            self.rim = value("rim") if "rim" in row else value("height") if "height" in row else 0.0
            self.area = value("area") if "area" in row else 0.0
            if "diameter" in row:
                self.area = math.pi / 4 * value("diameter") ** 2
            if "volume" in row:
                self.area = value("volume") / self.rim
            self.top = self.rim
        elif self.kind == "table":
            self.points = np.array([[h.value, a.value] for h, a in kind])
            self.top = self.points[-1, 0]
        else:
            self.top = value("height" if self.kind == "cone" else "diameter")
            self.size = value({"cone": "area", "sphere": "diameter"}.get(self.kind, "length"))
        self.rim = row["rim"].value if "rim" in row else self.top

    def section(self, h):
        """Cross-section at levels h."""
        y = np.clip(h / self.top, 1e-9, 1.0)
        if self.kind == "prism":
            return self.area + 0.0 * h
        if self.kind == "cone":
            return self.size * y**2
        if self.kind == "sphere":
            return math.pi * self.top**2 * y * (1.0 - y)
        if self.kind == "horizontal-cylinder":
            return self.size * self.top * 2.0 * np.sqrt(y * (1.0 - y))
        return np.interp(h, *self.points.T)

    def volume(self, h):
        """Volume at levels h."""
        y = np.clip(h / self.top, 0.0, 1.0)
        if self.kind == "prism":
            return self.area * h
        if self.kind == "cone":
            return self.size * self.top * y**3 / 3.0
        if self.kind == "sphere":
            return math.pi * self.top**3 * (y**2 / 2.0 - y**3 / 3.0)
        if self.kind == "horizontal-cylinder":
            r, c = self.top / 2.0, np.clip(1.0 - 2.0 * y, -1.0, 1.0)
            return self.size * r**2 * (np.arccos(c) - c * np.sqrt(1.0 - c**2))
        levels, areas = self.points.T
        inside = np.clip(h, 0.0, self.top)
        pieces = np.diff(levels) * 0.5 * (areas[1:] + areas[:-1])
        k = np.clip(np.searchsorted(levels, inside, "right") - 1, 0, len(levels) - 2)
        before = np.concatenate([[0.0], np.cumsum(pieces)])[k]
        return before + (inside - levels[k]) * 0.5 * (areas[k] + np.interp(inside, levels, areas))


def means(row, times, dt):
    """Mean inflow of a table of [[inflow]] over each sample."""
    t, q = (np.array([v.value for v in column]) for column in zip(*row["changes"]))
    if row.get("interpolate", "hold") == "linear":
        fine = times[:, None] + dt * (np.arange(2000) + 0.5) / 2000
        return np.interp(fine, t, q).mean(axis=1)
    volume = np.concatenate([[0.0], np.cumsum(q[:-1] * np.diff(t)), [1e9 * q[-1]]])
    volume[-1] += volume[-2]
    return np.diff(np.interp(np.append(times, times[-1] + dt), [*t, t[-1] + 1e9], volume)) / dt


class Plant:
    """A rig with its inflows and faults at the samples of a run."""

    def __init__(self, rig, clock, times):
        self.rig, self.tanks = rig, [Tank(row) for row in rig["tank"]]
        self.names = [row["name"] for row in rig["tank"]]
        options = rig.get("plant", {})
        gravity = options["gravity"].value if "gravity" in options else 9.81
        self.speed = math.sqrt(2.0 * gravity)
        self.knee = options["knee"].value if "knee" in options else 1e-4
        self.times, self.dt = times, clock.dt
        self.overflow = options.get("overflow", bool(rig.get("spill")))
        self.inflow = self._inflows()
        self.rims = [self.faulty(f"{n}.rim", t.rim) for n, t in zip(self.names, self.tanks)]

    def _inflows(self):
        rows = [np.zeros(len(self.times)) for _ in self.tanks]
        for row, tank in zip(rows, self.rig["tank"]):
            row += tank["inflow"].value if "inflow" in tank else 0.0
        for entry in self.rig.get("inflow", []):
            i = entry["tank"].index
            if "changes" in entry:
                rows[i] += means(entry, self.times, self.dt)
                continue
            start, lasts = entry["time"].value, entry["duration"].value
            begin = np.maximum(self.times, start)
            share = np.minimum(self.times + self.dt, start + lasts) - begin
            rows[i] += entry["volume"].value * np.maximum(share, 0.0) / (lasts * self.dt)
        return rows

    def faulty(self, name, value):
        """(samples,) a number of the plant, with the faults that are of it."""
        values = np.full(len(self.times), value)
        turned = ".".join(reversed(name.split(".")))
        for fault in self.rig.get("fault", []):
            if fault.get("of") in (name, turned):
                half = 1e-7 * self.dt
                on = (self.times >= fault["start"].value - half) & (
                    self.times < fault["end"].value - half
                )
                extra = fault["extra"].value if "extra" in fault else 0.0
                values = np.where(on, values * fault.get("factor", 1.0) + extra, values)
        return values

    def root(self, head, exponent=0.5):
        """Square root, or another power, of a head, laminar below the knee."""
        y = np.maximum(head, 0.0) / self.knee
        laminar = np.maximum(y * ((2.0 - exponent) + (exponent - 1.0) * y), 0.0)
        return np.where(y < 1.0, self.knee**exponent * laminar, np.maximum(head, 0.0) ** exponent)

    def signed(self, head):
        """Signed root of a difference of heads."""
        return head / (head * head + self.knee * self.knee) ** 0.25

    def streams(self, x, u):
        """[(source, sink, flow (samples,))] at levels and inputs."""
        value = lambda row, key, usual: row[key].value if key in row else usual
        for i, row in enumerate(self.rig["tank"]):
            head = np.maximum(x[i] - value(row, "drain_port", 0.0), 0.0)
            area = self.faulty(f"{row['name']}.drain", value(row, "drain", 0.0))
            yield i, None, area * self.speed * self.root(head, row.get("drain_exponent", 0.5))
            yield i, None, head / value(row, "drain_linear", math.inf)
        for row in self.rig.get("orifice", []):
            i, j = row["from"].index, row["to"].index
            head = np.maximum(x[i] - value(row, "port", 0.0), 0.0)
            power = self.root(head, row.get("exponent", 0.5))
            yield i, j, row["area"].value * self.speed * power
            yield i, j, head / value(row, "linear", math.inf)
        for row in self.rig.get("pipe", []):
            i, j = (tank.index for tank in row["between"])
            yield i, j, row["area"].value * self.speed * self.between(x, i, j, row)
        for k, row in enumerate(self.rig.get("pump", [])):
            yield from self.pumped(row, x, u[k])
        first = len(self.rig.get("pump", []))
        for k, row in enumerate(self.rig.get("valve", [])):
            yield self.valve(row, x, u[first + k])

    def between(self, x, i, j, row):
        """Signed root of the heads of two tanks above an opening below both surfaces."""
        port = row["port"].value if "port" in row else 0.0
        return self.signed(np.maximum(x[i] - port, 0.0) - np.maximum(x[j] - port, 0.0))

    def pumped(self, row, x, u):
        """The streams of a pump."""
        to = row.get("to", [])
        sinks = [tank.index for tank in (to if isinstance(to, list) else [to])] or [None]
        source = row["from"].index if "from" in row else None
        if "curve" in row:
            points = [(a.value, b.value) for a, b in row["curve"]]
            flow = share_of(points, u) * self.faulty(row["name"], 1.0)
        else:
            flow = u * self.faulty(row["name"], row["gain"].value)
        if "curve_head" in row:
            points = [(lift.value, share) for lift, share in row["curve_head"]]
            ends = (0.0 if i is None else x[i] for i in (sinks[0], source))
            flow = flow * share_of(points, next(ends) - next(ends))
        split = row.get("split", 1.0)
        for sink, share in zip(sinks, (split, 1.0 - split) if len(sinks) > 1 else (1.0,)):
            yield source, sink, share * flow

    def valve(self, row, x, u):
        """The stream of a valve."""
        kind = row.get("characteristic", "linear")
        share = u if kind == "linear" else share_of(kind, u) if isinstance(kind, list) else None
        if kind == "equal-percentage":
            share = row.get("rangeability", 50.0) ** (u - 1.0)
        i, j = row["from"].index, row["to"].index if "to" in row else None
        area = self.faulty(row["name"], row["area"].value) * share * self.speed
        if j is None:
            port = row["port"].value if "port" in row else 0.0
            return i, j, area * self.root(x[i] - port)
        flow = area * self.between(x, i, j, row)
        return i, j, np.maximum(flow, 0.0) if row.get("check") else flow

    def rates(self, x, u):
        """(net inflow of each tank, net inflow of the rig), each (samples,)."""
        net = [inflow.copy() for inflow in self.inflow]
        for source, sink, flow in self.streams(x, u):
            if source is not None:
                net[source] -= flow
            if sink is not None:
                net[sink] += flow
        return net

    def gives(self, x, u, h):
        """Largest share of its volume that a tank gives in a step h, of each sample."""
        leaving = [np.zeros(len(self.times)) for _ in x]
        for source, sink, flow in self.streams(x, u):
            for i, out in ((source, flow), (sink, -flow)):
                if i is not None:
                    leaving[i] += np.maximum(out, 0.0)
        return np.max([h * q / t.volume(v) for q, t, v in zip(leaving, self.tanks, x)], axis=0)

    def slopes(self, x, u):
        """Rates of the levels."""
        return [q / t.section(h) for q, t, h in zip(self.rates(x, u), self.tanks, x)]

    def step(self, x, u, h, midpoint):
        """Levels a step h later, without overflow."""
        move = lambda rates, by: [a + by * b for a, b in zip(x, rates)]
        a = self.slopes(x, u)
        b = self.slopes(move(a, h / 2), u)
        if midpoint:
            return move(b, h)
        c = self.slopes(move(b, h / 2), u)
        d = self.slopes(move(c, h), u)
        return move([(p + 2 * q + 2 * r + s) / 6 for p, q, r, s in zip(a, b, c, d)], h)

    def advance(self, x, u, steps, midpoint=False):
        """(levels after a sample, volume lost over each rim)."""
        x, lost = [v.copy() for v in x], [np.zeros(len(self.times)) for _ in x]
        for _ in range(steps):
            x = self.step(x, u, self.dt / steps, midpoint)
            if self.overflow:
                self.spill(x, lost)
        return x, lost

    def spill(self, x, lost):
        """Take what is above the rims, or the ports of overflows, out of x; to the tanks below."""
        spills = self.rig.get("spill", [])
        order = sorted(range(len(x)), key=lambda i: all(s["from"].index != i for s in spills))
        for i in order:
            brim = self.rims[i]
            for row in spills:
                if row["from"].index == i and "port" in row:
                    brim = np.minimum(brim, row["port"].value)
            tank = self.tanks[i]
            above = x[i] > brim
            excess = np.where(above, tank.volume(x[i]) - tank.volume(brim), 0.0)
            x[i] = np.where(above, brim, x[i])
            for row in spills:
                if row["from"].index == i:
                    j, caught = row["to"].index, row["caught"]
                    x[j] += caught * excess / self.tanks[j].section(x[j])
                    excess = (1.0 - caught) * excess
            lost[i] += excess


def _worst(off):
    """Index of the sample with the largest error above its tolerance; -1 where there is none."""
    return int(np.argmax(off)) if np.max(off, initial=0.0) > 0.0 else -1


def balance_errors(rig, run, clock):
    """Sentences where a sample of a Run does not follow from the one before."""
    times = clock.dt * np.arange(len(run.x) - 1)
    plant = Plant(rig, clock, times)
    x, u, after = list(run.x[:-1].T), list(run.u[:-1].T), run.x[1:].T
    with np.errstate(all="ignore"):
        fine, lost = plant.advance(x, u, FINE * clock.substeps)
        coarse, late = plant.advance(x, u, clock.substeps, clock.integrator == "midpoint")
        # a tank gives no more in a step than it holds
        step = clock.dt / clock.substeps
        usual = (plant.gives(x, u, step) < 0.5) & (plant.gives(list(after), u, step) < 0.5)
    for tank, before, later, end in zip(plant.tanks, x, after, coarse):
        most = np.inf if tank.kind == "prism" else TOP * tank.top
        for levels in (before, later, end):
            usual &= (levels > FLOOR * tank.rim) & (levels < most)
    # the plant integrates volumes of shaped tanks: of the same order, with errors of its own
    shaped = any(tank.kind != "prism" for tank in plant.tanks)
    moves = 1e-3 * shaped * np.max([np.abs(b - a) for a, b in zip(x, after)], axis=0)
    for i, tank in enumerate(plant.tanks):
        allowed = 4.0 * np.abs(fine[i] - coarse[i]) + 1e-7 * tank.rim + moves
        if plant.overflow:  # what falls from a rim within a step
            allowed = allowed + 0.02 * np.abs(after[i] - x[i])
        if (k := _worst(off := np.where(usual, np.abs(after[i] - fine[i]) - allowed, 0.0))) >= 0:
            yield (
                f"tank {i + 1} at {times[k]:.6g} s: {x[i][k]:.8g} -> {after[i][k]:.8g} m, and"
                f" {fine[i][k]:.8g} by its flows (coarse {coarse[i][k]:.8g}), in"
                f" {np.count_nonzero(off > 0)} of {np.count_nonzero(usual)} samples"
            )
    if plant.overflow:
        spilled = np.diff(run.spilled, axis=0).T
        for i, tank in enumerate(plant.tanks):
            allowed = 0.05 * np.abs(lost[i]) + 4.0 * np.abs(late[i] - lost[i])
            allowed = allowed + 1e-6 * tank.volume(tank.rim)
            if (k := _worst(np.where(usual, np.abs(spilled[i] - lost[i]) - allowed, 0.0))) >= 0:
                yield (
                    f"overflow of tank {i + 1} at {times[k]:.6g} s: {spilled[i][k]:.6g} m^3, and"
                    f" {lost[i][k]:.6g} by its flows"
                )

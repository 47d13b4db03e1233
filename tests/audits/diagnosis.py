"""Does `identify` name the fault of a log? Logs of an integrator of this file (RK4 in numpy), with
faults of eleven kinds at two sizes on four rigs, and clean ones among them.

python tests/audits/diagnosis.py [logs] [seed]
"""

import sys
import time
from typing import Any

import jax
import numpy as np

import tuning
from jaxtank import rig as rigs

FINE = 8
"""Integration steps per sample; delays are multiples of one."""

RIGS: dict[str, dict[str, Any]] = {
    "coupled": {
        "units": ("cm", "V"), "g": 981.0, "dt": 2.0, "noise": 0.1, "start": [12.0, 9.0],
        "area": [60.0, 80.0], "rim": [60.0, 60.0], "drain": [0.0, 0.55],
        "pipe": [(0, 1, 0.9)], "orifice": [], "pump": [(0, None, 1.0, 13.0)],
        "levels": [(3.0, 9.0)], "hold": 20, "samples": 900,
    },
    "cascade": {
        "units": ("m", "%"), "g": 9.81, "dt": 5.0, "noise": 0.002, "start": [0.4, 0.35, 0.45],
        "area": [0.5, 0.4, 0.25], "rim": [1.5, 1.5, 1.5], "drain": [0.0, 0.0, 4.3e-4],
        "pipe": [], "orifice": [(0, 1, 4.0e-4), (1, 2, 4.2e-4)],
        "pump": [(0, None, 1.0, 2.4e-5)], "levels": [(30.0, 75.0)], "hold": 30, "samples": 1000,
    },
    "crossed": {
        "units": ("cm", "V"), "g": 981.0, "dt": 1.0, "noise": 0.08, "start": [9.0, 8.0, 4.0, 4.0],
        "area": [28.0, 32.0, 28.0, 32.0], "rim": [40.0] * 4, "drain": [0.15, 0.12, 0.0, 0.0],
        "pipe": [], "orifice": [(2, 0, 0.14), (3, 1, 0.11)],
        "pump": [(0, 3, 0.6, 6.0), (1, 2, 0.55, 6.0)], "levels": [(1.5, 4.5), (1.5, 4.5)],
        "hold": 30, "samples": 1200,
    },
    "single": {
        "units": ("m", "%"), "g": 9.81, "dt": 10.0, "noise": 0.002, "start": [0.6],
        "area": [1.2], "rim": [2.0], "drain": [6e-4], "pipe": [], "orifice": [],
        "pump": [(0, None, 1.0, 4.2e-5)], "levels": [(25.0, 75.0)], "hold": 25, "samples": 600,
    },
}  # fmt: skip

FAULTS: dict[str, tuple[float, float]] = {
    "pump-delay": (0.75, 3.0),  # samples
    "pump-lag": (1.0, 5.0),  # samples
    "dead-zone": (0.06, 0.15),  # of the range of the inputs
    "pump-curve": (0.88, 1.3),  # exponent
    "sensor-offset": (-0.03, 0.08),  # of the level
    "sensor-scale": (1.03, 0.9),
    "leak": (0.06, 0.2),  # of the outlet of a tank with none
    "outlet-exponent": (0.53, 0.6),
    "inflow": (0.04, -0.12),  # of the flow of a pump
    "area": (1.06, 0.8),
    "swapped": (1.0, 1.0),
}

PLACES = {
    "coupled": {"pump-": [0], "dead-zone": [0], "sensor-": [0, 1], "leak": [0],
                "outlet-exponent": [1], "inflow": [0, 1], "area": [0, 1], "swapped": [0]},
    "cascade": {"pump-": [0], "dead-zone": [0], "sensor-": [0, 1, 2], "leak": [0, 1],
                "outlet-exponent": [0, 1, 2], "inflow": [0, 1, 2], "area": [0, 1, 2],
                "swapped": [0, 1]},
    "crossed": {"pump-": [0, 1], "dead-zone": [0, 1], "sensor-": [0, 1, 2, 3], "leak": [2, 3],
                "outlet-exponent": [0, 1, 2, 3], "inflow": [0, 1, 2, 3], "area": [0, 1, 2, 3],
                "swapped": [0, 2]},
    "single": {"pump-": [0], "dead-zone": [0], "sensor-offset": [0], "outlet-exponent": [0],
               "inflow": [0]},
}  # fmt: skip
"""Where a fault changes readings in a way that no other coefficients make."""


def places(rig, kind):
    return next((w for start, w in PLACES[rig].items() if kind.startswith(start)), [])


def toml(rig, wrong=None):
    """The rig file of a rig; wrong: factors on (gains, outlets) of its first guess."""
    gain, out = wrong or (1.0, 1.0)
    lines = [f'units = ["{rig["units"][0]}", "{rig["units"][1]}"]']
    for i, area in enumerate(rig["area"]):
        lines += ["[[tank]]", f"area = {area}", f"rim = {rig['rim'][i]}"]
        lines += [f"level = {rig['start'][i]}", f"drain = {rig['drain'][i] * out}"]
    for a, b, area in rig["orifice"]:
        lines += ["[[orifice]]", f"from = {a + 1}", f"to = {b + 1}", f"area = {area * out}"]
    for a, b, area in rig["pipe"]:
        lines += ["[[pipe]]", f"between = [{a + 1}, {b + 1}]", f"area = {area * out}"]
    for first, second, split, k in rig["pump"]:
        lines += ["[[pump]]", f"gain = {k * gain}"]
        lines += [f"to = {first + 1}" if second is None else f"to = [{first + 1}, {second + 1}]"]
        lines += [f"split = {split}"] * (second is not None)
        lines += ["high = 100.0" if rig["units"][1] == "%" else "high = 12.0"]
    lines += ["[plant]", f"gravity = {rig['g']}", "[controller]", 'kind = "open-loop"']
    lines += [f"initial = {[low for low, _ in rig['levels']]}", "changes = []"]
    return "\n".join(lines) + "\n"


def inputs_of(rig, rng, binary):
    """(samples, pumps) steps of random height and length, or between two levels."""
    n, columns = rig["samples"], []
    for low, high in rig["levels"]:
        u = []
        while len(u) < n:
            level = rng.choice([low, high]) if binary else rng.uniform(low, high)
            u += [level] * int(rng.integers(rig["hold"] // 2, rig["hold"] * 2))
        columns.append(u[:n])
    return np.round(np.array(columns).T, 3)


def simulated(rig, cases, u):
    """(cases, samples, tanks) levels for inputs u (cases, samples, pumps) and faults `cases`."""
    B, n, m, N = len(cases), u.shape[1], u.shape[2], len(rig["area"])
    value = lambda kind, count, usual: np.array(
        [[c[1] if (c[0], c[2]) == (kind, i) else usual for i in range(count)] for c in cases]
    )
    h, dt = rig["dt"] / FINE, rig["dt"]
    area = np.array(rig["area"]) * value("area", N, 1.0)
    exponent = value("outlet-exponent", N, 0.5)
    unit = 100.0 if rig["units"][0] == "cm" else 1.0
    root = np.sqrt(2 * rig["g"]) * unit**0.0
    outlet = np.array([_outlet(rig, i) for i in range(N)])
    drain = np.array(rig["drain"]) + value("leak", N, 0.0) * outlet
    span = np.array([high for _, high in rig["levels"]])
    dead = value("dead-zone", m, 0.0) * span
    curve = value("pump-curve", m, 1.0)
    gains = np.array([p[3] for p in rig["pump"]])
    inflow = value("inflow", N, 0.0) * gains[0] * span[0]
    fine = np.repeat(u, FINE, axis=1)
    moved = np.where(fine > dead[:, None], fine - dead[:, None], 0.0)
    moved = span * (moved / span) ** curve[:, None]
    delay = np.round(value("pump-delay", m, 0.0) * FINE).astype(int)
    k = np.arange(n * FINE)
    for b in range(B):
        for j in range(m):
            moved[b, :, j] = moved[b, np.maximum(k - delay[b, j], 0), j]
    lag = value("pump-lag", m, 0.0) * dt
    # the input of a pump with a lag, exact at both ends of each step and in its middle
    v, ends = moved[:, 0].copy(), []
    half = np.where(lag > 0, np.exp(-0.5 * h / np.where(lag > 0, lag, 1.0)), 0.0)
    for i in range(n * FINE):
        middle = moved[:, i] + half * (v - moved[:, i])
        last = moved[:, i] + half * (middle - moved[:, i])
        ends.append((v if np.any(lag) else moved[:, i], middle, last))
        v = last
    feed = np.zeros((N, m))
    for j, (first, second, share, gain) in enumerate(rig["pump"]):
        feed[first, j] += gain * share
        if second is not None:
            feed[second, j] += gain * (1 - share)

    def rate(x, v):
        power = np.maximum(x, 0.0) ** exponent
        q = v @ feed.T + inflow - drain * root * power
        for a, b, size in rig["orifice"]:
            flow = size * root * power[:, a]
            q[:, a] -= flow
            q[:, b] += flow
        for a, b, size in rig["pipe"]:
            d = x[:, a] - x[:, b]
            flow = size * root * np.sign(d) * np.sqrt(np.abs(d))
            q[:, a] -= flow
            q[:, b] += flow
        return q / area

    x, y = np.tile(np.array(rig["start"]), (B, 1)), np.empty((B, n, N))
    for i in range(n * FINE):
        if i % FINE == 0:
            y[:, i // FINE] = x
        a, b, c = (np.where(lag > 0, e, moved[:, i]) for e in ends[i])
        k1 = rate(x, a)
        k2 = rate(x + 0.5 * h * k1, b)
        k3 = rate(x + 0.5 * h * k2, b)
        k4 = rate(x + h * k3, c)
        x = np.maximum(x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), 0.0)
    return y


def _outlet(rig, i):
    """Area of all that leaves tank i."""
    joined = [size for a, b, size in (*rig["orifice"], *rig["pipe"]) if i in (a, b)]
    return rig["drain"][i] + sum(joined)


def trials(count, seed=0):
    """[(name of the rig, (kind, size, place), inputs, readings, noise)]: one in five is clean."""
    rng, rows = np.random.default_rng(seed), []
    kinds = list(FAULTS)
    for i in range(count):
        name = list(RIGS)[i % len(RIGS)]
        able = [kind for kind in kinds if places(name, kind)]
        kind = None if i % 5 == 4 else able[int(rng.integers(len(able)))]
        rows.append((name, _fault(rng, name, kind)))
    trials = []
    for name, rig in RIGS.items():
        chosen = [i for i, row in enumerate(rows) if row[0] == name]
        if not chosen:
            continue
        binary = rng.random(len(chosen)) < 0.3
        u = np.stack(
            [
                inputs_of(rig, rng, two and rows[i][1][0] not in ("pump-curve", "dead-zone"))
                for i, two in zip(chosen, binary)
            ]
        )
        y = simulated(rig, [rows[i][1] for i in chosen], u)
        for b, i in enumerate(chosen):
            noise = rig["noise"] * rng.uniform(0.5, 1.5)
            z = y[b] + noise * rng.standard_normal(y[b].shape)
            trials.append((i, name, rows[i][1], u[b], read(rows[i][1], z, y[b], noise)))
    return sorted(trials, key=lambda trial: trial[0])


def read(fault, z, y, noise):
    """Readings of levels y with noise (z) through sensors with the fault."""
    kind, size, place = fault
    z = z.copy()
    if kind == "sensor-scale":
        z[:, place] = size * y[:, place] + (z - y)[:, place]
    if kind == "sensor-offset":
        z[:, place] += size * y[:, place].mean()
    if kind == "swapped":
        z[:, [place, place + 1]] = z[:, [place + 1, place]]
    return z


def _fault(rng, name, kind):
    if kind is None:
        return (None, 0.0, 0)
    size = FAULTS[kind][int(rng.integers(2))]
    return kind, size, int(rng.choice(places(name, kind)))


def truth(name, fault):
    """{name of a coefficient: its value}, and the value of the fault under ""."""
    rig, (kind, size, place) = RIGS[name], fault
    columns = {"drain": rig["drain"], "pump_gain": [pump[3] for pump in rig["pump"]]}
    columns |= {part: [area for *_, area in rig[part]] for part in ("orifice", "pipe")}
    columns["split"] = [pump[2] for pump in rig["pump"]]
    values = {f"plant.{n}[{i}]": v for n, row in columns.items() for i, v in enumerate(row) if v}
    span = rig["levels"][0][1]
    scale = {"pump-delay": rig["dt"], "pump-lag": rig["dt"], "dead-zone": span, "pump-curve": 1.0,
             "sensor-scale": 1.0, "outlet-exponent": 1.0, "leak": _outlet(rig, place),
             "inflow": rig["pump"][0][3] * span, "area": rig["area"][place]}  # fmt: skip
    if kind in scale:
        values[""] = size * scale[kind]
    return values


def judged(trial):
    """(whether the right cause is first, or alike; [(coefficient, whether its interval after
    --accept holds the truth)]) of one of `trials`.
    """
    _, name, fault, u, y = trial
    kind, _, place = fault
    log = tuning.log(t=np.arange(len(u)) * RIGS[name]["dt"], u=u, y=y)
    case = rigs.loads(toml(RIGS[name], (1.1, 0.9)))
    result = tuning.identify(case, log, starts=1)
    where = [place + 1, place + 2] if kind == "swapped" else place + 1
    named = [c for first in result.diagnosis["causes"][:1] for c in (first, *first["equivalent"])]
    right = any((c["kind"], c["where"]) == (kind, where) for c in named)
    if kind is None:
        right = result.diagnosis["clean"]
    else:
        text = ",".join(map(str, np.ravel(where)))
        result = tuning.identify(case, log, starts=1, accept=[f"{kind}:{text}"])
    values, rows = truth(name, fault), []
    for parameter, row in result.parameters.items():
        value = values.get(parameter, values.get(""))
        if value is not None:
            low, high = row["interval95"] or (np.inf, -np.inf)
            rows.append((parameter, low <= value <= high))
    return right, rows


def main(count=100, seed=0):
    """Print wrong diagnoses; return shares (right, of clean ones accused, of intervals held)."""
    jax.config.update("jax_enable_x64", True)
    right, clean, covered, began = [], [], [], time.process_time()
    for trial in trials(count, seed):
        fault = trial[2]
        good, rows = judged(trial)
        (clean if fault[0] is None else right).append(good)
        covered += [inside for _, inside in rows]
        if not good:
            print(f"log {trial[0]} of {trial[1]}: {fault}", flush=True)
    accused = clean.count(False)
    print(f"right cause first, or alike: {sum(right)} of {len(right)}")
    print(f"clean logs accused: {accused} of {len(clean)}")
    print(f"intervals that hold the truth: {sum(covered)} of {len(covered)}")
    print(f"{time.process_time() - began:.0f} core-s")
    return np.mean(right), accused, np.mean(covered)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:3]))

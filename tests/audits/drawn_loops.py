"""Controllers and observers of `drawn_rigs`."""

from drawn_signals import event_times
from rig_text import Gain, PerTank, Q, Reading

PLAIN = ("p", "pi", "pid", "open-loop", "on-off")
OTHERS = ("state-feedback", "lqi", "gpc", "laguerre", "nmpc", "ngpc")
SHAPED = ("override", "reference-governor", "cascade", "flow-cascade", "split-range", "ratio")


def add_controller(d, rig):
    """Add [controller], of a kind that may fit, with some of its optional keys."""
    m = len(d.inputs)
    kind = d.choose("plain", "shaped", "other", p=[0.64, 0.24, 0.12])
    kind = d.choose(*{"plain": PLAIN, "shaped": SHAPED, "other": OTHERS}[kind])
    alone = not set(range(d.n)) - set(d.outputs)
    if (kind == "ratio" and m == 1) or (kind == "cascade" and (alone or m > 1)):
        kind = "pi"  # such a rig has no input that follows, no tank in between
    d.kind = kind
    if kind in ("split-range", "ratio") and m == 2:
        rig["plant"]["outputs"], d.outputs = [d.tank(d.outputs[0])], d.outputs[:1]
    if kind == "cascade" and d.n > 1:
        others = [k for k in range(d.n) if k not in d.outputs]
        if others and m == 1:
            d.outputs = [int(d.s.choice(others))]
            rig["plant"]["outputs"] = [d.tank(d.outputs[0])]
    each = list(zip(d.outputs, d.inputs))
    inputs = [*rig["pump"], *rig["valve"]]
    limited = any("low" in row or row.get("high", Q(1.0)).value != 1.0 for row in inputs)
    # of limited inputs in % a % is of the input, in other units of its range
    if kind not in ("on-off", "open-loop", "cascade") and (m > 1 or limited):
        d.readings.clear()
        for row in rig.get("sensor", []):
            row.pop("unit", None)
    gain = lambda i, sign, valve, by=1.0: Q(
        sign * d.near(by * 5.0 * d.area[i] / (d.tau * 2.5 * d.flow), 3.0), -1, 0, 1, valve
    )
    row = {"kind": kind}
    if kind in ("p", "pi", "pid", *SHAPED):
        _gains(d, rig, row, kind, each, gain)
    if kind == "open-loop":
        row["initial"] = [Q(d.share(0.1, 0.8), 0, 0, 1, v) for _, _, v in d.inputs]
        names = [p["name"] for p in [*rig["pump"], *rig["valve"]]]
        row["changes"] = [
            [Q(t, 0, 1), names[j], Q(d.share(0.0, 0.9), 0, 0, 1, d.inputs[j][2])]
            for t, j in event_times(d, m)
        ]
        if d.maybe(0.3):
            row["ramp"] = Q(d.dt * 7.3, 0, 1)
            row["shape"] = d.choose("linear", "quintic")
        elif d.maybe(0.2):
            row["filter"] = [Q(d.near(4 * d.dt), 0, 1) for _ in d.inputs]
    elif kind == "on-off":
        pairs = [
            (d.height[i] * d.share(0.3, 0.45), d.height[i] * d.share(0.5, 0.7)) for i, _ in each
        ]
        turned = [s < 0 for _, (_, s, _) in each]
        level = lambda i, v: Reading(v, *d.readings[i]) if i in d.readings else Q(v, 1)
        rows = [(i, *(reversed(p) if t else p)) for (i, _), p, t in zip(each, pairs, turned)]
        row |= {"on": [level(i, on) for i, on, _ in rows], "off": [level(i, v) for i, _, v in rows]}
        if d.maybe(0.3):
            row["low"] = [Q(d.share(0.0, 0.2), 0, 0, 1, v) for _, _, v in d.inputs]
            row["high"] = [Q(d.share(0.6, 1.0), 0, 0, 1, v) for _, _, v in d.inputs]
    elif kind in OTHERS:
        _other(d, row, kind, each)
    rig["controller"] = row


def _gains(d, rig, row, kind, each, gain):
    """The keys of the PID family."""
    time = lambda by: [Q(d.near(by * d.tau), 0, 1) for _ in each]
    row["Kc"] = [gain(i, s, v) for i, (_, s, v) in each]
    if len(each) == len(d.inputs) == 1 and each[0][0] in d.readings:
        row["Kc"] = [Gain(row["Kc"][0].value, d.readings[each[0][0]][0], 1.0)]
    if kind == "cascade":
        row["Kc"] = [d.near(0.5) for _ in each]
        if each[0][0] in d.readings:  # % of the level that is asked for, per % of the one measured
            asked = d.readings[i][0] if (i := d.inputs[0][0]) in d.readings else (0.0, d.height[i])
            spans = [high - low for low, high in (d.readings[each[0][0]][0], asked)]
            row["Kc"] = [f"{row['Kc'][0] * spans[0] / spans[1]!r} %/%"]
    elif kind == "flow-cascade":
        row["Kc"] = [Q(s * d.near(5 * d.area[i] / d.tau), 2, -1) for i, (_, s, _) in each]
    if kind == "pi" or (kind not in ("p", "ratio") and d.maybe(0.8)):
        row["Ti"] = time(0.5)
        if d.maybe(0.2) and kind not in ("p",):
            row["Tt"] = time(0.3)
        elif d.maybe(0.3):
            row["anti_windup"] = d.choose("back-calculation", "clamping", "conditioned")
    if kind in ("pid", "override", "split-range") and "Ti" in row and d.maybe(0.08):
        row["order"] = [d.share(0.7, 1.0) for _ in each]
    if kind not in ("p", "pi") and d.maybe(0.4):
        row["Td"] = time(0.05)
        if d.maybe(0.5):
            row["N"] = [d.share(3.0, 20.0) for _ in each]
    if "Ti" in row and d.maybe(0.2):
        row["b"] = [d.share(0.3, 1.0) for _ in each]
    if d.maybe(0.15):
        row["deadband"] = [Q(d.height[i] * d.share(0.0, 0.02), 1) for i, _ in each]
        if any(i in d.readings for i, _ in each):
            del row["deadband"]
        if "deadband" in row and d.maybe(0.4):
            row["gap_gain"] = [d.share(0.1, 0.9) for _ in each]
    elif d.maybe(0.1):
        row["error_span"] = [Q(d.height[i] * d.share(0.05, 0.5), 1) for i, _ in each]
    plain = d.simple and not rig["valve"] and all("shape" not in tank for tank in rig["tank"])
    if kind in ("p", "pi", "pid") and d.maybe(0.15 if plain else 0.01):
        row["feed_forward"] = True
    elif kind in ("p", "pi", "pid") and d.maybe(0.12):
        row["inflow_gain"] = [
            Q(-s * d.share(0.2, 1.0) / (2.5 * d.flow), -3, 1, 1, v) for _, (_, s, v) in each
        ]
    numbers = all(isinstance(gain, Q) for gain in row["Kc"])
    emptying = all(sign < 0 for _, (_, sign, _) in each)
    if kind in ("p", "pi", "pid") and emptying and numbers and d.maybe(0.5):
        row |= {"action": "direct", "Kc": [g._replace(value=-g.value) for g in row["Kc"]]}
    if kind in ("p", "pi", "pid", "override", "ratio") and d.maybe(0.6):
        row["bias"] = [Q(d.share(0.2, 0.7), 0, 0, 1, v) for _, (_, _, v) in each]
    if kind == "cascade":
        row["inner"] = [d.tank(i) for i, _, _ in d.inputs][: len(each)]
        row["inner_Kc"] = [gain(i, s, v) for i, s, v in d.inputs][: len(each)]
        if d.maybe(0.5):
            row["inner_Ti"] = time(0.2)
        if d.maybe(0.3):
            row["bias"] = [d.level(i, 0.3, 0.6) for i, *_ in d.inputs][: len(each)]
        if d.maybe(0.4):
            row["inner_low"] = [Q(0.05 * d.height[i], 1) for i, *_ in d.inputs][: len(each)]
            row["inner_high"] = [Q(0.9 * d.height[i], 1) for i, *_ in d.inputs][: len(each)]
    if kind == "flow-cascade":
        row["inner_Kc"] = [Q(d.near(0.3 / (2.5 * d.flow)), -3, 1, 1, v) for _, (_, _, v) in each]
        row["inner_Ti"] = [Q(d.near(5 * d.dt), 0, 1) for _ in each]
        if d.maybe(0.4):
            row["inner_low"] = [Q(0.0, 3, -1) for _ in each]
            row["inner_high"] = [Q(d.near(2.0 * d.flow), 3, -1) for _ in each]
        if d.maybe(0.3):
            row["bias"] = [Q(d.near(d.flow), 3, -1) for _ in each]
            row["inner_bias"] = [Q(d.share(0.2, 0.6), 0, 0, 1, v) for _, (_, _, v) in each]
    if kind == "override":
        others = [int(d.s.choice([k for k in range(d.n) if k != i] or [i])) for i, _ in each]
        row["limited"] = [d.tank(k) for k in others]
        row["limit"] = [d.read(k, 0.3, 0.8) for k in others]
        row["limit_Kc"] = [gain(k, s, v) for k, (_, (_, s, v)) in zip(others, each)]
        if "Kc" in row and isinstance(row["Kc"][0], Gain) and others[0] in d.readings:
            span = d.readings[others[0]][0]
            row["limit_Kc"] = [Gain(row["limit_Kc"][0].value, span, row["Kc"][0].range)]
        if d.maybe(0.6):
            row["limit_Ti"] = time(0.5)
        if d.maybe(0.3):
            row["select"] = d.choose("low", "high")
    if kind == "reference-governor":
        row["horizon"] = Q(d.near(2 * d.tau), 0, 1)
        if d.maybe(0.6):
            row["limit"] = PerTank(d.level(k, 0.6, 0.95) for k in range(d.n))
    if kind == "split-range" and len({valve for *_, valve in d.inputs}) > 1:
        row["span"] = [Q(d.share(0.5, 1.0), 0, 0, 1) for _ in d.inputs]
    if kind == "ratio" and len(d.inputs) == 2:
        follower = "FV2" if d.inputs[1][2] else "P2"
        row["follow"] = [follower]
        row["ratio"] = [d.share(0.1, 0.8)]
        if d.maybe(0.4):
            row["lead"] = [rig["pump"][0]["name"] if rig["pump"] else "FV1"]


def _other(d, row, kind, each):
    """The keys of controllers with a model."""
    m = len(d.inputs)
    point = PerTank(d.level(k, 0.3, 0.6) for k in range(d.n))
    if kind == "state-feedback":
        row["K"] = [
            PerTank(
                Q(
                    s * d.near(2 * d.area[i] / (d.tau * 2.5 * d.flow)) * (1.0 if k == i else 0.1),
                    -1,
                    0,
                    1,
                    v,
                )
                for k in range(d.n)
            )
            for i, s, v in d.inputs
        ]
    elif kind == "lqi":
        row["R"] = [Q(d.near(1.0), 0, 0, -2, v) for _, _, v in d.inputs]
        weights = [Q(d.near(10.0), -2)] * d.n  # alike: the tanks may be in another order
        row["Q"] = [*weights, *(Q(d.near(10.0 / d.tau**2), -2, -2) for _ in each)]
        row["operating_point"] = [d.level(i, 0.3, 0.6) for i, _ in each]
    elif kind in ("gpc", "laguerre"):
        row["operating_point"] = point
        row["r_w"] = Q(d.near(0.05), 2, 0, -2)
        row["Np"] = int(d.choose(10, 20))
        row["q"] = [d.near(1.0) for _ in each]
        row["u_low"] = [Q(0.0, 0, 0, 1, v) for _, _, v in d.inputs]
        row["u_high"] = [Q(1.0, 0, 0, 1, v) for _, _, v in d.inputs]
        row["du_limit"] = [Q(d.share(0.05, 0.5), 0, 0, 1, v) for _, _, v in d.inputs]
        row["mode"] = d.choose("unconstrained", "clipped", "constrained")
        row |= {"Nc": 3} if kind == "gpc" else {"a": [d.share(0.2, 0.7)] * m, "N": 3, "rows": 5}
    elif kind == "nmpc":
        row["horizon"] = Q(d.near(20 * d.dt), 0, 1)
        row["r_w"] = [Q(d.near(0.05), 2, 0, -2, v) for _, _, v in d.inputs]
        row |= {"N": 5, "moves": 2}
        if d.maybe(0.5):
            row["limit"] = PerTank(d.level(k, 0.7, 0.95) for k in range(d.n))
            if d.maybe(0.5):
                row["penalty"] = Q(d.near(1.0), 1)
        if d.maybe(0.4):
            row["q"] = [d.near(1.0) for _ in each]
        if d.maybe(0.3):
            row["rate"] = [Q(d.near(5.0 / d.tau), 0, -1, 1, v) for _, _, v in d.inputs]
        if d.maybe(0.3):
            row["terminal"] = d.near(1.0)
        if d.maybe(0.3):
            row["rate_time"] = Q(d.near(d.dt), 0, 1)
        if d.maybe(0.3):
            row["preview"] = Q(5 * d.dt, 0, 1)
        if d.maybe(0.3):
            row["low"] = [Q(0.1, 0, 0, 1, v) for _, _, v in d.inputs]
    else:
        row["Tp"] = Q(d.near(0.2 * d.tau), 0, 1)
        if d.maybe(0.4):
            row["level_floor"] = Q(d.near(2e-3), 1)


def add_observer(d, rig):
    """Add [observer] to some rigs."""
    if not d.maybe(0.22):
        return
    kind = d.choose(
        *("disturbance", "kalman", "extended-kalman", "unscented-kalman"),
        *("moving-horizon", "fault-bank"),
        p=[0.3, 0.2, 0.25, 0.1, 0.05, 0.1],
    )
    row = {"kind": kind}
    every = range(d.n)
    if kind == "disturbance":
        row["l"] = PerTank(Q(d.near(3 / d.tau), 0, -1) for _ in every)
        if d.maybe(0.3):
            row["fed"] = "command"
        if d.n > 1 and d.maybe(0.3):
            row["measured"] = [d.tank(i) for i in every][1:]
    else:
        row["process"] = PerTank(Q(d.near(1e-6) / d.dt, 2, -1) for _ in every)
        row["measurement"] = PerTank(Q(d.near(1e-6), 2) for _ in every)
        row["measured"] = [d.tank(i) for i in every]
        if d.n > 1 and d.maybe(0.3):
            row["measured"] = row["measured"][1:]
            row["measurement"] = row["measurement"]
        if kind == "kalman":
            row["levels"] = PerTank(d.level(i, 0.3, 0.6) for i in every)
            row["inputs"] = [Q(d.share(0.3, 0.6), 0, 0, 1, v) for _, _, v in d.inputs]
        elif d.maybe(0.3):
            row["spread"] = PerTank(Q(d.near(1e-4), 2) for _ in every)
        if kind in ("extended-kalman", "unscented-kalman") and d.maybe(0.3):
            row["start"] = PerTank(d.level(i, 0.3, 0.6) for i in every)
        if kind in ("kalman", "extended-kalman") and d.maybe(0.4):
            row["disturbed"] = [d.tank(0)]
            row["walk"] = PerTank(Q(d.near(1e-9), 2, -3) for _ in every)
        if kind in ("extended-kalman", "unscented-kalman", "moving-horizon"):
            if d.maybe(0.3):
                row["coefficients"] = [f"plant.area[{d.n - 1}]"] if d.n == 1 else ["pump_gain[0]"]
                row["coefficient_spread"] = d.share(0.05, 0.3)
                row["coefficient_walk"] = Q(d.near(1e-6), 0, -1)
            if kind != "moving-horizon" and d.maybe(0.3):
                row["substeps"] = 2
            if kind == "moving-horizon":
                row |= {"samples": 4, "limit": PerTank(Q(d.near(0.05), 1) for _ in every)}
        if kind == "fault-bank":
            row |= {"share": 0.5, "offset": Q(d.near(0.05), 1), "prior": 1e-3}
    rig["observer"] = row

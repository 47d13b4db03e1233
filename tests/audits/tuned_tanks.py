"""Default answers for random tanks under a PI or PID with poor first gains, beside tuning rules.

    python tests/audits/tuned_tanks.py [first seed] [last seed]    # 0 40; fifteen minutes

One or two tanks in a row with or without dead time and noise; first gains off by up to 300 times.
Each line has the cost before and after, Ms, Mt, the gains, and the least cost of a rule that keeps
the limits and setpoints. Counted: answers that are not converged, fragile (Ms above 2, Mt above
1.79), cost more than a rule whose loop is not fragile, or pass a limit.
"""

import sys
import warnings

import jax
import numpy as np

import tuning
from jaxtank import rig
from jaxtank.core.tree import with_values
from tuning.problem.reported import margin_measures

TANK = "{{ area = {area:.4g}, rim = {rim:.4g}, {drain}level = {level:.4g} }}"
RIG = """
name = "tank {seed}"
tank = [{tanks}]
pump = [{{ gain = {gain:.4g}, to = 1, high = 10.0, initial = {input:.4g}, delay = {delay:.6g} }}]
{joined}
controller = {{ kind = "{kind}", Kc = {Kc:.3g}, Ti = {Ti:.3g}{Td} }}
reference = {{ initial = [{level:.4g}], changes = [[{t1:.4g}, 1, {r1:.4g}], {last}] }}
limits = {{ max_level = {rim:.4g} }}
values = {{ "clock.dt" = {dt}, "clock.duration" = {duration:.6g}{noise} }}
"""


def drawn(seed):
    """The text of a rig file."""
    rng = np.random.default_rng(seed)
    count = int(rng.choice([1, 1, 2]))
    area, rim, time = 10 ** rng.uniform(1.3, 3.3), rng.uniform(20, 100), 10 ** rng.uniform(1.0, 3.0)
    level = rim * rng.uniform(0.2, 0.5)
    flow = area * level / time
    drain, gain = flow / np.sqrt(2 * 981.0 * level), flow / (10.0 * rng.uniform(0.3, 0.6))
    delay = rng.choice([0.0, 0.0, 0.02, 0.1]) * time
    dt = float(f"{time / rng.choice([100, 200, 400]):.2g}")
    delay, kind = round(delay / dt) * dt, rng.choice(["pi", "pi", "pid"])
    Kc = area / gain / (4.0 * max(delay, dt)) * 10 ** rng.uniform(-2.5, 1.0)
    Ti, noise = time * 10 ** rng.uniform(-1.5, 1.0), rim * rng.choice([0.0, 0.0, 0.002, 0.005])
    outlet = f"drain = {drain:.4g}, "
    tanks = ["" if i < count - 1 else outlet for i in range(count)]
    joined = f"orifice = [{{ from = 1, to = 2, area = {drain:.4g} }}]\nplant = {{ outputs = [2] }}"
    return RIG.format(
        seed=seed,
        tanks=", ".join(TANK.format(area=area, rim=rim, level=level, drain=d) for d in tanks),
        joined=joined if count == 2 else "",
        **{"gain": gain, "input": flow / gain, "delay": delay, "kind": kind, "Kc": Kc, "Ti": Ti},
        Td=f", Td = {Ti / 8:.3g}" if kind == "pid" else "",
        **{"level": level, "rim": rim, "dt": dt, "duration": round(6.0 * time / dt) * dt},
        **{"t1": 0.6 * time, "r1": level * rng.uniform(1.1, 1.5)},
        last=f"[{3.3 * time:.4g}, 1, {level * rng.uniform(0.7, 0.95):.4g}]",
        noise=f', "sensor.noise" = {noise:.3g}' if noise else "",
    )


def fragile(measures):
    return not (measures["sensitivity_peak"] <= 2.01 and measures["complementary_peak"] <= 1.80)


def main(words):
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    first, last = map(int, words) if words else (0, 40)
    counts = dict.fromkeys(("not converged", "fragile", "a rule costs less", "limit passed"), 0)
    for seed in range(first, last):
        case = rig.loads(drawn(seed))
        result = tuning.tune(case)
        answer, margins = result.answer, result.answer.measures["after"]
        before, cost = (float(side.cost.mean()) for side in (answer.before, answer.after))
        rules = {}
        for row in result.rules:
            if row["holds"] and not row["setpoints_lost"]:
                loop = with_values(case.loop, row["parameters"])
                if not fragile(margin_measures(loop, case.clock)):
                    rules[row["rule"]] = row["objective"]
        best = min(rules, key=rules.get, default="-")
        checks = {
            "not converged": result.status != "converged",
            "fragile": fragile(margins),
            "a rule costs less": bool(rules) and rules[best] < 0.95 * cost,
            "limit passed": not answer.after.held.all(),
        }
        for name, fails in checks.items():
            counts[name] += fails
        gains = {
            n.split(".")[1]: f"{result[n].before:.3g} -> {result[n].after:.3g}" for n in result
        }
        print(
            f"{seed}: {result.headline}, cost {before:.4g} -> {cost:.4g} (rule {best}"
            f" {rules.get(best, np.nan):.4g}), Ms {float(margins['sensitivity_peak']):.2f}, Mt"
            f" {float(margins['complementary_peak']):.2f}, {gains}",
            [name for name, fails in checks.items() if fails],
            flush=True,
        )
    print(f"{last - first} rigs:", ", ".join(f"{name} {n}" for name, n in counts.items()))


if __name__ == "__main__":
    main(sys.argv[1:])

"""Random single faults under a bank of fault models: kind and place named, and false alarms.

    python tests/audits/fault_bank.py [FAULTS [HOURS]]

On dts200/pi (1 s) and gouta2015/backstepping (0.5 s) with sensor noise of 0.05 cm: leaks of 10 to
50 % of the rig's largest opening, plugs and pump losses of 15 to 80 %, sensor offsets of 0.3 to
2 cm, frozen sensors, of 200 to 400 s from a random time on. A fault counts as named if it is the
most probable at its end or 200 s after its start, whichever is first. Prints a table.
"""

import dataclasses
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank import presets
from jaxtank.core.clock import Clock, sample_times
from jaxtank.core.tree import component, leaf
from jaxtank.loop.saved_rows import simulate_compiled
from jaxtank.observers import FaultBank
from jaxtank.plants.faults import Faults, SensorFault

jax.config.update("jax_enable_x64", True)
NOISE = 0.05  # [cm]
RIGS = {
    "dts200/pi": Clock(dt=1.0, duration=1000.0),
    "gouta2015/backstepping": Clock(dt=0.5, duration=1000.0),
}
LENGTH = (200.0, 400.0)  # of a fault [s]


@component
class Timed(Faults):
    """Faults of every kind, of which the sizes say which one there is; its times are numbers."""

    start: Any = leaf("s", "when it begins", default=lambda known: 0.0)
    end: Any = leaf("s", "when it is over", default=lambda known: 0.0)
    freezes: Any = leaf("-", "1 where the sensor of a tank freezes", default=lambda known: 0.0)

    def sample(self, clock):
        t = sample_times(clock)
        now = jnp.where((t >= self.start) & (t < self.end), 1.0, 0.0)
        frozen = [now * self.freezes[i] for i in range(len(self.sensors) // 2)]
        return (*[now] * (len(self.windows) + len(self.sensors) // 2), *frozen)


def observed(name, noise=NOISE, **changes):
    """(loop with the bank and noise, clock) of a case."""
    loop, n = presets.find(name).loop, presets.find(name).loop.plant.tanks
    values = {"process": [1e-6] * n, "measurement": [noise**2] * n, "spread": [noise**2] * n}
    bank = FaultBank(model=loop.plant, **values, measured=tuple(range(n)), **changes)
    sensor = dataclasses.replace(loop.sensor, noise=np.full(n, noise))
    return dataclasses.replace(loop, observer=bank, sensor=sensor), RIGS[name]


def drawn(loop, clock, count, rng):
    """({leaf: (count, ...) values of Timed}, (count,) modes, entries and sensors of Timed)."""
    modes, n = loop.observer.modes, loop.plant.tanks
    entries = list(dict.fromkeys((m.field, m.index) for m in modes if m.field))
    scales = np.array([float(v) for v in loop.observer._scales()])
    real = [k for k, m in enumerate(modes) if k and scales[k] > 0.0]
    which = np.array([real[i % len(real)] for i in range(count)])
    values = {
        "factor": np.ones((count, len(entries))),
        "extra": np.zeros((count, len(entries))),
        "size": np.zeros((count, 2 * n)),
        "freezes": np.zeros((count, n)),
    }
    for row, k in enumerate(which):
        kind, field, index, _ = modes[k]
        place = entries.index((field, index)) if field else index
        if kind == "leak":
            values["extra"][row, place] = scales[k] * rng.uniform(0.1, 0.5)
        elif kind in ("plug", "pump loss"):
            values["factor"][row, place] = 1.0 - rng.uniform(0.15, 0.8)
        elif kind == "offset":
            values["size"][row, place] = rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 2.0)
        else:
            values["freezes"][row, place] = 1.0
    values["start"] = rng.uniform(50.0, clock.duration - LENGTH[1], count)
    values["end"] = values["start"] + rng.uniform(*LENGTH, count)
    return values, which, entries


def runs(loop, clock, values, entries, seeds):
    """(runs, samples, 2 H) modes of a run for each row of `values`."""
    n = loop.plant.tanks
    sensors = [SensorFault(i, kind, 0.0, 1.0) for kind in ("offset", "freeze") for i in range(n)]
    fixed = {
        "windows": tuple((f"{f}[{i}]", 0.0, 1.0) for f, i in entries),
        "sensors": tuple(sensors),
    }

    def run(row, seed):
        faulty = dataclasses.replace(loop, faults=Timed(**row, **fixed))
        trajectory, _ = simulate_compiled(faulty, clock, jax.random.key(seed), 1)
        return trajectory.modes, trajectory.x

    rows = {name: jnp.asarray(v) for name, v in values.items()}
    batches = jax.jit(
        lambda rows, seeds: jax.lax.map(lambda one: run(*one), (rows, seeds), batch_size=25)
    )
    return [np.asarray(v) for v in batches(rows, jnp.asarray(seeds))]


def main(count=200, hours=10.0):
    """Print the table of each rig."""
    for name in RIGS:
        loop, clock = observed(name)
        H, plant = len(loop.observer.modes), loop.plant
        names = np.array([name for name, _ in loop.observer.mode_names(plant)])
        values, which, entries = drawn(loop, clock, count, np.random.default_rng(1))
        clean = int(np.ceil(3600.0 * hours / clock.duration))
        still = {
            k: np.repeat(v[:1] * 0.0 + (k == "factor"), clean, axis=0) for k, v in values.items()
        }
        both = {k: np.concatenate([v, still[k]]) for k, v in values.items()}
        modes, _ = runs(loop, clock, both, entries, np.arange(count + clean))
        best = modes[:, :, :H].argmax(axis=2)
        judged = np.minimum(values["end"], values["start"] + 200.0)
        at = np.ceil(judged / clock.dt).astype(int) - 1
        answers = best[np.arange(count), at]
        right = answers == which
        before = [
            int((np.diff((best[i, : int(s / clock.dt)] > 0).astype(int)) > 0).sum())
            for i, s in enumerate(values["start"])
        ]
        alarms = (np.diff((best[count:] > 0).astype(int), axis=1) > 0).sum()
        first = np.array(
            [
                np.argmax(best[i, int(np.ceil(s / clock.dt)) :] == which[i]) * clock.dt
                for i, s in enumerate(values["start"])
            ]
        )
        print(
            f"\n{name}: {right.sum()} of {count} named ({100 * right.mean():.1f} %), median delay"
            f" {np.median(first[right]):.1f} s, 95 % {np.quantile(first[right], 0.95):.1f} s;"
            f" {alarms} false alarms in {clean * clock.duration / 3600:.1f} h without faults,"
            f" {sum(before)} before {count} faults"
        )
        for k in sorted(set(which)):
            of = which == k
            wrong = [str(names[a]) for a in answers[of] if a != k]
            words = f"; else {', '.join(sorted(set(wrong)))}" if wrong else ""
            print(f"  {names[k]:42s} {right[of].sum():3d} of {of.sum():3d}{words}")


if __name__ == "__main__":
    main(*(int(w) for w in sys.argv[1:]))

"""Random single faults under a bank of fault models: leaks of 10 to 50 % of the rig's largest
opening, plugs and pump losses of 15 to 80 %, sensor offsets of 0.3 to 2 cm, frozen sensors, of 200
to 400 s from a random time on.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.clock import sample_times
from jaxtank.core.tree import component, leaf
from jaxtank.loop.saved_rows import simulate_compiled
from jaxtank.plants.faults import Faults, SensorFault

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

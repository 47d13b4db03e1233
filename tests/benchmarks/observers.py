"""What a disturbance observer makes of a wrong model: errors at the ends of plateaus, with and
without, on 200 plants.

    python tests/benchmarks/observers.py               # the table
    python tests/benchmarks/observers.py --markdown    # the same, into README.md here

gouta2015: the plants of its sec. 5.3 in `jaxtank compare`, c1, c2, c3, c7, c8 off by up to 5 and
10 %, ramps of 30 s, steps of 0.02 s. mirakhorli: outlets, orifices and pumps off by up to 5 and
10 %, each by its own share. The first plateau of gouta2015, 20 s from a start that is no steady
state of the wrong plants, is left out. No noise.
"""

import dataclasses
import sys
from typing import NamedTuple

import jax
import measuring
import numpy as np
from measuring import store

import tuning
from jaxtank import presets, rig
from jaxtank.core.tree import number, with_values
from jaxtank.loop import run as lp
from jaxtank.observers import DisturbanceObserver
from jaxtank.presets.rows import robustness
from jaxtank.presets.rows.robustness import SPREADS, N

GAIN = 0.5  # l of every tank: that of gouta2015/ngpc-observer [1/s]
CASES = (
    *("gouta2015/ngpc", "gouta2015/backstepping", "gouta2015/backstepping-ff", "mirakhorli/sfc"),
    *("mirakhorli/smc", "mirakhorli/hybrid"),
)
BEGIN, END = "<!-- tests/benchmarks/observers.py -->", "<!-- end of observers -->"


class Row(NamedTuple):
    """Errors at the ends of plateaus [cm], the largest of a plant, without and with the observer:
    mean of all plants, mean and largest of those that can follow.
    """

    case: str
    spread: float
    follow: int  # plants that can follow
    without: tuple
    observed: tuple

    @property
    def share(self):
        """Mean error of those that can follow, with the observer over without."""
        return self.observed[1] / self.without[1]


def plants_of(name, spread):
    """(Case, {name: (N, ...)} of its plants, times of the plateaus' ends [s])."""
    if name.startswith("gouta2015/"):
        case = rig.set_values(presets.find(name), robustness.SETTING)
        values = robustness.coefficients(case.loop.plant, spread)
        return case, values, robustness.CHANGES[1:]
    case, rng = presets.find(name), np.random.default_rng(2015)
    fields = {n: np.asarray(getattr(case.loop.plant, n)) for n in ("drain", "orifice", "pump_gain")}
    off = {n: rng.uniform(1 - spread, 1 + spread, (N, *v.shape)) for n, v in fields.items()}
    values = {f"plant.{n}": v * off[n] for n, v in fields.items()}
    return case, values, (case.clock.duration,)


def observed(loop):
    """The loop with the observer."""
    model = loop.controller.model
    observer = DisturbanceObserver(model=model, l=number([GAIN] * loop.plant.tanks))
    return dataclasses.replace(loop, observer=observer)


def ends(loop, clock, values, times):
    """(N,) largest error of a plant at these times [cm]."""
    every = round(0.5 / clock.dt) if clock.dt < 0.5 else 1
    at = np.array([round(t / (every * clock.dt)) for t in times])

    def one(values):
        return lp.simulate_compiled(with_values(loop, values), clock, None, every)[0].e[at]

    return np.abs(np.asarray(jax.jit(jax.vmap(one))(values))).max(axis=(1, 2))


def row(name, spread):
    """The Row of a case."""
    case, values, times = plants_of(name, spread)
    follow = np.asarray(tuning.can_follow(case, values))
    found = [ends(loop, case.clock, values, times) for loop in (case.loop, observed(case.loop))]
    texts = [(e.mean(), e[follow].mean(), e[follow].max()) for e in found]
    return Row(name, spread, int(follow.sum()), *texts)


def everything(cases=CASES, spreads=SPREADS):
    """All rows."""
    return [row(name, spread) for name in cases for spread in spreads]


def markdown(rows):
    """The table as it stands in README.md."""
    heads = (
        *("case", "off by", "plants that can follow", "error without, all (follow)"),
        *("with, all (follow)", "largest of those that can follow", "share"),
    )
    lines = []
    for r in rows:
        cells = [r.case, f"{100 * r.spread:g} %", f"{r.follow} of {N}"]
        cells += [f"{a:.3g} ({b:.3g}) cm" for a, b, _ in (r.without, r.observed)]
        lines.append([*cells, f"{r.observed[2]:.1g} cm", f"{r.share:.1g}"])
    return measuring.markdown(heads, lines)


def main(words):
    jax.config.update("jax_enable_x64", True)
    text = markdown(everything())
    if "--markdown" in words:
        store(BEGIN, END, text)
        return
    print(text)


if __name__ == "__main__":
    main(sys.argv[1:])

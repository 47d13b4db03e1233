"""gouta2015 sec. 5.3: both controllers on plants whose coefficients are off, with 95 % intervals.

200 plants with c1, c2, c3, c7, c8 (and their twins) off by up to 5 and 10 %; the paper gives
neither ranges nor numbers. Ramps of 30 s, steps of 0.02 s (gouta2015 notes S11).
"""

from typing import NamedTuple

import jax
import numpy as np

from jaxtank.core.tree import with_values
from jaxtank.loop import run as lp
from jaxtank.presets.paper import Claim
from jaxtank.xla.jit import compiled

N = 200
SPREADS = (0.05, 0.10)
CONTROLLERS = ("ngpc", "backstepping")
SETTING = {"reference.ramp": 30.0, "clock.dt": 0.02}  # [s]
CHANGES = (20.0, 270.0, 470.0, 760.0, 900.0, 1200.0)  # ends of the plateaus of the benchmark [s]
EVERY = 0.5  # of the errors that are kept [s]
MEASURES = (
    "rms_error_total",
    "max_level",
    "rms_input",
    "input_travel",
    "saturated_fraction",
    "overshoot_percent",
)


class Study(NamedTuple):
    """One controller on N plants."""

    measures: dict
    errors: np.ndarray
    failed: np.ndarray


def coefficients(plant, spread):
    """Return {name: (N, ...)}: c1, c2, c3, c7, c8 and twins times factors uniform in 1 +-spread."""
    f1, f2, f3, f7, f8 = np.random.default_rng(2015).uniform(1 - spread, 1 + spread, (5, N))
    inner, outer = np.asarray(plant.orifice)[:2]
    rest = f7 * (inner + outer) - f2 * inner - f3 * outer
    drain = np.asarray(plant.drain)[0]
    return {
        "plant.drain": np.stack([drain * f1, drain * f1, rest, rest], axis=1),
        "plant.orifice": np.stack([inner * f2, outer * f3, outer * f3, inner * f2], axis=1),
        "plant.pump_gain": np.stack([7.687 * f8] * 2, axis=1),
    }


@compiled("clock", "every", keep=True)
def _runs(loop, values, clock, every):
    def measured(values):
        plant = with_values(loop, values)
        measures, failed = lp.evaluate_and_flag(plant, clock, MEASURES)
        return measures, lp.simulate_compiled(plant, clock, None, every)[0].e, failed

    return jax.vmap(measured)(values)


def everything(run):
    """Return ({(controller, spread): Study}, {controller: nominal total RMS error [cm]})."""
    studies, nominal = {}, {}
    for controller in CONTROLLERS:
        case, trajectory = run(controller, SETTING)
        nominal[controller] = float(np.sqrt((trajectory.e**2).mean(axis=0).sum()))
        for spread in SPREADS:
            values, every = coefficients(case.loop.plant, spread), round(EVERY / case.clock.dt)
            runs = _runs(case.loop, values, case.clock, every)
            studies[controller, spread] = Study(*jax.tree.map(np.asarray, runs))
    return studies, nominal


def interval(values, of=np.mean, draws=2000):
    """Return (estimate, low, high) of a statistic of (N,) or (N, k), by resampling plants."""
    values = np.asarray(values, dtype=float)
    picks = np.random.default_rng(0).integers(0, len(values), (draws, len(values)))
    ends = np.quantile([of(values[p], axis=0) for p in picks], (0.025, 0.975))
    return float(of(values, axis=0)), *map(float, ends)


def exact(count, total):
    """Return (low, high), the interval of a probability by Clopper and Pearson."""
    from scipy.stats import binomtest  # takes half a second to import

    return tuple(binomtest(count, total).proportion_ci())


def above_zero(triples):
    """Return, for each spread, whether the interval of a difference lies above zero."""
    return [low > 0.0 for _, low, _ in triples]


def printed(triple, unit):
    """Return estimate, interval and unit as text."""
    estimate, low, high = triple
    return f"{estimate:+.3g}{' ' + unit if unit else ''} ({low:+.3g} to {high:+.3g})"


def window(study, output, start, end):
    """Return (N,) largest absolute error of an output between two times [cm]."""
    return np.abs(study.errors[:, round(start / EVERY) : round(end / EVERY), output]).max(axis=1)


def _each_spread(texts):
    """The texts of both spreads as one."""
    return "; ".join(f"{100 * s:g} % off: {text}" for s, text in zip(SPREADS, texts))


def _both(pair):
    """Means of both controllers [cm] as text."""
    named = zip(("NGPC", "backstepping"), pair)
    return ", ".join(f"{name} {printed(triple, 'cm')}" for name, triple in named)


def claims(studies, nominal):
    """Return {quantity: Claim} of the published rows."""
    pairs = list(zip(*([studies[controller, s] for s in SPREADS] for controller in CONTROLLERS)))

    def compared(triples, unit, words="NGPC less backstepping "):
        return Claim(above_zero(triples), _each_spread(words + printed(t, unit) for t in triples))

    def differences(name):  # NGPC less backstepping, mean over plants and outputs or pumps
        each = ((a.measures[name] - b.measures[name]).reshape(N, -1).mean(axis=1) for a, b in pairs)
        return [interval(values) for values in each]

    def growth(both, axis):  # of the median error, NGPC's less backstepping's
        times = np.median(both, axis) / [nominal["ngpc"], nominal["backstepping"]]
        return times[0] - times[1]

    errors = [[f.measures["rms_error_total"] for f in pair] for pair in pairs]
    worse = [interval(a - b) for a, b in errors]
    first = [[window(f, 0, 270.0, 470.0) for f in pair] for pair in pairs]
    return {
        **_counts(pairs, errors),
        **_plateaus(pairs),
        "uncertain plants: growth of the error": compared(
            [interval(np.stack(pair, 1), growth) for pair in errors],
            "times",
            "median over the nominal error, NGPC less backstepping ",
        ),
        "uncertain plants: size of the error": compared(worse, "cm"),
        "uncertain plants: precision": compared(
            [(-e, -high, -low) for e, low, high in worse], "cm", "backstepping less NGPC "
        ),
        "uncertain plants: overshoot": compared(differences("overshoot_percent"), "%"),
        "uncertain plants: voltage": compared(differences("rms_input"), "V rms"),
        "uncertain plants: changes of the voltage": compared(
            differences("input_travel"), "V", "total variation, NGPC less backstepping "
        ),
        "uncertain plants: time at the limits": compared(
            [tuple(100 * v for v in t) for t in differences("saturated_fraction")], "%"
        ),
        "uncertain plants: error of h1 when r2 goes to 14 cm": compared(
            [interval(a - b) for a, b in first], "cm"
        ),
    }


def _counts(pairs, errors):
    """The claims on stability and on the rims: shares of the runs."""
    stable = [sum(int((~f.failed).sum()) for f in pair) for pair in pairs]
    highest = [max(float(e.max()) for e in pair) for pair in errors]
    over = [[int((f.measures["max_level"] > 30.0).any(axis=1).sum()) for f in p] for p in pairs]
    least = min(exact(k, N)[0] for pair in over for k in pair)

    def share(count, total):
        low, high = (100 * end for end in exact(count, total))
        return f"{count} of {total} ({low:.3g} to {high:.3g} %)"

    return {
        "uncertain plants: stable loops": Claim(
            [count == 2 * N and error < 10.0 for count, error in zip(stable, highest)],
            _each_spread(
                f"{share(s, 2 * N)} runs stay finite, errors below {h:.2g} cm rms"
                for s, h in zip(stable, highest)
            ),
        ),
        "uncertain plants: feasible trajectories": Claim(
            least <= 0.05,
            _each_spread(
                f"above 30 cm with NGPC in {share(a, N)}, with backstepping in {share(b, N)}"
                for a, b in over
            ),
        ),
    }


def _plateaus(pairs):
    """The claims on the errors at the ends of the plateaus, and on h2 while r1 changes."""
    ends = [round(t / EVERY) for t in CHANGES]
    rest = [[interval(np.abs(f.errors[:, ends]).max(axis=(1, 2))) for f in pair] for pair in pairs]
    before = round(470.0 / EVERY)
    second = [
        [interval(window(f, 1, 470.0, 760.0) - np.abs(f.errors[:, before, 1])) for f in pair]
        for pair in pairs
    ]
    return {
        "uncertain plants: steady error": Claim(
            [low <= 0.01 for pair in rest for _, low, _ in pair],
            f"largest error at the ends of plateaus, {_each_spread(map(_both, rest))}",
        ),
        "uncertain plants: error of h2 while r1 goes to 16 cm": Claim(
            above_zero([t for pair in second for t in pair]),
            f"rise of the error, {_each_spread(map(_both, second))}",
        ),
    }

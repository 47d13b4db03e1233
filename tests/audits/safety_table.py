"""What the safety filter proves of preset cases at +-5 %, what it costs, and whether it holds.

    python tests/audits/safety_table.py                   all rows, 60 plants each: some minutes
    python tests/audits/safety_table.py 200 cascaded      200 plants, rows with this word

A row: the tanks whose limits are proved and by which theorem; total rms error and highest level of
the nominal run before and after; share of plants (corners of the box, random starts, readings off
by the whole band) in which some tank passes its limit: under the case's controller without and
with the filter, with pumps at full and with pumps that switch at random. Rims are no physics here,
except in the nominal run. The plants of the last two are simulated by the code of
`safety_attacks.py`.
"""

import dataclasses
import sys
from typing import Any, NamedTuple

import jax
import numpy as np
from safety_attacks import attack, of

from jaxtank import evaluate, presets, rig
from jaxtank.core.tree import with_values
from jaxtank.safety import design_for

SPREAD = 0.05
MOST = 50.0  # where pumps have no limit of their own
START = 0.5  # highest start, as a share of the limit


class Row(NamedTuple):
    """A case, its hold [s], band and what is set; of metres where the rig is."""

    case: str
    hold: float
    eps: float = 0.0
    rims: Any = None
    values: dict = {}
    pulses: bool = True
    seconds: float = 300.0


ROWS = (
    Row("gouta2015/backstepping", 0.01, seconds=60.0),
    Row("gouta2015/backstepping-ff", 0.1, 0.1),
    Row("gouta2015/ngpc", 0.1, 0.1),
    Row("gouta2022/enmpc", 0.05),
    Row("gouta2022/enmpc", 0.05, 0.05, [13.0, 10.5], pulses=False),
    Row("mirakhorli/sfc", 0.1),
    Row("mirakhorli/lqi", 0.1, 0.05, [12.3, 12.0, 4.0, 9.0]),
    Row("calofir/backstepping", 1.0, seconds=2000.0),
    Row("calofir/backstepping", 1.0, 0.001, [0.46, 0.46], {"actuator.high": 5.0}, seconds=2000.0),
    Row("khalid/gpc", 2.0, seconds=2000.0),
    Row("khalid/gpc-mimo", 2.0, 0.001, [0.16, 0.17], seconds=2000.0),
    Row("cascaded/pi", 4.0, 0.02, seconds=2000.0),
    Row("cascaded/pi", 4.0, 0.02, [9.13, 10.0], seconds=2000.0),
)


def case_of(row):
    """The case of a row; a factor of actuator.high multiplies the preset's."""
    case = presets.find(row.case)
    values = {n: np.asarray(case.loop.actuator.high) * v for n, v in row.values.items()}
    case = rig.set_values(case, {"clock.dt": row.hold, **values})
    if not row.pulses:
        case = case.replace(loop=dataclasses.replace(case.loop, disturbance=None))
    return case


def filter_of(case, row, start=None):
    """(SafetyFilter, certificate) of a row, for starts (n,) [cm], the case's where left out."""
    loop = case.loop
    plant = dataclasses.replace(loop.plant, overflow=False)
    loop = dataclasses.replace(loop, plant=plant, x0=loop.x0 if start is None else start)
    given = {"widths": of(loop.plant, SPREAD), "limit": row.rims, "band": row.eps}
    return design_for(case.replace(loop=loop), **given)


def nominal(case, found):
    """(total rms error, highest levels (n,)) [cm] of the case's run."""
    loop = dataclasses.replace(case.loop, safety_filter=found)
    of = evaluate(loop, case.clock, ["rms_error_total", "max_level"])
    return float(of["rms_error_total"]), np.asarray(of["max_level"])


def by_controller(case, found, limits, row, start, count):
    """(share of plants that pass a limit [-], largest excess [cm]) under the case's controller."""
    rng, loop = np.random.default_rng(1), case.loop
    plant = dataclasses.replace(loop.plant, overflow=False)
    shown = np.zeros(plant.tanks)
    sensor = dataclasses.replace(loop.sensor, offset=shown)
    loop = dataclasses.replace(loop, plant=plant, sensor=sensor, safety_filter=found)
    values: dict = {"sensor.offset": row.eps * rng.choice([-1.0, 1.0], (count, plant.tanks))}
    for name in ("drain", "orifice", "pipe", "pump_gain", "split"):
        nominal_value = np.asarray(getattr(plant, name), dtype=float)
        if nominal_value.size:
            off = 1.0 + SPREAD * rng.choice([-1.0, 1.0], (count, *nominal_value.shape))
            values[f"plant.{name}"] = nominal_value * off
    if "plant.split" in values:
        values["plant.split"] = np.minimum(values["plant.split"], 1.0)
    share = rng.uniform(0.2, 1.0, (count, 1)) * rng.uniform(0.0, 1.0, (count, plant.tanks)) ** 0.3
    values["x0"] = start * share

    @jax.jit
    @jax.vmap
    def highest(values):
        run = with_values(loop, values)
        return evaluate(run, case.clock, ["max_level"])["max_level"]

    over = np.max(np.asarray(highest(values)) - limits, axis=1)
    return float(np.mean(over > 1e-9)), float(over.max())


def by_pumps(case, found, limits, row, start, count):
    """((share of plants that pass a limit with full pumps, with pumps that switch), largest level
    over limit) [-].
    """
    actuator = case.loop.actuator
    low, high = np.maximum(actuator.low, 0.0), np.minimum(actuator.high, MOST)
    how: dict = {"seconds": row.seconds, "count": count, "eps": row.eps, "start": start}
    if case.loop.disturbance is not None:
        clock = dataclasses.replace(case.clock, duration=max(row.seconds, case.clock.duration))
        how["pulses"] = np.maximum(np.stack(case.loop.disturbance.sample(clock)[0], axis=1), 0.0)
        how["seconds"] = case.clock.duration
    pumps = dataclasses.replace(actuator, low=low, high=high)
    highest, _ = attack(case.loop.plant, pumps, found, row.hold, SPREAD, each=True, **how)
    over = np.max(highest - limits, axis=1) > 1e-9
    full = np.arange(count) % 3 == 0
    return over[full].mean(), over[~full].mean(), float((highest / limits).max())


def of_row(row, count):
    """Return the line of a row."""
    case = case_of(row)
    limits = np.asarray(case.loop.plant.rim if row.rims is None else row.rims, dtype=float)
    start = START * limits
    found, rows = filter_of(case, row, start)
    proved = "; ".join(
        f"{r.tank + 1}: {r.reason}, H {r.limit:.4g}" if r.certified else f"{r.tank + 1}: NOT"
        for r in rows
    )
    before, after = nominal(case, None), nominal(case, filter_of(case, row)[0])
    limits = np.array([r.limit for r in rows])
    free = by_controller(case, None, limits, row, start, count)
    held = by_controller(case, found, limits, row, start, count)
    full, switching, level = by_pumps(case, found, limits, row, start, count)
    return (
        f"{row.case}, T {row.hold:g} s, eps {row.eps:g}, rims {row.rims or 'own'} | {proved} | "
        f"{before[0]:.4f} -> {after[0]:.4f} ({before[1].max():.4g} -> {after[1].max():.4g}) | "
        f"{100 * free[0]:.0f} % ({free[1]:.3g}) | {100 * held[0]:.0f} / {100 * full:.0f} / "
        f"{100 * switching:.0f} % | {level:.5f}"
    )


def main(count, words):
    """Print the table; lengths in the units of each rig."""
    print(
        "case | proved | total rms error, nominal (highest level) | plants over a limit without"
        " filter (worst excess) | with: controller / full / switching pumps | level/limit"
    )
    for row in ROWS:
        if all(word in row.case for word in words):
            print(of_row(row, count), flush=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    numbers = [int(w) for w in sys.argv[1:] if w.isdigit()]
    main(numbers[0] if numbers else 60, [w for w in sys.argv[1:] if not w.isdigit()])

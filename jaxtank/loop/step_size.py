"""Integration steps too long for a tank that runs empty: there a level chatters, or water appears
from nowhere.

Near its bottom a tank of area A with outlets a_j (and pipes p_k) empties at the rate

    lambda = sqrt(2 g) (1.5 sum a_j + 2 sum p_k) / (A sqrt(knee))    [1/s]

of the film of `numerics.smooth_sqrt`, and a Runge-Kutta step h follows it while lambda h is below 2.785
(rk4) or 2 (midpoint), the ends of their stability regions on the negative axis (Hairer & Wanner
1996, sec. IV.2). Beyond, a level that should rest at 0 is thrown up again and again. How high
depends on lambda h alone, counted in knees, and is found here by doing it: 9 knees at 6.6, 160 at
15, 120,000 at 100.

In a rig with `bottom` a tank gives no more in one step than it holds (`TankNetwork.limited`):
nothing is thrown up and no volume appears, but a level below (h sqrt(2 g) (sum a_j + sum p_k) /
A)^2 stands too high, by at most that. Beyond lambda h = 2.785 of the pipes alone, levels that a
pipe has made equal still oscillate.
"""

import functools
import math
import warnings
from typing import Any, cast

import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.core.tree import split_index, walk

LIMITS = {"rk4": 2.785, "midpoint": 2.0}
SEEN = 0.01  # share of the levels that a run is about up to which one may be thrown without a word


def film_rates(plant, orifices=1.5, pipes=2.0) -> Any:
    """Return (n,) lambda of each tank [1/s], with these slopes of the film of its orifices and
    pipes; None of a plant of another kind, or one whose leaves are traced.
    """
    try:
        out, joined = np.array(plant.drain, dtype=float), np.zeros(plant.tanks)
        for k, (source, _) in enumerate(plant.links):
            out[source] += np.asarray(plant.orifice)[k]
        for k, ends in enumerate(plant.pipes):
            for i in ends:
                joined[i] += np.asarray(plant.pipe)[k]
        with np.errstate(all="ignore"):
            speed = np.sqrt(2.0 * np.asarray(plant.gravity, dtype=float) / plant.knee)
            rates = speed * (orifices * out + pipes * joined) / np.asarray(plant.area, dtype=float)
        return np.minimum(rates, 1e200)
    except (AttributeError, TypeError):  # what jax raises for a traced number is a TypeError
        return None


@functools.lru_cache(maxsize=256)
def thrown(product, integrator):
    """How high above an empty tank, in knees, a level is thrown in the long run, at lambda h =
    `product` of any start.
    """

    def rate(x):
        return (
            -product
            / 1.5
            * np.where(x >= 1.0, np.sqrt(np.maximum(x, 1.0)), x * (1.5 - 0.5 * np.maximum(x, 0.0)))
        )

    if product > 1e6:
        return math.inf
    x, highest = np.geomspace(1e-3, 4.0 * product**2 + 1.0, 200), 0.0
    with np.errstate(all="ignore"):
        for k in range(400):
            a = rate(x)
            b = rate(x + 0.5 * a)
            if integrator == "midpoint":
                x = x + b
            else:
                c = rate(x + 0.5 * b)
                x = x + (a + 2.0 * b + 2.0 * c + rate(x + c)) / 6.0
            highest = max(highest, float(np.max(np.abs(x)))) if k >= 200 else 0.0
    return highest if math.isfinite(highest) else math.inf


class StepWarning(UserWarning):
    """Steps too long for a tank that runs empty. The command says so in a note of its own."""


def check_step(loop, clock):
    """Raise InputError where a step would empty a full tank, and warn (StepWarning) where levels
    near a bottom are wrong.
    """
    plant, step = loop.plant, clock.dt / clock.substeps
    for tank, _, remedy in _thrown(loop, clock):
        # from a full tank: T = 2 A sqrt(h) / (sqrt(2 g) sum a), with the rate of the film in place
        # of its factors
        empty = 3.0 * math.sqrt(plant.rim[tank] / plant.knee) / film_rates(plant)[tank]
        if empty < step:
            raise InputError(
                f"clock.dt = {clock.dt:g} s: tank {tank + 1} runs empty in {empty:.2g} s, within"
                f" one step: {remedy}"
            )
    for line in doubts(loop, clock):
        warnings.warn(line, StepWarning, stacklevel=4)


def doubts(loop, clock):
    """A sentence on the tanks that would be thrown so high that it shows, or none; the worst is
    named.
    """
    length, shown = loop.plant.units[0], _seen(loop, clock)
    if not shown:
        return []
    tank, height, remedy = max(shown, key=lambda one: one[1] / loop.plant.rim[one[0]])
    others = f" (and so do {len(shown) - 1} more)" if len(shown) > 1 else ""
    up = f"thrown up by {height:.2g} {length}" if math.isfinite(height) else "thrown up without end"
    if loop.plant.bottom:
        up = f"up to {height:.2g} {length} too high" if math.isfinite(height) else "wrong"
    return [
        f"tank {tank + 1} runs empty faster than the steps follow{others}: once it is, its level is"
        f" {up} ({remedy})"
    ]


def check_run(loop, clock, run):
    """Raise InputError if in `run`, the whole Trajectory of a loop that has `doubts`, a tank was
    thrown up: the volume in a rig cannot rise by more than what is pumped and poured into it.
    """
    shown = _seen(loop, clock)
    if not shown:
        return
    least = _least_seen(loop, np.asarray(run.x))
    area, gain, dt = (
        np.asarray(loop.plant.area),
        np.array(loop.plant.pump_gain, dtype=float),
        clock.dt,
    )
    for k, (name, _, _) in enumerate(cast(Any, loop.faults.windows if loop.faults else ())):
        field, (entry,) = split_index(name)
        if field == "pump_gain":
            gain[entry] = max(
                gain[entry], gain[entry] * loop.faults.factor[k] + loop.faults.extra[k]
            )
        if field == "area":
            return  # what is stored changes with it
    x, u = np.asarray(run.x), np.asarray(run.u)
    inflow = np.maximum(u, 0.0) @ gain
    if loop.disturbance is not None:
        inflow = inflow + sum(
            np.maximum(np.asarray(d), 0.0) for d in loop.disturbance.sample(clock)[0]
        )
    gained = np.diff(x @ area) - dt * inflow[:-1]  # from nowhere
    for tank, _, remedy in shown:
        bad = (gained > area[tank] * least[tank]) & (np.diff(x[:, tank]) > least[tank])
        if bad.any():
            raise InputError(
                f"clock.dt = {clock.dt:g} s: steps too long to follow tank {tank + 1}, which runs"
                f" empty, threw its level up after t = {np.argmax(bad) * dt:g} s: {remedy}"
            )


def _seen(loop, clock):
    """Those of `_thrown` whose height shows; none where the levels that tell are traced."""
    found = list(_thrown(loop, clock))
    least = _least_seen(loop) if found else None
    return [] if least is None else [one for one in found if one[1] > least[one[0]]]


def _least_seen(loop, x: Any = 0.0) -> Any:
    """(n,) heights from which a throw shows: a share of the rim, or of the highest level of start,
    setpoint and the run's levels `x` where that is lower, for a rim may be a limit far above all
    that happens. Of a run from empty tanks to nowhere, of the rim. None of traced levels.
    """
    plant = loop.plant
    highest = lambda v: float(np.max(v, initial=0.0, where=np.isfinite(v)))
    try:
        levels = [
            v
            for _, v, meta in walk(loop.reference, units=plant.units)
            if meta["unit"] in (plant.units[0], "-")
        ]  # "-": as of a Table
        about = max(
            highest(np.abs(np.asarray(v, dtype=float))) for v in (loop.x0, *levels) if v is not None
        )
        rim = np.asarray(plant.rim, dtype=float)
        return SEEN * (rim if about <= plant.knee else np.minimum(rim, max(about, highest(x))))
    except TypeError:  # what jax raises for a traced number
        return None


def _thrown(loop, clock):
    """(tank, height [length of the rig], what helps) of every tank whose film is too fast."""
    rates = film_rates(loop.plant)
    if rates is None:
        return
    step, limit = clock.dt / clock.substeps, LIMITS[clock.integrator]
    for tank, product in enumerate(rates * step):
        if product > limit:
            height = _height(loop.plant, tank, step, product, clock.integrator) * loop.plant.knee
            substeps = math.ceil(clock.substeps * product / limit)
            remedy = (
                f"clock.substeps = {substeps}"
                if substeps <= 10
                else f"clock.dt of at most {step * limit / product:.2g} s"
            )
            yield tank, height, f"{remedy} is short enough"


def _height(plant, tank, step, product, integrator):
    """How far off the level of a tank may be once it is empty, in knees."""
    if not plant.bottom:
        return thrown(float(f"{product:.3g}"), integrator)
    held = (step * film_rates(plant, 1.0, 1.0)[tank]) ** 2
    pipes = step * film_rates(plant, 0.0, 2.0)[tank]
    return max(
        held, thrown(float(f"{pipes:.3g}"), integrator) if pipes > LIMITS[integrator] else 0.0
    )

"""Integration steps too long for a tank that runs empty: there the explicit step is unstable.

Near its bottom a tank of area A with outlets a_j (and pipes p_k) empties at the rate

    lambda = sqrt(2 g) (1.5 sum a_j + 2 sum p_k) / (A sqrt(threshold))    [1/s]

of laminar flow below `plant.knee`; a step h is stable while lambda h < 2.785 (rk4) or 2 (midpoint),
the ends of the stability regions on the negative axis (Hairer & Wanner 1996, sec. IV.2). Beyond, a
level that should stay at 0 rises again and again, to a height in thresholds that depends on lambda
h alone. With `bottom` no volume appears (`TankNetwork.limited`), but a level below
(h sqrt(2 g) (sum a_j + sum p_k) / A)^2 stands too high, by at most that. Of a network that is not
plain, lambda is the largest slope of the flows over the cross-section, at the bottom or at a port.
"""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false, reportUnknownLambdaType=false

import dataclasses
import functools
import math
import warnings
from collections.abc import Iterator
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.clock import Clock
from jaxtank.core.curves import monotone_curve
from jaxtank.core.errors import InputError
from jaxtank.core.labels import label_of, labels_of
from jaxtank.core.tree import split_index, walk
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.loop.trajectory import Trajectory
from jaxtank.plants import elements

LIMITS = {"rk4": 2.785, "midpoint": 2.0}
"""Largest stable lambda h of each integrator [-]."""
SEEN = 0.01
"""Share of the levels of a run up to which a level may be wrong without a warning [-]."""


class StepWarning(UserWarning):
    """Steps too long for a tank that runs empty. The command prints a note instead."""


class Unstable(NamedTuple):
    """A tank whose steps are too long near empty."""

    tank: int  # counted from 0
    height: float  # how far off its level may be [length of the rig]
    remedy: str  # a setting that is short enough


def emptying_rates(plant: Any, orifices: float = 1.5, pipes: float = 2.0) -> Any:
    """Lambda (n,) of each tank [1/s]; None of traced leaves or another kind of plant."""
    try:
        if not getattr(plant, "plain", True):
            alone, joined = _slopes_of_elements(plant)
            return orifices / 1.5 * alone + pipes / 2.0 * joined
        out, joined = np.array(plant.drain, dtype=float), np.zeros(plant.tanks)
        orifice, pipe = np.asarray(plant.orifice), np.asarray(plant.pipe)
        for k, (source, _) in enumerate(plant.links):
            out[source] += orifice[k]
        for k, ends in enumerate(plant.pipes):
            for i in ends:
                joined[i] += pipe[k]
        with np.errstate(all="ignore"):
            speed = np.sqrt(2.0 * np.asarray(plant.gravity, dtype=float) / plant.knee)
            rates = speed * (orifices * out + pipes * joined) / np.asarray(plant.area, dtype=float)
        return np.minimum(rates, 1e200)
    except (AttributeError, TypeError):  # jax raises a TypeError for a traced number
        return None


def _slopes_of_elements(plant: Any) -> tuple[Any, Any]:
    """((n,) slopes of flows by one level, (n,) of flows by two, twice) over the sections [1/s]."""
    n, knee = plant.tanks, plant.knee
    ports = [v for name in elements.PORTS if (v := getattr(plant, name)) is not None]
    heads = np.unique([0.0, *(float(v) + 1e-3 * knee for v in np.concatenate([*ports, []]))])
    x = np.broadcast_to(heads[:, None], (len(heads), n))
    with jax.enable_x64(True):
        slopes, joined = (np.asarray(v) for v in _flow_slopes(plant, x))
        height = np.maximum(x, SEEN * np.asarray(plant.rim, dtype=float) if plant.shapes else 0.0)
        section = np.stack([np.broadcast_to(v, len(heads)) for v in plant.sections(height.T)], 1)
    # near a tip a step that is too long misplaces a small volume only, which `bottom` keeps
    counted = 1.0 - _narrow(plant)
    return counted * np.max(slopes / section, axis=0), counted * np.max(joined / section, axis=0)


def _narrow(plant: Any) -> Any:
    """(n,) 1.0 of a tank with a tip below which `bottom` lets no level fall, else 0.0."""
    narrow = [plant.bottom and shape in ("cone", "sphere") for shape in plant.shapes]
    return np.array(narrow or [False] * plant.tanks, dtype=float)


def narrow_tanks(loop: ClosedLoop, clock: Clock) -> dict[int, float]:
    """{tank that may stand visibly too high: level below which a step takes more than it holds}."""
    plant: Any = loop.plant
    if not getattr(plant, "shapes", ()) or not _narrow(plant).any():
        return {}
    heights = _overdrawn(plant, clock.dt / clock.substeps)
    seen = (heights > visible_heights(loop)) & (_narrow(plant) > 0)
    return {int(i): float(heights[i]) for i in np.flatnonzero(seen)}


DREGS = 0.01
"""Share of the rim up to which a tank is filled with the volume that a pump's draw in one step is
compared with [-]."""


def pump_draws(loop: ClosedLoop, clock: Clock) -> list[tuple[int, int, float]]:
    """Return (pump, source tank, ratio) of each pump with a source tank."""
    # ratio: the volume that the pump takes in one step at its upper limit, over that of the tank
    # filled to DREGS of its rim [-]
    plant, actuator = loop.plant, loop.actuator
    step, rows = clock.dt / clock.substeps, list[tuple[int, int, float]]()
    for j, i in enumerate(getattr(plant, "sources", ()) or ()):
        if i is None:
            continue
        curve, demand = plant.curves[j] if plant.curves else None, float(actuator.high[j])
        demand = demand if curve is None else float(monotone_curve(curve, demand))
        most = DREGS * float(plant.rim[i])
        capacity = plant.stored((most,) * plant.tanks)[i] if plant.shapes else plant.area[i] * most
        rows.append((j, i, float(plant.pump_gain[j] * demand * step / capacity)))
    return rows


@jax.jit
def _flow_slopes(plant: Any, x: Any) -> Any:
    """((rows, n) slopes of flows by one level, of flows by two) at levels x (rows, n)."""

    def flows(x: Any) -> Any:
        streams = elements.streams(plant, tuple(x), elements.valves_open(plant))
        return jnp.stack([s.flow for s in streams])

    ends = elements.streams(plant, (0.0,) * plant.tanks, elements.valves_open(plant))
    slopes = jax.vmap(jax.jacfwd(flows))(x)
    alone, joined = [0.0] * plant.tanks, [0.0] * plant.tanks
    for k, (source, sink, *_) in enumerate(ends):
        size = jnp.abs(slopes[:, k])
        for i in (i for i in (source, sink) if i is not None):
            others = jnp.sum(size, axis=1) - size[:, i]
            joined[i] = joined[i] + 2.0 * jnp.where(others > 0.0, size[:, i], 0.0)
            alone[i] = alone[i] + jnp.where(others > 0.0, 0.0, size[:, i]) * (i == source)
    rows = lambda columns: jnp.stack([jnp.broadcast_to(v, x.shape[0]) for v in columns], axis=1)
    return rows(alone), rows(joined)


@jax.jit
def _outflows(plant: Any, x: Any) -> Any:
    """(rows, n) flow that leaves each tank and (rows, n) its volume, at levels x (rows, n)."""

    def at(x: Any) -> Any:
        leaving: list[Any] = [0.0] * plant.tanks
        for source, _, flow, _ in elements.streams(plant, tuple(x), elements.valves_open(plant)):
            if source is not None:
                leaving[source] = leaving[source] + jnp.maximum(flow, 0.0)
        return jnp.stack([v + 0.0 * x[0] for v in leaving]), jnp.stack(plant.stored(tuple(x)))

    return jax.vmap(at)(x)


def _overdrawn(plant: Any, step: float) -> Any:
    """(n,) highest level at which a tank gives less in a step than its outlets would take."""
    rim = np.asarray(plant.rim, dtype=float)
    x = np.minimum(rim, 1e6 * plant.knee) * np.geomspace(1e-7, 1.0, 400)[:, None]
    with jax.enable_x64(True):
        leaving, stored = (np.asarray(v) for v in _outflows(plant, x))
        steep = np.stack(elements.steepness(plant, (*x.T,), (*leaving.T,), step), axis=1)
    shaped = np.array([shape != "prism" for shape in plant.shapes] or [False] * plant.tanks)
    limited = (stored < step * leaving) & ((steep > elements.STABLE[0]) | ~shaped)
    return np.max(np.where(limited, x, 0.0), axis=0)


@functools.lru_cache(maxsize=256)
def unstable_height(product: float, integrator: str) -> float:
    """How high a level rises above empty at lambda h = `product`, in thresholds."""

    def rate(x: Any) -> Any:
        laminar = x * (1.5 - 0.5 * np.maximum(x, 0.0))
        flow = cast(Any, np.where(x >= 1.0, np.sqrt(np.maximum(x, 1.0)), laminar))
        return -product / 1.5 * flow

    def stepped(x: Any) -> Any:
        a = rate(x)
        b = rate(x + 0.5 * a)
        if integrator == "midpoint":
            return x + b
        c = rate(x + 0.5 * b)
        return x + (a + 2.0 * b + 2.0 * c + rate(x + c)) / 6.0

    if product > 1e6:
        return math.inf
    x: Any = np.geomspace(1e-3, 4.0 * product**2 + 1.0, 200)
    highest = 0.0
    with np.errstate(all="ignore"):
        for k in range(400):
            x = stepped(x)
            highest = max(highest, float(np.max(np.abs(x)))) if k >= 200 else 0.0
    return highest if math.isfinite(highest) else math.inf


def check_step(loop: ClosedLoop, clock: Clock) -> None:
    """Raise InputError where a step empties a full tank; warn where levels near 0 are wrong."""
    plant: Any = loop.plant
    step = clock.dt / clock.substeps
    rates = emptying_rates(plant)
    for unstable in unstable_tanks(loop, clock):
        # from a full tank: T = 2 A sqrt(h) / (sqrt(2 g) sum a), with the rate of laminar flow in
        # place of its factors
        if plant.plain:
            full = math.sqrt(plant.rim[unstable.tank] / plant.knee)
            empty = 3.0 * full / rates[unstable.tank]
        else:
            leaving, stored = _outflows(plant, np.asarray(plant.rim, dtype=float)[None])
            empty = float(stored[0, unstable.tank] / leaving[0, unstable.tank])
        if empty < step:
            name = label_of(plant, "tank", unstable.tank)
            raise InputError(
                f"clock.dt = {clock.dt:g} s: {name} runs empty in {empty:.2g} s, within one step:"
                f" {unstable.remedy}"
            )
    for line in step_warnings(loop, clock):
        warnings.warn(line, StepWarning, stacklevel=6)


def step_warnings(loop: ClosedLoop, clock: Clock) -> list[str]:
    """A sentence on tanks whose levels are visibly wrong near empty, the worst named; or none."""
    length, visible = loop.units[0], _visible(loop, clock)
    if not visible:
        return _tip_warnings(loop, clock)
    tank, height, remedy = max(visible, key=lambda item: item.height / loop.plant.rim[item.tank])
    others = f" (and for {len(visible) - 1} more)" if len(visible) > 1 else ""
    amount = f"{height:.2g} {length}" if math.isfinite(height) else "no bound"
    wrong = f"the explicit step is unstable and its level rises to {amount} alone, further if fed"
    if getattr(loop.plant, "bottom", False):
        high = f"up to {amount} too high" if math.isfinite(height) else "wrong"
        wrong = f"its level is {high}"
    return [
        f"steps too long for an empty {label_of(loop.plant, 'tank', tank)}{others}:"
        f" where it runs empty, {wrong} ({remedy})"
    ]


def _tip_warnings(loop: ClosedLoop, clock: Clock) -> list[str]:
    """Return a sentence on the tanks that begin, or are to be held, where steps pass their tip."""
    try:
        narrow = narrow_tanks(loop, clock)
        lowest = np.array(loop.x0, dtype=float) if narrow else np.zeros(0)
    except TypeError:  # raised by jax for a traced number
        return []
    plateaus = loop.reference.plateaus() if narrow else None
    for setpoints in () if plateaus is None else plateaus:
        for tank, setpoint in zip(loop.plant.outputs, setpoints):
            lowest[tank] = min(lowest[tank], float(setpoint))
    tanks = [tank for tank, height in narrow.items() if lowest[tank] <= height]
    if not tanks:
        return []
    heights = ", ".join(f"{narrow[tank]:.2g}" for tank in tanks)
    return [
        f"steps too long near the tip of {labels_of(loop.plant, 'tank', tanks)}: below"
        f" {heights} {loop.units[0]} one takes more liquid than there is, and the level is wrong"
        " (halve clock.dt or double clock.substeps)"
    ]


def check_run(loop: ClosedLoop, clock: Clock, run: Trajectory) -> None:
    """Raise InputError where volume appears in a run: the explicit step was unstable."""
    visible, names = _visible(loop, clock), [name for name, *_ in _fault_windows(loop)]
    if not visible or any(name.startswith(("area", "extent")) for name in names):
        return  # a fault of an area changes what is stored
    plant: Any = loop.plant  # a network of tanks
    x, least = np.asarray(run.x), visible_heights(loop, np.asarray(run.x))
    area, inflow = np.asarray(plant.area), _largest_inflow(loop, clock, np.asarray(run.u))
    volume = sum(np.asarray(v) for v in plant.stored(x.T)) if plant.shapes else x @ area
    gained = np.diff(volume) - clock.dt * inflow[:-1]  # volume from nowhere
    for tank, _, remedy in visible:
        bad = (gained > area[tank] * least[tank]) & (np.diff(x[:, tank]) > least[tank])
        if bad.any():
            raise InputError(
                f"clock.dt = {clock.dt:g} s: steps too long to follow"
                f" {label_of(plant, 'tank', tank)}, which runs empty: near empty the explicit step"
                " is unstable and its level rises by itself after"
                f" t = {np.argmax(bad) * clock.dt:g} s: {remedy}"
            )


def _fault_windows(loop: ClosedLoop) -> tuple[tuple[str, float, float], ...]:
    return () if loop.faults is None else loop.faults.windows


def _largest_inflow(loop: ClosedLoop, clock: Clock, u: Any) -> Any:
    """Return the (samples,) largest total inflow [cm^3/s] for inputs `u` of all samples."""
    plant: Any = loop.plant  # a network of tanks
    gain: Any = np.array(plant.pump_gain, dtype=float)
    faults: Any = loop.faults
    for k, (name, _, _) in enumerate(_fault_windows(loop)):
        field, index = split_index(name)
        if field == "pump_gain":
            gain[index] = max(gain[index], gain[index] * faults.factor[k] + faults.extra[k])
    if plant.plain:
        inflow = np.maximum(u, 0.0) @ gain
    else:
        inflow = elements.largest_supply(dataclasses.replace(plant, pump_gain=gain), u)
    if loop.disturbance is not None:
        inflows = loop.disturbance.sample(clock)[0]
        inflow = inflow + sum(np.maximum(np.asarray(d), 0.0) for d in inflows)
    return inflow


def _visible(loop: ClosedLoop, clock: Clock) -> list[Unstable]:
    """Those of `unstable_tanks` whose height shows; none where the levels needed are traced."""
    unstable = list(unstable_tanks(loop, clock))
    least = visible_heights(loop) if unstable else None
    return [] if least is None else [item for item in unstable if item.height > least[item.tank]]


def visible_heights(loop: ClosedLoop, x: Any = 0.0) -> Any:
    """Heights (n,) from which an error shows; None of traced levels."""
    # A share of the rim, or of the highest level of start, setpoint and run where that is lower: a
    # rim may be a limit far above all that happens.
    plant: Any = loop.plant

    def highest(v: Any) -> float:
        return float(np.max(v, initial=0.0, where=np.isfinite(v)))

    try:
        fields = walk(loop.reference, units=plant.units)
        # "-": as of a Table
        levels = [v for _, v, meta in fields if meta["unit"] in (plant.units[0], "-")]
        levels = [np.asarray(v, dtype=float) for v in (loop.x0, *levels) if v is not None]
        about = max(highest(np.abs(v)) for v in levels)
        rim = np.asarray(plant.rim, dtype=float)
        empty = about <= plant.knee
        return SEEN * (rim if empty else np.minimum(rim, max(about, highest(x))))
    except TypeError:  # raised by jax for a traced number
        return None


def unstable_tanks(loop: ClosedLoop, clock: Clock) -> Iterator[Unstable]:
    """Yield every tank that empties faster than the steps are stable."""
    plant: Any = loop.plant
    rates = emptying_rates(plant)
    if rates is None:
        return
    step, limit = clock.dt / clock.substeps, LIMITS[clock.integrator]
    for tank, product in enumerate(rates * step):
        if product > limit:
            height = _height(plant, tank, step, product, clock.integrator) * plant.knee
            substeps = math.ceil(clock.substeps * product / limit)
            remedy = f"clock.substeps = {substeps}"
            if substeps > 10:
                remedy = f"clock.dt of at most {step * limit / product:.2g} s"
            yield Unstable(tank, height, f"{remedy} is short enough")


def _height(plant: Any, tank: int, step: float, product: float, integrator: str) -> float:
    """Largest error of the level of an empty tank, in thresholds."""
    joined = step * emptying_rates(plant, 0.0, 2.0)[tank]  # by pipes
    if not plant.plain:
        bounded = plant.bottom and joined <= LIMITS[integrator]
        return float(_overdrawn(plant, step)[tank]) / plant.knee if bounded else math.inf
    if not plant.bottom:
        return unstable_height(float(f"{product:.3g}"), integrator)
    excess = float((step * emptying_rates(plant, 1.0, 1.0)[tank]) ** 2)
    if joined <= LIMITS[integrator]:
        return excess
    return max(excess, unstable_height(float(f"{joined:.3g}"), integrator))

"""TankNetwork: tanks joined by orifices and pipes, filled by pumps; one class serves every rig."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxtank.core.numerics import (
    clip,
    limited_flow,
    limited_sqrt,
    lower_clip,
    smooth_signed_sqrt,
    smooth_sqrt,
)
from jaxtank.core.tree import POSITIVE, component, leaf, note, static
from jaxtank.core.units import DEFAULT
from jaxtank.core.vectors import each, is_array, take, zeros
from jaxtank.plants import elements
from jaxtank.plants.base import Plant
from jaxtank.xla.barrier import materialised, with_one_slope
from jaxtank.xla.gather import gathered


def first_of(pairs: tuple[tuple[int, ...], ...]) -> tuple[int, ...]:
    """Return the first entry of each pair."""
    return tuple(a for a, _ in pairs)


def second_of(pairs: tuple[tuple[int, ...], ...]) -> tuple[int, ...]:
    """Return the second entry of each pair."""
    return tuple(b for _, b in pairs)


def pumped(net: Any, u: Any) -> Any:
    """Return (n,) what the pumps bring to each tank [cm^3/s] for inputs u (m,)."""
    firsts = [(j, first, second is not None) for j, (first, second) in enumerate(net.feeds)]
    seconds = [(j, second) for j, (_, second) in enumerate(net.feeds) if second is not None]
    gain, split = jnp.asarray(net.pump_gain), jnp.asarray(net.split)
    # a pump without a second tank brings all to its first, whatever its split is
    shared = np.array([s for *_, s in firsts])
    shares = gain * jnp.where(shared, split, 1.0)
    pumps, ends = [j for j, *_ in firsts], [tank for _, tank, _ in firsts]
    if seconds:
        at = np.array([j for j, _ in seconds])
        shares = jnp.concatenate([shares, take(gain * (1.0 - split), at)])
        pumps, ends = pumps + [j for j, _ in seconds], ends + [tank for _, tank in seconds]
    return gathered(shares, u, tuple(ends), net.tanks, of=pumps)


def outlets(net: Any) -> Any:
    """Return (n,) area of the outlets of each tank, orifices and drain [cm^2]."""
    leaving = gathered(jnp.asarray(net.orifice), None, first_of(net.links), net.tanks)
    return jnp.asarray(net.drain) + (0.0 if leaving is None else leaving)


def supply(net: Any, step: Any) -> Any:
    """Return (n,) largest ratio of root to level in a step [cm^-0.5] (`TankNetwork.limited`)."""
    pipe = jnp.asarray(net.pipe)
    areas = outlets(net)
    for ends in (first_of(net.pipes), second_of(net.pipes)):
        if ends:
            areas = areas + gathered(pipe, None, ends, net.tanks)
    # of the inverse, which is 0 and not infinite for a tank without outlets
    turnover = step * jnp.sqrt(2.0 * net.gravity)
    return 1.0 / lower_clip(turnover * areas / jnp.asarray(net.area), net.knee**0.5 / 1.5)


def flows(net: Any, x: Any, u: Any, d: Any, step: Any = None) -> Any:
    """Rates (n,) [cm/s] of levels x (n,), as `derivative`; with `step`, as `limited`."""
    w, per_area = jnp.sqrt(2.0 * net.gravity), 1.0 / jnp.asarray(net.area)
    enters = pumped(net, u) if d is None else pumped(net, u) + d
    most: Any = None if step is None else supply(net, step)
    root = with_one_slope(lambda h: smooth_sqrt(h, net.knee))
    q = root(x) if step is None else limited_sqrt(x, net.knee, most)
    v = w * q
    if net.links:
        v = materialised(v)  # read by every orifice
        orifice, ends = jnp.asarray(net.orifice), second_of(net.links)
        enters = enters + gathered(orifice, v, ends, net.tanks, of=first_of(net.links))
    rate = (enters - outlets(net) * v) * per_area
    return rate + piped(net, x, most) * per_area if net.pipes else rate


def piped(net: Any, x: Any, most: Any) -> Any:
    """Return (n,) what the pipes bring to each tank [cm^3/s]."""
    first, second = first_of(net.pipes), second_of(net.pipes)
    levels = x if most is None else lower_clip(x, 0.0)
    root = with_one_slope(lambda h: smooth_signed_sqrt(h, net.knee))
    s = root(take(levels, first) - take(levels, second))
    if most is not None:
        s = limited_flow(s, take(most * levels, first), take(most * levels, second))
    flow = materialised(jnp.asarray(net.pipe) * jnp.sqrt(2.0 * net.gravity) * s)
    pipes = range(len(first))
    signs = np.repeat([-1.0, 1.0], len(first))
    return gathered(signs, flow, first + second, net.tanks, of=(*pipes, *pipes))


UNROLLED = 4  # overflows into each other, one after the other, up to which each is written out

Pairs = tuple[tuple[int, int], ...]


@functools.lru_cache(maxsize=256)
def downwards(spills: Pairs, tanks: int) -> tuple[list[int], list[int]]:
    """Return (every tank, after those that overflow into it; the tanks of rings, where there is no
    such order): what a tank receives must be in it before its own overflow is computed.
    """
    below: list[list[int]] = [[] for _ in range(tanks)]
    waits = [0] * tanks
    for source, sink in spills:
        below[source].append(sink)
        waits[sink] += 1
    order: list[int] = []
    free = [i for i in range(tanks) if not waits[i]]
    while free:
        order += free
        after: list[int] = []
        for sink in (sink for i in free for sink in below[i]):
            waits[sink] -= 1
            if not waits[sink]:
                after.append(sink)
        free = sorted(after)
    placed = set(order)
    ring = [i for i in range(tanks) if i not in placed]
    return [*order, *ring], ring


class Cascade(NamedTuple):
    """The spills of a rig, in the order in which its tanks overflow."""

    forth: np.ndarray[Any, Any]  # spills into a tank that comes later in the order
    back: np.ndarray[Any, Any]  # those of a ring into a tank that has overflowed before
    ring: np.ndarray[Any, Any]  # (n,) whether a tank belongs to a ring, or follows one
    depth: int  # how many overflows can follow each other


@functools.lru_cache(maxsize=256)
def cascade(spills: Pairs, tanks: int) -> Cascade:
    """Return the Cascade of the spills of a rig."""
    order, ring = downwards(spills, tanks)
    place = {tank: k for k, tank in enumerate(order)}
    forward = [k for k, (source, sink) in enumerate(spills) if place[source] < place[sink]]
    behind = [k for k in range(len(spills)) if k not in set(forward)]
    level = [0] * tanks
    for k in sorted(forward, key=lambda k: place[spills[k][0]]):
        source, sink = spills[k]
        level[sink] = max(level[sink], level[source] + 1)
    rings = np.zeros(tanks, dtype=bool)
    rings[ring] = True
    return Cascade(np.array(forward, int), np.array(behind, int), rings, max(level, default=0))


def overflowed(net: Any, x: Any) -> tuple[Any, Any]:
    """Return (levels (n,) at or below the rims, volume lost over each rim (n,) [cm^3])."""
    area, rim, caught = (jnp.asarray(v) for v in (net.area, net.rim, net.caught))
    order = cascade(net.spills, net.tanks)

    def over(levels: Any) -> Any:
        return materialised(area * (levels - clip(levels, -rim, rim)))

    def caught_of(volumes: Any, which: np.ndarray[Any, Any]) -> Any:
        """(n,) what the spills `which` bring to each tank, as a rise of its level [cm]."""
        source = [net.spills[k][0] for k in which]
        sink = tuple(net.spills[k][1] for k in which)
        return gathered(caught[which], volumes, sink, net.tanks, of=source) / area

    def further(volumes: Any, _: Any) -> Any:
        return over(x + caught_of(volumes, order.forth)), None

    volumes = over(x)
    if order.depth > UNROLLED:

        def all_of(volumes: Any) -> Any:
            return jax.lax.scan(further, volumes, None, length=order.depth)[0]

        # most samples have no overflow, and none then follows
        full = jnp.any(volumes != 0.0)
        volumes = jax.lax.cond(full, all_of, lambda volumes: volumes, volumes)
    else:
        for _ in range(order.depth):
            volumes, _ = further(volumes, None)
    if order.depth:
        x = x + caught_of(volumes, order.forth)
    x, lost = clip(x, -rim, rim), volumes
    if net.spills:
        share = gathered(caught, None, tuple(a for a, _ in net.spills), net.tanks)
        lost = volumes * (1.0 - share)
    if len(order.back):  # what has come back to a full tank leaves the rig there
        x = x + caught_of(volumes, order.back)
        clipped = jnp.where(order.ring, clip(x, -rim, rim), x)
        lost, x = lost + area * (x - clipped), clipped
    return x, lost


OPTIONS = ("extent", "spill_port", "valve_port", "pipe_port") + tuple(
    f"{opening}_{option}"
    for opening in ("drain", "orifice")
    for option in ("port", "exponent", "resistance")
)
"""Leaves of a `TankNetwork` that are absent from a plain one."""


EXPONENT = "exponent of the head in the flow of each {}; 0.5: Torricelli"
RESISTANCE = "resistance R of a linear outlet beside each {}, whose flow is head/R; inf: none"


def _option(unit: str, doc: str, *, of: str, shape: str = "", low: float = 0.0, **more: Any) -> Any:
    """A leaf of an element that a plain network does not have; `of` is the leaf beside it."""
    shape = shape or {"drain": "tank"}.get(of, of)
    return leaf(unit, doc, low=low, like=of, default=None, shape=shape, **more)


@component
class TankNetwork(Plant):
    """n tanks joined by orifices that discharge from one tank into another or into the basin, and
    by pipes below the surface; m pumps.

        A_i h_i' = sum_j s_ji v_j - (s_i + sum_j s_ij) v_i + sum_j p_ij w_ji + pumped_i + d_i
        v = sqrt(2 g h)   (Torricelli; gouta2015 eqs. 1-8),      w_ji = sgn(h_j - h_i) sqrt(2 g |h_j
        - h_i|)   (gouta2022 eqs. 1-2)

    Pump j delivers pump_gain_j u_j: the share split_j to its first tank and the rest to its second.
    An orifice discharges freely, so its flow depends on the level above it alone; a pipe's flow
    depends on the difference of the two levels and changes its direction with it. Levels may fall
    to zero and stay there; with `overflow` they stop at the rim and what would rise past it
    overflows (and is counted), except for the share `caught` that falls into another tank;
    otherwise a rim is only a limit and levels may rise past it. With `bottom`, a level stops at
    zero where a negative inflow would take it below, and no tank gives more in one integration step
    than it holds (see `limited`) and, where it has a shape, gets. `jaxtank.plants.network` builds
    one from plain numbers.

    Examples
    --------
    >>> from jaxtank.plants import network
    >>> tank = network(area=[25.0], drain=[0.3], pump_gain=[8.0], feeds=[(0, None)], rim=[30.0])
    >>> [round(float(rate), 3) for rate in tank.derivative(0.0, (4.0,), (6.0,), None)]
    [0.857]
    """

    area: np.ndarray = leaf("cm^2", "cross-section A of each tank", **POSITIVE, shape="tank")
    drain: np.ndarray = leaf(
        "cm^2",
        "effective orifice area from each tank to the basin; 0: closed",
        low=0.0,
        shape="tank",
    )
    orifice: np.ndarray = leaf(
        "cm^2",
        "effective area of the orifices between tanks, in the order of `links`",
        low=0.0,
        shape="orifice",
    )
    pipe: np.ndarray = leaf(
        "cm^2",
        "effective area of the pipes between tanks, in the order of `pipes`",
        low=0.0,
        shape="pipe",
    )
    pump_gain: np.ndarray = leaf(
        "cm^3/(s V)", "flow per unit of each pump's input (Kp)", **POSITIVE, shape="feed"
    )
    split: np.ndarray = leaf(
        "-", "share of each pump that goes to its first tank", low=0.0, high=1.0, shape="feed"
    )
    valve: Any = _option(
        "cm^2",
        "effective area of each valve, full open, in the order of `valves`",
        of="area",
        shape="valve",
        strict=True,
    )
    rangeability: Any = _option(
        "-",
        "flow of an equal-percentage valve full open, in flows at opening 0",
        of="area",
        shape="valve",
        low=1.0,
        strict=True,
    )
    extent: Any = _option(
        "cm",
        "level at which the shape of each tank ends: height of a cone, diameter of a sphere",
        of="area",
        shape="tank",
        strict=True,
    )
    drain_port: Any = _option("cm", "height of each drain above the bottom", of="drain")
    orifice_port: Any = _option("cm", "height of each orifice above the bottom", of="orifice")
    pipe_port: Any = _option("cm", "height of the ends of each pipe above the bottoms", of="pipe")
    valve_port: Any = _option("cm", "height of each valve above the bottom", of="valve")
    spill_port: Any = _option(
        "cm",
        "height of the overflow opening of each spill, where below the rim",
        of="caught",
        shape="spill",
        strict=True,
    )
    drain_exponent: Any = _option("-", EXPONENT.format("drain"), of="drain", high=4.0, strict=True)
    orifice_exponent: Any = _option(
        "-", EXPONENT.format("orifice"), of="orifice", high=4.0, strict=True
    )
    drain_resistance: Any = _option(
        "s/cm^2", RESISTANCE.format("drain"), of="drain", strict=True, infinite=True
    )
    orifice_resistance: Any = _option(
        "s/cm^2", RESISTANCE.format("orifice"), of="orifice", strict=True, infinite=True
    )
    gravity: np.ndarray = leaf("cm/s^2", "acceleration g", **POSITIVE)
    rim: np.ndarray = leaf("cm", "height of each tank", **POSITIVE, shape="tank")
    caught: np.ndarray = leaf(
        "-",
        "share of what passes a rim that falls into another tank",
        low=0.0,
        high=1.0,
        shape="spill",
    )
    links: tuple = static(doc="((from, to), ...) tanks joined by each orifice")
    pipes: tuple = static(doc="((one, other), ...) tanks joined by each pipe", default=())
    feeds: tuple = static(
        doc="((first tank, second tank or None), ...) one per pump; (None, None): the basin"
    )
    sources: tuple = static(
        doc="the tank from which each pump draws, or None: the basin; () where all do", default=()
    )
    curves: tuple = static(
        doc="((input, flow), ...) of each pump, or None: as its input; () where all do", default=()
    )
    lift_curves: tuple = static(
        doc="((lift, share of the flow), ...) of each pump, or None; () where all do", default=()
    )
    valves: tuple = static(doc="((from, to or None), ...) tanks of each valve", default=())
    characteristics: tuple = static(
        doc='"linear", "equal-percentage" or ((opening, share), ...) of each valve', default=()
    )
    one_way: tuple = static(doc="whether each valve lets nothing back", default=())
    shapes: tuple = static(
        doc='"prism" or another shape of `vessels` of each tank; () where all are prisms',
        default=(),
    )
    spills: tuple = static(doc="((from, to), ...) where what passes a rim falls", default=())
    outputs: tuple = static(doc="tanks whose levels are controlled")
    names: tuple = note(())
    units: tuple = static(doc="(length, pump input): the units of this rig", default=DEFAULT)
    overflow: bool = static(
        doc="overflow is simulated: a level stops at the rim, the rest is lost",
        choices=(False, True),
        default=False,
    )
    bottom: bool = static(
        doc="a level stops at zero whatever is drawn from it", choices=(False, True), default=False
    )
    # lower bound: a nanometre or less, the root is then exact for any level that means something,
    # and its power -3/2 is still finite
    knee: float = static(
        "cm", "level, or difference of levels, below which flow turns laminar", low=1e-15
    )

    def metadata_of(self, field: str) -> dict[str, Any]:
        """Return changes of a field's metadata: the gain of pumps with curves is a factor."""
        curved = bool(self.curves) and None not in self.curves[: len(self.feeds)]
        factor = {"unit": "-", "doc": "factor of the flow of each pump's curve"}
        return factor if field == "pump_gain" and curved else {}

    @property
    def plain(self) -> bool:
        """Whether the rig has nothing but what the equations above have."""
        absent = (getattr(self, name) is None for name in OPTIONS)
        return all(absent) and not (
            self.sources or self.curves or self.lift_curves or self.valves or self.shapes
        )

    @property
    def arrays(self) -> bool:
        return self.plain

    @property
    def tanks(self) -> int:
        # a fault of a rim makes a tuple of traced numbers of it
        return len(self.rim) if isinstance(self.rim, tuple) else np.shape(self.rim)[-1]

    @property
    def pumps(self) -> int:
        return len(self.feeds) + len(self.valves)

    def shares(self):
        """Return [(pump, tank, gain [cm^3/(s V)])]: where each pump's flow goes."""
        shares = []
        for j, (first, second) in enumerate(self.feeds):
            if second is None and first is not None:  # else it only takes out
                shares.append((j, first, self.pump_gain[j]))
            elif second is not None:
                shares += [
                    (j, first, self.pump_gain[j] * self.split[j]),
                    (j, second, self.pump_gain[j] * (1.0 - self.split[j])),
                ]
        return shares

    def derivative(self, t: ArrayLike, x: Sequence, u: Sequence, d: Sequence | None) -> tuple:
        return self._flows(t, x, u, d)

    @property
    def overflow_within(self) -> bool:
        return self.overflow and type(self).spill is TankNetwork.spill  # a class may have its own

    def with_bottom(self) -> Self:
        return dataclasses.replace(self, bottom=True)

    @property
    def depends_on_time(self) -> bool:
        return False

    @property
    def by_volume(self) -> bool:
        return bool(self.shapes)

    def stored(self, x: Sequence) -> tuple:
        return elements.stored(self, x)

    def levels(self, volumes: Sequence) -> tuple:
        return elements.levels(self, volumes)

    def sections(self, x: Sequence) -> tuple:
        """Return the cross-section (n,) [cm^2] of each tank at its level."""
        return elements.sections(self, x)

    def net_flows(self, step: ArrayLike) -> Callable:
        limit = step if self.bottom else None
        return lambda t, x, u, d: elements.net_flows(self, x, u, d, limit)

    def limited(self, step: ArrayLike) -> Callable:
        """Return the vector field of one integration step of `step` [s]: `derivative`; with
        `bottom`, no tank gives more than it holds.

        In each stage an outlet of area s_k of tank i, orifice or pipe, passes at most its share
        s_k / (sum of the tank's outlets) of A_i max(h_i, 0) / step. An rk4 step then ends at or
        above zero where no inflow from outside is negative: stage s holds at most h_i plus what
        flows in up to it, so the weighted sum of the outflows is less than h_i plus the sum of the
        inflows (the midpoint rule: where an inflow does not fall by half within half a step). What
        leaves one tank arrives in the next, so volume is conserved whatever the step, and the lower
        clip in `spill` adds only what a negative inflow could not take (`shortfall`).

        The limit acts below h = (step sqrt(2 g) sum s_k / A)^2, where the tank holds less than it
        gives in one step; elsewhere the rates are those of `derivative`, bit for bit. Where it
        acts, what passes the tank is delayed by up to one step (`step_length` reports how high it
        stands).
        """
        if not self.bottom or type(self).derivative is not TankNetwork.derivative:
            return self.derivative
        return functools.partial(self._flows, step=step)

    def _supply(self, step):
        """(n) largest ratio of root to level in a step [cm^-0.5]: at most that of `smooth_sqrt`."""
        areas = [self.drain[i] for i in range(self.tanks)]
        for k, (source, _) in enumerate(self.links):
            areas[source] = areas[source] + self.orifice[k]
        for k, ends in enumerate(self.pipes):
            for i in ends:
                areas[i] = areas[i] + self.pipe[k]
        # of the inverse, which is 0 and not infinite for a tank without outlets
        turnover = step * jnp.sqrt(2.0 * self.gravity)
        return [
            1.0 / lower_clip(turnover * s / self.area[i], self.knee**0.5 / 1.5)
            for i, s in enumerate(areas)
        ]

    def _flows(self, t, x, u, d, step=None):
        if not self.plain:
            rates = elements.net_flows(self, x, u, d, step)
            return tuple(r / a for r, a in zip(rates, elements.sections(self, x)))
        if is_array(x):
            return flows(self, x, u, d, step)
        return self._plain_flows(x, u, d, step)

    def _plain_flows(self, x, u, d, step):
        """Rates [cm/s] of a network of prisms, orifices, pipes and pumps, by scalars."""
        # Coefficients that do not depend on the state (the c_i of gouta2015 eq. 7) are computed
        # once by the loop. What u and d bring comes first in each sum: within a Runge-Kutta step it
        # is ready before the roots are.
        n, w = self.tanks, jnp.sqrt(2.0 * self.gravity)
        out = [self.drain[i] for i in range(n)]
        for k, (source, _) in enumerate(self.links):
            out[source] = out[source] + self.orifice[k]
        rate = [0.0 if d is None else d[i] / self.area[i] for i in range(n)]
        for j, tank, gain in self.shares():
            rate[tank] = rate[tank] + (gain / self.area[tank]) * u[j]
        if step is None:
            supply, levels = (), x
            q = [smooth_sqrt(h, self.knee) for h in x]
        else:
            supply = self._supply(step)
            q = [limited_sqrt(h, self.knee, most) for h, most in zip(x, supply)]
            levels = [lower_clip(h, 0.0) for h in x]
        for k, (source, sink) in enumerate(self.links):
            rate[sink] = rate[sink] + (self.orifice[k] * w / self.area[sink]) * q[source]
        for k, (first, second) in enumerate(self.pipes):
            s = smooth_signed_sqrt(levels[first] - levels[second], self.knee)
            if step is not None:
                s = limited_flow(s, supply[first] * levels[first], supply[second] * levels[second])
            rate[first] = rate[first] - (self.pipe[k] * w / self.area[first]) * s
            rate[second] = rate[second] + (self.pipe[k] * w / self.area[second]) * s
        return tuple(rate[i] - (out[i] * w / self.area[i]) * q[i] for i in range(n))

    def rates(self, x: jax.Array, u: jax.Array) -> jax.Array:
        if type(self).derivative is not TankNetwork.derivative or not self.plain:
            return super().rates(x, u)
        x, u, orifice, pipe = map(jnp.asarray, (x, u, self.orifice, self.pipe))
        w = jnp.sqrt(2.0 * self.gravity)
        ends = lambda pairs: tuple(np.array(pairs, dtype=int).reshape(-1, 2).T)
        (source, sink), (first, second) = ends(self.links), ends(self.pipes)
        q = smooth_sqrt(x, self.knee)
        discharged = orifice * w * q[source]
        piped = pipe * w * smooth_signed_sqrt(x[first] - x[second], self.knee)
        flow = -jnp.asarray(self.drain) * w * q
        flow = flow.at[source].add(-discharged).at[sink].add(discharged)
        flow = flow.at[first].add(-piped).at[second].add(piped)
        pump, tank, gain = (list(column) for column in zip(*self.shares()))
        flow = flow.at[np.array(tank)].add(jnp.stack(gain) * u[np.array(pump)])
        return flow / jnp.asarray(self.area)

    def shortfall(self, x: Sequence[Any]) -> tuple[Any, ...]:
        if not self.bottom:
            return super().shortfall(x)
        if self.shapes:
            return tuple(lower_clip(-v, 0.0) for v in elements.stored(self, x))
        return each(lambda h, area: area * (lower_clip(h, 0.0) - h), x, self.area)

    def spill(self, x: Sequence, moved: Sequence | None = None) -> tuple[Sequence, Sequence]:
        """Return (levels at or below the rims, volume lost over each rim [cm^3]); `moved`: what
        overflow has brought to each tank of levels `x` already, or taken (n,) [cm^3].
        """
        if self.bottom:
            x = each(lambda h: lower_clip(h, 0.0), x)
        if not self.overflow:
            return x, zeros(x)
        if not self.plain:
            return elements.overflowed(self, x, downwards(self.spills, self.tanks), moved)
        if moved is None:
            return self._overflowed(x)
        x, lost = self._overflowed(each(lambda h, v, area: h - v / area, x, moved, self.area))
        return each(lambda h: lower_clip(h, 0.0), x) if self.bottom else x, lost

    def _overflowed(self, x):
        """`spill` of prisms, without what `moved`."""
        if is_array(x):
            return overflowed(self, x)
        x, overflow = list(x), [0.0] * self.tanks
        order, ring = downwards(self.spills, self.tanks)
        for i in order:
            clipped = clip(x[i], -self.rim[i], self.rim[i])
            over = self.area[i] * (x[i] - clipped)
            overflow[i], x[i] = overflow[i] + over, clipped
            for k, (source, sink) in enumerate(self.spills):
                if source == i:
                    overflow[i] = overflow[i] - self.caught[k] * over
                    x[sink] = x[sink] + self.caught[k] * over / self.area[sink]
        for i in ring:  # what has come back to a full tank leaves the rig there
            clipped = clip(x[i], -self.rim[i], self.rim[i])
            overflow[i], x[i] = overflow[i] + self.area[i] * (x[i] - clipped), clipped
        return tuple(x), tuple(overflow)

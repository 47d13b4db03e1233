"""A safety filter where inputs bring liquid to a tank or take it out: valves, pumps in outlets and
between tanks, shaped tanks. Theorem 6 of README.md of this folder.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxtank.core.curves import monotone_curve
from jaxtank.core.numerics import clip, lower_clip
from jaxtank.core.tree import component, static
from jaxtank.instruments.base import Actuator
from jaxtank.plants import elements
from jaxtank.plants.tank_network import TankNetwork
from jaxtank.plants.vessels import volume_of
from jaxtank.safety.filter import any_of, tank_leaf
from jaxtank.xla.barrier import materialised


class Effect(NamedTuple):
    """Harmful flow of an input at worst: `plus` v for v >= 0, `minus` v below [cm^3/s]."""

    plus: Any
    minus: Any
    up: bool  # whether a larger input helps

    def of(self, v: Any) -> Any:
        return jnp.where(v >= 0.0, self.plus * v, self.minus * v)


@component
class OutletFilter:
    """Caps and floors on inputs of either sign under which no level passes its limits.

    A row of tank i moves the inputs named with it, until

        harmful flow at worst <= rate (volume between the level and its limit)

    over the box of plants and the band of readings. Rows of low limits come first, so that an upper
    limit wins. Inputs that a row does not move count with the worst of their range.
    """

    least: TankNetwork
    most: TankNetwork
    limit: np.ndarray = tank_leaf("cm", "level that no tank may pass", low=0.0, strict=True)
    low: np.ndarray = tank_leaf("cm", "level below which no tank may fall; 0: none", low=0.0)
    reach: np.ndarray = tank_leaf("cm", "level that no tank passes for certain", low=0.0)
    bottom: np.ndarray = tank_leaf("cm", "level below which no tank falls for certain", low=0.0)
    rate: np.ndarray = tank_leaf(
        "1/s", "how fast the volume may approach that of a limit (kappa)", low=0.0, strict=True
    )
    band: np.ndarray = tank_leaf("cm", "largest difference of reading and level", low=0.0)
    inflow: np.ndarray = tank_leaf("cm^3/s", "largest inflow disturbance", low=0.0)
    draw: np.ndarray = tank_leaf("cm^3/s", "least inflow disturbance, 0 or negative")
    climb: np.ndarray = tank_leaf("cm", "largest rise of a level in a hold", low=0.0)
    drop: np.ndarray = tank_leaf("cm", "largest fall of a level in a hold", low=0.0)
    empty: np.ndarray = tank_leaf("cm", "level below which no outflow is certain", low=0.0)
    upper_rows: tuple = static(doc="((tank, (input, ...)), ...) rows of upper limits", default=())
    low_rows: tuple = static(doc="((tank, (input, ...)), ...) rows of low limits", default=())
    predicted: int = static(doc="inputs under way over which levels are predicted", default=0)

    def apply(
        self,
        actuator: Actuator,
        command: Sequence[Any],
        metric: Any,
        y: Sequence[Any],
        hold: Any,
        line: Any = None,
    ) -> tuple[tuple[Any, ...], Any]:
        """Return ((m) inputs, 1.0 where a row changed the command, else 0.0), as
        `SafetyFilter.apply`; the plant allocates nothing here, so `metric` has no part in it.
        """
        y, command = materialised((tuple(y), tuple(command)))
        pumps = range(actuator.pumps)
        ends = [[self.demand(j, end[j]) for j in pumps] for end in (actuator.low, actuator.high)]
        asked = [self.demand(j, clip(command[j], actuator.low[j], actuator.high[j])) for j in pumps]
        v = list(asked)
        for upper, rows in ((False, self.low_rows), (True, self.upper_rows)):
            others = self.others(y, upper)
            for tank, movers in rows:
                effects, allowed = self.row(tank, movers, y[tank], others, ends, upper)
                v = list(materialised(tuple(moved(v, effects, allowed, ends))))
        acts = any_of(a != b for a, b in zip(v, asked))
        return tuple(self.input_of(j, v[j]) for j in pumps), jnp.where(acts, 1.0, 0.0)

    def others(self, y: Sequence[Any], upper: bool) -> list[Any]:
        """Return (n) the highest (`upper`) or lowest level of each tank in the coming hold."""
        tanks = range(self.least.tanks)
        if upper:
            risen = [y[i] + self.band[i] + self.climb[i] for i in tanks]
            return [jnp.where(h < self.reach[i], h, self.reach[i]) for i, h in enumerate(risen)]
        fallen = [y[i] - self.band[i] - self.drop[i] for i in tanks]
        return [lower_clip(h, self.bottom[i]) for i, h in enumerate(fallen)]

    def row(self, tank: int, movers: Any, y: Any, others: Any, ends: Any, upper: bool) -> Any:
        """Return ({input: Effect} of the `movers`, the harmful flow that they may make at most)."""
        band, limit, least = self.band[tank], self.limit[tank], self.low[tank]
        if upper:
            h, high = lower_clip(y - band, 0.0), y + band
            room = self._volume(tank, jnp.where(high < limit, high, limit), limit)
        else:
            h = lower_clip(y + band, 0.0)
            room = self._volume(tank, least, lower_clip(y - band, least))
        effects = self.effects(tank, h, others, upper)
        allowed = self.rate[tank] * room - self.harmful(tank, h, others, upper)
        for j in (j for j in effects if j not in movers):
            allowed = allowed - jnp.maximum(*(effects[j].of(end[j]) for end in ends))
        return {j: effects[j] for j in movers}, allowed

    def _volume(self, tank, low, high):
        """Least volume [cm^3] between two levels of a tank."""
        shapes, area = self.least.shapes, self.least.area[tank]
        if not shapes or shapes[tank] == "prism":
            return area * (high - low)
        volume = lambda e, h: volume_of(shapes[tank], area, e, h)
        ends = (self.least.extent[tank], self.most.extent[tank])
        return jnp.minimum(*(volume(e, high) - volume(e, low) for e in ends))

    def harmful(self, tank: int, h: Any, others: Sequence[Any], upper: bool) -> Any:
        """Return the largest flow in the harmful direction that no input makes [cm^3/s]."""
        leaving, entering = (self.least, self.most) if upper else (self.most, self.least)
        sign = 1.0 if upper else -1.0
        total = self.inflow[tank] if upper else -self.draw[tank]
        for kind, pairs in elements.openings(self.least):
            for k, (source, sink) in enumerate(pairs):
                if source == tank:
                    flow = elements.outlet_flow(leaving, kind, k, h)
                    total = total - sign * (self._certain(tank, h, flow) if upper else flow)
                if sink == tank:
                    flow = elements.outlet_flow(entering, kind, k, others[source])
                    sure = flow if upper else self._certain(source, others[source], flow)
                    total = total + sign * sure
        for k, ends in enumerate(self.least.pipes):
            if tank in ends:
                total = total + self._by_pipe(k, tank, h, others, upper)
        return total

    def _by_pipe(self, k, tank, h, others, upper):
        """Harm of pipe k to a tank at one of its ends."""
        ends = self.least.pipes[k]
        other = ends[1] if ends[0] == tank else ends[0]
        heads = {tank: h, other: others[other]}
        weak, strong = (elements.pipe_flow(p, k, heads) for p in (self.least, self.most))
        if ends[1] == tank:
            weak, strong = -weak, -strong
        if upper:
            return -jnp.where(weak >= 0.0, self._certain(tank, h, weak), strong)
        sure = self._certain(other, others[other], weak)
        return jnp.where(strong >= 0.0, strong, sure)

    def _certain(self, tank, level, flow):
        """A flow out of a tank, or 0 where the tank may not hold what it gives in a step."""
        return jnp.where(level >= self.empty[tank], flow, 0.0)

    def effects(
        self, tank: int, h: Any, others: Sequence[Any], upper: bool
    ) -> Mapping[int, Effect]:
        """Return {input: Effect} of the inputs that act on a tank."""
        table: dict[int, Effect] = {}
        for j, (first, second) in enumerate(self.least.feeds):
            source = self.least.sources[j] if self.least.sources else None
            ends = [(p.pump_gain[j], p.split[j]) for p in (self.least, self.most)]
            (low, share), (high, most) = ends
            if source == tank:
                table[j] = self._pumped(j, tank, h, others, (low, high), first, upper)
            elif first == tank:
                gains = (low, high) if second is None else (low * share, high * most)
                table[j] = self._pumped(j, tank, h, others, gains, source, upper)
            elif second == tank and second is not None:
                gains = low * (1.0 - most), high * (1.0 - share)
                table[j] = self._pumped(j, tank, h, others, gains, source, upper)
        for k, pair in enumerate(self.least.valves):
            if tank in pair:
                j = len(self.least.feeds) + k
                table[j] = self._valve(k, tank, h, others, upper)
        return table

    def _valve(self, k, tank, h, others, upper):
        """Effect of a valve at a tank; closed, one between two tanks does no harm to either."""
        source, sink = self.least.valves[k]
        if sink is None:
            strong = elements.valve_flow(self.most, k, {tank: h})
            weak = self._certain(tank, h, elements.valve_flow(self.least, k, {tank: h}))
            plus = -weak if upper else strong
            return Effect(plus, plus, upper)
        other = sink if tank == source else source
        forth = elements.valve_flow(self.most, k, {tank: h, other: others[other]})
        into = forth if tank == sink else -forth
        harm = lower_clip(into if upper else -into, 0.0)
        return Effect(harm, harm, False)

    def _pumped(self, pump, tank, h, others, gains, other, upper):
        """Effect of a pump that brings liquid to a tank, or takes it out."""
        least, most = gains
        takes = bool(self.least.sources) and self.least.sources[pump] == tank
        by_lift = self.least.lift_curves[pump] if self.least.lift_curves else None
        if by_lift is not None:
            lift = h - (0.0 if other is None else others[other])
            share = lower_clip(monotone_curve(by_lift, -lift if takes else lift), 0.0)
            least, most = least * share, most * share

        def certain(*tanks):
            flow = least
            for i in (i for i in tanks if i is not None):
                flow = self._certain(i, h if i == tank else others[i], flow)
            return flow

        both = self.least.feeds[pump]
        sure, back = (certain(tank), certain(*both)) if takes else (certain(other), certain(tank))
        if upper:
            return Effect(-sure, -most, True) if takes else Effect(most, back, False)
        return Effect(most, back, False) if takes else Effect(-sure, -most, True)

    def demand(self, j: int, u: Any) -> Any:
        """Return what an input asks for: of a valve the open share of its area."""
        k = j - len(self.least.feeds)
        if k < 0:
            return u
        opening = u / elements.full_open(self.least.units)
        kind, ratio = self.least.characteristics[k], self.least.rangeability[k]
        return elements.valve_share(kind, ratio, opening)

    def input_of(self, j: int, v: Any) -> Any:
        """Return the input that asks for v, the inverse of `demand`."""
        k = j - len(self.least.feeds)
        if k < 0:
            return v
        full = elements.full_open(self.least.units)
        if self.least.characteristics[k] == "linear":
            return v * full
        return full * (1.0 + jnp.log(v) / jnp.log(self.least.rangeability[k]))


def moved(v: Sequence[Any], effects: Mapping[int, Effect], allowed: Any, ends: Any) -> list[Any]:
    """Return demands v (m), those of `effects` moved until they do no more harm than `allowed`."""
    v, (low, high) = list(v), ends
    if len(effects) == 1:
        ((j, effect),) = effects.items()
        helps = (allowed >= 0.0) ^ effect.up
        divisor = jnp.where(helps, effect.plus, effect.minus)
        bound = allowed / jnp.where(divisor == 0.0, 1.0, divisor)
        if effect.up:  # harm falls with v
            bound = jnp.where(divisor == 0.0, jnp.where(allowed >= 0.0, low[j], high[j]), bound)
            v[j] = clip(lower_clip(v[j], bound), low[j], high[j])
        else:
            bound = jnp.where(divisor == 0.0, jnp.where(allowed >= 0.0, high[j], low[j]), bound)
            v[j] = clip(jnp.where(v[j] < bound, v[j], bound), low[j], high[j])
        return v
    # the harm is convex on the way to the harmless ends, so below its chord
    safe = {j: (high if effect.up else low)[j] for j, effect in effects.items()}
    present = sum(effect.of(v[j]) for j, effect in effects.items())
    least = sum(effect.of(safe[j]) for j, effect in effects.items())
    excess, span = present - allowed, present - least
    part = excess / jnp.where(span > 0.0, span, 1.0)
    share = jnp.where(excess > 0.0, jnp.where(excess < span, part, 1.0), 0.0)
    for j in effects:
        v[j] = v[j] + share * (safe[j] - v[j])
    return v

"""An upper limit on the pumps, computed from the readings, that keeps levels below their limits.

A robust sampled-data control barrier function in closed form (a "safety filter"). Theorems and
conditions: README.md of this folder; what is proved for a rig: `certificate.design`.
"""

import functools
import operator
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxtank.core.numerics import clip, lower_clip, smooth_sqrt
from jaxtank.core.tree import component, leaf, static
from jaxtank.instruments.actuators import allocate
from jaxtank.instruments.base import Actuator
from jaxtank.plants.tank_network import TankNetwork
from jaxtank.safety.prediction import brackets
from jaxtank.safety.worst_case import fall, rates_of, rise
from jaxtank.xla.barrier import materialised

SHALLOW = 0.05
"""a0 as a share of s(H): below it the root of a feeding tank's level counts as constant."""


def tank_leaf(unit, doc, **more):
    return leaf(unit, doc, shape=("tank",), **more)


def _tanks_or_0(unit, doc, **more):
    return tank_leaf(unit, doc, default=lambda own: np.zeros(np.shape(own["limit"])), **more)


@component
class SafetyFilter:
    """Caps on the inputs under which no level passes its limit, for every plant of a box.

    For tank i with level h, reading y, |y - h| <= band, the inputs must satisfy

        sum_j b_ij,max u_j <= M_i = max(0, -Phi_max(y - band) + rate (limit - y - band))

    where Phi_max is the largest rate of the level with the pumps off (`worst_case.rise`). A tank
    without a pump whose inflow alone can pass its limit is held by a row on the pumps of the tanks
    above it (`slope` > 0; second order, see `_row_above`). u = 0 serves every row, and lowering an
    input never breaks one.

    Low limits (`low`, tanks `kept`) raise the inputs instead, as far as the caps allow
    (`least_inputs`).
    """

    least: TankNetwork
    most: TankNetwork
    limit: np.ndarray = tank_leaf("cm", "level that no tank may pass", low=0.0, strict=True)
    reach: np.ndarray = tank_leaf("cm", "level that no tank passes for certain", low=0.0)
    rate: np.ndarray = tank_leaf(
        "1/s", "how fast a level may approach its limit (kappa)", low=0.0, strict=True
    )
    band: np.ndarray = tank_leaf("cm", "largest difference of reading and level", low=0.0)
    inflow: np.ndarray = tank_leaf("cm^3/s", "largest inflow disturbance", low=0.0)
    slope: np.ndarray = _tanks_or_0(
        "1/s", "k1 of a tank that is held by the pumps above it; 0: by its own", low=0.0
    )
    spare: np.ndarray = _tanks_or_0("cm", "rise by volumes that may enter besides, in all", low=0.0)
    age: np.ndarray | float = leaf(
        "s", "age of a reading when the input computed from it begins to act", low=0.0, default=0.0
    )
    offset: np.ndarray = leaf(
        "V",
        "least input that moves liquid, of pumps with an offset dead zone",
        default=lambda own: np.zeros(own["least"].pumps),
        shape=("pump",),
    )
    low: np.ndarray = _tanks_or_0("cm", "level below which no tank may fall; 0: none", low=0.0)
    bottom: np.ndarray = _tanks_or_0("cm", "level below which no tank falls for certain", low=0.0)
    draw: np.ndarray = _tanks_or_0("cm^3/s", "least inflow disturbance, 0 or negative")
    held: tuple = static(doc="tanks whose limits are kept, counted from 0")
    kept: tuple = static(doc="tanks whose low limits are kept, counted from 0", default=())
    predicted: int = static(doc="inputs under way over which levels are predicted", default=0)
    substeps: int = static(doc="steps of the prediction in a sample", default=1)
    divided: tuple = static(
        doc="tanks whose row is divided among their pumps, in shares of what each brings at full",
        default=(),
    )
    running: tuple = static(doc="pumps whose lower limit is above 0 V", default=())
    allocate: bool = static(
        doc="give the other of two pumps what serves the outputs best where one meets its cap",
        choices=(False, True),
        default=True,
    )

    def apply(
        self,
        actuator: Actuator,
        command: Sequence[Any],
        metric: tuple[Any, ...] | None,
        y: Sequence[Any],
        hold: Any,
        line: Sequence[Any] | None = None,
    ) -> tuple[tuple[Any, ...], Any]:
        """Return ((m) inputs within the pumps' limits, the caps and the least inputs [V] for a
        command (m) [V], 1.0 where one of these two changed the command, else 0.0).

        Parameters
        ----------
        actuator : the pumps
        command : (m) inputs before their limits [V]
        metric : (g11, g12, g22) of the controller's cost (`Controller.input_metric`), or None:
            that of the plant, by the effect of two pumps on the outputs
        y : (n) readings [cm]
        hold : longest time for which the inputs are held [s]
        line : (m) arrays (predicted,) of the inputs under way, the oldest first [V]; needed where
            `predicted` is above 0
        """
        y, command = materialised((tuple(y), tuple(command)))
        pumps = range(actuator.pumps)
        low, dead = [actuator.low[j] for j in pumps], [self.offset[j] for j in pumps]
        high = [actuator.high[j] - dead[j] for j in pumps]
        caps, shared = materialised(self.limits(y, hold, low, high, line))
        least, raising = self.least_inputs(y, hold, low, caps)
        if self.kept:
            least = tuple(jnp.where(f > v, f + z, v) for f, v, z in zip(least, low, dead))
        most = tuple(cap + zone for cap, zone in zip(caps, dead))
        least, most = materialised((least, most))
        u = materialised(self._between(command, metric, y, least, most))
        free = [clip(command[j], low[j], actuator.high[j]) for j in pumps]
        acts = any_of((free[j] > most[j]) | (free[j] < least[j]) for j in pumps)
        if not shared and not raising:
            return u, jnp.where(acts, 1.0, 0.0)
        moving = tuple(v - zone for v, zone in zip(u, dead))
        scaled = self.scaled(_raised(moving, raising, caps), shared, low)
        acts = acts | any_of(a != b for a, b in zip(scaled, moving))
        return tuple(v + zone for v, zone in zip(scaled, dead)), jnp.where(acts, 1.0, 0.0)

    def _between(self, command, metric, y, least, most):
        """(m) inputs between `least` and `most` (m) that replace the command [V]."""
        if self.allocate and len(command) == 2:
            return allocate(command, materialised(metric or self._metric(y)), least, most)
        return tuple(map(clip, command, least, most))

    def _metric(self, y):
        """(g11, g12, g22) of G = J'J, J_oj the effect of pump j on output o: on its rate, or on its
        second derivative where it has no pump of its own.
        """
        r, knee = rates_of(self.least, self.most, self.inflow, 0.0), self.least.knee
        g11 = g12 = g22 = 0.0
        for o in self.least.outputs:
            row = {j: 0.5 * (a + b) for j, (a, b) in r.pumps[o].items()}
            for source, sink, a, b in () if row else r.links:
                if sink == o:
                    steep = 0.25 * (a + b) / smooth_sqrt(lower_clip(y[source], 10.0 * knee), knee)
                    for j, (c, d) in r.pumps[source].items():
                        row[j] = row.get(j, 0.0) + steep * 0.5 * (c + d)
            first, second = row.get(0, 0.0), row.get(1, 0.0)
            g11, g12, g22 = g11 + first**2, g12 + first * second, g22 + second**2
        small = 1e-6 * (g11 + g22)  # a pump that moves no output keeps its own command
        return g11 + small, g12, g22 + small

    def bounds(
        self, y: Sequence, hold: Any, low: Sequence, high: Sequence, line: Sequence | None = None
    ) -> list[tuple[dict, Any]]:
        """Return the rows [({pump: a}, M)], sum a u <= M [cm/s, or cm^0.5/s^2], for readings y and
        limits `low`, `high` (m) of the pumps [V]; the rest as of `apply`.
        """
        n, r = self.least.tanks, rates_of(self.least, self.most, self.inflow, hold, self.draw)
        fastest = [self._fastest(r, i, high) for i in range(n)]
        risen = lambda i: y[i] + self.band[i] + (hold + self.age) * fastest[i] + self.spare[i]
        above = materialised([jnp.minimum(self.reach[i], risen(i)) for i in range(n)])
        rows, below = [], self._lowest(r, y, hold, low) if self.predicted else []
        for i in self.held:
            if r.pumps[i]:
                least, most = y[i] - self.band[i], y[i] + self.band[i]
                if line is not None and self.predicted:
                    levels, others = (least, most, self.limit[i]), (below, above)
                    step = hold / self.substeps
                    least, most = brackets(r, i, levels, line, others, step, self.substeps)
                m = self.rate[i] * (self.limit[i] - most) - rise(r, i, least, above)
                row = {j: b for j, (_, b) in r.pumps[i].items()}
                whole = (row, lower_clip(m, 0.0))
                rows += _divided(*whole, high) if i in self.divided else [whole]
            else:
                rows.append(self._row_above(r, i, y, hold, high))
        return rows

    def _fastest(self, r, tank, high):
        """Largest rate of a level [cm/s]: all pumps at `high`, all other tanks at `reach`."""
        pumped = sum(b * lower_clip(high[j], 0.0) for j, (_, b) in r.pumps[tank].items())
        return pumped + lower_clip(rise(r, tank, 0.0, self.reach), 0.0)

    def _row_above(self, r, tank, y, hold, high):
        """Return the row of a tank without a pump on the pumps of the tanks that feed it."""
        # g = c_min s(h) + k1 (H - h) - sum_j c_j,max max(s(h_j), a0) g >= 0 keeps h' <= k1 (H - h)
        # sum_j c_j,max b_j,max S_j u_j <= M = max(0, D + k2 g_low - k1^2 (H - l))
        s = lambda h: smooth_sqrt(lower_clip(h, 0.0), r.knee)
        k1, k2, top, eps = self.slope[tank], self.rate[tank], self.limit[tank], self.band[tank]
        a0 = SHALLOW * s(top)
        sources = [(j, most) for j, sink, _, most in r.links if sink == tank]
        full = sum(most * s(self.reach[j]) for j, most in sources)
        drains, row = 0.0, {}
        g = r.out[tank] * s(y[tank] - eps) + k1 * (top - y[tank] - eps)
        for j, most in sources:
            lowest = s(y[j] - self.band[j]) - 0.5 * r.out_most[j] * hold
            drains = drains + jnp.where(lowest >= a0, 0.5 * most * r.out[j], 0.0)
            g = g - most * lower_clip(s(y[j] + self.band[j]), a0)
            steep = most * 0.5 / lower_clip(lowest, a0)
            for pump, (_, b) in r.pumps[j].items():
                row[pump] = row.get(pump, 0.0) + steep * b
        lowest = lower_clip(y[tank] - eps - hold * r.out_most[tank] * s(top), 0.0)
        m = lower_clip(drains + k2 * g - k1 * k1 * (top - lowest), 0.0)
        x = y[tank] + eps + hold * full
        far = r.out[tank] * s(x) + k1 * (top - x) >= full
        # no row far below: more than all pumps can bring, and finite, for its derivative
        idle = 1.0 + 2.0 * sum(a * lower_clip(high[j], 0.0) for j, a in row.items())
        return row, jnp.where(far, idle, m)

    def limits(
        self, y: Sequence, hold: Any, low: Sequence, high: Sequence, line: Sequence | None = None
    ) -> tuple:
        """Return ((m) upper limits of the inputs [V], the rows that bind two pumps or more).

        Lower limits win: a pump that cannot stop runs at its lower limit.
        """
        caps, shared = list(high), []
        for row, m in self.bounds(y, hold, low, high, line):
            if len(row) == 1:
                ((j, a),) = row.items()
                cap = jnp.where(a > 0.0, m / jnp.where(a > 0.0, a, 1.0), high[j])
                cap = lower_clip(cap, low[j])
                caps[j] = jnp.where(cap < caps[j], cap, caps[j])
            else:
                shared.append((row, m))
        return tuple(caps), shared

    def least_inputs(self, y: Sequence, hold: Any, low: Sequence, caps: Sequence) -> tuple:
        """Return ((m) lower limits of the inputs [V], none above its cap, the rows [({pump: b_min},
        f)] of tanks with two pumps or more: sum b_min u >= f [cm/s]) that keep the low limits.
        """
        # f = -Phi_min(y + band) - rate (y - band - low)
        if not self.kept:
            return tuple(low), []
        r = rates_of(self.least, self.most, self.inflow, hold, self.draw)
        below, least, shared = self._lowest(r, y, hold, low), list(low), []
        for i in self.kept:
            f = -fall(r, i, y[i] + self.band[i], below) - self.rate[i] * (
                y[i] - self.band[i] - self.low[i]
            )
            gains = r.pumps[i]
            if len(gains) > 1:
                shared.append(({j: b for j, (b, _) in gains.items()}, f))
                for j in gains:  # none of them draws
                    least[j] = lower_clip(least[j], 0.0)
                continue
            ((j, ends),) = gains.items()
            gain = jnp.where(f >= 0.0, *ends)
            needed = jnp.where(gain > 0.0, f / jnp.where(gain > 0.0, gain, 1.0), low[j])
            least[j] = lower_clip(least[j], needed)
        return tuple(jnp.where(v < cap, v, cap) for v, cap in zip(least, caps)), shared

    def _lowest(self, r, y, hold, low):
        """(n) least that each level can be until the inputs of this sample end [cm]."""
        below = []
        for i in range(self.least.tanks):
            leaving = sum(b * lower_clip(-low[j], 0.0) for j, (_, b) in r.pumps[i].items())
            fastest = lower_clip(leaving - fall(r, i, self.reach[i], self.bottom), 0.0)
            least = y[i] - self.band[i] - (hold + self.age) * fastest
            below.append(lower_clip(least, self.bottom[i]))
        return below

    def scaled(self, u: Sequence, shared: list, low: Sequence) -> tuple:
        """Return inputs u (m) [V] lowered so that rows of several pumps hold, all in proportion and
        none below its lower limit `low` (m) [V].
        """
        u = list(u)
        for row, m in shared:
            least = {j: low[j] for j in row if j in self.running}
            above = {j: u[j] - least[j] if j in least else u[j] for j in row}
            if least:  # which is brought in any case
                m = lower_clip(m - sum(row[j] * v for j, v in least.items()), 0.0)
            total = sum(a * lower_clip(above[j], 0.0) for j, a in row.items())
            share = jnp.where(total > m, m / jnp.where(total > m, total, 1.0), 1.0)
            for j, v in above.items():
                lowers = (v > 0.0) & (total > m) if j in least else v > 0.0
                lowered = least[j] + v * share if j in least else v * share
                u[j] = jnp.where(lowers, lowered, u[j])
        return tuple(u)


def _raised(u, shared, caps):
    """Inputs u (m) [V] raised towards their caps until the rows of several pumps hold."""
    u = list(u)
    for row, f in shared:
        lacking = f - sum(b * u[j] for j, b in row.items())
        rest = sum(b * lower_clip(caps[j] - u[j], 0.0) for j, b in row.items())
        share = clip(lacking / jnp.where(rest > 0.0, rest, 1.0), 0.0, 1.0)
        for j in row:
            u[j] = u[j] + share * lower_clip(caps[j] - u[j], 0.0)
    return tuple(u)


def _divided(row, m, high):
    """Rows [({pump: a}, M)] of single pumps: M [cm/s] in shares of their flows at `high` [V]."""
    full = {j: b * lower_clip(high[j], 0.0) for j, b in row.items()}
    total = sum(full.values())
    total = jnp.where(total > 0.0, total, 1.0)
    return [({j: b}, m * full[j] / total) for j, b in row.items()]


def any_of(flags):
    """Whether one of the flags is set."""
    return functools.reduce(operator.or_, flags)

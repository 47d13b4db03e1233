"""Tanks, orifices, pipes, pumps: one network serves every rig."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from numpy.typing import ArrayLike

from jaxtank.core.checks import check_value
from jaxtank.core.errors import InputError
from jaxtank.core.numerics import (
    clip,
    limited_flow,
    limited_sqrt,
    lower_clip,
    smooth_signed_sqrt,
    smooth_sqrt,
)
from jaxtank.core.tree import component, leaf, number, static
from jaxtank.core.units import DEFAULT, check_unit
from jaxtank.plants.base import Plant
from jaxtank.plants.hydraulics import default_gravity, default_threshold, efflux


@component
class TankNetwork(Plant):
    """n tanks joined by orifices that pour from one tank into another or into the basin, and by
    pipes below the surface; m pumps.

        A_i h_i' = sum_j s_ji v_j - (s_i + sum_j s_ij) v_i + sum_j p_ij w_ji + pumped_i + d_i
        v = sqrt(2 g h)   (Torricelli; gouta2015 eqs. 1-8),      w_ji = sgn(h_j - h_i) sqrt(2 g |h_j
        - h_i|)   (gouta2022 eqs. 1-2)

    Pump j delivers pump_gain_j u_j: the share split_j to its first tank and the rest to its second.
    An orifice discharges freely, so its flow depends on the level above it alone; a pipe's flow
    depends on the difference of the two levels and changes its direction with it. Levels may fall
    to zero and stay there; with `overflow` they stop at the rim and what would rise past it is lost
    (and counted), except for the share `caught` that falls into another tank; otherwise a rim is
    only a limit and levels may rise past it. With `bottom`, a level stops at zero where a negative
    inflow would take it below, and no tank gives more in one integration step than it holds (see
    `limited`).
    """

    area: np.ndarray = leaf("cm^2", "(n,) cross-section A of each tank", low=0.0, strict=True)
    drain: np.ndarray = leaf(
        "cm^2", "(n,) effective orifice area from each tank to the basin; 0: closed", low=0.0
    )
    orifice: np.ndarray = leaf(
        "cm^2",
        "(links,) effective area of the orifices between tanks, in the order of `links`",
        low=0.0,
    )
    pipe: np.ndarray = leaf(
        "cm^2",
        "(pipes,) effective area of the pipes between tanks, in the order of `pipes`",
        low=0.0,
    )
    pump_gain: np.ndarray = leaf(
        "cm^3/(s V)", "(m,) flow per unit of each pump's input (Kp)", low=0.0, strict=True
    )
    split: np.ndarray = leaf(
        "-", "(m,) share of each pump that goes to its first tank", low=0.0, high=1.0
    )
    gravity: np.ndarray = leaf("cm/s^2", "acceleration g", low=0.0, strict=True)
    rim: np.ndarray = leaf("cm", "(n,) height of each tank", low=0.0, strict=True)
    caught: np.ndarray = leaf(
        "-", "(spills,) share of what passes a rim that falls into another tank", low=0.0, high=1.0
    )
    links: tuple = static(doc="((from, to), ...) tanks joined by each orifice")
    pipes: tuple = static(doc="((one, other), ...) tanks joined by each pipe", default=())
    feeds: tuple = static(doc="((first tank, second tank or None), ...) one per pump")
    spills: tuple = static(doc="((from, to), ...) where what passes a rim falls", default=())
    outputs: tuple = static(doc="tanks whose levels are controlled")
    units: tuple = static(doc="(length, pump input): the units of this rig", default=DEFAULT)
    overflow: bool = static(
        doc="rims are physics: a level stops there and the liquid is lost",
        choices=(False, True),
        default=False,
    )
    bottom: bool = static(
        doc="a level stops at zero whatever is drawn from it", choices=(False, True), default=False
    )
    # its least: a nanometre or less, the root is then exact for any level that means something, and
    # knee^-3/2 still is a number
    knee: float = static(
        "cm", "level, or difference of levels, below which flow turns laminar", low=1e-15
    )

    @property
    def tanks(self) -> int:
        return np.shape(self.rim)[-1]

    @property
    def pumps(self) -> int:
        return len(self.feeds)

    def _shares(self):
        """[(pump, tank, gain [cm^3/(s V)])]: where each pump's flow goes."""
        shares = []
        for j, (first, second) in enumerate(self.feeds):
            if second is None:
                shares.append((j, first, self.pump_gain[j]))
            else:
                shares += [
                    (j, first, self.pump_gain[j] * self.split[j]),
                    (j, second, self.pump_gain[j] * (1.0 - self.split[j])),
                ]
        return shares

    def derivative(self, t: ArrayLike, x: Sequence, u: Sequence, d: Sequence | None) -> tuple:
        return self._flows(t, x, u, d)

    def limited(self, step: ArrayLike) -> Callable:
        """Return the vector field of one integration step of `step` [s]: `derivative`; with
        `bottom`, no tank gives more than it holds.

        In each stage an outlet of area s_k of tank i, orifice or pipe, passes at most its share
        s_k / (sum of the tank's outlets) of A_i max(h_i, 0) / step. An rk4 step then ends at or
        above zero where no inflow from outside is negative: stage s holds at most h_i plus what
        flows in up to it, so the weighted sum of the outflows is less than h_i plus the sum of the
        inflows (the
        midpoint rule: where an inflow does not fall by half within half a step). What leaves one
        tank arrives in the next, so volume is conserved whatever the step, and the lower clip in
        `spill` adds only what a negative inflow could not take (`shortfall`).

        The limit acts below h = (step sqrt(2 g) sum s_k / A)^2, where the tank holds less than it
        gives in one step; elsewhere the rates are those of `derivative`, bit for bit. Where it
        acts, what passes the tank is delayed by up to one step (`step_length` reports how high it
        stands).
        """
        if not self.bottom or type(self).derivative is not TankNetwork.derivative:
            return self.derivative
        return functools.partial(self._flows, step=step)

    def _supply(self, step):
        """(n) largest ratio of root to level in a step [cm^-0.5]: at most that of `numerics.smooth_sqrt`."""
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
        # Coefficients that do not depend on the state (the c_i of gouta2015 eq. 7) are computed
        # once by the loop. What u and d bring
        # comes first in each sum: within a Runge-Kutta step it is ready before the roots are.
        n, w = self.tanks, jnp.sqrt(2.0 * self.gravity)
        out = [self.drain[i] for i in range(n)]
        for k, (source, _) in enumerate(self.links):
            out[source] = out[source] + self.orifice[k]
        rate = [0.0 if d is None else d[i] / self.area[i] for i in range(n)]
        for j, tank, gain in self._shares():
            rate[tank] = rate[tank] + (gain / self.area[tank]) * u[j]
        supply = () if step is None else self._supply(step)
        q = [
            smooth_sqrt(h, self.knee) if step is None else limited_sqrt(h, self.knee, supply[i])
            for i, h in enumerate(x)
        ]
        held = x if step is None else [lower_clip(h, 0.0) for h in x]
        for k, (source, sink) in enumerate(self.links):
            rate[sink] = rate[sink] + (self.orifice[k] * w / self.area[sink]) * q[source]
        for k, (one, other) in enumerate(self.pipes):
            s = smooth_signed_sqrt(held[one] - held[other], self.knee)
            if step is not None:
                s = limited_flow(s, supply[one] * held[one], supply[other] * held[other])
            rate[one] = rate[one] - (self.pipe[k] * w / self.area[one]) * s
            rate[other] = rate[other] + (self.pipe[k] * w / self.area[other]) * s
        return tuple(rate[i] - (out[i] * w / self.area[i]) * q[i] for i in range(n))

    def rates(self, x: jax.Array, u: jax.Array) -> jax.Array:
        if type(self).derivative is not TankNetwork.derivative:
            return super().rates(x, u)
        x, u, w, orifice, pipe = (
            jnp.asarray(x),
            jnp.asarray(u),
            jnp.sqrt(2.0 * self.gravity),
            *map(jnp.asarray, (self.orifice, self.pipe)),
        )
        ends = lambda pairs: tuple(np.array(pairs, dtype=int).reshape(-1, 2).T)
        (source, sink), (one, other) = ends(self.links), ends(self.pipes)
        q = smooth_sqrt(x, self.knee)
        poured, piped = (
            orifice * w * q[source],
            pipe * w * smooth_signed_sqrt(x[one] - x[other], self.knee),
        )
        flow = -jnp.asarray(self.drain) * w * q
        flow = (
            flow.at[source]
            .add(-poured)
            .at[sink]
            .add(poured)
            .at[one]
            .add(-piped)
            .at[other]
            .add(piped)
        )
        pump, tank, gain = (list(column) for column in zip(*self._shares()))
        return flow.at[np.array(tank)].add(jnp.stack(gain) * u[np.array(pump)]) / jnp.asarray(
            self.area
        )

    def net_inflow(self, x: Sequence, u: Sequence, d: Sequence | None) -> Any:
        """Pumped and disturbing inflow less what leaves for the basin [cm^3/s]: the rate of change
        of the stored volume.
        """
        inflow = sum(gain * u[j] for j, _, gain in self._shares()) + (0.0 if d is None else sum(d))
        return inflow - sum(
            self.drain[i] * efflux(x[i], self.gravity, self.knee) for i in range(self.tanks)
        )

    def shortfall(self, x: Sequence) -> tuple:
        if not self.bottom:
            return super().shortfall(x)
        return tuple(self.area[i] * (lower_clip(h, 0.0) - h) for i, h in enumerate(x))

    def spill(self, x: Sequence) -> tuple[Sequence, Sequence]:
        lost = [0.0] * self.tanks
        if self.bottom:
            x = tuple(lower_clip(h, 0.0) for h in x)
        if not self.overflow:
            return x, tuple(lost)
        x = list(x)
        order, ring = _downwards(self.spills, self.tanks)
        for i in order:
            held = clip(x[i], -self.rim[i], self.rim[i])
            over = self.area[i] * (x[i] - held)
            lost[i], x[i] = lost[i] + over, held
            for k, (source, sink) in enumerate(self.spills):
                if source == i:
                    lost[i] = lost[i] - self.caught[k] * over
                    x[sink] = x[sink] + self.caught[k] * over / self.area[sink]
        for i in ring:  # what has come back to a full tank is lost there
            held = clip(x[i], -self.rim[i], self.rim[i])
            lost[i], x[i] = lost[i] + self.area[i] * (x[i] - held), held
        return tuple(x), tuple(lost)


SURPLUS = 1e-6
"""By how much the shares `caught` of one tank may be above 1 in sum: the rounding of single floats."""


def check_caught(plant: Any, name: str = "plant") -> None:
    """Raise InputError where the spills of one tank catch more than passes its rim: volume would
    come from nowhere. `plant` is called `name`; one whose shares are traced or of a batch, or that
    has none, is passed over.
    """
    shares: Any = getattr(plant, "caught", None)
    if isinstance(shares, Tracer) or np.ndim(shares) != 1:
        return
    for tank in dict.fromkeys(source for source, _ in plant.spills):
        own = [float(share) for share, (source, _) in zip(shares, plant.spills) if source == tank]
        if sum(own) > 1.0 + SURPLUS:
            raise InputError(
                f"{name}.caught: the {len(own)} spills of tank {tank + 1} catch"
                f" {' + '.join(f'{v:g}' for v in own)} = {sum(own):g} of what passes its rim: must"
                " be from 0 to 1 in sum"
            )


def _downwards(spills, tanks):
    """(every tank, after those that shed into it; the tanks of rings, where there is no such
    order): what a tank is given by one above must be there when it is its turn to shed.
    """
    order, left = [], list(range(tanks))
    while left:
        free = [i for i in left if not any(sink == i and source in left for source, sink in spills)]
        if not free:
            return [*order, *left], left
        order += free
        left = [i for i in left if i not in free]
    return order, []


def network(
    *,
    area: ArrayLike,
    drain: ArrayLike,
    pump_gain: ArrayLike,
    feeds: Sequence,
    rim: ArrayLike,
    links: Sequence = (),
    orifice: ArrayLike = (),
    pipes: Sequence = (),
    pipe: ArrayLike = (),
    spills: Sequence = (),
    caught: ArrayLike = (),
    split: ArrayLike | None = None,
    gravity: float | None = None,
    outputs: Sequence[int] = (0,),
    overflow: bool = False,
    bottom: bool = False,
    units: tuple[str, str] = DEFAULT,
    knee: float | None = None,
) -> TankNetwork:
    """A `TankNetwork` from plain numbers; scalars fill. Raises InputError where shapes and topology
    do not agree.

    area, drain, rim: (n,) or a number; pump_gain, split: (m,) or a number; feeds: m pairs (first
        tank, second tank or None);
    links, pipes, spills: pairs (from, to), with one orifice, pipe, caught each. Units as in
        TankNetwork, or those of `units`.
    gravity, knee: 981 cm/s^2 and 0.01 cm where they are None, in the length of `units`; InputError
        for no gravity beside levels in volts.
    """
    for unit in units:
        check_unit("plant.units: entry", unit)
    gravity = default_gravity(units[0]) if gravity is None else gravity
    knee = default_threshold(units[0]) if knee is None else knee
    feeds = tuple((int(a), None if b is None else int(b)) for a, b in feeds)
    links, pipes, spills = (
        tuple((int(a), int(b)) for a, b in pairs) for pairs in (links, pipes, spills)
    )
    joined = (*links, *pipes, *spills, *feeds)
    n = (
        np.size(area)
        if np.ndim(area)
        else 1 + max([i for pair in joined for i in pair if i is not None], default=0)
    )
    m = len(feeds)

    def fit(name, value, size):
        array = number(value)
        if array.ndim == 0:
            return np.full(size, array)
        if array.shape != (size,):
            raise InputError(
                f"{name} has {array.size} entries for {size}; give one each, or one number for all"
            )
        return array

    for name, pairs in (("links", links), ("pipes", pipes), ("spills", spills), ("feeds", feeds)):
        for i in (i for pair in pairs for i in pair):
            if i is not None and not 0 <= i < n:
                raise InputError(f"plant.{name} names tank {i}: there are {n}, counted from 0")
    for i in outputs:
        if not 0 <= i < n:
            raise InputError(f"plant.outputs names tank {i}: there are {n}, counted from 0")
    of_knee = next(
        field.metadata for field in dataclasses.fields(TankNetwork) if field.name == "knee"
    )
    check_value("plant.knee", float(knee), {**of_knee, "unit": units[0]})
    plant = TankNetwork(
        area=fit("plant.area", area, n),
        drain=fit("plant.drain", drain, n),
        orifice=fit("plant.orifice", orifice, len(links)),
        pipe=fit("plant.pipe", pipe, len(pipes)),
        pump_gain=fit("plant.pump_gain", pump_gain, m),
        split=fit("plant.split", 1.0 if split is None else split, m),
        gravity=number(gravity),
        rim=fit("plant.rim", rim, n),
        caught=fit("plant.caught", caught, len(spills)),
        links=links,
        pipes=pipes,
        feeds=feeds,
        spills=spills,
        outputs=tuple(int(i) for i in outputs),
        overflow=bool(overflow),
        bottom=bool(bottom),
        units=tuple(units),
        knee=float(knee),
    )
    check_caught(plant)
    return plant

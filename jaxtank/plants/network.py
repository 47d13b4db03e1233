"""Tanks, orifices, pumps: one network serves every rig."""

import jax.numpy as jnp
import numpy as np

from jaxtank.errors import InputError
from jaxtank.numerics import clip, root
from jaxtank.plants.base import Plant
from jaxtank.plants.hydraulics import GRAVITY, disc, efflux
from jaxtank.tree import component, leaf, number, static


@component
class TankNetwork(Plant):
    """n tanks joined by orifices that pour from one tank into another or into the basin, filled by m pumps.

        A_i h_i' = sum_j s_ji v_j - (s_i + sum_j s_ij) v_i + pumped_i + d_i,      v = sqrt(2 g h)   (Torricelli; gouta2015 eqs. 1-8)

    Pump j delivers pump_gain_j u_j: the share split_j to its first tank and the rest to its second. An orifice discharges
    freely, so its flow depends on the level above it alone. Levels may fall to zero and stay there; with `overflow` they stop at
    the rim and what would rise past it is lost (and counted), otherwise a rim is only a limit and levels may rise past it.
    """

    area: np.ndarray = leaf("cm^2", "(n,) cross-section A of each tank", low=0.0, strict=True)
    drain: np.ndarray = leaf("cm^2", "(n,) effective orifice area from each tank to the basin; 0: closed", low=0.0)
    orifice: np.ndarray = leaf("cm^2", "(links,) effective area of the orifices between tanks, in the order of `links`", low=0.0)
    pump_gain: np.ndarray = leaf("cm^3/(s V)", "(m,) flow per volt of each pump (Kp)", low=0.0, strict=True)
    split: np.ndarray = leaf("-", "(m,) share of each pump that goes to its first tank", low=0.0, high=1.0)
    gravity: np.ndarray = leaf("cm/s^2", "acceleration g", low=0.0, strict=True)
    rim: np.ndarray = leaf("cm", "(n,) height of each tank", low=0.0, strict=True)
    links: tuple = static(doc="((from, to), ...) tanks joined by each orifice")
    feeds: tuple = static(doc="((first tank, second tank or None), ...) one per pump")
    outputs: tuple = static(doc="tanks whose levels are controlled")
    overflow: bool = static(
        doc="rims are physics: a level stops there and the liquid is lost", choices=(False, True), default=False
    )
    knee: float = static("cm", "level below which outflow turns laminar", low=0.0, strict=True, default=0.01)

    @property
    def tanks(self):
        return np.shape(self.area)[-1]

    @property
    def pumps(self):
        return np.shape(self.pump_gain)[-1]

    def _shares(self):
        """[(pump, tank, gain [cm^3/(s V)])]: where each pump's flow goes."""
        shares = []
        for j, (first, second) in enumerate(self.feeds):
            if second is None:
                shares.append((j, first, self.pump_gain[j]))
            else:
                shares += [(j, first, self.pump_gain[j] * self.split[j]), (j, second, self.pump_gain[j] * (1.0 - self.split[j]))]
        return shares

    def derivative(self, t, x, u, d):
        # Coefficients that do not depend on the state (the c_i of gouta2015 eq. 7) are computed once by the loop. What u and d bring
        # comes first in each sum: within a Runge-Kutta step it is ready before the roots are.
        n, w = self.tanks, jnp.sqrt(2.0 * self.gravity)
        out = [self.drain[i] for i in range(n)]
        for k, (source, _) in enumerate(self.links):
            out[source] = out[source] + self.orifice[k]
        rate = [0.0 if d is None else d[i] / self.area[i] for i in range(n)]
        for j, tank, gain in self._shares():
            rate[tank] = rate[tank] + (gain / self.area[tank]) * u[j]
        q = [root(h, self.knee) for h in x]
        for k, (source, sink) in enumerate(self.links):
            rate[sink] = rate[sink] + (self.orifice[k] * w / self.area[sink]) * q[source]
        return tuple(rate[i] - (out[i] * w / self.area[i]) * q[i] for i in range(n))

    def net_inflow(self, x, u, d):
        """Pumped and disturbing inflow less what leaves for the basin [cm^3/s]: the rate of change of the stored volume."""
        inflow = sum(gain * u[j] for j, _, gain in self._shares()) + (0.0 if d is None else sum(d))
        return inflow - sum(self.drain[i] * efflux(x[i], self.gravity, self.knee) for i in range(self.tanks))

    def spill(self, x):
        if not self.overflow:
            return x, (0.0,) * self.tanks
        held = tuple(clip(x[i], -self.rim[i], self.rim[i]) for i in range(self.tanks))
        return held, tuple(self.area[i] * (x[i] - held[i]) for i in range(self.tanks))


def network(*, area, drain, pump_gain, feeds, rim, links=(), orifice=(), split=None, gravity=GRAVITY, outputs=(0,), overflow=False):
    """A `TankNetwork` from plain numbers; scalars fill. Raises InputError where shapes and topology do not agree.

    area, drain, rim: (n,) or a number; pump_gain, split: (m,) or a number; feeds: m pairs (first tank, second tank or None);
    links: pairs (from, to), orifice: one area per link. Units as in TankNetwork.
    """
    feeds = tuple((int(a), None if b is None else int(b)) for a, b in feeds)
    links = tuple((int(a), int(b)) for a, b in links)
    n = np.size(area) if np.ndim(area) else 1 + max([i for pair in (*links, *feeds) for i in pair if i is not None], default=0)
    m = len(feeds)

    def fit(name, value, size):
        array = number(value)
        if array.ndim == 0:
            return np.full(size, array)
        if array.shape != (size,):
            raise InputError(f"{name} has {array.size} entries for {size}; give one each, or one number for all")
        return array

    for name, pairs in (("links", links), ("feeds", feeds)):
        for i in (i for pair in pairs for i in pair):
            if i is not None and not 0 <= i < n:
                raise InputError(f"plant.{name} names tank {i}: there are {n}, counted from 0")
    for i in outputs:
        if not 0 <= i < n:
            raise InputError(f"plant.outputs names tank {i}: there are {n}, counted from 0")
    return TankNetwork(
        area=fit("plant.area", area, n),
        drain=fit("plant.drain", drain, n),
        orifice=fit("plant.orifice", orifice, len(links)),
        pump_gain=fit("plant.pump_gain", pump_gain, m),
        split=fit("plant.split", 1.0 if split is None else split, m),
        gravity=number(gravity),
        rim=fit("plant.rim", rim, n),
        links=links,
        feeds=feeds,
        outputs=tuple(int(i) for i in outputs),
        overflow=bool(overflow),
    )


STATE_COUPLED_LINKS = ((2, 0), (2, 1), (3, 0), (3, 1))  # tank 3 to 1, 3 to 2, 4 to 1, 4 to 2 in the paper's count from 1
STATE_COUPLED_FEEDS = ((2, None), (3, None))


def state_coupled_four_tank(area):
    """The state-coupled four-tank of gouta2015 (Fig. 1, eqs. 1-8, Table 1): pumps fill the upper tanks 3 and 4, each of which
    pours into both lower tanks 1 and 2, whose levels are controlled.

    area: cross-section of every tank [cm^2]. The printed diameter 15 sqrt(2) cm gives 353.43 cm^2 (plant A, "table1"), with
    which the paper's own gains fail; 15 sqrt(2) read as an area gives plant B, "fast", which reproduces the text (spec 0).
    """
    inner, outer = disc(0.38), disc(0.31)  # d31 = d42, d32 = d41 [cm], Table 1
    return network(
        area=[area] * 4,
        drain=[disc(0.48), disc(0.48), 0.0, 0.0],  # d1 = d2 [cm], Table 1
        links=STATE_COUPLED_LINKS,
        orifice=[inner, outer, outer, inner],
        pump_gain=7.687,  # Kp [cm^3/(s V)], Table 1 (printed cm^3/V)
        feeds=STATE_COUPLED_FEEDS,
        rim=30.0,  # "the maximum liquid levels of tanks are 30 cm", sec. 5
        outputs=(0, 1),
    )

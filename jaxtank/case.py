"""A case: one rig, one controller, one reference, one clock, and what may be tuned on it."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaincinv

from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.plants.network import TankNetwork
from jaxtank.safety import SafetyFilter, TankCertificate, design
from jaxtank.safety.certificate import widths_of
from jaxtank.signals.inflows import Pours


class Free(NamedTuple):
    """Where a tunable parameter may lie, in its own unit; "log" for gains and times, "linear" for
    what may pass through 0.
    """

    low: float
    high: float
    scale: str = "log"


class Scenario(NamedTuple):
    """One of several runs that a tuning is judged by: the case with `values` set by dotted name
    (sensor noise, a weaker pump, other setpoints, another duration), its sensor noise drawn with
    `seed`, counted with `weight` in the mean over scenarios [-].

    A value is a number in the parameter's unit, or a text relative to the case as it stands:
    "x1.3", "by -0.5", "0.02 if zero", "steady" (`rig.set_scenario`).
    """

    name: str
    values: Mapping[str, Any] = {}
    seed: int = 0
    weight: float = 1.0


class Mirror(NamedTuple):
    """Gains that exchange roles: image({name: value}) are the values, of some or all names, that
    give the same loop or nearly so.
    """

    words: str
    image: Callable


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """One rig, one law, one reference, one clock, with the gains its paper prints.

    limits: {measure: upper limit (number, or one per entry), or "rim" for the rim of each tank};
    free: {parameter: Free}, what `tune` tunes unless told otherwise; objective: {measure: weight},
    what it makes small; reachable: whether every plateau of the reference must have a steady state
    within the pumps' direction (False where the paper asks for one that has none); scenarios: what
    `tune` judges by instead of the case's own run, () for that alone; mirror: gains that exchange
    roles, where the law has such;
    uncertain: {parameter of the plant: spread as a share of it}, what a result is validated on;
    covariance: (names (n,), covariance (n, n) in their units) of parameters that were identified
    together, or None; log: {"t", "pump1", "h1", ..: column of a log, its unit in its header}, where
    a log of this rig names them otherwise; names: {"tank" or "pump": a name of each, "" for none},
    where a rig gives them; safety: settings of its safety filter (`with_safety_filter`), or None.
    """

    name: str
    title: str
    loop: ClosedLoop
    clock: Clock
    limits: Mapping[str, Any]
    free: Mapping[str, Free]
    objective: Mapping[str, float]
    reachable: bool = True
    scenarios: tuple[Scenario, ...] = ()
    mirror: Mirror | None = None
    uncertain: Mapping[str, float] = dataclasses.field(default_factory=dict)
    covariance: tuple | None = None
    log: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    names: Mapping[str, tuple] = dataclasses.field(default_factory=dict)
    safety: Mapping[str, Any] | None = None

    def replace(self, **changes: Any) -> "Case":
        """A copy with the named fields changed."""
        return dataclasses.replace(self, **changes)

    def safety_design(
        self,
        *,
        widths: Mapping[str, ArrayLike] | None = None,
        limit: ArrayLike | None = None,
        band: ArrayLike | None = None,
        rate: float | None = None,
    ) -> tuple[SafetyFilter, tuple[TankCertificate, ...]]:
        """Return a safety filter for the case, and the certificate of each tank.

        Parameters
        ----------
        widths : {parameter of the plant: half width of its interval, in its unit}, the box of
            plants; left out: `uncertain`, or 99 % of `covariance`, or 5 % of every flow
        limit : (n,) levels not to be passed [cm]; left out: limits on max_level, else the rims
        band : (n,) largest difference of reading and level [cm]; left out: 6 standard deviations
            of the noise, half an ADC step and the offset
        rate : kappa, how fast a level may approach its limit [1/s]

        Raises
        ------
        InputError
            where the plant is no TankNetwork or a value is out of its range

        Examples
        --------
        >>> from jaxtank import presets
        >>> _, rows = presets.find("cascaded/pi").safety_design()
        >>> [(row.certified, row.reason) for row in rows]
        [(True, 'Theorem 1'), (True, 'Theorem 2')]
        """
        loop, plant = self.loop, self.loop.plant
        if not isinstance(plant, TankNetwork):
            raise InputError("safety_filter: is for tank networks (plants.network) only")
        inflow, volume = _disturbances(loop, self.clock)
        share = max(
            (s for n, s in self.uncertain.items() if n == "actuator.dead_zone"), default=0.0
        )
        return design(
            plant,
            loop.actuator,
            cast(LevelSensor, loop.sensor),
            self.clock.dt,
            widths=self._widths() if widths is None else widths,
            limit=_level_limits(self) if limit is None else limit,
            inflow=inflow,
            volume=volume,
            offset=loop.actuator.offset * (1.0 - share),
            band=band,
            rate=rate,
            substeps=self.clock.substeps,
            start=loop.x0,
        )

    def with_safety_filter(self, **settings: Any) -> "Case":
        """Return the case with a safety filter on its pumps; settings as in `safety_design`.

        Examples
        --------
        >>> from jaxtank import presets
        >>> presets.find("cascaded/pi").with_safety_filter().loop.safety_filter.held
        (0, 1)
        """
        found, _ = self.safety_design(**settings)
        loop = dataclasses.replace(self.loop, safety_filter=found)
        return self.replace(loop=loop, safety=settings)

    def without_safety_filter(self) -> "Case":
        """Return the case without a safety filter."""
        return self.replace(loop=dataclasses.replace(self.loop, safety_filter=None), safety=None)

    def _widths(self):
        """The box of plants that the case itself describes."""
        if self.covariance is not None:
            names, matrix = self.covariance
            flows = [i for i, n in enumerate(names) if n.startswith("plant.")]
            sigma = np.sqrt(np.diag(np.asarray(matrix, dtype=float)))[flows]
            # of an ellipsoid that holds 99 % of a normal distribution, the box around it
            reach = np.sqrt(2.0 * gammaincinv(0.5 * max(len(flows), 1), 0.99))
            return {names[i]: reach * s for i, s in zip(flows, sigma)}
        shares = {n: s for n, s in self.uncertain.items() if n.startswith("plant.")}
        flows = ("drain", "orifice", "pipe", "pump_gain", "split")
        return widths_of(self.loop.plant, shares or dict.fromkeys(flows, 0.05))


def _level_limits(case):
    """(n,) upper limits on the levels of a case [cm]: of max_level where it has one, or the rims."""
    rim = np.asarray(case.loop.plant.rim, dtype=float)
    limit = case.limits.get("max_level", "rim")
    return rim if isinstance(limit, str) else np.minimum(rim, np.asarray(limit, dtype=float))


def _disturbances(loop, clock):
    """((n,) largest inflow [cm^3/s], (n,) volume that comes in pulses besides [cm^3])."""
    none = np.zeros(loop.plant.tanks)
    if loop.disturbance is None:
        return none, none
    if isinstance(loop.disturbance, Pours):
        volume = none.copy()
        for added, (_, _, tank) in zip(loop.disturbance.volume, loop.disturbance.events):
            volume[tank] += max(float(added), 0.0)
        return none, volume
    flows = loop.disturbance.sample(clock)[0]
    return np.array([max(float(np.max(flow)), 0.0) for flow in flows]), none

"""The result of an attack; made by `tuning.falsification.study`."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from jaxtank.core.tree import with_values
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.plants.faults import Faults
from tuning.falsification.attacked import Attacked, of_plant
from tuning.views import Result

TOLERANCE = 1e-9  # share of a limit by which rounding may pass it


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Found:
    """The highest level that an attack found in one tank, and the run that has it."""

    tank: int
    limit: float
    certified: bool | None
    reason: str
    starts: str
    nominal: float
    drawn: float
    level: float
    time_s: float
    rise: float
    values: Mapping[str, np.ndarray] = dataclasses.field(repr=False)

    @property
    def margin(self) -> float:
        """Distance of the level found to the limit [cm], negative where it passes."""
        return self.limit - self.level

    @property
    def passed(self) -> bool:
        return self.level > self.limit * (1.0 + TOLERANCE)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Attack(Result):
    """The worst that was found of a case; made by `tuning.attack`.

    Attributes
    ----------
    attacked : Attacked
        The case as a function of the variables of the attack.
    found : tuple of Found
        One for each tank.
    history : (iterations + 1, tanks) array
        Highest level after each step of the ascent [cm].
    starts, draws, seed : int
    wall_s : float
        [s].
    """

    attacked: Attacked
    found: tuple[Found, ...]
    history: np.ndarray
    starts: int
    draws: int
    seed: int
    wall_s: float

    @property
    def case(self) -> Any:
        """The case that was attacked, without overflow."""
        return self.attacked.case

    @property
    def passed(self) -> list[Found]:
        """The runs in which a level passed its limit."""
        return [run for run in self.found if run.passed]

    @property
    def worst(self) -> Found:
        """The run with the smallest margin to its limit, as a share of it."""
        return max(self.found, key=lambda run: run.level / run.limit)

    def parameters(self, run: Found) -> dict[str, Any]:
        """Return {dotted name: value, or the list of its values in windows of equal length} of a
        run. "sensor.offset[i]" is the mean error of a reading [cm].
        """
        values: dict[str, Any] = {}
        for c, value in zip(self.attacked.coefficients, _rows(run)):
            same = np.all(value == value[0])
            values[c.name] = float(value[0]) if same else [float(v) for v in value]
        values |= {f"x0[{i}]": float(h) for i, h in enumerate(run.values["x0"])}
        if "error" in run.values:
            mean = np.mean(run.values["error"], axis=1)
            values |= {f"sensor.offset[{i}]": float(v) for i, v in enumerate(mean)}
        return values

    def loop(self, run: Found) -> Any:
        """Return the ClosedLoop of a run."""
        return self.attacked.loop_of(jax.tree.map(np.asarray, dict(run.values)))

    def rig(self, run: Found) -> Any:
        """Return a run as a Case that a rig file can describe: the nominal plant with faults from
        t = 0, its start, and the mean error of each reading as the sensor's offset. Errors that
        change from sample to sample, an ADC's range and commands in place of the controller's have
        no place in a rig file (`not_in_rig`).
        """
        case, values = self.case, run.values
        if self.attacked.pumps != "own":
            case = self.attacked.original
        loop: Any = case.loop
        constant = zip(self.attacked.coefficients, _rows(run))
        loop = with_values(loop, {c.name: v[0] for c, v in constant if not of_plant(c)})
        changes: dict[str, Any] = {"x0": np.asarray(values["x0"]), "faults": self._faults(run)}
        safety = case.safety
        if "error" in values and isinstance(loop.sensor, LevelSensor):
            changes["sensor"] = dataclasses.replace(
                loop.sensor,
                noise=np.zeros(loop.plant.tanks),
                offset=np.mean(values["error"], axis=1),
            )
            if safety is not None:  # the band of the case, not of a sensor with this offset
                safety = {**safety, "band": np.asarray(loop.safety_filter.band)}
        return case.replace(loop=dataclasses.replace(loop, **changes), safety=safety)

    def not_in_rig(self, run: Found) -> list[str]:
        """Return, in words, the parts of a run that no rig file can describe."""
        error, missing = run.values.get("error"), []
        if error is not None and np.ptp(error, axis=1).max() > 0.0:
            missing.append("reading errors that change from sample to sample (their mean is)")
        if error is not None and getattr(self.case.loop.sensor, "bits", 0):
            missing.append("readings without the steps of the ADC")
        if self.attacked.pumps != "own":
            missing.append("commands in place of the controller's")
        return missing

    def _faults(self, run):
        """Return the Faults of the plant in a run, equal windows joined, then those of the case."""
        clock, of_case = self.case.clock, self.case.loop.faults
        edges = np.linspace(0.0, clock.duration + clock.dt, self.attacked.windows + 1)
        windows, extra = [], []
        for c, row in zip(self.attacked.coefficients, _rows(run)):
            if not of_plant(c):
                continue
            starts = [k for k in range(len(row)) if k == 0 or row[k] != row[k - 1]]
            for k, end in zip(starts, [*starts[1:], len(row)]):
                if row[k] != c.nominal:
                    name = c.name.removeprefix("plant.")
                    windows.append((name, float(edges[k]), float(edges[end])))
                    extra.append(row[k] - c.nominal)
        factor = np.ones(len(extra))
        if of_case is not None:
            factor, extra = np.append(factor, of_case.factor), np.append(extra, of_case.extra)
            windows += of_case.windows
        if not windows:
            return None
        return Faults(factor=factor, extra=np.asarray(extra), windows=tuple(windows))


def _rows(run):
    """Values in each window of every coefficient: (windows,) arrays, (1,) where constant."""
    return [*np.asarray(run.values["varying"]), *np.asarray(run.values["constant"])[:, None]]

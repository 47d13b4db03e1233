"""The setting of a default answer: plants, noise, cost, safety filter, and a coarser clock."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank import rig
from jaxtank.case import Case, Scenario, uncertain_shares
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.core.text import count
from jaxtank.core.tree import split_index, with_values
from jaxtank.limits import limited_levels
from jaxtank.loop import run as lp
from jaxtank.loop.closed_loop import takes_arrays
from jaxtank.loop.step_size import unstable_tanks
from jaxtank.plants.runge_kutta import advance
from jaxtank.rig.values import by_rig_name
from jaxtank.safety.box import beyond_box
from jaxtank.safety.of_case import inflow_bounds
from jaxtank.task import (
    default_cost,
    has_own_objective,
    height,
    input_range,
    sensor_noise,
    with_noise,
)
from jaxtank.xla.jit import compiled
from tuning.problem.scenarios import screening_clock
from tuning.uncertainty.distributions import Discrete, Empirical, Uniform, stated as stated_of
from tuning.uncertainty.draws import Draws, ends_of
from tuning.uncertainty.sampling import probabilities, spread_of

LARGEST_ERROR = 1e-3  # largest `midpoint_error`: a fiftieth of the spread of flows [-]

STATES = 256  # states and inputs at which both are compared

LOWEST = 0.05  # least level of these states [-]: near empty, stability limits the step


def midpoint_error(case: Case, clock: Clock, height: float, span: np.ndarray) -> float:
    """Return the relative difference of the midpoint rule and RK4 over one sample."""
    loop, plant = case.loop, case.loop.plant
    if any(unstable_tanks(loop, dataclasses.replace(clock, integrator="midpoint"))):
        return np.inf
    random, arrays = np.random.default_rng(0), takes_arrays(loop)
    low = np.broadcast_to(np.asarray(loop.actuator.low, float), (plant.pumps,))
    low = np.where(np.isfinite(low), np.maximum(low, -span), 0.0)
    x = height * random.uniform(LOWEST, 1.0, (STATES, plant.tanks))
    u = low + span * random.uniform(size=(STATES, plant.pumps))

    squares = _changes(plant, x, u, clock.dt, substeps=clock.substeps, arrays=arrays)
    off, moved = (float(jnp.sum(v)) for v in squares)
    share = np.sqrt(off / moved) if moved > 0.0 else np.inf
    return float(share) if np.isfinite(share) else np.inf


@compiled("substeps", "arrays", keep=True, optimised=False)
def _changes(plant: Any, x: Any, u: Any, dt: Any, substeps: int, arrays: bool) -> Any:
    """Squared differences of midpoint rule and RK4 over a sample, and of the level."""

    def changes(x: Any, u: Any) -> Any:
        start, inputs = (x, u) if arrays else (tuple(x), tuple(u))
        midpoint, rk4 = (
            jnp.asarray(advance(plant, rule, 0.0, start, inputs, None, dt, substeps).x)
            for rule in ("midpoint", "rk4")
        )
        return jnp.sum((midpoint - rk4) ** 2), jnp.sum((rk4 - x) ** 2)

    return jax.vmap(changes)(x, u)


NEAR = 0.9  # share of its limit that a level must reach on some plant for the limit to matter
FREE = 10.0  # limit of a tank that a safety filter leaves alone, in heights of the rig
PLANTS = 32  # plants that the search runs on
NOT_IN_PROOF = ("reference.", "clock.duration", "controller.", "observer.", "sensor.noise")
"""What a scenario may change of a case without a change of what its safety filter proves."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Setting:
    """The case of the user, and the changed case that is searched and judged."""

    case: Case
    searched: Case
    objective: Mapping[str, float]
    own_objective: bool
    distributions: Mapping[str, Any]
    stated: bool
    noise: np.ndarray  # (tanks,) [unit of length]
    assumed: bool
    span: np.ndarray
    filter: Mapping[str, Any] | None = None
    certificates: tuple = ()

    def replace(self, **changes: Any) -> "Setting":
        return dataclasses.replace(self, **changes)

    @property
    def limits(self) -> Mapping[str, Any]:
        """Limits that the search must keep to: those that no certificate covers."""
        proved = bool(self.certificates) and all(row.certified for row in self.certificates)
        return {m: v for m, v in self.case.limits.items() if not (proved and m == "max_level")}

    @property
    def plants_vary(self) -> bool:
        return any(not name.startswith("sensor.") for name in self.distributions)

    @property
    def runs(self) -> str:
        """Name of the runs on which the answer is judged, in the plural."""
        scenarios = len(scenarios_to_judge(self.case))
        where = f" in {count(scenarios, 'scenario')}" if scenarios else ""
        plants = "validation plants" if self.plants_vary else "runs of one plant, with new noise"
        return plants + where

    @property
    def cost_unit(self) -> str | None:
        return None if self.own_objective else f"{self.case.loop.units[0]}^2"

    def coarse(self) -> Case:
        """Return the searched case at ten times its step, itself where it cannot run so."""
        # By the midpoint rule where its error is small enough; itself too with too few samples.
        clock = screening_clock(self.searched.clock)
        if clock == self.searched.clock:
            return self.searched
        if midpoint_error(self.searched, clock, height(self.case), self.span) <= LARGEST_ERROR:
            clock = dataclasses.replace(clock, integrator="midpoint")
        try:
            coarse = self.searched.replace(clock=clock)
            lp.check(coarse.loop, clock, jax.random.key(0))
            return coarse if self.filter is None else self._filtered(coarse, self.filter)
        except InputError:  # a dead time that is no multiple of the longer step, for one
            return self.searched

    def plants(self, case: Case, samples: int, seed: int) -> tuple[Scenario, ...]:
        """Return the scenarios of at least `samples` plants of `case`, at any clock."""
        return scenarios_of(case, self.distributions, max(samples, len(case.scenarios)), seed)

    def with_filter(self, near: np.ndarray | None = None) -> "Setting":
        """Return the setting with a safety filter; itself where the plant can have none."""
        settings = dict(self.case.safety or {})
        plain, limits = self.searched.without_safety_filter(), limited_levels(self.case)
        try:
            safety_filter, rows = plain.safety_design(**settings)
            # a level that matters may be kept below its limit for the sake of another one
            reached = np.ones(len(limits), dtype=bool) if near is None else near
            lowers = lambda row: reached[row.tank] and row.limit < 0.999 * limits[row.tank]
            lowered = any(map(lowers, rows))
            if lowered and not np.all(reached):
                limit = np.where(reached, limits, FREE * height(self.case))
                settings = {"limit": limit.tolist()} | settings
                safety_filter, rows = plain.safety_design(**settings)
                rows = tuple(row for row in rows if reached[row.tank])
        except InputError:
            return self
        # both follow from the noise, which the case as given may not state
        band, rate = np.asarray(safety_filter.band).tolist(), float(np.max(safety_filter.rate))
        return self.replace(
            searched=plain.with_safety_filter(**settings),
            filter={"band": band, "rate": rate} | settings,
            certificates=tuple(_for_these_plants(self, safety_filter, row) for row in rows),
        )

    @staticmethod
    def _filtered(case: Case, settings: Mapping[str, Any]) -> Case:
        return case.without_safety_filter().with_safety_filter(**settings)

    def without_filter(self) -> "Setting":
        searched = self.searched.without_safety_filter()
        return self.replace(searched=searched, filter=None, certificates=())

    def tuned(self, values: Mapping[str, float]) -> Case:
        """Return the case as given with `values`, the filter, and the objective of the search."""
        loop = with_values(self.case.loop, values)
        case = self.case.replace(loop=loop, objective=dict(self.objective))
        if self.filter is None:
            return case.without_safety_filter()
        return self._filtered(case, self.filter)


def scenarios_of(case, distributions=None, samples=64, seed=0):
    """Return `samples` Scenarios of a case, each on a plant drawn from `distributions`."""
    # Latin hypercube draws in the scenarios of the case in turn, each with different noise
    distributions = (
        spread_of(case) if distributions is None else stated_of(distributions, case.loop)
    )
    space = Draws(case.loop, distributions)
    values = space.values(probabilities("latin", space.dimensions, samples, seed))
    base, plants = with_dotted_names(case).scenarios or (Scenario("run"),), []
    for i in range(samples):
        scenario = base[i % len(base)]
        plant = {n: v[i].tolist() for n, v in not_stated(scenario, values).items()}
        seed = (scenario.seed + 7919 * (i + 1)) % 2**31
        name = f"plant {i + 1}" + f" ({scenario.name})" * bool(case.scenarios)
        plants.append(Scenario(name, {**scenario.values, **plant}, seed, scenario.weight))
    return tuple(plants)


def not_stated(scenario: Scenario, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the drawn values of what a scenario does not state, or an entry of it."""
    stated = {split_index(n)[0] for n in scenario.values}
    return {n: v for n, v in values.items() if split_index(n)[0] not in stated}


def with_dotted_names(case: Case) -> Case:
    """Return the case with scenarios whose names are not those of its rig."""
    named = [s._replace(values=by_rig_name(case.loop, s.values)) for s in case.scenarios]
    return case.replace(scenarios=tuple(named))


def _for_these_plants(setting, safety_filter, row):
    """Return a certificate, not certified where it is not of these plants or of a higher limit."""
    limit = limited_levels(setting.case)[row.tank]
    why = ""
    if (row.certified or row.low_certified) and not _in_box(setting, safety_filter):
        why = "the plants asked for reach beyond the tolerances of the filter"
        row = dataclasses.replace(row, low_certified=False, low_reason=why)
    elif row.certified and row.limit > limit * (1.0 + 1e-9):
        why = f"the limit of the filter, {row.limit:.4g}, is above that on max_level, {limit:.4g}"
    return dataclasses.replace(row, certified=False, reason=why) if why else row


def _in_box(setting, safety_filter):
    """Return True if every plant is one that a filter was designed for."""
    scenarios, distributions = scenarios_to_judge(setting.case), setting.distributions
    if any(not n.startswith(NOT_IN_PROOF) for s in scenarios for n in s.values):
        return False  # a scenario has a plant, a start or an inflow of its own
    if any(_has_other_inflow(setting.case, s.values) for s in scenarios):
        return False
    if any(isinstance(d, Discrete | Empirical) for d in distributions.values()):
        return False  # whose ends are not those of their probabilities
    ends = ends_of(setting.case.loop, distributions)
    plants = {n: pair for n, pair in ends.items() if n.startswith("plant.")}
    tolerances = setting.case.uncertain  # what else varies is in the design if it is in these
    shares = {n: getattr(distributions.get(n), "relative", None) for n in ends.keys() - plants}
    known = all(share is not None and tolerances.get(n) == share for n, share in shares.items())
    return known and not beyond_box(safety_filter, plants)


def _has_other_inflow(case, values):
    """Whether a run of another duration has inflows beyond those of the case's own."""
    if "clock.duration" not in values:
        return False
    clock = dataclasses.replace(case.clock, duration=float(values["clock.duration"]))
    (least, most, *_), (low, high, *_) = (inflow_bounds(case.loop, c) for c in (clock, case.clock))
    return bool(np.any(least < low) or np.any(most > high))


def setting_of(
    case: Case,
    objective: Mapping[str, float] | None = None,
    limits: Mapping[str, Any] | None = None,
    distributions: Mapping[str, Any] | None = None,
) -> Setting:
    """Return the Setting of a case, without a safety filter unless the case has one."""
    if limits is not None:
        case = case.replace(limits=dict(limits))
    case = with_dotted_names(case)
    case = case.replace(limits=dict(rig.check_limits(case.loop, case.limits)))
    if distributions is not None:
        distributions = stated_of(distributions, case.loop)
        case = _with_box(case, distributions)
    (noise, assumed), span = sensor_noise(case), input_range(case)
    if objective is not None:
        objective = rig.check_objective(objective)
    elif has_own_objective(case):
        objective = dict(case.objective)
    setting = Setting(
        case=case,
        searched=with_noise(case, noise) if noise.any() else case,
        objective=default_cost(case, span) if objective is None else objective,
        own_objective=objective is not None,
        distributions=distributions or plants_of(case),
        stated=is_stated(case) or distributions is not None,
        noise=noise,
        assumed=assumed,
        span=span,
    )
    return setting.with_filter() if case.loop.safety_filter is not None else setting


def _with_box(case, distributions):
    """Return the case with `distributions` as its tolerances, where they are shares."""
    shares = {n: d.relative for n, d in distributions.items() if isinstance(d, Uniform)}
    if len(shares) < len(distributions) or None in shares.values():
        return case
    return case.replace(uncertain=shares, covariance=None)


def scenarios_to_judge(case: Case) -> Sequence[Scenario]:
    """The scenarios of a case if one of them changes more than the noise, which `searched` has."""
    changes = any(split_index(n)[0] != "sensor.noise" for s in case.scenarios for n in s.values)
    return case.scenarios if changes else ()


def is_stated(case: Case) -> bool:
    return bool(case.uncertain) or case.covariance is not None


def plants_of(case: Case) -> dict[str, Any]:
    return spread_of(case.replace(uncertain=uncertain_shares(case)))

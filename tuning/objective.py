"""What is made small and what must hold, as numbers with exact derivatives."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank import loop as lp
from jaxtank import measures as ms
from jaxtank.errors import InputError
from jaxtank.rig import check_limits, check_objective
from jaxtank.tree import get_value, with_values
from tuning.bounds import bounds

FORWARD_LIMIT = 10
"""Number of free parameters up to which derivatives run forward with the simulation; above, checkpointed reverse."""

LOWER = {"min_level"}
"""Measures whose limit is a lower one."""

EXPLODED = 1e9
"""Size at which a cost, a margin or a slope is no longer a number to search with."""

NOT_A_NUMBER = 1e6
"""Amount by which an infinite measure (never settled) is taken to break its limit, and one that does not apply to hold it."""

SPILL = 1e-3
"""Volume over a rim that counts as none [cm^3], where rims are physics."""


class Limit(NamedTuple):
    """One hard constraint: entry `index` of `measure` at most (or at least) `value`, in the measure's unit."""

    measure: str
    index: int
    value: float

    @property
    def sign(self):
        """+1 for an upper limit, -1 for a lower one."""
        return -1.0 if self.measure in LOWER else 1.0

    @property
    def label(self):
        """Name with the entry, counted from 1: "max_level of tank 3"."""
        per = ms.MEASURES[self.measure].per
        return self.measure if per == "run" else f"{self.measure} of {per} {self.index + 1}"

    def margin(self, measures):
        """How far the limit is from being met exactly: positive where it holds. A measure that does not apply (the settling time of an
        output that is never changed) holds by NOT_A_NUMBER, an infinite one breaks by as much."""
        value = float(np.ravel(measures[self.measure])[self.index])
        if np.isnan(value):
            return NOT_A_NUMBER
        return float(np.clip(self.sign * (self.value - value), -NOT_A_NUMBER, NOT_A_NUMBER))


class Point(NamedTuple):
    """The problem at one point z of the unit cube, derivatives with respect to z."""

    z: np.ndarray  # (P,)
    cost: float  # weighted sum of measures
    gradient: np.ndarray  # (P,)
    gauss_newton: np.ndarray  # (P, P) of the mean squared tracking error [cm^2]
    margins: np.ndarray  # (limits,) in each measure's unit
    margin_slopes: np.ndarray  # (limits, P)
    measures: dict

    @property
    def finite(self):
        """True if cost, margins and derivatives are numbers one can search with; a slope of 1e9 is that of a loop that has gone unstable."""
        return all(np.all(np.abs(v) < EXPLODED) for v in (self.cost, self.gradient, self.margins, self.margin_slopes))


def resolve_limits(case, limits=None):
    """The Limits of {measure: number, list or "rim"}; the case's own where None.

    With rims as physics a level cannot pass its rim, so a limit at the rim becomes one of no overflow volume. Raises InputError for
    an unknown measure or a value that is no number.
    """
    found, plant = [], case.loop.plant
    for measure, value in check_limits(case.loop, case.limits if limits is None else limits).items():
        value = np.asarray(plant.rim) if isinstance(value, str) else value
        values = np.broadcast_to(np.asarray(value, dtype=float), (ms.entries(measure, plant),))
        for i, v in enumerate(values):
            held = plant.overflow and measure == "max_level" and v >= plant.rim[i]
            found.append(Limit("overflow_volume", i, SPILL) if held else Limit(measure, i, float(v)))
    return found


class Problem:
    """A case, its free parameters, its cost and its limits.

    free: {name: Free}; objective: {measure: weight} (a list measure counts with the sum of its entries); limits as in
    resolve_limits; key: jax random key for sensor noise, the same for every evaluation (common random numbers).
    """

    def __init__(self, case, free=None, objective=None, limits=None, key=None):
        self.case, self.loop, self.clock, self.key = case, case.loop, case.clock, key
        self.bounds = bounds(case.loop, case.free if free is None else free)
        self.objective = check_objective(case.objective if objective is None else objective)
        self.limits = resolve_limits(case, limits)
        self.needed = tuple(dict.fromkeys([*self.objective, *(limit.measure for limit in self.limits)]))
        self.simulations, self.gradients, self.non_finite = 0, 0, 0

    @property
    def names(self):
        """Dotted names of the P free scalars."""
        return [b.name for b in self.bounds]

    @property
    def squares(self):
        """True if the cost is the tracking error alone, so that Gauss-Newton applies."""
        return set(self.objective) == {"rms_error_total"}

    def start(self):
        """(P,) z of the case's own values. Raises InputError if one lies outside its range."""
        z = []
        for b in self.bounds:
            value = float(get_value(self.loop, b.name))
            if not b.low <= value <= b.high:
                raise InputError(f"{b.name} = {value:g} {b.unit}: starts outside its range {b.low:g}:{b.high:g} {b.unit}")
            z.append(float(b.to_unit(value)))
        return np.array(z)

    def values(self, z):
        """{name: value in its unit} at z."""
        return {b.name: float(b.from_unit(v)) for b, v in zip(self.bounds, z)}

    def loop_at(self, z):
        """The loop with the values at z."""
        return with_values(self.loop, self.values(z))

    def cost(self, measures):
        """Weighted sum of measures."""
        return sum(w * float(np.sum(measures[m])) for m, w in self.objective.items())

    def margins(self, measures):
        """(limits,) margin of each limit."""
        return np.array([limit.margin(measures) for limit in self.limits])

    def screen(self, zs, clock):
        """(cost, margins) at many points (points, P), at `clock`, without derivatives."""
        values = {b.name: jnp.asarray(b.from_unit(zs[:, i])) for i, b in enumerate(self.bounds)}
        measures, broken = _batch(self.loop, clock, self.needed, values, self.key)
        self.simulations += len(zs)
        table = [{m: np.asarray(v[i]) for m, v in measures.items()} for i in range(len(zs))]
        costs = np.where(broken, np.nan, [self.cost(row) for row in table])
        return costs, np.array([self.margins(row) for row in table]).reshape(len(zs), -1)

    @np.errstate(over="ignore", invalid="ignore")  # what explodes is told by Point.finite
    def point(self, z):
        """The Point at z: one run at the case's own step, with derivatives."""
        z = np.clip(np.asarray(z, dtype=float), 0.0, 1.0)
        values = {name: np.float64(v) for name, v in self.values(z).items()}
        measures, slopes, gauss_newton, broken = self._run(values)
        self.simulations, self.gradients = self.simulations + 1, self.gradients + 1
        per_z = np.array([float(b.slope(np.float64(v))) for b, v in zip(self.bounds, values.values())])
        measures = {m: np.asarray(v) for m, v in measures.items()}
        slopes = {m: np.asarray(v).reshape(-1, len(z)) * per_z for m, v in slopes.items()}
        gradient = sum(w * slopes[m].sum(axis=0) for m, w in self.objective.items())
        margins = self.margins(measures)
        margin_slopes = np.array([-limit.sign * slopes[limit.measure][limit.index] for limit in self.limits]).reshape(-1, len(z))
        margin_slopes[np.abs(margins) >= NOT_A_NUMBER] = 0.0
        found = Point(
            z=z,
            cost=np.nan if broken else self.cost(measures),
            gradient=gradient,
            gauss_newton=np.asarray(gauss_newton) * np.outer(per_z, per_z),
            margins=margins,
            margin_slopes=margin_slopes,
            measures=measures,
        )
        self.non_finite += not found.finite
        return found

    def _run(self, values):
        if len(values) <= FORWARD_LIMIT:
            return lp.sensitivities(self.loop, self.clock, self.needed, values, self.key)
        measures, slopes = _reverse(self.loop, self.clock, self.needed, tuple(values), np.array(list(values.values())), self.key)
        broken = not all(np.all(np.isfinite(v)) for v in slopes.values())
        return measures, slopes, np.full((len(values),) * 2, np.nan), broken


@functools.partial(jax.jit, static_argnames=("clock", "names"))
def _batch(loop, clock, names, values, key):
    return jax.vmap(lambda v: lp.evaluate_and_flag(with_values(loop, v), clock, names, key))(values)


@functools.partial(jax.jit, static_argnames=("clock", "names", "order"))
def _reverse(loop, clock, names, order, theta, key):
    """(measures, {measure: (entries, P) slopes}) by reverse mode through checkpointed pieces; theta: (P,) values of `order`."""

    def run(theta):
        measures = lp.evaluate_for_reverse(with_values(loop, dict(zip(order, theta))), clock, names, key)
        return measures, measures

    slopes, measures = jax.jacrev(run, has_aux=True)(theta)
    return measures, slopes

"""Extended and unscented Kalman filters on the model of a rig."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.analysis.riccati import discrete_riccati
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import POSITIVE, component, leaf, split_index, static, with_entries
from jaxtank.observers.base import Observer
from jaxtank.observers.checks import check_coefficients, check_disturbed, check_model, check_tanks
from jaxtank.plants.base import Plant
from jaxtank.plants.elements import sections
from jaxtank.plants.runge_kutta import advance

SMALLEST = 1e-14  # share of a variance below which what the other numbers leave of it is round-off


class Belief(NamedTuple):
    """State of the extended filter, of n tanks and N = n + disturbed + coefficients numbers."""

    x: Sequence  # (N) levels [cm], disturbances of level rates [cm/s], logarithms of coefficients
    P: tuple  # (N) rows of N covariances [cm^2, cm^2/s, cm^2/s^2]
    u: Sequence = ()  # (m) last inputs within the limits [V], where coefficients are estimated


@component
class ExtendedKalman(Observer):
    """Extended Kalman filter (Jazwinski 1970): the levels are predicted by an integrator step,
    their covariance by that step's Jacobian.

        correct, for each measured tank i in turn:  K = P e_i / (P_ii + r_i),  x += K (y_i - x_i),
        P -= K e_i' P
        predict:  x = Phi(x, u),  P = F P F' + Q dt,   F = d Phi / d x

    Phi is one or more steps of "rk4" or "midpoint" with u, the input after the pumps' limits, held.
    The noises of the sensors are independent, so that correcting by one after the other is the
    joint correction and no matrix is inverted. x [cm], P [cm^2].

    `disturbed` names tanks whose level rate has a part d [cm/s] that the model does not explain, a
    random walk that gains the variance `walk` per second and is 0 at first; x is then extended by
    them, d(k+1) = d(k), and the controller receives the estimate. There can be no more of them than
    measured tanks, and each must act on one.

    `coefficients` names entries of the model that drift, such as "pump_gain[0]" or "drain[1]": each
    is its value in the model times exp(s), s a random walk that begins at 0 with the variance
    `coefficient_spread` and gains `coefficient_walk` per second (the joint state, Ljung 1979). The
    controller receives as d also what the new coefficients add to the level rates at the last
    inputs.

    Examples
    --------
    >>> from jaxtank.plants.rigs import johansson
    >>> observer = ExtendedKalman(
    ...     model=johansson("minimum")[0],
    ...     process=[0.01] * 4,
    ...     measurement=[0.04] * 4,
    ...     spread=[0.04] * 4,
    ...     measured=(0, 1),
    ... )
    >>> tick = Tick(t=0.0, r=(12.0, 12.0), dr=(0.0, 0.0), ddr=(0.0, 0.0), dt=0.1)
    >>> start = observer.init((12.0, 12.0, 2.0, 2.0))
    >>> estimate, _ = observer.step(start, tick, (12.2, 12.0, 0.0, 0.0))
    >>> [round(float(h), 6) for h in estimate.x]  # equal variances: half the innovation
    [12.1, 12.0, 2.0, 2.0]
    """

    model: Plant
    process: np.ndarray = leaf(
        "cm^2/s",
        "variance that each level's own disturbance gains per second (Q)",
        low=0.0,
        shape="tank",
    )
    measurement: np.ndarray = leaf(
        "cm^2",
        "variance of each sensor's noise (r); of unmeasured tanks not used",
        **POSITIVE,
        shape="tank",
    )
    spread: np.ndarray = leaf(
        "cm^2", "variance of the initial estimate at t = 0", low=0.0, shape="tank"
    )
    start: np.ndarray | None = leaf(
        "cm",
        "initial estimate at t = 0; absent: the true ones",
        low=0.0,
        like="spread",
        default=None,
        shape="tank",
    )
    walk: np.ndarray | None = leaf(
        "cm^2/s^3",
        "variance that the disturbance of each level's rate gains per second; of tanks not in"
        " `disturbed` not used",
        **POSITIVE,
        like="process",
        default=None,
        shape="tank",
    )
    coefficient_spread: Any = leaf(
        "-",
        "variance of the logarithm of each of `coefficients` at t = 0: of its relative error",
        **POSITIVE,
        like="coefficient_walk",
        default=None,
    )
    coefficient_walk: Any = leaf(
        "1/s",
        "variance that the logarithm of each of `coefficients` gains per second",
        low=0.0,
        like="coefficient_spread",
        default=None,
    )
    measured: tuple = static(doc="tanks whose levels are measured, counted from 0")
    disturbed: tuple = static(
        doc="tanks whose rate has a disturbance that is estimated, counted from 0", default=()
    )
    coefficients: tuple = static(
        doc='entries of the model that are estimated too, such as "pump_gain[0]"', default=()
    )
    substeps: int = static("-", "integrator steps per sample", low=1, high=10, default=1)
    integrator: str = static(
        doc="how the model is integrated", choices=("rk4", "midpoint"), default="rk4"
    )

    def init(self, x0: tuple) -> Any:
        n = range(len(x0))
        x = x0 if self.start is None else tuple(self.start[i] + 0.0 * x0[i] for i in n)
        zero = 0.0 * x0[0]
        walks, logarithms = [zero for _ in self.disturbed], [zero for _ in self.coefficients]
        variances = [self.spread[i] + 0.0 * x0[i] for i in n] + walks
        variances += [self.coefficient_spread + v for v in logarithms]
        N = range(len(variances))
        return Belief(
            x=(*x, *walks, *logarithms),
            P=tuple(tuple(variances[i] if i == j else zero for j in N) for i in N),
            u=(zero,) * self.model.pumps if self.coefficients else (),
        )

    def step(self, state: Any, tick: Tick, y: Sequence) -> tuple[Estimate, Any]:
        x, P = self._corrected(state, y)
        return self._estimate(x, state.u, tick), Belief(x, P, state.u)

    def _corrected(self, state, y):
        """((N) numbers, (N) rows of N covariances) of a Belief after readings y (n)."""
        x, P, _ = state
        n = range(len(x))
        for i in self.measured:
            K = [P[j][i] / (P[i][i] + self.measurement[i]) for j in n]
            x = tuple(x[j] + K[j] * (y[i] - x[i]) for j in n)
            P = _symmetric([[P[j][k] - K[j] * P[i][k] for k in n] for j in n])
        return x, P

    def _estimate(self, x, u, tick):
        """The Estimate of a state, with last inputs u."""
        levels, d, plant = self._parts(x)
        if not self.coefficients:
            return Estimate(x=levels, d=d)
        rates = [of.derivative(tick.t, levels, u, None) for of in (plant, self.model)]
        added = tuple(after - before for after, before in zip(*rates))
        entries = [split_index(name) for name in self.coefficients]
        return Estimate(
            x=levels,
            d=tuple(a + b for a, b in zip(added, d)) if d else added,
            coefficients=tuple(getattr(plant, field)[i] for field, (i,) in entries),
        )

    def _parts(self, x):
        """((n) levels [cm], (n) disturbances [cm/s], () without `disturbed`, model) of a state."""
        model, n, after = self.model, self.model.tanks, self.model.tanks + len(self.disturbed)
        levels, d = x[:n], [0.0 * h for h in x[:n]] if self.disturbed else []
        for i, value in zip(self.disturbed, x[n:after]):
            d[i] = value
        if self.coefficients:
            factors = [lambda value, s=s: value * jnp.exp(s) for s in x[after:]]
            model = with_entries(model, zip(self.coefficients, factors))
        return levels, tuple(d), model

    def predict(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        x, N, n = state.x, range(len(state.x)), self.model.tanks
        levels, P = self._moved(lambda x: self._onward(x, applied, tick), x, state.P)
        gained = self._gained()
        P = [[P[i][j] + (gained[i] * tick.dt if i == j else 0.0) for j in N] for i in N]
        u = tuple(applied) if self.coefficients else ()
        return Belief((*levels, *x[n:]), _symmetric(P), u)

    def _onward(self, x, applied, tick):
        """(n) levels a sample later; a random walk stays where it is."""
        levels, d, model = self._parts(x)
        inflow = tuple(a * v for a, v in zip(sections(model, levels), d)) if d else None
        known = model, self.integrator, tick.t, levels, applied, inflow
        return advance(*known, tick.dt, self.substeps).x

    def _gained(self):
        """(N) variances that the state gains per second."""
        walk = cast(Any, self.walk)
        gained = [self.process[i] for i in range(self.model.tanks)]
        gained += [walk[i] for i in self.disturbed]
        return gained + [self.coefficient_walk for _ in self.coefficients]

    def _moved(self, onward: Any, x: Sequence, P: Sequence) -> tuple[Sequence, list]:
        """Return the (n) levels a sample later and the (N) rows of N covariances, without noise."""
        N, n = range(len(x)), self.model.tanks
        unit, zero = jnp.ones_like(x[0]), jnp.zeros_like(x[0])
        # columns[j][i] = F_ij of the levels i; random walks have the rows of the identity
        columns = [
            jax.jvp(onward, (x,), (tuple(unit if i == j else zero for i in N),))[1] for j in N
        ]
        FP = [[sum(columns[k][i] * P[k][j] for k in N) if i < n else P[i][j] for j in N] for i in N]
        return onward(x), [
            [sum(FP[i][k] * columns[k][j] for k in N) if j < n else FP[i][j] for j in N] for i in N
        ]

    def settled(self, state: Any, dt: Any, u: Sequence) -> Any:
        # from no variance of a random walk Newton's method does not find that of a steady state
        return self._at_rest(state, dt, u) if self.disturbed or self.coefficients else state

    def _at_rest(self, state, dt, u):
        """A Belief with the covariances of its steady state."""
        n, tick = self.model.tanks, Tick(t=0.0, r=(), dr=(), ddr=(), dt=dt)
        x = jnp.stack(list(state.x))
        A = jax.jacfwd(lambda x: jnp.stack([*self._onward(tuple(x), u, tick), *x[n:]]))(x)
        C = jnp.eye(len(x))[np.array(self.measured)]
        noise = jnp.diag(jnp.stack(self._gained()) * dt)
        R = jnp.diag(jnp.asarray(self.measurement)[np.array(self.measured)])
        P = discrete_riccati(A.T, C.T, noise, R)
        u = tuple(u) if self.coefficients else ()
        return state._replace(P=tuple(tuple(row) for row in P), u=u)

    def check(self, plant: Plant) -> None:
        check_model(self, plant)
        check_tanks(self, "measured", plant)
        check_coefficients(self)
        # half full, each tank a little differently: levels at which no two flows cancel
        check_disturbed(self, plant, self.model.rim, 0.5 + 0.01 * np.arange(plant.tanks))


@component
class UnscentedKalman(ExtendedKalman):
    """Unscented Kalman filter (Julier and Uhlmann 1997) with the weights of the cubature filter
    (Arasaratnam and Haykin 2009): as `ExtendedKalman`, but mean and covariance are predicted by
    2 N states in place of a Jacobian,

        x_j = x +- sqrt(N) L_j,   L L' = P,   x = mean of Phi(x_j),
        P = mean of (Phi(x_j) - x)(Phi(x_j) - x)' + Q dt

    The mean is right to the third order of Phi, by a Jacobian to the first: better where a level is
    so uncertain that the flow of its outlet is curved over it, near the bottom of a tank. All
    weights are positive, so that P is never indefinite. x [cm], P [cm^2]. The correction is
    that of `ExtendedKalman`: the sensors are linear, and both are exact.

    Examples
    --------
    >>> from jaxtank.plants.rigs import johansson
    >>> observer = UnscentedKalman(
    ...     model=johansson("minimum")[0],
    ...     process=[0.01] * 4,
    ...     measurement=[0.04] * 4,
    ...     spread=[0.04] * 4,
    ...     measured=(0, 1),
    ... )
    >>> start = observer.init((12.0, 12.0, 2.0, 2.0))
    >>> tick = Tick(t=0.0, r=(12.0, 12.0), dr=(0.0, 0.0), ddr=(0.0, 0.0), dt=0.1)
    >>> later = observer.predict(start, tick, (3.0, 3.0), (3.0, 3.0))
    >>> [round(float(later.P[i][i]), 4) for i in range(4)]
    [0.0409, 0.0409, 0.0407, 0.0408]
    """

    def _moved(self, onward: Any, x: Sequence, P: Sequence) -> tuple[Sequence, list]:
        N, n = range(len(x)), self.model.tanks
        root, points = math.sqrt(len(x)), []
        for column in columns_of(P):
            for sign in (root, -root):
                point = tuple(x[i] + sign * column[i] for i in N)
                points.append((*onward(point), *point[n:]))
        share = 1.0 / len(points)
        levels = [share * sum(point[i] for point in points) for i in range(n)]
        away = [[point[i] - m for i, m in enumerate((*levels, *x[n:]))] for point in points]
        return levels, [[share * sum(d[i] * d[j] for d in away) for j in N] for i in N]


def columns_of(P):
    """Return the columns of L, L L' = P; that of a number without a variance is 0."""
    N, columns = range(len(P)), []
    for j in N:
        rest = [P[i][j] - sum(c[i] * c[j] for c in columns) for i in N]
        varies = rest[j] > SMALLEST * P[j][j]
        pivot = jnp.sqrt(jnp.where(varies, rest[j], 1.0))
        column = [jnp.where(varies, rest[i] / pivot, 0.0) if i >= j else 0.0 * rest[i] for i in N]
        columns.append(column)
    return columns


def _symmetric(P):
    """Rows whose lower half is the upper one: round-off would make them differ."""
    return tuple(tuple(P[min(i, j)][max(i, j)] for j in range(len(P))) for i in range(len(P)))

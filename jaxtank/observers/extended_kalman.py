"""Extended and unscented Kalman filters on the model of a rig."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import POSITIVE, component, leaf, static
from jaxtank.observers.base import Observer
from jaxtank.observers.checks import check_disturbed, check_model, check_tanks
from jaxtank.plants.base import Plant
from jaxtank.plants.elements import sections
from jaxtank.plants.runge_kutta import advance

SMALLEST = 1e-14
"""Share of a variance below which what the other numbers leave of it is round-off."""


class Belief(NamedTuple):
    """State of the extended filter, of n tanks and N = n + disturbed numbers."""

    x: Sequence  # (N) levels [cm], then disturbances of level rates [cm/s]
    P: tuple  # (N) rows of N covariances [cm^2, cm^2/s, cm^2/s^2]


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
    measured: tuple = static(doc="tanks whose levels are measured, counted from 0")
    disturbed: tuple = static(
        doc="tanks whose rate has a disturbance that is estimated, counted from 0", default=()
    )
    substeps: int = static("-", "integrator steps per sample", low=1, high=10, default=1)
    integrator: str = static(
        doc="how the model is integrated", choices=("rk4", "midpoint"), default="rk4"
    )

    def init(self, x0: tuple) -> Any:
        n = range(len(x0))
        x = x0 if self.start is None else tuple(self.start[i] + 0.0 * x0[i] for i in n)
        zero, N = 0.0 * x0[0], range(len(x0) + len(self.disturbed))
        return Belief(
            x=(*x, *(zero for _ in self.disturbed)),
            P=tuple(
                tuple(self.spread[i] + 0.0 * x0[i] if i == j and i in n else zero for j in N)
                for i in N
            ),
        )

    def step(self, state: Any, tick: Tick, y: Sequence) -> tuple[Estimate, Any]:
        x, P = state
        n = range(len(x))
        for i in self.measured:
            K = [P[j][i] / (P[i][i] + self.measurement[i]) for j in n]
            x = tuple(x[j] + K[j] * (y[i] - x[i]) for j in n)
            P = _symmetric([[P[j][k] - K[j] * P[i][k] for k in n] for j in n])
        levels, d = self._parts(x)
        return Estimate(x=levels, d=d), Belief(x, P)

    def _parts(self, x):
        """((n) levels [cm], (n) disturbances [cm/s], () without `disturbed`) of a state."""
        levels, disturbances = x[: self.model.tanks], x[self.model.tanks :]
        if not self.disturbed:
            return levels, ()
        d = [0.0 * h for h in levels]
        for i, value in zip(self.disturbed, disturbances):
            d[i] = value
        return levels, tuple(d)

    def predict(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        model, N, n = self.model, range(len(state.x)), self.model.tanks
        walk = cast(Any, self.walk)

        def onward(x):  # the levels alone: a random walk stays where it is
            levels, d = self._parts(x)
            inflow = tuple(a * v for a, v in zip(sections(model, levels), d)) if d else None
            return advance(
                model, self.integrator, tick.t, levels, applied, inflow, tick.dt, self.substeps
            ).x

        levels, P = self._moved(onward, *state)
        gained = [self.process[i] for i in range(n)] + [walk[i] for i in self.disturbed]
        P = [[P[i][j] + (gained[i] * tick.dt if i == j else 0.0) for j in N] for i in N]
        return Belief((*levels, *state.x[n:]), _symmetric(P))

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

    def check(self, plant: Plant) -> None:
        check_model(self, plant)
        check_tanks(self, "measured", plant)
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
        for column in _columns(P):
            for sign in (root, -root):
                point = tuple(x[i] + sign * column[i] for i in N)
                points.append((*onward(point), *point[n:]))
        share = 1.0 / len(points)
        levels = [share * sum(point[i] for point in points) for i in range(n)]
        away = [[point[i] - m for i, m in enumerate((*levels, *x[n:]))] for point in points]
        return levels, [[share * sum(d[i] * d[j] for d in away) for j in N] for i in N]


def _columns(P):
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

"""Steady states of large networks with pipes: Newton's method with a sparse Jacobian, on the host.

With 1,000 tanks a dense one takes minutes.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy  # its parts are imported when they are first used

from jaxtank.core.numerics import smooth_signed_sqrt, smooth_sqrt

STEPS = 200
"""Steps at most; ten to thirty suffice where there is a steady state."""


class Balance:
    """Rates and their Jacobian at levels x (n,) and inputs u (m,) of a network of tanks, with an
    inflow (n,) [cm^3/s] that no pump brings.
    """

    def __init__(self, plant: Any, inflow: Any = None):
        self.inflow = inflow
        self.knee, self.area = plant.knee, np.asarray(plant.area, dtype=float)
        w = np.sqrt(2.0 * float(plant.gravity))
        ends = lambda pairs: np.array(pairs, dtype=int).reshape(-1, 2).T
        (source, sink), (self.one, self.other) = ends(plant.links), ends(plant.pipes)
        n, self.pipe = plant.tanks, w * np.asarray(plant.pipe, dtype=float)
        drain, orifice = (w * np.asarray(v, dtype=float) for v in (plant.drain, plant.orifice))
        tanks, pipes = np.arange(n), np.arange(len(self.one))
        # what a unit of each root, pipe flow and input adds to the volume of each tank
        self.roots = _matrix(n, n, (tanks, tanks, -drain), (source, source, -orifice))
        self.roots = self.roots + _matrix(n, n, (sink, source, orifice))
        out, into = (self.one, pipes, -self.pipe), (self.other, pipes, self.pipe)
        self.flows = _matrix(n, len(pipes), out, into)
        unit = np.ones(len(pipes))
        self.apart = _matrix(len(pipes), n, (pipes, self.one, unit), (pipes, self.other, -unit))
        first = np.array([a for a, _ in plant.feeds])
        two = np.array([b is not None for _, b in plant.feeds])
        second = np.array([a if b is None else b for a, b in plant.feeds])
        gain, share = np.asarray(plant.pump_gain), np.where(two, np.asarray(plant.split), 1.0)
        pumps = np.arange(len(first))
        self.pumps = _matrix(
            n, len(first), (first, pumps, gain * share), (second, pumps, gain * (1.0 - share))
        )

    def rates(self, x: Any, u: Any) -> Any:
        """Return (n,) rates of the levels [cm/s]."""
        q, s = (np.asarray(v) for v in self._roots(x)[0])
        flow = self.roots @ q + self.flows @ s + self.pumps @ u
        return (flow if self.inflow is None else flow + self.inflow) / self.area

    def slopes(self, x: Any) -> tuple[Any, Any]:
        """Return their sparse derivatives by the levels (n, n) and by the inputs (n, m)."""
        diagonal = scipy.sparse.diags_array
        dq, ds = (diagonal(np.asarray(v)) for v in self._roots(x)[1])
        per_area = diagonal(1.0 / self.area)
        return per_area @ (self.roots @ dq + self.flows @ ds @ self.apart), per_area @ self.pumps

    def _roots(self, x: Any) -> Any:
        """((roots of the levels, roots of their differences), the slopes of both)."""
        h = (x, x[self.one] - x[self.other])

        def both(level: Any, apart: Any) -> Any:
            return smooth_sqrt(level, self.knee), smooth_signed_sqrt(apart, self.knee)

        with jax.enable_x64(True):
            return jax.jvp(both, h, tuple(np.ones_like(v) for v in h))


def _matrix(rows: int, columns: int, *parts: Any) -> Any:
    """Sparse matrix of (row, column, value) arrays, added up."""
    i, j, v = (np.concatenate([np.asarray(part[k]) for part in parts]) for k in range(3))
    return scipy.sparse.csr_array((v, (i.astype(int), j.astype(int))), shape=(rows, columns))


def balanced(plant: Any, y: Any, enough: float = 1e-14, inflow: Any = None) -> tuple[Any, Any, Any]:
    """Return (levels (n,), inputs (m,), rates (n,) left) where a network with outputs y (m,) and an
    inflow (n,) [cm^3/s] stands still, or as near to it as was found; it ends where no rate is above
    `enough` [cm/s].
    """
    # Levenberg-Marquardt steps in the roots of the unknown levels, so that no level is negative.
    system, outputs = Balance(plant, inflow), np.array(plant.outputs)
    free = np.setdiff1d(np.arange(plant.tanks), outputs)
    scale = float(np.max(y)) or 1.0
    gain = float(np.min(plant.pump_gain)) / float(np.max(plant.area))

    def split(z: Any) -> tuple[Any, Any]:
        x = np.zeros(plant.tanks)
        x[outputs], x[free] = y, scale * z[: len(free)] ** 2
        return x, z[len(free) :] / gain

    z = np.concatenate([np.full(len(free), 0.9), np.full(plant.pumps, 1e-3 * scale)])
    left, damping = system.rates(*split(z)), 1e-4
    for _ in range(STEPS):
        if np.max(np.abs(left)) < enough:
            break
        by_x, by_u = system.slopes(split(z)[0])
        by_z = by_x[:, free] @ scipy.sparse.diags_array(2.0 * scale * z[: len(free)])
        jacobian = scipy.sparse.hstack([by_z, by_u / gain], format="csc")
        normal, slope = jacobian.T @ jacobian, jacobian.T @ left
        diagonal = normal.diagonal()
        weights = scipy.sparse.diags_array(np.maximum(diagonal, 1e-12 * diagonal.max()))
        while damping < 1e12:
            step = scipy.sparse.linalg.spsolve((normal + damping * weights).tocsc(), slope)
            moved = z - step
            now = system.rates(*split(moved))
            if np.linalg.norm(now) < np.linalg.norm(left):
                z, left, damping = moved, now, max(1e-16, 0.1 * damping)
                break
            damping *= 10.0
        else:
            break
    return (*split(z), left)


def responses(plant, xp, inflow=None):
    """(n, outputs) efflux speeds and (m, outputs) inputs by the speeds of the controlled tanks, of
    a network of many tanks without pipes, by matrices that are filled and not added up. With an
    inflow (n,) [cm^3/s] a last column: what it does alone.
    """
    n, m, outputs = plant.tanks, plant.pumps, np.array(plant.outputs)
    free = np.setdiff1d(np.arange(n), outputs)
    source, sink = np.array(plant.links, dtype=int).reshape(-1, 2).T
    first = np.array([a for a, _ in plant.feeds])
    second = np.array([a if b is None else b for a, b in plant.feeds])
    alone, pump = np.array([b is None for _, b in plant.feeds]), np.arange(m)
    orifice, gain = xp.asarray(plant.orifice), xp.asarray(plant.pump_gain)
    share = xp.where(alone, 1.0, xp.asarray(plant.split))
    efflux = _filled(xp, -xp.diag(xp.asarray(plant.drain)), (source, source), -orifice)
    efflux = _filled(xp, efflux, (sink, source), orifice)
    pumps = _filled(xp, xp.zeros((n, m)), (first, pump), gain * share)
    pumps = _filled(xp, pumps, (second, pump), gain * (1.0 - share))
    columns = xp.concatenate([efflux[:, free], pumps], axis=1)
    right, still = -efflux[:, outputs], xp.eye(m)
    if inflow is not None:
        right = xp.concatenate([right, -xp.asarray(inflow)[:, None]], axis=1)
        still = xp.concatenate([still, xp.zeros((m, 1))], axis=1)
    solution = xp.linalg.solve(columns, right)
    order = np.argsort(np.concatenate([outputs, free]))
    speeds = xp.concatenate([still, solution[: len(free)]])[order]
    return speeds, solution[len(free) :]


def _filled(xp, matrix, places, values):
    """`matrix` with values added at places, some of which may be the same."""
    if xp is jnp:
        return matrix.at[places].add(values)
    matrix = np.array(matrix)
    np.add.at(matrix, places, values)
    return matrix

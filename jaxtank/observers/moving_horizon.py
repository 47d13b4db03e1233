"""Moving-horizon estimation: the levels of a window of samples by a programme with their limits."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxtank.analysis.active_set import SPAN, solve_soft
from jaxtank.analysis.condensing import condensed, slopes_along
from jaxtank.analysis.elimination import times, weighted_squares
from jaxtank.core.errors import InputError
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import POSITIVE, component, leaf, static
from jaxtank.observers.extended_kalman import Belief, ExtendedKalman, columns_of
from jaxtank.plants.base import Plant
from jaxtank.xla.barrier import materialised


class Window(NamedTuple):
    """State of the estimator: S samples of the past, N numbers each as in `Belief`."""

    arrival: Belief  # what is known of the first one without the window
    y: Any  # (S, measured) readings [cm]
    u: Any  # (S - 1, m) inputs between them [V]
    x: Any  # (S, N) the estimate of them all, from which the next programme starts
    filtered: Any  # (S, N) the estimate of each while it was the last one
    live: Any  # (S,) 0 for places before the first sample of the run, else 1


@component
class MovingHorizon(ExtendedKalman):
    """Moving-horizon estimator (Rao, Rawlings, Mayne 2003): the levels of the last `samples`
    samples together, within 0 and `limit`,

        min  |x_0 - a|^2_(P^-1) + sum_j |w_j|^2_((Q dt)^-1) + sum_j |y_j - C x_j|^2_(R^-1),
        x_(j+1) = Phi(x_j, u_j) + w_j,   0 <= x_j <= limit

    with Phi, Q, R, `disturbed` and `coefficients` as in `ExtendedKalman`, and the limits for the
    levels alone. What is known of x_0 from before the window, a and P, is predicted by the extended
    filter's recursion from the estimate of the sample before. In each sample Phi is linearised
    along the last estimate, moved on, and the quadratic programme for the change is solved,
    `iterations` times (Kuehl et al. 2011). On a linear model it is the Kalman filter, until a limit
    binds: a filter may then estimate a tank below its bottom. x [cm], P [cm^2].

    Examples
    --------
    >>> from jaxtank.plants.rigs import johansson
    >>> observer = MovingHorizon(
    ...     model=johansson("minimum")[0],
    ...     process=[0.01] * 4,
    ...     measurement=[0.04] * 4,
    ...     spread=[0.04] * 4,
    ...     measured=(0, 1),
    ...     samples=5,
    ... )
    >>> tick = Tick(t=0.0, r=(12.0, 12.0), dr=(0.0, 0.0), ddr=(0.0, 0.0), dt=0.1)
    >>> estimate, _ = observer.step(observer.init((19.9, 12.0, 2.0, 2.0)), tick, (20.4, 12.0, 0, 0))
    >>> [round(float(h), 6) for h in estimate.x]  # a rim of 20 cm; a filter has 20.15
    [20.0, 12.0, 2.0, 2.0]
    """

    sequential = True  # each run has as many iterations as its own samples need
    limit: np.ndarray = leaf(
        "cm",
        "largest level of each tank; left out: its rim",
        infinite=True,
        **POSITIVE,
        default=lambda values: values["model"].rim,
        shape="tank",
    )
    samples: int = static("-", "number of samples in the window", low=2, high=50, default=10)
    iterations: int = static("-", "quadratic programmes a sample", low=1, high=3, default=1)

    def init(self, x0: tuple) -> Any:
        arrival, zero = super().init(x0), 0.0 * x0[0]
        x = jnp.stack(list(arrival.x)) + jnp.zeros((self.samples, 1))
        y = jnp.full((self.samples, len(self.measured)), zero)
        return Window(
            arrival=arrival,
            y=y,
            u=jnp.full((self.samples - 1, self.model.pumps), zero),
            x=x,
            filtered=x,
            live=jnp.full(self.samples, zero),
        )

    def step(self, state: Any, tick: Tick, y: Sequence) -> tuple[Estimate, Any]:
        new = jnp.stack([y[i] for i in self.measured])
        state = state._replace(y=_next(state.y, new), live=_next(state.live, 1.0 + 0.0 * new[0]))
        for _ in range(self.iterations):
            state = state._replace(x=self._improved(state, tick))
        last = state.x[-1]
        state = state._replace(filtered=_next(state.filtered, last))
        return self._estimate(materialised(tuple(last)), tuple(state.u[-1]), tick), state

    def _improved(self, state, tick):
        """(S, N) the estimate of the window after one quadratic programme."""
        n, measured = self.model.tanks, np.array(self.measured)
        S = self._condensed(state, tick)
        S, x = S[..., :-1], state.x + S[..., -1]
        size, levels = S.shape[2], x[:, :n].reshape(-1)
        weight = (state.live[:, None] / jnp.asarray(self.measurement)[measured]).reshape(-1)
        C, excess = S[:, measured].reshape(-1, size), (x[:, measured] - state.y).reshape(-1)
        H, f = jnp.eye(size) + weighted_squares(C, weight), times(C.T, weight * excess)
        A, limit = S[:, :n].reshape(-1, size), jnp.tile(jnp.asarray(self.limit), self.samples)
        bounded = jnp.isfinite(limit)
        largest = jnp.maximum(jnp.abs(levels), jnp.where(bounded, limit, 0.0)).max()
        far = SPAN * jax.lax.stop_gradient(largest)
        # a level that nothing moves, for it is known exactly, is left where it is
        free = jnp.any(A != 0.0, axis=1)
        low = jnp.where(free, -levels, -far)
        high = jnp.where(free & bounded, jnp.where(bounded, limit, 0.0) - levels, far)
        none = jnp.zeros((0, 0, size)), jnp.zeros((0, 0))
        v, _ = solve_soft(H, f, A, low, high, *none, 0.0, 1.0)
        x = x + times(S, v)
        # a level at its lowest, 0, and not a rounding error below, where outlets have no slope
        within = free.reshape(self.samples, n) & (x[:, :n] < 0.0)
        return jnp.concatenate([jnp.where(within, 0.0, x[:, :n]), x[:, n:]], axis=1)

    def _condensed(self, state, tick):
        """(S, N, S N + 1) derivatives of the states by what moves x_0 and by the noises, all of
        variance 1, and the changes after which the states follow from each other without.
        """
        x, arrival, (samples, size) = state.x, state.arrival, state.x.shape
        t = tick.t + tick.dt * np.arange(1.0 - samples, 0.0)
        known = state.u, jnp.stack([t, state.live[:-1]], axis=1)

        def onward(x, w, u, now):  # places before the first sample have its state
            levels = self._onward(tuple(x), tuple(u), tick._replace(t=now[0]))
            return x + now[1] * (jnp.stack([*levels, *x[self.model.tanks :]]) - x + w)

        still = jnp.zeros_like(x[:-1])
        gaps = jax.vmap(onward)(x[:-1], still, *known) - x[1:]
        gained = jnp.stack(self._gained()) * tick.dt
        deviation = jnp.where(gained > 0.0, jnp.sqrt(jnp.where(gained > 0.0, gained, 1.0)), 0.0)
        noise = np.eye(samples - 1)[:, None, :, None] * jnp.diag(deviation)[:, None]
        noise = noise.reshape(samples - 1, size, -1)
        basis = jnp.concatenate([jnp.zeros((samples - 1, size, size)), noise, gaps[..., None]], 2)
        root = jnp.stack([jnp.stack(column) for column in columns_of(arrival.P)], axis=1)
        none = jnp.zeros((size, noise.shape[2]))
        off = jnp.stack(list(arrival.x)) - x[0]
        first = jnp.concatenate([root, none, off[:, None]], axis=1)
        later = condensed(slopes_along(onward, x[:-1], still, *known), basis, first)
        return jnp.concatenate([first[None], later])

    def predict(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        u = _next(jnp.pad(state.u, ((1, 0), (0, 0))), jnp.stack(list(applied)))
        first, last = tuple(state.filtered[0]), tuple(state.x[-1])
        arrival, then = state.arrival, tick._replace(t=tick.t - (self.samples - 1) * tick.dt)
        P = self._corrected(arrival._replace(x=first), first)[1]
        moved = super().predict(Belief(first, P, arrival.u), then, (), tuple(u[0]))
        moved = jax.tree.map(lambda a, b: jnp.where(state.live[0] > 0.0, a, b), moved, arrival)
        new = [*self._onward(last, applied, tick), *last[self.model.tanks :]]
        return state._replace(arrival=moved, u=u[1:], x=_next(state.x, jnp.stack(new)))

    def settled(self, state: Any, dt: Any, u: Sequence) -> Any:
        inputs = jnp.stack(list(u)) + jnp.zeros_like(state.u)
        return state._replace(
            arrival=self._at_rest(state.arrival, dt, u),
            y=state.x[:, np.array(self.measured)],
            u=inputs,
            live=jnp.ones_like(state.live),
        )

    def check(self, plant: Plant) -> None:
        super().check(plant)
        for name in ("process", "coefficient_walk"):
            value = getattr(self, name)
            if value is not None and not isinstance(value, Tracer) and not np.all(value > 0.0):
                raise InputError(
                    f"observer.{name} = {np.min(value):g}: must be above 0, for the programme of a"
                    " moving horizon weighs noises by their variances"
                )


def _next(rows, row):
    """Rows moved on by one."""
    return jnp.concatenate([rows[1:], row[None]])

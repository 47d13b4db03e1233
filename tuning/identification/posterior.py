"""Draws of the posterior of an identification, by the No-U-Turn sampler of blackjax.

Hoffman and Gelman, J. Mach. Learn. Res. 15 (2014) 1593; R-hat and effective sample size: Gelman et
al., Bayesian Data Analysis (3rd ed., 2013), ch. 11.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.core.tree import with_values
from tuning.identification import simulation
from tuning.identification.confidence import Spread
from tuning.identification.result import Identification

CHAINS, WARM_UP, DRAWS = 4, 300, 500
"""Chains, steps of each that adapt the step size, and its draws."""

LARGEST_RHAT = 1.05
"""R-hat above which the chains have not come to the same distribution [-]."""


class Posterior(NamedTuple):
    """Draws of the parameters of an identification."""

    names: tuple[str, ...]
    values: Any  # (draws, n) in the parameters' units
    rhat: dict[str, float]
    effective: dict[str, float]  # effective sample size

    @property
    def mixed(self) -> bool:
        """Whether all chains have come to the same distribution."""
        return max(self.rhat.values()) <= LARGEST_RHAT


def blackjax() -> Any:
    """Return the library blackjax; raise InputError where it is not installed."""
    try:
        import blackjax

        return blackjax
    except ImportError:
        raise InputError(
            "--posterior hmc: blackjax is not installed: pip install blackjax, or leave it out for"
            " the Laplace approximation"
        ) from None


def with_draws(fit: Identification, seed: int = 0) -> Identification:
    """Return an identification whose covariance is of draws of its posterior, kept in `posterior`.

    The likelihood has the variance of the residuals, widened as the intervals are for correlated
    ones; parameters at a bound stay there.
    """
    library = blackjax()
    if not fit.identifiable:
        raise InputError("--posterior hmc: some parameters are not identifiable from these data")
    est = fit.estimation
    if est.coordinates.inputs:
        raise InputError(
            "--posterior hmc: a cause of the inputs was accepted, which has no exact derivative:"
            " leave --posterior out for the Laplace approximation"
        )
    spread = Spread(est, fit.fit, fit.quality["residual_autocorrelation"])
    density = _density(est, fit, spread)
    draw = jax.jit(lambda keys: jax.vmap(lambda key: _chain(library, density, spread, key))(keys))
    w = np.asarray(draw(jax.random.split(jax.random.key(seed), CHAINS)))
    z = np.array(np.broadcast_to(est.unknowns(fit.fit), (*w.shape[:2], est.size)))
    z[..., spread.estimated] += w @ np.linalg.cholesky(spread.covariance).T
    names = fit.covariance[0]
    values = np.array([[_values(est, point, names) for point in chain] for chain in z])
    rhat, size = (
        getattr(library.diagnostics, name)(jnp.asarray(values))
        for name in ("potential_scale_reduction", "effective_sample_size")
    )
    flat = values.reshape(-1, len(names))
    posterior = Posterior(
        names,
        flat,
        dict(zip(names, map(float, rhat))),
        dict(zip(names, map(float, size))),
    )
    matrix = np.atleast_2d(np.cov(flat.T))
    return dataclasses.replace(fit, covariance=(names, matrix), posterior=posterior)


def _values(est, z, names):
    """The values of the parameters `names` at the unknowns z."""
    values = est.coordinates.values(z[: est.coordinates.size])
    return [values[name] for name in names]


def _chain(library, density, spread, key):
    """Draws (DRAWS, n) of one chain, in standard deviations of the Laplace approximation."""
    first, warm, later = jax.random.split(key, 3)
    start = jax.random.normal(first, (len(spread.estimated),))
    adaptation = library.window_adaptation(library.nuts, density)
    (state, settings), _ = adaptation.run(warm, start, num_steps=WARM_UP)
    step = library.nuts(density, **settings).step

    def move(state, key):
        state, _ = step(key, state)
        return state, state.position

    return jax.lax.scan(move, state, jax.random.split(later, DRAWS))[1]


def _density(est, fit, spread):
    """The logarithm of the posterior at w (n,), standard deviations of its Laplace approximation
    away from the estimates.
    """
    at, shared = jnp.asarray(est.unknowns(fit.fit)), est.coordinates.size
    factor = jnp.asarray(np.linalg.cholesky(spread.covariance))
    low, high = (jnp.asarray(side) for side in est.box)
    data, tanks, scale = est.data, list(est.tanks), jnp.asarray(est.level_scale)
    variance = spread.scale * spread.widened**2
    measured = jnp.where(est.mask, jnp.nan_to_num(data.y), 0.0)

    def density(w):
        z = at.at[spread.estimated].add(factor @ w)
        values = est.coordinates.values(z[:shared])
        rig = with_values(est.rig, values)
        first = jnp.asarray(est.initial)
        if tanks:
            levels = (z[shared:] * scale).reshape(len(est.logs), len(tanks))
            first = first.at[:, jnp.array(tanks)].set(levels)
        y = simulation.play(
            rig, data.dt, data.u, first, channels=data.channels, substeps=est.substeps
        )
        residual = jnp.where(est.mask, (y - measured) / est.noise, 0.0)
        square = jnp.sum(residual**2)
        if est.prior is not None:
            names, mean, root = est.prior
            change = jnp.stack([values[name] for name in names]) - mean
            square += jnp.sum((est.prior_weight * root @ change) ** 2)
        inside = jnp.all((z >= low - 1e-9) & (z <= high + 1e-9))
        return jnp.where(inside, -0.5 * square / variance, -1e12)

    return density

"""Draws of the posterior of an identification, by the No-U-Turn sampler of blackjax.

Hoffman and Gelman, J. Mach. Learn. Res. 15 (2014) 1593; R-hat and effective sample size: Gelman et
al., Bayesian Data Analysis (3rd ed., 2013), ch. 11.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.core.tree import with_values
from tuning.identification import simulation
from tuning.identification.confidence import Spread
from tuning.identification.result import Identification

CHAINS, WARM_UP, DRAWS = 4, 300, 500  # chains; steps that adapt; draws of each

OUTSIDE = -1e12  # logarithm of the density outside the ranges of the parameters
LARGEST_RHAT = 1.05  # r-hat above which the chains have not come to the same distribution [-]


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
            "--posterior hmc: blackjax is not installed (pip install blackjax); without the option:"
            " the Laplace approximation"
        ) from None


def with_draws(fit: Identification, seed: int = 0) -> Identification:
    """Return an identification whose covariance is of draws of its `posterior`."""
    # The likelihood has the variance of the residuals, widened as the intervals are for correlated
    # ones; parameters at a bound stay there.
    if not fit.identifiable:
        raise InputError("--posterior hmc: some parameters are not identifiable from these data")
    est = fit.estimation
    if fit.likelihood.get("kind", "output-error") != "output-error":
        raise InputError(
            "--posterior hmc: draws are of the likelihood of simulated readings: leave --likelihood"
            f" {fit.likelihood['kind']} or --posterior out"
        )
    if est.coordinates.inputs:
        raise InputError(
            "--posterior hmc: a cause of the inputs was accepted, which has no exact derivative:"
            " leave --posterior out for the Laplace approximation"
        )
    spread = Spread(est, fit.fit, fit.quality["residual_autocorrelation"])
    keys = jax.random.split(jax.random.key(seed), CHAINS)
    w = np.asarray(_chains(keys, *_problem(est, fit.fit, spread)))
    z = np.array(np.broadcast_to(est.unknowns(fit.fit), (*w.shape[:2], est.size)))
    z[..., spread.estimated] += w @ np.linalg.cholesky(spread.covariance).T
    names = fit.covariance[0]
    of, shared = est.coordinates, est.coordinates.size
    of_names_at = lambda values: [values[name] for name in names]
    values = np.array([[of_names_at(of.values(p[:shared])) for p in chain] for chain in z])
    flat, diagnostics = values.reshape(-1, len(names)), blackjax().diagnostics
    of_names = lambda function: dict(
        zip(names, map(float, np.ravel(function(jnp.asarray(values)))))
    )
    rhat = of_names(diagnostics.potential_scale_reduction)
    posterior = Posterior(names, flat, rhat, of_names(diagnostics.effective_sample_size))
    parameters = dict(fit.parameters)
    for name, column in zip(names, flat.T):
        interval = np.quantile(column, (0.025, 0.975)).tolist()
        parameters[name] = parameters[name] | {"sd": float(column.std()), "interval95": interval}
    draws = {"covariance": (names, np.atleast_2d(np.cov(flat.T))), "posterior": posterior}
    return dataclasses.replace(fit, parameters=parameters, **draws)


def _problem(est, fit, spread):
    """Arrays of the density, and what a sampler is compiled for: names of the prior, .."""
    names, mean, root = est.prior or ((), np.zeros(0), np.zeros((0, 0)))
    arrays = {
        "rig": est.rig,
        "data": (est.data.dt, est.data.inputs_and_flows(), np.where(est.mask, est.data.y, 0.0)),
        "weights": est.mask / est.noise,
        "moments": None,
        "initial": est.initial,
        "scale": est.level_scale,
        "at": est.unknowns(fit),
        "estimated": spread.estimated,
        "factor": np.linalg.cholesky(spread.covariance),
        "box": est.box,
        "variance": spread.scale * spread.widened**2,
        "prior": (mean, est.prior_weight * root),
    }
    if est.moments is not None:
        whitening = [np.linalg.inv(root) for root in est.moments.roots(est.noise)]
        arrays["moments"] = (np.flatnonzero(est.mask), est.shift, whitening)
    return arrays, (est.coordinates, names, est.tanks, est.data.channels, est.substeps)


@functools.partial(jax.jit, static_argnames="static")
def _chains(keys, arrays, static):
    """Draws (chains, DRAWS, n) in standard deviations of the Laplace approximation."""
    library, (coordinates, prior, tanks, channels, substeps) = blackjax(), static

    def density(w):
        z = arrays["at"].at[arrays["estimated"]].add(arrays["factor"] @ w)
        shared, first = coordinates.size, arrays["initial"]
        dt, u, measured = arrays["data"]
        values = coordinates.values(z[:shared])
        if tanks:
            levels = (z[shared:] * arrays["scale"]).reshape(len(first), len(tanks))
            first = first.at[:, jnp.array(tanks)].set(levels)
        rig = with_values(arrays["rig"], values)
        y = simulation.play(rig, dt, u, first, channels=channels, substeps=substeps)
        residual = (y - measured) * arrays["weights"]
        if arrays["moments"] is not None:  # over the moments of the inputs
            rows, shift, whitening = arrays["moments"]
            parts = jnp.split(
                residual.ravel()[rows] - shift, np.cumsum([*map(len, whitening)])[:-1]
            )
            residual = jnp.concatenate([of_log @ part for of_log, part in zip(whitening, parts)])
        square = jnp.sum(residual**2)
        if prior:
            mean, root = arrays["prior"]
            change = jnp.stack([values[name] for name in prior]) - mean
            square += jnp.sum((root @ change) ** 2)
        (low, high), edge = arrays["box"], 1e-9
        inside = jnp.all((z >= low - edge) & (z <= high + edge))
        return jnp.where(inside, -0.5 * square / arrays["variance"], OUTSIDE)

    def chain(key):
        first, warm, later = jax.random.split(key, 3)
        start = jax.random.normal(first, arrays["estimated"].shape)
        adaptation = library.window_adaptation(library.nuts, density)
        (state, settings), _ = adaptation.run(warm, start, num_steps=WARM_UP)
        step = library.nuts(density, **settings).step

        def move(state, key):
            state, _ = step(key, state)
            return state, state.position

        return jax.lax.scan(move, state, jax.random.split(later, DRAWS))[1]

    return jax.vmap(chain)(keys)

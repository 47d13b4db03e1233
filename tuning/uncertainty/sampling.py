"""Points to draw at, default distributions, the interval of a counted share, checks of arguments.

Imported by every study of `tuning`.
"""

import numpy as np
import scipy  # its parts are imported when they are first used

from jaxtank.core.errors import InputError
from tuning.uncertainty.distributions import Correlated, Uniform

METHODS = ("random", "latin", "sobol")
"""Ways to draw points."""


def check_whole(name, value, low, high=None):
    """Raise InputError unless `value` is a whole number from `low` to `high`.

    Examples
    --------
    >>> check_whole("samples", 0, 1)
    Traceback (most recent call last):
        ...
    jaxtank.core.errors.InputError: samples = 0: must be a whole number of at least 1
    """
    good = isinstance(value, int) and not isinstance(value, bool) and value >= low
    if not good or (high is not None and value > high):
        ends = f"of at least {low}" if high is None else f"from {low} to {high}"
        raise InputError(f"{name} = {value!r}: must be a whole number {ends}")


def clopper_pearson(count, samples, level=0.95):
    """Return [low, high], the exact interval of a probability by Clopper and Pearson.

    Parameters
    ----------
    count, samples : int
        `count` of `samples` independent trials had the event.
    level : float
        Confidence [-].

    Examples
    --------
    >>> [round(end, 4) for end in clopper_pearson(0, 100)]
    [0.0, 0.0362]
    """
    tail, beta = (1.0 - level) / 2, scipy.special.betaincinv  # quantile of the beta distribution
    low = 0.0 if count == 0 else float(beta(count, samples - count + 1, tail))
    high = 1.0 if count == samples else float(beta(count + 1, samples - count, 1.0 - tail))
    return [low, high]


def probabilities(method, dimensions, samples, seed):
    """Return points of the open unit cube.

    Parameters
    ----------
    method : {"random", "latin", "sobol"}
        Of "random" the first N points are the same whatever the number of samples.
    dimensions, samples, seed : int

    Returns
    -------
    (samples, dimensions) array

    Examples
    --------
    >>> probabilities("sobol", 2, 5, seed=0).shape
    (5, 2)
    """
    return Points(method, dimensions, samples, seed).rows(0, samples)


class Points:
    """The rows of `probabilities`, some at a time: the same bits without an array of all of them.

    Latin hypercube points are held all at once: each depends on all others.

    Parameters
    ----------
    method : {"random", "latin", "sobol"}
    dimensions, samples, seed : int

    Raises
    ------
    InputError
        For another method.

    Examples
    --------
    >>> points = Points("random", 2, 1000, seed=0)
    >>> bool(np.all(points.rows(990, 993) == probabilities("random", 2, 1000, 0)[990:993]))
    True
    """

    def __init__(self, method, dimensions, samples, seed):
        if method not in METHODS:
            raise InputError(f"draws = {method!r}: must be random, latin or sobol")
        self.method, self.dimensions, self.samples, self.seed = method, dimensions, samples, seed
        qmc = None if method == "random" else scipy.stats.qmc
        if qmc is not None and method == "latin":
            hypercube = qmc.LatinHypercube(dimensions, rng=np.random.default_rng(seed))
            self.all = hypercube.random(samples)
        elif qmc is not None:
            self.sobol = qmc.Sobol(dimensions, scramble=True, rng=np.random.default_rng(seed))

    def rows(self, start, stop):
        """Return (stop - start, dimensions) points: those of the draws from start to below stop."""
        if self.method == "latin":
            return self.all[start:stop]
        found = self._random(start, stop) if self.method == "random" else self._sobol(start, stop)
        return found.clip(1e-12, 1 - 1e-12)

    def _random(self, start, stop):
        generator = np.random.PCG64(self.seed)  # that of default_rng
        generator.advance(start * self.dimensions)  # one step for each number before
        return np.random.Generator(generator).random((stop - start, self.dimensions))

    def _sobol(self, start, stop):
        """Points of the sequence; from its beginning a power of 2 is drawn, else scipy warns."""
        if start < self.sobol.num_generated:
            self.sobol.reset()
        if start > self.sobol.num_generated:
            self.sobol.fast_forward(start - self.sobol.num_generated)
        if start == 0:
            return self.sobol.random_base2((stop - 1).bit_length())[:stop]
        return self.sobol.random(stop - start)


def spread_of(case, share=None):
    """Return {name: distribution} of what a case calls uncertain.

    Uniform, each entry on its own; what was identified together varies by its covariance.

    Parameters
    ----------
    case : Case
    share : float or None
        One relative half-width for all of it, in place of those of the case [-].

    Raises
    ------
    InputError
        The case names nothing uncertain.

    Examples
    --------
    >>> from jaxtank import presets
    >>> spread_of(presets.find("cascaded/pi"), 0.1)["plant.pump_gain"].relative
    0.1
    """
    if not case.uncertain and case.covariance is None:
        raise InputError(
            f"{case.name} names nothing uncertain: say what varies with --vary NAME=DISTRIBUTION"
            " (as plant.drain=uniform:10%), with a table [uncertain] in the rig file (as"
            ' "plant.drain" = 0.1), or in Python with distributions'
        )
    found = {
        name: Uniform(relative=own if share is None else share)
        for name, own in case.uncertain.items()
    }
    if case.covariance is not None:
        names, matrix = case.covariance
        together = {"identified": Correlated(names=names, covariance=matrix)}
        found |= together if share is None else {name: Uniform(relative=share) for name in names}
    return found

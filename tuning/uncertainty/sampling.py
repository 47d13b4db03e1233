"""Points to draw at, default distributions, the interval of a counted share, checks of arguments.

Imported by every study of `tuning`.
"""

import numpy as np
from scipy import stats

from jaxtank.core.errors import InputError
from tuning.uncertainty.distributions import Correlated, Uniform


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
    tail = (1.0 - level) / 2
    low = 0.0 if count == 0 else float(stats.beta.ppf(tail, count, samples - count + 1))
    high = (
        1.0 if count == samples else float(stats.beta.ppf(1.0 - tail, count + 1, samples - count))
    )
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
    if method == "random":
        return np.random.default_rng(seed).random((samples, dimensions)).clip(1e-12, 1 - 1e-12)
    if method == "latin":
        return stats.qmc.LatinHypercube(dimensions, rng=np.random.default_rng(seed)).random(samples)
    if method == "sobol":
        points = stats.qmc.Sobol(
            dimensions, scramble=True, rng=np.random.default_rng(seed)
        ).random_base2((samples - 1).bit_length())
        return points[:samples].clip(1e-12, 1 - 1e-12)
    raise InputError(f"draws = {method!r}: must be random, latin or sobol")


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

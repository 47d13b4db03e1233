"""Probabilities to draw at, default spreads, and the interval of a counted share."""

import numpy as np
from scipy import stats

from jaxtank.core.errors import InputError
from tuning.uncertainty.distributions import Correlated, Uniform


def clopper_pearson(count, samples, level=0.95):
    """[low, high]: exact interval of a probability of which `count` of `samples` independent trials
    speak.
    """
    tail = (1.0 - level) / 2
    low = 0.0 if count == 0 else float(stats.beta.ppf(tail, count, samples - count + 1))
    high = (
        1.0 if count == samples else float(stats.beta.ppf(1.0 - tail, count + 1, samples - count))
    )
    return [low, high]


def probabilities(method, dimensions, samples, seed):
    """(samples, dimensions) points of the open unit cube: "random" (the first N are the same
    whatever N), "latin" or "sobol".
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
    """{name: distribution}: what the case calls uncertain, uniform, each entry on its own, and what
    was identified together by its covariance; share: one uniform spread for all of it, instead.
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

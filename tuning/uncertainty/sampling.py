"""Points to draw at, default distributions, the interval of a counted share."""

import contextlib
import dataclasses

import numpy as np
import scipy  # its parts are imported when they are first used

from jaxtank.core.errors import InputError
from tuning.uncertainty.distributions import Correlated, Normal, Uniform, stated
from tuning.uncertainty.draws import Draws
from tuning.uncertainty.sobol import Sobol

TAILS = (7.0, 6.0, 5.0, 4.0)  # where a normal distribution of rare events may be cut [sd]
METHODS = ("random", "latin", "sobol")  # ways to draw points


def clopper_pearson(count, samples):
    """Return [low, high], the exact 95 % interval of a probability by Clopper and Pearson."""
    tail, beta = (1.0 - 0.95) / 2, scipy.special.betaincinv  # quantile of the beta distribution
    low = 0.0 if count == 0 else float(beta(count, samples - count + 1, tail))
    high = 1.0 if count == samples else float(beta(count + 1, samples - count, 1.0 - tail))
    return [low, high]


def latin_hypercube(dimensions, samples, seed):
    """Return the points of SciPy's LatinHypercube, whose module takes long to import."""
    rng = np.random.default_rng(seed).spawn(1)[0]
    inside = rng.uniform(size=(samples, dimensions))
    cells = np.tile(np.arange(1, samples + 1), (dimensions, 1))
    for row in cells:
        rng.shuffle(row)
    return (cells.T - inside) / samples


def probabilities(method, dimensions, samples, seed):
    return Points(method, dimensions, samples, seed).rows(0, samples)


class Points:
    """The rows of `probabilities`, some at a time: the same bits, and no array of all of them."""

    def __init__(self, method, dimensions, samples, seed):
        if method not in METHODS:
            raise InputError(f"draws = {method!r}: must be random, latin or sobol")
        self.method, self.dimensions, self.samples, self.seed = method, dimensions, samples, seed
        if method == "latin":
            self.all = latin_hypercube(dimensions, samples, seed)
        elif method == "sobol":
            self.sobol = Sobol(dimensions, seed)

    def rows(self, start, stop):
        """Return the (stop - start, dimensions) points of the draws start to stop - 1."""
        if self.method == "latin":
            return self.all[start:stop]
        if self.method == "random":
            generator = np.random.PCG64(self.seed)  # the generator of default_rng
            generator.advance(start * self.dimensions)  # one step for each number before
            points = np.random.Generator(generator).random((stop - start, self.dimensions))
        else:
            points = self.sobol.rows(start, stop)
        return points.clip(1e-12, 1 - 1e-12)


def varied(case, distributions=None, share=None):
    """Return ({name: distribution}, Draws): as stated, where each varies, or of the case."""
    chosen = spread_of(case, share) if distributions is None else stated(distributions, case.loop)
    space = Draws(case.loop, chosen)
    if distributions is not None or not space.dimensions:
        space.check_effect()
    return chosen, space


def with_tails(case, distributions, space, promise):
    """Return ({name: distribution}, Draws); for a promise normal ones are cut farther out."""
    cut_short = {n: d for n, d in distributions.items() if getattr(d, "cut", None) == Normal.cut}
    for cut in TAILS if cut_short and promise is not None else ():
        longer = {n: dataclasses.replace(d, cut=cut) for n, d in cut_short.items()}
        with contextlib.suppress(InputError):  # a value beyond what is physical
            longer = {**distributions, **longer}
            return longer, Draws(case.loop, longer)
    return distributions, space


def spread_of(case, share=None):
    """Return {name: distribution} of the uncertain parameters of a case."""
    if not case.uncertain and case.covariance is None:
        raise InputError(
            f"{case.name} names nothing uncertain: say what varies with --vary NAME=DISTRIBUTION"
            " (as plant.drain=uniform:10%), with a table [uncertain] in the rig file (as"
            ' "plant.drain" = 0.1), or in Python with distributions'
        )
    width = lambda name: case.uncertain[name] if share is None else share
    spread = {name: Uniform(relative=width(name)) for name in case.uncertain}
    if case.covariance is not None:
        names, matrix = case.covariance
        if share is None:
            return spread | {"identified": Correlated(names=names, covariance=matrix)}
        spread |= {name: Uniform(relative=share) for name in names}
    return spread

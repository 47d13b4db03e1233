"""The map from the unit cube to values of the uncertain parameters of a loop."""

import math

import numpy as np
import scipy  # its parts are imported when they are first used

from jaxtank.core.checks import check_value
from jaxtank.core.errors import InputError
from jaxtank.core.tree import describe, get_value, split_index
from tuning.uncertainty.distributions import Correlated, Discrete


class Draws:
    """The distributions of a case as a map from the unit cube to values of its parameters."""

    # The entries of an array vary each on its own, unless tied; zeros of a relative distribution
    # stay zero and take no dimension.

    def __init__(self, loop, distributions):
        if not distributions:
            raise InputError("nothing is uncertain: name at least one parameter")
        self.parts, self.dimensions, self.labels, self.ends = [], 0, [], {}
        taken = []
        for name, distribution in distributions.items():
            distribution.check(name)
            _check_names(loop, name, distribution, taken)
            if isinstance(distribution, Correlated):
                own = [float(get_value(loop, one)) for one in distribution.names]
                nominal, labels = np.array(own), list(distribution.names)
                self.ends[name] = [_ends(describe(loop, one)) for one in distribution.names]
            else:
                nominal = np.asarray(get_value(loop, name), dtype=float)
                labels = _labels(name, distribution, nominal)
            columns = slice(self.dimensions, self.dimensions + len(labels))
            self.parts.append((name, distribution, nominal, columns))
            self.dimensions += len(labels)
            self.labels += labels
        self._check_ranges(loop, distributions)

    def _check_ranges(self, loop, distributions):
        """Raise InputError where a distribution can leave the range of its parameter."""
        clipped = {
            one for d in distributions.values() if isinstance(d, Correlated) for one in d.names
        }
        for corner in (np.zeros, np.ones):
            for name, value in self.values(corner((1, self.dimensions))).items():
                if name not in clipped:
                    check_value(f"uncertain {name}", value[0], describe(loop, name))
        for name, d in distributions.items():
            if isinstance(d, Discrete):
                values = np.asarray(d.values, dtype=float)
                check_value(f"uncertain {name}", values, describe(loop, name))

    def values(self, p):
        """Return {name: (draws, ...)} at probabilities p (draws, dimensions)."""
        found = {}
        for name, distribution, nominal, columns in self.parts:
            mine = p[:, columns]
            if isinstance(distribution, Correlated):
                drawn = _together(distribution, nominal, mine).T
                for one, values, ends in zip(distribution.names, drawn, self.ends[name]):
                    found[one] = np.clip(values, *ends)
                continue
            if nominal.ndim == 0 or distribution.tied:
                shaped = mine.reshape(-1, *([1] * nominal.ndim)) + np.zeros(nominal.shape)
            else:
                shaped = np.full((len(p), *nominal.shape), 0.5)
                shaped[:, _moves(distribution, nominal)] = mine
            found[name] = distribution.quantile(shaped, nominal)
        return found


def _check_names(loop, name, distribution, taken):
    """Raise InputError where a parameter cannot vary or is in `taken`; add those of this one."""
    names = distribution.names if isinstance(distribution, Correlated) else (name,)
    for one in map(_spelled, names):
        base, index = split_index(one)
        whole_after_entry = not index and any(split_index(t)[0] == base for t in taken)
        if one in taken or base in taken or whole_after_entry:
            raise InputError(f"uncertain {one} is given twice")
        if describe(loop, one)["kind"] == "static":
            raise InputError(
                f"uncertain {one}: is part of the compiled program and cannot vary from draw to"
                " draw"
            )
        taken.append(one)


def _labels(name, distribution, nominal):
    """What the probabilities of a distribution move: a parameter, or entries of it."""
    if nominal.ndim == 0 or distribution.tied:
        return [name]
    moved = np.argwhere(_moves(distribution, nominal))
    return [f"{name}[{','.join(map(str, i))}]" for i in moved]


def _together(distribution, nominal, p):
    """(draws, n) values of a Correlated at probabilities p (draws, n), before clipping."""
    tail = scipy.special.ndtr(-distribution.cut)
    mean = nominal if distribution.mean is None else np.asarray(distribution.mean)
    return mean + scipy.special.ndtri(tail + (1.0 - 2.0 * tail) * p) @ distribution.factor().T


def _spelled(name):
    """Return `name` with its index as numbers are written: "a[00]" is "a[0]"."""
    base, index = split_index(name)
    return base + (f"[{','.join(map(str, index))}]" if index else "")


def _ends(meta):
    """(low, high) of a parameter's own range; just above a low end that does not belong to it."""
    low = -math.inf if meta["low"] is None else meta["low"] + (1e-9 if meta["strict"] else 0.0)
    return low, math.inf if meta["high"] is None else meta["high"]


def _moves(distribution, nominal):
    """Which entries a distribution moves: a relative spread leaves zeros alone."""
    relative = (
        getattr(distribution, "relative", None) is not None
        or getattr(distribution, "factor", None) is not None
    )
    return nominal != 0 if relative else np.ones(nominal.shape, dtype=bool)

"""The map from the unit cube to values of the uncertain parameters of a loop."""

import math

import numpy as np

from jaxtank.core.checks import check_value
from jaxtank.core.errors import InputError
from jaxtank.core.tree import describe, get_value, split_index
from tuning.uncertainty.distributions import Correlated, Discrete


class Draws:
    """The distributions of a case as a map from the unit cube to values of its parameters."""

    # Entries vary each on its own unless tied; zeros of a relative spread take no dimension.

    def __init__(self, loop, distributions):
        if not distributions:
            raise InputError("nothing is uncertain: name at least one parameter")
        self.parts, self.dimensions, self.labels, self.ends = [], 0, [], {}
        taken = []
        for name, distribution in distributions.items():
            distribution.check(name)
            _check_names(loop, name, distribution, taken)
            if isinstance(distribution, Correlated):
                labels = list(distribution.names)
                nominal = np.array([float(get_value(loop, label)) for label in labels])
                self.ends[name] = [_ends(describe(loop, label)) for label in labels]
            else:
                nominal = np.asarray(get_value(loop, name), dtype=float)
                labels = _labels(name, distribution, nominal)
            columns = slice(self.dimensions, self.dimensions + len(labels))
            self.parts.append((name, distribution, nominal, columns))
            self.dimensions += len(labels)
            self.labels += labels
        self.corners = [self.values(np.full((1, self.dimensions), p)) for p in (0.0, 1.0)]
        for name, d in distributions.items():
            if isinstance(d, Correlated):  # clipped
                continue
            values = [corner[name][0] for corner in self.corners]
            values += [np.asarray(d.values, dtype=float)] if isinstance(d, Discrete) else []
            for value in values:
                check_value(f"uncertain {name}", value, describe(loop, name))

    def check_effect(self):
        """Raise InputError for a distribution that moves no value."""
        for name, _, nominal, columns in self.parts:
            if columns.start == columns.stop:
                raise InputError(
                    f"uncertain {name}: has no effect: a relative spread leaves 0 as it is, and all"
                    " values are 0; give ends in its unit, as uniform:LOW:HIGH or"
                    " tuning.Uniform(low=LOW, high=HIGH)"
                    if nominal.size
                    else f"uncertain {name}: has no effect: the rig has none"
                )

    def values(self, p):
        """Return {name: (draws, ...)} at probabilities p (draws, dimensions)."""
        values = {}
        for name, distribution, nominal, columns in self.parts:
            part = p[:, columns]
            if isinstance(distribution, Correlated):
                rows = distribution.quantile(part, nominal).T
                for label, column, ends in zip(distribution.names, rows, self.ends[name]):
                    values[label] = np.clip(column, *ends)
                continue
            if part.shape[1] and (nominal.ndim == 0 or distribution.tied):
                shaped = part.reshape(-1, *([1] * nominal.ndim)) + np.zeros(nominal.shape)
            else:
                shaped = np.full((len(p), *nominal.shape), 0.5)
                shaped[:, _moves(distribution, nominal)] = part
            values[name] = distribution.quantile(shaped, nominal)
        return values


def ends_of(loop, distributions):
    """Return {name: (low, high)} of {name: distribution}, none of them Discrete or Empirical."""
    low, high = Draws(loop, distributions).corners
    ends = {name: (low[name][0], high[name][0]) for name in low}
    for d in (d for d in distributions.values() if isinstance(d, Correlated)):
        reach = d.cut * np.sqrt(np.diag(np.asarray(d.covariance, dtype=float)))
        for i, name in enumerate(d.names):
            mean = float(get_value(loop, name)) if d.mean is None else float(d.mean[i])
            ends[name] = (max(mean - reach[i], 0.0), mean + reach[i])
    return ends


def _check_names(loop, name, distribution, taken):
    """Raise InputError if a parameter cannot vary or is in `taken`; add its entries to `taken`."""
    for label in distribution.names if isinstance(distribution, Correlated) else (name,):
        base, index = split_index(label)
        if any(b == base and (not index or not i or i == index) for b, i in taken):
            raise InputError(f"uncertain {label} is given twice")
        if describe(loop, label)["kind"] == "static":
            raise InputError(
                f"uncertain {label}: is part of the compiled program and cannot vary from draw to"
                " draw"
            )
        taken.append((base, index))  # "a[00]" is "a[0]"


def _labels(name, distribution, nominal):
    """Target of a distribution: a parameter, or entries of it."""
    moves = _moves(distribution, nominal)
    labels = [label for i, label in entry_names(name, nominal.shape) if moves[i]]
    return [name] if distribution.tied and labels else labels


def entry_names(name, shape):
    """Return [(index, dotted name)] of the entries of a parameter."""
    label = lambda i: f"{name}[{','.join(map(str, i))}]" if i else name
    return [(i, label(i)) for i in np.ndindex(shape)]


def _ends(meta):
    """(low, high) of a parameter's own range; just above a low end that does not belong to it."""
    low = -math.inf if meta["low"] is None else meta["low"] + (1e-9 if meta["strict"] else 0.0)
    return low, math.inf if meta["high"] is None else meta["high"]


def _moves(distribution, nominal):
    """Which entries a distribution moves: a relative spread leaves zeros alone."""
    fields = (getattr(distribution, name, None) for name in ("relative", "factor"))
    relative = any(value is not None for value in fields)
    return nominal != 0 if relative else np.ones(nominal.shape, dtype=bool)

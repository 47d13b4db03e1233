"""The coefficients that an attack may change, each with its interval."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.core.tree import get_value, split_index
from jaxtank.safety.of_case import FLOWS
from tuning.uncertainty.distributions import Correlated, Discrete, stated
from tuning.uncertainty.draws import Draws
from tuning.uncertainty.sampling import spread_of


class Coefficient(NamedTuple):
    """One number of the loop and its interval, in its own unit."""

    name: str
    nominal: float
    low: float
    high: float
    varies: bool


def coefficients_of(case: Any, distributions: Any = None) -> list[Coefficient]:
    """Return the coefficients of a case that lie in intervals, with their intervals."""
    loop = case.loop
    if distributions is None:
        ends = _ends_of_box(case)
    else:
        ends = _ends_of(loop, stated(distributions))
    found = [c for name, (low, high) in ends.items() for c in _entries(loop, name, low, high)]
    if not found:
        raise InputError(
            f"attack {case.name}: no interval is wider than 0: name what varies, as --spread 0.05"
            " or --vary plant.drain=uniform:5%"
        )
    return found


def _ends_of_box(case):
    """{name: (low, high)} of the filter's box, and of what else the case calls uncertain."""
    guard = case.loop.safety_filter
    if guard is None:
        try:
            guard, _ = case.safety_design()
        except InputError:  # no network of tanks
            return _ends_of(case.loop, spread_of(case))
    least, most = guard.least, guard.most
    names = [f.name for f in dataclasses.fields(least) if f.metadata.get("kind") == "leaf"]
    ends = {f"plant.{name}": (getattr(least, name), getattr(most, name)) for name in names}
    others = {n: s for n, s in case.uncertain.items() if n.split(".")[0] not in NOT_OTHERS}
    return ends | (_ends_of(case.loop, stated(others)) if others else {})


NOT_OTHERS = ("plant", "sensor", "x0")
"""Parts whose uncertainty is in the box of plants, the band of readings and the starts."""


def _ends_of(loop, distributions):
    """{name: (low, high)} of {name: distribution}."""
    for name, distribution in distributions.items():
        if isinstance(distribution, Discrete):
            raise InputError(f"attack: {name} is discrete: must have an interval, as uniform:5%")
    draws = Draws(loop, distributions)
    together = [d for d in distributions.values() if isinstance(d, Correlated)]
    corners = [draws.values(np.full((1, draws.dimensions), p)) for p in (0.0, 1.0)]
    ends = {name: (corners[0][name][0], corners[1][name][0]) for name in corners[0]}
    for d in together:
        reach = d.cut * np.sqrt(np.diag(np.asarray(d.covariance, dtype=float)))
        for i, name in enumerate(d.names):
            mean = float(get_value(loop, name)) if d.mean is None else float(d.mean[i])
            ends[name] = (max(mean - reach[i], 0.0), mean + reach[i])
    return ends


def _entries(loop, name, low, high):
    """The Coefficients of the entries of one parameter whose interval has a width."""
    base, index = split_index(name)
    whole = np.asarray(get_value(loop, base), dtype=float)
    nominal = np.asarray(get_value(loop, name), dtype=float)
    varies = base.removeprefix("plant.") in FLOWS and whole.ndim == 1
    low, high = (np.broadcast_to(np.asarray(v, dtype=float), nominal.shape) for v in (low, high))
    for at in np.ndindex(nominal.shape):
        if high[at] > low[at]:
            entry = f"{base}[{','.join(map(str, index or at))}]" if index or at else base
            yield Coefficient(entry, float(nominal[at]), float(low[at]), float(high[at]), varies)

"""The smallest changes that make the plateaus of a case feasible for 95 % of its plants.

Each is found on one set of draws, for a share above the target (AIM), so that another set confirms
it, and rounded away from the case.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy  # its parts are imported when they are first used

from jaxtank.analysis.steady_batch import SteadyStates
from jaxtank.core.tree import get_value
from tuning.feasible.result import Mend
from tuning.uncertainty.needs import Needs

KINDS = ("setpoints", "rims", "orifices", "pumps", "ramps")

TARGET = 0.95
"""Share of the plants that a mend makes feasible [-]."""

AIM = 0.956
"""Share on the draws that it is found with: nearly two standard deviations of the share of 4,096
others above TARGET [-].
"""

DESIGN = 2
"""Draws that mends are found with, for each one that is counted: less scatter of their own."""

COARSE = 1024
"""Draws with which the direction of a move of setpoints is found; its size is found with all."""

FACTORS = (1.02, 1.05, 1.1, 1.2, 1.35, 1.6, 2.0, 3.0)
"""Factors on the areas of orifices among which the smallest is looked for."""

FAR = 0.4
"""Margin, as a share of a limit, of what a move of setpoints does not look at."""

ROUNDING = 1e-4
"""Margin, as a share of a limit, that a search of setpoints keeps."""

LARGEST = 1e6
"""Excess, as a share of a limit, that stands for no steady state."""


def find_mends(needs: Needs) -> tuple[Mend, ...]:
    """Return the mends of each kind that has one; () where the case needs none."""
    if needs.feasible().mean() >= TARGET:
        return ()
    searches = {"setpoints": _setpoints, "rims": _rims, "orifices": _orifices, "pumps": _pumps}
    return tuple(mend for search in searches.values() if (mend := search(needs)) is not None)


def _least(good: Callable, low: float, high: float, steps: int = 14) -> float:
    """The least number between `low`, which is not good, and `high`, which is."""
    for _ in range(steps):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if good(middle) else (middle, high)
    return high


def _rounded(value: float, old: float, digits: int = 2) -> float:
    """`value` rounded away from `old`, to `digits` digits of the change behind its first."""
    change = abs(value - old)
    if change == 0.0:
        return value
    places = digits - math.floor(math.log10(change))
    scale = 10.0**places
    away = math.ceil if value > old else math.floor
    found = away(round(value * scale, 6)) / scale
    return round(found, max(places, 0))


# setpoints


def _setpoints(needs: Needs) -> Mend | None:
    """The least change of all setpoints, in the sum of its squares."""
    names = list(dict.fromkeys(name for p in needs.plateaus for name in p.names))
    where = np.array([[names.index(name) for name in p.names] for p in needs.plateaus])
    moved = lambda change: needs.setpoints + change[where]
    share = lambda change: needs.feasible(needs.at(moved(change))).mean()
    old = {n: v for p in needs.plateaus for n, v in zip(p.names, p.values)}
    values = np.array([old[name] for name in names])
    found, quantile, coarse = np.zeros(len(names)), AIM, needs.first(COARSE)
    low, high = AIM, 1.0 - (1.0 - AIM) / 8.0
    best = None
    for _ in range(5):  # the quantile of each need at which they hold together
        found = _least_move(coarse, where, values, quantile, found)
        enough = share(found) >= AIM
        best = found if enough else best
        low, high = (low, quantile) if enough else (quantile, high)
        quantile = 0.5 * (low + high)
    if best is None:
        return None
    scale = _least(lambda s: share(s * best) >= AIM, 0.0, 1.0, 10)
    return _rounded_setpoints(names, values, scale * best, share)


def _rounded_setpoints(names, values, change, share):
    """The Mend of a change, rounded away from the case; a little more where rounding lost some."""
    digits = 10.0 ** (math.floor(math.log10(np.max(np.abs(change)))) - 2)
    for more in 1.0 + 0.005 * np.arange(20):
        kept = np.where(np.abs(change) < digits, 0.0, more * change)
        away = np.sign(kept) * np.ceil(np.abs(kept) / digits - 1e-9) * digits
        places = max(0, -round(math.log10(digits)))
        new = {n: round(float(v + c), places) for n, v, c in zip(names, values, away) if c != 0.0}
        exact = np.array([new.get(n, v) for n, v in zip(names, values)]) - values
        if (found := share(exact)) >= AIM:
            pairs = [f"{n} {v:g} -> {new[n]:g}" for n, v in zip(names, values) if n in new]
            return Mend(what="setpoints", set=new, share=float(found), words=", ".join(pairs))
    return None


def _least_move(needs, where, values, quantile, start):
    """(names,) least change for which the quantile of each need is within its limit."""
    size = np.maximum(np.abs(needs.high), np.abs(needs.low))[:, None]
    outputs = where.shape[1]

    def over(change):
        found = needs.excess(needs.at(np.maximum(needs.setpoints + change, 1e-6))) / size
        return np.minimum(found, LARGEST)

    rank = min(needs.count, math.ceil(quantile * needs.count)) - 1
    # what is far from its limit is left out; the share at the end counts all
    near = np.partition(over(0.0), rank, axis=0)[rank] > -FAR

    def needed(change):
        return np.partition(over(change)[:, near], rank, axis=0)[rank]

    def slopes(change):
        h, base = 1e-4 * float(np.max(np.abs(values))), change[where]
        matrix = np.zeros((*near.shape, len(values)))
        for j in range(outputs):
            step = h * np.eye(outputs)[j]
            found = np.zeros(near.shape)
            found[near] = -(needed(base + step) - needed(base - step)) / (2.0 * h)
            for k, name in enumerate(where[:, j]):
                matrix[k, :, name] += found[k]
        return matrix[near]

    return scipy.optimize.minimize(
        lambda change: float(change @ change),
        start,
        jac=lambda change: 2.0 * change,
        method="SLSQP",
        bounds=[(-0.9 * v, None) if v > 0 else (0.0, None) for v in values],
        constraints={"type": "ineq", "fun": lambda c: -needed(c[where]) - ROUNDING, "jac": slopes},
        options={"maxiter": 40, "ftol": 1e-4},
    ).x


# rims and pumps


def _rims(needs: Needs) -> Mend | None:
    """Rims raised; none where a limit of its own is below."""
    if np.ptp(needs.rim, axis=0).any():
        return None
    tanks = needs.rim.shape[1]
    return _raised(needs, "rims", "plant.rim", 0, np.flatnonzero(needs.at_rim), tanks)


def _pumps(needs: Needs) -> Mend | None:
    """Upper limits of the pumps raised."""
    tanks, whole = needs.rim.shape[1], needs.high.shape[1]
    if np.ptp(needs.high[:, tanks:], axis=0).any():
        return None
    return _raised(needs, "pumps", "actuator.high", tanks, np.arange(tanks, whole), whole)


def _raised(needs, what, leaf, first, columns, end) -> Mend | None:
    """The Mend that raises those of the limits `columns` that are passed; one height for all whose
    limits are the same.
    """
    needed = needs.at()
    most = np.nan_to_num(needed, nan=np.inf).max(axis=1)
    old = needs.high[0]

    def raised(quantile):
        high = needs.high.copy()
        for i in columns:
            new = np.quantile(most[:, i], quantile, method="higher")
            if new > old[i] and np.isfinite(new):
                high[:, i] = new
        return high

    share = lambda high: needs.feasible(needed, high=high).mean()
    if share(raised(1.0)) < AIM:
        return None
    quantile = _least(lambda p: share(raised(p)) >= AIM, 0.5, 1.0)
    high = raised(quantile)[0]
    changed = [int(i) for i in columns if high[i] > old[i]]
    new = {i: _rounded(float(high[i]), float(old[i])) for i in changed}
    if len(changed) > 1 and len({old[i] for i in changed}) == 1:
        bound = max(new.values())
        level = lambda top: np.where(np.isin(np.arange(len(old)), changed), top, needs.high)
        one = _least(lambda top: share(level(top)) >= AIM, float(old[changed[0]]), bound)
        new = dict.fromkeys(changed, _rounded(one, float(old[changed[0]])))
    top = needs.high.copy()
    top[:, changed] = [new[i] for i in changed]
    which = ", ".join(str(i - first + 1) for i in changed)
    unit = needs.case.loop.units[0 if first == 0 else 1]
    heights = ", ".join(dict.fromkeys(f"{v:g}" for v in new.values()))
    noun = ("rim" if what == "rims" else "pump") + "s" * (len(changed) > 1)
    words = f"{noun} of tank{'s' * (len(changed) > 1)} {which} at {heights} {unit}"
    if what == "pumps":
        words = f"{noun} {which} up to {heights} {unit}"
    values = {f"{leaf}[{i - first}]": v for i, v in new.items()}
    return Mend(what=what, set=values, share=float(share(top)), words=words)


# orifices


def _orifices(needs: Needs) -> Mend | None:
    """One factor on the areas of all orifices and pipes between tanks, the one nearest to 1."""
    leaves = [n for n in ("orifice", "pipe") if needs.states.own[n].shape[1]]
    if not leaves:
        return None

    def share(factor):
        own = {n: v * (factor if n in leaves else 1.0) for n, v in needs.states.own.items()}
        states = SteadyStates(needs.states.plant, own, needs.states.inflow)
        needed = np.concatenate(states.at(needs.setpoints), axis=2)
        return needs.feasible(needed).mean()

    good = lambda factor: share(factor) >= AIM
    for before, after in zip((1.0, *FACTORS), FACTORS):
        ways = [way for way in (1.0, -1.0) if good(after**way)]
        if ways:
            found = [_least(lambda f, w=w: good(f**w), before, after, 9) ** w for w in ways]
            return _scaled(needs, leaves, min(found, key=lambda f: abs(math.log(f))), share)
    return None


def _scaled(needs, leaves, factor, share):
    factor = _rounded(factor, 1.0, 2)
    loop: Any = needs.case.loop
    new = {}
    for name in leaves:
        values = np.asarray(get_value(loop, f"plant.{name}"), dtype=float)
        new[f"plant.{name}"] = [float(f"{v * factor:.6g}") for v in values]
    words = f"{' and '.join(f'{n}s' for n in leaves)} x {factor:g}"
    return Mend(what="orifices", set=new, share=float(share(factor)), words=words)

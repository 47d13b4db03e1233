"""How a parameter varies. Each distribution has one method, `quantile`, so that random, Latin
hypercube and Sobol draws all work.
"""

import dataclasses
import math
from collections.abc import Mapping

import numpy as np
import scipy  # its parts are imported when they are first used

from jaxtank.core.checks import check_value
from jaxtank.core.errors import InputError
from jaxtank.core.text import shortened
from jaxtank.core.tree import describe, get_value, is_real, split_index


@dataclasses.dataclass(frozen=True, kw_only=True)
class Uniform:
    """Uniform between low and high, in the parameter's unit; or, with relative, between (1 -
    relative) and (1 + relative) times the parameter's own value. tied: one factor (or value) for
    all entries of an array.
    """

    low: float | None = None
    high: float | None = None
    relative: float | None = None
    tied: bool = False

    def quantile(self, p: np.ndarray, nominal: np.ndarray) -> np.ndarray:
        """Values (draws, ...) at probabilities p (draws, ...), for a parameter that is `nominal`
        (...).
        """
        if self.relative is not None:
            return nominal * (1.0 + self.relative * (2.0 * p - 1.0))
        assert self.low is not None and self.high is not None  # `check`
        return self.low + (self.high - self.low) * p

    def check(self, name: str) -> None:
        """Raise InputError unless the range is one."""
        _one_kind(self, name, ("low", "high"), "relative")
        if self.relative is not None and not self.relative > 0:
            raise InputError(
                f"{name}: uniform of relative width {self.relative:g} must be wider than 0"
            )
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise InputError(
                f"{name}: uniform from {self.low:g} to {self.high:g} must have its low end below"
                " its high one"
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class LogUniform:
    """Uniform in the logarithm: between low and high, or with factor between 1/factor and factor
    times the parameter's own value.
    """

    low: float | None = None
    high: float | None = None
    factor: float | None = None
    tied: bool = False

    def quantile(self, p: np.ndarray, nominal: np.ndarray) -> np.ndarray:
        """Values (draws, ...) at probabilities p (draws, ...), for a parameter that is `nominal`
        (...).
        """
        if self.factor is not None:
            return nominal * self.factor ** (2.0 * p - 1.0)
        assert self.low is not None and self.high is not None  # `check`
        return self.low * (self.high / self.low) ** p

    def check(self, name: str) -> None:
        """Raise InputError unless the range is one, above 0."""
        _one_kind(self, name, ("low", "high"), "factor")
        if self.factor is not None and not self.factor > 1:
            raise InputError(f"{name}: log-uniform factor = {self.factor:g} must be above 1")
        if self.low is not None and self.high is not None and not 0 < self.low < self.high:
            raise InputError(
                f"{name}: log-uniform from {self.low:g} to {self.high:g} must lie above 0, its low"
                " end below its high one"
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Normal:
    """Normal with standard deviation sd (or relative times the parameter's own value) about mean
    (its own value where None), cut off at `cut` standard deviations to either side.
    """

    mean: float | None = None
    sd: float | None = None
    relative: float | None = None
    cut: float = 3.0
    tied: bool = False

    def quantile(self, p: np.ndarray, nominal: np.ndarray) -> np.ndarray:
        """Values (draws, ...) at probabilities p (draws, ...), for a parameter that is `nominal`
        (...).
        """
        tail = scipy.special.ndtr(-self.cut)
        centre = nominal if self.mean is None else self.mean
        spread = self.sd if self.relative is None else self.relative * np.abs(centre)
        return centre + spread * scipy.special.ndtri(tail + (1.0 - 2.0 * tail) * p)

    def check(self, name: str) -> None:
        """Raise InputError unless the width is one."""
        _one_kind(self, name, ("sd",), "relative")
        width = self.sd if self.relative is None else self.relative
        assert width is not None  # `_one_kind`
        if not (width > 0 and self.cut > 0):
            raise InputError(
                f"{name}: normal of width {width:g} cut at {self.cut:g} standard deviations: both"
                " must be above 0"
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Discrete:
    """One of `values`, with `weights` (equal where None)."""

    values: tuple
    weights: tuple | None = None
    tied: bool = False

    def quantile(self, p: np.ndarray, nominal: np.ndarray) -> np.ndarray:
        """Values (draws, ...) at probabilities p (draws, ...)."""
        weights = (
            np.ones(len(self.values))
            if self.weights is None
            else np.asarray(self.weights, dtype=float)
        )
        edges = np.cumsum(weights / weights.sum())[:-1]
        return np.asarray(self.values, dtype=float)[np.searchsorted(edges, p, side="right")]

    def check(self, name: str) -> None:
        """Raise InputError unless there are values, and a weight of at least 0 for each."""
        good = len(self.values) > 0 and all(math.isfinite(v) for v in self.values)
        weights = self.weights or (1.0,) * len(self.values)
        if not good or len(weights) != len(self.values) or min(weights) < 0 or not sum(weights) > 0:
            raise InputError(
                f"{name}: a discrete distribution needs finite values and a weight of at least 0"
                " for each"
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Correlated:
    """Several scalars that vary together: normal with a covariance, as an identification gives it,
    or by its Cholesky factor.

    names: (n,) dotted names of scalars or entries; covariance: (n, n) in their units; cut: as in
    Normal, of each independent part. What would leave the range that a parameter allows is held at
    its end. Its key in a dict of distributions is free to choose.
    """

    names: tuple
    covariance: tuple
    mean: tuple | None = None
    cut: float = 3.0

    def factor(self) -> np.ndarray:
        """(n, n) lower Cholesky factor."""
        return np.linalg.cholesky(np.asarray(self.covariance, dtype=float))

    def check(self, name: str) -> None:
        """Raise InputError unless the covariance is symmetric and positive definite, one row for
        each name.
        """
        try:
            matrix, n = np.asarray(self.covariance, dtype=float), len(self.names)
        except (TypeError, ValueError):
            raise InputError(f"{name}: covariance must be a matrix of numbers") from None
        if not self.cut > 0:
            raise InputError(f"{name}: cut at {self.cut:g} standard deviations must be above 0")
        if matrix.shape != (n, n) or not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0):
            raise InputError(f"{name}: covariance must be a symmetric {n} by {n} matrix")
        try:
            self.factor()
        except np.linalg.LinAlgError:
            raise InputError(f"{name}: covariance must be positive definite") from None


def _one_kind(distribution, name, absolute, relative):
    given = [getattr(distribution, a) is not None for a in absolute]
    other = getattr(distribution, relative) is not None
    if other == any(given) or any(given) != all(given):
        raise InputError(f"{name}: give either {' and '.join(absolute)}, or {relative}")
    for field in (*absolute, relative):
        value = getattr(distribution, field)
        if value is not None and not (isinstance(value, (int, float)) and math.isfinite(value)):
            raise InputError(f"{name}: {field} = {value!r} must be a finite number")


KINDS = {"uniform": Uniform, "loguniform": LogUniform, "normal": Normal, "discrete": Discrete}


def stated(distributions):
    """{name: distribution} of what a study was given: a bare number is a share, uniform to either
    side, as a case's `uncertain` has it. Raises InputError for what is neither.
    """
    if not isinstance(distributions, Mapping):
        raise InputError(
            f"what varies is a {type(distributions).__name__}: must be {{name: distribution}}, as"
            " tuning.Normal(relative=0.05)"
        )
    found = {}
    for name, given in distributions.items():
        if is_real(given) and np.ndim(given) == 0 and 0 < given < 1:
            given = Uniform(relative=float(given))
        if not isinstance(given, (*KINDS.values(), Correlated)):
            raise InputError(
                f"uncertain {name} = {shortened(given)}: must be a distribution, as"
                " tuning.Normal(relative=0.05), or a share between 0 and 1"
            )
        found[name] = given
    return found


class Draws:
    """The distributions of a case as a map from the unit cube: `dimensions` probabilities in,
    {name: (draws, ...)} out.

    distributions: {dotted name: distribution} (an array's entries vary each on its own, unless
    tied; zeros of a relative spread stay zero and take no dimension). Raises InputError for an
    unknown name, one given twice, and a distribution that can leave the range that its parameter
    allows.
    """

    def __init__(self, loop, distributions):
        if not distributions:
            raise InputError("nothing is uncertain: name at least one parameter")
        self.parts, self.dimensions, self.labels, self.ends = [], 0, [], {}
        taken = []
        for name, distribution in distributions.items():
            distribution.check(name)
            correlated = isinstance(distribution, Correlated)
            for one in map(_spelled, distribution.names if correlated else (name,)):
                base = split_index(one)[0]
                if (
                    one in taken
                    or base in taken
                    or (not split_index(one)[1] and any(split_index(t)[0] == base for t in taken))
                ):
                    raise InputError(f"uncertain {one} is given twice")
                if describe(loop, one)["kind"] == "static":
                    raise InputError(
                        f"uncertain {one}: is part of the compiled program and cannot vary from"
                        " draw to draw"
                    )
                taken.append(one)
            if correlated:
                nominal = np.array([float(get_value(loop, one)) for one in distribution.names])
                count, labels = len(nominal), list(distribution.names)
            else:
                nominal = np.asarray(get_value(loop, name), dtype=float)
                whole = nominal.ndim == 0 or distribution.tied
                count = 1 if whole else int(_moves(distribution, nominal).sum())
                where = [] if whole else np.argwhere(_moves(distribution, nominal))
                labels = [name] if whole else [f"{name}[{','.join(map(str, i))}]" for i in where]
            if correlated:
                self.ends[name] = [_ends(describe(loop, one)) for one in distribution.names]
            self.parts.append(
                (name, distribution, nominal, slice(self.dimensions, self.dimensions + count))
            )
            self.dimensions += count
            self.labels += labels
        # held within their ranges
        together = {
            one for d in distributions.values() if isinstance(d, Correlated) for one in d.names
        }
        for corner in (np.zeros, np.ones):
            for name, value in self.values(corner((1, self.dimensions))).items():
                if name not in together:
                    check_value(f"uncertain {name}", value[0], describe(loop, name))
        for name, d in distributions.items():
            if isinstance(d, Discrete):
                check_value(
                    f"uncertain {name}", np.asarray(d.values, dtype=float), describe(loop, name)
                )

    def values(self, p):
        """{name: (draws, ...)} at probabilities p (draws, dimensions)."""
        found = {}
        for name, distribution, nominal, columns in self.parts:
            mine = p[:, columns]
            if isinstance(distribution, Correlated):
                tail = scipy.special.ndtr(-distribution.cut)
                mean = nominal if distribution.mean is None else np.asarray(distribution.mean)
                drawn = (
                    mean
                    + scipy.special.ndtri(tail + (1.0 - 2.0 * tail) * mine)
                    @ distribution.factor().T
                )
                ends = self.ends[name]
                found.update(
                    {
                        one: np.clip(drawn[:, i], *ends[i])
                        for i, one in enumerate(distribution.names)
                    }
                )
                continue
            if nominal.ndim == 0 or distribution.tied:
                shaped = mine.reshape(-1, *([1] * nominal.ndim)) + np.zeros(nominal.shape)
            else:
                shaped = np.full((len(p), *nominal.shape), 0.5)
                shaped[:, _moves(distribution, nominal)] = mine
            found[name] = distribution.quantile(shaped, nominal)
        return found


def _spelled(name):
    """`name` with its index as numbers are written: "a[00]" is "a[0]"."""
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


def parse(name, text):
    """The distribution of a command line: "uniform:LOW:HIGH", "uniform:5%", "loguniform:LOW:HIGH",
    "loguniform:FACTOR", "normal:5%", "normal:MEAN:SD", "discrete:V1:V2:..."; "tied" at the end
    gives all entries of an array one draw.
    """
    kind, *parts = [p.strip() for p in text.split(":")]
    tied = bool(parts) and parts[-1] == "tied"
    parts = parts[:-1] if tied else parts
    try:
        share = float(parts[0][:-1]) / 100 if len(parts) == 1 and parts[0].endswith("%") else None
        numbers = None if share is not None else [float(p) for p in parts]
    except ValueError:
        kind = ""
    if kind in ("uniform", "normal") and share is not None:
        found = KINDS[kind](relative=share, tied=tied)
    elif kind in ("uniform", "loguniform") and numbers and len(numbers) == 2:
        found = KINDS[kind](low=numbers[0], high=numbers[1], tied=tied)
    elif kind == "loguniform" and numbers and len(numbers) == 1:
        found = LogUniform(factor=numbers[0], tied=tied)
    elif kind == "normal" and numbers and len(numbers) == 2:
        found = Normal(mean=numbers[0], sd=numbers[1], tied=tied)
    elif kind == "discrete" and numbers:
        found = Discrete(values=tuple(numbers), tied=tied)
    else:
        raise InputError(
            f"{name} = {text!r}: must be uniform:LOW:HIGH, uniform:5%, loguniform:LOW:HIGH,"
            " loguniform:FACTOR, normal:5%, normal:MEAN:SD or discrete:V1:V2, with :tied for one"
            " draw of a whole array"
        )
    found.check(name)
    return found

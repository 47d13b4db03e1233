"""Distributions of parameters by their quantile functions; imported by every study of `tuning`."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np
import scipy  # its parts are imported when they are first used
from numpy.typing import ArrayLike

from jaxtank.core.errors import InputError
from jaxtank.core.tables import numbers, read_table
from jaxtank.core.text import one_line, printable, shortened
from jaxtank.core.tree import is_real
from jaxtank.rig.values import dotted_name

# `quantile`: values (draws, ...) at probabilities p, nominal the case's own; `check`: InputError.


@dataclasses.dataclass(frozen=True, kw_only=True)
class Uniform:
    """Uniform between two values, or relative to the parameter's own value.

    Attributes
    ----------
    low, high : float or None
        Ends, in the parameter's unit.
    relative : float or None
        In place of the ends: half-width as a share of the parameter's own value [-].
    tied : bool
        One draw for all entries of an array.

    Examples
    --------
    >>> Uniform(relative=0.1).quantile(np.array([0.0, 0.5]), np.array(2.0)).tolist()
    [1.8, 2.0]
    """

    low: float | None = None
    high: float | None = None
    relative: float | None = None
    tied: bool = False

    def quantile(self, p: np.ndarray, nominal: np.ndarray) -> np.ndarray:
        """Return the values at probabilities p."""
        if self.relative is not None:
            return nominal * (1.0 + self.relative * (2.0 * p - 1.0))
        assert self.low is not None and self.high is not None  # `check`
        return self.low + (self.high - self.low) * p

    def check(self, name: str) -> None:
        """Raise InputError unless the range is one."""
        _check_fields(self, name, ("low", "high"), "relative")
        if self.relative is not None and self.relative <= 0:
            raise InputError(
                f"{name}: uniform of relative width {self.relative:g} must be wider than 0"
            )
        _check_order(self, name, -math.inf)


@dataclasses.dataclass(frozen=True, kw_only=True)
class LogUniform:
    """Uniform in the logarithm between two values, or within a factor of the parameter's own value.

    Attributes
    ----------
    low, high : float or None
        Ends above 0, in the parameter's unit.
    factor : float or None
        In place of the ends: between 1/factor and factor times the own value [-].
    tied : bool
        One draw for all entries of an array.

    Examples
    --------
    >>> LogUniform(factor=2.0).quantile(np.array([0.0, 1.0]), np.array(3.0)).tolist()
    [1.5, 6.0]
    """

    low: float | None = None
    high: float | None = None
    factor: float | None = None
    tied: bool = False

    def quantile(self, p: np.ndarray, nominal: np.ndarray) -> np.ndarray:
        """Return the values at probabilities p."""
        if self.factor is not None:
            return nominal * self.factor ** (2.0 * p - 1.0)
        assert self.low is not None and self.high is not None  # `check`
        return self.low * (self.high / self.low) ** p

    def check(self, name: str) -> None:
        """Raise InputError unless the range is one, above 0."""
        _check_fields(self, name, ("low", "high"), "factor")
        if self.factor is not None and self.factor <= 1:
            raise InputError(f"{name}: log-uniform factor = {self.factor:g} must be above 1")
        _check_order(self, name, 0.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Normal:
    """Normal distribution, truncated to either side.

    Attributes
    ----------
    mean : float or None
        The parameter's own value where None.
    sd, relative : float or None
        Standard deviation in the parameter's unit, or as a share of the mean; one of them.
    cut : float
        Truncated at so many standard deviations [-].
    tied : bool
        One draw for all entries of an array.

    Examples
    --------
    >>> Normal(relative=0.05).quantile(np.array([0.5, 1.0]), np.array(2.0)).round(6).tolist()
    [2.0, 2.3]
    """

    mean: float | None = None
    sd: float | None = None
    relative: float | None = None
    cut: float = 3.0
    tied: bool = False

    def quantile(self, p: np.ndarray, nominal: np.ndarray) -> np.ndarray:
        """Return the values at probabilities p."""
        centre = nominal if self.mean is None else self.mean
        spread = self.sd if self.relative is None else self.relative * np.abs(centre)
        return centre + spread * truncated_normal(p, self.cut)

    def check(self, name: str) -> None:
        """Raise InputError unless the width is one."""
        _check_fields(self, name, ("sd",), "relative")
        width = self.relative or self.sd or 0.0
        if not (width > 0 and self.cut > 0):
            raise InputError(
                f"{name}: normal of width {width:g} cut at {self.cut:g} standard deviations: both"
                " must be above 0"
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Discrete:
    """One of several values.

    Attributes
    ----------
    values : tuple of float
        In the parameter's unit.
    weights : tuple of float or None
        Their probabilities, up to a factor; equal where None.
    tied : bool
        One draw for all entries of an array.

    Examples
    --------
    >>> Discrete(values=(1.0, 2.0)).quantile(np.array([0.2, 0.7]), np.array(1.0)).tolist()
    [1.0, 2.0]
    """

    values: tuple
    weights: tuple | None = None
    tied: bool = False

    def quantile(self, p: np.ndarray, nominal: np.ndarray) -> np.ndarray:
        """Return the values at probabilities p."""
        edges = np.cumsum(self._shares())[:-1]
        return np.asarray(self.values, dtype=float)[np.searchsorted(edges, p, side="right")]

    def places(self) -> np.ndarray:
        """Return a probability at which each value of a weight above 0 is taken."""
        shares = self._shares()
        return (np.cumsum(shares) - 0.5 * shares)[shares > 0]

    def _shares(self):
        weights = np.asarray(self.weights or (1.0,) * len(self.values), dtype=float)
        return weights / weights.sum()

    def check(self, name: str) -> None:
        """Raise InputError unless there are values, and a weight of at least 0 for each."""
        weights = self.weights or (1.0,) * len(self.values)
        finite = len(self.values) > 0 and all(math.isfinite(v) for v in self.values)
        if not finite or len(weights) != len(self.values) or min(weights) < 0 or sum(weights) <= 0:
            raise InputError(
                f"{name}: a discrete distribution needs finite values and a weight of at least 0"
                " for each"
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Correlated:
    """Several scalars with a joint normal distribution, as an identification gives it.

    What would leave the range that a parameter allows is clipped to its end. The key of this
    distribution in a dict of distributions is free to choose.

    Attributes
    ----------
    names : tuple of str
        (n,) dotted names of scalars or entries.
    covariance : tuple
        (n, n) in their units.
    mean : tuple or None
        (n,); their own values where None.
    cut : float
        Each independent part is truncated at so many standard deviations [-].

    Examples
    --------
    >>> pair = Correlated(names=("plant.drain[0]", "x0[1]"), covariance=((4.0, 0.0), (0.0, 1.0)))
    >>> pair.factor().tolist()
    [[2.0, 0.0], [0.0, 1.0]]
    """

    names: tuple
    covariance: tuple
    mean: tuple | None = None
    cut: float = 3.0

    def factor(self) -> np.ndarray:
        """Return the (n, n) lower Cholesky factor of the covariance."""
        return np.linalg.cholesky(np.asarray(self.covariance, dtype=float))

    def quantile(self, p: np.ndarray, nominal: np.ndarray) -> np.ndarray:
        """Return the values (draws, n) at probabilities p (draws, n), before they are clipped."""
        mean = nominal if self.mean is None else np.asarray(self.mean)
        return mean + truncated_normal(p, self.cut) @ self.factor().T

    def check(self, name: str) -> None:
        """Raise InputError unless the covariance is symmetric, positive definite and (n, n)."""
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class Empirical(Correlated):
    """Several scalars that were drawn together, as from a posterior: each plant has one of the
    draws, all of which are as likely. `empirical` makes one.

    Attributes
    ----------
    names : tuple of str
        (n,) dotted names of scalars or entries.
    covariance, mean, cut : as in Correlated
        Of the draws, where a study needs no more.
    draws : tuple
        (N, n) in their units.

    Examples
    --------
    >>> pair = empirical(("x0[0]", "x0[1]"), [[1.0, 5.0], [2.0, 4.0], [3.0, 5.0]])
    >>> pair.quantile(np.array([[0.4, 0.9]]), np.zeros(2)).tolist()
    [[2.0, 4.0]]
    """

    draws: tuple = ()

    def quantile(self, p: np.ndarray, nominal: np.ndarray) -> np.ndarray:
        """Return draws (.., n): the first probability chooses one, the others are not used."""
        rows = (p[:, 0] * len(self.draws)).astype(int)
        return np.asarray(self.draws)[np.minimum(rows, len(self.draws) - 1)]


def empirical(names: Sequence[str], draws: ArrayLike) -> Empirical:
    """Return the distribution of parameters that were drawn together.

    Parameters
    ----------
    names : sequence of str
        Dotted names of scalars or entries.
    draws : (N, n) array
        A row for each draw, in the parameters' units.

    Returns
    -------
    Empirical

    Raises
    ------
    InputError
        For fewer than 3 draws, and numbers that are not finite.

    Examples
    --------
    >>> empirical(("x0[0]",), [[1.0], [2.0], [3.0]]).mean
    (2.0,)
    """
    rows = np.asarray(draws, dtype=float)
    if rows.ndim != 2 or rows.shape[1] != len(names) or len(rows) < 3:
        raise InputError(f"draws of {', '.join(names)}: must be 3 rows or more, a column for each")
    if not np.all(np.isfinite(rows)):
        raise InputError(f"draws of {', '.join(names)}: some are not finite")
    return Empirical(
        names=tuple(names),
        covariance=tuple(map(tuple, np.atleast_2d(np.cov(rows.T)).tolist())),
        mean=tuple(rows.mean(axis=0).tolist()),
        draws=tuple(map(tuple, rows.tolist())),
    )


def read_draws(path: str) -> Empirical:
    """Return the distribution of a CSV file of draws, names of parameters in its first line."""
    table = read_table(path, ".")
    try:
        columns = [numbers(table, i)[0] for i in range(len(table.columns))]
        return empirical([column.header for column in table.columns], np.stack(columns, axis=1))
    except ValueError as error:
        raise InputError(f"draws {printable(path)}: {one_line(error)}") from None


def truncated_normal(p, cut):
    """Return quantiles of the standard normal distribution, truncated at +-cut."""
    tail = scipy.special.ndtr(-cut)
    return scipy.special.ndtri(tail + (1.0 - 2.0 * tail) * p)


def _check_fields(distribution, name, absolute, relative):
    """Raise InputError unless all of `absolute`, or `relative`, are given, as finite numbers."""
    values = {field: getattr(distribution, field) for field in (*absolute, relative)}
    present = [values[field] is not None for field in absolute]
    if any(present) != all(present) or any(present) == (values[relative] is not None):
        raise InputError(f"{name}: give either {' and '.join(absolute)}, or {relative}")
    for field, value in values.items():
        if value is not None and not (
            isinstance(value, int | float | np.integer | np.floating) and math.isfinite(value)
        ):
            raise InputError(f"{name}: {field} = {value!r} must be a finite number")


def _check_order(distribution, name, least):
    low, high = distribution.low, distribution.high
    if low is not None and not least < low < high:
        kind, above = ("log-uniform", "above 0, ") if least == 0.0 else ("uniform", "")
        raise InputError(
            f"{name}: {kind} from {low:g} to {high:g} must have its low end {above}below its high"
            " end"
        )


KINDS = {"uniform": Uniform, "loguniform": LogUniform, "normal": Normal, "discrete": Discrete}


def stated(distributions, loop=None):
    """Return {name: distribution}; a number is the share of a Uniform; loop: of the rig's names."""
    if not isinstance(distributions, Mapping):
        raise InputError(
            f"what varies is a {type(distributions).__name__}: must be {{name: distribution}}, as"
            " tuning.Normal(relative=0.05)"
        )
    checked = {}
    for name, value in distributions.items():
        if is_real(value) and np.ndim(value) == 0 and 0 < value < 1:
            value = Uniform(relative=float(value))
        if not isinstance(value, (*KINDS.values(), Correlated)):
            raise InputError(
                f"uncertain {name} = {shortened(value)}: must be a distribution, as"
                " tuning.Normal(relative=0.05), or a share between 0 and 1"
            )
        if loop is not None and not isinstance(value, Correlated):
            name = dotted_name(loop, name)
        checked[name] = value
    return checked


FORMS = {  # {(kind, count of numbers): their fields}
    ("uniform", 2): ("low", "high"),
    ("loguniform", 2): ("low", "high"),
    ("loguniform", 1): ("factor",),
    ("normal", 2): ("mean", "sd"),
}


def parse(name, text):
    """Return the distribution of a text of the command line."""
    kind, *parts = [p.strip() for p in text.split(":")]
    if kind == "draws" and parts:
        return read_draws(text.split(":", 1)[1].strip())
    tied = bool(parts) and parts[-1] == "tied"
    parts = parts[:-1] if tied else parts
    try:
        if kind in ("uniform", "normal") and len(parts) == 1 and parts[0].endswith("%"):
            fields = {"relative": float(parts[0][:-1]) / 100}
        elif kind == "discrete" and parts:
            fields = {"values": tuple(map(float, parts))}
        else:
            fields = dict(zip(FORMS[kind, len(parts)], map(float, parts)))
    except (ValueError, KeyError):
        raise InputError(
            f"{name} = {text!r}: must be uniform:LOW:HIGH, uniform:5%, loguniform:LOW:HIGH,"
            " loguniform:FACTOR, normal:5%, normal:MEAN:SD or discrete:V1:V2, with :tied for one"
            " draw of a whole array, or draws:FILE"
        ) from None
    distribution = KINDS[kind](**fields, tied=tied)
    distribution.check(name)
    return distribution

"""How `tune` searches, as frozen dataclasses: SQP, TRF, LBFGS, Adam."""

import dataclasses
from typing import ClassVar

import jax
import numpy as np

from jaxtank.core.errors import InputError
from tuning.problem.problem import Problem

PROBLEM = ("free", "objective", "limits", "scenarios", "risk")
"""Keywords of `tune` that a Problem has of its own."""

DEFAULTS = {"starts": 8, "screening": 64, "iterations": 60, "batch": None, "tolerance": None}
"""Defaults of the keywords of `tune` that solver options have too."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Solver:
    """What every method has."""

    method: ClassVar[str]
    starts: int = DEFAULTS["starts"]
    screening: int = DEFAULTS["screening"]
    iterations: int = DEFAULTS["iterations"]

    def __post_init__(self):
        check_options(**self.options())

    def options(self):
        """Return {keyword of `tune`: value}."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return {name: value for name, value in fields.items() if name in DEFAULTS}

    @property
    def name(self):
        """The method, as `tune(case, method=...)` and `--method` have it."""
        return self.method


@dataclasses.dataclass(frozen=True, kw_only=True)
class SQP(Solver):
    """Sequential quadratic programming, which holds limits ("slsqp").

    Parameters
    ----------
    tolerance : change of the objective, as a share of its first value, below which a search has
        converged; None for 1e-8 and a last search to 1e-12.

    Examples
    --------
    >>> SQP(starts=4).options()["starts"]
    4
    """

    method: ClassVar[str] = "slsqp"
    tolerance: float | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class TRF(Solver):
    """Bounded Gauss-Newton trust region on squares, without limits ("trf").

    Parameters
    ----------
    coarse : first with a tenth of the samples ("coarse-trf").

    Examples
    --------
    >>> TRF(coarse=True).name
    'coarse-trf'
    """

    method: ClassVar[str] = "trf"
    coarse: bool = False

    def __post_init__(self):
        super().__post_init__()
        if not isinstance(self.coarse, bool):
            raise InputError(f"coarse = {self.coarse!r}: must be True or False")

    @property
    def name(self):
        return "coarse-trf" if self.coarse else "trf"


@dataclasses.dataclass(frozen=True, kw_only=True)
class LBFGS(Solver):
    """Limited-memory BFGS on an augmented Lagrangian ("lbfgs").

    Examples
    --------
    >>> LBFGS(iterations=20).name
    'lbfgs'
    """

    method: ClassVar[str] = "lbfgs"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Adam(Solver):
    """Adam on an augmented Lagrangian ("adam").

    Parameters
    ----------
    batch : scenarios drawn for each step, None for all.

    Examples
    --------
    >>> Adam(batch=4).options()["batch"]
    4
    """

    method: ClassVar[str] = "adam"
    batch: int | None = None


def check_precision() -> None:
    """Raise InputError where the default numbers of JAX are not of 64 bits."""
    if jax.numpy.result_type(float) != np.float64:
        raise InputError(
            "tune needs float64 (float32 cannot resolve a limit to 1e-3 cm):"
            " jax.config.update('jax_enable_x64', True)"
        )


def check_options(*, tolerance=None, **counts):
    """Raise InputError for a number of searches, points, iterations or runs out of range."""
    for name, value in counts.items():
        low = 0 if name == "validation" else 1
        if name == "batch" and value is None:
            continue
        if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= 100_000:
            raise InputError(f"{name} = {value!r}: must be a whole number from {low} to 100000")
    if tolerance is not None and not (isinstance(tolerance, float) and 0.0 < tolerance < 1.0):
        raise InputError(f"tolerance = {tolerance!r}: must be a number between 0 and 1")


def spelled_out(case, method, options):
    """Return (Case, name of the method, keywords of `tune`) of a Problem or a Solver."""
    options = dict(options)
    if isinstance(case, Problem):
        own = case.given
        for name in PROBLEM:
            if options[name] != ("mean" if name == "risk" else None):
                raise InputError(f"{name}: the Problem has it already, leave it out of tune")
        options |= own | {"seed": options["seed"] or case.seed}
        case = case.case
    if isinstance(method, Solver):
        for name, value in method.options().items():
            kind = type(method).__name__
            if value is not None and options[name] not in (DEFAULTS[name], value):
                raise InputError(f"{name} = {options[name]!r}: {kind} has {name} = {value!r}")
            options[name] = options[name] if value is None else value
        method = method.name
    return case, method, options

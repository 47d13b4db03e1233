"""How `tune` searches, as frozen dataclasses: Options, and SQP, TRF, LBFGS, Adam of one method."""

import dataclasses
from typing import Any, ClassVar

import jax
import numpy as np

from jaxtank.core.checks import check_choice, check_whole
from jaxtank.core.errors import InputError

LARGEST = 100_000  # searches, points, iterations or runs that can be asked for


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """How `tune` searches, by the method that suits the problem ("auto").

    Parameters
    ----------
    starts : local searches at most, until two agree; None for 4 (8 if nominal).
    screening : Sobol points; None for 32 (64 if nominal). Implies the nominal optimum.
    iterations : of each local search; None for 40 (60 if nominal).
    tolerance : change of the objective, as a share of its first value, below which a search under
        limits has converged; None for 1e-8 and a last search to 1e-12. Implies the nominal optimum.
    validation : validation plants; None for 256 (64 if nominal; 0 for none).
    cluster : Dask cluster on which the local searches run side by side, to the same answer:
        "HOST:PORT" of its scheduler, "local:N" for N workers on this machine, or a
        `distributed.Client`.

    Raises
    ------
    InputError : for a number out of range.

    Examples
    --------
    >>> Options(starts=2).method
    'auto'
    """

    method: ClassVar[str] = "auto"
    starts: int | None = None
    screening: int | None = None
    iterations: int | None = None
    tolerance: float | None = None
    validation: int | None = None
    cluster: Any = None

    def __post_init__(self):
        names = ("starts", "screening", "iterations", "validation", "batch")
        numbers = {name: getattr(self, name, None) for name in names}
        check_numbers(**{name: value for name, value in numbers.items() if value is not None})
        low = self.tolerance
        if low is not None and not (isinstance(low, float) and 0.0 < low < 1.0):
            raise InputError(f"tolerance = {low!r}: must be a number between 0 and 1")

    @property
    def name(self) -> str:
        """The method, as `tune(case, method=...)` and `--method` have it."""
        return self.method

    def filled(self, **usual: float) -> Any:
        """Return the options with `usual` numbers where none are given."""
        missing = {n: v for n, v in usual.items() if getattr(self, n) is None}
        return dataclasses.replace(self, **missing)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SQP(Options):
    """Sequential quadratic programming, which holds limits ("slsqp").

    Examples
    --------
    >>> SQP(starts=4).name
    'slsqp'
    """

    method: ClassVar[str] = "slsqp"


@dataclasses.dataclass(frozen=True, kw_only=True)
class TRF(Options):
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
    def name(self) -> str:
        return "coarse-trf" if self.coarse else "trf"


@dataclasses.dataclass(frozen=True, kw_only=True)
class LBFGS(Options):
    """Limited-memory BFGS on an augmented Lagrangian ("lbfgs").

    Examples
    --------
    >>> LBFGS(iterations=20).name
    'lbfgs'
    """

    method: ClassVar[str] = "lbfgs"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Adam(Options):
    """Adam on an augmented Lagrangian ("adam").

    Parameters
    ----------
    batch : scenarios drawn for each step, None for all.

    Examples
    --------
    >>> Adam(batch=4).batch
    4
    """

    method: ClassVar[str] = "adam"
    batch: int | None = None


def options_of(method: str | Options, **changes: Any) -> Options:
    if not isinstance(method, Options):
        check_choice("method", method, METHODS)
        method = METHODS[method]
    return dataclasses.replace(method, **{n: v for n, v in changes.items() if v is not None})


def check_precision() -> None:
    """Raise InputError where the default numbers of JAX are not of 64 bits."""
    if jax.numpy.result_type(float) != np.float64:
        raise InputError(
            "tune needs float64 (float32 cannot resolve a limit to 1e-3 cm):"
            " jax.config.update('jax_enable_x64', True)"
        )


def check_numbers(low: int = 1, **numbers: Any) -> None:
    """Raise InputError for a number of searches, points, iterations or runs out of range."""
    for name, value in numbers.items():
        check_whole(name, value, 0 if name == "validation" else low, LARGEST)


METHODS: dict[str, Options] = {  # options by the name of their method
    "auto": Options(),
    "trf": TRF(),
    "coarse-trf": TRF(coarse=True),
    "slsqp": SQP(),
    "lbfgs": LBFGS(),
    "adam": Adam(),
}

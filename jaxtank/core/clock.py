"""The clock of a run, and its samples: all at once, or chunk by chunk in a long run.

Setpoints and noise are computed before the time loop. A long run computes them for one chunk at a
time, so that memory does not grow. This needs methods whose samples depend on their own time alone;
they are marked `pointwise`. A loop with another method (recorded samples, a controller with
preview) runs in one chunk.
"""

import dataclasses
import math
from typing import Any, NamedTuple, TypeVar, cast

import jax
import jax.numpy as jnp

from jaxtank.core.checks import check_choice, check_whole
from jaxtank.core.errors import InputError

CHUNK = 2**18  # samples
# methods of components that are called before the time loop
METHODS = ("sample", "windows", "since", "prepare", "inputs", "announced")
INTEGRATORS = ("rk4", "midpoint")
LARGEST_RUN = 100_000_000  # samples

F = TypeVar("F")


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True, kw_only=True)
class Clock:
    """Sampling of the controller, and integration of the plant between samples.

    Sample k is at t_k = k dt, with k from 0 to duration/dt rounded to a whole number. A run ends at
    its last sample, (samples - 1) dt.

    Parameters
    ----------
    dt : sampling period of the controller (Ts) [s]
    duration : length of the run [s]
    substeps : integrator steps per sample [-]
    integrator : "rk4" (fourth order) or "midpoint" (second order)

    Examples
    --------
    >>> Clock(dt=0.5, duration=10.0).samples
    21
    """

    dt: float = 0.01
    duration: float = 1200.0
    substeps: int = 1
    integrator: str = "rk4"

    first = 0  # index of the first sample

    @property
    def samples(self) -> int:
        """Number of samples of a run, both ends included [-]."""
        return round(self.duration / self.dt) + 1


class Chunk(NamedTuple):
    """Consecutive samples of a clock, used instead of a Clock; `first` may be traced."""

    first: Any
    samples: int
    dt: float


def indices(clock: Clock | Chunk) -> jax.Array:
    """Return (samples,) indices of the samples."""
    return clock.first + cast(Any, jnp).arange(clock.samples)


def sample_times(clock: Clock | Chunk) -> jax.Array:
    """Return (samples,) times t_k = k dt [s], from the integer k: no drift over long runs."""
    return indices(clock) * clock.dt


def pointwise(method: F) -> F:
    """Mark a method whose sample k depends on t_k and on sample k of its arguments alone."""
    cast(Any, method).pointwise = True
    return method


def is_pointwise(part: Any) -> bool:
    """Return True if a component and its parts can compute their samples chunk by chunk."""
    cls = cast(Any, type(part))
    methods = [getattr(cls, name) for name in METHODS if hasattr(cls, name)]
    values = [getattr(part, field.name) for field in dataclasses.fields(part)]
    return all(hasattr(method, "pointwise") for method in methods) and all(
        map(is_pointwise, filter(dataclasses.is_dataclass, values))
    )


class ClockWarning(UserWarning):
    """A run does not end when it is asked to. The command prints a note instead."""


def clock_warnings(clock: Clock) -> list[str]:
    """Return a sentence where a run of whole samples does not end when it is asked to."""
    end = (clock.samples - 1) * clock.dt
    if abs(end - clock.duration) <= 1e-6 * clock.dt:
        return []
    return [
        f"clock.duration = {clock.duration:.9g} s is no whole number of samples of clock.dt ="
        f" {clock.dt:.9g} s: the run ends at {end:.9g} s"
    ]


def _meta(
    unit: str,
    doc: str,
    low: float | None = None,
    high: float | None = None,
    strict: bool = False,
    choices: tuple[str, ...] | None = None,
) -> dict[str, Any]:
    meta = {"unit": unit, "doc": doc, "low": low, "high": high}
    return {**meta, "strict": strict, "choices": choices}


CLOCK = {  # metadata of each field, as for the fields of a component
    "dt": _meta("s", "sampling period of the controller (Ts)", low=0.0, strict=True),
    "duration": _meta("s", "length of the run", low=0.0, strict=True),
    "substeps": _meta("-", "integrator steps per sample", low=1, high=10),
    "integrator": _meta("-", "integrator, of fourth or second order", choices=INTEGRATORS),
}

CLOCK_UNITS: dict[str, str] = {name: meta["unit"] for name, meta in CLOCK.items()}


def check_clock(clock: Any) -> None:
    """Check that a clock describes a run."""
    check_is_clock(clock)
    _check_duration(clock)
    check_whole("clock.substeps", clock.substeps, 1, 10)
    check_choice("clock.integrator", clock.integrator, INTEGRATORS)


def check_is_clock(clock: Any) -> None:
    """Raise InputError for what is no Clock."""
    if not isinstance(clock, Clock):
        raise InputError(
            f"clock is a {type(clock).__name__}: must be a jaxtank.Clock, such as case.clock (the"
            " arguments are loop, clock, in this order)"
        )


def _check_duration(clock: Clock) -> None:
    """Raise InputError if sampling period and duration give no run, or one that is too long."""
    for name in ("dt", "duration"):
        value = getattr(clock, name)
        real = isinstance(value, int | float) and not isinstance(value, bool)
        if not (real and 0 < value < math.inf):
            raise InputError(f"clock.{name} = {value!r} s: must be a finite number above 0 s")
    if clock.dt > clock.duration:
        raise InputError(
            f"clock.dt = {clock.dt:g} s: must be at most clock.duration = {clock.duration:g} s"
        )
    # compared before rounding: the ratio may be inf, which round() refuses
    if not clock.duration / clock.dt < LARGEST_RUN:
        raise InputError(
            f"clock.duration / clock.dt = {clock.duration / clock.dt:.9g} samples: must be below"
            f" {LARGEST_RUN}"
        )

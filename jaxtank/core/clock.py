"""Long runs piece by piece: what is known of every sample beforehand is then known of one piece at
a time, and memory does not grow.

A piece can be asked for where every sample follows from its time alone. Methods of which that is so
are marked `pointwise`; a run with any other, a recorded table or a law of the user's own that looks
ahead, is made in one piece.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxtank.core.errors import InputError

PIECE = 2**18  # samples
# what is asked before the loop starts
METHODS = ("sample", "windows", "since", "prepare", "inputs")


class Piece(NamedTuple):
    """Some of a clock's samples, in place of the Clock that a signal is asked with: from number
    `first` on, which may be traced.
    """

    first: Any
    samples: int
    dt: float


def indices(clock):
    """(samples,) numbers of the samples of a Clock or a Piece."""
    return clock.first + jnp.arange(clock.samples)


def sample_times(clock):
    """(samples,) times t_k = k dt [s], from the integer k: no drift over long runs."""
    return indices(clock) * clock.dt


def pointwise(method):
    """Mark a method whose sample k depends on t_k and on samples k alone."""
    method.pointwise = True
    return method


def is_pointwise(part: Any) -> bool:
    """Whether what `part` of a loop, or the whole of it, is asked for can be asked piece by piece."""
    asked = [getattr(type(part), name) for name in METHODS if hasattr(type(part), name)]
    inside = [getattr(part, field.name) for field in dataclasses.fields(part)]
    return all(hasattr(method, "pointwise") for method in asked) and all(
        map(is_pointwise, filter(dataclasses.is_dataclass, inside))
    )


INTEGRATORS = ("rk4", "midpoint")


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True, kw_only=True)
class Clock:
    """When the law samples and how the plant is integrated between samples.

    dt: sampling period of the law (Ts) [s]; duration: length of the run [s]; substeps: integrator
        steps per sample [-];
    integrator: "rk4" (fourth order) or "midpoint" (second order). Sample k is at t_k = k dt, k = 0
        .. duration/dt rounded to
    a whole number: a run is made of whole samples, and ends at (samples - 1) dt.
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


CLOCK = {  # what each field is, as metadata of a component's fields
    "dt": {
        "unit": "s",
        "doc": "sampling period of the law (Ts)",
        "low": 0.0,
        "high": None,
        "strict": True,
        "choices": None,
    },
    "duration": {
        "unit": "s",
        "doc": "length of the run",
        "low": 0.0,
        "high": None,
        "strict": True,
        "choices": None,
    },
    "substeps": {
        "unit": "-",
        "doc": "integrator steps per sample",
        "low": 1,
        "high": 10,
        "strict": False,
        "choices": None,
    },
    "integrator": {
        "unit": "-",
        "doc": "fourth order, or second",
        "low": None,
        "high": None,
        "strict": False,
        "choices": INTEGRATORS,
    },
}

CLOCK_UNITS = {name: meta["unit"] for name, meta in CLOCK.items()}

LARGEST_RUN = 100_000_000  # samples


def check_clock(clock: Any) -> None:
    """Raise InputError unless the clock describes a run."""
    if not isinstance(clock, Clock):
        raise InputError(
            f"clock is a {type(clock).__name__}: must be a jaxtank.Clock, as case.clock (first the"
            " loop, then the clock)"
        )
    for name in ("dt", "duration"):
        value = getattr(clock, name)
        if not (
            isinstance(value, (int, float))
            and not isinstance(value, bool)
            and 0 < value < float("inf")
        ):
            raise InputError(f"clock.{name} = {value!r} s: must be a finite number above 0 s")
    if clock.dt > clock.duration:
        raise InputError(
            f"clock.dt = {clock.dt:g} s: must be at most clock.duration = {clock.duration:g} s"
        )
    # before it is rounded: it may be more than any whole number
    if not clock.duration / clock.dt < LARGEST_RUN:
        raise InputError(
            f"clock.duration / clock.dt = {clock.duration / clock.dt:.9g} samples: must be below"
            f" {LARGEST_RUN}"
        )
    if (
        not isinstance(clock.substeps, int)
        or isinstance(clock.substeps, bool)
        or not 1 <= clock.substeps <= 10
    ):
        raise InputError(
            f"clock.substeps = {clock.substeps!r}: must be a whole number from 1 to 10"
        )
    if clock.integrator not in INTEGRATORS:
        raise InputError(
            f"clock.integrator = {clock.integrator!r}: must be one of {', '.join(INTEGRATORS)}"
        )

"""Long runs piece by piece: what is known of every sample beforehand is then known of one piece at a time, and memory does not grow.

A piece can be asked for where every sample follows from its time alone. Methods of which that is so are marked `pointwise`; a run with any
other, a recorded table or a law of the user's own that looks ahead, is made in one piece.
"""

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp

PIECE = 2**18  # samples
METHODS = ("sample", "windows", "since", "prepare", "inputs")  # what is asked before the loop starts


class Piece(NamedTuple):
    """Some of a clock's samples, in place of the Clock that a signal is asked with: from number `first` on, which may be traced."""

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


def is_pointwise(part):
    """Whether what `part` of a loop, or the whole of it, is asked for can be asked piece by piece."""
    asked = [getattr(type(part), name) for name in METHODS if hasattr(type(part), name)]
    inside = [getattr(part, field.name) for field in dataclasses.fields(part)]
    return all(hasattr(method, "pointwise") for method in asked) and all(
        map(is_pointwise, filter(dataclasses.is_dataclass, inside))
    )

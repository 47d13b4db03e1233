"""Errors of input validation: one line that names the thing, its value, its allowed range, and the
nearest valid name.
"""

import difflib
from collections.abc import Iterable
from typing import Any


class InputError(ValueError):
    """Something a user gave cannot be used. The message is one line; the command line ends with
    exit code 2.
    """

    place: Any = None
    """Where in a rig file it is, (section, index, key); None where that is not known."""
    parts: "tuple[InputError, ...]" = ()
    """The problems that it reports, where there are several."""


class EquilibriumError(InputError):
    """No steady state has the outputs asked for. The message names the tank or pump in the way."""


class DataError(InputError):
    """Experiment data cannot be used."""


class NonFiniteError(ArithmeticError):
    """A run produced NaN or infinity. The message gives the time, the tank and the parameters of
    the run.
    """


def nearest(name: str, names: Iterable[str], count: int = 3) -> str:
    """Return the tail of an error message: the `count` names closest to `name`."""
    names = list(names)
    close = (
        difflib.get_close_matches(name, names, n=count, cutoff=0.3)
        or sorted(names, key=lambda other: -difflib.SequenceMatcher(None, name, other).ratio())[
            :count
        ]
    )
    alike = [other for other in names if other.lower() == name.lower()]  # but for capitals
    close = [*alike, *(other for other in close if other not in alike)][:count]
    return f"; nearest: {', '.join(close)}" if close else ""


def unknown(kind: str, name: str, names: Iterable[str]) -> InputError:
    """Return an InputError for an unknown name, with the nearest valid ones."""
    return InputError(f"unknown {kind} {name!r}{nearest(name, names)}")

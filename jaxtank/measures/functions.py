"""Custom measures: functions of other measures and of the trajectory."""

import dataclasses
import inspect
from collections.abc import Callable, Iterable
from typing import Any

from jaxtank.core.checks import check_whole
from jaxtank.core.errors import InputError
from jaxtank.core.text import shortened
from jaxtank.measures.catalogue import MEASURES, Measure


@dataclasses.dataclass(frozen=True)
class RunFunction:
    """Replaces `Measure.read` if the measure is a function of a whole run.

    function : (measures) or (measures, trajectory) -> scalar.  trajectory : True for the second.
    save_every : distance of the rows of the trajectory [samples].
    """

    function: Callable[..., Any]
    trajectory: bool
    save_every: int

    def __call__(self, run: Any, accumulated: Any) -> Any:
        raise TypeError("the value is a function of a whole run: see jaxtank.loop.functions")


def from_function(
    function: Callable[..., Any],
    unit: str = "-",
    *,
    lower: bool = False,
    save_every: int = 1,
    doc: str | None = None,
) -> Measure:
    """Return the Measure that is a function of other measures, and of the trajectory.

    `jaxtank.measures.register` gives it a name. A function of the trajectory needs a second run,
    which keeps it: about twice the time.

    Parameters
    ----------
    function : callable
        f(measures) or f(measures, trajectory), made of functions of `jax.numpy`, that returns one
        number. measures: {name: number, or array with one entry per output, tank or pump}, of which
        only the ones that it reads are computed. trajectory: the result of `jaxtank.simulate`. A
        search runs it at other steps too: use `trajectory.t`, and means rather than sums over rows.
    unit : str
        Of the value; "cm" stands for the rig's unit of length, "V" for the unit of its inputs.
    lower : bool
        True where a limit on it is a lower one.
    save_every : int
        Distance of the rows of the trajectory [samples].
    doc : str, optional
        One line that describes it; by default the first line of the function's docstring.

    Returns
    -------
    Measure

    Raises
    ------
    InputError
        For a function that takes other arguments, and for a number of samples below 1.

    Examples
    --------
    The largest rate at which the input of the first pump changes:

    >>> import jax.numpy as jnp
    >>> import jaxtank
    >>> from jaxtank import presets
    >>> from jaxtank.measures import from_function, register
    >>> def fastest_change(measures, trajectory):
    ...     return jnp.max(jnp.abs(jnp.diff(trajectory.u[:, 0]) / jnp.diff(trajectory.t)))
    >>> _ = register("fastest_change", from_function(fastest_change, "V/s"))
    >>> loop = presets.load("cascaded/pi").loop
    >>> clock = jaxtank.Clock(dt=4.0, duration=40.0)
    >>> value = jaxtank.evaluate(loop, clock, ["fastest_change"])["fastest_change"]
    >>> u = jaxtank.simulate(loop, clock).u[:, 0]
    >>> bool(jnp.isclose(value, jnp.max(jnp.abs(jnp.diff(u))) / 4.0))
    True
    >>> del jaxtank.measures.MEASURES["fastest_change"]  # as it was before this example
    """
    check_whole(f"{name_of(function)}: save_every", save_every, 1)
    if not isinstance(unit, str):
        raise InputError(f"{name_of(function)}: unit = {shortened(unit)}: must be a text")
    read = RunFunction(function, _takes_trajectory(function), save_every)
    words = doc or (inspect.getdoc(function) or "").partition("\n")[0] or "a custom function"
    return Measure(unit, "run", (), read, words, low=None, sense=-1.0 if lower else 1.0)


def functions(names: Iterable[str]) -> dict[str, RunFunction]:
    """Return {name: RunFunction} of the `names` that are functions of a whole run.

    Examples
    --------
    >>> functions(["rms_error"])
    {}
    """
    readers = {name: MEASURES[name].read for name in names}
    return {name: read for name, read in readers.items() if isinstance(read, RunFunction)}


def name_of(function: Any, default: str = "a custom function") -> str:
    """Return the name of a function, `default` where it has none, as a lambda.

    Examples
    --------
    >>> name_of(name_of), name_of(lambda measures: 0.0, "own")
    ('name_of', 'own')
    """
    name = getattr(function, "__name__", "")
    return name if name.isidentifier() else default


def _takes_trajectory(function):
    """Return whether a function takes (measures, trajectory) rather than (measures)."""
    name = name_of(function)
    if not callable(function):
        raise InputError(f"{shortened(function)} is no function: must be f(measures) -> number")
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        raise InputError(f"{name}: its arguments are not known; wrap it in a def") from None
    alone, both = _binds(signature, 1), _binds(signature, 2)
    if not alone and not both:
        raise InputError(
            f"{name}{signature}: must take (measures) or (measures, trajectory), and no other"
            " argument without a default"
        )
    return both and (not alone or list(signature.parameters)[1:2] == ["trajectory"])


def _binds(signature, count):
    """Return whether a function can be called with so many arguments."""
    try:
        signature.bind(*[None] * count)
    except TypeError:
        return False
    return True

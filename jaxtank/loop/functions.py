"""Measures that are a function of a whole run: which other measures they read, and their values."""
# pyright: reportUnknownMemberType=false, reportUnknownLambdaType=false
# pyright: reportUnknownArgumentType=false

from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any, NoReturn

import jax
import jax.numpy as jnp

from jaxtank import measures as ms
from jaxtank.core.checks import NOT_TRACEABLE, TRACEABLE
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError, unknown
from jaxtank.core.text import one_line
from jaxtank.loop.closed_loop import ClosedLoop, zero_of
from jaxtank.loop.saved_rows import simulate_compiled


class Measures(Mapping[str, Any]):
    """The measures of one run as a function of the user's reads them; it keeps what was read."""

    def __init__(self, values: Mapping[str, Any], served: Collection[str]):
        self.values_of_run, self.served = values, served
        self.read: dict[str, None] = {}

    def __getitem__(self, name: str) -> Any:
        if name not in self.served:
            if name in ms.MEASURES and name not in ms.functions([name]):
                raise InputError(f"reads {name}, which has no value on this rig")
            raise unknown("measure", str(name), self.served)
        self.read[name] = None
        return self.values_of_run[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.served)

    def __len__(self) -> int:
        return len(self.served)

    def __contains__(self, name: object) -> bool:
        return name in self.served


def needed_by(loop: ClosedLoop, clock: Clock, names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the measures that `names` and the functions among them need."""
    functions = ms.functions(names)
    read = (m for name, spec in functions.items() for m in _read_by(loop, clock, name, spec))
    return tuple(dict.fromkeys([*(n for n in names if n not in functions), *read]))


_PROGRAMS: dict[Any, str] = {}
"""{(name, structure of the loop, clock): program of the function as it was last compiled}."""


def check_functions(loop: ClosedLoop, clock: Clock, names: tuple[str, ...]) -> None:
    """Raise InputError for a function that jax cannot trace, or whose result is no number."""
    # A function whose program is another than at the last call, because a number that it closes
    # over or a global one has changed, is compiled again: jax would run the first one.
    needed_by(loop, clock, names)
    for name in ms.functions(names):
        where: Any = (name, jax.tree.structure(loop), clock)
        text = program_of(loop, clock, name)
        if _PROGRAMS.setdefault(where, text) != text:
            jax.clear_caches()
            _PROGRAMS.clear()
            _PROGRAMS[where] = text


def values_of(
    loop: ClosedLoop,
    clock: Clock,
    names: tuple[str, ...],
    key: Any,
    measures: Mapping[str, Any],
    checkpoint: bool = False,
) -> dict[str, Any]:
    """Return {name: value} of `names`, measures and functions of them and of the run."""
    functions, served, zero = ms.functions(names), _shapes(loop), zero_of(loop)
    rows: dict[int, Any] = {}
    for spec in functions.values():
        if spec.trajectory and spec.save_every not in rows:
            every = min(spec.save_every, clock.samples)
            rows[spec.save_every] = simulate_compiled(loop, clock, key, every, checkpoint)[0]
    results = {name: measures[name] for name in names if name not in functions}
    for name, spec in functions.items():
        value = _called(name, spec, Measures(measures, served), rows.get(spec.save_every))
        results[name] = jnp.asarray(value, zero.dtype)
    return {name: results[name] for name in names}


def program_of(loop: ClosedLoop, clock: Clock, name: str) -> str:
    """Return the program of a function as text: equal for two functions that do the same."""
    spec, served = ms.functions([name])[name], _shapes(loop)

    def function(values: Any, run: Any) -> Any:
        return _called(name, spec, Measures(values, served), run)

    shapes: Any = {m: served[m] for m in served if m in _read_by(loop, clock, name, spec)}
    lowered: Any = jax.jit(function).lower(shapes, _rows(loop, clock, spec))
    return f"every {spec.save_every}: {lowered.as_text()}"


def _read_by(loop: ClosedLoop, clock: Clock, name: str, spec: ms.RunFunction) -> tuple[str, ...]:
    """Return the measures that a function reads, found by tracing it without a run."""
    served, read = _shapes(loop), dict[str, None]()

    def function(values: Any, run: Any) -> Any:
        measures = Measures(values, served)
        value = _called(name, spec, measures, run)
        read.update(measures.read)
        return value

    try:
        out: Any = jax.eval_shape(function, served, _rows(loop, clock, spec))
    except TypeError as error:  # of jax, for what is no array
        _refuse(name, f"must return one number ({one_line(str(error), 120)})")
    leaves: list[Any] = jax.tree.leaves(out)
    if len(leaves) != 1 or jax.tree.structure(out) != jax.tree.structure(0.0):
        _refuse(name, f"returns a {type(out).__name__}: must return one number")
    if out.shape != ():
        _refuse(name, f"returns an array of shape {out.shape}: must return one number")
    if not (jnp.issubdtype(out.dtype, jnp.floating) or jnp.issubdtype(out.dtype, jnp.integer)):
        _refuse(name, f"returns a number of type {out.dtype}: must be a real number")
    return tuple(read)


def _called(name: str, spec: ms.RunFunction, measures: Measures, run: Any) -> Any:
    """Return the value of a function; InputError, naming it, for whatever it raises."""
    # what jax has compiled takes no Mapping: the function that it was made of does
    function: Callable[..., Any] = spec.function
    if hasattr(function, "lower"):
        function = getattr(function, "__wrapped__", function)
    try:
        return function(measures, run) if spec.trajectory else function(measures)
    except InputError as error:
        _refuse(name, str(error))
    except NOT_TRACEABLE as error:
        _refuse(name, f"{TRACEABLE} ({type(error).__name__})")
    except Exception as error:  # whatever a function of the user's raises
        words = one_line(f"{type(error).__name__}: {error}", 200)
        raise InputError(f"function {name}: {words}") from error


def _refuse(name: str, why: str) -> NoReturn:
    raise InputError(f"function {name}: {why}") from None


def _shapes(loop: ClosedLoop) -> dict[str, Any]:
    """{measure: its shape and type} of the measures that are kept along with a run."""
    dtype: Any = zero_of(loop).dtype
    functions = ms.functions(ms.MEASURES)
    served = [m for m in ms.MEASURES if m not in functions and ms.serves(m, loop)]
    sizes = {m: () if ms.MEASURES[m].per == "run" else (ms.entries(m, loop.plant),) for m in served}
    return {m: jax.ShapeDtypeStruct(shape, dtype) for m, shape in sizes.items()}


def _rows(loop: ClosedLoop, clock: Clock, spec: ms.RunFunction) -> Any:
    """The shapes of the trajectory that a function is given, None where it takes none."""
    if not spec.trajectory:
        return None
    every = min(spec.save_every, clock.samples)
    return jax.eval_shape(lambda loop: simulate_compiled(loop, clock, None, every)[0], loop)

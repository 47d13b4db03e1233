"""`jax.jit` whose programs are kept between processes: a known one is not traced or compiled.

jax's own cache, which `program_cache` sets up, saves the compiler; tracing and lowering a closed
loop takes as long as its run again. An entry is found by everything that a trace depends on
(`signature`): types, shapes and static values of the arguments, the source of this package, jax and
its settings, the processor. A value without exact words, such as a
custom class, is traced in each process.

jax reads an entry by unpickling, and an entry holds native code. `program_cache.prepare` therefore
checks that the folder belongs to the user; the digest of an entry is checked too. An entry holds
its name (the signature) and the processor for which it was compiled.
"""

import contextlib
import dataclasses
import functools
import importlib
import json
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import jax
from jax.core import Tracer

from jaxtank.xla import program_cache
from jaxtank.xla.signatures import OURS, Unknown, context, kind_of, name_of, signature, words_of

ENDING = program_cache.LAZY[0]
"""Suffix of an entry, which is counted and removed like an entry of jax."""

NEVER = 1e9
"""Time to compile from which jax keeps a program, where none is to be kept [s]."""

MOST = 32
"""Programs of one function that a process holds. Each takes 5 to 50 MB and 70 memory maps, of which
Linux gives a process 65,530 and ends one that asks for more.
"""

SIZE = 4
"""Bytes of the length of the JSON text in front of an entry."""


class Kept:
    """A compiled function whose programs are kept between processes where the user keeps any."""

    def __init__(self, function: Callable[..., Any], compiled: Any, static: tuple[str, ...]):
        functools.update_wrapper(self, function)
        self.compiled, self.static = compiled, frozenset(static)
        code = function.__code__
        self.names = code.co_varnames[: code.co_argcount]
        self.programs: dict[Any, Any] = {}
        self.lock = threading.RLock()  # two threads compile no program twice

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Return the result of the function."""
        folder = program_cache.folder
        if folder is None:
            return self._by_jax(*args, **kwargs)
        values = dict(zip(self.names, args)) | kwargs
        static = {n: v for n, v in values.items() if n in self.static}
        moving = {n: v for n, v in values.items() if n not in self.static}
        leaves, tree = jax.tree.flatten(((), moving))
        config: Any = jax.config
        traced = any(isinstance(v, Tracer) for v in leaves)
        # else arguments of one process and device are all there is to a program
        if traced or config.jax_disable_jit or jax.device_count() > 1:
            return self._by_jax(*args, **kwargs)
        kinds = tuple(map(kind_of, leaves))
        key = tree, kinds, tuple(sorted(static.items())), context()
        with self.lock:
            if key in self.programs:
                program = self.programs.pop(key)  # the one used last stands last
            else:
                program = self._program(folder, tree, kinds, static, moving)
                while len(self.programs) >= MOST:
                    del self.programs[next(iter(self.programs))]
            self.programs[key] = program
        return program(**moving) if program else self._by_jax(*args, **kwargs)

    def _by_jax(self, *args: Any, **kwargs: Any) -> Any:
        """Return the result by programs that jax holds, which are dropped where they are many."""
        with self.lock:  # else every thread would compile; the run itself is not waited for
            result = self.compiled(*args, **kwargs)
            if self.compiled._cache_size() > MOST:
                self.compiled.clear_cache()
        return result

    def __getattr__(self, name: str) -> Any:
        return getattr(self.compiled, name)

    def _program(self, folder, tree, kinds, static, moving):
        """The program of these arguments, read or compiled and written; None if it has no name."""
        if None in kinds:
            return None
        try:
            about = {"kinds": repr(kinds), "context": repr(context()), **static}
            words = [self.__module__, self.__qualname__, *words_of(tree), *words_of(about)]
        except Unknown:
            return None
        name = signature(words)
        path = folder / f"{self.__name__}-{name}{ENDING}"
        program = _read(path, tree)
        if program is not None:
            return Tried(program, path, functools.partial(self.compiled, **static))
        lowered = self.compiled.lower(**moving, **static)
        about = _about(lowered)
        return lowered.compile() if about is None else _compile(lowered, about, path)


class Tried:
    """A program that was read, with a mark beside its entry until it has run once."""

    def __init__(self, program: Any, path: Path, traced: Callable[..., Any]):
        self.program, self.path, self.traced, self.ran = program, path, traced, False

    def __call__(self, **moving: Any) -> Any:
        """Return the result of the program."""
        if self.ran:
            return self.program(**moving)
        try:
            results = jax.block_until_ready(self.program(**moving))
        except jax.errors.JaxRuntimeError:
            self.path.unlink(missing_ok=True)
            self.program = self.traced
            results = self.program(**moving)
        self.ran = True
        _mark_of(self.path).unlink(missing_ok=True)
        return results


_HITS: list[str] = []
"""Programs that jax has read from its own cache since this was emptied."""


def _hit(event: str, **about: Any) -> None:
    if event == "/jax/compilation_cache/cache_hits":
        _HITS.append(event)


jax.monitoring.register_event_listener(_hit)


def _mark_of(path: Path) -> Path:
    return path.with_name(f"{path.name}.tried")


def _read(path: Path, tree: Any) -> Any:
    """The program of an entry; None where there is none, or it cannot be used."""
    from jax.experimental.serialize_executable import deserialize_and_load

    try:
        if _mark_of(path).exists():
            path.unlink(missing_ok=True)
            _mark_of(path).unlink(missing_ok=True)
        data = program_cache.read(path)
        size = int.from_bytes(data[:SIZE], "little")
        about = json.loads(data[SIZE : SIZE + size])
        if about["name"] != path.name or about["processor"] != program_cache.processor():
            return None
        program = deserialize_and_load(
            data[SIZE + size :], tree, jax.tree.structure(_tree(about["out"]))
        )
        _mark_of(path).touch()
        return program
    except FileNotFoundError:
        return None
    except Exception:  # of another build of jax, damaged, or a disk that is full: it is compiled
        return None


def _about(lowered: Any) -> dict[str, Any] | None:
    """The header of a stored program; None if the program cannot be stored."""
    if re.search(r"custom_call @\w", lowered.as_text()):  # functions a new process may not have
        return None
    try:
        count = lowered.out_tree.num_leaves
        out = _words(jax.tree.unflatten(lowered.out_tree, range(count)))
    except Unknown:
        return None
    return {"out": out}


def _compile(lowered: Any, about: dict[str, Any], path: Path) -> Any:
    """Compile a program and store it as an entry that replaces the entry of jax."""
    from jax.experimental.serialize_executable import serialize

    # A program that jax has read from its cache cannot be written again (XLA leaves out functions).
    config: Any = jax.config
    least = config.jax_persistent_cache_min_compile_time_secs
    _HITS.clear()
    config.update("jax_persistent_cache_min_compile_time_secs", NEVER)
    try:
        program = lowered.compile()
    finally:
        config.update("jax_persistent_cache_min_compile_time_secs", least)
    if not _HITS:
        about = {**about, "name": path.name, "processor": program_cache.processor()}
        text = json.dumps(about).encode()
        native = b""
        with contextlib.suppress(ValueError, NotImplementedError):  # jax cannot write it
            native = serialize(program)[0]
        if native:
            program_cache.write(path, len(text).to_bytes(SIZE, "little") + text + native)
    return program


def _words(tree: Any) -> Any:
    """A structure of results as JSON: containers, and data classes of this package."""
    if isinstance(tree, dict):
        return ["dict", {name: _words(value) for name, value in tree.items()}]
    if isinstance(tree, str):
        return ["str", tree]
    if dataclasses.is_dataclass(tree):
        fields = {field.name: getattr(tree, field.name) for field in dataclasses.fields(tree)}
        return [name_of(type(tree)), _words(fields)[1]]
    if hasattr(tree, "_fields"):
        return [name_of(type(tree)), [_words(value) for value in tree]]
    if type(tree) in (tuple, list):
        return [type(tree).__name__, [_words(value) for value in tree]]
    if tree is None or isinstance(tree, int):
        return tree
    raise Unknown


def _tree(words: Any) -> Any:
    """The structure of `_words`."""
    if not isinstance(words, list):
        return words
    kind, content = words
    if kind == "str":
        return content
    if isinstance(content, dict):
        fields = {name: _tree(value) for name, value in content.items()}
        return fields if kind == "dict" else _definition(kind)(**fields)
    parts = [_tree(value) for value in content]
    if kind in ("tuple", "list"):
        return tuple(parts) if kind == "tuple" else parts
    return _definition(kind)(*parts)


def _definition(kind: str) -> Any:
    """The class of these words, one of this package."""
    module, name = kind.split(":")
    if module.split(".")[0] not in OURS:
        raise Unknown
    return getattr(importlib.import_module(module), name)


F = TypeVar("F", bound=Callable[..., Any])


UNOPTIMISED = {"xla_backend_optimization_level": 0}
"""Options of XLA with which a program compiles in half the time, and runs 2 to 10 times as long."""


def compiled(*static: str, keep: bool = False, optimised: bool = True) -> Callable[[F], F]:
    """Return `jax.jit` as a decorator."""

    def decorate(function: F) -> F:
        jit: Any = jax.jit
        options = None if optimised else UNOPTIMISED
        jitted = jit(function, static_argnames=static, compiler_options=options)
        return cast(F, Kept(function, jitted, static) if keep else jitted)

    return decorate

"""The key of a compiled program in the cache: equal words mean an equal program.

The words hold types, shapes and static values of the arguments, the source of both packages, the
version of jax and its settings. A value without exact words, such as a user's class, is `Unknown`.
"""

import dataclasses
import enum
import functools
import hashlib
import importlib.metadata
import importlib.util
import itertools
import json
import os
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

OURS = ("jaxtank", "tuning")
"""Packages whose classes and functions are identified by name; the key has their source files."""

IGNORED = ("cache", "log", "dump", "traceback", "debug")
"""Settings of jax with one of these words in their name have no effect on a program."""

CUSTOM_MEASURES: set[str] = set()
"""Names of measures that a user has registered: the name does not determine the function."""


class Unknown(Exception):
    """A value has no exact words: its program is not kept, and is traced in each process."""


def signature(words: list[str]) -> str:
    """Return the digest of `words` and of the words of this process."""
    return hashlib.sha256("\0".join([*_process(), *words]).encode()).hexdigest()


@functools.cache
def _process() -> list[str]:
    """Return words for versions, settings, devices and source files: the same for all programs."""
    config: Any = jax.config
    settings = {n: repr(v) for n, v in config.values.items() if not any(i in n for i in IGNORED)}
    versions = [sys.version, *(importlib.metadata.version(n) for n in ("jax", "jaxlib", "numpy"))]
    flags = [os.environ.get(n, "") for n in ("XLA_FLAGS", "LIBTPU_INIT_ARGS")]
    devices = [f"{d.platform} {d.device_kind} {d.client.platform_version}" for d in jax.devices()]
    return [*versions, *flags, *devices, json.dumps(settings, sort_keys=True), *_source()]


def _source() -> Iterator[str]:
    """Yield path, size and time of each source file of both packages: an edit changes them."""
    for package in OURS:
        spec = importlib.util.find_spec(package)
        for root in (spec.submodule_search_locations or []) if spec else []:
            for path in sorted(Path(root).rglob("*.py")):
                status = path.stat()
                yield f"{path} {status.st_size} {status.st_mtime_ns}"


def context() -> tuple[Any, ...]:
    """Return the settings of jax that may change between two calls."""
    config: Any = jax.config
    return config.jax_enable_x64, config.jax_debug_nans, config.jax_default_matmul_precision


def kind_of(leaf: Any) -> Any:
    """Return shape, dtype, weak_type and committed of an array; None for anything else."""
    if isinstance(leaf, bool | int | float):
        return type(leaf).__name__
    if isinstance(leaf, jax.Array):
        weak = bool(getattr(leaf.aval, "weak_type", False))
        return leaf.shape, leaf.dtype, weak, leaf.committed
    if isinstance(leaf, np.ndarray | np.generic) and leaf.dtype.kind in "biuf":
        return leaf.shape, leaf.dtype, False, False
    return None


def words_of(value: Any) -> list[str]:
    """Return words that are equal only for equal static values; raise Unknown if there are none."""
    scalars = (bool, int, float, str, bytes, type(None))
    if isinstance(value, str) and value in CUSTOM_MEASURES:
        raise Unknown
    if type(value) in scalars or isinstance(value, np.dtype):
        return [f"{type(value).__name__} {value!r}"]
    if isinstance(value, np.generic):
        return [f"{value.dtype} {value.item()!r}"]
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        return [f"{value.dtype} {value.shape}", hashlib.sha256(value.tobytes()).hexdigest()]
    if isinstance(value, jax.tree_util.PyTreeDef):
        return words_of_tree(value)
    return _words_of_structure(value)


def _words_of_structure(value: Any) -> list[str]:
    """The same of names, containers and data classes."""
    if isinstance(value, enum.Enum):
        return [name_of(type(value)), value.name]
    if isinstance(value, type | types.FunctionType):
        return [name_of(value)]
    if isinstance(value, dict):
        items = [word for pair in value.items() for entry in pair for word in words_of(entry)]
        return [f"dict {len(value)}", *items]
    if isinstance(value, tuple | list | frozenset):
        parts = [words_of(v) for v in value]
        parts = sorted(parts) if isinstance(value, frozenset) else parts
        return [f"{name_of(type(value))} {len(parts)}", *itertools.chain(*parts)]
    if dataclasses.is_dataclass(value):
        fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
        return [name_of(type(value)), *words_of(fields)]
    raise Unknown


def words_of_tree(tree: Any) -> list[str]:
    """Return `words_of` for the tree structure of the arguments."""
    node = tree.node_data()
    if node is None:
        return [f"leaf {tree.num_leaves}"]
    kind, static = node
    children = tree.children()
    child_words = [word for child in children for word in words_of_tree(child)]
    return [f"{name_of(kind)} {len(children)}", *words_of(static), *child_words]


def name_of(definition: Any) -> str:
    """Return module and name of a class or function; raise Unknown for a user's definition."""
    module, name = definition.__module__, definition.__qualname__
    if module.split(".")[0] not in (*OURS, "builtins", "jax", "jaxlib") or "<" in name:
        raise Unknown
    return f"{module}:{name}"

"""What a compiled program depends on, written down: equal words mean an equal program.

Types, shapes and static values of the arguments, the source of this package, jax and its settings.
What cannot be written down exactly, as a class of a user's own, is `Unknown`.
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
"""Packages whose classes and functions are known by name, and by the digest of their source."""

IGNORED = ("cache", "log", "dump", "traceback", "debug")
"""Parts of names of settings of jax that no program depends on."""

OWN: set[str] = set()
"""Names of measures of a user's own: what they compute is not known by name."""


class Unknown(Exception):
    """What is not known by name and value: the program is traced."""


def signature(words: list[str]) -> str:
    """Return the digest of a program: of `words` and of all that holds for this process."""
    return hashlib.sha256("\0".join([*_process(), *words]).encode()).hexdigest()


@functools.cache
def _process() -> list[str]:
    """What every program of this process depends on."""
    config: Any = jax.config
    settings = {n: repr(v) for n, v in config.values.items() if not any(i in n for i in IGNORED)}
    versions = [sys.version, *(importlib.metadata.version(n) for n in ("jax", "jaxlib", "numpy"))]
    flags = [os.environ.get(n, "") for n in ("XLA_FLAGS", "LIBTPU_INIT_ARGS")]
    devices = [f"{d.platform} {d.device_kind} {d.client.platform_version}" for d in jax.devices()]
    return [*versions, *flags, *devices, json.dumps(settings, sort_keys=True), *_source()]


def _source() -> Iterator[str]:
    """Names, sizes and times of the files of our packages, which change with every edit."""
    for package in OURS:
        spec = importlib.util.find_spec(package)
        for root in (spec.submodule_search_locations or []) if spec else []:
            for path in sorted(Path(root).rglob("*.py")):
                status = path.stat()
                yield f"{path} {status.st_size} {status.st_mtime_ns}"


def context() -> tuple[Any, ...]:
    """The settings of jax that may differ from one call to the next."""
    config: Any = jax.config
    return config.jax_enable_x64, config.jax_debug_nans, config.jax_default_matmul_precision


def kind_of(leaf: Any) -> Any:
    """Shape, type and weakness of an array or a number; None for anything else."""
    if isinstance(leaf, bool | int | float):
        return type(leaf).__name__
    if isinstance(leaf, jax.Array):
        weak = bool(getattr(leaf.aval, "weak_type", False))
        return leaf.shape, str(leaf.dtype), weak, leaf.committed
    if isinstance(leaf, np.ndarray | np.generic) and leaf.dtype.kind in "biuf":
        return leaf.shape, str(leaf.dtype), False, False
    return None


def words_of(value: Any) -> list[str]:
    """Words that are the same for equal static values alone; Unknown where there are none."""
    plain = (bool, int, float, str, bytes, type(None))
    if isinstance(value, str) and value in OWN:
        raise Unknown
    if type(value) in plain or isinstance(value, np.dtype):
        return [f"{type(value).__name__} {value!r}"]
    if isinstance(value, np.generic):
        return [f"{value.dtype} {value.item()!r}"]
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        return [f"{value.dtype} {value.shape}", hashlib.sha256(value.tobytes()).hexdigest()]
    if isinstance(value, jax.tree_util.PyTreeDef):
        return words_of_tree(value)
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
    """The same of a structure of arguments."""
    node = tree.node_data()
    if node is None:
        return [f"leaf {tree.num_leaves}"]
    kind, static = node
    children = tree.children()
    below = [word for child in children for word in words_of_tree(child)]
    return [f"{name_of(kind)} {len(children)}", *words_of(static), *below]


def name_of(thing: Any) -> str:
    """Module and name of a class or function of ours, of jax or of Python itself."""
    module, name = thing.__module__, thing.__qualname__
    if module.split(".")[0] not in (*OURS, "builtins", "jax", "jaxlib") or "<" in name:
        raise Unknown
    return f"{module}:{name}"

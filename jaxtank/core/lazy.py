"""Imports that wait until they are needed: `jaxtank --help` must not wait for jax."""

import ast
import importlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

HOMES: dict[str, str] = {}
"""{function that draws, writes or explores: its module; class of results: module of its report}.

The two `__init__` fill it, so that a data class has `plot` without importing the module above it.
"""


def home(name: str) -> ModuleType:
    """Return the module of a name of HOMES."""
    return importlib.import_module(HOMES[name])


def call(name: str, *args: Any, **options: Any) -> Any:
    """Call a function of HOMES."""
    return getattr(home(name), name)(*args, **options)


def attach(package: str, file: str) -> tuple[Callable[[str], Any], list[str]]:
    """Return (__getattr__, __all__) of a package whose stub, __init__.pyi, lists its names."""
    stub = Path(file).with_suffix(".pyi").read_text(encoding="utf-8")
    imports = (node for node in ast.parse(stub).body if isinstance(node, ast.ImportFrom))
    table = {alias.name: str(node.module) for node in imports for alias in node.names}

    def get(name: str) -> Any:
        if name not in table:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        if table[name] == package:
            return importlib.import_module(f"{package}.{name}")
        return getattr(importlib.import_module(table[name]), name)

    return get, list(table)

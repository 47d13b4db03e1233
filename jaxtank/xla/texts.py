"""Data that takes seconds to derive from a loop, kept between processes beside its programs."""

import json
from collections.abc import Callable
from typing import Any

from jaxtank.xla import program_cache
from jaxtank.xla.signatures import Unknown, context, signature, words_of


def kept(name: str, parts: Any, derive: Callable[[], Any]) -> Any:
    """Return derive(), a value that JSON has; read where equal `parts` gave it before."""
    # parts: everything that it depends on, but for the sources of the packages
    folder = program_cache.folder
    if folder is None:
        return derive()
    try:
        key = signature([name, *words_of({"context": repr(context()), "parts": parts})])
    except Unknown:  # a custom class
        return derive()
    path = folder / f"{name}-{key}{program_cache.LAZY[1]}"
    try:
        return json.loads(program_cache.read(path))
    except (OSError, ValueError):  # new, or damaged
        value = derive()
    program_cache.write(path, json.dumps(value).encode())
    return value

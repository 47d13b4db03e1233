"""Values as JSON takes them."""

import math
from typing import Any, cast

import numpy as np


def fields(result: Any, names: str) -> dict[str, Any]:
    """Return {key: attribute, as JSON takes it} of words "key" or "key=attribute" in one text."""
    pairs = (word.partition("=") for word in names.split())
    return {key: clean(getattr(result, name or key)) for key, _, name in pairs}


def clean(value: Any) -> Any:
    """Return `value` for JSON: arrays as lists, NaN and infinity as None."""
    if isinstance(value, dict):
        return {k: clean(v) for k, v in cast(dict[Any, Any], value).items()}
    if isinstance(value, (list, tuple)):
        return [clean(v) for v in cast(list[Any], value)]
    if (
        isinstance(value, (np.ndarray, np.generic))
        or hasattr(value, "__jax_array__")
        or type(value).__module__.startswith("jax")
    ):
        return clean(np.asarray(cast(Any, value)).tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value

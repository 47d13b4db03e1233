"""Values as JSON takes them. May import nothing of ours."""

import math
from typing import Any

import numpy as np


def clean(value: Any) -> Any:
    """Return `value` for JSON: arrays as lists, NaN and infinity as None.

    Examples
    --------
    >>> import numpy as np
    >>> clean({"h": np.array([1.0, np.nan])})
    {'h': [1.0, None]}
    """
    if isinstance(value, dict):
        table: dict[Any, Any] = value
        return {k: clean(v) for k, v in table.items()}
    if isinstance(value, (list, tuple)):
        entries: Any = value
        return [clean(v) for v in entries]
    if (
        isinstance(value, (np.ndarray, np.generic))
        or hasattr(value, "__jax_array__")
        or type(value).__module__.startswith("jax")
    ):
        return clean(np.asarray(value).tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value

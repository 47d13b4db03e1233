"""What two runs must share for one to continue the other, as plain JSON; and digests of data.

Imported by every command that keeps a checkpoint: `tune`, `identify`, `ensemble`.
"""

import dataclasses
import hashlib
import json
import os
from typing import Any

import jax
import numpy as np

import jaxtank
from jaxtank.case import Case
from jaxtank.xla.flags import KEY


def digest(*parts: Any) -> str:
    """Return the hexadecimal SHA-256 digest of texts, bytes and arrays, in their order.

    An array counts with its type and shape, so that equal bytes of another shape differ.

    Examples
    --------
    >>> digest("a", [1.0, 2.0]) == digest("a", np.array([1.0, 2.0])) != digest("a", [[1.0, 2.0]])
    True
    """
    found = hashlib.sha256()
    for part in parts:
        if isinstance(part, str):
            part = part.encode()
        if not isinstance(part, bytes):
            array = np.asarray(part)
            part = f"{array.dtype.str}{array.shape}".encode() + array.tobytes()
        found.update(len(part).to_bytes(8, "little") + part)
    return found.hexdigest()


def fingerprint(case: Case, **what: Any) -> dict[str, Any]:
    """Return what two runs must share for one to continue the other, to the same bits.

    Parameters
    ----------
    case : the Case that is run; its loop (structure and values) and its clock count.
    what : everything else that decides a number: options, limits, data as their `digest`.

    Returns
    -------
    {name: text, number, list or dict}, equal after a round trip through JSON.

    Examples
    --------
    >>> from jaxtank import presets
    >>> found = fingerprint(presets.find("cascaded/pi"), seed=0, limits=[("max_level", 30.0)])
    >>> found["case"], found["seed"], found["limits"]
    ('cascaded/pi', 0, [['max_level', 30.0]])
    """
    leaves, structure = jax.tree.flatten(case.loop)
    return {
        "case": case.name,
        "loop": digest(str(structure), *leaves),
        "clock": repr(case.clock),
        **json.loads(json.dumps(what, default=_plain)),
        "jaxtank": jaxtank.__version__,
        "jax": jax.__version__,
        "xla_option": KEY in os.environ.get("XLA_FLAGS", ""),
    }


def _plain(value: Any) -> Any:
    """Return a value that JSON has no form for: arrays and dataclasses as lists, else as text."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return list(vars(value).values())
    if isinstance(value, np.generic | np.ndarray | jax.Array):
        return np.asarray(value).tolist()
    return repr(value)

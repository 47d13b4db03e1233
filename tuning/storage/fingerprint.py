"""Fingerprint of a run as plain JSON: equal for runs that may continue each other; digests."""

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
    """Return the hexadecimal SHA-256 digest of texts, bytes and arrays, in their order."""
    # An array counts with its type and shape, so that equal bytes of another shape differ.
    sha = hashlib.sha256()
    for part in parts:
        if isinstance(part, str):
            part = part.encode()
        if not isinstance(part, bytes):
            array = np.asarray(part)
            part = f"{array.dtype.str}{array.shape}".encode() + array.tobytes()
        sha.update(len(part).to_bytes(8, "little") + part)
    return sha.hexdigest()


def fingerprint(case: Case, **what: Any) -> dict[str, Any]:
    """Return the fingerprint: equal if one run may continue the other to the same bits."""
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

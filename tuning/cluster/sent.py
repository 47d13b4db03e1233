"""A case as text, and the case that a worker makes of it: the same loop to the bit, or an error."""

import functools
import json
from collections.abc import Sequence
from typing import Any

import jax

from jaxtank import measures as ms, rig
from jaxtank.case import Case
from jaxtank.core.errors import InputError
from tuning.storage.fingerprint import fingerprint


def sent(case: Case, names: Sequence[str] = ()) -> str:
    """Return a case as JSON: its rig file, and the fingerprint of its loop, clock and versions."""
    for name in ms.functions(names):
        raise InputError(
            f"cluster: {name} is a custom function, and no code is sent to workers:"
            " omit the cluster, or use measures of the package"
        )
    try:
        text = rig.dump(case)
    except InputError as error:
        raise InputError(
            f"cluster: workers get a case as its rig file, and there is none for {case.name}"
            f" ({error}); a class of a package that the workers have can be named there, by an"
            " entry point jaxtank.components"
        ) from None
    return json.dumps({"rig": text, "fingerprint": _fingerprint(case)})


@functools.lru_cache(maxsize=8)
def received(text: str) -> Case:
    """Return the case of `sent`, made anew; the same object for the same text."""
    message = json.loads(text)
    case = rig.loads(message["rig"], "rig file sent to this worker")
    there, sender = _fingerprint(case), message["fingerprint"]
    differs = [name for name in sender if there.get(name) != sender[name]]
    if "xla_option" in differs:
        raise InputError(
            "cluster: jax had started on this worker before jaxtank, without its compiler options:"
            " start workers with --preload jaxtank, or with the XLA_FLAGS of this command"
        )
    if differs:
        words = [f"{n} ({_short(there.get(n))} there, {_short(sender[n])} here)" for n in differs]
        raise InputError(f"cluster: a worker differs from this process: {', '.join(words)}")
    return case


def _fingerprint(case):
    """Return `fingerprint` with the settings for precision and random numbers on a worker."""
    config: Any = jax.config
    generator = [str(config.jax_default_prng_impl), str(config.jax_threefry_partitionable)]
    return fingerprint(case, x64=bool(config.jax_enable_x64), random=generator)


def _short(value):
    text = str(value)
    return text if len(text) <= 20 else text[:12] + "..."

"""What the shards of an ensemble are of, as JSON in their manifest, so that a folder can
be joined.
"""

import dataclasses
from typing import Any, cast

import numpy as np

from jaxtank import rig
from jaxtank.core.errors import InputError
from tuning.storage import batch_store
from tuning.uncertainty import distributions as ds

KINDS = {c.__name__: c for c in (ds.Uniform, ds.LogUniform, ds.Normal, ds.Discrete, ds.Correlated)}
WORDS = {
    "samples": int,
    "key": int,
    "batch": int,
    "draws": str,
    "measures": list,
    "distributions": dict,
}


def origin_of(case, limits):
    """Return {"rig": text of a rig file, None where no file describes the case, "limits": dict}."""
    try:
        text = rig.dump(case)
    except InputError:
        text = None
    return {
        "rig": text,
        "limits": {
            m: v if isinstance(v, str) else np.asarray(v).tolist() for m, v in limits.items()
        },
    }


def to_json(distributions):
    """Return {name: {"kind", fields}} of {name: distribution}."""
    return {
        n: {
            "kind": type(d).__name__,
            **{
                k: np.asarray(v).tolist() if np.ndim(v) else v
                for k, v in dataclasses.asdict(d).items()
            },
        }
        for n, d in distributions.items()
    }


def from_json(found):
    """Return {name: distribution} of what `to_json` gives; InputError for anything else."""
    built = {}
    for name, fields in found.items():
        kind = KINDS.get(cast(Any, fields.get("kind"))) if isinstance(fields, dict) else None
        if kind is None or set(fields) != {"kind", *(f.name for f in dataclasses.fields(kind))}:
            raise InputError(f"manifest: {name} is not a distribution of this program")
        built[name] = kind(**{k: _tuples(v) for k, v in fields.items() if k != "kind"})
        try:
            built[name].check(name)
        except (TypeError, ValueError, AttributeError):
            raise InputError(f"manifest: {name} is not a distribution of this program") from None
    return built


def _tuples(value) -> Any:
    return tuple(_tuples(v) for v in value) if isinstance(value, list) else value


def restore(folder):
    """Return (Case, options of `ensemble`) of the shards in a folder."""
    # Nothing is trusted: the rig file is read as any other, and the loop made from it must be, bit
    # for bit, that of the shards (`ensemble` compares their digests). Raises InputError where the
    # manifest does not state them.
    manifest = batch_store.read_manifest(folder)
    bad = [name for name, kind in WORDS.items() if not isinstance(manifest.get(name), kind)]
    asked = manifest.get("origin")
    if bad or not isinstance(asked, dict) or not isinstance(asked.get("limits"), dict):
        raise InputError(
            f"{str(folder)!r}: the manifest does not say what its shards are of; give the case and"
            " the options as theirs"
        )
    if not isinstance(asked.get("rig"), str):
        raise InputError(
            f"{str(folder)!r}: no rig file describes the case of these shards; merge them from"
            " Python"
        )
    case = rig.loads(asked["rig"], f"manifest of {str(folder)!r}")
    options = {n: manifest[n] for n in ("samples", "key", "batch", "draws")}
    named = all(isinstance(m, str) for m in manifest["measures"])
    if options["batch"] < 1 or options["samples"] > 10**8 or not named:
        raise InputError(f"{str(folder)!r}: the manifest is not one of this program")
    return case, {
        **options,
        "measures": tuple(manifest["measures"]),
        "limits": asked["limits"],
        "distributions": from_json(manifest["distributions"]),
    }

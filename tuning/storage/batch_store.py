"""Finished batches as files: each whole or not at all, read back without trust."""

import hashlib
import io
import json
import re
import zipfile
from pathlib import Path

import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.core.files import check_folder, refusal, untouched, write_atomic

MANIFEST = "manifest.json"
LARGEST = 1 << 28
"""Largest batch that is read [bytes], unpacked."""

NAME = re.compile(r"part-(\d{6})\.npz")


def digest(arrays):
    """Hexadecimal digest of arrays, their shapes and types."""
    found = hashlib.sha256()
    for a in arrays:
        found.update(f"{a.dtype.str}{a.shape}".encode() + np.ascontiguousarray(a).tobytes())
    return found.hexdigest()


class Store:
    """The finished batches of an ensemble in a folder, with a manifest that says what they are of.

    Shards of one ensemble may share a folder: the manifest is the same for all. anew: resume may
    begin one of which a kill left nothing but its lock. Raises InputError for a folder that holds
    another ensemble, for one that holds batches where neither resume nor shared is True, and for
    one with nothing to resume.
    """

    def __init__(self, folder, manifest, resume=False, shared=False, anew=True):
        check_folder(folder)
        self.folder = Path(folder)
        self.manifest = json.loads(json.dumps(manifest))
        path = self.folder / MANIFEST
        if path.exists():
            check_same(self.manifest, read_manifest(self.folder), self.folder)
            if not (resume or shared) and any(self.folder.glob("part-*.npz")):
                raise InputError(
                    f"{str(folder)!r} holds finished batches of this ensemble: --resume goes on"
                    " with them"
                )
        # a kill came before the first file
        elif resume and not path.exists() and not (anew and untouched(self.folder)):
            raise InputError(f"--resume {str(folder)!r}: there is no ensemble to go on with")
        if not path.exists():
            self._write(path, json.dumps(self.manifest, indent=1) + "\n")

    def path(self, k):
        """The file of batch k."""
        return self.folder / f"part-{k:06d}.npz"

    def has(self, k):
        """True if batch k is finished."""
        return self.path(k).exists()

    def put(self, k, batch):
        """Write batch k, {name: array}."""
        out = io.BytesIO()
        np.savez(out, **batch, seal=np.bytes_(self._seal(k, batch)))
        self._write(self.path(k), out.getvalue())

    def _write(self, path, data):
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_atomic(path, data)
        except OSError as error:
            raise InputError(
                f"{str(path)!r} cannot be written ({error.strerror}): make room, then --resume"
            ) from None

    def get(self, k, shapes):
        """Batch k as {name: array} of these {name: shape}. Raises InputError for a file that is not
        one of ours, or not what was written as
        batch k of this ensemble: its seal says so, which whoever has this program can make, or what
            it holds does.
        """
        path = self.path(k)
        found = read_part(path, set(self.manifest["measures"]) | {"failed", "seal"})
        seal = found.pop("seal")
        odd = [
            n
            for n, a in found.items()
            if a.dtype not in (np.float64, np.float32) or a.shape != shapes[n]
        ]
        if (
            odd
            or seal.dtype.kind != "S"
            or seal.shape != ()
            or bytes(seal).decode("ascii", "replace") != self._seal(k, found)
        ):
            raise InputError(
                f"{path.name}: is not what was written as batch {k} of this ensemble: remove it and"
                " run its share again"
            )
        return found

    def _seal(self, k, batch):
        """Digest of a batch, its number and what it is of: it tells a file that was changed or
        exchanged, by accident or by hand.
        """
        mine = json.dumps({n: v for n, v in self.manifest.items() if n != "origin"}, sort_keys=True)
        return digest(
            [
                np.frombuffer(f"{mine} {k}".encode(), dtype=np.uint8),
                *(np.asarray(batch[n]) for n in sorted(batch)),
            ]
        )

    def clear(self):
        """Remove the batches and the manifest: the result is whole."""
        for path in [*self.folder.glob("part-*.npz"), self.folder / MANIFEST]:
            if NAME.fullmatch(path.name) or path.name == MANIFEST:
                path.unlink(missing_ok=True)


def read_part(path, names):
    """{name: array} of a batch file; nothing is unpickled, and nothing larger than it should be is
    unpacked.
    """
    try:
        if why := refusal(path, LARGEST):
            raise ValueError(why)
        with zipfile.ZipFile(path) as archive:
            if sum(info.file_size for info in archive.infolist()) > LARGEST:
                raise InputError(
                    f"{path.name}: unpacks to more than {LARGEST >> 20} MiB, not a batch of this"
                    " program"
                )
            if sorted(archive.namelist()) != sorted(f"{n}.npy" for n in names):
                raise InputError(f"{path.name}: does not hold the measures of the manifest")
        with np.load(path, allow_pickle=False) as table:
            return {name: table[name] for name in names}
    except Exception as error:
        # numpy evaluates the header as a Python literal: RecursionError, TokenError, OverflowError,
        # ...
        raise InputError(
            f"{path.name}: is not a batch of this program ({' '.join(str(error).split())[:80]})"
        ) from None


def read_manifest(folder):
    """The manifest of a folder. Raises InputError where there is none, or it is no manifest."""
    path = Path(folder) / MANIFEST
    try:
        if why := refusal(path, 1 << 20):
            raise InputError(f"{str(path)!r} {why}, so it is no manifest")
        found = json.loads(path.read_text(encoding="utf-8"))
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{str(path)!r} cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError):  # the latter where it is nested without end
        raise InputError(f"{str(path)!r} is not a manifest") from None
    if not isinstance(found, dict):
        raise InputError(f"{str(path)!r} is not a manifest")
    return found


def check_same(mine, theirs, folder):
    """Raise InputError, naming what differs, unless two manifests are of one ensemble. "origin" is
    for people and `merge`: the limits in it decide nothing that is in a batch.
    """
    other = [k for k in mine if k != "origin" and mine[k] != theirs.get(k)]
    if other:
        raise InputError(
            f"{str(folder)!r} holds another ensemble; what differs: {', '.join(other)}"
        )


def missing(folder, count):
    """The batches of `count` that a folder does not hold."""
    have = {
        int(m.group(1))
        for m in (NAME.fullmatch(p.name) for p in Path(folder).glob("part-*.npz"))
        if m
    }
    return [k for k in range(count) if k not in have]

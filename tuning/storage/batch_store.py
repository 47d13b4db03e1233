"""Finished batches of an ensemble as files: each whole or not at all, read back without trust."""

import io
import json
import re
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.core.files import refusal, write_atomic
from tuning.storage.checkpoint import Checkpoint, Folder

MANIFEST = "manifest.json"
LARGEST = 1 << 28
"""Largest batch that is read [bytes], unpacked."""

NAME = re.compile(r"part-(\d{6})\.npz")


class BatchStore:
    """The finished batches of an ensemble in a folder, with a manifest of the problem
    they are of.
    """

    def __init__(
        self,
        folder: Folder,
        problem: Mapping[str, Any],
        *,
        resume: bool = False,
        shared: bool = False,
    ):
        self.checkpoint = Checkpoint(folder, problem)
        self.folder = self.checkpoint.folder
        path = self.folder / MANIFEST
        if path.exists():
            self.checkpoint.check_same(read_manifest(self.folder))
            if not (resume or shared) and any(self.folder.glob("part-*.npz")):
                raise InputError(
                    f"{str(folder)!r} holds finished batches of this ensemble: --resume continues"
                    " with them"
                )
            return
        if resume and not self.checkpoint.begun():
            self.checkpoint.refuse_empty(MANIFEST)
        self._write(path, json.dumps(self.checkpoint.problem, indent=1) + "\n")

    def path(self, k: int) -> Path:
        """Return the file of batch k."""
        return self.folder / f"part-{k:06d}.npz"

    def has(self, k: int) -> bool:
        """Return True if batch k is finished."""
        return self.path(k).exists()

    def put(self, k: int, batch: Mapping[str, Any]) -> None:
        """Write batch k, {name: array}."""
        out = io.BytesIO()
        np.savez(out, **batch, seal=np.bytes_(self._seal(k, batch)))
        self._write(self.path(k), out.getvalue())

    def _write(self, path: Path, data: str | bytes) -> None:
        """Write a file, whole or not at all."""
        with self.checkpoint.writing(path):
            write_atomic(path, data)

    def get(self, k: int, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Any]:
        """Return batch k as {name: array} of these {name: shape}."""
        # Raises InputError for a file that is not one of ours, or not what was written as batch k
        # of this ensemble, by its seal (which whoever has this program can make) or by what it
        # holds.
        path = self.path(k)
        found = read_batch(path, {*self.checkpoint.problem["measures"], "failed", "seal"})
        seal = found.pop("seal")
        odd = [
            n
            for n, a in found.items()
            if a.dtype not in (np.float64, np.float32) or a.shape != shapes[n]
        ]
        text = seal.dtype.kind == "S" and seal.shape == ()
        if odd or not text or bytes(seal).decode("ascii", "replace") != self._seal(k, found):
            raise InputError(
                f"{path.name}: is not what was written as batch {k} of this ensemble: delete it"
                " and run its share again"
            )
        return found

    def _seal(self, k: int, batch: Mapping[str, Any]) -> str:
        """Return the seal of a batch, its number included."""
        return self.checkpoint.seal(str(k), *(np.asarray(batch[n]) for n in sorted(batch)))


def remove_batches(folder: Folder) -> None:
    """Remove the batches and the manifest of a folder, if it has one: the result is complete."""
    if not (Path(folder) / MANIFEST).exists():
        return
    for path in (*Path(folder).glob("part-*.npz"), Path(folder) / MANIFEST):
        if NAME.fullmatch(path.name) or path.name == MANIFEST:
            path.unlink(missing_ok=True)


def read_batch(path: Path, names: Iterable[str]) -> dict[str, Any]:
    """Return {name: array} of a batch file."""
    # Nothing is unpickled, and nothing larger than it should be is unpacked. Raises InputError for
    # a file that is not one of ours.
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


def read_manifest(folder: Folder) -> dict[str, Any]:
    """Return the manifest of a folder. Raises InputError where there is none, or it is none."""
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

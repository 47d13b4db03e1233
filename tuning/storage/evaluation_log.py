"""Results of evaluations, kept in memory or as lines of a file that a killed run continues from."""

import contextlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.core.files import refusal
from tuning.storage.checkpoint import Checkpoint, Folder
from tuning.storage.fingerprint import digest

NAME = "evaluations.jsonl"
LARGEST = 1 << 30
"""Largest log that is read [bytes]."""

MARK, SIZE = b', "digest": "', 16
"""What stands before the digest that ends a line, and the digest's length."""

MALFORMED = (ValueError, KeyError, TypeError, RecursionError)
"""What reading a line of JSON raises that is not one of ours; the last where it is nested without
end.
"""


class EvaluationCache:
    """Results by what was evaluated."""

    def __init__(self):
        self.found: dict[str, Any] = {}

    def recall(self, kind: str, arguments: Sequence[Any], compute: Callable[[], Any]) -> Any:
        """Return compute(), or what it gave for the same kind and arguments (arrays, numbers)."""
        key = digest(kind, *arguments)
        if key not in self.found:
            self.enter(kind, key, compute())
        return self.found[key]

    def enter(self, kind: str, key: str, result: Any) -> None:
        """Enter a result under its key, unless there is one."""
        if key not in self.found:
            self.found[key] = self.keep(kind, key, result)

    def keep(self, kind: str, key: str, result: Any) -> Any:
        """Return `result`, entered wherever it is to be kept."""
        return result

    def in_memory(self) -> "EvaluationCache":
        """Return a cache of the same results that writes nothing."""
        cache = EvaluationCache()
        cache.found = self.found
        return cache


class EvaluationLog(EvaluationCache):
    """An EvaluationCache that is also a file: a line for each evaluation, numbers in
    hexadecimal.
    """

    def __init__(self, folder: Folder, problem: Mapping[str, Any], resume: bool = False):
        super().__init__()
        self.checkpoint = Checkpoint(folder, problem)
        self.path = self.checkpoint.folder / NAME
        whole = self._read() if resume else b""
        with self.checkpoint.writing(self.path), open(self.path, "r+b" if whole else "wb") as file:
            if whole:
                file.truncate(len(whole))
            else:
                file.write(json.dumps({"problem": self.checkpoint.problem}).encode() + b"\n")
        self.resumed = len(self.found)

    def _read(self) -> bytes:
        """Return the whole lines of the file, their results entered in `found`."""
        data = self._data()
        lines = data[: data.rfind(b"\n") + 1].splitlines(keepends=True)
        if not lines:
            return b""
        try:
            theirs = json.loads(lines[0])["problem"]
        except MALFORMED:
            raise InputError(f"--resume: {NAME} is not a log of this program") from None
        self.checkpoint.check_same(theirs)
        for i, line in enumerate(lines[1:]):
            try:
                body, mark, tail = line.rpartition(MARK)
                if not mark or tail != self._tail(body):
                    raise ValueError(tail)
                entry = json.loads(body + b"}")
                self.found[entry["key"]] = tuple(_from_json(v) for v in entry["result"])
            except MALFORMED:
                raise InputError(
                    f"--resume: line {i + 2} of {NAME} is not one of its entries, or was changed:"
                    " without that line it is evaluated again"
                ) from None
        return b"".join(lines)

    def _data(self) -> bytes:
        """Return the bytes of the file; none where a run was killed before its first line."""
        folder = str(self.checkpoint.folder)
        try:
            if why := refusal(self.path, LARGEST):
                raise InputError(f"--resume: {NAME} in {folder!r} {why}, so it is no log of ours")
            return self.path.read_bytes()
        except FileNotFoundError:
            if self.checkpoint.begun():
                return b""
            self.checkpoint.refuse_empty(NAME)
        except OSError as error:
            raise InputError(
                f"--resume: {NAME} in {folder!r} cannot be read ({error.strerror})"
            ) from None

    def keep(self, kind: str, key: str, result: Any) -> Any:
        """Return `result` as it is read back from the line that is written."""
        entries = [_to_json(v) for v in result]
        body = json.dumps({"kind": kind, "key": key, "result": entries}).encode()[:-1]
        with self.checkpoint.writing(self.path), open(self.path, "ab") as file:
            file.write(body + MARK + self._tail(body))
        return tuple(_from_json(json.loads(json.dumps(entry))) for entry in entries)

    def _tail(self, body: bytes) -> bytes:
        """Return what follows MARK on the line that begins with `body`."""
        return self.checkpoint.seal(body)[:SIZE].encode() + b'"}\n'


def discard(folder: Folder) -> None:
    """Remove the log of a folder, if it has one, and those of a search over choices."""
    for log in (Path(folder) / NAME, *Path(folder).glob(f"choice_*/{NAME}")):
        with contextlib.suppress(FileNotFoundError):
            os.unlink(log)
        if log.parent != Path(folder):
            with contextlib.suppress(OSError):  # not empty: somebody else's
                log.parent.rmdir()


def _to_json(value: Any) -> dict[str, Any]:
    """Return a number, an array, a dict or a tuple of them as JSON without loss."""
    if isinstance(value, dict):
        return {"of": {k: _to_json(v) for k, v in value.items()}}
    if isinstance(value, (tuple, list)):
        return {"all": [_to_json(v) for v in value]}
    array = np.asarray(value)
    if array.dtype != np.float64:
        raise TypeError(f"a log holds float64, not {array.dtype}")
    return {"shape": array.shape, "hex": [float(v).hex() for v in array.ravel()]}


def _from_json(entry: Any) -> Any:
    """Return what `_to_json` was given."""
    if "of" in entry:
        return {k: _from_json(v) for k, v in entry["of"].items()}
    if "all" in entry:
        return tuple(_from_json(v) for v in entry["all"])
    array = np.array([float.fromhex(v) for v in entry["hex"]], dtype=np.float64).reshape(
        [int(n) for n in entry["shape"]]
    )
    return float(array) if array.ndim == 0 else array

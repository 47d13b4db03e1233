"""What was evaluated before: a log that a killed run is continued from, to the same bits."""

import contextlib
import hashlib
import json
import os
from pathlib import Path

import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.core.files import refusal, untouched

NAME = "evaluations.jsonl"
LARGEST = 1 << 30
"""Largest log that is read [bytes]."""

MARK, SIZE = b', "digest": "', 16
"""What stands before the digest that closes a line, and the digest's length."""

BROKEN = (ValueError, KeyError, TypeError, RecursionError)
"""What reading a line of JSON raises that is not one of ours; the last where it is nested without
end.
"""


def folder_of(checkpoint, **former):
    """The folder where a search or study keeps what is done, None for none.

    former: {its former keyword: value}. Raises InputError where both are given, for two folders.

    >>> folder_of("run1", log=None)
    'run1'
    """
    ((name, folder),) = former.items()
    if checkpoint is None or folder is None or Path(checkpoint) == Path(folder):
        return folder if checkpoint is None else checkpoint
    raise InputError(f"checkpoint and {name} are two names of one folder: give one of them")


class Memo:
    """Results by what was asked. A search asks in an order that its results alone decide, so one
    that is started again and finds its earlier results here walks the same path, and goes on where
    the log ends.
    """

    def __init__(self):
        self.found = {}

    def recall(self, kind, asked, compute):
        """compute(), or what it gave when the same was asked before. asked: list of arrays and
        plain values.
        """
        key = _digest(kind, asked)
        if key not in self.found:
            self.found[key] = self.keep(kind, key, compute())
        return self.found[key]

    def keep(self, kind, key, result):
        """`result`, entered wherever it is to be kept."""
        return result


class Log(Memo):
    """A Memo that is also a file, a line per evaluation, numbers in hexadecimal so that not a bit
    is lost.

    The first line says what problem it belongs to, and every other one ends with a digest of itself
    and that problem: a line that was changed, by hand or by a bad disk, or that comes from another
    log is refused. One that a kill cut short is dropped. Raises InputError for those, for a log of
    another problem, and for what is no log.
    """

    def __init__(self, folder, problem, resume=False):
        super().__init__()
        self.path, head = (
            Path(folder) / NAME,
            json.dumps({"jaxtank": 2, "problem": problem}, sort_keys=True),
        )
        self.head = head.encode()
        whole = self._read(head) if resume else b""
        with self._told():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with open(self.path, "r+b" if whole else "wb") as file:
                if whole:
                    file.truncate(len(whole))
                else:
                    file.write(head.encode() + b"\n")
        self.resumed = len(self.found)

    def _read(self, head):
        try:
            if why := refusal(self.path, LARGEST):
                raise InputError(
                    f"--resume: {NAME} in {str(self.path.parent)!r} {why}, so it is no log of this"
                    " program"
                )
            data = self.path.read_bytes()
        except FileNotFoundError:
            if untouched(self.path.parent):  # a kill came before the first line
                return b""
            done = (self.path.parent / "result.json").exists()
            why = (
                "that run had ended, and its answer is in result.json"
                if done
                else f"there is no {NAME}"
            )
            raise InputError(
                f"--resume: {str(self.path.parent)!r} cannot be read as a search to go on with:"
                f" {why}"
            ) from None
        except OSError as error:
            raise InputError(
                f"--resume: {NAME} in {str(self.path.parent)!r} cannot be read ({error.strerror})"
            ) from None
        lines = data[: data.rfind(b"\n") + 1].splitlines(keepends=True)
        if not lines:
            return b""
        try:
            mine, theirs = json.loads(head)["problem"], json.loads(lines[0])["problem"]
        except BROKEN:
            raise InputError(f"--resume: {NAME} is not a log of this program") from None
        if mine != theirs:
            other = [k for k in mine if not isinstance(theirs, dict) or mine[k] != theirs.get(k)]
            raise InputError(
                f"--resume: the run in {str(self.path.parent)!r} was of another problem; what"
                f" differs: {', '.join(other)}"
            )
        for i, line in enumerate(lines[1:]):
            try:
                body, mark, tail = line.rpartition(MARK)
                if not mark or tail != self._tail(body):
                    raise ValueError(tail)
                entry = json.loads(body + b"}")
                self.found[entry["key"]] = tuple(_read(v) for v in entry["result"])
            except BROKEN:
                raise InputError(
                    f"--resume: line {i + 2} of {NAME} is not one of its entries, or was changed:"
                    " without that line it is evaluated again"
                ) from None
        return b"".join(lines)

    def keep(self, kind, key, result):
        body = json.dumps(
            {"kind": kind, "key": key, "result": [_write(v) for v in result]}
        ).encode()[:-1]
        with self._told(), open(self.path, "ab") as file:
            file.write(body + MARK + self._tail(body))
        return tuple(_read(json.loads(json.dumps(_write(v)))) for v in result)

    def _tail(self, body):
        """What follows MARK on the line that begins with `body`."""
        return hashlib.sha256(self.head + body).hexdigest()[:SIZE].encode() + b'"}\n'

    @contextlib.contextmanager
    def _told(self):
        """A log that cannot be written is an InputError: what it holds so far is good to go on
        from.
        """
        try:
            yield
        except OSError as error:
            raise InputError(
                f"{str(self.path)!r} cannot be written ({error.strerror}): make room, then --resume"
            ) from None

    def memo(self):
        """A Memo of what the log holds, for what is asked later and need not be kept."""
        memo = Memo()
        memo.found = self.found
        return memo


def discard(folder):
    """Remove the log of a folder, if it has one, and those of a search over choices."""
    for log in (Path(folder) / NAME, *Path(folder).glob(f"choice_*/{NAME}")):
        with contextlib.suppress(FileNotFoundError):
            os.unlink(log)
        if log.parent != Path(folder):
            with contextlib.suppress(OSError):  # not empty: somebody else's
                log.parent.rmdir()


def _digest(kind, asked):
    digest = hashlib.sha256(kind.encode())
    for value in asked:
        array = np.asarray(value)
        digest.update(f"{array.dtype.str}{array.shape}".encode() + array.tobytes())
    return digest.hexdigest()


def _write(value):
    """A number, an array, a dict or a tuple of them as JSON without loss."""
    if isinstance(value, dict):
        return {"of": {k: _write(v) for k, v in value.items()}}
    if isinstance(value, (tuple, list)):
        return {"all": [_write(v) for v in value]}
    array = np.asarray(value)
    if array.dtype != np.float64:
        raise TypeError(f"a log holds float64, not {array.dtype}")
    return {"shape": array.shape, "hex": [float(v).hex() for v in array.ravel()]}


def _read(entry):
    if "of" in entry:
        return {k: _read(v) for k, v in entry["of"].items()}
    if "all" in entry:
        return tuple(_read(v) for v in entry["all"])
    array = np.array([float.fromhex(v) for v in entry["hex"]], dtype=np.float64).reshape(
        [int(n) for n in entry["shape"]]
    )
    return float(array) if array.ndim == 0 else array

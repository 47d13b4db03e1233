"""Finished records of one problem in an SQLite file, from which a killed run continues."""

import base64
import contextlib
import json
import sqlite3
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.core.files import check_folder, refusal, untouched
from tuning.storage.fingerprint import digest

NAME = "checkpoint.sqlite3"

FORMAT = 4  # version of the file format; other versions are refused

LARGEST_FILE, LARGEST = 1 << 40, 1 << 28  # file and record that are read [bytes]

SCHEMA = "CREATE TABLE record (key TEXT PRIMARY KEY, value TEXT, seal TEXT)"
PROBLEM = "problem"  # key of the record that says what the others are of

TYPES = ("<f8", "<f4")

UNREADABLE = (
    "is not a checkpoint of this program, or was changed ({}): delete it and run without --resume"
)
UNWRITABLE = "cannot be written ({}): free disk space, then --resume"

Folder = str | Path


def check_resume(checkpoint: Folder | None, resume: bool) -> None:
    """Raise InputError for `resume` without the folder to go on from."""
    if resume and checkpoint is None:
        raise InputError("resume = True: needs `checkpoint`, the folder of the run to go on with")


class Store:
    """Values (numbers, arrays, dicts, tuples) by key in a file; a changed record is refused.

    afresh: begin a new file unless resumed. shared: several processes write to the file.
    """

    def __init__(
        self,
        folder: Folder,
        problem: Mapping[str, Any],
        *,
        resume: bool = False,
        afresh: bool = False,
        shared: bool = False,
    ):
        check_folder(folder)
        self.folder, self.path = Path(folder), Path(folder) / NAME
        self.problem: dict[str, Any] = json.loads(json.dumps({"format": FORMAT, **problem}))
        self.head = json.dumps(self.problem)
        if afresh and not resume:
            discard(folder)
        try:
            if why := refusal(self.path, LARGEST_FILE):
                raise InputError(f"{str(self.path)!r} {why}, so it is no checkpoint")
        except OSError:
            if resume and not untouched(self.folder):
                why = f"there is no {NAME}"
                if (self.folder / "result.json").exists():
                    why = "that run had ended, and its result is in result.json"
                raise InputError(
                    f"--resume: {str(self.folder)!r} holds no checkpoint to continue: {why}"
                ) from None
        with self._one_line(UNWRITABLE):
            self.folder.mkdir(parents=True, exist_ok=True)
            self.db = sqlite3.connect(
                self.path, timeout=60, isolation_level=None, check_same_thread=False
            )
        try:
            self._check_tables()
            self._begin(shared)
            self._check_problem()
            if not (resume or shared) and self.finished():
                raise InputError(
                    f"{str(self.folder)!r} holds finished batches of this ensemble: --resume"
                    " continues with them"
                )
        except BaseException:
            self.close()
            raise

    def _check_tables(self):
        """Raise InputError unless the file is a whole database of one table, or of none."""
        with self._one_line(UNREADABLE):
            self.db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LARGEST)
            self.db.execute("PRAGMA trusted_schema = OFF")
            schema = [sql for (sql,) in self.db.execute("SELECT sql FROM sqlite_master") if sql]
            (state,) = self.db.execute("PRAGMA quick_check(1)").fetchone()
            if state != "ok" or schema not in ([], [SCHEMA]):
                raise sqlite3.DatabaseError("has other tables" if state == "ok" else state)

    def _begin(self, shared):
        """Make the table, unless there is one."""
        with self._one_line(UNWRITABLE):
            # one writer need not wait for the disk: a power failure costs the last records alone
            self.db.execute(f"PRAGMA journal_mode = {'DELETE' if shared else 'WAL'}")
            self.db.execute("PRAGMA synchronous = NORMAL")
            self.db.execute("PRAGMA wal_autocheckpoint = 64")
            self.db.execute("BEGIN IMMEDIATE")
            self.db.execute(SCHEMA.replace("TABLE", "TABLE IF NOT EXISTS"))
            self._insert(PROBLEM, self.head)
            self.db.execute("COMMIT")

    def _check_problem(self):
        """Raise InputError, naming what differs, unless the file is of the same problem."""
        theirs = None
        with contextlib.suppress(ValueError, RecursionError):
            theirs = json.loads(self._text(PROBLEM))
        if not isinstance(theirs, dict) or theirs.get("format") != FORMAT:
            raise InputError(
                f"--resume: the checkpoint in {str(self.folder)!r} was written by another version"
                " of this program: give another folder, or delete that one"
            )
        names = dict.fromkeys([*self.problem, *theirs])
        # as text, so that NaN is equal to itself
        other = [n for n in names if json.dumps(self.problem.get(n)) != json.dumps(theirs.get(n))]
        if other:
            raise InputError(
                f"--resume: the checkpoint in {str(self.folder)!r} is of another problem; what"
                f" differs: {', '.join(other)}"
            )

    def finished(self) -> list[str]:
        """Return the keys of all values, as they were entered."""
        with self._one_line(UNREADABLE):
            rows = self.db.execute("SELECT key FROM record ORDER BY rowid")
            return [key for (key,) in rows if key != PROBLEM]

    def put(self, key: str, value: Any) -> Any:
        """Store a value and return the value that will be read back."""
        text = json.dumps(_to_json(value))
        with self._one_line(UNWRITABLE):
            self._insert(key, text)
        return _from_json(json.loads(text))

    def get(self, key: str) -> Any:
        """Return the value of a key. Raises InputError for one that was changed."""
        try:
            return _from_json(json.loads(self._text(key)))
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            raise self.changed(key) from None

    def changed(self, key: str) -> InputError:
        """Return the error for a record that this program did not write."""
        return InputError(
            f"--resume: record {key[:16]} of {str(self.path)!r} is not what was written for this"
            " problem, or was changed: delete the file and run without --resume"
        )

    def close(self) -> None:
        self.db.close()

    def _insert(self, key, text):
        seal = digest(self.head, key, text)
        self.db.execute("INSERT OR IGNORE INTO record VALUES (?, ?, ?)", (key, text, seal))

    def _text(self, key):
        """Return the text of a record; its seal is checked."""
        with self._one_line(UNREADABLE):
            rows = self.db.execute("SELECT value, seal FROM record WHERE key = ?", (key,))
            text, seal = rows.fetchone() or (None, None)
        # of the problem itself, what differs is told by name
        if not isinstance(text, str) or (key != PROBLEM and seal != digest(self.head, key, text)):
            raise self.changed(key)
        return text

    @contextlib.contextmanager
    def _one_line(self, words: str) -> Iterator[None]:
        """Turn an error of the disk or of SQLite into an InputError."""
        try:
            yield
        except (OSError, sqlite3.Error, UnicodeDecodeError) as error:
            why = getattr(error, "strerror", None) or error
            raise InputError(f"{str(self.path)!r} {words.format(why)}") from None


def discard(folder: Folder) -> None:
    """Remove the records of a folder, also of a search over choices: the result is complete."""
    folder = Path(folder)
    for path in sorted((*folder.glob(f"{NAME}*"), *folder.glob(f"choice_*/{NAME}*"))):
        with contextlib.suppress(FileNotFoundError):
            path.unlink()
        if path.parent != folder:
            with contextlib.suppress(OSError):  # not empty: somebody else's
                path.parent.rmdir()


def _to_json(value: Any) -> dict[str, Any]:
    """Return a number, an array, a dict or a tuple of them as JSON without loss."""
    if isinstance(value, Mapping):
        return {"of": {k: _to_json(v) for k, v in value.items()}}
    if isinstance(value, (tuple, list)):
        return {"all": [_to_json(v) for v in value]}
    array = np.asarray(value)
    if array.dtype.str not in TYPES:
        raise TypeError(f"a checkpoint holds floats, not {array.dtype}")
    data = base64.b64encode(array.tobytes()).decode()
    return {"type": array.dtype.str, "shape": array.shape, "data": data}


def _from_json(entry: Any) -> Any:
    if "of" in entry:
        return {k: _from_json(v) for k, v in entry["of"].items()}
    if "all" in entry:
        return tuple(_from_json(v) for v in entry["all"])
    if entry["type"] not in TYPES:
        raise TypeError(entry["type"])
    data = base64.b64decode(entry["data"], validate=True)
    array = np.frombuffer(data, entry["type"]).reshape([int(n) for n in entry["shape"]]).copy()
    return float(array) if array.ndim == 0 else array

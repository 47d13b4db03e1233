"""A folder that holds the finished records of one problem, from which a killed run continues."""

import contextlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NoReturn

from jaxtank.core.errors import InputError
from jaxtank.core.files import check_folder, untouched
from tuning.storage.fingerprint import digest

FORMAT = 3
"""Version of what is written; another one is refused."""

Folder = str | Path


def checkpoint_folder(checkpoint: Folder | None, **former: Folder | None) -> Folder | None:
    """Return the folder where a search or study keeps what is done, None for none."""
    ((name, folder),) = former.items()
    if checkpoint is None or folder is None or Path(checkpoint) == Path(folder):
        return folder if checkpoint is None else checkpoint
    raise InputError(f"checkpoint and {name} are two names of one folder: give one of them")


class Checkpoint:
    """A folder, the problem its records are of, and what is common to every form of record."""

    # problem : the `fingerprint` of the run. Every record carries a `seal`, so that one that was
    # changed, by hand or by a bad disk, or that is of another problem, is refused.

    def __init__(self, folder: Folder, problem: Mapping[str, Any]):
        check_folder(folder)
        self.folder = Path(folder)
        self.problem: dict[str, Any] = json.loads(json.dumps({"format": FORMAT, **problem}))
        self.head = json.dumps(self.problem, sort_keys=True)

    def seal(self, *record: Any) -> str:
        """Return the digest of a record, and of the problem that it belongs to."""
        return digest(self.head, *record)

    def check_same(self, theirs: Any) -> None:
        """Raise InputError, naming what differs, unless `theirs` is the same problem."""
        theirs = theirs if isinstance(theirs, dict) else {}
        if theirs.get("format") != FORMAT:
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

    def refuse_empty(self, name: str) -> NoReturn:
        """Raise InputError: there is nothing to continue, because the file `name` is missing."""
        done = (self.folder / "result.json").exists()
        why = (
            "that run had ended, and its result is in result.json"
            if done
            else f"there is no {name}"
        )
        raise InputError(
            f"--resume: {str(self.folder)!r} holds no checkpoint to continue: {why}"
        ) from None

    def begun(self) -> bool:
        """Return True if a run was killed before it wrote anything but its lock."""
        return untouched(self.folder)

    @contextlib.contextmanager
    def writing(self, path: Path) -> Iterator[None]:
        """Make the folder; turn an OSError inside into an InputError that names the remedy."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            yield
        except OSError as error:
            raise InputError(
                f"{str(path)!r} cannot be written ({error.strerror}): free disk space, then"
                " --resume"
            ) from None

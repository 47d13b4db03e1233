"""Reading and writing of files: each is written whole or not at all."""

import contextlib
import errno
import os
import stat
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path

from jaxtank.core.errors import InputError

LARGEST_TEXT = 4 * 1024 * 1024  # bytes of a rig file

LOCK = ".jaxtank.lock"
"""File that a run keeps in its folder while it lasts, and that stays after a kill."""

Content = str | bytes | Iterable[str]  # content from which a file is written

ASIDE = ".jaxtank"  # suffix of files that are not yet complete


def untouched(folder: str | os.PathLike[str]) -> bool:
    """Return whether a run began in a folder and wrote nothing else there."""
    return os.path.isdir(folder) and os.listdir(folder) == [LOCK]


def write_atomic(path: str | os.PathLike[str], data: str | bytes) -> None:
    """Write a file by way of a temporary one in the same folder; a link is not followed."""
    path = Path(path)
    write_together(path.parent, {path.name: data})


def write_together(folder: str | os.PathLike[str], files: Mapping[str, Content]) -> None:
    """Write several files to a folder, all of them or none."""
    # All are complete on the disk before the first replaces an older one, so that a full disk
    # leaves what was there as it was.
    folder, aside = Path(folder), list[tuple[str, Path]]()
    try:
        for name, data in files.items():
            if (folder / name).is_dir():
                raise IsADirectoryError(errno.EISDIR, f"{name} is a folder there")
            handle, temporary = tempfile.mkstemp(dir=folder, prefix=f".{name}.", suffix=ASIDE)
            aside.append((temporary, folder / name))
            with os.fdopen(handle, "wb") as file:
                for part in (data,) if isinstance(data, str | bytes) else data:
                    file.write(part.encode() if isinstance(part, str) else part)
                file.flush()
                os.fsync(file.fileno())
            os.chmod(temporary, 0o666 & ~_umask())
        for temporary, path in aside:
            os.replace(temporary, path)
    except BaseException:
        for temporary, _ in aside:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(temporary)
        raise


def write_folder(folder: str | Path, files: Mapping[str, Content]) -> list[Path]:
    """Write files to a folder, made if need be, all of them or none; return their paths."""
    check_folder(folder)
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_together(folder, files)
    except OSError as error:
        raise InputError(
            f"--out {str(folder)!r}: cannot be written to ({error.strerror}); give a folder"
            " that can"
        ) from None
    return [folder / name for name in files]


def sweep(folder: str | os.PathLike[str]) -> None:
    """Remove the incomplete files that a killed run left in a folder."""
    for path in Path(folder).glob(f".*{ASIDE}"):
        with contextlib.suppress(OSError):
            path.unlink()


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def check_folder(path: str | os.PathLike[str]) -> None:
    """Check that a path is, or can become, a folder to write to. Nothing is made yet."""
    path = Path(path)
    if "\0" in str(path):
        raise InputError(f"--out {str(path)!r}: a name cannot hold the character NUL")
    if path.is_symlink() and not path.exists():
        raise InputError(
            f"--out {str(path)!r} is a link to {os.readlink(path)!r}, which is not there: make that"
            " folder or give another"
        )
    if path.exists() and not path.is_dir():
        raise InputError(f"--out {str(path)!r} is a file: give a folder, new or existing")
    parent = (
        path if path.exists() else next((p for p in path.absolute().parents if p.exists()), None)
    )
    if parent is None or not parent.is_dir():
        raise InputError(
            f"--out {str(path)!r}: {str(parent)!r} is a file, so no folder can be made there"
        )
    if not os.access(parent, os.W_OK | os.X_OK):
        raise InputError(f"--out {str(path)!r}: no permission to write to {str(parent)!r}")


def refusal(path: str | os.PathLike[str], largest: int) -> str | None:
    """Return why a file is not to be read, or None."""
    # A folder, a device or a pipe, which may never end, is not read.
    reason = os.stat(path)
    if not stat.S_ISREG(reason.st_mode):
        return "is not a file"
    return (
        f"has {reason.st_size} bytes: at most {largest} are read"
        if reason.st_size > largest
        else None
    )


def read_text(path: str | os.PathLike[str], kind: str) -> str:
    """Return the text of a file of at most 4 MiB."""
    path = Path(path)
    if not path.exists():
        raise InputError(f"{kind} {str(path)!r} does not exist")
    try:
        if why := refusal(path, LARGEST_TEXT):
            raise InputError(f"{kind} {str(path)!r} {why}")
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{kind} {str(path)!r} is not UTF-8 text (byte {error.start})") from None
    except OSError as error:
        raise InputError(f"{kind} {str(path)!r} cannot be read: {error.strerror}") from None

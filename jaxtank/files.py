"""Files are written whole or not at all."""

import contextlib
import os
import tempfile
from pathlib import Path

from jaxtank.errors import InputError

LARGEST_TEXT = 4 * 1024 * 1024  # bytes of a rig file


def write_atomic(path, data):
    """Write `data` (str or bytes) to `path` by way of a temporary file in the same folder; a link is not followed."""
    path = Path(path)
    data = data.encode() if isinstance(data, str) else data
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, 0o666 & ~_umask())
        os.replace(name, path)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(name)
        raise


def _umask():
    mask = os.umask(0)
    os.umask(mask)
    return mask


def check_folder(path):
    """Raise InputError unless `path` is, or can become, a folder to write to. Nothing is made yet."""
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise InputError(f"--out {str(path)!r} is a file: give a folder, new or existing")
    parent = path if path.exists() else next((p for p in path.absolute().parents if p.exists()), None)
    if parent is None or not parent.is_dir():
        raise InputError(f"--out {str(path)!r}: {str(parent)!r} is a file, so no folder can be made there")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise InputError(f"--out {str(path)!r}: no permission to write to {str(parent)!r}")


def read_text(path, kind):
    """The text of a file of at most 4 MiB; InputError if it is missing, too large, or not UTF-8."""
    path = Path(path)
    if not path.exists():
        raise InputError(f"{kind} {str(path)!r} does not exist")
    if not path.is_file():
        raise InputError(f"{kind} {str(path)!r} is not a file")
    if path.stat().st_size > LARGEST_TEXT:
        raise InputError(f"{kind} {str(path)!r} has {path.stat().st_size} bytes: at most {LARGEST_TEXT} are read")
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{kind} {str(path)!r} is not UTF-8 text (byte {error.start})") from None
    except OSError as error:
        raise InputError(f"{kind} {str(path)!r} cannot be read: {error.strerror}") from None

"""One run writes to a folder at a time: a lock that ends with its process, and names it."""

import contextlib
import os
import time
from collections.abc import Callable
from pathlib import Path

from jaxtank.core.errors import InputError
from jaxtank.core.files import LOCK, check_folder, sweep

try:
    import fcntl
# no such locks on this system: the user must not start two runs in one folder
except ImportError:
    fcntl = None

PATIENCE = 0.2  # time for which a lock may be in the way [s]: a run that ends needs less


@contextlib.contextmanager
def hold(folder, leaving: Callable = contextlib.nullcontext):
    """Hold `folder`, made if need be, against other runs; None: nothing is held."""
    # flock on a file with the process id: it ends with its process, also after a kill; the next run
    # then sweeps unfinished files. A new folder that stays empty is removed.
    if folder is None or fcntl is None:
        yield
        return
    check_folder(folder)
    folder = Path(folder)
    new = [p for p in (folder, *folder.parents) if not p.exists()]
    opened, file = [], None

    def release():
        """Release the folder if a signal ends the process."""
        if file is not None:
            sweep(folder)
        # without one of ours, a file that was made and not yet locked
        with contextlib.suppress(OSError):
            _let_go(folder / LOCK, *opened or [os.open(folder / LOCK, os.O_RDWR | os.O_NOFOLLOW)])
        tidy()

    def tidy():
        for path in new:  # the innermost first
            with contextlib.suppress(OSError):  # not empty
                path.rmdir()

    try:
        with leaving(release):
            folder.mkdir(parents=True, exist_ok=True)
            file = _locked(folder, opened)
            try:
                sweep(folder)
                yield
            finally:
                _let_go(folder / LOCK, file)
    finally:
        tidy()


def _locked(folder, opened):
    """The open lock file, None where there are no locks; `opened` holds what is open meanwhile."""
    assert fcntl is not None  # `hold` comes no further without it
    path, until = folder / LOCK, time.monotonic() + PATIENCE
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        opened[:] = [file]
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            owner = os.pread(file, 20, 0).decode("ascii", "replace").strip()
            os.close(file)
            if time.monotonic() > until:
                process = f" (process {owner})" if owner.isdigit() else ""
                raise InputError(
                    f"{str(folder)!r}: another run{process} writes there: wait for it, or give"
                    " another folder"
                ) from None
            time.sleep(0.02)
            continue
        except OSError:  # a file system without locks
            os.close(file)
            path.unlink(missing_ok=True)
            return None
        with contextlib.suppress(OSError):
            # else: removed by its last owner before we had it
            if os.fstat(file).st_ino == os.stat(path).st_ino:
                # a full disk: the lock holds without a name on it
                with contextlib.suppress(OSError):
                    os.ftruncate(file, 0)
                    os.pwrite(file, f"{os.getpid()}\n".encode(), 0)
                return file
        os.close(file)


def _let_go(path, file):
    """Remove the lock file and close it."""
    if file is None:
        return
    assert fcntl is not None  # there is a file
    with contextlib.suppress(OSError):
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.unlink(path)
    os.close(file)

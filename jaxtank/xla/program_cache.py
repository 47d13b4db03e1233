"""Compiled programs kept between processes by the cache of jax, in a folder of the user.

Entries hold native code and are unpickled by jax, so every folder above them and every entry is
checked before it is used: its owner and mode, and its digest, which holds its own name too.
"""

import atexit
import hashlib
import os
import platform
import re
import stat
import sys
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jaxtank.core import VERSION

SWITCH = "JAXTANK_CACHE"
OFF = ("0", "off", "false", "no")

LARGEST = 128 * 2**20
"""Bytes of the programs of one version above which those compiled first are removed."""

HALF_WRITTEN = 600.0
"""Age of a temporary file at which no process writes it any more [s]."""

ENTRY, DIGEST = "-cache", ".sha256"
"""Ends of the names of an entry, as jax writes it, and of the digest beside it."""

LAZY = ("-whole-cache", "-text-cache")
"""Ends of the names of entries of this package, whose digests `read` compares; jax reads the others
itself, so theirs are compared when a process begins.
"""

ELSEWHERE = "choose another folder by JAXTANK_CACHE=DIR"
REMEDY = f"remove it, or {ELSEWHERE}"

folder: Path | None = None
"""Where this process keeps its programs, once `cache` or `keep_for_this_process` has said so."""

VERSION_FOLDER = re.compile(r"\d[\w.+]*-[0-9a-f]{12}")
"""Folder of the programs of one version of jaxtank on one sort of processor."""

SETTINGS = {
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}


def cache(folder: str | os.PathLike[str] | None = None) -> Path | None:
    """Keep what this process compiles from here on, and use what was kept before.

    The command `jaxtank` does this by itself; in Python it is opt-in. Results are the same to the
    last bit. A `jax_compilation_cache_dir` that is set already stays.

    Parameters
    ----------
    folder : path, optional
        Where left out: the environment variable JAXTANK_CACHE, else the user's cache folder.

    Returns
    -------
    Path or None
        Folder of the programs of this version and processor; None, with a warning that states why,
        where programs cannot be kept safely, and without one where JAXTANK_CACHE=0 turns this off.

    Examples
    --------
    >>> import jaxtank, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:  # doctest: +SKIP
    ...     jaxtank.cache(folder)
    """
    import jax

    config: Any = jax.config
    if config.jax_compilation_cache_dir:
        return Path(config.jax_compilation_cache_dir)
    prepared, why = prepare(folder)
    if why:
        warnings.warn(f"compiled programs are not kept: {why}", stacklevel=2)
    if prepared is not None:
        config.update("jax_compilation_cache_dir", str(prepared))
        for name, value in SETTINGS.items():
            config.update(name, value)
        _remember(prepared)
    return prepared


def keep_for_this_process() -> str:
    """Do what `cache` does by environment variables, before jax is imported."""
    if "jax" in sys.modules or os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return ""
    folder, why = prepare()
    if folder is not None:
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
        for name, value in SETTINGS.items():
            os.environ.setdefault(name.upper(), str(value))
        _remember(folder)
        # of an entry that another process has removed or is writing: it is compiled again
        words = "Error (reading|writing) persistent compilation cache"
        warnings.filterwarnings("ignore", message=words)
    return why


def _remember(prepared: Path) -> None:
    """Keep whole programs (`jit`) there too."""
    global folder
    folder = prepared


def base_folder(folder: str | os.PathLike[str] | None = None) -> Path | None:
    """Return the folder of all versions; None where JAXTANK_CACHE=0, or there is no home."""
    name = os.environ.get(SWITCH, "") if folder is None else os.fspath(folder)
    if folder is None and name.lower() in OFF:
        return None
    try:
        if name:
            return Path(name).expanduser().absolute()
        home, of = Path.home(), os.environ.get
        if sys.platform == "darwin":
            return home / "Library" / "Caches" / "jaxtank"
        if sys.platform == "win32":
            return Path(of("LOCALAPPDATA") or home / "AppData" / "Local") / "jaxtank" / "cache"
        xdg = of("XDG_CACHE_HOME", "")  # a relative one does not count, by its specification
        return (Path(xdg) if os.path.isabs(xdg) else home / ".cache") / "jaxtank"
    except RuntimeError:  # no home
        return None


def prepare(folder: str | os.PathLike[str] | None = None) -> tuple[Path | None, str]:
    """Return (folder of this version's programs, ""), made and checked, or (None, why not)."""
    # why not is "" where there is nothing that the user could mend, or would want to.
    base = base_folder(folder)
    if base is None:
        return None, ""
    try:
        if not base.exists():
            if not _may_make(base):
                return None, ""
            base.parent.mkdir(parents=True, exist_ok=True)
            base.mkdir(mode=0o700, exist_ok=True)
        why = refused(base)
        if why:
            return None, why
        mine = base.resolve() / f"{VERSION}-{processor()}"
        mine.mkdir(mode=0o700, exist_ok=True)
        why = refused(mine) or _planted(mine)
        if why:
            return None, why
        if not os.access(mine, os.W_OK | os.X_OK):
            return None, ""
        _check_entries(mine)
    except OSError:  # a disk that is full or can be read only
        return None, ""
    atexit.register(seal, mine, time.time() - 1.0)
    return mine, ""


def refused(folder: Path) -> str:
    """Return why native code in a folder cannot be trusted; "" where it can."""
    status, name = os.stat(folder), repr(str(folder))
    if not stat.S_ISDIR(status.st_mode):
        return f"{name} is no folder"
    if sys.platform == "win32":  # the profile of a user is the user's alone
        return ""
    if status.st_uid != os.geteuid():
        return f"{name} belongs to another user: {REMEDY}"
    if mode := stat.S_IMODE(status.st_mode) & 0o077:
        # chmod is no remedy: files that others may have put there cannot be recognised
        return f"{name} is open to other users (mode {0o700 | mode:o}, not 700): {REMEDY}"
    way = dict.fromkeys((*folder.absolute().parents, *folder.resolve().parents))  # of a link, both
    return next((why for above in way if (why := _open_above(above))), "")


def _open_above(folder: Path) -> str:
    """Return why others can exchange what lies in a folder on the way to the programs, or ""."""
    status = os.stat(folder)
    shared = status.st_mode & stat.S_IWOTH
    if status.st_mode & stat.S_IWGRP and status.st_gid not in (0, os.getegid()):
        shared = True  # a group of the user's alone has the user's number in most systems
    if status.st_uid not in (0, os.geteuid()) or (shared and not status.st_mode & stat.S_ISVTX):
        return f"other users can write to {str(folder)!r}: {ELSEWHERE}"
    return ""


def _planted(folder: Path) -> str:
    """Return why the entries of a folder may be the files of another user, or ""."""
    if sys.platform == "win32":
        return ""
    for path in folder.iterdir():
        status = os.lstat(path)
        if not stat.S_ISREG(status.st_mode) or status.st_uid != os.geteuid():
            return f"{str(path)!r} is no file of yours: remove the folder {str(folder)!r}"
    return ""


def seal(folder: Path, since: float) -> None:
    """Write the digest of each entry that was written after `since` [s since 1970]."""
    for path in _entries(folder):
        try:
            if path.stat().st_mtime >= since:
                path.chmod(0o600)
                _digest_of(path).write_text(_digest(path, path.read_bytes()))
                _digest_of(path).chmod(0o600)
        except OSError:  # another process has removed it
            continue


def read(path: Path) -> bytes:
    """Return what an entry of LAZY holds, as it was written; OSError where it is not there."""
    data = path.read_bytes()
    if _digest_of(path).read_text() != _digest(path, data):
        _remove(path)
        raise FileNotFoundError(path)
    return data


def write(path: Path, data: bytes) -> None:
    """Write an entry and its digest, whole or not at all; nothing where the disk is full."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}")
    try:
        temporary.write_bytes(data)
        temporary.chmod(0o600)
        temporary.replace(path)
        _digest_of(path).write_text(_digest(path, data))
        _digest_of(path).chmod(0o600)
    except OSError:
        temporary.unlink(missing_ok=True)


def contents(base: Path) -> dict[str, tuple[int, int]]:
    """Return {folder of a version: (programs, their bytes)} below the folder of all versions."""
    counts: dict[str, tuple[int, int]] = {}
    for folder in _versions(base):
        sizes = [path.stat().st_size for path in _entries(folder)]
        counts[folder.name] = len(sizes), sum(sizes)
    return counts


def clear(base: Path) -> int:
    """Remove the programs of all versions, and nothing else; returns how many there were."""
    count = 0
    for folder in _versions(base):
        for path in _entries(folder):
            _remove(path)
            count += 1
        if not any(folder.iterdir()):
            folder.rmdir()
    return count


def _may_make(base: Path) -> bool:
    """Return False where root would write into another user's home."""
    if sys.platform == "win32" or os.geteuid() != 0:
        return True
    above = next(path for path in base.parents if path.exists())
    return above.stat().st_uid == 0


def processor() -> str:
    """Digest of the processor: native code for another processor may crash."""
    words = [platform.machine(), sys.platform]
    try:
        with open("/proc/cpuinfo") as lines:
            for line in lines:
                if not line.strip():  # the end of the first core
                    break
                if line.split(":")[0].strip() in ("model name", "flags", "Features", "CPU part"):
                    words.append(line)
    except OSError:
        words.append(platform.processor())
    return hashlib.sha256("\n".join(words).encode()).hexdigest()[:12]


def _check_entries(folder: Path) -> None:
    """Remove entries that are damaged, the oldest ones of too many, and what was half written."""
    for path in folder.glob(f"*{ENTRY}.[0-9]*"):
        if path.stat().st_mtime < time.time() - HALF_WRITTEN:
            path.unlink(missing_ok=True)
    sound: list[tuple[float, int, Path]] = []
    for path in _entries(folder):
        try:
            status = path.stat()
            closed = not (status.st_mode | _digest_of(path).stat().st_mode) & 0o022
            good = closed and (
                path.name.endswith(LAZY)
                or _digest_of(path).read_text() == _digest(path, path.read_bytes())
            )
        except OSError:
            good, status = False, None
        if status is None or not good:
            _remove(path)
        else:
            sound.append((status.st_mtime, status.st_size, path))
    total = sum(size for _, size, _ in sound)
    for _, size, path in sorted(sound):
        if total <= LARGEST:
            break
        _remove(path)
        total -= size


def _versions(base: Path) -> list[Path]:
    """Return the folders of versions, of a base that can be trusted."""
    if not base.is_dir() or refused(base):
        return []
    return sorted(p for p in base.iterdir() if VERSION_FOLDER.fullmatch(p.name) and p.is_dir())


def _entries(folder: Path) -> Iterator[Path]:
    return iter(sorted(folder.glob(f"*{ENTRY}")))


def _digest(path: Path, data: bytes) -> str:
    """Return the SHA-256 of an entry, its name and folder: one that is moved is not known."""
    name = f"{path.parent.name}/{path.name}\0".encode()
    return hashlib.sha256(name + data).hexdigest()


def _digest_of(path: Path) -> Path:
    return path.with_name(path.name + DIGEST)


def _remove(path: Path) -> None:
    for file in (path, _digest_of(path)):
        file.unlink(missing_ok=True)

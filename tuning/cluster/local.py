"""A Dask scheduler and workers as processes of this machine, for `--cluster local:N`.
Dask's own LocalCluster would import the user's script anew in each worker.
"""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

from jaxtank.core.errors import InputError
from tuning.cluster.parent import FOLDER

DASK_SETTINGS = {
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "1s",
}
"""Settings of Dask for these processes: its profiler of a worker and the watch on its event loops
take 5 % of the core time. What the user has set stays.
"""

CLOSED = {
    "DASK_DISTRIBUTED__COMM__REQUIRE_ENCRYPTION": "True",
    "DASK_DISTRIBUTED__SCHEDULER__HTTP__ROUTES": "[]",
    "DASK_DISTRIBUTED__WORKER__HTTP__ROUTES": "[]",
}
"""Settings that a user's do not replace: no connection without a key of this run, no pages."""

PATIENCE = 60.0
"""Time within which the scheduler must have started [s]."""


class Workers(NamedTuple):
    """A running scheduler: its address, a function that raises InputError where no worker is left,
    the keys (`distributed.Security`) of its clients, and the words that give a worker its keys."""

    address: str
    check: Any
    security: Any
    words: list[str]


@contextlib.contextmanager
def local_workers(count):
    """Run a scheduler and `count` workers of one thread on this machine, and give its Workers."""
    with tempfile.TemporaryDirectory(prefix="jaxtank-") as folder, contextlib.ExitStack() as stack:
        file, security = Path(folder, "scheduler.json"), _keys()
        common = ["--host", "127.0.0.1", "--no-dashboard", "--dashboard-address", "127.0.0.1:0"]
        common += ["--preload", "tuning.cluster.parent", *_key_files(security, folder)]
        words = ["dask_scheduler", "--port", "0", "--protocol", "tls"]
        words += ["--scheduler-file", str(file), *common]
        scheduler = stack.enter_context(_process(words, folder, {FOLDER: folder}))
        address = _address(file, scheduler)
        words = ["dask_worker", address, "--nthreads", "1", "--no-nanny", "--memory-limit", "0"]
        words += ["--local-directory", folder, "--death-timeout", str(int(PATIENCE)), *common]
        workers = [stack.enter_context(_process(words, folder)) for _ in range(count)]

        def check():
            if all(worker.poll() is not None for worker in workers):
                raise InputError(
                    f"cluster: the workers on this machine have ended ({_last_line(folder)})"
                )

        yield Workers(address, check, security, _key_files(security, folder))


def _keys():
    """A certificate and its key, made anew: who has both is let in."""
    from distributed import Security

    try:
        return Security.temporary()
    except ImportError:
        raise InputError(
            "cluster local: needs keys for its connections: pip install cryptography, or"
            ' ".[cluster]"'
        ) from None


def _key_files(security, folder):
    """Write the keys into a folder of the user's alone; return the words that name them."""
    texts = {"--tls-ca-file": security.tls_ca_file, "--tls-cert": security.tls_worker_cert}
    texts["--tls-key"] = security.tls_worker_key
    words = []
    for option, text in texts.items():
        path = Path(folder, option.lstrip("-") + ".pem")
        path.touch(mode=0o600)
        path.write_text(text)
        words += [option, str(path)]
    return words


@contextlib.contextmanager
def _process(words, folder, more=None):
    """Run one of Dask's command lines until the context ends; more: its own environment."""
    here = str(Path(__file__).parents[2])  # where this program is imported from
    path = os.pathsep.join(filter(None, (here, os.environ.get("PYTHONPATH"))))
    own = {"PYTHONPATH": path, "DASK_TEMPORARY_DIRECTORY": str(folder)}
    with open(Path(folder, "log.txt"), "ab") as log:
        found = subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.{words[0]}", *words[1:]],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=log,
            start_new_session=True,
            env={**DASK_SETTINGS, **os.environ, **CLOSED, **_programs(), **own, **(more or {})},
        )
    try:
        yield found
    finally:
        found.kill()
        found.communicate()


def _programs():
    """Environment by which a worker uses the compiled programs that this process keeps."""
    import jax

    config: Any = jax.config
    folder = config.jax_compilation_cache_dir
    return {"JAX_COMPILATION_CACHE_DIR": str(folder)} if folder else {}


def _address(file, scheduler):
    """Return the address of a scheduler once it has written it."""
    until = time.monotonic() + PATIENCE
    while scheduler.poll() is None and time.monotonic() < until:
        with contextlib.suppress(OSError, ValueError):  # not there, or not yet whole
            return json.loads(file.read_text())["address"]
        time.sleep(0.05)
    why = _last_line(file.parent)
    raise InputError(f"cluster: no Dask scheduler could be started on this machine ({why})")


def _last_line(folder):
    """Return the end of what the processes printed."""
    lines = Path(folder, "log.txt").read_text(errors="replace").split("\n")
    return next(
        (line.strip()[:200] for line in reversed(lines) if line.strip()), "no message was printed"
    )

"""A Dask scheduler and workers as processes of this machine, for `--cluster local:N`.

Imported by `engine`. Dask's own LocalCluster would import the user's script anew in each worker.
"""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from jaxtank.core.errors import InputError

PATIENCE = 60.0
"""Time within which the scheduler must have started [s]."""


@contextlib.contextmanager
def local_workers(count):
    """Run a scheduler and `count` workers of one thread on this machine; gives its address.

    They listen on 127.0.0.1, leave signals of the terminal to this process, and end with it.
    """
    with tempfile.TemporaryDirectory(prefix="jaxtank-") as folder, contextlib.ExitStack() as stack:
        file = Path(folder, "scheduler.json")
        common = ["--host", "127.0.0.1", "--no-dashboard", "--preload", "tuning.cluster.parent"]
        words = ["dask_scheduler", "--port", "0", "--scheduler-file", str(file), *common]
        scheduler = stack.enter_context(_process(words, folder))
        address = _address(file, scheduler)
        words = ["dask_worker", address, "--nthreads", "1", "--no-nanny", "--memory-limit", "0"]
        words += ["--local-directory", folder, "--death-timeout", str(int(PATIENCE)), *common]
        for _ in range(count):
            stack.enter_context(_process(words, folder))
        yield address


@contextlib.contextmanager
def _process(words, folder):
    """Run one of Dask's command lines until the context ends."""
    here = str(Path(__file__).parents[2])  # where this program is imported from
    path = os.pathsep.join(filter(None, (here, os.environ.get("PYTHONPATH"))))
    with open(Path(folder, "log.txt"), "ab") as log:
        found = subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.{words[0]}", *words[1:]],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=log,
            start_new_session=True,
            env={**os.environ, **_programs(), "PYTHONPATH": path},
        )
    try:
        yield found
    finally:
        found.kill()
        found.communicate()


def _programs():
    """Environment by which a worker uses the compiled programs that this process keeps."""
    import jax

    folder = jax.config.jax_compilation_cache_dir
    return {"JAX_COMPILATION_CACHE_DIR": str(folder)} if folder else {}


def _address(file, scheduler):
    """Return the address of a scheduler once it has written it."""
    until = time.monotonic() + PATIENCE
    while scheduler.poll() is None and time.monotonic() < until:
        with contextlib.suppress(OSError, ValueError):  # not there, or not yet whole
            return json.loads(file.read_text())["address"]
        time.sleep(0.05)
    lines = file.with_name("log.txt").read_text(errors="replace").split("\n")
    why = next((line for line in reversed(lines) if line.strip()), "it said nothing")
    raise InputError(f"cluster: no Dask scheduler could be started on this machine ({why[:200]})")

"""A Dask scheduler and workers on this machine, for `--cluster local:N`: closed to all others."""

import contextlib
import logging
import sys
import types
from typing import Any

from jaxtank.core.errors import InputError

SETTINGS = {
    "distributed.comm.require-encryption": True,  # no connection without a key of this run
    "distributed.scheduler.http.routes": [],  # no pages
    "distributed.worker.http.routes": [],
    "distributed.worker.profile.enabled": False,  # it takes 5 % of the core time
    "distributed.admin.tick.interval": "1s",
}
"""Settings of Dask, whatever the user has set."""


@contextlib.contextmanager
def local_workers(count):
    """Run a Dask scheduler, and `count` workers of one thread as processes of this machine."""
    import distributed
    import jax
    from dask import config

    try:
        security = distributed.Security.temporary()
    except ImportError:
        raise InputError(
            "cluster local: needs keys for its connections: pip install cryptography, or"
            ' ".[cluster]"'
        ) from None
    compiler: Any = jax.config  # a worker uses the compiled programs that this process keeps
    programs = {"JAX_COMPILATION_CACHE_DIR": compiler.jax_compilation_cache_dir}
    with config.set(SETTINGS), _without_script():
        cluster = distributed.LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            host="127.0.0.1",
            protocol="tls",
            security=security,
            dashboard_address="127.0.0.1:0",
            scheduler_kwargs={"dashboard": False},
            memory_limit=0,
            env={name: folder for name, folder in programs.items() if folder},
            silence_logs=logging.CRITICAL,
        )
    with cluster:
        for nanny in cluster.workers.values():
            nanny.auto_restart = False
        yield cluster


@contextlib.contextmanager
def _without_script():
    """Hide the user's script from processes that start: they would run it anew."""
    script, sys.modules["__main__"] = sys.modules["__main__"], types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script

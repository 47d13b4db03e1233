"""Tasks on a Dask cluster: a scheduler at an address, or workers of this machine."""

import contextlib
import itertools
import logging
import re
import sys
import time
import warnings
from concurrent.futures import FIRST_COMPLETED, CancelledError, wait
from typing import Any

from jaxtank.core.errors import InputError
from tuning.cluster.local import local_workers

CONNECT = 8.0
"""Time within which a scheduler must answer [s]."""

AHEAD, LEAST = 2, 64
"""Tasks that wait for each thread of the workers, so that none is idle; and tasks sent at least, so
that a cluster that grows with its work does."""

LOOK = 0.5
"""Time between two looks at the connection and at the number of threads [s]."""

MOST = 1024
"""Workers of one machine, at most."""

ENCRYPTED = ("tls://", "wss://")

ADDRESS = re.compile(r"((tcp|tls|ws|wss|ucx)://)?(\[[0-9A-Fa-f:.]+\]|[\w.-]+):\d{1,5}")


class ClusterWarning(UserWarning):
    """Something about a cluster that a user should know; the command prints it as a note."""


TASKS = {
    "batches": ("tuning.uncertainty.batches", "batches"),
    "points": ("tuning.uncertainty.batches", "points"),
    "search": ("tuning.search.methods", "search_task"),
}
"""{name of a task: module and function}; names, texts, numbers and arrays are sent to it."""


def call(task, x64, *arguments):
    """Run a task on a worker."""
    import importlib

    import jax

    import jaxtank  # noqa: F401  it sets the options of the compiler, before jax starts
    from jaxtank.xla.program_cache import processor

    module, name = TASKS[task]
    function = getattr(importlib.import_module(module), name)
    with jax.enable_x64(x64):
        return processor(), function(*arguments)


# Dask sends a function of the main module as its code: a worker without this program then raises
# an error of its own rather than end, and the scheduler needs no more than Dask
call.__module__ = "__main__"


class Engine:
    """Runs tasks on a Dask cluster, by its `concurrent.futures.Executor`; made by `connect`."""

    def __init__(self, client, check=None):
        self.client, self.address, self.check = client, client.scheduler.address, check
        self.processors, self.threads, self.looked = set(), 0, 0.0

    def run(self, task, given, waiting=None):
        """Run a task many times on the workers and yield (number, result) as the results come."""
        import jax

        config: Any = jax.config
        x64, given, pending = bool(config.jax_enable_x64), iter(given), {}
        executor = self.client.get_executor(pure=False)
        try:
            while True:
                self._look(waiting)
                room = max(LEAST, (1 + AHEAD) * self.threads) - len(pending)
                for number, arguments in itertools.islice(given, room):
                    pending[self._submit(executor, task, x64, *arguments)] = number
                if not pending:
                    return
                done = wait(pending, timeout=LOOK, return_when=FIRST_COMPLETED).done
                for future in done:
                    yield pending.pop(future), self._result(future)
        finally:
            with contextlib.suppress(Exception):  # the connection has gone
                executor.shutdown(wait=False)

    def _submit(self, executor, *arguments):
        try:
            return executor.submit(call, *arguments)
        except Exception as error:
            raise self._lost(error) from None

    def _look(self, waiting):
        """Look, now and then, whether the scheduler is there and how many threads it has."""
        now = time.monotonic()
        if now - self.looked < LOOK:
            return
        if waiting is not None:
            waiting()
        if self.client.status != "running":
            raise self._lost()
        try:
            found = sum(self.client.nthreads().values())
        except Exception as error:
            raise self._lost(error) from None
        if not found and self.check is not None:
            self.check()
        elif not found and (self.threads or not self.looked):
            words = "no worker is left" if self.looked else "there is no worker yet"
            warnings.warn(
                f"cluster {self.address}: {words}, waiting for one", ClusterWarning, stacklevel=4
            )
        self.threads, self.looked = found, now

    def _result(self, future):
        """Return what a task returned; raise what it raised, in one line."""
        try:
            processor, found = future.result()
        except ImportError as error:
            raise InputError(
                f"cluster {self.address}: a worker has no jaxtank"
                f" {sys.modules['jaxtank'].__version__} ({error})"
            ) from None
        except (CancelledError, Exception) as error:
            if type(error).__name__ == "KilledWorker":
                raise InputError(
                    f"cluster {self.address}: several workers ended while they ran the same task,"
                    " probably out of memory: start workers with more memory, and --resume DIR"
                ) from None
            if self.client.status != "running" or isinstance(error, CancelledError):
                raise self._lost(error) from None
            raise
        self._same(processor)
        return found

    def _same(self, processor):
        """Warn once where workers have processors of two types."""
        if len(self.processors) == 1 and processor not in self.processors:
            warnings.warn(
                f"cluster {self.address}: workers have different types of processor: numbers may"
                " differ in their last digits from those of one type",
                ClusterWarning,
                stacklevel=5,
            )
        self.processors.add(processor)

    def _lost(self, error=None):
        why = f" ({type(error).__name__})" if error is not None else ""
        return InputError(
            f"cluster {self.address}: the connection to the scheduler was lost{why}; finished"
            " batches are kept if --out DIR was given: continue with --resume DIR"
        )


@contextlib.contextmanager
def connect(cluster):
    """Give an Engine of a cluster, None for None."""
    if cluster is None or isinstance(cluster, Engine):
        yield cluster
        return
    check_cluster(cluster)
    if not isinstance(cluster, str):
        yield Engine(cluster)
        return
    with contextlib.ExitStack() as stack:
        stack.enter_context(_quiet())
        check = security = None
        if cluster.startswith("local:"):
            count = int(cluster.removeprefix("local:"))
            cluster, check, security, _ = stack.enter_context(local_workers(count))
        client = stack.enter_context(_client(cluster, security))
        engine = Engine(client, check)
        if not engine.address.startswith(ENCRYPTED):
            warnings.warn(
                f"cluster {engine.address}: without TLS anybody who reaches this address"
                " can run code as the user of its workers, and of this command: give all of them"
                " certificates and the address as tls://HOST:PORT",
                ClusterWarning,
                stacklevel=3,
            )
        yield engine


def check_cluster(cluster, devices=1):
    """Raise InputError unless `cluster` is what `connect` takes, on one device, with Dask."""
    if cluster is None or isinstance(cluster, Engine):
        return
    if devices > 1:
        raise InputError("cluster and devices: give one of them")
    if isinstance(cluster, str):
        kind, _, count = cluster.partition(":")
        if kind == "local":
            good = count.isdecimal() and 1 <= int(count) <= MOST
        else:
            good = ADDRESS.fullmatch(cluster) is not None
        if not good:
            raise InputError(
                f"cluster = {cluster!r}: must be HOST:PORT of a Dask scheduler, tls://HOST:PORT, or"
                f" local:N for N workers on this machine, from 1 to {MOST}"
            )
    try:
        import distributed
    except ImportError:
        raise InputError(
            'cluster: Dask is not installed: pip install distributed, or ".[cluster]"'
        ) from None
    if not isinstance(cluster, str | distributed.Client) or (
        isinstance(cluster, distributed.Client) and cluster.asynchronous
    ):
        raise InputError(
            f"cluster is a {type(cluster).__name__}: must be an address, local:N, or a"
            " distributed.Client that is not asynchronous"
        )


@contextlib.contextmanager
def _client(address, security=None):
    """Connect to a scheduler, with keys or those that Dask is configured with."""
    import distributed

    options = {"set_as_default": False, "name": "jaxtank", "direct_to_workers": False}
    try:
        client = distributed.Client(address, timeout=CONNECT, security=security, **options)
    except Exception as error:  # no such host, nobody there, no TLS, another protocol
        why = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputError(
            f"cluster {address}: no Dask scheduler answers there within {CONNECT:g} s ({why})"
        ) from None
    try:
        yield client
    finally:
        with contextlib.suppress(Exception):  # the connection has gone
            client.close(timeout=2)


@contextlib.contextmanager
def _quiet():
    """Leave out the log of Dask, which would repeat in many lines what `Engine` says in one."""
    import distributed  # noqa: F401  it sets levels of its own

    known = [name for name in logging.root.manager.loggerDict if name.startswith("distributed")]
    levels = {log: log.level for log in map(logging.getLogger, known)}
    try:
        for log in levels:
            log.setLevel(logging.CRITICAL + 1)
        yield
    finally:
        for log, level in levels.items():
            log.setLevel(level)

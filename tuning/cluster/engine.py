"""Tasks on a Dask cluster: a scheduler at an address, or workers of this machine."""

import contextlib
import logging
import queue
import re
import sys
import time
import warnings
from typing import Any

from jaxtank.core.errors import InputError
from tuning.cluster.local import local_workers
from tuning.cluster.task import call

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


class Engine:
    """Runs tasks on a Dask cluster; made by `connect`."""

    def __init__(self, client, check=None):
        self.client, self.address, self.check = client, client.scheduler.address, check
        self.processors, self.threads, self.looked = set(), 0, 0.0

    def run(self, task, given, waiting=None):
        """Run a task many times on the workers and yield (number, result) as the results come."""
        import jax

        config: Any = jax.config
        x64, done = bool(config.jax_enable_x64), queue.SimpleQueue()
        given, pending = iter(given), {}

        def send(number, arguments):
            future = self._submit(task, x64, arguments)
            pending[future.key] = number, arguments, future
            future.add_done_callback(done.put)

        try:
            while True:
                self._look(waiting)
                while len(pending) < max(LEAST, (1 + AHEAD) * self.threads):
                    number, arguments = next(given, (None, None))
                    if arguments is None:
                        break
                    send(number, arguments)
                if not pending:
                    return
                with contextlib.suppress(queue.Empty):
                    future = done.get(timeout=LOOK)
                    number, arguments, _ = pending.pop(future.key)
                    found = self._result(future, waiting)
                    if found is None:  # lost with its worker
                        send(number, arguments)
                    else:
                        yield number, found[0]
        finally:
            with contextlib.suppress(Exception):  # the connection has gone
                self.client.cancel([future for *_, future in pending.values()])

    def _submit(self, task, x64, arguments):
        try:
            return self.client.submit(call, task, x64, *arguments, pure=False)
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

    def _result(self, future, waiting):
        """Return (what a task returned,), None where that was lost with its worker; raise what it
        raised, in one line.
        """
        while future.status == "finished":
            try:
                processor, found = future.result(timeout=CONNECT)
            except TimeoutError:  # its worker has gone: is there another one?
                self._look(waiting)
                continue
            except Exception as error:
                if future.status == "lost":
                    return None
                raise self._lost(error) from None
            self._same(processor)
            return (found,)
        if future.status in ("lost", "pending") and self.client.status == "running":
            return None
        if future.status != "error":
            raise self._lost()
        error = future.exception()
        if type(error).__name__ == "KilledWorker":
            raise InputError(
                f"cluster {self.address}: several workers ended while they ran the same task,"
                " probably out of memory: start workers with more memory, and --resume DIR"
            )
        if isinstance(error, ImportError):
            raise InputError(
                f"cluster {self.address}: a worker has no jaxtank"
                f" {sys.modules['jaxtank'].__version__} ({error})"
            )
        raise error

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


def check_cluster(cluster):
    """Raise InputError unless `cluster` is something that `connect` takes, and Dask is
    installed.
    """
    if cluster is None or isinstance(cluster, Engine):
        return
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


def check_alone(cluster, **other):
    """Raise InputError for a cluster that cannot be used, or beside what does not go with one."""
    # other : {what does not: whether it is given}
    if cluster is None:
        return
    for name, given in other.items():
        if given:
            raise InputError(f"cluster and {name}: give one of them")
    check_cluster(cluster)


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

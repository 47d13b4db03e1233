"""Tasks on any `concurrent.futures.Executor`, or on a Dask cluster (an address, or local)."""

import contextlib
import importlib
import itertools
import logging
import re
import sys
import types
import warnings
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, wait
from typing import Any

from jaxtank.core.errors import InputError

SETTINGS = {  # settings of Dask, whatever the user has set
    "distributed.comm.require-encryption": True,  # no connection without a key of this run
    "distributed.scheduler.http.routes": [],  # no pages
    "distributed.worker.http.routes": [],
    "distributed.worker.profile.enabled": False,  # it takes 5 % of the core time
    "distributed.admin.tick.interval": "1s",
}


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


CONNECT = 8.0  # time within which a scheduler must answer [s]
AT_ONCE = 1024  # largest number of tasks under way at once, and of workers on one machine
LOOK = 0.5  # time after which the workers are looked at, where no result has come [s]

ENCRYPTED = ("tls://", "wss://")

ADDRESS = re.compile(r"((tcp|tls|ws|wss|ucx)://)?(\[[0-9A-Fa-f:.]+\]|[\w.-]+):\d{1,5}")


class ClusterWarning(UserWarning):
    """Something about a cluster that a user should know; the command prints it as a note."""


TASKS = {  # {name of a task: module and function}; names, texts, numbers and arrays are sent to it
    "batches": ("tuning.uncertainty.batches", "batches"),
    "search": ("tuning.search.methods", "search_task"),
}


def call(task, x64, *arguments):
    """Run a task on a worker."""
    import jax

    import jaxtank  # noqa: F401  it sets the options of the compiler, before jax starts
    from jaxtank.xla.program_cache import processor

    module, name = TASKS[task]
    function = getattr(importlib.import_module(module), name)
    with jax.enable_x64(x64):
        return processor(), function(*arguments)


# sent as code, so that a worker without this program raises an error and continues to run
call_by_code = types.FunctionType(call.__code__, {"TASKS": TASKS, "importlib": importlib})
call_by_code.__module__ = "__main__"


class Engine:
    """Runs tasks on an Executor; made by `connect`."""

    name, function = "cluster", staticmethod(call)

    def __init__(self, executor):
        self.executor, self.processors = executor, set()

    def run(self, task, arguments, waiting=None):
        """Run a task for every (number, arguments); yield (number, result) as the results come."""
        import jax

        config: Any = jax.config
        x64, arguments, pending = bool(config.jax_enable_x64), iter(arguments), {}
        try:
            while True:
                for number, values in itertools.islice(arguments, AT_ONCE - len(pending)):
                    pending[self.submit(task, x64, *values)] = number
                if not pending:
                    return
                wait(pending, timeout=LOOK, return_when=FIRST_COMPLETED)
                done = [future for future in pending if future.done()]  # cancelled ones, too
                for future in done:
                    yield pending.pop(future), self._result(future)
                if waiting is not None:
                    waiting()
                if not done:
                    self.look()
        finally:
            for future in pending:
                future.cancel()

    def submit(self, *arguments):
        """Return the future of a task."""
        try:
            return self.executor.submit(self.function, *arguments)
        except Exception as error:
            raise self.lost(error) from None

    def look(self):
        """Warn, or raise InputError, where there is no worker."""

    def _result(self, future):
        """Return the result of a task, or raise its error in one line."""
        try:
            processor, result = future.result()
        except ImportError as error:
            version = sys.modules["jaxtank"].__version__
            raise InputError(f"{self.name}: a worker has no jaxtank {version} ({error})") from None
        except (CancelledError, BrokenExecutor) as error:
            raise self.lost(error) from None
        except Exception as error:
            if type(error).__name__ != "KilledWorker":
                raise
            raise InputError(
                f"{self.name}: several workers ended while they ran the same task, probably out of"
                " memory: start workers with more memory, and --resume DIR"
            ) from None
        if len(self.processors | {processor}) > len(self.processors) == 1:
            warnings.warn(
                f"{self.name}: workers have different types of processor: numbers may differ in"
                " their last digits",
                ClusterWarning,
                stacklevel=5,
            )
        self.processors.add(processor)
        return result

    def lost(self, error):
        """Return the error for workers that are out of reach."""
        return InputError(
            f"{self.name}: the connection to the workers was lost ({type(error).__name__});"
            " finished batches are kept if --out DIR was given: continue with --resume DIR"
        )


class DaskEngine(Engine):
    """Runs tasks on the workers of a Dask client; local: on this machine, where none is added."""

    function = staticmethod(call_by_code)

    def __init__(self, client, local=False):
        super().__init__(client.get_executor(pure=False))
        self.client, self.local, self.idle = client, local, False
        self.address = client.scheduler.address
        self.name = f"cluster {self.address}"

    def look(self):
        try:
            idle = not self.client.nthreads()
        except Exception as error:
            raise self.lost(error) from None
        if idle and self.local:
            raise InputError(f"{self.name}: the workers on this machine have ended")
        if idle and not self.idle:
            message = f"{self.name}: there is no worker, waiting for one"
            warnings.warn(message, ClusterWarning, stacklevel=4)
        self.idle = idle


@contextlib.contextmanager
def connect(cluster):
    """Give an Engine of a cluster or an Executor, None for None."""
    if cluster is None or isinstance(cluster, Engine):
        yield cluster
        return
    check_cluster(cluster)
    if not isinstance(cluster, str):
        yield Engine(cluster) if isinstance(cluster, Executor) else DaskEngine(cluster)
        return
    with contextlib.ExitStack() as stack:
        stack.enter_context(_quiet())
        address, security, local = cluster, None, cluster.startswith("local:")
        if local:
            address = stack.enter_context(local_workers(int(cluster.removeprefix("local:"))))
            security = address.security
        engine = DaskEngine(stack.enter_context(_client(address, security)), local)
        if not engine.address.startswith(ENCRYPTED):
            warnings.warn(
                f"{engine.name}: without TLS anybody who reaches this address can run code as the"
                " user of its workers, and of this command: give all of them certificates and the"
                " address as tls://HOST:PORT",
                ClusterWarning,
                stacklevel=3,
            )
        yield engine


def check_cluster(cluster, devices=1):
    """Raise InputError unless `cluster` is what `connect` takes, on one device."""
    if cluster is None or isinstance(cluster, Engine):
        return
    if devices > 1:
        raise InputError("cluster and devices: give one of them")
    if isinstance(cluster, Executor):
        return
    if isinstance(cluster, str):
        kind, _, count = cluster.partition(":")
        good = ADDRESS.fullmatch(cluster) is not None
        if kind == "local":
            good = count.isdecimal() and 1 <= int(count) <= AT_ONCE
        if not good:
            raise InputError(
                f"cluster = {cluster!r}: must be HOST:PORT of a Dask scheduler, tls://HOST:PORT, or"
                f" local:N for N workers on this machine, from 1 to {AT_ONCE}"
            )
    try:
        import distributed
    except ImportError:
        raise InputError(
            'cluster: Dask is not installed: pip install distributed, or ".[cluster]"'
        ) from None
    synchronous = isinstance(cluster, distributed.Client) and not cluster.asynchronous
    if not isinstance(cluster, str) and not synchronous:
        raise InputError(
            f"cluster is a {type(cluster).__name__}: must be an address, local:N, a"
            " concurrent.futures.Executor, or a distributed.Client that is not asynchronous"
        )


@contextlib.contextmanager
def _client(address, security):
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

    names = [name for name in logging.root.manager.loggerDict if name.startswith("distributed")]
    levels = {log: log.level for log in map(logging.getLogger, names)}
    try:
        for log in levels:
            log.setLevel(logging.CRITICAL + 1)
        yield
    finally:
        for log, level in levels.items():
            log.setLevel(level)

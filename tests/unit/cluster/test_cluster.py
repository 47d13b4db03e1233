"""Studies and searches on executors and Dask workers: the bits of one process, whatever happens.

One cluster serves the file; one of its workers is killed.
"""

import asyncio
import dataclasses
import multiprocessing
import os
import signal
import subprocess
import sys
import time
import urllib.request
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor

import jax
import numpy as np
import pytest
from fault_drill import kept
from helpers import command

import tuning
from jaxtank import presets, rig
from jaxtank.core.errors import InputError
from tuning.cluster import engine as engines
from tuning.cluster.engine import connect, local_workers
from tuning.cluster.sent import received, sent
from tuning.problem.functions import as_measures
from tuning.uncertainty import batches

distributed = pytest.importorskip("distributed", reason="Dask is not installed")
psutil = pytest.importorskip("psutil", reason="Dask is not installed")

SPREAD = {"plant.drain": 0.05, "plant.pump_gain": tuning.Normal(relative=0.05)}
OPTIONS = {"samples": 400, "key": 3, "batch": 16, "fan": False}  # 25 batches
SEARCH = tuning.Options(starts=2, screening=8, validation=0)


@pytest.fixture(scope="module")
def case():
    short = {"clock.dt": 4.0, "clock.duration": 200.0, "sensor.noise": 0.02}
    return rig.set_values(presets.find("cascaded/pi"), short)


@pytest.fixture(scope="module")
def whole(case):
    return tuning.ensemble(case, SPREAD, **OPTIONS)


@pytest.fixture(scope="module")
def client():
    """The client of two workers of `local:2`."""
    with connect("local:2") as engine:
        yield engine.client


class Counting(ThreadPoolExecutor):
    """Two threads; `sizes` are the numbers of batches of the tasks that were sent."""

    def __init__(self):
        super().__init__(2)
        self.sizes = []

    def submit(self, function, *arguments):
        self.sizes.append(len(arguments[-1]))
        return super().submit(function, *arguments)


class Refusing(Executor):
    """An executor to which nothing may be sent."""

    def submit(self, *_):
        raise AssertionError("something was sent")


def same(a, b):
    return list(a.measures) == list(b.measures) and all(
        np.array_equal(a.measures[m], b.measures[m], equal_nan=True) for m in a.measures
    )


def test_short_batches_share_a_task_and_change_no_bit(case, whole, monkeypatch):
    monkeypatch.setattr(batches, "SHARES", 6)
    with Counting() as pool:
        assert same(tuning.ensemble(case, SPREAD, **OPTIONS, cluster=pool), whole)
        assert pool.sizes == [4] * 6 + [1]
        monkeypatch.setattr(batches, "WORK", 2 * 16 * case.clock.samples)
        assert same(tuning.ensemble(case, SPREAD, **OPTIONS, cluster=pool), whole)
        assert pool.sizes[7:] == [2] * 12 + [1]


@pytest.mark.slow
def test_processes_give_the_bits_of_one(case, whole):
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        assert same(tuning.ensemble(case, SPREAD, **OPTIONS, cluster=pool), whole)


def listening(pid):
    """{address} on which a process waits for connections."""
    connections = psutil.Process(pid).net_connections(kind="inet")
    return {c.laddr for c in connections if c.status == psutil.CONN_LISTEN}


async def connected(address, keys):
    """Connect to a process of Dask, with its handshake."""
    comm = await asyncio.wait_for(distributed.comm.connect(address, timeout=0.7, **keys), 10)
    await comm.close()


@pytest.mark.slow
def test_local_workers_listen_on_this_machine_alone_and_to_their_own_client_alone(client):
    pids = [os.getpid(), *client.run(os.getpid).values()]
    listeners = set().union(*map(listening, pids))
    assert len(listeners) >= 2 * len(pids) - 1
    assert {address.ip for address in listeners} == {"127.0.0.1"}
    strange = distributed.Security.temporary().get_connection_args("client")
    for ip, port in listeners:
        for address, keys in ((f"tcp://{ip}:{port}", {}), (f"tls://{ip}:{port}", strange)):
            with pytest.raises(OSError):
                asyncio.run(connected(address, keys))
        for path in ("/json/identity.json", "/info/main/workers.html", "/health", "/"):
            with pytest.raises(OSError):  # refused, or no page of that name
                urllib.request.urlopen(f"http://{ip}:{port}{path}", timeout=2)


@pytest.mark.slow
def test_a_worker_that_is_killed_in_mid_run_changes_no_bit(case, whole, client, tmp_path):
    victim, pid = next(iter(client.run(os.getpid).items()))
    counts, folder = [], tmp_path / "run"

    def progress(done):
        counts.append(done)
        if len(counts) == 3:
            os.kill(pid, signal.SIGKILL)

    found = tuning.ensemble(
        case, SPREAD, **OPTIONS, cluster=client, checkpoint=folder, progress=progress
    )
    assert same(found, whole)
    assert counts == sorted(counts) and counts[-1] == 400 and len(counts) == 25
    assert kept(folder) == 25  # written by this process as they came
    assert victim not in client.nthreads()


@pytest.mark.slow
def test_sensitivity_on_workers_is_that_of_one_process(case):
    options = {"method": "morris", "samples": 8, "measures": ["rms_error", "max_level"], "batch": 8}
    spread = {"plant.drain": 0.05, "plant.area": 0.05}
    here = tuning.sensitivity(case, spread, **options)
    with Counting() as pool:
        there = tuning.sensitivity(case, spread, **options, cluster=pool)
        assert sum(pool.sizes) == -(-(8 * 4 + 1) // 8)
    assert (there.runs, there.failed, there.parameters) == (here.runs, 0, here.parameters)
    assert repr(there.columns) == repr(here.columns)


def answer(result):
    return result.parameters, result.objective, result.evaluations, result.starts, result.history


@pytest.mark.slow
def test_searches_on_workers_lead_to_the_answer_of_one_process(case, tmp_path):
    """And a search that is continued sends what its log lacks, and no more."""
    whole = repr(answer(tuning.tune(case, SEARCH, checkpoint=tmp_path)))
    on = lambda cluster: dataclasses.replace(SEARCH, cluster=cluster)
    again = tuning.tune(case, on(Refusing()), checkpoint=tmp_path, resume=True)
    assert repr(answer(again)) == whole
    with pytest.raises(InputError, match="AssertionError"):
        tuning.tune(case, on(Refusing()))
    with Counting() as pool:
        assert repr(answer(tuning.tune(case, on(pool)))) == whole
        assert len(pool.sizes) == SEARCH.starts


@pytest.mark.slow
def test_robust_searches_on_workers_lead_to_the_answer_of_one_process(case):
    robust = lambda method: tuning.tune_robust(case, SPREAD, samples=4, fresh=16, method=method)
    with Counting() as pool:
        there = robust(dataclasses.replace(SEARCH, cluster=pool))
    assert repr(answer(there)) == repr(answer(robust(SEARCH)))


def test_workers_that_are_lost_are_one_line_and_the_run_goes_on(case, whole, tmp_path):
    pool = ThreadPoolExecutor(1)
    options = {"checkpoint": tmp_path, "cluster": pool}
    with pytest.raises(InputError, match=r"^cluster: the connection .* lost .*--resume DIR$"):
        tuning.ensemble(
            case,
            SPREAD,
            **OPTIONS,
            **options,
            progress=lambda done: done == 64 and pool.shutdown(cancel_futures=True),
        )
    assert 4 <= kept(tmp_path) < 25
    assert same(tuning.ensemble(case, SPREAD, **OPTIONS, checkpoint=tmp_path, resume=True), whole)


SCHEDULER = ["-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0"]


@pytest.mark.slow
def test_a_lost_scheduler_is_one_line(case, tmp_path):
    file = tmp_path / "scheduler.json"
    words = [sys.executable, *SCHEDULER, "--scheduler-file", str(file), "--no-dashboard"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    scheduler = subprocess.Popen(words, **quiet)
    words = [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", str(file)]
    worker = subprocess.Popen([*words, "--no-nanny", "--death-timeout", "5"], **quiet)
    try:
        with (
            distributed.Client(scheduler_file=str(file), timeout=60) as client,
            pytest.raises(InputError, match=r"^cluster tcp://.* lost .*--resume DIR$"),
        ):
            tuning.ensemble(
                case,
                SPREAD,
                **OPTIONS,
                cluster=client,
                progress=lambda done: done == 64 and scheduler.kill(),
            )
    finally:
        for process in (scheduler, worker):
            process.kill()
            process.wait()


@pytest.mark.slow
def test_processes_of_local_end_with_the_one_that_began_them(tmp_path):
    code = (
        "import os, time\nfrom tuning.cluster.engine import connect\n"
        "with connect('local:1') as engine:\n"
        "    print(*engine.client.run(os.getpid).values(), flush=True)\n"
        "    time.sleep(60)\n"
    )
    begun = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    (pid,) = map(int, begun.stdout.readline().split())
    begun.kill()
    begun.communicate()
    deadline = time.monotonic() + 20
    while psutil.pid_exists(pid) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE


def test_a_scheduler_without_certificates_is_a_warning():
    options = {"n_workers": 1, "processes": False, "protocol": "tcp", "dashboard_address": None}
    with (
        distributed.LocalCluster(**options) as cluster,
        pytest.warns(engines.ClusterWarning, match="can run code as the user of its workers"),
        connect(cluster.scheduler_address),
    ):
        pass


# what is refused, before anything is run or written


@pytest.mark.parametrize(
    "cluster", ["", "local", "local:", "local:0", "local:2000", "host", "host:", "http://a:1", 5]
)
def test_what_is_no_cluster_is_refused(case, cluster):
    with pytest.raises(InputError, match=r"^cluster (=|is)"):
        tuning.ensemble(case, SPREAD, **OPTIONS, cluster=cluster)


def test_where_nobody_answers_is_an_error_in_time(case, monkeypatch, tmp_path):
    assert engines.CONNECT <= 9.0
    monkeypatch.setattr(engines, "CONNECT", 0.5)
    nobody = tuning.Options(cluster="127.0.0.1:1")
    for run, options in (
        (tuning.ensemble, {"cluster": "127.0.0.1:1"}),
        (tuning.tune, {"method": nobody}),
        (tuning.tune_robust, {"method": nobody}),
    ):
        with pytest.raises(InputError, match=r"^cluster 127.0.0.1:1: no Dask scheduler answers"):
            run(case, **options, checkpoint=tmp_path / "run")
    assert not any(tmp_path.iterdir())


def test_what_is_not_installed_is_named(case, monkeypatch):
    monkeypatch.setitem(sys.modules, "cryptography", None)
    with pytest.raises(InputError, match="pip install cryptography"), local_workers(1):
        pass
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install distributed"):
        tuning.ensemble(case, SPREAD, cluster="local:2")


def test_classes_and_functions_of_ones_own_are_not_sent(case):
    @dataclasses.dataclass(frozen=True)
    class Mine(type(case.loop.controller)):
        pass

    mine = Mine(**{f.name: getattr(case.loop.controller, f.name) for f in dataclasses.fields(Mine)})
    with pytest.raises(InputError, match=r"^cluster: workers get a case as its rig file"):
        sent(case.replace(loop=dataclasses.replace(case.loop, controller=mine)))
    objective, _ = as_measures(lambda measures: measures["ise"][0], None)
    with pytest.raises(InputError, match=r"^cluster: "):
        sent(case, tuple(objective))


def test_a_worker_that_differs_is_refused(case, monkeypatch):
    text = sent(case)
    assert np.array_equal(*(jax.tree.leaves(c.loop)[0] for c in (received(text), case)))
    received.cache_clear()
    monkeypatch.setattr("jaxtank.__version__", "0.0.0")
    with pytest.raises(InputError, match=r"a worker differs .*: jaxtank \(0\.0\.0 there,"):
        received(text)
    monkeypatch.setenv("XLA_FLAGS", "")  # as where jax had started first
    with pytest.raises(InputError, match=r"jax had started on this worker before jaxtank"):
        received(text)


@pytest.mark.slow_for("tune")
@pytest.mark.parametrize("words", ["uncertainty", "sensitivity --method morris", "tune"])
def test_the_command_refuses_what_is_no_cluster_in_one_line(words, tmp_path):
    name, *more = words.split()
    options = ["--cluster", "local:x", "--out", str(tmp_path / "run")]
    found = command(name, "cascaded/pi", *more, *options)
    assert found.code == 2 and found.out == "" and found.err.count("\n") == 1
    assert "local:x" in found.err and not any(tmp_path.iterdir())

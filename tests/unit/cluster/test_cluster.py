"""Studies and searches on Dask workers: the bits of one process, whatever happens to the workers.

One cluster serves the file; workers are killed as it goes on, the scheduler last.
"""

import asyncio
import contextlib
import dataclasses
import os
import signal
import subprocess
import sys
import time
import urllib.request
import warnings
from pathlib import Path

import jax
import numpy as np
import pytest
from fault_drill import kept
from helpers import command

import tuning
from jaxtank import presets, rig
from jaxtank.core.errors import InputError
from tuning.cluster import engine as engines
from tuning.cluster import parent
from tuning.cluster.engine import Engine
from tuning.cluster.local import local_workers
from tuning.cluster.sent import received, sent
from tuning.problem.functions import as_measures
from tuning.problem.problem import Problem
from tuning.uncertainty import batches

distributed = pytest.importorskip("distributed", reason="Dask is not installed")
psutil = pytest.importorskip("psutil", reason="Dask is not installed")

SPREAD = {"plant.drain": 0.05, "plant.pump_gain": tuning.Normal(relative=0.05)}
OPTIONS = {"samples": 400, "key": 3, "batch": 16, "fan": False}  # 25 batches
SEARCH = {"nominal": True, "starts": 2, "screening": 8, "validation": 0}


@pytest.fixture(scope="module")
def case():
    short = {"clock.dt": 4.0, "clock.duration": 200.0, "sensor.noise": 0.02}
    return rig.set_values(presets.find("cascaded/pi"), short)


@pytest.fixture(scope="module")
def whole(case):
    return tuning.ensemble(case, SPREAD, **OPTIONS)


@pytest.fixture(scope="module")
def client():
    """A client of two workers."""
    with local_workers(2) as workers:
        client = distributed.Client(workers.address, security=workers.security)
        with client, warnings.catch_warnings():
            client.workers = workers
            client.wait_for_workers(2, timeout=60)
            yield client


class Refusing(Engine):
    """A cluster to which nothing may be sent."""

    def __init__(self):
        pass

    def run(self, *_):
        raise AssertionError("something was sent")


def same(a, b):
    return list(a.measures) == list(b.measures) and all(
        np.array_equal(a.measures[m], b.measures[m], equal_nan=True) for m in a.measures
    )


def test_a_worker_killed_and_one_added_in_mid_run_change_no_bit(case, whole, client, tmp_path):
    victim, pid = next(iter(client.run(os.getpid).items()))
    added, seen = [], []

    def progress(done):
        seen.append(done)
        if len(seen) == 3:
            os.kill(pid, signal.SIGKILL)
            words = [sys.executable, "-m", "distributed.cli.dask_worker", client.scheduler.address]
            words += ["--no-nanny", "--nthreads", "1", "--no-dashboard", "--death-timeout", "30"]
            words += client.workers.words
            quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
            added.append(subprocess.Popen(words, cwd=tmp_path, **quiet))

    folder = tmp_path / "run"
    try:
        found = tuning.ensemble(
            case, SPREAD, **OPTIONS, cluster=client, checkpoint=folder, progress=progress
        )
        assert same(found, whole)
        assert seen == sorted(seen) and seen[-1] == 400 and len(seen) == 25
        assert kept(folder) == 25  # written by this process as they came
        assert victim not in client.nthreads()
    finally:
        for process in added:
            process.kill()
            process.wait()


def test_short_batches_share_a_task_and_change_no_bit(case, whole, client, monkeypatch):
    sent_tasks, submit = [], Engine._submit
    monkeypatch.setattr(Engine, "_submit", lambda *a: sent_tasks.append(len(a[-1])) or submit(*a))
    monkeypatch.setattr(batches, "SHARES", 6)
    assert same(tuning.ensemble(case, SPREAD, **OPTIONS, cluster=client), whole)
    assert sent_tasks == [4] * 6 + [1]
    monkeypatch.setattr(batches, "WORK", 2 * 16 * case.clock.samples)
    assert same(tuning.ensemble(case, SPREAD, **OPTIONS, cluster=client), whole)
    assert sent_tasks[7:] == [2] * 12 + [1]


def test_sensitivity_on_workers_is_that_of_one_process(case, client):
    options = {"method": "morris", "samples": 8, "measures": ["rms_error", "max_level"], "batch": 8}
    here = tuning.sensitivity(case, {"plant.drain": 0.05, "plant.area": 0.05}, **options)
    there = tuning.sensitivity(
        case, {"plant.drain": 0.05, "plant.area": 0.05}, **options, cluster=client
    )
    assert (there.runs, there.failed, there.parameters) == (here.runs, 0, here.parameters)
    assert repr(there.columns) == repr(here.columns)
    assert client.status == "running"  # one that was given stays open


def answer(result):
    return result.parameters, result.objective, result.evaluations, result.starts, result.history


@pytest.mark.parametrize("robust", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_searches_on_workers_lead_to_the_answer_of_one_process(case, client, monkeypatch, robust):
    """And it is the workers that evaluate: what is left here is before and after the searches."""

    def run(cluster):
        evaluated, point = [], Problem._point
        with monkeypatch.context() as patch:
            patch.setattr(Problem, "_point", lambda *a: evaluated.append(len(a[2])) or point(*a))
            if robust:
                options = {**SEARCH, "samples": 4, "fresh": 16, "cluster": cluster}
                del options["nominal"]
                found = tuning.tune_robust(case, SPREAD, **options)
            else:
                found = tuning.tune(case, **SEARCH, cluster=cluster)
        return found, len(evaluated)

    (here, many), (there, few) = run(None), run(client)
    assert repr(answer(there)) == repr(answer(here))
    searched = sum(start["evaluations"] for start in here.starts[: SEARCH["starts"]])
    assert searched > 5 and many - few >= searched - 2


def test_what_is_known_is_not_sent_again(case, tmp_path):
    """A search that is continued runs what its log lacks, and no more."""
    whole = tuning.tune(case, **SEARCH, checkpoint=tmp_path)
    again = tuning.tune(case, **SEARCH, checkpoint=tmp_path, resume=True, cluster=Refusing())
    assert repr(answer(again)) == repr(answer(whole))
    with pytest.raises(AssertionError, match="was sent"):
        tuning.tune(case, **SEARCH, cluster=Refusing())


def test_a_lost_scheduler_is_one_line_and_the_run_goes_on_from_its_folder(case, whole, tmp_path):
    with (
        local_workers(1) as workers,
        distributed.Client(workers.address, security=workers.security) as client,
    ):
        pid = client.run_on_scheduler(os.getpid)

        def progress(done):
            if done == 64:
                os.kill(pid, signal.SIGKILL)

        with (
            pytest.raises(InputError, match=r"^cluster tls://.*scheduler was lost.*--resume DIR$"),
            warnings.catch_warnings(action="ignore", category=engines.ClusterWarning),
        ):
            tuning.ensemble(
                case, SPREAD, **OPTIONS, cluster=client, checkpoint=tmp_path, progress=progress
            )
    assert 4 <= kept(tmp_path) < 25
    assert same(tuning.ensemble(case, SPREAD, **OPTIONS, checkpoint=tmp_path, resume=True), whole)


def test_a_process_of_local_ends_with_the_pipe_from_its_parent(tmp_path):
    (tmp_path / "of" / "dask").mkdir(parents=True)
    code = "import time; from tuning.cluster import parent; parent.dask_setup(None); time.sleep(60)"
    begun = subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        env={**os.environ, parent.FOLDER: str(tmp_path / "of")},
    )
    time.sleep(0.2)
    assert begun.poll() is None
    begun.stdin.close()
    assert begun.wait(timeout=20) == 0 and not any(tmp_path.iterdir())


@pytest.mark.slow
def test_processes_of_local_end_with_the_one_that_began_them(tmp_path):
    code = (
        "import time\nfrom tuning.cluster.local import local_workers\n"
        "with local_workers(1) as workers:\n"
        "    import distributed\n"
        "    client = distributed.Client(workers.address, security=workers.security)\n"
        "    client.wait_for_workers(1, timeout=60)\n"
        "    import os\n"
        "    print(client.run_on_scheduler(os.getpid), *client.run(os.getpid).values())\n"
        "    print(flush=True)\n"
        "    time.sleep(60)\n"
    )
    begun = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(tmp_path)},
    )
    pids = list(map(int, begun.stdout.readline().split()))
    assert len(pids) == 2 and len(list(tmp_path.glob("jaxtank-*"))) == 1
    begun.kill()
    begun.communicate()
    deadline = time.monotonic() + 20
    while (any(map(alive, pids)) or any(tmp_path.iterdir())) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not any(map(alive, pids)) and not any(tmp_path.iterdir())


def listening(pid):
    """{address} on which a process waits for connections."""
    connections = psutil.Process(pid).net_connections(kind="inet")
    return {c.laddr for c in connections if c.status == psutil.CONN_LISTEN}


async def connected(address, keys):
    """Connect to a process of Dask, with its handshake."""
    comm = await asyncio.wait_for(distributed.comm.connect(address, timeout=0.7, **keys), 10)
    await comm.close()


def test_local_workers_listen_on_this_machine_alone_and_to_their_own_client_alone(client):
    pids = [client.run_on_scheduler(os.getpid), *client.run(os.getpid).values()]
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
    folder = Path(client.workers.words[1]).parent
    assert folder.stat().st_mode & 0o077 == 0
    assert all(path.stat().st_mode & 0o077 == 0 for path in folder.glob("*.pem"))


def test_the_command_with_local_workers_opens_nothing_to_others(case, tmp_path):
    """Through the command: every socket of its processes, while it runs."""
    rig.save(case, tmp_path / "rig.toml")
    words = [sys.executable, "-m", "jaxtank", "uncertainty", str(tmp_path / "rig.toml")]
    words += ["--samples", "200000", "--cluster", "local:1"]
    begun = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    listeners, until = set(), time.monotonic() + 120
    try:
        while len(listeners) < 3 and begun.poll() is None and time.monotonic() < until:
            for process in psutil.Process(begun.pid).children(recursive=True):
                with contextlib.suppress(psutil.Error):
                    listeners |= listening(process.pid)
            time.sleep(0.2)
    finally:
        begun.kill()
        begun.wait()
    assert len(listeners) >= 3 and {address.ip for address in listeners} == {"127.0.0.1"}


def test_a_scheduler_without_certificates_is_a_warning(case, whole):
    with (
        distributed.LocalCluster(
            n_workers=1, processes=False, protocol="tcp", dashboard_address=None
        ) as cluster,
        pytest.warns(engines.ClusterWarning, match="can run code as the user of its workers"),
        engines.connect(cluster.scheduler_address),
    ):
        pass


def test_without_cryptography_the_remedy_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "cryptography", None)
    with pytest.raises(InputError, match="pip install cryptography"), local_workers(1):
        pass


def alive(pid):
    """Whether a process runs; one that has ended and waits for its parent does not."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


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
    for run in (tuning.ensemble, tuning.tune, tuning.tune_robust):
        with pytest.raises(InputError, match=r"^cluster 127.0.0.1:1: no Dask scheduler answers"):
            run(case, cluster="127.0.0.1:1", checkpoint=tmp_path / "run")
    assert not any(tmp_path.iterdir())


def test_without_dask_the_remedy_is_named(case, monkeypatch):
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
    with pytest.raises(InputError, match="is a function of your own"):
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


@pytest.mark.parametrize(
    "words", ["uncertainty", "sensitivity --method morris", "tune", "tune --robust cvar"]
)
def test_the_command_refuses_what_is_no_cluster_in_one_line(words, tmp_path):
    name, *more = words.split()
    found = command(
        name, "cascaded/pi", *more, "--cluster", "local:x", "--out", str(tmp_path / "run")
    )
    assert found.code == 2 and found.out == "" and found.err.count("\n") == 1
    assert "cluster = 'local:x': must be HOST:PORT" in found.err
    assert not any(tmp_path.iterdir())

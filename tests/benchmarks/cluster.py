"""Dask workers of this machine: two beside one, and drills in which processes are killed.

    python tests/benchmarks/cluster.py [--rounds 3] [--samples 16384] [--kills 3]

Time: an ensemble of gouta2015/backstepping in batches of 256, at the step of the case (120,001
samples) and at ten times that step, on one and on two workers, in turn, each with its program
compiled before; wall time, core time of workers and of this process, and the load of the machine,
without which a ratio of wall times means nothing.

Drills: SIGKILL of one of two workers, of the scheduler (then --resume on another cluster), and of
the command itself (then --resume), each at a random moment; draws.csv must have the bytes of one
process.
"""

import argparse
import contextlib
import logging
import os
import random
import signal
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import distributed
import jax

import tuning
from jaxtank import presets, rig

COMMAND = ["uncertainty", "gouta2015/backstepping", "--set", "clock.dt=0.1", "--set"]
COMMAND += ["sensor.noise=0.02", "--samples", "4096", "--quiet", "--json"]
KINDS = ("worker", "scheduler", "command")


@contextlib.contextmanager
def cluster(count):
    """A client of so many workers, whose scheduler is a process of its own."""
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        file = f"{folder}/scheduler.json"
        options = ["--scheduler-file", file, "--host", "127.0.0.1", "--no-dashboard"]
        worker = ["dask_worker", "--nthreads", "1", "--no-nanny", "--local-directory", folder]
        for words in (["dask_scheduler", "--port", "0"], *[worker] * count):
            command = [sys.executable, "-m", f"distributed.cli.{words[0]}", *words[1:], *options]
            process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
            stack.callback(process.wait)
            stack.callback(process.kill)
        while not Path(file).exists():
            time.sleep(0.1)
        with distributed.Client(scheduler_file=file) as client:
            client.wait_for_workers(count, timeout=120)
            yield client


def times(case, samples, rounds):
    """Print wall and core times on one and on two workers."""
    options = {"measures": ["rms_error_total", "max_level"], "fan": False}
    with cluster(1) as one, cluster(2) as two:
        spent = {one: [], two: []}
        for client in spent:  # every worker compiles, or has nothing to do at first
            for _ in range(2):
                tuning.ensemble(case, samples=2048, cluster=client, **options)
        for _ in range(rounds):
            for client, rows in spent.items():
                before = sum(client.run(time.process_time).values())
                began, mine = time.perf_counter(), time.process_time()
                tuning.ensemble(case, samples=samples, cluster=client, **options)
                wall, mine = time.perf_counter() - began, time.process_time() - mine
                rows.append((wall, sum(client.run(time.process_time).values()) - before, mine))
        for words, rows in zip(("one worker", "two workers"), spent.values()):
            wall, theirs, mine = (statistics.median(column) for column in zip(*rows))
            print(
                f"{words}: {wall:.2f} s, core time {theirs:.2f} s of the workers,"
                f" {1e3 * mine / (samples / 256):.1f} ms a batch of this process",
                flush=True,
            )
        ratios = [a[0] / b[0] for a, b in zip(spent[one], spent[two])]
        print(
            f"two workers {statistics.median(ratios):.2f} x one ({min(ratios):.2f} to"
            f" {max(ratios):.2f}); load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
        )


def kept(folder):
    """How many batches are kept in a folder."""
    path = (Path(folder) / "checkpoint.sqlite3").absolute()
    try:
        with contextlib.closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as file:
            return file.execute("SELECT count(*) FROM record").fetchone()[0] - 1
    except sqlite3.Error:
        return 0


def drill(kind, folder, whole, chance):
    """Kill a process of a run at a random moment; returns whether draws.csv has the same bytes."""
    with cluster(2) as client:
        words = [sys.executable, "-m", "jaxtank", *COMMAND, "--cluster", client.scheduler.address]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
        begun = subprocess.Popen([*words, "--out", folder], **quiet)
        most = chance.randint(1, 12)  # of 16 batches
        while begun.poll() is None and kept(folder) < most:
            time.sleep(0.005)
        pid = begun.pid
        if kind == "scheduler":
            pid = client.run_on_scheduler(os.getpid)
        elif kind == "worker":
            pid = chance.choice(list(client.run(os.getpid).values()))
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        error = begun.communicate()[1].decode().strip()
        print(f"  {kind} killed after {most} batches: exit code {begun.returncode} {error}")
    if begun.returncode:
        with cluster(1) as client:
            words = [sys.executable, "-m", "jaxtank", *COMMAND]
            words += ["--cluster", client.scheduler.address, "--resume", folder]
            subprocess.run(words, stdout=subprocess.DEVNULL, check=True)
    return Path(folder, "draws.csv").read_bytes() == whole


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--samples", type=int, default=16_384)
    parser.add_argument("--kills", type=int, default=3)
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # killed on purpose
    if asked.rounds:
        whole = presets.find("gouta2015/backstepping")
        for case in (whole, rig.set_values(whole, {"clock.dt": 0.1})):
            print(f"{asked.samples:,} plants of {case.clock.samples:,} samples")
            times(case, asked.samples, asked.rounds)
    chance, survived = random.Random(0), 0
    with tempfile.TemporaryDirectory() as top:
        if asked.kills:
            alone = [sys.executable, "-m", "jaxtank", *COMMAND, "--out", f"{top}/alone"]
            subprocess.run(alone, stdout=subprocess.DEVNULL, check=True)
            whole = Path(top, "alone", "draws.csv").read_bytes()
            for i in range(asked.kills):
                survived += drill(KINDS[i % len(KINDS)], f"{top}/{i}", whole, chance)
            print(f"{survived} of {asked.kills} kills: the bytes of one process")
    sys.exit(survived < asked.kills)


if __name__ == "__main__":
    main()

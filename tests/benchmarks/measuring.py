"""Core times of calls made in turn and of commands, and tables between the marks of README.md."""

import os
import re
import resource
import statistics
import subprocess
import time
from pathlib import Path

import jax

from jaxtank.core.files import write_atomic
from tuning.report import tables

README = Path(__file__).with_name("README.md")


def core_times(calls, rounds, repeat=1):
    """{name: [core time of a call, s]}: each `repeat` times a round, in turn, after one that
    compiles.
    """
    seconds = {name: [] for name in calls}
    for call in calls.values():
        jax.block_until_ready(call())
    for _ in range(rounds):
        for name, call in calls.items():
            began = time.process_time()
            for _ in range(repeat):
                jax.block_until_ready(call())
            seconds[name].append((time.process_time() - began) / repeat)
    return seconds


def environment(*beginnings, **more):
    """The environment without the names that begin so, and with others."""
    return {n: v for n, v in os.environ.items() if not n.startswith(beginnings)} | more


def of_command(words, **options):
    """(core time [s], stdout) of a command in a process of its own, which must end well."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    pipes = {"check": True, "capture_output": True, "text": True, **options}
    done = subprocess.run(words, **pipes)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return spent, done.stdout


def ratio(seconds, name, rival):
    """Words: median of the ratio in the same round, and its range."""
    return with_range([a / b for a, b in zip(seconds[name], seconds[rival])], ".2f")


def with_range(values, digits=".3g"):
    """Words: median and range."""
    middle, low, high = (f"{f(values):{digits}}" for f in (statistics.median, min, max))
    return f"{middle} ({low} to {high})"


def first_number(words, default):
    """The first whole number of the words of a command line."""
    return next((int(word) for word in words if word.isdigit()), default)


def markdown(heads, rows):
    """A table as GitHub renders it."""
    lines = [f"| {' | '.join(row)} |" for row in (heads, *rows)]
    return "\n".join([lines[0], "|---" * len(heads) + "|", *lines[1:]])


def report(words, heads, rows, begin, end):
    """Print a table; with --markdown also write it to README.md, between its marks."""
    print(tables.table(rows, heads))
    if "--markdown" in words:
        store(begin, end, markdown(heads, rows))


def store(begin, end, text):
    """Write a text to README.md, between its marks."""
    page, block = README.read_text(), f"{begin}\n{text}\n{end}"
    write_atomic(README, re.sub(f"{begin}.*?{end}", lambda _: block, page, flags=re.DOTALL))

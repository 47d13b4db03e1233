"""Everything here runs in float64; a test of float32 says so and runs in a process of its own.

Compiled programs are kept in pytest's own cache between runs and shared by workers and
subprocesses; `pytest --cache-clear` compiles everything anew.
"""

import contextlib
import ctypes
import gc
import itertools
import os
import re
import shutil
import zlib
from pathlib import Path

import jax
import pytest
from browser import chromium

from jaxtank import presets  # before jax starts, so that the XLA option takes
from jaxtank.measures import catalogue

jax.config.update("jax_enable_x64", True)
gc.set_threshold(50_000, 20, 100)  # as the command does: tracing makes many objects, few circles

MEASURES = set(catalogue.MEASURES)
"""Measures of the package, before a test registers one."""

FOLDER = "JAX_COMPILATION_CACHE_DIR"
LARGEST_CACHE = 2**30
"""Bytes of compiled programs above which a run begins without any."""

LARGEST_WORKER, MORE, MOST_MAPS = 3 * 2**29, 2**29, 20_000
"""Bytes of a worker from which its compiled programs are dropped after a test, and how much more it
may take before they are dropped again; memory maps from which they are dropped after a file. Linux
allows 65,530 maps, and XLA ends the process where it gets no more.
"""

TIERS = "slow", "extended"
"""Marks of tests that `pytest` alone leaves out; CI also runs the extended ones."""

SKIPS = (
    r"no Chromium( on this machine)?$",  # and, of the same kind, what a machine may lack
    r"(no node on this machine|node runs the exported code)$",
    r"no (gcc|octave|matiec) on this machine$",
    r"(blark|fmpy) is not installed$",
    r"(fish|zsh|bash) is not installed here$",
    r"needs JupyterLab: ",  # of the extra "notebooks", which tests do without
    r"pyright (is not installed|cannot run here)",
    r"could not import 'xarray'",
    r"CasADi is not installed",
    r"FMPy is not installed",
    r"diffrax is not installed",
)
"""Reasons for which a test may skip. Under JAXTANK_SKIPS=listed, as in CI, any other one fails."""


def pytest_sessionfinish(session):
    """Fail a run in which a test skipped for a reason that is not on the list."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if reporter is None or os.environ.get("JAXTANK_SKIPS") != "listed":
        return
    reasons = {
        report.longrepr[2].removeprefix("Skipped: ") for report in reporter.stats.get("skipped", ())
    }
    unlisted = sorted(r for r in reasons if not any(re.match(allowed, r) for allowed in SKIPS))
    if unlisted:
        reporter.write_line(f"skipped for reasons that are not on the list: {unlisted}", red=True)
        session.exitstatus = session.exitstatus or pytest.ExitCode.TESTS_FAILED


def pytest_addoption(parser):
    words = "run one of N parts of the selected tests, by a hash; K, any integer, selects which"
    parser.addoption("--turn", metavar="K/N", help=words)


def _in_turn(config, items):
    """Leave out the tests of other turns than --turn."""
    words = config.getoption("--turn")
    if not re.fullmatch(r"\d+/[1-9]\d*", words):
        raise pytest.UsageError(f"--turn {words}: must be K/N, as 7/24")
    turn, count = map(int, words.split("/"))
    others = {item for item in items if (zlib.crc32(item.nodeid.encode()) - turn) % count}
    config.hook.pytest_deselected(items=list(others))
    items[:] = [item for item in items if item not in others]


def pytest_configure(config):
    """Keep what XLA compiles in .pytest_cache: its key holds program, options and versions.

    Workers and subprocesses inherit the folder; one that the user has set stays.
    """
    cache = getattr(config, "cache", None)
    if cache is None or FOLDER in os.environ:  # -p no:cacheprovider; a worker
        return
    folder = cache.mkdir("xla")
    entries = [path for path in folder.iterdir() if path.is_file()]
    if sum(path.stat().st_size for path in entries) > LARGEST_CACHE:
        shutil.rmtree(folder)
        folder = cache.mkdir("xla")
    os.environ[FOLDER] = str(folder)
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.1"
    jax.config.update("jax_compilation_cache_dir", str(folder))  # jax has read the environment
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def _memory():
    """Resident bytes of this process; 0 where it cannot be read."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


def _maps():
    try:
        return Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:
        return 0


def _drop_programs(config):
    """Give back what compiled programs take, and what malloc holds of their compilation."""
    jax.clear_caches()
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):  # only glibc has it
        ctypes.CDLL(None).malloc_trim(0)
    config.stash[ALLOWED] = max(LARGEST_WORKER, _memory() + MORE)


ALLOWED = pytest.StashKey[int]()


def pytest_runtest_teardown(item, nextitem):
    """Take out the measures that a file has registered, and the programs that know them by name;
    all programs where they are too many.
    """
    same_file = nextitem is None or nextitem.path == item.path
    much = _memory() > item.config.stash.get(ALLOWED, LARGEST_WORKER)
    if much or (not same_file and _maps() > MOST_MAPS):
        _drop_programs(item.config)
    if same_file:
        return
    if registered := set(catalogue.MEASURES) - MEASURES:
        for name in registered:
            del catalogue.MEASURES[name]
        jax.clear_caches()


@pytest.hookimpl(tryfirst=True)  # before pytest selects by marks
def pytest_collection_modifyitems(config, items):
    """Mark as slow, or extended, the parameter sets that `slow_for(*ids)` and such name."""
    missing = {}
    for item, tier in itertools.product(items, TIERS):
        for mark in item.iter_markers(f"{tier}_for"):
            key = item.path, item.originalname, tier
            missing.setdefault(key, set(mark.args)).discard(item.callspec.id)
            if item.callspec.id in mark.args:
                item.add_marker(tier)
    missing = [
        f"{path.name}::{test}{sorted(ids)}" for (path, test, _), ids in missing.items() if ids
    ]
    if missing and not any("::" in str(word) for word in config.args):
        raise pytest.UsageError(f"slow_for or extended_for name what is not there: {missing}")
    if config.getoption("--turn"):
        _in_turn(config, items)


@pytest.fixture(scope="session")
def gouta():
    """Cases of gouta2015 by name, with overrides by dotted name: gouta("ngpc", {"reference.ramp":
    30.0}).
    """
    from jaxtank import presets, rig

    cases = presets.load("gouta2015").cases

    def case(name, values=None):
        return rig.set_values(cases[name], values or {})

    return case


@pytest.fixture(scope="module")
def browser():
    """A headless Chromium; a test skips where there is none."""
    with chromium() as started:
        yield started


@pytest.fixture(scope="session")
def written(tmp_path_factory):
    """The live page of cascaded/pi as a file."""
    folder = tmp_path_factory.mktemp("live")
    return presets.find("cascaded/pi").explore().save(folder / "page.html")

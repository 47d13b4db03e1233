"""Programs that the tests keep between runs (conftest.py) give the bits of those compiled anew."""

import os
from pathlib import Path

import jax
import numpy as np
import pytest
from helpers import ONE_TANK
from jax.experimental.compilation_cache import compilation_cache

import jaxtank
from jaxtank import rig

HIT = "/jax/compilation_cache/cache_hits"


@pytest.fixture
def empty(tmp_path):
    """An empty folder of compiled programs for one test."""
    before = jax.config.jax_compilation_cache_dir
    least = jax.config.jax_persistent_cache_min_compile_time_secs
    compilation_cache.reset_cache()
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    yield tmp_path
    compilation_cache.reset_cache()
    jax.config.update("jax_compilation_cache_dir", before)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", least)


def bits():
    """Measures of a short run and their exact derivatives, compiled now."""
    case = rig.set_values(rig.loads(ONE_TANK), {"clock.duration": 5.0})

    def run(gain):
        loop = jaxtank.with_values(case.loop, {"controller.Kc": gain})
        return jaxtank.evaluate(loop, case.clock, ["rms_error_total", "max_level"])

    program = jax.jit(lambda gain: (run(gain), jax.jacfwd(run)(gain)))
    return jax.tree.leaves(program.lower(2.0).compile()(2.0))


def test_a_kept_program_gives_the_bits_of_a_new_one(empty):
    """Compiled and written to the folder, read from it, compiled without it."""
    events = []
    jax.monitoring.register_event_listener(lambda event, **_: events.append(event))
    new = bits()
    assert list(empty.iterdir()) and HIT not in events
    kept = bits()
    assert HIT in events
    jax.config.update("jax_enable_compilation_cache", False)
    try:
        without = bits()
    finally:
        jax.config.update("jax_enable_compilation_cache", True)
    for other in (kept, without):
        for a, b in zip(new, other, strict=True):
            np.testing.assert_array_equal(a, b)


def test_the_folder_is_known_to_subprocesses():
    folder = Path(os.environ["JAX_COMPILATION_CACHE_DIR"])
    assert str(folder) == jax.config.jax_compilation_cache_dir and folder.is_dir()

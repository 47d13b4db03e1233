"""Everything here runs in float64; a test of float32 says so and runs in a process of its own. What
slow.txt lists is marked slow.
"""

from pathlib import Path

import jax
import pytest

import jaxtank  # noqa: F401  (before jax starts, so that the XLA option takes)

jax.config.update("jax_enable_x64", True)


SLOW = {
    line
    for line in (Path(__file__).parent / "slow.txt").read_text().splitlines()
    if line and not line.startswith("#")
}


@pytest.hookimpl(tryfirst=True)  # before the marker is looked for
def pytest_collection_modifyitems(items):
    """Mark the tests of slow.txt: one set of parameters, or all where none is named."""
    for item in items:
        if SLOW & {f"{item.path.name}::{item.name}", f"{item.path.name}::{item.originalname}"}:
            item.add_marker(pytest.mark.slow)


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

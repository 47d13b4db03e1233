"""Everything here runs in float64; a test of float32 says so and runs in a process of its own."""

import jax
import pytest

import jaxtank  # noqa: F401  (before jax starts, so that the XLA option takes)

jax.config.update("jax_enable_x64", True)


@pytest.fixture(scope="session")
def gouta():
    """Cases of gouta2015 by name, with overrides by dotted name: gouta("ngpc", {"reference.ramp": 30.0})."""
    from jaxtank import presets, rig

    cases = presets.load("gouta2015").cases

    def case(name, values=None):
        return rig.set_values(cases[name], values or {})

    return case

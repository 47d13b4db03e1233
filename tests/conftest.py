"""Everything here runs in float64; a test of float32 says so and runs in a process of its own."""

import jax
import pytest

import jaxtank  # noqa: F401  (before jax starts, so that the XLA option takes)

jax.config.update("jax_enable_x64", True)


@pytest.hookimpl(tryfirst=True)  # before pytest selects by marks
def pytest_collection_modifyitems(config, items):
    """Mark as slow the parameter sets that `@pytest.mark.slow_for(*ids)` names."""
    missing = {}
    for item in items:
        for mark in item.iter_markers("slow_for"):
            missing.setdefault((item.path, item.originalname), set(mark.args))
            missing[item.path, item.originalname].discard(item.callspec.id)
            if item.callspec.id in mark.args:
                item.add_marker(pytest.mark.slow)
    missing = [f"{path.name}::{test}{sorted(ids)}" for (path, test), ids in missing.items() if ids]
    if missing and not any("::" in str(word) for word in config.args):
        raise pytest.UsageError(f"slow_for names parameter sets that are not there: {missing}")


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

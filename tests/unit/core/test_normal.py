"""Deviates drawn by our own Threefry and inverse error function are those of jax."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import erfinv

from jaxtank.xla.normal import erf_inv, normal


@pytest.mark.extended_for("shape0-True", "shape2-False")
@pytest.mark.parametrize("shape, compiled", [((4, 1001), True), ((3,), True), ((1, 7), False)])
def test_deviates_are_those_of_jax(shape, compiled):
    mine, theirs = normal, lambda key, shape: jax.random.normal(key, shape, jnp.float64)
    if compiled:
        mine, theirs = (jax.jit(f, static_argnums=1) for f in (mine, theirs))
    for seed in (0, 2**31 - 1):
        key = jax.random.fold_in(jax.random.key(seed), 3)
        np.testing.assert_allclose(mine(key, shape), theirs(key, shape), rtol=1e-13)


def test_the_inverse_error_function_holds_from_0_to_the_last_number_below_1():
    rng = np.random.default_rng(0)
    ends = [0.0, 2.0**-60, np.nextafter(1.0, 0.0), np.nextafter(-1.0, 0.0)]
    near_1, near_0 = 1.0 - 2.0 ** -rng.uniform(1, 53, 20_000), 2.0 ** -rng.uniform(1, 60, 2_000)
    x = np.concatenate([rng.uniform(-1, 1, 200_000), near_1, -near_1, near_0, ends])
    np.testing.assert_allclose(jax.jit(erf_inv)(x), erfinv(x), rtol=3e-15)


def test_a_batch_of_keys_has_the_deviates_of_each():
    keys = jax.random.split(jax.random.key(5), 6)
    many = jax.jit(jax.vmap(lambda key: normal(key, (2, 9))))(keys)
    for key, row in zip(keys, many):
        np.testing.assert_allclose(row, jax.random.normal(key, (2, 9), jnp.float64), rtol=1e-13)


def test_other_generators_and_types_are_left_to_jax():
    for key in (jax.random.PRNGKey(1), jax.random.key(1, impl="rbg")):
        np.testing.assert_array_equal(
            normal(key, (5,)), jax.random.normal(key, (5,), jnp.result_type(float))
        )


def test_its_program_holds_no_loop():
    """The loops of jax's own generator are what it avoids."""
    text = jax.jit(lambda key: normal(key, (4, 64))).lower(jax.random.key(0)).as_text()
    assert "while" not in text and "threefry" not in text


@pytest.mark.slow
def test_the_noise_of_a_run_drawn_in_its_loop_is_that_drawn_before():
    """Deviates that are given, as the tuner gives them, against those drawn sample by sample."""
    import jaxtank
    from jaxtank import presets, rig
    from jaxtank.loop.run import evaluate_compiled

    case = presets.find("cascaded/pi")
    case = rig.set_values(case, {"clock.duration": 400.0, "sensor.noise": [0.1, 0.2]})
    key = jax.random.key(3)
    names = ("rms_error_total", "max_level")
    given = jnp.stack(case.loop.sensor.draw(key, case.clock.samples))
    before, there = (
        evaluate_compiled(case.loop, case.clock, names, k, False)[0] for k in (given, key)
    )
    for name in names:  # two programs: sums may differ in the last bit
        np.testing.assert_allclose(before[name], there[name], rtol=1e-14)
    run = jaxtank.simulate(case.loop, case.clock, key=key)
    np.testing.assert_allclose(there["max_level"], run.x.max(axis=0), rtol=1e-14)

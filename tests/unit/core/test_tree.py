"""Dotted names: every leaf can be listed, described, read and set, inside and outside a trace."""

import dataclasses
import fractions

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxtank
from jaxtank import rig
from jaxtank.core.checks import check_leaves
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.core.records import check_key
from jaxtank.core.tree import describe, get_value, parameters, with_values

OPTIONAL = ("actuator.dead_zone", "actuator.lag")
KEYS = jax.random.split(jax.random.key(0), 3)


@pytest.fixture(scope="module")
def loop(gouta):
    return gouta("backstepping").loop


def test_every_parameter_can_be_read_described_and_set_by_its_name(loop):
    values = parameters(loop)
    assert {"plant.area", "controller.model.drain", "sensor.noise", "reference.ramp"} <= set(values)
    # static fields are not parameters
    assert not {"plant.overflow", "plant.links", "reference.band"} & set(values)
    for name, value in values.items():
        assert np.array_equal(get_value(loop, name), value)
        assert describe(loop, name)["kind"] == "leaf"
        doubled = parameters(with_values(loop, {name: 2.0 * np.asarray(value) + 1.0}))
        changed = {other for other in values if not np.array_equal(doubled[other], values[other])}
        assert changed == ({name} if np.size(value) else set())  # this rig has no pipes
        assert np.array_equal(doubled[name], 2.0 * np.asarray(value) + 1.0)


def test_an_entry_is_read_and_set_alone(loop):
    changed = with_values(loop, {"plant.drain[2]": 0.5, "plant.area[0]": 7.0})
    np.testing.assert_array_equal(changed.plant.drain, [*loop.plant.drain[:2], 0.5, 0.0])
    np.testing.assert_array_equal(changed.plant.area, [7.0, *loop.plant.area[1:]])
    assert get_value(changed, "plant.drain[2]") == 0.5
    assert loop.plant.drain[2] == 0.0  # the loop it was made from is as it was
    assert changed.controller.model.drain[2] == 0.0  # and the law's own model does not follow


def test_later_values_win(loop):
    np.testing.assert_array_equal(
        with_values(loop, {"plant.area": 3.0, "plant.area[1]": 5.0}).plant.area,
        [3.0, 5.0, 3.0, 3.0],
    )
    np.testing.assert_array_equal(
        with_values(loop, {"plant.area[1]": 5.0, "plant.area": 3.0}).plant.area, [3.0] * 4
    )


@pytest.mark.parametrize(
    ("name", "value", "shape"),
    [
        ("plant.area", np.ones((1, 4)), "(1, 4)"),
        ("plant.area", [], "(0,)"),
        ("controller.k", [1.0], "(1,)"),
        ("plant.area[0]", jnp.ones(2), "(2,)"),
    ],
)
def test_a_wrong_shape_is_reported(loop, name, value, shape):
    with pytest.raises(InputError) as caught:
        with_values(loop, {name: value})
    assert name in str(caught.value) and shape in str(caught.value)


NO_NUMBERS = ["3", True, None, 1 + 2j, np.bool_(True), [1.0, True, 2.0, 3.0], ["1", "2", "3", "4"]]
NO_NUMBERS += [[[1.0], [2.0, 3.0]], {}, object(), jnp.array([1j, 1, 1, 1]), jax.random.key(0)]


@pytest.mark.parametrize("value", NO_NUMBERS, ids=range(len(NO_NUMBERS)))
def test_what_is_no_number_is_reported(loop, value):
    with pytest.raises(
        InputError, match=r"plant\.area = .*must be a real number or a list of real numbers"
    ):
        with_values(loop, {"plant.area": value})


@pytest.mark.parametrize(
    "value",
    [True, None, 1 + 2j, np.array([1j, 1, 1, 1]), jnp.ones(4) > 0, jax.random.key(0)],
    ids=range(6),
)
def test_a_leaf_that_is_no_number_is_reported_by_input_validation(loop, value):
    with pytest.raises(
        InputError, match=r"^plant\.drain = .*: must be a real number or an array of real numbers$"
    ):
        check_leaves(dataclasses.replace(loop, plant=dataclasses.replace(loop.plant, drain=value)))


def test_real_numbers_of_every_kind_are_taken(loop):
    several = ([1, 2.0, np.int16(3), 4], np.arange(4), fractions.Fraction(5, 2))
    for value in (3, np.float32(2.5), np.int8(3), jnp.bfloat16(2.5), 2**70, *several):
        found = with_values(loop, {"plant.area": value}).plant.area
        np.testing.assert_array_equal(found, np.broadcast_to(np.array(value, dtype=float), 4))


def test_complex_values_are_reported_inside_a_trace(loop):
    with pytest.raises(InputError, match=r"plant\.area"):
        jax.jit(lambda v: with_values(loop, {"plant.area": v}).plant.area)(1j)
    np.testing.assert_array_equal(
        jax.vmap(lambda v: with_values(loop, {"plant.area": v}).plant.area)(jnp.arange(1, 3)),
        [[1.0] * 4, [2.0] * 4],
    )


@pytest.mark.parametrize(
    ("name", "near"),
    [
        ("controller.kk", "controller.k1"),
        ("plant.aera", "plant.area"),
        ("plant.area.x", "plant.area"),
        ("plnt.area", "plant.area"),
        ("plant", "plant.rim"),
        ("plant.drian[0]", "plant.drain"),
        ("actuator.saturated", "actuator.saturation"),
    ],
)
def test_an_unknown_name_is_answered_with_the_nearest(loop, name, near):
    for ask in (get_value, describe, lambda tree, name: with_values(tree, {name: 1.0})):
        with pytest.raises(InputError) as caught:
            ask(loop, name)
        assert f"unknown parameter {name!r}" in str(caught.value)
        assert near in str(caught.value).split("nearest: ")[1].split(", ")


def test_a_static_field_is_described_but_is_no_leaf(loop):
    assert describe(loop, "reference.band")["kind"] == "static"
    assert describe(loop, "reference.band")["unit"] == "-"
    for ask in (get_value, lambda tree, name: with_values(tree, {name: 1.0})):
        with pytest.raises(InputError, match=r"reference\.band"):
            ask(loop, "reference.band")


@pytest.mark.parametrize(
    "name", ["plant.area[", "plant.area[-1]", "plant..area", "", "plant[0].area", "plant.area[0]\n"]
)
def test_a_malformed_name_is_reported(loop, name):
    for ask in (get_value, lambda tree, name: with_values(tree, {name: 1.0})):
        with pytest.raises(InputError, match="is not a parameter name"):
            ask(loop, name)


@pytest.mark.parametrize("name", ["plant.area[4]", "plant.area[0,0]", "controller.k[0]"])
def test_an_entry_that_is_not_there_is_reported_with_the_shape(loop, name):
    for ask in (get_value, lambda tree, name: with_values(tree, {name: 1.0})):
        with pytest.raises(InputError) as caught:
            ask(loop, name)
        assert name in str(caught.value) and "has shape (" in str(caught.value)


def test_values_are_set_under_jit_and_vmap(loop):
    values = jnp.array([1.0, 2.0, 3.0])

    def area(v):
        return with_values(loop, {"plant.area[1]": v}).plant.area

    expected = np.tile(loop.plant.area, (3, 1))
    expected[:, 1] = values
    np.testing.assert_array_equal(jax.vmap(area)(values), expected)
    np.testing.assert_array_equal(jax.jit(area)(2.0), expected[1])
    filled = jax.jit(jax.vmap(lambda v: with_values(loop, {"plant.area": v}).plant.area))(values)
    np.testing.assert_array_equal(filled, np.outer(values, np.ones(4)))


def test_derivatives_of_setting_and_reading_an_entry_are_one_hot(loop):
    one_hot = np.array([0.0, 0.0, 1.0, 0.0])
    area = lambda name: lambda v: with_values(loop, {name: v}).plant.area
    grad = lambda f: jax.jit(jax.grad(f))
    np.testing.assert_array_equal(jax.jit(jax.jacfwd(area("plant.area[2]")))(5.0), one_hot)
    assert grad(lambda v: area("plant.area[2]")(v).sum())(5.0) == 1.0
    assert grad(lambda v: area("plant.area")(v).sum())(5.0) == 4.0
    slopes = parameters(grad(lambda tree: get_value(tree, "plant.area[2]") + 0.0)(loop))
    np.testing.assert_array_equal(slopes.pop("plant.area"), one_hot)
    assert all(not np.any(slope) for slope in slopes.values())
    replaced = grad(lambda tree: with_values(tree, {"plant.area[2]": 1.0}).plant.area.sum())(loop)
    # what is overwritten is not felt
    np.testing.assert_array_equal(replaced.plant.area, 1.0 - one_hot)


def test_optional_leaves_are_absent_until_they_are_set(loop):
    assert not set(OPTIONAL) & set(parameters(loop))
    for name in OPTIONAL:
        assert describe(loop, name)["kind"] == "leaf"
        filled, one = with_values(loop, {name: 2.0}), with_values(loop, {f"{name}[1]": 2.0})
        np.testing.assert_array_equal(get_value(filled, name), [2.0, 2.0])
        np.testing.assert_array_equal(get_value(one, name), [0.0, 2.0])
        assert set(parameters(filled)) - set(parameters(loop)) == {name}
        assert get_value(one, f"{name}[1]") == 2.0
        with pytest.raises(InputError, match=r"shape \(3,\)"):
            with_values(loop, {name: [1.0, 2.0, 3.0]})


@pytest.mark.parametrize("name", OPTIONAL)
def test_reading_an_absent_leaf_does_not_suggest_the_same_name(loop, name):
    with pytest.raises(InputError, match=name) as caught:
        get_value(loop, name)
    assert name not in str(caught.value).partition("nearest: ")[2].split(", ")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("plant.area", [1.0, -2.0, 1.0, 1.0], "plant.area[1] = -2 cm^2: must be above 0 cm^2"),
        ("plant.area", 0.0, "plant.area[0] = 0 cm^2: must be above 0 cm^2"),
        ("plant.drain[3]", -1e-9, "plant.drain[3] = -1e-09 cm^2: must be at least 0 cm^2"),
        ("plant.split[1]", 1.5, "plant.split[1] = 1.5: must be at most 1"),
        ("controller.k", np.nan, "controller.k = nan 1/s: must be a finite number"),
        ("x0[2]", np.inf, "x0[2] = inf cm: must be a finite number"),
        ("actuator.low", -np.inf, "actuator.low[0] = -inf V: must be a finite number"),
        ("actuator.lag[1]", -1.0, "actuator.lag[1] = -1 s: must be at least 0 s"),
    ],
)
def test_a_value_out_of_range_is_reported_with_name_entry_and_unit(loop, name, value, message):
    bad = with_values(loop, {name: value})
    with pytest.raises(InputError) as caught:
        check_leaves(bad)
    assert str(caught.value) == message
    with pytest.raises(InputError):
        check_leaves(bad, {name.split("[")[0]})
    check_leaves(bad, {"plant.gravity"})


def test_both_ends_of_a_range_and_its_middle_pass(loop):
    for split in (0.0, 0.5, 1.0):
        check_leaves(with_values(loop, {"plant.split": split}))
    check_leaves(with_values(loop, {"plant.drain": 0.0, "plant.area": 1e-300}))


def test_traced_values_are_not_checked(loop):
    def through(k):
        tree = with_values(loop, {"controller.k": k})
        check_leaves(tree)
        return tree.controller.k

    assert jax.jit(through)(-1.0) == -1.0
    np.testing.assert_array_equal(jax.vmap(through)(jnp.array([-1.0, np.nan])), [-1.0, np.nan])


def test_a_changed_gain_does_not_retrace_and_a_changed_static_does(gouta):
    traces = []
    clock = Clock(dt=0.1, duration=5.0)

    @jax.jit
    def error(loop):
        traces.append(None)
        return jaxtank.evaluate(loop, clock, ["rms_error_total"])["rms_error_total"]

    case = gouta(
        "backstepping", {"x0": 5.0}
    )  # away from the steady state, so that the gain has an effect
    changes = [
        {"controller.k1": 0.05},
        {"controller.k1": np.float32(0.1)},
        {"controller.k1": jnp.asarray(0.2)},
        {"controller.k": 1},
        {"plant.area[0]": 20.0},
        {"plant.drain": [0.1, 0.2, 0.0, 0.0]},
        {"reference.ramp": 45.0},
    ]
    costs = [float(error(with_values(case.loop, values))) for values in changes]
    assert len(traces) == 1
    assert len(set(costs)) == len(changes)
    error(rig.set_values(case, {"reference.shape": "quintic"}).loop)
    assert len(traces) == 2
    # a leaf that was absent is a new program too
    error(with_values(case.loop, {"actuator.lag": 0.5}))
    assert len(traces) == 3


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda case: (case.clock, case.loop), "loop is a Clock: must be a ClosedLoop"),
        (lambda case: (case.loop.plant, case.clock), "loop is a TankNetwork: must be a"),
        (lambda case: (case.loop, 10.0), "clock is a float: must be a jaxtank.Clock"),
        (lambda case: (case.loop, case.clock, 0), "key is a int: must be one random key"),
        (lambda case: (case.loop, case.clock, np.arange(2)), "key is a ndarray: must be one"),
        (lambda case: (case.loop, case.clock, KEYS), "key has shape (3,)"),
    ],
)
def test_arguments_in_each_others_place_are_reported(gouta, call, words):
    with pytest.raises(InputError) as caught:
        jaxtank.simulate(*call(gouta("backstepping")))
    assert words in str(caught.value) and "\n" not in str(caught.value)


def test_keys_of_both_kinds_are_taken_traced_or_not():
    kinds = (jax.random.PRNGKey(1), jax.random.key(1, impl="rbg"), np.arange(2, dtype=np.uint32))
    for key in (None, jax.random.key(1), *kinds):
        check_key(key)
    for keys in (jax.random.split(key(0), 3) for key in (jax.random.key, jax.random.PRNGKey)):
        jax.vmap(lambda key: check_key(key) or 0)(keys)
        jax.jit(lambda key: check_key(key))(keys[0])


def test_a_part_of_the_structure_is_not_called_unknown():
    loop = jaxtank.presets.find("gouta2015/backstepping").loop
    with pytest.raises(
        InputError, match=r"^sensor\.bits is no number of the loop .*rig\.set_values$"
    ):
        with_values(loop, {"sensor.bits": 8})


def test_a_list_of_traced_numbers_is_one_of_real_numbers(loop):
    """As of floats; with a gradient."""
    total = lambda k: with_values(loop, {"x0": [k, 1.0, 2 * k, k]}).x0.sum()
    assert jax.grad(total)(2.0) == 4.0 and total(2.0) == 9.0
    with pytest.raises(InputError, match="real number"):
        with_values(loop, {"x0": [1j, 1.0, 1.0, 1.0]})

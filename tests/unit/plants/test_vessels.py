"""Shapes of tanks and flows through valves, curves and ports, beside geometry and SciPy."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import outlet_attacks
import pytest
import random_elements
from scipy.integrate import quad
from scipy.interpolate import PchipInterpolator

from jaxtank.core.curves import monotone_curve
from jaxtank.plants import elements, network
from jaxtank.plants.runge_kutta import advance
from jaxtank.plants.vessels import area_of, level_of, volume_of

TABLE = ((0.0, 0.5), (0.25, 1.0), (0.5, 0.75), (1.0, 0.25))
SIZES = {
    "prism": (2.0, 3.0),
    "cone": (3.0, 2.0),
    "sphere": (2.5, 2.0),
    "horizontal-cylinder": (8.0, 2.0),
    TABLE: (2.0, 2.0),
}
vessels = pytest.mark.parametrize(
    "shape", SIZES, ids=lambda s: s if isinstance(s, str) else "table"
)


@pytest.mark.extended_for("table")
@vessels
def test_volume_is_the_geometry_and_level_its_inverse(shape):
    area, extent = SIZES[shape]
    inside = np.linspace(0.01, 0.99, 40) * extent
    volumes = [outlet_attacks.volume_of(shape, area, extent, h) for h in inside]
    volume = jax.jit(lambda h: volume_of(shape, area, extent, h))
    np.testing.assert_allclose(volume(inside), volumes, rtol=1e-13)
    levels = np.concatenate([[-0.1, 0.0, 1e-9, 1e-6], inside, [extent, 1.2 * extent]])
    back = jax.jit(jax.vmap(lambda v: level_of(shape, area, extent, v)))(volume(levels))
    np.testing.assert_allclose(back, levels, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(volume(back), volume(levels), atol=1e-14)
    low, high = 0.05 * extent, 0.2 * extent  # at the tip itself the cross-section has a lower bound
    section = jax.jit(lambda h: area_of(shape, area, extent, h))
    exact = quad(lambda h: float(section(h)), low, high)[0]
    assert float(volume(high) - volume(low)) == pytest.approx(exact, rel=1e-9)


@vessels
@pytest.mark.parametrize("function", [volume_of, level_of])
def test_slopes_by_size_and_level_are_differences(shape, function):
    at = np.array([*SIZES[shape], 0.3 * SIZES[shape][1]])
    if function is level_of:
        at[2] = volume_of(shape, *at)
    value = jax.jit(lambda v: function(shape, v[0], v[1], v[2]))
    steps = 1e-6 * np.eye(3)
    differences = [(value(at + step) - value(at - step)) / 2e-6 for step in steps]
    np.testing.assert_allclose(
        jax.jit(jax.grad(value))(jnp.array(at)), differences, rtol=1e-7, atol=1e-8
    )


def test_a_curve_is_scipys_monotone_cubic_inside_and_straight_beyond():
    points = ((0.0, 0.0), (20.0, 1.0), (50.0, 7.0), (80.0, 8.0), (100.0, 8.5))
    middle = np.linspace(20.0, 80.0, 61)
    curve = jax.jit(jax.vmap(lambda u: monotone_curve(points, u)))
    np.testing.assert_allclose(curve(middle), PchipInterpolator(*zip(*points))(middle), rtol=1e-13)
    np.testing.assert_allclose(curve(np.array([-10.0, 110.0])), [-0.5, 8.75])
    slope = jax.jit(jax.vmap(jax.grad(lambda u: monotone_curve(points, u))))
    knots = np.array([x for x, _ in points])
    np.testing.assert_allclose(slope(knots - 1e-7), slope(knots + 1e-7), rtol=1e-5)
    assert np.all(np.diff(curve(np.linspace(-5.0, 105.0, 400))) > 0)


OTHERS = [pytest.param(k, marks=pytest.mark.slow) for k in range(1, 14)]
RIGS = [0, 20, 40, *OTHERS]
"""Three rigs of one structure, which share a compiled program, and others."""


@pytest.mark.extended_for("0")
@pytest.mark.parametrize("seed", RIGS)
def test_a_random_rig_follows_an_integrator_of_the_tests(seed):
    assert random_elements.errors(seed) < 1e-9


@pytest.mark.slow_for("0")
@pytest.mark.parametrize("seed", RIGS)
def test_a_rig_without_outlets_keeps_its_volume_while_tanks_run_empty(seed):
    assert random_elements.lost(seed) < 1e-12


@pytest.mark.parametrize("seed", [pytest.param(0, marks=pytest.mark.slow), *OTHERS])
def test_slopes_of_a_random_rig_are_those_of_differences(seed):
    assert random_elements.slope_error(seed) < 1e-6


def test_a_pump_that_draws_takes_no_more_than_the_tank_holds():
    plant = network(
        area=1.0, drain=0.0, pump_gain=1.0, feeds=[(1, None)], sources=[0], rim=[2.0, 9.0],
        units=("m", "m^3/s"), bottom=True,
    )  # fmt: skip
    x = (0.5, 0.0)
    for _ in range(30):
        x = advance(plant, "rk4", 0.0, x, (0.05,), None, 1.0, 1).x
    np.testing.assert_allclose(x, [0.0, 0.5], atol=1e-9)


@pytest.mark.extended_for("sphere", "table", "horizontal-cylinder")
@vessels
def test_slopes_of_an_empty_tank_are_finite_and_forget_its_first_level(shape):
    plant = network(
        area=SIZES[shape][0], shapes=(shape,), extent=[SIZES[shape][1]], drain=0.0, pump_gain=1.0,
        feeds=[(0, None)], valves=[(0, None)], valve=0.1, rim=2.0, units=("m", "m^3/s"),
        bottom=True,
    )  # fmt: skip

    def level(first, opening):  # after it has run empty and is fed again
        rate = lambda k: jnp.where(k < 80, 0.0, 0.4)
        step = lambda k, x: advance(plant, "rk4", 0.0, x, (rate(k), opening), None, 1.0, 4).x
        return jax.lax.fori_loop(0, 100, step, (first,))[0]

    by_first, by_opening = jax.jit(jax.jacfwd(level, (0, 1)))(0.5, 0.8)
    change = float(level(0.5, 0.8 + 1e-6) - level(0.5, 0.8 - 1e-6)) / 2e-6
    assert abs(by_first) < 1e-9 and float(by_opening) == pytest.approx(change, rel=1e-6)


@pytest.mark.parametrize("opening", ["drain", "orifice", "pipe", "valve"])
def test_an_opening_above_the_level_is_dry(opening):
    sizes = {"drain": 0.0, "orifice": 0.0, "pipe": 0.0, "valve": 1e-9} | {opening: 0.01}
    plant = network(
        area=[1.0, 1.0], drain=[sizes["drain"], 0.0], links=[(0, 1)], orifice=sizes["orifice"],
        pipes=[(0, 1)], pipe=sizes["pipe"], valves=[(0, None)], valve=sizes["valve"], pump_gain=1.0,
        feeds=[(0, None)], rim=5.0, ports={opening: 0.5}, units=("m", "m^3/s"),
    )  # fmt: skip
    rates = lambda level: plant.derivative(0.0, (level, 0.2), (0.0, 1.0), None)
    np.testing.assert_allclose(rates(0.3), 0.0, atol=1e-8)
    speed = np.sqrt(2.0 * 9.81 * 0.25)
    assert float(rates(0.75)[0]) == pytest.approx(-0.01 * speed, rel=1e-3)


@pytest.mark.parametrize("exponent", [0.4, 0.7, 1.0, 1.5])
def test_a_power_is_itself_above_its_knee_and_meets_it_smoothly_below(exponent):
    power = lambda h: elements.power_law(jnp.asarray(h), exponent, 0.01)
    h = np.array([0.01, 0.5, 30.0])
    np.testing.assert_allclose(power(h), h**exponent, rtol=1e-14)
    assert float(power(0.0)) == float(power(-1.0)) == 0.0
    slopes = [float(jax.grad(power)(h)) for h in (0.01 - 1e-12, 0.01 + 1e-12)]
    np.testing.assert_allclose(slopes, exponent * 0.01 ** (exponent - 1.0), rtol=1e-8)


def test_an_element_is_named_by_any_field_that_it_has():
    named = lambda **parts: elements.features(types.SimpleNamespace(**parts))
    assert named() == named(valves=(), shapes=None, extent=None) == []
    assert named(valves=((0, None),)) == ["valve"]
    assert named(shapes=("cone",)) == named(extent=np.ones(1)) == ["tank with a shape"]


def test_a_stream_of_zero_has_the_slope_of_a_stream():
    """It was twice that, where a rig is not plain: the limits of both directions act there."""
    cone = network(
        area=100.0, drain=0.5, pump_gain=20.0, feeds=[(0, None)], rim=20.0, shapes=("cone",)
    )
    rate = lambda u: cone.derivative(0.0, (5.0,), (u,), None)[0]
    slopes = [float(jax.grad(rate)(u)) for u in (0.0, 1.0)]
    assert slopes[0] == pytest.approx(slopes[1], rel=1e-12) and slopes[1] > 0.0

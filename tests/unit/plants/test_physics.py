"""Tanks against closed forms, another solver, and what must hold of any network."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxtank
from jaxtank.analysis.steady_state import equilibrium
from jaxtank.core.clock import Clock
from jaxtank.core.errors import EquilibriumError, InputError
from jaxtank.core.numerics import LAMINAR_THRESHOLD, clipped_sqrt, smooth_sqrt
from jaxtank.plants import state_coupled_four_tank
from jaxtank.plants.network import network
from jaxtank.plants.runge_kutta import integrate
from jaxtank.presets.gouta2015 import FAST_AREA


def one_tank(area=20.0, drain=0.2, rim=30.0, **more):
    return network(
        area=[area], drain=[drain], pump_gain=[5.0], feeds=((0, None),), rim=[rim], **more
    )


def held(plant, x, u, dt, steps, integrator="rk4"):
    """Levels after `steps` steps with the pumps held."""
    step = jax.jit(lambda x: integrate(plant, integrator, 0.0, x, u, None, dt))
    x = tuple(jnp.asarray(v, dtype=float) for v in x)
    for _ in range(steps):
        x = step(x)
    return np.array(x)


def test_root_meets_its_docstring():
    h = np.linspace(LAMINAR_THRESHOLD, 40, 2001)
    np.testing.assert_array_equal(smooth_sqrt(h), np.sqrt(h))
    below = np.linspace(0, LAMINAR_THRESHOLD, 4001)
    gap = np.sqrt(below) - np.asarray(smooth_sqrt(below))
    assert gap.min() > -1e-12
    assert 0.17 < gap.max() / LAMINAR_THRESHOLD**0.5 < 0.175
    assert abs(below[gap.argmax()] / LAMINAR_THRESHOLD - 0.13) < 0.01
    assert smooth_sqrt(jnp.float64(0.0)) == 0.0
    assert smooth_sqrt(jnp.float64(-0.5)) < 0.0  # draws a level back to zero


def test_second_derivatives_of_the_roots_are_finite_below_zero():
    for f in (smooth_sqrt, lambda h: clipped_sqrt(h, 0.01)):
        h = np.array([-1.0, -1e-9, 0.0, 0.005, 0.01, 1.0])
        for second in (jax.jacfwd(jax.grad(f)), jax.grad(jax.jacfwd(f))):
            assert np.isfinite(jax.jit(jax.vmap(second))(h)).all()


@pytest.mark.slow
@pytest.mark.parametrize("ramp, lowest, moved", [(60.0, 0.2, 1e-12), (30.0, 0.003, 3e-3)])
def test_smooth_root_moves_the_benchmark_by_less_than_its_promise(gouta, ramp, lowest, moved):
    """Against a knee a thousand times smaller: nothing above the knee, 3e-3 cm where tank 3 comes
    down to 0.004 cm.
    """
    case = gouta("ngpc", {"reference.ramp": ramp})
    plant = dataclasses.replace(case.loop.plant, knee=1e-5)
    sharp = jaxtank.simulate(
        dataclasses.replace(case.loop, plant=plant), case.clock, save_every=100
    )
    smooth = jaxtank.simulate(case.loop, case.clock, save_every=100)
    assert lowest < np.asarray(smooth.x).min() < 2 * lowest
    difference = np.abs(np.asarray(sharp.x) - np.asarray(smooth.x)).max()
    assert difference <= moved and (difference > 1e-5) == (ramp == 30.0)


EQUILIBRIA = [  # gouta2015 notes S2.3
    ((8, 8), (7.34218, 7.34218), (2.94924, 2.94924)),
    ((8, 14), (0.93885, 28.35800), (1.05462, 5.79609)),
    ((16, 14), (18.70079, 9.56107), (4.70682, 3.36551)),
    ((16, 10), (29.47178, 2.05263), (5.90882, 1.55938)),
]


@pytest.mark.parametrize("r, upper, u", EQUILIBRIA)
@pytest.mark.parametrize("area", [FAST_AREA, 353.43])
def test_equilibria_of_the_four_tank(r, upper, u, area):
    x, volts = equilibrium(state_coupled_four_tank(area), r)
    np.testing.assert_allclose(x, (*r, *upper), atol=6e-6)
    np.testing.assert_allclose(volts, u, atol=6e-6)


@pytest.mark.parametrize("r, tank", [((16, 3), 4), ((3, 16), 3), ((16, 7), 4)])
def test_no_equilibrium_is_reported_with_the_tank(r, tank):
    with pytest.raises(EquilibriumError, match=f"tank {tank}"):
        equilibrium(state_coupled_four_tank(FAST_AREA), r)


def test_equilibria_exist_between_the_ratios_of_the_notes():
    plant = state_coupled_four_tank(FAST_AREA)
    for ratio, exists in ((0.442, False), (0.444, True), (2.257, True), (2.259, False)):
        if exists:
            equilibrium(plant, (5.0 * ratio, 5.0))
        else:
            with pytest.raises(EquilibriumError):
                equilibrium(plant, (5.0 * ratio, 5.0))


def caught_below(seed, inflow):
    """A stiff network of 2 to 5 tanks with `bottom`, and a basin: everything that leaves a tank
    arrives in another one.
    """
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 6))
    links = tuple((i, j) for i in range(n) for j in range(n) if i != j and rng.random() < 0.3)
    pipes = tuple((i, j) for i in range(n) for j in range(i) if rng.random() < 0.3)
    area = np.r_[10.0 ** rng.uniform(-1, 2, n), 100.0]
    plant = network(
        area=area, drain=0.0, links=(*links, (0, n)),
        orifice=10.0 ** rng.uniform(-2, 1, len(links) + 1), pipes=pipes,
        pipe=10.0 ** rng.uniform(-2, 1, len(pipes)), pump_gain=rng.uniform(1, 10),
        feeds=((0, n - 1),), split=0.5, rim=1e6, bottom=True,
    )  # fmt: skip
    d = np.where(rng.random(n + 1) < 0.5, inflow * rng.uniform(0, 20, n + 1), 0.0)
    return plant, np.r_[rng.uniform(0, 5, n) * (rng.random(n) < 0.7), 0.0], d


@pytest.mark.extended_for("0-rk4")
@pytest.mark.parametrize("integrator", ["rk4", "midpoint"])
@pytest.mark.parametrize("seed", range(2))
def test_volume_is_kept_in_steps_in_which_tanks_run_empty(seed, integrator):
    """What is stored is what was there, has been pumped and drawn, and could not be drawn; to
    rounding, rings and pipes included.
    """
    plant, x, d = caught_below(seed, -1.0)
    area, pumped, missing = np.asarray(plant.area), 0.0, 0.0
    before, moved = area @ x, area @ x

    @jax.jit
    def step(x, u):
        x = integrate(plant, integrator, 0.0, x, (u,), tuple(d), 1.0)
        return plant.spill(x)[0], sum(plant.shortfall(x))

    for k in range(60):
        u = 3.0 if k < 30 else 0.0
        x, short = step(tuple(x), u)
        pumped, missing = pumped + float(plant.pump_gain[0]) * u, missing + float(short)
    assert min(x) >= 0.0 and missing > 0.0
    moved += pumped + 60.0 * np.abs(d).sum()
    assert abs(area @ np.array(x) - (before + pumped + 60.0 * d.sum() + missing)) < 1e-12 * moved


@pytest.mark.extended_for("0")
@pytest.mark.parametrize("seed", range(2))
def test_without_a_negative_inflow_no_step_takes_a_level_below_zero(seed):
    plant, x, d = caught_below(seed, 1.0)
    step = jax.jit(lambda x: integrate(plant, "rk4", 0.0, x, (0.0,), tuple(d), 3.0))
    for _ in range(40):
        x = step(tuple(x))
        assert min(float(h) for h in x) > -1e-12


@pytest.mark.extended
def test_the_lower_clip_changes_no_bit_of_tanks_that_are_not_empty():
    plant, x, u = state_coupled_four_tank(FAST_AREA), (8.0, 5.0, 12.0, 20.0), (3.0, 6.0)
    for integrator in ("rk4", "midpoint"):
        free, limited = (
            held(p, x, u, 0.5, 40, integrator)
            for p in (plant, dataclasses.replace(plant, bottom=True))
        )
        np.testing.assert_array_equal(free, limited)


@pytest.mark.extended_for("rk4")
@pytest.mark.parametrize("integrator", ["rk4", "midpoint"])
def test_halved_steps_converge_for_a_tank_that_runs_empty(integrator):
    """Of second order through the emptying, with a negative inflow after it: the level of the tank
    below.
    """
    plant = network(
        area=[3.0, 4.0], drain=[0.0, 0.02], links=((0, 1),), orifice=[0.3], pump_gain=1.0,
        feeds=((0, None),), rim=10.0, gravity=0.5, bottom=True,
    )  # fmt: skip

    step = jax.jit(
        lambda x, h: plant.spill(integrate(plant, integrator, 0.0, x, (0.0,), (-0.05, 0.0), h))[0]
    )

    def below(steps):
        x = (5.0, 3.0)
        for _ in range(steps):
            x = step(x, 80.0 / steps)
        assert x[0] == 0.0
        return float(x[1])

    exact = below(5120)
    errors = [abs(below(n) - exact) for n in (20, 40, 80, 160, 320)]
    assert errors[0] < 0.04 and errors[-1] < errors[0] / 100, errors


@pytest.mark.parametrize(
    "change, words",
    [
        ({"drain": [0.1, 0.1, 0.1]}, "plant.drain has 3 entries for 2"),
        ({"links": ((0, 5),), "orifice": [0.1]}, "tank 5"),
        ({"feeds": ((0, None), (7, None))}, "tank 7"),
        ({"outputs": (4,)}, "tank 4"),
    ],
)
def test_a_network_that_does_not_fit_together_is_refused(change, words):
    plain = {
        "area": [10.0, 10.0],
        "drain": 0.1,
        "pump_gain": 5.0,
        "feeds": ((0, None), (1, None)),
        "rim": 20.0,
    }
    with pytest.raises(InputError, match=words):
        network(**{**plain, **change})


def test_a_quadruple_tank_splits_its_pumps():
    """Johansson's topology: pump 1 to tanks 1 and 4, pump 2 to tanks 2 and 3; its equilibrium is a
    fixed point.
    """
    plant = network(
        area=[28, 32, 28, 32], drain=[0.071, 0.057, 0, 0], links=((2, 0), (3, 1)),
        orifice=[0.071, 0.057], pump_gain=[3.33, 3.35], split=[0.7, 0.6], feeds=((0, 3), (1, 2)),
        rim=20.0, outputs=(0, 1),
    )  # fmt: skip
    x, u = equilibrium(plant, (12.4, 12.7))
    # the published operating point, to its rounding
    np.testing.assert_allclose(x, (12.4, 12.7, 1.8, 1.4), atol=0.35)
    np.testing.assert_allclose(
        plant.derivative(0.0, tuple(x), tuple(u), None), np.zeros(4), atol=1e-12
    )


def test_the_clock_does_not_drift():
    clock = Clock(dt=0.01, duration=1200.0)
    assert clock.samples == 120001
    from jaxtank.core.clock import sample_times

    assert sample_times(clock)[-1] == 1200.0 and sample_times(clock)[47000] == 470.0


def test_a_knee_too_small_for_its_powers_is_refused():
    """At the least that is taken, value and slope of a root at an empty tank are numbers, in the
    shorter floats too.
    """
    with pytest.raises(InputError, match=r"plant\.knee = 1e-300 m: must be at least 1e-15 m"):
        one_tank(units=("m", "V"), knee=1e-300)
    least = one_tank(knee=1e-15).knee
    for level in (0.0, 1e-16, 1e-15, 1.0):
        for kind in (np.float32, np.float64):
            value, slope = jax.value_and_grad(smooth_sqrt)(kind(level), least)
            assert np.isfinite(value) and np.isfinite(slope)
        assert level in (0.0, 1e-16) or float(value) == np.sqrt(level)


def test_a_pipe_has_no_direction_also_where_a_step_would_take_more_than_a_tank_holds():
    for levels in ((0.02, 9.0), (9.0, 0.02), (0.02, 0.01)):
        rates = []
        for ends in ((0, 1), (1, 0)):
            plant = network(
                area=[20.0, 30.0], drain=[0.1, 0.1], pump_gain=[5.0], feeds=((0, None),),
                pipes=(ends,), pipe=[0.8], rim=[30.0, 30.0], bottom=True,
            )  # fmt: skip
            rates.append(plant._plain_flows(levels, (0.0,), None, 0.5))
        np.testing.assert_allclose(*rates, rtol=1e-13)

"""Physics by property: what must hold of every rig, on random ones (random_rigs.py), whatever joins
the tanks.

A default run tries a few rigs of each, `pytest -m slow tests/audits/test_properties.py` hundreds.
Examples are the same in every run. All rigs are of one compiled shape, so that none is compiled for
an example.
"""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import in_metres
from hypothesis import assume, given, settings, strategies as st
from random_rigs import FEEDS, KINDS, RIM, SIZE, flows, levels, random_rig, relabelled, voltages
from scipy.integrate import solve_ivp

from jaxtank.analysis.steady_state import steady_levels
from jaxtank.core.tree import component
from jaxtank.plants import Plant
from jaxtank.plants.network import TankNetwork, network
from jaxtank.plants.runge_kutta import integrate
from jaxtank.xla.hoist import scan

STILL = np.zeros(SIZE)
LONGEST = 2560
"""Steps of the one compiled run."""

SMOOTH = 0.5
"""Knee [cm] of the rigs of which an order, or nine digits, are asked. Where the levels of two tanks
that are joined below the surface cross, flow
bends within one knee: with 0.01 cm no step of 0.1 s sees it.
"""


def of_every_rig(few=4, many=200):
    """The property is checked on `few` random rigs, in slow mode on `many`: it takes (seed, tanks,
    kind). few = 0: in slow mode alone, for what needs a program of its own (5 s of compilation) and
    has a quicker sibling in test_physics.py.
    """

    def decorate(check):
        @pytest.mark.parametrize(
            "examples", [*[few] * (few > 0), pytest.param(many, marks=pytest.mark.slow)]
        )
        @functools.wraps(check)
        def test(examples):
            drawn = given(st.integers(0, 2**32 - 1), st.integers(1, SIZE), st.sampled_from(KINDS))
            settings(max_examples=examples, derandomize=True, deadline=None, database=None)(
                drawn(check)
            )()

        del test.__wrapped__  # pytest would take the property's arguments for fixtures
        return test

    return decorate


class Counted(Plant):
    """A rig with one more state: the volume that has come in from pumps and pours less what has
    left for the basin [cm^3].
    """

    def __init__(self, plant):
        self.plant = plant

    tanks = property(lambda self: self.plant.tanks + 1)
    pumps = property(lambda self: self.plant.pumps)

    def derivative(self, t, x, u, d):
        plant, x = self.plant, x[:-1]
        pumped = sum(gain * volts for gain, volts in zip(plant.pump_gain, u))
        left = sum(s * (h / jnp.sqrt(h)) for s, h in zip(self._speeds(x), self._film(x)))
        return (*plant.derivative(t, x, u, d), pumped + sum(d) - left)

    def _speeds(self, x):
        return [s * jnp.sqrt(2.0 * self.plant.gravity) for s in self.plant.drain]

    def _film(self, x):
        """Levels whose square root is the rig's, film included: written anew from the docstring of
        numerics.smooth_sqrt.
        """
        k = self.plant.knee
        return [
            jnp.where(h >= k, h, k * (1.5 * h / k - 0.5 * (h / k) ** 2) ** 2) + 1e-300 for h in x
        ]

    def spill(self, x):
        held, lost = self.plant.spill(x[:-1])
        return (*held, x[-1]), lost


@functools.partial(jax.jit, static_argnames="integrator")
def _course(plant, x, u, d, steps, integrator):
    whole, u, d = Counted(plant), tuple(u), tuple(d)

    def advance(carry, dt):
        x, lost = carry
        x, spilled = whole.spill(integrate(whole, integrator, 0.0, x, u, d, dt))
        return (x, tuple(a + b for a, b in zip(lost, spilled))), jnp.stack(x[:-1])

    zero = jnp.zeros(())
    (x, lost), path = scan(advance, ((*x, zero), (zero,) * SIZE), steps, length=LONGEST)
    return path, jnp.stack(lost), x[-1]


def course(plant, x, u, d, dt=0.1, steps=300, integrator="rk4"):
    """((steps, SIZE) levels after each step, (SIZE,) volume lost over each rim, net volume let in)
    with the pumps held. What is left of the one compiled length has steps of 0 s.
    """
    dts = np.where(np.arange(LONGEST) < steps, dt, 0.0)
    path, lost, net = _course(
        plant, jnp.asarray(x), jnp.asarray(u), jnp.asarray(d), dts, integrator
    )
    return np.asarray(path)[:steps], np.asarray(lost), float(net)


def after(plant, x, u, d, dt, steps, integrator="rk4"):
    """Levels (SIZE,) after so many steps."""
    return course(plant, x, u, d, dt, steps, integrator)[0][-1]


@pytest.mark.slow_for("16")
@of_every_rig(16, 500)
def test_mass_is_kept_with_what_is_lost_over_the_rims(seed, tanks, kind):
    """What is stored has come in and has not been lost: the same Runge-Kutta steps of one more
    state say how much came in. 1e-10 of what moved; 300 steps leave some 1e-13. No level is below
    zero or above its rim on the way.
    """
    plant, rng, pumps = random_rig(seed, tanks, kind, rim=RIM)
    x, u, d = (
        levels(rng, tanks),
        voltages(rng, pumps, high=40.0),
        np.r_[rng.uniform(0, 300, tanks), np.zeros(SIZE - tanks)],
    )
    if rng.random() < 0.3:
        x[rng.integers(tanks)] = 0.0
    path, lost, net = course(plant, x, u, d)
    moved = max(plant.area @ x, plant.area @ path[-1], abs(net), lost.sum())
    assert abs(plant.area @ (path[-1] - x) - (net - lost.sum())) < 1e-10 * moved
    assert np.all(lost >= 0) and np.all(path <= RIM)
    assert np.all(path >= 0) and np.all(path[:, tanks:] == 0)


@pytest.mark.slow_for("4")
@of_every_rig()
def test_tanks_run_dry_and_never_below(seed, tanks, kind):
    """From low levels with the pumps off, in steps that resolve the film (the fastest here falls by
    8 1/s at the bottom, a step is 0.1 s).
    """
    plant, rng, _ = random_rig(seed, tanks, kind)
    path = course(plant, levels(rng, tanks, 0.0, 0.3), np.zeros(len(FEEDS)), STILL)[0]
    assert np.all(path >= 0)
    assert np.all(np.diff(path @ plant.area) <= 1e-12 * plant.area.sum())


def never_lower(plant, x, more_x, u, more_u):
    """How far the run that starts higher and is fed more comes below the other anywhere [cm]."""
    low, high = (course(plant, a, v, STILL)[0] for a, v in ((x, u), (more_x, more_u)))
    return (low - high).max()


@pytest.mark.slow_for("6")
@of_every_rig(6, 500)
def test_more_voltage_never_lowers_a_level(seed, tanks, kind):
    """Every network is cooperative, whatever its orifices, pipes and rims: what flows into a tank
    does not fall with another one's level (roots grow, also the signed one), nor with an input (0
    <= split <= 1), and a rim sheds only what is above it (0 <= caught <= 1). So the order of two
    states and two inputs is kept for ever (Kamke). It is the open rig that is meant: with a law
    that feeds levels back, with a pump's hysteresis, or with a share outside [0, 1], it is not so.
    """
    plant, rng, pumps = random_rig(seed, tanks, kind, rim=RIM)
    x, u = levels(rng, tanks), voltages(rng, pumps)
    more_u = u + voltages(rng, pumps[: 1 + rng.integers(len(pumps))])
    higher = np.minimum(x + levels(rng, tanks, 0, 5) * (rng.random(SIZE) < 0.5), RIM)
    assert never_lower(plant, x, higher, u, more_u) <= 1e-12


@of_every_rig(few=0)
def test_no_level_and_no_input_lowers_another_tanks_rate(seed, tanks, kind):
    """Kamke's condition itself: the slopes across tanks and by inputs are not negative."""
    plant, rng, pumps = random_rig(seed, tanks, kind)
    by_x, by_u = slopes(plant, levels(rng, tanks), voltages(rng, pumps))
    assert np.all(by_x[~np.eye(SIZE, dtype=bool)] >= 0) and np.all(by_u >= 0) and np.any(by_u > 0)


@jax.jit
def slopes(plant, x, u):
    return jax.jacfwd(
        lambda x, u: jnp.stack(plant.derivative(0.0, tuple(x), tuple(u), None)), argnums=(0, 1)
    )(x, u)


@jax.jit
def both_ways(plant, x, u):
    return plant.rates(x, u), jnp.stack(plant.derivative(0.0, tuple(x), tuple(u), None))


@pytest.mark.extended
@of_every_rig()
def test_rates_by_vectors_are_those_tank_by_tank(seed, tanks, kind):
    """What steady states are looked for with, below the knee and at equal levels too."""
    plant, rng, pumps = random_rig(seed, tanks, kind)
    for x in (
        levels(rng, tanks),
        levels(rng, tanks, -0.01, 0.02),
        np.full(SIZE, rng.uniform(0, RIM)),
    ):
        vectors, scalars = both_ways(plant, x, voltages(rng, pumps))
        np.testing.assert_allclose(vectors, scalars, rtol=1e-12, atol=1e-12)


@pytest.mark.extended
def test_a_plant_with_a_vector_field_of_its_own_keeps_it():
    @component
    class Leaky(TankNetwork):
        def derivative(self, t, x, u, d):
            return tuple(rate - 1.0 for rate in super().derivative(t, x, u, d))

    plant = spilling([10.0] * 2, (), ())
    leaky = Leaky(**{f.name: getattr(plant, f.name) for f in dataclasses.fields(plant)})
    x, u = np.full(2, 5.0), np.ones(plant.pumps)
    np.testing.assert_allclose(leaky.rates(x, u), plant.rates(x, u) - 1.0, rtol=1e-12)


@pytest.mark.extended
def test_a_pump_that_draws_from_a_tank_is_named_apart():
    """The same check finds a rig that is not cooperative: a pump that gives one tank more than it
    delivers, out of another.
    """
    plant, rng, pumps = random_rig(0, 4, "quadruple")
    x, u = levels(rng, 4, 5.0), voltages(rng, pumps, 1.0, 2.0)
    drawing = dataclasses.replace(
        plant, split=np.where(np.isin(np.arange(len(FEEDS)), pumps), 1.5, plant.split)
    )
    assert never_lower(plant, x, x, u, 2 * u) <= 1e-12 < 0.1 < never_lower(drawing, x, x, u, 2 * u)


@of_every_rig()
def test_an_equilibrium_stays_one(seed, tanks, kind):
    """Inflows that balance random levels, reckoned without the library, hold them for 300 steps; so
    do the levels of `steady_levels`.
    """
    plant, rng, pumps = random_rig(seed, tanks, kind)
    x, u = levels(rng, tanks, 1.0), voltages(rng, pumps)
    d = -flows(plant, x, u, STILL)[0]
    path = course(plant, x, u, d)[0]
    np.testing.assert_allclose(path, np.broadcast_to(x, path.shape), rtol=1e-12, atol=1e-12)
    if not np.any(plant.pipe):
        free = dataclasses.replace(plant, pipes=(), pipe=np.zeros(0))
        rest = np.asarray(rests(free, u))
        assume(rest[:tanks].min() > free.knee)  # in the film the closed form is another
        # levels may be metres high here: rims are not physics
        moved = course(plant, rest, u, STILL)[0] - rest
        assert np.abs(moved).max() < 1e-11 * rest.max()


@jax.jit
def rests(plant, u):
    return steady_levels(plant, u)


@of_every_rig()
def test_the_order_of_the_tanks_is_a_name(seed, tanks, kind):
    """The rig with its tanks in another order moves the same way. Sums come in another order:
    1e-12.
    """
    plant, rng, pumps = random_rig(seed, tanks, kind)
    order = tuple(rng.permutation(SIZE))
    other, of = relabelled(plant, order)
    x, u = levels(rng, tanks), voltages(rng, pumps)
    here, there = course(plant, x, u, STILL)[0], course(other, x[list(order)], u[of], STILL)[0]
    np.testing.assert_allclose(here[:, order], there, rtol=1e-12, atol=1e-12)


@of_every_rig()
def test_swapped_inputs_of_a_symmetric_rig_give_swapped_levels(seed, tanks, kind):
    """Two equal halves of up to three tanks, joined by what is its own mirror image."""
    plant, rng, _ = random_rig(seed, SIZE, kind)
    permuted = (3, 4, 5, 0, 1, 2)
    image, of = relabelled(plant, permuted)
    names = ("area", "drain", "orifice", "pipe", "pump_gain", "split")
    even = dataclasses.replace(
        image,
        **{n: 0.5 * (np.asarray(getattr(plant, n)) + np.asarray(getattr(image, n))) for n in names},
    )
    x, u = levels(rng, SIZE), rng.uniform(0, 5, len(FEEDS))
    one, two = course(even, x, u, STILL)[0], course(even, x[list(permuted)], u[of], STILL)[0]
    np.testing.assert_allclose(one[:, permuted], two, rtol=1e-12, atol=1e-12)
    assert np.abs(one - two).max() > 1e-3  # they are two runs


@of_every_rig(few=0)
def test_metres_change_nothing(seed, tanks, kind):
    plant, rng, pumps = random_rig(seed, tanks, kind, rim=RIM)
    x, u, d = (
        levels(rng, tanks),
        voltages(rng, pumps, high=30.0),
        np.r_[rng.uniform(0, 100, tanks), np.zeros(SIZE - tanks)],
    )
    cm, m = course(plant, x, u, d), course(in_metres(plant), x / 100, u, d / 1e6)
    for here, there, factor in zip(cm, m, (1e2, 1e6, 1e6)):
        np.testing.assert_allclose(here, factor * there, rtol=1e-11, atol=1e-11)


@of_every_rig()
def test_a_tank_by_itself_drains_as_the_root_of_its_level(seed, tanks, kind):
    """sqrt(h) falls linearly in time, sqrt(h0) - s sqrt(g/2) t / A, until the film: all six tanks,
    every coupling closed.
    """
    plant, rng, _ = random_rig(seed, SIZE, kind)
    drain = rng.uniform(0.05, 0.3, SIZE)
    alone = dataclasses.replace(
        plant, drain=drain, orifice=0.0 * plant.orifice, pipe=0.0 * plant.pipe
    )
    x = levels(rng, SIZE, 10.0)
    path = course(alone, x, np.zeros(len(FEEDS)), STILL)[0]
    t = 0.1 * np.arange(1, len(path) + 1)[:, None]
    root = np.sqrt(x) - drain * np.sqrt(981.0 / 2) / plant.area * t
    deep = root > 1.0
    assert deep.sum() > 300
    # a step of 0.1 s is 1e-2 of what it takes to empty the fastest tank: fourth order leaves 1e-10
    np.testing.assert_allclose(np.sqrt(path)[deep], root[deep], atol=1e-9)


def smooth_rig(seed, tanks, kind):
    """A rig and a stretch without kinks: levels stay above the knee."""
    plant, rng, pumps = random_rig(seed, tanks, kind, knee=SMOOTH)
    x, u = levels(rng, tanks, 5.0), voltages(rng, pumps)
    d = np.r_[rng.uniform(5, 60, tanks), np.zeros(SIZE - tanks)]
    assume(course(plant, x, u, d, steps=200)[0][:, :tanks].min() > 2 * SMOOTH)
    return plant, x, u, d


def check_order(plant, x, u, d, integrator, order):
    """Twice the steps, 2^order of the error less: against 2,560 steps of rk4, at 20 to 160 steps of
    20 s, by the finest pair that is not round-off.
    """
    exact = after(plant, x, u, d, 20.0 / LONGEST, LONGEST)
    finals = [after(plant, x, u, d, 20.0 / n, n, integrator) for n in (20, 40, 80, 160)]
    errors = np.abs(finals - exact).max(axis=1)
    large = errors[1:] > 1e-11
    if large.any():
        slope = np.log2(errors[:-1] / errors[1:])[large][-1]
        assert order - 0.3 < slope < order + 1.0, errors
    assert errors[-1] < 1e-4


@pytest.mark.slow_for("4")
@of_every_rig()
def test_runge_kutta_is_of_fourth_order(seed, tanks, kind):
    check_order(*smooth_rig(seed, tanks, kind), "rk4", 4)


@of_every_rig(few=0)
def test_the_midpoint_rule_is_of_second_order(seed, tanks, kind):
    check_order(*smooth_rig(seed, tanks, kind), "midpoint", 2)


@of_every_rig()
def test_another_solver_and_other_equations_agree(seed, tanks, kind):
    """scipy's LSODA on the equations as numpy has them (random_rigs.flows): 1e-9 cm after 20 s. rk4
    in steps of 0.01 s leaves some 1e-12, LSODA at its tightest some 1e-10.
    """
    plant, x, u, d = smooth_rig(seed, tanks, kind)
    rate = lambda t, h: flows(plant, h, u, d)[0] / plant.area
    exact = solve_ivp(rate, (0, 20.0), x, method="LSODA", rtol=2.5e-14, atol=1e-13).y[:, -1]
    np.testing.assert_allclose(after(plant, x, u, d, 0.01, 2000), exact, atol=1e-9)


@functools.cache
def by_diffrax():
    """Levels after 20 s by Dopri8 of diffrax, compiled once."""
    diffrax = pytest.importorskip(
        "diffrax", reason="diffrax is not installed: it is not needed to test, only to compare"
    )

    @jax.jit
    def solve(plant, x, u, d):
        term = diffrax.ODETerm(
            lambda t, h, _: jnp.stack(plant.derivative(t, tuple(h), tuple(u), tuple(d)))
        )
        near = diffrax.PIDController(rtol=1e-12, atol=1e-12)
        options = {"stepsize_controller": near, "max_steps": 20000}
        solver, x = diffrax.Dopri8(), jnp.asarray(x)
        found = diffrax.diffeqsolve(term, solver, 0.0, 20.0, 0.01, x, **options)
        return found.ys[-1]

    return solve


@of_every_rig()
def test_diffrax_agrees(seed, tanks, kind):
    solve = by_diffrax()
    plant, x, u, d = smooth_rig(seed, tanks, kind)
    np.testing.assert_allclose(
        after(plant, x, u, d, 0.01, 2000), np.asarray(solve(plant, x, u, d)), atol=1e-9
    )


def spilling(area, spills, caught):
    """Tanks with rims at 10 cm."""
    numbers = {"drain": 0.1, "pump_gain": 5.0, "feeds": ((0, None),), "rim": 10.0}
    return network(area=area, spills=spills, caught=caught, overflow=True, **numbers)


@pytest.mark.parametrize("seed", range(10))
def test_no_level_is_left_above_a_rim_whoever_spills_into_whom(seed):
    """Spills named in any order, rings too: nothing is above its rim afterwards, and what is gone
    is counted.
    """
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 6))
    every = itertools.permutations(range(n), 2)
    pairs = [(i, j) for i, j in every if (seed % 2 or i < j) and rng.random() < 0.5]
    spills = tuple(pairs[k] for k in rng.permutation(len(pairs)))
    sources = [source for source, _ in spills]
    caught = [rng.uniform(0, 1) / sources.count(source) for source in sources]
    area, x = rng.uniform(10, 100, n), rng.uniform(5, 15, n)
    plant = spilling(area, spills, caught or ())
    held, lost = (np.array([float(v) for v in part]) for part in plant.spill(tuple(x)))
    assert np.all(held <= 10.0) and np.all(lost >= -1e-12)
    np.testing.assert_allclose(area @ held + lost.sum(), area @ x, rtol=1e-13)


def test_a_chain_of_spills_may_be_named_from_below():
    """Tank 2 spills into 3 and 3 into 1: what passes all three rims is lost at the last, whichever
    spill is named first.
    """
    for spills in (((1, 2), (2, 0)), ((2, 0), (1, 2))):
        plant = spilling([10.0] * 3, spills, 1.0)
        held, lost = plant.spill((10.0, 12.0, 10.0))
        assert [float(v) for v in held] == [10.0, 10.0, 10.0]
        assert [float(v) for v in lost] == [20.0, 0.0, 0.0]

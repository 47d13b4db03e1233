"""Overflow leaves, and enters the tank below, while it flows and not when a step ends."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxtank
from jaxtank import component, presets, rig
from jaxtank.core.errors import InputError
from jaxtank.plants.network import network
from jaxtank.plants.runge_kutta import advance
from jaxtank.plants.tank_network import TankNetwork
from tuning.uncertainty.needs import unjudged

GRAVITY, FLOW, DRAIN = 981.0, 180.0, 1.5
BELOW = (FLOW / DRAIN) ** 2 / (2.0 * GRAVITY)  # Torricelli: the level whose outflow is FLOW


def weir(tanks=2, **more):
    """A full tank whose pump pours FLOW over its rim into one with an outlet; others are empty."""
    return network(
        area=[200.0, 150.0] + [1.0] * (tanks - 2), drain=[0.0, DRAIN] + [0.0] * (tanks - 2),
        rim=40.0, pump_gain=30.0, feeds=[(0, None)], spills=[(0, 1)], caught=1.0, gravity=GRAVITY,
        overflow=True, bottom=True, **more,
    )  # fmt: skip


def after(plant, x, u, dt, steps):
    """(Levels, volumes lost) after that many steps with the input held."""
    start = jax.tree.map(lambda v: jnp.asarray(v, dtype=float), x)

    def step(carry, _):
        moved = advance(plant, "rk4", 0.0, carry[0], u, None, dt, 1)
        lost = jax.tree.map(lambda a, b: a + b, carry[1], moved.spilled)
        return (moved.x, lost), None

    carry = (start, jax.tree.map(jnp.zeros_like, start))
    x, lost = jax.lax.scan(step, carry, length=steps)[0]
    return np.array(x), np.array(lost)


@pytest.mark.extended_for("by volume-0.25", "by volume-1.0", "by volume-4.0")
@pytest.mark.parametrize("dt", [0.25, 1.0, 4.0])
@pytest.mark.parametrize("form", ["scalars", "arrays", "by volume"])
def test_a_tank_below_a_weir_stands_where_its_outlet_carries_the_flow(form, dt):
    tanks = 12 if form == "arrays" else 2
    plant = weir(tanks)
    if form == "by volume":
        plant = weir(shapes=["sphere", "prism"], extent=[40.0, 40.0])
    x, u = (40.0, 10.0, *[0.0] * (tanks - 2)), (6.0,)
    if form == "arrays":
        x, u = jnp.array(x), jnp.array(u)
    levels, lost = after(plant, x, u, dt, int(1200 / dt))
    assert levels[0] == 40.0 and lost[0] == pytest.approx(0.0, abs=1e-9)
    assert levels[1] == pytest.approx(BELOW, rel=1e-9)


def chain(drain):
    """Two tanks that overflow one into the next, a pipe from the first, a third that collects."""
    return network(
        area=[20.0, 15.0, 300.0, 30.0], drain=[drain, drain, 0.0, drain],
        rim=[10.0, 8.0, 90.0, 40.0], pipes=[(0, 3)], pipe=0.05, pump_gain=20.0, feeds=[(0, None)],
        spills=[(0, 1), (1, 2)], caught=[1.0, 0.9], gravity=GRAVITY, overflow=True, bottom=True,
    )  # fmt: skip


def test_no_volume_is_lost_in_a_chain_of_overflows():
    plant, start = chain(0.0), (9.0, 7.5, 0.0, 3.0)
    levels, lost = after(plant, start, (6.0,), 0.5, 200)
    stored = lambda x: float(np.dot(plant.area, x))
    assert lost[1] > 100.0
    assert stored(levels) + lost.sum() == pytest.approx(stored(start) + 120.0 * 100.0, rel=1e-12)


@pytest.mark.extended
def test_a_chain_of_overflows_is_of_second_order_in_the_step():
    plant, start = chain(0.1), (10.0, 8.0, 0.0, 3.0)
    at = lambda dt: after(plant, start, (6.0,), dt, int(20 / dt))[0]
    exact = at(1 / 256)
    coarse, fine = np.abs(at(0.5) - exact), np.abs(at(0.25) - exact)
    assert np.all(fine <= 0.35 * coarse) and 1e-7 < coarse.max() < 1e-3


@pytest.mark.parametrize("dt", [1.0, 10.0])
def test_a_full_tank_loses_what_its_outlet_does_not_carry(dt):
    plant = network(
        area=5000.0, drain=4.0, rim=120.0, pump_gain=30.0, feeds=[(0, None)], gravity=GRAVITY,
        overflow=True, bottom=True,
    )  # fmt: skip
    levels, lost = after(plant, (120.0,), (100.0,), dt, int(1800 / dt))
    carried = 4.0 * (2.0 * GRAVITY * 120.0) ** 0.5
    assert levels[0] == 120.0
    assert lost[0] == pytest.approx((3000.0 - carried) * 1800.0, rel=1e-4)


def test_a_class_with_a_spill_of_its_own_is_asked_as_before():
    @component
    class Lidded(TankNetwork):
        def spill(self, x):
            return x, tuple(0.0 * v for v in x)

    plain = weir()
    fields = {f.name: getattr(plain, f.name) for f in dataclasses.fields(plain)}
    levels, lost = after(Lidded(**fields), (40.0, 10.0), (6.0,), 1.0, 10)
    assert levels[0] == pytest.approx(40.0 + 10.0 * FLOW / 200.0) and not lost.any()


WEIR = """
units = ["cm", "V"]
tank = [{ area = 200.0, rim = 50.0, level = 38.0, drain = 0.3 },
        { area = 150.0, rim = 20.0, level = 4.0, drain = 1.5 }]
spill = [{ from = 1, to = 2, port = 40.0 }]
pump = [{ gain = 30.0, to = 1, high = 12.0, initial = 6.0 }]
plant = { overflow = true, outputs = [2] }
controller = { kind = "pi", Kc = 2.0, Ti = 60.0 }
reference = { initial = [4.0], changes = [[120.0, 1, 8.0]] }
values = { "clock.dt" = 1.0, "clock.duration" = 600.0 }
"""


def test_setpoints_that_need_an_overflow_are_not_called_out_of_reach():
    """The setpoint of 8 cm is held, by what passes the weir: no steady state without it."""
    case = rig.loads(WEIR)
    run = jaxtank.simulate(rig.check(case))
    assert run.x[-1, 0] == 40.0 and run.x[-1, 1] == pytest.approx(8.0, abs=0.05)
    assert "overflows from tank 1" in unjudged(case)
    lossy = WEIR.replace("port = 40.0", "port = 40.0, caught = 0.9")
    # out of reach where tank 1 must not overflow, or where what it loses must not be lost
    for text, limit, known in (
        (WEIR, "[45.0, 20.0]", False),
        (WEIR, "[30.0, 20.0]", True),
        (WEIR, '"rim"', False),
        (lossy, '"rim"', True),
    ):
        limited = rig.loads(f"{text}\nlimits = {{ max_level = {limit} }}\n")
        assert (not unjudged(limited)) == known
    assert not unjudged(presets.find("cascaded/pi"))  # which needs no overflow
    with pytest.raises(InputError, match="port = 60 cm is above the rim of tank 1, 50 cm"):
        rig.loads(WEIR.replace("port = 40.0", "port = 60.0"))
    with pytest.raises(InputError, match="rim"):
        rig.loads(WEIR.replace("rim = 50.0", "rim = -50.0"))

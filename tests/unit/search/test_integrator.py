"""The midpoint rule in the search of a default answer: measured against RK4 before it is used."""

import dataclasses

import numpy as np
import pytest
from helpers import ONE_TANK, rk4

from jaxtank import Clock, presets, rig
from tuning.search.setting import LARGEST_ERROR, midpoint_error, setting_of


def tank(drain=2.0):
    return rig.set_values(rig.loads(ONE_TANK), {"plant.drain": drain, "clock.duration": 1000.0})


def by_hand(dt, states=20_000):
    """The same share for A dh/dt = 5 u - 2 sqrt(h), written out, at other random states."""
    random = np.random.default_rng(7)
    h, u = random.uniform(0.15, 3.0, states), 2.0 * random.uniform(size=states)
    rate = lambda h: (5.0 * u - 2.0 * np.sqrt(np.maximum(h, 0.0))) / 20.0
    exact, midpoint = rk4(rate, h, dt) - h, dt * rate(h + 0.5 * dt * rate(h))
    return np.sqrt(np.sum((midpoint - exact) ** 2) / np.sum(exact**2))


@pytest.mark.parametrize("dt", [0.5, 1.0])
def test_the_error_is_that_of_the_rule_written_out(dt):
    found = midpoint_error(tank(), Clock(dt=dt, duration=100.0), 3.0, np.array([2.0]))
    assert found == pytest.approx(by_hand(dt), rel=0.3)


def test_searches_at_a_longer_step_use_it_where_its_error_is_small():
    setting = setting_of(presets.find("gouta2015/backstepping"))
    coarse = setting.coarse()
    assert (coarse.clock.dt, coarse.clock.integrator) == (0.1, "midpoint")
    long = Clock(dt=0.1, duration=1200.0)  # too inaccurate at ten times its step
    assert midpoint_error(setting.case, Clock(dt=1.0), 30.0, setting.span) > LARGEST_ERROR
    slow = dataclasses.replace(setting, searched=setting.searched.replace(clock=long))
    assert (slow.coarse().clock.dt, slow.coarse().clock.integrator) == (1.0, "rk4")


def test_the_midpoint_rule_is_refused_where_a_tank_empties_too_fast():
    """lambda h is 2.4, then 1.9: RK4 is stable below 2.785, the midpoint rule below 2."""
    own = tank()
    loop = own.loop
    threshold = float(np.asarray(loop.plant.knee))
    rate = 1.5 * 2.0 / (20.0 * np.sqrt(threshold))  # of laminar flow at 2 cm^2 [1/s]
    clock = Clock(dt=2.4 / rate, duration=100.0)
    assert midpoint_error(own, clock, 3.0, np.array([2.0])) == np.inf
    clock = Clock(dt=1.9 / rate, duration=100.0)
    assert midpoint_error(own, clock, 3.0, np.array([2.0])) < np.inf

"""Checks of a loop: made once for its structure and values, and again once one of them differs."""

import dataclasses

import jax
import numpy as np
import pytest

import jaxtank
from jaxtank import presets
from jaxtank.core.errors import InputError
from jaxtank.core.tree import component
from jaxtank.loop import run, validation


@pytest.fixture
def looks(monkeypatch):
    """What `check_leaves` was called with since the test began; nothing has passed before."""
    found, real = [], validation.check_leaves
    monkeypatch.setattr(validation, "_PASSED", {})
    monkeypatch.setattr(
        validation, "check_leaves", lambda loop, **given: (found.append(loop), real(loop, **given))
    )
    return found


def test_a_loop_that_has_passed_is_not_looked_at_again(looks):
    case = presets.find("cascaded/pi")
    again = presets.find("cascaded/pi")
    for loop in (case.loop, case.loop, again.loop):
        jaxtank.check(loop, case.clock)
    assert len(looks) == 1


def test_every_change_is_looked_at(looks):
    case = presets.find("cascaded/pi")
    loop, noisy = case.loop, jaxtank.with_values(case.loop, {"sensor.noise": [0.1, 0.1]})
    key = jax.random.key(0)
    jaxtank.check(loop, case.clock)
    changed = [
        (jaxtank.with_values(loop, {"controller.Kc": 1.25}), case.clock, None),
        (loop, dataclasses.replace(case.clock, duration=40.0), None),
        (loop, case.clock, key),
        (noisy, case.clock, key),
    ]
    for given in changed:
        jaxtank.check(*given)
    assert len(looks) == 1 + len(changed)
    with pytest.raises(InputError, match="give a key"):
        jaxtank.check(noisy, case.clock)


def test_an_array_that_is_changed_in_place_is_looked_at_again(looks):
    case = presets.find("cascaded/pi")
    gain = np.array(2.0)
    loop = jaxtank.with_values(case.loop, {"controller.Kc": gain})
    held = loop.controller.Kc
    jaxtank.check(loop, case.clock)
    held[...] = np.nan
    with pytest.raises(InputError, match="Kc"):
        jaxtank.check(loop, case.clock)


def test_what_fails_is_not_remembered(looks):
    case = presets.find("cascaded/pi")
    bad = jaxtank.with_values(case.loop, {"controller.Kc": np.inf})
    for _ in range(2):
        with pytest.raises(InputError, match="Kc"):
            jaxtank.check(bad, case.clock)
    assert not validation._PASSED


def test_few_loops_are_remembered(looks, monkeypatch):
    monkeypatch.setattr(validation, "KEPT", 2)
    case = presets.find("cascaded/pi")
    for gain in (1.0, 2.0, 3.0, 1.0):
        jaxtank.check(jaxtank.with_values(case.loop, {"controller.Kc": gain}), case.clock)
    assert len(looks) == 4 and len(validation._PASSED) == 2


def test_a_dead_time_is_a_whole_number_of_samples():
    case = presets.find("cascaded/pi")
    delayed = lambda samples: validation._check_delay(
        dataclasses.replace(case.loop.actuator, delay=samples * case.clock.dt), case.clock
    )
    delayed(3.0)
    with pytest.raises(InputError, match="delay"):
        delayed(2.5)


def test_noise_that_has_no_key_is_reported_as_such():
    case = presets.find("cascaded/pi")
    noisy = jaxtank.with_values(case.loop, {"sensor.noise": [0.1, 0.1]})
    with pytest.raises(InputError, match="key"):
        run._report_broken(np.True_, noisy, case.clock, None)


def test_a_state_of_another_form_than_at_first_is_refused():
    case = presets.find("cascaded/pi")
    controller = case.loop.controller

    class Grown(type(controller)):
        def step(self, state, tick, estimate):
            command, after = super().step(state, tick, estimate)
            return command, (after, after)

    grown = component(Grown)(
        **{f.name: getattr(controller, f.name) for f in dataclasses.fields(controller)}
    )
    with pytest.raises(InputError):
        jaxtank.simulate(dataclasses.replace(case.loop, controller=grown), case.clock)


def test_boxqp_is_for_two_pumps(gouta):
    case = gouta("ngpc-boxqp")
    jaxtank.check(case.loop, case.clock)
    assert case.loop.actuator.allocates

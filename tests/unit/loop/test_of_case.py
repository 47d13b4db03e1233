"""Functions of a loop and a clock take a case instead of both."""

import dataclasses
import warnings

import jax
import numpy as np
import pytest

import jaxtank
from jaxtank import presets
from jaxtank.core.errors import InputError
from jaxtank.core.tree import number
from jaxtank.loop.tank_bottom import TankBottomWarning

CASE = presets.find("cascaded/pi").replace(clock=jaxtank.Clock(dt=4.0, duration=40.0))
MEASURES = ["rms_error_total", "max_level"]
GAINS = {"controller.Kc": np.array([[0.5], [2.0]])}
CALLS = {
    "simulate": (jaxtank.simulate, {"save_every": 2}),
    "evaluate": (jaxtank.evaluate, {"measures": MEASURES}),
    "evaluate_many": (jaxtank.evaluate_many, {"measures": MEASURES, "values": GAINS}),
    "sensitivities": (jaxtank.sensitivities, {"measures": MEASURES, "values": {"x0[0]": 5.0}}),
    "check": (jaxtank.check, {}),
}


@pytest.mark.extended_for("evaluate_many", "sensitivities", "simulate")
@pytest.mark.parametrize("name", CALLS)
def test_a_case_stands_for_its_loop_and_clock(name):
    function, options = CALLS[name]
    expected = function(CASE.loop, CASE.clock, **options)
    for values in (
        function(CASE, **options),
        function(CASE, *options.values()) if "save_every" not in options else expected,
        function(CASE.replace(clock=jaxtank.Clock(dt=1.0)), CASE.clock, **options),
        function(loop=CASE.loop, clock=CASE.clock, **options),
    ):
        for a, b in zip(jax.tree.leaves(values), jax.tree.leaves(expected), strict=True):
            np.testing.assert_array_equal(a, b)


def test_arguments_in_another_order_are_named():
    loop, clock = CASE.loop, CASE.clock
    for call, words in (
        (lambda: jaxtank.simulate(clock, loop), "loop is a Clock"),
        (lambda: jaxtank.evaluate(loop, MEASURES), "clock is a list"),
        (lambda: jaxtank.evaluate(MEASURES, CASE), "loop is a list"),
        (lambda: jaxtank.evaluate_many(loop, clock, GAINS, MEASURES), "loop, clock, measures, v"),
        (lambda: jaxtank.sensitivities(CASE, GAINS, MEASURES), "loop, clock, measures, values"),
    ):
        with pytest.raises(InputError, match=words):
            call()


def test_a_warning_of_a_case_is_of_the_line_that_runs_it():
    plant = dataclasses.replace(CASE.loop.plant, bottom=False)
    actuator = dataclasses.replace(CASE.loop.actuator, low=number([-5.0]), initial=number([-5.0]))
    law = jaxtank.controllers.OpenLoop(signal=jaxtank.signals.ramps([-5.0], [], ramp=0.0))
    loop = dataclasses.replace(CASE.loop, plant=plant, actuator=actuator, controller=law)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        jaxtank.simulate(CASE.replace(loop=loop))
    assert [w.filename for w in caught if w.category is TankBottomWarning] == [__file__] * 2

"""Rig files that are accepted do what they say: what random files found, and a few of them."""

import elements_by_command as audit
import numpy as np
import pytest

import jaxtank
from jaxtank.rig.read import loads


def base(**changes):
    """The text of the base rig of the audit of elements, with other tables."""
    tables = {**audit.BASE, **changes}
    return "\n".join(f"{key} = {value}" for key, value in tables.items() if value is not None)


def scheduled(knots):
    """The base rig with a gain that follows the first setpoint."""
    gains = '{variable = "r1", gains = ["controller.Kc"], knots = KNOTS}'.replace("KNOTS", knots)
    return base(free=None, schedule=gains)


def test_knots_of_a_schedule_may_have_units():
    case = loads(scheduled('["30 cm", "50 %", 0.8]'))
    np.testing.assert_allclose(case.loop.controller.knots, [0.3, 0.6, 0.8])


@pytest.mark.parametrize("knots", ['["low", 0.8]', "[[0.3], [0.8]]", "[[0.3], 0.8]", "0.3", '"3 V"'])
def test_knots_that_are_no_levels_are_refused(knots):
    with pytest.raises(jaxtank.InputError, match="knots"):
        loads(scheduled(knots))

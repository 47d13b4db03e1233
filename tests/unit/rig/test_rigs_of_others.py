"""Rigs as people bring them, in tests/data/others, each with its value by a closed form or by an
integrator of scipy.
"""

import functools
import math

import numpy as np
import pytest
from helpers import DATA
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import jaxtank
from jaxtank import rig
from jaxtank.core.errors import InputError

FOLDER = DATA / "others"
ROOT_2G = math.sqrt(2 * 9.81)
SPEED = lambda h: ROOT_2G * math.copysign(math.sqrt(abs(h)), h)
"""Speed of an outflow [m/s] under a head [m]."""


@functools.cache
def played(name):
    """(last levels, last inputs, highest and lowest levels) of a run."""
    case = rig.load(FOLDER / f"{name}.toml")
    run = jaxtank.simulate(case)
    x, u = np.asarray(run.x), np.asarray(run.u)
    return {"levels": x[-1], "inputs": u[-1], "highest": x.max(axis=0), "lowest": x.min(axis=0)}


def integrated(rates, levels, end):
    """Levels at the end of a run without a controller."""
    return solve_ivp(
        lambda t, x: rates(x), (0.0, end), levels, method="DOP853", rtol=1e-12, atol=1e-13
    ).y[:, -1]


def sphere():
    """Level of a sphere: pi (D h - h^2) h' = -a w sqrt(h), integrated in closed form."""
    volume = lambda h: math.pi * (4 / 3 * h**1.5 - 0.4 * h**2.5)
    return brentq(lambda h: volume(h) - volume(1.8) + 0.003 * ROOT_2G * 300, 0.0, 1.8, xtol=1e-14)


def basin():
    """Level of the basin: its inflow changes after 1, 2 and 4 h."""
    level = [1.0]
    for inflow, hours in ((1.0, 1), (5.0, 1), (3.0, 2), (1.0, 1)):
        rates = lambda x, q=inflow: (q - 0.5 * SPEED(x[0])) / 5000.0
        level = integrated(rates, level, 3600.0 * hours)
    return level


def three(x):
    between = [1e-4 * SPEED(x[0] - x[1]), 0.5e-4 * SPEED(x[1] - x[2]), 0.3e-4 * SPEED(x[2])]
    return np.array([2e-4 - between[0], between[0] - between[1], between[1] - between[2]]) / 0.0154


CONE = math.pi / 12 * (2 / 3) ** 2
GALLON = 0.133680556  # ft^3
RIGHT = {
    "cone_fill": {"levels": [(0.3**3 + 0.01 * 240 / CONE) ** (1 / 3)]},
    "weir": {"highest": [1.5, 1.0]},
    "pump_lift": {
        "levels": lambda: integrated(
            lambda x: (0.016 * (1 - x[0] / 10) - 0.001 * SPEED(x[0])) / 1.5, [0.5], 600.0
        )
    },
    "rate": {"levels": [0.1 + sum(min(0.05 * k, 1.0) for k in range(1, 61)) * 1e-3 / 0.2]},
    "surge": {"levels": [5 + 2.5 * (1 - (1 - 40 * GALLON / 60 / 100 * 2) ** 1200)]},
    "horizontal": {"levels": [2 - (0.2**1.5 + 1.5 * 0.003 * ROOT_2G * 600 / 8) ** (2 / 3)]},
    "sphere": {"levels": lambda: [sphere()]},
    "leak": {"levels": [2 * math.exp(-1e-4 * ROOT_2G * 3600)]},
    "reservoir": {"levels": [10.0, 10 - (math.sqrt(8) - ROOT_2G * 3600 / 2e4) ** 2]},
    "hydrograph": {"levels": basin},
    "us": {"levels": [30 + 100 * 231 / (math.pi / 4 * 48**2)]},
    "volume": {"levels": [0.7]},
    "check": {"levels": [1.1, 1.5]},
    "dry": {"levels": [0.0, 0.5]},
    "bar": {"levels": [1e4 / 9806.65 + 0.1]},
    "three": {"levels": lambda: integrated(three, [0.4, 0.3, 0.1], 60.0)},
    "fault": {"levels": [0.75]},
    "recycle_control": {"levels": [0.5, 1.25], "inputs": [0.002 * SPEED(0.5) * 3600]},
    "flow_cascade": {"levels": [1.0], "inputs": [50.0]},
    "eqpct": {
        "levels": [1.2],
        "inputs": [100 * (1 + math.log(10 / 3600 / (0.002 * SPEED(1.2))) / math.log(30))],
    },
    "staged": {"levels": [2.0], "inputs": [100.0, (0.01 * SPEED(2.0) - 0.05) / 0.0005]},
    "iso": {"levels": [0.8]},
    "pid": {"levels": [1.0], "inputs": [15 / 36 / 0.003 / ROOT_2G]},
    "ff": {"levels": [1.0], "highest": [1.0], "lowest": [1.0]},
    "float": {"highest": [2.0], "lowest": [0.5]},
}
"""{rig: what its run ends at, or reaches}."""
TOLERANCE = {
    "float": 5e-3,  # a sample of the pump's flow
    "staged": 1e-5,  # what is left of the approach at the end
    "reservoir": 1e-5,  # the lake falls by 2e-6 m
}


@pytest.mark.extended_for("ff", "pid", "staged", "weir")
@pytest.mark.slow_for(*list(RIGHT)[4:20])
@pytest.mark.parametrize("name", RIGHT)
def test_a_rig_of_others_does_what_it_does_elsewhere(name):
    run = played(name)
    for quantity, right in RIGHT[name].items():
        right = right() if callable(right) else right
        np.testing.assert_allclose(
            run[quantity], right, rtol=TOLERANCE.get(name, 1e-6), atol=TOLERANCE.get(name, 1e-6)
        )


@pytest.mark.parametrize(
    ("name", "words"), [("quant", "sensor.bits.*values"), ("sensors", "give one of them")]
)
def test_a_rig_that_cannot_be_said_is_refused_with_what_to_write(name, words):
    with pytest.raises(InputError, match=words):
        rig.load(FOLDER / f"{name}.toml")

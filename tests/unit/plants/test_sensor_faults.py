"""Faults of sensors: what they add to a reading, their derivative, and their tables in a rig."""

import jax
import numpy as np
import pytest

from jaxtank import rig
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.core.tree import with_values
from jaxtank.loop.run import evaluate, simulate

CLOCK = Clock(dt=2.0, duration=60.0)
ROWS = """
fault = [
    { sensor = 1, kind = "drift", start = 10.0, end = 30.0, size = 0.25 },
    { sensor = 1, kind = "spikes", start = 41.0, end = 56.0, size = 3.0, every = 5.0 },
    { sensor = 2, kind = "offset", start = 20.0, end = 40.0, size = -0.5 },
    { sensor = 2, kind = "freeze", start = 45.0, end = 55.0 },
]
"""


@pytest.fixture(scope="module")
def case():
    return rig.loads('case = "cascaded/pi"\n' + ROWS)


@pytest.fixture(scope="module")
def run(case):
    return simulate(case.loop, CLOCK)


def test_readings_differ_from_the_levels_by_what_the_faults_say(run):
    t, error = np.asarray(run.t), np.asarray(run.y) - np.asarray(run.x)
    drift = np.where((t >= 10) & (t < 30), 0.25 * (t - 10.0), 0.0)
    spikes = np.where(np.isin(t, [42.0, 46.0, 52.0]), 3.0, 0.0)  # at or after 41, 46, 51
    np.testing.assert_allclose(error[:, 0], drift + spikes, atol=1e-12)
    whole = ~((t >= 45) & (t < 55))
    offset = np.where((t >= 20) & (t < 40), -0.5, 0.0)
    np.testing.assert_allclose(error[whole, 1], offset[whole], atol=1e-12)
    frozen = np.asarray(run.y)[~whole, 1]
    assert np.all(frozen == np.asarray(run.y)[t == 44.0, 1])


def test_a_rig_file_with_faults_of_sensors_is_read_back(case):
    again = rig.loads(rig.dump(case)).loop.faults
    assert again.sensors == case.loop.faults.sensors
    np.testing.assert_array_equal(again.size, case.loop.faults.size)


def test_the_derivative_by_the_size_is_that_of_differences(case):
    def error(size):
        loop = with_values(case.loop, {"faults.size[2]": size})
        return evaluate(loop, CLOCK, ["mean_square_error"])["mean_square_error"][0]

    slope, step = jax.jit(jax.value_and_grad(error)), 1e-5
    difference = (slope(step - 0.5)[0] - slope(-step - 0.5)[0]) / (2 * step)
    np.testing.assert_allclose(slope(-0.5)[1], difference, rtol=1e-6)
    assert abs(difference) > 1e-4


def test_a_burst_of_noise_adds_to_the_standard_deviation_and_needs_a_key():
    text = 'case = "cascaded/pi"\n[[fault]]\nsensor = 1\nkind = "noise"\nstart = 100.0\nend ='
    loop, clock = rig.loads(f"{text} 4000.0\nsize = 0.2\n").loop, Clock(dt=1.0, duration=4000.0)
    run = simulate(loop, clock, jax.random.key(3))
    error = np.asarray(run.y - run.x)
    assert np.all(error[:100] == 0.0) and np.all(error[:, 1] == 0.0)
    assert 0.19 < np.std(error[100:4000, 0]) < 0.21
    with pytest.raises(InputError):
        simulate(loop, clock)


FAULT = "[[fault]]\nstart = 1.0\nend = 9.0\n"


@pytest.mark.parametrize(
    "lines, words",
    [
        ("", "either of"),
        ('of = "drain[0]"\nsensor = 1\n', "either of"),
        ("sensor = 1\n", "needs kind"),
        ("sensor = 3\nkind = 'offset'\nsize = 1.0\n", "counted from 1 to 2"),
        ("sensor = 1\nkind = 'offset'\n", "needs size"),
        ("sensor = 1\nkind = 'freeze'\nsize = 1.0\n", "size is not for freeze"),
        ("sensor = 1\nkind = 'spikes'\nsize = 1.0\n", "needs every"),
        ("sensor = 1\nkind = 'noise'\nsize = -1.0\n", "at least 0"),
        ("sensor = 1\nkind = 'drift'\nsize = '1 mm'\n", "must be in (V|cm)/s"),
        ("of = 'drain[0]'\nkind = 'drift'\n", "kind is not for an entry of the plant"),
    ],
)
def test_a_wrong_table_is_refused_with_its_line(lines, words):
    with pytest.raises(InputError, match=rf"line \d: fault 1.*{words}"):
        rig.loads('case = "cascaded/pi"\n' + FAULT + lines)

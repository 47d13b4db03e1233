"""Long and large: ten million samples in one run, a million draws in one ensemble. The default run
does a hundredth of each.
"""

import dataclasses
import functools
import json
import math
from pathlib import Path

import jax
import numpy as np
import pytest
from helpers import python

import jaxtank
import tuning
from jaxtank import presets, rig
from jaxtank.controllers import OpenLoop
from jaxtank.core.clock import CHUNK, Clock, is_pointwise
from jaxtank.core.tree import component
from jaxtank.loop.run import evaluate_for_reverse
from jaxtank.plants.faults import faults
from jaxtank.signals.base import Table
from jaxtank.signals.inflows import inflow_pulses
from jaxtank.signals.setpoints import Sine, ramps
from tuning.uncertainty import needs
from tuning.uncertainty.draws import Draws
from tuning.uncertainty.sampling import probabilities, spread_of

DT = 0.01
LONG = [30_000, pytest.param(10_000_000, marks=pytest.mark.slow)]
MANY = [4_096, pytest.param(1_000_000, marks=pytest.mark.slow)]
REST = (10.0 / (0.1 * math.sqrt(2 * 981.0))) ** 2  # level [cm] at which 10 cm^3/s leave


def tank(reference, x0=REST, rim=30.0, volts=2.0, overflow=False):
    """A tank that rests at REST while its pump runs at 2 V, whatever the setpoint."""
    text = f"""
    tank = [{{ area = 20.0, rim = {rim}, drain = 0.1, level = {x0} }}]
    pump = [{{ gain = 5.0, to = 1, high = 12.0 }}]
    plant = {{ overflow = {str(overflow).lower()} }}
    controller = {{ kind = "open-loop", initial = [{volts}] }}
    """
    return dataclasses.replace(rig.loads(text).loop, reference=reference)


def moving():
    """A setpoint that swings about the level at rest."""
    return Sine(
        amplitude=np.array(1.0), offset=np.array(REST), period=977.0, zero=0.0, start=0.0, end=1e9,
        channel=0, width=1
    )  # fmt: skip


def clock(samples):
    return Clock(dt=DT, duration=(samples - 1) * DT)


@pytest.mark.parametrize("samples", LONG)
def test_running_sums_lose_nothing(samples):
    """Against math.fsum, which rounds once. A sum of N terms in order may lose N/2 bits' worth,
    1e-9 here; it loses a hundred thousandth of that, for rounding goes both ways. The absolute
    error, whose terms share their last bits, 1e-12.
    """
    names = ["ise", "iae", "rms_error", "rms_input", "max_level", "input_travel"]
    values = jaxtank.evaluate(tank(moving()), clock(samples), names)
    e = -np.sin(2 * np.pi / 977.0 * (np.arange(samples) * DT))
    # over [0, T]: the last sample ends the last interval
    ise, iae = math.fsum(e[:-1] ** 2) * DT, math.fsum(np.abs(e[:-1])) * DT
    assert values["ise"][0] == pytest.approx(ise, rel=1e-13)
    assert values["rms_error"][0] == pytest.approx(math.sqrt(math.fsum(e * e) / samples), rel=1e-13)
    assert values["iae"][0] == pytest.approx(iae, rel=5e-12)
    assert values["rms_input"][0] == pytest.approx(2.0, rel=1e-13)
    assert values["input_travel"][0] == 0.0
    assert values["max_level"][0] == pytest.approx(REST, rel=1e-14)  # the level has not crept away


@pytest.mark.parametrize("samples", LONG)
def test_what_is_lost_over_a_rim_adds_up(samples):
    """A full tank loses at every sample what flows in and not out at its rim. Equal terms are the
    worst for a sum in order: it is rounded the same way for long stretches, by half a unit in its
    last place and half of that on average.
    """
    found = jaxtank.evaluate(
        tank(moving(), x0=3.0, rim=3.0, overflow=True), clock(samples), "overflow_volume"
    )["overflow_volume"][0]
    step = DT * (10.0 - 0.1 * math.sqrt(2 * 981.0 * 3.0))
    assert found == pytest.approx((samples - 1) * step, rel=samples * 2.0**-54)


@pytest.mark.parametrize("samples", LONG)
def test_the_clock_of_a_long_run_does_not_drift(samples):
    """Every hundredth of the run is at k dt to the last bit, and a step of the setpoint comes at
    its sample and not one before.
    """
    every = samples // 100
    change = 90 * every * DT
    case = tank(ramps((3.0,), [(change, 0, 4.0), (change + DT, 0, 5.0)], ramp=0.0))
    run = jaxtank.simulate(case, clock(samples), save_every=every)
    np.testing.assert_array_equal(run.t, np.arange(100) * every * DT)
    np.testing.assert_array_equal(
        run.r[:, 0], np.where(np.arange(100) < 90, 3.0, np.where(np.arange(100) == 90, 4.0, 5.0))
    )
    assert np.ptp(np.asarray(run.x)) < 1e-12


PEAK = """
import json, sys
sys.path += [sys.argv[1], sys.argv[1] + "/.."]  # these tests, and helpers
import jaxtank, jax
jax.config.update("jax_enable_x64", True)
import test_long_runs as here
run, peaks = {"run": here.one_long_run, "draws": here.drained}[sys.argv[2]], []
for size in sys.argv[3:]:
    run(int(size))
    (line,) = (line for line in open("/proc/self/status") if line.startswith("VmHWM"))
    peaks.append(1024 * int(line.split()[1]))
print(json.dumps(peaks))
"""


def peaks(what, *sizes):
    """Most memory [bytes] that a process of its own has held after each of several runs."""
    if not Path("/proc/self/status").exists():
        pytest.skip("the most memory that a process has held is read from /proc")
    return json.loads(python(PEAK, Path(__file__).parent, what, *sizes))


def one_long_run(samples):
    values = jaxtank.evaluate(tank(moving()), clock(samples), ["ise", "max_level", "input_travel"])
    return float(values["ise"][0])


@pytest.mark.slow
def test_memory_of_a_long_run():
    """Nothing of a run is kept, nor what is known of its samples beforehand: ten million samples
    need what a million do, and the memory of one more program, some 7 MB (a setpoint and an input,
    kept whole, would be 160).
    """
    samples = 10_000_000
    _, before, after = peaks("run", 1_000_000, 1_000_000, samples)
    assert after - before < 2 * samples


def noisy(reference=None):
    """A case with all that is known beforehand: a moving setpoint, noise, a pour and a fault, near
    the end of the first piece and after.
    """
    case = presets.find("gouta2015/backstepping-ff")
    loop, dt = case.loop, case.clock.dt
    late = [CHUNK * dt - 2.0, CHUNK * dt + 3.0]
    return dataclasses.replace(
        loop,
        reference=reference
        or ramps(
            (3.0, 6.0), [(t, i, 5.0 + i) for i, t in enumerate(late)], ramp=5.0, shape="quintic"
        ),
        sensor=dataclasses.replace(loop.sensor, noise=np.full(4, 1e-3)),
        disturbance=inflow_pulses(4, [(t + 0.5, 1.1, 0, 50.0) for t in late]),
        faults=faults(loop.plant, [("pump_gain[0]", late[0], late[1], 0.9, 0.0)]),
        actuator=dataclasses.replace(loop.actuator, low=np.full(2, -100.0), high=np.full(2, 100.0)),
    )


@pytest.mark.slow_for("1000")
@pytest.mark.parametrize("rest", [pytest.param(0, marks=pytest.mark.slow), 1000])
def test_a_run_in_chunks_equals_the_run_in_one(rest):
    """Longer runs are made in chunks of CHUNK samples: measures against the trajectory of the same
    run, made in one.
    """
    loop, long = noisy(), Clock(dt=0.01, duration=(CHUNK * (1 if rest else 2) + rest - 1) * 0.01)
    key = jax.random.key(3)
    assert is_pointwise(loop) and long.samples > CHUNK
    found = jaxtank.evaluate(
        loop, long, ["ise", "max_level", "input_travel", "rms_input", "recovery_time"], key
    )
    run = jaxtank.simulate(loop, long, key)
    e, u = np.asarray(run.e), np.asarray(run.u)
    assert np.ptp(np.asarray(run.r)[CHUNK:]) > 0.5  # something happens in the second piece
    np.testing.assert_allclose(found["ise"], (e[:-1] ** 2).sum(axis=0) * 0.01, rtol=1e-9)
    np.testing.assert_allclose(found["max_level"], np.asarray(run.x).max(axis=0), rtol=1e-9)
    np.testing.assert_allclose(
        found["input_travel"], np.abs(np.diff(u, axis=0)).sum(axis=0), rtol=1e-6
    )
    np.testing.assert_allclose(found["rms_input"], np.sqrt((u**2).mean(axis=0)), rtol=1e-9)


@pytest.mark.slow
def test_slopes_through_chunks():
    """Forward, in chunks of CHUNK samples, against reverse, whose pieces are of another kind."""
    loop, long = noisy(), Clock(dt=0.01, duration=(CHUNK + 999) * 0.01)

    def cost(evaluate, k):
        return evaluate(
            jaxtank.with_values(loop, {"controller.k": k}), long, "ise", jax.random.key(3)
        )["ise"][0]

    k = loop.controller.k
    forward = jax.jacfwd(functools.partial(cost, jaxtank.evaluate))(k)
    np.testing.assert_allclose(
        forward, jax.grad(functools.partial(cost, evaluate_for_reverse))(k), rtol=1e-8
    )


def test_what_looks_ahead_is_not_cut():
    """A recorded table knows its samples from the host; a custom controller may look ahead."""

    @component
    class Ahead(OpenLoop):
        def prepare(self, r, dr, ddr):
            return r[0][::-1]

    control = tank(moving()).controller
    assert is_pointwise(tank(moving()))
    assert not is_pointwise(tank(Table(values=np.ones((1, 3)), period=1.0)))
    assert not is_pointwise(
        dataclasses.replace(tank(moving()), controller=Ahead(signal=control.signal))
    )


def drained(samples):
    """An Ensemble: a draining tank whose outlet varies, 8 s."""
    loop = tank(ramps((3.0,), [(2.0, 0, 4.0)], ramp=0.0), x0=16.0, volts=0.0)
    case = presets.find("cascaded/pi").replace(
        loop=loop,
        clock=Clock(dt=0.5, duration=8.0, substeps=4),
        limits={},
        uncertain={},
        objective="rms_error_total",
        name="a draining tank",
    )
    spread = {"plant.drain": tuning.Uniform(relative=0.2)}
    return tuning.ensemble(
        case,
        spread,
        samples,
        draws="latin",
        measures=("min_level", "rms_error"),
        limits={},
        fan=False,
    )


@pytest.mark.slow_for("4096")
@pytest.mark.parametrize("samples", MANY)
def test_every_draw_is_its_closed_form(samples):
    """The lowest level of every draw, and their mean."""
    found = drained(samples)
    assert found.samples == samples and not found.failed.any()
    s, c = np.ravel(found.values["plant.drain"]), math.sqrt(981.0 / 2) * 8.0 / 20.0
    np.testing.assert_allclose(
        np.ravel(found.measures["min_level"]), (4.0 - c * s) ** 2, rtol=1e-10
    )
    # of a uniform outlet with mean m and variance v, (4 - c m)^2 + c^2 v; Latin draws leave 1/N^1.5
    m, v = 0.1, (0.04 / math.sqrt(12.0)) ** 2
    assert found.measures["min_level"].mean() == pytest.approx(
        (4.0 - c * m) ** 2 + c * c * v, rel=30 * samples**-1.5
    )


@pytest.mark.slow
def test_memory_of_a_million_draws():
    """What grows is the result: the draws, and each measure twice while batches become one. Runs
    are made in batches of 256, steady states are looked for in blocks.
    """
    few, many = peaks("draws", 10_000, 1_000_000)
    assert many - few < 300 * 1_000_000


def test_steady_states_are_looked_for_in_blocks(monkeypatch):
    """The same answer whatever the size of a block, one that does not divide the draws too."""
    case = presets.find("gouta2015/backstepping")
    draws = Draws(case.loop, spread_of(case))
    values = draws.values(probabilities("random", draws.dimensions, 300, 0))
    whole = needs.infeasible(case, values)
    monkeypatch.setattr(needs, "BLOCK", 128)
    np.testing.assert_array_equal(needs.infeasible(case, values), whole)
    assert 0 < whole.sum() < 300


def test_a_run_may_not_be_longer_than_its_index():
    """Samples are counted in 32 bits: 10^8 is the most that is taken, and said."""
    with pytest.raises(jaxtank.InputError, match="100000000"):
        jaxtank.evaluate(
            tank(moving()), dataclasses.replace(clock(10), duration=2e6, dt=0.01), "ise"
        )

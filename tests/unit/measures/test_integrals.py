"""Integrals over a run are over [0, T]: every sample but the last one lasts for dt."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxtank
from jaxtank import rig
from tuning.cli.main import main
from tuning.optimal_input.cost import Lagrangian, Terms, _search_cost, open_loop

FULL = """
name = "full tank"
units = ["m", "m^3/s"]
tank = [{ area = 1.0, rim = 10.0, level = 10.0 }]
pump = [{ gain = 1.0, to = 1, high = 1.0, initial = 0.05 }]
plant = { gravity = 9.81, overflow = true, bottom = true }
law = { kind = "open-loop", initial = [0.05] }
inflow = [{ time = 0.0, duration = 1800.0, tank = 1, volume = -54.0 },
        { time = 1800.0, duration = 1800.0, tank = 1, volume = -90.0 }]
values = { "clock.dt" = 1.0, "clock.duration" = 3600.0 }
"""
"""EPANET issues 769 and 771: 0.05 m^3/s in, 0.03 out, later 0.05; 0.02 * 1800 = 36 m^3 are lost."""

CHAIN = """
name = "chain"
reachable = false
tank = [{ area = 20.0, rim = 10.0, level = 9.0 }, { area = 30.0, rim = 12.0, level = 11.0 },
        { area = 25.0, rim = 6.0, level = 1.0 }]
orifice = [{ from = 1, to = 2, area = 0.2 }, { from = 2, to = 3, area = 0.2 }]
pipe = [{ between = [1, 3], area = 0.1 }]
spill = [{ from = 1, to = 2, caught = 0.6 }]
pump = [{ gain = 8.0, to = [1, 3], split = 0.7, high = 12.0, initial = 3.0 }]
plant = { outputs = [3], overflow = true, bottom = true }
law = { kind = "pid", Kc = 4.0, Ti = 20.0 }
reference = { changes = [[5.0, 1, 5.0]], ramp = 0.0 }
inflow = [{ time = 2.25, duration = 3.1, tank = 2, volume = 90.0 },
        { time = 12.0, duration = 5.0, tank = 1, volume = -900.0 },
        { time = 29.75, duration = 10.0, tank = 3, volume = 800.0 }]
actuator = { kind = "pumps", lag = [1.5] }
values = { "clock.dt" = 0.5, "clock.duration" = 30.0, "clock.substeps" = 2 }
"""
"""No drain: what enters stays, or passes a rim. The last pulse is under way at the end."""

ERRORS = ("ise", "iae", "overflow_volume", "inflow_shortfall")


@pytest.fixture(scope="module")
def chain():
    return rig.loads(CHAIN)


@pytest.fixture(scope="module")
def run(chain):
    return jaxtank.simulate(chain.loop, chain.clock)


@pytest.fixture(scope="module")
def sums(chain, run):
    """The integrals from the rows of the run: each row but the last is held for dt."""
    dt, e = chain.clock.dt, np.asarray(run.e)[:-1]
    return {
        "ise": dt * (e**2).sum(axis=0),
        "iae": dt * np.abs(e).sum(axis=0),
        "overflow_volume": np.asarray(run.spilled)[-1],
    }


@pytest.mark.slow
def test_the_volume_lost_in_an_hour_is_that_of_an_hour(tmp_path, capsys):
    (tmp_path / "full.toml").write_text(FULL)
    assert main(["simulate", str(tmp_path / "full.toml"), "--out", str(tmp_path / "out")]) == 0
    capsys.readouterr()
    found = json.loads((tmp_path / "out" / "result.json").read_text())["measures"]
    last = (tmp_path / "out" / "trajectory.csv").read_text().splitlines()[-1].split(",")
    np.testing.assert_allclose(found["overflow_volume"], 36.0, rtol=1e-12)
    # 0.05 m^3/s is held for an hour, and this tank holds its level with 0
    np.testing.assert_allclose(found["input_deviation"], 0.05**2 * 3600.0, rtol=1e-12)
    np.testing.assert_allclose(float(last[-1]), 36.0, rtol=1e-9)  # ten digits are written


@pytest.mark.extended
def test_initial_and_inflow_less_overflow_are_the_final_volume(chain, run):
    area, dt = np.asarray(chain.loop.plant.area), chain.clock.dt
    found = jaxtank.evaluate(chain.loop, chain.clock, ["overflow_volume", "inflow_shortfall"])
    pumped = 8.0 * dt * float(np.asarray(run.u)[:-1].sum())
    # the last pulse of 800 cm^3 in 10 s begins 0.25 s before the end
    poured = 90.0 - 900.0 + float(found["inflow_shortfall"].sum()) + 800.0 * 0.25 / 10.0
    lost = float(found["overflow_volume"].sum())
    assert lost > 1.0 and float(found["inflow_shortfall"].sum()) > 1.0
    left = area @ np.asarray(run.x)[0] + pumped + poured - lost
    np.testing.assert_allclose(left, area @ np.asarray(run.x)[-1], rtol=1e-12)


@pytest.mark.slow
def test_every_way_to_run_has_the_same_integrals(chain, sums):
    loop, clock = chain.loop, chain.clock
    gains = {"controller.Kc": np.full((2, 1), 4.0)}
    found = {
        "evaluate": jaxtank.evaluate(loop, clock, ERRORS),
        "many": {
            name: value[0]
            for name, value in jaxtank.evaluate_many(loop, clock, ERRORS, gains).items()
        },
        "derivatives": jaxtank.sensitivities(
            loop, clock, ERRORS, {"controller.Kc": loop.controller.Kc}
        )[0],
    }
    for way, values in found.items():
        for name, value in sums.items():
            np.testing.assert_allclose(values[name], value, rtol=1e-12, atol=1e-12, err_msg=way)
        np.testing.assert_allclose(
            values["inflow_shortfall"], found["evaluate"]["inflow_shortfall"], rtol=1e-12
        )


@pytest.mark.slow
def test_residuals_of_the_integral_are_those_of_its_samples(chain):
    loop, clock = chain.loop, chain.clock
    point = {"reference.targets": loop.reference.targets}
    found = jaxtank.sensitivities(loop, clock, ["ise"], point, squares={"ise": 3.0})

    def errors(target):
        return jaxtank.simulate(jaxtank.with_values(loop, {"reference.targets": target}), clock).e

    e, slopes = errors(np.array([5.0])), jax.jacfwd(errors)(jnp.asarray([5.0]))[..., 0]
    assert abs(slopes[-1, 0]) > 1e-3  # the last sample has a slope, and no part in the integral
    e, slopes, dt = e[:-1], slopes[:-1], clock.dt
    np.testing.assert_allclose(found[1]["ise"][0, 0], 2.0 * dt * (e * slopes).sum(), rtol=1e-9)
    np.testing.assert_allclose(found[2][0, 0], 2.0 * 3.0 * dt * (slopes**2).sum(), rtol=1e-9)


@pytest.mark.slow
def test_the_search_for_the_best_inputs_minimises_the_same_integral(chain):
    inputs = np.full((1, 60), 3.0)
    loop = open_loop(chain.loop, inputs, chain.clock.dt)
    terms = Terms((("iae", 1.0),), False, (), ())
    none = np.zeros(0)
    lagrangian = Lagrangian(1.0, 1.0, none, (), none, none, (none, none), (1e-12, 1e-12))
    cost = _search_cost(jnp.asarray(inputs), loop, chain.clock, terms, lagrangian)
    iae = jaxtank.evaluate(loop, chain.clock, ["iae"])["iae"]
    np.testing.assert_allclose(cost, iae[0], rtol=1e-9)


PULSED = """
name = "pulsed tank"
reachable = false
tank = [{ area = 20.0, rim = 30.0, level = 10.0, drain = 0.3 }]
pump = [{ gain = 8.0, to = 1, high = 12.0, initial = 5.0 }]
controller = { kind = "pi", Kc = 0.4, Ti = 20.0 }
reference = { initial = [10.0] }
inflow = [{ time = 20.0, duration = 5.0, tank = 1, volume = 60.0 },
        { time = 80.0, duration = 5.0, tank = 1, volume = 90.0 }]
values = { "clock.dt" = 0.5, "clock.duration" = 140.0 }
"""


def test_the_recovery_time_ends_at_the_last_sample_outside_5_percent_of_the_setpoint():
    case = rig.loads(PULSED)
    run = jaxtank.simulate(case.loop, case.clock)
    t, outside, each = np.asarray(run.t), np.abs(np.asarray(run.x)[:, 0] - 10.0) > 0.5, []
    for start, end in ((20.0, 80.0), (80.0, 141.0)):
        each.append(t[(t >= start) & (t < end) & outside].max() - start)
    measured = jaxtank.evaluate(case.loop, case.clock, ["recovery_time"])["recovery_time"]
    assert float(measured[0]) == pytest.approx(max(each), abs=1e-9) and each[0] < each[1]

"""Doors to other libraries: python-control, tables, Gymnasium."""

import dataclasses

import jax
import numpy as np
import pytest
from helpers import ONE_TANK, python

import jaxtank
from jaxtank import presets, rig
from jaxtank.controllers import OpenLoop
from jaxtank.core.errors import InputError
from jaxtank.interop import python_control
from jaxtank.plants import network
from jaxtank.signals.base import Constant


@pytest.mark.extended
def test_python_control_sees_the_linearised_rig():
    """mirakhorli at 12/12: zeros and steady gain of mirakhorli notes S2.3; poles from the printed
    time constants.
    """
    control = pytest.importorskip("control", reason="python-control is the independent answer")
    plant = presets.find("mirakhorli/sfc").loop.plant
    system = python_control.to_control(plant, setpoints=(12.0, 12.0))
    assert sorted(control.zeros(system).real) == pytest.approx([-0.10717, 0.02467], abs=1e-5)
    np.testing.assert_allclose(
        control.dcgain(system), [[3.5849, 4.0151], [4.9506, 2.0684]], atol=1e-4
    )
    np.testing.assert_allclose(
        sorted(-1 / control.poles(system).real), [19.0178, 33.4252, 43.2223, 43.2223], atol=1e-3
    )
    assert system.state_labels == ["h1", "h2", "h3", "h4"]
    assert system.input_labels == ["pump1", "pump2"]


@pytest.mark.extended
def test_an_inflow_counts_where_a_cross_section_changes():
    """A h' = q - a sqrt(2 g h), A = pi h^2: at rest the slope of A times 0, d/dh of the outflow."""
    cone = network(
        area=np.pi * 4.0**2, extent=4.0, drain=0.5, pump_gain=20.0, feeds=[(0, None)], rim=4.0,
        shapes=("cone",),
    )  # fmt: skip
    outflow = 0.5 * np.sqrt(2 * 981.0 * 2.0)
    pole = -outflow / (2.0 * 2.0) / (np.pi * 2.0**2)
    system = python_control.to_control(cone, setpoints=(2.0,), inflow=(outflow - 10.0,))
    np.testing.assert_allclose(system.A, [[pole]], rtol=1e-6)
    with pytest.raises(InputError, match="inflow"):
        python_control.to_control(cone, setpoints=(2.0,), inflow=(1.0, 2.0))


def test_an_operating_point_is_asked_for():
    pytest.importorskip("control", reason="python-control is the independent answer")
    plant = presets.find("mirakhorli/sfc").loop.plant
    for options in (
        {},
        {"setpoints": (12.0, 12.0), "levels": (1.0,) * 4},
        {"setpoints": (12.0,)},
        {"outputs": (0, 1)},  # which levels are outputs: no operating point
        {"outputs": (0, 4), "setpoints": (12.0, 12.0)},
        {"outputs": (12.0, 12.0)},
        {"levels": (1.0,) * 4},
        {"levels": (1.0,) * 3, "inputs": (1.0, 1.0)},
    ):
        with pytest.raises(InputError, match="to_control"):
            python_control.to_control(plant, **options)


def test_outputs_of_the_system_are_indices_of_tanks_as_those_of_the_plant():
    pytest.importorskip("control", reason="python-control is the independent answer")
    plant = presets.find("mirakhorli/sfc").loop.plant
    system = python_control.to_control(plant, [3, 0], setpoints=(12.0, 12.0))
    assert system.output_labels == ["y_h4", "y_h1"]
    np.testing.assert_array_equal(system.C, [[0, 0, 0, 1], [1, 0, 0, 0]])
    np.testing.assert_allclose(system.A, python_control.to_control(plant, setpoints=(12.0, 12.0)).A)
    with pytest.raises(
        InputError, match=r"outputs = \[12.0, 12.0\]: must be indices .* given as setpoints"
    ):
        python_control.to_control(plant, [12.0, 12.0])


@pytest.mark.extended
def test_columns_of_a_run_have_units():
    case = rig.set_values(
        presets.find("calofir/backstepping"), {"clock.duration": 40.0, "sensor.noise": 0.0}
    )
    run = jaxtank.simulate(case.loop, case.clock)
    found = python_control.columns(run, case.loop.units)
    assert {"t [s]", "h1 [m]", "r1 [m]"} <= set(found)
    assert len({len(v) for v in found.values()}) == 1
    np.testing.assert_array_equal(found["h2 [m]"], np.asarray(run.x)[:, 1])


@pytest.mark.extended
def test_columns_of_a_named_rig_have_its_names_and_the_units_of_its_inputs(tmp_path):
    case = rig.loads("""
        tank = [{ name = "A", area = 10.0, rim = 9.0, level = 2.0, drain = 0.1 }]
        pump = [{ name = "P", gain = 5.0, to = "A", high = 9.0 }]
        valve = [{ name = "V", from = "A", area = 0.2 }]
        controller = { kind = "pi", Kc = 1.0, Ti = 9.0, lead = ["P"] }
        reference = { initial = [2.0] }
        values = { "clock.duration" = 3.0 }
    """)
    run = jaxtank.simulate(case)
    expected = ["t [s]", "h_A [cm]", "r_A [cm]", "u_P [V]", "u_V [-]"]
    assert set(expected) <= set(jaxtank.interop.python_control.columns(run, case.loop.units))
    run.save(tmp_path)
    head = (tmp_path / "trajectory.csv").read_text().splitlines()[0].split(",")
    assert set(expected) <= set(head)
    assert "level of A [cm]" in str(run) and "input of V [-]" in str(run)


def test_columns_share_one_dimension_where_it_is_named():
    """As xarray takes them: (dimension, values, attributes), time the coordinate of the dimension's
    name.
    """
    case = rig.set_values(
        presets.find("calofir/backstepping"), {"clock.duration": 40.0, "sensor.noise": 0.0}
    )
    run = jaxtank.simulate(case.loop, case.clock)
    found = python_control.columns(run, case.loop.units, dimension="t")
    flat = python_control.columns(run, case.loop.units)
    assert {dims for dims, _, _ in found.values()} == {"t"}
    assert [f"{name} [{attrs['units']}]" for name, (_, _, attrs) in found.items()] == list(flat)
    for (_, values, _), wanted in zip(found.values(), flat.values()):
        np.testing.assert_array_equal(values, wanted)
    xarray = pytest.importorskip("xarray")
    data = xarray.Dataset(found)
    assert dict(data.sizes) == {"t": len(flat["t [s]"])} and set(data.coords) == {"t"}
    assert (
        float(data.h1.sel(t=20.0, method="nearest"))
        == flat["h1 [m]"][int(np.abs(flat["t [s]"] - 20.0).argmin())]
    )


@pytest.mark.extended
def test_the_environment_plays_the_case():
    """With the law's own inputs as actions, the levels are those of the closed loop; and
    Gymnasium's own checker has no complaint.
    """
    pytest.importorskip("gymnasium")
    from gymnasium.utils.env_checker import check_env

    from jaxtank.interop.gymnasium import TankEnv

    case = rig.loads(ONE_TANK).replace(limits={"max_level": "rim"})
    run = jax.tree.map(np.asarray, jaxtank.simulate(case.loop, case.clock))
    env = TankEnv(case)
    env.reset(seed=0)
    low, high = np.asarray(case.loop.actuator.low), np.asarray(case.loop.actuator.high)
    total, k, ended = 0.0, 0, False
    while not ended:
        _, reward, broken, ended, info = env.step(2 * (run.applied[k] - low) / (high - low) - 1)
        k, total = k + 1, total + reward
        np.testing.assert_allclose(info["x"], run.x[k], atol=1e-9)
        assert not broken and info["t"] == pytest.approx(run.t[k])
    assert k == case.clock.samples - 1
    assert total == pytest.approx(
        -np.sum(np.mean((run.e[1:] / 3.0) ** 2, axis=1))
        - 100 * np.sum(np.maximum(run.x[1:] - 3, 0) ** 2 / 9),
        rel=1e-6,
    )
    check_env(TankEnv(case), skip_render_check=True)


EPISODES = {
    # an outlet that closes, a leak, an orifice that is another one
    "calofir/backstepping-perturbed": {"clock.duration": 1050.0},
    # a weak pump, inflows, an ADC, a dead zone
    "gouta2022/chadpc": {"clock.dt": 0.2, "clock.duration": 500.0, "observer.l": [9.0, 9.0]},
    "gouta2015/backstepping-boxqp": {"clock.dt": 0.5, "clock.duration": 150.0},
    "mirakhorli/hybrid": {"clock.duration": 100.0, "actuator.delay": 0.0},
    "cascaded/pi": {"plant.rim[1]": 6.0},
    "khalid/laguerre-constrained": {"clock.duration": 60.0},
}


def pumps_and_sensors(case):
    """The case with all that stands between an action and a reading, in units of the rig."""
    actuator, sensor, plant = case.loop.actuator, case.loop.sensor, case.loop.plant
    reach, rim = np.asarray(actuator.high) - np.asarray(actuator.low), np.asarray(plant.rim)
    pumps = dataclasses.replace(
        actuator, lag=np.full(len(reach), 2.5 * case.clock.dt), delay=3 * case.clock.dt
    )
    gauges = dataclasses.replace(
        sensor,
        noise=0.01 * rim,
        offset=0.02 * rim * (-1.0) ** np.arange(len(rim)),
        gain=rim / 5.0,
        bits=12,
        full_scale=5.0,
    )
    return case.replace(loop=dataclasses.replace(case.loop, actuator=pumps, sensor=gauges))


@pytest.mark.slow_for(
    "calofir/backstepping-perturbed-own",
    "calofir/backstepping-perturbed-lag-delay-noise-offset-adc",
    "cascaded/pi-lag-delay-noise-offset-adc",
    "gouta2015/backstepping-boxqp-lag-delay-noise-offset-adc",
    "gouta2015/backstepping-boxqp-own",
    "gouta2022/chadpc-own",
    "khalid/laguerre-constrained-lag-delay-noise-offset-adc",
    "khalid/laguerre-constrained-own",
    "mirakhorli/hybrid-lag-delay-noise-offset-adc",
    "mirakhorli/hybrid-own",
    "gouta2022/chadpc-lag-delay-noise-offset-adc",
    "cascaded/pi-own",
)
@pytest.mark.parametrize(
    "change", [lambda case: case, pumps_and_sensors], ids=["own", "lag-delay-noise-offset-adc"]
)
@pytest.mark.parametrize("name", EPISODES)
def test_an_episode_is_the_run_of_the_rig(name, change):
    """Levels, readings, inputs and what is lost over the rims, with the controller's inputs as
    actions and the seed of the run.
    """
    gymnasium = pytest.importorskip("gymnasium")
    from jaxtank.interop.gymnasium import TankEnv

    case = change(rig.set_values(presets.find(name), EPISODES[name]))
    run = jax.tree.map(np.asarray, jaxtank.simulate(case.loop, case.clock, jax.random.key(5)))
    low, high = np.asarray(case.loop.actuator.low), np.asarray(case.loop.actuator.high)
    env = gymnasium.wrappers.OrderEnforcing(TankEnv(case))
    seen, info = env.reset(seed=5)
    rows, k, ended = [(seen[: run.x.shape[1]] * np.max(case.loop.plant.rim), info)], 0, False
    while not ended:
        seen, _, broken, ended, info = env.step(2 * (run.applied[k] - low) / (high - low) - 1)
        rows.append((seen[: run.x.shape[1]] * np.max(case.loop.plant.rim), info))
        assert not broken
        k += 1
    assert len(rows) == case.clock.samples
    size = float(np.max(np.asarray(case.loop.plant.rim)))
    found = {
        field: np.array([info[field] for _, info in rows])
        for field in ("t", "x", "y", "u", "e", "spilled")
    }
    np.testing.assert_allclose(found["x"], run.x, atol=1e-10 * size)
    np.testing.assert_allclose(found["e"], run.e, atol=1e-10 * size)
    np.testing.assert_allclose(found["t"], run.t)
    np.testing.assert_allclose(found["y"], run.y, atol=1e-10 * size)
    np.testing.assert_allclose([y for y, _ in rows], run.y, atol=1e-10 * size)
    np.testing.assert_allclose(found["u"][1:], run.u[:-1], atol=1e-10 * float(np.max(np.abs(high))))
    np.testing.assert_allclose(
        found["spilled"], run.spilled, atol=1e-8 * max(1.0, run.spilled.max())
    )
    if name == "cascaded/pi":
        assert run.spilled.max() > 0.0
    if change is pumps_and_sensors:
        assert np.abs(run.y - run.x).max() > 0.01 * size


@pytest.mark.slow
def test_a_safety_filter_limits_the_actions_as_the_inputs_of_a_controller():
    """Pumps of gouta2015 at full by actions, and by an open-loop controller: the same run."""
    pytest.importorskip("gymnasium")
    from jaxtank.interop.gymnasium import TankEnv

    case = rig.set_values(
        presets.find("gouta2015/ngpc"),
        {"clock.dt": 0.5, "clock.duration": 90.0, "sensor.noise": 0.05},
    ).with_safety_filter()
    full = OpenLoop(signal=Constant(level=[12.0, 11.0]))
    loop = dataclasses.replace(case.loop, controller=full)
    key = jax.random.key(3)
    run = jax.tree.map(np.asarray, jaxtank.simulate(loop, case.clock, key))
    env, rows = TankEnv(case), []
    env.reset(seed=3)
    for _ in range(case.clock.samples - 1):
        rows.append(env.step([1.0, 2.0 * 11.0 / 12.0 - 1.0])[-1])
    np.testing.assert_allclose([row["x"] for row in rows], run.x[1:], atol=1e-9)
    np.testing.assert_allclose([row["u"] for row in rows], run.u[:-1], atol=1e-9)
    acts = np.any(run.applied != [12.0, 11.0], axis=1)[:-1]
    assert 0.1 < acts.mean() < 1.0 and [row["filtered"] for row in rows] == acts.tolist()
    assert run.x.max() < 30.0


def test_noise_of_the_environment_follows_its_seed():
    pytest.importorskip("gymnasium")
    from jaxtank.interop.gymnasium import TankEnv

    case = rig.set_values(
        presets.find("gouta2015/backstepping"),
        {"clock.dt": 0.5, "clock.duration": 10.0, "sensor.noise": 0.1},
    )
    env = TankEnv(case)
    one, two, other = (env.reset(seed=s)[0] for s in (1, 1, 2))
    assert np.array_equal(one, two) and not np.array_equal(one, other)


@pytest.mark.extended
def test_modules_are_reached_from_the_package_when_they_are_used():
    """Nothing of them is imported with `jaxtank`; without gymnasium only its environment is
    missing.
    """
    code = """
import sys
sys.modules["gymnasium"] = sys.modules["control"] = None  # as if they were not installed
import jaxtank
opened = {"jaxtank.interop.python_control", "jaxtank.interop.gymnasium", "jaxtank.export"}
assert not opened & set(sys.modules)
from jaxtank import *
assert {"interop", "export"} <= set(dir(jaxtank)) and callable(jaxtank.export.export)
import jaxtank.interop.python_control
try:
    import jaxtank.interop.gymnasium
except ImportError as error:
    print(error)
"""
    assert python(code).startswith(
        "jaxtank.interop.gymnasium needs gymnasium: pip install gymnasium"
    )


def test_an_action_has_a_number_for_each_pump():
    gymnasium = pytest.importorskip("gymnasium")
    from jaxtank.interop.gymnasium import TankEnv

    env = TankEnv(rig.set_values(presets.find("gouta2022/pi"), {"clock.duration": 4.0}))
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step([0.1, 0.2])
    env.reset(seed=0)
    for action in ([0.5], [0.1, 0.2, 0.3], [[0.1, 0.2]], [0.1, np.nan]):
        with pytest.raises(InputError, match=r"action = .* must be an array of 2 numbers"):
            env.step(action)
    assert env.step([0.1, 0.2])[4]["t"] > 0.0

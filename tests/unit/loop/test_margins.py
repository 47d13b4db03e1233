"""Stability margins of whole loops: against linear theory, and against the simulated loop."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import jaxtank
import tuning
from jaxtank import presets, rig
from jaxtank.analysis.margins import Margins
from jaxtank.case import Case
from jaxtank.controllers import PID
from jaxtank.core.errors import InputError
from jaxtank.core.tree import with_values
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.limits import Limit
from jaxtank.loop import margins as lm
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.loop.margins import Plateau, worst
from jaxtank.observers import Direct
from jaxtank.plants.network import network
from jaxtank.signals.base import Constant, Sum
from jaxtank.signals.inflows import inflow_table
from jaxtank.signals.setpoints import ramps
from tuning.cli.main import main
from tuning.report import simulated

control = pytest.importorskip("control", reason="python-control is the independent answer")

AREA, DRAIN, GAIN, KC, TI, DT = 100.0, 0.5, 10.0, 2.0, 30.0, 1.0


def one_tank(lag=None, delay=0.0, level=9.0, high=12.0, damping=None, **plant):
    """A tank with an outlet under PI control, and its clock."""
    tank = network(area=AREA, drain=DRAIN, pump_gain=GAIN, feeds=[(0, None)], rim=30.0, **plant)
    loop = ClosedLoop(
        plant=tank,
        sensor=LevelSensor(noise=[0.1], filter=damping),
        observer=Direct(),
        controller=PID(model=tank, Kc=[KC], Ti=[TI], Tt=[TI], bias=[0.0]),
        actuator=PumpBank(low=[0.0], high=[high], lag=lag, delay=delay),
        reference=Constant(level=[level]),
        x0=[level],
    )
    return loop, jaxtank.Clock(dt=DT, duration=100.0)


def of_theory(lag, dead, level=9.0, dt=DT, damping=None):
    """The same loop by hand: exact sampling, the lag's mean over a sample, a sum as integral, the
    filter of the reading with the sample of now."""
    pole = DRAIN * np.sqrt(2.0 * 981.0) / (2.0 * AREA * np.sqrt(level))
    keep = np.exp(-pole * dt)
    tank = control.ss([[keep]], [[(1.0 - keep) / pole * GAIN / AREA]], [[1.0]], [[0.0]], dt)
    pi = control.ss([[1.0]], [[1.0]], [[KC * dt / TI]], [[KC]], dt)
    if lag:
        left = np.exp(-dt / lag)
        share = lag / dt * (1.0 - left)
        tank = tank * control.ss([[left]], [[1.0 - left]], [[share]], [[1.0 - share]], dt)
    if damping:
        decay = np.exp(-dt / damping)
        tank = tank * control.tf([1.0 - decay, 0.0], [1.0, -decay], dt)
    return control.tf(tank * pi) * control.tf([1.0], [1.0] + [0.0] * dead, dt)


@pytest.mark.slow
@pytest.mark.slow_for("None-0")
@pytest.mark.parametrize(("lag", "dead"), [(None, 0), (2.5, 2)])
def test_a_tank_under_pi_with_lag_and_dead_time_has_the_margins_of_linear_theory(lag, dead):
    damping = 6.0 if dead else None
    filtered = None if damping is None else [damping]
    loop, clock = one_tank(None if lag is None else [lag], dead * DT, damping=filtered)
    (plateau,) = jaxtank.stability_margins(loop, clock)
    theory = of_theory(lag, dead, damping=damping)
    gain, phase, distance, _, crossover, _ = control.stability_margins(theory)
    found = plateau.margins
    assert plateau.stable and plateau.why == "" and plateau.x == pytest.approx([9.0], rel=1e-9)
    steady = DRAIN * np.sqrt(2.0 * 981.0 * 9.0) / GAIN
    assert plateau.u == pytest.approx([steady], rel=1e-9)
    assert found.sensitivity_peak == pytest.approx(1.0 / distance, rel=1e-5)
    assert found.phase_margin == pytest.approx([phase], rel=1e-5)
    assert found.delay_margin == pytest.approx([np.radians(phase) / crossover], rel=1e-5)
    if dead:
        assert found.gain_margin == pytest.approx([gain], rel=1e-5)
    else:  # L is real and negative at the Nyquist frequency
        nyquist = np.real(of_theory(lag, dead)(-1.0))
        assert found.gain_margin == pytest.approx([-1.0 / nyquist], rel=1e-5)


@pytest.mark.slow
def test_derivatives_of_the_margins_are_those_of_differences_on_several_plants():
    loop, clock = one_tank([2.5], 2.0)
    names = ["controller.Kc", "controller.Ti", "plant.drain", "actuator.lag"]
    centre = np.array([KC, TI, DRAIN, 2.5])

    def values(theta):
        here = with_values(loop, {n: theta[i : i + 1] for i, n in enumerate(names)})
        found = worst(here, clock)
        return jnp.concatenate([jnp.ravel(v) for v in found])

    plants = jnp.asarray(centre * np.array([[1.0, 1.0, 1.0, 1.0], [1.3, 0.8, 0.9, 1.2]]))
    value, slope = jax.jit(jax.vmap(lambda p: (values(p), jax.jacfwd(values)(p))))(plants)
    steps = 1e-5 * centre * np.concatenate([np.eye(4), -np.eye(4)])
    near = jax.jit(jax.vmap(values))(jnp.concatenate([p + steps for p in plants]))
    for k in range(2):
        up, down = np.split(np.asarray(near[8 * k : 8 * k + 8]), 2)
        differences = ((up - down) / (2.0 * 1e-5 * centre[:, None])).T
        scale = np.abs(np.asarray(value[k])[:, None] / centre)
        np.testing.assert_allclose(slope[k] / scale, differences / scale, atol=2e-5, rtol=2e-4)
    reverse = jax.jit(jax.jacrev(values))(plants[0])
    np.testing.assert_allclose(reverse, slope[0], rtol=1e-7, atol=1e-9)


@pytest.mark.slow
def test_four_tanks_under_two_pi_loops_have_the_margins_of_the_loops_closed_one_by_one():
    rig = presets.find("mirakhorli/sfc").loop
    gains = dict(Kc=[0.6, 0.9], Ti=[60.0, 40.0], Tt=[60.0, 40.0], bias=[3.0, 3.0])
    plant = with_values(rig.plant, {"split": [0.7, 0.6]})
    loop = dataclasses.replace(
        rig,
        plant=plant,
        controller=PID(model=plant, **gains),
        reference=Constant(level=[12.0, 11.0]),
    )
    dt = 1.0
    clock = jaxtank.Clock(dt=dt, duration=10.0, substeps=4)
    (plateau,) = jaxtank.stability_margins(loop, clock)
    x, u = jaxtank.analysis.equilibrium(plant, (12.0, 11.0))
    np.testing.assert_allclose(plateau.x, x, rtol=1e-8)
    A, B, C = map(np.asarray, jaxtank.analysis.linearise(plant, x, u))
    held = scipy.linalg.expm(np.block([[A, B], [np.zeros((2, 6))]]) * dt)
    tanks = control.ss(held[:4, :4], held[:4, 4:], C, np.zeros((2, 2)), dt)
    pi = [control.ss([[1.0]], [[1.0]], [[k * dt / t]], [[k]], dt) for k, t in
          zip(gains["Kc"], gains["Ti"])]  # fmt: skip
    w = np.geomspace(1e-5, np.pi, 20_000)
    P = tanks(np.exp(1j * w))
    c = [one(np.exp(1j * w)) for one in pi]
    L = np.moveaxis(np.stack([c[0] * P[0], c[1] * P[1]]), 2, 0)  # diag(c) P: at the pumps
    peak = np.linalg.norm(np.linalg.inv(np.eye(2) + L), 2, axis=(1, 2)).max()
    assert plateau.margins.sensitivity_peak == pytest.approx(peak, rel=1e-5)
    for i, j in ((0, 1), (1, 0)):  # the other loop closed, by hand
        alone = c[i] * (P[i, i] - P[i, j] * c[j] * P[j, i] / (1.0 + c[j] * P[j, j]))
        size = np.log(np.abs(alone))
        (k,) = np.flatnonzero((size[:-1] > 0) & (size[1:] < 0))
        crossover = np.interp(0.0, -size[k : k + 2], w[k : k + 2])
        phase = np.degrees(np.interp(crossover, w, np.unwrap(np.angle(alone)))) + 180.0
        assert plateau.margins.phase_margin[i] == pytest.approx(phase, rel=1e-4)
        assert plateau.margins.phase_frequency[i] * dt == pytest.approx(crossover, rel=1e-4)
        delay = np.radians(phase) / (crossover / dt)
        assert plateau.margins.delay_margin[i] == pytest.approx(delay, rel=1e-4)


@pytest.mark.slow
def test_the_simulated_loop_stands_the_delay_margin_and_no_more():
    base, clock = one_tank(lag=[2.0], level=9.0)
    fine = dataclasses.replace(clock, dt=0.25, duration=1500.0)
    (plateau,) = jaxtank.stability_margins(base, fine)
    margin = float(plateau.margins.delay_margin[0])
    samples = margin / fine.dt
    assert samples > 8

    def swings(dead):
        """Size of the last swings over that of earlier ones, of a small disturbance."""
        loop, _ = one_tank(lag=[2.0], delay=dead * fine.dt)
        quiet = dataclasses.replace(loop, sensor=loop.sensor.without_noise())
        u = float(plateau.u[0])
        start = {"x0": [9.001], "controller.bias": [u], "actuator.initial": [u]}
        quiet = with_values(quiet, start)
        levels = np.asarray(jaxtank.simulate(quiet, fine).x)[:, 0]
        early, late = np.array_split(levels, 5)[1], np.array_split(levels, 5)[4]
        (there,) = jaxtank.stability_margins(quiet, fine)
        return np.ptp(late) / np.ptp(early), there.stable

    below, above = int(0.93 * samples), int(np.ceil(1.07 * samples))
    assert swings(below)[0] < 0.7 and swings(below)[1]
    assert swings(above)[0] > 1.5 and not swings(above)[1]


@pytest.mark.slow
def test_what_cannot_be_linearised_is_named_and_left_out():
    loop, clock = one_tank(high=6.0)
    steps = ramps([9.0], [(10.0, 0, 4.0), (20.0, 0, 25.0), (30.0, 0, 0.0)], ramp=0.0)
    rows = jaxtank.stability_margins(dataclasses.replace(loop, reference=steps), clock)
    assert [r.stable for r in rows] == [False, True, False, False]
    assert "beyond its limits" in rows[0].why and "beyond its limits" in rows[2].why
    assert "empty" in rows[3].why and np.isnan(rows[0].margins.sensitivity_peak)
    found = worst(dataclasses.replace(loop, reference=steps), clock)
    assert float(found.sensitivity_peak) == pytest.approx(
        float(rows[1].margins.sensitivity_peak), rel=1e-12
    )
    brim = one_tank(level=30.0, high=20.0, overflow=True)[0]
    assert "rim" in jaxtank.stability_margins(brim, clock)[0].why


@pytest.mark.slow
def test_an_unstable_loop_has_no_margins_and_breaks_every_limit():
    loop, clock = one_tank(delay=25.0)
    (row,) = jaxtank.stability_margins(loop, clock)
    assert row.why == "" and not row.stable and np.isnan(row.margins.sensitivity_peak)
    names = ["sensitivity_peak", "delay_margin"]
    quiet = dataclasses.replace(loop, sensor=loop.sensor.without_noise())
    found = jaxtank.evaluate(quiet, clock, names)
    assert float(found["sensitivity_peak"]) == np.inf and float(found["delay_margin"][0]) == -np.inf
    assert Limit("sensitivity_peak", 0, 2.0).margin(found) < 0.0
    assert Limit("delay_margin", 0, 2.0).margin(found) < 0.0
    assert Limit("gain_margin", 0, 2.0).margins([np.inf])[0] > 0.0
    spec = jaxtank.measures.MEASURES["delay_margin"]
    assert "unstable" in spec.cause(-np.inf) and "never reaches 1" in spec.cause(np.inf)


@pytest.mark.slow
def test_a_switching_controller_is_undefined_and_float32_is_refused():
    case = presets.find("mirakhorli/smc")
    switch = dataclasses.replace(case.loop.controller, switch="sign")
    loop = dataclasses.replace(case.loop, controller=switch, reference=Constant(level=[12.0, 12.0]))
    assert "switch" in jaxtank.stability_margins(loop, case.clock)[0].why
    with jax.enable_x64(False), pytest.raises(InputError, match="float64"):
        jaxtank.stability_margins(jax.tree.map(jnp.float32, one_tank()[0]), one_tank()[1])


@pytest.mark.slow
def test_a_limit_on_the_sensitivity_peak_is_kept_by_a_search_and_costs_error():
    loop, clock = one_tank(lag=[2.5], delay=3.0)
    loop = dataclasses.replace(
        loop, sensor=loop.sensor.without_noise(), reference=ramps([5.0], [(10.0, 0, 9.0)], ramp=0.0)
    )
    case = Case(
        name="one tank",
        title="one tank",
        loop=with_values(loop, {"x0": [5.0], "controller.Kc": [0.8]}),
        clock=dataclasses.replace(clock, duration=150.0),
        limits={"sensitivity_peak": 1.4},
        free={"controller.Kc": (0.5, 30.0)},
        objective={"mean_square_error": 1.0},
    )
    few = tuning.Options(starts=1, screening=4, validation=0, iterations=15)
    result = tuning.tune(case, few)
    (row,) = result.constraints
    assert row.value == pytest.approx(1.4, rel=1e-3) and row.margin >= -1e-6
    gain = result["controller.Kc[0]"].after
    peaks = [
        float(worst(with_values(case.loop, {"controller.Kc": [k]}), case.clock).sensitivity_peak)
        for k in (gain, 1.02 * gain)
    ]
    assert peaks[0] <= 1.4 + 1e-6 < peaks[1]


@pytest.mark.slow
def test_simulate_prints_the_margins_of_every_plateau(capsys):
    asked = ["simulate", "cascaded/pi", "--margins"]
    assert main([*asked, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    rows = found["margins"]
    assert [row["setpoints"] for row in rows] == [[4.0], [7.0], [3.0], [5.0]]
    most = max(row["sensitivity_peak"] for row in rows)
    assert found["measures"]["sensitivity_peak"] == pytest.approx(most, rel=1e-12)
    assert found["units"]["phase_margin"] == "deg"
    assert main(asked) == 0
    assert "7 V (worst)" in capsys.readouterr().out


def test_no_stable_plateau_is_the_worst_where_another_is_unstable():
    numbers = [1.5] * len(Margins._fields[1:])
    stable = Margins(True, *numbers)
    first = Plateau([4.0], [4.0], [3.0], "", True, stable)
    loop = presets.find("cascaded/pi").loop
    heads = [
        [row[0] for row in simulated._margins(loop, rows)[1].rows]
        for rows in ([first], [first, first._replace(stable=False)])
    ]
    assert heads == [["4 V (worst)"], ["4 V"]]
    inflow = inflow_table(2, [(0, [0.0, 100.0], [0.0, 1.0])])
    poured = dataclasses.replace(loop, disturbance=inflow)
    notes = [simulated._margins(each, [first])[-1].sentences for each in (loop, poured)]
    assert notes[0] == [] and "The inflow varies" in notes[1][0]


def test_an_inflow_that_varies_counts_with_its_mean_over_the_run():
    """20 cm^3/s in the second tenth of the run, and nothing from then on."""
    loop, clock = one_tank()
    times = [0.0, 0.1 * clock.duration, 0.2 * clock.duration]
    inflow = inflow_table(1, [(0, times, [0.0, 20.0, 0.0])])
    alike = Constant(level=[2.0])
    peaks = [
        float(worst(dataclasses.replace(loop, disturbance=d), clock).sensitivity_peak)
        for d in (inflow, Sum(first=inflow, second=Constant(level=[0.0])), alike)
    ]
    assert peaks[0] == pytest.approx(peaks[2], rel=1e-9) == peaks[1]


def test_margins_of_what_cannot_be_run_are_refused():
    loop, clock = one_tank()
    with pytest.raises(InputError, match="clock"):
        jaxtank.stability_margins(loop, None)
    with pytest.raises(InputError, match="must be a ClosedLoop"):
        jaxtank.stability_margins(clock, loop)


@pytest.mark.extended
def test_margins_of_a_cone_that_holds_less_than_a_step_takes_do_not_depend_on_the_step():
    """At 12 cm the cone holds 133 cm^3 and gives 138 cm^3/s: one step of 1 s, or ten."""
    text = """
    tank = [{ shape = "cone", diameter = 38.0, height = 70.0, level = 12.0, drain = 0.9 }]
    pump = [{ gain = 4.0, to = 1, high = 100.0 }]
    controller = { kind = "pi", Kc = 4.0, Ti = 100.0 }
    reference = { initial = [12.0], changes = [] }
    values = { "clock.dt" = 1.0, "clock.duration" = 10.0, "clock.substeps" = STEPS }
    """
    (coarse,), (fine,) = (
        jaxtank.stability_margins(rig.loads(text.replace("STEPS", str(k)))) for k in (1, 10)
    )
    # of an own linearisation of the sampled cone
    assert coarse.margins.sensitivity_peak == pytest.approx(1.313, abs=5e-3)
    assert coarse.margins.delay_margin == pytest.approx([3.74], abs=0.02)
    assert coarse.margins.gain_margin == pytest.approx(fine.margins.gain_margin, rel=1e-3)


@pytest.mark.extended
def test_margins_that_are_compiled_in_less_time_are_those_of_optimised_code(monkeypatch):
    case = presets.find("cascaded/pi")
    quickly = worst(case.loop, case.clock)
    monkeypatch.setattr(lm, "_unoptimised", lm._compiled)
    for value, full in zip(quickly, worst(case.loop, case.clock), strict=True):
        np.testing.assert_allclose(value, full, rtol=1e-9)

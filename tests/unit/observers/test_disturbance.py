"""Observers of disturbances on rigs of 2 to 6 tanks: the observer of gouta2022 against its printed
form and its closed form, Kalman filters with random walks, and what they estimate of an inflow.
"""

import dataclasses

import jax
import numpy as np
import pytest

import jaxtank
from jaxtank import presets, rig
from jaxtank.core.errors import InputError
from jaxtank.core.records import Tick
from jaxtank.core.tree import with_values
from jaxtank.observers import DisturbanceObserver, ExtendedKalman, Kalman
from jaxtank.observers.checks import check_disturbed
from jaxtank.plants import network, state_coupled_four_tank

FOUR = state_coupled_four_tank(15 * 2**0.5)
INFLOW = 20.0  # of the injected disturbance [cm^3/s]


def row(n, observer, disturbed, more=""):
    """The rig file of n tanks in a row: an orifice from tank 1 to 2, pipes between the others, an
    outlet each, pumps at both ends whose inputs do not change, `disturbed` {tank: inflow}.
    """
    area = lambda i: 40.0 + 5.0 * i
    lines = ['name = "row"', "reachable = false"]
    for i in range(1, n + 1):
        lines += [
            *("[[tank]]", f"area = {area(i)}", "rim = 60.0", f"drain = {0.25 + 0.02 * i}"),
            *(f"level = {20.0 - 0.5 * i}", f"inflow = {disturbed.get(i, 0.0)}"),
        ]
    lines += ["[[orifice]]", "from = 1", "to = 2", "area = 0.2"]
    for i in range(2, n):
        lines += ["[[pipe]]", f"between = [{i}, {i + 1}]", "area = 0.3"]
    for tank in (1, n):
        lines += ["[[pump]]", "gain = 10.0", f"to = {tank}", "high = 12.0", "initial = 5.0"]
    lines += ["[controller]", 'kind = "open-loop"', "initial = [5.0, 5.0]", "[observer]", *observer]
    lines += ["[reference]", "initial = [19.0, 17.0]", "[values]"]
    return "\n".join([*lines, '"clock.dt" = 0.5', '"clock.duration" = 200.0', more])


def at_the_end(text, tanks):
    """(largest |d^ - d| / |d| of {tank: inflow}, case, levels) at the end of a run; d is the inflow
    over the area.
    """
    case = rig.loads(text)
    run = jaxtank.simulate(case.loop, case.clock, save_every=50)
    d, area = np.asarray(run.d_hat)[-1], np.asarray(case.loop.plant.area)
    wrong = max(abs(d[i - 1] * area[i - 1] / q - 1.0) for i, q in tanks.items())
    return wrong, case, np.asarray(run.x)[-1]


OWN = ['kind = "disturbance"', "l = 0.2"]
WALKS = ['kind = "extended-kalman"', "process = 1e-6", "measurement = 1e-4", "walk = 1e-4"]


@pytest.mark.extended
@pytest.mark.slow_for("2", "3", "4", "5")
@pytest.mark.parametrize("n", [2, 3, 4, 5, 6], ids=str)
def test_an_injected_inflow_is_found_within_2_percent(n):
    """Of a rig file with `kind = "disturbance"`: an inflow at one end, a leak at the other."""
    inflows = {1: INFLOW, n: -10.0}
    assert at_the_end(row(n, OWN, inflows), inflows)[0] < 0.02


@pytest.mark.slow
def test_unmeasured_levels_are_predicted():
    """Tanks 2 and 4 of five are not measured and start where they are: all the same."""
    inflows = {1: INFLOW, 3: -10.0}
    own = [*OWN, "measured = [1, 3, 5]"]
    assert at_the_end(row(5, own, inflows), inflows)[0] < 0.02


@pytest.mark.slow_for("3", "2")
@pytest.mark.parametrize("n", [2, 3], ids=str)
def test_an_inflow_into_an_unmeasured_tank_is_found_by_the_extended_filter(n):
    """Tank 1 is not measured; its inflow shows in tank 2, below it."""
    own = [*WALKS, "spread = 0.0", "disturbed = [1]", f"measured = {list(range(2, n + 1))}"]
    assert at_the_end(row(n, own, {1: INFLOW}), {1: INFLOW})[0] < 0.02


@pytest.mark.slow
def test_the_linear_filter_leaves_out_what_its_linear_model_lacks():
    """Levels end up to 9 cm away from the operating point, where the linear model is wrong by more
    than a tenth of the inflow.
    """
    own = ['kind = "kalman"', "process = 1e-6", "measurement = 1e-4", "walk = 1e-4"]
    own += ["disturbed = [1, 2]", "levels = [19.5, 19.0]", "inputs = [5.0, 5.0]"]
    inflows = {1: INFLOW, 2: -10.0}
    wrong, case, levels = at_the_end(row(2, own, inflows), inflows)
    assert wrong < 0.02
    loop = case.loop
    A, _, _ = jaxtank.analysis.linearise(loop.plant, (19.5, 19.0), (5.0, 5.0))
    rates = lambda x: np.asarray(loop.plant.derivative(0.0, tuple(x), (5.0, 5.0), None))
    lacking = rates((19.5, 19.0)) + A @ (levels - np.array([19.5, 19.0])) - rates(levels)
    assert np.abs(lacking).max() > 0.1 * INFLOW / 45.0


def test_it_is_the_printed_form_step_by_step():
    """z' = -l z - l (l h + f + g u) by forward Euler and d^ = z + l h, in numpy, for readings that
    have nothing to do with the model.
    """
    rng, dt, l = np.random.default_rng(0), 0.1, np.array([0.5, 1.0, 2.0, 4.0])
    ys, us = rng.uniform(3.0, 20.0, (30, 4)), rng.uniform(0.0, 12.0, (30, 2))
    observer = DisturbanceObserver(model=FOUR, l=l)
    state, z = observer.init(tuple(ys[0])), -l * ys[0]
    for y, u in zip(ys, us):
        estimate, state = observer.step(state, Tick(t=0.0, r=(), dr=(), ddr=(), dt=dt), tuple(y))
        np.testing.assert_allclose(estimate.d, z + l * y, rtol=1e-9, atol=1e-9)
        state = observer.predict(state, Tick(0.0, (), (), (), dt), tuple(us[0]), tuple(u))
        rate = np.asarray(FOUR.derivative(0.0, tuple(y), tuple(u), None))
        z = z + dt * (-l * z - l * (l * y + rate))


def test_a_constant_disturbance_is_found_at_the_rate_l():
    """Of levels that move as the observer expects, and by d besides, d^ = (1 - (1 - l dt)^k) d."""
    dt, l, d = 0.1, np.array([0.5, 1.0, 2.0, 4.0]), np.array([0.3, -0.2, 0.1, 0.0])
    observer, h, u = DisturbanceObserver(model=FOUR, l=l), np.full(4, 8.0), (3.0, 3.5)
    tick = Tick(t=0.0, r=(), dr=(), ddr=(), dt=dt)
    state = observer.init(tuple(h))
    for k in range(40):
        estimate, state = observer.step(state, tick, tuple(h))
        np.testing.assert_allclose(estimate.d, (1.0 - (1.0 - l * dt) ** k) * d, atol=1e-12)
        state = observer.predict(state, tick, u, u)
        h = h + dt * (np.asarray(FOUR.derivative(0.0, tuple(h), u, None)) + d)


def test_what_passes_a_rim_is_no_disturbance():
    """A full tank whose pump brings more than its outlet takes rests at the rim of the model."""
    tank = network(
        area=[25.0], drain=[0.1], pump_gain=[8.0], feeds=[(0, None)], rim=[10.0], overflow=True
    )
    tick = Tick(t=0.0, r=(), dr=(), ddr=(), dt=0.1)
    for overflow, expected in ((True, 0.0), (False, -1.0)):
        model = dataclasses.replace(tank, overflow=overflow)
        observer = DisturbanceObserver(model=model, l=[1.0])
        state = observer.init((10.0,))
        for _ in range(200):
            estimate, state = observer.step(state, tick, (10.0,))
            state = observer.predict(state, tick, (12.0,), (12.0,))
        rate = float(model.derivative(0.0, (10.0,), (12.0,), None)[0])
        assert float(estimate.d[0]) == pytest.approx(expected * rate, abs=1e-8)


def four(**changes):
    values = dict(model=FOUR, process=[1e-4] * 4, measurement=[0.01] * 4, walk=[1e-4] * 4)
    values |= dict(measured=(0, 1), disturbed=(0, 1))
    return values | changes


@pytest.mark.parametrize(
    "observer, words",
    [
        (DisturbanceObserver(model=FOUR, l=[1.0] * 4, measured=(4,)), "observer.measured = "),
        (DisturbanceObserver(model=FOUR, l=[1.0] * 4, measured=(1, 1)), "each once"),
        (
            DisturbanceObserver(model=FOUR, l=[1.0] * 4, before_compensation=True),
            "observer.model must have one pump per controlled tank",
        ),
        (ExtendedKalman(**four(walk=None), spread=[0.0] * 4), "observer.walk: needs"),
        (
            ExtendedKalman(**four(disturbed=(0, 7)), spread=[0.0] * 4),
            r"observer.disturbed = \(0, 7",
        ),
        (
            ExtendedKalman(**four(disturbed=(0, 1, 2)), spread=[0.0] * 4),
            "disturbances are not identifiable",
        ),
        # both upper tanks, from one lower level
        (
            Kalman(**four(measured=(0,), disturbed=(2, 3)), levels=[8.0] * 4, inputs=[3.0, 3.0]),
            "disturbances are not identifiable",
        ),
    ],
)
def test_by_input_validation(observer, words):
    with pytest.raises(InputError, match=words):
        observer.check(FOUR)


@pytest.mark.parametrize(
    "observer",
    [
        ExtendedKalman(**four(disturbed=(0,)), spread=[0.0] * 4),
        Kalman(**four(disturbed=(0,)), levels=[8.0] * 4, inputs=[3.0, 3.0]),
        DisturbanceObserver(model=FOUR, l=[1.0] * 4),
    ],
)
def test_an_observer_whose_leaves_are_traced_passes(observer):
    def checked(own):
        own.check(FOUR)
        return 0.0

    assert jax.jit(checked)(observer) == 0.0


def test_a_gain_too_large_for_the_sampling_period_is_refused():
    case = rig.set_values(presets.find("gouta2015/ngpc-observer"), {"clock.dt": 1.0})
    loop = with_values(case.loop, {"observer.l[2]": 2.5})
    with pytest.raises(
        InputError, match=r"observer.l\[2\] = 2.5 1/s: must be below 2/clock.dt = 2"
    ):
        jaxtank.check(loop, case.clock)
    jaxtank.check(with_values(loop, {"observer.l[2]": 1.9}), case.clock)


def test_rig_files_keep_every_key():
    assert rig.loads(row(3, OWN, {})).loop.observer.measured == (0, 1, 2)
    case = rig.loads(row(3, [*OWN, "measured = [1, 3]"], {}))
    assert case.loop.observer.measured == (0, 2)
    again = rig.loads(rig.dump(case))
    assert jax.tree.structure(again.loop) == jax.tree.structure(case.loop)
    assert "estimate.d" in "".join(rig.case_warnings(case))  # an open loop uses none
    words = [*WALKS, "spread = 0.0", "measured = [1, 3]", "disturbed = [2]"]
    filtered = rig.loads(row(3, words, {}))
    assert filtered.loop.observer.disturbed == (1,)
    again = rig.loads(rig.complete(filtered))
    assert jax.tree.structure(again.loop) == jax.tree.structure(filtered.loop)


def test_a_filter_begins_at_its_start_and_estimates_nothing_where_it_is_not_asked():
    plant = network(
        area=[50.0, 40.0], drain=[0.5, 0.3], pump_gain=[8.0], feeds=[(0, None)], rim=[40.0, 40.0]
    )
    values = {n: [0.01] * 2 for n in ("process", "measurement", "spread", "walk")}
    observer = ExtendedKalman(
        model=plant, measured=(0, 1), disturbed=(0,), start=[3.0, 0.0], **values
    )
    state = observer.init((7.0, 8.0))
    assert [float(v) for v in state.x] == [3.0, 0.0, 0.0]
    estimate, _ = observer.step(state, Tick(0.0, (), (), ()), (0.0, 0.0))
    assert [float(v) for v in estimate.d] == [0.0, 0.0]


def test_a_coefficient_with_a_small_effect_can_be_found():
    """A basin in metres: 1 V is 1e-6 m/s."""
    plant = network(
        area=[10.0], drain=[1e-3], pump_gain=[1e-5], feeds=[(0, None)], rim=[4.0], gravity=9.81
    )
    observer = ExtendedKalman(
        model=plant, measured=(0,), coefficients=("pump_gain[0]",), coefficient_spread=0.01,
        coefficient_walk=1e-6, process=[1e-6], measurement=[1e-6], spread=[1e-6],
    )  # fmt: skip
    check_disturbed(observer, plant, [2.0])


VALVE = """
units = ["m", "m^3/h"]
tank = [{ area = 0.8, height = 2.0, level = 1.0 }, { area = 0.5, height = 2.0, level = 0.8 }]
pump = [{ to = 1, high = 8.0, initial = 3.0 }]
valve = [{ from = 2, area = "6 cm^2", initial = 0.4 }]
orifice = [{ from = 1, to = 2, area = "2 cm^2" }]
plant = { outputs = [1, 2] }
controller = { kind = "state-feedback", K = [[2.0, 0.5], [-0.05, -0.3]] }
reference = { initial = [1.0, 0.8], changes = [[100.0, 1, 1.3], [600.0, 2, 1.1]] }
values = { "clock.dt" = 2.0, "clock.duration" = 3000.0 }
[observer]
kind = "kalman"
levels = [1.0, 0.8]
inputs = [3.0, 0.4]
process = [1e-6, 1e-6]
measurement = [1e-6, 1e-6]
walk = [1e-9, 1e-9]
measured = [1, 2]
disturbed = [1, 2]
"""


@pytest.mark.extended
def test_a_valve_away_from_its_operating_point_is_no_disturbance_of_a_linear_filter():
    """The model is exact; the opening falls to 0.36 and the level above it rises by 0.3 m."""
    case = rig.loads(VALVE)
    run = jaxtank.simulate(case.loop, case.clock)
    np.testing.assert_allclose(run.d_hat[-1], 0.0, atol=1e-7)  # m/s; the valve: 6e-4 m/s

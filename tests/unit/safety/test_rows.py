"""Rows, brackets, bands and conditions of the safety filter against numbers worked out by hand from
the formulas of `jaxtank/safety/README.md`, in plain arithmetic.
"""

import dataclasses
import math

import jax
import numpy as np
import pytest
from safety_attacks import sensor_of
from scipy.integrate import solve_ivp

from jaxtank import rig, simulate
from jaxtank.core.errors import InputError
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.plants import network
from jaxtank.safety import SafetyFilter, design
from jaxtank.safety.box import band_of, box_of, narrow_band
from jaxtank.safety.low_limits import certain_share

W = math.sqrt(2 * 981.0)
HOLD = 0.5


def cascade(**changes):
    """Tank 1 below tank 2 and beside tank 3; pump 1 into tank 1, 2 into tanks 2 and 1."""
    parts = {
        **{"area": [20.0, 30.0, 25.0], "drain": [0.30, 0.20, 0.15], "rim": [30.0, 28.0, 26.0]},
        **{"links": [(1, 0)], "orifice": [0.25], "pipes": [(0, 2)], "pipe": [0.12]},
        **{"feeds": [(0, None), (1, 0)], "pump_gain": [8.0, 6.0], "split": [1.0, 0.7]},
        "outputs": (0,),
    }
    return network(**(parts | changes))


def scaled_by(plant, factor):
    """A plant with all flows times a factor; shares of pumps as they are."""
    leaves = {n: np.asarray(getattr(plant, n)) for n in ("drain", "orifice", "pipe", "pump_gain")}
    return dataclasses.replace(plant, **{name: factor * v for name, v in leaves.items()})


def filter_of(plant, **fields):
    """A SafetyFilter of +-10 %, of limits that are given, not designed."""
    of_tanks = {"limit": [29.0, 27.0, 25.0], "reach": [29.0, 27.0, 25.0], "rate": [0.8] * 3}
    of_tanks |= {"band": [0.2, 0.3, 0.1], "inflow": [4.0, 6.0, 5.0], "spare": [0.4, 0.7, 0.5]}
    values = {name: np.array(v) for name, v in of_tanks.items()}
    least, most = scaled_by(plant, 0.9), scaled_by(plant, 1.1)
    return SafetyFilter(least=least, most=most, **(values | {"held": (0, 1), "age": 0.0} | fields))


Y, LOW, HIGH = (26.0, 18.0, 21.0), (0.0, 0.0), (12.0, 10.0)


def rows_of(safety_filter, y=Y, hold=HOLD, line=None):
    """[({pump: a}, M)] of plain numbers."""
    rows = safety_filter.bounds(y, hold, LOW, HIGH, line)
    return [({j: float(a) for j, a in row.items()}, float(m)) for row, m in rows]


def test_the_row_of_a_tank_with_pumps_has_each_term_of_theorem_1():
    """Neighbours: the lesser of `reach` and reading + band + (T + age) times the fastest rise +
    what may enter besides.
    """
    (row, m), _ = rows_of(filter_of(cascade(), age=0.3))
    assert row == pytest.approx({0: 1.1 * 8.0 / 20.0, 1: 1.1 * 6.0 * 0.3 / 20.0}, rel=1e-12)
    # tank 2: pump 2 at 10 V and the inflow, nothing else feeds it
    above_2 = 18.0 + 0.3 + 0.8 * (1.1 * 6.0 * 0.7 * 10.0 / 30.0 + 6.0 / 30.0) + 0.7
    # tank 3: the pipe, from tank 1 at its reach, and the inflow
    piped = 1.1 * 0.12 * W / 25.0 * 29.0 / (29.0**2 + 0.01**2) ** 0.25
    above_3 = 21.0 + 0.1 + 0.8 * (piped + 5.0 / 25.0) + 0.5
    assert above_2 < 27.0 and above_3 < 25.0
    h = 26.0 - 0.2
    z = above_3 - h  # below 0: the pipe takes liquid away, at least
    phi = 4.0 / 20.0 - 0.9 * 0.30 * W / 20.0 * math.sqrt(h)
    phi += 0.9 * 0.12 * W / 20.0 * z / (z**2 + 0.01**2) ** 0.25
    phi += 1.1 * 0.25 * W / 20.0 * math.sqrt(above_2)
    assert z < 0.0
    assert m == pytest.approx(0.8 * (29.0 - 26.0 - 0.2) - phi, rel=1e-9)


def test_neighbours_near_their_reach_count_with_it_and_pipes_may_fill():
    (_, m), _ = rows_of(filter_of(cascade(), age=30.0), y=(20.0, 26.9, 24.9))
    h = 20.0 - 0.2
    phi = 4.0 / 20.0 - 0.9 * 0.30 * W / 20.0 * math.sqrt(h)
    phi += 1.1 * 0.12 * W / 20.0 * math.sqrt(25.0 - h) + 1.1 * 0.25 * W / 20.0 * math.sqrt(27.0)
    assert m == pytest.approx(0.8 * (29.0 - 20.0 - 0.2) - phi, rel=1e-5)


def test_the_row_of_the_tank_above_counts_both_its_outlets():
    _, (row, m) = rows_of(filter_of(cascade()))
    assert row == pytest.approx({1: 1.1 * 6.0 * 0.7 / 30.0}, rel=1e-12)
    phi = 6.0 / 30.0 - 0.9 * (0.20 + 0.25) * W / 30.0 * math.sqrt(18.0 - 0.3)
    assert m == pytest.approx(0.8 * (27.0 - 18.0 - 0.3) - phi, rel=1e-12)


def below_two(**fields):
    """A filter with a second-order row of tank 1, below tanks 2 and 3 with a pump each."""
    plant = network(
        area=[20.0, 30.0, 25.0], drain=[0.30, 0.10, 0.05], links=[(1, 0), (2, 0)],
        orifice=[0.15, 0.2], feeds=[(1, None), (2, None)], pump_gain=[8.0, 6.0],
        rim=[30.0, 28.0, 26.0],
    )  # fmt: skip
    none = {"inflow": np.zeros(3), "spare": np.zeros(3), "held": (0,)}
    return filter_of(plant, **(none | {"slope": np.array([0.2, 0.0, 0.0])} | fields))


@pytest.mark.parametrize("draw", [None, [-3.0, -2.0, -1.0]])
def test_the_second_order_row_has_each_term_of_theorem_2(draw):
    """A leak (`draw`) counts for nothing in it: the comparison of README.md, Theorem 2."""
    leaks = {} if draw is None else {"draw": np.array(draw)}
    y, k1, k2 = (28.0, 14.0, 9.0), 0.2, 0.8
    ((row, m),) = rows_of(below_two(**leaks), y=y)
    out = lambda s, a, f: f * s * W / a
    c = {1: out(0.15, 20.0, 1.1), 2: out(0.20, 20.0, 1.1)}
    o_least = {1: out(0.25, 30.0, 0.9), 2: out(0.25, 25.0, 0.9)}
    o_most = {1: out(0.25, 30.0, 1.1), 2: out(0.25, 25.0, 1.1)}
    band = {1: 0.3, 2: 0.1}
    gain = {1: 1.1 * 8.0 / 30.0, 2: 1.1 * 6.0 / 25.0}
    for j in (1, 2):
        s = math.sqrt(y[j] - band[j]) - 0.5 * o_most[j] * HOLD
        assert row[j - 1] == pytest.approx(c[j] * gain[j] * 0.5 / s, rel=1e-12)
    g = out(0.30, 20.0, 0.9) * math.sqrt(28.0 - 0.2) + k1 * (29.0 - 28.0 - 0.2)
    g -= sum(c[j] * math.sqrt(y[j] + band[j]) for j in (1, 2))
    drains = sum(0.5 * c[j] * o_least[j] for j in (1, 2))
    leaves = out(0.30, 20.0, 1.1) * math.sqrt(29.0)
    lowest = 28.0 - 0.2 - HOLD * leaves
    assert m > 0.0
    assert m == pytest.approx(drains + k2 * g - k1**2 * (29.0 - lowest), rel=1e-10)


def test_far_below_its_limit_a_tank_without_a_pump_has_no_row():
    """h* of c_min s(h*) + k1 (H - h*) = F: a row above it, none below."""
    safety_filter = below_two(slope=np.array([0.6, 0.0, 0.0]))
    full = 1.1 * W / 20.0 * (0.15 * math.sqrt(27.0) + 0.2 * math.sqrt(25.0))
    c, k1 = 0.9 * 0.30 * W / 20.0, 0.6
    root = (c + math.sqrt(c * c + 4.0 * k1 * (k1 * 29.0 - full))) / (2.0 * k1)
    edge = root**2 - 0.2 - HOLD * full
    for y, far in ((edge - 1e-6, True), (edge + 1e-6, False)):
        ((row, m),) = rows_of(safety_filter, y=(y, 27.0, 25.0))
        assert (m > sum(a * v for a, v in zip(row.values(), HIGH))) == far


def bracketed(c, b, flows, h, top, line, step, above):
    """The level after inputs under way, from above or below: Theorem 5, by steps that bound it."""
    for u in line:
        flow = b * u + flows
        explicit = h + step * (flow - c * math.sqrt(h))
        half = 0.5 * step * c
        root = -half + math.sqrt(half * half + h + step * flow)
        rises = explicit >= h
        h = (explicit if rises else root**2) if above else (root**2 if rises else explicit)
        h = min(h, top) if above else h
    return h


@pytest.mark.parametrize("line", [(12.0, 6.0, 0.0), (0.0, 6.0, 12.0), (9.0, 0.0, 9.0)])
def test_the_predicted_row_runs_two_copies_over_the_inputs_under_way_oldest_first(line):
    plant = network(area=[20.0], drain=[0.3], feeds=[(0, None)], pump_gain=[8.0], rim=[30.0])
    value = lambda v: np.array([v])
    safety_filter = filter_of(
        plant, limit=value(29.0), reach=value(29.0), rate=value(0.8), band=value(0.2),
        inflow=value(4.0), spare=value(0.0), draw=value(-2.0), held=(0,), predicted=3,
    )  # fmt: skip
    rows = safety_filter.bounds((22.0,), HOLD, (0.0,), (12.0,), (np.array(line),))
    ((row, m),) = rows
    c_min, c_max = (f * 0.3 * W / 20.0 for f in (0.9, 1.1))
    b_min, b_max = 0.9 * 8.0 / 20.0, 1.1 * 8.0 / 20.0
    most = bracketed(c_min, b_max, 4.0 / 20.0, 22.2, 29.0, line, HOLD, above=True)
    least = bracketed(c_max, b_min, -2.0 / 20.0, 21.8, 29.0, line, HOLD, above=False)
    expected = 0.8 * (29.0 - most) - (4.0 / 20.0 - c_min * math.sqrt(least))
    assert float(row[0]) == pytest.approx(b_max) and expected > 0.0
    assert float(m) == pytest.approx(expected, rel=1e-9)


RUN = """
name = "delayed"
tank = [{ area = 20.0, rim = 30.0, drain = 0.2, level = 20.0 }]
pump = [{ gain = 8.0, to = 1, high = 12.0, initial = 1.0 }]
plant = { outputs = [1] }
law = { kind = "open-loop", initial = [0.0], changes = [[2.0, 1, 12.0], [20.0, 1, 3.0]] }
values = { "clock.dt" = 0.5, "clock.duration" = 30.0, "actuator.delay" = 2.0 }
[safety_filter]
"""


def test_a_run_gives_the_filter_the_inputs_under_way_in_their_order():
    """The inputs of a run are those that the filter gives for the last four of them."""
    loop = rig.loads(RUN).loop
    run = simulate(loop, rig.loads(RUN).clock)
    apply = jax.jit(lambda *now: loop.safety_filter.apply(loop.actuator, now[0], None, *now[1:]))
    applied = [1.0] * 4 + [float(u) for u in np.asarray(run.applied)[:, 0]]
    assert loop.safety_filter.predicted == 4 and len(set(applied)) > 20
    for k in range(60):
        command, y = float(np.asarray(run.command)[k, 0]), float(np.asarray(run.y)[k, 0])
        line = (np.array(applied[k : k + 4]),)
        (u,), _ = apply((command,), (y,), 0.5, line)
        assert float(u) == pytest.approx(applied[k + 4], rel=1e-9)


def test_a_row_of_two_pumps_lowers_both_in_proportion_above_their_lower_limits():
    """Pump 2 cannot stop: 0.5 V are no part of what is shared out."""
    safety_filter = filter_of(cascade(), running=(1,))
    (u, v), shared, low = (10.0, 8.0), [({0: 0.4, 1: 0.3}, 3.0)], (0.0, 0.5)
    share = (3.0 - 0.3 * 0.5) / (0.4 * 10.0 + 0.3 * 7.5)
    found = [float(x) for x in safety_filter.scaled((u, v), shared, low)]
    assert found == pytest.approx([10.0 * share, 0.5 + 7.5 * share], rel=1e-12)
    assert 0.4 * found[0] + 0.3 * found[1] == pytest.approx(3.0, rel=1e-12)
    stopped = [float(x) for x in safety_filter.scaled((u, v), [({0: 0.4, 1: 0.3}, 0.1)], low)]
    assert stopped == [0.0, 0.5]


@pytest.mark.parametrize("drawn", [0.0, 2.0])
def test_a_floor_has_each_term(drawn):
    """-Phi_min(y + band) - kappa (y - band - L), over the weakest gain of the pump; the one of the
    tank above may draw from it.
    """
    plant = cascade(pipes=[], pipe=[], feeds=[(1, None), (0, None)], split=[1.0, 1.0])
    draw = {"low": np.array([5.0, 0.0, 0.0]), "draw": np.array([-4.0, 0.0, 0.0])}
    safety_filter = filter_of(plant, kept=(0,), **draw)
    floors, _ = safety_filter.least_inputs((4.5, 12.0, 9.0), HOLD, (-drawn, 0.0), HIGH)
    fastest = (1.1 * (0.20 + 0.25) * W * math.sqrt(27.0) + 1.1 * 8.0 * drawn) / 30.0
    below = 12.0 - 0.3 - HOLD * fastest
    phi = -4.0 / 20.0 - 1.1 * 0.30 * W / 20.0 * math.sqrt(4.7)
    phi += 0.9 * 0.25 * W / 20.0 * math.sqrt(below)
    needed = (-phi - 0.8 * (4.5 - 0.2 - 5.0)) / (0.9 * 6.0 / 20.0)
    assert 0.0 < needed < 10.0
    assert [float(f) for f in floors] == pytest.approx([-drawn, needed], rel=1e-12)


# --------------------------------------------------------------------------- the design


def one_tank(drain=0.0, rim=30.0, **pumps):
    plant = network(area=[20.0], drain=[drain], feeds=[(0, None)], pump_gain=[8.0], rim=[rim])
    return plant, PumpBank(low=[0.0], high=[12.0], **pumps)


def designed(plant, actuator, **given):
    given = {"widths": {}, "sensor": sensor_of(plant), "hold": HOLD} | given
    sensor, hold = given.pop("sensor"), given.pop("hold")
    return design(plant, actuator, sensor, hold, **given)


def test_the_band_is_six_deviations_half_an_adc_step_and_the_size_of_the_offset():
    plant, actuator = one_tank()
    sensor = LevelSensor(noise=[0.05], offset=[-0.3], gain=[8.0], full_scale=5.0, bits=6)
    found, _ = designed(plant, actuator, sensor=sensor)
    step = 8.0 * 5.0 / 64
    assert float(found.band[0]) == pytest.approx(6 * 0.05 + 0.5 * step + 0.3, rel=1e-12)


def test_a_band_has_what_an_empty_tank_reads_and_half_a_step_of_the_widest_span():
    adc = {"gain": [1.0, 1.0], "full_scale": 30.0, "bits": 6}
    span = {"low": [0.4, -0.2], "high": [20.0, 25.0]}
    sensor = LevelSensor(noise=[0.05, 0.02], offset=[-0.3, 0.1], **span, **adc)
    widths = {"high[0]": 0.5, "low[0]": 0.1, "offset[1]": 0.2, "noise[0]": 0.01}
    band = band_of(sensor, widths={f"sensor.{name}": width for name, width in widths.items()})
    first = 6 * 0.06 + 0.3 + 0.5 + 0.5 * (20.5 - 0.3) / 64
    second = 6 * 0.02 + 0.3 + 0.0 + 0.5 * (25.0 + 0.2) / 64
    np.testing.assert_allclose(band, [first, second], rtol=1e-14)


@pytest.mark.parametrize(
    ("widths", "refused"),
    [
        ({"drain[0]": 0.3}, False),  # an outlet may be plugged
        ({"drain[0]": 0.31}, True),
        ({"area[0]": 20.0}, True),  # a tank has an area
        ({"area[0]": 19.0, "drain": 0.15}, False),
    ],
)
def test_a_box_has_no_parameter_below_0_and_no_area_of_0(widths, refused):
    if refused:
        with pytest.raises(InputError):
            box_of(cascade(), widths)
        return
    for plant, sign in zip(box_of(cascade(), widths), (-1.0, 1.0)):
        assert plant.drain[0] == 0.3 + sign * widths.get("drain[0]", widths.get("drain", 0.0))
        assert plant.area[0] == 20.0 + sign * widths.get("area[0]", 0.0)


@pytest.mark.parametrize(("sigmas", "proved"), [(4.9, False), (5.1, True)])
def test_a_band_of_less_than_five_deviations_is_not_relied_on(sigmas, proved):
    plant, actuator = one_tank()
    sensor = LevelSensor(noise=[0.05])
    found, (row,) = designed(plant, actuator, sensor=sensor, band=sigmas * 0.05)
    assert row.certified == proved
    assert (narrow_band(sensor, found.band, "cm", {}) == [""]) == proved  # not the checker alone


def test_volumes_that_enter_besides_lower_the_limit_that_is_kept():
    plant, actuator = one_tank(drain=0.3)
    given = {"volume": 40.0, "widths": {"area": [1.0]}, "start": [5.0]}
    found, (row,) = designed(plant, actuator, **given)
    assert float(found.limit[0]) == pytest.approx(30.0 - 40.0 / 19.0, rel=1e-12)
    assert row.limit == pytest.approx(30.0, rel=1e-12) and row.certified and row.starts == "case"
    volume = 19.0 * 29.95  # leaves 0.05 cm
    assert designed(plant, actuator, **given | {"volume": volume})[0].limit[0] < 0.051
    with pytest.raises(InputError):
        designed(plant, actuator, **given | {"volume": 19.0 * 30.0})


def test_a_tank_that_full_pumps_cannot_fill_has_no_gap_also_with_volumes_that_enter_besides():
    plant, actuator = one_tank(drain=96.0 / (W * math.sqrt(27.0)))  # full pumps rest at 27 cm
    _, (row,) = designed(plant, actuator, volume=40.0, start=[5.0])
    assert row.certified and row.gap == 0.0 and row.limit == pytest.approx(30.0, rel=1e-12)


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_f_what_full_pumps_bring_within_the_lag_is_at_most_three_quarters(share):
    """(F): (2 tau + T) b u_high against 3/4 of H."""
    lag = 2.0
    rim = (2.0 * lag + HOLD) * 8.0 / 20.0 * 12.0 / 0.75 / share
    plant, actuator = one_tank(rim=rim, lag=np.array([lag]))
    _, (row,) = designed(plant, actuator, start=[0.0])
    assert row.certified == (share < 1.0)


@pytest.mark.parametrize("share", [0.999, 1.001])
def test_inputs_under_way_may_fill_a_predicted_tank_up_to_its_limit(share):
    """Of a tank without outlets: 3 V for 2 s bring 8/20 x 3 x 2 = 2.4 cm."""
    plant, actuator = one_tank(delay=2.0, initial=np.array([3.0]))
    found, (row,) = designed(plant, actuator, start=[30.0 - 2.4 / share])
    assert found.predicted == 4 and row.certified == (share < 1.0)


@pytest.mark.parametrize("share", [0.995, 1.005])
def test_a_steady_inflow_and_the_outlet_count_while_inputs_under_way_fill_a_tank(share):
    plant, actuator = one_tank(drain=0.05, delay=5.0, initial=np.array([12.0]))
    falling = lambda t, h: -(8.0 * 12.0 + 12.0 - 0.05 * W * np.sqrt(h)) / 20.0
    earlier = solve_ivp(falling, (0.0, 5.0), [30.0], rtol=1e-10).y[0, -1]
    room = (30.0 - earlier) / share
    _, (row,) = designed(plant, actuator, start=[30.0 - room], inflow=[12.0])
    assert row.certified == (share < 1.0), row.reason


def test_a_pipe_with_dead_time_is_not_proved():
    plant = network(
        area=20.0, drain=[0.3, 0.3], pipes=[(0, 1)], pipe=[0.2], feeds=[(0, None)], pump_gain=8.0,
        rim=30.0,
    )  # fmt: skip
    pumps = lambda delay: PumpBank(low=[0.0], high=[12.0], delay=delay)
    assert [row.certified for row in designed(plant, pumps(0.0))[1]] == [True, True]
    row = designed(plant, pumps(HOLD))[1][0]
    assert not row.certified and row.reason == "a pipe with dead time or lag: not proved"


def below(drain, above, orifices, **given):
    """(filter, certificates) of tank 1 below tanks of a pump each; areas 20 cm^2, +-5 %."""
    n = 1 + len(orifices)
    links = [(k, 0) for k in range(1, n)]
    plant = network(
        area=20.0, drain=[drain] + [above] * (n - 1), links=links, orifice=orifices,
        feeds=[(k, None) for k in range(1, n)], pump_gain=20.0, rim=[20.0] + [30.0] * (n - 1),
    )  # fmt: skip
    actuator = PumpBank(low=[0.0] * (n - 1), high=[12.0] * (n - 1))
    widths = {name: 0.05 * np.asarray(getattr(plant, name)) for name in ("drain", "orifice")}
    return designed(plant, actuator, start=np.full(n, 0.5), widths=widths, **given)


def test_c3_a_tank_that_must_run_empty_above_is_not_held_by_the_second_order():
    """0.95 x 0.27 s(20) - 1.05 x 0.2 s(30) is less than 1.05 x 0.084 a0."""
    certain = 0.95 * 0.27 * math.sqrt(20.0)
    other, a0 = 1.05 * 0.2 * math.sqrt(30.0), 0.05 * math.sqrt(20.0)
    assert certain - other < 1.05 * 0.084 * a0
    found, rows = below(0.27, 0.38, [0.2, 0.084], hold=0.1)
    assert float(found.slope[0]) == 0.0 and all(r.certified for r in rows)
    assert np.all(np.asarray(found.limit)[1:] < 29.0)


def test_c4_k1_is_above_the_slope_of_the_outflow_where_the_row_acts():
    """k1 = 0.1775 1/s meets (C1) and (C2), and is below c_min/(2 sqrt(l)) = 0.29 1/s."""
    k1, hold, c = 0.17754985582066635, 2.0, 0.95 * 0.19 * W / 20.0
    c_in, o = 1.05 * 0.235 * W / 20.0, 0.95 * (0.35 + 0.235) * W / 20.0
    full = c_in * math.sqrt(30.0)
    root = (c + math.sqrt(c * c + 4.0 * k1 * (k1 * 20.0 - full))) / (2.0 * k1)
    assert k1 * 20.0 >= full and k1**2 * (20.0 - root**2) <= 0.9 * 0.5 * c_in * o
    lowest = root**2 - hold * (full + 1.05 / 0.95 * c * math.sqrt(20.0))
    assert lowest > 0.0 and c / (2.0 * math.sqrt(lowest)) > k1
    found, rows = below(0.19, 0.35, [0.235], hold=hold)
    assert float(found.slope[0]) == 0.0 and all(r.certified for r in rows)


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_the_weakest_of_two_pumps_decides_whether_floor_and_cap_agree(share):
    """Readings from L - band: there the floor asks for kappa 2 band, and the cap allows kappa
    (H - L), of which the weaker of two pumps brings 40/60 for certain.
    """
    plant = network(
        area=[20.0], drain=[0.0], feeds=[(0, None)] * 2, pump_gain=[50.0, 50.0], rim=[30.0]
    )
    actuator = PumpBank(low=[0.0, 0.0], high=[12.0, 12.0])
    band, widths = 0.5, {"pump_gain": [0.0, 10.0]}
    low = 30.0 - 2.0 * band * 60.0 / 40.0 / share
    _, (row,) = designed(plant, actuator, widths=widths, band=band, rate=1.0, low=[low])
    assert row.low_certified == (share < 1.0)
    assert certain_share({0: (50.0, 50.0), 1: (40.0, 60.0)}) == pytest.approx(2.0 / 3.0)

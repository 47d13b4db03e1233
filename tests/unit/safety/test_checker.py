"""The independent checker of the safety filter: each condition by hand, a little on either side,
and proved filters with one number damaged.
"""

import ast
import dataclasses
import inspect
import math
import types

import numpy as np
import pytest
from scipy.optimize import brentq

from jaxtank import component, leaf, presets, rig
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.plants import TankNetwork, network
from jaxtank.plants.faults import faults
from jaxtank.safety import checker, design, known_features
from jaxtank.safety.box import intervals, widths_of
from jaxtank.safety.checker import CASE, LIMITS, check
from jaxtank.safety.of_case import certificates_of

W = math.sqrt(2 * 981.0)
EDGE = ((0.999, True), (1.001, False))
"""Shares of the largest value that is proved, and whether it is."""


def bank(m=1, **changes):
    return PumpBank(**{"low": np.zeros(m), "high": np.full(m, 12.0)} | changes)


def one_tank(**changes):
    parts = {"area": [20.0], "drain": [0.3], "feeds": [(0, None)], "pump_gain": [8.0]}
    return network(**parts | {"rim": [30.0]} | changes)


def two_tanks(**changes):
    """Two tanks, each with a pump."""
    parts = {"area": 20.0, "drain": [0.3, 0.3], "feeds": [(0, None), (1, None)], "pump_gain": 8.0}
    return network(**parts | {"rim": 30.0} | changes)


def chain(**changes):
    """Tank 2 above tank 1, both with a pump; its limit is lowered for tank 1."""
    return two_tanks(**{"drain": [0.3, 0.0], "links": [(1, 0)], "orifice": [0.33]} | changes)


class Proved:
    """A filter of `design`, and what `check` says of it with changes to filter or arguments."""

    def __init__(self, plant, actuator, hold=0.5, *, sensor=None, spread=0.05, **settings):
        sensor = sensor or LevelSensor(noise=np.zeros(plant.tanks))
        names = ("drain", "orifice", "pipe", "pump_gain", "split")
        widths = widths_of(plant, dict.fromkeys(names, spread))
        self.filter, _ = design(plant, actuator, sensor, hold, widths=widths, **settings)
        self.plant, self.actuator, self.sensor = plant, actuator, sensor
        self.known = {
            "hold": hold,
            "substeps": settings.get("substeps", 1),
            "box": intervals(widths, {"plant": plant}),
            "inflow": (settings.get("draw", 0.0), settings.get("inflow", 0.0)),
            "volume": settings.get("volume", 0.0),
            "start": settings.get("start"),
        }

    def check(self, *, plant=None, actuator=None, sensor=None, box=(), known=(), **of_filter):
        known = self.known | dict(known)
        return check(
            dataclasses.replace(self.filter, **of_filter),
            plant or self.plant,
            actuator or self.actuator,
            sensor or self.sensor,
            **known | {"box": known["box"] | dict(box)},
        )

    def holds(self, tank=0, **changes):
        return self.check(**changes)[tank].holds

    def reason(self, tank=0, **changes):
        """Why the limit of a tank is not proved with some changes."""
        verdict = self.check(**changes)[tank]
        assert not verdict.holds
        return verdict.reason

    def entry(self, field, tank, factor):
        """{field: its array with one entry changed}."""
        value = np.array(getattr(self.filter, field), dtype=float)
        value[tank] = value[tank] * factor
        return {field: value}

    def ends(self, **changes):
        """{end of the filter's box: that plant with changes}."""
        ends = {"least": self.filter.least, "most": self.filter.most}
        return {k: dataclasses.replace(v, **changes) for k, v in ends.items()}


def test_the_checker_imports_nothing_of_the_filter():
    for module in (checker, known_features):
        tree = ast.parse(inspect.getsource(module))
        names = [n.module or "" for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)]
        names += [a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names]
        names = [name for name in names if name != "jaxtank.safety.known_features"]
        assert not [name for name in names if "safety" in name or name.startswith("jax.")]


# --------------------------------------------------------------------------- second order


def gouta2015():
    loop = presets.find("gouta2015/backstepping-ff").loop
    return Proved(loop.plant, loop.actuator, 0.1, start=loop.x0)


def by_hand(proved):
    """(c, H, F, D, o_most, [(tank, c_in) above]) of Theorem 2, for tank 1 of gouta2015."""
    least, most, area = proved.filter.least, proved.filter.most, np.asarray(proved.plant.area)
    links = proved.plant.links
    outlets = lambda p, i: float(
        p.drain[i] + sum(p.orifice[k] for k, (a, _) in enumerate(links) if a == i)
    )
    out = lambda p, i: W / area[i] * outlets(p, i)
    above = [(j, W * float(most.orifice[k]) / area[0]) for k, (j, b) in enumerate(links) if b == 0]
    full = sum(c * math.sqrt(30.0) for _, c in above)
    drained = sum(0.5 * c * out(least, j) for j, c in above)
    return out(least, 0), 30.0, full, drained, out(most, 0), above


def test_k1_of_a_second_order_row_is_bounded_by_c1_c2_and_c4():
    """By hand: k1^2 (H - h*) = D, k1 H = F, and k1 = c/(2 sqrt(lowest)), 0.1 % on either side."""
    proved = gouta2015()
    assert all(v.holds for v in proved.check())
    c, top, full, drained, most, _ = by_hand(proved)
    star = lambda k1: brentq(lambda h: c * math.sqrt(h) + k1 * (top - h) - full, 1e-9, top)
    largest = brentq(lambda k1: k1**2 * (top - star(k1)) - drained, 0.19, 0.5)
    second = float(proved.filter.slope[1])
    at = lambda k1, **known: {
        "slope": [k1, second, 0.0, 0.0], "rate": np.full(4, 0.1), "known": known
    }  # fmt: skip
    assert proved.holds(**at(0.999 * largest)) and "(C1)" in proved.reason(**at(1.001 * largest))
    least = full / top
    assert proved.holds(**at(1.001 * least)) and "(C2)" in proved.reason(**at(0.999 * least))
    lowest = (0.5 * c / 0.19) ** 2  # (C4): the slope of the outflow is k1 = 0.19 there
    hold = (star(0.19) - lowest) / (full + most * math.sqrt(top))
    assert proved.holds(**at(0.19, hold=0.999 * hold))
    assert "(C4)" in proved.reason(**at(0.19, hold=1.001 * hold))
    assert "(C4)" in proved.reason(**at(0.19, hold=0.999 * hold), band=np.full(4, 0.05))


def test_a_second_order_row_needs_tanks_above_that_hold_more_than_a0():
    """(C3): c_min s(H) less what the others bring, above c_in a0 of each, a0 = 0.05 s(H)."""
    proved = gouta2015()
    c, *_, above = by_hand(proved)
    share = sum(c_in for _, c_in in above) - min(0.95 * c_in for _, c_in in above)
    for factor, holds in ((1.001, True), (0.999, False)):
        drain = np.array(proved.filter.least.drain, dtype=float)
        drain[0] *= factor * share / c
        least = dataclasses.replace(proved.filter.least, drain=drain)
        assert ("(C3)" in proved.check(least=least)[0].reason) != holds


def test_two_orifices_between_the_same_tanks_count_together():
    """Halves of an orifice are the whole of it, in each condition of Theorem 2."""
    proved = gouta2015()
    halves = lambda p: np.concatenate([0.5 * np.asarray(p.orifice)] * 2)
    links = proved.plant.links * 2
    plant, least, most = (
        dataclasses.replace(p, links=links, orifice=halves(p))
        for p in (proved.plant, proved.filter.least, proved.filter.most)
    )
    box = {"plant.orifice": (halves(proved.filter.least), halves(proved.filter.most))}
    twice = {"plant": plant, "least": least, "most": most, "box": box}
    assert [v.holds for v in proved.check(**twice)] == [True] * 4
    c, top, full, drained, *_ = by_hand(proved)
    star = lambda k1: brentq(lambda h: c * math.sqrt(h) + k1 * (top - h) - full, 1e-9, top)
    largest = brentq(lambda k1: k1**2 * (top - star(k1)) - drained, 0.19, 0.5)
    for words, k1, holds in (("(C1)", largest, 0.999), ("(C2)", full / top, 1.001)):
        for share in (0.999, 1.001):
            slope = {"slope": [share * k1, 0.19, 0.0, 0.0], "rate": np.full(4, 0.1)}
            verdict = proved.check(**twice, **slope)[0]
            assert verdict.holds == (share == holds) and (words in verdict.reason) != verdict.holds


def test_a_second_order_row_needs_its_start_its_reach_and_its_rate():
    proved = gouta2015()
    c, top, *_, above = by_hand(proved)
    x0 = np.array([29.5, 3.0, 25.0, 25.0])
    k1, (other, share) = float(proved.filter.slope[0]), above[1]
    rest = c * math.sqrt(x0[0]) + k1 * (top - x0[0]) - share * math.sqrt(x0[other])
    edge = (rest / above[0][1]) ** 2  # level of the other tank above at which g = 0
    assert 3.0 < edge < top
    for factor, holds in EDGE:
        start = x0.copy()
        start[above[0][0]] = factor * edge
        assert proved.holds(known={"start": start}) == holds
    high = {"known": {"start": [3.0, 3.0, 31.0, 3.0]}}
    assert "start" in proved.reason(known={"start": np.full(4, 29.9)})
    assert "start at" in proved.reason(2, **high) and "relies on tank 3" in proved.reason(**high)
    lowered = proved.reason(**proved.entry("reach", 2, 0.99))
    assert "tank 3 may reach 30 cm, the filter counts on 29.7 cm" in lowered
    assert "k2 T" in proved.reason(**proved.entry("rate", 0, 5.001))
    assert all(v.holds for v in proved.check(**proved.entry("rate", 0, 4.999)))
    assert "rim" in proved.reason(held=(1, 2, 3))
    assert "neither" in proved.reason(slope=np.zeros(4))
    assert [v.starts for v in proved.check()] == [CASE, CASE, LIMITS, LIMITS]
    assert not proved.holds(known={"start": None})
    changed = lambda **pumps: {"actuator": dataclasses.replace(proved.actuator, **pumps)}
    for words, changes in (
        ("dead time or lag", changed(delay=0.1) | {"age": 0.1}),
        ("dead time or lag", changed(lag=np.array([0.1, 0.1]))),
        ("cannot stop", changed(low=np.array([0.1, 0.0]))),
        ("inflow disturbances", {"inflow": [0.0, 0.0, 1.0, 0.0]}),
        ("inflow disturbances", {"spare": [0.1, 0.0, 0.0, 0.0]}),
    ):
        assert words in proved.reason(**changes)
    # a pump that may run backwards only lowers the levels
    assert all(v.holds for v in proved.check(**changed(low=np.array([-1.0, 0.0]))))


def test_outflow_that_a_long_step_limits_is_not_counted_on():
    """With `bottom` a tank gives less below (step w s/A)^2: above a0^2 = 0.05^2 H it is (C3)."""
    proved = gouta2015()
    limited = {"plant": dataclasses.replace(proved.plant, bottom=True), **proved.ends(bottom=True)}
    share = W / float(proved.plant.area[2]) * 1.05
    share *= float(proved.plant.drain[2]) + sum(map(float, proved.plant.orifice[:2]))
    for factor, holds in EDGE:
        step = factor * 0.05 * math.sqrt(30.0) / share
        assert proved.holds(**limited, known={"substeps": 0.1 / step}) == holds


# --------------------------------------------------------------------------- the box


def test_a_lowered_limit_and_its_reach_cannot_be_raised():
    proved = Proved(chain(), bank(2))
    assert proved.holds(0) and proved.holds(1)
    limit, reach = proved.entry("limit", 1, 1.01), proved.entry("reach", 1, 1.01)
    assert "rim condition" in proved.reason(**limit, **reach)
    assert "may reach" in proved.reason(**limit)
    assert "may reach" in proved.reason(**proved.entry("reach", 1, 0.99))
    assert "rim condition" in proved.reason(1, held=(0,))
    assert "relies on tank 2" in proved.reason(0, held=(0,))


@pytest.mark.parametrize("field", ["area", "drain", "orifice", "pump_gain", "gravity"])
def test_every_coefficient_must_lie_between_least_and_most(field):
    proved = Proved(chain(), bank(2))
    ends = [np.array(getattr(p, field), float) for p in (proved.filter.least, proved.filter.most)]
    assert proved.holds(box={f"plant.{field}": tuple(ends)})
    for side, factor in ((0, 0.999), (1, 1.001)):
        wider = [v * (factor if k == side else 1.0) for k, v in enumerate(ends)]
        why = proved.reason(box={f"plant.{field}": tuple(wider)})
        assert why.startswith(f"not covered: plant.{field}") and "the filter counts on" in why
        if np.ndim(ends[0]):
            first = tuple(v.flat[0] for v in wider)
            assert not proved.holds(box={f"plant.{field}[0]": first})


def test_faults_are_covered_where_they_stay_in_the_box_or_lower_levels():
    proved = Proved(one_tank(), bank(), low=[2.0], start=[5.0])
    assert proved.holds() and proved.check()[0].low_holds
    at = lambda name, factor, extra=0.0: proved.check(
        known={"faults": faults(proved.plant, [(name, 1.0, 2.0, factor, extra)])}
    )[0]
    # the box has 5 % already: another 5 % leave it
    assert not at("drain[0]", 0.99).holds and not at("pump_gain[0]", 1.01).holds
    assert "fault of plant.drain[0]" in at("drain[0]", 0.5).reason
    assert not at("area[0]", 0.9).holds
    for gentle in (at("drain[0]", 1.0, 0.4), at("pump_gain[0]", 0.5)):  # a leak, a weak pump
        assert gentle.holds and not gentle.low_holds
    predicted = Proved(one_tank(), bank(delay=2.0), start=[5.0])
    leak = faults(predicted.plant, [("drain[0]", 1.0, 2.0, 1.0, 0.4)])
    assert "prediction with faults" in predicted.reason(known={"faults": leak})
    other = dataclasses.make_dataclass("Odd", [("windows", tuple)])(())
    assert "faults of class Odd" in proved.reason(known={"faults": other})


@component
class Siphon(TankNetwork):
    """A tank network of a class of its own."""


@component
class Valves(PumpBank):
    """Pumps with something more."""

    hammer: float = leaf("-", "something", default=lambda own: 0.0)


def test_what_is_not_on_the_list_is_not_covered():
    proved = Proved(one_tank(), bank())
    as_class = lambda kind, part: kind(
        **{f.name: getattr(part, f.name) for f in dataclasses.fields(part)}
    )
    for name, changes in {
        "plant of class Siphon": {"plant": as_class(Siphon, proved.plant)},
        "safety_filter.most of class Siphon": {"most": as_class(Siphon, proved.filter.most)},
        "actuator of class Valves": {"actuator": as_class(Valves, proved.actuator)},
        "uncertain disturbance.volume": {"box": {"disturbance.volume": (0.0, 1.0)}},
        "plant.drain is no number": {"plant": one_tank(drain=[math.nan])},
        "safety_filter.reach is no number": {"reach": [math.nan]},
        "uncertain plant.drain is no number": {"box": {"plant.drain": (math.nan, 1.0)}},
        "plant.knee differs": {"plant": one_tank(knee=0.02)},
        "sensor.filter": {"sensor": LevelSensor(noise=[0.0], filter=[1.0])},
    }.items():
        assert f"not covered: {name}" in proved.reason(**changes)
    assert proved.holds(box={"controller.Kc": (0.0, 1.0)})
    assert proved.holds(sensor=LevelSensor(noise=[0.0], filter=[0.0]))


@pytest.mark.parametrize("part", ["plant", "actuator", "sensor", "safety_filter"])
def test_a_field_that_the_checker_does_not_know_is_not_covered(part, monkeypatch):
    """Something that is added to a class later: here a field that is taken off the list."""
    proved = Proved(one_tank(), bank(lag=[0.1], delay=0.5))
    known = {"plant": "gravity", "actuator": "lag", "sensor": "noise", "safety_filter": "age"}
    monkeypatch.setitem(known_features.KNOWN, part, known_features.KNOWN[part] - {known[part]})
    assert f"not covered: {part}.{known[part]}" in proved.reason()
    monkeypatch.undo()
    unused = {"plant": "spills", "actuator": "dead_zone", "sensor": "offset"}
    if part in unused:
        monkeypatch.setitem(known_features.KNOWN, part, known_features.KNOWN[part] - {unused[part]})
        assert "not covered" not in proved.check()[0].reason


# --------------------------------------------------------------------------- rows of pumps


def test_the_rate_of_theorem_1_and_its_rim():
    proved = Proved(one_tank(), bank(), rate=2.0)
    assert proved.check()[0] == (0, True, "Theorem 1", LIMITS, False, "")
    assert "kappa T" in proved.reason(rate=[2.001])
    # 11.5 cm/s leave for certain at 30 cm: 0.95 x 0.3 sqrt(2 g) sqrt(30)
    leaves = 0.95 * 0.3 * W * math.sqrt(30.0)
    for share, holds in EDGE:
        entering = {"inflow": [share * leaves]}
        assert proved.holds(known={"inflow": (0.0, share * leaves)}, **entering) == holds
        stays = bank(low=[share * leaves / (8.0 * 1.05)])
        assert proved.holds(actuator=stays) == holds
    assert "may enter" in proved.reason(known={"inflow": (0.0, 1.0)})


def test_readings_must_lie_in_the_band():
    sensor = LevelSensor(noise=[0.02], offset=[-0.05], gain=[10.0], full_scale=5.0, bits=8)
    proved = Proved(one_tank(), bank(), sensor=sensor)
    assert proved.holds()
    least = 5 * 0.02 + 0.05 + 0.5 * 10.0 * 5.0 / 2**8
    assert proved.holds(band=[1.001 * least])
    assert "noise band" in proved.reason(band=[0.999 * least])
    for name, low, high in (("noise", 0.01, 0.1), ("offset", -0.2, 0.0), ("gain", 9.0, 30.0)):
        assert "noise band" in proved.reason(box={f"sensor.{name}": ([low], [high])})
    assert "sensor can read" in proved.reason(box={"sensor.gain": ([5.0], [10.0])})
    for share, holds in ((1.001, True), (0.999, False)):  # 30 cm are read as 5 V
        assert proved.holds(box={"sensor.gain": ([share * 6.0], [10.0])}) == holds
    # also that of a tank beside
    beside = Proved(chain(), bank(2), sensor=LevelSensor(noise=[0.02, 0.02]))
    assert beside.holds() and "noise band" in beside.reason(**beside.entry("band", 1, 0.5))


def test_inflow_pulses_need_their_volume():
    proved = Proved(one_tank(), bank(), volume=[40.0], start=[5.0])
    assert proved.check()[0].holds and proved.check()[0].starts == CASE
    assert "inflow pulses raise it by 2 cm" in proved.reason(spare=[0.0])
    assert "inflow pulses raise it by 2.002" in proved.reason(known={"volume": [40.04]})
    late = Proved(one_tank(drain=[0.1]), bank(delay=0.5), predict=False, start=[1.0], volume=[4.0])
    assert "inflow pulses with dead time" in late.reason()


def test_dead_zones_count_by_their_least_value():
    zone = bank(dead_zone=[3.0], dead_zone_kind="offset")
    proved = Proved(one_tank(), zone, offset=[2.7])
    assert proved.holds(box={"actuator.dead_zone": ([2.7], [3.3])})
    assert "may move liquid above 2.6" in proved.reason(box={"actuator.dead_zone": ([2.6], [3.3])})
    assert "may move liquid" in proved.reason(offset=[3.1])
    assert "may move liquid" in proved.reason(actuator=bank())
    pulsed = bank(dead_zone=[3.0], dead_zone_kind="pulse")
    assert "pulse" in Proved(one_tank(), zone, offset=[0.0]).reason(actuator=pulsed)


def test_pumps_that_cannot_stop_share_a_row_that_counts_with_them():
    plant = two_tanks(
        area=50.0, drain=[0.5, 0.3], feeds=[(0, None), (0, 1)], pump_gain=20.0, split=[1.0, 0.3],
        rim=[20.0, 60.0],
    )  # fmt: skip
    proved = Proved(plant, bank(2, low=[1.0, 0.5]), 0.1, start=[15.0, 5.0])
    assert proved.filter.running == (0, 1) and proved.holds()
    assert "lower limits above 0" in proved.reason(running=(0,))
    low = lambda least, most: {"box": {"actuator.low": (least, most)}}
    assert proved.holds(**low([0.9, 0.4], [1.0, 0.5]))  # none is above what the row counts with
    assert "uncertain lower limits above 0" in proved.reason(**low([1.0, 0.5], [1.0, 0.501]))
    leaves, most = 0.95 * 0.5 * W * math.sqrt(20.0), proved.filter.most
    second = float(most.pump_gain[1]) * float(most.split[1]) * 0.5
    for share, holds in EDGE:
        first = share * (leaves - second) / (20.0 * 1.05)
        assert proved.holds(actuator=bank(2, low=[first, 0.5])) == holds


def test_pipes_are_covered_without_dead_time_or_lag():
    plant = two_tanks(pipes=[(0, 1)], pipe=[0.2])
    proved = Proved(plant, bank(2), start=[1.0, 1.0])
    assert proved.holds(0) and proved.holds(1)
    late = Proved(plant, bank(2, delay=0.5), start=[1.0, 1.0])
    assert "a pipe with dead time" in late.reason()
    # an empty tank beside takes what it can: at unequal limits the rim condition fails
    uneven = proved.entry("limit", 1, 5.0) | proved.entry("reach", 1, 5.0)
    assert "rim" in proved.reason(**uneven)


# --------------------------------------------------------------------------- dead time and lag


@pytest.mark.parametrize("samples", [1, 3])
def test_dead_time_bounds_the_rate_from_both_sides(samples):
    """Theorem 3: n^n/(n + 1)^(n + 1)/T, and (N): c_min/sqrt(H)."""
    delayed = bank(delay=0.5 * samples)
    proved = Proved(one_tank(drain=[0.1]), delayed, predict=False, start=[1.0])
    assert proved.check()[0].reason == "Theorem 3"
    bound = samples**samples / (samples + 1) ** (samples + 1) / 0.5
    steep = 0.95 * 0.1 * W / 20.0 / math.sqrt(30.0)
    assert proved.holds(rate=[0.999 * bound]) and proved.holds(rate=[1.001 * steep])
    assert "above its bound" in proved.reason(rate=[1.001 * bound])
    assert "(N)" in proved.reason(rate=[0.999 * steep])
    assert "above its bound" in proved.reason(box={"actuator.delay": (0.0, 10.0)})


def test_inputs_under_way_must_obey_the_row_of_the_start():
    """(S): b_max u <= kappa (H - h) + c_min sqrt(h), of all levels from 0 to the start."""
    proved = Proved(one_tank(drain=[0.1]), bank(delay=0.5), predict=False, start=[29.5])
    kappa, c = float(proved.filter.rate[0]), 0.95 * 0.1 * W / 20.0
    allowed, b = kappa * 0.5 + c * math.sqrt(29.5), 8.0 * 1.05 / 20.0
    for share, holds in EDGE:
        assert proved.holds(actuator=bank(delay=0.5, initial=[share * allowed / b])) == holds
        # from anywhere below the limit: what leaves at the limit for certain
        before = bank(delay=0.5, initial=[share * c * math.sqrt(30.0) / b])
        assert proved.check(actuator=before)[0].starts == (LIMITS if holds else CASE)


def test_inputs_under_way_count_less_their_dead_zone():
    zone = {"delay": 0.5, "dead_zone": [2.0], "dead_zone_kind": "offset"}
    proved = Proved(one_tank(drain=[0.1]), bank(**zone), predict=False, start=[29.5], offset=[2.0])
    kappa, c = float(proved.filter.rate[0]), 0.95 * 0.1 * W / 20.0
    allowed, b = kappa * 0.5 + c * math.sqrt(29.5), 8.0 * 1.05 / 20.0
    for share, holds in EDGE:
        assert proved.holds(actuator=bank(**zone, initial=[2.0 + share * allowed / b])) == holds


def test_the_root_of_a_pipe_is_odd_and_that_of_the_difference():
    roots = [checker._pipe_root(z, 0.01) for z in (9.0, -9.0, 0.0, math.inf, -math.inf)]
    assert roots == pytest.approx([3.0, -3.0, 0.0, math.inf, -math.inf], rel=1e-5)


def test_below_the_laminar_threshold_the_root_of_a_level_is_a_parabola():
    """It meets the root at the threshold with its value and its slope, and begins at 0."""
    roots = [checker._root(h, 0.04) for h in (-1.0, 0.0, 0.02, 0.04, 0.25)]
    assert roots == pytest.approx([0.0, 0.0, 0.2 * 0.5 * (1.5 - 0.25), 0.2, 0.5], rel=1e-12)


def test_flows_between_the_same_tanks_add_up_at_either_end():
    table = {}
    for ends in ((1.0, 2.0), (10.0, 20.0)):
        checker._add(table, (1, 0), ends)
    assert table == {(1, 0): (11.0, 22.0)}


def test_full_pumps_fill_at_most_three_quarters_of_a_tank_within_its_lag():
    """(F): b u_high at most 3/4 sigma H, sigma the largest of kappa = r(sigma)."""
    lag = bank(lag=[0.7])
    proved = Proved(one_tank(drain=[0.05], area=[200.0]), lag, 0.1, start=[1.0])
    kappa = float(proved.filter.rate[0])
    rate = lambda sigma: sigma * (1.0 - 0.7 * sigma) * math.exp(-0.1 * sigma)
    sigma = brentq(lambda s: rate(s) - kappa, 0.68, 1.0 / 0.7)
    edge = 0.75 * sigma * 30.0 / (8.0 * 1.05 / 200.0)
    for share, holds in ((0.99999, True), (1.00001, False)):
        assert proved.holds(box={"actuator.high": ([0.0], [share * edge])}) == holds


def test_a_tank_is_far_below_what_it_may_reach_in_a_hold_and_by_what_enters_besides():
    rig = types.SimpleNamespace(
        pumped=lambda k, inputs: 2.0, rise=lambda k, level, others: 1.0, capped=None, hold=0.5,
        filter=types.SimpleNamespace(age=0.5), spare=[1.0], reach=[3.9],
    )  # fmt: skip
    assert checker._far(rig, 0)  # 1 s at 3 cm/s, and 1 cm
    rig.reach = [4.1]
    assert not checker._far(rig, 0)


@pytest.mark.parametrize("part", ["pipes", "lag", "zoned", "offset"])
def test_a_prediction_is_not_proved_with_one_of_what_it_does_not_count(part):
    parts = {"pipes": [[], []], "lag": [0.0, np.zeros(2)], "zoned": False, "offset": np.zeros(2)}
    first = lambda **more: next(
        checker._predicted(types.SimpleNamespace(**parts | more), 0, 0.0, None)
    )[0]
    assert first()
    some = {"pipes": [[0], []], "lag": [0.0, np.array([0.0, 1.0])], "zoned": True}
    assert not first(**{part: some.get(part, np.array([0.0, 1.0]))})


def largest_rate(tau, age):
    sigma = np.linspace(0.0, 1.0 / tau, 200001)
    return np.max(sigma * (1.0 - tau * sigma) * np.exp(-sigma * age))


def test_a_lag_bounds_the_rate_by_its_largest_value():
    """Theorem 4: kappa at most the largest of sigma (1 - tau sigma) exp(-sigma T)."""
    lag = bank(lag=[0.7])
    proved = Proved(one_tank(drain=[0.05], area=[200.0]), lag, 0.1, start=[1.0])
    assert proved.check()[0].reason == "Theorem 4"
    bound = largest_rate(0.7, 0.1)
    assert proved.holds(rate=[0.999 * bound])
    assert "above its bound" in proved.reason(rate=[1.001 * bound])
    kappa = float(proved.filter.rate[0])
    longest = brentq(lambda t: largest_rate(t, 0.1) - kappa, 0.7, 3.0)
    for factor, holds in ((0.99, True), (1.01, False)):
        assert proved.holds(box={"actuator.lag": ([0.1], [factor * longest])}) == holds
    # full pumps must not fill a tank within the lag
    strong = Proved(one_tank(drain=[0.05]), lag, 0.1, start=[1.0])
    assert "(F)" in strong.reason(box={"actuator.high": ([0.0], [60.0])})
    assert "above" in proved.reason(actuator=bank(lag=[0.7], initial=[2000.0]))
    slow = chain(area=[200.0, 200.0], drain=[0.1, 0.0], orifice=[0.05])
    below = Proved(slow, bank(2, lag=[0.7, 0.7]), 0.1, start=[1.0, 1.0])
    assert below.holds() and "rates of other tanks" in below.reason(age=0.0)


@pytest.mark.parametrize("delay", [0.0, 0.25])
def test_a_lag_and_a_dead_time_with_a_bottom_count_with_less_outflow(delay):
    """h_e = (step c_max)^2: (N) is c_min s(H) <= kappa (H - h_e); with a lag h_e <= H/4."""
    plant = one_tank(area=[200.0], drain=[0.4], rim=[8.0], pump_gain=[5.0], bottom=True)
    lag = {} if delay else {"lag": [0.2]}
    proved = Proved(plant, bank(delay=delay, **lag), 0.25, predict=False, start=[1.0])
    assert proved.holds()
    c_min, c_max = (share * 0.4 * W / 200.0 for share in (0.95, 1.05))
    at = lambda step, **changes: {"known": {"substeps": 0.25 / step}, **changes}
    step = math.sqrt(1.9) / c_max  # h_e = 1.9 cm
    needed = c_min * math.sqrt(8.0) / (8.0 - 1.9)
    assert proved.holds(**at(step, rate=[1.001 * needed]))
    assert "(N)" in proved.reason(**at(step, rate=[0.999 * needed]))
    for share, holds in EDGE:
        verdict = proved.check(**at(math.sqrt(2.0 * share) / c_max))[0]
        assert verdict.holds == (holds or not lag)
        assert ("limit below 4 x" in verdict.reason) != (verdict.holds)
    assert "where outflow is less" in proved.reason(**at(math.sqrt(8.01) / c_max))


def two_into_one(**changes):
    """Pump 1 into tank 1, pump 2 into both."""
    parts = {"area": 200.0, "feeds": [(0, None), (0, 1)], "split": [1.0, 0.5], "rim": [30.0, 60.0]}
    return two_tanks(**parts | changes)


def test_lags_that_differ_need_a_row_for_each_pump():
    """Each has the share of the row that it has of full pumps, also of what is under way."""
    same = Proved(two_into_one(drain=0.2), bank(2, lag=[0.7, 0.7]), 0.1, start=[1.0, 1.0])
    assert same.holds(0) and same.holds(1)
    for change in ({"actuator": bank(2, lag=[0.7, 0.1])}, {"box": {"actuator.lag": (0.6, 0.7)}}):
        assert "lags differ" in same.reason(**change) and same.holds(1, **change)
    lag = {"lag": [0.7, 0.1]}
    proved = Proved(two_into_one(drain=[0.1, 0.2]), bank(2, **lag), 0.1, start=[29.5, 1.0])
    assert proved.filter.divided == (0,) and proved.holds(0) and proved.holds(1)
    assert "lags differ" in proved.reason(divided=())
    most, kappa = proved.filter.most, float(proved.filter.rate[0])
    gains = [8.0 * 1.05 / 200.0, float(most.pump_gain[1]) * float(most.split[1]) / 200.0]
    allowed = kappa * 0.5 + 0.95 * 0.1 * W / 200.0 * math.sqrt(29.5)
    edge = allowed * 12.0 / sum(b * 12.0 for b in gains)  # b u = b 12/(sum b 12) allowed
    for share, holds in EDGE:
        assert proved.holds(actuator=bank(2, **lag, initial=[0.0, share * edge])) == holds


@pytest.mark.parametrize(
    ("words", "changes"),
    [
        ("kappa T", {"rate": [2.001]}),
        ("dead time", {"predicted": 3}),
        ("dead time", {"box": {"actuator.delay": (1.0, 2.0)}}),
        ("dead zone", {"actuator": bank(delay=2.0, dead_zone=[1.0])}),
        ("dead zone", {"actuator": bank(delay=2.0, lag=[0.1])}),
        ("inflow pulses", {"known": {"draws": True}}),
        ("inflow pulses", {"spare": [0.1]}),
        ("low limits", {"bottom": [0.1]}),
        ("may be drawn", {"known": {"inflow": (-1.0, 0.0)}}),
        ("inputs under way", {"actuator": bank(delay=2.0, initial=[12.0])}),
        ("counts on", {"box": {"plant.drain": ([0.28], [0.33])}}),
        ("limits or initial", {"box": {"actuator.low": ([0.0], [0.1])}}),
        ("limits or initial", {"box": {"actuator.high": ([11.0], [12.0])}}),
        ("limits or initial", {"box": {"actuator.initial": ([0.0], [1.0])}}),
    ],
)
def test_prediction_is_proved_for_what_it_predicts_only(words, changes):
    proved = Proved(one_tank(), bank(delay=2.0), start=[27.0])
    assert proved.check()[0].reason == "Theorem 5" and proved.check()[0].starts == LIMITS
    assert words in proved.reason(**changes)


def test_neighbours_count_by_readings_as_old_as_the_dead_time():
    proved = Proved(chain(), bank(2, delay=2.0), start=[1.0, 1.0])
    assert proved.holds(0) and proved.holds(1)
    assert "dead time 2 s, the filter counts on 1.9 s" in proved.reason(age=1.9)
    above = bank(2, delay=2.0, initial=[0.0, 13.0])
    assert "upper limit" in proved.reason(actuator=above)


# --------------------------------------------------------------------------- other tanks


def test_full_pumps_that_cannot_fill_a_tank_need_no_row():
    proved = Proved(one_tank(drain=[1.5]), bank(), start=[1.0])
    assert proved.filter.held == () and proved.check()[0].reason == "full pumps stay below"
    limit = float(proved.filter.limit[0])
    assert limit == pytest.approx((8.0 * 1.05 * 12.0 / (0.95 * 1.5 * W)) ** 2, rel=1e-6)
    assert "rim" in proved.reason(limit=[0.999 * limit])
    assert "rim" in proved.reason(box={"actuator.high": ([12.0], [12.01])})
    assert proved.check()[0].starts == LIMITS
    assert "start at" in proved.reason(known={"start": [1.01 * limit]})
    assert "rim" in proved.reason(actuator=bank(delay=5.0, initial=[13.0]))
    # from anywhere below a higher limit it falls; a tank below counts on what the filter has
    assert proved.check(known={"limits": [25.0]})[0].starts == LIMITS
    below = Proved(chain(drain=[0.3, 1.5], orifice=[0.1]), bank(2), start=[1.0, 1.0])
    verdicts = below.check(known={"limits": [30.0, 30.0]})
    assert below.filter.held == (0,) and all(v.holds for v in verdicts)
    assert [v.starts for v in verdicts] == [CASE, LIMITS]


def test_a_tank_that_is_not_proved_counts_with_a_reach_that_is_checked():
    """A tank above starts beyond its limit; the one below is proved where that cannot fill it."""
    plant = chain(orifice=[0.1], drain=[0.2, 0.1])
    proved = Proved(plant, bank(2), start=[1.0, 35.0], limit=[30.0, 20.0])
    reach = lambda top: {"reach": [30.0, top], "limit": [30.0, 20.0], "held": (0, 1)}
    assert "start at 35 cm" in proved.reason(1, **reach(400.0))
    rests = lambda volts: (8.0 * volts * 1.05 / (0.95 * 0.2 * W)) ** 2
    # such a level fills the tank below
    assert 1.05 * 0.1 * math.sqrt(rests(12.0)) / (0.95 * 0.2) > math.sqrt(30.0)
    assert "relies on tank 2" in proved.reason(**reach(1.001 * rests(12.0)))
    weak = {"actuator": bank(2, high=[12.0, 3.0])}
    assert rests(3.0) < 35.0
    assert proved.holds(**weak, **reach(35.0))
    assert "relies on tank 2" in proved.reason(**weak, **reach(34.9))
    stronger = {"actuator": bank(2, high=[12.0, 7.0])}
    assert "relies on tank 2" in proved.reason(**stronger, **reach(35.0))


def spilling(**changes):
    """Tank 1 spills half of its overflow into tank 2."""
    parts = {"drain": [0.1, 0.3], "pump_gain": [4.0, 8.0], "rim": [20.0, 40.0]}
    return two_tanks(**parts | {"spills": [(0, 1)], "caught": [0.5], "overflow": True} | changes)


OVER = 4.0 * 1.05 * 12.0 - 0.95 * 0.1 * W * math.sqrt(20.0)
"""What full pumps spill over the rim of tank 1 [cm^3/s]."""


def test_overflow_is_an_inflow_of_the_tank_below():
    proved = Proved(spilling(), bank(2), limit=[20.0, 30.0], start=[1.0, 1.0])
    assert proved.holds(0) and proved.holds(1)
    higher = proved.entry("limit", 0, 1.1) | proved.entry("reach", 0, 1.1)
    assert "may enter, the filter counts on 0" in proved.reason(1, **higher)
    for share, holds in ((0.999, False), (1.001, True)):
        assert proved.holds(1, **higher, inflow=[0.0, share * 0.5 * OVER]) == holds
    counted = {"inflow": [0.0, 0.6 * OVER]}
    assert "at once" in proved.reason(1, known={"start": [21.0, 1.0]}, **higher, **counted)
    ring = {"spills": ((0, 1), (1, 0)), "caught": np.array([0.5, 0.5])}
    both = {"limit": [22.0, 44.0], "reach": [22.0, 44.0], **counted, **proved.ends(**ring)}
    assert "a ring" in proved.reason(1, plant=dataclasses.replace(proved.plant, **ring), **both)


def test_a_tank_that_is_not_proved_may_fill_to_its_rim_and_overflow():
    """Tank 1 starts above its limit of 15 cm: only its rim bounds it, and what it spills counts."""
    proved = Proved(spilling(), bank(2), limit=[15.0, 30.0], start=[16.0, 1.0])
    above = lambda reach: {"limit": [15.0, 30.0], "reach": [reach, 30.0], "held": (0, 1)}
    for share, holds in ((0.999, False), (1.001, True)):
        counted = {"inflow": [0.0, share * 0.5 * OVER]}
        verdicts = proved.check(**above(20.0), **counted)
        assert [v.holds for v in verdicts] == [False, holds]
        # a reach below the rim bounds nothing, so what tank 1 spills is not known to be counted
        assert not proved.holds(0, **above(19.9), **counted)
        dry = dataclasses.replace(proved.plant, overflow=False)
        ends = proved.ends(overflow=False)
        assert proved.holds(1, **above(20.0), plant=dry, **ends, inflow=np.zeros(2))
    higher = {"plant.rim[0]": (20.0, 20.5)}  # of the highest rim
    assert not proved.holds(0, **above(20.0), box=higher)
    joined = Proved(
        spilling(links=[(0, 1)], orifice=[0.1]), bank(2), limit=[15.0, 30.0], start=[16.0, 1.0]
    )
    leaving = 4.0 * 1.05 * 12.0 - 0.95 * 0.2 * W * math.sqrt(20.0)
    counted = {"inflow": [0.0, 0.51 * leaving]}
    assert joined.holds(1, **above(20.0), **counted)
    assert not joined.holds(1, **above(19.9), **counted)  # without a bound, tank 2 has none
    assert not joined.holds(1, **above(20.0), **counted, box=higher)


# --------------------------------------------------------------------------- low limits


def test_low_limits_are_checked_by_their_own_conditions():
    proved = Proved(one_tank(), bank(), low=[2.0], start=[5.0])
    verdict = lambda **changes: proved.check(**changes)[0]
    assert verdict().low_holds and verdict().low_reason == "Low limits"
    least = 1.05 * 0.3 * W * math.sqrt(2.0) / (0.95 * 8.0)
    for share, holds in ((1.001, True), (0.999, False)):
        assert verdict(actuator=bank(high=[share * least])).low_holds == holds
    for words, changes in {
        "start at 1": {"known": {"start": [1.0]}},
        "draw liquid": {"known": {"draws": True}},
        "may be drawn": {"known": {"inflow": (-5.0, 0.0)}},
        "relies on": {"bottom": [2.5]},
        "no row": {"kept": ()},
        "dead time": {"actuator": bank(delay=0.5), "rate": [0.4], "age": 0.5},
        "dead zone": {"actuator": bank(dead_zone=[1.0])},
        "no upper bound": {"known": {"start": [31.0]}},
        "floor above cap": {"limit": [2.05], "known": {"start": [2.0]}},
    }.items():
        assert not verdict(**changes).low_holds
        assert words in verdict(**changes).low_reason, words
    assert not Proved(one_tank(), bank(), start=[5.0]).check()[0].low_holds


def test_several_pumps_keep_a_low_limit_with_what_each_brings_for_certain():
    """Together b_min u_high; cap and least input are compared by the weakest share b_min/b_max."""
    pumps = {"feeds": [(0, None)] * 2, "pump_gain": [5.0, 3.0]}
    proved = Proved(one_tank(**pumps), bank(2), low=[2.0], start=[5.0])
    verdict = lambda **changes: proved.check(**changes)[0]
    assert verdict().low_holds
    falling, second = 1.05 * 0.3 * W * math.sqrt(2.0), 0.95 * 3.0 * 2.0
    for share, holds in ((1.001, True), (0.999, False)):
        first = share * (falling - second) / (0.95 * 5.0)
        assert verdict(actuator=bank(2, high=[first, 2.0])).low_holds == holds
    back = verdict(actuator=bank(2, low=[0.0, -1.0]))
    assert not back.low_holds and "backwards" in back.low_reason
    # at readings from L - band: kappa 2 band is asked, kappa (H - L) share allowed (no outlets)
    plant, least, most = (
        one_tank(**pumps | {"pump_gain": gain}, drain=[0.0])
        for gain in ([50.0, 50.0], [50.0, 40.0], [50.0, 60.0])
    )
    widths = {"plant.pump_gain": ([50.0, 40.0], [50.0, 60.0]), "plant.drain": ([0.0], [0.0])}
    widths |= {"plant.split": ([1.0, 1.0], [1.0, 1.0])}
    for share, holds in ((0.99, True), (1.01, False)):
        low = 30.0 - 1.0 * 60.0 / 40.0 / share
        low_only = {"low": [low], "bottom": [low], "band": [0.5], "rate": [1.0]}
        found = verdict(plant=plant, least=least, most=most, box=widths, **low_only,
                        known={"start": [low]}, limit=[30.0])  # fmt: skip
        assert found.low_holds == holds and ("floor above cap" in found.low_reason) != holds


def test_a_cap_of_another_tank_may_stop_a_pump_that_keeps_a_low_limit():
    """A pump that feeds two tanks; and a second-order row below."""
    plant = two_tanks(feeds=[(0, 1)], pump_gain=[16.0], split=[0.5], drain=[0.3, 0.1])
    proved = Proved(plant, bank(1), low=[2.0, 0.0], start=[5.0, 5.0], limit=[30.0, 20.0])
    tank = lambda **changes: proved.check(**changes)[0]
    assert "the cap for tank 2 may stop" in tank().low_reason
    assert tank(held=(0,), limit=[30.0, 500.0], reach=[30.0, 500.0]).low_holds
    # one pump each, but several tanks: no cap of another tank stops it
    assert Proved(two_tanks(), bank(2), low=[2.0, 0.0], start=[5.0, 5.0]).check()[0].low_holds
    second = gouta2015()
    low = {"low": [0.0, 0.0, 1.0, 0.0], "bottom": [0.0, 0.0, 1.0, 0.0], "kept": (2,)}
    assert second.check(**low)[2].low_reason.startswith("the cap for tank")
    assert second.holds(0, **low)


@pytest.mark.parametrize(("drain", "holds"), [(0.0, False), (0.1, True)])
def test_a_cap_of_another_tank_stops_no_pump_where_enough_leaves_that_tank_at_its_limit(
    drain, holds
):
    """At 2 cm 0.07 cm/s leave tank 1; 0.94 leave tank 2 at 20 cm."""
    plant = two_tanks(feeds=[(0, 1)], pump_gain=[16.0], split=[0.5], drain=[0.02, drain])
    proved = Proved(plant, bank(1), low=[2.0, 0.0], start=[5.0, 5.0], limit=[30.0, 20.0])
    assert proved.check()[0].low_holds == holds


def test_uncertain_levels_at_the_start_count_with_both_ends():
    proved = Proved(one_tank(), bank(), low=[2.0], start=[5.0])
    at = lambda low, high: proved.check(box={"x0": ([low], [high])})[0]
    assert at(2.1, 29.9).holds and at(2.1, 29.9).low_holds
    assert not at(2.1, 30.1).holds and not at(1.9, 29.9).low_holds


def test_a_sensor_that_shows_percent_loses_no_proof():
    """What a reading is shown in is no property of the loop."""
    text = """
    tank = [{ area = 50.0, rim = 40.0, drain = 0.5, level = 5.0 }]
    pump = [{ gain = 20.0, to = 1, high = 10.0, initial = 2.5 }]
    controller = { kind = "pi", Kc = "1 V/cm", Ti = 50.0 }
    reference = { initial = ["5 cm"], changes = [[1.0, 1, "38 cm"]], ramp = 0.0 }
    sensor = [{ tank = 1, span = [0.0, 40.0], unit = "%" }]
    values = { "clock.dt" = 0.5, "clock.duration" = 200.0 }
    """
    case = rig.loads(text).with_safety_filter()
    assert case.loop.sensor.display == ("%",)
    assert [row.certified for row in certificates_of(case)] == [True]


def test_nothing_is_proved_below_an_inflow_that_is_uncertain():
    """The level of tank 1, on which the flow into tank 2 depends, has no bound then."""
    case = rig.loads("""
tank = [
    { area = 100.0, rim = 40.0, level = 10.0, inflow = 20.0 },
    { area = 100.0, rim = 40.0, level = 10.0, drain = 1.2 },
]
orifice = [{ from = 1, to = 2, area = 1.2 }]
pump = [{ gain = 30.0, to = 1, high = 10.0, initial = 5.0 }]
plant = { outputs = [2] }
controller = { kind = "pi", Kc = 1.0, Ti = 60.0 }
reference = { initial = [10.0] }
safety_filter = { limit = [18.0, 18.0] }
values = { "clock.dt" = 1.0 }
[covariance]
names = ["plant.drain[1]", "disturbance.level[0]"]
matrix = [[0.0016, 0.0], [0.0, 9.0]]
""")
    rows = certificates_of(case)
    assert [row.certified for row in rows] == [False, False]
    assert all("uncertain disturbance.level[0]" in row.reason for row in rows)

"""The bank of fault models: its filters, and the faults that it names."""

import fault_bank as audit
import jax
import numpy as np
import pytest
from helpers import estimates_along
from scipy import stats

import jaxtank
from jaxtank import rig
from jaxtank.core.clock import Clock
from jaxtank.observers import ExtendedKalman, FaultBank
from jaxtank.observers.fault_bank import LEAST
from jaxtank.plants import network

RIG = """
tank = [{name = "LT1", area = 50.0, rim = 40.0, level = 12.0},
        {name = "LT2", area = 40.0, rim = 40.0, level = 12.0, drain = 0.5}]
orifice = [{from = 1, to = 2, area = 0.5}]
pump = [{name = "P1", to = 1, gain = 8.0, high = 20.0, initial = 9.6}]
plant = {outputs = [2]}
controller = {kind = "pi", Kc = 0.5, Ti = 60.0}
reference = {initial = [12.0], changes = [[20.0, 1, 14.0]]}
observer = {kind = "fault-bank", process = 1e-6, measurement = 0.0025, spread = 0.0025}
fault = [{of = "LT1.drain", start = 100.0, end = 200.0, extra = 0.08}]
values = {"sensor.noise" = 0.05, "clock.dt" = 1.0, "clock.duration" = 300.0}
"""
VALUES = {"process": [1e-4] * 2, "measurement": [0.01] * 2, "spread": [0.02] * 2}


@pytest.fixture(scope="module")
def case():
    return rig.loads(RIG)


def test_without_a_fault_the_bank_is_the_extended_filter_and_so_is_its_derivative():
    rng = np.random.default_rng(0)
    tank = network(area=[50.0], drain=[0.5], pump_gain=[8.0], feeds=[(0, None)], rim=[40.0])
    ys, along = 12.0 + 0.1 * rng.standard_normal((15, 1)), rng.standard_normal((15, 1))
    us = np.full((15, 1), 0.5 * np.sqrt(2 * 981.0 * 12.0) / 8.0)  # which holds 12 cm
    values = {name: value[:1] for name, value in VALUES.items()} | {"model": tank, "measured": (0,)}

    def of(observer):
        filtered = lambda ys: estimates_along(observer, np.full(1, 12.0), ys, us, 1.0).x
        return jax.jit(lambda y, v: jax.jvp(filtered, (y,), (v,)))(ys, along)

    bank = FaultBank(**values, prior=1e-14)
    assert len(bank.mode_names(tank)) > 2
    for ours, known in zip(of(bank), of(ExtendedKalman(**values, integrator="midpoint"))):
        np.testing.assert_allclose(ours, known, atol=1e-9)


def test_a_sensor_without_noise_that_may_freeze_is_noted(case):
    still = rig.set_values(case, {"sensor.noise": [0.05, 0.0]})
    noted = [[s for s in rig.case_warnings(c) if "frozen" in s] for c in (case, still)]
    assert not noted[0] and "sensors without noise, of LT2" in noted[1][0]


def test_a_leak_of_a_rig_file_is_named_with_its_time_and_size(case):
    run = jaxtank.simulate(case, key=jax.random.key(2))
    (leak,) = run.diagnosis
    assert leak["fault"] == "leak of LT1" and leak["unit"] == "cm^2"
    assert 100.0 <= leak["from_s"] < 120.0 and 200.0 <= leak["to_s"] < 220.0
    assert abs(leak["size"] - 0.08) < 0.02
    np.testing.assert_allclose(run.modes[:, : len(run.mode_names)].sum(axis=1), 1.0)
    assert type(rig.loads(rig.dump(case)).loop.observer) is FaultBank


OUTLET = """
tank = [{ name = "T", area = 100.0, rim = 40.0, level = 20.0, noise = 0.05, drain = 0.0 }]
pump = [{ name = "P", gain = 20.0, to = 1, high = 10.0, initial = PUMP }]
controller = { kind = "open-loop" }
inputs = { initial = [PUMP, 0.0] }
reference = { initial = [20.0] }
plant = { bottom = true }
observer = { kind = "fault-bank", process = 1e-5, measurement = 0.0025, spread = 0.0025 }
fault = [{ of = "FAULT", start = 100.0, end = 300.0, SIZE }]
values = { "clock.dt" = 1.0, "clock.duration" = 300.0 }
"""
VALVE = 'valve = [{ name = "V", from = 1, area = 0.3 }]'


@pytest.mark.parametrize(
    ("outlet", "pump", "fault", "size", "named"),
    [
        (VALVE, 0.0, "T.drain", "extra = 0.05", ("leak of T", 0.05)),
        ("", 0.0, "T.drain", "extra = 0.05", ("leak of T", 0.05)),
        ("drain_linear = 1e5", 0.0, "T.drain", "extra = 0.05", ("leak of T", 0.05)),
        ("drain_linear = 0.25", 4.0, "T.drain_linear", "factor = 2.0", ("plug of the outlet", 0.5)),
    ],
    ids=["valve", "none", "tiny", "linear"],
)
def test_faults_of_tanks_without_a_drain_that_is_an_orifice(outlet, pump, fault, size, named):
    text = OUTLET.replace("PUMP", str(pump)).replace("FAULT", fault).replace("SIZE", size)
    if outlet.startswith("valve"):
        text = f"{outlet}\n{text}"
    else:
        text = text.replace("drain = 0.0", outlet or "drain = 0.0").replace(", 0.0]", "]")
    run = jaxtank.simulate(rig.loads(text), key=jax.random.key(1))
    [last] = [row for row in run.diagnosis if row["to_s"] == 300.0]
    assert last["fault"].startswith(named[0]) and 100.0 <= last["from_s"] < 130.0
    assert last["size"] == pytest.approx(named[1], rel=0.1)


@pytest.mark.slow
def test_each_fault_is_named_and_a_clean_run_names_none(case):
    clock = Clock(dt=1.0, duration=500.0)
    names = [name for name, _ in case.loop.observer.mode_names(case.loop.plant)]
    # the same to the levels while input and level are at rest
    alike = {names.index("loss of P1"): names.index("leak of LT1")}
    values, which, entries = audit.drawn(case.loop, clock, 9, np.random.default_rng(3))
    clean = {
        name: np.append(v, 0.0 * v[:1] + (name == "factor"), axis=0) for name, v in values.items()
    }
    modes, _ = audit.runs(case.loop, clock, clean, entries, np.arange(9 + 1))
    best = modes[:, :, : len(names)].argmax(axis=2)
    ends = np.ceil(np.minimum(values["end"], values["start"] + 200.0)).astype(int) - 1
    answers = best[np.arange(9), ends]
    assert [alike.get(k, k) for k in answers] == [alike.get(k, k) for k in which]
    assert not best[-1].any()


def bank_of_two():
    plant = network(
        area=[50.0, 40.0], drain=[0.5, 0.3], pump_gain=[8.0], feeds=[(0, None)], rim=[40.0, 40.0]
    )
    return FaultBank(**VALUES, model=plant, measured=(0, 1)), plant


def test_a_size_counts_by_the_probability_that_it_is_one_of_its_fault():
    bank, _ = bank_of_two()
    state = bank.init((12.0, 12.0))
    size, deviation = 0.4, 0.2
    z = state.z.at[:, -1].set(size)
    P = state.P.at[:, -1, -1].set(deviation**2)
    totals = bank._totals(state._replace(z=z, P=P, score=0.0 * state.score))
    for mode, total in zip(bank.modes, totals):
        if mode.field == "drain":
            least = LEAST * bank.share
            share = stats.norm.cdf((mode.sign * size - least) / deviation)
            assert abs(np.exp(total) * stats.norm.cdf(-LEAST) - share) < 0.02


def test_a_filter_that_has_fallen_behind_begins_at_the_best_one():
    bank, _ = bank_of_two()
    state = bank.init((12.0, 12.0))
    block = np.array([[0.5, 0.2], [0.2, 0.3]])
    P = state.P.at[0, :2, :2].set(block)
    behind = state._replace(
        P=P,
        z=state.z.at[0, :2].set([11.0, 13.0]),
        score=-1e6 * np.sign(np.arange(len(bank.modes))) + 0.0 * state.score,
    )
    again = bank._restarted(behind)
    for k in range(len(bank.modes)):
        np.testing.assert_allclose(again.P[k, :2, :2], block, rtol=1e-12)
        np.testing.assert_allclose(again.z[k], [11.0, 13.0, 0.0], rtol=1e-12)

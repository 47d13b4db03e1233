"""gouta2022: notes S7.1 to S7.3, the structure of CHADPC, and gradients of every case."""

import dataclasses
import functools

import jax
import numpy as np
import pytest
from helpers import in_metres, sampled

import jaxtank
from jaxtank import rig
from jaxtank.analysis.linear_model import linearise
from jaxtank.analysis.steady_state import equilibrium
from jaxtank.controllers.pid import oustaloup
from jaxtank.core.clock import Clock
from jaxtank.core.errors import EquilibriumError, InputError
from jaxtank.presets import gouta2022 as loops, gouta2022 as paper

CASES = paper.preset().cases
NO_DEAD_ZONE = {"actuator.dead_zone": 0.0}
PRINTED = {
    f"{owner}.pump_gain": 3.4717 for owner in ("plant", "controller.model", "observer.model")
}
STEADY = {"controller.Tp": 1.7, "observer.l": 0.1, "actuator.delay": 0.2}


@functools.cache
def known(name, values, clock):
    """A run of a case as it stands, made once."""
    return run(name, dict(values), lambda loop: loop, **dict(clock))


def run(name, values=None, loop=None, **clock):
    if loop is None:
        return known(name, tuple((values or {}).items()), tuple(clock.items()))
    case = rig.set_values(CASES[name], values or {})
    found = jaxtank.simulate(
        loop(case.loop), dataclasses.replace(case.clock, **clock), key=jax.random.key(1)
    )
    return jax.tree.map(np.asarray, found)


def constant_inflow(loop):
    """The mean d^ of the paper as a steady loss of both tanks, clipped at empty."""
    from jaxtank.signals.base import Constant, Sum

    loss = Constant(level=225.0 * np.array([-0.4249, -0.6673]))
    plant = dataclasses.replace(loop.plant, bottom=True)
    return dataclasses.replace(
        loop, plant=plant, disturbance=Sum(first=loop.disturbance, second=loss)
    )


# Notes S7.1: RMS u, RMS e, ts, tr, mean d^. Tolerances as stated there: e 1e-3 cm, u 0.01 V, times
# 0.03 s.
ROWS = {
    "V0 E": ("enmpc", {**PRINTED, **NO_DEAD_ZONE}, None, (11.93315, 12.0), (9.280399, 8.546027),
    None, None, (-0.0001, 0.0001)),
    "d=0 E": ("enmpc", NO_DEAD_ZONE, None, (4.00985, 3.55466), (0.254478, 0.456462), (2.52, 7.45),
    (1.75, 2.56), (0, 0)),
    "d=0 S": ("chadpc", NO_DEAD_ZONE, None, (4.00986, 3.55467), (0.254422, 0.456451), (2.52, 7.45),
    (1.74, 2.56), (0, 0)),
    "const d E": (
        "enmpc", NO_DEAD_ZONE, constant_inflow, (6.53792, 7.53306), (0.347460, 0.678875),
        (5.24, 16.85), (1.20, 1.34), (-0.4249, -0.6673),
    ),
    "const d S": (
        "chadpc", NO_DEAD_ZONE, constant_inflow, (6.53341, 7.55319), (0.345576, 0.676501),
        (5.24, 16.85), (1.21, 1.37), (-0.4249, -0.6673),
    ),
    "DZ E": ("enmpc", {}, None, (6.51890, 7.52039), (0.278456, 0.652434), (3.99, 15.63),
    (1.71, 2.48), (-0.42491, -0.66730)),
    "DZ S": ("chadpc", {}, None, (6.51438, 7.54043), (0.276234, 0.650127), (3.99, 15.63),
    (1.74, 2.56), (-0.42491, -0.66730)),
    "DZ A": (
        "chadpc", {"controller.compensation": "double"}, None, (6.510, 7.560), (0.2789, 0.6529),
        (3.99, 15.62), (1.78, 2.64), (-0.425, -0.667),
    ),
    "DZ B": (
        "chadpc",
        {"controller.compensation": "double", "observer.before_compensation": True},
        None, (6.514, 7.540), (0.2762, 0.6501), (3.99, 15.63), (1.74, 2.56), (-0.212, -0.334),
    ),
    "DZ delay": ("chadpc", STEADY, None, (6.50984, 7.54083), (0.293391, 0.667892), (5.56, 16.01),
    (2.11, 2.76), (-0.4248, -0.6670)),
}  # fmt: skip


@pytest.mark.extended_for("V0 E", "d=0 S")
@pytest.mark.slow_for("d=0 E", "const d E", "const d S", "DZ A", "DZ B", "DZ delay")
@pytest.mark.parametrize("name", ROWS)
def test_acceptance_table(name):
    case, values, change, u, e, ts, tr, d = ROWS[name]
    found = paper.figures(run(case, values, change))
    np.testing.assert_allclose(found["voltage"], u, atol=0.01)
    np.testing.assert_allclose(found["error"], e, atol=1e-3)
    np.testing.assert_allclose(found["d"], d, atol=1e-3)
    if ts:
        np.testing.assert_allclose(found["settling"], ts, atol=0.03)
        np.testing.assert_allclose(found["recovery"], tr, atol=0.03)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "u", "e"),
    [("enmpc", (7.01, 7.72), (0.298, 0.671)), ("chadpc", (7.21, 7.54), (0.309, 0.673))],
)
def test_limit_cycles_of_a_short_delay(name, u, e):
    """Bounded, within the 2 % of notes S7.2."""
    found = paper.figures(run(name, {"actuator.delay": 0.2}))
    np.testing.assert_allclose(found["voltage"], u, rtol=0.02)
    np.testing.assert_allclose(found["error"], e, rtol=0.02)


def test_spot_levels():
    s = run("chadpc")
    for t, h in (
        (5, (1.35152, 4.46854)),
        (12, (5.06744, 7.62911)),
        (501, (10.00154, 11.38305)),
        (701, (14.52322, 10.0)),
    ):
        np.testing.assert_allclose(s.x[100 * t], h, atol=5e-3)
    ideal = run("chadpc", NO_DEAD_ZONE)
    np.testing.assert_allclose(ideal.x[500], (1.66169, 7.17737), atol=5e-3)
    np.testing.assert_allclose(ideal.x[50100], (10.00154, 11.38305), atol=5e-3)


@pytest.mark.slow_for("values0-offset0", "values2-offset2", "values3-offset3")
@pytest.mark.parametrize(
    ("values", "offset"),
    [
        ({"controller.compensation": "none"}, (-0.0368, -0.0578)),
        ({}, (0, 0)),
        ({"controller.compensation": "double"}, (0.0368, 0.0578)),
        ({"observer.before_compensation": True}, (-0.0184, -0.0289)),
    ],
)
def test_steady_offsets_of_the_four_compensations(values, offset):
    """E: d/k; S: 0; A: -d/k; C: d/(2k) (notes S4.3)."""
    r = run("chadpc", values)
    np.testing.assert_allclose(r.e[paper.quiet(r.t)].mean(axis=0), offset, atol=2e-4)


@pytest.mark.slow_for("values1-offset1", "values2-offset2")
@pytest.mark.parametrize(
    ("values", "offset"),
    [
        ({"plant.pump_gain": 0.8 * 34.717}, (0.0120, 0.0095)),
        ({"plant.drain": 1.2 * 0.7854}, (0.0087, 0.0085)),
        ({"plant.pipe": 1.2 * 0.9143}, (0.0009, 0.0009)),
        ({"plant.drain": 0.62 * 0.7854, "plant.pipe": 0.62 * 0.9143}, (0.0182, 0.0145)),
    ],
)
def test_offsets_of_a_plant_that_is_not_the_model(values, offset):
    """|mean e| of E to the digits printed, and none of S (notes S7.1)."""
    e, s = (run(name, {**NO_DEAD_ZONE, **values}) for name in ("enmpc", "chadpc"))
    np.testing.assert_allclose(np.abs(e.e[paper.quiet(e.t)].mean(axis=0)), offset, atol=6e-5)
    np.testing.assert_allclose(s.e[paper.quiet(s.t)].mean(axis=0), 0.0, atol=1e-5)


@pytest.mark.slow
def test_steady_voltages():
    """Notes S2.2: and (14, 8) cm has no steady state."""
    for h, u in (
        ((8, 10), (1.185, 4.819)),
        ((10, 10), (3.169, 3.169)),
        ((12, 10), (5.121, 1.519)),
        ((14, 14), (3.749, 3.749)),
    ):
        np.testing.assert_allclose(equilibrium(loops.rig(), h)[1], u, atol=5e-4)
        np.testing.assert_allclose(
            equilibrium(loops.rig(loops.PRINTED_GAIN), h)[1], 10 * np.array(u), atol=5e-3
        )
    with pytest.raises(EquilibriumError, match="pump 2"):
        equilibrium(loops.rig(), (14.0, 8.0))
    k1, k12, k2 = 0.154617227, 0.179993036, 0.154297778
    A, B, _ = linearise(loops.rig(), (11.0, 10.0), (0.0, 0.0))
    np.testing.assert_allclose(A, [[-0.1133, 0.09], [0.09, -0.1144]], atol=6e-5)
    np.testing.assert_allclose(np.diag(B), k2, rtol=1e-8)
    a, b = k1 / 2 / np.sqrt([11.0, 10.0]), k12 / 2
    # the pipe's root is smooth: 0.75 (knee/x)^2
    np.testing.assert_allclose(A, [[-a[0] - b, b], [b, -a[1] - b]], rtol=1e-4)


def test_the_reference_is_that_of_the_text():
    clock = Clock(dt=0.01, duration=900.0)
    r, dr, _ = (np.array(v) for v in sampled(loops.benchmark(), clock))
    assert r[0].max() == pytest.approx(14.0) and r[0][100 * 60 :].min() == pytest.approx(8.0)
    np.testing.assert_allclose((r[0][50000], r[0][70000]), (10.0729, 13.4271), atol=1e-4)
    np.testing.assert_allclose(np.abs(dr[0]).max(), 0.0754, atol=1e-4)
    assert r[0][999] == 0 and r[0][1000] == 8 and (r[1] == 10).all()
    np.testing.assert_allclose(np.diff(r[0])[1000:] / 0.01, dr[0][1000:-1], atol=2e-4)


def test_an_inflow_pulse_arrives_whole_and_lifts_the_tank_by_what_the_paper_reports():
    r = run("chadpc")
    assert 2.0 < r.d_hat[(r.t > 499) & (r.t < 530), 1].max() < 2.04  # "about 2 cm/s"
    for dt in (0.01, 0.1, 0.7):
        clock = Clock(dt=dt, duration=900.0)
        flow = np.array(sampled(CASES["chadpc"].loop.disturbance, clock)[0])
        np.testing.assert_allclose(flow.sum(axis=1) * dt, 500.0, rtol=1e-9)


@pytest.mark.slow
def test_trapezoid_with_a_plateau_that_has_no_steady_state():
    """Tank 2 stands at 14 c12^2/(c1^2 + c12^2) = 8.0556 cm when pump 2 stays off (notes S3.3)."""
    r = run("chadpc-trapezoid", NO_DEAD_ZONE)
    np.testing.assert_allclose(r.x[55900], (14.0, 8.0556), atol=2e-4)


@pytest.mark.slow
def test_pump_fault():
    """Pump 1 at 60 % from 300 to 400 s: mean e1 -0.149 (E) and -0.085 cm (S), mean d^1 -0.82 cm/s
    (notes S3.4).
    """
    from jaxtank.plants.faults import faults

    broken = lambda loop: dataclasses.replace(
        loop, faults=faults(loop.plant, [("pump_gain[0]", 300, 400, 0.6, 0.0)])
    )
    e, s = run("enmpc", {}, broken), run("chadpc", {}, broken)
    inside = (s.t >= 310) & (s.t < 400)
    np.testing.assert_allclose(e.e[inside, 0].mean(), -0.149, atol=2e-3)
    np.testing.assert_allclose(s.e[inside, 0].mean(), -0.085, atol=2e-3)
    np.testing.assert_allclose(s.d_hat[inside, 0].mean(), -0.82, atol=5e-3)


def held_at(level):
    """A short unsaturated run: a steady setpoint, levels a little off it, a pour."""
    from jaxtank.signals.base import Constant
    from jaxtank.signals.inflows import inflow_pulses

    return lambda loop: dataclasses.replace(
        loop,
        reference=Constant(level=np.array(level)),
        x0=np.array(level) + np.array([0.05, -0.04]),
        disturbance=inflow_pulses(2, [(5.0, 4.0, 0, 60.0)]),
    )


def test_chadpc_is_a_pi_on_the_linearised_plant():
    """d^ = l e + k l dt sum e + const, so c2 u + f = r' - (k + l) e - k l int e (notes S4.4), to
    1e-10 while no pump is at its limit.
    """
    r = run("chadpc", NO_DEAD_ZONE, held_at((12.0, 10.0)), duration=20.0)
    assert np.array_equal(r.command, r.applied)
    k, l, dt = 1.5 / 0.13, 10.0, 0.01
    past = np.vstack([np.zeros(2), np.cumsum(r.e, axis=0)[:-1]])
    constant = r.d_hat - l * r.e - k * l * dt * past
    assert np.ptp(constant, axis=0).max() < 1e-10
    f = np.array(paper_drift(r.x))
    pi = -((k + l) * r.e + k * l * dt * past + constant[0])
    np.testing.assert_allclose(34.717 / 225 * r.command + f, pi, atol=1e-10)
    assert np.abs(r.e).max() > 0.04


def paper_drift(x):
    from jaxtank.controllers.feedback_linearisation import drift

    return np.stack(drift(loops.rig(), tuple(x.T)), axis=-1)


@pytest.mark.slow
def test_literal_double_compensation_is_a_single_one_with_twice_the_gain():
    """To 1e-14 cm, everywhere; the estimate reads half (notes S4.3; the prototype measured 7e-15
    cm, and 2e-13 cm/s between 60 and 499 s).
    """
    double = {"controller.compensation": "double", "observer.before_compensation": True}
    b, s = run("chadpc", double), run("chadpc", {"observer.l": 20.0})
    np.testing.assert_allclose(b.x, s.x, rtol=0, atol=1e-14)
    between = (s.t >= 60) & (s.t < 499)
    np.testing.assert_allclose(2 * b.d_hat[between], s.d_hat[between], rtol=0, atol=3e-13)


@pytest.mark.slow
def test_k_and_l_are_interchangeable_in_the_loop():
    """The response to a disturbance is the same with k and l exchanged (notes S4.4), by a run and
    its mirror.
    """
    one = run("chadpc", {**NO_DEAD_ZONE, "controller.Tp": 1.5, "observer.l": 4.0}, quietly)
    two = run("chadpc", {**NO_DEAD_ZONE, "controller.Tp": 1.5 / 4.0, "observer.l": 1.0}, quietly)
    np.testing.assert_allclose(one.e, two.e, atol=1e-12)
    assert np.abs(one.e).max() > 0.01


def quietly(loop):
    from jaxtank.signals.base import Constant
    from jaxtank.signals.inflows import inflow_pulses

    return dataclasses.replace(
        loop,
        reference=Constant(level=np.array([12.0, 10.0])),
        x0=np.array([12.0, 10.0]),
        disturbance=inflow_pulses(2, [(5.0, 4.0, 0, 60.0)]),
    )


@pytest.mark.slow
def test_an_observer_fed_the_unlimited_command_winds_up():
    """Notes S4.2: S overshoots to 15.79 cm in tank 2, B to 15.83 and tank 1 to 12.11 cm."""
    s = run("chadpc", {"observer.fed": "command"}, duration=400.0)
    np.testing.assert_allclose(s.x[:, 1].max(), 15.79, atol=0.02)
    double = {
        "controller.compensation": "double",
        "observer.before_compensation": True,
        "observer.fed": "command",
    }
    b = run("chadpc", double, duration=49.0)
    np.testing.assert_allclose((b.x[:, 1].max(), b.x[:, 0].max()), (15.83, 12.11), atol=0.02)


@pytest.mark.slow
def test_printed_sign_leaves_its_offset():
    """Offset 2 f/k, which the observer does not remove (notes E2)."""
    for name in ("enmpc-printed", "chadpc-printed"):
        r = run(name, NO_DEAD_ZONE)
        np.testing.assert_allclose(r.e[paper.quiet(r.t)].mean(axis=0), (-0.095, -0.076), atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tau", "limit"), [pytest.param(0.13, 0.05, marks=pytest.mark.slow), (1.3, 0.12)]
)
def test_delay_margin(tau, limit):
    """The largest stable delay of S at l = 10 (notes S7.2): a kick dies out at it and does not two
    samples later.
    """
    quiet = lambda loop: dataclasses.replace(
        quietly(loop), x0=np.array([12.0 + 1e-3, 10.0]), disturbance=None
    )
    for delay, stable in ((limit, True), (limit + 0.02, False)):
        values = {
            **NO_DEAD_ZONE,
            "controller.Tp": tau,
            "actuator.delay": delay,
            "actuator.initial": equilibrium(loops.rig(), (12, 10))[1],
        }
        r = run("chadpc", values, quiet, duration=60.0)
        late = np.abs(r.e[-500:]).max()
        assert late < 1e-5 if stable else late > 2e-3


TABLE6 = {  # notes S7.3, delay 0.5 s: RMS u, RMS e, ts, tr as printed there
    "pi": ((6.508, 7.570), (0.3249, 0.7590), (13.2, 37.8), (2.5, 7.5)),
    "pi-ff": ((6.508, 7.571), (0.3143, 0.7507), (4.7, 37.6), (2.4, 3.0)),
    "pid": ((6.507, 7.570), (0.3239, 0.7609), (14.2, 37.8), (2.3, 2.8)),
    "pid-ff": ((6.507, 7.572), (0.3134, 0.7524), (4.9, 37.6), (2.3, 2.9)),
    "fopi": ((6.505, 7.563), (0.3279, 0.7404), (12.3, 38.9), (2.5, 6.7)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", TABLE6)
def test_baselines(name):
    found = paper.figures(run(name, {"actuator.delay": 0.5}))
    for key, expected, tolerance in zip(
        ("voltage", "error", "settling", "recovery"), TABLE6[name], (0.01, 1e-3, 0.06, 0.06)
    ):
        np.testing.assert_allclose(found[key], expected, atol=tolerance)


# notes S7.3: J = mean |e|^2 + 0.04 mean |du|^2 with a delay of 0.5 s and 0.02 cm of noise
J_OF_NOISE = [
    ("pi", {}, 0.6830, 1e-3), ("pi-ff", {}, 0.6635, 1e-3), ("pid", {}, 0.8057, 1e-3),
    ("pid-ff", {}, 0.7861, 1e-3),
    ("fopi", {}, 0.6568, 1e-3), ("chadpc", STEADY, 0.5791, 1e-3),
    # limit cycles: the 2 % of notes S7.3
    ("enmpc", {}, 0.7417, 0.02), ("chadpc", {}, 0.8128, 0.02),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("name", "values", "cost", "share"), J_OF_NOISE)
def test_cost_with_noise(name, values, cost, share):
    """One draw of 90,000 samples for another: the spread of the noise's mean square is 0.3 % of a
    part that is 2 to 25 % of J.
    """
    r = run(name, {**values, "actuator.delay": 0.5, "sensor.noise": 0.02})
    found = (r.e**2).sum(axis=1).mean() + 0.04 * (np.diff(r.applied, axis=0) ** 2).sum(
        axis=1
    ).mean()
    np.testing.assert_allclose(found, cost, rtol=share)


@pytest.mark.slow
def test_oustaloup_filter():
    """s^g within 0.007 dB and 1.1 degrees on 0.01 .. 10 rad/s for lambda = 0.8 (notes S4.5); a
    fractional PI of order 1 is a PI.
    """
    gain, poles, residues = (np.asarray(v) for v in oustaloup(0.2))
    w = np.geomspace(0.01, 10, 200)
    ratio = (gain + (residues / (1j * w[:, None] + poles)).sum(axis=1)) / (1j * w) ** 0.2
    assert np.abs(20 * np.log10(np.abs(ratio))).max() <= 0.007
    assert np.abs(np.degrees(np.angle(ratio))).max() <= 1.1
    a, b = run("pi", duration=60.0), run("fopi", {"controller.order": 1.0}, duration=60.0)
    np.testing.assert_allclose(a.x, b.x, rtol=1e-9)


@pytest.mark.slow
def test_gain_of_noise_to_voltage():
    """(k + l)/c2 for S, k/c2 for E: 139.6 and 74.8 V/cm; measured 0.729 and 0.383 V at 0.005 cm
    (notes S4.4).
    """
    for name, expected in (("enmpc", 0.383), ("chadpc", 0.729)):
        r = run(name, {**NO_DEAD_ZONE, "sensor.noise": 0.005}, quietly, duration=200.0)
        np.testing.assert_allclose(
            r.command[2000:].std(axis=0), expected, rtol=0.03
        )  # 18,000 samples: 0.5 % and the rounding of the notes


def test_controllers_refuse_what_they_cannot_invert(gouta):
    four = gouta("ngpc").loop.plant
    loop = CASES["chadpc"].loop
    wrong = dataclasses.replace(loop, controller=dataclasses.replace(loop.controller, model=four))
    with pytest.raises(InputError, match="one pump per controlled tank"):
        jaxtank.check(wrong, CASES["chadpc"].clock)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["chadpc", "pid-ff", "fopi"])
def test_the_rig_in_metres_runs_as_in_centimetres(name):

    loop = CASES[name].loop
    control, watch, level = loop.controller, loop.observer, quietly(loop)
    m = in_metres(loop.plant)
    small = lambda part: dataclasses.replace(part, model=m) if hasattr(part, "model") else part
    if hasattr(control, "Kc"):
        control = dataclasses.replace(control, Kc=control.Kc * 100)
    volume = jaxtank.with_values(level.disturbance, {"volume": level.disturbance.volume * 1e-6})
    reference = jaxtank.with_values(level.reference, {"level": level.reference.level / 100})
    metres = dataclasses.replace(
        level,
        plant=m,
        controller=small(control),
        observer=small(watch),
        reference=reference,
        disturbance=volume,
        x0=np.array([0.11, 0.09]),
    )
    clock = Clock(dt=0.01, duration=20.0)
    a, b = (
        jaxtank.simulate(one, clock)
        for one in (metres, dataclasses.replace(level, x0=np.array([11.0, 9.0])))
    )
    np.testing.assert_allclose(100 * np.asarray(a.x), b.x, rtol=1e-9)
    np.testing.assert_allclose(a.command, b.command, rtol=1e-7, atol=1e-8)


@pytest.mark.slow
def test_the_rig_that_was_fitted_to_the_paper():
    """Notes S8, means over nine draws of noise: u 7.97, 8.70 V; e 0.622, 1.171 cm; settling 24.9,
    34.2 s (E), tolerances as in S7.1 with what so many draws leave open. The dead zone comes before
    the lag: rectified after it, noise costs another 0.4 V.
    """
    case = CASES["enmpc-fitted"]
    found = [
        paper.figures(jax.tree.map(np.asarray, t))
        for t in (
            jaxtank.simulate(case.loop, case.clock, jax.random.key(seed)) for seed in range(9)
        )
    ]
    mean = lambda name: np.mean([f[name] for f in found], axis=0)
    np.testing.assert_allclose(mean("voltage"), (7.97, 8.70), atol=0.03)
    np.testing.assert_allclose(mean("error"), (0.622, 1.171), atol=0.01)
    # the noise throws the second level out of its band once more, much later, in three of these
    # draws: the median
    np.testing.assert_allclose(
        np.median([f["settling"] for f in found], axis=0), (24.9, 34.2), atol=0.6
    )

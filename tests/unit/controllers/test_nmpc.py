"""Nonlinear predictive control against an independent programme, differences and its own limits."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import rk4, signals_of
from scipy.optimize import minimize

import jaxtank
from jaxtank import presets, rig
from jaxtank.controllers import NMPC
from jaxtank.controllers.nmpc import Course
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.core.records import Estimate, Tick
from jaxtank.export import export
from jaxtank.export.replay import replay
from jaxtank.export.source import files
from jaxtank.export.whole import check_pointwise
from jaxtank.plants.rigs import quadruple_tank
from jaxtank.presets.paper import closed_loop
from jaxtank.signals.setpoints import ramps

SERIES = """
tank = [
    { area = 12.0, rim = 20.0, level = 4.0, inflow = 1.0 },
    { area = 10.0, rim = 20.0, drain = 0.1, level = 4.0, inflow = 1.0 },
]
orifice = [{ from = 1, to = 2, area = 0.1 }]
pump = [{ gain = 2.0, to = 1, high = 12.0, initial = 4.43 }]
plant = { outputs = [2] }
observer = { kind = "disturbance", l = [0.5, 0.5] }
reference = { initial = [4.0], changes = [[5.0, 1, 6.0]], ramp = 10.0 }
values = { "clock.dt" = 1.0, "clock.duration" = 60.0 }
controller = { kind = "nmpc", horizon = 12.0, r_w = 1e-3, rate = 100.0, N = 6, moves = 4 }
"""
T, N, WEIGHT, LAST = 2.0, 6, 1e-3, 4.43


@pytest.fixture(scope="module")
def case():
    return rig.loads(SERIES)


def run(case, **values):
    loop = jaxtank.with_values(case.loop, {k.replace("__", "."): v for k, v in values.items()})
    return loop, jaxtank.simulate(loop, case.clock)


def predicted(x, inputs):
    """Levels (N, 2) of the two tanks in series by the classical Runge-Kutta method."""

    def rates(x, u):
        upper, lower = 0.1 * np.sqrt(2.0 * 981.0 * x[0]), 0.1 * np.sqrt(2.0 * 981.0 * x[1])
        return np.array([(2.0 * u - upper) / 12.0, (upper - lower) / 10.0])

    levels = []
    for u in inputs:
        x = rk4(lambda x, u=u: rates(x, u), x, T)
        levels.append(x)
    return np.array(levels)


def best_plan(x, setpoint, limit, last):
    """Inputs at the knots by SLSQP on the nonlinear programme, slopes by complex steps."""
    places = np.array([0.0, 1.0, 20.0 / 9.0, 5.0])  # the larger of k and 5 (k/3)^2
    blend = np.array([np.interp(np.arange(N), places, row) for row in np.eye(4)]).T

    def cost(knots):
        inputs = blend @ knots
        levels = predicted(x, inputs)
        moves = np.concatenate([inputs[:1] - last, np.diff(inputs)])
        return np.sum((levels[:, 1] - setpoint) ** 2) + WEIGHT * np.sum(moves**2)

    def slope(f, at):
        steps = 1e-30j * np.eye(4)
        return np.stack([np.imag(f(at + step)) / 1e-30 for step in steps], axis=-1)

    room = lambda knots: limit - predicted(x, blend @ knots)[:, 0]
    answer = minimize(
        cost,
        np.full(4, last),
        jac=lambda knots: slope(cost, knots),
        bounds=[(0.0, 12.0)] * 4,
        constraints={"type": "ineq", "fun": room, "jac": lambda knots: slope(room, knots)},
        options={"ftol": 1e-15, "maxiter": 200},
    )
    return answer.x, room(answer.x)


LEAVES = ("horizon", "r_w", "rate_time", "terminal", "limit[0]", "rate")


@pytest.fixture(scope="module")
def planned(case):
    """One sample: (plan (4,), its derivatives (4, 6) by LEAVES, the state after it)."""

    def plan(point, state, tick):
        values = dict(zip((f"controller.{name}" for name in LEAVES), point))
        controller = jaxtank.with_values(case.loop, values).controller
        after = controller.step(state, tick, Estimate(x=(4.0, 4.0), d=(0.0, 0.0)))[1]
        return after.knots, after

    def both(*arguments):
        slopes, after = jax.jacfwd(plan, has_aux=True)(*arguments)
        return after.knots, slopes, after

    compiled = jax.jit(both)
    # arrays, as the state after a sample: one program for the first and for the later ones
    start = jax.tree.map(jnp.asarray, case.loop.controller.init((4.0, 4.0), (LAST,)))

    def sample(point, setpoint, dt, state=start):
        tick = Tick(t=0.0, r=(setpoint,), dr=(0.1,), ddr=(0.0,), dt=dt)
        return compiled(np.asarray(point), state, tick)

    return sample


@pytest.mark.extended_for("4.5-4.6")
@pytest.mark.slow_for("4.2-20.0")
@pytest.mark.parametrize(("setpoint", "limit"), [(4.2, 20.0), (4.5, 4.6), (7.0, 20.0)])
def test_programmes_in_sequence_end_at_the_solution_of_the_nonlinear_programme(
    planned, setpoint, limit
):
    # a clock that stands still: the same programme is linearised at its own solution
    point = (12.0, WEIGHT, 0.0, 1.0, limit, 1e9)
    knots, _, state = planned(point, setpoint, 1e-6)
    for _ in range(12):
        knots, _, state = planned(point, setpoint, 1e-6, state)
    plan, room = best_plan(np.array([4.0, 4.0]), setpoint, limit, LAST)
    np.testing.assert_allclose(knots, plan, atol=1e-6)
    assert (room.min() < 1e-8) == (limit < 20.0)
    assert float(state.slack) < 1e-8


@pytest.mark.parametrize(
    ("setpoint", "limit", "rate"),
    [
        (4.2, 20.0, 100.0),
        (4.5, 4.6, 100.0),
        (7.0, 20.0, 100.0),
        (4.2, 20.0, 0.3),
        (4.2, 2.5, 100.0),
    ],
    ids=["no limit acts", "level", "input", "rate", "slack"],
)
def test_slopes_of_a_plan_are_those_of_differences(planned, setpoint, limit, rate):
    point = np.array([12.0, WEIGHT, 3.0, 1.0, limit, rate])
    state = planned(point, setpoint, 1.0)[2]
    value = lambda point: np.asarray(planned(point, setpoint, 1.0, state)[0])
    steps = 1e-4 * np.diag(point)
    differences = [(value(point + h) - value(point - h)) / (2.0 * h.sum()) for h in steps]
    exact = planned(point, setpoint, 1.0, state)[1]
    np.testing.assert_allclose(exact, np.stack(differences, axis=1), rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_a_limit_that_no_input_keeps_is_given_up_and_reported(case):
    loop, trajectory = run(case, controller__limit=[1.0, 20.0])
    assert np.all(np.isfinite(trajectory.x))
    assert float(trajectory.u[0, 0]) < 1e-9  # while the level is above its limit
    assert float(trajectory.x[-1, 0]) == pytest.approx(1.0, abs=1e-4)
    measured = jaxtank.evaluate(loop, case.clock, ["limit_slack"])["limit_slack"]
    falling = predicted(np.array([4.0, 4.0]), np.zeros(1))[0, 0] - 1.0  # after a predicted sample
    assert float(measured) == pytest.approx(falling, abs=0.02)  # linearised at another input


@pytest.mark.extended
def test_a_constant_inflow_leaves_no_error(case):
    _, trajectory = run(case, disturbance__level=[3.0, 4.0])
    assert abs(float(trajectory.e[-1, 0])) < 1e-4


def test_the_inputs_keep_their_largest_rate(case):
    _, trajectory = run(case, controller__rate=0.2)
    moves = np.abs(np.diff(trajectory.u[:, 0]))
    assert moves.max() == pytest.approx(0.2, abs=1e-6) and moves.max() < 0.2 + 1e-8


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"controller.moves": 7}, "controller.moves = 7"),
        ({"actuator.delay": 2.0}, "actuator.delay = 2 s"),
        ({"controller.high": -1.0}, "controller.high"),
    ],
)
def test_what_the_programme_cannot_have_is_refused(case, change, words):
    with pytest.raises(InputError, match=words):
        rig.check(rig.set_values(case, change))


@pytest.mark.slow_for("c-gcc")
@pytest.mark.parametrize(
    ("lang", "tool"), [("c", "gcc"), pytest.param("js", "node", marks=pytest.mark.slow)]
)
def test_code_gives_the_inputs_of_the_loop(case, lang, tool, tmp_path):
    if shutil.which(tool) is None:
        pytest.skip(f"no {tool} on this machine")
    rest = 0.05 * (2.0 * 981.0 * 4.0) ** 0.5  # replay begins from the first input of the log
    limits = {"controller.limit": [4.5, 20.0], "controller.rate": 0.5}
    bound = rig.set_values(case, limits | {"actuator.initial": [rest]})
    run = jaxtank.simulate(bound)
    signals = {"y": run.y, "u": run.u}
    signals |= zip(("r", "dr", "ddr"), signals_of(bound))
    names = [f"{name}{i + 1}" for name, v in signals.items() for i in range(v.shape[1])]
    table = np.column_stack([run.t, *signals.values()])
    log = tmp_path / "log.csv"
    np.savetxt(log, table, "%.17g", ",", header=",".join(["t [s]", *names]), comments="")
    for name, text in files(bound, lang, name="law").items():
        (tmp_path / name).write_text(text)
    (row,) = replay(tmp_path / f"law.{lang}", log)["inputs"]
    assert np.ptp(run.u) > 1.0 and row["largest_difference"] < 1e-9


def test_code_of_one_sample_reads_no_setpoints_ahead():
    with pytest.raises(InputError, match=r"controller\.preview"):
        export(presets.find("gouta2015/nmpc-preview"))


def test_a_live_page_is_refused(case):
    with pytest.raises(InputError, match="nmpc"):
        check_pointwise(case)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "most"), [("nmpc", 0.045), ("nmpc-preview", 0.032)])
def test_the_four_tank_follows_below_its_rims(kind, most):
    case = presets.find(f"gouta2015/{kind}")
    trajectory = jaxtank.simulate(case)
    assert np.sqrt(np.mean(trajectory.e**2, axis=0).sum()) < most
    assert trajectory.x.max() < 30.0005


@pytest.mark.slow
def test_a_quadruple_tank_reaches_its_setpoints_without_passing_a_limit():
    # the task of Dyad's quadruple tank: [2, 1, 8, 3] to [9.82, 9.82, 6.28, 6.28] cm
    shape = {"area": (4.9,) * 4, "outlet": (0.03,) * 4, "pump_gain": 1.6, "split": 0.2, "rim": 20.0}
    plant = jaxtank.with_values(quadruple_tank(**shape), {"gravity": 9.81})
    programme = {"low": [0.0, 0.0], "high": [0.6, 0.6], "iterations": 3}
    limits = np.array([12.0, 12.0, 8.0, 8.0])
    controller = NMPC(model=plant, horizon=600.0, r_w=[1.0, 1.0], limit=limits, **programme)
    loop = closed_loop(
        plant, controller, ramps([9.82, 9.82], []), [2.0, 1.0, 8.0, 3.0],
        sensor=(1.0, 3.3), pumps={"low": 0.0, "high": 0.6, "initial": 0.26},
    )  # fmt: skip
    trajectory = jaxtank.simulate(loop, Clock(dt=10.0, duration=3000.0, substeps=10))
    assert np.all(trajectory.x.max(axis=0) < limits + 1e-6)
    np.testing.assert_allclose(trajectory.x[-1], [9.82, 9.82, 6.28, 6.28], atol=0.01)


def test_setpoints_ahead_are_those_of_the_reference_or_go_on_at_their_rate(case):
    r = 4.0 + 0.3 * np.arange(case.clock.samples)  # [cm], a sample each second
    announced = rig.loads(SERIES.replace("moves = 4", "moves = 4, preview = 12.0"))
    controller = announced.loop.controller
    (rows,) = controller.announced(case.clock, (jnp.asarray(r),))
    tick = Tick(5.0, (r[5],), (0.1,), (0.0,), dt=1.0, own=(rows[5],))
    ahead = T * np.arange(1, N + 1)
    np.testing.assert_allclose(controller.setpoints(tick)[:, 0], r[5] + 0.3 * ahead, rtol=1e-12)
    controller = case.loop.controller
    assert controller.announced(case.clock, (jnp.asarray(r),)) == ()
    assert float(controller.rate_time) == 12.0 / 4.0
    lasting = np.minimum(ahead, 3.0)
    np.testing.assert_allclose(controller.setpoints(tick)[:, 0], r[5] + 0.1 * lasting, rtol=1e-12)


def test_a_plan_goes_on_where_the_time_has_come_to(case, monkeypatch):
    monkeypatch.setattr(NMPC, "_improved", lambda self, plan, *_: plan)
    controller = case.loop.controller
    places = controller.places
    state = controller.init((4.0, 4.0), (LAST,))._replace(knots=jnp.asarray(3.0 + 0.5 * places))
    tick = Tick(5.0, (4.0,), (0.0,), (0.0,), dt=1.0)
    (u,), plan = controller.step(state, tick, Estimate(x=(4.0, 4.0)))
    expected = 3.0 + 0.5 * np.minimum(places + 1.0 / T, places[-1])
    np.testing.assert_allclose(plan.knots, expected, rtol=1e-12)
    assert float(u) == 3.25


WIDE = """
tank = [{ area = 200.0, drain = 0.5, rim = 100.0, level = 10.0 }]
pump = [{ to = 1, gain = 60.0, high = 10.0, initial = 1.166 }]
controller = { kind = "nmpc", horizon = 60.0, r_w = [0.1], limit = [LIMIT], q = [WEIGHT] }
reference = { initial = [10.0], changes = [[20.0, 1, SETPOINT]] }
values = { "clock.dt" = 2.0, "clock.duration" = 300.0 }
reachable = false
"""


@pytest.mark.extended_for("40.0-5.0-50.0")
@pytest.mark.parametrize("limit, weight, setpoint", [(40.0, 5.0, 50.0), (20.0, 1.0, 90.0)])
def test_a_limit_holds_however_large_the_error(limit, weight, setpoint):
    text = WIDE.replace("LIMIT", f"{limit}").replace("WEIGHT", f"{weight}")
    case = rig.loads(text.replace("SETPOINT", f"{setpoint}"))
    level = float(jaxtank.evaluate(case.loop, case.clock, "max_level")["max_level"][0])
    assert limit - 1e-3 < level < limit + 1e-3


@pytest.mark.extended
def test_a_limit_of_a_tank_above_the_output_holds():
    """An output that follows the limited level eleven to one, at rest."""
    case = rig.loads("""
tank = [{ area = 100.0, rim = 50.0, level = 2.0 },
    { area = 20.0, drain = 0.15, rim = 150.0, level = 22.2 }]
orifice = [{ from = 1, to = 2, area = 0.5 }]
pump = [{ to = 1, gain = 60.0, high = 10.0, initial = 0.522 }]
plant = { outputs = [2] }
controller = { kind = "nmpc", horizon = 60.0, r_w = [0.1], limit = [5.0, 150.0] }
reference = { initial = [22.2], changes = [[20.0, 1, 120.0]] }
values = { "clock.dt" = 2.0, "clock.duration" = 400.0 }
reachable = false
""")
    level = float(jaxtank.evaluate(case.loop, case.clock, "max_level")["max_level"][0])
    assert level == pytest.approx(5.0, abs=1e-3)


@pytest.mark.extended
def test_rounding_at_empty_tanks_decides_nothing():
    """A predicted sample of 1.5 s is many times what empties the last film of a tank: where tanks
    gave more than they hold, slopes grew to 1e43; and a level, or an input at its limit, that
    rounding takes below 0 has the slopes of 0.
    """
    controller = presets.find("gouta2015/nmpc").loop.controller
    count, knots = controller.N, jnp.zeros(2 * controller.moves)
    tick = Tick(t=0.0, r=(8.0, 8.0), dr=(0.0, 0.0), ddr=(0.0, 0.0), dt=1.0)
    basis = controller.blend(np.arange(count)).reshape(count, 2, -1)
    step = jax.jit(lambda knots, x: controller.step(Course(knots, 0.0 * x[:2], 0.0), tick, of(x)))
    of = lambda x: Estimate(x=tuple(x))
    for levels in ([0.0] * 4, [6.7, 11.5, 0.26, 0.0], [5.1, 9.1, 0.015, 0.0]):
        x = jnp.array(levels)
        slopes = controller._predict(tick, of(x), jnp.zeros((count, 2)), basis)[1]
        assert 0.1 < float(jnp.abs(slopes).max()) < 1.0
        u, _ = step(knots, x)
        for nearly, film in ((-1e-27, 0.0), (1e-27, 0.0), (0.0, -1e-30), (0.0, 1e-30)):
            v, _ = step(knots + nearly, x.at[3].add(film))
            np.testing.assert_allclose(v, u, rtol=0, atol=1e-9)

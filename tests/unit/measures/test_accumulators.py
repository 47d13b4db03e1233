"""Every measure of given samples is that of its definition, computed here of the whole signals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxtank
from jaxtank import measures as ms, rig
from jaxtank.core import vectors
from jaxtank.core.clock import Clock
from jaxtank.core.records import Sample
from jaxtank.core.vectors import scalars
from jaxtank.measures import registry
from jaxtank.measures.accumulators import Context, Run

N, DT = 160, 0.5
T = DT * np.arange(N + 1)
CHANGES = (((20, 8.0, 3.0), (90, 5.0, -3.0)), ((0, 4.0, 0.0), (60, 7.0, 3.0)))
"""Of each output (sample, target [cm], step [cm]); a step of 0 is no change."""
PULSES = ((10, 45), (100, 130))  # samples at which a pulse is watched, first and last
LOW, HIGH, RIM = np.array([0.0, -1.0]), np.array([6.0, 4.0]), np.array([8.2, 7.5, 9.0])


def windows():
    """(target, step, time since the change, half width of its band), (N + 1, 2) each."""
    target, step, since = np.zeros((3, N + 1, 2))
    target[:, 0] = 5.0
    for i, changes in enumerate(CHANGES):
        for k, to, by in changes:
            target[k:, i], step[k:, i], since[k:, i] = to, by, T[k:] - T[k]
    return target, step, since, 0.05 * np.abs(step)


@pytest.fixture(scope="module")
def signals():
    rng = np.random.default_rng(5)
    target, step, since, band = windows()
    decay = np.exp(-since / np.array([3.0, 4.0])) * np.cos(since / np.array([1.2, 2.0]))
    y = target - step * decay + 0.02 * rng.standard_normal((N + 1, 2))
    y[10:30] += np.exp(-0.2 * np.arange(20))[:, None]  # the pulses
    y[100:130] -= 0.8 * np.exp(-0.1 * np.arange(30))[:, None]
    x = np.column_stack([y, 6.0 + 4.0 * rng.standard_normal(N + 1)])
    watched = np.full(N + 1, -1.0)
    for first, last in PULSES:
        watched[first : last + 1] = T[first : last + 1] - T[first]
    normal = lambda *shape: rng.standard_normal((N + 1, *shape))
    command = 2.0 + 3.0 * normal(2)
    sample = Sample(
        t=T, x=x, y=x, x_hat=x + 0.1 * normal(3), d_hat=np.zeros((N + 1, 3)), r=target,
        e=y - target, command=command, applied=np.clip(command, LOW, HIGH),
        u=np.clip(command, LOW, HIGH), spilled=np.abs(normal(3)), shortfall=np.abs(normal(3)),
        filtered=(normal() > 0.0) * 1.0, slack=normal(),
    )  # fmt: skip
    jump = np.isin(np.arange(2 * N + 2).reshape(-1, 2), [40, 121, 180, 123])
    context = Context((target, step, since, band), watched, 2.0 + 0.1 * normal(2), jump)
    return sample, context


def without_pulses(out, piece):
    """Where a change's samples are outside, but for what a pulse moves there from the inside."""
    out = out.copy()
    for first, last in PULSES:
        first, last = first - piece.start, last - piece.start
        if not 0 < first < len(out) or out[first - 1]:
            continue
        moved = True
        for k in range(first, len(out)):
            if k > last and not moved:
                break
            moved, out[k] = out[k], False
    return out


def by_definition(s, context):
    target, step, _, band = context.window
    e2, y, lasting = s.e**2, s.r + s.e, slice(None, -1)
    watched = context.since >= 0.0
    past = np.maximum((y - target) * np.sign(step), 0.0) * ~watched[:, None]
    outside = (s.command < LOW) | (s.command > HIGH)
    excess = np.maximum(np.maximum(s.command - HIGH, LOW - s.command), 0.0)
    over, moves = np.maximum(s.x - RIM, 0.0), np.diff(s.u, axis=0)
    overshoot, rise, settling, error, when = ([] for _ in range(5))
    for i, changes in enumerate(CHANGES):
        ends = [k for k, *_ in changes[1:]] + [N + 1]
        pieces = [slice(k, end) for (k, _, by), end in zip(changes, ends) if by]
        of = [(y[p, i] - target[p, i]) / step[p, i] for p in pieces]
        overshoot.append(100.0 * max(v[~watched[p]].max() for v, p in zip(of, pieces)))
        rise.append(max(DT * (np.argmax(v >= -0.1) - np.argmax(v >= -0.9)) for v in of))
        out = [np.abs(y[p, i] - target[p, i]) > band[p, i] for p in pieces]
        out = [without_pulses(o, p) for o, p in zip(out, pieces)]
        settling.append(max(np.inf if o[-1] else DT * np.flatnonzero(o)[-1] for o in out))
        last = [k - 1 for k, *_ in changes if k] + [N]
        on_setpoint = abs(s.e[0, i]) <= 0.01 * s.r[0, i]
        shortest_later = np.diff(last).min()
        last = last[1:] if on_setpoint and last[0] + 1 < shortest_later else last
        error.append(max(abs(s.e[k, i]) for k in last))
        when.append(T[max(last, key=lambda k: abs(s.e[k, i]))])
    far, recovery = np.abs(s.e) > 0.05 * np.abs(s.r), []
    for i in range(2):
        last = [np.flatnonzero(far[first : end + 1, i])[-1] for first, end in PULSES]
        ended = any(far[end, i] for _, end in PULSES)
        recovery.append(np.inf if ended else DT * max(last))
    return {
        "rms_error": np.sqrt(e2.mean(0)),
        "rms_error_total": np.sqrt(e2.mean(0).sum()),
        "mean_square_error": e2.mean(0),
        "ise": DT * e2[lasting].sum(0),
        "iae": DT * np.abs(s.e[lasting]).sum(0),
        "max_error": np.abs(s.e).max(0),
        "steady_state_error": error,
        "time_of_steady_state_error": when,
        "mean_square_overshoot": (past**2).mean(0),
        "rms_input": np.sqrt((s.u**2).mean(0)),
        "input_travel": np.abs(moves).sum(0),
        "mean_square_travel": (moves**2).sum(0) / (N + 1),
        "mean_square_jitter": (moves**2 * ~context.jump[1:]).sum(0) / (N + 1),
        "mean_square_relative_jitter": ((moves / (HIGH - LOW)) ** 2 * ~context.jump[1:]).sum(0)
        / (N + 1),
        "input_deviation": DT * ((s.u - context.steady)[lasting] ** 2).sum(0),
        "saturated_fraction": outside.mean(0),
        "filter_active_fraction": s.filtered.mean(),
        "limit_slack": s.slack.max(),
        "saturation_excess": (excess / (excess + HIGH - LOW)).mean(),
        "max_level": s.x.max(0),
        "min_level": s.x.min(0),
        "max_over_rim": s.x.max(0) - RIM,
        "rms_over_rim": np.sqrt((over**2).mean(0).sum()),
        "mean_square_over_rim": (over**2).mean(0),
        "overflow_volume": s.spilled[lasting].sum(0),
        "inflow_shortfall": s.shortfall[lasting].sum(0),
        "overshoot_percent": overshoot,
        "rise_time": rise,
        "settling_time": settling,
        "recovery_time": recovery,
        "estimation_rms": np.sqrt(((s.x_hat - s.x) ** 2).mean(0)),
        "time_of_max_level": T[s.x.argmax(0)],
        "time_of_min_level": T[s.x.argmin(0)],
    }


def measured(names, sample, context, arrays):
    """Measures of signals, sample by sample."""
    form = jnp.asarray if arrays else lambda v: tuple(jnp.asarray(v))
    run = Run(3, 2, 2, N + 1, DT, form(LOW), form(HIGH), form(RIM), jnp.zeros(()), arrays)
    in_form = lambda v: v if arrays or jnp.ndim(v) == 0 else scalars(v)

    def step(states, xs):
        s, c = jax.tree.map(in_form, xs)
        if not arrays:
            c = c._replace(window=tuple(zip(*c.window)))
        return registry.update(run, states, s, c), None

    states, _ = jax.lax.scan(step, registry.start(run, names), (sample, context))
    return registry.read(run, states, names)


@pytest.mark.parametrize("arrays", [False, True])
def test_every_measure_is_that_of_its_definition(signals, arrays):
    expected = by_definition(*signals)
    computed = measured(tuple(expected), *signals, arrays)
    for name, value in expected.items():
        np.testing.assert_allclose(computed[name], value, rtol=1e-12, err_msg=name)
    unchecked = {m for m in registry.BUILT_IN - expected.keys() if not ms.MEASURES[m].linear}
    assert unchecked == {"steady_state_swing"}


def test_the_swing_is_that_of_the_end_of_a_plateau(signals):
    sample, context = signals
    k = np.arange(N + 1)
    r = np.where(k < 100, 5.0, 6.0)[:, None] * np.ones(2)  # plateaus of 100 and 61 samples
    bump = lambda at, by: np.where(k == at, by, 0.0)

    def swing(*bumps):
        e = np.column_stack([sum(bump(*b) for b in bumps), np.zeros(N + 1)])
        values = measured(("steady_state_swing",), sample._replace(r=r, e=e), context, True)
        return float(values["steady_state_swing"][0])

    # the last sixth counts, what is before the last three tenths does not, nor one side alone
    assert swing((90, 0.5), (95, -0.3)) == 0.3 and swing((90, -0.5), (95, 0.4)) == 0.4
    assert swing((60, 0.5), (68, -0.3)) == swing((90, 0.5)) == 0.0
    assert swing((90, 0.5), (95, -0.3), (151, 0.2), (158, -0.1)) == 0.3
    assert swing((151, 0.2), (158, -0.1)) == 0.1


@pytest.mark.parametrize("begins", [True, False])
def test_a_plateau_that_begins_on_its_setpoint_counts_if_a_later_one_is_no_longer(signals, begins):
    sample, context = signals
    names = ("steady_state_error", "time_of_steady_state_error", "steady_state_swing")
    k, e = np.arange(N + 1), np.zeros((N + 1, 2))
    e[0] = 0.0 if begins else 0.06  # of a setpoint of 5

    def measures(*changes):  # errors of 3 at the end of the first plateau, of 1 and 2 afterwards
        ends = [*(at - 1 for at in changes), N]
        for end, size in zip(ends, (3.0, 1.0, 2.0)):
            e[end - 1, 0], e[end, 0] = -size, size
        r = 5.0 + 0.5 * sum((k >= at for at in changes), 0 * k)
        rows = sample._replace(r=np.column_stack([r, r]), e=e.copy())
        e[1:] = 0.0
        return [float(np.ravel(v)[0]) for v in measured(names, rows, context, True).values()]

    first, rest = 3.0, [2.0, T[N], 2.0]
    expected = rest if begins else [first, T[29], first]
    assert measures(30, 90) == expected  # 30, 60 and 71 samples
    assert measures(60, 120) == [first, T[59], first]  # 60, 60 and 41
    assert measures(60, 121) == [first, T[59], first]  # 60, 61 and 40: shorter than the first
    assert measures() == [3.0, T[N], 3.0]  # the only one
    ramp = sample._replace(
        r=np.column_stack([5.0 + np.maximum(0.1 * (k - 59), 0.0)] * 2),  # constant up to sample 59
        e=np.where(k == 59, 3.0, e[0, 0] * (k == 0))[:, None] * np.ones(2),
    )
    assert float(measured(names[:1], ramp, context, True)[names[0]][0]) == 3.0


PULSE = """
dt = 0.5
duration = 600.0
tank = [{ area = 100.0, rim = 40.0, drain = 0.1, level = 10.0 }]
pump = [{ gain = 10.0, to = 1, low = 0.0, high = 12.0 }]
controller = { kind = "pi", Kc = 0.3, Ti = 60.0 }
reference = { initial = [10.0], changes = [[10.0, 1, 14.0]], ramp = 0.0 }
"""


@pytest.mark.parametrize("arrays", [False, True])
def test_a_pulse_that_moves_nothing_changes_no_measure(arrays, monkeypatch):
    """While a step settles, after it, and before an earlier pulse is recovered from."""
    monkeypatch.setattr(vectors, "FROM", 1 if arrays else 10**9)
    jax.clear_caches()
    names = ("rise_time", "settling_time", "recovery_time")

    def at(*pulses):
        keys = "time = {}, duration = 1.0, tank = 1, volume = {}"
        rows = ", ".join(f"{{ {keys.format(*pulse)} }}" for pulse in pulses)
        case = rig.loads(PULSE + f"inflow = [{rows}]\n")
        values = jaxtank.evaluate(case.loop, case.clock, names)
        return [float(values[name][0]) for name in names]

    rise, settling, _ = alone = at((300.0, 300.0))
    run = jaxtank.simulate(rig.loads(PULSE).loop, Clock(dt=0.5, duration=600.0))
    t, done = run.t, (run.y[:, 0] - 10.0) / 4.0
    assert rise == t[done >= 0.9][0] - t[done >= 0.1][0]
    assert settling == t[np.abs(done - 1.0) > 0.05][-1] - 10.0
    for time in (30.0, 100.0):
        assert at((time, 1e-6), (300.0, 300.0))[:2] == [rise, settling]
    recovery = at((300.0, 300.0), (315.0, 1e-6))
    assert recovery == pytest.approx(alone, abs=1e-9) and 0.0 < alone[2] < 60.0
    burst = at(*((300.0 + 0.5 * k, 10.0) for k in range(20)))  # a pulse of 200 cm^3 in parts
    assert burst[2] == pytest.approx(at((300.0, 100.0), (305.0, 100.0))[2], abs=2.0)


def test_a_run_at_its_setpoint_has_no_changes_to_settle_and_recovers_at_once(signals):
    sample, context = signals
    still = np.zeros((N + 1, 2))
    rows = sample._replace(r=np.arange(1.0, N + 2.0)[:, None] + still, e=still)  # no plateau
    context = context._replace(window=(still, still, still, still))
    names = ("settling_time", "rise_time", "recovery_time", "steady_state_error")
    values = measured((*names, "steady_state_swing", "overshoot_percent"), rows, context, False)
    for name in ("settling_time", "rise_time", "steady_state_error", "steady_state_swing"):
        assert np.all(np.isnan(values[name])), name
    for name in ("recovery_time", "overshoot_percent"):
        assert np.all(np.asarray(values[name]) == 0.0), name

"""Changes of the inputs without those at a jump of a setpoint, against numpy on the trajectory."""

import dataclasses

import numpy as np
import pytest

import jaxtank
from jaxtank import rig
from jaxtank.core.clock import CHUNK
from jaxtank.loop.change_windows import windows
from jaxtank.loop.closed_loop import takes_arrays

RIG = """
tank = [
    {{ area = 100.0, level = 10.0, rim = 30.0, drain = 0.5 }},
    {{ area = 100.0, level = 10.0, rim = 30.0, drain = 0.5 }},
]
pump = [
    {{ to = 1, gain = 20.0, high = 10.0{first} }},
    {{ to = 2, gain = 20.0, high = 10.0 }},
]
controller = {{ kind = "pi", Kc = 0.3, Ti = 40.0 }}
reference = {{ initial = [10.0, 11.0], {changes} }}
values = {{ "clock.dt" = 0.5, "clock.duration" = {duration} }}
"""
STEPS = "changes = [[20.0, 1, 12.0], [60.0, 2, 9.0], [60.5, 1, 11.0], [80.0, 1, 10.5]]"
RAMP = STEPS + ", ramp = 7.0"


def jitter(case, delays=(0, 0)):
    """(pumps,) the measure by its definition; delays: of the pumps, in samples."""
    run = jaxtank.simulate(case.loop, case.clock)
    r, u = np.asarray(run.r), np.asarray(run.u)
    moves = np.any(np.diff(r, axis=0) != 0.0, axis=1)
    starts = 1 + np.flatnonzero(moves & ~np.concatenate([[False], moves[:-1]]))
    changes = np.diff(u, axis=0)
    for i, delay in enumerate(delays):
        later = starts + delay
        changes[later[later < len(u)] - 1, i] = 0.0
    return (changes**2).sum(0) / len(u), (np.diff(u, axis=0) ** 2).sum(0) / len(u)


def measured(case):
    values = jaxtank.evaluate(case.loop, case.clock, ["mean_square_jitter", "mean_square_travel"])
    return values["mean_square_jitter"], values["mean_square_travel"]


@pytest.mark.extended_for("delay")
@pytest.mark.parametrize(
    "first, changes, delays",
    [
        ("", STEPS, (0, 0)),
        ("", RAMP, (0, 0)),
        ("", "changes = []", (0, 0)),
        (", delay = 1.5", STEPS, (3, 0)),
    ],
    ids=["steps", "ramps", "constant", "delay"],
)
def test_jitter_leaves_out_the_samples_at_which_a_setpoint_jumps(first, changes, delays):
    case = rig.loads(RIG.format(first=first, changes=changes, duration=100.0))
    expected, all_changes = jitter(case, delays)
    computed = measured(case)
    np.testing.assert_allclose(computed[0], expected, rtol=1e-9)
    np.testing.assert_allclose(computed[1], all_changes, rtol=1e-9)
    if changes == STEPS:
        # the kick of a proportional gain is most of all changes
        assert computed[0][1] < 0.01 * computed[1][1]


NAMES = ["overshoot_percent", "rise_time", "settling_time", "mean_square_overshoot"]


@pytest.mark.slow_for("a table")
@pytest.mark.parametrize("count", [1, 70], ids=["pieces", "a table"])
def test_a_setpoint_that_is_repeated_is_no_change(count):
    """Nor where it repeats the first one: a start away from it is then the change."""
    repeated = "".join(f", [{30.0 + 0.25 * k}, 1, 12.0]" for k in range(count))
    same = "".join(f", [{30.0 + 0.25 * k}, 2, 11.0]" for k in range(count))
    both = "".join(
        f", [{30.0 + 0.25 * k}, 1, 12.0], [{30.0 + 0.25 * k}, 2, 11.0]" for k in range(count)
    )
    text = RIG.replace("Ti = 40.0", "Ti = 4.0").replace(
        "{changes}", "changes = [[20.0, 1, 12.0]{changes}]"
    )
    of = lambda more: rig.loads(text.format(first="", changes=more, duration=100.0))
    plain, cases = of(""), [of(repeated), of(same)]
    expected = jaxtank.evaluate(plain.loop, plain.clock, NAMES)
    assert np.min(expected["overshoot_percent"]) > 1.0 and np.max(expected["rise_time"]) < 50.0
    cases.append(
        of(repeated.replace("12.0", f"{np.nextafter(12.0, 13.0):.17g}"))
    )  # rounding of a unit
    for case in cases:
        values = jaxtank.evaluate(case.loop, case.clock, NAMES)
        for name in NAMES:
            np.testing.assert_allclose(values[name], expected[name], rtol=1e-9)
    arrays = windows(of(both).loop, plain.clock, True)
    for a, b in zip(arrays, windows(plain.loop, plain.clock, True)):
        np.testing.assert_allclose(a, b, rtol=1e-12)


def test_a_setpoint_that_comes_back_to_its_first_value_has_two_changes():
    """Also of an output that begins away from it."""
    there_and_back = "changes = [[20.0, 2, 13.0], [50.0, 2, 11.0]]"
    case = rig.loads(RIG.format(first="", changes=there_and_back, duration=100.0))
    scalars, arrays = (windows(case.loop, case.clock, form) for form in (False, True))
    for steps in (scalars[1][1], arrays[1][:, 1]):
        np.testing.assert_allclose(np.asarray(steps)[[60, 140]], [2.0, -2.0])  # at 30 and 70 s


@pytest.mark.extended
def test_a_setpoint_that_is_repeated_in_its_own_ramp_begins_that_anew():
    times = {}
    for changes in ("[[20.0, 1, 12.0]]", "[[20.0, 1, 12.0], [26.0, 1, 12.0]]"):
        table = f"changes = {changes}, ramp = 10.0"
        case = rig.loads(RIG.format(first="", changes=table, duration=100.0))
        run = jaxtank.simulate(case.loop, case.clock)
        _, step, since, _ = windows(case.loop, case.clock)[0]
        ends = np.asarray(run.t)[np.argmax(np.asarray(run.r)[:, 0] == 12.0)]
        times[changes] = ends
        np.testing.assert_allclose(np.asarray(since)[-1], run.t[-1] - ends)
        assert np.asarray(step)[-1] == 2.0
    assert list(times.values()) == [30.0, 36.0]


@pytest.mark.extended
def test_a_jump_at_the_border_of_two_parts_of_a_long_run_counts_as_any_other():
    borders = [0.5 * (CHUNK + k) for k in (-1, 0, 1)]
    for at in borders:
        changes = f"changes = [[20.0, 1, 12.0], [{at}, 1, 10.0]]"
        case = rig.loads(RIG.format(first="", changes=changes, duration=0.5 * (CHUNK + 40)))
        np.testing.assert_allclose(measured(case)[0], jitter(case)[0], rtol=1e-9)


def test_large_rigs_leave_out_the_same_samples(monkeypatch):
    case = rig.loads(RIG.format(first=", delay = 1.5", changes=STEPS, duration=100.0))
    monkeypatch.setattr("jaxtank.core.vectors.FROM", 1)
    other = case.replace(clock=dataclasses.replace(case.clock, duration=100.5))  # a new program
    assert takes_arrays(other.loop)
    expected = jitter(other, (3, 0))[0]
    np.testing.assert_allclose(measured(other)[0], expected, rtol=1e-9)
    assert np.all(expected > 0.0)

"""The audit of gradients (gradient_audit.py) as tests, and the points on a kink, where no central
difference is a derivative.

The default run audits the roots and clips of numerics.py, a network and a sensor; `pytest -m slow
-s tests/audits/test_gradient_audit.py` a case of each kind too, and prints the count and the worst
error (gradient_audit.py: of every case). That takes a quarter of an hour of a processor, so in
pieces: -k law, -k case, -k sensitivities, ... (2 GB at a time).
"""

import dataclasses

import audit_cases
import audit_subjects
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gradient_audit import STEPS, Subject, audit, differences, reported
from helpers import KINDS

from jaxtank import presets
from jaxtank.controllers.fuzzy import membership
from jaxtank.core import numerics
from jaxtank.core.clock import Clock
from jaxtank.instruments import actuators, sensors
from jaxtank.loop.run import evaluate_and_flag
from jaxtank.plants.network import network


@pytest.fixture(scope="module")
def rows():
    found = []
    yield found
    if found:
        print("\n" + reported(found))


of_kinds = lambda title: set(audit_cases.GROUPS.get(title, KINDS)) & set(KINDS)
ALL = audit_subjects.SUBJECTS | {t: s for t, s in audit_cases.SUBJECTS.items() if of_kinds(t)}


@pytest.mark.extended_for("plants.spill")
@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n in audit_subjects.QUICK else pytest.mark.slow) for n in ALL],
)
def test_forward_and_reverse_are_the_differences(name, rows):
    subject = ALL[name]()
    rows.append(audit(subject))
    if name not in audit_subjects.QUICK:
        # a program of its own for each: together they would take tens of gigabytes
        jax.clear_caches()
    assert rows[-1].good, reported(rows[-1:])


@pytest.mark.slow
def test_the_audit_is_of_a_thousand_points(rows):
    """After the rest of this file, in one process."""
    if len(rows) < len(ALL):
        pytest.skip(f"only {len(rows)} of {len(ALL)} subjects were audited in this process")
    assert sum(r.points for r in rows) >= 1000 and np.isfinite(max(r.worst for r in rows))


def test_every_public_function_of_numerics_is_audited():
    public = {
        n
        for n, f in vars(numerics).items()
        if callable(f) and getattr(f, "__module__", "") == numerics.__name__ and n[0] != "_"
    }
    audited = {
        word
        for name in audit_subjects.SUBJECTS
        if name.startswith("numerics.")
        for word in name[9:].split()
    }
    assert public - audited == {"quantise"}  # a staircase: its slope is tested below


def test_the_audit_finds_a_wrong_slope():
    """A rule that is off by 2e-6, and one that is right forward and wrong in reverse."""

    @jax.custom_jvp
    def off(x):
        return x * x

    off.defjvp(lambda primals, tangents: (off(*primals), (2.0 + 4e-6) * primals[0] * tangents[0]))
    points = np.array([[0.5], [2.0]])
    row = audit(Subject("off", off, points, points))
    assert not row.good and row.worst == pytest.approx(2e-6, rel=1e-3)
    stopped = lambda x: x * jax.lax.stop_gradient(x)
    row = audit(Subject("stopped", lambda x: x * x, points, points, backwards=stopped))
    assert row.worst < 1e-9 and row.ways == pytest.approx(0.5)


def test_on_several_kinks_the_slopes_beside_them_are_judged():
    """A pump at rest at its limit (clip: slope 1) that moves by nothing (travel: slope 0): together
    -1, where the left has 0 and the right 1. Where the subject says that a point is so it passes,
    but not with a slope that is wrong beside it, nor where the subject says nothing.
    """

    def rest(x):
        u = numerics.clip(x, 0.0, 10.0)
        return 2.0 * numerics.magnitude(u) - u

    here = Subject("rest", rest, np.zeros((1, 1)), np.ones((1, 1)), piled=(0,))
    assert jax.jacfwd(rest)(jnp.zeros(1))[0, 0] == -1.0
    row = audit(here)
    assert row.good and row.piled == 1 and row.between == 0
    assert not audit(here._replace(piled=())).good
    # a slope of 1e-3 that is none
    wrong = lambda x: rest(x) + 0.001 * (x - jax.lax.stop_gradient(x))
    assert not audit(here._replace(function=wrong)).good


def test_differences_of_a_known_function():
    """exp at 0, and |x + 3e-5| at 0, whose kink lies within the larger steps."""
    steps = np.array([1.0, -1.0]) * STEPS[:, None]
    values = np.stack([np.exp(steps), np.abs(steps + 3e-5)], axis=-1)[None, None]
    slopes, step = differences(values)
    np.testing.assert_allclose(slopes[0, 0], [1.0, 1.0], rtol=1e-9)
    assert step[0, 0, 1] < 3e-5


# On a kink: the slope of numerics.py lies between the one-sided ones, and is the one its docstring
# names


def one_sided(f, at, h=1e-6):
    """(left, right) slopes, extrapolated from two steps."""
    right = 2 * (f(at + h / 2) - f(at)) / (h / 2) - (f(at + h) - f(at)) / h
    left = 2 * (f(at) - f(at - h / 2)) / (h / 2) - (f(at) - f(at - h)) / h
    return np.array(left), np.array(right)


def rimmed(h, **more):
    return network(
        area=[20.0],
        drain=[0.2],
        pump_gain=[5.0],
        feeds=((0, None),),
        rim=[10.0],
        overflow=True,
        **more,
    ).spill((h,))


def limited(one, other):
    """Flow of a pipe between two levels whose tanks give at most 2 and 3 times their level."""
    one, other = numerics.lower_clip(one, 0.0), numerics.lower_clip(other, 0.0)
    return numerics.limited_flow(numerics.smooth_signed_sqrt(one - other), 2.0 * one, 3.0 * other)


BOX = ((2.0, 0.5, 1.0), np.array([0.0, 0.0]), np.array([10.0, 10.0]))
PUMP = actuators.PumpBank(
    low=np.zeros(1), high=np.full(1, 10.0), dead_zone=np.full(1, 3.0), stop=np.ones(1),
    pulse=np.full(1, 4.0), lag=None,
    initial=np.zeros(1), dead_zone_kind="offset",
)  # fmt: skip
KINKS = [  # what, f, where, the slope by convention (None: any between)
    ("at_least at its floor", lambda x: numerics.lower_clip(x, 2.0), 2.0, 1.0),
    ("at_least by its floor", lambda f: numerics.lower_clip(2.0, f), 2.0, 0.0),
    ("clip at its low end", lambda x: numerics.clip(x, 2.0, 3.0), 2.0, 1.0),
    ("clip at its high end", lambda x: numerics.clip(x, 2.0, 3.0), 3.0, 1.0),
    ("clip by its high end", lambda b: numerics.clip(3.0, 2.0, b), 3.0, 0.0),
    ("portion at its low end", lambda x: numerics.portion(x, 2.0, 3.0), 2.0, 0.5),
    ("portion at its high end", lambda x: numerics.portion(x, 2.0, 3.0), 3.0, 0.5),
    (
        "pieces that meet at a knot",
        lambda x: 3.0 * numerics.portion(x, 1.0, 2.0) + 5.0 * numerics.portion(x, 2.0, 3.0),
        2.0,
        4.0,
    ),
    ("magnitude of nothing", numerics.magnitude, 0.0, 0.0),
    (
        "travel of a pump at rest at its limit",
        lambda v: numerics.magnitude(2.0 - numerics.clip(v, 2.0, 3.0)),
        2.0,
        0.0,
    ),
    ("floored root at its floor", lambda h: numerics.clipped_sqrt(h, 0.04), 0.04, 2.5),
    ("floored root by its floor", lambda f: numerics.clipped_sqrt(0.04, f), 0.04, 0.0),
    ("root of a mean of nothing", lambda e: numerics.root_of_mean(e * e), 0.0, 0.0),
    ("root at an empty tank", numerics.smooth_sqrt, 0.0, 15.0),
    ("root at its knee", numerics.smooth_sqrt, 0.01, 5.0),
    ("limited root at an empty tank", lambda h: numerics.limited_sqrt(h, 0.01, 2.0), 0.0, 2.0),
    ("limited root where the limit ends", lambda h: numerics.limited_sqrt(h, 0.01, 2.0), 0.25, 2.0),
    ("a pipe's flow from an empty tank", lambda h: limited(h, 0.0), 0.0, 2.0),
    ("a pipe's flow into an empty tank", lambda h: limited(0.0, h), 0.0, -3.0),
    ("a pipe's flow between equal levels", lambda h: limited(1.0 + h, 1.0), 0.0, 10.0),
    ("a pipe's flow from a full tank into an empty one", lambda h: limited(4.0, h), 0.0, None),
    ("signed root between equal levels", numerics.smooth_signed_sqrt, 0.0, 10.0),
    ("membership where it begins", lambda e: membership(e, 1.0, 0.4), 0.6, 0.0),
    ("membership as wide as it may be", lambda w: membership(0.7, 1.0, w), 1.0, 0.102375),
    ("membership as low as it may be", lambda b: membership(0.7, b, 1.0), 1.0, -0.580125),
    ("a level at its rim", lambda h: rimmed(h)[0][0], 10.0, 1.0),
    ("the volume lost at a rim", lambda h: rimmed(h)[1][0], 10.0, 0.0),
    ("a level at the bottom", lambda h: rimmed(h, bottom=True)[0][0], 0.0, 1.0),
    (
        "a command at the edge of the box",
        lambda a: sum(actuators.allocate((a, 4.0), *BOX)),
        10.0,
        None,
    ),
    (
        "a command at the corner of the box",
        lambda a: sum(actuators.allocate((10.0 + a, 10.0 + a), *BOX)),
        0.0,
        None,
    ),
    ("an offset dead zone at its edge", lambda v: PUMP.driving((v,))[0], 3.0, 1.0),
]


@pytest.mark.extended_for("a pipe's flow from an empty tank")
@pytest.mark.parametrize("f, at, slope", [pytest.param(*k[1:], id=k[0]) for k in KINKS])
def test_on_a_kink_the_slope_lies_between_the_one_sided_ones(f, at, slope):
    left, right = one_sided(f, jnp.float64(at))
    found = [float(derivative(f)(jnp.float64(at))) for derivative in (jax.grad, jax.jacfwd)]
    assert found[0] == pytest.approx(found[1], rel=1e-12, abs=1e-15)
    # one-sided differences of 1e-6, extrapolated: 1e-9 of round-off, and where a root bends at its
    # knee 1e-5
    margin = 1e-5 * max(1.0, abs(left), abs(right))
    assert min(left, right) - margin <= found[0] <= max(left, right) + margin
    assert slope is None or found[0] == pytest.approx(slope, rel=1e-12)


@pytest.mark.extended_for("jacfwd")
@pytest.mark.parametrize("way", [jax.jacfwd, jax.jacrev])
def test_empty_tanks_at_their_setpoint_are_a_kink_of_the_travel(way):
    """gouta2022/enmpc, both tanks and the first setpoint at 0 cm: the first command is 0 V, the
    limit of pump 1. With more water it
    stays off, with less it runs: on the one side its travel has slope 0, on the other one as steep
        as the law.
    """
    case = presets.find("gouta2022/enmpc")
    clock = Clock(dt=0.05, duration=0.2)
    f = jax.jit(
        lambda x0: evaluate_and_flag(
            dataclasses.replace(case.loop, x0=x0), clock, ("input_travel",)
        )[0]["input_travel"]
    )
    at_rest = jnp.zeros(2)
    found = np.asarray(jax.jit(way(f))(at_rest))
    for i, axis in enumerate(np.eye(2)):
        left, right = one_sided(lambda h, axis=axis: f(at_rest + h * axis), 0.0)
        assert left[0] < -5.0 and right[0] == 0.0
        assert np.all(np.minimum(left, right) <= found[:, i])
        assert np.all(found[:, i] <= np.maximum(left, right))


def test_a_staircase_has_the_slope_of_the_line_through_it():
    """ADC: over whole steps the mean slope is 1, and that is the gradient, at an edge too; outside
    the range it is 0.
    """
    for x in (0.0, 0.013, 0.05, 0.75):
        assert (
            numerics.quantise(x + 0.1, 0.1) - numerics.quantise(x - 0.1, 0.1)
        ) / 0.2 == pytest.approx(1.0, rel=1e-12)
        assert jax.grad(numerics.quantise)(x, 0.1) == jax.jacfwd(numerics.quantise)(x, 0.1) == 1.0
    sensor = sensors.LevelSensor(
        gain=np.array([5.0]), noise=np.zeros(1), full_scale=np.array(5.0), bits=8
    )
    read = lambda h: sensor.read((h,), None)[0]
    step = 5.0 * 5.0 / 2**8
    for h in (3.0, 12.3):
        assert (read(h + 7 * step) - read(h - 7 * step)) / (14 * step) == pytest.approx(
            1.0, rel=1e-9
        )
        assert jax.grad(read)(h) == jax.jacfwd(read)(h) == 1.0
    assert jax.grad(read)(26.0) == jax.grad(read)(-1.0) == 0.0


def test_pulses_have_the_slope_of_the_mean_flow():
    """A voltage below the dead zone is paid in pulses: its mean over many samples has slope 1, as
    the gradient has it.
    """
    pumps = actuators.PumpBank(
        low=np.zeros(1), high=np.full(1, 10.0), dead_zone=np.full(1, 3.0), stop=np.ones(1),
        pulse=np.full(1, 4.0), lag=None,
        initial=np.zeros(1), dead_zone_kind="pulse",
    )  # fmt: skip

    @jax.jit
    def mean(v):
        start = jax.tree.map(
            lambda a: jnp.asarray(a, dtype=jnp.result_type(a)),
            pumps.init(Clock(dt=0.1, duration=1.0)),
        )

        def sample(state, _):
            (u,), state = pumps.step(state, (v,), 0.1)
            return state, u

        return jax.lax.scan(sample, start, length=4000)[1].mean()

    # 4,000 samples at 4 V or not at all: a mean is known to a pulse, 1e-3 V
    assert (mean(1.7) - mean(1.3)) / 0.4 == pytest.approx(1.0, abs=5e-3)
    assert jax.grad(mean)(1.5) == pytest.approx(1.0, rel=1e-12)

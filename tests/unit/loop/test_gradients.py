"""Gradients that are right, not merely finite: central differences at ordinary points and at every
kink of the physics.

Tolerance 1e-5 relative, with a step of 1e-5 in the logarithm: truncation 1e-10 times the third
derivative, round-off 1e-11. Forward and reverse agree to 1e-9.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxtank
from jaxtank import presets
from jaxtank.core.tree import get_value, with_values
from jaxtank.loop.run import evaluate_for_reverse

STEP = 1e-5


def sloped(case, names, measure, clock=None, run=jaxtank.evaluate):
    """(measure as a function of the logarithms of `names`, the point of the case)."""
    point = np.log([float(get_value(case.loop, n)) for n in names])

    def f(z):
        return jnp.ravel(
            run(
                with_values(case.loop, dict(zip(names, jnp.exp(z)))),
                clock or case.clock,
                (measure,),
            )[measure]
        )

    return f, point


def differences(f, z, step=STEP):
    f = jax.jit(f)
    columns = [(f(z + step * e) - f(z - step * e)) / (2 * step) for e in np.eye(len(z))]
    return np.array(columns).T


def agree(case, names, measure="rms_error_total", rtol=1e-5, atol=1e-9, step=STEP):
    """Forward derivatives equal central differences and reverse derivatives; returns them."""
    f, z = sloped(case, names, measure)
    forward = np.asarray(jax.jit(jax.jacfwd(f))(z))
    np.testing.assert_allclose(forward, differences(f, z, step), rtol=rtol, atol=atol)
    g, _ = sloped(case, names, measure, run=evaluate_for_reverse)
    reverse = np.asarray(jax.jit(jax.jacrev(g))(z))
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-12)
    carried = jaxtank.sensitivities(
        case.loop, case.clock, (measure,), {n: get_value(case.loop, n) for n in names}
    )[1][measure]
    np.testing.assert_allclose(
        np.reshape(carried, (-1, len(names))) * np.exp(z), forward, rtol=1e-9, atol=1e-12
    )
    return forward


REFERENCE_SLOPES = [  # case, D, free, d RMS_tot / d ln p (gouta2015 notes S9.1)
    ("ngpc", 30.0, {"controller.Tp": 11.0}, (0.0927,)),
    ("ngpc", 30.0, {"controller.Tp": 7.0}, (-0.1226,)),
    ("ngpc", 30.0, {"controller.Tp": 20.0}, (0.472,)),
    ("ngpc", 60.0, {"controller.Tp": 11.0}, (0.1228,)),
    ("backstepping", 30.0, {"controller.k": 0.03, "controller.k1": 0.088}, (-0.0700, -0.5047)),
    ("backstepping", 60.0, {"controller.k": 0.03, "controller.k1": 0.088}, (-0.0487, -0.4080)),
]


@pytest.mark.slow_for("1", "2", "3", "5", "4")
@pytest.mark.parametrize("name, ramp, values, slopes", REFERENCE_SLOPES, ids="012345")
def test_slopes_of_the_prototype(gouta, name, ramp, values, slopes):
    case = gouta(name, {**values, "reference.ramp": ramp, "clock.dt": 0.05})
    f, z = sloped(case, list(values), "rms_error_total")
    np.testing.assert_allclose(np.ravel(jax.jacfwd(f)(z)), slopes, rtol=5e-3, atol=2e-4)


GAINS = ["controller.k", "controller.k1"]
LOW = {"actuator.low": 3.4, "actuator.high": [3.5, 3.5]}
EMPTY = {"clock.duration": 100.0, "x0": [3.0, 3.0, 0.0, 0.0], "controller.level_floor": 0.5}
COARSE = {"reference.ramp": 30.0, "clock.dt": 0.05}
KINKS = {  # case, values, free, measure, (measure, its least or most value) that shows the kink
    "dry": ("backstepping-ff", {"reference.ramp": 20.0}, GAINS, None, ("min_level", -1e-3)),
    "empty": ("ngpc", EMPTY, ["controller.Tp", "controller.level_floor"], None, None),
    "rim": ("backstepping", {"plant.overflow": True}, GAINS, None, ("overflow_volume", 1.0)),
    "overflow": ("backstepping", {"plant.overflow": True}, GAINS, "overflow_volume", None),
    "saturated": ("backstepping", LOW, GAINS, None, ("saturated_fraction", 0.975)),
    "over the rim": ("ngpc", COARSE, ["controller.Tp"], "rms_over_rim", None),
    "excess": ("ngpc", COARSE, ["controller.Tp"], "saturation_excess", None),
    "highest": ("backstepping", {}, GAINS, "max_level", None),
    "highest of ngpc": ("ngpc", {}, ["controller.Tp"], "max_level", None),
    "box": ("ngpc-boxqp", COARSE, ["controller.Tp"], None, None),
    "dry box": ("ngpc-boxqp", {**COARSE, "reference.ramp": 20.0}, ["controller.Tp"], None, None),
}
ATOL = {"overflow_volume": 1e-6, "saturation_excess": 1e-8}


@pytest.mark.slow
@pytest.mark.parametrize("kink", KINKS)
def test_at_every_kink_of_the_physics(gouta, kink):
    name, values, free, measure, shows = KINKS[kink]
    case = gouta(name, values)
    if shows is not None:
        value = np.asarray(jaxtank.evaluate(case.loop, case.clock, shows[0])[shows[0]])
        assert np.max(np.sign(shows[1]) * value) > shows[1]
    # saturated slopes are 1e-5 cm: a larger step against round-off
    step = 1e-4 if kink == "saturated" else STEP
    agree(case, free, measure or "rms_error_total", atol=ATOL.get(measure, 1e-9), step=step)


@pytest.mark.slow
@pytest.mark.parametrize("samples", [110, 121, 122])
def test_reverse_mode_for_every_number_of_samples(gouta, samples):
    """The run is cut into about sqrt(samples) pieces; squares leave no remainder."""
    case = gouta(
        "ngpc",
        {
            "clock.dt": 0.1,
            "clock.duration": round(0.1 * (samples - 1), 1),
            "x0": [3.5, 3.0, 3.0, 3.0],
        },
    )
    assert case.clock.samples == samples
    agree(case, ["controller.Tp"])


@pytest.mark.slow
def test_a_measure_that_is_zero_throughout_has_slope_zero(gouta):
    case = gouta("ngpc", {"clock.dt": 0.1, "actuator.dead_zone": 11.0, "clock.duration": 20.0})
    f, z = sloped(case, ["controller.Tp"], "rms_input")
    np.testing.assert_array_equal(jax.jacfwd(f)(z), np.zeros((2, 1)))


def test_straight_through_is_not_what_we_do(gouta):
    """A fully saturated run has no derivative by the gains, and says so with an exact zero; it has
    the program of `test_slopes_of_the_prototype`.
    """
    case = gouta("ngpc", {"actuator.low": 11.0, "actuator.high": 11.5, "clock.dt": 0.05})
    saturated = jaxtank.evaluate(case.loop, case.clock, "saturated_fraction")["saturated_fraction"]
    assert np.all(np.asarray(saturated) == 1.0)
    f, z = sloped(case, ["controller.Tp"], "rms_error_total")
    np.testing.assert_array_equal(jax.jacfwd(f)(z), np.zeros((1, 1)))


def test_nan_is_reported_with_time_tank_and_parameters(gouta):
    case = gouta("ngpc", {"clock.duration": 5.0})

    class Broken(type(case.loop.controller)):
        def step(self, state, tick, estimate):
            u, state = super().step(state, tick, estimate)
            return (jnp.where(tick.t >= 2.0, jnp.nan, u[0]), u[1]), state

    fields = {
        f.name: getattr(case.loop.controller, f.name)
        for f in dataclasses.fields(case.loop.controller)
    }
    broken = dataclasses.replace(case.loop, controller=jaxtank.component(Broken)(**fields))
    for call in (
        lambda: jaxtank.evaluate(broken, case.clock, "rms_error"),
        lambda: jaxtank.simulate(broken, case.clock, save_every=10),
    ):
        with pytest.raises(
            jaxtank.NonFiniteError, match=r"tanks 1 to 3 .* t = 2\.01 s .* controller.Tp = 11"
        ):
            call()


@pytest.mark.slow
def test_by_the_duration_of_ramps_setpoints_and_the_filter_of_the_reference(gouta):
    """Rates of the reference are fed forward; the ramps end between two samples."""
    values = {"clock.dt": 0.2, "clock.duration": 360.0, "reference.ramp": 61.03}
    case = gouta("backstepping-ff", {**values, "reference.filter": 4.0, "controller.k1": 0.05})
    names = ["reference.ramp", "reference.targets[2]", "reference.initial[1]"]
    found = agree(case, [*names, "reference.filter[0]"])
    assert np.all(np.abs(found) > 1e-6)


@pytest.mark.slow
def test_the_matrix_of_many_parameters_is_that_of_few(monkeypatch):
    """Slopes that are stored first give the matrix and the slopes of those that are not, of one run
    and of several side by side: nothing is written over before it is read.
    """
    from jaxtank.loop import derivatives

    case = presets.find("gouta2015/backstepping")
    clock = dataclasses.replace(case.clock, dt=1.0, duration=300.0)
    names = ("plant.area", "plant.drain", "plant.orifice", "plant.pump_gain", "controller.k1")
    values = {n: get_value(case.loop, n) for n in names}
    squares = {"mean_square_error": 2.0, "mean_square_travel": -0.5}

    def found(limit):
        monkeypatch.setattr(derivatives, "OUTER", limit)
        jax.clear_caches()

        def one(k):
            loop = with_values(case.loop, {"controller.k": k})
            return jaxtank.sensitivities(
                loop, clock, ("rms_error_total", "max_level"), values, None, squares
            )

        return one(0.03), jax.vmap(one)(np.linspace(0.02, 0.04, 5))

    few, many = found(100), found(0)
    for a, b in zip(jax.tree.leaves(few), jax.tree.leaves(many), strict=True):
        scale = np.abs(np.asarray(a, float)).max()
        np.testing.assert_allclose(b, a, rtol=1e-9, atol=1e-11 * scale)

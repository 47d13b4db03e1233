"""Many runs at once, in batches."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import programs_in

import jaxtank
from jaxtank import presets
from jaxtank.controllers.base import Controller
from jaxtank.core.errors import InputError
from jaxtank.loop.many import _mapped
from jaxtank.loop.run import evaluate_and_flag

NAMES = ("rms_error_total", "max_level", "iae")


def short(name, samples=60):
    case = presets.find(name)
    clock = dataclasses.replace(case.clock, duration=(samples - 1) * case.clock.dt)
    return case.loop, clock


def spread(loop, name, count=5):
    share = np.random.default_rng(0).uniform(0.9, 1.1, count)
    own = np.asarray(jaxtank.parameters(loop)[name])
    return {name: share.reshape(-1, *(1,) * own.ndim) * own}


def one_by_one(loop, clock, rows, key=None):
    count = len(next(iter(rows.values())))
    runs = []
    for i in range(count):
        here = jaxtank.with_values(loop, {n: v[i] for n, v in rows.items()})
        noise = None if key is None else jax.random.fold_in(key, i)
        runs.append(jaxtank.evaluate(here, clock, NAMES, noise))
    return {n: np.stack([run[n] for run in runs]) for n in NAMES}


@pytest.mark.extended
@pytest.mark.slow_for("2")
@pytest.mark.parametrize("batch", [2, 256])
def test_batches_give_what_single_runs_give(batch):
    loop, clock = short("gouta2015/backstepping")
    rows = spread(loop, "plant.orifice")
    found = jaxtank.evaluate_many(loop, clock, NAMES, rows, batch=batch)
    for name, expected in one_by_one(loop, clock, rows).items():
        np.testing.assert_allclose(found[name], expected, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_each_run_has_noise_of_its_own():
    loop, clock = short("cascaded/pi")
    loop = jaxtank.with_values(loop, {"sensor.noise": [0.1, 0.1]})
    rows, key = {"controller.Kc": np.ones((4, 1))}, jax.random.key(3)
    found = jaxtank.evaluate_many(loop, clock, "iae", rows, key, batch=3)
    expected = one_by_one(loop, clock, rows, key)
    np.testing.assert_allclose(found["iae"], expected["iae"], rtol=1e-12)
    assert len(np.unique(np.round(np.ravel(expected["iae"]), 9))) == 4


@pytest.mark.slow
def test_it_can_be_differentiated_and_compiled_into_a_larger_program():
    loop, clock = short("gouta2015/backstepping")

    def mean(share):
        rows = {"plant.orifice": share[:, None] * loop.plant.orifice}
        return jnp.mean(jaxtank.evaluate_many(loop, clock, NAMES, rows, batch=2)["iae"])

    share, step = np.linspace(0.95, 1.06, 3), 1e-5  # none at rest, where |error| has a kink
    slopes = jax.jit(jax.jacfwd(mean))(share)
    for i, move in enumerate(step * np.eye(3)):
        difference = (mean(share + move) - mean(share - move)) / (2 * step)
        assert float(slopes[i]) == pytest.approx(float(difference), rel=1e-6)


@pytest.fixture
def for_gpu(monkeypatch):
    """Trace as if a GPU were there; programs of the CPU are forgotten before and after."""
    jax.clear_caches()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    yield
    monkeypatch.undo()
    jax.clear_caches()


@pytest.mark.slow
def test_one_program_for_a_gpu_without_a_call_to_the_host(for_gpu):
    loop, clock = short("gouta2015/backstepping")
    rows = spread(loop, "plant.orifice", 64)

    def run(rows):
        return jaxtank.evaluate_many(loop, clock, NAMES[:2], rows, batch=32)

    text = jax.jit(run).trace(rows).lower(lowering_platforms=("cuda",)).as_text()
    assert not any(word in text for word in ("callback", "lapack", "custom_call"))


@pytest.mark.parametrize(
    ("values", "options", "words"),
    [
        ({}, {}, "one parameter at least"),
        ([1.0], {}, "values is a list"),
        ({"controller.Kc": "abc"}, {}, "Kc = 'abc': must be an array of numbers"),
        ({"controller.Kc": [[1.0], [1.0, 2.0]]}, {}, "must be an array of numbers"),
        ({"controller.Kc": np.ones(3)}, {}, r"must be \('N', 1\)"),
        ({"controller.Kc": np.ones((0, 1))}, {}, "must be"),
        ({"controller.Kc": np.full((3, 1), np.inf)}, {}, "finite"),
        ({"controller.Kp": np.ones((3, 1))}, {}, "Kc"),
        ({"controller.Kc": np.ones((3, 1)), "x0": np.ones((2, 2))}, {}, "3 of controller.Kc, 2"),
        ({"controller.Kc": np.ones((3, 1))}, {"batch": 0}, "batch = 0"),
    ],
)
def test_what_cannot_be_run_is_refused(values, options, words):
    loop, clock = short("cascaded/pi")
    with pytest.raises(InputError, match=words):
        jaxtank.evaluate_many(loop, clock, ["iae"], values, **options)


def test_the_program_of_batches_does_not_grow_with_their_number():
    """One loop over batches: the text of the program is the same for 8 and for 8,000 runs."""
    loop, clock = short("gouta2015/backstepping")

    def lines(count):
        rows = {"controller.k1": jnp.linspace(0.05, 0.1, count)}
        lowered = jax.jit(lambda rows: _mapped(loop, rows, None, clock, NAMES, 4)).lower(rows)
        return len(lowered.as_text().splitlines())

    assert lines(8) == lines(8000)


def batched_and_direct(samples=40):
    """(evaluate, the run without batching) as functions of two gains, and points to compare at."""
    loop, clock = short("gouta2015/backstepping", samples)
    loop = jaxtank.with_values(loop, {"x0": 0.8 * np.asarray(loop.x0)})

    def of(call):
        def value(gains):
            k, k1 = gains
            here = jaxtank.with_values(loop, {"controller.k": k, "controller.k1": k1})
            return call(here, clock, NAMES[:1])["rms_error_total"]

        return value

    direct = of(lambda *a: evaluate_and_flag(*a)[0])
    points = np.array([0.1, 0.08]) * np.linspace(0.9, 1.1, 300)[:, None]
    return of(jaxtank.evaluate), direct, jnp.asarray(points)


@pytest.mark.slow
def test_a_large_vmap_of_evaluate_runs_in_batches():
    value, direct, points = batched_and_direct()
    np.testing.assert_allclose(
        jax.vmap(value)(points), [direct(p) for p in points], rtol=1e-12, atol=1e-12
    )

    def widths(call, count):
        """Numbers of runs side by side in the loops over the samples."""
        traced = jax.make_jaxpr(jax.vmap(call))(jnp.resize(points, (count, 2)))
        scans = [e for p in programs_in(traced.jaxpr) for e in p.eqns if e.primitive.name == "scan"]
        samples = [e for e in scans if e.params["length"] == 40]
        return {v.aval.shape[0] for e in samples for v in e.outvars if v.aval.shape}

    assert widths(value, 256) == {256} and widths(value, 700) == {256, 700 % 256}
    assert widths(direct, 700) == {700}


@pytest.mark.slow
def test_derivatives_of_evaluate_are_those_of_the_run_in_every_order_with_vmap():
    value, direct, points = batched_and_direct()
    for of in (
        lambda f: jax.jacfwd(f)(points[0]),
        lambda f: jax.grad(f)(points[0]),
        lambda f: jax.hessian(f)(points[0]),
        lambda f: jax.vmap(jax.grad(f))(points[:3]),
        lambda f: jax.grad(lambda s: jnp.sum(jax.vmap(f)(s * points)))(1.0),
        lambda f: jax.vmap(jax.vmap(f))(points.reshape(10, 30, 2)),
    ):
        np.testing.assert_allclose(of(value), of(direct), rtol=1e-9, atol=1e-12)
    step = 1e-6 * np.eye(2)
    differences = [(value(points[0] + s) - value(points[0] - s)) / 2e-6 for s in step]
    np.testing.assert_allclose(jax.grad(value)(points[0]), differences, rtol=1e-6)


STAGED = {
    "grad of jit of vmap": lambda f, x: jax.jacrev(jax.jit(jax.vmap(f)))(x),
    "jacfwd of jit of vmap": lambda f, x: jax.jacfwd(jax.jit(jax.vmap(f)))(x),
    "jvp of vmap of jit": lambda f, x: jax.jvp(jax.vmap(jax.jit(f)), (x,), (jnp.ones_like(x),)),
    "jit of vmap of grad": lambda f, x: jax.jit(jax.vmap(jax.jacfwd(f)))(x),
    "vmap of checkpoint": lambda f, x: jax.jacrev(jax.vmap(jax.checkpoint(f)))(x),
    "vmap of scan": lambda f, x: jax.jacfwd(
        jax.vmap(lambda v: jax.lax.scan(lambda c, _: (c, f(c)), v, None, length=2)[1])
    )(x),
    "vmap of vmap": lambda f, x: jax.jacfwd(jax.jit(jax.vmap(jax.vmap(f))))(jnp.stack([x, x + 1])),
    "linearize": lambda f, x: jax.linearize(jax.jit(jax.vmap(f)), x)[1](jnp.ones_like(x)),
}


@pytest.mark.slow_for(
    *[f"2-{form}" for form in STAGED],
    *[f"4-{form}" for form in STAGED if form != "jit of vmap of grad"],
)
@pytest.mark.parametrize("form", STAGED)
@pytest.mark.parametrize("count", [2, 4])  # as there are outputs, and tanks: axes could be confused
def test_derivatives_of_a_staged_vmap_have_the_right_numbers_and_axes(form, count):
    loop, clock = short("gouta2015/backstepping", 40)
    loop = jaxtank.with_values(loop, {"x0": 0.8 * np.asarray(loop.x0)})

    def of(call):
        def values(k1):
            here = jaxtank.with_values(loop, {"controller.k1": k1})
            found = call(here, clock, ("max_level", "rms_error", "iae"))
            return found["max_level"], found["rms_error"], jnp.sum(found["iae"] ** 2)

        return values

    points = jnp.linspace(0.07, 0.1, count)
    found = STAGED[form](of(jaxtank.evaluate), points)
    expected = STAGED[form](of(lambda *a: evaluate_and_flag(*a)[0]), points)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12, strict=True),
        found,
        expected,
    )


@pytest.mark.slow
def test_results_that_do_not_depend_on_what_is_mapped_have_its_axis():
    loop, clock = short("gouta2015/backstepping")

    def error(k, rim):
        here = jaxtank.with_values(loop, {"controller.k": k, "plant.rim": rim})
        return jaxtank.evaluate(here, clock, NAMES[:1])["rms_error_total"]

    rims = jnp.stack([jnp.full(4, 30.0 + i) for i in range(3)])
    run = jax.jit(lambda k: jax.vmap(error, (None, 0))(k, rims))
    value, slope = jax.jvp(run, (0.03,), (1.0,))
    assert value.shape == slope.shape == (3,)
    assert jnp.shape(jax.grad(lambda k: jnp.sum(run(k)))(0.03)) == ()


@pytest.mark.slow
def test_a_controller_may_close_over_what_is_traced():
    loop, clock = short("cascaded/pi")

    def error(bias, gain):
        @jaxtank.component
        class Own(Controller):
            Kc: float = jaxtank.leaf("-", "gain")

            def step(self, state, tick, estimate):
                return (bias + self.Kc * (tick.r[0] - estimate.x[1]),), state

        here = dataclasses.replace(loop, controller=Own(Kc=gain))
        return jaxtank.evaluate(here, clock, ["iae"])["iae"].sum()

    x = jnp.array([1.0, 2.0, 3.0])
    alone = [float(error(v, v)) for v in x]
    for mapped in (jax.vmap(error), jax.jit(jax.vmap(error))):
        np.testing.assert_allclose(mapped(x, x), alone, rtol=1e-12)
    slopes = jax.jit(jax.vmap(jax.grad(error, (0, 1))))(x, x)
    for i, moved in enumerate((np.array([1e-5, 0.0]), np.array([0.0, 1e-5]))):
        differences = [(error(*(v + moved)) - error(*(v - moved))) / 2e-5 for v in x]
        np.testing.assert_allclose(slopes[i], differences, rtol=1e-5)


@pytest.mark.slow
def test_no_derivatives_are_computed_by_what_does_not_move():
    """Derivatives by two of sixty numbers take no more operations than without batching."""
    value, direct, points = batched_and_direct()

    def operations(call):
        traced = jax.make_jaxpr(jax.jacfwd(call))(points[0])
        return sum(len(p.eqns) for p in programs_in(traced.jaxpr))

    assert operations(value) <= operations(direct) + 5


@pytest.mark.extended
def test_every_row_is_checked_and_one_may_be_the_only_one():
    loop, clock = short("cascaded/pi")
    area = np.asarray(loop.plant.area)
    for rows in ([-area, area], [area, -area]):
        with pytest.raises(InputError, match="area"):
            jaxtank.evaluate_many(loop, clock, NAMES, {"plant.area": np.stack(rows)})
    one = jaxtank.evaluate_many(loop, clock, NAMES, {"plant.area": area[None]})
    assert one["max_level"].shape == (1, 2)

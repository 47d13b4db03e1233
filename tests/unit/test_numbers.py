"""The same numbers whatever runs them: another process, two devices, the XLA option off; and where
float32 is refused, with the reason.

Beside test_compiled_loop.py (jit, vmap, sums in float32) and test_ensemble.py (devices and
processes of an ensemble).
"""

import dataclasses
import json
import os
import subprocess
import sys

import jax
import numpy as np
import pytest
from helpers import python

from jaxtank import InputError, evaluate, presets, sensitivities, with_values
from jaxtank.core.clock import Clock
from jaxtank.xla import flags

RUNS = """
import json, sys
import jaxtank, jax
import numpy as np
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", int(sys.argv[1]))
from jaxtank import presets, rig
values = {"clock.duration": 20.0, "sensor.noise": 0.02, "actuator.delay": 0.2}
case = rig.set_values(presets.find("gouta2022/chadpc"), values)
names, device = ["rms_error_total", "input_travel", "max_level"], jax.devices()[-1]
def run(value, noise):
    loop = jaxtank.with_values(case.loop, {"controller.Tp": value})
    return jaxtank.evaluate(loop, case.clock, names, jax.random.key(noise))
at = jax.device_put(1.3, device)
found = {"one": run(at, 5), "slope": jax.jacfwd(lambda v: run(v, 5))(at)}
many = jax.device_put(np.array([0.9, 1.3, 2.0]), device)
found["lanes"] = jax.vmap(run)(many, np.array([4, 5, 6], dtype=np.uint32))
places = {d.id for v in jax.tree.leaves(found) for d in v.devices()}
flat = {f"{k} {n}": np.ravel(v).tolist() for k, t in found.items() for n, v in t.items()}
print(json.dumps([{n: [x.hex() for x in v] for n, v in flat.items()}, sorted(places)]))
"""


def reported(devices, option):
    """({quantity: (n,)}, where it was) of a fresh process."""
    env = {k: v for k, v in os.environ.items() if k not in ("XLA_FLAGS", flags.SWITCH)} | {
        flags.SWITCH: option
    }
    found, places = json.loads(python(RUNS, devices, env=env))
    return {
        name: np.array([float.fromhex(v) for v in values]) for name, values in found.items()
    }, places


@pytest.fixture(scope="module")
def plain():
    return reported(1, "1")[0]


@pytest.mark.slow
def test_another_process_and_the_second_of_two_devices_give_the_same_bits(plain):
    again, places = reported(2, "1")
    assert places == [1]
    for name, values in plain.items():
        np.testing.assert_array_equal(again[name], values, name)


@pytest.mark.slow
def test_the_option_off_gives_the_same_noisy_runs_batches_and_slopes(plain):
    """To 1e-12 (methods 2.1: the last bits of a step; what adds up over 2,000 of them). A slope is
    a sum of terms of either sign.
    """
    off, _ = reported(1, "0")
    for name, values in plain.items():
        np.testing.assert_allclose(
            off[name], values, rtol=1e-10 if "slope" in name else 1e-12, err_msg=name
        )


FLOAT32 = """
import jaxtank, tuning
from jaxtank import presets
case = presets.find("cascaded/pi")
calls = [lambda: tuning.tune(case), lambda: tuning.identify(case, None)]
for run in (*calls, lambda: tuning.tune_robust(case)):
    try:
        run()
        print("ran")
    except jaxtank.InputError as error:
        print(error)
"""


@pytest.mark.slow
def test_a_run_has_the_precision_of_its_most_precise_leaf():
    """x0 of 32 bits in a loop of 64, and one gain of 64 bits in a loop of 32: jax's scan would not
    have a state change its type.
    """
    case = presets.find("gouta2015/backstepping")
    run = lambda loop: np.asarray(evaluate(loop, Clock(dt=0.1, duration=120.0), ("iae",))["iae"])
    short = lambda tree: jax.tree.map(lambda a: np.asarray(a, np.float32), tree)
    there = dataclasses.replace(case.loop, x0=short(case.loop.x0))
    back = dataclasses.replace(case.loop, x0=np.asarray(short(case.loop.x0), np.float64))
    assert run(there).dtype == np.float64 and np.array_equal(run(there), run(back))
    single = short(case.loop)
    one = dataclasses.replace(
        single,
        actuator=dataclasses.replace(
            single.actuator, high=np.asarray(single.actuator.high, np.float64)
        ),
    )
    assert run(one).dtype == np.float64 and np.allclose(run(one), run(case.loop), rtol=1e-4)
    listed = dataclasses.replace(case.loop, x0=case.loop.x0.tolist())
    assert np.array_equal(run(listed), run(case.loop))


SHAPES = {
    "plant.orifice": (3,),
    "plant.area": (1,),
    "actuator.initial": (2, 1),
    "sensor.noise": (5,),
    "observer.l": (1,),
    "controller.model.orifice": (1,),
    "x0": (3,),
}


@pytest.mark.parametrize("name", SHAPES)
def test_a_leaf_of_another_shape_is_no_other_rig(name):
    """An index past the end is that of the last entry inside jax: such runs gave plausible numbers
    of another rig.
    """
    case = presets.find(
        "gouta2022/chadpc" if name.startswith("observer") else "gouta2015/backstepping"
    )

    def other(tree, path):
        if not path:
            return np.ones(SHAPES[name])
        return dataclasses.replace(tree, **{path[0]: other(getattr(tree, path[0]), path[1:])})

    loop = other(case.loop, name.split("."))
    for run in (
        lambda: evaluate(loop, case.clock, ("iae",)),
        lambda: jax.jit(lambda b: evaluate(b, case.clock, ("iae",)))(loop),
    ):
        with pytest.raises(InputError, match=f"{name} has shape"):
            run()


@pytest.mark.slow
def test_noise_that_no_key_draws_is_no_answer():
    """Outside a trace it is refused; inside one the noise is not known, and a run without it looked
    like an answer.
    """
    case, clock = presets.find("gouta2022/pi"), Clock(dt=0.5, duration=50.0)

    def travel(noise, key=None):
        return evaluate(
            with_values(case.loop, {"sensor.noise": noise}), clock, ("input_travel",), key
        )["input_travel"].sum()

    def slope(noise, key=None):
        loop = with_values(case.loop, {"sensor.noise": noise})
        return sensitivities(loop, clock, ("input_travel",), {"controller.Kc": 1.0}, key)[1][
            "input_travel"
        ]

    key = jax.random.key(0)
    for run in (travel, jax.grad(travel)):
        with pytest.raises(InputError, match="give a key"):
            run(0.1)
    assert np.isnan(jax.jit(travel)(0.1))
    assert np.isnan(jax.jit(jax.grad(travel))(0.1)) and np.isnan(jax.jit(slope)(0.1)).all()
    assert np.isfinite(jax.jit(travel)(0.0)) and np.isfinite(jax.jit(slope)(0.0)).all()
    assert jax.jit(travel)(0.1, key) == pytest.approx(float(travel(0.1, key)), rel=1e-12)
    assert jax.grad(travel)(0.1, key) > 1.0


@pytest.mark.extended
def test_float32_is_refused_where_it_would_be_wrong():
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", FLOAT32], capture_output=True, text=True, check=True
    )
    lines = done.stdout.splitlines()
    assert len(lines) == 3 and all(
        "float64" in line and "jax_enable_x64" in line for line in lines
    ), lines

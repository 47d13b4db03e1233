"""FMUs of a controller and of its plant, run by FMPy in a loop against the simulation."""

import functools
import shutil

import jax
import numpy as np
import pytest
from helpers import opened, signals_of

import jaxtank
from jaxtank import rig
from jaxtank.export.source import files

fmpy = pytest.importorskip("fmpy", reason="FMPy is not installed")
validation, fmi2, fmi3 = (
    pytest.importorskip(f"fmpy.{part}", reason="FMPy is not installed")
    for part in ("validation", "fmi2", "fmi3")
)
pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc on this machine")
SAMPLES = 200


@functools.cache
def case_and_run(name, delay=0.0):
    """A case without noise, and its run of 200 samples as host arrays."""
    case = opened(name)
    values = {"clock.duration": (SAMPLES - 1) * case.clock.dt, "sensor.noise": 0.0}
    case = rig.set_values(case, {**values, "actuator.delay": delay * case.clock.dt})
    return case, jax.tree.map(np.asarray, jaxtank.simulate(case.loop, case.clock))


class Unit:
    """An FMU of either version in this process."""

    def __init__(self, case, folder, version, plant=False):
        (name, content), *_ = files(case, "fmu", name="law", plant=plant, version=version).items()
        path = folder / f"{plant}_{version}_{name}"
        path.write_bytes(content)
        assert validation.validate_fmu(str(path)) == []
        self.text = fmpy.read_model_description(str(path))
        self.refs = {v.name: v.valueReference for v in self.text.modelVariables}
        self.third = version == "3"
        kind = fmi3.FMU3Slave if self.third else fmi2.FMU2Slave
        words = {"modelIdentifier": "law", "unzipDirectory": fmpy.extract(str(path))}
        words["guid"] = self.text.guid
        self.fmu = kind(**words)
        self.fmu.instantiate()
        if not self.third:
            self.fmu.setupExperiment(startTime=0.0)
        self.fmu.enterInitializationMode()

    def _of(self, name):
        array = [ref for full, ref in self.refs.items() if full.split("[")[0] == name]
        return [self.refs[name]] if name in self.refs and "[" in name else array

    def set(self, name, values):
        call = self.fmu.setFloat64 if self.third else self.fmu.setReal
        call(self._of(name), [float(v) for v in np.ravel(values)])

    def get(self, name):
        return np.array((self.fmu.getFloat64 if self.third else self.fmu.getReal)(self._of(name)))

    def step(self, t, dt):
        self.fmu.doStep(t, dt)


def looped(case, run, controller, plant):
    """Inputs and levels of both FMUs in a loop."""
    dt, u, h = case.clock.dt, [], []
    plant.fmu.exitInitializationMode()
    signals = signals_of(case)
    controller.set("y", plant.get("y"))
    controller.fmu.exitInitializationMode()
    for k in range(len(run.t)):
        h.append(plant.get("h"))
        controller.set("y", plant.get("y"))
        for name, values in zip(("r", "dr", "ddr"), signals):
            controller.set(name, values[k])
        controller.step(k * dt, dt)
        u.append(controller.get("u"))
        plant.set("u", u[-1])
        plant.step(k * dt, dt)
    return np.array(u), np.array(h)


@pytest.mark.extended_for("cascaded/pi-3-3.0")
@pytest.mark.parametrize(
    ("name", "version", "delay"),
    [
        ("cascaded/pi", "3", 3.0),
        ("cascaded/pi", "2", 3.0),
        *(
            pytest.param(name, "3", 0.0, marks=pytest.mark.slow)
            for name in (
                *("gouta2015/backstepping-boxqp", "gouta2022/chadpc", "gouta2022/fopi"),
                *("calofir/backstepping-perturbed", "dts200/pi-faults", "mirakhorli/lqi"),
                *("khalid/gpc-nc2-constrained", "khalid/laguerre", "gouta2015/nmpc"),
                "moving_horizon",
            )
        ),
    ],
)
def test_two_fmus_in_a_loop_are_the_simulation(tmp_path, name, version, delay):
    case, run = case_and_run(name, delay)
    controller, plant = (Unit(case, tmp_path, version, plant=p) for p in (False, True))
    u, h = looped(case, run, controller, plant)
    np.testing.assert_allclose(u, run.applied, rtol=0, atol=1e-9 * max(1.0, np.abs(u).max()))
    np.testing.assert_allclose(h, run.x, rtol=0, atol=1e-9 * max(1.0, np.abs(h).max()))
    assert np.ptp(run.x) > 0


def test_parameters_of_an_fmu_are_tunable_with_units_and_ranges(tmp_path):
    case, _ = case_and_run("cascaded/pi", 3.0)
    unit = Unit(case, tmp_path, "3")
    (Kc,) = (v for v in unit.text.modelVariables if v.name == "controller.Kc[0]")
    assert (Kc.causality, Kc.variability, Kc.unit) == ("parameter", "tunable", "V/V")
    (Ti,) = (v for v in unit.text.modelVariables if v.name == "controller.Ti[0]")
    assert (Ti.start, Ti.min) == (str(float(case.loop.controller.Ti[0])), "0.0")
    unit.set("y", [4.0, 3.0])
    unit.fmu.exitInitializationMode()
    unit.set("r", [3.5])
    unit.step(0.0, case.clock.dt)
    before = unit.get("u")
    unit.set("controller.Kc[0]", [3.0 * case.loop.controller.Kc[0]])
    unit.fmu.reset()
    unit.fmu.enterInitializationMode()
    unit.set("controller.Kc[0]", [3.0 * case.loop.controller.Kc[0]])
    unit.set("y", [4.0, 3.0])
    unit.fmu.exitInitializationMode()
    unit.set("r", [3.5])
    unit.step(0.0, case.clock.dt)
    change = 2.0 * case.loop.controller.Kc[0] * 0.5  # of a proportional part, error 0.5
    np.testing.assert_allclose(unit.get("u") - before, change)
    unit.fmu.setBoolean([unit.refs["manual"]], [True])
    unit.set("manual_input", [1.25])
    unit.step(case.clock.dt, case.clock.dt)
    assert unit.get("u") == [1.25]

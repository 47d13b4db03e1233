"""Parts that `identify(refine=True)` adds, on logs of an integrator of these tests' own."""

import numpy as np
import pytest

import tuning
from jaxtank import rig

RIG = """
name = "one tank"
tank = [{ area = 20.0, rim = 40.0, drain = 0.35, level = 9.0 }]
pump = [{ name = "P", to = 1, gain = 8.0, high = 12.0 }]
inputs = { initial = [5.0] }
"""
NOISE, DT = 0.05, 5.0
FREE = {"plant.pump_gain": (1.0, 40.0), "plant.drain[0]": (0.05, 2.0)}


def levels(u, gain=8.0, drain=0.35, exponent=0.5, h=9.0, parts=40):
    """Levels at the samples, by steps of Heun."""
    rate = lambda h, v: (gain * v - drain * 1962**0.5 * max(h, 0.0) ** exponent) / 20.0
    run, step = [], DT / parts
    for v in u:
        run.append(h)
        for _ in range(parts):
            k = rate(h, v)
            h += step / 2 * (k + rate(h + step * k, v))
    return np.array(run)


def data(seed, reading=lambda h: h, samples=240, **law):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(2.5, 11.0, samples // 12), 12)
    y = reading(levels(u, **law)) + NOISE * rng.normal(size=samples)
    return tuning.log(t=DT * np.arange(samples), u=u, y=y)


def refined(log):
    settings = {"starts": 1, "substeps": 2, "hold_back": 0, "refine": True}
    return tuning.identify(rig.loads(RIG), log, FREE, **settings)


GAUGES = {
    "bent": lambda h: np.interp(h, [0.0, 8.0, 16.0, 40.0], [0.0, 4.0, 14.0, 40.0]),
    "true": lambda h: h,
}


@pytest.fixture(scope="module")
def bent():
    return refined(data(1, GAUGES["bent"]))


@pytest.mark.slow
def test_a_gauge_that_is_not_straight_is_found_and_predicts_another_log(bent):
    assert [(part.kind, part.where) for part in bent.refinements][:1] == [("sensor-curve", 0)]
    part = bent.refinements[0]
    assert part.after < 0.5 * part.before
    rmse = tuning.predict(bent.identified, data(2, GAUGES["bent"])).quality["rmse"]
    assert rmse[0] < 3.0 * NOISE
    sensor = bent.identified.loop.sensor
    h = np.linspace(6.0, 24.0, 10)
    # the scale of the levels is held by the last point: up to that, the gauge is that of the log
    y = bent.estimation.data.y[np.isfinite(bent.estimation.data.y)].max()
    scale = np.interp(y, [0.0, 4.0, 14.0, 40.0], [0.0, 8.0, 16.0, 40.0]) / y
    off = sensor.reading_of(0, h / scale) - GAUGES["bent"](h)
    assert np.sqrt(np.mean(off**2)) < 0.5


@pytest.mark.slow
def test_what_was_added_is_reported_and_written(bent):
    assert "a curve of the sensor of" in str(bent)
    row = bent.to_json()["refinements"][0]
    assert (row["kind"], row["where"]) == ("sensor-curve", 1)
    sensors = [bent.identified.loop.sensor, rig.loads(rig.dump(bent.identified)).loop.sensor]
    first, again = (sensor.reading_of(0, np.linspace(6.0, 24.0, 10)) for sensor in sensors)
    np.testing.assert_allclose(again, first, rtol=1e-12)


def test_nothing_is_added_to_a_rig_that_leaves_noise():
    result = refined(data(3))
    assert result.refinements == [] and result.identified.loop.sensor.curve_level is None


@pytest.mark.slow
def test_an_outlet_with_another_exponent_is_found():
    result = refined(data(4, exponent=0.8, drain=0.15))
    assert result.refinements[0].kind == "outlet-exponent"
    assert result.parameters["plant.drain_exponent[0]"]["value"] == pytest.approx(0.8, abs=0.05)

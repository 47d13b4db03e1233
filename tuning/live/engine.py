"""Stub of the engine, until the true one is merged."""

import json
from pathlib import Path


def describe(case):
    leaf = lambda name, unit, value, lo, hi, group: dict(
        name=name, unit=unit, doc=name, value=value, lower=lo, upper=hi, group=group
    )
    return dict(
        case=case.name,
        title=case.title,
        units={"length": "cm", "drive": "V"},
        dt=0.01,
        duration=1200.0,
        samples=120001,
        save_every_default=40,
        tanks=[dict(name="tank 1", rim=10.0), dict(name="tank 2", rim=10.0)],
        outputs=[1],
        pumps=[dict(name="pump 1", lower=0.0, upper=10.0)],
        leaves=[
            leaf("controller.Kc[0]", "V/cm", 1.0, 0.01, 10.0, "controller"),
            leaf("plant.orifice[0]", "cm^2", 0.0386, 0.0, 0.1, "plant"),
            leaf("plant.drain[1]", "cm^2", 0.0408, 0.0, 0.1, "plant"),
            leaf("plant.pump_gain[0]", "cm^3/(s V)", 0.0462, 0.01, 0.1, "plant"),
            leaf("x0[0]", "cm", 4.4, 0.0, 10.0, "initial"),
            leaf("x0[1]", "cm", 4.0, 0.0, 10.0, "initial"),
        ],
        measures=[
            dict(name="rms_error_total", unit="cm", size=1, doc="total RMS error", sense=1),
            dict(name="max_level", unit="cm", size=2, doc="highest level", sense=1),
        ],
        limits=[
            dict(measure="max_level", entry=i, upper=10.0, lower=None, unit="cm") for i in range(2)
        ],
        free=["controller.Kc[0]"],
        bounds={"controller.Kc[0]": [0.01, 5.0]},
        objective=dict(text="rms_error_total", measures={"rms_error_total": 1.0}),
        filter=dict(present=True, default_on=False),
        noise=False,
    )


def engine(case):
    return (
        (Path(__file__).parents[2] / "tests/unit/live/stub.js")
        .read_text()
        .replace("INFO", json.dumps(describe(case)))
    )

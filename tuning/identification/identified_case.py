"""The case before an identification, where only a plant is given, and the one after it."""

import numpy as np

from jaxtank import rig as rigs
from jaxtank.case import Case
from jaxtank.controllers import OpenLoop
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.core.tree import number, with_values
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.observers import Direct
from jaxtank.signals.base import Constant
from tuning.identification.proposal import with_pi


def bare(plant):
    """Return a Case around a plant: ideal pumps and sensors, empty tanks, no controller."""
    n, m = plant.tanks, plant.pumps
    zero = number(np.zeros(m))
    loop = ClosedLoop(
        plant=plant,
        sensor=LevelSensor(
            gain=number(np.ones(n)), noise=number(np.zeros(n)), full_scale=number(np.max(plant.rim))
        ),
        observer=Direct(),
        controller=OpenLoop(signal=Constant(level=zero)),
        actuator=PumpBank(
            low=zero,
            high=number(np.full(m, np.inf)),
            stop=zero,
            pulse=number(np.ones(m)),
            initial=zero,
        ),
        reference=Constant(level=number(np.zeros(len(plant.outputs)))),
        x0=number(np.zeros(n)),
    )
    return Case(
        name="plant",
        title="a plant without a controller",
        loop=loop,
        clock=Clock(),
        limits={},
        free={},
        objective={},
    )


def proposed(result):
    """Return (case, reason): `identified_plant` under a controller of the kind `result.law`."""
    case = identified_plant(result)
    if result.law is None:
        return case, None
    logs = result.estimation.logs
    inputs = np.concatenate([one.u for one in logs]).mean(axis=0)
    try:
        return with_pi(case, inputs), None
    except InputError as error:
        return case, str(error)


def identified_plant(result):
    """Return the Case of an Identification, with the covariance of its estimates."""
    case = result.case
    values = {n: p["value"] for n, p in result.parameters.items()}
    loop = case.loop
    for name, value in values.items():
        loop = with_values(loop, {name: value})
        for holder in ("controller", "observer"):
            model = getattr(getattr(loop, holder), "model", None)
            inner = f"{holder}.model.{name.removeprefix('plant.')}"
            if name.startswith("plant.") and model is not None and rigs.has(loop, inner):
                loop = with_values(loop, {inner: value})
    noise = np.array(loop.sensor.noise, dtype=float)
    white = result.quality["widened"] <= 1.05
    for (tank, volts), rmse, sd in zip(
        result.estimation.data.channels, result.quality["rmse"], result.quality["noise"]
    ):
        gain = float(loop.sensor.gain[tank]) if volts else 1.0
        noise[tank] = (rmse if white else min(rmse, sd)) * gain
    loop = with_values(loop, {"sensor.noise": noise})
    names, matrix = result.covariance
    covered = set(names)
    uncertain = {}
    for name, share in case.uncertain.items():
        uncertain |= rigs.uncovered(loop, name, share, covered)
    covariance = (tuple(names), tuple(tuple(map(float, row)) for row in matrix)) if names else None
    return case.replace(
        name=f"{case.name} identified", loop=loop, uncertain=uncertain, covariance=covariance
    )

"""What users write; test_types.py checks it with pyright and never runs it."""

import jax
import numpy as np

import jaxtank
import tuning
from jaxtank import presets, rig
from jaxtank.controllers.base import Controller
from jaxtank.core.records import Estimate, Tick
from jaxtank.plants import TankNetwork


@jaxtank.component
class Proportional(Controller):
    """A controller of the user's own."""

    gain: float = jaxtank.leaf("V/cm", "gain", low=0.0)
    order: int = jaxtank.static("-", "order", default=1)

    def step(self, state: tuple, tick: Tick, estimate: Estimate):
        return [self.gain * (r - h) for r, h in zip(tick.r, estimate.x)], state


case: jaxtank.Case = presets.find("gouta2015/backstepping")
preset: presets.Preset = presets.load("gouta2015")
loop: jaxtank.ClosedLoop = case.loop
seconds: float = case.clock.duration
clock = jaxtank.Clock(dt=0.1, duration=100.0)
own = case.replace(clock=clock)
law = Proportional(gain=0.5)

trajectory: jaxtank.Trajectory = jaxtank.simulate(loop, clock, save_every=10, key=jax.random.key(0))
levels = np.asarray(trajectory.x).max()
values = jaxtank.evaluate(loop, clock, ["rms_error_total"])
error: jax.Array = values["rms_error_total"]
faster: jaxtank.ClosedLoop = jaxtank.with_values(loop, {"controller.k1": 0.09})
mine: jaxtank.Case = rig.loads('case = "gouta2015/backstepping"')

two: TankNetwork = jaxtank.plants.coupled_tanks(
    area=[1.0, 1.0],
    drain=[0.1, 0.1],
    pipe=0.1,
    pump_gain=1.0,
    rim=50.0,
    outputs=(1,),
    feeds=((0, None),),
)

result: tuning.TuningResult = tuning.tune(case, starts=4, limits={"max_level": 30.0})
status: str = result.status
tuned: jaxtank.Case = tuning.tune_robust(case, {"plant.drain": tuning.Normal(relative=0.05)}).tuned
study = tuning.ensemble(case, samples=100, draws="random")
if study is not None:
    share: np.ndarray = study.failed
data: tuning.Log = tuning.read_log("run.csv", loop)
found: tuning.Identification = tuning.identify(case, [data], hold_back=0.2)

tank = jaxtank.Tank("LT101", area="2500 cm^2", rim=1.2, level=np.float64(0.4))
by_keywords: jaxtank.Case = jaxtank.Rig(
    units=("m", "%"),
    tanks=[tank],
    pumps=[jaxtank.Pump("P101", to="LT101", gain=3e-5, high=100.0)],
    controller={"kind": "pi", "Kc": 200.0, "Ti": "5 min"},
    reference=np.array([[0.0, 0.4], [60.0, 0.6]]),
    dt=5.0,
    duration="20 min",
)
highest: jax.Array = jaxtank.simulate(by_keywords, save_every=2).x.max()
shares = jaxtank.evaluate(by_keywords, ["max_level"])["max_level"]
gain = float(by_keywords.loop.controller.Kc[0]) + float(result.tuned.loop.controller.Kc[0])

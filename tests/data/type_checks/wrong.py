"""Mistakes, one in each marked line; test_types.py expects pyright to report each of them."""

import jaxtank
import tuning
from jaxtank import presets

case = presets.find("gouta2015/backstepping")
jaxtank.simulate(case.loop, case.clock, save_evry=10)  # wrong
jaxtank.Clock(dt=0.1, length=100.0)  # wrong
jaxtank.signals.Ramps(initial=[1.0], sahpe="linear")  # wrong
tuning.tune(case, strats=4)  # wrong
print(case.lop)  # wrong
jaxtank.simulat(case.loop, case.clock)  # wrong
jaxtank.Tank("LT101", aera=1.0)  # wrong
jaxtank.Rig(tank=[])  # wrong

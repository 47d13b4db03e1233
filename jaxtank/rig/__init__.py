"""A rig as a TOML file: a case of a paper and what is different about yours.

case = "gouta2015/backstepping"

[values]                     # any parameter by its dotted name; controller.model.* and
                             # observer.model.* follow plant.* unless they are set, and the
                             # observer's the controller's
"controller.k1" = 0.01
"plant.area" = [21.2, 21.2, 21.2, 21.2]
"clock.dt" = 0.01

[reference]                  # ramps between plateaus
initial = [3.0, 3.0]
changes = [[20.0, 1, 8.0]]   # time [s], output (from 1), level
ramp = 60.0

[reference.sine]             # a sine on top, for a while
amplitude = 1.0
period = 100.0
output = 1

[observer]                   # another one than the preset's, or [controller]: kind, and its fields
kind = "extended-kalman"
process = 1e-4
measurement = 1e-4

[[inflow]]                   # inflow pulses, or [disturbance] inflow = [one per tank]
time = 500.0
duration = 1.0
tank = 2
volume = 500.0

[[fault]]                    # faults of the plant, unknown to the controller
of = "pump_gain[0]"
start = 300.0
end = 400.0
factor = 0.6

[schedule]                   # gains that follow a setpoint (r1, r2 ..) or a level (h1, h2 ..);
                             # their values are "controller.values"
gains = ["controller.k", "controller.k1"]
variable = "r1"
knots = [5.0, 10.0, 15.0]

[limits]                     # hard limits of `tune`
max_level = "rim"

[free]                       # what `tune` may change: [low, high], or with "log" or "linear"
"controller.k1" = [0.001, 5.0]

[objective]                  # what is minimised: measure = weight
rms_error_total = 1.0

[uncertain]                  # spread of the plant's parameters, as a share, for validation
"plant.drain" = 0.05

[covariance]                 # of parameters that vary together, as `identify` writes it
names = ["plant.drain[0]", "plant.drain[1]"]
matrix = [[1e-6, 0.0], [0.0, 1e-6]]

[safety_filter]              # caps on the pumps: no level passes its limit on any plant of the
rate = 1.0                   # intervals above; every key may be left out

[log]                        # columns of experiment data: a header, or [header, unit]
pump1 = ["pump speed", "V"]
h1 = "level 1 [mm]"

[[scenario]]                 # runs that `tune` judges by, instead of the case's own;
                             # scenario = [] at the top: none
name = "noisy"
seed = 1
weight = 2.0
# numbers, or relative to the case: also "by -0.5" (less), and "steady" for a start from a steady
# state: x0, actuator.initial and reference.initial
values = { "sensor.noise" = "0.02 if zero", "plant.pump_gain" = "x1.3", "x0" = [5, 4, 3, 2] }
"""

from jaxtank.case import Case
from jaxtank.rig.components import register
from jaxtank.rig.entry import toml
from jaxtank.rig.read import (
    filtered as filtered,
    from_table as from_table,
    load,
    loads,
    open_case as open_case,
)
from jaxtank.rig.validation import (
    check,
    check_free as check_free,
    check_limits as check_limits,
    check_objective as check_objective,
    check_uncertain as check_uncertain,
    uncovered as uncovered,
    unreachable as unreachable,
)
from jaxtank.rig.values import (
    by_rig_name as by_rig_name,
    dotted_name as dotted_name,
    has as has,
    is_change as is_change,
    overlap as overlap,
    overridden as overridden,
    set_and_schedule as set_and_schedule,
    set_scenario,
    set_values,
    with_bottom as with_bottom,
)
from jaxtank.rig.warnings import case_warnings, model_warnings as model_warnings
from jaxtank.rig.write import complete, dump, save, short

__all__ = [
    "Case",
    "case_warnings",
    "check",
    "complete",
    "dump",
    "load",
    "loads",
    "register",
    "save",
    "set_scenario",
    "set_values",
    "short",
    "toml",
]

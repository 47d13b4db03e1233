"""Tuning and analysis of a closed loop: gains through the simulation, under limits.

import tuning
from jaxtank import presets

result = tuning.tune(presets.load("gouta2015").cases["backstepping"])
print(result)
result.save("tuned")
"""

from jaxtank.core import lazy

__getattr__, __all__ = lazy.attach(__name__, __file__)

lazy.HOMES.update(
    # functions
    fragment="tuning.report.html",
    live_page_of="tuning.report.live",
    save_result="tuning.report.folder",
    Table="tuning.report.tables",
    terminal="tuning.report.document",
    # results
    Answer="tuning.report.tuned",
    Attack="tuning.report.falsification",
    ControllerComparison="tuning.report.controllers",
    Ensemble="tuning.report.uncertainty",
    Feasibility="tuning.report.feasible",
    Identification="tuning.report.identification",
    Identifications="tuning.report.identifications",
    InputBound="tuning.report.optimal_input",
    Prediction="tuning.report.prediction",
    SensitivityResult="tuning.report.effects",
    TuningResult="tuning.report.tuned",
)


def __dir__():
    return sorted({*globals(), *__all__})

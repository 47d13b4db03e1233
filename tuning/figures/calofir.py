"""Figures of Calofir et al.: two coupled tanks under backstepping."""

from tuning.figures.figure import Figure, Run

PAPER = "calofir"

FIGURES = (
    Figure(PAPER, 1, "The rig"),
    Figure(
        PAPER,
        2,
        "Levels of both tanks and the inflow without a fault",
        "Setpoints of 80 and 50 % of the height; the level of the first tank ends at its setpoint"
        " very accurately (sec. 4).",
        (Run("backstepping", "calofir/backstepping"),),
        "levels inputs",
        remark="The curves are described as simulated and as measured; ours are simulated.",
    ),
    Figure(
        PAPER,
        3,
        "The same with faults",
        "The controller acts at once against the faults; steady-state errors remain (secs. 4, 5).",
        (
            Run("without faults", "calofir/backstepping"),
            Run("with faults", "calofir/backstepping-perturbed"),
        ),
        "levels inputs",
        remark="Which faults is not said: a partly closed outlet and a leak are assumed.",
    ),
)

"""Figures of Khalid et al.: coupled tanks under GPC and Laguerre predictive control."""

from tuning.figures.figure import Figure, Run

PAPER = "khalid"
SINGLE = "The level of tank 2 under GPC with a control horizon of {}"
SAYS = (
    "Setpoints of tank 2 are pulses of 0.12 m. Longer control horizons help up to about 10;"
    " overshoot and undershoot stay whatever it is (sec. V.A)."
)
MIMO = (Run("Laguerre, two inputs", "khalid/laguerre-mimo"),)


def _gpc(number, horizon, case):
    return Figure(
        PAPER, number, SINGLE.format(horizon), SAYS, (Run(f"GPC, {horizon}", case),), "levels", (1,)
    )


FIGURES = (
    Figure(PAPER, 1, "The rig"),
    _gpc(2, 2, "khalid/gpc-nc2"),
    _gpc(3, 10, "khalid/gpc"),
    _gpc(4, 30, "khalid/gpc-nc30"),
    Figure(
        PAPER,
        5,
        "The level of tank 2 under Laguerre predictive control",
        "4 parameters with a pole of 0.4; much smaller overshoot and undershoot than GPC"
        " (sec. V.A).",
        (Run("GPC, 30", "khalid/gpc-nc30"), Run("Laguerre, 4", "khalid/laguerre")),
        "levels",
        (1,),
        remark="GPC of figure 4 is drawn too, for the comparison.",
    ),
    Figure(
        PAPER,
        6,
        "The level of tank 1 under Laguerre predictive control of both tanks",
        "Setpoints are pulses of 0.12 m in tank 1 and 0.15 m in tank 2; tighter control than by GPC"
        " (sec. V.B).",
        (Run("GPC, two inputs", "khalid/gpc-mimo"), *MIMO),
        "levels",
        (0,),
    ),
    Figure(
        PAPER,
        7,
        "The level of tank 2 under Laguerre predictive control of both tanks",
        "As figure 6 (sec. V.B).",
        (Run("GPC, two inputs", "khalid/gpc-mimo"), *MIMO),
        "levels",
        (1,),
    ),
)

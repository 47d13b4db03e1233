"""Figures of Mirakhorli and Farrokhi, 2016: the non-minimum-phase quadruple tank."""

from tuning.figures.figure import Figure, Run

PAPER = "mirakhorli"
THREE = (
    Run("SMC", "mirakhorli/smc-fitted"),
    Run("SFC", "mirakhorli/sfc-fitted"),
    Run("hybrid", "mirakhorli/hybrid-fitted"),
)
ASSUMED = (
    "The paper measured this on its rig. Pumps to 5.8 V and 5 % stronger than modelled, sliding"
    " mode as a relay and memberships of 3.25 +- 1.5 cm were chosen to come near its Table 3."
)
WIDER = {"plant.drain": [1.3 * 0.50265, 0.50265, 0.0, 0.0]}
CHANGED = (Run("SFC", "mirakhorli/sfc", WIDER), Run("hybrid", "mirakhorli/hybrid", WIDER))
OUTLET = (
    "Which outlet, and whether wider or narrower, is not said: that of tank 1 is 30 % wider here."
    " With one 30 % narrower 12 cm have no steady state."
)

FIGURES = (
    Figure(PAPER, 1, "The rig"),
    Figure(
        PAPER,
        2,
        "Validation of the identified model",
        "A fit of about 84 % (sec. 2); the record is not printed, so there is nothing to redraw.",
    ),
    Figure(
        PAPER,
        3,
        "Memberships of the size of an error in low and high",
        "",
        (Run("hybrid", "mirakhorli/hybrid"),),
        "memberships",
        remark="The picture is not in the text: a smoothstep, b and w are assumed.",
    ),
    Figure(PAPER, 4, "Block diagram of the hybrid"),
    Figure(PAPER, 5, "Photograph of the rig"),
    Figure(
        PAPER,
        6,
        "Levels of both lower tanks under SMC, SFC and the hybrid, measured",
        "Tank 1: overshoot 44.16, 10 and 13.33 %, rise time 66, 80 and 65 s (Table 3).",
        THREE,
        "levels",
        (0, 1),
        remark=ASSUMED,
    ),
    Figure(
        PAPER,
        7,
        "Inputs of both pumps under the three controllers, measured",
        "Those of SMC chatter (sec. 5).",
        THREE,
        "inputs",
        remark=ASSUMED,
    ),
    Figure(
        PAPER,
        8,
        "Shares of SFC and SMC in the inputs of the hybrid, for figure 6",
        "The hybrid blends the two (sec. 5).",
        THREE[2:],
        "shares",
        remark=ASSUMED,
    ),
    Figure(
        PAPER,
        9,
        "Levels under SFC and the hybrid with another cross section of an outlet, measured",
        "A change of about 30 % leaves a much larger steady-state error with SFC than with the"
        " hybrid (sec. 5).",
        CHANGED,
        "levels",
        (0, 1),
        remark=OUTLET,
    ),
    Figure(
        PAPER,
        10,
        "Shares of SFC and SMC in the inputs of the hybrid, for figure 9",
        "The hybrid keeps changing between the two (sec. 5).",
        CHANGED[1:],
        "shares",
        remark=OUTLET,
    ),
    Figure(
        PAPER,
        11,
        "Inputs of both pumps, for figure 9",
        "The hybrid keeps changing between the two (sec. 5).",
        CHANGED,
        "inputs",
        remark=OUTLET,
    ),
)

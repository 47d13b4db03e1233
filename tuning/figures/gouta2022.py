"""Figures of Gouta et al., 2022: two coupled tanks under ENMPC and CHADPC."""

from tuning.figures.figure import Figure, Run

ENMPC = Run("ENMPC", "gouta2022/enmpc")
CHADPC = Run("CHADPC", "gouta2022/chadpc")
LIKE = (Run("ENMPC", "gouta2022/enmpc-fitted"), Run("CHADPC", "gouta2022/chadpc-fitted"))
THIRD = (Run("CHADPC", "gouta2022/chadpc-trapezoid"),)
BENCH = (
    "The paper measured this on its rig. Ours is a rig with dead zones, delay, lag and noise that"
    " were chosen to come near its Table 3; other choices would do as well."
)
PAPER = "gouta2022"

FIGURES = (
    Figure(PAPER, 1, "The rig"),
    Figure(PAPER, 2, "Block diagram of CHADPC"),
    Figure(PAPER, 3, "Photograph of the rig"),
    Figure(PAPER, 4, "How the controllers were developed"),
    Figure(
        PAPER,
        5,
        "The trapezoidal setpoints of the third experiment",
        "From 330 to 560 s 14 and 8 cm; six intervals by which of the two is higher (sec. 5.2).",
        THIRD,
        "setpoints",
        remark="The picture is not in the text: the other breakpoints are assumed.",
    ),
    Figure(
        PAPER,
        6,
        "Levels of both tanks under ENMPC and CHADPC, simulated",
        "500 cm^3 are poured into tank 2 at 500 s and into tank 1 at 700 s. CHADPC overshoots less,"
        " rejects the disturbance faster, and keeps it from the other tank (sec. 5.2).",
        (ENMPC, CHADPC),
        "levels",
    ),
    Figure(
        PAPER,
        7,
        "Levels of both tanks under ENMPC, measured",
        "Rejection takes about 8 s in tank 1 and 6 s in tank 2; RMS errors 0.76 and 1.29 cm"
        " (Table 3).",
        LIKE[:1],
        "levels",
        remark=BENCH,
    ),
    Figure(
        PAPER,
        8,
        "Levels of both tanks under CHADPC, measured",
        "Rejection takes about 4.5 s in tank 1 and 3.5 s in tank 2; RMS errors 0.62 and 0.98 cm"
        " (Table 3).",
        LIKE,
        "levels",
        remark=f"{BENCH} ENMPC is drawn too, for the comparison.",
    ),
    Figure(
        PAPER,
        9,
        "Inputs of both pumps under ENMPC and CHADPC",
        "The input of pump 2 varies with the level of tank 1 in opposite phase; each drops to 0 V"
        " when liquid is poured into its tank; CHADPC fluctuates less (sec. 5.2).",
        LIKE,
        "inputs",
        remark=BENCH,
    ),
    Figure(
        PAPER,
        10,
        "Disturbances that the observer of CHADPC estimates",
        "Means of -0.4249 and -0.6673 cm/s, and about +2 cm/s as liquid is poured in (sec. 5.2).",
        (CHADPC,),
        "estimates",
        remark="The dead zones of the pumps were chosen so that the means are those of the paper.",
    ),
    Figure(
        PAPER,
        11,
        "Levels of both tanks under CHADPC in the third experiment",
        "Tracking errors close to zero and no effect of one tank on the other (sec. 5.2).",
        THIRD,
        "levels",
        remark="Simulated; the setpoints are partly assumed (figure 5).",
    ),
    Figure(
        PAPER,
        12,
        "Inputs of both pumps in the third experiment",
        "From 330 to 560 s pump 2 delivers less, for liquid flows in from tank 1 (sec. 5.2, which"
        " says figure 13).",
        THIRD,
        "inputs",
        remark="Simulated; the setpoints are partly assumed (figure 5).",
    ),
    Figure(
        PAPER,
        13,
        "Disturbances that the observer estimates in the third experiment",
        "Negative throughout, and smaller in size where the level is higher (sec. 5.2).",
        THIRD,
        "estimates",
        remark="Ours come from dead zones of the pumps, which do not depend on the level.",
    ),
)

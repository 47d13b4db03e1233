"""Figures of Gouta et al., 2015: the state-coupled four-tank rig under NGPC and backstepping."""

from tuning.figures.figure import Figure, Run

NGPC = (Run("NGPC", "gouta2015/ngpc"),)
BACKSTEPPING = (Run("backstepping", "gouta2015/backstepping"),)
BENCH = (
    "The paper measured this on its rig; no record is printed, so ours is the simulation with"
    " sensor noise of 0.03 cm (0.1 % of the height)."
)
NOISE = {"sensor.noise": 0.03}
NOISY_NGPC = (Run("NGPC", "gouta2015/ngpc", NOISE),)
NOISY_BACKSTEPPING = (Run("backstepping", "gouta2015/backstepping", NOISE),)
PAPER = "gouta2015"

FIGURES = (
    Figure(PAPER, 1, "The rig"),
    Figure(PAPER, 2, "The plant with the saturation of its pumps"),
    Figure(PAPER, 3, "Block diagram of NGPC"),
    Figure(PAPER, 4, "Block diagram of backstepping"),
    Figure(
        PAPER,
        5,
        "The setpoints of both lower tanks",
        "20 min; changes of both at 270, 470, 760 and 900 s (sec. 5).",
        NGPC,
        "setpoints",
        remark="The picture is not in the text: plateaus and ramps of 60 s are reconstructed.",
    ),
    Figure(
        PAPER,
        6,
        "Levels of all tanks under NGPC, simulated",
        "Negligible tracking error, worse at changes of the setpoints, where the pumps saturate; no"
        " level above the height of the tanks, 30 cm (sec. 5.1).",
        NGPC,
        "levels",
        remark="With ramps of 60 s the upper tanks pass 30 cm; ramps of 200 s do not.",
    ),
    Figure(
        PAPER,
        7,
        "Inputs of both pumps under NGPC, simulated",
        "Between 0 and 12 V (sec. 5).",
        NGPC,
        "inputs",
    ),
    Figure(
        PAPER,
        8,
        "Levels of all tanks under backstepping, simulated",
        "Tracks better than NGPC, and saturation hardly changes it (sec. 5.1).",
        (*NGPC, *BACKSTEPPING),
        "levels",
        remark="NGPC is drawn too: on this rig it tracks better, the opposite of the text.",
    ),
    Figure(
        PAPER,
        9,
        "Inputs of both pumps under backstepping, simulated",
        "Less aggressive than those of NGPC (sec. 5.1).",
        (*NGPC, *BACKSTEPPING),
        "inputs",
        remark="NGPC is drawn too, for the comparison.",
    ),
    Figure(PAPER, 10, "Photograph of the rig"),
    Figure(PAPER, 11, "Diagram of the experiment"),
    Figure(
        PAPER,
        12,
        "Levels of all tanks under NGPC, measured",
        "The lower tanks follow their setpoints with a negligible static error (sec. 5.2).",
        NOISY_NGPC,
        "levels",
        remark=BENCH,
    ),
    Figure(
        PAPER,
        13,
        "Tracking errors of both lower tanks under NGPC, measured",
        "Negligible static errors (sec. 5.2).",
        NOISY_NGPC,
        "errors",
        remark=BENCH,
    ),
    Figure(
        PAPER,
        14,
        "Inputs of both pumps under NGPC, measured",
        "Between 0 and 12 V; pumps do not always run below 3 V (remark 4).",
        NOISY_NGPC,
        "inputs",
        remark=BENCH,
    ),
    Figure(
        PAPER,
        15,
        "Levels of all tanks under backstepping, measured",
        "The lower tanks follow their setpoints without noticeable disturbance (sec. 5.2).",
        NOISY_BACKSTEPPING,
        "levels",
        remark=BENCH,
    ),
    Figure(
        PAPER,
        16,
        "Tracking errors of both lower tanks under backstepping, measured",
        "",
        (*NOISY_NGPC, *NOISY_BACKSTEPPING),
        "errors",
        remark=f"{BENCH} NGPC is drawn too, for the comparison.",
    ),
    Figure(
        PAPER,
        17,
        "Inputs of both pumps under backstepping, measured",
        "Between 0 and 12 V (sec. 5).",
        NOISY_BACKSTEPPING,
        "inputs",
        remark=BENCH,
    ),
)

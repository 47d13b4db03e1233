"""Measures of the linearised loop: stability margins, the worst of all plateaus.

`loop.margins` computes them.
"""

from typing import Any

from jaxtank.measures.accumulators import Run
from jaxtank.measures.measure import Measure

UNSTABLE = "the linearised loop is unstable at a steady state"
NONE_LEFT = (
    "at no plateau of the reference is there a steady state at which the loop can be linearised;"
    " jaxtank.stability_margins says why of each"
)
NOTHING_HELD = "the reference holds no setpoints at which the loop could be linearised"


def _margin(
    field: str, unit: str, doc: str, unlimited: str, shown: int, low: float, high: float | None
) -> Measure:
    """A margin of each pump: larger is better, infinite where nothing crosses."""

    def read(run: Run, accumulated: dict[str, Any]) -> Any:
        return getattr(run.margins, field)

    return Measure(
        unit,
        "pump",
        (),
        read,
        doc,
        low=low,
        high=high,
        sense=-1.0,
        shown=shown,
        undefined=NONE_LEFT,
        worst=UNSTABLE,
        unlimited=unlimited,
        unserved=NOTHING_HELD,
        linear=True,
    )


MARGINS: dict[str, Measure] = {
    "sensitivity_peak": Measure(
        "-",
        "run",
        (),
        lambda run, accumulated: run.margins.sensitivity_peak,
        "Ms of the linearised loop: largest gain of 1/(1 + L), at the pumps",
        low=1.0,  # the mean of log|S| over frequency is at least 0 (Bode), as L is strictly proper
        shown=110,
        undefined=NONE_LEFT,
        worst=UNSTABLE,
        unserved=NOTHING_HELD,
        linear=True,
    ),
    "gain_margin": _margin(
        "gain_margin",
        "-",
        "factor on the loop gain, up or down, that the linearised loop stands",
        "the phase never reaches -180 deg",
        120,
        low=1.0,
        high=None,
    ),
    "phase_margin": _margin(
        "phase_margin",
        "deg",
        "change of the phase that the linearised loop stands",
        "the gain never reaches 1",
        130,
        low=0.0,
        high=180.0,
    ),
    "delay_margin": _margin(
        "delay_margin",
        "s",
        "additional dead time that the linearised loop stands",
        "the gain never reaches 1",
        140,
        low=0.0,
        high=None,
    ),
}
"""{name: Measure}, entries of the catalogue."""

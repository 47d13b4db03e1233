"""The rigs of the papers: functions that build a `TankNetwork`, and their topologies, by which
controllers check their model.
"""

from collections.abc import Sequence
from typing import Any

from numpy.typing import ArrayLike

from jaxtank.core.checks import check_choice
from jaxtank.core.errors import InputError
from jaxtank.plants import elements
from jaxtank.plants.hydraulics import disc
from jaxtank.plants.network import TankNetwork, network

# tank 3 to 1, 3 to 2, 4 to 1, 4 to 2 in the paper's count from 1
STATE_COUPLED_LINKS = ((2, 0), (2, 1), (3, 0), (3, 1))
STATE_COUPLED_FEEDS = ((2, None), (3, None))
QUADRUPLE_LINKS = ((2, 0), (3, 1))  # tank 3 above 1, 4 above 2
QUADRUPLE_FEEDS = ((0, 3), (1, 2))  # pump 1 to tanks 1 and 4, pump 2 to tanks 2 and 3
COUPLED_PIPES = ((0, 1),)


def state_coupled_four_tank(area: float) -> TankNetwork:
    """Return the state-coupled four-tank of gouta2015 (Fig. 1, eqs. 1-8, Table 1).

    Pumps fill the upper tanks 3 and 4, each of which discharges into both lower tanks 1 and 2,
    whose levels are controlled.

    Parameters
    ----------
    area : cross-section of every tank [cm^2]. The printed diameter 15 sqrt(2) cm gives 353.43 cm^2
        (plant A, "table1"), with which the paper's own gains fail; 15 sqrt(2) read as an area gives
        plant B, "fast", which reproduces the text (gouta2015 notes S1).

    Examples
    --------
    >>> state_coupled_four_tank(15.0).tanks
    4
    """
    inner, outer = disc(0.38), disc(0.31)  # d31 = d42, d32 = d41 [cm], Table 1
    return network(
        area=[area] * 4,
        drain=[disc(0.48), disc(0.48), 0.0, 0.0],  # d1 = d2 [cm], Table 1
        links=STATE_COUPLED_LINKS,
        orifice=[inner, outer, outer, inner],
        pump_gain=7.687,  # Kp [cm^3/(s V)], Table 1 (printed cm^3/V)
        feeds=STATE_COUPLED_FEEDS,
        rim=30.0,  # "the maximum liquid levels of tanks are 30 cm", sec. 5
        outputs=(0, 1),
    )


def quadruple_tank(
    *,
    area: ArrayLike,
    outlet: Sequence[float],
    pump_gain: ArrayLike,
    split: ArrayLike,
    rim: ArrayLike,
    gravity: float = 981.0,
) -> TankNetwork:
    """Return Johansson's quadruple tank (mirakhorli eq. 2).

    Tank 3 discharges into 1, tank 4 into 2; pump 1 feeds tanks 1 and 4, pump 2 tanks 2 and 3.

    Parameters
    ----------
    area, outlet : (4,) cross-sections A and outlet areas a [cm^2]
    pump_gain : (2,) k [cm^3/(s V)]
    split : (2,) share gamma of each pump that goes to the lower tank [-]
    rim : height of the tanks [cm]
    gravity : acceleration [cm/s^2]

    Examples
    --------
    >>> johansson("minimum")[0].split
    array([0.7, 0.6])
    """
    a1, a2, a3, a4 = outlet
    return network(
        area=area,
        drain=[a1, a2, 0.0, 0.0],
        links=QUADRUPLE_LINKS,
        orifice=[a3, a4],
        pump_gain=pump_gain,
        split=split,
        feeds=QUADRUPLE_FEEDS,
        gravity=gravity,
        rim=rim,
        outputs=(0, 1),
    )


# Johansson, IEEE Trans. CST 8(3), 2000, Table I and sec. II: (k [cm^3/(s V)], gamma, operating
# voltages [V])
JOHANSSON = {
    "minimum": ((3.33, 3.35), (0.70, 0.60), (3.0, 3.0)),
    "non-minimum": ((3.14, 3.29), (0.43, 0.34), (3.15, 3.15)),
}


def johansson(phase):
    """Return Johansson's laboratory process (IEEE Trans. CST 8(3), 2000)."""
    check_choice("phase", phase, JOHANSSON)
    pump_gain, split, voltages = JOHANSSON[phase]
    area, outlet = (28.0, 32.0, 28.0, 32.0), (0.071, 0.057, 0.071, 0.057)
    return (
        quadruple_tank(area=area, outlet=outlet, pump_gain=pump_gain, split=split, rim=20.0),
        voltages,
    )


def coupled_tanks(
    *,
    area: ArrayLike,
    drain: ArrayLike,
    pipe: float,
    pump_gain: ArrayLike,
    rim: ArrayLike,
    outputs: Sequence[int],
    feeds: Sequence,
    **more: Any,
) -> TankNetwork:
    """Return two tanks joined by a pipe below the surface: gouta2022, calofir, khalid.

    Parameters
    ----------
    area, drain, rim : (2,) or a number: cross-section, outlet to the basin (0: none) [cm^2], height
        [cm]
    pipe : effective area of the pipe [cm^2]
    pump_gain : (m,) or a number [cm^3/(s V)]
    outputs : tanks whose levels are controlled, counted from 0
    feeds : the tank that each pump fills
    more : as in `network`

    Examples
    --------
    >>> coupled_tanks(
    ...     area=15.0, drain=0.2, pipe=0.1, pump_gain=5.0, rim=30.0, outputs=(1,), feeds=(0,)
    ... ).pipes
    ((0, 1),)
    """
    return network(
        area=area,
        drain=drain,
        pipes=COUPLED_PIPES,
        pipe=[pipe],
        pump_gain=pump_gain,
        feeds=[(tank, None) for tank in feeds],
        rim=rim,
        outputs=outputs,
        **more,
    )


def check_topology(model, like, **wanted):
    """Check that the model of a controller is the rig that it inverts."""
    elements.check_plain(model, "controller.model", f"this controller inverts {like}")
    for name, value in wanted.items():
        if getattr(model, name, None) != value:
            raise InputError(
                f"controller.model must be {like}: this controller inverts it, and its {name} are"
                f" not {value}"
            )

"""Conversion of a rig to python-control, and of the columns of a run to pandas or xarray."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxtank.analysis.linear_model import linearise
from jaxtank.analysis.steady_state import equilibrium
from jaxtank.core.errors import InputError
from jaxtank.loop.trajectory import columns

__all__ = ["columns", "to_control"]


def to_control(
    plant: Any,
    outputs: Sequence[int] | None = None,
    *,
    setpoints: ArrayLike | None = None,
    levels: ArrayLike | None = None,
    inputs: ArrayLike | None = None,
    inflow: ArrayLike | None = None,
) -> Any:
    """Return the rig linearised at a steady state as a `control.StateSpace` of python-control.

    delta x' = A delta x + B delta u, delta y = C delta x (`analysis.linear_model.linearise`), with
    states h1 .., inputs pump1 .. and outputs y_h1 ...

    Parameters
    ----------
    plant : TankNetwork
    outputs : tanks from 0 whose levels are outputs; by default those of the plant
    setpoints : (outputs of the plant,) levels of the steady state [cm]; or, in their place,
    levels, inputs : (n,) levels [cm] and (m,) inputs [V] of the operating point
    inflow : (n,) steady inflow of each tank that no pump brings [cm^3/s]. It belongs to a loop and
        not to its plant: of a rig file `loop.steady.steady_inflow(case.loop)`.

    Returns
    -------
    control.StateSpace

    Raises
    ------
    InputError
        Without python-control, for an operating point that is not given in one way, for sizes that
        are not the plant's, and for setpoints without a steady state.

    Examples
    --------
    >>> from jaxtank import presets
    >>> system = to_control(presets.find("cascaded/pi").loop.plant, setpoints=(5.0,))
    >>> system.state_labels, system.input_labels
    (['h1', 'h2'], ['pump1'])
    """
    try:
        import control
    except ImportError:
        raise InputError("to_control needs python-control: pip install control") from None
    tanks: Sequence[int] = plant.outputs if outputs is None else outputs
    if not all(isinstance(i, (int, np.integer)) and 0 <= i < plant.tanks for i in tanks):
        raise InputError(
            f"to_control: outputs = {outputs!r}: must be indices of tanks from 0 to"
            f" {plant.tanks - 1}; steady levels are given as setpoints=(...)"
        )
    if inflow is not None and np.shape(inflow) != (plant.tanks,):
        raise InputError(f"to_control: inflow = {inflow!r}: must be {plant.tanks} flows")
    levels, inputs = _operating_point(plant, setpoints, levels, inputs, inflow)
    A, B, _ = (np.asarray(M) for M in linearise(plant, levels, inputs, inflow))
    return control.ss(
        A,
        B,
        np.eye(plant.tanks)[list(tanks)],
        np.zeros((len(tanks), plant.pumps)),
        states=[f"h{i + 1}" for i in range(plant.tanks)],
        inputs=[f"pump{j + 1}" for j in range(plant.pumps)],
        outputs=[f"y_h{i + 1}" for i in tanks],
    )


def _operating_point(plant, setpoints, levels, inputs, inflow):
    """(levels (n,), inputs (m,)) of a steady state; InputError unless it is given in one way."""
    if (setpoints is None) == (levels is None) or (levels is None) != (inputs is None):
        raise InputError(
            "to_control: give setpoints=(...), steady levels of the controlled tanks, or both"
            " levels and inputs"
        )
    if setpoints is not None:
        if np.shape(setpoints) != (len(plant.outputs),):
            raise InputError(
                f"to_control: setpoints = {setpoints!r}: must be {len(plant.outputs)} levels"
                f" [{plant.units[0]}]"
            )
        levels, inputs = equilibrium(plant, setpoints, inflow)
    for name, value, size in (("levels", levels, plant.tanks), ("inputs", inputs, plant.pumps)):
        if np.shape(value) != (size,) or not np.all(np.isfinite(np.asarray(value, dtype=float))):
            raise InputError(f"to_control: {name} = {value!r}: must be {size} finite numbers")
    return levels, inputs
